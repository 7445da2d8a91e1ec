"""Many rows at once: a handover may bring ten thousand nodes, and a statement for each would take a second or two."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from teds_provision.store.database import Database
from teds_provision.store.records import Holder, KeyRecord, NodeRecord, Tombstone, WhitelistEntry

_NODE_FIELDS = tuple(column.name for column in fields(NodeRecord))
_FIELDS: dict[type[object], tuple[str, ...]] = {
    kind: tuple(column.name for column in fields(kind)) for kind in (KeyRecord, WhitelistEntry, Holder, Tombstone)
}
_NODES = f"INSERT OR REPLACE INTO nodes({', '.join(_NODE_FIELDS)}) VALUES({', '.join('?' * len(_NODE_FIELDS))})"
_KEYS = (
    "INSERT INTO keys(uuid, epoch, key_id, state, slot, wrapped, source, created) VALUES(?,?,?,?,?,?,?,?)"
    " ON CONFLICT(uuid, key_id) DO NOTHING"
)
_SLOTS = "INSERT INTO key_slots VALUES(?, ?) ON CONFLICT(uuid) DO UPDATE SET last = max(last, excluded.last)"


@dataclass(frozen=True)
class Batch:
    """Rows to add or replace, and marks of nodes; the caller has held epochs and keys against what is there."""

    nodes: Sequence[NodeRecord] = ()
    whitelist: Sequence[WhitelistEntry] = ()
    keys: Sequence[KeyRecord] = ()
    holders: Sequence[Holder] = ()
    tombstones: Sequence[Tombstone] = ()
    marks: Mapping[bytes, Mapping[str, Any]] = field(default_factory=dict)
    """Changes of marks (names and values of :class:`Marks`), by UUID; the caller of ``put_batch`` makes them."""


class BulkTables:
    """The part of the store that reads and writes many rows; see :class:`teds_provision.store.Store`."""

    _database: Database

    def slots(self) -> dict[bytes, int]:
        """Return the last slot given to each node's keys."""
        return {bytes(uuid): int(last) for uuid, last in self._database.execute("SELECT uuid, last FROM key_slots")}

    def put_batch(self, batch: Batch) -> None:
        """Add or replace all of it, or nothing; raises StoreFailure."""
        many = self._database.execute_many
        with self._database.transaction():
            many(_NODES, (_node_row(record) for record in batch.nodes))
            many(
                "INSERT OR REPLACE INTO whitelist VALUES(?, ?, ?, ?, ?, ?)", (_row(entry) for entry in batch.whitelist)
            )
            many(_SLOTS, ((key.uuid, key.slot) for key in batch.keys))
            many(_KEYS, (_row(key)[:-1] for key in batch.keys))
            many("INSERT OR REPLACE INTO holders VALUES(?, ?, ?, ?)", (_row(holder) for holder in batch.holders))
            many("INSERT OR REPLACE INTO tombstones VALUES(?, ?, ?, ?)", (_row(one) for one in batch.tombstones))

    def remove_tombstones(self, uuids: Iterable[bytes]) -> None:
        """Take the tombstones of these nodes away."""
        self._database.execute_many("DELETE FROM tombstones WHERE uuid = ?", ((uuid,) for uuid in uuids))


def _row(record: KeyRecord | WhitelistEntry | Holder | Tombstone) -> tuple[Any, ...]:
    return tuple([getattr(record, name) for name in _FIELDS[type(record)]])


def _node_row(record: NodeRecord) -> tuple[Any, ...]:
    groups = json.dumps(list(record.groups))
    return tuple(groups if name == "groups" else getattr(record, name) for name in _NODE_FIELDS)
