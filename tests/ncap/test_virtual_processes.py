"""The process of a virtual transducer ends with its daemon, however that one ends."""

from __future__ import annotations

import os
import signal
import subprocess
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.ncap.nodes.virtual import Virtual, Virtuals, _die_with
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


def test_a_transducer_whose_process_cannot_be_started_says_so_and_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without memory or descriptors its thread ended without a word, and it was shown as running ever after."""
    events, pauses = list[tuple[str, str]](), list[float]()
    station = SimpleNamespace(home=tmp_path, id="bench")
    live = SimpleNamespace(event=lambda _kind, **facts: events.append((facts["state"], facts["why"])))
    virtuals = Virtuals(cast(Any, station), cast(Any, live))
    one = Virtual("ab", "arm", "noise", tmp_path / "arm")
    one.folder.mkdir()
    virtuals._all["ab"] = one
    runs: list[Any] = [
        OSError(12, "Cannot allocate memory"),
        OSError(24, "Too many open files"),
        [b'{"event":"ready"}\n'],
        [],
        [],
    ]

    def begun(_virtual: Virtual, _words: list[str], log: Path) -> Any:
        run = runs.pop(0)
        if isinstance(run, OSError):
            raise run
        log.write_text("first line\nThe bus is gone.\n")
        return SimpleNamespace(stdout=run, wait=lambda: 0)

    def wait(seconds: float) -> None:
        pauses.append(seconds)
        if not runs:
            virtuals._stop.set()

    monkeypatch.setattr(virtuals, "_begun", begun)
    monkeypatch.setattr(virtuals._stop, "wait", wait)
    virtuals._run(one)
    assert events == [
        ("ended", "It cannot be started: Cannot allocate memory."),
        ("ended", "It cannot be started: Too many open files."),
        ("running", ""),
        ("ended", "The bus is gone."),
        ("ended", "The bus is gone."),
        ("ended", "The bus is gone."),
    ]
    assert pauses == [1.0, 2.0, 1.0, 2.0, 4.0], "one that was ready is started again at once"
    assert (one.state, one.why) == ("ended", "The bus is gone.")
