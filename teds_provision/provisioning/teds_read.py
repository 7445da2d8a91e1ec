"""Reading TEDS off a node: one block, or all that it lists."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Generator, Iterable
from dataclasses import dataclass, field
from functools import partial

from teds_provision.errors import BadDataError, GarbledError, NodeRefusedError
from teds_provision.links.ports import PacedLink
from teds_provision.protocol.messages.frames import (
    IDENTIFY,
    Attribute,
    Command,
    Function,
    Reason,
    TedsStatus,
    decode_list,
    query_teds,
    read_teds,
    security_command,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.provisioning.conversation import Conversation
from teds_provision.teds.codec.frame import unframe
from teds_provision.teds.image import SECURITY, BlockId, Image

LARGEST_TEDS = 1 << 20
LARGEST_SECURITY = 65535
"""Room for 1,700 signed TEDS; it is read before anything is known of a node."""
LARGEST_IMAGE = 4 << 20
_NOISY_READS = 4
_REFUSED_READS = 2
READING_SECONDS = 300.0
"""A whole image takes seconds, over a slow link a minute; a slower node would delay others."""


def read_block(node: Conversation, block: BlockId, *, until: float | None = None) -> bytes:
    """Read one TEDS, segment by segment, up to its Length (or as the node has octets).

    Outside a session no tag distinguishes noise from a bad TEDS, so one with a wrong checksum is read again: two equal
    readings count. ``until`` is a monotonic time. Raises NodeRefusedError (18: no such TEDS) and,
    for a Length beyond 1 MiB (of a Security TEDS, 65535 octets), BadDataError in a session, GarbledError outside one.
    """
    octets = _read_once(node, block, until)
    for _ in range(_NOISY_READS):
        if node.sealed or _whole(octets):
            return octets
        again = _read_once(node, block, until)
        if again == octets:
            return octets
        octets = again
    raise GarbledError(f"TEDS {block[1]} of channel {block[0]} reads differently each time; the link is noisy.")


def _whole(octets: bytes) -> bool:
    try:
        unframe(octets)
    except BadDataError:
        return False
    return True


def _read_once(node: Conversation, block: BlockId, until: float | None) -> bytes:
    largest = LARGEST_SECURITY if block == SECURITY else LARGEST_TEDS
    octets = bytearray()
    until = time.monotonic() + READING_SECONDS if until is None else until
    while True:
        if time.monotonic() > until:
            raise GarbledError(f"The node delivers its TEDS too slowly: not finished after {READING_SECONDS:.0f} s.")
        segment = _read_segment(node, block, len(octets))
        octets += segment
        total = 4 + int.from_bytes(octets[:4], "big") if len(octets) >= 4 else largest
        if not segment or len(octets) >= total:
            return bytes(octets)
        if total > largest:
            text = f"TEDS {block[1]} of channel {block[0]} claims {total} octets; at most {largest} are read."
            raise (
                BadDataError(text)
                if node.sealed
                else GarbledError(f"{text} That is unverified: it was received outside a session.")
            )


def _read_segment(node: Conversation, block: BlockId, offset: int) -> bytes:
    """Read one segment; outside a session an answer to another question is repeated, as a refusal is."""
    channel, access_code = block
    command, what = read_teds(channel, access_code, offset), f"to read TEDS {access_code} of channel {channel}"
    for _ in range(1 if node.sealed else 1 + _REFUSED_READS):
        payload = _ask_despite_noise(node, command, what)
        if len(payload) >= 4 and int.from_bytes(payload[:4], "big") == offset:
            return payload[4:]
    raise GarbledError(f"The node read TEDS {access_code} of channel {channel} from a different offset than requested.")


def _ask_despite_noise(node: Conversation, command: Command, what: str) -> bytes:
    """Ask; a refusal that came in no session is asked for again: noise on the line makes another question of a read."""
    for left in range(_REFUSED_READS, -1, -1):
        try:
            return node.request_idempotent(command, what)
        except NodeRefusedError:
            if node.sealed or not left:
                raise
    raise AssertionError("the last refusal is raised")


def list_blocks(node: Conversation) -> list[BlockId]:
    """List (128.11): every TEDS on the node."""
    return decode_list(node.request_idempotent(security_command(Function.LIST), "to list its TEDS"))


def read_image(node: Conversation, *, initial: bytes | None = None, listed: Iterable[BlockId] | None = None) -> Image:
    """Read every TEDS of a node; ``initial`` replaces its Security TEDS if that is not worth reading again.

    ``listed`` are the TEDS that it has, if that is known; None: it is asked.
    """
    blocks: dict[BlockId, bytes] = {}
    total = 0
    until = time.monotonic() + READING_SECONDS
    for block in list_blocks(node) if listed is None else listed:
        if block == SECURITY and initial is not None:
            blocks[block] = initial
            continue
        try:
            blocks[block] = read_block(node, block, until=until)
        except NodeRefusedError as refusal:
            if refusal.reason != Reason.NO_SUCH_TEDS:
                raise
            continue
        total += len(blocks[block])
        if total > LARGEST_IMAGE:
            raise BadDataError("The node lists more than 4 MiB of TEDS.")
    return Image(node.uuid, blocks)


def read_in_between(node: Conversation, *, gap: int) -> Generator[None, None, Image]:
    """Read as :func:`read_image`, in the open session, one exchange for each ``next``; its value is the image.

    For a node that measures meanwhile: the caller chooses when the bus is free, and requests frames of a reply with
    ``gap`` ms between them. No new session replaces a lost one: it carries the streams. Raises SessionLostError,
    LinkError, NodeRefusedError, BadDataError.
    """

    def sent(command: Command, what: str) -> bytes:
        link = node.contact.link
        if not isinstance(link, PacedLink):
            return node.request(command, what)
        link.gap = gap
        try:
            return node.request(command, what)
        finally:
            link.gap = 0

    listed = decode_list(sent(security_command(Function.LIST), "to list its TEDS"))
    blocks: dict[BlockId, bytes] = {}
    for channel, code in listed:
        yield
        octets = bytearray()
        total = largest = LARGEST_SECURITY if (channel, code) == SECURITY else LARGEST_TEDS
        while len(octets) < total:
            what = f"to read TEDS {code} of channel {channel}"
            payload = sent(read_teds(channel, code, len(octets)), what)
            if len(payload) < 4 or int.from_bytes(payload[:4], "big") != len(octets):
                raise GarbledError(
                    f"The node read TEDS {code} of channel {channel} from a different offset than requested."
                )
            if len(payload) == 4:
                break
            octets += payload[4:]
            total = 4 + int.from_bytes(octets[:4], "big") if len(octets) >= 4 else largest
            if total > largest or sum(map(len, blocks.values())) + total > LARGEST_IMAGE:
                raise BadDataError(f"TEDS {code} of channel {channel} claims {total} octets, which is too many.")
            if len(octets) < total:
                yield
        blocks[channel, code] = bytes(octets)
    return Image(node.uuid, blocks)


def read_identity(node: Conversation) -> Identity:
    """Send Identify again, inside the session if one is open (then it is authentic)."""
    identity = Identity.decode(node.request_idempotent(IDENTIFY, "to identify itself"))
    if identity.uuid != node.uuid:
        raise GarbledError(f"The node gave its UUID as {node.uuid.hex()} before and gives {identity.uuid.hex()} now.")
    if node.sealed:
        node.proven = identity
    return identity


@dataclass(frozen=True)
class NodeSnapshot:
    """Content of a node, read in its session; the node is asked which TEDS are read-only if that matters, each once."""

    image: Image
    identity: Identity
    ask: Callable[[BlockId], bool] = field(repr=False, compare=False)
    _answers: dict[BlockId, bool] = field(default_factory=dict, repr=False, compare=False)

    def is_read_only(self, block: BlockId) -> bool:
        """Return True if the node has this TEDS and nothing can replace it."""
        if block not in self.image.blocks or block == SECURITY:
            return False
        if block not in self._answers:
            self._answers[block] = self.ask(block)
        return self._answers[block]

    @property
    def is_fixed(self) -> bool:
        """True if no TEDS but the Security TEDS can be replaced or removed, as on a node that has no other."""
        return all(map(self.is_read_only, self.image.unsigned_blocks()))

    def fixed_beside(self, blocks: Collection[BlockId]) -> dict[BlockId, bytes]:
        """Return the read-only TEDS that are none of these; the node is not asked about these."""
        return {
            block: teds
            for block, teds in self.image.unsigned_blocks().items()
            if block not in blocks and self.is_read_only(block)
        }


def take_snapshot(node: Conversation, *, initial: bytes | None = None) -> NodeSnapshot:
    """Read all TEDS, and in a session its Identify.

    ``initial`` is the Security TEDS that was read before the session: of a node that was not written since its last
    reset it is unsigned and adds nothing to the session, so it is not read twice.
    """
    identity = node.proven or read_identity(node)
    image = read_image(node, initial=None if identity.state == NodeState.PROVISIONED else initial)
    return NodeSnapshot(image, identity, partial(_is_read_only, node))


def _is_read_only(node: Conversation, block: BlockId) -> bool:
    status = TedsStatus.decode(
        node.request_idempotent(query_teds(*block), f"to query TEDS {block[1]} of channel {block[0]}")
    )
    return bool(status.attributes & Attribute.READ_ONLY)
