"""What the node in C was measured to need: held by ``make firmware-arm`` at a fifth more, told in firmware/README.md.

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
    "m0-security": 17_132,
    "m0-full": 28_325,
    "m0-nfc": 31_910,
    "m0-ble": 33_625,
    "m4-security": 16_554,
    "m4-full": 26_945,
    "m4-nfc": 30_428,
    "m4-ble": 31_919,
    "m33-security": 16_548,
    "m33-full": 26_939,
    "m33-nfc": 30_422,
    "m33-ble": 31_905,
}
POINTS: Final = {
    "m0": {"make": 10_510_000, "sign": 14_760_000, "verify": 29_420_000, "ecdh": 15_580_000, "ccm-25-samples": 68_200},
    "m4": {"make": 4_340_000, "sign": 5_570_000, "verify": 11_420_000, "ecdh": 6_270_000, "ccm-25-samples": 48_900},
    "m33": {"make": 4_340_000, "sign": 5_570_000, "verify": 11_420_000, "ecdh": 6_270_000, "ccm-25-samples": 48_900},
}
STEPS: Final = {
    "m0": {
        "first-start": Cost(25_596_240, 3932),
        "identify": Cost(400, 372),
        "prove": Cost(14_765_360, 3948),
        "one-time-key": Cost(10_506_920, 2468),
        "request": Cost(79_718_080, 4428),
        "confirm": Cost(20_600, 1076),
        "open": Cost(17_187_720, 3532),
        "sealed-identify": Cost(90_760, 1476),
        "write-639-octets": Cost(389_400, 1476),
        "commit": Cost(60_494_000, 4620),
        "read-639-octets": Cost(391_520, 1476),
        "sample": Cost(83_760, 1476),
        "data-message-of-25": Cost(133_680, 1396),
    },
    "m4": {
        "first-start": Cost(10_093_320, 2896),
        "identify": Cost(280, 360),
        "prove": Cost(5_570_240, 2912),
        "one-time-key": Cost(4_334_600, 1236),
        "request": Cost(31_408_160, 3088),
        "confirm": Cost(15_600, 848),
        "open": Cost(6_971_880, 2192),
        "sealed-identify": Cost(65_360, 1440),
        "write-639-octets": Cost(269_400, 1440),
        "commit": Cost(23_600_960, 2924),
        "read-639-octets": Cost(273_800, 1440),
        "sample": Cost(60_160, 1440),
        "data-message-of-25": Cost(79_800, 1272),
    },
    "m33": {
        "first-start": Cost(10_095_900, 2896),
        "identify": Cost(250, 360),
        "prove": Cost(5_571_850, 2912),
        "one-time-key": Cost(4_334_950, 1236),
        "request": Cost(31_416_000, 3088),
        "confirm": Cost(15_700, 848),
        "open": Cost(6_973_750, 2192),
        "sealed-identify": Cost(65_450, 1440),
        "write-639-octets": Cost(269_500, 1440),
        "commit": Cost(23_607_100, 2924),
        "read-639-octets": Cost(273_900, 1440),
        "sample": Cost(60_250, 1440),
        "data-message-of-25": Cost(79_800, 1272),
    },
}
STACK: Final = 3280
"""High-water mark over a whole ``node check --factory`` on the emulated M4, octets."""
NODE: Final = 11_992
"""sizeof(teds_node) with the defaults, octets."""


def row(step: str) -> str:
    """The README's table row of a step: million instructions, stack, and time at the clock of :data:`CLOCKS`."""
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
