"""The zero of a sensor: mean of many samples, angles included, and a Calibration TEDS in which nothing else moves."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.calibration import Calibration, CalibrationInput, evaluate, from_decoded
from teds_provision.teds.calibration.zero import SampleStatistics, offset_for, reading_of, turn_of, with_zero_offset
from teds_provision.teds.codec.frame import frame, raw_tuple, unframe
from teds_provision.teds.units import parse_unit

AT = datetime(2026, 11, 23, 8, 0, tzinfo=UTC)
LINE = Calibration(
    1,
    "linear",
    (CalibrationInput(1, 1, (0, 65535), (0,)),),
    (0.0, 360 / 65536),
    unit=parse_unit("degree"),
    date=datetime(2026, 10, 1, tzinfo=UTC),
    monotone="increasing",
)


def composed(calibration: Calibration, width: int | None = None) -> bytes:
    return teds.compose(5, calibration.fields(), width=width)


def test_the_mean_of_readings_on_both_sides_of_the_wrap_is_between_them() -> None:
    reading = reading_of(np.array([359.0, 1.0, 358.0, 2.0]), 360.0)
    assert reading.mean % 360 == pytest.approx(0, abs=1e-9)
    assert reading.spread == pytest.approx(math.sqrt(2.5))
    assert not reading.is_unstable(2.0)
    assert reading_of(np.array([359.0, 1.0, 358.0, 2.0])).is_unstable(100), "without a turn it is no angle"


def test_a_drift_shows_that_hides_in_the_spread() -> None:
    reading = reading_of(np.linspace(0, 1, 32))
    assert reading.drift == pytest.approx(0.516, abs=1e-3)
    assert reading.spread == pytest.approx(0.298, abs=1e-3)
    assert reading.is_unstable(0.4)
    falls = reading_of(np.linspace(1, 0, 32))
    assert falls.drift == pytest.approx(-0.516, abs=1e-3)
    assert falls.is_unstable(0.4), "whichever way it moves"


@pytest.mark.parametrize(
    ("mean", "spread", "count", "doubt"),
    [
        (0.0, 0.2, 36, 0.1),
        (0.0, 0.2, 144, 0.05),
        (0.0, 0.0, 32, 0.0),
        (-2097152.0, 0.2, 36, 1.1),
        (2097152.0, 0.0, 36, 1.0),
    ],
)
def test_a_mean_is_good_to_three_standard_errors_and_four_steps_of_a_float32(
    mean: float, spread: float, count: int, doubt: float
) -> None:
    assert SampleStatistics(mean, spread, 0.0, count).doubt == pytest.approx(doubt)


@given(st.floats(0, 360), st.floats(0, 3), st.integers(16, 64))
def test_the_mean_of_an_angle_is_where_its_samples_are_wherever_that_is(
    about: float, spread: float, count: int
) -> None:
    samples = about + np.linspace(-spread, spread, count)
    reading = reading_of(np.mod(samples, 360.0), 360.0)
    assert abs((reading.mean - about + 180) % 360 - 180) < 1e-9
    assert reading.spread == pytest.approx(float(samples.std()), abs=1e-9)


@given(st.floats(-1e4, 1e4), st.floats(-360, 360), st.floats(-180, 180))
def test_with_the_offset_the_sensor_reads_what_it_shall(had: float, reading: float, wanted: float) -> None:
    calibration = replace(LINE, zero_offset=had)
    turn = turn_of(calibration, full_turn=True)
    backwards = replace(calibration, unit=replace(calibration.unit, scale=-calibration.unit.scale))
    assert turn_of(backwards, full_turn=True) == turn > 0
    assert turn_of(backwards, full_turn=False) == math.inf
    offset = offset_for(calibration, reading, wanted, turn)
    assert abs(offset) <= 180
    left = reading - calibration.zero_offset + offset - wanted
    assert abs(left - 360 * round(left / 360)) < 2e-2 + 1e-6 * abs(had)
    plain = offset_for(calibration, reading, wanted)
    assert plain == pytest.approx(calibration.zero_offset + wanted - reading, abs=1e-2)


def test_only_the_offset_and_its_date_move() -> None:
    before = composed(LINE)
    after = with_zero_offset(before, -12.5, AT)
    found = from_decoded(teds.decode(after), channel=1)
    assert found == replace(from_decoded(teds.decode(before), channel=1), zero_offset=-12.5, zeroed=AT)
    assert not [finding for finding in teds.decode(after).findings if finding.severity == "error"]
    assert evaluate(found, 0.0).value == -12.5
    assert with_zero_offset(with_zero_offset(before, 3.0, AT), -12.5, AT) == after
    assert composed(found) == after, "and it is what a build would write"


@pytest.mark.parametrize("width", [1, 2, 3])
def test_unknown_fields_are_kept_octet_for_octet(width: int) -> None:
    strange = frame(unframe(composed(LINE, width)) + raw_tuple(200, b"\xde\xad", width=width))
    after = with_zero_offset(strange, 1.0, AT)
    assert raw_tuple(200, b"\xde\xad", width=width) in after
    assert from_decoded(teds.decode(after), channel=1).zero_offset == 1.0
    assert with_zero_offset(after, 1.0, AT) == after


def test_the_edition_of_2024_is_kept() -> None:
    before = teds.compose(5, LINE.fields(), edition=2024)
    after = teds.decode(with_zero_offset(before, 1.0, AT))
    assert after.edition == 2024
    assert from_decoded(after, channel=1).zeroed == AT


def test_a_damaged_one_is_refused() -> None:
    with pytest.raises(BadDataError):
        with_zero_offset(composed(LINE)[:-1] + b"\x00", 1.0, AT)
