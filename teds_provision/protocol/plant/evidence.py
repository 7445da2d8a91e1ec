"""Evidence of one board and attempt: an in-toto Statement v1 in a DSSE envelope (line.md, "Evidence"). Pure.

The station signs the envelope (ECDSA P-256 with SHA-256, DER, over the PAE of DSSE 1.0). The board signs too: Prove,
over a challenge that binds subject and facts, so that who changes them afterwards needs the board again.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final, NamedTuple

from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature

from teds_provision.errors import BadDataError
from teds_provision.limits import check_size
from teds_provision.protocol import datasheet
from teds_provision.protocol.handover.strict_json import LAST_U32, Members, load_object, refuse_many, separators
from teds_provision.protocol.keys import (
    POINT_OCTETS,
    SIGNATURE_OCTETS,
    PrivateKey,
    fingerprint,
    is_point,
    node_key_message,
    prove_message,
    verify,
    verify_der,
    verify_each_once,
    verify_once,
)
from teds_provision.protocol.messages.firmware import FirmwareReport, is_stated
from teds_provision.teds.codec import security
from teds_provision.teds.codec.security import SecurityTeds
from teds_provision.teds.origin import ORIGIN, origin_from_text

PAYLOAD_TYPE: Final = "application/vnd.in-toto+json"
STATEMENT_TYPE: Final = "https://in-toto.io/Statement/v1"
PREDICATE_TYPE: Final = "urn:x-teds-provision:evidence:1"
MAX_OCTETS: Final = 1 << 20
"""The Security TEDS of 255 channels with all their TEDS, twice, in hex and base64, is half of it."""
NONCE_OCTETS: Final = 16
PASSED, FAILED = "passed", "failed"
GOOD_RESULTS: Final = frozenset({"ok", "done", "nothing to do", "skipped"})
"""Results of a step that ended well; any other is the code of the error that ended the attempt."""

_MAX_SEPARATORS: Final = 40_000
_MAX_STEPS: Final = 64
LAST_CHANNEL: Final = 255
_DEPTH: Final = 4
_spelled: Final = json.JSONEncoder(
    sort_keys=True, separators=(",", ":"), ensure_ascii=False, check_circular=False
).encode
_OF_SUBJECT: Final = frozenset({"name", "digest"})
_UUID_NAME: Final = re.compile(r"teds:([0-9a-f]{20})")
_DIGEST: Final = re.compile(r"[0-9a-f]{64}")
_TIME: Final = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ")


NO_IMAGE: Final = "0" * 64
"""Of a board whose firmware names no image digest."""


@dataclass(frozen=True)
class BoardFacts:
    """The facts that a board signs beside its datasheet: maker, job, components, and each step.

    ``epoch``, ``sequence`` and ``blocks`` (channel, access code, SHA-256) are those of the Security TEDS. ``job`` and
    ``unit`` are None outside a job, ``heads`` (first 16 digits, number of chains) if no registry was joined. ``steps``:
    name, result, milliseconds. Times are ``2026-01-31T12:00:00Z``. ``certificates`` are channel and SHA-256 of the
    calibration certificates that the datasheet names, ``origin`` is the text of its Origin TEDS; evidence of older
    versions has neither, and ``certificates`` is None. ``firmware`` is what the board reported in the session of verify
    (text, version with build, image digest or zeros in hex, flags), None if it reported none, () if the evidence is of
    a version that did not state it.
    """

    station: str
    job: str | None
    unit: int | None
    attempt: int
    profile: str | None
    profile_sha256: str | None
    calibration_sha256: str | None
    epoch: int
    sequence: int
    blocks: tuple[tuple[int, int, str], ...]
    steps: tuple[tuple[str, str, int], ...]
    assurance: str
    tool: str
    begun: str
    heads: tuple[str, int] | None = None
    certificates: tuple[tuple[int, str], ...] | None = None
    origin: str | None = None
    firmware: tuple[str, str, str, int] | tuple[()] | None = ()

    def to_json(self) -> dict[str, Any]:
        """Return the member ``facts`` of the predicate."""
        found = self._all_json()
        if self.firmware == ():
            del found["firmware"]
        if self.certificates is None:
            del found["certificates"], found["origin"]
            return found
        return {**found, "certificates": [list(certificate) for certificate in self.certificates]}

    def _all_json(self) -> dict[str, Any]:
        lists = {"blocks": [list(block) for block in self.blocks], "steps": [list(step) for step in self.steps]}
        heads, firmware = self.heads and list(self.heads), self.firmware and list(self.firmware)
        return {**vars(self), **lists, "heads": heads, "firmware": firmware}

    @property
    def failure(self) -> str | None:
        """The code of the error that ended the attempt, None if no step failed."""
        return next((result for _, result, _ in self.steps if result not in GOOD_RESULTS), None)


@dataclass(frozen=True)
class EvidenceClaim:
    """Facts to be proven of a board, with its UUID and the Security TEDS that it shows (framed)."""

    uuid: bytes
    teds: bytes = field(repr=False)
    facts: BoardFacts

    @property
    def subject(self) -> list[dict[str, Any]]:
        """Member ``subject`` of the Statement."""
        return [{"name": f"teds:{self.uuid.hex()}", "digest": {"sha256": hashlib.sha256(self.teds).hexdigest()}}]

    def challenge(self, nonce: bytes) -> bytes:
        """Return the challenge (32 octets) of Prove; see :func:`challenge`."""
        return challenge(nonce, canonical(self.facts.to_json(), self.subject))


def canonical(facts: Mapping[str, Any], subject: object) -> bytes:
    """Return the RFC 8785 form of ``{facts, subject}``, which hold only texts, whole numbers, lists and null."""
    try:
        return _spelled({"facts": facts, "subject": subject}).encode()
    except UnicodeEncodeError as error:  # half a surrogate pair
        raise BadDataError("A text of the evidence is not Unicode.") from error


def challenge(nonce: bytes, bound: bytes) -> bytes:
    """Return what the board signs by Prove: SHA-256("TEDS1 evidence" ‖ 00 ‖ nonce ‖ RFC 8785 form)."""
    return hashlib.sha256(b"TEDS1 evidence\0" + nonce + bound).digest()


def pae(payload: bytes) -> bytes:
    """Return what a DSSE envelope of our payload type signs (DSSE 1.0, "Signature Definition")."""
    return b"DSSEv1 %d %s %d %s" % (len(PAYLOAD_TYPE), PAYLOAD_TYPE.encode(), len(payload), payload)


def seal(
    key: PrivateKey,
    certificate: bytes,
    claim: EvidenceClaim,
    *,
    nonce: bytes,
    proof: bytes,
    finished: str,
    operator: str | None = None,
) -> bytes:
    """Return the envelope, signed by the station ``key`` with its ``certificate`` (field 104, 64 octets).

    ``proof`` is the board's signature over the challenge of ``nonce``; both are empty for a failed attempt at a board
    that no longer answers.
    """
    shown = security.decode(claim.teds)
    node = {"point": shown.node_key.hex(), "nonce": nonce.hex(), "proof": proof.hex(), "teds": claim.teds.hex()}
    predicate = {
        "facts": claim.facts.to_json(),
        "verdict": PASSED if claim.facts.failure is None else FAILED,
        "finished": finished,
        **({"operator": operator} if operator is not None else {}),
        "node": node,
        "station": {"point": key.point.hex(), "certificate": base64.b64encode(certificate).decode()},
    }
    statement = {
        "_type": STATEMENT_TYPE,
        "subject": claim.subject,
        "predicateType": PREDICATE_TYPE,
        "predicate": predicate,
    }
    payload = json.dumps(statement, separators=(",", ":"), ensure_ascii=False).encode()
    raw = key.sign(pae(payload))
    der = encode_dss_signature(int.from_bytes(raw[:32], "big"), int.from_bytes(raw[32:], "big"))
    signature = {"keyid": fingerprint(key.point), "sig": base64.b64encode(der).decode()}
    envelope = {
        "payload": base64.b64encode(payload).decode(),
        "payloadType": PAYLOAD_TYPE,
        "signatures": [signature],
    }
    return json.dumps(envelope, separators=(",", ":")).encode()


@dataclass(frozen=True)
class Evidence:
    """A document as it was read; nothing of it is verified yet (:func:`faults`).

    ``bound`` is the RFC 8785 form that the board signed. ``nonce`` and ``proof`` are empty if no board answered.
    """

    uuid: bytes
    digest: str
    facts: BoardFacts
    verdict: str
    finished: str
    operator: str | None
    node: bytes
    nonce: bytes
    proof: bytes
    teds: bytes = field(repr=False)
    station: bytes
    certificate: bytes
    bound: bytes = field(repr=False)
    payload: bytes = field(repr=False)
    keyid: str
    signature: bytes = field(repr=False)


def read(octets: bytes) -> Evidence:
    """Read an envelope; raises BadDataError for what is not of our form, whatever the octets."""
    check_size(len(octets), MAX_OCTETS, "the evidence")
    if len(octets) > _MAX_SEPARATORS:
        refuse_many(separators(octets), 64, "an envelope of evidence")
    envelope = load_object(octets, "The evidence")
    if envelope.keys() != {"payload", "payloadType", "signatures"} or envelope["payloadType"] != PAYLOAD_TYPE:
        raise BadDataError(
            f"This is not a DSSE envelope of {PAYLOAD_TYPE}.", hint="Evidence comes from: evidence export"
        )
    signatures = envelope["signatures"]
    if not isinstance(signatures, list) or len(signatures) != 1 or not isinstance(signatures[0], dict):
        raise BadDataError("The envelope of the evidence has not exactly one signature.")
    keyid, signature = signatures[0].get("keyid"), base64_of(signatures[0].get("sig"), "sig")
    if signatures[0].keys() != {"keyid", "sig"}:
        raise BadDataError("The signature of the envelope has other members than keyid and sig.")
    payload = base64_of(envelope["payload"], "payload")
    return _statement(payload, keyid if isinstance(keyid, str) else "", signature)


def _statement(payload: bytes, keyid: str, signature: bytes) -> Evidence:
    if len(payload) > _MAX_SEPARATORS:
        refuse_many(separators(payload), _MAX_SEPARATORS, "evidence")
    statement = load_object(payload, "The statement")
    if statement.get("_type") != STATEMENT_TYPE or statement.get("predicateType") != PREDICATE_TYPE:
        raise BadDataError(f"This is no in-toto Statement v1 of {PREDICATE_TYPE}.")
    subject = statement.get("subject")
    uuid, digest = _subject(subject)
    predicate = Members(statement.get("predicate"), "The predicate")
    members = Members(predicate.get("facts"), "The facts")
    facts = _facts(members, predicate.get("facts"))
    node = Members(predicate.get("node"), "The node of the evidence")
    station = Members(predicate.get("station"), "The station of the evidence")
    nonce, proof = _hex(node, "nonce", (0, NONCE_OCTETS)), _hex(node, "proof", (0, SIGNATURE_OCTETS))
    if bool(nonce) != bool(proof):
        raise BadDataError("The evidence holds one of nonce and proof, not both.")
    verdict = predicate.text("verdict")
    if verdict not in (PASSED, FAILED):
        raise BadDataError(f"The verdict of the evidence is neither {PASSED} nor {FAILED}.")
    return Evidence(
        uuid,
        digest,
        facts,
        verdict,
        _time(predicate, "finished"),
        predicate.text_or_none("operator"),
        _hex(node, "point", (POINT_OCTETS,)),
        nonce,
        proof,
        _hex(node, "teds", None),
        _hex(station, "point", (POINT_OCTETS,)),
        base64_of(station.get("certificate"), "certificate"),
        canonical(predicate.get("facts"), subject),
        payload,
        keyid,
        signature,
    )


@dataclass(frozen=True)
class CheckedEvidence:
    """A document of which everything but its signatures was looked at: its Security TEDS, or why that is none."""

    evidence: Evidence
    shown: SecurityTeds | None
    why: str
    datasheet: bytes
    board: bytes


class Signatures(NamedTuple):
    """Results of verifying a document's signatures; None: not verified."""

    envelope: bool
    node_key: bool
    datasheet: bool | None
    board: bool | None


