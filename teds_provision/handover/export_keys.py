"""``export-keys``: node keys into a sealed bundle for other stations (profile.md, "Handover between base stations").

What a killed run leaves behind: a move's tombstones and its row are durable before any file exists, so the key rests
whatever happens; the same command then seals the same move again, under the same id.
"""

from __future__ import annotations

import hashlib
import uuid as uuids
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from operator import attrgetter
from pathlib import Path

from teds_provision.errors import NotFound, PolicyRefused, UsageFailure
from teds_provision.files import new_file, require_new
from teds_provision.handover import collector
from teds_provision.handover.pending import OPEN, Notes, content_digest
from teds_provision.handover.selection import Chosen, ExportOrder, Leaving, Selection
from teds_provision.handover.trust import find_trusted
from teds_provision.protocol.handover.bundle import sealing
from teds_provision.protocol.handover.contents import Bundle, BundledNode, Mode
from teds_provision.protocol.handover.payload import time_text
from teds_provision.protocol.handover.sealing import Sealing
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import Batch, Handover, Holder, Tombstone, TrustRecord, pages, utc_now

NODES_IN_A_BUNDLE = 50_000
"""Well below what a bundle can hold (64 MiB), so that a few long names do not burst one."""


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
    nodes: tuple[Leaving, ...]
    skipped: tuple[tuple[bytes, str], ...]
    content: str
    expires: datetime
    earlier: Handover | None
    also_held_by: tuple[str, ...] = ()
    run: str = ""
    """Id of the first bundle where one command made several."""


@dataclass(frozen=True)
class Exported:
    """A bundle that lies in a file; ``fresh`` False where it lay there already."""

    plan: ExportPlan
    sha256: str
    octets: int
    fresh: bool


def plan_export(station: Station, order: ExportOrder) -> ExportPlan:
    """:func:`plan_exports` for what fits into one bundle; raises UsageFailure for more."""
    plans = plan_exports(station, order)
    if len(plans) > 1:
        raise UsageFailure("These are too many nodes for one bundle.", hint="Export them in several.")
    return plans[0]


@collector.put_off()
def plan_exports(station: Station, order: ExportOrder, *, most: int = NODES_IN_A_BUNDLE) -> list[ExportPlan]:
    """Find the receivers and nodes, and the CA's signature over each receiver; changes nothing.

    Returns a plan for each bundle, of at most ``most`` nodes. Raises NotFound, UsageFailure (two receivers of a move),
    PolicyRefused (a node without proven key, given away, revoked, due for rotation or, for a move, with an agreement
    that is not settled; nodes of several CAs; a receiver that is not certified), BadData (a receiver's file).
    """
    receivers = tuple({record.point: record for record in _receivers(station, order)}.values())
    _check(order, receivers)
    selection = Selection(station, order, {record.fingerprint for record in receivers})
    nodes, skipped = selection.choose()
    ca = _one_ca(station, order, nodes)
    if order.ca is not None:
        nodes = [node for node, kept in _with_ca(station, nodes) if kept == ca]
    signatures = {record.fingerprint: _signature(station, ca, record) for record in receivers}
    common = _Common(order, receivers, ca, signatures, datetime.now(UTC), station.fingerprint, selection.rows)
    plans = [common.plan(part, _other_holders(station, part, receivers)) for part in selection.parts(nodes, most)]
    return [replace(plans[0], skipped=tuple(skipped)), *plans[1:]]


def _check(order: ExportOrder, receivers: Sequence[TrustRecord]) -> None:
    if order.mode == "move" and len(receivers) != 1:
        raise UsageFailure("A move has exactly one receiver.", hint="Use --mode copy for several.")
    if order.days < 1:
        raise UsageFailure("A bundle is valid for at least one day.")


