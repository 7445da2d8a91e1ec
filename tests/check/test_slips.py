"""Each known slip, made here a second time from the profile, is named for what it is; right octets have no slip."""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable
from typing import Any

import pytest
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESCCM
from cryptography.hazmat.primitives.kdf.hkdf import HKDF, HKDFExpand

from teds_provision.check import slips
from teds_provision.check.slips import Agreement, Slip
from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey
from teds_provision.protocol.session import SessionKeys
from teds_provision.teds.codec import security

UUID = bytes(range(10))
NODE, ONE_TIME, STATION, OWN = (SoftwareKey.generate() for _ in range(4))
P, EN = NODE.point, OWN.point
REQUEST, NONCE, EPOCH = bytes(range(256)) + b"end", bytes(range(100, 116)), b"\0\1\2\3"
TEDS = security.initial(P, bytes(64), sequence=7, key_epoch=0x010202)
CHALLENGE, KEY = bytes(range(50, 82)), bytes(range(16))
OKM = bytes(range(48))


def sha(*parts: bytes) -> bytes:
    return hashlib.sha256(b"".join(parts)).digest()


def mac(key: bytes, *parts: bytes) -> bytes:
    return hmac.digest(key, b"".join(parts), "sha256")


def hkdf(ikm: bytes, salt: bytes | None, info: bytes, octets: int) -> bytes:
    return HKDF(hashes.SHA256(), octets, salt, info).derive(ikm)


def expand(key: bytes, info: bytes, octets: int) -> bytes:
    return HKDFExpand(hashes.SHA256(), octets, info).derive(key)


def name(found: Slip | None) -> str | None:
    return found.name if found is not None else None


# -- the key agreement -------------------------------------------------------------------------------------------------

LABEL, DIGEST = b"TEDS1 transcript\0", sha(TEDS)
HEAD, REST = (LABEL, REQUEST, NONCE), (EN, UUID, P)
T = sha(*HEAD, EPOCH, *REST, DIGEST)
FIRST, SECOND = OWN.ecdh(ONE_TIME.point), OWN.ecdh(STATION.point)
FIRST_OF_NODE, SECOND_OF_NODE = NODE.ecdh(ONE_TIME.point), NODE.ecdh(STATION.point)
Z = FIRST + SECOND
INFO = b"TEDS1 link key\0"

