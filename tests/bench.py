"""A station and a node on one desk, in memory: the real Tim behind a link that can lose messages and power."""

from __future__ import annotations

import atexit
import functools
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from teds_provision.errors import NodeSilentError
from teds_provision.links import LINKS, Capabilities, Contact
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.announce import default_can_address
from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import SoftwareKey, node_key_message
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.repetition import Repetition
from teds_provision.protocol.tim import Tim
from teds_provision.provisioning.conversation import Conversation
from teds_provision.station.station import Station, initialise
from teds_provision.vault import passphrase
from tests.protocol.memory import PowerCutError, RamFlash

PASSPHRASE = "correct horse battery"


def make_station(home: Path, name: str = "bench") -> Station:
    """Return a station with a passphrase vault at the lowest cost."""
    costs = passphrase.THROWAWAY
    return initialise(home, name=name, keystore="file", ask=lambda prompt, confirm: PASSPHRASE, costs=costs)[0]


@functools.cache
def _template() -> Path:
    """Return the home that this process copies: made at the first need, removed with the process."""
    folder = tempfile.TemporaryDirectory()
    atexit.register(folder.cleanup)
    make_station(Path(folder.name) / "bench").close()
    return Path(folder.name) / "bench"


def copy_home(home: Path) -> None:
    """Make the home of a station as ``make_station`` does, by a copy: a tenth of the CPU, and no wait for the disk.

    Every copy has the same keys: a test that needs two owners makes the other one by ``make_station``.
    """
    shutil.copytree(_template(), home, dirs_exist_ok=True)


def copied_station(home: Path) -> Station:
    """Return a station with a passphrase vault at the lowest cost, by :func:`copy_home`."""
    copy_home(home)
    return Station.open(home, ask=lambda prompt, confirm: PASSPHRASE)


@dataclass
class Board:
    """A node on the desk: its key, flash and the Tim that runs until power is cut."""

    uuid: bytes = bytes.fromhex("8d4d9da65281f7000000")
    max_message: int = 2048
    seconds: float = 0.0
    key: SoftwareKey = field(default_factory=SoftwareKey.generate)

    def __post_init__(self) -> None:
        flash = Flash(
            self.uuid,
            self.key.point,
            self.key.sign(node_key_message(self.uuid, self.key.point)),
            can_address=default_can_address(self.uuid),
        )
        self.flash = RamFlash(flash)
        self.power_on()

    def power_on(self) -> None:
        """Start anew from flash: sessions, pending agreement and stored replies are gone."""
        self.flash.die_before = self.flash.die_after = False
        self.tim = Tim(self.key, self.flash, lambda: self.seconds, max_message=self.max_message)
        self.repetition = Repetition()

    @property
    def state(self) -> Flash:
        return self.flash.state


@dataclass
class MemoryLink:
    """One request, one reply; ``lose_request``/``lose_reply`` name the exchange (from 1) that is cut."""

    board: Board
    via: str = "nfc"
    tapped: bool = True
    lose_request: int = 0
    lose_reply: int = 0
    tamper: Callable[[int, bytes], bytes] | None = None
    count: int = 0
    frames: list[bytes] = field(default_factory=list)

    def exchange(self, frame: bytes) -> bytes:
        self.count += 1
        self.frames.append(frame)
        if self.count == self.lose_request:
            raise NodeSilentError("The request was lost.")
        try:
            reply = self.board.repetition.answer(
                self.count,
                frame,
                lambda octets: self.board.tim.handle(octets, link=self.via, tapped=self.tapped),
                now=self.board.seconds,
            )
        except PowerCutError:
            self.board.power_on()
            raise NodeSilentError("The node lost power.") from None
        if self.count == self.lose_reply:
            raise NodeSilentError("The reply was lost.")
        return self.tamper(self.count, reply) if self.tamper is not None else reply

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.via].capabilities

    def close(self) -> None:
        self.board.tim.link_lost(self.via)


@dataclass
class VirtualLink:
    """A virtual node that lies on the reader of this process."""

    node: VirtualNode
    via: str = "nfc"

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.via].capabilities

    def exchange(self, frame: bytes) -> bytes:
        return self.node.request(self.via, frame, tapped=True)

    def close(self) -> None:
        self.node.lost(self.via)


def on_reader(node: VirtualNode) -> Contact:
    """Return the virtual node as a reader would find it."""
    return Contact(Identity.decode(node.identify()), VirtualLink(node), tag_uid=b"\x04" + bytes(6))


def contact(board: Board, link: MemoryLink | None = None) -> Contact:
    """Return the node as a port would find it."""
    link = link or MemoryLink(board)
    reply = board.tim.identity().encode()
    address = board.tim.flash.can_address if link.via == "can" else None
    return Contact(Identity.decode(reply), link, tag_uid=b"\x04\x11\x22\x33\x44\x55\x66", address=address)


def talk(board: Board, link: MemoryLink | None = None) -> Conversation:
    """Return a conversation with the node."""
    return Conversation(contact(board, link), notice=lambda notice: None)
