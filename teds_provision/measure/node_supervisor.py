"""One node of a measurement: found, verified, claimed, streaming; found again when it was lost; released at the end.

A thread for each node, so the steps stay plain sequential code (operation.md section 7): Open, verify, Clock, Operate,
Subscribe, then Clock every lease / 3. After an error again after 1 s, doubling to 30 s; after an Announce at once.
"""

from __future__ import annotations

import functools
import logging
import math
import threading
import time
from collections.abc import Sequence
from contextlib import suppress

from teds_provision.errors import (
    BadDataError,
    BadDatasheetError,
    InternalError,
    KeyStolenError,
    LinkError,
    NodeRefusedError,
    NoRoomError,
    NotAuthenticError,
    PolicyError,
    TedsProvisionError,
    VaultLockedError,
)
from teds_provision.links.discovery import Sighting
from teds_provision.links.ports import CancellableLink
from teds_provision.measure.background_reread import BackgroundReread
from teds_provision.measure.blocks import NodeReport, SetPointCommand, State
from teds_provision.measure.buses import Buses, MeasuredBus
from teds_provision.measure.clock import AT_FIRST, HostClock
from teds_provision.measure.planning import BusTime, NodePlans, plan_node, sensors_of
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.retry_policy import RetryPolicy
from teds_provision.measure.running.streams import NodeStreams, added
from teds_provision.measure.standing import NodeStanding, why_not_measured
from teds_provision.measure.topic_actuators import TopicActuators
from teds_provision.measure.verified_session import (
    LEASE_EACH,
    LONGEST_LEASE,
    VerifiedSession,
    claim,
    open_trusted,
    open_unverified,
)
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.operation.commands import idle
from teds_provision.protocol.operation.stream_commands import SOON
from teds_provision.provisioning.conversation import Conversation, SessionLostError, came_under_key
from teds_provision.provisioning.firmware import firmware_warning, read_firmware, require_good_firmware
from teds_provision.station.firmware import firmware_of
from teds_provision.station.station import Station
from teds_provision.teds.sheet import Channel

_log = logging.getLogger(__name__)
FIRST_PAUSE, LAST_PAUSE = 1.0, 30.0
LOOKING = 2.0  # seconds to search for a node that ran before, between its reports
WORKED_ON, NOTICE_AFTER, LONGEST_WORK = 0.05, 0.5, 60.0
"""Seconds between checks whether a command works on the node, until that is reported, and until it counts as hung."""
LOOK = 0.2  # seconds between checks of the node while a change is expected
CALM = 0.5  # seconds between checks otherwise: with a thousand nodes, a thousand threads wake up
LOOK_FOR_DATA = 0.4  # seconds after an Announce; data within them mean that another device sent it
ANNOUNCED = 1.0  # seconds after an Announce without data until the node is asked
DECIDED = 0.5  # seconds between checks whether this station's own decision against a node was withdrawn
AT_ONCE = 1.0  # least seconds between two tries, however often Announces with this UUID arrive
SLOWER = 10  # the rate is halved up to this often if the firmware's shortest period is longer
UNLOCKED = 1.0  # seconds between checks whether the vault is unlocked again
BUSY = 2.0  # seconds for which a busy node is asked again at once; then it is treated like any other error


