"""Views of the page by themselves: a held actuator, changes before they are written, plans, filters, words."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import pytest

from .stage import ARM

if TYPE_CHECKING:
    from .stage import Stage

pytestmark = pytest.mark.system
NONE = None
HELD = "held"


def nodes(stage: Stage, *wires: dict[str, Any]) -> None:
    """Let the station know these nodes."""
    stage.run("for (const wire of words) state.nodes.set(wire.uuid, shapes.node(wire)); hub.changed('nodes')", *wires)


def gripper(**more: Any) -> dict[str, Any]:
    """Return a node as the API describes it: an actuator in mm, and its sensor."""
    shown = {"unit": "mm", "factor": 1000, "offset": 0}
    opening = {"number": 1, "name": "opening set point", "kind": "actuator", "unit": "m", "shown": shown,
               "low": 0, "high": 0.11, "rate": 100}  # fmt: skip
    sensor = opening | {"number": 2, "name": "opening", "kind": "sensor", "uncertainty": 0.0001}
    return {"uuid": ARM, "name": "hand", "whitelisted": True, "present": True, "channels": [opening, sensor]} | more


PRESS = """
  const named = (one) => (one.getAttribute("aria-label") ?? one.innerText).trim() === words[0];
  const found = [...document.querySelectorAll("button")].filter((one) => named(one) && one.checkVisibility());
  if (found.length !== 1 || found[0].disabled) throw new Error(`${found.length} buttons to press: ${words[0]}`);
  found[0].focus();
  found[0].click();
"""


def press(stage: Stage, name: str) -> None:
    """Press the one button of this name that is seen, at a twentieth of what a mouse costs."""
    stage.run(PRESS, name)


def change(stage: Stage, **more: Any) -> None:
    """Change the state, and let the views know."""
    stage.run("Object.assign(state, words[0]); hub.changed('status', 'connection', 'nodes', 'measurements')", more)
    stage.pass_time(20)


CHANNEL = f"nodes/{ARM}/channels/1"
PUT = f"PUT {CHANNEL}"
SAFE = {"applied": {"value": 0.0399}, "safe": True}
RELEASED = {"method": "PUT", "path": CHANNEL, "body": {"hold": 0}}


@pytest.fixture
def actuator(stage: Stage) -> Stage:
    """An actuator with 40 mm in its field, whose requests are answered at once."""
    nodes(stage, gripper())
    stage.answers(**{PUT: SAFE})
    stage.run(
        "document.getElementById('main').append(show(window.panel = new actuator.ActuatorPanel(words[0], 1)).element)",
        ARM,
    )
    stage.page.get_by_role("spinbutton").fill("40")
    stage.pass_time(20)
    return stage


def shown(stage: Stage) -> str:
    """Return what the actuator's panel says of its state."""
    return str(stage.run("return document.querySelector('.actuator-state').innerText"))


def held(stage: Stage) -> None:
    """Put the mouse down on the button, and take what was asked until now."""
    stage.page.get_by_role("button", name="Hold to move").hover()
    stage.page.mouse.down()
    stage.pass_time(10)


def test_a_held_button_sends_its_value_four_times_a_second_one_request_after_the_other(actuator: Stage) -> None:
    held(actuator)
    [first] = actuator.sent
    assert first == {"method": "PUT", "path": CHANNEL, "body": {"value": pytest.approx(0.04), "hold": 0.8}}
    assert (shown(actuator), actuator.said) == ("Moving: 39.900 mm", "Moving opening set point.")
    assert actuator.run("return document.querySelectorAll('[data-held][aria-pressed=true]').length") == 1
    actuator.pass_time(1000)
    assert len(actuator.sent) == 4
    actuator.answers(**{PUT: HELD})
    actuator.pass_time(2000)
    assert len(actuator.sent) == 1, "while one is on its way there is no second one"
    actuator.page.get_by_role("spinbutton").evaluate("entry => (entry.value = '50')")
    actuator.answers(**{PUT: SAFE})
    actuator.run("window.held.shift()()")
    actuator.pass_time(10)
    assert [entry["body"]["value"] for entry in actuator.sent] == [pytest.approx(0.05)], "at once: it is overdue"
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert actuator.sent == [RELEASED]
    assert shown(actuator).startswith("Safe: confirmed by the node at 10:0")
    assert actuator.said == "opening set point of hand is in its safe state."
    actuator.pass_time(2000)
    assert actuator.sent == []


