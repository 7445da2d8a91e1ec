"""nfcpy's udp driver, repaired: NFC frames between two processes of one machine, for virtual transducers.

The wire format is nfcpy's (one datagram ``106A hex…`` or ``RFOFF``); nothing above the driver changes. Repairs:

Node side (:class:`NodeDevice`)
    * the socket stays bound between two listens, so that no SENS_REQ behind an RFOFF is lost;
    * it binds the given loopback address, not every interface;
    * a UID of 10 octets can be selected (the third cascade level is 97h);
    * a command before selection is ignored, so that a node does not answer for its predecessor;
    * an answer is not sent when a newer command already waits;
    * a SENS_REQ while activated ends the activation and is then served: the reader before was killed.

Both sides
    * a port that has a name in /etc/services can be used.

Reader side (:class:`ReaderDevice`)
    * answers that came after their time-out are dropped before the next command;
    * time-outs below 0.05 s are 0.1 s (the other side is a process on a busy machine);
    * an empty field costs 0.08 s instead of 1 s.
"""

from __future__ import annotations

import errno
import functools
import operator
import select
import socket
import time
from collections.abc import Callable
from typing import Any, Final

from teds_provision.errors import UsageError
from teds_provision.links.nfc.nfcpy import Frontend, UdpDevice, nfc

DEFAULT_PORT: Final = 54321
_LOOPBACK: Final = {"", "localhost", "127.0.0.1"}
_SENS_REQ: Final = (b"\x26", b"\x52")
_FLOOR, _SENSE_WAIT = 0.1, 0.08  # seconds
_PASSIVE, _SHORT = 0.002, 0.05  # seconds: the passive acknowledge of SECTOR SELECT is 1 ms, READ gets 5 ms
_Frame = tuple[str, bytearray, Any]


def address_of(path: str) -> tuple[str, int]:
    """Return host and port of ``udp[:host][:port]``; raises UsageError unless it is this machine's loopback."""
    parts = path.split(":")
    host, port = (*parts[1:], "", "")[:2]
    if parts[0] != "udp" or len(parts) > 3 or not (port == "" or (port.isdecimal() and 0 < int(port) < 65536)):
        raise UsageError(f"{path!r} is not a simulated reader.", hint="Write udp:localhost:PORT.")
    if host not in _LOOPBACK:
        raise UsageError(
            f"A simulated reader must be on this machine's loopback, not on {host}.",
            hint="Use udp:localhost:PORT; anyone who can reach the port could write to the node.",
        )
    return "127.0.0.1", int(port or DEFAULT_PORT)


def frontend(device: Any, path: str) -> Any:
    """Return an nfcpy frontend on an opened udp device."""
    device._vendor_name, device._device_name, device._chipset_name, device._path = "", "simulated reader", "", path
    clf = Frontend()
    clf.device = device
    return clf


def _at(device: Any, host: str, port: int) -> None:
    """Set host and port as nfcpy's constructor does.

    That turns a port with a name in /etc/services (10000: webmin) into it.
    """
    device.addr, device._path, device.socket = (host, port), f"{host}:{port}", None
    device._create_socket()


def _received(receive: Callable[..., _Frame], timeout: float | None, brty_list: tuple[str, ...]) -> _Frame:
    """Receive one frame; a datagram that is none (not hexadecimal, not ASCII, empty) is a transmission error."""
    try:
        frame = receive(timeout, *brty_list)
    except ValueError as error:
        raise nfc.clf.TransmissionError(str(error)) from None
    if not frame[1]:
        raise nfc.clf.TransmissionError("empty frame")
    return frame


