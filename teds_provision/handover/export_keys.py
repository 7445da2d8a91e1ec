"""``export-keys``: node keys into a sealed bundle for other stations (profile section 6).

What a killed run leaves behind: a move's tombstones and its row are durable before any file exists, so the key rests
whatever happens; the same command then seals the same move again, under the same id.
"""

from __future__ import annotations

import hashlib
import uuid as uuids
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

from teds_provision.errors import NotFound, PolicyRefused, UsageFailure
from teds_provision.files import require_new, write_new
from teds_provision.handover.pending import OPEN, Notes, content_digest
from teds_provision.handover.trust import find_trusted
from teds_provision.protocol.handover.bundle import Bundle, BundledNode, Mode, seal_bundle
from teds_provision.protocol.handover.payload import time_text
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import Batch, Handover, Holder, KeyRecord, NodeRecord, Tombstone, TrustRecord, utc_now

DEFAULT_DAYS = 7
OUT_OF_SERVICE = ("decommissioned", "replaced by")  # verdicts that workflow.life gives


@dataclass(frozen=True)
class ExportOrder:
    """What to hand over: to whom (as typed), which nodes (None: all that can be), how, and for how many days."""

    to: tuple[str, ...]
    nodes: tuple[bytes, ...] | None
    mode: Mode = "copy"
    days: int = DEFAULT_DAYS
    ca: str | None = None


@dataclass(frozen=True)
class ExportPlan:
    """What would be handed over. ``skipped`` are nodes that ``--all`` leaves out, and why.

    ``earlier`` is the open handover that this one carries on: the same keys to the same stations. ``also_held_by`` are
    other stations (fingerprints) that hold a copy of any of these keys.
    """

    id: str
    mode: Mode
    receivers: tuple[TrustRecord, ...]
    ca: bytes
    signatures: Mapping[str, bytes]
    nodes: tuple[tuple[NodeRecord, KeyRecord], ...]
    skipped: tuple[tuple[bytes, str], ...]
    content: str
    expires: datetime
    earlier: Handover | None
    also_held_by: tuple[str, ...] = ()


@dataclass(frozen=True)
class Exported:
    """A bundle that lies in a file; ``fresh`` False where it lay there already."""

    plan: ExportPlan
    sha256: str
    octets: int
    fresh: bool


def plan_export(station: Station, order: ExportOrder, now: datetime | None = None) -> ExportPlan:
    """Find the receivers and nodes, and the CA's signature over each receiver; changes nothing.

    Raises NotFound, UsageFailure (two receivers of a move), PolicyRefused (a node without proven key, given away,
    revoked or due for rotation; nodes of several CAs; a receiver that is not certified), BadData (a receiver's file).
    """
    now = now or datetime.now(UTC)
    receivers = tuple({record.point: record for record in _receivers(station, order)}.values())
    if order.mode == "move" and len(receivers) != 1:
        raise UsageFailure("A move has exactly one receiver.", hint="Use --mode copy for several.")
    if order.days < 1:
        raise UsageFailure("A bundle is valid for at least one day.")
    nodes, skipped = _Selection(station, order, {record.fingerprint for record in receivers}).choose()
    ca = _one_ca(station, order, nodes)
    if order.ca is not None:
        nodes = [(node, key) for node, key in nodes if station.keys.ca_of(node.uuid) == ca]
    listed = ((node.uuid, key.key_id, key.epoch) for node, key in nodes)
    content = content_digest(station.fingerprint, [r.fingerprint for r in receivers], order.mode, ca, listed)
    earlier = next((row for row in station.handovers.all() if _is_same(row, content, now)), None)
    signatures = {record.fingerprint: _signature(station, ca, record) for record in receivers}
    expires = datetime.fromisoformat(Notes.from_json(earlier.nodes).expires) if earlier else None
    if expires is None or expires <= now:
        expires = now.replace(microsecond=0) + timedelta(days=order.days)
    handover_id = earlier.id if earlier else str(uuids.uuid4())
    return ExportPlan(
        handover_id,
        order.mode,
        receivers,
        ca,
        signatures,
        tuple(nodes),
        tuple(skipped),
        content,
        expires,
        earlier,
        _other_holders(station, nodes, receivers),
    )


def export_keys(station: Station, plan: ExportPlan, output: Path, now: datetime | None = None) -> Exported:
    """Seal the bundle into a new file of mode 0600; a move's keys rest from before that file exists.

    The same command over its own file finds nothing to do. Raises UsageFailure (another file lies there),
    StoreFailure, VaultFailure.
    """
    before = _already(plan, output)
    if before is not None:
        return Exported(plan, before, output.stat().st_size, fresh=False)
    require_new(output)
    now = now or datetime.now(UTC)
    sealed = _seal(station, plan, now)
    digest = hashlib.sha256(sealed).hexdigest()
    with station.transaction():
        _record(station, plan, digest)
    write_new(output, sealed)
    return Exported(plan, digest, len(sealed), fresh=True)


