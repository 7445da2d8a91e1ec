"""Files written atomically, and read with a limit: the one way for every room.

A new file begins under a temporary name in the same folder (``.NAME.<16 hex digits>.teds-part``), made with ``O_EXCL``,
so a planted link is never written through. It gets its name only when its octets are on the disk; the folder is brought
to the disk after that. The file of a killed writer is recognised by that name and by the lock that its writer held, and
removed by the next one; nothing else in the folder is ever touched.
"""

from __future__ import annotations

import errno
import os
import re
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from teds_provision.errors import BadDataError, NotFoundError, StoreError, TedsProvisionError, UsageError
from teds_provision.lazy import late
from teds_provision.portable import (
    CLOSING,
    NOFOLLOW,
    NONBLOCK,
    OPENS_FOLDERS,
    RENAMES_OPEN_FILES,
    is_mine,
    is_open_to,
    lock,
)

if TYPE_CHECKING:
    import socket
else:  # most commands do not listen
    socket = late("socket")

PRIVATE: Final = 0o600
"""Mode of what holds secrets, sealed or not."""
SHARED: Final = 0o666
"""Mode of results that are no secret; the user's umask takes away from it."""
_SUFFIX: Final = ".teds-part"
_STALE_SECONDS: Final = 60.0  # a file that was just created is not locked yet, and looks as if its writer had died
_LONGEST_SOCKET: Final = 100
"""Octets: Linux takes 107 for the name of a Unix socket."""
_PIECE: Final = 1 << 16
_JSON: Final = ".json"
_NO_FOLDER_SYNC: Final = frozenset({errno.EINVAL, errno.ENOTSUP, errno.ENOSYS, errno.EROFS, errno.EACCES})
_NO_HARD_LINKS: Final = frozenset({errno.EPERM, errno.ENOTSUP, errno.ENOSYS, errno.EMLINK, errno.EXDEV, errno.EACCES})


@contextmanager
def whole_file(path: Path, *, replace: bool, mode: int = PRIVATE) -> Iterator[BinaryIO]:
    """Give a new file to write (and read back); when the block ends well it becomes ``path``, else nothing is left.

    Durable when it returns: file, then name. ``replace`` False never takes the place of another file. Raises OSError,
    FileExistsError for a name that is taken.
    """
    with whole_draft(path, replace=replace, mode=mode) as (_, file):
        yield file


@contextmanager
def whole_draft(path: Path, *, replace: bool, mode: int = PRIVATE) -> Iterator[tuple[Path, BinaryIO]]:
    """Open a draft as :func:`whole_file` does, and yield its present path too, for callers that write by name."""
    if not path.name:  # "" and "/"
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    # a rename would replace the device: /dev/null
    if replace and path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "it is a device, pipe or socket and cannot be replaced by a file", str(path))
    draft = path.with_name(f".{path.name}.{secrets.token_hex(8)}{_SUFFIX}")
    _sweep(path)
    descriptor = os.open(draft, os.O_CREAT | os.O_EXCL | os.O_RDWR | NOFOLLOW | CLOSING, mode)
    try:
        with open(descriptor, "w+b") as file:
            # some network folders have no locks; there only its age identifies a left-over file
            with suppress(OSError):
                lock(file.fileno())
            yield draft, file
            file.flush()
            os.fsync(file.fileno())
            if RENAMES_OPEN_FILES:  # while it is locked, no other process treats the draft as a left-over
                _publish(draft, path, replace=replace)
        if not RENAMES_OPEN_FILES:
            _publish(draft, path, replace=replace)
        sync_folder(path.parent)
    finally:
        with suppress(OSError):
            draft.unlink()


