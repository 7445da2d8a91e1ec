"""Rows of the PHY TEDS (1451.5), the text-based TEDS and both Security TEDS (teds.md, "Access codes")."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from teds_provision.teds.codec.codes import AccessCode
from teds_provision.teds.codec.tables.field_spec import Confidence, FieldSpec, Need

RADIO: Final = {0: "IEEE 802.11", 1: "Bluetooth", 2: "ZigBee", 3: "6LoWPAN", 255: "manufacturer"}

# Tables 2 to 5 of Mitterer et al. 2023. The weak or never implemented ones are read, named, and never written.
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
        enumeration={1: "AES-128-CCM alone (older)", 2: "one-time ECDH, AES-128-CCM"},
    ),
    _security(110, "KeyAgreement", "u8", "key agreement", "M", enumeration={1: "C(1e, 2s, ECC CDH)"}),
)

TABLES: Final[dict[int, dict[str, Any]]] = {
    AccessCode.PHY: {"rows": PHY, "family": 5, "source": 'teds.md, "13 PHYTEDS (IEEE 1451.5, family 5)"'},
    AccessCode.SECURITY_2024: {"rows": LEVEL, "verified": False, "source": 'teds.md, "16 SecurityTEDS2024"'},
    AccessCode.SECURITY: {
        "rows": SECURITY,
        "source": 'Mitterer et al. 2023, Table 1; from 105 on the security profile, "The Security TEDS"',
    },
}
