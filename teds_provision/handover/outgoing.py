"""``export-keys``: node keys into a sealed bundle for other stations (profile.md, "Handover between base stations").

After a killed run: a move's tombstones and its row are durable before any file exists, so the key rests
whatever happens; the same command then seals the same move again, under the same id.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple
from uuid import uuid4

from teds_provision.errors import NotFoundError, PolicyError, UsageError
from teds_provision.files import new_file, require_new
from teds_provision.handover import gc_pause
from teds_provision.handover.pending import OPEN, BundleNotes, content_digest
from teds_provision.handover.trust import find_trusted
from teds_provision.protocol.handover.bundle import Bundle, BundledNode, Mode, seal_pieces
from teds_provision.protocol.handover.envelope import EnvelopeWriter
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.bulk import BulkRows
from teds_provision.station.station import Station
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import (
    ExportEligibility,
    Handover,
    Holder,
    NodeRecord,
    Tombstone,
    TrustRecord,
    utc_now,
)

# Which nodes an export includes, and why others are left out.

DEFAULT_DAYS = 7
OUT_OF_SERVICE = ("decommissioned", "replaced by")  # the words that handover/life.py writes
_UNKNOWN = "its public key is not known"
_CURE = "See teds-provision nodes UUID; any session settles it, or: teds-provision agree UUID --rotate"


@dataclass(frozen=True)
class ExportOrder:
    """A request for a handover: the receiver (as typed), the nodes (None: all that can go), the mode, and the days."""

    to: tuple[str, ...]
    nodes: tuple[bytes, ...] | None
    mode: Mode = "copy"
    days: int = DEFAULT_DAYS
    ca: str | None = None


class LeavingNode(NamedTuple):
    """A node to export, by UUID, with its present key; the rest is read when the bundle is sealed."""

    uuid: bytes
    key_id: str
    epoch: int


Chosen = list[LeavingNode]


class Selection:
    """Selects nodes to export from the present tables (read once, a chunk at a time: there may be ten thousand)."""

    def __init__(self, station: Station, order: ExportOrder, receivers: set[str]) -> None:
        self.order, self.receivers = order, receivers
        self.keys: dict[bytes, LeavingNode] = {}
        self.pending: set[bytes] = set()
        for uuid, key_id, epoch, state in _keys(station, order.nodes):
            if state == "active":
                self.keys[uuid] = LeavingNode(uuid, key_id, epoch)
            else:
                self.pending.add(uuid)
        self.stays = _why_nodes_stay(station, order.nodes)
        self.due = station.keys.rotations_due().keys()
        self.tombstones = {tombstone.uuid: tombstone for tombstone in station.policy.tombstones()}
        self.revoked = {revocation.uuid for revocation in station.policy.revocations()}
        self.rows = [row for row in station.handovers.all() if row.direction == "out" and row.state == OPEN]
        self.open = {row.id: row for row in self.rows}

    def parts(self, nodes: Chosen, most: int) -> list[Chosen]:
        """Divide the nodes into bundles: those of an open move as they were, the others by ``most``."""
        resting: dict[str, Chosen] = {}
        free: Chosen = []
        for node in nodes:
            tombstone = self.tombstones.get(node.uuid)
            (free if tombstone is None else resting.setdefault(tombstone.handover_id, [])).append(node)
        return [*resting.values(), *(free[start : start + most] for start in range(0, len(free), most))]

    def choose(self) -> tuple[Chosen, list[tuple[bytes, str]]]:
        """Return the nodes with their keys, and those that ``--all`` leaves out."""
        why = self._every() if self.order.nodes is None else self._named(self.order.nodes)
        chosen = [self.keys[uuid] for uuid, obstacle in why.items() if not obstacle]
        if not chosen:
            raise NotFoundError("There is no node to hand over.", hint="Name the nodes; see: teds-provision nodes")
        return chosen, [(uuid, obstacle) for uuid, obstacle in why.items() if obstacle]

    def fitting(self) -> Chosen:
        """Return those of the named nodes that can be exported."""
        return [self.keys[uuid] for uuid in sorted(set(self.order.nodes or ())) if not self._obstacle(uuid)]

    def why_outdated(self, uuid: bytes, key_id: str) -> str:
        """Return why this key, which is in a bundle that was made earlier, must not leave now; "" if it may.

        The key of a move rests: nothing can rotate it here, and its receiver does so at once.
        """
        if self.order.mode == "move":
            held = uuid in self.keys
            return "it is revoked" if uuid in self.revoked else "" if held else "this station holds no key for it"
        why = self._obstacle(uuid)
        return why if why or self.keys[uuid].key_id == key_id else "its key was replaced since"

    def _named(self, nodes: tuple[bytes, ...]) -> dict[bytes, str]:
        """Return the nodes that were named; raises PolicyError if one cannot go."""
        why = {uuid: self._obstacle(uuid) for uuid in sorted(set(nodes))}
        for uuid, obstacle in why.items():
            if obstacle:
                raise PolicyError(f"Node {uuid.hex()} cannot be handed over: {obstacle}.", hint=_CURE)
        return why

    def _every(self) -> dict[bytes, str]:
        """Return every node with a held key and what keeps it here; if all stay, those of an interrupted move."""
        special = {*self.revoked, *self.tombstones, *self.due, *self.pending}
        why = {
            uuid: self._obstacle(uuid) if uuid in special else self.stays.get(uuid, _UNKNOWN)
            for uuid in sorted(self.keys.keys() | self.pending)
        }
        if all(why.values()):
            return self._cut_again() or why
        return why

    def _cut_again(self) -> dict[bytes, str]:
        """Return the nodes of an interrupted move; PolicyError if one of them has been revoked or forgotten since."""
        resting = self._cut_move()
        for uuid in resting:
            if uuid in self.revoked or uuid not in self.keys:
                why = "it is revoked" if uuid in self.revoked else "this station holds no key for it"
                raise PolicyError(
                    f"The pending move includes node {uuid.hex()} and cannot be sealed again: {why}.",
                    hint="Undo the move (handover list, handover undo ID), then hand over the others.",
                )
        return dict.fromkeys(resting, "")

    def _obstacle(self, uuid: bytes) -> str:
        return self._key_stays(uuid) or self.stays.get(uuid, _UNKNOWN)

    def _key_stays(self, uuid: bytes) -> str:
        tombstone = self.tombstones.get(uuid)
        if uuid in self.revoked:
            return "it is revoked"
        if tombstone is not None and not (self.order.nodes is not None and self._is_cut(uuid)):
            return f"it was moved to station {tombstone.to_fingerprint[:16]}"
        if uuid not in self.keys:
            never = "its key was never proven in a session"
            return never if uuid in self.pending else "this station holds no key for it"
        if self.order.mode == "move" and uuid in self.pending:
            return "an agreement with it is not settled: the key that it has now may be a newer one"
        if uuid in self.due:
            return "its key must be rotated first"
        return ""

    def _is_cut(self, uuid: bytes) -> bool:
        """Return True if this node rests because of a move to the same receiver that is still open."""
        tombstone = self.tombstones[uuid]
        return (
            self.order.mode == "move"
            and tombstone.handover_id in self.open
            and tombstone.to_fingerprint in self.receivers
        )

    def _cut_move(self) -> list[bytes]:
        """Return the nodes of the newest open move to this receiver, and of the bundles made by the same command.

        ``--all`` again after an interruption means these.
        """
        if self.order.mode != "move":
            return []
        rows = [row for row in self.open.values() if row.mode == "move" and set(row.peers) == self.receivers]
        together = _of_the_last_run([BundleNotes.from_json(row.nodes) for row in rows])
        return sorted(bytes.fromhex(uuid) for notes in together for uuid in notes.uuids)


def why_outdated(station: Station, row: Handover) -> tuple[bytes, str] | None:
    """Return the first node of a bundle that no export would include now with that key, and why; None if all go.

    For a bundle that was sealed and has not left: a node may have been revoked since, or its key rotated.
    """
    notes = BundleNotes.from_json(row.nodes)
    uuids = tuple(bytes.fromhex(uuid) for uuid in notes.uuids)
    selection = Selection(station, ExportOrder(row.peers, uuids, row.mode), set(row.peers))
    found = ((uuid, selection.why_outdated(uuid, key)) for uuid, key in zip(uuids, notes.keys, strict=False))
    return next(((uuid, why) for uuid, why in found if why), None)


def _keys(station: Station, wanted: tuple[bytes, ...] | None) -> Iterator[tuple[bytes, str, int, str]]:
    """Return UUID, key id, epoch and state of the keys of the wanted nodes, or of all."""
    if wanted is None:
        return station.keys.all_key_names()
    records = (key for chunk in chunks(wanted) for key in station.keys.get_many(chunk))
    return ((key.uuid, key.key_id, key.epoch, key.state) for key in records)


def _why_nodes_stay(station: Station, wanted: tuple[bytes, ...] | None) -> dict[bytes, str]:
    """Return why each of the wanted nodes, or of all, cannot be exported whatever its key; "" if it can."""
    known: Iterable[Sequence[NodeRecord | ExportEligibility]] = (
        chunks(station.nodes.all_shown_keys())
        if wanted is None
        else (list(station.nodes.get_many(chunk).values()) for chunk in chunks(wanted))
    )
    stays: dict[bytes, str] = {}
    for chunk in known:
        elsewhere = station.pins.pinned_elsewhere(chunk)
        stays |= {node.uuid: _why_node_stays(node, pinned_elsewhere=node.uuid in elsewhere) for node in chunk}
    return stays


def _why_node_stays(node: NodeRecord | ExportEligibility, *, pinned_elsewhere: bool) -> str:
    if node.retired is not None and node.retired.startswith(OUT_OF_SERVICE):
        return "it is out of service"
    if node.point is None:
        return _UNKNOWN
    if pinned_elsewhere:
        return "the key that it showed last is not the one that it is pinned to"
    return ""


def _of_the_last_run(notes: list[BundleNotes]) -> list[BundleNotes]:
    """Return the newest bundle, with all that the same command made."""
    return [note for note in notes if note.run and note.run == notes[-1].run] or notes[-1:]


NODES_IN_A_BUNDLE = 50_000
"""Well below what a bundle can hold (64 MiB), so that a few long names do not burst one."""


@dataclass(frozen=True)
class ExportPlan:
    """Preview of a handover. ``skipped`` are nodes that ``--all`` leaves out, with the reason.

    ``earlier`` is the open handover that this one carries on: the same keys to the same stations. ``also_held_by`` are
    other stations (fingerprints) that hold a copy of any of these keys.
    """

    id: str
    mode: Mode
    receivers: tuple[TrustRecord, ...]
    ca: bytes
    signatures: Mapping[str, bytes]
    nodes: tuple[LeavingNode, ...]
    skipped: tuple[tuple[bytes, str], ...]
    content: str
    expires: datetime
    earlier: Handover | None
    also_held_by: tuple[str, ...] = ()
    run: str = ""
    """Id of the first bundle if one command made several."""


@dataclass(frozen=True)
class ExportResult:
    """A bundle in a file; ``fresh`` False if the file existed already."""

    plan: ExportPlan
    sha256: str
    octets: int
    fresh: bool


def plan_export(station: Station, order: ExportOrder, now: datetime | None = None) -> ExportPlan:
    """Plan one bundle as :func:`plan_exports` does; raises UsageError if it takes more than one."""
    plans = plan_exports(station, order, now=now)
    if len(plans) > 1:
        raise UsageError("These are too many nodes for one bundle.", hint="Export them in several bundles.")
    return plans[0]


@gc_pause.pause_gc()
def plan_exports(
    station: Station, order: ExportOrder, *, most: int = NODES_IN_A_BUNDLE, now: datetime | None = None
) -> list[ExportPlan]:
    """Find the receivers and nodes, and the CA's signature over each receiver; changes nothing.

    Returns a plan for each bundle, of at most ``most`` nodes. Raises NotFoundError, UsageError (two receivers of a
    move), PolicyError (a node without proven key, given away, revoked, due for rotation or, for a move, with an
    agreement that is not settled; nodes of several CAs; a receiver that is not certified), BadDataError (a receiver's
    file).
    """
    receivers = tuple({record.point: record for record in _receivers(station, order)}.values())
    if order.mode == "move" and len(receivers) != 1:
        raise UsageError("A move has exactly one receiver.", hint="For several receivers, use --mode copy.")
    if order.days < 1:
        raise UsageError("A bundle is valid for at least one day.")
    selection = Selection(station, order, {record.fingerprint for record in receivers})
    nodes, skipped = selection.choose()
    ca = _one_ca(station, order, nodes)
    if order.ca is not None:
        nodes = [node for node, kept in _with_ca(station, nodes) if kept == ca]
    signatures = {record.fingerprint: _signature(station, ca, record) for record in receivers}
    common = _SharedFields(
        order, receivers, ca, signatures, now or datetime.now(UTC), station.fingerprint, selection.rows
    )
    plans = [common.plan(part, _other_holders(station, part, receivers)) for part in selection.parts(nodes, most)]
    return [replace(plans[0], skipped=tuple(skipped)), *plans[1:]]


@dataclass(frozen=True)
class _SharedFields:
    """Fields that the bundles of one command share."""

    order: ExportOrder
    receivers: tuple[TrustRecord, ...]
    ca: bytes
    signatures: Mapping[str, bytes]
    now: datetime
    sender: str
    rows: Sequence[Handover]

    def plan(self, nodes: Chosen, also_held_by: tuple[str, ...]) -> ExportPlan:
        """Return the plan of one bundle; an open one of the same content is carried on."""
        mode, to = self.order.mode, [record.fingerprint for record in self.receivers]
        listed = ((node.uuid, node.key_id, node.epoch) for node in sorted(nodes, key=attrgetter("uuid")))
        content = content_digest(self.sender, to, mode, self.ca, listed)
        earlier = next((row for row in self.rows if _is_same(row, content, self.now)), None)
        notes = BundleNotes.from_json(earlier.nodes) if earlier else None
        if notes is None or notes.why_stale(self.now):
            expires = self.now.replace(microsecond=0) + timedelta(days=self.order.days)
        else:
            expires = datetime.fromisoformat(notes.expires)
        return ExportPlan(
            earlier.id if earlier else str(uuid4()),
            mode,
            self.receivers,
            self.ca,
            self.signatures,
            tuple(nodes),
            (),
            content,
            expires,
            earlier,
            also_held_by,
            notes.run if notes else "",
        )


@gc_pause.pause_gc()
def export_bundle(station: Station, plan: ExportPlan, output: Path, now: datetime | None = None) -> ExportResult:
    """Seal the bundle into a new file of mode 0600; the store has it, and a move's keys rest, before it has its name.

    Until then the file is a draft without signature and tag, under a temporary name. The same
    command over its own file finds nothing to do. Raises UsageError (the path holds another file, or this bundle as it
    was sealed before, and no receiver would take it now), StoreError, VaultError.
    """
    now = now or datetime.now(UTC)
    before = _already(plan, output, now)
    if before is not None:
        return ExportResult(plan, before, output.stat().st_size, fresh=False)
    require_new(output)
    made = _sealing(station, plan, now)
    with new_file(output) as file:
        for piece in made.body():
            file.write(piece)
        end = made.end()
        with station.transaction():
            _record(station, plan, (made.sha256, made.signed_sha256), now)
        file.write(end)
    return ExportResult(plan, made.sha256, made.octets, fresh=True)


@dataclass(frozen=True)
class SealedBundle:
    """A bundle without a file; :func:`record_export` has to be durable before it leaves this process."""

    plan: ExportPlan
    octets: bytes
    sha256: str
    signed_sha256: str
    created: datetime


@gc_pause.pause_gc()
def seal_export(station: Station, plan: ExportPlan, now: datetime) -> SealedBundle:
    """Seal a bundle in memory, for a parcel. Raises StoreError, VaultError, PolicyError (a node changed)."""
    made = _sealing(station, plan, now)
    octets = b"".join([*made.body(), made.end()])
    return SealedBundle(plan, octets, made.sha256, made.signed_sha256, now)


def record_export(station: Station, sealed: SealedBundle) -> None:
    """Record the new holders; the caller's transaction also stores the parcel."""
    _record(station, sealed.plan, (sealed.sha256, sealed.signed_sha256), sealed.created)


