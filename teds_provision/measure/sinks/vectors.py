"""Messages of several channels: a vector group of the Meta-TEDS whose unit determines the type, and range finders.

| channels | message | topic |
|---|---|---|
| three of T | sensor_msgs/MagneticField | ``/<station>/<node>/magnetic_field`` |
| three of m/s², three of rad/s, or both | sensor_msgs/Imu | ``…/imu`` |
| three of N and three of N·m | geometry_msgs/WrenchStamped | ``…/wrench`` |
| one in m of a channel named as range finder | sensor_msgs/Range | the channel's own |

The members of a vector group (Meta-TEDS, VGroup) are its axes x, y, z in their order. Whatever is not measured is
marked as sensor_msgs asks: the first element of its covariance is -1. A covariance of 0 is unknown.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Final

from teds_provision.measure.blocks import ChannelFacts
from teds_provision.teds.codec.model import Units
from teds_provision.teds.units import units_of

# Which ROS message fits a channel: by unit and meaning, otherwise a plain number.
#
# REP 103: SI units and radians. A variance of 0 means "unknown" in sensor_msgs. If a profile has the standard
# deviation, the variance is its square. The uncertainty of a datasheet (OError) is a worst case; if every error within
# it is equally likely, the variance is (OError / √3)²; the metadata state this.

KELVIN = 273.15  # 0 °C
VARIANCE_NOTE = (
    "variance = deviation^2 where the profile knows a standard deviation, else (uncertainty / sqrt 3)^2: every error "
    "within the worst case equally likely"
)
_RATIOS = (Units(), Units(interpretation=1))  # a plain number, a ratio of equal units
_KELVIN = units_of(kelvins=1)
_STRESS = units_of(meters=-1, kilograms=1, seconds=-2)
_LUX = units_of(meters=-2, candelas=1, steradians=1)


@dataclass(frozen=True)
class Meaning:
    """Type of a channel's scalar topic, and how a value in the datasheet's SI unit becomes its field."""

    type: str  # ROS 1 spelling: sensor_msgs/Temperature
    field: str
    shift: float = 0.0
    variance: bool = False  # True if the message has a field for it

    def field_value(self, value: float) -> float:
        """Return the value of the message's field."""
        return value + self.shift


NUMBER = Meaning("std_msgs/Float64", "data")
TEMPERATURE = Meaning("sensor_msgs/Temperature", "temperature", -KELVIN, True)
PRESSURE = Meaning("sensor_msgs/FluidPressure", "fluid_pressure", 0.0, True)
HUMIDITY = Meaning("sensor_msgs/RelativeHumidity", "relative_humidity", 0.0, True)
ILLUMINANCE = Meaning("sensor_msgs/Illuminance", "illuminance", 0.0, True)


def meaning_of(facts: ChannelFacts) -> Meaning:
    """Return the meaning, typed only if unit and meaning fit: a ratio is humidity only if the names mean it."""
    if facts.kind == "actuator":
        return NUMBER
    words = f"{facts.quantity} {facts.name}".lower().replace("_", " ").replace("-", " ")
    if "relative humidity" in words and facts.units in _RATIOS:
        return HUMIDITY
    if facts.units == _STRESS and {"stress", "modulus", "strength"} & set(words.split()):
        return NUMBER
    if facts.units is None:
        return NUMBER
    return {_KELVIN: TEMPERATURE, _STRESS: PRESSURE, _LUX: ILLUMINANCE}.get(facts.units, NUMBER)


def variance_of(facts: ChannelFacts) -> float:
    """Return the variance for sensor_msgs; 0 if neither profile nor datasheet has one."""
    if facts.deviation:
        return facts.deviation**2
    return facts.uncertainty**2 / 3 if facts.uncertainty else 0.0


FieldValue = float | int | list[float]
AXES: Final = ("x", "y", "z")
_FIELD = units_of(kilograms=1, seconds=-2, amperes=-1)
_ACCELERATION = units_of(meters=1, seconds=-2)
_RATE = units_of(radians=1, seconds=-1)
_FORCE = units_of(meters=1, kilograms=1, seconds=-2)
_TORQUE = units_of(meters=2, kilograms=1, seconds=-2)
_LENGTH = units_of(meters=1)
_RANGE_WORDS = ("range finder", "rangefinder", "distance sensor")
_NOT_MEASURED: Final = [-1.0, *[0.0] * 8]
_INFRARED: Final = 1


