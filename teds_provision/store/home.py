"""The home of a station before SQLite opens anything in it: who owns it, who may write, and what lies there."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path
from typing import Final

from teds_provision.errors import StoreFailure

FILE_NAME: Final = "store.sqlite3"


def has_store(home: Path) -> bool:
    """Whether a store lies here, usable or not."""
    return (home / FILE_NAME).exists()


def prepare_home(home: Path, *, create: bool) -> None:
    """Make the directory with mode 0700; refuse one in which others may write."""
    if create:
        home.parent.mkdir(parents=True, exist_ok=True)
        with suppress(FileExistsError):
            home.mkdir(mode=0o700)
            home.chmod(0o700)  # whatever the umask said
    try:
        status = home.stat()
    except FileNotFoundError:
        raise StoreFailure(f"There is no store in {home}.", hint="Run teds-provision init.") from None
    if not stat.S_ISDIR(status.st_mode):
        raise StoreFailure(f"{home} is not a directory.", hint="Choose another --home.")
    if status.st_uid != os.geteuid():
        raise StoreFailure(f"{home} belongs to another user.", hint="Run this as its owner, or choose another --home.")
    private = not status.st_mode & 0o077
    if create and not private and not any(home.iterdir()):
        home.chmod(0o700)
    elif status.st_mode & 0o022:
        raise StoreFailure(f"Others may write in {home}.", hint=f"Run: chmod 700 {home}, or choose another --home.")


def prepare_file(path: Path, *, create: bool) -> None:
    """Make the file with mode 0600 before SQLite would make it wider; its -wal and -shm follow its mode."""
    if create:
        with suppress(FileExistsError):
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_RDWR | os.O_NOFOLLOW, 0o600))
    for file in (path, path.with_name(path.name + "-wal"), path.with_name(path.name + "-shm")):
        _require_own(file)
    if not path.exists():
        raise StoreFailure(f"There is no store in {path.parent}.", hint="Run teds-provision init.")
    if path.stat().st_mode & 0o077:
        with suppress(OSError):  # a disk that is read-only: what is read stays as open as it was
            path.chmod(0o600)


def _require_own(file: Path) -> None:
    """Refuse a link, or another user's file, in the place of the store: somebody put it there."""
    try:
        status = file.lstat()
    except FileNotFoundError:
        return
    if not stat.S_ISREG(status.st_mode) or status.st_uid != os.geteuid():
        what = "a link" if stat.S_ISLNK(status.st_mode) else "not this user's own file"
        raise StoreFailure(f"{file} is {what}.", hint="Somebody put it there: look at it, and move it away.")
