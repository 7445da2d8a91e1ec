"""``import-keys``: take node keys over from a trusted station (profile.md, "Handover between base stations").

Everything is checked before anything is kept, and one transaction keeps all of it: keys as pending, whitelist, nodes,
the CA's signature over this station, the deny list and the receipt. The same bundle again gives the same receipt.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import Any, Literal

from teds_provision.errors import LinkError, NoNodeError, PolicyError, TedsProvisionError
from teds_provision.handover import gc_pause
from teds_provision.handover.deny import deny_all, why_not
from teds_provision.handover.pending import IMPORTED, BundleNotes, digest_of
from teds_provision.links import LinkSettings, open_port
from teds_provision.protocol.fingerprints import is_whole, same_key
from teds_provision.protocol.handover.bundle import Bundle, BundledNode, OpenedBundle, check_times, open_bundle
from teds_provision.protocol.handover.envelope import Source
from teds_provision.protocol.handover.receipt import Receipt, RefusedNode, seal_receipt
from teds_provision.protocol.handover.revocation import Revocation as Statement
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.progress import Reporter
from teds_provision.station.bulk import BulkRows
from teds_provision.station.groups import valid_name
from teds_provision.station.node_keys import MAX_PENDING
from teds_provision.station.station import Station
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import (
    Handover,
    Holder,
    KeyRecord,
    NewNode,
    NewPin,
    NodeRecord,
    WhitelistEntry,
    utc_now,
)

# The nodes in a bundle: what is done with each, and the rows of those that are accepted.

Decision = Literal["new", "newer", "same", "refused"]


@dataclass(frozen=True, slots=True)
class PlannedNode:
    """Outcome of one node of the bundle, with the reason if it is refused.

    ``name`` is its name here, ``notes`` are hints for the operator about an accepted node.
    """

    node: BundledNode
    decision: Decision
    why: str = ""
    name: str | None = None
    notes: tuple[str, ...] = ()


class ImportedRows:
    """The rows of the nodes that are taken in, made and written a chunk at a time; the caller holds the transaction."""

    def __init__(self, station: Station, bundle: Bundle) -> None:
        self.station, self.bundle = station, bundle
        self.resting = {tombstone.uuid for tombstone in station.policy.tombstones()}
        self.others = sorted({bundle.sender, *bundle.to} - {station.fingerprint})
        self.now = utc_now()
        self._turn_to([])

    def take_in(self, nodes: Iterable[PlannedNode]) -> None:
        """Write all of them."""
        self.station.keys.refresh()
        for taken in chunks(nodes):
            self._turn_to([planned.node.uuid for planned in taken])
            back = [planned.node.uuid for planned in taken if planned.node.uuid in self.resting]
            self.station.policy.take_back(back)
            for uuid in back:
                self.station.audit("handover", uuid, "came back", handover=self.bundle.id)
            self.station.bulk.put(self._rows(taken))

    def _rows(self, taken: Sequence[PlannedNode]) -> BulkRows:
        known_nodes = [(planned, self.known[planned.node.uuid]) for planned in taken if planned.node.uuid in self.known]
        loose = {uuid for uuid, pin in self.pins.items() if not is_whole(pin.fingerprint)}
        return BulkRows(
            nodes=[self._node(planned, known) for planned, known in known_nodes],
            new_nodes=[self._new_node(planned) for planned in taken if planned.node.uuid not in self.known],
            whitelist=[self._whole_pin(planned) for planned in taken if planned.node.uuid in loose],
            new_pins=[self._new_pin(planned) for planned in taken if planned.node.uuid not in self.pins],
            keys=[self._key(planned.node) for planned in taken if planned.decision != "same"],
            holders=[
                Holder(planned.node.uuid, other, self.now, self.bundle.mode)
                for planned in taken
                for other in self.others
            ],
            groups=self._groups(taken),
            key_flags=self._marks(taken),
        )

    @staticmethod
    def _groups(taken: Sequence[PlannedNode]) -> dict[str, list[bytes]]:
        """Return the measurement groups that the bundle puts these nodes in."""
        groups: dict[str, list[bytes]] = {}
        for planned in taken:
            for label in planned.node.groups:
                groups.setdefault(valid_name(label), []).append(planned.node.uuid)
        return groups

    def _turn_to(self, uuids: Sequence[bytes]) -> None:
        """Read what is known here of a chunk of nodes."""
        station = self.station
        self.known = station.nodes.get_many(uuids)
        self.pins = station.pins.get_many(uuids)
        self.slots = station.keys.slots_of(uuids)
        self.cas = station.keys.cas_among(uuids)

    def _key(self, node: BundledNode) -> KeyRecord:
        return self.station.keys.wrapped(
            node.uuid,
            key=node.key,
            key_id=bytes.fromhex(node.kid),
            epoch=node.epoch,
            slot=self.slots.get(node.uuid, 0) + 1,
            source="import",
            created=self.now,
        )

    def _new_pin(self, planned: PlannedNode) -> NewPin:
        """Return the whitelist entry of a node that has none, pinned to its key."""
        node = planned.node
        return NewPin(node.uuid, fingerprint(node.node_key), self.now, "import", planned.name)

    def _whole_pin(self, planned: PlannedNode) -> WhitelistEntry:
        """Return the entry of a node that was listed without its whole fingerprint, pinned to its key."""
        node = planned.node
        return replace(self.pins[node.uuid], fingerprint=fingerprint(node.node_key), assurance="import")

    @staticmethod
    def _state(node: BundledNode) -> NodeState:
        return NodeState.PROVISIONED if node.teds_sha256 else NodeState.KEYED

    def _new_node(self, planned: PlannedNode) -> NewNode:
        """Return a node's first record, without epoch and sequence, which only a session can report."""
        node = planned.node
        return NewNode(node.uuid, node.node_key, planned.name, node.profile, int(self._state(node)), node.teds_sha256)

    def _node(self, planned: PlannedNode, known: NodeRecord) -> NodeRecord:
        """Return the record of a node that is known here with what the bundle adds; epoch and sequence stay."""
        node = planned.node
        return replace(
            known,
            point=node.node_key,
            name=known.name or planned.name,
            profile=known.profile or node.profile,
            state=known.state or int(self._state(node)),
            teds_sha256=known.teds_sha256 or node.teds_sha256,
        )

    def _marks(self, taken: Iterable[PlannedNode]) -> dict[bytes, dict[str, Any]]:
        """Return key flags by UUID: rotations due after a move, and the CA that a node keeps, or will once proven."""
        ca, own = self.bundle.ca, self.station.ca
        marks: dict[bytes, dict[str, Any]] = {}
        kept_ca: dict[str, Any] = {"ca": ca}
        for planned in taken:
            uuid = planned.node.uuid
            if uuid in self.resting:
                marks[uuid] = {"rotation": f"it was returned by {self.bundle.id}: others have held this key"}
            if self.bundle.mode == "move":
                marks[uuid] = {"rotation": f"moved here by {self.bundle.id}: the sender has held this key"}
            if planned.decision == "same" or self.cas.get(uuid, own) == ca:
                continue
            if planned.decision == "newer":  # keep the present key and its CA until a session proves the new one
                kept: dict[str, Any] = {"next_key_id": planned.node.kid, "next_ca": ca}
            else:
                kept = kept_ca
            marks[uuid] = marks[uuid] | kept if uuid in marks else kept
        return marks


