"""A virtual node in a process of its own measures and acts over a real bus, as a station sees it."""

from __future__ import annotations

import itertools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError
from teds_provision.links.nfc.port import NfcPort
from teds_provision.node.hardware.converter import Converter
from teds_provision.node.sources import make_source
from teds_provision.node.sources.base import Reading
from teds_provision.protocol.messages.frames import Function, decode_reply, security_command
from teds_provision.protocol.operation.commands import (
    ChannelState,
    PowerFlag,
    PowerReply,
    SampleReply,
    idle,
    sample,
    set_values,
)
from teds_provision.protocol.operation.datagram import Layout
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.stream_commands import (
    WAITS,
    Action,
    DriveReply,
    StreamKind,
    SubscribeReply,
    decode_stopped,
    drive,
    stop,
)
from teds_provision.protocol.operation.subscription import Receiver, StreamMessage, StreamPlan, TickBounds
from teds_provision.protocol.operation.timing import TriggerToken, mark_is_honest
from teds_provision.teds.calibration import load_calibrations
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from tests.cli.shell import clean_environment
from tests.e2e.desk import ROOT, Links, Running
from tests.links.can.hub import Hub
from tests.node.measuring_station import MeasuringStation, SealedLine, keyed_node
from tests.pace import PATIENCE, best_of, succeeds
from tests.places import new_uuid

pytestmark = pytest.mark.link
ANGLE = "magnetic-angular-position-sensor"
MS = 1_000_000
CALIBRATION = "raw,value [deg]\n0,0\n16383,360\n"


