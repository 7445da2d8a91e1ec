"""``registry sync``: publishes this station's statements and takes in those of others (contract/plant.md section 6).

Every step can be interrupted; the same command carries on. Nothing here needs an honest other side: rosters count by
the CA's signature, pages by their station's, and this station's own chain is checked before anything is added to it, so
that a copy of this home, or one that was put back, detects itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from shlex import quote
from typing import Final, NoReturn

from teds_provision.errors import ForkError, NotAuthenticError, NotMemberError, PolicyError
from teds_provision.plant import fetching, parcels, removed_members, returned
from teds_provision.plant.apply_pages import (
    alarm,
    apply_claims,
    counted_places,
    fold_new_acts,
    merged_views,
    now,
    octets_of,
    require_roster,
    take_pages,
    take_rosters,
)
from teds_provision.plant.membership import FILES
from teds_provision.plant.transport import Transport
from teds_provision.protocol.handover.strict_json import load_exact
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.document import hash_of
from teds_provision.protocol.plant.evidence import PASSED
from teds_provision.protocol.plant.merged_claims import MergedClaims
from teds_provision.protocol.plant.page import MOST_EVENTS, MOST_PAYLOAD, Page, PageDraft, open_page, sign_page
from teds_provision.protocol.plant.roster import Roster
from teds_provision.sanitize import counted
from teds_provision.station.plant.line import UnitRow
from teds_provision.station.plant.pages import Chain
from teds_provision.station.plant.plant import new_home
from teds_provision.station.station import Station
from teds_provision.station.store.lock import StoreLock
from teds_provision.station.store.records import WhitelistEntry, utc_now

LOCK_FILE: Final = "registry.lock"
_ROOM: Final = 20_000
"""Octets of a page that are kept for its heads and its other members."""


@dataclass
class SyncResult:
    """Result of a sync: pages and parcels out and in, remarks for people, rosters taken."""

    pushed: int = 0
    fetched: int = 0
    returned: int = 0
    """Pages of stations that left which the registry lacked: handed in for them."""
    judged: int = 0
    parcels_in: int = 0
    parcels_out: int = 0
    waiting: int = 0
    """Parcels that came and that a person has to take in (``import-keys --received``)."""
    remarks: list[str] = field(default_factory=list)
    rosters: list[int] = field(default_factory=list)


@contextmanager
def sync_lock(station: Station) -> Iterator[None]:
    """Hold the lock of one sync per home for the block: a second one waits 10 s, then StoreLockedError."""
    lock = StoreLock(station.home, command="registry sync", notice=station.notice, file=LOCK_FILE)
    with lock:
        yield


def sync(station: Station, transport: Transport, *, connected: bool = True) -> SyncResult:
    """Bring this station and the transport to the same state, as far as signatures go.

    ``connected``: it is what the station joined by; how far its database came is remembered. Raises LinkError,
    NotMemberError, ForkError, PolicyError.
    """
    station.unlock()
    with sync_lock(station):
        done = SyncResult()
        done.rosters = [
            roster.version for roster, how, _ in _rosters(station, transport, done) if how.startswith("taken")
        ]
        roster = require_roster(station)
        if roster.member(station.fingerprint) is None:
            apply_claims(station)
            raise NotMemberError(
                f"This station was removed from {roster.name} (roster {roster.version}).",
                hint="A removed key cannot return: create a new station (init) and have it added.",
            )
        _check_own_chain(station, transport, roster, done, connected=connected)
        if again := fold_new_acts(station, roster):
            done.remarks.append(f"{counted(again, 'page')} read again: this version shows more of what pages say")
        while write_page(station, roster) is not None:
            pass
        _push(station, transport, roster, done, connected=connected)
        done.fetched += fetching.fetch(station, transport, roster)
        _return_pages(station, transport, roster, done)
        done.judged = apply_claims(station)
        acknowledged = station.plant.pages.seen_heads()
        done.remarks += [
            head_text for head, head_text in unseen_heads(station, roster).items() if head not in acknowledged
        ]
        _parcels(station, transport, roster, done)
        with station.transaction():
            joined = station.plant.joined
            assert joined is not None
            station.plant.put_record(replace(joined, synced=utc_now()))
        return done


def _return_pages(station: Station, transport: Transport, roster: Roster, done: SyncResult) -> None:
    """Take what others handed in for stations that left, and hand in what the registry lacks of them."""
    if transport.returned is None or not returned.is_new(station, transport.returned, roster):
        return
    done.fetched += returned.take_in(station, transport.returned, roster)
    done.returned, refused = returned.hand_in(station, transport.returned, roster)
    if done.returned:
        pages = "1 page" if done.returned == 1 else f"{done.returned} pages"
        done.remarks.append(f"{pages} of stations that are no longer members, which the registry lacked, handed in")
    done.remarks += refused
    if transport.returned.takes_pages:
        returned.note(station, transport.returned, roster)


def _rosters(station: Station, transport: Transport, done: SyncResult) -> list[tuple[Roster, str, str]]:
    """Take the best roster in the transport, and post one's own."""
    joined = station.plant.joined
    if joined is not None and transport.registry() not in (None, joined.registry):
        raise PolicyError(
            f"{transport.where} belongs to another registry ({transport.registry()}).",
            hint="Use the one that this station joined.",
        )
    results = take_rosters(station, transport.rosters())
    for roster, how, why in results:
        if how not in ("taken", "older"):  # "older" is normal: members post the newest roster that they know
            done.remarks.append(f"roster {roster.version}: {how}: {why}")
    held = station.plant.held_roster()
    if held is not None:
        transport.post_roster(held.version, held.hash, held.octets)
    return [(roster_read, str(how), why) for roster_read, how, why in results]


