"""Which boards a batch is for, when it ends, and what it tells: each clause of docs/batch.md with its other case."""

from __future__ import annotations

import getpass
import threading
from collections.abc import Generator, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    AddressConflictError,
    NodeSilentError,
    NoNodeError,
    NotAuthenticError,
    PolicyError,
    TedsProvisionError,
    UsageError,
    VaultLockedError,
)
from teds_provision.links import Contact, LinkSettings
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning import batch
from teds_provision.provisioning.batch import BatchRun, ProvisionRequest
from teds_provision.provisioning.batch_sheet import (
    BoardResult,
    Progress,
    ReportHead,
    check_report,
    read_sheet,
    write_report,
)
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import BuildOrder, compose, named_for
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import Reporter, SilentReporter, StepResult
from teds_provision.shapes.verdict import Check, Verification
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord, WhitelistEntry
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from tests.bench import Board, contact
from tests.pace import PATIENCE

KEY = "ab" * 32
CELL = BuildOrder(profile="load-cell")


def uuid_of(number: int) -> bytes:
    return bytes([number]) * 10


def answer(number: int, *, address: int | None = None, state: NodeState | None = None) -> Contact:
    found = contact(Board(uuid=uuid_of(number)))
    identity = replace(found.identity, state=state) if state is not None else found.identity
    return replace(found, identity=identity, address=address)


def sheet(folder: Path, text: str) -> Path:
    file = folder / "boards.csv"
    file.write_text(text)
    return file


def run_of(station: Station, **request: Any) -> BatchRun:
    request.setdefault("order", CELL)
    return BatchRun(station, LinkSettings("can"), ProvisionRequest(**request), SilentReporter())


def of_sheet(station: Station, folder: Path, text: str, **request: Any) -> BatchRun:
    return run_of(station, sheet=sheet(folder, text), **request)


# -- which boards are meant --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("verdict", "state", "image", "meant"),
    [
        ("authentic", NodeState.PROVISIONED, {(1, 5): b"x"}, False),
        ("authentic", NodeState.PROVISIONED, {}, True),  # its type requires a calibration
        ("authentic", NodeState.KEYED, {(1, 5): b"x"}, True),
        ("authentic", NodeState.FACTORY, {(1, 5): b"x"}, True),
        ("unsigned", NodeState.PROVISIONED, {(1, 5): b"x"}, True),
        (None, NodeState.PROVISIONED, {(1, 5): b"x"}, True),
    ],
)
def test_a_whitelisted_board_of_the_bus_is_left_out_only_if_nothing_is_left_to_do_for_it(
    station: Station, monkeypatch: pytest.MonkeyPatch, verdict: str | None, state: NodeState, image: Any, meant: bool
) -> None:
    station.pins.put(WhitelistEntry(uuid_of(1), assurance="tap"))
    judged = None if verdict is None else SimpleNamespace(verified=SimpleNamespace(verdict=verdict))
    monkeypatch.setattr(batch, "verdict_of", lambda *_: judged)
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda _own, uuid: Image(uuid, image))
    assert run_of(station, whole_bus=True)._is_meant(answer(1, state=state)) == meant


def test_of_a_sheet_every_board_that_a_row_may_be_of_is_met_and_a_finished_one_is_passed_over_in_silence(
    station: Station, tmp_path: Path
) -> None:
    """A row that names a key alone may be of any board of the bus: only the board itself shows its key."""
    text = f"uuid,fingerprint,name\n{uuid_of(1).hex()},,a\n{uuid_of(2).hex()},,b\n,{KEY},c\n"
    run = of_sheet(station, tmp_path, text, whole_bus=True)
    progress = run.progress
    assert progress is not None
    notices: list[str] = []
    station.notice = notices.append
    assert [run._is_meant(answer(number)) for number in (1, 2, 9)] == [True, True, True]
    for row, uuid in zip(progress.sheet.rows, (uuid_of(1), uuid_of(2), uuid_of(3)), strict=True):
        progress.assign_row(row, uuid)
    progress.rows[1].result = progress.rows[3].result = "passed"
    progress.rows[2].result = "failed"
    assert [run._is_meant(answer(number)) for number in (1, 2, 3)] == [False, True, False]
    assert notices == []
    assert not run._is_meant(answer(9))
    assert notices == [f"Skipped: node {uuid_of(9).hex()} is not in the sheet."]


@pytest.mark.parametrize(("listed", "with_sheet", "early"), [(True, False, True), (False, False, False),
                                                             (False, True, True)])  # fmt: skip
def test_a_board_that_may_be_meant_is_read_while_the_others_are_asked(
    station: Station, tmp_path: Path, listed: bool, with_sheet: bool, early: bool
) -> None:
    if listed:
        station.pins.put(WhitelistEntry(uuid_of(1), assurance="tap"))
    more = {"sheet": sheet(tmp_path, f"uuid\n{uuid_of(1).hex()}\n")} if with_sheet else {}
    assert run_of(station, whole_bus=True, **more)._may_be_meant(answer(1)) == early


def test_nothing_done_is_not_all_done_if_no_board_of_the_bus_is_ours(station: Station, tmp_path: Path) -> None:
    run = run_of(station, whole_bus=True)
    strangers = [answer(number) for number in range(1, 8)]
    with pytest.raises(PolicyError) as refused:
        run._require_known(strangers)
    five = ", ".join(uuid_of(number).hex() for number in range(1, 6))
    assert refused.value.message == f"7 nodes answered, but none is on the whitelist: {five}, …."
    assert refused.value.hint == f"Add them (teds-provision whitelist add {uuid_of(1).hex()}), or list them in a" + (
        " sheet: --batch FILE."
    )
    with pytest.raises(PolicyError, match=rf"^1 node answered, but none is on the whitelist: {uuid_of(1).hex()}\.$"):
        run._require_known(strangers[:1])
    of_sheet(station, tmp_path, f"uuid\n{uuid_of(9).hex()}\n", whole_bus=True)._require_known(strangers)
    station.pins.put(WhitelistEntry(uuid_of(7), assurance="tap"))
    run._require_known(strangers)


