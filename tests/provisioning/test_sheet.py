"""The sheet of a batch: what is wrong with it, and what a person should know of it, told before the first board."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    NodeBusyError,
    NodeSilentError,
    NoNodeError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
    UsageError,
    VaultLockedError,
)
from teds_provision.links import Contact, LinkSettings
from teds_provision.provisioning import batch_sheet
from teds_provision.provisioning.batch import BatchRun, ProvisionRequest
from teds_provision.provisioning.batch_sheet import (
    BatchSheet,
    BatchTotals,
    BoardResult,
    DeclinedError,
    Progress,
    ReportHead,
    SheetRow,
    check_report,
    read_sheet,
    worse,
    write_report,
)
from teds_provision.provisioning.build import BuildOrder, PreparedOrder, check_name, for_several, named_for, prepare
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord, WhitelistEntry
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from tests.bench import Board, contact
from tests.pace import PATIENCE


def read(station: Station, folder: Path, text: str | bytes) -> BatchSheet:
    file = folder / "boards.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_sheet(station, file, BuildOrder(profile="load-cell"))


def test_a_mistake_of_many_lines_is_reported_once_with_all_of_them(station: Station, tmp_path: Path) -> None:
    rows = "".join(f",b{number},none.csv\n" for number in range(30))
    with pytest.raises(BadDataError) as caught:
        read(station, tmp_path, f"uuid,name,calibration\n{rows}")
    assert caught.value.message.count("There is no calibration file") == 1
    assert caught.value.message.startswith("boards.csv:2, 3, 4, ")
    assert "and 10 more: There is no" in caught.value.message


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_spreadsheet_separates_by_comma_semicolon_or_tab(station: Station, tmp_path: Path, delimiter: str) -> None:
    sheet = read(station, tmp_path, f"\ufeffuuid{delimiter}name\r\n{delimiter}left knee\r\n")
    assert [row.prepared.order.name for row in sheet.rows] == ["left knee"]


def test_a_sheet_that_is_not_utf8_is_reported_with_the_line_and_the_cure(station: Station, tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match=r"boards.csv:3: it is not UTF-8 .*CSV UTF-8"):
        read(station, tmp_path, b"uuid,name\n,a\n,caf\xe9\n,b\n,c\n")


def test_rows_without_the_calibration_that_their_type_asks_for_are_reported_before_the_tap(
    station: Station, tmp_path: Path
) -> None:
    (tmp_path / "cal.csv").write_text("# date: 2026-11-20\nraw,value [N]\n4194304,-500\n12582912,500\n")
    sheet = read(station, tmp_path, "name,calibration,profile\na,,\nb,cal.csv,\nc,,\nd,,limit-switch\n")
    assert [warning for warning in sheet.warnings if "type requires" in warning] == [
        "Rows 1, 3: the type requires a calibration, but the sheet gives none."
    ]


def test_a_name_is_one_line(station: Station, tmp_path: Path) -> None:
    with pytest.raises(BadDataError, match="one line of printable characters"):
        read(station, tmp_path, 'uuid,name\n,"a\nb"\n')


@pytest.mark.parametrize("columns", ["uuid,name,fingerprint", "fingerprint,name,uuid"])
def test_a_label_scanned_into_a_cell_says_uuid_and_key(station: Station, tmp_path: Path, columns: str) -> None:
    """Under a Russian layout here; the other cell is empty, or says the same."""
    uuid, key = "8d4d9da65281f7000000", "0123456789abcdef" * 4
    label = f"TEDS1:{uuid}:{key}".upper().translate(str.maketrans("ABCDEFTS:", "ФИСВУАЕЫЖ"))
    same = uuid if columns.endswith("uuid") else key[:32]
    for other in ("", same):
        (row,) = read(station, tmp_path, f"{columns}\n{label},a,{other}\n").rows
        assert (row.uuid, row.fingerprint) == (bytes.fromhex(uuid), key)
    with pytest.raises(BadDataError, match="and the label in"):
        read(station, tmp_path, f"{columns}\n{label},a,{'ab' * (len(same) // 2)}\n")


def board_of(number: int) -> bytes:
    return bytes([number]) * 10


def test_rows_go_to_boards_in_the_order_of_the_taps_and_to_a_spare_at_last(station: Station, tmp_path: Path) -> None:
    """A board that failed keeps its row for another try; its spare was told that no row is left."""
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\nc\n"))
    for number, error in ((1, None), (2, NodeSilentError("It was pulled.")), (3, None)):
        row = progress.row_for(board_of(number), "")
        assert row is not None
        assert row.number == number
        progress.assign_row(row, board_of(number))
        progress.rows[number].result = "failed" if error else "passed"
        if error:
            progress.note(row, BoardResult(board_of(number), 1.0, error=error, row=number))
    progress.save()
    again = Progress(station.home, progress.sheet)
    assert [row.number for row in again.open] == [2]
    assert again.next_row is not None
    assert again.board_of(again.next_row) == board_of(2).hex()
    for board in (2, 9):  # the same one again, or its spare
        row = again.row_for(board_of(board), "")
        assert row is not None
        assert row.number == 2
    assert again.row_for(board_of(9), "", busy={2}) is None, "another reader is at work on it"


def test_two_runs_of_one_sheet_lose_each_other_no_board_and_share_no_row(station: Station, tmp_path: Path) -> None:
    """Each wrote the whole sheet as it knew it: what the other had done was open again."""
    sheet = read(station, tmp_path, "name\na\nb\nc\n")
    here, other = Progress(station.home, sheet), Progress(station.home, sheet)
    first, second, third = sheet.rows
    here.assign_row(first, board_of(1))
    assert other.row_for(board_of(2), "") is first, "it does not know yet"
    with pytest.raises(NodeBusyError, match="by another run of this sheet"):
        other.assign_row(first, board_of(2))
    assert other.row_for(board_of(2), "") is second
    other.assign_row(second, board_of(2))
    other.note(second, BoardResult(board_of(2), 1.0, error=NodeSilentError("It was pulled."), row=2))
    here.note(first, BoardResult(board_of(1), 1.0, error=NodeSilentError("It was pulled."), row=1))
    here.assign_row(third, board_of(3))
    again = Progress(station.home, sheet)
    assert [again.board_of(row) for row in sheet.rows] == [board_of(number).hex() for number in (1, 2, 3)]
    assert [again.rows[number].result for number in (1, 2)] == ["failed", "failed"]
    assert here.rows[2].result == "failed"


def test_a_spare_gets_no_row_before_those_that_had_no_board(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\n"))
    progress.assign_row(progress.sheet.rows[0], board_of(1))
    progress.note(progress.sheet.rows[0], BoardResult(board_of(1), 1.0, error=NodeSilentError("It was pulled."), row=1))
    row = progress.row_for(board_of(2), "")
    assert row is not None
    assert row.number == 2


CERTIFICATE = "# date: 2026-11-20\nraw,value [N]\n4194304,-500\n12582912,{high}\n"


def finished(station: Station, folder: Path, text: str) -> Progress:
    """Return a sheet of one row that has passed, kept on the disk."""
    progress = Progress(station.home, read(station, folder, text))
    progress.assign_row(progress.sheet.rows[0], board_of(1))
    progress.rows[1].result = "passed"
    progress.save()
    return progress


def test_a_row_is_done_again_after_its_calibration_profile_or_name_changed(station: Station, tmp_path: Path) -> None:
    """The digest of the cells stayed the same: a corrected file of the same name was reported as passed."""
    (station.home / "profiles").mkdir()
    base, own, file = station.home / "profiles/base.toml", station.home / "profiles/own.toml", tmp_path / "cal.csv"
    base.write_text('name = "base"\nextends = "load-cell"\n')
    own.write_text('name = "own"\nextends = "base"\n')
    file.write_text(CERTIFICATE.format(high=500))
    text = "name,calibration,profile\na,cal.csv,own\n"
    finished(station, tmp_path, text)
    assert Progress(station.home, read(station, tmp_path, text)).open == []

    file.write_text(CERTIFICATE.format(high=490))
    again = Progress(station.home, read(station, tmp_path, text))
    assert [(row.number, again.board_of(row)) for row in again.open] == [(1, board_of(1).hex())]
    assert again.again == ("Row 1: provisioned again, because the calibration changed.",)
    file.write_text(CERTIFICATE.format(high=500))
    assert Progress(station.home, read(station, tmp_path, text)).open == [], "it is as it was"

    base.write_text('name = "base"\nextends = "load-cell"\n[channel.1]\nuncertainty = 0.4\n')
    assert Progress(station.home, read(station, tmp_path, text)).again == (
        "Row 1: provisioned again, because the profile changed.",
    )
    base.write_text('name = "base"\nextends = "load-cell"\n')
    renamed = Progress(station.home, read(station, tmp_path, text.replace("a,", "b,", 1)))
    assert renamed.again == ("Row 1: provisioned again, because the sheet changed.",)


def test_a_row_stays_done_when_rows_before_it_are_added_removed_or_sorted(station: Station, tmp_path: Path) -> None:
    """Progress was matched by the number of the row: one line more at the top opened every finished row again."""
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\nc\n"))
    for row in progress.sheet.rows[:2]:
        progress.assign_row(row, board_of(row.number))
        progress.rows[row.number].result = "passed"
    progress.save()
    for text, open_rows, boards in (
        ("name\nnew\na\nb\nc\n", [1, 4], [None, 1, 2, None]),
        ("name\nc\nb\na\n", [1], [None, 2, 1]),
        ("name\nb\n", [], [2]),
    ):
        later = Progress(station.home, read(station, tmp_path, text))
        assert ([row.number for row in later.open], later.again) == (open_rows, ()), text
        had = [None if number is None else board_of(number).hex() for number in boards]
        assert [later.board_of(row) for row in later.sheet.rows] == had, text


def test_equal_rows_that_moved_are_each_done_once(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "uuid,profile\n,load-cell\n,load-cell\n"))
    for row in progress.sheet.rows:
        progress.assign_row(row, board_of(row.number))
        progress.rows[row.number].result = "passed"
    progress.save()
    rows = "uuid,profile\n,limit-switch\n,load-cell\n,load-cell\n,load-cell\n"
    later = Progress(station.home, read(station, tmp_path, rows))
    assert [row.number for row in later.open] == [1, 4]
    boards = {later.board_of(row) for row in later.sheet.rows[1:3]}
    assert boards == {board_of(1).hex(), board_of(2).hex()}


@pytest.mark.parametrize("same", [True, False])
def test_a_row_finished_by_an_older_version_is_done_again_if_its_board_differs(
    station: Station, tmp_path: Path, same: bool
) -> None:
    progress = finished(station, tmp_path, "name\na\n")
    (kept,) = (station.home / "batches").glob("*.json")
    record = json.loads(kept.read_text())
    for member in ("content", "again"):
        del record["rows"]["1"][member]
    kept.write_text(json.dumps(record))
    asked: list[bytes] = []

    def has_it(row: SheetRow, uuid: bytes) -> bool:
        asked.append(uuid)
        return same

    again = Progress(station.home, progress.sheet, has_it)
    assert (asked, len(again.open)) == ([board_of(1)], 0 if same else 1)
    assert ("the datasheet differs" in "".join(again.again)) is not same


def test_a_board_that_is_turned_away_takes_no_row(station: Station, tmp_path: Path) -> None:
    """Row 1 was bound to the first board that came; whoever has the name in fact got the name of row 2."""
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\nc\n"))
    first, second, _ = progress.sheet.rows
    progress.turn_away(first, board_of(1))
    progress.note(first, BoardResult(board_of(1), 1.0, error=NodeSilentError("Its name is another's."), row=1))
    assert progress.row_for(board_of(1), "") is first, "held there again it is tried for the same row"
    assert progress.row_for(board_of(2), "") is second
    assert progress.next_row is second
    later = Progress(station.home, progress.sheet)
    assert later.row_for(board_of(5), "") is later.sheet.rows[0], "nobody has it"
    progress.turn_away(first, board_of(3))
    assert progress.board_of(first) == board_of(3).hex(), "the last one that was refused"
    progress.assign_row(first, board_of(4))
    assert progress.board_of(first) == board_of(4).hex(), "the one that has it"


def test_a_row_that_was_tried_without_a_board_goes_before_the_one_of_a_board_that_failed_yesterday(
    station: Station, tmp_path: Path
) -> None:
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\n"))
    first, second = progress.sheet.rows
    progress.assign_row(second, board_of(2))
    progress.note(second, BoardResult(board_of(2), 1.0, error=NodeSilentError("It is silent."), row=2))
    today = Progress(station.home, progress.sheet)
    today.turn_away(first, board_of(1))
    today.note(first, BoardResult(board_of(1), 1.0, error=NodeSilentError("Its name is another's."), row=1))
    assert today.row_for(board_of(3), "") is first


def test_the_mean_of_a_step_is_that_of_the_boards_that_passed(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\nc\n"))
    for row, result, seconds in zip(progress.sheet.rows, ("passed", "failed", "passed"), (1.0, 9.0, 2.0), strict=True):
        progress.rows[row.number].result = result
        progress.rows[row.number].steps = {"write": seconds}
    assert progress.totals().steps == {"write": 1.5}


def test_a_no_is_no_try_of_a_board(station: Station, tmp_path: Path) -> None:
    """A board that passed when it was held there again counted as one that needed two tries."""
    progress = Progress(station.home, read(station, tmp_path, "name\na\n"))
    (row,) = progress.sheet.rows
    progress.note(row, BoardResult(board_of(1), 1.0, error=DeclinedError("You said no."), row=1))
    assert (progress.rows[1].result, progress.rows[1].tries) == ("skipped", 0)
    progress.rows[1].result = ""
    progress.note(row, BoardResult(board_of(1), 1.0, row=1))
    assert (progress.rows[1].result, progress.rows[1].tries, progress.rows[1].first) == ("passed", 1, True)
    assert progress.totals().first_pass == 1.0


def test_a_batch_to_which_no_board_came_says_so(station: Station, tmp_path: Path) -> None:
    """It said "0 passed, 0 failed, 2 skipped", and not why."""
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\n"))
    progress.ran_out("was tapped within 30 s")
    error = progress.totals().error
    assert isinstance(error, NoNodeError)
    assert error.message == "0 passed, 0 failed, 2 skipped. No board was tapped within 30 s for row 1, 2."


def test_the_report_for_people_says_yield_and_leaves_out_what_was_not_reached(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "name\n<b>\nb\n"))
    progress.assign_row(progress.sheet.rows[0], bytes(10))
    progress.note(progress.sheet.rows[0], BoardResult(bytes(10), 1.23, error=NodeSilentError("It is <silent>."), row=1))
    about = ReportHead("bench <1>", "ab" * 32, "Ada", "teds-provision 9")
    write_report(tmp_path / "day.html", progress, about)
    text = (tmp_path / "day.html").read_text()
    assert "<th>first-pass yield</th><td>0.0%</td>" in text
    assert "<th>skipped or not reached</th><td>1</td>" in text
    assert "&lt;b&gt;" in text
    assert "It is &lt;silent&gt;." in text
    assert "<td>not reached</td><td>0</td><td></td><td></td><td></td><td></td></tr>" in text
    for fact in ("bench &lt;1&gt;", "ab" * 32, "Ada", "teds-provision 9", "@page{size:A4 landscape"):
        assert fact in text
    write_report(tmp_path / "day.csv", progress, about)
    assert "first_pass,0.0000" in (tmp_path / "day.csv").read_text()


def test_boards_that_are_finished_when_the_vault_is_locked_are_counted(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process changed the passphrase while nodes of a bus were worked on: finished ones are reported."""
    boards = BatchRun(station, LinkSettings("can"), ProvisionRequest(whole_bus=True), SilentReporter())
    contacts = [on_reader_number(number) for number in range(4)]
    locked, begun = threading.Event(), threading.Barrier(4)

    def board(contact: Contact, place: str, _operator: Operator) -> BoardResult:
        uuid = contact.identity.uuid
        begun.wait(PATIENCE)  # what has not begun when the vault is locked does not begin any more
        if uuid == contacts[0].identity.uuid:
            locked.set()
            raise VaultLockedError("The vault is locked.")
        locked.wait(PATIENCE)
        time.sleep(0.05)  # the error is there first
        return BoardResult(uuid, 0.1, None, PolicyError("refused"), None, place)

    monkeypatch.setattr(boards, "_board", board)
    came: list[bytes] = []
    everyone = boards._side_by_side(SixAtOnce(), contacts, Operator())  # type: ignore[arg-type]
    with pytest.raises(VaultLockedError):
        came.extend(ended.uuid for ended in everyone)
    assert sorted(came) == sorted(contact.identity.uuid for contact in contacts[1:])


