"""From octets to values and back: data models, calibrations, limits, and the way back for actuators and simulations."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from fractions import Fraction
from itertools import product

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds import AccessCode, Sheet
from teds_provision.teds.calibration import (
    Calibration,
    CalibrationInput,
    ChannelInterpreter,
    PreparedCurve,
    PreparedInverse,
    SampleReader,
    evaluate,
    fit,
)
from teds_provision.teds.calibration.samples import DataModel, SampleForm
from teds_provision.teds.channel import ChannelKind
from teds_provision.teds.image import BlockId, Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.units import WrittenUnit, parse_unit

UUID = bytes(10)
Blocks = dict[BlockId, bytes]


def blocks_of(profile: str, calibrations: dict[int, Calibration] | None = None) -> Blocks:
    return dict(load_profile(profile).build(UUID, calibration=calibrations or {}).blocks)


def sheet_of(profile: str, calibrations: dict[int, Calibration] | None = None) -> Sheet:
    return Sheet.from_image(Image(UUID, blocks_of(profile, calibrations)))


def changed(sheet: Sheet, number: int = 1, **more: object) -> Sheet:
    """Return the same sheet with another channel."""
    channels = tuple(replace(c, **more) if c.number == number else c for c in sheet.channels)  # type: ignore[arg-type]
    return replace(sheet, channels=channels)


FORMS = st.one_of(
    st.builds(SampleForm, st.just(0), st.integers(1, 8), st.integers(0, 70)),
    st.builds(SampleForm, st.just(3), st.integers(1, 8), st.integers(0, 70)),
    st.builds(SampleForm, st.just(4), st.integers(1, 12), st.just(0)),
    st.builds(SampleForm, st.sampled_from([5, 6]), st.integers(9, 255), st.integers(0, 2100)),
    st.sampled_from([SampleForm(1, 4), SampleForm(2, 8), SampleForm(7, 8)]),
)


def one_number(form: SampleForm, octets: bytes) -> float:
    """Return what one sample means, written down as the contract has it."""
    whole = int.from_bytes(octets, "big")
    match form.model:
        case 1:
            return float(struct.unpack(">f", octets)[0])
        case 2:
            return float(struct.unpack(">d", octets)[0])
        case 3 | 6:
            return float(Fraction(whole, 1 << 8 * len(octets)))
        case 7:
            value = int.from_bytes(octets[:4], "big") + (int.from_bytes(octets[4:], "big") & 0x7FFFFFFF) * 1e-9
            return -value if octets[4] & 0x80 else value
        case _:
            try:
                return float(whole)
            except OverflowError:
                return math.inf


@settings(max_examples=300, deadline=None)
@given(form=FORMS, data=st.data())
def test_every_octet_string_reads_as_the_contract_says(form: SampleForm, data: st.DataObject) -> None:
    samples = data.draw(st.lists(st.binary(min_size=form.octets, max_size=form.octets), max_size=5))
    reader = SampleReader(form)
    numbers, possible = reader.numbers(reader.raw(b"".join(samples)))
    expected = np.array([one_number(form, octets) for octets in samples])
    np.testing.assert_array_equal(numbers, expected)
    most = form.raw_range[1] if form.integer and form.raw_range else math.inf
    assert possible.tolist() == [math.isfinite(x) and x <= most for x in expected.tolist()]


@pytest.mark.parametrize("bits", [0, 1, 12, 15, 16])
def test_of_an_integer_every_number_of_its_bits_is_possible_and_none_above(bits: int) -> None:
    reader = SampleReader(SampleForm(DataModel.UNSIGNED, 2, bits))
    most = (1 << (bits or 16)) - 1
    samples = [0, most, min(most + 1, 0xFFFF)]
    possible = reader.numbers(reader.raw(b"".join(number.to_bytes(2, "big") for number in samples)))[1]
    assert possible.tolist() == [True, True, most == 0xFFFF]


def test_a_block_may_come_as_rows_of_a_larger_message() -> None:
    reader = SampleReader(SampleForm(DataModel.UNSIGNED, 2))
    body = np.frombuffer(bytes.fromhex("aa 0001 bb 0203 aa 0004 bb 0506"), dtype=np.uint8).reshape(-1, 6)
    assert reader.raw(body[:, 1:3]).tolist() == [1, 4]
    assert reader.raw(body[:, 4:6]).tolist() == [0x0203, 0x0506]
    with pytest.raises(BadDataError, match="3 octets"):
        reader.raw(b"abc")
    with pytest.raises(BadDataError, match="3 octets"):
        reader.raw(body[:, :3])


@pytest.mark.parametrize(
    ("form", "number", "octets"),
    [
        (SampleForm(0, 2), 4660.4, "1234"),
        (SampleForm(0, 2), -5, "0000"),
        (SampleForm(0, 2, 12), 70000, "0fff"),
        (SampleForm(0, 3), 1.5, "000002"),
        (SampleForm(0, 8), 1e30, "ff" * 8),
        (SampleForm(5, 9), 2.0**65, "020000000000000000"),
        (SampleForm(1, 4), 1e300, "7f7fffff"),
        (SampleForm(2, 8), -1.5, "bff8000000000000"),
        (SampleForm(3, 2), 0.5, "8000"),
        (SampleForm(3, 2), 1.0, "ffff"),
        (SampleForm(3, 2, 4), 0.26, "4000"),
        (SampleForm(6, 9), 0.25, "400000000000000000"),
    ],
)
def test_numbers_are_written_rounded_and_kept_within_what_the_form_can_hold(
    form: SampleForm, number: float, octets: str
) -> None:
    assert SampleReader(form).write(np.array([number])).hex() == octets


@pytest.mark.parametrize(
    ("octets", "seconds"),
    [
        ("00000001 1dcd6500", 1.5),
        ("00000001 9dcd6500", -1.5),
        ("00000000 80000000", 0.0),
        ("ffffffff 00000001", 4294967295.000000001),
    ],
)
def test_a_time_of_day_may_lie_before_1970(octets: str, seconds: float) -> None:
    """The highest bit of the nanoseconds is the sign of the whole."""
    assert SampleReader(SampleForm(DataModel.TIME_OF_DAY, 8)).raw(bytes.fromhex(octets)).tolist() == [seconds]


def test_what_is_no_quantity_is_not_written_and_what_cannot_be_read_is_refused() -> None:
    for form in (SampleForm(4, 1), SampleForm(7, 8)):
        with pytest.raises(BadDataError):
            SampleReader(form).write(np.array([1.0]))
    with pytest.raises(BadDataError, match="reserved"):
        SampleReader(SampleForm(77, 1))
    with pytest.raises(BadDataError, match="not finite"):
        SampleReader(SampleForm(1, 4)).write(np.array([math.nan]))


@st.composite
def calibrations(draw: st.DrawFn, inputs: int) -> Calibration:
    parts = []
    for number in range(1, inputs + 1):
        degree, segments = draw(st.integers(0, 3)), draw(st.integers(1, 4))
        edges = sorted(draw(st.sets(st.integers(0, 65535), min_size=segments + 1, max_size=segments + 1)))
        offsets = draw(st.lists(st.integers(0, 65535), min_size=segments, max_size=segments))
        parts.append(CalibrationInput(number, degree, tuple(map(float, edges)), tuple(map(float, offsets))))
    count = math.prod(part.segments * (part.degree + 1) for part in parts)
    numbers = st.floats(-8, 8, width=32)
    coefficients = draw(st.lists(numbers, min_size=count, max_size=count))
    return Calibration(1, "polynomial", tuple(parts), tuple(coefficients), zero_offset=draw(numbers))


def by_hand(calibration: Calibration, *inputs: float) -> Fraction:
    """Return the formula of teds.md ("5 CalTEDS") in exact arithmetic, written down once more."""
    cell, distances = 0, []
    for part, value in zip(calibration.inputs, inputs, strict=True):
        segment = sum(1 for edge in part.boundaries[1:-1] if value >= edge)
        cell = cell * part.segments + segment
        distances.append(Fraction(value) - Fraction(part.offsets[segment]))
    powers = list(product(*(range(part.degree + 1) for part in calibration.inputs)))
    total = Fraction(calibration.zero_offset)
    for place, exponents in enumerate(powers):
        term = Fraction(calibration.coefficients[cell * len(powers) + place])
        for distance, exponent in zip(distances, exponents, strict=True):
            term *= distance**exponent
        total += term
    return total


@settings(max_examples=200, deadline=None)
@given(calibration=st.integers(1, 2).flatmap(calibrations), data=st.data())
def test_blocks_give_what_one_value_gives_and_what_exact_arithmetic_gives(
    calibration: Calibration, data: st.DataObject
) -> None:
    count = data.draw(st.integers(1, 6))
    octets = [data.draw(st.binary(min_size=2 * count, max_size=2 * count)) for _ in calibration.inputs]
    arrays = [np.frombuffer(part, dtype=">u2").astype(np.float64) for part in octets]
    values = PreparedCurve(calibration)(*arrays)
    for place in range(count):
        inputs = [float(array[place]) for array in arrays]
        assert values[place] == evaluate(calibration, *inputs).value
        exact = by_hand(calibration, *inputs)
        size = sum(abs(c) for c in calibration.coefficients) * 65535.0 ** sum(p.degree for p in calibration.inputs) + 8
        assert abs(Fraction(float(values[place])) - exact) <= Fraction(size) * Fraction(2) ** -45


@settings(max_examples=100, deadline=None)
@given(octets=st.binary(min_size=2, max_size=40).filter(lambda b: len(b) % 2 == 0))
def test_the_interpreter_gives_what_evaluate_gives_on_every_octet_string(octets: bytes) -> None:
    interpreter = ChannelInterpreter(LESS_THAN_A_TURN, 1)
    values = interpreter.decode(octets)
    for raw, value, valid in zip(values.raw.tolist(), values.value.tolist(), values.valid.tolist(), strict=True):
        expected = evaluate(TABLE, float(raw)).value
        low, high = interpreter.limits
        within = low - interpreter.uncertainty <= expected <= high + interpreter.uncertainty  # type: ignore[operator]
        assert valid == within
        assert value == expected if valid else math.isnan(value)


TABLE = replace(
    fit([(n * 1000, (n * 1000 * 370 / 65536) ** 1.0001) for n in range(66)], "table", channel=1),
    unit=parse_unit("degree"),
    uncertainty=0.5,
)
ANGLE = sheet_of("magnetic-angular-position-sensor", {1: TABLE})
LESS_THAN_A_TURN = changed(ANGLE, high=math.radians(359.9))


def test_limits_and_uncertainty_are_stated_in_the_unit_of_the_values() -> None:
    interpreter = ChannelInterpreter(ANGLE, 1)
    assert interpreter.unit.text in ("°", "degree")
    assert interpreter.uncertainty == pytest.approx(0.5)
    assert interpreter.limits == pytest.approx((0.0, 360.0))
    assert interpreter.octets == 2
    assert interpreter.inputs == (1,)


def test_an_uncertainty_in_degrees_celsius_is_a_difference_and_widens_the_limits_by_itself() -> None:
    part = CalibrationInput(1, 1, (0.0, 21120.0), (0.0,))
    line = Calibration(1, "linear", (part,), (-41.0, 1 / 128), unit=parse_unit("degC"), uncertainty=0.75)
    for calibration, uncertainty, valid in (
        (line, 0.75, [False, True]),
        (replace(line, uncertainty=None), 0.5, [False, False]),
    ):
        interpreter = ChannelInterpreter(sheet_of("temperature-sensor", {1: calibration}), 1)
        assert interpreter.uncertainty == pytest.approx(uncertainty)
        raws = np.array([0, 50], dtype=np.uint64)  # -41 and -40.61 degC
        assert interpreter.values(raws).valid.tolist() == valid


@pytest.mark.parametrize(
    ("own", "limits"),
    [
        ((10.0, 20.0), (10.0, 20.0)),
        ((-10.0, 400.0), (0.0, 360.0)),
        ((None, 20.0), (0.0, 20.0)),
        ((10.0, None), (10.0, 360.0)),
    ],
)
def test_the_narrower_limits_of_channel_and_calibration_count(
    own: tuple[float | None, float | None], limits: tuple[float, float]
) -> None:
    calibration = ANGLE.channels[0].calibration
    assert calibration is not None
    narrowed = changed(ANGLE, calibration=replace(calibration, low_limit=own[0], high_limit=own[1]))
    assert ChannelInterpreter(narrowed, 1).limits == pytest.approx(limits)


def test_a_value_beyond_the_limits_by_more_than_the_uncertainty_is_not_valid() -> None:
    interpreter = ChannelInterpreter(LESS_THAN_A_TURN, 1)
    raws = np.array([0, 63750, 65000], dtype=np.uint64)
    values = interpreter.values(raws)
    assert values.valid.tolist() == [True, True, False]
    assert 359.9 < values.value[1] < 360.4
    assert math.isnan(values.value[2])
    assert values.raw is raws
    assert interpreter.why_invalid(raws) == {"above its high limit, 359.9 °": 1}


def turned(zero: float, low: float = 0.0, counts: int = 4096) -> Sheet:
    """Return the second paper's angle sensor, ``counts`` to a turn, its scale turned by ``zero`` degrees."""
    ends = [(0, 0.0), (counts, 360.0)]
    line = replace(fit(ends, "linear", channel=1), unit=parse_unit("degree"), uncertainty=0.5, zero_offset=zero)
    sheet = sheet_of("magnetic-angular-position-sensor", {1: line})
    return changed(sheet, low=low, high=low + 2 * math.pi, sample=SampleForm(DataModel.UNSIGNED, 2, 12))


