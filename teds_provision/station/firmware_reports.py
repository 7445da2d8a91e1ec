"""The last firmware report (About) of each node, and the report under which its datasheet was signed."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

from teds_provision.station.row_macs import MacRow, RowMacs, Values
from teds_provision.station.store.database import places
from teds_provision.station.store.records import FirmwareRecord, utc_now
from teds_provision.station.store.row_sample import ALL_ROWS, RowSample
from teds_provision.station.store.store import Store


class FirmwareReports:
    """The firmware reports of the nodes of one station, by UUID; ``station/firmware.py`` judges them."""

    def __init__(self, store: Store, row_macs: RowMacs) -> None:
        self._store, self._row_macs = store, row_macs

    def get(self, uuid: bytes) -> FirmwareRecord | None:
        """Return what a node last reported of its firmware, None if nothing is known."""
        return self.get_many([uuid]).get(uuid)

    def get_many(self, uuids: Sequence[bytes]) -> dict[bytes, FirmwareRecord]:
        """Return what a chunk of nodes last reported, by UUID; what another program wrote does not count."""
        found = self._store.read(_record, f"SELECT * FROM firmware WHERE uuid IN ({places(uuids)})", uuids)
        return {record.uuid: record for record in found if self._counts(record)}

    def all(self, sample: RowSample | None = None) -> Iterator[FirmwareRecord]:
        """Yield what every node last reported, by UUID, or those in ``sample``.

        Rows that another program wrote do not count.
        """
        rows = ALL_ROWS if sample is None else sample.rows(self._store, "firmware")
        found = self._store.read(_record, f"SELECT * FROM firmware WHERE {rows} ORDER BY uuid")
        return (record for record in found if self._counts(record))

    def keep(self, uuid: bytes, report: bytes, *, in_session: bool, signed: bool = False) -> FirmwareRecord:
        """Keep a node's answer to About (empty: it reports none), and return what is kept now.

        Only one in a session replaces one of a session. ``signed``: its datasheet was signed under this firmware. An
        answer that is known is not written again.
        """
        with self._store.together():
            before = self.get(uuid)
            if before is not None and before.in_session and not in_session:
                return before
            known = before is not None and (before.report, before.in_session) == (report, in_session)
            at = before.at if before is not None and known else utc_now()
            kept = before.signed if before is not None else None
            record = FirmwareRecord(uuid, report, in_session, at, report if signed else kept)
            if record != before:
                self._put(record)
            return record

    def renew(self, record: FirmwareRecord) -> FirmwareRecord:
        """Note that a kept report holds since now: the node reported it again, after another station saw another."""
        renewed = replace(record, at=utc_now())
        self._put(renewed)
        return renewed

    def make_hint(self, uuid: bytes) -> None:
        """Let the next report of a session replace a kept one in any case; until then it is shown as unverified."""
        with self._store.together():
            before = self.get(uuid)
            if before is not None and before.in_session:
                self._put(replace(before, in_session=False))

    def _put(self, record: FirmwareRecord) -> None:
        """Write a report with its MAC; without one, and so only a hint, as long as the vault is closed."""
        mac = self._row_macs.mac("firmware", _bound(record)) if self._row_macs.active else None
        values = (record.uuid, record.report, record.in_session, record.at, record.signed, mac)
        self._store.execute(f"INSERT OR REPLACE INTO firmware VALUES({places(values)})", values)

    def forget(self, uuid: bytes) -> None:
        """Forget the report of a node that was reset, or of a board that was replaced."""
        self._store.execute("DELETE FROM firmware WHERE uuid = ?", (uuid,))

    def _counts(self, record: FirmwareRecord) -> bool:
        """Return True if a report counts: its MAC is right, or the vault is closed, or it is a hint anyway."""
        return not record.in_session or self._row_macs.counts(record.mac, "firmware", _bound(record))

    def mac_rows(self, sample: RowSample) -> Iterator[MacRow]:
        """Yield the reports of sessions, for a check of their MACs."""
        rows = sample.rows(self._store, "firmware")
        for record in self._store.read(_record, f"SELECT * FROM firmware WHERE {rows} ORDER BY uuid"):
            if record.in_session:
                yield f"the firmware report of {record.uuid.hex()}", record.mac, "firmware", _bound(record)


def _record(uuid: bytes, report: bytes, in_session: int, at: str, *rest: Any) -> FirmwareRecord:
    return FirmwareRecord(uuid, report, bool(in_session), at, *rest)


def _bound(record: FirmwareRecord) -> Values:
    return (record.uuid, record.report, str(int(record.in_session)), record.at, record.signed)
