"""So many nodes in C in one process on one bus: ``python -m tests.firmware.crowd BUS COUNT``, until it is ended.

Says one line of JSON when they are there: their UUIDs.
"""

from __future__ import annotations

import json
import os
import sys
import time

from teds_provision.links.can.bus import Bus
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import parse_spec
from teds_provision.protocol.announce import default_can_address
from tests.firmware.memory_node import MemoryNode

PHYSICAL, EVERYONE, CLAIM = 0x18DA0000, 0x18DBFF00, 0x1CFF0000


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


def main(arguments: list[str]) -> None:
    """Serve until it is ended."""
    bus = Bus(parse_spec(arguments[0]))
    nodes: dict[int, MemoryNode] = {}
    for uuid in uuids(int(arguments[1])):
        node = MemoryNode(draw, time.monotonic, uuid=uuid)
        assert node.start() == 0
        nodes[default_can_address(uuid)] = node
    print(json.dumps([node.identity().uuid.hex() for node in nodes.values()]), flush=True)
    awake: set[int] = set()
    while True:
        frame = bus.receive(0.002 if awake else 0.1)
        if frame is not None:
            heard = [frame.identifier >> 8 & 0xFF] if frame.identifier & 0x1FFF0000 == PHYSICAL else list(nodes)
            for address in heard:
                if address in nodes and frame.identifier & 0x1FFFFF00 != CLAIM:
                    nodes[address].take_frame(frame.identifier, frame.data, fd=frame.fd)
                    awake.add(address)
        for address in list(awake):
            node = nodes[address]
            due = node.poll()
            while (out := node.next_frame()) is not None:
                bus.send(Frame(*out))
            if due > (time.monotonic() + 1) * 1e9:
                awake.discard(address)


if __name__ == "__main__":
    main(sys.argv[1:])
