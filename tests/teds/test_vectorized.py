"""Channels side by side give what each interpreter gives alone, to the last bit."""

from __future__ import annotations

import math
from dataclasses import replace
from weakref import WeakValueDictionary

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.arrays import without_repeats
from teds_provision.teds import Sheet
from teds_provision.teds.calibration import Calibration, CalibrationInput, ChannelInterpreter, fit, vectorized
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.calibration.vectorized import ManyChannels
from teds_provision.teds.units import WrittenUnit, parse_unit
from tests.cli.shell import python
from tests.teds.test_interpreter import sheet_of, turned

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
    usable = [not interpreter.problem for interpreter in channels]
    many = ManyChannels.side_by_side(channels, usable)
    assert many is not None
    octets = np.array(raw, dtype=">u2").view(np.uint8).reshape(len(raw), 24)
    raws = many.raw(octets.tobytes())
    np.testing.assert_array_equal(raws, raw)
    value, valid = many.values(raws)
    for column, interpreter in enumerate(channels):
        alone = interpreter.values(interpreter.reader.raw(octets[:, 2 * column : 2 * column + 2]))
        np.testing.assert_array_equal(valid[:, column], alone.valid)
        np.testing.assert_array_equal(value[:, column], alone.value * interpreter.unit.scale + interpreter.unit.offset)


@given(st.lists(st.lists(st.integers(0, 65535), min_size=3, max_size=3), min_size=1, max_size=6), st.floats(-500, 500))
@settings(max_examples=60)
def test_angles_wrap_side_by_side_with_what_does_not(raw: list[list[int]], zero: float) -> None:
    known = turned(zero).channel(1)
    assert known is not None
    wide = replace(known, sample=SampleForm(0, 2))
    # The second has a range of less than a turn, the third gives its angles in rad.
    degrees = replace(fit([(0, 0.0), (4096, 360.0)], "linear", channel=2), unit=parse_unit("degree"))
    others = (
        replace(wide, number=2, high=6.0, calibration=degrees),
        replace(wide, number=3, calibration=fit([(0, 0.0), (65535, 10.0)], "linear", channel=3)),
    )
    together = replace(sheet(), channels=(wide, *others))
    channels = [ChannelInterpreter(together, number) for number in (1, 2, 3)]
    many = ManyChannels.side_by_side(channels, [True, True, True])
    assert many is not None
    octets = np.array(raw, dtype=">u2").view(np.uint8).reshape(len(raw), 6)
    value, valid = many.values(many.raw(octets.tobytes()))
    for column, interpreter in enumerate(channels):
        alone = interpreter.values(interpreter.reader.raw(octets[:, 2 * column : 2 * column + 2]))
        np.testing.assert_array_equal(valid[:, column], alone.valid)
        np.testing.assert_array_equal(value[:, column], alone.value * interpreter.unit.scale + interpreter.unit.offset)
    assert valid[:, 0].all()


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_every_value_that_a_channel_can_have_is_calibrated_beforehand(number: int) -> None:
    """One channel of 16 bits, some values of which lie beyond SigBits and beyond its limits.

    Steps alone, without a channel of another degree beside them, once gave their offset's multiple.
    """
    known = sheet("mN")
    first = known.channel(number)
    assert first is not None
    assert first.sample is not None
    narrow = replace(first, sample=replace(first.sample, bits=15), high=2.0)
    narrowed = ChannelInterpreter(replace(known, channels=(narrow,)), number)
    many = ManyChannels.side_by_side([narrowed], [True])
    assert many is not None
    octets = np.arange(65536).astype(">u2")
    computed = many.values(many.raw(octets.tobytes()))
    many.calibrate_all()
    value, valid = many.values(many.raw(octets.tobytes()))
    np.testing.assert_array_equal(valid, computed[1])
    np.testing.assert_array_equal(value, computed[0])
    alone = narrowed.values(narrowed.reader.raw(octets.view(np.uint8).reshape(-1, 2)))
    assert 0 < np.count_nonzero(alone.valid) < 65536
    np.testing.assert_array_equal(valid[:, 0], alone.valid)
    np.testing.assert_array_equal(value[:, 0], narrowed.unit.to_si(alone.value))


@given(st.lists(st.lists(st.integers(0, 255), min_size=4, max_size=4), min_size=1, max_size=6), st.booleans())
@settings(max_examples=30)
def test_channels_of_8_bits_are_looked_up_each_in_its_own(raw: list[list[int]], last: bool) -> None:
    known = sheet()
    small = [replace(channel, sample=SampleForm(0, 1)) for channel in known.channels[:4]]
    channels = [ChannelInterpreter(replace(known, channels=tuple(small)), number) for number in range(1, 5)]
    many = ManyChannels.side_by_side(channels, [True, True, True, last])
    assert many is not None
    many.calibrate_all()
    octets = np.array(raw, dtype=np.uint8)
    value, valid = many.values(many.raw(octets.tobytes()))
    for column, interpreter in enumerate(channels):
        alone = interpreter.values(interpreter.reader.raw(octets[:, column : column + 1]))
        usable = last or column < 3
        np.testing.assert_array_equal(valid[:, column], alone.valid & usable)
        np.testing.assert_array_equal(value[:, column], interpreter.unit.to_si(alone.value) if usable else np.nan)