class SixAtOnce:
    """A fixture for a bus on which six nodes are worked on at once."""

    place = "can:test"

    class capabilities:
        max_parallel = 6

    def close(self) -> None:
        """Nothing is open."""


def on_reader_number(number: int) -> Contact:
    return contact(Board(uuid=board_of(number + 1)))


LABEL_KEY = "ab" * 32


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("uuid,nam\n", "boards.csv:1: there is no column 'nam'; columns are uuid, name, profile, calibration, item,"),
        ("name,NAME\na,b\n", "boards.csv:1: the column 'name' appears twice."),
        ("name\na,b\n", "boards.csv:2: 2 cells under 1 columns."),
        ("uuid\n8d4d\n", "boards.csv:2: uuid: expected 20 hex digits, not '8d4d'."),
        (f"fingerprint\n{'ab' * 15}\n", f"boards.csv:2: fingerprint: expected 32 to 64 hex digits, not '{'ab' * 15}'."),
        (f"fingerprint\n{'ab' * 33}\n", f"boards.csv:2: fingerprint: expected 32 to 64 hex digits, not '{'ab' * 24}'."),
        ("name\na\n\nb\na\n", "boards.csv:5: the name a is already in line 2."),
        (
            "uuid\n8d4d9da65281f7000000\n0x8D4D-9da6 5281f7000000\n",
            "boards.csv:3: the uuid 8d4d9da65281f7000000 is already",
        ),
        (
            f"fingerprint\n{'ab' * 32}\n{'ab' * 16}\n",
            f"boards.csv:3: the fingerprint {'ab' * 16} is already in line 2.",
        ),
        ('name\n"a', "boards.csv:2: this is not CSV: unexpected end of data."),
        ("name\n" + "x\n" * 3 + "y\n", "boards.csv:3, 4: the name x is already in line 2."),
        ("profile\nnone\n", "boards.csv:2: There is no profile"),
        ("uuid\n" + "".join(f"{n}\n" for n in range(22)), "; and 2 more."),
        ("uuid\n" + "".join(f"{n}\n" for n in range(20)), "; boards.csv:21: uuid: expected 20 hex digits, not '19'."),
        ("uuid\nä\n", "boards.csv:2: uuid: expected 20 hex digits, not '\\xe4'."),
    ],
)
def test_each_mistake_in_a_sheet_is_named_with_its_line(
    station: Station, tmp_path: Path, text: str, message: str
) -> None:
    with pytest.raises(BadDataError) as caught:
        read(station, tmp_path, text)
    assert caught.value.message.startswith(message) or (message[0] == ";" and caught.value.message.endswith(message))
    assert caught.value.hint == "Nothing was provisioned. Fix the sheet and run the same command again."


