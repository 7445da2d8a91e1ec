"""The zero of a mounted sensor: statistics of many samples, and a Calibration TEDS with another offset.

Values here are in the calibrated unit, the zero offset included, and before any limit is applied: a sensor whose zero
is off may well read beyond its limits.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from teds_provision.arrays import NDArray, np
from teds_provision.teds.calibration.model import Calibration, float32, instant
from teds_provision.teds.channel import TURN
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.composer import Composer, tuple_width
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.codec.frame import RawTuple, frame, raw_tuple, tuples, unframe
from teds_provision.teds.codec.tables import table

_SIGMAS: Final = 3
_STEP: Final = 2.0**-23


@dataclass(frozen=True)
class SampleStatistics:
    """Statistics of ``count`` samples: mean, standard deviation, and by how much the mean moved meanwhile.

    ``drift`` is the mean of the second half less that of the first.
    """

    mean: float
    spread: float
    drift: float
    count: int

    @property
    def doubt(self) -> float:
        """By how much another mean of as many samples may differ, for their spread and for Float32."""
        return _SIGMAS * self.spread / math.sqrt(self.count) + 4 * _STEP * abs(self.mean)

    def is_unstable(self, most: float) -> bool:
        """Return True if it spreads, or drifts, by more than ``most``."""
        return max(self.spread, abs(self.drift)) > most


def reading_of(values: NDArray[np.float64], turn: float = math.inf) -> SampleStatistics:
    """Return the reading of samples; ``turn``: they are angles in a unit with this turn, and their mean is circular.

    The mean of angles is within half a turn of the first one.
    """
    first = float(values[0])
    away = values - first
    if math.isfinite(turn):
        angles = away * (TURN / turn)
        middle = math.atan2(float(np.sin(angles).mean()), float(np.cos(angles).mean())) * (turn / TURN)
        away = middle + shortest(away - middle, turn)
    half = len(away) // 2
    drift = float(away[half:].mean() - away[:half].mean()) if half else 0.0
    return SampleStatistics(first + float(away.mean()), float(away.std()), drift, len(away))


def shortest(difference: NDArray[np.float64], turn: float) -> NDArray[np.float64]:
    """Return differences of angles the shorter way round, unchanged if ``turn`` is infinite."""
    return difference - turn * np.round(difference / turn) if math.isfinite(turn) else difference


def turn_of(calibration: Calibration, *, full_turn: bool) -> float:
    """Return a turn in the calibrated unit, infinite if the channel's values do not wrap."""
    return TURN / abs(calibration.unit.scale) if full_turn else math.inf


def offset_for(calibration: Calibration, reading: float, wanted: float, turn: float = math.inf) -> float:
    """Return the zero offset (as a Float32 holds it) with which a sensor that gives ``reading`` now gives ``wanted``.

    Of angles the one nearest to 0: an offset of whole turns has no effect.
    """
    offset = calibration.zero_offset + (wanted - reading)
    return float32((float(shortest(np.asarray(offset), turn)),), "zero_offset")[0]


def with_zero_offset(teds: bytes, offset: float, at: datetime) -> bytes:
    """Return a Calibration TEDS (Length to Checksum) with another zero offset and its date; all else octet for octet.

    Raises BadDataError for a TEDS that is damaged.
    """
    decoded = decode(teds)
    width = tuple_width(decoded)
    fields = table(AccessCode.CALIBRATION)
    composer = Composer(fields, decoded.edition or 2007, width)
    given = {"ZeroOffset": offset, "ZeroDate": instant(at)}
    new = [RawTuple(*composer.encode_field(name, value, fields.by_name)[:2], 0) for name, value in given.items()]
    head, *kept = tuples(unframe(teds), width=width)
    rest = [raw for raw in kept if raw.type not in {entry.type for entry in new}]
    for entry in new:  # keep the ascending order of types, as in all TEDS of this program
        at_place = next((n for n, raw in enumerate(rest) if raw.type > entry.type), len(rest))
        rest.insert(at_place, entry)
    return frame(
        raw_tuple(head.type, head.value) + b"".join(raw_tuple(raw.type, raw.value, width=width) for raw in rest)
    )
