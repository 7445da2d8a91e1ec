"""Plays CAN sensors in a process of its own, on a python-can bus.

``GROUP PORT`` name the bus (udp_multicast, hop limit 0). A line of stdin is a JSON object of what is sent from then on:
``{"every": seconds, "frames": [[identifier, data in hex], …]}``; identifiers above 0x7FF have 29 bits. Each line is
answered with ``{"sent": N}``, the frames so far.
"""

from __future__ import annotations

import json
import select
import sys
import time

import can


def main() -> None:
    group, port = sys.argv[1], int(sys.argv[2])
    every, frames, sent, due = 1.0, list[list[str]](), 0, 0.0
    with can.Bus(interface="udp_multicast", channel=group, port=port, hop_limit=0, fd=False) as bus:
        print(json.dumps({"sent": sent}), flush=True)
        while True:
            if select.select([sys.stdin], [], [], max(0.0, due - time.monotonic()) if frames else None)[0]:
                line = sys.stdin.readline()
                if not line:
                    return
                record = json.loads(line)
                every, frames, due = record["every"], record["frames"], time.monotonic()
                print(json.dumps({"sent": sent}), flush=True)
            for identifier, data in frames:
                octets = bytes.fromhex(data)
                bus.send(
                    can.Message(arbitration_id=int(identifier), is_extended_id=int(identifier) > 0x7FF, data=octets)
                )
                sent += 1
            due += every


if __name__ == "__main__":
    main()
