"""All that is known of nodes, put together from every table: found by one query, read a chunk at a time.

A node is known here that was met, whitelisted, brought by a bundle, moved away or denied.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

from teds_provision.station.datasheets import unpacked
from teds_provision.station.store.database import CHUNK, places
from teds_provision.station.store.records import UUID_OCTETS
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store
from teds_provision.teds.origin import ORIGIN, Origin, origin_of

_TABLES = ("nodes", "whitelist", "keys", "tombstones", "revocations")
_KNOWN = f"({' UNION '.join(f'SELECT uuid FROM {table}' for table in _TABLES)})"
# One EXISTS per table: with _KNOWN, SQLite would build the whole union before it searches.
_IS_KNOWN = " OR ".join(f"EXISTS (SELECT 1 FROM {table} WHERE uuid = ?1)" for table in _TABLES)
_NAME = "coalesce(n.name, w.name, '')"
_NAMES_TWICE = "SELECT name FROM nodes WHERE name IS NOT NULL GROUP BY name HAVING count(*) > 1"
_OTHERS_NAMES = (
    "SELECT n.name FROM ({}) k JOIN nodes n ON n.uuid = k.uuid WHERE n.name IS NOT NULL"
    " AND EXISTS (SELECT 1 FROM nodes o WHERE o.name = n.name AND o.uuid <> n.uuid)"
)
_UNVERIFIED = (
    "SELECT uuid FROM keys WHERE state = 'active' EXCEPT SELECT uuid FROM readings WHERE c IS NOT NULL"
    " EXCEPT SELECT uuid FROM nodes WHERE retired IS NOT NULL EXCEPT SELECT uuid FROM tombstones"
    " EXCEPT SELECT uuid FROM revocations ORDER BY uuid"  # all tables are sorted by their key, so EXCEPT is one merge
)
_UNVERIFIED_OF = (
    "SELECT uuid FROM ({}) k WHERE NOT EXISTS (SELECT 1 FROM readings WHERE uuid = k.uuid AND c IS NOT NULL)"
    " AND NOT EXISTS (SELECT 1 FROM nodes WHERE uuid = k.uuid AND retired IS NOT NULL)"
    " AND NOT EXISTS (SELECT 1 FROM tombstones WHERE uuid = k.uuid)"
    # one look-up per node, for a few nodes
    " AND NOT EXISTS (SELECT 1 FROM revocations WHERE uuid = k.uuid) ORDER BY uuid"
)


@dataclass(frozen=True)
class Search:
    """Criteria for nodes; a node must meet all fields that are set.

    ``text``: any part of UUID, name or profile; ``state``: a number of Identify, ``moved``, ``revoked``, ``retired`` or
    ``unseen``; ``due``: the day (ISO 8601) by which a calibration ends; ``since``: seen at this moment or later.
    """

    text: str | None = None
    state: str | int | None = None
    profile: str | None = None
    group: str | None = None
    due: str | None = None
    since: str | None = None


@dataclass(frozen=True)
class NodeOverview:
    """One node across all tables; None and empty for what they lack."""

    uuid: bytes
    node: dict[str, Any] | None
    whitelist: dict[str, Any] | None
    moved: dict[str, str] | None
    revoked: dict[str, str] | None
    rotation: str | None
    keys: list[dict[str, Any]] = field(default_factory=list)
    holders: list[dict[str, str]] = field(default_factory=list)
    groups: list[str] = field(default_factory=list)
    origin: Origin | None = None


@dataclass(frozen=True)
class WaitingNodes:
    """Nodes that wait for an operator, by UUID."""

    overdue: tuple[bytes, ...]
    twice: tuple[bytes, ...]
    drafts: tuple[bytes, ...]
    unverified: tuple[bytes, ...]
    rotations: tuple[bytes, ...]


class Overview:
    """All that one station knows of its nodes, across all topics; read only."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def find(self, search: Search) -> list[bytes]:
        """Return the UUIDs of the nodes that are meant, ascending."""
        terms, values = _terms(search)
        statement = f"""SELECT k.uuid FROM {_KNOWN} k LEFT JOIN nodes n ON n.uuid = k.uuid
            LEFT JOIN whitelist w ON w.uuid = k.uuid WHERE {" AND ".join(terms) or "1"} ORDER BY k.uuid"""
        return [bytes(uuid) for (uuid,) in self._store.execute(statement, values)]

    def nodes(self, uuids: Sequence[bytes]) -> Iterator[NodeOverview]:
        """Give what is known of these nodes, in their order, a chunk at a time; holds no lock between chunks."""
        for first in range(0, len(uuids), CHUNK):
            yield from self._chunk(uuids[first : first + CHUNK])

    def waiting(self, today: str, sample: RowSample) -> WaitingNodes:
        """Return the nodes that wait for an operator; ``today`` is a day, ISO 8601.

        With a ``sample`` of many nodes only those keyed last are compared by name, and with what was verified.
        """

        def some(statement: str, *values: Any) -> tuple[bytes, ...]:
            return tuple(bytes(uuid) for (uuid,) in self._store.execute(statement, values))

        newest = sample.newest_keyed(self._store)
        return WaitingNodes(
            some("SELECT uuid FROM nodes WHERE due < ? ORDER BY due, uuid", today),
            some(
                f"SELECT uuid FROM nodes WHERE name IN ({_OTHERS_NAMES.format(newest) if newest else _NAMES_TWICE})"
                " ORDER BY name, uuid"
            ),
            some("SELECT uuid FROM drafts ORDER BY uuid"),
            some(_UNVERIFIED_OF.format(newest) if newest else _UNVERIFIED),
            some("SELECT uuid FROM marks WHERE rotation IS NOT NULL ORDER BY uuid"),
        )

    def is_known(self, uuid: bytes) -> bool:
        """Return True if anything is known of a node."""
        row = self._store.first_row(f"SELECT {_IS_KNOWN}", (uuid,))
        return row is not None and bool(row[0])

    def _chunk(self, uuids: Sequence[bytes]) -> Iterator[NodeOverview]:
        nodes = self._rows("nodes", _NODE, uuids)
        whitelist = self._rows("whitelist", ("fingerprint", "assurance", "name", "added"), uuids)
        moved = self._rows("tombstones", ("to_fingerprint", "handover_id"), uuids)
        revoked = self._rows("revocations", ("why", "created"), uuids)
        marks = self._rows("marks", ("rotation",), uuids)
        keys = self._lists(
            "keys", ("key_id", "epoch", "state", "source", "created"), uuids, "state = 'active', seq DESC"
        )
        holders = self._lists("holders", ("fingerprint", "mode", "since"), uuids, "since, fingerprint")
        groups = self._lists("group_members", ("name",), uuids, "name")
        origins = self._origins(uuids)
        for uuid in uuids:
            yield NodeOverview(
                uuid,
                nodes.get(uuid),
                whitelist.get(uuid),
                moved.get(uuid),
                revoked.get(uuid),
                (marks.get(uuid) or {}).get("rotation"),
                keys.get(uuid, []),
                holders.get(uuid, []),
                [group["name"] for group in groups.get(uuid, [])],
                origins.get(uuid),
            )

    def _origins(self, uuids: Sequence[bytes]) -> dict[bytes, Origin]:
        """Return what the wrapped ones of these nodes wrap, by their last datasheet; few images are read for it.

        Only a node whose reading lists a TEDS at the place of the Origin TEDS has its image looked at.
        """
        listed = self._store.execute(
            f"SELECT uuid FROM readings WHERE uuid IN ({places(uuids)}) AND instr(digests, ?) > 0", [*uuids, _ORIGIN]
        )
        found: dict[bytes, Origin] = {}
        for (uuid,) in listed:
            row = self._store.first_row(
                "SELECT blocks FROM datasheets WHERE uuid = ? ORDER BY row DESC LIMIT 1", (uuid,)
            )
            try:
                origin = origin_of(unpacked(uuid, row[0]).blocks) if row is not None else None
            except ValueError:  # reading the datasheet itself reports the damage
                continue
            if origin is not None:
                found[bytes(uuid)] = origin
        return found

    def _rows(self, table: str, columns: Sequence[str], uuids: Sequence[bytes]) -> dict[bytes, dict[str, Any]]:
        return {uuid: rows[0] for uuid, rows in self._lists(table, columns, uuids, "uuid").items()}

    def _lists(
        self, table: str, columns: Sequence[str], uuids: Sequence[bytes], order: str
    ) -> dict[bytes, list[dict[str, Any]]]:
        rows = self._store.execute(
            f"SELECT uuid, {', '.join(columns)} FROM {table} WHERE uuid IN ({places(uuids)}) ORDER BY {order}", uuids
        )
        found: dict[bytes, list[dict[str, Any]]] = {}
        for uuid, *values in rows:
            found.setdefault(uuid, []).append(dict(zip(columns, values, strict=True)))
        return found