@pytest.mark.parametrize("low", [0.0, -math.pi])
@given(zero=st.floats(-1000, 1000), raw=st.integers(0, 4095))
def test_every_angle_of_a_full_turn_is_valid_for_every_zero(low: float, zero: float, raw: int) -> None:
    interpreter = ChannelInterpreter(turned(zero, low), 1)
    values = interpreter.values(np.array([raw], dtype=np.uint64))
    assert values.valid.all()
    begin, end = interpreter.limits
    assert begin <= values.value[0] < end
    off = values.value[0] - (raw * 360 / 4096 + np.float32(zero))
    assert abs(off - 360 * round(off / 360)) < 1e-3
    assert interpreter.why_invalid(np.array([raw], dtype=np.uint64)) == {}


@given(zero=st.floats(-1000, 1000), angle=st.floats(-720, 720))
def test_an_angle_finds_its_way_back_across_the_wrap(zero: float, angle: float) -> None:
    interpreter = ChannelInterpreter(turned(zero), 1)
    value = interpreter.decode(interpreter.encode(angle)).value[0]
    off = value - angle
    assert abs(off - 360 * round(off / 360)) < 360 / 4096


@pytest.mark.parametrize(
    ("angle", "raw"),
    [
        (10.0, 0),
        (350.0, 4095),
        (180.05, 2048),
        (5.0, 0),
        (355.0, 4095),
        (0.1, 0),
        (359.9, 4095),
        (370.0, 0),
        (-10.0, 4095),
    ],
)
def test_an_angle_that_a_sensor_does_not_reach_is_nearest_to_one_of_its_ends(angle: float, raw: int) -> None:
    """Its raw values cover 10 to 350 degrees of the turn; between 350 and 10 the nearer end counts."""
    line = replace(fit([(0, 10.0), (4095, 350.0)], "linear", channel=1), unit=parse_unit("degree"))
    sheet = sheet_of("magnetic-angular-position-sensor", {1: line})
    sheet = changed(sheet, low=0.0, high=2 * math.pi, sample=SampleForm(DataModel.UNSIGNED, 2, 12))
    assert ChannelInterpreter(sheet, 1).encode(angle) == raw.to_bytes(2, "big")


