"""The link keys that this station holds, whose CA each node keeps, who else holds a key, and which rotation is due."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from datetime import UTC, datetime, timedelta
from operator import attrgetter
from typing import Any, Final

from teds_provision.errors import (
    KeyringUnavailableError,
    NotFoundError,
    UnknownMasterKeyError,
    VaultChangedError,
    VaultError,
    VaultLockedError,
    WrongPassphraseError,
)
from teds_provision.station.identity import StationIdentity
from teds_provision.station.plant.plant import Plant
from teds_provision.station.row_macs import MacRow, RowMacs, changed
from teds_provision.station.store.database import chunks
from teds_provision.station.store.records import Holder, KeyFlags, KeyRecord, KeySource, utc_now
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store
from teds_provision.vault.base import Vault, node_key_context

MAX_PENDING = 8
"""So many keys of one node may wait for their proof at a time (issue 7 L4)."""

_NO_FLAGS: Final = KeyFlags()
_COLUMNS: Final = "seq, uuid, epoch, key_id, state, slot, wrapped, source, created"
_COLUMNS_IN_ORDER: Final = ", ".join(column.name for column in fields(KeyRecord))
_FLAG_COLUMNS: Final = ("uuid", *(column.name for column in fields(KeyFlags)))
_FLAGS: Final = ", ".join(_FLAG_COLUMNS[1:])
_flag_values = attrgetter(*_FLAG_COLUMNS[1:])
_key_values, _holder_values = (attrgetter(*(column.name for column in fields(kind))) for kind in (KeyRecord, Holder))
_ADD_KEY: Final = (
    "INSERT INTO keys(uuid, epoch, key_id, state, slot, wrapped, source, created) VALUES(?,?,?,?,?,?,?,?)"
    " ON CONFLICT(uuid, key_id) DO NOTHING"
)
_USE_SLOT: Final = "INSERT INTO key_slots VALUES(?, ?) ON CONFLICT(uuid) DO UPDATE SET last = max(last, excluded.last)"
_PUT_HOLDER: Final = "INSERT OR REPLACE INTO holders VALUES(?, ?, ?, ?)"

RESTORED = "restored from a backup"
"""Prefix of the reason of a rotation that needs a tap or an operator: other holders of that key are unknown."""
REMOVED: Final = "registry: "
"""Begins the reason of a rotation that is due because a station was removed from the plant."""
_FROM: Final = f"{REMOVED}from "
STOLEN = "registry: stolen: "
"""Begins the reason of a rotation for which a running session ends at once: a thief has that key."""
CONFIRM_MAY_ARRIVE = timedelta(minutes=2)
"""For how long after an agreement its Confirm may still reach the node: 60 s of the profile, and a bus that is slow."""


def deferred(begins: datetime, why: str) -> str:
    """Return the reason of a rotation that another station is to do first; this one does it from ``begins`` on."""
    return f"{_FROM}{begins:%Y-%m-%dT%H:%M:%SZ}: {why}"


def deferred_until(why: str) -> str | None:
    """Return when this station does a rotation that another one is to do first; None for its own rotation."""
    return why[len(_FROM) :].partition("Z")[0] + "Z" if why.startswith(_FROM) else None


@dataclass(frozen=True)
class NodeKey:
    """One unwrapped link key that this station holds for a node."""

    record: KeyRecord
    key: bytes

    def __repr__(self) -> str:
        return f"NodeKey({self.record.key_id}, {self.record.state})"


class NodeKeys:
    """The link keys of one station: wrapped in the store, opened by the vault."""

    def __init__(
        self,
        store: Store,
        vault: Callable[[], Vault],
        identity: StationIdentity,
        row_macs: RowMacs,
        reopened: Callable[[], Vault],
        plant: Plant,
    ) -> None:
        self._plant = plant
        self._store = store
        self._vault = vault
        self._identity = identity
        self._row_macs = row_macs
        self._reopened = reopened

    def keys_of(self, uuid: bytes) -> list[KeyRecord]:
        """Return the keys of a node, wrapped, in the order to try them: newest pending first, the active one last."""
        statement = f"SELECT {_COLUMNS} FROM keys WHERE uuid = ? ORDER BY state = 'active', seq DESC"
        return list(self._store.recall(_key, statement, (uuid,)))

    def all(self) -> Iterator[KeyRecord]:
        """Give every key of every node, wrapped, in the order they came, a chunk at a time."""
        return self._store.stream(_key, f"SELECT {_COLUMNS} FROM keys WHERE seq > ? ORDER BY seq LIMIT ?")

    def all_key_names(self) -> Iterator[tuple[bytes, str, int, str]]:
        """Give UUID, key id, epoch and state of every key, in the order they came, a chunk at a time."""
        statement = "SELECT seq, uuid, key_id, epoch, state FROM keys WHERE seq > ? ORDER BY seq LIMIT ?"
        return self._store.stream(_key_name, statement)

    def held(self, uuid: bytes) -> bool:
        """Return True if any key is held for a node."""
        return bool(self.keys_of(uuid))

    def unwrapped(self, uuid: bytes) -> Iterator[NodeKey]:
        """Yield every key held for a node in the order of trying: newest pending first, the active one last.

        One that cannot be unwrapped does not hide the others; VaultError comes after the last.
        """
        damaged: VaultError | None = None
        for record in self.keys_of(uuid):
            try:
                key = self.unwrap(record)
            except (WrongPassphraseError, KeyringUnavailableError, VaultLockedError):
                raise
            except VaultError as failure:
                damaged = failure
                continue
            yield NodeKey(record, key)
        if damaged is not None:
            raise damaged

    def active_epoch(self, uuid: bytes) -> int:
        """Return the epoch of the active key of a node, 0 for none."""
        return next((record.epoch for record in self.keys_of(uuid) if record.state == "active"), 0)

    def get_many(self, uuids: Sequence[bytes]) -> list[KeyRecord]:
        """Return the keys of a chunk of nodes, wrapped, in the order they came."""
        found = self._store.read_of_nodes(KeyRecord, f"SELECT {_COLUMNS_IN_ORDER} FROM keys", uuids)
        return sorted(found, key=attrgetter("seq"))

    def slots_of(self, uuids: Sequence[bytes]) -> dict[bytes, int]:
        """Return the last slot given to the keys of each of these nodes (a chunk of them)."""
        return dict(self._store.read_of_nodes(_slot, "SELECT uuid, last FROM key_slots", uuids))

    def next_slot(self, uuid: bytes) -> int:
        """Return a slot number that this node never had; to be asked before wrapping a new key."""
        rows = self._store.execute(
            "INSERT INTO key_slots VALUES(?, 1) ON CONFLICT(uuid) DO UPDATE SET last = last + 1 RETURNING last", (uuid,)
        )
        return int(rows[0][0])

    def add(self, *records: KeyRecord) -> None:
        """Keep keys, all or none; one that is there already (same node and key id) stays as it is.

        ``seq`` is ignored, the store gives the next. Raises StoreError, also for a second active key.
        """
        with self._store.together():
            self._store.execute_many(_USE_SLOT, ((record.uuid, record.slot) for record in records))
            self._store.execute_many(_ADD_KEY, (_key_values(record)[:-1] for record in records))

    def add_pending(self, uuid: bytes, *, key: bytes, key_id: bytes, epoch: int) -> None:
        """Store a new key durably as pending; of the others only the oldest pending one goes, beyond eight.

        The newest are tried first, and a node knows one unproven key at most. The limit keeps an attacker who forces
        agreements from filling the disk.
        """
        with self._store.together():
            self.refresh()
            pending = [record for record in self.keys_of(uuid) if record.state == "pending"]
            for record in pending[MAX_PENDING - 1 :]:
                self._delete(uuid, record.key_id)
            slot = self.next_slot(uuid)
            self.add(
                self.wrapped(
                    uuid, key=key, key_id=key_id, epoch=epoch, slot=slot, source="agreement", created=utc_now()
                )
            )

    def refresh(self) -> None:
        """Read the vault again if another process has changed the master key (vault rewrap).

        To be called inside a transaction, before keys are wrapped in it: then no such change comes in between.
        """
        if self._identity.master not in self._vault().masters():
            self._reopened()

    def wrapped(
        self, uuid: bytes, *, key: bytes, key_id: bytes, epoch: int, slot: int, source: KeySource, created: str
    ) -> KeyRecord:
        """Return the record of a new pending key in a slot that the node never had.

        To be called inside the transaction that keeps it, after :meth:`refresh`.
        """
        context = node_key_context(self._store.id, uuid, epoch, slot)
        sealed = self._vault().wrap(key, context=context)
        return KeyRecord(uuid, epoch, key_id.hex(), "pending", slot, sealed, source, created)

    def unwrap(self, record: KeyRecord) -> bytes:
        """Return a link key in the clear.

        A record that was read before another command changed the master key is read again, and so is the vault. Raises
        VaultError if it is damaged or of another vault.
        """
        try:
            return self._unwrapped(record, self._vault())
        except UnknownMasterKeyError:  # the record or the vault was read before the master key changed
            vault = self._reopened()
        there = (held for held in self.keys_of(record.uuid) if held.key_id == record.key_id)
        fresh = next(there, record)
        try:
            return self._unwrapped(fresh, vault)
        except UnknownMasterKeyError:
            if self._identity.master in vault.masters():  # the key is damaged; it was not just read too early
                raise
        raise VaultChangedError("Another command has just changed the master key.", hint="Run this again.")

    def unwrap_named(self, key_ids: Mapping[bytes, str]) -> dict[bytes, tuple[int, bytes]]:
        """Return epoch and key in the clear of a chunk of nodes, by UUID: of each the key with this id.

        A node without that key is left out. No records are made, as a handover needs thousands of keys. Raises as
        :meth:`unwrap`.
        """
        statement = "SELECT uuid, key_id, epoch, slot, wrapped FROM keys"
        rows = [row for row in self._store.rows_of_nodes(statement, list(key_ids)) if key_ids[row[0]] == row[1]]
        vault, store = self._vault(), self._store.id
        try:
            return {
                uuid: (epoch, vault.unwrap(wrapped, context=node_key_context(store, uuid, epoch, slot)))
                for uuid, _, epoch, slot, wrapped in rows
            }
        except UnknownMasterKeyError:  # as in unwrap(): the rows or the vault were read before the change
            named = (key for key in self.get_many(list(key_ids)) if key_ids[key.uuid] == key.key_id)
            return {key.uuid: (key.epoch, self.unwrap(key)) for key in named}

    def _unwrapped(self, record: KeyRecord, vault: Vault) -> bytes:
        context = node_key_context(self._store.id, record.uuid, record.epoch, record.slot)
        return vault.unwrap(record.wrapped, context=context)

    def outdated(self, record: KeyRecord) -> list[KeyRecord]:
        """Return the keys of a node that a good Open under ``record`` makes obsolete.

        A newer agreement may still become good: its Confirm can be held back on the way, until the node has forgotten
        the Request (60 seconds). Such a key stays, else a late Confirm would leave a node with a key that no station
        has.
        """
        late = (datetime.now(UTC) - CONFIRM_MAY_ARRIVE).strftime("%Y-%m-%dT%H:%M:%SZ")
        return [
            other
            for other in self.keys_of(record.uuid)
            if other.key_id != record.key_id
            and not (
                other.state == "pending"
                and other.source == "agreement"
                and other.epoch > record.epoch
                and other.created >= late
            )
        ]

    def promote(self, uuid: bytes, key_id: str) -> None:
        """Make a key the active one after a good Open under it; its CA is then the one that the node keeps.

        Raises NotFoundError for a key that is not held.
        """
        with self._store.together():
            record = next((held for held in self.keys_of(uuid) if held.key_id == key_id), None)
            if record is not None:
                for other in self.outdated(record):
                    self._delete(uuid, other.key_id)
            self.activate(uuid, key_id)
            flags = self._flags(uuid)
            if flags.next_ca is None:
                return
            self._set_flags(uuid, next_key_id=None, next_ca=None)
            if flags.next_key_id == key_id:
                self.set_ca_of(uuid, flags.next_ca)

    def remove(self, uuid: bytes) -> int:
        """Delete every key of a node; returns how many there were."""
        with self._store.together():
            self._report_forgotten(uuid, self.keys_of(uuid))
            return self._store.change("DELETE FROM keys WHERE uuid = ?", (uuid,))

    def _report_forgotten(self, uuid: bytes, gone: Sequence[KeyRecord]) -> None:
        """Report to the plant that no key up to these epochs is left here."""
        if gone and self._plant.joined is not None:
            self._plant.record_event("forgot", uuid, epoch=max(record.epoch for record in gone))

    def wrap_anew(self, rewrap: Callable[[KeyRecord], bytes]) -> int:
        """Wrap every key again (a change of the master key), all or none; return how many.

        ``rewrap`` gets each record and returns the new wrapped octets; an error that it raises leaves all as it was.
        """
        count = 0
        with self._store.together():
            for record in self.all():
                self._store.execute("UPDATE keys SET wrapped = ? WHERE seq = ?", (rewrap(record), record.seq))
                count += 1
        return count

    def activate(self, uuid: bytes, key_id: str) -> None:
        """Make this key the active one; another active one goes, pending ones stay. Raises NotFoundError."""
        with self._store.together():
            if not self._store.first_row("SELECT 1 FROM keys WHERE uuid = ? AND key_id = ?", (uuid, key_id)):
                raise NotFoundError(f"The store has no key {key_id} of node {uuid.hex()}.")
            self._store.execute("DELETE FROM keys WHERE uuid = ? AND key_id <> ? AND state = 'active'", (uuid, key_id))
            self._store.execute(
                "UPDATE keys SET state = 'active' WHERE uuid = ? AND key_id = ? AND state <> 'active'", (uuid, key_id)
            )

    def remove_key(self, uuid: bytes, key_id: str) -> bool:
        """Delete one key of a node; False if it is not held."""
        with self._store.together():
            before = self.keys_of(uuid)
            removed = self._delete(uuid, key_id)
            if removed and len(before) == 1:
                self._report_forgotten(uuid, before)
            return removed

    def _delete(self, uuid: bytes, key_id: str) -> bool:
        return self._store.change("DELETE FROM keys WHERE uuid = ? AND key_id = ?", (uuid, key_id)) > 0

    def correct_epoch(self, record: KeyRecord, epoch: int) -> KeyRecord:
        """Correct the epoch of a key, which was unverified, to the one that a node reported in a session.

        The key stays.

        The wrapped form is bound to the epoch, so it is made again, in one transaction.
        """
        with self._store.together():
            self.refresh()
            key = self.unwrap(record)
            slot = self.next_slot(record.uuid)
            context = node_key_context(self._store.id, record.uuid, epoch, slot)
            corrected = replace(record, epoch=epoch, slot=slot, wrapped=self._vault().wrap(key, context=context))
            self._delete(record.uuid, record.key_id)
            self.add(corrected)
        return corrected

    # -- the CA that a node keeps ----------------------------------------------------------------------------------

    def ca_of(self, uuid: bytes) -> bytes:
        """Return P(CA) that a node keeps: the owner's, or that of the bundle that brought its key."""
        flags = self._flags(uuid)
        if flags.ca is None:
            return self._identity.ca
        self._check_ca(uuid, flags.ca, flags.ca_mac)
        return flags.ca

    def cas_of_nodes(self) -> dict[bytes, bytes]:
        """Return P(CA) of every node that keeps another CA than the owner's."""
        return self._checked_cas(self.all_flags())

    def cas_among(self, uuids: Sequence[bytes]) -> dict[bytes, bytes]:
        """Return P(CA) of those of a chunk of nodes that keep another CA than the owner's."""
        return self._checked_cas(self._flags_of(uuids))

    def _checked_cas(self, flagged: Mapping[bytes, KeyFlags]) -> dict[bytes, bytes]:
        cas: dict[bytes, bytes] = {}
        for uuid, flags in flagged.items():
            if flags.ca is not None:
                self._check_ca(uuid, flags.ca, flags.ca_mac)
                cas[uuid] = flags.ca
        return cas

    def _check_ca(self, uuid: bytes, ca: bytes, mac: bytes | None) -> None:
        """Raise StoreChangedError if the CA that a node keeps is not the recorded one."""
        if not self._row_macs.counts(mac, "ca", (uuid, ca)):
            raise changed(
                [f"the CA of node {uuid.hex()}"], "Restore a backup, or reset the node and agree on a new key."
            )

    def set_ca_of(self, uuid: bytes, ca: bytes) -> None:
        """Note which CA a node keeps."""
        self._set_flags(uuid, ca=ca)

    def set_flags(self, changes: Mapping[bytes, Mapping[str, Any]]) -> None:
        """Change flags of many nodes at once, by the names of :class:`KeyFlags`; the owner's CA is none."""
        self._set_all_flags(
            changes, {uuid: m for chunk in chunks(changes) for uuid, m in self._flags_of(chunk).items()}
        )

    def _set_all_flags(self, changes: Mapping[bytes, Mapping[str, Any]], present: Mapping[bytes, KeyFlags]) -> None:
        own = self._identity.ca
        wanted: dict[bytes, KeyFlags] = {}
        for uuid, change in changes.items():
            before = present.get(uuid, _NO_FLAGS)
            ca = change.get("ca", before.ca)
            sealed: dict[str, bytes | None] = {}
            if ca == own:
                sealed = {"ca": None, "ca_mac": None}
            elif ca is not None and ca != before.ca:
                sealed = {"ca_mac": self._row_macs.mac("ca", (uuid, ca))}
            values = {**change, **sealed}
            after = (
                KeyFlags(**values) if before is _NO_FLAGS else replace(before, **values)
            )  # replace() takes four times as long
            if after.ca != before.ca or after != before:  # the former is quicker, and decides in a handover
                wanted[uuid] = after
        if wanted:
            self.put_flags(wanted)

    def _set_flags(self, uuid: bytes, **change: Any) -> None:
        self._set_all_flags({uuid: change}, {uuid: self._flags(uuid)})

    def _flags(self, uuid: bytes) -> KeyFlags:
        row = self._store.read_one(KeyFlags, f"SELECT {_FLAGS} FROM marks WHERE uuid = ?", (uuid,))
        return row or _NO_FLAGS

    def _flags_of(self, uuids: Sequence[bytes]) -> dict[bytes, KeyFlags]:
        """Return the flags of those of these nodes (a chunk of them) that have one."""
        return dict(self._store.read_of_nodes(_flagged, f"SELECT uuid, {_FLAGS} FROM marks", uuids))

    def all_flags(self, rows: str = "1") -> dict[bytes, KeyFlags]:
        """Return the flags of every node that has one; ``rows`` is a condition in SQL for the nodes that are meant."""
        return dict(self._store.read(_flagged, f"SELECT uuid, {_FLAGS} FROM marks WHERE {rows}"))

    def put_flags(self, flags: Mapping[bytes, KeyFlags]) -> None:
        """Keep the flags of nodes, with the MACs that they have, in place of those that are there.

        A node without any flag has no row.
        """
        without = [(uuid,) for uuid, kept in flags.items() if kept.ca is None and kept == _NO_FLAGS]
        gone = {uuid for (uuid,) in without}
        rows = ((uuid, *_flag_values(kept)) for uuid, kept in flags.items() if uuid not in gone)
        with self._store.together():
            self._store.execute_many("DELETE FROM marks WHERE uuid = ?", without)
            self._store.replace_rows("marks", _FLAG_COLUMNS, rows)

    def mac_rows(self, sample: RowSample) -> Iterator[MacRow]:
        """Yield the CAs of nodes that keep another one than the owner's, for a check of their MACs."""
        for uuid, flags in self.all_flags(sample.rows(self._store, "marks")).items():
            if flags.ca is not None:
                yield f"the CA of node {uuid.hex()}", flags.ca_mac, "ca", (uuid, flags.ca)

    # -- rotations and other holders -------------------------------------------------------------------------------

    def rotation_due(self, uuid: bytes) -> str | None:
        """Return why a node's key is to be rotated, None if it is not; :meth:`rotates_now`: by this station, today."""
        return self._flags(uuid).rotation

    def rotates_now(self, uuid: bytes) -> bool:
        """Return True if the next session with a node has to rotate its key first.

        False while another station is due to do so before.
        """
        why = self.rotation_due(uuid)
        begins = None if why is None else deferred_until(why)
        return why is not None and (begins is None or utc_now() >= begins)

    def rotations_due(self) -> dict[bytes, str]:
        """Return why a rotation is due, for every node that has one."""
        flags = self.all_flags()
        return {uuid: kept.rotation for uuid, kept in flags.items() if kept.rotation is not None}

    def due_among(self, uuids: Sequence[bytes]) -> set[bytes]:
        """Return those of a chunk of nodes whose key must be rotated."""
        flags = self._flags_of(uuids)
        return {uuid for uuid, kept in flags.items() if kept.rotation is not None}

    def restored(self, uuid: bytes) -> bool:
        """Return True if the keys of a node came back from a backup and none was agreed since."""
        return (self.rotation_due(uuid) or "").startswith(RESTORED)

    def stolen(self, uuid: bytes) -> str | None:
        """Return why a key must not even end its present session: a stolen station has had it. None if it may."""
        why = self.rotation_due(uuid) or ""
        return why if why.startswith(STOLEN) else None

    def demand_rotation(self, uuid: bytes, why: str) -> None:
        """Have the next session with a node rotate its key before anything else.

        Only a key that is agreed on from now on ends that: one that is pending already may be known to others.
        """
        self._set_flags(uuid, rotation=why)
        self._count_as_imported(uuid)

    def _count_as_imported(self, uuid: bytes) -> None:
        """Have no pending key of a node count as agreed on here: a rotation became due after it was made."""
        self._store.execute("UPDATE keys SET source = 'import' WHERE uuid = ? AND state = 'pending'", (uuid,))

    def rotated(self, uuid: bytes) -> None:
        """Note that a node has a key that no other station holds."""
        self._set_flags(uuid, rotation=None)
        for holder in self.holders(uuid):
            self.remove_holder(uuid, holder.fingerprint)

    def end_removal_mark(self, record: KeyRecord) -> None:
        """End a rotation that a removal demanded: a session was opened under a key that no removed station has had.

        Another holder has rotated the node. A key that only a page after the removed station's last one shows
        is found by the next review of removals.
        """
        if (self.rotation_due(record.uuid) or "").startswith(REMOVED) and not self._plant.removed_had(
            record.uuid, record.epoch, record.key_id, self.holders_of_key(record)
        ):
            self._set_flags(record.uuid, rotation=None)

    def former(self, uuid: bytes) -> str | None:
        """Return the fingerprint of the board that the link keys were agreed with, if it was unpinned since."""
        return self._flags(uuid).former

    def set_former(self, uuid: bytes, fingerprint: str | None) -> None:
        """Note which board the link keys were agreed with; None once a session has shown it."""
        self._set_flags(uuid, former=fingerprint)

    def holders(self, uuid: bytes | None = None) -> list[Holder]:
        """Return who else holds keys: of this node, or of all."""
        # the index is used: there may be 100,000 rows
        which, values = ("", ()) if uuid is None else ("WHERE uuid = ?", (uuid,))
        return self._store.read(Holder, f"SELECT * FROM holders {which} ORDER BY uuid, since, fingerprint", values)

    def all_holders(self) -> set[str]:
        """Return the fingerprints of all stations that hold a key of any node."""
        return {str(digits) for (digits,) in self._store.execute("SELECT DISTINCT fingerprint FROM holders")}

    def holders_of_key(self, record: KeyRecord) -> set[str]:
        """Return the stations that were noted as holders since this key came; earlier ones had the key before it."""
        return {holder.fingerprint for holder in self.holders(record.uuid) if holder.since >= record.created}

    def put_holder(self, *holders: Holder) -> None:
        """Note that other stations hold a key of these nodes."""
        self._store.execute_many(_PUT_HOLDER, map(_holder_values, holders))

    def remove_holder(self, uuid: bytes, fingerprint: str) -> bool:
        """Note that a station holds it no more (a rotation); False if it was not noted."""
        statement = "DELETE FROM holders WHERE uuid = ? AND fingerprint = ?"
        return self._store.change(statement, (uuid, fingerprint)) > 0


def _key_name(seq: int, *row: Any) -> tuple[bytes, str, int, str]:
    uuid, key_id, epoch, state = row
    return uuid, key_id, epoch, state


def _slot(uuid: bytes, last: int) -> tuple[bytes, int]:
    return bytes(uuid), int(last)


def _key(seq: int, *row: Any) -> KeyRecord:
    values = (*row, seq)
    return KeyRecord(*values)


def _flagged(uuid: bytes, *row: Any) -> tuple[bytes, KeyFlags]:
    return uuid, KeyFlags(*row)