class Scene:
    """Nodes that run, and stations on their bus."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.can = folder, Links().can
        self.addresses: set[int] = set()
        self._stack = ExitStack()

    def run(self, name: str, *words: object, profile: str = ANGLE, can: str = "") -> Running:
        """Return a node that is keyed and up."""
        keyed_node(self.folder / name, profile=profile, uuid=new_uuid(self.addresses))
        process = Running("--json", "node", "run", self.folder / name, "--can", can or self.can, *words)
        self._stack.callback(process.close)
        process.wait_for_lines(1)
        return process

    def station(self, name: str, can: str = "") -> MeasuringStation:
        flash = keyed_node(self.folder / name).load()
        station = MeasuringStation(can or self.can, flash.uuid, flash.can_address)
        self._stack.callback(station.close)
        return station

    def sheet(self, name: str) -> Sheet:
        made = keyed_node(self.folder / name)
        return Sheet.from_image(Image(made.load().uuid, made.hardware))

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
def scene(tmp_path: Path) -> Iterator[Scene]:
    scene = Scene(tmp_path)
    yield scene
    scene.close()


def wait_for(what: Callable[[], object], seconds: float = PATIENCE) -> bool:
    until = time.monotonic() + seconds
    while not what():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def actuator_lines(process: Running) -> list[Any]:
    process.read(0.05)
    lines = process.out.splitlines()[: process.out.count("\n")]
    return [line for line in map(json.loads, lines) if line.get("event") == "actuator"]


@pytest.mark.parametrize("form", ["", "&fd=1"])
def test_a_stream_brings_the_source_sample_for_sample(scene: Scene, form: str) -> None:
    can = scene.can + form
    scene.run("angle", "--source", "sine:2", can=can)
    station, sheet = scene.station("angle", can), scene.sheet("angle")
    station.operate(lease=60)
    source = make_source("sine:2", [Converter(sheet, sheet.channels[0]).place], print)
    converter = Converter(sheet, sheet.channels[0])

    def missing() -> int:
        """Of twelve messages: a node that a busy machine let wait for too long leaves some out."""
        receiver, reply = station.subscribe(StreamPlan.for_channels(1, ((1, 2),), n=5, period=4 * MS, gap=100))
        messages = station.hear(receiver, 12)
        assert decode_stopped(station.send(stop(1))) >= 12
        assert receiver.counts.bad == 0
        right(messages, reply)
        return receiver.counts.lost + receiver.counts.late + abs(messages[-1].counter - 11)

    def right(messages: list[StreamMessage], reply: SubscribeReply) -> None:
        for message in messages:
            assert message.valid
            assert message.tick == reply.start + message.index * 4 * MS
            for instant in range(5):
                seconds = (message.tick + instant * 4 * MS) / 1e9
                expected = converter.octets(source.at(1, seconds) or Reading())
                assert message.data[2 * instant : 2 * instant + 2] == expected

    succeeds(5, missing, because="twelve messages in 240 ms: one that the node is 20 ms late with is left out")


def test_a_classic_bus_takes_a_kilohertz_of_two_streams_and_loses_nothing(scene: Scene) -> None:
    hub = Hub()
    try:
        process = scene.run("angle", can=hub.spec)
        station = scene.station("angle", hub.spec)
        station.operate()
        receiver, _ = station.subscribe(
            StreamPlan.for_channels(0, ((1, 2),), n=25, period=1 * MS, gap=300, test_pattern=True)
        )
        messages = station.hear(receiver, 40)
        assert all(message.data == receiver.expected(message) for message in messages)
        station.send(idle())
        counts = receiver.counts
        assert (counts.bad, counts.junk, counts.late, counts.unasked) == (0, 0, 0, 0)
        if counts.lost:  # nothing else may be missing: a node that a busy machine let wait for too long says so
            process.wait_for("could not be sent in time")
    finally:
        hub.close()


def test_nothing_of_a_stream_comes_after_the_reply_to_stop(scene: Scene) -> None:
    scene.run("angle")
    station = scene.station("angle")
    station.operate()
    for _ in range(8):
        receiver, _ = station.subscribe(StreamPlan.for_channels(0, ((1, 2),), n=5, period=1 * MS, gap=200))
        station.hear(receiver, 3)
        station.send(stop(0))
        replied = time.monotonic()
        time.sleep(0.05)
        late = []
        while (frame := station.ear.get(0)) is not None:
            late += [frame.at - replied] if frame.at > replied else []
        assert late == []


def test_a_switch_reports_its_events_with_their_times(scene: Scene) -> None:
    scene.run("switch", "--source", "sine:0.4", profile="limit-switch")
    station = scene.station("switch")
    station.operate(lease=60)

    def wrong() -> list[int]:
        """Ticks from event to event where they are not those of the source: a node that was not run saw them late."""
        receiver, _ = station.subscribe(
            StreamPlan.for_channels(2, ((1, 1),), n=1, period=1 * MS, gap=100, kind=StreamKind.EVENT)
        )
        events = station.hear(receiver, 4)
        station.send(stop(2))
        assert all(before.data != after.data for before, after in itertools.pairwise(events))
        gaps = [after.tick - before.tick for before, after in itertools.pairwise(events)]
        return [] if all(100 * MS < gap < 300 * MS for gap in gaps) else gaps

    succeeds(5, wrong, because="an edge is seen within 50 ms only if the node runs then")


def test_without_a_sign_of_life_the_lease_silences_the_node(scene: Scene) -> None:
    scene.run("angle")
    station = scene.station("angle")

    def spoke_for() -> float:
        """Seconds from the last sign of life to the last sample; a lease of one second is over after one."""
        station.operate(lease=1)
        asked = time.monotonic()
        station.subscribe(StreamPlan.for_channels(0, ((1, 2),), n=1, period=50 * MS, gap=100))
        began = last = time.monotonic()
        while time.monotonic() - last < 0.6:
            if station.ear.get(0.1) is not None:
                last = time.monotonic()
        assert last - asked > 0.7, "a lease is not over before its time"
        return last - began

    best_of(5, 3, spoke_for, because="three seconds hold one lease and what a busy node sends after it")
    assert not station.states().channels[1][0] & ChannelState.CLAIMED_HERE


def test_an_actuator_shows_what_it_is_told_and_goes_safe_by_its_dead_man(scene: Scene) -> None:
    process = scene.run("gripper", profile="gripper")
    station, sheet = scene.station("gripper"), scene.sheet("gripper")
    converter = Converter(sheet, sheet.channels[0])
    half = converter.octets(Reading(value=(converter.low + converter.high) / 2))
    assert wait_for(lambda: [line["safe"] for line in actuator_lines(process)] == [True])
    with pytest.raises(NodeRefusedError) as refused:
        station.send(set_values([(1, half)]))
    assert refused.value.reason == 2
    station.operate(1, dead_man=400)
    station.send(set_values([(1, half)]))
    assert wait_for(lambda: len(actuator_lines(process)) == 3)
    driven, safe = actuator_lines(process)[1:]
    assert (driven["name"], driven["safe"]) == ("opening set point", False)
    assert driven["value"] == pytest.approx((converter.low + converter.high) / 2, rel=1e-3)
    assert (safe["safe"], safe["value"]) == (True, converter.low)
    state = station.states().channels[1][0]
    assert state & ChannelState.SAFE
    assert state & ChannelState.STOPPED


def test_a_raw_value_that_the_hardware_does_not_bear_is_refused(scene: Scene) -> None:
    scene.run("gripper", profile="gripper")
    station = scene.station("gripper")
    station.operate(1, dead_man=5000)
    with pytest.raises(NodeRefusedError) as refused:
        station.send(set_values([(1, b"\xff\xff")]))
    assert refused.value.reason == 19
    station.send(set_values([(1, b"\x0f\xff")]))


def test_drive_messages_move_an_actuator(scene: Scene) -> None:
    process = scene.run("gripper", profile="gripper")
    station = scene.station("gripper")
    station.operate(1, dead_man=10_000)
    layout = Layout((1,), (2,))
    driver = Driver(layout, DriveReply.decode(station.send(drive([1]))), station.session.message_key, dead_man=10_000)
    for raw in (100, 200, 300):  # each within its time, which is the dead-man's
        station.drive(driver.seal((raw.to_bytes(2, "big"),), station.now()))
        time.sleep(0.08)
    assert wait_for(lambda: [line["raw"] for line in actuator_lines(process)][-1:] == [300.0])
    station.read_clock()
    assert station.last_clock.last == 2
    process.signal(signal.SIGTERM)
    assert process.end().code == 0


def test_streams_of_two_nodes_start_at_one_trigger(scene: Scene) -> None:
    for name in ("left", "right"):
        scene.run(name)
    stations = [scene.station(name) for name in ("left", "right")]
    token = TriggerToken.draw()
    receivers = []
    for station in stations:
        station.operate()
        station.send(token.arm(Action.START, 20).command())
        receivers.append(
            station.subscribe(StreamPlan.for_channels(0, ((1, 2),), n=1, period=20 * MS, gap=100, start=WAITS))[0]
        )
    left_at = stations[0].trigger(token.octets)
    starts = []
    for station, receiver in zip(stations, receivers, strict=True):
        sample = station.read_clock()
        mark = station.last_clock.mark
        assert mark_is_honest(mark, sample.tick(left_at, own_drift=1000.0)) or mark > 0
        receiver.begin(mark + 10 * MS)
        (first,) = station.hear(receiver, 1)
        starts.append(first.tick - first.index * 20 * MS - sample.offset)
    assert abs(starts[0] - starts[1]) < 100 * MS


SIMULATION = """
import json, sys, time
t = 0.0
while True:
    t += 0.02
    print(json.dumps({"t": t, "value": {"angle": (t * 10) % 360}}), flush=True)
    time.sleep(0.02)
