"""``draft`` and ``history``: what was built and never written, and the datasheets that a node had before."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.errors import NotFoundError
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.board_type import differences, is_remembered
from teds_provision.provisioning.build import unwritten_draft
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import Reporter
from teds_provision.provisioning.sign import require_not_measured, sign
from teds_provision.provisioning.teds_read import take_snapshot
from teds_provision.provisioning.visit import at_node
from teds_provision.provisioning.write import WriteResult, write
from teds_provision.station.station import Station
from teds_provision.station.store.records import DatasheetRecord, Draft
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.image import Image


@dataclass(frozen=True)
class DroppedDraft:
    """A draft that was dropped, or would be; None if there was none."""

    uuid: bytes
    draft: Draft | None


def drop_draft(station: Station, node: str, *, dry_run: bool = False) -> DroppedDraft:
    """Drop what was built for the node that ``node`` names and never written."""
    uuid = station.nodes.resolve(node)
    draft = station.datasheets.draft(uuid)
    if draft is not None and not dry_run:
        with station.durable("draft"):
            station.datasheets.drop_draft(uuid)
            station.audit("draft", uuid, "dropped", stage=draft.stage, profile=draft.profile)
    return DroppedDraft(uuid, draft)


def history_of(station: Station, node: str) -> tuple[bytes, list[DatasheetRecord]]:
    """Return the datasheets of the node that ``node`` names, newest first."""
    uuid = station.nodes.resolve(node)
    return uuid, station.datasheets.history(uuid)


@dataclass(frozen=True)
class RestoredDatasheet:
    """An older datasheet, signed again and written; for a dry run ``written`` is None.

    ``warnings`` names a draft that was not written and is kept.
    """

    uuid: bytes
    sequence: int
    changes: tuple[Change, ...]
    written: WriteResult | None
    warnings: tuple[str, ...] = ()


def _record_of(station: Station, uuid: bytes, sequence: int) -> DatasheetRecord:
    known = station.datasheets.history(uuid)
    for record in known:
        if record.sequence == sequence:
            return record
    listed = ", ".join(str(record.sequence) for record in known) or "none"
    raise NotFoundError(
        f"Node {uuid.hex()} never had a datasheet with sequence {sequence}.", hint=f"Known are: {listed}."
    )


@dataclass(frozen=True)
class RestoreOrder:
    """The order to write the datasheet that ``node`` had under ``sequence``, or only to plan it.

    ``retyped``: the board may become one of another type; ``jump``: its sequence may go far ahead.
    """

    node: str
    sequence: int
    retyped: bool = False
    jump: bool = False
    dry_run: bool = False


def restore_datasheet(
    station: Station, links: LinkSettings, order: RestoreOrder, reporter: Reporter, *, operator: Operator
) -> RestoredDatasheet:
    """Sign an older datasheet of a node again and write it; its content counts, not its number.

    ``operator`` is asked as by :func:`~teds_provision.provisioning.write.write_at`. A draft of other content that was
    never written is kept, with a warning. Raises NotFoundError (no such datasheet), PolicyError, and what ``write``
    raises.
    """
    sequence = order.sequence
    uuid = station.nodes.resolve(order.node)
    station.policy.require_whitelisted(uuid)
    record = _record_of(station, uuid, sequence)
    if order.dry_run:
        now = station.datasheets.datasheet(uuid)
        before = now.unsigned_blocks() if now is not None else {}
        changes = tuple(diff_blocks(before, record.image.unsigned_blocks()))
        return RestoredDatasheet(uuid, sequence, changes, None, unwritten_draft(station, now, record.image))
    if order.jump:
        operator.jump("This uses up the node's sequence numbers up to that point, permanently. Write it?")
    with at_node(station, links.after_agreeing(), uuid, reporter, unlock="always", writes="write") as visit:
        require_session(station, visit.node)
        present = take_snapshot(visit.node)
        blocks = record.image.unsigned_blocks()
        same = {block for block, teds in blocks.items() if present.image.blocks.get(block) == teds}
        image = Image(uuid, {**blocks, **present.fixed_beside(same)})
        if not order.retyped:
            retype = differences(present.image.blocks, image)
            known = record.profile is not None and is_remembered(station, uuid, record.profile, factory=False)
            if retype and not known:
                operator.retype(uuid, retype)
        guard(station, image, present.image, f"datasheet of sequence {sequence} brought back")
        warnings = unwritten_draft(station, present.image, image)
        changes = tuple(diff_blocks(present.image.unsigned_blocks(), image.unsigned_blocks()))
        signed = sign(
            station,
            SignedNodeKey(uuid, visit.who.point, visit.who.key_signature),
            image,
            epoch=present.identity.epoch,
            node_sequence=present.identity.sequence,
            on_node=present.image.security if not changes else None,
            keep_draft=not warnings,
            profile=record.profile,
            before=lambda: require_not_measured(station, visit.node, released=visit.released),
        )
        facts = {"profile": record.profile} if record.profile is not None else {}
        written = write(
            station,
            visit.node,
            signed.image,
            present=present,
            progress=reporter.written,
            facts=facts,
            jump=order.jump,
            low=operator.low_battery,
        )
        return RestoredDatasheet(uuid, signed.sequence, changes, written, warnings)
