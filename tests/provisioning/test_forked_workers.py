"""Forked workers: results in order, and no end of a process, here or there, leaves another one waiting."""

from __future__ import annotations

import os
import pickle
import selectors
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from teds_provision.errors import BadDataError, TedsProvisionError
from teds_provision.provisioning import forked_workers
from teds_provision.provisioning.forked_workers import map_ranges
from tests.cli.shell import ROOT, clean_environment
from tests.pace import PATIENCE

RANGES = [range(at, at + 3) for at in range(0, 60, 3)]


def test_results_come_in_the_order_of_the_ranges_even_if_the_first_is_the_last_to_be_ready() -> None:
    read, write = os.pipe()

    def work(places: range) -> tuple[range, int]:
        if places.start == 0:
            os.read(read, 1)
        if places.start == 6:
            os.write(write, b"x")
        return places, os.getpid()

    found = list(map_ranges(work, RANGES, 2))
    assert [places for places, _ in found] == RANGES
    pids = {pid for _, pid in found}
    assert os.getpid() not in pids
    assert len(pids) == 2
    os.close(read)
    os.close(write)


def test_no_more_than_eight_ranges_for_each_worker_are_ahead_of_the_first_that_is_not_ready(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Their results wait in the parent: a slow first file must not let those of 100,000 others fill its memory."""
    lines = socket.socketpair()
    slow, quick = (forked_workers._Worker(0, line) for line in lines)
    handed: list[int] = []
    looks: list[int] = []

    class Selector:
        def __enter__(self) -> Selector:
            return self

        def __exit__(self, *_: object) -> None:
            """Nothing is open."""

        def register(self, *_: object) -> None:
            """All are looked at."""

        def select(self) -> list[tuple[SimpleNamespace, int]]:
            looks.append(len(handed))
            return [(SimpleNamespace(data=worker), 0) for worker in (slow, quick)]

    def hand(worker: forked_workers._Worker, place: int, places: range) -> None:
        worker.places.append(place)
        handed.append(places.start)

    def receive(worker: forked_workers._Worker, results: dict[int, tuple[bool, bytes]]) -> None:
        if worker is quick or looks[-2:] == [looks[-1]] * 2:
            while worker.places:
                results[worker.places.popleft()] = (True, pickle.dumps("done"))

    monkeypatch.setattr(selectors, "DefaultSelector", Selector)
    monkeypatch.setattr(forked_workers, "_hand", hand)
    monkeypatch.setattr(forked_workers, "_receive", receive)
    found = forked_workers._collect([slow, quick], [range(at, at + 1) for at in range(40)])
    assert next(found) == "done"
    assert handed == list(range(16)), "until the first is ready"
    assert len(list(found)) == 39
    assert handed == list(range(40))
    for line in lines:
        line.close()


def test_a_result_of_megabytes_comes_whole() -> None:
    found = list(map_ranges(lambda places: bytes([places.start]) * 3_000_000, RANGES[:5], 2))
    assert found == [bytes([places.start]) * 3_000_000 for places in RANGES[:5]]


def test_what_the_work_raises_is_raised_here() -> None:
    class LocalError(Exception):
        """One that cannot be sent: another process does not find its class."""

    def work(places: range) -> int:
        if places.start == 9:
            raise BadDataError("Nine is wrong.", hint="Take ten.")
        if places.start == 12:
            raise LocalError("twelve")
        return places.start

    some = map_ranges(work, RANGES, 2)
    with pytest.raises(BadDataError, match=r"Nine is wrong\.") as found:
        list(some)
    assert found.value.hint == "Take ten."
    with pytest.raises(RuntimeError, match="twelve"):
        list(map_ranges(work, RANGES[4:5], 1))


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_that_is_killed_ends_the_work_with_an_error(number: signal.Signals) -> None:
    """A pool started another process in its place, and waited for ever for the lost range."""

    def work(places: range) -> int:
        if places.start == 30:
            os.kill(os.getpid(), number)
        return places.start

    some = map_ranges(work, RANGES, 2)
    seen: list[int] = []
    with pytest.raises(TedsProvisionError, match=f"ended by signal {number.value}") as found:
        seen.extend(some)
    assert found.value.exit_code == 1
    assert seen == [places.start for places in RANGES[: len(seen)]]
    assert len(seen) <= 10


def test_a_worker_that_ctrl_c_reached_first_is_no_separate_error() -> None:
    def work(places: range) -> int:
        os.kill(os.getpid(), signal.SIGINT)
        return places.start

    with pytest.raises(KeyboardInterrupt):
        list(map_ranges(work, RANGES, 2))


def test_no_process_to_spare_is_no_reason_to_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left() -> int:
        raise BlockingIOError(11, "Resource temporarily unavailable")

    lines: list[socket.socket] = []
    pair = socket.socketpair

    def socketpair() -> tuple[socket.socket, socket.socket]:
        lines.extend(pair())
        return lines[-2], lines[-1]

    monkeypatch.setattr("os.fork", none_left)
    monkeypatch.setattr("socket.socketpair", socketpair)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGTERM])
    try:
        assert list(map_ranges(len, RANGES, 2)) == [3] * 20
        assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == before | {signal.SIGTERM}, "as the program had it"
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    assert [line.fileno() for line in lines] == [-1, -1], "nothing stays open"


@contextmanager
def handled(number: signal.Signals, handler: Callable[..., object]) -> Iterator[None]:
    before = signal.signal(number, handler)
    try:
        yield
    finally:
        signal.signal(number, before)


def test_a_generator_closed_early_leaves_no_worker_whatever_handler_the_program_has() -> None:
    """A worker with the program's handler of SIGTERM went on, and its parent waited for it for ever."""
    with handled(signal.SIGTERM, lambda *_: None):
        some = map_ranges(lambda _: os.getpid(), RANGES, 2)
        pid = next(some)
        os.kill(pid, 0)
        some.close()
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_workers_have_no_handler_of_the_program() -> None:
    with handled(signal.SIGTERM, lambda *_: None), handled(signal.SIGINT, lambda *_: None):
        names = list(map_ranges(lambda _: (signal.getsignal(15), signal.getsignal(2)), RANGES[:2], 1))
        assert signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL
    assert names == [(signal.SIG_DFL, signal.SIG_DFL)] * 2


# The parent is a process of its own. Its workers hold the write end of a pipe, so the pipe's end is theirs.
_PARENT = """
import os, sys
from teds_provision.provisioning.forked_workers import map_ranges
open_until_the_end = int(sys.argv[1])
def work(places):
    if places.start >= {stops}:
        os.write(open_until_the_end, b"!")
        {then}
    return os.getpid()
some = map_ranges(work, [range(at, at + 1) for at in range(2000)], 2)
next(some)
{parent}
for _ in some:
    pass
"""


@contextmanager
def parent(stops: int, then: str = "", parent: str = "") -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    """Start a program that has workers; wait for both of them if they stop. Gives the read end of their pipe."""
    read, write = os.pipe()
    code = _PARENT.format(stops=stops, then=then or "pass", parent=parent)
    process = subprocess.Popen(
        [sys.executable, "-c", code, str(write)],
        cwd=ROOT,
        env=clean_environment(),
        pass_fds=[write],
        stderr=subprocess.PIPE,
        start_new_session=True,
    )
    os.close(write)
    try:
        yield process, read
    finally:
        process.kill()
        process.communicate()
        os.close(read)


def _next(pipe: int) -> bytes:
    with selectors.DefaultSelector() as selector:
        selector.register(pipe, selectors.EVENT_READ)
        assert selector.select(PATIENCE), "the workers are still there"
    return os.read(pipe, 1)


def ended(pipe: int) -> None:
    """Wait until all who hold the other end are gone."""
    while _next(pipe):
        pass


def test_idle_workers_end_when_their_parent_is_killed() -> None:
    """Those of a pool stayed for ever: each held the pipe of the other open."""
    with parent(0, parent="import signal; signal.pause()") as (process, pipe):
        assert _next(pipe)
        process.kill()
        ended(pipe)


def test_busy_workers_end_when_their_parent_is_killed() -> None:
    with parent(0) as (process, pipe):
        assert _next(pipe)
        process.kill()
        ended(pipe)


def test_ctrl_c_ends_the_program_and_its_workers() -> None:
    with parent(1, then="import signal; signal.pause()") as (process, pipe):
        assert _next(pipe) + _next(pipe) == b"!!"  # both wait, and so does their parent
        os.killpg(process.pid, signal.SIGINT)
        _, text = process.communicate(timeout=PATIENCE)
        assert process.returncode == -signal.SIGINT, text.decode()
        assert b"KeyboardInterrupt" in text
        ended(pipe)


def test_ctrl_c_for_the_program_alone_ends_its_workers() -> None:
    with parent(1, then="import signal; signal.pause()") as (process, pipe):
        assert _next(pipe) + _next(pipe) == b"!!"
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=PATIENCE)
        assert process.returncode == -signal.SIGINT
        ended(pipe)
