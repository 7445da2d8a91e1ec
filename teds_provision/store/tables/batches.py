"""Many rows at once: a handover may bring ten thousand nodes, and a statement for each would take a second or two."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from itertools import islice
from operator import attrgetter
from typing import Any, TypeVar

from teds_provision.store.database import PAGE, Database, places
from teds_provision.store.records import Holder, KeyRecord, NodeRecord, Tombstone, WhitelistEntry
from teds_provision.store.tables.nodes import GROUPS, NODE_FIELDS, REPLACE_ENTRY, REPLACE_NODE, listed

Value = TypeVar("Value")

_SEAL = NODE_FIELDS.index("point_mac")
_node_values = attrgetter(*NODE_FIELDS)
_key_values, _entry_values, _holder_values, _tombstone_values = (
    attrgetter(*(column.name for column in fields(kind))) for kind in (KeyRecord, WhitelistEntry, Holder, Tombstone)
)
_KEYS = (
    "INSERT INTO keys(uuid, epoch, key_id, state, slot, wrapped, source, created) VALUES(?,?,?,?,?,?,?,?)"
    " ON CONFLICT(uuid, key_id) DO NOTHING"
)
_SLOTS = "INSERT INTO key_slots VALUES(?, ?) ON CONFLICT(uuid) DO UPDATE SET last = max(last, excluded.last)"


def pages(values: Iterable[Value], length: int = PAGE) -> Iterator[list[Value]]:
    """Divide many values into pages, as many as one statement looks up at once."""
    rest = iter(values)
    while page := list(islice(rest, length)):
        yield page


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

    def slots_of(self, uuids: Sequence[bytes]) -> dict[bytes, int]:
        """Return the last slot given to the keys of each of these nodes (a page of them)."""
        rows = self._database.execute(f"SELECT uuid, last FROM key_slots WHERE uuid IN ({places(uuids)})", uuids)
        return {bytes(uuid): int(last) for uuid, last in rows}

    def put_batch(
        self,
        batch: Batch,
        seal_node: Callable[[NodeRecord], bytes | None] = lambda node: node.point_mac,
        seal_entry: Callable[[WhitelistEntry], bytes | None] = lambda entry: entry.mac,
    ) -> None:
        """Add or replace all of it, or nothing, with seals made as it is written; raises StoreFailure."""
        many = self._database.execute_many
        with self._database.together():
            many(REPLACE_NODE, (_node_row(record, seal_node(record)) for record in batch.nodes))
            many(
                REPLACE_ENTRY,
                ((*_entry_values(entry)[:-1], seal_entry(entry)) for entry in batch.whitelist),
            )
            many(_SLOTS, ((key.uuid, key.slot) for key in batch.keys))
            many(_KEYS, (_key_values(key)[:-1] for key in batch.keys))
            many("INSERT OR REPLACE INTO holders VALUES(?, ?, ?, ?)", map(_holder_values, batch.holders))
            many("INSERT OR REPLACE INTO tombstones VALUES(?, ?, ?, ?)", map(_tombstone_values, batch.tombstones))

    def remove_tombstones(self, uuids: Iterable[bytes]) -> None:
        """Take the tombstones of these nodes away."""
        self._database.execute_many("DELETE FROM tombstones WHERE uuid = ?", ((uuid,) for uuid in uuids))


def _node_row(record: NodeRecord, mac: bytes | None) -> list[Any]:
    row = list(_node_values(record))
    row[GROUPS] = listed(record.groups)
    row[_SEAL] = mac
    return row