# -- a board whose key was imported ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "left"),
    [
        ({}, True),
        ({"read": True}, False),
        ({"state": NodeState.KEYED}, False),
        ({"held": False}, False),
        ({"order": CELL}, False),
        ({"order": BuildOrder(name="cell {n}")}, False),
        ({"verdict": "unsigned"}, False),
        ({"verdict": "not authentic"}, False),
        ({"session": PolicyError("no key here")}, False),
        ({"session": NotAuthenticError("a clone")}, False),
    ],
)
def test_only_an_authentic_board_that_another_station_finished_is_left_as_it_is(
    station: Station, monkeypatch: pytest.MonkeyPatch, change: dict[str, Any], left: bool
) -> None:
    facts = {"read": False, "state": NodeState.PROVISIONED, "held": True, "order": BuildOrder(), "session": None}
    facts |= {"verdict": "authentic"} | change
    run = run_of(station, whole_bus=True, order=facts["order"])
    monkeypatch.setattr(type(station.datasheets), "reading", lambda *_: object() if facts["read"] else None)
    monkeypatch.setattr(type(station.keys), "held", lambda *_: [object()] if facts["held"] else [])

    def session(*_: object) -> None:
        if isinstance(facts["session"], Exception):
            raise facts["session"]

    looked = SimpleNamespace(
        verified=SimpleNamespace(verdict=facts["verdict"]), image=Image(uuid_of(1), {})
    )  # its type requires no calibration
    monkeypatch.setattr(batch, "require_session", session)
    monkeypatch.setattr(batch, "verify_in_session", lambda *_, **__: looked)
    notices: list[str] = []
    station.notice = notices.append
    node: Any = SimpleNamespace(uuid=uuid_of(1), identity=answer(1, state=facts["state"]).identity)
    assert run._was_finished_elsewhere(node) == left
    said = f"Nothing to do: node {uuid_of(1).hex()} is authentic, as its datasheet was signed elsewhere."
    assert notices == ([said] if left else [])


