"""Every row of the standard's tables as they stand in the format study, by hand: numbers, names, types, octets, needs.

Nothing here is computed from the tables that it holds.
"""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec import tables
from teds_provision.teds.codec.frame import checksum, frame, raw_tuple, shape_of, teds_class, tuples, unframe
from teds_provision.teds.codec.model import ONLY_2024, TEXT_BASED, Edition

# Type, name, kind of value, need; the sub-fields of a structure follow it, indented.
META = """
4 UUID uuid R
10 OholdOff f32 R
11 SHoldOff f32 O
12 TestTime f32 R
13 MaxChan u16 R
14 CGroup tlv O repeats
  20 GrpType u8 O
  21 MemList u16[] O
15 VGroup tlv O repeats
  20 GrpType u8 O
  21 MemList u16[] O
16 GeoLoc tlv O repeats
  24 LocEnum u8 O
  20 GrpType u8 O
  21 MemList u16[] O
17 Proxies tlv O repeats
  22 ChanNum u16 O also 1
  23 Organiz u8 O
  21 MemList u16[] O
"""
UNITS = """
  50 UnitType u8 O
  51 Radians u8 O
  52 SterRad u8 O
  53 Meters u8 O
  54 Kilogram u8 O
  55 Seconds u8 O
  56 Amperes u8 O
  57 Kelvins u8 O
  58 Moles u8 O
  59 Candelas u8 O
  60 UnitsExt u8 O
"""
CHANNEL = f"""
10 CalKey u8 R
11 ChanType u8 R
12 PhyUnits units R
{UNITS}
13 LowLimit f32 R
14 HiLimit f32 R
15 OError f32 R
16 SelfTest u8 R
17 MRange u8 O
18 Sample tlv R
  40 DatModel u8 R
  41 ModLenth u8 R
  42 SigBits u16 R also 1
19 DataSet tlv O
  43 Repeats u16 O also 1
  44 SOrigin f32 O
  45 StepSize f32 O
  46 SUnits units O
  47 PreTrigg u16 O also 1
20 UpdateT f32 R?
21 WSetupT f32 O
22 RSetupT f32 R?
23 SPeriod f32 R?
24 WarmUpT f32 R?
25 RDelayT f32 R?
26 TestTime f32 O
27 TimeSrc u8 O
28 InPropDl f32 O
29 OutPropD f32 O
30 TSError f32 O
31 Sampling tlv R
  48 SampMode u8 R
  49 SDefault u8 O
32 DataXmit u8 O
33 Buffered u8 O
34 EndOfSet u8 O
35 EdgeRpt u8 O
36 ActHalt u8 O
37 Directon f32 O
38 DAngles f32x2 O
39 ESOption u8 O
"""
NAME = """
4 Format u8 R
5 TCName text R
"""
PHY = "\n".join(
    (
        "10 Radio u8 R?",
        "11 MaxBPS u32 R?",
        "12 MaxCDev u16 R?",
        "13 MaxRDev u16 R?",
        "14 Encrypt u16 O",
        "15 Authent u8 O",
        "16 MinKeyL u16 O",
        "17 MaxKeyL u16 O",
        "18 MaxSDU u16 O",
        "19 MinALat u32 O",
        "20 MinTLat u32 O",
        "21 MaxXact u8 O",
        "22 Battery u8 O",
        "23 RadioVer u16 O",
        "24 MaxRetry u16 O",
        *(f"{n} Bluetooth{n} octets O" for n in range(32, 42)),
        *(f"{n} WiFi{n} octets O" for n in range(48, 55)),
        *(f"{n} ZigBee{n} octets O" for n in range(64, 81)),
        *(f"{n} LoWPAN{n} octets O" for n in range(96, 104)),
    )
)
TEXT = """
10 NumLang u8 R
11 DirBlock tlv R repeats
  20 LangCode lang O
  21 Offset u32 O
  22 Length u32 O
  23 Compress u8 O
12 SubSum u16 R
"""
CALIBRATION = """
10 LstCalDt instant O
11 CalInrvl duration O
12 SIConvrt tlv O
  30 Slope f32 O
  31 Intercept f32 O
13 LowLimit f32 O
14 HiLimit f32 O
15 OError f32 O
16 LinOnly f32[] O
"""
SEED = """
1 UsedSecScheme u8 R
2 UsedVerAlg u8 R
3 UsedEncAlg u8 R
4 UsedHashAlg u8 R
5 CA text O
6 LastModified instant O
100 Signature key O
101 NodePublicKey key O
102 SigNodePublicKey key O
103 BaseStationPublicKey key O
104 SigBaseStationPublicKey key O
105 ProfileVersion u8 O
106 Sequence u32 O
107 KeyEpoch u32 O
108 SignedBlock block id O repeats
109 SessionSuite u8 O
110 KeyAgreement u8 O
"""
LEVEL = """
10 Level text R
11 NumOfStandards u8 R
"""