def ready(evidence: Evidence) -> CheckedEvidence:
    """Look at everything that comes before the signatures."""
    try:
        shown, signed = security.decode_with_tbs(evidence.uuid, evidence.teds)
    except BadDataError as error:
        return CheckedEvidence(evidence, None, error.message, b"", b"")
    asked = prove_message(evidence.uuid, challenge(evidence.nonce, evidence.bound)) if evidence.proof else b""
    return CheckedEvidence(evidence, shown, "", signed, asked)


def check_signatures(checked: CheckedEvidence) -> Signatures:
    """Check the signatures alone: of many documents in a row each costs half of what it costs between other work."""
    evidence, shown = checked.evidence, checked.shown
    envelope = verify_der(evidence.station, pae(evidence.payload), evidence.signature)
    if shown is None:
        return Signatures(envelope, False, None, None)
    signed = [(node_key_message(evidence.uuid, shown.node_key), shown.node_key_signature)]
    if evidence.proof and evidence.node == shown.node_key:
        signed.append((checked.board, evidence.proof))
    node_key, *proven = verify_each_once(shown.node_key, signed)  # one key of thousands: it is not kept
    board: bool | None = proven[0] if proven else None
    if evidence.proof and not proven:
        board = verify_once(evidence.node, checked.board, evidence.proof)
    made: bool | None = None
    if evidence.verdict == PASSED and shown.station_key is not None and shown.signature is not None:
        made = verify(shown.station_key, checked.datasheet, shown.signature)
    return Signatures(envelope, node_key, made, board)


