"""The plot: axes, marks, the moment under the pointer, a selected span, and the drawing rate."""

from __future__ import annotations

from typing import Any

import pytest

from .stage import ARM, NOW, Stage
from .test_forms import text, texts
from .test_modules import bins

pytestmark = pytest.mark.system
NONE = None
PAST = f"GET nodes/{ARM}/past"
SHOW = """
  const plotted = new plot.LivePlot(words);
  window.plot = show(plotted);
  window.chart = (at = 0) => plotted.frames[at].chart;
  document.getElementById("main").append(plotted.element);
  await new Promise((seen) => new ResizeObserver(seen).observe(plotted.charts));
"""


def channels(*units: str) -> list[dict[str, Any]]:
    return [{"uuid": ARM, "number": number, "label": f"n {number}", "unit": unit, "uncertainty": 0.1}
            for number, unit in enumerate(units, 1)]  # fmt: skip


def drawn(stage: Stage, *units: str) -> float:
    """Draw channels of these units, whose last minute is known; return the time of the station's clock."""
    now = float(stage.run("return hub.now()"))
    lost = [0] * 20 + [9] + [0] * 36 + [3, 2]
    stage.answers(**{PAST: bins(*(now - 60 + second for second in range(59)), lost=lost, invalid=[0] * 56 + [4, 0, 1])})
    stage.run(SHOW, *channels(*units))
    stage.pass_time(400)
    stage.sent  # noqa: B018
    return now


def test_axes_have_clock_times_and_short_numbers_and_room_around_a_curve(stage: Stage) -> None:
    drawn(stage, "mm")
    axes = """
      const [x, y] = chart().axes;
      return [x.values(chart(), [null, 0, 45296]), y.values(chart(), [null, -0.5, 1234567, 0.1 + 0.2])];
    """
    assert stage.run("const chart = window.chart;" + axes) == [
        ["", "00:00:00", "12:34:56"], ["", "\u22120.5", "1234570", "0.3"],
    ]  # fmt: skip
    room: list[tuple[list[Any], list[float]]] = [
        ([NONE, NONE], [0, 1]), ([0, 100], [-8, 108]), ([5, 5], [4.75, 5.25]), ([-2, -2], [-2.1, -1.9]),
        ([0, 0], [-1, 1]), ([-10, 10], [-11.6, 11.6]),
    ]  # fmt: skip
    found = stage.run("return words.map((one) => window.chart().scales.y.range(window.chart(), ...one))",
                      *(ends for ends, _ in room))  # fmt: skip
    for (ends, wanted), got in zip(room, found, strict=True):
        assert got == pytest.approx(wanted), ends


def test_each_curve_has_a_colour_and_the_ninth_a_dash_and_frames_share_the_height(stage: Stage) -> None:
    drawn(stage, *["mm"] * 9)
    style = """
      const colour = (at) => getComputedStyle(document.documentElement).getPropertyValue(`--line-${at}`).trim();
      const known = Array.from({ length: 8 }, (_, at) => colour(at + 1));
      const lines = window.chart().series.slice(1);
      const swatches = [...document.querySelectorAll(".swatch")];
      return [lines.map((one) => known.indexOf(one.stroke()) + 1), lines.map((one) => one.dash ?? []),
        swatches.map((one) => one.classList[1]), swatches.map((one) => one.firstChild.getAttribute("stroke-dasharray")),
        lines.every((one) => one.points.show(window.chart(), 1) === false && one.width === 1),
        swatches.every((one) => one.firstChild.getAttribute("d") && one.getAttribute("aria-hidden") === "true")];
    """
    colours, dashes, classes, drawn_dashes, bare, whole = stage.run(style)
    assert colours == [1, 2, 3, 4, 5, 6, 7, 8, 1]
    assert dashes == [[]] * 8 + [[7, 3]]
    assert classes == [f"line-{number}" for number in (1, 2, 3, 4, 5, 6, 7, 8, 1)]
    assert drawn_dashes == [""] * 8 + ["7 3"]
    assert (bare, whole) == (True, True)
    for units, height in ((["mm"], 320), (["mm", "N"], 220), (["mm", "N", "V"], 160)):
        stage.run("window.plot.show(words)", *channels(*units))
        assert stage.run("return window.plot.frames.map((one) => one.chart.height)") == [height] * len(units)
    assert texts(stage, ".charts .unit") == ["mm", "N", "V"]
    stage.run("window.plot.show(words)", *channels(""))
    assert (texts(stage, ".charts .unit"), stage.run("return window.plot.frames.length")) == (["no unit"], 1)
    wide = "const box = document.querySelector('.canvas').clientWidth; return [box > 99, window.chart().width === box]"
    assert stage.run(wide) == [True, True]