def lines(rows: tuple[tables.FieldSpec, ...], indent: str = "") -> list[str]:
    """A table as it is written above."""
    written = []
    for row in rows:
        words = [f"{indent}{row.type}", row.name, row.kind, row.need]
        words += ["repeats"] if row.repeats else []
        words += [f"also {', '.join(map(str, row.also))}"] if row.also else []
        written.append(" ".join(words))
        if row.name != "SUnits":  # the same sub-fields as PhyUnits, held there
            written += lines(row.children, "  ")
    return written


@pytest.mark.parametrize(
    ("access_code", "written"),
    [
        (1, META), (2, TEXT), (3, CHANNEL), (4, TEXT), (6, TEXT), (7, ""), (8, ""), (9, ""), (10, TEXT), (11, TEXT),
        (12, NAME), (13, PHY), (14, TEXT), (15, TEXT), (16, LEVEL), (17, ""), (128, SEED), (0, ""), (18, ""), (129, ""),
    ],
)  # fmt: skip
def test_each_row_is_the_standards(access_code: int, written: str) -> None:
    assert lines(teds.table(access_code).rows) == [line for line in written.split("\n") if line]


def test_the_calibration_rows_from_memory_are_below_the_house_profile() -> None:
    rows = tuple(row for row in teds.table(5).rows if row.type < 128)
    assert lines(rows) == CALIBRATION.strip().split("\n")
    assert min(row.type for row in teds.table(5).rows if row not in rows) == 128


def test_both_units_have_the_same_sub_fields() -> None:
    channel = teds.table(3)
    assert channel.by_name["PhyUnits"].children == channel.by_name["DataSet"].by_name["SUnits"].children


def test_octets_of_each_kind_of_value() -> None:
    kinds = ("u8", "u16", "u32", "f32", "f32x2", "lang", "instant", "duration", "block id", "text", "u16[]", "units")
    found = {kind: teds.FieldSpec(1, "x", kind).octets for kind in kinds}
    assert found == {
        "u8": (1,), "u16": (2,), "u32": (4,), "f32": (4,), "f32x2": (8,), "lang": (2,), "instant": (8, 10),
        "duration": (8,), "block id": (35,), "text": (), "u16[]": (), "units": (),
    }  # fmt: skip


def test_names_of_the_access_codes() -> None:
    assert [teds.name_of(code) for code in (*range(19), 127, 128, 129, 130, 131, 132, 255)] == [
        "reserved 0", "MetaTEDS", "MetaIdTEDS", "ChanTEDS", "ChanIdTEDS", "CalTEDS", "CalIdTEDS", "EUASTEDS",
        "FreqRespTEDS", "TransferTEDS", "CommandTEDS", "TitleTEDS", "XdcrName", "PHYTEDS", "GeoLocTEDS",
        "UnitsExtention", "SecurityTEDS2024", "TimeSyncTEDS", "reserved 18", "reserved 127", "SecurityTEDS",
        "manufacturer 129", "OriginTEDS", "CertificateTEDS", "manufacturer 132", "manufacturer 255",
    ]  # fmt: skip
    assert {2, 4, 6, 10, 11, 14, 15} == TEXT_BASED
    assert {16, 17} == ONLY_2024
    assert {code: teds.table(code).family for code in (1, 3, 5, 10, 12, 13, 16, 128)} == {
        1: 0, 3: 0, 5: 0, 10: 0, 12: 0, 13: 5, 16: 0, 128: 0,
    }  # fmt: skip
    assert [code for code in (1, 2, 3, 5, 12, 13, 16, 128) if not teds.table(code).verified] == [5, 16]