def faults(evidence: Evidence, ca: bytes) -> list[str]:
    """Return the faults of a document, a sentence each; empty if it holds under the owner's ``ca`` (65 octets).

    A document of an attempt that ``failed`` claims no datasheet: its Security TEDS is what the board showed, and the
    board's proof may be absent.
    """
    one = ready(evidence)
    return faults_of(one, check_signatures(one), ca)


def faults_of(checked: CheckedEvidence, signatures: Signatures, ca: bytes) -> list[str]:
    """Return the same as :func:`faults`, for signatures that were checked already."""
    words = _wrong_words(checked.evidence)
    return [*words, *_wrong_datasheet(checked, signatures, ca), *_wrong_signatures(checked.evidence, signatures, ca)]


def _wrong_words(evidence: Evidence) -> Iterator[str]:
    if not evidence.facts.station == evidence.keyid == fingerprint(evidence.station):
        yield "the facts name another station than the one that signed"
    if (evidence.facts.failure is None) != (evidence.verdict == PASSED):
        yield f"the verdict is {evidence.verdict}, the steps say otherwise"
    if evidence.digest != hashlib.sha256(evidence.teds).hexdigest():
        yield "the subject is not the digest of the Security TEDS that is here"
    if evidence.verdict == PASSED and not evidence.proof:
        yield "the board did not sign it"


