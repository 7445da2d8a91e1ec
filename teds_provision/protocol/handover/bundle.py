"""The handover bundle: node keys from one base station to others. Pure: no store, no files.

The format is that of profile.md, "Handover between base stations".

:func:`seal_bundle` makes one, :func:`open_bundle` checks all that can be checked without a store, :func:`peek_bundle`
reads the clear part. The owner of the store checks the rest: a known UUID with another node key, an epoch that would go
back, an id that was seen before, a node on the deny list, a receiver that is not yet certified.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Literal, cast

from teds_provision.errors import BadDataError, NotAuthenticError, PolicyError
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.envelope import (
    PIECE,
    EnvelopeWriter,
    Source,
    UnsealedPayload,
    as_file,
    read_envelope,
    unseal,
)
from teds_provision.protocol.handover.jose import FindKey, link_key_of, point_of, public_jwk
from teds_provision.protocol.handover.revocation import Revocation, open_revocations
from teds_provision.protocol.handover.strict_json import (
    LAST_U32,
    Members,
    decode_base64url,
    dump,
    encode_base64url,
    fingerprints,
    is_label,
    load_long,
    time_text,
)
from teds_provision.protocol.keys import PrivateKey, fingerprint, is_point, station_key_message, verify
from teds_provision.protocol.wire_agreement import key_id

# Times are RFC 3339 text in UTC; UUIDs and fingerprints are hex in either case (written in lower case). The payload may
# have more members than the profile lists; unknown ones are skipped. This program adds ``revoked``, see revocation.py.

FORMAT = "teds-handover/1"

_quoted = json.encoder.encode_basestring_ascii

Mode = Literal["copy", "move"]


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
    kid: str = field(init=False, compare=False)
    """KeyId of the link key in hex: asked for again and again."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "kid", key_id(self.key).hex())


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


def check_rules(bundle: Bundle) -> None:
    """Check the rules between members, the same for sender and receiver."""
    if bundle.mode == "move" and len(bundle.to) != 1:
        raise PolicyError(f"A move has exactly one receiver, this one {len(bundle.to)}.")
    if not bundle.to:
        raise BadDataError("The bundle names no receiver.")
    if bundle.expires <= bundle.created:
        raise BadDataError("The bundle expires before it was made.")
    if len({node.uuid for node in bundle.nodes}) != len(bundle.nodes):
        raise BadDataError("The bundle names an UUID twice.")


def payload_of(bundle: Bundle) -> bytes:
    """Return the whole JSON that is signed."""
    return b"".join(payload_pieces(bundle, bundle.nodes, len(bundle.nodes)))


def payload_pieces(bundle: Bundle, nodes: Iterable[BundledNode], count: int) -> Iterator[bytes]:
    """Yield the JSON that is signed, node by node: ten thousand of them as objects would take many times its size."""
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
        "count": count,
    }
    yield dump(members)[:-1] + b',"nodes":['
    seen: set[bytes] = set()
    piece, writer = bytearray(), _NodeWriter()
    for node in nodes:
        piece += b"," * bool(seen) + writer.checked_json(node).encode("ascii")
        seen.add(node.uuid)
        if len(piece) >= PIECE:
            yield bytes(piece)
            piece.clear()
    if len(seen) != count:
        raise BadDataError(f"The bundle was to hold {count} different nodes, and holds {len(seen)}.")
    yield bytes(piece) + b"]" + (b',"revoked":' + dump(list(bundle.revoked)) if bundle.revoked else b"") + b"}"