def plan_copies(
    station: Station, receiver: TrustRecord, uuids: Sequence[bytes], now: datetime, *, most: int = NODES_IN_A_BUNDLE
) -> list[ExportPlan]:
    """Return plans of copies for one station: those of the nodes that may go and keep the owner's CA.

    Nodes that an export leaves out are left out without a notice. Raises PolicyError if the receiver is not certified.
    """
    order = ExportOrder((receiver.fingerprint,), tuple(uuids), "copy", ca=fingerprint(station.ca))
    selection = Selection(station, order, {receiver.fingerprint})
    nodes = [node for node, kept in _with_ca(station, selection.fitting()) if kept == station.ca]
    if not nodes:
        return []
    signatures = {receiver.fingerprint: _signature(station, station.ca, receiver)}
    common = _SharedFields(order, (receiver,), station.ca, signatures, now, station.fingerprint, selection.rows)
    return [common.plan(part, ()) for part in selection.parts(nodes, most)]


def export_all(station: Station, plans: Sequence[ExportPlan], outputs: Sequence[Path]) -> list[ExportResult]:
    """Seal each plan into its file. Of several, all keys of a move rest before the first file exists.

    Raises what :func:`export_bundle` raises; the same command carries on.
    """
    now = datetime.now(UTC)
    for plan, output in zip(plans, outputs, strict=True):
        if _already(plan, output, now) is None:
            require_new(output)
    ready = list(plans)
    if len(plans) > 1:
        run = plans[0].earlier and BundleNotes.from_json(plans[0].earlier.nodes).run
        with station.transaction():
            ready = [plan if plan.earlier else _announced(station, plan, run or plans[0].id) for plan in plans]
    return [export_bundle(station, plan, output) for plan, output in zip(ready, outputs, strict=True)]


