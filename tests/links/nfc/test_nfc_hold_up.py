"""A node that keeps to the form and never comes to an end: the station goes its way."""

from __future__ import annotations

import pytest

from teds_provision.errors import Garbled, NodeSilent
from teds_provision.links.nfc import message, tnep
from teds_provision.links.nfc.pieces import LONGEST_FRAME, Piece, Requester
from teds_provision.links.nfc.poller import LONGEST, Poller

SERVICE = tnep.ServiceParameters(tnep.SERVICE, 20, 15, 499)


class Dripping:
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
        body = bytes(min(self.step, LONGEST_FRAME - offset))
        piece = Piece(asked.transaction, LONGEST_FRAME, offset, body, answer=True, more=True)
        self._answer = message.encode([status, tnep.payload_record(piece.encode())])

    def read(self) -> bytes:
        return self._answer


def test_a_reply_in_drops_ends_after_two_minutes() -> None:
    node = Dripping(8, 4.0)
    with pytest.raises(NodeSilent, match="120 s"):
        Poller(node, SERVICE, clock=lambda: node.now, sleep=node.sleep).transact(1, bytes(10))
    assert node.now < LONGEST + 15


def test_a_slow_node_has_the_time_that_it_needs() -> None:
    node = Dripping(100, 2.0)
    reply = Poller(node, SERVICE, clock=lambda: node.now, sleep=node.sleep).transact(1, bytes(10))
    assert len(reply) == LONGEST_FRAME


def test_no_reply_is_longer_than_the_longest_frame() -> None:
    requester = Requester(1, bytes(10), 100)
    with pytest.raises(Garbled, match="4094 is the most"):
        requester.take(Piece(1, LONGEST_FRAME + 1, 0, bytes(8), answer=True))
    assert requester.take(Piece(1, LONGEST_FRAME, 0, bytes(8), answer=True))