def test_a_turn_is_two_pi_to_a_hundred_thousandth_and_of_sensors_of_angles_alone() -> None:
    known = turned(90.0).channel(1)
    assert known is not None
    for high, more, full in (
        (2 * math.pi + 0.9e-5, {}, True),
        (2 * math.pi + 1.1e-5, {}, False),
        (2 * math.pi - 0.9e-5, {}, True),
        (2 * math.pi, {"units": parse_unit("m").units}, False),
        (2 * math.pi, {"kind": ChannelKind.ACTUATOR}, False),
        (math.nan, {}, False),
    ):
        assert replace(known, high=high, **more).full_turn is full  # type: ignore[arg-type]


def test_what_is_not_valid_says_why() -> None:
    part = CalibrationInput(1, 1, (10.0, 3000.0), (0.0,))
    line = Calibration(1, "linear", (part,), (-1.0, 0.05), unit=parse_unit("degree"))
    sheet = sheet_of("magnetic-angular-position-sensor", {1: line})
    sheet = changed(sheet, sample=SampleForm(0, 2, 12), high=math.radians(120), low=math.radians(1), uncertainty=0.0)
    interpreter = ChannelInterpreter(sheet, 1)
    raws = np.array([5, 15, 15, 100, 2600, 3500, 4096], dtype=np.uint64)
    assert interpreter.why_invalid(raws) == {
        "the raw value is none that the channel can give": 1,
        "beyond the calibrated range": 2,
        "below its low limit, 1 °": 2,
        "above its high limit, 120 °": 1,
    }
    assert interpreter.values(raws).valid.tolist() == [False, False, False, True, False, False, False]
    without = ChannelInterpreter(sheet_of("magnetic-angular-position-sensor"), 1)
    assert without.why_invalid(raws) == {without.problem.removesuffix("."): 7}


