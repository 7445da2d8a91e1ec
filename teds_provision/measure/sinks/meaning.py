"""Which ROS message fits a channel: by unit and meaning, else a plain number.

REP 103: SI units and radians. A variance of 0 means "unknown" in sensor_msgs. The uncertainty of a datasheet (OError)
is a worst case; (OError / √3)² is its variance if every error inside is equally likely, which the metadata say.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from teds_provision.measure.blocks import ChannelFacts
from teds_provision.teds.codec.model import Units
from teds_provision.teds.units import units_of

KELVIN = 273.15  # 0 °C
VARIANCE_NOTE = "variance = (uncertainty / sqrt 3)^2: every error within the worst case equally likely"
_KELVIN = units_of(kelvins=1)
_STRESS = units_of(meters=-1, kilograms=1, seconds=-2)
_LUX = units_of(meters=-2, candelas=1, steradians=1)


@dataclass(frozen=True)
class Meaning:
    """Type of a channel's scalar topic, and how a value in the datasheet's SI unit becomes its field."""

    type: str  # ROS 1 spelling: sensor_msgs/Temperature
    field: str
    shift: float = 0.0
    variance: bool = False  # whether the message has a field for it

    def field_value(self, value: float) -> float:
        """Value of the message's field."""
        return value + self.shift


NUMBER = Meaning("std_msgs/Float64", "data")
TEMPERATURE = Meaning("sensor_msgs/Temperature", "temperature", -KELVIN, True)
PRESSURE = Meaning("sensor_msgs/FluidPressure", "fluid_pressure", 0.0, True)
HUMIDITY = Meaning("sensor_msgs/RelativeHumidity", "relative_humidity", 0.0, True)
ILLUMINANCE = Meaning("sensor_msgs/Illuminance", "illuminance", 0.0, True)


def meaning_of(facts: ChannelFacts) -> Meaning:
    """Typed only where unit and meaning fit: a ratio is humidity only where the names say so."""
    if facts.kind == "actuator":
        return NUMBER
    words = f"{facts.quantity} {facts.name}".lower().replace("_", " ").replace("-", " ")
    if "relative humidity" in words and facts.units is not None and replace(facts.units, interpretation=0) == Units():
        return HUMIDITY
    if facts.units == _STRESS and {"stress", "modulus", "strength"} & set(words.split()):
        return NUMBER
    if facts.units is None:
        return NUMBER
    return {_KELVIN: TEMPERATURE, _STRESS: PRESSURE, _LUX: ILLUMINANCE}.get(facts.units, NUMBER)


def variance_of(facts: ChannelFacts) -> float:
    """Variance for sensor_msgs; 0 where the datasheet does not say."""
    return facts.uncertainty**2 / 3 if facts.uncertainty else 0.0
