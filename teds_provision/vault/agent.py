"""``unlock``: a process that keeps the vault's secret, only in memory, until its time is over or ``lock``.

Commands ask it over a Unix socket of mode 0600 in the home, and each side looks at who is at the other end
(SO_PEERCRED). Linux only. A request is one octet. ``S``: kind (one octet) ‖ secret, to the end of the stream. ``T``:
seconds left, u32. ``L``: nothing, the stream ends when the secret is gone.
"""

from __future__ import annotations

import mmap
import os
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

from teds_provision.errors import VaultError
from teds_provision.files import listen_alone, short_path
from teds_provision.lazy import late
from teds_provision.vault.hardening import harden

if TYPE_CHECKING:
    import ctypes
else:  # only the process that holds the secret needs ctypes; the commands that ask it start faster without
    ctypes = late("ctypes")

SOCKET: Final = "agent.sock"
SECRET, TIME, END = b"S", b"T", b"L"
KINDS: Final = {"file": b"F", "pkcs11": b"P"}
MOST_OCTETS: Final = 1024
MOST_SECONDS: Final = 12 * 3600
_ANSWER_SECONDS: Final = 3.0


def held(home: Path, kind: str) -> bytes | None:
    """Return the secret that opens the vault of this kind, None if no agent holds it."""
    answer = _ask(home, SECRET)
    return answer[1:] if answer[:1] == KINDS[kind] and len(answer) > 1 else None


def seconds_left(home: Path) -> int | None:
    """Return for how many more seconds the vault stays open, None if it is not open."""
    answer = _ask(home, TIME)
    return struct.unpack(">I", answer)[0] if len(answer) == 4 else None


def lock(home: Path) -> bool:
    """Wipe the agent's secret and end its process; False if there was none."""
    there = seconds_left(home) is not None
    _ask(home, END)
    return there


def start(home: Path, kind: str, secret: bytes, seconds: int) -> None:
    """Hold ``secret`` for the given number of seconds in a separate process; a running agent ends first.

    Raises VaultError if this system has no such sockets, or the process does not start.
    """
    if not hasattr(socket, "SO_PEERCRED"):
        raise VaultError("unlock requires Linux: this system does not identify the peer of a socket.")
    lock(home)
    package = Path(__file__).parents[2]
    # -P and an appended path: neither the user's working directory nor our folder comes before the standard library.
    code = f"import sys; sys.path.append({str(package)!r}); from teds_provision.vault import agent; agent.main()"
    command = [sys.executable, "-P", "-c", code, str(home.resolve()), str(seconds)]
    process = subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        cwd="/",
        start_new_session=True,  # Ctrl-C and the end of the terminal must not reach the agent
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
        raise VaultError(f"The vault cannot be kept open: {SOCKET} in {home} does not come up.")


def _ask(home: Path, request: bytes) -> bytes:
    """Return the whole answer; empty if no process of this user listens."""
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
    """Return the uid of the process at the other end, as the kernel recorded it (socket(7), SO_PEERCRED)."""
    _, uid, _ = struct.unpack("3i", line.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i")))
    return int(uid)


# The agent process: started by ``unlock``, it exits when its time is over.
#
# The secret comes through stdin straight into one page of memory that is locked (mlock), excluded from core dumps and
# child processes, and zeroed at the end. Other processes of the same user cannot trace the agent, and it leaves no core
# dump. Its time goes on while the machine sleeps.

_LOOK_SECONDS: Final = 20.0
"""Seconds between checks of the clock: a wait stops while the machine sleeps, the clock does not."""
_CLIENT_SECONDS: Final = 2.0


def main() -> None:
    """Hold the secret of standard input; arguments: the home, and for how many seconds."""
    home, seconds = Path(sys.argv[1]), int(sys.argv[2])
    harden()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, _end)
    page = LockedPage()
    path = home / SOCKET
    try:
        page.read(0)
        listener = listen_alone(path, 16)
        ours = path.stat().st_ino
        os.write(1, b"ready\n")
        # Close the pipes to the process that started this one.
        null = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(null, descriptor)
        os.close(null)
        try:
            serve(listener, page, _now() + seconds)
        finally:
            with suppress(OSError):
                if path.stat().st_ino == ours:
                    path.unlink()
            listener.close()
    finally:
        page.wipe()


class LockedPage:
    """One page of memory for one secret of at most 1024 octets."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self._length = 0
        address = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        self.locked = ctypes.CDLL(None).mlock(ctypes.c_void_p(address), ctypes.c_size_t(mmap.PAGESIZE)) == 0
        """True if the page stays out of swap; a system limit may forbid that (ulimit -l)."""
        for advice in ("MADV_DONTDUMP", "MADV_DONTFORK"):
            with suppress(OSError, AttributeError):
                self._memory.madvise(getattr(mmap, advice))

    def read(self, descriptor: int) -> None:
        """Take in all that a pipe holds, without a copy in Python's own memory; raises ValueError for too much."""
        view = memoryview(self._memory)
        while got := os.readv(descriptor, [view[self._length :]]):
            self._length += got
            if self._length > MOST_OCTETS:
                raise ValueError("longer than any secret")

    def view(self) -> memoryview:
        """Return the secret in place, without copying it."""
        return memoryview(self._memory)[: self._length]

    def wipe(self) -> None:
        """Fill the page with zeros."""
        ctypes.memset(ctypes.addressof(ctypes.c_char.from_buffer(self._memory)), 0, mmap.PAGESIZE)
        self._length = 0


def serve(listener: socket.socket, page: LockedPage, until: float) -> None:
    """Answer this user's commands until the time is over or one asks to end; then wipe the page."""
    try:
        while (left := until - _now()) > 0:
            if select.select([listener], [], [], min(left, _LOOK_SECONDS))[0]:
                line, _ = listener.accept()
                with line, suppress(OSError):
                    if not _answer(line, page, until):
                        return
    finally:
        page.wipe()


def _answer(line: socket.socket, page: LockedPage, until: float) -> bool:
    """Serve one command; return False if the secret has to be wiped."""
    line.settimeout(_CLIENT_SECONDS)
    if user_at(line) != os.geteuid():
        return True
    request, left = line.recv(1), until - _now()
    if left <= 0 or request == END:
        page.wipe()  # before the connection closes: to the other side, that means that the secret is gone
        return False
    if request == SECRET:
        line.sendall(page.view())
    elif request == TIME:
        line.sendall(struct.pack(">I", int(left)))
    return True


def _now() -> float:
    """Return seconds of a clock that also runs while the machine sleeps."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def _end(number: int, frame: object) -> NoReturn:
    raise SystemExit(0)