KEEPALIVE = {**RELEASED, "keepalive": True}
LETTING_GO = {
    "pointer cancelled": "document.querySelector('.hold').dispatchEvent(new PointerEvent('pointercancel'))",
    "capture lost": "document.querySelector('.hold').dispatchEvent(new PointerEvent('lostpointercapture'))",
    "focus lost": "document.querySelector('.hold').blur()",
    "menu opened": "document.querySelector('.hold').dispatchEvent(new Event('contextmenu'))",
    "connection lost": "state.connection = 'lost'; hub.changed('connection')",
    "signed out": "state.connection = 'signed out'; hub.changed('connection')",
    "read only": "state.status = { write: false, links: [] }; hub.changed('status')",
    "not on the whitelist": "state.nodes.get(words[0]).whitelisted = false; hub.changed('nodes')",
}


@pytest.mark.parametrize("how", LETTING_GO)
def test_whatever_takes_the_button_from_the_person_lets_go(actuator: Stage, how: str) -> None:
    held(actuator)
    actuator.sent  # noqa: B018
    actuator.run(LETTING_GO[how], ARM)
    actuator.pass_time(30)
    assert actuator.sent == [RELEASED]
    actuator.pass_time(1000)
    assert actuator.sent == []
    assert actuator.run("return document.querySelector('[data-held]')") is None
    actuator.page.mouse.up()


LEAVING = {
    "another tab": ("document", "visibilitychange", "hidden", True),
    "another window": ("window", "blur", "visible", False),
    "page left": ("window", "pagehide", "hidden", False),
}


@pytest.mark.parametrize("how", LEAVING)
def test_leaving_the_page_lets_go_at_once_by_a_request_that_outlives_it(actuator: Stage, how: str) -> None:
    where, name, visibility, focus = LEAVING[how]
    held(actuator)
    actuator.sent  # noqa: B018
    script = f"""
      Object.defineProperty(document, "visibilityState", {{ configurable: true, get: () => words[0] }});
      document.hasFocus = () => words[1];
      {where}.dispatchEvent(new Event("{name}"));
    """
    try:
        actuator.run(script, "visible", True)
        actuator.pass_time(300)
        assert [entry["body"]["hold"] for entry in actuator.sent] == [0.8], "the page is in front, so nobody left"
        actuator.run(script, visibility, focus)
        assert actuator.sent[:1] == [KEEPALIVE]
        actuator.pass_time(1000)
        assert actuator.sent == []
    finally:
        actuator.run("delete document.visibilityState; delete document.hasFocus")
        actuator.page.mouse.up()


@pytest.mark.parametrize("key", [" ", "Enter"])
def test_it_moves_while_a_key_is_held_and_a_repeated_key_is_one_hold(actuator: Stage, key: str) -> None:
    actuator.page.get_by_role("button", name="Hold to move").focus()
    actuator.page.keyboard.down("a")
    actuator.page.keyboard.up("a")
    assert actuator.sent == []
    actuator.page.keyboard.down(key)
    actuator.page.keyboard.down(key)  # the keyboard repeats it
    actuator.page.keyboard.up("a")
    actuator.pass_time(10)
    assert [entry["body"]["hold"] for entry in actuator.sent] == [0.8]
    actuator.page.keyboard.up(key)
    actuator.pass_time(10)
    assert actuator.sent == [RELEASED]


def test_only_the_first_button_of_a_mouse_moves_it(actuator: Stage) -> None:
    actuator.page.get_by_role("button", name="Hold to move").hover()
    actuator.page.mouse.down(button="right")
    actuator.page.mouse.up(button="right")
    actuator.pass_time(10)
    assert actuator.sent == []


def test_a_refused_set_point_lets_go_and_says_why(actuator: Stage) -> None:
    actuator.answers(**{PUT: {"refused": 422, "code": "refused", "message": "Too far.", "hint": "Less."}})
    held(actuator)
    assert [entry["body"]["hold"] for entry in actuator.sent] == [0.8, 0]
    alert = "return document.querySelector('.actuator [role=alert]')?.innerText ?? ''"
    assert actuator.run(alert) == "Too far.\n\nLess."
    assert shown(actuator) == "Not controlled from this page", "safe is what the node said, and it said nothing"
    actuator.page.mouse.up()
    actuator.answers(**{PUT: SAFE})
    held(actuator)
    assert actuator.run(alert) == ""
    actuator.answers(**{PUT: {"refused": 503, "message": "Silent.", "hint": "Look."}})
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert actuator.run(alert) == (
        "Silent.\n\nLook. Without further set points, the node goes to its safe state by itself within a second."
    )


def test_a_pointer_that_slips_off_the_button_still_holds_it_and_lets_go_wherever_it_is(actuator: Stage) -> None:
    held(actuator)
    actuator.page.mouse.move(5, 850)
    actuator.pass_time(1000)
    assert [entry["body"]["hold"] for entry in actuator.sent] == [0.8] * 5
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert actuator.sent == [RELEASED]


