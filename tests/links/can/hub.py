"""A socketcand server on 127.0.0.1 that hands every frame to all other clients, in order, unless told to lose it."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Callable


class Hub:
    def __init__(self, lose: Callable[[int, bytes], bool] = lambda identifier, data: False, port: int = 0) -> None:
        self.lose = lose
        self.frames: list[tuple[int, bytes]] = []
        self._clients: list[socket.socket] = []
        self._lock = threading.RLock()  # ``lose`` may send: that frame goes before its own
        self._socket = socket.create_server(("127.0.0.1", port))
        self.port = self._socket.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    @property
    def spec(self) -> str:
        return f"socketcand:vcan0?host=127.0.0.1&port={self.port}"

    def close(self) -> None:
        with contextlib.suppress(OSError):  # closed already
            self._socket.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        with self._lock:
            for client in self._clients:
                with contextlib.suppress(OSError):  # gone already
                    client.shutdown(socket.SHUT_RDWR)
                client.close()
            self._clients.clear()

    def send(self, identifier: int, data: bytes, sender: socket.socket | None = None) -> None:
        line = f"< frame {identifier:08X} 0.0 {data.hex()} >".encode()
        with self._lock:
            self.frames.append((identifier, data))
            if self.lose(identifier, data):
                return
            for client in self._clients:
                if client is not sender:
                    with contextlib.suppress(OSError):  # it is just leaving, which is no matter of the sender's
                        client.sendall(line)

    def _accept(self) -> None:
        while True:
            try:
                client, _ = self._socket.accept()
            except OSError:
                return
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            threading.Thread(target=self._serve, args=(client,), daemon=True).start()

    def _serve(self, client: socket.socket) -> None:
        with contextlib.suppress(OSError):
            self._talk(client)
        with self._lock:
            if client in self._clients:
                self._clients.remove(client)

    def _talk(self, client: socket.socket) -> None:
        client.sendall(b"< hi >")
        held = b""
        while octets := client.recv(65536):
            held += octets
            while b">" in held:
                command, held = held.split(b">", 1)
                words = command.strip().lstrip(b"<").split()
                if words[:1] == [b"open"]:
                    client.sendall(b"< ok >")
                elif words[:1] == [b"rawmode"]:
                    with self._lock:
                        client.sendall(b"< ok >")
                        self._clients.append(client)
                elif words[:1] == [b"send"]:
                    self.send(int(words[1], 16), bytes(int(word, 16) for word in words[3:]), client)