def _receivers(station: Station, order: ExportOrder) -> list[TrustRecord]:
    if not order.to:
        raise UsageFailure("Nobody is named to hand the keys to.", hint="Add --to STATION; see: trust list")
    return [find_trusted(station, text, "station") for text in order.to]


class _Selection:
    """Which nodes go, by the tables as they are now (read once: there may be ten thousand)."""

    def __init__(self, station: Station, order: ExportOrder, receivers: set[str]) -> None:
        self.station, self.order, self.receivers = station, order, receivers
        self.nodes = {node.uuid: node for node in station.nodes.all()}
        held = list(station.keys.all())
        self.keys = {key.uuid: key for key in held if key.state == "active"}
        self.pending = {key.uuid for key in held if key.state == "pending"}
        self.due = station.keys.rotations_due().keys()
        self.tombstones = {tombstone.uuid: tombstone for tombstone in station.policy.tombstones()}
        self.revoked = {revocation.uuid for revocation in station.policy.revocations()}
        self.open = {row.id: row for row in station.handovers.all() if row.direction == "out" and row.state == OPEN}

    def choose(self) -> tuple[list[tuple[NodeRecord, KeyRecord]], list[tuple[bytes, str]]]:
        """The nodes with their keys, and those that ``--all`` leaves out."""
        wanted = sorted(self.keys.keys() | self.pending) if self.order.nodes is None else sorted(set(self.order.nodes))
        why = {uuid: self._obstacle(uuid) for uuid in wanted}
        if self.order.nodes is None and all(why.values()):
            carried_on = self._cut_move()
            if carried_on:
                wanted, why = carried_on, dict.fromkeys(carried_on, "")
        if self.order.nodes is not None:
            for uuid, obstacle in why.items():
                if obstacle:
                    raise PolicyRefused(f"Node {uuid.hex()} cannot be handed over: {obstacle}.", hint=_CURE)
        chosen = [(self.nodes[uuid], self.keys[uuid]) for uuid in wanted if not why[uuid]]
        if not chosen:
            raise NotFound("There is no node to hand over.", hint="Name nodes, or see: teds-provision nodes")
        return chosen, [(uuid, obstacle) for uuid, obstacle in why.items() if obstacle]

    def _obstacle(self, uuid: bytes) -> str:
        node, tombstone = self.nodes.get(uuid), self.tombstones.get(uuid)
        if uuid in self.revoked:
            return "it is revoked"
        if tombstone is not None and not (self.order.nodes is not None and self._is_cut(uuid)):
            return f"it was moved to station {tombstone.to_fingerprint[:16]}"
        if uuid not in self.keys:
            return "its key was never proven in a session" if uuid in self.pending else "no key of it is held here"
        if uuid in self.due:
            return "its key must be rotated first"
        if node is not None and (node.verdict or "").startswith(OUT_OF_SERVICE):
            return "it is out of service"
        if node is None or node.point is None:
            return "its public key is not known"
        return ""

    def _is_cut(self, uuid: bytes) -> bool:
        """Whether this node rests because of a move to the same receiver that is still open."""
        tombstone = self.tombstones[uuid]
        return (
            self.order.mode == "move"
            and tombstone.handover_id in self.open
            and tombstone.to_fingerprint in self.receivers
        )

    def _cut_move(self) -> list[bytes]:
        """The nodes of the newest open move to this receiver: ``--all`` again after a cut means that one."""
        if self.order.mode != "move":
            return []
        rows = [row for row in self.open.values() if row.mode == "move" and set(row.peers) == self.receivers]
        return sorted(map(bytes.fromhex, Notes.from_json(rows[-1].nodes).uuids)) if rows else []


_CURE = "See teds-provision nodes UUID; rotate with: teds-provision agree UUID --rotate"


def _one_ca(station: Station, order: ExportOrder, nodes: list[tuple[NodeRecord, KeyRecord]]) -> bytes:
    """The CA that the nodes keep: one bundle has one."""
    of, own = station.keys.cas_of_nodes(), station.ca
    found = {fingerprint(ca): ca for ca in {of.get(node.uuid, own) for node, _ in nodes}}
    if order.ca is not None:
        found = {digits: ca for digits, ca in found.items() if digits.startswith(order.ca.lower())}
        if not found:
            raise NotFound(f"None of these nodes keeps a CA key {order.ca}.")
    if len(found) > 1:
        raise PolicyRefused(
            f"These nodes keep {len(found)} different CA keys; a bundle is for one.",
            hint=f"Export them apart: --ca {' / --ca '.join(sorted(digits[:16] for digits in found))}",
        )
    return next(iter(found.values()))