def test_a_board_that_another_station_finished_without_the_calibration_of_its_type_is_not_left(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.nodes.remember(uuid_of(1), profile="load-cell")
    monkeypatch.setattr(type(station.keys), "held", lambda *_: [object()])
    looked = SimpleNamespace(verified=SimpleNamespace(verdict="authentic"), image=Image(uuid_of(1), {}))
    monkeypatch.setattr(batch, "require_session", lambda *_: None)
    monkeypatch.setattr(batch, "verify_in_session", lambda *_, **__: looked)
    node: Any = SimpleNamespace(uuid=uuid_of(1), identity=answer(1, state=NodeState.PROVISIONED).identity)
    run = run_of(station, whole_bus=True, order=BuildOrder())
    assert not run._was_finished_elsewhere(node)
    looked.image = Image(uuid_of(1), {(1, 5): b"x"})
    assert run._was_finished_elsewhere(node)


# -- when it ends ------------------------------------------------------------------------------------------------------


def taps(monkeypatch: pytest.MonkeyPatch, run: BatchRun, *boards: tuple[int, str | None]) -> list[tuple[int, str]]:
    """Tap these boards, each with its error, until the run stops; the row and result of each that was worked on."""

    def watch_nodes(_links: Any, work: Any, _reporter: Any, stop: Any) -> Iterator[Any]:
        for number, error in boards:
            if stop.is_set():
                return
            who: Any = SimpleNamespace(uuid=uuid_of(number), fingerprint=f"{number:02d}" * 32)
            failure: Any = None
            try:
                run._for(who)
                failure = NodeSilentError(error) if error else None
            except PolicyError as refused:
                failure = refused
            yield SimpleNamespace(uuid=who.uuid, seconds=1.0, result=None, error=failure, place="nfc")

    monkeypatch.setattr(batch, "watch_nodes", watch_nodes)
    monkeypatch.setattr(batch, "_load_ahead", lambda: None)
    return [(board.row or 0, board.result) for board in run.many(Operator())]


@pytest.mark.parametrize(
    ("watch", "ended"),
    [
        (False, [(1, "failed"), (2, "passed")]),  # each row is tried once
        (True, [(1, "failed"), (2, "passed"), (1, "passed")]),  # all rows have passed
    ],
)
def test_a_sheet_ends_after_its_last_row_and_with_watch_once_all_have_passed(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, watch: bool, ended: list[tuple[int, str]]
) -> None:
    run = of_sheet(station, tmp_path, "name\na\nb\n", watch=watch)
    renewed: list[int] = []
    monkeypatch.setattr(run.stop, "renew", lambda: renewed.append(run.ended))
    assert taps(monkeypatch, run, (1, "It was pulled."), (2, None), (1, None), (4, None)) == ended
    assert (run.passed, len(run), run.ended) == (sum(result == "passed" for _, result in ended), 2, len(ended))
    assert len(renewed) == len(ended), "after each board the next one has the whole time"


def test_a_row_that_another_reader_works_on_is_not_given_to_a_second_board(station: Station, tmp_path: Path) -> None:
    run = of_sheet(station, tmp_path, "name\na\nb\n")
    for number, row in ((1, 1), (2, 2), (1, 1)):
        run._for(SimpleNamespace(uuid=uuid_of(number), fingerprint=KEY))  # type: ignore[arg-type]
        assert run._rows[uuid_of(number)].number == row
    with pytest.raises(PolicyError) as refused:
        run._for(SimpleNamespace(uuid=uuid_of(3), fingerprint=KEY))  # type: ignore[arg-type]
    assert (refused.value.message, refused.value.hint) == (
        f"The sheet has no row left for board {uuid_of(3).hex()}.", "Set it aside.",
    )  # fmt: skip


@pytest.mark.parametrize(("pin", "good"), [(KEY, True), (KEY[:32], True), (KEY[:32] + "cd" * 16, False)])
def test_a_row_that_names_board_and_key_is_for_that_key_alone(
    station: Station, tmp_path: Path, pin: str, good: bool
) -> None:
    run = of_sheet(station, tmp_path, f"uuid,fingerprint\n{uuid_of(1).hex()},{pin}\n")
    who: Any = SimpleNamespace(uuid=uuid_of(1), fingerprint=KEY)
    if good:
        assert run._for(who).order.profile == "load-cell"
        assert run._is_named(who), "the sheet names this very board: no question"
        return
    with pytest.raises(PolicyError) as refused:
        run._for(who)
    assert refused.value.code == "other-key"
    assert refused.value.message == (
        f"Board {uuid_of(1).hex()} holds the key {KEY[:32]}; row 1 of the sheet says {pin[:32]}."
    )


def test_a_row_in_the_order_of_taps_names_no_board(station: Station, tmp_path: Path) -> None:
    run = of_sheet(station, tmp_path, "name\na\n")
    who: Any = SimpleNamespace(uuid=uuid_of(1), fingerprint=KEY)
    run._for(who)
    assert not run._is_named(who)
    assert not run_of(station)._is_named(who)


@pytest.mark.parametrize(
    ("request_", "all_done", "out", "error"),
    [
        ({}, False, True, "0 passed, 0 failed, 1 skipped. No board was tapped within 60 s for row 1."),
        ({}, False, False, "0 passed, 0 failed, 1 skipped."),
        ({"whole_bus": True}, True, False, "0 passed, 0 failed, 1 skipped. No board answered on the bus for row 1."),
        ({"whole_bus": True}, False, False, "0 passed, 0 failed, 1 skipped."),  # Ctrl-C: boards may be there
    ],
)
def test_the_totals_of_a_sheet_say_why_a_row_has_no_board(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    request_: dict[str, bool], all_done: bool, out: bool, error: str,
) -> None:  # fmt: skip
    run = of_sheet(station, tmp_path, f"uuid\n{uuid_of(1).hex()}\n", **request_)
    run._all_done = all_done
    monkeypatch.setattr(type(run.stop), "ran_out", property(lambda _own: out))
    found = run.totals().error
    assert found is not None
    assert found.message == error
    assert isinstance(found, NoNodeError) == ("No board" in error)


class Bus:
    """A bus on which these nodes answer."""

    place = "can:test"

    class capabilities:
        many, max_parallel = True, 1

    def __init__(self, *answers: Contact) -> None:
        self.answers, self.closed = list(answers), 0

    def find_all(self, **_: object) -> list[Contact]:
        return self.answers

    def close(self) -> None:
        self.closed += 1


@pytest.mark.parametrize("stopped", [False, True])
def test_one_uuid_at_two_addresses_ends_the_run_after_the_others_are_finished(
    station: Station, monkeypatch: pytest.MonkeyPatch, stopped: bool
) -> None:
    """A person who asked to stop has the boards that were begun, and no error of a board that was not."""
    for number in (1, 2, 3, 4):
        station.pins.put(WhitelistEntry(uuid_of(number), assurance="tap"))
    bus = Bus(answer(1, address=0x21), answer(2, address=0x22), answer(1, address=0x23), answer(3), answer(4))
    run = run_of(station, whole_bus=True)
    monkeypatch.setattr(batch, "open_port", lambda _links: bus)

    dropped, drop = threading.Event(), batch.ParallelWork.drop_waiting
    monkeypatch.setattr(batch.ParallelWork, "drop_waiting", lambda own: (drop(own), dropped.set()))

    def board(found: Contact, place: str, _operator: Operator) -> BoardResult | None:
        uuid = found.identity.uuid
        if stopped and uuid != uuid_of(2):
            dropped.wait(PATIENCE)
        return None if uuid == uuid_of(3) and not stopped else BoardResult(uuid, 0.1, place=place)

    monkeypatch.setattr(run, "_board", board)
    came: list[bytes] = []
    boards = run._all_at_once(Operator())
    if stopped:
        came.append(next(boards).uuid)
        run.stop.request_stop()
        came += [ended.uuid for ended in boards]
        assert came in ([uuid_of(2)], [uuid_of(2), uuid_of(3)]), "the one that was begun is finished, no other begun"
    else:
        with pytest.raises(AddressConflictError, match="at 0x21 and at 0x23"):
            came.extend(ended.uuid for ended in boards)
        assert came == [uuid_of(2), uuid_of(4)]
        assert run.expected == 2, "one of three turned out to be finished already"
    assert (run._all_done, bus.closed) == (not stopped, 1)


def test_a_finished_sheet_opens_no_vault_and_waits_for_no_board_but_writes_its_report(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = of_sheet(station, tmp_path, "name\na\n", report=tmp_path / "day.csv")
    asked: list[object] = []
    monkeypatch.setattr(type(station), "unlock", lambda *_: asked.append(1))
    run.unlock()
    assert len(asked) == 1
    assert run.progress is not None
    run.progress.rows[1].result = "passed"
    run.unlock()
    assert list(run.many(Operator())) == []
    assert len(asked) == 1
    assert (tmp_path / "day.csv").read_text().startswith("row,uuid,name,")
    run_of(station).unlock()
    assert len(asked) == 2


# -- the plan ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("state", "held", "listed", "steps"),
    [
        (NodeState.FACTORY, True, True, ["agree"]),
        (NodeState.FACTORY, False, False, ["whitelist", "agree"]),
        (NodeState.KEYED, False, True, ["agree"]),
        (NodeState.KEYED, True, True, []),
        (NodeState.PROVISIONED, True, False, ["whitelist"]),
    ],
)
def test_a_plan_has_the_steps_that_are_left(
    station: Station, monkeypatch: pytest.MonkeyPatch, state: NodeState, held: bool, listed: bool, steps: list[str]
) -> None:
    uuid = uuid_of(1)
    who = SimpleNamespace(uuid=uuid, whitelisted=listed or None, state=state, security_teds=b"")
    found = SimpleNamespace(image=Image(uuid, {}), identity=SimpleNamespace(state=state))
    proposal = SimpleNamespace(changes=(SimpleNamespace(text="It changes."),), warnings=("w",), image=Image(uuid, {}))
    monkeypatch.setattr(batch, "examine", lambda *_: who)
    monkeypatch.setattr(batch, "take_snapshot", lambda *_, **__: found)
    monkeypatch.setattr(batch, "propose", lambda *_, **__: proposal)
    monkeypatch.setattr(batch, "differences", lambda *_: ("Another type.",))
    monkeypatch.setattr(type(station.keys), "held", lambda *_: [object()] if held else [])
    plan = run_of(station)._plan_for(None)  # type: ignore[arg-type]
    assert plan.steps == ("identify", *steps, "build", "sign", "write", "verify", "check")
    assert (plan.changes, plan.warnings) == (("It changes.",), ("w", "Another type."))
    retyped = run_of(station, order=replace(CELL, retype=True))._plan_for(None)  # type: ignore[arg-type]
    assert retyped.warnings == ("w",)


# -- what is told ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("named", "sudo", "operator"), [("Ada", "root's", "Ada"), ("", "ada", "ada"), ("", None, None), ("", "", None)]
)
def test_a_report_names_station_key_operator_and_software(
    station: Station, monkeypatch: pytest.MonkeyPatch, named: str, sudo: str | None, operator: str | None
) -> None:
    monkeypatch.delenv("SUDO_USER", raising=False)
    if sudo is not None:
        monkeypatch.setenv("SUDO_USER", sudo)
    monkeypatch.setattr(getpass, "getuser", lambda: "user")
    about = run_of(station, operator=named)._about()
    assert (about.station, about.fingerprint, about.operator) == (
        "bench", station.fingerprint, operator if operator is not None else "user",
    )  # fmt: skip
    assert about.software.startswith("teds-provision ")


