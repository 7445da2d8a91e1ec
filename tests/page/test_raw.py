"""A sensor that nobody has calibrated: its raw numbers in list, table and plot, marked as such, until it is."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from tests.e2e.desk import ANGLE
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system
DRAWN = """async (key) => {
  const { state } = await import(new URL("js/state.js", document.baseURI));
  const ring = state.rings.get(key);
  return ring ? Array.from(ring.value.slice(0, ring.held)).filter((value) => !Number.isNaN(value)) : [];
}"""
RAW, VALUE = re.compile(r"^\d+ raw$"), re.compile(r"^\d+\.\d+$")


def drawn(page: Page, uuid: str) -> list[float]:
    """Return what the plot has of the channel."""
    return [float(value) for value in page.evaluate(DRAWN, f"{uuid}/1")]


def test_raw_numbers_are_shown_marked_until_there_is_a_calibration(browser: Browser, fresh: Lab) -> None:
    """Nothing on the page showed that such a sensor gives anything at all."""
    node = fresh.create("bare", ANGLE)
    fresh.power("bare")
    where = ["--can", f"{fresh.can}&node=0x{node.flash['can_address']:02X}"]
    fresh.station.ask("provision", "--profile", ANGLE, "--name", "bare", "--via", "can", *where, "--yes")
    fresh.run()
    uuid = node.uuid
    with opened(browser, fresh, route=f"nodes/{uuid}/live", width=1600) as page:
        page.get_by_label("Rate, Hz").fill("20")
        page.get_by_role("button", name="Measure", exact=True).click()
        page.locator("tr .figure").filter(has_text=RAW).wait_for()
        assert page.locator("tr .value .unit").is_hidden(), "it is no angle"
        assert "calibration" in (page.locator("tr .figure").get_attribute("title") or "")
        page.locator(".card .peek b").filter(has_text=RAW).wait_for()
        page.locator("figcaption .unit", has_text="raw, not calibrated").wait_for()
        page.locator(".legend .figure").filter(has_text=RAW).wait_for()
        until(lambda: len(drawn(page, uuid)) > 10)
        assert max(drawn(page, uuid)) > 360, "raw numbers, not degrees"
        page.get_by_text(re.compile(r"\d+ samples, (none|\d+) lost,.* \d+ invalid\.")).wait_for()
        text = page.locator(".mode .state").inner_text()
        assert len(re.findall("calibrat", text)) == 1, "one explanation"
        with opened(browser, fresh, route=f"nodes/{uuid}/live", width=360) as after:
            after.locator("tr .figure").filter(has_text=RAW).wait_for()
            until(lambda: len(drawn(after, uuid)) > 20, "what was measured before it was opened")
            assert max(drawn(after, uuid)) > 360
            assert after.evaluate("document.documentElement.scrollWidth <= innerWidth")
            with client.connect(home=fresh.station.home) as station:
                past = station.past(uuid, 1)
                assert [part.get("raw") for part in past["segments"]] == [True]
                station.end_measurement(station.measurements()[0]["id"])
                fresh.provision("bare", ANGLE)
                until(lambda: station.node(uuid)["channels"][0]["problem"] is None)
                station.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})
            for shown in (page, after):
                shown.locator("tr .figure").filter(has_text=VALUE).wait_for()
                shown.locator("figcaption .unit", has_text="°").wait_for()
                until(lambda tab=shown: drawn(tab, uuid))
                assert max(drawn(shown, uuid)) < 7, "radians: no raw number is among them"
