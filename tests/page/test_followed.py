"""The page follows what happens elsewhere: a measurement that ends, a node that goes, a service that gets a link."""

from __future__ import annotations

import json
import re
import signal
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from tests.bench import PASSPHRASE
from tests.e2e.desk import ANGLE
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import APIResponse, Browser, Page, Route

pytestmark = pytest.mark.system


def test_a_node_is_free_as_soon_as_the_command_that_measured_it_ends(browser: Browser, lab: Lab) -> None:
    """The page went on to say "Measured as part of group crane", and locked Provision and Write."""
    uuid = lab.nodes["slew"].uuid
    with lab.visited(), client.connect(home=lab.station.home) as station:
        station.request("POST", "/groups", {"name": "crane", "uuids": [uuid]})
        where = ["--can", lab.can, "--rate", 20]
        command = lab.desk.start(
            "--home", lab.station.home, "--json", "measure", "crane", *where, passphrase=PASSPHRASE
        )
        command.wait_for('"event":"data"')
        with opened(browser, lab, route=f"nodes/{uuid}/provision") as page:
            page.get_by_text(f"in group crane by the command measure (process {command.process.pid})").wait_for()
            assert page.get_by_role("button", name="Provision", exact=True).is_disabled()
            with opened(browser, lab, route="measure") as other:
                card = other.locator("li.group", has=other.get_by_role("heading", name="crane"))
                card.get_by_text("End it there with Ctrl-C").wait_for()
                assert card.get_by_role("button", name="Stop crane").is_disabled(), "only the command can end it"
                command.signal(signal.SIGINT)
                assert command.end().code == 0
                card.get_by_role("button", name="Start crane").wait_for()
            page.wait_for_function("button => !button.disabled", arg=button(page, "Provision"))
            page.get_by_role("link", name="Live", exact=True).click()
            page.locator(".mode .state", has_text="Idle.").wait_for()
            page.goto(f"{lab.url}/#/nodes/{uuid}/provision")
            page.reload()
            page.wait_for_function("button => !button.disabled", arg=button(page, "Provision"))


def button(page: Page, name: str) -> object:
    return page.get_by_role("button", name=name, exact=True).element_handle()


def test_an_earlier_status_begins_no_measurement_again(browser: Browser, lab: Lab) -> None:
    """A status that was on its way while a measurement ended brought it back until the next one."""
    uuid = lab.nodes["slew"].uuid
    held: list[tuple[Route, APIResponse]] = []

    def keep(route: Route) -> None:
        if held:
            route.continue_()
        else:
            held.append((route, route.fetch()))

    with lab.visited(), opened(browser, lab, route=f"nodes/{uuid}/live") as page:
        lab.measure("slew", rate=20)
        page.get_by_role("button", name="Measure", pressed=True).wait_for()
        page.route("**/api/v1/status", keep)
        while not held:
            page.wait_for_timeout(20)
        page.get_by_role("button", name="Idle").click()
        page.locator(".mode .state", has_text="Idle.").wait_for()
        [(route, answer)] = held
        assert answer.json()["measurements"], "it is from before the end"
        page.evaluate(
            """() => { window.seen = []; new MutationObserver(() => window.seen.push(document.body.textContent))
                .observe(document.querySelector(".mode"), { subtree: true, childList: true, characterData: true }); }"""
        )
        route.fulfill(response=answer)
        with page.expect_response("**/api/v1/status"):
            pass
        page.wait_for_timeout(100)
        assert page.get_by_role("button", name="Idle", pressed=True).is_visible()
        assert not page.evaluate("window.seen.some((words) => words.includes('running'))")


