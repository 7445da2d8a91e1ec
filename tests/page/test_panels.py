"""Panels of the page: how a group and a node are measured, values, a node's head, datasheets, the station."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM, HAND
from .test_forms import text, texts
from .test_views import change, gripper, nodes, press

if TYPE_CHECKING:
    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
THIRD = "c3" * 10
PAIR = {"name": "pair", "uuids": [ARM, HAND]}
ANGLE = {"uuid": HAND, "name": "slew", "present": False,
         "channels": [{"number": 1, "name": "angle", "kind": "sensor", "unit": "rad", "rate": 50}]}  # fmt: skip


def sent(stage: Stage) -> list[Any]:
    """Return what the page changed since the last time."""
    return [entry for entry in stage.sent if entry["method"] != "GET"]


def measured(stage: Stage, *measurements: dict[str, Any], **more: Any) -> None:
    """Let the station have these measurements."""
    stage.answers(**{"GET measurements": {"measurements": measurements}})
    change(stage, measurements=measurements, **more)


@pytest.fixture
def measuring(stage: Stage) -> Stage:
    """The view of groups: one of a gripper and an absent angle sensor."""
    nodes(stage, gripper(), ANGLE)
    stage.answers(**{"GET groups": {"groups": [PAIR]}, "GET nodes": {"nodes": [gripper(), ANGLE]}})
    stage.run("state.groups = words; show(measure.measureView(document.getElementById('main')))", PAIR)
    stage.pass_time(20)
    stage.sent  # noqa: B018
    return stage


def test_a_group_is_created_from_its_name_and_selected_nodes(measuring: Stage) -> None:
    nodes(measuring, {"uuid": THIRD, "name": "stranger", "whitelisted": False})
    measuring.pass_time(20)
    measuring.page.get_by_text("New group").click()
    press(measuring, "Create group")
    assert texts(measuring, ".new .trouble") == ["Enter a name for the group. A short one will do, such as hand."]
    measuring.page.get_by_label("Name", exact=True).fill(" arm ")
    press(measuring, "Create group")
    assert texts(measuring, ".new .trouble") == [
        "Select at least one node. A group is the nodes that you want to measure together."
    ]
    assert sent(measuring) == []
    assert texts(measuring, ".new .members label") == ["hand not checked", "slew not checked"]
    measuring.page.get_by_role("group", name="Nodes").get_by_role("checkbox", name="slew").check()
    measuring.answers(**{"POST groups": {"refused": 409, "message": "There is one.", "hint": "Another name."}})
    press(measuring, "Create group")
    assert texts(measuring, ".new .trouble") == ["There is one. Another name."]
    measuring.answers(**{"POST groups": {}, "GET groups": {"groups": [PAIR]}})
    press(measuring, "Create group")
    assert sent(measuring)[1:] == [{"method": "POST", "path": "groups", "body": {"name": "arm", "uuids": [HAND]}}]
    assert measuring.said == "Group arm created. Press Start to measure it."
    assert measuring.page.locator(".new input:checked").count() == 0
    assert texts(measuring, ".new .trouble") == [], "that was another try"


def test_a_group_starts_with_what_its_card_says(measuring: Stage) -> None:
    measuring.page.get_by_text("More", exact=True).click()
    press(measuring, "Start pair")
    measuring.page.get_by_label("Rate, Hz").fill("20")
    measuring.page.get_by_label("Kind").select_option("event")
    measuring.page.get_by_label("Start all nodes together").check()
    measuring.page.get_by_label("Record to").fill(" run.csv ")
    change(measuring, status={"actuators": True, "dead_man": 300, "links": []})
    measuring.page.get_by_label("Dead-man, ms").fill("250")
    measuring.page.get_by_label("Allow topics").uncheck()
    press(measuring, "Start pair")
    body: dict[str, Any] = {
        "group": "pair",
        "rate": NONE,
        "kind": "periodic",
        "trigger": False,
        "sinks": [],
        "actuators": True,
    }
    assert [entry["body"] for entry in sent(measuring)] == [
        body,
        body
        | {"rate": 20, "kind": "event", "trigger": True, "sinks": ["run.csv"], "actuators": False, "dead_man": 250},
    ]
    assert measuring.said == "Group pair is now measuring."
    for rate, words in (
        ("0", "Enter a rate above 0 Hz. Or leave it empty to use the rate in the datasheet."),
        ("51", "angle of slew supports at most 50 Hz."
               " Enter a lower rate, or leave it empty to use the rate in each datasheet."),
    ):  # fmt: skip
        measuring.page.get_by_label("Rate, Hz").fill(rate)
        press(measuring, "Start pair")
        assert texts(measuring, "li.group .trouble") == [words]
    for dead_man in ("19", "10001", "20.5"):
        measuring.page.get_by_label("Rate, Hz").fill("50")
        measuring.page.get_by_label("Dead-man, ms").fill(dead_man)
        press(measuring, "Start pair")
        assert texts(measuring, "li.group .trouble") == [
            "The dead-man must be between 20 and 10000 ms. Leave it empty to use the station's default of 300 ms."
        ]
    assert sent(measuring) == []
    for dead_man in ("20", "10000"):
        measuring.page.get_by_label("Dead-man, ms").fill(dead_man)
        press(measuring, "Start pair")
    assert [entry["body"]["dead_man"] for entry in sent(measuring)] == [20, 10_000]


RUNNING = {
    "id": "m 1", "group": "pair", "state": "running", "kind": "event", "trigger": True, "actuators": True,
    "dead_man": 250, "sinks": ["/var/lib/run.csv", "ros2"], "owner": "page", "match": NONE, "uuids": [],
    "nodes": [
        {"uuid": ARM, "state": "running", "samples": 1, "lost": 2, "late": 3, "bad": 4},
        {"uuid": HAND, "state": "waiting", "why": "It is away."},
    ],
}  # fmt: skip


def test_a_running_group_says_how_each_node_fares_and_is_only_stopped(measuring: Stage) -> None:
    assert texts(measuring, ".member-list li") == ["hand", "slew away"]
    assert text(measuring, "li.group .chip") == "idle"
    measured(measuring, RUNNING, status={"actuators": True, "links": []})
    assert texts(measuring, ".member-list li") == [
        "hand running, 1 sample, 2 lost, 3 late, 4 bad.",
        "slew waiting. It is away.",
    ]
    assert text(measuring, "li.group .chip") == "running"
    assert measuring.page.get_by_role("button", name="Start pair").is_hidden()
    measuring.page.get_by_text("More", exact=True).click()
    locked = ["Rate, Hz", "Kind", "Start all nodes together", "Record to", "Allow topics", "Dead-man, ms"]
    assert [measuring.page.get_by_label(name).is_disabled() for name in locked] == [True] * 6
    assert measuring.page.get_by_role("button", name="Delete group").is_disabled()
    assert measuring.page.get_by_role("button", name="Save members").is_disabled()
    assert text(measuring, "[aria-label='Set points from topics'] > .hint") == (
        "Accepted. An actuator goes to its safe state 250 ms after the last one."
    )
    press(measuring, "Stop pair")
    assert sent(measuring) == [{"method": "DELETE", "path": "measurements/m 1", "body": {}}]
    assert measuring.said == "Group pair is idle."
    measured(measuring, RUNNING | {"owner": "command", "process": {"id": 7}, "actuators": False})
    assert measuring.page.get_by_role("button", name="Stop pair").is_disabled()
    assert text(measuring, "li.group > p.hint") == "Run by the command measure (process 7). End it there with Ctrl-C."
    assert measuring.page.get_by_label("Allow topics").is_checked() is False
    error = {"message": "The disk is full.", "hint": "Make room."}
    measured(measuring, RUNNING | {"state": "failed", "error": error})
    assert (text(measuring, "li.group .chip"), texts(measuring, "li.group .trouble")) == (
        "failed", ["The disk is full. Make room."],
    )  # fmt: skip
    assert measuring.page.locator("li.group .chip.bad").count() == 1
    measured(measuring, RUNNING, status={"write": False, "links": []})
    assert measuring.page.get_by_role("button", name="Stop pair").is_disabled()


def test_values_that_get_lost_offer_a_lower_rate_and_all_else_stays(measuring: Stage) -> None:
    measured(measuring, RUNNING | {"lower_rate": 12.5})
    hint = "li.group .rate-hint"
    assert texts(measuring, hint) == ["Values are being lost at this rate. Measure at 12.5 Hz"]
    measured(measuring, RUNNING | {"lower_rate": 20})
    assert texts(measuring, hint) == ["Values are being lost at this rate. Measure at 12.5 Hz"], "not a higher one"
    measured(measuring, RUNNING | {"lower_rate": 10})
    press(measuring, "Measure at 10 Hz")
    measuring.pass_time(20)
    assert sent(measuring) == [
        {"method": "DELETE", "path": "measurements/m 1", "body": {}},
        {"method": "POST", "path": "measurements",
         "body": {"group": "pair", "rate": 10, "kind": "event", "trigger": True, "sinks": ["run.csv", "ros2"],
                  "actuators": True, "dead_man": 250}},
    ]  # fmt: skip
    assert measuring.said == "Group pair is now measured at 10 Hz."
    measured(measuring, RUNNING | {"lower_rate": 10, "owner": "command", "process": {"id": 7}})
    assert measuring.page.locator(hint).is_hidden()


def test_a_rate_that_fits_is_a_preset_unless_the_datasheets_fits(measuring: Stage) -> None:
    rate = "GET measurements/rate"
    hint = measuring.page.locator("li.group .rate-hint")
    proposal = {"rate": 25, "limit": "bus", "stated": 10_000, "why": "the bus carries 25 Hz"}
    for answer, words in (
        ({"proposal": NONE}, NONE),
        ({"refused": 404}, NONE),
        ({"proposal": proposal}, "Values may be lost at the datasheet's 10 kHz: the bus carries 25 Hz. Use 25 Hz"),
        ({"proposal": proposal | {"limit": "datasheet"}}, NONE),
        ({"proposal": proposal}, "Values may be lost at the datasheet's 10 kHz: the bus carries 25 Hz. Use 25 Hz"),
    ):
        measuring.answers(**{rate: answer})
        measuring.pass_time(30_010)
        change(measuring)
        measuring.pass_time(20)
        asked = [entry["path"] for entry in measuring.sent if "rate" in entry["path"]]
        assert asked[-1:] == ["measurements/rate?group=pair"]
        assert hint.is_visible() is (words is not None)
        if words:
            assert texts(measuring, "li.group .rate-hint") == [words]
    change(measuring)
    assert [entry for entry in measuring.sent if "rate" in entry["path"]] == [], "asked once in half a minute"
    press(measuring, "Use 25 Hz")
    assert measuring.page.get_by_label("Rate, Hz").input_value() == "25"
    assert measuring.page.evaluate("document.activeElement.type") == "number"
    assert (sent(measuring), hint.is_hidden()) == ([], True)


def test_members_are_kept_and_a_group_is_deleted(measuring: Stage) -> None:
    measuring.page.get_by_text("More", exact=True).click()
    members = measuring.page.get_by_role("group", name="Members")
    assert members.get_by_role("checkbox").count() == 2
    members.get_by_role("checkbox", name="hand").uncheck()
    press(measuring, "Save members")
    assert measuring.said == "Group pair has 1 member."
    measuring.answers(**{"DELETE groups/pair": {"refused": 409, "message": "It is measured.", "hint": "Stop it."}})
    press(measuring, "Delete group")
    assert texts(measuring, "li.group .trouble") == ["It is measured. Stop it."]
    assert sent(measuring) == [
        {"method": "PUT", "path": "groups/pair", "body": {"uuids": [HAND]}},
        {"method": "DELETE", "path": "groups/pair", "body": {}},
    ]


def test_a_measurement_without_a_group_is_named_by_whom_it_measures(measuring: Stage) -> None:
    many = [{"uuid": uuid, "state": state, "samples": 5, "lost": lost}
            for uuid, state, lost in ((ARM, "running", 0), (HAND, "lost", 2), (THIRD, "running", 0))]  # fmt: skip
    one = {"id": "m", "state": "running", "owner": "page", "uuids": [ARM], "nodes": many[:1], "match": NONE}
    cases: list[tuple[dict[str, Any], list[str]]] = [
        (one, ["hand", "running, 5 samples, none lost."]),
        (one | {"uuids": [ARM, HAND, THIRD], "nodes": many},
         ["3 nodes", "2 running, 1 lost, 15 samples, 2 lost: hand, node c3c3c3c3, slew."]),
        (one | {"match": "all"}, ["All trusted nodes", "1 node measured: hand"]),
        (one | {"match": "type:gripper", "uuids": [ARM], "nodes": [
            {"uuid": HAND, "state": "waiting", "why": "No trust"}, {"uuid": THIRD, "state": "waiting", "why": ""}]},
         ["type:gripper", "1 node measured: hand. slew waits: No trust"]),
    ]  # fmt: skip
    for measurement, words in cases:
        measured(measuring, measurement)
        where = ".side-wide > ul:last-child li"
        assert texts(measuring, f"{where} h4, {where} p") == words
        assert measuring.page.get_by_role("button", name="Measure all trusted nodes").is_visible() is (
            measurement.get("match") != "all"
        )
    press(measuring, "Stop")
    press(measuring, "Measure all trusted nodes")
    assert sent(measuring) == [
        {"method": "DELETE", "path": "measurements/m", "body": {}},
        {"method": "POST", "path": "measurements", "body": {"match": "all"}},
    ]


def test_the_plot_shows_what_is_measured_or_chosen_up_to_twenty_channels(measuring: Stage) -> None:
    assert texts(measuring, ".pick summary") == ["Channels: 0 of 2 shown"]
    assert text(measuring, ".wide .empty .lead") == "No measurement is running."
    measured(measuring, RUNNING)
    assert texts(measuring, ".pick summary") == ["Channels: 2 of 2 shown"]
    assert texts(measuring, ".legend .label") == ["hand opening", "slew angle"], "of two nodes, so with their names"
    measuring.page.get_by_text("Channels:").click()
    assert texts(measuring, ".pick label") == ["hand: opening", "slew: angle"], "no actuator"
    measuring.page.get_by_label("slew: angle").uncheck()
    measuring.pass_time(20)
    assert texts(measuring, ".legend .label") == ["opening"]
    measured(measuring)
    measuring.page.get_by_label("slew: angle").check()
    measuring.pass_time(20)
    assert texts(measuring, ".legend .label") == ["angle"], "a choice stays"
    crowd = {
        "uuid": THIRD,
        "name": "crowd",
        "channels": [{"number": number, "kind": "sensor", "unit": "V"} for number in range(1, 23)],
    }
    nodes(measuring, crowd)
    measured(measuring, {"state": "running", "uuids": [THIRD], "nodes": []})
    assert texts(measuring, ".pick summary") == ["Channels: 20 of 24 shown (at most 20)"]


def mode(stage: Stage, **more: Any) -> None:
    """The live tab of the gripper."""
    nodes(stage, gripper(**more))
    stage.answers(**{"GET nodes": {"nodes": [gripper(**more)]}})
    stage.run("show(new values.LiveTab(document.getElementById('main'), words[0]))", ARM)
    stage.pass_time(20)
    stage.sent  # noqa: B018


def test_a_node_is_measured_and_idle_again_and_what_others_began_is_named(stage: Stage) -> None:
    mode(stage)
    idle, run = (stage.page.get_by_role("button", name=name, exact=True) for name in ("Idle", "Measure"))
    assert (idle.is_disabled(), run.is_enabled(), text(stage, ".mode .state")) == (True, True, "Idle.")
    stage.page.get_by_label("Rate, Hz").fill("100")
    run.click()
    assert [entry["body"] for entry in sent(stage)] == [
        {"uuids": [ARM], "rate": 100, "kind": "periodic", "trigger": False, "sinks": [], "actuators": True}
    ]
    stage.page.get_by_label("Rate, Hz").fill("100.1")
    run.click()
    assert texts(stage, ".mode .trouble")[0].startswith("opening of hand supports at most 100 Hz.")
    own = {"id": "m", "state": "running", "uuids": [ARM], "owner": "page", "group": NONE, "channels": [2],
           "kind": "event", "trigger": True, "sinks": ["/x/a.csv"], "actuators": False, "dead_man": 99,
           "nodes": [{"uuid": ARM, "state": "running", "samples": 2, "invalid": 3,
                      "invalid_why": [{"channel": 2, "count": 1, "why": "no answer"},
                                      {"channel": 2, "count": 2, "why": "out of range"}]}]}  # fmt: skip
    measured(stage, own)
    assert (idle.is_enabled(), run.is_disabled(), stage.page.get_by_label("Rate, Hz").is_disabled()) == (True,) * 3
    assert text(stage, ".mode .state").strip() == (
        "running, 2 samples, none lost, 3 invalid (opening: out of range; opening: no answer)."
    )
    assert stage.page.get_by_role("button", name="Measure", pressed=True).count() == 1
    measured(stage, own | {"lower_rate": 10})
    press(stage, "Measure at 10 Hz")
    assert [entry["body"] for entry in sent(stage)] == [
        {},
        {"uuids": [ARM], "channels": [2], "rate": 10, "kind": "event", "trigger": True, "sinks": ["a.csv"],
         "actuators": False, "dead_man": 99},
    ]  # fmt: skip
    idle.click()
    assert sent(stage) == [{"method": "DELETE", "path": "measurements/m", "body": {}}]
    change(stage, groups=[PAIR])
    measured(stage, RUNNING)
    assert (idle.is_disabled(), text(stage, ".mode .state")) == (True, "Measured as part of group pair. Stop it there.")
    measured(stage, RUNNING | {"state": "failed", "why": "No room."})
    assert text(stage, ".mode .state") == "Measured as part of group pair. Stop it there. It has failed: No room."
    measured(stage, RUNNING | {"owner": "command", "process": {"id": 7}})
    assert text(stage, ".mode .state") == (
        "Measured as part of group pair by the command measure (process 7). End it there with Ctrl-C."
    )
    measured(stage, connection="lost")
    assert run.is_disabled()
    change(stage, connection="live", status={"write": False, "links": []})
    assert run.is_disabled()


def test_a_stranger_is_provisioned_first_and_actuators_alone_are_not_measured(stage: Stage) -> None:
    mode(stage, whitelisted=False)
    assert text(stage, ".mode .state") == "Not on the whitelist: provision it first."
    assert stage.page.get_by_role("button", name="Measure", exact=True).is_disabled()
    wire = gripper()
    nodes(stage, wire | {"channels": wire["channels"][:1]})
    stage.pass_time(20)
    assert text(stage, ".mode .state") == "This node has no sensors to measure."
    for whitelisted, words in ((False, "Not on the whitelist"), (True, "No channels")):
        nodes(stage, gripper(channels=[], whitelisted=whitelisted))
        stage.pass_time(20)
        assert text(stage, ".empty .lead") == words
        assert stage.page.get_by_role("region", name="Configure").is_hidden()


def test_each_channel_has_its_value_its_age_and_its_facts(stage: Stage) -> None:
    wire = gripper()
    wire["channels"][1] |= {"calibrated": "2026-11-01", "due": "2027-11-01"}
    channels = [
        *wire["channels"],
        {"number": 3, "kind": "event", "unit": "", "calibrated": "2024-01-01", "due": "2025-01-01", "overdue": True},
        {"number": 4, "kind": "sensor", "unit": "V", "problem": "no calibration", "low": 0, "high": 5, "rate": 2500},
    ]
    mode(stage, channels=channels)
    assert texts(stage, "table.values tbody tr") == [
        "1opening set point Actuator not set 0 to 110 mm not stated by set point no calibration",
        "2opening no value yet 0 to 110 mm ± 0.1 mm 100 Hz 2026-11-01 due 2027-11-01",
        "3channel 3 Event no value yet not stated not stated not stated 2024-01-01, was due 2025-01-01",
        "4channel 4 no value yet 0 to 5 V not stated 2.5 kHz no calibration",
    ]
    now = stage.run("return hub.now()")
    told = [
        {"value": 0.05, "time": now - 1, "period": 0},
        {"value": NONE, "time": now - 1},
        {"raw": 7, "value": NONE, "time": now},
    ]
    stage.run("words.forEach((last, at) => state.values.set(`${'a1'.repeat(10)}/${at + 2}`, last))", *told)
    report = {"uuid": ARM, "state": "running", "invalid_why": [{"channel": 3, "count": 2, "why": "no answer"}]}
    measured(stage, {"state": "running", "uuids": [ARM], "nodes": [report]})
    stage.pass_time(250)
    figures = "table.values .value"
    assert texts(stage, figures) == ["not set", "50.00 mm", "not valid", "7 raw"]
    titles = "return [...document.querySelectorAll('table.values .figure')].map((one) => one.title)"
    assert stage.run(titles) == ["", "", "2: no answer", "no calibration"]
    meters = "return [...document.querySelectorAll('table.values meter')].map((one) => [one.value, one.hidden])"
    assert stage.run(meters) == [[0, False], [50, False], [0, True]]
    assert stage.run("return document.querySelectorAll('tr.fresh').length") == 3
    stage.pass_time(3000)
    assert texts(stage, "table.values .old")[1] == "4 s ago"
    assert stage.run("return [...document.querySelectorAll('tr')].map((one) => one.className)")[1:] == [
        "actuator-row", "stale", "stale", "stale",
    ]  # fmt: skip
    for told_, words in (
        ({"safe": False, "value": 70, "unit": "mm"}, "70.000 mm"),
        ({"safe": True, "value": NONE}, "safe state"),
    ):
        channels[0]["actuator"] = told_
        nodes(stage, gripper(channels=channels))
        stage.pass_time(20)
        assert texts(stage, figures)[0] == words
        assert stage.run(meters)[0][0] == (70 if "70" in words else 0)


LISTS = {"measurements": {"measurements": []}, "groups": {"groups": [PAIR]}, "nodes": {"nodes": [gripper(), ANGLE]}}


@pytest.mark.parametrize(
    ("act", "running", "lists"),
    [
        ("Start pair", [], ["groups", "measurements", "nodes"]),
        ("Stop pair", [RUNNING], ["groups", "measurements", "nodes"]),
        ("Save members", [], ["groups", "measurements", "nodes"]),
        ("Delete group", [], ["groups", "measurements", "nodes"]),
        ("Measure all trusted nodes", [], ["measurements", "nodes"]),
        ("Stop", [{"id": "x", "state": "running", "uuids": [ARM], "nodes": []}], ["measurements", "nodes"]),
        ("Create group", [], ["groups", "nodes"]),
    ],
)
def test_what_an_act_changes_is_fetched_anew_and_a_button_waits_for_it(
    measuring: Stage, act: str, running: list[dict[str, Any]], lists: list[str]
) -> None:
    measuring.answers(**{f"GET {name}": answer for name, answer in LISTS.items()})
    measured(measuring, *running)
    measuring.run("document.querySelectorAll('details').forEach((one) => (one.open = true))")
    measuring.page.get_by_label("Name", exact=True).fill("new")
    measuring.run("document.querySelectorAll('.new input[type=checkbox]').forEach((one) => (one.checked = true))")
    paths = {"POST groups", "POST measurements", "PUT groups/pair", "DELETE groups/pair",
             "DELETE measurements/x", "DELETE measurements/m 1"}  # fmt: skip
    measuring.answers(**dict.fromkeys(paths, "held"))
    measuring.sent  # noqa: B018
    press(measuring, act)
    assert len(sent(measuring)) == 1
    waits = """
      const named = (one) => (one.getAttribute("aria-label") ?? one.textContent).trim() === words[0];
      const button = [...document.querySelectorAll("button")].find(named);
      return [button.disabled, button.getAttribute("aria-busy")];
    """
    change(measuring, total=3)
    if act not in ("Delete group", "Save members"):  # who could press these again would ask for the same
        assert measuring.run(waits, act) == [True, "true"]
    measuring.run("window.held.splice(0).forEach((go) => go({}))")
    measuring.pass_time(20)
    # the plot and the rate's hint ask by clocks of their own
    asked = {entry["path"] for entry in measuring.sent if "?" not in entry["path"]}
    assert sorted(asked) == lists
    assert measuring.run(waits, act)[1] is NONE
    if act == "Create group":
        assert measuring.run("return [document.querySelector('.new').open, document.querySelector('.new input').value]"
                             ) == [False, ""]  # fmt: skip


def test_a_refused_act_says_why_beside_it(stage: Stage) -> None:
    no = {"refused": 409, "message": "Not now.", "hint": "Later."}
    mode(stage)
    own = {"id": "m", "state": "running", "uuids": [ARM], "owner": "page", "sinks": [], "nodes": [], "lower_rate": 10}
    stage.answers(**{"POST measurements": no, "DELETE measurements/m": no})
    press(stage, "Measure")
    assert texts(stage, ".mode .trouble") == ["Not now. Later."]
    stage.answers(**{"POST measurements": {}})
    press(stage, "Measure")
    assert (texts(stage, ".mode .trouble"), stage.said) == ([], "Measuring.")
    measured(stage, own)
    press(stage, "Idle")
    assert texts(stage, ".mode .trouble") == ["Not now. Later."]
    stage.answers(**{"DELETE measurements/m": {}, "POST measurements": no})
    press(stage, "Idle")
    assert (texts(stage, ".mode .trouble"), stage.said) == ([], "Idle.")
    measured(stage, own)
    press(stage, "Measure at 10 Hz")
    assert texts(stage, ".mode .trouble") == ["Not now. Later."]
    stage.answers(**{"POST measurements": {}})
    for _ in range(2):
        measured(stage, own)
        stage.sent  # noqa: B018
        press(stage, "Measure at 10 Hz")
        stage.pass_time(20)
        asked = [(entry["method"], entry["path"]) for entry in stage.sent if "?" not in entry["path"]]
        assert asked == [
            ("DELETE", "measurements/m"),
            ("POST", "measurements"),
            ("GET", "measurements"),
            ("GET", "nodes"),
        ]


def test_a_node_in_a_measurement_is_told_by_its_numbers_and_the_three_commonest_reasons(stage: Stage) -> None:
    nodes(stage, gripper())
    found = ((2, 1, "late"), (2, 9, "no answer"), (7, 4, "range"), (2, 5, "noise"))
    why = [{"channel": number, "count": many, "why": word} for number, many, word in found]
    one = {"uuid": ARM, "state": "running", "samples": 1, "lost": 0}
    reasons = "opening: no answer; opening: noise; channel 7: range"
    cases = [
        ({"state": "running", "nodes": [one]}, "running, 1 sample, none lost."),
        (
            {"state": "running", "nodes": [one | {"samples": 0, "lost": 2, "late": 1, "bad": 3}]},
            "running, 0 samples, 2 lost, 1 late, 3 bad.",
        ),
        (
            {"nodes": [one | {"invalid": 19, "invalid_why": why}]},
            f"running, 1 sample, none lost, 19 invalid ({reasons}).",
        ),
        (
            {"nodes": [one | {"invalid": 1, "invalid_why": why[:1], "why": "It is late."}]},
            "running, 1 sample, none lost, 1 invalid. It is late.",
        ),
        ({"nodes": [one | {"invalid": 1}]}, "running, 1 sample, none lost, 1 invalid (no reason given)."),
        ({"nodes": [{"uuid": ARM, "state": "lost", "why": "Silent."}], "why": "else"}, "lost. Silent."),
        ({"state": "failed", "why": "No room.", "nodes": [{"uuid": HAND}]}, "failed. No room."),
        ({}, "starting."),
    ]
    stage.table(f"values.told(one, '{ARM}').slice(1).join('').trim()", cases)
    icons = "const d = (one) => one.querySelector('path').getAttribute('d');"
    same = "words.map(([word, name]) => d(values.told({ state: word }, 'x')[0]) === d(dom.icon(name)))"
    signs = [("running", "wave"), ("refused", "warn"), ("lost", "warn"), ("waiting", "clock")]
    assert stage.run(f"{icons} return {same}", *signs) == [True] * 4


def test_a_plot_has_buttons_for_its_length_its_pause_and_the_way_back(stage: Stage) -> None:
    stage.run(
        """
        window.plot = show(new plot.LivePlot([]));
        document.getElementById("main").append(values.plotHead(window.plot, "h4", "Course"), window.plot.element);
        """
    )
    assert texts(stage, ".plot-head > h4") == ["Course"]
    pressed = (
        "[...document.querySelectorAll('.switch button')].map((one) => [one.innerText, one.ariaPressed === 'true'])"
    )
    names = ["10 s", "30 s", "2 min", "10 min", "1 h"]
    assert stage.run(f"return {pressed}") == [[name, name == "30 s"] for name in names]
    for name, seconds in zip(names, (10, 30, 120, 600, 3600), strict=True):
        press(stage, name)
        assert stage.run(f"return [{pressed}, window.plot.window]") == [[[one, one == name] for one in names], seconds]
    state = "const one = document.querySelector('.plot-head > button'); return [one.innerText, one.ariaPressed]"
    assert stage.run(state) == ["Pause", "false"]
    press(stage, "Pause")
    assert (stage.run(state), stage.run("return window.plot.paused !== null")) == (["Resume", "true"], True)
    press(stage, "Resume")
    assert (stage.run(state), stage.run("return window.plot.paused")) == (["Pause", "false"], NONE)
    back = stage.page.get_by_role("button", name="Back to live")
    assert back.is_hidden()
    stage.run("window.plot.zoom([1, 2])")
    assert back.is_visible()
    press(stage, "Back to live")
    assert (back.is_hidden(), stage.run("return window.plot.range")) == (True, NONE)


def test_a_nodes_plot_has_its_first_twelve_sensors_while_something_is_known_of_one(stage: Stage) -> None:
    wire = gripper()
    sensors = [wire["channels"][1] | {"number": number, "name": f"n {number}"} for number in range(2, 16)]
    mode(stage, channels=[wire["channels"][0], *sensors])
    plot = "[aria-label=Plot]"
    assert texts(stage, plot) == ["Plot Press Measure to see live values."]
    own = {"id": "m", "state": "running", "uuids": [ARM], "owner": "page", "nodes": []}
    measured(stage, own)
    assert texts(stage, f"{plot} .label") == [f"n {number}" for number in range(2, 14)]
    assert texts(stage, f"{plot} .plot-head h3") == ["Plot"]
    stage.run("state.rings.clear(); state.measurements = []; window.ends.at(-1).paint()")  # before it draws again
    assert texts(stage, plot) == ["Plot Press Measure to see live values."]
    stage.run("hub.ringOf(words[0], 3)", ARM)
    change(stage)
    assert len(texts(stage, f"{plot} .label")) == 12, "values of it came before"
    nodes(stage, wire | {"channels": wire["channels"][:1]})
    stage.pass_time(20)
    assert stage.page.locator(plot).is_hidden(), "nothing of an actuator moves there"
