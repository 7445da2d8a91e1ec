"""Edges of keys, signatures, messages and documents that nothing ordinary reaches: each is refused in its words."""

from __future__ import annotations

import base64
import hashlib
import sys
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec, ed25519

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError
from teds_provision.protocol import datasheet
from teds_provision.protocol.announce import AddressClaim, Announce
from teds_provision.protocol.handover import bundle as bundles
from teds_provision.protocol.handover import jose, strict_json
from teds_provision.protocol.handover.bundle import TYPE, open_bundle, payload_pieces
from teds_provision.protocol.handover.envelope import _SplitJws
from teds_provision.protocol.handover.strict_json import base64url, dump
from teds_provision.protocol.keys import (
    SoftwareKey,
    fingerprint,
    from_pem,
    node_key_message,
    station_key_message,
    to_pem,
    verify_der,
    verify_each_once,
)
from teds_provision.protocol.messages import smp
from teds_provision.protocol.messages.arguments import _octets, read_plain, write_plain
from teds_provision.protocol.messages.frames import Command, Reply
from teds_provision.protocol.messages.message import compose_command, compose_service
from teds_provision.protocol.messages.tables import describe_answer, describe_request
from teds_provision.protocol.operation.can_frames import StreamAssembly
from teds_provision.protocol.operation.datagram import DatagramSealer
from teds_provision.protocol.plant.document import Fields
from teds_provision.protocol.plant.evidence import CheckedEvidence, Signatures, check_signatures
from teds_provision.protocol.plant.roster import _roles
from teds_provision.protocol.plant.signing import require_name
from teds_provision.protocol.session import _decrypt, unpad
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.codec import security
from tests.protocol.desk import CREDENTIALS, UUID
from tests.protocol.handover_parts import NOW, RECEIVER, SENDER, STRANGER, bundle, node, trusts

KEY = SoftwareKey(77)
GOOD_JWK = jose.public_jwk(KEY.point)


@pytest.mark.parametrize(
    ("padded", "octets"),
    [
        ("", None),
        ("01" * 15, None),
        ("aa" * 15 + "01", "aa" * 15),
        ("10" * 16, ""),
        ("aa" * 16 + "10" * 16, "aa" * 16),
        ("aa" * 13 + "030303", "aa" * 13),
        ("aa" * 13 + "020303", None),
        ("aa" * 15 + "00", None),
        ("11" * 32, None),
        ("aa" * 16 + "01", None),
    ],
)
def test_a_padding_is_1_to_16_octets_that_count_themselves(padded: str, octets: str | None) -> None:
    """RFC 5652 section 6.3."""
    assert unpad(bytes.fromhex(padded)) == (None if octets is None else bytes.fromhex(octets))


def _pem(octets: bytes) -> bytes:
    return b"-----BEGIN PUBLIC KEY-----\n" + base64.b64encode(octets) + b"\n-----END PUBLIC KEY-----\n"


def _public(key: Any) -> bytes:
    form = serialization.PublicFormat.SubjectPublicKeyInfo
    return bytes(key.public_key().public_bytes(serialization.Encoding.PEM, form))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            b"-----BEGIN EC PRIVATE KEY-----\n",
            "This file holds a private key where a public one belongs.",
        ),
        (
            _pem(bytes.fromhex("300a" "3005" "0603" "2a0304" "0301" "00")),
            "This is no P-256 key: its kind is not known here; stations and CAs have P-256 keys.",
        ),
        (b"no PEM", "This file holds no public key in PEM form."),
        (_pem(b"\x30\x00"), "This file holds no public key in PEM form."),
        (
            _public(ed25519.Ed25519PrivateKey.from_private_bytes(bytes(32))),
            "This is not a P-256 key; stations and CAs have P-256 keys.",
        ),
        (
            _public(ec.derive_private_key(5, ec.SECP384R1())),
            "This is not a P-256 key; stations and CAs have P-256 keys.",
        ),
    ],
    ids=["private", "unknown kind", "no PEM", "no key", "Ed25519", "P-384"],
)  # fmt: skip
def test_a_public_key_of_a_file_is_one_of_p_256(text: bytes, words: str) -> None:
    with pytest.raises(BadDataError) as no:
        from_pem(text)
    assert no.value.message == words
    assert from_pem(to_pem(KEY.point).encode()) == KEY.point


def test_signatures_of_a_point_that_is_none_are_all_wrong() -> None:
    good = (b"one", KEY.sign(b"one"))
    assert verify_each_once(KEY.point, [good, (b"two", good[1])]) == [True, False]
    assert verify_each_once(b"\x04" + bytes(64), [good, good]) == [False, False]


