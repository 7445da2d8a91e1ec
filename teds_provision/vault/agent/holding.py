"""The process that holds what opens the vault: started by ``unlock``, gone when its time is over.

The secret comes through standard input straight into one page of memory that is locked (mlock), left out of dumps and
of children, and filled with zeros at the end. The process cannot be traced by others of the same user and leaves no
core dump. Its time runs on while the machine sleeps.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import select
import signal
import socket
import struct
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Final, NoReturn

from teds_provision.files import listen_alone
from teds_provision.vault.agent.asking import END, MOST_OCTETS, SECRET, SOCKET, TIME, user_at
from teds_provision.vault.hardening import harden

_LOOK_SECONDS: Final = 20.0
"""A sleeping machine stops the wait, not the clock: so often it is looked at again."""
_CLIENT_SECONDS: Final = 2.0


def main() -> None:
    """Hold the secret of standard input; arguments: the home, and for how many seconds."""
    home, seconds = Path(sys.argv[1]), int(sys.argv[2])
    harden()
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, _end)
    page = Page()
    path = home / SOCKET
    try:
        page.read(0)
        listener = listen_alone(path, 16)
        ours = path.stat().st_ino
        os.write(1, b"ready\n")
        _give_up_streams()
        try:
            serve(listener, page, _now() + seconds)
        finally:
            with suppress(OSError):
                if path.stat().st_ino == ours:
                    path.unlink()
            listener.close()
    finally:
        page.wipe()


class Page:
    """One page of memory for one secret of at most 1024 octets."""

    def __init__(self) -> None:
        self._memory = mmap.mmap(-1, mmap.PAGESIZE)
        self._length = 0
        address = ctypes.addressof(ctypes.c_char.from_buffer(self._memory))
        self.locked = ctypes.CDLL(None).mlock(ctypes.c_void_p(address), ctypes.c_size_t(mmap.PAGESIZE)) == 0
        """Whether it stays out of the swap: a limit of the system may forbid that (ulimit -l)."""
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
        """The secret, where it lies."""
        return memoryview(self._memory)[: self._length]

    def wipe(self) -> None:
        """Fill the page with zeros."""
        ctypes.memset(ctypes.addressof(ctypes.c_char.from_buffer(self._memory)), 0, mmap.PAGESIZE)
        self._length = 0


def serve(listener: socket.socket, page: Page, until: float) -> None:
    """Answer this user's commands until the time is over, or one says to end; the page is wiped then."""
    try:
        while (left := until - _now()) > 0:
            if select.select([listener], [], [], min(left, _LOOK_SECONDS))[0]:
                line, _ = listener.accept()
                with line, suppress(OSError):
                    if not _answer(line, page, until):
                        return
    finally:
        page.wipe()


def _answer(line: socket.socket, page: Page, until: float) -> bool:
    """Serve one command; False where the secret is to go."""
    line.settimeout(_CLIENT_SECONDS)
    if user_at(line) != os.geteuid():
        return True
    request, left = line.recv(1), until - _now()
    if left <= 0 or request == END:
        page.wipe()  # before the stream ends, which tells the other side that it is gone
        return False
    if request == SECRET:
        line.sendall(page.view())
    elif request == TIME:
        line.sendall(struct.pack(">I", int(left)))
    return True


def _give_up_streams() -> None:
    """Let go of whoever started this: no pipe of theirs stays open."""
    null = os.open(os.devnull, os.O_RDWR)
    for descriptor in (0, 1, 2):
        os.dup2(null, descriptor)
    os.close(null)


def _now() -> float:
    """Seconds of a clock that runs on while the machine sleeps."""
    return time.clock_gettime(getattr(time, "CLOCK_BOOTTIME", time.CLOCK_MONOTONIC))


def _end(number: int, frame: object) -> NoReturn:
    raise SystemExit(0)
