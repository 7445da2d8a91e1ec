"""python-can's ``udp_multicast`` bus, without python-can's overhead per frame.

The datagrams are python-can's own (a msgpack map of the fields of ``can.Message``), so that any program with python-can
interoperates. Only reading and writing differ: a message object, a select and two clock readings a frame are left out,
and our own frames do not come back. They are sent from a separate socket, whose address no other program has; the
kernel drops datagrams from it before they wake this process (socket filter, Linux: ``man 7 socket``, SO_ATTACH_FILTER).
"""

from __future__ import annotations

import array
import contextlib
import select
import socket
import struct
import sys
import time
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from teds_provision.lazy import late
from teds_provision.links.can.isotp import Frame

if TYPE_CHECKING:
    import msgpack
else:
    msgpack = late("msgpack")

_LARGEST: Final = 4096
_STAMP: Final = struct.Struct("@ll")
_ANCILLARY: Final = socket.CMSG_SPACE(_STAMP.size) if hasattr(socket, "CMSG_SPACE") else 0
_TIMESTAMPNS: Final = 35
"""SO_TIMESTAMPNS (linux/asm-generic/socket.h): the kernel's time of arrival."""
_ATTACH_FILTER: Final = 26
"""SO_ATTACH_FILTER (linux/asm-generic/socket.h)."""
_LATEST_SECONDS: Final = 1.0
"""A time stamp that is older is taken for one of another clock."""
_EXTENDED_IDS: Final = 1 << 29
_CLASSIC, _FD = 8, 64


class ReceivedFrame(NamedTuple):
    """A frame, or a controller's own report (``error``: the identifier of an error frame)."""

    frame: Frame | None
    error: int = 0


_NOTHING: Final = ReceivedFrame(None)


class Multicast:
    """The bus behind an open ``can.interfaces.udp_multicast.UdpMulticastBus``; frames of FD only with ``fd``.

    Sending from one thread while another receives is allowed; two senders take turns themselves.
    """

    def __init__(self, receiving: socket.socket, group: str, port: int, *, hop_limit: int, fd: bool) -> None:
        self._in, self._fd = receiving, fd
        self._out = _sender(receiving.family, group, port, hop_limit)
        self._own = self._out.getsockname()[:2]
        self._poll = select.poll()
        self._poll.register(receiving, select.POLLIN)
        _drop_own(receiving, self._own)

    def send(self, datagram: bytes, seconds: float) -> None:
        """Put a frame, as :func:`written` gives it, on the bus; raises OSError (TimeoutError after ``seconds``)."""
        try:
            self._out.send(datagram)
        except BlockingIOError:
            if not select.select([], [self._out], [], seconds)[1]:
                raise TimeoutError("no room for another datagram") from None
            self._out.send(datagram)

    def receive(self, seconds: float) -> ReceivedFrame | None:
        """Return the next datagram of another sender, None if none came within ``seconds``; raises OSError."""
        try:
            return self._read()
        except BlockingIOError:
            if seconds <= 0 or not self._poll.poll(seconds * 1000):
                return None
        with contextlib.suppress(BlockingIOError):
            return self._read()
        return None

    def close(self) -> None:
        """Release the sender; the receiving socket is python-can's."""
        self._out.close()

    def _read(self) -> ReceivedFrame:
        datagram, ancillary, _, sender = self._in.recvmsg(_LARGEST, _ANCILLARY, socket.MSG_DONTWAIT)
        return _NOTHING if sender[:2] == self._own else read(datagram, arrival(ancillary), fd=self._fd)


def of_bus(bus: object, options: dict[str, Any], *, fd: bool) -> Multicast | None:
    """Return the fast path to an open bus of python-can; None if it is no ``udp_multicast``, or differs inside."""
    inside = getattr(bus, "_multicast", None)
    receiving, group, port = (getattr(inside, name, None) for name in ("_socket", "group", "port"))
    if not isinstance(receiving, socket.socket) or not isinstance(group, str) or not isinstance(port, int):
        return None
    return Multicast(receiving, group, port, hop_limit=int(options["hop_limit"]), fd=fd)


