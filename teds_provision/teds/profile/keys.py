"""The keys of a profile: one table from the words of the file to the fields of the TEDS.

The reader, the template of ``profile new`` and docs/profiles.md all follow these tables. Field names and enumerations
are those of teds.md, "1 MetaTEDS", "3 ChanTEDS" and "13 PHYTEDS (IEEE 1451.5, family 5)".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Final


class KeyKind(Enum):
    """Forms of values in a profile (docs/profiles.md, "Units and times")."""

    TIME = "time"
    """Seconds, or a text like "100 us"."""
    VALUE = "value"
    """A number in the channel's unit, or a text with its own unit."""
    DIFFERENCE = "difference"
    """As VALUE, without the offset of the unit."""
    ANGLE = "angle"
    """A number of rad, or a text like "90 degree"."""
    FLAG = "true or false"
    U8 = "0 to 255"
    U16 = "0 to 65535"
    U32 = "0 to 4294967295"
    NUMBER = "number"
    CHOICE = "one of"
    CHOICES = "list of"


class KeyNeed(Enum):
    """Need of a key in a profile; USUAL: present in every complete datasheet, a warning if it is left out."""

    REQUIRED = "required"
    USUAL = "usual"
    OPTIONAL = "optional"


@dataclass(frozen=True)
class Key:
    """One key of the profile and the TEDS field that it fills."""

    key: str
    field: str
    kind: KeyKind
    help: str
    need: KeyNeed = KeyNeed.OPTIONAL
    choices: Mapping[str, int] = dataclasses.field(default_factory=dict)
    example: str = ""


CHANNEL_TYPES: Final = {"sensor": 0, "actuator": 1, "event-sensor": 2}
CALIBRATION_KEYS: Final = {
    "none": 0,
    "supplied": 1,
    "custom": 3,
    "tim-supplied": 4,
    "tim-self": 5,
    "tim-custom": 6,
}
MODELS: Final = {
    "unsigned": 0,
    "float32": 1,
    "float64": 2,
    "fraction": 3,
    "bits": 4,
    "long-integer": 5,
    "long-fraction": 6,
    "time-of-day": 7,
}
MODES: Final = {"trigger": 1, "free-running": 2, "free-running-pre-trigger": 4, "continuous": 8, "immediate": 16}
TRANSMISSIONS: Final = {
    "command": 1,
    "command-or-buffer-full": 2,
    "command-or-interval": 3,
    "command-buffer-or-interval": 4,
    "buffer-full": 5,
    "interval": 6,
    "buffer-or-interval": 7,
}
EDGES: Final = {
    "none": 0,
    "rising": 1,
    "falling": 2,
    "both": 3,
    "selectable-rising": 5,
    "selectable-falling": 6,
    "selectable-both": 7,
}
HALTS: Final = {"none": 0, "at-once": 1, "end-of-data-set": 2, "ramp": 3}
EVENT_OPTIONS: Final = {"none": 0, "fixed": 1, "changeable-checked": 2, "changeable-unchecked": 3}
RADIOS: Final = {"802.11": 0, "bluetooth": 1, "zigbee": 2, "6lowpan": 3, "manufacturer": 255}

_R, _U = KeyNeed.REQUIRED, KeyNeed.USUAL

META_KEYS: Final = (
    Key(
        "operation-timeout",
        "OholdOff",
        KeyKind.TIME,
        "longest time from a command to its reply",
        _R,
        example='"100 ms"',
    ),
    Key(
        "slow-timeout",
        "SHoldOff",
        KeyKind.TIME,
        "the same for slow accesses, such as writing to flash",
        example='"2 s"',
    ),
    Key("self-test-time", "TestTime", KeyKind.TIME, "longest time of the self-test, 0 for none", _R, example="0.0"),
)
GROUP_KEYS: Final = (
    Key("type", "GrpType", KeyKind.U8, "kind of group, a number of the standard", _R, example="0"),
    Key("members", "MemList", KeyKind.CHOICES, "numbers of the channels in it", _R, example="[1, 2]"),
)
GEO_KEYS: Final = (
    Key("location", "LocEnum", KeyKind.U8, "how the place is known, a number", _R, example="0"),
    *GROUP_KEYS,
)
PROXY_KEYS: Final = (
    Key("channel", "ChanNum", KeyKind.U16, "number of the proxy channel", _R, example="3"),
    Key("organization", "Organiz", KeyKind.U8, "how its data set is put together, a number", _R, example="0"),
    GROUP_KEYS[1],
)
META_GROUPS: Final = {
    "control-group": ("CGroup", GROUP_KEYS),
    "vector-group": ("VGroup", GROUP_KEYS),
    "geo-location": ("GeoLoc", GEO_KEYS),
    "proxy": ("Proxies", PROXY_KEYS),
}

