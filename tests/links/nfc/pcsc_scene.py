"""Real pcscd with a virtual reader (vpcd), and a virtual node as the card in it; runs the program's commands on it.

``unshare -n -m python -m tests.links.nfc.pcsc_scene FOLDER TAG`` (vpcd listens on every interface, and pcscd's socket
has a fixed place: both namespaces are this scene's own). Commands, as JSON lists, come on stdin, one a line; for each a
JSON line with ``code``, ``out``, ``err`` goes out. The passphrase stands in FOLDER/pass. ``["lift"]`` and ``["put"]``
take the card off and put it back.

What is real: pcscd, its client library, vpcd's driver. What is not: the reader, its firmware, the radio.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

from teds_provision.node.flash_file import FlashFile
from teds_provision.node.nfc.tags import NdefApplication, Type2Memory, Type4Memory
from teds_provision.node.nfc.tnep import TnepTag
from teds_provision.node.virtual import VirtualNode

DRIVER = "/usr/lib/pcsc/drivers/serial/libifdvpcd.so"
PORT = 35963
UID = bytes.fromhex("04112233445566")
ATR = {
    "4": bytes.fromhex("3B80800101"),
    "2": bytes.fromhex("3B8F8001804F0CA000000306030003000000006800"),  # PC/SC part 3: a storage card, Ultralight
}
POWER_OFF, POWER_ON, RESET, GET_ATR = range(4)
GET_ATR = 4


def loopback_up() -> None:
    """A new network namespace has its loopback down."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as control:
        fcntl.ioctl(control, 0x8914, struct.pack("16sh14x", b"lo", 1 | 0x40))  # SIOCSIFFLAGS: up, running


class Card:
    """The node's tag as a card in vpcd's slot."""

    def __init__(self, folder: Path, kind: str) -> None:
        FlashFile.create(folder)
        self.node = VirtualNode(folder)
        self.kind = kind
        self._memory4, self._memory2 = Type4Memory(4160), Type2Memory(UID)
        memory = self._memory4 if kind == "4" else self._memory2
        self._tnep = TnepTag(memory, self.node, wt_int=4, n_wait=15)
        self._tnep.start()
        self._application: NdefApplication | None = None
        self._slot: socket.socket | None = None

    def put(self) -> None:
        """Put it on the reader."""
        until = time.monotonic() + 60
        while True:
            try:
                self._slot = socket.create_connection(("127.0.0.1", PORT))
                self._slot.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                break
            except OSError:
                if time.monotonic() > until:
                    raise
                time.sleep(0.05)
        threading.Thread(target=self._serve, args=(self._slot,), daemon=True).start()

    def lift(self) -> None:
        """Take it off."""
        assert self._slot is not None
        self._slot.shutdown(socket.SHUT_RDWR)
        self._slot.close()

    def _serve(self, slot: socket.socket) -> None:
        with contextlib.suppress(OSError, EOFError):
            while True:
                octets = _exactly(slot, int.from_bytes(_exactly(slot, 2), "big"))
                answer = self._control(octets[0]) if len(octets) == 1 else self._apdu(octets)
                if answer:
                    slot.sendall(len(answer).to_bytes(2, "big") + answer)
        self._power(on=False)

    def _control(self, code: int) -> bytes:
        if code == GET_ATR:
            return ATR[self.kind]
        self._power(on=code != POWER_OFF)
        return b""

    def _power(self, *, on: bool) -> None:
        if self._application is not None:
            self._tnep.lost()
            self._application = None
        if on:
            self._tnep.activated()
            self._application = NdefApplication(self._memory4, self._tnep.ready)

    def _apdu(self, apdu: bytes) -> bytes:
        if apdu[:2] == b"\xff\xca":
            return UID + b"\x90\x00"
        if self.kind == "2":
            return self._storage(apdu)
        if self._application is None:
            self._power(on=True)
        assert self._application is not None
        return self._application.run(apdu, 0.5) or b"\x64\x00"

    def _storage(self, apdu: bytes) -> bytes:
        if apdu[:2] == b"\xff\xb0":
            octets = self._memory2.answer(bytes((0x30, apdu[3]))) or b""
            return octets + b"\x90\x00" if len(octets) == 16 else b"\x63\x00"
        if apdu[:2] == b"\xff\xd6":
            done = self._memory2.answer(bytes((0xA2, apdu[3])) + apdu[5:9]) == b"\x0a"
            return b"\x90\x00" if done else b"\x63\x00"
        return b"\x6d\x00"


def _exactly(stream: socket.socket, octets: int) -> bytes:
    held = b""
    while len(held) < octets:
        stream.setsockopt(socket.IPPROTO_TCP, socket.TCP_QUICKACK, 1)  # vpcd sends length and octets apart: 40 ms else
        more = stream.recv(octets - len(held))
        if not more:
            raise EOFError
        held += more
    return held


def start_pcscd(folder: Path) -> subprocess.Popen[bytes]:
    """Start pcscd with one virtual reader, its socket and lock on a file system of our own."""
    Path("/run/pcscd").mkdir(exist_ok=True)
    subprocess.run(["mount", "-t", "tmpfs", "tmpfs", "/run/pcscd"], check=True)
    config = folder / "reader.conf"
    config.write_text(
        f'FRIENDLYNAME "Virtual PCD"\nDEVICENAME /dev/null:0x{PORT:04X}\nLIBPATH {DRIVER}\nCHANNELID 0x{PORT:04X}\n'
    )
    process = subprocess.Popen(
        ["/usr/sbin/pcscd", "--foreground", "--config", config], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    until = time.monotonic() + 60
    while not Path("/run/pcscd/pcscd.comm").exists():
        assert time.monotonic() < until
        time.sleep(0.05)
    return process


def main() -> None:
    folder, kind = Path(sys.argv[1]), sys.argv[2]
    loopback_up()
    pcscd = start_pcscd(folder)
    card = Card(folder / "node", kind)
    doing: dict[str, Callable[[], None]] = {"lift": card.lift, "put": card.put}
    print(json.dumps({"uuid": card.node.tim.flash.uuid.hex()}), flush=True)
    try:
        for line in sys.stdin:
            words = json.loads(line)
            if words[0] in doing:
                doing[words[0]]()
                done = {"code": 0}
            else:
                secret = os.open(folder / "pass", os.O_RDONLY)
                ran = subprocess.run(
                    [sys.executable, "-m", "teds_provision", "--passphrase-fd", str(secret), *words],
                    capture_output=True,
                    text=True,
                    check=False,
                    pass_fds=(secret,),
                    timeout=60,
                )
                os.close(secret)
                done = {"code": ran.returncode, "out": ran.stdout, "err": ran.stderr}
            print(json.dumps(done), flush=True)
    finally:
        pcscd.terminate()
        pcscd.wait(60)


if __name__ == "__main__":
    main()
