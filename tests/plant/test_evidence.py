"""Evidence of a board: what holds, what does not, and whoever signs it."""

from __future__ import annotations

import base64
import hashlib
import itertools
import json
import os
import signal
from collections.abc import Callable
from contextlib import closing, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from cryptography.hazmat.primitives.serialization import load_pem_public_key
from in_toto_attestation.v1.statement import Statement
from securesystemslib.dsse import Envelope
from securesystemslib.signer import SSlibKey

from teds_provision.errors import BadDataError, NodeSilentError, NotAuthenticError, TedsProvisionError
from teds_provision.plant.commands import line as line_command
from teds_provision.plant.evidence import export, sign_evidence
from teds_provision.plant.line import _firmware_in_session, _named_in
from teds_provision.plant.verify_evidence import EvidenceTotals, JudgedEvidence
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message, to_pem
from teds_provision.protocol.messages.firmware import FirmwareReport
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.evidence import EvidenceClaim
from teds_provision.provisioning.agree import require_session
from teds_provision.provisioning.firmware import read_firmware
from teds_provision.provisioning.identify import identify
from teds_provision.station.plant.line import EvidenceRow
from teds_provision.station.station import Station
from teds_provision.teds.certificate import CertificateReference
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.origin import ORIGIN, Origin
from tests.bench import Board, MemoryLink, make_station, talk
from tests.cli.shell import call
from tests.provisioning.test_firmware import GOOD, FirmwareBoard

from .proofs import evidence_of, facts_of, run, signed_anew

KAT = json.loads((Path(__file__).parents[1] / "vectors" / "profile" / "plant_kat.json").read_text())


@pytest.fixture
def document(station: Station, board: Board) -> bytes:
    return evidence_of(station, board, operator="A. Meier")


def faults(station: Station, document: bytes) -> list[str]:
    return codec.faults(codec.read(document), station.identity.ca)


def test_evidence_holds_under_the_ca_of_its_owner(station: Station, board: Board, document: bytes) -> None:
    evidence = codec.read(document)
    assert faults(station, document) == []
    assert (evidence.uuid, evidence.verdict, evidence.operator) == (board.uuid, "passed", "A. Meier")
    assert evidence.facts.steps == (("identify", "done", 41), ("write", "done", 1250))


def kept_evidence(station: Station, uuid: bytes, finished: str, document: bytes) -> bytes:
    """Keep a document (any octets) as evidence of a board."""
    digest = hashlib.sha256(document).hexdigest()
    with station.transaction():
        station.plant.line.add_evidence(EvidenceRow(digest, uuid, None, None, 1, "passed", finished, document))
    return document


def exported(station: Station, folder: Path, **more: bool) -> dict[str, bool]:
    """Export all evidence of a station; return the names of files, and which are new."""
    found = export(station, station.plant.line.evidence(), folder, **more)
    return {path.name: new for path, new in found.items()}


def test_evidence_of_two_stations_of_one_board_in_one_folder_replaces_nothing(station: Station, tmp_path: Path) -> None:
    """The second station's file took the place of the first one's proof, without a word."""
    uuid, proof = bytes(range(10)), tmp_path / "proof"
    one = kept_evidence(station, uuid, "2026-11-28T10:00:00Z", b"one")
    with closing(make_station(tmp_path / "other", "other")) as other:
        two = kept_evidence(other, uuid, "2026-11-28T11:00:00Z", b"two")
        three = kept_evidence(other, uuid, "2026-11-28T12:00:00Z", b"three")
        first, second, third = (f"{uuid.hex()}.{number}.json" for number in (1, 2, 3))
        assert exported(station, proof) == {first: True}
        assert exported(other, proof, write=False) == {second: True, third: True}
        for new in (True, False):
            assert exported(other, proof) == {second: new, third: new}
    assert exported(station, proof) == {first: False}
    assert [(proof / name).read_bytes() for name in (first, second, third)] == [one, two, three]