def test_samples_of_three_octets_are_read_side_by_side_too() -> None:
    known = sheet()
    wide = tuple(replace(channel, sample=SampleForm(0, 3), high=1e9) for channel in known.channels[:2])
    channels = [ChannelInterpreter(replace(known, channels=wide), number) for number in (1, 2)]
    many = ManyChannels.side_by_side(channels, [True, True])
    assert many is not None
    octets = bytes.fromhex("000001 00ffff 123456 800000")
    raw = many.raw(octets)
    assert raw.tolist() == [[1, 0xFFFF], [0x123456, 0x800000]]
    assert raw.dtype == np.int64
    value, valid = many.values(raw)
    for column, interpreter in enumerate(channels):
        rows = np.frombuffer(octets, np.uint8).reshape(2, 6)[:, 3 * column : 3 * column + 3]
        alone = interpreter.values(interpreter.reader.raw(rows))
        np.testing.assert_array_equal(valid[:, column], alone.valid)
        np.testing.assert_array_equal(value[:, column], interpreter.unit.to_si(alone.value))


def test_a_curve_that_overflows_gives_no_value_and_no_warning() -> None:
    """A polynomial of degree 70 grows beyond the largest float where each part of it fits a Float32."""
    part = CalibrationInput(1, 70, (0.0, 65535.0), (0.0,))
    steep = Calibration(1, "polynomial", (part,), (*[0.0] * 70, 3e38))
    known = sheet()
    first = replace(known.channels[0], calibration=steep, low=-math.inf, high=math.inf)
    interpreter = ChannelInterpreter(replace(known, channels=(first,)), 1)
    many = ManyChannels.side_by_side([interpreter], [True])
    assert many is not None
    with np.errstate(over="raise", invalid="raise"):
        value, valid = many.values(many.raw(bytes.fromhex("0000 0001 ffff")))
    assert valid[:, 0].tolist() == [True, True, False]
    assert value[:2, 0].tolist() == [0.0, pytest.approx(3e38)]


def test_tables_are_shared_by_channels_of_one_curve_and_are_few(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(vectorized, "_MOST_TABLES", 2)
    monkeypatch.setattr(vectorized, "_TABLES", WeakValueDictionary())

    def channel(top: float) -> ManyChannels:
        first = sheet().channels[0]
        curve = replace(first, calibration=fit([(0, 0.0), (65535, top)], "linear", channel=1))
        many = ManyChannels.side_by_side([ChannelInterpreter(replace(sheet(), channels=(curve,)), 1)], [True])
        assert many is not None
        return many

    first, same, other, third = channel(2), channel(2), channel(3), channel(4)
    for many in (first, same, other, third):
        many.calibrate_all()
    assert first._known is not None
    assert same._known is first._known
    assert other._known is not None
    assert third._known is None
    value, _ = third.values(third.raw(b"\xff\xff"))
    assert value[0, 0] == pytest.approx(4)
    del other, many
    third.calibrate_all()
    assert third._known is not None


def test_channels_of_other_forms_stay_alone() -> None:
    known = sheet()
    channels = [ChannelInterpreter(known, number) for number in (1, 2)]
    assert ManyChannels.side_by_side(channels, [True, True]) is not None
    (first, *rest) = known.channels
    wider = replace(known, channels=(replace(first, sample=SampleForm(0, 3), calibration=None), *rest))
    assert ManyChannels.side_by_side([ChannelInterpreter(wider, number) for number in (1, 2)], [True, True]) is None
    floats = replace(known, channels=(replace(first, sample=SampleForm(1, 4), calibration=None), *rest))
    assert ManyChannels.side_by_side([ChannelInterpreter(floats, 1)], [True]) is None


@given(st.lists(st.floats(allow_nan=False) | st.sampled_from([0.0, 1.0, 2.5]), max_size=12))
def test_numbers_are_ordered_and_each_stands_once(numbers: list[float]) -> None:
    assert list(without_repeats(np.array(numbers))) == sorted(set(numbers))


def test_a_curve_and_its_inverse_load_no_masked_arrays() -> None:
    """``numpy.unique`` loads them: 40 ms of CPU in the middle of a provisioning."""
    code = """
import sys
from teds_provision.teds.calibration import fit
from teds_provision.teds.calibration.formula import PreparedCurve, PreparedInverse
from teds_provision.teds.curve import _spread
calibration = fit([(0, 0.0), (100, 5.0), (200, 20.0)], "table", channel=1)
PreparedInverse(PreparedCurve(calibration), 0.0, 200.0)
assert len(_spread((0.0, 200.0), 0.0, 200.0, 50, True))
print("numpy" in sys.modules, "numpy.ma" in sys.modules)
"""
    assert python(code).out == "True False\n"


def test_temperatures_in_several_units_stand_side_by_side() -> None:
    """Each with its own zero, on the way to the unit of its channel and from there to kelvins."""
    (own,) = sheet_of("temperature-sensor").channels
    odd = WrittenUnit("(× 0.5 K + 100 K)", parse_unit("K").units, 0.5, 100.0)  # shown in degrees Celsius
    units = (parse_unit("degC"), parse_unit("degF"), parse_unit("K"), odd)
    channels = []
    for number, unit in enumerate(units, 1):
        ends = [(0, unit.from_si(250.0)), (65535, unit.from_si(390.0))]
        curve = replace(fit(ends, "linear", channel=number), unit=unit)
        channels.append(replace(own, number=number, calibration=curve, sample=SampleForm(0, 2)))
    known = replace(sheet(), channels=tuple(channels))
    many = ManyChannels.side_by_side([ChannelInterpreter(known, number) for number in (1, 2, 3, 4)], [True] * 4)
    assert many is not None
    value, valid = many.values(np.array([[0] * 4, [65535] * 4]))
    assert valid.all()
    assert value == pytest.approx(np.array([[250.0] * 4, [390.0] * 4]), abs=1e-3)
