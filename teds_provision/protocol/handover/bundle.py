"""The handover bundle: node keys from one base station to others. Pure: no store, no files.

The format is that of profile.md, "Handover between base stations".

:func:`seal_bundle` makes one, :func:`open_bundle` checks all that can be checked without a store, :func:`peek_bundle`
reads what stands in the clear. What remains for whoever holds the store: a known UUID with another node key, an epoch
that would go back, an id that was seen before, a node on the deny list, a receiver that is not yet certified.

Times are RFC 3339 text in UTC, UUIDs and fingerprints hex in either case (written in lower case). The payload may hold
more members than the profile lists; they are passed over. One of ours is ``revoked``, see :mod:`.revocation`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any, Literal, cast

from teds_provision.errors import BadData, NotAuthentic, PolicyRefused
from teds_provision.protocol.agreement import key_id
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.jwk import link_key_jwk, link_key_of, point_of, public_jwk
from teds_provision.protocol.handover.payload import LAST_U32, Members, fingerprints, is_label, time_text
from teds_provision.protocol.handover.revocation import Revocation, open_revocations
from teds_provision.protocol.handover.strict_json import decode_base64url, dump, encode_base64url, load_object
from teds_provision.protocol.keys import PrivateKey, fingerprint, is_point, station_key_message, verify

FORMAT = "teds-handover/1"
TYPE = "teds-handover+jws"
CONTENT_TYPE = "JWS"
MAX_BUNDLE_OCTETS = 64 * 1024 * 1024
"""More is not read: about 80,000 nodes. Look at the size of a file before reading it."""
CLOCK_TOLERANCE = timedelta(minutes=10)
"""How far a sender's clock may be ahead."""

Mode = Literal["copy", "move"]
FindKey = Callable[[str], bytes | None]


@dataclass(frozen=True, slots=True)
class BundledNode:
    """One node: its UUID (10 octets), public key (65), link key (16), and what the sender knows of it.

    ``sequence`` is the last one signed; ``teds_sha256`` the digest (hex) of the Security TEDS last committed.
    """

    uuid: bytes
    node_key: bytes
    key: bytes = field(repr=False)
    epoch: int
    sequence: int = 0
    profile: str | None = None
    name: str | None = None
    groups: tuple[str, ...] = ()
    teds_sha256: str | None = None


@dataclass(frozen=True)
class Bundle:
    """The payload. ``sender`` and ``to`` are fingerprints, ``ca`` a point, times are aware.

    ``station_signatures`` holds SIG104 (64 octets) of that CA over a receiver's key, by the receiver's fingerprint;
    ``revoked`` signed statements as :func:`.revocation.seal_revocation` makes them.
    """

    id: str
    sender: str
    to: tuple[str, ...]
    created: datetime
    expires: datetime
    mode: Mode
    ca: bytes
    nodes: tuple[BundledNode, ...]
    station_signatures: Mapping[str, bytes] = field(default_factory=dict)
    revoked: tuple[str, ...] = ()


@dataclass(frozen=True)
class OpenedBundle:
    """A bundle that passed every check but those of the store.

    ``station_signature`` is the CA's over this station's key, None where the bundle brings none; ``revocations`` are
    those of trusted signers, ``unknown_revocations`` counts the others; ``sha256`` is over the octets of the file,
    ``signed_sha256`` over the JWS in it, which nobody on the way can change: receipts name that.
    """

    bundle: Bundle
    sender_key: bytes
    sha256: str
    station_signature: bytes | None
    revocations: tuple[Revocation, ...]
    unknown_revocations: int
    signed_sha256: str


@dataclass(frozen=True)
class BundleHeader:
    """What a bundle shows without a key. Nothing here is authenticated. ``recipients`` are fingerprints, or ""."""

    algorithm: str
    encryption: str
    content_type: str
    recipients: tuple[str, ...]
    octets: int
    sha256: str


def seal_bundle(payload: Bundle, sender: PrivateKey, recipients: Sequence[bytes]) -> bytes:
    """Like :func:`seal_signed`, but returns the octets of the file alone."""
    return seal_signed(payload, sender, recipients)[0]


