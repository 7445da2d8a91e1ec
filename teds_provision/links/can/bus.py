"""Open, read and write a CAN bus through python-can; each failure is translated into an error with its remedy."""

from __future__ import annotations

import contextlib
import errno
import logging
import re
import select
import socket
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final, NoReturn

from teds_provision.errors import LinkError, NoReaderError, UsageError
from teds_provision.lazy import install_command
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.multicast import Multicast, of_bus, written
from teds_provision.links.can.pacing import Pacer
from teds_provision.links.can.spec import CanSpec
from teds_provision.links.ports import Trace

if TYPE_CHECKING:
    import can


# Our own frames, as interfaces return them that do not mark them: udp_multicast, SocketCAN.
#
# A received frame counts as an echo once for each time that it was sent, for three seconds.

_SECONDS: Final = 3.0
_KEPT: Final = 4096


class SentFrames:
    """Sent frames whose echo has not come back yet. Thread-safe."""

    def __init__(self) -> None:
        self._sent: OrderedDict[tuple[int, bytes], list[float]] = OrderedDict()
        self._lock = threading.Lock()

    def sent(self, frame: Frame) -> None:
        """Note a frame before it leaves."""
        key = (frame.identifier, frame.data)
        with self._lock:
            self._sent.setdefault(key, []).append(time.monotonic())
            self._sent.move_to_end(key)
            if len(self._sent) > _KEPT:  # some echoes were lost
                self._sent.popitem(last=False)

    def discard_echo(self, frame: Frame) -> bool:
        """Return True if this is the echo of a sent frame, and forget that frame."""
        key = (frame.identifier, frame.data)
        with self._lock:
            times = self._sent.get(key)
            if times is None:
                return False
            oldest = time.monotonic() - _SECONDS
            while times and times[0] < oldest:
                times.pop(0)
            known = bool(times)
            if known:
                times.pop(0)
            if not times:
                del self._sent[key]
            return known


_SEND_SECONDS: Final = 1.0
_QUEUE_PAUSE: Final = 0.0002
"""Seconds until a full queue is tried again: Linux holds 10 frames for a CAN interface, and raises ENOBUFS beyond."""
_OPENINGS: Final = 5
_SOCKETCAND_PORT: Final = 29536
_RECEIVE_BUFFER: Final = 4 << 20
_LATEST_SECONDS: Final = 1.0
"""A time stamp that is older is taken for one of another clock."""
_OURS: Final = ((0x18DA0000, 0x1FFE0000), (0x1CFF0000, 0x1FFF0000), (0x18FF0000, 0x1FFFFF00), (0x18EF0000, 0x1FFF0000))
"""Identifiers and masks of the profile: commands, functional requests; data and Announce; trigger; Drive."""
_BUS_OFF: Final = 0x40
"""Error class of a SocketCAN error frame (linux/can/error.h, CAN_ERR_BUSOFF)."""


_PACKAGES: Final = {
    "gs_usb": "python-can[gs-usb]",
    "canalystii": "python-can[canalystii]",
    "cantact": "python-can[cantact]",
    "neovi": "python-can[neovi]",
    "nixnet": "python-can[nixnet]",
    "seeedstudio": "python-can[seeedstudio]",
    "candle": "python-can[candle]",
    "canine": "python-can[canine]",
    "sontheim": "python-can[sontheim]",
    "zlgcan": "python-can[zlgcan]",
}
"""Packages that python-can itself needs for an interface (its pyproject.toml)."""
_LIBRARIES: Final = {
    "kvaser": "Kvaser's CANlib (linuxcan, from kvaser.com)",
    "pcan": "PEAK's PCAN-Basic (libpcanbasic.so, from peak-system.com), or the kernel's own driver: socketcan:can0",
    "ixxat": "HMS's VCI driver, of Windows; on Linux take the kernel's driver: socketcan:can0",
    "vector": "Vector's XL driver, of Windows",
    "usb2can": "8devices' library, of Windows; on Linux take the kernel's driver: socketcan:can0",
    "systec": "SYS TEC's library, of Windows; on Linux take the kernel's driver: socketcan:can0",
    "nican": "NI-CAN, of Windows",
    "iscan": "Thorsis' isCAN library",
    "etas": "ETAS BOA, of Windows",
}
"""Libraries that come from the maker of the adapter."""


