"""How many exchanges a provisioning takes, which ones, and that none of those that are left out hid a change."""

from __future__ import annotations

import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from teds_provision.errors import KeyMismatchError, NotAuthenticError, VaultLockedError
from teds_provision.links import LinkSettings
from teds_provision.node.hardware.board import Board as Hardware
from teds_provision.node.node_template import create
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.provisioning import batch
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.batch import ProvisionRequest
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import examine, identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.provisioning.teds_read import take_snapshot
from teds_provision.station.station import Station
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.sheet import Sheet
from tests.answers import Answers
from tests.bench import Board, MemoryLink, make_station, on_reader, talk
from tests.measure.rig import CALIBRATIONS
from tests.provisioning.exchanges import AGAIN, AGREED, CLAIMED, FIRST, IDENTIFIED, OPENED, asked, in_order

ANGLE = "magnetic-angular-position-sensor"


def run(station: Station, node: Conversation, order: BuildOrder) -> ProvisionResult:
    with node:
        return provision(station, node, order, operator=Answers(), reporter=SilentReporter())


def test_each_exchange_with_a_board_that_has_no_teds_is_there_for_a_reason(station: Station, board: Board) -> None:
    with asked() as words:
        run(station, talk(board), BuildOrder(ANGLE))
        assert in_order(words) == [*FIRST, "[operation]", "[close]"], "it does not measure: one question shows that"
        for start in ("the same start", "another start"):
            words.clear()
            run(station, talk(board), BuildOrder(ANGLE))
            assert in_order(words) == [*AGAIN, "[operation]", "[close]"], start
            board.power_on()


