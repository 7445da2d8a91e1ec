"""The JOSE layer: known answers of the RFCs, forms, and what a header may not ask for."""

from __future__ import annotations

import json
from contextlib import suppress
from hashlib import sha256

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import TYPE, open_bundle
from teds_provision.protocol.handover.jose import link_key_of, point_of, public_jwk
from teds_provision.protocol.handover.strict_json import base64url, decode_base64url, dump, encode_base64url
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey, fingerprint, is_point
from tests.protocol.handover_parts import LIMIT, NOW, RECEIVER, SENDER, STRANGER, THIRD, sealed_jws, trusts

PAYLOAD = b"It\xe2\x80\x99s a dangerous business, Frodo, going out your door."


def verified(octets, trusted=None):
    return jose.verify_compact(octets, trusted or trusts(SENDER), typ="note", max_octets=LIMIT)


def signed(header, payload=PAYLOAD, signer=SENDER):
    message = base64url(dump(header)) + b"." + base64url(payload)
    return message + b"." + base64url(signer.sign(message))


def header(**changes):
    return {"alg": "ES256", "kid": fingerprint(SENDER.point), "typ": "note"} | changes


# Known answers


def test_es256_of_rfc_7515_appendix_a3_verifies():
    jwk = {
        "kty": "EC",
        "crv": "P-256",
        "x": "f83OJ3D2xF1Bg8vub9tLe1gHMzV76e8Tus9uPHvRVEU",
        "y": "x_FEzRu9m36HLN_tue659LNpXW6pCyStikYjKIWI5a0",
    }
    token = (
        b"eyJhbGciOiJFUzI1NiJ9.eyJpc3MiOiJqb2UiLA0KICJleHAiOjEzMDA4MTkzODAsDQogImh0dHA6Ly9leGFtcGxlLmNvbS9pc19yb290"
        b"Ijp0cnVlfQ.DtEhU3ljbEg8L38VWAfUAqOyKAM6-Xx-F4GawxaepmXFCgfTjDxw5djxLa8ISlSApmWQxfKTUJqPP3-Kg6NU1Q"
    )
    message, _, signature = token.rpartition(b".")
    raw = decode_base64url(signature, "the signature")
    assert jose._es256_good(point_of(jwk, "the key"), sha256(message).digest(), raw)
    assert int.from_bytes(raw[32:], "big") > GROUP_ORDER // 2, "the vector's s is high, and JOSE accepts it"
    assert not jose._es256_good(point_of(jwk, "the key"), sha256(message + b"A").digest(), raw)


def test_the_key_derivation_of_rfc_7518_appendix_c(monkeypatch):
    shared = bytes.fromhex("9e56d91d817135d372834283bf84269cfb316ea3da806a48f6daa7798cfe90c4")
    monkeypatch.setattr(jose, "KEY_ALGORITHM", "A128GCM")
    monkeypatch.setattr(jose, "_KEY_OCTETS", 16)
    assert encode_base64url(jose._wrapping_key(shared, b"Alice", b"Bob")) == "VqqN6vgjbSBcIijNcacQGg"


def test_base64url_of_rfc_7515_appendix_c():
    assert encode_base64url(bytes([3, 236, 255, 224, 193])) == "A-z_4ME"


@pytest.mark.parametrize("text", ["A", "AA==", "AB", "AAB", "A+__", "A/__", "AA A", "AA\n", "é", "AAAAA", "=", "*AAA"])
def test_base64url_has_one_spelling(text):
    with pytest.raises(BadDataError):
        decode_base64url(text, "it")


@settings(deadline=None)
@given(st.binary(max_size=80))
def test_base64url_round_trip(octets):
    assert decode_base64url(encode_base64url(octets), "it") == decode_base64url(base64url(octets), "it") == octets


@settings(deadline=None)
@given(st.text(alphabet="ABQgw09-_+/= ", max_size=12))
def test_what_decodes_encodes_to_the_same(text):
    try:
        octets = decode_base64url(text, "it")
    except BadDataError:
        return
    assert encode_base64url(octets) == text


