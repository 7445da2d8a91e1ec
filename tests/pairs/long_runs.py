"""The long-running commands of the pair bench: how each is started, seen to work, ended, and held to account."""

from __future__ import annotations

import json
import signal
import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from tests.pace import PATIENCE, until
from tests.pairs.scene import BOARDS, GROUP, NODES, Outcome, Scene
from tests.zygote import Child

NAMES = {uuid: name for name, uuid in NODES.items()}
STICK = ("--files", "{FILES}/stick")
SETTLES = 5.0
"""Seconds in which a change reaches a long run on a punctual machine: the contract's 2 s, and slack for processes."""
STAYS = 1.0
"""Seconds for which a node that left a measurement is watched: it may not return."""


@dataclass
class LongRun(ABC):
    """A long-running command of one cell.

    ``leaves`` are the nodes that the change takes out of a measurement; ``touches`` those that it may interrupt.
    ``codes`` are the exit codes with which the command may end because of the change.
    """

    scene: Scene
    leaves: Collection[str] = ()
    touches: Collection[str] = ()
    codes: tuple[int, ...] = (0,)
    line_codes: tuple[int, ...] = (0,)
    """How a command of the line may end that needs this one."""
    punctual: bool = True
    """False on a machine that is busy: how long something takes, and lost messages, count for nothing then."""
    child: Child | None = None
    ended: Outcome | None = None
    complaints: list[str] = field(default_factory=list)

    name: ClassVar[str]
    of: ClassVar[str] = "alone"
    """The prepared scene that it runs in."""
    measures: ClassVar[bool] = False
    """True if it measures the group ``hand``, which may then not be changed."""

    @property
    def lines(self) -> list[dict[str, Any]]:
        """The lines of JSON that it has printed."""
        if self.ended is not None:
            return self.ended.lines
        return Outcome(0, self.child.stdout(), "").lines if self.child is not None else []

    @property
    def settles(self) -> float:
        """Seconds in which a change must have reached it."""
        return SETTLES if self.punctual else PATIENCE

    @property
    def runs(self) -> bool:
        """True while its process runs."""
        return self.child is not None and self.child.poll() is None

    def wait(self, seen: Any, why: str, seconds: float = PATIENCE) -> bool:
        """Wait until ``seen`` returns something true; notes a complaint, and returns False, if that does not happen."""
        end = time.monotonic() + seconds
        while not seen():
            if time.monotonic() > end or not self.runs:
                if seen():
                    break
                self.complaints.append(f"{self.name}: {why}" + ("" if self.runs else " (it has ended)"))
                return False
            time.sleep(0.02)
        return True

    def power(self) -> None:
        """Power what must be there before it starts."""
        self.scene.power_nodes()

    @abstractmethod
    def start(self) -> None:
        """Start it, without waiting."""

    @abstractmethod
    def reach_work(self) -> None:
        """Wait until it does what it is for."""

    @abstractmethod
    def change_made(self) -> None:
        """Give it time to notice a change, and take note of what it did."""

    def stop(self) -> None:
        """Ask it to end; it may take a moment."""
        if self.child is not None:
            self.child.send_signal(signal.SIGTERM)

    def end(self) -> None:
        """Wait for its end, and compare its exit code and its counts."""
        if self.child is None:
            return
        self.ended = self.scene.end_of(self.child)
        self.child = None
        if self.ended.is_bug or self.ended.code not in self.codes:
            self.complaints.append(f"{self.name} ended: {self.ended}")
        self.account()

    @abstractmethod
    def account(self) -> None:
        """Compare what it reported with what was to be done."""


# -- measuring ---------------------------------------------------------------------------------------------------------


