"""A node on an emulated Cortex-M4: qemu runs its image, this carries CAN frames between its serial line and a bus.

python -m tests.firmware.bridge IMAGE BUS UUID
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

from teds_provision.links.can.bus import Bus
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import parse_spec

_END, _ESCAPE = 0xC0, 0xDB
_QEMU: Final = ("qemu-system-arm", "-M", "mps2-an386", "-display", "none", "-monitor", "none", "-serial", "stdio")
_FRAME, _START, _STACK = 0, 1, 3


def packed(kind: int, octets: bytes) -> bytes:
    """Return one packet, framed as SLIP does (RFC 1055)."""
    body = bytes([kind]) + octets
    return b"\xc0" + body.replace(b"\xdb", b"\xdb\xdd").replace(b"\xc0", b"\xdb\xdc") + b"\xc0"


def packets(octets: Iterator[int]) -> Iterator[bytes]:
    """Packets out of a stream of octets."""
    held, escaped = bytearray(), False
    for octet in octets:
        if octet == _END:
            if held:
                yield bytes(held)
            held.clear()
        elif octet == _ESCAPE:
            escaped = True
        else:
            held.append({0xDC: _END, 0xDD: _ESCAPE}.get(octet, octet) if escaped else octet)
            escaped = False


class EmulatedBoard:
    """The image under qemu, on a bus. ``stack`` is the high-water mark, ``node`` sizeof(teds_node), when asked for."""

    def __init__(self, image: Path, bus: str, uuid: bytes) -> None:
        self._bus = Bus(parse_spec(bus))
        self._process = subprocess.Popen(
            [*_QEMU, "-kernel", str(image)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, bufsize=0
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._in: IO[bytes] = self._process.stdin
        self._out: IO[bytes] = self._process.stdout
        self.ready, self.asked = threading.Event(), threading.Event()
        self.stack = self.node = 0
        self._over = threading.Event()
        self._threads = [threading.Thread(target=job, daemon=True) for job in (self._from_node, self._from_bus)]
        for thread in self._threads:
            thread.start()
        self._write(_START, os.urandom(32) + uuid)

    def sizes(self) -> tuple[int, int]:
        """Stack that was ever used, and sizeof(teds_node), in octets."""
        self.asked.clear()
        self._write(_STACK, b"")
        assert self.asked.wait(30)
        return self.stack, self.node

    def close(self) -> None:
        """End it."""
        self._over.set()
        self._process.kill()
        self._process.wait(30)
        for thread in self._threads:
            thread.join(5)
        self._bus.close()

    def _write(self, kind: int, octets: bytes) -> None:
        self._in.write(packed(kind, octets))

    def _octets(self) -> Iterator[int]:
        while octets := self._out.read(4096):
            yield from octets

    def _from_node(self) -> None:
        for packet in packets(self._octets()):
            if packet[0] == _FRAME:
                identifier = int.from_bytes(packet[1:5], "big")
                self._bus.send(Frame(identifier, packet[6:], bool(packet[5])))
            elif packet[0] == _STACK:
                self.stack, self.node = int.from_bytes(packet[1:5], "big"), int.from_bytes(packet[5:9], "big")
                self.asked.set()
            else:
                self.ready.set()

    def _from_bus(self) -> None:
        while not self._over.is_set():
            frame = self._bus.receive(0.1)
            if frame is not None and self.ready.is_set():
                try:
                    self._write(_FRAME, frame.identifier.to_bytes(4, "big") + bytes([frame.fd]) + frame.data)
                except (BrokenPipeError, ValueError):
                    return


def main(arguments: list[str]) -> int:
    """Run it until stdin ends; then say what stack it took."""
    image, bus, uuid = arguments
    emulated = EmulatedBoard(Path(image), bus, bytes.fromhex(uuid))
    try:
        assert emulated.ready.wait(60)
        print("ready", flush=True)
        sys.stdin.read()
        stack, node = emulated.sizes()
        print(f"stack {stack} octets, teds_node {node} octets", flush=True)
    finally:
        emulated.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
