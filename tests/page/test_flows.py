"""What people come for, in a real browser, with real nodes: measure, write a datasheet, provision, move an actuator."""

from __future__ import annotations

import json
import re
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.cli.shell import clean_environment
from tests.pace import until
from tests.places import ros_domain

from .lab import Lab, opened

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = pytest.mark.system
HOSTILE = '<img src=x onerror="document.title=1">"; DROP'
TURNED = "\u202egrab\u200b"  # turns the direction of writing, and is invisible


def received(page: Page) -> int:
    """Points that the page took in so far, as its plot tells."""
    return int(page.locator(".plot-foot").get_attribute("data-received") or 0)


def in_group(page: Page, name: str) -> Locator:
    """Return the card of a group."""
    return page.locator("li.group").filter(has=page.get_by_role("heading", name=name))


def make_group(page: Page, name: str, *nodes: str) -> None:
    page.get_by_text("New group", exact=True).click()
    page.get_by_label("Name", exact=True).fill(name)
    for node in nodes:
        page.get_by_role("group", name="Nodes").get_by_role("checkbox", name=node).check()
    page.get_by_role("button", name="Create group").click()


def test_from_an_empty_home_to_a_moving_plot(browser: Browser, fresh: Lab) -> None:
    fresh.run()
    with opened(browser, fresh) as page:
        page.get_by_role("link", name="Create a virtual transducer").click()
        page.get_by_label("Transducer type").select_option("accelerometer")
        page.get_by_label("Name").fill("shaker")
        page.get_by_role("button", name="Create").click()
        page.get_by_role("link", name="Nodes").click()
        page.locator(".card", has_text="shaker").get_by_text("Authentic", exact=True).wait_for()
        page.get_by_role("link", name="Measure").click()
        page.get_by_text("No groups yet").wait_for()
        make_group(page, "table", "shaker")
        in_group(page, "table").get_by_label("Rate, Hz").fill("20")
        page.get_by_role("button", name="Start table").click()
        page.get_by_role("img", name="Plot of acceleration x, acceleration y, acceleration z").wait_for()
        until(lambda: received(page) > 50, "no points arrive")
        before = received(page)
        until(lambda: received(page) > before, "the plot stands still")
        in_group(page, "table").get_by_text(re.compile(r"running, \d+ samples, none lost")).wait_for()
        page.get_by_role("button", name="Pause").click()
        page.get_by_role("button", name="Resume").wait_for()
        page.get_by_role("button", name="Stop table").click()
        page.get_by_role("button", name="Start table").wait_for()
        page.get_by_role("link", name="Nodes").click()
        page.locator("tr.stale").first.wait_for()
        page.get_by_text("ago").first.wait_for()


def test_everything_that_is_trusted_is_measured_by_one_button(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route="measure") as page:
        page.get_by_role("button", name="Measure all trusted nodes").click()
        card = page.locator(".group", has=page.get_by_role("heading", name="All trusted nodes"))
        card.get_by_text(re.compile(r"\d+ nodes? measured: .*hand")).wait_for()
        assert [measurement["match"] for measurement in lab.measurements()] == ["all"]
        card.get_by_role("button", name="Stop").click()
        page.get_by_role("button", name="Measure all trusted nodes").wait_for()
        assert lab.measurements() == []


def test_a_rate_that_does_not_fit_is_refused_with_the_fastest(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route=f"nodes/{lab.nodes['hand'].uuid}/live") as page:
        page.get_by_label("Rate, Hz").fill("5000")
        page.get_by_role("button", name="Measure").click()
        page.get_by_role("alert").filter(has_text="supports at most 100 Hz").wait_for()
        assert page.get_by_role("button", name="Idle", pressed=True).is_visible()