"""


def test_a_simulation_brings_its_own_time_and_its_end_is_survived(scene: Scene, tmp_path: Path) -> None:
    program = tmp_path / "simulation.py"
    program.write_text(SIMULATION)
    process = scene.run("angle", "--source", f"exec:{sys.executable} {program}")
    station, sheet = scene.station("angle"), scene.sheet("angle")
    converter = Converter(sheet, sheet.channels[0])
    station.operate()
    station.read_clock()
    assert wait_for(lambda: station.read_clock() and station.last_clock.step >= 19 * MS)
    sampled = SampleReply.decode(station.send(sample([1])), 2)
    assert sampled.valid
    degrees = converter.value(sampled.data)
    assert degrees is not None
    assert degrees == pytest.approx(sampled.tick / 1e9 * 10 % 360, abs=6)
    receiver, _ = station.subscribe(StreamPlan.for_channels(0, ((1, 2),), n=2, period=20 * MS, gap=100))
    first, second = station.hear(receiver, 2)
    assert second.tick - first.tick == (second.counter - first.counter) * 40 * MS
    assert first.valid
    pid = next(iter(_children(process.process.pid)))
    os.kill(pid, signal.SIGTERM)
    process.wait_for("all values are invalid")
    assert not SampleReply.decode(station.send(sample([1])), 2).valid


def _children(pid: int) -> list[int]:
    return [int(number) for number in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def test_a_battery_reports_its_level_and_a_low_one_does_not_measure(scene: Scene) -> None:
    scene.run("angle", "--battery", "3")
    station = scene.station("angle")
    power = PowerReply.decode(station.send(security_command(Function.POWER)))
    assert power.level == 3
    with pytest.raises(NodeRefusedError) as refused:
        station.operate()
    assert refused.value.reason == 23


def test_values_on_demand_over_nfc_and_a_battery_that_the_field_charges(scene: Scene) -> None:
    keyed_node(scene.folder / "angle", profile=ANGLE)
    path = Links().nfc
    process = Running("--json", "node", "run", scene.folder / "angle", "--nfc", path, "--battery", "50")
    port = NfcPort(path)
    try:
        process.wait_for_lines(1)
        contact = port.find(lambda identity: True, seconds=20, notice=lambda reply: None)
        line = SealedLine(contact.link, contact.identity.uuid)
        line.operate()
        assert SampleReply.decode(line.send(sample([1])), 2).valid
        power = PowerReply.decode(line.send(security_command(Function.POWER)))
        assert power.flags & PowerFlag.CHARGING
        assert power.current is not None
        assert power.current > 0
        with pytest.raises(NodeRefusedError) as refused:
            line.send(StreamPlan.for_channels(0, ((1, 2),), n=1, period=50 * MS).command())
        assert refused.value.reason == 21
        assert line.states().channels[1][1] == 1
    finally:
        port.close()
        process.close()


def test_no_slow_chip_holds_up_a_dead_man(scene: Scene) -> None:
    process = scene.run("gripper", "--crypto-delay", "1500", profile="gripper")
    station, sheet = scene.station("gripper"), scene.sheet("gripper")
    converter = Converter(sheet, sheet.channels[0])
    station.operate(1, dead_man=200)
    station.send(set_values([(1, converter.octets(Reading(value=converter.high)))]))
    done: list[float] = []

    def prove() -> None:
        station.send(security_command(Function.PROVE, bytes(32)))
        done.append(time.time())

    proving = threading.Thread(target=prove, daemon=True)
    proving.start()
    assert wait_for(lambda: [line["safe"] for line in actuator_lines(process)] == [True, False, True])
    proving.join(60)
    safe = datetime.fromisoformat(actuator_lines(process)[-1]["time"]).timestamp()
    assert safe < done[0] - 0.5, "the safe state came while the chip was still at work"


def test_a_slow_chip_answers_no_stranger_while_an_actuator_is_claimed(scene: Scene) -> None:
    scene.run("gripper", "--crypto-delay", "50", profile="gripper")
    station = scene.station("gripper")
    station.operate(1, dead_man=10_000)
    reply = decode_reply(station.link.exchange(security_command(Function.PROVE, bytes(32)).encode()))
    assert (reply.ok, reply.payload) == (False, b"\x11")


def test_an_actuator_is_safe_when_its_node_is_ended(scene: Scene) -> None:
    process = scene.run("gripper", profile="gripper")
    station = scene.station("gripper")
    station.operate(1, dead_man=10_000)
    station.send(set_values([(1, b"\x01\x00")]))
    assert wait_for(lambda: len(actuator_lines(process)) == 2)
    process.signal(signal.SIGTERM)
    ended = process.end()
    assert ended.code == 0
    assert json.loads(ended.out.splitlines()[-1])["safe"]


def test_a_lost_bus_brings_actuators_to_their_safe_state_at_once(scene: Scene) -> None:
    hub = Hub()
    process = scene.run("gripper", profile="gripper", can=hub.spec)
    station = scene.station("gripper", hub.spec)
    station.operate(1, dead_man=10_000)
    station.send(set_values([(1, b"\x01\x00")]))
    assert wait_for(lambda: [line["safe"] for line in actuator_lines(process)] == [True, False])
    lost = time.time()
    hub.close()
    assert wait_for(lambda: [line["safe"] for line in actuator_lines(process)] == [True, False, True])
    safe = datetime.fromisoformat(actuator_lines(process)[-1]["time"]).timestamp()
    assert safe - lost < 5, "and not at its dead-man"


def test_two_stations_share_sensors_and_not_an_actuator(scene: Scene) -> None:
    scene.run("gripper", profile="gripper")
    first, second = scene.station("gripper"), scene.station("gripper", f"{scene.can}&source=0xF2")
    for station in (first, second):
        station.operate()
    first.operate(1, dead_man=10_000)
    with pytest.raises(NodeRefusedError) as refused:
        second.operate(1, dead_man=10_000)
    assert refused.value.reason == 17
    plan = StreamPlan.for_channels(0, ((2, 2),), n=2, period=20 * MS, gap=100)
    receivers = [station.subscribe(plan)[0] for station in (first, second)]
    for station, receiver in zip((first, second), receivers, strict=True):
        assert len(station.hear(receiver, 5)) == 5
        assert (receiver.counts.bad, receiver.counts.junk) == (0, 0)
    assert first.states().channels[2][1] == 0xF2
    first.send(idle())
    second.operate(1, dead_man=10_000)


def test_a_closed_standard_output_does_not_stop_a_node(scene: Scene) -> None:
    keyed_node(scene.folder / "gripper", profile="gripper")
    words = ["--json", "node", "run", str(scene.folder / "gripper"), "--can", scene.can]
    with subprocess.Popen(
        [sys.executable, "-m", "teds_provision", *words], stdout=subprocess.PIPE, cwd=ROOT, env=clean_environment()
    ) as process:
        try:
            assert process.stdout is not None
            assert b"ready" in process.stdout.readline()
            process.stdout.close()
            station = scene.station("gripper")
            station.operate(1, dead_man=1000)
            for raw in (b"\1\0", b"\2\0"):
                station.send(set_values([(1, raw)]))
                time.sleep(0.1)
            assert station.states().channels[1][0] & ChannelState.CLAIMED_HERE
            assert process.poll() is None
        finally:
            process.terminate()


def test_hardware_stays_what_the_node_was_made_with(tmp_path: Path) -> None:
    profile = load_profile(ANGLE)
    path = tmp_path / "angle.csv"
    path.write_text(CALIBRATION)
    uuid = bytes(range(10))
    image = Image(uuid, profile.build(uuid, calibration=load_calibrations(path, profile)).blocks)
    file = tmp_path / "angle.json"
    file.write_text(image.to_json())
    made = keyed_node(tmp_path / "node", teds=file)
    sheet = Sheet.from_image(Image(uuid, made.hardware))
    assert Converter(sheet, sheet.channels[0]).octets(Reading(value=180.0)) == round(16383 / 2).to_bytes(2, "big")


SLOW_SIMULATION = """
import json, sys, time
for line in range(1, 40):
    print(json.dumps({"t": line * 1.0, "raw": {"angle": line}}), flush=True)
    time.sleep(0.15)
