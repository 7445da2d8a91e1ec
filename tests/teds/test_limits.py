"""No file costs more than 10 s and 300 MB: hostile ones of every kind, each in a process with that much and no more.

Each line is a file that took minutes or gigabytes, or that raised something foreign.
"""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_toml, load_json, whole_number
from teds_provision.teds import AccessCode, compose
from teds_provision.teds.formats import read_blocks
from teds_provision.teds.image import Image
from teds_provision.teds.units import parse_unit
from tests.cli.shell import Outcome, spawn
from tests.teds.limited import LIMITED

pytestmark = pytest.mark.slow
MIB = 1 << 20
NAMESPACE = "urn:teds-provision:teds:1"


def hex_record(address: int, data: bytes) -> str:
    octets = bytes([len(data)]) + (address & 0xFFFF).to_bytes(2, "big") + b"\0" + data
    return f":{octets.hex().upper()}{-sum(octets) & 0xFF:02X}\n"


def scattered() -> str:
    return "".join(hex_record(2 * n, b"\0") for n in range(30_000)) + ":00000001FF\n"


def image(blocks: str) -> str:
    return f'{{"format": "teds-image/1", "uuid": "{"00" * 10}", "blocks": {blocks}}}'


def of_units(exponent: str) -> str:
    units = {"interpretation": "0", "meters": exponent}
    field = {"type": 12, "name": "PhyUnits", "kind": "units", "value": units}
    return json.dumps({"format": "teds/1", "teds": [{"channel": 1, "access_code": 3, "fields": [field]}]})


def many_inputs() -> str:
    """Return a calibration whose grid of inputs would have 9^40 places."""
    part = (("ChanNum", 1), ("Degree", 1), ("Boundaries", (0.0, 1.0)), ("Offsets", (0.0,)))
    octets = compose(AccessCode.CALIBRATION, [("CalInput", part)] * 40 + [("Coefs", (1.0, 1.0))])
    return image(json.dumps([{"access_code": 5, "channel": 1, "teds": octets.hex()}]))


def steep() -> str:
    """Return two inputs of degree 89: 8,100 terms for each of 250,000 places."""
    inputs = [(("ChanNum", n), ("Degree", 89), ("Boundaries", (0.0, 65535.0)), ("Offsets", (0.0,))) for n in (1, 2)]
    octets = compose(5, [*(("CalInput", part) for part in inputs), ("Coefs", tuple([1e-9] * 8100))])
    return image(json.dumps([{"access_code": 5, "channel": 1, "teds": octets.hex()}]))


XML = '<teds-set xmlns="' + NAMESPACE + '">{}</teds-set>'
FIELD = '<teds channel="1" access-code="3"><field type="10">{}</field></teds>'
HOSTILE = {
    "lists.json": lambda: "[" + "[]," * 10_000_000 + "[]]",
    "deep.json": lambda: '{"a":' * 200_000,
    "deep-image.json": lambda: image("[" * 900 + "]" * 900),
    "many.json": lambda: image("[" + '{"access_code":1,"channel":0,"teds":""},' * 700_000 + "1]"),
    "digits.json": lambda: image("[" + "9" * 5000 + "]"),
    "twice.json": lambda: image("[]").replace('"uuid"', '"uuid": "", "uuid"'),
    "exponent.json": lambda: of_units("1e999999999"),
    "fields.json": lambda: json.dumps({"format": "teds/1", "teds": [{"access_code": 3, "fields": [{}] * 400_000}]}),
    "inputs.json": many_inputs,
    "attributes.xml": lambda: "<teds-set " + " ".join(f'a{n}=""' for n in range(1_500_000)) + "/>",
    "elements.xml": lambda: XML.format("<teds/>" * 4_000_000),
    "deep.xml": lambda: "<a>" * 1_000_000,
    "digits.xml": lambda: XML.format(FIELD.format(f"<integer>{'9' * 5000}</integer>")),
    "numbers.xml": lambda: XML.format(FIELD.format(f"<integers>{'1 ' * 12_000_000}</integers>")),
    "exponent.xml": lambda: XML.format(FIELD.format('<units meters="1e999999999"/>')),
    "laughs.xml": lambda: '<!DOCTYPE a [<!ENTITY b "bb"><!ENTITY c "&b;&b;">]><a>&c;</a>',
    "scattered.hex": scattered,
    "places.hex": lambda: "# channel 1 access code 3\n" * 900_000,
    "digits.hex": lambda: "0" * (33 * MIB),
    "runs.bin": lambda: compose(12, (("Format", 0), ("TCName", ""))) * 100_000,
    "dotted.toml": lambda: ".".join(["a"] * 200_000) + " = 1",
    "keys.toml": lambda: "\n".join(f"a{n} = 1" for n in range(60_000)),
    "inline.toml": lambda: "a = " + "{a = " * 900 + "1" + "}" * 900,
    "arrays.toml": lambda: "a = " + "[" * 900 + "]" * 900,
    "digits.toml": lambda: "a = " + "9" * 5000,
    "hex-digits.toml": lambda: "a = 0x" + "9" * 5000,
    "unit.toml": lambda: '[channel.1]\nunit = "9**9**9 m"\n',
    "quotes.toml": lambda: 'a = "' + "\\" * 500_001,
    "headers.toml": lambda: "\n".join(f"[channel.1-255.a{n}]" for n in range(50_000)),
}


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    """Return every hostile file through ``show``, each in its own process with 10 s of processor and bounded memory."""
    folder = tmp_path_factory.mktemp("hostile")
    out = {}
    for name, make in HOSTILE.items():
        content = make()
        path = folder / name
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        out[name] = show(path)
        path.unlink()
    return out