def test_who_measures_says_whether_topics_may_move_actuators_and_when_these_are_safe(
    browser: Browser, fresh: Lab
) -> None:
    with ros_domain() as domain:
        fresh.run("--ros2", "--dead-man", 300, environment={**clean_environment(), "ROS_DOMAIN_ID": str(domain)})
        with opened(browser, fresh, route="virtual") as page:
            page.get_by_label("Transducer type").select_option("gripper")
            page.get_by_label("Name").fill("hand")
            page.get_by_role("button", name="Create").click()
            page.get_by_role("link", name="Nodes").click()
            page.locator(".card", has_text="hand").get_by_text("Authentic", exact=True).wait_for()
            page.get_by_role("link", name="Measure").click()
            make_group(page, "arm", "hand")
            card = in_group(page, "arm")
            card.get_by_text("More", exact=True).click()
            card.get_by_label("Rate, Hz").fill("10")
            may = card.get_by_label("Allow topics to move actuators")
            assert may.is_checked()
            assert card.get_by_label("Dead-man, ms").get_attribute("placeholder") == "300"
            card.get_by_label("Dead-man, ms").fill("5")
            page.get_by_role("button", name="Start arm").click()
            page.get_by_role("alert").filter(has_text="between 20 and 10000 ms").wait_for()
            card.get_by_label("Dead-man, ms").fill("")
            page.get_by_role("button", name="Start arm").click()
            card.get_by_text("safe state 300 ms after the last one").wait_for()
            assert [(measurement["actuators"], measurement["dead_man"]) for measurement in fresh.measurements()] == [
                (True, 300)
            ]
            page.get_by_role("button", name="Stop arm").click()
            page.get_by_role("button", name="Start arm").wait_for()
            may.uncheck()
            card.get_by_label("Dead-man, ms").fill("250")
            page.get_by_role("button", name="Start arm").click()
            card.get_by_text("Not accepted in this measurement").wait_for()
            assert [(measurement["actuators"], measurement["dead_man"]) for measurement in fresh.measurements()] == [
                (False, 250)
            ]
            page.get_by_role("button", name="Stop arm").click()
            page.get_by_role("button", name="Start arm").wait_for()
            # The same of one node by itself.
            page.get_by_role("link", name="Nodes").click()
            page.locator(".card", has_text="hand").click()
            page.get_by_role("group", name="Set points from topics").get_by_label(
                "Allow topics to move actuators"
            ).uncheck()
            page.get_by_role("button", name="Measure", exact=True).click()
            page.get_by_text("Not accepted in this measurement").wait_for()
            assert [measurement["actuators"] for measurement in fresh.measurements()] == [False]


def test_a_station_without_topics_says_that_it_takes_no_set_points(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route=f"nodes/{lab.nodes['hand'].uuid}/live") as page:
        page.get_by_text("This station does not accept set points from topics").wait_for()
        assert page.get_by_label("Allow topics to move actuators").is_disabled()
        page.goto(f"{lab.url}/#/nodes/{lab.nodes['slew'].uuid}/live")
        page.get_by_role("heading", name="slew").wait_for()
        page.get_by_role("button", name="Measure", exact=True).wait_for()
        assert not page.get_by_label("Allow topics to move actuators").is_visible(), "it has none"


@pytest.mark.realtime
def test_an_actuator_moves_while_it_is_held_and_the_node_says_that_it_is_safe(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route=f"nodes/{lab.nodes['hand'].uuid}/live") as page:
        hold = page.get_by_role("button", name="Hold to move")
        value = page.get_by_role("spinbutton", name="Value, mm")
        value.fill("40")
        hold.hover()
        page.mouse.down()
        page.get_by_text("Moving: 39.998 mm").wait_for()
        until(
            lambda: any(abs(entry["value"] - 0.04) < 1e-4 and not entry["safe"] for entry in lab.moved("hand")),
            "not set",
        )
        began = len(lab.moved("hand"))
        page.wait_for_timeout(1500)  # longer than what one word holds: the page goes on asking
        assert not any(entry["safe"] for entry in lab.moved("hand")[began:])
        page.mouse.up()
        page.get_by_text("Safe: confirmed by the node at").wait_for()
        assert lab.moved("hand")[-1]["safe"]
        # By keyboard.
        page.get_by_role("slider").focus()
        page.keyboard.press("End")
        assert value.input_value() == "110"
        hold.focus()
        page.keyboard.down(" ")
        page.get_by_text("Moving: 110").wait_for()
        page.keyboard.up(" ")
        page.get_by_text("Safe: confirmed by the node at").wait_for()
        # Beyond the limits of the datasheet.
        value.fill("500")
        hold.click()
        page.get_by_role("alert").filter(has_text="exceeds the limits").wait_for()


