"""Drafts that are dropped, and a datasheet of before that is written again."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from teds_provision.errors import NotFoundError, PolicyError
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import SEQUENCE_WINDOW
from teds_provision.provisioning import datasheet_history
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import BuildOrder, build
from teds_provision.provisioning.datasheet_history import (
    RestoredDatasheet,
    RestoreOrder,
    drop_draft,
    history_of,
    restore_datasheet,
)
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.visit import NodeVisit
from teds_provision.station.station import Station
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import Image
from tests.answers import Answers
from tests.bench import Board, talk

from .test_provision import ANGLE, run

FINGER = BuildOrder(profile="tactile-finger-sensor")


def last(station: Station, act: str) -> tuple[str, dict[str, Any]]:
    line = [entry for entry in station.audit_log.entries() if entry.act == act][-1]
    return line.outcome, line.detail


def test_a_draft_is_dropped_once_and_is_in_the_log(station: Station, board: Board) -> None:
    run(station, board)
    node = board.uuid.hex()
    assert drop_draft(station, node).draft is None
    with pytest.raises(IndexError):
        last(station, "draft")
    build(station, board.uuid, replace(ANGLE, name="another"))
    kept = station.datasheets.draft(board.uuid)
    assert kept is not None
    assert drop_draft(station, node, dry_run=True).draft == kept
    assert station.datasheets.draft(board.uuid) == kept, "a dry run drops nothing"
    assert drop_draft(station, node).draft == kept
    assert station.datasheets.draft(board.uuid) is None
    assert last(station, "draft") == ("dropped", {"stage": kept.stage, "profile": kept.profile})


def restored(
    station: Station, order: RestoreOrder, operator: Operator | None = None, links: LinkSettings | None = None
) -> RestoredDatasheet:
    """Restore a datasheet with nobody there to be asked, unless ``operator`` answers."""
    return restore_datasheet(station, links or LinkSettings(), order, SilentReporter(), operator=operator or Operator())


@pytest.fixture
def visits(station: Station, board: Board, monkeypatch: pytest.MonkeyPatch) -> list[dict[str, Any]]:
    """Return how each node was visited; each lies on the reader at once."""
    run(station, board)
    run(station, board, order=replace(ANGLE, name="second"))
    made: list[dict[str, Any]] = []

    @contextmanager
    def at_node(
        station: Station, links: LinkSettings, uuid: bytes, _reporter: object, **more: Any
    ) -> Iterator[NodeVisit]:
        made.append({"uuid": uuid, "via": links.via, **more})
        with talk(board) as node:
            yield NodeVisit(station, node, identify(station, node))

    monkeypatch.setattr(datasheet_history, "at_node", at_node)
    return made


def test_a_datasheet_of_before_is_signed_anew_under_the_next_number(
    station: Station, board: Board, visits: list[dict[str, Any]]
) -> None:
    node = board.uuid.hex()
    uuid, known = history_of(station, node)
    assert (uuid, [record.sequence for record in known]) == (board.uuid, [2, 1])
    plan = restore_datasheet(
        station, LinkSettings(), RestoreOrder(node, 1, dry_run=True), SilentReporter(), operator=Operator()
    )
    assert (plan.uuid, plan.sequence, plan.written, visits) == (board.uuid, 1, None, [])
    assert len(plan.changes) == 1
    with station.transaction():
        station.nodes.remember(board.uuid, profile="another-type")
    done = restore_datasheet(
        station, LinkSettings(nfc="usb", ble="hci0"), RestoreOrder(node, 1), SilentReporter(), operator=Operator()
    )
    assert visits == [{"uuid": board.uuid, "via": "ble", "unlock": "always", "writes": "write"}]
    assert (done.uuid, done.sequence, done.changes) == (board.uuid, 3, plan.changes)
    assert done.written is not None
    assert board.state.sequence == 3
    now = station.datasheets.datasheet(board.uuid)
    assert now is not None
    assert now.unsigned_blocks() == known[1].image.unsigned_blocks()
    assert done.warnings == plan.warnings == ()
    assert station.datasheets.draft(board.uuid) is None, "what was signed is written"
    assert last(station, "write")[1]["sequence"] == 3
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert (record.profile, known[1].profile) == (ANGLE.profile, ANGLE.profile)
    assert history_of(station, node)[1][0].profile == known[1].profile


def test_what_the_node_has_already_costs_no_number(
    station: Station, board: Board, visits: list[dict[str, Any]]
) -> None:
    done = restore_datasheet(
        station, LinkSettings(), RestoreOrder(board.uuid.hex(), 2), SilentReporter(), operator=Operator()
    )
    assert (done.sequence, done.changes, board.state.sequence) == (2, (), 2)


def test_a_draft_that_was_not_written_is_kept_and_named(
    station: Station, board: Board, visits: list[dict[str, Any]]
) -> None:
    node = board.uuid.hex()
    build(station, board.uuid, replace(ANGLE, name="third"))
    draft = station.datasheets.draft(board.uuid)
    plan = restore_datasheet(
        station, LinkSettings(), RestoreOrder(node, 1, dry_run=True), SilentReporter(), operator=Operator()
    )
    done = restored(station, RestoreOrder(node, 1))
    assert (done.sequence, board.state.sequence) == (3, 3)
    assert station.datasheets.draft(board.uuid) == draft
    (warning,) = plan.warnings
    assert done.warnings == (warning,)
    assert "draft (built as magnetic-angular-position-sensor)" in warning
    assert warning.endswith(f"teds-provision draft drop {node}")


def test_another_type_and_a_jump_of_the_sequence_need_a_word(
    station: Station, board: Board, visits: list[dict[str, Any]]
) -> None:
    node = board.uuid.hex()
    run(station, board, order=replace(FINGER, retype=True))
    with pytest.raises(WrongBoardError) as other:
        restored(station, RestoreOrder(node, 1))
    assert other.value.differences
    assert board.state.sequence == 3
    asked: list[bytes] = []
    answers = Answers(retype=lambda uuid, differences: asked.append(uuid))
    assert restored(station, RestoreOrder(node, 1), answers).sequence == 4
    assert asked == [board.uuid]
    done = restore_datasheet(
        station, LinkSettings(), RestoreOrder(node, 3, retyped=True), SilentReporter(), operator=Operator()
    )
    assert done.sequence == 5
    with station.transaction():
        station.nodes.remember(board.uuid, sequence=5 + SEQUENCE_WINDOW)
    with pytest.raises(PolicyError, match="far ahead"):
        restore_datasheet(
            station, LinkSettings(), RestoreOrder(node, 2, retyped=True), SilentReporter(), operator=Operator()
        )
    with pytest.raises(PolicyError, match="no person"):
        restore_datasheet(
            station, LinkSettings(), RestoreOrder(node, 2, jump=True), SilentReporter(), operator=Operator()
        )
    jumps = Answers(jump=lambda question: None)
    restore_datasheet(
        station, LinkSettings(), RestoreOrder(node, 2, jump=True, retyped=True), SilentReporter(), operator=jumps
    )
    assert board.state.sequence > 5 + SEQUENCE_WINDOW


def test_what_is_refused_before_any_node_is_waited_for(
    station: Station, board: Board, visits: list[dict[str, Any]]
) -> None:
    node = board.uuid.hex()
    with pytest.raises(NotFoundError) as unknown:
        restored(station, RestoreOrder(node, 7))
    assert unknown.value.message == f"Node {node} never had a datasheet with sequence 7."
    assert unknown.value.hint == "Known are: 2, 1."
    with station.transaction():
        station.pins.remove(board.uuid)
    with pytest.raises(PolicyError):
        restore_datasheet(
            station, LinkSettings(), RestoreOrder(node, 1, dry_run=True), SilentReporter(), operator=Operator()
        )
    assert visits == []


@pytest.mark.parametrize(
    ("profile", "current", "asked"),
    [
        (ANGLE.profile, FINGER, True),
        (FINGER.profile, FINGER, False),
        ("another-type", ANGLE, False),
        (None, FINGER, True),
    ],
    ids=["another type", "it differs, and is remembered as that type", "it is alike, and not remembered", "no type"],
)
def test_only_a_board_that_differs_and_is_not_remembered_as_that_type_is_asked_about(
    station: Station,
    board: Board,
    visits: list[dict[str, Any]],
    monkeypatch: pytest.MonkeyPatch,
    profile: str | None,
    current: BuildOrder,
    asked: bool,
) -> None:
    """The type that the node has is not erased by a datasheet of no type."""
    run(station, board, order=replace(current, retype=True))
    first = history_of(station, board.uuid.hex())[1][-1]
    monkeypatch.setattr(datasheet_history, "_record_of", lambda *_: replace(first, profile=profile))
    questions: list[bytes] = []
    answers = Answers(retype=lambda uuid, _differences: questions.append(uuid))
    restored(station, RestoreOrder(board.uuid.hex(), 1), answers)
    assert questions == ([board.uuid] if asked else [])
    record = station.nodes.get(board.uuid)
    assert record is not None
    assert record.profile == (profile or current.profile)


def test_a_datasheet_of_before_passes_the_guard_as_it_stands_on_the_node(
    station: Station, board: Board, visits: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What nothing can replace on the node stays in it, in place of what the datasheet has there."""
    fixed, other = (frame(bytes.fromhex(f"0304050d01010a01010b04000000{last}")) for last in ("01", "02"))
    first = history_of(station, board.uuid.hex())[1][-1]
    brought = replace(first, image=replace(first.image, blocks={**first.image.blocks, (0, 13): other}))
    monkeypatch.setattr(datasheet_history, "_record_of", lambda *_: brought)
    board.flash.state = replace(
        board.state, blocks={**board.state.blocks, (0, 13): fixed}, read_only=frozenset({(0, 13)})
    )
    board.power_on()
    looked: list[tuple[bytes, bytes, str]] = []

    def guard(_station: Station, image: Image, present: Image, why: str) -> None:
        looked.append((image.blocks[0, 13], present.blocks[0, 13], why))
        raise PolicyError("It is harmful.")

    monkeypatch.setattr(datasheet_history, "guard", guard)
    with pytest.raises(PolicyError, match="harmful"):
        restored(station, RestoreOrder(board.uuid.hex(), 1))
    assert looked == [(fixed, fixed, "datasheet of sequence 1 brought back")]
    assert board.state.sequence == 2