@dataclass(frozen=True)
class Compound:
    """One message: its type (ROS 1 spelling), the end of its topic ("" for the channel's own), and its values.

    ``parts`` are (path of the field, channel number), ``fixed`` the other fields by path.
    """

    type: str
    name: str
    parts: tuple[tuple[str, int], ...]
    fixed: Mapping[str, FieldValue] = field(default_factory=dict)

    def fields(self, values: Mapping[int, float]) -> dict[str, FieldValue] | None:
        """Return all fields by path; None if a value is missing or not finite: half a vector is none."""
        found: dict[str, FieldValue] = dict(self.fixed)
        for path, number in self.parts:
            value = values.get(number, math.nan)
            if not math.isfinite(value):
                return None
            found[path] = value
        return found


def compounds_of(facts: Iterable[ChannelFacts]) -> list[Compound]:
    """Return the messages that the channels of one stream of one node make together."""
    sensors = {channel_facts.number: channel_facts for channel_facts in facts if channel_facts.kind == "sensor"}
    by_unit = _vectors(sensors)
    found = [_magnetic(axes) for axes in by_unit.get(_FIELD, [])]
    found += _imus(by_unit.get(_ACCELERATION, []), by_unit.get(_RATE, []))
    pairs = zip(by_unit.get(_FORCE, []), by_unit.get(_TORQUE, []), strict=False)
    found += [
        Compound("geometry_msgs/WrenchStamped", "wrench", (*_paths("wrench.force", f), *_paths("wrench.torque", t)))
        for f, t in pairs
    ]
    return [*_without_namesakes(found), *(_range(facts) for facts in sensors.values() if is_range(facts))]


def _vectors(sensors: Mapping[int, ChannelFacts]) -> dict[object, list[list[ChannelFacts]]]:
    """Return the axes of each whole vector whose axes have one unit, by that unit."""
    groups = {
        facts.vector: [sensors[n] for n in facts.vector]
        for facts in sensors.values()
        if len(facts.vector) == len(AXES) and all(number in sensors for number in facts.vector)
    }
    by_unit: dict[object, list[list[ChannelFacts]]] = {}
    for axes in groups.values():
        if len({facts.units for facts in axes}) == 1:
            by_unit.setdefault(axes[0].units, []).append(axes)
    return by_unit


def is_range(facts: ChannelFacts) -> bool:
    """Return True if a channel is a range finder: by its unit and the name in profile or datasheet."""
    words = f"{facts.quantity} {facts.name}".lower().replace("_", " ").replace("-", " ")
    return facts.kind == "sensor" and facts.units == _LENGTH and any(word in words for word in _RANGE_WORDS)


def _paths(field_name: str, axes: list[ChannelFacts]) -> tuple[tuple[str, int], ...]:
    return tuple((f"{field_name}.{axis}", facts.number) for axis, facts in zip(AXES, axes, strict=True))


def _covariance(axes: list[ChannelFacts]) -> list[float]:
    """Return the covariance row by row; only the diagonal is known."""
    found = [0.0] * 9
    for k, facts in enumerate(axes):
        found[4 * k] = variance_of(facts)
    return found


def _magnetic(axes: list[ChannelFacts]) -> Compound:
    fixed: dict[str, FieldValue] = {"magnetic_field_covariance": _covariance(axes)}
    return Compound("sensor_msgs/MagneticField", "magnetic_field", _paths("magnetic_field", axes), fixed)


def _imus(accelerations: list[list[ChannelFacts]], rates: list[list[ChannelFacts]]) -> list[Compound]:
    found = []
    for k in range(max(len(accelerations), len(rates))):
        parts: tuple[tuple[str, int], ...] = ()
        fixed: dict[str, FieldValue] = {"orientation_covariance": _NOT_MEASURED, "orientation.w": 1.0}
        for name, groups in (("linear_acceleration", accelerations), ("angular_velocity", rates)):
            axes = groups[k] if k < len(groups) else None
            fixed[f"{name}_covariance"] = _NOT_MEASURED if axes is None else _covariance(axes)
            parts += () if axes is None else _paths(name, axes)
        found.append(Compound("sensor_msgs/Imu", "imu", parts, fixed))
    return found


def _range(facts: ChannelFacts) -> Compound:
    """Return a Range; the angle of its cone is not in a datasheet: 0."""
    fixed: dict[str, FieldValue] = {
        "radiation_type": _INFRARED,
        "min_range": 0.0 if facts.low is None else facts.low,
        "max_range": math.inf if facts.high is None else facts.high,
        "variance": variance_of(facts),
    }
    return Compound("sensor_msgs/Range", "", (("range", facts.number),), fixed)


def _without_namesakes(found: list[Compound]) -> list[Compound]:
    """Return the compounds; two of one name get the number of their first channel appended."""
    names = [compound.name for compound in found]
    return [
        compound
        if names.count(compound.name) == 1
        else Compound(compound.type, f"{compound.name}_{compound.parts[0][1]}", compound.parts, compound.fixed)
        for compound in found
    ]