def _announced(station: Station, plan: ExportPlan, run: str) -> ExportPlan:
    """Record a bundle of several that is not sealed yet."""
    named = replace(plan, run=run)
    return replace(named, earlier=_record(station, named, (), None))


def outputs_of(output: Path, count: int) -> list[Path]:
    """Return ``FILE``, ``FILE.2``, ``FILE.3`` and so on."""
    return [output, *(output.with_name(f"{output.name}.{number}") for number in range(2, count + 1))]


def _receivers(station: Station, order: ExportOrder) -> list[TrustRecord]:
    if not order.to:
        raise UsageError("No receiver was given.", hint="Add --to STATION; see: trust list")
    return [find_trusted(station, text, "station") for text in order.to]


def _one_ca(station: Station, order: ExportOrder, nodes: Chosen) -> bytes:
    """Return the CA that the nodes keep: one bundle has one."""
    own, kept = station.ca, set[bytes]()
    for chunk in chunks(nodes):
        others = station.keys.cas_among([node.uuid for node in chunk])
        kept |= {own, *others.values()} if len(others) < len(chunk) else set(others.values())
    found = {fingerprint(ca): ca for ca in kept}
    if order.ca is not None:
        found = {digits: ca for digits, ca in found.items() if digits.startswith(order.ca.lower())}
        if not found:
            raise NotFoundError(f"None of these nodes holds the CA key {order.ca}.")
    if len(found) > 1:
        raise PolicyError(
            f"These nodes hold {len(found)} different CA keys; a bundle covers one.",
            hint=f"Export them separately: --ca {' / --ca '.join(sorted(digits[:16] for digits in found))}",
        )
    return next(iter(found.values()))


