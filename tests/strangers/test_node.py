"""A stranger's node under the product's commands: `verify`, `sample`, `set`, `mode`, `measure`; good and faulty."""

from __future__ import annotations

import itertools
import json
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from teds_provision.node.flash_file import FlashFile
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import ChannelKind, Sheet
from tests.e2e.desk import ANGLE, Running
from tests.measure.rig import Rig, events, of, ran
from tests.pace import succeeds, until
from tests.strangers.wire import of_spec

pytestmark = pytest.mark.link
KINDS = {ChannelKind.SENSOR: "sensor", ChannelKind.EVENT_SENSOR: "event sensor", ChannelKind.ACTUATOR: "actuator"}


@dataclass
class StrangerNode:
    """A node of the rig, played by a stranger's firmware."""

    rig: Rig
    name: str
    fd: bool
    address: int
    process: Running | None = None

    @property
    def can(self) -> str:
        return self.rig.can if self.fd else self.rig.desk.links.can

    @property
    def uuid(self) -> str:
        return self.rig.nodes[self.name].uuid

    def plan(self, fault: str = "", **more: Any) -> Path:
        """Return the file that says who it is and what is wrong with it."""
        file = FlashFile(self.rig.folder / self.name)
        flash, document = file.load(), json.loads(file.path.read_text())
        file.release()
        sheet = Sheet.from_image(Image(flash.uuid, dict(flash.blocks)))
        channels = {
            channel.number: {
                "kind": KINDS[ChannelKind(channel.kind)],
                "octets": channel.sample.octets,
                "shortest": int(channel.period * 1e9 * (1 - 1e-6)) if channel.period > 0 else 1,
                "bears": [0, 4095],
            }
            for channel in sheet.channels
            if channel.kind is not None and channel.sample is not None
        }
        group, port = of_spec(self.rig.desk.links.can)
        given = {
            "bus": {"group": group, "port": port, "fd": self.fd, "address": self.address},
            "uuid": flash.uuid.hex(), "key": flash.key.hex() if flash.key else "", "epoch": flash.epoch,
            "sequence": flash.sequence, "identity": document["key"], "channels": channels, "fault": fault,
            "teds": {f"{channel},{code}": octets.hex() for (channel, code), octets in flash.blocks.items()}, **more,
        }  # fmt: skip
        plan = self.rig.folder / f"{self.name}.json"
        plan.write_text(json.dumps(given))
        return plan

    def start(self, fault: str = "", *, program: str = "tests.strangers.node", **more: Any) -> StrangerNode:
        self.process = self.rig.desk.start(self.plan(fault, **more), program=(sys.executable, "-m", program))
        self.process.wait_for('"ready": true')
        return self

    def end(self) -> None:
        if self.process is not None:
            self.process.process.kill()
            self.process.end()
            self.process = None

    def states(self) -> list[dict[str, Any]]:
        assert self.process is not None
        self.process.read(0.1)
        return [line for line in events(self.process.out) if "safe" in line]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("strangers"), {"a": ANGLE, "g": "gripper"})
    yield made
    made.close()


@contextmanager
def played(rig: Rig, name: str, address: int, *, fd: bool) -> Iterator[StrangerNode]:
    made = StrangerNode(rig, name, fd, address)
    try:
        yield made
    finally:
        made.end()


CLASSIC = pytest.mark.nightly(
    "tests/strangers/test_node.py::test_it_is_verified_sampled_and_measured[fd]; on a classic bus: "
    "tests/strangers/test_station.py::test_streams_come_whole_in_time_and_end"
)


@pytest.fixture(params=[pytest.param(False, marks=CLASSIC), True], ids=["classic", "fd"])
def angle(rig: Rig, request: pytest.FixtureRequest) -> Iterator[StrangerNode]:
    with played(rig, "a", 0x31, fd=request.param) as made:
        yield made


@pytest.fixture
def fd_angle(rig: Rig) -> Iterator[StrangerNode]:
    with played(rig, "a", 0x31, fd=True) as made:
        yield made


@pytest.fixture
def classic_angle(rig: Rig) -> Iterator[StrangerNode]:
    with played(rig, "a", 0x31, fd=False) as made:
        yield made


@pytest.fixture
def gripper(rig: Rig) -> Iterator[StrangerNode]:
    with played(rig, "g", 0x32, fd=True) as made:
        yield made


def steps(line: dict[str, Any]) -> set[int]:
    raw = line["raw"]
    return {(after - before) % 65536 for before, after in itertools.pairwise(raw)}


def measured(node: StrangerNode, *words: object, code: int = 0) -> list[dict[str, Any]]:
    return node.rig.measure(node.uuid, *words, can=node.can, code=code)


