"""All threads on one core: which one, when it is left, and what a process that is started gets."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
import threading
from collections.abc import Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from teds_provision.one_core import OneCore, every_core, one_core
from tests.pace import PATIENCE, until
from tests.parsed import parsed

PACKAGE = Path(__file__).parent.parent / "teds_provision"
COUNT_CORES = [sys.executable, "-c", "import os; print(len(os.sched_getaffinity(0)))"]

needs_two_cores = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2, reason="this process has one core alone"
)


@dataclass
class StatedKernel:
    """A kernel whose figures the test states: a thread of this process is number 1, the calling one."""

    cores: Set[int] = frozenset({0, 1, 2})
    on: int = 1
    fast: Set[int] | None = None
    work: dict[int, float] = field(default_factory=dict)
    mine: float = 0.0
    seconds: float = 0.0
    started: list[int] = field(default_factory=lambda: [1])
    places: dict[int, Set[int]] = field(default_factory=dict)

    def allowed(self) -> Set[int]:
        return self.places.get(1, self.cores)

    def fastest(self, cores: Set[int]) -> Set[int]:
        return cores if self.fast is None else cores & self.fast

    def current(self) -> int:
        return self.on

    def place(self, thread: int, cores: Set[int]) -> None:
        self.places[thread or 1] = frozenset(cores)

    def threads(self) -> Set[int]:
        return set(self.started)

    def busy(self) -> Mapping[int, float]:
        return {core: self.work.get(core, 0.0) for core in range(4)}

    def own(self) -> float:
        return self.mine

    def now(self) -> float:
        return self.seconds

    def passes(self, seconds: float, *, mine: float = 0.0, on: int = 1, **others: float) -> None:
        """Let time pass, with so much work of this process on that core, and of others (``core0=1.5``)."""
        self.seconds += seconds
        self.mine += mine
        self.work[on] = self.work.get(on, 0.0) + mine
        for name, worked in others.items():
            core = int(name.removeprefix("core"))
            self.work[core] = self.work.get(core, 0.0) + worked


def test_every_thread_gets_the_core_on_which_the_process_runs() -> None:
    kernel = StatedKernel(started=[1, 7, 8])
    assert OneCore(kernel).core == 1
    assert kernel.places == {1: {1}, 7: {1}, 8: {1}}


def test_the_core_is_one_of_those_that_the_user_left() -> None:
    kernel = StatedKernel(cores=frozenset({2, 3}), on=3)
    kept = OneCore(kernel)
    kernel.passes(2, core3=2)
    kept.look()
    assert (kept.core, kernel.places[1]) == (2, {2}), "cores 0 and 1 are idle as well, but not this process's"


def test_a_slow_core_is_not_taken() -> None:
    kernel = StatedKernel(on=0, fast={1, 2})
    kept = OneCore(kernel)
    assert kept.core == 1
    kernel.passes(2, core1=2, core2=1)
    kept.look()
    assert kept.core == 2


def test_a_core_that_others_take_is_left_for_the_least_busy_one() -> None:
    kernel = StatedKernel(started=[1, 7])
    kept = OneCore(kernel)
    kernel.passes(2, mine=0.6, core1=1.4, core2=0.5, core0=0.9)
    kept.look()
    assert kept.core == 2
    assert kernel.places == {1: {2}, 7: {2}}


def test_its_own_work_is_no_reason_to_move() -> None:
    kernel = StatedKernel()
    kept = OneCore(kernel)
    kernel.passes(2, mine=2.0)
    kept.look()
    assert kept.core == 1


@pytest.mark.parametrize(
    "others", [{"core1": 0.5}, {"core1": 2.0, "core0": 1.9, "core2": 1.6}], ids=["little", "the same everywhere"]
)
def test_it_stays_where_moving_gains_nothing(others: dict[str, float]) -> None:
    kernel = StatedKernel()
    kept = OneCore(kernel)
    kernel.passes(2, mine=0.0, on=1, **others)
    kept.look()
    assert kept.core == 1


def test_only_what_happened_since_the_last_look_counts() -> None:
    kernel = StatedKernel()
    kept = OneCore(kernel)
    kernel.passes(2, core1=2)
    kept.look()
    kernel.passes(2, mine=0.6, on=kept.core)
    kept.look()
    assert kept.core == 0, "and not back: the core that was left is idle now, but so is this one"


def test_a_thread_that_begins_while_the_others_move_is_placed_too() -> None:
    kernel = StatedKernel()
    kept = OneCore(kernel)

    def place(thread: int, cores: Set[int]) -> None:
        if thread == 1 and 9 not in kernel.started:
            kernel.started.append(9)
            kernel.places[9] = kernel.places[1]
        kernel.places[thread] = cores

    kernel.place = place  # type: ignore[method-assign]
    kernel.passes(2, core1=2)
    kept.look()
    assert kernel.places[9] == {0}


def test_cores_that_somebody_else_gives_stay() -> None:
    kernel = StatedKernel()
    kept = OneCore(kernel)
    kernel.places[1] = frozenset({0, 2})
    kernel.passes(2, core1=2)
    kept.look()
    kept.leave()
    assert kept.left
    assert kernel.places[1] == {0, 2}


def test_figures_of_other_cores_change_nothing() -> None:
    """A container may count its cores anew in /proc/stat."""
    kernel = StatedKernel(cores=frozenset({6, 7}), on=6)
    with pytest.raises(ValueError, match="other cores"):
        OneCore(kernel)
    assert kernel.places == {}


@needs_two_cores
def test_threads_and_those_that_they_start_have_one_core_until_the_end() -> None:
    before = os.sched_getaffinity(0)
    ends, seen = threading.Event(), []
    early = threading.Thread(target=ends.wait, args=(PATIENCE,))
    early.start()
    with one_core() as kept:
        assert kept is not None
        late = threading.Thread(target=lambda: seen.append(os.sched_getaffinity(0)))
        late.start()
        late.join()
        assert early.native_id is not None
        assert seen == [os.sched_getaffinity(early.native_id)] == [os.sched_getaffinity(0)] == [{kept.core}]
        with one_core() as inner:
            assert inner is None
        assert os.sched_getaffinity(0) == {kept.core}
    assert os.sched_getaffinity(0) == os.sched_getaffinity(early.native_id) == before
    ends.set()
    early.join()


@needs_two_cores
def test_a_process_that_is_started_gets_all_cores_back() -> None:
    cores = len(os.sched_getaffinity(0))
    with one_core() as kept:
        assert kept is not None
        with every_core():
            counted = subprocess.run(COUNT_CORES, capture_output=True, check=True)
        assert os.sched_getaffinity(0) == {kept.core}
        with every_core(), every_core():
            assert len(os.sched_getaffinity(0)) == cores
        assert os.sched_getaffinity(0) == {kept.core}
    assert int(counted.stdout) == cores
    with every_core():
        assert len(os.sched_getaffinity(0)) == cores


@needs_two_cores
def test_a_move_leaves_a_thread_alone_that_starts_a_process() -> None:
    cores = os.sched_getaffinity(0)
    with one_core() as kept:
        assert kept is not None
        with every_core():
            kept._place_all({kept.core})
            assert os.sched_getaffinity(0) == cores


@needs_two_cores
def test_the_watcher_ends_with_the_block() -> None:
    def watchers() -> int:
        return sum(thread.name == "core" for thread in threading.enumerate())

    with one_core():
        assert watchers() == 1
    until(lambda: not watchers())


ALONE = {
    "demo/page.py",
    "demo/story.py",
    "doctor/links.py",
    "node/sources/command.py",
    "plant/demo/cluster.py",
    "provisioning/forked_workers.py",
    "vault/agent.py",
}
"""Modules whose processes are started by commands and nodes that do not keep to one core."""
STARTERS = {"subprocess.Popen", "subprocess.run", "subprocess.call", "subprocess.check_output", "os.fork"}
STARTERS |= {"os.posix_spawn", "os.system", "os.popen", "asyncio.create_subprocess_exec"}


def outside_every_core(tree: ast.AST) -> list[int]:
    """Return the lines of calls that start a process outside of ``with every_core()``."""
    inside = {
        call
        for block in ast.walk(tree)
        if isinstance(block, ast.With) and any(ast.unparse(item.context_expr) == "every_core()" for item in block.items)
        for call in ast.walk(block)
    }
    calls = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    return [call.lineno for call in calls if ast.unparse(call.func) in STARTERS and call not in inside]


def test_what_a_station_starts_gets_all_cores() -> None:
    found = {str(path.relative_to(PACKAGE)): outside_every_core(parsed(path)) for path in PACKAGE.rglob("*.py")}
    assert {name for name, lines in found.items() if lines} == ALONE
