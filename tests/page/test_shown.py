"""From the API's answers to what people read, in the browser's own JavaScript: units, times, words, the past."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

import teds_provision

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system
FOLDER = Path(teds_provision.__file__).parent / "ncap/page/js"
CALL = """async ([source, name, cases]) => {
  const found = await import("data:text/javascript," + encodeURIComponent(source));
  const told = (one) => (one === undefined ? "-" : one);
  return cases.map((words) => {
    const result = found[name](...words) ?? null;
    return Array.isArray(result) ? result.map(told) : result;
  });
}"""


def called(browser: Browser, file: str, name: str, cases: list[list[Any]]) -> list[Any]:
    """Call an exported function of a module of the page, which imports nothing meanwhile, with each of these words."""
    source = re.sub(r"^import .*$", "", (FOLDER / file).read_text(), flags=re.MULTILINE)
    page = browser.new_page()
    try:
        found: list[Any] = page.evaluate(CALL, [source, name, cases])
        return found
    finally:
        page.close()


def shown(browser: Browser, file: str, name: str, *cases: tuple[list[Any], Any]) -> None:
    """Hold what the function gives for each list of words against what it should."""
    found = called(browser, file, name, [words for words, _ in cases])
    for result, (words, wanted) in zip(found, cases, strict=True):
        assert result == (pytest.approx(wanted) if isinstance(wanted, float | list) else wanted), (name, words)


def test_a_channel_is_shown_in_its_unit_its_lower_end_first(browser: Browser) -> None:
    upside_down = {"unit": "m", "shown": {"unit": "mm below", "factor": -1000, "offset": 5}, "low": 0, "high": 0.1}
    upside_down |= {"uncertainty": 0.001, "last": {"value": 0.05, "raw": 7, "time": 1, "valid": True}}
    turn = {"unit": "rad", "low": 0, "high": 2 * math.pi, "shown": {"unit": "°", "factor": 180 / math.pi, "offset": 0}}
    odd = {"unit": "K", "shown": {"unit": "°C", "factor": 0, "offset": None}, "kind": "unheard of", "last": None}
    wire = {"channels": [upside_down, turn, {**turn, "kind": "actuator"}, {**turn, "high": 6.0}, odd]}
    [node] = called(browser, "shapes.js", "node", [[wire]])
    first, angle, actuator, part, plain = node["channels"]
    assert (first["low"], first["high"], first["uncertainty"]) == pytest.approx((-95.0, 5.0, 1.0))
    assert (first["last"]["value"], first["last"]["raw"]) == (pytest.approx(-45.0), 7)
    assert angle["turn"] == pytest.approx({"low": 0.0, "size": 360.0})
    assert (actuator["turn"], part["turn"]) == (None, None), "what is set, and what is no whole turn, does not wrap"
    assert (plain["scale"]["factor"], plain["scale"]["offset"], plain["kind"], plain["last"]) == (1, 0, "sensor", None)


def test_a_node_without_a_battery_has_no_charge_and_a_mode_only_while_it_is_measured(browser: Browser) -> None:
    wires: list[dict[str, Any]] = [
        {"power": {"level": 80, "flags": ["battery", "charging", "too low"]}},
        {"power": {"level": 80, "flags": ["charging"]}},
        {"power": {"level": 0, "flags": ["battery", "in field"]}},
        {"power": None},
    ]
    nodes = called(browser, "shapes.js", "node", [[wire] for wire in wires])
    assert [node["power"] for node in nodes] == [
        {"percent": 80, "charging": "charging", "low": True},
        None,
        {"percent": 0, "charging": "charging", "low": False},
        None,
    ]
    states = ["running", "refused", "lost", "ended", "waiting", None]
    wires = [{"measurement": "1", "measuring": {"state": state}} for state in states]
    wires += [{"measurement": "1"}, {"measuring": {"state": "running"}}]
    nodes = called(browser, "shapes.js", "node", [[wire] for wire in wires])
    waiting = "waiting to be measured"
    assert [node["mode"] for node in nodes] == [
        "measuring", "refused, not measured", "lost, not measured", "not measured", waiting, waiting, waiting, None,
    ]  # fmt: skip


def test_values_go_to_the_shown_unit_and_back(browser: Browser) -> None:
    celsius = {"unit": "°C", "factor": 1, "offset": -273.15, "si": "K"}
    shown(browser, "shapes.js", "toShown", ([celsius, 293.15], 20.0), ([celsius, None], None))
    shown(browser, "shapes.js", "toSi", ([celsius, 20], 293.15))
    shown(browser, "shapes.js", "fromUnit", ([celsius, 20, "°C"], 20), ([celsius, 293.15, "K"], 20.0))
    shown(
        browser,
        "shapes.js",
        "moment",
        ([12.5], 12.5),
        (["2026-11-25T10:00:00Z"], 1795600800.0),
        (["yesterday"], None),
        ([None], None),
    )


def test_times_rates_and_counts_are_words_that_change_seldom(browser: Browser) -> None:
    ages = [
        (None, "never"), (0, "now"), (1.4, "now"), (1.6, "2 s ago"), (89, "89 s ago"), (91, "2 min ago"),
        (5399, "90 min ago"), (5401, "2 h ago"), (129_000, "36 h ago"), (130_000, "2 days ago"),
    ]  # fmt: skip
    shown(browser, "format.js", "age", *(([seconds], words) for seconds, words in ages))
    rates = [
        (None, "not stated"),
        (0, "not stated"),
        (0.5, "0.5 Hz"),
        (999, "999 Hz"),
        (1000, "1 kHz"),
        (2500, "2.5 kHz"),
    ]
    shown(browser, "format.js", "hertz", *(([rate], words) for rate, words in rates))
    shown(browser, "format.js", "count", ([1, "node"], "1 node"), ([0, "node"], "0 nodes"), ([2, "x", "y"], "2 y"))
    ranges: list[tuple[list[Any], Any]] = [
        ([{"low": 0, "high": 110, "unit": "mm"}], "0 to 110 mm"),
        ([{"low": -1, "high": None, "unit": "mm"}], "from \u22121 mm"),
        ([{"low": None, "high": 5, "unit": ""}], "up to 5"),
        ([{"low": None, "high": None, "unit": "mm"}], "not stated"),
    ]
    shown(browser, "format.js", "range", *ranges)


def test_of_many_nodes_the_first_by_name_are_named_and_one_is_not_left_over(browser: Browser) -> None:
    names = [{"name": name, "uuid": name} for name in ("finger 10", "arm", "finger 2")]
    two, one = "arm, finger 2 and 1 more", "arm, finger 2, finger 10"
    shown(browser, "format.js", "namesOf", ([names, 1], "arm and 2 more"), ([names, 2], one), ([names], one))
    assert two != one
    shown(
        browser,
        "format.js",
        "nameOf",
        ([{"name": "", "uuid": "abcdef0123"}], "node abcdef01"),
        ([None], "unknown node"),
    )


def test_a_verdict_on_an_absent_node_is_grey_and_says_when_it_was_read(browser: Browser) -> None:
    verdicts = [
        {"verdict": "authentic"},
        {"verdict": "authentic", "from": "kept"},
        {"verdict": "authentic", "unverified": True},
        {"verdict": "authentic", "present": False, "read": {"at": 1795600800}},
        {"verdict": None},
        {"verdict": None, "present": False},
    ]
    found = called(browser, "format.js", "verdict", [[of] for of in verdicts])
    assert [tone for tone, *_ in found] == ["good", "good", "warn", "plain", "plain", "plain"]
    assert "Only the Security TEDS was read now" in found[1][3]
    assert found[2][2] == "Unverified"
    assert re.fullmatch(r"Authentic on 2026-11-\d\d", found[3][2])
    assert found[3][3].endswith("The node is not connected now.")
    assert found[5][3] == found[4][3], "nothing is known of it either way"


BINS = {
    "bin": 1, "time": [0, 1, 2, 3, 8, 9], "low": [1, 2, None, 4, 5, 70], "high": [2, 3, None, 6, 5, 80],
    "segment": [0, 0, 0, 0, 0, 1], "segments": [{"id": 0, "unit": "m"}, {"id": 1, "unit": "K"}],
}  # fmt: skip


def test_the_line_of_the_past_ends_at_a_silence_at_what_is_not_valid_and_where_values_mean_something_else(
    browser: Browser,
) -> None:
    plain, cases = [BINS, 0, 10], [[10, 2], [10, 2, "m"], [2, 2, "m"], [10, 6, "m"]]
    all_units, metres, wide, patient = called(browser, "past.js", "columnsOf", [[*plain, *words] for words in cases])
    none = ["-"] * 3
    begun = [1, 2, "-", 2, 3, "-", None, None, "-", 4, 6, "-", *none * 3]
    assert metres == [*begun, "-", "-", None, 5, 5, "-", *none], "no line leads through five seconds of silence"
    assert patient == [*begun, *none, 5, 5, "-", *none]
    assert wide == [1, 6, None, 5, 5, "-"]
    assert all_units == [*metres[:26], None, 70, 80, "-"], "nor from metres to kelvins"
