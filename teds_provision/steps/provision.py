"""All steps in one: identify, whitelist, agree, build, sign, write, verify (Figures 3 and 4 of the papers).

Each step looks at what is there already, so that an interrupted run is carried on by the same call and a finished one
finds nothing to do.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from teds_provision.errors import PolicyRefused
from teds_provision.protocol.datasheet import NodeKeys
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station
from teds_provision.steps.agree import Agreed, agree
from teds_provision.steps.build import BuildOrder, Built, build, check_order
from teds_provision.steps.identify import Identified, identify
from teds_provision.steps.read import Survey, survey
from teds_provision.steps.sign import Signed, sign
from teds_provision.steps.verify import Verified
from teds_provision.steps.verify_node import verify_node
from teds_provision.steps.write import Written, write
from teds_provision.store import Draft, WhitelistEntry
from teds_provision.store.records import Assurance
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.progress import DONE, NOTHING, Reporter, StepResult, Steps
from teds_provision.teds.image import SECURITY, Image

Accept = Callable[[Identified], None]
"""Asked before an unknown node is whitelisted; raises (or aborts) where the answer is no."""


@dataclass(frozen=True)
class Provisioned:
    """The end of a run: its steps, what stands on the node, and the verdict."""

    who: Identified
    steps: tuple[StepResult, ...]
    image: Image
    verified: Verified
    warnings: tuple[str, ...]


def provision(
    station: Station, node: Conversation, order: BuildOrder, *, accept: Accept, reporter: Reporter
) -> Provisioned:
    """Bring one node from wherever it stands to a verified datasheet; raises at the first step that fails."""
    return _Run(station, node, order, accept, reporter).run()


class _Run:
    def __init__(
        self, station: Station, node: Conversation, order: BuildOrder, accept: Accept, reporter: Reporter
    ) -> None:
        self.station, self.node, self.order = station, node, order
        self.accept, self.reporter = accept, reporter
        self.steps = Steps(reporter)

    def run(self) -> Provisioned:
        who = self._identify()
        check_order(self.station, who.uuid, self.order)
        self._whitelist(who)
        self._agree(who)
        present = survey(self.node)
        earlier = _signed_draft(self.station.nodes.draft(who.uuid))
        built = self._build(present)
        signed = self._sign(who, built, present, earlier)
        written = self._write(signed, present)
        verified = self._verify(who, written)
        return Provisioned(who, tuple(self.steps.done), written.on_node, verified, built.warnings)

    def _identify(self) -> Identified:
        with self.steps.step("identify") as step:
            who = identify(self.station, self.node)
            step.detail = f"{who.uuid.hex()}, key {who.fingerprint[:16]}"
        return who

    def _whitelist(self, who: Identified) -> None:
        with self.steps.step("whitelist") as step:
            if who.whitelisted is not None:
                step.result = NOTHING
                return
            self.accept(who)
            add_to_whitelist(self.station, self.node, who)

    def _agree(self, who: Identified) -> Agreed:
        with self.steps.step("agree") as step:
            agreed = agree(self.station, self.node, who)
            step.result = DONE if agreed.fresh else NOTHING
            step.detail = f"key epoch {agreed.epoch}, key {agreed.key_id}"
        return agreed

    def _build(self, present: Survey) -> Built:
        from teds_provision.teds.calibration import sentence

        with self.steps.step("build") as step:
            keep = {block: present.image.blocks[block] for block in present.read_only}
            built = build(self.station, self.node.uuid, self.order, has=present.image, keep=keep)
            if built.image.unsigned_blocks() == present.image.unsigned_blocks():
                step.result = NOTHING
            fits = "".join(f"; {sentence(calibration)}" for calibration in built.calibrations.values())
            step.detail = f"{built.profile}, {len(built.image.blocks)} TEDS{fits}"
        return built

    def _sign(self, who: Identified, built: Built, present: Survey, earlier: bytes | None) -> Signed:
        with self.steps.step("sign") as step:
            keys = NodeKeys(who.uuid, who.point, who.key_signature)
            # a node whose TEDS are not what it was signed for takes them only under a newer sequence
            intact = present.image.unsigned_blocks() == built.image.unsigned_blocks()
            signed = sign(
                self.station,
                keys,
                built.image,
                epoch=present.identity.epoch,
                node_sequence=present.identity.sequence,
                on_node=present.image.security if intact and present.identity.state == NodeState.PROVISIONED else None,
                earlier=() if earlier is None else (earlier,),
            )
            self.station.nodes.keep_draft(Draft(who.uuid, signed.image, "signed", built.profile))
            step.result = NOTHING if signed.reused else DONE
            step.detail = f"sequence {signed.sequence}"
        return signed

    def _write(self, signed: Signed, present: Survey) -> Written:
        with self.steps.step("write") as step:
            written = write(self.station, self.node, signed.image, has=present.image, progress=self.reporter.written)
            step.result = DONE if written.octets else NOTHING
            step.detail = f"{written.octets} octets" if written.octets else ""
        return written

    def _verify(self, who: Identified, written: Written) -> Verified:
        with self.steps.step("verify") as step:
            verified = verify_node(self.station, self.node, written.on_node, who.point)
            step.detail = verified.verdict
        return verified


def add_to_whitelist(station: Station, node: Conversation, who: Identified) -> WhitelistEntry:
    """Whitelist a node that was just identified, pinned to its key: by tap, or by the bus of a new CAN-only node.

    A node that already has a key is not pinned over a bus, where anyone may show any UUID; its first tap does. An
    entry that another process made meanwhile stays. Raises PolicyRefused (revoked), OtherKey.
    """
    new = who.state == NodeState.FACTORY
    assurance: Assurance = "tap" if node.tapped else "bus" if new else "uuid"
    pinned = who.fingerprint if node.tapped or new else None
    entry = WhitelistEntry(who.uuid, pinned, assurance=assurance)
    with station.transaction():
        revoked = station.policy.revocation(who.uuid)
        if revoked is not None:
            raise PolicyRefused(f"Node {who.uuid.hex()} was revoked: {revoked.why}.", hint="It was not whitelisted.")
        station.pins.check(who.uuid, who.point)
        present = station.pins.entry(who.uuid)
        if present is not None:
            return present
        station.pins.put(entry)
        if pinned is not None:
            station.nodes.remember(who.uuid, point=who.point)
        station.audit("whitelist", who.uuid, "added", fingerprint=pinned, assurance=assurance)
    return entry


def _signed_draft(draft: Draft | None) -> bytes | None:
    """The Security TEDS of a signed draft, None for a built one."""
    if draft is None or draft.stage != "signed":
        return None
    return draft.image.blocks.get(SECURITY)
