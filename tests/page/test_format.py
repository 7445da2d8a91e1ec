"""How the page shows numbers, in the browser's own JavaScript."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import teds_provision

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system

SOURCE = (Path(teds_provision.__file__).parent / "ncap/page/js/format.js").read_text()
NUMBERS = """async ([source, cases]) => {
  const { number } = await import("data:text/javascript," + encodeURIComponent(source));
  return cases.map(([value, uncertainty, turn]) => number(value, uncertainty, turn));
}"""


def test_an_angle_that_rounds_to_the_end_of_its_turn_is_its_beginning(browser: Browser) -> None:
    whole, half = {"low": 0, "size": 360}, {"low": -180, "size": 360}
    cases = [
        ([359.9999, 1, whole], "0.0"),
        ([359.94, 1, whole], "359.9"),
        ([0, 1, whole], "0.0"),
        ([179.97, 1, half], "\u2212180.0"),
        ([-179.97, 1, half], "\u2212180.0"),
        ([359.9999, 1, None], "360.0"),
        ([6.28318529, None, {"low": 0, "size": 6.283185307179586}], "0.0000"),
    ]
    page = browser.new_page()
    try:
        assert page.evaluate(NUMBERS, [SOURCE, [case for case, _ in cases]]) == [shown for _, shown in cases]
    finally:
        page.close()


READINGS = """async ([source, cases]) => {
  const { reading } = await import("data:text/javascript," + encodeURIComponent(source));
  return cases.map(([value, channel]) => reading(value, channel));
}"""


def test_what_rounding_leaves_of_0_is_0_and_a_small_value_stays(browser: Browser) -> None:
    turn = {"low": 0, "high": 360, "uncertainty": None, "turn": None}
    celsius = {"low": None, "high": None, "uncertainty": None, "turn": None, "scale": {"factor": 1, "offset": -273.15}}
    bare = {"low": None, "high": None, "uncertainty": None, "turn": None}
    cases = [
        ([2.4e-14, turn], "0"),
        ([-5.7e-14, celsius], "0"),
        ([2.4e-14, bare], "2.4000e\u221214"),
        ([2e-6, {**turn, "high": 1e-5}], "2.0000e\u22126"),
        ([12.5, turn], "12.500"),
    ]
    page = browser.new_page()
    try:
        assert page.evaluate(READINGS, [SOURCE, [case for case, _ in cases]]) == [shown for _, shown in cases]
    finally:
        page.close()


NAMES = """async ([source, many]) => {
  const { namesOf } = await import("data:text/javascript," + encodeURIComponent(source));
  return namesOf(Array.from({ length: many }, (_, index) => ({ uuid: `${index}`, name: `joint ${many - index}` })));
}"""


def test_many_names_are_in_order_and_the_rest_is_counted(browser: Browser) -> None:
    page = browser.new_page()
    try:
        assert page.evaluate(NAMES, [SOURCE, 3]) == "joint 1, joint 2, joint 3"
        assert page.evaluate(NAMES, [SOURCE, 9]).endswith("joint 8, joint 9"), "one more takes no more room"
        assert page.evaluate(NAMES, [SOURCE, 100]).endswith("joint 7, joint 8 and 92 more")
    finally:
        page.close()
