"""A mock: a PN533 on a fake libusb transport, below nfcpy's real pn533 driver. No USB reader can run in the tests.

What is real: nfcpy's driver, its chip commands and errors. What is not: libusb, the chip, the radio. The tag in the
field is the emulated one of the virtual transducer.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Callable
from typing import Any

import nfc.clf.device
import pytest

from tests.links.nfc.pn532_chip import framed

ACK = bytes.fromhex("0000ff00ff00")
IDS = (0x04E6, 0x5591)


class Chip:
    """The stick: whether it is plugged in, under which device number, and the tag on it."""

    def __init__(self) -> None:
        self.plugged = True
        self.number = 5
        self.refuse: int | None = None  # errno of every opening
        self.uid = b""
        self.sak = 0
        self.answer: Callable[[bytes], bytes | None] | None = None
        self.polled: Callable[[], None] = lambda: None
        self.commands = 0

    def install(self, monkeypatch: pytest.MonkeyPatch) -> None:
        class Usb(Transport):
            chip = self

        monkeypatch.setattr(nfc.clf.device.transport, "USB", Usb)
        access = os.access
        monkeypatch.setattr(
            nfc.clf.device.os, "access", lambda path, mode: str(path).startswith("/dev/bus/usb") or access(path, mode)
        )

    def run(self, command: int, data: bytes) -> bytes | None:
        """Return what the chip answers to one host command, after its status octet where it has one."""
        self.commands += 1
        if command == 0x00:
            return data
        if command == 0x02:
            return bytes.fromhex("33020707")
        if command == 0x06:
            registers = [data[at : at + 2] for at in range(0, len(data), 2)]
            if registers[0][0] >= 0xA0:
                return b"\x01"
            return b"\0" + bytes(0x26 if register == b"\x63\x39" else 0 for register in registers)
        if command == 0x4A:
            self.polled()
            if data[1] == 0 and self.answer is not None:
                return bytes((1, 1, 0, 0x04, self.sak, len(self.uid))) + self.uid
            return b"\0"
        if command == 0x42:
            answer = self.answer(data) if self.answer is not None else None
            if answer is None:
                return b"\x01"
            crc = self.sak == 0 and len(answer) > 1  # nfcpy checks a Type 2 tag's CRC_A itself
            return b"\0" + (bytes(nfc.clf.device.Device.add_crc_a(bytearray(answer))) if crc else answer)
        return b"" if command in (0x12, 0x32) else b"\0"


class Transport:
    """nfcpy's USB transport, as far as its pn533 driver uses it."""

    TYPE = "USB"
    manufacturer_name, product_name = "SCM Micro", "SCL3711-NFC&RW"
    chip: Chip

    @classmethod
    def find(cls, path: str) -> list[tuple[int, int, int, int]] | None:
        if not path.startswith("usb"):
            return None
        return [(*IDS, 1, cls.chip.number)] if cls.chip.plugged else []

    def __init__(self, bus: int, number: int) -> None:
        if self.chip.refuse is not None:
            raise OSError(self.chip.refuse, os.strerror(self.chip.refuse))
        self._check()
        self._answers: list[bytearray] = []

    def close(self) -> None:
        pass

    def _check(self) -> None:
        if not self.chip.plugged:
            raise OSError(errno.ENODEV, os.strerror(errno.ENODEV))

    def read(self, timeout: int = 0) -> bytearray:
        self._check()
        if not self._answers:
            time.sleep(min(timeout, 1000) / 1000)
            raise OSError(errno.ETIMEDOUT, os.strerror(errno.ETIMEDOUT))
        return self._answers.pop(0)

    def write(self, frame: Any, timeout: int = 0) -> None:
        self._check()
        if bytes(frame) == ACK:
            self._answers.clear()
            return
        data = bytes(frame[8:-2] if frame[3:5] == b"\xff\xff" else frame[5:-2])
        answer = self.chip.run(data[1], data[2:])
        self._answers.append(bytearray(ACK))
        if answer is not None:
            self._answers.append(bytearray(framed(bytes((0xD5, data[1] + 1)) + answer)))
