"""``show``: every given string with its verdict, every kind of file, every output, and what bad input gets."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision import teds
from teds_provision.cli.main import run
from teds_provision.limits import LIMITS
from teds_provision.protocol.handover.jose import encrypt
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.teds.codec.security import initial
from teds_provision.teds.formats import TedsBlock, read_blocks, write_blocks
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile

ROOT = Path(__file__).parent.parent.parent
VECTORS = ROOT / "tests" / "vectors" / "ieee1451"
INDEX = json.loads((VECTORS / "index.json").read_text())["vectors"]
UUID = bytes.fromhex("8D4D9DA65281F7000000")
POINT = b"\x04" + bytes(range(64))


@pytest.fixture
def show(capfdbinary, tmp_path):
    """Run ``show`` in this process: exit code, stdout, stderr."""

    def call(*arguments, before=()):
        code = run(["--home", str(tmp_path / "home"), *before, "show", *map(str, arguments)])
        out, err = capfdbinary.readouterr()
        return code, out.decode(errors="replace") if "binary" not in arguments else out, err.decode()

    return call


@pytest.fixture
def show_json(show):
    """Return the one JSON object, and the exit code."""

    def call(*arguments):
        code, out, _ = show(*arguments, before=("--json",))
        (line,) = out.splitlines()
        return code, json.loads(line)

    return call


def image_of(profile="magnetic-angular-position-sensor", *, extra=None, points=None):
    kind = load_profile(profile)
    calibration = None
    if points is not None:
        from teds_provision.teds.calibration.files import read_calibrations

        rows = "\n".join(f"{raw},{value}" for raw, value in points)
        calibration = read_calibrations(
            f"# date: 2020-01-02\n# interval: 1 year\nraw,value [degree]\n{rows}\n", "c", kind
        )
    blocks = kind.build(UUID, calibration=calibration).blocks
    return Image(UUID, {**blocks, **(extra or {})})


@pytest.fixture
def image(tmp_path):
    path = tmp_path / "image.json"
    path.write_text(image_of(points=[(0, 0), (32768, 180), (65535, 360)]).to_json())
    return path


# -- the given strings ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("entry", INDEX, ids=lambda entry: entry["name"])
def test_every_given_string_is_shown_with_its_verdict(show_json, entry):
    code, shown = show_json(VECTORS / entry["file"])
    assert shown["verdict"] == entry["verdict"]
    assert code == (8 if entry["verdict"] == "malformed" else 0)
    assert len(shown["teds"]) == 1
    assert {"edition", "access_code", "verdict", "findings", "fields"} <= shown["teds"][0].keys()
    for finding in shown["findings"]:
        assert {"severity", "offset", "code", "message"} <= finding.keys()
    if entry["verdict"] not in {"malformed"} and "no_tedsid" not in entry["name"]:
        assert str(shown["edition"]) == entry["era"]


@pytest.mark.parametrize("entry", INDEX[::5], ids=lambda entry: entry["name"])
def test_binary_and_hex_of_the_same_octets_show_the_same(show_json, tmp_path, entry):
    (block,) = read_blocks((VECTORS / entry["file"]).read_bytes())
    path = tmp_path / "octets"
    path.write_bytes(block.octets)
    code, shown = show_json(path)
    same_code, same = show_json(VECTORS / entry["file"])
    drop = {"file", "teds"}
    assert code == same_code
    assert {k: v for k, v in shown.items() if k not in drop} == {k: v for k, v in same.items() if k not in drop}


# -- for people ----------------------------------------------------------------------------------------------------


def test_a_person_sees_place_range_and_calibration(show, image):
    code, out, _ = show(image)
    assert code == 0
    assert "made at: 30.2719° N, 120.1272° E" in out
    assert "range: 0 ° to 360 °, uncertainty 1 °" in out
    assert "calibrated: 2020-01-02" in out
    assert "(overdue)" in out
    assert "unsigned integer" in out
    assert "\x1b[" not in out


def test_random_uuids_are_shown_and_never_refused(show, tmp_path):
    path = tmp_path / "meta"
    path.write_bytes(teds.compose(1, {"UUID": bytes([255]) * 10, "OholdOff": 1.0, "TestTime": 0.0, "MaxChan": 1}))
    code, out, _ = show(path)
    assert code == 0
    assert "probably random" in out


def test_a_security_teds_shows_fingerprints_and_weak_algorithms(show, show_json, tmp_path):
    import hashlib

    path = tmp_path / "security"
    path.write_bytes(initial(POINT, bytes(64), sequence=3, key_epoch=2))
    _, out, _ = show(path)
    assert hashlib.sha256(POINT).hexdigest()[:16] in out
    assert "none: initial or unsigned" in out
    weak = teds.compose(128, {"UsedSecScheme": 3, "UsedVerAlg": 1, "UsedEncAlg": 3, "UsedHashAlg": 0, "CA": "old"})
    path.write_bytes(weak)
    _, out, _ = show(path)
    assert "DES: weak" in out
    assert "MD5: weak" in out
    assert "another vendor's Security TEDS" in out
    _, shown = show_json(path)
    assert {field["name"] for field in shown["fields"] if field.get("weak")} == {
        "UsedVerAlg",
        "UsedEncAlg",
        "UsedHashAlg",
    }


def test_a_signed_block_says_whether_the_teds_beside_it_is_the_one(show, tmp_path):
    import hashlib

    meta = image_of().blocks[0, 1]
    entry = b"\x00\x00\x01" + hashlib.sha256(meta).digest()
    other = b"\x00\x01\x03" + bytes(32)
    security = teds.compose(128, [("ProfileVersion", 1), ("SignedBlock", entry), ("SignedBlock", other)])
    path = tmp_path / "image.json"
    path.write_text(image_of(extra={(0, 128): security}).to_json())
    _, out, _ = show(path)
    assert "channel 0 MetaTEDS " + hashlib.sha256(meta).hexdigest()[:16] + "… (same)" in out
    assert "channel 1 ChanTEDS 0000000000000000… (OTHER DIGEST)" in out


def test_the_guard_speaks_in_show_and_strict_makes_it_count(show, show_json, tmp_path):
    path = tmp_path / "image.json"
    path.write_text(image_of(points=[(0, 0), (32768, 900), (65535, 360)]).to_json())
    code, out, _ = show(path)
    assert code == 0
    assert "error  guard, channel 1, " in out
    _, shown = show_json(path)
    assert {finding["code"] for finding in shown["guard"] if finding["severity"] == "error"}
    assert show(path, "--strict")[0] == 6


def test_strict_makes_error_findings_count(show):
    path = VECTORS / "f07_swami_meta_gen.hex"
    assert show(path)[0] == 0
    assert show(path, "--strict")[0] == 8
    assert show(VECTORS / "x07_name.hex", "--strict")[0] == 0


def test_a_message_is_shown_with_the_teds_inside(show):
    _, out, _ = show(VECTORS / "m24_readteds_reply_meta.hex")
    assert "TEDS access: Read TEDS, reply" in out
    assert "TEDS at octet 61:" in out
    assert "MetaTEDS (1)" in out


def test_a_bundle_shows_its_header_alone(show, show_json, tmp_path):
    sealed = encrypt(b"x", [SoftwareKey.generate().point], cty="JWS")
    path = tmp_path / "bundle.json"
    path.write_bytes(sealed)
    code, out, _ = show(path)
    assert (code, "sealed handover bundle" in out) == (0, True)
    code, shown = show_json(path)
    assert (code, shown["teds"], len(shown["bundles"])) == (0, [], 1)


def test_a_bundle_longer_than_any_file_of_teds_shows_its_header(show, tmp_path):
    """It was called no file of TEDS."""
    sealed = encrypt(b"\0" * (26 << 20), [SoftwareKey.generate().point], cty="JWS")
    assert len(sealed) > LIMITS.teds_file
    path = tmp_path / "bundle.json"
    path.write_bytes(sealed)
    code, out, _ = show(path)
    assert (code, "sealed handover bundle" in out) == (0, True)


@pytest.mark.parametrize(
    ("octets", "what", "command"),
    [
        (b'{"format":"teds-backup/2","store":"x"}\n', "a backup", "restore"),
        (b"\x89MCAP0\r\n" + bytes(100), "a recording", "mcap info"),
        (b"# teds-provision measurement, text 1; times are unix seconds\ntime,uuid\n", "a recording (text)", "less"),
        (b"\n\r\r\n" + bytes(100), "a trace", "trace show"),
        (b'{"format": "teds-trace/1"}\n', "a trace", "trace show"),
        (b'{"format":"teds-backup/2"}' + bytes(33 << 20), "a backup", "restore"),
        (bytes(33 << 20), "it has more than 32 MiB", ""),
    ],
    ids=["backup", "mcap", "text", "pcapng", "trace", "long backup", "long"],
)
def test_another_file_of_this_program_is_called_what_it_is(show, tmp_path, octets, what, command):
    path = tmp_path / "file"
    path.write_bytes(octets)
    code, _, err = show(path)
    assert code == 8
    assert "file holds no TEDS: " in err
    assert what in err
    assert command in err


def test_several_files_are_distinguished(show, show_json):
    files = [VECTORS / "x07_name.hex", VECTORS / "x07_meta.hex"]
    _, out, _ = show(*files)
    assert all(file.name in out for file in files)
    _, shown = show_json(*files)
    assert [Path(entry["file"]).name for entry in shown["teds"]] == [file.name for file in files]
    assert "verdict" not in shown


def test_a_diff_speaks_in_physical_terms(show, show_json, tmp_path, image):
    other = tmp_path / "other.json"
    other.write_text(image_of(points=[(0, 0), (32768, 181), (65535, 360)]).to_json())
    code, out, _ = show("--diff", image, other)
    assert code == 0
    assert "°" in out
    assert "channel 1" in out
    code, shown = show_json("--diff", image, other)
    assert (code, {change["channel"] for change in shown["changes"]}) == (0, {1})
    assert show("--diff", image, image)[1] == "no difference\n"
    assert json.loads(show("--diff", image, other, "--format", "json")[1]) == shown


def test_a_calibration_is_drawn(show, tmp_path, image):
    pytest.importorskip("matplotlib")
    picture = tmp_path / "curve.svg"
    code, _, err = show(image, "--plot", picture)
    assert (code, "channel 1" in err) == (0, True)
    assert "<svg" in picture.read_text()
    assert show(VECTORS / "x07_name.hex", "--plot", picture)[0] == 8
    assert show(image, "--plot", tmp_path / "curve.gif")[0] == 2
    assert show(image, image, "--plot", picture)[0] == 2
    for channel in ("1", "angle"):
        assert show(image, "--plot", picture, "--channel", channel)[0] == 0
    assert show(image, "--plot", picture, "--channel", "torque")[0] == 8
    assert show(image, "--channel", "1")[0] == 2


# -- formats -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("format", ["hex", "xml", "json", "image", "ihex"])
def test_an_image_in_other_formats_is_the_same_image(show, image, tmp_path, format):
    code, out, _ = show(image, "--format", format)
    assert code == 0
    blocks = read_blocks(image.read_bytes())
    again = read_blocks(out.encode())
    assert [block.octets for block in again] == [block.octets for block in blocks]
    if format != "ihex":
        assert again == blocks


@pytest.mark.parametrize("format", ["hex", "xml", "json", "ihex"])
def test_a_message_in_other_formats_is_the_same_message(show, show_json, tmp_path, format):
    _, out, _ = show(VECTORS / "m24_readteds_reply_meta.hex", "--format", format)
    path = tmp_path / "message"
    path.write_text(out)
    _, shown = show_json(path)
    _, original = show_json(VECTORS / "m24_readteds_reply_meta.hex")
    assert (shown["verdict"], shown["fields"]) == ("message", original["fields"])


def test_xml_of_show_is_valid_by_the_shipped_schema(show, image):
    xmlschema = pytest.importorskip("xmlschema")
    from teds_provision.teds.formats.xmlform import SCHEMA

    _, out, _ = show(image, "--format", "xml")
    xmlschema.XMLSchema(str(SCHEMA)).validate(out)


def test_binary_output_is_the_octets_and_says_what_is_lost(show, image):
    code, out, err = show(image, "--format", "binary")
    assert code == 0
    assert out == b"".join(block.octets for block in read_blocks(image.read_bytes()))
    assert "binary cannot hold the channels" in err


def test_a_profile_out_of_an_image_and_back(show, image, tmp_path):
    code, out, err = show(image, "--format", "toml")
    assert code == 0
    assert "calibrations come from a file of their own" in err
    path = tmp_path / "made.toml"
    path.write_text(out)
    code, shown, err = show(path, "--format", "hex")
    assert (code, "UUID is all zeros" in err) == (0, True)
    made = {(b.channel, b.access_code): b.octets for b in read_blocks(shown.encode())}
    assert made[1, 12] == image_of().blocks[1, 12]


def test_the_other_edition_says_what_it_cannot_hold(show, show_json, image):
    code, out, err = show(image, "--edition", "2024", "--format", "hex")
    assert code == 0
    assert "cannot be said in 16" in err
    editions = {teds.decode(block.octets).edition for block in read_blocks(out.encode())}
    assert editions == {2024}
    _, shown = show_json(image, "--edition", "2024")
    findings = [finding for entry in shown["teds"] for finding in entry["conversion"]]
    assert "lost" in {finding["code"] for finding in findings}


def test_standard_input_is_a_file_too():
    octets = (VECTORS / "x07_name.hex").read_bytes()
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision", "--json", "show", "-"], input=octets, capture_output=True, check=True
    )
    assert json.loads(done.stdout)["verdict"] == "clean"


def test_octets_are_not_written_to_a_terminal(show, monkeypatch):
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    code, _, err = show(VECTORS / "x07_name.hex", "--format", "binary")
    assert (code, "terminal" in err) == (2, True)


# -- bad input -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "code", "message"),
    [
        (b"", 8, "empty"),
        (b"00 0x 1", 8, "hex"),
        (b'{"format": "teds-image/1"}', 8, "uuid"),
        (b'<!DOCTYPE a [<!ENTITY b "c">]><a>&b;</a>', 8, "refused"),
        (b"<whitelist/>", 8, "no set of TEDS"),
        (b"a = [", 8, "TOML"),
        (b'{"ciphertext": 1}', 8, ""),
        (b":0000000", 8, "Line 1"),
    ],
)
def test_bad_files_get_one_clear_error(show, tmp_path, content, code, message):
    path = tmp_path / "bad"
    path.write_bytes(content)
    got, out, err = show(path)
    assert (got, out) == (code, "")
    assert message.lower() in err.lower()
    assert len(err.splitlines()) <= 3
    assert "Traceback" not in err


def test_missing_files_and_folders_exit_3(show, tmp_path):
    assert show(tmp_path / "nothing")[0] == 3
    assert show(tmp_path)[0] == 3
    assert show("a\0b")[0] == 3


def test_usage(show, image):
    assert show()[0] == 2
    assert show(image, "--diff", image, image)[0] == 2
    assert show(image, "--format", "xml", before=("--json",))[0] == 2


def test_an_error_is_json_if_json_is_requested(show, tmp_path):
    code, out, _ = show(tmp_path / "nothing", before=("--json",))
    assert (code, json.loads(out)["error"]["code"]) == (3, "not-found")


def test_junk_is_decoded_or_refused_and_never_a_bug(show_json, tmp_path):
    import random

    chance = random.Random(1451)
    path = tmp_path / "junk"
    for size in (1, 2, 3, 5, 6, 11, 12, 40, 300, 5000):
        path.write_bytes(chance.randbytes(size))
        code, shown = show_json(path)
        assert code in {0, 8}
        assert "error" not in shown or shown["error"]["code"] == "bad-data"


def test_markup_in_a_name_is_text(show, tmp_path):
    path = tmp_path / "name"
    path.write_bytes(teds.compose(12, {"Format": 0, "TCName": "[red]not red[/] [link=x]y"}))
    _, out, _ = show(path)
    assert "[red]not red[/] [link=x]y" in out


def test_control_characters_in_a_name_do_not_reach_the_terminal(show, tmp_path):
    path = tmp_path / "name"
    path.write_bytes(teds.compose(12, {"Format": 0, "TCName": "a\x1b]0;title\x07b\x9bc"}))
    _, out, _ = show(path)
    assert "\x1b" not in out
    assert "\x9b" not in out


def test_written_hex_of_one_teds_needs_no_place():
    assert write_blocks([TedsBlock(None, 12, teds.compose(12, {"Format": 0, "TCName": "a"}))], "hex").count("#") == 0


# -- whole outputs -------------------------------------------------------------------------------------------------

NAME_TEDS = bytes.fromhex("0000001f0304000c01010401000512") + b"temperature sensor"
FIELDS = (
    "offset  type  field   value               meaning",
    "     4     3  TEDSID  00 0c 01 01",
    "    10     4  Format  0                   user defined",
    "    13     5  TCName  temperature sensor",
)


def checked(octets):
    """Return a TEDS with its checksum: all octets but its own, complemented (IEEE 1451.0-2007, 5.5.4)."""
    return octets + (0xFFFF - sum(octets)).to_bytes(2, "big")


@pytest.fixture
def name_file(tmp_path):
    path = tmp_path / "name.hex"
    path.write_text(checked(NAME_TEDS).hex())
    return path


def lines_of(text):
    return [line.rstrip() for line in text.splitlines()]


def test_a_teds_as_a_table(show, name_file, tmp_path):
    code, out, err = show(name_file)
    assert (code, err) == (0, "")
    assert lines_of(out) == ["XdcrName (12) · 2007 edition · 35 octets · clean", *FIELDS]
    bare = tmp_path / "bare.hex"
    bare.write_text(NAME_TEDS[4:].hex())
    assert lines_of(show(bare)[1]) == [
        "XdcrName (12) · 2007 edition · 29 octets · bare data block · block-clean",
        "offset  type  field   value               meaning",
        "     0     3  TEDSID  00 0c 01 01",
        "     6     4  Format  0                   user defined",
        "     9     5  TCName  temperature sensor",
    ]
    wrong = tmp_path / "wrong.hex"
    wrong.write_text((NAME_TEDS + b"\0\0").hex())
    right = f"{0xFFFF - sum(NAME_TEDS):04X}"
    code, out, _ = show(name_file, wrong)
    assert code == 0
    first, *rest = lines_of(out)
    assert first.startswith(f"{name_file} ──")
    assert rest[:5] == ["XdcrName (12) · 2007 edition · 35 octets · clean", *FIELDS]
    assert rest[5].startswith(f"{wrong} ──")
    assert rest[6:] == [
        "XdcrName (12) · 2007 edition · 35 octets · frame-bad",
        *FIELDS,
        f"error  octet 33, frame-checksum: The checksum is 0000, the octets give {right}.",
    ]
    assert show(wrong, "--strict")[0] == 8
    assert lines_of(show(name_file, "--edition", "2024")[1])[0] == "XdcrName (12) · 2024 edition · 36 octets · clean"


def test_a_teds_as_json(show, show_json, name_file):
    one = {
        "file": str(name_file), "edition": 2024, "channel": None, "access_code": 12, "family": 0, "subfamily": 255,
        "version": 2, "width": 1, "framed": True, "name": "XdcrName",
        "fields": [
            {"type": 4, "name": "Format", "kind": "integer", "value": 0, "offset": 11, "text": "0",
             "meaning": "user defined"},
            {"type": 5, "name": "TCName", "kind": "text", "value": "temperature sensor", "offset": 14,
             "text": "temperature sensor"},
        ],
        "verdict": "clean", "findings": [], "conversion": [],
    }  # fmt: skip
    code, found = show_json(name_file, "--edition", "2024")
    assert (code, found) == (0, {**one, "format": "teds/1", "teds": [one]})
    code, pretty, _ = show(name_file, "--format", "json", "--edition", "2024")
    assert (code, json.loads(pretty)) == (0, found)
    assert pretty.startswith('{\n "file": ')
    code, several = show_json(name_file, name_file)
    assert (code, set(several), len(several["teds"])) == (0, {"format", "teds"}, 2)


def test_two_teds_of_one_file_stand_apart(show, tmp_path):
    path = tmp_path / "node.json"
    path.write_text(image_of("temperature-sensor").to_json())
    out = lines_of(show(path)[1])
    heads = [at for at, line in enumerate(out) if " edition · " in line]
    assert [out[at - 1] for at in heads[1:]] == [""] * (len(heads) - 1)
    assert out[heads[1]].startswith("channel 0 · XdcrName (12) · 2007 edition")


def test_equal_files_show_no_difference(show, name_file):
    assert show("--diff", name_file, name_file)[:2] == (0, "no difference\n")
    code, found, _ = show("--diff", name_file, name_file, "--format", "json")
    assert (code, json.loads(found)) == (0, {"changes": [], "guard": []})


def test_an_unknown_file_names_the_commands_of_a_node(show, tmp_path):
    code, _, err = show(tmp_path / "8d4d")
    assert code == 3
    assert "show decodes files. Of a node: nodes UUID, or read UUID --output FILE." in err


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "No file given."),
        (["a", "--channel", "1"], "--channel works with --plot."),
        (["--diff", "a", "b", "c"], "--diff compares two files and cannot be combined with anything else."),
        (["--diff", "a", "b", "--format", "xml"], "--diff compares two files and cannot be combined"),
        (["--diff", "a", "b", "--plot", "p.svg"], "--diff compares two files and cannot be combined"),
    ],
)
def test_what_show_cannot_mean(show, words, why):
    code, _, err = show(*words)
    assert code == 2
    assert why in err
    assert show("a", "--format", "xml", before=("--json",))[0] == 2


def test_a_plot_is_of_one_file(show, name_file, tmp_path):
    code, _, err = show(name_file, name_file, "--plot", tmp_path / "p.svg")
    assert (code, "--plot works with one file." in err) == (2, True)


@pytest.mark.parametrize(
    ("file", "lines"),
    [
        (
            "m07_read_teds_reply.hex",
            [
                "Reply to Read TEDS segment · reply, 2007 edition",
                "offset  argument  value                                                          meaning",
                "3       offset    0",
                "7       octets    000000190304000c0101040100050c626f696c65722d696e… (29 octets)",
                "note  octet 3, reply-guessed: A reply does not say what it answers; it is read as what its form fits.",
                "",
                "TEDS at octet 7:",
                "XdcrName (12) · 2007 edition · 29 octets · clean",
                "offset  type  field   value         meaning",
                "     4     3  TEDSID  00 0c 01 01",
                "    10     4  Format  0             user defined",
                "    13     5  TCName  boiler-inlet",
            ],
        ),
        ("m07_fail_reply.hex", ["Failure · reply, 2007 edition · failed"]),
        (
            "m24_sample_cmd.hex",
            [
                "transducer access: Synchronous read of sample, one channel of one TIM, command · network-service, "
                "2024 edition · channel 1",
                "offset  argument       value                             meaning",
                "5       app            00303900303900303907e80549365990",
                "21      ncap           00303900303900303907e80549382e50",
                "37      tim            86258a0b72f612d68707e8054911dcf0",
                "53      channel        1",
                "55      sampling_mode  3",
                "56      timeout        5.0 s",
            ],
        ),
    ],
)
def test_a_message_as_a_table(show, file, lines):
    code, out, _ = show(VECTORS / file)
    assert (code, lines_of(out)) == (0, lines)


def test_a_message_as_json(show_json):
    _, found = show_json(VECTORS / "m24_sample_cmd.hex")
    assert found["message"] == {
        "kind": "network-service",
        "name": "Synchronous read of sample, one channel of one TIM, command",
        "group": found["message"]["group"], "group_name": "transducer access",
        "function": found["message"]["function"], "channel": 1, "ok": None, "school": found["message"]["school"],
    }  # fmt: skip
    assert found["fields"][-1] == {"name": "timeout", "type": "duration", "value": 5.0, "offset": 56}
    assert (found["verdict"], found["access_code"], found["findings"]) == ("message", None, [])
    assert "inside" not in found
    _, reply = show_json(VECTORS / "m07_read_teds_reply.hex")
    assert [inside["name"] for inside in reply["inside"]] == ["XdcrName"]
    assert reply["findings"][0]["code"] == "reply-guessed"


def test_a_field_in_a_field_is_indented(show, image):
    out = lines_of(show(image)[1])
    at = next(at for at, line in enumerate(out) if line.split()[2:3] == ["Sample"])
    assert out[at + 1].index("DatModel") == out[at].index("Sample") + 2
