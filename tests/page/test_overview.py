"""The list of nodes, the station, the plot and the frame of the page: taps, what is not listed, what moves in time."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM, HAND, NOW, Stage, staged
from .test_forms import text, texts
from .test_modules import bins
from .test_views import HELD, change, gripper, nodes, press

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser

pytestmark = pytest.mark.system
NONE = None
THIRD = "c3" * 10


def listing(stage: Stage, *rest: str) -> None:
    stage.run("window.view = show(nodes.nodesView(document.getElementById('main'), words))", *rest)
    stage.pass_time(20)


def crowd(many: int, **more: Any) -> list[dict[str, Any]]:
    return [
        {"uuid": f"{number:020x}", "name": f"joint {number}", "present": False} | more for number in range(1, many + 1)
    ]


def test_who_is_there_comes_first_and_a_hundred_cards_are_drawn(stage: Stage) -> None:
    listing(stage, "next")
    nodes(stage, *crowd(250), gripper(present=True), {"uuid": HAND, "name": "zebra", "present": True})
    stage.pass_time(20)
    names = texts(stage, ".card .name")
    assert (names[:4], len(names)) == (["hand", "zebra", "joint 1", "joint 2"], 100)
    assert text(stage, ".total") == "252 nodes"
    press(stage, "Show 100 more of 252")
    assert len(texts(stage, ".card")) == 200
    press(stage, "Show 52 more of 252")
    assert len(texts(stage, ".card")) == 252
    stage.page.get_by_label("Search nodes").fill("joint")
    assert (len(texts(stage, ".card")), text(stage, ".total")) == (100, "250 of 252 nodes")
    change(stage, total=3000)
    assert text(stage, ".total") == "250 of 252 of 3000 nodes"
    stage.page.get_by_label("Search nodes").fill("")
    change(stage, status={"strangers": 2, "links": [{"virtual": False}]})
    assert text(stage, ".total") == "252 of 3000 nodes, 2 more not on the whitelist"
    assert stage.page.locator(".side [data-linkless]").is_hidden()


@pytest.mark.parametrize(
    ("many", "search", "select"), [(1, False, False), (2, False, True), (6, False, True), (7, True, True)]
)
def test_a_search_appears_when_it_is_worth_it(stage: Stage, many: int, search: bool, select: bool) -> None:
    listing(stage, "next")
    nodes(stage, *crowd(many))
    stage.pass_time(20)
    assert stage.page.get_by_label("Search nodes").is_visible() is search
    assert stage.page.get_by_role("button", name="Select").is_visible() is select
    assert stage.page.locator(".side [data-linkless]").is_visible(), "the station has no link"


def test_a_card_has_three_values_and_a_tapped_one_is_marked_for_eight_seconds(stage: Stage) -> None:
    wire = gripper()
    sensor = wire["channels"][1]
    channels = [wire["channels"][0], *(sensor | {"number": number, "name": f"n {number}"} for number in range(2, 6))]
    nodes(stage, gripper(channels=channels), {"uuid": HAND, "name": "other", "present": False})
    listing(stage, ARM, "provision")
    stage.pass_time(250)
    assert texts(stage, ".peek > span") == [f"n {number} no value yet" for number in (2, 3, 4)]
    now = stage.run("return hub.now()")
    stage.run("state.values.set(words[0], { value: 0.05, time: words[1], period: 0 })", f"{ARM}/2", now)
    stage.pass_time(250)
    assert texts(stage, ".peek > span")[0] == "n 2 50.00 mm"
    nodes(stage, gripper(channels=channels, groups=["crane"]), {"uuid": HAND, "name": "other", "present": False})
    stage.pass_time(20)
    assert texts(stage, ".peek > span")[0] == "n 2 50.00 mm", "as soon as the card is drawn anew"
    marked = """
      const marks = [".card a[aria-current=true] .name", ".card.tapped .name", ".card.absent .name", ".peek > .stale"];
      return marks.map((one) => [...document.querySelectorAll(one)].map((each) => each.innerText.trim()));
    """
    assert stage.run(marked) == [["hand"], [], ["other"], ["n 3 no value yet", "n 4 no value yet"]]
    stage.run("state.tapped = { uuid: words[0], at: performance.now() }; hub.changed('tap')", HAND)
    stage.pass_time(7900)
    assert stage.run(marked)[1] == ["other"]
    stage.pass_time(1200)
    assert stage.run(marked)[1] == []
    stage.run("window.view.go([words[0], 'provision'])", HAND)
    assert stage.run(marked)[0] == ["other"]
    stage.run("window.view.go(['ff'])")
    assert texts(stage, ".detail .empty .lead") == ["Node not found."]


def test_what_is_open_beside_the_list_gives_way_to_what_is_chosen(stage: Stage) -> None:
    nodes(stage, gripper(), {"uuid": HAND, "name": "slew"})
    listing(stage)
    heads = ".detail h2"
    look = """
      const main = document.getElementById("main");
      return [main.classList.contains("one-open"), main.querySelectorAll(".tabs").length];
    """
    assert (texts(stage, heads), stage.run(look)) == (["hand"], [False, 1]), "the first one, if none is chosen"
    for rest, head, tabs in (
        (["next", "provision"], "Provision the next tapped node", 0), (["update"], "Firmware update", 0),
        ([HAND, "history"], "slew", 1), (["update"], "Firmware update", 0), ([HAND], "slew", 1),
        (["next", "provision"], "Provision the next tapped node", 0), (["update"], "Firmware update", 0),
        (["next", "provision"], "Provision the next tapped node", 0), ([ARM], "hand", 1), ([HAND], "slew", 1),
        (["unheard of"], NONE, 0), ([HAND], "slew", 1), (["next"], "Provision the next tapped node", 0),
        ([HAND], "slew", 1),
    ):  # fmt: skip
        stage.run("window.view.go(words)", *rest)
        stage.pass_time(20)
        assert (texts(stage, heads), stage.run(look)) == ([head] if head else [], [True, tabs]), rest
    stage.run("window.view.go(['unheard of'])")
    assert (texts(stage, heads), texts(stage, ".detail .empty .lead")) == ([], ["Node not found."])
    change(stage, loaded=False)
    assert texts(stage, ".detail *") == [], "it may still come"
    stage.run("window.view.go([])")
    assert texts(stage, heads) == ["hand"]


def test_a_narrow_window_has_the_list_or_the_node_that_was_chosen_and_a_way_back(stage: Stage) -> None:
    nodes(stage, gripper(), {"uuid": HAND, "name": "slew"})
    stage.run("document.getElementById('main').className = 'view-nodes'")
    seen = """
      const shown = (where) => [...document.querySelectorAll(where)].filter((one) => one.checkVisibility());
      return [shown(".side").length, shown(".detail h2").map((one) => one.innerText),
        shown(".detail .back").map((one) => [one.innerText, one.getAttribute("href")])];
    """
    back = [["All nodes", "#/nodes"]]
    try:
        stage.page.set_viewport_size({"width": 899, "height": 900})
        listing(stage)
        assert stage.run(seen) == [1, [], []]
        for rest, head in (([HAND], "slew"), (["update"], "Firmware update")):
            stage.run("window.view.go(words)", *rest)
            assert stage.run(seen) == [0, [head], back]
        stage.run("window.view.go([])")
        assert stage.run(seen) == [1, [], []]
        stage.page.set_viewport_size({"width": 900, "height": 900})
        stage.run("window.view.go([words[0]])", ARM)
        assert stage.run(seen) == [1, ["hand"], []], "there is room for both"
    finally:
        stage.page.set_viewport_size({"width": 1280, "height": 900})
        stage.run("document.getElementById('main').className = ''")


def test_boards_of_an_update_are_those_selected_in_the_list(stage: Stage) -> None:
    nodes(stage, gripper(), {"uuid": HAND, "name": "slew"})
    listing(stage, "update")
    selected = ".detail .stack > p"
    assert text(stage, selected) == "No boards are selected."
    press(stage, "Select boards")
    assert stage.run("return [location.hash, document.activeElement.innerText]") == ["#/nodes", "All listed"]
    assert stage.page.get_by_role("button", name="Select", pressed=True, exact=True).count() == 1
    stage.page.get_by_label("Select slew").check()
    stage.pass_time(20)
    assert text(stage, selected) == "1 board selected: slew"
    stage.page.get_by_label("Select slew").uncheck()
    stage.page.get_by_label("Select hand").check()
    stage.pass_time(20)
    assert text(stage, selected) == "1 board selected: hand"
    press(stage, "Select")
    stage.pass_time(20)
    assert text(stage, selected) == "No boards are selected."
    assert stage.page.get_by_label("Select slew").is_hidden()


def test_without_a_node_it_says_what_to_do_and_who_was_not_opened(stage: Stage) -> None:
    stage.run("state.loaded = false")
    listing(stage)
    assert text(stage, ".empty") == "Loading …"
    change(stage, loaded=True)
    assert texts(stage, ".first h2") == ["No nodes yet"]
    assert stage.page.locator("[data-strangers]").is_hidden()
    for strangers, words in ((1, "1 node answered but is not"), (2, "2 nodes answered but are not")):
        change(stage, status={"strangers": strangers, "links": [{"virtual": False}]})
        assert text(stage, "[data-strangers]").startswith(words)
        assert stage.page.locator(".first [data-linkless]").is_hidden()
    change(stage, status={"links": [{"virtual": True}]})
    assert stage.page.locator(".first [data-linkless]").is_visible(), "no board is on the bus of virtual ones"


def test_an_update_is_linked_while_it_runs_and_for_an_hour(stage: Stage) -> None:
    now = stage.run("return hub.now()")
    nodes(stage, *crowd(2))
    listing(stage, "next")
    link = stage.page.get_by_role("link", name="Firmware update to 1.4.0: 1 of 2 boards done")
    board = {"image": {"version": "1.4.0"}, "boards": [{"result": "lost"}, {"state": "waiting"}]}
    for update, there in (
        ({"state": "running"}, True), ({"state": "done", "ended": now - 3500}, True),
        ({"state": "done", "ended": now - 3700}, False),
    ):  # fmt: skip
        change(stage, updates=[board | update])
        assert link.is_visible() is there


def test_links_sinks_and_the_station_itself_are_shown(stage: Stage) -> None:
    problem = {"message": "No reader.", "hint": "Plug it in."}
    links = [{"place": "can:can0", "via": "can", "state": "up"},
             {"place": "nfc:usb", "via": "nfc", "state": "failed", "problem": problem}]  # fmt: skip
    running = {"measurement": "m", "state": "running"}
    sinks = [running | {"name": "run.csv", "written": 5, "dropped": 0, "detail": "x"},
             running | {"name": "ros2", "written": 1, "dropped": 7, "recorder": True, "detail": "part 2"},
             {"name": "mqtt", "measurement": "m", "state": "failed", "error": "No broker.",
              "hint": "Start it."},
             {"name": "run.csv", "measurement": "n", "state": "waiting", "detail": "It waits."}]  # fmt: skip
    status = {"links": links, "sinks": sinks, "station": {"name": "bench", "fingerprint": "abcd1234"},
              "version": "1.0", "started": NOW, "clock_error": 0.0000123, "write": False,
              "budget": {"used": 12.5, "limit": 1000}}  # fmt: skip
    stage.answers(**{"GET status": status})
    stage.run("show(station.stationView(document.getElementById('main')))")
    stage.pass_time(20)
    assert texts(stage, "[aria-label=Links] li") == ["CAN can0 up", "NFC usb failed No reader. Plug it in."]
    tones = "return [...document.querySelectorAll(words[0])].map((one) => one.classList[1])"
    assert stage.run(tones, "[aria-label=Links] .chip") == ["good", "warn"]
    assert texts(stage, "[aria-label='Where values go'] li") == [
        "run.csv 5 values written, 0 dropped running",
        "ros2 1 value written, 7 dropped running part 2",
        "mqtt 0 values written, 0 dropped failed No broker. Start it.",
        "run.csv 0 values written, 0 dropped waiting It waits.",
    ]
    assert stage.run(tones, "[aria-label='Where values go'] .chip") == ["good", "warn", "bad", "good"]
    assert texts(stage, "[aria-label=About] dd") == [
        "bench", "abcd 1234", "1.0", "10:00:00", "± 12.3 µs at most", "12.5 of 1000 per second", "read-only",
    ]  # fmt: skip
    stage.run("state.status = { links: [], foxglove: 'ws://127.0.0.1:8765' }; hub.changed('status')")
    stage.pass_time(20)
    assert texts(stage, "[aria-label=About] dd") == ["no measurement is running", "read and write"]
    assert text(stage, "[aria-label='Where values go'] > p") == "Live for Foxglove on ws://127.0.0.1:8765"
    assert texts(stage, "[aria-label='Where values go'] .empty") == []
    stage.run("state.status = { links: [] }; hub.changed('status')")
    stage.pass_time(20)
    assert texts(stage, "[aria-label='Where values go'] .empty .lead") == ["Values are not recorded or published."]


def test_names_are_searched_forty_at_a_time_and_renamed(stage: Stage) -> None:
    nodes(stage, gripper(), *crowd(50))
    names = [{"uuid": f"{number:020x}", "channel": 0, "topic": f"/b/j{number}"} for number in range(1, 51)]
    names += [
        {"uuid": ARM, "channel": 2, "topic": "/b/hand/opening"},
        {"uuid": ARM, "channel": 9, "topic": "/b/hand/x"},
    ]
    stage.answers(**{"GET names": {"names": names}})
    stage.run("show(station.stationView(document.getElementById('main')))")
    stage.pass_time(20)
    labels = ".names th[scope=row]"
    assert texts(stage, labels)[:4] == ["hand: opening", "hand: channel 9", "joint 1 (the node)", "joint 2 (the node)"]
    assert len(texts(stage, labels)) == 40
    press(stage, "Show 12 more of 52")
    assert len(texts(stage, labels)) == 52
    search = stage.page.get_by_label("Search published names")
    search.fill("HAND/o")
    assert texts(stage, labels) == ["hand: opening"]
    search.fill("channel 9")
    assert texts(stage, labels) == ["hand: channel 9"]
    entry = stage.page.get_by_label("Topic of hand: channel 9")
    stage.sent  # noqa: B018
    for words, name in ((" //left/x ", "left/x"), ("", NONE)):
        entry.fill(words)
        press(stage, "Rename")
        [entry_sent] = [one for one in stage.sent if one["method"] == "PUT"]
        assert entry_sent == {"method": "PUT", "path": "names", "body": {"uuid": ARM, "channel": 9, "name": name}}
    assert stage.said == "Renamed."
    stage.answers(**{"PUT names": {"refused": 409, "message": "It is taken.", "hint": "Another."}})
    press(stage, "Rename")
    assert texts(stage, ".toast") == ["It is taken. Another."]
    change(stage, status={"write": False, "links": []})
    assert stage.page.get_by_role("button", name="Rename").is_disabled()


SAYS = {"holders": {"a": ["north"], "b": ["south"]}, "epoch": 3, "written_by": "north", "sequence": 7, "revoked": [],
        "firmware": {"text": "nrf", "version": "1.3.0", "build": "7", "by": "south"}}  # fmt: skip


def test_the_plant_says_who_holds_a_node_and_what_is_to_be_done(stage: Stage) -> None:
    plant = {
        "name": "Augsburg", "roster": 2, "expires": NOW, "age": 7300, "why": "no route", "unsent": 1, "to_rotate": 0,
        "alarms": [{"code": "fork", "about": "x", "at": 1, "seen": False, "why": "two pages"},
                   {"code": "old", "about": "x", "at": 1, "seen": True, "why": "seen"}],
        "stations": [{"fingerprint": "f1", "name": "north", "state": "here", "roles": ["keeper", "base"], "page": 4,
                      "age": NONE},
                     {"fingerprint": "f2", "name": "south", "state": "silent", "roles": ["base"], "page": 1,
                      "age": 90}],
        "conflicts": [{"uuid": ARM, "conflict": "two keys", "detail": "north and south"}],
    }  # fmt: skip
    stage.answers(**{"GET plant": plant, "GET jobs": {"jobs": []}, "GET status": {"plant": True}})
    stage.run("state.status = { plant: true, links: [] }; show(station.stationView(document.getElementById('main')))")
    stage.pass_time(20)
    assert texts(stage, "[aria-label=Plant] > dl dd") == [
        "Augsburg, roster 2 until 2026-11-25", "2 h ago: no route", "1 event",
    ]  # fmt: skip
    assert texts(stage, "[aria-label=Plant] > ul:first-of-type li") == [
        "x two pages fork", "north keeper base, page 4 here", "south base, page 1, 90 s ago silent",
        "node a1a1a1a1 north and south two keys",
    ]  # fmt: skip
    held = ".lines[aria-label='Who holds a node'] li"
    box = stage.page.get_by_role("searchbox", name="Who holds a node")
    bare: dict[str, Any] = {"holders": {}, "revoked": ["x"], "firmware": NONE}
    asked = {"holders": {}, "revoked": [], "firmware": {"version": NONE, "by": "east"}}
    found = [{"uuid": ARM, "name": "hand", "says": SAYS, "conflicts": []},
             {"uuid": HAND, "name": "", "says": bare, "conflicts": []},
             {"uuid": THIRD, "name": "x", "says": asked, "conflicts": [{"name": "two keys"}]}]  # fmt: skip
    stage.answers(**{"GET plant/nodes": {"nodes": found, "more": True}})
    box.fill("a")
    stage.pass_time(200)
    box.fill("a b")
    stage.sent  # noqa: B018
    stage.pass_time(290)
    assert [entry["path"] for entry in stage.sent if "text" in entry["path"]] == []
    stage.pass_time(20)
    assert [entry["path"] for entry in stage.sent if "text" in entry["path"]] == ["plant/nodes?text=a b"]
    assert texts(stage, held) == [
        f"hand {ARM}: held by north, south (epoch 3), datasheet 7 by north, firmware nrf 1.3.0+7 (seen by south)",
        f"node b2b2b2b2 {HAND}: no holder, firmware not reported revoked",
        f"x {THIRD}: no holder, firmware not reported (asked by east) two keys",
        "More nodes match: enter more of the UUID or name.",
    ]
    stage.answers(**{"GET plant/nodes": {"refused": 503, "message": "Busy."}})
    box.fill("c")
    stage.pass_time(310)
    assert texts(stage, held) == ["Busy."]
    stage.answers(**{"GET plant/nodes": {"nodes": [], "more": False}})
    box.fill("d")
    stage.pass_time(310)
    assert texts(stage, held) == ["No station reports such a node."]
    box.fill("")
    stage.pass_time(310)
    assert texts(stage, held) == []
    plant |= {"age": NONE, "to_rotate": 2}
    stage.answers(**{"GET plant": plant})
    stage.pass_time(10_000)
    assert texts(stage, "[aria-label=Plant] > dl dd")[1:] == ["never", "1 event", "2 nodes"]
    stage.answers(**{"GET plant": {"refused": 404}})
    stage.pass_time(10_000)
    assert stage.page.get_by_role("region", name="Plant").is_hidden(), "the station has left it"


def test_a_job_is_open_until_its_last_day(stage: Stage) -> None:
    now = stage.run("return hub.now()")
    job = {
        "id": "j",
        "title": "fingers",
        "passed": 3,
        "total": 5,
        "profile": "gripper",
        "state": "open",
        "ends": now + 60,
    }
    older = job | {"id": "k", "title": "thumbs", "ends": now - 60}
    closed = job | {"id": "l", "title": "palms", "state": "closed"}
    stage.answers(**{"GET jobs": {"jobs": [closed, older, job]}})
    stage.run("state.status = { plant: true, links: [] }; window.panel = show(line.linePanel())")
    stage.run("document.getElementById('main').append(window.panel.panel)")
    stage.pass_time(20)
    assert texts(stage, ".jobs summary") == [
        "fingers 3 of 5 passed here, gripper, until 2026-11-25 open",
        "thumbs 3 of 5 passed here, gripper, until 2026-11-25 over",
        "palms 3 of 5 passed here, gripper, until 2026-11-25 closed",
    ]
    assert stage.run("return [...document.querySelectorAll('.chip')].map((one) => one.classList[1])") == [
        "good", "plain", "plain",
    ]  # fmt: skip


def test_a_station_of_the_plant_is_good_while_it_is_heard_and_plain_when_it_is_gone(stage: Stage) -> None:
    words = ["here", "heard", "retired", "lost", "stolen", "silent"]
    stations = [{"fingerprint": word, "name": word, "state": word, "roles": ["base"], "page": 1, "age": age}
                for word, age in zip(words, (NONE, 119, 120, 7199, 7200, 172_800), strict=True)]  # fmt: skip
    plant: dict[str, Any] = {"name": "p", "roster": 1, "expires": NOW, "age": 0, "why": "", "unsent": 0, "to_rotate": 0,
                             "alarms": [], "stations": stations, "conflicts": []}  # fmt: skip
    stage.answers(**{"GET plant": plant, "GET status": {"plant": True}, "GET jobs": {"jobs": []}})
    stage.run("state.status = { plant: true, links: [] }; show(station.stationView(document.getElementById('main')))")
    stage.pass_time(20)
    tones = "return [...document.querySelectorAll('[aria-label=Plant] .chip')].map((one) => one.classList[1])"
    assert stage.run(tones) == ["good", "good", "plain", "plain", "plain", "warn"]
    assert [line.partition("page 1")[2] for line in texts(stage, "[aria-label=Plant] > ul:first-of-type li")] == [
        " here", ", 119 s ago heard", ", 2 min ago retired", ", 119 min ago lost", ", 2 h ago stolen",
        ", 2 days ago silent",
    ]  # fmt: skip
    assert texts(stage, "[aria-label=Plant] > dl dd")[1:] == ["0 s ago", "0 events"]


def test_an_open_job_is_asked_again_and_its_bars_are_as_long_as_its_numbers(stage: Stage) -> None:
    part = {"name": "north", "allotment": 4, "units": 5, "passed": 4, "first_pass": 0.6, "over": True, "attempts": 7,
            "steps": {"agree": {"median": 1, "worst": 2.5}, "write": {"median": 0.5, "worst": 0.5}},
            "failures": {"node-silent": 1, "no-key": 2}}  # fmt: skip
    none = {"name": "south", "allotment": 10, "units": 0, "passed": 0, "first_pass": NONE, "over": False,
            "attempts": 0, "steps": {}, "failures": {}}  # fmt: skip
    now = stage.run("return hub.now()")
    job = {
        "id": "j",
        "title": "fingers",
        "passed": 3,
        "total": 5,
        "profile": "gripper",
        "state": "open",
        "ends": now + 9,
    }
    stage.answers(**{"GET jobs/j": job | {"stations": [part, none]}})
    stage.run("state.status = { links: [] }; window.panel = show(line.linePanel())")
    stage.run("document.getElementById('main').append(window.panel.panel)")
    stage.pass_time(20)
    panel = stage.page.get_by_role("region", name="Line")
    assert (stage.sent, panel.is_hidden()) == ([], True), "without a plant there is no line"
    stage.answers(**{"GET jobs": {"jobs": [job]}})
    change(stage, status={"plant": True, "links": []})
    assert ([entry["path"] for entry in stage.sent], panel.is_visible()) == (["jobs"], True)
    change(stage)
    assert stage.sent == [], "it is shown now, and asked again later"
    stage.page.get_by_text("fingers").click()
    stage.page.get_by_text("first pass").first.wait_for()
    assert [entry["path"] for entry in stage.sent] == ["jobs/j"]
    bars = """
      const bars = [...document.querySelectorAll(".bars .share")];
      return bars.map((bar) => [...bar.children].map((one) => [one.className, Number.parseFloat(one.style.width)]));
    """
    assert stage.run(bars) == [
        [["good", 60]], [["good", 80]], [["", 100]],  # of the boards that have begun, more than were allotted
        [["farther", 100], ["", 40]], [["farther", 20], ["", 20]],  # of the slowest step
        [["bad", 50]], [["bad", 100]],
        [["good", 0]], [["good", 0]], [["", 0]],
    ]  # fmt: skip
    stage.answers(**{"GET jobs/j": job | {"stations": [part | {"allotment": 10, "over": False}]}})
    stage.pass_time(10_000)
    assert [entry["path"] for entry in stage.sent] == ["jobs", "jobs/j"]
    assert stage.run(bars)[:3] == [[["good", 30]], [["good", 40]], [["", 50]]]
    assert texts(stage, ".station-part h4") == ["north"]
    stage.run(
        """
        const details = document.querySelector(".jobs details");
        const folded = new Promise((done) => details.addEventListener("toggle", done, { once: true }));
        details.open = false;
        await folded;
        """
    )
    stage.pass_time(10_000)
    assert [entry["path"] for entry in stage.sent] == ["jobs"], "a closed one is not asked"
    stage.answers(**{"GET jobs": {"refused": 503}})
    stage.pass_time(10_000)
    assert panel.is_visible(), "what was known stays"
    stage.answers(**{"GET jobs": {"jobs": []}})
    stage.pass_time(10_000)
    assert panel.is_hidden()


CHANNELS = [
    {"uuid": ARM, "number": 1, "label": "opening", "unit": "mm"},
    {"uuid": ARM, "number": 2, "label": "force", "unit": "N"},
]


@pytest.fixture
def moving(stage: Stage) -> Stage:
    """A plot of two channels of 20 Hz, of which a minute is known."""
    now = stage.run("return hub.now()")
    past = bins(*(now - 60 + second for second in range(59)), lost=[0] * 58 + [3], invalid=[0] * 57 + [4, 0])
    stage.answers(**{f"GET nodes/{ARM}/past": past})
    stage.run(
        """
        const plotted = new plot.LivePlot(words);
        window.plot = show(plotted);
        document.getElementById("main").append(plotted.element);
        """,
        *CHANNELS,
    )
    stage.pass_time(400)
    stage.sent  # noqa: B018
    return stage


@pytest.mark.parametrize(
    ("key", "left", "right"),
    [("+", -22.5, -7.5), ("-", -45, 0), ("ArrowLeft", -37.5, -7.5), ("ArrowRight", -22.5, 0)],
)
def test_keys_zoom_and_move_the_plot_but_never_beyond_now(moving: Stage, key: str, left: float, right: float) -> None:
    now = moving.run("return hub.now()")
    canvas = moving.page.get_by_role("img", name="Plot of opening in mm")
    canvas.focus()
    moving.page.keyboard.press(key)
    assert moving.run("return window.plot.range.map((one) => one - hub.now())") == pytest.approx([left, right])
    assert [entry["path"] for entry in moving.sent if "points=900" in entry["path"]] == [
        f"nodes/{ARM}/past?channel={number}&from={now + left:.3f}&until={now + right:.3f}&points=900"
        for number in (1, 2)
    ]
    moving.page.keyboard.press("a")
    assert moving.run("return window.plot.range !== null")
    moving.page.keyboard.press("Escape")
    assert moving.run("return [window.plot.range, window.plot.zoomed.size]") == [NONE, 0]


@pytest.mark.parametrize(
    ("key", "left", "right"), [("+", -95, -85), ("-", -110, -70), ("ArrowLeft", -105, -85), ("ArrowRight", -95, -75)]
)
def test_keys_zoom_and_move_a_stretch_of_the_past(moving: Stage, key: str, left: float, right: float) -> None:
    moving.run("window.plot.zoom([hub.now() - 100, hub.now() - 80])")
    moving.page.get_by_role("img", name="Plot of opening in mm").focus()
    moving.page.keyboard.press(key)
    assert moving.run("return window.plot.range.map((one) => one - hub.now())") == pytest.approx([left, right])


def test_a_late_answer_to_an_earlier_zoom_is_dropped_and_an_hour_is_the_most(moving: Stage) -> None:
    moving.answers(**{f"GET nodes/{ARM}/past": HELD})
    moving.run("window.plot.zoom([1, 2]); window.plot.zoom([3, 4])")
    moving.run("window.held.splice(0, 2).forEach((go) => go({ time: [] }))")
    assert moving.run("return window.plot.zoomed.size") == 0
    moving.run("window.held.splice(0).forEach((go) => go({ time: [] }))")
    assert moving.run("return window.plot.zoomed.size") == 2
    moving.run("window.plot.range = [hub.now() - 3590, hub.now()]; window.plot.key({ key: '-', preventDefault() {} })")
    assert moving.run("return window.plot.range[0] - hub.now()") == pytest.approx(-3600)
    moving.run("window.plot.span(10)")
    assert moving.run("return [window.plot.window, window.plot.range]") == [10, NONE], "another length is live again"
    moving.run("window.held.splice(0).forEach((go) => go({ time: [] }))")


def test_the_legend_has_value_rate_and_what_was_lost_and_the_foot_what_came(moving: Stage) -> None:
    now = moving.run("return hub.now()")
    message = {"type": "values", "channels": {f"{ARM}/1": [[now - 0.2, now - 0.1], [1.5, 2.5]]}}
    moving.run("hub.take(words[0])", message)
    moving.pass_time(400)
    assert texts(moving, ".legend li") == [
        "opening 2.5000 20 Hz 3 lost, 4 invalid", "force no value yet 20 Hz 3 lost, 4 invalid",
    ]  # fmt: skip
    assert moving.run("return document.querySelectorAll('.faults.bad').length") == 2
    moving.pass_time(1000)
    assert moving.page.locator(".plot-foot").inner_text().startswith("2 channels · ")
    assert moving.page.locator(".plot-foot").inner_text().endswith("no data lost between station and browser")
    moving.run("hub.take({ type: 'dropped', messages: 1 })")
    moving.pass_time(1200)
    assert moving.page.locator(".plot-foot").inner_text().endswith("1 message dropped: this page is too slow")
    assert moving.page.locator(".plot-foot").get_attribute("data-dropped") == "1"
    change(moving, connection="lost")
    assert moving.page.locator(".charts.stale").count() == 1
    moving.sent  # noqa: B018
    moving.run("window.plot.ask()")
    assert moving.sent == [], "a lost station is not asked"
    change(moving, connection="live")
    moving.run("window.plot.ask()")
    assert {entry["path"].split("&")[0] for entry in moving.sent} == {
        f"nodes/{ARM}/past?channel={number}" for number in (1, 2)
    }
    moving.run("window.plot.pause(true)")
    assert moving.run("return hub.now() - window.plot.paused") == pytest.approx(0.25)
    moving.run("window.plot.pause(false)")
    assert moving.run("return window.plot.paused") is None


def test_a_channel_without_calibration_has_a_frame_of_its_own(stage: Stage) -> None:
    channel = {"number": 1, "unit": "mm", "uncertainty": 0.1, "turn": {"low": 0, "size": 360}}
    channels = [channel, channel | {"problem": "none"}, {"number": 1}]
    found = stage.run("return words.map((one) => plot.plotted('u', one, 'x'))", *channels)
    assert [(one["unit"], one.get("uncertainty"), one.get("turn")) for one in found] == [
        ("mm", 0.1, {"low": 0, "size": 360}), ("raw, not calibrated", NONE, NONE), ("", NONE, NONE),
    ]  # fmt: skip


@pytest.fixture
def whole(browser: Browser) -> Iterator[Stage]:
    """The page as it starts, with a station that answers nothing yet but is live."""
    with staged(browser) as stage:
        stage.answers(
            **{
                "GET status": {
                    "station": {"name": "bench"},
                    "links": [{"via": "can", "place": "can:x"}],
                    "detection": "whitelist",
                },
                "GET nodes": {"nodes": [gripper(), {"uuid": HAND, "name": "slew"}]},
                "GET log": {"entries": [], "intact": True},
                f"GET nodes/{ARM}": gripper(),
                f"GET nodes/{HAND}": {"uuid": HAND, "name": "slew"},
            }
        )
        stage.run("await import('/js/main.js'); window.sockets[0].tell({ type: 'hello' })")
        stage.pass_time(100)
        yield stage
        assert not stage.wrong, stage.wrong


GO = """
  const gone = new Promise((done) => window.addEventListener("hashchange", done, { once: true }));
  location.hash = words[0];
  await gone;
