"""The UUID of a Meta-TEDS taken apart: place, year and time (teds.md, "Data types").

2007, 10 octets: north 1 bit, latitude 20 bits in arc seconds, east 1, longitude 20, manufacturer 4, year 12, time 22
bits in units of 10 s since the start of that year (TAI). 2024, 16 octets: location 48 bits (1 + 23 + 1 + 23),
manufacturer 24, year 16, time 40 bits; the unit of the location is open, that of the time (milliseconds) a guess from
two examples. Many UUIDs in the field are random octets: all are unpacked, and ``plausible`` is True if the result makes
sense.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.model import Edition

_ARC_SECONDS: Final = 3600
_FORMS: Final = {
    # Edition: bits of latitude, longitude, manufacturer, year, time.
    2007: (20, 20, 4, 12, 22),
    2024: (23, 23, 24, 16, 40),
}
_YEARS: Final = range(1990, 2200)


@dataclass(frozen=True)
class UuidParts:
    """Parts of a UUID as whole numbers in the units of its edition.

    ``latitude`` and ``longitude`` are arc seconds in 2007, digits of an unclear unit in 2024; ``time`` counts 10 s
    (2007) or milliseconds (2024, probably) from the start of ``year``.
    """

    edition: Edition
    north: bool
    latitude: int
    east: bool
    longitude: int
    manufacturer: int
    year: int
    time: int

    @classmethod
    def at(cls, latitude: float, longitude: float, *, manufacturer: int, year: int, seconds: float) -> UuidParts:
        """Return the parts of a 2007 UUID: degrees (north and east positive), seconds since the start of the year."""
        return cls(
            2007,
            latitude >= 0,
            round(abs(latitude) * _ARC_SECONDS),
            longitude >= 0,
            round(abs(longitude) * _ARC_SECONDS),
            manufacturer,
            year,
            int(seconds // 10),
        )

    @property
    def degrees(self) -> tuple[float, float] | None:
        """Latitude and longitude in degrees, north and east positive; None in 2024, whose unit is unclear."""
        if self.edition != 2007:
            return None
        latitude, longitude = self.latitude / _ARC_SECONDS, self.longitude / _ARC_SECONDS
        return (latitude if self.north else -latitude, longitude if self.east else -longitude)

    @property
    def moment(self) -> datetime | None:
        """Time of manufacture (TAI, without time zone), None if year and time give no moment in that year."""
        if not 1 <= self.year <= 9998:
            return None
        elapsed = timedelta(seconds=10 * self.time) if self.edition == 2007 else timedelta(milliseconds=self.time)
        moment = datetime(self.year, 1, 1) + elapsed
        return moment if moment.year == self.year else None

    @property
    def plausible(self) -> bool:
        """True if place, year and time make sense: random octets rarely do."""
        degrees = self.degrees
        placed = degrees is None or (abs(degrees[0]) <= 90 and abs(degrees[1]) <= 180)
        return placed and self.year in _YEARS and self.moment is not None


def unpack_uuid(octets: bytes) -> UuidParts | None:
    """Take a UUID of 10 (2007) or 16 octets (2024) apart; None for any other number of octets, never an error."""
    if len(octets) not in (10, 16):
        return None
    edition: Edition = 2007 if len(octets) == 10 else 2024
    rest = int.from_bytes(octets, "big")
    lat, lon, maker, year, time = _FORMS[edition]
    parts = []
    for bits in (time, year, maker, lon, 1, lat, 1):
        parts.append(rest & ((1 << bits) - 1))
        rest >>= bits
    return UuidParts(edition, bool(parts[6]), parts[5], bool(parts[4]), parts[3], parts[2], parts[1], parts[0])


def pack_uuid(parts: UuidParts) -> bytes:
    """Put a UUID together, 10 or 16 octets after its edition; raises BadDataError naming a part that does not fit."""
    lat, lon, maker, year, time = _FORMS[parts.edition]
    packed = 0
    for name, value, bits in (
        ("north", int(parts.north), 1),
        ("latitude", parts.latitude, lat),
        ("east", int(parts.east), 1),
        ("longitude", parts.longitude, lon),
        ("manufacturer", parts.manufacturer, maker),
        ("year", parts.year, year),
        ("time", parts.time, time),
    ):
        if not 0 <= value < 1 << bits:
            raise BadDataError(f"The {name} of a {parts.edition} UUID has {bits} bits, {value} does not fit.")
        packed = packed << bits | value
    return packed.to_bytes(10 if parts.edition == 2007 else 16, "big")