def test_evidence_keeps_its_file_when_the_clock_was_set_back(station: Station, tmp_path: Path) -> None:
    uuid, proof = bytes(range(10)), tmp_path / "proof"
    ahead = kept_evidence(station, uuid, "2027-11-28T10:00:00Z", b"ahead")
    exported(station, proof)
    right = kept_evidence(station, uuid, "2026-11-28T10:00:00Z", b"right")
    first, second = (f"{uuid.hex()}.{number}.json" for number in (1, 2))
    assert exported(station, proof) == {second: True, first: False}
    assert [(proof / name).read_bytes() for name in (first, second)] == [ahead, right]


def test_of_two_files_with_one_document_the_one_with_its_number_is_meant(station: Station, tmp_path: Path) -> None:
    uuid = bytes(range(10))
    kept_evidence(station, uuid, "2026-11-28T10:00:00Z", b"one")
    two = kept_evidence(station, uuid, "2026-11-28T11:00:00Z", b"two")
    for number in (1, 2, 3):
        (tmp_path / f"{uuid.hex()}.{number}.json").write_bytes(two)
    assert exported(station, tmp_path) == {f"{uuid.hex()}.4.json": True, f"{uuid.hex()}.2.json": False}


def test_public_verifiers_accept_it(station: Station, document: bytes) -> None:
    """securesystemslib and in-toto-attestation know nothing of us: the key, and what was signed."""
    envelope = Envelope.from_dict(json.loads(document))
    key = SSlibKey.from_crypto(load_pem_public_key(to_pem(station.point).encode()), station.identity.fingerprint)
    assert station.identity.fingerprint in envelope.verify([key], threshold=1)
    statement = json.loads(envelope.payload)
    Statement.copy_from_pb(_parsed(statement)).validate()
    assert statement["predicateType"] == "urn:x-teds-provision:evidence:1"


def _parsed(statement: dict[str, Any]) -> Any:
    from google.protobuf.json_format import ParseDict
    from in_toto_attestation.v1.statement_pb2 import Statement as Message

    return ParseDict(statement, Message())


def test_no_octet_of_it_can_be_another(station: Station, document: bytes) -> None:
    """Octet by octet, with one bit changed: unreadable, or not authentic."""
    for at in range(len(document)):
        changed = document[:at] + bytes([document[at] ^ (1 << at % 7)]) + document[at + 1 :]
        with suppress(TedsProvisionError):
            assert faults(station, changed), f"octet {at}"


def test_half_a_document_is_none(document: bytes) -> None:
    for end in range(0, len(document), 97):
        with pytest.raises(TedsProvisionError):
            codec.read(document[:end])


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s["predicate"]["facts"].update(unit=2),
        lambda s: s["predicate"]["facts"].update(attempt=2),
        lambda s: s["predicate"]["facts"].update(profile="another"),
        lambda s: s["predicate"]["facts"].update(begun="2026-03-01T11:28:59Z"),
        lambda s: s["predicate"]["facts"]["steps"].append(["label", "done", 3]),
        lambda s: s["predicate"]["facts"].update(remark="what no reader knows"),
        lambda s: s["predicate"]["node"].update(nonce="00" * 16),
    ],
)
def test_its_own_station_cannot_change_a_fact(
    station: Station, document: bytes, change: Callable[[dict[str, Any]], object]
) -> None:
    key = station.credentials(codec.read(document).uuid).key
    anew = signed_anew(document, key, change)
    assert faults(station, anew) == ["the board did not sign these facts (Prove)"]


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda s: s["predicate"]["facts"]["steps"].append(["check", "node-silent", 3]), "verdict"),
        (lambda s: s["predicate"].update(verdict="failed"), "verdict"),
        (lambda s: s["predicate"]["node"].update(nonce="", proof=""), "the board did not sign it"),
        (lambda s: s["subject"][0].update(name="teds:8d4d9da65281f7000001"), "field 102"),
        (lambda s: s["predicate"]["facts"].update(sequence=2), "sequence or epoch"),
        (lambda s: s["predicate"]["facts"].update(epoch=2), "sequence or epoch"),
        (lambda s: s["predicate"]["facts"]["blocks"].pop(), "field 108"),
        (lambda s: s["predicate"]["facts"]["blocks"][0].__setitem__(2, "0" * 64), "field 108"),
        (lambda s: s["predicate"]["station"].update(certificate="AA=="), "not certified"),
    ],
)
def test_what_its_own_station_signs_again_is_reported(
    station: Station, document: bytes, change: Callable[[dict[str, Any]], object], why: str
) -> None:
    anew = signed_anew(document, station.credentials(codec.read(document).uuid).key, change)
    assert any(why in fault for fault in faults(station, anew))