@settings(deadline=None)
@given(st.binary(min_size=64, max_size=64))
def test_the_test_of_the_curve_agrees_with_the_library(octets):
    for point in (b"\x04" + octets, SoftwareKey(1 + octets[0]).point):
        try:
            found = point_of(public_jwk(point), "it")
        except BadDataError:
            assert not is_point(point)
        else:
            assert found == point
            assert is_point(point)


# JWS


def test_a_signed_document_comes_out_with_its_signer():
    found = verified(jose.sign_compact(PAYLOAD, SENDER, typ="note"))
    assert (found.kid, found.signer, found.payload) == (fingerprint(SENDER.point), SENDER.point, PAYLOAD)
    assert b"Frodo" not in repr(found).encode()


def test_either_s_is_accepted():
    token = jose.sign_compact(PAYLOAD, SENDER, typ="note")
    message, _, signature = token.rpartition(b".")
    raw = decode_base64url(signature, "it")
    high = raw[:32] + (GROUP_ORDER - int.from_bytes(raw[32:], "big")).to_bytes(32, "big")
    assert verified(message + b"." + base64url(high)).payload == PAYLOAD


@pytest.mark.parametrize("raw", [b"", bytes(64), b"\xff" * 64, bytes(63), bytes(65), bytes(31) + b"\1" + bytes(32)])
def test_signatures_out_of_range_do_not_verify(raw):
    message = jose.sign_compact(PAYLOAD, SENDER, typ="note").rpartition(b".")[0]
    with pytest.raises(NotAuthenticError):
        verified(message + b"." + base64url(raw))


@pytest.mark.parametrize(
    "algorithm", ["none", "None", "HS256", "RS256", "PS256", "ES384", "ES256K", "EdDSA", "", None, 7, []]
)
def test_no_other_signature_algorithm(algorithm):
    with pytest.raises(PolicyError, match="signature algorithm"):
        verified(signed(header(alg=algorithm)))


def test_an_unsigned_document_is_refused():
    message = base64url(dump(header(alg="none"))) + b"." + base64url(PAYLOAD) + b"."
    with pytest.raises(PolicyError):
        verified(message)
    with pytest.raises(NotAuthenticError):
        verified(base64url(dump(header())) + b"." + base64url(PAYLOAD) + b".")


def test_a_public_key_as_hmac_secret_is_refused():
    import hmac

    message = base64url(dump(header(alg="HS256"))) + b"." + base64url(PAYLOAD)
    forged = message + b"." + base64url(hmac.digest(SENDER.point, message, "sha256"))
    with pytest.raises(PolicyError):
        verified(forged)


@pytest.mark.parametrize(
    "extension", [{"crit": ["exp"], "exp": 1}, {"crit": []}, {"b64": False, "crit": ["b64"]}, {"zip": "DEF"}]
)
def test_nothing_critical_is_accepted(extension):
    with pytest.raises(PolicyError, match="is not accepted"):
        verified(signed(header(**extension)))


def test_a_key_inside_the_header_is_not_trusted():
    with pytest.raises(NotAuthenticError, match="not trusted here"):
        verified(signed(header(kid=fingerprint(STRANGER.point), jwk=public_jwk(STRANGER.point)), signer=STRANGER))
    with pytest.raises(NotAuthenticError, match="does not verify"):
        verified(signed(header(jwk=public_jwk(STRANGER.point)), signer=STRANGER))


@pytest.mark.parametrize("kid", [None, 7, "", "../../etc/passwd"])
def test_a_signer_without_a_name_is_refused(kid):
    with pytest.raises((BadDataError, NotAuthenticError)):
        verified(signed(header(kid=kid)))


@pytest.mark.parametrize("typ", ["application/note", "NOTE", "note"])
def test_the_type_as_rfc_7515_spells_it(typ):
    assert verified(signed(header(typ=typ))).payload == PAYLOAD


@pytest.mark.parametrize("typ", ["other", None, 7, ""])
def test_another_type_is_refused(typ):
    with pytest.raises(BadDataError, match="not note"):
        verified(signed(header(typ=typ)))


