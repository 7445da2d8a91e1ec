"""The virtual transducer: one Tim behind both link servers, as slow as it is told to be."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from teds_provision.node.flash_file import FlashFile
from teds_provision.protocol.keys import PrivateKey, SoftwareKey
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.tim import Tim

QUICK_SECONDS = 0.005
"""Point operations up to here hold no Sealed frame up for long (operation.md section 2)."""


@dataclass(frozen=True)
class Delays:
    """Seconds that a board would need: for one point operation (signature, ECDH, key pair), for one flash commit."""

    crypto: float = 0.0
    flash: float = 0.0


@dataclass(frozen=True)
class _SlowKey:
    """A node's key on a slow chip."""

    key: PrivateKey
    delay: float

    @property
    def point(self) -> bytes:
        return self.key.point

    def sign(self, message: bytes) -> bytes:
        time.sleep(self.delay)
        return self.key.sign(message)

    def ecdh(self, peer: bytes) -> bytes:
        time.sleep(self.delay)
        return self.key.ecdh(peer)


def _slow_one_time(delay: float) -> PrivateKey:
    """A key pair for one Open, made on a slow chip."""
    time.sleep(delay)
    return _SlowKey(SoftwareKey.generate(), delay)


class LinkServer(Protocol):
    """One link of the node, served in a thread of its own."""

    def start(self) -> None:
        """Open the link; raises a LinkFailure where it cannot."""

    def stop(self) -> None:
        """Close it; never raises."""


class VirtualNode:
    """A NodeHandler: runs one command at a time, whichever link it came by, like the one core of a small board.

    ``exclusive`` takes the node for this process; see FlashFile.
    """

    def __init__(
        self,
        folder: Path,
        *,
        delays: Delays | None = None,
        clock: Callable[[], float] = time.monotonic,
        exclusive: bool = False,
    ) -> None:
        delays = delays or Delays()
        self.flash_file = FlashFile(folder, delay=delays.flash, exclusive=exclusive)
        self._one = threading.Lock()
        self.tim = Tim(
            _SlowKey(self.flash_file.key, delays.crypto),
            self.flash_file,
            clock,
            max_message=self.flash_file.max_message,
            one_time=lambda: _slow_one_time(delays.crypto),
            quick_points=delays.crypto <= QUICK_SECONDS,
        )

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        """Run one command frame; see NodeHandler."""
        with self._one:
            return self.tim.handle(frame, link=link, tapped=tapped)

    def lost(self, link: str) -> None:
        """The link is gone; see NodeHandler."""
        with self._one:
            self.tim.link_lost(link)

    def identify(self) -> bytes:
        """Identify as it is now; see NodeHandler."""
        return self.tim.identity().encode()

    def can_address(self) -> int:
        """Present CAN address; see NodeHandler."""
        return self.tim.can_address

    def take_can_address(self, address: int) -> None:
        """Move to another CAN address until the restart; see NodeHandler."""
        self.tim.take_can_address(address)

    def actuator_claimed(self) -> bool:
        """Whether an actuator is claimed; see NodeHandler."""
        return self.tim.actuator_claimed()

    def in_factory_state(self) -> bool:
        """Whether the node holds no key."""
        return self.tim.flash.state == NodeState.FACTORY

    def reset_by_hand(self) -> None:
        """Hold the button 5 s."""
        with self._one:
            self.tim.reset_by_hand()
