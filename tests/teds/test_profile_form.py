"""A profile made from TEDS, to its last line, and what it cannot hold."""

from __future__ import annotations

import tomllib
from pathlib import Path

from teds_provision import teds
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.formats.profileform import read_profile, spell, write_profile
from teds_provision.teds.image import TedsBlock
from teds_provision.teds.profile import load_profile
from teds_provision.teds.units import parse_unit

from .test_profile import RICH, write

UUID = bytes(range(10))
CHANNEL = """\
name = "t1"
unit = "K"
display-unit = "degC"
type = "sensor"
low-limit = 233.15
high-limit = 373.15
uncertainty = 0.5
self-test = false
update-time = 0.001
write-setup-time = 2e-06
read-setup-time = 5e-05
sampling-period = 0.001
warm-up-time = 120.0
read-delay-time = 0.003
self-test-time = 1.0
calibration-key = "none"
sample = { model = "fraction", octets = 2, bits = 12 }
sampling = { modes = ["trigger", "immediate"], default = "immediate" }
"""
WRITTEN = """\
# Profile made from TEDS. The UUID belongs to the node, so a profile has none.
title = "rich board"
name = "rich board"

[meta]
operation-timeout = 0.1
slow-timeout = 2.0
self-test-time = 60.0

[[meta.control-group]]
type = 1
members = [1, 2]

[[meta.vector-group]]
type = 3
members = [2, 3]

[[meta.geo-location]]
location = 4
type = 5
members = [1]

[[meta.proxy]]
channel = 3
organization = 6
members = [1, 2]

[channel.1]
name = "t1"
unit = "K"
display-unit = "degC"
type = "sensor"
low-limit = 233.15
high-limit = 373.15
uncertainty = 0.5
self-test = false
update-time = 0.001
write-setup-time = 2e-06
read-setup-time = 5e-05
sampling-period = 0.001
warm-up-time = 120.0
read-delay-time = 0.003
self-test-time = 1.0
calibration-key = "none"
sample = { model = "fraction", octets = 2, bits = 12 }
sampling = { modes = ["trigger", "immediate"], default = "immediate" }

[channel.2]
name = "t2"
unit = "K"
display-unit = "degC"
type = "event-sensor"
low-limit = 233.15
high-limit = 373.15
uncertainty = 0.5
self-test = true
multi-range = true
update-time = 0.001
write-setup-time = 2e-06
read-setup-time = 5e-05
sampling-period = 0.001
warm-up-time = 120.0
read-delay-time = 0.003
self-test-time = 1.0
time-source = 7
incoming-delay = 1e-06
outgoing-delay = 2e-06
trigger-uncertainty = 3e-06
transmission = "buffer-or-interval"
buffered = 8
end-of-set = 9
edge-report = "selectable-both"
direction = 1.5707964
direction-angles = [0.0, 3.1415927]
event-options = "changeable-checked"
calibration-key = "tim-self"
sample = { model = "fraction", octets = 2, bits = 12 }
sampling = { modes = ["free-running", "free-running-pre-trigger", "continuous"], default = "free-running" }

[channel.2.data-set]
unit = "K"
repeats = 10
origin = 266.48334
step = 1.0
pre-trigger = 3

[channel.3]
name = "valve"
unit = "K"
display-unit = "degC"
type = "actuator"
low-limit = 233.15
high-limit = 373.15
uncertainty = 0.5
self-test = false
update-time = 0.001
write-setup-time = 2e-06
read-setup-time = 5e-05
sampling-period = 0.001
warm-up-time = 120.0
read-delay-time = 0.003
self-test-time = 1.0
actuator-halt = "ramp"
calibration-key = "none"
sample = { model = "fraction", octets = 2, bits = 12 }
sampling = { modes = ["trigger", "immediate"], default = "immediate" }

[phy]
radio = "bluetooth"
bit-rate = 1000000
encryption = 272
authentication = true
battery = false
retries = 2

[[text]]
kind = "title"
channel = 0
language = "de"
xml = "<a/>"
"""


