"""Limits that no tool can beat: how long an exchange's octets occupy its link, and the waits of the contract.

Seconds, from (request, reply) sizes. Of a CAN bus a question counts with its answer; of a Type 4 tag the activation,
the initial message, selecting and leaving the service, and t_wait before each answer (docs/contract, "NFC").
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from statistics import fmean

from teds_provision.links.can.pacing import classic_bits, fd_seconds
from teds_provision.links.nfc import message, tnep
from teds_provision.node.nfc.server import answer_seconds, command_seconds

Sizes = Sequence[tuple[int, int]]

BITRATE, DATA_BITRATE = 500_000, 2_000_000
_IDENTIFIER = 0x18DA21F1
_DICE = random.Random(1)
_SEALED = [_DICE.randbytes(64) for _ in range(100)]
"""What sealed octets look like: as many stuff bits as chance gives, on average."""
_FLOW = bytes([0x30, 16, 0]).ljust(8, b"\xcc")
_FRAME_DELAY = (9 * 128 + 84 + 1172) / 13.56e6  # seconds: ISO/IEC 14443-3 clause 6.2, both directions
_RECORD, _STATUS = 40, 6  # octets: header, type and piece header of the payload record; the Te record
_LARGEST_APDU_DATA = 248
_BLOCK = 16


def classic(sizes: Sizes) -> float:
    """Return the seconds of all frames of these exchanges on a classic bus of 500 kbit/s, with flow control."""
    bits = fmean(classic_bits(_IDENTIFIER, octets[:8]) for octets in _SEALED)
    return sum(_classic_frames(size + 1) for size in _each(sizes)) * bits / BITRATE


def fd(sizes: Sizes) -> float:
    """Return the same on FD, 500 kbit/s and 2 Mbit/s."""
    full = _fd_frame(64)
    flow = fd_seconds(_IDENTIFIER, _FLOW, BITRATE, DATA_BITRATE)
    total = 0.0
    for size in _each(sizes):
        octets = size + 1
        if octets <= 62:
            total += _fd_frame(octets + (1 if octets <= 7 else 2))
        else:
            consecutive = -(-(octets - 62) // 63)
            last = octets - 62 - 63 * (consecutive - 1) + 1
            total += consecutive * full + _fd_frame(last) + _flows(consecutive) * flow
    return total


@cache
def _fd_frame(octets: int) -> float:
    return fmean(fd_seconds(_IDENTIFIER, sealed[:octets], BITRATE, DATA_BITRATE) for sealed in _SEALED)


def type4(sizes: Sizes) -> float:
    """Return the same on a Type 4 tag at 106 kbit/s: message and length in as few commands as possible."""
    return sum(_written(request) + _answer(reply) for request, reply in sizes)


def type4_in_two_steps(sizes: Sizes) -> float:
    """Return the same with the length read by a separate command, as in NFC Forum's read procedure."""
    return sum(
        _written(request) + _block(5, 4) + sum(_block(5, octets + 2) for octets in _cut(_RECORD + _STATUS + reply))
        for request, reply in sizes
    )


def type4_finding() -> float:
    """Return the seconds from the first short frame to the initial message, with the service's selection and end."""
    initial = message.encode([tnep.ServiceParameters(tnep.SERVICE, 4, 15, 2000).record(), tnep.id_record(bytes(23))])
    activation = ((b"\x26", 2), (b"\x93\x20", 5), (bytes(7), 1), (b"\xe0\x80", 5))  # a UID of four octets
    application = ((13, 2), (7, 2), (5, 17), (7, 2), *((5, octets + 2) for octets in _cut(2 + len(initial))))
    select, leave, status = (
        2 + len(message.encode([record])) for record in (tnep.select(tnep.SERVICE), tnep.select(b""), tnep.status(0))
    )
    service = ((5 + select, 2), (5, status + 2), (5 + leave, 2))
    return sum(_frame(command, bytes(back)) for command, back in activation) + sum(
        _block(there, back) for there, back in (*application, *service)
    )


def type4_waits(exchanges: int) -> float:
    """Return the sum of t_wait between each request and the first look for its answer, with the service's selection."""
    return (exchanges + 1) * tnep.ServiceParameters(tnep.SERVICE, 4, 15, 2000).t_wait


def _written(request: int) -> float:
    return sum(_block(5 + octets, 2) for octets in _cut(2 + _RECORD + request))


def _answer(reply: int) -> float:
    return sum(_block(5, octets + 2) for octets in _cut(2 + _RECORD + _STATUS + reply))


def _block(there: int, back: int) -> float:
    return _frame(bytes(there + 1), bytes(back + 1))


def _frame(command: bytes, answer: bytes) -> float:
    return command_seconds(command) + _FRAME_DELAY + answer_seconds(command, answer)


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


IDENTIFY = (6, 26)
"""Octets of the command that finds a node on a bus, and of its reply."""


@dataclass(frozen=True)
class Limit:
    """The least of one link: what its ``octets`` occupy, finding included, and the contract's ``waits`` by exchanges.

    ``exchanges`` is what was reckoned until 2026-11-21: the octets of the exchanges after the finding, nothing else.
    """

    octets: Callable[[Sizes], float]
    waits: Callable[[int], float]
    exchanges: Callable[[Sizes], float]


def _found(octets: Callable[[Sizes], float]) -> Callable[[Sizes], float]:
    return lambda sizes: octets([IDENTIFY, *sizes])


TYPE4 = Limit(lambda sizes: type4_finding() + type4(sizes), type4_waits, type4_in_two_steps)
# What a node waits before it answers everyone is drawn at random: each prints its own (benchmarks.nodes).
CLASSIC = Limit(_found(classic), lambda _: 0.0, classic)
FD = Limit(_found(fd), lambda _: 0.0, fd)
