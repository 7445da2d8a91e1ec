"""How long a frame occupies the wire, to the bit: for benchmarks on a simulated bus (option ``pace=1``).

Frame fields, bit stuffing and the CRC-15 polynomial 0x4599 are those of ISO 11898-1. An FD frame is sent with bit
rate switching; its stuff bits are counted over the fields in front of the CRC, the CRC's own are fixed ones.
"""

from __future__ import annotations

import time
from collections.abc import Iterable

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)


def classic_bits(identifier: int, data: bytes) -> int:
    """Bits of a classic extended data frame from start of frame to the end of the intermission, stuffing included."""
    fields = [0, *_bits(identifier >> 18, 11), 1, 1, *_bits(identifier & 0x3FFFF, 18), 0, 0, 0, *_bits(len(data), 4)]
    for octet in data:
        fields += _bits(octet, 8)
    crc = 0
    for bit in fields:
        top = bit ^ (crc >> 14)
        crc = (crc << 1) & 0x7FFF
        if top:
            crc ^= 0x4599
    fields += _bits(crc, 15)
    # CRC delimiter, acknowledge, its delimiter, end of frame, intermission
    return len(fields) + _stuff_bits(fields) + 1 + 1 + 1 + 7 + 3


def fd_seconds(identifier: int, data: bytes, bitrate: int, data_bitrate: int) -> float:
    """Seconds that an extended FD frame with bit rate switching takes; ``data`` is padded to a length FD knows."""
    length = next(size for size in FD_LENGTHS if size >= len(data))
    # start, base identifier, SRR, IDE, extension, RRS, FDF, reserved, BRS: at the nominal rate
    nominal = [0, *_bits(identifier >> 18, 11), 1, 1, *_bits(identifier & 0x3FFFF, 18), 0, 1, 0, 1]
    fast = [0, *_bits(FD_LENGTHS.index(length), 4)]
    for octet in data.ljust(length, b"\xcc"):
        fast += _bits(octet, 8)
    stuffed = _stuff_bits(nominal)
    crc = 17 if length <= 16 else 21
    fixed = 1 + -(-crc // 4)  # one in front of the stuff count, one after every fourth bit
    fast_bits = len(fast) + _stuff_bits(nominal + fast) - stuffed + 4 + crc + fixed
    slow_bits = len(nominal) + stuffed + 1 + 1 + 1 + 7 + 3
    return slow_bits / bitrate + fast_bits / data_bitrate


class Pacer:
    """Holds a sender back until its frame would have left the wire; knows nothing of arbitration."""

    def __init__(self, bitrate: int, data_bitrate: int) -> None:
        self._bitrate, self._data_bitrate = bitrate, data_bitrate
        self._free_at = self._last = 0.0
        self.busy_seconds = 0.0

    def wait(self, identifier: int, data: bytes, *, fd: bool) -> None:
        """Sleep until the frame is through, the last 0.1 ms by asking the clock."""
        if fd:
            duration = fd_seconds(identifier, data, self._bitrate, self._data_bitrate)
        else:
            duration = classic_bits(identifier, data) / self._bitrate
        self.busy_seconds += duration
        now = time.perf_counter()
        # a controller has a queue: the next frame is made ready while this one is still on the wire
        queued = now - self._free_at < self._last
        self._free_at = (self._free_at if queued else now) + duration
        self._last = duration
        while (left := self._free_at - time.perf_counter()) > 0:
            time.sleep(max(0.0, left - 1e-4))  # 0 lets other threads run: a bare loop would hold them up for 5 ms


def _bits(value: int, count: int) -> list[int]:
    return [(value >> place) & 1 for place in range(count - 1, -1, -1)]


def _stuff_bits(bits: Iterable[int]) -> int:
    """How many stuff bits go in: one after five equal bits, itself the first of the next run."""
    stuffed, last, run = 0, -1, 0
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            stuffed, last, run = stuffed + 1, 1 - bit, 1
    return stuffed
