"""Nodes: names and states, the last datasheet of each, and the draft that it is being given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

from teds_provision.errors import BadDataError, StoreError
from teds_provision.lazy import late
from teds_provision.station.plant.plant import Plant
from teds_provision.station.row_macs import RowMacs
from teds_provision.station.store import (
    DatasheetRecord,
    Draft,
    ExportedNode,
    ExportEligibility,
    FirmwareRecord,
    NodeOverview,
    NodeReading,
    NodeRecord,
    Search,
    Store,
    chunks,
    utc_now,
)
from teds_provision.teds.codec.model import AccessCode
from teds_provision.teds.image import Image

if TYPE_CHECKING:
    from teds_provision.teds import sheet
    from teds_provision.teds.codec import security
else:  # TEDS: a list decodes none
    sheet, security = late("teds_provision.teds.sheet"), late("teds_provision.teds.codec.security")


class Nodes:
    """The nodes of one station, by UUID."""

    def __init__(self, store: Store, seals: RowMacs, plant: Plant) -> None:
        self._plant = plant
        self._store = store
        self._row_macs = seals

    def all(self) -> list[NodeRecord]:
        """All nodes, by UUID."""
        return self._store.nodes()

    def all_shown_keys(self) -> Iterator[ExportEligibility]:
        """Identity key of all nodes, and whether each was retired, by UUID, a page at a time."""
        return self._store.all_shown_keys()

    def get_many(self, uuids: Sequence[bytes]) -> dict[bytes, NodeRecord]:
        """Return the records of a batch of nodes, by UUID."""
        return self._store.nodes_of(uuids)

    def exported_many(self, uuids: Sequence[bytes]) -> dict[bytes, ExportedNode]:
        """Return a bundle's facts about a batch of nodes, by UUID."""
        return self._store.exported_nodes_of(uuids)

    def bearers_of(self, names: Sequence[str]) -> dict[str, bytes]:
        """Who has each of a page of names."""
        return self._store.bearers_of(names)

    def get(self, uuid: bytes) -> NodeRecord | None:
        """Return the record of a node, None if there is none."""
        return self._store.node(uuid)

    def put(self, record: NodeRecord) -> None:
        """Add or replace a node. Epoch and sequence never go back; raises KeyMismatchError for another identity key."""
        present = self._store.node(record.uuid)
        self._store.put_node(replace(record, point_mac=self._seal(record.uuid, record.point, present)))

    def remember(self, uuid: bytes, **facts: object) -> NodeRecord:
        """Bring what is known of a node up to date and return it."""
        with self._store.together():  # no other process changes what was read before it is written
            present = self._store.node(uuid)
            before = present or NodeRecord(uuid)
            mac = self._seal(uuid, facts.get("point", before.point), present)
            changed = replace(before, **facts, point_mac=mac)  # type: ignore[arg-type]
            if present is None or changed != present or mac != present.point_mac:
                self._store.replace_node(changed, present)
            if changed.name != before.name:
                self._plant.record_name(uuid, changed.name)
        return changed

    def _seal(self, uuid: bytes, point: object, present: NodeRecord | None) -> bytes | None:
        """Return the row MAC of an identity key, new if the vault is open; without one it is a hint."""
        if not isinstance(point, bytes):
            return None
        if present is not None and present.point == point and present.point_mac is not None:
            return present.point_mac
        return self._row_macs.point(uuid, point)

    def met_at(self, uuid: bytes, place: str) -> None:
        """Record that a session with this node was opened at ``place`` (``LINK:PORT``), for the next search.

        A hint: it neither waits for the disk nor fails because of it; a lost one comes back in the next session.
        """
        if place and self._store.last_places([uuid]).get(uuid) != place:
            with suppress(StoreError), self._store.transaction(later=True):
                self._store.put_last_place(uuid, place)

    def last_places(self, uuids: Sequence[bytes]) -> dict[bytes, str]:
        """Return the last place of each of these nodes, as ``LINK:PORT``; without those never met."""
        return {uuid: place for page in chunks(uuids) for uuid, place in self._store.last_places(page).items()}

    def resolve(self, text: str) -> bytes:
        """Return the UUID for ``text`` (a UUID, a prefix of it, or a name); raises NotFoundError, UsageError."""
        return self._store.resolve(text)

    def beginning_with(self, text: str, most: int) -> list[tuple[str, str]]:
        """Names and UUIDs that begin with ``text``, each with what it is; for completing a command line."""
        return self._store.beginning_with(text, most)

    def find(self, search: Search) -> list[bytes]:
        """UUIDs of the nodes that are meant, ascending; of all that is known, imported and merely listed ones too."""
        return self._store.find(search)

    def overview(self, uuids: Sequence[bytes]) -> Iterator[NodeOverview]:
        """All that is known of these nodes, in their order, a page at a time."""
        return self._store.overview(uuids)

    def is_known(self, uuid: bytes) -> bool:
        """Return True if anything is known of a node."""
        return self._store.is_known(uuid)

    def named(self, name: str) -> bytes | None:
        """Return the UUID of the only node of exactly this name, None if none or several have it."""
        return self._store.named(name)

    def all_named(self, name: str) -> list[bytes]:
        """Return the UUIDs that have exactly this name, as a node or on the whitelist."""
        return self._store.all_named(name)

    # -- datasheets ------------------------------------------------------------------------------------------------

    def datasheet(self, uuid: bytes) -> Image | None:
        """Return the image of a node when it was last read or written whole, None if it never was."""
        record = self._store.datasheet(uuid)
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
            draft = self._store.draft(image.uuid)
            if draft is not None and draft.image == image:
                profile = profile or draft.profile
                self._store.drop_draft(image.uuid)
            if self._store.put_datasheet(image, profile):
                self._store.set_due(image.uuid, _first_due(image))

    def history(self, uuid: bytes) -> list[DatasheetRecord]:
        """Return the datasheets that a node had, newest first: the present one and at most ten older ones.

        Readings of the Security TEDS alone are not among them.
        """
        return [record for record in self._store.history(uuid) if record.image.unsigned_blocks()]

    # -- readings --------------------------------------------------------------------------------------------------

    def reading(self, uuid: bytes) -> NodeReading | None:
        """Return the last reading of a node, from which its verdict is derived; None if there is none."""
        return self._store.reading_of(uuid)

    def reads_well(self, uuid: bytes) -> bool:
        """Return True if a node's datasheet was read in a session and was free of faults: a hint, without trust."""
        row = self.reading(uuid)
        return row is not None and row.in_session and not row.failed

    def readings_of(self, uuids: Sequence[bytes]) -> dict[bytes, NodeReading]:
        """Return the last readings of a batch of nodes, by UUID."""
        return self._store.readings_of(uuids)

    def keep_reading(self, reading: NodeReading, image: Image | None = None, profile: str | None = None) -> bool:
        """Keep a reading of a node, with the datasheet if that is worth keeping, at one moment.

        Only a reading in a session replaces one made in a session: False if it did not.
        """
        with self._store.together():
            kept = self._store.put_reading(reading)
            if image is not None:
                self.keep_datasheet(image, profile)
        return kept

    def started_anew(self, uuid: bytes, c: bytes) -> None:
        """Record a restart of the node since its reading, as a session with this ``c`` (8 octets) shows.

        Does not wait for the disk: a record lost in a crash comes back in the next session.
        """
        with self._store.transaction(later=True):
            self._store.put_start(uuid, c)

    def forget_reading(self, uuid: bytes) -> None:
        """Forget the reading of a node that was reset."""
        self._store.drop_reading(uuid)

    # -- firmware --------------------------------------------------------------------------------------------------

    def firmware(self, uuid: bytes) -> FirmwareRecord | None:
        """Return what a node last reported of its firmware, None if nothing is known."""
        return self.firmware_of([uuid]).get(uuid)

    def firmware_of(self, uuids: Sequence[bytes]) -> dict[bytes, FirmwareRecord]:
        """Return what a batch of nodes last reported, by UUID; what another program wrote does not count."""
        found = self._store.firmware_of(uuids)
        return {uuid: record for uuid, record in found.items() if self._row_macs.reported(record)}

    def keep_firmware(self, uuid: bytes, report: bytes, *, in_session: bool, signed: bool = False) -> None:
        """Keep a node's answer to About (empty: it reports none); only one in a session replaces one of a session.

        ``signed``: its datasheet was signed under this firmware. An answer that is known is not written again.
        """
        with self._store.together():
            before = self.firmware(uuid)
            if before is not None and before.in_session and not in_session:
                return
            known = before is not None and (before.report, before.in_session) == (report, in_session)
            at = before.at if before is not None and known else utc_now()
            kept = before.signed if before is not None else None
            record = FirmwareRecord(uuid, report, in_session, at, report if signed else kept)
            if record != before:
                self._store.put_firmware(self._row_macs.firmware(record))

    def drafts(self) -> list[Draft]:
        """Every image that was built and not written, by UUID."""
        return self._store.drafts()

    def draft(self, uuid: bytes) -> Draft | None:
        """Return the image that a node is being given, and how far the write has come."""
        return self._store.draft(uuid)

    def keep_draft(self, draft: Draft) -> None:
        """Keep an image for a node, in place of the one before."""
        self._store.put_draft(draft)

    def drop_draft(self, uuid: bytes) -> bool:
        """Forget the image that a node was to be given; False if there was none."""
        return self._store.drop_draft(uuid)


def is_whole(image: Image) -> bool:
    """Return True if an image is a whole datasheet: more than a Security TEDS, with every TEDS of field 108."""
    if not image.unsigned_blocks():
        return False
    if image.security is None:
        return True
    try:
        return security.decode(image.security).signed_blocks.keys() <= image.blocks.keys()
    except BadDataError:
        return True  # not of this profile: it lists nothing


def _first_due(image: Image) -> str | None:
    """Return the day (ISO 8601) on which the first calibration of a datasheet ends, None if none does."""
    if not any(code == AccessCode.CALIBRATION for _, code in image):
        return None
    ends = [channel.due for channel in sheet.Sheet.from_image(image).channels if channel.due is not None]
    return min(ends).strftime("%Y-%m-%d") if ends else None
