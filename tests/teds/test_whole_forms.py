"""Each text form of TEDS whole, for one set that holds a value of every kind."""

from __future__ import annotations

import json
import math
from fractions import Fraction

import pytest

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.codec.model import Edition, TimeInstance, Units
from teds_provision.teds.formats import TedsBlock, read_blocks
from teds_provision.teds.formats.intelhex import stretches, write_hex, write_intel_hex
from teds_provision.teds.formats.jsonform import read_json, write_json
from teds_provision.teds.formats.xmlform import read_xml, write_xml

META = teds.compose(1, [("UUID", bytes(range(10))), ("OholdOff", 0.1), ("TestTime", math.nan), ("MaxChan", 1)])
CHANNEL = teds.compose(
    3,
    [
        ("PhyUnits", Units(1, meters=Fraction(1, 2), extension=7)),
        ("LowLimit", -math.inf),
        ("HiLimit", math.inf),
        ("Sample", {"DatModel": 0, "ModLenth": 2, "SigBits": 12}),
        ("DAngles", [0.0, 1.5]),
        ("200", b"\x01\xff"),
    ],
    width=2,
)
CALIBRATION = teds.compose(5, [("LstCalDt", TimeInstance(5, 6, True)), ("Coefs", (0.1, 2.0))])
NAME = teds.compose(12, {"Format": 0, "TCName": "a <&> \u00e4"}, edition=2024)
DAMAGED = NAME[:-1] + bytes([NAME[-1] ^ 1])
BLOCKS = [
    TedsBlock(0, 1, META),
    TedsBlock(1, 3, CHANNEL),
    TedsBlock(1, 5, CALIBRATION),
    TedsBlock(None, 12, unframe(NAME)),
    TedsBlock(0, 12, DAMAGED),
    TedsBlock(2, 200, frame(bytes.fromhex("030400c80101 010100"))),
]