def blocks_of(folder: Path) -> list[TedsBlock]:
    built = load_profile(write(folder, "rich", RICH)).build(UUID).blocks
    return [TedsBlock(channel, code, octets) for (channel, code), octets in built.items()]


def test_a_whole_profile_from_teds(tmp_path: Path) -> None:
    blocks = blocks_of(tmp_path)
    assert write_profile(blocks) == (WRITTEN, ())
    again = {(block.channel, block.access_code): block.octets for block in read_profile(WRITTEN)}
    for block in blocks:
        if (block.channel, block.access_code) != (0, 1):  # the Meta-TEDS has the node's UUID
            assert again[block.channel, block.access_code] == block.octets


def test_what_a_profile_cannot_hold_is_at_its_top(tmp_path: Path) -> None:
    (channel,) = [block.octets for block in blocks_of(tmp_path) if (block.channel, block.access_code) == (1, 3)]
    text, lost = write_profile(
        [
            TedsBlock(None, 3, channel),
            TedsBlock(1, 3, channel),
            TedsBlock(None, None, b""),
            TedsBlock(1, 128, b"x"),
            TedsBlock(1, 5, b"y"),
        ]
    )
    assert lost == (
        "a second ChanTEDS of channel 1.",
        "a TEDS without a TEDSID.",
        "CalTEDS of channel 1 (calibrations come from a file of their own).",
        "SecurityTEDS of channel 1 (made when a datasheet is signed).",
    )
    head = "# Profile made from TEDS. The UUID belongs to the node, so a profile has none.\n"
    head += "".join(f"# Not held here: {sentence}\n" for sentence in lost)
    meta = (
        'title = "unnamed"\n\n[meta]\n'
        "operation-timeout = 1.0  # placeholder: there was no Meta-TEDS\nself-test-time = 0.0  # placeholder\n\n"
    )
    assert text == head + meta + "[channel.1]\n" + CHANNEL.partition("\n")[2]


def test_a_text_in_several_languages_is_not_held() -> None:
    texts = [("Text", {"LangCode": code, "Text": "<a/>"}) for code in ("en", "de")]
    for given, held in ((texts[:1], True), (texts, False)):
        text, _ = write_profile([TedsBlock(0, 11, teds.compose(11, given))])
        assert ("[[text]]" in text) is held


def test_units_are_spelt_so_that_they_are_read_again() -> None:
    spelt = {
        text: spell(parse_unit(text).units) for text in ("degC", "N", "mm/s", "rpm", "count", "kg*m**2", "%", "1/s")
    }
    assert spelt == {
        "degC": "K",
        "N": "N",
        "mm/s": "m/s",
        "rpm": "rad/s",
        "count": "count",
        "kg*m**2": "m²·kg",
        "%": "ratio",
        "1/s": "1/s",
    }


def test_any_character_of_a_name_is_written_as_toml_reads_it() -> None:
    """TOML allows no control character in a text, DEL among them."""
    name = 'a"b\\c\n\r\t\x00\x1f\x7f\x80ä'
    text, _ = write_profile([TedsBlock(0, 12, teds.compose(12, {"Format": 0, "TCName": name}))])
    spelt = 'name = "a\\"b\\\\c\\n\\r\\t\\u0000\\u001f\\u007f\x80ä"'
    assert spelt in text.split("\n")
    assert tomllib.loads(spelt) == {"name": name}


def test_of_a_field_that_is_there_twice_the_first_is_written_and_none_that_is_no_number() -> None:
    twice = frame(bytes.fromhex("030400030101 0d043f800000 0d0440000000 0e047f800000"))
    angles = frame(bytes.fromhex("030400030101 26087fc000003f800000"))
    text, _ = write_profile([TedsBlock(1, 3, twice), TedsBlock(2, 3, angles)])
    assert [line for line in text.splitlines() if line.startswith(("low-", "high-", "direction"))] == [
        "low-limit = 1.0"
    ]
    good = frame(bytes.fromhex("030400030101 2608000000003f800000"))
    assert "direction-angles = [0.0, 1.0]" in write_profile([TedsBlock(1, 3, good)])[0].splitlines()
