"""Advisory locks: one command at a time changes a store, and one at a time works on a node.

The store's (flock) names its holder; a node's is one octet of a file, taken by number. Without flock an empty SQLite
file beside it is locked exclusively instead: the store relies on SQLite's locks on every system.

The kernel releases it when the holder ends, however it ends; the holder's name in the file counts only while the lock
is held.
"""

from __future__ import annotations

import hashlib
import json
import os
import struct
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

from teds_provision.errors import NodeBusyError, StoreError, StoreLockedError
from teds_provision.lazy import late
from teds_provision.portable import CLOSING, HAS_LOCKS, NOFOLLOW, lock
from teds_provision.station.store.connection import as_store_failure
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.sqlite import sqlite3

if TYPE_CHECKING:
    import fcntl
else:  # Windows has no fcntl, and uses no nodes
    fcntl = late("fcntl")

FILE_NAME = "store.lock"
TURNS_NAME = "store.turns"
OWNERS_NAME = "store.owners"
_TURN_SECONDS = 60.0
_FIRST_POLL_SECONDS = 0.001
_LAST_QUIET_POLL_SECONDS = 0.004
_POLL_SECONDS = 0.05
_SIGNATURE_OCTETS = 256
_quoted = json.encoder.encode_basestring_ascii


@lru_cache(maxsize=4)
def _beside(home: Path, name: str) -> Path:
    """Return the file of a home, made once: a run of steps takes the store six times."""
    return home / name