def test_a_name_twice_in_the_header_is_refused():
    twice = b'{"alg":"none","alg":"ES256","kid":"x","typ":"note"}'
    with pytest.raises(BadDataError, match="twice"):
        verified(base64url(twice) + b".AA.AA")


@pytest.mark.parametrize(
    "token", [b"", b".", b"..", b"...", b"a.b.c.d", b"\xff.\xff.\xff", b"e30.e30", b"{}", b"W10.AA.AA"]
)
def test_what_is_no_compact_jws(token):
    with pytest.raises((BadDataError, PolicyError)):
        verified(token)


def test_a_long_header_and_a_long_document_are_refused_unread():
    with pytest.raises(BadDataError, match="longer than"):
        verified(signed(header(pad="x" * 9000)))
    with pytest.raises(BadDataError, match=r"at most [0-9]+ are read"):
        verified(b"a" * (LIMIT + 1))


# JWE


def opened(octets, key=RECEIVER):
    return jose.decrypt(octets, key, cty="JWS", max_octets=LIMIT)


def jwe(**changes):
    """Return the members of a good JWE, some of them changed or (Ellipsis) taken away."""
    members = json.loads(jose.encrypt(PAYLOAD, [RECEIVER.point], cty="JWS")) | changes
    return {name: value for name, value in members.items() if value is not ...}


def protected(**changes):
    """Return a JWE with other protected members. The tag no longer fits; what is refused must be so before."""
    inside = {"alg": "ECDH-ES+A256KW", "enc": "A256GCM", "cty": "JWS"} | changes
    return dump(jwe(protected=encode_base64url(dump({k: v for k, v in inside.items() if v is not ...}))))


@pytest.mark.parametrize("receivers", [1, 2, 50])
def test_only_recipients_can_open_it(receivers):
    keys = [SoftwareKey(1000 + number) for number in range(receivers)]
    octets = jose.encrypt(PAYLOAD, [key.point for key in keys], cty="JWS")
    header = jose.read_header(octets, max_octets=LIMIT)
    assert (header.algorithm, header.encryption, header.content_type) == ("ECDH-ES+A256KW", "A256GCM", "JWS")
    assert header.recipients == tuple(fingerprint(key.point) for key in keys)
    assert all(opened(octets, key) == PAYLOAD for key in keys)
    with pytest.raises(PolicyError, match="not sealed for this station"):
        opened(octets, STRANGER)


def test_two_seals_share_no_key_and_no_nonce():
    first, second = jwe(), jwe()
    for name in ("iv", "ciphertext", "tag"):
        assert first[name] != second[name]
    assert first["recipients"][0]["header"]["epk"] != second["recipients"][0]["header"]["epk"]


def test_the_flattened_form_of_one_recipient_is_read():
    members = jwe()
    entry = members.pop("recipients")[0]
    assert opened(dump(members | entry)) == PAYLOAD
    for own in ({}, {"header": entry["header"]}, {"encrypted_key": entry["encrypted_key"]}):
        both = dump(members | own | {"recipients": [entry]})
        if not own:
            assert opened(both) == PAYLOAD
            continue
        with pytest.raises(BadDataError, match="not in both"):
            opened(both)


def test_a_recipient_without_a_name_is_tried():
    members = jwe()
    members["recipients"][0]["header"].pop("kid")
    assert opened(dump(members)) == PAYLOAD
    with pytest.raises(NotAuthenticError, match="does not open"):
        opened(dump(members), STRANGER)


def test_no_other_recipient_count():
    with pytest.raises(BadDataError):
        jose.encrypt(PAYLOAD, [], cty="JWS")
    with pytest.raises(BadDataError):
        jose.encrypt(PAYLOAD, [RECEIVER.point] * 257, cty="JWS")
    with pytest.raises(BadDataError, match="recipients"):
        opened(dump(jwe(recipients=[])))
    with pytest.raises(BadDataError, match="recipients"):
        opened(dump(jwe(recipients=[{}] * 257)))


