"""The firmware below a node as measurement operation sees it: channels, values, clock (operation.md 1, 2, 5). Node.

The TEDS does not command the hardware: kind, widths, halt and shortest period of a channel are defined here, and a
channel whose stored TEDS differs is not claimed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, NamedTuple, Protocol

from teds_provision.protocol.operation.commands import PowerReply
from teds_provision.teds.codec.decode import decode
from teds_provision.teds.sheet import ChannelKind, channel_from

_MILLION: Final = 10**6
_LONGEST: Final = 1e6
"""Seconds that replace every longer SPeriod, infinity too: no stream has such a period."""


@dataclass(frozen=True)
class ChannelHardware:
    """One channel as the firmware knows it.

    ``octets`` is ModLenth, ``model`` DatModel, ``halt`` ActHalt (None: none), ``shortest`` the shortest period in ns.
    """

    kind: ChannelKind
    octets: int
    model: int = 0
    halt: int | None = None
    shortest: int = 1

    @property
    def actuator(self) -> bool:
        """True if the channel is an actuator."""
        return self.kind is ChannelKind.ACTUATOR


class RawReading(NamedTuple):
    """One data set, ModLenth octets; not valid if out of range, warming up, or with a fault."""

    octets: bytes
    valid: bool = True


class Hardware(Protocol):
    """The firmware. All calls return at once; ticks are ns of the node's clock, which never goes back.

    ``step`` in ns and ``drift`` in ppm describe that clock. ``safe`` must not depend on links, flash or cryptography.
    """

    @property
    def channels(self) -> Mapping[int, ChannelHardware]:
        """Channels 1 to 255."""

    @property
    def step(self) -> int:
        """Step of the clock, ns."""

    @property
    def drift(self) -> int:
        """How far the clock may run off, ppm."""

    def now(self) -> int:
        """Return the present tick."""

    def keeps(self, period: int) -> bool:
        """Return True if the clock keeps a period of so many ns on average."""

    def read(self, channel: int, tick: int) -> RawReading:
        """Return the value of a sensor at ``tick``, which is now or a little before."""

    def accepts(self, channel: int, data_set: bytes) -> bool:
        """Return True if the hardware of an actuator accepts this raw value."""

    def apply(self, values: Mapping[int, bytes]) -> None:
        """Give actuators their values, all together."""

    def set_point(self, channel: int) -> bytes:
        """Return the present value of an actuator."""

    def make_safe(self, channel: int) -> None:
        """Bring an actuator to its safe state, as ActHalt requires."""

    def self_test(self, channels: Sequence[int]) -> None:
        """Begin a self-test; it never moves an actuator."""

    def testing(self, channel: int) -> bool:
        """Return True if the channel's self-test runs."""

    def fault(self, channel: int) -> bool:
        """Return True if its hardware has a fault, or its last self-test failed."""

    def power(self) -> PowerReply:
        """Return battery and charge."""


class SessionPort(NamedTuple):
    """Place of a session's link: ``kind`` nfc, can or ble; streams of one ``bus`` share its budget.

    ``source`` is the station's address there (F1 to F7 on CAN, 1 on NFC, 2 and up on BLE); ``fd``: the command came by
    CAN FD; ``mtu`` is that of a BLE connection, ``hears``: the station has enabled data messages on it.
    """

    kind: str
    bus: str
    source: int
    fd: bool = False
    mtu: int = 23
    hears: bool = True


def port_of(link: str) -> SessionPort:
    """Return the port of a link's name: ``nfc``, ``can:f1``, ``ble:2`` (the bus is the part before the last colon)."""
    bus, _, source = link.rpartition(":")
    bus = bus or link
    kind = bus.partition(":")[0].rstrip("0123456789")
    number = int(source, 16) if source and bus != link else 1
    return SessionPort(kind, bus, number)


def teds_fits(own: ChannelHardware, teds: bytes | None) -> bool:
    """Return True if a stored Channel TEDS matches the firmware.

    Compared: ChanType, DatModel, ModLenth, and ActHalt if present.
    """
    if teds is None:
        return False
    described = channel_from(decode(teds))
    if described.kind is not own.kind or described.sample is None:
        return False
    halts = not own.actuator or described.halt is None or described.halt == own.halt
    return halts and (described.sample.model, described.sample.octets) == (own.model, own.octets)


def teds_period(teds: bytes | None) -> int:
    """Return SPeriod of a Channel TEDS in ns, less 1 ppm (it is a Float32); 0 if it is absent, NaN or not positive."""
    period = channel_from(decode(teds)).period if teds is not None else 0.0
    return int(min(period, _LONGEST) * 1e9 * (1 - 1 / _MILLION)) if period > 0 else 0
