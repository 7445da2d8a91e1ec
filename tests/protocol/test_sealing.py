"""A bundle a piece at a time: what a whole reading gives, however the pieces fall, and nothing before its end."""

from __future__ import annotations

import io
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError, TedsProvisionError
from teds_provision.protocol.handover import envelope, jose, strict_json
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from tests.protocol.handover_parts import LIMIT, RECEIVER, SENDER, THIRD, trusts

NOTE = b'{"note": "an iron ring, found beside the river"}'


def seal(payload, receivers=(RECEIVER,)):
    made = envelope.EnvelopeWriter(payload, SENDER, [key.point for key in receivers], typ="note", cty="JWS")
    return b"".join([*made.body(), made.end()]), made


def unseal(octets, key=RECEIVER):
    return envelope.unseal(octets, key, trusts(SENDER), typ="note", cty="JWS", max_octets=LIMIT)


def whole(octets, key=RECEIVER):
    """Return what the reader of whole octets says."""
    signed = jose.decrypt(octets, key, cty="JWS", max_octets=LIMIT)
    return jose.verify_compact(signed, trusts(SENDER), typ="note", max_octets=LIMIT)


def number_of(read, octets):
    """Return what a reader gives: signer and payload, or the kind of its refusal."""
    try:
        found = read(octets)
    except TedsProvisionError as error:
        return type(error)
    return found.kid, bytes(found.payload)


@given(st.lists(st.binary(max_size=200), max_size=6), st.integers(4, 90))
def test_what_was_sealed_in_pieces_is_opened_by_either_reader(pieces, size):
    octets, made = seal(pieces)
    signed = jose.decrypt(octets, RECEIVER, cty="JWS", max_octets=LIMIT)
    assert number_of(whole, octets) == (fingerprint(SENDER.point), b"".join(pieces))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envelope, "PIECE", size)
        found = unseal(io.BytesIO(octets))
    assert bytes(found.payload) == b"".join(pieces)
    assert (found.sha256, found.signed_sha256) == (made.sha256, made.signed_sha256)
    assert envelope.hashlib.sha256(signed).hexdigest() == made.signed_sha256
    assert made.octets == len(octets)


@settings(max_examples=200)
@given(st.data())
def test_both_readers_give_the_same_result_for_a_changed_file(data):
    octets, _ = seal([NOTE * 9])
    at, size = data.draw(st.integers(0, len(octets) - 1)), data.draw(st.sampled_from([16, 33, 64, 4096]))
    change = data.draw(st.sampled_from([b"", b"A", b'"', b"\\", b"\\u0041", b" ", b"\xff", b"}", b"-_-_"]))
    changed = octets[:at] + change + octets[at + data.draw(st.integers(0, 40)) :]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(envelope, "PIECE", size)
        assert number_of(unseal, changed) == number_of(whole, changed)


@pytest.mark.parametrize("size", [16, 64])
def test_a_long_member_beside_the_ciphertext_is_passed_over(size, monkeypatch):
    monkeypatch.setattr(envelope, "PIECE", size)
    members = json.loads(seal([NOTE * 9])[0])
    members.pop("tag"), members.pop("iv")
    with pytest.raises(BadDataError):
        unseal(json.dumps(members).encode())
    members = json.loads(seal([NOTE * 9])[0])
    for changed in ({"comment": "A" * 999} | members, members | {"comment": "A" * 999}):
        assert bytes(unseal(json.dumps(changed).encode()).payload) == NOTE * 9


@pytest.mark.parametrize("size", [16, 64])
def test_an_escape_is_read_at_every_boundary_of_the_pieces(size, monkeypatch):
    monkeypatch.setattr(envelope, "PIECE", size)
    text = seal([NOTE * 9])[0].decode()
    begin = text.index('"ciphertext"') + len('"ciphertext":"') + 1
    for at in range(begin, begin + 2 * size):
        escaped = f"{text[:at]}\\u{ord(text[at]):04x}{text[at + 1 :]}".encode()
        assert number_of(unseal, escaped)[1] == NOTE * 9


@pytest.mark.parametrize("value", [None, 7, [], "", "A", "ü" * 40, "A" * 99, "=" * 64])
def test_a_ciphertext_that_is_none_is_refused(value):
    members = json.loads(seal([NOTE])[0]) | {"ciphertext": value}
    with pytest.raises((BadDataError, NotAuthenticError)):
        unseal(json.dumps(members).encode())


def test_a_bundle_that_is_cut_off_anywhere_is_no_bundle():
    octets, _ = seal([NOTE * 2000])
    for at in (*range(400), *range(400, len(octets), 997), *range(len(octets) - 60, len(octets))):
        with pytest.raises((BadDataError, NotAuthenticError)):
            unseal(octets[:at])


