"""The firmware that a node reports: when it is read, what a type demands, and what is shown beside the verdict."""

from __future__ import annotations

import os
import sqlite3
from contextlib import closing, nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import teds
from teds_provision.doctor.checks import System
from teds_provision.doctor.fleet import nodes
from teds_provision.errors import GarbledError, LinkError, NodeRefusedError, NodeSilentError
from teds_provision.protocol.messages.firmware import ABOUT, FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Command, Reason, Reply
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.tim import Tim
from teds_provision.provisioning import identify as identify_step
from teds_provision.provisioning import verify_node
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.firmware import (
    FirmwareError,
    firmware_warning,
    keep_firmware,
    read_firmware,
    require_firmware,
    require_good_firmware,
)
from teds_provision.provisioning.identify import add_to_whitelist, identify
from teds_provision.provisioning.inventory import inventory
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.provisioning.verify_node import verify_at_node
from teds_provision.station.firmware import (
    FirmwareDemands,
    FirmwareReading,
    firmware_of,
    known_firmware,
    same_firmware,
    state_of,
)
from teds_provision.station.station import Station
from teds_provision.teds.profile.firmware import FirmwareDemand, parse_release
from tests.bench import Board, MemoryLink, contact
from tests.cli.shell import call
from tests.e2e.desk import ANGLE

OLD = FirmwareReport("nrf/angle", (1, 1, 0), 3, bytes([1]) * 32)
GOOD = FirmwareReport("nrf/angle", (1, 2, 0), 3, bytes([2]) * 32)
TRIAL = FirmwareReport("nrf/angle", (1, 2, 0), 3, bytes([2]) * 32, FirmwareFlag.ON_TRIAL)
PENDING = FirmwareReport("nrf/angle", (1, 2, 0), 3, bytes([2]) * 32, FirmwareFlag.PENDING)
DEMAND = FirmwareDemand("*/angle", "1.2.0", ("1.3.0", "1.4.0+7", "aa" * 32))


@dataclass
class FirmwareBoard(Board):
    """A board whose firmware reports; ``report`` None: it was built without About."""

    report: FirmwareReport | None = GOOD

    def power_on(self) -> None:
        super().power_on()
        self.tim = Tim(self.key, self.flash, lambda: self.seconds, firmware=self if self.report else None)

    def about(self) -> FirmwareReport | None:
        return self.report

    def locate(self, seconds: int) -> None:
        raise AssertionError("it was asked for nothing else")


def asked(link: MemoryLink) -> int:
    """Plain questions for its firmware that went over a link."""
    return link.frames.count(ABOUT.encode())


def met(board: Board, link: MemoryLink) -> Conversation:
    return Conversation(contact(board, link), notice=lambda _notice: None)


def on_bus(board: Board) -> MemoryLink:
    """Return the wired bus of a board that was built without NFC."""
    return MemoryLink(board, via="can", tapped=board.tim.flash.state == NodeState.FACTORY)


def profile(folder: Path, table: str) -> str:
    path = folder / "angle.toml"
    path.write_text(f'extends = "{ANGLE}"\ntitle = "Angle"\n[channel.1.calibration]\nrequired = false\n{table}')
    return str(path)


def given(station: Station, board: Board, wanted: str | None, *, link: MemoryLink | None = None) -> ProvisionResult:
    with met(board, link or on_bus(board)) as node:
        order = BuildOrder(wanted)
        return provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())


# -- reading ---------------------------------------------------------------------------------------------------------


def test_it_is_asked_once_in_plain_and_once_in_a_session(station: Station) -> None:
    board = FirmwareBoard()
    link = on_bus(board)
    with met(board, link) as node:
        assert read_firmware(node) == read_firmware(node) == FirmwareReading(GOOD, sealed=False)
        assert asked(link) == 1
        who = identify(station, node)
        add_to_whitelist(station, node, who)
        agree(station, node, who)
        before = link.count
        board.report = OLD
        assert read_firmware(node) == read_firmware(node) == FirmwareReading(OLD, sealed=True)
        assert link.count == before + 1


def test_a_keyed_board_is_asked_plainly_on_its_wired_bus_alone(station: Station) -> None:
    board = FirmwareBoard()
    given(station, board, ANGLE)
    reader, bus = MemoryLink(board), on_bus(board)
    with met(board, reader) as node:
        assert read_firmware(node) is None
        assert reader.count == 0
    with met(board, bus) as node:
        assert read_firmware(node) == FirmwareReading(GOOD, sealed=False)


