"""The rate that the page proposes: before a measurement, and while one loses values."""

from __future__ import annotations

import re
import signal
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from tests.bench import PASSPHRASE
from tests.e2e.desk import ANGLE
from tests.measure.rig import FAULTY
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system


def offered(page: Page, words: str) -> float:
    """Return the rate on the button beside these words, Hz."""
    hint = page.locator(".rate-hint", has_text=words)
    hint.wait_for()
    found = re.search(r"([\d.]+) (k?Hz)$", hint.get_by_role("button").inner_text())
    assert found is not None
    return float(found[1]) * (1000 if found[2] == "kHz" else 1)


@pytest.mark.parametrize(
    "width",
    [
        360,
        pytest.param(
            1600,
            marks=pytest.mark.nightly(
                "tests/page/test_rates.py::test_a_rate_that_can_be_carried_is_a_preset_and_a_lower_one_after_losses[360]"
                ": the same ways on a narrow screen; tests/page/test_access.py looks at the views at both widths"
            ),
        ),
    ],
)
def test_a_rate_that_can_be_carried_is_a_preset_and_a_lower_one_after_losses(
    browser: Browser, fresh: Lab, width: int
) -> None:
    """Start at the datasheet's 10 kHz lost thousands of values, and nothing said what to do."""
    node = fresh.create("slew", ANGLE)
    power = fresh.power("slew")
    fresh.provision("slew", ANGLE)
    power.signal(signal.SIGTERM)
    power.end()
    fresh.desk.start(fresh.can, f"gaps={node.folder}", program=FAULTY).wait_for('"ready": true')
    words = ["--home", fresh.station.home, "--json", "ncap", "run", "--http", f"127.0.0.1:{fresh.port}"]
    narrow = f"{fresh.can}&bitrate=20000&data_bitrate=20000"  # or the machine is busy: one of the two is slower
    fresh.daemon = fresh.desk.start(*words, "--can", narrow, passphrase=PASSPHRASE)
    fresh.daemon.wait_for('"ready": true')
    with client.connect(home=fresh.station.home) as station:
        until(lambda: station.node(node.uuid)["present"])
        station.request("POST", "/groups", {"name": "crane", "uuids": [node.uuid]})
        with opened(browser, fresh, width=width, route="measure") as page:
            card = page.locator("li.group", has=page.get_by_role("heading", name="crane"))
            rate = offered(page, "Values may be lost at the datasheet's 10 kHz")
            assert rate < 10_000
            card.locator(".rate-hint").get_by_role("button").focus()
            page.keyboard.press("Enter")
            assert 0 < float(card.get_by_label("Rate, Hz").input_value()) < 10_000
            card.get_by_label("Rate, Hz").fill("20")
            page.get_by_role("button", name="Start crane").click()
            lower = offered(page, "Values are being lost at this rate")
            assert lower <= 10
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
            card.locator(".rate-hint").get_by_role("button").click()
            until(
                lambda: [measurement for measurement in station.measurements() if measurement["rate"] <= lower],
                "or lower by now",
            )
            card.get_by_text(re.compile("running")).first.wait_for()
            with opened(browser, fresh, width=width, route=f"nodes/{node.uuid}/live") as after:
                after.get_by_text("Stop it there").wait_for()
                after.locator(".rate-hint").wait_for(state="hidden")  # the group's card is the place
