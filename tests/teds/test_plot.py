"""Pictures of calibrations: that they hold what they should; how they look was judged by eye."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.teds import plot
from teds_provision.teds.calibration import Calibration, CalibrationInput, read_calibrations, residuals
from teds_provision.teds.plot import plot_blocks
from teds_provision.teds.profile import load_profile, shipped_profiles
from teds_provision.teds.units import parse_unit

pytest.importorskip("matplotlib")
pytestmark = pytest.mark.slow  # matplotlib alone is half a second
UUID = bytes(10)
ROWS = "".join(f"{raw},{raw / 65535 * 10 + 0.05 * (raw % 2)}\n" for raw in range(0, 65536, 5041))


@pytest.fixture(scope="module")
def finger():  # type: ignore[no-untyped-def]
    return load_profile("tactile-finger-sensor", [shipped_profiles()])


def test_a_curve_with_points_residuals_and_limits_is_drawn(finger, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    calibrations = read_calibrations(f"# channel: 1-2\n# date: 2026-10-31\n{ROWS}", "x.csv", finger)
    blocks = finger.build(UUID, calibration=calibrations).blocks
    svg = tmp_path / "curve.svg"
    assert plot_blocks(blocks, svg, profile=finger, calibrations=calibrations) == (1, 2)
    text = svg.read_text()
    for words in (
        "taxel 1",
        "taxel 2",
        "value [N]",
        "residuals: largest",
        "14 points",
        "limits ± uncertainty",
        "due 20",
    ):
        assert words in text
    again = tmp_path / "again.svg"
    plot_blocks(blocks, again, profile=finger, calibrations=calibrations)
    assert again.read_bytes() == svg.read_bytes()
    assert list(tmp_path.glob("*.part")) == []


def test_a_table_read_from_a_node_shows_its_nodes_and_its_bend(tmp_path: Path) -> None:
    angle = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    calibrations = read_calibrations("0,0\n30000,166\n65535,360\n", "x.csv", angle)
    svg = tmp_path / "angle.svg"
    assert plot_blocks(angle.build(UUID, calibration=calibrations).blocks, svg, channel=1) == (1,)
    text = svg.read_text()
    assert "departure from a straight line" in text
    assert "3 nodes" in text
    assert "value [°]" in text


def test_a_png_is_a_png(finger, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    calibrations = read_calibrations(f"# channel: 3\n{ROWS}", "x.csv", finger)
    png = tmp_path / "curve.PNG"
    plot_blocks(finger.build(UUID, calibration=calibrations).blocks, png)
    assert png.read_bytes().startswith(b"\x89PNG")


def test_several_inputs_and_actuators_are_drawn(finger, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    inputs = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    two = Calibration(1, "polynomial", inputs, (0.0, 1e-5, 1e-4, 0.0), unit=parse_unit("N"))
    assert plot_blocks(finger.build(UUID, calibration={1: two}).blocks, tmp_path / "two.svg") == (1,)
    gripper = load_profile("gripper", [shipped_profiles()])
    calibrations = read_calibrations("# channel: 1\n0,0\n4095,110\n", "x.csv", gripper)
    blocks = gripper.build(UUID, calibration=calibrations).blocks
    assert plot_blocks(blocks, tmp_path / "grip.svg", calibrations=calibrations) == (1,)
    assert "value [mm]" in (tmp_path / "grip.svg").read_text()


def test_what_cannot_be_drawn_is_reported(finger, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    calibrations = read_calibrations(f"# channel: 1\n{ROWS}", "x.csv", finger)
    blocks = finger.build(UUID, calibration=calibrations).blocks
    with pytest.raises(UsageError, match="picture"):
        plot_blocks(blocks, tmp_path / "x.pdf")
    with pytest.raises(BadDataError, match="channel 2"):
        plot_blocks(blocks, tmp_path / "x.png", channel=2)
    with pytest.raises(BadDataError, match="any channel"):
        plot_blocks({(0, 1): b"", (1, 5): b"\xff" * 40}, tmp_path / "x.png")
    with pytest.raises(NotFoundError, match="There is no folder"):
        plot_blocks(blocks, tmp_path / "no" / "x.png")
    erased = replace(calibrations[1], zero_offset=float("nan"))
    with pytest.raises(BadDataError):
        plot_blocks(finger.build(UUID, calibration={1: erased}).blocks, tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


def test_a_missing_extra_is_named_with_its_cure(tmp_path: Path) -> None:
    code = """