def _with_ca(station: Station, nodes: Chosen) -> Iterator[tuple[LeavingNode, bytes]]:
    """Return each node with the CA that it keeps."""
    own = station.ca
    for chunk in chunks(nodes):
        kept = station.keys.cas_among([node.uuid for node in chunk])
        yield from ((node, kept.get(node.uuid, own)) for node in chunk)


def _signature(station: Station, ca: bytes, receiver: TrustRecord) -> bytes:
    """Return SIG104 over the receiver: known, in the plant's roster, or made now if the CA key is here."""
    known = station.identity.certificate(ca, receiver.point)
    if known is None and ca == station.ca and (roster := station.plant.roster) is not None:
        member = roster.member(receiver.fingerprint)
        known = member.certificate if member is not None else None
    if known is None and ca == station.ca:
        try:
            known = station.identity.certify(receiver.point)
        except NotFoundError:
            known = None
    if known is None:
        raise PolicyError(
            f"Station {receiver.name!r} is not certified by the CA {fingerprint(ca)[:16]}, whose key is not here:"
            " it could read these nodes but neither write nor rotate them.",
            hint="Where the CA key is kept: trust ca sign REQUEST --output CERT; here: trust add NAME CERT",
        )
    return known


def _other_holders(station: Station, nodes: Chosen, receivers: tuple[TrustRecord, ...]) -> tuple[str, ...]:
    """Return the stations, other than the receivers, that hold any of these keys since an earlier copy."""
    to = {record.fingerprint for record in receivers}
    # quick check first: there may be 100,000 rows of holders and only a few stations
    if station.keys.all_holders() <= to:
        return ()
    chosen = {node.uuid for node in nodes}
    found = {holder.fingerprint for holder in station.keys.holders() if holder.uuid in chosen}
    return tuple(sorted(found - to))


