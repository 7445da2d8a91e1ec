"""Calibration files that grow point by point, and what a fit of points is worth."""

from __future__ import annotations

import math
from datetime import date
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, PolicyError
from teds_provision.teds.calibration import (
    evaluate,
    fit_points,
    left_out,
    load_calibrations,
    read_calibrations,
    residuals,
)
from teds_provision.teds.calibration.points import Point, points_of, with_point
from teds_provision.teds.certificate import CertificateChoice
from teds_provision.teds.profile import load_profile, shipped_profiles
from teds_provision.teds.units import parse_unit
from tests.cli.shell import spawn

DEGREE, NODE, TODAY = parse_unit("degree"), "ab" * 10, date(2026, 11, 23)


def grown(*pairs: tuple[float, float], text: str = "", channel: int = 1) -> str:
    for raw, degrees in pairs:
        point = Point(channel, raw, math.radians(degrees), 0.5, 32)
        text = with_point(text, "joint3.csv", point, node=NODE, unit=DEGREE, today=TODAY)
    return text


def test_a_file_grows_and_is_one_for_calibration() -> None:
    text = grown((0, 0), (32768, 180), (65535, 359.9))
    assert text.splitlines() == [
        f"# node: {NODE}",
        "# date: 2026-11-23",
        "channel, raw, value [degree], # spread, # count",
        "1, 0, 0, 0.5, 32",
        "1, 32768, 180, 0.5, 32",
        "1, 65535, 359.9, 0.5, 32",
    ]
    profile = load_profile("magnetic-angular-position-sensor", [shipped_profiles()])
    table = read_calibrations(text, "joint3.csv", profile)[1]
    assert table.points == ((0, 0), (32768, 180), (65535, pytest.approx(359.9)))
    assert points_of(text, "joint3.csv")[1] == {"channel": 1, "raw": 32768, "value": 180, "spread": 0.5, "count": 32}


def test_a_later_point_dates_the_file_and_is_in_its_unit() -> None:
    text = grown((0, 0)).replace("2026-11-23", "2026-10-01").replace("[degree]", "[rad]")
    more = grown((16384, 90), text=text)
    assert "# date: 2026-11-23\n" in more
    assert points_of(more, "x")[1]["value"] == pytest.approx(math.pi / 2)


def test_a_file_of_another_node_or_of_other_columns_or_units_is_left_alone() -> None:
    with pytest.raises(PolicyError, match="holds points of node cd"):
        grown((1, 1), text=grown((0, 0)).replace(NODE, "cd" * 10))
    for text in ("raw, value\n1, 2\n", "# date: 2026-01-01\n", grown((0, 0)) * 2):
        with pytest.raises(BadDataError):
            grown((1, 1), text=text)
    with pytest.raises(BadDataError, match="values in N"):
        grown((1, 1), text=grown((0, 0)).replace("[degree]", "[N]"))
    with pytest.raises(BadDataError, match="not a number"):
        grown((1, 1), text=grown((0, 0)).replace("1, 0, 0", "1, zero, 0"))


@given(st.lists(st.tuples(st.floats(0, 65535), st.floats(-360, 360)), min_size=1, max_size=8))
def test_what_was_captured_is_what_is_read(pairs: list[tuple[float, float]]) -> None:
    read = points_of(grown(*pairs), "x")
    assert [(event["raw"], event["value"]) for event in read] == [
        (pytest.approx(raw, rel=1e-7, abs=1e-30), pytest.approx(value, rel=1e-7, abs=1e-30)) for raw, value in pairs
    ]


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("op.csv", "raw,value [mm]\n0,0\n4095,110\n"),
        ("op.toml", 'unit = "mm"\npoints = [[0, 0], [4095, 110]]\n'),
    ],
)
def test_the_caller_names_the_channel_of_a_file_that_names_none(tmp_path: Path, name: str, text: str) -> None:
    """``--calibration 2=op.csv`` was refused with: say which one this is for."""
    gripper = load_profile("gripper", [shipped_profiles()])
    path = tmp_path / name
    path.write_text(text)
    found = load_calibrations(path, gripper, CertificateChoice(channel=2))
    assert found.keys() == {2}
    assert evaluate(found[2], 4095).value == pytest.approx(110), "mm"
    with pytest.raises(BadDataError, match=r"gripper has 3 channels: .* --calibration N="):
        load_calibrations(path, gripper)
    with pytest.raises(BadDataError, match="channels 1 to 3, not 9"):
        load_calibrations(path, gripper, CertificateChoice(channel=9))
    named = tmp_path / f"named-{name}"
    named.write_text("# channel: 2\n" + text if name.endswith(".csv") else "channel = 2\n" + text)
    with pytest.raises(BadDataError, match="holds no calibration of channel 3"):
        load_calibrations(named, gripper, CertificateChoice(channel=3))
    for_all = tmp_path / f"all-{name}"
    for_all.write_text("# channel: all\n" + text if name.endswith(".csv") else 'channel = "all"\n' + text)
    assert load_calibrations(for_all, gripper, CertificateChoice(channel=2)).keys() == {2}, "3 is in N, and not meant"
    with pytest.raises(BadDataError, match="not of the same kind"):
        load_calibrations(for_all, gripper)