class NodeDevice(UdpDevice):  # type: ignore[misc]
    """The tag's side of a simulated reader. ``air`` receives each frame, to imitate its time on air."""

    socket: Any

    def __init__(self, host: str, port: int) -> None:
        self.bound = False
        self.air: Callable[[bytes, bool], None] | None = None
        self._pushed_back: _Frame | None = None
        _at(self, host, port)

    def mute(self) -> None:
        """Leave the field; a bound socket is kept."""
        if self.socket is not None and not self.bound:
            super().mute()

    def close(self) -> None:
        """Close the socket."""
        if self.socket is not None:
            self.socket.close()
        self.socket, self.bound = None, False

    def wake(self) -> None:
        """End a wait for a command that another thread is in."""
        if self.bound:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as knock:
                knock.sendto(b"RFOFF", self.addr)

    def bind(self) -> bool:
        """Place the node on the reader; False while another node is on it."""
        self._create_socket()
        if not self.bound:
            try:
                self.socket.bind(self.addr)
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return False
                raise
            self.bound = True
        return True

    def _bind_socket(self, time_to_return: float) -> bool:
        return self.bind()

    def _recv_data(self, timeout: float | None, *brty_list: str) -> _Frame:
        if self._pushed_back is not None:
            frame, self._pushed_back = self._pushed_back, None
            return frame
        frame = _received(super()._recv_data, timeout, brty_list)
        if self.air is not None:
            self.air(bytes(frame[1]), False)
        return frame

    def _send_data(self, brty: str, data: bytes, addr: Any) -> None:
        if self.air is not None:
            self.air(bytes(data), True)
        super()._send_data(brty, data, addr)

    def _listen_tta(self, target: Any, time_to_return: float, init: Any = None) -> Any:
        levels = _cascade(bytes(target.sdd_res))
        level = 0
        while (wait := time_to_return - time.time()) > 0:
            try:
                brty, frame, addr = self._recv_data(wait, target.brty)
            except nfc.clf.TimeoutError:
                return None
            except nfc.clf.CommunicationError:
                level = 0
                continue
            data = bytes(frame)
            if data in _SENS_REQ:
                level = 0
                self._send_data(brty, target.sens_res, addr)
            elif level == len(levels):
                return _activated(target, brty, addr, data)
            elif data == bytes((0x93 + 2 * level, 0x20)):
                self._send_data(brty, levels[level], addr)
            elif data == bytes((0x93 + 2 * level, 0x70)) + levels[level]:
                level += 1
                sak = target.sel_res[0] & 0xFB if level == len(levels) else 0x04
                self._send_data(brty, bytes((sak,)), addr)
        return None

    def send_rsp_recv_cmd(self, target: Any, data: bytes | None, timeout: float | None = None) -> bytearray | None:
        """Send an answer unless a newer command waits, then return the next command."""
        if data is not None and not select.select([self.socket], [], [], 0)[0]:
            self._send_data(target.brty, data, target._addr)
        if timeout is None or timeout > 0:
            frame = self._recv_data(timeout, target.brty)
            if bytes(frame[1]) in _SENS_REQ:
                self._pushed_back = frame
                raise nfc.clf.BrokenLinkError("polled again")
            return frame[1]
        return None


def _cascade(uid: bytes) -> list[bytes]:
    """Return what a UID of 4, 7 or 10 octets answers to SDD_REQ at each cascade level, check octet included."""
    parts = {
        4: [uid],
        7: [b"\x88" + uid[:3], uid[3:]],
        10: [b"\x88" + uid[:3], b"\x88" + uid[3:6], uid[6:]],
    }[len(uid)]
    return [part + bytes((functools.reduce(operator.xor, part),)) for part in parts]


def _activated(target: Any, brty: str, addr: Any, data: bytes) -> Any:
    activated = nfc.clf.LocalTarget(
        brty, _addr=addr, sens_res=target.sens_res, sdd_res=target.sdd_res, sel_res=target.sel_res
    )
    if target.sel_res[0] & 0x20 and data[0] == 0xE0:
        activated.tt4_cmd = bytearray(data)
    else:
        activated.tt2_cmd = bytearray(data)
    return activated


class ReaderDevice(UdpDevice):  # type: ignore[misc]
    """The reader's side."""

    socket: Any
    _sensing = False

    def __init__(self, host: str, port: int) -> None:
        _at(self, host, port)

    def send_cmd_recv_rsp(self, target: Any, data: bytes, timeout: float | None) -> bytearray:
        """Send a command and return its answer; what came too late for an earlier one is dropped first."""
        while select.select([self.socket], [], [], 0)[0]:
            self.socket.recvfrom(2048)
        if timeout is not None and _PASSIVE < timeout < _SHORT:
            timeout = _FLOOR
        return super().send_cmd_recv_rsp(target, data, timeout)  # type: ignore[no-any-return]

    def sense_tta(self, target: Any) -> Any:
        """Look for a Type A target for 0.08 s."""
        self._sensing = True
        try:
            return super().sense_tta(target)
        finally:
            self._sensing = False

    def _recv_data(self, timeout: float | None, *brty_list: str) -> _Frame:
        if self._sensing and timeout is not None:
            timeout = min(timeout, _SENSE_WAIT)
        return _received(super()._recv_data, timeout, brty_list)