@pytest.mark.parametrize(
    "alg", ["none", "dir", "ECDH-ES", "ECDH-ES+A128KW", "RSA-OAEP", "RSA1_5", "A256KW", "PBES2-HS512+A256KW", 5]
)
def test_no_other_key_management(alg):
    with pytest.raises(PolicyError, match="key management"):
        opened(protected(alg=alg))


@pytest.mark.parametrize("enc", ["none", "A128GCM", "A128CBC-HS256", "A256CBC-HS512", "", None])
def test_no_other_content_encryption(enc):
    with pytest.raises(PolicyError, match="content encryption"):
        opened(protected(enc=enc))


@pytest.mark.parametrize("extension", [{"zip": "DEF"}, {"crit": ["x"]}, {"b64": True}])
def test_no_compression_and_nothing_critical(extension):
    with pytest.raises(PolicyError, match="is not accepted"):
        opened(protected(**extension))
    with pytest.raises(PolicyError, match="is not accepted"):
        opened(dump(jwe(unprotected=extension)))


def test_a_compressed_bomb_is_never_inflated():
    import zlib

    bomb = zlib.compress(bytes(50 << 20))[2:-4]
    with pytest.raises(PolicyError, match="zip"):
        opened(dump(jwe(unprotected={"zip": "DEF"}, ciphertext=encode_base64url(bomb))))


@pytest.mark.parametrize("cty", ["JWT", "text/plain", ..., 3])
def test_other_content_is_refused(cty):
    with pytest.raises(BadDataError, match="not JWS"):
        opened(protected(cty=cty))


def test_enc_must_be_protected_and_no_parameter_occurs_twice():
    with pytest.raises(BadDataError, match="no content encryption"):
        opened(protected(enc=...))
    with pytest.raises(BadDataError, match="two headers"):
        opened(dump(jwe(unprotected={"enc": "A256GCM"})))
    with pytest.raises(BadDataError, match="two headers"):
        opened(dump(jwe(unprotected={"kid": "x"})))


P384 = {"kty": "EC", "crv": "P-384", "x": "A" * 64, "y": "A" * 64}
RSA = {"kty": "RSA", "n": "AQAB", "e": "AQAB"}
PRIVATE = public_jwk(THIRD.point) | {"d": encode_base64url(THIRD.secret())}
OFF_CURVE = {"kty": "EC", "crv": "P-256", "x": encode_base64url(b"\1" * 32), "y": encode_base64url(b"\1" * 32)}
ZERO = {"kty": "EC", "crv": "P-256", "x": encode_base64url(bytes(32)), "y": encode_base64url(bytes(32))}
SHORT = public_jwk(THIRD.point) | {"x": "AAAA"}


@pytest.mark.parametrize("epk", [P384, RSA, PRIVATE, OFF_CURVE, ZERO, SHORT, None, "x", [], {}])
def test_a_one_time_key_must_be_a_public_p256_point(epk):
    members = jwe()
    members["recipients"][0]["header"]["epk"] = epk
    with pytest.raises(BadDataError):
        opened(dump(members))


@pytest.mark.parametrize("name", ["iv", "tag", "ciphertext", "protected"])
@pytest.mark.parametrize("value", [..., None, 7, "", "AAAA", "A", "not base64!", {}])
def test_members_of_the_wrong_form(name, value):
    with pytest.raises((BadDataError, NotAuthenticError)):
        opened(dump(jwe(**{name: value})))


def test_a_shortened_tag_is_refused():
    members = jwe()
    short = decode_base64url(members["tag"], "it")[:12]
    with pytest.raises(BadDataError, match="the tag 16"):
        opened(dump(jwe(tag=encode_base64url(short))))


def test_what_is_in_aad_is_authenticated():
    with pytest.raises(NotAuthenticError, match="tag does not fit"):
        opened(dump(jwe(aad="AAAA")))


def test_party_info_enters_the_key():
    with pytest.raises(NotAuthenticError, match="does not open"):
        opened(dump(jwe(unprotected={"apu": "QWxpY2U"})))
    with pytest.raises(BadDataError, match="longer than"):
        opened(dump(jwe(unprotected={"apu": "A" * 400})))


