"""A Type 2 tag as a state machine, in the layout of the NHS31xx family: 512 octets of SRAM behind 16 of header.

The data area begins with a lock control TLV ``01 03 E8 0E 46`` and a proprietary TLV ``FD 01 00``; the NDEF TLV stands
on RF page 6, and a length other than 0 written there completes a message (facts from NXP's public SDK headers; the
octets of the capability container are an inference). What lies behind the SRAM is not there.
"""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Final

MAX_NDEF = 499  # 512 - 8 (the two TLVs) - 4 (TLV type and length) - 1 (terminator)
SAK: Final = 0x00
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