_LIKE_UUID = re.compile("(0x)?[0-9a-f]{4,}", re.IGNORECASE)


@dataclass(frozen=True)
class ImportPlan:
    """Preview of an import; ``ca_is_known`` False: that CA would be trusted for these nodes from now on."""

    opened: OpenedBundle
    content: str
    nodes: tuple[PlannedNode, ...]
    denied: tuple[Statement, ...]
    ca_is_known: bool
    passed_over: tuple[tuple[Statement, str], ...] = ()
    """Revocations that ban nothing here, and why."""

    @property
    def taken(self) -> tuple[PlannedNode, ...]:
        """The nodes that are not refused."""
        return tuple(node for node in self.nodes if node.decision != "refused")


@dataclass(frozen=True)
class ImportResult:
    """A bundle that was taken in, now or before (``fresh`` False), with its receipt as the octets of a file."""

    row: Handover
    notes: BundleNotes
    receipt: bytes
    fresh: bool

    @property
    def refused_uuids(self) -> set[str]:
        """The nodes that were not taken in, in hex."""
        return {uuid for uuid, _ in self.notes.refused}

    @property
    def uuids(self) -> tuple[bytes, ...]:
        """The nodes that were taken in."""
        refused = self.refused_uuids
        return tuple(bytes.fromhex(uuid) for uuid in self.notes.uuids if uuid not in refused)


