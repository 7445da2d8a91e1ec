"""TEDS access on the node: Query, Read, Write, Update, and the commit (profile.md, "Writing to flash"). Pure."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from teds_provision.protocol import datasheet
from teds_provision.protocol.datasheet import can_be_stored, passes_own_check
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import Verify, verify
from teds_provision.protocol.messages.frames import (
    LIST_OVERHEAD,
    READ_OVERHEAD,
    Attribute,
    Command,
    CommandRefusedError,
    Reason,
    Reply,
    TedsStatus,
)
from teds_provision.protocol.session import NodeSession
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.model import MANUFACTURER, TEXT_BASED
from teds_provision.teds.codec.security import NotCanonicalError, SecurityTeds
from teds_provision.teds.image import SECURITY, BlockId

STAGED_SECONDS: Final = 60.0
"""Seconds after which untouched staging of a session gives way to a Write in another one."""
_ENTRY_OCTETS: Final = 3


@dataclass
class Staging:
    """The node's one staging area: images by TEDS, and the session that they belong to and go with."""

    _owner: NodeSession | None = None
    _images: dict[BlockId, bytes] = field(default_factory=dict)
    _touched_at: float = 0.0

    def staged_by(self, session: NodeSession) -> Mapping[BlockId, bytes]:
        """Return what this session has staged."""
        return self._images if session is self._owner else {}

    def require(self, session: NodeSession, *, untouched: float | None = None) -> None:
        """Raise CommandRefusedError (17) if something is staged in another session.

        ``untouched``: seconds (monotonic) now, for a Write, to which staging that is too old gives way.
        """
        gives_way = untouched is not None and untouched - self._touched_at >= STAGED_SECONDS
        if self._images and session is not self._owner and not gives_way:
            raise CommandRefusedError(Reason.BUSY)

    def put(self, session: NodeSession, block: BlockId, image: bytes, now: float) -> None:
        """Stage an image; staged images of another session are dropped."""
        if session is not self._owner:
            self._owner, self._images = session, {}
        self._images[block], self._touched_at = image, now

    def touch(self, session: NodeSession, now: float) -> None:
        """Record that the session uses its staging."""
        if session is self._owner:
            self._touched_at = now

    def end(self, session: NodeSession | None = None) -> None:
        """Drop what this session has staged; None: any staging."""
        if session is None or session is self._owner:
            self._owner, self._images = None, {}


@dataclass(frozen=True)
class TedsAccess:
    """Query, Read, Write and Update over a node's state.

    ``max_teds`` octets is the largest TEDS it takes; ``verify`` checks signatures.
    """

    max_message: int
    max_teds: int
    verify: Verify = verify

    def query(self, flash: Flash, command: Command) -> Reply:
        """Query TEDS (1.1)."""
        block = _block(command, 1)
        return Reply(True, self._status(flash, block, flash.teds(block)).encode())

    def read(self, flash: Flash, command: Command) -> Reply:
        """Read TEDS segment (1.2): offset ‖ as many octets as one message carries."""
        block = _block(command, 5)
        teds = flash.teds(block)
        if teds is None:
            raise CommandRefusedError(Reason.NO_SUCH_TEDS)
        offset = min(int.from_bytes(command.payload[1:5], "big"), len(teds))
        octets = teds[offset : offset + self.max_message - READ_OVERHEAD]
        return Reply(True, offset.to_bytes(4, "big") + octets)

    def write(self, flash: Flash, command: Command, staging: Staging, session: NodeSession, *, now: float) -> Reply:
        """Write TEDS segment (1.3) into the staged image; octets after the written ones are dropped.

        ``now`` is a monotonic time in seconds.
        """
        if len(command.payload) < 5:
            raise CommandRefusedError(Reason.BAD_FORM)
        block = _block(command, len(command.payload))
        if block in flash.read_only:
            raise CommandRefusedError(Reason.NOT_PERMITTED)
        staged = staging.staged_by(session).get(block, b"")
        offset = int.from_bytes(command.payload[1:5], "big")
        if offset > len(staged):
            raise CommandRefusedError(Reason.BAD_FORM)
        staging.require(session, untouched=now)
        image = staged[:offset] + command.payload[5:]
        if len(image) > self.max_teds or not self._can_list(
            {*flash.blocks, *staging.staged_by(session), block, SECURITY}
        ):
            raise CommandRefusedError(Reason.TOO_LARGE)
        staging.put(session, block, image, now)
        return Reply(True)

    def update(
        self, flash: Flash, command: Command, staging: Staging, session: NodeSession, *, now: float
    ) -> tuple[Reply, Flash | None]:
        """Run Update TEDS (1.4): return the reply, and the state to commit if it is that of access code 128."""
        block = _block(command, 1)
        staging.require(session)
        staged = staging.staged_by(session)
        staging.touch(session, now)
        if block not in staged:
            if block == SECURITY and staged:
                raise CommandRefusedError(Reason.WRONG_STATE)
            return self.query(flash, command), None
        state = None
        if block == SECURITY:
            state = verified_commit(flash, staged, self.verify)
        elif not passes_own_check(block, staged[block]):
            raise CommandRefusedError(Reason.BAD_FORM)
        return Reply(True, self._status(flash, block, staged[block]).encode()), state

    def _can_list(self, blocks: set[BlockId]) -> bool:
        """Return True if the reply to List, sealed, still fits into one message."""
        return _ENTRY_OCTETS * len(blocks) <= self.max_message - LIST_OVERHEAD

    def _status(self, flash: Flash, block: BlockId, teds: bytes | None) -> TedsStatus:
        attributes = 0
        if block[1] >= MANUFACTURER:
            attributes |= Attribute.MANUFACTURER
        if block[1] in TEXT_BASED:
            attributes |= Attribute.TEXT
        if block in flash.read_only:
            attributes |= Attribute.READ_ONLY
        if teds is None:
            return TedsStatus(attributes | Attribute.NOT_AVAILABLE, 0, 0, self.max_teds)
        return TedsStatus(attributes, len(teds), int.from_bytes(teds[-2:], "big"), self.max_teds)


