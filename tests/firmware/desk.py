"""A station and a node in C without links: the desk of ``tests.protocol`` with the other node on it."""

from __future__ import annotations

import hashlib
import random
from dataclasses import dataclass, field

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import GROUP_ORDER
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.teds.image import SECURITY
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import NODE, UUID, Desk


@dataclass
class CDesk(Desk):
    """One node in C; its flash takes units of ``unit`` octets and is ``erased`` where it is blank."""

    max_message: int = 1024
    unit: int = 8
    erased: int = 0xFF
    dice: random.Random = field(default_factory=lambda: random.Random(1))

    def __post_init__(self) -> None:
        self.node = MemoryNode(
            self.draw, lambda: self.now, uuid=UUID, max_message=self.max_message, unit=self.unit, erased=self.erased
        )
        self.key, self.session = b"", None
        self.tim = self.node  # type: ignore[assignment]
        self.restart()

    def draw(self, kind: str, size: int) -> bytes:
        """Its randomness; the identity key is the desk's own."""
        if kind == "i":
            return NODE.secret()
        if kind == "o":
            return self.dice.randrange(1, GROUP_ORDER - (1 << 224)).to_bytes(32, "big")
        return self.dice.randbytes(size)

    def restart(self) -> None:
        assert self.node.start() == 0

    @property
    def flash(self) -> Flash:
        """What it says of itself."""
        said, blocks = self.node.identity(), self.node.blocks()
        provisioned = said.state == NodeState.PROVISIONED
        stored = {block: teds for block, teds in blocks.items() if provisioned or block != SECURITY}
        return Flash(
            said.uuid,
            NODE.point,
            NODE.sign(b"TEDS1 node key\0" + UUID + NODE.point),
            blocks=stored,
            epoch=said.epoch,
            sequence=said.sequence,
            provisioned=provisioned,
            can_address=said.can_address,
            key=bytes(16) if said.state else None,
        )

    def shown(self) -> tuple[object, ...]:
        """All that tells one state from another: Identify, and a digest of every TEDS."""
        blocks = {block: hashlib.sha256(teds).hexdigest() for block, teds in self.node.blocks().items()}
        return self.node.identity(), blocks