__all__ = ["Bus", "Frame", "clock_is_ours", "open_bus"]


class Bus:
    """An open bus; every frame goes to ``trace``.

    Sending from one thread while another receives is allowed; two senders take turns themselves.
    """

    def __init__(self, spec: CanSpec, trace: Trace | None = None) -> None:
        self.spec = spec
        self._trace = trace
        self._bus = open_bus(spec, _OURS)
        self._multicast = _multicast(self._bus, spec)
        self._descriptor = _descriptor(self._bus)
        self._clock_is_ours = clock_is_ours(spec)
        self._pacer = Pacer(spec.bitrate, spec.data_bitrate, spec.wire) if spec.pace else None
        # SocketCAN marks all frames of this machine as sent here, also those of nodes in other processes.
        self._marks_own = spec.interface != "socketcan"
        gives_back = not self._marks_own and "receive_own_messages" in dict(spec.options)
        back = spec.interface == "udp_multicast" and self._multicast is None
        self._echoes = SentFrames() if back or gives_back else None

    @property
    def busy_seconds(self) -> float:
        """Wire time of all frames sent so far; 0 unless paced."""
        return self._pacer.busy_seconds if self._pacer else 0.0

    def send(self, frame: Frame) -> None:
        """Put one frame on the bus; raises LinkError."""
        multicast = self._multicast
        # encoded first, so that it can leave at once when the wire is free, as from a controller's queue
        datagram = written(frame) if multicast is not None else b""
        if self._pacer:
            self._pacer.wait(frame.identifier, frame.data, fd=frame.fd)
        if self._echoes:
            self._echoes.sent(frame)
        if self._trace is not None:  # recorded before it is sent, so that its answer follows it in the trace
            self._trace.frame("can", "out", frame.data, identifier=frame.identifier, fd=frame.fd)
        if multicast is None:
            self._send_message(frame)
            return
        try:
            multicast.send(datagram, _SEND_SECONDS)
        except OSError as error:
            self._failed("does not take a frame", error)

    def _send_message(self, frame: Frame) -> None:
        import can

        message = can.Message(
            arbitration_id=frame.identifier,
            is_extended_id=True,
            data=frame.data,
            is_fd=frame.fd,
            bitrate_switch=frame.fd,
        )
        until = time.monotonic() + _SEND_SECONDS
        while True:
            try:
                self._bus.send(message, timeout=_SEND_SECONDS)
                return
            except (can.CanError, OSError, ValueError) as error:
                if _number(error) != errno.ENOBUFS or time.monotonic() >= until:
                    self._failed("does not take a frame", error)
            time.sleep(_QUEUE_PAUSE)

    def receive(self, seconds: float) -> Frame | None:
        """Return the next data frame that another sent, None when there is none; raises LinkError (also bus-off).

        Waits at most ``seconds``; returns None earlier after any other frame.
        """
        frame = self._receive_message(seconds) if self._multicast is None else self._heard(self._multicast, seconds)
        if frame is not None and self._trace is not None:
            self._trace.frame("can", "in", frame.data, identifier=frame.identifier, fd=frame.fd, at=frame.at)
        return frame

    def _heard(self, multicast: Multicast, seconds: float) -> Frame | None:
        try:
            heard = multicast.receive(seconds)
        except OSError as error:
            self._failed("cannot be read", error)
        if heard is None:
            return None
        if heard.error & _BUS_OFF:
            self._bus_off()
        return heard.frame

    def _receive_message(self, seconds: float) -> Frame | None:
        message = self._next(seconds)
        if message is None:
            return None
        if message.is_error_frame:
            if message.arbitration_id & _BUS_OFF:
                self._bus_off()
            return None
        own = self._marks_own and not message.is_rx
        if message.is_remote_frame or not message.is_extended_id or own:
            return None
        frame = Frame(message.arbitration_id, bytes(message.data), message.is_fd, self._arrival(message.timestamp))
        return None if self._echoes and self._echoes.discard_echo(frame) else frame

    def _arrival(self, timestamp: float) -> float:
        """Return the arrival on the monotonic clock, less the age of the time stamp if this machine's clock made it."""
        age = time.time() - timestamp if self._clock_is_ours else 0.0
        return time.monotonic() - (age if 0.0 < age < _LATEST_SECONDS else 0.0)

    def _next(self, seconds: float) -> can.Message | None:
        import can

        try:
            message = self._bus.recv(timeout=max(0.0, seconds))
        except can.CanOperationError as error:
            if "unpack" in str(error):  # udp_multicast: a datagram that is not a CAN frame
                return None
            self._failed("cannot be read", error)
        except (can.CanError, OSError, ValueError) as error:
            self._failed("cannot be read", error)
        if message is None:
            self._check_alive()
        return message

    def wait(self, seconds: float, wake: socket.socket) -> None:
        """Sleep until there may be a frame to receive, ``wake`` can be read, or ``seconds`` are over.

        Not every interface can be waited for so: there this returns at once, and :meth:`receive` waits.
        """
        descriptor = self._descriptor
        if descriptor < 0:
            return
        with contextlib.suppress(OSError, ValueError):  # closed meanwhile: receive() reports it
            select.select([descriptor, wake.fileno()], [], [], seconds)

    @property
    def can_be_waited_for(self) -> bool:
        """True if :meth:`wait` sleeps."""
        return self._descriptor >= 0

    @property
    def stamps_arrivals(self) -> bool:
        """True if a frame's time of arrival is the kernel's, whenever it is read."""
        return self._clock_is_ours

    def drain(self, most: int = 10_000) -> None:
        """Throw away what has come in unread."""
        for _ in range(most):
            if self.receive(0.0) is None:
                return

    def close(self) -> None:
        """Release the adapter; never raises."""
        if self._pacer is not None:
            self._pacer.close()
        try:
            if self._multicast is not None:
                self._multicast.close()
            self._bus.shutdown()
        except Exception:  # python-can back ends raise whatever their driver raises
            logging.getLogger(__name__).debug("The CAN bus did not close cleanly.", exc_info=True)

    def _check_alive(self) -> None:
        import can

        try:
            if self._bus.state is can.BusState.ERROR:
                self._bus_off()
        except (can.CanError, OSError, NotImplementedError):
            return
        if self.spec.interface == "socketcand" and _hung_up(self._bus):
            raise LinkError(
                f"The socketcand server closed the bus {self.spec.text}.", hint="Start it again, then repeat."
            )

    def _bus_off(self) -> NoReturn:
        raise LinkError(
            f"The CAN controller of {self.spec.text} went bus-off: too many frame errors.",
            hint="Check wiring, termination (120 ohm at both ends) and the bit rate; then: "
            f"ip link set {self.spec.channel} type can restart.",
        )

    def _failed(self, what: str, error: Exception) -> NoReturn:
        self._check_alive()
        raise LinkError(
            f"The CAN bus {self.spec.text} {what}: {_reason(error)}.",
            hint="Check that the adapter is up and plugged in.",
        ) from error


