"""The signed statement that a node is no longer trusted: its members, and what is refused of one."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.revocation import open_revocation, open_revocations, seal_revocation
from teds_provision.protocol.handover.strict_json import decode_base64url, dump
from teds_provision.protocol.keys import SoftwareKey, fingerprint

SIGNER, STRANGER = SoftwareKey(61), SoftwareKey(62)
UUID, PIN = bytes(range(10)), "ab" * 32
WHEN = datetime(2026, 3, 1, 12, tzinfo=UTC)
MEMBERS = {
    "format": "teds-revocation/1",
    "uuid": "00010203040506070809",
    "fingerprint": PIN,
    "from": fingerprint(SIGNER.point),
    "reason": "lost",
    "created": "2026-03-01T12:00:00Z",
    "why": "lost",
}


def known(kid: str) -> bytes | None:
    return {fingerprint(SIGNER.point): SIGNER.point}.get(kid)


def statement(signer: SoftwareKey = SIGNER, typ: str = "teds-revocation+jws", **changes: object) -> str:
    members = {name: value for name, value in {**MEMBERS, **changes}.items() if value is not ...}
    return jose.sign_compact(dump(members), signer, typ=typ).decode()


def test_what_a_statement_says() -> None:
    sealed = seal_revocation(SIGNER, uuid=UUID, node=PIN, why="lost", created=WHEN)
    head, payload, _ = sealed.statement.split(".")
    assert json.loads(decode_base64url(payload, "it")) == MEMBERS
    assert json.loads(decode_base64url(head, "it")) == {
        "alg": "ES256", "kid": MEMBERS["from"], "typ": "teds-revocation+jws"
    }  # fmt: skip
    found = open_revocation(sealed.statement, known)
    assert found == sealed
    assert (found.uuid, found.fingerprint, found.why, found.created, found.sender) == (
        UUID, PIN, "lost", WHEN, MEMBERS["from"]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"reason": "stolen"}, "stolen"),
        ({"reason": ""}, ""),
        ({"reason": ...}, "lost"),
        ({"reason": None}, "lost"),
        ({"why": ...}, "lost"),
    ],
)
def test_the_reason_counts_before_that_of_earlier_versions(changes: dict[str, object], why: str) -> None:
    assert open_revocation(statement(**changes), known).why == why


def test_a_statement_about_every_key_of_a_node() -> None:
    assert open_revocation(statement(fingerprint=None), known).fingerprint is None


@pytest.mark.parametrize(
    ("text", "error", "says"),
    [
        (statement(format="teds-revocation/2"), BadDataError, "format is not teds-revocation/1"),
        (statement(**{"from": fingerprint(STRANGER.point)}), NotAuthenticError, "names another signer"),
        (statement(typ="teds-handover+jws"), BadDataError, "not teds-revocation"),
        (statement(uuid="00"), BadDataError, "uuid"),
        (statement(fingerprint="ab"), BadDataError, "fingerprint"),
        (statement(reason=..., why=...), BadDataError, "why"),
        (statement() + "é", BadDataError, "is not a compact JWS"),
        (statement(more="x" * 12_300), BadDataError, "at most 16384 are read"),
    ],
)
def test_what_is_no_statement(text: str, error: type[Exception], says: str) -> None:
    with pytest.raises(error, match=says):
        open_revocation(text, known)
    with pytest.raises(error, match=says):
        open_revocations([statement(), text], known)


def test_statements_of_unknown_signers_are_counted_and_the_others_read() -> None:
    strange = [statement(STRANGER, uuid=f"{number:020x}", **{"from": fingerprint(STRANGER.point)}) for number in (1, 2)]
    found, unknown = open_revocations([strange[0], statement(), strange[1], statement(uuid="00" * 10)], known)
    assert ([revocation.uuid for revocation in found], unknown) == ([UUID, bytes(10)], 2)
    head, payload, signature = statement().split(".")
    with pytest.raises(NotAuthenticError, match="does not verify"):
        open_revocations([f"{head}.{payload}.{'A' * len(signature)}"], known)
