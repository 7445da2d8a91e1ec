"""What is known of nodes: names and states, the datasheet that each had last, and the one that it is being given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from teds_provision.lazy import late
from teds_provision.station.seals import Seals
from teds_provision.store import DatasheetRecord, Draft, Handed, Known, NodeRecord, Search, Shown, Store
from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.image import Image

if TYPE_CHECKING:
    from teds_provision.teds import sheet
else:  # TEDS: a list decodes none
    sheet = late("teds_provision.teds.sheet")


class Nodes:
    """The nodes of one station, by UUID."""

    def __init__(self, store: Store, seals: Seals) -> None:
        self._store = store
        self._seals = seals

    def all(self) -> list[NodeRecord]:
        """All nodes, by UUID."""
        return self._store.nodes()

    def each_shown(self) -> Iterator[Shown]:
        """Identity key and verdict of all nodes, by UUID, a page at a time."""
        return self._store.each_shown()

    def of_page(self, uuids: Sequence[bytes]) -> dict[bytes, NodeRecord]:
        """What is known of a page of nodes, by UUID."""
        return self._store.nodes_of(uuids)

    def handed_of_page(self, uuids: Sequence[bytes]) -> dict[bytes, Handed]:
        """What a bundle says of a page of nodes, by UUID."""
        return self._store.handed_of(uuids)

    def bearers_of(self, names: Sequence[str]) -> dict[str, bytes]:
        """Who has each of a page of names."""
        return self._store.bearers_of(names)

    def get(self, uuid: bytes) -> NodeRecord | None:
        """What is known of a node, None if nothing is."""
        return self._store.node(uuid)

    def put(self, record: NodeRecord) -> None:
        """Add or replace a node. Epoch and sequence never go back; raises OtherKey for another identity key."""
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
        return changed

    def _seal(self, uuid: bytes, point: object, present: NodeRecord | None) -> bytes | None:
        """The seal of an identity key, new where the vault is open; without one it is a hint."""
        if not isinstance(point, bytes):
            return None
        if present is not None and present.point == point and present.point_mac is not None:
            return present.point_mac
        return self._seals.point(uuid, point)

    def resolve(self, text: str) -> bytes:
        """The UUID that ``text`` (a UUID, a prefix of it, or a name) means; raises NotFound, UsageFailure."""
        return self._store.resolve(text)

    def beginning_with(self, text: str, most: int) -> list[tuple[str, str]]:
        """Names and UUIDs that begin with ``text``, each with what it is; for completing a command line."""
        return self._store.beginning_with(text, most)

    def find(self, search: Search) -> list[bytes]:
        """UUIDs of the nodes that are meant, ascending; of all that is known, imported and merely listed ones too."""
        return self._store.find(search)

    def overview(self, uuids: Sequence[bytes]) -> Iterator[Known]:
        """All that is known of these nodes, in their order, a page at a time."""
        return self._store.overview(uuids)

    def is_known(self, uuid: bytes) -> bool:
        """Whether anything at all is known of a node."""
        return self._store.is_known(uuid)

    def named(self, name: str) -> bytes | None:
        """UUID of the one node of exactly this name, None where none or several have it."""
        return self._store.named(name)

    def all_named(self, name: str) -> list[bytes]:
        """The UUIDs that have exactly this name, as a node or on the whitelist."""
        return self._store.all_named(name)

    # -- datasheets ------------------------------------------------------------------------------------------------

    def datasheet(self, uuid: bytes) -> Image | None:
        """The image that a node had when it was last read or written, None if it never was."""
        record = self._store.datasheet(uuid)
        return record.image if record is not None else None

    def keep_datasheet(self, image: Image, profile: str | None = None) -> None:
        """Remember what a node has: every TEDS as it was read or written; the one before goes into its history.

        A draft of the same content is done with. ``profile`` names the type, where that is known.
        """
        with self._store.together():
            draft = self._store.draft(image.uuid)
            if draft is not None and draft.image == image:
                profile = profile or draft.profile
                self._store.drop_draft(image.uuid)
            if self._store.put_datasheet(image, profile):
                self._store.set_due(image.uuid, _first_due(image))

    def history(self, uuid: bytes) -> list[DatasheetRecord]:
        """The datasheets that a node had, newest first: the present one and at most ten older ones.

        What was read of a node before this station knew more than its Security TEDS is not among them.
        """
        return [record for record in self._store.history(uuid) if record.image.unsigned_blocks()]

    def drafts(self) -> list[Draft]:
        """Every image that was built and not written, by UUID."""
        return self._store.drafts()

    def draft(self, uuid: bytes) -> Draft | None:
        """The image that a node is being given, and how far it came."""
        return self._store.draft(uuid)

    def keep_draft(self, draft: Draft) -> None:
        """Keep an image for a node, in place of the one before."""
        self._store.put_draft(draft)

    def drop_draft(self, uuid: bytes) -> bool:
        """Forget the image that a node was to be given; False if there was none."""
        return self._store.drop_draft(uuid)


def _first_due(image: Image) -> str | None:
    """The day (ISO 8601) on which the first calibration of a datasheet ends, None where none does."""
    if not any(code == AccessCode.CALIBRATION for _, code in image):
        return None
    ends = [channel.due for channel in sheet.Sheet.of(image).channels if channel.due is not None]
    return min(ends).strftime("%Y-%m-%d") if ends else None