@pytest.mark.parametrize("name", ["day.html", "day.HTM", "day.htm"])
def test_a_report_for_people_has_a_row_for_each_board_in_its_colour(
    station: Station, tmp_path: Path, name: str
) -> None:
    progress = Progress(
        station.home, read_sheet(station, sheet(tmp_path, f"uuid,name\n{uuid_of(5).hex()},a\n,b\n"), CELL)
    )
    first, second = progress.sheet.rows
    progress.assign_row(second, uuid_of(2))
    progress.note(second, BoardResult(uuid_of(2), 1.25, row=2))
    about = ReportHead("bench", KEY, "Ada", "teds-provision 9")
    check_report(tmp_path / name)
    write_report(tmp_path / name, progress, about)
    text = (tmp_path / name).read_text()
    assert text.startswith("<!DOCTYPE html>")
    assert f'<tr class="not reached"><td>1</td><td>{uuid_of(5).hex()}</td><td>a</td><td>load-cell</td>' in text
    assert f'<tr class="passed"><td>2</td><td>{uuid_of(2).hex()}</td><td>b</td><td>load-cell</td><td>passed</td>' in (
        text
    )
    assert "<td>1</td><td>yes</td><td>1.2</td>" in text
    assert f"<tr><th>key</th><td>{KEY}</td></tr>" in text, "all of it"
    assert first.number == 1


@pytest.mark.parametrize("kept", ["{", "[]", '{"rows": []}', '{"rows": {"1": 7}}', '{"rows": {"1": {"new": 1}}}'])
def test_progress_that_cannot_be_read_begins_anew(station: Station, tmp_path: Path, kept: str) -> None:
    found = read_sheet(station, sheet(tmp_path, "name\na\n"), CELL)
    Progress(station.home, found).save()
    (file,) = (station.home / "batches").glob("*.json")
    file.write_text(kept)
    assert [row.number for row in Progress(station.home, found).open] == [1]


def test_only_a_row_that_has_passed_is_done_again_and_told_so(station: Station, tmp_path: Path) -> None:
    def now(text: str) -> Progress:
        return Progress(station.home, read_sheet(station, sheet(tmp_path, text), CELL))

    progress = now("name\na\nb\n")
    for row, result in zip(progress.sheet.rows, ("passed", "failed"), strict=True):
        progress.assign_row(row, uuid_of(row.number))
        progress.rows[row.number].result = result
    progress.save()
    changed = now("name\nc\nd\n")
    assert changed.again == ("Row 1: provisioned again, because the sheet changed.",)
    assert [changed.board_of(row) for row in changed.sheet.rows] == [None, None], "other cells are another board"
    assert [changed.has_passed(uuid_of(number)) for number in (1, 2)] == [False, False]
    changed.note(changed.sheet.rows[0], BoardResult(uuid_of(1), 1.0, row=1))
    assert now("name\nc\nd\n").again == (), "it was done again"
    assert progress.has_passed(uuid_of(1))
    assert not progress.has_passed(uuid_of(2))
    assert not progress.has_passed(uuid_of(3))


def test_a_row_that_failed_is_no_row_that_is_done_again(station: Station, tmp_path: Path) -> None:
    """It is tried again in any case, and keeps its tries."""

    def now(text: str) -> Progress:
        return Progress(station.home, read_sheet(station, sheet(tmp_path, text), CELL))

    (station.home / "profiles").mkdir()
    own = station.home / "profiles" / "own.toml"
    own.write_text('extends = "load-cell"\n')
    failed = now("name,profile\na,own\n")
    failed.note(failed.sheet.rows[0], BoardResult(uuid_of(1), 1.0, error=NodeSilentError("Pulled."), row=1))
    own.write_text('extends = "load-cell"\n[channel.1]\nuncertainty = 0.4\n')
    later = now("name,profile\na,own\n")
    assert (later.again, later.rows[1].tries) == ((), 1), "a row that failed is tried again in any case"


