"""Evidence for tests: a board that was provisioned in memory, and documents about it."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from cryptography.hazmat.primitives.asymmetric.utils import encode_dss_signature

from teds_provision.plant.evidence import TOOL, sign_evidence
from teds_provision.protocol.keys import PrivateKey, fingerprint
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.evidence import BoardFacts, EvidenceClaim
from teds_provision.station.station import Station
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY
from tests.bench import Board, talk
from tests.provisioning.test_provision import run

BEGUN = "2026-03-01T11:29:00Z"


def facts_of(station: Station, teds: bytes, **changes: Any) -> BoardFacts:
    shown = security.decode(teds)
    facts = BoardFacts(
        station=station.identity.fingerprint,
        job=None,
        unit=None,
        attempt=1,
        profile="magnetic-angular-position-sensor",
        profile_sha256="0" * 64,
        calibration_sha256=None,
        epoch=shown.key_epoch,
        sequence=shown.sequence,
        blocks=codec.blocks_of(shown),
        steps=(("identify", "done", 41), ("write", "done", 1250)),
        assurance="tap",
        tool=TOOL,
        begun=BEGUN,
    )
    return replace(facts, **changes)


def evidence_of(station: Station, board: Board, *, operator: str | None = None, **changes: Any) -> bytes:
    """Provision a board and have it sign."""
    teds = run(station, board).image.blocks[SECURITY]
    with talk(board) as node:
        claim = EvidenceClaim(board.uuid, teds, facts_of(station, teds, **changes))
        return sign_evidence(node, station.credentials(board.uuid), claim, operator=operator)


def signed_anew(document: bytes, key: PrivateKey, change: Callable[[dict[str, Any]], object]) -> bytes:
    """Return what a station can make of its own evidence: the statement changed, and signed once more."""
    statement = json.loads(base64.b64decode(json.loads(document)["payload"]))
    change(statement)
    payload = json.dumps(statement, separators=(",", ":"), ensure_ascii=False).encode()
    raw = key.sign(codec.pae(payload))
    der = encode_dss_signature(int.from_bytes(raw[:32], "big"), int.from_bytes(raw[32:], "big"))
    envelope = json.loads(document) | {
        "payload": base64.b64encode(payload).decode(),
        "signatures": [{"keyid": fingerprint(key.point), "sig": base64.b64encode(der).decode()}],
    }
    return json.dumps(envelope, separators=(",", ":")).encode()
