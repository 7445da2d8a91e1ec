"""Nodes that come with a bundle: what becomes of each, and the rows of those that are taken in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

from teds_provision.protocol.fingerprints import is_whole
from teds_provision.protocol.handover.contents import Bundle, BundledNode
from teds_provision.protocol.keys import fingerprint
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station
from teds_provision.store import Batch, Holder, KeyRecord, NodeRecord, WhitelistEntry, pages, utc_now

Decision = Literal["new", "newer", "same", "refused"]


@dataclass(frozen=True, slots=True)
class PlannedNode:
    """What becomes of one node of the bundle, and why where it is refused.

    ``name`` is the one that it gets here, ``notes`` say what a person should know of a node that is taken.
    """

    node: BundledNode
    decision: Decision
    why: str = ""
    name: str | None = None
    notes: tuple[str, ...] = ()


class Arrivals:
    """The rows of the nodes that are taken in, made and written a page at a time; the caller holds the transaction."""

    def __init__(self, station: Station, bundle: Bundle) -> None:
        self.station, self.bundle = station, bundle
        self.resting = {tombstone.uuid for tombstone in station.policy.tombstones()}
        self.others = sorted({bundle.sender, *bundle.to} - {station.fingerprint})
        self.now = utc_now()
        self._turn_to([])

    def take_in(self, nodes: Iterable[PlannedNode]) -> None:
        """Write all of them."""
        self.station.keys.refresh()
        for taken in pages(nodes):
            self._turn_to([one.node.uuid for one in taken])
            self._take_back([one.node.uuid for one in taken if one.node.uuid in self.resting])
            self.station.handovers.take_in(self._rows(taken))

    def _rows(self, taken: Sequence[PlannedNode]) -> Batch:
        return Batch(
            nodes=[self._node(one) for one in taken],
            whitelist=[entry for entry in map(self._entry, taken) if entry is not None],
            keys=[self._key(one.node) for one in taken if one.decision != "same"],
            holders=[holder for one in taken for holder in self._holders(one.node)],
            marks=self._marks(taken),
        )

    def _turn_to(self, uuids: Sequence[bytes]) -> None:
        """Read what is known here of a page of nodes."""
        station = self.station
        self.known = station.nodes.of_page(uuids)
        self.pins = station.pins.of_page(uuids)
        self.slots = station.keys.slots_of(uuids)
        self.cas = station.keys.cas_of_page(uuids)

    def _take_back(self, uuids: list[bytes]) -> None:
        self.station.policy.take_back(uuids)
        for uuid in uuids:
            self.station.audit("handover", uuid, "came back", handover=self.bundle.id)

    def _holders(self, node: BundledNode) -> list[Holder]:
        """The other stations that have this key from now on: the sender, and who else the bundle is for."""
        return [Holder(node.uuid, other, self.now, self.bundle.mode) for other in self.others]

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

    def _entry(self, one: PlannedNode) -> WhitelistEntry | None:
        """The whitelist entry, pinned to the node's key; None where it is pinned already."""
        node = one.node
        pin, digits = self.pins.get(node.uuid), fingerprint(node.node_key)
        if pin is None:
            return WhitelistEntry(node.uuid, digits, self.now, "import", one.name)
        return None if is_whole(pin.fingerprint) else replace(pin, fingerprint=digits, assurance="import")

    def _node(self, one: PlannedNode) -> NodeRecord:
        """What is known of the node from now on; not its epoch and sequence, which a session has to tell."""
        node = one.node
        state = int(NodeState.PROVISIONED if node.teds_sha256 else NodeState.KEYED)
        known = self.known.get(node.uuid)
        if known is None:
            return NodeRecord(
                node.uuid,
                node.node_key,
                one.name,
                node.profile,
                state,
                groups=node.groups,
                teds_sha256=node.teds_sha256,
            )
        return replace(
            known,
            point=node.node_key,
            name=known.name or one.name,
            profile=known.profile or node.profile,
            groups=tuple(dict.fromkeys((*known.groups, *node.groups))),
            state=known.state or state,
            teds_sha256=known.teds_sha256 or node.teds_sha256,
        )

    def _marks(self, taken: Iterable[PlannedNode]) -> dict[bytes, dict[str, Any]]:
        """Rotations that are due after a move; the CA that each node keeps, or keeps once its new key is proven."""
        ca, own = self.bundle.ca, self.station.ca
        marks: dict[bytes, dict[str, Any]] = {}
        for one in taken:
            uuid = one.node.uuid
            if uuid in self.resting:
                marks[uuid] = {"rotation": f"it came back by {self.bundle.id}: others have had this key"}
            if self.bundle.mode == "move":
                marks[uuid] = {"rotation": f"moved here by {self.bundle.id}: the sender has had this key"}
            if one.decision == "same" or self.cas.get(uuid, own) == ca:
                continue
            if one.decision == "newer":  # the key held now stays good, under its CA, until the new one is proven
                kept: dict[str, Any] = {"next_key_id": one.node.kid, "next_ca": ca}
            else:
                kept = {"ca": ca}
            marks[uuid] = {**marks.get(uuid, {}), **kept}
        return marks
