"""Drafts, what was read of each node last, and the datasheets that it had: the present one and ten older ones."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import fields
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Any

from teds_provision.errors import BadDataError
from teds_provision.lazy import late
from teds_provision.station.store.database import Database, places
from teds_provision.station.store.records import DatasheetRecord, Draft, FirmwareRecord, NodeReading, iso, utc_now
from teds_provision.teds.image import BlockId, Image

if TYPE_CHECKING:
    from teds_provision.teds.codec import security
else:  # commands that only list decode no TEDS
    security = late("teds_provision.teds.codec.security")


# Images in the store: octets, deflated, with facts of their Security TEDS beside them.

_BLOCK = struct.Struct(">HBI")
_MAX_OCTETS = 64 << 20


def datasheet_row(image: Image, profile: str | None, seen: str) -> tuple[Any, ...]:
    """Return the row of an image: sequence, epoch and time of its Security TEDS, its digest, its octets."""
    sequence = epoch = 0
    signed: str | None = None
    if image.security is not None:
        try:
            said = security.decode(image.security)
        except BadDataError:
            pass
        else:
            sequence, epoch = said.sequence, said.key_epoch
            if said.signed:
                signed = iso(datetime.fromtimestamp(int.from_bytes(said.last_modified[:4], "big"), UTC))
    return image.uuid, sequence, epoch, signed, profile, seen, bytes.fromhex(image.digest()), packed(image)


def packed(image: Image) -> bytes:
    """Return the blocks of an image, ascending, deflated: channel u16, access code u8, length u32, octets."""
    parts = (_BLOCK.pack(channel, code, len(image.blocks[channel, code])) for channel, code in image)
    whole = b"".join(head + image.blocks[block] for head, block in zip(parts, image, strict=True))
    return _deflated(whole)


@lru_cache(maxsize=4)
def _deflated(whole: bytes) -> bytes:
    """Return an image deflated; cached, as it is kept as a draft, and a moment later as written."""
    return zlib.compress(whole, 9)


def unpacked(uuid: bytes, octets: bytes) -> Image:
    """Return the image that :func:`packed` gave; raises ValueError for any other octets."""
    inflate = zlib.decompressobj()
    try:
        whole = inflate.decompress(octets, _MAX_OCTETS)
    except zlib.error as error:
        raise ValueError from error
    if not inflate.eof:
        raise ValueError
    blocks: dict[BlockId, bytes] = {}
    place = 0
    while place < len(whole):
        try:
            channel, code, length = _BLOCK.unpack_from(whole, place)
        except struct.error as error:
            raise ValueError from error
        place += _BLOCK.size
        if place + length > len(whole):
            raise ValueError
        blocks[channel, code] = whole[place : place + length]
        place += length
    return Image(uuid, blocks)


KEPT = 11
"""The present datasheet of a node and ten older ones."""

READING_FIELDS = tuple(column.name for column in fields(NodeReading))
_READING = ", ".join(READING_FIELDS)
_COLUMNS = "uuid, sequence, epoch, signed, profile, seen, digest, blocks"


class DatasheetTables:
    """The part of the store that is about images; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    def draft(self, uuid: bytes) -> Draft | None:
        """Return the image that this node is being given."""
        return self._database.read_one(_draft, "SELECT * FROM drafts WHERE uuid = ?", (uuid,))

    def drafts(self) -> list[Draft]:
        """Return every image that was built and not written, by UUID."""
        return self._database.read(_draft, "SELECT * FROM drafts ORDER BY uuid")

    def put_draft(self, draft: Draft) -> None:
        """Keep an image for a node, in place of the one before."""
        self._database.execute(
            "INSERT OR REPLACE INTO drafts VALUES(?, ?, ?, ?, ?)",
            (draft.uuid, packed(draft.image), draft.stage, draft.profile, draft.created),
        )

    def drop_draft(self, uuid: bytes) -> bool:
        """Forget the image that a node was to be given; False if there was none."""
        return self._database.change("DELETE FROM drafts WHERE uuid = ?", (uuid,)) > 0

    def datasheet(self, uuid: bytes) -> DatasheetRecord | None:
        """Return what this node had when it was last read or written, None if it never was."""
        statement = f"SELECT {_COLUMNS} FROM datasheets WHERE uuid = ? ORDER BY row DESC LIMIT 1"
        return self._database.read_one(_datasheet, statement, (uuid,))

    def history(self, uuid: bytes) -> list[DatasheetRecord]:
        """Return every datasheet that is kept of this node, newest first."""
        statement = f"SELECT {_COLUMNS} FROM datasheets WHERE uuid = ? ORDER BY row DESC"
        return self._database.read(_datasheet, statement, (uuid,))

    def put_datasheet(self, image: Image, profile: str | None = None) -> bool:
        """Remember what a node has: every TEDS as it was read. One that it has already is not written again.

        Returns whether it was new. The oldest go when there are more than ten older ones.
        """
        row = datasheet_row(image, profile, utc_now())
        with self._database.together():
            last = self._database.one(
                "SELECT digest FROM datasheets WHERE uuid = ? ORDER BY row DESC LIMIT 1", (image.uuid,)
            )
            if last == (row[-2],):
                return False
            self._database.execute(f"INSERT INTO datasheets({_COLUMNS}) VALUES(?, ?, ?, ?, ?, ?, ?, ?)", row)
            self._database.execute(
                "DELETE FROM datasheets WHERE uuid = ? AND row <= (SELECT row FROM datasheets WHERE uuid = ?"
                " ORDER BY row DESC LIMIT 1 OFFSET ?)",
                (image.uuid, image.uuid, KEPT),
            )
        return True

    # -- readings --------------------------------------------------------------------------------------------------

    def reading_of(self, uuid: bytes) -> NodeReading | None:
        """Return the last reading of this node, None if there is none."""
        return self._database.read_one(_reading, f"SELECT {_READING} FROM readings WHERE uuid = ?", (uuid,))

    def readings_of(self, uuids: Sequence[bytes]) -> dict[bytes, NodeReading]:
        """Return what was read last of these nodes (a page of them), by UUID."""
        statement = f"SELECT {_READING} FROM readings WHERE uuid IN ({places(uuids)})"
        return {reading.uuid: reading for reading in self._database.read(_reading, statement, uuids)}

    def put_reading(self, reading: NodeReading) -> bool:
        """Keep a reading in place of the one before; False if that was made in a session and this one was not."""
        values = tuple(getattr(reading, name) for name in READING_FIELDS)
        changed = ", ".join(f"{name} = excluded.{name}" for name in READING_FIELDS[1:])
        return (
            self._database.change(
                f"INSERT INTO readings({_READING}) VALUES({places(values)}) ON CONFLICT(uuid) DO UPDATE SET {changed}"
                " WHERE excluded.c IS NOT NULL OR readings.c IS NULL",
                values,
            )
            > 0
        )

    def put_start(self, uuid: bytes, c: bytes) -> None:
        """Record a restart of the node with the same Security TEDS: the rest is as it was read before."""
        self._database.execute("UPDATE readings SET c = ?, whole = 0 WHERE uuid = ?", (c, uuid))

    def drop_reading(self, uuid: bytes) -> None:
        """Forget what was read of a node: it was reset."""
        self._database.execute("DELETE FROM readings WHERE uuid = ?", (uuid,))
        self._database.execute("DELETE FROM firmware WHERE uuid = ?", (uuid,))

    def firmware_of(self, uuids: Sequence[bytes]) -> dict[bytes, FirmwareRecord]:
        """Return what these nodes (a page of them) last reported of their firmware, by UUID."""
        found = self._database.read(_firmware, f"SELECT * FROM firmware WHERE uuid IN ({places(uuids)})", uuids)
        return {record.uuid: record for record in found}

    def all_firmware(self) -> list[FirmwareRecord]:
        """Return what all nodes last reported of their firmware."""
        return self._database.read(_firmware, "SELECT * FROM firmware ORDER BY uuid")

    def put_firmware(self, record: FirmwareRecord) -> None:
        """Keep what a node reports of its firmware, in place of what it reported before."""
        values = (record.uuid, record.report, record.in_session, record.at, record.signed, record.mac)
        self._database.execute(f"INSERT OR REPLACE INTO firmware VALUES({places(values)})", values)

    def put_history(self, records: list[DatasheetRecord]) -> None:
        """Keep datasheets of a node, oldest first, in place of those that are there (for restore)."""
        with self._database.together():
            for uuid in {record.uuid for record in records}:
                self._database.execute("DELETE FROM datasheets WHERE uuid = ?", (uuid,))
            for record in records:
                row = datasheet_row(record.image, record.profile, record.seen)
                self._database.execute(f"INSERT INTO datasheets({_COLUMNS}) VALUES(?, ?, ?, ?, ?, ?, ?, ?)", row)


def _reading(*row: Any) -> NodeReading:
    values = dict(zip(READING_FIELDS, row, strict=True))
    return NodeReading(**(values | {"whole": bool(values["whole"])}))


def _firmware(uuid: bytes, report: bytes, in_session: int, at: str, *rest: Any) -> FirmwareRecord:
    return FirmwareRecord(uuid, report, bool(in_session), at, *rest)


def _draft(uuid: bytes, blocks: bytes, stage: Any, profile: str | None, created: str) -> Draft:
    return Draft(uuid, unpacked(uuid, blocks), stage, profile, created)


def _datasheet(uuid: bytes, *row: Any) -> DatasheetRecord:
    sequence, epoch, signed, profile, seen, digest, blocks = row
    return DatasheetRecord(uuid, sequence, epoch, signed, profile, seen, digest.hex(), unpacked(uuid, blocks))