class NothingImportedError(PolicyError):
    """Every node of a bundle is refused; ``nodes`` have the reasons."""

    def __init__(self, bundle: Bundle, nodes: tuple[PlannedNode, ...]) -> None:
        super().__init__(
            f"None of the nodes in the bundle can be imported; {nodes[0].node.uuid.hex()}: {nodes[0].why}.",
            hint="Nothing was imported. Notify the sender.",
        )
        self.bundle, self.nodes = bundle, nodes


@gc_pause.pause_gc()
def plan_import(station: Station, source: Source, now: datetime | None = None) -> ImportPlan | ImportResult:
    """Open and check a bundle (octets, or a file) and return the outcome for each node; changes nothing.

    A bundle that was imported before returns its result, even if it has expired since. Its sequences and epochs are
    unverified: only the epoch of a pending key is kept, which the first session corrects. A node that was moved away
    comes back only from the station that it went to. Raises what :func:`open_bundle` raises, and PolicyError: an id
    seen with other content, no signature of the bundle's CA over this station, or every node refused
    (NothingImportedError).
    """
    opened = open_bundle(source, station.vault.identity(), station.policy.station_points().get, None)
    bundle, content = opened.bundle, digest_of(opened.bundle)
    row = station.handovers.get(bundle.id, "in")
    if row is not None:
        return _before(row, content)
    check_times(bundle, now or datetime.now(UTC))
    _check_certified(station, opened)
    denied, passed_over = _new_revocations(station, opened)
    nodes = tuple(_Judge(station, denied, bundle).judge_nodes(bundle.nodes))
    if nodes and all(node.decision == "refused" for node in nodes):
        raise NothingImportedError(bundle, nodes)
    return ImportPlan(opened, content, nodes, denied, _is_known_ca(station, bundle.ca), passed_over)


_PassedOver = tuple[tuple[Statement, str], ...]


def _new_revocations(station: Station, opened: OpenedBundle) -> tuple[tuple[Statement, ...], _PassedOver]:
    """Return the revocations of the bundle that are new here: those that count, and the others with the reason."""
    news = [revocation for revocation in opened.revocations if station.policy.revocation(revocation.uuid) is None]
    judged = [(revocation, why_not(station, revocation, opened.bundle)) for revocation in news]
    denied = tuple(revocation for revocation, why in judged if not why)
    return denied, tuple((revocation, why) for revocation, why in judged if why)


def _is_known_ca(station: Station, ca: bytes) -> bool:
    """Return True if the CA is known without this bundle.

    It certified this station before, or an operator trusts it.
    """
    certified = station.identity.certificate(ca, station.point) is not None
    return station.policy.counts(ca) and (certified or ca in station.policy.trusted_cas())


