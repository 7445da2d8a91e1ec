"""How pages, rosters and parcels travel: a folder (a stick, a share), or PostgreSQL. A post office decides nothing.

Whoever carries can withhold, repeat and put in junk, and no more: what it gives is octets, and every reader checks who
signed them. So a post never raises because of what lies there; it raises LinkFailure where it cannot be reached and
PolicyRefused where it lets nobody in.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final, Protocol

SMALL: Final = 8 << 20
"""Documents of a line are smaller, sealed; a larger parcel is a bundle."""
AT_ONCE: Final = 16


@dataclass(frozen=True)
class Carried:
    """A page as it lies there: whose, which number, its octets; none of it is checked."""

    station: str
    n: int
    octets: bytes = field(repr=False)


@dataclass(frozen=True)
class Parcel:
    """A document for one station (``to``), or from one: random id, octets, when it is thrown away (ISO 8601).

    ``sender`` is "" where nobody wrote it down.
    """

    id: str
    to: str
    octets: bytes = field(repr=False)
    expires: str
    sender: str = ""


class Post(Protocol):
    """What carries between the stations of one registry."""

    everybody: bool
    """Whether pages of others are brought there too: a folder has no other way to get them."""

    where: str
    """For people: the folder, or the URL without anything secret."""

    def registry(self) -> str | None:
        """The registry (UUID) that this is of; None where nothing says so: the rosters that lie there do then."""

    def rosters(self) -> Iterator[bytes]:
        """Every roster that lies there."""

    def post_roster(self, version: int, hash: str, octets: bytes) -> None:
        """Put a roster there; the same again changes nothing, and another one of that version stays beside it."""

    def heads(self) -> Mapping[str, int]:
        """The greatest number of a page that is there, by station."""

    def pages(self, station: str, after: int) -> Iterator[Carried]:
        """The pages of a station above a number, ascending; a folder gives all that it has, several of one number."""

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        """Put a page there; the same again changes nothing. Raises Fork where another one has its place for good."""

    def parcels(self, to: str) -> Iterator[Parcel]:
        """What lies there for a station."""

    def new_parcels(self, to: str, known: Collection[str]) -> Iterator[Parcel]:
        """What lies there now for a station, but for the ids that it knows and what is larger than ``SMALL``.

        Looks anew; at most ``AT_ONCE``, the others at the next call.
        """

    def send(self, parcel: Parcel) -> None:
        """Put a parcel there; the same id again changes nothing. Raises PolicyRefused where no more is taken."""

    def drop(self, parcel: str, to: str) -> None:
        """Throw a parcel away; one that is gone is no error."""

    def close(self) -> None:
        """Let go of it."""
