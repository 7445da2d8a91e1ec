"""Access codes by name; separate from the codec, which users of the names need not import."""

from __future__ import annotations

from enum import IntEnum


class AccessCode(IntEnum):
    """Access code of a TEDS class (teds.md, "Access codes"); the TEDSID of each TEDS repeats it.

    128, 130 and 131 are ours: the Security TEDS of the profile, Origin and Certificate. 16 is what the 2024 edition
    calls by the first one's name.
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
    ORIGIN = 130
    CERTIFICATE = 131