TRANSCRIPTS = {
    "transcript-label-without-00": sha(LABEL[:-1], REQUEST, NONCE, EPOCH, *REST, DIGEST),
    "transcript-without-label": sha(REQUEST, NONCE, EPOCH, *REST, DIGEST),
    "transcript-epoch-little-endian": sha(*HEAD, b"\3\2\1\0", *REST, DIGEST),
    "transcript-epoch-not-plus-1": sha(*HEAD, b"\0\1\2\2", *REST, DIGEST),
    "transcript-epoch-plus-2": sha(*HEAD, b"\0\1\2\4", *REST, DIGEST),
    "transcript-without-epoch": sha(*HEAD, *REST, DIGEST),
    "transcript-digest-of-data-block": sha(*HEAD, EPOCH, *REST, sha(TEDS[4:-2])),
    "transcript-digest-without-length": sha(*HEAD, EPOCH, *REST, sha(TEDS[4:])),
    "transcript-digest-without-checksum": sha(*HEAD, EPOCH, *REST, sha(TEDS[:-2])),
    "transcript-digest-of-new-epoch": sha(
        *HEAD, EPOCH, *REST, sha(security.initial(P, bytes(64), sequence=7, key_epoch=0x010203))
    ),
    "transcript-teds-not-hashed": sha(*HEAD, EPOCH, *REST, TEDS),
    "transcript-without-digest": sha(*HEAD, EPOCH, *REST),
    "transcript-without-one-time": sha(*HEAD, EPOCH, UUID, P, DIGEST),
    "transcript-one-time-before-epoch": sha(*HEAD, EN, EPOCH, UUID, P, DIGEST),
    "transcript-one-time-first": sha(LABEL, REQUEST, EN, NONCE, EPOCH, UUID, P, DIGEST),
    "transcript-without-nonce": sha(LABEL, REQUEST, EPOCH, *REST, DIGEST),
    "transcript-without-uuid": sha(*HEAD, EPOCH, EN, P, DIGEST),
    "transcript-node-before-uuid": sha(*HEAD, EPOCH, EN, P, UUID, DIGEST),
    "transcript-without-node": sha(*HEAD, EPOCH, EN, UUID, DIGEST),
    "transcript-points-without-04": sha(*HEAD, EPOCH, EN[1:], UUID, P[1:], DIGEST),
    "transcript-request-with-header": sha(LABEL, b"\0\0\x80\1\1\3", REQUEST, NONCE, EPOCH, *REST, DIGEST),
    "transcript-not-hashed": b"".join((*HEAD, EPOCH, *REST, DIGEST)),
}
SECRETS = {
    "z-halves-swapped": SECOND + FIRST,
    "z-little-endian": FIRST[::-1] + SECOND[::-1],
    "z-of-one-time-alone": FIRST,
    "z-of-station-alone": SECOND,
    "z-one-time-twice": FIRST + FIRST,
    "z-with-identity-key": FIRST_OF_NODE + SECOND_OF_NODE,
    "z-static-with-identity-key": FIRST + SECOND_OF_NODE,
    "z-hashed": sha(Z),
}
MATERIALS = {
    "salt-and-ikm-swapped": hkdf(NONCE, Z, INFO + T, 64),
    "info-label-without-00": hkdf(Z, NONCE, b"TEDS1 link key" + T, 64),
    "info-without-transcript": hkdf(Z, NONCE, INFO, 64),
    "info-without-label": hkdf(Z, NONCE, T, 64),
    "info-transcript-first": hkdf(Z, NONCE, T + INFO, 64),
    "without-salt": hkdf(Z, None, INFO + T, 64),
    "without-extract": expand(Z, INFO + T, 64),
}
RIGHT = hkdf(Z, NONCE, INFO + T, 64)
M = RIGHT[16:48]
TAGS = {
    "m-of-48-octets": mac(RIGHT[16:64], b"node", T)[:16],
    "m-is-all-of-okm": mac(RIGHT[:48], b"node", T)[:16],
    "m-of-16-octets": mac(RIGHT[16:32], b"node", T)[:16],
    "m-before-k": mac(RIGHT[:32], b"node", T)[:16],
    "m-is-k": mac(RIGHT[:16], b"node", T)[:16],
    "mac-label-with-00": mac(M, b"node\0", T)[:16],
    "mac-label-of-the-other-side": mac(M, b"station", T)[:16],
    "mac-without-label": mac(M, T)[:16],
    "mac-label-last": mac(M, T, b"node")[:16],
    "mac-last-16-octets": mac(M, b"node", T)[16:],
    "mac-reversed": mac(M, b"node", T)[:16][::-1],
}


def tag(script: bytes = T, z: bytes = Z, okm: bytes | None = None) -> bytes:
    """Return tagN from a wrong T, Z or OKM."""
    return mac((okm or hkdf(z, NONCE, INFO + script, 64))[16:48], b"node", script)[:16]


def agreement(tag_n: bytes, signature: bytes = bytes(64)) -> Agreement:
    return Agreement(REQUEST, NONCE + EPOCH + EN + tag_n + signature, UUID, P, TEDS, ONE_TIME, STATION)


WRONG_TAGS = {
    None: tag(),
    **{slip: tag(script) for slip, script in TRANSCRIPTS.items()},
    **{slip: tag(z=z) for slip, z in SECRETS.items()},
    **{slip: tag(okm=okm) for slip, okm in MATERIALS.items()},
    **TAGS,
    "transcript-without-label+z-hashed": tag(TRANSCRIPTS["transcript-without-label"], SECRETS["z-hashed"]),
    "without-salt+mac-reversed": mac(MATERIALS["without-salt"][16:48], b"node", T)[:16][::-1],
    "m-is-k+mac-without-label": mac(RIGHT[:16], T)[:16],
}


