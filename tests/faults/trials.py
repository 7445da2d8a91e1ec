"""One trial: a fault in one command, in the station or in the node, and whether all is well after it.

A trial copies a station and a node into a folder of its own, runs one changing command with one fault in it (cut.c),
takes the disk as the program left it or as it was at the last fsync, runs the same command again without a fault, and
then asks: does the command end well, and is the node authentic to the station that must hold it (``verify`` says 4
where an epoch or a sequence is older than the station's, 5 or 6 where a key was lost)?

The folders lie in memory where there is a /dev/shm: what survives a loss of power is what the shadow holds, not what
the real disk does.
"""

from __future__ import annotations

import os
import shutil
import sqlite3
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from tests.cli.shell import clean_environment
from tests.faults.acts import UUID, Act
from tests.faults.desk import Desk, Outcome, States, ended
from tests.faults.disk import build_library, put_back
from tests.zygote import Child, Zygote, first_of

CUTS = ("kill", "torn")
HANGS = 120.0
MEMORY = Path("/dev/shm")


@dataclass(frozen=True)
class Fault:
    """One fault: at which change, how, whose disk; ``power``: afterwards the disk is as at the last fsync."""

    at: int
    how: str = "kill"
    stays: bool = False
    power: bool = False
    ignore_fsync: bool = False

    def __str__(self) -> str:
        extra = " (and from then on)" if self.stays else ", power lost" if self.power else ""
        return f"{self.how} at {self.at}{extra}"

    def environment(self, library: Path, desk: Desk, *places: str) -> dict[str, str]:
        """Return what cut.c reads; ``places`` are the folders of the desk whose changes count."""
        chosen = {
            "LD_PRELOAD": str(library),
            "FAULT_ROOTS": ":".join(str(desk.folder / place) for place in places),
            "FAULT_AT": str(self.at),
            "FAULT_HOW": self.how,
            "FAULT_COUNT": str(desk.folder / "count"),
        }
        if self.stays:
            chosen["FAULT_STAYS"] = "1"
        if self.power:
            (desk.folder / "shadow").mkdir(exist_ok=True)
            chosen["FAULT_SHADOW"] = str(desk.folder / "shadow")
        if self.ignore_fsync:
            chosen["FAULT_NOSYNC"] = "1"
        return chosen


@dataclass(frozen=True)
class Trial:
    """One fault in one command, in the station or in the node."""

    act: Act
    fault: Fault
    on_node: bool

    def __str__(self) -> str:
        return f"{self.act.name}, {'node ' if self.on_node else ''}{self.fault}"


