"""What scenes share: the program in this very process (Python starts in 10 s here), stations, nodes, commands."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from teds_provision.cli import main as command_line
from tests.bench import PASSPHRASE, make_station
from tests.system.machine import report

FOLDER = Path(tempfile.mkdtemp(prefix="scene"))


@dataclass
class Outcome:
    """A command that ran: exit code, output, what was told on stderr."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """Its one object."""
        return json.loads(self.out)

    @property
    def lines(self) -> list[Any]:
        """Its lines of JSON."""
        return [json.loads(line) for line in self.out.splitlines()]


class Bench:
    """A station's home, and the program that works on it."""

    def __init__(self, name: str = "bench") -> None:
        self.home = FOLDER / name
        make_station(self.home, name).close()

    def run(self, *words: object) -> Outcome:
        """Run a command in this process."""
        read, write = os.pipe()
        os.write(write, PASSPHRASE.encode() + b"\n")
        os.close(write)
        out, err = io.TextIOWrapper(io.BytesIO(), encoding="utf-8"), io.StringIO()
        given = ["--home", self.home, "--passphrase-fd", read, "--json", *words]
        try:
            with redirect_stdout(out), redirect_stderr(err):
                code = command_line.run([str(word) for word in given])
        finally:
            os.close(read)
        out.flush()
        return Outcome(code, out.buffer.getvalue().decode(), err.getvalue())  # type: ignore[attr-defined]


@contextmanager
def process(*words: object) -> Iterator[subprocess.Popen[str]]:
    """Yield a process that is ended by its id."""
    running = subprocess.Popen([str(word) for word in words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        yield running
    finally:
        running.terminate()
        try:
            running.wait(20)
        except subprocess.TimeoutExpired:
            running.kill()


def program(*words: object) -> list[object]:
    """Return the command line as a process of its own."""
    return [sys.executable, "-m", "teds_provision", *words]


def look(name: str, what: Callable[[], dict[str, Any]]) -> None:
    """Do one thing of the scene and tell how it came out; what it raises is told, and the scene goes on."""
    began = time.monotonic()
    try:
        state = what()
    except BaseException as error:  # noqa: BLE001 - told to the test
        report(name, error=repr(error)[:2000], trace=traceback.format_exc()[-3000:])
        return
    report(name, seconds=round(time.monotonic() - began, 1), **state)


def sh(*words: str) -> str:
    """Run a program of the system."""
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    return done.stdout + done.stderr


def later(seconds: float, what: Callable[[], object]) -> threading.Timer:
    """Do something in so many seconds."""
    timer = threading.Timer(seconds, what)
    timer.daemon = True
    timer.start()
    return timer
