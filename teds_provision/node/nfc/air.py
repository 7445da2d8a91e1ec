"""What ISO/IEC 14443-3 Type A frames take on air at 106 kbit/s, to imitate the link in benchmarks.

One etu is 128/13.56 MHz (9.44 µs). A standard frame has a start bit, 8 bits and parity per octet, and an end; the
frame delay times are those of ISO/IEC 14443-3 clause 6.2 (n = 9, last bit 1) and of the answer's other direction.
"""

from __future__ import annotations

import time

ETU = 128 / 13.56e6  # seconds
_TO_TAG, _TO_READER = (9 * 128 + 84) / 13.56e6, 1172 / 13.56e6  # frame delay times, seconds
_SPIN = 0.0003  # seconds: sleep is late by up to this
_SHORT, _ACK_BITS = 9, 6  # etu of a short frame (7 bits) and of a 4-bit acknowledge


def command_seconds(octets: bytes) -> float:
    """Return how long a command takes from the reader to the tag, CRC_A added where the frame has one."""
    if len(octets) == 1 and octets in (b"\x26", b"\x52"):
        return _SHORT * ETU
    anticollision = len(octets) == 2 and octets[0] in (0x93, 0x95, 0x97) and octets[1] == 0x20
    return ((len(octets) + (0 if anticollision else 2)) * 9 + 3) * ETU


def answer_seconds(command: bytes, octets: bytes) -> float:
    """Return how long the answer to ``command`` takes from the tag to the reader."""
    if len(octets) == 1 and command[:1] in (b"\xa2", b"\xc2", b"\x30"):
        return _ACK_BITS * ETU
    bare = command in (b"\x26", b"\x52") or command[1:] == b"\x20"  # SENS_RES and SDD_RES have no CRC_A
    return ((len(octets) + (0 if bare else 2)) * 9 + 2) * ETU


class Air:
    """Holds each answer back until command and answer would have passed; called with every frame of a tag.

    What the processes themselves take runs inside that time, so that a paced exchange lasts as long as on air.
    """

    def __init__(self) -> None:
        self._due = 0.0
        self._command = b""

    def __call__(self, octets: bytes, answering: bool) -> None:
        """Note a command, or wait until the ``answering`` frame would be there."""
        if not answering:
            self._command, self._due = octets, time.perf_counter() + command_seconds(octets) + _TO_TAG
            return
        due = self._due + answer_seconds(self._command, octets) + _TO_READER
        while (left := due - time.perf_counter()) > 0:
            if left > _SPIN:
                time.sleep(left - _SPIN)
