"""A virtual transducer is fed from the page: by sliders, by keyboard, by one page at a time, again after a restart."""

from __future__ import annotations

import signal
from typing import TYPE_CHECKING, Any

import pytest

from teds_provision import client
from tests.pace import until

from .lab import Lab, opened
from .test_access import violations

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system


def opening(station: client.Client, uuid: str) -> Any:
    """Return the last value of the gripper's opening in mm, None if it is not valid."""
    last = station.node(uuid)["channels"][1]["last"]
    return None if last is None or last["value"] is None else round(1000 * last["value"], 1)


def await_start(lab: Lab) -> str:
    """Wait until the one virtual transducer runs: a page that feeds it while it starts is refused after ten seconds."""
    with client.connect(home=lab.station.home) as station:
        [made] = until(
            lambda: [
                virtual for virtual in station.request("GET", "/virtual")["virtual"] if virtual["state"] == "running"
            ]
        )
    return str(made["uuid"])


@pytest.mark.parametrize(
    "width",
    [
        360,
        pytest.param(
            1600,
            marks=pytest.mark.nightly(
                "tests/page/test_simulation.py::test_values_are_set_by_keyboard_and_one_page_has_the_place[360]"
                ": the same ways on a narrow screen; tests/page/test_access.py looks at the views at both widths"
            ),
        ),
    ],
)
def test_values_are_set_by_keyboard_and_one_page_has_the_place(browser: Browser, lab: Lab, width: int) -> None:
    with lab.visited(), opened(browser, lab, width=width, route="virtual") as page:
        page.get_by_label("Transducer type").select_option("gripper")
        page.get_by_label("Name", exact=True).fill("dummy")
        page.get_by_label("Value source").select_option("simulation")
        page.get_by_role("button", name="Create").click()
        card = page.locator("li.group", has=page.get_by_role("link", name="dummy"))
        card.get_by_text("Nothing feeds it").wait_for()
        with client.connect(home=lab.station.home) as station:
            [made] = station.request("GET", "/virtual")["virtual"]
            uuid = made["uuid"]
            try:
                until(lambda: (station.node(uuid)["verdict"] or {}).get("verdict") == "authentic")
                station.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})
                card.get_by_role("button", name="Set values of dummy").focus()
                page.keyboard.press("Enter")
                card.get_by_text("Values are set on this page").wait_for()
                page.wait_for_function("document.activeElement.type === 'number'")
                page.keyboard.press("Control+a")
                page.keyboard.type("0.02")
                until(lambda: opening(station, uuid) == 20.0)
                page.keyboard.press("Tab")
                page.keyboard.press("End")  # the slider, at its highest
                until(lambda: opening(station, uuid) == 110.0)
                page.keyboard.press("Tab")
                page.keyboard.press("Space")  # no value
                until(lambda: opening(station, uuid) is None)
                assert violations(page) == []
                assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
                with opened(browser, lab, width=width, route="virtual") as other:
                    there = other.locator("li.group", has=other.get_by_role("link", name="dummy"))
                    there.get_by_text("Fed by another page since").wait_for()
                    assert there.get_by_role("button", name="Set values of dummy").is_disabled()
                    card.get_by_role("button", name="Stop setting values of dummy").click()
                    there.get_by_text("Nothing feeds it").wait_for()
                    there.get_by_role("button", name="Set values of dummy").click()
                    there.get_by_text("Values are set on this page").wait_for()
                    card.get_by_text("Fed by another page since").wait_for()
                    until(lambda: opening(station, uuid) == 55.0)
                card.get_by_text("Nothing feeds it").wait_for()  # that page was closed
                until(lambda: opening(station, uuid) is None)
                with opened(browser, lab, width=width, route="virtual", read_only=True) as reader:
                    there = reader.locator("li.group", has=reader.get_by_role("link", name="dummy"))
                    until(there.get_by_role("button", name="Set values of dummy").is_disabled)
            finally:
                for measurement in station.measurements():
                    station.end_measurement(measurement["id"])
                station.request("DELETE", f"/virtual/{uuid}")
        card.wait_for(state="detached")


def test_a_page_feeds_on_after_the_service_came_back(browser: Browser, fresh: Lab) -> None:
    fresh.run()
    with client.connect(home=fresh.station.home) as station:
        station.request("POST", "/virtual", {"profile": "gripper", "name": "dummy", "source": "simulation"})
    uuid = await_start(fresh)
    with opened(browser, fresh, route="virtual") as page:
        button = page.get_by_role("button", name="Set values of dummy")
        button.click()
        page.get_by_text("Values are set on this page").first.wait_for()
        fresh.end(signal.SIGKILL)
        page.get_by_role("alert").filter(has_text="no longer valid").wait_for()
        fresh.run()
        await_start(fresh)
        page.get_by_text("Nothing feeds it").wait_for()
        button.click()
        page.get_by_text("Values are set on this page").first.wait_for()
        with client.connect(home=fresh.station.home) as station:
            until(lambda: (station.node(uuid)["verdict"] or {}).get("verdict") == "authentic")
            station.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})
            until(lambda: opening(station, uuid) == 55.0)