def test_a_raw_value_beyond_its_bits_is_not_valid_and_beyond_its_points_is_marked() -> None:
    part = CalibrationInput(1, 1, (10.0, 3000.0), (0.0,))
    line = Calibration(1, "linear", (part,), (0.0, 0.05), unit=parse_unit("degree"))
    sheet = changed(sheet_of("magnetic-angular-position-sensor", {1: line}), sample=SampleForm(0, 2, 12))
    values = ChannelInterpreter(sheet, 1).values(np.array([5, 100, 3500, 4096], dtype=np.uint64))
    assert values.valid.tolist() == [True, True, True, False]
    assert values.extrapolated.tolist() == [True, False, True, True]


def test_a_calibration_alone_is_neither_wrapped_nor_limited_and_only_a_sensors() -> None:
    part = CalibrationInput(1, 1, (0.0, 1000.0), (0.0,))
    line = Calibration(1, "linear", (part,), (0.0, 1.0), unit=parse_unit("degree"))
    sheet = changed(sheet_of("magnetic-angular-position-sensor", {1: line}), sample=SampleForm(0, 2, 12))
    value, possible, outside = ChannelInterpreter(sheet, 1).calibrated(np.array([10, 1001, 5000], dtype=np.uint64))
    assert value.tolist() == [10.0, 1001.0, 5000.0]
    assert (possible.tolist(), outside.tolist()) == ([True, True, False], [False, True, True])
    raws = np.array([1], dtype=np.uint64)
    # a profile is not asked for: floats speak for themselves, and have no calibration
    floats = ChannelInterpreter(changed(sheet_of("magnetic-angular-position-sensor"), sample=SampleForm(1, 4)), 1)
    for interpreter in (floats, ChannelInterpreter(actuator(), 1)):
        assert interpreter.problem == ""
        with pytest.raises(BadDataError, match=r"^Channel 1 has no calibration of a sensor\.$"):
            interpreter.calibrated(raws)


def test_a_channel_without_calibration_gives_raw_values_alone_and_says_why() -> None:
    interpreter = ChannelInterpreter(sheet_of("magnetic-angular-position-sensor"), 1)
    assert "no calibration" in interpreter.problem
    values = interpreter.decode(bytes.fromhex("12340001"))
    assert values.raw.tolist() == [0x1234, 1]
    assert not values.valid.any()
    assert np.isnan(values.value).all()
    with pytest.raises(BadDataError, match="no calibration"):
        interpreter.encode(1.0)