@pytest.mark.parametrize(
    "change",
    [
        lambda s: s["subject"].append(s["subject"][0]),
        lambda s: s["subject"].clear(),
        lambda s: s["subject"][0].update(note=1),
        lambda s: s["subject"][0].pop("name"),
        lambda s: s["subject"][0].update(name=5),
        lambda s: s["subject"][0].update(name="8d4d9da65281f7000000"),
        lambda s: s["subject"][0]["digest"].update(sha512="0" * 128),
        lambda s: s["subject"][0]["digest"].update(sha256="A" * 64),
        lambda s: s["subject"][0].update(digest=["sha256"]),
        lambda s: s.update(subject={"name": "teds:8d4d9da65281f7000000"}),
    ],
)
def test_a_statement_has_one_subject_in_one_form(
    station: Station, document: bytes, change: Callable[[dict[str, Any]], object]
) -> None:
    key = station.credentials(codec.read(document).uuid).key
    with pytest.raises(BadDataError, match="subject"):
        codec.read(signed_anew(document, key, change))


@pytest.mark.parametrize(
    "time", ["2026-02-31T11:31:00Z", "2026-03-01T24:31:00Z", "2026-03-01T11:31:00", "٢026-03-01T11:31:00Z"]
)
def test_a_time_that_is_none_is_refused(station: Station, document: bytes, time: str) -> None:
    key = station.credentials(codec.read(document).uuid).key
    for where in (lambda s: s["predicate"].update(finished=time), lambda s: s["predicate"]["facts"].update(begun=time)):
        with pytest.raises(BadDataError, match="time"):
            codec.read(signed_anew(document, key, where))


@pytest.mark.parametrize(
    ("job", "holds"),
    [
        ("0b5f1c52-7d0e-4a3b-9c1d-5e6f7a8b9c0d", True),
        ("0B5F1C52-7D0E-4A3B-9C1D-5E6F7A8B9C0D", True),
        ("0b5f1c52-7d0e-1a3b-9c1d-5e6f7a8b9c0d", False),
        ("0b5f1c52-7d0e-4a3b-cc1d-5e6f7a8b9c0d", False),
        ("0b5f1c527d0e4a3b9c1d5e6f7a8b9c0d", False),
        ("{0b5f1c52-7d0e-4a3b-9c1d-5e6f7a8b9c0d}", False),
    ],
)
def test_a_job_is_a_random_uuid_in_its_one_spelling(station: Station, document: bytes, job: str, holds: bool) -> None:
    key = station.credentials(codec.read(document).uuid).key
    anew = signed_anew(document, key, lambda s: s["predicate"]["facts"].update(job=job))
    if holds:
        assert codec.read(anew).facts.job == job.lower()
        return
    with pytest.raises(BadDataError, match="UUIDv4"):
        codec.read(anew)


def test_a_certified_station_cannot_pass_anothers_evidence_off_as_its_own(station: Station, document: bytes) -> None:
    other = SoftwareKey(11)
    certificate = station.identity.certify(other.point)

    def mine(statement: dict[str, Any]) -> None:
        statement["predicate"]["facts"]["station"] = fingerprint(other.point)
        members = {"point": other.point.hex(), "certificate": base64.b64encode(certificate).decode()}
        statement["predicate"]["station"] = members

    assert faults(station, signed_anew(document, other, mine)) == ["the board did not sign these facts (Prove)"]


def test_another_owners_ca_does_not_accept_it(document: bytes) -> None:
    found = codec.faults(codec.read(document), SoftwareKey(3).point)
    assert "its station is not certified by this CA" in found
    assert "the station that signed the datasheet is not certified by this CA (field 104)" in found


