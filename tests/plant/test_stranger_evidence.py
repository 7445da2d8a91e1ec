"""Somebody with the contract and pyca alone judges evidence, also what its own station changed and signed anew."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature

from teds_provision.errors import TedsProvisionError
from teds_provision.plant.jobs import take_job
from teds_provision.plant.line import LineRun
from teds_provision.protocol.keys import PrivateKey
from teds_provision.protocol.plant import evidence as codec
from teds_provision.station.station import Station

from .owner import alone, job_of
from .proofs import signed_anew
from .test_jobs import build, make_board

BOUND = {"facts", "node", "station"}
"""What of the predicate no station changes alone; ``finished`` and ``operator`` it can, and ``verdict`` with steps."""


def signed_by(point: bytes, message: bytes, der: bytes) -> bool:
    try:
        key = ec.EllipticCurvePublicKey.from_encoded_point(ec.SECP256R1(), point)
        key.verify(der, message, ec.ECDSA(hashes.SHA256()))
    except (InvalidSignature, ValueError):
        return False
    return True


def der_of(raw: bytes) -> bytes:
    return encode_dss_signature(int.from_bytes(raw[:32], "big"), int.from_bytes(raw[32:], "big"))


def fields_of(teds: bytes) -> tuple[dict[int, bytes], list[list[object]], bytes]:
    """Tuples of a Security TEDS by their type, its signed blocks, and the data block without tuple 100."""
    assert int.from_bytes(teds[:4], "big") == len(teds) - 4
    data, at = teds[4:-2], 6
    found: dict[int, bytes] = {}
    blocks: list[list[object]] = []
    signed = data[:6]
    while at < len(data):
        type, end = data[at], at + 2 + data[at + 1]
        value = data[at + 2 : end]
        signed += b"" if type == 100 else data[at:end]
        if type == 108:
            blocks.append([int.from_bytes(value[:2], "big"), value[2], value[3:].hex()])
        found[type] = base64.b64decode(value) if 100 <= type <= 104 else value
        at = end
    return found, blocks, signed


def holds(document: bytes, ca: bytes) -> bool:
    """Return what section 10 has a reader check, and nothing of the program."""
    envelope = json.loads(document)
    payload = base64.b64decode(envelope["payload"], validate=True)
    kind = envelope["payloadType"].encode()
    (signature,) = envelope["signatures"]
    statement = json.loads(payload)
    predicate, (subject,) = statement["predicate"], statement["subject"]
    facts, node, station = predicate["facts"], predicate["node"], predicate["station"]
    own, uuid, teds = bytes.fromhex(station["point"]), bytes.fromhex(subject["name"][5:]), bytes.fromhex(node["teds"])
    point = bytes.fromhex(node["point"])
    shown, blocks, signed = fields_of(teds)
    bound = json.dumps(
        {"facts": facts, "subject": [subject]}, sort_keys=True, separators=(",", ":"), ensure_ascii=False
    )
    asked = hashlib.sha256(b"TEDS1 evidence\0" + bytes.fromhex(node["nonce"]) + bound.encode()).digest()
    certificate = base64.b64decode(station["certificate"])
    failed = [result for _, result, _ in facts["steps"] if result not in ("ok", "done", "nothing to do", "skipped")]
    return all(
        (
            signed_by(ca, b"TEDS1 station key\0" + own, der_of(certificate)),
            signed_by(
                own,
                b"DSSEv1 %d %s %d %s" % (len(kind), kind, len(payload), payload),
                base64.b64decode(signature["sig"]),
            ),
            facts["station"] == signature["keyid"] == hashlib.sha256(own).hexdigest(),
            subject["digest"] == {"sha256": hashlib.sha256(teds).hexdigest()},
            shown[101] == point,
            signed_by(point, b"TEDS1 node key\0" + uuid + point, der_of(shown[102])),
            signed_by(ca, b"TEDS1 station key\0" + shown[103], der_of(shown[104])),
            signed_by(shown[103], b"TEDS1 datasheet\0" + uuid + signed, der_of(shown[100])),
            (facts["sequence"], facts["epoch"]) == tuple(int.from_bytes(shown[n], "big") for n in (106, 107)),
            facts["blocks"] == blocks,
            signed_by(point, b"TEDS1 prove\0" + uuid + asked, der_of(bytes.fromhex(node["proof"]))),
            predicate["verdict"] == ("failed" if failed else "passed"),
        )
    )


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[Station]:
    station = alone(tmp_path / "home")
    yield station
    station.close()


@pytest.fixture
def document(owner: Station) -> bytes:
    """Evidence of a board that a job made, by an operator with a name."""
    line = LineRun(owner, take_job(owner, job_of(owner)), operator="A. Meier")
    build(line, make_board(1))
    (row,) = owner.plant.line.evidence()
    return row.document


def leaves(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield where in a document a text, a number or nothing stands."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    if not isinstance(value, dict | list):
        yield path
    for name, option in inner:
        yield from leaves(option, (*path, name))


def change_at(statement: dict[str, Any], path: tuple[Any, ...]) -> None:
    """Put something else of the same kind there."""
    place: Any = statement
    for name in path[:-1]:
        place = place[name]
    was = place[path[-1]]
    other = was + 1 if isinstance(was, int) else 1 if was is None else ("1" if was[:1] != "1" else "2")
    place[path[-1]] = other if not isinstance(was, str) else other + was[1:]


def test_who_has_the_contract_alone_comes_to_the_same_verdict(owner: Station, document: bytes) -> None:
    ca = owner.identity.ca
    assert holds(document, ca)
    assert codec.faults(codec.read(document), ca) == []
    assert not holds(document, owner.point)


def test_no_member_that_its_own_station_changes_and_signs_again_holds(owner: Station, document: bytes) -> None:
    """Each text, number and null of the statement in turn, at the stranger's and here."""
    key, ca = owner.credentials().key, owner.identity.ca
    statement = json.loads(base64.b64decode(json.loads(document)["payload"]))
    held = set()
    for path in leaves(statement):
        anew = signed_anew(document, key, lambda changed, path=path: change_at(changed, path))  # type: ignore[misc]
        if judged(anew, ca):
            held.add(path)
    assert held == {("predicate", "finished"), ("predicate", "operator")}


