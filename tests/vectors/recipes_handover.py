"""Handover bundles and receipts, sealed here by hand with fixed one-time values (profile section 6).

The JWE is put together from RFC 7516 and RFC 7518 with plain primitives, not with the code that it is to test.
"""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Iterator, Sequence
from typing import Any

from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from cryptography.hazmat.primitives.kdf.concatkdf import ConcatKDFHash
from cryptography.hazmat.primitives.keywrap import aes_key_wrap

from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.wire_agreement import key_id

from .scene import KAT, SIGNED, UUID, K, key, octets

NOW = "2026-01-05T12:00:00Z"
SECOND_UUID = "93cc201af4c1f7442acc"


def b64(raw: bytes) -> str:
    """Base64url without padding."""
    return base64.urlsafe_b64encode(raw).rstrip(b"=").decode()


def dump(members: object) -> bytes:
    """Compact JSON."""
    return json.dumps(members, separators=(",", ":"), ensure_ascii=False).encode()


def jwk(point: bytes) -> dict[str, str]:
    """Return a public key."""
    return {"kty": "EC", "crv": "P-256", "x": b64(point[1:33]), "y": b64(point[33:])}


def jws(payload: bytes, signer: SoftwareKey, typ: str, **header: Any) -> bytes:
    """Return a compact JWS."""
    head = {"alg": "ES256", "kid": fingerprint(signer.point), "typ": typ} | header
    signed = f"{b64(dump(head))}.{b64(payload)}".encode()
    return signed + b"." + b64(signer.sign(signed)).encode()


def jwe(content: bytes, recipients: Sequence[SoftwareKey], label: str) -> bytes:
    """Return a JWE in the General JSON serialization with one-time values that follow from ``label``."""
    protected = b64(dump({"alg": "ECDH-ES+A256KW", "cty": "JWS", "enc": "A256GCM"}))
    content_key, iv = octets(label, "cek a") + octets(label, "cek b"), octets(label, "iv")[:12]
    info = b"".join(len(part).to_bytes(4, "big") + part for part in (b"ECDH-ES+A256KW", b"", b""))
    info += (256).to_bytes(4, "big")
    entries = []
    for recipient in recipients:
        one_time = SoftwareKey(int.from_bytes(octets(label, fingerprint(recipient.point)), "big"))
        wrapping = ConcatKDFHash(hashes.SHA256(), 32, info).derive(one_time.ecdh(recipient.point))
        header = {"kid": fingerprint(recipient.point), "epk": jwk(one_time.point)}
        entries.append({"header": header, "encrypted_key": b64(aes_key_wrap(wrapping, content_key))})
    sealed = AESGCM(content_key).encrypt(iv, content, protected.encode())
    return dump(
        {
            "protected": protected,
            "recipients": entries,
            "iv": b64(iv),
            "tag": b64(sealed[-16:]),
            "ciphertext": b64(sealed[:-16]),
        }
    )


def payload(to: Sequence[str] = ("second_station",), **changes: Any) -> dict[str, Any]:
    """Return the members of a bundle from ``station`` about the node of kat.json."""
    receivers = [fingerprint(key(name).point) for name in to]
    made = {
        "format": "teds-handover/1",
        "id": "3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f1",
        "from": fingerprint(key("station").point),
        "to": receivers,
        "created": "2026-01-05T11:00:00Z",
        "expires": "2026-01-12T11:00:00Z",
        "mode": "copy",
        "ca": jwk(key("ca").point),
        "station_signatures": {
            fingerprint(key(name).point): b64(key("ca").sign(station_key_message(key(name).point))) for name in to
        },
        "count": 1,
        "nodes": [
            {
                "uuid": KAT["uuid"],
                "node_public_key": jwk(key("node").point),
                "key": {"kty": "oct", "k": b64(K), "kid": key_id(K).hex()},
                "epoch": 1,
                "sequence": 1,
                "profile": "tactile-finger-sensor",
                "name": "boom strain 7",
                "groups": ["boom"],
                "teds_sha256": hashlib.sha256(SIGNED).hexdigest(),
            }
        ],
    }
    return made | changes


