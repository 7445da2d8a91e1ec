"""Rosters and pages into the store, and what follows from them: the fold of ``protocol/plant`` over a store's rows.

Every step is one transaction and leaves a state from which the next fold goes on: some pages with their claims; then, a
few hundred at a time, the nodes that are to be judged again (contract/plant.md sections 2 and 3).
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from typing import Final, NamedTuple

from teds_provision.errors import PolicyError, TedsProvisionError
from teds_provision.handover import deny
from teds_provision.plant.backlog import firmware_reports
from teds_provision.protocol.fingerprints import is_whole, same_key
from teds_provision.protocol.handover.revocation import open_revocation
from teds_provision.protocol.handover.strict_json import load_exact
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.chain import counting
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.document import join, split
from teds_provision.protocol.plant.event import Event
from teds_provision.protocol.plant.merged_claims import BY_CONTACT, BanStatement, LocalState, MergedClaims, merge_claims
from teds_provision.protocol.plant.page import Page
from teds_provision.protocol.plant.roster import MOST_AHEAD, Roster, Taking, open_roster, taking
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.pages import Chain, PageRow
from teds_provision.station.plant.plant import RosterRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord, NodeRecord, WhitelistEntry, utc_now

AT_ONCE: Final = 500
"""Nodes that are judged in one transaction: others write in between."""
EVENTS_AT_ONCE: Final = 2000


def now() -> datetime:
    """Return the time of this station's clock."""
    return datetime.now(UTC)


def require_roster(station: Station) -> Roster:
    """Return the current roster; raises PolicyError if no registry was joined."""
    roster = station.plant.roster
    if roster is None:
        raise PolicyError(
            "This station has joined no registry.", hint="Join one: teds-provision registry connect --files DIR"
        )
    return roster


def alarm(station: Station, code: str, about: str, n: int, why: str, *, again: bool = False) -> None:
    """Keep an alarm; an existing one keeps its time. A new one is reported to other stations.

    ``again``: it happened once more, so an alarm that was seen is raised again.
    """
    with station.transaction():
        if station.plant.alarms.put(Alarm(code, about, n, why), again=again):
            station.audit("registry", None, f"alarm: {code}", about=about[:16], n=n, why=why)
            station.plant.record_event("alarm", code=code, about=about or None, n=n)


# -- rosters -----------------------------------------------------------------------------------------------------------


def take_rosters(station: Station, found: Iterable[bytes]) -> list[tuple[Roster, Taking, str]]:
    """Take the best of the rosters in a transport; those that the CA did not sign are ignored.

    Everything that follows from a roster (who counts, up to which page) is brought in order in its transaction. Returns
    what was taken or refused, and why; two rosters of one version are an alarm.
    """
    joined = station.plant.joined
    registry = joined.registry if joined is not None else ""
    results: list[tuple[Roster, Taking, str]] = []
    read: dict[str, Roster] = {}
    for octets in found:
        try:
            roster = open_roster(octets, station.ca)
        except TedsProvisionError:  # the transport is untrusted
            continue
        if roster.registry == registry:
            read.setdefault(roster.hash, roster)
    known = {row.hash for row in station.plant.rosters()}
    for roster in sorted(read.values(), key=lambda roster: (roster.version, roster.hash)):
        own = station.plant.roster
        how, why = taking(roster, own, registry)
        # the roster's date shows if this machine's clock was set back
        at = now() if own is None else max(now(), own.created)
        if how not in ("same", "older") and roster.created > at + MOST_AHEAD:
            how, why = (
                "refused",
                "it is dated in the future: check this machine's clock and its owner's (registry renew --redate)",
            )
        if how in ("same", "older") and (how == "same" or roster.hash in known):
            continue
        results.append((roster, how, why))
        if how.startswith("taken"):
            put_roster(station, roster)
        elif how == "two rosters":
            station.plant.put_roster(RosterRow(roster.version, roster.hash, roster.octets, False, utc_now()))
        if "two rosters" in how:
            alarm(station, "two-rosters", "", roster.version, why)
    held = station.plant.roster
    if held is not None:  # a newer version ends the conflict
        for raised in station.plant.alarms.all():
            if raised.code == "two-rosters" and raised.n < held.version and not raised.seen:
                station.plant.alarms.end(raised)
    return results


def put_roster(station: Station, roster: Roster) -> None:
    """Have a roster count from now on, and bring in order which pages of each station count by it."""
    before = station.plant.roster
    with station.transaction():
        station.plant.put_roster(RosterRow(roster.version, roster.hash, roster.octets, True, utc_now()))
        for member in roster.members:  # so that keys can be handed over to the member, although the CA key is not here
            station.identity.keep_certificate(station.ca, member.point, member.certificate)
        station.audit("registry", None, "roster", version=roster.version, hash=roster.hash)
        for station_id, chain in station.plant.pages.chains().items():
            if before is None or _last(before, station_id) != _last(roster, station_id):
                recount(station, chain, roster)
        station.plant.claims.queue_all()


