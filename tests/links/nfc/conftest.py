from __future__ import annotations

import json
import os
import selectors
import signal
import sys
import time
from collections.abc import Callable, Iterator
from io import FileIO
from pathlib import Path
from typing import Any

import pytest

from tests.cli.shell import begin
from tests.pace import PATIENCE
from tests.places import free_reader

ROOT = Path(__file__).resolve().parents[3]
UUID = "0011223344556677AABB"


class Process:
    """A helper process whose lines of output are waited for."""

    def __init__(self, module: str, argument: str) -> None:
        read, write = os.pipe()
        program = (sys.executable, "-m", f"tests.links.nfc.{module}")
        try:
            self._process = begin(argument, out=write, err=2, cwd=ROOT, program=program)
        finally:
            os.close(write)
        self._out = FileIO(read)
        os.set_blocking(self._out.fileno(), False)
        self._lines: list[str] = []
        self._rest = b""

    def wait_for(self, start: str, seconds: float = PATIENCE) -> str:
        """Return the next line that begins with ``start``."""
        until = time.monotonic() + seconds
        with selectors.DefaultSelector() as selector:
            selector.register(self._out, selectors.EVENT_READ)
            while True:
                while self._lines:
                    if (line := self._lines.pop(0)).startswith(start):
                        return line
                assert time.monotonic() < until, f"no line {start!r}"
                if selector.select(0.2):
                    chunk = self._out.read() or b""
                    assert chunk or self._process.poll() is None, f"ended before {start!r}"
                    *lines, self._rest = (self._rest + chunk).split(b"\n")
                    self._lines += [line.decode() for line in lines]

    def signal(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self, seconds: float = PATIENCE) -> int:
        return self._process.wait(seconds)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait(PATIENCE)

    def end(self) -> None:
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(PATIENCE)

    def close(self) -> None:
        if self._process.poll() is None:
            self.kill()
        self._out.close()


StartNode = Callable[..., Process]


@pytest.fixture
def path() -> str:
    """Return a simulated reader that no other test uses."""
    return free_reader()


@pytest.fixture
def start() -> Iterator[Callable[[str, str], Process]]:
    running: list[Process] = []

    def run(module: str, argument: str) -> Process:
        running.append(Process(module, argument))
        return running[-1]

    yield run
    for process in running:
        process.close()


@pytest.fixture
def start_node(start: Callable[[str, str], Process], path: str) -> StartNode:
    """Start an echo node on ``path`` and wait until it lies there."""

    def run(*, ready: bool = True, **options: Any) -> Process:
        node = start("echo_node", json.dumps({"path": path, "uuid": UUID, **options}))
        if ready:
            node.wait_for("ready")
        return node

    return run
