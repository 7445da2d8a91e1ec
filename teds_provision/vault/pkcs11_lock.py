"""One process at a time at the risky moments of a token: loading the module, logging in, making keys.

SoftHSM rewrites its token file at every login, and a process that loads it then sees no token, or fails with
CKR_GENERAL_ERROR (SoftHSMv2#757). The lock is one per user and module, as several homes may share a token; processes
of other users and other programs are not held off, for these there is one more try.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from teds_provision.errors import VaultFailure
from teds_provision.files import private_folder

_WAIT_SECONDS = 30.0
_POLL_SECONDS = 0.02


@contextmanager
def exclusive(module_path: str) -> Iterator[None]:
    """Hold the lock of a module; released by the kernel if the process dies. Raises VaultFailure after 30 s."""
    path = _folder() / f"pkcs11-{hashlib.sha256(module_path.encode()).hexdigest()[:16]}.lock"
    try:
        descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    except OSError as error:
        raise VaultFailure(f"{path} cannot be opened: {error.strerror}.", hint="Check its owner and mode.") from error
    try:
        _wait(descriptor)
        yield
    finally:
        os.close(descriptor)


def _wait(descriptor: int) -> None:
    until = time.monotonic() + _WAIT_SECONDS
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            if time.monotonic() > until:
                raise VaultFailure(
                    "Another teds-provision has been using the token for long.", hint="Wait for it, or end it."
                ) from None
            time.sleep(_POLL_SECONDS)
        else:
            return


def _folder() -> Path:
    """Return a folder that only this user can write to: in /run/user, else in the home.

    Not in /tmp: there anybody could make a folder of that name first and keep this user out.
    """
    user = os.getuid()
    session = Path(f"/run/user/{user}")
    parent = session if os.access(session, os.W_OK) else Path.home() / ".cache"
    try:
        parent.mkdir(parents=True, exist_ok=True)
        return private_folder(parent / f"teds-provision-{user}")
    except (OSError, RuntimeError) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise VaultFailure(
            f"The folder {parent / f'teds-provision-{user}'} cannot be used: {said}.",
            hint="Remove it and run it again.",
        ) from error
