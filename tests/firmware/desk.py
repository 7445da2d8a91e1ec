"""A station and a node in C without links: the desk of ``tests.protocol`` with the other node on it."""

from __future__ import annotations

import hashlib
import random
from dataclasses import dataclass, field
from typing import ClassVar

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import GROUP_ORDER
from teds_provision.protocol.messages.frames import Reply
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.teds.image import SECURITY
from tests.firmware.memory_node import MemoryNode
from tests.protocol.desk import NODE, UUID, Desk

ADDRESS = 192


@dataclass
class Memory:
    """Its flash, as the tests of the reference know one."""

    desk: CDesk

    @property
    def state(self) -> Flash:
        return self.desk.flash

    @property
    def fail(self) -> bool:
        return False

    @fail.setter
    def fail(self, fails: bool) -> None:
        self.desk.node.fails(fails)

    @property
    def garbles(self) -> bool:
        return False

    @garbles.setter
    def garbles(self, garbles: bool) -> None:
        self.desk.node.garble(5 if garbles else 0)


@dataclass
class CDesk(Desk):
    """One node in C; its flash takes units of ``unit`` octets and is ``erased`` where it is blank."""

    max_message: int = 1024
    max_teds: int = 4092
    unit: int = 8
    erased: int = 0xFF
    dice: random.Random = field(default_factory=lambda: random.Random(1))
    made: ClassVar[list[CDesk]] = []

    @classmethod
    def close_all(cls) -> None:
        """Give the memory of every desk of a test back."""
        while cls.made:
            cls.made.pop().node.close()

    def __post_init__(self) -> None:
        self.node = MemoryNode(
            self.draw,
            lambda: self.now,
            uuid=UUID,
            max_message=self.max_message,
            max_teds=self.max_teds,
            unit=self.unit,
            erased=self.erased,
        )
        self.key, self.session = b"", None
        self.tim = self.node  # type: ignore[assignment]
        self.memory = Memory(self)  # type: ignore[assignment]
        self.restart()
        if self.blocks or self.node.identity().can_address != ADDRESS:
            fixed = {block: teds for block, teds in self.blocks.items() if block in self.read_only}
            flash = Flash(UUID, NODE.point, b"", blocks=self.blocks, read_only=frozenset(fixed), can_address=ADDRESS)
            self.node.put(flash)
        self.made.append(self)

    def draw(self, kind: str, size: int) -> bytes:
        """Its randomness; the identity key is the desk's own."""
        if kind == "i":
            return NODE.secret()
        if kind == "o":
            return self.dice.randrange(1, GROUP_ORDER - (1 << 224)).to_bytes(32, "big")
        return self.dice.randbytes(size)

    def raw(self, octets: bytes, *, link: str = "nfc", tapped: bool = True) -> Reply:
        reply = super().raw(octets, link=link, tapped=tapped)
        self.node.reply_sent(link)
        return reply

    def restart(self) -> None:
        assert self.node.start() == 0

    @property
    def flash(self) -> Flash:
        """What it says of itself."""
        identity, blocks = self.node.identity(), self.node.blocks()
        provisioned = identity.state == NodeState.PROVISIONED
        stored = {block: teds for block, teds in blocks.items() if provisioned or block != SECURITY}
        return Flash(
            identity.uuid,
            NODE.point,
            NODE.sign(b"TEDS1 node key\0" + UUID + NODE.point),
            blocks=stored,
            epoch=identity.epoch,
            sequence=identity.sequence,
            provisioned=provisioned,
            can_address=identity.can_address,
            key=bytes(16) if identity.state else None,
        )

    def shown(self) -> tuple[object, ...]:
        """Return all that tells one state from another: Identify, and a digest of every TEDS."""
        blocks = {block: hashlib.sha256(teds).hexdigest() for block, teds in self.node.blocks().items()}
        return self.node.identity(), blocks
