"""Accessibility tree of each view: roles, names, order, and what is pressed, checked or disabled.

Each view stands in ``aloud/VIEW.yaml`` as the browser's accessibility tree, so whatever is left out of a view, or loses
its name, differs. After a change that is meant, rewrite them with ``ALOUD=write pytest tests/page/test_aloud.py``,
and read the difference.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import pytest

from .stage import ARM, HAND, NOW
from .stage import FOLDER as PAGE
from .test_forms import BOARDS, DRY, IMAGE, PLAN, entries, give, texts
from .test_overview import SAYS, THIRD, listing
from .test_panels import ANGLE, PAIR, RUNNING, measured
from .test_parts import CHECKS, PROVISION, READ, READY, TEDS, VIRTUAL, judged
from .test_views import change, gripper, nodes, press

if TYPE_CHECKING:
    from collections.abc import Callable

    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
FOLDER = Path(__file__).parent / "aloud"
VIEWS: dict[str, Callable[[Stage], None]] = {}


def view(show: Callable[[Stage], None]) -> Callable[[Stage], None]:
    """Let a function show the view of its name."""
    VIEWS[show.__name__] = show
    return show


def make(stage: Stage, what: str, *words: Any) -> None:
    """Show what a script makes, in ``main``."""
    stage.run(f"const main = document.getElementById('main'); window.made = show({what})", *words)
    stage.pass_time(20)


def unfold(stage: Stage) -> None:
    """Open what a click would open."""
    stage.run("document.querySelectorAll('details').forEach((one) => (one.open = true))")


@view
def no_nodes(stage: Stage) -> None:
    listing(stage)
    change(stage, status={"strangers": 2, "links": []})


@view
def nodes_selected(stage: Stage) -> None:
    power = {"percent": 80, "charging": "charging", "low": False}
    known = judged() | {"power": power, "fingerprint": "abcd1234", "problem": {"message": "Odd.", "hint": "Look."}}
    crowd = [{"uuid": f"{number:020x}", "name": f"joint {number}", "present": False} for number in range(1, 7)]
    nodes(stage, known, *crowd)
    stage.answers(**{"GET nodes": {"nodes": [known]}})
    change(stage, groups=[PAIR])
    listing(stage, ARM)
    press(stage, "Select")
    change(stage, updates=[{"state": "running", "image": {"version": "1.4.0"}, "boards": [{"state": "waiting"}]}])
    unfold(stage)
    stage.page.get_by_label("Select hand").check()


@view
def stranger(stage: Stage) -> None:
    nodes(stage, gripper(channels=[], whitelisted=False))
    make(stage, "new values.LiveTab(main, words[0])", ARM)


@view
def live(stage: Stage) -> None:
    own = {"id": "m", "state": "running", "uuids": [ARM], "owner": "page", "nodes": [], "lower_rate": 10}
    nodes(stage, gripper())
    make(stage, "new values.LiveTab(main, words[0])", ARM)
    measured(stage, own | {"actuators": True, "dead_man": 250}, status={"actuators": True, "links": []})


@view
def datasheet(stage: Stage) -> None:
    guard = {"severity": "error", "message": "Odd.", "hint": "Look."}
    curve = {"name": "opening", "x_unit": "", "y_unit": "mm", "points": [[0, 0], [2047, NONE], [4095, 110]]}
    answer = READ | {"verdict": "unsigned", "checks": CHECKS, "guard": [guard], "curves": [curve]}
    nodes(stage, gripper())
    stage.answers(**{TEDS: answer, "GET nodes": {"nodes": [gripper()]}})
    make(stage, "new datasheet.DatasheetTab(main, words[0])", ARM)
    unfold(stage)


@view
def no_datasheet(stage: Stage) -> None:
    nodes(stage, gripper())
    stage.answers(**{TEDS: READ | {"verdict": "unproven", "teds": []}, "GET nodes": {"nodes": [gripper()]}})
    make(stage, "new datasheet.DatasheetTab(main, words[0])", ARM)


@view
def changes(stage: Stage) -> None:
    nodes(stage, gripper())
    stage.answers(**{DRY: PLAN})
    make(stage, "new write.WritePanel(words[0], () => 0)", ARM)
    stage.run("document.getElementById('main').append(window.made.element)")
    give(stage, "slew.json", "{}")
    stage.page.get_by_role("heading", name="slew.json: 5 changes").wait_for()


@view
def suspicious(stage: Stage) -> None:
    nodes(stage, gripper())
    stage.answers(**{DRY: {"refused": 422, "message": "Odd.", "hint": "See --accept-calibration."}})
    make(stage, "new write.WritePanel(words[0], () => 0)", ARM)
    stage.run("document.getElementById('main').append(window.made.element)")
    give(stage, "slew.json", "{}")
    stage.page.get_by_role("button", name="Accept and compare again").wait_for()


@view
def provision(stage: Stage) -> None:
    nodes(stage, gripper())
    stage.answers(**{f"GET {PROVISION}": {"state": "done"}})
    stage.run("state.profiles = [{ name: 'gripper', title: 'Gripper' }, { name: 'load-cell' }]")
    make(stage, "new provision.ProvisionTab(main, words[0])", ARM)
    give(stage, "cell.xml", "<a/>")
    steps = [{"name": "identify", "result": "done", "detail": "hand"}, {"name": "agree", "result": "running"}]
    stage.run("state.runs.set(words[0], words[1])", ARM, {"state": "waiting", "until": NOW + 99, "steps": steps})
    change(stage)
    stage.pass_time(250)


@view
def history(stage: Stage) -> None:
    told = [*entries(2), *entries(1, failed=True, detail=NONE, actor=NONE, who="lab")]
    stage.answers(**{"GET log": {"entries": told}})
    make(stage, "new history.HistoryTab(main, words[0])", ARM)


@view
def log(stage: Stage) -> None:
    told = [*entries(2, uuid=ARM), *entries(1, failed=True, detail=NONE)]
    nodes(stage, gripper())
    stage.answers(**{"GET log": {"entries": told, "intact": True}})
    make(stage, "log.logView(main)")


@view
def measure(stage: Stage) -> None:
    nodes(stage, gripper(), ANGLE)
    stage.run("state.groups = words", PAIR)
    make(stage, "measure.measureView(main)")
    alone = {"id": "x", "state": "running", "uuids": [ARM], "nodes": [], "match": NONE}
    measured(stage, RUNNING, alone, status={"actuators": True, "links": []})
    unfold(stage)


@view
def measure_idle(stage: Stage) -> None:
    make(stage, "measure.measureView(main)")
    nodes(stage, gripper())
    change(stage, groups=[PAIR | {"uuids": [ARM]}])


@view
def virtual(stage: Stage) -> None:
    stage.answers(**{"GET virtual": {"virtual": [VIRTUAL | {"source": "simulation"}]},
                     "GET profiles": {"profiles": [{"name": "gripper"}]}})  # fmt: skip
    make(stage, "virtual.virtualView(main)")
    press(stage, "Set values of dummy")
    stage.run("window.sockets.at(-1).tell(words[0])", READY)
    unfold(stage)


@view
def station(stage: Stage) -> None:
    plant = {
        "name": "Augsburg", "roster": 2, "expires": NOW, "age": 7300, "why": "no route", "unsent": 1, "to_rotate": 2,
        "alarms": [{"code": "fork", "about": "x", "at": 1, "seen": False, "why": "two pages"}], "conflicts": [],
        "stations": [{"fingerprint": "f1", "name": "north", "state": "here", "roles": ["keeper"], "page": 4, "age": 5}],
    }  # fmt: skip
    steps = {"agree": {"median": 1, "worst": 2.5}, "write": {"median": 0.5, "worst": 0.5}}
    parts = [
        {"name": "north", "allotment": 4, "units": 5, "passed": 4, "first_pass": 0.6, "over": True, "attempts": 7,
         "steps": steps, "failures": {"node-silent": 1, "no-key": 2}},
        {"name": "south", "allotment": 3, "units": 0, "passed": 0, "first_pass": NONE, "over": False, "attempts": 0,
         "steps": {}, "failures": {}},
        {"name": "east", "allotment": 3, "units": 1, "passed": 0, "first_pass": 0, "over": False, "attempts": 1,
         "steps": {}, "failures": {}},
    ]  # fmt: skip
    job = {"id": "j", "title": "fingers", "passed": 4, "total": 10, "profile": "gripper", "state": "open", "ends": NOW}
    status = {
        "links": [{"place": "can:can0", "via": "can", "state": "up"}], "plant": True, "write": True,
        "station": {"name": "bench", "fingerprint": "abcd1234"}, "version": "1.0", "started": NOW,
        "sinks": [{"measurement": "m", "name": "run.csv", "state": "running", "written": 5}],
        "foxglove": "ws://127.0.0.1:8765", "budget": {"used": 12.5, "limit": 1000},
    }  # fmt: skip
    held = {"nodes": [{"uuid": ARM, "name": "hand", "says": SAYS, "conflicts": []}], "more": True}
    names = [{"uuid": ARM, "channel": 2, "topic": "/b/hand/opening"}, {"uuid": THIRD, "channel": 0, "topic": NONE}]
    nodes(stage, gripper())
    stage.answers(**{"GET plant": plant, "GET jobs": {"jobs": [job]}, "GET jobs/j": job | {"stations": parts},
                     "GET status": status, "GET names": {"names": names}, "GET plant/nodes": held})  # fmt: skip
    stage.run("state.status = { plant: true, links: [] }")
    make(stage, "station.stationView(main)")
    stage.page.get_by_role("searchbox", name="Who holds a node").fill("hand")
    stage.page.get_by_text("fingers").click()
    stage.page.get_by_text("first pass").first.wait_for()
    stage.pass_time(310)


@view
def update(stage: Stage) -> None:
    nodes(stage, *({"uuid": uuid, "name": name} for uuid, name in ((ARM, "arm"), (HAND, "hand"), (THIRD, "third"))))
    stage.answers(**{"POST updates": {"image": IMAGE, "boards": BOARDS, "id": "u1"}})
    make(stage, "new update.UpdatePanel(main, () => words, () => 0)", ARM, HAND)
    give(stage, "finger.bin", "x" * 2049)
    stage.page.get_by_text("finger.bin, 3 KiB").wait_for()
    press(stage, "Show the plan")


@view
def updating(stage: Stage) -> None:
    board = {"from": "1.3.0", "to": "1.4.0"}
    boards = [board | {"uuid": ARM, "state": "running", "step": "upload", "octets": 200, "written": 101},
              board | {"uuid": HAND, "state": "waiting"}]  # fmt: skip
    told = {"id": "u1", "state": "running", "image": IMAGE, "owner": "api:lab", "began": NOW, "boards": boards}
    nodes(stage, {"uuid": ARM, "name": "arm"})
    stage.answers(**{"GET updates": {"updates": [told]}})
    make(stage, "new update.UpdatePanel(main, () => [], () => 0)")


LATER = """
  for (const node of state.nodes.values()) Object.assign(node, { name: "renamed", whitelisted: false });
  Object.assign(state, { connection: "lost", status: { write: false, plant: true, links: [{ name: "x" }] },
    groups: [], measurements: [], virtual: [], names: [], profiles: [{ name: "other" }], updates: [] });
  state.runs.clear();
  hub.changed(..."status nodes groups measurements virtual updates update profiles names connection tap route log "
    .concat("provision actuator plot").split(" "));
