"""Every value of the profile's known-answer vectors, from both roles."""

from __future__ import annotations

import zlib

import pytest
from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError
from teds_provision.protocol import keys
from teds_provision.protocol.datasheet import SignedNodeKey, sign_datasheet, unsigned_datasheet
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import Credentials, SoftwareKey
from teds_provision.protocol.messages.frames import Command, decode_reply
from teds_provision.protocol.session import StationSession, pad
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import StationAgreement, derive
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

from .kat import KAT, UUID, key, octets
from .memory import RamFlash

CREDENTIALS = Credentials(key("station"), octets("sig104", "signature"), key("ca").point)


@pytest.mark.parametrize("name", ["node", "station", "ca", "one_time", "one_time_node"])
def test_points_and_fingerprints_are_those_of_the_vectors(name: str) -> None:
    assert key(name).point == octets(name, "P")
    if "fingerprint" in KAT[name]:
        assert keys.fingerprint(key(name).point) == KAT[name]["fingerprint"]


@pytest.mark.parametrize(
    ("entry", "signer", "message"),
    [
        ("sig102", "node", keys.node_key_message(UUID, key("node").point)),
        ("sig104", "ca", keys.station_key_message(key("station").point)),
        ("prove", "node", keys.prove_message(UUID, octets("prove", "challenge"))),
        ("reset", "node", keys.reset_message(UUID, KAT["reset"]["epoch"], octets("reset", "challenge"))),
    ],
)
def test_signatures_are_deterministic_and_labelled(entry: str, signer: str, message: bytes) -> None:
    assert message == octets(entry, "message")
    assert key(signer).sign(message) == octets(entry, "signature")
    assert keys.verify(key(signer).point, message, octets(entry, "signature"))


def test_a_high_s_is_refused() -> None:
    signature = octets("prove", "signature")
    high = keys.GROUP_ORDER - int.from_bytes(signature[32:], "big")
    forged = signature[:32] + high.to_bytes(32, "big")
    assert not keys.verify(key("node").point, octets("prove", "message"), forged)
    assert keys.normalise_signature(forged) == signature


