"""The Security TEDS: ours in canonical form, other people's with keys in any form, weak algorithms named."""

from __future__ import annotations

import base64

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import teds
from teds_provision.errors import BadDataError
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame

POINT = b"\x04" + bytes(range(64))
SPKI = bytes.fromhex("3059301306072a8648ce3d020106082a8648ce3d030107034200") + POINT
PEM = b"-----BEGIN PUBLIC KEY-----\n" + base64.encodebytes(SPKI) + b"-----END PUBLIC KEY-----\n"


def ours(**changes: object) -> bytes:
    fields = {"signature": bytes(64), "station_key": POINT, "station_key_signature": bytes(64), "ca": "Works:00"}
    return security.SecurityTeds(POINT, bytes(64), **{**fields, **changes}).encode()  # type: ignore[arg-type]


def test_ours_is_clean_and_named() -> None:
    decoded = teds.decode(ours(signed_blocks={(0, 1): bytes(32), (1, 3): bytes(32)}))
    assert decoded.verdict == "clean"
    assert decoded.findings == ()
    assert [field.name for field in decoded.fields[:7]] == [
        "TEDSID",
        "UsedSecScheme",
        "UsedVerAlg",
        "UsedEncAlg",
        "UsedHashAlg",
        "CA",
        "LastModified",
    ]
    assert decoded.get("UsedEncAlg") == 0
    key = teds.read_key(str(decoded.get("NodePublicKey")))
    assert (key.form, key.point) == ("base64", POINT)


def test_type_3_behind_the_tedsid_is_the_encryption() -> None:
    table = teds.table(128)
    assert table.by_type[3].enumeration[table.by_type[3].type - 3] == "AES-128"


@pytest.mark.parametrize("break_it", ["order", "length", "unknown"])
def test_ours_out_of_canonical_form_is_in_error(break_it: str) -> None:
    block = ours()[4:-2]
    if break_it == "order":
        block = block[:6] + block[9:12] + block[6:9] + block[12:]
    elif break_it == "length":
        block = block[:6] + b"\1\2\0\4" + block[9:]
    else:
        block = block[:18] + b"\x09\1\0" + block[18:]
    decoded = teds.decode(frame(block))
    assert decoded.verdict == "content-nonconformant"
    assert any(finding.code == "not-canonical" for finding in decoded.findings)


@pytest.mark.parametrize(
    ("written", "form"),
    [(PEM, "pem"), (SPKI, "der"), (SPKI.hex().encode(), "hex"), (base64.b64encode(SPKI), "base64"), (POINT, "raw")],
)
def test_keys_of_other_people_in_every_form(written: bytes, form: str) -> None:
    fields = {"UsedSecScheme": 4, "UsedVerAlg": 2, "UsedEncAlg": 0, "UsedHashAlg": 1, "NodePublicKey": written}
    decoded = teds.decode(teds.compose(128, fields))
    assert decoded.verdict == "clean"
    assert "foreign" in {finding.code for finding in decoded.findings}
    key = teds.read_key(decoded.field("NodePublicKey").raw)  # type: ignore[union-attr]
    assert (key.form, key.point) == (form, POINT)


def test_white_space_about_a_key_and_headers_of_a_pem_are_no_part_of_it() -> None:
    for written, form in ((PEM, "pem"), (SPKI.hex().encode(), "hex"), (base64.b64encode(SPKI), "base64")):
        assert teds.read_key(b" \r\n" + written + b"\n ") == teds.read_key(written)
        assert teds.read_key(written).form == form
    first, rest = PEM.split(b"\n", 1)
    assert teds.read_key(first + b"\nComment: mine\nX-Y: 1\n\n" + rest) == teds.read_key(PEM)


@pytest.mark.parametrize(
    "octets", [b"\2" + POINT[1:], b"\3" + POINT[1:33], POINT[:-1], POINT + b"\0", SPKI[:-1], SPKI[1:]]
)
def test_a_key_is_an_uncompressed_point_of_p_256_alone(octets: bytes) -> None:
    assert teds.read_key(octets).point is None
    assert teds.read_key(POINT).point == teds.read_key(SPKI).point == POINT


