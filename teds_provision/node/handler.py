"""The interface of a node towards its link servers (NFC tag, CAN)."""

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
        """End session, half-open Open and pending agreement: the field or link is gone."""

    def identify(self) -> bytes:
        """Return the 23 octets of Identify as they are now (renewed into the NFC id record)."""

    def can_address(self) -> int:
        """Return the node's present CAN address, 1 to 239."""

    def take_can_address(self, address: int) -> None:
        """Have another CAN address until the restart: another node claimed this one (profile.md, "CAN")."""

    def actuator_claimed(self) -> bool:
        """Return True if a session claims an actuator, so that the node keeps its CAN address."""


class MeasuringHandler(Protocol):
    """Events that a bus passes to a measuring node, beside its commands (operation.md, sections 3 to 6).

    Thread-safe.
    """

    def tick(self, at: float = 0.0) -> int:
        """Return the tick of the node's clock, ns: the present one, or that of ``at`` (time.monotonic) a moment ago."""

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
        """Run a command frame like NodeHandler.request. Its last part came at the tick ``received``, ``fd`` by CAN FD.

        ``mtu`` and ``hears`` are those of a BLE connection; see SessionPort.
        """

    def reply_sent(self, link: str) -> None:
        """Let data follow: the last reply on this link has left (or will not any more)."""

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        """Handle a trigger frame of this link's station that ended at ``tick``."""

    def drive(self, link: str, data: bytes) -> None:
        """Handle a Drive frame of this link's station."""


class BleHandler(NodeHandler, MeasuringHandler, Protocol):
    """A node's handler with the events of BLE (profile.md, "BLE")."""

    def in_factory_state(self) -> bool:
        """Return True if the node holds no key."""

    def in_session(self, link: str) -> bool:
        """Return True if a session is open on this link."""

    def unheard(self, link: str) -> None:
        """End the streams of this link: the station has disabled data messages on it."""
