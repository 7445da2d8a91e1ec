"""Measurement operation beyond the known answers: orders of checks, claims, safe states, streams, triggers, Drive."""

# ruff: noqa: E501 - one row per case, its note in words included
from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from teds_provision.protocol.messages.frames import (
    Command,
    Function,
    read_teds,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.operation.can_frames import cut
from teds_provision.protocol.operation.commands import (
    OPERATION,
    OperateCommand,
    idle,
    read_data_set,
    run_self_test,
    sample,
    set_values,
    write_data_set,
)
from teds_provision.protocol.operation.datagram import Layout
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.stream_commands import (
    CLOCK,
    WAITS,
    Action,
    ArmCommand,
    DriveReply,
    StreamKind,
    SubscribeCommand,
    drive,
    stop,
)
from teds_provision.protocol.operation.subscription import TickBounds
from teds_provision.protocol.operation.timing import TriggerToken
from teds_provision.protocol.session import StationSession
from tests.protocol.operation.bench import DIGEST, HIGH, LOW, MS, SECOND, Bench, K

from .scene import UUID, named_key, octets

F1, F2, NFC = "can:f1", "can:f2", "nfc"
VALUE, TOO_MUCH = (1000).to_bytes(2, "big"), (HIGH + 1).to_bytes(2, "big")
PROVE = security_command(Function.PROVE, bytes(range(32)))


class OperationScene:
    """One entry: a provisioned node with the channels of operation_kat.json, and all that it says and does."""

    def __init__(self, name: str, note: str, *links: str, **limits: int | bool) -> None:
        self.name, self.note, self.limits = name, note, limits
        self.steps: list[dict[str, Any]] = []
        self.sessions: list[dict[str, Any]] = []
        self.bench = Bench(**limits)
        self.start = self.bench.hardware.tick
        self.bench.tim._sessions._opens = int.from_bytes(octets(name, "c")[:8], "big")
        for link in links or (F1,):
            self.open(link)
        self.logged = len(self.bench.hardware.log)

    def open(self, link: str) -> None:
        """Open a session on a link, with one-time keys that follow from the entry's name."""
        number = len(self.sessions)
        station, node = (named_key(self.name, number, side) for side in ("Es", "En"))
        self.bench.tim._sessions._one_time = lambda: node
        session = StationSession(K, UUID, one_time=station)
        counter = self.bench.plain(session.request_counter(), link).payload
        session.accept(self.bench.plain(session.open(counter), link).payload)
        self.bench.sessions[link] = session
        record = {
            "link": link,
            "K": K.hex(),
            "Es": station.secret().hex(),
            "En": node.secret().hex(),
            "c": counter.hex(),
        }
        self.sessions.append({**record, "k_m": session.message_key.hex()})

    def exchange(self, command: Command, note: str, link: str = F1, *, plain: bool = False) -> OperationScene:
        """Send a command: an inner one of this link's session, or a plain one."""
        reply = self.bench.plain(command, link) if plain else self.bench.send(command, link)
        step = {"at": self.bench.hardware.tick, "link": link, "note": note, "plain": plain}
        step |= {"command": command.encode().hex(), "reply": reply.encode().hex()}
        if reply.reason is not None:
            step["reason"] = reply.reason
        self._add(step)
        return self

    def rows(self, rows: list[tuple[Command, str]], link: str = F1) -> OperationScene:
        """Several."""
        for command, note in rows:
            self.exchange(command, note, link)
        return self

    def until(self, tick: int, note: str = "") -> OperationScene:
        """Let time pass; what left on the bus meanwhile is written down, each frame with its tick."""
        before = len(self.bench.frames)
        self.bench.until(tick)
        sent = [
            {"at": at, "id": f"{frame.identifier:08x}", "data": frame.data.hex()}
            for at, frame in self.bench.frames[before:]
        ]
        self._add({"at": tick, "note": note or "Time passes.", "sent": sent})
        return self

    def later(self, ns: int, note: str = "") -> OperationScene:
        """Let so many ns pass."""
        return self.until(self.bench.hardware.tick + ns, note)

    def event(self, channel: int, data_set: bytes, note: str) -> OperationScene:
        """Let an event sensor see something now."""
        self.bench.tim.event(channel, self.bench.hardware.tick, data_set)
        self._add({"at": self.bench.hardware.tick, "note": note, "event": channel, "data_set": data_set.hex()})
        return self

    def trigger(self, token: bytes, note: str, link: str = F1) -> OperationScene:
        """A trigger frame ends now."""
        self.bench.tim.trigger(link, token, self.bench.hardware.tick)
        self._add({"at": self.bench.hardware.tick, "link": link, "note": note, "trigger": token.hex()})
        return self

    def message(self, message: bytes, note: str, link: str = F1) -> OperationScene:
        """Send a Drive message, in classic frames."""
        pieces = [piece.data for piece in cut(message, fd=False, drive=True)]
        for data in pieces:
            self.bench.tim.drive(link, data)
        frames = [data.hex() for data in pieces]
        self._add(
            {"at": self.bench.hardware.tick, "link": link, "note": note, "drive": message.hex(), "frames": frames}
        )
        return self

    def _add(self, step: dict[str, Any]) -> None:
        log = self.bench.hardware.log
        done = [{"apply": value} if what == "apply" else {what: value} for what, value in log[self.logged :]]
        self.logged = len(log)
        self.steps.append(step | ({"hardware": done} if done else {}))

    def entry(self) -> dict[str, Any]:
        """Return the JSON of it all."""
        head = {"name": self.name, "note": self.note, "tick": self.start, **self.limits}
        return {**head, "sessions": self.sessions, "steps": self.steps}


def operate(channel: int, *, digest: bytes = DIGEST, lease: int = 60, dead_man: int | None = None) -> Command:
    """Operate."""
    return OperateCommand(channel, digest, lease, dead_man).command()


def subscribe(**changes: object) -> Command:
    """Subscribe to two samples of channel 1 every 10 ms, or something else."""
    asked: dict[str, Any] = {"stream": 0, "kind": StreamKind.PERIODIC, "n": 2, "gap": 1000, "period": 10 * MS, "start": 0, "channels": (1,)}  # fmt: skip
    return SubscribeCommand(**{**asked, **changes}).command()


def operation() -> Iterator[dict[str, Any]]:
    """Measurement operation (operation.md): inner commands of sessions, frames on the bus, what the hardware is told.

    The node is that of operation_kat.json, provisioned. Sensor c gives c times the milliseconds of the tick, cut to its
    width; actuators bear 100 to 4000, their safe value is 100. Ticks and times are ns and run together.
    """
    for made in (
        _checks_of_claims,
        _checks_of_values,
        _checks_of_streams,
        _lives,
        _several,
        _streams,
        _triggers,
        _drives,
    ):
        yield from (scene.entry() for scene in made())


def _checks_of_claims() -> Iterator[OperationScene]:
    bad = bytes(16)
    yield (
        OperationScene("operate-checks", "Operate: 1, 4, 6, 19, 17 and 2, in this order.", F1, F2)
        .rows(
            [
                (operate(9, digest=bad, lease=0), "A channel that is not there, all else wrong too: 1."),
                (Command(0xFFFF, 4, 1, bad + b"\0"), "Every channel at once: 1."),
                (operate(1, digest=bad, lease=0, dead_man=500), "A sensor with a dead-man: 4."),
                (operate(4, digest=bad, lease=0), "An actuator without one: 4."),
                (operate(1, digest=bad, lease=0), "Another datasheet: 6."),
                (operate(1, lease=0), "Lease 0: 19."),
                (operate(1, lease=61), "Lease 61: 19."),
                (operate(4, dead_man=19), "Dead-man 19: 19."),
                (operate(4, dead_man=10_001), "Dead-man 10001: 19."),
                (operate(4, dead_man=10_000), "Good: safe state until the first value."),
                (operate(4, dead_man=10_000), "Its own actuator again: 2."),
                (operate(0), "All sensors."),
                (operate(1), "A sensor again: its lease is renewed."),
                (OPERATION, "Operation."),
            ]
        )
        .rows(
            [
                (operate(4, dead_man=500), "Another's actuator: 17."),
                (operate(1), "A sensor is shared."),
                (OPERATION, "Operation."),
            ],
            F2,
        )
    )


def _checks_of_values() -> Iterator[OperationScene]:
    scene = OperationScene("value-checks", "3.1, Sample, 3.2, Set: 1, 4, 2, 3, 19.")
    scene.rows([(operate(1), "Sensor 1."), (operate(4, dead_man=10_000), "Actuator 4.")])
    yield scene.rows(
        [
            (read_data_set(9), "A channel that is not there: 1."),
            (Command(1, 3, 1, bytes(3)), "Three octets: 4."),
            (Command(2, 3, 1, b"\0\0\0\1"), "Not claimed, offset 1: 2."),
            (Command(1, 3, 1, b"\0\0\0\1"), "Offset 1: 19."),
            (read_data_set(1), "Good."),
            (read_data_set(4), "The set point of an actuator."),
            (sample([]), "Sample of nothing: 4."),
            (sample([1, 1]), "One twice: 4."),
            (sample([1, 9]), "One that is not there: 2."),
            (sample([1, 2]), "One not claimed: 2."),
            (sample([4, 1]), "Good, in the order asked."),
            (write_data_set(4, b"\0"), "Another width: 4."),
            (write_data_set(6, TOO_MUCH), "Not claimed, and too much: 2."),
            (Command(1, 3, 2, b"\0\0\0\1\0\0"), "A sensor, at offset 1: 3."),
            (Command(4, 3, 2, b"\0\0\0\1" + VALUE), "Offset 1: 19."),
            (write_data_set(4, TOO_MUCH), "More than the hardware bears: 19."),
            (write_data_set(4, VALUE), "Good."),
            (set_values([]), "Set of nothing: 4."),
            (set_values([(4, b"\0")]), "Cut short: 4."),
            (set_values([(4, VALUE), (4, VALUE)]), "One twice: 4."),
            (set_values([(9, VALUE)]), "One that is not there: 2."),
            (set_values([(4, TOO_MUCH), (6, VALUE)]), "One not claimed, the other too much: 2."),
            (set_values([(4, TOO_MUCH), (1, VALUE)]), "A sensor: 3."),
            (set_values([(4, LOW.to_bytes(2, "big"))]), "The least that it bears: good."),
            (run_self_test(9), "Self-test of a channel that is not there: 1."),
            (Command(1, 1, 5, b"\1"), "Another self-test: 19."),
            (run_self_test(2), "Self-test, which needs no claim."),
            (idle(9), "Idle of a channel that is not there: 1."),
            (idle(2), "Idle where nothing was claimed: good."),
            (Command(1, 4, 3, b"\1"), "Another function of class 4: 1."),
        ]
    )


def _checks_of_streams() -> Iterator[OperationScene]:
    scene = OperationScene("subscribe-checks", "Subscribe: 4, 2, 3, 19, 10, 21, 20, 22, in this order.", streams=1)
    scene.rows([(operate(0), "All sensors."), (operate(4, dead_man=10_000), "Actuator 4.")])
    now = scene.bench.hardware.tick
    yield scene.rows(
        [
            (subscribe(n=0, channels=(9,)), "n 0: 4."),
            (subscribe(kind=StreamKind.EVENT, n=2, channels=(5,)), "Events, n 2: 4."),
            (subscribe(stream=4), "Stream 4: 4."),
            (subscribe(channels=(4, 9)), "One that is not there: 2."),
            (subscribe(channels=(4,), period=0), "An actuator: 3."),
            (subscribe(channels=(5,)), "Periodic of an event sensor: 19."),
            (subscribe(kind=StreamKind.EVENT, n=1), "Events of a sensor: 19."),
            (subscribe(period=10**12 + 1, n=200), "A period above 10^12: 19."),
            (subscribe(n=114, gap=65535), "241 octets: 10."),
            (subscribe(n=1, gap=5001, start=now), "2 frames · 5001 µs in 10 ms: 21."),
            (subscribe(start=now), "A start that is past: 20."),
            (subscribe(start=now + 60 * SECOND + 1), "A start above 60 s ahead: 20."),
            (subscribe(n=1, gap=5000, start=now + 60 * SECOND), "The budget used up to its end: good."),
            (subscribe(stream=1, gap=0, n=100), "A second on this bus: 21."),
            (subscribe(n=1, gap=0), "In place of the first: good."),
            (subscribe(stream=1, gap=0, n=100), "A second: this node has room for one: 22."),
            (stop(1), "Stop of none: 2."),
            (stop(0), "Stop."),
            (drive([]), "Drive of nothing: 4."),
            (drive([6]), "Drive of one not claimed: 2."),
            (drive([4, 1]), "Drive of a sensor: 3."),
            (ArmCommand(bytes(16), 61, 0).command(), "Arm, life 61: 19."),
            (ArmCommand(bytes(16), 60, 3).command(), "Arm, action 3: 19."),
        ]
    )
    yield OperationScene("nfc", "Over NFC: no streams, no Drive, no trigger.", NFC).rows(
        [
            (operate(1), "Claimed."),
            (subscribe(), "Subscribe: 21."),
            (drive([4]), "Drive, not claimed: 21."),
            (ArmCommand(bytes(16), 10, 0).command(), "Arm: 21."),
            (sample([1]), "Sample: good."),
            (CLOCK, "Clock: good."),
        ],
        NFC,
    )


def _lives() -> Iterator[OperationScene]:
    scene = OperationScene("dead-man", "A dead-man lives by values for its channel alone.")
    scene.rows([(operate(4, dead_man=200), "Dead-man 200 ms."), (operate(6, dead_man=200), "The other one.")])
    scene.exchange(write_data_set(4, VALUE), "A value for 4.")
    scene.later(150 * MS).exchange(write_data_set(4, VALUE), "Another one; none for 6.").later(50 * MS, "6 goes safe.")
    scene.exchange(OPERATION, "Bit 5 of 6.").later(140 * MS).exchange(CLOCK, "A keep-alive is no value.").later(
        10 * MS, "4 goes safe."
    )
    yield scene.rows(
        [
            (write_data_set(4, VALUE), "Too late: 2."),
            (operate(4, dead_man=200), "The way back."),
            (OPERATION, "No bit 5."),
        ]
    )

    scene = OperationScene(
        "lease", "A lease lives by any good Sealed frame; the claims end with it, the session does not."
    )
    scene.rows([(operate(1, lease=60), "60 s."), (operate(2, lease=1), "The last Operate's counts: 1 s for both.")])
    scene.later(999 * MS).exchange(read_data_set(9), "Refused, and a sign of life all the same.")
    scene.later(999 * MS).exchange(sample([1, 2]), "Still claimed.").later(1 * SECOND, "Silence for 1 s.")
    yield scene.rows([(sample([1]), "2."), (OPERATION, "Nothing is claimed.")])


def _several() -> Iterator[OperationScene]:
    scene = OperationScene(
        "under-a-claim", "1.3, 1.4 and 128.10 while a session claims: 2 in one that claims, else 17.", F1, F2, NFC
    )
    write, address = write_teds(1, 12, 0, b"x"), security_command(Function.SET_CAN_ADDRESS, b"\x21")
    scene.exchange(operate(1), "F1 claims a sensor.")
    for command, words in ((write, "Write"), (update_teds(1, 12), "Update"), (address, "Set CAN address")):
        scene.exchange(command, f"{words}, its own claim: 2.").exchange(command, f"{words}, another's: 17.", F2)
    scene.exchange(address, "Plain and tapped: 17.", NFC, plain=True)
    scene.exchange(write, "A Write over NFC ends the claims of others on sensors.", NFC).exchange(
        OPERATION, "Nothing is claimed."
    )
    scene.exchange(operate(4, dead_man=10_000), "F1 claims an actuator.")
    yield scene.exchange(write, "Now a Write over NFC gets 17 too.", NFC)

    scene = OperationScene(
        "strangers", "No stranger stops a motor: a node that takes long for a point operation.", quick_points=False
    )
    read = read_teds(0, 128, 0)
    scene.exchange(PROVE, "Prove, nothing claimed: good.", plain=True).exchange(
        operate(4, dead_man=10_000), "An actuator."
    )
    scene.exchange(PROVE, "Plain Prove: 17.", plain=True).exchange(PROVE, "In the session: good.")
    scene.exchange(security_command(Function.OPEN, bytes(89)), "The long form of a plain Open: 17.", F2, plain=True)
    scene.exchange(operate(1), "A sensor.").exchange(subscribe(), "A stream.")
    scene.exchange(read, "Plain Read: good.", plain=True).exchange(
        security_command(Function.LIST), "List within a second: 17.", NFC, plain=True
    )
    yield scene.later(1 * SECOND).exchange(read, "A second later: good.", F2, plain=True)


def _streams() -> Iterator[OperationScene]:
    scene = OperationScene("two-streams", "Two streams on one bus: 700 µs apart, the shorter n · period first.")
    start = scene.bench.hardware.tick + 20 * MS
    scene.exchange(operate(0), "All sensors.")
    scene.exchange(subscribe(n=4, gap=300, start=start, channels=(1, 3)), "Stream 0: four samples of 1 and 3.")
    scene.exchange(
        subscribe(stream=1, n=1, period=30 * MS, gap=700, start=start, channels=(2,)), "Stream 1: one sample of 2."
    )
    scene.until(start + 65 * MS, "Frames; then message 2 of stream 1 is full.")
    yield scene.rows([(stop(1), "Stop."), (idle(), "Idle ends the other."), (stop(0), "None left: 2.")])

    scene = OperationScene("taken-back", "Frames not yet sent are taken back at every end.")
    start = scene.bench.hardware.tick + 20 * MS
    scene.exchange(operate(1), "Sensor 1.").exchange(
        subscribe(n=25, period=1 * MS, gap=2000, start=start), "Eight frames, 2 ms apart."
    )
    yield (
        scene.until(start + 29 * MS, "Three frames.")
        .exchange(stop(0), "The counter says that one was full.")
        .later(50 * MS, "Nothing more.")
    )

    scene = OperationScene(
        "events", "Events before the start do not count; those sooner than the period count and are dropped."
    )
    start = scene.bench.hardware.tick + 20 * MS
    scene.exchange(operate(5), "The event sensor.").exchange(
        subscribe(kind=StreamKind.EVENT, n=1, period=20 * MS, start=start, channels=(5,)), "Subscribe."
    )
    for after, note in (
        (-1, "Before the start."),
        (0, "Counter 0."),
        (19, "Too soon: counter 1, dropped."),
        (20, "Counter 2."),
    ):
        scene.until(start + after * MS).event(5, bytes([50 + after]), note)
    yield scene.later(5 * MS).exchange(stop(0), "3.")

    scene = OperationScene("replaced", "A half-open Open ends nothing; its first good frame ends claims and streams.")
    scene.exchange(operate(1), "Sensor 1.").exchange(subscribe(n=1, period=20 * MS), "Subscribe.")
    scene.later(45 * MS).open(F1)
    scene.later(20 * MS, "The stream goes on.").exchange(OPERATION, "The first good frame of the new session.")
    yield scene.later(50 * MS, "Nothing more.")


def _triggers() -> Iterator[OperationScene]:
    token, other, last = (TriggerToken(octets("trigger", number)[:8]) for number in range(3))
    scene = OperationScene(
        "trigger", "A trigger: the mark, the start of streams that wait, once, for its life.", F1, F2
    )
    scene.exchange(operate(1), "Sensor 1.").exchange(subscribe(start=WAITS), "A stream that waits.")
    scene.exchange(token.arm(Action.START, 10).command(), "Arm, start.").exchange(CLOCK, "No mark.").later(5 * MS)
    scene.trigger(other.octets, "A wrong T changes nothing.").trigger(token.octets, "Another station's frame.", F2)
    scene.exchange(CLOCK, "No mark.").trigger(token.octets, "The right one.").exchange(CLOCK, "The mark.")
    scene.later(45 * MS, "The stream began 10 ms after the mark.").trigger(token.octets, "Used up.").exchange(
        CLOCK, "The mark stands."
    )
    scene.exchange(other.arm(Action.MARK, 1).command(), "Arm, mark, for 1 s.").later(1 * SECOND)
    scene.trigger(other.octets, "Too late.").exchange(CLOCK, "The mark stands.")
    scene.exchange(last.arm(Action.MARK, 10).command(), "Arm once more.").exchange(
        idle(), "The last claim goes, and what is armed."
    )
    yield scene.trigger(last.octets, "Nothing.").exchange(CLOCK, "The mark stands.")

    scene = OperationScene("trigger-stop", "A trigger that stops: every actuator of its session goes safe.", F1, F2)
    scene.exchange(operate(4, dead_man=10_000), "F1 claims 4.").exchange(
        operate(6, dead_man=10_000), "F2 claims 6.", F2
    )
    scene.exchange(write_data_set(4, VALUE), "A value.").exchange(write_data_set(6, VALUE), "A value.", F2)
    scene.exchange(token.arm(Action.STOP, 10).command(), "Arm, stop.").trigger(token.octets, "4 goes safe.")
    yield scene.exchange(OPERATION, "Bit 5 of 4; 6 goes on.")


def _drives() -> Iterator[OperationScene]:
    scene = OperationScene("drive", "Drive messages: which move and which do not.")
    scene.exchange(operate(4, dead_man=500), "Actuator 4.").exchange(operate(6, dead_man=800), "Actuator 6.").exchange(
        drive([4, 6]), "Drive."
    )
    reply = DriveReply.decode(bytes.fromhex(scene.steps[-1]["reply"])[3:])
    driver = Driver(Layout((4, 6), (2, 2)), reply, scene.bench.sessions[F1].message_key, dead_man=500)

    def message(*values: int, ahead: int = 0, hold: int = 500) -> bytes:
        tick = scene.bench.hardware.tick + ahead * MS
        data = tuple(value.to_bytes(2, "big") for value in values)
        return driver.seal(data, TickBounds(tick, tick), hold=hold * MS)

    first, held = message(1000, 1001), message(2000, 2001, hold=20)
    scene.message(first, "Counter 0: good.").message(first, "Again: nothing.")
    scene.message(first[:-1] + bytes([first[-1] ^ 1]), "A bad tag: nothing.").exchange(CLOCK, "last 0.")
    scene.later(21 * MS).message(held, "Counter 1, its until is past: nothing.").exchange(CLOCK, "last 1 all the same.")
    scene.message(message(3000, 3001, ahead=2), "until 502 ms ahead, the smallest dead-man is 500: nothing.")
    scene.message(message(3000, HIGH + 1), "One value that the hardware does not bear: nothing.")
    scene.message(message(1500, 1501), "Good.").exchange(read_data_set(6), "1501.")
    scene.later(499 * MS, "Nothing yet.").later(1 * MS, "4 goes safe, Drive ends; 6 goes on.")
    scene.message(message(1600, 1601), "Nothing.").exchange(OPERATION, "Operation.")
    yield scene.later(300 * MS, "6 goes safe.")


FILES = {"operation": operation}
