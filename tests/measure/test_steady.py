"""When a reading is steady enough for a zero, or for a point of a calibration."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import PolicyError
from teds_provision.measure import capture
from teds_provision.measure.sample_series import SampleSeries, require_still
from teds_provision.teds import Sheet
from teds_provision.teds.calibration import ChannelInterpreter, read_calibrations
from teds_provision.teds.profile import load_profile

TEMPERATURE = "temperature-sensor"
DEGREES = "# date: 2026-10-01\nraw,value [degC]\n0,-40\n32768,216\n"  # 1/128 degC a step
ANGLE = "magnetic-angular-position-sensor"


def series(
    type_name: str, calibration: str | None, raw: list[float], *, dtype: str = "uint64", **facts: Any
) -> SampleSeries:
    """Return samples of channel 1 of a type; ``facts`` replace those of its datasheet."""
    profile = load_profile(type_name)
    made = read_calibrations(calibration, "c.csv", profile) if calibration else {}
    sheet = Sheet.from_blocks(profile.build(bytes(10), calibration=made).blocks)
    sheet = replace(sheet, channels=(replace(sheet.channels[0], **facts), *sheet.channels[1:]))
    return SampleSeries(ChannelInterpreter(sheet, 1), np.array(raw, dtype=dtype), {})


def between(middle: float, away: float) -> list[float]:
    """Return 32 samples with a mean, a standard deviation, and no drift."""
    return [middle - away, middle + away] * 16


def drifting(first: float, second: float) -> list[float]:
    return [first] * 16 + [second] * 16


@pytest.mark.parametrize(
    ("raw", "facts", "why"),
    [
        (between(8000, 64), {"uncertainty": 0.5}, None),
        (between(8000, 65), {"uncertainty": 0.5}, "spreads by 0.507812 °C; 0.5 °C is allowed"),
        (drifting(8000, 8064), {"uncertainty": 0.5}, None),
        (drifting(8000, 8065), {"uncertainty": 0.5}, "drifts by 0.507812 °C; 0.5 °C is allowed"),
        (drifting(8065, 8000), {"uncertainty": 0.5}, "drifts by 0.507812 °C; 0.5 °C is allowed"),
        (between(8000, 255), {"uncertainty": math.nan, "low": 233.15, "high": 433.15}, None),
        (
            between(8000, 257),
            {"uncertainty": math.nan, "low": 233.15, "high": 433.15},
            "spreads by 2.00781 °C; 2 °C is allowed",
        ),
        (between(8000, 257), {"uncertainty": 0.0, "low": 233.15, "high": 433.15}, "2 °C is allowed"),
        (between(8000, 7000), {"uncertainty": math.nan, "low": math.nan}, None),
    ],
)
def test_a_reading_may_spread_or_drift_by_the_uncertainty_or_else_by_a_hundredth_of_the_range(
    raw: list[float], facts: dict[str, float], why: str | None
) -> None:
    settled = series(TEMPERATURE, DEGREES, raw, **facts)
    if why is None:
        assert require_still(settled).count == 32
        assert capture._point(settled, 300.0).raw == np.mean(raw)
        return
    for call in (lambda: require_still(settled), lambda: capture._point(settled, 300.0)):
        with pytest.raises(PolicyError, match=f"^Channel 1 is not steady: its reading .*{why}\\.$"):
            call()


@pytest.mark.parametrize(
    ("raw", "why"),
    [
        (between(8000, 327), None),
        (between(8000, 328), "spreads by 328; 327.67 is allowed"),
        (drifting(8000, 8327), None),
        (drifting(8000, 8328), "drifts by 328; 327.67 is allowed"),
        (drifting(8328, 8000), "drifts by 328; 327.67 is allowed"),
    ],
)
def test_without_a_calibration_raw_values_may_spread_or_drift_by_a_hundredth_of_what_they_can_be(
    raw: list[float], why: str | None
) -> None:
    """They were not looked at: a first point could be one of a sensor that moved."""
    settled = series(TEMPERATURE, None, raw)
    if why is None:
        assert capture._point(settled, 300.0).spread == pytest.approx(np.std(raw))
    else:
        with pytest.raises(PolicyError, match=f"^Channel 1 is not steady: its raw value {why}\\.$"):
            capture._point(settled, 300.0)


def test_an_angle_at_the_wrap_of_its_raw_values_gives_no_point() -> None:
    wraps = "is at the wrap of its raw values"
    with pytest.raises(PolicyError, match=wraps):
        capture._point(series(ANGLE, None, [0.0] * 31 + [65535.0]), 0.0)
    with pytest.raises(PolicyError, match=wraps):
        capture._point(series(ANGLE, None, [0.0] * 31 + [32768.0]), 0.0)
    with pytest.raises(PolicyError, match="not steady"):
        capture._point(series(ANGLE, None, [0.0] * 31 + [32767.0]), 0.0)
    with pytest.raises(PolicyError, match="not steady"):
        capture._point(series(TEMPERATURE, None, [0.0] * 31 + [65535.0]), 0.0)  # it has no wrap


def test_a_point_is_the_mean_of_its_samples_with_spread_and_count() -> None:
    found = capture._point(series(TEMPERATURE, DEGREES, [1000.0, 1001.0, 1003.0]), 300.0)
    assert (found.channel, found.reference, found.count) == (1, 300.0, 3)
    assert (found.raw, found.spread) == (pytest.approx(1001.3333333), pytest.approx(1.2472191))