def _last(roster: Roster, station: str) -> tuple[int, str] | None:
    removed = roster.removed_one(station)
    return removed.last if removed is not None else None


# -- pages -------------------------------------------------------------------------------------------------------------


def take_pages(station: Station, roster: Roster, pages: Sequence[Page]) -> None:
    """Keep pages of one station (their signatures were checked) and fold what counts of them, in one transaction."""
    if not pages:
        return
    with station.transaction():
        chain = station.plant.pages.chain(pages[0].station)
        for page in pages:
            station.plant.pages.add(chain.id, row_of(page))
            station.plant.pages.put_heads(chain.id, page.heads)
        fresh = recount(station, chain, roster)
        for page in pages:
            # the page is on no branch that counts, but its bans are applied anyway
            if (page.number, page.hash) not in fresh:
                _keep_bans(station, chain, page.events, counts=False)


def row_of(page: Page) -> PageRow:
    """Return a page as the store keeps it."""
    return PageRow(page.number, page.hash, page.previous, page.created, page.home, *split(page.octets))


def fold_new_acts(station: Station, roster: Roster) -> int:
    """Fold the pages here again if an earlier version, which skipped acts that this one knows, did so; return how many.

    That version published nothing of these acts either: what this station keeps of them becomes events now.
    """
    if event.FORMS.keys() <= station.plant.folded_acts():
        return 0
    folded = 0
    for chain in station.plant.pages.chains().values():
        with station.transaction():
            folded += len(recount(station, station.plant.pages.chain(chain.station), roster, again=True))
    own = station.plant.pages.chain(station.fingerprint).id
    with station.transaction():
        for act, uuid, members in list(firmware_reports(station)):
            assert uuid is not None
            claim = station.plant.claims.of_station(own, [uuid]).get(uuid)
            if claim is None or Claim.from_json(claim).firmware is None:
                station.plant.record_event(act, uuid, **members)
        station.plant.put_folded_acts(event.FORMS)
    return folded


def recount(station: Station, chain: Chain, roster: Roster, *, again: bool = False) -> set[tuple[int, str]]:
    """Determine again which pages of a chain count, and fold them; from the first one if folded pages no longer count.

    Returns the pages that were folded now. ``again``: from the first one in any case.
    """
    links = station.plant.pages.chain_links(chain.id)
    counts = counting(links, last=_last(roster, chain.station), accepted=chain.accepted)
    if counts.two is not None:
        why = "two histories part at this page" if chain.station != station.fingerprint else "of this very station"
        alarm(station, "two-histories", chain.station, counts.two, why)
    else:
        station.plant.alarms.end_about("two-histories", chain.station)
    folded = chain.folded
    if folded[0] and (again or folded not in counts.pages):
        station.plant.claims.forget(chain.id)
        folded = (0, "")
        for n, hash, _ in links:
            if (n, hash) not in counts.pages and (page := station.plant.pages.get(chain.id, n, hash)) is not None:
                _keep_bans(station, chain, _events_of(page), counts=False)
    fresh = [place for place in counts.pages if place[0] > folded[0]]
    for n, hash in fresh:
        row = station.plant.pages.get(chain.id, n, hash)
        assert row is not None
        _fold_page(station, chain, n, _events_of(row))
    if counts.newest != chain.counted or counts.newest != chain.folded:
        station.plant.pages.put_chain(replace(chain, counted=counts.newest, folded=counts.newest))
    return set(fresh)


def _events_of(page: PageRow) -> list[object]:
    events = load_exact(page.content, "A page").get("events", [])
    return events if isinstance(events, list) else []


