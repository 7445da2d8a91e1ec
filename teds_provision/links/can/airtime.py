"""The share of a CAN bus that data messages use."""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.links.can.spec import DEFAULT_BITRATE
from teds_provision.protocol.operation.budget import MOST_OCTETS, bus_load
from teds_provision.protocol.operation.can_frames import frames_of


@dataclass(frozen=True)
class CanAirtime:
    """See ``links.streaming.Airtime``. Bit/s; with a ``data_bitrate`` data go in FD frames of 64 octets."""

    bitrate: int = DEFAULT_BITRATE
    data_bitrate: int | None = None

    @property
    def most_octets(self) -> int:
        """Octets of the longest data message."""
        return MOST_OCTETS

    def load(self, length: int, n: int, period: int) -> float:
        """Return a stream's share of the bus at worst-case stuffing."""
        return bus_load(length, n, period, bitrate=self.bitrate, data_bitrate=self.data_bitrate)

    def frames(self, length: int) -> int:
        """Return how many frames a message takes."""
        return frames_of(length, fd=self.data_bitrate is not None)