"""
LOOK = "return document.getElementById('main').innerHTML"
CLASSES = """
  const found = [...document.querySelectorAll("[class]")].flatMap((one) => [...one.classList]);
  return [...new Set(found)].filter((one) => !one.startsWith("u-") && one !== "uplot");
"""


class Seen(NamedTuple):
    """Content of a view, and effects after it was left: requests, errors, or another appearance."""

    aloud: str
    classes: set[str]
    after: Any


def look_at(stage: Stage, show: Callable[[Stage], None]) -> Seen:
    """Show a view and leave it; then change the whole state, for longer than any view waits."""
    stage.reset()
    show(stage)
    stage.pass_time(20)
    aloud, classes = stage.page.locator("main").aria_snapshot() + "\n", set(stage.run(CLASSES))
    stage.run("hub.changed('log', 'nodes')")  # some wait a moment after these
    stage.pass_time(20)
    stage.run("window.ends.splice(0).forEach((one) => one.end())")
    before = stage.run(LOOK)
    stage.sent  # noqa: B018
    stage.run(LATER)
    stage.pass_time(100)
    stage.run("state.connection = 'live'")
    stage.pass_time(3000)
    stage.pass_time(40_000)
    after = stage.run(LOOK)
    wrong = [*stage.sent, *stage.wrong, *stage.run("return [...document.getElementById('toasts').children]"
                                                   ".map((one) => one.textContent)")]  # fmt: skip
    return Seen(aloud, classes, wrong or (after if after != before else None))


@pytest.fixture(scope="module")
def seen(modules: Stage) -> dict[str, Seen]:
    """Look at each view once."""
    return {name: look_at(modules, show) for name, show in VIEWS.items()}


def test_each_view_is_read_aloud_as_it_stands_in_its_file(seen: dict[str, Seen]) -> None:
    if os.environ.get("ALOUD") == "write":
        for name, view in seen.items():
            (FOLDER / f"{name}.yaml").write_text(view.aloud, encoding="utf-8")
    kept = {file.stem: file.read_text(encoding="utf-8") for file in FOLDER.glob("*.yaml")}
    assert {name: view.aloud for name, view in seen.items()} == kept


def test_a_view_that_was_left_asks_nothing_and_changes_nothing(seen: dict[str, Seen]) -> None:
    assert {name: view.after for name, view in seen.items() if view.after is not None} == {}


AT_ONCE = {
    "station.stationView(main)": ["Values are not recorded or published.", "No channels are published yet."],
    "virtual.virtualView(main)": ["No virtual transducers yet."],
    "measure.measureView(main)": ["No groups yet.", "No measurement is running."],
    "nodes.nodesView(main, [])": ["Loading \u2026"],
    "new update.UpdatePanel(main, () => [], () => 0)": ["No boards are selected."],
}


@pytest.mark.parametrize("what", AT_ONCE)
def test_a_view_is_there_before_the_station_has_answered(stage: Stage, what: str) -> None:
    stage.answers(**{f"GET {name}": "held" for name in ("status", "names", "profiles", "virtual", "updates", "jobs")})
    try:
        stage.run(f"state.loaded = false; const main = document.getElementById('main'); show({what})")
        found = texts(stage, "main .empty .lead, main p.empty, main .stack > p:first-child")
        assert found[: len(AT_ONCE[what])] == AT_ONCE[what]
    finally:  # else the next test's questions wait for these
        stage.run("window.ends.splice(0).forEach((one) => one.end()); window.held.splice(0).forEach((go) => go({}))")
        stage.pass_time(20)


# what an element is, for tests and scripts; it has no look of its own
BARE = {"plain", "busy-line", "brought", "arrow", "rate-hint", "check", "actuator-state", "fresh", "feed-state",
        "feed-channels"}  # fmt: skip


def test_each_class_of_an_element_is_one_of_the_style_sheets_and_each_of_these_is_used(seen: dict[str, Seen]) -> None:
    """One with another name has no colour and no place."""
    sheets = "\n".join(file.read_text(encoding="utf-8") for file in (PAGE / "css").glob("*.css"))
    selectors = "".join(re.findall(r"([^{}]+)\{", re.sub(r"/\*.*?\*/", "", sheets, flags=re.DOTALL)))
    styled = set(re.findall(r"\.([a-z][\w-]*)", selectors))
    assert {name: view.classes - styled - BARE for name, view in seen.items() if view.classes - styled - BARE} == {}
    scripts = "\n".join(file.read_text(encoding="utf-8") for file in [PAGE / "index.html", *PAGE.glob("js/**/*.js")])
    words = {
        word for text in re.findall(r"[\"`]([^\"`\n]*)[\"`]", scripts) for word in re.findall(r"[a-z][\w-]*", text)
    }
    made = {f"line-{number}" for number in range(1, 9)} | {"view-nodes", "u-select", "u-cursor-x"}
    assert styled - words == made


def test_each_icon_that_a_script_names_is_drawn() -> None:
    """An unknown one is drawn as a question mark."""
    scripts = {file.name: file.read_text(encoding="utf-8") for file in PAGE.glob("js/**/*.js")}
    drawn = re.search(r"const PATHS = \{(.*?)\n\};", scripts["dom.js"], re.DOTALL)
    assert drawn is not None
    known = set(re.findall(r"^  (\w+): \"M", drawn[1], re.MULTILINE))
    patterns = (
        r"icon\(\"(\w*)\"\)", r"chip\(\"\w*\", \"(\w*)\"", r"button\([^{}]*\{[^{}]*\}, \"(\w*)\"\)",
        r"\[\"(?:good|warn|bad|plain|busy)\", \"(\w*)\"(?:, \"[^\"]*\")?\]",
    )  # fmt: skip
    named = {(name, one) for name, text in scripts.items() for pattern in patterns for one in re.findall(pattern, text)}
    assert len(named) > 50
    assert {one for one in named if one[1] not in known} == set()
