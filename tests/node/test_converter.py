"""From values to samples: the quick way gives what the interpreter of the station reads back."""

from __future__ import annotations

import math
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.errors import BadDataError
from teds_provision.node.hardware.clock import NodeClock
from teds_provision.node.hardware.converter import Converter
from teds_provision.node.sources.base import Reading
from teds_provision.teds.calibration import load_calibrations, read_calibrations
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
from teds_provision.teds.calibration.samples import DataModel, SampleForm
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet

UUID = bytes.fromhex("8d4d9da65281f7000000")
CALIBRATIONS = {
    "linear": "raw,value [deg]\n0,0\n16383,360\n",
    "table": "raw,value [deg]\n0,0\n4000,100\n9000,200\n16383,360\n",
}


def sheet_of(name: str, tmp_path_factory: pytest.TempPathFactory) -> Sheet:
    profile = load_profile("magnetic-angular-position-sensor")
    calibration = {}
    if name in CALIBRATIONS:
        path = tmp_path_factory.mktemp("calibration") / "angle.csv"
        path.write_text(CALIBRATIONS[name])
        calibration = load_calibrations(path, profile)
    return Sheet.from_image(Image(UUID, profile.build(UUID, calibration=calibration).blocks))


@pytest.fixture(scope="module", params=["none", *CALIBRATIONS])
def channel(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Sheet, Converter]:
    sheet = sheet_of(request.param, tmp_path_factory)
    return sheet, Converter(sheet, sheet.channels[0])


@settings(max_examples=200, deadline=None)
@given(share=st.floats(-0.1, 1.1))
def test_a_sample_is_read_back_as_the_value_within_its_step(channel: tuple[Sheet, Converter], share: float) -> None:
    sheet, converter = channel
    low, high = converter.low, converter.high
    value = low + share * (high - low)
    octets = converter.octets(Reading(value=value))
    assert len(octets) == converter.form.octets
    back = converter.value(octets)
    assert back is not None
    turn = high - low
    off = back - value
    assert off - turn * round(off / turn) == pytest.approx(0.0, abs=turn / 2000)
    interpreter = ChannelInterpreter(sheet, 1)
    if not interpreter.problem:
        exact = interpreter.decode(interpreter.encode(value)).value[0]
        off = back - exact
        assert abs(off - turn * round(off / turn)) <= 1.5 * turn / 16384


@settings(max_examples=60, deadline=None)
@given(zero=st.floats(-400, 400), value=st.floats(-720, 720))
def test_a_turned_scale_gives_the_sample_of_the_same_angle_quickly(zero: float, value: float) -> None:
    """The second paper's sensor with its zero adjusted: a virtual one shows every angle, not the end of its scale."""
    profile = load_profile("magnetic-angular-position-sensor")
    text = f"# zero-offset: {zero!r}\nraw,value [deg]\n0,0\n16384,360\n"
    calibration = read_calibrations(text, "angle.csv", profile)
    sheet = Sheet.from_image(Image(UUID, profile.build(UUID, calibration=calibration).blocks))
    converter = Converter(sheet, sheet.channels[0])
    assert converter._table is not None
    back = converter.value(converter.octets(Reading(value=value)))
    assert back is not None
    off = back - value
    assert off - 360 * round(off / 360) == pytest.approx(0.0, abs=0.023)


def test_raw_numbers_are_rounded_and_kept_within_the_sample(channel: tuple[Sheet, Converter]) -> None:
    _, converter = channel
    most = int(converter.form.raw_range[1])  # type: ignore[index]
    encoded = [converter.octets(Reading(raw=raw)) for raw in (-5.0, 7.6, 1e9)]
    assert [int.from_bytes(octets, "big") for octets in encoded] == [0, 8, most]


def test_floats_carry_si_values() -> None:
    sheet = Sheet.from_image(Image(UUID, load_profile("gripper").build(UUID).blocks))
    for channel in sheet.channels:
        converter = Converter(sheet, channel)
        middle = (converter.low + converter.high) / 2
        assert converter.value(converter.octets(Reading(value=middle))) == pytest.approx(middle, rel=2e-3)


class Host:
    def __init__(self) -> None:
        self.nanoseconds = 10**12

    def __call__(self) -> int:
        return self.nanoseconds


