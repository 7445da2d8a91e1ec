"""The page on a full disk: it says what is not recorded, and since when; measuring goes on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.measure.test_full_disk import SmallDisk, fill
from tests.page.lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Route

pytestmark = pytest.mark.system


def test_a_sink_that_waits_for_room_is_shown_with_what_the_service_says_of_it(browser: Browser, lab: Lab) -> None:
    waiting = "The disk is full since 2026-11-22T10:00:00Z; 7 values are not recorded."

    def fulfil(route: Route) -> None:
        answer = route.fetch()
        sink = {"name": "run.csv", "measurement": "run", "recorder": True, "written": 5, "dropped": 7, "error": ""}
        route.fulfill(
            response=answer, json={**answer.json(), "sinks": [{**sink, "state": "waiting", "detail": waiting}]}
        )

    with opened(browser, lab) as page:
        page.route("**/api/v1/status", fulfil)
        page.goto(f"{lab.url}/#/station")
        page.reload()
        shown = page.get_by_role("region", name="Where values go").get_by_role("listitem")
        shown.get_by_text("5 values written, 7 dropped").wait_for()
        shown.get_by_text("waiting", exact=True).wait_for()
        shown.get_by_text(waiting).wait_for()


@pytest.mark.nightly(
    "tests/page/test_full_disk.py::test_a_sink_that_waits_for_room_is_shown_with_what_the_service_says_of_it; what the "
    "service says: tests/measure/test_full_disk.py::test_the_daemon_begins_a_new_part_when_there_is_room_again"
)
def test_a_full_disk_is_reported_with_its_time_and_so_is_what_was_not_recorded(
    browser: Browser, fresh: Lab, tmp_path: Path
) -> None:
    disk = SmallDisk(tmp_path / "disk")
    fresh.run("--record", disk.folder, program=disk.program)
    fresh.create("arm", "accelerometer")
    fresh.power("arm")
    fresh.ask("provision", "--profile", "accelerometer", "--name", "arm", "--via", "can", "--can", fresh.can, "--yes")
    assert fresh.daemon is not None
    folder = disk.seen_by(fresh.daemon)
    with opened(browser, fresh, route="station") as page:
        fresh.measure("arm")
        page.get_by_text(re.compile(r"\d+ values written, 0 dropped")).wait_for()
        fill(folder)
        page.get_by_text(re.compile("The disk is full since")).wait_for()
        page.get_by_text("waiting", exact=True).wait_for()
        (folder / "ballast").unlink()
        page.get_by_text(re.compile(r"[1-9]\d* values are not recorded")).wait_for()
