"""One channel by itself: which field of the TEDS each value is, and what is said of it."""

from __future__ import annotations

import math
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from teds_provision import teds
from teds_provision.teds.calibration import Calibration, CalibrationInput
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.channel import (
    Channel,
    ChannelKind,
    Sampling,
    Timing,
    described,
    read_channel,
    within_turn,
    wrapped,
)
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.model import Units
from teds_provision.teds.units import parse_unit

DEGREE = parse_unit("degree")


def degrees(**more: object) -> Calibration:
    part = CalibrationInput(1, 1, (0.0, 65535.0), (0.0,))
    return Calibration(1, "linear", (part,), (0.0, 360 / 65536), unit=DEGREE, **more)  # type: ignore[arg-type]


def test_each_field_of_the_teds_is_the_value_of_its_name() -> None:
    fields = {
        "CalKey": 1,
        "ChanType": 1,
        "PhyUnits": Units(radians=1),
        "LowLimit": -1.0,
        "HiLimit": 2.0,
        "OError": 0.25,
        "SelfTest": 0,
        "Sample": {"DatModel": 0, "ModLenth": 2, "SigBits": 12},
        "UpdateT": 3.0,
        "WSetupT": 4.0,
        "RSetupT": 5.0,
        "SPeriod": 6.0,
        "WarmUpT": 7.0,
        "RDelayT": 8.0,
        "Sampling": {"SampMode": 9, "SDefault": 8},
        "ActHalt": 2,
    }
    octets = teds.compose(3, fields)
    assert read_channel(7, "slew", decode(octets)) == Channel(
        7,
        "slew",
        True,
        ChannelKind.ACTUATOR,
        Units(radians=1),
        True,
        -1.0,
        2.0,
        0.25,
        SampleForm(0, 2, 12),
        Sampling(9, 8),
        Timing(period=6.0, update=3.0, write_setup=4.0, read_setup=5.0, read_delay=8.0, warm_up=7.0),
        2,
        1,
    )
    assert described(7, {(7, 3): octets, (7, 4): b"", (6, 3): b""}).high == 2.0
    assert described(7, {(6, 3): octets}) == Channel(7)


def test_what_the_teds_leave_out_is_not_stated() -> None:
    bare = read_channel(1, "", decode(teds.compose(3, {"ChanType": 7, "Sample": {"DatModel": 0}})))
    assert (bare.described, bare.kind, bare.units_stated, bare.sample) == (True, None, False, None)
    assert (bare.sampling, bare.halt, bare.calibration_key) == (Sampling(None, None), None, None)
    times = (bare.timing.period, bare.timing.update, bare.timing.write_setup, bare.timing.read_setup)
    stated = (*times, bare.timing.read_delay, bare.timing.warm_up, bare.low, bare.high, bare.uncertainty, bare.period)
    assert all(math.isnan(number) for number in stated)
    assert not bare.has_range
    assert not replace(bare, low=0.0).has_range
    assert not replace(bare, high=0.0).has_range
    assert replace(bare, low=0.0, high=0.0).has_range
    sampled = read_channel(1, "", decode(teds.compose(3, {"Sample": {"DatModel": 0, "ModLenth": 2}})))
    assert sampled.sample == SampleForm(0, 2, 0)


def test_the_unit_is_the_calibrated_one_unless_it_has_no_name_and_a_profile_may_choose_another() -> None:
    angle = Channel(1, units=Units(radians=1), calibration=degrees())
    assert angle.unit.text == angle.shown.text == "degree", "as the calibration writes it"
    plain = replace(angle, calibration=None)
    assert plain.unit.text == "°", "a friendly one"
    assert plain.si_unit == "rad"
    for text in ("", "(m)·kg"):
        nameless = replace(angle, calibration=replace(degrees(), unit=replace(DEGREE, text=text)))
        assert nameless.unit == plain.unit
    turns = replace(angle, calibration=replace(degrees(), unit=parse_unit("turn")))
    assert turns.unit.text == "turn"
    assert replace(turns, display="mrad").shown.text == "mrad"
    assert replace(turns, display="mm").shown.text == "turn", "that is no unit of angles"
    assert replace(turns, display="nonsense").shown.text == "turn"


