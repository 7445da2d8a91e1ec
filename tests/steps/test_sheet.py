"""The sheet of a batch: what is wrong with it, and what a person should know of it, told before the first board."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.errors import BadData, NodeSilent, NoNode
from teds_provision.station.station import Station
from teds_provision.steps.build_order import BuildOrder
from teds_provision.steps.many.board import Board
from teds_provision.steps.many.progress import Progress
from teds_provision.steps.many.report import write_report
from teds_provision.steps.many.sheet import Sheet, read_sheet


def read(station: Station, folder: Path, text: str | bytes) -> Sheet:
    file = folder / "boards.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_sheet(station, file, BuildOrder(profile="load-cell"))


def test_a_mistake_of_many_lines_is_told_once_with_all_of_them(station: Station, tmp_path: Path) -> None:
    rows = "".join(f",b{number},none.csv\n" for number in range(30))
    with pytest.raises(BadData) as told:
        read(station, tmp_path, f"uuid,name,calibration\n{rows}")
    assert told.value.message.count("There is no calibration file") == 1
    assert told.value.message.startswith("boards.csv:2, 3, 4, ")
    assert "and 10 more: There is no" in told.value.message


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_spreadsheet_separates_by_comma_semicolon_or_tab(station: Station, tmp_path: Path, delimiter: str) -> None:
    sheet = read(station, tmp_path, f"\ufeffuuid{delimiter}name\r\n{delimiter}left knee\r\n")
    assert [row.prepared.order.name for row in sheet.rows] == ["left knee"]


def test_a_sheet_that_is_not_utf8_is_told_with_the_line_and_the_cure(station: Station, tmp_path: Path) -> None:
    with pytest.raises(BadData, match=r"boards.csv:3: it is not UTF-8 .*CSV UTF-8"):
        read(station, tmp_path, b"uuid,name\n,a\n,caf\xe9\n,b\n,c\n")


def test_rows_without_the_calibration_that_their_type_asks_for_are_told_before_the_tap(
    station: Station, tmp_path: Path
) -> None:
    (tmp_path / "cal.csv").write_text("# date: 2026-11-20\nraw,value [N]\n4194304,-500\n12582912,500\n")
    sheet = read(station, tmp_path, "name,calibration,profile\na,,\nb,cal.csv,\nc,,\nd,,limit-switch\n")
    assert [warning for warning in sheet.warnings if "type asks for" in warning] == [
        "Rows 1, 3: the type asks for a calibration, and none is named."
    ]


def test_a_name_is_one_line(station: Station, tmp_path: Path) -> None:
    with pytest.raises(BadData, match="one line of printable characters"):
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
    with pytest.raises(BadData, match="and the label in"):
        read(station, tmp_path, f"{columns}\n{label},a,{'ab' * (len(same) // 2)}\n")


def test_a_batch_to_which_no_board_came_says_so(station: Station, tmp_path: Path) -> None:
    """It said "0 passed, 0 failed, 2 skipped", and not why."""
    progress = Progress(station.home, read(station, tmp_path, "name\na\nb\n"))
    progress.ran_out(30)
    error = progress.totals().error
    assert isinstance(error, NoNode)
    assert error.message == "0 passed, 0 failed, 2 skipped. No board came within 30 s for row 1, 2."


def test_the_report_for_people_says_yield_and_leaves_out_what_was_not_reached(station: Station, tmp_path: Path) -> None:
    progress = Progress(station.home, read(station, tmp_path, "name\n<b>\nb\n"))
    progress.take(progress.sheet.rows[0], bytes(10))
    progress.note(progress.sheet.rows[0], Board(bytes(10), 1.23, error=NodeSilent("It is <silent>."), row=1))
    write_report(tmp_path / "day.html", progress)
    text = (tmp_path / "day.html").read_text()
    assert "<th>first-pass yield</th><td>0.0%</td>" in text
    assert "<th>skipped or not reached</th><td>1</td>" in text
    assert "&lt;b&gt;" in text
    assert "It is &lt;silent&gt;." in text
    assert "<td>not reached</td><td>0</td><td></td><td></td><td></td><td></td></tr>" in text
    write_report(tmp_path / "day.csv", progress)
    assert "first_pass,0.0000" in (tmp_path / "day.csv").read_text()
