"""Field tables of every TEDS class, one per access code, open to inspection (teds.md, "Access codes").

The rows are here, but for those of the Calibration TEDS: the data file ``calibration_fields.toml`` has them, as their
numbers were not checked against the standard.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final, Literal

from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import MANUFACTURER, ONLY_2024, TEXT_BASED

# The parts of a field table, and the names of the TEDS classes (teds.md, "Access codes").

Need = Literal["R", "R?", "O"]
Confidence = Literal["H", "M", "L", "MEM", "unverified"]

NAMES: Final[Mapping[int, str]] = {
    AccessCode.META: "MetaTEDS",
    AccessCode.META_ID: "MetaIdTEDS",
    AccessCode.CHANNEL: "ChanTEDS",
    AccessCode.CHANNEL_ID: "ChanIdTEDS",
    AccessCode.CALIBRATION: "CalTEDS",
    AccessCode.CALIBRATION_ID: "CalIdTEDS",
    AccessCode.END_USER: "EUASTEDS",
    AccessCode.FREQUENCY_RESPONSE: "FreqRespTEDS",
    AccessCode.TRANSFER: "TransferTEDS",
    AccessCode.COMMANDS: "CommandTEDS",
    AccessCode.TITLE: "TitleTEDS",
    AccessCode.NAME: "XdcrName",
    AccessCode.PHY: "PHYTEDS",
    AccessCode.LOCATION: "GeoLocTEDS",
    AccessCode.UNITS_EXTENSION: "UnitsExtention",
    AccessCode.SECURITY_2024: "SecurityTEDS2024",
    AccessCode.TIME_SYNC: "TimeSyncTEDS",
    AccessCode.SECURITY: "SecurityTEDS",
    AccessCode.ORIGIN: "OriginTEDS",
    AccessCode.CERTIFICATE: "CertificateTEDS",
}

# Octets of value kinds with a fixed length; UUID, TEDSID and TimeInstance depend on the edition.
OCTETS: Final[Mapping[str, tuple[int, ...]]] = {
    "u8": (1,),
    "u16": (2,),
    "u32": (4,),
    "f32": (4,),
    "f32x2": (8,),
    "lang": (2,),
    "instant": (8, 10),
    "duration": (8,),
    "block id": (35,),
}


ANY_LENGTH: Final = frozenset({"text", "key", "octets"})
"""Kinds of value of which every number of octets can be read."""


@dataclass(frozen=True)
class FieldSpec:
    """One row of a field table.

    ``kind`` is the data type: u8, u16, u32, f32, f32x2, u16[], f32[], text, key, lang, uuid, units, instant, duration,
    tlv, block id, octets. ``need`` is R (required), R? (carried by every full example) or O. ``weak`` are the values of
    ``enumeration`` that no new TEDS may use. ``also`` are further octet counts that are met in the wild and read.
    """

    type: int
    name: str
    kind: str
    need: Need = "O"
    confidence: Confidence = "H"
    meaning: str = ""
    unit: str = ""
    enumeration: Mapping[int, str] = field(default_factory=dict)
    enumeration_confidence: Confidence = "M"
    children: tuple[FieldSpec, ...] = ()
    repeats: bool = False
    also: tuple[int, ...] = ()
    weak: frozenset[int] = frozenset()
    by_type: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)
    by_name: Mapping[str, FieldSpec] = field(init=False, repr=False, compare=False)
    octets: tuple[int, ...] = field(init=False, repr=False, compare=False)
    any_length: bool = field(init=False, repr=False, compare=False)
    required: frozenset[int] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        required = frozenset(child.type for child in self.children if child.need == "R")
        object.__setattr__(self, "required", required)
        object.__setattr__(self, "by_type", {child.type: child for child in self.children})
        object.__setattr__(self, "by_name", {child.name: child for child in self.children})
        object.__setattr__(self, "octets", OCTETS.get(self.kind, ()))
        object.__setattr__(self, "any_length", self.kind in ANY_LENGTH)


@dataclass(frozen=True)
class Table:
    """All rows of one TEDS class; ``verified`` is False if rows come from memory or from one weak source."""

    access_code: int
    name: str
    rows: tuple[FieldSpec, ...] = ()
    verified: bool = True
    family: int = 0
    source: str = ""
    aliases: Mapping[int, FieldSpec] = field(default_factory=dict)
    by_type: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)
    by_name: Mapping[str, FieldSpec] = field(init=False, repr=False, compare=False)
    required: frozenset[int] = field(init=False, repr=False, compare=False)
    parents: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)
    inner: Mapping[int, FieldSpec] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        inner: dict[int, FieldSpec] = {}
        parents: dict[int, FieldSpec] = {}
        for row in self.rows:
            for child in row.children:
                inner.setdefault(child.type, child)
                parents.setdefault(child.type, row)
        object.__setattr__(self, "by_type", {row.type: row for row in self.rows})
        object.__setattr__(self, "by_name", {row.name: row for row in self.rows})
        object.__setattr__(self, "required", frozenset(row.type for row in self.rows if row.need == "R"))
        object.__setattr__(self, "inner", inner)
        object.__setattr__(self, "parents", parents)


def name_of(access_code: int) -> str:
    """Return the name of a TEDS class, e.g. 3 -> ``ChanTEDS``.

    'reserved' or 'manufacturer' if the standard names none.
    """
    known = NAMES.get(access_code)
    if known is not None:
        return known
    return f"manufacturer {access_code}" if access_code >= MANUFACTURER else f"reserved {access_code}"


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

# Rows of the Meta-TEDS, the TransducerChannel TEDS and the transducer name TEDS (teds.md, "Access codes").

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
    _row(31, "Sampling", "tlv", "R", children=_SAMPLING, meaning="sampling attributes"),
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
# The explanatory text of the same clause numbers these fields 10 and 11; no known software writes them, but they are
# read.
NAME_ALIASES: Final = {
    10: _row(10, "Format", "u8", confidence="L", enumeration=_FORMAT, meaning="Format in the numbering of the text"),
    11: _row(11, "TCName", "text", confidence="L", meaning="TCName in the numbering of the text"),
}

TABLES: Final[dict[int, dict[str, Any]]] = {
    AccessCode.META: {"rows": META, "source": 'teds.md, "1 MetaTEDS"'},
    AccessCode.CHANNEL: {"rows": CHANNEL, "source": 'teds.md, "3 ChanTEDS"'},
    AccessCode.NAME: {"rows": NAME, "aliases": NAME_ALIASES, "source": 'teds.md, "12 XdcrName"'},
}


# Rows of the PHY TEDS (1451.5), the text-based TEDS and both Security TEDS (teds.md, "Access codes").

RADIO: Final = {0: "IEEE 802.11", 1: "Bluetooth", 2: "ZigBee", 3: "6LoWPAN", 255: "manufacturer"}

# Tables 2 to 5 of Mitterer et al. 2023. Weak schemes and ones that were never implemented are decoded, never written.
SECURITY_SCHEMES: Final = {
    0: "NoSec",
    1: "AsVerification",
    2: "DataEncryption",
    3: "CommEncryption",
    4: "AsVerAndData",
}
VERIFICATION: Final = {0: "RSA", 1: "DSA", 2: "ECDSA", 3: "ElGamal", 4: "ECDH"}
ENCRYPTION: Final = {0: "AES-128", 1: "AES-256", 2: "RC4", 3: "DES", 4: "Blowfish"}
HASHES: Final = {0: "MD5", 1: "SHA-256", 2: "SHA-512"}
LEVELS: Final = {
    "A": "encryption",
    "B": "authentication",
    "C": "encryption and authentication",
    "D": "authentication and authorization",
    "E": "all",
    "N": "none",
}


def _phy(number: int, name: str, kind: str, meaning: str, need: Need = "O", **more: Any) -> FieldSpec:
    return FieldSpec(number, name, kind, need, meaning=meaning, **more)


def _own(prefix: str, first: int, last: int) -> tuple[FieldSpec, ...]:
    meaning = f"own field of {prefix}; its name and type are not available"
    return tuple(
        FieldSpec(n, f"{prefix}{n}", "octets", confidence="L", meaning=meaning) for n in range(first, last + 1)
    )


PHY: Final = (
    _phy(10, "Radio", "u8", "radio type", "R?", enumeration=RADIO, enumeration_confidence="H"),
    _phy(11, "MaxBPS", "u32", "maximum data throughput", "R?", unit="bit/s"),
    _phy(12, "MaxCDev", "u16", "connected devices, at most", "R?"),
    _phy(13, "MaxRDev", "u16", "registered devices, at most", "R?"),
    _phy(14, "Encrypt", "u16", "high octet 0 none, 1 AES, 2 SAFER, 3 3DES; low octet the key length"),
    _phy(15, "Authent", "u8", "nonzero: authentication"),
    _phy(16, "MinKeyL", "u16", "shortest key"),
    _phy(17, "MaxKeyL", "u16", "longest key"),
    _phy(18, "MaxSDU", "u16", "largest payload"),
    _phy(19, "MinALat", "u32", "access latency, at least"),
    _phy(20, "MinTLat", "u32", "transmit latency, at least"),
    _phy(21, "MaxXact", "u8", "open commands, at most"),
    _phy(22, "Battery", "u8", "nonzero: runs on a battery"),
    _phy(23, "RadioVer", "u16", "version of the radio, 0 unknown"),
    _phy(24, "MaxRetry", "u16", "retries before disconnecting, 0 never"),
    *_own("Bluetooth", 32, 41),
    *_own("WiFi", 48, 54),
    *_own("ZigBee", 64, 80),
    *_own("LoWPAN", 96, 103),
)

_DIRECTORY = (
    FieldSpec(20, "LangCode", "lang", confidence="M", meaning="language, two letters (ISO 639)"),
    FieldSpec(21, "Offset", "u32", confidence="M", meaning="where the text stands (from where: open)"),
    FieldSpec(22, "Length", "u32", confidence="M", meaning="octets of the text and its checksum"),
    FieldSpec(23, "Compress", "u8", confidence="M", meaning="compression, 0 none"),
)
TEXT: Final = (
    FieldSpec(10, "NumLang", "u8", "R", "M", meaning="number of languages"),
    FieldSpec(
        11, "DirBlock", "tlv", "R", "M", meaning="directory entry, one per language", children=_DIRECTORY, repeats=True
    ),
    FieldSpec(12, "SubSum", "u16", "R", "M", meaning="checksum of the directory part"),
)

LEVEL: Final = (
    FieldSpec(10, "Level", "text", "R", "M", meaning="security level, one letter: A to E or N"),
    FieldSpec(11, "NumOfStandards", "u8", "R", "M", meaning="how many name and version pairs follow"),
)


def _code(number: int, name: str, meaning: str, values: Mapping[int, str], *weak: int) -> FieldSpec:
    return FieldSpec(number, name, "u8", "R", meaning=meaning, enumeration=values, weak=frozenset(weak))


def _security(number: int, name: str, kind: str, meaning: str, confidence: Confidence = "H", **more: Any) -> FieldSpec:
    return FieldSpec(number, name, kind, confidence=confidence, meaning=meaning, **more)


SECURITY: Final = (
    _code(1, "UsedSecScheme", "type of security (Table 2)", SECURITY_SCHEMES, 0),
    _code(2, "UsedVerAlg", "verification algorithm (Table 3)", VERIFICATION, 1, 3),
    _code(3, "UsedEncAlg", "encryption algorithm (Table 4)", ENCRYPTION, 2, 3, 4),
    _code(4, "UsedHashAlg", "hashing algorithm (Table 5)", HASHES, 0),
    _security(5, "CA", "text", "certificate authority, a hint"),
    _security(6, "LastModified", "instant", "last modified, UTC"),
    _security(100, "Signature", "key", "signature of the base station over the datasheet"),
    _security(101, "NodePublicKey", "key", "public key of the node"),
    _security(102, "SigNodePublicKey", "key", "signature of the node over its key"),
    _security(103, "BaseStationPublicKey", "key", "public key of the base station"),
    _security(104, "SigBaseStationPublicKey", "key", "signature of the CA over the base station's key"),
    _security(105, "ProfileVersion", "u8", "version of the security profile", "M"),
    _security(106, "Sequence", "u32", "grows with every new signature", "M"),
    _security(107, "KeyEpoch", "u32", "the node's key epoch at signing", "M"),
    _security(108, "SignedBlock", "block id", "channel, access code and SHA-256 of a signed TEDS", "M", repeats=True),
    _security(
        109,
        "SessionSuite",
        "u8",
        "session suite",
        "M",
        enumeration={1: "AES-128-CCM alone (never fielded)", 2: "one-time ECDH, AES-128-CCM"},
    ),
    _security(
        110,
        "KeyAgreement",
        "u8",
        "key agreement",
        "M",
        enumeration={1: "static keys of both (never fielded)", 2: "one-time keys, node signs"},
    ),
)

_PHY_TEXT_SECURITY: Final[dict[int, dict[str, Any]]] = {
    AccessCode.PHY: {"rows": PHY, "family": 5, "source": 'teds.md, "13 PHYTEDS (IEEE 1451.5, family 5)"'},
    AccessCode.SECURITY_2024: {"rows": LEVEL, "verified": False, "source": 'teds.md, "16 SecurityTEDS2024"'},
    AccessCode.SECURITY: {
        "rows": SECURITY,
        "source": 'Mitterer et al. 2023, Table 1; from 105 on the security profile, "The Security TEDS"',
    },
}

# The two TEDS of the profile whose content is lines of text (text_lines.py).
_LINES: Final[dict[int, dict[str, Any]]] = {
    AccessCode.ORIGIN: {
        "rows": (
            _row(4, "Lines", "text", "R", meaning="kind, name and digest of the description of the wrapped sensor"),
        ),
        "source": 'teds.md, "130 OriginTEDS"',
    },
    AccessCode.CERTIFICATE: {
        "rows": (
            _row(4, "Lines", "text", "R", meaning="number, laboratory, date and digest of a calibration certificate"),
        ),
        "source": 'teds.md, "131 CertificateTEDS"',
    },
}


# Reads the field table of the Calibration TEDS from ``calibration_fields.toml`` (unverified numbers).


def calibration_table() -> Table:
    """Return the table of access code 5, marked unverified."""
    data = tomllib.loads(Path(__file__).with_name("calibration_fields.toml").read_text(encoding="utf-8"))
    rows = tuple(_from_toml(row) for row in data["field"])
    return Table(
        AccessCode.CALIBRATION,
        name_of(AccessCode.CALIBRATION),
        rows,
        verified=data["status"] != "unverified",
        source=data["source"],
    )


def _from_toml(row: dict[str, Any]) -> FieldSpec:
    plain = {key: value for key, value in row.items() if key not in {"children", "enumeration"}}
    return FieldSpec(
        **plain,
        children=tuple(_from_toml(child) for child in row.get("children", ())),
        enumeration=dict(enumerate(row.get("enumeration", ()))),
    )


__all__ = ["MANUFACTURER", "NAMES", "OCTETS", "ONLY_2024", "TEXT_BASED", "FieldSpec", "Table", "name_of", "table"]


@cache
def table(access_code: int) -> Table:
    """Return the field table of a TEDS class; one without rows if no fields are known (their tuples stay raw)."""
    name = name_of(access_code)
    if access_code == AccessCode.CALIBRATION:
        return calibration_table()
    if access_code in TEXT_BASED:
        return Table(access_code, name, TEXT, source='teds.md, "Text-based TEDS (2, 4, 6, 10, 11, 14, 15)"')
    entry = TABLES.get(access_code) or _PHY_TEXT_SECURITY.get(access_code) or _LINES.get(access_code)
    if entry is None:
        return Table(access_code, name, verified=False)
    return Table(access_code, name, **entry)