"""


def tap(stage: Stage, uuid: str) -> Any:
    stage.run("window.sockets.at(-1).tell({ type: 'beat' })")
    stage.run("hub.take({ type: 'event', event: 'node', uuid: words[0], state: 'tapped' })", uuid)
    stage.pass_time(100)
    return stage.run("return location.hash")


def test_the_page_as_a_whole(whole: Stage) -> None:
    """All in one, as each would start the page again."""
    begin_with_the_nodes(whole)
    open_what_is_tapped(whole)
    whole.run("document.getElementById('toasts').replaceChildren()")
    show_the_view_of_an_address(whole)
    whole.run("document.getElementById('toasts').replaceChildren(); location.hash = '#/nodes'")
    whole.pass_time(400)
    whole.run("window.sockets.at(-1).tell({ type: 'beat' })")  # it was silent meanwhile
    whole.pass_time(20)
    show_the_connection(whole)


def begin_with_the_nodes(whole: Stage) -> None:
    """Without an address the list is open, and the header is read aloud from left to right."""
    assert whole.run("return [document.title, document.getElementById('main').className]") == [
        "Nodes \u2013 base station", "view-nodes",
    ]  # fmt: skip
    assert len(texts(whole, ".card")) == 2
    assert whole.page.locator("#bar").aria_snapshot() == HEADER
    assert whole.run("return document.getElementById('connection').className") == "pill good"
    assert whole.run("return document.body.classList.contains('lost')") is False


HEADER = """\
- banner:
  - heading "Base station bench" [level=1]
  - text: Live
  - navigation "Views":
    - link "Nodes":
      - /url: "#/nodes"
    - link "Measure":
      - /url: "#/measure"
    - link "Virtual":
      - /url: "#/virtual"
    - link "Log":
      - /url: "#/log"
    - link "Station":
      - /url: "#/station"
  - text: Detection
  - group "Detection":
    - button "Whitelist" [pressed]
    - button "Transparent"
  - button "Discover"\
