"""The station's own facts, the certificates that it knows, and the marks on nodes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from operator import attrgetter
from typing import Any

from teds_provision.station.store.database import Database, places
from teds_provision.station.store.records import KeyFlags, StationRecord

_FACTS = ", ".join(column.name for column in fields(StationRecord))
_MARKS = ", ".join(column.name for column in fields(KeyFlags))
_NONE = KeyFlags()
_values = attrgetter(*(column.name for column in fields(KeyFlags)))


class FactTables:
    """The part of the store that is about the station itself; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    _seen: tuple[tuple[int, int], StationRecord | None] | None = None
    """The facts as they were read last, and the state of the file then: every step asks for them again and again."""

    def facts(self) -> StationRecord | None:
        """Return what the station knows of itself, None before init made anything."""
        state = self._database.state()
        if self._seen is None or self._seen[0] != state:
            self._seen = state, self._database.read_one(StationRecord, f"SELECT {_FACTS} FROM station")
        return self._seen[1]

    def put_facts(self, facts: StationRecord) -> None:
        """Keep the station's facts, all of them."""
        self._seen = None
        values = tuple(getattr(facts, column.name) for column in fields(StationRecord))
        self._database.execute(f"INSERT OR REPLACE INTO station(one, {_FACTS}) VALUES(1, {places(values)})", values)

    # -- certificates ----------------------------------------------------------------------------------------------

    def certificate(self, ca: str, station: str) -> bytes | None:
        """Return SIG104 of a CA over a station's key, both by fingerprint; None if it is not known."""
        row = self._database.one("SELECT signature FROM certificates WHERE ca = ? AND station = ?", (ca, station))
        return None if row is None else bytes(row[0])

    def certificates(self) -> dict[tuple[str, str], bytes]:
        """Return every SIG104 by the fingerprints of CA and station."""
        rows = self._database.execute("SELECT ca, station, signature FROM certificates")
        return {(str(ca), str(station)): bytes(signature) for ca, station, signature in rows}

    def put_certificate(self, ca: str, station: str, signature: bytes) -> None:
        """Keep a SIG104; the caller has verified it."""
        self._database.execute("INSERT OR REPLACE INTO certificates VALUES(?, ?, ?)", (ca, station, signature))

    # -- marks on nodes --------------------------------------------------------------------------------------------

    def key_flags(self, uuid: bytes) -> KeyFlags:
        """Return the marks on a node; none of them is set on one without."""
        return self._database.read_one(KeyFlags, f"SELECT {_MARKS} FROM marks WHERE uuid = ?", (uuid,)) or KeyFlags()

    def key_flags_of(self, uuids: Sequence[bytes]) -> dict[bytes, KeyFlags]:
        """Return the marks on those of these nodes (a page of them) that have one."""
        statement = f"SELECT uuid, {_MARKS} FROM marks WHERE uuid IN ({places(uuids)})"
        return dict(self._database.read(_marked, statement, uuids))

    def all_key_flags(self) -> dict[bytes, KeyFlags]:
        """Return the marks on every node that has one."""
        return dict(self._database.read(_marked, f"SELECT uuid, {_MARKS} FROM marks"))

    def put_key_flags(self, marks: Mapping[bytes, KeyFlags]) -> None:
        """Keep the marks on nodes, in place of those that are there; a node without any has no row."""
        columns = ("uuid", *fields(KeyFlags))
        rows = ((uuid, *_values(mark)) for uuid, mark in marks.items() if mark != _NONE)
        without = [(uuid,) for uuid, mark in marks.items() if mark == _NONE]
        with self._database.together():
            self._database.execute_many("DELETE FROM marks WHERE uuid = ?", without)
            statement = f"INSERT OR REPLACE INTO marks(uuid, {_MARKS}) VALUES({places(columns)})"
            self._database.execute_many(statement, rows)


def _marked(uuid: bytes, *row: Any) -> tuple[bytes, KeyFlags]:
    return uuid, KeyFlags(*row)
