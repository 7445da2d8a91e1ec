"""Many rows at once: a handover may bring ten thousand nodes, and a statement for each would take a second or two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from teds_provision.station.groups import Groups
from teds_provision.station.node_keys import NodeKeys
from teds_provision.station.nodes import Nodes
from teds_provision.station.pins import Pins
from teds_provision.station.policy import Policy
from teds_provision.station.store.records import (
    Holder,
    KeyRecord,
    NewNode,
    NewPin,
    NodeRecord,
    Tombstone,
    WhitelistEntry,
)
from teds_provision.station.store.store import Store


@dataclass(frozen=True)
class BulkRows:
    """Rows to add or replace, and flags of keys; the caller has held epochs and keys against what is there."""

    nodes: Sequence[NodeRecord] = ()
    new_nodes: Sequence[NewNode] = ()
    whitelist: Sequence[WhitelistEntry] = ()
    new_pins: Sequence[NewPin] = ()
    keys: Sequence[KeyRecord] = ()
    holders: Sequence[Holder] = ()
    tombstones: Sequence[Tombstone] = ()
    groups: Mapping[str, Sequence[bytes]] = field(default_factory=dict)
    """Nodes to add to measurement groups, by the group's name; a group that does not exist is created."""
    key_flags: Mapping[bytes, Mapping[str, Any]] = field(default_factory=dict)
    """Changes of flags (names, values of :class:`.records.KeyFlags`), by UUID."""


class Bulk:
    """Writes rows of several topics as one change."""

    def __init__(self, store: Store, nodes: Nodes, pins: Pins, keys: NodeKeys, policy: Policy, groups: Groups) -> None:
        self._store = store
        self._nodes, self._pins, self._keys, self._policy, self._groups = nodes, pins, keys, policy, groups

    def put(self, rows: BulkRows) -> None:
        """Add or replace all rows, or none; MACs are made as they are written. Raises StoreError."""
        with self._store.transaction():
            self._nodes.put_many(rows.nodes)
            self._nodes.add_many(rows.new_nodes)
            self._pins.put_many(rows.whitelist)
            self._pins.add_many(rows.new_pins)
            self._keys.add(*rows.keys)
            self._keys.put_holder(*rows.holders)
            self._policy.put_tombstone(*rows.tombstones)
            self._groups.put_members(rows.groups)
            self._keys.set_flags(rows.key_flags)