@pytest.mark.parametrize("octets", [None, b"", bytes(42), GOOD.encode()[:41], b"\2" + GOOD.encode()[1:]])
def test_a_board_that_does_not_report_works_as_before(station: Station, octets: bytes | None) -> None:
    """Refusal 1, or another form or length: firmware not reported. A refusal costs one question."""
    board = FirmwareBoard(report=None)

    def forged(_count: int, reply: bytes) -> bytes:
        return reply if octets is None or link.frames[-1] != ABOUT.encode() else Reply(True, octets).encode()

    link = MemoryLink(board, via="can", tamper=forged)
    with met(board, link) as node:
        assert read_firmware(node, once=True) == FirmwareReading(None, sealed=False)
        assert asked(link) == 1
    done = given(station, board, ANGLE)
    assert done.verified.verdict == "authentic"
    assert done.firmware == FirmwareReading(None, sealed=True)
    (known,) = inventory(station, [board.uuid])
    assert known.firmware == {
        "text": None, "version": None, "build": None, "image": None,
        "state": "unjudged", "from": "session", "changed": False,
    }  # fmt: skip


# -- what a type demands -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("report", "state"),
    [
        (None, "not-reported"),
        (FirmwareReport("nrf/force", (1, 3, 0), 0), "bad"),
        (FirmwareReport("nrf/force", (1, 0, 0), 0, bytes([0xAA]) * 32), "bad"),
        (FirmwareReport("nrf/angle", (1, 4, 0), 7), "bad"),
        (FirmwareReport("nrf/angle", (1, 4, 0), 8), "good"),
        (FirmwareReport("nrf/force", (1, 0, 0), 0), "other"),
        (FirmwareReport("nrf/angle", (1, 1, 65535), 9, flags=FirmwareFlag.ON_TRIAL), "outdated"),
        (FirmwareReport("nrf/angle", (1, 2, 0), 0, flags=FirmwareFlag.ON_TRIAL | FirmwareFlag.PENDING), "on-trial"),
        (FirmwareReport("nrf/angle", (1, 10, 0), 0, flags=FirmwareFlag.PENDING), "pending"),
        (GOOD, "good"),
    ],
)
def test_the_first_state_that_applies(report: FirmwareReport | None, state: str) -> None:
    assert state_of(DEMAND, report) == state
    assert state_of(None, report) == "unjudged"


@pytest.mark.parametrize(
    ("table", "report", "state"),
    [
        ('minimum = "1.2.0+45"', FirmwareReport("a", (1, 2, 0), 44), "outdated"),
        ('minimum = "1.2.0+45"', FirmwareReport("a", (1, 2, 0), 45), "good"),
        ('minimum = "1.2.0"', FirmwareReport("a", (1, 1, 9), 99), "outdated"),
        (f'bad = ["1.0.0", "{"AB" * 32}"]', FirmwareReport("a", (1, 2, 0), 1, bytes([0xAB]) * 32), "bad"),
        ('bad = ["1.2.0", "1.3.0+7"]', FirmwareReport("a", (1, 3, 0), 7), "bad"),
        ('bad = ["1.2.0", "1.3.0+7"]', FirmwareReport("a", (1, 3, 0), 0), "good"),
        ('bad = ["1.2.0", "1.3.0+7"]', FirmwareReport("a", (1, 2, 0), 8), "bad"),
        ('text = "nrf[12]/a?"', FirmwareReport("nrf2/ab", (1, 0, 0)), "good"),
        ('text = "nrf[12]/a?"', FirmwareReport("NRF2/ab", (1, 0, 0)), "other"),
        ('text = "nrf[12]/a?"', FirmwareReport("nrf2/abc", (1, 0, 0)), "other"),
        ("", FirmwareReport("a", (0, 0, 0)), "good"),
    ],
)
def test_what_the_table_of_a_type_means(tmp_path: Path, table: str, report: FirmwareReport, state: str) -> None:
    demand = teds.profile.load_profile(Path(profile(tmp_path, f"[firmware]\n{table}\n"))).firmware
    assert state_of(demand, report) == state


