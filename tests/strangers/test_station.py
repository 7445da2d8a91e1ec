"""A stranger's station against the product's node: every scenario of operation.md that crosses the wire."""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.e2e.desk import Links, Running
from tests.node.measuring_station import KEY, keyed_node
from tests.places import new_uuid
from tests.strangers.station import NodeRefusalError, Station, identify
from tests.strangers.wire import of_spec

pytestmark = pytest.mark.link
MS = 1_000_000
ANGLE = "magnetic-angular-position-sensor"
ACTUATOR, EVENT, SAFE, STOPPED, CLAIMED, BY_OTHER = 1, 8, 16, 32, 2, 4


class Floor:
    """Nodes of the product, each in a process, and strangers' stations on their bus."""

    def __init__(self, folder: Path, fd: bool) -> None:
        self.folder, self.fd = folder, fd
        self.can = Links().can
        self.addresses: set[int] = set()
        self.group, self.port = of_spec(self.can)
        self._stack = ExitStack()

    def run(self, profile: str, source: str = "ramp:2") -> Running:
        keyed_node(self.folder / profile, profile=profile, uuid=new_uuid(self.addresses))
        spec = self.can + ("&fd=1" if self.fd else "")
        process = Running("--json", "node", "run", self.folder / profile, "--can", spec, "--source", source)
        self._stack.callback(process.close)
        process.wait_for_lines(1)
        return process

    def station(self, profile: str, own: int = 0xF1) -> Station:
        flash = keyed_node(self.folder / profile).load()
        made = Station(self.group, self.port, flash.can_address, flash.uuid, KEY, own=own, fd=self.fd)
        self._stack.callback(made.close)
        made.open()
        return made

    def close(self) -> None:
        self._stack.close()


@pytest.fixture(params=[False, True], ids=["classic", "fd"])
def floor(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Floor]:
    made = Floor(tmp_path, request.param)
    yield made
    made.close()


def refused(reason: int, what: Callable[[], object]) -> None:
    with pytest.raises(NodeRefusalError) as caught:
        what()
    assert caught.value.reason == reason


def of_kind(station: Station, bit: int) -> list[int]:
    return [number for number, (state, _) in station.states()[1].items() if state & 9 == bit]


def test_who_is_there_and_who_answers_whom(floor: Floor) -> None:
    floor.run(ANGLE)
    station = floor.station(ANGLE)
    [found] = identify(floor.group, floor.port, fd=floor.fd)
    assert (found["address"], found["uuid"], found["state"]) == (station.node, station.uuid, 1)
    assert found["can"] == found["address"]
    # Outside a session nothing of operation.md is done; inside, what is unknown is unknown.
    refused(3, lambda: station.plain(0, 128, 19))
    refused(3, lambda: station.plain(0, 128, 16))
    refused(3, lambda: station.plain(1, 3, 1, bytes(4)))
    refused(1, lambda: station.do(0, 2, 5, b"\2"))
    refused(1, lambda: station.do(0, 128, 99))
    refused(1, lambda: station.do(1, 128, 16))
    # A repetition is answered from what is stored, a replay under another transaction with 13, a wrong tag with 12.
    frame = station.sealed(station.command(0, 128, 19))
    first = station.raw(frame)
    assert station.raw(frame, again=True) == first
    refused(13, lambda: station.payload(station.raw(frame), True))
    sealed = station.sealed(station.command(0, 128, 19))
    broken = sealed[:-1] + bytes([sealed[-1] ^ 1])
    refused(12, lambda: station.payload(station.raw(broken), True))
    assert station.states()[0] == 0, "a bad frame ends nothing"


