"""Parcels that leave and that came, and for whom a copy of which key was made (contract/plant.md section 4)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields
from typing import Literal

from teds_provision.station.store.database import places
from teds_provision.station.store.records import Direction, utc_now
from teds_provision.station.store.store import Store

ParcelKind = Literal["bundle", "receipt", "job", "sign-request", "signed"]
ParcelState = Literal["ready", "sent", "later", "waiting"]


@dataclass(frozen=True)
class ParcelRow:
    """One document for, or from, one station (``peer``, a fingerprint).

    Out: ``ready`` to be sent, ``sent``. In: ``later`` (judged again at the next sync), ``waiting`` for an operator.
    ``about`` is the id of the bundle that it is about, or H of a line's document; ``detail`` why it waits.
    """

    id: str
    direction: Direction
    peer: str
    kind: ParcelKind
    state: ParcelState
    expires: str
    about: str = ""
    detail: str = ""
    created: str = field(default_factory=utc_now)


_ROW = ", ".join(column.name for column in fields(ParcelRow))


class Parcels:
    """The parcels of one station, and the copies of keys that it made for others."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def forget_all(self) -> None:
        """Remove every parcel, and for whom copies were made."""
        self._store.execute("DELETE FROM parcels")
        self._store.execute("DELETE FROM shared")

    def all(self, direction: Direction, *states: ParcelState) -> list[ParcelRow]:
        """Return parcels without their documents, oldest first."""
        return self._store.read(
            ParcelRow,
            f"SELECT {_ROW} FROM parcels WHERE direction = ? AND state IN ({places(states)}) ORDER BY created, id",
            (direction, *states),
        )

    def get(self, id: str, direction: Direction) -> ParcelRow | None:
        """Return one parcel, without its document."""
        return self._store.read_one(
            ParcelRow, f"SELECT {_ROW} FROM parcels WHERE id = ? AND direction = ?", (id, direction)
        )

    def document(self, id: str, direction: Direction) -> bytes:
        """Return the octets of a parcel, empty if it is done or not known."""
        rows = self._store.execute("SELECT document FROM parcels WHERE id = ? AND direction = ?", (id, direction))
        return bytes(rows[0][0]) if rows else b""

    def put(self, row: ParcelRow, document: bytes) -> None:
        """Add or replace a parcel."""
        values = tuple(getattr(row, column.name) for column in fields(ParcelRow))
        self._store.execute(
            f"INSERT OR REPLACE INTO parcels({_ROW}, document) VALUES({places(values)}, ?)", (*values, document)
        )

    def set_state(self, id: str, direction: Direction, state: ParcelState, detail: str = "") -> None:
        """Note what became of a parcel."""
        self._store.execute(
            "UPDATE parcels SET state = ?, detail = ? WHERE id = ? AND direction = ?", (state, detail, id, direction)
        )

    def drop(self, id: str, direction: Direction) -> None:
        """Forget a parcel."""
        self._store.execute("DELETE FROM parcels WHERE id = ? AND direction = ?", (id, direction))

    # -- copies that were made ---------------------------------------------------------------------------------------

    def unshared(self, receiver: str, *, imported: bool = False) -> list[tuple[bytes, int, str]]:
        """Return nodes whose present key was agreed here (or came from others) and of which no copy went to a receiver.

        UUID, epoch and key id, by UUID.
        """
        return self._store.execute(
            "SELECT uuid, epoch, key_id FROM keys WHERE state = 'active' AND (source = 'agreement') = ? AND NOT EXISTS"
            " (SELECT 1 FROM shared WHERE shared.uuid = keys.uuid AND shared.epoch = keys.epoch AND receiver = ?)"
            " ORDER BY uuid",
            (int(not imported), receiver),
        )

    def put_shared(self, rows: Iterable[tuple[bytes, int]], receiver: str, parcel: str, state: str) -> None:
        """Note that a copy of these keys (UUID, epoch) is made for a receiver: ``sent``, ``taken`` or ``refused``."""
        self._store.execute_many(
            "INSERT OR REPLACE INTO shared VALUES(?, ?, ?, ?, ?)",
            ((uuid, epoch, receiver, parcel, state) for uuid, epoch in rows),
        )

    def turn_shared(self, parcel: str, state: str, uuids: Sequence[bytes] | None = None) -> None:
        """Note what became of the copies in a parcel, of all or of some nodes."""
        if uuids is None:
            self._store.execute("UPDATE shared SET state = ? WHERE parcel = ?", (state, parcel))
            return
        self._store.execute_many(
            "UPDATE shared SET state = ? WHERE parcel = ? AND uuid = ?", ((state, parcel, uuid) for uuid in uuids)
        )

    def forget_shared(self, parcel: str) -> None:
        """Queue the copies of a parcel without a receipt for another export."""
        self._store.execute("DELETE FROM shared WHERE parcel = ? AND state = 'sent'", (parcel,))

    def shared_in(self, parcel: str) -> list[tuple[bytes, int, str]]:
        """Return what a parcel holds: UUID, epoch, state."""
        return self._store.execute("SELECT uuid, epoch, state FROM shared WHERE parcel = ? ORDER BY uuid", (parcel,))

    def receipted(self) -> list[tuple[bytes, int, set[str]]]:
        """Return keys that are still held here and of which receivers sent a receipt: UUID, epoch, who."""
        rows = self._store.execute(
            "SELECT uuid, epoch, group_concat(receiver) FROM shared WHERE shared.state = 'taken' AND EXISTS"
            " (SELECT 1 FROM keys WHERE keys.uuid = shared.uuid AND keys.epoch = shared.epoch AND state = 'active')"
            " GROUP BY uuid, epoch"
        )
        return [(uuid, epoch, set(receivers.split(","))) for uuid, epoch, receivers in rows]

    # -- what a removed station received -----------------------------------------------------------------------------

    def review(self) -> str | None:
        """Return what was found when the keys were looked through last, JSON."""
        row = self._store.first_row("SELECT value FROM meta WHERE name = 'plant-review'")
        return None if row is None else str(row[0])

    def put_review(self, text: str) -> None:
        """Keep what was found."""
        self._store.execute("INSERT OR REPLACE INTO meta VALUES('plant-review', ?)", (text,))
