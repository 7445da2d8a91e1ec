"""Transports for pages, rosters and parcels: a folder (a removable disk, a share), or PostgreSQL. All are untrusted.

A carrier can withhold, repeat and add junk, and no more: it gives octets, and every reader checks who signed them. So a
transport never raises because of its content; it raises LinkError if it cannot be reached and PolicyError if it denies
access.
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
    """A page in a transport: whose, which number, its octets; unverified.

    ``by``: the member that handed it in for its author; "" if the author appended it, or a folder holds it.
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
        """Return a text that changes with what was handed in of a station.

        "" if it is an open member and nothing was.
        """

    def was_handed_in(self, station: str) -> bool:
        """Return True if a member handed in a page of this station."""

    def is_open(self, station: str) -> bool:
        """Return True if the station appends its pages itself."""

    def head(self, station: str) -> int:
        """Return the number of the newest page that the station appended itself."""

    def offers(self, station: str) -> list[Offer]:
        """Return every page of a station, from any sender."""

    def octets(self, offers: Sequence[Offer]) -> list[CarriedPage]:
        """Return the offered pages; one that is gone is left out."""

    def restore(self, author: str, pages: Sequence[tuple[int, bytes]]) -> None:
        """Hand in pages (number, octets) of a station. Raises PolicyError."""


@dataclass(frozen=True)
class Parcel:
    """A document for one station (``to``), or from one: random id, octets, when it expires (ISO 8601).

    ``sender`` is "" if it is unknown.
    """

    id: str
    to: str
    octets: bytes = field(repr=False)
    expires: str
    sender: str = ""


class Transport(Protocol):
    """Transport between the stations of one registry."""

    carries_all: bool
    """True for a folder: stations also put the pages of other stations into it, which it gets in no other way."""

    returned: Returned | None
    """Pages that members handed in for stations that left; None for a folder, which all stations fill."""

    where: str
    """For people: the folder, or the URL without anything secret."""

    def registry(self) -> str | None:
        """Return the registry (UUID) that this is of; None if only its rosters name it."""

    def rosters(self) -> Iterator[bytes]:
        """Yield every roster in it."""

    def post_roster(self, version: int, hash: str, octets: bytes) -> None:
        """Put a roster there; the same again changes nothing, and another one of that version stays beside it."""

    def heads(self) -> Mapping[str, int]:
        """Return the greatest number of a page, by station."""

    def pages(self, station: str, after: int) -> Iterator[CarriedPage]:
        """Yield the pages of a station above a number, ascending.

        A folder gives all that it has, several of one number.
        """

    def append(self, station: str, n: int, previous: str, hash: str, octets: bytes) -> None:
        """Append a page; the same again changes nothing. Raises ForkError if another one has its place."""

    def parcels(self, to: str) -> Iterator[Parcel]:
        """Yield the parcels for a station."""

    def new_parcels(self, to: str, known: Collection[str]) -> Iterator[Parcel]:
        """Yield the parcels for a station, skipping known ids and those larger than ``SMALL``.

        Looks again; at most ``AT_ONCE``, the others at the next call.
        """

    def send(self, parcel: Parcel) -> None:
        """Send a parcel; the same id again changes nothing. Raises PolicyError if no more is accepted."""

    def drop(self, parcel: str, to: str) -> None:
        """Delete a parcel, if it still exists."""

    def close(self) -> None:
        """Let go of it."""