def test_every_slip_of_a_node_tag_is_named() -> None:
    found = {slip: name(agreement(made).slip_of_tag()) for slip, made in WRONG_TAGS.items()}
    assert found == {slip: slip for slip in WRONG_TAGS}


def test_a_tag_with_three_slips_or_of_anything_else_fits_none() -> None:
    script, z = TRANSCRIPTS["transcript-without-label"], SECRETS["z-hashed"]
    assert agreement(mac(hkdf(z, NONCE, INFO + script, 64)[16:48], b"node", script)[15::-1]).slip_of_tag() is None
    assert agreement(bytes(16)).slip_of_tag() is None


def high(signature: bytes) -> bytes:
    return signature[:32] + (GROUP_ORDER - int.from_bytes(signature[32:], "big")).to_bytes(32, "big")


def test_every_slip_of_an_agreement_signature_is_named() -> None:
    label, reply = b"TEDS1 agree\0", NONCE + EPOCH + EN + tag()
    messages = {
        **{slip: label + script for slip, script in TRANSCRIPTS.items()},
        "sign-label-without-00": b"TEDS1 agree" + T,
        "sign-without-label": T,
        "sign-with-uuid": label + UUID + T,
        "sign-of-request": label + REQUEST,
        "sign-of-one-time": label + EN,
        "sign-of-tag": label + tag(),
        "sign-of-nonce": label + NONCE,
        "sign-of-reply": label + reply,
        "sign-transcript-label": LABEL + T,
        "sign-prove-label": b"TEDS1 prove\0" + T,
    }
    signatures = {slip: NODE.sign(message) for slip, message in messages.items()}
    right = NODE.sign(label + T)
    signatures |= {
        "signature-little-endian": right[:32][::-1] + right[32:][::-1],
        "signature-s-first": right[32:] + right[:32],
        "sign-hashed-twice": NODE.sign_digest(sha(sha(label + T))),
        "sign-not-hashed": NODE.sign_digest(T),
        "sign-with-one-time-key": OWN.sign(label + T),
    }
    assert {slip: name(agreement(tag(), made).slip_of_signature()) for slip, made in signatures.items()} == {
        slip: slip for slip in signatures
    }
    assert agreement(tag(), right).slip_of_signature() is None
    assert agreement(tag(), high(right)).slip_of_signature() is None
    assert agreement(tag(), ONE_TIME.sign(label + T)).slip_of_signature() is None
    assert slips.of_signature(P, right[:-1], [(None, label + T)]) is None


def test_a_station_tag_is_tried_in_every_wrong_way_once() -> None:
    assert {slip.name: made for slip, made in slips.confirmations(M, T)} == {
        "mac-label-with-00": mac(M, b"station\0", T)[:16],
        "mac-label-of-the-other-side": mac(M, b"node", T)[:16],
        "mac-without-label": mac(M, T)[:16],
        "mac-label-last": mac(M, T, b"station")[:16],
        "mac-last-16-octets": mac(M, b"station", T)[16:],
        "mac-reversed": mac(M, b"station", T)[:16][::-1],
    }


# -- signatures of the node, and messages that a node verifies ---------------------------------------------------------