NOT_APPLICABLE = "not applicable"
ENUMERATIONS = {
    (3, "CalKey"): {
        0: "CAL_NONE", 1: "CAL_SUPPLIED", 3: "CAL_CUSTOM", 4: "TIM_CAL_SUPPLIED", 5: "TIM_CAL_SELF",
        6: "TIM_CAL_CUSTOM",
    },
    (3, "ChanType"): {0: "sensor", 1: "actuator", 2: "event sensor"},
    (3, "UnitType"): {
        0: "product of SI units", 1: "ratio of a unit to itself", 2: "log10 of the product", 3: "log10 of the ratio",
        4: "digital data", 5: "arbitrary",
    },
    (3, "SelfTest"): {0: "none", 1: "provided"},
    (3, "DatModel"): {
        0: "unsigned integer", 1: "Float32", 2: "Float64", 3: "fraction", 4: "bit sequence", 5: "long integer",
        6: "long fraction", 7: "time of day",
    },
    (3, "DataXmit"): {
        1: "on command", 2: "command or buffer full", 3: "command or interval", 4: "command, buffer or interval",
        5: "buffer full", 6: "interval", 7: "buffer or interval",
    },
    (3, "EdgeRpt"): {
        0: NOT_APPLICABLE, 1: "rising", 2: "falling", 3: "both", 5: "selectable, default rising",
        6: "selectable, default falling", 7: "selectable, default both",
    },
    (3, "ActHalt"): {0: NOT_APPLICABLE, 1: "halt at once", 2: "halt at end of data set", 3: "ramp"},
    (3, "ESOption"): {
        0: NOT_APPLICABLE, 1: "not changeable", 2: "changeable, inconsistencies detected",
        3: "changeable, inconsistencies not detected",
    },
    (12, "Format"): {0: "user defined", 1: "text-based"},
    (13, "Radio"): {0: "IEEE 802.11", 1: "Bluetooth", 2: "ZigBee", 3: "6LoWPAN", 255: "manufacturer"},
    (128, "UsedSecScheme"): {
        0: "NoSec", 1: "AsVerification", 2: "DataEncryption", 3: "CommEncryption", 4: "AsVerAndData",
    },
    (128, "UsedVerAlg"): {0: "RSA", 1: "DSA", 2: "ECDSA", 3: "ElGamal", 4: "ECDH"},
    (128, "UsedEncAlg"): {0: "AES-128", 1: "AES-256", 2: "RC4", 3: "DES", 4: "Blowfish"},
    (128, "UsedHashAlg"): {0: "MD5", 1: "SHA-256", 2: "SHA-512"},
    (128, "SessionSuite"): {1: "AES-128-CCM alone (never fielded)", 2: "one-time ECDH, AES-128-CCM"},
    (128, "KeyAgreement"): {1: "static keys of both (never fielded)", 2: "one-time keys, node signs"},
}  # fmt: skip


def test_every_enumeration_has_its_numbers() -> None:
    found = {}
    for access_code in (1, 3, 10, 12, 13, 16, 128):
        table = teds.table(access_code)
        for row in (*table.rows, *table.inner.values()):
            if row.enumeration:
                found[access_code, row.name] = dict(row.enumeration)
    assert found == ENUMERATIONS
    assert tables.LEVELS == {
        "A": "encryption", "B": "authentication", "C": "encryption and authentication",
        "D": "authentication and authorization", "E": "all", "N": "none",
    }  # fmt: skip


def test_what_is_weak_or_protects_nothing_is_marked() -> None:
    """No security; DSA, ElGamal; RC4, DES, Blowfish; MD5."""
    weak = {row.name: set(row.weak) for row in teds.table(128).rows if row.weak}
    assert weak == {"UsedSecScheme": {0}, "UsedVerAlg": {1, 3}, "UsedEncAlg": {2, 3, 4}, "UsedHashAlg": {0}}


def test_a_wrong_number_is_an_error_where_the_sources_agree_and_a_warning_elsewhere() -> None:
    """H: interpretation, ChanType, SelfTest, DatModel. The codes of CalKey, EdgeRpt and the rest have one source."""
    table = teds.table(3)
    sure = [
        row.name
        for row in (*table.rows, *table.inner.values())
        if row.enumeration and row.enumeration_confidence == "H"
    ]
    assert sure == ["ChanType", "SelfTest", "UnitType", "DatModel"]


