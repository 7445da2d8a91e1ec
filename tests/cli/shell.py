"""The program as its users run it: by subprocess, or in this process where only the result matters."""

from __future__ import annotations

import atexit
import functools
import io
import json
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from teds_provision.cli.main import run
from tests.bench import PASSPHRASE
from tests.pace import PATIENCE
from tests.zygote import FIRST_FD, ForkedProcess, Zygote, forkable

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = (sys.executable, "-m", "teds_provision")


@dataclass(frozen=True)
class Outcome:
    """How a command ended."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> Any:
        """The one object that stands on stdout; fails where there is more, or less."""
        assert self.out.endswith("\n")
        assert self.out.count("\n") == 1, self.out
        return json.loads(self.out)


class Screen(io.StringIO):
    """A terminal that keeps what is written to it."""

    def isatty(self) -> bool:
        """Return True."""
        return True


def call(home: Path, *words: object, passphrase: str | None = PASSPHRASE, terminal: bool = False) -> Outcome:
    """Run a command in this process; stdin is no terminal, the passphrase comes through --passphrase-fd.

    With ``terminal``, stdout and stderr are one.
    """
    kind = Screen if terminal else io.StringIO
    out, err = kind(), kind()
    before = sys.stdin
    sys.stdin = io.StringIO("")
    read, write = os.pipe()
    given = []
    if passphrase is not None and "--passphrase-fd" not in words:
        given = ["--passphrase-fd", str(read)]
        os.write(write, passphrase.encode() + b"\n")
    os.close(write)
    try:
        with redirect_stdout(out), redirect_stderr(err):
            code = run(["--home", str(home), *given, *map(str, words)])
    finally:
        sys.stdin = before
        os.close(read)
    return Outcome(code, out.getvalue(), err.getvalue())


def clean_environment(**more: str) -> dict[str, str]:
    """Return the environment without what would change the program's mind, and without a keyring."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("TEDS_PROVISION", "PYTHON"))}
    kept |= {"DBUS_SESSION_BUS_ADDRESS": "unix:path=/nonexistent/bus"}
    return kept | more


def unmeasured_environment() -> dict[str, str]:
    """Return a clean environment in which coverage, which loads modules of its own, does not start."""
    return {name: value for name, value in clean_environment().items() if not name.startswith("COVERAGE_")}


def python(code: str, *words: str, **variables: str) -> Outcome:
    """Run code in a Python of its own, which coverage does not measure; fails where the code does."""
    done = subprocess.run(
        [sys.executable, "-c", code, *words],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=True,
        env=unmeasured_environment() | variables,
    )
    return Outcome(done.returncode, done.stdout, done.stderr)


@functools.cache
def zygote() -> Zygote:
    """Return the zygote of this test process: made at the first need, ended with it."""
    made = Zygote(clean_environment())
    atexit.register(made.close)
    return made


@functools.cache
def _of_strangers() -> Zygote:
    """Return the zygote of the strangers, which share nothing with the product: it has imported their node alone."""
    made = Zygote(clean_environment(), module="tests.strangers.node")
    atexit.register(made.close)
    return made


def _zygote_of(program: tuple[str, ...]) -> Zygote | None:
    """Return what to fork for the program, or for a module of the tests or of the strangers; None for anything else."""
    if program[:2] != PROGRAM[:2] or len(program) != len(PROGRAM):
        return None
    if program[2].startswith("tests.strangers."):
        return _of_strangers()
    return zygote() if program == PROGRAM or program[2].startswith("tests.") else None


def begin(
    *words: object,
    out: int,
    err: int,
    passphrase: str | None = None,
    environment: dict[str, str] | None = None,
    cwd: Path | None = None,
    program: tuple[str, ...] = PROGRAM,
    fork: bool = True,
) -> ForkedProcess | subprocess.Popen[bytes]:
    """Start the program as a process of its own that writes to two files; the passphrase goes by --passphrase-fd.

    It, and a module of the tests, is a fork of a zygote where nobody could tell, else (and without ``fork``) a start
    of an interpreter.
    """
    read, write = os.pipe()
    asked = environment if environment is not None else clean_environment()
    ready = _zygote_of(program) if fork else None
    if ready is not None and not forkable(asked, ready.environment):
        ready = None
    given = [] if passphrase is None else ["--passphrase-fd", str(FIRST_FD if ready else read)]
    os.write(write, (passphrase or "").encode() + b"\n")
    os.close(write)
    whole, folder = [*given, *map(str, words)], cwd or Path.cwd()
    try:
        if ready is not None:
            return ready.run(program[-1], whole, asked, out=out, err=err, given=(read,), cwd=folder)
        return subprocess.Popen(
            [*program, *whole],
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=err,
            pass_fds=(read,),
            env=asked,
            cwd=folder,
        )
    finally:
        os.close(read)


def set_passphrase(home: Path, old: str, new: str) -> Outcome:
    """Change the passphrase of a vault file by command."""
    read, write = os.pipe()
    try:
        os.write(write, new.encode() + b"\n")
        os.close(write)
        return call(home, "vault", "passphrase", "--new-passphrase-fd", read, passphrase=old)
    finally:
        os.close(read)


def spawn(
    *words: object,
    passphrase: str | None = None,
    environment: dict[str, str] | None = None,
    program: tuple[str, ...] = PROGRAM,
) -> Outcome:
    """Run the program as a process of its own to its end; ``passphrase`` is given through --passphrase-fd."""
    how: dict[str, Any] = {"passphrase": passphrase, "environment": environment, "program": program}
    with TemporaryFile() as out, TemporaryFile() as err:
        done = begin(*words, out=out.fileno(), err=err.fileno(), **how)
        try:
            code = done.wait(60)
        finally:
            done.kill()
        texts = [os.pread(file.fileno(), os.fstat(file.fileno()).st_size, 0).decode() for file in (out, err)]
    return Outcome(code, *texts)