PROOFS: dict[str, tuple[Callable[[bytes], Slip | None], bytes, dict[str, bytes]]] = {
    "field 102": (
        lambda made: slips.of_node_key(UUID, P, made),
        b"TEDS1 node key\0" + UUID + P,
        {
            "label-without-00": b"TEDS1 node key" + UUID + P,
            "without-label": UUID + P,
            "without-uuid": b"TEDS1 node key\0" + P,
            "uuid-last": b"TEDS1 node key\0" + P + UUID,
            "point-without-04": b"TEDS1 node key\0" + UUID + P[1:],
            "station-label": b"TEDS1 station key\0" + P,
        },
    ),
    "Prove": (
        lambda made: slips.of_prove(UUID, P, CHALLENGE, made),
        b"TEDS1 prove\0" + UUID + CHALLENGE,
        {
            "label-without-00": b"TEDS1 prove" + UUID + CHALLENGE,
            "without-label": UUID + CHALLENGE,
            "without-uuid": b"TEDS1 prove\0" + CHALLENGE,
            "uuid-last": b"TEDS1 prove\0" + CHALLENGE + UUID,
            "challenge-alone": CHALLENGE,
        },
    ),
    "Reset": (
        lambda made: slips.of_reset(UUID, P, 0x010203, CHALLENGE, made),
        b"TEDS1 reset\0" + UUID + EPOCH + CHALLENGE,
        {
            "label-without-00": b"TEDS1 reset" + UUID + EPOCH + CHALLENGE,
            "without-label": UUID + EPOCH + CHALLENGE,
            "without-uuid": b"TEDS1 reset\0" + EPOCH + CHALLENGE,
            "without-epoch": b"TEDS1 reset\0" + UUID + CHALLENGE,
            "epoch-little-endian": b"TEDS1 reset\0" + UUID + EPOCH[::-1] + CHALLENGE,
            "epoch-plus-1": b"TEDS1 reset\0" + UUID + b"\0\1\2\4" + CHALLENGE,
            "prove-label": b"TEDS1 prove\0" + UUID + CHALLENGE,
        },
    ),
}


@pytest.mark.parametrize("what", PROOFS)
def test_every_slip_of_a_proof_is_named(what: str) -> None:
    explain, right, wrong = PROOFS[what]
    assert {slip: name(explain(NODE.sign(message))) for slip, message in wrong.items()} == {
        slip: slip for slip in wrong
    }
    assert explain(NODE.sign(right)) is None
    assert name(explain(NODE.sign_digest(sha(P) if what == "field 102" else CHALLENGE))) == "sign-not-hashed"
    s_first = NODE.sign(wrong["without-label"])
    assert name(explain(s_first[32:] + s_first[:32])) == "without-label+signature-s-first"


def test_messages_that_a_node_with_a_slip_verifies() -> None:
    point, block = STATION.point, bytes(range(60))
    assert {slip.name: message for slip, message in slips.station_keys(point)} == {
        "station-label-without-00": b"TEDS1 station key" + point,
        "station-without-label": point,
        "station-point-without-04": b"TEDS1 station key\0" + point[1:],
        "station-label-of-node": b"TEDS1 node key\0" + point,
    }
    assert {slip.name: message for slip, message in slips.datasheets(UUID, block)} == {
        "datasheet-label-without-00": b"TEDS1 datasheet" + UUID + block,
        "datasheet-without-label": UUID + block,
        "datasheet-without-uuid": b"TEDS1 datasheet\0" + block,
        "datasheet-without-tedsid": b"TEDS1 datasheet\0" + UUID + block[6:],
    }


# -- sessions ----------------------------------------------------------------------------------------------------------

IDENTIFIER = sha(b"TEDS1 key id\0", KEY)[:8]
ES = ONE_TIME.point


