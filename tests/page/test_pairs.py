"""What a page shows while something else happens: another tab, a later answer, a node that comes, an early end."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from tests.e2e.desk import ANGLE
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import APIResponse, Browser, Route

pytestmark = pytest.mark.system


def test_an_older_list_of_nodes_replaces_no_later_answer_about_one(browser: Browser, lab: Lab) -> None:
    """A slow answer to Discover took back what an event had told since, until the next one."""
    uuid = lab.nodes["slew"].uuid
    held: list[tuple[Route, APIResponse]] = []

    def keep(route: Route) -> None:
        if held:
            route.continue_()
        else:
            held.append((route, route.fetch()))

    with opened(browser, lab, route="nodes") as page, client.connect(home=lab.station.home) as station:
        card = page.locator(f"a[href='#/nodes/{uuid}'] .name").first
        card.filter(has_text="slew").wait_for()
        page.route("**/api/v1/nodes", keep)
        page.get_by_role("button", name="Discover").click()
        while not held:
            page.wait_for_timeout(50)
        for name in ("crane", "slew"):
            station.request("POST", f"/nodes/{uuid}/provision", {"profile": ANGLE, "name": name})
            until(lambda: station.request("GET", f"/nodes/{uuid}/provision")["state"] == "done")
            card.filter(has_text=name).wait_for()
            if name == "crane":
                [(route, answer)] = held
                route.fulfill(response=answer)
                page.wait_for_timeout(500)
                assert card.inner_text() == "crane"


def test_an_answer_that_comes_after_the_end_does_not_begin_again(browser: Browser, lab: Lab) -> None:
    """Over a slow connection a provisioning that was done stood there as begun, and its button stayed locked."""
    with opened(browser, lab, route=f"nodes/{lab.nodes['slew'].uuid}/provision") as page:
        answers: list[tuple[Route, APIResponse]] = []
        page.route("**/provision", lambda route: answers.append((route, route.fetch())))
        page.get_by_label("Transducer type").select_option(ANGLE)
        go = page.get_by_role("button", name="Provision", exact=True)
        for _ in range(2):  # the first has no run before it, the second one that is done
            go.click()
            while not answers:
                page.wait_for_timeout(50)
            page.locator(".steps li", has_text="Read back and verify").get_by_text("done").wait_for()
            page.wait_for_timeout(500)
            for route, answer in answers:
                route.fulfill(response=answer)
            answers.clear()
            page.get_by_text("This node is ready.").wait_for()
            page.wait_for_timeout(300)
            assert go.is_enabled()
            assert page.get_by_text("This node is ready.").is_visible()


def test_a_node_that_comes_unticks_no_member(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route="measure") as page, client.connect(home=lab.station.home) as station:
        station.request("POST", "/groups", {"name": "pair", "uuids": [lab.nodes["slew"].uuid]})
        card = page.locator("li.group", has=page.get_by_role("heading", name="pair"))
        card.get_by_text("More").click()
        card.get_by_role("checkbox", name="hand").check()
        made = station.request("POST", "/virtual", {"profile": ANGLE, "name": "late comer"})
        try:
            card.get_by_role("checkbox", name="late comer").wait_for()
            assert card.get_by_role("checkbox", name="hand").is_checked()
            assert not card.get_by_role("checkbox", name="late comer").is_checked()
            station.request("PUT", "/groups/pair", {"uuids": [made["uuid"]]})
            page.wait_for_function(
                "box => box.checked", arg=card.get_by_role("checkbox", name="late comer").element_handle()
            )
            assert not card.get_by_role("checkbox", name="hand").is_checked(), "another tab decided who is in it"
        finally:
            station.request("DELETE", "/groups/pair")
            station.request("DELETE", f"/virtual/{made['uuid']}")


def test_what_is_typed_as_a_topic_stays_while_others_rename(browser: Browser, lab: Lab) -> None:
    uuid = lab.nodes["hand"].uuid
    with opened(browser, lab, route="station") as page, client.connect(home=lab.station.home) as station:
        entry, other = (
            page.get_by_label("Topic of hand: opening", exact=True),
            page.get_by_label("Topic of hand: grip force"),
        )
        entry.fill("left/opening")
        entry.press("Tab")  # to its button
        station.request("PUT", "/names", {"uuid": uuid, "channel": 3, "name": "left/force"})
        until(lambda: other.input_value() == "/left/force")
        page.keyboard.press("Enter")
        until(lambda: entry.input_value() == "/left/opening")
        for channel in (2, 3):
            station.request("PUT", "/names", {"uuid": uuid, "channel": channel, "name": None})
        until(lambda: entry.input_value() == "/bench/hand/opening")


def test_nothing_is_written_that_was_not_shown(browser: Browser, lab: Lab, tmp_path: Path) -> None:
    """Another tab wrote after the changes were shown: they were other changes then, and nobody saw them."""
    uuid = lab.nodes["slew"].uuid
    with (
        opened(browser, lab, route=f"nodes/{uuid}/datasheet") as page,
        client.connect(home=lab.station.home) as station,
    ):
        sheet = page.request.get(f"{lab.url}/api/v1/nodes/{uuid}/teds?format=json").text()
        file = tmp_path / "slew.json"
        file.write_text(sheet.replace('"slew"', '"crane slew"'))
        page.get_by_label("Choose a datasheet file").set_input_files(file)
        row = page.get_by_role("table", name="What changes, in physical units").get_by_role("row", name="crane slew")
        row.wait_for()
        station.request("PUT", f"/nodes/{uuid}/teds", {"content": sheet.replace('"slew"', '"tower slew"')})
        with page.expect_request(lambda sent: sent.method == "PUT") as first:
            page.get_by_role("button", name="Sign and write to").click()
        assert "dry_run" not in first.value.url, "the station compares, under the node's lock"
        assert first.value.headers["if-match"]
        page.get_by_role("alert").filter(has_text="has changed since").wait_for()
        assert row.get_by_role("cell").all_inner_texts() == ["name", "tower slew", "→ crane slew"]
        assert station.node(uuid)["name"] == "tower slew"
        page.get_by_role("button", name="Sign and write to").click()
        page.get_by_text("Signed, written and verified: authentic").wait_for()
        station.request("PUT", f"/nodes/{uuid}/teds", {"content": sheet})


def test_a_datasheet_that_is_open_has_the_verdict_of_now(browser: Browser, lab: Lab) -> None:
    with client.connect(home=lab.station.home) as station:
        uuid = station.request("POST", "/virtual", {"profile": ANGLE, "name": "passing"})["uuid"]
        until(lambda: (station.node(uuid)["verdict"] or {}).get("verdict") == "authentic")
        try:
            with opened(browser, lab, route=f"nodes/{uuid}/datasheet") as page:
                head, verdict = page.locator(".node-facts .chip").first, page.locator(".sheet-verdict .chip").first
                verdict.get_by_text("Authentic", exact=True).wait_for()
                lab.ask("revoke", uuid, "--why", "a test", "--yes")
                head.get_by_text("Not authentic", exact=True).wait_for()
                verdict.get_by_text("Not authentic", exact=True).wait_for()
        finally:
            station.request("DELETE", f"/virtual/{uuid}")
