"""Bundles that left and came, and the many rows that one of them brings at once."""

from __future__ import annotations

from teds_provision.station.node_keys import NodeKeys
from teds_provision.station.seals import Seals
from teds_provision.store import Batch, Handover, Store
from teds_provision.store.records import Direction


class Handovers:
    """The handovers of one station."""

    def __init__(self, store: Store, keys: NodeKeys, seals: Seals) -> None:
        self._store = store
        self._keys = keys
        self._seals = seals

    def all(self) -> list[Handover]:
        """Every bundle that left or came, oldest first."""
        return self._store.handovers()

    def get(self, handover_id: str, direction: Direction) -> Handover | None:
        """One bundle, None if it is not known."""
        return self._store.handover(handover_id, direction)

    def put(self, handover: Handover) -> None:
        """Add or replace a bundle."""
        self._store.put_handover(handover)

    def remove(self, handover_id: str, direction: Direction) -> bool:
        """Forget a bundle; False if there is none."""
        return self._store.remove_handover(handover_id, direction)

    def take_in(self, batch: Batch) -> None:
        """Add or replace many rows, all or none; the caller has held them against what is there."""
        with self._store.transaction():
            seals = self._seals
            self._store.put_batch(
                batch,
                seal_node=lambda node: seals.point(node.uuid, node.point) if node.point else None,
                seal_entry=seals.of_entry,
            )
            self._keys.mark(batch.marks)