def test_a_sheet_without_rows_says_what_it_needs(station: Station, tmp_path: Path) -> None:
    for text in ("", "uuid,name\n", "uuid,name\n ,\n"):
        with pytest.raises(BadDataError, match=r"boards\.csv has no rows") as caught:
            read(station, tmp_path, text)
        assert caught.value.hint == (
            "It needs a header (uuid, name, profile, calibration, item, fingerprint) and one line per board."
        )


def test_a_row_is_for_the_board_that_it_names_and_gets_what_the_sheet_leaves_out(
    station: Station, tmp_path: Path
) -> None:
    file = tmp_path / "boards.csv"
    file.write_text(
        "uuid,name,profile,item,fingerprint\n8d4d9da65281f7000000,a,,,\n\n"
        f",,gripper,i1,{'ab' * 20}\n,b-{{n}},,,\n,b-{{n}},,,\n"
    )
    first, second, third, fourth = read_sheet(
        station, file, BuildOrder(profile="load-cell", name="common", item="i0")
    ).rows
    assert [(row.number, row.line) for row in (first, second, third)] == [(1, 2), (2, 4), (3, 5)]
    orders = [
        (row.prepared.order.profile, row.prepared.order.name, row.prepared.order.item) for row in (first, second, third)
    ]
    assert orders == [("load-cell", "a", "i0"), ("gripper", "common", "i1"), ("load-cell", "b-{n}", "i0")]
    assert [row.by_order for row in (first, second, third, fourth)] == [False, False, True, True]
    named = bytes.fromhex("8d4d9da65281f7000000")
    assert first.means(named, "cd" * 32), "another key is for the pin to refuse"
    assert not first.means(bytes(10), "ab" * 32)
    assert second.means(bytes(10), "ab" * 32)
    assert not second.means(bytes(10), "ab" * 19 + "cd" * 13)
    assert not third.means(bytes(10), "ab" * 32)
    assert third.digest == fourth.digest != first.digest
    assert set(first.content) == {"profile", "calibration", "name"}
    assert first.content["name"] == "a"


