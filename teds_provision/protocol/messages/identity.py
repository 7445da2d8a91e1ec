"""Identify (128.7): a node's unauthenticated description of itself (profile.md, "Identify, Prove, List")."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

from teds_provision.errors import BadDataError

_LAYOUT = struct.Struct(">B10sBIIHB")
IDENTITY_OCTETS = _LAYOUT.size  # 23
LEAST_MESSAGE, MOST_MESSAGE = 512, 4094
"""Octets of maxMessage."""


class NodeState(IntEnum):
    """State of a node: no key; a key; a key and a committed datasheet since the last reset."""

    FACTORY = 0
    KEYED = 1
    PROVISIONED = 2


@dataclass(frozen=True)
class Identity:
    """Payload of the reply to Identify: a hint, proves nothing.

    ``uuid`` 10 octets; ``max_message`` octets of the longest whole command or reply frame; ``can_address`` 1 to 239,
    0 for none.
    """

    uuid: bytes
    state: NodeState
    epoch: int
    sequence: int
    max_message: int
    can_address: int

    def encode(self) -> bytes:
        """Return the 23 octets: version ‖ UUID ‖ state ‖ epoch ‖ sequence ‖ maxMessage ‖ canAddress."""
        return _LAYOUT.pack(1, self.uuid, self.state, self.epoch, self.sequence, self.max_message, self.can_address)

    @classmethod
    def decode(cls, octets: bytes) -> Identity:
        """Read the 23 octets; raises BadDataError when they are not an Identify payload of version 1."""
        if len(octets) != IDENTITY_OCTETS:
            raise BadDataError(f"An Identify payload has {IDENTITY_OCTETS} octets, this one {len(octets)}.")
        version, uuid, state, epoch, sequence, max_message, address = _LAYOUT.unpack(octets)
        if version != 1:
            raise BadDataError(f"The node speaks version {version} of the profile; this tool speaks version 1.")
        if state > NodeState.PROVISIONED:
            raise BadDataError(f"Identify names a state {state} that the profile does not know.")
        if not LEAST_MESSAGE <= max_message <= MOST_MESSAGE:
            least, most = LEAST_MESSAGE, MOST_MESSAGE
            raise BadDataError(f"Identify names a maxMessage of {max_message}; the profile allows {least} to {most}.")
        if address > 239:
            raise BadDataError(f"Identify names a CAN address {address}; the profile allows 1 to 239, 0 for none.")
        return cls(uuid, NodeState(state), epoch, sequence, max_message, address)
