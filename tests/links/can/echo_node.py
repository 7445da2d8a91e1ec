"""Nodes in a process of their own: Identify, and a Write that answers with its payload turned round.

Arguments: JSON with ``spec``, ``addresses`` (one node each), ``delay`` seconds in each Write. Prints ``ready``; ends
when stdin closes.
"""

from __future__ import annotations

import json
import sys
import threading
import time

from teds_provision.node.can.server import CanServer
from teds_provision.protocol.messages.identity import Identity, NodeState


class EchoNode:
    def __init__(self, address: int, delay: float = 0.0, uuid: bytes | None = None) -> None:
        self.address, self.delay = address, delay
        self.uuid = uuid or bytes([address]) * 10
        self.state = NodeState.FACTORY
        self.runs = 0
        self.pinned = False
        self.free = threading.Event()  # a Write ends after ``delay`` and not before this
        self.free.set()
        self.seen: list[tuple[str, bool]] = []
        self.links_lost: list[str] = []

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        self.seen.append((link, tapped))
        if frame[2:4] == b"\x80\x07":
            return b"\x01\x00\x17" + self.identify()
        if frame[2:4] == b"\x80\x0a":
            self.address = frame[6]
            return b"\x01\x00\x00"
        self.runs += 1
        time.sleep(self.delay)
        self.free.wait()
        if frame[2:4] == b"\x01\x7f":
            return b"\x01" + self.runs.to_bytes(2, "big")
        return frame[6:][::-1] or b"\x00"

    def lost(self, link: str) -> None:
        self.links_lost.append(link)

    def identify(self) -> bytes:
        return Identity(self.uuid, self.state, 0, 0, 4094, self.address).encode()

    def can_address(self) -> int:
        return self.address

    def take_can_address(self, address: int) -> None:
        self.address = address

    def actuator_claimed(self) -> bool:
        return self.pinned


def main() -> None:
    plan = json.loads(sys.argv[1])
    servers = []
    for number, address in enumerate(plan["addresses"]):
        node = EchoNode(address, plan.get("delay", 0.0), bytes([number, address]) * 5)
        servers.append(CanServer(plan["spec"], node, counts_as_tapped=lambda: True))
    for server in servers:
        server.start()
    print("ready", flush=True)
    sys.stdin.read()
    threads = [threading.Thread(target=server.stop) for server in servers]
    for thread in threads:
        thread.start()


if __name__ == "__main__":
    main()