@pytest.mark.parametrize(
    ("one", "other", "first"),
    [
        (NodeSilentError("a"), PolicyError("b"), "b"),
        (PolicyError("a"), NotAuthenticError("b"), "b"),
        (NotAuthenticError("a"), PolicyError("b"), "a"),
        (DeclinedError("a"), NodeSilentError("b"), "a"),
        (PolicyError("a"), DeclinedError("b"), "a"),
        (DeclinedError("a"), PolicyError("b"), "b"),
        (None, NodeSilentError("b"), "b"),
        (NodeSilentError("a"), None, "a"),
    ],
)
def test_which_error_of_a_batch_a_person_should_see(
    one: TedsProvisionError | None, other: TedsProvisionError | None, first: str
) -> None:
    found = worse(one, other)
    assert found is not None
    assert found.message == first


def test_a_batch_ends_with_its_worst_error_and_its_counts() -> None:
    def totals(passed: int, failed: int, skipped: int, error: TedsProvisionError | None) -> TedsProvisionError | None:
        return BatchTotals(passed, failed, skipped, 1.0, None, {}, error).error

    assert totals(2, 0, 0, None) is None
    for failed, skipped in ((1, 0), (0, 1)):
        ended = totals(2, failed, skipped, None)
        assert type(ended) is PolicyError
        assert ended.message == f"2 passed, {failed} failed, {skipped} skipped."
        assert ended.hint == "Run the same command again to continue with the rest."
    assert isinstance(totals(0, 1, 0, NotAuthenticError("x")), NotAuthenticError)
    assert isinstance(totals(0, 1, 0, NodeSilentError("x")), NodeSilentError)