def open_bus(spec: CanSpec, filters: Sequence[tuple[int, int]] = ()) -> can.BusABC:
    """Open a bus of python-can; ``filters`` are 29-bit identifiers and masks that SocketCAN lets through.

    Raises NoReaderError or UsageError with the cause and the remedy.
    """
    import can

    for name in ("can", "isotp"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    spec.require_known()
    options = _options(spec)
    try:
        bus = _opened(spec, options)
    except can.CanInterfaceNotImplementedError as error:
        known = f"python-can knows {', '.join(sorted(can.VALID_INTERFACES))}."
        raise NoReaderError(
            f"Cannot use CAN interface {spec.interface!r} here: {_reason(error)}.",
            hint=_driver(spec.interface) or known,
        ) from error
    except TypeError as error:  # python-can raises it for an unknown option of the interface
        raise _unknown_key(spec, error) from error
    except Exception as error:  # back ends raise what their driver, serial port or library raises
        raise _not_opened(spec, error) from error
    if spec.interface == "udp_multicast":
        _this_group_alone(bus)
        # Enlarge the kernel's buffer, 256 frames by default: 60 nodes answer one Identify with 300.
        found = getattr(getattr(bus, "_multicast", None), "_socket", None)
        if isinstance(found, socket.socket):
            with contextlib.suppress(OSError):
                found.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
    if spec.interface == "socketcan" and filters:
        bus.set_filters([{"can_id": value, "can_mask": mask, "extended": True} for value, mask in filters])
    return bus


def _multicast(bus: can.BusABC, spec: CanSpec) -> Multicast | None:
    """Return the fast path to a bus of ``udp_multicast``, None for every other one."""
    if spec.interface != "udp_multicast":
        return None
    try:
        return of_bus(bus, dict(spec.options), fd=spec.fd)
    except (OSError, ValueError) as error:
        bus.shutdown()
        raise _not_opened(spec, error) from error


def _options(spec: CanSpec) -> dict[str, Any]:
    """Return python-can's arguments for opening the bus; checks that a socketcand server is reachable."""
    options: dict[str, Any] = dict(spec.options)
    if spec.interface == "udp_multicast" or spec.fd:
        options["fd"] = spec.fd
    if spec.interface == "socketcand":
        if spec.fd:
            raise UsageError("socketcand carries classic CAN only.", hint="Remove fd=1.")
        options = {"host": "127.0.0.1", "port": _SOCKETCAND_PORT, "tcp_tune": True} | options
        _probe(spec, options)
    return options


def _not_opened(spec: CanSpec, error: Exception) -> NoReaderError:
    """Return the error for a bus that does not open: the reason and what to do."""
    number = _number(error) if spec.interface == "socketcan" else None
    if number == errno.EAFNOSUPPORT:
        return NoReaderError(
            "This kernel has no CAN support.",
            hint="Load it (sudo modprobe can_raw), or go over the network: socketcand:can0?host=….",
        )
    if number == errno.ENODEV:
        return NoReaderError(
            f"There is no CAN interface {spec.channel}.", hint="To list the interfaces: ip -brief link show type can."
        )
    return NoReaderError(f"The CAN bus {spec.text} does not open: {_reason(error)}.", hint=_cure(spec))


def _opened(spec: CanSpec, options: dict[str, Any]) -> can.BusABC:
    """Open; try once more if a frame of a busy bus came between python-can's question and socketcand's answer."""
    import can

    for _ in range(_OPENINGS - 1):
        try:
            return can.Bus(interface=spec.interface, channel=spec.channel, **options)
        except can.CanError as error:
            if spec.interface != "socketcand" or "< frame" not in str(error):
                raise
    return can.Bus(interface=spec.interface, channel=spec.channel, **options)


def _descriptor(bus: can.BusABC) -> int:
    try:
        return int(bus.fileno())
    except Exception:  # noqa: BLE001  (NotImplementedError, and whatever a back end without one raises)
        return -1


def clock_is_ours(spec: CanSpec) -> bool:
    """Return True if this machine's kernel stamps the frames, not an adapter or another machine.

    With a clock that is a little slow a frame would seem older than it is, and the bound of a node's time be false.
    """
    host = str(dict(spec.options).get("host", "127.0.0.1"))
    here = spec.interface == "socketcand" and host in ("127.0.0.1", "::1", "localhost")
    return here or spec.interface in ("socketcan", "udp_multicast")


def _this_group_alone(bus: can.BusABC) -> None:
    """Hear no other group on the same port: Linux delivers every group that any socket of the machine has joined."""
    multicast = getattr(bus, "_multicast", None)
    found = getattr(multicast, "_socket", None)
    if not isinstance(found, socket.socket) or not sys.platform.startswith("linux"):
        return
    level, option = (socket.IPPROTO_IPV6, 29) if found.family == socket.AF_INET6 else (socket.IPPROTO_IP, 49)
    found.setsockopt(level, option, 0)  # IPV6_MULTICAST_ALL, IP_MULTICAST_ALL (linux/in6.h, linux/in.h)


def _probe(spec: CanSpec, options: dict[str, Any]) -> None:
    """Check that a server listens: python-can itself would try for 10 s without a pause."""
    try:
        socket.create_connection((str(options["host"]), int(options["port"])), timeout=3).close()
    except (OSError, ValueError) as error:
        raise NoReaderError(
            f"No socketcand server answers at {options['host']}:{options['port']} ({_reason(error)}).", hint=_cure(spec)
        ) from error


def _cure(spec: CanSpec) -> str:
    if spec.interface == "socketcan":
        data = f" dbitrate {spec.data_bitrate} fd on" if spec.fd else ""
        return f"Bring it up: sudo ip link set {spec.channel} up type can bitrate {spec.bitrate}{data}."
    if spec.interface == "udp_multicast":
        return "This needs a multicast address and a route to it: sudo ip route add 239.0.0.0/8 dev lo."
    if spec.interface == "socketcand":
        return "Start socketcand there, or give its address: socketcand:can0?host=127.0.0.1&port=29536."
    driver = _driver(spec.interface)
    return f"Check the channel's name and that the adapter is plugged in. {driver or 'Is its driver installed?'}"


def _driver(interface: str) -> str:
    """Return how to install the driver of an interface, "" if it needs none or is unknown."""
    package, library = _PACKAGES.get(interface), _LIBRARIES.get(interface)
    return f"Install it: {install_command(package)}" if package else f"It needs {library}." if library else ""


def _unknown_key(spec: CanSpec, error: TypeError) -> UsageError:
    """Return the error for an unknown option after the ``?``."""
    found = re.search(r"unexpected keyword argument '(\w+)'", str(error))
    missing = re.search(r"missing \d+ required [^:]*: (.+)", str(error))
    if found is not None:
        why = f"takes no {found[1]}="
    else:
        why = f"also needs {missing[1]}" if missing is not None else f"does not take these options: {_reason(error)}"
    return UsageError(
        f"The CAN interface {spec.interface} {why}.",
        hint="teds-provision's own options are bitrate, data_bitrate, fd, node, source and pace; any other goes"
        " to the interface.",
    )


def _number(error: BaseException) -> int | None:
    """Return the errno of the innermost cause, None if it has none."""
    while error.__cause__ is not None:
        error = error.__cause__
    return error.errno if isinstance(error, OSError) else None


def _reason(error: BaseException) -> str:
    """Return the innermost cause in one line: python-can hides it behind its own."""
    while error.__cause__ is not None:
        error = error.__cause__
    if isinstance(error, NameError):  # a name that python-can would have loaded from the driver's library
        return "its driver library is not installed"
    text = str(error).strip().splitlines()
    return (text[0] if text else type(error).__name__).rstrip(".")


def _hung_up(bus: can.BusABC) -> bool:
    """Return True if the server has closed the connection; python-can reads that as silence."""
    connection = getattr(bus, "_SocketCanDaemonBus__socket", None)
    if not isinstance(connection, socket.socket):
        return False
    try:
        return connection.recv(1, socket.MSG_PEEK | socket.MSG_DONTWAIT) == b""
    except BlockingIOError:
        return False
    except OSError:
        return True
