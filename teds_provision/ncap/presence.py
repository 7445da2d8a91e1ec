"""One daemon per home: its lock, and the Unix socket by which the command line reaches it."""

from __future__ import annotations

import fcntl
import os
import socket
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Final

from teds_provision.client import SOCKET
from teds_provision.errors import StoreLocked
from teds_provision.files import listen_alone

LOCK: Final = "ncap.lock"


class Presence:
    """``with Presence(home):`` is the one daemon of this home; raises StoreLocked (7) where there is one."""

    def __init__(self, home: Path) -> None:
        self._home = home
        self._descriptor = -1

    def __enter__(self) -> Presence:
        descriptor = os.open(self._home / LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            pid = os.pread(descriptor, 20, 0).decode(errors="replace").strip()
            os.close(descriptor)
            raise StoreLocked(
                f"The base station of {self._home} runs already (pid {pid or 'unknown'}).",
                hint="See it: teds-provision ncap status. End it: kill -TERM its pid.",
            ) from None
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"{os.getpid()}\n".encode(), 0)
        self._descriptor = descriptor
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with suppress(OSError):
            (self._home / SOCKET).unlink()
        with suppress(OSError):
            os.ftruncate(self._descriptor, 0)
        os.close(self._descriptor)

    def listen(self) -> socket.socket:
        """The listening Unix socket, for this user alone; what a killed daemon left is replaced."""
        return listen_alone(self._home / SOCKET, 128)