def written(frame: Frame) -> bytes:
    """Return the datagram of a frame, as python-can writes it."""
    datagram: bytes = msgpack.packb(
        {
            "timestamp": 0.0,
            "arbitration_id": frame.identifier,
            "is_extended_id": True,
            "is_remote_frame": False,
            "is_error_frame": False,
            "channel": None,
            "dlc": len(frame.data),
            "data": frame.data,
            "is_fd": frame.fd,
            "bitrate_switch": frame.fd,
            "error_state_indicator": False,
        }
    )
    return datagram


def read(datagram: bytes, at: float, *, fd: bool) -> ReceivedFrame:
    """Parse a datagram; it may come from any sender, and anything but a data frame of ours gives an empty result."""
    try:
        fields = msgpack.unpackb(datagram)
    except Exception:  # noqa: BLE001 - msgpack raises ValueError, its own, and what a key of a strange type raises
        return _NOTHING
    if type(fields) is not dict:
        return _NOTHING
    identifier, data, is_fd = fields.get("arbitration_id"), fields.get("data"), bool(fields.get("is_fd"))
    if type(identifier) is not int or not 0 <= identifier < _EXTENDED_IDS:
        return _NOTHING
    if fields.get("is_error_frame"):
        return ReceivedFrame(None, identifier)
    if type(data) is not bytes or is_fd > fd or not _is_data(fields, len(data), _FD if is_fd else _CLASSIC):
        return _NOTHING
    return ReceivedFrame(Frame(identifier, data, is_fd, at))


def _is_data(fields: dict[object, object], octets: int, most: int) -> bool:
    """Return True if it is a data frame of a 29-bit identifier whose length field matches its octets."""
    if not fields.get("is_extended_id", True) or fields.get("is_remote_frame"):
        return False
    return octets <= most and fields.get("dlc", octets) == octets


def arrival(ancillary: list[tuple[int, int, bytes]]) -> float:
    """Return the time of arrival on the monotonic clock, less the datagram's time in the kernel's queue.

    Never too early: the wall clock is read first. A thread that is preempted between the two readings makes the arrival
    late, which a bound of the node's time tolerates; the other way round it would precede the sending.
    """
    late_by = 0.0
    for level, kind, data in ancillary:
        if level == socket.SOL_SOCKET and kind == _TIMESTAMPNS and len(data) == _STAMP.size:
            seconds, nanoseconds = _STAMP.unpack(data)
            late_by = (time.time_ns() - seconds * 10**9 - nanoseconds) / 1e9
    return time.monotonic() - (late_by if 0.0 < late_by < _LATEST_SECONDS else 0.0)


def _sender(family: int, group: str, port: int, hop_limit: int) -> socket.socket:
    """Return a socket to the group alone, with a separate address; raises OSError."""
    sender = socket.socket(family, socket.SOCK_DGRAM)
    try:
        if family == socket.AF_INET6:
            sender.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_MULTICAST_HOPS, hop_limit)
        else:
            sender.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, hop_limit)
        sender.connect((group, port))
        sender.setblocking(False)
    except OSError:
        sender.close()
        raise
    return sender


def _drop_own(receiving: socket.socket, own: tuple[str, int]) -> None:
    """Have the kernel drop frames of our own sender; without the filter each one wakes us, to be dropped by its sender.

    In front of the filter is the UDP header, source port first; the source address is that of the IP header.
    """
    if receiving.family != socket.AF_INET or not sys.platform.startswith("linux"):
        return
    address = int.from_bytes(socket.inet_aton(own[0]), "big")
    network = (-0x100000) & 0xFFFFFFFF  # SKF_NET_OFF (linux/filter.h)
    program = b"".join(
        struct.pack("@HBBI", *line)
        for line in (
            (0x28, 0, 0, 0),  # load the half word at 0
            (0x15, 0, 3, own[1]),  # not our port: accept
            (0x20, 0, 0, network + 12),  # load the word at 12 of the IP header
            (0x15, 0, 1, address),  # not our address: accept
            (0x06, 0, 0, 0),  # drop
            (0x06, 0, 0, 0xFFFFFFFF),  # accept
        )
    )
    code = array.array("B", program)
    with contextlib.suppress(OSError):
        receiving.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, struct.pack("@HP", 6, code.buffer_info()[0]))
