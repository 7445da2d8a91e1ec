"""Provisioning on request: it waits for the tap if one is needed, and reports every step as it happens.

A tap needs no button: the request contains the work, and it is done when its node is on the reader. A node on a wired
bus is provisioned there if it allows that; if it requires a tap, the run waits for it.
"""

from __future__ import annotations

import logging
import tempfile
import threading
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from teds_provision.errors import (
    BadDataError,
    NodeRefusedError,
    NotFoundError,
    PolicyError,
    StoreError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.links.ports import Notice
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.inspection import STRANGERS_TEDS
from teds_provision.ncap.nodes.node_jobs import NodeJob, NodeJobs, as_program_error
from teds_provision.ncap.nodes.virtual import Virtuals
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.adoption import FactoryDatasheet
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.provisioning.datasheet_edit import write_sheet
from teds_provision.provisioning.identify import identify, new_whitelist_entry
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.provisioning.teds_read import list_blocks
from teds_provision.provisioning.verify import require_authentic
from teds_provision.shapes.problem import Problem, problem_of
from teds_provision.shapes.verdict import Verification
from teds_provision.station.station import Station
from teds_provision.station.store.audit import ACTOR, acting_for

_log = logging.getLogger(__name__)
WAITING: Final = 300.0  # seconds for a tap
NEXT: Final = "next"
_SUFFIXES: Final = (".csv", ".json", ".toml", ".txt", ".xml")


@dataclass
class ProvisioningRun:
    """One request; as the API shows it by :meth:`as_json`."""

    uuid: str
    state: str = "running"  # waiting, running, done, failed, cancelled
    waits_for: str | None = None
    until: float | None = None
    steps: list[dict[str, Any]] = field(default_factory=list)
    error: Problem | None = None
    verdict: str | None = None
    job: NodeJob[Any] | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the object of api.md, `/nodes/UUID/provision`."""
        names = ("uuid", "state", "waits_for", "until", "steps", "error", "verdict")
        return {name: getattr(self, name) for name in names}


class Provisioning:
    """The requests of one daemon, one for each node at a time."""

    def __init__(
        self,
        station: Station,
        roster: NodeDirectory,
        live: Live,
        desk: NodeJobs,
        apart: Callable[[str, str], AbstractContextManager[None]] = lambda _uuid, _why: nullcontext(),
        *,
        trusted: tuple[Path, ...] = (),
    ) -> None:
        self._station, self._directory, self._live, self._node_jobs = station, roster, live, desk
        self._apart, self._trusted = apart, trusted
        self._runs: dict[str, ProvisioningRun] = {}
        self._guard = threading.Lock()

    def run_of(self, uuid: str) -> dict[str, Any]:
        """Return the state of the last request for a node; raises NotFoundError."""
        with self._guard:
            run = self._runs.get(uuid)
        if run is None:
            raise NotFoundError(f"No provisioning was requested for node {uuid}.", hint="Start one with POST.")
        return run.as_json()

    def begin(
        self,
        uuid: str,
        *,
        profile: str | None,
        name: str | None,
        calibration: str | None,
        calibration_name: str | None,
        channel: int | None = None,
        item: str | None = None,
        adopt: bool = False,
        accept: str | None = None,
    ) -> dict[str, Any]:
        """Begin a run; ``uuid`` may be ``next``: whichever node is tapped next. Return what it waits for.

        ``channel`` is the one that the calibration is for, ``item`` the result of a certificate. ``adopt``: the board's
        own datasheet is signed; ``accept`` is the reason to accept it in spite of findings.

        Raises UsageError, NotFoundError, BadDataError, PolicyError for what cannot be built, StoreError if no temporary
        file can be written, before any wait.
        """
        with self._guard:
            before = self._runs.get(uuid)
            if before is not None and before.state in ("waiting", "running"):
                raise UsageError(f"Node {uuid} is already being provisioned.", hint="Cancel that first.")
            run = self._runs[uuid] = ProvisioningRun(uuid)  # registered at once, so that a second request is refused
        # The steps read the calibration from a file, which is kept until the run has ended.
        folder: tempfile.TemporaryDirectory[str] | None = None
        try:
            folder = tempfile.TemporaryDirectory(prefix="ncap-")
            order = BuildOrder(
                profile=profile,
                calibration=_file(Path(folder.name), calibration, calibration_name),
                name=name,
                adopt=adopt,
                accept_calibration=accept,
                channel=channel,
                item=item,
                trusted=self._trusted,
            )
            prepare(self._station, order, None if uuid == NEXT else bytes.fromhex(uuid))
        except BaseException as error:
            if folder is not None:
                folder.cleanup()
            with self._guard:
                del self._runs[uuid]
                if before is not None:
                    self._runs[uuid] = before
            if isinstance(error, OSError):
                raise StoreError(
                    f"No temporary file can be written: {error.strerror or type(error).__name__}.",
                    hint=f"Make room in {tempfile.gettempdir()}, then try again.",
                ) from error
            raise

        who = ACTOR.get()

        def work(node: Conversation) -> None:
            with acting_for(who):  # the actor of the request, since this may run in another thread
                self._work(run, node, order)

        if uuid != NEXT and self._node_jobs.on_a_bus(uuid):
            self._publish(run)
            threading.Thread(
                target=self._on_the_bus, args=(run, work, folder.cleanup), name=f"provision {uuid[:8]}", daemon=True
            ).start()
        else:
            self._wait_for_a_tap(run, work, folder.cleanup)
        return run.as_json()

    def cancel(self, uuid: str) -> dict[str, Any]:
        """Cancel the wait; a run that has begun continues to its end. Raises NotFoundError."""
        with self._guard:
            run = self._runs.get(uuid)
        if run is None:
            raise NotFoundError(f"No provisioning was requested for node {uuid}.")
        if run.job is not None and self._node_jobs.cancel(run.job):
            run.state, run.waits_for, run.until = "cancelled", None, None
            run.job.done.set()
            self._publish(run)
        return run.as_json()

    # -- reaching the node -------------------------------------------------------------------------------------------

    def _wait_for_a_tap(
        self, run: ProvisioningRun, work: Callable[[Conversation], None], clean: Callable[[], None]
    ) -> None:
        run.state, run.waits_for, run.until = "waiting", "tap", time.time() + WAITING
        errand = run.job = self._node_jobs.wait_for(None if run.uuid == NEXT else run.uuid, "provision", work, WAITING)
        self._publish(run)

        def watch() -> None:
            if not errand.done.wait(WAITING) and self._node_jobs.cancel(errand):
                problem = Problem(
                    code="no-node",
                    message=f"Node {run.uuid} was not placed on a reader within {WAITING:.0f} s.",
                    hint="Try again, and hold its NFC antenna flat on the reader.",
                )
                self._fail(run, problem)
            else:
                errand.done.wait()
                if errand.error is not None:
                    self._fail(run, problem_of(errand.error))
            clean()

        threading.Thread(target=watch, name=f"provision {run.uuid[:8]}", daemon=True).start()

    def _on_the_bus(
        self, run: ProvisioningRun, work: Callable[[Conversation], None], clean: Callable[[], None]
    ) -> None:
        try:
            with self._apart(run.uuid, "let go for provision"):
                self._node_jobs.with_node(run.uuid, "it is provisioned", work)
            clean()
        except NodeRefusedError as refusal:
            if refusal.reason != Reason.NOT_PERMITTED:
                self._fail(run, problem_of(refusal))
                clean()
                return
            run.steps.clear()  # this node accepts a key only at a reader
            self._wait_for_a_tap(run, work, clean)
        except TedsProvisionError as error:
            self._fail(run, problem_of(error))
            clean()
        except Exception as error:  # noqa: BLE001 - a thread that ends without a word leaves a run that never ends
            _log.exception("Provisioning node %s failed.", run.uuid)
            self._fail(run, problem_of(as_program_error(error)))
            clean()

    def _work(self, run: ProvisioningRun, node: Conversation, order: BuildOrder) -> None:
        run.state, run.waits_for, run.until = "running", None, None
        uuid = node.uuid.hex()
        if run.uuid == NEXT:
            with self._guard:
                self._runs.pop(NEXT, None)
                run.uuid = uuid
                self._runs[uuid] = run
        self._publish(run)
        reporter = _RunReporter(run, self._live)
        try:
            # The caller accepted the node's key by requesting this node, or the next one that is tapped.
            done: ProvisionResult = provision(self._station, node, order, operator=_APPROVED, reporter=reporter)
        except SessionLostError as lost:
            raise lost.cause from lost
        run.verdict = done.verified.verdict
        require_authentic(done.verified)
        _show_verified(self._directory, uuid, done.verified)
        run.state = "done"  # set last: a client that sees it may request the node at once
        self._publish(run)

    def _fail(self, run: ProvisioningRun, error: Problem) -> None:
        run.state, run.error, run.waits_for, run.until = "failed", error, None, None
        self._publish(run)

    def _publish(self, run: ProvisioningRun) -> None:
        facts = {"waits_for": run.waits_for, "until": run.until, "error": run.error, "verdict": run.verdict}
        self._live.event("provision", uuid=run.uuid, state=run.state, **facts)


class _ApprovedOperator(AcceptingOperator):
    """The request, or ``ncap run --adopt --yes``, has approved the datasheet that the board brought, too."""

    def adopt(self, brought: FactoryDatasheet) -> None:
        """Return for every datasheet; one with errors is refused all the same."""


_APPROVED: Final = _ApprovedOperator()


class _RunReporter:
    """A reporter whose steps go to the run and to all clients."""

    def __init__(self, run: ProvisioningRun, live: Live) -> None:
        self._run, self._live = run, live

    def started(self, step: str) -> None:
        """Report the start of a step."""
        self._step(step, "running", "")

    def finished(self, step: StepResult) -> None:
        """Report a step that ended well."""
        self._step(step.name, step.result, step.detail)

    def notice(self, notice: Notice) -> None:
        """Publish that the run waits for something, or that something arrived."""
        self._live.event("provision", uuid=self._run.uuid, state="running", text=notice.text)

    def written(self, octets: int, total: int) -> None:
        """Publish how many octets of the datasheet are staged."""
        self._live.event(
            "provision", uuid=self._run.uuid, state="running", step="write", result="running",
            detail=f"{octets} of {total} octets",
        )  # fmt: skip

    def _step(self, name: str, result: str, detail: str) -> None:
        facts = {"name": name, "result": result, "detail": detail}
        self._run.steps = [step for step in self._run.steps if step["name"] != name] + [facts]
        self._live.event("provision", uuid=self._run.uuid, state="running", step=name, result=result, detail=detail)


def _show_verified(directory: NodeDirectory, uuid: str, verified: Verification) -> None:
    """Show a node that was provisioned: its datasheet is the one that is kept now."""
    directory.show_sheet(uuid, None)
    with suppress(TedsProvisionError):
        directory.refresh([uuid])
    directory.note(uuid, "verified", verdict=verified.verdict, heard=None, looked=time.time(), problem=None)


def _file(folder: Path, text: str | None, name: str | None) -> Path | None:
    """Return a calibration that came as text, as the file that the steps read; its suffix names the form."""
    if text is None:
        return None
    suffix = Path(name or "calibration.csv").suffix.lower()
    if suffix not in _SUFFIXES:
        raise UsageError(
            f"Unsupported calibration file: {name!r}.", hint=f"Its name must end in {', '.join(_SUFFIXES)}."
        )
    path = folder / f"calibration{suffix}"
    path.write_text(text, encoding="utf-8")
    return path


# Nodes that are provisioned without a request: virtual transducers of this station, which made their keys; and factory
# nodes on a wired bus if the operator chose that (`--adopt`, transparent mode; operation.md section 7, assurance
# ``bus``).


class AutoProvisioner:
    """Takes up permitted nodes; ``adopts``: factory nodes of a bus are among them.

    ``signs``: the own datasheet of such a node is signed at once, as confirmed at the start, if it has no fault. A
    refused node is not tried again while it stays unchanged.
    """

    def __init__(
        self,
        station: Station,
        roster: NodeDirectory,
        live: Live,
        virtuals: Virtuals,
        adopts: Callable[[], bool],
        *,
        signs: bool = False,
    ) -> None:
        self._station, self._directory, self._live = station, roster, live
        self._virtuals, self._adopts, self._signs = virtuals, adopts, signs
        self._refused: dict[str, TedsProvisionError] = {}

    def serve(self, node: Conversation) -> bool:
        """Take up a node in factory state; False if it is not permitted, or was done. Raises as the steps do."""
        uuid = node.uuid.hex()
        if node.tapped or node.identity.state == NodeState.PROVISIONED:
            return False
        if node.identity.state == NodeState.KEYED:
            return self._sign_own(node)
        self._refused.pop(uuid, None)
        if uuid in self._virtuals:
            verified = self._virtual(node, uuid)
            _show_verified(self._directory, uuid, verified)
            return True
        if (
            self._adopts()
            and node.contact.link.capabilities.wired
            and self._station.policy.tombstone(node.uuid) is None
        ):
            who = identify(self._station, node)
            listed = len(list_blocks(node))
            if listed > STRANGERS_TEDS:  # once adopted, the node would have all of them read again and again
                raise BadDataError(
                    f"Node {uuid} lists {listed} TEDS; one with more than {STRANGERS_TEDS} is not adopted."
                )
            entry = None if who.whitelisted is not None else new_whitelist_entry(self._station, node, who)
            with self._station.node_lock(node.uuid):
                agreed = agree(self._station, node, who, newcomer=entry)
            # With the old identity, the node would be inspected as one without a key, and found unproven.
            node.identity = replace(node.identity, state=NodeState.KEYED, epoch=agreed.epoch)
            self._station.audit("adopt", node.uuid, "done", fingerprint=who.fingerprint)
            self._live.event("node", uuid=uuid, state="adopted")
            return self._sign_own(node)
        return False

    def _sign_own(self, node: Conversation) -> bool:
        """Sign a keyed node's own datasheet, if that was confirmed at the start.

        False: it is inspected like any other.
        """
        uuid = node.uuid.hex()
        signs = self._signs and self._adopts() and uuid not in self._virtuals and node.contact.link.capabilities.wired
        if not signs or not self._station.keys.held(node.uuid) or self._station.pins.entry(node.uuid) is None:
            return False
        if uuid in self._refused:
            return False
        try:
            done = provision(
                self._station,
                node,
                BuildOrder(adopt=True),
                operator=_APPROVED,
                reporter=SilentReporter(),
            )
        except (BadDataError, PolicyError) as error:
            self._refused[uuid] = error
            self._live.event("node", uuid=uuid, state="not adopted", problem=problem_of(error))
            return False
        _show_verified(self._directory, uuid, done.verified)
        return True

    def _virtual(self, node: Conversation, uuid: str) -> Verification:
        """Give a virtual transducer the datasheet that it was made from."""
        station, profile = self._station, self._virtuals.profile_of(uuid)
        if profile is not None:
            order = BuildOrder(
                profile, calibration=self._virtuals.calibration_of(uuid), name=self._virtuals.name_of(uuid) or None
            )
            return provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter()).verified
        blocks = self._virtuals.blocks_of(uuid)
        with station.node_lock(node.uuid):
            agree(station, node, identify(station, node))
            done = write_sheet(station, node, blocks, SilentReporter())
        if self._virtuals.name_of(uuid):
            station.nodes.remember(node.uuid, name=self._virtuals.name_of(uuid))
        return done.verified
