"""What SQLite and the system say when the store's file fails them, in the words of the tool: cause and cure."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision.errors import StoreFailure, StoreLocked
from teds_provision.lazy import late

if TYPE_CHECKING:
    import sqlite3
else:  # loaded with the first store: --help does not wait for it
    sqlite3 = late("sqlite3")

BUSY_SECONDS = 10.0
_RESTORE = "Restore a backup (teds-provision restore), or move the file away and run teds-provision init."

_FULL = ("there is no space left on the disk", "Free some space and run the same command again; nothing is lost.")
_READ_ONLY = (
    "it cannot be written",
    "Check the owner and mode of the home directory and whether the disk is read-only.",
)
# SQLite's primary result codes; written out, so that sqlite3 is not loaded for --help (sqlite.org, rescode).
_SQLITE_FULL, _SQLITE_READONLY, _SQLITE_PERM, _SQLITE_CANTOPEN = 13, 8, 3, 14
_SQLITE_IOERR, _SQLITE_CORRUPT, _SQLITE_NOTADB, _SQLITE_CONSTRAINT = 10, 11, 26, 19
_CAUSES: dict[int, tuple[str, str]] = {
    _SQLITE_FULL: _FULL,
    _SQLITE_READONLY: _READ_ONLY,
    _SQLITE_PERM: _READ_ONLY,
    _SQLITE_CANTOPEN: ("it cannot be opened", _READ_ONLY[1]),
    _SQLITE_IOERR: (
        "the disk failed or is full",
        "Check the disk (space, quota, kernel log), then run the same command again.",
    ),
    _SQLITE_CORRUPT: ("it is damaged", _RESTORE),
    _SQLITE_NOTADB: ("it is damaged or no store of this tool", _RESTORE),
    _SQLITE_CONSTRAINT: ("the entry breaks a rule of the store", "Nothing was changed; please report this."),
}
_OS_CAUSES: dict[int, tuple[str, str]] = {
    errno.ENOSPC: _FULL,
    errno.EDQUOT: _FULL,
    errno.EROFS: _READ_ONLY,
    errno.EACCES: _READ_ONLY,
    errno.EPERM: _READ_ONLY,
}


def as_store_failure(error: sqlite3.Error | OSError, path: Path) -> StoreFailure:
    """Say in the words of the tool why SQLite or the system refused; cause and cure, no octet of the contents."""
    if isinstance(error, OSError):
        cause, cure = _OS_CAUSES.get(error.errno or 0, (error.strerror or type(error).__name__, "Check that path."))
        return StoreFailure(f"The store {path} cannot be used: {cause}.", hint=cure)
    primary = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if primary in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
        return StoreLocked(
            f"The store {path} was kept busy by another process for {BUSY_SECONDS:.0f} s.",
            hint="Wait until the other command has ended, then run this one again.",
        )
    cause, cure = _CAUSES.get(primary, (f"SQLite says: {error}", "Run teds-provision doctor."))
    return StoreFailure(f"The store {path} cannot be used: {cause}.", hint=cure)


def damaged(path: Path) -> StoreFailure:
    """The error for a file that holds what this tool never wrote."""
    cause, cure = _CAUSES[_SQLITE_CORRUPT]
    return StoreFailure(f"The store {path} cannot be used: {cause}.", hint=cure)


def is_no_place_to_write(failure: StoreFailure) -> bool:
    """Whether a store could not be opened because nothing can be written where it lies."""
    cause = failure.__cause__
    if isinstance(cause, OSError):
        return cause.errno in _OS_CAUSES
    refused = (sqlite3.SQLITE_READONLY, sqlite3.SQLITE_CANTOPEN, sqlite3.SQLITE_IOERR, sqlite3.SQLITE_FULL)
    return isinstance(cause, sqlite3.Error) and getattr(cause, "sqlite_errorcode", 0) & 0xFF in refused


def too_old(what: str, version: int) -> StoreFailure:
    """The error for a store, or the store in a backup (``what``), of a schema before KeyAgreement 2."""
    return StoreFailure(
        f"{what} is of schema {version}, from before KeyAgreement 2; no node agrees that way any more.",
        hint="Nothing of it was released. Choose another --home, run init there, and provision the nodes anew.",
    )