def test_only_another_list_of_channels_is_drawn_anew(stage: Stage) -> None:
    drawn(stage, "mm", "N")
    same = "const before = window.plot.frames; window.plot.show(words); return window.plot.frames === before"
    both = channels("mm", "N")
    assert stage.run(same, *both)
    for more in ({"label": "x"}, {"uuid": "b2"}, {"number": 9}, {"unit": "V"}):
        assert not stage.run(same, both[0] | more, both[1]), more
        stage.run("window.plot.show(words)", *both)
    assert not stage.run(same, both[0])


def test_seconds_with_lost_samples_are_marked_red_and_invalid_ones_orange(stage: Stage) -> None:
    now = drawn(stage, "mm")
    marks = """
      const chart = window.chart(), { ctx, bbox } = chart, found = [];
      const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
      const names = ["--bad", "--warn"];
      const filled = (name) => { ctx.fillStyle = colour(name); return ctx.fillStyle; };
      const known = names.map(filled);
      ctx.fillRect = (...one) => found.push([names[known.indexOf(ctx.fillStyle)], one]);
      window.plot.frames[0].marks = [[window.plot.hour(window.plot.channels[0]).bins, words[0] - 30, words[0]]];
      chart.redraw();
      await null;
      const { left, width, top, height } = bbox;
      delete ctx.fillRect;
      const size = devicePixelRatio;
      return found.filter(([name]) => name).map(([name, [x, y, wide, high]]) =>
        [name, 30 - (x - left) / width * 30, wide / width * 30, (top + height - y) / size, high / size]);
    """
    # a second ago nothing is known; lost samples weigh more than invalid ones; what is 40 s old is not in the window
    found = stage.run(marks, now)
    assert [name for name, *_ in found] == ["--bad", "--bad", "--warn"]
    assert [back for _, back, *_ in found] == pytest.approx([2, 3, 4])
    assert [numbers for _, _, *numbers in found] == [pytest.approx([1, 5, 5])] * 3
    narrow = marks.replace("words[0] - 30, words[0]", "words[0] - 3.5, words[0] - 2.5")
    found = stage.run(narrow.replace("30", "1"), now - 0)
    assert [(name, back, wide) for name, back, wide, *_ in found] == [
        ("--bad", pytest.approx(0.5), pytest.approx(1)), ("--warn", pytest.approx(1), pytest.approx(1)),
    ], "one that began before the edge begins at the edge, what comes after the other edge is left out"  # fmt: skip


POINT = """
  const chart = window.chart();
  const at = (time) => chart.valToPos(time, "x");
  chart.setCursor({ left: at(words[0]), top: 10 });
"""


def moment(stage: Stage, time: float) -> list[str]:
    """Point at a time of the first frame; return the moment and the value that are shown."""
    stage.run(POINT, time)
    stage.pass_time(300)
    return [text(stage, ".when"), *texts(stage, ".legend .figure")]