def _block(command: Command, octets: int) -> BlockId:
    """Return the TEDS that a command names; its payload must have that many octets, and the node be able to hold it."""
    if len(command.payload) != octets:
        raise CommandRefusedError(Reason.BAD_FORM)
    block = (command.channel, command.payload[0])
    if not can_be_stored(block):
        raise CommandRefusedError(Reason.NO_SUCH_TEDS)
    return block


# The commit: the checks of Update of TEDS 128 before anything is stored, in order (profile.md, "Writing to flash").


def _demand(holds: bool, reason: Reason) -> None:
    if not holds:
        raise CommandRefusedError(reason)


def verified_commit(flash: Flash, staged: Mapping[BlockId, bytes], verify: Verify = verify) -> Flash:
    """Return the state that the commit of ``staged`` leads to.

    Raises CommandRefusedError with the first check that fails.
    """
    for block, teds in staged.items():
        _demand(datasheet.passes_own_check(block, teds), Reason.BAD_FORM)
    try:
        signed = security.decode(staged[SECURITY])
    except NotCanonicalError:
        raise CommandRefusedError(Reason.BAD_FORM) from None
    _demand(signed.signed, Reason.BAD_FORM)
    _demand(datasheet.own_values(signed), Reason.BAD_FORM)
    own = (flash.node_key, flash.node_key_signature)
    _demand((signed.node_key, signed.node_key_signature) == own, Reason.BAD_SIGNATURE)
    _demand(datasheet.station_signature_good(signed, flash.ca or b"", verify), Reason.BAD_SIGNATURE)
    _demand(datasheet.signature_good(signed, staged[SECURITY], flash.uuid, verify), Reason.BAD_SIGNATURE)
    blocks = _listed_blocks(flash, staged, signed)
    for (_, access_code), teds in blocks.items():
        _demand(access_code != AccessCode.META or datasheet.meta_names(teds, flash.uuid), Reason.WRONG_UUID)
    ahead = signed.sequence - flash.sequence
    _demand(0 < ahead <= datasheet.SEQUENCE_WINDOW, Reason.STALE_SEQUENCE)
    _demand(signed.key_epoch == flash.epoch, Reason.WRONG_EPOCH)
    kept = {block: teds for block, teds in flash.blocks.items() if block in flash.read_only and block not in blocks}
    stored = {**kept, **blocks, SECURITY: staged[SECURITY]}
    return replace(flash, blocks=stored, sequence=signed.sequence, provisioned=True)


def _listed_blocks(flash: Flash, staged: Mapping[BlockId, bytes], signed: SecurityTeds) -> dict[BlockId, bytes]:
    blocks: dict[BlockId, bytes] = {}
    for block, digest in signed.signed_blocks.items():
        teds = staged[block] if block in staged else flash.teds(block)
        if teds is None or hashlib.sha256(teds).digest() != digest:
            raise CommandRefusedError(Reason.DIGEST_MISMATCH)
        blocks[block] = teds
    _demand(staged.keys() - {SECURITY} <= blocks.keys(), Reason.DIGEST_MISMATCH)
    return blocks
