"""All steps in one: identify, whitelist, agree, build, sign, write, verify (Figures 3 and 4 of the papers).

Each step looks at what is there already, so that an interrupted run is carried on by the same call and a finished one
finds nothing to do.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Protocol

from teds_provision.errors import StoreError, TedsProvisionError
from teds_provision.links import LinkSettings
from teds_provision.protocol.datasheet import SignedNodeKey
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.adoption import read_factory_datasheet, require_a_reason
from teds_provision.provisioning.agree import AgreeResult, agree, require_own_ca
from teds_provision.provisioning.board_type import (
    HardwareCheck,
    check_hardware,
    differences,
    further,
    is_remembered,
    require_board_type,
    shown_by,
)
from teds_provision.provisioning.build import (
    BuildOrder,
    PreparedOrder,
    Proposal,
    certificate_brought,
    named_for,
    no_profile,
    prepare,
    propose,
)
from teds_provision.provisioning.calibration_guard import merged
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.firmware import read_firmware, require_firmware
from teds_provision.provisioning.identify import IdentifiedNode, identify, new_whitelist_entry
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import Operator
from teds_provision.provisioning.progress import DONE, NOTHING, SKIPPED, Reporter, StepResult, Steps
from teds_provision.provisioning.sign import SignResult, require_not_measured, sign
from teds_provision.provisioning.teds_read import NodeSnapshot, take_snapshot
from teds_provision.provisioning.verify_node import judge_and_keep, verify_at_node
from teds_provision.provisioning.write import WriteResult, write
from teds_provision.shapes.verdict import Verification
from teds_provision.station.firmware import FirmwareDemands, FirmwareReading
from teds_provision.station.shown_units import shown_units, units_of
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from teds_provision.teds.calibration.formula import sentence
from teds_provision.teds.certificate import CertificateReference
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile.firmware import FirmwareDemand

Order = BuildOrder | PreparedOrder | Callable[["IdentifiedNode"], PreparedOrder]
"""What a node gets: as it was ordered, read already, or by its identity (which raises if it gets nothing)."""
Onward = Callable[[Conversation], None]
"""Takes the conversation to another link; see ``provisioning/meeting.py``."""


@dataclass(frozen=True)
class ProvisionResult:
    """End of a run: its steps, the node's content, and the verdict."""

    who: IdentifiedNode
    steps: tuple[StepResult, ...]
    image: Image
    verified: Verification
    warnings: tuple[str, ...]
    samples: tuple[dict[str, Any], ...] = ()
    """One reading of each sensor at the end: channel, name, value and unit (SI), valid."""
    certificate: CertificateReference | None = None
    """The certificate that this run calibrated the node by."""
    firmware: FirmwareReading | None = None
    """The firmware that the node reported in the session of this run."""


def verify_only(station: Station, node: Conversation, line: ProductionLine, reporter: Reporter) -> ProvisionResult:
    """Test one board that another station made: identify, verify, check; writes nothing, records evidence.

    Raises what :func:`provision` raises; the verdict reports a board that is not authentic.
    """
    steps, unit = Steps(reporter), None
    try:
        with station.node_lock(node.uuid), station.released(node.uuid, "provision"):
            with steps.step("identify") as step:
                who = identify(station, node)
                step.detail = f"{who.uuid.hex()}, key {who.fingerprint[:16]}"
            prepared = line.order(who)
            unit = line.allot_unit(node, who, prepared, None)
            try:
                with steps.step("verify") as step:
                    looked = verify_at_node(station, node, who)
                    step.take_verdict(looked.verified.verdict)
                    changes = differences(looked.image.blocks, prepared.profile) if prepared.profile is not None else ()
                    if changes:
                        require_board_type(who.uuid, changes)
                with steps.step("check") as step:
                    firmware = read_firmware(node)
                    passed = looked.verified.verdict == "authentic" and node.sealed
                    borne = check_hardware(node, looked.image) if passed else HardwareCheck({})
                    step.result = DONE if borne.asked else SKIPPED
                done = ProvisionResult(
                    who,
                    tuple(steps.done),
                    looked.image,
                    looked.verified,
                    borne.warnings,
                    borne.samples,
                    firmware=firmware,
                )
                unit.ended(node, done)
            except (TedsProvisionError, SessionLostError) as error:
                cause = error.cause if isinstance(error, SessionLostError) else error
                unit.failed(node, who, steps.done, steps.current, cause)
                raise
            return done
    except TedsProvisionError as error:
        with suppress(StoreError):
            station.audit("provision", node.uuid, error.code, step=steps.current, why=error.message)
        raise