@dataclass(frozen=True)
class _Common:
    """What the bundles of one command share."""

    order: ExportOrder
    receivers: tuple[TrustRecord, ...]
    ca: bytes
    signatures: Mapping[str, bytes]
    now: datetime
    sender: str
    rows: Sequence[Handover]

    def plan(self, nodes: Chosen, also_held_by: tuple[str, ...]) -> ExportPlan:
        """The plan of one bundle; an open one of the same content is carried on."""
        mode, to = self.order.mode, [record.fingerprint for record in self.receivers]
        listed = ((node.uuid, node.key_id, node.epoch) for node in sorted(nodes, key=attrgetter("uuid")))
        content = content_digest(self.sender, to, mode, self.ca, listed)
        earlier = next((row for row in self.rows if _is_same(row, content, self.now)), None)
        expires = datetime.fromisoformat(Notes.from_json(earlier.nodes).expires) if earlier else None
        if expires is None or expires <= self.now:
            expires = self.now.replace(microsecond=0) + timedelta(days=self.order.days)
        return ExportPlan(
            earlier.id if earlier else str(uuids.uuid4()),
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
            Notes.from_json(earlier.nodes).run if earlier else "",
        )


@collector.put_off()
def export_keys(station: Station, plan: ExportPlan, output: Path, now: datetime | None = None) -> Exported:
    """Seal the bundle into a new file of mode 0600; a move's keys rest from before anybody could open that file.

    What is written before the store has it is a draft without signature and tag, under a name of its own.
    The same command over its own file finds nothing to do. Raises UsageFailure (another file lies there),
    StoreFailure, VaultFailure.
    """
    before = _already(plan, output)
    if before is not None:
        return Exported(plan, before, output.stat().st_size, fresh=False)
    require_new(output)
    made = _sealing(station, plan, now or datetime.now(UTC))
    with new_file(output) as file:
        for piece in made.body():
            file.write(piece)
        end = made.end()
        with station.transaction():
            _record(station, plan, (made.sha256, made.signed_sha256))
        file.write(end)
    return Exported(plan, made.sha256, made.octets, fresh=True)


def export_all(station: Station, plans: Sequence[ExportPlan], outputs: Sequence[Path]) -> list[Exported]:
    """Seal each plan into its file. Of several, all keys of a move rest before the first file exists.

    Raises what :func:`export_keys` raises; the same command carries on.
    """
    for plan, output in zip(plans, outputs, strict=True):
        if _already(plan, output) is None:
            require_new(output)
    ready = list(plans)
    if len(plans) > 1:
        run = plans[0].earlier and Notes.from_json(plans[0].earlier.nodes).run
        with station.transaction():
            ready = [plan if plan.earlier else _announced(station, plan, run or plans[0].id) for plan in plans]
    return [export_keys(station, plan, output) for plan, output in zip(ready, outputs, strict=True)]


def _announced(station: Station, plan: ExportPlan, run: str) -> ExportPlan:
    """Record a bundle of several that is not sealed yet."""
    named = replace(plan, run=run)
    return replace(named, earlier=_record(station, named, ()))


def outputs_of(output: Path, count: int) -> list[Path]:
    """Return ``FILE``, ``FILE.2``, ``FILE.3`` and so on."""
    return [output, *(output.with_name(f"{output.name}.{number}") for number in range(2, count + 1))]


def _receivers(station: Station, order: ExportOrder) -> list[TrustRecord]:
    if not order.to:
        raise UsageFailure("Nobody is named to hand the keys to.", hint="Add --to STATION; see: trust list")
    return [find_trusted(station, text, "station") for text in order.to]


def _one_ca(station: Station, order: ExportOrder, nodes: Chosen) -> bytes:
    """The CA that the nodes keep: one bundle has one."""
    found = {fingerprint(ca): ca for ca in {ca for _, ca in _with_ca(station, nodes)}}
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


def _with_ca(station: Station, nodes: Chosen) -> Iterator[tuple[Leaving, bytes]]:
    """Each node with the CA that it keeps."""
    own = station.ca
    for page in pages(nodes):
        kept = station.keys.cas_of_page([node.uuid for node in page])
        yield from ((node, kept.get(node.uuid, own)) for node in page)


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


