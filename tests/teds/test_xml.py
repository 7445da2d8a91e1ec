"""XML: valid by the shipped schema, hostile documents refused, schema and reader of one mind."""

import json
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.formats import TedsBlock, read_blocks, write_blocks
from teds_provision.teds.formats.xmlform import NAMESPACE, SCHEMA
from tests.pace import costs_at_most

VECTORS = sorted((Path(__file__).parent.parent / "vectors" / "ieee1451").glob("*.hex"))
PROFILES = sorted((Path(__file__).parent.parent.parent / "profiles").glob("*-sensor.toml"))
OPEN = f'<teds-set xmlns="{NAMESPACE}">'


@pytest.fixture(scope="module")
def schema():
    xmlschema = pytest.importorskip("xmlschema")
    return xmlschema.XMLSchema(str(SCHEMA))


@pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)
def test_every_given_string_gives_valid_xml(schema, path):
    schema.validate(write_blocks(read_blocks(path.read_bytes()), "xml"))


@pytest.mark.parametrize("path", [path for path in PROFILES if path.stem != "smart-sensor"], ids=lambda path: path.stem)
def test_every_profile_gives_valid_xml(schema, path):
    schema.validate(write_blocks(read_blocks(path.read_bytes(), path=path), "xml"))


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture])
@given(text=st.text(max_size=30), number=st.floats(width=32), channel=st.none() | st.integers(0, 65535))
def test_any_text_and_number_give_valid_xml_that_comes_back(schema, text, number, channel):
    blocks = [
        TedsBlock(channel, 12, teds.compose(12, {"Format": 1, "TCName": text})),
        TedsBlock(channel, 3, teds.compose(3, {"LowLimit": number, "DAngles": (number, 0.0)})),
    ]
    document = write_blocks(blocks, "xml")
    schema.validate(document)
    assert read_blocks(document.encode()) == blocks


BOMB = (
    '<!DOCTYPE a [<!ENTITY a "{}">' + "".join(f'<!ENTITY {b} "{f"&{a};" * 10}">' for a, b in ("ab", "bc", "cd")) + "]>"
)


@pytest.mark.parametrize(
    "document",
    [
        BOMB.format("ha" * 100) + f"{OPEN}&d;</teds-set>",
        f'<!DOCTYPE a SYSTEM "file:///etc/passwd">{OPEN}</teds-set>',
        f'<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]>{OPEN}&x;</teds-set>',
        f"<!DOCTYPE teds-set>{OPEN}</teds-set>",
    ],
    ids=["bomb", "external DTD", "external entity", "bare DTD"],
)
def test_documents_with_a_dtd_or_entities_are_refused_at_once(document):
    with costs_at_most(1.0), pytest.raises(BadDataError, match="refused"):
        read_blocks(document.encode())


INVALID = [
    "<teds/>",
    '<teds access-code="256"><octets>00</octets></teds>',
    '<teds channel="-1"><octets>00</octets></teds>',
    '<teds colour="red"><octets>00</octets></teds>',
    '<teds edition="1999"><octets>00</octets></teds>',
    '<teds framed="perhaps"><octets>00</octets></teds>',
    "<teds><octets>0</octets></teds>",
    "<teds><octets>00</octets><octets>00</octets></teds>",
    '<teds><octets>00</octets><field name="TCName"/></teds>',
    "<other/>",
    '<teds><field colour="red"/></teds>',
    '<teds access-code="12"><field name="Format"><integer>0</integer><integer>0</integer></field></teds>',
    '<teds access-code="12"><field name="Format"><integer>zero</integer></field></teds>',
    '<teds access-code="12"><field name="Format"><complex>0</complex></field></teds>',
    '<teds access-code="3"><field name="PhyUnits"><units parsecs="1"/></field></teds>',
    '<teds access-code="3"><field name="PhyUnits"><units meters="1/3"/></field></teds>',
    '<teds access-code="3"><field name="LowLimit"><number>low</number></field></teds>',
    '<teds access-code="5"><field name="LstCalDt"><time seconds="-1"/></field></teds>',
    '<teds access-code="1"><field name="VGroup"><field name="MemList"><integers>1 x</integers></field></field></teds>',
]


@pytest.mark.parametrize("inner", INVALID)
def test_what_the_schema_refuses_the_reader_refuses_too(schema, inner):
    document = f"{OPEN}{inner}</teds-set>"
    assert inner == "<teds/>" or not schema.is_valid(document)
    with pytest.raises(BadDataError):
        read_blocks(document.encode())


@pytest.mark.parametrize(
    "document", ["<whitelist/>", '<teds-set xmlns="urn:other"/>', f'{OPEN[:-1]} a="1"/>', "<teds-set>", "<"]
)
def test_other_xml_is_refused(document):
    with pytest.raises(BadDataError):
        read_blocks(document.encode(), "xml")


def test_deep_nesting_is_refused():
    deep = '<field name="x">' * 5000 + "</field>" * 5000
    with pytest.raises(BadDataError):
        read_blocks(f'{OPEN}<teds access-code="1">{deep}</teds></teds-set>'.encode())


@pytest.mark.parametrize("levels", [9, 10])
def test_fields_nest_nine_levels(levels):
    """A tree of nine is read, and refused for what is in it: no TEDS has fields so deep."""
    value = '<field name="x"><integer>0</integer></field>'
    for _ in range(levels - 1):
        value = f'<field name="x">{value}</field>'
    entry = {"name": "x", "kind": "integer", "value": 0}
    for _ in range(levels - 1):
        entry = {"name": "x", "fields": [entry]}
    document = json.dumps({"format": "teds/1", "teds": [{"access_code": 1, "fields": [entry]}]})
    for text in (f'{OPEN}<teds access-code="1">{value}</teds></teds-set>', document):
        with pytest.raises(BadDataError) as refused:
            read_blocks(text.encode())
        assert ("nests too deep" in refused.value.message) is (levels == 10)


def test_xml_in_another_encoding_is_read():
    document = write_blocks([TedsBlock(1, 12, teds.compose(12, {"Format": 0, "TCName": "Öl"}))], "xml")
    assert (
        teds.decode(read_blocks(document.replace("UTF-8", "ISO-8859-1").encode("latin-1"), "xml")[0].octets).get(
            "TCName"
        )
        == "Öl"
    )
