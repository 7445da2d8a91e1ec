"""Every finding of the decoder, whole: severity, code, place, field, what was asked and found, and the sentence."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import teds
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.codec.values import split_text

META_HEAD = "0304 0001 0101"
META = f"{META_HEAD} 040a 00000000000000000000 0a04 3f800000 0c04 3f800000 0d02 0001"
CHAN_HEAD = "0304 0003 0101"
CHAN = f"{CHAN_HEAD} 0a0100 0b0100 0c06 320100 350182 0d04 3f800000 0e04 40000000 0f04 3f000000 100100"
CHAN += " 120a 280100 290102 2a020010"
NAME = "040100 050161"
TEXT_HEAD = "0a0101 0b13 1402656e 150400000026 160400000004 170100 0c02fe6a"


def framed(*parts: str) -> bytes:
    """Return the TEDS around a data block in hex digits."""
    return frame(bytes.fromhex("".join(parts).replace(" ", "")))


CASES = (
    (
        "an empty string",
        b"",
        """\
malformed None None
error too-short @0 - <|>
    A TEDS has 12 octets or more, this one 0.
""",
    ),
    (
        "five octets",
        bytes(5),
        """\
malformed None None
error too-short @0 - <|>
    A TEDS has 12 octets or more, this one 5.
""",
    ),
    (
        "a length that lies",
        framed(CHAN)[:3] + b"\x63" + framed(CHAN)[4:],
        """\
frame-bad 2007 3
error frame-length @0 Length <55|99>
    Length says 99 octets follow, 55 do.
error frame-checksum @57 Checksum <FC4A|FC76>
    The checksum is FC76, the octets give FC4A.
""",
    ),
    (
        "a wrong checksum",
        framed(CHAN)[:-1] + b"\0",
        """\
frame-bad 2007 3
error frame-checksum @57 Checksum <FC76|FC00>
    The checksum is FC00, the octets give FC76.
""",
    ),
    (
        "octets behind it",
        framed(CHAN) + b"\xff\xff",
        """\
frame-bad 2007 3
error frame-trailing @59 - <0|2>
    2 octets follow the checksum of this TEDS.
""",
    ),
    (
        "no TEDSID at all",
        framed("0b0100"),
        """\
content-nonconformant None None
error tedsid-first @4 TEDSID <type 3|type 11>
    The TEDSID tuple is not first.
note no-class @4 - <|>
    There is no TEDSID, so the meaning of the fields is unknown.
""",
    ),
    (
        "a TEDSID that is not first",
        framed("0b0100", CHAN),
        """\
content-nonconformant 2007 3
error tedsid-first @4 TEDSID <type 3|type 11>
    The TEDSID tuple is not first.
warning order @13 CalKey <ascending types|10 behind 11>
    The field 10 CalKey comes after 11.
warning repeated @16 ChanType <once|again>
    The field 11 ChanType occurs more than once.
""",
    ),
    (
        "a TEDSID of six octets",
        framed("0306 0003 01010101 0b0100"),
        """\
content-nonconformant None None
error tedsid-length @4 TEDSID <4 or 5|6>
    The TEDSID has 6 octets; 4 (2007) or 5 (2024) are known.
""",
    ),
    (
        "a TEDSID that runs over",
        framed("0305 0003 0101"),
        """\
malformed None None
error not-closed @4 - <4|5>
    The tuple of type 3 needs 5 octets, 4 are left.
""",
    ),
    (
        "tuples of 9 length octets",
        framed("0304 0003 0109"),
        """\
content-nonconformant 2007 3
error tuple-width @9 TEDSID <1 to 4|9>
    The TEDSID asks for tuples of 9 length octets.
""",
    ),
    (
        "tuples of 0 length octets",
        framed("0304 0003 0100 0b0100"),
        """\
content-nonconformant 2007 3
error tuple-width @9 TEDSID <1 to 4|0>
    The TEDSID asks for tuples of 0 length octets.
""",
    ),
    (
        "a class of 2024 in 2007",
        framed("0304 0010 0101"),
        """\
clean 2007 16
note class @7 TEDSID <|>
    The 2007 edition has no SecurityTEDS2024.
note unverified @- - <|>
    The field numbers of SecurityTEDS2024 are not checked against the standard.
""",
    ),
    (
        "a reserved class",
        framed("0304 0064 0101"),
        """\
