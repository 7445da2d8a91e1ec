"""What was built and not written (drafts), and the datasheets that a node had, one of which can be brought back."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.errors import NotFound
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import NodeKeys
from teds_provision.station.station import Station
from teds_provision.steps.build_order import guard
from teds_provision.steps.read import survey
from teds_provision.steps.sign import sign
from teds_provision.steps.visits.visit import at_node
from teds_provision.steps.write import Written, write
from teds_provision.store import DatasheetRecord, Draft
from teds_provision.talk.progress import Reporter
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.image import Image


@dataclass(frozen=True)
class Dropped:
    """A draft that was dropped, or would be; None where there was none."""

    uuid: bytes
    draft: Draft | None


def drop_draft(station: Station, node: str, *, dry_run: bool = False) -> Dropped:
    """Drop what was built for the node that ``node`` names and never written."""
    uuid = station.nodes.resolve(node)
    draft = station.nodes.draft(uuid)
    if draft is not None and not dry_run:
        with station.durable("draft"):
            station.nodes.drop_draft(uuid)
            station.audit("draft", uuid, "dropped", stage=draft.stage, profile=draft.profile)
    return Dropped(uuid, draft)


def history_of(station: Station, node: str) -> tuple[bytes, list[DatasheetRecord]]:
    """The datasheets of the node that ``node`` names, newest first."""
    uuid = station.nodes.resolve(node)
    return uuid, station.nodes.history(uuid)


@dataclass(frozen=True)
class BroughtBack:
    """An older datasheet, signed anew and written; for a dry run ``written`` is None."""

    uuid: bytes
    sequence: int
    changes: tuple[Change, ...]
    written: Written | None


def _record_of(station: Station, uuid: bytes, sequence: int) -> DatasheetRecord:
    known = station.nodes.history(uuid)
    for record in known:
        if record.sequence == sequence:
            return record
    listed = ", ".join(str(record.sequence) for record in known) or "none"
    raise NotFound(f"Node {uuid.hex()} had no datasheet of sequence {sequence}.", hint=f"Known are: {listed}.")


def bring_back(
    station: Station, links: LinkSettings, node: str, sequence: int, reporter: Reporter, *, dry_run: bool = False
) -> BroughtBack:
    """Write a datasheet that the node had under ``sequence``, signed anew; its content counts, not its number.

    Raises NotFound (no such datasheet), PolicyRefused, and what ``write`` raises.
    """
    uuid = station.nodes.resolve(node)
    station.policy.require_whitelisted(uuid)
    record = _record_of(station, uuid, sequence)
    if dry_run:
        now = station.nodes.datasheet(uuid)
        before = now.unsigned_blocks() if now is not None else {}
        return BroughtBack(uuid, sequence, tuple(diff_blocks(before, record.image.unsigned_blocks())), None)
    with at_node(station, links.after_agreeing(), uuid, reporter, unlock="always") as visit:
        visit.session()
        present = survey(visit.node)
        keep = {block: present.image.blocks[block] for block in present.read_only}
        image = Image(uuid, {**record.image.unsigned_blocks(), **keep})
        guard(station, image, present.image, f"datasheet of sequence {sequence} brought back")
        changes = tuple(diff_blocks(present.image.unsigned_blocks(), image.unsigned_blocks()))
        signed = sign(
            station,
            NodeKeys(uuid, visit.who.point, visit.who.key_signature),
            image,
            epoch=present.identity.epoch,
            node_sequence=present.identity.sequence,
            on_node=present.image.security if not changes else None,
            keep_draft=True,
            profile=record.profile,
        )
        facts = {"profile": record.profile} if record.profile is not None else {}
        written = write(station, visit.node, signed.image, present=present, progress=reporter.written, facts=facts)
        return BroughtBack(uuid, signed.sequence, changes, written)
