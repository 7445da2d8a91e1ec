"""Rows of the Meta-TEDS, the TransducerChannel TEDS and the transducer name TEDS (teds.md, "Access codes")."""

from __future__ import annotations

from typing import Any, Final

from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.tables.field_spec import FieldSpec, Need

UNITS_NAMES: Final = {
    50: "UnitType",
    51: "Radians",
    52: "SterRad",
    53: "Meters",
    54: "Kilogram",
    55: "Seconds",
    56: "Amperes",
    57: "Kelvins",
    58: "Moles",
    59: "Candelas",
    60: "UnitsExt",
}
INTERPRETATIONS: Final = {
    0: "product of SI units",
    1: "ratio of a unit to itself",
    2: "log10 of the product",
    3: "log10 of the ratio",
    4: "digital data",
    5: "arbitrary",
}
CAL_KEY: Final = {
    0: "CAL_NONE",
    1: "CAL_SUPPLIED",
    3: "CAL_CUSTOM",
    4: "TIM_CAL_SUPPLIED",
    5: "TIM_CAL_SELF",
    6: "TIM_CAL_CUSTOM",
}
CHANNEL_TYPE: Final = {0: "sensor", 1: "actuator", 2: "event sensor"}
SELF_TEST: Final = {0: "none", 1: "provided"}
DATA_MODEL: Final = {
    0: "unsigned integer",
    1: "Float32",
    2: "Float64",
    3: "fraction",
    4: "bit sequence",
    5: "long integer",
    6: "long fraction",
    7: "time of day",
}
DATA_XMIT: Final = {
    1: "on command",
    2: "command or buffer full",
    3: "command or interval",
    4: "command, buffer or interval",
    5: "buffer full",
    6: "interval",
    7: "buffer or interval",
}
EDGE_REPORT: Final = {
    0: "not applicable",
    1: "rising",
    2: "falling",
    3: "both",
    5: "selectable, default rising",
    6: "selectable, default falling",
    7: "selectable, default both",
}
ACTUATOR_HALT: Final = {0: "not applicable", 1: "halt at once", 2: "halt at end of data set", 3: "ramp"}
EVENT_OPTION: Final = {
    0: "not applicable",
    1: "not changeable",
    2: "changeable, inconsistencies detected",
    3: "changeable, inconsistencies not detected",
}

_UNIT_ROWS: Final = tuple(
    FieldSpec(number, name, "u8", enumeration=INTERPRETATIONS if number == 50 else {}, enumeration_confidence="H")
    for number, name in UNITS_NAMES.items()
)


def _row(number: int, name: str, kind: str, need: Need = "O", **more: Any) -> FieldSpec:
    return FieldSpec(number, name, kind, need, **more)


def _units(number: int, name: str, need: Need = "O") -> FieldSpec:
    return FieldSpec(number, name, "units", need, children=_UNIT_ROWS, meaning="physical units, three spellings")


def _seconds(number: int, name: str, need: Need, meaning: str) -> FieldSpec:
    return FieldSpec(number, name, "f32", need, meaning=meaning, unit="s")


_GRP_TYPE = _row(20, "GrpType", "u8", meaning="kind of group (enumeration not available)")
_MEM_LIST = _row(21, "MemList", "u16[]", meaning="channel numbers of the members")
_LOC_ENUM = _row(24, "LocEnum", "u8", meaning="kind of location (enumeration not available)")
_PROXY_NUM = _row(22, "ChanNum", "u16", meaning="channel number of the proxy", also=(1,))
_ORGANIZ = _row(23, "Organiz", "u8", meaning="organisation of the proxy data set (enumeration not available)")

META: Final = (
    _row(4, "UUID", "uuid", "R", meaning="globally unique identifier, 10 octets (2024: 16)"),
    _seconds(10, "OholdOff", "R", "operational time-out"),
    _seconds(11, "SHoldOff", "O", "slow-access time-out"),
    _seconds(12, "TestTime", "R", "self-test time"),
    _row(13, "MaxChan", "u16", "R", meaning="number of implemented TransducerChannels"),
    _row(14, "CGroup", "tlv", repeats=True, children=(_GRP_TYPE, _MEM_LIST), meaning="control group"),
    _row(15, "VGroup", "tlv", repeats=True, children=(_GRP_TYPE, _MEM_LIST), meaning="vector group"),
    _row(16, "GeoLoc", "tlv", repeats=True, children=(_LOC_ENUM, _GRP_TYPE, _MEM_LIST), meaning="geographic group"),
    _row(17, "Proxies", "tlv", repeats=True, children=(_PROXY_NUM, _ORGANIZ, _MEM_LIST), meaning="proxy channels"),
)