def write_whole(
    path: Path,
    octets: bytes | Iterable[bytes],
    *,
    mode: int = PRIVATE,
    failure: type[TedsProvisionError] = StoreError,
) -> None:
    """Put a file in the place of ``path``, whole and durable.

    Raises UsageError if a folder is there, NotFoundError if its own is missing (and ``failure`` is no other one), else
    ``failure``; the old file is then as it was.
    """
    try:
        with whole_file(path, replace=True, mode=mode) as file:
            file.writelines((octets,) if isinstance(octets, bytes) else octets)
    except OSError as error:
        raise _cannot_write(path, error, failure) from error


def open_lock(path: Path) -> int:
    """Open the file that is locked while another one is changed, made if it is missing; return its descriptor.

    Raises StoreError if it cannot be made: the first thing that a read-only or full disk refuses.
    """
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT | NOFOLLOW | CLOSING, PRIVATE)
    except OSError as error:
        raise _cannot_write(path, error, StoreError) from error


def write_new(
    path: Path, octets: bytes, *, mode: int = PRIVATE, failure: type[TedsProvisionError] = StoreError
) -> None:
    """Write a new file, whole and durable, never over another; raises as :func:`new_file` does."""
    with new_file(path, mode=mode, failure=failure) as file:
        file.write(octets)


@contextmanager
def new_file(path: Path, *, mode: int = PRIVATE, failure: type[TedsProvisionError] = StoreError) -> Iterator[BinaryIO]:
    """Yield a new file to write; when the block ends well it becomes ``path``, whole and durable, never over another.

    Raises UsageError if ``path`` exists, NotFoundError if its folder is missing, else ``failure``.
    """
    require_new(path)
    try:
        with whole_file(path, replace=False, mode=mode) as file:
            yield file
    except FileExistsError:
        raise _taken(path) from None
    except OSError as error:
        raise _cannot_write(path, error, failure) from error


def require_new(path: Path) -> None:
    """Raise UsageError if ``path`` exists, NotFoundError if there is no folder for it."""
    if path.exists() or path.is_symlink():
        raise _taken(path)
    if not path.parent.is_dir():
        raise NotFoundError(f"There is no folder {path.parent}.", hint="Create it, or choose another path.")


def read_limited(
    path: Path | str,
    max_octets: int,
    what: str,
    *,
    failure: type[TedsProvisionError] = NotFoundError,
    follow: bool = True,
) -> bytes:
    """Return the octets of a file, reading no more than ``max_octets`` of it.

    ``path`` may be a text, for callers with thousands of files: making a Path takes as long as reading the file.
    ``follow`` False refuses a symbolic link. Raises NotFoundError (no such file), ``failure`` (it cannot be read), and
    BadDataError (larger than any ``what``).
    """
    try:
        octets = _read(*_opened(path, 0 if follow else NOFOLLOW), max_octets + 1)
    except (OSError, ValueError) as error:
        raise _unreadable(path, error, failure) from error
    if len(octets) > max_octets:
        article = "an" if what[0] in "aeiouAEIOU" else "a"
        raise BadDataError(f"{path} is larger than {max_octets} octets, which is too large for {article} {what}.")
    return octets


def read_text(path: Path, max_octets: int, what: str, *, failure: type[TedsProvisionError] = NotFoundError) -> str:
    """Return the text of a UTF-8 file without a mark in front of it.

    Raises as :func:`read_limited`, and BadDataError.
    """
    octets = read_limited(path, max_octets, what, failure=failure)
    try:
        return octets.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = octets[: error.start].count(b"\n") + 1
        raise BadDataError(f"{path}:{line}: the text is not UTF-8.", hint="Save the file as UTF-8.") from error


def open_to_read(path: Path) -> BinaryIO:
    """Open a file to read from; raises NotFoundError if it does not exist or cannot be read."""
    try:
        return open(_opened(path)[0], "rb")
    except (OSError, ValueError) as error:
        raise _unreadable(path, error, NotFoundError) from error


