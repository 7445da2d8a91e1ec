"""A bus with devices that do not use the profile: frames with 11-bit and 29-bit identifiers, read only.

:class:`~teds_provision.links.can.bus.Bus` receives only the profile's frames; this one receives all others.
"""

from __future__ import annotations

import contextlib
import logging
import select
import socket
import time
from collections.abc import Collection
from typing import TYPE_CHECKING, NamedTuple

from teds_provision.errors import LinkError
from teds_provision.lazy import late
from teds_provision.links.can.bus import clock_is_ours, open_bus
from teds_provision.links.can.multicast import arrival
from teds_provision.links.can.spec import CanSpec

if TYPE_CHECKING:
    import can
    import msgpack
else:
    can, msgpack = late("can"), late("msgpack")

_LARGEST = 4096
_ANCILLARY = socket.CMSG_SPACE(16) if hasattr(socket, "CMSG_SPACE") else 0
_LATEST_SECONDS = 1.0
"""A time stamp that is older is taken for one of another clock."""


class SensorFrame(NamedTuple):
    """A data frame; ``at`` is its arrival in seconds of ``time.monotonic()``."""

    identifier: int
    extended: bool
    data: bytes
    at: float


class SensorBus:
    """Frames of other devices. Each reader has its own: python-can gives a frame to one reader of a bus object only.

    ``wanted`` is what SocketCAN lets through: identifier, mask, and whether it has 29 bits; all frames if it is empty.
    Raises NoReaderError or UsageError.
    """

    def __init__(self, spec: CanSpec, wanted: Collection[tuple[int, int, bool]] = ()) -> None:
        self.spec = spec
        self._bus = open_bus(spec)
        self._clock_is_ours = clock_is_ours(spec)
        found = getattr(getattr(self._bus, "_multicast", None), "_socket", None)
        self._socket = found if spec.interface == "udp_multicast" and isinstance(found, socket.socket) else None
        self._poll = select.poll()
        if self._socket is not None:
            self._poll.register(self._socket, select.POLLIN)
        elif wanted and spec.interface == "socketcan":
            self._bus.set_filters(
                [{"can_id": number, "can_mask": mask, "extended": extended} for number, mask, extended in wanted]
            )

    @property
    def stamped(self) -> bool:
        """True if this machine's kernel dates the frames, so that they may wait to be read."""
        return self._clock_is_ours

    def receive(self, seconds: float) -> SensorFrame | None:
        """Return the next data frame; None if there is none within ``seconds``. Raises LinkError."""
        try:
            return self._read(seconds) if self._socket is not None else self._receive(seconds)
        except (can.CanError, OSError, ValueError) as error:
            raise LinkError(
                f"The CAN bus {self.spec.text} cannot be read: {error}.",
                hint="Check that the adapter is up and plugged in.",
            ) from error

    def close(self) -> None:
        """Release the adapter; never raises."""
        try:
            self._bus.shutdown()
        except Exception:  # python-can back ends raise whatever their driver raises
            logging.getLogger(__name__).debug("The CAN bus did not close cleanly.", exc_info=True)

    def _receive(self, seconds: float) -> SensorFrame | None:
        message = self._bus.recv(timeout=max(0.0, seconds))
        if message is None or message.is_error_frame or message.is_remote_frame:
            return None
        age = time.time() - message.timestamp if self._clock_is_ours else 0.0
        at = time.monotonic() - (age if 0.0 < age < _LATEST_SECONDS else 0.0)
        return SensorFrame(message.arbitration_id, message.is_extended_id, bytes(message.data), at)

    def _read(self, seconds: float) -> SensorFrame | None:
        """Read a datagram of ``udp_multicast`` without what python-can does for each one."""
        assert self._socket is not None
        with contextlib.suppress(BlockingIOError):
            return self._datagram(self._socket)
        if seconds <= 0 or not self._poll.poll(seconds * 1000):
            return None
        with contextlib.suppress(BlockingIOError):
            return self._datagram(self._socket)
        return None

    def _datagram(self, source: socket.socket) -> SensorFrame | None:
        datagram, ancillary, _, _ = source.recvmsg(_LARGEST, _ANCILLARY, socket.MSG_DONTWAIT)
        try:
            fields = msgpack.unpackb(datagram)
        except Exception:  # noqa: BLE001 - msgpack raises ValueError, its own, and what a key of a strange type raises
            return None
        if type(fields) is not dict or fields.get("is_error_frame") or fields.get("is_remote_frame"):
            return None
        identifier, data = fields.get("arbitration_id"), fields.get("data")
        extended = bool(fields.get("is_extended_id", True))
        if type(identifier) is not int or type(data) is not bytes or len(data) > 64:
            return None
        if not 0 <= identifier < (1 << 29 if extended else 1 << 11):
            return None
        return SensorFrame(identifier, extended, data, arrival(ancillary))