class Bench:
    """Runs trials of acts; at most ``jobs`` of them work at a time, not counting those that wait for a time-out."""

    def __init__(self, folder: Path, jobs: int = 1) -> None:
        self.folder = folder
        self.library = build_library(folder)
        (folder / "states").mkdir()
        self.zygote = Zygote(clean_environment(), self.library)
        self.states = States(folder / "states", self.zygote)
        self._cores = threading.Semaphore(jobs)

    @classmethod
    @contextmanager
    def open(cls, jobs: int = 1) -> Iterator[Bench]:
        """Yield a bench in a folder of its own, in memory where that can be."""
        where = MEMORY if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) else None
        with tempfile.TemporaryDirectory(prefix="faults-", dir=where) as folder:
            bench = cls(Path(folder).resolve(), jobs)
            try:
                yield bench
            finally:
                bench.zygote.close()

    @contextmanager
    def desk(self, act: Act) -> Iterator[Desk]:
        """A copy of the act's starting state; goes when the trial is over."""
        place = Path(tempfile.mkdtemp(dir=self.folder)) / "desk"
        shutil.copytree(self.states.of(act.start), place)
        try:
            yield Desk(place, self.zygote)
        finally:
            shutil.rmtree(place.parent, ignore_errors=True)

    def count(self, act: Act, how: str = "kill") -> int:
        """Return how many changes and messages the whole command makes."""
        with self.desk(act) as desk, desk.node() if act.node else nullcontext():
            fault = Fault(0, how).environment(self.library, desk, act.home, "files")
            _must_end(act, desk.run(*act.words, home=act.home, fault=fault, until=act.until, seconds=act.seconds))
            return _counted(desk)

    def node_count(self, act: Act, how: str = "kill") -> int:
        """Return how many changes of its flash, and datagrams, the node makes while the whole command runs."""
        with self.desk(act) as desk:
            with desk.node(Fault(0, how).environment(self.library, desk, "flash")):
                _must_end(act, desk.run(*act.words, home=act.home, until=act.until))
            return _counted(desk)

    def run(self, trial: Trial) -> str:
        """Run one trial; the complaint, or nothing where all healed."""
        with self._cores, self.desk(trial.act) as desk:
            cut = self._on_node if trial.on_node else self._on_station
            return cut(desk, trial.act, trial.fault) or self._proof(trial.act, desk)

    def _on_station(self, desk: Desk, act: Act, fault: Fault) -> str:
        """The command meets the fault, then it runs again; the node stays as it is."""
        with desk.node() if act.node else nullcontext():
            try:
                first = desk.run(
                    *act.words,
                    home=act.home,
                    fault=fault.environment(self.library, desk, act.home, "files"),
                    seconds=max(HANGS, act.seconds),
                    until=act.until,
                )
            except subprocess.TimeoutExpired:
                return "the command hangs"
            if first.buggy:
                return first.buggy
            if fault.power:
                for root in (desk.folder / act.home, desk.folder / "files"):
                    if root.exists():
                        put_back(desk.folder / "shadow", root)
            return self._again(desk, act, first)

    def _on_node(self, desk: Desk, act: Act, fault: Fault) -> str:
        """The node meets the fault; it is started anew, and the command runs again."""
        first: Outcome | None = None
        try:
            with desk.node(fault.environment(self.library, desk, "flash")) as node:
                command = desk.start(*act.words, "--timeout", "5", home=act.home)
                first = self._end_of(command, node)
                if fault.how not in CUTS and node.poll() is not None:
                    return f"the node died of a failing flash: {node.stderr()[-300:]}"
        except subprocess.TimeoutExpired:
            return "the command hangs"
        except AssertionError:
            pass  # it was cut before it was ready
        if first is not None and first.buggy:
            return first.buggy
        if fault.power:
            put_back(desk.folder / "shadow", desk.folder / "flash")
        with desk.node():
            return self._again(desk, act, first)

    def _end_of(self, command: Child, node: Child) -> Outcome:
        """The end of a command; where its node is gone it does nothing but wait, and others may work meanwhile."""
        if first_of(command, node, HANGS) is command:
            return ended(command, HANGS)
        self._cores.release()
        try:
            return ended(command, HANGS)
        finally:
            self._cores.acquire()

    def _again(self, desk: Desk, act: Act, first: Outcome | None) -> str:
        again = desk.run(*act.words, home=act.home, until=act.until, seconds=act.seconds)
        if again.returncode in act.ends:
            return ""
        output = again.stdout[-400:] + again.stderr[-200:]
        return f"first {first.returncode if first else 'not begun'}, again {again.returncode}: {output}"

    def _proof(self, act: Act, desk: Desk) -> str:
        if not act.proof:
            listed = desk.run("nodes", home=act.home)
            return "" if listed.returncode == 0 else f"nodes: {listed.stdout[-300:]}"
        with desk.node():
            verified = desk.run("verify", UUID, "TAP", home=act.proof)
        if act.keys:
            with closing(sqlite3.connect(desk.folder / act.proof / "store.sqlite3")) as store:
                (keys,) = store.execute("SELECT count(*) FROM keys").fetchone()
            if keys != act.keys:
                return f"{keys} keys of {act.keys}"
        return "" if verified.returncode in act.verdicts else f"verify {verified.returncode}: {verified.stdout[-400:]}"


def _must_end(act: Act, done: Outcome) -> None:
    assert done.returncode in act.ends, f"{act.name} fails without any fault: {done.stdout}{done.stderr}"


def _counted(desk: Desk) -> int:
    return int.from_bytes((desk.folder / "count").read_bytes()[:8], sys.byteorder)
