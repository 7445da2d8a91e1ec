"""Calibration: published check values, fits, files, and the way through the TEDS."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.teds.calibration import (
    METHODS,
    Calibration,
    CalibrationInput,
    PreparedCurve,
    PreparedInverse,
    Residuals,
    describe_calibration,
    evaluate,
    fit,
    from_decoded,
    left_out,
    load_calibrations,
    read_calibrations,
    residuals,
    sentence,
)
from teds_provision.teds.calibration import formula as formulas
from teds_provision.teds.calibration.formula import kind_of
from teds_provision.teds.profile import Profile, load_profile
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.units import parse_unit


@pytest.fixture(scope="module")
def magnetic() -> Profile:
    return load_profile("magnetic-angular-position-sensor")


@pytest.fixture(scope="module")
def tactile() -> Profile:
    return load_profile("tactile-finger-sensor")


SPLINE = Calibration(
    1,
    "table",
    (CalibrationInput(1, 1, (0, 512, 1024), (0, 512)),),
    (233.15, 0.1, 284.35, 0.12),
)
TWO_INPUTS = Calibration(
    1,
    "polynomial",
    (CalibrationInput(1, 1, (0, 200), (50,)), CalibrationInput(2, 1, (0, 40), (25,))),
    (10, -0.01, 0.5, 0.002),
)


def value(calibration: Calibration, *inputs: float) -> float:
    return evaluate(calibration, *inputs).value


def residuals_of(calibration: Calibration) -> Residuals:
    left = residuals(calibration)
    assert left is not None
    return left


def test_the_published_check_value_of_one_input() -> None:
    assert value(SPLINE, 700) == pytest.approx(306.91, abs=1e-4)


def test_the_published_check_value_of_two_inputs() -> None:
    assert value(TWO_INPUTS, 100, 20) == pytest.approx(34.55, abs=1e-5)


def test_a_value_on_a_boundary_belongs_to_the_upper_segment() -> None:
    steps = Calibration(1, "steps", (CalibrationInput(1, 0, (0, 10, 20), (0, 10)),), (1.0, 2.0))
    assert [value(steps, x) for x in (0, 9.999, 10, 19, 20)] == [1, 1, 2, 2, 2]


def test_outside_the_outer_boundaries_the_end_segment_holds_and_is_flagged() -> None:
    result = evaluate(SPLINE, np.array([-10.0, 0.0, 1024.0, 1034.0, math.nan]))
    assert result.value[:4] == pytest.approx([232.15, 233.15, 345.79, 346.99], abs=1e-3)
    assert result.outside.tolist() == [1, 0, 0, 1, 1]
    assert evaluate(SPLINE, 2000.0).outside == 1.0


@pytest.mark.parametrize(
    ("inputs", "outside"),
    [
        ((100, 20), 0.0),
        ((0, 0), 0.0),
        ((200, 40), 0.0),
        ((201, 20), 1.0),
        ((-1, 20), 1.0),
        ((100, 41), 1.0),
        ((100, -1), 1.0),
        ((math.nan, 20), 1.0),
        ((100, math.nan), 1.0),
    ],
)
def test_each_input_is_held_to_its_own_outer_boundaries(inputs: tuple[float, float], outside: float) -> None:
    assert evaluate(TWO_INPUTS, *inputs).outside == outside


def test_arrays_and_scalars_give_the_same() -> None:
    x = np.random.default_rng(7).uniform(-50, 250, 50)
    grid = evaluate(TWO_INPUTS, x[:, None], np.linspace(-10, 50, 7)[None, :])
    assert grid.value.shape == (50, 7)
    assert grid.value[3, 2] == pytest.approx(value(TWO_INPUTS, float(x[3]), 10.0))


def test_cells_are_ordered_with_the_last_input_fastest() -> None:
    inputs = (CalibrationInput(1, 0, (0, 1, 2), (0, 0)), CalibrationInput(2, 0, (0, 1, 2, 3), (0, 0, 0)))
    grid = Calibration(1, "steps", inputs, (0, 1, 2, 10, 11, 12))
    assert [value(grid, 0.5, y) for y in (0.5, 1.5, 2.5)] == [0, 1, 2]
    assert [value(grid, 1.5, y) for y in (0.5, 1.5, 2.5)] == [10, 11, 12]


@pytest.mark.parametrize(
    ("inputs", "coefficients"),
    [
        ((), (1.0,)),
        ((CalibrationInput(1, 1, (0, 1), (0,)),), (1.0,)),
        ((CalibrationInput(1, 1, (0, 1), (0,)),), (1.0, 1e40)),
    ],
)
def test_what_does_not_fit_together_is_refused(
    inputs: tuple[CalibrationInput, ...], coefficients: tuple[float, ...]
) -> None:
    with pytest.raises(BadDataError):
        Calibration(1, "linear", inputs, coefficients)
    with pytest.raises(BadDataError):
        CalibrationInput(1, 1, (0.0, 1.0), (0.0, 1.0))


@pytest.mark.parametrize("name", ["zero_offset", "low_limit", "high_limit", "uncertainty"])
def test_each_number_of_a_calibration_is_a_float32(name: str) -> None:
    assert getattr(replace(SPLINE, **{name: 0.1}), name) == 0.10000000149011612  # type: ignore[arg-type]
    with pytest.raises(BadDataError) as refused:
        replace(SPLINE, **{name: 1e39})  # type: ignore[arg-type]
    assert refused.value.message == f"{name} of the calibration hold a number that does not fit a Float32."


# --- fits


@pytest.mark.parametrize("degree", [-1, 256])
def test_the_degree_of_an_input_is_an_octet(degree: int) -> None:
    with pytest.raises(BadDataError) as refused:
        CalibrationInput(1, degree, (0.0, 1.0), (0.0,))
    assert refused.value.message == f"The degree of a calibration input goes from 0 to 255, not {degree}."
    assert [CalibrationInput(1, just, (0.0, 1.0), (0.0,)).degree for just in (0, 255)] == [0, 255]


@pytest.mark.parametrize("ends", [(0, math.inf), (-math.inf, 1), (math.nan, 1), (0, math.nan), (1, 1), (2, 1)], ids=str)
def test_a_curve_is_inverted_between_two_finite_ends_in_order(ends: tuple[float, float]) -> None:
    with pytest.raises(BadDataError, match=r"^A calibration is only inverted between two finite ends\.$"):
        PreparedInverse(PreparedCurve(SPLINE), *ends)


@pytest.mark.parametrize("given", [0, 2])
def test_a_curve_takes_one_value_for_each_input(given: int) -> None:
    with pytest.raises(BadDataError) as refused:
        evaluate(SPLINE, *([1.0] * given))
    assert refused.value.message == f"The calibration of channel 1 takes 1 inputs, not {given}."


def test_points_are_left_out_of_a_fit_of_at_most_200_of_them() -> None:
    for points, kept in ((3, 1), (200, 198), (201, 0)):
        line = fit([(float(raw), 2.0 * raw) for raw in range(points)], "linear", channel=1)
        assert left_out(line) == pytest.approx([0.0] * kept, abs=1e-3), points


def test_a_table_of_which_a_point_cannot_be_left_out_has_no_such_differences() -> None:
    """Without one of three points, two are left: too few for a polynomial of degree 2."""
    three = fit([(0, 0), (1, 2), (2, 8)], "polynomial", channel=1)
    assert three.inputs[0].degree == 2
    assert left_out(three) == ()
    assert left_out(fit([(0, 0), (1, 3), (2, 8)], "linear", channel=1)) == pytest.approx((-1.0,))
    assert left_out(fit([(0, 0), (2, 8)], "linear", channel=1)) == ()


def test_a_date_before_1970_and_a_length_of_time_in_whole_seconds() -> None:
    octets = teds.compose(5, [*SPLINE.fields(), ("LstCalDt", teds.TimeInstance(5, 0, True))])
    assert from_decoded(teds.decode(octets), channel=1).date == datetime(1969, 12, 31, 23, 59, 55, tzinfo=UTC)
    for interval, seconds in ((86399.6, 86400), (86400.4, 86400), (0.5, 0)):
        assert dict(replace(SPLINE, interval=interval).fields())["CalInrvl"] == teds.TimeInstance(seconds), interval


def test_a_due_date_beyond_the_calendar_is_none() -> None:
    late = replace(SPLINE, date=datetime(9999, 12, 1, tzinfo=UTC), interval=31 * 86400.0)
    assert (late.due, late.overdue(datetime(9999, 12, 31, tzinfo=UTC))) == (None, False)
    assert replace(late, interval=30 * 86400.0).due == datetime(9999, 12, 31, tzinfo=UTC)


def test_a_date_beyond_the_calendar_in_a_teds_is_none() -> None:
    """The 2024 edition has 48 bits of seconds; the last second of the year 9999 is 253402300799."""
    for seconds, year in ((253402300799, 9999), (253402300800, None)):
        moment = teds.TimeInstance(seconds, 0, False)
        octets = teds.compose(5, [*SPLINE.fields(2024), ("LstCalDt", moment)], edition=2024)
        found = from_decoded(teds.decode(octets), channel=1)
        assert (found.date and found.date.year) == year


def test_a_line_through_exact_points_is_found() -> None:
    line = fit([(0, 1.0), (100, 51.0), (200, 101.0)], "linear", channel=1)
    assert line.coefficients == (1.0, 0.5)
    residuals = residuals_of(line)
    assert residuals is not None
    assert residuals.maximum < 1e-5


def test_the_residuals_of_a_line_are_shown() -> None:
    residuals = residuals_of(fit([(0, 0.0), (1, 1.0), (2, 0.0)], "linear", channel=1))
    assert residuals is not None
    assert residuals.maximum == pytest.approx(2 / 3)
    assert residuals.rms == pytest.approx(math.sqrt(2) / 3)
    assert residuals.worst[0] == 1


def test_a_zero_that_was_set_since_is_no_residual() -> None:
    line = replace(fit([(0, 0.0), (1, 1.0), (2, 0.0)], "linear", channel=1), zero_offset=5.0)
    assert residuals_of(line).curve == pytest.approx((1 / 3, 1 / 3, 1 / 3))
    assert residuals_of(line).differences == pytest.approx((-1 / 3, 2 / 3, -1 / 3))


def test_a_polynomial_survives_rounding_to_float32_over_16_bit_raw() -> None:
    raw = np.linspace(0, 65535, 40)
    value = 10 * (raw / 65535) ** 3 - 4 * (raw / 65535) ** 2 + raw / 65535
    cubic = fit(list(zip(raw.tolist(), value.tolist(), strict=True)), "polynomial", channel=1, degree=3)
    residuals = residuals_of(cubic)
    assert residuals is not None
    assert residuals.maximum < 2e-5


def test_a_table_goes_through_its_points_and_straight_in_between() -> None:
    table = fit([(100, 5.0), (0, 0.0), (50, 1.0), (50, 2.0)], "table", channel=1)
    assert [value(table, x) for x in (0, 25, 50, 75, 100)] == pytest.approx([0, 0.75, 1.5, 3.25, 5])


def test_a_table_can_be_thinned_and_stays_as_close_as_asked() -> None:
    raw = np.linspace(0, 65535, 20_000)
    points = list(zip(raw.tolist(), (360 * raw / 65535 + np.sin(raw / 9000)).tolist(), strict=True))
    with pytest.raises(BadDataError, match="too large"):
        fit(points, "table", channel=1)
    thin = fit(points, "table", channel=1, tolerance=0.01)
    assert 20 < thin.inputs[0].segments < 200
    residuals = residuals_of(thin)
    assert residuals is not None
    assert 0.001 < residuals.maximum < 0.0101
    assert fit(points, "table", channel=1, tolerance=5.0).inputs[0].segments == 1


def test_steps_hold_up_to_the_next_point() -> None:
    steps = fit([(0, 1.0), (10, 2.0), (20, 3.0)], "steps", channel=1)
    assert [value(steps, x) for x in (0, 9, 10, 25)] == [1, 1, 2, 3]


def test_an_actuator_is_fitted_from_units_to_raw() -> None:
    line = fit([(0, 10.0), (4095, 110.0)], "linear", channel=1, actuator=True)
    assert value(line, 110.0) == pytest.approx(4095, abs=0.01)
    assert value(line, 10.0) == pytest.approx(0, abs=0.01)


@pytest.mark.parametrize("method", METHODS)
def test_too_few_points_are_refused(method: str) -> None:
    with pytest.raises(BadDataError, match="two different inputs"):
        fit([(5, 1.0), (5, 2.0)], method, channel=1)  # type: ignore[arg-type]


def test_points_that_a_float32_cannot_distinguish_are_refused() -> None:
    with pytest.raises(BadDataError, match="Float32"):
        fit([(16777216, 0.0), (16777217, 1.0), (16777219, 2.0)], "table", channel=1)


# --- through the TEDS

finite = st.floats(-1e6, 1e6, width=32)


@st.composite
def calibrations(draw: st.DrawFn) -> Calibration:
    inputs, cells, terms = [], 1, 1
    for _ in range(draw(st.integers(1, 3))):
        segments, degree = draw(st.integers(1, 4)), draw(st.integers(0, 3))
        boundaries = sorted(draw(st.sets(finite, min_size=segments + 1, max_size=segments + 1)))
        offsets = draw(st.lists(finite, min_size=segments, max_size=segments))
        channel, key = draw(st.integers(0, 65535)), draw(st.integers(0, 255))
        inputs.append(CalibrationInput(channel, degree, tuple(boundaries), tuple(offsets), key))
        cells, terms = cells * segments, terms * (degree + 1)
    coefficients = draw(st.lists(finite, min_size=cells * terms, max_size=cells * terms))
    number = st.none() | finite
    low, high = sorted(draw(st.tuples(finite, finite)))
    moment = st.datetimes(datetime(1970, 1, 1), datetime(2105, 1, 1)).map(
        lambda d: d.replace(microsecond=0, tzinfo=UTC)
    )
    return Calibration(
        draw(st.integers(1, 255)),
        draw(st.sampled_from(METHODS)),
        tuple(inputs),
        tuple(coefficients),
        unit=parse_unit("rad"),
        zero_offset=draw(finite),
        low_limit=low,
        high_limit=high,
        uncertainty=draw(number),
        date=draw(st.none() | moment),
        interval=draw(st.none() | st.integers(0, 2**32 - 1).map(float)),
        monotone=draw(st.sampled_from([None, "increasing", "decreasing", "either"])),
        raw_range=draw(st.none() | st.just((0.0, 4095.0))),
    )


@given(calibrations(), st.sampled_from([2007, 2024]))
def test_a_calibration_survives_its_teds(calibration: Calibration, edition: teds.Edition) -> None:
    octets = teds.compose(5, calibration.fields(edition), edition=edition)
    decoded = teds.decode(octets)
    assert decoded.verdict == "clean"
    again = from_decoded(decoded, channel=calibration.channel, units=parse_unit("rad").units)
    assert again == calibration


def test_the_calibrated_unit_is_recognized_again(magnetic: Profile) -> None:
    table = replace(fit([(0, 0.0), (65535, 360.0)], "table", channel=1), unit=parse_unit("degree"))
    built = magnetic.build(bytes(10), calibration={1: table})
    again = dict(Sheet.from_blocks(built.blocks).calibrations)[1]
    assert again.unit.text == "°"
    assert again.unit.to_si(value(again, 65535)) == pytest.approx(2 * math.pi)


@pytest.mark.parametrize(
    ("slope", "intercept", "si"),
    [(2.0, 5.0, (2.0, 5.0)), (2.0, None, (1.0, 0.0)), (None, 5.0, (1.0, 0.0)), (None, None, (1.0, 0.0))],
)
def test_a_conversion_of_which_a_number_cannot_be_read_is_none(
    slope: float | None, intercept: float | None, si: tuple[float, float]
) -> None:
    parts = (teds.Field(30, "Slope", slope, b"", 0), teds.Field(31, "Intercept", intercept, b"", 0))
    plain = teds.decode(teds.compose(5, SPLINE.fields()))
    fields = tuple(field for field in plain.fields if field.name != "SIConvrt")
    converted = replace(plain, fields=(*fields, teds.Field(12, "SIConvrt", None, b"", 0, parts)))
    unit = from_decoded(converted, channel=1).unit
    assert (unit.scale, unit.offset) == si
    assert from_decoded(replace(plain, fields=fields), channel=1).unit.scale == 1.0


def test_a_foreign_calibration_is_bad_data_and_nothing_else() -> None:
    foreign = teds.decode(teds.compose(5, [("LinOnly", (1.0, 2.0))]))
    with pytest.raises(BadDataError, match="understood"):
        from_decoded(foreign, channel=1)


@pytest.mark.parametrize(
    ("inputs", "coefficients", "method"),
    [
        ([(1, 1, 2)], 2, "linear"),
        ([(1, 2, 2)], 3, "polynomial"),
        ([(1, 0, 2)], 1, "polynomial"),
        ([(1, 0, 3)], 2, "steps"),
        ([(1, 1, 3)], 4, "table"),
        ([(1, 2, 3)], 6, "polynomial"),
        ([(1, 1, 2), (2, 1, 2)], 4, "polynomial"),
        ([(1, 1, 3), (2, 1, 2)], 8, "polynomial"),
    ],
)
def test_of_a_calibration_without_the_house_fields_the_formula_says_the_method(
    inputs: list[tuple[int, int, int]], coefficients: int, method: str
) -> None:
    """What is not stated is not there: no unit but that of SI, no zero, no limits, no date."""
    fields: list[tuple[str, object]] = [
        ("CalInput", {"ChanNum": channel, "Degree": degree, "Boundaries": range(edges), "Offsets": range(edges - 1)})
        for channel, degree, edges in inputs
    ]
    fields.append(("Coefs", range(coefficients)))
    found = from_decoded(teds.decode(teds.compose(5, fields)), channel=1, units=parse_unit("rad").units)
    assert found.method == method
    assert [(part.channel, part.degree, len(part.boundaries), part.key) for part in found.inputs] == [
        (*part, 0) for part in inputs
    ]
    assert (found.unit.scale, found.unit.offset, found.unit.units) == (1.0, 0.0, parse_unit("rad").units)
    assert (found.zero_offset, found.low_limit, found.high_limit, found.uncertainty) == (0.0, None, None, None)
    assert (found.date, found.interval, found.zeroed, found.monotone, found.raw_range) == (None,) * 5
    half = from_decoded(teds.decode(teds.compose(5, [*fields, ("SIConvrt", {"Slope": 0.5})])), channel=1)
    assert (half.unit.scale, half.unit.offset) == (0.5, 0.0)


@given(st.binary(max_size=200))
def test_any_octets_of_a_calibration_teds_give_a_calibration_or_bad_data(block: bytes) -> None:
    from teds_provision.teds.codec.frame import frame

    decoded = teds.decode(frame(bytes.fromhex("030400050101") + block))
    with suppress(BadDataError):
        assert isinstance(from_decoded(decoded, channel=1), Calibration)


# --- dates


def test_an_overdue_calibration_is_warned_about() -> None:
    now = datetime(2026, 11, 21, tzinfo=UTC)
    old = replace(SPLINE, date=now - timedelta(days=400), interval=365 * 86400.0)
    assert old.overdue(now)
    assert "35 days ago" in old.date_warnings(now)[0]
    assert not replace(old, interval=None).overdue(now)
    assert replace(old, date=now).date_warnings(now) == []
    assert "future" in replace(old, date=now + timedelta(days=3)).date_warnings(now)[0]
    assert replace(old, date=now + timedelta(hours=23)).date_warnings(now) == [], "today, in another zone"
    recent = replace(old, date=now - timedelta(days=100), interval=365 * 86400.0).date_warnings(now, 30 * 86400.0)
    assert [text.partition(" days")[0] for text in recent] == ["its interval of 365"], "its own interval decides"
    assert "no date" in SPLINE.date_warnings(now)[0]
    assert "due again" in replace(old, interval=None).date_warnings(now, 30 * 86400.0)[0]
    assert "longer than" in replace(old, date=now).date_warnings(now, 30 * 86400.0)[0]


def test_a_calibration_is_overdue_after_its_moment_and_from_the_future_beyond_a_day() -> None:
    now = datetime(2026, 11, 21, tzinfo=UTC)
    year = 365 * 86400.0
    due_now = replace(SPLINE, date=now - timedelta(days=365), interval=year)
    assert (due_now.overdue(now), due_now.date_warnings(now)) == (False, [])
    later = now + timedelta(seconds=1)
    assert due_now.overdue(later)
    assert due_now.date_warnings(later) == ["the calibration of 2025-11-21 was due again on 2026-11-21, 0 days ago."]
    assert replace(SPLINE, date=now + timedelta(days=1)).date_warnings(now) == []
    assert replace(SPLINE, date=now, interval=year).date_warnings(now, year) == []
    assert replace(SPLINE, date=now, interval=year).date_warnings(now, year - 86400) == [
        "its interval of 365 days is longer than the 364 days that its type asks for."
    ]
    assert replace(SPLINE, date=now, interval=0.0).due is None


def test_a_calibration_is_shown_in_one_line_and_as_data(tactile: Profile) -> None:
    text = "# channel: 1\n# method: linear\n# date: 2026-01-01\n0,0\n32768,5.3\n65535,10\n"
    calibration = read_calibrations(text, "x.csv", tactile)[1]
    assert sentence(calibration) == (
        "channel 1: linear, 3 points, largest residual 0.2 N at raw 32768, rms 0.141 N, due 2026-06-30"
    )
    data = describe_calibration(calibration, datetime(2026, 7, 1, tzinfo=UTC))
    assert data["overdue"] is True
    assert data["residuals"]["worst"] == {"input": 32768, "difference": pytest.approx(0.2, abs=1e-3)}
    assert json.loads(json.dumps(data)) == data


# --- files

CSV = """\
# Angular sensor 7, bench 3
# date: 2026-10-31
# interval: 1 year
# by: lab 2
# uncertainty: 0.5
raw, value [degree]
0, 0
32768, 181
65535, 360
"""


def test_a_csv_of_points_becomes_the_table_that_the_profile_asks_for(magnetic: Profile, tmp_path: Path) -> None:
    path = tmp_path / "cal.csv"
    path.write_text(CSV)
    found = load_calibrations(path, magnetic)
    assert list(found) == [1]
    table = found[1]
    assert (table.method, table.by, table.uncertainty) == ("table", "lab 2", 0.5)
    assert value(table, 32768) == 181
    assert table.date == datetime(2026, 10, 31, tzinfo=UTC)
    assert table.interval == pytest.approx(365.2425 * 86400)
    assert table.unit.to_si(180.0) == pytest.approx(math.pi)


@pytest.mark.parametrize(
    "text",
    [
        "0;0,5\n100;1,5\n",
        "raw\tvalue (N)\n0\t0.5\n100\t1.5\n",
        "0 0.5\n100 1.5\n",
        "0,0.5\r\n100,1.5\r\n",
        "value,raw\n0.5,0\n1.5,100\n",
        "0x0,0.5\n0x64,1.5\n",
    ],
)
def test_the_habits_of_spreadsheets_are_read(text: str, tactile: Profile) -> None:
    line = read_calibrations("# channel: 3\n# method: linear\n" + text, "x.csv", tactile)[3]
    assert line.coefficients == pytest.approx((0.5, 0.01))


def test_one_file_may_hold_many_channels(tactile: Profile) -> None:
    rows = "".join(f"{channel},{raw},{raw / 6553.5}\n" for channel in range(1, 13) for raw in (0, 30000, 65535))
    found = read_calibrations("channel,raw,value\n" + rows, "all.csv", tactile)
    assert sorted(found) == list(range(1, 13))
    assert found[12].method == "polynomial"
    shared = read_calibrations("# channel: 1-12\n0,0\n65535,10\n", "same.csv", tactile)
    assert len(shared) == 12


def test_a_channel_that_the_type_has_not_is_answered_with_those_that_it_has(
    magnetic: Profile, tactile: Profile
) -> None:
    for profile, has in ((magnetic, "has channel 1, not 40"), (tactile, "has channels 1 to 12, not 40")):
        with pytest.raises(BadDataError, match=has):
            read_calibrations("# channel: 40\n0,0\n65535,10\n", "x.csv", profile)


def test_the_residual_of_a_fit_becomes_its_uncertainty_if_it_is_greater(tactile: Profile) -> None:
    text = "# channel: 1\n# method: linear\n# uncertainty: 0.01\n0,0\n1,1\n2,0\n"
    assert read_calibrations(text, "x.csv", tactile)[1].uncertainty == pytest.approx(2 / 3)


def test_the_rounding_of_a_table_is_no_uncertainty(magnetic: Profile) -> None:
    rows = "".join(f"{raw},{raw * 360 / 65535}\n" for raw in range(0, 65536, 257))
    assert read_calibrations(rows, "x.csv", magnetic)[1].uncertainty is None


def test_an_uncertainty_may_have_its_own_unit(tactile: Profile) -> None:
    text = "# channel: 1\n# uncertainty: 50 mN\n0,0\n1,1\n"
    assert read_calibrations(text, "x.csv", tactile)[1].uncertainty == pytest.approx(0.05)


def test_segments_with_coefficients_are_read_as_they_are(magnetic: Profile) -> None:
    text = "from,to,offset,c0,c1\n0,512,0,233.15,0.1\n512,1024,512,284.35,0.12\n"
    assert value(read_calibrations(text, "x.csv", magnetic)[1], 700) == pytest.approx(306.91, abs=1e-3)


READY = {
    "slope": {"slope": 0.1, "intercept": 5, "zero-offset": 2},
    "list": {"coefficients": [5, 0.1], "zero-offset": 2},
    "inputs": {
        "inputs": [{"channel": 1, "degree": 1, "boundaries": [0, 100], "offsets": [0]}],
        "coefficients": [7, 0.1],
    },
    "points": {"points": [[0, 7], [10, 8]], "method": "linear"},
    "many": {"date": "2026-01-01", "calibration": [{"channel": 1, "slope": 0.1, "intercept": 7}]},
}


@pytest.mark.parametrize("kind", READY)
def test_ready_coefficients_are_read_from_json(kind: str, magnetic: Profile) -> None:
    found = read_calibrations(json.dumps(READY[kind]), "cal.json", magnetic)
    assert value(found[1], 10) == pytest.approx(8)


def test_ready_coefficients_of_several_inputs_are_read_from_toml(tactile: Profile) -> None:
    text = """