def test_names_in_the_numbering_of_the_text_are_read_as_well() -> None:
    """4 and 5 are written; 10 and 11 of the clause's text are read."""
    aliases = teds.table(12).aliases
    assert {number: (row.name, row.kind) for number, row in aliases.items()} == {
        10: ("Format", "u8"),
        11: ("TCName", "text"),
    }
    octets = teds.compose(12, {"Format": 0, "TCName": "bench"})
    assert [(field.type, field.name) for field in teds.decode(octets).fields] == [
        (3, "TEDSID"),
        (4, "Format"),
        (5, "TCName"),
    ]


def test_a_teds_is_its_length_the_block_and_one_s_complement_of_the_sum() -> None:
    """The smallest has 12 octets; the sum is modulo 65536, the Length included."""
    whole = bytes.fromhex("00000008 030400010101 FFED")
    assert frame(bytes.fromhex("030400010101")) == whole
    assert unframe(whole) == bytes.fromhex("030400010101")
    assert checksum(b"") == 0xFFFF
    assert checksum(b"\xff" * 257) == 0xFFFF - 65535 == 0
    assert checksum(b"\xff" * 258) == 0xFFFF - (65790 - 65536) == 0xFF01
    assert checksum(b"\xff" * 300) == 0xD52B
    for octets, words in (
        ("0000000803", "A TEDS has at least 12 octets, this one 5."),
        ("00000009 030400010101 FFEC", "The Length of this TEDS says 9 octets follow; 8 do."),
        ("00000008 030400010101 FFEC", "The checksum of this TEDS is FFEC; its octets give FFED."),
    ):
        with pytest.raises(BadDataError) as refused:
            unframe(bytes.fromhex(octets))
        assert refused.value.message == words


@pytest.mark.parametrize(
    ("block", "found"),
    [
        ("030400050101", 5),
        ("030500FF070201", 7),
        ("0304000501", None),
        ("030500FF0702", None),
        ("030300050101", None),
        ("030600050101FF", None),
        ("040400050101", None),
        ("", None),
    ],
)
def test_the_class_is_the_third_from_the_end_of_a_tedsid_of_either_edition(block: str, found: int | None) -> None:
    assert teds_class(bytes.fromhex(block)) == found


def test_only_the_tedsid_at_the_front_has_a_length_of_one_octet_whatever_the_width() -> None:
    block = bytes.fromhex("0304000C0102 04000100 0500020041 03000100".replace(" ", ""))
    with pytest.raises(BadDataError, match="The tuple of type 5 at octet 10 runs past the end"):
        list(tuples(block[:-6], width=2))
    good = bytes.fromhex("0304000C0102 0400010A 0300010B".replace(" ", ""))
    assert [(part.type, part.value, part.offset) for part in tuples(good, width=2)] == [
        (3, bytes.fromhex("000C0102"), 0),
        (4, b"\x0a", 6),
        (3, b"\x0b", 10),
    ]


@pytest.mark.parametrize(
    ("octets", "shape"),
    [
        ("00000008 030400010101 FFED", "framed"),
        ("00000009 030400010101 FFED", "framed"),  # a wrong Length in front of a TEDSID
        ("030400010101", "block"),
        ("030500FF030201", "block"),
        ("0001 01 02 0005 0300000000", "message"),  # a command: channel, class, function, length
        ("0001 01 02 0006 0300000000", "framed"),  # damaged: it counts one too many
        ("0001 81 02 0001 00", "message"),  # a maker's class
        ("0001 80 01 0001 00", "message"),
        ("0001 7F 01 0001 00", "framed"),  # a reserved one
        ("0001 08 02 0001 00", "framed"),
        ("0001 07 01 0000", "message"),
        ("0001 01 01 0001 03", "message"),
        ("01 08 01 0000", "message"),  # a service of type 1, a command
        ("0001 01 00 0001 00", "framed"),  # no function
        ("01 0002 FFFF", "message"),  # a reply
        ("00 0001 04", "message"),
        ("02 0001 04", "framed"),
        ("09 02 05 0001 00", "message"),  # a network service: type, id, message type, length
        ("0A 02 05 0001 00", "framed"),
        ("09 02 06 0001 00", "framed"),
        ("03 04 01 0001 00", "message"),  # Update TEDS as a service, and no TEDSID
        ("00000102 0100" + 256 * "00", "framed"),  # its Length counts it; as a command it would have class 1
    ],
)
def test_a_teds_a_bare_block_and_a_message_are_distinguished_by_their_first_octets(octets: str, shape: str) -> None:
    assert shape_of(bytes.fromhex(octets.replace(" ", ""))) == shape


