"""The curve of a calibration: which facts of its channel count, and which step of it is the worst."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from teds_provision.teds.calibration import Calibration, CalibrationInput
from teds_provision.teds.curve import Curve, CurveChannel, channel_of
from teds_provision.teds.profile import Profile, load_profile, shipped_profiles
from teds_provision.teds.units import parse_unit

NEWTON = parse_unit("N")
CHANNEL = CurveChannel(1, NEWTON.units, 0.0, 100.0, 0.1, (0.0, 4.0), actuator=False, integer=True)


@pytest.fixture(scope="module")
def tactile() -> Profile:
    return load_profile("tactile-finger-sensor", [shipped_profiles()])


def curve_with(*results: float) -> Curve:
    """Return a table whose result at raw 0, 1, 2 … is the next of ``results``."""
    edges = tuple(float(raw) for raw in range(len(results) + 1))
    table = Calibration(1, "steps", (CalibrationInput(1, 0, edges, edges[:-1]),), results, unit=NEWTON)
    return Curve(table, CHANNEL, (np.array(edges[:-1]),), 0)


def test_without_a_channel_teds_the_units_are_those_of_the_profile(tactile: Profile) -> None:
    channel = channel_of(1, {}, tactile)
    assert channel.units == NEWTON.units
    assert channel.integer, "nothing states a float"
    assert channel_of(1, {}, None).units != NEWTON.units


def test_a_value_is_shown_in_the_unit_of_its_calibration_unless_that_is_only_a_formula() -> None:
    degrees = replace(CHANNEL, units=parse_unit("K").units)
    assert degrees.show(300.0, like=parse_unit("degC")) == "26.85 degC"
    assert degrees.show(5.0, difference=True, like=parse_unit("degC")) == "5 degC"
    formula = replace(parse_unit("mm"), text="(mm)")
    assert replace(CHANNEL, units=formula.units).show(0.5, like=formula) == "0.5 m"
    chosen = replace(CHANNEL, units=formula.units, display="cm")
    assert chosen.show(0.5, like=parse_unit("mm")) == "50 cm", "what its profile shows counts first"


def test_what_the_channel_teds_states_counts_before_the_profile(tactile: Profile) -> None:
    blocks = tactile.build(bytes(10)).blocks
    other = replace(tactile, channels=tuple(replace(c, unit=parse_unit("m")) for c in tactile.channels))
    assert channel_of(1, blocks, other).units == NEWTON.units
    assert channel_of(1, blocks, other).display is not None


@pytest.mark.parametrize(
    ("results", "direction", "before", "step"),
    [
        ((0.0, 1.0, 0.5, 3.0), "increasing", 1.0, -0.5),
        ((0.0, 1.0, 0.5, 3.0), "decreasing", 2.0, 2.5),
        ((0.0, 1.0, 0.5, 3.0), "either", 1.0, -0.5),
        ((3.0, 0.5, 1.0, 0.0), "either", 1.0, 0.5),
    ],
)
def test_the_worst_step_goes_against_the_direction_of_the_whole(
    results: tuple[float, ...], direction: str, before: float, step: float
) -> None:
    assert curve_with(*results).worst_step(direction) == ((before,), step)


@pytest.mark.parametrize(
    ("results", "increasing", "decreasing", "either"),
    [
        ((0.0, 1.0, 2.0), True, False, True),
        ((2.0, 1.0, 1.0), False, True, True),
        ((0.0, 2.0, 1.0), False, False, False),
        ((1.0, 1.0, 1.0), True, True, True),
    ],
)
def test_a_curve_is_monotone_in_a_direction(
    results: tuple[float, ...], increasing: bool, decreasing: bool, either: bool
) -> None:
    curve = curve_with(*results)
    assert [curve.monotone(way) for way in ("increasing", "decreasing", "either")] == [increasing, decreasing, either]


def test_the_sample_after_one_is_the_next_place_and_the_last_has_none() -> None:
    curve = curve_with(0.0, 1.0, 2.0)
    assert [curve.next_sample(raw) for raw in (0.0, 0.5, 1.0, 2.0)] == [1.0, 1.0, 2.0, 2.0]
