"""The workers of a bus: jobs of one link in order, links side by side, and an end that waits for what runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace

import pytest

from teds_provision.node.can import endpoint
from teds_provision.node.worker_pool import WorkerPool

_SECONDS = 30.0


def test_jobs_of_a_line_run_in_order_and_one_at_a_time() -> None:
    workers = WorkerPool(8)
    queue, done, running, all_done = workers.new_queue(), [], threading.Semaphore(1), threading.Event()

    def job(number: int) -> Callable[[], None]:
        def run() -> None:
            assert running.acquire(blocking=False), "two jobs of one line at once"
            done.append(number)
            running.release()
            if number == 199:
                all_done.set()

        return run

    for number in range(200):
        queue.put(job(number))
    assert all_done.wait(_SECONDS)
    workers.end()
    assert done == list(range(200))


def test_lines_run_side_by_side_as_far_as_there_are_threads() -> None:
    workers, most = WorkerPool(4), 4
    together = threading.Barrier(most)
    met = threading.Semaphore(0)

    def meet() -> None:
        together.wait(_SECONDS)
        met.release()

    for _ in range(3):  # threads that are free again take the next ones
        for _ in range(most):
            workers.new_queue().put(meet)
        for _ in range(most):
            assert met.acquire(timeout=_SECONDS)
    workers.end()


def test_more_lines_than_threads_all_get_their_turn() -> None:
    workers, lines = WorkerPool(2), 20
    go, ran = threading.Event(), threading.Semaphore(0)
    threads: set[str] = set()

    def job() -> None:
        assert go.wait(_SECONDS)
        threads.add(threading.current_thread().name)
        ran.release()

    for _ in range(lines):
        workers.new_queue().put(job)
    go.set()
    for _ in range(lines):
        assert ran.acquire(timeout=_SECONDS)
    workers.end()
    assert len(threads) <= 2


def test_a_job_that_fails_costs_no_thread_and_no_line(caplog: pytest.LogCaptureFixture) -> None:
    workers, ran = WorkerPool(1), threading.Event()
    queue = workers.new_queue()
    queue.put(lambda: {}[0])
    queue.put(ran.set)
    assert ran.wait(_SECONDS)
    workers.end()
    assert "A node's command failed." in caplog.text


def test_a_job_of_no_line_that_fails_leaves_its_thread_to_the_next(caplog: pytest.LogCaptureFixture) -> None:
    workers, ran = WorkerPool(1), threading.Event()
    workers.run(lambda: {}[0])
    workers.run(ran.set)
    assert ran.wait(_SECONDS)
    workers.end()
    assert caplog.messages == ["A node's command failed."]
    workers.run(ran.clear)
    assert (workers._threads, workers._work.empty()) == ([], True), "after the end nothing happens"


def test_the_end_waits_for_what_runs_and_drops_the_rest() -> None:
    workers, began, go = WorkerPool(1), threading.Event(), threading.Event()
    ended: list[str] = []

    def slow() -> None:
        began.set()
        assert go.wait(_SECONDS)
        ended.append("slow")

    workers.new_queue().put(slow)
    assert began.wait(_SECONDS)
    workers.new_queue().put(lambda: ended.append("never"))
    over = threading.Thread(target=workers.end)
    over.start()
    until = time.monotonic() + _SECONDS
    while not workers._ended and time.monotonic() < until:
        time.sleep(0.001)
    go.set()  # not before: a thread that is free would still take the next job
    over.join(_SECONDS)
    assert not over.is_alive()
    workers.new_queue().put(lambda: ended.append("after the end"))
    assert ended == ["slow"]


def test_a_stored_reply_is_kept_from_its_end_however_long_the_command_ran(monkeypatch: pytest.MonkeyPatch) -> None:
    """A commit takes seconds: counted from the request's arrival the repetition of a slow one was run again."""
    now = [100.0]
    monkeypatch.setattr(endpoint, "time", SimpleNamespace(monotonic=lambda: now[0]))
    ran = []

    def slow(_link: str, frame: bytes, *, tapped: bool) -> bytes:
        ran.append(frame)
        now[0] += 8
        return b"\x80"

    handler = SimpleNamespace(request=slow)
    node = SimpleNamespace(measuring_handler=None, handler=handler, counts_as_tapped=lambda: False)
    line = endpoint.StationState(node, 0xF1, SimpleNamespace(put=lambda job: job()))  # type: ignore[arg-type]
    request = endpoint.EndpointRequest(bytes.fromhex("01 8010 0000".replace(" ", "")), fd=False, received=0)
    first = line.answer(request)
    now[0] += 4  # its last frame is taken
    line.reply_sent()
    now[0] += 19.9
    assert (line.answer(request), len(ran)) == (first, 1)
    now[0] += 20
    line.answer(request)
    assert len(ran) == 2