def test_a_tuple_holds_as_much_as_its_length_octets_can_count() -> None:
    assert raw_tuple(5, bytes(255)) == bytes([5, 255]) + bytes(255)
    assert raw_tuple(5, bytes(256), width=2) == bytes([5, 1, 0]) + bytes(256)
    with pytest.raises(BadDataError, match="Field 5 has 256 octets; 1 length octets allow 255"):
        raw_tuple(5, bytes(256))


EDITIONS: tuple[Edition, ...] = (2007, 2024)
PASCAL = teds.Units(kilograms=Fraction(1), meters=Fraction(-1), seconds=Fraction(-2))


@pytest.mark.parametrize(
    ("spelled", "units"),
    [
        ("32 01 00 35 01 7E 36 01 82 37 01 7C", PASCAL),
        ("00 80 80 7E 82 7C 80 80 80 80 00", PASCAL),
        ("00 80 80 7E 82 7C 80 80 80 80 80", PASCAL),  # 80 means no extension, too
        ("00 80 80 7E 82 7C 80 80 80 80", PASCAL),  # without the octet of an extension
        ("00 80 80 7E 82 7C 80 80 80 80 0F", replace(PASCAL, extension=15)),
        ("32 01 00 35 01 7E 36 01 82 37 01 7C 3C 01 0F", replace(PASCAL, extension=15)),
        ("00 80 80 80 80 7F 80 80 80 80 00", teds.Units(seconds=Fraction(-1, 2))),  # an octet is 2 · exponent + 128
        ("01 82 80 80 80 80 80 80 80 80 00", teds.Units(1, radians=Fraction(1))),
        ("05 80 80 80 80 80 80 80 80 84 00", teds.Units(5, candelas=Fraction(2))),
        (
            "04 80 82 80 80 80 84 80 82 80 00",
            teds.Units(4, steradians=Fraction(1), amperes=Fraction(2), moles=Fraction(1)),
        ),
    ],
)
def test_units_are_read_in_each_of_three_spellings(spelled: str, units: teds.Units) -> None:
    octets = bytes.fromhex(spelled)
    decoded = teds.decode(bytes([3, 4, 0, 3, 1, 1, 12, len(octets)]) + octets)
    assert decoded.get("PhyUnits") == units


def test_units_are_written_as_tuples_in_2007_and_packed_in_2024() -> None:
    old, new = (teds.compose(3, {"PhyUnits": PASCAL}, edition=edition)[4:-2] for edition in EDITIONS)
    assert old.hex() == "030400030101" + "0c0c" + "32010035017e360182370 17c".replace(" ", "")
    assert new.hex() == "030500ff030201" + "0c0b" + "0080807e827c8080808000"


@pytest.mark.parametrize(
    ("kind", "octets", "value"),
    [
        (10, "6955B900 00000001", teds.TimeInstance(0x6955B900, 1)),
        (10, "00000005 80000002", teds.TimeInstance(5, 2, True)),  # the top bit is the sign of the whole
        (10, "00006700 10B7 2575FEF3", teds.TimeInstance(0x670010B7, 0x2575FEF3)),
        (13, "7FFFFFFF", None),  # the NaN that means "not available"
        (13, "C2280000", -42.0),
        (16, "3F800000 40000000", (1.0, 2.0)),
    ],
)
def test_data_types_are_big_endian(kind: int, octets: str, value: object) -> None:
    raw = bytes.fromhex(octets.replace(" ", ""))
    decoded = teds.decode(bytes([3, 4, 0, 5, 1, 1, kind, len(raw)]) + raw)
    (_, field) = decoded.fields
    if value is None:
        assert isinstance(field.value, float)
        assert math.isnan(field.value)
    else:
        assert field.value == value


@pytest.mark.parametrize(
    ("edition", "seconds", "nanoseconds", "fits"),
    [
        (2007, (1 << 32) - 1, (1 << 31) - 1, True),
        (2007, 1 << 32, 0, False),
        (2007, 0, 1 << 31, False),
        (2024, (1 << 48) - 1, (1 << 32) - 1, True),
        (2024, 1 << 48, 0, False),
        (2024, 0, 1 << 32, False),
    ],
)
def test_a_time_has_32_and_31_bits_in_2007_and_48_and_32_in_2024(
    edition: Edition, seconds: int, nanoseconds: int, fits: bool
) -> None:
    fields = {"LstCalDt": teds.TimeInstance(seconds, nanoseconds)}
    if fits:
        octets = teds.compose(5, fields, edition=edition)
        assert len(octets) == 4 + (6 if edition == 2007 else 7) + 2 + (8 if edition == 2007 else 10) + 2
        assert teds.decode(octets).get("LstCalDt") == fields["LstCalDt"]
    else:
        with pytest.raises(BadDataError, match="LstCalDt has"):
            teds.compose(5, fields, edition=edition)


