"""The pages of stations that left return to a database that lost them (contract/plant.md section 5, ``restore``).

Only an open member appends to its own chain. The pages of all others (removed, or their row was lost with an older
dump) are handed in by the members that have them. Nothing that was handed in is believed: a page counts by its
author's signature, and a member that hands in one that the author did not sign is read no further in this sync and
named in an alarm. The comparison costs two round trips and is made only when something changed here or there.
"""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Sequence
from itertools import islice
from typing import Final

from teds_provision.errors import PolicyError
from teds_provision.plant.apply_pages import alarm, counted_places, octets_of
from teds_provision.plant.fetching import note_waiting, read_pages, take_carried
from teds_provision.plant.transport import CarriedPage, Offer, Returned
from teds_provision.protocol.plant.page import Page
from teds_provision.protocol.plant.roster import Roster
from teds_provision.station.plant.pages import Chain
from teds_provision.station.station import Station

FORGED: Final = "forged"
"""Alarm: a member handed in a page that its author did not sign."""
_AT_ONCE: Final = 8
"""Pages for each round trip: of a member that forges, no more than these come in one sync."""


def is_new(station: Station, database: Returned, roster: Roster) -> bool:
    """Return True if there may be something to take or to hand in.

    That is after any change since the last comparison.
    """
    digest = _digest(station, database, roster)
    return digest != "" and digest != station.plant.returned_state()


def note(station: Station, database: Returned, roster: Roster) -> None:
    """Note that the comparison was made."""
    station.plant.put_returned_state(_digest(station, database, roster))


def _digest(station: Station, database: Returned, roster: Roster) -> str:
    """Return a digest of what both sides have of the stations in question, "" if there is none."""
    states = {name: state for name in sorted(roster.by_key) if (state := database.state(name))}
    if not states:
        return ""
    chains = station.plant.pages.chains()
    digest = hashlib.sha256(f"{roster.hash} {database.takes_pages}\n".encode())
    for name, state in states.items():
        links = station.plant.pages.chain_links(chains[name].id) if name in chains else []
        digest.update(f"{state} {' '.join(hash for _, hash, _ in links)}\n".encode())
    return digest.hexdigest()


def own_pages(
    station: Station, database: Returned | None, roster: Roster, known: Collection[str], *, always: bool = False
) -> list[Page]:
    """Return pages under this station's own key that others handed in while it was no member, but for ``known`` (H).

    None after a comparison that found nothing new, unless ``always``.
    """
    here = station.fingerprint
    if database is None or not database.was_handed_in(here) or not (always or is_new(station, database, roster)):
        return []
    good: dict[str, Page] = {}
    liars: set[str] = set()
    offers = [offer for offer in database.offers(here) if offer.by and offer.hash not in known]
    for carried in _octets(database, offers, liars):
        pages, junk = read_pages([carried], roster, here)
        good.update((page.hash, page) for page in pages)
        if junk:
            liars.add(carried.by)
    return list(good.values())


def take_in(station: Station, database: Returned, roster: Roster) -> int:
    """Take in the pages of others that members handed in, and return how many were new."""
    taken_pages, forged = 0, False
    for author in sorted(roster.by_key):
        if author == station.fingerprint or not database.was_handed_in(author):
            continue
        links = station.plant.pages.chain_links(station.plant.pages.chain(author).id)
        known = {hash for _, hash, _ in links}
        offers = [offer for offer in database.offers(author) if offer.hash not in known]
        liars: set[str] = set()

        def distrust(carried: CarriedPage, liars: set[str] = liars) -> None:
            if carried.by:
                liars.add(carried.by)
                _report_forged(station, roster, carried)

        taken = take_carried(station, roster, author, _octets(database, offers, liars), distrust)
        taken_pages += taken.pages
        forged |= bool(liars)
        if offers:
            note_waiting(station, author, taken)
    if not forged:
        station.plant.alarms.end_all_of(FORGED)
    return taken_pages


def _octets(database: Returned, offers: Sequence[Offer], liars: Collection[str]) -> Iterator[CarriedPage]:
    """Yield pages in the order of their numbers, a few for each round trip; none of those in ``liars``."""
    waiting = sorted(offers, key=lambda offer: (offer.n, offer.by))
    while waiting:
        wanted = [offer for offer in waiting if offer.by not in liars]
        batch, waiting = wanted[:_AT_ONCE], wanted[_AT_ONCE:]
        for carried in database.octets(batch) if batch else ():
            if carried.by not in liars:
                yield carried


def _report_forged(station: Station, roster: Roster, carried: CarriedPage) -> None:
    who, whose = roster.name_of(carried.by), roster.name_of(carried.station)
    alarm(station, FORGED, carried.by, carried.number, f"{who} handed in a page of {whose} that {whose} did not sign")


def hand_in(station: Station, database: Returned, roster: Roster) -> tuple[int, list[str]]:
    """Hand in every page here that the database lacks and whose author is no open member.

    Returns how many, and a sentence for each author of which the database does not take them.
    """
    handed_in, refused = 0, []
    chains = station.plant.pages.chains()
    for author in sorted(roster.by_key):
        chain = chains.get(author)
        if author == station.fingerprint or chain is None or database.is_open(author):
            continue
        name = roster.name_of(author)
        if not database.takes_pages:
            if chain.counted[0] > database.head(author):
                refused.append(
                    f"the database lacks pages of {name} and has schema 1, which takes them only from {name}: its"
                    " superuser should run: registry sql | psql"
                )
            continue
        there = {(offer.n, offer.digest) for offer in database.offers(author)}
        try:
            lacking = _lacking(station, roster, chain, there)
            while batch := list(islice(lacking, _AT_ONCE)):
                database.restore(author, batch)
                handed_in += len(batch)
        except PolicyError as error:
            refused.append(f"the registry does not take all pages of {name}: {error.message}")
    return handed_in, refused


def _lacking(
    station: Station, roster: Roster, chain: Chain, there: Collection[tuple[int, str]]
) -> Iterator[tuple[int, bytes]]:
    """Yield number and octets of the pages here that are not there: those that count before all others."""
    counted = counted_places(station, roster, chain)
    places = [(n, hash) for n, hash, _ in station.plant.pages.chain_links(chain.id)]
    for n, hash in sorted(places, key=lambda place: (place not in counted, place)):
        row = station.plant.pages.get(chain.id, n, hash)
        if row is not None and (n, hashlib.sha256(octets_of(row)).hexdigest()) not in there:
            yield n, octets_of(row)
