"""Forms and lists of the page: changes before a write, many nodes at once, an update's plan, the log, filters."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM, HAND, NOW
from .test_views import HELD, change, gripper, nodes, press

if TYPE_CHECKING:
    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
THIRD = "c3" * 10


def text(stage: Stage, where: str) -> str:
    """Return what a person sees of the first such element."""
    return str(stage.run("return document.querySelector(words[0])?.innerText ?? ''", where))


def texts(stage: Stage, where: str) -> Any:
    """Return what a person sees of each such element, one line each."""
    script = "return [...document.querySelectorAll(words[0])].map((one) => one.innerText.trim().replace(/\\s+/g, ' '))"
    return stage.run(script, where)


def give(stage: Stage, name: str, content: str) -> None:
    """Choose a file, and wait until the page has read it."""
    file: Any = {"name": name, "mimeType": "application/octet-stream", "buffer": content.encode()}
    stage.page.locator("input[type=file]").first.set_input_files(file)


SHEET = f"nodes/{ARM}/teds"
DRY = f"PUT {SHEET}?dry_run=1"
CHANGES = [
    {"channel": 0, "field": "XdcrName", "text": "Node: name slew -> crane.", "before": "slew", "after": "crane"},
    {"channel": 2, "field": "OError", "text": "opening: stated uncertainty  -> 1 mm.", "before": "", "after": "1 mm"},
    {"channel": 9, "field": "Other", "text": "This sentence has another form: not so", "before": "x", "after": ""},
    {"channel": 0, "field": "Bare", "text": "Node:  a -> b.", "before": "a", "after": "b"},
    {"channel": 2, "field": "CalTEDS", "text": "The calibration is new."},
]  # fmt: skip
PLAN = {
    "changes": CHANGES,
    "tag": '"7"',
    "guard": [{"severity": "error", "message": "Odd.", "hint": "Look."}, {"message": "So."}],
}


@pytest.fixture
def writing(stage: Stage) -> Stage:
    """The panel that writes a datasheet to a node."""
    nodes(stage, gripper())
    stage.answers(**{DRY: PLAN, f"PUT {SHEET}": {"verdict": "authentic"}})
    stage.run(
        """
        window.written = 0;
        window.panel = show(new write.WritePanel(words[0], () => (window.written += 1)));
        document.getElementById("main").append(window.panel.element);
        """,
        ARM,
    )
    return stage


@pytest.mark.parametrize(("content", "form"), [("{}", "json"), ("\n <a/>", "xml"), ("a<b", "json")])
def test_a_file_is_compared_first_as_what_it_begins_like(writing: Stage, content: str, form: str) -> None:
    give(writing, "slew.dat", content)
    writing.page.get_by_role("heading", name="slew.dat: 5 changes").wait_for()
    assert writing.sent == [
        {"method": "PUT", "path": f"{SHEET}?dry_run=1", "body": {"format": form, "content": content}}
    ]
    assert texts(writing, ".diff tbody tr") == [
        "Node name slew → crane",
        "opening stated uncertainty nothing → 1 mm",
        "channel 9 Other x → nothing",
        "Node Bare a → b",
        "opening The calibration is new.",
    ]
    assert texts(writing, ".guard li") == ["error Odd. Look.", "warning So."]
    assert writing.said == "5 changes to review."


def test_what_was_reviewed_is_written_and_another_write_is_reviewed_again(writing: Stage) -> None:
    give(writing, "slew.json", "{}")
    go = writing.page.get_by_role("button", name="Sign and write to hand")
    go.wait_for()
    writing.sent  # noqa: B018
    writing.answers(**{f"PUT {SHEET}": {"refused": 412, "code": "changed"}, DRY: {**PLAN, "tag": '"8"'}})
    go.click()
    alert = writing.page.get_by_role("alert").filter(has_text="The datasheet on the node has changed since.")
    alert.wait_for()
    body = {"format": "json", "content": "{}"}
    assert writing.sent == [
        {"method": "PUT", "path": SHEET, "body": body, "match": '"7"'},
        {"method": "PUT", "path": f"{SHEET}?dry_run=1", "body": body},
    ]
    writing.answers(**{f"PUT {SHEET}": {"refused": 503, "message": "Silent.", "hint": "Look."}})
    go.click()
    writing.page.get_by_role("alert").filter(has_text="Silent.").wait_for()
    assert [entry.get("match") for entry in writing.sent] == ['"8"'], "any other refusal is no reason to ask again"
    assert writing.run("return window.written") == 0
    give(writing, "slew.json", "{}")
    writing.answers(**{f"PUT {SHEET}": {"verdict": "authentic"}})
    go.click()
    writing.page.get_by_text("Signed, written and verified: authentic.").wait_for()
    assert writing.run("return window.written") == 1


def test_nothing_to_change_offers_no_write_and_cancel_clears(writing: Stage) -> None:
    give(writing, "slew.json", "{}")
    writing.page.get_by_role("button", name="Cancel").wait_for()
    press(writing, "Cancel")
    assert text(writing, ".plan") == ""
    writing.answers(**{DRY: {"changes": []}})
    give(writing, "slew.json", "{}")
    writing.page.get_by_text("The node already has this datasheet.").wait_for()
    assert writing.run("return document.querySelector('input[type=file]').value") == "", "it may be chosen again"
    assert writing.page.get_by_role("button", name="Sign and write").count() == 0
    assert (writing.said, text(writing, ".plan h4")) == ("Nothing to change.", "slew.json: nothing to change")


def test_a_suspicious_calibration_needs_a_reason_and_another_type_a_button(writing: Stage) -> None:
    writing.answers(**{DRY: {"refused": 422, "message": "Odd.", "hint": "See --accept-calibration."}})
    give(writing, "slew.json", "{}")
    again = writing.page.get_by_role("button", name="Accept and compare again")
    again.click()
    writing.page.get_by_label("Reason to accept it").fill("  ")
    again.click()
    assert len(writing.sent) == 1, "without a reason nothing is asked"
    assert "--accept" not in text(writing, ".plan"), "the command line's option is no remedy here"
    writing.page.get_by_label("Reason to accept it").fill(" measured twice ")
    writing.answers(**{DRY: {"refused": 409, "code": "wrong-board", "message": "Another type.", "hint": "--retype"}})
    again.click()
    retype = writing.page.get_by_role("button", name="Change its type and compare")
    retype.wait_for()
    assert writing.sent[0]["body"] == {"format": "json", "content": "{}", "accept_calibration": "measured twice"}
    writing.answers(**{DRY: {"refused": 503, "message": "Silent.", "hint": "Look."}})
    retype.click()
    writing.page.get_by_role("alert").filter(has_text="Silent.").wait_for()
    assert writing.sent[0]["body"]["retype"] is True
    assert writing.page.locator(".plan button").count() == 0


def test_a_file_that_is_too_large_is_refused_and_one_may_be_dropped(writing: Stage) -> None:
    writing.run("window.panel.take(new File([new Uint8Array(900_001)], 'big.xml'))")
    writing.page.get_by_role("alert").filter(has_text="big.xml is too large for a datasheet (900001 bytes)").wait_for()
    assert writing.sent == []
    writing.run(
        """
        const files = new DataTransfer();
        files.items.add(new File(["{}"], "dropped.json"));
        const place = document.querySelector(".drop");
        const drag = (name) => place.dispatchEvent(new DragEvent(name, { dataTransfer: files, cancelable: true }));
        const names = ["dragover", "dragleave", "dragenter", "drop"];
        window.over = names.map((name) => [drag(name), place.classList.contains("over")]);
        """
    )
    writing.page.get_by_role("heading", name="dropped.json: 5 changes").wait_for()
    assert writing.run("return window.over") == [[False, True], [False, False], [False, True], [False, False]]


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"measurements": [{"id": "m", "state": "running", "uuids": [ARM]}]},
         "This node is being measured. Stop the measurement first. Until then its datasheet is frozen."),
        ({"status": {"write": False, "links": []}}, "This browser has read-only access."),
        ({"connection": "lost"}, ""),
    ],
)  # fmt: skip
def test_what_forbids_a_write_is_said_and_the_button_waits(writing: Stage, changed: dict[str, Any], words: str) -> None:
    give(writing, "slew.json", "{}")
    go = writing.page.get_by_role("button", name="Sign and write to hand")
    go.wait_for()
    assert go.is_enabled()
    change(writing, **changed)
    writing.run("window.panel.paint()")
    assert (go.is_disabled(), writing.page.locator("input[type=file]").is_disabled()) == (True, True)
    assert text(writing, "section > p.hint:last-of-type") == words


@pytest.fixture
def many(stage: Stage) -> Stage:
    """The bar of selected nodes: three are known, two listed."""
    wires = [{"uuid": uuid, "name": name} for uuid, name in ((ARM, "arm"), (HAND, "hand"), (THIRD, "third"))]
    nodes(stage, *wires)
    stage.run(
        """
        const listed = () => [...state.nodes.values()].slice(0, 2);
        window.bulk = new bulk.Bulk(listed, () => window.bulk.paint());
        document.getElementById("main").append(window.bulk.toggle, window.bulk.bar);
        """
    )
    press(stage, "Select")
    return stage


def chosen(stage: Stage) -> Any:
    return stage.run("return [...window.bulk.chosen].map((uuid) => state.nodes.get(uuid).name)")


def test_all_listed_nodes_are_selected_or_none_and_others_stay(many: Stage) -> None:
    assert (chosen(many), many.page.get_by_role("button", name="Verify").is_enabled()) == ([], False)
    many.run("window.bulk.choose(words[0], true)", THIRD)
    assert text(many, ".bulk strong") == "1 node selected, 1 of them not listed"
    press(many, "All listed")
    assert chosen(many) == ["third", "arm", "hand"]
    many.run("window.bulk.choose(words[0], false)", ARM)
    press(many, "All listed")
    assert chosen(many) == ["third", "hand", "arm"], "not all were selected, so they are now"
    press(many, "All listed")
    assert chosen(many) == ["third"]
    many.run("state.nodes.delete(words[0]); window.bulk.paint()", THIRD)
    assert (chosen(many), text(many, ".bulk strong")) == ([], "0 nodes selected")
    many.run("window.bulk.choose(words[0], true)", ARM)
    change(many, status={"write": False, "links": []})
    many.run("window.bulk.paint()")
    able = {name: many.page.get_by_role("button", name=name).is_enabled()
            for name in ("Verify", "Measure", "Update firmware", "Add to group")}  # fmt: skip
    assert able == {"Verify": True, "Measure": False, "Update firmware": False, "Add to group": False}
    press(many, "Select")
    assert (chosen(many), many.run("return window.bulk.on")) == ([], False)


def test_four_nodes_are_verified_at_once_and_each_refusal_is_named(many: Stage) -> None:
    extra = [{"uuid": letter * 20, "name": letter} for letter in "def"]
    nodes(many, *extra)
    many.answers(**{f"GET nodes/{uuid}/teds": HELD for uuid in (ARM, HAND, THIRD, *(one["uuid"] for one in extra))})
    many.run("for (const uuid of state.nodes.keys()) window.bulk.choose(uuid, true)")
    press(many, "Verify")
    assert len(many.sent) == 4
    for answer in ({"verdict": "authentic"}, {}, {"verdict": "unproven"}, {"refused": 503, "message": "Silent."}):
        many.run("window.held.shift()(words[0])", answer)
    assert text(many, ".bulk-result") == "Verified 4 of 6 …"
    assert len(many.sent) == 2
    for _ in range(2):
        many.run("window.held.shift()({})")
    assert texts(many, ".bulk-result p") == ["Verified 4 of 6."]
    assert texts(many, ".refused li") == ["third: unproven", "d: Silent."]
    assert many.said == "Verified 4 of 6."
    assert [entry["path"] for entry in many.sent] == ["nodes"]


def test_selected_nodes_join_a_group_beside_its_members_and_are_measured(many: Stage) -> None:
    many.run("window.bulk.choose(words[0], true); window.bulk.choose(words[1], true)", ARM, HAND)
    press(many, "Add to group")
    assert text(many, ".bulk-result") == "Enter the name of a group."
    assert many.sent == []
    many.run("state.groups = [{ name: 'pair', uuids: words }]; window.bulk.paint()", THIRD, ARM)
    assert many.run("return [...document.querySelectorAll('datalist option')].map((one) => one.value)") == ["pair"]
    for name, words in ((" pair ", "Group pair has 3 nodes."), ("new", "Group new has 2 nodes.")):
        many.page.get_by_label("Group to add to").fill(name)
        press(many, "Add to group")
        assert text(many, ".bulk-result") == words
    press(many, "Measure")
    assert text(many, ".bulk-result") == "Measuring 2 nodes."
    asked = many.sent
    assert {entry["path"] for entry in asked if entry["method"] == "GET"} == {"groups", "measurements", "nodes"}
    assert [entry for entry in asked if entry["method"] != "GET"] == [
        {"method": "PUT", "path": "groups/pair", "body": {"uuids": [THIRD, ARM, HAND]}},
        {"method": "POST", "path": "groups", "body": {"name": "new", "uuids": [ARM, HAND]}},
        {"method": "POST", "path": "measurements", "body": {"uuids": [ARM, HAND]}},
    ]
    many.answers(**{"POST measurements": {"refused": 423, "message": "Claimed.", "hint": "Wait."}})
    press(many, "Measure")
    assert text(many, ".bulk-result") == "Claimed. Wait."


IMAGE = {"version": "1.4.0", "board": "finger", "digest": "ab" * 32, "octets": 66233}
FROM = {"from": "1.3.0", "to": "1.4.0", "octets": 66233, "seconds": 3.4, "interrupts": []}
REFUSED = {"result": "refused"}
BOARDS = [
    {"uuid": ARM, "plan": "upload", **FROM},
    {"uuid": HAND, "plan": "upload", **FROM, "question": "It names no board.", "interrupts": ["m"], "seconds": 0.2},
    {"uuid": THIRD, **FROM, **REFUSED, "error": {"code": "downgrade", "message": "Older.", "hint": "--allow"}},
    {"uuid": "d" * 20, **FROM, **REFUSED, "error": {"code": "no-update", "message": "None.", "hint": "Cable."}},
    {"uuid": "e" * 20, "plan": "nothing", **FROM, "from": NONE, "octets": 0, "result": "already"},
]  # fmt: skip


@pytest.fixture
def firmware(stage: Stage) -> Stage:
    """The panel of an update, with two selected nodes and an image."""
    nodes(stage, *({"uuid": uuid, "name": name} for uuid, name in ((ARM, "arm"), (HAND, "hand"), (THIRD, "third"))))
    stage.answers(**{"POST updates": {"image": IMAGE, "boards": BOARDS, "id": "u1"}})
    stage.run(
        """
        window.chosen = words;
        const [main, select] = [document.getElementById("main"), () => (window.selecting = true)];
        window.panel = show(new update.UpdatePanel(main, () => window.chosen, select));
        """,
        ARM,
        HAND,
    )
    give(stage, "finger.bin", "x" * 2049)
    stage.page.get_by_text("finger.bin, 3 KiB").wait_for()
    stage.sent  # noqa: B018
    return stage


def test_the_plan_says_of_each_board_what_happens_and_only_answered_questions_count(firmware: Stage) -> None:
    firmware.page.get_by_label("Boards at once").fill("2")
    press(firmware, "Show the plan")
    assert firmware.sent == [
        {"method": "POST", "path": f"updates?nodes={ARM},{HAND}&parallel=2&dry_run=1", "body": "2049 octets",
         "kind": "application/octet-stream"}
    ]  # fmt: skip
    assert texts(firmware, "[aria-label='Plan of each board'] li") == [
        "arm 1.3.0 → 1.4.0 ready Installs 1.4.0, 66233 octets, about 3 s.",
        "hand 1.3.0 → 1.4.0 question Installs 1.4.0, 66233 octets, about 1 s. Its measurement pauses."
        " It names no board. Install it on hand all the same",
        "third 1.3.0 → 1.4.0 refused Older."
        " To go back on purpose, tick “Allow an older version” and show the plan again.",
        "node dddddddd 1.3.0 → 1.4.0 refused None. Cable.",
        "node eeeeeeee unknown → 1.4.0 nothing to do Runs it already: 1.4.0.",
    ]
    assert text(firmware, ".plan > p.hint") == "For finger. Image abababababababab, 66233 octets."
    assert firmware.said == "Plan for 5 boards, 2 refused, 1 with a question."
    assert firmware.page.get_by_role("button", name="Update 1 board to 1.4.0").is_enabled()
    firmware.page.get_by_label("Install it on hand all the same").check()
    firmware.page.get_by_label("Allow an older version").check()
    firmware.answers(**{"POST updates": {"refused": 423, "message": "Another updates.", "hint": "Wait."}})
    press(firmware, "Update 2 boards to 1.4.0")
    firmware.page.get_by_role("alert").filter(has_text="Another updates.").wait_for()
    [sent, after] = firmware.sent
    assert sent["path"] == f"updates?nodes={ARM},{HAND}&parallel=2&allow_downgrade=1&other_board={HAND}"
    assert (sent["body"], after["path"]) == ("2049 octets", "updates")
    firmware.page.get_by_label("Install it on hand all the same").uncheck()
    firmware.answers(**{"POST updates": {"id": "u1"}})
    running = {"id": "u1", "state": "running", "image": IMAGE, "owner": "page", "began": NOW, "boards": []}
    firmware.answers(**{"GET updates": {"updates": [running]}})
    firmware.page.get_by_label("Boards at once").evaluate("one => (one.value = '')")
    press(firmware, "Update 1 board to 1.4.0")
    firmware.pass_time(20)
    assert firmware.sent[0]["path"] == f"updates?nodes={ARM}&parallel=1&allow_downgrade=1"
    assert firmware.run("return document.activeElement.innerText") == "Updating to 1.4.0"
    assert firmware.page.get_by_role("button", name="Show the plan").is_hidden(), "one at a time"
    assert text(firmware, ".plan") == ""


def test_without_an_image_a_board_or_a_right_there_is_no_plan(firmware: Stage) -> None:
    ask = firmware.page.get_by_role("button", name="Show the plan")
    assert ask.is_enabled()
    assert firmware.page.get_by_role("button", name="Select boards").is_hidden()
    for changed in ({"status": {"write": False, "links": []}}, {"connection": "lost", "status": {"links": []}}):
        change(firmware, **changed)
        assert ask.is_disabled()
        assert firmware.page.locator("input[type=file]").is_disabled()
    change(firmware, connection="live")
    firmware.run("window.chosen = []; window.panel.paint()")
    assert (ask.is_disabled(), text(firmware, ".stack > p")) == (True, "No boards are selected.")
    press(firmware, "Select boards")
    assert firmware.run("return window.selecting") is True
    ten = [f"{number}" * 20 for number in range(10)]
    firmware.run("window.chosen = words; window.panel.paint()", *ten)
    assert text(firmware, ".stack > p").endswith("node 77777777 and 2 more")
    firmware.run("window.chosen = words; window.panel.paint()", *ten[:9])
    assert text(firmware, ".stack > p").endswith("node 77777777 and 1 more")
    firmware.run("window.panel.take(new File([new Uint8Array(4 * 1024 * 1024 + 1)], 'large.bin'))")
    firmware.page.get_by_role("alert").filter(has_text="large.bin is too large").wait_for()
    assert (ask.is_disabled(), text(firmware, ".drop strong")) == (True, "Choose a firmware image")
    firmware.answers(**{"POST updates": {"refused": 422, "message": "No image.", "hint": "Sign it."}})
    give(firmware, "finger.bin", "y")
    firmware.page.get_by_text("finger.bin, 1 KiB").wait_for()
    press(firmware, "Show the plan")
    assert texts(firmware, ".plan [role=alert]") == ["No image. Sign it."]
    give(firmware, "other.bin", "z")
    firmware.page.get_by_text("other.bin, 1 KiB").wait_for()
    assert text(firmware, ".plan") == "", "that was about another image"


def test_an_image_may_be_dropped_and_marks_the_place_while_it_is_above_it(firmware: Stage) -> None:
    firmware.run(
        """
        const files = new DataTransfer();
        files.items.add(new File(["z"], "dropped.bin"));
        const place = document.querySelector(".drop");
        const drag = (name) => place.dispatchEvent(new DragEvent(name, { dataTransfer: files, cancelable: true }));
        const names = ["dragover", "dragleave", "dragenter", "drop"];
        window.over = names.map((name) => [drag(name), place.classList.contains("over")]);
        """
    )
    firmware.page.get_by_text("dropped.bin, 1 KiB").wait_for()
    assert firmware.run("return window.over") == [[False, True], [False, False], [False, True], [False, False]]
    change(firmware, connection="lost")
    assert firmware.page.locator(".drop.off").count() == 1
    firmware.run("window.panel.take(new File(['z'], 'late.bin'))")
    assert text(firmware, ".drop strong") == "dropped.bin, 1 KiB", "nothing is taken while it is disabled"


@pytest.mark.parametrize(
    ("made", "accepted"),
    [
        ("new update.UpdatePanel(main, () => [], () => 0)", ".bin,application/octet-stream"),
        ("new write.WritePanel(words[0], () => 0)", ".xml,.json,application/xml,application/json"),
        ("new provision.ProvisionTab(main, words[0])", ".csv,.toml,.json,.txt,.xml"),
        ("virtual.virtualView(main)", ".xml,.json,application/xml,application/json"),
    ],
)
def test_the_choice_of_a_file_offers_what_is_read(stage: Stage, made: str, accepted: str) -> None:
    nodes(stage, gripper())
    script = f"""
      const main = document.getElementById("main"), made = show({made});
      const file = main.querySelector("input[type=file]") ?? made.file;
      return file.accept;
    """
    assert stage.run(script, ARM) == accepted


def test_how_an_update_goes_is_told_board_by_board(firmware: Stage) -> None:
    error = {"message": "It is silent.", "hint": "Switch it off."}
    boards: list[dict[str, Any]] = [
        {"uuid": ARM, "from": "1.3.0", "to": "1.4.0", "result": "updated", "seconds": 15.84},
        {"uuid": HAND, "from": "1.3.0", "to": "1.4.0", "result": "lost", "seconds": 2, "error": error},
        {"uuid": THIRD, "from": "1.3.0", "to": "1.4.0", "state": "running", "step": "upload", "octets": 200,
         "written": 101},
        {"uuid": "d" * 20, "from": NONE, "to": "1.4.0", "state": "waiting"},
    ]  # fmt: skip
    told = {"id": "u1", "state": "running", "image": IMAGE, "owner": "api:lab", "began": NOW, "boards": boards}
    firmware.run("state.updates = [{ id: 'old', state: 'done' }, words[0]]; window.panel.paint()", told)
    assert texts(firmware, "[aria-label='How the update goes'] > h3, [aria-label='How the update goes'] > p") == [
        "Updating to 1.4.0",
        "Requested by api:lab at 10:00:00. It goes on if this page is closed.",
        "2 of 4 boards done: 1 updated, 1 lost",
    ]
    assert texts(firmware, "[aria-label='Boards of this update'] li") == [
        "arm 1.3.0 → 1.4.0, 15.84 s updated",
        "hand 1.3.0 → 1.4.0, 2 s lost It is silent. Switch it off.",
        "third 1.3.0 → 1.4.0 uploading",
        "node dddddddd unknown → 1.4.0 waiting",
    ]
    assert firmware.page.get_by_role("progressbar", name="Upload to third").get_attribute("value") == "50"
    chips = "return [...document.querySelectorAll('.lines .chip')].map((one) => one.className)"
    assert firmware.run(chips) == ["chip good", "chip bad", "chip busy", "chip plain"]
    firmware.answers(**{"DELETE updates/u1": {"refused": 409, "message": "It is over.", "hint": "Look."}})
    press(firmware, "Begin no further board")
    assert texts(firmware, "[aria-label='How the update goes'] .trouble") == ["It is over. Look."]
    firmware.answers(**{"DELETE updates/u1": {}})
    firmware.sent  # noqa: B018
    press(firmware, "Begin no further board")
    firmware.pass_time(20)
    asked = [(entry["method"], entry["path"]) for entry in firmware.sent]
    assert asked == [("DELETE", "updates/u1"), ("GET", "updates")]
    assert texts(firmware, "[aria-label='How the update goes'] .trouble") == []
    words = {"restart": "restarting", "prove": "proving itself", "revert": "going back", "else": "looking"}
    for step, shown in words.items():
        boards[2]["step"] = step
        firmware.run("state.updates = [words[0]]; window.panel.paint()", told)
        assert texts(firmware, "[aria-label='Boards of this update'] li")[2].endswith(shown)
    boards[3]["state"] = "running"
    firmware.run("state.updates = [words[0]]; window.panel.paint()", told)
    assert firmware.page.get_by_role("button", name="Begin no further board").is_hidden(), "all have begun"
    boards[2] |= {"step": NONE, "result": "reverted", "seconds": 1}
    boards[3] |= {"state": "skipped"}
    over = told | {"state": "stopped", "owner": "page", "ended": NOW + 5}
    firmware.run("state.updates = [words[0]]; window.panel.paint()", over)
    assert texts(firmware, "[aria-label='How the update goes'] > h3, [aria-label='How the update goes'] > p") == [
        "Update to 1.4.0 was stopped",
        "Requested by the page at 10:00:00, over at 10:00:05.",
        "4 of 4 boards done: 1 updated, 1 reverted, 1 lost",
    ]
    assert texts(firmware, "[aria-label='Boards of this update'] li")[3].endswith("not begun")
    assert firmware.said == "4 of 4 boards done: 1 updated, 1 reverted, 1 lost"
    assert firmware.page.get_by_role("button", name="Begin no further board").is_hidden()
    firmware.run("state.updates = [words[0]]; window.panel.paint()", over | {"state": "done"})
    assert text(firmware, "[aria-label='How the update goes'] > h3") == "Update to 1.4.0 is over"
    firmware.run("state.updates = []; window.panel.paint()")
    assert firmware.page.get_by_role("region", name="How the update goes").is_hidden()


def entries(*numbers: int, **more: Any) -> list[dict[str, Any]]:
    return [{"seq": number, "time": NOW, "act": f"act {number}", "detail": "so", "actor": "api:lab"} | more
            for number in numbers]  # fmt: skip


def answer_log(stage: Stage, *numbers: int, intact: bool = True, **more: Any) -> None:
    stage.answers(**{"GET log": {"entries": entries(*numbers, **more), "intact": intact, "why": "line 7"}})


def rows(stage: Stage) -> Any:
    return texts(stage, "table.log tbody tr")


@pytest.fixture
def log(stage: Stage) -> Stage:
    """The audit log with three entries."""
    answer_log(stage, 3, 1, 2)
    stage.run("show(log.logView(document.getElementById('main')))")
    stage.page.get_by_text("3 entries").wait_for()
    return stage


def test_the_log_is_newest_first_and_looks_for_news_every_five_seconds(log: Stage) -> None:
    assert [entry["path"] for entry in log.sent] == ["log?limit=200"]
    assert rows(log)[0] == "10:00:00 act 3 so api:lab"
    assert [row.split()[2] for row in rows(log)] == ["3", "2", "1"]
    assert log.page.get_by_role("button", name="Show older entries").is_hidden()
    assert text(log, ".view-head .chip") == "Chain intact"
    nodes(log, {"uuid": ARM, "name": "arm"})
    answer_log(log, 4, intact=False, uuid=ARM, failed=True, actor=NONE, who="lab")
    log.pass_time(5100)
    assert (rows(log)[0], len(rows(log))) == ("10:00:00 act 4 failed arm so lab", 4)
    assert log.run("return document.querySelector('.chip.bad').innerText") == "Chain broken: the log was altered"
    assert log.run("return document.querySelector('.view-head > span').title") == "line 7"
    change(log, connection="lost")
    log.sent  # noqa: B018
    log.pass_time(11_000)
    assert log.sent == [], "a station that is not there is not asked"
    change(log, connection="live")
    log.run("hub.changed('log')")
    log.pass_time(20)
    assert [entry["path"] for entry in log.sent] == ["log?limit=200"], "at once when the station reports an entry"


def test_the_station_searches_when_the_typing_pauses_and_late_answers_are_dropped(log: Stage) -> None:
    log.sent  # noqa: B018
    search = log.page.get_by_label("Search the log")
    log.answers(**{"GET log": HELD})
    search.fill(" first ")
    log.pass_time(200)
    search.fill(" second ")
    log.pass_time(240)
    assert log.sent == []
    log.pass_time(20)
    assert [entry["path"] for entry in log.sent] == ["log?limit=200&text=second"]
    answer_log(log, 9)
    log.page.get_by_label("Failures only").check()
    log.page.get_by_text("1 entry").wait_for()
    assert [row.split()[2] for row in rows(log)] == ["9"], "of another search nothing stays"
    log.run("window.held.shift()({ entries: words, intact: true })", *entries(7, 8))
    assert [row.split()[2] for row in rows(log)] == ["9"]
    log.page.get_by_label("Time").select_option("Last hour")
    minute = (NOW + 60 - 3600) // 60 * 60
    paths = [entry["path"] for entry in log.sent]
    assert paths[0] == "log?limit=200&text=second&failed=1"
    assert paths[1].startswith("log?limit=200&text=second&failed=1&since=")
    assert minute <= int(paths[1].rpartition("=")[2]) <= minute + 120
    assert int(paths[1].rpartition("=")[2]) % 60 == 0, "by the minute: the same search for as long"
    answer_log(log)
    search.fill("x")
    log.pass_time(260)
    assert texts(log, ".empty") == ["No matching entries. Try another search, or clear the filter."]
    search.fill("")
    log.page.get_by_label("Failures only").uncheck()
    log.page.get_by_label("Time").select_option("All entries")
    log.pass_time(260)
    assert texts(log, ".empty") == ["The log is empty. Every change and every refusal is recorded here."]
    log.answers(**{"GET log": {"refused": 503, "message": "Busy.", "hint": "Later."}})
    log.pass_time(5000)
    assert texts(log, "[role=alert].trouble") == ["Busy. Later."]


def test_older_entries_come_before_the_oldest_one_until_there_are_no_more(log: Stage) -> None:
    older = log.page.get_by_role("button", name="Show older entries")
    answer_log(log, *range(300, 100, -1))
    log.page.get_by_label("Failures only").check()
    log.page.get_by_text("Newest 200 entries").wait_for()
    log.sent  # noqa: B018
    answer_log(log, 99, 100)
    older.click()
    log.page.get_by_text("202 entries", exact=True).wait_for()
    assert [entry["path"] for entry in log.sent] == ["log?limit=200&failed=1&before=101"]
    assert older.is_hidden()


def test_a_nodes_history_has_its_own_entries_fifty_at_a_time(stage: Stage) -> None:
    answer_log(stage, *range(50, 0, -1))
    stage.run("show(new history.HistoryTab(document.getElementById('main'), words[0]))", ARM)
    stage.page.get_by_text("Newest 50 entries").wait_for()
    answer_log(stage, 0, failed=True, detail=NONE, actor=NONE, who="lab")
    press(stage, "Show older entries")
    stage.page.get_by_text("51 entries", exact=True).wait_for()
    assert [entry["path"] for entry in stage.sent] == [f"log?limit=50&uuid={ARM}", f"log?limit=50&uuid={ARM}&before=1"]
    assert texts(stage, ".history li")[-1] == "10:00:00 act 0 failed lab"
    assert stage.page.get_by_role("button", name="Show older entries").is_hidden()
    answer_log(stage, 51)
    stage.run("hub.changed('log')")
    stage.pass_time(20)
    stage.run("hub.changed('nodes')")
    stage.pass_time(900)
    assert stage.sent == [], "events come in bursts"
    stage.pass_time(200)
    assert len(stage.sent) == 1
    assert texts(stage, ".history li")[0].startswith("10:00:00 act 51")
    stage.run("hub.changed('log')")
    stage.pass_time(1100)
    assert len(stage.sent) == 1, "the next burst"
    for answer, words in (
        ({"refused": 404}, "No history for this node yet."),
        ({"refused": 503, "message": "Busy."}, "Busy."),
        ({"entries": []}, "No history for this node yet."),
    ):
        stage.answers(**{"GET log": answer})
        stage.run(
            """
            const main = document.getElementById("main");
            main.replaceChildren();
            show(new history.HistoryTab(main, words[0]));
            """,
            HAND,
        )
        assert texts(stage, "section > div:nth-child(2)") == [words]


def test_filters_join_and_a_chosen_word_stays_though_no_node_has_it_any_more(stage: Stage) -> None:
    wires: list[dict[str, Any]] = [
        {"uuid": ARM, "name": "Arm", "profile": "gripper", "verdict": {"verdict": "authentic"}, "via": "can",
         "groups": ["pair", "all"], "due": "2026-11-24"},
        {"uuid": HAND, "name": "hand", "profile": "load-cell", "via": "nfc", "present": False, "groups": ["pair"],
         "due": "2026-12-20"},
        {"uuid": THIRD, "name": "", "virtual": True, "via": "can", "due": "2027-11-24"},
        {"uuid": "dd" * 10, "name": "last", "via": "ble"},
    ]  # fmt: skip
    nodes(stage, *wires)
    stage.run(
        """
        window.changed = 0;
        window.filters = new filters.Filters(() => (window.changed += 1));
        document.getElementById("main").append(window.filters.element);
        window.of = () => window.filters.of([...state.nodes.values()]).map((node) => node.uuid.slice(0, 2));
        """
    )
    of = "return window.of()"
    assert (stage.run(of), stage.run("return window.filters.on")) == (["a1", "b2", "c3", "dd"], False)
    choices = """
      const words = (one) => [...one.options].slice(1).map((each) => each.value);
      return Object.fromEntries(window.filters.selects.map((one) => [one.dataset.filter, words(one)]));
    """
    assert stage.run(choices) == {
        "type": ["gripper", "load-cell", "no type"],
        "verdict": ["authentic", "not checked"],
        "due": ["due in 30 days", "no date", "not due", "overdue"],
        "link": ["away", "BLE", "CAN", "Virtual"],
        "group": ["all", "no group", "pair"],
    }
    picked = """
      const [search, choices] = words;
      window.filters.search.value = search;
      for (const one of window.filters.selects) one.value = choices[one.dataset.filter] ?? "";
      return [window.of(), window.filters.clear.hidden, window.filters.more.firstChild.textContent];
    """
    for search, choice, found, filters in (
        ("ARM", {}, ["a1"], "Filter"), ("load", {}, ["b2"], "Filter"), ("a1a1 a1a1", {}, ["a1"], "Filter"),
        ("node c3c3", {}, ["c3"], "Filter"), ("", {"group": "pair"}, ["a1", "b2"], "Filter: 1 chosen"),
        ("", {"group": "pair", "link": "CAN"}, ["a1"], "Filter: 2 chosen"),
        ("hand", {"link": "CAN"}, [], "Filter: 1 chosen"), ("", {"due": "overdue"}, ["a1"], "Filter: 1 chosen"),
        ("", {"due": "due in 30 days"}, ["b2"], "Filter: 1 chosen"), (" ", {}, ["a1", "b2", "c3", "dd"], "Filter"),
    ):  # fmt: skip
        assert stage.run(picked, search, choice) == [found, search == " ", filters], (search, choice)
    stage.run(picked, "x", {"type": "gripper"})
    stage.run("state.nodes.delete(words[0])", ARM)
    assert stage.run(of) == []
    assert stage.run("return window.filters.selects[0].value") == "gripper"
    stage.run("window.changed = 0; window.filters.clear.click()")
    assert (stage.run(of), stage.run("return window.changed")) == (["b2", "c3", "dd"], 1)