class _NodeWriter:
    """Writes the nodes of one bundle as JSON: labels that many have, a profile and groups, are checked and coded once.

    It is put together by hand: an encoder takes three times as long.
    """

    def __init__(self) -> None:
        self._labels: dict[tuple[str | None, tuple[str, ...]], tuple[str, str]] = {}
        self._good: set[tuple[str | None, tuple[str, ...]]] = set()

    def checked_json(self, node: BundledNode) -> str:
        """Return the compact JSON of one node; raises BadDataError for what no reader would take."""
        shared, name = (node.profile, node.groups), node.name
        if not (
            len(node.uuid) == 10
            and len(node.node_key) == 65
            and len(node.key) == 16
            and 0 < node.epoch <= LAST_U32
            and 0 <= node.sequence <= LAST_U32
            and (name is None or is_label(name))
            and (shared in self._good or all(map(is_label, filter(None, (node.profile, *node.groups)))))
        ):
            raise BadDataError(f"The node {node.uuid.hex()} cannot be put into a bundle: a member is out of its range.")
        self._good.add(shared)
        return self.to_json(node)

    def to_json(self, node: BundledNode) -> str:
        """Return the compact JSON of one node."""
        coded_labels = self._labels.get((node.profile, node.groups))
        if coded_labels is None:
            coded_labels = _text(node.profile), ",".join(map(_quoted, node.groups))
            self._labels[node.profile, node.groups] = coded_labels
        profile, groups = coded_labels
        # Encode x, y and K together, each padded with zeros to whole groups of three octets, so that their spare bits
        # are zero.
        key = node.node_key
        coded = encode_base64url(key[1:33] + b"\0" + key[33:] + b"\0" + node.key + b"\0\0")
        return (
            f'{{"uuid":"{node.uuid.hex()}",'
            f'"node_public_key":{{"kty":"EC","crv":"P-256","x":"{coded[:43]}","y":"{coded[44:87]}"}},'
            f'"key":{{"kty":"oct","k":"{coded[88:110]}","kid":"{node.kid}"}},'
            f'"epoch":{node.epoch},"sequence":{node.sequence},'
            f'"profile":{profile},"name":{_text(node.name)},'
            f'"groups":[{groups}],"teds_sha256":{_text(node.teds_sha256)}}}'
        )


def _text(text: str | None) -> str:
    return "null" if text is None else _quoted(text)


def from_json(octets: bytearray) -> Bundle:
    """Read what was signed; ``octets`` is emptied on the way. Raises BadDataError, NotAuthenticError, PolicyError."""
    read = _NodeReader()
    members = Members(load_long(octets, "The bundle", "nodes", read.read_node), "The bundle")
    if members.get("format") != FORMAT:
        raise BadDataError(f"The bundle's format is not {FORMAT}.", hint="A newer teds-provision may read it.")
    mode = members.get("mode")
    if mode not in ("copy", "move"):
        raise BadDataError("The bundle's mode is neither copy nor move.")
    nodes = members.list_of("nodes")
    if members.u32("count") != len(nodes):
        raise BadDataError(f"The bundle says that it holds {members.get('count')} nodes, and holds {len(nodes)}.")
    bundle = Bundle(
        id=members.random_id("id"),
        sender=members.sha256("from"),
        to=fingerprints(members.list_of("to"), "The bundle's list of receivers"),
        created=members.time("created"),
        expires=members.time("expires"),
        mode=cast(Mode, mode),
        ca=point_of(members.get("ca"), "The bundle's CA key"),
        nodes=tuple(read.all_of(nodes)),
        station_signatures=_signatures(members.get("station_signatures")),
        revoked=tuple(_statement(text) for text in members.list_of("revoked", required=False)),
    )
    check_rules(bundle)
    return bundle


class _NodeReader:
    """Reads the nodes one by one; a complaint names one by its place, counted from 1, and waits for its turn."""

    def __init__(self) -> None:
        self._number = 0
        self._complaint: BadDataError | NotAuthenticError | None = None

    def read_node(self, node: object) -> BundledNode | None:
        """Read the next node, None from the first on that cannot be read."""
        self._number += 1
        if self._complaint is None:
            try:
                return _read_node(Members(node, "It"))
            except (BadDataError, NotAuthenticError) as error:
                text = f"Node {self._number} of the bundle cannot be taken. {error.message}"
                self._complaint = type(error)(text)
                self._complaint.__cause__ = error
        return None

    def all_of(self, nodes: list[BundledNode]) -> list[BundledNode]:
        """Return what was read; raises the complaint."""
        if self._complaint is not None:
            raise self._complaint
        return nodes


