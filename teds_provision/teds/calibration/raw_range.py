"""Which raw values a data model can give (DatModel, ModLenth, SigBits; ieee-1451.0.md section 4.2)."""

from __future__ import annotations

from typing import Final

UNSIGNED, FLOAT32, FLOAT64, FRACTION, BITS, LONG_INTEGER, LONG_FRACTION, TIME_OF_DAY = range(8)
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


def raw_range(model: int, octets: int, bits: int) -> tuple[float, float] | None:
    """Lowest and highest raw value, ends included; None where the model sets none (floats, bits, times, unknown).

    SigBits counts right-justified bits of an integer; 0, or more than the octets hold, means all of them.
    """
    width = 8 * octets
    if 0 < bits < width:
        width = bits
    if model in (UNSIGNED, LONG_INTEGER) and 0 < width <= 1023:
        return 0.0, float(2**width - 1)
    if model in (FRACTION, LONG_FRACTION) and width > 0:
        return 0.0, 1.0 - 2.0 ** -min(width, 1074)
    return None


def model_name(model: int) -> str:
    """Name of a DatModel."""
    return MODEL_NAMES[model] if 0 <= model < len(MODEL_NAMES) else f"model {model} (reserved)"