@pytest.mark.realtime
def test_closing_the_page_releases_the_actuator(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route=f"nodes/{lab.nodes['hand'].uuid}/live") as page:
        page.get_by_role("spinbutton", name="Value, mm").fill("30")
        page.get_by_role("button", name="Hold to move").hover()
        page.mouse.down()
        page.get_by_text("Moving: 30.005").wait_for()
    until(lambda: lab.moved("hand")[-1]["safe"], "still moving after the page was closed", 4)


def test_a_datasheet_is_read_and_written_from_a_file_with_the_changes_shown_first(
    browser: Browser, lab: Lab, tmp_path: Path
) -> None:
    slew = lab.nodes["slew"]
    with opened(browser, lab, route=f"nodes/{slew.uuid}/datasheet") as page:
        panel = page.get_by_role("region", name="Datasheet", exact=True)
        panel.get_by_text("Signature, trust and key proof are valid").wait_for()
        panel.get_by_role("img", name="Calibration of angle").locator("canvas").wait_for()
        panel.get_by_text("Channel 1: TransducerChannel TEDS").click()
        assert "360 °" in panel.get_by_role("row", name="HiLimit").inner_text()
        with page.expect_download() as download:
            panel.get_by_role("link", name="JSON").click()
        sheet = json.loads(Path(download.value.path()).read_text())
        written = tmp_path / "slew.json"
        written.write_text(json.dumps(sheet).replace('"slew"', '"crane slew"'))
        before = slew.datasheet
        chooser = page.get_by_label("Choose a datasheet file")
        chooser.set_input_files(written)
        plan = page.get_by_role("table", name="What changes, in physical units")
        row = plan.get_by_role("row", name="crane slew")
        row.wait_for()
        assert row.get_by_role("cell").all_inner_texts() == ["name", "slew", "→ crane slew"]
        assert slew.datasheet == before
        page.get_by_role("button", name="Sign and write to").click()
        page.get_by_text("Signed, written and verified: authentic").wait_for()
        assert slew.datasheet != before
        page.locator(".fields td", has_text="crane slew").wait_for(state="attached")
        chooser.set_input_files(written)
        page.get_by_role("heading", name="nothing to change").wait_for()
        broken = tmp_path / "broken.json"
        broken.write_text('{"format": "teds/1", "teds": [{}]}')
        chooser.set_input_files(broken)
        page.get_by_role("alert").filter(has_text=re.compile("teds|TEDS")).wait_for()


def test_provisioning_waits_for_the_tap_and_follows_it(browser: Browser, lab: Lab) -> None:
    lab.create("oven", "temperature-sensor")
    calibration = lab.desk.folder / "oven.csv"
    calibration.write_text("# date: 2026-11-01\nraw,value [degC]\n0,-40\n21120,125\n")
    with opened(browser, lab, route="nodes") as page:
        page.get_by_role("link", name="Provision the next tapped node").click()
        page.get_by_role("button", name="Provision").click()
        page.get_by_role("alert").filter(has_text="Choose a transducer type").wait_for()
        page.get_by_label("Transducer type").select_option("temperature-sensor")
        page.get_by_label("Name").fill("oven")
        page.get_by_label("Calibration file").set_input_files(calibration)
        page.get_by_role("button", name="Provision").click()
        page.locator(".waiting").get_by_text("Place a node on the reader.").wait_for()
        page.reload()
        page.locator(".waiting").get_by_text("Place a node on the reader.").wait_for()
        page.get_by_role("button", name="Cancel").click()
        page.get_by_text("Provisioning was cancelled").wait_for()
        page.get_by_label("Transducer type").select_option("temperature-sensor")
        page.get_by_label("Name").fill("oven")
        page.get_by_label("Calibration file").set_input_files(calibration)
        page.get_by_role("button", name="Provision").click()
        page.locator(".waiting").get_by_text("Place a node on the reader.").wait_for()
        running = lab.power("oven", nfc=True)
        page.get_by_text("This node is ready").wait_for()
        page.get_by_role("heading", name="oven", exact=True).wait_for()
        steps = page.locator(".steps li")
        assert steps.count() >= 6
        assert {inner_text.split("\n")[0] for inner_text in steps.all_inner_texts()} <= {"done", "not needed"}
        assert lab.nodes["oven"].uuid in page.url
        running.close()