def _fold_page(station: Station, chain: Chain, n: int, values: Sequence[object]) -> None:
    """Add the events of the next page that counts to what its station claims."""
    read = [stated for stated in map(event.read, values) if stated is not None]
    wrong = [stated for stated in read if isinstance(stated, str)]
    events = [stated for stated in read if isinstance(stated, Event)]
    known = station.plant.claims.known_ids(chain.id, [_number(stated.id) for stated in events])
    by_node: dict[bytes, list[Event]] = {}
    digests: list[tuple[bytes, int, bool]] = []
    lifted: set[str] = set()
    for stated in events:
        number = _number(stated.id)
        if number in known:
            wrong.append(f"{stated.act}: an id that stood before")
            continue
        known.add(number)
        if stated.act in ("signed", "vouched"):
            digest = stated.members["teds_sha256"]
            digests.append((bytes.fromhex(digest), n, stated.act == "vouched"))
        elif stated.act == "lifted":
            station.plant.claims.put_lifting(stated.members["of"], chain)
            lifted.add(stated.members["of"])
        if stated.uuid is not None:
            by_node.setdefault(stated.uuid, []).append(stated)
    station.plant.claims.add_ids(chain.id, known)
    station.plant.claims.put_digests(chain, digests)
    _keep_bans(station, chain, events, counts=True)
    if lifted:  # a ban from a bundle is on no page, so only the deny list has its node
        station.plant.claims.queue(
            ban.uuid for ban in station.policy.revocations() if event.hash_of_statement(ban.statement) in lifted
        )
    there = station.plant.claims.of_station(chain.id, list(by_node))
    claims: dict[bytes, str] = {}
    for uuid, statements in by_node.items():
        claim = Claim.from_json(there[uuid]) if uuid in there else Claim()
        for stated in statements:
            claim.apply_event(stated)
        claims[uuid] = claim.to_json()
    station.plant.claims.put(chain.id, claims)
    if wrong:
        why = f"{len(wrong)} events were skipped: {wrong[0]}"
        alarm(station, "bad-event", chain.station, n, why)


def _number(id: str) -> int:
    """Return an event's id as SQLite keeps it: a signed integer of 64 bits."""
    return int.from_bytes(bytes.fromhex(id), "big", signed=True)


def _keep_bans(station: Station, chain: Chain, values: Iterable[object], *, counts: bool) -> None:
    for value in values:
        one = value if isinstance(value, Event) else event.read(value)
        if isinstance(one, Event) and one.act == "revoked" and one.uuid is not None:
            text = one.members["statement"]
            if text.isascii():
                hash = event.hash_of_statement(text)
                station.plant.claims.put_ban(hash, chain.id, counts=counts, uuid=one.uuid, statement=text)


def counted_places(station: Station, roster: Roster, chain: Chain) -> frozenset[tuple[int, str]]:
    """Return number and H of the pages of a chain that count; of a fork, only those before the two histories part."""
    links = station.plant.pages.chain_links(chain.id)
    return frozenset(counting(links, last=_last(roster, chain.station), accepted=chain.accepted).pages)


def octets_of(row: PageRow) -> bytes:
    """Return the octets of a page, as they came."""
    return join(row.header, row.content, row.signature)


# -- what follows for each node: bans, pins, conflicts -----------------------------------------------------------------


class _LocalRows(NamedTuple):
    """The station's own rows about a batch of nodes."""

    entries: dict[bytes, WhitelistEntry]
    nodes: dict[bytes, NodeRecord]
    keys: dict[bytes, KeyRecord]

    @classmethod
    def read(cls, station: Station, uuids: Sequence[bytes]) -> _LocalRows:
        keys = {record.uuid: record for record in station.keys.get_many(uuids)}
        return cls(station.pins.get_many(uuids), station.nodes.get_many(uuids), keys)

    def local_state(self, station: Station, uuid: bytes, hashes: Sequence[tuple[str, str]]) -> LocalState:
        """Return this station's state of a node; ``hashes`` are H and text of the statements about it."""
        entry, node = self.entries.get(uuid), self.nodes.get(uuid)
        pin, assurance = (entry.fingerprint, entry.assurance) if entry is not None else (None, "")
        if assurance == "registry":
            pin, assurance = None, ""
        if not is_whole(pin) and node is not None and node.point is not None:
            seen = fingerprint(node.point)
            pin = seen if pin is None or same_key(pin, seen) else pin
        holders: frozenset[str] = frozenset()
        if hashes:
            gone = station.policy.tombstone(uuid)
            holders = frozenset(holder.fingerprint for holder in station.keys.holders(uuid))
            holders |= {gone.to_fingerprint} if gone is not None else set()
        return LocalState(
            station.fingerprint,
            pin,
            assurance,
            met=assurance in BY_CONTACT,
            holds=uuid in self.keys,
            holders=holders,
            lifted=frozenset(hash for hash, text in hashes if station.policy.was_lifted(text)),
        )


def merged_views(station: Station, roster: Roster, uuids: Sequence[bytes]) -> dict[bytes, MergedClaims]:
    """Return the plant's view of nodes, at most a batch of them, by today's rows; writes nothing."""
    return {uuid: seen for uuid, (seen, _) in _judged(station, roster, uuids, _LocalRows.read(station, uuids)).items()}


