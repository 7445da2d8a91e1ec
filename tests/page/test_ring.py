"""The points that the page keeps and draws, in the browser's own JavaScript."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pytest

import teds_provision

if TYPE_CHECKING:
    from playwright.sync_api import Browser

pytestmark = pytest.mark.system

RING = Path(teds_provision.__file__).parent / "ncap/page/js/ring.js"
BINS = """async ([source, points, silence]) => {
  const { Ring } = await import("data:text/javascript," + encodeURIComponent(source));
  const ring = new Ring();
  points.forEach(([time, value]) => ring.push(time, value ?? NaN));
  return ring.bins(0, 40, 4, silence).map((one) => (one === undefined ? "nothing" : one));
}"""

RESTLESS = """async ([source, course]) => {
  const { restless } = await import("data:text/javascript," + encodeURIComponent(source));
  return restless(course);
}"""


@pytest.mark.parametrize(
    ("course", "restless"),
    [
        ([number % 100 for number in range(2000)], False),  # twenty turns of a shaft
        ([5] * 900, False),
        ([None] * 900, False),
        ([], False),
        ([3 if number % 2 else 7 for number in range(50)], False),
        ([[3, 7, None][number % 3] for number in range(900)], True),
    ],
)
def test_a_curve_that_fills_the_plot_gets_no_dash(browser: Browser, course: list[float | None], restless: bool) -> None:
    """Nobody would see it, and a browser without a GPU took seconds to paint it."""
    page = browser.new_page()
    try:
        assert page.evaluate(RESTLESS, [RING.read_text(), course]) is restless
    finally:
        page.close()


@pytest.mark.parametrize(
    ("points", "silence", "bins"),
    [
        ([[0, 350], [4, 355], [12, 357], [30, 350]], 100, [350, 355, "-", 357, 357, "-", "-", "-", "-", 350, 350, "-"]),
        ([[0, 1], [30, 2]], 5, [1, 1, "-", "-", "-", "-", "-", "-", None, 2, 2, "-"]),
        # An angle that wraps within a bin, between two, and twice within one: no line from 359 down to 1.
        (
            [[0, 340], [5, 355], [6, None], [7, 2], [8, 5], [12, 6]],
            100,
            [340, 355, None, 6, 6, "-", "-", "-", "-", "-", "-", "-"],
        ),
        ([[9, 355], [10, None], [11, 2]], 100, [355, 355, None, 2, 2, "-", "-", "-", "-", "-", "-", "-"]),
        (
            [[9, 300], [11, 355], [12, None], [13, 2], [15, 350], [16, None], [17, 4], [21, 9]],
            100,
            [300, 300, None, 2, 350, None, 9, 9, "-", "-", "-", "-"],
        ),
        ([[0, 1], [12, None], [30, 2]], 100, [1, 1, "-", None, None, "-", "-", "-", "-", 2, 2, "-"]),
    ],
)
def test_a_line_is_drawn_only_through_points_that_belong_together(
    browser: Browser, points: list[list[float | None]], silence: float, bins: list[float | str | None]
) -> None:
    page = browser.new_page()
    try:
        found = page.evaluate(BINS, [RING.read_text(), points, silence])
    finally:
        page.close()
    assert [("-" if item == "nothing" else item) for item in found] == bins
