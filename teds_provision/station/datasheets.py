"""The last reading of each node, the datasheets that it had (the present one and ten older ones), and its draft.

Images are kept as octets, deflated, with facts of their Security TEDS beside them.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Sequence
from dataclasses import fields
from datetime import UTC, datetime
from functools import lru_cache
from typing import Any

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.station.firmware_reports import FirmwareReports
from teds_provision.station.nodes import Nodes
from teds_provision.station.store.database import places
from teds_provision.station.store.records import DatasheetRecord, Draft, NodeReading, iso, utc_now
from teds_provision.station.store.store import Store
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import BlockId, Image

_BLOCK = struct.Struct(">HBI")
_MAX_OCTETS = 64 << 20


def datasheet_row(image: Image, profile: str | None, seen: str) -> tuple[Any, ...]:
    """Return the row of an image: sequence, epoch and time of its Security TEDS, its digest, its octets."""
    sequence = epoch = 0
    signed: str | None = None
    if image.security is not None:
        try:
            document = security.decode(image.security)
        except BadDataError:
            pass
        else:
            sequence, epoch = document.sequence, document.key_epoch
            if document.signed:
                signed = iso(datetime.fromtimestamp(int.from_bytes(document.last_modified[:4], "big"), UTC))
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


class Datasheets:
    """Datasheets, readings and drafts of the nodes of one station, by UUID."""

    def __init__(self, store: Store, nodes: Nodes, firmware: FirmwareReports) -> None:
        self._store, self._nodes, self._firmware = store, nodes, firmware

    def datasheet(self, uuid: bytes) -> Image | None:
        """Return the image of a node when it was last read or written whole, None if it never was."""
        statement = f"SELECT {_COLUMNS} FROM datasheets WHERE uuid = ? ORDER BY row DESC LIMIT 1"
        record = self._store.read_one(_datasheet, statement, (uuid,))
        return record.image if record is not None and is_whole(record.image) else None

    def keep_datasheet(self, image: Image, profile: str | None = None) -> None:
        """Keep the present datasheet of a node, as it was read or written; the one before goes into its history.

        A draft of the same content is removed. ``profile`` names the type, if it is known. An incomplete datasheet (a
        Security TEDS alone, or a TEDS of its field 108 missing) is not kept: it would replace octets that were not
        read.
        """
        if not is_whole(image):
            return
        with self._store.together():
            draft = self.draft(image.uuid)
            if draft is not None and draft.image == image:
                profile = profile or draft.profile
                self.drop_draft(image.uuid)
            if self.put(image, profile):
                self._nodes.set_due(image.uuid, _first_due(image))

    def put(self, image: Image, profile: str | None = None) -> bool:
        """Remember what a node has: every TEDS as it was read. One that it has already is not written again.

        Returns whether it was new. The oldest go when there are more than ten older ones.
        """
        row = datasheet_row(image, profile, utc_now())
        with self._store.together():
            last = self._store.first_row(
                "SELECT digest FROM datasheets WHERE uuid = ? ORDER BY row DESC LIMIT 1", (image.uuid,)
            )
            if last == (row[-2],):
                return False
            self._store.execute(f"INSERT INTO datasheets({_COLUMNS}) VALUES(?, ?, ?, ?, ?, ?, ?, ?)", row)
            self._store.execute(
                "DELETE FROM datasheets WHERE uuid = ? AND row <= (SELECT row FROM datasheets WHERE uuid = ?"
                " ORDER BY row DESC LIMIT 1 OFFSET ?)",
                (image.uuid, image.uuid, KEPT),
            )
        return True

    def history(self, uuid: bytes) -> list[DatasheetRecord]:
        """Return the datasheets that a node had, newest first: the present one and at most ten older ones.

        Readings of the Security TEDS alone are not among them.
        """
        return [record for record in self.whole_history(uuid) if record.image.unsigned_blocks()]

    def whole_history(self, uuid: bytes) -> list[DatasheetRecord]:
        """Return every datasheet that is kept of a node, newest first, those of a Security TEDS alone included."""
        statement = f"SELECT {_COLUMNS} FROM datasheets WHERE uuid = ? ORDER BY row DESC"
        return self._store.read(_datasheet, statement, (uuid,))

    def put_history(self, records: list[DatasheetRecord]) -> None:
        """Keep datasheets of a node, oldest first, in place of those that are there (for restore)."""
        with self._store.together():
            for uuid in {record.uuid for record in records}:
                self._store.execute("DELETE FROM datasheets WHERE uuid = ?", (uuid,))
            for record in records:
                row = datasheet_row(record.image, record.profile, record.seen)
                self._store.execute(f"INSERT INTO datasheets({_COLUMNS}) VALUES(?, ?, ?, ?, ?, ?, ?, ?)", row)

    # -- readings --------------------------------------------------------------------------------------------------

    def reading(self, uuid: bytes) -> NodeReading | None:
        """Return the last reading of a node, from which its verdict is derived; None if there is none."""
        return self._store.read_one(_reading, f"SELECT {_READING} FROM readings WHERE uuid = ?", (uuid,))

    def reads_well(self, uuid: bytes) -> bool:
        """Return True if a node's datasheet was read in a session and was free of faults: a hint, without trust."""
        row = self.reading(uuid)
        return row is not None and row.in_session and not row.failed

    def readings_of(self, uuids: Sequence[bytes]) -> dict[bytes, NodeReading]:
        """Return the last readings of a chunk of nodes, by UUID."""
        statement = f"SELECT {_READING} FROM readings WHERE uuid IN ({places(uuids)})"
        return {reading.uuid: reading for reading in self._store.read(_reading, statement, uuids)}

    def keep_reading(self, reading: NodeReading, image: Image | None = None, profile: str | None = None) -> bool:
        """Keep a reading of a node, with the datasheet if that is worth keeping, at one moment.

        Only a reading in a session replaces one made in a session: False if it did not.
        """
        with self._store.together():
            kept = self._put_reading(reading)
            if image is not None:
                self.keep_datasheet(image, profile)
        return kept

    def _put_reading(self, reading: NodeReading) -> bool:
        """Keep a reading in place of the one before; False if that was made in a session and this one was not."""
        values = tuple(getattr(reading, name) for name in READING_FIELDS)
        changed = ", ".join(f"{name} = excluded.{name}" for name in READING_FIELDS[1:])
        return (
            self._store.change(
                f"INSERT INTO readings({_READING}) VALUES({places(values)}) ON CONFLICT(uuid) DO UPDATE SET {changed}"
                " WHERE excluded.c IS NOT NULL OR readings.c IS NULL",
                values,
            )
            > 0
        )

    def started_anew(self, uuid: bytes, c: bytes) -> None:
        """Record a restart of the node since its reading, as a session with this ``c`` (8 octets) shows.

        Does not wait for the disk: a record lost in a crash comes back in the next session.
        """
        with self._store.transaction(later=True):
            self._store.execute("UPDATE readings SET c = ?, whole = 0 WHERE uuid = ?", (c, uuid))

    def forget_reading(self, uuid: bytes) -> None:
        """Forget the reading of a node that was reset, and its firmware report."""
        self._store.execute("DELETE FROM readings WHERE uuid = ?", (uuid,))
        self._firmware.forget(uuid)

    # -- drafts ------------------------------------------------------------------------------------------------------

    def drafts(self) -> list[Draft]:
        """Return every image that was built and not written, by UUID."""
        return self._store.read(_draft, "SELECT * FROM drafts ORDER BY uuid")

    def draft(self, uuid: bytes) -> Draft | None:
        """Return the image that a node is being given, and how far the write has come."""
        return self._store.read_one(_draft, "SELECT * FROM drafts WHERE uuid = ?", (uuid,))

    def keep_draft(self, draft: Draft) -> None:
        """Keep an image for a node, in place of the one before."""
        self._store.execute(
            "INSERT OR REPLACE INTO drafts VALUES(?, ?, ?, ?, ?)",
            (draft.uuid, packed(draft.image), draft.stage, draft.profile, draft.created),
        )

    def drop_draft(self, uuid: bytes) -> bool:
        """Forget the image that a node was to be given; False if there was none."""
        return self._store.change("DELETE FROM drafts WHERE uuid = ?", (uuid,)) > 0


