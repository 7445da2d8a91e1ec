"""What a board signs for a line's request, and what an office and a line read (contract/plant.md section 11)."""

from __future__ import annotations

import hashlib
from typing import Any

import pytest

from teds_provision.errors import BadDataError
from teds_provision.protocol.keys import prove_message, verify
from teds_provision.protocol.plant import document, signing
from teds_provision.protocol.plant.signing import Answer, open_answer, open_request
from teds_provision.teds.codec.frame import frame
from tests.plant.test_documents import KAT, KEYS, POINTS, octets_of

GOOD: dict[str, Any] = KAT["documents"]["sign-request"]["payload"]
H = "ab" * 32


def test_the_board_signs_label_nonce_line_uuid_epoch_sequence_and_the_values_of_108_ascending() -> None:
    nonce, line, uuid = bytes(range(16)), bytes(65), bytes(range(10))
    blocks = {(1, 3): frame(b"\x01"), (0, 12): frame(b"\x02"), (0, 1): frame(b"\x03")}
    values = b"".join(
        channel.to_bytes(2, "big") + bytes([code]) + hashlib.sha256(blocks[channel, code]).digest()
        for channel, code in ((0, 1), (0, 12), (1, 3))
    )
    bound = b"TEDS1 sign request\x00" + nonce + line + uuid + b"\x00\x00\x00\x05" + b"\x00\x00\x00\x07" + values
    assert signing.challenge(nonce, line, uuid, 5, 7, blocks) == hashlib.sha256(bound).digest()


def test_the_known_request_is_signed_by_its_board_for_its_line_alone() -> None:
    request = open_request(octets_of("sign-request"), POINTS.get)
    message = prove_message(request.uuid, request.challenge())
    assert verify(request.point, message, request.proof)
    assert request.line == KEYS["west"].point


def test_blanks_around_a_request_and_an_answer_do_not_count() -> None:
    octets = octets_of("sign-request")
    assert open_request(b" " + octets + b"\r\n", POINTS.get) == open_request(octets, POINTS.get)
    members = {"format": "teds-signed/1", "of": H, "refused": "guard", "why": "no"}
    answer = document.sign_document(members, KEYS["office"], document.SIGNED)
    assert open_answer(b" " + answer + b"\r\n", POINTS.get) == open_answer(answer, POINTS.get)


def changed(**changes: Any) -> bytes:
    node = {**GOOD["node"], **changes.pop("node", {})}
    members = {name: value for name, value in {**GOOD, "node": node, **changes}.items() if value is not Ellipsis}
    return document.sign_document(members, KEYS["west"], document.SIGN_REQUEST)


META, OTHER = [0, 1, "00000001"], [1, 3, "ff00"]


@pytest.mark.parametrize(
    "changes",
    [
        {"image": []},
        {"image": ...},
        {"image": [META, OTHER, META]},
        {"image": [META, [0, 16, "00"], [0, 128, "00"]]},  # the Security TEDS
        {"image": [[0, 1, "0"]]},
        {"image": [[0, 1, "AB"]]},
        {"image": [[0, 1]]},
        {"image": [[-1, 1, "00"]]},
        {"image": [[0, 256, "00"]]},
        {"image": [[True, 1, "00"]]},
        {"image": [["0", 1, "00"]]},
        {"id": "11111111"},
        {"to": "AB" * 32},
        {"created": "2026-02-31T12:00:00Z"},
        {"job": None},
        {"uuid": "8D4D9DA65281F7000000"},
        {"epoch": -1},
        {"sequence": 4_294_967_296},
        {"name": " left"},
        {"name": "x" * 101},
        {"calibration": "AA"},
        {"calibration": "AB=="},  # spare bits
        {"calibration": 1},
        {"node": {"nonce": "00" * 15}},
        {"node": {"nonce": "00" * 17}},
        {"node": {"nonce": "0A" * 16}},
        {"node": {"proof": "00" * 63}},
        {"node": {"signature": "AAAA"}},
        {"node": {"point": "04" + "00" * 64}},
    ],
    ids=str,
)
def test_a_request_that_is_not_of_its_form_is_none(changes: dict[str, Any]) -> None:
    with pytest.raises(BadDataError):
        open_request(changed(**changes), POINTS.get)


def test_a_request_may_have_no_name_and_no_calibration_and_others_have_both() -> None:
    read = open_request(changed(name=None, calibration=None), POINTS.get)
    assert (read.name, read.calibration) == (None, None)
    read = open_request(changed(name="left", calibration="AAE=", sequence=4_294_967_295), POINTS.get)
    assert (read.name, read.calibration, read.sequence) == ("left", b"\x00\x01", 4_294_967_295)


def answered(**members: Any) -> Answer:
    octets = document.sign_document({"format": "teds-signed/1", "of": H, **members}, KEYS["office"], document.SIGNED)
    return open_answer(octets, POINTS.get)


def test_an_answer_is_a_security_teds_with_its_sequence_or_a_word_and_why() -> None:
    assert answered(sequence=1, security="AAE=") == Answer(H, 1, b"\x00\x01")
    assert answered(sequence=1, security="AAE=", refused="full", why="x") == Answer(H, refused="full", why="x")
    for word in ("not-line", "job", "full", "other-key", "proof", "differs", "guard", "sequence", "revoked"):
        assert answered(refused=word, why="so") == Answer(H, refused=word, why="so")
    for why in (None, 1, "a\nb", "x" * 1025):
        assert answered(refused="job", why=why) == Answer(H, refused="job")
    for members in ({"sequence": 0, "security": "AAE="}, {"sequence": 1}, {"security": "AAE="}, {"refused": "no"},
                    {"refused": ""}, {"sequence": 1, "security": "AAE"}, {"of": "x", "refused": "job"}):  # fmt: skip
        with pytest.raises(BadDataError):
            answered(**members)
