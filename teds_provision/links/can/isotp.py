"""ISO 15765-2 between one pair of addresses: can-isotp's state machine, driven by events instead of polling.

Normal fixed addressing with 29-bit identifiers: 0x18DA ‖ target ‖ source, functional 0x18DBFF ‖ source (ISO 15765-2,
normal fixed addressing). We request blocks of 16 frames without gaps, pad with 0xCC, and accept any block size, gap and
padding of the other side.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Final, Literal

# A CAN frame as the profile uses it.


@dataclass(frozen=True)
class Frame:
    """One CAN data frame with a 29-bit identifier; ``data`` 0 to 8 octets, in FD up to 64.

    ``at`` is the time of arrival, in seconds of ``time.monotonic()``, less the time in the kernel's queue; 0 for a
    frame that is sent.
    """

    identifier: int
    data: bytes
    fd: bool = False
    at: float = field(default=0.0, compare=False)


LONGEST: Final = 4095
"""Octets of the longest message: transaction ‖ a frame of the largest maxMessage."""
BLOCK_SIZE: Final = 16
PADDING: Final = 0xCC
FUNCTIONAL: Final = 0x18DBFF00
_PHYSICAL: Final = 0x18DA0000
_TIMEOUT_MS: Final = 1000
"""N_Bs and N_Cr of ISO 15765-2: the wait for a flow control or the next consecutive frame."""
_WHOLE_SECONDS: Final = 5.0
"""A message as a whole comes within so long (profile.md, "CAN"); we ask for no gap between its frames."""
_HARMLESS: Final = frozenset(
    {
        "UnexpectedFlowControlError",
        "UnexpectedConsecutiveFrameError",
        "ReceptionInterruptedWithSingleFrameError",
        "ReceptionInterruptedWithFirstFrameError",
        "MissingEscapeSequenceError",
        "ChangingInvalidRXDLError",
    }
)
"""Errors of can-isotp that end nothing: left over from a transfer that one side gave up, or a frame to ignore."""
_SINGLE, _FIRST, _CONSECUTIVE, _FLOW = range(4)


def physical_id(target: int, source: int) -> int:
    """Return the identifier of a frame from ``source`` to ``target``."""
    return _PHYSICAL | target << 8 | source


def addresses(identifier: int) -> tuple[int, int] | None:
    """Target and source of a physical identifier, None for any other."""
    if identifier & 0x1FFF0000 != _PHYSICAL:
        return None
    return identifier >> 8 & 0xFF, identifier & 0xFF


def padded(data: bytes, *, fd: bool) -> bytes:
    """Fill up to 8 octets, or to the next length that FD knows."""
    if len(data) <= 8 or not fd:
        return data.ljust(8, bytes([PADDING]))
    return data.ljust(next(size for size in (12, 16, 20, 24, 32, 48, 64) if size >= len(data)), bytes([PADDING]))


def read_single(data: bytes) -> bytes | None:
    """Return the content of a single frame (ISO 15765-2, SF_DL), None for any other frame.

    The length is in the first octet of a frame of up to 8 octets, and behind an escape in a longer one.
    """
    if len(data) < 2 or data[0] >> 4 != _SINGLE:
        return None
    escaped = len(data) > 8
    start, length = (2, data[1]) if escaped else (1, data[0])
    if (escaped and (data[0] or length < 8)) or not length or start + length > len(data):
        return None
    return data[start : start + length]


def single(body: bytes, *, fd: bool = False) -> bytes:
    """Return a padded single frame; ``body`` at most 7 octets, in FD 62."""
    return padded((bytes([len(body)]) if len(body) <= 7 else bytes([0, len(body)])) + body, fd=fd)


class Pair:
    """Our end of one pair of addresses. Not thread-safe; ``send_frame`` is called from within every method.

    Messages of one frame are read and written here while nothing else is under way: can-isotp's states have nothing
    to add to it, and take ten times as long over it.
    """

    def __init__(
        self,
        own: int,
        peer: int,
        send_frame: Callable[[Frame], None],
        *,
        fd: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        import isotp

        self.own, self.peer = own, peer
        self._clock, self._whole_by = clock, 0.0
        self._receive_id, self._send_id = physical_id(own, peer), physical_id(peer, own)
        self._send_frame = send_frame
        self._waiting: deque[Any] = deque()
        self._singles: deque[bytes] = deque()
        self._message = isotp.CanMessage
        self._wait_fc = isotp.TransportLayerLogic.TxState.WAIT_FC
        self.error = ""
        self.overflow = False
        self._last = b""
        address = isotp.Address(isotp.AddressingMode.NormalFixed_29bits, source_address=own, target_address=peer)
        self._logic = isotp.TransportLayerLogic(
            self._next, self._put, address, error_handler=self._note_error, params=_parameters(fd)
        )

    def send(self, body: bytes) -> None:
        """Start to send; a message in progress is sent first."""
        fd = bool(self._logic.params.can_fd)
        if 0 < len(body) <= (62 if fd else 7) and not self.sending:
            self._send_frame(Frame(self._send_id, single(body, fd=fd), fd))
            return
        self._logic.send(body)
        self.run()

    def handle_frame(self, frame: Frame) -> bool:
        """Process a received frame; return True if it is for this pair. Answers are classic or FD as the request."""
        if frame.identifier != self._receive_id:
            return False
        if (data := _tolerable(frame.data)) is None:
            return True
        kind = data[0] >> 4
        if kind == _CONSECUTIVE and data == self._last:
            return True  # the same frame twice: CAN repeats a frame after an error in its last bit
        if kind == _CONSECUTIVE and self.receiving and not self._has_its_length(data):
            return True
        self._last = data if kind == _CONSECUTIVE else b""
        if kind == _SINGLE and self.waits_for_flow:
            self.stop_sending()  # a refusal instead of flow control, or a new request; can-isotp would go on waiting
        if kind != _FLOW:
            self.speak(fd=frame.fd)
        if kind == _SINGLE and self._take_single(data):
            return True
        if kind == _FIRST:
            self._whole_by = self._clock() + _WHOLE_SECONDS
        self._waiting.append(
            self._message(arbitration_id=frame.identifier, data=data, extended_id=True, is_fd=frame.fd)
        )
        self.run()
        return True

    def _has_its_length(self, consecutive: bytes) -> bool:
        """Return True if it is as long as its first frame, or the last and shorter; ISO 15765-2 ignores all others.

        can-isotp takes any classic one.
        """
        octets, first = len(consecutive), self._logic.actual_rxdl or 0
        left = self._logic.rx_frame_length - len(self._logic.rx_buffer)
        return octets == first or (octets < first and octets - 1 >= left)

    def _take_single(self, data: bytes) -> bool:
        """Receive a message of one frame without the state machine; False if that has to see it."""
        body = read_single(data) if not self._is_busy else None
        if body is None:
            return False
        self._singles.append(body)
        return True

    def speak(self, *, fd: bool) -> None:
        """Send in FD, or in classic frames, from now on."""
        params = self._logic.params
        if params.can_fd != fd and not self.sending:
            params.can_fd = params.bitrate_switch = fd
            params.tx_data_length = 64 if fd else 8

    def run(self) -> None:
        """Do what is due: send the next consecutive frame, give up on what never came."""
        if self.receiving and self._clock() >= self._whole_by:
            self._logic.stop_receiving()
        self._logic.process()
        while self._waiting:
            self._logic.process()

    def received(self) -> bytes | None:
        """Return the next whole message, None while there is none."""
        if self._singles:
            return self._singles.popleft()
        body = self._logic.recv()
        return None if body is None else bytes(body)

    @property
    def sending(self) -> bool:
        """True if a message of ours is still under way."""
        return bool(self._logic.transmitting())

    @property
    def receiving(self) -> bool:
        """True if a message of theirs has begun and not ended."""
        return bool(self._logic.is_rx_active())

    @property
    def _is_busy(self) -> bool:
        """True if can-isotp has anything to do, or a message that has not been fetched yet."""
        return bool(self._waiting) or self.sending or self.receiving or self._logic.available()

    @property
    def waits_for_flow(self) -> bool:
        """True if our first frame, or block, has not been answered yet."""
        return bool(self._logic.tx_state == self._wait_fc)

    def due_in(self, most: float) -> float:
        """Return the seconds until :meth:`run` has something to do, at most ``most``."""
        delay = self._logic.next_cf_delay()
        return most if delay is None else max(0.0, min(most, delay))

    def abandon(self) -> None:
        """Forget what is being sent and received, and past errors."""
        self._waiting.clear()
        self._singles.clear()
        self._logic.reset()
        self.error, self.overflow = "", False

    def stop_sending(self) -> None:
        """Forget what is being sent."""
        self._logic.clear_tx_queue()
        self._logic.stop_sending()

    def _next(self, _seconds: float) -> Any:
        return self._waiting.popleft() if self._waiting else None

    def _put(self, message: Any) -> None:
        self._send_frame(Frame(message.arbitration_id, bytes(message.data), bool(message.is_fd)))

    def _note_error(self, error: Exception) -> None:
        if type(error).__name__ in _HARMLESS:
            return
        self.error = str(error)
        self.overflow = type(error).__name__ == "OverflowError"


def _parameters(fd: bool) -> dict[str, Any]:
    return {
        "stmin": 0,
        "blocksize": BLOCK_SIZE,
        "tx_padding": PADDING,
        "tx_data_min_length": 8,
        "max_frame_size": LONGEST,
        "tx_data_length": 64 if fd else 8,
        "can_fd": fd,
        "bitrate_switch": fd,
        "rx_flowcontrol_timeout": _TIMEOUT_MS,
        "rx_consecutive_frame_timeout": _TIMEOUT_MS,
        "wftmax": 255,
        "wait_func": _not_waited_for,  # the default sleeps once when the library validates it, for each new pair
    }


def _not_waited_for(_seconds: float) -> None:
    """Return at once: only the library's own thread waits, and there is none."""