def judged(document: bytes, ca: bytes) -> bool:
    """Return True if the program finds nothing wrong; then the stranger must not, either."""
    try:
        good = not codec.faults(codec.read(document), ca)
    except TedsProvisionError:
        return False
    assert not good or holds(document, ca), "the program is content with what a stranger refuses"
    return good


def changed_octets(document: bytes, key: PrivateKey, ca: bytes, places: range) -> int:
    """Flip one bit of each of these octets of the payload, and have the station sign it; how many were tried."""
    envelope = json.loads(document)
    payload = base64.b64decode(envelope["payload"])
    before = known(payload)
    for at in places:
        new = payload[:at] + bytes([payload[at] ^ (1 << at % 7)]) + payload[at + 1 :]
        der = der_of(key.sign(codec.pae(new)))
        signature = envelope["signatures"][0] | {"sig": base64.b64encode(der).decode()}
        anew = json.dumps(envelope | {"payload": base64.b64encode(new).decode(), "signatures": [signature]}).encode()
        if judged(anew, ca):
            assert known(new) == before, f"octet {at}"
    return len(places)


def known(payload: bytes) -> dict[str, Any]:
    """Return a statement without what the facts do not bind."""
    statement: dict[str, Any] = json.loads(payload)
    statement["predicate"] = {name: item for name, item in statement["predicate"].items() if name in BOUND}
    return statement


def test_an_octet_changed_and_signed_again_by_its_own_station_is_noticed(owner: Station, document: bytes) -> None:
    size = len(base64.b64decode(json.loads(document)["payload"]))
    assert changed_octets(document, owner.credentials().key, owner.identity.ca, range(0, size, 29)) > 100


@pytest.mark.soak
def test_no_octet_changed_and_signed_again_by_its_own_station_holds(owner: Station, document: bytes) -> None:
    size = len(base64.b64decode(json.loads(document)["payload"]))
    assert changed_octets(document, owner.credentials().key, owner.identity.ca, range(size)) > 3000
