"""``node check``: the reference node keeps every rule, and each fault is found by the rule that names it."""

from __future__ import annotations

import hmac
import re
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.check import firmware_rules, frame_rules
from teds_provision.check.agreement_rules import ExplainedRequest
from teds_provision.check.rule import RULES, Stage
from teds_provision.check.run import CheckReport, check_node
from teds_provision.errors import GarbledError, MessageTooLongError, NodeSilentError, PolicyError
from teds_provision.protocol.messages.frames import Function, Reason, decode_reply, refusal, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.agree import reset_node
from teds_provision.provisioning.identify import identify
from teds_provision.station.station import Station
from tests.protocol.operation.bench import SAFE_VALUE

from .. import bench
from ..bench import make_station, talk
from . import faulty, nodes
from .bends import agreeing_so, opening_so
from .faulty import FaultyBus, FaultyLink
from .memory_bus import MemoryServer
from .nodes import Board, names

DOCS = Path(__file__).parents[2] / "docs"


@pytest.fixture
def patch(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    return monkeypatch


def checked(station: Station, board: bench.Board, *, factory: bool = True, **link: object) -> CheckReport:
    with pytest.MonkeyPatch.context() as patch:
        return nodes.checked(station, patch, board, factory=factory, **link)


OF_FRAMES = {"can-flow-control", "can-form", "nfc-wait-time", "nfc-wtx"}
"""Rules that hear frames: a link in memory has none. ``test_link_rules`` tries them."""
OF_STATIONS = {
    "can-busy", "confirm-other-link", "confirm-beside", "two-sessions", "stranger-ends-nothing", "repetition-everyone",
    "repetition-two", "staging-shared", "session-bound",
}  # fmt: skip
"""Rules that need a second station."""
OF_CAN = OF_STATIONS | {rule.name for rule in RULES if rule.run.__module__ == frame_rules.__name__}
OF_CHANNELS = {rule.name for rule in RULES if rule.stage == Stage.MEASURING}
BY_DATA = {"stream-messages", "drive-replay", "trigger-token"}
"""Rules of channels that need CAN."""
NOTHING_READ_ONLY = {"write-read-only"}


# -- a good node -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("over", "skipped"),
    [
        ("nfc", {"keyed-untapped", *OF_CHANNELS, *OF_CAN, *NOTHING_READ_ONLY}),
        ("can", {"confirm-elsewhere", *OF_CHANNELS, *NOTHING_READ_ONLY}),
        ("measuring", {"keyed-untapped", *BY_DATA, *OF_CAN, *NOTHING_READ_ONLY}),
        ("measuring can", {"confirm-elsewhere", *NOTHING_READ_ONLY}),
        ("nfc read-only", {"keyed-untapped", *OF_CHANNELS, *OF_CAN}),
    ],
)
def test_the_reference_node_keeps_every_rule(
    station: Station, patch: pytest.MonkeyPatch, over: str, skipped: set[str]
) -> None:
    board = nodes.made(over)
    own, home = dict(board.state.blocks), board.tim.can_address
    report = nodes.checked(station, patch, board, over=over)
    assert not nodes.failed(report)
    assert names(report, "skipped") == skipped | OF_FRAMES
    assert board.state.state == NodeState.FACTORY
    assert board.state.blocks == own, "the TEDS of the test is gone, its own are there"
    assert board.state.epoch == 6
    assert board.state.sequence == 3
    assert board.tim.can_address == home
    assert not station.keys.held(board.uuid)


class SlowLink(FaultyLink):
    """A link on which every exchange takes a while, as over the air on a busy machine."""

    seconds = 0.0

    def exchange(self, frame: bytes) -> bytes:
        self.board.seconds += self.seconds
        return super().exchange(frame)


@pytest.mark.parametrize("seconds", [1.1, 4.5])
def test_a_slow_link_accuses_no_node_of_losing_its_claim(
    station: Station, patch: pytest.MonkeyPatch, seconds: float
) -> None:
    board = nodes.made("measuring")
    link = SlowLink(board)
    link.seconds = seconds
    report = nodes.checked(station, patch, board, over="measuring", line=link)
    assert not nodes.failed(report)
    assert "operate-expires" in names(report, "passed")


def test_a_board_without_channel_teds_is_lent_some(station: Station, patch: pytest.MonkeyPatch) -> None:
    """With --factory too "operate-lease" was skipped, as a board in factory state has no datasheet."""
    board = nodes.made("measuring can blank")
    own = dict(board.state.blocks)
    report = nodes.checked(station, patch, board, over="measuring can")
    assert not nodes.failed(report)
    assert names(report, "passed") >= OF_CHANNELS
    assert board.state.blocks == own, "what was lent is gone"
    assert board.hardware.points == dict.fromkeys((4, 6), SAFE_VALUE), "no actuator was given another value"