def test_ticks_count_from_the_start() -> None:
    host = Host()
    clock = NodeClock(host)
    assert clock.tick() == 0
    host.nanoseconds += 5_000_000_000
    assert (clock.tick(), clock.now()) == (5_000_000_000, 5.0)


def test_a_simulation_drives_the_clock_and_it_never_goes_back() -> None:
    host = Host()
    clock = NodeClock(host)
    seen: list[tuple[int, str]] = []
    values = ["old"]
    clock.due = lambda: seen.append((clock.tick(), values[0]))
    host.nanoseconds += 1000
    clock.own_clock()
    host.nanoseconds += 10**9
    assert clock.tick() == 1000
    clock.advance(0.01, lambda: values.__setitem__(0, "new"))
    assert seen == [(9_999_999, "old"), (10_000_000, "new")]
    assert clock.step == 10_000_000 - 1000
    clock.advance(0.005, lambda: None)
    assert clock.tick() == 10_000_000
    clock.host_clock()
    host.nanoseconds += 7
    assert clock.tick() == 10_000_007


@given(st.lists(st.tuples(st.sampled_from(["own", "host", "advance", "wait"]), st.floats(0, 10)), max_size=30))
def test_no_order_of_events_makes_the_clock_go_back(events: list[tuple[str, float]]) -> None:
    host = Host()
    clock = NodeClock(host)
    last = 0
    for what, seconds in events:
        if what == "own":
            clock.own_clock()
        elif what == "host":
            clock.host_clock()
        elif what == "advance" and not clock.runs_by_itself:
            clock.advance(seconds, lambda: None)
        else:
            host.nanoseconds += round(seconds * 1e9)
        assert clock.tick() >= last
        last = clock.tick()


def test_what_is_not_finite_gives_no_sample(channel: tuple[Sheet, Converter]) -> None:
    _, converter = channel
    assert math.isfinite(converter.raw(np.inf))


def made(model: DataModel, octets: int, bits: int = 0, low: float = 0.0, high: float = 0.11) -> Converter:
    """Return the converter of a channel in metres without a calibration."""
    sheet = Sheet.from_image(Image(UUID, load_profile("gripper").build(UUID).blocks))
    channel = replace(sheet.channels[1], sample=SampleForm(model, octets, bits), low=low, high=high)
    return Converter(replace(sheet, channels=(sheet.channels[0], channel, *sheet.channels[2:])), channel)


@pytest.mark.parametrize(
    ("form", "raw", "octets"),
    [
        ((DataModel.UNSIGNED, 2, 12), 7.6, "0008"),
        ((DataModel.UNSIGNED, 2, 12), 7.4, "0007"),
        ((DataModel.UNSIGNED, 2, 12), 4096.0, "0fff"),
        ((DataModel.UNSIGNED, 2, 12), -1.0, "0000"),
        ((DataModel.UNSIGNED, 2, 0), 70000.0, "ffff"),
        ((DataModel.UNSIGNED, 2, 16), 70000.0, "ffff"),
        ((DataModel.UNSIGNED, 2, 20), 70000.0, "ffff"),  # more bits than octets hold are all of them
        ((DataModel.BITS, 1, 1), 7.0, "01"),
        ((DataModel.BITS, 2, 3), 9.0, "0007"),
        ((DataModel.FLOAT32, 4), 7.5, "40f00000"),
        ((DataModel.FLOAT32, 4), 1e39, "7f7fffff"),
        ((DataModel.FLOAT32, 4), -1e39, "ff7fffff"),
        ((DataModel.FLOAT64, 8), 1e39, "48078287f49c4a1d"),
        ((DataModel.FRACTION, 2), 0.5, "8000"),
    ],
)
def test_a_raw_number_is_rounded_and_kept_within_what_the_sample_holds(
    form: tuple[DataModel, int], raw: float, octets: str
) -> None:
    assert made(*form).octets(Reading(raw=raw)).hex() == octets


