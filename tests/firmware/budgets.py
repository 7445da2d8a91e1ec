"""What the node in C was measured to need: held by ``make firmware-arm`` at a fifth more or at
the contract's bound where that is met, told in firmware/docs/figures.md.

Instructions and stack are counted by qemu (``firmware/port/qemu/steps.c``, ``measure.c``), sizes by
``arm-none-eabi-size``; arm-none-eabi-gcc 12.2, -Os, BearSSL 0.6.
"""

from __future__ import annotations

from typing import Final, NamedTuple

CPUS: Final = {"m0": "Cortex-M0+", "m4": "Cortex-M4", "m33": "Cortex-M33"}
CLOCKS: Final = {"m0": 48, "m4": 64, "m33": 128}
"""MHz of a usual chip of each: at an instruction a cycle they make the README's times."""
MORE: Final = 1.2


class Cost(NamedTuple):
    """Of a step: instructions, and octets of stack below its call."""

    instructions: int
    stack: int


TEXT: Final = {
    "m0-security": 16_806,
    "m0-full": 27_049,
    "m0-managed": 29_317,
    "m0-nfc": 31_242,
    "m0-ble": 32_829,
    "m4-security": 16_440,
    "m4-full": 26_147,
    "m4-managed": 28_313,
    "m4-nfc": 30_214,
    "m4-ble": 31_667,
    "m33-security": 16_444,
    "m33-full": 26_151,
    "m33-managed": 28_317,
    "m33-nfc": 30_212,
    "m33-ble": 31_665,
}
POINTS: Final = {
    "m0": {"make": 10_510_000, "sign": 14_760_000, "verify": 29_420_000, "ecdh": 15_580_000, "ccm-25-samples": 68_200},
    "m4": {"make": 4_340_000, "sign": 5_570_000, "verify": 11_420_000, "ecdh": 6_270_000, "ccm-25-samples": 48_900},
    "m33": {"make": 4_340_000, "sign": 5_570_000, "verify": 11_420_000, "ecdh": 6_270_000, "ccm-25-samples": 48_900},
}
STEPS: Final = {
    "m0": {
        "first-start": Cost(25_901_880, 3892),
        "identify": Cost(400, 196),
        "prove": Cost(14_765_480, 3820),
        "one-time-key": Cost(10_506_920, 2476),
        "request": Cost(79_715_400, 4012),
        "confirm": Cost(20_440, 684),
        "open": Cost(17_187_520, 3204),
        "sealed-identify": Cost(91_080, 1492),
        "write-639-octets": Cost(389_640, 1492),
        "commit": Cost(60_560_160, 4284),
        "read-639-octets": Cost(391_840, 1492),
        "sample": Cost(84_120, 1492),
        "data-message-of-25": Cost(138_600, 1364),
    },
    "m4": {
        "first-start": Cost(10_294_200, 2856),
        "identify": Cost(280, 160),
        "prove": Cost(5_570_320, 2752),
        "one-time-key": Cost(4_334_600, 1244),
        "request": Cost(31_405_920, 2808),
        "confirm": Cost(15_680, 652),
        "open": Cost(6_971_680, 2040),
        "sealed-identify": Cost(65_680, 1440),
        "write-639-octets": Cost(269_680, 1440),
        "commit": Cost(23_638_520, 2796),
        "read-639-octets": Cost(274_080, 1440),
        "sample": Cost(60_560, 1440),
        "data-message-of-25": Cost(82_000, 1264),
    },
    "m33": {
        "first-start": Cost(10_296_800, 2856),
        "identify": Cost(250, 160),
        "prove": Cost(5_571_950, 2752),
        "one-time-key": Cost(4_335_000, 1244),
        "request": Cost(31_414_100, 2808),
        "confirm": Cost(15_750, 652),
        "open": Cost(6_973_500, 2040),
        "sealed-identify": Cost(65_750, 1440),
        "write-639-octets": Cost(269_800, 1440),
        "commit": Cost(23_663_850, 2796),
        "read-639-octets": Cost(274_200, 1440),
        "sample": Cost(60_650, 1440),
        "data-message-of-25": Cost(82_050, 1264),
    },
}
STACK: Final = 3040
"""High-water mark over a whole ``node check --factory`` on the emulated M4, octets."""
NODE: Final = 11_912
"""sizeof(teds_node) with the defaults, octets."""
SMALL: Final = 8_688
"""The same of :data:`SMALL_WORDS`: provisioning over classic CAN alone, two stations."""
SMALL_WORDS: Final = ("-DTEDS_OPERATION=0", "-DTEDS_CAN_FD=0", "-DTEDS_CAN_LINES=3", "-DTEDS_REPLIES=2")
STACK_BOUND: Final = 3 * 1024
SMALL_BOUND: Final = 8704
"""Bounds of the contract that are met: held as they are, not at a fifth more."""


def row(step: str) -> str:
    """Return the README's table row of a step: million instructions, stack, and time at the clock of :data:`CLOCKS`."""
    cells = [step]
    for cpu, steps in STEPS.items():
        cost = steps[step]
        ms = cost.instructions / CLOCKS[cpu] / 1000
        count = cost.instructions
        counted = f"{count / 1e6:.1f} M" if count >= 1e6 else f"{count / 1e3:.0f} k" if count >= 1e4 else f"{count}"
        cells.append(f"{counted}, {_time(ms)}, {cost.stack:,}")
    return f"| {' | '.join(cells)} |"


def _time(ms: float) -> str:
    if ms >= 100:
        return f"{ms / 1000:.2f} s"
    return f"{ms:.0f} ms" if ms >= 10 else f"{ms:.1f} ms" if ms >= 0.1 else "0 ms"
