"""Rows of the store as frozen values: one class per table (store.md; profile.md).

UUIDs are 10 octets, fingerprints 64 hex digits, points 65 octets (SEC 1 uncompressed), times ISO 8601 in UTC.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import lru_cache
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from teds_provision.shapes.measurement import MeasurementSpec

if TYPE_CHECKING:
    from teds_provision.teds.image import Image

UUID_OCTETS = 10

Assurance = Literal["tap", "bus", "uuid", "import", "registry"]
KeyState = Literal["pending", "active"]
KeySource = Literal["agreement", "import"]
DraftStage = Literal["built", "signed"]
DetectionMode = Literal["transparent", "whitelist"]
TrustRole = Literal["station", "ca"]
Direction = Literal["out", "in"]
HandoverMode = Literal["copy", "move"]


def utc_now() -> str:
    """Return the present moment as ``2026-01-31T12:00:00Z``."""
    return _second(int(time.time()))


@lru_cache(maxsize=2)  # each step reads the time several times
def _second(second: int) -> str:
    return iso(datetime.fromtimestamp(second, UTC))


def iso(moment: datetime) -> str:
    """Return a moment (aware) as ``2026-01-31T12:00:00Z``."""
    at = moment.astimezone(UTC)  # formatted by hand, in a quarter of the time of strftime: each step needs the time
    return f"{at.year:04}-{at.month:02}-{at.day:02}T{at.hour:02}:{at.minute:02}:{at.second:02}Z"


@dataclass(frozen=True, slots=True)
class WhitelistEntry:
    """A node that may be provisioned: its UUID, and the key it is pinned to (None until the first proven contact)."""

    uuid: bytes
    fingerprint: str | None = None
    added: str = field(default_factory=utc_now)
    assurance: Assurance = "uuid"
    name: str | None = None
    mac: bytes | None = field(default=None, repr=False, compare=False)


class NewPin(NamedTuple):
    """The whitelist entry of a node that has none; as in :class:`WhitelistEntry`."""

    uuid: bytes
    fingerprint: str
    added: str
    assurance: Assurance
    name: str | None


@dataclass(frozen=True, slots=True)
class NodeRecord:
    """One node as the store knows it.

    ``state`` is that of Identify (0 factory, 1 keyed, 2 provisioned); ``can_address`` 1 to 239, 0 for none;
    ``teds_sha256`` is the digest (hex) of the Security TEDS last committed; ``channels`` counts TransducerChannels;
    ``retired``: an operator took it out of service; ``due`` is the day (ISO 8601) on which the first calibration of its
    datasheet ends; ``charging`` its last charge report, JSON with the time ``at``, unauthenticated. ``profile`` is a
    name or the whole path of a file, ``profile_digest`` (hex) that of its content when the node's datasheet was made.
    """

    uuid: bytes
    point: bytes | None = None
    name: str | None = None
    profile: str | None = None
    state: int = 0
    epoch: int = 0
    sequence: int = 0
    can_address: int = 0
    teds_sha256: str | None = None
    retired: str | None = None
    last_seen: str | None = None
    channels: int = 0
    point_mac: bytes | None = field(default=None, repr=False, compare=False)
    due: str | None = None
    charging: str | None = None
    profile_digest: str | None = None


class NewNode(NamedTuple):
    """What a bundle gives of a node that the store does not know; as in :class:`NodeRecord`."""

    uuid: bytes
    point: bytes
    name: str | None
    profile: str | None
    state: int
    teds_sha256: str | None


@dataclass(frozen=True, slots=True)
class NodeReading:
    """Last reading of each node, from which its verdict is derived.

    ``at`` is when its TEDS were read, ``by`` the command that did; ``c`` (8 octets) that of the newest session with the
    node, None for a reading in no session. ``whole``: every TEDS that it lists was read, in a session since its last
    start; else the Security TEDS alone was, and the rest of ``digests`` is as it was read before. ``digests`` are
    channel u16 ‖ access code u8 ‖ SHA-256 of every TEDS, ascending. Then fields 101 to 104 of the Security TEDS (None
    if it cannot be parsed, or is unsigned), and ``checks``: those that no later change of trust can alter, JSON.
    """

    uuid: bytes
    at: str
    by: str
    c: bytes | None
    whole: bool
    digests: bytes = field(repr=False)
    node_key: bytes | None = None
    node_key_signature: bytes | None = field(default=None, repr=False)
    station_key: bytes | None = None
    station_key_signature: bytes | None = field(default=None, repr=False)
    checks: str = "[]"

    @property
    def in_session(self) -> bool:
        """True if the node is known to have sent it: it was read in a session."""
        return self.c is not None

    @property
    def is_datasheet(self) -> bool:
        """True if a datasheet was read; the Security TEDS alone, which a plain contact shows, is none."""
        return self.whole or self.c is not None

    @property
    def failed(self) -> frozenset[str]:
        """Names of the checks of its octets that failed."""
        return frozenset(name for name, result, *_ in json.loads(self.checks) if result == "failed")

    def is_of_this_start(self, c: bytes) -> bool:
        """Return True if a session with this c is of the same power-up of the node (profile.md, "Sessions")."""
        if self.c is None:
            return False
        return (int.from_bytes(c, "big") - int.from_bytes(self.c, "big")) % (1 << 64) < 1 << 32


@dataclass(frozen=True, slots=True)
class FirmwareRecord:
    """The last firmware report of a node.

    ``report`` is the payload of the reply to About, empty if the node reports none; ``at`` is when this very report
    first came, or came again after another station had seen other firmware.
    ``signed`` is the report under which its datasheet was last signed here, None if none was.
    """

    uuid: bytes
    report: bytes
    in_session: bool
    at: str
    signed: bytes | None = None
    mac: bytes | None = field(default=None, repr=False, compare=False)


class ExportEligibility(NamedTuple):
    """Facts that decide whether a node may leave: its identity key with its seal, and whether it was retired."""

    uuid: bytes
    point: bytes | None
    point_mac: bytes | None
    retired: str | None


class ExportedNode(NamedTuple):
    """Facts of a node that a bundle contains beside its link key; as in :class:`NodeRecord`, with the node's groups."""

    uuid: bytes
    point: bytes | None
    sequence: int
    profile: str | None
    name: str | None
    teds_sha256: str | None
    groups: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class KeyRecord:
    """One link key of one node, wrapped by the vault; ``key_id`` is 16 hex digits (profile.md, "Key agreement").

    ``slot`` distinguishes keys of one node and epoch (see ``Store.next_slot``); ``seq`` is given by the store and
    grows.
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
    """The image that a node is being given, and how far it came."""

    uuid: bytes
    image: Image = field(repr=False)
    stage: DraftStage = "built"
    profile: str | None = None
    created: str = field(default_factory=utc_now)


@dataclass(frozen=True)
class DatasheetRecord:
    """A datasheet that a node had, as it was read or written.

    ``sequence``, ``epoch`` and ``signed`` (ISO 8601, None for an unsigned one) come from its Security TEDS; ``digest``
    is that of the image (64 hex digits), ``seen`` when it was read first.
    """

    uuid: bytes
    sequence: int
    epoch: int
    signed: str | None
    profile: str | None
    seen: str
    digest: str
    image: Image = field(repr=False)


@dataclass(frozen=True)
class StationRecord:
    """The station's own record: name, keystore, and the points (65 octets) and signature (64) of its key.

    ``requested`` is the point for which a certificate was requested; ``point``, ``ca`` and ``signature`` come together
    when init is complete. ``master`` is the number of the master key that wraps link keys, ``rewrapping`` the number of
    the next one during a change. ``seal_key`` (wrapped by the vault) makes the MACs of rows.
    """

    name: str
    keystore: str
    keystore_why: str = ""
    requested: bytes | None = None
    point: bytes | None = None
    ca: bytes | None = None
    signature: bytes | None = None
    master: int = 1
    rewrapping: int | None = None
    seal_key: bytes | None = field(default=None, repr=False)
    mac: bytes | None = field(default=None, repr=False, compare=False)


@dataclass(frozen=True)
class KeyFlags:
    """Flags of one node's keys, each until something ends it.

    ``ca``: P(CA) that it keeps, if that is not the owner's; ``next_ca`` the one that it keeps if the pending key
    ``next_key_id`` turns out to be good; ``rotation``: why a rotation is due; ``former``: fingerprint of the board that
    its link keys were agreed with, after its pin was removed.
    """

    ca: bytes | None = None
    ca_mac: bytes | None = field(default=None, repr=False, compare=False)
    next_key_id: str | None = None
    next_ca: bytes | None = None
    rotation: str | None = None
    former: str | None = None


@dataclass(frozen=True)
class Group:
    """A measurement group: nodes that are measured together."""

    name: str
    uuids: tuple[bytes, ...] = ()
    created: str = field(default_factory=utc_now)


COMMAND: Final = "command"
"""Owner of a measurement that a ``measure`` command runs."""


@dataclass(frozen=True)
class KeptMeasurement(MeasurementSpec):
    """A measurement that the station resumes after every start: its settings, and whose it is.

    ``owner`` is ``ncap``, ``page``, ``api:TOKEN`` or :data:`COMMAND`; of a command ``pid`` is the process ID and
    ``started`` the start of that process (unix seconds). ``ends`` is when (unix seconds), None for never.
    """

    id: str
    owner: str = field(default="ncap", kw_only=True)
    ends: float | None = field(default=None, kw_only=True)
    created: str = field(default_factory=utc_now, kw_only=True)
    pid: int | None = field(default=None, kw_only=True)
    started: int | None = field(default=None, kw_only=True)

    @property
    def lasting(self) -> bool:
        """True if it is kept until it is deleted; a command's ends with the command."""
        return self.owner != COMMAND


@dataclass(frozen=True)
class TrustRecord:
    """The public key of another station or of a CA, trusted because the operator added it."""

    name: str
    role: TrustRole
    point: bytes
    fingerprint: str
    added: str = field(default_factory=utc_now)
    mac: bytes | None = field(default=None, repr=False, compare=False)


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
    """A node given away: its key is no longer used; records the receiver."""

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
class RevocationRecord:
    """A node (by UUID, and by key if known) that is no longer trusted; ``statement`` is the signed text."""

    uuid: bytes
    fingerprint: str | None
    why: str
    statement: str
    created: str = field(default_factory=utc_now)
