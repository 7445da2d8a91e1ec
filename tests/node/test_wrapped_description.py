"""What a wrapped signal becomes: its sample, calibration, limits, the whole profile, and units as files spell them."""

from __future__ import annotations

import math
import struct
from dataclasses import replace
from typing import Any

import pytest

from teds_provision.errors import BadDataError
from teds_provision.node.wrapped.description import (
    SampleChoice,
    WrappedChannel,
    WrappedSensor,
    facts,
    written_unit,
)
from teds_provision.teds.image import Image
from teds_provision.teds.origin import Origin
from teds_provision.teds.sheet import Sheet

TORQUE = WrappedChannel(
    "Torque", "N·m", 0.01, -5.0, 12, low=-5.0, high=30.0, period=0.02, choices={4095: "n/a", 0: "off"},
    comment="of the shaft",
)  # fmt: skip
OIL = WrappedChannel("Oil\x7f", "degC", 0.5, 0.0, 15, signed=True, low=-40.0, high=125.0, note="read as it is")
SPEED = WrappedChannel("Speed", "rad/s", is_float=True, bits=32, period=0.001)
COUNT = WrappedChannel("Count", "count", bits=8, choices={3: "three"})


U, F64 = "unsigned", SampleChoice("float64", 8, 64, False)


@pytest.mark.parametrize(
    ("channel", "sample", "limits", "raw_limits", "unstated"),
    [
        (TORQUE, SampleChoice(U, 2, 12, True, 0, (-5.0, 0.01)), (-5.0, 30.0), (0, 3500), ("OError",)),
        (OIL, SampleChoice(U, 2, 15, True, 16384, (-8192.0, 0.5)), (-40.0, 125.0), (16304, 16634), ("OError",)),
        (SPEED, SampleChoice("float32", 4, 32, False), (-1e30, 1e30), None, ("OError", "LowLimit", "HiLimit")),
        (replace(SPEED, bits=64), F64, (-1e30, 1e30), None, None),
        (replace(SPEED, unit="rpm"), F64, (-1e30, 1e30), None, None),
        (replace(SPEED, unit="degC"), F64, (-1e30, 1e30), None, None),
        (replace(SPEED, scale=2.0), F64, (-1e30, 1e30), None, None),
        (replace(SPEED, offset=1.0), F64, (-1e30, 1e30), None, None),
        (replace(SPEED, low=0.0, high=9.0), SampleChoice("float32", 4, 32, False), (0.0, 9.0), None, ("OError",)),
        (COUNT, SampleChoice(U, 2, 8, True), (0.0, 255.0), (0, 255), ("OError",)),
        (replace(COUNT, bits=7), SampleChoice(U, 1, 7, True), (0.0, 127.0), (0, 127), None),
        (replace(COUNT, bits=64), SampleChoice(U, 8, 64, True), (0.0, 1.84467440737096e19), None, None),
        (replace(COUNT, unit="V"), SampleChoice(U, 2, 8, True, 0, (0.0, 1.0)), (0.0, 255.0), None, None),
        (replace(COUNT, scale=-2.0), SampleChoice(U, 2, 8, True, 0, (0.0, -2.0)), (-510.0, 0.0), (0, 255), None),
        (replace(COUNT, signed=True), SampleChoice(U, 2, 8, True, 128, (-128.0, 1.0)), (-128.0, 127.0), None, None),
        (replace(COUNT, offset=1.0), SampleChoice(U, 2, 8, True, 0, (1.0, 1.0)), (1.0, 256.0), None, None),
        (replace(COUNT, bits=24, scale=2.0), SampleChoice(U, 4, 24, True, 0, (0.0, 2.0)), None, None, None),
        (replace(COUNT, bits=25, scale=2.0), F64, None, None, None),
        (replace(COUNT, bits=24, scale=0.3), F64, None, None, None),
        (replace(COUNT, bits=23, scale=0.3), SampleChoice(U, 3, 23, True, 0, (0.0, 0.3)), None, None, None),
        (replace(COUNT, scale=1e-3, offset=1e6 + 0.03), F64, None, None, None),
        (replace(COUNT, scale=1e-46, offset=1.0), F64, None, None, None),
        (replace(COUNT, scale=1e39), F64, None, None, None),
        (replace(COUNT, offset=-1e39), F64, None, None, None),
        (replace(COUNT, low=5.0, high=5.0), SampleChoice(U, 2, 8, True), (0.0, 255.0), None, None),
        (replace(COUNT, low=5.0), SampleChoice(U, 2, 8, True), (0.0, 255.0), None, None),
        (replace(COUNT, low=4.5, high=9.5), SampleChoice(U, 2, 8, True), (4.5, 9.5), (5, 9), None),
        (replace(COUNT, low=-7.0, high=999.0), SampleChoice(U, 2, 8, True), (-7.0, 999.0), (0, 255), None),
        (replace(COUNT, low=4.1, high=4.9), SampleChoice(U, 2, 8, True), (4.1, 4.9), (0, 255), None),
    ],
)  # fmt: skip
def test_how_a_signal_travels(
    channel: WrappedChannel, sample: SampleChoice, limits: Any, raw_limits: Any, unstated: Any
) -> None:
    """A raw number stays one if Float32 coefficients move it by less than half a step; a bit marks "no value"."""
    assert channel.sample == sample
    assert limits is None or channel.limits == limits
    assert raw_limits is None or channel.raw_limits == raw_limits
    assert unstated is None or channel.unstated == unstated
    assert (channel.raw_limits is None) == (not sample.raw)


