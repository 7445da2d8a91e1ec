"""TEDS access on the node: Query, Read, Write, Update (profile.md, "Writing to flash"). Pure."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.protocol.commit import verified_commit
from teds_provision.protocol.datasheet import can_be_stored, passes_own_check
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import Verify, verify
from teds_provision.protocol.messages.frames import (
    READ_OVERHEAD,
    Attribute,
    Command,
    Reason,
    Refused,
    Reply,
    TedsStatus,
)
from teds_provision.teds.codec.codes import MANUFACTURER, TEXT_BASED
from teds_provision.teds.image import SECURITY, BlockId

REQUEST_REPLY_OVERHEAD = 78

Staging = dict[BlockId, bytes]


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
            raise Refused(Reason.NO_SUCH_TEDS)
        offset = min(int.from_bytes(command.payload[1:5], "big"), len(teds))
        octets = teds[offset : offset + self.max_message - READ_OVERHEAD]
        return Reply(True, offset.to_bytes(4, "big") + octets)

    def write(self, flash: Flash, command: Command, staging: Staging) -> Reply:
        """Write TEDS segment (1.3) into the staged image; what lay after the written octets is dropped."""
        if len(command.payload) < 5:
            raise Refused(Reason.BAD_FORM)
        block = _block(command, len(command.payload))
        if block in flash.read_only:
            raise Refused(Reason.NOT_PERMITTED)
        staged = staging.get(block, b"")
        offset = int.from_bytes(command.payload[1:5], "big")
        if offset > len(staged):
            raise Refused(Reason.BAD_FORM)
        image = staged[:offset] + command.payload[5:]
        if len(image) > self._largest(block):
            raise Refused(Reason.TOO_LARGE)
        staging[block] = image
        return Reply(True)

    def update(self, flash: Flash, command: Command, staging: Staging) -> tuple[Reply, Flash | None]:
        """Update TEDS (1.4): the reply, and the state to commit where it is that of access code 128."""
        block = _block(command, 1)
        if block not in staging:
            if block == SECURITY and staging:
                raise Refused(Reason.WRONG_STATE)
            return self.query(flash, command), None
        state = None
        if block == SECURITY:
            state = verified_commit(flash, staging, self.verify)
        elif not passes_own_check(block, staging[block]):
            raise Refused(Reason.BAD_FORM)
        return Reply(True, self._status(flash, block, staging[block]).encode()), state

    def _largest(self, block: BlockId) -> int:
        return min(self.max_teds, self.max_message - REQUEST_REPLY_OVERHEAD) if block == SECURITY else self.max_teds

    def _status(self, flash: Flash, block: BlockId, teds: bytes | None) -> TedsStatus:
        attributes = 0
        if block[1] >= MANUFACTURER:
            attributes |= Attribute.MANUFACTURER
        if block[1] in TEXT_BASED:
            attributes |= Attribute.TEXT
        if block in flash.read_only:
            attributes |= Attribute.READ_ONLY
        if teds is None:
            return TedsStatus(attributes | Attribute.NOT_AVAILABLE, 0, 0, self._largest(block))
        return TedsStatus(attributes, len(teds), int.from_bytes(teds[-2:], "big"), self._largest(block))


def _block(command: Command, octets: int) -> BlockId:
    """The TEDS that a command names; its payload must have that many octets, and the node be able to hold it."""
    if len(command.payload) != octets:
        raise Refused(Reason.BAD_FORM)
    block = (command.channel, command.payload[0])
    if not can_be_stored(block):
        raise Refused(Reason.NO_SUCH_TEDS)
    return block
