"""The field of a simulated reader between a station and nodes: boards are put down, changed and lifted off by frames.

A relay of nfcpy's datagrams on 127.0.0.1. What lies on the reader is the port of one node; nothing lies there after
:meth:`Field.lift`, or once the reader has sent as many frames as :meth:`Field.put` was told.
"""

from __future__ import annotations

import contextlib
import selectors
import socket
import threading
from typing import Any


class Field:
    def __init__(self) -> None:
        self.frames = 0
        """Frames of the reader since the last :meth:`put`, polls included."""
        self._lies: int | None = None
        self._lift_after: int | None = None
        self._lock = threading.Lock()
        self._reader = _socket(bind=True)
        self._clients: dict[Any, socket.socket] = {}
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._reader, selectors.EVENT_READ)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def path(self) -> str:
        return f"udp:localhost:{self._reader.getsockname()[1]}"

    @property
    def empty(self) -> bool:
        """Whether nothing lies there, or what lay there was lifted off after so many frames."""
        with self._lock:
            return self._lies is None

    def put(self, path: str, *, lift_after: int | None = None) -> None:
        """Put down the node that serves ``path``, to be lifted off after so many frames."""
        with self._lock:
            self._lies, self._lift_after, self.frames = int(path.rpartition(":")[2]), lift_after, 0

    def lift(self) -> None:
        with self._lock:
            self._lies = None

    def close(self) -> None:
        self._stop.set()
        self._thread.join(60)
        for sock in (self._reader, *self._clients.values()):
            sock.close()
        self._selector.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for key, _ in self._selector.select(0.1):
                with contextlib.suppress(OSError):  # a node that is not there any more
                    self._pass_on(key.fileobj, key.data)  # type: ignore[arg-type]

    def _pass_on(self, source: socket.socket, reader: Any) -> None:
        octets, sender = source.recvfrom(4096)
        with self._lock:
            if source is self._reader:
                if self._lies is None:
                    return
                self.frames += 1
                if self._lift_after is not None and self.frames > self._lift_after:
                    self._lies = None
                    return
                self._towards_node(sender).sendto(octets, ("127.0.0.1", self._lies))
            elif self._lies == sender[1]:
                self._reader.sendto(octets, reader)

    def _towards_node(self, reader: Any) -> socket.socket:
        if reader not in self._clients:
            self._clients[reader] = _socket(bind=False)
            self._selector.register(self._clients[reader], selectors.EVENT_READ, reader)
        return self._clients[reader]


def _socket(*, bind: bool) -> socket.socket:
    made = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    if bind:
        made.bind(("127.0.0.1", 0))
    return made
