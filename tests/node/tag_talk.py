"""A node behind a tag that counts what it runs, and the messages of TNEP that both sides send."""

from __future__ import annotations

import threading

from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import Piece


class Handler:
    """A node that counts what it runs and can be held up."""

    def __init__(self) -> None:
        self.frames: list[bytes] = []
        self.lost_lines: list[str] = []
        self.go = threading.Event()
        self.go.set()
        self.entered = threading.Event()

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        self.entered.set()
        self.go.wait(60)
        self.frames.append(frame)
        return b"\x01\x00\x00" + bytes((len(self.frames),)) + frame

    def lost(self, link: str) -> None:
        self.lost_lines.append(link)

    def identify(self) -> bytes:
        return bytes(22) + bytes((len(self.frames),))

    def can_address(self) -> int:
        return 1

    def take_can_address(self, address: int) -> None:
        raise AssertionError

    def actuator_claimed(self) -> bool:
        return False


def select() -> bytes:
    return message.encode([tnep.select(tnep.SERVICE)])


def request(piece: Piece) -> bytes:
    return message.encode([tnep.payload_record(piece.encode())])


def answer(piece: Piece) -> bytes:
    return message.encode([tnep.payload_record(piece.encode()), tnep.status(0)])