def test_names_from_a_datasheet_are_text_and_nothing_else(browser: Browser, fresh: Lab) -> None:
    foreign = "0123456789abcdef0123"  # its datasheet was written elsewhere
    with closing(Station.open(fresh.station.home, ask=lambda _prompt, confirm: PASSPHRASE)) as station:
        station.nodes.remember(bytes.fromhex(foreign), name=TURNED)
    fresh.run()
    with opened(browser, fresh, route="virtual") as page:
        page.get_by_label("Transducer type").select_option("gripper")
        page.get_by_label("Name").fill(HOSTILE + TURNED)
        page.get_by_role("button", name="Create").click()
        page.get_by_role("alert").filter(has_text="one line of printable characters").wait_for()
        page.goto(f"{fresh.url}/#/nodes/{foreign}")
        page.get_by_role("heading", name="\ufffdgrab\ufffd", exact=True).wait_for()
        page.goto(f"{fresh.url}/#/virtual")
        page.get_by_label("Transducer type").select_option("gripper")
        page.get_by_label("Name").fill(HOSTILE)
        page.get_by_role("button", name="Create").click()
        page.get_by_role("link", name=HOSTILE).first.click()
        page.locator(".card").get_by_text("Authentic", exact=True).wait_for()
        title = page.title()
        for view in ("nodes", "measure", "virtual", "log", "station"):
            page.goto(f"{fresh.url}/#/{view}")
            page.get_by_text(HOSTILE).first.wait_for(state="attached")
            assert page.evaluate("document.querySelectorAll('img, iframe, object, script:not([src])').length") == 0
        assert "1" not in title


def test_two_browsers_see_the_same_and_one_that_may_only_read_changes_nothing(browser: Browser, lab: Lab) -> None:
    with opened(browser, lab, route="measure") as page, opened(browser, lab, route="measure", read_only=True) as other:
        make_group(page, "both", "hand")
        in_group(other, "both").wait_for()
        assert other.get_by_role("button", name="Start both").is_disabled()
        assert other.get_by_role("button", name="Discover").is_disabled()
        in_group(page, "both").get_by_label("Rate, Hz").fill("20")
        page.get_by_role("button", name="Start both").click()
        until(lambda: received(other) > 20, "the second browser gets nothing")
        other.goto(f"{lab.url}/#/nodes/{lab.nodes['hand'].uuid}/datasheet")
        other.get_by_text("This browser has read-only access").or_(
            other.get_by_text("is being measured")
        ).first.wait_for()
        page.get_by_role("button", name="Stop both").click()
        page.get_by_text("More").first.click()
        members = page.get_by_role("group", name="Members")
        members.get_by_role("checkbox", name="slew").check()
        page.get_by_role("button", name="Save members").click()
        other.locator(".card", has_text="slew").get_by_text("both").wait_for()
        page.get_by_role("button", name="Delete group").click()
        page.get_by_text("No groups yet").wait_for()
        other.goto(f"{lab.url}/#/measure")
        other.get_by_text("No groups yet").wait_for()


def test_the_station_searches_its_log_and_older_entries_come_when_they_are_asked_for(
    browser: Browser, fresh: Lab
) -> None:
    fresh.run()
    with closing(Station.open(fresh.station.home, ask=lambda _prompt, confirm: PASSPHRASE)) as station:
        station.audit("group", None, "the first of many")
        for number in range(230):
            station.audit("detection", None, "set", number=number)
    with opened(browser, fresh, route="log") as page:
        rows = page.locator("table.log tbody tr")
        page.get_by_text("Newest 200 entries").wait_for()
        page.get_by_text("Chain intact").wait_for()
        assert rows.count() == 200
        page.get_by_role("button", name="Show older entries").click()
        page.get_by_text("the first of many").wait_for()
        assert rows.count() > 230
        page.get_by_role("button", name="Show older entries").wait_for(state="hidden")
        page.reload()
        page.get_by_text("Newest 200 entries").wait_for()
        page.get_by_label("Search the log").fill("first of MANY")
        page.get_by_text("1 entry").wait_for()
        assert "the first of many" in rows.first.inner_text(), "it is none of the newest 200"
        page.get_by_label("Failures only").check()
        page.get_by_text("No matching entries").wait_for()
        page.get_by_label("Failures only").uncheck()
        page.get_by_label("Search the log").fill("")
        page.get_by_text("Newest 200 entries").wait_for()