def test_a_datasheet_that_nobody_signed_has_no_good_signature() -> None:
    node_signature = KEY.sign(node_key_message(UUID, KEY.point))
    octets = security.initial(KEY.point, node_signature, sequence=0, key_epoch=1)
    shown = security.decode(octets)
    for unsigned in (shown, replace(shown, station_key=KEY.point), replace(shown, signature=bytes(64))):
        assert not datasheet.signature_good(unsigned, octets, UUID)
        assert not datasheet.signature_good(unsigned, octets, UUID, lambda *_: True)
        assert not datasheet.message_signature_good(unsigned, b"message")
        assert not datasheet.message_signature_good_once(unsigned, b"message")
    good = datasheet.sign_datasheet(replace(shown, station_key=CREDENTIALS.key.point), UUID, CREDENTIALS)
    signed, asked = security.decode(good), list[Any]()

    def chip(*given: bytes) -> bool:
        asked.append(given)
        return True

    assert datasheet.signature_good(signed, good, UUID)
    assert datasheet.signature_good(signed, good, UUID, chip)
    assert asked == [(CREDENTIALS.key.point, security.tbs(UUID, good), signed.signature)]
    assert not datasheet.signature_good(signed, good, bytes(10))
    assert not datasheet.signature_good(signed, good, UUID, lambda *_: False)
    assert datasheet.message_signature_good_once(signed, security.tbs(UUID, good))
    assert datasheet.message_signature_good(signed, security.tbs(UUID, good))
    assert not datasheet.message_signature_good_once(signed, b"message")


@pytest.mark.parametrize("own", ["station", "one-time"])
def test_a_node_that_shows_a_key_of_the_station_is_not_agreed_with(own: str) -> None:
    """Else a station would agree with its own reflection."""
    one_time = SoftwareKey(78)
    key = CREDENTIALS.key if own == "station" else one_time
    teds = security.initial(key.point, key.sign(node_key_message(UUID, key.point)), sequence=0, key_epoch=1)
    with pytest.raises(NotAuthenticError, match="The key that the node shows is this station's own"):
        StationAgreement(CREDENTIALS, UUID, one_time=one_time).accept(bytes(165), teds, pinned=None, epoch=0)


def test_a_node_that_hears_every_address_keeps_its_own() -> None:
    claim = AddressClaim(6, uniform=lambda low, _high: low)
    for source in range(1, 240):
        claim.hear(source)
    assert claim.handle_announce(Announce(33, 0, 5), 33, 1.0) == 33


# -- documents ---------------------------------------------------------------------------------------------------------


def test_a_bundle_holds_as_many_nodes_as_it_was_to_hold() -> None:
    made = bundle()
    with pytest.raises(BadDataError) as no:
        b"".join(payload_pieces(made, iter([node(1), node(2)]), 3))
    assert no.value.message == "The bundle was to hold 3 different nodes, and holds 2."
    with pytest.raises(BadDataError) as no:
        b"".join(payload_pieces(made, iter([node(1), node(1)]), 2))
    assert no.value.message == "The bundle was to hold 2 different nodes, and holds 1."


def test_a_bundle_is_no_longer_than_its_receiver_reads() -> None:
    """64 MiB sealed, of which the payload has 9 octets in 16 at most, after 128 KiB for the rest."""
    most, piece = (64 * 1024 * 1024 - 128 * 1024) // 16 * 9, bytes(1 << 20)
    pieces = [piece] * (most >> 20) + [bytes(most & 0xFFFFF)]
    assert sum(len(out) for out in bundles._within(pieces, 9)) == most
    with pytest.raises(BadDataError) as no:
        list(bundles._within([*pieces, b"1"], 12345))
    assert (no.value.message, no.value.hint) == ("12345 nodes are too many for one bundle.", "Export them in groups.")


def test_a_payload_that_is_no_base64url_is_a_fault_only_after_its_signature() -> None:
    """An unsigned value is not trusted, so the error does not quote it."""
    head = base64url(dump({"alg": "ES256", "kid": fingerprint(SENDER.point), "typ": TYPE}))
    for text in (b"*", b"QQ=="):
        message = head + b"." + text
        for signer, error in ((SENDER, BadDataError), (STRANGER, NotAuthenticError)):
            jws = message + b"." + base64url(signer.sign(message))
            with pytest.raises(error) as no:
                open_bundle(jose.encrypt(jws, [RECEIVER.point], cty="JWS"), RECEIVER, trusts(SENDER), NOW)
            assert ("base64url" in no.value.message) == (signer is SENDER)