class _HeldFile(ABC):
    """A file that is locked for as long as the ``with`` lasts."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._descriptor: int | None = None

    def __enter__(self) -> Self:
        descriptor = self._open()
        try:
            self._acquire(descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        self._descriptor = descriptor
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._descriptor is not None:
            descriptor, self._descriptor = self._descriptor, None
            with suppress(OSError):
                self._release(descriptor)
            os.close(descriptor)

    def _open(self) -> int:
        try:
            return os.open(self._path, os.O_CREAT | os.O_RDWR | NOFOLLOW | CLOSING, 0o600)
        except OSError as error:
            raise as_store_failure(error, self._path) from error

    @abstractmethod
    def _acquire(self, descriptor: int) -> None:
        """Lock the open file, or raise."""

    def _release(self, descriptor: int) -> None:  # noqa: B027  a node's turn leaves nothing behind
        """Do what is needed before the file is closed, which unlocks it."""


class StoreLock(_HeldFile):
    """``with StoreLock(home, command="provision"):`` holds the store of ``home`` for one command.

    Waits up to ``wait`` seconds; ``notice`` receives one sentence with the holder's name. Raises StoreLockedError after
    that, StoreError if the file cannot be made. Not re-entrant: take it once, at the outside.
    """

    def __init__(
        self,
        home: Path,
        *,
        command: str,
        wait: float = 10.0,
        notice: Callable[[str], object] | None = None,
        file: str = FILE_NAME,
    ) -> None:
        super().__init__(_beside(home, file))
        self._command = command
        self._wait = wait
        self._notice = notice
        self._substitute: sqlite3.Connection | None = None

    def _acquire(self, descriptor: int) -> None:
        self._lock(descriptor)
        with suppress(OSError):  # a full disk must not hide the store's own, better message
            # Overwrite the text of the last holder: truncating the file costs more than a step.
            _write_at_start(descriptor, _signature(self._command).ljust(_SIGNATURE_OCTETS))

    def _try_to_lock(self, descriptor: int) -> None:
        """Lock the file, or raise BlockingIOError or OSError."""
        if HAS_LOCKS:
            lock(descriptor)
        else:
            self._substitute = _locked_database(self._path)

    def _release(self, descriptor: int) -> None:
        if self._substitute is not None:
            self._substitute.close()
            self._substitute = None

    def _lock(self, descriptor: int) -> None:
        began = time.monotonic()
        reported, pause = False, _FIRST_POLL_SECONDS
        while True:
            try:
                self._try_to_lock(descriptor)
            except BlockingIOError:
                pass
            except OSError as error:
                raise as_store_failure(error, self._path) from error
            else:
                return
            waited = time.monotonic() - began
            if waited >= self._wait:
                hint = "Wait for it to finish, or stop it."
                raise StoreLockedError(f"The store is locked by {_holder(descriptor)}.", hint=hint)
            if not reported and waited >= _POLL_SECONDS and self._notice is not None:
                self._notice(f"Waiting for the store, locked by {_holder(descriptor)}.")
                reported = True
            time.sleep(pause)
            # Poll often: a durable step takes milliseconds, and other processes wait for the same lock.
            pause = min(2 * pause, _POLL_SECONDS if reported else _LAST_QUIET_POLL_SECONDS)


class UsageLock(_HeldFile):
    """``with UsageLock(path, command="measure hand") as lock:`` uses something for as long as this process lives.

    Does not wait: raises :class:`UsageLockTakenError`, which names the holder. Several processes may hold it together
    if each takes it as ``shared``. ``left_behind`` is true if the previous holder could not remove its mark (it was
    killed, or the power failed).
    """

    def __init__(self, path: Path, *, command: str, shared: bool = False) -> None:
        super().__init__(path)
        self._command, self._shared = command, shared
        self.left_behind = False

    def _open(self) -> int:
        try:
            self._path.parent.mkdir(mode=0o700, exist_ok=True)
        except OSError as error:
            raise as_store_failure(error, self._path) from error
        return super()._open()

    def _acquire(self, descriptor: int) -> None:
        try:
            lock(descriptor, shared=self._shared)
        except BlockingIOError:
            holder = _holder(descriptor)
            raise UsageLockTakenError(f"It is locked by {holder}.", holder) from None
        except OSError as error:
            raise as_store_failure(error, self._path) from error
        self.left_behind = bool(_read_at_start(descriptor, 1))
        with suppress(OSError):  # a full disk must not hide the store's own, better message
            os.ftruncate(descriptor, 0)
            _write_at_start(descriptor, _signature(self._command))

    def _release(self, descriptor: int) -> None:
        if self._shared:  # only the last holder gets the exclusive lock and clears the mark
            lock(descriptor)
        os.ftruncate(descriptor, 0)

    def share(self) -> None:
        """Turn the exclusive lock into a shared one; exclusive requests are still refused."""
        assert self._descriptor is not None, "share() inside the with"
        lock(self._descriptor, shared=True, wait=True)
        self._shared = True

    @property
    def is_taken(self) -> bool:
        """True if a process holds it now, alone or shared."""
        return self.holder is not None

    @property
    def holder(self) -> str | None:
        """Return a description of the holder; None if it is free."""
        return _held_by(self._path)

    @property
    def is_taken_alone(self) -> bool:
        """True if one process holds it now and does not share it."""
        return _held_by(self._path, shared=True) is not None


class UsageLockTakenError(StoreLockedError):
    """Another process holds a :class:`UsageLock`; ``holder`` names the process."""

    def __init__(self, message: str, holder: str) -> None:
        super().__init__(message, hint="Wait for it to finish, or stop it.")
        self.holder = holder


def _locked_database(path: Path) -> sqlite3.Connection:
    """Lock an empty SQLite file beside ``path``, for every process and thread; closing the connection releases it.

    Raises BlockingIOError if it is locked, StoreError if it cannot be made.
    """
    connection = sqlite3.connect(
        path.with_name(path.name + ".sqlite"), timeout=0, isolation_level=None, check_same_thread=False
    )
    try:
        connection.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError as error:
        connection.close()
        if error.sqlite_errorcode & 0xFF == sqlite3.SQLITE_BUSY:
            raise BlockingIOError from None
        raise StoreError(f"{path} cannot be locked: {error}.", hint="Check its owner and mode.") from error
    return connection


def _read_at_start(descriptor: int, most: int) -> bytes:
    """Return the first octets of a file; raises OSError."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    return os.read(descriptor, most)


def _write_at_start(descriptor: int, octets: bytes) -> None:
    """Write over the first octets of a file; raises OSError."""
    os.lseek(descriptor, 0, os.SEEK_SET)
    os.write(descriptor, octets)


def _signature(command: str) -> bytes:
    return f'{{"pid": {os.getpid()}, "command": {_quoted(command)}, "since": "{utc_now()}"}}'.encode()


