"""Nodes with little room: a refusal in place of a flow control, block sizes, gaps and padding of their own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from teds_provision.links.can import link as link_module
from teds_provision.links.can.bus import Frame
from teds_provision.links.can.isotp import Pair, physical_id, single
from teds_provision.links.can.port import CanPort
from teds_provision.node.can.server import CanServer
from teds_provision.protocol.messages.frames import Reason, decode_reply, refusal
from teds_provision.protocol.messages.identity import Identity
from tests.links.can.echo_node import EchoNode
from tests.links.can.hub import Hub

pytestmark = pytest.mark.link
TO_US, FROM_US = 0x18DAF121, 0x18DA21F1
LONG = b"\x00\x00\x01\x03\x00\x64" + bytes(100)
BUSY, DONE = refusal(Reason.BUSY).encode(), b"\x01\x00\x00"
FRAMES_OF_LONG = 1 + (107 - 6 + 6) // 7


@contextmanager
def small_node(hub: Hub, take: Callable[[bytes], None]) -> Iterator[list[bytes]]:
    """Hands every frame of the station to ``take``; gives the first frames that came."""
    firsts: list[bytes] = []
    stop = threading.Event()

    def run() -> None:
        seen = 0
        while not stop.wait(0.002):
            frames = list(hub.frames)
            for identifier, data in frames[seen:]:
                if identifier == FROM_US:
                    if data[0] >> 4 == 1:
                        firsts.append(data)
                    take(data)
            seen = len(frames)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield firsts
    finally:
        stop.set()
        thread.join()


@pytest.fixture
def port(hub: Hub) -> Iterator[CanPort]:
    port = CanPort(hub.spec)
    yield port
    port.close()


def serving(hub: Hub, refusals: int, flow: bytes, reason: Reason = Reason.BUSY) -> Callable[[bytes], None]:
    """Refuses the first so many first frames, then takes the request with this flow control, and says it is done."""
    left, held = [refusals], [0]

    def take(data: bytes) -> None:
        transaction = data[2:3]
        if data[0] >> 4 == 1 and left[0]:
            left[0] -= 1
            hub.send(TO_US, single(transaction + refusal(reason).encode()))
        elif data[0] >> 4 == 1:
            held[:] = [6, transaction[0]]
            hub.send(TO_US, flow)
        elif data[0] >> 4 == 2 and held[0]:
            held[0] += 7
            if held[0] >= 107:
                hub.send(TO_US, single(bytes([held[1]]) + DONE))
            elif flow[1] and (held[0] - 6) // 7 % flow[1] == 0:
                hub.send(TO_US, flow)

    return take


def test_a_node_that_cannot_take_a_long_request_now_is_sent_the_same_octets_after_100_ms(
    hub: Hub, port: CanPort
) -> None:
    began = time.monotonic()
    with small_node(hub, serving(hub, 4, b"\x30\x00\x00")) as firsts:
        assert port.link(0x21).exchange(LONG) == DONE
    assert time.monotonic() - began >= 0.4
    assert len(firsts) == 5, "more often than a request is repeated"
    assert len(set(firsts)) == 1, "the same transaction"


def test_after_10_s_the_17_is_the_reply(hub: Hub, port: CanPort, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(link_module, "BUSY_SECONDS", 0.5)
    with small_node(hub, serving(hub, 999, b"")) as firsts:
        assert port.link(0x21).exchange(LONG) == BUSY
    assert 3 <= len(firsts) <= 7


def test_another_refusal_in_place_of_a_flow_control_is_the_reply_at_once(hub: Hub, port: CanPort) -> None:
    with small_node(hub, serving(hub, 999, b"", Reason.TOO_LARGE)) as firsts:
        assert decode_reply(port.link(0x21).exchange(LONG)).reason == Reason.TOO_LARGE
    assert len(firsts) == 1


@pytest.mark.parametrize(
    ("flow", "least"),
    [
        (b"\x30\x00\x00", 0.0),
        (b"\x30\x01\x00", 0.0),
        (b"\x30\x02\x05\x00\x00", 0.03),  # unpadded, 5 ms
        (b"\x30\x03\xf5\x55\x55\x55\x55\x55", 0.0),
        (b"\x30\x08\x14", 0.2),  # 20 ms
        (b"\x30\x0e\x80", 1.5),  # reserved: 127 ms
        (b"\x30\x0e\xff", 1.5),
    ],
)
def test_a_node_asks_for_its_own_block_size_and_gap(hub: Hub, port: CanPort, flow: bytes, least: float) -> None:
    began = time.monotonic()
    with small_node(hub, serving(hub, 0, flow)) as firsts:
        assert port.link(0x21).exchange(LONG) == DONE
    assert time.monotonic() - began >= least
    assert len(firsts) == 1


# -- our node ----------------------------------------------------------------------------------------------------------


def test_a_request_beyond_max_message_is_refused_in_place_of_a_flow_control(hub: Hub, port: CanPort) -> None:
    node = EchoNode(0x21)
    identity = replace(Identity.decode(node.identify()), max_message=512).encode()
    node.identify = lambda: identity  # type: ignore[method-assign]
    server = CanServer(hub.spec, node, counts_as_tapped=lambda: True)
    server.start()
    try:
        most = 512
        longest = b"\x00\x00\x01\x03" + (most - 6).to_bytes(2, "big") + bytes(most - 6)
        assert len(port.link(0x21).exchange(longest)) > 500
        assert decode_reply(port.link(0x21).exchange(longest + b"\0")).reason == Reason.TOO_LARGE
        sent = [data for identifier, data in hub.frames if identifier == FROM_US]
        assert sum(data[0] >> 4 == 1 for data in sent) == 2
        assert sent[-1][0] >> 4 == 1, "nothing of it was sent but its first frame"
    finally:
        server.stop()


def test_a_single_frame_in_place_of_a_flow_control_ends_what_can_isotp_would_go_on_waiting_for() -> None:
    sent: list[Frame] = []
    pair = Pair(0xF1, 0x21, sent.append)
    pair.send(bytes(100))
    assert pair.waits_for_flow
    assert pair.handle_frame(Frame(physical_id(0xF1, 0x21), single(b"\x42" + BUSY)))
    assert not pair.sending
    assert pair.received() == b"\x42" + BUSY
    pair.send(bytes(100))
    assert [frame.data[0] >> 4 for frame in sent] == [1, 1]