def test_data_messages_that_were_on_their_way_accuse_no_slow_board(station: Station, patch: pytest.MonkeyPatch) -> None:
    """One that came before the reply to Stop was taken for one after it, one of run 1 for one of run 2."""

    class SlowBus(FaultyBus):
        def exchange(self, frame: bytes) -> bytes:
            if isinstance(self.end, MemoryServer):
                self.end.pass_time(0.3)
            return super().exchange(frame)

    board = nodes.made("measuring can")
    report = nodes.checked(station, patch, board, over="measuring can", line=SlowBus(board))
    streams = [check for check in report.checks if check.rule == "stream-messages"]
    assert [(check.result, check.detail) for check in streams if check.result != "passed"] == []


@pytest.mark.parametrize("over", ["measuring can", "measuring can blank"])
def test_without_factory_no_channel_teds_is_written_and_no_actuator_claimed(
    station: Station, patch: pytest.MonkeyPatch, over: str
) -> None:
    board = nodes.made(over)
    agreed(station, board)
    before = board.state
    report = nodes.checked(station, patch, board, over=over, factory=False)
    assert not nodes.failed(report)
    assert board.state == before
    (replay,) = [check for check in report.checks if check.rule == "drive-replay"]
    assert replay.result == "skipped"
    assert "--factory" in replay.detail
    assert ("trigger-token" in names(report, "passed")) == (over == "measuring can")


@pytest.mark.parametrize("over", ["nfc", "can", "measuring can blank"])
def test_a_skipped_rule_says_what_lets_it_run(station: Station, patch: pytest.MonkeyPatch, over: str) -> None:
    report = nodes.checked(station, patch, nodes.made(over), over=over, factory=False)
    words = re.compile(
        r"Connect the board's CAN|NFC reader|build its firmware with|--factory|never asked for more time"
    )
    assert [check for check in report.checks if check.result == "skipped" and not words.search(check.detail)] == []


def test_without_factory_a_factory_node_is_left_as_it_was(station: Station) -> None:
    board = Board()
    before = board.state
    report = checked(station, board, factory=False)
    assert board.state == before
    assert not names(report, "failed")
    tried = {rule.name for rule in RULES if rule.stage in (Stage.PLAIN, Stage.FACTORY)}
    assert names(report, "passed") == tried - OF_FRAMES - OF_CAN
    why = {check.rule: check.detail for check in report.checks}
    for rule in RULES:
        if rule.stage in (Stage.KEYED, Stage.SESSION, Stage.MEASURING):
            assert why[rule.name] == "The node has no key. Ask with --factory to give it one."
        elif rule.stage not in (Stage.PLAIN, Stage.FACTORY):
            assert why[rule.name] == "Changes the node's key. Ask with --factory."


def test_a_node_from_before_about_breaks_no_rule(station: Station) -> None:
    report = checked(station, bench.Board())
    assert not names(report, "failed")
    of_firmware = {rule.name for rule in RULES if rule.run.__module__ == firmware_rules.__name__}
    assert len(of_firmware) == 7
    assert of_firmware <= names(report, "skipped")


def agreed(station: Station, board: Board) -> None:
    """Leave the node keyed, as a run that was cut after its agreement leaves it."""

    def cut(_board: Board, octets: bytes, reference: faulty.Next) -> bytes:
        if board.state.key is not None:
            raise NodeSilentError("The power of the station went.")
        return reference(octets)

    report = checked(station, board, fault=cut)
    assert isinstance(report.lost, NodeSilentError)
    assert "power of the station" in report.lost.message
    assert board.state.state == NodeState.KEYED


def test_a_run_that_was_cut_leaves_a_node_of_ours(station: Station) -> None:
    board = Board()
    agreed(station, board)
    held = board.state.key
    report = checked(station, board, factory=False)
    assert board.state.key == held
    assert not names(report, "failed")
    in_sessions = {rule.name for rule in RULES if rule.stage in (Stage.KEYED, Stage.SESSION)}
    assert in_sessions - OF_STATIONS - NOTHING_READ_ONLY - {"keyed-untapped"} <= names(report, "passed")
    again = checked(station, board)
    assert not names(again, "failed")
    assert board.state.state == NodeState.FACTORY


def test_a_node_of_ours_can_be_reset_after_a_cut(station: Station) -> None:
    board = Board()
    agreed(station, board)
    node = talk(board)
    reset_node(station, node, identify(station, node))
    assert board.state.state == NodeState.FACTORY


