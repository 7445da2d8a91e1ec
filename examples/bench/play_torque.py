"""Plays the torque cell of torque.dbc on a simulated bus: 100 Hz, a slow sine of 50 N·m, until Ctrl-C.

Usage: python examples/bench/play_torque.py udp_multicast:239.74.163.3
"""

from __future__ import annotations

import contextlib
import math
import struct
import sys
import time

import can

IDENTIFIER, PERIOD = 291, 0.01


def main() -> None:
    """Send a frame every 10 ms."""
    interface, _, channel = sys.argv[1].partition(":")
    with can.Bus(interface=interface, channel=channel, hop_limit=0, fd=False) as bus:
        begun, number = time.monotonic(), 0
        while True:
            torque = round(50 * math.sin(2 * math.pi * number / 1000) / 0.01)
            data = struct.pack("<hHBBxx", torque, round(1500 / 0.5), 24 + 40, 1)
            bus.send(can.Message(arbitration_id=IDENTIFIER, is_extended_id=False, data=data))
            number += 1
            time.sleep(max(0.0, begun + number * PERIOD - time.monotonic()))


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
