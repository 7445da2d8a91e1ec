"""Hand a new master key to the `ncap` that runs over this home, so that a rewrap does not lock it.

A Unix socket of mode 0600 in the home; each side checks the user of the other (SO_PEERCRED), so Linux only. The request
is a JSON object, number to 64 hex digits, to the end of the stream. The answer is one octet: ``Y`` if the receiver uses
the keys now, ``N`` if it does not.
"""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Final

from teds_provision.files import listen_alone, short_path
from teds_provision.vault.agent import user_at
from teds_provision.vault.master import MASTER_OCTETS, MasterKeys

SOCKET: Final = "vault.sock"
_MAX_OCTETS: Final = 64 * 1024
_SECONDS: Final = 5.0
_USED, _REFUSED = b"Y", b"N"


def hand_over(home: Path, masters: MasterKeys) -> bool | None:
    """Give the master keys to the running `ncap`; None if no process of this user listens, False if it refuses."""
    path = home / SOCKET
    if not path.is_socket() or not hasattr(socket, "SO_PEERCRED"):
        return None
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as line, short_path(path) as name:
        line.settimeout(_SECONDS)
        line.connect(name)
        if user_at(line) != os.geteuid():
            return None
        line.sendall(json.dumps({str(number): key.hex() for number, key in masters.keys.items()}).encode())
        line.shutdown(socket.SHUT_WR)
        return line.recv(1) == _USED
    return None


class MasterSocket:
    """Receives master keys for as long as the block of ``with`` lasts; ``accept`` returns True if it uses them."""

    def __init__(self, home: Path, accept: Callable[[MasterKeys], bool]) -> None:
        self._path, self._accept = home / SOCKET, accept
        self._listener: socket.socket | None = None
        self._thread = threading.Thread(target=self._run, name="vault", daemon=True)

    def __enter__(self) -> MasterSocket:
        if hasattr(socket, "SO_PEERCRED"):
            self._listener = listen_alone(self._path, 4)
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._listener is None:
            return
        with suppress(OSError):
            self._path.unlink()
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)  # wakes the thread; close() alone does not
        self._listener.close()
        self._thread.join(_SECONDS)

    def _run(self) -> None:
        assert self._listener is not None
        while True:
            try:
                line, _ = self._listener.accept()
            except OSError:  # closed: the process ends
                return
            with line, suppress(OSError):
                line.settimeout(_SECONDS)
                if user_at(line) == os.geteuid():
                    masters = _read(line)
                    line.sendall(_USED if masters is not None and self._accept(masters) else _REFUSED)


def _read(line: socket.socket) -> MasterKeys | None:
    """Return the keys of a request, None if it is malformed."""
    octets = b""
    while more := line.recv(4096):
        octets += more
        if len(octets) > _MAX_OCTETS:
            return None
    try:
        keys = {int(number): bytes.fromhex(key) for number, key in json.loads(octets).items()}
    except (ValueError, AttributeError, TypeError, RecursionError):
        return None
    return MasterKeys(keys) if keys and all(len(key) == MASTER_OCTETS for key in keys.values()) else None