def test_the_moment_under_the_pointer_has_its_time_and_what_was_measured_then(stage: Stage) -> None:
    drawn(stage, "mm")
    stage.run("window.plot.pause(true); window.plot.paused = words[0]", NOW + 58)
    stage.pass_time(100)
    times = [NOW + 40, NOW + 40.001, NOW + 45, NOW + 50, NOW + 50.001]
    message = {"type": "values", "channels": {f"{ARM}/1": [times, [5, 7, 3.25, NONE, NONE]]}}
    stage.run("hub.take(words[0])", message)
    stage.pass_time(100)
    columns = stage.run("return window.chart().data[0].length / 3")
    width = 30 / columns
    for time, words in ((40, "5.00 to 7.00"), (45, "3.25"), (50, "not valid"), (35, "nothing")):
        when, value = moment(stage, NOW + time + width / 2)
        assert value == words, time
        # the column's left edge, which is a multiple of its width
        assert (when[:6], abs(float(when[9:]) - time) <= 1.01 * width) == ("at 10:", True), when
    stage.run("window.chart().setCursor({ left: -10, top: -10 })")
    stage.pass_time(300)
    assert (text(stage, ".when"), text(stage, ".legend .figure")) == ("", "not valid")


@pytest.mark.parametrize(
    ("period", "silence", "gap"), [(0.1, 0.45, False), (0.1, 0.6, True), (2, 5.9, False), (2, 6.5, True)]
)
def test_a_live_curve_has_a_gap_where_three_values_and_half_a_second_are_missing(
    stage: Stage, period: float, silence: float, gap: bool
) -> None:
    drawn(stage, "mm")
    stage.run("state.rings.clear(); window.plot.pause(true); window.plot.paused = words[0]", NOW + 58)
    times = [NOW + 35 + number * period for number in range(5)]
    for some in (times, [times[-1] + silence, times[-1] + silence + period]):
        stage.run("hub.take(words[0])", {"type": "values", "channels": {f"{ARM}/1": [some, [5] * len(some)]}})
    stage.run("state.values.get(words[0]).period = words[1]", f"{ARM}/1", period)
    stage.pass_time(100)
    assert stage.run("return window.chart().data[1].includes(null)") is gap


@pytest.mark.parametrize(("span", "digits"), [(10, 3), (30, 3), (117, 1), (600, 1), (3600, 0)])
def test_the_moment_has_as_many_digits_as_its_column_is_wide(stage: Stage, span: int, digits: int) -> None:
    """59.98 s with one digit was 59.0 s, a second too early."""
    drawn(stage, "mm")
    stage.run("window.plot.range = words", NOW + 60 - span, NOW + 60)
    stage.pass_time(100)
    width = span / stage.run("return window.chart().data[0].length / 3")
    first = (NOW + 60 - span) // width + 3
    late = sorted(range(60), key=lambda place: -((first + place) * width % 1))[:3]  # just before a whole second
    for place in (*late, 7):
        left = (first + place) * width
        when = moment(stage, left + width / 2)[0]
        assert len(when.partition(".")[2]) == digits
        hours, minutes, seconds = map(float, when[3:].split(":"))
        shown = (hours * 60 + minutes) * 60 + seconds
        assert abs(shown - left % 86_400) < (0.51 / 10**digits if digits else 1), (when, left)


def test_a_stretch_that_was_chosen_with_the_mouse_is_drawn_from_its_own_bins(stage: Stage) -> None:
    now = drawn(stage, "mm")
    select = """
      const chart = window.chart();
      chart.setSelect({ left: words[0], top: 0, width: words[1], height: 9 });
      return [window.plot.range, chart.select.width, chart.bbox.width / devicePixelRatio];
    """
    assert stage.run(select, 50, 7.9)[0] is NONE, "that was a click"
    stage.sent  # noqa: B018
    stage.answers(**{PAST: bins(now - 25, now - 20, low=[1, 2], high=[1, 2])})
    (left, right), selected, width = stage.run(select, 50, 100)
    assert selected == 0, "the selection is gone"
    assert right - left == pytest.approx(100 / width * 30, rel=0.01)
    assert (now + 0.4 - 0.25 - 30) + 50 / width * 30 == pytest.approx(left, abs=0.2)
    assert [entry["path"] for entry in stage.sent] == [
        f"nodes/{ARM}/past?channel=1&from={left:.3f}&until={right:.3f}&points=900"
    ]
    back = stage.run("window.plot.zoom(words)", now - 30, now - 15)
    stage.pass_time(100)
    ends = "const { min, max } = window.chart().scales.x; return [min, max]"
    assert stage.run(ends) == pytest.approx([now - 30, now - 15])
    assert stage.run("return [...new Set(window.chart().data[1].filter((one) => typeof one === 'number'))]") == [1, 2]
    stage.page.get_by_role("img", name="Plot of n 1 in mm").dblclick()
    assert (back, stage.run("return window.plot.range")) == (NONE, NONE)
    stage.pass_time(100)
    low, high = stage.run(ends)
    assert high - low == pytest.approx(30)


