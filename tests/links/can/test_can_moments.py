"""When a message left and came: what a station makes of a node's clock rests on it."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import pytest

from teds_provision.links.can.bus import Bus, Frame, clock_is_ours
from teds_provision.links.can.spec import parse_spec
from teds_provision.node.can.server import CanServer
from teds_provision.protocol.operation.can_frames import trigger_identifier
from tests.links.can.echo_node import EchoNode
from tests.links.can.test_can_exchange import COUNT, opened, serving

pytestmark = pytest.mark.link


class TimedEchoNode(EchoNode):
    """Notes when it ran a request, and at which of its ticks (the host's ns) the request is said to have come."""

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.ran = 0.0
        self.received = 0
        self.triggered = threading.Event()

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        self.ran = time.monotonic()
        return super().request(link, frame, tapped=tapped)

    def tick(self, at: float = 0.0) -> int:
        return round(at * 1e9)

    def request_received(self, link: str, frame: bytes, *, tapped: bool, received: int, **_: object) -> bytes:
        self.received = received
        return self.request(link, frame, tapped=tapped)

    def reply_sent(self, link: str) -> None: ...

    def trigger(self, link: str, token: bytes, tick: int) -> None:
        self.received = tick
        self.triggered.set()


def test_a_link_says_when_the_first_request_left_and_when_the_last_reply_was_whole(group: str) -> None:
    node = TimedEchoNode(0x21)
    with serving(group, node), opened(group) as port:
        link = port.link(0x21)
        before = time.monotonic()
        link.exchange(COUNT)
        assert before <= link.left <= node.ran <= link.came <= time.monotonic()
        left, came = link.left, link.came
        link.exchange(COUNT)
        assert link.left == left, "until it is set to 0: of several copies the first one counts"
        assert came < node.ran <= link.came
        link.left = 0.0
        link.exchange(COUNT)
        assert came < link.left <= node.ran


def test_a_node_dates_requests_and_triggers_by_their_arrival_not_by_when_its_thread_came_to_it(
    group: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    receive = Bus.receive

    def late(bus: Bus, seconds: float) -> Frame | None:
        frame = receive(bus, seconds)
        return frame and replace(frame, at=frame.at - 0.25)

    monkeypatch.setattr(Bus, "receive", late)
    node, server = TimedEchoNode(0x21), CanServer(group)
    server.add(node, measuring_handler=node)  # type: ignore[arg-type]  # what a request asks of a measuring node
    server.start()
    try:
        with opened(group) as port:
            port.link(0x21).exchange(COUNT)
            assert node.received <= (node.ran - 0.25) * 1e9
            before = time.monotonic()
            port.send(Frame(trigger_identifier(port.spec.source), bytes(8)))
            assert node.triggered.wait(30)
            assert (before - 0.25) * 1e9 <= node.received <= (time.monotonic() - 0.25) * 1e9
    finally:
        server.stop()


@pytest.mark.parametrize(
    ("spec", "ours"),
    [
        ("socketcan:can0", True),
        ("socketcand:can0", True),
        ("socketcand:can0?host=127.0.0.1&port=1", True),
        ("socketcand:can0?host=10.0.0.7", False),
        ("slcan:/dev/ttyACM0", False),
    ],
)
def test_time_stamps_of_another_clock_are_not_believed(spec: str, ours: bool) -> None:
    """An adapter's or another machine's clock that is 0.3 s behind would make each frame 0.3 s older than it is."""
    assert clock_is_ours(parse_spec(spec)) is ours
