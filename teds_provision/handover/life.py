"""The rest of a node's life: banned, taken out of service, or replaced by a spare."""

from __future__ import annotations

from dataclasses import dataclass, replace
from datetime import UTC, datetime

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.handover.deny import deny
from teds_provision.protocol.fingerprints import is_whole
from teds_provision.protocol.handover.revocation import seal_revocation
from teds_provision.protocol.handover.strict_json import is_label
from teds_provision.provisioning.agree import ResetReceipt
from teds_provision.provisioning.board_type import WrongBoardError, differences
from teds_provision.provisioning.build import BuildOrder, build, pending_image
from teds_provision.station.measurements import HandedOn
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, NodeRecord, RevocationRecord
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import BlockId, Image

DECOMMISSIONED = "decommissioned"
REPLACED = "replaced by"
UNCONFIRMED = ", unconfirmed"


@dataclass(frozen=True)
class RevokeResult:
    """A node on the deny list; ``fresh`` False if there was nothing left to do."""

    entry: RevocationRecord
    fresh: bool


def already_revoked(station: Station, uuid: bytes) -> RevokeResult | None:
    """Return the ban of a node if nothing of it is left to revoke here, else None."""
    present = station.policy.revocation(uuid)
    if present is None or station.keys.held(uuid) or station.pins.entry(uuid) is not None:
        return None
    return RevokeResult(present, fresh=False)


def revoke(station: Station, uuid: bytes, why: str) -> RevokeResult:
    """Ban a node's key: off the whitelist, its keys deleted, and a signed statement that travels in every bundle."""
    if not why.strip() or not is_label(why):
        raise UsageError("Give the reason, in printable text of at most 1,024 characters.")
    done = already_revoked(station, uuid)
    if done is not None:
        return done
    statement = None
    if station.policy.revocation(uuid) is None:
        now = datetime.now(UTC)
        key = station.vault.identity()
        pinned = station.pins.pinned(uuid)
        # a statement names a whole fingerprint; without one it bans all keys of the UUID
        banned = pinned if is_whole(pinned) else None
        statement = seal_revocation(key, uuid=uuid, node=banned, why=why, created=now)
    with station.transaction():
        if statement is not None:
            deny(station, statement, key=statement.fingerprint)
            station.plant.record_event("revoked", uuid, statement=statement.statement)
        station.pins.remove(uuid)
        keys = station.keys.remove(uuid)
        station.datasheets.drop_draft(uuid)
        station.audit("revoke", uuid, "done", why=why, keys=keys)
    entry = station.policy.revocation(uuid)
    assert entry is not None
    return RevokeResult(entry, fresh=True)


def is_retired(record: NodeRecord | None) -> bool:
    """Return True if a node was taken out of service."""
    return record is not None and (record.retired or "").startswith((DECOMMISSIONED, REPLACED))


def is_finished(station: Station, uuid: bytes) -> bool:
    """Return True if a node was taken out of service and has signed that it is in factory state."""
    record = station.nodes.get(uuid)
    return record is not None and is_retired(record) and not (record.retired or "").endswith(UNCONFIRMED)


def retire(station: Station, uuid: bytes, receipt: ResetReceipt | None, *, as_: str = DECOMMISSIONED) -> HandedOn:
    """Take a node out of service, and out of its groups and measurements, which are returned.

    Without its receipt that is unconfirmed, and its keys stay for another try.
    """
    record = station.nodes.get(uuid)
    retired = as_ if receipt is not None else as_ + UNCONFIRMED
    with station.transaction():
        station.pins.remove(uuid)
        station.datasheets.drop_draft(uuid)
        station.nodes.remember(uuid, name=None, retired=retired)
        left = station.measurements.hand_on(uuid, None)
        detail: dict[str, object] = {"proof": receipt.proof.hex()} if receipt is not None else {}
        detail |= {name: values for name, values in left.to_json().items() if values}
        station.audit("decommission", uuid, retired, name=record.name if record else None, **detail)
    return left