def _is_same(row: Handover, content: str, now: datetime) -> bool:
    """Return True if an open bundle of this content is carried on; a copy only until it expires."""
    notes = BundleNotes.from_json(row.nodes)
    return notes.content == content and (row.mode == "move" or datetime.fromisoformat(notes.expires) > now)


def _already(plan: ExportPlan, output: Path, now: datetime) -> str | None:
    """Return the digest of the file if this very handover wrote it before.

    Raises UsageError if no receiver would take that file: it has expired, or a clock that was ahead dated it.
    """
    if plan.earlier is None or not output.is_file():
        return None
    with output.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    notes = BundleNotes.from_json(plan.earlier.nodes)
    if digest not in notes.files:
        return None
    why = "was sealed again since, because it was out of date" if digest in notes.stale else notes.why_stale(now)
    if why:
        raise UsageError(
            f"The bundle in {output} {why}.",
            hint="Delete the file, or choose another name, and run this again: the bundle is then sealed again.",
        )
    return digest


def _sealing(station: Station, plan: ExportPlan, now: datetime) -> EnvelopeWriter:
    own = station.identity.certificate(plan.ca, station.point)
    bundle = Bundle(
        id=plan.id,
        sender=station.fingerprint,
        to=tuple(record.fingerprint for record in plan.receivers),
        created=now.replace(microsecond=0),
        expires=plan.expires,
        mode=plan.mode,
        ca=plan.ca,
        nodes=(),
        # The sender's own certificate is included, so that the receiver can hand the nodes back later.
        station_signatures={**plan.signatures, **({station.fingerprint: own} if own else {})},
        revoked=tuple(revocation.statement for revocation in station.policy.revocations()),
    )
    to = [record.point for record in plan.receivers]
    return seal_pieces(bundle, _bundled(station, plan.nodes), len(plan.nodes), station.vault.identity(), to)


