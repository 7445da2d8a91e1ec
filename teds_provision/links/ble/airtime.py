"""The share of a Bluetooth adapter's time that data messages use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from teds_provision.protocol.messages.ble import LEAST_MTU
from teds_provision.protocol.operation.budget import BLE_OVERHEAD, MOST_OCTETS

AIR_MESSAGES: Final = 160.0
"""Notifications a second that an adapter is trusted with, all connections together."""


@dataclass(frozen=True)
class BleAirtime:
    """See ``links.streaming.Airtime``; a message is one notification, at most the connection's ATT ``mtu`` long."""

    mtu: int = LEAST_MTU

    @property
    def most_octets(self) -> int:
        """Octets of the longest data message."""
        return min(MOST_OCTETS, self.mtu - BLE_OVERHEAD)

    def load(self, length: int, n: int, period: int) -> float:
        """Return a stream's share of what an adapter carries."""
        del length
        return 1e9 / (n * period) / AIR_MESSAGES

    def frames(self, length: int) -> int:
        """Return 1: a message is one notification."""
        del length
        return 1
