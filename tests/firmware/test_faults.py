"""``node check`` finds each faulty node in C by the rule that finds the one in Python, with the same words.

One whose fault lies in its lines is a process on a bus, all others are asked frame by frame.
"""

from __future__ import annotations

import dataclasses
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from teds_provision.check.run import CheckReport
from teds_provision.links.ports import BusFrame, BusFrames
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.repetition import Repetition
from teds_provision.station.station import Station
from tests.bench import copied_station
from tests.check import nodes
from tests.check.faults import FAULTS
from tests.check.faulty import FaultyBus
from tests.e2e.desk import Desk
from tests.firmware import builds
from tests.firmware.conftest import CNode
from tests.firmware.faults import CHANGES, ON_THE_BUS, SEEN_BY_A_STATION, Change
from tests.firmware.memory_node import MemoryNode

pytestmark = pytest.mark.system

MAX_MESSAGE, STAGING = 2048, 16388


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    """Yield a station in this process."""
    made = copied_station(tmp_path / "station")
    yield made
    made.close()


def faulty_source(folder: Path, change: Change) -> Path:
    """Return the changed file."""
    source = folder / change.file
    source.write_text(
        change.made((builds.FIRMWARE / "src" / change.file).read_text(encoding="utf-8")), encoding="utf-8"
    )
    return source


def built(folder: Path, name: str) -> Path:
    """The library with this fault; "" is the good one."""
    if not name:
        return builds.library(MAX_MESSAGE, STAGING)
    objects, words = builds.objects(MAX_MESSAGE, STAGING)
    source, changed, library = faulty_source(folder, ALL[name]), folder / "changed.o", folder / "faulty.so"
    subprocess.run(["gcc", *words, "-w", "-c", str(source), "-o", str(changed)], check=True, cwd=builds.FIRMWARE)
    others = [str(path) for path in objects if path.stem != source.stem]
    subprocess.run(["gcc", "-shared", str(changed), *others, "-o", str(library), "-lbearssl"], check=True)
    return library


class AnsweringNode(MemoryNode):
    """Every reply of it is taken at once."""

    def handle(self, frame: bytes, *, link: str, **more: Any) -> bytes:
        reply = super().handle(frame, link=link, **more)
        self.reply_sent(link)
        return reply

    @property
    def flash(self) -> Identity:
        """Of which a bus asks the address alone."""
        return self.identity()


class Frames:
    """The node's end of CAN, frame by frame; see ``links.ports.BusFrames``. Waits pass at once."""

    fd = False

    def __init__(self, board: Board, bus: FaultyBus) -> None:
        self._board, self.own = board, bus.source

    @property
    def _node(self) -> MemoryNode:
        node = self._board.tim
        assert isinstance(node, MemoryNode)
        return node

    def send(self, identifier: int, octets: bytes, *, fd: bool = False) -> None:
        self._node.take_frame(identifier, octets, fd=fd)

    def next(self, seconds: float) -> BusFrame | None:
        board, until = self._board, self._board.seconds + seconds
        while True:
            due = self._node.poll() / 10**9
            if (frame := self._node.next_frame()) is not None:
                return BusFrame(frame[0], frame[1], board.seconds)
            if due >= until:
                board.seconds = max(board.seconds, until)
                return None
            board.seconds = max(due, board.seconds + 1e-6)


class Board(nodes.MeasuringBoard):
    """A factory node in C on the desk of ``node check``."""

    library: Path
    measures = False

    def power_on(self) -> None:
        super().power_on()
        node = AnsweringNode(
            self._draw, lambda: self.seconds, uuid=self.uuid, max_message=2048, max_teds=16384, library=self.library
        )
        node.room = 2049  # FAULT_LIST_LONG
        node.has_firmware(lambda what, _argument, _octets: nodes.FIRMWARE.encode()[1:] if what == "a" else b"")
        if self.measures:
            self._channels(node)
        assert node.start() == 0
        node.put(dataclasses.replace(self.state, can_address=node.can_address))
        if self.state.read_only:  # which the firmware brings at its start
            assert node.start() == 0
        self.tim, self.repetition = node, Repetition()  # type: ignore[assignment]

    def _channels(self, node: AnsweringNode) -> None:
        for number, facts in self.hardware.channels.items():
            node.add_channel(number, int(facts.kind), facts.octets)
            node.halts(number, facts.halt or 0)

    def frames_of(self, bus: FaultyBus) -> BusFrames:
        """Its end of the bus, which is C as well."""
        return Frames(self, bus)

    def _draw(self, kind: str, size: int) -> bytes:
        return self.key.secret() if kind == "i" else b"\x01" + os.urandom(size - 1) if kind == "o" else os.urandom(size)


