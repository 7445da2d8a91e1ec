"""Each fault of evidence by itself (contract/plant.md section 10), and what is no fault of a failed attempt."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, NodeRefusedError, NodeSilentError, NotAuthenticError
from teds_provision.plant.evidence import sign_evidence
from teds_provision.plant.verify_evidence import EvidenceAnchors
from teds_provision.protocol.handover.strict_json import Members
from teds_provision.protocol.keys import Credentials, SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.evidence import (
    BoardFacts,
    CheckedEvidence,
    Evidence,
    EvidenceClaim,
    Signatures,
    canonical,
    challenge,
    faults_of,
    pae,
    seal,
)
from teds_provision.provisioning.conversation import Conversation
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.origin import ORIGIN, Origin, origin_from_text
from tests.plant.plants import CA

NODE, LINE, OFFICE, OTHER = (SoftwareKey(number) for number in (901, 902, 903, 904))
UUID = bytes.fromhex("8d4d9da65281f7000000")
AT, H = "2026-03-01T12:00:00Z", "ab" * 32
TEDS = b"the Security TEDS"
ORIGIN_TEXT = Origin("dbc", "brake.dbc", "ab" * 32).lines


def certified(key: SoftwareKey, ca: SoftwareKey = CA) -> bytes:
    return ca.sign(station_key_message(key.point))


FACTS = BoardFacts(
    station=fingerprint(LINE.point), job=None, unit=None, attempt=1, profile=None, profile_sha256=None,
    calibration_sha256=None, epoch=3, sequence=7, blocks=((1, 3, "cd" * 32),), steps=(("check", "ok", 12),),
    assurance="tap", tool="teds-provision 1", begun=AT,
)  # fmt: skip
SHOWN = SecurityTeds(
    NODE.point, bytes(64), sequence=7, key_epoch=3, signature=bytes(64), station_key=OFFICE.point,
    station_key_signature=certified(OFFICE), signed_blocks={(1, 3): bytes.fromhex("cd" * 32)},
)  # fmt: skip
GOOD = Evidence(
    UUID, hashlib.sha256(TEDS).hexdigest(), FACTS, "passed", AT, None, NODE.point, bytes(16), bytes(64), TEDS,
    LINE.point, certified(LINE), b"bound", b"payload", fingerprint(LINE.point), b"signature",
)  # fmt: skip
ALL_GOOD = Signatures(envelope=True, node_key=True, datasheet=True, board=True)
BROKE = replace(FACTS, steps=(("check", "ok", 12), ("agree", "node-silent", 3)))


def faults(
    evidence: Evidence = GOOD, shown: SecurityTeds | None = SHOWN, *, facts: BoardFacts | None = None, **signatures: Any
) -> list[str]:
    whole = evidence if facts is None else replace(evidence, facts=facts)
    checked = CheckedEvidence(whole, shown, "" if shown is not None else "field 101 is missing", b"", b"")
    return faults_of(checked, ALL_GOOD._replace(**signatures), CA.point)


def test_good_evidence_has_none() -> None:
    assert faults() == []
    assert faults(replace(GOOD, operator="A. Meier", finished="2026-03-02T12:00:00Z")) == []


ANOTHER_STATION = "the facts name another station than the one that signed"
NOT_CERTIFIED = "its station is not certified by this CA"
SEQUENCE = "sequence or epoch of the facts are not those of the Security TEDS"
BLOCKS = "the blocks of the facts are not those of the Security TEDS (field 108)"


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (lambda: faults(facts=replace(FACTS, station=fingerprint(OTHER.point))), [ANOTHER_STATION]),
        (lambda: faults(replace(GOOD, keyid=fingerprint(OTHER.point))), [ANOTHER_STATION]),
        (lambda: faults(replace(GOOD, station=OTHER.point)), [ANOTHER_STATION, NOT_CERTIFIED]),
        (lambda: faults(replace(GOOD, certificate=certified(LINE, OTHER))), [NOT_CERTIFIED]),
        (lambda: faults(replace(GOOD, certificate=bytes(64))), [NOT_CERTIFIED]),
        (lambda: faults(replace(GOOD, verdict="failed")), ["the verdict is failed, the steps say otherwise"]),
        (lambda: faults(facts=BROKE), ["the verdict is passed, the steps say otherwise"]),
        (lambda: faults(replace(GOOD, digest=H)), ["the subject is not the digest of the Security TEDS that is here"]),
        (lambda: faults(replace(GOOD, proof=b"", nonce=b""), board=None), ["the board did not sign it"]),
        (lambda: faults(replace(GOOD, node=OTHER.point)), ["the Security TEDS names another node key (field 101)"]),
        (lambda: faults(node_key=False), ["field 102 does not sign this key for this UUID"]),
        (lambda: faults(facts=replace(FACTS, sequence=8)), [SEQUENCE]),
        (lambda: faults(facts=replace(FACTS, epoch=4)), [SEQUENCE]),
        (lambda: faults(facts=replace(FACTS, blocks=())), [BLOCKS]),
        (lambda: faults(facts=replace(FACTS, blocks=((1, 3, H),))), [BLOCKS]),
        (lambda: faults(facts=replace(FACTS, origin=ORIGIN_TEXT)),
         ["the origin of the facts is not that of the Origin TEDS (130)"]),
        (lambda: faults(shown=replace(SHOWN, signature=None)), ["the datasheet is not signed"]),
        (lambda: faults(shown=replace(SHOWN, signature=None), datasheet=None), ["the datasheet is not signed"]),
        (lambda: faults(shown=replace(SHOWN, station_key_signature=certified(OFFICE, OTHER))),
         ["the station that signed the datasheet is not certified by this CA (field 104)"]),
        (lambda: faults(datasheet=False), ["field 100 does not verify: the datasheet was changed"]),
        (lambda: faults(datasheet=None), ["field 100 does not verify: the datasheet was changed"]),
        (lambda: faults(envelope=False), ["the station's signature does not verify: the evidence was changed"]),
        (lambda: faults(board=False), ["the board did not sign these facts (Prove)"]),
        (lambda: faults(shown=None), ["its Security TEDS is not canonical: field 101 is missing"]),
    ],
)  # fmt: skip
def test_one_fault_is_one_sentence(found: Callable[[], list[str]], expected: list[str]) -> None:
    assert found() == expected


def test_every_fault_of_a_datasheet_is_named_whatever_else_is_wrong() -> None:
    shown = replace(SHOWN, station_key_signature=certified(OFFICE, OTHER))
    facts = replace(FACTS, sequence=8, blocks=(), origin=ORIGIN_TEXT)
    assert faults(replace(GOOD, node=OTHER.point), shown, facts=facts, node_key=False, datasheet=False) == [
        "the Security TEDS names another node key (field 101)",
        "field 102 does not sign this key for this UUID",
        SEQUENCE,
        BLOCKS,
        "the origin of the facts is not that of the Origin TEDS (130)",
        "the station that signed the datasheet is not certified by this CA (field 104)",
        "field 100 does not verify: the datasheet was changed",
    ]


def test_the_origin_is_good_if_the_datasheet_lists_it() -> None:
    listed = {**SHOWN.signed_blocks, ORIGIN: hashlib.sha256(origin_from_text(ORIGIN_TEXT).encode()).digest()}
    shown = replace(SHOWN, signed_blocks=listed)
    blocks = tuple((channel, code, digest.hex()) for (channel, code), digest in listed.items())
    assert faults(shown=shown, facts=replace(FACTS, origin=ORIGIN_TEXT, blocks=blocks)) == []
    other = replace(FACTS, origin=ORIGIN_TEXT.replace("brake", "engine"), blocks=blocks)
    assert faults(shown=shown, facts=other) == ["the origin of the facts is not that of the Origin TEDS (130)"]


def test_a_failed_attempt_claims_no_datasheet_and_may_lack_the_boards_word_but_no_false_one() -> None:
    broke = replace(GOOD, verdict="failed", facts=BROKE)
    assert faults(broke) == []
    assert faults(replace(broke, proof=b"", nonce=b""), board=None, datasheet=None) == []
    assert faults(broke, replace(SHOWN, signature=None, station_key=None, station_key_signature=None)) == []
    assert faults(broke, datasheet=False) == []
    assert faults(broke, board=False) == ["the board did not sign these facts (Prove)"]
    assert faults(broke, node_key=False) == ["field 102 does not sign this key for this UUID"]
    assert faults(broke, envelope=False) == ["the station's signature does not verify: the evidence was changed"]


# -- octets ------------------------------------------------------------------------------------------------------------


def test_what_the_board_and_the_station_sign() -> None:
    facts, subject = {"b": [1, "ü"], "a": None}, [{"name": "x"}]
    text = '{"facts":{"a":null,"b":[1,"ü"]},"subject":[{"name":"x"}]}'.encode()
    assert canonical(facts, subject) == text
    nonce = bytes(range(16))
    assert challenge(nonce, text) == hashlib.sha256(b"TEDS1 evidence\x00" + nonce + text).digest()
    assert pae(b"hello") == b"DSSEv1 28 application/vnd.in-toto+json 5 hello"


def sealed(**changes: Any) -> dict[str, Any]:
    claim = EvidenceClaim(UUID, SHOWN.encode(), changes.pop("facts", FACTS))
    given: dict[str, Any] = {"nonce": bytes(16), "proof": bytes(64), "finished": AT, **changes}
    document = json.loads(seal(LINE, certified(LINE), claim, **given))
    assert list(document) == ["payload", "payloadType", "signatures"]
    assert document["payloadType"] == "application/vnd.in-toto+json"
    assert [list(one) for one in document["signatures"]] == [["keyid", "sig"]]
    assert document["signatures"][0]["keyid"] == fingerprint(LINE.point)
    payload: dict[str, Any] = json.loads(codec.base64_of(document["payload"], "payload"))
    return payload


def test_a_statement_is_whole_and_in_the_order_of_the_contract() -> None:
    teds, station = SHOWN.encode(), fingerprint(LINE.point)
    whole = sealed(operator="A. Meier")
    assert whole == {
        "_type": "https://in-toto.io/Statement/v1",
        "subject": [{"name": f"teds:{UUID.hex()}", "digest": {"sha256": hashlib.sha256(teds).hexdigest()}}],
        "predicateType": "urn:x-teds-provision:evidence:1",
        "predicate": {
            "facts": {
                "station": station, "job": None, "unit": None, "attempt": 1, "profile": None, "profile_sha256": None,
                "calibration_sha256": None, "epoch": 3, "sequence": 7, "blocks": [[1, 3, "cd" * 32]],
                "steps": [["check", "ok", 12]], "assurance": "tap", "tool": "teds-provision 1", "begun": AT,
                "heads": None,
            },
            "verdict": "passed",
            "finished": AT,
            "operator": "A. Meier",
            "node": {"point": NODE.point.hex(), "nonce": "00" * 16, "proof": "00" * 64, "teds": teds.hex()},
            "station": {
                "point": LINE.point.hex(), "certificate": whole["predicate"]["station"]["certificate"],
            },
        },
    }  # fmt: skip
    assert codec.base64_of(whole["predicate"]["station"]["certificate"], "x") == certified(LINE)
    assert list(whole["predicate"]) == ["facts", "verdict", "finished", "operator", "node", "station"]
    assert "operator" not in sealed()["predicate"]
    assert sealed(operator="")["predicate"]["operator"] == ""
    assert sealed(facts=BROKE)["predicate"]["verdict"] == "failed"
    named = replace(FACTS, certificates=((1, H),), origin=None, firmware=("app", "1.2.3+4", H, 1), heads=("0" * 16, 3))
    shown = sealed(facts=named)["predicate"]["facts"]
    assert (shown["certificates"], shown["origin"], shown["firmware"], shown["heads"]) == (
        [[1, H]], None, ["app", "1.2.3+4", H, 1], ["0" * 16, 3]
    )  # fmt: skip
    assert sealed(facts=replace(FACTS, firmware=None))["predicate"]["facts"]["firmware"] is None


def test_a_statement_has_no_spaces_and_its_text_is_utf_8() -> None:
    claim = EvidenceClaim(UUID, SHOWN.encode(), FACTS)
    octets = seal(LINE, certified(LINE), claim, nonce=bytes(16), proof=bytes(64), finished=AT, operator="J. Müller")
    payload = codec.base64_of(json.loads(octets)["payload"], "payload")
    assert f'"finished":"{AT}","operator":"J. Müller","node":{{'.encode() in payload
    assert b'","payloadType":"' in octets


@pytest.mark.parametrize(
    ("member", "value", "good"),
    [
        ("unit", 1, True), ("unit", 0, False), ("unit", None, True), ("attempt", 1, True), ("attempt", 0, False),
        ("attempt", None, False), ("heads", "", False), ("heads", [], False), ("heads", ["0" * 16, 3], True),
        ("heads", ["0" * 15, 3], False),
        ("heads", ["0" * 16], False), ("heads", ["G" * 16, 3], False), ("heads", ["A" * 16, 3], False),
        ("heads", ["0" * 16, -1], False), ("heads", ["0" * 16, True], False), ("heads", ["0" * 16, 0], True),
        ("epoch", 4_294_967_295, True),
        ("epoch", 4_294_967_296, False), ("epoch", -1, False), ("epoch", 1.5, False), ("epoch", True, False),
        ("steps", [["x", "ok", 1]] * 64, True), ("steps", [["x", "ok", 1]] * 65, False),
        ("certificates", [[255, H]], True), ("certificates", [[256, H]], False),
        ("certificates", [[1, H.upper()]], False), ("blocks", [[65535, 255, H]], True),
        ("blocks", [[65536, 255, H]], False), ("blocks", [[1, 256, H]], False),
        ("begun", "2026-02-31T12:00:00Z", False),
    ],
)  # fmt: skip
def test_a_fact_is_read_at_its_limit_and_not_beyond_it(member: str, value: object, good: bool) -> None:
    facts = {**FACTS.to_json(), member: value}
    if good:
        codec._facts(Members(facts, "The facts"), facts)
        return
    with pytest.raises(BadDataError):
        codec._facts(Members(facts, "The facts"), facts)


def enveloped(statement: dict[str, Any], **changes: Any) -> bytes:
    """Return the envelope of a statement, of which nobody looks at the signature."""
    envelope = {
        "payload": base64.b64encode(json.dumps(statement).encode()).decode(),
        "payloadType": "application/vnd.in-toto+json",
        "signatures": [{"keyid": fingerprint(LINE.point), "sig": "AA=="}],
    }
    return json.dumps({**envelope, **changes}).encode()


@pytest.mark.parametrize(
    ("of_statement", "of_envelope"),
    [
        ({"_type": "https://in-toto.io/Statement/v0.1"}, {}),
        ({"predicateType": "urn:x-teds-provision:evidence:2"}, {}),
        ({}, {"payloadType": "application/json"}),
        ({}, {"more": 1}),
        ({}, {"signatures": []}),
        ({}, {"signatures": [{"keyid": "a", "sig": "AA=="}] * 2}),
        ({}, {"signatures": [{"keyid": "a", "sig": "AA==", "more": 1}]}),
        ({}, {"signatures": [{"keyid": "a"}]}),
    ],
)
def test_what_is_no_envelope_of_evidence_is_unreadable(
    of_statement: dict[str, Any], of_envelope: dict[str, Any]
) -> None:
    codec.read(enveloped(sealed()))
    with pytest.raises(BadDataError):
        codec.read(enveloped({**sealed(), **of_statement}, **of_envelope))


def test_a_step_that_had_nothing_to_do_is_no_failure() -> None:
    good = tuple((f"step {word}", word, 1) for word in ("ok", "done", "nothing to do", "skipped"))
    assert replace(FACTS, steps=good).failure is None
    assert replace(FACTS, steps=(*good, ("agree", "node-silent", 1), ("verdict", "job", 1))).failure == "node-silent"


@pytest.mark.parametrize("error", [None, NodeSilentError("x"), NodeRefusedError("x", reason=6)])
def test_a_board_that_signs_wrongly_or_not_at_all_fails_a_pass_and_leaves_a_failure_without_its_word(
    error: Exception | None,
) -> None:
    def asked(*_: object) -> bytes:
        if error is not None:
            raise error
        return bytes(64)

    node = cast("Conversation", SimpleNamespace(request_idempotent=asked))
    credentials = cast("Credentials", SimpleNamespace(key=LINE, station_signature=certified(LINE)))
    teds = SHOWN.encode()
    with pytest.raises((NotAuthenticError, NodeSilentError, NodeRefusedError)):
        sign_evidence(node, credentials, EvidenceClaim(UUID, teds, FACTS))
    document = sign_evidence(node, credentials, EvidenceClaim(UUID, teds, BROKE), finished=AT)
    read = codec.read(document)
    assert (read.nonce, read.proof, read.verdict, read.finished) == (b"", b"", "failed", AT)


def test_a_board_is_known_by_the_pins_file() -> None:
    checked = CheckedEvidence(GOOD, SHOWN, "", b"", b"")
    own = fingerprint(NODE.point)
    for pins, expected in (
        (None, []),
        ({UUID: own}, []),
        ({UUID: own[:32]}, []),
        ({}, ["its UUID is not in the pins file"]),
        ({UUID: ""}, ["its UUID is not in the pins file"]),
        ({UUID: H}, ["its key differs from the one in the pins file"]),
    ):
        assert EvidenceAnchors(CA.point, pins).faults_of(checked, ALL_GOOD) == expected


@pytest.mark.parametrize(
    ("nonce", "proof", "good"),
    [(16, 64, True), (0, 0, True), (16, 0, False), (0, 64, False), (15, 64, False), (17, 64, False), (16, 63, False)],
)
def test_a_nonce_and_a_proof_are_there_both_or_neither(nonce: int, proof: int, good: bool) -> None:
    statement = sealed()
    statement["predicate"]["node"] |= {"nonce": "00" * nonce, "proof": "00" * proof}
    document = enveloped(statement)
    if good:
        assert (len(codec.read(document).nonce), len(codec.read(document).proof)) == (nonce, proof)
        return
    with pytest.raises(BadDataError):
        codec.read(document)


def test_evidence_has_at_most_a_mebibyte() -> None:
    with pytest.raises(BadDataError, match="at most 1048576 "):
        codec.read(b" " * 1_048_577)
    with pytest.raises(BadDataError) as error:
        codec.read(b" " * 1_048_576)
    assert "at most" not in error.value.message


@pytest.mark.parametrize(
    ("value", "plain"),
    [
        (0, True), (4294967295, True), ("", True), (None, True), ([], True), ([[[["a", 1, None]]]], False),
        ([[[["a"]]]], False), ([[["a", 1, None]]], True), ({"a": {"b": {"c": 1}}}, True),
        ({"a": {"b": {"c": {"d": 1}}}}, False), (-1, False), (4294967296, False), (True, False), (False, False),
        (1.0, False), ([1, [2.5]], False), ([-1], False), ({"a": 4294967296}, False), (b"a", False), ((1,), False),
    ],
)  # fmt: skip
def test_facts_hold_texts_whole_numbers_lists_and_null(value: object, plain: bool) -> None:
    """JSON with one spelling in RFC 8785; numbers of 32 bits, four levels deep including the facts."""
    if plain:
        codec._require_plain({"a": value})
        return
    with pytest.raises(BadDataError) as no:
        codec._require_plain({"a": value})
    assert no.value.message == "The facts hold something else than texts, whole numbers, lists and null."


def test_half_a_surrogate_pair_has_no_form_that_could_be_signed() -> None:
    with pytest.raises(BadDataError) as no:
        codec.canonical({"unit": "\ud800"}, [])
    assert no.value.message == "A text of the evidence is not Unicode."


def test_a_statement_of_separators_alone_is_not_read() -> None:
    """Each costs an object: 40,000 are read, and no more."""
    for number, words in ((40_000, "The statement"), (40_001, "far more members than evidence")):
        with pytest.raises(BadDataError) as no:
            codec._statement(b"[" + b"0," * (number - 1) + b"0]", "", b"")
        assert words in no.value.message, no.value.message