@pytest.mark.parametrize(
    "row", [f"0X{KEY[:20].upper()},{{key}}", f"{KEY[:4]}:{KEY[4:8]}-{KEY[8:20]},{{key}}", f" {KEY[:20]} , {{key}} "]
)
def test_digits_of_a_sheet_are_read_as_people_write_them(station: Station, tmp_path: Path, row: str) -> None:
    text = f"UUID , Fingerprint\n{row.format(key=f'{KEY[:8].upper()} {KEY[8:16]}:{KEY[16:40]}')}\n"
    (found,) = read_sheet(station, sheet(tmp_path, text), CELL).rows
    assert (found.uuid, found.fingerprint) == (bytes.fromhex(KEY[:20]), KEY[:40])
    assert not found.by_order


def test_one_label_in_both_cells_is_one_board(station: Station, tmp_path: Path) -> None:
    label = f"TEDS1:{uuid_of(1).hex()}:{KEY}".upper()
    (found,) = read_sheet(station, sheet(tmp_path, f"uuid,fingerprint\n{label},{label}\n"), CELL).rows
    assert (found.uuid, found.fingerprint) == (uuid_of(1), KEY)


@pytest.mark.parametrize(("watch", "with_sheet"), [(True, False), (False, True), (True, True)])
def test_several_readers_serve_taps_or_a_sheet(station: Station, tmp_path: Path, watch: bool, with_sheet: bool) -> None:
    file = sheet(tmp_path, "name\na\n") if with_sheet else None
    links = LinkSettings(nfc=("usb", "tty:USB0:pn532"))
    BatchRun(station, links, ProvisionRequest(order=CELL, watch=watch, sheet=file), SilentReporter())


def test_a_row_may_be_shorter_than_the_header_and_cells_are_not_run_together(station: Station, tmp_path: Path) -> None:
    text = f"uuid,name,item\n{uuid_of(1).hex()}\n,bc,\n,b,c\n"
    first, second, third = read_sheet(station, sheet(tmp_path, text), CELL).rows
    assert (first.uuid, first.prepared.order.name) == (uuid_of(1), None)
    assert second.digest != third.digest


def test_two_runs_that_end_one_board_keep_what_each_of_them_saw_last(station: Station, tmp_path: Path) -> None:
    found = read_sheet(station, sheet(tmp_path, "name\na\n"), CELL)
    here, other = Progress(station.home, found), Progress(station.home, found)
    (row,) = found.rows
    other.note(row, BoardResult(uuid_of(1), 1.0, error=NodeSilentError("It was pulled."), row=1))
    here.note(row, BoardResult(uuid_of(1), 1.0, row=1))
    assert here.rows[1].result == Progress(station.home, found).rows[1].result == "passed"


def test_a_row_that_names_a_key_is_for_no_board_with_another_one_though_it_had_the_row(
    station: Station, tmp_path: Path
) -> None:
    found = read_sheet(station, sheet(tmp_path, f"fingerprint,name\n{KEY},a\n,b\n"), CELL)
    progress = Progress(station.home, found)
    progress.assign_row(found.rows[0], uuid_of(1))
    assert progress.row_for(uuid_of(1), KEY) is found.rows[0]
    assert progress.row_for(uuid_of(1), "cd" * 32) is found.rows[1]


def test_a_board_of_another_type_leaves_its_row_free_and_ends_the_batch_with_6(
    station: Station, tmp_path: Path
) -> None:
    run = of_sheet(station, tmp_path, "name\na\n")
    progress = run.progress
    assert progress is not None
    (row,) = progress.sheet.rows
    progress.assign_row(row, uuid_of(1))
    wrong = WrongBoardError("It is of another type.")
    run._note(BoardResult(uuid_of(1), 1.0, error=wrong, row=1, time="2026-11-28T01:02:03Z"))
    kept = Progress(station.home, progress.sheet).rows[1]
    assert (kept.uuid, kept.result, kept.tries) == (None, "", 0)
    assert (kept.message, kept.time) == ("It is of another type.", "2026-11-28T01:02:03Z")
    assert progress.board_of(row) is None
    assert progress.untried == [row]
    assert run.totals().worst is wrong


def test_a_board_of_another_type_that_its_row_names_is_a_failed_one(station: Station, tmp_path: Path) -> None:
    run = of_sheet(station, tmp_path, f"uuid\n{uuid_of(1).hex()}\n")
    run._note(BoardResult(uuid_of(1), 1.0, error=WrongBoardError("It is of another type."), row=1))
    assert run.progress is not None
    assert (run.progress.rows[1].result, run.progress.rows[1].tries) == ("failed", 1)


def test_a_board_that_passed_at_once_did_so_though_it_is_tapped_again(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read_sheet(station, sheet(tmp_path, "name\na\nb\n"), CELL))
    first, second = progress.sheet.rows
    for row, error in ((first, None), (first, None), (second, NodeSilentError("Pulled.")), (second, None)):
        progress.note(row, BoardResult(uuid_of(row.number), 1.0, error=error, row=row.number))
    assert [progress.rows[number].first for number in (1, 2)] == [True, False]
    assert progress.totals().first_pass == 0.5