def test_floats_counts_and_bits_speak_for_themselves() -> None:
    angle = sheet_of("magnetic-angular-position-sensor")
    floats = ChannelInterpreter(changed(angle, sample=SampleForm(DataModel.FLOAT32, 4)), 1)
    assert floats.problem == ""
    values = floats.decode(struct.pack(">3f", math.pi, 1.75 * math.pi, math.nan))
    assert values.value[:2] == pytest.approx([180.0, 315.0])
    assert values.valid.tolist() == [True, True, False]
    assert floats.encode(180.0) == struct.pack(">f", math.pi)
    counts = changed(angle, units=teds.Units(), sample=SampleForm(DataModel.UNSIGNED, 2), low=math.nan, high=math.nan)
    assert ChannelInterpreter(counts, 1).decode(bytes.fromhex("0102")).value.tolist() == [258.0]


def test_a_compensated_channel_asks_for_its_other_input() -> None:
    inputs = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    both = Calibration(1, "polynomial", inputs, (0.0, 0.001, 0.0001, 0.0), unit=parse_unit("N"))
    sheet = sheet_of("tactile-finger-sensor", {1: both})
    interpreter = ChannelInterpreter(sheet, 1)
    assert interpreter.others == (2,)
    own, other = np.array([5000, 6000], dtype=">u2").tobytes(), np.array([10, 20], dtype=">u2").tobytes()
    values = interpreter.decode(own, {2: other})
    assert values.value.tolist() == [evaluate(both, 5000, 10).value, evaluate(both, 6000, 20).value]
    for others in (None, {}, {2: other[:2]}, {2: other + other}):
        with pytest.raises(BadDataError, match=r"^Channel 1 is compensated by channel 2, which is not given\.$"):
            interpreter.decode(own, others)
    back = interpreter.encode(values.value, {2: np.array([10, 20], dtype=np.uint64)})
    assert back == own
    assert "not described" in ChannelInterpreter(replace(sheet, channels=sheet.channels[:1]), 1).problem


def test_a_compensated_channel_may_be_any_input_of_its_curve() -> None:
    """In the order of the inputs, forwards and back; what compensates it may be impossible or beyond its range too."""
    inputs = (CalibrationInput(2, 1, (0, 1000), (0,)), CalibrationInput(1, 1, (0, 65535), (0,)))
    both = Calibration(1, "polynomial", inputs, (0.0, 0.001, 0.0002, 0.0), unit=parse_unit("N"))
    sheet = changed(sheet_of("tactile-finger-sensor", {1: both}), 2, sample=SampleForm(DataModel.UNSIGNED, 2, 12))
    interpreter = ChannelInterpreter(sheet, 1)
    assert (interpreter.inputs, interpreter.others) == ((2, 1), (2,))
    own = np.array([5000, 5000, 5000, 5000], dtype=np.uint64)
    other = {2: np.array([10, 1000, 1001, 4096], dtype=np.uint64)}
    values = interpreter.values(own, other)
    assert values.value[:3] == pytest.approx([5.002, 5.2, 5.2002], abs=1e-6)
    assert values.valid.tolist() == [True, True, True, False]
    assert values.extrapolated.tolist() == [False, False, True, True]
    back = interpreter.encode(values.value[:3], {2: other[2][:3]})
    assert back == bytes.fromhex("1388" * 3)


@pytest.mark.parametrize(("slope", "raws"), [(0.05, [0.0, 200.0, 2000.0, 4000.0, 4095.0]), (-0.05, [4095.0, 3.0])])
def test_the_way_back_goes_on_beyond_the_outer_boundaries_as_the_curve_does(slope: float, raws: list[float]) -> None:
    """The end segments hold there, up to the ends between which the input is searched."""
    part = CalibrationInput(1, 1, (1000.0, 2000.0, 3000.0), (1000.0, 2000.0))
    spline = Calibration(1, "table", (part,), (50.0, slope, 50 + 1000 * slope, 2 * slope), zero_offset=7.0)
    curve = PreparedCurve(spline)
    inverse = PreparedInverse(curve, 0.0, 4095.0, step=0.25)
    assert inverse(curve(np.array(raws))).tolist() == pytest.approx(raws)


def actuator(calibration: Calibration | None = None) -> Sheet:
    sheet = sheet_of("gripper")
    number = next(channel.number for channel in sheet.channels if channel.actuator)
    own = sheet.channel(number)
    assert own is not None
    if calibration is None:
        low, high = own.unit.from_si(own.low), own.unit.from_si(own.high)
        part = CalibrationInput(number, 1, (low, high), (low,))
        calibration = Calibration(number, "linear", (part,), (0.0, 4000 / (high - low)), unit=own.unit, actuator=True)
    return Sheet.from_image(Image(UUID, blocks_of("gripper", {number: calibration})))


def test_an_actuator_is_set_within_its_limits_and_read_back() -> None:
    sheet = actuator()
    number = next(channel.number for channel in sheet.channels if channel.actuator)
    interpreter = ChannelInterpreter(sheet, number)
    low, high = interpreter.limits
    middle = (low + high) / 2
    assert int.from_bytes(interpreter.encode(middle), "big") == 2000
    assert int.from_bytes(interpreter.encode(high * 3), "big") == 4000
    assert interpreter.decode(interpreter.encode(middle)).value[0] == pytest.approx(middle)
    assert interpreter.beyond(middle) == ""
    assert "exceeds the limits" in interpreter.beyond(high * 1.01)
    assert interpreter.beyond(math.nan)
    with pytest.raises(BadDataError, match="not finite"):
        interpreter.encode(math.nan)