clean 2007 100
note class @4 TEDSID <|100>
    The class 100 is reserved.
note unverified @- - <|>
    The field numbers of reserved 100 are not checked against the standard.
""",
    ),
    (
        "class 0",
        framed("0304 0000 0101"),
        """\
clean 2007 0
note class @4 TEDSID <|0>
    The class 0 is reserved.
note unverified @- - <|>
    The field numbers of reserved 0 are not checked against the standard.
""",
    ),
    (
        "another family and a prototype",
        framed("0304 070c 0001", NAME),
        """\
clean 2007 12
note family @6 TEDSID <0|7>
    The TEDSID names family 7.
note version @8 TEDSID <1|0 (prototype)>
    The TEDSID names version 0 (prototype).
""",
    ),
    (
        "another version of 2024",
        framed("0305 0000 0c0301", NAME),
        """\
clean 2024 12
note version @9 TEDSID <2|3>
    The TEDSID names version 3.
""",
    ),
    (
        "fields in another order, and twice",
        framed("0304 000c 0101", "050161", "040100", "050162"),
        """\
clean 2007 12
warning order @13 Format <ascending types|4 behind 5>
    The field 4 Format comes after 5.
warning repeated @16 TCName <once|again>
    The field 5 TCName occurs more than once.
""",
    ),
    (
        "the name by the number of the text",
        framed("0304 000c 0101", "0a0100", "0b0161"),
        """\
clean 2007 12
warning numbering @10 Format <4 or 5|10>
    Format has the number 10 of the clause's text, not that of its table.
warning numbering @13 TCName <4 or 5|11>
    TCName has the number 11 of the clause's text, not that of its table.
""",
    ),
    (
        "a name without its format",
        framed("0304 000c 0101", "050161"),
        """\
clean 2007 12
warning missing @4 Format <present|>
    The required field 4 Format is missing.
""",
    ),
    (
        "a name that ends in NUL",
        framed("0304 000c 0101", "040100", "05026100"),
        """\
clean 2007 12
warning text @13 TCName <no NUL|NUL>
    TCName ends in NUL.
""",
    ),
    (
        "a name in another encoding",
        framed("0304 000c 0101", "040100", "0502e4e4"),
        """\
clean 2007 12
warning text @13 TCName <UTF-8|e4e4>
    TCName is not UTF-8.
""",
    ),
    (
        "the type 3 again",
        framed(META, "030100"),
        """\
content-nonconformant 2007 1
warning order @38 - <ascending types|3 behind 13>
    The field 3 comes after 13.
error tedsid-again @38 TEDSID <once|again>
    The type 3 occurs again with 1 octets (clash with the TEDSID).
""",
    ),
    (
        "a sub-field at top level",
        framed(CHAN, "280101"),
        """\
content-nonconformant 2007 3
error top-level @57 DatModel <inside Sample|at top level>
    The sub-field 40 DatModel is at top level; it belongs inside 18 Sample.
""",
    ),
    (
        "a field of nobody, and of a maker",
        framed(META, "7f0100", "800100"),
        """\
content-nonconformant 2007 1
error unknown @38 - <|127>
    The field 127 is not in the table of this class.
note manufacturer @41 - <|128>
    The field 128 is in the manufacturers' range.
""",
    ),
    (
        "lengths that the table does not have",
        framed(META_HEAD, "0409 000000000000000000", "0a020001", "0b03000000"),
        """\
content-nonconformant 2007 1
error length @12 UUID <10|9>
    UUID (4) has 9 octets, the table says 10.
error length @23 OholdOff <4|2>
    OholdOff (10) has 2 octets, the table says 4.
error length @27 SHoldOff <4|3>
    SHoldOff (11) has 3 octets, the table says 4.
""",
    ),
    (
        "a tuple that runs over",
        framed(META, "0d0401"),
        """\
malformed 2007 1
error not-closed @38 - <1|4>
    The tuple of type 13 needs 4 octets, 1 are left.
""",
    ),
    (
        "a tuple without a length",
        framed(META, "0d"),
        """\
malformed 2007 1
error not-closed @38 - <|13>
    The header of a tuple of type 13 runs past the end.
""",
    ),
    (
        "a structure that runs over",
        framed(CHAN_HEAD, "1205 280101 2904"),
        """\
content-nonconformant 2007 3
error nested @15 Sample <2|6>
    Sample holds a tuple of type 41 that runs past the end.