import sys
sys.modules["matplotlib"] = None
from pathlib import Path
from teds_provision.errors import TedsProvisionError
from teds_provision.teds.calibration import read_calibrations
from teds_provision.teds.plot import plot_blocks
from teds_provision.teds.profile import load_profile, shipped_profiles
angle = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
blocks = angle.build(bytes(10), calibration=read_calibrations("0,0\\n65535,360\\n", "x.csv", angle)).blocks
try:
    plot_blocks(blocks, Path("x.png"))
except TedsProvisionError as error:
    print(error.exit_code, error.message, error.hint)
"""
    output = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    ).stdout
    assert "matplotlib" in output
    assert output.startswith("1 ")
    assert f"{sys.executable} -m pip install " in output
    assert "[plot]" in output


def test_a_picture_names_the_node(tmp_path: Path) -> None:
    named = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    calibrations = read_calibrations("0,0\n65535,360\n", "x.csv", named)
    blocks = named.build(UUID, calibration=calibrations, name="crane slew angle").blocks
    plot_blocks(blocks, tmp_path / "x.svg")
    drawn = (tmp_path / "x.svg").read_text()
    assert "crane slew angle" in drawn
    assert UUID.hex() in drawn


def test_the_title_of_a_picture_is_name_and_uuid_or_the_one_that_the_node_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    titles: list[str] = []
    monkeypatch.setattr(plot, "_picture", lambda _panels, _kind, title: titles.append(title) or b"")
    angle = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    made = read_calibrations("0,0\n65535,360\n", "x.csv", angle)
    blocks = dict(angle.build(UUID, calibration=made, name="slew").blocks)
    plot_blocks(blocks, tmp_path / "x.SVG")
    del blocks[0, 12]
    plot_blocks(blocks, tmp_path / "x.svg")
    del blocks[0, 1]
    plot_blocks(blocks, tmp_path / "x.png")
    assert titles == [f"slew  {UUID.hex()}", UUID.hex(), ""]


def test_a_thinned_curve_is_drawn_from_its_first_point_to_its_last() -> None:
    mask = np.ones(10_001, dtype=bool)
    mask[:3] = False
    drawn = plot._View._thinned(cast(Any, None), mask)
    assert (drawn[0], drawn[-1]) == (3, 10_000)
    assert 1_900 < len(drawn) < 2_700


class Axes:
    """One diagram, which notes what is drawn in it."""

    def __init__(self) -> None:
        self.drawn: list[tuple[str, tuple[Any, ...], dict[str, Any]]] = []

    def __getattr__(self, name: str) -> Any:
        return lambda *values, **how: self.drawn.append((name, values, how))

    def all(self, name: str, **how: Any) -> list[tuple[Any, ...]]:
        """Return what was drawn in this way."""
        return [
            values
            for drawn, values, given in self.drawn
            if drawn == name and all(given.get(key) == value for key, value in how.items())
        ]

    def text(self, name: str) -> str:
        """Return the last text of this kind."""
        return str(self.all(name)[-1][0])


def drawn(blocks: Any, calibrations: Any = None, number: int = 0) -> tuple[Axes, Axes]:
    """Return the two diagrams of a channel: the curve, and the residuals or departures."""
    upper, lower = Axes(), Axes()
    where: Any = type("Where", (), {"subplots": lambda *_, **__: (upper, lower)})()
    plot._draw(where, plot._panels(blocks, None, None, calibrations or {})[number])
    return upper, lower


def test_each_part_of_a_picture_is_where_it_belongs(finger) -> None:  # type: ignore[no-untyped-def]
    rows = "".join(f"{raw},{raw / 6553.5 + 0.05 * (raw // 1000 % 2)}\n" for raw in (6000, 20000, 35000, 60000))
    calibrations = read_calibrations(f"# channel: 1\n# method: linear\n# date: 2026-10-31\n{rows}", "x.csv", finger)
    blocks = finger.build(UUID, calibration=calibrations).blocks
    upper, lower = drawn(blocks, calibrations)
    assert upper.text("set_title") == "channel 1: taxel 1\nlinear, 2026-10-31, due 2027-04-29"
    assert (upper.text("set_ylabel"), lower.text("set_xlabel")) == ("value [N]", "raw")
    ((inside, values),) = upper.all("plot", label="calibration")
    assert (inside.min(), inside.max()) == (pytest.approx(6000, abs=40), pytest.approx(60000, abs=40))
    assert values[-1] == pytest.approx(60000 / 6553.5, abs=0.1), "in the calibrated unit"
    beyond = [values[0] for values in upper.all("plot", linestyle=":")]
    assert [(side.min(), side.max()) for side in beyond] == [
        (0, pytest.approx(6000, abs=40)),
        (pytest.approx(60000, abs=40), 65535),
    ]
    assert len(upper.all("plot", label="extrapolated")) == 1, "named once"
    ((x, y, _),) = upper.all("plot", label="4 points")
    assert list(x) == [6000, 20000, 35000, 60000]
    assert y[0] == pytest.approx(6000 / 6553.5)
    assert [values[0] for values in upper.all("axhline")] == [pytest.approx(0.0), pytest.approx(10.0)]
    assert len(upper.all("axhline", label="limits ± uncertainty")) == 1
    assert upper.all("axhspan") == [
        (pytest.approx(-0.2), pytest.approx(0.2)),
        (pytest.approx(9.8), pytest.approx(10.2)),
    ]
    assert (lower.text("set_ylabel"), lower.all("axhline", linestyle="--")) == (
        "point - curve",
        [(pytest.approx(-0.2),), (pytest.approx(0.2),)],
    )
    caption = lower.text("set_title")
    largest, rms = map(float, re.findall(r"residuals: largest ([0-9.]+), rms ([0-9.]+);", caption)[0])
    left = residuals(calibrations[1])
    assert left is not None
    deviations = [abs(difference) for difference in left.differences]
    assert largest == pytest.approx(max(deviations), rel=1e-2)
    assert rms == pytest.approx(float(np.sqrt(np.mean(np.square(deviations)))), rel=1e-2)
    assert caption.endswith("; stated uncertainty 0.2 (dashed)")
    exact = read_calibrations("# channel: 1\n0,0\n65535,10\n", "x.csv", finger)
    _, lower = drawn(finger.build(UUID, calibration=exact).blocks, exact)
    assert lower.text("set_title").endswith("; stated uncertainty 0.2, far outside")
    assert lower.all("axhline", linestyle="--") == []
    assert lower.all("axhline") == [(0,)], "what every departure is from"


def test_without_points_the_bend_of_the_curve_is_drawn(finger) -> None:  # type: ignore[no-untyped-def]
    made = read_calibrations("# channel: 1\n# method: table\n0,0\n30000,4\n65535,10\n", "x.csv", finger)
    upper, lower = drawn(finger.build(UUID, calibration=made).blocks)
    ((x, y, _),) = upper.all("plot", label="3 nodes")
    assert (list(x), list(y)) == ([0, 30000, 65535], pytest.approx([0, 4, 10]))
    assert lower.text("set_ylabel") == "curve - line"
    assert lower.text("set_title").startswith("departure from a straight line: largest 0.")
    assert "stated uncertainty 0.2 (dashed)" in lower.text("set_title")


def test_a_picture_of_an_actuator_has_raw_numbers_over_values() -> None:
    gripper = load_profile("gripper", [shipped_profiles()])
    calibrations = read_calibrations("# channel: 1\n0,0\n2000,60\n4095,110\n", "x.csv", gripper)
    upper, lower = drawn(gripper.build(UUID, calibration=calibrations).blocks, calibrations)
    assert (upper.text("set_ylabel"), lower.text("set_xlabel")) == ("raw", "value [mm]")
    ((x, y, _),) = upper.all("plot", label="3 points")
    assert (list(x), list(y)) == ([0, 60, 110], [0, 2000, 4095])
    assert [values[0] for values in upper.all("axhline")] == [0, 4095]
    assert upper.all("axhspan") == []
    assert "uncertainty" not in lower.text("set_title")


def test_a_curve_over_the_end_of_a_turn_has_a_gap_there() -> None:
    angle = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    made = read_calibrations("# zero-offset: 90\n0,0\n65535,360\n", "x.csv", angle)
    upper, _ = drawn(angle.build(UUID, calibration=made).blocks)
    ((_, values),) = upper.all("plot", label="calibration")
    assert np.isnan(values).sum() == 1
    kept = values[~np.isnan(values)]
    assert (kept.min() >= 0, kept.max() <= 360) == (True, True)
    assert float(np.nanmax(np.abs(np.diff(kept)))) > 300


def test_a_calibration_that_cannot_be_drawn_leaves_those_of_other_channels(finger, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    """The first of two is unsound; of a chosen channel alone that one is drawn."""
    part = CalibrationInput(1, 1, (0, 4095), (0,))
    calibrations = {n: Calibration(n, "linear", (part,), (0.0, 0.25), unit=parse_unit("N")) for n in (1, 2, 3)}
    sheet = SimpleNamespace(calibrations=calibrations)
    monkeypatch.setattr(plot, "Sheet", SimpleNamespace(from_blocks=lambda _blocks: sheet))
    monkeypatch.setattr(plot, "is_sound", lambda calibration: calibration.channel != 1)
    assert [panel.name for panel in plot._panels({}, None, None, {})] == ["channel 2", "channel 3"]
    assert [panel.name for panel in plot._panels({}, 3, None, {})] == ["channel 3"]


def test_a_picture_goes_as_far_as_the_calibration_says_that_raw_values_go(finger) -> None:  # type: ignore[no-untyped-def]
    """Read from a node, whose TEDS carries the range; a profile that is given has its own."""
    made = read_calibrations("# channel: 1\n0,0\n4095,10\n", "x.csv", finger)
    made[1] = replace(made[1], raw_range=(0.0, 4095.0))
    blocks = finger.build(UUID, calibration=made).blocks
    for profile, end in ((None, 4095), (finger, 65535)):
        (panel,) = plot._panels(blocks, None, profile, {})
        assert panel.curve.axes[0][-1] == end


def test_points_and_nodes_lie_above_the_curve_and_a_range_without_samples_has_no_bend(finger) -> None:  # type: ignore[no-untyped-def]
    made = read_calibrations("# channel: 1\n# method: table\n0,0\n30000,4\n65535,10\n", "x.csv", finger)
    blocks = finger.build(UUID, calibration=made).blocks
    for given in (None, made):
        upper, _ = drawn(blocks, given)
        heights = {how["label"]: how["zorder"] for name, _, how in upper.drawn if name == "plot" and how["label"]}
        above = heights.pop("3 nodes" if given is None else "3 points")
        assert above > max(heights.values())
    between = replace(made[1], inputs=(CalibrationInput(1, 1, (10.25, 10.5, 10.75), (10.25, 10.5)),))
    _, lower = drawn(finger.build(UUID, calibration={1: between}).blocks)
    assert lower.all("plot") == lower.all("set_title") == []


def test_25_channels_do_not_fit_one_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plot, "_panels", lambda *_: [None] * 25)
    with pytest.raises(UsageError, match="25 channels do not fit one picture") as refused:
        plot_blocks({}, tmp_path / "x.svg")
    assert refused.value.hint == "Choose one with --channel."


def test_the_axis_of_a_calibration_without_a_unit_is_of_counts() -> None:
    angle = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    own = replace(angle.channels[0], unit=parse_unit("count"))
    own = replace(own, fields={**own.fields, "PhyUnits": own.unit.units})
    made = read_calibrations("0,0\n65535,9\n", "x.csv", replace(angle, channels=(own,)))
    upper, lower = drawn(replace(angle, channels=(own,)).build(UUID, calibration=made).blocks)
    assert (upper.text("set_ylabel"), lower.text("set_xlabel")) == ("value [count]", "raw")