def test_a_board_that_is_gone_leaves_the_stations_word_on_a_failed_attempt(station: Station, board: Board) -> None:
    teds = run(station, board).image.blocks[SECURITY]
    failed = facts_of(station, teds, steps=(("identify", "done", 9), ("write", "node-silent", 40)))
    with talk(board, MemoryLink(board, lose_request=1)) as node:
        document = sign_evidence(node, station.credentials(board.uuid), EvidenceClaim(board.uuid, teds, failed))
    evidence = codec.read(document)
    assert (evidence.verdict, evidence.facts.failure, evidence.proof) == ("failed", "node-silent", b"")
    assert faults(station, document) == []


def test_a_board_that_passed_must_sign(station: Station, board: Board) -> None:
    teds = run(station, board).image.blocks[SECURITY]
    claim = EvidenceClaim(board.uuid, teds, facts_of(station, teds))
    with pytest.raises(NodeSilentError), talk(board, MemoryLink(board, lose_request=1)) as node:
        sign_evidence(node, station.credentials(board.uuid), claim)
    other = Board()  # the same UUID, another key
    with pytest.raises(NotAuthenticError), talk(other) as node:
        sign_evidence(node, station.credentials(board.uuid), claim)


@pytest.mark.parametrize(
    "text", ["QR==", "QUJ=", "QUJD=", "QUJD====", "QUI=\n", " QUI=", "QUI", "QUI=QUI=", "=", "\n", 5]
)
def test_base64_has_one_spelling(text: object) -> None:
    """Spare bits, needless padding, white space: other texts for the same octets would be other documents."""
    assert [codec.base64_of(plain, "sig") for plain in ("", "QQ==", "QUI=", "QUJD")] == [b"", b"A", b"AB", b"ABC"]
    with pytest.raises(BadDataError):
        codec.base64_of(text, "sig")


DIGEST = "0" * 64


@pytest.mark.parametrize(
    ("member", "row"),
    [
        *(("blocks", row) for row in ([65536, 1, DIGEST], [0, 256, DIGEST], [0, 1, "A" * 64], [0, 1, 5])),
        *(("blocks", row) for row in ([0, 1], [0, 1, DIGEST, 1], ["0", 1, DIGEST], [0, None, DIGEST], DIGEST, {})),
        *(
            ("steps", row)
            for row in (["write", "done"], ["write", "done", "5"], [1, "done", 5], ["write", "do\nne", 5])
        ),
        *(("steps", row) for row in (["wri\u202ete", "done", 5], ["write", None, 5], "wd5", None)),
    ],
)
def test_a_row_of_the_facts_has_one_form(member: str, row: object) -> None:
    record = json.loads(KAT["evidence"]["file"])
    statement = json.loads(codec.base64_of(record["payload"], "payload"))
    statement["predicate"]["facts"][member][0] = row
    record["payload"] = base64.b64encode(json.dumps(statement).encode()).decode()
    with pytest.raises(BadDataError, match=member[:-1]):
        codec.read(json.dumps(record).encode())


def test_known_answers_of_another_implementation() -> None:
    """Its document is of a time before ``node.teds``: what is hashed and signed is the same."""
    evidence = KAT["evidence"]
    payload = codec.base64_of(json.loads(evidence["file"])["payload"], "payload")
    statement = json.loads(payload)
    predicate = statement["predicate"]
    bound = codec.canonical(predicate["facts"], statement["subject"])
    assert bound.decode() == evidence["canonical"]
    assert codec.challenge(bytes.fromhex(predicate["node"]["nonce"]), bound).hex() == evidence["challenge"]
    assert codec.pae(payload).hex() == evidence["pae"]


def test_evidence_verify_needs_nothing_but_files(tmp_path: Path, station: Station, board: Board) -> None:
    (tmp_path / "evidence").mkdir()
    good = tmp_path / "evidence" / "a.json"
    good.write_bytes(evidence_of(station, board))
    ca, none = tmp_path / "ca.pem", tmp_path / "nowhere"
    ca.write_text(to_pem(station.identity.ca))
    done = call(none, "--json", "evidence", "verify", good.parent, "--ca", ca, passphrase=None)
    reports = [json.loads(line) for line in done.out.splitlines()]
    assert (done.code, reports[0]["good"], reports[0]["uuid"]) == (0, True, board.uuid.hex())
    assert reports[1] == {"totals": {"files": 1, "passed": 1}}
    assert not none.exists()
    (good.parent / "b.json").write_bytes(good.read_bytes().replace(b"payloadType", b"payloadtype"))
    (good.parent / "c.json").write_bytes(signed_anew(good.read_bytes(), SoftwareKey(9), lambda s: None))
    done = call(none, "evidence", "verify", good.parent, "--ca", ca, passphrase=None)
    assert done.code == 4
    assert done.out.splitlines()[-1] == "3 files: 1 not authentic, 1 passed, 1 unreadable."