def test_a_calibration_states_its_uncertainty_in_its_own_unit_and_when_it_ends() -> None:
    date, due = datetime(2026, 1, 1, tzinfo=UTC), datetime(2027, 1, 1, tzinfo=UTC)
    celsius = Channel(1, units=Units(kelvins=1), uncertainty=0.25)
    own = replace(degrees(uncertainty=9.0, date=date, interval=365 * 86400.0), unit=parse_unit("degF"))
    calibrated = replace(celsius, calibration=own)
    assert calibrated.stated_uncertainty == pytest.approx(5.0), "a difference: without the offset of the scale"
    for unknown in (None, math.nan):
        assert replace(celsius, calibration=replace(own, uncertainty=unknown)).stated_uncertainty == 0.25
    assert celsius.stated_uncertainty == 0.25
    assert (calibrated.calibrated_at, calibrated.due) == (date, due)
    assert (celsius.calibrated_at, celsius.due) == (None, None)
    assert [calibrated.overdue(datetime(2027, 1, day, tzinfo=UTC)) for day in (1, 2)] == [False, True]
    assert not celsius.overdue(datetime(2099, 1, 1, tzinfo=UTC))


ANGLE, RATIO, BITS, COUNTS = Units(radians=1), Units(1, meters=1), Units(4), Units()


@pytest.mark.parametrize(
    ("units", "model", "octets", "has_values"),
    [
        (ANGLE, 0, 2, False),
        (ANGLE, 1, 4, True),
        (ANGLE, 2, 8, True),
        (ANGLE, 3, 2, False),
        (ANGLE, 5, 9, False),
        (ANGLE, 7, 8, True),
        (COUNTS, 0, 2, True),
        (Units(extension=3), 0, 2, True),
        (BITS, 4, 2, True),
        (Units(5, meters=1), 0, 2, True),
        (RATIO, 0, 2, False),
        (RATIO, 3, 2, True),
        (RATIO, 6, 9, True),
    ],
)
def test_which_samples_are_values_without_a_calibration(
    units: Units, model: int, octets: int, has_values: bool
) -> None:
    channel = Channel(3, units=units, sample=SampleForm(model, octets))
    assert (channel.value_problem == "") is has_values, channel.value_problem
    assert replace(channel, calibration=degrees()).value_problem == ""


def test_why_samples_give_no_values_in_whole_sentences() -> None:
    channel = Channel(3, units=ANGLE, sample=SampleForm(0, 2))
    assert channel.value_problem == "Channel 3 has no calibration: raw values cannot be turned into °."
    assert replace(channel, display="mrad").value_problem.endswith("into °."), "the datasheet's unit, whatever is shown"
    bad = replace(channel, calibration_problem="no Coefs.")
    assert bad.value_problem == "Channel 3 has a calibration that cannot be used: no Coefs."
    assert replace(channel, sample=None).value_problem == (
        "The datasheet does not say how a sample of channel 3 is coded."
    )
    nine = replace(channel, sample=SampleForm(0, 9), calibration=degrees()).value_problem
    assert nine.startswith("The samples of channel 3 cannot be read: ")
    assert (channel.label, replace(channel, name="slew").label) == ("3", "3 (slew)")
    assert [kind.word for kind in ChannelKind] == ["sensor", "actuator", "event sensor"]


def test_angles_wrap_at_their_low_limit() -> None:
    angles = np.array([-0.1, 0.0, 359.9999, 360.0, 725.0, math.inf, math.nan])
    moved = wrapped(angles, 0.0, 360.0, 360.0)
    assert moved[:5] == pytest.approx([359.9, 0.0, 359.9999, 0.0, 5.0])
    assert np.isnan(moved[5:]).all()
    assert wrapped(np.array([179.0, 180.0, -181.0]), -180.0, 180.0, 360.0).tolist() == [179.0, -180.0, 179.0]
    short = 359.9999
    assert wrapped(np.array([359.99995, short]), 0.0, short, 360.0).tolist() == [0.0, 0.0]
    assert within_turn(359.9996, DEGREE, 0.0) == "0"
    assert within_turn(359.9994, DEGREE, 0.0) == "359.999"
    assert within_turn(179.9996, DEGREE, -math.pi) == "-180"
    assert within_turn(359.96, DEGREE, 0.0, digits=4) == "0"


def test_a_value_is_shown_with_the_digits_that_are_asked_for() -> None:
    celsius = Channel(1, units=Units(kelvins=1), display="degC")
    assert celsius.show(293.15) == "20 °C"
    assert celsius.show(1.23456789, difference=True) == "1.23457 °C"
    assert celsius.show(1.23456789, difference=True, digits=3) == "1.23 °C"
    assert celsius.show_reading(293.123456, digits=4) == "19.97 °C"
    turn = Channel(1, units=ANGLE, low=0.0, high=math.tau, kind=ChannelKind.SENSOR)
    assert turn.show_reading(math.radians(359.99), digits=4) == "0 °"
    assert turn.show_reading(math.radians(359.99)) == "359.99 °"
