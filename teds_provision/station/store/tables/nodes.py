"""Whitelist, nodes and names; and many rows of them at once, as a handover brings them."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields
from functools import lru_cache
from itertools import islice
from operator import attrgetter
from typing import Any, Final, TypeVar

from teds_provision.errors import KeyMismatchError, NotFoundError, UsageError
from teds_provision.station.store.database import PAGE, Database, places
from teds_provision.station.store.records import (
    UUID_OCTETS,
    ExportedNode,
    ExportEligibility,
    Holder,
    KeyRecord,
    NodeRecord,
    Tombstone,
    WhitelistEntry,
    utc_now,
)

_UUID_DIGITS = 2 * UUID_OCTETS
_MIN_PREFIX = 4
_SHOWN_CANDIDATES = 5
NODE_FIELDS = tuple(column.name for column in fields(NodeRecord))
_NODE_COLUMNS = ", ".join(NODE_FIELDS)
_HANDED_COLUMNS = ", ".join(
    "(SELECT json_group_array(name) FROM (SELECT name FROM group_members m WHERE m.uuid = nodes.uuid ORDER BY name))"
    if name == "groups"
    else name
    for name in ExportedNode._fields
)
REPLACE_NODE = f"INSERT OR REPLACE INTO nodes({_NODE_COLUMNS}) VALUES({places(NODE_FIELDS)})"
REPLACE_ENTRY = "INSERT OR REPLACE INTO whitelist VALUES(?, ?, ?, ?, ?, ?)"


class NodeTables:
    """The part of the store that is about nodes; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    def whitelist(self) -> list[WhitelistEntry]:
        """Return all entries, by UUID."""
        return self._database.read(WhitelistEntry, "SELECT * FROM whitelist ORDER BY uuid")

    def all_whitelisted(self) -> Iterator[WhitelistEntry]:
        """Give all entries, by UUID, a page at a time; holds no lock between pages."""
        after = b""
        while page := self._database.read(
            WhitelistEntry, "SELECT * FROM whitelist WHERE uuid > ? ORDER BY uuid LIMIT ?", (after, PAGE)
        ):
            yield from page
            after = page[-1].uuid

    def whitelisted(self, uuid: bytes) -> WhitelistEntry | None:
        """Return the entry of this node, None if it is not whitelisted."""
        return self._database.read_one(WhitelistEntry, "SELECT * FROM whitelist WHERE uuid = ?", (uuid,))

    def put_whitelist(self, entry: WhitelistEntry) -> None:
        """Add or replace the entry of a node; policy (a pinned key stays) is the caller's."""
        self._database.execute(
            REPLACE_ENTRY,
            (entry.uuid, entry.fingerprint, entry.added, entry.assurance, entry.name, entry.mac),
        )

    def put_whitelist_entries(self, entries: Iterable[WhitelistEntry]) -> None:
        """Add or replace many entries at once, all or none."""
        rows = ((e.uuid, e.fingerprint, e.added, e.assurance, e.name, e.mac) for e in entries)
        with self._database.together():
            self._database.execute_many(REPLACE_ENTRY, rows)

    def remove_whitelist(self, uuid: bytes) -> bool:
        """Take a node off the whitelist; False if it was not on it."""
        return self._database.change("DELETE FROM whitelist WHERE uuid = ?", (uuid,)) > 0

    def nodes(self) -> list[NodeRecord]:
        """Return all nodes, by UUID."""
        return self._database.read(NodeRecord, f"SELECT {_NODE_COLUMNS} FROM nodes ORDER BY uuid")

    def all_shown_keys(self) -> Iterator[ExportEligibility]:
        """Give identity key and retirement of all nodes, by UUID, a page at a time."""
        after = b""
        statement = "SELECT uuid, point, point_mac, retired FROM nodes WHERE uuid > ? ORDER BY uuid LIMIT ?"
        while page := self._database.read(ExportEligibility, statement, (after, PAGE)):
            yield from page
            after = page[-1].uuid

    def nodes_of(self, uuids: Sequence[bytes]) -> dict[bytes, NodeRecord]:
        """Return what is known of these nodes (a page of them), by UUID."""
        statement = f"SELECT {_NODE_COLUMNS} FROM nodes WHERE uuid IN ({places(uuids)})"
        return {record.uuid: record for record in self._database.read(NodeRecord, statement, uuids)}

    def exported_nodes_of(self, uuids: Sequence[bytes]) -> dict[bytes, ExportedNode]:
        """Return a bundle's facts about these nodes (a batch of them), by UUID."""
        statement = f"SELECT {_HANDED_COLUMNS} FROM nodes WHERE uuid IN ({places(uuids)})"
        return {handed.uuid: handed for handed in self._database.read(_handed, statement, uuids)}

    def whitelist_of(self, uuids: Sequence[bytes]) -> dict[bytes, WhitelistEntry]:
        """Return the entries of these nodes (a page of them), by UUID."""
        statement = f"SELECT * FROM whitelist WHERE uuid IN ({places(uuids)})"
        return {entry.uuid: entry for entry in self._database.read(WhitelistEntry, statement, uuids)}

    def bearers_of(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return who has each of these names (a page of them), in the nodes or in the whitelist."""
        found = (
            f"SELECT name, uuid FROM {table} WHERE name IN ({places(names)})" for table in (_LISTED_NAMES, "nodes")
        )
        return {name: bytes(uuid) for statement in found for name, uuid in self._database.execute(statement, names)}

    def node(self, uuid: bytes) -> NodeRecord | None:
        """Return what is known of this node."""
        return self._database.read_one(NodeRecord, f"SELECT {_NODE_COLUMNS} FROM nodes WHERE uuid = ?", (uuid,))

    def put_node(self, record: NodeRecord) -> None:
        """Add or replace a node. Epoch and sequence never go back; a known identity key stays.

        Raises KeyMismatchError if the record brings another identity key than the stored one.
        """
        with self._database.together():
            self.replace_node(record, self.node(record.uuid))

    def replace_node(self, record: NodeRecord, known: NodeRecord | None) -> None:
        """As :meth:`put_node`, inside a transaction in which ``known`` was read (None: there is no such node)."""
        if known and known.point and record.point and known.point != record.point:
            raise KeyMismatchError(
                f"Node {record.uuid.hex()} is known with another identity key than the one it shows now.",
                hint="Do not trust this node. If its chip was really replaced, it needs a new UUID.",
            )
        values: dict[str, Any] = {name: getattr(record, name) for name in NODE_FIELDS}
        if known:
            if record.point is None:
                values["point"], values["point_mac"] = known.point, known.point_mac
            values["epoch"] = max(record.epoch, known.epoch)
            values["sequence"] = max(record.sequence, known.sequence)
        self._database.execute(REPLACE_NODE, tuple(values.values()))

    def last_places(self, uuids: Sequence[bytes]) -> dict[bytes, str]:
        """Return the last place of each of these nodes (a batch of them), ``LINK:PORT``; without those never met."""
        statement = f"SELECT uuid, place FROM last_places WHERE uuid IN ({places(uuids)})"
        return {bytes(uuid): str(place) for uuid, place in self._database.execute(statement, uuids)}

    def put_last_place(self, uuid: bytes, place: str) -> None:
        """Record the place of a node's last contact."""
        self._database.execute("INSERT OR REPLACE INTO last_places VALUES(?, ?)", (uuid, place))

    def set_due(self, uuid: bytes, due: str | None) -> None:
        """Record the day (ISO 8601) on which the first calibration of a node ends, None if none does."""
        self._database.execute("UPDATE nodes SET due = ? WHERE uuid = ? AND due IS NOT ?", (due, uuid, due))

    def unpin_node(self, uuid: bytes) -> None:
        """Forget the identity key of a node on its owner's explicit order; epoch and sequence stay."""
        with self._database.together():
            self._database.execute("UPDATE nodes SET point = NULL, point_mac = NULL WHERE uuid = ?", (uuid,))
            for table in ("readings", "firmware"):  # of the board that it was
                self._database.execute(f"DELETE FROM {table} WHERE uuid = ?", (uuid,))

    def resolve(self, text: str) -> bytes:
        """Return the UUID that ``text`` means, looking at nodes and whitelist.

        ``text`` is a UUID of 20 hex digits (returned even if unknown), a prefix of four or more, either with or
        without ``0x`` and in any case, or a name. Raises NotFoundError, or UsageError when several nodes fit.
        """
        asked = text.strip()
        digits = asked.removeprefix("0x").removeprefix("0X").lower()
        is_hex = re.fullmatch("[0-9a-f]+", digits) is not None
        if is_hex and len(digits) == _UUID_DIGITS:
            return bytes.fromhex(digits)
        found = set(self._database.execute(*_by_name(asked)))
        if is_hex and _MIN_PREFIX <= len(digits) < _UUID_DIGITS:
            found.update(self._database.execute(*_by_prefix(digits)))
        candidates = sorted(uuid for (uuid,) in found)
        if not candidates:
            raise NotFoundError(
                f"No node is known as {asked!r}.",
                hint="Give a UUID (20 hex digits, or its first four or more) or a name; see teds-provision nodes.",
            )
        if len(candidates) > 1:
            shown = ", ".join(uuid.hex() for uuid in candidates[:_SHOWN_CANDIDATES])
            more = f" and {len(candidates) - _SHOWN_CANDIDATES} more" if len(candidates) > _SHOWN_CANDIDATES else ""
            raise UsageError(f"{asked!r} fits several nodes: {shown}{more}.", hint="Give more digits of the UUID.")
        return bytes(candidates[0])

    def beginning_with(self, text: str, most: int) -> list[tuple[str, str]]:
        """Return at most so many words that begin with ``text``, each with what it is: names, and UUIDs (20 digits)."""
        found: dict[str, str] = {}
        upper = text + "\U0010ffff"
        digits = text.removeprefix("0x").lower()
        for table, names in (("nodes", "nodes"), ("whitelist", _LISTED_NAMES)):
            named = f"SELECT name, lower(hex(uuid)) FROM {names} WHERE name >= ? AND name < ? ORDER BY name LIMIT ?"
            found.update((name, uuid) for name, uuid in self._database.execute(named, (text, upper, most)))
            if re.fullmatch("[0-9a-f]{0,20}", digits):
                within = f"SELECT lower(hex(uuid)), name FROM {table} WHERE uuid BETWEEN ? AND ? LIMIT ?"
                rows = self._database.execute(within, (*_bounds(digits), most))
                found.update((uuid, found.get(uuid) or name or "") for uuid, name in rows)
        return sorted(found.items())[:most]

    def all_named(self, name: str) -> list[bytes]:
        """Return the UUIDs of the nodes and whitelist entries that have exactly this name."""
        return sorted(bytes(uuid) for (uuid,) in self._database.execute(*_by_name(name)))


def _handed(*row: Any) -> ExportedNode:
    values: tuple[Any, ...] = (*row[:-1], _groups(row[-1]))
    return ExportedNode(*values)


@lru_cache(maxsize=256)  # nodes may be 100,000, and groups are few
def _groups(listed: str) -> tuple[str, ...]:
    return tuple(json.loads(listed))


_LISTED_NAMES: Final = (
    "(SELECT w.uuid, w.name FROM whitelist w LEFT JOIN nodes n USING (uuid)"
    " WHERE w.name IS NOT NULL AND n.name IS NULL)"
)
"""The names of the whitelist that count: a node that was named since has that name alone."""


def _by_name(name: str) -> tuple[str, tuple[str, str]]:
    return f"SELECT uuid FROM nodes WHERE name = ? UNION SELECT uuid FROM {_LISTED_NAMES} WHERE name = ?", (name, name)


def _by_prefix(digits: str) -> tuple[str, tuple[bytes, bytes, bytes, bytes]]:
    statement = (
        "SELECT uuid FROM nodes WHERE uuid BETWEEN ? AND ? UNION SELECT uuid FROM whitelist WHERE uuid BETWEEN ? AND ?"
    )
    low, high = _bounds(digits)
    return statement, (low, high, low, high)


def _bounds(digits: str) -> tuple[bytes, bytes]:
    """Return the lowest and the highest UUID that begins with these digits."""
    return bytes.fromhex(digits.ljust(_UUID_DIGITS, "0")), bytes.fromhex(digits.ljust(_UUID_DIGITS, "f"))


# Many rows at once: a handover may bring ten thousand nodes, and a statement for each would take a second or two.

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


def chunks(values: Iterable[Value], length: int = PAGE) -> Iterator[list[Value]]:
    """Divide many values into pages, as many as one statement looks up at once."""
    rest = iter(values)
    while page := list(islice(rest, length)):
        yield page


@dataclass(frozen=True)
class BulkRows:
    """Rows to add or replace, and marks of nodes; the caller has held epochs and keys against what is there."""

    nodes: Sequence[NodeRecord] = ()
    whitelist: Sequence[WhitelistEntry] = ()
    keys: Sequence[KeyRecord] = ()
    holders: Sequence[Holder] = ()
    tombstones: Sequence[Tombstone] = ()
    groups: Mapping[str, Sequence[bytes]] = field(default_factory=dict)
    """Nodes to add to measurement groups, by the group's name; a group that does not exist is created."""
    key_flags: Mapping[bytes, Mapping[str, Any]] = field(default_factory=dict)
    """Changes of marks (names, values of :class:`records.KeyFlags`), by UUID; the caller of ``put_bulk`` makes them."""


class BulkTables:
    """The part of the store that reads and writes many rows; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    def slots_of(self, uuids: Sequence[bytes]) -> dict[bytes, int]:
        """Return the last slot given to the keys of each of these nodes (a page of them)."""
        rows = self._database.execute(f"SELECT uuid, last FROM key_slots WHERE uuid IN ({places(uuids)})", uuids)
        return {bytes(uuid): int(last) for uuid, last in rows}

    def put_bulk(
        self,
        batch: BulkRows,
        seal_node: Callable[[NodeRecord], bytes | None] = lambda node: node.point_mac,
        seal_entry: Callable[[WhitelistEntry], bytes | None] = lambda entry: entry.mac,
    ) -> None:
        """Add or replace all of it, or nothing, with seals made as it is written; raises StoreError."""
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
            many("INSERT OR IGNORE INTO groups VALUES(?, ?)", ((name, utc_now()) for name in batch.groups))
            many(
                "INSERT OR IGNORE INTO group_members VALUES(?, ?)",
                ((name, uuid) for name, uuids in batch.groups.items() for uuid in uuids),
            )

    def remove_tombstones(self, uuids: Iterable[bytes]) -> None:
        """Take the tombstones of these nodes away."""
        self._database.execute_many("DELETE FROM tombstones WHERE uuid = ?", ((uuid,) for uuid in uuids))


def _node_row(record: NodeRecord, mac: bytes | None) -> list[Any]:
    row = list(_node_values(record))
    row[_SEAL] = mac
    return row
