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
from types import ModuleType

import pytest

from teds_provision.ncap import service_run
from teds_provision.one_core import LinuxKernel, OneCore, every_core, one_core
from teds_provision.provisioning import batch
from tests.pace import PATIENCE, until
from tests.parsed import parsed

PACKAGE = Path(__file__).parent.parent / "teds_provision"
COUNT_CORES = [sys.executable, "-c", "import os; print(len(os.sched_getaffinity(0)))"]

needs_two_cores = pytest.mark.skipif(
    not hasattr(os, "sched_setaffinity") or len(os.sched_getaffinity(0)) < 2, reason="this process has one core alone"
)


@dataclass
class StatedKernel:
    """A kernel whose figures the test states: the calling thread is number 1, as the system counts it 0."""

    cores: Set[int] = frozenset({0, 1, 2})
    fast: Set[int] | None = None
    real_time: bool = False
    work: dict[int, float] = field(default_factory=dict)
    mine: float = 0.0
    seconds: float = 0.0
    started: list[int] = field(default_factory=lambda: [1])
    places: dict[int, Set[int]] = field(default_factory=dict)

    def allowed(self) -> Set[int]:
        return self.places.get(1, self.cores)

    def fastest(self, cores: Set[int]) -> Set[int]:
        return cores if self.fast is None else cores & self.fast

    def waits(self) -> bool:
        return not self.real_time

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


@dataclass
class Run:
    """One core of a stated kernel, and what it decides in each two seconds."""

    kernel: StatedKernel = field(default_factory=StatedKernel)

    def __post_init__(self) -> None:
        self.kept = OneCore(self.kernel)

    def look(self, *, mine: float = 0.0, others: Mapping[int, float] = {}) -> int | None:
        """Let two seconds pass, with so much work of this process and of others on each core; return the core."""
        self.kernel.seconds += 2.0
        self.kernel.mine += mine
        placed = sorted(self.kernel.places.get(1, self.kernel.cores))
        for core in placed:
            self.kernel.work[core] = self.kernel.work.get(core, 0.0) + mine / len(placed)
        for core, worked in others.items():
            self.kernel.work[core] = self.kernel.work.get(core, 0.0) + worked
        self.kept.look()
        return self.kept.core


def test_every_thread_gets_the_core_on_which_others_do_least() -> None:
    run = Run(StatedKernel(started=[1, 7, 8]))
    assert run.kernel.places == {}, "before the first look nothing is known"
    assert run.look(mine=0.6, others={0: 0.4, 1: 0.2, 2: 1.0}) == 1
    assert run.kernel.places == {1: {1}, 7: {1}, 8: {1}}


def test_the_core_is_one_of_those_that_the_user_left() -> None:
    run = Run(StatedKernel(cores=frozenset({2, 3})))
    assert run.look(others={2: 0.2, 3: 0.1}) == 3
    assert run.look(others={3: 1.5}) == 2, "cores 0 and 1 are free as well, but not this process's"


def test_a_slow_core_is_not_taken() -> None:
    run = Run(StatedKernel(fast={1, 2}))
    assert run.look(others={1: 0.1}) == 2
    assert run.look(others={2: 1.4}) == 1


def test_a_core_that_others_take_is_left_for_a_free_one() -> None:
    run = Run(StatedKernel(started=[1, 7]))
    run.look()
    assert run.look(mine=0.6, others={0: 1.4, 1: 0.5, 2: 0.3}) == 2
    assert run.kernel.places == {1: {2}, 7: {2}}
    assert run.look(mine=0.6, others={0: 0.0, 1: 0.5, 2: 0.3}) == 2, "it stays while it can"


def test_its_own_work_is_no_reason_to_move() -> None:
    run = Run()
    assert [run.look(mine=2.0) for _ in range(3)] == [0, 0, 0]


def test_on_a_machine_whose_cores_are_all_taken_the_threads_have_all() -> None:
    """On one core of it a thread that is woken waits longer for its turn than on the first that gives it one."""
    run = Run(StatedKernel(started=[1, 7]))
    run.look()
    everywhere = {0: 1.9, 1: 1.8, 2: 1.7}
    assert run.look(mine=0.1, others=everywhere) is None
    assert run.kernel.places == {1: {0, 1, 2}, 7: {0, 1, 2}}
    assert run.look(mine=0.3, others=everywhere) is None
    assert run.look(mine=0.3, others={**everywhere, 1: 0.5}) == 1


