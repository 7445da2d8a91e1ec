"""Exchanges on a bus that loses, doubles, swaps, delays and corrupts frames; every node of a bus is found."""

from __future__ import annotations

import os
import time
from collections.abc import Callable

import pytest

from teds_provision.errors import GarbledError, LinkError
from teds_provision.links import Notice
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.port import CanPort
from tests.links.can import lossy
from tests.links.can.hub import Hub
from tests.pace import best_of

pytestmark = pytest.mark.link
Start = Callable[..., None]
lossy.install()


def write(octets: bytes) -> bytes:
    return b"\x00\x00\x01\x03" + len(octets).to_bytes(2, "big") + octets


def over(group: str, **faults: object) -> str:
    return group.replace("udp_multicast:", "lossy:", 1) + "".join(f"&{key}={value}" for key, value in faults.items())


def tally(port: CanPort, octets: int, count: int) -> int:
    """Return how many of so many exchanges come through; a reply that is another is an error at once."""
    good = 0
    for _ in range(count):
        body = os.urandom(octets)
        try:
            assert port.link(0x21).exchange(write(body)) == body[::-1]
            good += 1
        except LinkError:
            continue
    return good


def test_doubled_frames_do_no_harm(group: str, nodes: Start) -> None:
    nodes(group, 0x21)
    port = CanPort(over(group, seed=1, double=0.05))

    def twenty() -> float:
        began = time.monotonic()
        assert tally(port, 100, 20) == 20
        return time.monotonic() - began

    best_of(5, 10, twenty, because="twenty exchanges of two processes; a sequence error costs a second each time")
    port.close()


def test_small_pieces_come_through_if_frames_are_lost(group: str, nodes: Start) -> None:
    nodes(group, 0x21)
    port = CanPort(over(group, seed=2, loss=0.03))
    best_of(3, 4, lambda: 10 - tally(port, 40, 10))  # of ten, three may be lost
    port.close()


def test_a_lost_flow_control_ends_the_wait_at_once(hub: Hub, nodes: Start) -> None:
    nodes(hub.spec, 0x21)
    lost: list[bytes] = []

    def lose_flow(identifier: int, data: bytes) -> bool:
        if identifier == 0x18DAF121 and data[0] >> 4 == 3 and not lost:
            lost.append(data)
            return True
        return False

    hub.lose = lose_flow
    port = CanPort(hub.spec)

    def elapsed() -> float:
        lost.clear()
        began = time.monotonic()
        assert port.link(0x21).exchange(write(bytes(300))) == bytes(300)
        assert lost
        return time.monotonic() - began

    best_of(5, 4.0, elapsed, because="the exchange itself may take seconds, a reply that is waited for five")
    port.close()


@pytest.mark.parametrize("busy", [0.0, 0.4], ids=["free bus", "flow control held up"])
def test_a_node_has_a_second_from_the_flow_control_to_the_next_frame(
    hub: Hub, monkeypatch: pytest.MonkeyPatch, busy: float
) -> None:
    """N_Cr (profile.md): half a second after its first frame its reply counted as torn, whatever held it up."""
    port, begun = CanPort(hub.spec), (0x18DAF121, b"\x10\x20")
    times: list[tuple[str, float]] = []
    pass_on = port.bus()._bus.send

    def answer(identifier: int, data: bytes) -> bool:
        if identifier == 0x18DA21F1 and data[0] == 7:
            times.append(("asked", time.monotonic()))
            hub.send(begun[0], begun[1] + data[1:2] + bytes(5))  # and no frame after the first
        return False

    def send(frame: Frame) -> None:
        if frame.data[0] >> 4 == 3:
            time.sleep(busy)
            times.append(("asked on", time.monotonic()))
        pass_on(frame)

    monkeypatch.setattr(port.bus()._bus, "send", send)
    hub.lose = answer
    with pytest.raises(GarbledError):
        port.link(0x21).exchange_limited(write(b""), tries=2, seconds=5.0)
    assert [name for name, _ in times] == ["asked", "asked on"] * 2
    assert times[2][1] - times[1][1] >= 1.0
    port.close()