@gc_pause.pause_gc()
def import_bundle(station: Station, plan: ImportPlan, now: datetime | None = None) -> ImportResult:
    """Take the bundle in, all of it in one transaction, and sign its receipt."""
    bundle = plan.opened.bundle
    receipt = Receipt(
        id=bundle.id,
        bundle_sha256=plan.opened.signed_sha256,
        sender=station.fingerprint,
        to=bundle.sender,
        imported=tuple(node.node.uuid for node in plan.taken),
        refused=tuple(RefusedNode(n.node.uuid, n.why) for n in plan.nodes if n.decision == "refused"),
        created=(now or datetime.now(UTC)).replace(microsecond=0),
    )
    text = seal_receipt(receipt, station.vault.identity())
    notes = BundleNotes(
        tuple(node.uuid.hex() for node in bundle.nodes),
        plan.content,
        bundle.ca.hex(),
        time_text(bundle.expires),
        (plan.opened.signed_sha256, plan.opened.sha256),
        tuple((refused.uuid.hex(), refused.why) for refused in receipt.refused),
    )
    row = Handover(
        bundle.id,
        "in",
        bundle.mode,
        (bundle.sender,),
        IMPORTED,
        notes.to_json(),
        plan.opened.signed_sha256,
        text.decode("ascii"),
    )
    with station.transaction():
        _keep_ca(station, plan)
        deny_all(station, plan.denied, bundle)
        ImportedRows(station, plan.opened.bundle).take_in(plan.taken)
        station.handovers.put(row)
        for planned in plan.nodes if station.plant.joined is not None else ():
            node, facts = planned.node, {"peer": bundle.sender, "bundle": bundle.id}
            if planned.decision == "refused":
                station.plant.record_event("refused", node.uuid, why=planned.why, **facts)
            elif planned.decision != "same":
                station.plant.record_event(
                    "took", node.uuid, epoch=node.epoch, key_id=node.kid, mode=bundle.mode, **facts
                )
        refused = {refused.uuid.hex() for refused in receipt.refused}
        taken = [uuid for uuid in notes.uuids if uuid not in refused]
        detail = {"handover": bundle.id, "mode": bundle.mode, "from": bundle.sender, "nodes": taken}
        station.audit("import", None, "done", refused=len(receipt.refused), **detail)
    return ImportResult(row, notes, text, fresh=True)


def _before(row: Handover, content: str) -> ImportResult:
    """Return the result of a bundle id that came before; PolicyError if its content differs."""
    notes = BundleNotes.from_json(row.nodes)
    if notes.content != content:
        raise PolicyError(
            f"The bundle {row.id} was already imported with different content: it is a replay or a forgery.",
            hint="Ask its sender by voice what was sent.",
        )
    assert row.receipt is not None
    return ImportResult(row, notes, row.receipt.encode("ascii"), fresh=False)


def _check_certified(station: Station, opened: OpenedBundle) -> None:
    """Check that the receiver is able to write and rotate: it needs the CA's signature over its key."""
    ca = opened.bundle.ca
    if opened.station_signature is None and station.identity.certificate(ca, station.point) is None:
        raise PolicyError(
            f"The bundle has no signature by CA {fingerprint(ca)[:16]} over this station's key.",
            hint="Ask the sender to export it again on the station with that CA key.",
        )