@pytest.mark.parametrize("name", ["", " a", "a ", "a\tb", "a" * 101, "a\x85", "\u202e"])
def test_a_name_in_a_request_is_printable_and_has_no_space_at_its_ends(name: str) -> None:
    with pytest.raises(BadDataError) as no:
        require_name(name)
    assert no.value.message == (
        f"The name {name!r} is none of 1 to 100 printable characters without space at either end."
    )


@pytest.mark.parametrize("name", [None, "a", "a" * 100, "links, rechts", "größe"])
def test_any_other_name_may_stand_in_a_request(name: str | None) -> None:
    require_name(name)


# -- messages ----------------------------------------------------------------------------------------------------------


def test_what_is_no_message_is_not_composed() -> None:
    with pytest.raises(BadDataError) as no:
        compose_service(99, 1, 1, {})
    assert no.value.message == "There is no network service 99.1 with message type 1."
    with pytest.raises(BadDataError) as no:
        compose_service(1, 1, 9, {})
    assert no.value.message == "There is no network service 1.1 with message type 9."
    with pytest.raises(BadDataError):
        compose_command(1, 1, 1)  # only Open may come without arguments
    assert compose_command(0, 128, 3) == bytes.fromhex("0000 8003 0000")
    assert compose_command(65_535, 1, 1, {"access_code": 3})[:2] == b"\xff\xff"
    long: dict[str, Any] = {"access_code": 3, "offset": 0, "octets": bytes(65_530)}
    assert len(compose_command(1, 1, 3, long)) == 6 + 65_535
    with pytest.raises(BadDataError) as no:
        compose_command(1, 1, 3, long | {"octets": bytes(65_531)})
    assert no.value.message == "Write TEDS segment would carry 65536 octets; a message carries at most 65535."


def test_an_update_without_cbor2_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    assert smp.decode_map(b"\xa1\x61a\x01") == {"a": 1}
    monkeypatch.setitem(sys.modules, "cbor2", None)
    with pytest.raises(NotFoundError) as no:
        smp.decode_map(b"\xa0")
    assert no.value.message == "Firmware updates need the package cbor2."
    assert "[update]" in (no.value.hint or "")


LONG = '"' + "x" * 70_000 + '"'


@pytest.mark.parametrize(
    "text",
    [
        '\ufeff{"nodes":[]}', '\ufeff[]', '{"nodes":[1,2]', '{"nodes":[1 2]}', '{"nodes":[1,]}', '{"nodes":[],}',
        '{"nodes":[]}x', '{"nodes":[]} {}', '{"a":1,"a":2}', '{"nodes":[],"nodes":[]}', '{a:1}', '{"a" 1}', '{"a":}',
        '{"a":01}', '{"a":NaN}', '{"a":1.5.5}', '{"nodes":[' + LONG + ',',
        "", " ", '{"a":"\x01"}',
    ],
)  # fmt: skip
def test_a_long_object_is_json_to_its_last_character(text: str) -> None:
    with pytest.raises(BadDataError, match="The bundle"):
        strict_json.load_long(bytearray(text.encode()), "The bundle", "nodes", lambda value: value)


@pytest.mark.parametrize("text", ["[]", "1", '"a"', "null", " [1, 2] "])
def test_a_long_value_that_is_no_object_is_named_so(text: str) -> None:
    with pytest.raises(BadDataError) as no:
        strict_json.load_long(bytearray(text.encode()), "The bundle", "nodes", lambda value: value)
    assert no.value.message == "The bundle is JSON, but not an object."


def test_elements_of_a_long_list_are_made_one_by_one_and_the_octets_are_used_up() -> None:
    text = ' {"a" : {"nodes":[1]}, "nodes" : [1, [2], ' + LONG + ' , {"b":null} ] , "c":[3],\n"d":-1.5e+10 } '
    octets = bytearray(text.encode())
    found = strict_json.load_long(octets, "The bundle", "nodes", lambda value: (value,))
    assert found == {
        "a": {"nodes": [1]},
        "nodes": [(1,), ([2],), ("x" * 70_000,), ({"b": None},)],
        "c": [3],
        "d": -1.5e10,
    }
    assert octets == b""
    empty = strict_json.load_long(bytearray(b'{"nodes":[]}'), "The bundle", "nodes", lambda value: value)
    assert empty == {"nodes": []}
    other = strict_json.load_long(bytearray(b'{"nodes":{"a":1}}'), "The bundle", "nodes", lambda value: value)
    assert other == {"nodes": {"a": 1}}


