"""From values to samples: the quick way gives what the interpreter of the station reads back."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.node.hardware.clock import NodeClock
from teds_provision.node.hardware.converter import Converter
from teds_provision.node.sources.base import Reading
from teds_provision.teds.calibration import load_calibrations, read_calibrations
from teds_provision.teds.calibration.interpreter import ChannelInterpreter
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