# -- the interface of a line (plant/line.py): an order, a unit before the key agreement, proof at the end --------------


class Unit(Protocol):
    """One board of a line, from before its key is agreed on until it is done."""

    @property
    def prepared(self) -> PreparedOrder:
        """The board's order, including its name; its unit is on the disk. Raises PolicyError if no unit is left."""

    def sign(
        self, node: Conversation, keys: SignedNodeKey, proposal: Proposal, present: NodeSnapshot
    ) -> SignResult | None:
        """Return the datasheet signed elsewhere; None if this station signs."""

    def ended(self, node: Conversation, done: ProvisionResult) -> None:
        """Leave proof, in the session that is open."""

    def failed(
        self, node: Conversation, who: IdentifiedNode, steps: Sequence[StepResult], step: str, error: TedsProvisionError
    ) -> None:
        """Leave proof of an attempt that ended with an error in ``step``, as far as the board still answers."""


class ProductionLine(Protocol):
    """State that all boards of a run share."""

    @property
    def total(self) -> int:
        """The number of boards, 0 if it is unknown."""

    @property
    def passed(self) -> int:
        """How many have passed, over all runs."""

    @property
    def base(self) -> BuildOrder:
        """Settings of all boards."""

    def order(self, who: IdentifiedNode) -> PreparedOrder:
        """Return what this board gets; raises PolicyError if it gets nothing."""

    @property
    def only_verify(self) -> bool:
        """True if boards are only tested, and nothing is written."""

    def unit_to_json(self, uuid: bytes) -> dict[str, Any]:
        """Return the members about a board beside its steps."""

    def lists(self, who: IdentifiedNode) -> bool:
        """Return True if the job names this very board, by UUID and key."""

    def is_listed(self, uuid: bytes) -> bool:
        """Return True if the job names this UUID."""

    def allot_unit(
        self, node: Conversation, who: IdentifiedNode, prepared: PreparedOrder, entry: WhitelistEntry | None
    ) -> Unit:
        """Have a unit taken for this board, or find the one that it has; ``entry`` is a newcomer's.

        It is on the disk with the agreed key, before the board has that. Raises PolicyError, and then no unit was
        taken; the step that takes it raises it too if another process was given the last one meanwhile.
        """


def provision(
    station: Station,
    node: Conversation,
    order: Order,
    *,
    operator: Operator,
    reporter: Reporter,
    onward: Onward | None = None,
    line: ProductionLine | None = None,
    named: Callable[[IdentifiedNode], bool] = lambda _who: False,
) -> ProvisionResult:
    """Bring one node from any state to a verified datasheet; raises at the first step that fails.

    The session ends with a run that went well.

    ``operator`` answers what a person has to decide. ``named``: a sheet or job names this very board, so it is
    whitelisted without a question. ``onward`` moves the conversation to another link after the agreement. ``line``
    gives the board a unit before the agreement, and records its evidence. A failure is in the audit log with its step.
    """
    run = _Run(station, node, order, operator, reporter, onward=onward, line=line, named=named)
    try:
        with station.node_lock(node.uuid), station.released(node.uuid, "provision") as released, station.run():
            run.released = bool(released)
            return run.proven()
    except TedsProvisionError as error:
        with suppress(StoreError):  # a full disk must not hide what happened
            station.audit("provision", node.uuid, error.code, step=run.steps.current, why=error.message)
        raise