def show(path: Path) -> Outcome:
    return spawn("show", path, program=LIMITED)


def test_no_hostile_file_costs_more_than_its_limits(shown: dict[str, Outcome]) -> None:
    wrong = [
        (name, done.code, done.err[-300:])
        for name, done in shown.items()
        if done.code != (0 if name == "inputs.json" else 8) or "Traceback" in done.err
    ]
    assert not wrong


@pytest.mark.parametrize(
    ("words", "ends"), [("while True: pass", -signal.SIGXCPU), ("bytes(2 << 30)", 1)], ids=["time", "memory"]
)
def test_the_limits_hold(tmp_path: Path, words: str, ends: int) -> None:
    """What costs more does end, and not well."""
    (tmp_path / "costs.py").write_text(words)
    assert spawn(tmp_path / "costs.py", "1", program=LIMITED).code == ends


def test_what_is_refused_says_in_which_file_and_what_is_too_much(shown: dict[str, Outcome]) -> None:
    words = {
        "lists.json": "values",
        "deep-image.json": "levels",
        "digits.json": "integer of 5000 digits",
        "twice.json": '"uuid" twice',
        "attributes.xml": "attributes",
        "laughs.xml": "DTD",
        "scattered.hex": "stretches",
        "runs.bin": "TEDS",
        "dotted.toml": "dotted.toml:1: a key of more than",
        "inline.toml": "recursion",
        "digits.toml": "digits.toml:1: an integer of more than",
        "unit.toml": "is not a unit",
    }
    wrong = [(name, shown[name].err) for name, word in words.items() if word not in shown[name].err]
    wrong += [(name, done.err) for name, done in shown.items() if done.code == 8 and name not in done.err]
    assert not wrong


def test_a_calibration_of_many_terms_is_looked_at_in_bounded_time(tmp_path: Path) -> None:
    path = tmp_path / "steep.json"
    path.write_text(steep())
    done = show(path)
    assert done.code == 0, done.err


@pytest.mark.parametrize(
    "text", ["9**9**9 m", "m**9**9", "m" * 65, "((m**99)**99)**99", "1e9 m", "m ** 10000", "__import__"]
)
def test_a_unit_is_read_and_never_computed(text: str) -> None:
    with pytest.raises(BadDataError):
        parse_unit(text)


def test_an_image_refuses_a_name_that_is_there_twice() -> None:
    text = Image(bytes(10), {}).to_json()
    assert Image.from_json(text).uuid == bytes(10)
    with pytest.raises(BadDataError, match='"uuid" twice'):
        Image.from_json(text.replace('"blocks"', '"uuid": "00", "blocks"'))


def test_numbers_beyond_the_limit_are_refused_by_their_length() -> None:
    with pytest.raises(BadDataError, match="5000 characters"):
        whole_number("9" * 5000, "the value")
    assert whole_number(" -12 ", "the value") == -12
    with pytest.raises(BadDataError, match="1001 digits"):
        load_json("9" * (LIMITS.integer_digits + 1), "the file")


def test_usual_toml_is_not_taken_for_a_hostile_one() -> None:
    check_toml('a.b.c = "' + "x." * 400 + '"\n# ' + "9" * 400 + '\n"""\n' + "1.2.3." * 100 + '\n"""\n', "a.toml")


def test_what_was_read_before_is_still_read() -> None:
    octets = compose(12, (("Format", 0), ("TCName", "x")))
    assert len(read_blocks(octets * LIMITS.teds_of_a_file)) == LIMITS.teds_of_a_file
    with pytest.raises(BadDataError, match="at most 2000"):
        read_blocks(octets * (LIMITS.teds_of_a_file + 1))
