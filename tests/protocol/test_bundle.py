"""A handover bundle: what comes out is what went in, and everything else is refused for one clear cause."""

from __future__ import annotations

import json
import tracemalloc
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import (
    CLOCK_TOLERANCE,
    TYPE,
    BundledNode,
    _NodeWriter,
    check_rules,
    open_bundle,
    peek_bundle,
    seal_bundle,
)
from teds_provision.protocol.handover.revocation import seal_revocation
from teds_provision.protocol.handover.strict_json import LAST_U32, dump, encode_base64url
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from tests.protocol.handover_parts import (
    NODE_KEY,
    NOW,
    OWNER,
    RECEIVER,
    SENDER,
    STRANGER,
    THIRD,
    bundle,
    members_of,
    node,
    sealed,
    sealed_jws,
    trusts,
)


def opened(octets, *, by=RECEIVER, trusted=None, now=NOW, **options):
    return open_bundle(octets, by, trusted or trusts(SENDER), now, **options)


@pytest.mark.parametrize("count", [0, 1, 1000])
def test_a_bundle_comes_out_as_it_went_in(count):
    made = bundle(count)
    octets = seal_bundle(made, SENDER, [RECEIVER.point])
    found = opened(octets)
    assert found.bundle == made
    assert found.sender_key == SENDER.point
    assert found.station_signature == made.station_signatures[fingerprint(RECEIVER.point)]


@pytest.mark.slow
def test_ten_thousand_nodes_need_memory_in_proportion_to_the_file():
    made = bundle(10_000)
    octets, sealing = peak_of(lambda: seal_bundle(made, SENDER, [RECEIVER.point]))
    found, opening = peak_of(lambda: opened(octets))
    assert found.bundle.nodes == made.nodes
    assert sealing < 6 * len(octets)
    assert opening < 6 * len(octets)


def peak_of(run):
    tracemalloc.start()
    try:
        return run(), tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def test_every_receiver_opens_the_same_bundle():
    made = bundle(3, to=(RECEIVER, THIRD))
    octets = seal_bundle(made, SENDER, [RECEIVER.point, THIRD.point])
    assert opened(octets).bundle == opened(octets, by=THIRD).bundle == made


def test_the_clear_part_holds_no_payload():
    made = bundle(1)
    octets = seal_bundle(made, SENDER, [RECEIVER.point])
    header = peek_bundle(octets)
    assert (header.algorithm, header.encryption, header.content_type) == ("ECDH-ES+A256KW", "A256GCM", "JWS")
    assert header.recipients == (fingerprint(RECEIVER.point),)
    for secret in (made.sender.encode(), b"finger", encode_base64url(made.nodes[0].key).encode(), b"uuid"):
        assert secret not in octets


def test_no_link_key_is_in_a_repr():
    made = bundle(1, nodes=(node(key=bytes(range(16))),))
    assert repr(bytes(range(16))) not in repr(opened(seal_bundle(made, SENDER, [RECEIVER.point])))


def test_a_station_outside_the_recipients_is_told_so():
    octets = seal_bundle(bundle(), SENDER, [RECEIVER.point])
    with pytest.raises(PolicyError, match="not sealed for this station"):
        opened(octets, by=THIRD)


def test_a_payload_that_names_another_receiver_than_the_seal_is_refused():
    members = members_of(bundle())
    members["to"] = [fingerprint(THIRD.point)]
    with pytest.raises(PolicyError, match="does not name this station"):
        opened(sealed(members))


def test_an_unknown_sender_is_refused_before_the_payload_is_read():
    with pytest.raises(NotAuthenticError, match="not trusted here"):
        opened(sealed(b"not even JSON", sender=STRANGER))


def test_a_sender_that_claims_a_trusted_name_is_refused():
    header = {"alg": "ES256", "kid": fingerprint(SENDER.point), "typ": TYPE}
    with pytest.raises(NotAuthenticError, match="signature does not verify"):
        opened(sealed_jws(header, dump(members_of(bundle())), signer=STRANGER))