def _tolerable(data: bytes) -> bytes | None:
    """Drop frames that ISO 15765-2 ignores and can-isotp would treat as the end of a transfer.

    Unknown frame types, single frames with an impossible length, first frames of a message that fits one frame, or of
    4095 octets or fewer by 32 bits, and unknown flow states are ignored; a reserved STmin counts as 127 ms.
    """
    if len(data) < 2:
        return None
    kind = data[0] >> 4
    if kind == _SINGLE:
        return data if read_single(data) is not None else None
    if kind == _FIRST:
        return data if len(data) >= 8 and _announced(data)[0] >= _least_length(data) else None
    if kind == _CONSECUTIVE:
        return data
    return _tolerable_flow(data) if kind == _FLOW else None


def _announced(first: bytes) -> tuple[int, int]:
    """Return the octets that a first frame announces, and where they begin; 0 if 32 bits hold what fits 12 bits."""
    if length := (first[0] & 0xF) << 8 | first[1]:
        return length, 2
    length = int.from_bytes(first[2:6], "big")
    return (length if length > LONGEST else 0), 6


def _least_length(first: bytes) -> int:
    """Return FF_DLmin of ISO 15765-2: the shortest message that begins with a first frame of this length."""
    return max(8, len(first) - 1)


def _tolerable_flow(data: bytes) -> bytes | None:
    if len(data) < 3 or data[0] & 0xF > 2:
        return None
    reserved = 0x80 <= data[2] <= 0xF0 or data[2] >= 0xFA
    return data[:2] + (b"\x7f" if reserved else data[2:3]) + data[3:]