class _Judge:
    """Holds a bundle's nodes against the store, whose tables are read a chunk at a time."""

    def __init__(self, station: Station, denied: Iterable[Statement], bundle: Bundle) -> None:
        policy = station.policy
        self.station = station
        self.sender, self.mode = bundle.sender, bundle.mode
        self.denied = {entry.uuid: (entry.fingerprint, entry.why) for entry in policy.revocations()}
        self.denied |= {revocation.uuid: (revocation.fingerprint, revocation.why) for revocation in denied}
        self.tombstones = {tombstone.uuid: tombstone for tombstone in policy.tombstones()}
        self.given: dict[str, bytes] = {}
        """Names that nodes of this bundle get."""
        self._turn_to([])

    def judge_nodes(self, nodes: Iterable[BundledNode]) -> Iterator[PlannedNode]:
        """Decide for each node of the bundle whether its key is taken, and why not."""
        for chunk in chunks(nodes):
            self._turn_to(chunk)
            for node in chunk:
                why = self._obstacle(node) or self._stale_key(node)
                yield PlannedNode(node, "refused", why) if why else self._taken(node)

    def _turn_to(self, chunk: Sequence[BundledNode]) -> None:
        """Read the rows of a chunk of nodes, and the nodes that already have their names."""
        station, uuids = self.station, [node.uuid for node in chunk]
        self.nodes = station.nodes.get_many(uuids)
        self.pins = station.pins.pinned_among(self.nodes.values(), station.pins.get_many(uuids).values())
        self.bearers = station.nodes.bearers_of([node.name for node in chunk if node.name])
        self.held: dict[bytes, dict[str, tuple[str, int]]] = {}
        for key in station.keys.get_many(uuids):
            self.held.setdefault(key.uuid, {})[key.key_id] = (key.state, key.epoch)

    def _obstacle(self, node: BundledNode) -> str:
        """Return why the node itself is not imported, "" if it is."""
        pin = self.pins.get(node.uuid)
        key, why = self.denied.get(node.uuid, (None, ""))
        if why and (key is None or same_key(key, fingerprint(node.node_key))):
            return f"it is revoked: {why}"
        tombstone = self.tombstones.get(node.uuid)
        if tombstone is not None and (self.sender != tombstone.to_fingerprint or self.mode != "move"):
            return f"it was moved to station {tombstone.to_fingerprint[:32]}, and only that station can move it back"
        if pin is not None and not same_key(pin, fingerprint(node.node_key)):
            return "this UUID is known here with another node key"
        return ""

    def _stale_key(self, node: BundledNode) -> str:
        """Return why its key is not added to those that are held, "" if it is."""
        held, known = self.held.get(node.uuid), self.nodes.get(node.uuid)
        if held is None:
            if known is None or node.epoch >= known.epoch:
                return ""
            held = {}
        if node.kid in held:
            return ""
        if sum(state == "pending" for state, _ in held.values()) >= MAX_PENDING:
            return f"{MAX_PENDING} of its keys are already waiting for proof here"
        active = max((epoch for state, epoch in held.values() if state == "active"), default=0)
        proven = max(known.epoch if known is not None else 0, active)
        pending = max((epoch for state, epoch in held.values() if state == "pending"), default=0)
        if node.epoch < proven:
            return f"its key epoch {node.epoch} is older than {proven}, which is known here"
        if node.epoch < pending:
            of = f"{pending}, that of a key which no session has proven here yet"
            return f"its key epoch {node.epoch} is older than {of}: verify the node, or agree a new key with it"
        if node.epoch == active:
            return f"another key of epoch {node.epoch} is in use here"
        return ""

    def _taken(self, node: BundledNode) -> PlannedNode:
        notes = []
        if node.uuid in self.tombstones:
            notes.append("it is returning: its key is rotated at the first contact")
        known = self.nodes.get(node.uuid)
        name = known.name if known is not None and known.name else node.name
        if name is not None and name == node.name:
            name = self._free_name(node.uuid, name)
            if name != node.name:
                notes.append(f"it is called {name} here: {node.name} is the name of another node, or like a UUID")
            self.given[name] = node.uuid
        return PlannedNode(node, self._decision(node), name=name, notes=tuple(notes))

    def _free_name(self, uuid: bytes, name: str) -> str:
        """Return a name that no other node has and that cannot be mistaken for the first digits of a UUID."""
        tried, digits = name, 4
        while self._bearer(tried, uuid) != uuid or _LIKE_UUID.fullmatch(tried):
            tried = f"{name}-{uuid.hex()[-digits:]}"
            digits += 2
            self.bearers |= self.station.nodes.bearers_of([tried])
        return tried

    def _bearer(self, name: str, uuid: bytes) -> bytes:
        """Return the node with this name, among those in the bundle and here; ``uuid`` if there is none."""
        return self.given.get(name) or self.bearers.get(name, uuid)

    def _decision(self, node: BundledNode) -> Decision:
        held = self.held.get(node.uuid, {})
        if node.kid in held:
            return "new" if node.uuid in self.tombstones else "same"
        return "newer" if held else "new"