def _parcels(station: Station, transport: Transport, roster: Roster, done: SyncResult) -> None:
    """Take in and send keys, after the pages that determine their holders."""

    def seen(uuids: Sequence[bytes]) -> Mapping[bytes, MergedClaims]:
        return merged_views(station, roster, uuids)

    at = max(now(), roster.created)
    removed_members.review(station, roster, at)
    came = parcels.take_in(station, transport, seen, at)
    done.parcels_in, done.waiting = came.taken, came.waiting
    left = parcels.send_out(station, transport, seen, at)
    done.parcels_out = left.count
    done.remarks += left.held_back


# -- this station's chain ----------------------------------------------------------------------------------------------


def own_chain(station: Station) -> Chain:
    """Return the chain of this station."""
    return station.plant.pages.chain(station.fingerprint)


def _check_own_chain(
    station: Station, transport: Transport, roster: Roster, done: SyncResult, *, connected: bool
) -> None:
    """Check the pages under this station's key before any is added, in the order of contract/plant.md, section 6."""
    chain, joined = own_chain(station), station.plant.joined
    assert joined is not None
    restored = station.plant.restored
    known = {(n, hash) for n, hash, _ in station.plant.pages.chain_links(chain.id)}
    above = max(0, joined.acknowledged - 1) if connected and not restored else 0
    appended = _own_pages(station, transport, roster, done, above)
    found = appended + returned.own_pages(station, transport.returned, roster, {page.hash for page in appended})
    new = [page for page in found if (page.number, page.hash) not in known]
    if new and restored and _follows(chain, new):
        take_back(station, roster, new)
        station.plant.alarms.end_about("fork", station.fingerprint)
        back = "1 page that this station wrote before its backup is"
        if len(new) > 1:
            back = f"{len(new)} pages that this station wrote before its backup are"
        done.remarks.append(f"{back} back")
    elif new:
        _stop_at_fork(station, transport, new)
    else:
        _require_resumed(station)
    if restored:
        _require_all_seen(station, roster, {page.number for page in found})
        if new or connected or joined.url is None:
            station.plant.end_restored()
        # a folder that has fewer pages than this home acknowledged proves nothing: a page number could be used twice
        else:
            done.remarks.append(
                "this home was restored from a backup and publishes nothing new until it has synced with its"
                " own registry"
            )
    there = max((page.number for page in appended), default=0)
    if connected and there < joined.acknowledged and not transport.carries_all:
        there = transport.heads().get(station.fingerprint, 0)
        why = f"page {joined.acknowledged} was there, and now {there} is the last"
        alarm(station, "rolled-back", station.fingerprint, joined.acknowledged, why, again=True)
        done.remarks.append(f"{transport.where} was rolled back: {why}; it is being refilled")


def _own_pages(station: Station, transport: Transport, roster: Roster, done: SyncResult, above: int) -> list[Page]:
    """Return the pages under this station's key.

    If only members can write, one that it did not sign stops everything.
    """
    found, junk = fetching.read_pages(transport.pages(station.fingerprint, above), roster, station.fingerprint)
    if junk and not transport.carries_all:
        alarm(
            station,
            "junk",
            station.fingerprint,
            junk[0],
            f"{transport.where} has pages that this station's key did not sign",
        )
        raise NotAuthenticError(
            f"{transport.where} has pages of this station that its key did not sign, from number {junk[0]} on.",
            hint=f"To delete them there: registry sql --mend {quote(roster.name_of(station.fingerprint))} {junk[0]}",
        )
    if junk:
        done.remarks.append(
            f"{transport.where}: {counted(len(junk), 'file')} in this station's folder that it did not sign; ignored"
        )
    return found


