"""What the store keeps, as frozen values: one class per table (profile: security-teds.md sections 1, 2, 3 and 6).

UUIDs are 10 octets, fingerprints 64 hex digits, points 65 octets (SEC 1 uncompressed), times ISO 8601 in UTC.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Literal

UUID_OCTETS = 10

Assurance = Literal["tap", "bus", "uuid", "import"]
KeyState = Literal["pending", "active"]
KeySource = Literal["agreement", "import"]
DraftStage = Literal["built", "signed"]
TrustRole = Literal["station", "ca"]
Direction = Literal["out", "in"]
HandoverMode = Literal["copy", "move"]


def utc_now() -> str:
    """Return the present moment as ``2026-01-31T12:00:00Z``."""
    return datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


@dataclass(frozen=True)
class WhitelistEntry:
    """A node that may be provisioned: its UUID, and the key it is pinned to (None until the first proven contact)."""

    uuid: bytes
    fingerprint: str | None = None
    added: str = field(default_factory=utc_now)
    assurance: Assurance = "uuid"
    name: str | None = None


@dataclass(frozen=True)
class NodeRecord:
    """What is known of one node.

    ``state`` is that of Identify (0 factory, 1 keyed, 2 provisioned); ``can_address`` 1 to 239, 0 for none;
    ``teds_sha256`` is the digest (hex) of the Security TEDS last committed; ``channels`` counts TransducerChannels.
    """

    uuid: bytes
    point: bytes | None = None
    name: str | None = None
    profile: str | None = None
    state: int = 0
    epoch: int = 0
    sequence: int = 0
    can_address: int = 0
    groups: tuple[str, ...] = ()
    teds_sha256: str | None = None
    verdict: str | None = None
    last_seen: str | None = None
    channels: int = 0


@dataclass(frozen=True)
class KeyRecord:
    """One link key of one node, wrapped by the vault; ``key_id`` is 16 hex digits (security-teds.md section 4).

    ``slot`` tells apart keys of one node and epoch (see ``Store.next_slot``); ``seq`` is given by the store and grows.
    """

    uuid: bytes
    epoch: int
    key_id: str
    state: KeyState
    slot: int
    wrapped: bytes = field(repr=False)
    source: KeySource = "agreement"
    created: str = field(default_factory=utc_now)
    seq: int = 0


@dataclass(frozen=True)
class Draft:
    """The image (JSON) that a node is being given, and how far it came."""

    uuid: bytes
    image: str = field(repr=False)
    stage: DraftStage = "built"
    profile: str | None = None
    created: str = field(default_factory=utc_now)


@dataclass(frozen=True)
class TrustRecord:
    """The public key of another station or of a CA, trusted because someone added it."""

    name: str
    role: TrustRole
    point: bytes
    fingerprint: str
    added: str = field(default_factory=utc_now)


@dataclass(frozen=True)
class Handover:
    """A bundle that left (``out``) or came (``in``); ``peers`` are fingerprints, ``nodes`` and ``receipt`` text."""

    id: str
    direction: Direction
    mode: HandoverMode
    peers: tuple[str, ...]
    state: str
    nodes: str
    bundle_sha256: str | None = None
    receipt: str | None = None
    created: str = field(default_factory=utc_now)


@dataclass(frozen=True)
class Tombstone:
    """A node given away: its key is used no more, and this says where it went."""

    uuid: bytes
    to_fingerprint: str
    handover_id: str
    created: str = field(default_factory=utc_now)


@dataclass(frozen=True)
class Holder:
    """Another station that holds a key of this node, and by which kind of handover."""

    uuid: bytes
    fingerprint: str
    since: str = field(default_factory=utc_now)
    mode: HandoverMode = "copy"


@dataclass(frozen=True)
class Revocation:
    """A node (by UUID, and by key where known) that is trusted no more; ``statement`` is the signed text."""

    uuid: bytes
    fingerprint: str | None
    why: str
    statement: str
    created: str = field(default_factory=utc_now)