def test_an_open_is_tried_with_every_slip() -> None:
    counter, following = b"\0\0\0\0\0\0\1\xff", b"\0\0\0\0\0\0\2\0"

    def tried(about_key: bool, okm: bytes = b"") -> list[tuple[str, bytes]]:
        return [(slip.name, made(counter)) for slip, made in slips.opens(KEY, okm, UUID, ES, about_key=about_key)]

    def opened(identifier: bytes, key: bytes, *parts: bytes) -> bytes:
        return identifier + ES + mac(key, b"station open", *parts)[:16]

    right = (UUID, counter, ES)
    by_key_id = [
        ("key-id-label-without-00", opened(sha(b"TEDS1 key id", KEY)[:8], KEY, *right)),
        ("key-id-without-label", opened(sha(KEY)[:8], KEY, *right)),
        ("key-id-last-8-octets", opened(sha(b"TEDS1 key id\0", KEY)[24:], KEY, *right)),
        ("key-id-reversed", opened(IDENTIFIER[::-1], KEY, *right)),
    ]
    elsewhere = [
        ("k-elsewhere-in-okm", opened(sha(b"TEDS1 key id\0", other)[:8], other, *right))
        for other in (OKM[32:48], OKM[16:32])
    ]
    assert tried(about_key=True) == by_key_id
    assert tried(about_key=True, okm=OKM) == by_key_id + elsewhere
    whole = mac(KEY, b"station open", *right)
    assert tried(about_key=False, okm=OKM) == [
        ("mac-label-with-00", opened(IDENTIFIER, KEY, b"\0", *right)),
        ("mac-without-label", IDENTIFIER + ES + mac(KEY, *right)[:16]),
        ("mac-without-uuid", opened(IDENTIFIER, KEY, counter, ES)),
        ("mac-counter-little-endian", opened(IDENTIFIER, KEY, UUID, counter[::-1], ES)),
        ("mac-without-counter", opened(IDENTIFIER, KEY, UUID, ES)),
        ("mac-counter-last", opened(IDENTIFIER, KEY, UUID, ES, counter)),
        ("mac-next-counter", opened(IDENTIFIER, KEY, UUID, following, ES)),
        ("mac-without-point", opened(IDENTIFIER, KEY, UUID, counter)),
        ("mac-with-key-id", opened(IDENTIFIER, KEY, UUID, counter, IDENTIFIER, ES)),
        ("mac-point-without-04", opened(IDENTIFIER, KEY, UUID, counter, ES[1:])),
        ("mac-last-16-octets", IDENTIFIER + ES + whole[16:]),
    ]


def test_every_slip_of_a_reply_to_open_is_named() -> None:
    z, label, both = OWN.ecdh(ES), b"TEDS1 session\0", ES + EN
    okm, reply_label = hkdf(z, KEY, label + UUID + both, 96), b"node open"
    kc = okm[32:64]

    def by(made: bytes) -> bytes:
        return mac(made[32:64], reply_label, IDENTIFIER, both)[:16]

    replies = {
        None: by(okm),
        "z-little-endian": by(hkdf(z[::-1], KEY, label + UUID + both, 96)),
        "salt-and-ikm-swapped": by(hkdf(KEY, z, label + UUID + both, 96)),
        "info-label-without-00": by(hkdf(z, KEY, b"TEDS1 session" + UUID + both, 96)),
        "info-without-label": by(hkdf(z, KEY, UUID + both, 96)),
        "info-without-uuid": by(hkdf(z, KEY, label + both, 96)),
        "info-node-first": by(hkdf(z, KEY, label + UUID + EN + ES, 96)),
        "info-without-points": by(hkdf(z, KEY, label + UUID, 96)),
        "without-salt": by(hkdf(z, None, label + UUID + both, 96)),
        "without-extract": by(expand(z, label + UUID + both, 96)),
        "kc-of-16-octets": mac(okm[32:48], reply_label, IDENTIFIER, both)[:16],
        "kc-is-km": mac(okm[64:96], reply_label, IDENTIFIER, both)[:16],
        "kc-first": mac(okm[:32], reply_label, IDENTIFIER, both)[:16],
        "kc-is-k": mac(KEY, reply_label, IDENTIFIER, both)[:16],
        "mac-label-with-00": mac(kc, b"node open\0", IDENTIFIER, both)[:16],
        "mac-without-label": mac(kc, IDENTIFIER, both)[:16],
        "mac-without-key-id": mac(kc, reply_label, both)[:16],
        "mac-node-first": mac(kc, reply_label, IDENTIFIER, EN, ES)[:16],
        "mac-last-16-octets": mac(kc, reply_label, IDENTIFIER, both)[16:],
        "without-salt+mac-without-label": mac(
            hkdf(z, None, label + UUID + both, 96)[32:64], IDENTIFIER, both
        )[:16],
    }  # fmt: skip
    found = {slip: name(slips.of_session(KEY, UUID, ONE_TIME, EN + made)) for slip, made in replies.items()}
    assert found == {slip: slip for slip in replies}
    assert slips.of_session(KEY, UUID, ONE_TIME, EN + by(okm)[:15]) is None
    assert slips.of_session(KEY, UUID, ONE_TIME, b"\4" + bytes(64) + by(okm)) is None