@dataclass
class MeasuringRun(LongRun):
    """What ``measure`` and ``ncap run`` share: which nodes are measured."""

    measures = True

    def power(self) -> None:
        """Power the nodes, and read those that will leave: else a session that reads the rest of one ends it too."""
        super().power()
        for name in self.leaves:
            self.scene.ask("verify", NODES[name], "BUS")

    @abstractmethod
    def measured(self) -> set[str]:
        """Return the names of the nodes that it measures now."""

    def reach_work(self) -> None:
        wanted = {name for name in GROUP if name not in self.leaves}
        if not wanted:  # it finds the group, or it does not
            until(lambda: not self.runs or any("error" not in line for line in self.lines), "it prints nothing")
        self.wait(lambda: wanted <= self.measured(), f"it does not measure all of {', '.join(sorted(wanted))}")

    def change_made(self) -> None:
        wanted = {name for name in GROUP if name not in self.leaves}
        leaves = set(self.leaves)
        why = f"{', '.join(self.leaves)} is still measured after {self.settles:.0f} s"
        if leaves and self.wait(lambda: not self.measured() & leaves, why, self.settles) and wanted:
            time.sleep(STAYS)
            if back := self.measured() & leaves:
                self.complaints.append(f"{self.name}: {', '.join(back)} left and is measured again")
        self.wait(lambda: wanted <= self.measured(), f"not measured again: {wanted - self.measured() or 'nothing'}")


@dataclass
class Measure(MeasuringRun):
    """``measure GROUP`` to a file, until SIGTERM."""

    name = "measure"

    @property
    def file(self) -> Path:
        return self.scene.files / "run.jsonl"

    def start(self) -> None:
        self.child = self.scene.start("measure", "hand", "--rate", "20", "--to", "{FILES}/run.jsonl", "BUS")

    def measured(self) -> set[str]:
        found = set()
        for line in self.lines:
            if line.get("event") == "status" and line["uuid"] in NAMES:
                (found.add if line["state"] == "running" else found.discard)(NAMES[line["uuid"]])
        return found

    def account(self) -> None:
        assert self.ended is not None
        end = next((line for line in self.ended.lines if line.get("event") == "end"), None)
        if end is None or not self.file.exists():
            return
        kept: Counter[str] = Counter()
        for line in map(json.loads, self.file.read_text().splitlines()):
            if line.get("event") == "data":
                kept[line["uuid"]] += len(line["value"])
        for node in end["nodes"]:
            name = NAMES.get(node["uuid"], node["uuid"])
            samples = sum(stream["samples"] for stream in node["streams"])
            if samples != kept[node["uuid"]]:
                self.complaints.append(
                    f"measure reports {samples} values of {name}, its file holds {kept[node['uuid']]}"
                )
            lost = sum(stream["lost"] + stream["bad"] for stream in node["streams"])
            if lost and self.punctual and name not in (*self.touches, *self.leaves):
                self.complaints.append(f"measure lost {lost} messages of {name}")


@dataclass
class Ncap(MeasuringRun):
    """``ncap run --measure GROUP``, recording, until SIGTERM."""

    name = "ncap run"
    _seen: Counter[str] = field(default_factory=Counter)

    def start(self) -> None:
        words = ("ncap", "run", "--can", "{CAN}", "--measure", "hand", "--rate", "20", "--record", "{FILES}/runs")
        self.child = self.scene.start(*words)

    def measured(self) -> set[str]:
        found = set()
        for line in self.lines:
            if line.get("event") == "measurement" and line.get("uuid") in NAMES:
                (found.add if line["state"] == "joined" else found.discard)(NAMES[line["uuid"]])
        return found

    def change_made(self) -> None:
        super().change_made()
        if not self.runs:
            return
        end = time.monotonic() + self.settles
        while (differences := self._differences()) and time.monotonic() < end:
            time.sleep(0.2)
        self.complaints += [f"ncap run: {difference}" for difference in differences]
        self._foreign()

    def _differences(self) -> list[str]:
        status = self.scene.run("ncap", "status")
        known = self.scene.run("nodes")
        if status.code or known.code:
            return [f"ncap status {status}" if status.code else f"nodes {known}"]
        stored = {node["uuid"]: node["verdict"] for node in known.lines[-1]["nodes"]}
        found = []
        for node in status.lines[-1]["nodes"]:
            shown = (node.get("verdict") or {}).get("verdict") if node.get("verdict") else None
            if node["uuid"] in NAMES and node.get("present") and shown != stored.get(node["uuid"]):
                found.append(f"{NAMES[node['uuid']]} is {shown} in status, {stored.get(node['uuid'])} in the store")
        return found

    def _foreign(self) -> None:
        """Complain of a measurement that this run did not begin."""
        status = self.scene.run("ncap", "status")
        if status.code:
            self.complaints.append(f"ncap status: {status}")
            return
        foreign = [measurement["id"] for measurement in status.lines[-1]["measurements"] if measurement["id"] != "run"]
        if foreign:
            self.complaints.append(f"ncap run measures what another command began: {foreign}")

    def account(self) -> None:
        assert self.ended is not None
        for name in GROUP:
            if name in (*self.touches, *self.leaves):
                continue
            states = [
                line["state"]
                for line in self.ended.lines
                if line.get("event") == "measurement" and line.get("uuid") == NODES[name]
            ]
            if states not in (["joined", "left"], []):
                self.complaints.append(f"ncap run disturbed {name}: {', '.join(states)}")
        for recording in sorted(self.scene.files.glob("runs/*")):
            if recording.suffix in (".mcap", ".jsonl", ".csv"):
                info = self.scene.run("record", "info", str(recording))
                if info.code:
                    self.complaints.append(f"record info {recording.name}: {info}")
                elif self.punctual and (lost := info.lines[-1].get("lost")):
                    self.complaints.append(f"ncap run lost {lost} messages")