def test_more_than_two_minutes_are_drawn_from_the_stations_hour(stage: Stage) -> None:
    now = drawn(stage, "mm")
    numbers = "return window.chart().data[1].filter((one) => typeof one === 'number').length"
    stage.run("state.rings.clear()")
    stage.pass_time(100)
    assert stage.run(numbers) == 0, "two minutes are what this page received"
    stage.run("window.plot.span(600)")
    stage.pass_time(100)
    assert stage.run(numbers) > 50
    stage.run("window.plot.span(120)")
    stage.pass_time(100)
    assert stage.run(numbers) == 0
    assert now > 0


def test_it_draws_at_most_twenty_times_a_second_and_less_often_if_that_takes_long(stage: Stage) -> None:
    drawn(stage, "mm")
    stage.run("window.plot.ended = true; Object.assign(window.plot, { next: 0, drawn: 0, skipped: 0, began: 0 })")
    draw = "window.plot[words[0]](words[1]); return [window.plot.drawn, window.plot.skipped, window.plot.next]"
    for what, time, wanted in (
        ("draw", 1000, [1, 0, 1042]), ("draw", 1041, [1, 0, 1042]), ("draw", 1042, [2, 0, 1084]),
        ("draw", 1300, [3, 4, 1342]), ("painted", 1317, [3, 4, 1342]), ("draw", 1342, [4, 4, 1384]),
        ("painted", 1342 + 17 + 70, [4, 4, 1542]), ("painted", 9000, [4, 4, 1542]), ("draw", 1541, [4, 4, 1542]),
    ):  # fmt: skip
        assert stage.run(draw, what, time) == pytest.approx(wanted), (what, time)
    hidden = "Object.defineProperty(document, 'hidden', { configurable: true, get: () => true }); window.plot.ask();"
    try:
        stage.sent  # noqa: B018
        assert stage.run(hidden + draw, "draw", 99_000)[0] == 4, "nobody sees it"
        assert stage.sent == []
    finally:
        stage.run("delete document.hidden")


def test_a_curve_of_a_calibration_has_its_units_and_dots_while_there_are_few(stage: Stage) -> None:
    script = """
      const real = window.uPlot, made = [];
      window.uPlot = class extends real { constructor(...all) { super(...all); made.push([this, all]); } };
      try {
        for (const many of [59, 60]) {
          const points = Array.from({ length: many }, (_, at) => [at, many - at]);
          const canvas = plot.curvePlot("Calibration of n", "counts", "mm", points);
          document.getElementById("main").append(canvas);
          await new Promise((seen) => new ResizeObserver(seen).observe(canvas));
        }
      } finally { window.uPlot = real; }
      return made.map(([chart, [setting, [xs, ys]]]) => [
        setting.axes.map((one) => one.label), setting.series[1].points.show, setting.height,
        setting.width === document.querySelector(".canvas").clientWidth, xs.slice(0, 2), ys.slice(0, 2),
        setting.scales.x.time, chart.axes[0].values(chart, [-1, 2]), setting.axes.map((one) => one.labelSize)]);
    """
    found = stage.run(script)
    assert found[:1] + found[-1:] == [
        [["counts", "mm"], dots, 240, True, [0, 1], [many, many - 1], False, ["\u22121", "2"], [18, 18]]
        for many, dots in ((59, True), (60, False))
    ]
    assert stage.page.locator(".canvas[role=img][aria-label='Calibration of n']").count() == 2
