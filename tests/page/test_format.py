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
