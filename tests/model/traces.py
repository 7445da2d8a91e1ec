"""Traces of the model (model/keys_life.pml): which steps it takes, and the state that each of them leaves.

SPIN makes a program of the model, which prints every sequence of steps up to a depth, or follows a script as far as the
model lets it. A step is ``number.station.aim``; the aim is the receiver of a handover, the bundle that is taken in or
closed, or 0 for a Request whose reply is lost.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Final

MODEL: Final = Path(__file__).parents[2] / "model" / "keys_life.pml"
NONE: Final = 7
"""What the model has for no bundle."""


class Kind(IntEnum):
    """The steps of the model, as it numbers them."""

    CUT = 0
    REQUEST = 1
    STORE = 2
    SEND_CONFIRM = 3
    END_CONFIRM = 4
    OPEN = 5
    FORGET = 6
    MOVE = 7
    FILE = 8
    FILE_AGAIN = 9
    UNDO = 10
    COPY = 11
    IMPORT = 12
    RECEIPT = 13
    BACKUP = 14
    RESTORE = 15
    RESET = 16
    PROOF = 17
    CONFIRM = 18
    LOST_RAM = 19
    SESSION = 20
    END_SESSION = 21
    SIGN = 22
    COMMIT = 23


@dataclass(frozen=True)
class Step:
    """One step of the model."""

    kind: Kind
    station: int = 0
    aim: int = 0

    def __str__(self) -> str:
        return f"{self.kind.name.lower().replace('_', '-')} {self.station}{f' -> {self.aim}' if self.aim else ''}"

    @property
    def script(self) -> str:
        """The step as a script names it."""
        return f"{int(self.kind)}.{self.station}.{self.aim}"


@dataclass(frozen=True)
class StationState:
    """What the model says of one station.

    ``signed`` is the sequence of the datasheet that it has signed and not committed yet, ``session`` the key of its
    open session; 0 for none.
    """

    present: int
    held: frozenset[int]
    tombstone: int
    due: bool
    shared: bool
    idle: bool
    signed: int
    session: int


@dataclass(frozen=True)
class State:
    """What the model says after a step. ``opens`` and ``takes``: what would succeed now, for stations that are idle."""

    node: int
    epoch: int
    sequence: int
    ram: int
    stations: tuple[StationState, ...]
    opens: frozenset[int]
    takes: frozenset[tuple[int, int]]


@dataclass(frozen=True)
class Trace:
    """A sequence of steps (None: the model refused this one of the script) and the state after each of them."""

    steps: tuple[Step | None, ...]
    states: tuple[State, ...]


KEYED: Final = (
    Step(Kind.REQUEST, 0, 1),
    Step(Kind.STORE),
    Step(Kind.SEND_CONFIRM),
    Step(Kind.CONFIRM),
    Step(Kind.END_CONFIRM),
    Step(Kind.OPEN),
)
"""The first station's first key: where most sequences begin."""


class Program:
    """The model, compiled with some bounds and, maybe, without some rules."""

    def __init__(self, folder: Path, *broken: str, agreements: int = 2, bundles: int = 2, **bounds: int) -> None:
        """``bounds`` say how much may happen, and with ``sessions_too=1`` that sessions are a part of it."""
        self._folder = folder
        wanted = {"commits": 0, "restores": 0, "resets": 1} | bounds | {"agreements": agreements, "bundles": bundles}
        defines = [f"-D{name.upper()}={value}" for name, value in wanted.items()]
        defines += [f"-DBREAK_{rule}" for rule in broken]
        folder.mkdir(parents=True, exist_ok=True)
        shutil.copy(MODEL, folder)  # else the trail that is written is not the one that is looked for
        _call(["spin", "-a", "-DTRACED", *defines, MODEL.name], folder)
        _call(["cc", "-O0", "-w", "-DSAFETY", "-DHC4", "-o", "pan", "pan.c"], folder)

    def every(self, depth: int, begin: Iterable[Step] = ()) -> list[Trace]:
        """Return every sequence that leads to another state, or there by another step; up to ``depth`` steps."""
        output = self._run(["-m10000", "-w18"], depth, begin)
        states = dict(map(_read, _lines(output)))
        inner = {steps[:-1] for steps in states}
        return [_trace(steps, states) for steps in states if steps not in inner]

    def follow(self, script: Iterable[Step]) -> Trace:
        """Return what the model makes of a script; a step that it does not permit changes nothing."""
        output = self._run(["-m10000", "-w18"], 0, script)
        states = dict(map(_read, _lines(output)))
        return _trace(max(states, key=len), states)

    def counterexample(self) -> tuple[Step, ...]:
        """Return the steps by which a broken rule leads to a violation, not many more than needed; empty for none."""
        for depth in (8, 12, 16, 20, 26):
            if "errors: 0" not in self._run(["-m10000", "-w22"], depth, ()):
                break
        else:
            return ()
        output = self._run(["-r", "-S"], depth, ())
        steps: list[Step] = []
        for word, text in re.findall(r"^(DID|AIM) (\S+)$", output, re.MULTILINE):
            if word == "DID":
                number, station = text.split(".")
                steps.append(Step(Kind(int(number)), int(station)))
            else:
                steps[-1] = Step(steps[-1].kind, steps[-1].station, int(text))
        return tuple(steps)

    def _run(self, options: list[str], depth: int, script: Iterable[Step]) -> str:
        environment = os.environ | {"DEPTH": str(depth)}
        if words := " ".join(step.script for step in script):
            environment["SCRIPT"] = words
        return _call(["./pan", *options], self._folder, environment)


def _call(command: list[str], folder: Path, environment: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=600, check=False, env=environment
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def _lines(message: str) -> Iterator[str]:
    return (line for line in message.splitlines() if line.startswith("STATE "))


_Steps = tuple[Step | None, ...]


def _read(line: str) -> tuple[_Steps, State]:
    steps, _, state = line.removeprefix("STATE ").partition(" | ")
    node, *stations = state.split()
    key, epoch, sequence, ram, able = map(int, node.split(":"))
    return tuple(map(_step, steps.split())), State(
        key,
        epoch,
        sequence,
        ram,
        tuple(map(_station, stations)),
        frozenset(s for s in range(3) if able >> 9 + s & 1),
        frozenset((s, n) for n in range(3) for s in range(3) if able >> 3 * n + s & 1),
    )


def _step(text: str) -> Step | None:
    number, station, aim = map(int, text.split("."))
    return None if number == 63 else Step(Kind(number), station, aim)


def _station(text: str) -> StationState:
    present, held, tombstone, due, shared, at, number, session = map(int, text.split(":"))
    keys = frozenset(key for key in range(1, 8) if held >> key & 1)
    signed = number if at == SIGNED else 0
    return StationState(present, keys, tombstone, bool(due), bool(shared), at == IDLE, signed, session)


IDLE, SIGNED = 6, 2
"""The numbers that SPIN gives two of the model's mtypes, ``idle`` and ``signed_``: the first has the highest."""


def _trace(steps: _Steps, states: dict[_Steps, State]) -> Trace:
    return Trace(steps, tuple(states[steps[: count + 1]] for count in range(len(steps))))
