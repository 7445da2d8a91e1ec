"""Tags as state machines. Type 4: the NDEF application (NFC Forum T4T 2.0) over ISO-DEP (ISO/IEC 14443-4).

One NDEF file, readable and writeable by anyone. Octets in, octets out; the frames come from elsewhere.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable
from typing import Final

MLE, MLC = 251, 248  # so that each APDU is one frame of 256 octets
ATS: Final = bytes.fromhex("0578 80 B0 00")  # FSCI 8 (256 octets), TA1 106 kbit/s, FWI 11 (0.62 s), no CID, no NAD
SAK: Final = 0x20
_NDEF_APPLICATION = bytes.fromhex("D2760000850101")
_CC_FILE, _NDEF_FILE = b"\xe1\x03", b"\xe1\x04"
_FSD = (16, 24, 32, 40, 48, 64, 96, 128, 256)
_SELECT, _READ_BINARY, _UPDATE_BINARY = 0xA4, 0xB0, 0xD6
_LONGEST_APDU = 261  # a longer chain is cut, and is then refused
_WTX: Final = b"\xf2\x01"  # S(WTX), one more frame waiting time
_OK, _WRONG_LENGTH, _NO_FILE, _NOT_ALLOWED = b"\x90\x00", b"\x67\x00", b"\x6a\x82", b"\x69\x86"
_WRONG_OFFSET, _NO_SPACE, _NO_COMMAND = b"\x6b\x00", b"\x6a\x84", b"\x6d\x00"


class Type4Memory:
    """The NDEF file: NLEN (u16) and the message, at most ``max_ndef`` octets. Thread-safe.

    ``written`` is called with each message that a reader completed, from the thread that serves the frames.
    """

    def __init__(self, max_ndef: int) -> None:
        self.max_ndef = max_ndef
        self.written: Callable[[bytes], None] = lambda octets: None
        self._lock = threading.Lock()
        self._file = bytearray(2 + max_ndef)

    def put(self, octets: bytes) -> None:
        """Replace the message (the node's side)."""
        with self._lock:
            self._file[: 2 + len(octets)] = len(octets).to_bytes(2, "big") + octets

    def read(self, file: bytes, offset: int, size: int) -> bytes | None:
        """Return up to ``size`` octets of the capability or NDEF file, None beyond its end."""
        with self._lock:
            octets = self._capability() if file == _CC_FILE else self._file
            return bytes(octets[offset : offset + size]) if offset <= len(octets) else None

    def write(self, offset: int, octets: bytes) -> bool:
        """Write into the NDEF file; a length other than 0 at its begin completes a message. False beyond its end."""
        with self._lock:
            if offset + len(octets) > len(self._file):
                return False
            self._file[offset : offset + len(octets)] = octets
            size = int.from_bytes(self._file[:2], "big") if offset == 0 and len(octets) > 1 else 0
            message = bytes(self._file[2 : 2 + size])
        if message:
            self.written(message)
        return True

    def _capability(self) -> bytes:
        return struct.pack(">HBHHBB2sHBB", 15, 0x20, MLE, MLC, 4, 6, _NDEF_FILE, len(self._file), 0, 0)


class NdefApplication:
    """The APDUs of the NDEF application: SELECT, READ BINARY, UPDATE BINARY."""

    def __init__(self, memory: Type4Memory, ready: Callable[[float], bool]) -> None:
        self._memory = memory
        self._ready = ready
        self._open = False
        self._file = b""

    def run(self, apdu: bytes, seconds: float) -> bytes | None:
        """Return the answer to one APDU, None when it is not ready after ``seconds``: ask again.

        Only the selection of the application may take time: until the initial message is as new as the node.
        """
        if len(apdu) < 4:
            return _WRONG_LENGTH
        if apdu[1] == _SELECT and apdu[2] == 4:
            return self._select_application(_data(apdu), seconds)
        return self._in_application(apdu) if self._open else _NOT_ALLOWED

    def _in_application(self, apdu: bytes) -> bytes:
        """Answer the commands on files after the NDEF application was selected."""
        instruction = apdu[1]
        if instruction == _SELECT:
            name = _data(apdu)
            self._file = name if name in (_CC_FILE, _NDEF_FILE) else b""
            return _OK if self._file else _NO_FILE
        if instruction == _READ_BINARY and self._file:
            octets = self._memory.read(self._file, _offset(apdu), (apdu[4] or 256) if len(apdu) == 5 else 256)
            return _WRONG_OFFSET if octets is None else octets + _OK
        if instruction == _UPDATE_BINARY and self._file == _NDEF_FILE:
            return _OK if self._memory.write(_offset(apdu), _data(apdu)) else _NO_SPACE
        return _NO_COMMAND

    def _select_application(self, name: bytes, seconds: float) -> bytes | None:
        if name != _NDEF_APPLICATION:
            return _NO_FILE
        if not self._ready(seconds):
            return None
        self._open, self._file = True, b""
        return _OK


def _offset(apdu: bytes) -> int:
    return apdu[2] << 8 | apdu[3]


def _data(apdu: bytes) -> bytes:
    return apdu[5 : 5 + apdu[4]] if len(apdu) > 5 else b""


class IsoDepTag:
    """ISO-DEP, the card's side (ISO/IEC 14443-4 clause 7): blocks in, blocks out, chaining both ways, S(WTX).

    ``rats`` is the request that activated it; ``patience`` seconds are given to an APDU before more time is asked for.
    """

    def __init__(self, rats: bytes, application: NdefApplication, *, patience: float = 0.25) -> None:
        self._information = _FSD[min(rats[1] >> 4 if len(rats) > 1 else 0, 8)] - 3
        self._application = application
        self._patience = patience
        self._number = 1
        self._received = b""
        self._pending: bytes | None = None
        self._parts: list[bytes] = []
        self._last = b""
        self.deselected = False

    def answer(self, block: bytes) -> bytes | None:
        """Return the block that answers ``block``, None for silence."""
        # blocks with CID or NAD, which our ATS does not offer, are for another card (ISO/IEC 14443-4, 7.1)
        pcb = block[0]
        if pcb & 0xEE == 0x02:
            return self._information_block(pcb, block[1:])
        if pcb & 0xFE == 0xB2:  # R(NAK): the last block again, or none was received
            return self._last if pcb & 1 == self._number and self._last else bytes((0xA2 | self._number,))
        if pcb & 0xFE == 0xA2:  # R(ACK): the next part of a chain
            return self._acknowledged(pcb & 1)
        if pcb == 0xF2 and self._pending is not None:
            return self._run(self._pending)
        if pcb == 0xC2:
            self.deselected = True
            return bytes((pcb,))
        return None

    def _acknowledged(self, number: int) -> bytes | None:
        if number == self._number:
            return self._last or None
        if not self._parts:
            return None
        self._number ^= 1
        return self._part()

    def _information_block(self, pcb: int, octets: bytes) -> bytes:
        self._number ^= 1
        self._parts = []  # a reader that starts again drops the answer before
        self._received = (self._received + octets)[:_LONGEST_APDU]
        if pcb & 0x10:
            return self._remember(bytes((0xA2 | self._number,)))
        apdu, self._received = self._received, b""
        return self._run(apdu)

    def _run(self, apdu: bytes) -> bytes:
        answer = self._application.run(apdu, self._patience)
        if answer is None:
            self._pending = apdu
            return self._remember(_WTX)
        self._pending = None
        self._parts = [answer[at : at + self._information] for at in range(0, len(answer), self._information)]
        return self._part()

    def _part(self) -> bytes:
        part = self._parts.pop(0)
        return self._remember(bytes((0x02 | (0x10 if self._parts else 0) | self._number,)) + part)

    def _remember(self, block: bytes) -> bytes:
        self._last = block
        return block


# A Type 2 tag as a state machine, in the layout of the NHS31xx family: 512 octets of SRAM after 16 of header.
#
# The data area begins with a lock control TLV ``01 03 E8 0E 46`` and a proprietary TLV ``FD 01 00``; the NDEF TLV is on
# RF page 6, and writing a length other than 0 there completes a message (facts from NXP's public SDK headers; the
# octets of the capability container are an inference). There is no memory after the SRAM.

MAX_NDEF = 499  # 512 - 8 (the two TLVs) - 4 (TLV type and length) - 1 (terminator)
TYPE_2_SAK: Final = 0x00
_HEADER, _END = 16, 16 + 512
_TLV = 24  # octet address of RF page 6
_ACK, _NAK = b"\x0a", b"\x00"


class Type2Memory:
    """The tag's memory and its three commands: READ, WRITE, and the refusal of all others. Thread-safe.

    ``uid`` has 7 octets. ``written`` is called with each message that a reader completed.
    """

    def __init__(self, uid: bytes, max_ndef: int = MAX_NDEF) -> None:
        self.max_ndef = min(max_ndef, MAX_NDEF)
        self.written: Callable[[bytes], None] = lambda octets: None
        self._lock = threading.Lock()
        header = uid[:3] + bytes((0x88 ^ uid[0] ^ uid[1] ^ uid[2],)) + uid[3:7]
        header += bytes((uid[3] ^ uid[4] ^ uid[5] ^ uid[6], 0, 0, 0)) + bytes.fromhex("E1106F00")
        self._memory = bytearray(header + bytes.fromhex("0103E80E46FD0100") + bytes(_END - _TLV + 16))
        self.put(b"")

    def put(self, octets: bytes) -> None:
        """Replace the message (the node's side)."""
        size = bytes((len(octets),)) if len(octets) < 255 else b"\xff" + len(octets).to_bytes(2, "big")
        tlv = (b"\x03" + size + octets + b"\xfe")[: _END - _TLV]
        with self._lock:
            self._memory[_TLV : _TLV + len(tlv)] = tlv

    def answer(self, command: bytes) -> bytes | None:
        """Return the answer to one command frame."""
        address = command[1] * 4 if len(command) > 1 else _END
        if command[:1] == b"\x30" and len(command) == 2 and address < _END:
            with self._lock:
                return bytes(self._memory[address : address + 16])
        if command[:1] == b"\xa2" and len(command) == 6 and _HEADER <= address < _END:
            self._write(address, command[2:])
            return _ACK
        return _NAK

    def _write(self, address: int, octets: bytes) -> None:
        message = b""
        with self._lock:
            self._memory[address : address + 4] = octets
            if address == _TLV and octets[0] == 0x03:
                size, begin = octets[1], _TLV + 2
                if size == 255:
                    size, begin = int.from_bytes(octets[2:4], "big"), _TLV + 4
                message = bytes(self._memory[begin : min(begin + size, _END)])
        if message:
            self.written(message)