def test_a_trust_store_that_gives_the_wrong_key_is_not_believed():
    octets = seal_bundle(bundle(), SENDER, [RECEIVER.point])
    with pytest.raises(NotAuthenticError, match="not trusted here"):
        opened(octets, trusted=lambda _: STRANGER.point)


def test_from_must_be_the_signer():
    members = members_of(bundle())
    members["from"] = fingerprint(THIRD.point)
    with pytest.raises(NotAuthenticError, match="another sender"):
        opened(sealed(members))


def test_expiry_and_a_date_in_the_future():
    made = bundle()
    octets = seal_bundle(made, SENDER, [RECEIVER.point])
    assert opened(octets, now=made.expires - timedelta(seconds=1)).bundle == made
    with pytest.raises(PolicyError, match="expired"):
        opened(octets, now=made.expires)
    assert opened(octets, now=made.created - CLOCK_TOLERANCE).bundle == made
    with pytest.raises(PolicyError, match="future"):
        opened(octets, now=made.created - CLOCK_TOLERANCE - timedelta(seconds=1))


def test_a_move_has_one_receiver():
    with pytest.raises(PolicyError, match="exactly one"):
        seal_bundle(bundle(to=(RECEIVER, THIRD), mode="move"), SENDER, [RECEIVER.point, THIRD.point])
    members = members_of(bundle(mode="move"))
    members["to"].append(fingerprint(THIRD.point))
    with pytest.raises(PolicyError, match="exactly one"):
        opened(sealed(members))
    assert opened(seal_bundle(bundle(mode="move"), SENDER, [RECEIVER.point])).bundle.mode == "move"


@pytest.mark.parametrize("to", [(), (RECEIVER, THIRD)])
def test_a_move_to_none_or_to_two_counts_its_receivers(to):
    with pytest.raises(PolicyError) as no:
        check_rules(bundle(to=to, mode="move"))
    assert no.value.message == f"A move has exactly one receiver, this one {len(to)}."


def test_a_station_signature_of_another_ca_is_refused():
    members = members_of(bundle())
    wrong = STRANGER.sign(station_key_message(RECEIVER.point))
    members["station_signatures"] = {fingerprint(RECEIVER.point): encode_base64url(wrong)}
    with pytest.raises(NotAuthenticError, match="CA's signature"):
        opened(sealed(members))
    made = bundle(station_signatures={fingerprint(RECEIVER.point): wrong})
    with pytest.raises(NotAuthenticError, match="CA's signature"):
        seal_bundle(made, SENDER, [RECEIVER.point])


def test_a_receiver_that_is_certified_already_needs_no_signature():
    assert opened(seal_bundle(bundle(station_signatures={}), SENDER, [RECEIVER.point])).station_signature is None


def bent(name, value):
    """Return the members of a good bundle with one of them, by its path, changed or (Ellipsis) taken away."""
    members = members_of(bundle(2))
    *path, last = name.split(".")
    place = members
    for part in path:
        place = place[int(part) if part.isdigit() else part]
    if value is ...:
        del place[last]
    else:
        place[int(last) if last.isdigit() else last] = value
    return members


P384 = {"kty": "EC", "crv": "P-384", "x": "A" * 64, "y": "A" * 64}
RSA = {"kty": "RSA", "n": "AQAB", "e": "AQAB"}
PRIVATE = {"kty": "EC", "crv": "P-256", "x": "A" * 43, "y": "A" * 43, "d": "A" * 43}
OFF_CURVE = {"kty": "EC", "crv": "P-256", "x": encode_base64url(bytes(31) + b"\5"), "y": encode_base64url(bytes(32))}