def test_a_whole_report_for_programs(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "uuid,name\n8d4d9da65281f7000000,=SUM(A1)\n,b\n,c\n"))
    first, second, _ = progress.sheet.rows
    progress.note(first, BoardResult(board_of(1), 1.23456, row=1, time="2026-11-28T01:02:03Z"))
    progress.assign_row(second, board_of(2))
    silent = BoardResult(
        board_of(2), 2.0, error=NodeSilentError('Gone, and "lost".'), row=2, time="2026-11-28T01:02:04Z"
    )
    progress.note(second, silent)
    progress.note(second, silent)
    progress.rows[1].steps = {"write": 0.25, "verify": 0.5}
    check_report(tmp_path / "day.CSV")
    write_report(tmp_path / "day.CSV", progress, ReportHead("s", "f", "o", "w"))
    assert (
        (tmp_path / "day.CSV").read_text()
        == f"""\
row,uuid,name,profile,result,tries,first_pass,seconds,time,message
1,8d4d9da65281f7000000,'=SUM(A1),load-cell,passed,1,true,1.235,2026-11-28T01:02:03Z,
2,{board_of(2).hex()},b,load-cell,failed,2,false,2.0,2026-11-28T01:02:04Z,"Gone, and ""lost""."
3,,c,load-cell,not reached,0,false,0.0,,

passed,1
failed,1
skipped,1
seconds,3.235
first_pass,0.5000
seconds of write,0.2500
seconds of verify,0.5000
"""
    )
    for sign in "=+-@":
        progress.sheet = read(station, tmp_path, f"uuid,name\n8d4d9da65281f7000000,{sign}SUM(A1)\n,b\n,c\n")
        write_report(tmp_path / "day.csv", progress, ReportHead("s", "f", "o", "w"))
        assert f",'{sign}SUM(A1)," in (tmp_path / "day.csv").read_text()
    with pytest.raises(UsageError, match=r"day\.pdf is neither CSV nor HTML"):
        check_report(tmp_path / "day.pdf")
    with pytest.raises(NotFoundError, match=r"There is no folder .*none for the report"):
        check_report(tmp_path / "none" / "day.html")
    check_report(None)


