"""What the store knows of its nodes, put together from all of its tables; no secret is among it."""

from __future__ import annotations

from typing import Any

from teds_provision.errors import NotFound
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station
from teds_provision.store import KeyRecord, NodeRecord


def inventory(station: Station, uuid: bytes | None = None) -> list[dict[str, Any]]:
    """Describe every node, or the one of ``uuid``; raises NotFound where nothing at all is known of it."""
    store = station._store
    if uuid is not None:
        known = store.node(uuid)
        named = known or store.whitelisted(uuid) or store.keys(uuid) or store.tombstone(uuid) or store.revocation(uuid)
        if not named:
            raise NotFound(f"Nothing is known of node {uuid.hex()}.", hint="See: teds-provision nodes.")
        records = [known or NodeRecord(uuid)]
        keys = {uuid: store.keys(uuid)}
    else:
        records, keys = store.nodes(), {}
        for key in store.all_keys():
            keys.setdefault(key.uuid, []).append(key)
    whitelist = {entry.uuid: entry for entry in store.whitelist()}
    tombstones = {tombstone.uuid: tombstone for tombstone in store.tombstones()}
    revocations = {revocation.uuid: revocation for revocation in store.revocations()}
    holders: dict[bytes, list[dict[str, str]]] = {}
    for holder in store.holders(uuid):
        told = {"fingerprint": holder.fingerprint, "mode": holder.mode, "since": holder.since}
        holders.setdefault(holder.uuid, []).append(told)
    described = []
    for record in records:
        entry, tombstone = whitelist.get(record.uuid), tombstones.get(record.uuid)
        revocation = revocations.get(record.uuid)
        point = fingerprint(record.point) if record.point is not None else None
        described.append(
            {
                "uuid": record.uuid.hex(),
                "name": record.name or (entry.name if entry else None),
                "profile": record.profile,
                "state": _state(record),
                "epoch": record.epoch,
                "sequence": record.sequence,
                "fingerprint": point or (entry.fingerprint if entry else None),
                "whitelisted": entry is not None,
                "assurance": entry.assurance if entry else None,
                "verdict": record.verdict,
                "last_seen": record.last_seen,
                "channels": record.channels,
                "can_address": record.can_address,
                "groups": list(record.groups),
                "teds_sha256": record.teds_sha256,
                "keys": [_key(key) for key in keys.get(record.uuid, [])],
                "moved_to": tombstone and {"fingerprint": tombstone.to_fingerprint, "handover": tombstone.handover_id},
                "holders": holders.get(record.uuid, []),
                "revoked": revocation and {"why": revocation.why, "since": revocation.created},
            }
        )
    return described


def _state(record: NodeRecord) -> str | None:
    if record.last_seen is None and record.point is None:
        return None
    try:
        return NodeState(record.state).name.lower()
    except ValueError:
        return f"unknown ({record.state})"


def _key(key: KeyRecord) -> dict[str, Any]:
    return {
        "key_id": key.key_id,
        "epoch": key.epoch,
        "state": key.state,
        "source": key.source,
        "created": key.created,
    }