@pytest.mark.parametrize(
    ("name", "value", "cause"),
    [
        ("format", "teds-handover/2", "format is not"),
        ("id", ..., "UUIDv4"),
        ("id", "3d1a4d1c-52c4-1d0b-9d3c-0c8f4bd5a7f1", "UUIDv4"),
        ("id", "3d1a4d1c52c44d0b9d3c0c8f4bd5a7f1", "UUIDv4"),
        ("from", "ab", "from is no SHA-256"),
        ("to", [], "names no receiver"),
        ("to", [fingerprint(RECEIVER.point)] * 2, "each once"),
        ("to", "abc", "to is no list"),
        ("created", 1772366400, "RFC 3339"),
        ("created", "2026-02-30T00:00:00Z", "RFC 3339"),
        ("expires", "tomorrow", "RFC 3339"),
        ("expires", "2020-01-01T00:00:00Z", "before it was made"),
        ("mode", "lend", "neither copy nor move"),
        ("ca", P384, "not a P-256 key"),
        ("ca", RSA, "not a P-256 key"),
        ("ca", PRIVATE, "private or secret key"),
        ("ca", None, "not a JSON Web Key"),
        ("station_signatures", [], "not an object"),
        ("station_signatures", {"me": "AA"}, "list of fingerprints"),
        ("count", 1, "says that it holds 1"),
        ("count", 3, "says that it holds 3"),
        ("count", True, "no integer"),
        ("count", 2.0, "no integer"),
        ("nodes", {}, "nodes is no list"),
        ("nodes.1.uuid", "00" * 9 + "01", "UUID twice"),
        ("nodes.0.uuid", "00" * 9, "20 hex digits"),
        ("nodes.0.uuid", "00" * 16, "20 hex digits"),
        ("nodes.0.node_public_key", P384, "not a P-256 key"),
        ("nodes.0.node_public_key", PRIVATE, "private or secret key"),
        ("nodes.0.node_public_key", OFF_CURVE, "not a point"),
        ("nodes.0.key", {"kty": "EC"}, "not a symmetric"),
        ("nodes.0.key.k", "AAAA", "a link key has 16"),
        ("nodes.0.key.k", "A" * 21 + "B", "spare bits"),
        ("nodes.0.key.k", "A" * 22 + "==", "without padding"),
        ("nodes.0.key.kid", ..., "no kid"),
        ("nodes.0.epoch", 0, "epoch is no integer"),
        ("nodes.0.epoch", 1 << 32, "epoch is no integer"),
        ("nodes.0.epoch", "3", "epoch is no integer"),
        ("nodes.0.sequence", -1, "sequence is no integer"),
        ("nodes.0.sequence", ..., "sequence is no integer"),
        ("nodes.0.name", "\x1b[2J", "no printable text"),
        ("nodes.0.name", "\ud800", "no printable text"),
        ("nodes.0.groups", "left", "groups is no list"),
        ("nodes.0.groups", [1], "no printable text"),
        ("nodes.0.teds_sha256", "abcd", "64 hex digits"),
        ("nodes.0", None, "not an object"),
        ("revoked", ["x"], "three parts"),
        ("revoked", [7], "not a compact JWS"),
    ],
)
def test_a_member_that_is_wrong_is_named(name, value, cause):
    payload = json.dumps(bent(name, value)).encode()
    with pytest.raises(BadDataError, match=cause):
        opened(sealed(payload))


def test_a_key_under_another_keys_id_is_not_authentic():
    with pytest.raises(NotAuthenticError, match="kid is not that"):
        opened(sealed(bent("nodes.0.key.kid", "00" * 8)))


def test_the_first_node_that_cannot_be_taken_is_named_by_its_number():
    for path, kind in (("nodes.1.key.kid", NotAuthenticError), ("nodes.1.epoch", BadDataError)):
        members = bent(path, "00" * 8)
        members["nodes"][0]["key"]["kid"] = members["nodes"][0]["key"]["kid"].upper()
        with pytest.raises(kind) as no:
            opened(sealed(members))
        assert no.value.message.startswith("Node 2 of the bundle cannot be taken. ")


@pytest.mark.parametrize(
    "payload",
    [b"", b"[]", b"null", b"{", b'{"a":1}x', b"\xff\xfe", b'{"format":NaN}', b"[" * 100_000, b'{"a":1,"a":1}'],
)
def test_a_payload_that_is_no_object_is_refused(payload):
    with pytest.raises(BadDataError):
        opened(sealed(payload))


def test_a_name_given_twice_is_refused_at_any_depth():
    payload = dump(members_of(bundle())).replace(b'"epoch":3', b'"epoch":9,"epoch":3')
    with pytest.raises(BadDataError, match="twice"):
        opened(sealed(payload))