def _read_node(members: Members) -> BundledNode:
    key, kid = link_key_of(members.get("key"), "Its link key")
    node = BundledNode(
        uuid=members.uuid("uuid"),
        node_key=point_of(members.get("node_public_key"), "Its public key"),
        key=key,
        epoch=members.u32("epoch", first=1),
        sequence=members.u32("sequence"),
        profile=_shared(members.text_or_none("profile")),
        name=members.text_or_none("name"),
        groups=members.texts("groups"),
        teds_sha256=members.sha256_or_none("teds_sha256"),
    )
    if kid != node.kid:
        raise NotAuthenticError("The kid is not that of its link key.")
    return node


def _shared(text: str | None) -> str | None:
    """Return the same text object for all nodes of a profile: there are few profiles and many nodes."""
    return None if text is None else sys.intern(text)


def _signatures(value: object) -> dict[str, bytes]:
    if not isinstance(value, dict):
        raise BadDataError("The bundle's station_signatures are not an object.")
    receivers = fingerprints(list(value), "The list of station_signatures")
    return {
        receiver: decode_base64url(signature, "A station signature")
        for receiver, signature in zip(receivers, value.values(), strict=True)
    }


def _statement(text: object) -> str:
    if not isinstance(text, str):
        raise BadDataError("A revocation in the bundle is not a compact JWS.")
    return text


TYPE = "teds-handover+jws"
CONTENT_TYPE = "JWS"
MAX_BUNDLE_OCTETS = 64 * 1024 * 1024
"""More is not read: about 80,000 nodes. Look at the size of a file before reading it."""
_MAX_PAYLOAD_OCTETS = (MAX_BUNDLE_OCTETS - 128 * 1024) // 16 * 9
"""The largest payload: base64url of base64url, after headers of at most 256 recipients."""
CLOCK_TOLERANCE = timedelta(minutes=10)
"""How far a sender's clock may be ahead."""