"""


def test_between_two_lines_of_a_simulation_every_sample_is_taken_with_the_value_before(
    scene: Scene, tmp_path: Path
) -> None:
    program = tmp_path / "simulation.py"
    program.write_text(SLOW_SIMULATION)
    scene.run("angle", "--source", f"exec:{sys.executable} {program}")
    station = scene.station("angle")
    station.operate(lease=60)
    plan = StreamPlan.for_channels(0, ((1, 2),), n=5, period=100 * MS, gap=100)
    reply = plan.accept(station.send(plan.command()), TickBounds(0, 1 << 63))  # its clock is a simulation's
    receiver = Receiver(plan, reply, station.session.message_key)
    receiver._oldest = 10**12  # a simulation at seven times real time: the age of its messages says nothing
    station.clock = replace(station.clock, reply=replace(station.clock.reply, step=0xFFFFFFFF))
    messages = station.hear(receiver, 8)  # some may be left out on a busy machine; what comes is right
    counters = [message.counter for message in messages]
    assert counters == sorted(set(counters))
    for message in messages:
        for instant in range(5):
            tick = message.tick + instant * 100 * MS
            value = int.from_bytes(message.data[2 * instant : 2 * instant + 2], "big")
            assert value == tick // 1_000_000_000, (tick, value)