_SAMPLE = (
    _row(40, "DatModel", "u8", "R", enumeration=DATA_MODEL, enumeration_confidence="H", meaning="data model"),
    _row(41, "ModLenth", "u8", "R", meaning="data model length in octets"),
    _row(42, "SigBits", "u16", "R", also=(1,), meaning="significant bits"),
)
_DATA_SET = (
    _row(43, "Repeats", "u16", also=(1,), meaning="maximum data repetitions"),
    _row(44, "SOrigin", "f32", meaning="series origin, in SUnits"),
    _row(45, "StepSize", "f32", meaning="series increment, in SUnits"),
    _units(46, "SUnits"),
    _row(47, "PreTrigg", "u16", also=(1,), meaning="maximum pre-trigger samples"),
)
_SAMPLING = (
    _row(48, "SampMode", "u8", "R", meaning="sampling modes, one bit each: 0 trigger, 1 free without pre-trigger, ..."),
    _row(49, "SDefault", "u8", meaning="default mode: the mask bit or the number 1 to 5 (sources disagree)"),
)

CHANNEL: Final = (
    _row(10, "CalKey", "u8", "R", enumeration=CAL_KEY, meaning="calibration key"),
    _row(11, "ChanType", "u8", "R", enumeration=CHANNEL_TYPE, enumeration_confidence="H", meaning="channel type"),
    _units(12, "PhyUnits", "R"),
    _row(13, "LowLimit", "f32", "R", meaning="lower range limit, in PhyUnits"),
    _row(14, "HiLimit", "f32", "R", meaning="upper range limit, in PhyUnits"),
    _row(15, "OError", "f32", "R", meaning="worst-case uncertainty, in PhyUnits"),
    _row(16, "SelfTest", "u8", "R", enumeration=SELF_TEST, enumeration_confidence="H", meaning="self-test key"),
    _row(17, "MRange", "u8", meaning="multi-range capability (enumeration not available)"),
    _row(18, "Sample", "tlv", "R", children=_SAMPLE, meaning="sample definition"),
    _row(19, "DataSet", "tlv", children=_DATA_SET, meaning="data set definition"),
    _seconds(20, "UpdateT", "R?", "channel update time"),
    _seconds(21, "WSetupT", "O", "write set-up time"),
    _seconds(22, "RSetupT", "R?", "read set-up time (sensors)"),
    _seconds(23, "SPeriod", "R?", "sampling period"),
    _seconds(24, "WarmUpT", "R?", "warm-up time"),
    _seconds(25, "RDelayT", "R?", "read delay time"),
    _seconds(26, "TestTime", "O", "self-test time"),
    _row(27, "TimeSrc", "u8", meaning="source of the time of sample (enumeration not available)"),
    _seconds(28, "InPropDl", "O", "incoming propagation delay"),
    _seconds(29, "OutPropD", "O", "outgoing propagation delay"),
    _seconds(30, "TSError", "O", "trigger-to-sample delay uncertainty"),
    _row(31, "Sampling", "tlv", "R?", children=_SAMPLING, meaning="sampling attributes"),
    _row(32, "DataXmit", "u8", enumeration=DATA_XMIT, meaning="data transmission capability"),
    _row(33, "Buffered", "u8", meaning="buffered attribute (enumeration not available)"),
    _row(34, "EndOfSet", "u8", meaning="end-of-data-set operation (enumeration not available)"),
    _row(35, "EdgeRpt", "u8", enumeration=EDGE_REPORT, meaning="edge to report"),
    _row(36, "ActHalt", "u8", enumeration=ACTUATOR_HALT, meaning="actuator halt"),
    _row(37, "Directon", "f32", meaning="sensitivity direction"),
    _row(38, "DAngles", "f32x2", meaning="direction angles"),
    _row(39, "ESOption", "u8", enumeration=EVENT_OPTION, meaning="event sensor options"),
)

_FORMAT = {0: "user defined", 1: "text-based"}
NAME: Final = (
    _row(4, "Format", "u8", "R", enumeration=_FORMAT, enumeration_confidence="H", meaning="layout of the name"),
    _row(5, "TCName", "text", "R", meaning="name that the user gave the transducer"),
)
# The explanatory text of the same clause counts 10 and 11; nobody is known to write them, we read them.
NAME_ALIASES: Final = {
    10: _row(10, "Format", "u8", confidence="L", enumeration=_FORMAT, meaning="Format in the numbering of the text"),
    11: _row(11, "TCName", "text", confidence="L", meaning="TCName in the numbering of the text"),
}

TABLES: Final[dict[int, dict[str, Any]]] = {
    AccessCode.META: {"rows": META, "source": 'teds.md, "1 MetaTEDS"'},
    AccessCode.CHANNEL: {"rows": CHANNEL, "source": 'teds.md, "3 ChanTEDS"'},
    AccessCode.NAME: {"rows": NAME, "aliases": NAME_ALIASES, "source": 'teds.md, "12 XdcrName"'},
}
