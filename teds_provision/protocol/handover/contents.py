"""What a handover bundle says: its nodes, who it is from and for, and the JSON of it that is signed, both ways.

Times are RFC 3339 text in UTC, UUIDs and fingerprints hex in either case (written in lower case). The payload may hold
more members than the profile lists; they are passed over. One of ours is ``revoked``, see :mod:`.revocation`.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from typing import Literal, cast

from teds_provision.errors import BadData, NotAuthentic, PolicyRefused
from teds_provision.protocol.agreement import key_id
from teds_provision.protocol.handover.jwk import link_key_of, point_of, public_jwk
from teds_provision.protocol.handover.payload import LAST_U32, Members, fingerprints, is_label, time_text
from teds_provision.protocol.handover.sealing import PIECE
from teds_provision.protocol.handover.strict_json import decode_base64url, dump, encode_base64url, load_long

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
    if not (
        (len(node.uuid), len(node.node_key), len(node.key)) == (10, 65, 16)
        and 0 < node.epoch <= LAST_U32
        and 0 <= node.sequence <= LAST_U32
        and all(map(is_label, filter(None, (node.profile, node.name, *node.groups))))
    ):
        raise BadData(f"The node {node.uuid.hex()} cannot be put into a bundle: a member is out of its range.")


def payload_of(bundle: Bundle) -> bytes:
    """The whole JSON that is signed."""
    return b"".join(payload_pieces(bundle, bundle.nodes, len(bundle.nodes)))


def payload_pieces(bundle: Bundle, nodes: Iterable[BundledNode], count: int) -> Iterator[bytes]:
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
        "count": count,
    }
    yield dump(members)[:-1] + b',"nodes":['
    seen: set[bytes] = set()
    piece = bytearray()
    for node in nodes:
        _check_writable(node)
        piece += b"," * bool(seen) + _node_to_json(node).encode("ascii")
        seen.add(node.uuid)
        if len(piece) >= PIECE:
            yield bytes(piece)
            piece.clear()
    if len(seen) != count:
        raise BadData(f"The bundle was to hold {count} different nodes, and holds {len(seen)}.")
    yield bytes(piece) + b"]" + (b',"revoked":' + dump(list(bundle.revoked)) if bundle.revoked else b"") + b"}"


def _node_to_json(node: BundledNode) -> str:
    """Compact JSON of one node, put together by hand: an encoder takes three times as long, and there are thousands."""
    # x, y and K coded at once, each filled up with zeros to whole groups of three octets: zeros are its spare bits too
    coded = encode_base64url(node.node_key[1:33] + b"\0" + node.node_key[33:] + b"\0" + node.key + b"\0\0")
    x, y, key = coded[:43], coded[44:87], coded[88:110]
    return (
        f'{{"uuid":"{node.uuid.hex()}",'
        f'"node_public_key":{{"kty":"EC","crv":"P-256","x":"{x}","y":"{y}"}},'
        f'"key":{{"kty":"oct","k":"{key}","kid":"{node.kid}"}},'
        f'"epoch":{node.epoch},"sequence":{node.sequence},'
        f'"profile":{_text(node.profile)},"name":{_text(node.name)},'
        f'"groups":[{",".join(map(_quoted, node.groups))}],"teds_sha256":{_text(node.teds_sha256)}}}'
    )


def _text(text: str | None) -> str:
    return "null" if text is None else _quoted(text)


def from_json(octets: bytearray) -> Bundle:
    """Read what was signed; ``octets`` is emptied on the way. Raises BadData, NotAuthentic, PolicyRefused."""
    read = _NodeReader()
    members = Members(load_long(octets, "The bundle", "nodes", read.each), "The bundle")
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
        self._complaint: BadData | NotAuthentic | None = None

    def each(self, node: object) -> BundledNode | None:
        """Read the next node, None from the first on that cannot be read."""
        self._number += 1
        if self._complaint is None:
            try:
                return _read_node(Members(node, "It"))
            except (BadData, NotAuthentic) as error:
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
        raise NotAuthentic("The kid is not that of its link key.")
    return node


def _shared(text: str | None) -> str | None:
    """The same text object for all nodes of a profile: there are few profiles and many nodes."""
    return None if text is None else sys.intern(text)


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