def test_a_node_of_ours_that_cannot_be_reset_loses_no_report(station: Station) -> None:
    board = Board()
    agreed(station, board)
    board.flash.state = replace(board.state, node_key_signature=board.key.sign(b"for another UUID"))
    board.power_on()
    report = checked(station, board)
    assert names(report, "failed") == {"node-key", "reset"}
    assert {"factory-open", "commit"} <= names(report, "skipped")
    assert station.keys.held(board.uuid)


@pytest.mark.parametrize("factory", [False, True])
def test_a_node_of_another_owner_is_left_alone(station: Station, tmp_path: Path, factory: bool) -> None:
    rival, board = make_station(tmp_path / "rival", "rival"), Board()
    agreed(rival, board)
    before, link = board.state, FaultyLink(board)
    with pytest.raises(PolicyError, match="does not hold"):
        check_node(station, talk(board, link), factory=factory)
    assert board.state == before
    assert [frame[2:4] for frame in link.frames] == [b"\x80\x07"], "nothing but Identify was asked"
    rival.close()


# -- a node that keeps rules from being tried --------------------------------------------------------------------------


@pytest.mark.parametrize("via", ["nfc", "can"])
def test_a_reply_that_is_torn_each_time_is_the_nodes_fault(station: Station, via: str) -> None:
    """It was skipped, and a board that answered 0 octets over NFC passed; so did it on a bus, with exit code 0."""

    class TornLink(FaultyLink):
        def exchange(self, frame: bytes) -> bytes:
            if frame[2:4] == bytes([128, 99]):
                raise GarbledError("The node keeps asking for the same pieces.")
            return super().exchange(frame)

    report = check_node(station, talk(board := Board(), TornLink(board, via=via)))
    torn = {check.rule: check for check in report.checks if check.rule in ("unknown-command", "refusal-form")}
    assert {check.result for check in torn.values()} == {"failed"}
    assert len(torn) == 2
    assert names(report, "failed") <= {*torn, "max-message"}
    assert all(("very bad bus" in check.detail) == (via == "can") for check in torn.values())


def test_a_good_node_with_nfc_that_is_checked_over_its_bus_fails_no_rule(station: Station) -> None:
    """Its Request is for a tap: "confirm-newest" called that a broken rule."""

    class UntappedLink(FaultyLink):
        def reference(self, octets: bytes) -> bytes:
            return self.board.tim.handle(octets, link=self.name, tapped=False)

    report = check_node(station, talk(board := Board(), UntappedLink(board, via="can")), factory=True)
    assert not names(report, "failed")
    assert {"agreement", "confirm-newest"} <= names(report, "skipped")
    assert board.state.state == NodeState.FACTORY


def test_a_board_that_refuses_what_it_announces_fails_and_is_not_skipped(
    station: Station, patch: pytest.MonkeyPatch
) -> None:
    """It announced 1024, refused more than 512 on the link, and 15 rules were skipped with exit code 0."""

    class ShortLink(FaultyLink):
        def exchange(self, frame: bytes) -> bytes:
            if len(frame) > 512:
                raise MessageTooLongError("The node refuses it (flow control: overflow).")
            return super().exchange(frame)

    board = Board(max_message=1024)
    report = nodes.checked(station, patch, board, line=ShortLink(board))
    assert {"max-message", "commit", "write-drops"} <= names(report, "failed")
    (detail,) = [check.detail for check in report.checks if check.rule == "max-message"]
    assert "1024 octets are refused on the link; maxMessage is 1024" in detail
    assert not [check for check in report.checks if check.result == "skipped" and "refuse" in check.detail]


def test_a_board_that_is_busy_for_ever_fails_and_is_not_skipped(station: Station) -> None:
    def busy(_board: Board, octets: bytes, reference: faulty.Next) -> bytes:
        return refusal(Reason.BUSY).encode() if octets[2:4] == b"\x80\x0b" else reference(octets)

    report = checked(station, Board(), fault=busy)
    assert "list-ascending" in names(report, "failed")


@pytest.mark.parametrize("bend", [opening_so(tag_label=b"node open\0"), opening_so(swapped=True)])
def test_what_needs_a_session_is_skipped_if_none_opens(
    station: Station, patch: pytest.MonkeyPatch, bend: object
) -> None:
    """One slip failed 29 rules, each of which accused the key."""
    bend(patch)  # type: ignore[operator]
    report = nodes.checked(station, patch)
    assert names(report, "failed") == {"open"}
    needed = [check for check in report.checks if check.detail.startswith("Needs a session, and none opens: ")]
    assert len(needed) > 30
    assert {check.result for check in needed} == {"skipped"}


def test_a_node_of_ours_that_opens_no_session_is_not_taken_for_another_owners(
    station: Station, patch: pytest.MonkeyPatch
) -> None:
    board = Board()
    agreed(station, board)
    opening_so(tag_label=b"node open\0")(patch)
    report = nodes.checked(station, patch, board, factory=False)
    assert names(report, "failed") == {"open"}
    assert board.state.state == NodeState.KEYED