def test_values_numbers_and_texts_of_a_signal() -> None:
    assert (TORQUE.value(100), TORQUE.number(100), TORQUE.shown(100)) == (-4.0, 100, "-4 N·m")
    assert (TORQUE.shown(0), TORQUE.shown(0.5), TORQUE.shown(4095)) == ("off", "-4.995 N·m", "n/a")
    assert (OIL.value(-20), OIL.number(-20), OIL.shown(-20)) == (-10.0, 16364, "-10 degC")
    assert (COUNT.shown(7), COUNT.shown(3)) == ("7", "three")
    assert (SPEED.shown(-1234.5678), SPEED.shown(1_234_567.8)) == ("-1234.57 rad/s", "1.23457e+06 rad/s")
    assert replace(COUNT, choices={3: ""}).shown(3) == "", "a text that is empty is one"
    assert (replace(SPEED, unit="degC").number(20.0), SPEED.number(20.0)) == (293.15, 20.0)


def test_limits_that_a_float32_would_exclude_are_moved_outward_by_one() -> None:
    """125 degC are 398.15 K, whose Float32 is less; -40 degC are 233.15 K, whose Float32 is less too."""

    def float32(value: float) -> float:
        return float(struct.unpack(">f", struct.pack(">f", value))[0])

    def neighbour(value: float, step: int) -> float:
        return float(struct.unpack(">f", struct.pack(">i", struct.unpack(">i", struct.pack(">f", value))[0] + step))[0])

    above = neighbour(398.15, 1)
    assert float32(398.15) < 398.15 < above
    assert OIL.held_limits == (-40.0, 125.00002)
    assert float32(125.00002 + 273.15) == above, "in as few digits as give it"
    below = neighbour(0.1, -1)
    assert float32(0.1) > 0.1 > below
    assert replace(OIL, unit="V", low=0.1, high=0.5).held_limits == (0.099999994, 0.5)
    assert float32(0.099999994) == below
    assert replace(OIL, unit="V", low=-0.5, high=-0.1).held_limits == (-0.5, -0.099999994)
    assert SPEED.held_limits == (-1e30, 1e30)


def test_a_calibration_applies_factor_and_offset_in_the_unit() -> None:
    made = OIL.calibration(2)
    assert made is not None
    assert (made.channel, made.method, made.coefficients, made.raw_range) == (
        2,
        "linear",
        (-8192.0, 0.5),
        (16304, 16634),
    )
    (part,) = made.inputs
    assert (part.channel, part.degree, part.boundaries, part.offsets) == (2, 1, (16304, 16634), (0.0,))
    assert made.low_limit == -40.0
    assert made.high_limit == pytest.approx(125.0, abs=1e-4)
    assert made.unit.text == "degC"
    assert (COUNT.calibration(1), SPEED.calibration(1)) == (None, None)


