"""Several boards at once: order, limits, and an end that waits for no thread."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time

import pytest

from teds_provision.provisioning.parallel import ParallelWork
from tests.cli.shell import ROOT
from tests.pace import PATIENCE

ENDS = """
import threading
from teds_provision.provisioning.parallel import ParallelWork
asked = threading.Event()
def wait_for_good(item):
    if item:
        asked.set()
        threading.Event().wait()
work = ParallelWork([0, 1, 2], wait_for_good, at_once=2, name="node")
try:
    for done in work.results():
        asked.wait()
        print("one is waited for", flush=True)
except KeyboardInterrupt:
    work.drop_waiting()
    work.wait(0.1)
    raise SystemExit(130)
"""


def test_no_more_than_allowed_run_at_a_time_and_each_item_comes_back_once() -> None:
    running, most, lock = 0, 0, threading.Lock()

    def work(item: int) -> int:
        nonlocal running, most
        with lock:
            running += 1
            most = max(most, running)
        time.sleep(0.01)
        with lock:
            running -= 1
        return item * item

    results = {done.item: done.result() for done in ParallelWork(range(12), work, at_once=3, name="node").results()}

    assert results == {item: item * item for item in range(12)}
    assert most == 3


def test_an_error_is_raised_where_the_result_is_read_and_the_others_go_on() -> None:
    def work(item: int) -> int:
        return 12 // item

    done = {result.item: result for result in ParallelWork([0, 3, 4], work, at_once=2, name="node").results()}

    with pytest.raises(ZeroDivisionError):
        done[0].result()
    assert done[3].result() == 4
    assert done[4].result() == 3


def test_what_was_not_begun_is_dropped_and_what_was_begun_is_finished() -> None:
    begun: list[int] = []

    def work(item: int) -> int:
        begun.append(item)
        return item

    team = ParallelWork(range(100), work, at_once=1, name="node")
    seen = []
    for done in team.results():
        seen.append(done.item)
        team.drop_waiting()

    assert seen == begun


def test_ctrl_c_ends_a_process_of_which_a_thread_waits_for_ever() -> None:
    """A pool of the library has its threads waited for when the interpreter ends."""
    with subprocess.Popen([sys.executable, "-c", ENDS], stdout=subprocess.PIPE, cwd=ROOT) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == b"one is waited for\n"
            process.send_signal(signal.SIGINT)
            assert process.wait(PATIENCE) == 130
        finally:
            process.kill()