class NodeSupervisor:
    """Keeps one node measuring until :meth:`stop`; ``error`` is what it ended with, None if all is well."""

    def __init__(
        self,
        station: Station,
        buses: Buses,
        uuid: bytes,
        request: MeasurementRequest,
        host: HostClock,
        events: Events,
        common_start: CommonStart,
    ) -> None:
        self.uuid = uuid
        self.error: TedsProvisionError | None = None
        self.state: State = "waiting"
        self.ever_ran = False
        self.verified: VerifiedSession | None = None
        self.streams = NodeStreams(host, events.block)
        self.turn = threading.Lock()  # held during each exchange of the session
        self.ready = threading.Event()  # the streams were subscribed
        self.done = threading.Event()
        self._station, self._buses = station, buses
        self.bus: MeasuredBus | None = None  # its place, once it was found
        self._request, self._events, self._common_start = request, events, common_start
        self._stop = threading.Event()
        self._anew = threading.Event()
        self._announced = 0.0  # time.monotonic() of its Announce; 0: none
        self._elsewhere = 0.0  # time.monotonic() when it answered at another place
        self._lost_at = 0.0
        self._proven = True  # True if the last failure came under the node's key
        self._retry_policy = RetryPolicy(None)
        self._standing: NodeStanding | None = None  # of the current try
        self.sighting: Sighting | None = None  # its last place
        self._lease, self._claimed = request.lease, [0]
        self._driven: TopicActuators | None = None
        self._told = ""
        self._comes_back = False  # it is released for a while, and its share of the bus is reserved
        self._firmware_warning = ""
        self._why = ""  # reason of the stop, for its last report
        self._thread = self._new_thread()

    def _new_thread(self) -> threading.Thread:
        return threading.Thread(target=self._run, name=f"node {self.uuid.hex()[:8]}", daemon=True)

    def start(self) -> None:
        """Begin; one that has ended begins again, and its counts go on."""
        if self.begun:
            self._thread.join()
            self._stop.clear()
            self.done.clear()
            self._why, self.error, self._comes_back = "", None, False
            self._thread = self._new_thread()
        self._thread.start()

    def give_room_up(self) -> None:
        """Give up its room on the bus: it does not come back."""
        if self._comes_back:
            self._comes_back = False
            for bus in self._buses.all():
                bus.share.remove_node(self.uuid)

    @property
    def begun(self) -> bool:
        """True if it was ever started."""
        return self._thread.ident is not None

    def stop(self, why: str = "", *, comes_back: bool = False) -> None:
        """End it in order: Stop, Idle, Close; its last report contains ``why``.

        ``comes_back``: it keeps its room on the bus until it is started again, or :meth:`give_room_up`.
        """
        self._why, self._comes_back = why, comes_back
        self._stop.set()
        self._anew.set()

    def command(self, command: SetPointCommand) -> None:
        """Take a set point for one of its actuators; dropped while the node is absent."""
        driven = self._driven
        if driven is not None:
            driven.queue_command(command)

    def join(self, seconds: float) -> None:
        """Wait for its end."""
        if self.begun:
            self._thread.join(seconds)

    # -- the thread --------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        pause = FIRST_PAUSE
        patience = self._retry_policy = RetryPolicy(None if self._request.patient else self._request.timeout)
        try:
            while not self._stop.is_set():
                self._anew.clear()
                began = time.monotonic()
                error = self._failure()
                if error is None or self._stop.is_set():
                    break
                shared = self._is_shared(error)
                self.error = error = shared or error
                if self._request.newcomers:
                    final = isinstance(error, (NotAuthenticError, PolicyError, BadDataError))
                    if isinstance(error, NoRoomError):
                        self._set_state("waiting", why="no room on the bus")
                    else:
                        self._set_state("refused" if final else "lost", error)
                    return
                decided = self._standing is not None and error is self._standing.ended
                if shared is not None or patience.gives_up(
                    error, proven=self._proven, decided=decided, elsewhere=self._is_elsewhere
                ):
                    self._set_state("refused", error)
                    return
                if time.monotonic() - began > LAST_PAUSE:
                    pause = FIRST_PAUSE
                lost: State = "refused" if isinstance(error, BadDatasheetError) else "lost"
                self._set_state(lost if self.ever_ran else "waiting", error, f"; again in {patience.next_try(pause)}")
                self._wait(min(pause, patience.seconds_left), began, decided=decided)
                pause = min(2 * pause, LAST_PAUSE)
            self._set_state("ended", why=self._why)
        finally:
            self._common_start.drop_node(self.uuid)
            if self._request.requirements is not None:
                self._request.requirements.drop_node(self.uuid)
            if not self._comes_back:
                for bus in self._buses.all():
                    bus.share.remove_node(self.uuid)
            self.done.set()
            self.ready.set()

    def _is_elsewhere(self) -> bool:
        return self._buses.presence.has_other_place(self.uuid)

    def _is_shared(self, error: TedsProvisionError) -> PolicyError | None:
        """Return the error of a node that lacks room for this stream, because another process has one there too.

        None if that is not so, or the room is waited for. It would last for as long as the other one does.
        """
        holder = self._request.beside.get(self.uuid)
        full = isinstance(error, NodeRefusedError) and error.reason == Reason.DOES_NOT_FIT
        if holder is None or not full or self.ever_ran or self._request.patient:
            return None
        return PolicyError(
            f"Node {self.uuid.hex()} is also being measured by {holder}, and has no room for this rate beside it.",
            hint="Use a lower --rate, or end that measurement.",
        )

    def _wait(self, pause: float, began: float, *, decided: bool) -> None:
        """Wait until it is time to try again: after ``pause`` seconds, or at once when the node announces itself.

        ``decided``: this station itself does not let it be measured; also at once when that is taken back.
        """
        if self.sighting is not None:
            self._buses.presence.on_announce(self.sighting, self._anew.set)
        until, changes = time.monotonic() + pause, self._station.changes() if decided else None
        while (left := until - time.monotonic()) > 0 and not self._anew.wait(min(left, DECIDED) if decided else left):
            now = self._station.changes() if decided else None
            if now != changes and not why_not_measured(self._station, self.uuid):
                break
            changes = now
        self._buses.presence.let_announce(self.uuid)  # from now on the node is searched for
        self._stop.wait(max(0.0, began + AT_ONCE - time.monotonic()))

    def _failure(self) -> TedsProvisionError | None:
        """Measure until the end or an error: what ended it, None for the end in order."""
        try:
            self._try_once()
        except SessionLostError as lost:
            return lost.cause
        except TedsProvisionError as error:
            return error
        except Exception as bug:  # noqa: BLE001 - a thread that ends unreported looks like a normal end
            _log.debug("Measuring node %s failed.", self.uuid.hex(), exc_info=True)
            return InternalError(f"Unexpected {type(bug).__name__}.", hint="This is a bug: please report it with -vv.")
        return None

    def _let_others_finish(self) -> None:
        """Wait while a command of this station works on the node: a claim in the middle would spoil what it does."""
        passed, since, reported = 0.0, time.monotonic(), False
        while passed < LONGEST_WORK and self._station.node_lock(self.uuid).is_taken and not self._stop.wait(WORKED_ON):
            passed = time.monotonic() - since
            if passed > NOTICE_AFTER and not reported:
                reported = True
                self._set_state("waiting", why="a command of this station is using it")

    def _wait_for_vault(self) -> None:
        """Wait while another command's new master key locks this process out: each try would fail.

        The node keeps its place in the measurement meanwhile, so that nothing takes it up again and again.
        """
        reported = False
        while self._request.patient and not self._stop.is_set():
            try:
                self._station.unlock(self.uuid)
                return
            except VaultLockedError as locked:
                if not reported:
                    reported = True
                    self._set_state("waiting", locked)
            self._stop.wait(UNLOCKED)

    def _try_once(self) -> None:
        self._let_others_finish()
        self._wait_for_vault()
        if self._stop.is_set():
            return
        standing = self._standing = NodeStanding(self._station, self.uuid)
        standing.require_measurable()
        seconds = (
            LOOKING
            if self.ever_ran
            else max(LOOKING, round(min(self._request.timeout, self._retry_policy.seconds_left), 1))
        )
        sighting = self._buses.presence.find(self.uuid, seconds=seconds, stop=self._stop, fresh=self._lost_at)
        self.sighting = sighting
        self.bus = self._buses.bus_of(sighting)
        for other in self._buses.all():
            if other is not self.bus:
                other.share.remove_node(self.uuid)
        try:
            self._in_session(self.bus, sighting, standing)
        except NoRoomError:
            raise
        except BaseException as error:
            self._lost_at = time.monotonic()
            self._proven = self._proven and came_under_key(error)
            self._buses.presence.let_announce(self.uuid)
            # A refusal under its key proves that the node is here, and another measurement may want it now.
            if not (self._proven and isinstance(error, (NotAuthenticError, PolicyError, BadDataError))):
                self._buses.presence.search_again(sighting)
            if not self._proven and isinstance(error, (TedsProvisionError, SessionLostError)):
                if not isinstance(error, LinkError):
                    self._ask_who_answers()
                conflict = self._buses.presence.conflict_at(sighting)
                if conflict is not None:
                    raise conflict from error  # either of the two nodes may have answered
            raise

    def _ask_who_answers(self) -> None:
        """Send a broadcast while no request to the node is pending: its replies would hide a second board's.

        Only until its first value, for a caller that gives up in time: other waiters learn it from the next round.
        """
        if self.bus is None or self.ever_ran or self._request.patient:
            return
        with suppress(LinkError):
            self.bus.discovery.discover()

    def _in_session(self, bus: MeasuredBus, sighting: Sighting, standing: NodeStanding) -> None:
        self._announced = self._elsewhere = 0.0
        bus.beginning.add(self.uuid)
        try:
            self._open_and_measure(bus, sighting, standing)
        finally:
            bus.beginning.discard(self.uuid)

    def _open_and_measure(self, bus: MeasuredBus, sighting: Sighting, standing: NodeStanding) -> None:
        self._buses.presence.on_announce(sighting, self._heard_announce, self._seen_elsewhere)
        with Conversation(sighting.contact(), notice=lambda _notice: None, busy_seconds=BUSY) as node:
            if isinstance(node.contact.link, CancellableLink):
                node.contact.link.hopeless = self._is_gone
            try:
                trusted = (
                    open_unverified(self._station, node, by=self._request.by)
                    if self._request.unverified
                    else open_trusted(self._station, node, by=self._request.by, unsigned=self._request.unsigned)
                )
            finally:
                self._proven = node.sealed
            if self._request.requirements is not None:
                self._request.requirements.offer(self.uuid, trusted.sheet, self._stop)
            runs = firmware_of(self._station, self.uuid, read_firmware(node))
            if self._request.require_firmware:
                require_good_firmware(self.uuid, runs)
            self._firmware_warning = firmware_warning(runs)
            self.verified, self._announced = trusted, 0.0
            answers = False
            try:
                self._measure(bus, trusted, sighting.address)
                bus.beginning.discard(self.uuid)
                standing.drives = self._driven is not None
                standing.unsigned = trusted.unsigned or trusted.unverified
                self._keep(bus, trusted, standing)
                answers = True
            except (NotAuthenticError, PolicyError, BadDataError, KeyStolenError):
                answers = True  # the node answers, so stop its streams: otherwise they would go on until the lease ends
                raise
            finally:
                self._end(bus, trusted, sighting.address, answers=answers or self._stop.is_set())

    def _measure(self, bus: MeasuredBus, trusted: VerifiedSession, address: int) -> None:
        """Set the clock, claim channels (Operate) and subscribe; every stream is received from then on."""
        self.streams.new_session()
        for _ in range(AT_FIRST):
            self.streams.tell_time(trusted)
        actuators = self._actuators(trusted)
        channels = self._sensors(trusted.sheet.channels, actuators)
        self._claim(trusted, channels)
        plans = self._subscribe(bus, trusted, channels, address) if channels else NodePlans((), 0.0)
        periods = plans.periods()
        self._events.facts([trusted.facts(channel, periods.get(channel.number)) for channel in (*channels, *actuators)])
        self.streams.described()
        if actuators:
            self._driven = self._take_up(bus, trusted, actuators, address)
        notes = [note for note in (plans.slowed, self._firmware_warning) if note]
        notes += [problem for heard in self.streams.running.values() for problem in heard.interpreter.problems.values()]
        self.ever_ran, self.error = True, None
        self._retry_policy.has_run()
        self._set_state("running", why="; ".join(note.removesuffix(".") for note in notes))
        self.ready.set()

    def _actuators(self, trusted: VerifiedSession) -> list[Channel]:
        """Return actuators that may get set points: signed datasheet, on the whitelist, with a way to raw values."""
        if (
            trusted.unsigned
            or trusted.unverified
            or not self._request.actuators
            or self._station.pins.entry(self.uuid) is None
        ):
            return []
        wanted = self._request.channels
        return [
            channel
            for channel in trusted.sheet.channels
            if channel.actuator and not channel.value_problem and (not wanted or channel.number in wanted)
        ]

    def _sensors(self, every: Sequence[Channel], actuators: list[Channel]) -> list[Channel]:
        """Return the sensors to measure; empty if only actuators were requested, or the node has nothing else."""
        moved = {channel.number for channel in actuators}
        asked = [number for number in self._request.channels if number not in moved]
        nothing_else = all(channel.actuator for channel in every) or (self._request.channels and not asked)
        if actuators and nothing_else:
            return []
        return sensors_of(every, asked, self._request.stream_kind)

    def _claim(self, trusted: VerifiedSession, channels: list[Channel]) -> None:
        """Claim the sensors one by one, or the whole node at once if every sensor is measured."""
        sensors = [channel for channel in trusted.sheet.channels if not channel.actuator]
        whole = bool(channels) and len(channels) == len(sensors)
        self._claimed = [0] if whole else [channel.number for channel in channels]
        self._lease = self._lease_now()
        for number in self._claimed:
            claim(trusted, number, lease=self._lease)

    def _lease_now(self) -> int:
        """Return the lease.

        It grows with the bus, and with it the pause between two Clocks, so that many nodes do not fill it.
        """
        nodes = self.bus.share.nodes if self.bus is not None else 0
        return min(LONGEST_LEASE, max(self._request.lease, math.ceil(LEASE_EACH * nodes)))

    def _take_up(
        self, bus: MeasuredBus, trusted: VerifiedSession, actuators: list[Channel], address: int
    ) -> TopicActuators:
        return TopicActuators(
            trusted,
            functools.partial(bus.port.drive, address),
            tuple(sorted(channel.number for channel in actuators)),
            dead_man=self._request.dead_man,
            clock=self.streams.clock,
            turn=self.turn,
            mapping=self.streams.mapping,
            echo=self._events.block,
            notify=lambda why: self._set_state(self.state, why=why),
        )

    def _subscribe(
        self, bus: MeasuredBus, trusted: VerifiedSession, channels: list[Channel], address: int
    ) -> NodePlans:
        rate, share = self._request.rate, bus.share
        halved = 0  # counted from 0 in each session: other firmware may allow what the last one refused
        if rate is None:
            share.announce_share(self.uuid, self._plan(channels, bus.time_for(share.time, address), SOON, halved).load)
        start = self._common_start.start(self.uuid, self.streams.clock)
        while True:
            with share.lock:
                time_left = bus.time_for(share.for_node(self.uuid, sharing=rate is None), address)
                plans = self._plan(channels, time_left, start, halved)
                share.taken[self.uuid] = plans.load
            try:
                for plan in plans.streams:
                    self.streams.subscribe(bus, trusted, plan, address, ahead=self._common_start.seconds_until(start))
            except NodeRefusedError as refusal:
                if refusal.reason == Reason.TOO_LATE and start != SOON:
                    self._common_start.start_by_itself(self.uuid)
                    start = SOON
                elif refusal.reason != Reason.OUT_OF_RANGE or rate is not None or halved >= SLOWER:
                    raise
                else:
                    # the firmware's shortest period may be longer than the datasheet's, and no command reports it
                    halved += 1
                self.streams.stop(bus, trusted, address)
                continue
            return plans

    def _plan(self, channels: list[Channel], bus: BusTime, start: int, halved: int) -> NodePlans:
        return plan_node(
            channels,
            bus,
            rate=self._request.rate,
            kind=self._request.stream_kind,
            test_pattern=self._request.test_pattern,
            start=start,
            slower=2**halved,
            at_most=self._request.newcomers,
        )

    def _keep(self, bus: MeasuredBus, trusted: VerifiedSession, standing: NodeStanding) -> None:
        """Send Clock every third of a lease until the end, or until the node is lost or may no longer be measured."""
        rest = BackgroundReread(self._station, trusted, bus, by=self._request.by) if trusted.kept else None
        try:
            self._watch(bus, trusted, standing, rest)
        finally:
            if rest is not None:
                rest.close()

    def _watch(
        self, bus: MeasuredBus, trusted: VerifiedSession, standing: NodeStanding, rest: BackgroundReread | None
    ) -> None:
        reported_at = time.monotonic()
        lied, mark = False, ""
        while not self._stop.is_set():
            if self._anew.wait(LOOK if rest is not None or self._announced or self._elsewhere else CALM):
                self._anew.clear()  # set by an Announce, and also by stop() together with _stop
                self._stop.wait(LOOK)  # any device can send Announces at any rate: they must not speed up this loop
            standing.require()
            if standing.mark != mark:
                mark = standing.mark
                self._set_state("running", why=mark)
            now = time.monotonic()
            if self._doubted(now) or now - reported_at >= self._lease / 3:
                with self.turn:
                    self.streams.tell_time(trusted)
                    if self._lease_now() > self._lease:
                        self._lease = self._lease_now()
                        for number in self._claimed:
                            claim(trusted, number, lease=self._lease)
                reported_at = now
            elif rest is not None:
                with self.turn:
                    rest = rest if rest.step() else None
                if rest is None:
                    self._events.reread_done(self.uuid)
            if self.streams.clock.lie and not lied:
                lied = True
                self._set_state("running", why=f"its clock is inconsistent: {self.streams.clock.lie}")
            silent = self.streams.silent(now)
            # the link failed (for example, the adapter was unplugged), not the node
            if silent and (failure := bus.hearing.failure) is not None:
                raise failure
            if silent:
                raise LinkError(f"No message from the node for {silent:.1f} s.", hint="Check its power and the bus.")

    def _is_gone(self) -> bool:
        """Return True if the node is silent or was seen on another bus, so that waiting for its answer is useless."""
        now, since = time.monotonic(), self._elsewhere
        if since and now - since > max(LOOK_FOR_DATA, self.streams.every() or 0.0):
            return not self.streams.heard_since(since)
        return bool(self.streams.silent(now))

    def _seen_elsewhere(self) -> None:
        self._elsewhere = time.monotonic()
        self._heard_announce()

    def _heard_announce(self) -> None:
        if not self._announced:
            self._announced = time.monotonic()
            self._anew.set()

    def _doubted(self, now: float) -> bool:
        """Return True if an Announce is a reason to ask the node: then it has started again, or moved.

        But any device can send an Announce. Data with good tags is better evidence; if none comes, the session is gone,
        and is opened again at once.
        """
        since = self._announced
        if not since:
            return False
        every = self.streams.every()
        if every is not None and every < LOOK_FOR_DATA:
            if self.streams.heard_since(since):
                self._announced = 0.0
            elif now - since > LOOK_FOR_DATA:
                self._announced = 0.0
                self._anew.set()
                raise LinkError("The node has restarted, or now answers elsewhere.")
            return False
        doubted = now - since >= ANNOUNCED
        if doubted:
            self._announced = 0.0
        return doubted

    def _end(self, bus: MeasuredBus, trusted: VerifiedSession, address: int, *, answers: bool) -> None:
        """Let go in order, as far as the node still ``answers``."""
        if self._driven is not None:
            self._driven.close()
            self._driven = None
        with self.turn:  # a command in progress ends first, and no other starts in this session
            self.verified = None
        self._buses.presence.let_announce(self.uuid)
        self.streams.stop(bus, trusted if answers else None, address)
        if not self._comes_back:
            with bus.share.lock:
                bus.share.taken.pop(self.uuid, None)
        if answers:
            with suppress(TedsProvisionError, SessionLostError):
                trusted.node.request(idle(0), "to let go")
        else:
            trusted.node.forget()

    # -- reports ---------------------------------------------------------------------------------------------------

    def report(self) -> NodeReport:
        """Return the state of the node as it is now."""
        sums = self.streams.summed()
        errors = [totals.clock_error for totals in sums if totals.clock_error is not None]
        return NodeReport(
            uuid=self.uuid.hex(),
            state=self.state,
            why=self._told,
            samples=sum(totals.samples for totals in sums),
            lost=sum(totals.lost for totals in sums),
            late=sum(totals.late for totals in sums),
            bad=sum(totals.bad for totals in sums),
            invalid=sum(totals.invalid for totals in sums),
            clock_error=max(errors) if errors else None,
            time=time.time(),
            invalid_why=added(*(totals.invalid_why for totals in sums)),
        )

    def _set_state(
        self, state: State, error: TedsProvisionError | None = None, more: str = "", *, why: str = ""
    ) -> None:
        self.state = state
        self._told = why or (error.message.rstrip(".") + more if error is not None else "")
        self._events.report(self.report())