def test_a_real_time_process_has_one_core_whatever_others_do() -> None:
    run = Run(StatedKernel(real_time=True))
    assert run.look(mine=0.6, others={0: 1.7, 1: 1.8, 2: 1.9}) == 0
    assert run.look(mine=0.6, others={0: 1.4, 1: 1.1, 2: 1.9}) == 0
    assert run.look(mine=0.6, others={0: 1.4, 1: 0.1, 2: 1.9}) == 1


def test_only_what_happened_since_the_last_look_counts() -> None:
    run = Run()
    run.look()
    assert run.look(others={0: 2.0}) == 1
    assert run.look(mine=0.6) == 1, "and not back: the core that was left is free now, but so is this one"


def test_a_thread_that_begins_while_the_others_move_is_placed_too() -> None:
    run = Run()
    kernel = run.kernel

    def place(thread: int, cores: Set[int]) -> None:
        if thread == 1 and 9 not in kernel.started:
            kernel.started.append(9)
            kernel.places[9] = kernel.allowed()
        kernel.places[thread] = cores

    kernel.place = place  # type: ignore[method-assign]
    assert run.look() == 0
    assert kernel.places[9] == {0}


def test_cores_that_somebody_else_gives_stay() -> None:
    run = Run()
    run.look()
    run.kernel.places[1] = frozenset({0, 2})
    run.look(others={0: 2.0})
    run.kept.leave()
    assert run.kept.left
    assert run.kernel.places[1] == {0, 2}


def test_figures_of_other_cores_change_nothing() -> None:
    """A container may count its cores anew in /proc/stat."""
    kernel = StatedKernel(cores=frozenset({6, 7}))
    with pytest.raises(ValueError, match="other cores"):
        OneCore(kernel)
    assert kernel.places == {}


def test_the_kernels_figures_are_read() -> None:
    kernel = LinuxKernel()
    assert kernel.busy().keys() >= kernel.allowed() >= kernel.fastest(kernel.allowed()) > frozenset()
    assert threading.get_native_id() in kernel.threads()
    assert kernel.waits() is (os.sched_getscheduler(0) == os.SCHED_OTHER)
    before = kernel.busy()
    until(lambda: kernel.busy() != before)


class IdleMachine(LinuxKernel):
    """This machine, as if nobody else worked on it."""

    def busy(self) -> Mapping[int, float]:
        return dict.fromkeys(super().busy(), 0.0)


@needs_two_cores
def test_threads_and_those_that_they_start_have_one_core_until_the_end() -> None:
    before = os.sched_getaffinity(0)
    ends, seen = threading.Event(), []
    early = threading.Thread(target=ends.wait, args=(PATIENCE,))
    early.start()
    with one_core(IdleMachine()) as kept:
        assert kept is not None
        until(lambda: kept.core is not None)
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
    with one_core(IdleMachine()) as kept:
        assert kept is not None
        until(lambda: kept.core is not None)
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
    with one_core(IdleMachine()) as kept:
        assert kept is not None
        with every_core():
            until(lambda: kept.core is not None)
            assert os.sched_getaffinity(0) == cores
        assert os.sched_getaffinity(0) == {kept.core}


@needs_two_cores
def test_the_watcher_ends_with_the_block() -> None:
    def watchers() -> int:
        return sum(thread.name == "core" for thread in threading.enumerate())

    until(lambda: not watchers())  # one of a test before ends a moment after its block
    with one_core():
        assert watchers() == 1
    until(lambda: not watchers())


