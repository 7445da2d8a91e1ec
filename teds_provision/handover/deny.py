"""The deny list: whose statement bans a node here, and how a ban is withdrawn.

A statement counts if its signer has authority over the node: this station itself; a station that holds a key of it, or
that it was given to; one that is certified by the CA that the node keeps; or the sender of the very bundle that brings
the node. And only for the key that it names, or for the one that the UUID is pinned to here: a signer who could ban any
UUID could take other owners' nodes out of service.
"""

from __future__ import annotations

from teds_provision.protocol.fingerprints import same_key
from teds_provision.protocol.handover.bundle import Bundle
from teds_provision.protocol.handover.revocation import Revocation as Statement
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord


def why_not(station: Station, statement: Statement, bundle: Bundle) -> str:
    """Return why a statement that came in ``bundle`` bans nothing here; "" if it counts."""
    if station.policy.was_lifted(statement.statement):
        return "it was lifted here"
    brought = next((node for node in bundle.nodes if node.uuid == statement.uuid), None)
    key = _key_of(station, statement.uuid, bundle)
    if key is None:
        return "this node is unknown here"
    if statement.fingerprint is not None and not same_key(statement.fingerprint, key):
        return f"it names the key {str(statement.fingerprint)[:32]}, and the node here has another"
    if not _has_authority(station, statement) and not (brought is not None and statement.sender == bundle.sender):
        return f"station {statement.sender[:32]} has no authority over this node"
    return ""


def deny(station: Station, statement: Statement, *, key: str | None) -> None:
    """Add a signed statement to the deny list, bound to ``key`` if it names none; an existing one stays."""
    if station.policy.revocation(statement.uuid) is None:
        created = time_text(statement.created)
        named = statement.fingerprint or key
        entry = RevocationRecord(statement.uuid, named, statement.why, statement.statement, created)
        station.policy.deny(entry)
        station.audit("revoke", statement.uuid, "on the deny list", why=statement.why, by=statement.sender)
        if station.plant.joined is not None:  # a page with its lifting may have arrived before the ban
            station.plant.claims.queue([statement.uuid])


def deny_all(station: Station, statements: tuple[Statement, ...], bundle: Bundle) -> None:
    """Put what counts of a bundle on the deny list."""
    for statement in statements:
        deny(station, statement, key=_key_of(station, statement.uuid, bundle))


def lift(station: Station, uuid: bytes) -> bool:
    """Take a ban back, by a person's word; the same statement bans nothing here any more. False if there is none."""
    entry = station.policy.revocation(uuid)
    if entry is None:
        return False
    station.unlock()
    with station.transaction():
        station.policy.lift(uuid)
        station.audit("revoke", uuid, "lifted", why=entry.why)
    return True


def _key_of(station: Station, uuid: bytes, bundle: Bundle) -> str | None:
    """Return the key that a UUID is pinned to here, else the one that the bundle brings with it."""
    pinned = station.pins.pinned(uuid)
    brought = next((fingerprint(node.node_key) for node in bundle.nodes if node.uuid == uuid), None)
    return pinned or brought


def _has_authority(station: Station, statement: Statement) -> bool:
    uuid, signer = statement.uuid, statement.sender
    if signer == station.fingerprint or any(holder.fingerprint == signer for holder in station.keys.holders(uuid)):
        return True
    tombstone = station.policy.tombstone(uuid)
    if tombstone is not None and tombstone.to_fingerprint == signer:
        return True
    # the CA certifies every member, so a certificate alone gives no authority among them
    if station.policy.in_roster(signer):
        roster = station.plant.roster
        return roster is not None and roster.has(signer, "keeper")
    point = station.policy.station_points().get(signer)
    known = station.nodes.get(uuid) is not None or station.pins.entry(uuid) is not None
    return known and point is not None and station.identity.certificate(station.keys.ca_of(uuid), point) is not None
