"""``node check``: the reference node keeps every rule, and each fault is found by the rule that names it."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.check.rule import RULES, Stage
from teds_provision.check.run import Report, check_node
from teds_provision.errors import Garbled, NodeSilent, PolicyRefused
from teds_provision.protocol.commit import verified_commit
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.tim import teds_access
from teds_provision.station.station import Station
from teds_provision.steps.identify import identify
from teds_provision.steps.reset import reset_node

from ..bench import Board, make_station, talk
from ..protocol.desk import META, NAME
from . import faulty
from .faulty import Fault, FaultyLink

PAGE = Path(__file__).parents[2] / "docs" / "profile.md"


def checked(station: Station, board: Board, *, factory: bool = True, **link: object) -> Report:
    return check_node(station, talk(board, FaultyLink(board, **link)), factory=factory)  # type: ignore[arg-type]


OF_LINKS = {"can-padding", "can-flow-control", "can-form", "nfc-wait-time", "nfc-wtx"}
"""Rules that hear frames: a link in memory has none. ``test_link_rules`` tries them."""


def names(report: Report, result: str) -> set[str]:
    return {check.rule for check in report.checks if check.result == result}


# -- a good node -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("via", "skipped"), [("nfc", {"keyed-untapped"}), ("can", {"confirm-elsewhere"})])
def test_the_reference_node_keeps_every_rule(station: Station, via: str, skipped: set[str]) -> None:
    board = Board()
    board.flash.state = replace(board.state, blocks={(0, 1): META, (1, 12): NAME})
    board.power_on()
    report = checked(station, board, via=via)
    assert not [check for check in report.checks if check.result == "failed"]
    assert names(report, "skipped") == skipped | OF_LINKS
    assert board.state.state == NodeState.FACTORY
    assert board.state.blocks == {(0, 1): META, (1, 12): NAME}, "the TEDS of the test is gone, its own are there"
    assert not station.keys.held(board.uuid)


def test_without_factory_a_factory_node_is_left_as_it_was(station: Station) -> None:
    board = Board()
    before = board.state
    report = checked(station, board, factory=False)
    assert board.state == before
    assert not names(report, "failed")
    tried = {each.name for each in RULES if each.stage in (Stage.PLAIN, Stage.FACTORY)}
    assert names(report, "passed") == tried - OF_LINKS


def agreed(station: Station, board: Board) -> None:
    """Leave the node keyed, as a run that was cut after its agreement leaves it."""

    def cut(_board: Board, octets: bytes, reference: faulty.Next) -> bytes:
        if board.state.key is not None:
            raise NodeSilent("The power of the station went.")
        return reference(octets)

    report = checked(station, board, fault=cut)
    assert isinstance(report.lost, NodeSilent)
    assert "power of the station" in report.lost.message
    assert board.state.state == NodeState.KEYED


def test_a_run_that_was_cut_leaves_a_node_of_ours(station: Station) -> None:
    board = Board()
    agreed(station, board)
    held = board.state.key
    report = checked(station, board, factory=False)
    assert board.state.key == held
    assert not names(report, "failed")
    assert {each.name for each in RULES if each.stage == Stage.SESSION} <= names(report, "passed")
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
    assert names(report, "failed") == {"node-key"}
    assert {"factory-open", "commit", "reset"} <= names(report, "skipped")
    assert station.keys.held(board.uuid)


@pytest.mark.parametrize("factory", [False, True])
def test_a_node_of_another_owner_is_left_alone(station: Station, tmp_path: Path, factory: bool) -> None:
    rival, board = make_station(tmp_path / "rival", "rival"), Board()
    agreed(rival, board)
    before, link = board.state, FaultyLink(board)
    with pytest.raises(PolicyRefused, match="does not hold"):
        check_node(station, talk(board, link), factory=factory)
    assert board.state == before
    assert [frame[2:4] for frame in link.frames] == [b"\x80\x07"], "nothing but Identify was asked"
    rival.close()


# -- faults ------------------------------------------------------------------------------------------------------------

FAULTS: dict[str, tuple[Fault, str]] = {
    "an unknown command is answered by 0 octets": (faulty.unknown_is_silent, "unknown-command"),
    "a refusal of two octets": (faulty.long_refusal, "refusal-form"),
    "lengths before state": (faulty.length_before_state, "state-before-length"),
    "the length in the header is ignored": (faulty.header_length_ignored, "frame-length"),
    "a high s in Prove": (faulty.high_s, "prove-low-s"),
    "a challenge of any length": (faulty.any_challenge, "prove-length"),
    "Prove under another key": (faulty.proof_of_another, "prove"),
    "List does not ascend": (faulty.list_twice, "list-ascending"),
    "Query of an absent TEDS without NotAvail": (faulty.absent_is_available, "query-absent"),
    "the checksum of a TEDS": (faulty.wrong_checksum, "teds-checksum"),
    "a Security TEDS that is not canonical": (faulty.not_canonical, "security-canonical"),
    "the suite of the draft": (faulty.other_suite, "security-canonical"),
    "Read past the end is refused": (faulty.end_refused, "read-end"),
    "Write outside a session": (faulty.write_anywhere, "write-needs-session"),
    "Open with a wrong mac": (faulty.any_mac, "open-checks"),
    "a second sealed reply for a counter": (faulty.any_counter, "sealed-counter"),
    "Close ends nothing": (faulty.close_is_ignored, "close"),
    "what pends survives a wrong tagS": (faulty.keeps_pending, "confirm-checks"),
    "the CA of another owner": (faulty.any_ca, "first-owner-wins"),
    "an epoch that stands still": (faulty.epoch_stands_still, "agreement-epoch"),
    "an epoch that goes back with Reset": (faulty.reset_forgets_epoch, "reset"),
}


@pytest.mark.parametrize("what", FAULTS)
def test_a_fault_is_found_by_its_rule(station: Station, what: str) -> None:
    fault, rule = FAULTS[what]
    board = Board()
    board.flash.state = replace(board.state, epoch=4)
    board.power_on()
    report = checked(station, board, fault=fault)
    assert rule in names(report, "failed"), [check for check in report.checks if check.result != "passed"]


def test_a_wrong_field_102_is_found(station: Station) -> None:
    board = Board()
    board.flash.state = replace(board.state, node_key_signature=board.key.sign(b"for another UUID"))
    board.power_on()
    assert "node-key" in names(checked(station, board), "failed")


def test_a_request_without_a_tap_is_found(station: Station) -> None:
    assert names(checked(station, Board(), via="can", tapped_when_keyed=True), "failed") == {"keyed-untapped"}


def test_a_repetition_that_is_run_again_is_found(station: Station) -> None:
    assert names(checked(station, Board(), runs_again=True), "failed") == {"repetition"}


def test_a_commit_that_takes_an_old_sequence_is_found(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    def forgetful(flash, staged, verify):  # type: ignore[no-untyped-def]
        return verified_commit(replace(flash, sequence=flash.sequence - 1), staged, verify)

    monkeypatch.setattr(teds_access, "verified_commit", forgetful)
    assert names(checked(station, Board()), "failed") == {"commit-sequence"}


@pytest.mark.parametrize(("via", "result"), [("nfc", "failed"), ("can", "skipped")])
def test_a_reply_that_is_torn_each_time_is_the_nodes_fault_at_a_reader(station: Station, via: str, result: str) -> None:
    """It was skipped, and a board that answered 0 octets over NFC passed; on a bus single frames are lost."""

    class Torn(FaultyLink):
        def exchange(self, frame: bytes) -> bytes:
            if frame[2:4] == bytes([128, 99]):
                raise Garbled("The node asks for the same pieces again and again.")
            return super().exchange(frame)

    report = check_node(station, talk(board := Board(), Torn(board, via=via)))
    torn = {check.rule: check for check in report.checks if check.rule in ("unknown-command", "refusal-form")}
    assert {check.result for check in torn.values()} == {result}
    assert len(torn) == 2
    assert names(report, "failed") <= set(torn)


@pytest.mark.parametrize("via", ["nfc", "can"])
def test_a_node_that_falls_silent_loses_no_report(station: Station, via: str) -> None:
    """Nothing was said of the rules before it, nor which command it was."""

    def hangs(board: Board, octets: bytes, reference: faulty.Next) -> bytes:
        if board.max_message == 0 or octets[2:4] == bytes([1, 1]):
            board.max_message = 0
            raise NodeSilent("The node does not answer any more.")
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
    sections = set(re.findall(r"^## (.+)$", PAGE.read_text(encoding="utf-8"), re.MULTILINE))
    assert {each.section for each in RULES} <= sections
    assert len({each.name for each in RULES}) == len(RULES)
