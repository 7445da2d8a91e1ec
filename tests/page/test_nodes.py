"""The page in a real browser: which nodes are there, whether they are to be trusted; taps; a lost connection."""

from __future__ import annotations

import re
import signal
import time
import urllib.error
import urllib.request
from contextlib import suppress
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from tests.e2e.desk import ANGLE
from tests.ncap.test_adopting import brings
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Route

pytestmark = pytest.mark.system


def test_nodes_are_shown_with_verdict_link_and_channels(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab) as page:
        nodes = page.get_by_role("region", name="Nodes")
        for name in ("slew", "hand"):
            card = nodes.get_by_role("link", name=name)
            card.get_by_text("Authentic", exact=True).wait_for()
            assert "CAN" in card.inner_text()
            assert re.search(r"(80|79) %", card.inner_text()), card.inner_text()
            assert "virtual/teds-provision" in card.inner_text()
        nodes.get_by_role("link", name="hand").click()
        page.get_by_role("heading", name="hand", exact=True).wait_for()
        rows = page.get_by_role("table", name="Channels and their latest values")
        row = rows.get_by_role("row", name="opening", exact=False).nth(1)
        for words in ("opening", "mm", "0 to 110 mm", "± 0.1 mm", "100 Hz", "2026-11-01"):
            assert words in row.inner_text(), row.inner_text()
        page.get_by_text("Security check:").click()
        assert page.get_by_text("passed", exact=True).count() > 10
        assert lab.nodes["hand"].uuid in page.locator(".uuid").inner_text().replace(" ", "")
        page.get_by_role("button", name="Locate").click()
        page.get_by_role("status").filter(has_text="The board blinks for 10 seconds.").wait_for(state="attached")
        assert lab.board is not None
        lab.board.wait_for('"locate"')


def test_an_empty_home_says_what_to_do_next_and_a_tap_opens_the_node(browser: Browser, fresh: Lab) -> None:
    fresh.run("--detection", "transparent")
    fresh.create("oven", "temperature-sensor")
    with opened(browser, fresh, route="log") as page:
        page.goto(f"{fresh.url}/#/nodes")
        page.get_by_role("heading", name="No nodes yet").wait_for()
        page.get_by_role("link", name="Create a virtual transducer").wait_for()
        page.goto(f"{fresh.url}/#/nodes/{'ab' * 10}")  # a bookmark of a node that is no more
        page.get_by_role("heading", name="No nodes yet").wait_for(state="detached")
        page.goto(f"{fresh.url}/#/station")
        page.get_by_role("heading", name="Links").wait_for()
        fresh.power("oven", nfc=True)  # laid on the reader while the person looks at something else: the view stays
        page.get_by_role("link", name="Open it").click()
        page.get_by_text("This one was just tapped").or_(page.locator(".node-head.tapped")).first.wait_for()
        assert fresh.nodes["oven"].uuid in page.url
        page.get_by_role("status").filter(has_text="Tapped").first.wait_for(state="attached")
        page.locator(".card.tapped").wait_for()
        page.get_by_role("link", name="provision it first").wait_for()


def test_only_a_node_that_is_measured_is_shown_as_measuring(browser: Browser, lab: Lab) -> None:
    """A node that was refused had the word for as long as the measurement was kept."""
    with opened(browser, lab) as page:
        texts = page.evaluate(
            """async () => {
                const { node } = await import("/js/shapes.js");
                const of = (state) => node({ uuid: "00", measurement: "m", measuring: state && { state } }).mode;
                return ["running", "refused", "lost", undefined].map(of).concat(node({ uuid: "00" }).mode);
            }"""
        )
    assert texts == ["measuring", "refused, not measured", "lost, not measured", "waiting to be measured", None]


def test_a_node_that_leaves_is_shown_as_away(browser: Browser, fresh: Lab) -> None:
    fresh.run("--detection", "transparent")
    fresh.create("oven", "temperature-sensor")
    running = fresh.power("oven", nfc=True)
    with opened(browser, fresh) as page:
        card = page.locator(".card", has_text="NFC")
        card.wait_for()
        running.signal(signal.SIGTERM)
        card.get_by_text("away").wait_for()


def test_detection_is_switched_and_seen_by_the_command_line(browser: Browser, lab: Lab) -> None:
    lab.create("stranger", ANGLE)
    running = lab.power("stranger")
    with opened(browser, lab) as page:
        page.get_by_text("1 more not on the whitelist").wait_for()
        page.get_by_role("button", name="Transparent").click()
        page.locator(".card", has_text="not on the whitelist").wait_for()
        assert lab.ask("ncap", "status")["detection"] == "transparent"
        page.get_by_role("button", name="Whitelist").click()
        page.get_by_role("button", name="Whitelist", pressed=True).wait_for()
        assert lab.ask("ncap", "status")["detection"] == "whitelist"
        page.get_by_role("button", name="Discover").click()
        page.get_by_text("nodes answered").wait_for()
    running.close()