def bent_actuator(falling: bool, **more: object) -> tuple[ChannelInterpreter, PreparedCurve]:
    """An actuator with a curve that is not straight, calibrated over the middle half of its limits alone."""
    number = next(channel.number for channel in sheet_of("gripper").channels if channel.actuator)
    own = sheet_of("gripper").channel(number)
    assert own is not None
    low, high = own.unit.from_si(own.low), own.unit.from_si(own.high)
    span, way = high - low, -1 if falling else 1
    coefficients = (4010.0 if falling else 10.0, way * 2000 / span, way * 2000 / span**2)
    part = CalibrationInput(number, 2, (low + span / 4, high - span / 4), (low,))
    calibration = Calibration(number, "polynomial", (part,), coefficients, unit=own.unit, actuator=True)
    sheet = changed(actuator(calibration), number, **more)
    return ChannelInterpreter(sheet, number), PreparedCurve(calibration)


@pytest.mark.parametrize("falling", [False, True])
def test_the_raw_set_point_of_an_actuator_is_searched_up_to_both_limits(falling: bool) -> None:
    interpreter, curve = bent_actuator(falling)
    low, high = interpreter.limits
    raws = np.array([10, 1000, 4010], dtype=np.uint64)
    back = interpreter.values(raws if not falling else raws[::-1]).value
    assert back[[0, 2]].tolist() == pytest.approx([low, high], abs=1e-6 * (high - low))
    assert curve(back[1:2]).tolist() == pytest.approx([1000]), "as close as the curve gives it, whatever the unit"
    beyond = interpreter.values(np.array([0, 4095], dtype=np.uint64)).value
    assert beyond.tolist() == pytest.approx([high, low] if falling else [low, high])


@pytest.mark.parametrize("open_end", ["low", "high"])
def test_an_actuator_without_one_of_its_limits_is_read_back_within_its_calibration(open_end: str) -> None:
    interpreter, curve = bent_actuator(False, **{open_end: math.nan})
    assert interpreter.channel.calibration is not None
    low, high = interpreter.channel.calibration.inputs[0].boundaries
    middle = (low + high) / 2
    back = interpreter.values(np.rint(curve(np.array([low, middle, high]))).astype(np.uint64))
    assert back.valid.all()
    assert back.value.tolist() == pytest.approx([low, middle, high], rel=1e-3)


def test_an_actuator_whose_curve_turns_can_be_set_but_not_read_back() -> None:
    number = next(channel.number for channel in sheet_of("gripper").channels if channel.actuator)
    own = sheet_of("gripper").channel(number)
    assert own is not None
    low, high = own.unit.from_si(own.low), own.unit.from_si(own.high)
    part = CalibrationInput(number, 2, (low, high), ((low + high) / 2,))
    bent = Calibration(number, "polynomial", (part,), (100.0, 0.0, 5.0), unit=own.unit, actuator=True)
    interpreter = ChannelInterpreter(actuator(bent), number)
    assert len(interpreter.encode(high)) == interpreter.octets
    assert not interpreter.decode(interpreter.encode(high)).valid.any()


@settings(max_examples=150, deadline=None)
@given(
    steps=st.lists(st.floats(0.01, 10), min_size=2, max_size=8),
    falling=st.booleans(),
    cubic=st.booleans(),
    data=st.data(),
)
def test_the_way_back_gives_the_raw_value_that_it_came_from(
    steps: list[float], falling: bool, cubic: bool, data: st.DataObject
) -> None:
    values = np.cumsum(steps)
    points = list(zip(np.linspace(0, 65535, len(values)).round().tolist(), values.tolist(), strict=True))
    if falling:
        points = [(raw, -value) for raw, value in points]
    curve = PreparedCurve(fit(points, "polynomial" if cubic else "table", channel=1))
    try:
        inverse = PreparedInverse(curve, 0.0, 65535.0, step=0.25)
    except BadDataError:
        assume(not cubic)  # a polynomial through such points may turn
        raise
    raws = np.array(data.draw(st.lists(st.integers(0, 65535), min_size=1, max_size=5)), dtype=np.float64)
    found = inverse(curve(raws))
    slack = 8 * 2.0**-23 * float(np.abs(curve(raws)).max())
    assert np.all((np.abs(found - raws) <= 0.26) | (np.abs(curve(found) - curve(raws)) <= slack))
    beyond = inverse(np.array([-1e9, 1e9]))
    assert sorted(beyond.tolist()) == pytest.approx([0.0, 65535.0], abs=0.26)