def test_an_absent_nodes_verdict_is_grey_and_has_its_date(browser: Browser, fresh: Lab) -> None:
    fresh.create("slew", ANGLE)
    power = fresh.power("slew")
    fresh.provision("slew", ANGLE)
    fresh.run()
    with opened(browser, fresh) as page, client.connect(home=fresh.station.home) as station:
        chip = page.locator(".card .chip").first
        chip.get_by_text("Authentic", exact=True).wait_for()
        assert "good" in (chip.get_attribute("class") or "")
        power.signal(signal.SIGTERM)
        power.end()
        station.request("PUT", "/detection", {"mode": "transparent"})  # looks at every link: it is gone
        for place in (page.locator(".card .chip").first, page.locator(".node-facts .chip").first):
            place.get_by_text(re.compile(r"^Authentic at \d\d:\d\d:\d\d$")).wait_for()
            assert "good" not in (place.get_attribute("class") or "")
        assert "not connected now" in (chip.get_attribute("title") or "")
        station.request("PUT", "/detection", {"mode": "whitelist"})
        fresh.board = None
        fresh.power("slew")
        chip.get_by_text("Authentic", exact=True).wait_for()


def test_a_service_without_a_link_says_how_to_add_one_until_it_has_one(browser: Browser, fresh: Lab) -> None:
    words = ["--home", fresh.station.home, "--json", "ncap", "run", "--http", f"127.0.0.1:{fresh.port}"]
    fresh.daemon = fresh.desk.start(*words, passphrase=PASSPHRASE)
    fresh.daemon.wait_for('"ready": true')
    message = "No link is configured"
    with opened(browser, fresh) as page:
        for width in (360, 1600):
            page.set_viewport_size({"width": width, "height": 900})
            page.locator("p:visible", has_text=message).get_by_text("teds-provision ncap run --can").wait_for()
            assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        page.goto(f"{fresh.url}/#/station")
        page.get_by_label("Links").get_by_text(message).wait_for()
        with client.connect(home=fresh.station.home) as station:
            station.request("POST", "/virtual", {"profile": ANGLE, "name": "lone"})
        page.goto(f"{fresh.url}/#/nodes")
        page.locator(".card", has_text="lone").wait_for()
        page.locator(".side").get_by_text(message).wait_for()  # their bus reaches no board
        fresh.end()
        fresh.run()
        page.locator("#connection", has_text="Live").wait_for()
        page.locator(".side").get_by_text(message).wait_for(state="hidden")
        page.reload()
        page.locator(".card", has_text="lone").wait_for()
        assert page.locator("p:visible", has_text=message).count() == 0


WIDE = pytest.mark.nightly(
    "tests/page/test_followed.py::test_long_names_fit_the_window[360]: what fits the narrow window fits the wide one"
)


@pytest.mark.parametrize("width", [360, pytest.param(1600, marks=WIDE)])
def test_long_names_fit_the_window(browser: Browser, lab: Lab, width: int) -> None:
    """A file of 75 letters pushed the buttons out of the window."""
    uuid, name = lab.nodes["hand"].uuid, "run" * 25
    with lab.visited(), opened(browser, lab, width=width) as page, client.connect(home=lab.station.home) as station:
        station.request("POST", "/groups", {"name": "g" * 60, "uuids": [uuid]})
        station.request("POST", "/measurements", {"group": "g" * 60, "rate": 20, "sinks": [f"{name}.csv"]})
        until(lambda: [measurement["state"] for measurement in station.measurements()] == ["running"])
        for view, words in (("station", name), ("measure", "g" * 60), (f"nodes/{uuid}/live", "g" * 60)):
            page.goto(f"{lab.url}/#/{view}")
            page.get_by_text(words).locator("visible=true").first.wait_for()
            wide = page.evaluate("[document.documentElement.scrollWidth, innerWidth]")
            assert wide[0] <= wide[1], (view, wide)
        page.goto(f"{lab.url}/#/nodes/{uuid}/datasheet")
        station.end_measurement(station.measurements()[0]["id"])
        page.wait_for_function("input => !input.disabled", arg=page.locator("input[type=file]").element_handle())
        sheet = json.dumps(station.request("GET", f"/nodes/{uuid}/teds?format=json"))
        page.locator("input[type=file]").set_input_files(
            {"name": f"{name}.json", "mimeType": "application/json", "buffer": sheet.encode()}
        )
        page.get_by_text(name).locator("visible=true").first.wait_for()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