def test_the_plan_for_a_node_whose_datasheet_is_unknown_lists_every_teds(
    station: Station, board: Board, visits: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: None)
    plan = restored(station, RestoreOrder(board.uuid.hex(), 1, dry_run=True))
    assert len(plan.changes) >= len(history_of(station, board.uuid.hex())[1][-1].image.unsigned_blocks()) > 1
    monkeypatch.setattr(type(station.datasheets), "history", lambda *_: [])
    with pytest.raises(NotFoundError) as unknown:
        restored(station, RestoreOrder(board.uuid.hex(), 1, dry_run=True))
    assert unknown.value.hint == "Known are: none."


def test_who_let_the_node_go_and_who_is_asked_about_its_battery_go_to_the_steps(
    station: Station, board: Board, visits: list[dict[str, Any]], monkeypatch: pytest.MonkeyPatch
) -> None:
    given: list[Any] = []
    operator = Operator()

    def write(*_: object, low: object, jump: bool, **__: object) -> Any:
        given.append((low, jump))
        raise PolicyError("far enough")

    monkeypatch.setattr(datasheet_history, "require_not_measured", lambda *_, released: given.append(released))
    monkeypatch.setattr(datasheet_history, "write", write)
    with pytest.raises(PolicyError, match="far enough"):
        restored(station, RestoreOrder(board.uuid.hex(), 1), operator)
    assert given == [False, (operator.low_battery, False)]