def test_claims_leases_and_data_sets(floor: Floor) -> None:
    floor.run(ANGLE)
    station = floor.station(ANGLE)
    assert station.states() == (0, {1: (0, 0)})
    refused(2, lambda: station.do(1, 3, 1, bytes(4)))
    refused(6, lambda: station.operate(0, digest=bytes(16)))
    refused(19, lambda: station.operate(0, lease=0))
    refused(19, lambda: station.operate(0, lease=61))
    refused(1, lambda: station.operate(9))
    refused(1, lambda: station.do(0xFFFF, 4, 1, station.digest + b"\x0a"))
    refused(4, lambda: station.do(1, 4, 1, station.digest + b"\x0a\0\x64"))  # a dead-man is for actuators
    refused(4, lambda: station.do(1, 4, 1, station.digest))
    station.operate(0, lease=30)
    assert station.states() == (1, {1: (CLAIMED, 0xF1)})
    station.operate(1)
    assert len(station.do(1, 3, 1, bytes(4))) == 4 + 2
    refused(19, lambda: station.do(1, 3, 1, b"\0\0\0\1"))
    refused(4, lambda: station.do(1, 3, 1, b"\0"))
    taken = station.do(0, 128, 12, b"\1")
    assert len(taken) == 8 + 1 + 2
    assert taken[8] & 0xFE == 0
    refused(4, lambda: station.do(0, 128, 12, b"\1\1"))
    refused(4, lambda: station.do(0, 128, 12, b""))
    refused(2, lambda: station.do(0, 128, 12, b"\7"))
    refused(3, lambda: station.do(1, 3, 2, bytes(4) + b"\0\0"))  # a sensor takes no value
    refused(2, lambda: station.do(1, 1, 3, b"\3" + bytes(4) + b"x"))  # the datasheet stands while it is claimed
    refused(2, lambda: station.do(0, 128, 10, b"\x21"))
    station.do(1, 1, 5, b"\0")
    assert station.states()[1][1][0] & 64, "its self-test runs"
    assert len(station.do(0, 128, 18)) == 7
    station.idle()
    station.idle()
    assert station.states() == (0, {1: (64, 0)}) or station.states() == (0, {1: (0, 0)})
    # A session that says nothing loses its claims, not itself.
    station.operate(0, lease=1)
    station.wire.turn(1.5)
    assert station.states()[0] == 0
    # Another station sees it, and shares the sensor.
    other = floor.station(ANGLE, own=0xF2)
    station.operate(0)
    assert other.states()[1][1] == (BY_OTHER, 0xF1)
    other.operate(0)
    assert other.states()[1][1] == (CLAIMED | BY_OTHER, 0xF2)
    refused(17, lambda: floor_write(other))
    assert len(station.do(1, 3, 1, bytes(4))) == 6


def floor_write(station: Station) -> None:
    """A write of somebody who claims nothing, while another one does."""
    station.idle()
    station.do(1, 1, 3, b"\3" + bytes(4) + b"x")