# -- provisioning ------------------------------------------------------------------------------------------------------


@dataclass
class Watch(LongRun):
    """``provision --watch`` on a reader, a board before the change and another one after it, until Ctrl-C."""

    name = "provision --watch"
    codes: tuple[int, ...] = (0, 130)
    _board: Child | None = None
    words: ClassVar[tuple[str, ...]] = ("provision", "--watch", "--profile", "{BOARD_TYPE}", "--yes", "TAP")

    def start(self) -> None:
        self.child = self.scene.start(*self.words)

    def _provide(self, name: str) -> None:
        if self._board is not None:
            self.scene.cut(self._board)
        self._board = self.scene.tap(name)
        self.wait(lambda: any(line.get("uuid") == NODES[name] for line in self.lines), f"the {name} board is not done")

    def reach_work(self) -> None:
        self._provide("first")

    def change_made(self) -> None:
        self._provide("second")

    def stop(self) -> None:
        if self.child is not None:
            self.child.send_signal(signal.SIGINT)

    def account(self) -> None:
        assert self.ended is not None
        if self._board is not None:
            self.scene.cut(self._board)
            self._board = None
        of_boards = [line for line in self.ended.lines if "uuid" in line]
        for line in of_boards:
            if line.get("verdict") != "authentic":
                self.complaints.append(f"a board of {self.name} is not done: {json.dumps(line)[-300:]}")
        twice = [uuid for uuid, count in Counter(line["uuid"] for line in of_boards).items() if count > 1]
        if twice:
            self.complaints.append(f"{self.name} reports {twice} more than once")


@dataclass
class Sheet(Watch):
    """``provision --batch SHEET`` on a reader: two rows, one before the change and one after it."""

    name = "provision --batch"
    codes: tuple[int, ...] = (0,)
    words = ("provision", "--batch", "{FILES}/sheet.csv", "--report", "{FILES}/report.csv", "--yes", "TAP")

    def start(self) -> None:
        rows = "".join(f"{NODES[name]},{name},limit-switch\n" for name in ("first", "second"))
        (self.scene.files / "sheet.csv").write_text(f"uuid,name,profile\n{rows}")
        super().start()

    def stop(self) -> None:
        """Do nothing: it ends when every row is done."""
        self._provide_rest()

    def _provide_rest(self) -> None:
        done = {line.get("uuid") for line in self.lines}
        for name in ("first", "second"):
            if NODES[name] not in done and self.runs:
                self._provide(name)

    def account(self) -> None:
        super().account()
        assert self.ended is not None
        totals = next((line["totals"] for line in self.ended.lines if "totals" in line), {})
        if (totals.get("passed"), totals.get("failed"), totals.get("skipped")) != (2, 0, 0):
            self.complaints.append(f"{self.name} counts {totals or self.ended}")


