"""Samples of a channel: data model, octets and bits, the possible raw numbers, and reading and writing them.

DatModel, ModLenth and SigBits are fields 40 to 42 of the TransducerChannel TEDS (teds.md, "3 ChanTEDS"). Samples come
in blocks (operation.md section 2): a number of samples of one channel, each ModLenth octets, most significant octet
first. Integers are right-justified, floats are IEEE 754, a fraction has its point before the first bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Any, Final

from teds_provision.arrays import NDArray, Octets, np
from teds_provision.errors import BadDataError

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
# Octets of one sample, minimum and maximum, by data model; other models are reserved.
SAMPLE_OCTETS: Final = {
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
    """Form of one sample on the wire: DatModel, ModLenth (octets), SigBits; 0 if the TEDS has none."""

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
        """Lowest and highest raw value that it can give; None if it sets none."""
        return raw_range(self.model, self.octets, self.bits)

    @property
    def integer(self) -> bool:
        """True if raw values are whole numbers."""
        return self.model in (DataModel.UNSIGNED, DataModel.LONG_INTEGER)

    @property
    def problem(self) -> str:
        """Why samples of this form cannot be read as numbers, as half a sentence; "" if they can."""
        if self.model not in SAMPLE_OCTETS:
            return f"its data model {self.model} is reserved"
        least, most = SAMPLE_OCTETS[DataModel(self.model)]
        if not least <= self.octets <= most:
            asked = str(least) if least == most else f"{least} to {most}"
            return f"its samples are {model_name(self.model)} of {self.octets} octets; {asked} are possible"
        return ""


def raw_range(model: int, octets: int, bits: int) -> Range | None:
    """Return lowest and highest raw value, ends included; None if the model sets none (floats, bits, times, unknown).

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


WORD: Final = 8
_NEGATIVE: Final = 1 << 31
_FLOATS: Final = {DataModel.FLOAT32: ">f4", DataModel.FLOAT64: ">f8"}
_INTEGERS: Final = (DataModel.UNSIGNED, DataModel.BITS, DataModel.LONG_INTEGER)
_FRACTIONS: Final = (DataModel.FRACTION, DataModel.LONG_FRACTION)


@dataclass(frozen=True)
class SampleReader:
    """Reads and writes samples of one form, prepared once. Raises BadDataError for a form that cannot be read."""

    form: SampleForm

    def __post_init__(self) -> None:
        if self.form.problem:
            raise BadDataError(f"The samples cannot be read: {self.form.problem}.")

    @property
    def octets(self) -> int:
        """Octets of one sample."""
        return self.form.octets

    @cached_property
    def _long(self) -> bool:
        return self.form.octets > WORD

    def raw(self, octets: Octets) -> NDArray[np.generic]:
        """Return raw values by the data model: unsigned 64-bit integers, Float64 for floats, fractions and times.

        Integers and bits of more than 8 octets come as Python integers in an object array. Takes octets one sample
        after the other, or an array of shape (samples, ModLenth). Raises BadDataError if they do not divide evenly.
        """
        rows = self._rows(octets)
        model = self.form.model
        if model in _FLOATS:
            return np.ascontiguousarray(rows).view(_FLOATS[DataModel(model)])[:, 0].astype(np.float64)
        if model == DataModel.TIME_OF_DAY:
            # TimeInstance: seconds, and nanoseconds whose highest bit is the sign of the whole value.
            seconds = _words(rows[:, :4]).astype(np.float64)
            nanoseconds = _words(rows[:, 4:])
            value = seconds + (nanoseconds & (_NEGATIVE - 1)).astype(np.float64) * 1e-9
            return np.where(nanoseconds & _NEGATIVE, -value, value)
        if model in _FRACTIONS:
            whole = 8 * self.form.octets
            if not self._long:
                return _words(rows).astype(np.float64) * 2.0**-whole
            return np.array([number / (1 << whole) for number in _as_integers(rows).tolist()], dtype=np.float64)
        return _as_integers(rows) if self._long else _words(rows)

    def numbers(self, raw: NDArray[np.generic]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Return raw values as Float64, and which of them their data model and SigBits can have.

        Of integers above 2^53 the nearest Float64 is taken; one that no Float64 can hold is infinite, and not possible.
        """
        if raw.dtype == object:
            values = np.array([_float(number) for number in raw.tolist()], dtype=np.float64)
        else:
            values = raw.astype(np.float64)
        possible = np.isfinite(values)
        if self.form.integer and self.form.raw_range is not None:
            possible &= values <= self.form.raw_range[1]
        return values, possible

    def write(self, numbers: NDArray[np.float64]) -> bytes:
        """Return octets of raw numbers, rounded to the nearest that the form can hold, and clipped to its range.

        Raises BadDataError for a number that is not finite, and for bit sequences and times, which are not quantities.
        """
        if self.form.model in (DataModel.BITS, DataModel.TIME_OF_DAY):
            raise BadDataError(f"A number cannot be written as {self.form.name}.")
        numbers = np.atleast_1d(np.asarray(numbers, dtype=np.float64))
        if not np.isfinite(numbers).all():
            raise BadDataError("A value that is not finite cannot be written as a sample.")
        if self.form.model in _FLOATS:
            most = float(np.finfo(_FLOATS[DataModel(self.form.model)]).max)
            return np.clip(numbers, -most, most).astype(_FLOATS[DataModel(self.form.model)]).tobytes()
        return b"".join(self._integer(float(number)) for number in numbers)

    def _integer(self, number: float) -> bytes:
        whole, used = 8 * self.form.octets, self.form.bits
        bits = used if 0 < used < whole else whole
        if self.form.model in _FRACTIONS:  # the leading bits are used, the others are 0
            # number × 2^bits to the nearest integer, exact for any number of bits
            above, below = min(max(number, 0.0), 1.0).as_integer_ratio()
            steps = ((above << (bits + 1)) + below) // (2 * below)
            return (min(steps, (1 << bits) - 1) << (whole - bits)).to_bytes(self.form.octets, "big")
        return min(max(round(number), 0), (1 << bits) - 1).to_bytes(self.form.octets, "big")

    def _rows(self, octets: Octets) -> NDArray[np.uint8]:
        rows = octets if isinstance(octets, np.ndarray) else np.frombuffer(octets, dtype=np.uint8)
        size = self.form.octets
        if rows.ndim == 1:
            if len(rows) % size:
                raise BadDataError(f"{len(rows)} octets are no whole number of samples of {size} octets.")
            rows = rows.reshape(-1, size)
        elif rows.shape[1] != size:
            raise BadDataError(f"A sample of {rows.shape[1]} octets was given; the data model has {size}.")
        return rows


def big_endian(rows: NDArray[np.uint8]) -> NDArray[Any]:
    """Return the octets of the last axis (at most 8) as integers of 64 bits, high octet first."""
    padded = np.zeros((*rows.shape[:-1], WORD), dtype=np.uint8)
    padded[..., WORD - rows.shape[-1] :] = rows
    return padded.view(">u8")[..., 0]


def _words(rows: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return rows of up to 8 octets as integers."""
    return big_endian(rows).astype(np.uint64)


def _as_integers(rows: NDArray[np.uint8]) -> NDArray[np.object_]:
    """Return rows of any number of octets as Python integers."""
    out = np.empty(len(rows), dtype=object)
    out[:] = [int.from_bytes(row.tobytes(), "big") for row in rows]
    return out


def _float(number: int) -> float:
    try:
        return float(number)
    except OverflowError:
        return math.inf