def _wrong_datasheet(checked: CheckedEvidence, signatures: Signatures, ca: bytes) -> Iterator[str]:
    evidence, facts, shown = checked.evidence, checked.evidence.facts, checked.shown
    if shown is None:
        yield f"its Security TEDS is not canonical: {checked.why}"
        return
    if shown.node_key != evidence.node:
        yield "the Security TEDS names another node key (field 101)"
    if not signatures.node_key:
        yield "field 102 does not sign this key for this UUID"
    if (shown.sequence, shown.key_epoch) != (facts.sequence, facts.epoch):
        yield "sequence or epoch of the facts are not those of the Security TEDS"
    if blocks_of(shown) != facts.blocks:
        yield "the blocks of the facts are not those of the Security TEDS (field 108)"
    if facts.origin is not None and not _is_listed(facts.origin, shown):
        yield "the origin of the facts is not that of the Origin TEDS (130)"
    if evidence.verdict != PASSED:
        return
    if not shown.signed:
        yield "the datasheet is not signed"
        return
    if not datasheet.is_certified(ca, shown.station_key, shown.station_key_signature):
        yield "the station that signed the datasheet is not certified by this CA (field 104)"
    if not signatures.datasheet:
        yield "field 100 does not verify: the datasheet was changed"


def _is_listed(origin: str, shown: SecurityTeds) -> bool:
    """Return True if field 108 lists the TEDS that holds this origin."""
    return shown.signed_blocks.get(ORIGIN) == hashlib.sha256(origin_from_text(origin).encode()).digest()