def test_a_board_that_was_declined_in_the_end_counts_as_none_that_was_tried(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\n"))
    first, second = progress.sheet.rows
    progress.note(first, BoardResult(board_of(1), 1.0, error=PolicyError("refused"), row=1))
    progress.note(first, BoardResult(board_of(1), 1.0, error=DeclinedError("no"), row=1))
    assert (progress.totals().first_pass, progress.totals().skipped) == (None, 2)
    progress.note(second, BoardResult(board_of(2), 1.0, row=2))
    totals = progress.totals()
    assert (totals.first_pass, totals.passed, totals.failed, totals.skipped) == (1.0, 1, 0, 1)
    assert isinstance(totals.error, PolicyError), "the worst of all boards, not the last one's"
    assert totals.worst is not None
    assert totals.worst.message == "refused"


def test_the_first_pass_yield_of_a_run_without_a_sheet_counts_the_first_try_of_each_board(station: Station) -> None:
    """A "no" counted as a try, and a board that was held there again as two boards."""
    run = BatchRun(station, LinkSettings("can"), ProvisionRequest(watch=True), SilentReporter())
    assert run.totals().first_pass is None
    run._note(BoardResult(board_of(1), 1.0, error=DeclinedError("no")))
    assert (run.totals().first_pass, run.totals().skipped) == (None, 1)
    for number, error in ((1, None), (2, PolicyError("refused")), (2, None), (3, None)):
        run._note(BoardResult(board_of(number), 1.0, error=error))
    totals = run.totals()
    assert (totals.first_pass, totals.passed, totals.failed, totals.skipped) == (0.6667, 3, 1, 1)


@pytest.mark.parametrize(
    ("request_", "links", "message"),
    [
        (
            ProvisionRequest(node="x", watch=True),
            LinkSettings(),
            "A single node cannot be combined with --all, --watch or",
        ),
        (ProvisionRequest(node="x", whole_bus=True), LinkSettings(), "A single node cannot be combined with --all"),
        (ProvisionRequest(node="x", sheet=Path("s")), LinkSettings(), "A single node cannot be combined with --all"),
        (
            ProvisionRequest(whole_bus=True, watch=True),
            LinkSettings(),
            "--all provisions the nodes that are on the bus now",
        ),
        (ProvisionRequest(report=Path("r.csv")), LinkSettings(), "--report requires a sheet."),
        (ProvisionRequest(whole_bus=True), LinkSettings("can", can=("a", "b")), "Several readers require --watch."),
        (ProvisionRequest(), LinkSettings(nfc=("a", "b")), "Several readers require --watch."),
    ],
)
def test_options_that_exclude_each_other_are_refused_before_anything(
    station: Station, request_: ProvisionRequest, links: LinkSettings, message: str
) -> None:
    with pytest.raises(UsageError) as refused:
        BatchRun(station, links, request_, SilentReporter())
    assert refused.value.message.startswith(message)
    BatchRun(station, LinkSettings(nfc=("a", "b")), ProvisionRequest(watch=True), SilentReporter())


@pytest.mark.parametrize(
    ("rows", "good"),
    [
        (f"{{one}},,a\n,{LABEL_KEY},b\n", True),
        (f"{{one}},,a\n,{LABEL_KEY},b\n,,c\n", False),
        (",,c\n{one},,a\n", False),
    ],
)
def test_on_a_bus_every_row_names_its_board(station: Station, tmp_path: Path, rows: str, good: bool) -> None:
    file = tmp_path / "boards.csv"
    file.write_text("uuid,fingerprint,name\n" + rows.format(one=board_of(1).hex()))
    request = ProvisionRequest(order=BuildOrder(profile="load-cell"), whole_bus=True, sheet=file)
    if good:
        assert len(BatchRun(station, LinkSettings("can"), request, SilentReporter())) == 2
        return
    with pytest.raises(UsageError, match="rows cannot follow the order of taps") as refused:
        BatchRun(station, LinkSettings("can"), request, SilentReporter())
    assert refused.value.hint == "Give each row its uuid or fingerprint."


def test_a_name_is_no_other_nodes_and_a_pattern_may_be_of_many_rows(station: Station, tmp_path: Path) -> None:
    station.nodes.put(NodeRecord(board_of(9), name="taken"))
    station.nodes.put(NodeRecord(board_of(1), name="own"))
    patterns = "name\nb-{uuid}\nb-{uuid}\nc-{n}\nc-{n}\n"
    assert len(read(station, tmp_path, patterns).rows) == 4
    (row,) = read(station, tmp_path, f"uuid,name\n{board_of(1).hex()},own\n").rows
    assert row.prepared.order.name == "own", "the board has it itself"
    with pytest.raises(BadDataError) as caught:
        read(station, tmp_path, f"uuid,name\n{board_of(1).hex()},taken\n")
    assert caught.value.message == f"boards.csv:2: node {board_of(9).hex()} already has the name 'taken'."


@pytest.mark.parametrize(
    ("mine", "others", "pattern", "name"),
    [
        (None, (), "cell {n}", "cell 1"),
        (None, ("cell 1", "cell 3"), "cell {n}", "cell 2"),
        ("cell 3", ("cell 1",), "cell {n}", "cell 3"),  # its own, though 2 is free
        ("cell 3", (), "joint {n}", "joint 1"),
        ("cell x", (), "cell {n}", "cell 1"),
        ("cell 3", (), "cell {n}{n}", "cell 11"),
        ("old", ("cell 1",), "cell {n} {uuid}", f"cell 1 {'01' * 10}"),
    ],
)
def test_a_node_keeps_its_number_and_a_new_one_gets_the_first_that_is_free(
    station: Station, mine: str | None, others: tuple[str, ...], pattern: str, name: str
) -> None:
    station.nodes.put(NodeRecord(board_of(1), name=mine))
    for number, other in enumerate(others, 2):
        station.nodes.put(NodeRecord(board_of(number), name=other))
    named = named_for(station, board_of(1), prepare(station, BuildOrder(profile="load-cell", name=pattern)))
    assert named.order.name == name


@pytest.mark.parametrize(
    ("keystore", "at_once"), [("file", 6), ("keyring", 6), ("pkcs11:token=x?module-path=/x.so", 1)]
)
def test_boards_of_a_bus_are_worked_on_one_at_a_time_if_a_token_holds_the_key(
    station: Station, monkeypatch: pytest.MonkeyPatch, keystore: str, at_once: int
) -> None:
    run = BatchRun(station, LinkSettings("can"), ProvisionRequest(whole_bus=True), SilentReporter())
    monkeypatch.setattr(type(station.identity), "keystore", keystore)
    assert run._at_once(SixAtOnce()) == at_once  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("calibrated", "missing"), [((), "1, 3"), ((1,), "3"), ((3,), "1"), ((2,), "1, 3"), ((1, 3), None)]
)
def test_a_board_that_lacks_a_calibration_of_any_channel_has_not_passed(
    station: Station, calibrated: tuple[int, ...], missing: str | None
) -> None:
    (station.home / "profiles").mkdir()
    required = "".join(f"[channel.{number}.calibration]\nrequired = true\n" for number in (1, 3))
    (station.home / "profiles" / "hand.toml").write_text(f'extends = "gripper"\n{required}')
    order = BuildOrder(profile="hand")
    run = BatchRun(station, LinkSettings("can"), ProvisionRequest(order=order, whole_bus=True), SilentReporter())
    error = run._lacks_calibration(board_of(1), Image(board_of(1), {(number, 5): b"x" for number in calibrated}))
    assert (error is None) == (missing is None)
    if error is not None:
        assert f"has no calibration of channel {missing}, which its type requires" in error.message