BARE = FirmwareReport("nrf/angle", (1, 2, 0), 3)
"""Of a firmware that does not report its image's digest."""


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (None, None, True),
        (None, BARE, False),
        (GOOD, GOOD, True),
        (GOOD, FirmwareReport("x", (9, 9, 9), 9, GOOD.image), True),  # the digest is the image
        (GOOD, FirmwareReport("nrf/angle", (1, 2, 0), 3, bytes([9]) * 32), False),
        (GOOD, TRIAL, True),
        (GOOD, BARE, False),  # nobody knows
        (BARE, FirmwareReport("nrf/angle", (1, 2, 0), 3, flags=FirmwareFlag.PENDING), True),
        (BARE, FirmwareReport("nrf/angle", (1, 2, 0), 4), False),
        (BARE, FirmwareReport("nrf/angle", (1, 2, 1), 3), False),
        (BARE, FirmwareReport("nrf/force", (1, 2, 0), 3), False),
    ],
)
def test_the_same_firmware_is_the_same_image_or_without_digests_the_same_build(
    one: FirmwareReport | None, other: FirmwareReport | None, same: bool
) -> None:
    assert same_firmware(one, other) is same_firmware(other, one) is same


@pytest.mark.parametrize(
    ("signed", "now", "sealed", "changed"),
    [
        (OLD, GOOD, True, True),
        (OLD, GOOD, False, False),  # anybody may say so
        (GOOD, GOOD, True, False),
        (GOOD, None, True, True),
        (None, GOOD, True, False),  # never signed
    ],
)
def test_only_what_is_said_in_a_session_shows_a_change_since_the_signature(
    signed: FirmwareReport | None, now: FirmwareReport | None, sealed: bool, changed: bool
) -> None:
    octets = None if signed is None else signed.encode()
    record: Any = SimpleNamespace(report=GOOD.encode(), in_session=True, signed=octets)
    known = known_firmware(record, lambda: DEMAND, FirmwareReading(now, sealed))
    assert known is not None
    assert known.changed is changed
    kept = known_firmware(SimpleNamespace(report=GOOD.encode(), in_session=sealed, signed=octets), lambda: None)  # type: ignore[arg-type]
    assert kept is not None
    assert (kept.reading, kept.state) == (FirmwareReading(GOOD, sealed), "unjudged")
    assert known_firmware(None, lambda: DEMAND) is None


@pytest.mark.parametrize(
    ("text", "release"),
    [
        ("1.2.3", (1, 2, 3, 0)),
        ("0.0.0+0", (0, 0, 0, 0)),
        ("255.255.65535+4294967295", (255, 255, 65535, 4294967295)),
        *((text, None) for text in ("256.0.0", "0.256.0", "0.0.65536", "0.0.0+4294967296", "1.2", "1.2.3+", "01.2.3")),
    ],
)
def test_a_version_is_one_that_a_node_can_report(text: str, release: tuple[int, ...] | None) -> None:
    assert parse_release(text) == release


TABLE = '[firmware]\ntext = "*/angle"\nminimum = "1.2.0"\n'


@pytest.mark.parametrize("report", [OLD, None, FirmwareReport("nrf/force", (2, 0, 0))])
def test_a_board_with_other_firmware_is_refused_before_it_becomes_ours(
    station: Station, tmp_path: Path, report: FirmwareReport | None
) -> None:
    board = FirmwareBoard(report=report)
    with pytest.raises(FirmwareError) as caught:
        given(station, board, profile(tmp_path, TABLE))
    assert (caught.value.code, caught.value.exit_code) == ("firmware", 6)
    assert f"provision {board.uuid.hex()} --firmware IMAGE" in caught.value.hint, "it is not on the whitelist yet"
    assert (board.state.state, station.pins.entry(board.uuid)) == (NodeState.FACTORY, None)


def test_a_plain_report_never_permits(station: Station, tmp_path: Path) -> None:
    """Anyone on the bus can answer a plain question; the session shows what runs, and nothing is signed."""
    board = FirmwareBoard(report=OLD)

    def forged(_count: int, reply: bytes) -> bytes:
        return Reply(True, GOOD.encode()).encode() if link.frames[-1] == ABOUT.encode() else reply

    link = MemoryLink(board, via="can", tamper=forged)
    with pytest.raises(FirmwareError, match="outdated"):
        given(station, board, profile(tmp_path, TABLE), link=link)
    assert board.state.state == NodeState.KEYED
    assert asked(link) == 1
    board.report = GOOD
    done = given(station, board, profile(tmp_path, TABLE))
    assert done.verified.verdict == "authentic"