def test_the_sequence_is_on_the_disk_before_the_signature_that_has_it_leaves(
    station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After a loss of power the same sequence would be given a second time, to another datasheet."""
    flush = station.flush
    with asked() as words:

        def noted() -> None:
            flush()
            words.append("on the disk")

        monkeypatch.setattr(station, "flush", noted)
        run(station, talk(board), BuildOrder(ANGLE))
        assert words[words.index("[write 128]") - 1] == "on the disk"


def test_each_exchange_with_a_board_that_brings_a_datasheet_and_measures_is_there_for_a_reason(
    station: Station, tmp_path: Path
) -> None:
    (tmp_path / "curve.csv").write_text(CALIBRATIONS[ANGLE])
    create(tmp_path / "node", profile=ANGLE)
    board = VirtualNode(
        tmp_path / "node", board=lambda file: Hardware(Sheet.from_image(Image(file.load().uuid, file.hardware)))
    )
    order = BuildOrder(ANGLE, calibration=tmp_path / "curve.csv")
    with asked() as words:
        run(station, Conversation(on_reader(board), notice=lambda _notice: None), order)
        brought = len(board.tim.flash.blocks) - 2  # the calibration and the Security TEDS are ours
        shown = ["list", "read"]  # of what type it claims to be
        written, end = words.count("[write]"), [*["[read]"] * (brought + 1), "[read 128]", "[prove]", *CLAIMED]
        assert 2 <= written <= brought + 1
        writes = [*["[write]"] * written, "[write 128]", "[update]"]
        first = [*IDENTIFIED, *shown, *AGREED, "[list]", *["[read]"] * brought, *writes]
        assert in_order(words) == [*first, *end, "[close]"], "nothing is asked about TEDS that the new datasheet has"
        words.clear()
        run(station, Conversation(on_reader(board), notice=lambda _notice: None), order)
        assert in_order(words) == ["prove", *OPENED, "[list]", *end, "[close]"]


# -- what is not read again: the key of a node that was read in a session before ---------------------------------------


def test_a_board_that_was_swapped_is_noticed_although_its_key_is_not_read_first(station: Station, board: Board) -> None:
    run(station, talk(board), BuildOrder(ANGLE))
    other = Board(key=SoftwareKey.generate())
    run(station_of(station, "other"), talk(other), BuildOrder(ANGLE))
    with asked() as words, pytest.raises(KeyMismatchError):
        run(station, talk(other), BuildOrder(ANGLE))
    assert words[:3] == ["prove", "read 128", "prove"]


def test_a_board_that_cannot_prove_the_key_it_shows_is_not_recalled(station: Station, board: Board) -> None:
    run(station, talk(board), BuildOrder(ANGLE))
    board.tim.key = SoftwareKey.generate()
    with talk(board) as node, pytest.raises(NotAuthenticError):
        examine(station, node, recall=True)


def test_a_key_that_is_agreed_on_again_without_a_session_is_agreed_over_the_present_teds(
    station: Station, board: Board
) -> None:
    """Its transcript has the Security TEDS that the node has now, which another holder of its key may have written."""
    run(station, talk(board), BuildOrder(ANGLE))
    old = board.state.blocks
    run(station, talk(board), replace(BuildOrder(ANGLE), name="boom"))
    assert board.state.blocks[SECURITY] != old[SECURITY]
    last = station.datasheets.datasheet(board.uuid)
    assert last is not None
    row = station.datasheets.reading(board.uuid)
    assert row is not None
    before = Image(board.uuid, {**old})
    station.datasheets.keep_reading(row, before)  # as if the newer datasheet were another holder's
    board.flash.state = replace(board.state, key=bytes(16))
    board.power_on()
    with asked() as words, talk(board) as node:
        who = identify(station, node, recall=True)
        assert who.recalled
        agree(station, node, who, rotate=True)
    assert words.count("request") == 1
    assert words.index("read 128") < words.index("request")


def station_of(like: Station, name: str) -> Station:
    """Another station."""
    return make_station(like.home.parent / name)


# -- what is not listed again: the TEDS after a commit that put in all that was there ----------------------------------


@dataclass
class ChangingLink(MemoryLink):
    """A link on which ``change`` happens to the board as soon as its reply to Update has left."""

    change: Callable[[Board], object] = lambda board: None

    def exchange(self, frame: bytes) -> bytes:
        before = self.board.state.sequence
        reply = super().exchange(frame)
        if self.board.state.sequence != before:
            self.change(self.board)
        return reply


def put(board: Board, block: tuple[int, int], teds: bytes | None) -> None:
    """Change one TEDS in the board's flash; None takes it away."""
    blocks = {key: octets for key, octets in board.state.blocks.items() if key != block}
    board.flash.state = replace(board.state, blocks=blocks if teds is None else {**blocks, block: teds})
    board.tim._flash = board.state


PHY = (0, 13), frame(bytes.fromhex("0304050d01010a01010b0400000001"))
"""A TEDS that no profile has."""


@pytest.mark.parametrize("block", [(0, 1), (0, 12), (1, 3), (1, 12), SECURITY])
def test_a_board_that_has_something_else_after_the_commit_is_noticed(
    station: Station, board: Board, block: tuple[int, int]
) -> None:
    def change(board: Board) -> None:
        put(board, block, frame(unframe(board.state.blocks[block]) + b"\xc8\x01\x07"))

    link = ChangingLink(board, change=change)
    with pytest.raises(NotAuthenticError, match=r"reads back differently|not authentic"):
        run(station, talk(board, link), BuildOrder(ANGLE))
    assert run(station, talk(board), BuildOrder(ANGLE)).verified.verdict == "authentic"


def test_a_board_that_lacks_a_teds_after_the_commit_is_noticed(station: Station, board: Board) -> None:
    link = ChangingLink(board, change=lambda board: put(board, (1, 12), None))
    with pytest.raises(NotAuthenticError, match="reads back differently"):
        run(station, talk(board, link), BuildOrder(ANGLE))


def test_a_board_that_had_more_teds_than_it_gets_is_listed_after_the_commit(station: Station, board: Board) -> None:
    """The commit takes away what is not listed; whether it did, the node is asked."""
    run(station, talk(board), BuildOrder(ANGLE))
    put(board, *PHY)
    with asked() as words:
        assert run(station, talk(board), BuildOrder(ANGLE)).verified.verdict == "authentic"
    assert words.count("[list]") == 2
    assert PHY[0] not in board.state.blocks


# -- what is not asked: whether a TEDS can be replaced that the new datasheet has --------------------------------------


def test_a_read_only_teds_beside_the_datasheet_is_asked_about_once_and_stays(station: Station, board: Board) -> None:
    extra, teds = PHY
    put(board, extra, teds)
    board.flash.state = replace(board.state, read_only=frozenset({extra}))
    board.power_on()
    with asked() as words:
        done = run(station, talk(board), BuildOrder(ANGLE))
    assert words.count("[query]") == 1
    assert done.verified.verdict == "authentic"
    assert done.image.blocks[extra] == teds
    with talk(board) as node:
        found = take_snapshot(node)
        assert [block for block in found.image if found.is_read_only(block)] == [extra]


# -- what is not loaded in the middle of a conversation ----------------------------------------------------------------


def test_what_a_reading_needs_is_loaded_while_the_vault_is_opened(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """numpy was loaded after the claim, for 80 ms: as long as all of a provisioning over CAN FD."""
    assert "numpy" in batch._AT_THE_BOARD
    monkeypatch.delitem(sys.modules, "colorsys", raising=False)
    monkeypatch.setattr(batch, "_AT_THE_BOARD", ("no_such_module", "colorsys"))
    threads: list[threading.Thread] = []
    plain = batch._load_ahead
    monkeypatch.setattr(batch, "_load_ahead", lambda: threads.append(plain()))

    def unlock(_uuid: bytes | None = None) -> None:
        assert len(threads) == 1
        threads[0].join(60)
        assert "colorsys" in sys.modules
        raise VaultLockedError("It was asked for.")

    monkeypatch.setattr(station, "unlock", unlock)
    links = LinkSettings("nfc", nfc="udp:127.0.0.1:1", timeout=1.0)
    for request in (ProvisionRequest(order=BuildOrder(ANGLE)), ProvisionRequest(order=BuildOrder(ANGLE), watch=True)):
        threads.clear()
        boards = batch.BatchRun(station, links, request, SilentReporter())
        with pytest.raises(VaultLockedError):
            list(boards.many(AcceptingOperator())) if request.watch else boards.one(AcceptingOperator())
