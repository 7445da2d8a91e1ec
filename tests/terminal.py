"""The program on a pseudo-terminal: what a person sees there, and answers that are typed where it asks."""

from __future__ import annotations

import fcntl
import os
import pty
import selectors
import struct
import subprocess
import sys
import termios
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tests.cli.shell import clean_environment, zygote
from tests.zygote import FIRST_FD, ForkedProcess, forkable

PATIENCE = 60.0
STREAMS = ("stdin", "stdout", "stderr")


@dataclass(frozen=True)
class TerminalOutcome:
    """How a command ended; ``screen`` is what stood on the terminal, ``out`` and ``err`` what went elsewhere."""

    code: int
    screen: str
    out: str
    err: str


def on_terminal(
    home: Path,
    *words: object,
    streams: Collection[str] = STREAMS,
    answers: Sequence[str] = (),
    passphrase: str | None = None,
    columns: int | None = None,
    environment: dict[str, str] | None = None,
) -> TerminalOutcome:
    """Run a command with these streams on a terminal, the others in pipes; each answer is typed at a prompt of its own.

    A prompt ends with a colon, maybe with "[y/N]" before it; what is typed earlier the program throws away.
    """
    ours, theirs = pty.openpty()
    read, write = os.pipe()
    os.write(write, (passphrase or "").encode() + b"\n")
    os.close(write)
    variables = environment or clean_environment()
    if columns is not None:
        fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 40, columns, 0, 0))
        # What the variables say would count more than the terminal itself.
        variables = {name: value for name, value in variables.items() if name not in ("COLUMNS", "LINES")}
    places, ends = {"screen": ours}, {"stdin": theirs if "stdin" in streams else os.open(os.devnull, os.O_RDONLY)}
    for name, short in (("stdout", "out"), ("stderr", "err")):
        if name in streams:
            ends[name] = theirs
        else:
            places[short], ends[name] = os.pipe()
    process = _begun(["--home", str(home), *map(str, words)], variables, ends, read if passphrase is not None else None)
    for end in {theirs, read, *ends.values()}:
        os.close(end)
    try:
        seen = _conversation(places, list(answers))
        code = process.wait(PATIENCE)
    finally:
        process.kill()
        process.wait(PATIENCE)
        for place in places.values():
            os.close(place)
    return TerminalOutcome(
        code, *(seen[name].decode(errors="replace").replace("\r\n", "\n") for name in ("screen", "out", "err"))
    )


def _begun(
    words: list[str], variables: dict[str, str], ends: dict[str, int], secret: int | None
) -> ForkedProcess | subprocess.Popen[bytes]:
    """Start the program in a session of its own: a fork if nobody can see the difference, else an interpreter."""
    fork = forkable(variables, zygote().environment)
    given = () if secret is None else (secret,)
    if secret is not None:
        words = ["--passphrase-fd", str(FIRST_FD if fork else secret), *words]
    if fork:
        more: dict[str, Any] = {"out": ends["stdout"], "err": ends["stderr"], "stdin": ends["stdin"], "given": given}
        return zygote().run("teds_provision", words, variables, cwd=Path.cwd(), **more)
    command = [sys.executable, "-m", "teds_provision", *words]
    how: dict[str, Any] = {"pass_fds": given, "env": variables, "start_new_session": True, **ends}
    return subprocess.Popen(command, **how)


def _conversation(places: dict[str, int], answers: list[str]) -> dict[str, bytes]:
    """Read everything until the program has closed it all; type an answer wherever it asks."""
    seen, answered = dict.fromkeys(("screen", "out", "err"), b""), dict.fromkeys(("screen", "out", "err"), 0)
    until = time.monotonic() + PATIENCE
    with selectors.DefaultSelector() as selector:
        for name, place in places.items():
            selector.register(place, selectors.EVENT_READ, name)
        while selector.get_map():
            found = selector.select(max(0.0, until - time.monotonic()))
            assert found, ("the program says nothing more, and does not end", seen)
            for key, _ in found:
                try:
                    octets = os.read(key.fd, 65536)
                except OSError:  # EIO: the other end of the terminal is closed
                    octets = b""
                if not octets:
                    selector.unregister(key.fileobj)
                seen[key.data] += octets
                if answers and seen[key.data][answered[key.data] :].strip().endswith(b":"):
                    answered[key.data] = len(seen[key.data])
                    os.write(places["screen"], answers.pop(0).encode() + b"\n")
    return seen
