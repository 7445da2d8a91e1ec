"""Features of Linux that other systems may lack: flags of open(), owners by number, locks of whole files.

The commands that work on files alone also run without it (docs/compatibility.md). The rule for locks: without flock,
what only tidies up is skipped, and what must not happen twice at once is refused, except for the store: there SQLite's
own lock serves (store/lock.py), on which the store relies on every system anyway.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from typing import Final

NOFOLLOW: Final[int] = getattr(os, "O_NOFOLLOW", 0)
NONBLOCK: Final[int] = getattr(os, "O_NONBLOCK", 0)
OPENS_FOLDERS: Final = hasattr(os, "O_DIRECTORY")
"""True if a folder has a descriptor, which can be locked and brought to the disk."""
CLOSING: Final[int] = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""For every open(): no child inherits the file, and on Windows the octets stay as they are."""
RENAMES_OPEN_FILES: Final = os.name != "nt"
HAS_OWNERS: Final = hasattr(os, "geteuid")
"""False where a mode protects nothing: there the access list of the user's own folder does."""
_SHARED, _EXCLUSIVE, _NO_WAIT = 1, 2, 4


def is_mine(status: os.stat_result) -> bool:
    """Return True if a file belongs to this user, or if files here do not have owners by number."""
    return not HAS_OWNERS or status.st_uid == os.geteuid()


def is_open_to(others: int, status: os.stat_result) -> bool:
    """Return True if the mode of a file gives one of these bits to other users."""
    return HAS_OWNERS and bool(status.st_mode & others)


def _find_flock() -> Callable[[int, int], None] | None:
    try:
        import fcntl
    except ImportError:
        return None
    return fcntl.flock


_FLOCK: Final = _find_flock()
HAS_LOCKS: Final = _FLOCK is not None


def lock(descriptor: int, *, shared: bool = False, wait: bool = False) -> None:
    """Lock an open file until it is closed or its process ends.

    Raises BlockingIOError if another process has it locked, OSError if the system or the file system has no such locks.
    """
    if _FLOCK is None:
        raise OSError(errno.ENOLCK, "this system has no locks of files")
    _FLOCK(descriptor, (_SHARED if shared else _EXCLUSIVE) | (0 if wait else _NO_WAIT))


def sync_content(descriptor: int) -> None:
    """Bring what was written to a file to the disk; raises OSError."""
    getattr(os, "fdatasync", os.fsync)(descriptor)


def cores_to_share() -> int:
    """Return how many processes may share work that they inherit by fork: the cores of this process, 1 without fork."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "fork") and hasattr(os, "sched_getaffinity") else 1


def name_of_machine() -> str:
    """Return the machine's name in its network."""
    if hasattr(os, "uname"):
        return os.uname().nodename
    import platform

    return platform.node()