warning missing @12 ModLenth <present|>
    Sample holds no ModLenth.
warning missing @12 SigBits <present|>
    Sample holds no SigBits.
""",
    ),
    (
        "a structure with strangers",
        framed(CHAN_HEAD, "120c 280101 280102 2a0108 0d0101"),
        """\
content-nonconformant 2007 3
warning repeated @15 Sample <once|again>
    Sample holds the field 40 twice.
warning length @20 SigBits <2|1>
    SigBits (42) has 1 octets, the table says 2.
error misplaced @21 LowLimit <elsewhere|inside Sample>
    LowLimit (13) does not belong inside Sample.
error length @23 LowLimit <4|1>
    LowLimit (13) has 1 octets, the table says 4.
warning missing @12 ModLenth <present|>
    Sample holds no ModLenth.
""",
    ),
    (
        "units that do not say of what",
        framed(CHAN_HEAD, "0c03 330182"),
        """\
clean 2007 3
warning units @12 PhyUnits <UnitType|>
    PhyUnits does not say its interpretation.
""",
    ),
    (
        "units of an unknown kind",
        framed(CHAN_HEAD, "0c0a 05828080808080808080", "0d047fffffff"),
        """\
clean 2007 3
warning units @10 PhyUnits <no exponents|some>
    PhyUnits is digital data or arbitrary and yet has exponents.
warning not-available @22 LowLimit <a number|NaN>
    LowLimit is not available (NaN).
""",
    ),
    (
        "units that are reserved",
        framed(CHAN_HEAD, "0c06 320107 330182"),
        """\
content-nonconformant 2007 3
error enumeration @12 UnitType <0, 1, 2, 3, 4, 5|7>
    UnitType is 7; known are 0, 1, 2, 3, 4, 5.
""",
    ),
    (
        "limits the wrong way round",
        framed(CHAN_HEAD, "0d0440000000", "0e043f800000", "0f04bf800000"),
        """\
content-nonconformant 2007 3
warning negative @22 OError <>= 0|-1.0>
    The uncertainty OError is negative.
error limits @10 LowLimit <<= 1|2>
    LowLimit 2 lies above HiLimit 1.
""",
    ),
    (
        "infinite, and swapped octets",
        framed(CHAN_HEAD, "0d047f800000", "0e040000803f", "0f04ff800000"),
        """\
content-nonconformant 2007 3
warning infinite @10 LowLimit <a number|inf>
    LowLimit is infinite.
warning swapped @16 HiLimit <1|4.6006e-41>
    HiLimit = 4.6006e-41 looks like swapped octets of 1.
warning infinite @22 OError <a number|-inf>
    OError is infinite.
warning negative @22 OError <>= 0|-inf>
    The uncertainty OError is negative.
error limits @10 LowLimit <<= 4.6006e-41|inf>
    LowLimit inf lies above HiLimit 4.6006e-41.
""",
    ),
    (
        "unknown values",
        framed(CHAN_HEAD, "0a0109", "0b0109", "100109", "200109"),
        """\
content-nonconformant 2007 3
warning enumeration @10 CalKey <0, 1, 3, 4, 5, 6|9>
    CalKey is 9; known are 0, 1, 3, 4, 5, 6.
error enumeration @13 ChanType <0, 1, 2|9>
    ChanType is 9; known are 0, 1, 2.
error enumeration @16 SelfTest <0, 1|9>
    SelfTest is 9; known are 0, 1.
warning enumeration @19 DataXmit <1, 2, 3, 4, 5, 6, 7|9>
    DataXmit is 9; known are 1, 2, 3, 4, 5, 6, 7.
""",
    ),
    (
        "samples that do not fit",
        framed(CHAN_HEAD, "120a 280101 290102 2a020010", "1f06 30011f 310106"),
        """\
clean 2007 3
warning sample @10 ModLenth <4 to 4|2>
    Sample has 2 octets; data model 1 takes 4 to 4.
warning sampling @22 SDefault <1 to 5, or a bit of SampMode|6>
    SDefault 6 is neither a mode from 1 to 5 nor one bit of SampMode 0x1f.
""",
    ),
    (
        "more bits than octets",
        framed(CHAN_HEAD, "120a 280100 290102 2a020011"),
        """\