def _wrong_signatures(evidence: Evidence, signatures: Signatures, ca: bytes) -> Iterator[str]:
    if not datasheet.is_certified(ca, evidence.station, evidence.certificate):
        yield "its station is not certified by this CA"
    if not signatures.envelope:
        yield "the station's signature does not verify: the evidence was changed"
    if signatures.board is False:
        yield "the board did not sign these facts (Prove)"


def blocks_of(shown: SecurityTeds) -> tuple[tuple[int, int, str], ...]:
    """Return fields 108 as ``facts`` list them: channel, access code, SHA-256 as 64 hex digits."""
    return tuple((channel, code, digest.hex()) for (channel, code), digest in shown.signed_blocks.items())


def _subject(subject: object) -> tuple[bytes, str]:
    one = subject[0] if type(subject) is list and len(subject) == 1 else None
    if type(one) is dict and one.keys() == _OF_SUBJECT:  # a match statement takes three times as long
        name, digests = one["name"], one["digest"]
        digest = digests.get("sha256") if type(digests) is dict and len(digests) == 1 else None
        if type(name) is str and type(digest) is str and _DIGEST.fullmatch(digest):
            found = _UUID_NAME.fullmatch(name)
            if found:
                return bytes.fromhex(found[1]), digest
    raise BadDataError("The subject of the statement is not one teds:UUID with its SHA-256.")


def _facts(members: Members, raw: dict[str, Any]) -> BoardFacts:
    _require_plain(raw)
    heads = members.get("heads")
    return BoardFacts(
        station=_sha256(members, "station"),
        job=None if members.get("job") is None else members.random_id("job"),
        unit=None if members.get("unit") is None else members.u32("unit", 1),
        attempt=members.u32("attempt", 1),
        profile=members.text_or_none("profile"),
        profile_sha256=_sha256_or_none(members, "profile_sha256"),
        calibration_sha256=_sha256_or_none(members, "calibration_sha256"),
        epoch=members.u32("epoch"),
        sequence=members.u32("sequence"),
        blocks=tuple(_block(block) for block in members.list_of("blocks")),
        steps=tuple(_step(step) for step in _short(members.list_of("steps"))),
        assurance=members.text("assurance"),
        tool=members.text("tool"),
        begun=_time(members, "begun"),
        heads=None if heads is None else _heads(heads),
        certificates=_certificates(members),
        origin=_origin(members),
        firmware=_firmware(raw),
    )


def _certificates(members: Members) -> tuple[tuple[int, str], ...] | None:
    if members.get("certificates") is None:
        return None
    found = members.list_of("certificates")
    for entry in found:
        match entry:
            case [int(channel), str(digest)] if 0 <= channel <= LAST_CHANNEL and _DIGEST.fullmatch(digest):
                continue
        raise BadDataError("A certificate of the facts is not a channel and its SHA-256.")
    return tuple((channel, digest) for channel, digest in found)


def _firmware(raw: Mapping[str, Any]) -> tuple[str, str, str, int] | tuple[()] | None:
    if "firmware" not in raw:
        return ()
    match raw["firmware"]:
        case None:
            return None
        case [str(text), str(version), str(image), int(flags)] if 0 <= flags <= 0xFF and is_stated(
            [text, version, None if image == NO_IMAGE else image]
        ):
            return text, version, image, flags
    raise BadDataError("The firmware of the facts is not text, version, image and flags.")


def firmware_facts(report: FirmwareReport) -> tuple[str, str, str, int]:
    """Return what the facts state of a board's firmware."""
    text, version, image = report.stated
    return text, version, image or NO_IMAGE, int(report.flags)


def _origin(members: Members) -> str | None:
    origin = members.get("origin")
    if origin is None:
        return None
    if not isinstance(origin, str):
        raise BadDataError("The origin of the facts is not a text.")
    origin_from_text(origin)
    return origin