def test_what_was_written_before_the_end_cannot_be_opened():
    made = envelope.EnvelopeWriter([NOTE * 2000], SENDER, [RECEIVER.point], typ="note", cty="JWS")
    body = b"".join(made.body())
    for closed in (body, body + b'"}', body + b'","tag":"' + strict_json.base64url(bytes(16)) + b'"}'):
        with pytest.raises((BadDataError, NotAuthenticError)):
            unseal(closed)
    assert bytes(unseal(body + made.end()).payload) == NOTE * 2000


def test_a_file_that_changes_while_it_is_read_is_refused(tmp_path):
    path = tmp_path / "bundle"
    path.write_bytes(seal([NOTE * 9000])[0])

    class TurnedFile(io.FileIO):
        """A file in which another process turns one character after it was read once."""

        reads = 0

        def read(self, size=-1):
            self.reads += 1
            piece = super().read(size)
            late = self.reads > 12 and len(piece) > 9
            return piece[:5] + (b"B" if piece[5:6] == b"A" else b"A") + piece[6:] if late else piece

    with TurnedFile(path) as file, pytest.raises(NotAuthenticError):
        unseal(file)


def test_the_tag_is_looked_at_before_anything_that_came_out():
    made = envelope.EnvelopeWriter([NOTE], SENDER, [RECEIVER.point], typ="note", cty="JWS")
    signature_of_other = b"".join([*made.body(), made.end()])
    members = json.loads(signature_of_other)
    text = members["ciphertext"]
    members["ciphertext"] = text[:-8] + ("A" if text[-8] != "A" else "B") + text[-7:]
    with pytest.raises(NotAuthenticError, match="tag does not fit"):
        unseal(json.dumps(members).encode())
    with pytest.raises(PolicyError, match="not sealed for this station"):
        unseal(signature_of_other, THIRD)


def test_a_signed_text_of_another_form_is_no_document(monkeypatch):
    for text in (b"a.b", b"a.b.c.d", b"", b".." * 9000, b"A" * 70000 + b".AA.AA", b"e30.A.AA"):
        sealed = jose.encrypt(text, [RECEIVER.point], cty="JWS")
        assert number_of(unseal, sealed) == number_of(whole, sealed)


@given(st.binary(max_size=300))
def test_a_signature_of_the_digest_is_that_of_the_message(message):
    key = SoftwareKey(0x1F2E3D)
    assert key.sign_digest(envelope.hashlib.sha256(message).digest()) == key.sign(message)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=4), inner, max_size=4),
    max_leaves=12,
)


def long_or_whole(octets, window=5):
    """Return what both readers of JSON say: they agree, or this fails."""
    results = []
    for read in (
        lambda: strict_json.load_object(octets, "It"),
        lambda: strict_json.load_long(bytearray(octets), "It", "nodes", lambda node: node),
    ):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(strict_json, "_WINDOW", window)
            try:
                results.append(read())
            except BadDataError as error:
                results.append(error.message)
    assert results[0] == results[1]
    return results[0]


@given(st.dictionaries(st.text(max_size=4) | st.just("nodes"), JSON, max_size=5), st.sampled_from([None, 1]))
def test_json_read_element_by_element_is_the_same_json(value, indent):
    assert long_or_whole(json.dumps(value, indent=indent).encode()) == value


@pytest.mark.parametrize("window", [1, 2, 3, 64, 1 << 16])
def test_no_value_is_cut_where_the_window_ends(window):
    value = {
        "format": "x",
        "rate": 1.5e-9,
        "nodes": [1234567, 2.25, 1e40, "né\u20ac\U0001f600", {"a": [True, None, -1.5e9]}],
        "count": 31415926,
    }
    for text in (json.dumps(value), json.dumps(value, ensure_ascii=False)):
        assert long_or_whole(text.encode(), window) == value
    for damaged in (text.encode()[:-9], text.encode().replace("€".encode(), b"\xe2\x82"), b"[" + text.encode() + b"]"):
        assert isinstance(long_or_whole(damaged, window), str)


@given(st.text(alphabet='{}[]",:nodes 1\n\\ue', max_size=40).map(lambda text: '{"nodes":' + text))
def test_no_junk_reads_in_two_ways(text):
    long_or_whole(text.encode())


@pytest.mark.parametrize(
    "text",
    ['{"nodes":[1],"nodes":[2]}', '{"nodes":[1,]}', '{"nodes":[1 2]}', '{"nodes":[1]} x', '{"nodes":[NaN]}', "[1]", "7",
     '{"nodes":[{"a":1,"a":2}]}', '{"nodes":[' + "[" * 99999 + "]}", '{,"nodes":[]}', '{"nodes":[]', "", "\ufeff{}",
     '{"nodes":{"a":1}}', '{"a" "nodes"}', '{"nodes":[] "b":1}', "{'a':1}", '{"a":1,}', "{} {}"],
)  # fmt: skip
def test_what_is_no_json_is_none_for_both(text):
    long_or_whole(text.encode())