FORMAT_1 = {
    "format": "teds/1",
    "teds": [
        {
            "channel": 0,
            "access_code": 1,
            "family": 0,
            "version": 1,
            "width": 1,
            "edition": 2007,
            "framed": True,
            "name": "MetaTEDS",
            "fields": [
                {"type": 4, "name": "UUID", "kind": "octets", "value": "00010203040506070809"},
                {"type": 10, "name": "OholdOff", "kind": "number", "value": 0.1},
                {"type": 12, "name": "TestTime", "kind": "number", "value": "NaN"},
                {"type": 13, "name": "MaxChan", "kind": "integer", "value": 1},
            ],
        },
        {
            "channel": 1,
            "access_code": 3,
            "family": 0,
            "version": 1,
            "width": 2,
            "edition": 2007,
            "framed": True,
            "name": "ChanTEDS",
            "fields": [
                {
                    "type": 12,
                    "name": "PhyUnits",
                    "kind": "units",
                    "value": {"interpretation": "1", "meters": "1/2", "extension": "7"},
                },
                {"type": 13, "name": "LowLimit", "kind": "number", "value": "-INF"},
                {"type": 14, "name": "HiLimit", "kind": "number", "value": "INF"},
                {
                    "type": 18,
                    "name": "Sample",
                    "kind": "fields",
                    "fields": [
                        {"type": 40, "name": "DatModel", "kind": "integer", "value": 0},
                        {"type": 41, "name": "ModLenth", "kind": "integer", "value": 2},
                        {"type": 42, "name": "SigBits", "kind": "integer", "value": 12},
                    ],
                },
                {"type": 38, "name": "DAngles", "kind": "numbers", "value": [0.0, 1.5]},
                {"type": 200, "name": "", "kind": "octets", "value": "01ff"},
            ],
        },
        {
            "channel": 1,
            "access_code": 5,
            "family": 0,
            "version": 1,
            "width": 1,
            "edition": 2007,
            "framed": True,
            "name": "CalTEDS",
            "fields": [
                {
                    "type": 10,
                    "name": "LstCalDt",
                    "kind": "time",
                    "value": {"seconds": 5, "nanoseconds": 6, "negative": True},
                },
                {"type": 129, "name": "Coefs", "kind": "numbers", "value": [0.1, 2.0]},
            ],
        },
        {
            "channel": None,
            "access_code": 12,
            "family": 0,
            "subfamily": 255,
            "version": 2,
            "width": 1,
            "edition": 2024,
            "framed": False,
            "name": "XdcrName",
            "fields": [
                {"type": 4, "name": "Format", "kind": "integer", "value": 0},
                {"type": 5, "name": "TCName", "kind": "text", "value": "a <&> ä"},
            ],
        },
        {
            "channel": 0,
            "access_code": 12,
            "family": 0,
            "subfamily": 255,
            "version": 2,
            "width": 1,
            "edition": 2024,
            "framed": True,
            "name": "XdcrName",
            "fields": [
                {"type": 4, "name": "Format", "kind": "integer", "value": 0},
                {"type": 5, "name": "TCName", "kind": "text", "value": "a <&> ä"},
            ],
            "octets": "00000016030500ff0c0201040100050861203c263e20c3a4fc18",
        },
        {
            "channel": 2,
            "access_code": 200,
            "family": 0,
            "version": 1,
            "width": 1,
            "edition": 2007,
            "framed": True,
            "name": "manufacturer 200",
            "fields": [{"type": 1, "name": "", "kind": "octets", "value": "00"}],
        },
    ],
}
XML = """\
<?xml version="1.0" encoding="UTF-8"?>
<teds-set xmlns="urn:teds-provision:teds:1">
 <teds channel="0" access-code="1" edition="2007" family="0" version="1" width="1" name="MetaTEDS">
  <field type="4" name="UUID">
   <octets>00010203040506070809</octets>
  </field>
  <field type="10" name="OholdOff">
   <number>0.1</number>
  </field>
  <field type="12" name="TestTime">
   <number>NaN</number>
  </field>
  <field type="13" name="MaxChan">
   <integer>1</integer>
  </field>
 </teds>
 <teds channel="1" access-code="3" edition="2007" family="0" version="1" width="2" name="ChanTEDS">
  <field type="12" name="PhyUnits">
   <units interpretation="1" meters="1/2" extension="7" />
  </field>
  <field type="13" name="LowLimit">
   <number>-INF</number>
  </field>
  <field type="14" name="HiLimit">
   <number>INF</number>
  </field>
  <field type="18" name="Sample">
   <field type="40" name="DatModel">
    <integer>0</integer>
   </field>
   <field type="41" name="ModLenth">
    <integer>2</integer>
   </field>
   <field type="42" name="SigBits">
    <integer>12</integer>
   </field>
  </field>
  <field type="38" name="DAngles">
   <numbers>0.0 1.5</numbers>
  </field>
  <field type="200">
   <octets>01ff</octets>
  </field>
 </teds>
 <teds channel="1" access-code="5" edition="2007" family="0" version="1" width="1" name="CalTEDS">
  <field type="10" name="LstCalDt">
   <time seconds="5" nanoseconds="6" negative="true" />
  </field>
  <field type="129" name="Coefs">
   <numbers>0.1 2.0</numbers>
  </field>
 </teds>
 <teds access-code="12" edition="2024" family="0" subfamily="255" version="2" width="1" name="XdcrName" framed="false">
  <field type="4" name="Format">
   <integer>0</integer>
  </field>
  <field type="5" name="TCName">
   <text>a &lt;&amp;&gt; ä</text>
  </field>
 </teds>
 <teds channel="0" access-code="12" edition="2024" family="0" subfamily="255" version="2" width="1" name="XdcrName">
  <field type="4" name="Format">
   <integer>0</integer>
  </field>
  <field type="5" name="TCName">
   <text>a &lt;&amp;&gt; ä</text>
  </field>
  <octets>00000016030500ff0c0201040100050861203c263e20c3a4fc18</octets>
 </teds>
 <teds channel="2" access-code="200" edition="2007" family="0" version="1" width="1" name="manufacturer 200">
  <field type="1">
   <octets>00</octets>
  </field>
 </teds>
</teds-set>
"""
HEX = """\
# channel 0 access code 1 (MetaTEDS)
00000024030400010101040a000102030405060708090a043dcccccd0c047fff
ffff0d020001f94a
# channel 1 access code 3 (ChanTEDS)
000000450304000301020c000c32000101350001813c0001070d0004ff800000
0e00047f80000012000d28000100290001022a0002000c260008000000003fc0
0000c8000201fff822
# channel 1 access code 5 (CalTEDS)
0000001c0304000501010a08000000058000000681083dcccccd40000000fbcd
# channel - access code 12 (XdcrName)
030500ff0c0201040100050861203c263e20c3a4
# channel 0 access code 12 (XdcrName)
00000016030500ff0c0201040100050861203c263e20c3a4fc18
# channel 2 access code 200 (manufacturer 200)
0000000b030400c80101010100ff21
"""
INTEL_HEX = """\
:08FFF8000000002403040001D5
:020000040001F9
:100000000101040A000102030405060708090A04A5
:100010003DCCCCCD0C047FFFFFFF0D020001F94A5F
:00000001FF
"""