def test_facts_of_a_signal() -> None:
    assert facts(TORQUE) == {"low": -5.0, "high": 30.0, "period": 0.02, "factor": 0.01, "offset": -5.0, "raw": True,
                             "choices": {"0": "off", "4095": "n/a"}}  # fmt: skip
    several = replace(COUNT, choices={10: "ten", 9: "nine", 100: "much"})
    assert str(facts(several)["choices"]) == "{'9': 'nine', '10': 'ten', '100': 'much'}", "in the order of the numbers"
    assert facts(SPEED) == {"low": -1e30, "high": 1e30, "period": 0.001, "factor": 1.0, "offset": 0.0, "raw": False}


ORIGIN = Origin("dbc", "Gearbox", "ab" * 32)


def test_the_whole_profile_of_a_sensor() -> None:
    sensor = WrappedSensor(ORIGIN, 'Gear "one"', (TORQUE, OIL, SPEED, COUNT), "gear.dbc")
    assert sensor.notes == ("Oil: read as it is.",)
    assert b"Oil" in sensor.blocks(bytes(10))[2, 12], "no comment of TOML has a control character"
    assert sensor.profile_text("gear").splitlines() == [
        "# Transducer type gear, made from gear.dbc (CAN message Gearbox (dbc)).",
        "# Neither names an uncertainty: each is one step of the raw number. Replace it by that of the data sheet.",
        "# Oil: read as it is.",
        "",
        'title = "Gear \\"one\\""',
        'name = "Gear \\"one\\""',
        'links = ["can"]',
        "",
        "[meta]",
        'operation-timeout = "100 ms"',
        'slow-timeout = "2 s"',
        "self-test-time = 0.0",
        *_channel(1, "Torque", "N·m", "-5.0", "30.0", "0.01", ("unsigned", 2, 12), "0.02"),
        "",
        "[channel.1.calibration]",
        "required = true",
        "raw-range = [0.0, 3500.0]",
        "indication = [0.01, -5.0]",
        "",
        "[[text]]",
        'kind = "channel-identification"',
        "channel = 1",
        'xml = "<Signal name=\\"Torque\\" comment=\\"of the shaft\\"><Value raw=\\"0\\">off</Value>'
        '<Value raw=\\"4095\\">n/a</Value></Signal>"',
        *_channel(2, "Oil", "degC", "-40.0", repr(OIL.held_limits[1]), "0.5", ("unsigned", 2, 15), "0.1"),
        "",
        "[channel.2.calibration]",
        "required = true",
        "raw-range = [16304.0, 16634.0]",
        "indication = [0.5, -8192.0]",
        *_channel(3, "Speed", "rad/s", "-1e+30", "1e+30", "1e-07", ("float32", 4, 32), "0.001"),
        *_channel(4, "Count", "count", "0.0", "255.0", "1.0", ("unsigned", 2, 8), "0.1"),
        "",
        "[[text]]",
        'kind = "channel-identification"',
        "channel = 4",
        'xml = "<Signal name=\\"Count\\"><Value raw=\\"3\\">three</Value></Signal>"',
    ]


def _channel(
    number: int, name: str, unit: str, low: str, high: str, step: str, form: tuple[str, int, int], period: str
) -> list[str]:
    return [
        "",
        f"[channel.{number}]",
        f'name = "{name}"',
        'type = "sensor"',
        f'unit = "{unit}"',
        f"low-limit = {low}",
        f"high-limit = {high}",
        f"uncertainty = {step}",
        f'sample = {{ model = "{form[0]}", octets = {form[1]}, bits = {form[2]} }}',
        'sampling = { modes = ["trigger", "continuous"], default = "continuous" }',
        f"update-time = {period}",
        f"sampling-period = {period}",
        "read-setup-time = 0.0",
        "read-delay-time = 0.0",
        "warm-up-time = 0.0",
    ]