def test_party_info_of_256_octets_is_read_and_no_more():
    for octets, error, says in ((256, NotAuthenticError, "does not open"), (257, BadDataError, "longer than 256")):
        for name in ("apu", "apv"):
            with pytest.raises(error, match=says):
                opened(dump(jwe(unprotected={name: encode_base64url(bytes(octets))})))


@pytest.mark.parametrize("octets", [0, 8, 24, 32, 39, 41, 48])
def test_an_encrypted_key_has_40_octets(octets):
    members = jwe()
    members["recipients"][0]["encrypted_key"] = encode_base64url(bytes(octets))
    with pytest.raises(BadDataError, match=f"encrypted key has {octets} octets, not 40"):
        opened(dump(members))


@pytest.mark.parametrize("cty", ["jws", "Jws"])
def test_the_content_type_counts_in_any_case(cty):
    assert opened(jose.encrypt(PAYLOAD, [RECEIVER.point], cty=cty)) == PAYLOAD
    assert jose.decrypt(dump(jwe()), RECEIVER, cty=cty, max_octets=LIMIT) == PAYLOAD


def test_every_truncation_is_refused():
    octets = jose.encrypt(PAYLOAD, [RECEIVER.point], cty="JWS")
    for length in range(len(octets)):
        with pytest.raises(BadDataError):
            opened(octets[:length])


def test_a_header_that_asks_for_none_inside_a_good_seal():
    with pytest.raises(PolicyError):
        open_bundle(sealed_jws({"alg": "none", "typ": TYPE}), RECEIVER, trusts(SENDER), NOW)


@settings(deadline=None)
@given(st.binary(max_size=200))
def test_any_octets_end_in_a_leaf(octets):
    for read in (opened, verified, lambda junk: jose.read_header(junk, max_octets=LIMIT)):
        with pytest.raises((BadDataError, PolicyError, NotAuthenticError)):
            read(octets)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8) | st.sampled_from(["AAAA", "ES256", "A256GCM"]),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["alg", "epk", "kty", "x", "header"]), inner)
    ),
    max_leaves=8,
)


@settings(deadline=None)
@given(st.dictionaries(st.sampled_from([*jwe(), "aad", "header", "unprotected", "encrypted_key"]), JSON, min_size=1))
def test_members_of_any_type_end_in_a_leaf_or_change_nothing(changes):
    with suppress(BadDataError, PolicyError, NotAuthenticError):
        assert opened(dump(jwe(**changes))) == PAYLOAD


@settings(deadline=None)
@given(JSON)
def test_any_json_where_a_key_belongs(value):
    for read in (point_of, link_key_of):
        with pytest.raises(BadDataError):
            read(value, "it")


def test_a_signature_has_64_octets_and_one_spelling() -> None:
    """A zero before s is the same number, and another document."""
    key = SoftwareKey(81)
    document = jose.sign_compact(b"{}", key, typ="x+jws")
    header, payload, signature = document.split(b".")
    octets = decode_base64url(signature, "The signature")
    for longer in (octets[:32] + b"\0" + octets[32:], b"\0" + octets, octets + b"\0"):
        changed = b".".join([header, payload, base64url(longer)])
        with pytest.raises(NotAuthenticError, match="does not verify"):
            jose.verify_compact(changed, lambda kid: key.point, typ="x+jws", max_octets=4096)
    assert jose.verify_compact(document, lambda kid: key.point, typ="x+jws", max_octets=4096).payload == b"{}"


def test_a_kid_is_the_fingerprint_of_the_key_that_verifies() -> None:
    """A store that gives another key under a name gives nobody that name."""
    key, named = SoftwareKey(81), SoftwareKey(82)
    header = base64url(dump({"alg": "ES256", "kid": fingerprint(named.point), "typ": "x+jws"}))
    message = header + b"." + base64url(b"{}")
    document = message + b"." + base64url(key.sign(message))
    with pytest.raises(NotAuthenticError, match="is not trusted here"):
        jose.verify_compact(document, lambda kid: key.point, typ="x+jws", max_octets=4096)
