"""Access codes of the TEDS, the numbers by which a node's TEDS are asked for (teds.md, "Access codes")."""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class AccessCode(IntEnum):
    """Access code of a TEDS class; the TEDSID of each TEDS repeats it.

    128 is ours: the Security TEDS of the profile. 16 is what the 2024 edition calls by the same name.
    """

    META = 1
    META_ID = 2
    CHANNEL = 3
    CHANNEL_ID = 4
    CALIBRATION = 5
    CALIBRATION_ID = 6
    END_USER = 7
    FREQUENCY_RESPONSE = 8
    TRANSFER = 9
    COMMANDS = 10
    TITLE = 11
    NAME = 12
    PHY = 13
    LOCATION = 14
    UNITS_EXTENSION = 15
    SECURITY_2024 = 16
    TIME_SYNC = 17
    SECURITY = 128


TEXT_BASED: Final = frozenset(
    {
        AccessCode.META_ID,
        AccessCode.CHANNEL_ID,
        AccessCode.CALIBRATION_ID,
        AccessCode.COMMANDS,
        AccessCode.TITLE,
        AccessCode.LOCATION,
        AccessCode.UNITS_EXTENSION,
    }
)
"""Classes whose content is text behind a directory (teds.md, "Text-based TEDS (2, 4, 6, 10, 11, 14, 15)")."""
ONLY_2024: Final = frozenset({AccessCode.SECURITY_2024, AccessCode.TIME_SYNC})
MANUFACTURER: Final = 128
"""First type and first access code of the manufacturers' range."""