def seal_signed(payload: Bundle, sender: PrivateKey, recipients: Sequence[bytes]) -> tuple[bytes, str]:
    """Sign with ``sender`` and seal to the points ``recipients``.

    Returns the octets of the file, and the SHA-256 of what was signed, which the receipt will name.

    Raises BadData or PolicyRefused where the payload breaks a rule that :func:`open_bundle` would hold against it.
    """
    if any(not is_point(point) for point in recipients):
        raise BadData("A recipient's key is not a P-256 point.")
    if payload.sender != fingerprint(sender.point):
        raise BadData("The bundle names another sender than the key that signs it.")
    if sorted(payload.to) != sorted(map(fingerprint, recipients)):
        raise BadData("The bundle names other recipients than the keys that it is sealed to.")
    _check_rules(payload)
    for node in payload.nodes:
        _check_writable(node)
    for point in recipients:
        _station_signature(payload, point)
    signed = jose.sign_compact(_payload(payload), sender, typ=TYPE)
    sealed = jose.encrypt(signed, recipients, cty=CONTENT_TYPE)
    if len(sealed) > MAX_BUNDLE_OCTETS:
        raise BadData(f"{len(payload.nodes)} nodes are too many for one bundle.", hint="Export them in groups.")
    return sealed, hashlib.sha256(signed).hexdigest()


def open_bundle(
    octets: bytes,
    recipient: PrivateKey,
    trusted: FindKey,
    now: datetime | None,
    *,
    max_octets: int = MAX_BUNDLE_OCTETS,
) -> OpenedBundle:
    """Open a bundle for ``recipient``; ``trusted`` gives the point of a trusted station by its fingerprint.

    Without ``now`` its times are left to :func:`check_times`: one that was taken in before gives its receipt again.

    Raises PolicyRefused (not for this station, expired, dated in the future, algorithm), NotAuthentic (unknown sender,
    signature, tag, SIG104, kid of a key) or BadData (form, ranges, count, an UUID twice).
    """
    bundle, sender_key, signed_sha256 = _opened(octets, recipient, trusted, max_octets)
    if fingerprint(recipient.point) not in bundle.to:
        raise PolicyRefused("The bundle does not name this station as a receiver, though it is sealed to it.")
    if now is not None:
        check_times(bundle, now)
    revocations, unknown = open_revocations(bundle.revoked, trusted)
    return OpenedBundle(
        bundle,
        sender_key,
        hashlib.sha256(octets).hexdigest(),
        _station_signature(bundle, recipient.point),
        revocations,
        unknown,
        signed_sha256,
    )


def check_times(bundle: Bundle, now: datetime) -> None:
    """Raise PolicyRefused for a bundle that has expired, or that was made in the future."""
    if bundle.created > now + CLOCK_TOLERANCE:
        raise PolicyRefused(
            f"The bundle was made in the future ({time_text(bundle.created)}).", hint="Compare both stations' clocks."
        )
    if now >= bundle.expires:
        raise PolicyRefused(
            f"The bundle expired at {time_text(bundle.expires)}.", hint="Ask the sender to export it again."
        )


def peek_bundle(octets: bytes, *, max_octets: int = MAX_BUNDLE_OCTETS) -> BundleHeader:
    """Read the header and the recipients of a bundle without any key; raises BadData."""
    header = jose.read_header(octets, max_octets=max_octets)
    return BundleHeader(
        header.algorithm,
        header.encryption,
        header.content_type,
        header.recipients,
        len(octets),
        hashlib.sha256(octets).hexdigest(),
    )


def _opened(octets: bytes, recipient: PrivateKey, trusted: FindKey, max_octets: int) -> tuple[Bundle, bytes, str]:
    """Unseal, verify and read; each form of the payload is let go as soon as the next one is there."""
    signed = jose.decrypt(octets, recipient, cty=CONTENT_TYPE, max_octets=max_octets)
    verified = jose.verify_compact(signed, trusted, typ=TYPE, max_octets=max_octets)
    signed_sha256 = hashlib.sha256(signed).hexdigest()
    del signed
    kid, signer, payload = verified.kid, verified.signer, verified.payload
    del verified
    members = load_object(payload, "The bundle")
    del payload
    bundle = _from_json(members)
    if bundle.sender != kid:
        raise NotAuthentic("The bundle names another sender than the one who signed it.")
    return bundle, signer, signed_sha256


def _check_rules(bundle: Bundle) -> None:
    """The rules between members, the same for sender and receiver."""
    if bundle.mode == "move" and len(bundle.to) != 1:
        raise PolicyRefused(f"A move has exactly one receiver, this one {len(bundle.to)}.")
    if not bundle.to:
        raise BadData("The bundle names no receiver.")
    if bundle.expires <= bundle.created:
        raise BadData("The bundle expires before it was made.")
    if len({node.uuid for node in bundle.nodes}) != len(bundle.nodes):
        raise BadData("The bundle names an UUID twice.")


def _check_writable(node: BundledNode) -> None:
    """Refuse to write what no reader would take."""
    texts = (node.profile, node.name, *node.groups)
    if not (
        (len(node.uuid), len(node.node_key), len(node.key)) == (10, 65, 16)
        and 0 < node.epoch <= LAST_U32
        and 0 <= node.sequence <= LAST_U32
        and all(text is None or is_label(text) for text in texts)
    ):
        raise BadData(f"The node {node.uuid.hex()} cannot be put into a bundle: a member is out of its range.")


