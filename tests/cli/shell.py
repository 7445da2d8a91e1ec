"""The program as its users run it: by subprocess, or in this process where only the result matters."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from teds_provision.cli.main import run
from tests.bench import PASSPHRASE


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


def call(home: Path, *words: object, passphrase: str | None = PASSPHRASE) -> Outcome:
    """Run a command in this process; stdin is no terminal, the passphrase comes through --passphrase-fd."""
    out, err = io.StringIO(), io.StringIO()
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
    """The environment without what would change the program's mind, and without a keyring."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("TEDS_PROVISION", "PYTHON"))}
    kept |= {"DBUS_SESSION_BUS_ADDRESS": "unix:path=/nonexistent/bus"}
    return kept | more


def unmeasured_environment() -> dict[str, str]:
    """A clean environment in which coverage, which loads modules of its own, does not start."""
    return {name: value for name, value in clean_environment().items() if not name.startswith("COVERAGE_")}


def spawn(*words: object, passphrase: str | None = None, environment: dict[str, str] | None = None) -> Outcome:
    """Run the program as a process of its own; ``passphrase`` is given through --passphrase-fd."""
    command = [sys.executable, "-m", "teds_provision"]
    read, write = os.pipe()
    if passphrase is not None:
        command += ["--passphrase-fd", str(read)]
        os.write(write, passphrase.encode() + b"\n")
    os.close(write)
    try:
        done = subprocess.run(
            [*command, *map(str, words)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=60,
            check=False,
            pass_fds=(read,),
            env=environment or clean_environment(),
        )
    finally:
        os.close(read)
    return Outcome(done.returncode, done.stdout, done.stderr)