@dataclass(frozen=True)
class OpenedBundle:
    """A bundle that passed every check but those of the store.

    ``station_signature`` is the CA's over this station's key, None if the bundle has none; ``revocations`` are those of
    trusted signers, ``unknown_revocations`` counts the others; ``sha256`` is over the octets of the file,
    ``signed_sha256`` over the JWS in it, which cannot be changed on the way: receipts name that.
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
    """The part of a bundle that is readable without a key. Nothing in it is authenticated.

    ``recipients`` are fingerprints, or "".
    """

    algorithm: str
    encryption: str
    content_type: str
    recipients: tuple[str, ...]
    octets: int
    sha256: str


def seal_bundle(payload: Bundle, sender: PrivateKey, recipients: Sequence[bytes]) -> bytes:
    """Seal a bundle as :func:`seal_pieces` does, and return the octets of the whole file."""
    made = seal_pieces(payload, payload.nodes, len(payload.nodes), sender, recipients)
    return b"".join([*made.body(), made.end()])


def seal_pieces(
    payload: Bundle, nodes: Iterable[BundledNode], count: int, sender: PrivateKey, recipients: Sequence[bytes]
) -> EnvelopeWriter:
    """Sign with ``sender`` and seal to the points ``recipients``; ``count`` nodes come one by one, not in ``payload``.

    Its ``signed_sha256``, the digest of what was signed, is what the receipt will name.

    Raises BadDataError or PolicyError if the payload breaks a rule that :func:`open_bundle` checks.
    """
    if any(not is_point(point) for point in recipients):
        raise BadDataError("A recipient's key is not a P-256 point.")
    if payload.sender != fingerprint(sender.point):
        raise BadDataError("The bundle names another sender than the key that signs it.")
    if sorted(payload.to) != sorted(map(fingerprint, recipients)):
        raise BadDataError("The bundle names other recipients than the keys that it is sealed to.")
    check_rules(payload)
    for point in recipients:
        _station_signature(payload, point)
    pieces = payload_pieces(payload, nodes, count)
    return EnvelopeWriter(_within(pieces, count), sender, recipients, typ=TYPE, cty=CONTENT_TYPE)


def _within(pieces: Iterable[bytes], count: int) -> Iterator[bytes]:
    """Yield the pieces of a payload; raises BadDataError if the bundle becomes longer than a reader accepts."""
    octets = 0
    for piece in pieces:
        octets += len(piece)
        if octets > _MAX_PAYLOAD_OCTETS:
            raise BadDataError(f"{count} nodes are too many for one bundle.", hint="Export them in groups.")
        yield piece


def open_bundle(
    source: Source,
    recipient: PrivateKey,
    trusted: FindKey,
    now: datetime | None,
    *,
    max_octets: int = MAX_BUNDLE_OCTETS,
) -> OpenedBundle:
    """Open a bundle for ``recipient``; ``trusted`` gives the point of a trusted station by its fingerprint.

    Without ``now`` its times are left to :func:`check_times`: one that was taken in before gives its receipt again.

    Raises PolicyError (not for this station, expired, dated in the future, algorithm), NotAuthenticError (unknown
    sender, signature, tag, SIG104, kid of a key) or BadDataError (form, ranges, count, an UUID twice).
    """
    bundle, opened = _opened(source, recipient, trusted, max_octets)
    if fingerprint(recipient.point) not in bundle.to:
        raise PolicyError("The bundle does not name this station as a receiver, though it is sealed to it.")
    if now is not None:
        check_times(bundle, now)
    revocations, unknown = open_revocations(bundle.revoked, trusted)
    return OpenedBundle(
        bundle,
        opened.signer,
        opened.sha256,
        _station_signature(bundle, recipient.point),
        revocations,
        unknown,
        opened.signed_sha256,
    )


def check_times(bundle: Bundle, now: datetime) -> None:
    """Raise PolicyError for a bundle that has expired, or that was made in the future."""
    if bundle.created > now + CLOCK_TOLERANCE:
        raise PolicyError(
            f"The bundle was made in the future ({time_text(bundle.created)}).", hint="Compare both stations' clocks."
        )
    if now >= bundle.expires:
        raise PolicyError(
            f"The bundle expired at {time_text(bundle.expires)}.", hint="Ask the sender to export it again."
        )


def peek_bundle(source: Source) -> BundleHeader:
    """Read the header and the recipients of a bundle without any key; raises BadDataError."""
    envelope = read_envelope(as_file(source), MAX_BUNDLE_OCTETS)
    header = jose.header_of(envelope.document)
    return BundleHeader(
        header.algorithm,
        header.encryption,
        header.content_type,
        header.recipients,
        envelope.octets,
        envelope.sha256,
    )


def _opened(source: Source, recipient: PrivateKey, trusted: FindKey, max_octets: int) -> tuple[Bundle, UnsealedPayload]:
    """Unseal, verify and read; each form of the payload is let go as soon as the next one is there."""
    opened = unseal(source, recipient, trusted, typ=TYPE, cty=CONTENT_TYPE, max_octets=max_octets)
    bundle = from_json(opened.payload)
    if bundle.sender != opened.kid:
        raise NotAuthenticError("The bundle names another sender than the one who signed it.")
    return bundle, opened


def _station_signature(bundle: Bundle, station: bytes) -> bytes | None:
    """Return SIG104 over ``station``, verified; None if there is none."""
    signature = bundle.station_signatures.get(fingerprint(station))
    if signature is not None and not verify(bundle.ca, station_key_message(station), signature):
        raise NotAuthenticError("The CA's signature over the receiver's key does not verify under the bundle's CA.")
    return signature
