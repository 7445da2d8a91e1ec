"""Channels side by side give what each interpreter gives alone, to the last bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.teds import Sheet
from teds_provision.teds.calibration import ChannelInterpreter, fit
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.calibration.together import Together
from teds_provision.teds.units.units import parse_unit
from tests.teds.test_interpreter import sheet_of

CURVES = {
    1: fit([(0, 0.0), (65535, 10.0)], "linear", channel=1),
    2: fit([(n * 1000, 0.0001 * n**2) for n in range(60)], "table", channel=2),
    3: fit([(n * 4000, 0.04 * n**2) for n in range(16)], "polynomial", channel=3),
    4: fit([(0, 1.0), (20000, 3.0), (40000, 9.0)], "steps", channel=4),
}


def sheet(unit: str = "N") -> Sheet:
    """Twelve taxels: four with different calibrations (one in another unit, one offset), the others with none."""
    curves = dict(CURVES)
    curves[3] = replace(curves[3], unit=parse_unit(unit))
    curves[4] = replace(curves[4], zero_offset=0.25)
    return sheet_of("tactile-finger-sensor", curves)


@pytest.mark.parametrize("unit", ["N", "mN"])
@given(st.lists(st.lists(st.integers(0, 65535), min_size=12, max_size=12), min_size=1, max_size=6))
@settings(max_examples=60)
def test_side_by_side_is_one_by_one(unit: str, raw: list[list[int]]) -> None:
    known = sheet(unit)
    channels = [ChannelInterpreter(known, number) for number in range(1, 13)]
    usable = [not one.problem for one in channels]
    together = Together.of(channels, usable)
    assert together is not None
    octets = np.array(raw, dtype=">u2").view(np.uint8).reshape(len(raw), 24)
    raws = together.raw(octets)
    np.testing.assert_array_equal(raws, raw)
    value, valid = together.values(raws)
    for column, one in enumerate(channels):
        alone = one.values(one.reader.raw(octets[:, 2 * column : 2 * column + 2]))
        np.testing.assert_array_equal(valid[:, column], alone.valid)
        np.testing.assert_array_equal(value[:, column], alone.value * one.unit.scale + one.unit.offset)


def test_channels_of_other_forms_stay_alone() -> None:
    known = sheet()
    channels = [ChannelInterpreter(known, number) for number in (1, 2)]
    assert Together.of(channels, [True, True]) is not None
    (first, *rest) = known.channels
    wider = replace(known, channels=(replace(first, sample=SampleForm(0, 3), calibration=None), *rest))
    assert Together.of([ChannelInterpreter(wider, number) for number in (1, 2)], [True, True]) is None
    floats = replace(known, channels=(replace(first, sample=SampleForm(1, 4), calibration=None), *rest))
    assert Together.of([ChannelInterpreter(floats, 1)], [True]) is None