def test_streams_come_whole_in_time_and_end(floor: Floor) -> None:
    floor.run(ANGLE)
    station = floor.station(ANGLE)
    station.operate(0, lease=30)
    clock = station.clock()
    run = station.subscribe(0, 0, 10, 5 * MS, {1: 2})
    assert (run.run, run.length) == (1, 13 + 10 * 2)
    assert clock["sent"] < run.start < station.clock()["sent"] + 10**9
    got = station.hear(run, 8)
    counters = [counter for counter, _ in got]
    assert counters == sorted(set(counters))
    assert run.bad == 0
    assert all(len(plain) == 1 + 20 and plain[0] & 0x7E == 0 for _, plain in got)
    # The ramp rises by the same step each instant: index and time need no sending.
    values = [int.from_bytes(got[0][1][1 + 2 * i : 3 + 2 * i], "big") for i in range(10)]
    steps = {after - before for before, after in itertools.pairwise(values) if after > before}
    assert max(steps) - min(steps) <= 1, values
    # A new Subscribe ends the run before; its frames are of another key.
    again = station.subscribe(0, 0, 1, 20 * MS, {1: 2})
    assert again.run == 2
    station.hear(again, 3)
    # A refused one changes nothing.
    refused(4, lambda: station.subscribe(0, 0, 0, 20 * MS, {1: 2}))
    refused(4, lambda: station.subscribe(4, 0, 1, 20 * MS, {1: 2}))
    refused(4, lambda: station.subscribe(0, 3, 1, 20 * MS, {1: 2}))
    refused(4, lambda: station.subscribe(0, 1, 2, 20 * MS, {1: 2}))
    refused(4, lambda: station.subscribe(0, 0, 1, 20 * MS, {}))
    refused(2, lambda: station.subscribe(0, 0, 1, 20 * MS, {9: 2}))
    refused(19, lambda: station.subscribe(0, 1, 1, 20 * MS, {1: 2}))  # no event sensor
    refused(19, lambda: station.subscribe(0, 0, 1, 1, {1: 2}))  # faster than it can
    refused(19, lambda: station.subscribe(0, 0, 1, 2 * 10**12, {1: 2}))
    refused(10, lambda: station.subscribe(0, 0, 114, 20 * MS, {1: 2}))  # 241 octets
    refused(21, lambda: station.subscribe(0, 0, 1, 1 * MS, {1: 2}, gap=60_000))
    refused(20, lambda: station.subscribe(0, 0, 1, 20 * MS, {1: 2}, start=1))
    refused(20, lambda: station.subscribe(0, 0, 1, 20 * MS, {1: 2}, start=station.clock()["sent"] + 61 * 10**9))
    before = len(again.messages)
    station.hear(again, before + 2)
    end = station.stop(0)
    counters = [counter for counter, _ in again.messages]
    assert end >= max(counters) + 1
    station.data_frames.clear()
    station.wire.turn(0.2)
    assert station.data_frames == [], "after the reply to Stop nothing leaves"
    refused(2, lambda: station.stop(0))
    # At a start that was asked for, and free running, each message with its tick.
    start = station.clock()["sent"] + 300 * MS
    timed = station.subscribe(1, 2, 5, 10 * MS, {1: 2}, start=start)
    assert (timed.start, timed.length) == (start, 13 + 8 + 10)
    free = station.hear(timed, 4)
    ticks = [int.from_bytes(plain[1:9], "big") for _, plain in free]
    assert ticks[0] >= start
    assert all(abs(after - before - 50 * MS * (c1 - c0)) < MS for (c0, _), (c1, _), before, after
               in zip(free, free[1:], ticks, ticks[1:], strict=False))  # fmt: skip
    # The test pattern counts.
    pattern = station.subscribe(2, 0x80, 4, 5 * MS, {1: 2})
    for counter, plain in station.hear(pattern, 5):
        assert plain[0] == 0x80
        assert [int.from_bytes(plain[1 + 2 * i : 3 + 2 * i], "big") for i in range(4)] == [
            (counter * 4 + i + 1) % 65536 for i in range(4)
        ]
    # The end of the claim ends all of them; so does Close, and a new session begins with run 1.
    station.idle()
    station.data_frames.clear()
    station.wire.turn(0.2)
    assert station.data_frames == []
    station.open()
    station.operate(0)
    assert station.subscribe(0, 0, 5, 5 * MS, {1: 2}).run == 1
    station.do(0, 128, 5)
    station.data_frames.clear()
    station.wire.turn(0.2)
    assert station.data_frames == []


def test_a_half_open_open_ends_nothing_and_its_first_good_frame_all(floor: Floor) -> None:
    floor.run(ANGLE)
    station = floor.station(ANGLE)
    station.operate(0)
    run = station.subscribe(0, 0, 2, 10 * MS, {1: 2})
    station.hear(run, 3)
    keys, counter = station.keys, station.counter
    station.open()
    station.runs[0] = run
    before = len(run.messages)
    station.hear(run, before + 5)
    new, station.keys, station.counter = station.keys, keys, counter
    assert station.states()[0] == 1, "the session before still holds"
    station.keys, station.counter = new, 0
    assert station.states() == (0, {1: (0, 0)})
    before = len(run.messages)
    station.wire.turn(0.2)
    assert len(run.messages) == before


