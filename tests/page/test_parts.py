"""A node on the page by itself: facts, head, datasheet, provisioning; virtual ones and who feeds them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM, HAND, NOW
from .test_forms import give, text, texts
from .test_views import HELD, change, gripper, nodes, press

if TYPE_CHECKING:
    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
CAN = {"link": "can"}


def sent(stage: Stage) -> list[Any]:
    """Return what the page changed since the last time."""
    return [entry for entry in stage.sent if entry["method"] != "GET"]


def test_facts_of_a_node_are_words_and_what_needs_care_is_marked(stage: Stage) -> None:
    now = stage.run("return hub.now()")
    told = {"text": "nrf/finger", "version": "1.3.0", "build": "7", "state": "good", "from": "session"}
    warn, none = "warn:", {"version": NONE, "state": "not-reported"}
    stage.table(
        "facts.facts(one).map((each) => (each.classList.contains('warn') ? 'warn:' : '') + each.textContent)",
        [
            ({**CAN, "state": "idle"}, ["CAN", "idle"]),
            ({"link": "nfc"}, ["NFC"]),
            ({"link": "ble"}, ["BLE"]),
            ({}, ["no link"]),
            ({"virtual": True, "link": "can"}, ["Virtual"]),
            ({**CAN, "present": False, "seen": now - 300, "mode": "x"}, ["CAN", f"{warn}away, seen 5 min ago"]),
            ({**CAN, "present": False}, ["CAN", f"{warn}away"]),
            ({**CAN, "busy": "writing", "mode": "measuring"}, ["CAN", "writing"]),
            ({**CAN, "mode": "measuring", "state": "idle"}, ["CAN", "measuring"]),
            ({**CAN, "mode": "lost, not measured"}, ["CAN", f"{warn}lost, not measured"]),
            ({**CAN, "wrapped": {"name": "bpm", "kind": "dbc"}}, ["CAN", f"{warn}wrapped: bpm (dbc)"]),
            ({**CAN, "whitelisted": False, "groups": ["a", "b"]}, ["CAN", f"{warn}not on the whitelist", "a, b"]),
            ({**CAN, "firmware": told}, ["CAN", "nrf/finger 1.3.0+7"]),
            ({**CAN, "firmware": told | {"build": NONE, "from": "plain"}},
             ["CAN", "nrf/finger 1.3.0, not verified"]),
            ({**CAN, "firmware": told | {"changed": True}},
             ["CAN", f"{warn}nrf/finger 1.3.0+7, changed since calibration"]),
            ({**CAN, "firmware": none}, ["CAN", f"{warn}firmware not reported"]),
            *(({**CAN, "firmware": told | {"state": state}}, ["CAN", f"{mark}nrf/finger 1.3.0+7, {words}"])
              for state, mark, words in (
                  ("bad", warn, "ruled out by its type"), ("other", warn, "not of its type"),
                  ("outdated", warn, "outdated"),
                  ("on-trial", "", "on trial"), ("pending", "", "another starts at the next restart"))),
            ({"power": {"percent": 80, "charging": "charging", "low": False}}, ["no link", "80 %, charging"]),
            ({"power": {"percent": 10, "charging": "full", "low": False}}, ["no link", "10 %, full"]),
            ({"power": {"percent": 9, "charging": "wanted", "low": False}},
             ["no link", f"{warn}9 %, needs charging, low"]),
            ({"power": {"percent": 50, "charging": "error", "low": True}},
             ["no link", f"{warn}50 %, charging error, low"]),
            ({"power": {"percent": NONE, "charging": NONE, "low": False}}, ["no link", "level unknown"]),
        ],
    )  # fmt: skip
    stage.table(
        "facts.checkLine(one).textContent",
        [
            ({"name": "Signature", "result": "passed"}, "passedSignature"),
            ({"name": "Trust", "result": "failed", "why": "revoked"}, "failedTrustrevoked"),
            ({"name": "Key", "result": "else"}, "skippedKey"),
            ({"name": "x", "print": "abcdef01"}, "Key fingerprintabcd ef01"),
        ],
    )
    title = "return facts.facts({ firmware: words[0] }).at(-1).title"
    assert stage.run(title, told | {"image": "ab"}) == "Image ab. The node reports this; it is no proof of the image."


CHECKS = [{"name": name, "result": result} for name, result in (("a", "passed"), ("b", "failed"), ("c", "skipped"))]


def judged(**more: Any) -> dict[str, Any]:
    return gripper(verdict={"verdict": "authentic", "checks": CHECKS, "from": "session", "at": NOW} | more)


@pytest.fixture
def head(stage: Stage) -> Stage:
    """The panel of a node, at its provisioning."""
    nodes(stage, judged())
    stage.run(
        """
        window.panel = show(new node.NodePanel(document.getElementById("main"), words[0]));
        window.panel.tab("provision");
        """,
        ARM,
    )
    stage.sent  # noqa: B018
    return stage


def test_a_nodes_head_has_its_verdict_its_checks_and_what_was_heard_beside_it(head: Stage) -> None:
    chips = ".node-facts .chip"
    assert texts(head, chips) == ["Authentic", "On the whitelist"]
    assert texts(head, "summary") == ["Security check: 1 of 2 passed"]
    assert text(head, ".uuid") == "a1a1 a1a1 a1a1 a1a1 a1a1"
    cases = [
        (judged() | {"heard": {"verdict": "authentic"}}, ["Authentic", "On the whitelist"]),
        (judged() | {"heard": {"verdict": "unsigned"}, "whitelisted": False}, ["Authentic", "Not verified: unsigned"]),
        (judged(**{"from": "kept"}), ["Authentic", "Kept", "On the whitelist"]),
    ]
    for wire, words in cases:
        nodes(head, wire)
        head.pass_time(20)
        assert texts(head, chips) == words
    nodes(head, judged(checks=[]) | {"fingerprint": "abcd1234", "problem": {"message": "Odd.", "hint": "Look."}})
    head.pass_time(20)
    assert texts(head, "summary") == ["Key"]
    assert head.page.locator(".node-head details").is_visible()
    assert texts(head, ".node-facts > .warn:not(.chip)") == ["Odd. Look."]
    assert texts(head, chips)[0] == "Not verified", "it is there, and has not proven itself"
    nodes(head, judged(checks=[]))
    head.pass_time(20)
    assert head.page.locator(".node-head details").is_hidden()


def test_a_board_is_located_by_who_may_and_while_it_is_there(head: Stage) -> None:
    press(head, "Locate")
    assert head.sent == [{"method": "POST", "path": f"nodes/{ARM}/locate", "body": {"seconds": 10}}]
    assert head.said == "The board blinks for 10 seconds."
    head.answers(**{f"POST nodes/{ARM}/locate": {"refused": 409, "message": "It cannot.", "hint": ""}})
    press(head, "Locate")
    assert texts(head, ".node-head .trouble") == ["It cannot."]
    locate = head.page.get_by_role("button", name="Locate")
    for changed, wire in (
        ({"connection": "lost"}, judged()),
        ({"connection": "live", "status": {"write": False, "links": []}}, judged()),
        ({"status": {"links": []}}, judged() | {"present": False}),
    ):
        nodes(head, wire)
        change(head, **changed)
        assert locate.is_disabled()


def test_tabs_say_which_one_is_open_and_a_tapped_node_gets_the_focus(head: Stage) -> None:
    current = """
      const tabs = [...document.querySelectorAll(".tabs a")];
      return tabs.map((one) => [one.textContent, one.getAttribute("aria-current")]);
    """
    order = ["Live", "Datasheet", "Provision", "History"]
    assert head.run(current) == [[name, "page" if name == "Provision" else NONE] for name in order]
    head.run("window.panel.tab('unheard of')")
    assert head.run(current) == [[name, "page" if name == "Live" else NONE] for name in order]
    head.run("window.panel.marked(true)")
    assert head.run("return document.activeElement.tagName") == "H2"
    head.run("document.querySelector('.tabs a').focus(); window.panel.marked(true)")
    assert head.run("return document.activeElement.tagName") == "A", "it is marked already"
    head.run("window.panel.marked(false)")
    assert head.run("return document.querySelector('.tapped')") is None


TEDS = f"GET nodes/{ARM}/teds"
FIELD = {
    "name": "Unit",
    "text": "<b>mm</b>",
    "meaning": "millimetre",
    "fields": [{"type": 7, "text": "x", "meaning": "x"}],
}
BLOCK = {"channel": 1, "name": "ChanTEDS", "verdict": "clean", "fields": [FIELD]}
READ = {"verdict": "authentic", "checks": [], "teds": [BLOCK, {"channel": 0, "name": "MetaTEDS", "verdict": "odd"}]}


def open_datasheet(stage: Stage, **answer: Any) -> None:
    nodes(stage, gripper())
    stage.answers(**{TEDS: READ | answer, "GET nodes": {"nodes": [gripper()]}})
    stage.run("document.getElementById('main').replaceChildren()")
    stage.run("show(new datasheet.DatasheetTab(document.getElementById('main'), words[0]))", ARM)
    stage.pass_time(20)


def test_a_datasheet_is_read_and_each_part_is_text(stage: Stage) -> None:
    open_datasheet(stage)
    assert stage.said == "Datasheet of hand read."
    assert texts(stage, ".teds summary") == [
        "Channel 1: TransducerChannel TEDS 1 field",
        "Node: Meta-TEDS odd 0 fields",
    ]
    assert texts(stage, ".fields tbody tr") == ["Unit <b>mm</b> millimetre", "field 7 x"]
    assert stage.run("return document.querySelectorAll('.teds details[open]').length") == 2
    links = "return [...document.querySelectorAll('.links a')].map((one) => [one.getAttribute('href'), one.download])"
    assert stage.run(links) == [
        [f"api/v1/nodes/{ARM}/teds?format={form}", f"{ARM}.{form}"] for form in ("json", "xml", "hex")
    ]
    assert texts(stage, ".sheet-verdict") == ["Authentic Signature, trust and key proof are valid."]
    open_datasheet(stage, teds=[BLOCK] * 3, checks=CHECKS)
    assert stage.run("return document.querySelectorAll('.teds details[open], .checks[open]').length") == 0
    open_datasheet(stage, teds=[], verdict="unproven", checks=CHECKS)
    assert text(stage, ".sheet-verdict + .checks[open] summary") == "Security check"
    assert texts(stage, ".empty .lead") == ["The node has no datasheet."]
    stage.run("state.nodes.get(words[0]).read = { at: words[1] }", ARM, NOW)
    stage.answers(**{"GET nodes": {"nodes": [gripper(verdict={"verdict": "authentic", "at": NOW})]}})
    press(stage, "Read from node")
    stage.answers(**{TEDS: READ | {"read_now": False}})
    press(stage, "Read from node")
    stage.pass_time(20)
    assert texts(stage, ".sheet-verdict .chip") == [
        "Authentic at 10:00:00", "Last reading: the node is not connected now",
    ]  # fmt: skip
    stage.answers(**{TEDS: {"refused": 503, "message": "Silent.", "hint": "Look."}})
    press(stage, "Read from node")
    assert texts(stage, "[role=alert].trouble") == ["Silent. Look."]


def test_findings_come_with_where_they_are_and_an_error_opens_them(stage: Stage) -> None:
    guard = {"severity": "warning", "message": "Odd.", "hint": "Look."}
    found = {"message": "So.", "severity": NONE}
    open_datasheet(stage, guard=[guard], teds=[BLOCK | {"findings": [found]}])
    assert stage.run("return [...document.querySelectorAll('.findings')].map((one) => one.open)") == [False]
    lines = "return [...document.querySelectorAll('.findings li')].map((one) => one.textContent)"
    assert stage.run(lines) == [
        "warningPlausibilityOdd. Look.", "noteChannel 1: TransducerChannel TEDSSo.",
    ]  # fmt: skip
    open_datasheet(stage, guard=[guard | {"severity": "error"}])
    assert stage.run("return document.querySelector('.findings').open") is True
    assert stage.page.locator(".findings .chip.bad").count() == 1


@pytest.mark.parametrize(
    ("answer", "offered", "reason"),
    [
        ({"verdict": "unsigned"}, True, False),
        ({"verdict": "unsigned", "guard": [{"severity": "error", "message": "Odd."}]}, True, True),
        ({"verdict": "unsigned", "guard": [{"severity": "warning", "message": "Odd."}]}, True, False),
        ({"verdict": "unsigned", "read_now": False}, False, False),
        ({"verdict": "unsigned", "teds": [BLOCK | {"name": "MetaTEDS"}]}, False, False),
        ({"verdict": "unproven"}, False, False),
    ],
)
def test_a_boards_own_datasheet_is_signed_with_a_reason_if_it_looks_wrong(
    stage: Stage, answer: dict[str, Any], offered: bool, reason: bool
) -> None:
    open_datasheet(stage, **answer)
    stage.sent  # noqa: B018
    sign = stage.page.get_by_role("button", name="Sign this datasheet")
    assert (sign.count() == 1) is offered
    assert (stage.page.get_by_label("Reason to accept it despite the findings").count() == 1) is reason
    if not offered:
        return
    if reason:
        stage.page.get_by_label("Reason to accept it despite the findings").fill(" seen ")
    path = f"nodes/{ARM}/provision"
    stage.answers(**{f"POST {path}": {"refused": 422, "message": "Not so.", "hint": ""}})
    sign.click()
    assert texts(stage, ".brought .trouble") == ["Not so."]
    stage.answers(**{f"POST {path}": {"state": "running"}})
    sign.click()
    body = {"adopt": True, "accept_calibration": "seen" if reason else NONE}
    assert sent(stage) == [{"method": "POST", "path": path, "body": body}] * 2
    assert stage.run("return [location.hash, state.runs.get(words[0])]", ARM) == [
        f"#/nodes/{ARM}/provision", {"steps": [], "state": "running"},
    ]  # fmt: skip


def test_an_open_datasheet_is_read_again_when_its_verdict_changes(stage: Stage) -> None:
    verdict = {"verdict": "authentic"}
    nodes(stage, gripper(verdict=verdict))
    stage.answers(**{TEDS: READ, "GET nodes": {"nodes": [gripper(verdict=verdict)]}})
    stage.run("show(new datasheet.DatasheetTab(document.getElementById('main'), words[0]))", ARM)
    stage.pass_time(20)
    stage.sent  # noqa: B018
    change(stage)
    assert stage.sent == []
    bad = gripper(verdict={"verdict": "not authentic"})
    stage.answers(**{"GET nodes": {"nodes": [bad]}})
    nodes(stage, bad)
    stage.pass_time(20)
    assert [entry["path"] for entry in stage.sent] == [f"nodes/{ARM}/teds", "nodes"]
    change(stage, connection="lost")
    assert stage.page.get_by_role("button", name="Read from node").is_disabled()


PROVISION = f"nodes/{ARM}/provision"


@pytest.fixture
def provisioning(stage: Stage) -> Stage:
    """The form of a node that has no run yet."""
    nodes(stage, gripper())
    stage.run("state.profiles = [{ name: 'gripper', title: 'Gripper' }, { name: 'load-cell' }]")
    stage.answers(**{f"GET {PROVISION}": {"state": "done"}})
    stage.run("window.form = show(new provision.ProvisionTab(document.getElementById('main'), words[0]))", ARM)
    stage.pass_time(20)
    stage.sent  # noqa: B018
    return stage


def run_is(stage: Stage, **run: Any) -> None:
    stage.run("state.runs.set(words[0], words[1]); hub.changed('provision')", ARM, {"steps": []} | run)
    stage.pass_time(20)


def test_a_provisioning_is_asked_with_what_the_form_says(provisioning: Stage) -> None:
    go = provisioning.page.get_by_role("button", name="Provision", exact=True)
    assert texts(provisioning, "option") == ["Choose a type", "Gripper", "load-cell"]
    assert provisioning.page.get_by_label("Name").input_value() == "hand"
    go.click()
    assert texts(provisioning, ".trouble") == ["Choose a transducer type. The list shows the profiles of this station."]
    assert provisioning.page.evaluate("document.activeElement.tagName") == "SELECT"
    assert sent(provisioning) == []
    provisioning.page.get_by_label("Transducer type").select_option("gripper")
    item = provisioning.page.get_by_label("Result of the certificate")
    assert item.is_hidden()
    go.click()
    body = {
        "profile": "gripper",
        "name": "hand",
        "calibration": NONE,
        "calibration_name": NONE,
        "calibration_item": NONE,
    }
    assert sent(provisioning) == [{"method": "POST", "path": PROVISION, "body": body}]
    provisioning.run("state.runs.clear(); hub.changed('provision')")
    provisioning.pass_time(20)
    give(provisioning, "cell.XML", "<a/>")
    item.fill(" force ")
    provisioning.page.get_by_label("Name").fill(" ")
    provisioning.answers(**{f"POST {PROVISION}": {"waits_for": "tap", "until": NOW + 90}})
    go.click()
    provisioning.page.get_by_text("Place this node on the reader.").first.wait_for()
    assert sent(provisioning)[0]["body"] == {
        "profile": "gripper", "name": NONE, "calibration": "<a/>", "calibration_name": "cell.XML",
        "calibration_item": "force",
    }  # fmt: skip
    assert go.is_disabled()
    provisioning.pass_time(250)
    assert text(provisioning, ".waiting .figure").startswith("(")
    left = int(text(provisioning, ".waiting .figure")[1:-3])
    now = provisioning.run("return hub.now()")
    assert NOW + 90 - now <= left <= NOW + 91.3 - now
    provisioning.answers(**{f"POST {PROVISION}": {"state": "cancelled", "steps": []}})
    press(provisioning, "Cancel")
    assert sent(provisioning) == [{"method": "POST", "path": PROVISION, "body": {"cancel": True}}]
    assert text(provisioning, ".panel").endswith("Provisioning was cancelled.")
    assert go.is_enabled()
    give(provisioning, "cell.csv", "1,2")
    assert item.is_hidden()
    provisioning.answers(**{f"POST {PROVISION}": {"refused": 422, "message": "No such file.", "hint": "Look."}})
    go.click()
    provisioning.page.get_by_role("alert").filter(has_text="No such file.").wait_for()
    body = sent(provisioning)[0]["body"]
    assert (body["calibration"], body["calibration_item"]) == ("1,2", NONE)


def test_steps_and_the_end_of_a_provisioning_are_shown(provisioning: Stage) -> None:
    run_is(provisioning, state="running", steps=[
        {"name": "identify", "result": "done", "detail": "hand"}, {"name": "agree", "result": "skipped"},
        {"name": "build", "result": "running"}, {"name": "else", "result": "odd"}])  # fmt: skip
    lines = """
      const words = (one) => [...one.children].map((each) => each.textContent);
      return [...document.querySelectorAll(".steps li")].map(words);
    """
    assert provisioning.run(lines) == [
        ["done", "Identify", "hand"], ["not needed", "Agree on a key"], ["in progress", "Build the datasheet"],
        ["odd", "else"],
    ]  # fmt: skip
    go = provisioning.page.get_by_role("button", name="Provision", exact=True)
    assert go.is_disabled()
    run_is(provisioning, state="failed", error={"message": "It is silent.", "hint": "Look."})
    assert (texts(provisioning, ".trouble"), go.is_enabled()) == (["It is silent. Look."], True)
    run_is(provisioning, state="failed")
    assert texts(provisioning, ".trouble") == ["Provisioning failed."]
    run_is(provisioning, state="done")
    assert texts(provisioning, ".done") == ["Provisioned This node is ready. See its values"]
    assert provisioning.said == "Provisioned."
    change(provisioning, measurements=[{"state": "running", "uuids": [ARM]}])
    assert (go.is_disabled(), text(provisioning, ".row .hint")[:28]) == (True, "This node is being measured.")
    change(provisioning, measurements=[], status={"write": False, "links": []})
    assert (go.is_disabled(), texts(provisioning, ".row > .hint")) == (True, ["This browser has read-only access."])
    change(provisioning, status={"links": []}, connection="lost")
    assert go.is_disabled()


def test_a_run_from_elsewhere_is_shown_and_a_later_event_is_not_undone(stage: Stage) -> None:
    nodes(stage, gripper())
    stage.answers(**{f"GET {PROVISION}": {"state": "waiting", "until": NOW + 99, "steps": []}})
    stage.run("show(new provision.ProvisionTab(document.getElementById('main'), words[0]))", ARM)
    stage.page.get_by_text("Place this node on the reader.").first.wait_for()
    stage.run("state.runs.clear(); state.profiles = [{ name: 'gripper' }]; hub.changed('profiles')")
    stage.pass_time(20)
    stage.page.get_by_label("Transducer type").select_option("gripper")
    stage.answers(**{f"POST {PROVISION}": HELD})
    press(stage, "Provision")
    run_is(stage, state="done")
    stage.run("window.held.shift()({ state: 'running' })")
    assert stage.run("return state.runs.get(words[0]).state", ARM) == "done"
    stage.run("document.getElementById('main').replaceChildren()")
    stage.answers(**{"GET nodes/next/provision": {"refused": 404}})
    stage.run("show(new provision.ProvisionTab(document.getElementById('main'), 'next'))")
    stage.run(
        "state.runs.set('next', { state: 'waiting', until: words[0], steps: [] }); hub.changed('provision')", NOW + 99
    )
    stage.pass_time(20)
    assert texts(stage, ".waiting .lead") == ["Place a node on the reader."]
    assert stage.said == "Place a node on the reader."


VIRTUAL = {"uuid": HAND, "name": "dummy", "source": "sine:5", "channels": [1, 2], "state": "running"}


@pytest.fixture
def virtual(stage: Stage) -> Stage:
    """The view of virtual transducers, one of which is there."""
    stage.answers(**{"GET virtual": {"virtual": [VIRTUAL]}, "GET profiles": {"profiles": [{"name": "gripper"}]}})
    stage.run("show(virtual.virtualView(document.getElementById('main')))")
    stage.pass_time(20)
    stage.sent  # noqa: B018
    return stage


def test_a_virtual_transducer_is_made_from_a_type_or_a_file(virtual: Stage) -> None:
    press(virtual, "Create")
    assert texts(virtual, ".trouble") == [
        "A virtual transducer needs a datasheet. Choose a transducer type, or a datasheet file."
    ]
    virtual.answers(**{"POST virtual": {"uuid": ARM, "name": "new"}})
    virtual.page.get_by_label("Transducer type").select_option("gripper")
    virtual.page.get_by_label("Value source").select_option("ramp:5")
    virtual.page.get_by_label("Name").fill(" new ")
    press(virtual, "Create")
    assert (texts(virtual, ".done"), virtual.said) == (["Created new"], "Virtual transducer new created.")
    virtual.answers(**{"POST virtual": {"refused": 409, "code": "uuid-known", "message": "Known.", "hint": "new_uuid"}})
    give(virtual, "copy.xml", " <a/>")
    press(virtual, "Create")
    virtual.page.get_by_role("button", name="Create it with a new UUID").wait_for()
    assert texts(virtual, ".trouble") == ["Known. Two nodes with one UUID cannot be distinguished."]
    virtual.answers(**{"POST virtual": {"uuid": ARM}})
    press(virtual, "Create it with a new UUID")
    virtual.page.get_by_text("Created", exact=True).wait_for()
    sheet = {"name": NONE, "source": "ramp:5", "content": " <a/>", "format": "xml"}
    assert [entry["body"] for entry in sent(virtual)] == [
        {"name": "new", "source": "ramp:5", "profile": "gripper"}, sheet, sheet | {"new_uuid": True},
    ]  # fmt: skip
    assert virtual.page.evaluate("document.activeElement.hash") == f"#/nodes/{ARM}"
    change(virtual, status={"write": False, "links": []})
    assert virtual.page.get_by_role("button", name="Create", exact=True).is_disabled()
    assert virtual.page.get_by_role("button", name="Remove").is_disabled()


def test_a_virtual_transducer_is_deleted_only_when_it_is_said_twice(virtual: Stage) -> None:
    assert texts(virtual, ".facts") == [f"source sine:5 · 2 channels · running · {HAND}"]
    press(virtual, "Remove")
    virtual.pass_time(3990)
    assert virtual.page.get_by_role("button", name="Delete this transducer and its key?").is_visible()
    virtual.pass_time(20)
    press(virtual, "Remove")
    assert sent(virtual) == []
    virtual.answers(**{f"DELETE virtual/{HAND}": {"refused": 409, "message": "It is measured.", "hint": "Stop it."}})
    press(virtual, "Delete this transducer and its key?")
    assert texts(virtual, ".trouble") == ["It is measured. Stop it."]
    assert sent(virtual) == [{"method": "DELETE", "path": f"virtual/{HAND}", "body": {}}]
    virtual.run("state.virtual = []; hub.changed('virtual')")
    virtual.pass_time(20)
    assert texts(virtual, ".empty .lead") == ["No virtual transducers yet."]


@pytest.fixture
def feeding(stage: Stage) -> Stage:
    """A virtual transducer that a simulation may feed."""
    stage.answers(**{"GET virtual": {"virtual": [VIRTUAL | {"source": "simulation"}]}})
    stage.run("show(virtual.virtualView(document.getElementById('main')))")
    stage.pass_time(20)
    return stage


READY = {"ready": True, "channels": [
    {"number": 1, "name": "opening", "unit": "m", "low": 0, "high": 0.123456}, {"number": 2, "name": ""},
    {"number": 3, "name": "force", "low": NONE, "high": NONE}]}  # fmt: skip


def lines(stage: Stage) -> Any:
    return stage.run("return window.sockets.at(-1).lines.splice(0)")


def test_values_set_here_go_out_at_most_twenty_times_a_second_and_the_last_ones_always(feeding: Stage) -> None:
    assert text(feeding, ".feed-state") == "Nothing feeds it: its values are not valid."
    press(feeding, "Set values of dummy")
    feeding.pass_time(20)
    assert text(feeding, ".feed-state") == "Connecting …"
    feeding.run("window.sockets[0].tell(words[0])", READY)
    feeding.pass_time(20)
    assert (text(feeding, ".feed-state"), feeding.said) == ("Values are set on this page.",) * 2
    assert texts(feeding, ".feed-channels label:first-child") == ["opening, m", "force"]
    assert lines(feeding) == [{"value": {"opening": 0.061728, "force": 0}}]
    assert feeding.run("return document.activeElement.type") == "number", "the first field has the focus"
    entry = feeding.page.get_by_role("spinbutton", name="opening, m")
    feeding.pass_time(100)
    for value in ("0.01", "0.02", "0.03"):
        entry.fill(value)
    assert [line["value"]["opening"] for line in lines(feeding)] == [0.01]
    assert float(feeding.page.get_by_role("slider").input_value()) == pytest.approx(0.03, abs=1e-3)
    feeding.pass_time(40)
    assert lines(feeding) == []
    feeding.pass_time(20)
    assert [line["value"]["opening"] for line in lines(feeding)] == [0.03]
    for value in ("0.04", "0.05"):
        entry.fill(value)
    feeding.pass_time(60)
    assert [line["value"]["opening"] for line in lines(feeding)] == [0.05], "the next burst too"
    feeding.page.get_by_role("slider").focus()
    feeding.page.keyboard.press("End")
    assert float(entry.input_value()) <= 0.123456
    feeding.pass_time(60)
    feeding.page.get_by_label("no value").first.check()
    feeding.pass_time(60)
    entry.fill("")
    feeding.page.get_by_label("no value").first.uncheck()
    feeding.pass_time(60)
    assert [line["value"]["opening"] for line in lines(feeding)][-2:] == [NONE, NONE], "an empty field is no value"
    for told, words in (
        ({"skipped": 2, "why": "too fast"}, "2 values not taken as set: too fast."),
        ({"limited": 1, "why": "beyond its range"}, "1 value not taken as set: beyond its range."),
        ({"set": {"opening": 0.05}}, "opening is set to 0.05"),
    ):
        feeding.run("window.sockets[0].tell(words[0])", told)
        assert text(feeding, ".warn-line") == words
    press(feeding, "Stop setting values of dummy")
    assert feeding.run("return window.sockets[0].readyState") == 3
    assert feeding.page.get_by_role("slider").count() == 0


@pytest.mark.parametrize(
    ("ready", "code", "reason", "words"),
    [
        (False, 1006, "",
         "The station refused the connection. Another simulation may feed this transducer, or it is still starting."),
        (True, 1006, "", "The station closed the connection: the values are no longer valid."),
        (True, 1008, "The token was removed.", "The token was removed."),
    ],
)  # fmt: skip
def test_a_feed_that_ends_says_why(feeding: Stage, ready: bool, code: int, reason: str, words: str) -> None:
    press(feeding, "Set values of dummy")
    if ready:
        feeding.run("window.sockets[0].tell(words[0])", READY)
    feeding.run("window.sockets[0].end(words[0], words[1])", code, reason)
    assert texts(feeding, ".feed .trouble") == [f"{words} Press Set values here to try again."]
    assert feeding.page.get_by_role("button", name="Set values of dummy").is_enabled()


def test_one_feeds_and_others_see_who(feeding: Stage) -> None:
    button = feeding.page.get_by_role("button", name="Set values of dummy")
    for by, words in (("page", "another page"), ("api:lab", "token lab"), ("bench", "bench")):
        simulation = {"by": by, "since": NOW}
        feeding.run(
            "state.virtual = [words[0]]; hub.changed('virtual')",
            VIRTUAL | {"source": "simulation", "simulation": simulation},
        )
        feeding.pass_time(20)
        assert (text(feeding, ".feed-state"), button.is_disabled()) == (f"Fed by {words} since 10:00:00.", True)
    feeding.run("state.virtual = [words[0]]; hub.changed('virtual')", VIRTUAL | {"source": "simulation"})
    feeding.pass_time(20)
    button.click()
    feeding.run("window.sockets.at(-1).tell(words[0])", READY)
    change(feeding, connection="lost")
    assert texts(feeding, ".feed .trouble")[0].startswith(
        "The connection to the station is lost: the values are no longer"
    )
    change(feeding, connection="live")
    button.click()
    feeding.run("state.virtual = []; hub.changed('virtual')")
    feeding.pass_time(20)
    assert feeding.run("return window.sockets.at(-1).readyState") == 3, "who is gone is fed no more"