@pytest.mark.parametrize("module", [batch, service_run], ids=["provision --all", "ncap run"])
def test_who_works_with_many_nodes_keeps_to_one_core(module: ModuleType) -> None:
    blocks = [
        ast.unparse(item.context_expr)
        for node in ast.walk(parsed(Path(str(module.__file__))))
        if isinstance(node, ast.With)
        for item in node.items
    ]
    assert "one_core()" in blocks


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
    texts = {path: path.read_text(encoding="utf-8") for path in PACKAGE.rglob("*.py")}
    starting = [path for path, text in texts.items() if any(starter in text for starter in STARTERS)]
    found = {str(path.relative_to(PACKAGE)): outside_every_core(parsed(path)) for path in starting}
    assert {name for name, lines in found.items() if lines} == ALONE


def test_a_core_is_free_up_to_35_percent_and_taken_beyond_half() -> None:
    run = Run()
    assert run.look(others={0: 0.7, 1: 0.7, 2: 0.7}) == 0, "35 % of two seconds"
    assert run.look(others={0: 1.0}) == 0, "half of a core is no reason to move"
    assert run.look(others={0: 1.01}) == 1
    assert Run().look(others={0: 0.71, 1: 0.71, 2: 0.71}) is None


def test_its_own_work_makes_no_core_better_than_an_idle_one() -> None:
    run = Run()
    run.kernel.work |= {0: 0.3, 1: 0.1}
    run.kernel.mine += 0.9
    assert run.look() == 0, "on each of them others do nothing"


def test_figures_that_lack_one_core_change_nothing_either() -> None:
    with pytest.raises(ValueError, match="other cores"):
        OneCore(StatedKernel(cores=frozenset({2, 6})))


@pytest.mark.parametrize(
    ("policy", "waits"),
    [(os.SCHED_OTHER, True), (os.SCHED_BATCH, True), (os.SCHED_FIFO, False), (os.SCHED_RR, False)],
)
def test_threads_of_real_time_processes_do_not_wait(monkeypatch: pytest.MonkeyPatch, policy: int, waits: bool) -> None:
    monkeypatch.setattr(os, "sched_getscheduler", lambda _process: policy)
    assert LinuxKernel().waits() is waits


def test_who_starts_processes_keeps_every_core_until_the_outer_block_ends() -> None:
    run = Run()
    assert run.look() == 0
    with run.kept.on_every_core():
        with run.kept.on_every_core():
            assert run.kernel.places[1] == {0, 1, 2}
        assert run.kernel.places[1] == {0, 1, 2}
    assert run.kernel.places[1] == {0}
    with run.kept.on_every_core():
        run.kept.leave()
        run.kernel.places[1] = frozenset({2})  # as somebody else gave it
    assert run.kernel.places[1] == {2}


def test_a_thread_that_has_ended_leaves_the_others_to_be_placed() -> None:
    run = Run(StatedKernel(started=[1, 5, 7]))
    place = run.kernel.place

    def gone(thread: int, cores: Set[int]) -> None:
        if thread == 5:
            raise ProcessLookupError
        place(thread, cores)

    run.kernel.place = gone  # type: ignore[method-assign]
    assert run.look() == 0
    assert run.kernel.places == {1: {0}, 7: {0}}


def test_a_block_within_a_block_changes_nothing() -> None:
    with one_core(StatedKernel()) as outer, one_core(StatedKernel()) as inner:
        assert (outer is None, inner) == (False, None)
    with one_core(StatedKernel()) as again:
        assert again is not None


def test_a_block_that_fails_gives_all_cores_back() -> None:
    found: list[OneCore | None] = []

    def fail() -> None:
        with one_core(StatedKernel()) as kept:
            found.append(kept)
            raise LookupError

    with pytest.raises(LookupError):
        fail()
    assert found[0] is not None
    assert found[0].left
    with one_core(StatedKernel()) as again:
        assert again is not None


def test_a_thread_that_has_started_its_process_is_moved_with_the_others_again() -> None:
    own = threading.get_native_id()
    run = Run(StatedKernel(started=[1, own]))
    assert run.look() == 0
    with run.kept.on_every_core():
        run.kernel.places[1] = frozenset({0})  # as another thread sees it, which looks
        assert run.look(others={0: 1.4}) == 1
        assert run.kernel.places[own] == {0}, "not while it starts one"
    assert run.look(others={1: 1.4}) == 0
    assert run.look(others={0: 1.4}) == 1
    assert run.kernel.places[own] == {1}