@pytest.mark.parametrize(
    ("raw", "value"),
    [
        (b"MFkwEwYHKoZIzj0=", "MFkwEwYHKoZIzj0="),
        (b"-----BEGIN PUBLIC KEY-----\nMFkw\n", "-----BEGIN PUBLIC KEY-----\nMFkw\n"),
        (b"\x04\x01\x02", b"\x04\x01\x02"),
        (b"\xff" * 3, b"\xff" * 3),
    ],
)
def test_a_key_is_text_if_it_can_be_read_and_octets_else(raw: bytes, value: object) -> None:
    decoded = teds.decode(bytes([3, 4, 0, 128, 1, 1, 101, len(raw)]) + raw)
    assert decoded.get("NodePublicKey") == value


DIRECTORY = "0304000E0101 0A0101 0B13 1402656E 150400000026 160400000006 170100 0C02FE5E"
"""NumLang 1; LangCode en, Offset 38 (from the first octet of the TEDS), Length 6, Compress 0; SubSum."""


def located(directory: str, text: str) -> bytes:
    return frame(bytes.fromhex((directory + text).replace(" ", "")))


def test_a_text_stands_bare_behind_its_directory_with_a_checksum_of_its_own() -> None:
    whole = located(DIRECTORY, "3C612F3E FEF5")
    assert teds.compose(14, [("Text", {"LangCode": "en", "Text": "<a/>"})]) == whole
    decoded = teds.decode(whole)
    assert (decoded.text, decoded.findings) == ((b"<a/>",), ())
    assert [field.name for field in decoded.fields] == ["TEDSID", "NumLang", "DirBlock", "SubSum"]
    assert (decoded.get("LangCode"), decoded.get("Offset"), decoded.get("Length")) == ("en", 38, 6)
    two = teds.decode(teds.compose(2, [("Text", {"Text": "a"}), ("Text", {"LangCode": "de", "Text": "bc"})]))
    places = [(field.children[1].value, field.children[2].value) for field in two.fields if field.name == "DirBlock"]
    assert (two.get("NumLang"), two.text, places) == (2, (b"a", b"bc"), [(59, 3), (62, 4)])


@pytest.mark.parametrize(
    ("directory", "text", "found", "texts"),
    [
        (DIRECTORY, "3C612F3E FEF4", {"text-checksum": "warning"}, (b"<a/>",)),
        (DIRECTORY.replace("00000006", "00000004"), "3C612F3E FEF5", {"text-length": "note"}, (b"<a/>",)),
        (DIRECTORY.replace("00000006", "00000009"), "3C612F3E FEF5", {"text-length": "warning"}, (b"<a/>\xfe\xf5",)),
        (DIRECTORY, "8004 3C612F3E 8102 FEF5", {"text-tagged": "warning"}, (b"<a/>",)),
    ],
)
def test_other_habits_of_texts_are_read_and_named(
    directory: str, text: str, found: dict[str, str], texts: tuple[bytes, ...]
) -> None:
    decoded = teds.decode(located(directory, text))
    assert {finding.code: finding.severity for finding in decoded.findings} == found
    assert decoded.text == texts


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ([], "A text-based TEDS has at least one Text."),
        ([("Text", {"Text": "a"}), ("NumLang", 1)], "takes Text entries, not NumLang"),
        ([("Text", "a")], "Text is a mapping of field names, or a sequence of"),
        ([("Text", {"Text": "a", "Offset": 1})], "Text is a mapping with LangCode, Text and Compress."),
        ([("Text", {"Text": 1})], "Text holds text or octets, Compress a number."),
        ([("Text", {"Text": "a", "Compress": "0"})], "Text holds text or octets, Compress a number."),
        ([("Text", {"Text": "a", "LangCode": "eng"})], "LangCode has 2 octets, not 3."),
    ],
)
def test_a_text_that_cannot_be_written_is_refused_by_name(fields: list[tuple[str, object]], words: str) -> None:
    with pytest.raises(BadDataError, match=words):
        teds.compose(14, fields)