@pytest.mark.parametrize(
    ("jwk", "why"),
    [
        (None, "It is not a JSON Web Key."),
        ([], "It is not a JSON Web Key."),
        ({"kty": "oct", "k": "AAAA"}, "It holds a private or secret key where a public one belongs."),
        (GOOD_JWK | {"d": "AAAA"}, "It holds a private or secret key where a public one belongs."),
        (GOOD_JWK | {"kty": "RSA"}, "It is not a P-256 key; stations, CAs and nodes have P-256 keys."),
        (GOOD_JWK | {"crv": "P-384"}, "It is not a P-256 key; stations, CAs and nodes have P-256 keys."),
        (GOOD_JWK | {"x": GOOD_JWK["x"] + "AAA"}, "It has coordinates that are not 32 octets each."),
        (GOOD_JWK | {"y": ""}, "It has coordinates that are not 32 octets each."),
        (GOOD_JWK | {"y": GOOD_JWK["x"]}, "It is not a point of the curve P-256."),
        (GOOD_JWK | {"kid": "me", "use": "sig", "alg": "ES256"}, None),
    ],
)
def test_a_key_of_a_document_is_a_public_point_or_named_for_what_it_is(jwk: Any, why: str | None) -> None:
    if why is None:
        assert jose.point_of(jwk, "It") == KEY.point
        return
    with pytest.raises(BadDataError) as no:
        jose.point_of(jwk, "It")
    assert no.value.message == why


def test_a_sealed_document_beyond_its_bound_is_not_parsed() -> None:
    sealed = jose.encrypt(b"{}", [KEY.point], cty="JWS")
    longer = sealed + b" " * (4096 - len(sealed))
    assert jose.decrypt(longer, KEY, cty="JWS", max_octets=4096) == b"{}"
    with pytest.raises(BadDataError, match="The sealed document has 4097 octets; at most 4096 are read"):
        jose.decrypt(longer + b" ", KEY, cty="JWS", max_octets=4096)


@pytest.mark.parametrize(("count", "found"), [(1, 2), (3, 2), (0, 2)])
def test_a_bundle_is_not_written_with_more_or_fewer_nodes_than_it_counts(count: int, found: int) -> None:
    with pytest.raises(BadDataError, match=f"to hold {count} different nodes, and holds {found}"):
        list(payload_pieces(bundle(), [node(1), node(2)], count))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (b"aGVhZA.YWJj.c2ln", (b"aGVhZA", b"c2ln", b"abc")),
        (b"aGVhZA.YWJj", None),
        (b"aGVhZA.YWJj.c2ln.", None),
        (b"aGVhZA.YWJj.c2ln.YQ", None),
        (b"aGVhZA", None),
    ],
)
@pytest.mark.parametrize("size", [1, 7, 100])
def test_what_is_inside_a_sealed_bundle_has_three_parts_however_it_comes(
    text: bytes, parts: tuple[bytes, bytes, bytes] | None, size: int
) -> None:
    jws = _SplitJws()
    for at in range(0, len(text), size):
        jws.more(text[at : at + size])
    assert jws.sha256 == hashlib.sha256(text).hexdigest()
    if parts is None:
        with pytest.raises(BadDataError, match="three parts"):
            jws.signed()
        return
    header, signature, digest = jws.signed()
    assert (header, signature, bytes(jws.payload())) == parts
    assert digest == hashlib.sha256(b"aGVhZA.YWJj").digest()


@pytest.mark.parametrize(
    ("changes", "good"),
    [({}, True), ({"station_key": None}, False), ({"station_key_signature": None}, False),
     ({"station_key": b"\4" + bytes(64)}, False), ({"station_key": KEY.point[:-1]}, False)],
)  # fmt: skip
def test_the_key_of_a_station_is_a_point_before_a_node_s_chip_is_asked(changes: dict[str, Any], good: bool) -> None:
    asked: list[tuple[bytes, bytes, bytes]] = []

    def chip(point: bytes, message: bytes, signature: bytes) -> bool:
        asked.append((point, message, signature))
        return True

    teds = SimpleNamespace(station_key=KEY.point, station_key_signature=bytes(64))
    vars(teds).update(changes)
    assert datasheet.station_signature_good(cast("Any", teds), STRANGER.point, chip) is good
    assert asked == ([(STRANGER.point, station_key_message(KEY.point), bytes(64))] if good else [])
    assert not datasheet.station_signature_good(cast("Any", teds), STRANGER.point), "the signature is of nobody"


