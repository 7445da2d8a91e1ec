"""``label``: what stands on it is what ``whitelist add`` takes, whatever the scanner's keyboard made of it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.station.label import Label, read_label

from .shell import call

UUID, KEY = "8d4d9da65281f7000000", "0123456789abcdef" * 4
FRENCH = str.maketrans("0123456789AQMW:;", "à&é\"'(-è_çQA?Z.m")


def test_a_label_is_read_back_by_a_camera_and_pins_the_key(home: Path, tmp_path: Path) -> None:
    zxingcpp = pytest.importorskip("zxingcpp")
    image = pytest.importorskip("PIL.Image")
    call(home, "whitelist", "add", UUID, "--fingerprint", KEY, "--name", "finger <1>")
    picture, drawing = tmp_path / "finger.png", tmp_path / "finger.svg"
    made = call(home, "--json", "label", "finger <1>", "--output", picture)
    text = f"TEDS1:{UUID}:{KEY}".upper()
    assert made.json == {"label": {"text": text, "uuid": UUID, "fingerprint": KEY, "file": str(picture)}}
    (found,) = zxingcpp.read_barcodes(image.open(picture).convert("L"))
    assert found.text == made.json["label"]["text"]
    call(home, "label", UUID, "--output", drawing)
    assert "finger &lt;1&gt;" in drawing.read_text()
    call(home, "whitelist", "remove", UUID, "--yes")
    added = call(home, "--json", "whitelist", "add", found.text)
    assert [entry["fingerprint"] for entry in added.json["whitelist"]] == [KEY]
    assert call(home, "whitelist", "add", found.text, "--fingerprint", "ab" * 32).code == 2


def test_no_label_without_a_pinned_key_and_none_of_another_kind(home: Path, tmp_path: Path) -> None:
    call(home, "whitelist", "add", UUID)
    assert call(home, "label", UUID, "--output", tmp_path / "x.svg").code == 3
    call(home, "whitelist", "add", UUID, "--fingerprint", KEY)
    assert call(home, "label", UUID, "--output", tmp_path / "x.pdf").code == 2
    assert list(tmp_path.glob("x.*")) == []


@given(st.binary(min_size=10, max_size=10), st.binary(min_size=32, max_size=32), st.sampled_from(":/;Ö>-. "))
def test_any_separator_and_a_french_keyboard_are_read(uuid: bytes, key: bytes, separator: str) -> None:
    text = Label(uuid, key.hex()).text
    assert read_label(re.sub(":", lambda _: separator, text)) == (uuid, key.hex())
    assert read_label(text.lower()) == (uuid, key.hex())
    assert read_label(text.translate(FRENCH)) == (uuid, key.hex())


@pytest.mark.parametrize(
    ("keys", "typed"),
    [
        ("ABCDEFTS:", "ФИСВУАЕЫЖ"),
        ("abcdefts:", "фисвуаеыЖ"),
        ("ABCDEFTS:", "ФИСВУАЕІЖ"),
        ("ABCDEFTS:", "AXJE>UYOS"),
        ("abcdefts:", "axje.uyoS"),
        ("ABCDEFTS:", "ΑΒΨΔΕΦΤΣ¨"),
        ("abcdefts:", "αβψδεφτσ¨"),
        ("ABCDEFTS:", "UÇVEĞAOİŞ"),
        ("abcdefts:", "uçveğaoiŞ"),
        ("ABCDEFTS:", "ABCDEFTSÖ"),
        ("ABCDEFTS:", "ABCDEFTSŞ"),
    ],
    ids=["ru", "ru small", "uk", "dvorak", "dvorak small", "el", "el small", "tr-f", "tr-f small", "de", "tr-q"],
)
def test_layouts_that_have_other_letters_are_read(keys: str, typed: str) -> None:
    text = Label(bytes.fromhex(UUID), KEY).text
    text = text if keys.isupper() else text.lower()
    assert read_label(text.translate(str.maketrans(keys, typed))) == (bytes.fromhex(UUID), KEY)


@given(st.text(max_size=100))
def test_other_words_are_no_label(text: str) -> None:
    if not text.strip().upper().startswith("TEDS"):
        assert read_label(text) is None
