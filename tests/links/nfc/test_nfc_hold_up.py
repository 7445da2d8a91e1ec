"""A node that keeps to the form and never comes to an end: the station goes its way."""

from __future__ import annotations

import time

import pytest

from teds_provision.errors import GarbledError, NodeSilentError
from teds_provision.links.nfc import message, tag, tnep
from teds_provision.links.nfc.nfcpy import Type4TagCommandError
from teds_provision.links.nfc.pieces import Piece, Requester
from teds_provision.links.nfc.poller import Poller

SERVICE = tnep.ServiceParameters(tnep.SERVICE, 20, 15, 499)


class EndlessReply:
    """Gives ``step`` octets of an endless reply at a time, just within the station's patience."""

    def __init__(self, step: int, seconds: float) -> None:
        self.step, self.seconds = step, seconds
        self.now = 0.0
        self._answer = b""

    def sleep(self, seconds: float) -> None:
        self.now += seconds

    def write(self, octets: bytes) -> None:
        self.now += self.seconds
        status = tnep.status(tnep.SUCCESS)
        payload = tnep.external(message.decode(octets), tnep.TIM_TYPE)
        if payload is None:
            self._answer = message.encode([status])
            return
        asked = Piece.decode(payload)
        offset = 0 if asked.body else asked.offset
        body = bytes(min(self.step, 4094 - offset))
        piece = Piece(asked.transaction, 4094, offset, body, answer=True, more=True)
        self._answer = message.encode([status, tnep.payload_record(piece.encode())])

    def read(self) -> bytes:
        return self._answer


def test_a_reply_in_drops_ends_after_two_minutes() -> None:
    node = EndlessReply(8, 4.0)
    with pytest.raises(NodeSilentError, match="120 s"):
        Poller(node, SERVICE, clock=lambda: node.now, sleep=node.sleep).transact(1, bytes(10))
    assert node.now < 135


def test_a_slow_node_has_the_time_that_it_needs() -> None:
    node = EndlessReply(100, 2.0)
    reply = Poller(node, SERVICE, clock=lambda: node.now, sleep=node.sleep).transact(1, bytes(10))
    assert len(reply) == 4094


def test_no_reply_is_longer_than_the_longest_frame() -> None:
    requester = Requester(1, bytes(10), 100)
    with pytest.raises(GarbledError, match="at most 4094 are allowed"):
        requester.handle_piece(Piece(1, 4094 + 1, 0, bytes(8), answer=True))
    assert requester.handle_piece(Piece(1, 4094, 0, bytes(8), answer=True))


class StuckFrontEnd:
    """A front end whose tag says the same block to whatever it is asked."""

    def __init__(self, block: bytes) -> None:
        self.block, self.frames = block, 0

    def exchange(self, octets: bytes, _timeout: float) -> bytes:
        self.frames += 1
        number = octets[0] & 1
        return bytes([self.block[0] & 0xFE | number]) + self.block[1:] if self.block[0] < 0xC0 else self.block


@pytest.mark.parametrize(
    "block", [b"\xf2\x01", b"\xf2\x3b", b"\xf2", b"\xa2", b"\x12" + bytes(200)],
    ids=["S(WTX)", "S(WTX) 59", "S(WTX) cut short", "R(ACK)", "chained"],
)  # fmt: skip
def test_a_tag_that_puts_off_its_answer_for_ever_is_given_up(block: bytes, monkeypatch: pytest.MonkeyPatch) -> None:
    """nfcpy goes on for as long as the tag does: `identify --timeout 6` never ended, at full speed."""
    monkeypatch.setattr(tag, "_APDU_SECONDS", 0.2)
    air = StuckFrontEnd(block)
    began = time.monotonic()
    dep = tag.IsoDep(air, 64, 0.1)
    if block == b"\xa2":
        dep.pni = 1  # R(ACK) of the block before: send yours again
        air.exchange = lambda octets, _timeout: bytes([0xA2 | ~octets[0] & 1])  # type: ignore[method-assign]
    with pytest.raises(Type4TagCommandError):
        dep.exchange(b"\x00\xa4\x04\x00")
    assert time.monotonic() - began < 30