def test_a_der_signature_is_of_a_point_over_a_message_or_no_good() -> None:
    signer = ec.generate_private_key(ec.SECP256R1())
    point = signer.public_key().public_bytes(serialization.Encoding.X962, serialization.PublicFormat.UncompressedPoint)
    signature = signer.sign(b"message", ec.ECDSA(hashes.SHA256()))
    assert verify_der(point, b"message", signature)
    for wrong in (
        (point, b"messagf", signature),
        (KEY.point, b"message", signature),
        (b"\4" + bytes(64), b"message", signature),
        (b"", b"message", signature),
        (point, b"message", b""),
        (point, b"message", signature[:-1]),
    ):
        assert not verify_der(*wrong)


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (Command(1, 1, 2, b"\x05\0\0\1\0"), "Read (1.2), 5 octets: TEDS 5 of channel 1 from octet 256"),
        (Command(0, 1, 3, b"\x0c\0\0\0\7abc"), "Write (1.3), 8 octets: TEDS 12 of channel 0 from octet 7"),
        (Command(2, 1, 3, b"\x03\0\0\0"), "Write (1.3), 4 octets: TEDS 3 of channel 2"),
        (Command(0, 1, 1, b"\x10\0\0\0\7"), "Query (1.1), 5 octets: TEDS 16 of channel 0"),
        (Command(0, 1, 2, b""), "Read (1.2), 0 octets"),
        (Command(0, 128, 8, bytes(31)), "Prove (128.8), 31 octets"),
        (Command(1, 1, 5, b"\1"), "Run self-test (1.5), 1 octets"),
        (Command(1, 4, 1, bytes(17)), "TransducerChannel Operate (4.1), 17 octets"),
        (Command(1, 3, 2, bytes(6)), "Write data-set segment (3.2), 6 octets"),
        (Command(0, 1, 99), "1.99, 0 octets"),
        (Command(0, 128, 10, b"\x21"), "Set can address (128.10), 1 octets"),
        (Command(0, 128, 99), "128.99, 0 octets"),
        (Command(0, 200, 8, bytes(3)), "200.8, 3 octets"),
    ],
)
def test_a_command_of_teds_is_described_with_its_teds_and_its_place(command: Command, words: str) -> None:
    assert describe_request(command) == words


@pytest.mark.parametrize(
    ("reply", "words"),
    [
        (Reply(True, bytes(64)), "success, 64 octets"),
        (Reply(True), "success, 0 octets"),
        (Reply(False, b"\x11"), "refusal 17 (busy)"),
        (Reply(False, b"\x12"), "refusal 18 (no such teds)"),
        (Reply(False, b"\xc8"), "refusal 200"),
        (Reply(False, b"\xc8\0"), "a refusal of 2 octets"),
        (Reply(False), "a refusal of 0 octets"),
    ],
)
def test_an_answer_is_described_with_its_command(reply: Reply, words: str) -> None:
    assert describe_answer(Command(0, 128, 8, bytes(31)), reply) == f"reply to Prove (128.8): {words}"


def test_what_was_begun_of_a_message_is_dropped_with_its_link() -> None:
    assembly = StreamAssembly(10, fd=False)
    assert assembly.add_segment(0, bytes(8)) is None
    assembly.forget()
    assert assembly.add_segment(1, bytes(2)) is None, "its beginning is gone"
    assert (assembly.broken, assembly.wrong) == (0, 0), "and it counts as no fault of the bus"
    assert assembly.add_segment(0, bytes(8)) is None
    assert assembly.add_segment(1, b"ab") == bytes(8) + b"ab"


@pytest.mark.parametrize(
    ("layout", "payload", "values", "findings"),
    [
        ("level:f32", "3fc00000", [1.5], []),
        ("level:f32", "3fc000", [b"\x3f\xc0\0"], ["argument-cut"]),
        ("count:u16 ids:uuids", "0002" + "11" * 16 + "22" * 16, [2, (b"\x11" * 16, b"\x22" * 16)], []),
        ("count:u16 ids:uuids last:u8", "0001" + "11" * 16 + "07", [1, (b"\x11" * 16,), 7], []),
        ("count:u16 ids:uuids", "0002" + "11" * 16, [2, (b"\x11" * 16,)], ["argument-cut"]),
        ("count:u16 names:texts last:u8", "0002" + "610062620007", [2, ("a", "bb"), 7], []),
        ("name:text last:u8", "61620007", ["ab", 7], []),
        ("last:u8", "0708", [7, b"\x08"], ["argument-rest"]),
    ],
)
def test_arguments_one_after_the_other(layout: str, payload: str, values: list[Any], findings: list[str]) -> None:
    arguments, found = read_plain(bytes.fromhex(payload), layout, 6)
    assert [argument.value for argument in arguments] == values
    assert [finding.code for finding in found] == findings