def key_board(station: Station, node: Conversation, *, operator: Operator, reporter: Reporter) -> IdentifiedNode:
    """Identify, whitelist and agree, as :func:`provision` begins, for a board that gets new firmware before the rest.

    ``operator`` is asked as there.
    """
    run = _Run(station, node, BuildOrder(), operator, reporter)
    with station.node_lock(node.uuid), station.released(node.uuid, "provision"), station.run():
        return run.keyed()


class _Run:
    def __init__(
        self,
        station: Station,
        node: Conversation,
        order: Order,
        operator: Operator,
        reporter: Reporter,
        *,
        onward: Onward | None = None,
        line: ProductionLine | None = None,
        named: Callable[[IdentifiedNode], bool] = lambda _who: False,
    ) -> None:
        self.station, self.node, self.order = station, node, order
        self.operator, self.reporter, self.named = operator, reporter, named
        self.steps, self.onward, self._retyped = Steps(reporter), onward, False
        self.line = line
        self.unit: Unit | None = None
        self._enlisting: StepResult | None = None
        self.released = False  # True if the running `ncap` measured the node and released it

    def proven(self) -> ProvisionResult:
        """Return the run.

        An error of a board that has a unit is recorded as evidence too, while the board may be there.
        """
        who = self._identify()
        try:
            done = self.run(who)
            if self.unit is not None:
                self.unit.ended(self.node, done)
        except (TedsProvisionError, SessionLostError) as error:
            if self.unit is not None:
                cause = error.cause if isinstance(error, SessionLostError) else error
                self.unit.failed(self.node, who, self.steps.done, self.steps.current, cause)
            raise
        self.node.leave()  # meanwhile the last record is written to disk
        return done

    def keyed(self) -> IdentifiedNode:
        """Run only identify, whitelist and agree, and return the node."""
        who = self._identify()
        self._agree(who, self._whitelist(who))
        return who

    def run(self, who: IdentifiedNode) -> ProvisionResult:
        prepared = self._prepared(who)
        # Before the board is keyed, or uses up a unit.
        if prepared.profile is not None and (who.state == NodeState.FACTORY or self.line is not None):
            shown = shown_by(self.node, {channel.number for channel in prepared.profile.channels})
            changes = differences(shown, prepared.profile, prepared.calibrations or ())
            self._require_its_board(who, prepared, changes)
        demand = self._firmware_demand(who, prepared)
        if demand is not None:  # unauthenticated, so it can cause a refusal but not an acceptance
            require_firmware(who.uuid, demand, read_firmware(self.node))
        entry = self._whitelist(who)
        if self.line is not None:
            self.unit = self.line.allot_unit(self.node, who, prepared, entry)
        self._agree(who, entry)
        if self.unit is not None:
            prepared = self.unit.prepared
        if self.onward is not None:
            self.onward(self.node)
        firmware = read_firmware(self.node)
        require_firmware(who.uuid, demand, firmware or FirmwareReading(None, sealed=True))
        present = take_snapshot(self.node, initial=None if who.recalled else who.security_teds)
        proposal = self._build(who, prepared, present)
        signed = self._sign(who, proposal, present)
        written = self._write(signed, proposal, present)
        verified = self._verify(who, written)
        borne = self._check(prepared, written, verified)
        warnings = merged((*proposal.warnings, *further(present.image.blocks, proposal.image), *borne.warnings))
        certificate = certificate_brought(proposal.calibrations)
        return ProvisionResult(
            who, tuple(self.steps.done), written.on_node, verified, warnings, borne.samples, certificate, firmware
        )

    def _firmware_demand(self, who: IdentifiedNode, prepared: PreparedOrder) -> FirmwareDemand | None:
        """Return what the type that this board gets, or has, demands of its firmware."""
        if prepared.profile is not None:
            return prepared.profile.firmware
        known = self.station.nodes.get(who.uuid)
        return FirmwareDemands(self.station.home).demand_of(known.profile if known is not None else None)

    def _require_its_board(self, who: IdentifiedNode, prepared: PreparedOrder, changes: tuple[str, ...]) -> None:
        """Ask, or refuse, if the board claims another type; only the first of the two checks asks."""
        wanted = prepared.order.profile
        if not changes or prepared.order.retype or self._retyped:
            return
        if is_remembered(self.station, who.uuid, wanted, factory=who.state == NodeState.FACTORY):
            return
        self.operator.retype(who.uuid, changes)
        self._retyped = True

    def _identify(self) -> IdentifiedNode:
        with self.steps.step("identify") as step:
            # A line's evidence states what the board sent, so nothing is recalled from the store.
            who = identify(self.station, self.node, expect=self._choose, recall=self.line is None)
            step.detail = f"{who.uuid.hex()}, key {who.fingerprint[:16]}"
        return who

    def _choose(self, who: IdentifiedNode) -> None:
        if callable(self.order):
            self.order = self.order(who)

    def _prepared(self, who: IdentifiedNode) -> PreparedOrder:
        """Return the order for this very node; what was read before the tap is not read again."""
        order = self.order
        prepared = prepare(self.station, order, who.uuid) if isinstance(order, BuildOrder) else order
        assert isinstance(prepared, PreparedOrder), "_choose() has asked"
        # the calibration is for the type that this node has
        if prepared.profile is None and prepared.order.calibration is not None:
            prepared = prepare(self.station, prepared.order, who.uuid)
        if prepared.profile is None and who.state != NodeState.PROVISIONED and not prepared.order.adopt:
            known = self.station.nodes.get(who.uuid)
            if known is None or known.profile is None:
                raise no_profile(who.uuid)
        return named_for(self.station, who.uuid, prepared, keep=True)

    def _whitelist(self, who: IdentifiedNode) -> WhitelistEntry | None:
        """Return the node's whitelist entry to be made durable with the key, None if it is whitelisted.

        Until then the step is open: it is reported as done by :meth:`_agree`, once the entry is kept.
        """
        with self.steps.deferred("whitelist") as step:
            if who.whitelisted is not None:
                step.result = NOTHING
                self.steps.finish(step)
                return None
            require_own_ca(self.station, who.uuid, who.state, who.security_teds)
            entry = new_whitelist_entry(self.station, self.node, who)
            if not self.named(who):
                self.operator.accept(who)
        self._enlisting = step
        return entry

    def _agree(self, who: IdentifiedNode, entry: WhitelistEntry | None) -> AgreeResult:
        listed = False  # listed with a new key: do not wait for the record that is being written
        try:
            with self.steps.deferred("agree") as step:
                agreed = agree(self.station, self.node, who, newcomer=entry, take_over=self.operator.take_over)
                listed = agreed.listed
                step.result = DONE if agreed.fresh else NOTHING
                step.detail = f"key epoch {agreed.epoch}, key {agreed.key_id}"
        finally:
            if self._enlisting is not None and (listed or self.station.pins.entry(who.uuid) is not None):
                self.steps.finish(self._enlisting)
        self.steps.finish(step)
        return agreed

    def _build(self, who: IdentifiedNode, prepared: PreparedOrder, present: NodeSnapshot) -> Proposal:
        with self.steps.step("build") as step:
            # check the type first, so that a calibration is compared with the right channel
            if prepared.profile is not None:
                changes = differences(present.image.blocks, prepared.profile, prepared.calibrations or ())
                self._require_its_board(who, prepared, changes)
            brings = prepared.order.adopt and present.identity.state != NodeState.PROVISIONED
            proposal = self._adopted(prepared, present) if brings else propose(self.station, prepared, present)
            self._require_its_board(who, prepared, differences(present.image.blocks, proposal.image))
            proposal.require_a_yes(self.operator.confirm)
            if not proposal.changes:
                step.result = NOTHING
            fits = "".join(f"; {sentence(calibration)}" for calibration in proposal.calibrations.values())
            kind = f"{proposal.profile}, " if proposal.profile else ""
            step.detail = f"{kind}{len(proposal.image.blocks)} TEDS{fits}"
        return proposal

    def _adopted(self, prepared: PreparedOrder, present: NodeSnapshot) -> Proposal:
        """Return the board's own datasheet, judged and confirmed; unchanged but for its name, if one is given."""
        brought = read_factory_datasheet(self.station, present.image, name=prepared.order.name)
        reason = prepared.order.accept_calibration
        if brought.errors and reason is None:
            require_a_reason(self.station, brought, None)
        self.operator.adopt(brought)
        require_a_reason(self.station, brought, reason)
        self.station.audit("adopt", brought.image.uuid, "accepted", teds=brought.image.digest(), name=brought.name)
        return Proposal(brought.image, (), True, brought.warnings, name=brought.name or None)

    def _sign(self, who: IdentifiedNode, proposal: Proposal, present: NodeSnapshot) -> SignResult:
        with self.steps.step("sign") as step:
            keys = SignedNodeKey(who.uuid, who.point, who.key_signature)
            elsewhere = None if self.unit is None else self.unit.sign(self.node, keys, proposal, present)
            if elsewhere is not None:
                step.result = NOTHING if elsewhere.reused else DONE
                step.detail = f"sequence {elsewhere.sequence}, by the office"
                return elsewhere
            draft = self.station.datasheets.draft(who.uuid)
            earlier = draft.image.blocks.get(SECURITY) if draft is not None and draft.stage == "signed" else None
            # If the node's TEDS differ from the signed ones, it accepts them only with a newer sequence.
            intact = present.image.unsigned_blocks() == proposal.image.unsigned_blocks()
            signed = sign(
                self.station,
                keys,
                proposal.image,
                epoch=present.identity.epoch,
                node_sequence=present.identity.sequence,
                on_node=present.image.security if intact and present.identity.state == NodeState.PROVISIONED else None,
                earlier=() if earlier is None else (earlier,),
                keep_draft=True,
                profile=proposal.profile,
                write_follows=True,
                before=lambda: require_not_measured(self.station, self.node, released=self.released),
            )
            step.result = NOTHING if signed.reused else DONE
            step.detail = f"sequence {signed.sequence}"
        return signed

    def _write(self, signed: SignResult, proposal: Proposal, present: NodeSnapshot) -> WriteResult:
        with self.steps.step("write") as step:
            facts = {"profile": proposal.profile, "name": proposal.name, "profile_digest": proposal.profile_digest}
            written = write(
                self.station,
                self.node,
                signed.image,
                present=present,
                progress=self.reporter.written,
                facts={fact: value for fact, value in facts.items() if value is not None},
                low=self.operator.low_battery,
            )
            step.result = DONE if written.octets else NOTHING
            step.detail = f"{written.octets} octets" if written.octets else ""
        return written

    def _check(self, prepared: PreparedOrder, written: WriteResult, verified: Verification) -> HardwareCheck:
        """Check that the hardware accepts the datasheet, and take one reading; skipped if it is not authentic."""
        with self.steps.step("check") as step:
            if verified.verdict != "authentic":
                step.result = SKIPPED
                return HardwareCheck({})
            profile = prepared.profile
            units = shown_units(self.station, self.node.uuid) if profile is None else units_of(profile.channels)
            borne = check_hardware(self.node, written.on_node, units)
            step.result = DONE if borne.asked else SKIPPED
            good = sum(bool(channel) for channel in borne.channels.values())
            step.detail = (
                f"{good} of {len(borne.channels)} channels match the hardware" if borne.asked else "it does not measure"
            )
        return borne

    def _verify(self, who: IdentifiedNode, written: WriteResult) -> Verification:
        with self.steps.step("verify") as step:
            # For a line, evidence follows, and only its challenge to the board comes before it.
            verified = judge_and_keep(
                self.station,
                self.node,
                written.on_node,
                who.point,
                by="provision",
                more_follows=self.unit is not None,
            ).verified
            step.take_verdict(verified.verdict)
        return verified


def key_board_at(
    station: Station,
    links: LinkSettings,
    node: str | None,
    reporter: Reporter,
    *,
    operator: Operator,
) -> bytes:
    """Identify, whitelist and key the board that ``node`` names (None: the one that is there); return its UUID."""
    wanted = None if node is None else station.nodes.resolve(node)
    with meet(station, links, wanted, reporter, before=station.unlock) as there:
        return key_board(station, there, operator=operator, reporter=reporter).uuid