def _station_signature(bundle: Bundle, station: bytes) -> bytes | None:
    """SIG104 over ``station``, verified; None where there is none."""
    signature = bundle.station_signatures.get(fingerprint(station))
    if signature is not None and not verify(bundle.ca, station_key_message(station), signature):
        raise NotAuthentic("The CA's signature over the receiver's key does not verify under the bundle's CA.")
    return signature


def _payload(bundle: Bundle) -> bytes:
    """The JSON that is signed, node by node: ten thousand of them as objects would take many times its size."""
    members: dict[str, object] = {
        "format": FORMAT,
        "id": bundle.id,
        "from": bundle.sender,
        "to": list(bundle.to),
        "created": time_text(bundle.created),
        "expires": time_text(bundle.expires),
        "mode": bundle.mode,
        "ca": public_jwk(bundle.ca),
        "station_signatures": {
            receiver: encode_base64url(signature) for receiver, signature in bundle.station_signatures.items()
        },
        "count": len(bundle.nodes),
    }
    octets = bytearray(dump(members)[:-1] + b',"nodes":[')
    for number, node in enumerate(bundle.nodes):
        octets += b"," * (number > 0) + dump(_node_to_json(node))
    octets += b"]" + (b',"revoked":' + dump(list(bundle.revoked)) if bundle.revoked else b"") + b"}"
    return bytes(octets)


def _node_to_json(node: BundledNode) -> dict[str, object]:
    return {
        "uuid": node.uuid.hex(),
        "node_public_key": public_jwk(node.node_key),
        "key": link_key_jwk(node.key, key_id(node.key)),
        "epoch": node.epoch,
        "sequence": node.sequence,
        "profile": node.profile,
        "name": node.name,
        "groups": list(node.groups),
        "teds_sha256": node.teds_sha256,
    }


def _from_json(payload: dict[str, Any]) -> Bundle:
    members = Members(payload, "The bundle")
    if members.get("format") != FORMAT:
        raise BadData(f"The bundle's format is not {FORMAT}.", hint="A newer teds-provision may read it.")
    mode = members.get("mode")
    if mode not in ("copy", "move"):
        raise BadData("The bundle's mode is neither copy nor move.")
    nodes = members.list_of("nodes")
    if members.u32("count") != len(nodes):
        raise BadData(f"The bundle says that it holds {members.get('count')} nodes, and holds {len(nodes)}.")
    bundle = Bundle(
        id=members.random_id("id"),
        sender=members.sha256("from"),
        to=fingerprints(members.list_of("to"), "The bundle's list of receivers"),
        created=members.time("created"),
        expires=members.time("expires"),
        mode=cast(Mode, mode),
        ca=point_of(members.get("ca"), "The bundle's CA key"),
        nodes=tuple(_node_from_json(node, number) for number, node in enumerate(nodes, 1)),
        station_signatures=_signatures(members.get("station_signatures")),
        revoked=tuple(_statement(text) for text in members.list_of("revoked", required=False)),
    )
    _check_rules(bundle)
    return bundle


def _node_from_json(node: object, number: int) -> BundledNode:
    """Read one node; a complaint names it by its place, counted from 1."""
    try:
        return _read_node(Members(node, "It"))
    except (BadData, NotAuthentic) as error:
        raise type(error)(f"Node {number} of the bundle cannot be taken. {error.message}") from error


def _read_node(members: Members) -> BundledNode:
    key, kid = link_key_of(members.get("key"), "Its link key")
    if kid != key_id(key).hex():
        raise NotAuthentic("The kid is not that of its link key.")
    return BundledNode(
        uuid=members.uuid("uuid"),
        node_key=point_of(members.get("node_public_key"), "Its public key"),
        key=key,
        epoch=members.u32("epoch", first=1),
        sequence=members.u32("sequence"),
        profile=members.text_or_none("profile"),
        name=members.text_or_none("name"),
        groups=members.texts("groups"),
        teds_sha256=members.sha256_or_none("teds_sha256"),
    )


def _signatures(value: object) -> dict[str, bytes]:
    if not isinstance(value, dict):
        raise BadData("The bundle's station_signatures are not an object.")
    receivers = fingerprints(list(value), "The list of station_signatures")
    return {
        receiver: decode_base64url(signature, "A station signature")
        for receiver, signature in zip(receivers, value.values(), strict=True)
    }


def _statement(text: object) -> str:
    if not isinstance(text, str):
        raise BadData("A revocation in the bundle is not a compact JWS.")
    return text