def test_clock_trigger_and_marks(floor: Floor) -> None:
    floor.run(ANGLE)
    station = floor.station(ANGLE)
    a = time.monotonic_ns()
    first = station.clock()
    d = time.monotonic_ns()
    assert 0 < first["sent"] - first["received"] <= d - a
    assert (first["mark"], first["last"]) == (0, 2**32 - 1)
    station.wire.turn(0.5)
    asked = time.monotonic_ns()
    second = station.clock()
    sent_at = time.monotonic_ns()
    assert asked - d - MS < second["sent"] - first["sent"] < sent_at - a + MS, "it runs as ours does"
    station.operate(0, lease=30)
    waiting = station.subscribe(0, 0, 2, 10 * MS, {1: 2}, start=2**64 - 1)
    assert station.stop(0) == 0
    waiting = station.subscribe(0, 0, 2, 10 * MS, {1: 2}, start=2**64 - 1)
    token = os.urandom(8)
    c = hashlib.sha256(b"TEDS1 trigger\0" + token).digest()[:16]
    refused(19, lambda: station.do(0, 128, 17, c + bytes([61, 1])))
    refused(19, lambda: station.do(0, 128, 17, c + bytes([5, 3])))
    refused(4, lambda: station.do(0, 128, 17, c + bytes([5])))
    station.do(0, 128, 17, c + bytes([5, 1]))
    station.trigger(os.urandom(8))
    station.wire.turn(0.3)
    assert station.clock()["mark"] == 0
    assert waiting.messages == []
    station.trigger(token)
    got = station.hear(waiting, 3)
    mark = station.clock()["mark"]
    assert first["sent"] < mark < station.clock()["sent"]
    assert got[0][0] in (0, 1)
    station.trigger(token)  # it was good once
    assert station.clock()["mark"] == mark


def test_events_come_with_their_ticks(floor: Floor) -> None:
    floor.run("limit-switch", source="sine:0.2")
    station = floor.station("limit-switch")
    [switch] = of_kind(station, EVENT)
    station.operate(0, lease=30)
    width = len(station.do(switch, 3, 1, bytes(4))) - 4
    refused(19, lambda: station.subscribe(0, 0, 1, 10 * MS, {switch: width}))
    run = station.subscribe(0, 1, 1, 1 * MS, {switch: width})
    assert run.length == 13 + 8 + width
    got = station.hear(run, 6)
    ticks = [int.from_bytes(plain[1:9], "big") for _, plain in got]
    assert ticks == sorted(set(ticks))
    states = [plain[9:] for _, plain in got]
    assert all(before != after for (c0, _), (c1, _), before, after
               in zip(got, got[1:], states, states[1:], strict=False) if c1 == c0 + 1)  # fmt: skip


def shown(process: Running, channel: int) -> list[dict[str, object]]:
    process.read(0.1)
    lines = [json.loads(line) for line in process.out.splitlines(keepends=True) if line.endswith("\n")]
    return [line for line in lines if line.get("event") == "actuator" and line["channel"] == channel]