def test_a_calibration_lies_beside_the_sheet_and_may_be_of_one_channel_and_is_checked_before(
    station: Station, tmp_path: Path
) -> None:
    (tmp_path / "force.csv").write_text("raw,value [N]\n0,0\n65535,10\n")
    sheet = "name,profile,calibration\na,tactile-finger-sensor,2=force.csv\nb,tactile-finger-sensor,{second}\n"
    first, second = read(station, tmp_path, sheet.format(second=f"3={tmp_path / 'force.csv'}")).rows
    assert (first.prepared.order.calibration, first.prepared.order.channel) == (tmp_path / "force.csv", 2)
    found = [list(row.prepared.calibrations or {}) for row in (first, second)]
    assert found == [[2], [3]]
    with pytest.raises(BadDataError, match=r"boards\.csv:3: .*channels 1 to 12, not 13"):
        read(station, tmp_path, sheet.format(second="13=force.csv"))


def test_the_report_gives_the_reason_for_a_row_that_is_done_again(station: Station, tmp_path: Path) -> None:
    finished(station, tmp_path, "name\na\n")
    again = Progress(station.home, read(station, tmp_path, "name\nb\n"))
    (row,) = again.sheet.rows
    for error, message in (
        (None, "Provisioned again, because the sheet changed."),
        (NodeSilentError("It was pulled."), "Provisioned again, because the sheet changed. It was pulled."),
    ):
        again.note(row, BoardResult(board_of(1), 1.0, error=error, row=1))
        assert again.rows[1].message == message


@pytest.mark.parametrize(
    ("sheet", "listed", "said"),
    [
        (True, False, "is not in the sheet."),  # it said "not whitelisted", which adding it would not have helped
        (True, True, "is not in the sheet."),
        (False, False, "is not whitelisted."),
        (False, True, None),
    ],
)
def test_a_board_of_a_bus_that_is_not_meant_is_named_with_the_list_that_it_is_not_on(
    station: Station, tmp_path: Path, sheet: bool, listed: bool, said: str | None
) -> None:
    file = tmp_path / "boards.csv"
    file.write_text(f"uuid,name\n{board_of(1).hex()},left\n")
    there = Board(uuid=board_of(2))
    if listed:
        station.pins.put(WhitelistEntry(there.uuid, assurance="tap"))
    request = ProvisionRequest(order=BuildOrder(profile="load-cell"), whole_bus=True, sheet=file if sheet else None)
    run = BatchRun(station, LinkSettings("can"), request, SilentReporter())
    notices: list[str] = []
    station.notice = notices.append
    assert run._is_meant(contact(there)) == (said is None)
    assert notices == ([] if said is None else [f"Skipped: node {there.uuid.hex()} {said}"])


@pytest.mark.parametrize(
    ("order", "refused"),
    [
        (BuildOrder(), ""),
        (BuildOrder(profile="load-cell", item="i", drop_calibration=True), ""),
        (BuildOrder(name="cell {n}"), ""),
        (BuildOrder(name="cell {uuid}"), ""),
        (BuildOrder(name="cell"), "Every node would get the name 'cell'."),
        (BuildOrder(name="cell {m}"), "Every node would get the name 'cell {m}'."),
        (
            BuildOrder(calibration=Path("a.csv")),
            "Every node would get the calibration a.csv: it belongs to one sensor.",
        ),
    ],
)
def test_what_may_be_ordered_for_many_boards(order: BuildOrder, refused: str) -> None:
    if not refused:
        assert for_several(order) is order
        return
    with pytest.raises(UsageError) as error:
        for_several(order)
    assert error.value.message.startswith(refused)
    assert error.value.hint.endswith("list the boards in a sheet: --batch FILE.") or error.value.hint.startswith("List")