def test_a_board_that_does_not_report_in_its_session_is_refused(station: Station, tmp_path: Path) -> None:
    """Its plain report was good, but nobody vouches for that one; a board that is busy (17) is not signed either."""
    board = FirmwareBoard(report=GOOD)
    link = on_bus(board)
    with met(board, link) as node:
        asks = node.request_idempotent

        def refused(command: Command, *words: Any, **more: Any) -> bytes:
            if command == ABOUT and node.sealed:
                raise NodeRefusedError("It is busy.", reason=Reason.BUSY)
            return asks(command, *words, **more)

        node.request_idempotent = refused  # type: ignore[method-assign]
        order = BuildOrder(profile(tmp_path, TABLE))
        with pytest.raises(FirmwareError, match="does not report its firmware"):
            provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
    assert board.state.state == NodeState.KEYED


def test_a_type_without_the_table_asks_nothing_before_the_session(station: Station) -> None:
    board = FirmwareBoard(report=OLD)
    link = on_bus(board)
    assert given(station, board, ANGLE, link=link).verified.verdict == "authentic"
    assert asked(link) == 0


# -- beside the verdict ------------------------------------------------------------------------------------------------


def state(station: Station, board: Board) -> tuple[str, bool]:
    known = firmware_of(station, board.uuid)
    assert known is not None
    return known.state, known.changed


def look(station: Station, board: Board) -> str:
    with met(board, on_bus(board)) as node:
        return verify_at_node(station, node, identify(station, node)).verified.verdict


def test_another_image_is_shown_beside_the_verdict_until_it_is_signed_again_or_accepted(
    station: Station, tmp_path: Path
) -> None:
    board, wanted = FirmwareBoard(), profile(tmp_path, TABLE)
    given(station, board, wanted)
    assert state(station, board) == ("good", False)
    board.report = TRIAL
    look(station, board)
    assert state(station, board) == ("on-trial", False), "the same image"
    board.report = FirmwareReport("nrf/angle", (1, 2, 0), 3, bytes([9]) * 32)
    assert look(station, board) == "authentic", "the verdict covers the datasheet"
    assert state(station, board) == ("good", True)
    given(station, board, wanted)
    assert state(station, board) == ("good", True), "nothing was signed"
    with met(board, on_bus(board)) as node:
        require_session(station, node)
        keep_firmware(station, board.uuid, read_firmware(node), signed=True)
    assert state(station, board) == ("good", False)
    board.report = OLD
    look(station, board)
    assert state(station, board) == ("outdated", True)


def test_a_plain_report_replaces_none_of_a_session(station: Station) -> None:
    board = FirmwareBoard()
    given(station, board, ANGLE)
    keep_firmware(station, board.uuid, FirmwareReading(OLD, sealed=False))
    kept = station.firmware_reports.get(board.uuid)
    assert kept is not None
    assert (kept.report, kept.in_session, kept.signed) == (GOOD.encode(), True, GOOD.encode())


def test_what_a_board_says_plainly_is_not_accepted(station: Station) -> None:
    """Whoever is on the bus may have said it."""
    board = FirmwareBoard()
    given(station, board, ANGLE)
    board.report = OLD
    with station.durable("test"):
        station.firmware_reports.make_hint(board.uuid)
    for sealed, signed in ((False, GOOD), (True, OLD)):
        with met(board, on_bus(board)) as node:
            if sealed:
                require_session(station, node)
            verify_node._firmware_at(station, node, accept=True)
        kept = station.firmware_reports.get(board.uuid)
        assert kept is not None
        assert kept.signed == signed.encode()
        assert [entry.act for entry in station.audit_log.entries()].count("firmware") == sealed


def test_a_report_that_another_program_wrote_does_not_count(station: Station) -> None:
    board = FirmwareBoard()
    given(station, board, ANGLE)
    station.flush()
    with closing(sqlite3.connect(station.home / "store.sqlite3")) as file, file:
        file.execute("UPDATE firmware SET report = ?", (OLD.encode(),))
    assert station.firmware_reports.get(board.uuid) is None


def test_doctor_and_nodes_name_what_a_type_does_not_accept_and_what_changed(station: Station, tmp_path: Path) -> None:
    board = FirmwareBoard()
    given(station, board, profile(tmp_path, TABLE))
    station.flush()
    for board.report in (GOOD, TRIAL, PENDING):  # an update that is not through yet is no trouble of the type's
        look(station, board)
        station.flush()
        assert [finding.result for finding in nodes(System(station.home))] == ["ok"], board.report
    board.report = OLD
    look(station, board)
    station.flush()
    warnings = {finding.why for finding in nodes(System(station.home)) if finding.result == "warning"}
    assert warnings == {
        f"1 with firmware that their type does not accept: {board.uuid.hex()}.",
        f"1 whose firmware changed since calibration: {board.uuid.hex()}.",
    }
    assert "firmware outdated; firmware changed since calibration" in call(station.home, "nodes").out


