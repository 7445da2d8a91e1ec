"""A lab's own datasheet XML becomes a type by a small mapping file; what is wrong in either is named."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import pytest

from teds_provision.errors import BadDataError
from teds_provision.teds.formats import mapped
from teds_provision.teds.formats.mapped import profile_from_xml
from teds_provision.teds.profile.load import parse_profile

EXAMPLES = Path(__file__).resolve().parents[2] / "examples" / "xml"
MAP = 'channel = "c"\n[channel-keys]\nname = "n"\n'
XML = b"<d><c><n>force</n></c></d>"


@pytest.mark.parametrize(
    ("name", "channels"),
    [
        ("angle", {1: ("angle", "degree", 0.0, 6.2831853)}),
        ("virtual", {1: ("force x", "N", -5.0, 5.0), 2: ("force z", "N", -20.0, 20.0),
                     3: ("temperature", "degC", 273.15, 333.15)}),
    ],
)  # fmt: skip
def test_the_examples_become_types_with_limits_in_their_units(
    name: str, channels: dict[int, tuple[str, str, float, float]]
) -> None:
    mapping = (EXAMPLES / f"{name}-map.toml").read_text()
    text = profile_from_xml((EXAMPLES / f"{name}.xml").read_bytes(), mapping, name=name)
    profile = parse_profile(text, name)
    found = {channel.number: (channel.name, channel.unit.text) for channel in profile.channels}
    assert found == {number: wanted[:2] for number, wanted in channels.items()}
    for channel in profile.channels:
        ends = (channel.fields["LowLimit"], channel.fields["HiLimit"])
        assert ends == pytest.approx(channels[channel.number][2:], rel=1e-6)


WHOLE = b"""<lab:sheet xmlns:lab="urn:lab"><head><title>  Two
  <b>ways</b></title><serial>007</serial></head>
 <out no="4" kind="F"><range unit="newton"><low>-1.50</low><high>+2e1</high></range></out>
 <out kind="T"><range unit="C"><low>0</low><high>9</high></range></out></lab:sheet>"""
WHOLE_MAP = """
channel = "out"
[keys]
description = "head/title"
name = "head/serial"
[values]
title = "Mine"
name = "overlaid"
links = ["nfc", "can"]
abstract = false
[channel-keys]
name = { at = "@kind", words = { F = "force", T = "temperature" } }
unit = { at = "range/@unit", words = { newton = "N", C = "degC" } }
low-limit = { at = "range/low", unit-at = "range/@unit", words = { newton = "N", C = "degC" } }
high-limit = { at = "range/high", unit = "kN" }
type = "range/high"
[channel-values]
type = "overlaid"
sample = { model = "unsigned", octets = 2 }
"""


@pytest.mark.parametrize("text", ['a", octets = "4', "C:\\temp", "tab\there", "\x7f", "é ✓", "]\n[x]"])
def test_a_text_of_the_laboratory_stays_one_text(text: str) -> None:
    """As a value of the file and inside a table of one line; it adds no key, whatever is in it."""
    assert tomllib.loads(f"title = {mapped._toml(text)}\n") == {"title": text}
    sample = {"model": text, "octets": 2}
    assert tomllib.loads(f"sample = {mapped._toml(sample)}\n") == {"sample": sample}


def test_the_text_that_is_made_whole() -> None:
    """Places go before values; a channel without a number gets its place in the file; white space is one space."""
    mapping = WHOLE_MAP.replace("[channel-keys]", "[channel-keys]\nnumber = '@no'", 1)
    xml = WHOLE.replace(b'<out kind="T">', b'<out no="05" kind="T">')
    text = profile_from_xml(xml, mapping, name="lab", file="/home/me/two.xml")
    assert (
        text
        == """# Made from two.xml.
title = "Mine"
name = 7
links = ["nfc", "can"]
abstract = false
description = "Two ways"

[channel.4]
type = 20.0
sample = { model = "unsigned", octets = 2 }
name = "force"
unit = "N"
low-limit = "-1.50 N"
high-limit = "+2e1 kN"

