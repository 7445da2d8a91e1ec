"""What a command says to the process that holds the vault open: give what you hold, how long still, end.

A request is one octet. ``S``: kind (one octet) ‖ secret, to the end of the stream. ``T``: seconds left, u32.
``L``: nothing, the stream ends when the secret is gone.
"""

from __future__ import annotations

import os
import socket
import struct
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from teds_provision.errors import VaultFailure
from teds_provision.files import short_path

SOCKET: Final = "agent.sock"
SECRET, TIME, END = b"S", b"T", b"L"
KINDS: Final = {"file": b"F", "pkcs11": b"P"}
MOST_OCTETS: Final = 1024
MOST_SECONDS: Final = 12 * 3600
_ANSWER_SECONDS: Final = 3.0


def held(home: Path, kind: str) -> bytes | None:
    """What opens the vault of this kind, None where nobody holds it open."""
    answer = _asked(home, SECRET)
    return answer[1:] if answer[:1] == KINDS[kind] and len(answer) > 1 else None


def seconds_left(home: Path) -> int | None:
    """How long the vault is still held open, None where it is not."""
    answer = _asked(home, TIME)
    return struct.unpack(">I", answer)[0] if len(answer) == 4 else None


def lock(home: Path) -> bool:
    """Have the secret wiped and the process end; False where there was none."""
    there = seconds_left(home) is not None
    _asked(home, END)
    return there


def start(home: Path, kind: str, secret: bytes, seconds: int) -> None:
    """Hold ``secret`` for so many seconds, in a process of its own; one that is there ends first.

    Raises VaultFailure where this system has no such sockets, or the process does not come up.
    """
    if not hasattr(socket, "SO_PEERCRED"):
        raise VaultFailure("This system does not say who is at the other end of a socket: unlock needs Linux.")
    lock(home)
    package = Path(__file__).parents[3]
    # -P and an appended folder: neither the folder that the user is in, nor ours, comes before Python's own modules.
    code = (
        f"import sys; sys.path.append({str(package)!r}); from teds_provision.vault.agent import holding; holding.main()"
    )
    command = [sys.executable, "-P", "-c", code, str(home.resolve()), str(seconds)]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd="/",
        start_new_session=True,  # the terminal's Ctrl-C and its end are not for it
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        with suppress(BrokenPipeError), process.stdin as stream:
            stream.write(KINDS[kind] + secret)
        ready = process.stdout.readline()
    finally:
        process.stdout.close()
    if ready != b"ready\n":
        process.kill()
        process.wait()
        raise VaultFailure(f"The vault cannot be held open: {SOCKET} in {home} does not come up.")


def _asked(home: Path, request: bytes) -> bytes:
    """The whole answer; empty where nobody of this user's own listens."""
    path = home / SOCKET
    if not path.is_socket() or not hasattr(socket, "SO_PEERCRED"):
        return b""
    answer = b""
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line, short_path(path) as name:
        line.settimeout(_ANSWER_SECONDS)
        line.connect(name)
        if user_at(line) != os.geteuid():
            return b""
        line.sendall(request)
        while len(answer) <= MOST_OCTETS and (more := line.recv(MOST_OCTETS)):
            answer += more
    return answer


def user_at(line: socket.socket) -> int:
    """The uid of the process at the other end, as the kernel noted it (socket(7), SO_PEERCRED)."""
    _, uid, _ = struct.unpack("3i", line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    return int(uid)
