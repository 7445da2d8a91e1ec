"""A test rig: a station and nodes that it has provisioned, made in this process in a moment; each runs as a process."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from teds_provision.node.node_template import create
from teds_provision.node.virtual import VirtualNode
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry, utc_now
from tests.bench import make_station, on_reader
from tests.e2e.desk import ANGLE, Desk, Running
from tests.e2e.desk import Station as Commands

CALIBRATIONS = {
    ANGLE: "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n",
    "gripper": "# date: 2026-10-01\nraw,value,channel\n0,0,1\n4095,110,1\n0,0,2\n4095,110,2\n0,0,3\n4095,140,3\n",
}
FAULTY = (sys.executable, "-m", "tests.measure.faulty_node")


def provisioned(station: Station, folder: Path, type_: str, name: str, uuid: bytes | None = None) -> str:
    """Make a node of this type, and provision it; its UUID. ``keyed:TYPE`` gets a key, and no datasheet is signed."""
    keyed, type_ = type_.startswith("keyed:"), type_.removeprefix("keyed:")
    create(folder, uuid=uuid, name=name, profile=type_)
    node = VirtualNode(folder)
    calibration = folder / "calibration.csv"
    calibration.write_text(CALIBRATIONS[type_])
    order = BuildOrder(type_, calibration=calibration, name=name)
    with Conversation(on_reader(node), notice=lambda _notice: None) as talk:
        if keyed:
            who = identify(station, talk)
            agree(station, talk, who, newcomer=WhitelistEntry(talk.uuid, who.fingerprint, utc_now(), "tap", name))
            return talk.uuid.hex()
        done = provision(station, talk, order, operator=AcceptingOperator(), reporter=SilentReporter())
    assert done.verified.verdict == "authentic"
    return node.tim.flash.uuid.hex()


@dataclass
class RigNode:
    """A node of the rig; ``process`` while it runs."""

    rig: Rig
    folder: Path
    uuid: str
    process: Running | None = None
    bus: str = ""

    def start(self, *words: object, can: str = "", fault: str = "") -> RigNode:
        """Power on: the product's node, or one with a fault."""
        bus = self.bus = can or self.bus or self.rig.can
        program: tuple[str, ...]
        given: list[object]
        if fault:
            program, given = FAULTY, [fault, bus, self.folder, *words]
        else:
            program, given = (), ["--json", "node", "run", self.folder, "--can", bus, "--source", "ramp:2", *words]
        self.process = self.rig.desk.start(*given, **({"program": program} if program else {}))
        self.process.wait_for('"ready": true')
        return self

    @property
    def runs(self) -> bool:
        """Whether it is powered."""
        return self.process is not None and self.process.runs

    def kill(self) -> None:
        """Cut its power."""
        assert self.process is not None
        self.process.process.kill()
        self.process.end()

    def sees(self, text: str, seconds: float = 20.0) -> None:
        """Wait until it has said this."""
        assert self.process is not None
        self.process.wait_for(text, seconds)


@dataclass
class Rig:
    """A station and its nodes on one bus; commands are processes."""

    folder: Path
    types: dict[str, str] = field(default_factory=lambda: {"a": ANGLE, "g": "gripper"})
    nodes: dict[str, RigNode] = field(default_factory=dict, init=False)

    def __post_init__(self) -> None:
        prepared = self.folder / "stations"
        prepared.mkdir(parents=True)
        self.desk = Desk(self.folder, prepared)
        self.can = f"{self.desk.links.can}&fd=1"
        with_keys = make_station(prepared / "bench", "bench")
        try:
            for name, type_ in self.types.items():
                uuid = provisioned(with_keys, self.folder / name, type_, name, self.desk.new_uuid())
                self.nodes[name] = RigNode(self, self.folder / name, uuid)
        finally:
            with_keys.close()
        self.station: Commands = self.desk.station()

    def close(self) -> None:
        """End all that runs."""
        self.desk.clear()

    @contextmanager
    def visited(self) -> Iterator[None]:
        """One test in a rig that several share, however it ends: what it began ends, who was powered is so again."""
        powered = [node for node in self.nodes.values() if node.runs]
        there = list(self.desk.running)
        try:
            yield
        finally:
            self.desk.clear(but=[*there, *(node.process for node in powered if node.runs)])
            for node in powered:
                if not node.runs:
                    node.start()  # on the bus that it was on

    def copy(self, name: str) -> Commands:
        """Return a second home with the same keys, as they are now: another machine that holds a copy."""
        shutil.copytree(self.station.home, self.folder / name, ignore=shutil.ignore_patterns("measuring", "*.sock"))
        return Commands(self.desk, self.folder / name)

    def begin(self, *words: object, can: str = "", station: Commands | None = None, **more: Any) -> Running:
        """Begin to measure."""
        return (station or self.station).start("--json", "measure", *words, "--can", can or self.can, **more)

    def measure(self, *words: object, code: int = 0, **more: Any) -> list[dict[str, Any]]:
        """Measure to the end; the events."""
        outcome = self.begin(*words, **more).end()
        assert outcome.code == code, outcome
        return events(outcome.out)

    def address(self, name: str) -> int:
        """Return where a node is on the bus now: a stranger may have moved it."""
        reply = self.ask("identify", "--via", "can")
        return int(next(node["can_address"] for node in reply["nodes"] if node["uuid"] == self.nodes[name].uuid))

    def ask(self, *words: object, code: int = 0) -> Any:
        """Another command on the bus, to its end."""
        return self.station.ask(*words, "--can", self.can, code=code)


def events(text: str) -> list[dict[str, Any]]:
    """Return the whole lines of JSON."""
    return [json.loads(line) for line in text.splitlines(keepends=True) if line.endswith("\n")]


def of(lines: list[dict[str, Any]], uuid: str = "", channel: int = 1) -> list[dict[str, Any]]:
    """Data lines of a channel."""
    data = [line for line in lines if line["event"] == "data" and line["channel"] == channel]
    return [line for line in data if not uuid or line["uuid"] == uuid]


def ran(lines: list[dict[str, Any]]) -> list[str]:
    """Return the states without those of waiting, which nobody sees of a node that runs at once."""
    return [state for state in states(lines) if state != "waiting"]


def states(lines: list[dict[str, Any]]) -> list[str]:
    """States in the order in which they came."""
    return [line["state"] for line in lines if line["event"] == "status" and "uuid" in line]


def crowd(can: str, folders: list[Path], desk: Desk) -> Running:
    """Many nodes in one process."""
    process = desk.start("--json", "node", "run", *folders, "--can", can, "--source", "ramp:2")
    process.wait_for('"ready": true')
    return process


def killed(process: Running) -> None:
    """kill -9."""
    process.process.kill()
    process.end()
