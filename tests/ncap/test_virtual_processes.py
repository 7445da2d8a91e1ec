"""The process of a virtual transducer ends with its daemon, however that one ends."""

from __future__ import annotations

import os
import signal
import subprocess
import threading

from teds_provision.ncap.nodes.virtual import _die_with
from tests.pace import PATIENCE


def test_a_node_dies_with_its_daemon() -> None:
    """The system counts the thread that started a process as its parent: here one that ends at once."""
    started: list[subprocess.Popen[bytes]] = []
    daemon = os.getpid()

    def start() -> None:
        started.append(
            subprocess.Popen(["sleep", "600"], preexec_fn=lambda: _die_with(daemon))  # noqa: PLW1509 - as the daemon does
        )

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    (process,) = started
    try:
        assert process.wait(PATIENCE) == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()


def test_a_node_whose_daemon_died_before_it_asked_to_die_with_it_ends_at_once() -> None:
    """By then it has another parent, whose end it would wait for."""
    other = os.getppid()
    process = subprocess.Popen(["true"], preexec_fn=lambda: _die_with(other))  # noqa: PLW1509 - as the daemon does
    assert process.wait(PATIENCE) == 1
