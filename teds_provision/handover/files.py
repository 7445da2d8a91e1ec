"""Files that leave or come: read with a limit, written whole or not at all, never over something else."""

from __future__ import annotations

import os
import secrets
from contextlib import suppress
from pathlib import Path

from teds_provision.errors import BadData, NotFound, StoreFailure, UsageFailure


def read_limited(path: Path, max_octets: int, what: str) -> bytes:
    """Return the octets of a file; raises NotFound, StoreFailure (unreadable), BadData (more than ``max_octets``)."""
    try:
        with path.open("rb") as file:
            octets = file.read(max_octets + 1)
    except FileNotFoundError:
        raise NotFound(f"There is no file {path}.") from None
    except OSError as error:
        raise StoreFailure(f"{path} cannot be read: {error.strerror}.", hint="Check its owner and mode.") from error
    if len(octets) > max_octets:
        raise BadData(f"{path} is larger than {max_octets} octets: that is no {what}.")
    return octets


def require_new(path: Path) -> None:
    """Raise UsageFailure where something lies at ``path``, NotFound where there is no folder for it."""
    if path.exists() or path.is_symlink():
        raise UsageFailure(f"{path} exists already and is not overwritten.", hint="Choose another name.")
    if not path.parent.is_dir():
        raise NotFound(f"There is no folder {path.parent}.")


def write_new(path: Path, octets: bytes) -> None:
    """Write a new file of mode 0600, durable when this returns: whole, or none.

    Raises UsageFailure where it exists, StoreFailure where it cannot be written.
    """
    require_new(path)
    draft = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        try:
            with open(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file:
                file.write(octets)
                file.flush()
                os.fsync(file.fileno())
            _publish(draft, path)
        finally:
            with suppress(FileNotFoundError):
                draft.unlink()
        _sync_folder(path.parent)
    except FileExistsError:
        raise UsageFailure(f"{path} exists already and is not overwritten.", hint="Choose another name.") from None
    except OSError as error:
        raise StoreFailure(
            f"{path} cannot be written: {error.strerror}.", hint="Mend that and run the same command again."
        ) from error


def _publish(draft: Path, path: Path) -> None:
    """Give the file its name, never over another; a memory stick without hard links gets a plain rename."""
    try:
        os.link(draft, path)
    except FileExistsError:
        raise
    except OSError:
        if path.exists():
            raise FileExistsError(path) from None
        draft.rename(path)


def _sync_folder(folder: Path) -> None:
    with suppress(OSError):  # some file systems cannot
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