SAMPLE_KEYS: Final = (
    Key("model", "DatModel", KeyKind.CHOICE, "how one sample is coded", _R, MODELS, '"unsigned"'),
    Key("octets", "ModLenth", KeyKind.U8, "octets of one sample", _R, example="2"),
    Key("bits", "SigBits", KeyKind.U16, "bits of it that mean something", _R, example="16"),
)
DATA_SET_KEYS: Final = (
    Key("repeats", "Repeats", KeyKind.U16, "samples after the first", _R, example="0"),
    Key("origin", "SOrigin", KeyKind.NUMBER, "start of the series, in its unit", example="0.0"),
    Key("step", "StepSize", KeyKind.NUMBER, "distance of two samples, in its unit", example="0.0"),
    Key("pre-trigger", "PreTrigg", KeyKind.U16, "samples kept from before the trigger", example="0"),
)
CHANNEL_KEYS: Final = (
    Key("type", "ChanType", KeyKind.CHOICE, "what the channel is", _R, CHANNEL_TYPES, '"sensor"'),
    Key("low-limit", "LowLimit", KeyKind.VALUE, "lowest value that it gives or takes", _R, example="0.0"),
    Key("high-limit", "HiLimit", KeyKind.VALUE, "highest value", _R, example="360.0"),
    Key("uncertainty", "OError", KeyKind.DIFFERENCE, "worst-case uncertainty under all conditions", _R, example="1.0"),
    Key("self-test", "SelfTest", KeyKind.FLAG, "has a self-test", example="false"),
    Key("multi-range", "MRange", KeyKind.FLAG, "has several ranges", example="false"),
    Key("update-time", "UpdateT", KeyKind.TIME, "longest time from trigger to latched sample", _U, example='"100 us"'),
    Key("write-setup-time", "WSetupT", KeyKind.TIME, "wait after writing data before the trigger", example='"0 us"'),
    Key("read-setup-time", "RSetupT", KeyKind.TIME, "wait after the trigger before reading", _U, example='"50 us"'),
    Key("sampling-period", "SPeriod", KeyKind.TIME, "shortest time from sample to sample", _U, example='"10 kHz"'),
    Key("warm-up-time", "WarmUpT", KeyKind.TIME, "time from power on to stated uncertainty", _U, example='"1 s"'),
    Key("read-delay-time", "RDelayT", KeyKind.TIME, "longest delay of a read reply", _U, example='"1 ms"'),
    Key("self-test-time", "TestTime", KeyKind.TIME, "longest time of the self-test", example='"0 s"'),
    Key("time-source", "TimeSrc", KeyKind.U8, "where time stamps come from, a number of the standard", example="0"),
    Key("incoming-delay", "InPropDl", KeyKind.TIME, "propagation delay of what comes in", example='"0 us"'),
    Key("outgoing-delay", "OutPropD", KeyKind.TIME, "propagation delay of what goes out", example='"0 us"'),
    Key("trigger-uncertainty", "TSError", KeyKind.TIME, "uncertainty of the time of sampling", example='"1 us"'),
    Key(
        "transmission", "DataXmit", KeyKind.CHOICE, "when data can be sent", choices=TRANSMISSIONS, example='"command"'
    ),
    Key("buffered", "Buffered", KeyKind.U8, "buffering ability, a number of the standard", example="0"),
    Key("end-of-set", "EndOfSet", KeyKind.U8, "end-of-data-set ability, a number of the standard", example="0"),
    Key(
        "edge-report", "EdgeRpt", KeyKind.CHOICE, "edges that an event sensor reports", choices=EDGES, example='"none"'
    ),
    Key("actuator-halt", "ActHalt", KeyKind.CHOICE, "how an actuator stops", choices=HALTS, example='"none"'),
    Key("direction", "Directon", KeyKind.ANGLE, "sensing direction", example="0.0"),
    Key(
        "direction-angles",
        "DAngles",
        KeyKind.CHOICES,
        "two angles of the direction",
        example='["0 degree", "90 degree"]',
    ),
    Key("event-options", "ESOption", KeyKind.CHOICE, "event sensor settings", choices=EVENT_OPTIONS, example='"none"'),
)
PHY_KEYS: Final = (
    Key("radio", "Radio", KeyKind.CHOICE, "kind of radio (IEEE 1451.5)", _R, RADIOS, '"bluetooth"'),
    Key("bit-rate", "MaxBPS", KeyKind.U32, "highest bit rate, bit/s", example="1000000"),
    Key("connected-devices", "MaxCDev", KeyKind.U16, "devices connected at a time", example="1"),
    Key("registered-devices", "MaxRDev", KeyKind.U16, "devices registered", example="1"),
    Key("encryption", "Encrypt", KeyKind.U16, "high octet kind (1 = AES), low octet key length", example="0x0110"),
    Key("authentication", "Authent", KeyKind.FLAG, "authenticates", example="true"),
    Key("shortest-key", "MinKeyL", KeyKind.U16, "shortest key", example="16"),
    Key("longest-key", "MaxKeyL", KeyKind.U16, "longest key", example="16"),
    Key("largest-unit", "MaxSDU", KeyKind.U16, "octets of the largest service data unit", example="244"),
    Key("access-latency", "MinALat", KeyKind.U32, "lowest access latency", example="0"),
    Key("transmit-latency", "MinTLat", KeyKind.U32, "lowest transmit latency", example="0"),
    Key("open-commands", "MaxXact", KeyKind.U8, "commands open at a time", example="1"),
    Key("battery", "Battery", KeyKind.FLAG, "runs on a battery", example="false"),
    Key("radio-version", "RadioVer", KeyKind.U16, "version of the radio, 0 = unknown", example="0"),
    Key("retries", "MaxRetry", KeyKind.U16, "retries before it disconnects, 0 = never", example="0"),
)