@pytest.mark.parametrize(("written", "form"), [("AAAAAAA=", "base64"), ("QUJDRA==", "base64"), ("QUJD", "raw")])
def test_a_short_word_is_octets_and_no_base64(written: str, form: str) -> None:
    assert teds.read_key(written).form == form


@pytest.mark.parametrize(
    ("octets", "form"),
    [
        ("30 00", "der"),
        ("30 02 0500", "der"),
        ("30 02 05", "raw"),
        ("30 01 0500", "raw"),
        ("31 02 0500", "raw"),
        ("30", "raw"),
        ("30 7f" + "00" * 127, "der"),
        ("30 81 80" + "00" * 128, "der"),
        ("30 81 81" + "00" * 128, "raw"),
        ("30 82 0100" + "00" * 256, "der"),
        ("30 83 000100" + "00" * 256, "der"),
        ("30 84 00000100" + "00" * 256, "der"),
        ("30 85 0000000100" + "00" * 256, "raw"),
        ("30 80" + "00" * 128, "raw"),  # without a length
        ("30 80", "raw"),
    ],
)
def test_der_is_one_sequence_whose_length_is_that_of_the_rest(octets: str, form: str) -> None:
    """A short length is one octet below 128; a long one has 1 to 4 octets, counted by the first one."""
    assert teds.read_key(bytes.fromhex(octets)).form == form


@given(st.binary(max_size=300))
def test_any_key_is_read(octets: bytes) -> None:
    assert teds.read_key(octets).form in {"pem", "hex", "base64", "der", "raw"}


@pytest.mark.parametrize(
    ("field", "code", "name"),
    [
        ("UsedSecScheme", 0, "NoSec"),
        ("UsedVerAlg", 1, "DSA"),
        ("UsedVerAlg", 3, "ElGamal"),
        ("UsedEncAlg", 2, "RC4"),
        ("UsedEncAlg", 3, "DES"),
        ("UsedEncAlg", 4, "Blowfish"),
        ("UsedHashAlg", 0, "MD5"),
    ],
)
def test_weak_choices_are_named(field: str, code: int, name: str) -> None:
    fields = {"UsedSecScheme": 4, "UsedVerAlg": 2, "UsedEncAlg": 0, "UsedHashAlg": 1, field: code}
    weak = [finding for finding in teds.decode(teds.compose(128, fields)).findings if finding.code == "weak"]
    assert [(finding.field, finding.found) for finding in weak] == [(field, name)]


def test_reserved_codes_are_warned_about() -> None:
    fields = {"UsedSecScheme": 77, "UsedVerAlg": 2, "UsedEncAlg": 0, "UsedHashAlg": 1}
    findings = teds.decode(teds.compose(128, fields)).findings
    assert [finding.field for finding in findings if finding.code == "enumeration"] == ["UsedSecScheme"]


def test_a_foreign_class_128_does_not_become_an_error() -> None:
    block = bytes.fromhex("030400800101") + bytes.fromhex("0104DEADBEEF") + bytes.fromhex("4D0101") + b"\x96\x00"
    decoded = teds.decode(frame(block))
    assert decoded.verdict == "clean"
    assert teds.recompose(decoded) == decoded.octets


def test_security_of_2024_keeps_unknown_fields() -> None:
    octets = teds.compose(16, {"Level": "E", "NumOfStandards": 1, "12": b"\x0a", "13": b"\x04"}, edition=2024)
    decoded = teds.decode(octets)
    assert decoded.verdict == "clean"
    assert [(field.type, field.raw) for field in decoded.fields[3:]] == [(12, b"\x0a"), (13, b"\x04")]
    assert teds.recompose(decoded) == octets


