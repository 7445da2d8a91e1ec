"""The Origin TEDS: one way to write it, everything else is refused, and it marks the node that carries it."""

from __future__ import annotations

import string
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import frame, raw_tuple
from teds_provision.teds.codec.text_lines import MOST_OCTETS, compose_lines, read_lines
from teds_provision.teds.formats import TedsBlock
from teds_provision.teds.origin import ORIGIN, Origin, origin_of, read_origin
from teds_provision.teds.sheet import Sheet
from teds_provision.teds.show import describe
from teds_provision.teds.value_table import read_value_table, signal_xml

DIGEST = "5a" * 32
TORQUE = Origin("dbc", "Torque", DIGEST)
NAMES = st.text(st.characters(exclude_categories=("C", "Z")), min_size=1, max_size=40)
ORIGINS = st.one_of(
    st.builds(
        Origin,
        st.sampled_from(["dbc", "eds"]),
        NAMES,
        st.text(string.digits + "abcdef", min_size=64, max_size=64),
    ),
    st.builds(Origin, st.just("iio"), NAMES),
)


@given(ORIGINS)
def test_what_is_written_is_read_back_and_the_decoder_has_nothing_against_it(origin: Origin) -> None:
    octets = origin.encode()
    assert read_origin(octets) == origin
    decoded = teds.decode(octets)
    assert decoded.verdict == "clean"
    assert teds.recompose(decoded) == octets
    assert decoded.get("Lines") == octets[12:-2].decode()
    assert origin_of({ORIGIN: octets}) == origin


def test_a_node_without_a_meta_teds_has_its_name_and_origin_all_the_same() -> None:
    name = teds.compose(12, {"Format": 0, "TCName": "bench"})
    meta = Sheet.from_blocks({ORIGIN: TORQUE.encode(), (0, 12): name}).meta
    assert (meta.origin, meta.name, meta.uuid) == (TORQUE, "bench", None)


@given(st.binary(max_size=300))
def test_octets_end_in_an_origin_or_in_an_error_of_ours(octets: bytes) -> None:
    assert origin_of({ORIGIN: octets}) is None or read_origin(octets).encode() == octets
    framed = frame(bytes.fromhex("030400820101") + raw_tuple(4, octets[:255]))
    assert origin_of({ORIGIN: framed}) is None or read_origin(framed).encode() == framed


@given(ORIGINS, st.data())
def test_a_changed_octet_is_refused_or_says_something_else(origin: Origin, data: st.DataObject) -> None:
    block = bytearray(origin.encode()[4:-2])
    at = data.draw(st.integers(0, len(block) - 1))
    block[at] ^= data.draw(st.integers(1, 255))
    changed = frame(bytes(block))
    try:
        found = read_origin(changed)
    except BadDataError:
        return
    assert found != origin
    assert found.encode() == changed


def test_the_octets_are_those_of_the_page() -> None:
    lines = b"kind=dbc\nname=Torque\nsha256=" + DIGEST.encode() + b"\n"
    assert TORQUE.encode() == frame(bytes.fromhex("030400820101") + bytes([4, len(lines)]) + lines)
    assert Origin("iio", "bmp280").encode()[12:-2] == b"kind=iio\nname=bmp280\n"


@pytest.mark.parametrize(
    "lines",
    [
        b"kind=dbc\nname=Torque\n",  # a file has a digest
        b"name=Torque\nkind=iio\n",
        b"kind=iio\nname=bmp280",
        b"kind=iio\nname=bmp280\nmore=1\n",
        b"kind=iio\nname=\n",
        b"kind=usb\nname=bmp280\n",
        b"kind=iio\nname=a\rb\n",
        b"kind=iio\nname=\xff\n",
        b"kind=dbc\nname=Torque\nsha256=" + DIGEST.upper().encode() + b"\n",
        b"kind=iio\nname=bmp280\nsha256=" + DIGEST.encode() + b"\n",
    ],
)
def test_other_lines_mark_nothing(lines: bytes) -> None:
    teds_of_a_stranger = frame(bytes.fromhex("030400820101") + raw_tuple(4, lines))
    assert origin_of({ORIGIN: teds_of_a_stranger}) is None
    with pytest.raises(BadDataError):
        read_origin(teds_of_a_stranger)