def test_json_whole() -> None:
    text = write_json(BLOCKS)
    assert json.loads(text) == FORMAT_1
    assert text == json.dumps(FORMAT_1, indent=1) + "\n", "members in their order"
    assert read_json(text) == BLOCKS


def test_xml_whole() -> None:
    assert write_xml(BLOCKS) == XML
    assert read_xml(XML.encode()) == BLOCKS


@pytest.mark.parametrize(
    ("edition", "time"),
    [
        (2007, TimeInstance((1 << 32) - 1, (1 << 31) - 1)),
        (2007, TimeInstance((1 << 32) - 1, 0, True)),
        (2024, TimeInstance(1 << 32, (1 << 32) - 1)),
        (2024, TimeInstance((1 << 48) - 1, 0)),
    ],
)
def test_the_longest_times_of_both_editions_go_through_json_and_xml(edition: Edition, time: TimeInstance) -> None:
    block = TedsBlock(1, 5, teds.compose(5, {"LstCalDt": time}, edition=edition))
    assert read_json(write_json([block])) == [block]
    assert read_xml(write_xml([block]).encode()) == [block]


def test_hex_whole() -> None:
    assert write_hex(BLOCKS) == HEX
    assert read_blocks(HEX.encode()) == BLOCKS


def test_intel_hex_whole_across_64_kib() -> None:
    assert write_intel_hex(BLOCKS[:1], address=0xFFF8) == INTEL_HEX
    text = write_intel_hex([BLOCKS[0], BLOCKS[0]])
    assert text.splitlines()[3][:9] == ":10003000", "each TEDS begins at a multiple of 16"
    full = TedsBlock(0, 12, bytes(32))
    assert [address for address, _ in stretches(write_intel_hex([full, full]))] == [0, 48], "at least one octet apart"
    with pytest.raises(BadDataError, match="ends at address FFFFFFFF"):
        write_intel_hex(BLOCKS[:1], address=(1 << 32) - len(META) + 1)
    write_intel_hex(BLOCKS[:1], address=(1 << 32) - len(META))


def one(**field: object) -> str:
    return json.dumps({"format": "teds/1", "teds": [{"access_code": 3, "fields": [field]}]})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"format": "teds/2", "teds": []}', 'This JSON contains no TEDS: "format" is not "teds/1" or "teds" is not'),
        ('{"format": "teds/1", "teds": {}}', 'This JSON contains no TEDS: "format" is not "teds/1" or "teds" is not'),
        ('{"format": "teds/1", "teds": [1]}', "TEDS 1 is not an object."),
        (
            '{"format": "teds/1", "teds": [{"channel": 65536}]}',
            "The channel of TEDS 1 is not a number from 0 to 65535.",
        ),
        ('{"format": "teds/1", "teds": [{"width": true}]}', "The width of TEDS 1 is not a number from 0 to 255."),
        (
            '{"format": "teds/1", "teds": [{"edition": 2010}]}',
            "TEDS 1 names the edition 2010; 2007 and 2024 are known.",
        ),
        ('{"format": "teds/1", "teds": [{"fields": 1}]}', '"fields" of TEDS 1 is not a list.'),
        ('{"format": "teds/1", "teds": [{"octets": 12}]}', "The octets of TEDS 1 are not hex digits."),
        (one(name=1), "A field of TEDS 1 is not an object with a name, or nests too deep."),
        (one(type=256), "The type of a field of TEDS 1 is not a number from 0 to 255."),
        (one(type=7, fields=1), '"fields" of TEDS 1, type 7 is not a list.'),
        (one(name="x", kind="number", value="1"), "TEDS 1, x holds '1' where a number is asked."),
        (one(name="x", kind="number", value=10**400), "TEDS 1, x holds a number that is too large."),
        (one(name="x", kind="numbers", value=[1, 10**400]), "TEDS 1, x holds a number that is too large."),
        (one(name="x", kind="number", value=True), "TEDS 1, x holds True where a number is asked."),
        (one(name="x", kind="integer", value=True), "The value of TEDS 1, x is no integer: 'True'."),
        (one(name="x", kind="integers", value=[1, True]), "The value of TEDS 1, x is no integers: '[1, True]'."),
        (one(name="x", value=1.5), "The value of TEDS 1, x is no value: '1.5'."),
        (
            one(name="x", kind="time", value={"seconds": 1 << 48}),
            "The seconds of TEDS 1, x is not a number from 0 to 28147",
        ),
        (one(name="x", kind="octets", value="0g"), "The octets of TEDS 1, x are not hex digits."),
        (one(name="x", kind="units", value={"parsecs": 1, "b": 1}), "Units have no part 'b'."),
        *(
            (one(name="x", kind="units", value={name: text}), "The units hold an exponent that is not a number.")
            for name in ("meters", "interpretation")
            for text in ("1/0" if name == "meters" else "1.5", "x", "")
        ),
        *(
            (
                one(name="x", kind="units", value={"meters": text}),
                "Exponents of units are multiples of 1/2 from -64 to 63.5.",
            )
            for text in ("1/3", "0.25", "-64.5", "64.5")
        ),
    ],
)
def test_what_is_wrong_with_json_in_whole_words(text: str, message: str) -> None:
    with pytest.raises(BadDataError) as refused:
        read_json(text)
    assert refused.value.message.startswith(message)