def is_whole(image: Image) -> bool:
    """Return True if an image is a whole datasheet: more than a Security TEDS, with every TEDS of field 108."""
    if not image.unsigned_blocks():
        return False
    if image.security is None:
        return True
    try:
        return security.decode(image.security).signed_blocks.keys() <= image.blocks.keys()
    except BadDataError:
        return True  # a Security TEDS of another kind, which lists no TEDS


def _first_due(image: Image) -> str | None:
    """Return the day (ISO 8601) on which the first calibration of a datasheet ends, None if none does."""
    if not any(code == AccessCode.CALIBRATION for _, code in image):
        return None
    ends = [channel.due for channel in teds.sheet.Sheet.from_image(image).channels if channel.due is not None]
    return min(ends).strftime("%Y-%m-%d") if ends else None


def _reading(*row: Any) -> NodeReading:
    values = dict(zip(READING_FIELDS, row, strict=True))
    return NodeReading(**(values | {"whole": bool(values["whole"])}))


def _draft(uuid: bytes, blocks: bytes, stage: Any, profile: str | None, created: str) -> Draft:
    return Draft(uuid, unpacked(uuid, blocks), stage, profile, created)


def _datasheet(uuid: bytes, *row: Any) -> DatasheetRecord:
    sequence, epoch, signed, profile, seen, digest, blocks = row
    return DatasheetRecord(uuid, sequence, epoch, signed, profile, seen, digest.hex(), unpacked(uuid, blocks))