clean 2007 3
warning sample @10 SigBits <<= 16|17>
    Sample claims 17 significant bits in 2 octets.
""",
    ),
    (
        "a time of more than a second",
        framed("0304 0005 0101", "0a08 000000013b9aca00"),
        """\
clean 2007 5
warning time @10 LstCalDt <<= 999999999|1000000000>
    LstCalDt has 1000000000 nanoseconds, a second or more.
note unverified @- - <|>
    The field numbers of CalTEDS are not checked against the standard.
""",
    ),
    (
        "a security TEDS of somebody",
        framed("0304 0080 0101", "6502 0101", "c80100"),
        """\
clean 2007 128
note unknown @14 - <|200>
    The field 200 has no name that we know; it is kept as it is.
note foreign @- - <|>
    This Security TEDS is not of our profile (no field 105).
""",
    ),
    (
        "a security TEDS of ours that is not canonical",
        framed("0304 0080 0101", "690101"),
        """\
content-nonconformant 2007 128
error not-canonical @- - <the canonical form|>
    The Security TEDS lacks field 1.
""",
    ),
    (
        "a maker's field twice",
        framed(META, "800100", "800100"),
        """\
clean 2007 1
note manufacturer @38 - <|128>
    The field 128 is in the manufacturers' range.
note manufacturer @41 - <|128>
    The field 128 is in the manufacturers' range.
""",
    ),
    (
        "the last class of 2024",
        framed("0305 0000 110201"),
        """\
clean 2024 17
note unverified @- - <|>
    The field numbers of TimeSyncTEDS are not checked against the standard.
""",
    ),
    (
        "the first class that nobody has",
        framed("0305 0000 120201"),
        """\
clean 2024 18
note class @4 TEDSID <|18>
    The class 18 is reserved.
note unverified @- - <|>
    The field numbers of reserved 18 are not checked against the standard.
""",
    ),
    (
        "text in a tuple",
        framed("0304 0004 0101", TEXT_HEAD, "800161"),
        """\
clean 2007 4
warning text-tagged @38 - <bare|128>
    The text is in a tuple of type 128; it should be bare.
""",
    ),
    (
        "text of another length",
        framed("0304 0004 0101", TEXT_HEAD, "6162636465"),
        """\
clean 2007 4
warning text-length @38 Length <5|4>
    The directory counts 4 octets of text, 5 are there.
""",
    ),
    (
        "text without its checksum",
        framed("0304 0004 0101", TEXT_HEAD, "61626364fe75"),
        """\
clean 2007 4
note text-length @38 Length <|>
    The directory counts the texts without their checksums.
""",
    ),
    (
        "text with a wrong checksum",
        framed("0304 0004 0101", TEXT_HEAD, "61620000"),
        """\
clean 2007 4
warning text-checksum @40 - <FF3C|0000>
    The checksum of a text is 0000, the rule for TEDS gives FF3C.
""",
    ),
    (
        "an end user's own octets",
        framed("0304 0007 0101", "616263"),
        """\
clean 2007 7
note free-form @10 - <|>
    The end user's part is no run of tuples; it is kept as it stands.
note unverified @- - <|>
    The field numbers of EUASTEDS are not checked against the standard.
""",
    ),
    (
        "a level of 2024 that nobody has",
        framed("0305 0000 100201", "0a0151"),
        """\
clean 2024 16
warning enumeration @11 Level <A to E, N|Q>
    Level is 'Q'; A to E and N are known.
note unverified @- - <|>
    The field numbers of SecurityTEDS2024 are not checked against the standard.
""",
    ),
    (
        "a bare block in error",
        bytes.fromhex("0304 0001 0101 7f0100".replace(" ", "")),
        """\
block-nonconformant 2007 1
error unknown @6 - <|127>
    The field 127 is not in the table of this class.
warning missing @0 UUID <present|>
    The required field 4 UUID is missing.
warning missing @0 OholdOff <present|>
    The required field 10 OholdOff is missing.
warning missing @0 TestTime <present|>
    The required field 12 TestTime is missing.
warning missing @0 MaxChan <present|>
    The required field 13 MaxChan is missing.
