"""Each failure of the store's file: cause, cure, and whether what is there can be read all the same."""

from __future__ import annotations

import errno
import sqlite3
from pathlib import Path

import pytest

from teds_provision.errors import StoreError, StoreLockedError
from teds_provision.station.snapshot import is_damage
from teds_provision.station.store.connection import as_store_failure, is_no_place_to_write

PATH = Path("/home/one/store.sqlite3")
FULL = ("there is no space left on the disk", "Free some space and run the same command again; nothing is lost.")
MODE = "Check the owner and mode of the home directory and whether the disk is read-only."
RESTORE = "Restore a backup (teds-provision restore), or move the file away and run teds-provision init."


def of_sqlite(code: int) -> sqlite3.Error:
    error = sqlite3.OperationalError("its own words")
    error.sqlite_errorcode = code
    return error


def wrapped(error: sqlite3.Error | OSError) -> StoreError:
    failure = as_store_failure(error, PATH)
    failure.__cause__ = error
    return failure


@pytest.mark.parametrize(
    ("code", "cause", "cure", "read", "damage"),
    [
        (13, *FULL, True, False),
        (8, "it cannot be written", MODE, True, False),
        (8 | 2 << 8, "it cannot be written", MODE, True, False),  # SQLITE_READONLY_CANTLOCK
        (3, "it cannot be written", MODE, False, False),
        (14, "it cannot be opened", MODE, True, False),
        (10, "the disk failed or is full",
         "Check the disk (space, quota, kernel log), then run the same command again.", True, False),
        (10 | 3 << 8, "the disk failed or is full",
         "Check the disk (space, quota, kernel log), then run the same command again.", True, False),
        (11, "it is damaged", RESTORE, False, True),
        (26, "it is damaged or no store of this tool", RESTORE, False, True),
        (19, "the entry breaks a rule of the store", "Nothing was changed; please report this.", False, False),
        (1, "SQLite says: its own words", "Run teds-provision doctor.", False, False),
    ],
)  # fmt: skip
def test_what_sqlite_reports(code: int, cause: str, cure: str, read: bool, damage: bool) -> None:
    failure = wrapped(of_sqlite(code))
    assert (failure.message, failure.hint) == (f"The store {PATH} cannot be used: {cause}.", cure)
    assert (is_no_place_to_write(failure), is_damage(failure)) == (read, damage)
    assert not isinstance(failure, StoreLockedError)


@pytest.mark.parametrize("code", [5, 6, 5 | 2 << 8, 6 | 1 << 8])
def test_a_store_that_another_process_keeps_busy(code: int) -> None:
    failure = wrapped(of_sqlite(code))
    assert isinstance(failure, StoreLockedError)
    assert (failure.message, failure.hint) == (
        f"The store {PATH} was kept busy by another process for 10 s.",
        "Wait until the other command has ended, then run this one again.",
    )
    assert (is_no_place_to_write(failure), is_damage(failure)) == (False, False)


@pytest.mark.parametrize(
    ("number", "cause", "cure", "read"),
    [
        (errno.ENOSPC, *FULL, True),
        (errno.EDQUOT, *FULL, True),
        (errno.EROFS, "it cannot be written", MODE, True),
        (errno.EACCES, "it cannot be written", MODE, True),
        (errno.EPERM, "it cannot be written", MODE, True),
        (errno.ENOTDIR, "Not a directory", "Check that path.", False),
    ],
)
def test_what_the_system_reports(number: int, cause: str, cure: str, read: bool) -> None:
    failure = wrapped(OSError(number, "Not a directory"))
    assert (failure.message, failure.hint) == (f"The store {PATH} cannot be used: {cause}.", cure)
    assert (is_no_place_to_write(failure), is_damage(failure)) == (read, False)


def test_a_failure_without_a_cause_is_neither() -> None:
    failure = StoreError("The store is of another version.")
    assert (is_no_place_to_write(failure), is_damage(failure)) == (False, False)
    assert as_store_failure(OSError(), PATH).message == f"The store {PATH} cannot be used: OSError."