[channel.5]
type = 9
sample = { model = "unsigned", octets = 2 }
name = "temperature"
unit = "degC"
low-limit = "0 degC"
high-limit = "9 kN"
"""
    )
    numbered = profile_from_xml(WHOLE, WHOLE_MAP, name="lab", file="two.xml")
    assert [line for line in numbered.splitlines() if line.startswith("[")] == ["[channel.1]", "[channel.2]"]
    assert 'title = "lab"' in profile_from_xml(WHOLE, 'channel = "out"', name="lab")


@pytest.mark.parametrize(
    ("xml", "mapping", "words"),
    [
        (XML, "", "channel is missing"),
        (XML, 'channel = "x"', "no element 'x'"),
        (XML, 'channel = "c"\n[channels]\n', "unknown key 'channels'"),
        (XML, 'channel = "c"\n[channel-keys]\nname = "m"\n', "nothing at 'm'"),
        (
            XML,
            'channel = "c"\n[channel-keys]\nlow-limit = { at = "n", unit = "N" }\n',
            "'force' at 'n' is not a number",
        ),
        (XML, 'channel = "c"\n[channel-keys]\nnumber = "n"\n', "'force' is no channel number"),
        *((XML, f'channel = "c"\n{key} = 3\n', f"{key} is not a table") for key in ("keys", "channel-keys", "values")),
        (XML, 'channel = "c["\n', "is no path"),
        (XML, 'channel = "c"\n[channel-keys]\nname = 3\n', "name is no place"),
        (b"<d>" + b"<c/>" * 256 + b"</d>", 'channel = "c"\n', "at most 255"),
        (b"<d><c></d>", MAP, "is not XML"),
        (b'<?xml version="1.0" encoding="no-such"?><d/>', MAP, "is not XML"),
        (b'<d><c n="' + b"x" * 300 + b'"/></d>', 'channel = "c"\n[channel-keys]\nname = "@n"\n', "more than 200"),
    ],
)
def test_what_is_wrong_is_named(xml: bytes, mapping: str, words: str) -> None:
    with pytest.raises(BadDataError, match=words):
        profile_from_xml(xml, mapping, name="lab")


def test_a_dtd_is_refused_also_if_it_declares_nothing() -> None:
    with pytest.raises(BadDataError, match="has a DTD or entities, which are not read") as refusal:
        profile_from_xml(b"<!DOCTYPE d><d/>", MAP, name="lab")
    assert refusal.value.hint == "Remove the DOCTYPE."


@pytest.mark.parametrize("octets", [b"<d>", b'<?xml version="1.0" encoding="nowhere-8"?><d/>', b""])
def test_what_is_no_xml_or_in_an_unknown_encoding_is_refused(octets: bytes) -> None:
    with pytest.raises(BadDataError, match="is not XML"):
        profile_from_xml(octets, MAP, name="lab")


def test_a_text_of_the_xml_has_at_most_200_characters() -> None:
    for letters in (200, 201):
        xml = f"<d><c><n>{'x' * 100}<b>{'y' * (letters - 100)}</b></n></c></d>".encode()
        if letters == 200:
            assert f'name = "{"x" * 100}{"y" * 100}"' in profile_from_xml(xml, MAP, name="lab")
        else:
            with pytest.raises(BadDataError, match=r"^The text at 'n' has more than 200 characters\.$"):
                profile_from_xml(xml, MAP, name="lab")


@pytest.mark.parametrize(
    ("mapping", "hint"),
    [
        ('channel = "c["\n', 'Write names of elements: "Range/Low", or "Range/@unit".'),
        ('channel = "c"\n[channel-keys]\nname = 3\n', 'Write key = "Path", or { at = "Path", unit = "degree" }.'),
        ('channel = "c"\nkeys = 3\n', "Write [keys]."),
    ],
)
def test_what_is_wrong_with_a_mapping_is_answered_with_how_to_write_it(mapping: str, hint: str) -> None:
    with pytest.raises(BadDataError) as refused:
        profile_from_xml(XML, mapping, name="lab")
    assert refused.value.hint == hint


@pytest.mark.parametrize(
    "bomb",
    [
        b'<!DOCTYPE d [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]><d><c><n>&b;</n></c></d>',
        b'<!DOCTYPE d [<!ENTITY a SYSTEM "file:///etc/passwd">]><d><c><n>&a;</n></c></d>',
        b"<d>" * 2_000_000,
        b"<d " + b'a="" ' * 3_000_000 + b"/>",
        b"<d><c><n>" + b"x" * 70_000_000 + b"</n></c></d>",
    ],
    ids=["entities", "a file", "depth", "attributes", "length"],
)
def test_a_bomb_costs_little(bomb: bytes) -> None:
    began = time.process_time()
    with pytest.raises(BadDataError):
        profile_from_xml(bomb, MAP, name="lab")
    assert time.process_time() - began < 1


@pytest.mark.parametrize("number", ["-1", "1.5", "\u0663", "two"])
def test_what_is_no_channel_number_is_named_with_its_place_in_the_file(number: str) -> None:
    xml = f"<d><c n='1'/><c n='{number}'/></d>".encode()
    with pytest.raises(BadDataError) as refused:
        profile_from_xml(xml, "channel = 'c'\n[channel-keys]\nnumber = '@n'\n", name="lab", file="/a/two.xml")
    assert refused.value.message == f"/a/two.xml, channel 2: {number!r} is no channel number."


def test_a_node_has_at_most_255_channels() -> None:
    for count in (255, 256):
        xml = b"<d>" + b"<c/>" * count + b"</d>"
        if count == 255:
            assert "[channel.255]" in profile_from_xml(xml, "channel = 'c'\n", name="lab")
        else:
            with pytest.raises(BadDataError, match=r"^a\.xml has 256 channels; a node has at most 255\.$"):
                profile_from_xml(xml, "channel = 'c'\n", name="lab", file="a.xml")


def test_the_place_of_channels_is_a_text() -> None:
    with pytest.raises(BadDataError, match=r"^the mapping: channel is missing\.$"):
        profile_from_xml(XML, "channel = 3\n", name="lab")
