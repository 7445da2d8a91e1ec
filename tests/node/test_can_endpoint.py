"""One node on a bus, without a bus: what it queues, answers once, announces, and forgets with an address or the bus."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.links.can.bus import Frame
from teds_provision.links.can.isotp import Pair
from teds_provision.node.can import endpoint as endpoint_module
from teds_provision.node.can.endpoint import CanEndpoint, EndpointRequest, StationState, link_name
from teds_provision.protocol.messages.identity import Identity, NodeState

UUID = bytes(range(10))
WRITE, LIST = bytes.fromhex("000001030000"), bytes.fromhex("0000800b0000")


class Jobs:
    """The queue of one station: jobs run when the test says so."""

    def __init__(self) -> None:
        self.jobs: list[Callable[[], None]] = []

    def put(self, job: Callable[[], None]) -> None:
        self.jobs.append(job)

    def run(self) -> None:
        while self.jobs:
            self.jobs.pop(0)()


class Handler:
    """A node that counts what it runs."""

    def __init__(self) -> None:
        self.address, self.state = 7, NodeState.KEYED
        self.log: list[Any] = []

    def request(self, link: str, frame: bytes, *, tapped: bool) -> bytes:
        self.log.append((link, frame, tapped))
        return bytes((len(self.log),))

    def request_received(self, link: str, frame: bytes, **how: Any) -> bytes:
        self.log.append((link, frame, how))
        return b"m"

    def reply_sent(self, link: str) -> None:
        self.log.append(f"sent {link}")

    def lost(self, link: str) -> None:
        self.log.append(f"lost {link}")

    def identify(self) -> bytes:
        return Identity(UUID, self.state, 1, 2, 1024, self.address).encode()

    def can_address(self) -> int:
        return self.address

    def take_can_address(self, address: int) -> None:
        self.log.append(f"takes {address}")


class Rig:
    """A node on no bus: its queues, and what it sends."""

    def __init__(self, *, measuring: bool = False) -> None:
        self.handler, self.sent, self.queues = Handler(), list[Frame](), list[Jobs]()
        self.tapped = False
        self.node = CanEndpoint(
            cast("Any", self.handler),
            lambda: self.tapped,
            cast("Any", SimpleNamespace(new_queue=self.queue)),
            lambda _node, frame: self.sent.append(frame),
            cast("Any", self.handler) if measuring else None,
        )

    def queue(self) -> Jobs:
        self.queues.append(Jobs())
        return self.queues[-1]

    def station(self, number: int = 0xF1, own: int = 7) -> tuple[StationState, Pair]:
        return self.node.pair(number, own)


@pytest.fixture
def rig() -> Rig:
    return Rig()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    now = [1000.0]
    monkeypatch.setattr(endpoint_module, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


def asked(frame: bytes, transaction: int = 5) -> EndpointRequest:
    return EndpointRequest(bytes((transaction,)) + frame, True, 77)


def test_a_node_has_address_uuid_and_longest_message_of_identify(rig: Rig) -> None:
    assert (rig.node.address, rig.node.uuid, rig.node.max_message) == (7, UUID, 1024)
    assert rig.node.claim.crc == zlib.crc32(UUID)
    assert [link_name(number) for number in (0xF1, 7)] == ["can:f1", "can:07"]


def test_an_announce_that_has_left_is_due_no_more(rig: Rig, clock: list[float]) -> None:
    rig.node.claim.start(clock[0])
    assert rig.node.claim.due(clock[0]) is not None
    rig.node.announce()
    assert rig.node.claim.due(clock[0]) is None
    assert len(rig.sent) == 1


def test_of_a_station_four_requests_wait(rig: Rig) -> None:
    state, _ = rig.station()
    for number in range(6):
        state.put(lambda number=number: rig.handler.log.append(number))
    assert state.waiting == 4
    rig.queues[0].run()
    assert rig.handler.log == [0, 1, 2, 3]


def test_a_repeated_request_is_answered_and_not_run_again(rig: Rig, clock: list[float]) -> None:
    state, _ = rig.station()
    assert state.answer(asked(WRITE)) == b"\5\1"
    assert state.answer(asked(WRITE)) == b"\5\1"
    rig.tapped = True
    assert state.answer(asked(WRITE, 6)) == b"\6\2", "another transaction is another request"
    assert rig.handler.log == [("can:f1", WRITE, False), ("can:f1", WRITE, True)]
    clock[0] += 15
    rig.node.reply_sent(state)
    clock[0] += 19.9
    assert state.answer(asked(WRITE, 6)) == b"\6\2", "20 s from when the reply left"
    clock[0] += 0.1
    assert state.answer(asked(WRITE, 6)) == b"\6\3"
    assert [state.answer(asked(LIST)) for _ in range(2)] == [b"\5\4", b"\5\5"], "what changes nothing is run each time"


def test_a_lost_link_forgets_reply_and_session(rig: Rig, clock: list[float]) -> None:
    state, _ = rig.station()
    state.answer(asked(WRITE))
    state.restart()
    assert rig.handler.log[1:] == ["lost can:f1"]
    assert state.answer(asked(WRITE)) == b"\5\3"


def test_a_measuring_node_learns_how_a_request_came_and_when_its_reply_left(clock: list[float]) -> None:
    rig = Rig(measuring=True)
    rig.tapped = True
    state, pair = rig.station()
    assert state.answer(asked(WRITE)) == b"\5m"
    state.replying = pair
    rig.node.reply_sent(state)
    assert state.replying is None
    assert rig.handler.log == [
        ("can:f1", WRITE, {"tapped": True, "fd": True, "received": 77}), "sent can:f1"
    ]  # fmt: skip


def test_an_announce_has_the_present_state_and_a_press_is_one_a_second(rig: Rig, clock: list[float]) -> None:
    crc = zlib.crc32(UUID).to_bytes(4, "big")
    rig.node.announce()
    rig.handler.state = NodeState.PROVISIONED
    rig.node.announce_press()
    clock[0] += 0.9
    rig.node.announce_press()
    clock[0] += 0.1
    rig.node.announce_press()
    first, *presses = rig.sent
    assert first.data == b"\1\1" + crc + b"\0\0"
    assert [frame.data for frame in presses] == [b"\1\2" + crc + b"\1\0"] * 2
    assert {frame.identifier & 0xFF for frame in rig.sent} == {7}
    rig.node.restart()
    rig.node.announce_press()
    assert len(rig.sent) == 4, "a node that has restarted counts anew"


def test_a_link_is_a_pair_of_addresses(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    sending: set[Pair] = set()
    monkeypatch.setattr(Pair, "sending", property(lambda pair: pair in sending))
    state, pair = rig.station()
    assert rig.station() == (state, pair)
    other, _ = rig.station(0xF2)
    assert (other is state, len(rig.queues)) == (False, 2)
    assert not rig.queues[0].jobs
    sending.add(pair)
    again, moved = rig.station(own=9)
    assert again is state
    assert moved is not pair
    assert state.pairs == {7: pair, 9: moved}, "the old one still sends"
    rig.queues[0].run()
    assert rig.handler.log == ["lost can:f1"]
    sending.clear()
    _, third = rig.station(own=11)
    assert state.pairs == {11: third}


def test_a_node_that_moves_ends_the_sessions_of_its_old_address(rig: Rig) -> None:
    state, _ = rig.station()
    other, _ = rig.station(0xF2)
    other.pairs.clear()
    rig.node.move(9)
    assert (rig.node.address, rig.handler.log) == (9, ["takes 9"])
    for queue in rig.queues:
        queue.run()
    assert rig.handler.log == ["takes 9", "lost can:f1"]
    assert state.pairs == {}
    rig.station(own=9)
    assert rig.queues[0].jobs == [], "it has started over already"


def test_a_node_that_restarts_or_loses_its_bus_has_no_station_any_more(rig: Rig) -> None:
    state, _ = rig.station()
    rig.node.move(9)
    claim = rig.node.claim
    rig.node.restart()
    assert rig.node.address == 7, "the durable one"
    assert (rig.node.claim is claim, rig.node.claim.crc) == (False, claim.crc)
    assert (rig.node.stations, state.gone) == ({}, True)
    rig.queues[0].run()
    assert rig.handler.log == ["takes 9", "lost can:f1", "lost can:f1"]
    fresh, _ = rig.station()
    assert (fresh is state, fresh.gone) == (False, False)
    rig.node.lose_stations()
    assert (rig.node.stations, fresh.gone) == ({}, True)
