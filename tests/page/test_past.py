"""The past of a channel on the page: it outlives a reload, is looked at closely, and says what a node went through."""

from __future__ import annotations

import json
import re
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, Route

pytestmark = pytest.mark.system
OLDEST = """async (key) => {
  const { state, now } = await import(new URL("js/state.js", document.baseURI));
  const ring = state.rings.get(key);
  return ring?.held ? now() - ring.time[(ring.next + ring.size - ring.held) % ring.size] : 0;
}"""


def age(page: Page, key: str) -> float:
    """Return seconds since the oldest point that the page draws of a channel."""
    return float(page.evaluate(OLDEST, key))


def test_a_reload_loses_nothing_and_a_stretch_is_looked_at_closely(browser: Browser, lab: Lab) -> None:
    uuid = lab.nodes["hand"].uuid
    lab.measure("hand", rate=20)
    with opened(browser, lab, route=f"nodes/{uuid}/live") as page:
        until(lambda: age(page, f"{uuid}/2") > 2)
        page.reload()
        until(lambda: age(page, f"{uuid}/2") > 2, "what was measured before the reload is gone")
        page.locator(".rate").filter(has_text=re.compile(r"^(19|20)(\.\d)? Hz$")).first.wait_for()
        with client.connect(home=lab.station.home) as station:
            lost = station.measurements()[0]["nodes"][0]["lost"]
            assert sum(station.past(uuid, 2, points=3600)["lost"]) == pytest.approx(lost, abs=20), "as the report says"
        page.get_by_role("button", name="1 h").click()
        plot = page.locator(".canvas").first
        plot.scroll_into_view_if_needed()
        box = plot.bounding_box()
        assert box is not None
        page.mouse.move(box["x"] + box["width"] - 60, box["y"] + 80)
        page.locator(".when", has_text=re.compile(r"^at \d\d:\d\d:\d\d")).first.wait_for()
        page.get_by_role("button", name="10 s", exact=True).click()
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 80)
        page.mouse.down()
        page.mouse.move(box["x"] + box["width"] / 2 + 120, box["y"] + 80, steps=4)
        page.mouse.up()
        page.get_by_role("button", name="Back to live").click()
        page.get_by_role("button", name="Back to live").wait_for(state="hidden")
        plot.focus()
        page.keyboard.press("+")
        page.get_by_role("button", name="Back to live").wait_for()
        page.keyboard.press("Escape")
        page.get_by_role("button", name="Back to live").wait_for(state="hidden")


def test_a_node_has_its_history_beside_it(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route=f"nodes/{lab.nodes['slew'].uuid}/history") as page:
        rows = page.get_by_role("list", name="History").get_by_role("listitem")
        rows.filter(has_text="write").first.wait_for()
        rows.filter(has_text="verify").first.wait_for()
        assert all("hand" not in text for text in rows.all_inner_texts())


def test_values_that_come_before_their_datasheet_are_shown_in_its_unit(browser: Browser, lab: Lab) -> None:
    """Metres were shown, and drawn for two minutes, as millimetres: a page that is opened hears values first."""
    uuid = lab.nodes["hand"].uuid
    lab.measure("hand", rate=0.25)
    heard: list[float] = []

    def hear(frame: str | bytes) -> None:
        message = json.loads(frame)
        if message["type"] == "values" and f"{uuid}/2" in message["channels"]:
            heard.extend(message["channels"][f"{uuid}/2"][1])

    held: list[Route] = []

    def keep(route: Route) -> None:
        if heard:
            route.continue_()
        else:
            held.append(route)

    with opened(browser, lab, route=f"nodes/{uuid}/live") as page:
        page.on("websocket", lambda socket: socket.on("framereceived", hear))
        page.route("**/api/v1/nodes", keep)
        heard.clear()
        page.reload()
        while not heard or not held:
            page.wait_for_timeout(50)
        for route in held:
            route.continue_()
        row = page.locator("table.values tbody tr").nth(1)  # channel 2, in mm
        figure = row.locator(".figure")
        figure.filter(has_text=re.compile(r"\d")).wait_for()
        assert float(figure.inner_text()) in [pytest.approx(1000 * value, abs=0.01) for value in heard]