# Segmentation and reassembly of one ISO-TP message: octets to frames and back (ISO 15765-2, section 9).
#
# The station uses this for many nodes at once. A node uses can-isotp, above, so that each exchange is one between two
# independent implementations. Pure: no bus, no clock.

CONTINUE, WAIT, OVERFLOW = 0x30, 0x31, 0x32
"""First octet of a flow control frame."""
_LONGEST_GAP: Final = 0.127

Taken = Literal["more", "block", "whole", "again", "torn"]


@dataclass
class Reassembly:
    """A message of ``peer`` that is being received: ``length`` octets in all, ``fd`` the form of its frames.

    ``asked`` counts the frames since the last flow control.
    """

    peer: int
    length: int
    octets: bytearray
    first: bytes
    fd: bool
    number: int = 0
    asked: int = 0
    last: bytes = b""

    @classmethod
    def begin(cls, peer: int, frame: Frame) -> Reassembly | None:
        """Start with a first frame; None if it is none, or announces a length that needs none."""
        data = frame.data
        if len(data) < 8 or data[0] >> 4 != 1:
            return None
        length, start = _announced(data)
        if length < _least_length(data):
            return None
        return cls(peer, length, bytearray(data[start : start + length]), data, frame.fd)

    @property
    def too_long(self) -> bool:
        """True if no message of the profile has that length."""
        return self.length > LONGEST

    def add_frame(self, data: bytes) -> Taken:
        """Process a consecutive frame.

        Returns ``block`` if flow control is due, ``again`` for a repeated frame, ``torn`` for one out of sequence.
        """
        if data[0] & 0xF != self.number + 1 & 0xF:
            return "again" if data == self.last else "torn"
        self.number += 1
        self.asked += 1
        self.last = data
        self.octets += data[1 : 1 + self.length - len(self.octets)]
        if len(self.octets) == self.length:
            return "whole"
        if self.asked == BLOCK_SIZE:
            self.asked = 0
            return "block"
        return "more"


def flow(peer: int, own: int, status: int, *, fd: bool, gap: int = 0) -> Frame:
    """Return a flow control frame to ``peer``: 16 frames a block, ``gap`` ms (0 to 127) between them.

    profile.md, "CAN". Without a gap a reply takes the whole bus, as it has priority over all data; a gap leaves room
    for data frames.
    """
    return Frame(physical_id(peer, own), padded(bytes([status, BLOCK_SIZE, gap]), fd=fd), fd)


def first_frame(body: bytes, *, fd: bool) -> tuple[bytes, bytes]:
    """Return the first frame of a message that no single frame holds, and the octets that are left."""
    room = 62 if fd else 6
    return (0x1000 | len(body)).to_bytes(2, "big") + body[:room], body[room:]


def consecutive_frames(rest: bytes, *, fd: bool) -> Iterator[bytes]:
    """Yield the frames after the first one, padded."""
    room = 63 if fd else 7
    for number, at in enumerate(range(0, len(rest), room), 1):
        yield padded(bytes([0x20 | number & 0xF]) + rest[at : at + room], fd=fd)


def gap_seconds(octet: int) -> float:
    """Return STmin of a flow control in seconds; a reserved value counts as 127 ms (ISO 15765-2, table of STmin)."""
    if octet <= 0x7F:
        return octet / 1000
    if 0xF1 <= octet <= 0xF9:
        return (octet - 0xF0) / 10_000
    return _LONGEST_GAP