def test_teds_of_a_sensor_state_nothing_that_no_file_states() -> None:
    uuid = bytes(range(10))
    blocks = WrappedSensor(ORIGIN, "Gear", (TORQUE, SPEED), "gear.dbc").blocks(uuid, "left gear")
    torque, speed = Sheet.from_image(Image(uuid, blocks)).channels
    assert (torque.low, torque.high) == (-5.0, 30.0)
    assert all(map(math.isnan, (speed.low, speed.high)))
    assert (0, 128) not in blocks
    assert blocks[0, 130] == ORIGIN.encode()
    assert b"left gear" in blocks[0, 12]
    assert b"Gear" in WrappedSensor(ORIGIN, "Gear", (TORQUE,)).blocks(uuid)[0, 12]
    several = WrappedSensor(ORIGIN, "Gear", (SPEED, TORQUE, COUNT, OIL)).blocks(uuid)
    assert [channel for channel, code in sorted(several) if code == 5] == [2, 4]


@pytest.mark.parametrize(("count", "good"), [(0, False), (1, True), (255, True), (256, False)])
def test_a_node_has_1_to_255_channels(count: int, good: bool) -> None:
    channels = tuple(replace(COUNT, name=f"c{number}") for number in range(count))
    if good:
        assert len(WrappedSensor(ORIGIN, "Gear", channels).channels) == count
        return
    with pytest.raises(BadDataError, match=f"has {count} signals; a node has 1 to 255") as refused:
        WrappedSensor(ORIGIN, "Gear", channels)
    assert refused.value.hint == "Choose another message."
    with pytest.raises(BadDataError) as refused:
        WrappedSensor(Origin("iio", "adc"), "adc", channels)
    assert not refused.value.hint


@pytest.mark.parametrize(
    "change",
    [{"bits": 0}, {"bits": 65}, {"scale": math.inf}, {"offset": math.nan}, {"scale": 0.0}, {"period": 0.0},
     {"period": -1.0}, {"period": math.inf}],
    ids=str,
)  # fmt: skip
def test_a_signal_that_cannot_be_measured_is_refused(change: dict[str, Any]) -> None:
    with pytest.raises(BadDataError, match="The signal Count"):
        replace(COUNT, **change)
    assert replace(COUNT, bits=1).raw_ends == (0, 1)
    assert replace(COUNT, bits=64, signed=True).raw_ends == (-(2**63), 2**63 - 1)


@pytest.mark.parametrize(
    ("written", "unit"),
    [
        ("", "count"), ("-", "count"), ("counts", "count"), ("cnt", "count"), ("n/a", "count"),
        ("Celsius", "degC"), ("deg C", "degC"), ("degree C", "degC"), ("degrees C", "degC"), ("°C", "degC"),
        ("degC", "degC"), ("deg F", "degF"), ("N m", "N·m"), ("N-m", "N·m"), ("N.m", "N·m"), ("Nm", "N·m"),
        ("U/min", "rpm"), ("r/min", "rpm"), ("RPM", "rpm"), ("kmh", "km/h"), ("kph", "km/h"), ("Ohm", "Ω"),
        ("ohms", "Ω"), ("m/s2", "m/s²"), ("rad/s2", "rad/s²"), ("sec", "s"), ("msec", "ms"), ("Volt", "V"),
        ("volts", "V"), ("Amp", "A"), ("amps", "A"), ("percent", "%"), ("%rH", "%"), ("% RH", "%"), ("%rel", "%"),
        (" V ", "V"), ("nm", "nm"), ("mm", "mm"), ("kPa", "kPa"),
    ],
)  # fmt: skip
def test_units_as_files_spell_them(written: str, unit: str) -> None:
    assert written_unit(written) == (unit, "")


def test_units_that_are_doubtful_have_a_note() -> None:
    assert written_unit("C") == ("C", "the unit 'C' was read as coulomb; if it is °C, write degC")
    assert written_unit("g") == ("g", "the unit 'g' was read as gram; if it is the acceleration of free fall, write gn")
    gauss = "the unit 'G' could be gauss; if it is the acceleration of free fall, write gn: values are plain numbers"
    assert written_unit("G") == ("count", gauss)
    assert written_unit("NM") == ("count", "the unit 'NM' is unknown: values are plain numbers")
    assert written_unit("blorp") == ("count", "the unit 'blorp' is unknown: values are plain numbers")
