"""A removed station: the keys that it had, their rotation, and what no roster can repair (contract/plant.md, 7).

The holders of a key are taken from all stations' pages, the removed one's beyond ``last`` too: a thief's statements
there count for nothing else, but it had a key that it names.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime, timedelta
from functools import lru_cache
from typing import Final

from teds_provision.errors import TedsProvisionError
from teds_provision.plant.apply_pages import counted_places, merged_views
from teds_provision.protocol.handover.strict_json import load_exact
from teds_provision.protocol.plant import event, sharing
from teds_provision.protocol.plant.claim import Claim, had_key
from teds_provision.protocol.plant.roster import RemovedMember, Roster, open_roster
from teds_provision.station.node_keys import REMOVED, STOLEN, deferred
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord

OTHERS: Final = timedelta(hours=24)
"""Time for the station whose turn it is to rotate a key, before others do it."""
EVERY: Final = timedelta(hours=1)
_PAGE: Final = 500
_COMMAND: Final = "registry sync"


@dataclass(frozen=True)
class RemovalReview:
    """Result of the last review: ``of`` nodes whose key is held here; ``alone`` had only the removed station."""

    at: str
    removed: str
    of: int
    alone: int


def review(station: Station, roster: Roster, now: datetime) -> RemovalReview | None:
    """Mark for rotation the keys that a removed station had; None if none was removed.

    Checking every key takes seconds in a large plant, so it is done when a roster removes another station, and each
    hour.
    """
    if not roster.removed:
        return None
    named = hashlib.sha256("".join(sorted(removed.fingerprint for removed in roster.removed)).encode()).hexdigest()
    before = last(station)
    if before is not None and before.removed == named and abs(now - datetime.fromisoformat(before.at)) < EVERY:
        return before
    ours = _first_removals(station, now)
    beyond = _beyond(station, roster)
    of = 0
    for page in _pages(station):
        keys = _keys_held(station, page)
        of += len(keys)
        _mark(station, roster, keys, beyond, now, ours)
    found = RemovalReview(now.isoformat(), named, of, _alone(station, roster))
    with station.durable(_COMMAND):
        station.plant.parcels.put_review(json.dumps(asdict(found)))
    return found


def last(station: Station) -> RemovalReview | None:
    """Return the result of the last review."""
    text = station.plant.parcels.review()
    return None if text is None else RemovalReview(**json.loads(text))


def rotations_due(station: Station) -> int:
    """Return how many nodes this station has to rotate because of a removed station."""
    return sum(why.startswith(REMOVED) for why in station.keys.rotations_due().values())


def _pages(station: Station) -> Iterable[list[bytes]]:
    page: list[bytes] = []
    seen: set[bytes] = set()
    for uuid, _, _, _ in station.keys.all_key_names():
        if uuid not in seen:
            seen.add(uuid)
            page.append(uuid)
        if len(page) == _PAGE:
            yield page
            page = []
    if page:
        yield page


def _keys_held(station: Station, page: Sequence[bytes]) -> dict[bytes, KeyRecord]:
    """Return the key of each node: the active one, or the newest of those that no session has proven yet (copies)."""
    found: dict[bytes, KeyRecord] = {}
    for key in station.keys.get_many(page):
        if key.uuid not in found or found[key.uuid].state != "active":
            found[key.uuid] = key
    return found


def _mark(
    station: Station,
    roster: Roster,
    keys: Mapping[bytes, KeyRecord],
    beyond: Mapping[tuple[bytes, int, str], set[str]],
    now: datetime,
    ours: Mapping[str, datetime],
) -> None:
    """Mark those of a page of nodes whose key a station that left has had, and note whose turn the rotation is."""
    claims = station.plant.claims.of_nodes(list(keys))
    marked = station.keys.due_among(list(keys))
    wanted: dict[bytes, str] = {}
    for uuid, key in keys.items():
        already = station.keys.rotation_due(uuid) or "" if uuid in marked else None
        if already is not None and (already.startswith(STOLEN) or not already.startswith(REMOVED)):
            continue
        claims_by = {fingerprint: Claim.from_json(text) for fingerprint, text in claims.get(uuid, {}).items()}
        had = beyond.get((uuid, key.epoch, key.key_id), set()) | {
            holder for holder in station.keys.holders_of_key(key) if roster.removed_one(holder)
        }
        known = [
            removed
            for removed in roster.removed
            if removed.fingerprint in had or had_key(removed.fingerprint, (key.epoch, key.key_id), claims_by)
        ]
        own_turn = bool(known) and _own_turn(station, roster, uuid, key)
        why = _why_due(known, key, claims_by, now, ours, own_turn=own_turn)
        if why is not None and why != already:
            wanted[uuid] = why
    if wanted:
        with station.durable(_COMMAND):
            for uuid, why in wanted.items():
                station.keys.demand_rotation(uuid, why)
                station.audit("registry", uuid, "rotation due", why=why)


def _own_turn(station: Station, roster: Roster, uuid: bytes, key: KeyRecord) -> bool:
    """Return True if this station rotates a key before others do.

    It made the key; or no member that holds the key did, and of those this one has the lowest fingerprint.
    """
    if key.source == "agreement":
        return True
    view = merged_views(station, roster, [uuid])[uuid]
    turn = sharing.rotator(view, (key.epoch, key.key_id), station.fingerprint)
    return turn == station.fingerprint


def _why_due(
    known: Sequence[RemovedMember],
    key: KeyRecord,
    claims: Mapping[str, Claim],
    now: datetime,
    ours: Mapping[str, datetime],
    *,
    own_turn: bool,
) -> str | None:
    """Return why a key that these removed stations have held is to be replaced; a stolen one goes before all others.

    A station that was retired and reports that it forgot the key needs no rotation. If it is another station's turn,
    the rotation is deferred until the removal has been known here for ``OTHERS``.
    """
    why: str | None = None
    for removed in known:
        forgot = claims[removed.fingerprint].forgot if removed.fingerprint in claims else -1
        if removed.why == "retired" and forgot >= key.epoch:
            continue
        text = f"station {removed.name} ({removed.why}) has held this key"
        begins = ours.get(removed.fingerprint, now) + OTHERS
        if not own_turn and now < begins:
            why = why or deferred(begins.astimezone(UTC), text)
        elif removed.why == "stolen":
            return f"{STOLEN}{removed.name} has held this key"
        else:
            why = f"{REMOVED}{text}"
    return why


def _beyond(station: Station, roster: Roster) -> dict[tuple[bytes, int, str], set[str]]:
    """Return keys (UUID, epoch, key id) on uncounted pages of removed members: later pages, or another history."""
    found: dict[tuple[bytes, int, str], set[str]] = {}
    for removed in roster.removed:
        chain = station.plant.pages.chains().get(removed.fingerprint)
        if chain is None:
            continue
        counted = counted_places(station, roster, chain)
        for n, hash, _ in station.plant.pages.chain_links(chain.id):
            page = None if (n, hash) in counted else station.plant.pages.get(chain.id, n, hash)
            if page is None:
                continue
            for value in load_exact(page.content, "A page").get("events", ()):
                read = event.read(value)
                if isinstance(read, event.Event) and read.uuid is not None and "key_id" in read.members:
                    key = read.uuid, read.members["epoch"], read.members["key_id"]
                    found.setdefault(key, set()).add(removed.fingerprint)
    return found


def _first_removals(station: Station, now: datetime) -> dict[str, datetime]:
    """Return since when this station knows of each removal.

    A roster that a clock which was ahead dates after ``now`` counts from its own date: another holder's turn must end.
    """
    since: dict[str, datetime] = {}
    for row in station.plant.rosters():
        created, fingerprints = _removals_in(row.octets, station.ca)
        for fingerprint in fingerprints:
            at = datetime.fromisoformat(row.at)
            known = at if at <= now else created
            since[fingerprint] = min(since.get(fingerprint, known), known)
    return since


@lru_cache(maxsize=64)
def _removals_in(octets: bytes, ca: bytes) -> tuple[datetime, frozenset[str]]:
    try:
        roster = open_roster(octets, ca)
    except TedsProvisionError:  # stored only as proof that there were two rosters of one version
        return datetime.max.replace(tzinfo=UTC), frozenset()
    return roster.created, frozenset(removed.fingerprint for removed in roster.removed)


def _alone(station: Station, roster: Roster) -> int:
    """Return the number of nodes whose key only the removed station had: a tap is needed."""
    count, after = 0, b""
    while page := station.plant.claims.nodes(after, _PAGE):
        after = page[-1]
        held = _keys_held(station, page).keys()
        seen = merged_views(station, roster, page)
        count += sum(not seen[uuid].held and bool(seen[uuid].left) and uuid not in held for uuid in page)
    return count