@dataclass(frozen=True)
class TakeoverPlan:
    """Data that a spare takes over; ``calibration`` counts the channels whose calibration goes along.

    ``draft`` is what was built for the spare and never written: it is dropped.
    """

    old: NodeRecord
    new: NodeRecord
    calibration: dict[BlockId, bytes]
    draft: Draft | None = None

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence about the draft that is dropped, if there is one."""
        if self.draft is None:
            return ()
        profile = f" as {self.draft.profile}" if self.draft.profile else ""
        return (
            f"The draft of node {self.new.uuid.hex()} ({self.draft.stage}{profile}) was never written; it is dropped.",
        )

    @property
    def done(self) -> bool:
        """True if the spare is in its place already."""
        return (self.old.retired or "").startswith(f"{REPLACED} {self.new.uuid.hex()}")


def plan_takeover(station: Station, old: bytes, new: bytes, *, copy_calibration: bool) -> TakeoverPlan:
    """Look at both nodes.

    Raises NotFoundError (OLD unknown, no calibration known), UsageError, NotWhitelistedError (NEW), WrongBoardError (by
    their last readings NEW is of another type).
    """
    if old == new:
        raise UsageError("A node cannot replace itself.")
    before = station.nodes.get(old)
    if before is None:
        raise NotFoundError(f"Node {old.hex()} is not known here.", hint="See: teds-provision nodes")
    station.policy.require_not_given_away(old)
    station.policy.require_whitelisted(new)
    after = station.nodes.get(new) or NodeRecord(new)
    plan = TakeoverPlan(before, after, _calibration_of(station, before) if copy_calibration else {})
    if not plan.done:
        _require_same_type(station, old, new)
        if pending_image(station, new, station.datasheets.datasheet(new)) is not None:
            return replace(plan, draft=station.datasheets.draft(new))
    return plan


def _require_same_type(station: Station, old: bytes, new: bytes) -> None:
    """Refuse before OLD is reset: the spare's datasheet could not be written afterwards."""
    has, wanted = station.datasheets.datasheet(new), station.datasheets.datasheet(old)
    changes = differences(has.blocks, wanted) if has is not None and wanted is not None else ()
    if changes:
        more = f" (and {len(changes) - 1} more)" if len(changes) > 1 else ""
        raise WrongBoardError(
            f"Node {new.hex()} is of a different type: {changes[0].rstrip('.')}{more}. Nothing was changed.",
            changes,
            hint=f"Name a spare of the same type, or first change its type: provision {new.hex()} --retype",
        )


def _calibration_of(station: Station, old: NodeRecord) -> dict[BlockId, bytes]:
    """Return the Calibration TEDS of a node's last reading.

    Raises NotFoundError, BadDataError (they cannot be built in).
    """
    image = station.datasheets.datasheet(old.uuid) or Image(old.uuid, {})
    blocks = {
        block: octets for block, octets in image.blocks.items() if block[1] == AccessCode.CALIBRATION and block[0]
    }
    # The spare's channel is compared with the old TransducerChannel TEDS to see if the calibration fits. The
    # certificate is left out: it is about another sensor.
    described = [(number, AccessCode.CHANNEL) for number, _ in blocks]
    blocks |= {block: image.blocks[block] for block in described if block in image.blocks}
    if not blocks:
        raise NotFoundError(f"No calibration of node {old.uuid.hex()} is known here.", hint="Omit --copy-calibration.")
    if old.profile is None:
        raise BadDataError("The profile of the old node is not known, so its calibration cannot be built in.")
    return blocks


def hand_on(station: Station, plan: TakeoverPlan) -> HandedOn:
    """Move what is still with the old node: groups, chosen names, measurements; for a spare in its place already."""
    with station.transaction():
        moved = station.measurements.hand_on(plan.old.uuid, plan.new.uuid)
        if moved != HandedOn(kept=moved.kept):
            station.audit("replace", plan.new.uuid, "moved", old=plan.old.uuid.hex(), **moved.to_json())
    return moved


def take_over(station: Station, plan: TakeoverPlan, receipt: ResetReceipt | None) -> tuple[tuple[str, ...], HandedOn]:
    """Give the spare name, groups, measurements and profile, and take the old node out of service, in one transaction.

    Returns warnings (with a calibration the spare's datasheet is built, to be signed and written), and what it moved.
    """
    old, new = plan.old, plan.new.uuid
    warnings = plan.warnings
    with station.transaction():
        moved = station.measurements.hand_on(old.uuid, new)
        if not plan.done:
            entry, former = station.pins.entry(new), station.pins.entry(old.uuid)  # which retire() takes away
            retire(station, old.uuid, receipt, as_=f"{REPLACED} {new.hex()}")  # before the spare takes its name
            if entry is not None and former is not None and former.name is not None:
                station.pins.put(replace(entry, name=former.name))
            station.datasheets.drop_draft(new)
            station.nodes.remember(new, name=old.name, profile=old.profile)
            if plan.calibration:
                order = BuildOrder(old.profile, name=old.name)
                warnings += build(station, new, order, has=Image(new, plan.calibration)).warnings
            detail = {name: values for name, values in moved.to_json().items() if values}
            station.audit("replace", new, "done", old=old.uuid.hex(), calibration=bool(plan.calibration), **detail)
        else:
            retire(station, old.uuid, receipt, as_=f"{REPLACED} {new.hex()}")
    return warnings, moved