def _opened(path: Path | str, flags: int = 0) -> tuple[int, int]:
    """Open a file that is read to its end, and return its descriptor and size (0: not known).

    Raises OSError, NotFoundError for a named pipe.
    Opening a pipe without a writer waits for ever. The pipe of a shell's ``<(command)`` has no name but that of its
    descriptor, and has a writer.
    """
    descriptor = os.open(path, os.O_RDONLY | CLOSING | NONBLOCK | flags)
    status = os.fstat(descriptor)
    mode = status.st_mode
    if stat.S_ISREG(mode):
        return descriptor, status.st_size
    if stat.S_ISFIFO(mode) and _is_named(path):
        os.close(descriptor)
        raise NotFoundError(f"{path} is a pipe, not a file.")
    if NONBLOCK:
        os.set_blocking(descriptor, True)
    return descriptor, 0


def require_no_pipe(path: Path) -> None:
    """Raise NotFoundError for a named pipe, before foreign code opens it and waits."""
    with suppress(OSError, ValueError):
        if stat.S_ISFIFO(path.stat().st_mode) and _is_named(path):
            raise NotFoundError(f"{path} is a pipe, not a file.")


def _is_named(path: Path | str) -> bool:
    return not str(path).startswith(("/dev/fd/", "/dev/std", "/proc/"))


def _unreadable(path: Path | str, error: OSError | ValueError, failure: type[TedsProvisionError]) -> TedsProvisionError:
    """Return why a file cannot be read."""
    if isinstance(error, FileNotFoundError):
        return NotFoundError(f"There is no file {path}.")
    if isinstance(error, IsADirectoryError):
        return NotFoundError(f"{path} is a folder, not a file.")
    if isinstance(error, OSError):
        return failure(f"{path} cannot be read: {error.strerror}.", hint="Check its owner and mode.")
    return NotFoundError(f"{str(path)!r} is not a valid file name.")  # the name contains a NUL octet


def _read(descriptor: int, size: int, most: int) -> bytes:
    """Read at most ``most`` octets of an open file of ``size`` (0: not known) and close it; raises OSError."""
    parts: list[bytes] = []
    try:  # system calls take half as long as open(), which counts for thousands of files
        if 0 < size < _PIECE:
            part = os.read(descriptor, min(most, size + 1))
            if len(part) == size:  # one octet more was requested, so this is the end of the file
                return part
            parts.append(part)
            most -= len(part)
        while most and (part := os.read(descriptor, min(most, _PIECE))):
            parts.append(part)
            most -= len(part)
    finally:
        os.close(descriptor)
    return b"".join(parts)


def json_files(paths: Sequence[Path], what: str) -> list[str]:
    """Return named files, and every ``*.json`` below named folders, by name; each once.

    As text, because the processes that read the files make paths of them.
    """
    found: list[str] = []
    for path in paths:
        if path.is_dir():
            inside = list(_below(str(path)))
            if not inside:
                raise NotFoundError(f"There is no {what} (*{_JSON}) in the folder {path}.")
            found += inside
        else:
            found.append(str(path))
    return list(dict.fromkeys(found))


def _below(folder: str) -> Iterator[str]:
    """Yield the JSON files in a folder and its folders, by name; neither links to folders nor unreadable ones."""
    here: list[os.DirEntry[str]] = []
    with suppress(OSError), os.scandir(folder) as entries:
        here = sorted(entries, key=attrgetter("name"))
    for entry in here:
        if entry.name.endswith(_JSON) and _is_file(entry):  # nearly all entries
            yield entry.path
        elif _is_folder(entry):
            yield from _below(entry.path)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    """Return True if it is a folder itself.

    The directory entry knows that already, so that most need no look at the disk.
    """
    try:
        return entry.is_dir(follow_symlinks=False)
    except OSError:
        return False


def _is_file(entry: os.DirEntry[str]) -> bool:
    """Return True if it is a file, or a link to one."""
    try:
        return entry.is_file()
    except OSError:
        return False