def test_actuators_dead_man_set_and_drive(floor: Floor) -> None:
    process = floor.run("gripper")
    station = floor.station("gripper")
    hand = of_kind(station, ACTUATOR)[0]
    assert station.states()[1][hand] == (ACTUATOR | SAFE, 0)
    station.operate(0)
    refused(2, lambda: station.do(hand, 3, 2, bytes(4) + b"\1\0"))  # 0 claims sensors alone
    refused(19, lambda: station.operate(hand, dead_man=19))
    refused(19, lambda: station.operate(hand, dead_man=10_001))
    refused(4, lambda: station.operate(hand))
    station.operate(hand, dead_man=10_000)
    refused(2, lambda: station.operate(hand, dead_man=10_000))  # Operate is no sign of life
    assert station.states()[1][hand] == (ACTUATOR | CLAIMED | SAFE, 0xF1)
    station.do(hand, 3, 2, bytes(4) + b"\1\0")
    assert station.states()[1][hand] == (ACTUATOR | CLAIMED, 0xF1)
    assert station.do(hand, 3, 1, bytes(4))[4:] == b"\1\0"
    refused(19, lambda: station.do(hand, 3, 2, bytes(4) + b"\xff\xff"))  # beyond what the hardware bears
    assert station.do(hand, 3, 1, bytes(4))[4:] == b"\1\0", "every set point stays"
    station.do(0, 128, 13, bytes([hand]) + b"\1\1")
    refused(2, lambda: station.do(0, 128, 13, bytes([hand]) + b"\1\2" + b"\x63\0\0"))
    refused(4, lambda: station.do(0, 128, 13, bytes([hand]) + b"\1"))
    assert station.do(hand, 3, 1, bytes(4))[4:] == b"\1\1"
    # Another session gets 17; nothing but values feeds the dead-man.
    other = floor.station("gripper", own=0xF2)
    refused(17, lambda: other.operate(hand, dead_man=600))
    end = time.monotonic() + 10.5
    while time.monotonic() < end:
        station.clock()
        station.wire.turn(0.25)
    assert station.states()[1][hand] == (ACTUATOR | SAFE | STOPPED, 0)
    refused(2, lambda: station.do(hand, 3, 2, bytes(4) + b"\1\0"))
    # Drive: values without a reply, each good once, in its time.
    station.operate(hand, dead_man=10_000)
    refused(2, lambda: station.drive([9]))
    _, length, key = station.drive([hand])
    assert length == 4 + 4 + 2 + 8

    def now_us() -> int:
        return station.clock()["sent"] // 1000

    good = station.drive_message(key, 0, now_us() + 8_000_000, b"\2\0")
    station.put_drive(good)
    assert station.clock()["last"] == 0
    assert station.do(hand, 3, 1, bytes(4))[4:] == b"\2\0"
    for counter, until, value in (
        (0, 8_000_000, b"\3\0"),  # replayed counter
        (3, -1_000, b"\3\0"),  # past
        (4, 60_000_000, b"\3\0"),  # too far ahead
        (5, 8_000_000, b"\xff\xff"),  # not borne
    ):
        station.put_drive(station.drive_message(key, counter, now_us() + until, value))
    station.put_drive(station.drive_message(bytes(16), 6, now_us() + 8_000_000, b"\3\0"))
    assert station.clock()["last"] == 5, "a good tag uses up its counter all the same"
    assert station.do(hand, 3, 1, bytes(4))[4:] == b"\2\0"
    station.put_drive(station.drive_message(key, 7, now_us() + 8_000_000, b"\0\x40"))
    assert station.do(hand, 3, 1, bytes(4))[4:] == b"\0\x40"
    # A trigger stops, and never moves.
    token = os.urandom(8)
    station.do(0, 128, 17, hashlib.sha256(b"TEDS1 trigger\0" + token).digest()[:16] + bytes([5, 2]))
    station.trigger(token)
    assert station.states()[1][hand] == (ACTUATOR | SAFE | STOPPED, 0)
    # Idle, Close, and the process's end bring it to its safe state.
    for end_it in (lambda: station.idle(hand), lambda: station.do(0, 128, 5)):
        station.operate(hand, dead_man=5000)
        station.do(hand, 3, 2, bytes(4) + b"\1\0")
        end_it()
        assert other.states()[1][hand][0] & SAFE
    deadline = time.monotonic() + 60
    while not shown(process, hand)[-1]["safe"]:
        assert time.monotonic() < deadline


def test_a_session_that_was_recorded_is_worth_nothing(floor: Floor) -> None:
    floor.run("gripper")
    station = floor.station("gripper")
    hand = of_kind(station, ACTUATOR)[0]
    station.operate(hand, dead_man=10_000)
    recorded = [station.sealed(station.command(hand, 3, 2, bytes(4) + b"\1\0"))]
    station.raw(recorded[0])
    station.open()
    assert station.states()[1][hand][0] & SAFE, "its claim went with the session before"
    for frame in recorded:
        refused(12, lambda frame=frame: station.payload(station.raw(frame), True))
    assert station.states()[1][hand][0] & SAFE
