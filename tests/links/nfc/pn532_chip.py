"""A model of a PN532 on a serial line (a pty), below nfcpy's real pn532 driver; a virtual node's tag lies on it.

``python -m tests.links.nfc.pn532_chip NAME udp:localhost:PORT`` makes the link /dev/NAME (nfcpy looks there alone), and
relays InCommunicateThru to the node over nfcpy's udp frames. Prints ``ready``; ends on SIGTERM, and prints then how
many host commands came. With ``--pace`` the line and the chip take their time, and it prints what was counted as JSON:
commands, octets on the line, the seconds that those take, seconds in the air at least. A SIGUSR1 swallows the next
answer, as a serial line does that loses a character.

What is real: nfcpy's driver and transport, the tty, the frames. What is not: the chip, the radio.
"""

from __future__ import annotations

import collections
import contextlib
import json
import os
import pty
import select
import signal
import sys
import time
import tty
from pathlib import Path
from typing import Any

from teds_provision.links.nfc.nfcpy import nfc
from teds_provision.links.nfc.udp import ReaderDevice, address_of

ACK = bytes.fromhex("0000ff00ff00")
_TX_MODE, _RX_MODE, _FIFO = 0x6302, 0x6303, 0x6339
_SENS_REQ = 0x26
_BAUD = (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600, 1288000)
_COMMAND_SECONDS = 0.001
"""An assumption: how long the chip thinks about a command."""
_OCTET_IN_THE_AIR = 9 * 128 / 13.56e6


class Chip:
    """The commands of a PN532 (user manual, section 7) that nfcpy's driver sends to a poller."""

    def __init__(self, path: str) -> None:
        self.commands: collections.Counter[int] = collections.Counter()
        self.baud = 115_200
        self.air = 0.0
        self._registers: dict[int, int] = {_FIFO: _SENS_REQ}
        self._path = path
        self._device: Any = None
        self._target: Any = None
        self._timeout = 0.1

    def run(self, command: int, data: bytes) -> bytes | None:
        """Return the answer's data, None for an error frame."""
        self.commands[command] += 1
        match command:
            case 0x00:
                return data if data[:1] == b"\0" else b"\0"
            case 0x02:
                return bytes.fromhex("32010607")
            case 0x06:
                return bytes(self._registers.get(register, 0) for register in _words(data, 2))
            case 0x08:
                self._registers |= {
                    int.from_bytes(data[at : at + 2], "big"): data[at + 2] for at in range(0, len(data), 3)
                }
                return b""
            case 0x32:
                self._configure(data)
                return b""
            case 0x4A:
                return self._list_target(data)
            case 0x42:
                return self._exchange(data)
            case 0x16:
                self._field(on=False)
                return b"\0"
            case 0x10 | 0x12 | 0x14:
                return b""
        return None

    def _configure(self, data: bytes) -> None:
        if data[0] == 1:
            self._field(on=bool(data[1] & 1))
        if data[0] == 2:
            self._timeout = 1e-4 * 2 ** (data[3] - 1) if data[3] else 1.0

    def _field(self, *, on: bool) -> None:
        if not on and self._device is not None:
            self._device.close()
            self._device = self._target = None
        if on and self._device is None:
            self._device = ReaderDevice(*address_of(self._path))

    def _list_target(self, data: bytes) -> bytes:
        self._target = None
        if data[1] != 0:
            return b"\0"
        self._field(on=True)
        self._device.mute()
        self._target = self._device.sense_tta(nfc.clf.RemoteTarget("106A"))
        if self._target is None:
            return b"\0"
        self._registers |= {_TX_MODE: 0x80, _RX_MODE: 0x80}
        uid = bytes(self._target.sdd_res)
        return (
            bytes((1, 1)) + bytes(self._target.sens_res)[::-1] + bytes(self._target.sel_res) + bytes((len(uid),)) + uid
        )

    def _exchange(self, data: bytes) -> bytes:
        if self._target is None:
            return b"\x01"
        try:
            answer = bytes(self._device.send_cmd_recv_rsp(self._target, data, self._timeout))
        except nfc.clf.TimeoutError:
            return b"\x01"
        except nfc.clf.CommunicationError:
            return b"\x02"
        self.air += (len(data) + len(answer)) * _OCTET_IN_THE_AIR
        if not self._registers[_RX_MODE] & 0x80 and len(answer) > 1:  # the host checks the CRC itself
            answer = bytes(nfc.clf.device.Device.add_crc_a(bytearray(answer)))
        return b"\0" + answer