def around(inside: str) -> str:
    return f'<teds-set xmlns="urn:teds-provision:teds:1">{inside}</teds-set>'


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "<teds-set/>",
            "This XML is no set of TEDS: its root is 'teds-set', not teds-set of urn:teds-provision:teds:1.",
        ),
        ('<teds-set xmlns="urn:teds-provision:teds:1" a="1"/>', "teds-set has no attribute 'a'."),
        (around("<field/>"), "teds-set holds 'field' where teds is asked."),
        (around('<x xmlns="urn:other"/>'), "TEDS 1 holds the foreign element '{urn:other}x'."),
        (around('<teds colour="1"/>'), "TEDS 1 has no attribute 'colour'."),
        (around('<teds channel="65536"/>'), "channel of TEDS 1 is not a number from 0 to 65535: '65536'."),
        (around('<teds channel="²"/>'), "channel of TEDS 1 is not a number from 0 to 65535: '²'."),
        (around('<teds edition="2010"/>'), "TEDS 1 names the edition 2010; 2007 and 2024 are known."),
        (around('<teds framed="yes"/>'), "framed of TEDS 1 is true or false, not 'yes'."),
        (around("<teds><octets/><octets/></teds>"), "In TEDS 1, octets come last and once."),
        (around("<teds><octets>0g</octets></teds>"), "The octets of TEDS 1 are not hex digits."),
        (around("<teds><number>1</number></teds>"), "TEDS 1 holds 'number' where field is asked, or nests too deep."),
        (around("<teds><field a='1'/></teds>"), "TEDS 1 has no attribute 'a'."),
        *(
            (
                around(f"<teds><field name='x' type='7'><{kind}><a/></{kind}></field></teds>"),
                f"The {kind} of TEDS 1, x holds further elements.",
            )
            for kind in ("units", "number", "time")
        ),
        ("<a><b></a>", "This is not XML: "),
        ('<?xml version="1.0" encoding="no-such"?><a/>', "This is not XML: unknown encoding: no-such."),
        ('<?xml version="1.0" encoding="big5"?><a/>', "This is not XML: multi-byte encodings are not supported."),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', "The XML holds a DTD or an entity, which is refused."),
    ],
)
def test_what_is_wrong_with_xml_in_whole_words(text: str, message: str) -> None:
    with pytest.raises(BadDataError) as refused:
        read_xml(text.encode())
    assert refused.value.message.startswith(message)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("00000001FF", "Line 1 does not begin with a colon."),
        (":0000000g", "Line 1 holds something that is no hex digit."),
        (":00000001", "Line 1 has a wrong length."),
        (":01000001FE", "Line 1 has a wrong length."),
        (":00000001FE", "The checksum of line 1 is wrong."),
        (":00000006FA", "Line 1 holds a record of type 6 with 0 octets, which is none."),
        (":0100000400FB", "Line 1 holds a record of type 4 with 1 octets, which is none."),
        (":00000001FF\n\n:00000001FF", "Line 3 comes after the end record."),
        (":0100000000FF", "The Intel HEX text has no end record (:00000001FF): it was cut off."),
        (
            ":0200000000FFFF\n:0100010000FE\n:00000001FF",
            "Two records of the Intel HEX text overlap at address 00000001.",
        ),
    ],
)
def test_what_is_wrong_with_intel_hex_in_whole_words(text: str, message: str) -> None:
    with pytest.raises(BadDataError) as refused:
        stretches(text)
    assert refused.value.message == message


