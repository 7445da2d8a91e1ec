"""The line on the page: how far a job is, and how each of its stations does."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from teds_provision.errors import NodeSilentError
from teds_provision.plant.jobs import take_job
from tests.bench import MemoryLink
from tests.e2e.desk import Desk
from tests.plant.owner import alone, job_of, join, member, roster_of
from tests.plant.stations import certified
from tests.plant.test_jobs import build, line_of, make_board

from .lab import Lab, opened

if TYPE_CHECKING:
    from pathlib import Path

    from playwright.sync_api import Browser

pytestmark = pytest.mark.system
EAST = "east"


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Lab]:
    """A service at a line: of a job for five boards here three passed, one at its second attempt, and east did none."""
    (tmp_path / "desk").mkdir()
    home = tmp_path / "prepared" / "owner"
    station = alone(home)
    east = certified(tmp_path / EAST, EAST, station)
    members = (member(station, "owner", "keeper", "line", "sign"), member(east, EAST, "line"))
    assert station.plant.roster is not None
    join(station, roster_of(station, *members, version=2, previous=station.plant.roster.hash))
    allotted = {station.identity.fingerprint: 5, east.identity.fingerprint: 3}
    run = line_of(station, count=8, stations=allotted)
    board = make_board(1)
    with pytest.raises(NodeSilentError):
        build(run, board, MemoryLink(board, lose_request=4))
    for number in (1, 2, 3):
        build(run, board if number == 1 else make_board(number))
    take_job(station, job_of(station, title="<b>later</b>"))
    station.close()
    east.close()
    desk = Desk(tmp_path / "desk", tmp_path / "prepared")
    lab = Lab(tmp_path, desk, desk.station("owner"))
    lab.run()
    yield lab
    desk.clear()


def test_a_job_shows_its_yield_its_seconds_and_its_failures(browser: Browser, line: Lab, tmp_path: Path) -> None:
    with client.connect(home=line.station.home) as asked:
        jobs = sorted(asked.request("GET", "/jobs")["jobs"], key=lambda item: -item["units"])
        assert [(job["title"], job["units"], job["passed"], job["total"]) for job in jobs] == [
            ("three angles", 3, 3, 8),
            ("<b>later</b>", 0, 0, 3),
        ]
        job = asked.request("GET", f"/jobs/{jobs[0]['id'][:8]}")
        parts = {station["name"]: station for station in job["stations"]}
        assert parts["owner"]["first_pass"] == pytest.approx(2 / 3, abs=1e-3)
        assert parts["owner"]["failures"] == {"node-silent": 1}
        assert (parts[EAST]["units"], parts[EAST]["first_pass"]) == (0, None)
        with pytest.raises(client.ApiError) as refused:
            asked.request("GET", "/jobs/ffff")
        assert refused.value.exit_code == 3
    with opened(browser, line, route="station") as page:
        panel = page.get_by_role("region", name="Line")
        panel.get_by_text("three angles").click()
        assert "3 of 8 passed here" in panel.inner_text()
        own = panel.get_by_role("region", name="owner, three angles")
        own.wait_for()
        bars = own.locator("dt", has_text="first pass").locator("+ dd")
        assert "66.7 %" in bars.inner_text()
        share = bars.evaluate("one => one.querySelector('i').offsetWidth / one.querySelector('.share').clientWidth")
        assert share == pytest.approx(2 / 5, abs=0.02), "of the boards that this station may build"
        assert "node-silent" in own.get_by_role("group", name="Failures").inner_text()
        steps = own.get_by_role("group", name="Seconds, median and worst").inner_text()
        assert all(step in steps for step in ("agree", "sign", "write", "verify"))
        assert "No attempts yet." in panel.get_by_role("region", name=f"{EAST}, three angles").inner_text()
        assert panel.get_by_text("<b>later</b>").count() == 1
        assert own.locator(".share").first.evaluate("one => one.clientHeight") == 10
        assert page.get_by_text("No link is configured").is_hidden()
        page.screenshot(path=tmp_path / "line.png", full_page=True)
        page.set_viewport_size({"width": 360, "height": 800})
        assert page.evaluate("document.documentElement.scrollWidth <= 360")
        page.screenshot(path=tmp_path / "line-360.png", full_page=True)