def holder_of(home: Path) -> str | None:
    """Describe the process that holds the store of ``home`` now; None if there is none."""
    return _held_by(home / FILE_NAME)


def _held_by(path: Path, *, shared: bool = False) -> str | None:
    try:
        descriptor = os.open(path, os.O_RDWR | NOFOLLOW | CLOSING)
    except OSError:
        return None
    try:
        lock(descriptor, shared=shared)
    except BlockingIOError:
        return _holder(descriptor)
    except OSError:  # a file system without locks, so none is held
        return None
    finally:
        os.close(descriptor)
    return None


def _holder(descriptor: int) -> str:
    try:
        holder = json.loads(_read_at_start(descriptor, 4096))
        if Path("/proc/self").exists() and not Path(f"/proc/{int(holder['pid'])}").exists():
            return "another process"  # of several that share the lock, the last one that wrote its text has ended
        return f"pid {int(holder['pid'])} ({holder['command']}) since {holder['since']}"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


class _LockedOctet(_HeldFile):
    """One octet of a file, at a place that ``key`` names (two keys may share one).

    A lock of the open file, not of the process, so threads exclude each other too; a child that executes another
    program does not inherit it.
    """

    def __init__(self, path: Path, key: bytes) -> None:
        super().__init__(path)
        self._key = key

    @property
    def is_taken(self) -> bool:
        """True if the octet is locked now; takes nothing and waits for nothing."""
        try:
            descriptor = os.open(self._path, os.O_RDWR | NOFOLLOW | CLOSING)
        except OSError:
            return False  # without the file, no octet was ever locked
        try:
            answer = fcntl.fcntl(descriptor, fcntl.F_OFD_GETLK, self._lock_struct())
        except OSError:
            return False
        finally:
            os.close(descriptor)
        return bool(struct.unpack_from("h", answer)[0] != fcntl.F_UNLCK)

    def _lock_struct(self) -> bytes:
        place = int.from_bytes(hashlib.sha256(self._key).digest()[:6], "big")
        return struct.pack("hhqqi4x", fcntl.F_WRLCK, os.SEEK_SET, place, 1, 0)  # struct flock

    def _try_to_lock(self, descriptor: int) -> bool:
        """Lock the octet; False if another open file has it locked."""
        try:
            fcntl.fcntl(descriptor, fcntl.F_OFD_SETLK, self._lock_struct())
        except (BlockingIOError, PermissionError):
            return False
        except OSError as error:
            raise as_store_failure(error, self._path) from error
        return True


class NodeLock(_LockedOctet):
    """``with NodeLock(home, uuid):`` one command works on this node of the store, the next one waits for it.

    Two nodes may share an octet; then they only take turns. Waits up to a minute; raises NodeBusyError after that,
    StoreError if the file cannot be made.
    """

    def __init__(self, home: Path, uuid: bytes, *, notice: Callable[[str], object] | None = None) -> None:
        super().__init__(_beside(home, TURNS_NAME), uuid)
        self._uuid, self._notice = uuid, notice

    def _acquire(self, descriptor: int) -> None:
        until, reported = time.monotonic() + _TURN_SECONDS, False
        while not self._try_to_lock(descriptor):
            if time.monotonic() >= until:
                raise NodeBusyError(
                    f"Another command of this station is using node {self._uuid.hex()}.",
                    hint="Wait for it to finish, or stop it.",
                )
            if not reported and self._notice is not None:
                self._notice(f"Waiting: another command is using node {self._uuid.hex()}.")
                reported = True
            time.sleep(_POLL_SECONDS)


class OwnerLock(_LockedOctet):
    """``with OwnerLock(home, measurement_id):`` the command that owns a measurement lives.

    The kernel releases it when the command ends, also by kill -9, whichever process gets its process ID afterwards.
    Raises StoreLockedError if another command owns a measurement of this ID.
    """

    def __init__(self, home: Path, measurement_id: str) -> None:
        super().__init__(_beside(home, OWNERS_NAME), measurement_id.encode())

    def _acquire(self, descriptor: int) -> None:
        if not self._try_to_lock(descriptor):
            raise StoreLockedError("Another command owns this measurement.", hint="Wait for it to finish, or stop it.")