@pytest.mark.parametrize("more", [{"profile": "load-cell"}, {"calibration": Path("a.csv")}, {"drop_calibration": True}])
def test_what_a_board_brought_is_signed_as_it_is(station: Station, more: dict[str, Any]) -> None:
    with pytest.raises(UsageError, match="--adopt signs the datasheet that the board brought"):
        prepare(station, BuildOrder(adopt=True, **more))
    assert prepare(station, BuildOrder(adopt=True, name="a")).profile is None


def test_a_board_without_a_known_type_gets_nothing_that_is_named(station: Station, tmp_path: Path) -> None:
    uuid = board_of(1)
    assert prepare(station, BuildOrder(), uuid).profile is None, "the board itself may be finished"
    for order in (BuildOrder(name="a"), BuildOrder(drop_calibration=True)):
        with pytest.raises(UsageError, match=rf"^No profile is known for node {uuid.hex()}\.$"):
            prepare(station, order, uuid)
        assert prepare(station, order).profile is None, "any board may come"
    station.nodes.remember(uuid, profile="load-cell")
    prepared = prepare(station, BuildOrder(name="a"), uuid)
    assert prepared.profile is not None
    assert prepared.profile.name == "load-cell"
    with pytest.raises(NotFoundError, match=r"^There is no calibration file .*none\.csv\.$"):
        prepare(station, BuildOrder(calibration=tmp_path / "none.csv"))


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("a" * 120, ""),
        ("ä" * 60, ""),
        ("a" * 121, "A name has 1 to 120 octets of UTF-8, this one 121."),
        ("ä" * 61, "A name has 1 to 120 octets of UTF-8, this one 122."),
        ("", "A name has 1 to 120 octets of UTF-8, this one 0."),
        ("a\tb", "A name is one line of printable characters, not 'a\\tb'."),
        ("a\udcff", "The name of the node is not valid text."),
    ],
)
def test_a_name_fits_into_its_teds_and_is_shown_whole(name: str, message: str) -> None:
    if not message:
        check_name(name)
        return
    with pytest.raises((UsageError, BadDataError)) as refused:
        check_name(name)
    assert refused.value.message == message


def test_warnings_that_rows_share_are_one_with_all_their_numbers(station: Station, tmp_path: Path) -> None:
    cell = load_profile("load-cell")
    prepared = [
        PreparedOrder(BuildOrder(), cell if number > 2 else None, warnings=warnings)
        for number, warnings in enumerate((("old",), (), ("old", "late"), ("old",)), 1)
    ]
    rows = tuple(SheetRow(number, number + 1, None, None, one, "") for number, one in enumerate(prepared, 1))
    lacks = "the type requires a calibration, but the sheet gives none."
    assert BatchSheet(tmp_path, rows).warnings == ("Rows 1, 3, 4: old", "Row 3: late", f"Rows 3, 4: {lacks}")


def test_a_sheet_has_at_most_ten_thousand_rows(
    station: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert batch_sheet.MAX_ROWS == 10_000
    monkeypatch.setattr(batch_sheet, "MAX_ROWS", 3)
    lines = "".join(f",b{number}\n" for number in range(3))
    assert len(read(station, tmp_path, f"uuid,name\n{lines}\n").rows) == 3
    with pytest.raises(BadDataError, match=r"boards\.csv:5: there are more than 3 rows\."):
        read(station, tmp_path, f"uuid,name\n{lines},b\n,c\n,d\n")


@pytest.mark.parametrize("by_order", [True, False])
def test_a_row_in_the_order_of_taps_is_given_to_one_board_by_two_runs_of_a_sheet(
    station: Station, tmp_path: Path, by_order: bool
) -> None:
    sheet = read(station, tmp_path, "name\na\n" if by_order else f"fingerprint,name\n{'ab' * 32},a\n")
    (row,) = sheet.rows
    first, second = Progress(station.home, sheet), Progress(station.home, sheet)
    first.assign_row(row, board_of(1))
    if by_order:
        with pytest.raises(NodeBusyError) as refused:
            second.assign_row(row, board_of(2))
        assert refused.value.message == f"Row 1 was assigned to board {board_of(1).hex()} by another run of this sheet."
        assert refused.value.hint == "Tap this board again to use the next row."
        assert second.board_of(row) == board_of(1).hex()
    else:
        second.assign_row(row, board_of(2))
        assert Progress(station.home, sheet).board_of(row) == board_of(2).hex(), "the one with that key"


def test_a_sheet_is_the_same_one_by_whatever_path_it_is_named(station: Station, tmp_path: Path) -> None:
    sheet = read(station, tmp_path, "name\na\n")
    (tmp_path / "link").symlink_to(tmp_path)
    Progress(station.home, sheet).assign_row(sheet.rows[0], board_of(1))
    again = Progress(station.home, replace(sheet, path=tmp_path / "link" / sheet.path.name))
    assert again.board_of(sheet.rows[0]) == board_of(1).hex()