def test_a_calibration_in_a_unit_without_a_name_is_shown_in_the_usual_one() -> None:
    odd = replace(TABLE, unit=WrittenUnit("(× 0.1 rad)", TABLE.unit.units, 0.1), coefficients=TABLE.coefficients)
    blocks = blocks_of("magnetic-angular-position-sensor")
    blocks[1, AccessCode.CALIBRATION] = teds.compose(AccessCode.CALIBRATION, replace(odd, uncertainty=0.1).fields())
    interpreter = ChannelInterpreter(Sheet.from_blocks(blocks), 1)
    assert interpreter.unit.text == "°"
    shown = interpreter.decode(bytes.fromhex("0100")).value[0]
    assert shown == pytest.approx(math.degrees(evaluate(odd, 256.0).value * 0.1))
    assert interpreter.uncertainty == pytest.approx(math.degrees(0.01))


def test_a_temperature_in_a_unit_without_a_name_is_shown_in_degrees_celsius() -> None:
    """The zero point of the shown unit is taken off in kelvins, before its scale."""
    blocks = blocks_of("temperature-sensor")
    part = CalibrationInput(1, 1, (0, 4096), (0,))
    odd = Calibration(1, "linear", (part,), (500.0, 0.25), unit=WrittenUnit("(× 0.5 K)", parse_unit("K").units, 0.5))
    blocks[1, AccessCode.CALIBRATION] = teds.compose(AccessCode.CALIBRATION, odd.fields())
    interpreter = ChannelInterpreter(Sheet.from_blocks(blocks), 1)
    assert interpreter.unit.text == "°C"
    octets = (400).to_bytes(interpreter.reader.form.octets, "big")
    assert interpreter.decode(octets).value[0] == pytest.approx(0.5 * (500 + 100) - 273.15)


def test_what_is_not_described_is_refused() -> None:
    with pytest.raises(BadDataError, match="no channel 9"):
        ChannelInterpreter(ANGLE, 9)
    with pytest.raises(BadDataError, match="how a sample"):
        ChannelInterpreter(changed(ANGLE, sample=None), 1)


@pytest.mark.parametrize(
    ("profile", "low", "high"), [("load-cell", -500.0, 500.0), ("temperature-sensor", -40.0, 125.0)]
)
def test_values_far_beyond_a_turn_find_their_way_back_where_nothing_wraps(
    profile: str, low: float, high: float
) -> None:
    ends = SampleReader(sheet_of(profile).channels[0].sample or SampleForm(0, 2)).form.raw_range
    assert ends is not None
    line = fit([(ends[0], low), (ends[1], high)], "linear", channel=1)
    interpreter = ChannelInterpreter(sheet_of(profile, {1: replace(line, unit=sheet_of(profile).channels[0].unit)}), 1)
    values = np.linspace(*interpreter.limits, 9)[1:-1]
    step = (high - low) / (ends[1] - ends[0])
    assert interpreter.decode(interpreter.encode(values)).value.tolist() == pytest.approx(values.tolist(), abs=step)
    assert interpreter.given == (pytest.approx(low), pytest.approx(high))


@pytest.mark.parametrize("values", [[1.0, math.nan], [math.nan, math.nan], [math.nan]])
def test_no_block_with_a_value_that_is_none_is_sent(values: list[float]) -> None:
    calibration = fit([(0, 0.0), (65535, 10.0)], "linear", channel=1)
    interpreter = ChannelInterpreter(
        sheet_of("tactile-finger-sensor", {1: replace(calibration, unit=parse_unit("N"))}), 1
    )
    assert interpreter.encode(1.0) == bytes.fromhex("199a")
    with pytest.raises(BadDataError, match=r"^A value of channel 1 is not finite\.$"):
        interpreter.encode(np.array(values))


def test_a_refused_set_point_is_stated_in_the_unit_that_was_written() -> None:
    interpreter = ChannelInterpreter(actuator(), 1)
    assert interpreter.beyond(interpreter.limits[1]) == interpreter.beyond(interpreter.limits[0]) == ""
    too_far = interpreter.unit.from_si(0.2)
    assert interpreter.beyond(too_far, parse_unit("cm")) == (
        "20 cm exceeds the limits of channel 1 (opening set point), 0 to 11 cm."
    )
    assert interpreter.beyond(too_far).startswith("0.2 m exceeds the limits of channel 1")
    backwards = replace(parse_unit("cm"), text="x", scale=-0.01)
    assert "-20 x exceeds the limits of channel 1 (opening set point), -11 to " in interpreter.beyond(
        too_far, backwards
    )
    low, high = interpreter.limits
    assert interpreter.beyond(high * (1 + 2e-7)) == "", "within the rounding of a Float32"
    for beyond in (high * (1 + 1e-5), low - 1e-3, math.inf, -math.inf, math.nan):
        assert interpreter.beyond(beyond) != "", beyond


def test_what_a_compensated_channel_needs_is_named_on_the_way_back() -> None:
    gain = 10 / 65535
    parts = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    both = Calibration(1, "polynomial", parts, (0.0, 0.0, gain, 0.0), unit=parse_unit("N"))
    interpreter = ChannelInterpreter(sheet_of("tactile-finger-sensor", {1: both}), 1)
    assert interpreter.given is None
    for others in (None, {}):
        with pytest.raises(BadDataError, match=r"^Channel 1 is compensated by channel 2, which is not given\.$"):
            interpreter.encode(5.0, others)
    other = {2: np.array([7], dtype=np.uint64)}
    assert int.from_bytes(interpreter.encode(5.0, other), "big") == pytest.approx(32768, abs=1)