_ORIGIN = ORIGIN[0].to_bytes(2, "big") + bytes([ORIGIN[1]])
_NODE = (
    "point", "name", "profile", "state", "epoch", "sequence", "can_address", "teds_sha256", "retired",
    "last_seen", "channels", "due", "charging",
)  # fmt: skip


def _terms(search: Search) -> tuple[list[str], list[Any]]:
    terms: list[str] = []
    values: list[Any] = []

    def add(term: str, *more: Any) -> None:
        terms.append(term)
        values.extend(more)

    if search.text is not None:
        part = search.text.strip()
        digits = part.lower().removeprefix("0x")
        named = f"instr(lower({_NAME}), lower(?)) OR instr(lower(coalesce(n.profile, '')), lower(?))"
        if digits and len(digits) <= 2 * UUID_OCTETS and not set(digits) - set("0123456789abcdef"):
            add(f"(instr(lower(hex(k.uuid)), ?) OR {named})", digits, part, part)
        else:
            add(f"({named})", part, part)
    if search.profile is not None:
        add("n.profile = ?", search.profile)
    if search.group is not None:
        add("k.uuid IN (SELECT uuid FROM group_members WHERE name = ?)", search.group)
    if search.due is not None:
        add("n.due <= ?", search.due)
    if search.since is not None:
        add("n.last_seen >= ?", search.since)
    if search.state is not None:
        _add_state(search.state, add)
    return terms, values


def _add_state(state: str | int, add: Any) -> None:
    tables = {"moved": "tombstones", "revoked": "revocations"}
    seen = "(n.last_seen IS NOT NULL OR n.point IS NOT NULL)"
    if isinstance(state, int):
        add(f"n.state = ? AND {seen}", state)
    elif state in tables:
        add(f"k.uuid IN (SELECT uuid FROM {tables[state]})")
    elif state == "retired":
        add("n.retired IS NOT NULL")
    else:
        add(f"(n.uuid IS NULL OR NOT {seen})")