def _stop_at_fork(station: Station, transport: Transport, new: Sequence[Page]) -> NoReturn:
    """Raise ForkError: another home writes, or has written, under this station's key."""
    homes = ", ".join(sorted({page.home or "unknown" for page in new}))
    first = min(page.number for page in new)
    alarm(station, "fork", station.fingerprint, first, f"pages of home {homes} that are not of this one")
    raise ForkError(
        f"{transport.where} has pages under this station's key that are not of this home, from number {first} on"
        f" (home {homes}; here {station.plant.home}): a disk image was restored, or a copy of this home is in use.",
        hint="Find out who has a copy; if in doubt, have this station removed. Then: teds-provision registry resume",
    )


def _require_resumed(station: Station) -> None:
    """Raise ForkError if one was found before and no person has decided.

    A folder that shows less of it ends nothing.
    """
    found = [
        raised for raised in station.plant.alarms.all() if raised.code == "fork" and raised.about == station.fingerprint
    ]
    if found:
        raise ForkError(
            f"Pages under this station's key that this home did not write were found, from number {found[0].n}"
            " on, and the decision is still open.",
            hint="Find out who has a copy; if in doubt, have this station removed. Then: teds-provision"
            " registry resume",
        )


def _follows(chain: Chain, new: Sequence[Page]) -> bool:
    """Return True if pages continue, without a gap, from the newest page that counts here."""
    place = chain.counted
    for page in sorted(new, key=lambda page: page.number):
        if (page.number - 1, page.previous) != place:
            return False
        place = page.number, page.hash
    return True


def take_back(station: Station, roster: Roster, pages: Sequence[Page]) -> None:
    """Take back pages that this station wrote: their events wait no more, their content is known again."""
    with station.transaction():
        take_pages(station, roster, sorted(pages, key=lambda page: page.number))
        ids = [stated.get("id") for page in pages for stated in page.events if isinstance(stated, dict)]
        station.plant.drop_events([id_ for id_ in ids if isinstance(id_, str)])
        for page in pages:
            _know_again(station, page)
        station.audit("registry", None, "adopted", pages=[page.number for page in pages])


def _know_again(station: Station, page: Page) -> None:
    """Restore epochs, sequences and units that this station gave before it was put back: none is given twice."""
    reached: dict[bytes, tuple[int, int]] = {}
    signed: set[bytes] = set()
    for event_read in map(event.read, page.events):
        if isinstance(event_read, event.Event) and event_read.act == "firmware" and event_read.uuid is not None:
            # the report is from the backup; this station has seen a newer one since
            station.firmware_reports.make_hint(event_read.uuid)
        if (
            isinstance(event_read, event.Event)
            and event_read.uuid is not None
            and (unit := event.unit_of(event_read)) is not None
        ):
            _know_unit(station, event_read.uuid, event_read, *unit)
        if (
            isinstance(event_read, event.Event)
            and event_read.act in ("agreed", "signed", "written")
            and event_read.uuid is not None
        ):
            epoch, sequence = reached.get(event_read.uuid, (0, 0))
            reached[event_read.uuid] = (
                max(epoch, event_read.members["epoch"]),
                max(sequence, event_read.members.get("sequence", 0)),
            )
        if isinstance(event_read, event.Event) and event_read.act == "signed" and event_read.uuid is not None:
            signed.add(event_read.uuid)
    for uuid, (epoch, sequence) in reached.items():
        node = station.nodes.get(uuid)
        if node is not None:
            station.nodes.remember(uuid, epoch=max(node.epoch, epoch), sequence=max(node.sequence, sequence))
        elif uuid in signed:  # keep the sequence of an unknown board too, so that none is used twice
            station.nodes.remember(uuid, sequence=sequence)
    # Pin boards that this station signed for to the key in its own claims, so that no other board gets their units.
    for uuid, text in station.plant.claims.of_station(own_chain(station).id, sorted(signed)).items():
        pin = Claim.from_json(text).pin
        if pin is not None and station.pins.entry(uuid) is None:
            station.pins.put(WhitelistEntry(uuid, pin[0], assurance=pin[1]))  # type: ignore[arg-type]


