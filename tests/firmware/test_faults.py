"""``node check`` finds each faulty node in C by the rule that finds the one in Python, with the same words."""

from __future__ import annotations

import dataclasses
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.repetition import Repetition
from teds_provision.station.station import Station
from tests.bench import make_station
from tests.check import nodes
from tests.check.faults import FAULTS
from tests.firmware import builds
from tests.firmware.faults import CHANGES
from tests.firmware.memory_node import MemoryNode

pytestmark = pytest.mark.system

MAX_MESSAGE, STAGING = 2048, 16388


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    """A station in this process."""
    made = make_station(tmp_path / "station")
    yield made
    made.close()


def built(folder: Path, name: str) -> Path:
    """The library with this fault; "" is the good one."""
    if not name:
        return builds.library(MAX_MESSAGE, STAGING)
    objects, words = builds.objects(MAX_MESSAGE, STAGING)
    change = CHANGES[name]
    text = (builds.FIRMWARE / "src" / change.file).read_text(encoding="utf-8")
    source, changed, library = folder / change.file, folder / "changed.o", folder / "faulty.so"
    source.write_text(change.made(text), encoding="utf-8")
    subprocess.run(["gcc", *words, "-w", "-c", str(source), "-o", str(changed)], check=True, cwd=builds.FIRMWARE)
    others = [str(path) for path in objects if path.stem != source.stem]
    subprocess.run(["gcc", "-shared", str(changed), *others, "-o", str(library), "-lbearssl"], check=True)
    return library


class Answering(MemoryNode):
    """Every reply of it is taken at once."""

    def handle(self, frame: bytes, *, link: str, **more: Any) -> bytes:
        reply = super().handle(frame, link=link, **more)
        self.reply_left(link)
        return reply

    @property
    def flash(self) -> Identity:
        """Of which a bus asks the address alone."""
        return self.identity()


class Board(nodes.Measuring):
    """A factory node in C on the desk of ``node check``."""

    library: Path
    measures = False

    def power_on(self) -> None:
        super().power_on()
        node = Answering(
            self._draw, lambda: self.seconds, uuid=self.uuid, max_message=2048, max_teds=16384, library=self.library
        )
        if self.measures:
            for number, facts in self.hardware.channels.items():
                node.add_channel(number, int(facts.kind), facts.octets)
        assert node.start() == 0
        node.put(dataclasses.replace(self.state, can_address=node.can_address))
        self.tim, self.repetition = node, Repetition()  # type: ignore[assignment]

    def _draw(self, kind: str, size: int) -> bytes:
        return self.key.secret() if kind == "i" else b"\x01" + os.urandom(size - 1) if kind == "o" else os.urandom(size)


def check(folder: Path, station: Station, patch: pytest.MonkeyPatch, name: str) -> nodes.Report:
    patch.setattr(Board, "library", built(folder, name), raising=False)
    patch.setattr(nodes, "Measuring", Board)
    patch.setattr(nodes, "Board", Board)
    over = FAULTS[name].over if name else "nfc"
    patch.setattr(Board, "measures", over == "measuring")
    return nodes.checked(station, patch, nodes.made(over), over=over)


def test_a_good_node_keeps_every_rule(tmp_path: Path, station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    assert nodes.failed(check(tmp_path, station, monkeypatch, "")) == {}


def of_the_gate() -> Iterator[Any]:
    """Each fault; beyond the first of a rule they are left to ``make firmware``."""
    rules = set()
    for name in CHANGES:
        rule = FAULTS[name].rule
        yield pytest.param(name, marks=[pytest.mark.soak] if rule in rules else [])
        rules.add(rule)


@pytest.mark.parametrize("name", list(of_the_gate()))
def test_a_faulty_node_in_c_is_found_by_its_rule(
    tmp_path: Path, station: Station, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    found = nodes.failed(check(tmp_path, station, monkeypatch, name))
    assert FAULTS[name].rule in found, found
    assert FAULTS[name].words in found[FAULTS[name].rule].detail
    assert found[FAULTS[name].rule].slip == FAULTS[name].slip
