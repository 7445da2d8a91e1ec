"""The page on a full disk: it says what is not recorded, and since when; measuring goes on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.measure.test_full_disk import SmallDisk, fill
from tests.page.lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system


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