def test_members_that_are_not_known_are_passed_over_and_null_is_absent():
    made = bundle(1)
    members = members_of(made)
    members["later"] = {"a": [1]}
    members["nodes"][0]["colour"] = "red"
    members["ca"]["kid"] = "owner"
    for name in ("profile", "name", "teds_sha256"):
        del members["nodes"][0][name]
    found = opened(sealed(members)).bundle
    assert found.nodes == (replace(made.nodes[0], profile=None, name=None, teds_sha256=None),)


def test_hex_may_stand_in_either_case():
    members = members_of(bundle())
    members["from"] = members["from"].upper()
    members["nodes"][0]["key"]["kid"] = members["nodes"][0]["key"]["kid"].upper()
    assert opened(sealed(members)).bundle == bundle()


@pytest.mark.parametrize(
    "wrong",
    [
        {"sender": fingerprint(THIRD.point)},
        {"to": (fingerprint(THIRD.point),)},
        {"to": ()},
        {"expires": NOW - timedelta(days=9)},
        {"nodes": (node(1), node(1))},
        {"nodes": (node(epoch=0),)},
        {"nodes": (node(sequence=1 << 32),)},
        {"nodes": (node(key=bytes(15)),)},
        {"nodes": (node(uuid=bytes(9)),)},
        {"nodes": (node(name="a\nb"),)},
    ],
)
def test_a_bundle_without_a_recipient_that_could_open_it_is_not_sealed(wrong):
    with pytest.raises(BadDataError):
        seal_bundle(replace(bundle(), **wrong), SENDER, [RECEIVER.point])


def test_a_recipient_that_is_no_point_is_refused():
    with pytest.raises(BadDataError, match="recipient's key"):
        seal_bundle(bundle(), SENDER, [b"\x04" + bytes(64)])


def test_the_deny_list_travels_and_strangers_on_it_are_only_counted():
    mine = seal_revocation(SENDER, uuid=bytes(10), node=fingerprint(NODE_KEY), why="lost", created=NOW)
    theirs = seal_revocation(STRANGER, uuid=bytes(10), node=None, why="stolen", created=NOW)
    made = bundle(revoked=(mine.statement, theirs.statement))
    found = opened(seal_bundle(made, SENDER, [RECEIVER.point]))
    assert found.revocations == (mine,)
    assert found.unknown_revocations == 1
    both = opened(seal_bundle(made, SENDER, [RECEIVER.point]), trusted=trusts(SENDER, STRANGER))
    assert both.revocations == (mine, theirs)


def test_a_forged_statement_of_a_trusted_signer_spoils_the_bundle():
    mine = seal_revocation(SENDER, uuid=bytes(10), node=None, why="lost", created=NOW).statement
    other = seal_revocation(SENDER, uuid=b"\1" * 10, node=None, why="lost", created=NOW).statement
    forged = mine.rsplit(".", 1)[0] + "." + other.rsplit(".", 1)[1]
    with pytest.raises(NotAuthenticError, match="signature does not verify"):
        opened(seal_bundle(bundle(revoked=(forged,)), SENDER, [RECEIVER.point]))


def test_what_is_too_large_is_refused_unread():
    junk = b"{" * (100 << 20)
    tracemalloc.start()
    try:
        for read in (opened, peek_bundle):
            with pytest.raises(BadDataError, match=r"at most [0-9]+ are read"):
                read(junk)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_a_flood_of_tiny_values_within_the_limit_is_refused_unparsed():
    junk = b'{"recipients":[' + b"[]," * (20 << 20) + b"0]}"
    tracemalloc.start()
    try:
        with pytest.raises(BadDataError, match="far more members"):
            opened(junk)
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()


def test_another_signed_document_of_the_sender_is_no_bundle():
    with pytest.raises(BadDataError, match="not teds-handover"):
        opened(sealed(members_of(bundle()), typ="teds-receipt+jws"))


def test_a_bundle_sealed_by_hand_with_a_key_of_no_station_opens_only_in_its_name():
    outsider = SoftwareKey(77)
    octets = jose.encrypt(
        jose.sign_compact(dump(members_of(bundle())), outsider, typ=TYPE), [RECEIVER.point], cty="JWS"
    )
    with pytest.raises(NotAuthenticError):
        opened(octets)
    assert OWNER.point == opened(seal_bundle(bundle(), SENDER, [RECEIVER.point])).bundle.ca