def _other_holders(station: Station, nodes: Chosen, receivers: tuple[TrustRecord, ...]) -> tuple[str, ...]:
    """Stations besides the receivers that hold any of these keys since an earlier copy."""
    chosen = {node.uuid for node in nodes}
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
    return digest if digest in _files_before(plan) else None


def _sealing(station: Station, plan: ExportPlan, now: datetime) -> Sealing:
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
        # The sender's own goes along, so that the receiver can hand the nodes back one day.
        station_signatures={**plan.signatures, **({station.fingerprint: own} if own else {})},
        revoked=tuple(revocation.statement for revocation in station.policy.revocations()),
    )
    to = [record.point for record in plan.receivers]
    return sealing(bundle, _bundled(station, plan.nodes), len(plan.nodes), station.vault.identity(), to)


def _bundled(station: Station, nodes: Iterable[Leaving]) -> Iterator[BundledNode]:
    """Read the nodes and unwrap their keys, a page at a time."""
    for page in pages(nodes):
        uuids_of_page = [node.uuid for node in page]
        records = station.nodes.handed_of_page(uuids_of_page)
        keys = {(key.uuid, key.key_id): key for key in station.keys.of_page(uuids_of_page)}
        for leaving in page:
            record, key = records.get(leaving.uuid), keys.get((leaving.uuid, leaving.key_id))
            if record is None or record.point is None or key is None:
                raise PolicyRefused(f"Node {leaving.uuid.hex()} was changed meanwhile.", hint="Run it again.")
            yield BundledNode(
                uuid=record.uuid,
                node_key=record.point,
                key=station.keys.unwrap(key),
                epoch=key.epoch,
                sequence=record.sequence,
                profile=record.profile,
                name=record.name,
                groups=record.groups,
                teds_sha256=record.teds_sha256,
            )


def _record(station: Station, plan: ExportPlan, digests: tuple[str, ...]) -> Handover:
    """What must be durable before the file: who holds what, the bundle's row, and for a move the tombstones.

    ``digests`` are those of the file and of what was signed in it; none where a bundle of several is announced.
    """
    files = _files_before(plan)
    uuids_hex = tuple(node.uuid.hex() for node in plan.nodes)
    keys = tuple(node.key_id for node in plan.nodes)
    notes = Notes(
        uuids_hex, plan.content, plan.ca.hex(), time_text(plan.expires), (*files, *digests), (), keys, plan.run
    )
    peers = tuple(record.fingerprint for record in plan.receivers)
    row = plan.earlier or Handover(plan.id, "out", plan.mode, peers, OPEN, "")
    row = replace(row, nodes=notes.to_json(), bundle_sha256=digests[0] if digests else row.bundle_sha256)
    station.handovers.put(row)
    for record in plan.receivers:
        station.identity.keep_certificate(plan.ca, record.point, plan.signatures[record.fingerprint])
    _record_holders(station, plan, peers)
    if digests:
        detail = {"handover": plan.id, "mode": plan.mode, "to": list(peers), "nodes": list(uuids_hex)}
        station.audit("export", None, "again" if files else "done", file=digests[0], **detail)
    return row


def _files_before(plan: ExportPlan) -> tuple[str, ...]:
    """Digests of the files that this very handover gave in earlier runs."""
    return Notes.from_json(plan.earlier.nodes).files if plan.earlier else ()


def _record_holders(station: Station, plan: ExportPlan, peers: tuple[str, ...]) -> None:
    """Who holds the keys from now on: each receiver of a copy beside us; of a move, that is, the receiver alone."""
    now, uuids_of_nodes = utc_now(), [node.uuid for node in plan.nodes]
    if plan.mode == "copy":
        station.handovers.take_in(Batch(holders=[Holder(uuid, peer, now) for uuid in uuids_of_nodes for peer in peers]))
    elif plan.earlier is None:
        tombstones = [Tombstone(uuid, peers[0], plan.id, now) for uuid in uuids_of_nodes]
        station.handovers.take_in(Batch(tombstones=tombstones))
