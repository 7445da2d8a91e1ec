"""The report of a batch on paper: A4 lying, no word torn apart, nothing beyond the edge."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision.errors import NodeSilentError
from teds_provision.provisioning.batch_sheet import BoardResult, Progress, ReportHead, read_sheet, write_report
from teds_provision.provisioning.build import BuildOrder
from teds_provision.station.station import Station

if TYPE_CHECKING:
    from playwright.sync_api import Browser

A4_LYING = round((297 - 2 * 12) / 25.4 * 96)  # CSS pixels between margins of 12 mm
TORN = """() => [...document.querySelectorAll("table:last-of-type td, table:last-of-type th")]
  .filter((cell) => ![2, 9].includes(cell.cellIndex))
  .flatMap((cell) => {
    const range = document.createRange();
    return (cell.textContent.match(/[^\\s-]+/g) ?? []).filter((word) => {
      const at = cell.firstChild.data.indexOf(word);
      range.setStart(cell.firstChild, at);
      range.setEnd(cell.firstChild, at + word.length);
      return range.getClientRects().length > 1;
    });
  })"""


def test_it_fits_a4_and_tears_no_word_apart(browser: Browser, station: Station, tmp_path: Path) -> None:
    names = ["crane north boom joint 1 angle", "W" * 60, "slew"]
    (tmp_path / "boards.csv").write_text(
        "profile,name\n" + "".join(f"magnetic-angular-position-sensor,{name}\n" for name in names)
    )
    progress = Progress(station.home, read_sheet(station, tmp_path / "boards.csv", BuildOrder(profile="load-cell")))
    for number, row in enumerate(progress.sheet.rows, 1):
        uuid = bytes([number]) * 10
        progress.assign_row(row, uuid)
        why = NodeSilentError(
            "Node 8d4d did not answer on udp_multicast:239.74.163.2?port=43113 within 3 s.", hint="x" * 80
        )
        progress.note(row, BoardResult(uuid, 4.2, error=why if number == 2 else None, row=number))
    about = ReportHead("bench north", "ab12cd34" * 8, "Ada Lovelace", "teds-provision 0.2.0, Python 3.11.7")
    write_report(tmp_path / "day.html", progress, about)
    page = browser.new_page(viewport={"width": A4_LYING, "height": 700})
    try:
        page.emulate_media(media="print")
        page.set_content((tmp_path / "day.html").read_text())
        assert page.evaluate("document.documentElement.scrollWidth") <= A4_LYING
        assert page.evaluate(TORN) == []
    finally:
        page.close()