@pytest.mark.parametrize("unsigned", [True, False])
def test_a_board_that_is_not_authentic_has_failed_and_its_verdict_goes_before_its_warnings(
    station: Station, tmp_path: Path, unsigned: bool
) -> None:
    progress = Progress(station.home, read_sheet(station, sheet(tmp_path, "name\na\n"), CELL))
    check = Check("signed", "failed", "it is not signed") if unsigned else Check("signed", "passed", "")
    done: Any = SimpleNamespace(
        verified=Verification(uuid_of(1), (check,)), warnings=("Warm.", "Slow."), steps=(SimpleNamespace(
            name="write", seconds=0.5),)
    )  # fmt: skip
    board = BoardResult(uuid_of(1), 1.0, done, row=1)
    progress.note(progress.sheet.rows[0], board)
    kept = progress.rows[1]
    assert kept.steps == {"write": 0.5}
    if not unsigned:
        assert (kept.result, kept.message, progress.totals().error) == ("passed", "Warm. Slow.", None)
        return
    assert board.failure is not None
    assert (kept.result, kept.message) == ("failed", board.failure.message)
    assert isinstance(progress.totals().error, NotAuthenticError)
    assert progress.totals().steps == {}


@pytest.mark.parametrize(
    ("request_", "limited"),
    [({"sheet": True}, True), ({"sheet": True, "watch": True}, False), ({"sheet": True, "whole_bus": True}, False),
     ({"watch": True}, False), ({"whole_bus": True}, False), ({}, False)],
)  # fmt: skip
def test_the_wait_for_the_next_board_is_limited_for_a_sheet_alone(
    station: Station, tmp_path: Path, request_: dict[str, Any], limited: bool
) -> None:
    file = sheet(tmp_path, f"uuid\n{uuid_of(1).hex()}\n")
    request = ProvisionRequest(order=CELL, **request_ | ({"sheet": file} if "sheet" in request_ else {}))
    run = BatchRun(station, LinkSettings("can", timeout=0.0), request, SilentReporter())
    assert run.stop.is_set() == limited


def test_a_name_that_another_node_has_is_refused_before_the_named_one_is_waited_for(station: Station) -> None:
    station.nodes.remember(uuid_of(1), name="own")
    station.nodes.remember(uuid_of(2), name="taken")
    request = ProvisionRequest(uuid_of(1).hex(), replace(CELL, name="taken"))
    with pytest.raises(PolicyError, match=rf"^Node {uuid_of(2).hex()} already has the name 'taken'\.$"):
        BatchRun(station, LinkSettings(), request, SilentReporter())
    BatchRun(station, LinkSettings(), replace(request, order=replace(CELL, name="own")), SilentReporter())


def test_what_is_wrong_with_a_sheet_and_what_is_done_again_is_told_before_the_first_board(
    station: Station, tmp_path: Path
) -> None:
    run = of_sheet(station, tmp_path, "name\na\n")
    assert run.progress is not None
    run.progress.assign_row(run.progress.sheet.rows[0], uuid_of(1))
    run.progress.rows[1].result = "passed"
    run.progress.save()
    lacking = "the type requires a calibration, but the sheet gives none."
    assert of_sheet(station, tmp_path, "name\nb\n").warnings == (
        f"Row 1: {lacking}", "Row 1: provisioned again, because the sheet changed.",
    )  # fmt: skip
    assert run_of(station).warnings == ()


@pytest.mark.parametrize(("state", "brings"), [(NodeState.FACTORY, True), (NodeState.PROVISIONED, False)])
def test_a_plan_to_adopt_judges_what_a_board_brought_unless_it_has_a_datasheet(
    station: Station, monkeypatch: pytest.MonkeyPatch, state: NodeState, brings: bool
) -> None:
    who = SimpleNamespace(uuid=uuid_of(1), whitelisted=None, state=state, security_teds=b"")
    found = SimpleNamespace(image=Image(uuid_of(1), {}), identity=SimpleNamespace(state=state))
    proposal = SimpleNamespace(changes=(), warnings=("proposed",), image=Image(uuid_of(1), {}))
    brought = SimpleNamespace(errors=("an error",), warnings=("a warning",))
    monkeypatch.setattr(batch, "examine", lambda *_: who)
    monkeypatch.setattr(batch, "take_snapshot", lambda *_, **__: found)
    monkeypatch.setattr(batch, "propose", lambda *_, **__: proposal)
    monkeypatch.setattr(batch, "read_factory_datasheet", lambda *_, **__: brought)
    plan = run_of(station, order=BuildOrder(adopt=True))._plan_for(None)  # type: ignore[arg-type]
    assert plan.warnings == (("an error", "a warning") if brings else ("proposed",))
    assert plan.steps[-5:] == ("build", "sign", "write", "verify", "check")


def test_the_mean_of_a_step_without_a_sheet_is_that_of_the_boards_that_passed_too(station: Station) -> None:
    """A board that lacked the calibration of its type counted, and so did one that was not authentic."""
    run = run_of(station, whole_bus=True)
    good, bad = (Check("signed", result, "why") for result in ("passed", "failed"))  # type: ignore[arg-type]
    boards = (
        (good, None, 1.0),
        (good, PolicyError("It has no calibration."), 9.0),
        (bad, None, 9.0),
        (good, None, 2.0),
    )
    for number, (check, error, seconds) in enumerate(boards):
        steps = (SimpleNamespace(name="write", seconds=seconds),)
        done: Any = SimpleNamespace(verified=Verification(uuid_of(number), (check,)), warnings=(), steps=steps)
        run._note(BoardResult(uuid_of(number), 1.0, done, error))
    totals = run.totals()
    assert (totals.passed, totals.failed, totals.steps) == (2, 2, {"write": 1.5})
    assert isinstance(totals.worst, NotAuthenticError), "the worst of all, its verdict counted"


