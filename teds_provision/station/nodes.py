"""Nodes: names, states and identity keys, and what leads from a text to a node."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from functools import lru_cache
from itertools import islice
from operator import attrgetter
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import KeyMismatchError, NotFoundError, StoreError, UsageError
from teds_provision.lazy import late
from teds_provision.station.plant.plant import Plant
from teds_provision.station.row_macs import MacRow, RowMacs, changed
from teds_provision.station.store.database import CHUNK, chunks, places
from teds_provision.station.store.records import UUID_OCTETS, ExportedNode, ExportEligibility, NewNode, NodeRecord
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

if TYPE_CHECKING:
    import difflib
else:
    difflib = late("difflib")  # for suggestions if a name is mistyped

_MOST_NAMES: Final = 10_000
_LONGEST: Final = 64
_UUID_DIGITS = 2 * UUID_OCTETS
_MIN_PREFIX = 4
_SHOWN_CANDIDATES = 5
NODE_FIELDS = tuple(column.name for column in fields(NodeRecord))
_NODE_COLUMNS = ", ".join(NODE_FIELDS)
_EXPORTED_COLUMNS = ", ".join(
    "(SELECT json_group_array(name) FROM (SELECT name FROM group_members m WHERE m.uuid = nodes.uuid ORDER BY name))"
    if name == "groups"
    else name
    for name in ExportedNode._fields
)
_REPLACE = f"INSERT OR REPLACE INTO nodes({_NODE_COLUMNS}) VALUES({places(NODE_FIELDS)})"
_ADD = (
    f"INSERT INTO nodes({', '.join(NewNode._fields)}, point_mac, epoch, sequence, can_address, channels)"
    f" VALUES({places(NewNode._fields)}, ?, 0, 0, 0, 0)"
)
_node_values = attrgetter(*NODE_FIELDS)
_MAC = NODE_FIELDS.index("point_mac")
_LISTED_NAMES: Final = (
    "(SELECT w.uuid, w.name FROM whitelist w LEFT JOIN nodes n USING (uuid)"
    " WHERE w.name IS NOT NULL AND n.name IS NULL)"
)
"""The names of the whitelist that count: a node that was named since has that name alone."""


class Nodes:
    """The nodes of one station, by UUID."""

    def __init__(self, store: Store, row_macs: RowMacs, plant: Plant) -> None:
        self._store, self._row_macs, self._plant = store, row_macs, plant

    def all(self) -> list[NodeRecord]:
        """Return all nodes, by UUID."""
        return self._store.read(NodeRecord, f"SELECT {_NODE_COLUMNS} FROM nodes ORDER BY uuid")

    def get(self, uuid: bytes) -> NodeRecord | None:
        """Return the record of a node, None if there is none."""
        return self._store.read_one(NodeRecord, f"SELECT {_NODE_COLUMNS} FROM nodes WHERE uuid = ?", (uuid,))

    def get_many(self, uuids: Sequence[bytes]) -> dict[bytes, NodeRecord]:
        """Return the records of a chunk of nodes, by UUID."""
        found = self._store.read_of_nodes(NodeRecord, f"SELECT {_NODE_COLUMNS} FROM nodes", uuids)
        return {record.uuid: record for record in found}

    def names(self) -> dict[bytes, str]:
        """Return the names of all nodes that have one, by UUID."""
        return dict(self._store.execute("SELECT uuid, name FROM nodes WHERE name IS NOT NULL"))

    def all_shown_keys(self) -> Iterator[ExportEligibility]:
        """Give identity key and retirement of all nodes, by UUID, a chunk at a time."""
        after = b""
        statement = "SELECT uuid, point, point_mac, retired FROM nodes WHERE uuid > ? ORDER BY uuid LIMIT ?"
        while chunk := self._store.read(ExportEligibility, statement, (after, CHUNK)):
            yield from chunk
            after = chunk[-1].uuid

    def exported_many(self, uuids: Sequence[bytes]) -> dict[bytes, ExportedNode]:
        """Return a bundle's facts about a chunk of nodes, by UUID."""
        found = self._store.read_of_nodes(_exported, f"SELECT {_EXPORTED_COLUMNS} FROM nodes", uuids)
        return {exported.uuid: exported for exported in found}

    def put(self, record: NodeRecord) -> None:
        """Add or replace a node. Epoch and sequence never go back; raises KeyMismatchError for another identity key."""
        with self._store.together():
            present = self.get(record.uuid)
            self._replace(replace(record, point_mac=self._mac_of(record.uuid, record.point, present)), present)

    def restore(self, record: NodeRecord) -> None:
        """Put a row as :meth:`put` does, with the MAC that it has: it comes from a backup."""
        with self._store.together():
            self._replace(record, self.get(record.uuid))

    def put_many(self, records: Iterable[NodeRecord]) -> None:
        """Add or replace nodes, each with a MAC of its identity key; the caller has held them against those here."""
        rows = ((record, self._mac(record.uuid, record.point) if record.point else None) for record in records)
        self._store.replace_rows("nodes", NODE_FIELDS, (_row(record, mac) for record, mac in rows))

    def add_many(self, nodes: Iterable[NewNode]) -> None:
        """Add nodes, each with a MAC of its identity key; the caller knows that none of them is here."""
        mac = self._mac
        self._store.execute_many(_ADD, ((*node, mac(node.uuid, node.point)) for node in nodes))

    def remember(self, uuid: bytes, **facts: object) -> NodeRecord:
        """Bring what is known of a node up to date and return it."""
        with self._store.together():  # so that no other process changes the row between read and write
            present = self.get(uuid)
            before = present or NodeRecord(uuid)
            mac = self._mac_of(uuid, facts.get("point", before.point), present)
            changed = replace(before, **facts, point_mac=mac)  # type: ignore[arg-type]
            if present is None or changed != present or mac != present.point_mac:
                self._replace(changed, present)
            if changed.name != before.name:
                self._plant.record_name(uuid, changed.name)
        return changed

    def _replace(self, record: NodeRecord, known: NodeRecord | None) -> None:
        """Keep a record, inside a transaction in which ``known`` was read (None: there is no such node)."""
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
        self._store.execute(_REPLACE, tuple(values.values()))

    def met_at(self, uuid: bytes, place: str) -> None:
        """Record that a session with this node was opened at ``place`` (``LINK:PORT``), for the next search.

        A hint: it neither waits for the disk nor fails because of it; a lost one comes back in the next session.
        """
        if place and self.last_places([uuid]).get(uuid) != place:
            with suppress(StoreError), self._store.transaction(later=True):
                self._store.execute("INSERT OR REPLACE INTO last_places VALUES(?, ?)", (uuid, place))

    def last_places(self, uuids: Sequence[bytes]) -> dict[bytes, str]:
        """Return the last place of each of these nodes, as ``LINK:PORT``; without those never met."""
        return {
            bytes(uuid): str(place)
            for batch in chunks(uuids)
            for uuid, place in self._store.execute(
                f"SELECT uuid, place FROM last_places WHERE uuid IN ({places(batch)})", batch
            )
        }

    def unpin(self, uuid: bytes) -> None:
        """Forget the identity key of a node on its owner's explicit order; epoch and sequence stay."""
        self._store.execute("UPDATE nodes SET point = NULL, point_mac = NULL WHERE uuid = ?", (uuid,))

    def set_due(self, uuid: bytes, due: str | None) -> None:
        """Record the day (ISO 8601) on which the first calibration of a node ends, None if none does."""
        self._store.execute("UPDATE nodes SET due = ? WHERE uuid = ? AND due IS NOT ?", (due, uuid, due))

    # -- the MAC of an identity key ----------------------------------------------------------------------------------

    def _mac_of(self, uuid: bytes, point: object, present: NodeRecord | None) -> bytes | None:
        """Return the row MAC of an identity key, new if the vault is open; without one it is a hint."""
        if not isinstance(point, bytes):
            return None
        if present is not None and present.point == point and present.point_mac is not None:
            return present.point_mac
        return self._mac(uuid, point)

    def _mac(self, uuid: bytes, point: bytes) -> bytes | None:
        """Return the MAC of an identity key; None, and so only a hint, as long as the vault is closed."""
        return self._row_macs.mac("node", (uuid, point)) if self._row_macs.active else None

    def check_point(self, node: NodeRecord | ExportEligibility) -> None:
        """Raise StoreChangedError if a node's identity key with a MAC was changed."""
        has_mac = node.point is not None and node.point_mac is not None
        if has_mac and not self._row_macs.counts(node.point_mac, "node", (node.uuid, node.point)):
            remove = f"teds-provision whitelist remove {node.uuid.hex()}, then tap the node."
            raise changed([f"the key of node {node.uuid.hex()}"], remove)

    def mac_rows(self, sample: RowSample) -> Iterator[MacRow]:
        """Yield the identity keys with a MAC, for a check of them."""
        rows = sample.rows(self._store, "nodes")
        for node in self._store.read(NodeRecord, f"SELECT {_NODE_COLUMNS} FROM nodes WHERE {rows} ORDER BY uuid"):
            if node.point is not None and node.point_mac is not None:
                yield f"the key of node {node.uuid.hex()}", node.point_mac, "node", (node.uuid, node.point)

    # -- names, and prefixes of UUIDs --------------------------------------------------------------------------------

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
        found = set(self._store.execute(*_by_name(asked)))
        if is_hex and _MIN_PREFIX <= len(digits) < _UUID_DIGITS:
            found.update(self._store.execute(*_by_prefix(digits)))
        candidates = sorted(uuid for (uuid,) in found)
        if not candidates:
            near = self._near_names(asked)
            meant = f"Did you mean {' or '.join(map(repr, near))}? " if near else ""
            raise NotFoundError(
                f"No node is known as {asked!r}.",
                hint=f"{meant}Give a UUID (20 hex digits, or its first four or more) or a name; see nodes.",
            )
        if len(candidates) > 1:
            shown = ", ".join(uuid.hex() for uuid in candidates[:_SHOWN_CANDIDATES])
            more = f" and {len(candidates) - _SHOWN_CANDIDATES} more" if len(candidates) > _SHOWN_CANDIDATES else ""
            raise UsageError(f"{asked!r} fits several nodes: {shown}{more}.", hint="Give more digits of the UUID.")
        return bytes(candidates[0])

    def _near_names(self, text: str) -> list[str]:
        """Return names much like a mistyped one, or that begin with it; two at most."""
        names = sorted({node.name for node in islice(self.all(), _MOST_NAMES) if node.name})
        folded = {name.casefold(): name for name in names}
        begun = [name for key, name in folded.items() if key.startswith(text.casefold()[:_LONGEST])]
        near = difflib.get_close_matches(text.casefold()[:_LONGEST], folded, n=2, cutoff=0.6)
        return list(dict.fromkeys([*(folded[key] for key in near), *begun]))[:2]

    def beginning_with(self, text: str, most: int) -> list[tuple[str, str]]:
        """Return at most so many words that begin with ``text``, each with what it is: names, and UUIDs (20 digits)."""
        found: dict[str, str] = {}
        upper = text + "\U0010ffff"
        digits = text.removeprefix("0x").lower()
        for table, names in (("nodes", "nodes"), ("whitelist", _LISTED_NAMES)):
            named = f"SELECT name, lower(hex(uuid)) FROM {names} WHERE name >= ? AND name < ? ORDER BY name LIMIT ?"
            found.update((name, uuid) for name, uuid in self._store.execute(named, (text, upper, most)))
            if re.fullmatch("[0-9a-f]{0,20}", digits):
                within = f"SELECT lower(hex(uuid)), name FROM {table} WHERE uuid BETWEEN ? AND ? LIMIT ?"
                rows = self._store.execute(within, (*_bounds(digits), most))
                found.update((uuid, found.get(uuid) or name or "") for uuid, name in rows)
        return sorted(found.items())[:most]

    def all_named(self, name: str) -> list[bytes]:
        """Return the UUIDs of the nodes and whitelist entries that have exactly this name."""
        return sorted(bytes(uuid) for (uuid,) in self._store.execute(*_by_name(name)))

    def named(self, name: str) -> bytes | None:
        """Return the UUID of the only node of exactly this name, None if none or several have it."""
        found = self.all_named(name)
        return found[0] if len(found) == 1 else None

    def bearers_of(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return who has each of these names (a chunk of them), in the nodes or in the whitelist."""
        found = (
            f"SELECT name, uuid FROM {table} WHERE name IN ({places(names)})" for table in (_LISTED_NAMES, "nodes")
        )
        return {name: bytes(uuid) for statement in found for name, uuid in self._store.execute(statement, names)}


def _row(record: NodeRecord, mac: bytes | None) -> list[Any]:
    row = list(_node_values(record))
    row[_MAC] = mac
    return row


def _exported(*row: Any) -> ExportedNode:
    values: tuple[Any, ...] = (*row[:-1], _groups(row[-1]))
    return ExportedNode(*values)


@lru_cache(maxsize=256)  # there may be 100,000 nodes, but only a few groups
def _groups(listed: str) -> tuple[str, ...]:
    return tuple(json.loads(listed))


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