"""


def open_what_is_tapped(whole: Stage) -> None:
    """A tap opens its node unless something else is being done."""
    assert tap(whole, HAND) == f"#/nodes/{HAND}"
    assert whole.said == "Tapped: slew."
    assert tap(whole, ARM) == f"#/nodes/{HAND}", "another node is open"
    assert texts(whole, ".toast") == ["Tapped: hand. Open it"]
    whole.run(GO, "#/nodes/next/provision")
    whole.run("state.runs.set('next', { state: 'waiting', steps: [] })")
    assert tap(whole, ARM) == f"#/nodes/{ARM}/provision"
    whole.run("state.runs.clear()")
    whole.run(GO, "#/log")
    assert tap(whole, ARM) == "#/log"
    whole.run(GO, "#/nodes")
    whole.page.get_by_role("link", name="Provision the next tapped node").click()
    whole.page.get_by_label("Name", exact=True).fill("typed")
    assert tap(whole, ARM) == "#/nodes/next/provision"
    assert texts(whole, ".toast")[-1] == "Tapped: hand. Not opened because you are typing. It is marked under Nodes."
    whole.run("document.activeElement.blur()")
    whole.run("document.querySelector('main').firstChild.dataset.held = ''")
    assert tap(whole, ARM) == "#/nodes/next/provision"
    assert texts(whole, ".toast")[-1].endswith(
        "Not opened because you are holding an actuator. It is marked under Nodes."
    )
    whole.run("delete document.querySelector('main').firstChild.dataset.held")
    whole.run("document.activeElement.value = document.activeElement.defaultValue; document.activeElement.focus()")
    run = "state.runs.set(words[0], { state: 'done', steps: [], heard: performance.now() - words[1] })"
    for at, ago, opened in (
        ("#/nodes/next/provision", 2900, f"#/nodes/{HAND}/provision"), ("#/nodes", 3100, f"#/nodes/{HAND}"),
        ("#/nodes/", 9999, f"#/nodes/{HAND}"), (f"#/nodes/{HAND}/history", 9999, f"#/nodes/{HAND}/history"),
        (f"#/nodes/{HAND}/history", 100, f"#/nodes/{HAND}/provision"), (f"#/nodes/{ARM}", 100, f"#/nodes/{ARM}"),
    ):  # fmt: skip
        whole.run(GO if whole.run("return location.hash") != at else "", at)
        whole.run("document.getElementById('toasts').replaceChildren()")
        whole.run(run, HAND, ago)
        assert tap(whole, HAND) == opened, (at, ago)
        assert texts(whole, ".toast") == (["Tapped: slew. Open it"] if at.endswith(ARM) else []), at
    assert whole.page.get_by_role("link", name="Open it").get_attribute("href") == f"#/nodes/{HAND}"
    whole.run("state.runs.clear()")
    whole.answers(**{f"GET nodes/{THIRD}": {"refused": 404}})
    tap(whole, THIRD)
    assert whole.said == "Tapped: node c3c3c3c3."


def show_the_connection(whole: Stage) -> None:
    """The header says how the connection is, and has what this browser may do."""
    assert (text(whole, "h1"), text(whole, "#connection")) == ("Base station bench", "Live")
    assert whole.run("return document.title") == "Nodes – base station"
    assert whole.page.get_by_role("button", name="Whitelist", pressed=True).count() == 1
    whole.sent  # noqa: B018
    whole.pass_time(1000)
    whole.run("window.sockets.at(-1).tell({ type: 'beat' })")
    whole.pass_time(1050)
    assert [entry["path"] for entry in whole.sent] == ["status"], "every two seconds"
    whole.answers(**{"PUT detection": {"refused": 409, "message": "Not now.", "hint": "Later."}})
    press(whole, "Transparent")
    assert whole.sent[0] == {"method": "PUT", "path": "detection", "body": {"mode": "transparent"}}
    assert texts(whole, ".toast.bad") == ["Not now. Later."]
    whole.answers(**{"PUT detection": {}})
    press(whole, "Transparent")
    whole.pass_time(20)
    assert [entry["path"] for entry in whole.sent] == ["detection", "status", "nodes"]
    assert whole.said == "Detection: transparent. Read and show every node found."
    for answer, words in (
        ({"nodes": [1, 2]}, "2 nodes answered."),
        ({"nodes": []}, "No node answered. Is it powered and on the bus?"
                        " A node with NFC is found when you place it on the reader."),
        ({"refused": 503, "message": "Busy.", "hint": "Later."}, "Busy. Later."),
    ):  # fmt: skip
        whole.answers(**{"POST discover": answer})
        press(whole, "Discover")
        whole.pass_time(20)
        assert texts(whole, ".toast")[-1] == words
        assert (
            whole.page.locator(".toast").last.get_attribute("class")
            == f"toast {'bad' if 'refused' in answer else 'good'}"
        )
    assert whole.said == "Looking for nodes on every link."
    asked = [entry["path"] for entry in whole.sent]
    assert [path for path in asked if path != "status"] == ["discover", "nodes"] * 2 + ["discover"]
    assert asked[:3] == ["discover", "nodes", "status"]
    whole.answers(**{"POST discover": HELD})
    press(whole, "Discover")
    change(whole, total=2)
    assert whole.page.get_by_role("button", name="Discover").is_disabled()
    whole.run("window.held.shift()({ nodes: [] })")
    whole.answers(**{"GET status": {"links": [{"virtual": True}]}, "POST discover": {"nodes": []}})
    whole.run("await hub.refresh('status')")
    press(whole, "Discover")
    whole.pass_time(20)
    assert texts(whole, ".toast")[-1].startswith("No node answered. No link is configured, so no board is found.")
    problem = {"message": "No passphrase.", "hint": "Unlock it."}
    whole.answers(**{"GET status": {"links": [], "vault": {"problem": problem}, "write": False}})
    whole.run("await hub.refresh('status')")
    whole.pass_time(20)
    assert text(whole, "#banner") == "The vault is locked. No passphrase. Unlock it."
    assert [
        whole.page.get_by_role("button", name=name).is_disabled() for name in ("Discover", "Whitelist", "Transparent")
    ] == [True] * 3
    whole.run("window.sockets.at(-1).end(1006)")
    whole.pass_time(20)
    assert (text(whole, "#connection"), whole.said) == ("Connection lost", "Connection lost.")
    look = "return [document.getElementById('connection').className, document.body.classList.contains('lost')]"
    assert whole.run(look) == ["pill bad", True]
    assert text(whole, "#banner").startswith("Connection to the base station lost. These values are out of date.")
    whole.pass_time(320)
    whole.run("window.sockets.at(-1).tell({ type: 'beat' })")
    whole.pass_time(20)
    assert (text(whole, "#connection"), whole.said) == ("Live", "Connected.")
    assert whole.run(look) == ["pill good", False]
    whole.run("window.sockets.at(-1).end(1008)")
    whole.pass_time(20)
    assert (text(whole, "#connection"), whole.page.locator("#banner code").inner_text()) == (
        "Signed out", "teds-provision ncap open",
    )  # fmt: skip
    assert whole.run(look) == ["pill bad", True]
    whole.sent  # noqa: B018
    whole.pass_time(4100)
    assert whole.sent == [], "it asks no more"


def show_the_view_of_an_address(whole: Stage) -> None:
    """An address that names no view is the list of nodes; an error is told."""
    for address, title, name in (
        ("#/log", "Log", "log"),
        ("#/toString", "Nodes", "nodes"),
        ("#station", "Station", "station"),
    ):
        whole.run(GO, address)
        whole.pass_time(20)
        assert whole.run("return document.title") == f"{title} – base station"
        assert whole.run("return document.querySelector('nav a[aria-current=page]').dataset.view") == name
    whole.run("Promise.reject(new Error('It broke.')); Promise.reject(new DOMException('x', 'AbortError'))")
    whole.page.get_by_text("It broke.").wait_for()
    assert len(texts(whole, ".toast")) == 1
    whole.wrong.clear()
