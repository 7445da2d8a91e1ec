"""Runs the rules in stages, and makes keys durable: after an interrupted run, no node's key is lost."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace

from teds_provision.check import (
    agreement_rules,
    firmware_rules,
    frame_rules,
    link_rules,
    measuring_rules,
    plain_rules,
    session_rules,
    write_rules,
)
from teds_provision.check.agreement_rules import ExplainedRequest, explain
from teds_provision.check.probe import NotApplicableError, Probe, RuleBrokenError, TraceRecorder
from teds_provision.check.rule import RULES, Rule, RuleResult, Stage
from teds_provision.errors import BadDataError, GarbledError, LinkError, NotAuthenticError, PolicyError
from teds_provision.links import LinkSettings
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.frames import Function, Reason, security_command
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.wire_agreement import AgreedKey, key_id
from teds_provision.provisioning.agree import open_session, reset_node
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import examine
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.progress import Reporter
from teds_provision.station.station import NodeKey, Station

_REGISTERS = (
    plain_rules,
    firmware_rules,
    link_rules,
    frame_rules,
    agreement_rules,
    session_rules,
    write_rules,
    measuring_rules,
)
"""The modules whose rules are registered by being imported."""
_ONLY_FACTORY = "The node has a key. Use --factory to have it reset and keyed again."
_NEEDS_FACTORY = "Changes the node's key. Ask with --factory."
_NEEDS_KEY = "The node has no key. Ask with --factory to give it one."


_GONE = "The node no longer answers."
_TORN_TRIES = 3
"""The number of tries of a rule whose replies come torn; on a bus each try has its own repetitions below."""


@dataclass(frozen=True)
class CheckReport:
    """Every rule, in order, and the number of each result.

    ``lost`` is the reason why the rest could not be tried: the node fell silent, or the reader went away; None if all
    ran. ``explained`` is the test agreement, or the reason why there is none; None if none was requested.
    """

    uuid: bytes
    checks: tuple[RuleResult, ...]
    lost: LinkError | None = None
    explained: ExplainedRequest | str | None = None

    def count(self, result: str) -> int:
        """Return the number of rules with this result."""
        return sum(check.result == result for check in self.checks)


def check_at(
    station: Station, links: LinkSettings, reporter: Reporter, *, factory: bool, explained: bool = False
) -> CheckReport:
    """Run the rules against the node that is met first; see :func:`check_node`.

    Raises NoNodeError, NoReaderError as well.
    """
    heard = TraceRecorder(links.trace)
    with meet(station, replace(links, trace=heard), None, reporter, before=station.unlock) as node:
        return check_node(station, node, factory=factory, heard=heard, explained=explained)


def check_node(
    station: Station,
    node: Conversation,
    *,
    factory: bool = False,
    heard: TraceRecorder | None = None,
    explained: bool = False,
) -> CheckReport:
    """Run the rules against a node, most of which change nothing; ``heard`` has the frames of its link.

    Without ``factory`` no key changes: a factory node is tried in factory state, one of ours in sessions too. With it a
    node of ours is reset, then keyed, written and reset again, so that it ends in factory state. ``explained``: make a
    test agreement that is never confirmed, and return its values. A node that falls silent ends the run, with the
    results so far. Raises PolicyError for a node with another owner, before any command but Identify; LinkError before
    the first rule.
    """
    return _Run(station, node, factory, heard, explained=explained).all()


class _Run:
    def __init__(
        self, station: Station, node: Conversation, factory: bool, heard: TraceRecorder | None, *, explained: bool
    ) -> None:
        self._station, self._node, self._factory = station, node, factory
        self._probe = Probe(node.contact, heard)
        self._checks: dict[str, RuleResult] = {}
        self._explaining, self._explained = explained, None  # type: bool, ExplainedRequest | str | None
        self._lost: LinkError | None = None

    def all(self) -> CheckReport:
        try:
            ours = self._probe.identity().state != NodeState.FACTORY
        except RuleBrokenError:  # the rules report what is wrong with the reply
            ours = self._node.identity.state != NodeState.FACTORY
        if ours:
            self._take_up()
        elif self._factory:
            self._station.policy.require_not_given_away(self._node.uuid)
        ca = self._station.keys.ca_of(self._node.uuid) if ours else None
        self._probe.credentials = self._station.identity.credentials(ca) if ca else self._station.credentials()
        try:
            self._explain()
            self._stage(Stage.PLAIN)
            if ours:
                self._stage(Stage.KEYED)
                self._stage(Stage.SESSION)
                if not self._factory:  # TEDS may be written only in factory state; then these rules run later
                    self._stage(Stage.MEASURING)
            self._in_factory_state(ours)
        except LinkError as lost:
            self._lost = lost
            for stage in Stage:
                self._skip(stage, _GONE)
        for stage in Stage:
            held = stage in (Stage.KEYED, Stage.SESSION, Stage.MEASURING) and not self._factory
            self._skip(stage, _NEEDS_KEY if held else _NEEDS_FACTORY)
        stages = list(Stage)
        ordered = sorted(RULES, key=lambda rule: stages.index(rule.stage))
        checks = tuple(self._checks[rule.name] for rule in ordered)
        return CheckReport(self._node.uuid, checks, self._lost, self._explained)

    def _explain(self) -> None:
        """Compute, before any rule, why a node cannot agree; its figures go into the results of the rules."""
        if not self._explaining:
            return
        try:
            self._explained = explain(self._probe)
        except (RuleBrokenError, NotApplicableError) as no:
            self._explained = str(no)

    def _in_factory_state(self, ours: bool) -> None:
        """Run the rules of factory state, and of the way to a key and back; a node of ours is reset for them."""
        why = (self._reset() if self._factory else _ONLY_FACTORY) if ours else ""
        if why:
            for stage in Stage:
                self._skip(stage, why)
            return
        self._stage(Stage.FACTORY)
        if self._factory:
            self._key_and_back(sessions_too=not ours)

    # -- stages ----------------------------------------------------------------------------------------------------

    def _stage(self, stage: Stage) -> None:
        for rule in RULES:
            if rule.stage == stage:
                self._checks[rule.name] = self._try(rule)

    def _skip(self, stage: Stage, why: str) -> None:
        for rule in RULES:
            if rule.stage == stage and rule.name not in self._checks:
                self._checks[rule.name] = RuleResult(rule.name, rule.clause, "skipped", why)

    def _try(self, rule: Rule) -> RuleResult:
        for left in reversed(range(_TORN_TRIES)):
            try:
                return self._tried(rule)
            except GarbledError as torn:  # from the link, after its own repetitions
                why, self._probe.session = torn.message, None
                if left:
                    # raises LinkError if the node answers nothing: then it is lost, and this rule did not fail
                    self._probe.listen()
        also = " Identify was answered meanwhile: it is the node, or a very bad bus." if self._probe.noisy else ""
        text = f"{self._probe.asked}: no reply that can be read, {_TORN_TRIES} times.{also} {why}"
        return RuleResult(rule.name, rule.clause, "failed", text)

    def _tried(self, rule: Rule) -> RuleResult:
        slip = None
        try:
            return RuleResult(rule.name, rule.clause, "passed", rule.run(self._probe))
        except NotApplicableError as skip:
            self._probe.session = None
            return RuleResult(rule.name, rule.clause, "skipped", str(skip))
        except RuleBrokenError as broken:
            detail, slip = str(broken), broken.slip
        except GarbledError:
            raise
        except LinkError as lost:
            detail = f"{self._probe.asked}: {lost.message}"
            self._checks[rule.name] = RuleResult(rule.name, rule.clause, "skipped", detail)
            raise type(lost)(f"The node fell silent in the rule {rule.name}: {detail}", hint=lost.hint) from lost
        except (BadDataError, NotAuthenticError, PolicyError) as wrong:
            detail = wrong.message
        self._probe.session = None
        return RuleResult(rule.name, rule.clause, "failed", detail, slip.name if slip is not None else None)

    # -- keys ------------------------------------------------------------------------------------------------------

    def _take_up(self) -> None:
        """Load the link key of a node of ours; raises PolicyError if another owner has it, or it is unknown.

        A node that knows the key but opens no session is tried all the same: the rules then name the reason.
        """
        node, held = self._node, None
        if self._station.keys.held(node.uuid):
            held = open_session(self._station, node) or self._known_there()
        if held is None:
            raise PolicyError(
                f"Node {node.uuid.hex()} has a key that this station does not hold: nothing was tried.",
                hint="Check it from its owner's station, or reset it by hand (button held 5 s).",
            )
        self._probe.key = held.key
        node.leave()

    def _known_there(self) -> NodeKey | None:
        """Return the newest key of ours whose keyId the node knows: it answers a wrong mac with 12, not 16."""
        for held in self._station.keys.unwrapped(self._node.uuid):
            wrong = key_id(held.key) + SoftwareKey.generate().point + bytes(16)
            if self._probe.plain(security_command(Function.OPEN, wrong)).reason == Reason.BAD_TAG:
                return held
        return None

    def _reset(self) -> str:
        """Reset a node of ours as ``reset`` does: its keys are deleted here if the proof was good.

        Returns why not, else "".
        """
        try:
            reset_node(self._station, self._node, examine(self._station, self._node))
        except (BadDataError, NotAuthenticError, PolicyError) as no:
            (rule,) = [rule for rule in RULES if rule.name == "reset"]
            self._checks["reset"] = RuleResult("reset", rule.clause, "failed", no.message)
            return f"The node could not be reset. {no.message}"
        self._probe.key = self._probe.session = None
        self._probe.no_session = self._probe.no_agreement = ""
        return ""

    def _key_and_back(self, *, sessions_too: bool) -> None:
        probe = self._probe
        probe.credentials, probe.keep = self._station.credentials(), self._keep
        self._stage(Stage.AGREEMENT)
        if probe.key is None:
            ended = self._checks["agreement"]
            why = f"No key was agreed (rule agreement, {ended.result}): {ended.detail}"
            for stage in (Stage.KEYED, Stage.SESSION, Stage.COMMIT, Stage.MEASURING, Stage.ROTATION, Stage.RESET):
                self._skip(stage, why)
            return
        if sessions_too:
            self._stage(Stage.KEYED)
            self._stage(Stage.SESSION)
        self._stage(Stage.COMMIT)
        self._stage(Stage.MEASURING)
        with suppress(RuleBrokenError, NotApplicableError):  # a rule has already reported the fault
            measuring_rules.restore(probe)
        self._stage(Stage.ROTATION)
        self._stage(Stage.RESET)
        if self._checks["reset"].result == "passed":
            with self._station.durable("node check"):
                self._station.keys.remove(self._node.uuid)
                self._station.audit("reset", self._node.uuid, "done", by="node check")

    def _keep(self, agreed: AgreedKey) -> None:
        """Make a key durable here, before its Confirm leaves."""
        uuid, station = self._node.uuid, self._station
        with station.durable("node check"):
            station.keys.add_pending(uuid, key=agreed.key, key_id=agreed.key_id, epoch=agreed.epoch)
            station.keys.set_ca_of(uuid, station.identity.ca)
            station.audit("agree", uuid, "pending", key_id=agreed.key_id.hex(), by="node check")
