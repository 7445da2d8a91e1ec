"""The crew of a bus: jobs of a line in order, lines side by side, and an end that waits for what runs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from teds_provision.node.handler import Crew

_SECONDS = 30.0


def test_jobs_of_a_line_run_in_order_and_one_at_a_time() -> None:
    crew = Crew(8)
    turns, done, running, all_done = crew.turns(), [], threading.Semaphore(1), threading.Event()

    def job(number: int) -> Callable[[], None]:
        def run() -> None:
            assert running.acquire(blocking=False), "two jobs of one line at once"
            done.append(number)
            running.release()
            if number == 199:
                all_done.set()

        return run

    for number in range(200):
        turns.put(job(number))
    assert all_done.wait(_SECONDS)
    crew.end()
    assert done == list(range(200))


def test_lines_run_side_by_side_as_far_as_there_are_threads() -> None:
    crew, most = Crew(4), 4
    together = threading.Barrier(most)
    met = threading.Semaphore(0)

    def meet() -> None:
        together.wait(_SECONDS)
        met.release()

    for _ in range(3):  # threads that are free again take the next ones
        for _ in range(most):
            crew.turns().put(meet)
        for _ in range(most):
            assert met.acquire(timeout=_SECONDS)
    crew.end()


def test_more_lines_than_threads_all_get_their_turn() -> None:
    crew, lines = Crew(2), 20
    go, ran = threading.Event(), threading.Semaphore(0)
    threads: set[str] = set()

    def job() -> None:
        assert go.wait(_SECONDS)
        threads.add(threading.current_thread().name)
        ran.release()

    for _ in range(lines):
        crew.turns().put(job)
    go.set()
    for _ in range(lines):
        assert ran.acquire(timeout=_SECONDS)
    crew.end()
    assert len(threads) <= 2


def test_a_job_that_fails_costs_no_thread_and_no_line(caplog: pytest.LogCaptureFixture) -> None:
    crew, ran = Crew(1), threading.Event()
    turns = crew.turns()
    turns.put(lambda: {}[0])
    turns.put(ran.set)
    assert ran.wait(_SECONDS)
    crew.end()
    assert "A node's command failed." in caplog.text


def test_the_end_waits_for_what_runs_and_drops_the_rest() -> None:
    crew, began, go = Crew(1), threading.Event(), threading.Event()
    ended: list[str] = []

    def slow() -> None:
        began.set()
        assert go.wait(_SECONDS)
        ended.append("slow")

    crew.turns().put(slow)
    assert began.wait(_SECONDS)
    crew.turns().put(lambda: ended.append("never"))
    over = threading.Thread(target=crew.end)
    over.start()
    until = time.monotonic() + _SECONDS
    while not crew._ended and time.monotonic() < until:
        time.sleep(0.001)
    go.set()  # not before: a thread that is free would still take the next job
    over.join(_SECONDS)
    assert not over.is_alive()
    crew.turns().put(lambda: ended.append("after the end"))
    assert ended == ["slow"]