def _know_unit(station: Station, uuid: bytes, stated: event.Event, job: str, unit: int) -> None:
    """Record the unit that an attempt or an office's signature was about, and one more attempt.

    If another board has that unit by now, this one has the next: an office counts what it gave, not its numbers.
    """
    line = station.plant.line
    kept = line.unit(job, uuid)
    if kept is None and any(row.unit == unit for row in line.units(job)):
        station.notice(
            f"Unit {unit} of the job {job} was assigned twice: also to {uuid.hex()}, before this home was restored."
        )
        if stated.act == "evidence":
            return
        unit = line.count_units(job)[2] + 1
    row = UnitRow(job, uuid, unit, stated.at) if kept is None else replace(kept, attempts=kept.attempts + 1)
    passed = row.attempts if stated.members.get("verdict") == PASSED and not row.passed else row.passed
    line.put_unit(replace(row, passed=passed))


def _require_all_seen(station: Station, roster: Roster, there: set[int]) -> None:
    """Let a home that a backup rebuilt go on only if no station has seen pages of it that are missing.

    Missing are pages that are neither here nor in the registry.
    """
    newest = max({own_chain(station).counted[0]} | there)
    for who, about, n, _ in station.plant.pages.heads():
        if about == station.fingerprint and n > newest and roster.member(who) is not None:
            raise PolicyError(
                f"This home was restored from a backup. {roster.name_of(who)} has seen its page {n}, but the"
                f" last one here is {newest}.",
                hint=f"Get the missing pages: registry sync --files DIR that {roster.name_of(who)} filled; or"
                " registry resume",
            )


def resume(station: Station, transport: Transport) -> int:
    """Go on after a fork, as an operator confirmed: existing pages are adopted, one's own unsent events stay.

    A page of this home whose place another one took there is written again with its content; returns how many were
    adopted.
    """
    station.unlock()
    with sync_lock(station):
        roster = require_roster(station)
        chain = own_chain(station)
        found = _under_our_key(station, transport, roster)
        new = _strange(station, found)
        with station.transaction():
            if new:
                newest = max(new, key=lambda page: (page.number, page.hash))
                theirs = {(page.number, page.hash) for page in found}
                counted = [
                    (n, hash) for n, hash, _ in station.plant.pages.chain_links(chain.id) if n <= chain.counted[0]
                ]
                lost = [place for place in counted if place not in theirs and place[0] >= new[0].number]
                station.plant.pages.put_chain(replace(chain, accepted=(newest.number, newest.hash)))
                take_back(station, roster, new)
                _report_again(station, chain, lost, new)
            station.plant.alarms.end_about("fork", station.fingerprint)
            station.plant.end_restored()
            joined = station.plant.joined
            assert joined is not None
            station.plant.put_record(replace(joined, acknowledged=0))
            station.audit("registry", None, "resumed", adopted=len(new))
        new_home(station.home)
    return len(new)


def unknown_pages(station: Station, transport: Transport) -> list[Page]:
    """Return the unknown pages under this station's key: what :func:`resume` adopts."""
    return _strange(station, _under_our_key(station, transport, require_roster(station)))


def _under_our_key(station: Station, transport: Transport, roster: Roster) -> list[Page]:
    transport.registry()  # raises if the database was replaced meanwhile
    found, _ = fetching.read_pages(transport.pages(station.fingerprint, 0), roster, station.fingerprint)
    return found + returned.own_pages(station, transport.returned, roster, {page.hash for page in found}, always=True)


def _strange(station: Station, found: Sequence[Page]) -> list[Page]:
    known = {(n, hash) for n, hash, _ in station.plant.pages.chain_links(own_chain(station).id)}
    return [page for page in found if (page.number, page.hash) not in known]


def _report_again(station: Station, chain: Chain, lost: Sequence[tuple[int, str]], new: Sequence[Page]) -> None:
    adopted = {stated.get("id") for page in new for stated in page.events if isinstance(stated, dict)}
    for n, hash in lost:
        row = station.plant.pages.get(chain.id, n, hash)
        for item in load_exact(row.content, "A page")["events"] if row is not None else ():
            if item["id"] not in adopted:
                station.plant.queue_event(item)