channel = 1
date = 2026-10-31
coefficients = [10, -0.01, 0.5, 0.002]
[[inputs]]
channel = 1
degree = 1
boundaries = [0, 200]
offsets = [50]
[[inputs]]
channel = 2
degree = 1
boundaries = [0, 40]
offsets = [25]
"""
    assert value(read_calibrations(text, "cal.toml", tactile)[1], 100, 20) == pytest.approx(34.55, abs=1e-4)


@pytest.mark.parametrize(
    ("text", "name", "place", "field"),
    [
        ("raw,value\n0,0\n1,x\n", "c.csv", 3, "value"),
        ("raw,value\n0,0\n1,nan\n", "c.csv", 3, "value"),
        ("raw,value\n0,0\n1\n", "c.csv", 3, "columns"),
        ("0,0,0\n", "c.csv", 1, "columns"),
        ("a,b,c\n0,0,0\n", "c.csv", 1, "columns"),
        ("", "c.csv", 1, "no points"),
        ("raw,value\n", "c.csv", 1, "no points"),
        ("# date: tomorrow\n0,0\n1,1\n", "c.csv", 1, "date"),
        ("# date: 1969-01-01\n0,0\n1,1\n", "c.csv", 1, "date"),
        ("# intervall: 1 year\n0,0\n1,1\n", "c.csv", 1, "interval"),
        ("# interval: soon\n0,0\n1,1\n", "c.csv", 1, "interval"),
        ("# method: tabel\n0,0\n1,1\n", "c.csv", 1, '"table"'),
        ("# degree: 5\n# method: polynomial\n0,0\n1,1\n", "c.csv", 3, "degree 5"),
        ("# degree: x\n0,0\n1,1\n", "c.csv", 1, "degree"),
        ("# unit: N\n0,0\n1,1\n", "c.csv", 1, "unit"),
        ("raw,value [wibble]\n0,0\n1,1\n", "c.csv", 1, "unit"),
        ("# channel: 2\n0,0\n1,1\n", "c.csv", 1, "channel"),
        ("# uncertainty: -1\n0,0\n1,1\n", "c.csv", 1, "uncertainty"),
        ("# date: 2026-01-01\n# date: 2026-01-02\n0,0\n1,1\n", "c.csv", 2, "twice"),
        ("0,0\n0,1\n", "c.csv", 1, "different inputs"),
        ("from,to,offset,c0\n0,1,0,5\n2,3,0,6\n", "c.csv", 3, "from"),
        ("from,to,c0\n0,1,5\n", "c.csv", 1, '"offset"'),
        ("slope = 1\nslop = 2\n", "c.toml", 2, '"slope"'),
        (f"slope = {10**400}\n", "c.toml", 1, "slope"),
        ("coefficients = [1.0, inf]\n", "c.toml", 1, "coefficients"),
        (f"points = [[0, 1], [2, {10**400}]]\n", "c.toml", 1, "point 2"),
        (f"raw,value\n0,0\n0x{'f' * 400},1\n", "c.csv", 3, "raw"),
        ("slope = \n", "c.toml", 1, "TOML"),
        ('points = [[1, 2], [3, "x"]]\n', "c.toml", 1, "point 2"),
        ("slope = 1\npoints = [[0, 1], [2, 3]]\n", "c.toml", 2, "only one"),
        ("by = 'x'\n", "c.toml", 1, "nothing"),
        ("coefficients = [1, 2, 3]\nboundaries = [0, 1, 2]\n", "c.toml", 1, "coefficients"),
        ("slope = 1\nlow-limit = 2\nhigh-limit = 1\n", "c.toml", 2, "low-limit"),
        ("coefficients = [1, 2, 3, 4]\nboundaries = [0, 2, 1]\n", "c.toml", 2, "ascend"),
        ("coefficients = [1, 2]\ninputs = 3\n", "c.toml", 2, "inputs"),
        ("coefficients = [1, 2]\n[[inputs]]\nchanel = 3\n", "c.toml", 3, "chanel"),
        ("{", "c.json", 1, "JSON"),
        ("[]", "c.json", 1, "object"),
        ('{"slope": true}', "c.json", 1, "slope"),
        ('{\n"slope": 1,\n"channel": "x"}', "c.json", 3, "channel"),
        ('{\n"slope": 1,\n"channel": [{"number": 1}]}', "c.json", 3, "not a list; several channels: [["),
    ],
)
def test_a_bad_file_names_file_line_and_field(text: str, name: str, place: int, field: str, magnetic: Profile) -> None:
    with pytest.raises(BadDataError) as caught:
        read_calibrations(text, name, magnetic)
    assert caught.value.message.startswith(f"{name}:{place}: ")
    assert field in caught.value.message + caught.value.hint


def test_a_file_for_one_of_many_channels_must_say_which(tactile: Profile) -> None:
    with pytest.raises(BadDataError, match="12 channels"):
        read_calibrations("0,0\n1,1\n", "x.csv", tactile)
    with pytest.raises(BadDataError, match="two calibrations"):
        read_calibrations(
            '{"calibration": [{"channel": 1, "slope": 1}, {"channel": "1-2", "slope": 1}]}', "x.json", tactile
        )


def test_a_missing_file_is_not_found(magnetic: Profile, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        load_calibrations(tmp_path / "no.csv", magnetic)


@given(st.text(max_size=200), st.sampled_from(["c.csv", "c.toml", "c.json"]))
def test_any_text_is_a_calibration_or_bad_data(text: str, name: str) -> None:
    profile = load_profile("magnetic-angular-position-sensor")
    with suppress(BadDataError):
        assert read_calibrations(text, name, profile)


def test_a_calibration_kept_from_a_node_gives_the_same_octets(magnetic: Profile) -> None:
    built = magnetic.build(bytes(10), calibration=read_calibrations(CSV, "x.csv", magnetic))
    kept = from_decoded(teds.decode(built.blocks[1, 5]))
    assert magnetic.build(bytes(10), calibration={1: kept}).blocks == built.blocks
    assert (
        magnetic.build(bytes(10), calibration=dict(Sheet.from_blocks(built.blocks).calibrations)).blocks == built.blocks
    )


def test_a_column_that_is_named_twice_is_refused(tactile: Profile) -> None:
    text = "channel;from;to;from;to;offset;c0;c1\n1;0;512;0;0,5;0,001\n"
    with pytest.raises(BadDataError, match=r'c\.csv:1: the column "from" appears twice'):
        read_calibrations(text, "c.csv", tactile)


POLYGON = [(0.0, 0.0), (1.0, 1.0), (2.0, 2.0), (3.0, 1.5), (4.0, 1.0), (6.0, 0.0), (8.0, 4.25), (10.0, 8.0)]


@pytest.mark.parametrize(
    ("tolerance", "nodes"),
    [
        (0.0, [0, 1, 2, 3, 4, 6, 8, 10]),
        (0.2, [0, 2, 6, 8, 10]),
        (0.25, [0, 2, 6, 10]),
        (1.9, [0, 2, 6, 10]),
        (2.0, [0, 6, 10]),
        (9.0, [0, 10]),
    ],
)
def test_every_point_stays_within_the_tolerance_of_the_nodes_that_are_kept(tolerance: float, nodes: list[int]) -> None:
    """At most so far: the point at 8 is 0.25 above the line between its neighbours."""
    table = fit(POLYGON, "table", channel=1, tolerance=tolerance)
    assert table.inputs[0].boundaries == tuple(nodes)
    for raw, value in POLYGON:
        assert abs(evaluate(table, raw).value - value) <= tolerance + 1e-6


def test_a_curve_that_leaves_the_numbers_is_not_inverted() -> None:
    steep = Calibration(1, "polynomial", (CalibrationInput(1, 64, (0, 65535), (0,)),), (*[0.0] * 64, 1.01))
    with pytest.raises(BadDataError, match="its curve does not rise or fall all the way"):
        PreparedInverse(PreparedCurve(steep), 0.0, 65535.0)(np.array([1.0]))


def test_the_way_back_over_a_step_is_to_the_nearer_of_its_two_results() -> None:
    steps = PreparedInverse(PreparedCurve(fit([(0, 0.0), (10, 10.0)], "steps", channel=1)), 0.0, 19.0)
    below, above = steps(np.array([4.0, 6.0])).tolist()
    assert below == pytest.approx(10.0)
    assert below < 10.0 <= above


def test_the_kind_of_a_curve_in_words() -> None:
    for points, method, words in (
        (2, "table", "table of 1 segment"),
        (3, "table", "table of 2 segments"),
        (2, "steps", "steps of 2 segments"),
        (3, "linear", "linear"),
        (4, "polynomial", "polynomial of degree 3"),
    ):
        assert kind_of(fit(POLYGON[:points], method, channel=1)) == words  # type: ignore[arg-type]
    assert kind_of(replace(SPLINE, method="linear")) == "linear, 2 segments"


def test_of_two_points_none_is_left_out() -> None:
    assert fit(POLYGON[:2], "table", channel=1, tolerance=9.0).inputs[0].boundaries == (0.0, 1.0)
    assert fit(POLYGON[:3], "table", channel=1, tolerance=0.1).inputs[0].boundaries == (0.0, 2.0)


@pytest.mark.parametrize(
    ("degree", "points", "why"),
    [
        (1, 2, ""),
        (2, 3, ""),
        (12, 13, ""),
        (2, 2, "A polynomial of degree 2 needs 3 different inputs; there are 2."),
        (12, 12, "A polynomial of degree 12 needs 13 different inputs; there are 12."),
        (0, 9, "The degree of a polynomial goes from 1 to 12, not 0."),
        (13, 20, "The degree of a polynomial goes from 1 to 12, not 13."),
    ],
)
def test_a_polynomial_has_a_degree_from_1_to_12_and_one_point_more(degree: int, points: int, why: str) -> None:
    rows = [(float(x), float(x % 3)) for x in range(points)] + [(0.0, 0.0)]  # one input twice
    if not why:
        assert fit(rows, "polynomial", channel=1, degree=degree).inputs[0].degree == degree
        return
    with pytest.raises(BadDataError) as refused:
        fit(rows, "polynomial", channel=1, degree=degree)
    assert refused.value.message == why


def test_points_are_left_out_of_a_polynomial_of_the_same_degree() -> None:
    """A parabola through y = x³ without the point at 2, and a line through it: by hand."""
    cubes = [(float(x), float(x**3)) for x in range(5)]
    line = fit(cubes, "polynomial", channel=1, degree=1)
    others = [pair for pair in cubes if pair[0] != 2]
    mean = sum(y for _, y in others) / 4
    assert left_out(line)[1] == pytest.approx(8 - mean, rel=1e-5), "the mean of the others lies at x = 2"
    assert left_out(fit(cubes, "polynomial", channel=1, degree=3)) == pytest.approx((0, 0, 0), abs=1e-4)


def test_a_sentence_on_an_actuators_fit_is_in_raw_values_at_what_is_set() -> None:
    points = [(0.0, 0.0), (100.0, 1.0), (204.0, 2.0)]
    mm = replace(fit(points, "linear", channel=2, actuator=True), unit=parse_unit("mm"))
    assert sentence(mm) == "channel 2: linear, 3 points, largest residual 1.33 raw at 1 mm, rms 0.943 raw"
    sensor = replace(fit(points, "linear", channel=2), unit=parse_unit("mm"))
    assert sentence(sensor).startswith("channel 2: linear, 3 points, largest residual 0.0131 mm at raw 100")


def test_outside_is_beyond_either_end_of_any_input_and_what_is_no_number() -> None:
    parts = (CalibrationInput(1, 1, (0.0, 4.0, 10.0), (0.0, 0.0)), CalibrationInput(2, 1, (5.0, 6.0), (0.0,)))
    both = Calibration(1, "polynomial", parts, (0.0,) * 8)
    for one, other, outside in (
        (0, 5, 0), (10, 6, 0), (-0.1, 5, 1), (10.1, 5, 1), (5, 4.9, 1), (5, 6.1, 1), (math.nan, 5, 1), (5, math.nan, 1),
    ):  # fmt: skip
        assert evaluate(both, one, other).outside == outside, (one, other)


def test_a_table_has_as_many_nodes_as_a_teds_holds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(formulas, "MAXIMUM_NODES", 3)
    assert fit(POLYGON[:3], "table", channel=1).inputs[0].boundaries == (0.0, 1.0, 2.0)
    with pytest.raises(BadDataError, match=r"^A table of 4 nodes is too large for a TEDS, which holds 3 at most\.$"):
        fit(POLYGON[:4], "table", channel=1)


def test_warnings_about_the_age_of_a_calibration_in_whole_words() -> None:
    now, day = datetime(2026, 11, 21, tzinfo=UTC), 86400.0
    assert SPLINE.date_warnings(now) == ["the calibration has no date."]
    assert SPLINE.date_warnings(now, 30.4 * day) == [
        "the calibration has no date, and is to be repeated every 30 days."
    ]
    ahead = replace(SPLINE, date=datetime(2026, 12, 1, tzinfo=UTC))
    assert ahead.date_warnings(now) == ["the calibration date 2026-12-01 lies in the future."]
    late = replace(SPLINE, date=datetime(2025, 11, 20, tzinfo=UTC), interval=365 * day)
    assert late.date_warnings(now, 30 * day) == [
        "the calibration of 2025-11-20 was due again on 2026-11-20, 1 day ago.",
        "its interval of 365 days is longer than the 30 days that its type asks for.",
    ]
    for days, warned in ((365.3, False), (365.4, True)):
        longer = replace(SPLINE, date=now, interval=days * day).date_warnings(now, 365 * day)
        assert bool(longer) is warned, "more than a thousandth"


def test_without_its_channel_a_calibration_is_that_of_its_first_input() -> None:
    parts = (CalibrationInput(3, 1, (0, 200), (50,)), CalibrationInput(2, 1, (0, 40), (25,)))
    decoded = teds.decode(teds.compose(5, replace(TWO_INPUTS, inputs=parts).fields()))
    assert from_decoded(decoded).channel == 3
    assert from_decoded(decoded, channel=7).channel == 7
    assert [part.channel for part in from_decoded(decoded, channel=7).inputs] == [3, 2]
