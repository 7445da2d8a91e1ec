"""Parts of rules that a good node never reaches: which channel is tried, what is skipped, how a result comes about."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.check import firmware_rules, measuring_rules, session_rules
from teds_provision.check.probe import NotApplicableError, RuleBrokenError
from teds_provision.check.rule import RuleResult
from teds_provision.check.run import _Run
from teds_provision.check.slips import Slip
from teds_provision.errors import BadDataError, GarbledError, NodeSilentError, NotAuthenticError, PolicyError
from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Command, Reply
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.teds.sheet import ChannelKind

SENSOR, EVENT, ACTUATOR = ChannelKind.SENSOR, ChannelKind.EVENT_SENSOR, ChannelKind.ACTUATOR
FITS = "build its firmware with one, whose Channel TEDS fits."


def _channels(*kinds: ChannelKind, keep: Any = "keep") -> Any:
    return SimpleNamespace(channels={number: (kind, 2) for number, kind in enumerate(kinds, 1)}, keep=keep)


@pytest.mark.parametrize(
    ("kinds", "sensor"),
    [((SENSOR, SENSOR), 1), ((EVENT, ACTUATOR, SENSOR), 3), ((ACTUATOR, EVENT, EVENT), 2), ((ACTUATOR,), None)],
)
def test_a_sensor_that_samples_by_period_is_tried_before_one_of_events(
    kinds: tuple[ChannelKind, ...], sensor: int | None
) -> None:
    if sensor is not None:
        assert measuring_rules._sensor(_channels(*kinds)) == sensor
        return
    with pytest.raises(NotApplicableError) as no:
        measuring_rules._sensor(_channels(*kinds))
    assert str(no.value) == f"No sensor can be claimed: {FITS}"


def test_an_actuator_is_claimed_only_if_that_was_asked_for() -> None:
    assert measuring_rules._actuator(_channels(SENSOR, ACTUATOR, ACTUATOR)) == (2, 2)
    for probe, words in (
        (_channels(SENSOR, ACTUATOR, keep=None), "Claims an actuator: ask for it with --factory."),
        (_channels(SENSOR, EVENT), f"No actuator can be claimed: {FITS}"),
    ):
        with pytest.raises(NotApplicableError) as no:
            measuring_rules._actuator(probe)
        assert str(no.value) == words


@pytest.mark.parametrize(
    ("reply", "fits", "ended"),
    [(Reply(False, b"\6"), False, 0), (Reply(False, b"\x13"), True, 0), (Reply(True, b""), True, 1)],
)
@pytest.mark.parametrize("kind", [SENSOR, ACTUATOR])
def test_a_lease_of_0_tells_whether_a_teds_fits_and_one_that_is_taken_is_ended(
    kind: ChannelKind, reply: Reply, fits: bool, ended: int
) -> None:
    asked, good = list[Command](), list[Command]()

    def sealed(command: Command) -> Reply:
        asked.append(command)
        return reply

    probe: Any = SimpleNamespace(sealed=sealed, sealed_good=good.append)
    assert measuring_rules._fits(probe, 5, kind, bytes(16)) is fits
    assert asked[0].encode().hex() == "00050401" + ("0013" if kind is ACTUATOR else "0011") + "00" * (
        19 if kind is ACTUATOR else 17
    )
    assert [command.encode().hex() for command in good] == ["000004020000"] * ended


def test_why_no_channel_can_be_claimed_is_kept_for_the_rules_after_it() -> None:
    probe: Any = SimpleNamespace(channels={}, no_channels="kept reason")
    with pytest.raises(NotApplicableError, match="kept reason"):
        measuring_rules.channels(probe)
    probe = SimpleNamespace(channels={}, no_channels="", sealed=lambda _: Reply(False, b"\1"))
    with pytest.raises(NotApplicableError) as no:
        measuring_rules.channels(probe)
    assert str(no.value) == probe.no_channels
    assert probe.no_channels == "The board does not measure (Operation gets 1): build its firmware with a channel."
    cures = [measuring_rules._cure(SimpleNamespace(keep=keep)) for keep in (None, print)]  # type: ignore[arg-type]
    assert cures == [
        "Provision the board with its datasheet, or let the check write one: --factory",
        "None of the usual formats fits either: provision the board with its datasheet, and leave --factory out.",
    ]


@pytest.mark.parametrize("rule", ["locate", "locate_in_session"])
def test_a_board_without_a_light_answers_1(monkeypatch: pytest.MonkeyPatch, rule: str) -> None:
    asked: list[Any] = []

    def refused(command: Command, reason: int, why: str) -> str:
        asked.append((command.encode().hex(), reason, why))
        return "refused"

    report = FirmwareReport("desk/check", (1, 2, 3), 4, bytes(range(32)), FirmwareFlag(0))
    monkeypatch.setattr(firmware_rules, "_known", lambda _: Reply(True, report.encode()))
    monkeypatch.setattr(firmware_rules, "_in_session", lambda _: report)
    probe: Any = SimpleNamespace(refused=refused, sealed_refused=refused, close=lambda: None)
    assert getattr(firmware_rules, rule)(probe) == "refused"
    assert asked == [("00008016000101", 1, "a board without anything to blink")]


# -- addresses ---------------------------------------------------------------------------------------------------------


class _Bus:
    """A bus of which these addresses are in use."""

    def __init__(self, *used: int, uuid: bytes = bytes(10)) -> None:
        self.used, self.asked, self.uuid = used, list[int](), uuid

    def identify_at(self, address: int) -> Identity | None:
        self.asked.append(address)
        return Identity(self.uuid, NodeState.KEYED, 1, 1, 512, address) if address in self.used else None

    def identify_functional(self) -> bytes:
        return b""

    begin = from_station = identify_functional
    address = 0


def test_a_node_is_moved_to_an_address_that_nobody_has() -> None:
    bus = _Bus(70, 123)
    probe: Any = SimpleNamespace(contact=SimpleNamespace(link=bus))
    assert session_rules._free_address(probe, 17) == 176
    assert bus.asked == [70, 123, 176]
    full: Any = SimpleNamespace(contact=SimpleNamespace(link=_Bus(*range(1, 240))))
    with pytest.raises(NotApplicableError) as no:
        session_rules._free_address(full, 17)
    assert str(no.value) == "Every CAN address is in use here: disconnect other boards."
    assert sorted(full.contact.link.asked) == [address for address in range(1, 240) if address != 17]
    elsewhere: Any = SimpleNamespace(contact=SimpleNamespace(link=object()))
    assert session_rules._free_address(elsewhere, 17) == 70


@pytest.mark.parametrize(
    ("link", "found"),
    [
        (object(), NodeSilentError),
        (_Bus(), NodeSilentError),
        (_Bus(70), NodeSilentError),
        (_Bus(70, uuid=b"u" * 10), RuleBrokenError),
    ],
)
def test_a_node_that_fell_silent_while_it_moved_is_looked_for_at_its_new_address(
    link: object, found: type[Exception]
) -> None:
    moves: list[int] = []

    def sealed(_command: Command) -> Reply:
        raise NodeSilentError("silent")

    probe: Any = SimpleNamespace(
        session="session", sealed=sealed, contact=SimpleNamespace(link=link), uuid=b"u" * 10, move=moves.append
    )
    with pytest.raises(found) as broken:
        session_rules._moved(probe, 17, 70)
    if found is RuleBrokenError:
        assert str(broken.value).startswith(
            "Set CAN address (128.10) 70: the node is there now, and its reply never came from 17."
        )
        assert (moves, probe.session) == ([70], None)
    else:
        assert (moves, probe.session) == ([], "session")


def test_an_address_that_another_station_has_just_set_is_set_ten_seconds_later() -> None:
    replies, pauses, moves = [Reply(False, b"\x11"), Reply(True, b"")], list[float](), list[int]()
    probe: Any = SimpleNamespace(
        session="session", sealed=lambda _: replies.pop(0), pause=pauses.append, move=moves.append
    )
    assert session_rules._moved(probe, 17, 70) is probe.session
    assert (pauses, moves, replies) == ([10.0], [70], [])


def test_nobody_answers_a_question_to_everyone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_rules, "_RepeatedIdentify", lambda _: None)
    with pytest.raises(RuleBrokenError) as broken:
        session_rules.repetition_everyone(SimpleNamespace(bus=_Bus()))  # type: ignore[arg-type]
    assert str(broken.value) == "Identify (128.7), functional: no reply."


# -- results -----------------------------------------------------------------------------------------------------------

SLIP = Slip("a-slip", "what it did")


@pytest.mark.parametrize(
    ("raised", "result", "detail", "slip"),
    [
        (None, "passed", "seen", None),
        (NotApplicableError("no bus"), "skipped", "no bus", None),
        (RuleBrokenError("it broke"), "failed", "it broke", None),
        (RuleBrokenError("it broke", SLIP), "failed", None, "a-slip"),
        (BadDataError("bad"), "failed", "bad", None),
        (NotAuthenticError("forged"), "failed", "forged", None),
        (PolicyError("not ours"), "failed", "not ours", None),
    ],
)
def test_each_end_of_a_rule_is_a_result(
    raised: Exception | None, result: str, detail: str | None, slip: str | None
) -> None:
    def run(_probe: Any) -> str:
        if raised is not None:
            raise raised
        return "seen"

    rig: Any = SimpleNamespace(_probe=SimpleNamespace(session="open", asked="List"), _checks={})
    rule: Any = SimpleNamespace(name="a-rule", clause="Clause", run=run)
    found = _Run._tried(rig, rule)
    assert (found.rule, found.clause, found.result, found.slip) == ("a-rule", "Clause", result, slip)
    assert detail is None or found.detail == detail
    assert rig._probe.session == ("open" if raised is None else None)


def test_a_node_that_falls_silent_is_named_with_rule_and_command() -> None:
    def run(_probe: Any) -> str:
        raise NodeSilentError("No answer.", hint="Tap it.")

    rig: Any = SimpleNamespace(_probe=SimpleNamespace(session="open", asked="List (128.11)"), _checks={})
    rule: Any = SimpleNamespace(name="a-rule", clause="Clause", run=run)
    with pytest.raises(NodeSilentError) as lost:
        _Run._tried(rig, rule)
    assert lost.value.message == "The node fell silent in the rule a-rule: List (128.11): No answer."
    assert lost.value.hint == "Tap it."
    assert rig._checks == {"a-rule": RuleResult("a-rule", "Clause", "skipped", "List (128.11): No answer.")}

    def garbled(_probe: Any) -> str:
        raise GarbledError("torn")

    rule.run = garbled
    with pytest.raises(GarbledError, match="torn"):
        _Run._tried(rig, rule)


@pytest.mark.parametrize(("home", "now"), [(0, 17), (17, 17)])
def test_a_node_whose_address_was_not_moved_is_not_moved_back(home: int, now: int) -> None:
    """Address 0 would be asked of it, and waited for."""
    probe: Any = SimpleNamespace(home_address=home, identity=lambda: SimpleNamespace(can_address=now))
    with pytest.raises(NotApplicableError) as no:
        session_rules.address_back(probe)
    assert str(no.value) == "The rule address-moves moved no address."


@pytest.mark.parametrize("own", [None, {(1, 3): b"teds"}])
def test_a_board_gets_its_own_teds_back_if_it_was_lent_others(monkeypatch: pytest.MonkeyPatch, own: Any) -> None:
    """Its channels are asked for again, and so is why none could be claimed."""
    course: list[Any] = []
    probe: Any = SimpleNamespace(
        own_blocks=own, channels={1: (SENSOR, 2)}, no_channels="none", close=lambda: course.append("closed")
    )

    def commit(of: Any, blocks: Any, *, write: Any) -> None:
        assert of is probe
        course.append((blocks, write))

    monkeypatch.setattr(measuring_rules, "commit_blocks", commit)
    measuring_rules.restore(probe)
    assert course == ([] if own is None else ["closed", (own, {}), "closed"])
    assert (probe.own_blocks, probe.channels, probe.no_channels) == (None, {}, "")
