"""The exact wire time of frames, for benchmarks on a simulated bus (option ``pace=1``).

Frame fields, bit stuffing and the CRC-15 polynomial 0x4599 are those of ISO 11898-1. An FD frame is sent with bit
rate switching; its stuff bits are counted over the fields in front of the CRC, the CRC's own are fixed ones.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import mmap
import os
import struct
import sys
import tempfile
import threading
import time
from functools import cache, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

from teds_provision.lazy import late

if TYPE_CHECKING:
    import fcntl
else:  # without fcntl, this module is still imported to read recordings
    fcntl = late("fcntl")

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
_POLYNOMIAL = 0x4599
_TIMER_SLACK: Final = 29  # PR_SET_TIMERSLACK, linux/prctl.h
_BEFORE = 3e-5
"""Seconds before the time up to which a sleep is trusted. To sleep on for nothing until then ended 10 to 15 µs late, at
every change of direction of a bus; no other thread is held up for longer than this."""
_LONGEST_QUEUE: Final = 10.0
_UNTIL: Final = struct.Struct("@dd")
"""When the wire is free again, and the seconds for which it was taken since it exists."""
_THREAD = threading.local()
_NO_BIT = 0  # before the first bit of a frame; else 1 + 4 · the last bit + (equal bits so far, 1 to 4) - 1


def classic_bits(identifier: int, data: bytes) -> int:
    """Return the bits of a classic extended data frame, from start of frame to intermission, with stuff bits."""
    length, stuffed, state, crc = _classic_head(identifier, len(data))
    for octet in data:
        more, state = _run(state, octet, 8)
        stuffed += more
        crc = _crc(crc, octet)
    for value, width in ((crc >> 7, 8), (crc & 0x7F, 7)):
        more, state = _run(state, value, width)
        stuffed += more
    # CRC, its delimiter, acknowledge, its delimiter, end of frame, intermission.
    return length + 8 * len(data) + stuffed + 15 + 1 + 1 + 1 + 7 + 3


def fd_seconds(identifier: int, data: bytes, bitrate: int, data_bitrate: int) -> float:
    """Return the seconds of an extended FD frame with bit rate switching; ``data`` is padded to a length of FD."""
    length = next(size for size in FD_LENGTHS if size >= len(data))
    slow, stuffed, state = _fd_head(identifier)
    fast_stuffed, state = _run(state, FD_LENGTHS.index(length), 5)  # ESI (0) and the length's code
    for octet in data.ljust(length, b"\xcc"):
        more, state = _run(state, octet, 8)
        fast_stuffed += more
    crc = 17 if length <= 16 else 21
    fixed = 1 + -(-crc // 4)  # one before the stuff count, one after every fourth bit
    fast_bits = 5 + 8 * length + fast_stuffed + 4 + crc + fixed
    slow_bits = slow + stuffed + 1 + 1 + 1 + 7 + 3
    return slow_bits / bitrate + fast_bits / data_bitrate


class Pacer:
    """Holds a sender back until its frame would have left the wire ``bus``, which it shares with others that name it.

    Frames take turns in the order in which they are ready; a real bus would let the lowest identifier go first.
    """

    def __init__(self, bitrate: int, data_bitrate: int, bus: str = "") -> None:
        self._bitrate, self._data_bitrate = bitrate, data_bitrate
        self._wire = Wire(bus) if bus else None
        self._free_at = self._last = 0.0
        self.busy_seconds = 0.0

    def wait(self, identifier: int, data: bytes, *, fd: bool) -> None:
        """Sleep until the frame is through, the last 30 µs by asking the clock."""
        now = time.perf_counter()  # the frame begins now: the computation below must not delay it
        sharp_timers()
        if fd:
            duration = fd_seconds(identifier, data, self._bitrate, self._data_bitrate)
        else:
            duration = classic_bits(identifier, data) / self._bitrate
        self.busy_seconds += duration
        # As in a controller's queue, the next frame is prepared while this one is still on the wire.
        queued = now - self._free_at < self._last
        begin = self._free_at if queued else now
        self._free_at = begin + duration if self._wire is None else self._wire.occupy(begin, duration)
        self._last = duration
        if (left := self._free_at - time.perf_counter()) > _BEFORE:
            time.sleep(left - _BEFORE)
        while time.perf_counter() < self._free_at:
            pass

    def close(self) -> None:
        """Leave the wire."""
        if self._wire is not None:
            self._wire.close()


class Wire:
    """The time until which a simulated bus is occupied, shared by this user's processes with paced frames on it.

    A small file by the bus's name, gone with its last user.
    """

    _turn: Final = threading.Lock()  # POSIX locks exclude processes, not threads

    def __init__(self, bus: str) -> None:
        name = f"teds-pace-{os.getuid()}-{hashlib.sha256(bus.encode()).hexdigest()[:16]}"
        self._path = Path(tempfile.gettempdir()) / name
        self._file = os.open(self._path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        fcntl.flock(self._file, fcntl.LOCK_SH)  # marks the file as in use; turns need another kind of lock
        os.ftruncate(self._file, _UNTIL.size)  # keeps its contents; a new file is filled with zeros
        self._shared = mmap.mmap(self._file, _UNTIL.size)

    def occupy(self, begin: float, duration: float) -> float:
        """Take the wire for so many seconds, at ``begin`` or as soon as it is free; returns the end (perf_counter)."""
        with self._turn:
            fcntl.lockf(self._file, fcntl.LOCK_EX)
            try:
                taken, busy = _UNTIL.unpack(self._shared[:])
                if taken - begin < _LONGEST_QUEUE:  # otherwise the time is from before a restart of the clock
                    begin = max(begin, taken)
                self._shared[:] = _UNTIL.pack(begin + duration, busy + duration)
            finally:
                fcntl.lockf(self._file, fcntl.LOCK_UN)
        return begin + duration

    @property
    def busy_seconds(self) -> float:
        """Wire time of all frames of all senders since the first of the present users came."""
        return float(_UNTIL.unpack(self._shared[:])[1])

    def close(self) -> None:
        """Leave it; the last one takes the file away."""
        if self._file < 0:
            return
        with self._turn, contextlib.suppress(OSError):
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._path.unlink(missing_ok=True)
        self._shared.close()
        os.close(self._file)
        self._file = -1


def sharp_timers() -> None:
    """Have this thread's sleeps end when they should, from now on.

    Linux may add 50 µs to each sleep, also to one of 0 s, so that it can wake several threads at once (prctl(2),
    PR_SET_TIMERSLACK): as long as half a frame on a bus of 1 Mbit/s. Elsewhere nothing is changed.
    """
    if getattr(_THREAD, "sharp", False):
        return
    _THREAD.sharp = True
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_TIMER_SLACK, 1, 0, 0, 0)


@lru_cache(1024)
def _classic_head(identifier: int, octets: int) -> tuple[int, int, int, int]:
    """Return the bits before the data, their stuff bits, the run that they end with, and the CRC so far."""
    fields = [0, *_bits(identifier >> 18, 11), 1, 1, *_bits(identifier & 0x3FFFF, 18), 0, 0, 0, *_bits(octets, 4)]
    crc = 0
    for bit in fields:
        crc = _crc_bit(crc, bit)
    return len(fields), *_runs(fields), crc


@lru_cache(1024)
def _fd_head(identifier: int) -> tuple[int, int, int]:
    """Return the bits at the nominal rate before the data, their stuff bits, and the run that they end with."""
    # Start, base identifier, SRR, IDE, extension, RRS, FDF, reserved, BRS.
    nominal = [0, *_bits(identifier >> 18, 11), 1, 1, *_bits(identifier & 0x3FFFF, 18), 0, 1, 0, 1]
    return len(nominal), *_runs(nominal)


def _bits(value: int, count: int) -> list[int]:
    return [(value >> place) & 1 for place in range(count - 1, -1, -1)]


def _crc_bit(crc: int, bit: int) -> int:
    top = bit ^ (crc >> 14)
    crc = (crc << 1) & 0x7FFF
    return crc ^ _POLYNOMIAL if top else crc


@cache
def _crc_of_octet(octet: int) -> int:
    crc = 0
    for bit in _bits(octet, 8):
        crc = _crc_bit(crc, bit)
    return crc


def _crc(crc: int, octet: int) -> int:
    return (crc << 8) & 0x7FFF ^ _crc_of_octet(crc >> 7 ^ octet)


@cache
def _run(state: int, value: int, width: int) -> tuple[int, int]:
    """Stuff bits that ``width`` bits of ``value`` get after ``state``, and the state then.

    Remembered for every octet, so that a frame is looked at octet by octet: a sender that is held to the time of the
    wire has no time to look at each bit.
    """
    last, run = ((state - 1) >> 2, ((state - 1) & 3) + 1) if state != _NO_BIT else (-1, 0)
    stuffed = 0
    for bit in _bits(value, width):
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:  # a stuff bit after five equal ones; it is the first of the next run
            stuffed, last, run = stuffed + 1, 1 - bit, 1
    return stuffed, 1 + 4 * last + run - 1


def _runs(bits: list[int]) -> tuple[int, int]:
    stuffed, state = 0, _NO_BIT
    for bit in bits:
        more, state = _run(state, bit, 1)
        stuffed += more
    return stuffed, state