def test_a_process_that_is_killed_ends_evidence_verify_with_an_error(
    tmp_path: Path, station: Station, board: Board, monkeypatch: pytest.MonkeyPatch
) -> None:
    document, whole, here = evidence_of(station, board), line_command._json, os.getpid()
    (tmp_path / "evidence").mkdir()
    for number in range(200):
        (tmp_path / "evidence" / f"{number:03}.json").write_bytes(document)
    ca = tmp_path / "ca.pem"
    ca.write_text(to_pem(station.identity.ca))
    alone = call(tmp_path, "--json", "evidence", "verify", tmp_path / "evidence", "--ca", ca, passphrase=None)
    assert json.loads(alone.out.splitlines()[-1]) == {"totals": {"files": 200, "passed": 200}}
    assert [json.loads(line)["file"][-8:-5] for line in alone.out.splitlines()[:-1]] == [f"{n:03}" for n in range(200)]

    def killed(judged: JudgedEvidence) -> str:
        if judged.path.name == "100.json" and os.getpid() != here:
            os.kill(os.getpid(), signal.SIGKILL)
        return whole(judged)

    monkeypatch.setattr(line_command, "_json", killed)
    done = call(tmp_path, "--json", "evidence", "verify", tmp_path / "evidence", "--ca", ca, passphrase=None)
    error = json.loads(done.out.splitlines()[-1])["error"]
    assert (done.code, error["code"]) == (1, "failed")
    assert "ended by signal 9" in error["message"]


def test_the_exit_code_of_files_that_processes_share_is_that_of_the_worst() -> None:
    """A file that cannot be read (4) before what does not hold (1), and no evidence with a higher code before those."""
    order = (0, 7, 3, 8, 1, 4)
    for one, other in itertools.product(order, repeat=2):
        totals = EvidenceTotals(1, {"good": 1}, one)
        totals.join(EvidenceTotals(2, {"good": 1, "bad": 1}, other))
        assert totals == EvidenceTotals(3, {"good": 2, "bad": 1}, max(one, other, key=order.index))


def test_pins_say_which_board_it_must_have_been(tmp_path: Path, station: Station, board: Board) -> None:
    file, ca, pins = tmp_path / "a.json", tmp_path / "ca.pem", tmp_path / "pins.csv"
    file.write_bytes(evidence_of(station, board))
    ca.write_text(to_pem(station.identity.ca))
    pins.write_text(f"uuid,fingerprint\n{board.uuid.hex()},{fingerprint(board.key.point)}\n")
    assert call(tmp_path, "evidence", "verify", file, "--ca", ca, "--pins", pins).code == 0
    pins.write_text(f"uuid,fingerprint\n{board.uuid.hex()},{'0' * 64}\n")
    done = call(tmp_path, "evidence", "verify", file, "--ca", ca, "--pins", pins)
    assert (done.code, "its key differs from the one in the pins file" in done.out) == (4, True)


def test_a_stations_own_ca_makes_no_evidence_for_another(tmp_path: Path, station: Station, board: Board) -> None:
    """A station that was never certified by this CA can sign what it likes."""
    stranger = make_station(tmp_path / "stranger", "stranger")
    document = evidence_of(stranger, board)
    assert faults(stranger, document) == []
    assert "its station is not certified by this CA" in faults(station, document)
    assert station_key_message(stranger.point) != station_key_message(station.point)
    stranger.close()


WRAPPED = Origin("dbc", "Torque", "5a" * 32)