def _judged(
    station: Station, roster: Roster, uuids: Sequence[bytes], here: _LocalRows
) -> dict[bytes, tuple[MergedClaims, list[BanStatement]]]:
    claims = station.plant.claims.of_nodes(uuids)
    said: dict[bytes, list[BanStatement]] = {}
    for uuid, hash, page_of, counts, text in station.plant.claims.bans_of(uuids):
        try:
            read = open_revocation(text, lambda kid: roster.point_of(kid) or station.policy.station_points().get(kid))
        except TedsProvisionError:  # an unknown signer or a malformed statement: no ban
            continue
        if read.uuid == uuid:
            said.setdefault(uuid, []).append(BanStatement(hash, page_of, counts, read))
    lifted = {
        statement.hash: station.plant.claims.lifters(statement.hash) for every in said.values() for statement in every
    }
    judged = {}
    for uuid in uuids:
        statements = said.get(uuid, [])
        own = here.local_state(
            station, uuid, [(statement.hash, statement.revocation.statement) for statement in statements]
        )
        node = {station_id: Claim.from_json(claim) for station_id, claim in claims.get(uuid, {}).items()}
        judged[uuid] = merge_claims(roster, node, own, statements, lifted), statements
    return judged


def apply_claims(station: Station) -> int:
    """Update whitelist, deny list and conflicts for every node with new statements; return how many.

    Rule 2: no pin, key or right of this station's own goes; only what the registry pinned, or a page banned, comes and
    goes.
    """
    done = 0
    while uuids := station.plant.claims.to_judge(AT_ONCE):
        roster = require_roster(station)
        with station.transaction():
            here = _LocalRows.read(station, uuids)
            judged = _judged(station, roster, uuids, here)
            station.plant.claims.put_conflicts({uuid: seen.conflicts for uuid, (seen, _) in judged.items()})
            _pin(station, judged, here)
            for uuid, (seen, statements) in judged.items():
                if statements or station.policy.revocation(uuid) is not None:
                    _ban(station, uuid, seen, statements)
            station.plant.claims.note_judged(uuids)
        done += len(uuids)
    return done


def _pin(station: Station, judged: dict[bytes, tuple[MergedClaims, list[BanStatement]]], here: _LocalRows) -> None:
    """Whitelist what all keepers pin, if there is no own entry; and remove it when they no longer do."""
    put: list[WhitelistEntry] = []
    for uuid, (seen, _) in judged.items():
        entry, node = here.entries.get(uuid), here.nodes.get(uuid)
        if entry is not None and entry.assurance != "registry":
            continue
        other = node is not None and node.point is not None and fingerprint(node.point) != seen.pin
        wanted = None if other or seen.bans else seen.pin
        if entry is not None and wanted is None:
            station.pins.remove(uuid)
        elif wanted is not None and (entry is None or entry.fingerprint != wanted):
            put.append(WhitelistEntry(uuid, wanted, assurance="registry"))
    if put:
        station.pins.put(*put)


def _ban(station: Station, uuid: bytes, seen: MergedClaims, statements: Sequence[BanStatement]) -> None:
    """Keep one row on the deny list if any statement bans the node, and none if those of pages no longer do."""
    entry = station.policy.revocation(uuid)
    if entry is not None and entry.statement:
        hash = event.hash_of_statement(entry.statement)
        from_pages = any(statement.hash == hash for statement in statements)
        counts = any(statement.hash == hash for statement in seen.bans)
        if counts or (not from_pages and not _is_lifted(station, entry.statement, hash)):
            return
        station.policy.forgive(uuid)
        station.audit("revoke", uuid, "lifted", by="registry", why=entry.why)
    for statement in seen.bans[:1]:
        deny.deny(station, statement.revocation, key=station.pins.pinned(uuid))


def _is_lifted(station: Station, statement: str, hash: str) -> bool:
    """Return True if a ban of a bundle, or of this station, was lifted in a page by a keeper or by its own signer."""
    roster = require_roster(station)
    try:
        signer = open_revocation(statement, lambda kid: roster.point_of(kid) or _own(station, kid)).sender
    except TedsProvisionError:
        return False
    return any(lifter == signer or "keeper" in roster.roles_of(lifter) for lifter in station.plant.claims.lifters(hash))


def _own(station: Station, kid: str) -> bytes | None:
    return station.point if kid == station.fingerprint else station.policy.station_points().get(kid)


# -- the state of each station -----------------------------------------------------------------------------------------


def heads_digest(station: Station) -> tuple[str, int]:
    """Return 16 digits of the SHA-256 over the newest counted page of every chain, and the number of chains.

    Two stations that have all pages have the same one.
    """
    lines = sorted(
        f"{station_id} {chain.counted[0]} {chain.counted[1]}\n".encode()
        for station_id, chain in station.plant.pages.chains().items()
        if chain.counted[0]
    )
    return hashlib.sha256(b"".join(lines)).hexdigest()[:16], len(lines)