def _signature(station: Station, ca: bytes, receiver: TrustRecord) -> bytes:
    """SIG104 over the receiver: known, or made now where the CA key is here."""
    known = station.identity.certificate(ca, receiver.point)
    if known is None and ca == station.ca:
        try:
            known = station.identity.certify(receiver.point)
        except NotFound:
            known = None
    if known is None:
        raise PolicyRefused(
            f"Station {receiver.name!r} is not certified by the CA {fingerprint(ca)[:16]}, whose key is not here:"
            " it could read these nodes, but neither write nor rotate them.",
            hint="Where the CA key is kept: trust ca sign REQUEST --output CERT; here: trust add NAME CERT",
        )
    return known


def _other_holders(
    station: Station, nodes: list[tuple[NodeRecord, KeyRecord]], receivers: tuple[TrustRecord, ...]
) -> tuple[str, ...]:
    """Stations besides the receivers that hold any of these keys since an earlier copy."""
    chosen = {node.uuid for node, _ in nodes}
    found = {holder.fingerprint for holder in station.keys.holders() if holder.uuid in chosen}
    return tuple(sorted(found - {record.fingerprint for record in receivers}))


def _is_same(row: Handover, content: str, now: datetime) -> bool:
    if row.direction != "out" or row.state != OPEN:
        return False
    notes = Notes.from_json(row.nodes)
    return notes.content == content and (row.mode == "move" or datetime.fromisoformat(notes.expires) > now)


def _already(plan: ExportPlan, output: Path) -> str | None:
    """Digest of the file where it is one that this very handover gave before."""
    if plan.earlier is None or not output.is_file():
        return None
    with output.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return digest if digest in Notes.from_json(plan.earlier.nodes).files else None


def _seal(station: Station, plan: ExportPlan, now: datetime) -> bytes:
    own = station.identity.certificate(plan.ca, station.point)
    bundle = Bundle(
        id=plan.id,
        sender=station.fingerprint,
        to=tuple(record.fingerprint for record in plan.receivers),
        created=now.replace(microsecond=0),
        expires=plan.expires,
        mode=plan.mode,
        ca=plan.ca,
        nodes=tuple(_bundled(station, node, key) for node, key in plan.nodes),
        # The sender's own goes along, so that the receiver can hand the nodes back one day.
        station_signatures={**plan.signatures, **({station.fingerprint: own} if own else {})},
        revoked=tuple(revocation.statement for revocation in station.policy.revocations()),
    )
    return seal_bundle(bundle, station.vault.identity(), [record.point for record in plan.receivers])


def _bundled(station: Station, node: NodeRecord, key: KeyRecord) -> BundledNode:
    assert node.point is not None
    return BundledNode(
        uuid=node.uuid,
        node_key=node.point,
        key=station.keys.unwrap(key),
        epoch=key.epoch,
        sequence=node.sequence,
        profile=node.profile,
        name=node.name,
        groups=node.groups,
        teds_sha256=node.teds_sha256,
    )


def _record(station: Station, plan: ExportPlan, digest: str) -> None:
    """What must be durable before the file: who holds what, the bundle's row, and for a move the tombstones."""
    files = (*(Notes.from_json(plan.earlier.nodes).files if plan.earlier else ()), digest)
    uuids_hex = tuple(node.uuid.hex() for node, _ in plan.nodes)
    notes = Notes(uuids_hex, plan.content, plan.ca.hex(), time_text(plan.expires), files)
    peers = tuple(record.fingerprint for record in plan.receivers)
    row = plan.earlier or Handover(plan.id, "out", plan.mode, peers, OPEN, "")
    station.handovers.put(replace(row, nodes=notes.to_json(), bundle_sha256=digest))
    for record in plan.receivers:
        station.identity.keep_certificate(plan.ca, record.point, plan.signatures[record.fingerprint])
    if plan.mode == "copy":
        now = utc_now()
        holders = [Holder(node.uuid, peer, now) for node, _ in plan.nodes for peer in peers]
        station.handovers.take_in(Batch(holders=holders))
    elif plan.earlier is None:
        now = utc_now()
        tombstones = [Tombstone(node.uuid, peers[0], plan.id, now) for node, _ in plan.nodes]
        station.handovers.take_in(Batch(tombstones=tombstones))
    detail = {"handover": plan.id, "mode": plan.mode, "to": list(peers), "nodes": list(uuids_hex), "file": digest}
    station.audit("export", None, "again" if plan.earlier else "done", **detail)
