"""A relay between a station and its registry, which can be cut, fall silent (half open) or be slow."""

from __future__ import annotations

import selectors
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field


@dataclass
class Relay:
    """Passes on what comes to ``port``. ``silent``: nothing is passed on any more, and nothing closed."""

    to: int
    silent: bool = False
    delay: float = 0.0
    cut_after: int = 0
    """Cut everything once ``sent`` has come so far; 0: never."""
    sent: int = 0
    """How often the station began to say something after the server had spoken: its round trips."""
    received: int = 0
    """How many octets came from the server."""
    _pairs: list[tuple[socket.socket, socket.socket]] = field(default_factory=list)
    _ended: bool = False

    def __post_init__(self) -> None:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = self._listener.getsockname()[1]
        self._threads = [threading.Thread(target=self._accept, daemon=True)]
        self._threads[0].start()

    def cut(self) -> None:
        """Cut what is connected now."""
        for pair in self._pairs:
            for end in pair:
                with suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._ended = True
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self.silent = False
        self.cut()
        for thread in self._threads:
            thread.join(10)

    def _accept(self) -> None:
        while not self._ended:
            try:
                station, _ = self._listener.accept()
            except OSError:
                return
            try:
                server = socket.create_connection(("127.0.0.1", self.to))
            except OSError:
                station.close()
                continue
            self._pairs.append((station, server))
            thread = threading.Thread(target=self._carry, args=(station, server), daemon=True)
            self._threads.append(thread)
            thread.start()

    def _carry(self, station: socket.socket, server: socket.socket) -> None:
        spoke = server
        with selectors.DefaultSelector() as ready, station, server:
            ready.register(station, selectors.EVENT_READ, server)
            ready.register(server, selectors.EVENT_READ, station)
            while not self._ended:
                for key, _ in ready.select(0.2):
                    while self.silent and not self._ended:
                        time.sleep(0.02)
                    source = key.fileobj
                    assert isinstance(source, socket.socket)
                    try:
                        octets = source.recv(65536)
                        if not octets:
                            return
                        self.sent += source is station and spoke is server
                        self.received += len(octets) if source is server else 0
                        spoke = source
                        if self.cut_after and self.sent >= self.cut_after:
                            self.cut()
                            return
                        time.sleep(self.delay)
                        key.data.sendall(octets)
                    except OSError:
                        return


@contextmanager
def relay(to: int) -> Iterator[Relay]:
    made = Relay(to)
    try:
        yield made
    finally:
        made.close()
