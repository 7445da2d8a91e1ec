"""Take in the pages of other stations (contract/plant.md section 2); only the signature decides, not the transport."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

from teds_provision.errors import NotAuthenticError, TedsProvisionError
from teds_provision.plant.apply_pages import EVENTS_AT_ONCE, alarm, take_pages
from teds_provision.plant.transport import CarriedPage, Transport
from teds_provision.protocol.plant.document import NewerFormatError, hash_of
from teds_provision.protocol.plant.page import Page, open_page
from teds_provision.protocol.plant.roster import Roster
from teds_provision.sanitize import counted
from teds_provision.station.station import Station


@dataclass
class Taken:
    """The result of reading pages of one station: how many were taken, and which ones it did not sign."""

    pages: int = 0
    junk: list[CarriedPage] = field(default_factory=list)
    waits: str | None = None
    """Why the chain is not read on: a page of a newer format."""


def open_carried(carried: CarriedPage, roster: Roster, station: str) -> Page:
    """Return a page that its station signed and that is in its own place.

    Raises NotAuthenticError, NewerFormatError.
    """
    page = open_page(carried.octets, roster.registry, roster.point_of)
    if page.station != station or page.number != carried.number:
        raise NotAuthenticError("It is in the place of another page.")
    return page


def read_pages(carried: Iterable[CarriedPage], roster: Roster, station: str) -> tuple[list[Page], list[int]]:
    """Return the pages that a station signed among those under its name, and the numbers of those that it did not."""
    good: list[Page] = []
    junk: list[int] = []
    for carried_page in carried:
        try:
            good.append(open_carried(carried_page, roster, station))
        except NewerFormatError:
            raise
        except TedsProvisionError:
            junk.append(carried_page.number)
    return good, junk


def fetch(station: Station, transport: Transport, roster: Roster) -> int:
    """Take in other stations' pages, station by station, and return how many came.

    Faults in the pages of one station delay no other's.
    """
    heads, fetched = transport.heads(), 0
    for fingerprint in roster.by_key:
        if fingerprint == station.fingerprint or fingerprint not in heads:
            continue
        chain = station.plant.pages.chain(fingerprint)
        newest = max((n for n, _, _ in station.plant.pages.chain_links(chain.id)), default=0)
        taken = take_carried(station, roster, fingerprint, transport.pages(fingerprint, newest))
        fetched += taken.pages
        _report_junk(station, roster, fingerprint, [carried.number for carried in taken.junk], transport)
        note_waiting(station, fingerprint, taken)
    return fetched


def take_carried(
    station: Station,
    roster: Roster,
    author: str,
    pages: Iterable[CarriedPage],
    on_junk: Callable[[CarriedPage], None] = lambda _: None,
) -> Taken:
    """Keep the pages of one station that are new and follow one that is here; ``pages`` ascend by number.

    A page that the station did not sign is ignored, and may be requested again.
    """
    links = station.plant.pages.chain_links(station.plant.pages.chain(author).id)
    known, numbers = {hash for _, hash, _ in links}, {n for n, _, _ in links} | {0}
    taken = Taken()
    batch: list[Page] = []
    for carried in pages:
        if hash_of(carried.octets) in known:
            continue
        try:
            page = open_carried(carried, roster, author)
        except NewerFormatError as newer:
            taken.waits = newer.message
            break
        except TedsProvisionError:
            taken.junk.append(carried)
            on_junk(carried)
            continue
        if page.number - 1 not in numbers:
            break
        numbers.add(page.number)
        known.add(page.hash)
        batch.append(page)
        taken.pages += 1
        if sum(len(page.events) for page in batch) >= EVENTS_AT_ONCE:
            take_pages(station, roster, batch)
            batch = []
    take_pages(station, roster, batch)
    return taken


def note_waiting(station: Station, author: str, taken: Taken) -> None:
    """Note that a chain waits for a newer version of this program, or that it does so no longer."""
    chain = station.plant.pages.chain(author)
    if taken.waits is not None:
        newest = max((n for n, _, _ in station.plant.pages.chain_links(chain.id)), default=0)
        alarm(station, "newer-format", author, newest + 1, taken.waits)
    if taken.waits != chain.waits:
        station.plant.pages.put_chain(replace(chain, waits=taken.waits))


def _report_junk(station: Station, roster: Roster, name: str, junk: Sequence[int], transport: Transport) -> None:
    if not junk:
        station.plant.alarms.end_about("junk", name)
    for n in junk[:1]:
        alarm(
            station,
            "junk",
            name,
            n,
            f"{transport.where}: {counted(len(junk), 'page')} of {roster.name_of(name)} that it did not sign",
        )
