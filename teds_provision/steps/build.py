"""Step 4: the TEDS of a node from its profile and calibration, and the Security TEDS still unsigned.

What is written to a node that has a datasheet is what the user just asked for. Anything else (a trial build, a run that
was cut, a newer profile, another datasheet than this station remembers) is shown as the changes in physical units and
asked about; the store never silently wins over the node.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from teds_provision.errors import BadData, NotFound, PolicyRefused
from teds_provision.protocol import datasheet
from teds_provision.station.station import Station
from teds_provision.steps.board_type import Retype, differences, is_remembered, refuse
from teds_provision.steps.build_order import BuildOrder, Prepared, compose, guard, merged, named_for, own_name, prepare
from teds_provision.steps.read import Survey
from teds_provision.steps.sign import known_image, known_node_keys, unsigned_security
from teds_provision.steps.verify import Known, Verified, verify_image
from teds_provision.store import Draft
from teds_provision.teds.codec import security
from teds_provision.teds.codec.model import AccessCode
from teds_provision.teds.diff import Change, diff_blocks
from teds_provision.teds.image import SECURITY, BlockId, Image

if TYPE_CHECKING:
    from teds_provision.teds.calibration import Calibration

__all__ = ["BuildOrder", "Built", "NotNamed", "Proposal", "build", "propose"]


@dataclass(frozen=True)
class Built:
    """A built image (Security TEDS unsigned, or absent where the node's key is not known yet) and its warnings."""

    image: Image
    profile: str
    warnings: tuple[str, ...]
    calibrations: Mapping[int, Calibration] = field(default_factory=dict)


class NotNamed(PolicyRefused):
    """A node's datasheet would change in what this command did not name, and nobody said yes; ``changes`` says what."""

    code = "not-named"

    def __init__(self, message: str, changes: tuple[Change, ...], *, hint: str = "") -> None:
        super().__init__(message, hint=hint)
        self.changes = changes


Confirm = Callable[[bytes, tuple[Change, ...]], None]
"""Asked before a datasheet changes in what was not named: UUID and changes; raises where the answer is no."""


def nobody(uuid: bytes, changes: tuple[Change, ...]) -> None:
    """The answer where nobody can be asked: no. Raises NotNamed with the changes."""
    shown = " ".join(change.text for change in changes[:3])
    more = f" And {len(changes) - 3} more." if len(changes) > 3 else ""
    raise NotNamed(
        f"Node {uuid.hex()} has another datasheet, and this command does not name what would change: {shown}{more}",
        changes,
        hint="Name it (--profile, --name, --calibration), or drop what lies ready: teds-provision draft drop UUID.",
    )


def build(
    station: Station,
    uuid: bytes,
    order: BuildOrder,
    *,
    has: Image | None = None,
    edition: int = 2007,
    keep_draft: bool = True,
    retype: Retype | None = None,
) -> Built:
    """Build a node's datasheet as a draft: a trial, which only ``sign``, ``write`` or a "yes" bring onto the node.

    Where the order brings no calibration, that of an earlier run that never came to write is taken, else the one that
    the node was last read to have (``has``: another one's). ``keep_draft`` False changes nothing (dry run).

    ``retype`` is asked where the board, as it was last read, is of another type. Raises NotFound (profile, file),
    BadData (profile or calibration with errors), WrongBoard, PolicyRefused (a calibration that the guard refuses).
    """
    prepared = named_for(station, uuid, prepare(station, order, uuid))
    has = has or known_image(station, uuid)
    if has is not None and prepared.profile is not None and not order.retype:
        told = differences(has.blocks, prepared.profile, prepared.calibrations or ())
        if told and not is_remembered(station, uuid, order.profile, factory=False):
            (retype or refuse)(uuid, told)
    plan = compose(station, uuid, prepared, pending_image(station, uuid, has) or has, edition=edition)
    image = Image(uuid, dict(plan.blocks))
    warnings = plan.warnings + guard(
        station, image, has, order.accept_calibration, plan.calibrations, plan.profile, record=keep_draft
    )
    try:
        image = image.with_block(SECURITY, unsigned_security(station, known_node_keys(station, uuid, has), image))
    except NotFound:
        warnings += ("The node's key is not known yet: the Security TEDS is added when it was identified.",)
    built = Built(image, plan.profile.name, merged(warnings), plan.calibrations)
    if not keep_draft:
        return built
    with station.durable("build"):
        facts = {} if plan.name is None else {"name": plan.name}
        if has is None or not has.unsigned_blocks():  # of a node with a datasheet the store keeps what is on it
            facts |= {"profile": plan.wanted, "profile_digest": plan.digest}
        station.nodes.remember(uuid, **facts)
        station.nodes.keep_draft(Draft(uuid, image, "built", plan.wanted))
        station.audit("build", uuid, "done", profile=built.profile, teds=image.digest())
    return built


@dataclass(frozen=True)
class Proposal:
    """What a node is to have: TEDS without the Security TEDS, and whether all of it was asked for.

    ``changes`` are against what it has now; ``profile`` and ``name`` what is remembered once it is written, None where
    nothing is to be remembered anew.
    """

    image: Image
    changes: tuple[Change, ...]
    named: bool
    warnings: tuple[str, ...] = ()
    profile: str | None = None
    name: str | None = None
    calibrations: Mapping[int, Calibration] = field(default_factory=dict)
    profile_digest: str | None = None

    def require_a_yes(self, confirm: Confirm) -> None:
        """Ask where something changes that was not named."""
        if self.changes and not self.named:
            confirm(self.image.uuid, self.changes)


def propose(station: Station, prepared: Prepared, present: Survey, *, record: bool = True) -> Proposal:
    """Say what a node that was just read is to have. ``record`` False: for a dry run, without a trace in the log.

    Raises UsageFailure (no profile known), NotFound, BadData, PolicyRefused (a calibration that the guard refuses).
    """
    has = present.image
    proposal = _proposal(station, prepared, present)
    warnings = guard(
        station,
        proposal.image,
        has,
        prepared.order.accept_calibration,
        proposal.calibrations or None,
        prepared.profile if proposal.calibrations else None,
        record=record,
    )
    changes = tuple(diff_blocks(has.unsigned_blocks(), proposal.image.unsigned_blocks()))
    return Proposal(
        proposal.image,
        changes,
        proposal.named,
        merged(proposal.warnings + warnings),
        proposal.profile,
        proposal.name,
        proposal.calibrations,
        proposal.profile_digest,
    )


def _proposal(station: Station, prepared: Prepared, present: Survey) -> Proposal:
    """What the node is to have, by what it has now and what was ordered; not guarded yet."""
    has, order = present.image, prepared.order
    keep = {block: has.blocks[block] for block in present.read_only}
    if not has.unsigned_blocks().keys() - keep.keys():
        return _composed(station, prepared, present, keep, named=True)
    if not _intact(station, present):
        return _mended(station, prepared, present) or _composed(
            station, prepared, present, keep, named=order.profile is not None
        )
    if order.names_nothing:
        return _as_it_is(station, present, keep)
    if order.profile is not None:
        return _composed(station, prepared, present, keep, named=True, resume=False)
    return _only_what_is_named(station, prepared, present, keep)


def _intact(station: Station, present: Survey) -> bool:
    """Whether the node has a datasheet that this station would call authentic: what it says may be kept."""
    checks = verify_image(station, present.image, known=Known(present.identity))
    return Verified(present.image.uuid, tuple(checks)).verdict == "authentic"


def _mended(station: Station, prepared: Prepared, present: Survey) -> Proposal | None:
    """The very datasheet that the node was signed for, where it holds something else and nothing else is asked for."""
    octets, uuid = present.image.security, present.image.uuid
    try:
        shown = security.decode(octets) if octets is not None else None
    except BadData:
        shown = None
    if octets is None or shown is None or not shown.signed or not prepared.order.names_nothing:
        return None
    for record in station.nodes.history(uuid):
        blocks = record.image.unsigned_blocks()
        if datasheet.digests(blocks) != shown.signed_blocks:
            continue
        checks = verify_image(station, Image(uuid, {**blocks, SECURITY: octets}), known=Known(present.identity))
        if Verified(uuid, tuple(checks)).verdict == "authentic":
            return Proposal(Image(uuid, blocks), (), named=True)
    return None


def _composed(
    station: Station,
    prepared: Prepared,
    present: Survey,
    keep: Mapping[BlockId, bytes],
    *,
    named: bool,
    resume: bool = True,
) -> Proposal:
    """Everything by profile; ``resume``: with the calibration of a run that never came to write."""
    uuid, has = present.image.uuid, present.image
    pending = pending_image(station, uuid, has) if resume else None
    record = station.nodes.get(uuid)
    name = own_name(station, pending or has, record.profile if record is not None else None)
    plan = compose(station, uuid, prepared, pending or has, name=name, as_known=resume)
    image = Image(uuid, {**keep, **plan.blocks})
    named = named and not plan.changed
    return Proposal(image, (), named, plan.warnings, plan.wanted, plan.name, plan.calibrations, plan.digest)


def _as_it_is(station: Station, present: Survey, keep: Mapping[BlockId, bytes]) -> Proposal:
    """What the node has, unless something else was built or signed for it and never written."""
    uuid, has = present.image.uuid, present.image
    pending = pending_image(station, uuid, has)
    if pending is None or pending.unsigned_blocks() == has.unsigned_blocks():
        return Proposal(Image(uuid, has.unsigned_blocks()), (), named=True)
    draft = station.nodes.draft(uuid)
    image = Image(uuid, {**keep, **pending.unsigned_blocks()})
    profile = draft.profile if draft is not None else None
    return Proposal(image, (), named=False, profile=profile, name=own_name(station, image, profile))


def _only_what_is_named(
    station: Station, prepared: Prepared, present: Survey, keep: Mapping[BlockId, bytes]
) -> Proposal:
    """What the node has, with those TEDS exchanged that differ by the named values alone."""
    uuid, has = present.image.uuid, present.image
    record = station.nodes.get(uuid)
    name = own_name(station, has, record.profile if record is not None else None)
    asked = compose(station, uuid, prepared, has, name=name, as_known=False)
    unasked = compose(station, uuid, Prepared(BuildOrder(), asked.profile), has, name=name, as_known=False)
    blocks = dict(has.unsigned_blocks())
    for block in {*asked.blocks, *unasked.blocks} - set(keep):
        wanted = asked.blocks.get(block)
        if wanted == unasked.blocks.get(block):
            continue
        if wanted is None:
            blocks.pop(block, None)
        else:
            blocks[block] = wanted
    if prepared.order.name is not None:  # also where the profile says the same and the node does not
        blocks[0, AccessCode.NAME] = asked.blocks[0, AccessCode.NAME]
    # What else the profile says now stays unwritten, so what is remembered of it is what it said then.
    return Proposal(Image(uuid, blocks), (), True, asked.warnings, asked.wanted, asked.name, asked.calibrations)


def pending_image(station: Station, uuid: bytes, has: Image | None) -> Image | None:
    """What an earlier run built or signed and never wrote: it says which calibration was meant, not the node."""
    draft = station.nodes.draft(uuid)
    if draft is None:
        return None
    image = draft.image
    if draft.stage == "signed" and _sequence(image) <= _sequence(has):
        return None
    return image


def _sequence(image: Image | None) -> int:
    octets = image.security if image is not None else None
    try:
        return security.decode(octets).sequence if octets is not None else -1
    except BadData:
        return -1