def test_what_it_cannot_hold_is_refused() -> None:
    with pytest.raises(BadDataError, match="at most 255 octets"):
        Origin("dbc", "x" * 200, DIGEST).encode()
    with pytest.raises(BadDataError, match="printable"):
        Origin("iio", "two\nlines").encode()
    fitting = MOST_OCTETS - len("certificate=\n")
    assert read_lines(131, compose_lines(131, {"certificate": "x" * fitting}), ["certificate"])
    with pytest.raises(BadDataError):
        compose_lines(131, {"certificate": "x" * (fitting + 1)})


def test_show_says_that_the_node_is_wrapped() -> None:
    shown = describe(TedsBlock(*ORIGIN, TORQUE.encode()))
    assert shown.title == "channel 0 · OriginTEDS (130)"
    assert dict(shown.summary)["wrapped"].startswith("CAN message Torque (dbc): the node's proof ends at the wrapper")


def test_show_says_of_other_lines_that_they_are_none_of_the_profile() -> None:
    """A reader learns neither that the node is wrapped nor that it is not."""
    stranger = frame(bytes.fromhex("030400820101") + raw_tuple(4, b"kind=usb\nname=bmp280\n"))
    with pytest.raises(BadDataError) as why:
        read_origin(stranger)
    summary = dict(describe(TedsBlock(*ORIGIN, stranger)).summary)
    assert summary == {"form": f"not the Origin TEDS of the profile: {why.value.message}"}


def test_the_other_edition_has_the_same_form() -> None:
    octets, findings = teds.convert(teds.decode(TORQUE.encode()), 2024)
    assert octets == TORQUE.encode()
    assert [finding.code for finding in findings] == ["one-form"]


@given(st.dictionaries(st.integers(0, 10**6), NAMES, max_size=10), st.text(max_size=50), NAMES)
def test_a_value_table_is_read_back_from_its_teds(rows: dict[int, str], comment: str, name: str) -> None:
    text = signal_xml(name, comment, rows)
    octets = teds.compose(4, (("Text", {"LangCode": "en", "Text": text or "-"}),))
    assert read_value_table(teds.decode(octets)) == rows


@given(st.binary(max_size=200))
def test_a_stranger_s_text_is_no_value_table_and_no_error(octets: bytes) -> None:
    for content in (octets, b'<Signal name="x">' + octets):
        made = teds.compose(4, (("Text", {"LangCode": "en", "Text": content.decode("latin-1")}),))
        assert all(word.isprintable() for word in read_value_table(teds.decode(made)).values())
    assert read_value_table(None) == {}


def test_a_value_table_has_its_bounds_when_it_is_written_and_when_it_is_read() -> None:
    assert signal_xml("Torque", "", {}) == ""
    rows = {number: f"state {number}" for number in range(70)}
    text = signal_xml('a"b', "x" * 201, dict(reversed(rows.items())))
    assert text.startswith(f"""<Signal name='a"b' comment="{"x" * 200}"><Value raw="0">state 0</Value>""")
    assert (text.count("<Value"), '<Value raw="63">' in text) == (64, True)
    assert signal_xml("T", "", {1: "a<b>&c"}) == '<Signal name="T"><Value raw="1">a&lt;b&gt;&amp;c</Value></Signal>'

    def read(*texts: str) -> dict[int, str]:
        return read_value_table(SimpleNamespace(text=[text.encode() for text in texts]))  # type: ignore[arg-type]

    assert read("a name", signal_xml("T", "", {1: "a<b>&c"})) == {1: "a<b>&c"}
    assert read('<Signal name="T"></Signal>', signal_xml("T", "", {1: "on"})) == {}, "the first one counts"
    many = "".join(f'<Value raw="{number}">on</Value>' for number in range(65))
    assert list(read(f'<Signal name="T">{many}')) == list(range(64))
    for value, found in (("9" * 19, {int("9" * 19): "on"}), ("9" * 20, {})):
        assert read(f'<Signal name="T"><Value raw="{value}">on</Value>') == found
    for word, count in (("x" * 128, 1), ("x" * 129, 0), ("", 0), ("a\x07b", 0), ("a<b", 0)):
        assert len(read(f'<Signal name="T"><Value raw="1">{word}</Value>')) == count
    row = '<Value raw="1">on</Value>'
    begin = '<Signal name="T">'
    assert read(begin + " " * (16_384 - len(begin) - len(row)) + row) == {1: "on"}
    assert read(begin + " " * (16_385 - len(begin) - len(row)) + row) == {}
    assert read("é" + begin + row) == {}