def check(folder: Path, station: Station, patch: pytest.MonkeyPatch, name: str, over: str = "nfc") -> CheckReport:
    patch.setattr(Board, "library", built(folder, name), raising=False)
    patch.setattr(nodes, "MeasuringBoard", Board)
    patch.setattr(nodes, "Board", Board)
    over = FAULTS[name].over if name else over
    patch.setattr(Board, "measures", over.startswith("measuring"))
    return nodes.checked(station, patch, nodes.made(over), over=over)


@pytest.mark.parametrize("over", ["nfc", "measuring can"])
def test_a_good_node_keeps_every_rule(
    tmp_path: Path, station: Station, monkeypatch: pytest.MonkeyPatch, over: str
) -> None:
    report = check(tmp_path, station, monkeypatch, "", over)
    assert nodes.failed(report) == {}
    if over != "nfc":
        heard = {"can-flow-control", "can-form", "nfc-wait-time", "nfc-wtx"}
        assert nodes.names(report, "skipped") == {"confirm-elsewhere", "write-read-only", *heard}


SAMPLE: Final = {"FAULT_OLDER_EPOCH", "FAULT_ANY_TARGET", "FAULT_DRIVE_TWICE"}
"""Of those that a station sees only if it looks for them, the gate has these: each is found in Python there as well."""
ALL: Final = {**CHANGES, **SEEN_BY_A_STATION}


AT_NIGHT = pytest.mark.nightly(
    "tests/check/test_faults.py::test_a_faulty_node_is_found_by_its_rule has its sister in Python"
)


def of_the_gate() -> Iterator[Any]:
    """Yield each fault; but for each twelfth, and for the sample, they are left to the night and to ``make firmware``.

    ``tests/check/test_faults.py`` holds each rule at the gate, against the faulty nodes in Python.
    """
    for number, name in enumerate(CHANGES):
        marks = [pytest.mark.soak] if number % 6 else [AT_NIGHT] if number % 12 else []
        yield pytest.param(name, marks=marks)
    for name in SEEN_BY_A_STATION:
        yield pytest.param(name, marks=[] if name in SAMPLE else [pytest.mark.soak])


@pytest.mark.parametrize("name", list(of_the_gate()))
def test_a_faulty_node_in_c_is_found_by_its_rule(
    tmp_path: Path, station: Station, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    found = nodes.failed(check(tmp_path, station, monkeypatch, name))
    assert FAULTS[name].rule in found, found
    assert FAULTS[name].words in found[FAULTS[name].rule].detail
    assert found[FAULTS[name].rule].slip == FAULTS[name].slip


@pytest.mark.soak
@pytest.mark.parametrize("name", ON_THE_BUS)
def test_a_faulty_node_in_c_is_found_over_its_bus(desk: Desk, node: CNode, name: str) -> None:
    node.program = desk.folder / "faulty-node"
    source = faulty_source(desk.folder, ON_THE_BUS[name])
    builds.compile_host(node.program, source)
    node.start()
    outcome = desk.station().run("--json", "node", "check", "--factory", "--yes", *desk.links.over("can"))
    found = {check["rule"]: check for check in outcome.json["checks"] if check["result"] == "failed"}
    assert FAULTS[name].rule in found, outcome
    assert FAULTS[name].words in found[FAULTS[name].rule]["detail"]
    assert found[FAULTS[name].rule]["slip"] == FAULTS[name].slip


def test_every_change_finds_its_place() -> None:
    """Two of those that are tried outside the gate had lost it."""
    for change in (*ALL.values(), *ON_THE_BUS.values()):
        change.made((builds.FIRMWARE / "src" / change.file).read_text(encoding="utf-8"))


def test_every_faulty_node_of_the_reference_has_a_sister() -> None:
    assert set(ALL) | set(ON_THE_BUS) == set(FAULTS)
    assert not set(ALL) & set(ON_THE_BUS)