def handover() -> Iterator[dict[str, Any]]:
    """Bundles between base stations, to be opened by ``recipient`` at the time ``now``; not for nodes.

    ``outcome`` is "opened" or the exit code of the command line: 4 not authentic, 6 refused by policy, 8 bad data.
    ``payload`` is what must be found inside.
    """
    good = payload()
    yield _entry("copy", "One node, one receiver, its key certified by the sender's CA.", good)
    yield _entry(
        "move", "A move has exactly one receiver.", payload(mode="move", id="7b0c0f0e-8d53-4c9e-9f57-0d0a5f6d1c11")
    )
    both = ("second_station", "foreign_station")
    yield _entry(
        "two-receivers",
        "A copy to two stations; this is the entry of the second.",
        payload(both),
        to=both,
        recipient="foreign_station",
    )
    node = good["nodes"][0]
    spare = {**node, "uuid": SECOND_UUID, "name": "boom strain 8", "epoch": 3, "sequence": 7}
    yield _entry(
        "two-nodes",
        "Two nodes; members that the profile does not name are passed over.",
        payload(count=2, nodes=[{**node, "spare": 1}, spare], note="for the left hand"),
    )
    yield _entry("not-for-us", "Sealed to another station.", good, recipient="foreign_station", outcome=6)
    yield _entry(
        "not-named", "Sealed to us, but the payload does not name us.", payload(("foreign_station",)), outcome=6
    )
    yield _entry("unknown-sender", "The sender is not in the trust store.", good, trusted=(), outcome=4)
    yield _entry(
        "another-signer",
        "Signed by a trusted station that is not the one in `from`.",
        good,
        signer="foreign_station",
        trusted=("station", "foreign_station"),
        outcome=4,
    )
    yield _entry("expired", "Opened after it expired.", good, now="2026-01-12T11:00:00Z", outcome=6)
    yield _entry("count", "The count is wrong.", payload(count=2), outcome=8)
    yield _entry("uuid-twice", "A UUID stands twice.", payload(count=2, nodes=[node, node]), outcome=8)
    yield _entry("move-to-two", "A move to two receivers.", payload(both, mode="move"), to=both, outcome=6)
    yield _entry(
        "wrong-kid",
        "The kid of a link key is not its keyId.",
        payload(nodes=[{**node, "key": {**node["key"], "kid": "00" * 8}}]),
        outcome=4,
    )
    wrong = {name: b64(key("foreign_ca").sign(station_key_message(key("second_station").point))) for name in good["to"]}
    yield _entry(
        "wrong-certificate",
        "The station signature is not that of the CA in the bundle.",
        payload(station_signatures=wrong),
        outcome=4,
    )
    made = _entry("tag", "One bit of the JWE's tag is flipped.", good, outcome=4)
    document = json.loads(made["bundle"])
    document["tag"] = ("A" if document["tag"][0] != "A" else "B") + document["tag"][1:]
    yield made | {"bundle": dump(document).decode()}
    yield _entry("alg-none", "The JWS header says alg none.", good, header={"alg": "none"}, outcome=6)
    yield _entry(
        "crit", "The JWS header holds a critical extension.", good, header={"crit": ["exp"], "exp": 0}, outcome=6
    )


def _entry(
    name: str,
    note: str,
    members: dict[str, Any],
    *,
    to: Sequence[str] = ("second_station",),
    recipient: str = "second_station",
    trusted: Sequence[str] = ("station",),
    signer: str = "station",
    now: str = NOW,
    header: dict[str, Any] | None = None,
    outcome: str | int = "opened",
) -> dict[str, Any]:
    inner = jws(dump(members), key(signer), "teds-handover+jws", **(header or {}))
    bundle = jwe(inner, [key(receiver) for receiver in to], name)
    entry = {
        "name": name, "note": note, "recipient": recipient, "trusted": list(trusted), "now": now, "outcome": outcome,
        "payload": members, "jws": inner.decode(), "bundle": bundle.decode(),
    }  # fmt: skip
    if outcome == "opened":
        receipt = {
            "format": "teds-receipt/1",
            "id": members["id"],
            "bundle_sha256": hashlib.sha256(bundle).hexdigest(),
            "from": fingerprint(key(recipient).point),
            "to": members["from"],
            "imported": [node["uuid"] for node in members["nodes"]],
            "refused": [],
            "created": now,
        }
        entry |= {"receipt": receipt, "receipt_jws": jws(dump(receipt), key(recipient), "teds-receipt+jws").decode()}
    return entry


FILES = {"handover": handover}
assert len(UUID) == 10