def ccm(key: bytes, nonce: bytes, octets: bytes, aad: bytes | None = None, tag: int = 16) -> bytes:
    return AESCCM(key, tag_length=tag).encrypt(nonce, octets, aad)


KEYS = SessionKeys(bytes(range(1, 17)), bytes(range(17, 33)), bytes(32), bytes(16))
ZEROS, NUMBER, COUNTER = bytes(9), b"\0\1\2\3", 0x010203
FRAME = b"\1\0\2ab"
PADDED = FRAME + b"\x0b" * 11


def test_a_sealed_frame_is_tried_with_every_slip() -> None:
    assert {slip.name: seal(KEYS, COUNTER, FRAME) for slip, seal in slips.SEALED} == {
        "session-keys-swapped": NUMBER + ccm(KEYS.to_station, ZEROS + NUMBER, PADDED),
        "nonce-counter-first": NUMBER + ccm(KEYS.to_node, NUMBER + ZEROS, PADDED),
        "nonce-counter-little-endian": NUMBER + ccm(KEYS.to_node, ZEROS + NUMBER[::-1], PADDED),
        "aad-counter": NUMBER + ccm(KEYS.to_node, ZEROS + NUMBER, PADDED, NUMBER),
        "tag-of-8-octets": NUMBER + ccm(KEYS.to_node, ZEROS + NUMBER, PADDED, tag=8),
    }


def test_every_slip_of_a_sealed_reply_is_named() -> None:
    right, block = ZEROS + NUMBER, b"\1\0\x0d" + bytes(13)
    replies = {
        "counter-little-endian": NUMBER[::-1] + ccm(KEYS.to_station, right, PADDED),
        "session-keys-swapped": NUMBER + ccm(KEYS.to_node, right, PADDED),
        "nonce-counter-first": NUMBER + ccm(KEYS.to_station, NUMBER + ZEROS, PADDED),
        "nonce-counter-little-endian": NUMBER + ccm(KEYS.to_station, ZEROS + NUMBER[::-1], PADDED),
        "aad-counter": NUMBER + ccm(KEYS.to_station, right, PADDED, NUMBER),
        "nonce-of-zeros": NUMBER + ccm(KEYS.to_station, bytes(13), PADDED),
        "nonce-next-counter": NUMBER + ccm(KEYS.to_station, ZEROS + b"\0\1\2\4", PADDED),
        "padding-no-full-block": NUMBER + ccm(KEYS.to_station, right, block),
        "padding-none": NUMBER + ccm(KEYS.to_station, right, FRAME),
        "padding-zeros": NUMBER + ccm(KEYS.to_station, right, FRAME + bytes(11)),
        "padding-x923": NUMBER + ccm(KEYS.to_station, right, FRAME + bytes(10) + b"\x0b"),
        "padding-one-less": NUMBER + ccm(KEYS.to_station, right, FRAME + b"\x0a" * 11),
    }
    found = {slip: name(slips.of_sealed_reply(KEYS, made, COUNTER)) for slip, made in replies.items()}
    assert found == {slip: slip for slip in replies}
    long = NUMBER + ccm(KEYS.to_station, right, b"\1\1\0" + bytes(256))
    assert name(slips.of_sealed_reply(KEYS, long, COUNTER)) == "padding-none"
    for unknown in (
        ccm(KEYS.to_station, right, PADDED),
        ccm(KEYS.to_station, right, FRAME + b"\x0b" * 10 + b"\x0c"),
        bytes(40),
    ):
        assert slips.of_sealed_reply(KEYS, NUMBER + unknown, COUNTER) is None
    assert slips.of_sealed_reply(KEYS, NUMBER + bytes(15), COUNTER) is None


