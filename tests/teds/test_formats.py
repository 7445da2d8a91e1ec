"""Files of TEDS: told apart, read, written, from each to each without loss where the target can hold it."""

import json
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError, NotFoundError
from teds_provision.teds.codec.frame import frame, raw_tuple, tuples, unframe
from teds_provision.teds.formats import (
    FORMATS,
    TedsBlock,
    class_of,
    detect,
    lost,
    placed,
    read_blocks,
    under,
    write_blocks,
)
from teds_provision.teds.formats.intelhex import stretches, write_intel_hex
from teds_provision.teds.formats.tree import from_tree, shortest, to_tree
from teds_provision.teds.image import split_run

ROOT = Path(__file__).parent.parent.parent
VECTORS = sorted((ROOT / "tests" / "vectors" / "ieee1451").glob("*.hex"))
PROFILES = [path for path in sorted((ROOT / "profiles").glob("*.toml")) if path.stem != "smart-sensor"]
LOSSLESS = ("hex", "json", "xml")
BLANK = (0, 1, 2)

NAME = teds.compose(12, {"Format": 0, "TCName": "boiler inlet"})
META = teds.compose(1, {"UUID": bytes(range(10)), "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 1})


def as_octets(written):
    return written if isinstance(written, bytes) else written.encode()


def octets_of(path):
    (block,) = read_blocks(path.read_bytes(), "hex")
    return block.octets


# -- the given strings, whatever is wrong with them -----------------------------------------------------------------


@pytest.mark.parametrize("path", VECTORS, ids=lambda path: path.stem)
@pytest.mark.parametrize("format", [*LOSSLESS, "ihex", "binary"])
def test_every_given_string_survives_every_format_octet_for_octet(path, format):
    blocks = read_blocks(path.read_bytes())
    written = as_octets(write_blocks(blocks, format))
    assert detect(written) == format
    assert read_blocks(written) == blocks


@pytest.mark.parametrize(
    "path", [path for path in VECTORS if path.stem.startswith(("x07", "w24", "p07"))], ids=lambda p: p.stem
)
def test_what_is_written_by_the_rules_needs_no_octets_in_a_tree(path):
    tree = to_tree(read_blocks(path.read_bytes())[0])
    spelled_otherwise = path.stem in {"x07_chan_temp_packed", "w24_ubi_chan", "x07_phy"}
    assert (tree.octets is None) != spelled_otherwise or path.stem == "x07_phy"


# -- profiles -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("path", PROFILES, ids=lambda path: path.stem)
@pytest.mark.parametrize("format", [*LOSSLESS, "image", "toml"])
def test_every_shipped_profile_survives_every_format_that_holds_places(path, format):
    blocks = read_blocks(path.read_bytes(), path=path)
    assert lost(blocks, format) == ()
    written = as_octets(write_blocks(blocks, format))
    assert detect(written) == format
    assert read_blocks(written) == blocks


def test_a_profile_names_what_it_cannot_hold():
    channel = read_blocks(
        next(p for p in PROFILES if p.stem == "load-cell").read_bytes(), path=PROFILES[0].parent / "load-cell.toml"
    )
    calibration = teds.compose(5, {"LowLimit": 0.0, "HiLimit": 1.0, "OError": 0.1})
    blocks = [*channel, TedsBlock(1, 5, calibration), TedsBlock(0, 16, octets_of(_vector("x24_security")))]
    losses = " ".join(lost(blocks, "toml"))
    assert "CalTEDS of channel 1 (calibrations come from a file of their own)" in losses
    assert "SecurityTEDS2024 of channel 0" in losses
    text = write_blocks(blocks, "toml")
    assert "# Not held here: CalTEDS of channel 1" in text
    assert read_blocks(text.encode()) == channel


def test_a_field_without_a_key_is_named_by_a_profile():
    path = PROFILES[0].parent / "load-cell.toml"
    others = [block for block in read_blocks(path.read_bytes(), path=path) if block.access_code != 1]
    fields = [("UUID", bytes(10)), ("OholdOff", 1.0), ("TestTime", 0.0), ("MaxChan", 7), ("200", b"own")]
    losses = lost([TedsBlock(0, 1, teds.compose(1, fields)), *others], "toml")
    assert losses == ("MetaTEDS of channel 0: MaxChan, type 200.",)


def test_teds_that_no_profile_builds_are_named_with_the_reason():
    path = PROFILES[0].parent / "load-cell.toml"
    blocks = [block for block in read_blocks(path.read_bytes(), path=path) if block.access_code != 1]
    parts = tuples(unframe(teds.compose(1, {"UUID": bytes(10), "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 1})))
    short = frame(b"".join(raw_tuple(part.type, part.value[: 9 if part.type == 4 else None]) for part in parts))
    losses = lost([TedsBlock(0, 1, short), *blocks], "toml")
    assert losses[0] == "it does not load: A UUID of the 2007 edition has 10 octets, this one 9."


def test_teds_without_a_channel_make_no_profile_and_that_is_reported():
    assert "does not load" in lost([TedsBlock(0, 1, META)], "toml")[0]


def test_a_profile_that_extends_another_is_read_beside_it(tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "load-cell"\nname = "mine"\n')
    blocks = read_blocks((tmp_path / "mine.toml").read_bytes(), path=tmp_path / "mine.toml")
    assert {block.access_code for block in blocks} >= {1, 3, 12}
    (tmp_path / "lost.toml").write_text('extends = "nothing-of-the-kind"\n')
    with pytest.raises((BadDataError, NotFoundError), match="nothing-of-the-kind"):
        read_blocks((tmp_path / "lost.toml").read_bytes(), path=tmp_path / "lost.toml")


def _vector(name):
    return next(path for path in VECTORS if path.stem == name)


# -- telling apart ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        (NAME, "binary"),
        (NAME.hex().encode(), "hex"),
        (b"\xef\xbb\xbf# a comment\n0x00, 0x01 02\n", "hex"),
        (b":00000001FF\n", "ihex"),
        (b'{"format": "teds-image/1", "uuid": "", "blocks": []}', "image"),
        (b'{"format": "teds/1", "teds": []}', "json"),
        (b'{"protected": "e30", "recipients": [], "iv": "", "ciphertext": "", "tag": ""}', "bundle"),
        (b'  <?xml version="1.0"?><teds-set xmlns="urn:teds-provision:teds:1"/>', "xml"),
        (b'extends = "load-cell"\n', "toml"),
        (b" [channel.1]\n", "toml"),
        (b"[[text]]\n", "toml"),
        (b"[{}]", "json"),
        (b"00 00 zz", "hex"),
        (b"\xff\xfe\x00\x01", "binary"),
    ],
)
def test_files_are_distinguished_by_content(content, kind):
    assert detect(content) == kind


def test_an_empty_file_is_named():
    with pytest.raises(BadDataError, match="empty"):
        detect(b"")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"# fine\n00 0q", "Line 2 holds 'q'"),
        (b"00 0", "3 hex digits"),
        (b":0000000", "Line 1"),
        (b":0100000000FE", "checksum of line 1"),
        (b":00000001FF\n:00000001FF", "Line 2 comes after the end"),
        (b":0100000000FF", "no end record"),
        (b":0100000001FE\n:0100000002FD\n:00000001FF", "overlap at address 00000000"),
        (b'{"format": "teds/2"}', '"format"'),
        (b"{", "not JSON"),
        (b'{"format": "teds-image/1"}', "uuid"),
        (b"[meta", "TOML"),
        (b'{"ciphertext": ""}', "bundle"),
    ],
)
def test_a_damaged_file_is_refused_with_its_place(content, message):
    with pytest.raises(BadDataError, match=message):
        read_blocks(content)


def test_a_file_of_junk_is_not_read_for_ever():
    with pytest.raises(BadDataError, match="at most"):
        read_blocks(bytes(33 << 20))


# -- single formats ---------------------------------------------------------------------------------------------------


def test_a_run_of_framed_teds_is_cut_apart_and_a_broken_one_is_not():
    assert split_run(META + NAME) == [META, NAME]
    other = frame(bytes.fromhex("0406") + bytes(6))  # no TEDSID: octets of something else that closes by chance
    for run in (META + other, other + META, other):
        assert split_run(run) == [run]
    for cut in (NAME[:-1], NAME[:3], NAME[:4]):
        assert split_run(META + cut) == [META + cut]
    broken = META + NAME[:-1] + bytes([NAME[-1] ^ 1])
    assert split_run(broken) == [broken]
    assert [block.access_code for block in read_blocks(META + NAME)] == [1, 12]
    with pytest.raises(BadDataError, match="right Length and checksum"):
        write_blocks([TedsBlock(0, 1, META), TedsBlock(0, 12, broken)], "binary")
    assert lost([TedsBlock(1, 12, NAME)], "binary") == ("the channels of the TEDS.",)


def test_hex_keeps_places_in_comments_and_other_comments_mean_nothing():
    blocks = [TedsBlock(0, 1, META), TedsBlock(7, 12, NAME), TedsBlock(None, 12, NAME)]
    text = write_blocks(blocks, "hex")
    assert "# channel 7 access code 12 (XdcrName)" in text
    assert read_blocks(b"# made by somebody\n" + text.encode()) == blocks


def test_hex_states_the_place_of_a_teds_where_its_octets_would_be_taken_for_another() -> None:
    for block, place in (
        (TedsBlock(None, 12, NAME), ""),
        (TedsBlock(None, 1, NAME), "# channel - access code 1 (MetaTEDS)"),
        (TedsBlock(None, None, NAME), "# channel - access code -"),
        (TedsBlock(0, 12, NAME), "# channel 0 access code 12 (XdcrName)"),
        (TedsBlock(None, 12, NAME + META), "# channel - access code 12 (XdcrName)"),
    ):
        text = write_blocks([block], "hex")
        assert isinstance(text, str)
        assert "".join(line for line in text.splitlines() if line.startswith("#")) == place
        assert read_blocks(text.encode(), "hex") == [block]


def test_intel_hex_crosses_64_kib_and_is_what_other_tools_read():
    blocks = [
        TedsBlock(None, 1, META),
        TedsBlock(None, 128, frame(bytes.fromhex("030400800102") + b"\x80\xff\xff" + bytes(0xFFFF))),
    ]
    text = write_intel_hex(blocks, address=0xFFF0)
    assert read_blocks(text.encode()) == blocks
    intelhex = pytest.importorskip("intelhex")
    import io

    other = intelhex.IntelHex(io.StringIO(text))
    assert [(start, bytes(other.tobinarray(start, end - 1))) for start, end in other.segments()] == stretches(text)


def test_intel_hex_with_segment_base_and_start_records_of_other_tools():
    text = ":020000021000EC\n:0300000000000A F3\n".replace(" ", "") + ":0400000300003800C1\n:00000001FF\n"
    assert stretches(text) == [(0x10000, b"\x00\x00\x0a")]


def test_a_comment_of_hex_places_any_u16_channel_and_u8_access_code_and_no_others():
    for place in ((65535, 255), (0, 0)):
        text = f"# channel {place[0]} access code {place[1]}\n{NAME.hex()}\n"
        assert read_blocks(text.encode(), "hex") == [TedsBlock(*place, NAME)]
    for channel, code in ((65536, 1), (1, 256)):
        with pytest.raises(BadDataError, match=f"Line 2 names channel {channel} and access code {code}"):
            read_blocks(f"# ours\n# channel {channel} access code {code}\n00\n".encode(), "hex")


def test_a_record_of_intel_hex_without_octets_is_no_stretch():
    assert stretches(":00002000E0\n:0100000001FE\n:00000001FF\n") == [(0, b"\x01")]


def test_an_image_needs_a_uuid_and_places():
    image = json.loads(write_blocks([TedsBlock(0, 1, META), TedsBlock(1, 12, NAME)], "image"))
    assert (image["uuid"], len(image["blocks"])) == ("00010203040506070809", 2)
    with pytest.raises(BadDataError, match="UUID"):
        write_blocks([TedsBlock(0, 12, NAME)], "image")
    long = teds.compose(1, {"UUID": bytes(range(16)), "MaxChan": 1}, edition=2024)
    with pytest.raises(BadDataError, match=r"^An image needs a Meta-TEDS on channel 0 with a UUID of 10 octets\.$"):
        write_blocks([TedsBlock(0, 1, long)], "image")
    for place in ((None, 12), (1, None), (None, None)):
        with pytest.raises(BadDataError, match="channel and access code") as refused:
            write_blocks([TedsBlock(*place, NAME)], "image")
        assert refused.value.hint == "Use hex, json or xml."
    with pytest.raises(BadDataError, match="Two TEDS"):
        write_blocks([TedsBlock(0, 1, META), TedsBlock(0, 1, META)], "image")


def test_a_document_holds_one_teds_for_each_place():
    """TEDS of a channel without a number belong to channel 1, others to the node; a Security TEDS is not read."""
    name, calibration = teds.compose(12, {"Format": 0, "TCName": "a"}), teds.compose(5, {"Coefs": [1.0]})
    security = octets_of(_vector("x24_security"))

    def lines(*blocks):
        return "\n".join(block.hex() for block in blocks).encode()

    assert placed(lines(name, calibration)) == {(0, 12): name, (1, 5): calibration}
    for twice, words in (
        ((name, calibration, name), "12 for channel 0"),
        ((calibration, calibration), "5 for channel 1"),
    ):
        with pytest.raises(BadDataError, match=rf"^It holds two TEDS of access code {words}\.$"):
            placed(lines(*twice))
    with pytest.raises(BadDataError, match=r"^There are octets in it that are no TEDS\.$") as refused:
        placed(lines(bytes(13)))
    assert refused.value.hint == "See what it holds: teds-provision show FILE"
    assert placed(lines(name, security)) == {(0, 12): name, (0, 16): security}
    own = teds.compose(128, {"UsedSecScheme": 4})
    assert placed(lines(name, own)) == {(0, 12): name}
    with pytest.raises(BadDataError, match=r"^It holds no TEDS\.$"):
        placed(lines(own))


def test_teds_of_another_node_differ_in_the_uuid_of_the_2007_form_alone() -> None:
    blocks = {(0, 1): META, (0, 12): NAME}
    meta = teds.compose(1, {"UUID": b"\1" * 10, "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 1})
    assert under(blocks, b"\1" * 10) == {(0, 1): meta, (0, 12): NAME}
    assert under(blocks, bytes(range(10))) == blocks
    assert under({(0, 12): NAME}, b"\1" * 10) == {(0, 12): NAME}
    long = {(0, 1): teds.compose(1, {"UUID": bytes(range(16)), "MaxChan": 1}, edition=2024)}
    assert under(long, b"\1" * 10) == long


def test_json_can_be_written_by_hand_without_octets():
    document = {
        "format": "teds/1",
        "teds": [
            {
                "access_code": 12,
                "channel": 3,
                "fields": [{"name": "Format", "value": 0}, {"name": "TCName", "value": "a"}],
            }
        ],
    }
    (block,) = read_blocks(json.dumps(document).encode())
    assert (block.channel, teds.decode(block.octets).get("TCName")) == (3, "a")


@pytest.mark.parametrize(
    "entry",
    [
        1,
        {},
        {"access_code": 300},
        {"access_code": 12, "channel": -1},
        {"access_code": 12, "octets": "xy"},
        {"access_code": 12, "edition": 1999, "octets": ""},
        {"access_code": 12, "fields": {}},
        {"access_code": 12, "fields": [{"name": "TCName", "value": 1.5}]},
        {"access_code": 12, "fields": [{"name": "Colour", "value": "red"}]},
        {"access_code": 12, "fields": [{"name": "Format", "value": 300}]},
        {"access_code": 3, "fields": [{"name": "LowLimit", "kind": "number", "value": 1e39}]},
        {"access_code": 3, "fields": [{"name": "LowLimit", "kind": "number", "value": "x"}]},
        {"access_code": 3, "fields": [{"name": "PhyUnits", "kind": "units", "value": {"parsecs": 1}}]},
        {"access_code": 3, "fields": [{"name": "PhyUnits", "kind": "units", "value": {"meters": "1/3"}}]},
        {"access_code": 5, "fields": [{"name": "LstCalDt", "kind": "time", "value": {"seconds": -1}}]},
    ],
)
def test_json_that_makes_no_teds_is_refused(entry):
    with pytest.raises(BadDataError):
        read_blocks(json.dumps({"format": "teds/1", "teds": [entry]}).encode())


def test_json_that_nests_without_end_is_refused():
    deep = '{"name":"x","fields":[' * 50 + "]}" * 50
    with pytest.raises(BadDataError, match="deep"):
        read_blocks(f'{{"format":"teds/1","teds":[{{"access_code":1,"fields":[{deep}]}}]}}'.encode())
    with pytest.raises(BadDataError):
        read_blocks(b'{"format":' + b"[" * 200_000)


@given(st.floats(width=32, allow_nan=False, allow_infinity=False))
def test_the_shortest_number_is_the_same_float32(value):
    import struct

    assert struct.pack(">f", shortest(value)) == struct.pack(">f", value)
    assert float(f"{shortest(value):.9g}") == shortest(value) or abs(value) > 3.4e38  # the largest would round up


# -- from each to each ------------------------------------------------------------------------------------------------

TEXT = st.text(max_size=20)
REAL = st.floats(width=32)
SMALL = st.integers(0, 255)


@st.composite
def known_teds(draw):
    edition = draw(st.sampled_from([2007, 2024]))
    code = draw(st.sampled_from([1, 2, 3, 5, 12, 128, 200]))
    fields = {
        1: [
            ("UUID", draw(st.binary(min_size=(n := 10 if edition == 2007 else 16), max_size=n))),
            ("OholdOff", draw(REAL)),
            ("TestTime", draw(REAL)),
            ("MaxChan", draw(st.integers(0, 65535))),
            *[
                ("VGroup", {"GrpType": draw(SMALL), "MemList": draw(st.lists(st.integers(0, 65535), max_size=4))})
                for _ in BLANK
            ],
        ],
        2: [
            ("Text", {"LangCode": language, "Text": draw(TEXT)})
            for language in draw(st.sampled_from([("en",), ("en", "de")]))
        ],
        3: [
            ("CalKey", draw(SMALL)),
            ("PhyUnits", {"interpretation": draw(st.integers(0, 5)), "meters": draw(st.integers(-128, 127)) / 2}),
            ("LowLimit", draw(REAL)),
            ("DAngles", (draw(REAL), draw(REAL))),
            ("Sample", {"DatModel": draw(SMALL), "ModLenth": draw(SMALL), "SigBits": draw(SMALL)}),
            ("200", draw(st.binary(max_size=9))),
        ],
        5: [
            ("LstCalDt", teds.TimeInstance(draw(st.integers(0, 2**32 - 1)), draw(st.integers(0, 10**9 - 1)))),
            ("LinOnly", draw(st.lists(REAL, max_size=4))),
        ],
        12: [("Format", draw(SMALL)), ("TCName", draw(TEXT))],
        128: [("CA", draw(TEXT)), ("Sequence", draw(st.integers(0, 2**32 - 1)))],
        200: [("17", draw(st.binary(max_size=5)))],
    }[code]
    octets = teds.compose(code, fields, edition=edition, width=draw(st.sampled_from([None, 2])))
    return TedsBlock(draw(st.none() | st.integers(0, 65535)), code, octets)


def damaged(block, data):
    octets = bytearray(block.octets)
    for _ in range(data.draw(st.integers(0, 3))):
        octets[data.draw(st.integers(0, len(octets) - 1))] = data.draw(SMALL)
    return TedsBlock(
        block.channel, class_of(bytes(octets)) if block.channel is None else block.access_code, bytes(octets)
    )


@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(known_teds(), min_size=1, max_size=3), st.data())
def test_from_each_to_each_nothing_is_lost_that_the_target_can_hold(blocks, data):
    blocks = [damaged(block, data) for block in blocks]
    for first in LOSSLESS:
        there = read_blocks(as_octets(write_blocks(blocks, first)))
        assert there == blocks
        for second in LOSSLESS:
            assert read_blocks(as_octets(write_blocks(there, second))) == blocks
    flash = b"".join(octets for _, octets in stretches(write_blocks(blocks, "ihex")))
    assert flash == b"".join(block.octets for block in blocks)


@settings(suppress_health_check=[HealthCheck.too_slow])
@given(known_teds())
def test_a_composed_teds_needs_no_octets_in_its_tree(block):
    tree = to_tree(block)
    assert from_tree(tree) == block
    unusual = block.access_code in {2, 128, 5, 3, 1, 12}  # NaN payloads, texts that XML cannot hold, width 2 by choice
    assert tree.octets is None or unusual


@given(st.binary(max_size=200))
@example(b"<a>")
@example(b"\x00\x00\x00\x08\x03\x04\x00\x01\x01\x00\xff\xee")
def test_any_octets_are_read_or_refused_with_bad_data(octets):
    try:
        blocks = read_blocks(octets)
    except (BadDataError, NotFoundError):
        return
    for format in FORMATS:
        try:
            write_blocks(blocks, format)
        except BadDataError:
            continue


@given(st.sampled_from([*LOSSLESS, "ihex", "image", "toml"]), st.data())
@settings(suppress_health_check=[HealthCheck.too_slow])
def test_a_damaged_text_file_is_read_or_refused_with_bad_data(format, data):
    text = bytearray(as_octets(write_blocks([TedsBlock(0, 1, META), TedsBlock(1, 12, NAME)], format)))
    for _ in range(data.draw(st.integers(1, 4))):
        text[data.draw(st.integers(0, len(text) - 1))] = data.draw(SMALL)
    with suppress(BadDataError, NotFoundError):
        read_blocks(bytes(text), format)


# -- the page for people ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("language", ["", "json", "xml"])
def test_the_examples_of_the_page_are_the_same_teds(language):
    import re

    page = (ROOT / "docs" / "formats.md").read_text()
    (example,) = re.findall(rf"^```{language}\n((?:#|\{{|<\?xml).*?)^```", page, re.DOTALL | re.MULTILINE)
    fields = [("Format", 0), ("TCName", "boiler inlet"), ("200", b"\x01\x02")]
    assert read_blocks(example.encode()) == [TedsBlock(1, 12, teds.compose(12, fields))]


def test_the_page_names_every_format():
    page = (ROOT / "docs" / "formats.md").read_text()
    assert all(f"| `{format}` |" in page for format in FORMATS)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.lists(known_teds(), min_size=1, max_size=4), st.data())
def test_any_teds_give_a_profile_that_names_its_losses(blocks, data):
    blocks = [damaged(block, data) for block in blocks]
    text = write_blocks(blocks, "toml")
    losses = lost(blocks, "toml")
    assert text.count("# Not held here: ") == len(losses)


@settings(max_examples=60, suppress_health_check=[HealthCheck.too_slow])
@given(st.sampled_from(["load-cell", "accelerometer", "gripper"]), st.data())
def test_a_changed_datasheet_is_held_by_a_profile_or_its_loss_is_named(name, data):
    path = ROOT / "profiles" / f"{name}.toml"
    blocks = read_blocks(path.read_bytes(), path=path)
    number = data.draw(st.integers(0, len(blocks) - 1))
    block = bytearray(blocks[number].octets[4:-2])
    block[data.draw(st.integers(6, len(block) - 1))] = data.draw(SMALL)
    blocks[number] = blocks[number]._replace(octets=frame(bytes(block)))
    if not lost(blocks, "toml") and blocks[number].access_code != 1:  # the UUID of a Meta-TEDS is the node's
        assert read_blocks(write_blocks(blocks, "toml").encode()) == blocks


def test_a_place_that_is_stated_is_kept_also_if_its_channel_is_0() -> None:
    calibration = teds.compose(5, {"Coefs": [1.0]})
    text = f"# channel 0 access code 5\n{calibration.hex()}\n# channel 2 access code 5\n{calibration.hex()}\n"
    assert placed(text.encode()) == {(0, 5): calibration, (2, 5): calibration}


def test_comments_of_hex_may_hold_anything_and_make_none_alone() -> None:
    assert detect(b"00 01\n# a = 1\n") == "hex"
    assert detect(b"# a = 1\n00 01\n\n") == "hex"
    assert detect(b"# a = 1\n") == "toml"


def test_octets_of_json_count_before_fields_that_make_no_teds() -> None:
    for fields in ([1], [{"name": "Colour", "value": "red"}], []):
        entry = {"access_code": 12, "channel": 1, "fields": fields, "octets": NAME.hex(), "edition": None}
        assert read_blocks(json.dumps({"format": "teds/1", "teds": [entry]}).encode()) == [TedsBlock(1, 12, NAME)]
