"""Joining with an existing store: its facts as events (contract/plant.md section 2).

Nodes that were provisioned before the plant was made stay authentic at every member: what this station signed, and
still has a record of, is in its first pages.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterator
from typing import Any

from teds_provision.errors import BadDataError, TedsProvisionError
from teds_provision.handover.pending import UNDONE, BundleNotes, refused_in, signer_of
from teds_provision.protocol.datasheet import signature_good
from teds_provision.protocol.fingerprints import is_whole
from teds_provision.protocol.handover.revocation import open_revocation
from teds_provision.station.firmware import plant_event
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord
from teds_provision.teds.codec import security
from teds_provision.teds.image import Image

PastEvent = tuple[str, bytes | None, dict[str, Any]]


def backlog(station: Station) -> Iterator[PastEvent]:
    """Yield the events that this station would have recorded as a member: act, node, members; writes nothing."""
    for entry in station.pins.all_entries():
        if is_whole(entry.fingerprint) and entry.assurance != "registry":
            yield "pinned", entry.uuid, {"fingerprint": entry.fingerprint, "assurance": entry.assurance}
    keys = {record.uuid: record for record in station.keys.all() if record.state == "active"}
    for uuid, record in keys.items():
        pinned = station.pins.pinned(uuid)
        if record.source == "agreement" and is_whole(pinned):
            yield "agreed", uuid, {"fingerprint": pinned, "epoch": record.epoch, "key_id": record.key_id}
    yield from _handed(station, keys)
    for shown in station.nodes.all_shown_keys():
        for epoch, sequence, digest in signed_here(station, shown.uuid):
            yield "signed", shown.uuid, {"epoch": epoch, "sequence": sequence, "teds_sha256": digest}
    yield from firmware_reports(station)
    for ban in station.policy.revocations():
        try:
            own = open_revocation(ban.statement, lambda kid: station.point if kid == station.fingerprint else None)
        except TedsProvisionError:  # another station's statement, which that station publishes itself
            continue
        yield "revoked", ban.uuid, {"statement": own.statement}


def _handed(station: Station, keys: dict[bytes, KeyRecord]) -> Iterator[PastEvent]:
    """Yield events of the keys that left and arrived, by the recorded handovers."""
    for row in station.handovers.all():
        notes = BundleNotes.from_json(row.nodes)
        refused = {uuid for uuid, _ in notes.refused}
        receipts = (row.receipt or "").split() if row.direction == "out" else ()
        refused_by = {signer_of(receipt): refused_in(receipt) for receipt in receipts}
        for at, digits in enumerate(notes.uuids):
            uuid = bytes.fromhex(digits)
            held, node = keys.get(uuid), station.nodes.get(uuid)
            key_id = notes.keys[at] if at < len(notes.keys) else held.key_id if held is not None else None
            if digits in refused or row.state == UNDONE or key_id is None:
                continue
            same = held is not None and held.key_id == key_id
            epoch = held.epoch if held is not None and same else node.epoch if node is not None else 0
            handed = {"epoch": epoch, "key_id": key_id, "mode": row.mode, "bundle": row.id}
            if row.direction == "in" and same and held is not None and held.source == "import":
                yield "took", uuid, {**handed, "peer": row.peers[0]}
            elif row.direction == "out":
                takers = (peer for peer in row.peers if digits not in refused_by.get(peer, ()))
                yield from (("gave", uuid, {**handed, "peer": peer}) for peer in takers)


def firmware_reports(station: Station) -> Iterator[PastEvent]:
    """Yield events of the firmware that nodes reported in a session, as recorded here."""
    for record in station.firmware_reports.all():
        if (stated := plant_event(record)) is not None:
            yield "firmware", record.uuid, {"runs": stated.members, "at": record.at}


def signed_here(station: Station, uuid: bytes) -> Iterator[tuple[int, int, str]]:
    """Yield epoch, sequence and digest of every recorded datasheet of a node that this station signed."""
    draft = station.datasheets.draft(uuid)
    images: list[Image] = [record.image for record in station.datasheets.history(uuid)]
    images += [draft.image] if draft is not None and draft.stage == "signed" else []
    seen: set[str] = set()
    for image in images:
        octets = image.security
        try:
            shown = security.decode(octets) if octets is not None else None
        except BadDataError:
            continue
        if octets is None or shown is None or not shown.signed or shown.station_key != station.point:
            continue
        digest = hashlib.sha256(octets).hexdigest()
        if digest not in seen and signature_good(shown, octets, uuid):
            seen.add(digest)
            yield shown.key_epoch, shown.sequence, digest


def count(events: list[PastEvent]) -> dict[str, int]:
    """Return the number of events of each act."""
    return dict(Counter(act for act, _, _ in events))
