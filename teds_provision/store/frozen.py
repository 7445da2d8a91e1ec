"""A store that can be read and not written: a disk that is full or read-only must not hide what is known.

SQLite needs a writable folder for the shared memory of a write-ahead log, and without the log the newest entries would
be missing. So both files are copied to where something can be written (memory first), brought together there, and
opened without a name: nothing of the copy is left when the process ends, however it ends.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision.lazy import late

if TYPE_CHECKING:
    import sqlite3
else:  # loaded with the first store: --help does not wait for it
    sqlite3 = late("sqlite3")


_LOG = "-wal"


def open_copy(path: Path) -> sqlite3.Connection:
    """Return a connection to a private copy of the database with its log; raises OSError, sqlite3.Error."""
    last: OSError | None = None
    for place in _places():
        try:
            folder = Path(tempfile.mkdtemp(prefix="teds-provision-", dir=place))
        except OSError as error:
            last = error
            continue
        try:
            return _copied(path, folder)
        except OSError as error:  # not enough room here either
            last = error
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    raise last or OSError(f"There is no place for a copy of {path}.")


def _places() -> Iterator[str]:
    yield "/dev/shm"
    runtime = os.environ.get("XDG_RUNTIME_DIR")
    if runtime:
        yield runtime
    with suppress(OSError):
        yield tempfile.gettempdir()


def _copied(path: Path, folder: Path) -> sqlite3.Connection:
    copy = folder / path.name
    shutil.copyfile(path, copy)
    log = path.with_name(path.name + _LOG)
    with suppress(FileNotFoundError):
        shutil.copyfile(log, copy.with_name(copy.name + _LOG))
    connection = sqlite3.connect(copy, isolation_level=None, check_same_thread=False)
    try:
        connection.execute("PRAGMA locking_mode=EXCLUSIVE")  # no shared memory, so no third file
        connection.execute("PRAGMA journal_mode=MEMORY")  # takes what stood in the log into the file
        connection.execute("SELECT count(*) FROM sqlite_schema").fetchone()
    except BaseException:
        connection.close()
        raise
    return connection