def test_an_order_is_sent_again_after_a_quarter_and_a_half_and_given_up_at_the_end(hub: Hub, nodes: Start) -> None:
    """operation.md section 2, "No late orders": nothing of it leaves when it would be too late."""
    nodes(hub.spec, 0x21)
    port = CanPort(hub.spec)
    link = port.link(0x21)
    assert link.exchange_within(write(bytes(20)), 1.0) == bytes(20)

    def with_first_reply_lost() -> float:
        replies: list[int] = []

        def lose(identifier: int, data: bytes) -> bool:
            first = identifier == 0x18DAF121 and data[0] >> 4 == 1 and not replies
            replies.extend([identifier] * first)
            return first

        hub.lose = lose
        began = time.monotonic()
        assert link.exchange_within(write(bytes(range(20))), 2.0) == bytes(range(20))[::-1]
        seconds = time.monotonic() - began
        assert seconds >= 0.5
        return seconds

    best_of(5, 1.0, with_first_reply_lost, because="half of the second is the wait itself")
    hub.lose = lambda identifier, _data: identifier == 0x18DAF121

    def with_every_reply_lost() -> float:
        hub.frames.clear()
        began = time.monotonic()
        with pytest.raises(LinkError):
            link.exchange_within(write(b""), 0.8)  # one frame
        seconds = time.monotonic() - began
        assert seconds >= 0.8
        requests = [data for identifier, data in hub.frames if identifier == 0x18DA21F1]
        return seconds if len(requests) == 3 else float("inf")

    best_of(5, 1.2, with_every_reply_lost, because="0.8 s are the wait itself")
    hub.frames.clear()
    with pytest.raises(LinkError):
        link.exchange_within(write(bytes(20)), 0.8)  # whose flow control is lost: it is begun again until then

    def sent() -> int:
        return sum(identifier == 0x18DA21F1 for identifier, _ in list(hub.frames))

    ended = sent()
    time.sleep(0.3)
    assert sent() == ended
    port.close()


def quiet(_: Notice) -> None:
    pass


def assert_all_found(
    port: CanPort,
    addresses: list[int],
    begin: Callable[[], None] = lambda: None,
    notice: Callable[[Notice], None] = quiet,
) -> None:
    """One question to everyone finds all: of some, since a node that had no processor in time is not on time."""
    missed = []
    for _ in range(8):
        begin()
        found = sorted(contact.address or 0 for contact in port.find_all(seconds=10, notice=notice))
        if found == addresses:
            return
        missed.append(sorted(set(addresses) - set(found)))
    raise AssertionError(f"not found: {missed}")


def test_all_of_sixty_nodes_answer_one_question(hub: Hub, nodes: Start) -> None:
    addresses = list(range(0x21, 0x21 + 60))
    nodes(hub.spec, *addresses)
    port = CanPort(hub.spec)
    assert_all_found(port, addresses)
    port.close()


def test_a_node_of_many_whose_first_frame_was_lost_is_found_all_the_same(hub: Hub, nodes: Start) -> None:
    """Nothing of its answer was heard, so that nobody knew that there was one to ask for."""
    addresses = list(range(0x21, 0x21 + 12))
    nodes(hub.spec, *addresses)
    lost: list[int] = []

    def lose_one(identifier: int, data: bytes) -> bool:
        if identifier == 0x18DAF125 and data[0] >> 4 == 1 and not lost:
            lost.append(identifier)
            return True
        return False

    hub.lose = lose_one
    port = CanPort(hub.spec)
    assert_all_found(port, addresses, begin=lost.clear)
    assert lost
    port.close()


def test_a_torn_answer_to_everyone_is_asked_again_and_no_conflict(hub: Hub, nodes: Start) -> None:
    nodes(hub.spec, 0x21, 0x22, 0x23)
    lost: set[int] = set()

    def lose_second_frame(identifier: int, data: bytes) -> bool:
        first = identifier in (0x18DAF121, 0x18DAF122) and data[0] == 0x22 and identifier not in lost
        if first:
            lost.add(identifier)
        return first

    hub.lose = lose_second_frame
    port = CanPort(hub.spec)
    assert_all_found(port, [0x21, 0x22, 0x23], begin=lost.clear)
    assert len(lost) == 2
    port.close()


def test_what_began_and_did_not_end_is_named(hub: Hub, nodes: Start) -> None:
    nodes(hub.spec, 0x21, 0x22)
    hub.lose = lambda identifier, data: identifier == 0x18DAF122 and data[0] == 0x23  # its last frame, always
    port = CanPort(hub.spec)
    notices: list[Notice] = []
    assert_all_found(port, [0x21], begin=notices.clear, notice=notices.append)
    assert [(notice.kind, "0x22" in notice.text) for notice in notices[1:]] == [("unfinished", True)]
    port.close()


def test_one_uuid_at_two_addresses_is_named(hub: Hub) -> None:
    from teds_provision.node.can.server import CanServer
    from tests.links.can.echo_node import EchoNode

    servers = [CanServer(hub.spec, EchoNode(address, uuid=b"U" * 10)) for address in (0x21, 0x22)]
    for server in servers:
        server.start()
    port = CanPort(hub.spec)
    notices: list[Notice] = []
    try:
        assert_all_found(port, [0x21, 0x22], begin=notices.clear, notice=notices.append)
        assert any(notice.kind == "conflict" and "0x21 and 0x22" in notice.text for notice in notices)
    finally:
        for server in servers:
            server.stop()
        port.close()
