"""The share of a link that data messages use: the node's budget, the load of a CAN bus (operation.md sections 4, 6)."""

from __future__ import annotations

from typing import Final

from teds_provision.protocol.operation.can_frames import FD_OCTETS, fd_length, frames_of

MILLION: Final = 10**6
MOST_OCTETS: Final = 240
"""Octets of the longest data message, whatever the link."""
MOST_LOAD: Final = 0.6
"""Share of a CAN bus that a station lets data frames take, at worst-case stuffing."""
BLE_OVERHEAD: Final = 4
_FULL_OCTETS: Final = 8


def frames(length: int, *, link: str, fd: bool) -> int:
    """Return the frames of a data message: of 8 octets, on FD of 64, on BLE one. ``link`` is ``can`` or ``ble``."""
    return 1 if link == "ble" else frames_of(length, fd=fd)


def share(count: int, gap: int, n: int, period: int) -> int:
    """Return a stream's share of the node's budget in ppm: ⌈frames · g · 10^9 / (n · period)⌉ (g in µs, period in ns).

    The node counts with g at least 1; the sum over its streams on one bus is at most 10^6.
    """
    return -(-count * gap * 10**9 // (n * period))


def classic_bits(octets: int, *, worst: bool = True) -> int:
    """Return the bits of a classic frame with a 29-bit identifier and ``octets`` of data, interframe space included.

    ISO 11898-1. ``worst``: with the most stuff bits that can be; else without any.
    """
    stuffed = 54 + 8 * octets  # start, identifier, control, data, CRC: the part with stuff bits
    return stuffed + (stuffed - 1) // 4 * worst + 13


def fd_seconds(octets: int, bitrate: int, data_bitrate: int, *, worst: bool = True) -> float:
    """Return the seconds of an FD frame, 29-bit identifier, bit rate switched; ``octets`` is a length of FD.

    ISO 11898-1:2015: CRC of 17 bits up to 16 octets, else of 21, with the stuff count and its fixed stuff bits.
    """
    slow = 36  # start to the bit-rate switch
    fast = 5 + 8 * octets  # ESI, DLC, data
    crc = 17 if octets <= 16 else 21
    fixed = 4 + crc + 1 + (4 + crc) // 4  # stuff count, CRC, fixed stuff bits (one first, then every fourth)
    stuff_slow, stuff_fast = ((slow - 1) // 4 * worst, fast // 4 * worst)
    tail = 1 + 2 + 7 + 3  # CRC delimiter, ACK and its delimiter, end of frame, interframe space
    return (slow + stuff_slow + tail) / bitrate + (fast + stuff_fast + fixed) / data_bitrate


def bus_load(
    length: int, n: int, period: int, *, bitrate: int, data_bitrate: int | None = None, worst: bool = True
) -> float:
    """Share of a CAN bus that one stream takes: messages of ``length`` octets, one every n · period ns."""
    if data_bitrate is None:
        whole, rest = divmod(length, _FULL_OCTETS)
        bits = whole * classic_bits(_FULL_OCTETS, worst=worst) + (classic_bits(rest, worst=worst) if rest else 0)
        seconds = bits / bitrate
    else:
        whole, rest = divmod(length, FD_OCTETS)
        seconds = whole * fd_seconds(FD_OCTETS, bitrate, data_bitrate, worst=worst)
        seconds += fd_seconds(fd_length(rest), bitrate, data_bitrate, worst=worst) if rest else 0.0
    return seconds * 1e9 / (n * period)