def test_records_of_intel_hex_are_joined_where_they_touch_and_wrap_at_64_kib() -> None:
    text = ":0100020001FC\n:0100010000FE\n:0100040003F8\n:02FFFF000102FD\n:00000001FF\n"
    assert stretches(text) == [(0, b"\x02\x00\x01"), (4, b"\x03"), (0xFFFF, b"\x01")]


def test_the_tedsid_of_a_written_tree_is_the_one_that_it_names() -> None:
    """docs/formats.md: family, sub-family, version and width are those of the TEDSID; left out, the usual ones."""
    fields = [{"name": "TCName", "value": "a"}]
    for named, tedsid in (
        ({}, "0304000c0101"),
        ({"edition": 2024}, "030500ff0c0201"),
        ({"family": 7, "version": 0, "width": 2}, "0304070c0002"),
        ({"edition": 2024, "family": 9, "subfamily": 3, "version": 5, "width": 1}, "030509030c0501"),
        ({"framed": False}, "0304000c0101"),
    ):
        teds_entry = {"access_code": 12, "fields": fields, **named}
        (block,) = read_json(json.dumps({"format": "teds/1", "teds": [teds_entry]}))
        start = 4 if named.get("framed", True) else 0
        assert block.octets[start : start + len(tedsid) // 2].hex() == tedsid, named
        attributes = " ".join(f'{name}="{str(value).lower()}"' for name, value in named.items())
        xml = f'<teds-set xmlns="urn:teds-provision:teds:1"><teds access-code="12" {attributes}>'
        xml += '<field name="TCName"><text>a</text></field></teds></teds-set>'
        assert read_xml(xml.encode()) == [block], named


def test_a_text_that_is_no_utf_8_goes_as_octets_through_json_and_xml() -> None:
    block = TedsBlock(0, 11, teds.compose(11, [("Text", {"LangCode": "en", "Text": b"\xff\x00", "Compress": 1})]))
    (entry,) = json.loads(write_json([block]))["teds"]
    assert entry["fields"][0]["fields"][-1] == {"name": "Text", "kind": "octets", "value": "ff00"}
    assert read_json(write_json([block])) == read_xml(write_xml([block]).encode()) == [block]


def test_a_text_based_teds_has_one_text_of_each_language_in_json_and_xml() -> None:
    texts = [("Text", {"LangCode": code, "Text": text, "Compress": 0}) for code, text in (("en", "<a/>"), ("de", "ä"))]
    block = TedsBlock(0, 11, teds.compose(11, texts))
    (entry,) = json.loads(write_json([block]))["teds"]
    assert entry["fields"] == [
        {
            "name": "Text",
            "kind": "fields",
            "fields": [
                {"type": 20, "name": "LangCode", "kind": "text", "value": code},
                {"type": 23, "name": "Compress", "kind": "integer", "value": 0},
                {"name": "Text", "kind": "text", "value": text},
            ],
        }
        for code, text in (("en", "<a/>"), ("de", "ä"))
    ]
    assert "octets" not in entry, "the directory follows from them"
    assert write_xml([block]).count('<field name="Text">') == 4
    assert read_json(write_json([block])) == read_xml(write_xml([block]).encode()) == [block]


@pytest.mark.parametrize(
    ("flag", "framed"), [("true", True), ("1", True), (" true ", True), ("false", False), ("0", False), (" 0 ", False)]
)
def test_a_flag_of_xml_is_a_word_or_a_digit_as_its_schema_has_it(flag: str, framed: bool) -> None:
    xml = around(f"<teds access-code='12' framed='{flag}'><field name='TCName'><text>a</text></field></teds>")
    (block,) = read_xml(xml.encode())
    assert block.octets.startswith(bytes.fromhex("0304000c0101")) is not framed