def test_a_curve_in_another_unit_than_the_channels_is_converted_with_its_zero() -> None:
    """212 °F are 100 °C and 373.15 K; and the way back."""
    line = replace(fit([(0, -40.0), (32767, 287.67)], "linear", channel=1), unit=parse_unit("degF"))
    interpreter = ChannelInterpreter(sheet_of("temperature-sensor", {1: line}), 1)
    found = interpreter.values(np.array([25200], dtype=np.uint64))
    assert found.valid.all()
    assert interpreter.unit.to_si(float(found.value[0])) == pytest.approx(373.15, abs=1e-3)
    assert int.from_bytes(interpreter.encode(found.value), "big") == 25200
    assert interpreter.given == pytest.approx(tuple(interpreter.unit.from_si(k) for k in (233.15, 415.19)), abs=0.01)


@pytest.mark.parametrize(
    ("sample", "why"),
    [
        (SampleForm(1, 3), "has samples that cannot be read"),
        (None, "has samples that cannot be read"),
        (..., "is not described"),
    ],
)
def test_a_channel_that_compensates_must_be_described_and_readable(sample: object, why: str) -> None:
    parts = (CalibrationInput(1, 1, (0, 65535), (0,)), CalibrationInput(2, 1, (0, 65535), (0,)))
    both = Calibration(1, "polynomial", parts, (0.0, 0.0, 10 / 65535, 0.0), unit=parse_unit("N"))
    sheet = sheet_of("tactile-finger-sensor", {1: both})
    sheet = replace(sheet, channels=sheet.channels[:1]) if sample is ... else changed(sheet, 2, sample=sample)
    assert ChannelInterpreter(sheet, 1).problem == f"Channel 1 is compensated by channel 2, which {why}."


def test_an_actuator_with_several_inputs_cannot_be_set() -> None:
    parts = (CalibrationInput(1, 1, (0, 110), (0,)), CalibrationInput(2, 1, (0, 4095), (0,)))
    both = Calibration(1, "polynomial", parts, (0.0, 0.0, 30.0, 0.0), unit=parse_unit("mm"), actuator=True)
    interpreter = ChannelInterpreter(actuator(both), 1)
    assert interpreter.problem == "The calibration of actuator 1 takes several inputs; one is what can be set here."


def test_the_limits_of_a_value_have_room_for_its_uncertainty_and_for_rounding() -> None:
    interpreter = ChannelInterpreter(changed(sheet_of("load-cell"), low=-1e6, high=1e6, uncertainty=5.0), 1)
    low, high = interpreter.accepted
    assert interpreter.unit.to_si(high) > 1e6 + 5 > interpreter.unit.to_si(high) - 2
    assert interpreter.unit.to_si(low) < -1e6 - 5 < interpreter.unit.to_si(low) + 2


@pytest.mark.parametrize(
    ("model", "octets", "bits", "ends"),
    [
        (0, 2, 0, (0, 65535)),
        (0, 2, 12, (0, 4095)),
        (0, 2, 17, (0, 65535)),
        (5, 9, 0, (0, 2.0**72)),
        (5, 128, 1023, (0, 2.0**1023)),
        (5, 128, 0, None),
        (3, 1, 0, (0, 1 - 2**-8)),
        (6, 9, 70, (0, 1.0)),
        (1, 4, 32, None),
        (4, 2, 16, None),
        (7, 8, 64, None),
    ],
)
def test_which_raw_values_a_form_can_hold(model: int, octets: int, bits: int, ends: tuple[float, float] | None) -> None:
    assert SampleForm(model, octets, bits).raw_range == ends


def test_a_limit_of_zero_of_the_calibration_counts() -> None:
    own = ANGLE.channels[0].calibration
    assert own is not None
    for low, high, limits in ((0.0, None, (0.0, 180.0)), (None, 0.0, (-180.0, 0.0))):
        curve = replace(own, low_limit=low, high_limit=high)
        narrowed = changed(ANGLE, low=-math.pi, high=math.pi, calibration=curve)
        assert ChannelInterpreter(narrowed, 1).limits == pytest.approx(limits)


def test_an_input_that_a_curve_takes_twice_is_asked_for_once_in_the_order_of_the_inputs() -> None:
    parts = tuple(CalibrationInput(number, 0, (0, 65535), (0,)) for number in (3, 1, 2, 3))
    curve = Calibration(1, "polynomial", parts, (1.0,), unit=parse_unit("N"))
    assert ChannelInterpreter(sheet_of("tactile-finger-sensor", {1: curve}), 1).others == (3, 2)


@pytest.mark.parametrize(
    ("stated", "known"), [(0.0, 0.0), (2.0, 2.0), (-1.0, None), (math.nan, None), (math.inf, None)]
)
def test_an_uncertainty_of_zero_is_stated_and_one_that_is_none_is_not(stated: float, known: float | None) -> None:
    sheet = changed(sheet_of("load-cell"), uncertainty=stated)
    assert ChannelInterpreter(sheet, 1).uncertainty == known
