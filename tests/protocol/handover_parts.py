"""Stations, a CA and a bundle between them, for the tests of a handover."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import TYPE, Bundle, BundledNode, payload_of
from teds_provision.protocol.handover.strict_json import base64url, dump
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message

NOW = datetime(2026, 3, 1, 12, 0, tzinfo=UTC)
SENDER, RECEIVER, THIRD, OWNER, STRANGER = (SoftwareKey(number) for number in (11, 12, 13, 14, 15))
NODE_KEY = SoftwareKey(99).point
LIMIT = 1 << 20


def trusts(*stations: SoftwareKey) -> Callable[[str], bytes | None]:
    """Return a trust store that holds these stations."""
    points = {fingerprint(station.point): station.point for station in stations}
    return points.get


def node(number: int = 1, **changes: Any) -> BundledNode:
    uuid, key = number.to_bytes(10, "big"), number.to_bytes(16, "big")
    made = BundledNode(
        uuid, NODE_KEY, key, 3, 7, "tactile-finger-sensor", f"finger {number}", ("left hand",), "ab" * 32
    )
    return replace(made, **changes)


def bundle(count: int = 1, to: tuple[SoftwareKey, ...] = (RECEIVER,), **changes: Any) -> Bundle:
    receivers = tuple(fingerprint(station.point) for station in to)
    made = Bundle(
        id="3d1a4d1c-52c4-4d0b-9d3c-0c8f4bd5a7f1",
        sender=fingerprint(SENDER.point),
        to=receivers,
        created=NOW - timedelta(hours=1),
        expires=NOW + timedelta(days=7),
        mode="copy",
        ca=OWNER.point,
        nodes=tuple(node(number) for number in range(1, count + 1)),
        station_signatures={fingerprint(s.point): OWNER.sign(station_key_message(s.point)) for s in to},
    )
    return replace(made, **changes)


def members_of(made: Bundle) -> dict[str, Any]:
    """Return the payload as JSON members, to be bent."""
    return json.loads(payload_of(made))


def sealed(members: object, *, sender: SoftwareKey = SENDER, to: SoftwareKey = RECEIVER, typ: str = TYPE) -> bytes:
    """Seal any payload, with none of the sender's checks."""
    payload = members if isinstance(members, bytes) else dump(members)
    return jose.encrypt(jose.sign_compact(payload, sender, typ=typ), [to.point], cty="JWS")


def sealed_jws(header: object, payload: bytes = b"{}", *, signer: SoftwareKey = SENDER) -> bytes:
    """Seal a JWS with any header, signed well."""
    signed = base64url(dump(header)) + b"." + base64url(payload)
    jws = signed + b"." + base64url(signer.sign(signed))
    return jose.encrypt(jws, [RECEIVER.point], cty="JWS")