def test_released_and_held_again_while_a_request_is_on_its_way_is_one_row_of_requests(actuator: Stage) -> None:
    actuator.answers(**{PUT: HELD})
    held(actuator)
    actuator.page.mouse.up()
    actuator.page.mouse.down()
    actuator.pass_time(500)
    assert len(actuator.sent) == 1
    actuator.answers(**{PUT: SAFE})
    actuator.run("window.held.shift()()")
    actuator.pass_time(300)
    assert [entry["body"]["hold"] for entry in actuator.sent] == [0.8, 0.8]
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert actuator.sent == [RELEASED]


def test_safe_is_said_only_when_the_node_confirmed_it(actuator: Stage) -> None:
    held(actuator)
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert shown(actuator).startswith("Safe: confirmed by the node at")
    held(actuator)
    actuator.answers(**{PUT: HELD})
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert shown(actuator) == "Stopping …"
    actuator.run("window.held.shift()({ safe: false })")
    actuator.pass_time(10)
    assert shown(actuator) == "Not controlled from this page"
    words = []
    for told in ({"safe": False, "value": 0.07}, {"safe": True, "value": NONE}, {"value": 0.07}):
        wire = gripper()
        wire["channels"][0]["actuator"] = told
        nodes(actuator, wire)
        actuator.pass_time(20)
        words.append(shown(actuator))
    assert words == ["Controlled from elsewhere: 70.000 mm", "Safe state", "Not controlled from this page"]


@pytest.mark.parametrize(
    ("changed", "may"),
    [
        ({}, True), ({"connection": "lost"}, False), ({"connection": "connecting"}, False),
        ({"status": {"write": False, "links": []}}, False), ({"status": NONE}, True),
    ],
)  # fmt: skip
def test_who_may_not_change_anything_holds_no_button(actuator: Stage, changed: dict[str, Any], may: bool) -> None:
    change(actuator, **changed)
    assert actuator.page.get_by_role("button", name="Hold to move").is_enabled() is may
    held(actuator)
    actuator.page.mouse.up()
    actuator.pass_time(10)
    assert bool(actuator.sent) is may


def test_what_is_no_number_moves_nothing(actuator: Stage) -> None:
    actuator.page.get_by_role("spinbutton").fill("")
    held(actuator)
    assert actuator.sent == []
    assert actuator.run("return document.querySelector('.actuator [role=alert]').innerText") == (
        "Enter a number as the set point.\n\nIt must be within 0 to 110 mm."
    )
    actuator.page.mouse.up()


def test_the_slider_stays_within_the_limits_and_follows_the_number(actuator: Stage) -> None:
    wire = gripper()
    wire["channels"][0] |= {"low": 0.00123456, "high": 0.1234567}
    nodes(actuator, wire)
    actuator.run(
        """
        document.getElementById("main").replaceChildren(show(new actuator.ActuatorPanel(words[0], 1)).element);
        """,
        ARM,
    )
    assert actuator.run("return document.querySelector('[type=range]').value") == "1.23456"
    entry, slider = actuator.page.get_by_role("spinbutton"), actuator.page.get_by_role("slider")
    actuator.run(
        """
        const slider = document.querySelector("[type=range]");
        slider.value = 1000;
        slider.dispatchEvent(new Event("input"));
        """
    )
    assert float(entry.input_value()) == pytest.approx(123.4567, abs=0.03)
    assert float(entry.input_value()) <= 123.4567
    entry.fill("50.1")
    assert float(slider.input_value()) == pytest.approx(50.1, abs=0.1)
    entry.fill("")
    assert float(slider.input_value()) == pytest.approx(50.1, abs=0.1)
    for high in (0.0012344, NONE):
        wire["channels"][0] |= {"low": 0.0012344, "high": high}
        nodes(actuator, wire)
        actuator.run(
            "document.getElementById('main').replaceChildren(show(new actuator.ActuatorPanel(words[0], 1)).element)",
            ARM,
        )
        assert actuator.page.get_by_role("slider").count() == 0, "nothing lies between its ends"
    assert float(actuator.page.get_by_role("spinbutton").input_value()) == pytest.approx(1.2344)


def test_closing_the_view_lets_go_of_what_is_held_and_hears_nothing_more(actuator: Stage) -> None:
    held(actuator)
    actuator.sent  # noqa: B018
    actuator.run("window.panel.end()")
    assert actuator.sent[:1] == [KEEPALIVE]
    actuator.pass_time(1000)
    actuator.sent  # noqa: B018
    actuator.run("window.panel.hold(); window.dispatchEvent(new Event('pagehide'))")
    actuator.page.mouse.up()
    actuator.run("window.panel.letGo()")
    actuator.pass_time(300)
    assert KEEPALIVE not in actuator.sent
