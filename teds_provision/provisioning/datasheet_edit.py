"""A datasheet out of an XML or JSON document onto a connected node: planned, guarded, signed, written.

The document is the whole datasheet. Other TEDS of the node that are read-only stay; other writable ones are removed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace

from teds_provision.errors import BadDataError, DatasheetChangedError
from teds_provision.protocol.datasheet import can_be_stored, passes_own_check
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.board_type import differences, require_board_type, topic_warnings
from teds_provision.provisioning.build import own_name, require_fit, teds_calibrations, unwritten_draft
from teds_provision.provisioning.calibration_guard import guard
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.progress import DONE, NOTHING, Reporter, StepResult, Steps
from teds_provision.provisioning.sign import known_node_keys, require_not_measured, sign
from teds_provision.provisioning.teds_read import NodeSnapshot, take_snapshot
from teds_provision.provisioning.verify import require_authentic
from teds_provision.provisioning.verify_node import judge_and_keep
from teds_provision.provisioning.write import write
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station
from teds_provision.teds.calibration import Calibration
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.formats import stated_uuid, under
from teds_provision.teds.image import BlockId, Image


@dataclass(frozen=True)
class SheetPlan:
    """Changes of a document on a node: ``image`` is the wanted content, without its Security TEDS."""

    image: Image
    changes: tuple[Change, ...]
    warnings: tuple[str, ...]
    present: NodeSnapshot


@dataclass(frozen=True)
class SheetEditResult:
    """Result of an edit: its steps, and the node's verdict now."""

    plan: SheetPlan
    steps: tuple[StepResult, ...]
    verified: Verification


def plan_sheet(
    station: Station,
    node: Conversation,
    blocks: Mapping[BlockId, bytes],
    *,
    accept_calibration: str | None = None,
    retype: bool = False,
    record: bool = False,
    expected: Collection[str] | None = None,
) -> SheetPlan:
    """Plan the writing of these TEDS, in a session of the node; changes nothing.

    Raises NotWhitelistedError, PolicyError (no key, the guard), BadDataError (damaged TEDS, another node's),
    WrongBoardError if the board claims another type, unless ``retype``: no document names the type that it was given
    before. DatasheetChangedError if ``expected`` is given and names no digest of the datasheet that the node has.
    """
    station.policy.require_whitelisted(node.uuid)
    for (channel, code), teds in blocks.items():
        if not can_be_stored((channel, code)) or not passes_own_check((channel, code), teds):
            raise BadDataError(f"TEDS {code} of channel {channel} is damaged, or is one that no node can store.")
    meant = stated_uuid(blocks)
    if meant is not None and meant != node.uuid:
        raise BadDataError(
            f"This datasheet belongs to node {meant.hex()}, not to {node.uuid.hex()}.",
            hint="To use it for this node, remove the UUID from its Meta-TEDS (or set it to zeros).",
        )
    if not node.sealed:
        require_session(station, node)
    present = take_snapshot(node)
    if expected is not None and present.image.digest() not in expected:
        raise DatasheetChangedError(
            f"The datasheet of node {node.uuid.hex()} has changed since it was read.",
            hint="Read it again, or repeat the dry run, and review the changes.",
        )
    wanted = under(blocks, node.uuid)
    image = without_stale_certificates(present.image, Image(node.uuid, {**present.fixed_beside(wanted), **wanted}))
    differing = () if retype else differences(present.image.blocks, image)
    if differing:
        require_board_type(node.uuid, differing)
    same = {
        number: calibration
        for number, calibration in teds_calibrations(present.image).items()
        if image.blocks.get((number, AccessCode.CALIBRATION)) == present.image.blocks[number, AccessCode.CALIBRATION]
    }
    require_fit(same, present.image, image)
    warnings = guard(station, image, present.image, accept_calibration, record=record)
    warnings += topic_warnings(station, present.image, image)
    warnings += unwritten_draft(station, present.image, image)
    changes = tuple(diff_blocks(present.image.unsigned_blocks(), image.unsigned_blocks()))
    return SheetPlan(image, changes, warnings, present)


def without_stale_certificates(before: Image, after: Image) -> Image:
    """Return the image without the Certificate TEDS of calibrations that another one replaces.

    One that came with the new calibration stays, and so does that of a calibration whose zero offset alone changes.
    """
    old, new = teds_calibrations(before), teds_calibrations(after)
    stale = {
        (number, AccessCode.CERTIFICATE)
        for number, calibration in old.items()
        if calibration.certificate is not None
        and (number not in new or _unzeroed(new[number]) != _unzeroed(calibration))
        and after.blocks.get((number, AccessCode.CERTIFICATE)) == before.blocks[number, AccessCode.CERTIFICATE]
    }
    return Image(after.uuid, {block: teds for block, teds in after.blocks.items() if block not in stale})


def _unzeroed(calibration: Calibration) -> Calibration:
    return replace(calibration, zero_offset=0.0, zeroed=None, certificate=None)


def write_sheet(
    station: Station,
    node: Conversation,
    blocks: Mapping[BlockId, bytes],
    reporter: Reporter,
    *,
    accept_calibration: str | None = None,
    retype: bool = False,
    expected: Collection[str] | None = None,
) -> SheetEditResult:
    """Plan, sign, write, read back and verify; raises as the steps do, and NotAuthenticError if the end is not good."""
    steps = Steps(reporter)
    with steps.step("build") as step:
        plan = plan_sheet(
            station,
            node,
            blocks,
            accept_calibration=accept_calibration,
            retype=retype,
            record=True,
            expected=expected,
        )
        step.result = DONE if plan.changes else NOTHING
        step.detail = f"{len(plan.image.blocks)} TEDS"
    present = plan.present
    keys = known_node_keys(station, node.uuid, present.image)
    with steps.step("sign") as step:
        on_node = None if plan.changes else present.image.security
        signed = sign(
            station,
            keys,
            plan.image,
            epoch=present.identity.epoch,
            node_sequence=present.identity.sequence,
            on_node=on_node,
            keep_draft=not unwritten_draft(station, present.image, plan.image),
            before=lambda: require_not_measured(station, node),
        )
        step.result = NOTHING if signed.reused else DONE
        step.detail = f"sequence {signed.sequence}"
    with steps.step("write") as step:
        record = station.nodes.get(node.uuid)
        name = own_name(station, signed.image, record.profile if record is not None else None)
        facts = {} if name is None else {"name": name}
        written = write(station, node, signed.image, present=present, progress=reporter.written, facts=facts)
        step.result = DONE if written.octets else NOTHING
        step.detail = f"{written.octets} octets" if written.octets else ""
    with steps.step("verify") as step:
        verified = judge_and_keep(station, node, written.on_node, keys.key, by="write").verified
        step.take_verdict(verified.verdict)
    require_authentic(verified)
    return SheetEditResult(plan, tuple(steps.done), verified)