@pytest.mark.parametrize(
    ("report", "warns"),
    [
        (GOOD, ""),
        (TRIAL, "its firmware is on-trial"),
        (OLD, "its firmware is outdated, and firmware changed since calibration"),
        (FirmwareReport("nrf/angle", (1, 9, 0), 0, bytes([8]) * 32), "firmware changed since calibration"),
    ],
)
def test_a_measurement_warns_or_refuses(station: Station, tmp_path: Path, report: FirmwareReport, warns: str) -> None:
    board = FirmwareBoard()
    given(station, board, profile(tmp_path, TABLE))
    board.report = report
    with met(board, on_bus(board)) as node:
        require_session(station, node)
        known = firmware_of(station, board.uuid, read_firmware(node))
    assert firmware_warning(known) == warns
    refused = "its firmware is" in warns
    with pytest.raises(FirmwareError) if refused else nullcontext():
        require_good_firmware(board.uuid, known)


@pytest.mark.parametrize(
    ("known", "refused"),
    [
        (None, "not-reported"),
        ("not-reported", "not-reported"),
        ("bad", "bad"),
        ("other", "other"),
        ("outdated", "outdated"),
        ("on-trial", "on-trial"),
        ("pending", "pending"),
        ("good", ""),
        ("unjudged", ""),
    ],
)
def test_where_only_good_firmware_is_admitted_a_node_that_never_reported_any_is_refused(
    known: Any, refused: str
) -> None:
    reported = None if known is None else SimpleNamespace(state=known)
    if not refused:
        require_good_firmware(bytes(range(10)), cast(Any, reported))
        return
    with pytest.raises(FirmwareError) as failure:
        require_good_firmware(bytes(range(10)), cast(Any, reported))
    assert failure.value.message == f"The firmware of node 00010203040506070809 is {refused}."


@pytest.mark.parametrize("report", [GOOD, None])
def test_it_costs_identify_one_more_round_trip(
    station: Station, monkeypatch: pytest.MonkeyPatch, report: FirmwareReport | None
) -> None:
    def exchanges() -> int:
        board = FirmwareBoard(report=report)
        link = on_bus(board)
        with met(board, link) as node:
            identify_step._identified(station, node, add=False, dry_run=False)
        return link.count

    with_it = exchanges()
    monkeypatch.setattr(identify_step, "read_firmware", lambda _node, *, once: None)
    assert with_it == exchanges() + 1