@pytest.mark.realtime  # the bound of the clock is what the best exchange took
def test_it_is_verified_sampled_and_measured(angle: StrangerNode) -> None:
    angle.start()
    station = angle.rig.station
    assert station.ask("verify", angle.uuid, "--via", "can", "--can", angle.can)["verdict"] == "authentic"
    assert station.ask("mode", angle.uuid, "--can", angle.can)["mode"] == "configuration"
    [taken] = station.ask("sample", angle.uuid, "--can", angle.can)["samples"]
    assert taken["valid"] is True
    lines = measured(angle, "--rate", 50, "--duration", 2)
    data = of(lines)
    [stream] = lines[-1]["nodes"][0]["streams"]
    assert ran(lines) == ["running", "ended"]
    assert stream["bad"] == 0, stream
    assert stream["samples"] + stream["lost"] + stream["late"] >= 80
    # The firmware's sample is the millisecond of its tick: 20 between two instants, whatever its clock.
    assert {step for line in data for step in steps(line)} <= {20}
    for line in data:
        for raw, value in zip(line["raw"], line["value"], strict=True):
            assert value == pytest.approx(raw / 65535 * 6.2814, abs=2e-3)
    assert stream["clock_error"] < 0.1
    assert station.ask("mode", angle.uuid, "--can", angle.can)["mode"] == "configuration"


@pytest.mark.parametrize("words", [["--kind", "free"], ["--trigger"], ["--test-pattern"]], ids=lambda words: words[-1])
def test_other_kinds_of_streams(fd_angle: StrangerNode, words: list[str]) -> None:
    fd_angle.start()
    lines = measured(fd_angle, "--rate", 50, "--duration", 1, *words)
    [stream] = lines[-1]["nodes"][0]["streams"]
    assert stream["bad"] == 0, lines[-1]
    assert {step for line in of(lines) for step in steps(line)} <= ({1} if "--test-pattern" in words else {20})


def test_a_stranger_among_our_own(fd_angle: StrangerNode, gripper: StrangerNode) -> None:
    """Two strangers' nodes and two of our stations on one bus: none disturbs another."""
    fd_angle.start()
    gripper.start()
    other = fd_angle.rig.copy("twin")

    def disturbed() -> list[object]:
        """Return what was lost or late; a machine that is busy costs that, once."""
        first = fd_angle.rig.begin(fd_angle.uuid, gripper.uuid, "--rate", 40, "--trigger")
        first.wait_for('"event":"data"')
        second = fd_angle.rig.begin(fd_angle.uuid, "--rate", 25, can=f"{fd_angle.can}&source=0xF3", station=other)
        second.wait_for('"index":20')
        found: list[object] = []
        for running in (second, first):
            running.signal(signal.SIGTERM)
            lines = events(running.end().out)
            found += [state for state in ran(lines) if state == "lost"]
            streams = [stream for node in lines[-1]["nodes"] for stream in node["streams"]]
            assert all(stream["bad"] == 0 and stream["samples"] > 0 for stream in streams), streams
            found += [stream for stream in streams if stream["late"] > 0.1 * stream["messages"]]
        return found

    succeeds(4, disturbed, because="two measurements of a node that takes turns with them")


def test_a_strangers_actuator_is_set_and_left_safe(gripper: StrangerNode) -> None:
    gripper.start()
    station = gripper.rig.station

    def let_go_too_soon() -> bool:
        """Return True if it was not fed for twice its dead-man: by a command that the machine did not run, once."""
        acting = station.start("--json", "set", gripper.uuid, 1, 0.05, "--dead-man", 500, "--can", gripper.can)
        acting.wait_for('"applied"')
        time.sleep(1.0)
        safe = bool(gripper.states()[-1]["safe"])
        state = station.ask("mode", gripper.uuid, "--can", f"{gripper.can}&source=0xF5")["channels"][0]
        acting.signal(signal.SIGTERM)
        ended = acting.end().out.splitlines()[-1]
        return safe or (state["claimant"], ended) != (0xF1, '{"event": "end", "safe": true}')

    succeeds(5, let_go_too_soon, because="a command that is not run for half a second lets go, as it must")
    acting = station.start("--json", "set", gripper.uuid, 1, 0.05, "--dead-man", 500, "--can", gripper.can)
    acting.wait_for('"applied"')
    acting.process.kill()
    until(lambda: gripper.states()[-1]["safe"])
    station.ask("set", gripper.uuid, 1, 99, "--can", gripper.can, code=6)


def test_a_node_that_is_reset_in_the_middle_is_measured_on(fd_angle: StrangerNode) -> None:
    fd_angle.start()
    running = fd_angle.rig.begin(fd_angle.uuid, "--rate", 50)
    running.wait_for('"index":20')
    fd_angle.end()
    fd_angle.start()
    until(lambda: (running.read(0.1), running.out.count('"state":"running"') > 1)[1])
    running.read(0.5)
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 0
    assert {step for line in of(events(outcome.out)) for step in steps(line)} <= {20}


