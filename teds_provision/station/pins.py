"""Pins (the identity key of each UUID) and the whitelist of nodes; decided only here."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any, Final

from teds_provision.protocol import keys
from teds_provision.protocol.fingerprints import is_whole, same_key
from teds_provision.station.datasheets import Datasheets
from teds_provision.station.node_keys import NodeKeys
from teds_provision.station.nodes import Nodes
from teds_provision.station.plant.plant import Plant
from teds_provision.station.row_macs import MacRow, RowMacs, changed
from teds_provision.station.store.database import CHUNK
from teds_provision.station.store.records import ExportEligibility, NewPin, NodeRecord, WhitelistEntry
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

_values_but_mac = attrgetter(*(column.name for column in fields(WhitelistEntry) if column.name != "mac"))
_BOUND: Final = ("uuid", "fingerprint", "assurance", "name")
_BOUND_COLUMNS: Final = ", ".join(_BOUND)
_bound = attrgetter(*_BOUND)

RECORD_AGAIN: Final = 600.0
"""Seconds in which a process records one wrong key of a UUID.

Any device on a bus can show wrong keys, and a new one each time; a service that looks at each would fill the disk with
its audit log.
"""


class Pins:
    """The whitelist, and the key of each UUID: by the whitelist, else from the first proven contact.

    With an open vault every row that is used has to carry its row MAC: StoreChangedError otherwise.
    """

    def __init__(
        self, store: Store, nodes: Nodes, datasheets: Datasheets, keys: NodeKeys, row_macs: RowMacs, plant: Plant
    ) -> None:
        self._store = store
        self._nodes = nodes
        self._datasheets = datasheets
        self._keys = keys
        self._row_macs = row_macs
        self._plant = plant
        self._recorded: dict[bytes, tuple[float, int]] = {}

    def pinned(self, uuid: bytes) -> str | None:
        """Return the fingerprint of the key that this UUID has to show, None if none is known yet.

        Its first 32 digits or more if an operator gave no more and the node was not met since.
        """
        entry = self.entry(uuid)
        pin = entry.fingerprint if entry is not None else None
        if is_whole(pin):
            return pin
        node = self._nodes.get(uuid)
        if node is None or node.point is None:
            return pin
        self._nodes.check_point(node)
        return _wholer(pin, keys.fingerprint(node.point))

    def all(self, nodes: Iterable[NodeRecord] | None = None) -> dict[bytes, str]:
        """Return the fingerprint of every pinned UUID.

        ``nodes`` are all of the store if they have been read already.
        """
        return self.pinned_among(self._nodes.all() if nodes is None else nodes, self.whitelist())

    def pinned_among(
        self, nodes: Iterable[NodeRecord | ExportEligibility], entries: Iterable[WhitelistEntry]
    ) -> dict[bytes, str]:
        """Return the pinned fingerprint of each of these nodes and entries, by UUID."""
        pins: dict[bytes, str] = {}
        for node in nodes:
            if node.point is not None:
                self._nodes.check_point(node)
                pins[node.uuid] = keys.fingerprint(node.point)
        for entry in entries:
            if entry.fingerprint is not None:
                seen = pins.get(entry.uuid)
                if entry.fingerprint != seen:
                    pins[entry.uuid] = _wholer(entry.fingerprint, seen)
        return pins

    def pinned_elsewhere(self, nodes: Sequence[NodeRecord | ExportEligibility]) -> set[bytes]:
        """Return those of a chunk of nodes that the whitelist pins to another key than the one they showed last.

        No entries are made of the rows, as a handover asks for thousands.
        """
        statement, uuids = f"SELECT {_BOUND_COLUMNS}, mac FROM whitelist", [node.uuid for node in nodes]
        pins: dict[bytes, str | None] = {}
        for *values, mac in self._store.rows_of_nodes(statement, uuids):
            self._check_values(tuple(values), mac)
            pins[values[0]] = values[1]
        elsewhere = set()
        for node in nodes:
            if node.point is not None:
                self._nodes.check_point(node)
                pin = pins.get(node.uuid)
                if pin is not None:
                    shown = keys.fingerprint(node.point)
                    if pin != shown and not same_key(pin, shown):
                        elsewhere.add(node.uuid)
        return elsewhere

    def check(self, uuid: bytes, point: bytes) -> None:
        """Raise KeyMismatchError if this UUID is known with another key than ``point``."""
        pinned = self.pinned(uuid)
        if pinned is not None and not same_key(pinned, keys.fingerprint(point)):
            self._record(uuid, keys.fingerprint(point), pinned)
            raise keys.other_key(pinned, point)

    def _record(self, uuid: bytes, shown: str, pinned: str) -> None:
        """Record one audit entry per :data:`RECORD_AGAIN`; ``unrecorded`` counts what happened since the last."""
        now = time.monotonic()
        at, passed_over = self._recorded.get(uuid, (-RECORD_AGAIN, 0))
        if now - at < RECORD_AGAIN:
            self._recorded[uuid] = at, passed_over + 1
            return
        more = {"unrecorded": passed_over} if passed_over else {}
        self._store.audit.append("identify", uuid, "other key", {"shown": shown, "pinned": pinned, **more})
        self._recorded[uuid] = now, 0

    # -- the whitelist ---------------------------------------------------------------------------------------------

    def whitelist(self) -> list[WhitelistEntry]:
        """Return all entries, by UUID."""
        entries = self._store.read(WhitelistEntry, "SELECT * FROM whitelist ORDER BY uuid")
        for entry in entries:
            self._checked(entry)
        return entries

    def all_entries(self) -> Iterator[WhitelistEntry]:
        """Give all entries, by UUID, a chunk at a time, for lists; holds no lock between chunks."""
        after = b""
        while chunk := self._store.read(
            WhitelistEntry, "SELECT * FROM whitelist WHERE uuid > ? ORDER BY uuid LIMIT ?", (after, CHUNK)
        ):
            yield from map(self._checked, chunk)
            after = chunk[-1].uuid

    def _checked(self, entry: WhitelistEntry) -> WhitelistEntry:
        """Return an entry; raise StoreChangedError if its MAC does not hold. Unchecked with a closed vault."""
        self._check_values(_bound(entry), entry.mac)
        return entry

    def _check_values(self, values: tuple[Any, ...], mac: bytes | None) -> None:
        if not self._row_macs.counts(mac, "whitelist", values):
            raise changed(
                [f"the whitelist entry of {values[0].hex()}"], "Remove it from the whitelist and add it again."
            )

    def entry(self, uuid: bytes) -> WhitelistEntry | None:
        """Return the whitelist entry of a node, None if it is not on it."""
        entry = self.row(uuid)
        return None if entry is None else self._checked(entry)

    def row(self, uuid: bytes) -> WhitelistEntry | None:
        """Return the row as :meth:`entry` does, whatever its MAC, for a caller that replaces or removes it."""
        return self._store.read_one(WhitelistEntry, "SELECT * FROM whitelist WHERE uuid = ?", (uuid,))

    def get_many(self, uuids: Sequence[bytes]) -> dict[bytes, WhitelistEntry]:
        """Return the entries of a chunk of nodes, by UUID."""
        entries = self._store.read_of_nodes(WhitelistEntry, "SELECT * FROM whitelist", uuids)
        return {entry.uuid: self._checked(entry) for entry in entries}

    def put(self, *entries: WhitelistEntry) -> None:
        """Add or replace entries of the whitelist (the vault opens); the caller has held keys against pinned ones."""
        self._row_macs.require()
        with self._store.together():
            for entry in entries if self._plant.joined is not None else ():
                self._report_pin(entry)
            self.put_many(entries)

    def put_many(self, entries: Iterable[WhitelistEntry]) -> None:
        """Add or replace entries, each with its MAC, without a report to the plant; inside a transaction."""
        mac = self._row_macs.mac
        self._put_rows((*_values_but_mac(entry), mac("whitelist", _bound(entry))) for entry in entries)

    def add_many(self, pins: Iterable[NewPin]) -> None:
        """Add entries as :meth:`put_many` does, of nodes that have none."""
        mac = self._row_macs.mac
        self._put_rows(
            (uuid, fingerprint, added, assurance, name, mac("whitelist", (uuid, fingerprint, assurance, name)))
            for uuid, fingerprint, added, assurance, name in pins
        )

    def restore(self, entries: Iterable[WhitelistEntry]) -> None:
        """Add or replace entries with the MACs that they have: they come from a backup."""
        self._put_rows((*_values_but_mac(entry), entry.mac) for entry in entries)

    def _put_rows(self, rows: Iterable[tuple[object, ...]]) -> None:
        self._store.execute_many("INSERT OR REPLACE INTO whitelist VALUES(?, ?, ?, ?, ?, ?)", rows)

    def _report_pin(self, entry: WhitelistEntry) -> None:
        """Report a new pin of this station to the plant."""
        before = self.row(entry.uuid)
        if entry.name != (before.name if before is not None else None):
            self._plant.record_name(entry.uuid, entry.name)
        if entry.fingerprint is None or not is_whole(entry.fingerprint) or entry.assurance == "registry":
            return
        if before is None or (before.fingerprint, before.assurance) != (entry.fingerprint, entry.assurance):
            self._plant.record_event("pinned", entry.uuid, fingerprint=entry.fingerprint, assurance=entry.assurance)

    def remove(self, uuid: bytes) -> bool:
        """Take a node off the whitelist (the vault opens); False if it was not on it. A contact's key stays pinned."""
        self._row_macs.require()
        with self._store.together():
            entry = self.row(uuid) if self._plant.joined is not None else None
            if entry is not None and is_whole(entry.fingerprint) and entry.assurance != "registry":
                self._plant.record_event("unpinned", uuid)
            return self._store.change("DELETE FROM whitelist WHERE uuid = ?", (uuid,)) > 0

    def mac_rows(self, sample: RowSample) -> Iterator[MacRow]:
        """Yield the entries, for a check of their MACs."""
        rows = sample.rows(self._store, "whitelist")
        for entry in self._store.read(WhitelistEntry, f"SELECT * FROM whitelist WHERE {rows} ORDER BY uuid"):
            yield f"the whitelist entry of {entry.uuid.hex()}", entry.mac, "whitelist", _bound(entry)

    # -- a board that was replaced, with the same UUID -------------------------------------------------------------

    def unpin(self, uuid: bytes) -> None:
        """Forget the pinned key; the link keys that are held still belong to the board that had it."""
        self._row_macs.require()
        entry, node = self.row(uuid), self._nodes.get(uuid)  # also with a wrong MAC, since the row is removed
        pinned = entry.fingerprint if entry is not None else None
        if not is_whole(pinned) and node is not None and node.point is not None:
            pinned = _wholer(pinned, keys.fingerprint(node.point))
        if pinned is not None and is_whole(pinned):  # otherwise no board was met, and so no key was agreed on
            self._keys.set_former(uuid, pinned)
            self._datasheets.drop_draft(uuid)  # it may hold the old board's calibration
        with self._store.together():
            self._nodes.unpin(uuid)
            self._datasheets.forget_reading(uuid)  # it is of the old board

    def epoch_to_exceed(self, uuid: bytes, pinned: str | None) -> int:
        """Return the epoch that an agreement must exceed: the active key's, 0 for a board that never agreed it."""
        former = self._keys.former(uuid)
        return 0 if former and pinned and not same_key(former, pinned) else self._keys.active_epoch(uuid)

    def is_unsettled(self, uuid: bytes) -> bool:
        """Return True if the held link keys may belong to a board that was replaced since."""
        return self._keys.former(uuid) is not None

    def settled(self, uuid: bytes) -> None:
        """Record that a session is open: the key in use belongs to the present board."""
        self._keys.set_former(uuid, None)


def _wholer(pin: str | None, seen: str | None) -> str:
    """Return the pin of the whitelist, or the key that was seen if the pin is only its beginning."""
    if pin is None or (seen is not None and same_key(pin, seen)):
        return seen or ""
    return pin