def _bundled(station: Station, nodes: Iterable[LeavingNode]) -> Iterator[BundledNode]:
    """Read the nodes and unwrap their keys, a chunk at a time."""
    for chunk in chunks(nodes):
        uuids_of_chunk = [node.uuid for node in chunk]
        records = station.nodes.exported_many(uuids_of_chunk)
        keys = station.keys.unwrap_named({node.uuid: node.key_id for node in chunk})
        for uuid in uuids_of_chunk:
            record, key = records.get(uuid), keys.get(uuid)
            if record is None or record.point is None or key is None:
                raise PolicyError(f"Node {uuid.hex()} was changed in the meantime.", hint="Run it again.")
            epoch, octets = key
            yield BundledNode(
                uuid,
                record.point,
                octets,
                epoch,
                record.sequence,
                record.profile,
                record.name,
                record.groups,
                record.teds_sha256,
            )


def _record(station: Station, plan: ExportPlan, digests: tuple[str, ...], created: datetime | None) -> Handover:
    """Write what must be durable before the file: the holders, the bundle's row, and for a move the tombstones.

    ``digests`` are those of the file and of what was signed in it, ``created`` is its date; empty and None if a bundle
    of several is announced.
    """
    files, stale = _files_before(plan), _stale_before(plan, created)
    uuids_hex = tuple(node.uuid.hex() for node in plan.nodes)
    keys = tuple(node.key_id for node in plan.nodes)
    notes = BundleNotes(
        uuids_hex,
        plan.content,
        plan.ca.hex(),
        time_text(plan.expires),
        (*files, *digests),
        (),
        keys,
        plan.run,
        time_text(created) if created is not None else "",
        stale,
    )
    peers = tuple(record.fingerprint for record in plan.receivers)
    row = plan.earlier or Handover(plan.id, "out", plan.mode, peers, OPEN, "")
    row = replace(row, nodes=notes.to_json(), bundle_sha256=digests[0] if digests else row.bundle_sha256)
    station.handovers.put(row)
    for record in plan.receivers:
        station.identity.keep_certificate(plan.ca, record.point, plan.signatures[record.fingerprint])
    _record_holders(station, plan, peers)
    if plan.earlier is None and station.plant.joined is not None:
        for node in plan.nodes:
            for peer in peers:
                facts = {"epoch": node.epoch, "key_id": node.key_id, "peer": peer, "mode": plan.mode, "bundle": plan.id}
                station.plant.record_event("gave", node.uuid, **facts)
    if digests:
        detail = {"handover": plan.id, "mode": plan.mode, "to": list(peers), "nodes": list(uuids_hex)}
        station.audit("export", None, "again" if files else "done", file=digests[0], **detail)
    return row


def _files_before(plan: ExportPlan) -> tuple[str, ...]:
    """Return the digests of the files that earlier runs of this handover wrote."""
    return BundleNotes.from_json(plan.earlier.nodes).files if plan.earlier else ()


def _stale_before(plan: ExportPlan, now: datetime | None) -> tuple[str, ...]:
    """Return the digests of those that no receiver takes at ``now``, when the bundle is sealed again."""
    notes = BundleNotes.from_json(plan.earlier.nodes) if plan.earlier else None
    if notes is None:
        return ()
    return notes.files if now is not None and notes.why_stale(now) else notes.stale


def _record_holders(station: Station, plan: ExportPlan, peers: tuple[str, ...]) -> None:
    """Record the new holders of the keys: after a copy, each receiver too; after a move, only the receiver."""
    now, uuids_of_nodes = utc_now(), [node.uuid for node in plan.nodes]
    if plan.mode == "copy":
        station.bulk.put(BulkRows(holders=[Holder(uuid, peer, now) for uuid in uuids_of_nodes for peer in peers]))
    elif plan.earlier is None:
        tombstones = [Tombstone(uuid, peers[0], plan.id, now) for uuid in uuids_of_nodes]
        station.bulk.put(BulkRows(tombstones=tombstones))