def test_a_type_is_read_once_for_all_nodes_that_come_together_and_again_when_it_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of two hundred nodes read three files of TOML, three times: a sixth of what the station had to do."""
    read: list[object] = []
    plain = teds.profile.load_profile

    def counted(*words: Any) -> Any:
        read.append(words)
        return plain(*words)

    monkeypatch.setattr(teds.profile, "load_profile", counted)
    monkeypatch.setattr("teds_provision.station.firmware.time.monotonic", lambda: 7.5)
    file = tmp_path / "type.toml"
    file.write_text(f'extends = "{ANGLE}"\n[firmware]\ntext = "nrf/angle"\n')
    found = [FirmwareDemands(tmp_path).demand_of(str(file)) for _ in range(20)]
    assert len(read) == 1
    assert {demand.text for demand in found if demand is not None} == {"nrf/angle"}
    file.write_text(f'extends = "{ANGLE}"\n[firmware]\ntext = "nrf/other"\n')
    os.utime(file, ns=(1, 1))
    demand = FirmwareDemands(tmp_path).demand_of(str(file))
    assert demand is not None
    assert demand.text == "nrf/other"
    assert FirmwareDemands(tmp_path).demand_of(str(tmp_path / "none.toml")) is None


# -- one question ------------------------------------------------------------------------------------------------------


class Asked:
    """A node that is asked for its firmware: what it answers, and by which kind of request it was asked."""

    def __init__(self, answer: object, *, sealed: bool = False, wired: bool = True, state: str = "KEYED") -> None:
        self.answer, self.sealed, self.wired = answer, sealed, wired
        self.identity = SimpleNamespace(state=NodeState[state])
        self.open_counter = bytes(8) if sealed else None
        self.reported_firmware: Any = None
        self.requests: list[str] = []

    def _reply(self, how: str) -> bytes:
        self.requests.append(how)
        if isinstance(self.answer, Exception):
            raise self.answer
        assert isinstance(self.answer, FirmwareReport)
        return self.answer.encode()

    def request(self, _command: object, _why: str) -> bytes:
        return self._reply("once")

    def request_idempotent(self, _command: object, _why: str) -> bytes:
        return self._reply("until it answers")

    def read(self, **how: bool) -> FirmwareReading | None:
        return read_firmware(cast("Conversation", self), **how)


@pytest.mark.parametrize(
    ("sealed", "wired", "state", "asks"),
    [
        (False, True, "KEYED", True),
        (False, True, "FACTORY", True),
        (False, False, "FACTORY", True),  # a tag, or the air: a node without a key answers anyone
        (False, False, "KEYED", False),  # it would refuse with 3
        (False, False, "PROVISIONED", False),
        (True, False, "PROVISIONED", True),
    ],
)
def test_a_node_is_asked_where_it_may_answer(sealed: bool, wired: bool, state: str, asks: bool) -> None:
    node = Asked(GOOD, sealed=sealed, wired=wired, state=state)
    assert node.read() == (FirmwareReading(GOOD, sealed=sealed) if asks else None)
    assert node.requests == ["until it answers"] * asks
    node.read()
    assert len(node.requests) == asks, "once for each session"


def test_a_node_that_refuses_for_now_is_asked_again_and_one_that_cannot_report_is_not() -> None:
    for reason, reading, times in ((Reason.BUSY, None, 2), (Reason.UNKNOWN_COMMAND, FirmwareReading(None, False), 1)):
        node = Asked(NodeRefusedError("no", reason=reason))
        assert node.read() == node.read() == reading
        assert len(node.requests) == times


@pytest.mark.parametrize("error", [NodeSilentError("silent"), GarbledError("torn")])
def test_an_answer_that_is_lost_is_an_error_unless_it_was_asked_in_passing(error: LinkError) -> None:
    node = Asked(error)
    with pytest.raises(type(error)):
        node.read()
    assert node.read(once=True) is None
    assert node.requests == ["until it answers", "once"]


@pytest.mark.parametrize(
    ("demand", "reading", "text"),
    [
        (None, FirmwareReading(OLD, sealed=False), None),
        (DEMAND, None, None),  # it could not be asked here: the session asks
        (DEMAND, FirmwareReading(GOOD, sealed=False), None),
        (DEMAND, FirmwareReading(TRIAL, sealed=True), None),
        (DEMAND, FirmwareReading(PENDING, sealed=True), None),
        (DEMAND, FirmwareReading(None, sealed=False), "does not report its firmware (wanted: */angle)"),
        (DEMAND, FirmwareReading(OLD, sealed=False),
         "runs outdated firmware: nrf/angle 1.1.0+3 (wanted: */angle, at least 1.2.0)"),
        (DEMAND, FirmwareReading(FirmwareReport("nrf/arm", (1, 2, 0), 3, bytes([4]) * 32), sealed=True),
         "runs other firmware than its type: nrf/arm 1.2.0+3 (wanted: */angle)"),
        (FirmwareDemand(bad=("1.2.0",)), FirmwareReading(GOOD, sealed=True),
         "runs firmware that its type rules out: nrf/angle 1.2.0+3"),
    ],
)  # fmt: skip
def test_what_a_board_is_refused_for_and_what_was_wanted(
    demand: FirmwareDemand | None, reading: FirmwareReading | None, text: str | None
) -> None:
    uuid = bytes(10)
    if text is None:
        require_firmware(uuid, demand, reading)
        return
    with pytest.raises(FirmwareError) as refused:
        require_firmware(uuid, demand, reading)
    assert refused.value.message == f"Board {uuid.hex()} {text}. Nothing was signed."
    assert refused.value.hint == (f"Install other firmware in the same run: provision {uuid.hex()} --firmware IMAGE")
    assert (refused.value.code, refused.value.exit_code) == ("firmware", 6)


@pytest.mark.parametrize(
    ("state", "changed", "warning"),
    [
        ("good", False, ""),
        ("unjudged", False, ""),
        ("good", True, "firmware changed since calibration"),
        ("unjudged", True, "firmware changed since calibration"),
        ("outdated", False, "its firmware is outdated"),
        ("bad", True, "its firmware is bad, and firmware changed since calibration"),
    ],
)
def test_a_measurement_is_warned_of_firmware_that_is_not_good_or_has_changed(
    state: str, changed: bool, warning: str
) -> None:
    known: Any = SimpleNamespace(state=state, changed=changed)
    assert firmware_warning(known) == warning
    assert firmware_warning(None) == ""
