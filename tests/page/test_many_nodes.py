"""Hundreds of nodes on the page: their order, filters, what is done with many of them, and how soon they are drawn."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import pytest

from teds_provision import client
from teds_provision.station.station import Station
from tests.pace import until

from .lab import Lab, opened

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser, Page

pytestmark = pytest.mark.system
MANY = 300


@pytest.fixture(scope="module")
def crowd(lab: Lab) -> Iterator[Lab]:
    """Yield the lab, and nodes that are on the whitelist and not there."""
    listed = [{"uuid": f"{0xBEEF:04x}{number:016x}", "name": f"joint {number}"} for number in range(1, MANY + 1)]
    file = lab.folder / "crowd.json"
    file.write_text(json.dumps({"whitelist": listed}))
    lab.ask("whitelist", "import", file)
    yield lab
    with Station.inspect(lab.station.home) as store, store._store.together():
        for entry in listed:
            store._store.execute("DELETE FROM whitelist WHERE uuid = ?", (bytes.fromhex(entry["uuid"]),))


def called(lab: Lab, *nodes: str) -> list[str]:
    """Return what nodes of the lab are called by now: the tests before these rename one."""
    with client.connect(home=lab.station.home) as station:
        return sorted(station.node(lab.nodes[node].uuid)["name"] for node in nodes)


def others(lab: Lab) -> list[str]:
    """Return what nodes are called that tests before these provisioned, and left there."""
    mine = {lab.nodes[node].uuid for node in ("hand", "slew")}
    with client.connect(home=lab.station.home) as station:
        known = [node for node in station.nodes() if (node["verdict"] or {}).get("verdict") == "authentic"]
    return [node["name"] for node in known if node["uuid"] not in mine]


def names(page: Page) -> list[str]:
    """Return what is listed, from top to bottom."""
    return page.locator(".card .name").all_inner_texts()


def test_many_nodes_are_in_order_found_by_what_they_are_and_drawn_by_the_hundred(browser: Browser, crowd: Lab) -> None:
    there = called(crowd, "hand", "slew")
    with opened(browser, crowd) as page:
        page.get_by_role("button", name="Show 100 more").wait_for()
        until(lambda: names(page)[:2] == there, "who is there comes first")
        found = names(page)
        assert found[2:12] == [f"joint {number}" for number in range(1, 11)], "2 comes before 10"
        assert len(found) == 100
        page.get_by_label("Search nodes").fill("joint 29")
        until(lambda: names(page) == ["joint 29", *[f"joint {number}" for number in range(290, 300)]])
        page.get_by_role("button", name="Clear filters").click()
        page.get_by_text("Filter", exact=True).click()
        page.get_by_label("Filter by verdict").select_option("authentic")
        authentic = [*there, *others(crowd)]
        until(lambda: sorted(names(page)) == sorted(authentic))
        page.get_by_label("Filter by type").select_option("gripper")
        until(lambda: names(page) == called(crowd, "hand"))
        page.get_by_role("button", name="Clear filters").click()
        page.get_by_label("Filter by link").select_option("away")
        until(lambda: len(names(page)) == 100)


def test_published_names_are_in_order_and_links_that_are_there_are_not_missed(browser: Browser, crowd: Lab) -> None:
    with opened(browser, crowd, route="station") as page:
        rows = page.locator(".names th[scope=row]")
        until(lambda: rows.count() == 40)
        joints = [f"joint {number}" for number in range(1, 40)]
        listed = sorted([*called(crowd, "hand", "slew"), "joint"])  # joint 1, joint 2 … stand together
        expected = [*listed[: listed.index("joint")], *joints]

        def shown() -> list[str]:
            words = rows.all_inner_texts()
            return [text.removesuffix(" (the node)") for text in words if text.endswith("(the node)")]

        # names come with the nodes, which may come after the rows
        until(lambda: (nodes := shown()) and nodes == expected[: len(nodes)], lambda: f"2 comes before 10: {shown()}")
        page.get_by_label("Links").get_by_text("CAN", exact=True).wait_for()
        assert page.get_by_text("No link is configured").is_hidden()


def test_an_act_on_many_nodes_names_who_was_refused_and_does_the_rest(browser: Browser, crowd: Lab) -> None:
    there = called(crowd, "hand", "slew")
    with opened(browser, crowd) as page, opened(browser, crowd) as other:
        page.get_by_role("button", name="Select", exact=True).click()
        for name in (*there, "joint 1"):
            page.get_by_role("checkbox", name=f"Select {name}", exact=True).check()
        page.get_by_role("button", name="Verify").click()
        result = page.locator(".bulk-result")
        result.get_by_text("Verified 2 of 3.").wait_for()
        result.get_by_role("listitem").filter(has_text="joint 1: ").wait_for()
        page.get_by_role("checkbox", name="Select joint 1", exact=True).uncheck()
        page.get_by_label("Group to add to").fill("pair")
        page.get_by_role("button", name="Add to group").click()
        result.get_by_text("Group pair has 2 nodes.").wait_for()
        other.get_by_role("link", name="Measure").click()
        other.get_by_role("heading", name="pair").wait_for()  # another tab sees it at once
        page.get_by_role("group", name="Selected nodes").get_by_role("button", name="Measure").click()
        result.get_by_text("Measuring 2 nodes.").wait_for()
        assert sorted(crowd.measurements()[0]["uuids"]) == sorted(crowd.nodes[name].uuid for name in ("hand", "slew"))
        page.get_by_label("Search nodes").fill("joint")
        page.get_by_text("2 nodes selected, 2 of them not listed").wait_for()


WIDE = pytest.mark.nightly(
    "tests/page/test_many_nodes.py::test_a_group_of_a_hundred_nodes_has_a_card_of_a_windows_size_in_order[360]: "
    "the narrow window is the harder one"
)


@pytest.mark.parametrize("width", [360, pytest.param(1600, marks=WIDE)])
def test_a_group_of_a_hundred_nodes_has_a_card_of_a_windows_size_in_order(
    browser: Browser, crowd: Lab, width: int
) -> None:
    with crowd.visited(), opened(browser, crowd, width=width, route="measure") as page:
        with client.connect(home=crowd.station.home) as station:
            uuids = [f"{0xBEEF:04x}{number:016x}" for number in (10, 2, *range(20, 120))]
            station.request("POST", "/groups", {"name": "joints", "uuids": uuids})
        card = page.locator("li.group", has=page.get_by_role("heading", name="joints"))
        members = card.locator(".member-list a")
        until(lambda: members.all_inner_texts()[:3] == ["joint 2", "joint 10", "joint 20"], "2 comes before 10")
        assert members.count() == 102
        box = card.bounding_box()
        assert box is not None
        assert box["height"] < 900, "the next group is in sight"
        members.last.focus()  # by keyboard, too
        assert members.last.is_visible()
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