def test_a_bus_without_a_board_of_ours_ends_the_run_before_anything(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    bus = Bus(answer(1), answer(2))
    monkeypatch.setattr(batch, "open_port", lambda _links: bus)
    run = run_of(station, whole_bus=True)
    with pytest.raises(PolicyError, match=r"^2 nodes answered, but none is on the whitelist"):
        list(run._all_at_once(Operator()))
    assert (bus.closed, run._all_done) == (1, False)
    bus.capabilities = SimpleNamespace(many=False, max_parallel=1)  # type: ignore[assignment]
    with pytest.raises(UsageError, match="--all needs a bus: a reader sees one node at a time"):
        list(run._all_at_once(Operator()))
    assert bus.closed == 2


def test_a_board_of_the_bus_that_lacks_the_calibration_of_its_type_has_that_error(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = run_of(station, whole_bus=True)
    done = SimpleNamespace(image=Image(uuid_of(1), {}))
    monkeypatch.setattr(run, "_was_finished_elsewhere", lambda _node: False)
    monkeypatch.setattr(run, "_provision", lambda *_: done)
    ended = run._board(answer(1), "can:test", Operator())
    assert ended is not None
    assert (ended.done, ended.place) == (done, "can:test")
    assert isinstance(ended.error, PolicyError)
    assert "has no calibration of channel 1, which its type requires." in ended.error.message
    monkeypatch.setattr(run, "_was_finished_elsewhere", lambda _node: True)
    assert run._board(answer(1), "can:test", Operator()) is None


def test_a_vault_that_is_locked_meanwhile_ends_the_run_and_is_no_fault_of_a_board(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, done = run_of(station, whole_bus=True), SimpleNamespace(image=Image(uuid_of(1), {}))

    def provision(node: Any, _operator: object, _reporter: object) -> Any:
        if node.contact.identity.uuid != uuid_of(1):
            raise VaultLockedError("The vault is locked.")
        return done

    monkeypatch.setattr(run, "_was_finished_elsewhere", lambda _node: False)
    monkeypatch.setattr(run, "_provision", provision)
    monkeypatch.setattr(run, "_at_once", lambda _port: 1)
    port: Any = SimpleNamespace(place="can:test", close=lambda: None)
    boards = run._side_by_side(port, [answer(1), answer(2), answer(3)], Operator())
    first = next(boards)
    assert (first.uuid, first.done) == (uuid_of(1), done)
    with pytest.raises(VaultLockedError) as locked:
        next(boards)
    assert locked.value.exit_code == 7


def clock(patch: pytest.MonkeyPatch, *moments: float) -> None:
    """Let the batch read these moments from the clock, one after the other."""
    left = list(moments)
    patch.setattr(batch, "time", SimpleNamespace(monotonic=lambda: left.pop(0), sleep=None))


def test_in_the_plans_of_a_bus_a_refused_board_has_its_reason_and_ends_no_other(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in (1, 2, 3):
        station.pins.put(WhitelistEntry(uuid_of(number), assurance="tap"))
    bus, run = Bus(answer(1), answer(2), answer(3)), run_of(station, whole_bus=True)
    refused, silent = PolicyError("It is another owner's."), NodeSilentError("It is silent.")
    failures = {uuid_of(1): refused, uuid_of(2): SessionLostError(silent)}

    def plan_for(node: Conversation) -> Any:
        if node.uuid in failures:
            raise failures[node.uuid]
        return node.uuid

    monkeypatch.setattr(batch, "open_port", lambda _links: bus)
    monkeypatch.setattr(run, "_plan_for", plan_for)
    monkeypatch.setattr(run, "_on_the_bus", lambda _port: (None, bus.answers))
    clock(monkeypatch, 100.0, 102.5, 200.0, 200.25, 300.0)
    first, second, third = run.plans()
    assert third == uuid_of(3)
    assert (first, second) == (
        BoardResult(uuid_of(1), 2.5, None, refused, None, "can:test", first.time),  # type: ignore[union-attr]
        BoardResult(uuid_of(2), 0.25, None, silent, None, "can:test", second.time),  # type: ignore[union-attr]
    )
    assert (run.ended, run.worst, run.passed, bus.closed) == (2, refused, 0, 1)


@pytest.mark.parametrize("error", [NodeSilentError("It is silent."), PolicyError("No.")], ids=["lost", "refused"])
def test_a_board_that_fails_has_its_reason_place_and_time_and_of_a_lost_session_the_cause(
    station: Station, monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError
) -> None:
    def provision(*_: object) -> Any:
        raise SessionLostError(error) if isinstance(error, NodeSilentError) else error

    run = run_of(station, whole_bus=True)
    monkeypatch.setattr(run, "_was_finished_elsewhere", lambda _node: False)
    monkeypatch.setattr(run, "_provision", provision)
    clock(monkeypatch, 100.0, 104.5)
    ended = run._board(answer(1), "can:test", Operator())
    assert ended is not None
    assert (ended.error, ended.seconds, ended.place, ended.row, ended.done) == (error, 4.5, "can:test", None, None)


def test_without_a_sheet_those_have_passed_that_did_in_this_run_and_of_a_job_those_of_all_runs(
    station: Station,
) -> None:
    run, verified = run_of(station, whole_bus=True), Verification(uuid_of(1), (Check("signed", "passed"),))
    done: Any = SimpleNamespace(verified=verified, warnings=("old",), steps=())
    for number, error in ((1, None), (2, PolicyError("No.")), (3, None)):
        run._note(BoardResult(uuid_of(number), 1.0, done, error))
    assert (run.passed, run.ended, len(run), run.of_a_job) == (2, 3, 0, False)
    assert run.board_warnings == {"old": [uuid_of(1), uuid_of(2), uuid_of(3)]}
    for total, passed in ((12, 7), (0, 2)):
        run.line = cast(Any, SimpleNamespace(total=total, passed=7))
        assert (run.passed, len(run), run.of_a_job) == (passed, total, total > 0)


def test_a_job_that_only_verifies_writes_nothing(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    run, node, line = run_of(station), cast(Any, object()), cast(Any, SimpleNamespace(only_verify=True, total=0))
    run.line = line
    monkeypatch.setattr(batch, "verify_only", lambda *given: given)
    monkeypatch.setattr(batch, "provision", lambda *_, **__: "provisioned")
    assert run._provision(node, Operator()) == (station, node, line, run._reporter)
    line.only_verify = False
    assert run._provision(node, Operator()) == "provisioned"


def test_the_steps_of_one_of_several_boards_are_reported_under_its_name(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    with station.transaction():
        station.nodes.put(NodeRecord(uuid_of(1), name="hand"))
        station.nodes.put(NodeRecord(uuid_of(2)))
    run, steps = run_of(station, whole_bus=True), []

    def provision(*_: object, reporter: Reporter, **__: object) -> Any:
        reporter.finished(StepResult("write"))
        return SimpleNamespace(image=Image(uuid_of(1), {(1, 5): b"x"}))

    monkeypatch.setattr(run._reporter, "finished", steps.append)
    monkeypatch.setattr(run, "_was_finished_elsewhere", lambda _node: False)
    monkeypatch.setattr(batch, "provision", provision)
    for number in (1, 2, 3):
        assert run._board(answer(number), "can:test", Operator()) is not None
    assert [step.of for step in steps] == ["hand", uuid_of(2).hex(), uuid_of(3).hex()]
    run._provision(cast(Any, object()), Operator())
    assert steps[-1].of == "", "of a board that is alone, the run's own"


def test_a_row_is_done_already_if_the_board_has_what_the_row_gives(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    uuid, gripper, other = uuid_of(1), load_profile("gripper"), load_profile("limit-switch")
    sheets = read_sheet(station, sheet(tmp_path, "uuid,name,profile\n,hand,gripper\n,arm,gripper\n"), BuildOrder())
    hand, arm = sheets.rows
    built = compose(station, uuid, named_for(station, uuid, hand.prepared), Image(uuid, {}), edition=2007).blocks
    images: dict[str, Image | None] = {
        "what it gives": Image(uuid, built),
        "another type": Image(uuid, other.build(uuid, name="hand").blocks),
        "another name": Image(uuid, gripper.build(uuid, name="foot").blocks),
        "less": Image(uuid, dict(list(built.items())[:-1])),
        "nothing": None,
    }
    found = {}
    for what, image in images.items():
        monkeypatch.setattr(type(station.datasheets), "datasheet", lambda _own, _uuid, image=image: image)
        found[what] = (batch._has_it_already(station, hand, uuid), batch._has_it_already(station, arm, uuid))
    assert found == {what: (what == "what it gives", False) for what in images}
    monkeypatch.setattr(type(station.datasheets), "datasheet", lambda *_: images["what it gives"])
    with station.transaction():
        station.nodes.put(NodeRecord(uuid_of(2), name="hand"))
    assert not batch._has_it_already(station, hand, uuid), "another node has that name now"


@pytest.mark.parametrize(
    ("whitelisted", "of_the_job", "only_verify", "meant"),
    [
        (False, True, False, True),
        (False, False, False, False),
        (False, True, True, True),
        (True, False, True, True),
        (False, False, True, False),
    ],
)
def test_a_board_of_the_bus_is_meant_if_the_job_or_the_whitelist_lists_it(
    station: Station, monkeypatch: pytest.MonkeyPatch, whitelisted: bool, of_the_job: bool, only_verify: bool,
    meant: bool,
) -> None:  # fmt: skip
    if whitelisted:
        station.pins.put(WhitelistEntry(uuid_of(1), assurance="tap"))
    run = run_of(station, whole_bus=True)
    run.line = cast(Any, SimpleNamespace(is_listed=lambda uuid: of_the_job and uuid == uuid_of(1),
                                         only_verify=only_verify, total=0))  # fmt: skip
    assert run._is_meant(answer(1)) is meant
    assert not run._is_meant(answer(2))


def test_a_board_whose_row_cannot_be_given_for_any_reason_is_turned_away(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = of_sheet(station, tmp_path, "name\na\n")

    def fail(*_: object) -> None:
        raise UsageError("The name is none.")

    monkeypatch.setattr(batch, "named_for", fail)
    with pytest.raises(UsageError, match="The name is none"):
        run._for(SimpleNamespace(uuid=uuid_of(1), fingerprint=KEY))  # type: ignore[arg-type]
    assert run.progress is not None
    assert run.progress.board_of(run.progress.sheet.rows[0]) == uuid_of(1).hex()
    assert run.progress.rows[1].uuid is None


@pytest.mark.parametrize("how", ["locked", "closed"])
def test_a_batch_that_is_cut_short_writes_its_report_of_the_boards_until_then(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    run = of_sheet(station, tmp_path, "name\na\nb\n", report=tmp_path / "day.csv")
    noted: list[BoardResult] = []

    def come(_operator: Operator) -> Iterator[BoardResult]:
        yield BoardResult(uuid_of(1), 1.0, row=1)
        raise VaultLockedError("The vault is locked.")

    monkeypatch.setattr(batch, "_load_ahead", lambda: None)
    monkeypatch.setattr(run, "_as_they_come", come)
    monkeypatch.setattr(run, "_note", noted.append)
    boards = cast("Generator[BoardResult]", run.many(Operator()))
    assert [next(boards)] == noted, "noted before anybody sees it"
    assert not (tmp_path / "day.csv").exists()
    if how == "locked":
        with pytest.raises(VaultLockedError):
            next(boards)
    else:
        boards.close()
    assert (tmp_path / "day.csv").read_text().startswith("row,uuid,name,")


def test_of_many_rows_without_a_board_the_first_ten_are_named(station: Station, tmp_path: Path) -> None:
    rows = "".join(f"{uuid_of(number).hex()}\n" for number in range(1, 12))
    run = of_sheet(station, tmp_path, f"uuid\n{rows}", whole_bus=True)
    run._all_done = True
    found = run.totals().error
    assert found is not None
    assert found.message.endswith("No board answered on the bus for row 1, 2, 3, 4, 5, 6, 7, 8, 9, 10.")