@pytest.mark.parametrize(
    ("form", "octets"),
    [
        ((DataModel.UNSIGNED, 2, 12), "ffff"),
        ((DataModel.BITS, 1, 7), "ff"),
        ((DataModel.FLOAT32, 4), "7fc00000"),
        ((DataModel.FLOAT64, 8), "7ff8000000000000"),
        ((DataModel.UNSIGNED, 2, 16), None),
        ((DataModel.UNSIGNED, 2), None),
        ((DataModel.BITS, 1), None),
        ((DataModel.FRACTION, 2), None),
    ],
)
def test_a_missing_value_is_a_sample_that_is_none_if_there_is_one(
    form: tuple[DataModel, int], octets: str | None
) -> None:
    converter = made(*form)
    if octets is not None:
        assert converter.octets(Reading(missing=True)).hex() == octets
        return
    with pytest.raises(BadDataError, match="Every sample of this channel is a value"):
        converter.octets(Reading(missing=True))


@pytest.mark.parametrize(
    ("converter", "octets", "value", "raw"),
    [
        (made(DataModel.UNSIGNED, 2, 12), "0fff", 0.11, 4095.0),
        (made(DataModel.UNSIGNED, 2, 12), "0555", 0.0366667, 1365.0),
        (made(DataModel.UNSIGNED, 2, 12), "1000", None, math.nan),
        (made(DataModel.UNSIGNED, 2, 12, high=math.inf), "0001", None, 1.0),
        (made(DataModel.UNSIGNED, 2, 12, low=-math.inf), "0001", None, 1.0),
        (made(DataModel.UNSIGNED, 2, 12, low=0.11), "0001", None, 1.0),
        (made(DataModel.BITS, 1, 1), "01", None, 1.0),
        (made(DataModel.FLOAT32, 4), struct.pack(">f", 0.0625).hex(), 0.0625, 0.0625),
        (made(DataModel.FLOAT32, 4), "7fc00000", None, math.nan),
    ],
)
def test_octets_mean_a_value_and_a_raw_number_if_they_can(
    converter: Converter, octets: str, value: float | None, raw: float
) -> None:
    found = converter.value(bytes.fromhex(octets))
    assert (found is None) if value is None else (found == pytest.approx(value, rel=1e-5))
    assert converter.raw_of(bytes.fromhex(octets)) == pytest.approx(raw, nan_ok=True)


@pytest.mark.parametrize(("low", "high"), [(0.0, math.inf), (-math.inf, 1.0), (1.0, 1.0), (2.0, 1.0)])
def test_without_a_range_or_a_calibration_a_value_has_no_sample(low: float, high: float) -> None:
    with pytest.raises(BadDataError, match="raw values cannot be turned into m"):
        made(DataModel.UNSIGNED, 2, 12, low, high).octets(Reading(value=0.5))
    with pytest.raises(BadDataError, match="raw values cannot be turned into m"):
        made(DataModel.BITS, 2, 12).octets(Reading(value=0.05))


@pytest.mark.parametrize(
    ("low", "high", "value", "raw"),
    [(0.0, math.inf, 7.0, 7.0), (0.0, math.inf, -7.0, 0.0), (-math.inf, 1.0, 7.0, 1.0), (0.0, 0.5, 0.25, 0.25)],
)
def test_a_float_is_kept_within_the_limits_that_there_are(low: float, high: float, value: float, raw: float) -> None:
    assert made(DataModel.FLOAT32, 4, 0, low, high).raw(value) == pytest.approx(raw)


def test_a_channel_without_a_form_of_sample_has_no_converter() -> None:
    sheet = Sheet.from_image(Image(UUID, load_profile("gripper").build(UUID).blocks))
    with pytest.raises(BadDataError, match="does not say how a sample of channel 1 is coded"):
        Converter(sheet, replace(sheet.channels[0], sample=None))


@pytest.mark.parametrize(
    ("value", "raw"), [(60.0, 21845), (200.0, 65535), (265.0, 65535), (275.0, 0), (-5.0, 0), (420.0, 21845)]
)
def test_an_angle_outside_a_curve_of_half_a_turn_is_that_of_its_nearer_end(value: float, raw: int) -> None:
    profile = load_profile("magnetic-angular-position-sensor")
    calibration = read_calibrations("raw,value [deg]\n0,0\n65535,180\n", "angle.csv", profile)
    sheet = Sheet.from_image(Image(UUID, profile.build(UUID, calibration=calibration).blocks))
    converter = Converter(sheet, sheet.channels[0])
    assert int.from_bytes(converter.octets(Reading(value=value)), "big") == raw
