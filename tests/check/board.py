"""A board with one fault, behind real links: ``python -m tests.check.board FAULT [--nfc PATH] [--can BUS]``.

Prints a line when its links are up; ends when stdin closes. FAULT "" is the good one, "mute" answers Identify alone.
"""

from __future__ import annotations

import argparse
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace

import pytest

from teds_provision.errors import LinkError
from teds_provision.links.can import isotp
from teds_provision.node.can import endpoint
from teds_provision.node.can.server import CanServer
from teds_provision.node.nfc import tags
from teds_provision.node.nfc import tnep as tnep_of_node
from teds_provision.node.nfc.server import NfcServer
from teds_provision.protocol.messages.frames import IDENTIFY
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.repetition import Repetition
from teds_provision.protocol.tim import node
from tests.bench import Board
from tests.check.faults import FAULTS
from tests.check.faulty import Fault
from tests.protocol.desk import META, NAME

Bend = Callable[[pytest.MonkeyPatch], None]
ADDRESS_SECONDS = 3.0
"""Between two writes of the address, of the 10 s that the profile has: nobody waits for them here."""
BOARD = (sys.executable, "-m", "tests.check.board")
"""The program: FAULT --nfc PLACE | --can PLACE; it says that it is ready, and runs until it is ended."""


def _runs_again(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(Repetition, "answer", lambda self, transaction, frame, run, now: run(frame))


def _padded_with(octet: int) -> Bend:
    def bend(patch: pytest.MonkeyPatch) -> None:
        original = endpoint.Pair.__init__

        def init(self: isotp.Pair, *args: object, **more: object) -> None:
            original(self, *args, **more)  # type: ignore[arg-type]
            self._logic.params.tx_padding = octet

        patch.setattr(endpoint.Pair, "__init__", init)
        patch.setattr(isotp, "PADDING", octet)

    return bend


def _block_of(size: int, gap: int) -> Bend:
    def bend(patch: pytest.MonkeyPatch) -> None:
        original = endpoint.Pair.__init__

        def init(self: isotp.Pair, *args: object, **more: object) -> None:
            original(self, *args, **more)  # type: ignore[arg-type]
            self._logic.params.blocksize, self._logic.params.stmin = size, gap

        patch.setattr(endpoint.Pair, "__init__", init)

    return bend


def _choosing_otherwise(patch: pytest.MonkeyPatch) -> None:
    """Block size, gap and padding are none of those that are usual."""
    _block_of(8, 2)(patch)
    _padded_with(0)(patch)


def _always_classic(patch: pytest.MonkeyPatch) -> None:
    original = isotp.Pair.speak
    patch.setattr(isotp.Pair, "speak", lambda self, fd: original(self, fd=False))


def _wtx(octets: bytes) -> Bend:
    """Each APDU is answered after an S(WTX) with this multiplier."""

    def bend(patch: pytest.MonkeyPatch) -> None:
        run = tags.IsoDepTag._run

        def asks_first(self: tags.IsoDepTag, apdu: bytes) -> bytes:
            if self._pending is None:
                self._pending = apdu
                return self._remember(octets)
            return run(self, apdu)

        patch.setattr(tags.IsoDepTag, "_run", asks_first)

    return bend


def _stale(patch: pytest.MonkeyPatch) -> None:
    def identify(self: OnLinks) -> bytes:
        now = self.board.tim.identity()
        return replace(now, epoch=now.epoch - 1).encode()

    patch.setattr(OnLinks, "identify", identify)


LINK_FAULTS: dict[str, Bend] = {
    "runs again": _runs_again,
    "padding 00": _padded_with(0),
    "block size 8": _block_of(8, 0),
    "each choice": _choosing_otherwise,
    "gap of 5 ms": _block_of(16, 5),
    "found as of an older epoch": _stale,
    "always classic": _always_classic,
    "WTX 1": _wtx(b"\xf2\x01"),
    "WTX 0": _wtx(b"\xf2\x00"),
    "WTX 63": _wtx(b"\xf2\x3f"),
    "a TNEP status of 81": lambda patch: patch.setattr(tnep_of_node.tnep, "SUCCESS", 0x81),
}


class OnLinks:
    """The board as its links see it; see ``NodeHandler``."""

    def __init__(self, board: Board, fault: Fault | None) -> None:
        self.board, self.fault = board, fault
        self.mute = False
        self._turn = threading.Lock()

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        if self.mute and frame[2:4] != IDENTIFY.encode()[2:4]:
            raise LinkError("It is mute.")
        with self._turn:
            board = self.board
            board.seconds = time.monotonic()

            def reference(octets: bytes) -> bytes:
                return board.tim.handle(octets, link=link, tapped=tapped)

            return reference(frame) if self.fault is None else self.fault(board, frame, reference)

    def lost(self, link: str) -> None:
        with self._turn:
            self.board.tim.link_lost(link)

    def identify(self) -> bytes:
        return self.board.tim.identity().encode()

    def can_address(self) -> int:
        return self.board.tim.can_address

    def take_can_address(self, address: int) -> None:
        self.board.tim.take_can_address(address)

    def actuator_claimed(self) -> bool:
        return False


def main() -> None:
    words = argparse.ArgumentParser()
    words.add_argument("fault")
    words.add_argument("--nfc")
    words.add_argument("--can")
    words.add_argument("--wait-time", type=int, default=4)
    options = words.parse_args()
    patch = pytest.MonkeyPatch()
    patch.setattr(node, "_ADDRESS_SECONDS", ADDRESS_SECONDS)
    fault = FAULTS.get(options.fault)
    if fault is not None and fault.bend is not None:
        fault.bend(patch)
    if options.fault in LINK_FAULTS:
        LINK_FAULTS[options.fault](patch)
    board = Board()
    board.flash.state = replace(board.state, blocks={(0, 1): META, (1, 12): NAME}, epoch=4)
    board.power_on()
    handler = OnLinks(board, fault.fault if fault is not None else None)
    handler.mute = options.fault == "mute"
    servers: list[NfcServer | CanServer] = []
    if options.nfc:
        servers.append(NfcServer(options.nfc, handler, wt_int=options.wait_time))
    if options.can:
        always = options.fault == "tapped by bus"
        tapped = lambda: always or (not options.nfc and board.state.state == NodeState.FACTORY)  # noqa: E731
        servers.append(CanServer(options.can, handler, counts_as_tapped=tapped))
    for server in servers:
        server.start()
    print("ready", flush=True)
    threading.Event().wait()  # until it is ended


if __name__ == "__main__":
    main()