def _require_plain(value: object, depth: int = _DEPTH) -> None:
    """Raise BadDataError for what RFC 8785 would have to spell: floating numbers, true and false, huge integers."""
    kind = type(value)
    if kind is str or value is None or (kind is int and 0 <= value <= LAST_U32):  # type: ignore[operator]
        return
    if not depth or kind not in (dict, list):
        raise BadDataError("The facts hold something else than texts, whole numbers, lists and null.")
    for member in value.values() if kind is dict else value:  # type: ignore[attr-defined, union-attr]
        own = type(member)
        if own is not str and member is not None and (own is not int or not 0 <= member <= LAST_U32):
            _require_plain(member, depth - 1)  # only for a few members: a call takes longer than the check


def _short(steps: list[Any]) -> list[Any]:
    if len(steps) > _MAX_STEPS:
        raise BadDataError(f"The facts name {len(steps)} steps; at most {_MAX_STEPS} are read.")
    return steps


def _block(value: object) -> tuple[int, int, str]:
    # There are no booleans here (_require_plain), which would pass as int. A match statement takes three times as long.
    if type(value) is list and len(value) == 3:
        channel, code, digest = value
        small = type(channel) is int and type(code) is int and channel <= 0xFFFF and code <= 0xFF
        if small and type(digest) is str and _DIGEST.fullmatch(digest):
            return channel, code, digest
    raise BadDataError("A block of the facts is not [channel, access code, SHA-256].")


def _step(value: object) -> tuple[str, str, int]:
    if type(value) is list and len(value) == 3:
        name, result, milliseconds = value
        texts = type(name) is str and type(result) is str and name.isprintable() and result.isprintable()
        if texts and type(milliseconds) is int:
            return name, result, milliseconds
    raise BadDataError("A step of the facts is not [name, result, milliseconds].")


def _heads(heads: object) -> tuple[str, int]:
    match heads:
        case [str(digits), int(count)] if re.fullmatch(r"[0-9a-f]{16}", digits) and not isinstance(count, bool):
            if count < 0:
                raise BadDataError("The number of chains of the facts is negative.")
            return digits, count
    raise BadDataError("The heads of the facts are not [16 digits, number of chains].")


def _sha256(members: Members, name: str) -> str:
    """Return a digest as ``Members.sha256`` does, if in lower case: the board signed that spelling."""
    text = members.get(name)
    if isinstance(text, str) and _DIGEST.fullmatch(text):
        return text
    members.sha256(name)
    raise BadDataError(f"The facts: {name} is not in lower case.")


def _sha256_or_none(members: Members, name: str) -> str | None:
    return None if members.get(name) is None else _sha256(members, name)


def _time(members: Members, name: str) -> str:
    text = members.text(name)
    if not _TIME.fullmatch(text):
        raise BadDataError(f"The evidence: {name} is not a time like 2026-01-31T12:00:00Z.")
    try:
        datetime.fromisoformat(text)  # rejects dates such as 31 February
    except ValueError:
        members.time(name)  # raises the error with the member's name
    return text


def _hex(members: Members, name: str, lengths: tuple[int, ...] | None) -> bytes:
    text = members.get(name)
    try:
        octets = bytes.fromhex(text) if isinstance(text, str) else None
    except ValueError:
        octets = None
    # fromhex also accepts spaces and capitals; comparing with hex() is three times as fast as a pattern.
    if octets is None or octets.hex() != text or (lengths and len(octets) not in lengths):
        raise BadDataError(f"The evidence: {name} is not hex of the right length.")
    if name == "point" and not is_point(octets):
        raise BadDataError("The evidence holds a key that is no point of P-256.")
    return octets


def base64_of(text: object, name: str) -> bytes:
    """Read a text of base64 that is spelled one way; raises BadDataError that calls it ``name``."""
    try:
        octets = binascii.a2b_base64(text, strict_mode=True) if isinstance(text, str) else None
    except ValueError as error:
        raise BadDataError(f"The evidence: {name} is not base64.") from error
    # Strict mode does not check the spare bits and padding at the end: encode only the end again, not all 4,000 octets.
    end = (len(octets) - 1) // 3 if octets else 0
    if octets is None or binascii.b2a_base64(octets[3 * end :], newline=False).decode() != str(text)[4 * end :]:
        raise BadDataError(f"The evidence: {name} is not base64 in its one spelling.")
    return octets
