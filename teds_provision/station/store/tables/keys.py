"""The wrapped link keys: pending ones beside the active one (profile.md, "Key agreement")."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from teds_provision.errors import NotFoundError
from teds_provision.station.store.database import Database, places
from teds_provision.station.store.records import KeyRecord

_COLUMNS = "seq, uuid, epoch, key_id, state, slot, wrapped, source, created"


class KeyTables:
    """The part of the store that is about link keys; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    def keys(self, uuid: bytes) -> list[KeyRecord]:
        """Return the keys of a node in the order to try them: newest pending first, the active one last."""
        statement = f"SELECT {_COLUMNS} FROM keys WHERE uuid = ? ORDER BY state = 'active', seq DESC"
        return list(self._database.recall(_key, statement, (uuid,)))

    def keys_of(self, uuids: Sequence[bytes]) -> list[KeyRecord]:
        """Return the keys of these nodes (a page of them), in the order they came."""
        return self._database.read(
            _key, f"SELECT {_COLUMNS} FROM keys WHERE uuid IN ({places(uuids)}) ORDER BY seq", uuids
        )

    def next_slot(self, uuid: bytes) -> int:
        """Return a slot number that this node never had; to be asked before wrapping a new key."""
        rows = self._database.execute(
            "INSERT INTO key_slots VALUES(?, 1) ON CONFLICT(uuid) DO UPDATE SET last = last + 1 RETURNING last", (uuid,)
        )
        return int(rows[0][0])

    def add_key(self, record: KeyRecord) -> None:
        """Keep a key durably before returning; one that is there already (same node and key id) stays as it is.

        ``record.seq`` is ignored, the store gives the next. Raises StoreError, also for a second active key.
        """
        with self._database.together():
            self._database.execute(
                "INSERT INTO key_slots VALUES(?, ?) ON CONFLICT(uuid) DO UPDATE SET last = max(last, excluded.last)",
                (record.uuid, record.slot),
            )
            self._database.execute(
                "INSERT INTO keys(uuid, epoch, key_id, state, slot, wrapped, source, created) VALUES(?,?,?,?,?,?,?,?)"
                " ON CONFLICT(uuid, key_id) DO NOTHING",
                (
                    record.uuid,
                    record.epoch,
                    record.key_id,
                    record.state,
                    record.slot,
                    record.wrapped,
                    record.source,
                    record.created,
                ),
            )

    def activate_key(self, uuid: bytes, key_id: str) -> None:
        """Make this key the active one; another active one goes, pending ones stay. Raises NotFoundError."""
        with self._database.together():
            if not self._database.one("SELECT 1 FROM keys WHERE uuid = ? AND key_id = ?", (uuid, key_id)):
                raise NotFoundError(f"The store has no key {key_id} of node {uuid.hex()}.")
            self._database.execute(
                "DELETE FROM keys WHERE uuid = ? AND key_id <> ? AND state = 'active'", (uuid, key_id)
            )
            self._database.execute(
                "UPDATE keys SET state = 'active' WHERE uuid = ? AND key_id = ? AND state <> 'active'", (uuid, key_id)
            )

    def count_as_imported(self, uuid: bytes) -> None:
        """Have no pending key of a node count as agreed on here: a rotation became due after it was made."""
        self._database.execute("UPDATE keys SET source = 'import' WHERE uuid = ? AND state = 'pending'", (uuid,))

    def remove_keys(self, uuid: bytes) -> int:
        """Delete every key of a node (decommission); returns how many there were."""
        return self._database.change("DELETE FROM keys WHERE uuid = ?", (uuid,))

    def remove_key(self, uuid: bytes, key_id: str) -> bool:
        """Delete one key of a node; False if there is none of that id."""
        return self._database.change("DELETE FROM keys WHERE uuid = ? AND key_id = ?", (uuid, key_id)) > 0

    def all_keys(self) -> Iterator[KeyRecord]:
        """Give every key of every node, in the order they came, a page at a time."""
        return self._database.stream(_key, f"SELECT {_COLUMNS} FROM keys WHERE seq > ? ORDER BY seq LIMIT ?")

    def all_key_names(self) -> Iterator[tuple[bytes, str, int, str]]:
        """Give UUID, key id, epoch and state of every key, in the order they came, a page at a time."""
        statement = "SELECT seq, uuid, key_id, epoch, state FROM keys WHERE seq > ? ORDER BY seq LIMIT ?"
        return self._database.stream(_key_name, statement)

    def replace_keys(self, rewrap: Callable[[KeyRecord], bytes]) -> int:
        """Wrap every key again (a change of the master key), all or none; return how many.

        ``rewrap`` gets each record and returns the new wrapped octets; an error that it raises leaves all as it was.
        """
        count = 0
        with self._database.together():
            for record in self.all_keys():
                self._database.execute("UPDATE keys SET wrapped = ? WHERE seq = ?", (rewrap(record), record.seq))
                count += 1
        return count


def _key_name(seq: int, *row: Any) -> tuple[bytes, str, int, str]:
    uuid, key_id, epoch, state = row
    return uuid, key_id, epoch, state


def _key(seq: int, *row: Any) -> KeyRecord:
    values = (*row, seq)
    return KeyRecord(*values)
