"""The Certificate TEDS by itself: its octets, what fits into it, and which channel a file is for."""

from __future__ import annotations

import pytest

from teds_provision.errors import BadDataError
from teds_provision.teds.certificate import (
    CertificateReference,
    certificate_reference_of,
    read_certificate_reference,
    split_channel,
)
from teds_provision.teds.codec.frame import frame, raw_tuple, unframe
from teds_provision.teds.codec.text_lines import compose_lines, read_lines

GOOD = CertificateReference("B2-42", "Lab", "2026-10-12", "ab" * 32)


def test_the_octets_of_a_certificate_teds() -> None:
    lines = f"certificate=B2-42\nlaboratory=Lab\ndate=2026-10-12\nsha256={'ab' * 32}\n".encode()
    assert GOOD.encode() == frame(bytes.fromhex("030400830101") + raw_tuple(4, lines))
    assert read_certificate_reference(GOOD.encode()) == GOOD
    assert GOOD.to_json() == {
        "certificate": "B2-42",
        "laboratory": "Lab",
        "date": "2026-10-12",
        "sha256": "ab" * 32,
    }
    checked = CertificateReference("B2-42", "Lab", "2026-10-12", "ab" * 32, "good", ("a note",))
    assert checked.to_json()["signature"] == "good"
    assert checked.encode() == GOOD.encode()
    assert checked == GOOD, "what was checked is no part of it"


@pytest.mark.parametrize("letter", ["a", "ä"])
def test_a_long_laboratory_is_cut_to_255_octets_and_a_long_number_is_refused(letter: str) -> None:
    long = CertificateReference("1", letter * 300, "2026-10-12", "ab" * 32)
    lines = read_lines(131, long.encode(), ("certificate", "laboratory", "date", "sha256"))
    assert lines["laboratory"] == letter * (138 // len(letter.encode())) + "…"
    text = "".join(f"{key}={value}\n" for key, value in lines.items()).encode()
    assert 254 <= len(text) <= 255
    room = 255 - len(f"certificate=\nlaboratory=\ndate=2026-10-12\nsha256={'ab' * 32}\n")
    exact = CertificateReference("1" * (room - 3), "abc", "2026-10-12", "ab" * 32)
    assert read_certificate_reference(exact.encode()) == exact, "it fits to the octet"
    with pytest.raises(BadDataError, match="have at most 255 octets"):
        CertificateReference("1" * (room - 2), "", "2026-10-12", "ab" * 32 + "x" * 9).encode()


@pytest.mark.parametrize(
    "change",
    [
        {"number": ""},
        {"date": "2026-1-12"},
        {"date": "2026-10-123"},
        {"sha256": "AB" * 32},
        {"sha256": "ab" * 31},
    ],
)
def test_another_form_is_no_certificate(change: dict[str, str]) -> None:
    values = {"certificate": "B2-42", "laboratory": "Lab", "date": "2026-10-12", "sha256": "ab" * 32}
    values |= {"certificate" if key == "number" else key: value for key, value in change.items()}
    teds = compose_lines(131, values)
    with pytest.raises(BadDataError, match="has no number, date or digest in the form of the profile"):
        read_certificate_reference(teds)
    assert certificate_reference_of({(1, 131): teds}, 1) is None
    assert certificate_reference_of({(1, 131): GOOD.encode()}, 1) == GOOD
    assert certificate_reference_of({(1, 131): GOOD.encode()}, 2) is None


@pytest.mark.parametrize(
    ("text", "channel", "file"),
    [
        ("2=cell.xml", 2, "cell.xml"),
        ("cell.xml", None, "cell.xml"),
        ("a=b.xml", None, "a=b.xml"),
        ("999=b", 999, "b"),
        ("1000=b", None, "1000=b"),
        ("2=", None, "2="),
        ("²=b", None, "²=b"),
        ("2=3=b", 2, "3=b"),
        ("", None, ""),
    ],
)
def test_a_number_before_a_file_is_its_channel(text: str, channel: int | None, file: str) -> None:
    assert split_channel(text) == (channel, file)


ORDER = ("a", "b")


def lines_teds(head: str, text: bytes, *more: bytes) -> bytes:
    return frame(bytes.fromhex(head) + raw_tuple(4, text) + b"".join(more))


@pytest.mark.parametrize(
    ("teds", "why"),
    [
        (lines_teds("030400820101", b"a=1\nb=2\n"), "does not have the form of the profile"),
        (lines_teds("030400830201", b"a=1\nb=2\n"), "does not have the form of the profile"),
        (lines_teds("030401830101", b"a=1\nb=2\n"), "does not have the form of the profile"),
        (lines_teds("030400830101", b"a=1\nb=2\n", raw_tuple(5, b"")), "does not have the form of the profile"),
        (lines_teds("030400830101", b"a=1\nb=2"), "are not a, b, in this order"),
        (lines_teds("030400830101", b"a=1\nb=2\n\n"), "are not a, b, in this order"),
        (lines_teds("030400830101", b"a=1\nb=2\nx"), "are not a, b, in this order"),
        (lines_teds("030400830101", b"b=2\na=1\n"), "are not a, b, in this order"),
        (lines_teds("030400830101", b"a=1\n"), "are not a, b, in this order"),
        (lines_teds("030400830101", b"a=1\nb\n"), "are not a, b, in this order"),
        (lines_teds("030400830101", b"a=1\nb=\t\n"), "is not printable text"),
        (lines_teds("030400830101", b"a=1\nb=\xff\n"), "are not UTF-8"),
    ],
)
def test_lines_in_any_other_way_are_refused(teds: bytes, why: str) -> None:
    assert read_lines(131, lines_teds("030400830101", b"a=1\nb==2\n"), ("x",), ORDER) == {"a": "1", "b": "=2"}
    with pytest.raises(BadDataError, match=why):
        read_lines(131, teds, ORDER)


@pytest.mark.parametrize(("value", "good"), [("x" * 253, True), ("x" * 254, False), ("a\nb", False), ("\ud800", False)])
def test_what_a_line_can_hold(value: str, good: bool) -> None:
    if good:
        assert read_lines(131, compose_lines(131, {"": value}), ("",)) == {"": value}
        assert len(unframe(compose_lines(131, {"": value}))) == 6 + 2 + 255
        return
    with pytest.raises(BadDataError):
        compose_lines(131, {"": value})


def test_a_laboratory_that_is_cut_behind_a_blank_ends_with_its_last_word() -> None:
    for name, kept in ((f"{'a' * 137} {'b' * 99}", "a" * 137), (f"{'a' * 136} {'b' * 99}", f"{'a' * 136} b")):
        long = CertificateReference("1", name, "2026-10-12", "ab" * 32)
        assert read_certificate_reference(long.encode()).laboratory == f"{kept}…"
