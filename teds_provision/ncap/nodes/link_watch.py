"""A thread for each link: opens it, reopens it after failures, and notices nodes that arrive and leave.

On a bus, the discovery that measurements also use finds nodes, and a few workers inspect them. At a reader, the thread
itself handles the tap at once, because the node may be taken away.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, Protocol

from teds_provision.errors import AddressConflictError, FrozenError, LinkError, NodeBusyError, TedsProvisionError
from teds_provision.links import Contact, Notice, Port, Trace
from teds_provision.links.discovery import Sighting
from teds_provision.links.opening import capabilities_at, open_place
from teds_provision.links.streaming import MeasuringLink
from teds_provision.measure.buses import Buses
from teds_provision.measure.sources import sole_user
from teds_provision.measure.standing import is_listed
from teds_provision.ncap.live import Live
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.inspection import NodeInspection, look, read_anew
from teds_provision.ncap.nodes.node_jobs import NodeLocks
from teds_provision.ncap.waits import USUAL, Waits
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.shapes.problem import Problem, problem_of
from teds_provision.station.station import Station

# Checks whether a node that was seen on a bus is still there: it is asked twice before it counts as gone.
#
# Broadcasts are sent only every 30 s (operation.md section 7), and on a busy machine an answer may come too late. So a
# node that was silent for a while (Waits.silent_node) gets an Identify of its own: at most MAX_PARALLEL a second, and
# each node once in 10 s, the limit of the contract for nodes that announce themselves.

MAX_PARALLEL: Final = 5
PATIENCE: Final = (1.0, 3.0)  # seconds to wait for the first answer, and for the second


class PresenceCheck:
    """Checks the nodes of one bus. ``held`` returns True for nodes in use, such as measured ones."""

    def __init__(self, port: MeasuringLink, held: Callable[[str], bool], waits: Waits = USUAL) -> None:
        self._port, self._held, self._silence = port, held, waits.silent_node
        self._asked: dict[str, float] = {}
        self._last = 0.0

    def look(self, known: Mapping[str, Sighting]) -> Iterator[tuple[str, Sighting | None]]:
        """Ask those whose turn has come: yield each with its present Identify, None if it no longer answers."""
        now = time.monotonic()
        if now - self._last < 1.0:
            return
        due = [uuid for uuid, last in known.items() if now - max(last.at, self._asked.get(uuid, 0.0)) >= self._silence]
        due.sort(key=lambda uuid: known[uuid].at)
        silent = [uuid for uuid in due if not self._held(uuid)][:MAX_PARALLEL]
        self._asked = {uuid: at for uuid, at in self._asked.items() if uuid in known} | dict.fromkeys(silent, now)
        if not silent:
            return
        self._last = now
        with ThreadPoolExecutor(len(silent), thread_name_prefix="still there") as askers:
            yield from zip(silent, askers.map(self._ask, [known[uuid] for uuid in silent]), strict=True)

    def _ask(self, last: Sighting) -> Sighting | None:
        for seconds in PATIENCE:
            try:
                first = seconds == PATIENCE[0]
                identity = self._port.identify(last.address, seconds=seconds, until_announced=first)
            except AddressConflictError:  # a node is there; the code that found the conflict reports it
                return Sighting(last.identity, last.address, last.port, time.monotonic())
            except LinkError:
                return None
            if identity is not None:
                same = identity.uuid == last.uuid
                return Sighting(identity, last.address, last.port, time.monotonic()) if same else None
        return None


_log = logging.getLogger(__name__)
WORKERS: Final = 4
STRANGERS: Final = 2
"""Threads that look at nodes which are not on the whitelist: those that are on it never wait for a stranger."""
MOST_KNOWN: Final = 512
"""Limit of nodes assumed on a bus: it has 239 addresses, but a device may send another UUID each time."""
STRANGERS_EVERY: Final = 10.0  # seconds between two events with the number of unlisted nodes
FIRST_PAUSE, LAST_PAUSE = 1.0, 30.0
LOOK_AGAIN: Final = 30.0  # seconds until a node whose inspection failed is inspected again
SILENT: Final = 37.5  # seconds of silence after which a node without an Identify of its own counts as gone
LENDING: Final = 10.0


class NodeObserver(Protocol):
    """Receiver of nodes that are on a reader, or answer on a bus."""

    def serve_node(self, node: Conversation) -> bool:
        """Do what was requested for this node; False if nothing was."""


@dataclass
class LinkState:
    """A link as the API shows it."""

    place: str
    state: str = "opening"
    problem: Problem | None = None
    waiting: str = ""
    since: float = field(default_factory=time.time)
    notice_text: str = ""


class LinkWatch:
    """Watches one link until ``stop``."""

    def __init__(
        self,
        place: str,
        station: Station,
        roster: NodeDirectory,
        live: Live,
        turns: NodeLocks,
        taps: NodeObserver,
        transparent: Callable[[], bool],
        buses: Buses,
        trace: Trace | None = None,
        waits: Waits = USUAL,
    ) -> None:
        self._waits = waits
        self.place = place
        self.state = LinkState(place)
        self.port: Port | None = None
        self._station, self._directory, self._live, self._node_locks = station, roster, live, turns
        self._taps, self._transparent, self._buses = taps, transparent, buses
        self._trace = trace
        self._known: dict[str, Sighting] = {}
        self._looked_for: set[str] = set()  # nodes to inspect again when they answer
        self._stop, self._anew = threading.Event(), threading.Event()
        self._workers = ThreadPoolExecutor(WORKERS, thread_name_prefix=f"look {place[:20]}")
        self._for_strangers = ThreadPoolExecutor(STRANGERS, thread_name_prefix=f"stranger {place[:20]}")
        self._for_rest = ThreadPoolExecutor(1, thread_name_prefix=f"rest {place[:20]}")
        self._strangers_reported, self._strangers_at = 0, -STRANGERS_EVERY
        self._pending: set[str] = set()
        self._guard = threading.Lock()
        self._borrowers: set[int] = set()
        self._free = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"watch {place}", daemon=True)

    def start(self) -> None:
        """Start the thread that watches the link."""
        self._thread.start()

    def stop(self) -> None:
        """Ask it to end; see :meth:`join`."""
        self._stop.set()
        self._anew.set()

    def join(self, seconds: float) -> None:
        """Wait for its end, and close the link."""
        self._thread.join(seconds)
        for workers in (self._workers, self._for_strangers, self._for_rest):
            workers.shutdown(wait=False, cancel_futures=True)
        port, self.port = self.port, None
        if port is not None:
            port.close()

    def look_at_all(self) -> None:
        """Ask all nodes now, and inspect each of them again."""
        self._anew.set()

    # -- the watching thread -----------------------------------------------------------------------------------------

    def _run(self) -> None:
        pause = FIRST_PAUSE
        while True:
            # cleared first: a stop or a loan from here on sets it again, and an earlier one is noticed below
            self._anew.clear()
            if self._stop.is_set():
                return
            if self._borrowers:
                self._lend()
                continue
            try:
                if self.port is None:
                    self.port = open_place(self.place, self._trace)
                    pause = FIRST_PAUSE
                self._publish_state("up")
                self._watch(self.port)
            except TedsProvisionError as error:
                self._down(error)
            except Exception:  # noqa: BLE001 - a bug here must not end the watch on a link
                _log.exception("Watching %s failed; starting again.", self.place)
                self._down(TedsProvisionError("This link failed unexpectedly.", hint="See the log."))
            if self.port is None:
                self._anew.wait(pause)
                pause = min(2 * pause, LAST_PAUSE)

    def _down(self, error: TedsProvisionError) -> None:
        self._publish_state("down", error)
        self._directory.forget_place(self.place)
        self._close()

    def _watch(self, port: Port) -> None:
        """Handle arriving nodes until the link fails or the daemon ends."""
        if isinstance(port, MeasuringLink):
            with sole_user(self._station, [port], "ncap run"):
                self._watch_bus(port)
        else:
            self._watch_reader(port)

    def _watch_reader(self, port: Port) -> None:
        for contact in port.watch(stop=self._anew, notice=self._notice):
            self._came(contact)

    def _watch_bus(self, port: MeasuringLink) -> None:
        """Run a bus: discovery reports answering nodes (:meth:`on_sighting`).

        Here silent ones are noticed, and whether the bus works.
        """
        bus = self._buses.add(port)
        bus.discovery.poll(port.poll_seconds)
        asked = PresenceCheck(port, self._is_held, self._waits) if port.capabilities.connectionless else None
        while not self._stop.is_set():
            if self._anew.is_set():
                self._anew.clear()
                self._look_for_all()
                with suppress(LinkError):
                    bus.discovery.discover()
            failure = bus.discovery.failure
            self._publish_state("up" if failure is None else "down", failure)
            if failure is None:
                with suppress(LinkError):  # the bus was lost just now: its discovery reports it, and opens it again
                    port.report_rivals(self._notice)
            if asked is not None and failure is None:
                for uuid, sighting in asked.look(dict(self._known)):
                    if sighting is not None:
                        self.on_sighting(sighting)
                    elif not self._is_held(uuid):
                        self._gone(uuid)
            else:
                self._see_who_left(SILENT)
            self._report_strangers()
            self._anew.wait(self._waits.link)

    def _look_for_all(self) -> None:
        """Inspect all that answer from now on; the others are still known, and so are seen to leave."""
        self._looked_for = set(self._known)

    def _is_held(self, uuid: str) -> bool:
        return self._node_locks.holder(uuid) is not None

    def on_sighting(self, sighting: Sighting) -> None:
        """Handle a node that answered on this bus; called from the discovery's thread."""
        uuid, identity = sighting.uuid.hex(), sighting.identity
        before = self._known.pop(uuid, None)  # removed, so that the newest sighting is added at the end
        self._known[uuid] = sighting
        if len(self._known) > MOST_KNOWN:
            oldest, *_ = list(self._known)
            self._gone(oldest)
        if before is not None:
            seen = self._directory.seen(uuid)
            here = seen.place == self.place  # the node may have been on another bus meanwhile
            same = here and (before.address, before.identity.state) == (sighting.address, identity.state)
            retry = seen.problem is not None and abs(time.time() - seen.seen) > LOOK_AGAIN
            if same and not retry and uuid not in self._looked_for:
                return
        self._looked_for.discard(uuid)
        self._came(sighting.contact())

    def _see_who_left(self, silence: float) -> None:
        now = time.monotonic()
        for uuid, last in list(self._known.items()):
            if now - last.at >= silence:
                self._gone(uuid)

    def _gone(self, uuid: str) -> None:
        self._known.pop(uuid, None)
        text = f"Node {uuid} no longer answers."
        self._notice(Notice("node-left", text, uuid=bytes.fromhex(uuid)))

    # -- lending the reader to one command -----------------------------------------------------------------------------

    def borrow(self, who: object) -> bool:
        """Lend the reader to a command of this machine until it is given back; False if this is no reader."""
        if not capabilities_at(self.place).tapped:
            return False
        self._borrowers.add(id(who))
        self._anew.set()
        self._free.wait(LENDING)
        return True

    def give_back(self, who: object) -> None:
        """Take the reader back: the command has ended."""
        self._borrowers.discard(id(who))

    def _lend(self) -> None:
        """Close the reader for as long as a command has it."""
        self._close()
        self._directory.forget_place(self.place)
        self._publish_state("lent")
        self._free.set()
        while self._borrowers and not self._stop.is_set():
            while self._borrowers and not self._stop.wait(0.1):
                pass
            self._free.clear()
            if self._borrowers:  # another command began to borrow just now and was notified that the reader is free
                self._free.set()

    def _close(self) -> None:
        port, self.port = self.port, None
        if port is not None:
            port.close()

    def _notice(self, notice: Notice) -> None:
        if notice.kind == "node-left" and notice.uuid is not None:
            self._left(notice.uuid.hex())
        elif notice.kind == "reader-lost":
            self._publish_state("down", LinkError(notice.text))
            self._directory.forget_place(self.place)
        elif notice.kind == "reader-ready":
            self._publish_state("up")
        elif notice.kind == "waiting":
            self.state.waiting = notice.text
        elif notice.kind != "retry":
            self._publish_notice(notice)

    def _left(self, uuid: str) -> None:
        if self._directory.stranger(self.place, uuid, there=False) or self._node_locks.holder(uuid) is not None:
            return
        if self._directory.seen(uuid).place == self.place:  # otherwise it was moved to another link
            self._directory.note(uuid, "left", present=False)

    def _publish_notice(self, notice: Notice) -> None:
        """Publish another notice that a person should know of, once."""
        if notice.text != self.state.notice_text:
            self.state.notice_text = notice.text
            self._live.event("link", place=self.place, state=notice.kind, text=notice.text)

    def _publish_state(self, state: str, error: TedsProvisionError | None = None) -> None:
        problem = problem_of(error) if error is not None else None
        if (self.state.state, self.state.problem) != (state, problem):
            self.state.state, self.state.problem, self.state.since = state, problem, time.time()
            self._live.event("link", place=self.place, state=state, problem=problem)

    # -- nodes -------------------------------------------------------------------------------------------------------

    def _came(self, contact: Contact) -> None:
        uuid = contact.identity.uuid.hex()
        facts: dict[str, Any] = {
            "place": self.place, "address": contact.address, "present": True, "seen": time.time(),
            "says": contact.identity.state.name.lower(),
        }  # fmt: skip
        if contact.link.capabilities.tapped:
            self._directory.note(uuid, "tapped", tapped=time.time(), **facts)
            self._serve(contact)
            return
        if not self._wanted(contact):
            self._directory.stranger(self.place, uuid, there=True)
            return
        self._directory.note(uuid, "came", **facts)
        with self._guard:
            if uuid in self._pending:
                return
            self._pending.add(uuid)
        listed = is_listed(self._station, contact.identity.uuid)
        self._have_done(self._workers if listed else self._for_strangers, self._serve_known, contact)

    def _serve_known(self, contact: Contact) -> None:
        """Look at a node whose turn has come, if it is still there."""
        uuid = contact.identity.uuid.hex()
        if uuid in self._known:
            self._serve(contact)
            if uuid not in self._known:  # it left, or too many others came, during the inspection
                self._left(uuid)
            return
        with self._guard:
            self._pending.discard(uuid)

    def _report_strangers(self) -> None:
        """Report the number of nodes that whitelist mode ignores, if it changed, at a limited rate."""
        count, now = self._directory.strangers(self.place), time.monotonic()
        if count != self._strangers_reported and now - self._strangers_at >= STRANGERS_EVERY:
            self._strangers_reported, self._strangers_at = count, now
            self._live.event("link", place=self.place, state="strangers", count=count)

    def _wanted(self, contact: Contact) -> bool:
        """Return True if detection shows this node: whitelist mode shows others as a count."""
        return self._transparent() or is_listed(self._station, contact.identity.uuid)

    def _serve(self, contact: Contact) -> None:
        uuid = contact.identity.uuid.hex()
        try:
            with self._node_locks.hold(uuid, "it is looked at"), Conversation(contact, notice=self._notice) as node:
                if not self._taps.serve_node(node):
                    self._look(node)
        except FrozenError:  # its measurement has verified it and reports its state
            # the measurement may release it; inspect it then, so that it can be adopted
            if contact.identity.state == NodeState.FACTORY:
                self._looked_for.add(uuid)
            return
        except NodeBusyError as error:
            self._directory.note(uuid, problem=problem_of(error))
        except SessionLostError as lost:
            self._directory.note(uuid, "problem", problem=problem_of(lost.cause))
        except TedsProvisionError as error:
            self._directory.note(uuid, "problem", problem=problem_of(error))
        except Exception:  # noqa: BLE001 - a worker has no caller to raise to
            _log.exception("Looking at node %s failed.", uuid)
            self._directory.note(
                uuid, "problem", problem=problem_of(TedsProvisionError("Unexpected failure: see the log."))
            )
        finally:
            with self._guard:
                self._pending.discard(uuid)
            self._directory.refresh([uuid])

    def _look(self, node: Conversation) -> None:
        if not self._wanted(node.contact):
            return  # a tap of an unlisted node shows only which node it is
        found: NodeInspection = look(self._station, node)
        uuid = node.uuid.hex()
        self._directory.show_sheet(uuid, found.sheet)
        self._directory.refresh([uuid])
        self._directory.note(
            uuid,
            "verified",
            verdict=found.judged.verified.verdict,
            heard=found.judged.to_json() if found.judged.origin == "plain" else None,
            looked=time.time(),
            power=found.power,
            firmware=found.firmware,
            problem=None,
        )
        if found.judged.origin == "kept" and not node.contact.link.capabilities.tapped:
            self._have_done(self._for_rest, self._read_rest, node.contact)

    def _have_done(self, workers: ThreadPoolExecutor, work: Callable[[Contact], None], contact: Contact) -> None:
        """Have it done by one of the workers; a watch that is ending takes no more work."""
        try:
            workers.submit(work, contact)
        except RuntimeError:  # they were shut down, or no thread can be started
            if not self._stop.is_set():
                raise

    def _read_rest(self, contact: Contact) -> None:
        """Read all of a node that has started since it was read, one node of the link at a time.

        One that is measured meanwhile is read by its measurement, in what its data leave free.
        """
        uuid = contact.identity.uuid.hex()
        try:
            with (
                self._node_locks.hold(uuid, "the rest of its datasheet is read"),
                Conversation(contact, notice=self._notice) as node,
            ):
                found = read_anew(self._station, node)
        except (TedsProvisionError, SessionLostError):
            return  # the cached datasheet is still shown, and is read again at the next inspection
        except Exception:  # noqa: BLE001 - a worker has no caller to raise to
            _log.exception("Reading the rest of node %s failed.", uuid)
            return
        self._directory.refresh([uuid])
        if found is not None:
            self._directory.note(uuid, "verified", verdict=found[1].verified.verdict, looked=time.time())