def test_a_browser_whose_token_was_removed_stops_asking_and_is_told_how_to_sign_in(
    browser: Browser, fresh: Lab
) -> None:
    """After ten wrong tokens of anybody the page was told 429 in place of 401, and tried again for ever."""
    fresh.run()
    with opened(browser, fresh) as page:
        for _ in range(11):
            request = urllib.request.Request(f"{fresh.url}/api/v1/status", headers={"Authorization": "Bearer wrong"})
            with suppress(urllib.error.HTTPError):
                urllib.request.urlopen(request, timeout=60).close()
        sockets: list[str] = []
        page.on("websocket", lambda socket: sockets.append(socket.url))
        fresh.ask("ncap", "token", "remove", "browser")
        page.locator("#connection", has_text="Signed out").wait_for()
        page.get_by_role("alert").get_by_text("teds-provision ncap open").wait_for()
        page.wait_for_timeout(4000)  # longer than it waits between two tries
        assert (sockets, page.locator("#connection").inner_text()) == ([], "Signed out")
        page.goto(fresh.login())
        page.locator("#connection", has_text="Live").wait_for()


def test_a_verdict_from_an_earlier_reading_is_marked_and_unverified_values_are_shown_beside_it(
    browser: Browser, lab: Lab
) -> None:
    uuid = lab.nodes["hand"].uuid
    changed = {
        "verdict": {"verdict": "authentic", "checks": [], "from": "kept", "at": "2026-11-22T10:00:00Z", "by": "ncap"},
        "heard": {
            "verdict": "not authentic",
            "checks": [],
            "from": "plain",
            "at": "2026-11-22T10:00:00Z",
            "by": "ncap",
        },
    }

    def fulfil(route: Route) -> None:
        answer = route.fetch()
        found = answer.json()
        for node in found.get("nodes", [found]):
            if node.get("uuid") == uuid:
                node.update(changed)
        route.fulfill(response=answer, json=found)

    with opened(browser, lab) as page:
        page.route("**/api/v1/nodes*", fulfil)
        page.route(f"**/api/v1/nodes/{uuid}", fulfil)
        page.goto(f"{lab.url}/#/nodes/{uuid}")
        page.reload()
        head = page.locator(".node-head")
        head.get_by_text("Kept", exact=True).wait_for()
        head.get_by_text("Authentic", exact=True).wait_for()  # what no session said replaces nothing
        head.get_by_text("Not verified: not authentic").wait_for()
        page.unroute_all(behavior="ignoreErrors")  # what it still fetches is answered without it from here on
        page.reload()
        head.get_by_text("Authentic", exact=True).wait_for()
        assert head.get_by_text("Kept", exact=True).count() == head.get_by_text("Not verified").count() == 0


KILLED = pytest.mark.nightly(
    "tests/page/test_nodes.py::test_a_lost_connection_is_seen_within_two_seconds_and_healed[frozen]: a silent service "
    "is noticed by its missing beats, one that is killed sooner; it comes back to the page in "
    "tests/page/test_simulation.py::test_a_page_feeds_on_after_the_service_came_back"
)


@pytest.mark.realtime
@pytest.mark.parametrize(
    "how", [pytest.param(signal.SIGKILL, marks=KILLED, id="killed"), pytest.param(signal.SIGSTOP, id="frozen")]
)
def test_a_lost_connection_is_seen_within_two_seconds_and_healed(
    browser: Browser, fresh: Lab, how: signal.Signals
) -> None:
    fresh.run()
    assert fresh.daemon is not None
    with opened(browser, fresh) as page:
        began = time.monotonic()
        fresh.daemon.signal(how)
        page.locator("#connection", has_text="Connection lost").wait_for()
        seen = time.monotonic() - began
        page.get_by_role("alert").filter(has_text="These values are out of date").wait_for()
        assert page.get_by_role("button", name="Discover").is_disabled()
        if how == signal.SIGSTOP:
            fresh.daemon.signal(signal.SIGCONT)
        else:
            fresh.daemon.close()
            fresh.run()
        page.locator("#connection", has_text="Live").wait_for()
        assert seen < 3  # two seconds, and what a loaded machine adds to this test


def test_what_describes_itself_is_shown_unverified_and_signed_by_a_button(browser: Browser, fresh: Lab) -> None:
    fresh.run("--detection", "transparent", "--adopt", "--unverified", "--rate", "20")
    node = brings(fresh.desk, "shaft 40 mm", can=fresh.can)
    with client.connect(home=fresh.station.home) as asked:
        until(lambda: any(known_node["uuid"] == node.uuid and known_node["unverified"] for known_node in asked.nodes()))
    with opened(browser, fresh, route=f"nodes/{node.uuid}/datasheet") as page:
        page.get_by_text("Unverified", exact=True).first.wait_for()
        page.get_by_role("heading", name="shaft 40 mm", exact=True).wait_for()
        brought = page.get_by_role("group", name="The board's own datasheet")
        brought.get_by_text("nobody has signed it").wait_for()
        brought.get_by_role("button", name="Sign this datasheet").click()
        page.get_by_text("This node is ready.").wait_for()
        page.get_by_text("Authentic", exact=True).first.wait_for()