@pytest.mark.parametrize(
    ("kind", "value"),
    [("u8", "x"), ("u8", None), ("u8", 256), ("u8", -1), ("f32", "x"), ("f32", 1e39), ("time", 5), ("duration", None),
     ("duration", 1e300), ("text", 5), ("text", "a\0"), ("octets", "text"), ("octets", 5), ("o16", b"short"),
     ("uuids", (1,)), ("u16s", (65_536,)), ("texts", 7)],
)  # fmt: skip
def test_a_value_that_fits_no_argument_is_named(kind: str, value: Any) -> None:
    with pytest.raises(BadDataError) as no:
        write_plain(f"it:{kind}", {"it": value}, of="Read")
    assert no.value.message == f"The argument 'it' of Read does not fit {kind}: {value!r}."


def test_of_arguments_that_are_not_known_the_first_by_its_name_is_named() -> None:
    for number in range(10):
        values = {f"{letter}{number}": 1 for letter in "zyxabc"}
        with pytest.raises(BadDataError, match=f"Read has no argument 'a{number}'"):
            write_plain("it:u8", {"it": 1, **values}, of="Read")


def test_a_text_of_a_message_holds_no_nul() -> None:
    assert _octets("texts", ("a", "bé")).hex() == "610062c3a900"
    with pytest.raises(ValueError, match="a text ends at its first NUL"):
        _octets("texts", ("a", "b\0c"))


def test_a_proof_under_another_key_than_that_of_the_datasheet_is_checked_under_its_own() -> None:
    """Whose key it is, is a fault of its own; the board has signed these facts all the same."""
    board, shown = SoftwareKey(901), SoftwareKey(904)
    for signer, good in ((board, True), (shown, False)):
        evidence: Any = SimpleNamespace(
            uuid=UUID, station=KEY.point, payload=b"", signature=b"", node=board.point, proof=signer.sign(b"board"),
            verdict="failed",
        )  # fmt: skip
        teds: Any = SimpleNamespace(node_key=shown.point, node_key_signature=bytes(64), station_key=None)
        checked = CheckedEvidence(evidence, teds, "", b"", b"board")
        assert check_signatures(checked) == Signatures(False, False, None, good)


@pytest.mark.parametrize(
    ("roles", "read"),
    [(["line", "keeper"], {"line", "keeper"}), (["line", "later"], {"line"}), (["later"], {"audit"}), ([], {"audit"})],
)
def test_roles_of_a_later_version_are_passed_over(roles: list[str], read: set[str]) -> None:
    assert _roles(Fields({"roles": roles}, "It")) == read


@pytest.mark.parametrize("roles", [["line", 1], [None], [["line"]]])
def test_roles_are_words(roles: list[object]) -> None:
    with pytest.raises(BadDataError, match="roles is no list of words"):
        _roles(Fields({"roles": roles}, "It"))


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("2026-01-31T12:00:00Z", "2026-01-31T12:00:00Z"),
        ("2026-01-31t14:00:00.5+02:00", "2026-01-31T12:00:00Z"),
        ("0001-01-01T00:00:00+23:59", None),  # before the first year
        ("9999-12-31T23:59:59-23:59", None),
        ("2026-02-30T00:00:00Z", None),
    ],
)
def test_a_time_of_a_document_is_one_of_the_years_1_to_9999(text: str, read: str | None) -> None:
    members = strict_json.Members({"created": text}, "It")
    if read is not None:
        assert strict_json.time_text(members.time("created")) == read
        return
    with pytest.raises(BadDataError, match="created is no RFC 3339 time"):
        members.time("created")


@pytest.mark.parametrize(
    "octets", [b"", b"\0\0\0", b"\0\0\0\1", b"\0\0\0\1" + bytes(7), b"\0\0\0\1" + bytes(40), bytes(70_000)]
)
def test_octets_that_hold_no_good_tag_open_nothing(octets: bytes) -> None:
    assert DatagramSealer(bytes(16)).open(octets) is None
    assert _decrypt(bytes(16), octets) is None
