"""What one sample of a channel is: its data model, octets and bits, and the raw numbers that they can give.

DatModel, ModLenth and SigBits are fields 40 to 42 of the TransducerChannel TEDS (teds.md, "3 ChanTEDS"). Turning
octets into numbers in blocks is :mod:`teds_provision.teds.calibration.reading`.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Final

Range = tuple[float, float]
"""Lowest and highest value, ends included."""


class DataModel(IntEnum):
    """DatModel: how the octets of one sample are coded."""

    UNSIGNED = 0
    FLOAT32 = 1
    FLOAT64 = 2
    FRACTION = 3
    BITS = 4
    LONG_INTEGER = 5
    LONG_FRACTION = 6
    TIME_OF_DAY = 7


MODEL_NAMES: Final = (
    "unsigned integer",
    "Float32",
    "Float64",
    "fraction",
    "bit sequence",
    "long integer",
    "long fraction",
    "time of day",
)
# Octets that one sample of a model has, first and last; models that are not here are reserved.
_OCTETS: Final = {
    DataModel.UNSIGNED: (1, 8),
    DataModel.FLOAT32: (4, 4),
    DataModel.FLOAT64: (8, 8),
    DataModel.FRACTION: (1, 8),
    DataModel.BITS: (1, 255),
    DataModel.LONG_INTEGER: (9, 255),
    DataModel.LONG_FRACTION: (9, 255),
    DataModel.TIME_OF_DAY: (8, 8),
}


@dataclass(frozen=True)
class SampleForm:
    """How one sample stands on the wire: DatModel, ModLenth (octets), SigBits; 0 where the TEDS does not say."""

    model: int
    octets: int
    bits: int = 0

    @property
    def name(self) -> str:
        """``unsigned integer, 2 octets, 12 bits``."""
        used = f", {self.bits} bits" if 0 < self.bits < 8 * self.octets else ""
        return f"{model_name(self.model)}, {self.octets} octet{'' if self.octets == 1 else 's'}{used}"

    @property
    def raw_range(self) -> Range | None:
        """Lowest and highest raw value that it can give; None where it sets none."""
        return raw_range(self.model, self.octets, self.bits)

    @property
    def integer(self) -> bool:
        """Whether raw values are whole numbers."""
        return self.model in (DataModel.UNSIGNED, DataModel.LONG_INTEGER)

    @property
    def problem(self) -> str:
        """Why samples of this form cannot be read as numbers, as half a sentence; "" where they can."""
        if self.model not in _OCTETS:
            return f"its data model {self.model} is reserved"
        least, most = _OCTETS[DataModel(self.model)]
        if not least <= self.octets <= most:
            asked = str(least) if least == most else f"{least} to {most}"
            return f"its samples are {model_name(self.model)} of {self.octets} octets; {asked} are possible"
        return ""


def raw_range(model: int, octets: int, bits: int) -> Range | None:
    """Lowest and highest raw value, ends included; None where the model sets none (floats, bits, times, unknown).

    SigBits counts right-justified bits of an integer, and the leading bits of a fraction; 0, or more than the octets
    hold, means all of them.
    """
    width = 8 * octets
    if 0 < bits < width:
        width = bits
    if model in (DataModel.UNSIGNED, DataModel.LONG_INTEGER) and 0 < width <= 1023:
        return 0.0, float(2**width - 1)
    if model in (DataModel.FRACTION, DataModel.LONG_FRACTION) and width > 0:
        return 0.0, 1.0 - 2.0 ** -min(width, 1074)
    return None


def model_name(model: int) -> str:
    """Name of a DatModel."""
    return MODEL_NAMES[model] if 0 <= model < len(MODEL_NAMES) else f"model {model} (reserved)"
