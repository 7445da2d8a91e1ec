"""The state that a node keeps through power cuts, and its one change: a whole new state in one transaction."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

from teds_provision.protocol.messages.identity import NodeState
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY, BlockId


class FlashError(Exception):
    """The commit of a :class:`Flash` failed; the old state remains (reason 11)."""


class ChipError(Exception):
    """Raised by a node's random source, key or one-time key that does not work: nothing was done (reason 11)."""


@dataclass(frozen=True)
class Flash:
    """A node's durable state.

    ``blocks`` holds every stored TEDS but the initial Security TEDS, which is made from the keys whenever
    ``provisioned`` is false. ``key``, ``station`` and ``ca`` are None in factory state.
    """

    uuid: bytes
    node_key: bytes
    node_key_signature: bytes
    blocks: Mapping[BlockId, bytes] = field(default_factory=dict)
    read_only: frozenset[BlockId] = frozenset()
    epoch: int = 0
    sequence: int = 0
    key: bytes | None = field(default=None, repr=False)
    station: bytes | None = None
    ca: bytes | None = None
    provisioned: bool = False
    can_address: int = 0

    @property
    def state(self) -> NodeState:
        """Factory, keyed or provisioned."""
        if self.key is None:
            return NodeState.FACTORY
        return NodeState.PROVISIONED if self.provisioned else NodeState.KEYED

    def security_teds(self) -> bytes:
        """Return the Security TEDS that the node shows now."""
        if self.provisioned:
            return self.blocks[SECURITY]
        return security.initial(self.node_key, self.node_key_signature, sequence=self.sequence, key_epoch=self.epoch)

    def teds(self, block: BlockId) -> bytes | None:
        """Return the stored TEDS, None if there is none."""
        return self.security_teds() if block == SECURITY else self.blocks.get(block)

    def present(self) -> list[BlockId]:
        """Return every TEDS on the node, ascending."""
        return sorted({*self.blocks, SECURITY})


def in_factory_state(flash: Flash) -> Flash:
    """Return the flash without key, CA and station, with an initial Security TEDS; all else is unchanged."""
    blocks = {block: teds for block, teds in flash.blocks.items() if block != SECURITY}
    return replace(flash, key=None, ca=None, station=None, provisioned=False, blocks=blocks)


class FlashMemory(Protocol):
    """Storage of the state. ``commit`` either stores the whole new state or leaves the whole old one."""

    def load(self) -> Flash:
        """Return the state as it is."""

    def commit(self, state: Flash) -> None:
        """Replace the state durably in one transaction; raises FlashError."""
