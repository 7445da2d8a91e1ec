"""How pages, rosters and parcels travel: a folder (a stick, a share), or PostgreSQL. A post office decides nothing.

Whoever carries can withhold, repeat and put in junk, and no more: what it gives is octets, and every reader checks who
signed them. So a post never raises because of what lies there; it raises LinkError where it cannot be reached and
PolicyError where it lets nobody in.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Protocol

SMALL: Final = 8 << 20
"""Documents of a line are smaller, sealed; a larger parcel is a bundle."""
AT_ONCE: Final = 16


@dataclass(frozen=True)
class CarriedPage:
    """A page as it lies there: whose, which number, its octets; none of it is checked.

    ``by``: the member that handed it in for its author; "" if the author put it there, or a folder holds it.
    """

    station: str
    number: int
    octets: bytes = field(repr=False)
    by: str = ""


@dataclass(frozen=True)
class Offer:
    """A page that a database holds: author, number, H, SHA-256 of its octets, and who handed it in ("": its author)."""

    station: str
    n: int
    hash: str
    digest: str
    by: str


class Returned(Protocol):
    """Pages of stations that are no open member, which others hand in: see :class:`.postgres.ReturnedPages`."""

    @property
    def takes_pages(self) -> bool:
        """False if the database cannot take such pages."""

    def state(self, station: str) -> str:
        """A text that changes with what was handed in of a station; "" if it is an open member and nothing was."""

    def was_handed_in(self, station: str) -> bool:
        """True if a member handed in a page of this station."""

    def is_open(self, station: str) -> bool:
        """True if the station appends its pages itself."""

    def head(self, station: str) -> int:
        """The number of the newest page that the station appended itself."""

    def offers(self, station: str) -> list[Offer]:
        """Every page of a station that is there, whoever put it there."""

    def octets(self, offers: Sequence[Offer]) -> list[CarriedPage]:
        """The pages that were offered; one that is gone is left out."""

    def restore(self, author: str, pages: Sequence[tuple[int, bytes]]) -> None:
        """Hand in pages (number, octets) of a station. Raises PolicyError."""


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


class Transport(Protocol):
    """What carries between the stations of one registry."""

    everybody: bool
    """Whether pages of others are brought there too: a folder has no other way to get them."""

    returned: Returned | None
    """What members handed in for stations that left; None for a folder, which everybody fills."""

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

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        """The pages of a station above a number, ascending; a folder gives all that it has, several of one number."""

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        """Put a page there; the same again changes nothing. Raises ForkError if another one has its place for good."""

    def parcels(self, to: str) -> Iterator[Parcel]:
        """What lies there for a station."""

    def new_parcels(self, to: str, known: Collection[str]) -> Iterator[Parcel]:
        """What lies there now for a station, but for the ids that it knows and what is larger than ``SMALL``.

        Looks anew; at most ``AT_ONCE``, the others at the next call.
        """

    def send(self, parcel: Parcel) -> None:
        """Put a parcel there; the same id again changes nothing. Raises PolicyError where no more is taken."""

    def drop(self, parcel: str, to: str) -> None:
        """Throw a parcel away; one that is gone is no error."""

    def close(self) -> None:
        """Let go of it."""
