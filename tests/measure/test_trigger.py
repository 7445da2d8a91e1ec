"""The station's half of a trigger, without nodes: who is armed, what leaves, whose mark is believed."""

from __future__ import annotations

import hashlib
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError, NodeSilentError
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.trigger import pull
from teds_provision.protocol.messages.frames import Command
from teds_provision.protocol.operation.stream_commands import WAITS
from teds_provision.protocol.operation.subscription import TickBounds

MS = 10**6
AHEAD = 5 * 10**12
"""Ns by which each node's tick is ahead of the host's clock, known to 0.1 ms."""


class Port:
    """A link that notes when the trigger left; ``able``: it has one."""

    def __init__(self, able: bool = True) -> None:
        self.able, self.tokens, self.at = able, list[bytes](), 0

    def trigger(self, token: bytes) -> bool:
        self.tokens.append(token)
        self.at = time.monotonic_ns()
        return self.able


class Node:
    """A supervisor and its node: ``late`` is how long after the frame it claims to have seen it, ns; None: never."""

    def __init__(self, name: str, port: Port, late: int | None = 0, **what: Any) -> None:
        self.uuid, self.late, self.port = name.encode() * 10, late, port
        self.asked: list[Command] = []
        self.refuses: Exception | None = what.get("refuses")
        self.silent: bool = what.get("silent", False)
        self.turn, self.ever_ran = threading.Lock(), what.get("ran", True)
        self.verified: Any = (
            SimpleNamespace(node=SimpleNamespace(request=self.request)) if what.get("here", 1) else None
        )
        self.bus = SimpleNamespace(place=what.get("place", "can:a"), port=port)
        self.begun: list[int] = []
        self.stopped = 0
        bounds = SimpleNamespace(ticks_at=lambda host: TickBounds(host + AHEAD - MS // 10, host + AHEAD + MS // 10))
        running = {number: SimpleNamespace(begin=self.begun.append) for number in range(what.get("streams", 1))}
        self.streams = SimpleNamespace(
            clock=bounds, mapping=threading.Lock(), running=running, tell_time=lambda _trusted: self.tell()
        )

    def request(self, command: Command, _doing: str) -> bytes:
        assert self.turn.locked(), "one exchange of a session at a time"
        self.asked.append(command)
        if self.refuses is not None:
            raise self.refuses
        return b""

    def tell(self) -> SimpleNamespace:
        assert self.turn.locked()
        if self.silent:
            raise NodeSilentError("It does not answer.")
        return SimpleNamespace(mark=0 if self.late is None else self.mark)

    @property
    def mark(self) -> int:
        return self.port.at + AHEAD + (self.late or 0)

    def stop(self) -> None:
        self.stopped += 1


def pulled(*nodes: Node, common: CommonStart | None = None) -> list[str]:
    notes: list[str] = []
    many: Any = nodes
    pull(common or CommonStart([node.uuid for node in nodes], trigger=True), many, notes.append)
    return notes


def test_each_node_that_runs_is_armed_for_half_a_minute_with_a_token_of_this_time() -> None:
    port = Port()
    nodes = [Node("a", port), Node("b", port), Node("c", port, here=0), Node("d", port, ran=False)]
    assert pulled(*nodes) == []
    (token,) = port.tokens
    payload = hashlib.sha256(b"TEDS1 trigger\0" + token).digest()[:16] + bytes([30, 1])
    armed = Command(0, 128, 17, payload)
    assert [node.asked for node in nodes] == [[armed], [armed], [], []]
    assert len(token) == 8
    pulled(*nodes)
    assert len({*port.tokens}) == 2, "a new one each time"


def test_one_frame_leaves_on_each_bus_and_streams_begin_10_ms_after_the_mark() -> None:
    here, there, over_air = Port(), Port(), Port(able=False)
    nodes = [
        Node("a", here, streams=3), Node("b", here), Node("c", there, place="can:b"),
        Node("d", over_air, place="ble:auto"),
    ]  # fmt: skip
    common = CommonStart([node.uuid for node in nodes], trigger=True)
    assert common.start(nodes[0].uuid, nodes[0].streams.clock) == WAITS
    assert pulled(*nodes, common=common) == []
    assert [len(port.tokens) for port in (here, there, over_air)] == [1, 1, 1]
    assert here.tokens == there.tokens, "the same token"
    for node, streams in zip(nodes, (3, 1, 1, 0), strict=True):
        assert node.begun == [node.mark + 10 * MS] * streams
    assert common.start(nodes[0].uuid, nodes[0].streams.clock) == 0, "who comes later begins by himself"
    assert {uuid: tick for uuid, (_, tick) in common._begun.items()} == {node.uuid: node.mark for node in nodes[:3]}


@pytest.mark.parametrize("late", [None, -1 * MS, 5000 * MS], ids=["no mark", "before the frame", "long after it"])
def test_a_node_whose_mark_is_not_the_time_of_the_frame_is_stopped_and_named(late: int | None) -> None:
    port = Port()
    liar, honest = Node("a", port, late), Node("b", port)
    (note,) = pulled(liar, honest)
    assert note == f"Node {liar.uuid.hex()} reported a different time for the trigger, so it was not started."
    assert (liar.begun, liar.stopped) == ([], 1)
    assert (honest.begun, honest.stopped) == ([honest.mark + 10 * MS], 0)


def test_a_controller_may_hold_the_frame_back_for_10_ms() -> None:
    port = Port()
    node = Node("a", port, 9 * MS)
    assert pulled(node) == []
    assert node.begun == [node.mark + 10 * MS]


def test_a_node_that_cannot_be_armed_or_asked_holds_up_no_other_one() -> None:
    port = Port()
    refusing = Node("a", port, refuses=NodeRefusedError("It is no bus.", reason=21))
    silent, honest = Node("b", port, silent=True), Node("c", port)
    notes = pulled(refusing, silent, honest)
    assert notes == [
        f"Node {refusing.uuid.hex()} did not accept the trigger: It is no bus.",
        f"Node {silent.uuid.hex()} did not report when it saw the trigger: It does not answer.",
    ]
    assert (refusing.begun, silent.begun, honest.begun) == ([], [], [honest.mark + 10 * MS])
    assert (refusing.stopped, silent.stopped) == (0, 0), "it is not known to lie"
