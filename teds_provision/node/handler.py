"""What a node's link servers (NFC tag, CAN) need from the node behind them."""

from __future__ import annotations

from typing import Protocol


class NodeHandler(Protocol):
    """The node as its links see it. Thread-safe: each link server runs in its own threads."""

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        """Run one whole command frame that arrived on ``link``; always returns a whole reply frame.

        ``link`` names the line (``"nfc"``, ``"can:f1"``): sessions and half-open Opens belong to it.
        ``tapped`` is true when the frame itself arrived over NFC. It may take long (``--crypto-delay``).
        """

    def lost(self, link: str) -> None:
        """The field or link is gone: its session, half-open Open and pending agreement end."""

    def identify(self) -> bytes:
        """Return the 23 octets of Identify as they are now (renewed into the NFC id record)."""

    def can_address(self) -> int:
        """Return the node's present CAN address, 1 to 239."""

    def take_can_address(self, address: int) -> None:
        """Have another CAN address until the restart: another node claimed this one (profile.md, "CAN")."""

    def actuator_claimed(self) -> bool:
        """Whether a session claims an actuator, so that the node keeps its CAN address whoever claims it."""


class Measuring(Protocol):
    """What a bus tells a node that measures, beside its commands (operation.md, sections 3 to 6). Thread-safe."""

    def tick(self, at: float = 0.0) -> int:
        """The tick of the node's clock, ns: the present one, or that of ``at`` (time.monotonic) a moment ago."""

    def request_received(
        self,
        link: str,
        frame: bytes,
        *,
        tapped: bool,
        received: int,
        fd: bool = False,
        mtu: int = 23,
        hears: bool = True,
    ) -> bytes:
        """As NodeHandler.request, for a frame whose last part came by CAN FD or not, at the tick ``received``.

        ``mtu`` and ``hears`` are those of a BLE connection; see Port.
        """

    def reply_left(self, link: str) -> None:
        """The last reply on this link has left (or will not any more): data may follow."""

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        """A trigger frame of this link's station ended at ``tick``."""

    def drive(self, link: str, data: bytes) -> None:
        """A Drive frame of this link's station came."""


class InTheAir(NodeHandler, Measuring, Protocol):
    """What a node's BLE asks beside (profile.md, "BLE")."""

    def in_factory_state(self) -> bool:
        """Whether the node holds no key."""

    def in_session(self, link: str) -> bool:
        """Whether a session is open on this link."""

    def unheard(self, link: str) -> None:
        """The station has disabled data messages on this link: its streams end."""