def write_page(station: Station, roster: Roster, *, empty: bool = False) -> Page | None:
    """Put what waits into the next page, in one transaction; None if nothing does (unless ``empty``)."""
    with station.transaction():
        chain = own_chain(station)
        waiting = station.plant.outbox(MOST_EVENTS)
        if (not waiting and not empty) or station.plant.restored:
            return None
        events: list[tuple[str, dict[str, object]]] = []
        room = MOST_PAYLOAD - _ROOM
        for _, id, text in waiting:
            room -= len(text.encode()) + 1
            if room < 0 and events:
                break
            events.append((id, load_exact(text.encode(), "An event")))
        n, previous = chain.counted
        entry = station.audit_log.newest()
        draft = PageDraft(
            roster.registry, n + 1, previous, station.plant.home, now(), _fresh_heads(station, chain), entry
        )
        octets = sign_page(draft, [made for _, made in events], station.vault.identity())
        page = open_page(octets, roster.registry, lambda kid: station.point)
        take_pages(station, roster, [page])
        station.plant.drop_events([id for id, _ in events])
    return page


def _fresh_heads(station: Station, own: Chain) -> dict[str, tuple[int, str]]:
    """Return what this station verified of others and did not report yet."""
    known = {about: (n, hash) for who, about, n, hash in station.plant.pages.heads() if who == own.station}
    return {
        fingerprint: chain.counted
        for fingerprint, chain in station.plant.pages.chains().items()
        if fingerprint != own.station and chain.counted[0] and known.get(fingerprint) != chain.counted
    }


# -- out and in --------------------------------------------------------------------------------------------------------


def _push(station: Station, transport: Transport, roster: Roster, done: SyncResult, *, connected: bool) -> None:
    """Append missing pages: one's own, and in a folder those of all stations."""
    heads = transport.heads()
    for fingerprint, chain in station.plant.pages.chains().items():
        own = fingerprint == station.fingerprint
        if not own and not transport.carries_all:
            continue
        there = (
            {hash_of(carried.octets) for carried in transport.pages(fingerprint, 0)} if transport.carries_all else set()
        )
        above = 0 if transport.carries_all else heads.get(fingerprint, 0)
        # a registry takes one history: pages that `registry resume` gave up stay here, even if their number is free
        counting = None if transport.carries_all else counted_places(station, roster, chain)
        for n, hash, previous in station.plant.pages.chain_links(chain.id):
            if n <= above or hash in there or (counting is not None and (n, hash) not in counting):
                continue
            row = station.plant.pages.get(chain.id, n, hash)
            assert row is not None
            transport.append(fingerprint, n, previous, hash, octets_of(row))
            done.pushed += own
    joined, newest = station.plant.joined, own_chain(station).counted[0]
    assert joined is not None
    # For a station that uses folders, each of them is the registry: a removable disk has another path on each machine.
    by_folder = transport.carries_all and (joined.url or "").startswith(FILES)
    if (connected or by_folder) and joined.acknowledged != newest:
        station.plant.put_record(replace(joined, acknowledged=newest))


def unseen_heads(station: Station, roster: Roster) -> dict[tuple[str, str, int, str], str]:
    """Return what members report of others' pages that are not here, in sentences; it ends nothing.

    By who reports, of whom, the number and H of the page; those that a person has acknowledged are among them.
    """
    found: dict[tuple[str, str, int, str], str] = {}
    chains = station.plant.pages.chains()
    for who, about, n, hash in station.plant.pages.heads():
        chain = chains.get(about)
        if roster.member(who) is None or about not in roster.by_key or who == station.fingerprint:
            continue
        links = station.plant.pages.chain_links(chain.id) if chain is not None else []
        if any((n, hash) == (number, named) for number, named, _ in links):
            continue
        here = chain.counted[0] if chain is not None else 0
        if n > here:
            saw = f"{roster.name_of(who)} saw page {n} of {roster.name_of(about)}"
            found[who, about, n, hash] = f"{saw}; the last one here is {here}"
        else:
            other = f"{roster.name_of(who)} reports a page {n} of {roster.name_of(about)}"
            found[who, about, n, hash] = f"{other} that differs from the one here"
    return found


def acknowledge(station: Station) -> tuple[int, int]:
    """Note that a person knows of all alarms and reported heads up to now; returns how many of each were new."""
    heads = unseen_heads(station, require_roster(station))
    with station.transaction():
        fresh = len(heads.keys() - station.plant.pages.seen_heads())
        station.plant.pages.see_heads(heads)
        alarms = station.plant.alarms.see()
        station.audit("registry", None, "seen", alarms=alarms, heads=fresh)
    return alarms, fresh