def test_every_slip_of_a_data_message_is_named() -> None:
    key, run, values = bytes(range(32)), b"\1\2", b"sample"
    label = b"TEDS1 stream\0"
    run_key, nonce = expand(key, label + run, 16), ZEROS + NUMBER

    def sealed(under: bytes = run_key, nonce: bytes = nonce, aad: bytes | None = None) -> bytes:
        return ccm(under, nonce, values, aad, tag=8)

    messages = {
        None: sealed(),
        "run-label-without-00": sealed(expand(key, b"TEDS1 stream" + run, 16)),
        "run-drive-label": sealed(expand(key, b"TEDS1 drive\0" + run, 16)),
        "run-little-endian": sealed(expand(key, label + b"\2\1", 16)),
        "run-before": sealed(expand(key, label + b"\1\1", 16)),
        "run-left-out": sealed(expand(key, label, 16)),
        "run-key-is-km": sealed(key[:16]),
        "nonce-counter-first": sealed(nonce=NUMBER + ZEROS),
        "nonce-counter-little-endian": sealed(nonce=ZEROS + NUMBER[::-1]),
        "nonce-of-zeros": sealed(nonce=bytes(13)),
        "nonce-next-counter": sealed(nonce=ZEROS + b"\0\1\2\4"),
        "aad-counter": sealed(aad=NUMBER),
        "run-before+nonce-of-zeros": sealed(expand(key, label + b"\1\1", 16), bytes(13)),
    }
    found: dict[Any, str | None] = {
        slip: name(slips.of_data_message(key, 0x0102, COUNTER, NUMBER + made)) for slip, made in messages.items()
    }
    assert found == {slip: slip for slip in messages}


def test_s_is_high_above_half_of_the_group_order_only() -> None:
    half = GROUP_ORDER // 2
    assert not slips.high_s(bytes(32) + half.to_bytes(32, "big"))
    assert slips.high_s(bytes(32) + (half + 1).to_bytes(32, "big"))


def test_the_counter_after_the_last_is_0() -> None:
    """c of Open has 64 bits; a node that counts too early has the next one in its mac."""
    found = [slips._next(bytes.fromhex(text)).hex() for text in ("00" * 8, "7f" + "ff" * 7, "ff" * 8)]
    assert found == ["00" * 7 + "01", "80" + "00" * 7, "00" * 8]


def test_a_number_at_either_end_of_its_range_is_tried_as_any_other() -> None:
    """The number before 0 and the one after the last do not fit: what a faulty board sends never ends the check."""
    for epoch in (b"\0\0\0\0", b"\xff\xff\xff\xff"):
        made = Agreement(REQUEST, NONCE + epoch + EN + bytes(80), UUID, P, TEDS, ONE_TIME, STATION)
        assert (made.slip_of_tag(), made.slip_of_signature()) == (None, None)
        reset = b"TEDS1 reset\0" + UUID + epoch + CHALLENGE
        wrong = b"TEDS1 reset" + UUID + epoch + CHALLENGE
        number = int.from_bytes(epoch, "big")
        assert slips.of_reset(UUID, P, number, CHALLENGE, NODE.sign(reset)) is None
        assert name(slips.of_reset(UUID, P, number, CHALLENGE, NODE.sign(wrong))) == "label-without-00"
    last, key = b"\xff\xff\xff\xff", bytes(range(32))
    for run, before in ((0, b"\xff\xff"), (0xFFFF, b"\xff\xfe")):
        made_so = expand(key, b"TEDS1 stream\0" + before, 16)
        octets = last + ccm(made_so, ZEROS + last, b"sample", tag=8)
        assert name(slips.of_data_message(key, run, 0xFFFFFFFF, octets)) == "run-before"
    after = ccm(expand(key, b"TEDS1 stream\0" + b"\0\1", 16), bytes(13), b"sample", tag=8)
    found = name(slips.of_data_message(key, 1, 0xFFFFFFFF, last + after))
    assert found in ("nonce-of-zeros", "nonce-next-counter"), "0 comes after the last counter"
    assert slips.of_sealed_reply(KEYS, last + bytes(36), 0xFFFFFFFF) is None