""",
    ),
)


def shown(octets: bytes) -> list[str]:
    """Return verdict, edition and class, then each finding as a line; fields that are missing have a test below."""
    decoded = teds.decode(octets)
    lines = [f"{decoded.verdict} {decoded.edition} {decoded.access_code}"]
    for finding in decoded.findings:
        where = "-" if finding.offset is None else finding.offset
        lines.append(
            f"{finding.severity} {finding.code} @{where} {finding.field or '-'} <{finding.asked}|{finding.found}>"
            f"\n    {finding.message}"
        )
    return lines


@pytest.mark.parametrize(("what", "octets", "expected"), CASES, ids=[case[0] for case in CASES])
def test_each_finding_is_whole(what: str, octets: bytes, expected: str) -> None:
    lines = shown(octets)
    if what != "a name without its format":
        lines = [line for line in lines if not line.startswith("warning missing @4")]
    assert "\n".join(lines) == expected.rstrip()


REQUIRED = {
    0: ("reserved 0", []),
    1: ("MetaTEDS", ["UUID", "OholdOff", "TestTime", "MaxChan"]),
    2: ("MetaIdTEDS", ["NumLang", "DirBlock", "SubSum"]),
    3: (
        "ChanTEDS",
        ["CalKey", "ChanType", "PhyUnits", "LowLimit", "HiLimit", "OError", "SelfTest", "Sample", "Sampling"],
    ),
    4: ("ChanIdTEDS", ["NumLang", "DirBlock", "SubSum"]),
    5: ("CalTEDS", []),
    6: ("CalIdTEDS", ["NumLang", "DirBlock", "SubSum"]),
    7: ("EUASTEDS", []),
    8: ("FreqRespTEDS", []),
    9: ("TransferTEDS", []),
    10: ("CommandTEDS", ["NumLang", "DirBlock", "SubSum"]),
    11: ("TitleTEDS", ["NumLang", "DirBlock", "SubSum"]),
    12: ("XdcrName", ["Format", "TCName"]),
    13: ("PHYTEDS", []),
    14: ("GeoLocTEDS", ["NumLang", "DirBlock", "SubSum"]),
    15: ("UnitsExtention", ["NumLang", "DirBlock", "SubSum"]),
    16: ("SecurityTEDS2024", ["Level", "NumOfStandards"]),
    17: ("TimeSyncTEDS", []),
    18: ("reserved 18", []),
    128: ("SecurityTEDS", ["UsedSecScheme", "UsedVerAlg", "UsedEncAlg", "UsedHashAlg"]),
    130: ("OriginTEDS", ["Lines"]),
    131: ("CertificateTEDS", ["Lines"]),
    200: ("manufacturer 200", []),
}


@pytest.mark.parametrize("access_code", REQUIRED)
@pytest.mark.parametrize("edition", [2007, 2024])
def test_each_class_has_its_name_and_its_required_fields(access_code: int, edition: int) -> None:
    tedsid = [3, 4, 0, access_code, 1, 1] if edition == 2007 else [3, 5, 0, 0, access_code, 2, 1]
    decoded = teds.decode(frame(bytes(tedsid)))
    missing = [finding.field for finding in decoded.findings if finding.code == "missing"]
    assert (decoded.name, missing) == REQUIRED[access_code]


def test_the_last_of_a_kind_is_found_twice_wherever_the_first_stands() -> None:
    """One that stood behind a smaller type was not reported."""
    octets = framed("0304 000c 0101", "050161", "040100", "050162", "050163")
    found = [(finding.code, finding.offset) for finding in teds.decode(octets).findings]
    assert found == [("order", 13), ("repeated", 16), ("repeated", 19)]
    assert teds.decode(octets).get("TCName") == "a", "the first counts"


@pytest.mark.parametrize(
    ("lengths", "area", "texts", "codes"),
    [
        ((), b"", (), []),
        ((0,), b"", (), []),
        ((1,), b"a", (b"a",), ["text-length"]),  # too short for its checksum
        ((1, 3), b"abcd", (b"abcd",), ["text-length"]),
        ((), b"ab", (b"ab",), ["text-length"]),
    ],
)
def test_texts_that_the_directory_does_not_fit_stay_in_one_piece(
    lengths: tuple[int, ...], area: bytes, texts: tuple[bytes, ...], codes: list[str]
) -> None:
    found: list[str] = []
    entries = [SimpleNamespace(name="DirBlock", children=[SimpleNamespace(type=22, value=n)]) for n in lengths]
    assert split_text(cast(Any, entries), area, 10, lambda _severity, code, *_rest: found.append(code)) == texts
    assert found == codes
