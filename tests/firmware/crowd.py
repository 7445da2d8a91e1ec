"""So many nodes in C in one process on one bus: ``python -m tests.firmware.crowd BUS COUNT [measuring]``.

They have power from the start, and the process prints one line of JSON then: their UUIDs. Each line of stdin is a
word: ``off`` cuts the power of all, ``on`` gives it back (flash stays), ``cpu`` changes nothing. The answer to each is
one line, the seconds of processor time of this process so far. ``measuring``: each has one sensor of two octets on
channel 1. The process runs until it is ended; the end of stdin does not end it.
"""

from __future__ import annotations

import heapq
import json
import os
import select
import sys
import time
from typing import Final

from teds_provision.links.can.bus import Bus
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import parse_spec
from teds_provision.protocol.announce import default_can_address
from tests.firmware.memory_node import MemoryNode

PHYSICAL, EVERYONE, CLAIM = 0x18DA0000, 0x18DBFF00, 0x1CFF0000
_LONGEST: Final = 0.05
"""Seconds of one wait for a frame: a word on stdin is looked for between two."""
_NANOSECONDS: Final = 10**9


def draw(kind: str, size: int) -> bytes:
    """Good randomness; a scalar below the order of the group."""
    return b"\x01" + os.urandom(size - 1) if kind in "io" else os.urandom(size)


def uuids(count: int) -> list[bytes]:
    """Of which each has a default address of its own."""
    found: dict[int, bytes] = {}
    while len(found) < count:
        uuid = os.urandom(10)
        found.setdefault(default_can_address(uuid), uuid)
    return list(found.values())


class Crowd:
    """The nodes by address, and when each of them has something to do again."""

    def __init__(self, bus: Bus, count: int, *, measuring: bool) -> None:
        self._bus = bus
        self.nodes: dict[int, MemoryNode] = {}
        self._due: dict[int, float] = {}
        self._turns: list[tuple[float, int]] = []
        self._has_power = True
        for uuid in uuids(count):
            node = MemoryNode(draw, time.monotonic, uuid=uuid)
            if measuring:
                node.add_channel(1, 0, 2)
            self.nodes[default_can_address(uuid)] = node

    def on(self) -> None:
        """Give all of them power."""
        self._has_power = True
        self._bus.drain()
        for address, node in self.nodes.items():
            assert node.start() == 0
            node.joins_bus()
            self._serve(address)

    def off(self) -> None:
        """Cut the power of all of them."""
        self._has_power = False
        self._due.clear()
        self._turns.clear()

    def turn(self) -> None:
        """Take a frame, if one comes before a node is due, and do what is due."""
        now = time.monotonic()
        while self._turns and self._turns[0][0] <= now:
            at, address = heapq.heappop(self._turns)
            if self._due.get(address) == at:
                self._serve(address)
        wait = min(_LONGEST, max(0.0, self._turns[0][0] - time.monotonic())) if self._turns else _LONGEST
        frame = self._bus.receive(wait)
        if frame is None or not self._has_power or frame.identifier & 0x1FFFFF00 == CLAIM:
            return
        heard = [frame.identifier >> 8 & 0xFF] if frame.identifier & 0x1FFF0000 == PHYSICAL else list(self.nodes)
        for address in heard:
            if address in self.nodes:
                self.nodes[address].take_frame(frame.identifier, frame.data, fd=frame.fd)
        for address in heard:
            if address in self.nodes:
                self._serve(address)

    def _serve(self, address: int) -> None:
        node = self.nodes[address]
        due = node.poll()
        while (out := node.next_frame()) is not None:
            self._bus.send(Frame(*out))
            due = node.poll()
        at = due / _NANOSECONDS
        self._due[address] = at
        if at < time.monotonic() + 3600:
            heapq.heappush(self._turns, (at, address))


def main(arguments: list[str]) -> None:
    """Serve until it is ended."""
    crowd = Crowd(Bus(parse_spec(arguments[0])), int(arguments[1]), measuring="measuring" in arguments[2:])
    print(json.dumps([node.identity().uuid.hex() for node in start(crowd)]), flush=True)
    words = [sys.stdin]
    while True:
        crowd.turn()
        if words and select.select(words, [], [], 0)[0]:
            word = sys.stdin.readline().strip()
            if not word:
                words = []
                continue
            if word in ("on", "off"):
                getattr(crowd, word)()
            print(time.process_time(), flush=True)


def start(crowd: Crowd) -> list[MemoryNode]:
    """Give them power, and return them."""
    crowd.on()
    return list(crowd.nodes.values())


if __name__ == "__main__":
    main(sys.argv[1:])