@dataclass
class ProvisionAll(LongRun):
    """``provision --all`` over the bus: three boards that take a second or two each."""

    name = "provision --all"

    def power(self) -> None:
        super().power()
        self.scene.power(*BOARDS, options=("--crypto-delay", "60"))

    def start(self) -> None:
        words = ("provision", "--all", "--profile", "{BOARD_TYPE}", "--yes", "BUS", "--timeout", "1.5")
        self.child = self.scene.start(*words)

    def reach_work(self) -> None:
        key = "SELECT count(*) FROM keys WHERE uuid = ?"
        boards = [bytes.fromhex(NODES[name]) for name in BOARDS]
        self.wait(lambda: any(self.scene.count(key, board) for board in boards), "no board is being provisioned")

    def change_made(self) -> None:
        """Do nothing: a change may take as long as the boards."""

    def stop(self) -> None:
        """Do nothing: it ends when every board is done."""

    def account(self) -> None:
        assert self.ended is not None
        passed = {line["uuid"] for line in self.ended.lines if line.get("verdict") == "authentic"}
        missing = [name for name in BOARDS if NODES[name] not in passed]
        totals = next((line["totals"] for line in self.ended.lines if "totals" in line), {})
        if missing or totals.get("passed") != len(passed):
            self.complaints.append(
                f"{self.name} counts {totals.get('passed')}, {len(passed)} passed, without {missing}"
            )


# -- the plant ---------------------------------------------------------------------------------------------------------


@dataclass
class Signer(LongRun):
    """``signer run`` at the office, and a board of the line before the change and after it, until Ctrl-C."""

    name = "signer run"
    of = "plant"
    codes: tuple[int, ...] = (0, 130)
    _signed: list[str] = field(default_factory=list)

    def power(self) -> None:
        super().power()
        self.scene.ask("registry", "connect", *STICK, "--yes", home="line")

    def start(self) -> None:
        self.child = self.scene.start("signer", "run", "--job", "{JOB}", *STICK)

    def _build(self, name: str) -> None:
        board = self.scene.tap(name)
        try:
            words = ("provision", "--job", "{FILES}/job.jws", "--yes", "TAP", *STICK, "--timeout", "20")
            built = self.scene.run(*words, home="line")
        finally:
            self.scene.cut(board)
        if built.code not in self.line_codes:
            self.complaints.append(f"the line could not build the {name} board: {built}")
        if built.code == 0:
            self._signed.append(name)

    def reach_work(self) -> None:
        self._build("first")

    def change_made(self) -> None:
        if self.runs:
            self._build("second")

    def stop(self) -> None:
        if self.child is not None:
            self.child.send_signal(signal.SIGINT)

    def account(self) -> None:
        assert self.ended is not None
        signed = [NAMES.get(line["uuid"], "") for line in self.ended.lines if "sequence" in line]
        if sorted(set(signed)) != sorted(self._signed):
            self.complaints.append(f"signer run reports {signed}, the line built {self._signed}")
        status = self.scene.run("job", "status", "{JOB}")
        if status.code or status.lines[-1]["units"] != len(self._signed):
            self.complaints.append(f"job status does not count {len(self._signed)} units: {status}")


@dataclass
class Sync(LongRun):
    """``registry sync`` at the keeper, again and again while a second member does the same."""

    name = "registry sync"
    of = "plant"
    _rounds: int = 0
    _stopping: bool = False

    def power(self) -> None:
        super().power()
        self.scene.ask("registry", "connect", *STICK, "--yes", home="line")

    def start(self) -> None:
        self.child = self.scene.start("registry", "sync", *STICK)

    def _again(self, home: str) -> None:
        synced = self.scene.run("registry", "sync", *STICK, home=home)
        if synced.is_bug or synced.code not in self.codes:
            self.complaints.append(f"registry sync of {home}: {synced}")

    def reach_work(self) -> None:
        """Do nothing: one exchange takes a fraction of a second, and is beside the change already."""

    def change_made(self) -> None:
        for home in ("line", "bench"):
            self._again(home)

    def stop(self) -> None:
        """Do nothing: it ends by itself."""

    def account(self) -> None:
        for home in ("bench", "line", "bench", "line"):
            self._again(home)
        bench, line = self._pages("bench"), self._pages("line")
        if bench != line:
            self.complaints.append(f"the members hold different pages: {bench} and {line}")
        status = self.scene.run("registry", "status")
        summary = status.lines[-1] if status.lines else {}
        if status.code or summary.get("alarms") or summary.get("conflicts") or summary.get("unsent"):
            self.complaints.append(f"registry status: {status}")

    def _pages(self, home: str) -> int:
        return self.scene.count("SELECT count(*) FROM pages", home=home)


LONG_RUNS: dict[str, type[LongRun]] = {
    kind.name: kind for kind in (Ncap, Measure, Watch, Sheet, ProvisionAll, Signer, Sync)
}
