"""Work shared among the cores: forked processes judge ranges of a list, and their results come back in order.

Each process has one socket to its parent and nothing in common with the others, neither queue nor lock, so the end of
one leaves none of them waiting. It ends when its socket closes: after the last range, if the parent stops early, and if
the parent is killed. The parent ends them by SIGKILL, which no handler of the program can hold up; they have nothing to
put in order.
"""

from __future__ import annotations

import gc
import os
import pickle
import selectors
import signal
import socket
import struct
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Final, NoReturn, TypeVar

from teds_provision.errors import TedsProvisionError

Result = TypeVar("Result")

_ASKED: Final = struct.Struct("!QQ")
"""A range for a worker: its start and its stop."""
_ANSWERED: Final = struct.Struct("!?Q")
"""Start of an answer: whether it is a result or an exception, and the octets that follow."""
_AHEAD: Final = 2
"""Ranges that a worker has at a time, so that it need not wait for the next one."""
_RARELY: Final = 50_000
"""New objects between two looks for circles: documents are trees, which their counts of references free."""
_ENDING: Final = tuple(
    getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP", "SIGPIPE") if hasattr(signal, name)
)


def map_ranges(work: Callable[[range], Result], ranges: Sequence[range], workers: int) -> Generator[Result, None, None]:
    """Yield ``work`` of each range, in order, worked out by so many forked processes, which inherit what it needs.

    An exception of ``work`` is raised here, in its turn.

    Raises TedsProvisionError if a process ends before its work is done.
    """
    forked: list[_Worker] = []
    try:
        _fork_workers(forked, workers, work)
        if forked:
            yield from _collect(forked, ranges)
        else:  # the system could not start a process
            yield from map(work, ranges)
    finally:
        _end(forked)


@dataclass
class _Worker:
    """One forked process as its parent knows it: the places of the ranges that it has, and what came of its answer."""

    pid: int
    line: socket.socket
    places: deque[int] = field(default_factory=deque)
    received: bytearray = field(default_factory=bytearray)

    def answers(self) -> Iterator[tuple[bool, bytes]]:
        """Take every whole answer from what was received."""
        while len(self.received) >= _ANSWERED.size:
            good, size = _ANSWERED.unpack_from(self.received)
            end = _ANSWERED.size + size
            if len(self.received) < end:
                return
            yield good, bytes(self.received[_ANSWERED.size : end])
            del self.received[:end]


def _fork_workers(forked: list[_Worker], count: int, work: Callable[[range], object]) -> None:
    """Fork processes into ``forked``; fewer if the system gives no more."""
    for _ in range(count):
        here, there = socket.socketpair()
        # Block signals until the child has set its own handlers, or it would run those of the program.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
        try:
            pid = os.fork()
            if not pid:
                _serve(there, [here, *(worker.line for worker in forked)], work)
            forked.append(_Worker(pid, here))
        except OSError:
            here.close()
            return
        finally:
            there.close()
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _serve(line: socket.socket, of_the_parent: Sequence[socket.socket], work: Callable[[range], object]) -> NoReturn:
    """Work on range after range in the forked process, until the parent closes the socket."""
    try:
        # if the child kept them open, other workers would go on waiting after the parent's death
        for end in of_the_parent:
            end.close()
        for number in _ENDING:
            signal.signal(number, signal.SIG_DFL)
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
        gc.freeze()  # the objects of the program are not collected again and again
        gc.set_threshold(_RARELY)
        while len(asked := line.recv(_ASKED.size, socket.MSG_WAITALL)) == _ASKED.size:
            good, octets = _answer(work, range(*_ASKED.unpack(asked)))
            line.sendall(_ANSWERED.pack(good, len(octets)) + octets)
    finally:
        os._exit(0)  # skips the parent's buffers and exit handlers


def _answer(work: Callable[[range], object], places: range) -> tuple[bool, bytes]:
    try:
        return True, pickle.dumps(work(places), pickle.HIGHEST_PROTOCOL)
    except Exception as error:  # noqa: BLE001 - of any kind: raised again in the parent
        try:
            return False, pickle.dumps(error)
        except Exception:  # noqa: BLE001 - an exception with something in it that is bound to this process
            return False, pickle.dumps(RuntimeError(repr(error)))


def _collect(forked: Sequence[_Worker], ranges: Sequence[range]) -> Iterator[Any]:
    """Hand out the ranges, and yield the results in the order of the ranges."""
    results: dict[int, tuple[bool, bytes]] = {}
    handed, due, most = 0, 0, 4 * _AHEAD * len(forked)  # results that wait for an earlier one
    with selectors.DefaultSelector() as selector:
        for worker in forked:
            selector.register(worker.line, selectors.EVENT_READ, worker)
        while due < len(ranges):
            for worker in forked:
                while len(worker.places) < _AHEAD and handed < min(len(ranges), due + most):
                    _hand(worker, handed, ranges[handed])
                    handed += 1
            for key, _ in selector.select():
                _receive(key.data, results)
            while due in results:
                good, octets = results.pop(due)
                if not good:
                    raise pickle.loads(octets)
                yield pickle.loads(octets)
                due += 1


def _hand(worker: _Worker, place: int, places: range) -> None:
    worker.places.append(place)
    with suppress(ConnectionError):  # a read reports that the worker is gone
        worker.line.sendall(_ASKED.pack(places.start, places.stop))


def _receive(worker: _Worker, results: dict[int, tuple[bool, bytes]]) -> None:
    """Take what a worker sent; raises TedsProvisionError if it is gone."""
    try:
        octets = worker.line.recv(1 << 20)
    except ConnectionError:
        octets = b""
    if not octets:
        raise _gone(worker)
    worker.received += octets
    for answer in worker.answers():
        results[worker.places.popleft()] = answer


def _gone(worker: _Worker) -> BaseException:
    """Return the error for a worker that ended before its work was done."""
    status = _wait(worker)
    if os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGINT:
        return KeyboardInterrupt()  # Ctrl-C goes to both processes, and reached this one first
    how = f"was ended by signal {os.WTERMSIG(status)}" if os.WIFSIGNALED(status) else "ended"
    return TedsProvisionError(
        f"A process that judged a part of the files {how}; the files without a line were not judged.",
        hint="Run the command again. If nothing else ended it, the machine has too little memory: give fewer files.",
    )


def _wait(worker: _Worker) -> int:
    pid, worker.pid = worker.pid, 0
    try:
        return os.waitpid(pid, 0)[1]
    except ChildProcessError:  # the program does not wait for its children (SIGCHLD is ignored)
        return 0


def _end(forked: Sequence[_Worker]) -> None:
    """End every worker that is still there."""
    running = [worker for worker in forked if worker.pid]
    for worker in running:
        with suppress(ProcessLookupError):
            os.kill(worker.pid, signal.SIGKILL)
    for worker in forked:
        worker.line.close()
    for worker in running:
        _wait(worker)
