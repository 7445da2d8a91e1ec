"""Actuators of a node in a measurement: set points that come by topics, applied in the node's session.

An actuator is claimed when its first set point comes, not before (operation.md section 7), and the dead-man is fed by
set points alone: when they stop, the node goes to its safe state by itself, and the next one claims it again. A set
point beyond the limits of the datasheet, or older than the dead-man, is refused and reported; it is never changed. Its
age is checked again right before it leaves, because the session may have been busy. More than DRIVE_ABOVE set points a
second to one actuator go as Drive messages, which need no reply.

No late orders (operation.md section 2): an unanswered value is abandoned at the end of the dead-man, and no value
leaves after it before the node has answered a Clock: its counter makes the older frame worthless.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from teds_provision.errors import GarbledError, LinkError, NodeRefusedError, NotAuthenticError, TedsProvisionError
from teds_provision.measure.blocks import ECHO, Block, SetPointCommand
from teds_provision.measure.clock import ClockMap
from teds_provision.measure.verified_session import LEASE, VerifiedSession, claim
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.operation.commands import write_data_set
from teds_provision.protocol.operation.datagram import Layout
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.stream_commands import CLOCK, DriveReply, drive
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.teds.calibration.interpreter import ChannelInterpreter

_log = logging.getLogger(__name__)
DRIVE_ABOVE = 50  # set points a second
WATCHED = 10  # set points over which their rate is computed


@dataclass
class _Actuator:
    interpreter: ChannelInterpreter
    claimed_until: float = 0.0
    answered: float = 0.0  # when the node last confirmed a value
    count: int = 0
    came: deque[float] = field(default_factory=lambda: deque(maxlen=WATCHED))
    driver: Driver | None = None
    drivable: bool = True  # False once the node has refused Drive messages for it

    @property
    def fast(self) -> bool:
        """True if set points come so fast that a reply to each would delay them."""
        full = len(self.came) == WATCHED
        return full and self.came[-1] - self.came[0] < (WATCHED - 1) / DRIVE_ABOVE


class TopicActuators:
    """The actuators of one node in one session.

    ``queue_command`` returns at once; the newest set point of each counts.
    """

    def __init__(
        self,
        trusted: VerifiedSession,
        send: Callable[[bytes], None],
        numbers: tuple[int, ...],
        *,
        dead_man: int,
        clock: ClockMap,
        turn: threading.Lock,
        mapping: threading.Lock,
        echo: Callable[[Block], None],
        notify: Callable[[str], None],
    ) -> None:
        self._verified, self._send_message = trusted, send
        self._dead_man, self._clock, self._turn, self._mapping = dead_man, clock, turn, mapping
        self._echo, self._notify = echo, notify
        self._actuators = {number: _Actuator(ChannelInterpreter(trusted.sheet, number)) for number in numbers}
        self._newest: dict[int, SetPointCommand] = {}
        self._news = threading.Condition()
        self._stop = False
        self._last_drive = 0  # run of the last Drive messages
        self._unsure = False  # True if a value may still be on its way
        self.refused = 0
        self._thread = threading.Thread(target=self._run, name=f"actuators {trusted.uuid[:8]}", daemon=True)
        self._thread.start()

    def queue_command(self, command: SetPointCommand) -> None:
        """Queue a set point in the SI unit of the datasheet."""
        with self._news:
            if command.channel in self._actuators and not self._stop:
                self._newest[command.channel] = command
                self._news.notify_all()

    def close(self) -> None:
        """Take no more; what is claimed is let go by the node's own end."""
        with self._news:
            self._stop = True
            self._news.notify_all()
        self._thread.join(2.0)

    def _run(self) -> None:
        while True:
            with self._news:
                while not self._newest and not self._stop:
                    self._news.wait()
                if self._stop:
                    return
                commands, self._newest = list(self._newest.values()), {}
            for command in commands:
                try:
                    self._apply(command)
                except SessionLostError as lost:
                    self._refuse(f"channel {command.channel}: the session was lost: {lost.cause.message}")
                except TedsProvisionError as error:
                    self._refuse(f"channel {command.channel}: {error.message}")
                except Exception as bug:  # noqa: BLE001 - a thread that ends takes no further set point, and nothing reports it
                    _log.debug("Set point of channel %d failed.", command.channel, exc_info=True)
                    self._refuse(f"channel {command.channel}: unexpected {type(bug).__name__}, which is a bug")

    def _refuse(self, why: str) -> None:
        self.refused += 1
        self._notify(f"set point refused, {why.rstrip('.')}")

    def _apply(self, command: SetPointCommand) -> None:
        actuator = self._actuators[command.channel]
        one = actuator.interpreter
        self._seconds_left(command)
        value = one.unit.from_si(command.value)
        beyond = one.beyond(value)
        if beyond:
            self._refuse(f"{beyond}")
            return
        octets = one.encode(value)
        actuator.came.append(command.received)
        with self._turn:
            self._send(command, actuator, octets)
        self._echo_sample(command.channel, actuator, octets)

    def _seconds_left(self, command: SetPointCommand) -> float:
        """Return seconds until a set point is too old; raises LinkError if it is."""
        age = time.monotonic() - command.received
        if age > self._dead_man / 1000:
            raise LinkError(f"It is {age:.2f} s old; the dead-man is {self._dead_man} ms.")
        return self._dead_man / 1000 - age

    def _send(self, command: SetPointCommand, actuator: _Actuator, octets: bytes) -> None:
        self._seconds_left(command)
        if self._unsure:
            self._verified.node.request(CLOCK, "to report its time", within=self._dead_man / 1000)
            self._unsure = False
        now = time.monotonic()
        if now >= actuator.claimed_until:
            self._claim(command.channel, actuator)
        fast_alone = actuator.fast and sum(actuator.claimed_until > now for actuator in self._actuators.values()) <= 1
        if not fast_alone:
            actuator.driver = None
        # Drive messages have no reply, so now and then send a value by command: a node that was cut off is noticed.
        by_message = fast_alone and now - actuator.answered < self._dead_man / 2000
        if not (by_message and self._is_driven(command, actuator, octets)):
            self._set(command, actuator, octets)
            actuator.answered = time.monotonic()
        actuator.claimed_until = time.monotonic() + self._dead_man / 1000

    def _set(self, command: SetPointCommand, actuator: _Actuator, octets: bytes) -> None:
        try:
            self._write(command, octets)
        except NodeRefusedError as refusal:
            actuator.claimed_until = 0.0
            if refusal.reason != Reason.WRONG_STATE:
                raise
            # By the node's clock, the dead-man has expired meanwhile: claim the channel again with Operate.
            self._claim(command.channel, actuator)
            self._write(command, octets)
        except LinkError:
            self._unsure, actuator.claimed_until, actuator.driver = True, 0.0, None
            raise

    def _write(self, command: SetPointCommand, octets: bytes) -> None:
        words = write_data_set(command.channel, octets)
        self._verified.node.request(words, "to set the actuator", within=self._seconds_left(command))

    def _claim(self, number: int, actuator: _Actuator) -> None:
        actuator.driver = None
        try:
            claim(self._verified, number, lease=LEASE, dead_man=self._dead_man)
        except NodeRefusedError as refusal:
            if refusal.reason != Reason.WRONG_STATE:  # this session still has the claim
                raise

    def _is_driven(self, command: SetPointCommand, actuator: _Actuator, octets: bytes) -> bool:
        """Send it as a Drive message; False if the node takes none: then values go by command, as fast as it can."""
        if not actuator.drivable:
            return False
        try:
            self._drive(command, actuator, octets)
        except (NodeRefusedError, NotAuthenticError, GarbledError) as error:
            if not (
                isinstance(error, NodeRefusedError) and error.reason == Reason.WRONG_STATE
            ):  # the claim is gone; _set claims it again
                actuator.drivable = False
                self._notify(f"channel {command.channel} takes no Drive messages: {error.message}")
            return False
        return True

    def _drive(self, command: SetPointCommand, actuator: _Actuator, octets: bytes) -> None:
        number = command.channel
        if actuator.driver is None:
            layout = Layout((number,), (len(octets),))
            reply = DriveReply.decode(self._verified.node.request(drive([number]), "to be driven"))
            key = self._verified.node.message_key
            actuator.driver = Driver(layout, reply, key, dead_man=self._dead_man, after=self._last_drive)
            self._last_drive = reply.run
        left = round(self._seconds_left(command) * 1e9)
        with self._mapping:
            now = self._clock.ticks_at(time.monotonic_ns())
        message = actuator.driver.seal((octets,), now, hold=left)
        self._send_message(message)

    def _echo_sample(self, number: int, actuator: _Actuator, octets: bytes) -> None:
        """Echo what was applied, as a sample of the actuator's channel."""
        one = actuator.interpreter
        raw = one.reader.raw(octets)
        found = one.values(raw)
        value = np.asarray(one.unit.to_si(found.value), dtype=np.float64)  # type: ignore[arg-type]
        self._echo(
            Block(
                uuid=self._verified.uuid,
                stream=ECHO,
                channels=(number,),
                index=actuator.count,
                time=np.array([time.time()]),
                tick=np.array([0], dtype=np.uint64),
                raw=raw.reshape(1, 1),
                value=value.reshape(1, 1),
                valid=np.isfinite(value).reshape(1, 1),
            )
        )
        actuator.count += 1
