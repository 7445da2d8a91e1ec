"""What no tool can beat: how long the octets of an exchange occupy its link; seconds, from (request, reply) sizes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from teds_provision.links.can.pacing import classic_bits, fd_seconds
from teds_provision.node.nfc.air import answer_seconds, command_seconds

Sizes = Sequence[tuple[int, int]]

BITRATE, DATA_BITRATE = 500_000, 2_000_000
_IDENTIFIER = 0x18DA21F1
_FLOW = bytes([0x30, 16, 0]).ljust(8, b"\xcc")
_FRAME_DELAY = (9 * 128 + 84 + 1172) / 13.56e6  # seconds: ISO/IEC 14443-3 clause 6.2, both directions
_RECORD, _STATUS = 40, 6  # octets: header, type and piece header of the payload record; the Te record
_LARGEST_APDU_DATA = 248
_BLOCK = 16


def classic(sizes: Sizes) -> float:
    """All frames of these exchanges on a classic bus of 500 kbit/s, flow control included."""
    bits = classic_bits(_IDENTIFIER, bytes(range(8)))
    return sum(_classic_frames(size + 1) for size in _each(sizes)) * bits / BITRATE


def fd(sizes: Sizes) -> float:
    """The same on FD, 500 kbit/s and 2 Mbit/s."""
    full = fd_seconds(_IDENTIFIER, bytes(range(64)), BITRATE, DATA_BITRATE)
    flow = fd_seconds(_IDENTIFIER, _FLOW, BITRATE, DATA_BITRATE)
    total = 0.0
    for size in _each(sizes):
        octets = size + 1
        if octets <= 62:
            total += fd_seconds(_IDENTIFIER, bytes(octets + (1 if octets <= 7 else 2)), BITRATE, DATA_BITRATE)
        else:
            consecutive = -(-(octets - 62) // 63)
            total += (1 + consecutive) * full + _flows(consecutive) * flow
    return total


def type4(sizes: Sizes) -> float:
    """The same on a Type 4 tag at 106 kbit/s, waiting times and presence checks left out."""

    def block(there: int, back: int) -> float:
        command = bytes(there + 1)
        return command_seconds(command) + _FRAME_DELAY + answer_seconds(command, bytes(back + 1))

    total = 0.0
    for request, reply in sizes:
        total += sum(block(5 + octets, 2) for octets in _cut(2 + _RECORD + request))
        total += block(5, 4)
        total += sum(block(5, octets + 2) for octets in _cut(_RECORD + _STATUS + reply))
    return total


def _each(sizes: Sizes) -> Iterable[int]:
    return (size for pair in sizes for size in pair)


def _classic_frames(octets: int) -> int:
    if octets <= 7:
        return 1
    consecutive = -(-(octets - 6) // 7)
    return 1 + consecutive + _flows(consecutive)


def _flows(consecutive: int) -> int:
    return 1 + (consecutive - 1) // _BLOCK


def _cut(octets: int) -> list[int]:
    return [min(_LARGEST_APDU_DATA, octets - at) for at in range(0, octets, _LARGEST_APDU_DATA)]