def make_folder(folder: Path) -> None:
    """Make a folder for results; raises StoreError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"Cannot create folder {folder}: {error.strerror}.") from error


def holds(path: Path, octets: bytes) -> bool:
    """Return True if a regular file holds exactly these octets; reads no more of it than their length.

    Raises OSError.
    """
    if not path.is_file():
        return False
    with open_to_read(path) as file:
        return file.read(len(octets) + 1) == octets


def sync_folder(folder: Path) -> None:
    """Bring a folder's names to the disk; file systems that cannot are left alone. Raises OSError."""
    if not OPENS_FOLDERS:
        return
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | CLOSING)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in _NO_FOLDER_SYNC:
            raise
    finally:
        os.close(descriptor)


def private_folder(folder: Path) -> Path:
    """Make a folder that only this user can use, or check one that is there; raises OSError.

    Raises PermissionError if it belongs to another user, is open to others, or is a link: it may be a trap.
    """
    with suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    status = folder.lstat()
    if not stat.S_ISDIR(status.st_mode) or not is_mine(status) or is_open_to(0o077, status):
        raise PermissionError(errno.EPERM, "it is not a folder of this user alone", str(folder))
    return folder


@contextmanager
def short_path(path: Path) -> Iterator[str]:
    """Yield a name for a Unix socket that the system takes, however deep its folder is; raises OSError."""
    if len(os.fsencode(path)) <= _LONGEST_SOCKET:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_PATH | os.O_DIRECTORY | CLOSING)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def listen_alone(path: Path, waiting: int) -> socket.socket:
    """Return a Unix socket that only this user can reach; that of a killed process is replaced. Raises StoreError."""
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    before = os.umask(0o177)  # the mode is set when the socket is bound, so other users can never connect
    try:
        with suppress(FileNotFoundError):
            path.unlink()
        with short_path(path) as name:
            listener.bind(name)
        listener.listen(waiting)
    except OSError as error:
        listener.close()
        raise _cannot_write(path, error, StoreError) from error
    finally:
        os.umask(before)
    return listener


def _publish(draft: Path, path: Path, *, replace: bool) -> None:
    """Give the draft its name; a memory stick without hard links gets a rename after a look."""
    if replace:
        os.replace(draft, path)
        return
    try:
        os.link(draft, path, follow_symlinks=os.link not in os.supports_follow_symlinks)
    except OSError as error:
        if error.errno not in _NO_HARD_LINKS:
            raise
        if path.exists() or path.is_symlink():
            raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), str(path)) from None
        os.rename(draft, path)


def _sweep(path: Path) -> None:
    """Remove the files of killed writers of ``path``: a temporary name, our file, old, and without a lock."""
    ours = re.compile(re.escape(f".{path.name}.") + "[0-9a-f]{16}" + re.escape(_SUFFIX))
    with suppress(OSError):
        for name in os.listdir(path.parent):
            if ours.fullmatch(name):
                _remove_if_left(path.with_name(name))


def _remove_if_left(left: Path) -> None:
    with suppress(OSError), open(os.open(left, os.O_RDWR | NOFOLLOW | NONBLOCK | CLOSING), "rb") as file:
        status = os.fstat(file.fileno())
        mine = stat.S_ISREG(status.st_mode) and is_mine(status)
        if mine and time.time() - status.st_mtime > _STALE_SECONDS:
            lock(file.fileno())
            left.unlink()


def _taken(path: Path) -> UsageError:
    return UsageError(f"{path} already exists and is not overwritten.", hint="Choose another name.")


def _cannot_write(path: Path, error: OSError, failure: type[TedsProvisionError]) -> TedsProvisionError:
    if failure is StoreError and isinstance(error, FileNotFoundError | NotADirectoryError):  # the user gave this path
        return NotFoundError(f"There is no folder {path.parent}.", hint="Create it, or choose another path.")
    if isinstance(error, IsADirectoryError):
        return UsageError(f"{path} is a folder, not a file.", hint="Name a file in it.")
    return failure(f"{path} cannot be written: {error.strerror}.", hint="Fix that and run the same command again.")