def test_evidence_names_the_certificates_and_the_origin_of_the_datasheet(station: Station, board: Board) -> None:
    """A wrapped node's evidence states what it wraps; a text that no signed TEDS holds is a fault."""
    document = evidence_of(station, board, certificates=((1, "0" * 64),), origin=None)
    facts = codec.read(document).facts
    assert (facts.certificates, facts.origin, faults(station, document)) == (((1, "0" * 64),), None, [])
    assert json.loads(base64.b64decode(json.loads(document)["payload"]))["predicate"]["facts"]["origin"] is None
    invented = evidence_of(station, board, certificates=(), origin=WRAPPED.lines)
    assert codec.read(invented).facts.origin == WRAPPED.lines
    assert "the origin of the facts is not that of the Origin TEDS (130)" in faults(station, invented)


def test_evidence_names_nothing_that_its_signature_does_not_list() -> None:
    """A board's image may hold what was changed beside its signature."""
    certificate = (1, AccessCode.CERTIFICATE)
    blocks = {ORIGIN: WRAPPED.encode(), certificate: CertificateReference("7", "lab", "2026-11-01", "0" * 64).encode()}
    listed = {place: hashlib.sha256(block).digest() for place, block in blocks.items()}
    for changed in (set(), {ORIGIN}, {certificate}, set(blocks)):
        shown: Any = SimpleNamespace(signed_blocks=listed | dict.fromkeys(changed, b"\x01" * 32))
        certificates, origin = _named_in(Image(bytes(10), blocks), shown)
        assert certificates == (() if certificate in changed else ((1, "0" * 64),))
        assert origin == (None if ORIGIN in changed else WRAPPED.lines)


@pytest.mark.parametrize("report", [GOOD, FirmwareReport("bare", (0, 9, 0)), None], ids=["image", "no-image", "none"])
def test_evidence_states_the_firmware_of_its_session(station: Station, report: FirmwareReport | None) -> None:
    board = FirmwareBoard(report=report)
    run(station, board)
    with talk(board) as node:
        identify(station, node)
        read_firmware(node)
        assert _firmware_in_session(node) is None, "what is said in no session is no fact"
        require_session(station, node)
        read_firmware(node)
        firmware = _firmware_in_session(node)
        node.leave()
        require_session(station, node)
        assert _firmware_in_session(node) is None, "it was said in the session before"
    due = None if report is None else (report.text, f"{report.version_text}+{report.build}", "02" * 32, 0)
    if report is not None and report.image is None:
        due = ("bare", "0.9.0+0", "0" * 64, 0)
    assert firmware == due
    document = evidence_of(station, board, certificates=(), firmware=firmware)
    facts = codec.read(document).facts
    assert (facts.firmware, faults(station, document)) == (due, [])
    assert facts.to_json()["firmware"] == (None if due is None else list(due))


def test_evidence_of_older_versions_has_neither_certificates_nor_origin(station: Station, board: Board) -> None:
    document = evidence_of(station, board)
    facts = codec.read(document).facts
    assert (facts.certificates, facts.origin, faults(station, document)) == (None, None, [])
    assert not {"certificates", "origin", "firmware"} & set(facts.to_json())


@pytest.mark.parametrize(
    "change",
    [
        {"certificates": [[1, "x"]]},
        {"certificates": [[256, "0" * 64]]},
        {"certificates": [[1]]},
        {"certificates": "none"},
        {"certificates": [], "origin": "kind=usb\nname=x\n"},
        {"certificates": [], "origin": 1},
        {"firmware": []},
        {"firmware": ["x", "1.0.0+0", "0" * 64]},
        {"firmware": ["x", "1.0.0", "0" * 64, 0]},
        {"firmware": ["x", "1.0.0+0", "00", 0]},
        {"firmware": ["x", "1.0.0+0", "0" * 64, 256]},
        {"firmware": {"text": "x"}},
    ],
)
def test_certificates_and_origin_of_another_form_are_no_evidence(
    station: Station, board: Board, document: bytes, change: dict[str, Any]
) -> None:
    key = station.credentials(board.uuid).key
    changed = signed_anew(document, key, lambda statement: statement["predicate"]["facts"].update(change))
    with pytest.raises(BadDataError):
        codec.read(changed)