def _keep_ca(station: Station, plan: ImportPlan) -> None:
    """Keep the CA's signatures that the bundle brings: over this station, and over those it names that are known."""
    bundle, signature = plan.opened.bundle, plan.opened.station_signature
    if signature is not None:
        station.identity.keep_certificate(bundle.ca, station.point, signature)
    station.policy.renew_ca(bundle.ca)
    points = station.policy.station_points()
    for digits, signature in bundle.station_signatures.items():
        point = points.get(digits)
        if point is not None and digits != station.fingerprint:
            station.identity.keep_certificate(bundle.ca, point, signature)  # checks the signature


# A node counts as taken over once it has opened a session here, after a move under a new key.


@dataclass(frozen=True)
class NodeProof:
    """A node that opened a session; ``rotated``: under a new key, so that the former holders are locked out."""

    uuid: bytes
    epoch: int
    rotated: bool


@dataclass(frozen=True)
class NodeProofFailure:
    """A node that did not, and why."""

    uuid: bytes
    why: str


def prove_node(station: Station, node: Conversation) -> NodeProof:
    """Have one node prove its identity key and open a session; a move's key is rotated in it.

    Raises TedsProvisionError: link, other key, unknown key.
    """
    due = station.keys.rotates_now(node.uuid)
    identify(station, node)
    held = require_session(station, node)
    station.audit("handover", node.uuid, "taken over", epoch=held.record.epoch, rotated=due)
    return NodeProof(node.uuid, held.record.epoch, rotated=due)


def proven_of(station: Station, uuids: Iterable[bytes]) -> set[bytes]:
    """Return those of many nodes whose held key opened a session and has no rotation due."""
    proven: set[bytes] = set()
    for chunk in chunks(uuids):
        active = {key.uuid for key in station.keys.get_many(chunk) if key.state == "active"}
        proven |= active - station.keys.due_among(chunk)
    return proven


def prove_nodes(
    station: Station,
    links: LinkSettings,
    uuids: Sequence[bytes],
    reporter: Reporter,
    *,
    hold: Callable[[], AbstractContextManager[object]] = nullcontext,
) -> list[NodeProof | NodeProofFailure]:
    """Meet each of these nodes on the chosen link, in whatever order they come; ends when none comes in time.

    ``hold`` holds the store for as long as one node is worked on, never while one is waited for.
    """
    waiting, outcomes = set(uuids), dict[bytes, NodeProof | NodeProofFailure]()
    try:
        port = open_port(links)
    except LinkError as error:
        return [NodeProofFailure(uuid, error.message) for uuid in uuids]
    try:
        while waiting:
            try:
                contact = port.find(
                    lambda identity: identity.uuid in waiting, seconds=links.timeout, notice=reporter.notice
                )
            except NoNodeError:
                break
            uuid = contact.identity.uuid
            waiting.discard(uuid)
            try:
                with Conversation(contact, notice=reporter.notice) as node, hold():
                    outcomes[uuid] = prove_node(station, node)
            except TedsProvisionError as error:
                outcomes[uuid] = NodeProofFailure(uuid, error.message)
    except LinkError as error:
        return [outcomes.get(uuid, NodeProofFailure(uuid, error.message)) for uuid in uuids]
    finally:
        port.close()
    return [outcomes.get(uuid, NodeProofFailure(uuid, "it was not met")) for uuid in uuids]