@given(
    st.lists(st.text(st.characters(blacklist_categories=("Cs", "Cc", "Cf", "Zl", "Zp")), max_size=20), min_size=3),
    st.integers(1, LAST_U32),
    st.binary(min_size=64, max_size=64),
    st.binary(min_size=16, max_size=16),
)
def test_a_node_written_by_hand_is_the_json_that_an_encoder_gives(
    texts: list[str], epoch: int, point: bytes, key: bytes
) -> None:
    profile, name, *groups = texts
    node = BundledNode(bytes(10), b"\x04" + point, key, epoch, 7, profile, name, tuple(groups), None)
    writer = _NodeWriter()
    written = writer.to_json(node)
    assert writer.to_json(node) == written, "also with labels that it has seen"
    members = json.loads(written)
    assert json.dumps(members, separators=(",", ":")) == written
    assert (members["profile"], members["name"], members["groups"]) == (profile, name, groups)
    assert (members["epoch"], members["sequence"], members["teds_sha256"]) == (epoch, 7, None)
    coordinates = {"x": encode_base64url(point[:32]), "y": encode_base64url(point[32:])}
    assert members["node_public_key"] == {"kty": "EC", "crv": "P-256", **coordinates}
    assert members["key"] == {"kty": "oct", "k": encode_base64url(key), "kid": node.kid}


LAST = 0xFFFFFFFF


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"expires": NOW - timedelta(hours=1)}, "expires before it was made"),  # the very moment
        ({"expires": NOW - timedelta(minutes=59)}, None),
        ({"nodes": (node(epoch=LAST, sequence=LAST),)}, None),
        ({"nodes": (node(epoch=1, sequence=0),)}, None),
        ({"nodes": (node(epoch=0),)}, "out of its range"),
        ({"nodes": (node(epoch=LAST + 1),)}, "out of its range"),
        ({"nodes": (node(sequence=LAST + 1),)}, "out of its range"),
        ({"nodes": (node(sequence=-1),)}, "out of its range"),
        ({"nodes": (node(name="x" * 1024),)}, None),
        ({"nodes": (node(name="x" * 1025),)}, "out of its range"),
        ({"nodes": (node(groups=("a", "two\nlines")),)}, "out of its range"),
        ({"nodes": (node(profile="\x1b"),)}, "out of its range"),
        ({"nodes": (node(), node(2, groups=("a\tb",)))}, "out of its range"),
        ({"nodes": (node(), node(2, profile=None), node(3, profile=None, groups=()))}, None),
        ({"nodes": (node(uuid=bytes(9)),)}, "out of its range"),
        ({"nodes": (node(node_key=bytes(64)),)}, "out of its range"),
        ({"nodes": (node(key=bytes(15)),)}, "out of its range"),
        ({"nodes": (node(), node())}, "names an UUID twice"),
    ],
)
def test_what_a_sender_seals_at_its_edges(changes: dict[str, Any], why: str | None) -> None:
    made = bundle(**changes)
    if why is None:
        opened = open_bundle(seal_bundle(made, SENDER, [RECEIVER.point]), RECEIVER, trusts(SENDER), None)
        assert opened.bundle.nodes == made.nodes
        return
    with pytest.raises(BadDataError, match=why):
        seal_bundle(made, SENDER, [RECEIVER.point])


@pytest.mark.parametrize(
    ("named", "sealed_to"),
    [((RECEIVER,), (RECEIVER, THIRD)), ((RECEIVER, THIRD), (RECEIVER,)), ((RECEIVER,), (THIRD,)),
     ((RECEIVER,), (RECEIVER, RECEIVER))],
)  # fmt: skip
def test_a_bundle_is_sealed_to_those_that_it_names_and_no_others(
    named: tuple[SoftwareKey, ...], sealed_to: tuple[SoftwareKey, ...]
) -> None:
    with pytest.raises(BadDataError, match="other recipients"):
        seal_bundle(bundle(to=named), SENDER, [station.point for station in sealed_to])
