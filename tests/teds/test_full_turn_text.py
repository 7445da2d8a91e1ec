"""An angle over a full turn that rounds to the end of its turn is shown as the turn's beginning, everywhere."""

from __future__ import annotations

import math

import pytest

from teds_provision.cli.measure import record, sample
from teds_provision.cli.measure.measure_view import value_text
from teds_provision.measure.blocks import ChannelFacts
from teds_provision.measure.sampling import Sample
from teds_provision.teds.channel import Channel, ChannelKind
from teds_provision.teds.units import parse_unit

RAD = parse_unit("rad").units
TURN = math.tau


def channel(low: float, high: float, display: str = "degree") -> Channel:
    return Channel(1, "angle", ChannelKind.SENSOR, units=RAD, low=low, high=high, display=display)


@pytest.mark.parametrize(
    ("low", "display", "value", "shown"),
    [
        (0.0, "degree", TURN - 1e-9, "0 °"),
        (0.0, "degree", TURN - 1e-3, "359.943 °"),
        (0.0, "degree", 0.0, "0 °"),
        (0.0, "degree", -0.0, "0 °"),
        (0.0, "rad", TURN - 1e-9, "0 rad"),
        (0.0, "rad", 6.2831, "6.2831 rad"),
        (-math.pi, "degree", math.pi - 1e-9, "-180 °"),
        (-math.pi, "degree", -math.pi, "-180 °"),
        (-math.pi, "degree", -1e-12, "-5.72958e-11 °"),
        (0.0, "turn", TURN - 1e-9, "0 turn"),
    ],
)
def test_a_reading_is_shown_within_its_turn(low: float, display: str, value: float, shown: str) -> None:
    own = channel(low, low + TURN, display)
    assert own.full_turn
    assert own.show_reading(value) == shown
    facts = ChannelFacts("00", "", 1, "angle", unit="rad", units=RAD, shown_unit=display, low=low, high=low + TURN)
    assert " ".join(value_text(value, facts)) == shown
    assert record._value(value, facts) == shown
    taken = Sample(1, "angle", value, "rad", 1, None, True, 0.0, shown=own.shown, turn=low)
    assert sample._text(taken, own.shown.from_si(value)) == shown.split(maxsplit=1)[0]


def test_limits_and_other_channels_are_shown_as_they_are() -> None:
    own = channel(0.0, TURN)
    assert own.show(own.high) == "360 °"
    half = channel(0.0, math.pi)
    assert not half.full_turn
    assert half.show_reading(math.pi - 1e-12) == "180 °"
    assert own.show_reading(math.nan) == "not available"
    facts = ChannelFacts("00", "", 1, "angle", unit="rad", units=RAD, shown_unit="degree", uncertainty=0.02)
    assert value_text(None, facts)[0] == "not valid"
    assert value_text(TURN, facts) == ("360", "°"), "without limits nothing says that it wraps"


def test_what_the_uncertainty_rounds_up_stays_within_the_turn() -> None:
    facts = ChannelFacts(
        "00", "", 1, "a", unit="rad", units=RAD, shown_unit="degree", low=0.0, high=TURN, uncertainty=math.radians(5)
    )
    assert value_text(TURN - 2e-6, facts)[0] in ("0", "359.999", "359.995"), "never 360"
    assert value_text(TURN - 1e-7, facts)[0] == "0"