FAULTS = {
    "wrong tag": lambda end: end["bad"] > 0,
    "replay": lambda end: end["late"] > 0,
    "a segment is missing": lambda end: end["lost"] > 0,
    "from the future": lambda end: end["bad"] > 0,  # those that were late enough have become true meanwhile
    "reserved flags": lambda end: end["bad"] == 0 and end["samples"] > 0,
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_counted_and_no_value_is_false(classic_angle: StrangerNode, fault: str) -> None:
    """Classic frames, four a message, so that segments can be missing."""
    node = classic_angle.start(fault)
    running = node.rig.begin(node.uuid, "--rate", 400, "--duration", 2, can=node.can)
    outcome = running.end()
    lines = events(outcome.out)
    assert {step for line in of(lines) for step in steps(line)} <= {2, 3}, "2.5 ms between two instants"
    indices = [line["index"] for line in of(lines)]
    assert indices == sorted(set(indices))
    [stream] = lines[-1]["nodes"][0]["streams"]
    assert FAULTS[fault](stream), (stream, outcome.err)


def test_what_a_slow_node_sends_from_the_future_is_bad_too(classic_angle: StrangerNode) -> None:
    """It sent one message a turn: on a busy machine turns took longer than messages, and all of them had come true."""
    node = classic_angle.start("from the future", pause=0.05)
    outcome = node.rig.begin(node.uuid, "--rate", 400, "--duration", 2, can=node.can).end()
    [stream] = events(outcome.out)[-1]["nodes"][0]["streams"]
    assert stream["bad"] > stream["messages"], (stream, outcome.err)


@pytest.mark.parametrize("fault", ["clock runs back", "clock at the end of time"])
def test_no_sample_has_the_time_of_a_clock_that_lies(fd_angle: StrangerNode, fault: str) -> None:
    """`sample` gave the hour at which the node had started, or ended with a bug."""
    fd_angle.start(fault, program="tests.strangers.liar")
    before = time.time()
    [taken] = fd_angle.rig.station.ask("sample", fd_angle.uuid, "--can", fd_angle.can)["samples"]
    assert before - 1 < taken["time"] < time.time() + 1


@pytest.mark.parametrize("lie", ["counter far ahead", "ticks at the end of time", "every message twice"])
def test_a_node_that_lies_about_its_messages_gives_no_value_twice_or_at_a_false_time(
    fd_angle: StrangerNode, lie: str
) -> None:
    fd_angle.start(lie, program="tests.strangers.liar")
    before = time.time()
    data = of(measured(fd_angle, "--rate", 50, "--duration", 1, "--kind", "free"))
    assert bool(data) != (lie == "ticks at the end of time")
    indices, times = [line["index"] for line in data], [at for line in data for at in line["time"]]
    assert indices == sorted(set(indices))
    assert times == sorted(times)
    assert all(before - 5 < at < time.time() + 1 for at in times)


@pytest.mark.parametrize("fault", ["another length", "another start", "clock runs back"])
def test_a_node_that_contradicts_itself_is_reported(fd_angle: StrangerNode, fault: str) -> None:
    fd_angle.start(fault)
    lines = measured(fd_angle, "--rate", 50, "--duration", 1, code=0 if fault == "clock runs back" else 4)
    whys = [line["why"] for line in lines if line["event"] == "status" and line["why"]]
    assert whys, lines
    if fault == "clock runs back":
        assert any("clock" in why for why in whys)
    else:
        assert of(lines) == []
    # What it was asked for is ended, and not left to go on until the lease does.
    asked = fd_angle.rig.station.ask("mode", fd_angle.uuid, "--can", f"{fd_angle.can}&source=0xF5")
    assert asked["mode"] == "configuration"


def test_a_node_that_is_busy_for_ever_is_reported_and_delays_no_other(
    fd_angle: StrangerNode, gripper: StrangerNode
) -> None:
    fd_angle.start("busy for ever", program="tests.strangers.liar")
    gripper.start()
    rig = fd_angle.rig
    lines = events(rig.begin(fd_angle.uuid, gripper.uuid, "--rate", 20, "--duration", 1).end().out)
    assert ran([line for line in lines if line.get("uuid") == gripper.uuid]) == ["running", "ended"]
    whys = [line["why"] for line in lines if line["event"] == "status" and line["uuid"] == fd_angle.uuid]
    assert any("it is busy" in why and "again in 1 s, giving up in" in why for why in whys), whys
    # Its datasheet is read all the same, without proof.
    words = ["verify", fd_angle.uuid, "--via", "can", "--can", fd_angle.can]
    verified = rig.station.ask(*words, code=5)
    assert verified["verdict"] == "unproven"
    assert "it is busy" in next(check["why"] for check in verified["checks"] if check["name"] == "session")
    # Where it is alone, it is given up at the end of --timeout, and no later than a last try takes.
    lines = measured(fd_angle, "--timeout", 3, code=6)
    assert [line["state"] for line in lines if line["event"] == "status"][-1] == "refused"