def test_residuals_of_a_known_line() -> None:
    """Points 0, 1, 5 at 0, 1, 2: least squares gives -0.5 + 2.5 x, so residuals 0.5, -1, 0.5 and rms √0.5."""
    found = fit_points("# unit: N\nraw,value\n0,0\n1,1\n2,5\n", "x.csv", method="linear")[1]
    left = residuals(found)
    assert left is not None
    assert left.differences == pytest.approx((0.5, -1, 0.5), abs=1e-6)
    assert left.rms == pytest.approx(math.sqrt(0.5), abs=1e-6)
    assert found.unit.text == "N"
    assert left_out(found) == pytest.approx((1 - 2.5,), abs=1e-6), "the line through its neighbours gives 2.5"


def test_a_table_has_no_residuals_and_points_that_are_left_out_show_its_worth() -> None:
    found = fit_points("raw,value\n" + "".join(f"{x},{x * x}\n" for x in range(5)), "x.csv")[1]
    left = residuals(found)
    assert left is not None
    assert (found.method, left.maximum) == ("table", 0)
    assert left_out(found) == pytest.approx((-1, -1, -1), abs=1e-6)


def test_the_file_says_the_method_and_the_caller_goes_before() -> None:
    text = "# method: polynomial\n# degree: 2\nraw,value\n" + "".join(f"{x},{x * x}\n" for x in range(5))
    assert fit_points(text, "x.csv")[1].inputs[0].degree == 2
    assert fit_points(text, "x.csv", method="linear")[1].method == "linear"
    assert fit_points(text, "x.csv", degree=3)[1].inputs[0].degree == 3


@given(st.floats(-5, 5), st.floats(-5, 5), st.floats(-5, 5), st.lists(st.integers(0, 60), min_size=4, unique=True))
def test_a_polynomial_of_its_own_degree_meets_every_point(a: float, b: float, c: float, xs: list[int]) -> None:
    rows = "".join(f"{x},{a + b * x + c * x * x!r}\n" for x in xs)
    found = fit_points("raw,value\n" + rows, "x.csv", method="polynomial", degree=2)[1]
    left = residuals(found)
    assert left is not None
    assert left.maximum <= 1e-4 * (1 + max(abs(value) for _, value in found.points))
    assert evaluate(found, float(xs[0])).value == pytest.approx(found.points[0][1], rel=1e-4, abs=2e-1)


def test_segments_have_no_points() -> None:
    with pytest.raises(BadDataError, match="no points"):
        fit_points("from,to,offset,c0,c1\n0,10,0,1,2\n", "x.csv")


@pytest.mark.parametrize(
    ("remarks", "spread", "count"),
    [
        ("", None, None),
        (", 0.5", 0.5, None),
        (", 0.5, 32", 0.5, 32),
        (", me, 32", None, 32),
        (", inf, nan", None, None),
        (", 0.5, 32, x", 0.5, 32),
    ],
)
def test_spread_and_count_of_a_point_are_given_if_they_are_numbers(
    remarks: str, spread: float | None, count: int | None
) -> None:
    columns = ", #" * remarks.count(",")
    (point,) = points_of(f"channel, raw, value [degree]{columns}\n2, 7, 90{remarks}\n", "x.csv")
    assert point == {"channel": 2, "raw": 7.0, "value": 90.0, "spread": spread, "count": count}


def test_remarks_are_no_values(tmp_path: Path) -> None:
    text = "raw, # who, value [N], #\n0, me, 1\n5, you, 2, x\n"
    assert fit_points(text, "x.csv")[1].points == ((0, 1), (5, 2))
    with pytest.raises(BadDataError, match="columns"):
        fit_points("raw, value, # a\n0, 1, 2, 3\n", "x.csv")
    file = tmp_path / "x.csv"
    file.write_text(text)
    report = spawn("--json", "calibrate", "fit", file, "--method", "linear").json
    assert (report["method"], report["rms"], report["unit"]) == ("linear", pytest.approx(0, abs=1e-6), "N")
    assert [row["raw"] for row in report["residuals"]] == [0, 5]
