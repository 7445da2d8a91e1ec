"""Between the editions: without loss where both can say it, and a finding for what cannot be said."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import frame, raw_tuple, unframe
from tests.teds.strategies import some_fields
from tests.teds.vectors import TEDS, octets_of

OLD, NEW = bytes(range(10)), bytes(range(16))


def to(octets: bytes, edition: Any, **more: bytes) -> tuple[teds.DecodedTeds, list[teds.Finding]]:
    converted, findings = teds.convert(teds.decode(octets), edition, **more)
    return teds.decode(converted), findings


def test_worked_channel_becomes_the_worked_one_of_2024() -> None:
    converted, findings = teds.convert(teds.decode(octets_of("x07_chan_temp_nested")), 2024)
    assert converted == octets_of("x24_chan_temp")
    assert findings == []
    assert teds.convert(teds.decode(converted), 2007) == (octets_of("x07_chan_temp_nested"), [])


@pytest.mark.parametrize("access_code", [1, 3, 5, 8, 10, 12, 13, 14, 129])
@given(data=st.data())
@settings(max_examples=20, deadline=None, suppress_health_check=list(HealthCheck))
def test_there_and_back_is_no_change(access_code: int, data: st.DataObject) -> None:
    pairs = data.draw(some_fields(access_code, 2007))
    for name, value in pairs:
        if name in ("LstCalDt", "ZeroDate") and value.negative:
            pairs = [pair for pair in pairs if pair[0] != name]
    octets = teds.compose(access_code, pairs)
    newer, there = to(octets, 2024, uuid=NEW)
    assert (newer.edition, newer.verdict) == (2024, "clean")
    assert not [finding for finding in there if finding.severity == "error"]
    old = dict(pairs).get("UUID", OLD)
    older, _ = to(newer.octets, 2007, uuid=old)
    assert older.octets == octets


def test_a_uuid_cannot_be_expressed_in_the_other_edition() -> None:
    decoded, findings = to(octets_of("x07_meta"), 2024)
    assert [(finding.severity, finding.code, finding.field) for finding in findings] == [("error", "lost", "UUID")]
    assert decoded.field("UUID") is None
    assert decoded.verdict == "clean"
    decoded, findings = to(octets_of("x07_meta"), 2024, uuid=NEW)
    assert (decoded.get("UUID"), findings) == (NEW, [])
    with pytest.raises(BadDataError, match="16 octets"):
        to(octets_of("x07_meta"), 2024, uuid=OLD)


def test_times_before_1970_and_after_2106() -> None:
    octets = teds.compose(5, {"LstCalDt": -5, "OError": 0.5})
    decoded, findings = to(octets, 2024)
    assert [(f.severity, f.code, f.field) for f in findings] == [("error", "lost", "LstCalDt")]
    assert findings[0].message.endswith(" It is left out.")
    assert decoded.get("OError") == 0.5
    octets = teds.compose(5, {"LstCalDt": 1 << 33}, edition=2024)
    assert [(finding.severity, finding.code) for finding in to(octets, 2007)[1]] == [("error", "lost")]


@pytest.mark.parametrize("edition", [2007, 2024])
def test_what_follows_the_checksum_of_a_text_based_teds_is_no_text(edition: Any) -> None:
    octets = teds.compose(11, [("Text", {"Text": "<a/>"}), ("Text", {"LangCode": "de", "Text": "b"})], edition=edition)
    decoded = teds.decode(octets + b"\xff\xfe\xfd")
    assert (decoded.text, [finding.code for finding in decoded.findings]) == ((b"<a/>", b"b"), ["frame-trailing"])
    assert teds.recompose(decoded) == octets


def test_nanoseconds_beyond_a_second_are_kept_and_warned_about() -> None:
    block = bytes.fromhex("030400050101" + "0a0a" + "00006955b900" + "b65fffff")
    decoded = teds.decode(frame(block))
    assert decoded.get("LstCalDt") == teds.TimeInstance(0x6955B900, 0xB65FFFFF)
    assert "time" in {finding.code for finding in decoded.findings}
    assert teds.recompose(decoded) == frame(block)


@pytest.mark.parametrize(
    ("fields", "newer", "lost"),
    [
        ("1204 280100 29", "1204 280100 29", []),
        ("1207 280100 290102 2a", "1207 280100 290102 2a", []),
        ("0c03 320100", "0c0b 0080808080808080808000", []),
        ("0c04 320100 33", "0c0b 0080808080808080808000", ["The octets 33 of PhyUnits form no field"]),
        ("0c03 010203", "0c0b 0080808080808080808000", ["The octets 01 02 03 of PhyUnits form no field"]),
        ("0c0b 0080808080808080808005", "0c0b 0080808080808080808005", []),
    ],
)
def test_octets_that_form_no_field_are_kept_or_their_loss_is_a_finding(
    fields: str, newer: str, lost: list[str]
) -> None:
    """They went without a word."""
    octets, findings = teds.convert(teds.decode(frame(bytes.fromhex(f"030400030101 {fields}"))), 2024)
    assert unframe(octets) == bytes.fromhex(f"030500ff030201 {newer}")
    assert [(f.severity, f.code, f.message) for f in findings] == [
        ("error", "lost", f"{words}; they are left out.") for words in lost
    ]
    back, none = teds.convert(teds.decode(octets), 2007)
    assert none == []
    if fields.startswith("12"):
        assert unframe(back) == bytes.fromhex(f"030400030101 {fields}")


def test_octets_that_form_no_field_are_kept_behind_tuples_of_two_length_octets() -> None:
    octets, findings = teds.convert(teds.decode(frame(bytes.fromhex("030400030102 120006 28000100 2900"))), 2024)
    assert unframe(octets) == bytes.fromhex("030500ff030202 120006 28000100 2900")
    assert findings == []


def test_sub_family_is_lost() -> None:
    octets = teds.compose(12, {"Format": 0, "TCName": "x", "TEDSID": {"subfamily": 4}}, edition=2024)
    assert [(finding.severity, finding.code) for finding in to(octets, 2007)[1]] == [("error", "lost")]


def test_classes_that_2007_does_not_have() -> None:
    decoded, findings = to(octets_of("x24_security"), 2007)
    assert "class" in {finding.code for finding in findings}
    assert decoded.get("Level") == "E"
    assert "class" not in {finding.code for finding in to(octets_of("x24_security"), 2024)[1]}


@pytest.mark.parametrize("code", [AccessCode.SECURITY, AccessCode.ORIGIN, AccessCode.CERTIFICATE])
def test_a_teds_of_the_profile_has_the_same_octets_in_each_edition(code: AccessCode) -> None:
    octets = frame(bytes.fromhex(f"03 04 00 {code:02x} 01 01 0a 01 61"))
    for edition, codes in ((2007, []), (2024, ["one-form"])):
        converted, findings = to(octets, edition)
        assert converted.octets == octets
        assert [finding.code for finding in findings] == codes


def test_the_security_teds_of_the_profile_has_one_form() -> None:
    octets = teds.compose(128, {"UsedSecScheme": 4, "UsedVerAlg": 2, "UsedEncAlg": 0, "UsedHashAlg": 1})
    converted, findings = teds.convert(teds.decode(octets), 2024)
    assert converted == octets
    assert [finding.code for finding in findings] == ["one-form"]


def test_text_based_teds_get_a_new_directory() -> None:
    pairs = [("Text", {"LangCode": "en", "Text": "<a/>"}), ("Text", {"LangCode": "de", "Text": "<b/>"})]
    octets = teds.compose(14, pairs)
    decoded, findings = to(octets, 2024)
    assert decoded.octets == teds.compose(14, pairs, edition=2024)
    assert findings == []


def test_bare_blocks_stay_bare_and_the_same_edition_is_left_alone() -> None:
    block = octets_of("x07_name")[4:-2]
    converted, _ = teds.convert(teds.decode(block), 2024)
    assert converted[:2] == b"\3\5"
    assert teds.convert(teds.decode(block), 2007) == (block, [])


def test_prototype_versions_are_kept_and_named() -> None:
    assert "version" in {finding.code for finding in to(octets_of("b07_mcpeixoto_meta"), 2024)[1]}


@pytest.mark.parametrize("name", TEDS)
@pytest.mark.parametrize("edition", [2007, 2024])
def test_every_vector_converts_or_says_why_not(name: str, edition: Any) -> None:
    decoded = teds.decode(octets_of(name))
    if decoded.edition is None or decoded.verdict == "malformed":
        with pytest.raises(BadDataError):
            teds.convert(decoded, edition)
    else:
        converted, _ = teds.convert(decoded, edition)
        assert teds.decode(converted).edition == edition
        assert teds.decode(converted).framed == decoded.framed


# --- text-based TEDS ---


def test_a_text_based_teds_whose_tedsid_is_not_first_is_not_converted() -> None:
    decoded = teds.decode(frame(bytes.fromhex("0a0101 0304000b0101")))
    assert (decoded.access_code, decoded.verdict) == (11, "content-nonconformant")
    with pytest.raises(BadDataError) as refused:
        teds.convert(decoded, 2024)
    assert refused.value.message == "A text-based TEDS whose TEDSID is not first cannot be converted."


def test_texts_are_read_by_their_lengths() -> None:
    octets = teds.compose(10, [("Text", {"LangCode": "en", "Text": "<a/>"}), ("Text", {"LangCode": "pt", "Text": "é"})])
    decoded = teds.decode(octets)
    assert decoded.text == (b"<a/>", "é".encode())
    offsets = [child.value for field in decoded.fields for child in field.children if child.name == "Offset"]
    assert octets[offsets[0] :].startswith(b"<a/>")  # type: ignore[misc]
    assert octets[offsets[1] :].startswith("é".encode())  # type: ignore[misc]


def directory(length: int) -> bytes:
    entry = raw_tuple(20, b"en") + raw_tuple(21, bytes(4)) + raw_tuple(22, length.to_bytes(4, "big"))
    return bytes.fromhex("0304000E0101") + raw_tuple(10, b"\1") + raw_tuple(11, entry) + raw_tuple(12, b"\0\0")


@pytest.mark.parametrize(
    ("area", "length", "codes"),
    [
        (b"<a/>\xff\xff", 6, {"text-checksum"}),
        (b"<a/>\xff\xff", 4, {"text-length", "text-checksum"}),
        (b"\x80\x04<a/>\x81\x02\0\0", 4, {"text-tagged"}),
        (b"\x80\x00\x04<a/>\x81\x00\x02\0\0", 4, {"text-tagged"}),
        (b"<a/>", 99, {"text-length"}),
    ],
)
def test_habits_of_other_people_are_read_with_a_remark(area: bytes, length: int, codes: set[str]) -> None:
    decoded = teds.decode(frame(directory(length) + area))
    assert decoded.verdict == "clean"
    assert decoded.text == (b"<a/>",)
    assert {finding.code for finding in decoded.findings} == codes
    assert teds.recompose(decoded) == decoded.octets


@pytest.mark.parametrize("fields", [{}, {"NumLang": 1}, {"Text": 3}, {"Text": {"Text": 5}}, {"Text": {"Lang": "en"}}])
def test_texts_that_cannot_be_written(fields: dict[str, object]) -> None:
    with pytest.raises(BadDataError):
        teds.compose(10, fields)


def test_a_number_that_is_none_keeps_its_bits() -> None:
    octets = teds.compose(5, {"OError": float("nan")})
    other = frame(unframe(octets).replace(bytes.fromhex("7fffffff"), bytes.fromhex("ffc01234")))
    assert other != octets
    assert teds.recompose(teds.decode(other)) == other