_EDGES = (0, 1, 127, 128, 1 << 247, (1 << 248) - 1, 1 << 248, 1 << 255, keys.GROUP_ORDER // 2, keys.GROUP_ORDER)


@pytest.mark.parametrize("r", [*_EDGES, keys.GROUP_ORDER - 1, (1 << 256) - 1])
@pytest.mark.parametrize("s", [*_EDGES, keys.GROUP_ORDER // 2 + 1, (1 << 255) - 1])
def test_a_signature_goes_to_the_library_as_it_spells_it_itself(r: int, s: int) -> None:
    spelled = keys._to_der(r.to_bytes(32, "big") + s.to_bytes(32, "big"))
    good = 0 < r < keys.GROUP_ORDER and 0 < s <= keys.GROUP_ORDER // 2
    assert spelled == (encode_dss_signature(r, s) if good else None)


_FIELD = 2**256 - 2**224 + 2**192 + 2**96 - 1


@given(st.integers(1, keys.GROUP_ORDER - 1), st.integers(0, 511), st.sampled_from([b"\x04", b"\x02", b"\0"]))
def test_a_point_is_one_if_the_library_loads_it(secret: int, bent: int, form: bytes) -> None:
    x, y = (int.from_bytes(part, "big") for part in (SoftwareKey(secret).point[1:33], SoftwareKey(secret).point[33:]))
    beyond = [(x + _FIELD) % 2**256, (y + _FIELD) % 2**256]  # the same numbers modulo the field
    for one, other in (
        (x, y),
        (x, _FIELD - y),
        (x ^ 1 << bent % 256, y),
        (beyond[0], y),
        (x, beyond[1]),
        (0, 0),
        (y, x),
    ):
        point = form + one.to_bytes(32, "big") + other.to_bytes(32, "big")
        assert keys.is_point(point) is _loads(point)
    assert keys.is_point(SoftwareKey(secret).point)
    assert not keys.is_point(SoftwareKey(secret).point[:64])
    assert not keys.is_point(SoftwareKey(secret).point + b"\0")


def _loads(point: bytes) -> bool:
    try:
        keys.public_key(point)
    except BadDataError:
        return False
    return True


@given(st.integers(0, 5))
def test_the_second_root_of_a_small_x_is_a_point_too(x: int) -> None:
    """Numbers that a wrong carry or a missing reduction would show at."""
    right = (x**3 - 3 * x + 0x5AC635D8AA3A93E7B3EBBD55769886BC651D06B0CC53B0F63BCE3C3E27D2604B) % _FIELD
    y = pow(right, (_FIELD + 1) // 4, _FIELD)
    for root in (y, _FIELD - y):
        point = b"\x04" + x.to_bytes(32, "big") + root.to_bytes(32, "big")
        assert keys.is_point(point) is _loads(point) is (root * root % _FIELD == right)
        far = b"\x04" + (x + _FIELD).to_bytes(32, "big") + root.to_bytes(32, "big")
        assert not keys.is_point(far)
        assert not _loads(far)


def test_the_default_can_address_follows_from_the_uuid() -> None:
    assert 1 + zlib.crc32(UUID) % 239 == KAT["default_can_address"]


def new_node(**state: object) -> Tim:
    """Return the vectors' node in factory state, with the vectors' nonces in their order of use."""
    drawn = iter([octets("session", "c"), octets("agreement", "nonceN")])
    one_time = iter([key("one_time_node"), SoftwareKey(int(KAT["session"]["En"]["d"], 16))])
    flash = Flash(UUID, key("node").point, octets("sig102", "signature"), can_address=KAT["default_can_address"])
    return Tim(
        key("node"),
        RamFlash(flash),
        clock=lambda: 0.0,
        max_message=2048,
        random=lambda n: next(drawn),
        one_time=lambda: next(one_time),
    )


def test_agreement_and_session_from_both_roles_give_the_vectors_frames() -> None:
    node = new_node()
    assert node.flash.security_teds() == octets("initial_security_teds")
    agreement = StationAgreement(CREDENTIALS, UUID, one_time=key("one_time"))
    assert agreement.request().encode() == octets("agreement", "request_frame")
    reply = node.handle(agreement.request().encode(), link="nfc", tapped=True)
    assert reply == octets("agreement", "reply_frame")
    teds, pinned = octets("initial_security_teds"), keys.fingerprint(key("node").point)
    agreed = agreement.accept(decode_reply(reply).payload, teds, pinned=pinned, epoch=0)
    assert (agreed.key, agreed.epoch) == (octets("agreement", "K"), 1)
    assert agreed.confirm.encode() == octets("agreement", "confirm_frame")
    assert node.handle(agreed.confirm.encode(), link="nfc", tapped=True) == octets("agreement", "confirm_reply")

    session = StationSession(agreed.key, UUID, one_time=SoftwareKey(int(KAT["session"]["Es"]["d"], 16)))
    assert session.request_counter().encode() == octets("session", "c_frame")
    counter = node.handle(session.request_counter().encode(), link="nfc", tapped=True)
    assert counter == octets("session", "c_reply")
    frame = session.open(decode_reply(counter).payload).encode()
    assert frame == octets("session", "open_frame")
    reply = node.handle(frame, link="nfc", tapped=True)
    assert reply == octets("session", "open_reply")
    session.accept(decode_reply(reply).payload)
    assert session.message_key == octets("session", "k_m")
    for sealed in KAT["sealed"]:
        inner = bytes.fromhex(sealed["inner"])
        assert pad(inner).hex() == sealed["padded"]
        frame = session.seal(Command(int.from_bytes(inner[:2], "big"), inner[2], inner[3], inner[6:])).encode()
        assert frame.hex() == sealed["frame"]
        reply = node.handle(frame, link="nfc", tapped=True)
        assert reply.hex() == sealed["reply_frame"]
        assert session.unseal(decode_reply(reply).payload).encode().hex() == sealed["inner_reply"]


def test_the_proof_of_an_agreement_is_over_the_vectors_transcript() -> None:
    for name in ("agreement", "rotation"):
        assert keys.agreement_message(octets(name, "T")) == octets(name, "sigN_message")
        assert key("node").sign(octets(name, "sigN_message")) == octets(name, "sigN")
        derived = derive(octets(name, "Z"), octets(name, "nonceN"), octets(name, "T"))
        assert derived.key + derived.node_tag + derived.station_tag == (
            octets(name, "K") + octets(name, "tagN") + octets(name, "tagS")
        )


def test_rotation_from_both_roles_gives_the_vectors_frames() -> None:
    rotation = KAT["rotation"]
    signed = octets("datasheet", "security_teds")
    flash = Flash(
        UUID,
        key("node").point,
        octets("sig102", "signature"),
        blocks={SECURITY: signed},
        epoch=1,
        sequence=1,
        key=octets("agreement", "K"),
        station=key("station").point,
        ca=key("ca").point,
        provisioned=True,
    )
    drawn = iter([bytes(8), octets("rotation", "nonceN")])
    one_time = SoftwareKey(int(rotation["one_time_node"]["d"], 16))
    node = Tim(key("node"), RamFlash(flash), lambda: 0.0, random=lambda n: next(drawn), one_time=lambda: one_time)
    agreement = StationAgreement(CREDENTIALS, UUID, one_time=SoftwareKey(int(rotation["one_time"]["d"], 16)))
    assert agreement.request().encode() == octets("rotation", "request_frame")
    reply = node.handle(agreement.request().encode(), link="nfc", tapped=True)
    assert reply == octets("rotation", "reply_frame")
    agreed = agreement.accept(decode_reply(reply).payload, signed, pinned=None, epoch=1)
    assert (agreed.key, agreed.epoch, agreed.unsigned) == (octets("rotation", "K"), 2, False)
    assert agreed.confirm.encode() == octets("rotation", "confirm_frame")
    assert node.handle(agreed.confirm.encode(), link="nfc", tapped=True) == octets("rotation", "confirm_reply")


def test_after_a_reset_the_node_shows_the_vectors_initial_security_teds() -> None:
    epoch, sequence = KAT["reset"]["epoch"], KAT["datasheet"]["sequence"]
    flash = Flash(UUID, key("node").point, octets("sig102", "signature"), epoch=epoch, sequence=sequence)
    assert flash.security_teds() == octets("security_teds_after_reset")


def test_the_signed_datasheet_is_the_vectors() -> None:
    sheet = KAT["datasheet"]
    listed = {(b["channel"], b["access_code"]): bytes.fromhex(b["sha256"]) for b in sheet["blocks"]}
    unsigned = unsigned_datasheet(
        SignedNodeKey(UUID, key("node").point, octets("sig102", "signature")),
        key("station").point,
        octets("sig104", "signature"),
        listed,
        ca=security.ca_hint("peer", keys.fingerprint(key("ca").point)),
        last_modified=bytes.fromhex(sheet["last_modified"]),
        sequence=sheet["sequence"],
        key_epoch=sheet["epoch"],
    )
    signed = sign_datasheet(unsigned, UUID, CREDENTIALS)
    assert security.tbs(UUID, signed).hex() == sheet["tbs"]
    assert signed.hex() == sheet["security_teds"]
    assert security.decode(signed).encode() == signed