class Line:
    """The serial line: host frames in, acknowledge and answer out."""

    def __init__(self, name: str, chip: Chip, *, pace: bool = False) -> None:
        self.chip, self._pace = chip, pace
        self.octets, self.seconds = 0, 0.0
        self.stop = self.swallow = False
        self._master, slave = pty.openpty()
        tty.setraw(slave)
        self._link = Path("/dev") / name
        self._link.unlink(missing_ok=True)
        self._link.symlink_to(os.ttyname(slave))
        self._held = b""

    def serve(self) -> None:
        while not self.stop:
            if select.select([self._master], [], [], 0.1)[0]:
                came = os.read(self._master, 4096)
                self._take_time(len(came))
                self._held += came
                while self._frame():
                    pass
        self._link.unlink(missing_ok=True)

    def _frame(self) -> bool:
        at = self._held.find(b"\0\xff")
        if at < 0:
            return False
        rest = self._held[at + 2 :]
        if rest[:2] == b"\0\xff":  # the host's acknowledge
            self._held = rest[3:]
            return True
        long = rest[:2] == b"\xff\xff"
        begin = 5 if long else 2
        if len(rest) < begin:
            return False
        size = int.from_bytes(rest[2:4], "big") if long else rest[0]
        if len(rest) < begin + size + 1:
            return False
        self._held = rest[begin + size + 1 :]
        self._answer(rest[begin : begin + size])
        return True

    def _answer(self, body: bytes) -> None:
        self._write(ACK)
        self._take_time(0, _COMMAND_SECONDS)
        answer = self.chip.run(body[1], body[2:])
        if self.swallow and body[1] == 0x42:
            self.swallow = False
            return
        self._write(framed(b"\x7f" if answer is None else bytes((0xD5, body[1] + 1)) + answer))
        if body[1] == 0x10 and body[2] < len(_BAUD):  # SetSerialBaudRate counts from the next command on
            self.chip.baud = _BAUD[body[2]]

    def _write(self, octets: bytes) -> None:
        self._take_time(len(octets))
        os.write(self._master, octets)

    def _take_time(self, octets: int, more: float = 0.0) -> None:
        seconds = octets * 10 / self.chip.baud + more
        self.octets += octets
        self.seconds += seconds
        if self._pace:
            time.sleep(seconds)


def _words(data: bytes, size: int) -> list[int]:
    return [int.from_bytes(data[at : at + size], "big") for at in range(0, len(data), size)]


def framed(body: bytes) -> bytes:
    size = len(body)
    short = bytes((size, -size & 255)) if size < 256 else b""
    head = short or b"\xff\xff" + size.to_bytes(2, "big") + bytes((-(size >> 8) - (size & 255) & 255,))
    return b"\0\0\xff" + head + body + bytes((-sum(body) & 255, 0))


def main() -> None:
    pace = "--pace" in sys.argv
    line = Line(sys.argv[1], Chip(sys.argv[2]), pace=pace)
    signal.signal(signal.SIGTERM, lambda *_: setattr(line, "stop", True))
    signal.signal(signal.SIGUSR1, lambda *_: setattr(line, "swallow", True))
    print("ready", flush=True)
    with contextlib.suppress(OSError):
        line.serve()
    commands = sum(line.chip.commands.values())
    print(json.dumps([commands, line.octets, line.seconds, line.chip.air]) if pace else commands, flush=True)


if __name__ == "__main__":
    main()