def test_a_board_that_opened_no_session_before_its_reset_is_tried_again_after_it(station: Station) -> None:
    """The rules after the reset were skipped for a fault that was over."""
    board, opens = Board(), list[bytes]()
    agreed(station, board)

    def slips(_board: bench.Board, octets: bytes, reference: faulty.Next) -> bytes:
        reply = reference(octets)
        if octets[2:4] == b"\x80\x03" and len(octets) > 6:
            opens.append(octets)
            if len(opens) == 2:  # the first one is not a rule's
                return reply[:-1] + bytes((reply[-1] ^ 1,))
        return reply

    report = checked(station, board, fault=slips)
    assert names(report, "failed") == {"open"}
    (skipped,) = [check for check in report.checks if check.rule == "sealed-tag"]
    assert skipped.detail.startswith("Needs a session, and none opens: ")
    assert {"agreement", "commit", "reset"} <= names(report, "passed")


# -- the test agreement in the open ------------------------------------------------------------------------------------


@pytest.mark.parametrize("over", ["nfc", "can"])
def test_explain_names_an_agreement_that_is_never_confirmed(
    station: Station, patch: pytest.MonkeyPatch, over: str
) -> None:
    board = nodes.made(over)
    before = board.state
    explanation = nodes.checked(station, patch, board, over=over, factory=False, explained=True).explained
    assert isinstance(explanation, ExplainedRequest)
    assert (len(explanation.transcript), len(explanation.okm), len(explanation.confirmation_key)) == (32, 48, 32)
    assert explanation.tag_due == explanation.reply[85:101]
    key, script = explanation.confirmation_key, explanation.transcript
    assert explanation.tag_due == hmac.digest(key, b"node" + script, "sha256")[:16]
    assert explanation.station_tag == hmac.digest(key, b"station" + script, "sha256")[:16]
    assert not explanation.problem
    assert board.state == before
    assert station.identity.point not in explanation.request, "a stranger asks, whose keys are for this one question"


def test_explain_shows_what_is_due_beside_what_came(station: Station, patch: pytest.MonkeyPatch) -> None:
    agreeing_so(label=b"TEDS1 transcript")(patch)
    explanation = nodes.checked(station, patch, factory=False, explained=True).explained
    assert isinstance(explanation, ExplainedRequest)
    assert explanation.slip == "transcript-label-without-00"
    assert explanation.tag_due != explanation.reply[85:101]
    assert "tagN is wrong" in explanation.problem


@pytest.mark.parametrize("over", ["nfc", "can"])
def test_explain_of_a_node_of_ours_never_prints_its_key(station: Station, patch: pytest.MonkeyPatch, over: str) -> None:
    board = Board()
    agreed(station, board)
    held = board.state.key
    explanation = nodes.checked(station, patch, board, over=over, factory=False, explained=True).explained
    assert isinstance(explanation, ExplainedRequest)
    assert board.state.key == held
    assert held is not None
    assert explanation.okm[:16] != held
    confirmed = security_command(Function.CONFIRM, explanation.station_tag).encode()
    reply = decode_reply(board.tim.handle(confirmed, link="nfc", tapped=True))
    assert reply.reason == Reason.WRONG_STATE, "what is printed can be confirmed by nobody"


# -- what runs twice, and stops ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("via", ["nfc", "can"])
def test_a_node_that_falls_silent_loses_no_report(station: Station, via: str) -> None:
    """Nothing was said of the rules before it, nor which command it was."""

    def hangs(board: Board, octets: bytes, reference: faulty.Next) -> bytes:
        if board.max_message == 0 or octets[2:] == bytes([1, 1, 0, 1, 128]):
            board.max_message = 0
            raise NodeSilentError("The node no longer answers.")
        return reference(octets)

    report = checked(station, Board(), fault=hangs, via=via)
    assert report.lost is not None
    assert "Query (1.1)" in report.lost.message
    assert {"list-ascending", "teds-checksum"} <= names(report, "passed")
    assert not names(report, "failed")
    (last,) = [check for check in report.checks if "Query (1.1)" in check.detail]
    assert last.rule in report.lost.message
    assert {"commit", "reset"} <= names(report, "skipped")


# -- what a report says ------------------------------------------------------------------------------------------------


def test_every_clause_is_a_section_of_the_page() -> None:
    for page in {rule.page for rule in RULES}:
        sections = set(re.findall(r"^## (.+)$", (DOCS / page).read_text(encoding="utf-8"), re.MULTILINE))
        assert {rule.section for rule in RULES if rule.page == page} <= sections
    assert len({rule.name for rule in RULES}) == len(RULES)