@pytest.mark.parametrize("unknown", [7, 99])
def test_a_field_that_the_profile_does_not_know_is_refused_below_111_whatever_stands_above(unknown: int) -> None:
    assert security.decode(ours(extra={111: b"x", 255: b"more"})).extra == {111: b"x", 255: b"more"}
    for extra in ({unknown: b"x"}, {unknown: b"x", 255: b"more"}):
        with pytest.raises(security.NotCanonicalError, match=f"field {unknown} that the profile does not know"):
            security.decode(ours(extra=extra))


@given(st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), max_size=4), st.booleans())
def test_a_layout_that_was_seen_before_changes_no_verdict(changes: list[tuple[int, int]], swapped: bool) -> None:
    good = ours(signed_blocks={(0, 1): bytes(32), (1, 3): b"3" * 32}, extra={120: b"more"})
    block = bytearray(good[4:-2])
    for place, octet in changes:
        block[place % len(block)] = octet
    if swapped:  # two fields of one length
        at = block.find(b"\x6a\x04")
        block[at : at + 12] = block[at + 6 : at + 12] + block[at : at + 6]

    def read() -> object:
        found: list[object] = []
        for look in (
            lambda: vars(security.decode_block(bytes(block))),
            lambda: security.tbs(bytes(10), frame(bytes(block))),
        ):
            try:
                found.append(look())
            except BadDataError as error:
                found.append(error.message)
        return found

    security._LAYOUTS.clear()
    security._walked.cache_clear()
    fresh = read()
    security._LAYOUTS.clear()
    security._walked.cache_clear()
    assert security.decode_block(good[4:-2]).extra == {120: b"more"}
    assert read() == fresh


def test_layouts_that_are_remembered_are_few_and_short() -> None:
    security._LAYOUTS.clear()
    for length in range(200):
        with pytest.raises(security.NotCanonicalError):
            security.decode_block(security.TEDSID_TUPLE + bytes([5, length]) + bytes(length))
    assert len(security._LAYOUTS) <= 64
    security._LAYOUTS.clear()
    many = ours(signed_blocks={(channel, 3): bytes(32) for channel in range(256)})
    assert len(security.decode(many).signed_blocks) == 256
    assert not security._LAYOUTS


@pytest.mark.parametrize("name", ["signed_blocks", "values", "extra"])
def test_what_was_decoded_cannot_be_changed_for_the_next_reader(name: str) -> None:
    """The result is cached: who changed it changed what every later reader of these octets was given."""
    octets = ours(signed_blocks={(0, 1): bytes(32)}, extra={120: b"more"})
    before = dict(getattr(security.decode(octets), name))
    with pytest.raises(TypeError):
        getattr(security.decode(octets), name)[next(iter(before))] = 0
    assert getattr(security.decode(octets), name) == before


@pytest.mark.parametrize(
    ("places", "good"), [("000001 000003 000101", True), ("000001 000001", False), ("000003 000001", False)]
)
def test_signed_blocks_ascend_and_none_is_there_twice(places: str, good: bool) -> None:
    block = ours(signed_blocks={(0, 1): bytes(32)})[4:-2]
    one = bytes.fromhex("6c23 000001") + bytes(32)
    assert block.count(one) == 1
    listed = b"".join(bytes.fromhex(f"6c23 {place}") + bytes(32) for place in places.split())
    changed = block.replace(one, listed)
    if good:
        assert list(security.decode_block(changed).signed_blocks) == [(0, 1), (0, 3), (1, 1)]
        return
    with pytest.raises(security.NotCanonicalError, match="The SignedBlocks do not ascend by channel and access code"):
        security.decode_block(changed)


@pytest.mark.parametrize(
    ("rest", "kind"),
    [("0102 00", 1), ("010104 0205 00", 2), ("010104 020104 0302", 3), ("010104 02", 2), ("01", 1)],
)
def test_the_tuple_that_runs_past_the_end_is_named(rest: str, kind: int) -> None:
    """A type alone, without its length, is one too."""
    with pytest.raises(BadDataError, match=rf"^The tuple of type {kind} runs past the end of the data block\.$"):
        security.decode_block(security.TEDSID_TUPLE + bytes.fromhex(rest))
