"""Reference values that people give, and deviations that profiles state: in which unit they are meant."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, UsageError
from teds_provision.measure import verified_session
from teds_provision.measure.sample_series import reference_for
from teds_provision.teds.channel import Channel
from teds_provision.teds.units import WrittenUnit, parse_unit


def channel(unit: str, si: str) -> Any:
    """Return a channel that is shown in a unit."""
    shown = parse_unit(unit)
    return SimpleNamespace(number=1, label="1", shown=shown, unit=shown, si_unit=si, units=shown.units)


@pytest.mark.parametrize(
    ("unit", "si", "value", "named", "asked", "reference"),
    [
        ("m", "m", None, None, True, 0.0),
        ("m", "m", 2.0, None, True, 2.0),
        ("mm", "m", None, None, True, 0.0),
        ("mm", "m", 2.0, None, False, 2.0),
        ("mm", "m", 2.0, None, True, None),
        ("mm", "m", 2.0, "mm", True, 0.002),
        ("mm", "m", 2.0, "m", True, 2.0),
        ("degC", "K", None, None, True, None),
        ("degC", "K", None, None, False, None),
        ("degC", "K", None, "degC", False, 273.15),
        ("degC", "K", 20.0, None, False, 20.0),
        ("degC", "K", 20.0, None, True, None),
    ],
)
def test_a_value_without_a_unit_is_si_and_asked_for_where_that_is_not_what_is_shown(
    unit: str, si: str, value: float | None, named: str | None, asked: bool, reference: float | None
) -> None:
    """0 is the same in millimetres and metres; 0 °C is no 0 K, and no program can know which one is meant."""
    if reference is None:
        with pytest.raises(UsageError, match="give the unit of the value"):
            reference_for(channel(unit, si), value, named, shown_unit_asked=asked)
        return
    assert reference_for(channel(unit, si), value, named, shown_unit_asked=asked) == pytest.approx(reference)
    with pytest.raises(BadDataError):
        reference_for(channel(unit, si), 1.0, "Hz", shown_unit_asked=asked)


def test_a_deviation_is_a_difference_in_its_unit_and_none_of_another_quantity() -> None:
    celsius, newton = parse_unit("degC"), parse_unit("N")

    def deviation(unit: WrittenUnit, stated: float | None) -> float | None:
        of_type: Any = SimpleNamespace(
            units=unit.units, unit=unit, calibration=SimpleNamespace(standard_deviation=stated)
        )
        return verified_session._deviation(of_type, Channel(1, units=celsius.units))

    assert deviation(celsius, 0.5) == pytest.approx(0.5), "kelvins, not the temperature of 0.5 °C"
    assert [deviation(newton, 0.5), deviation(celsius, None), deviation(celsius, float("nan"))] == [None] * 3
    assert verified_session._deviation(None, Channel(1)) is None
