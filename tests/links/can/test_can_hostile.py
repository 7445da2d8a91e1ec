"""A node, or anybody at its address, that keeps to no rule of ISO-TP: the station neither hangs nor grows."""

from __future__ import annotations

import itertools
import math
import threading
import time
from collections.abc import Callable
from queue import Empty
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, NodeSilentError
from teds_provision.links.can import link as link_module
from teds_provision.links.can.port import CanPort
from tests.links.can.hub import Hub

pytestmark = pytest.mark.link
TO_US, FROM_US = 0x18DAF121, 0x18DA21F1
CONTINUE, WAIT = bytes.fromhex("300100cccccccccc"), bytes.fromhex("311000cccccccccc")
LONG = b"\x00\x00\x01\x03\x00\x64" + bytes(100)
ANNOUNCE = 0x1CFF0021


def answering(hub: Hub, answer: Callable[[int], None]) -> threading.Event:
    """Calls ``answer`` with the number of frames that came from the station, every 20 ms, until the event is set."""
    stop = threading.Event()

    def run() -> None:
        while not stop.wait(0.02):
            answer(sum(identifier == FROM_US for identifier, _ in list(hub.frames)))

    threading.Thread(target=run, daemon=True).start()
    return stop


def test_unexpected_flow_controls_do_not_pile_up(hub: Hub) -> None:
    port = CanPort(hub.spec)
    try:
        with port.listen_frames(lambda frame: frame.identifier == ANNOUNCE) as ear:
            for number in range(500):
                hub.send(TO_US, bytes([0x30 + number % 3]) + WAIT[1:])
            hub.send(ANNOUNCE, bytes(8))
            assert ear.get(60) is not None, "all frames before it were read"
        assert port.bus().address_pair(0x21).flows.empty()
    finally:
        port.close()


@pytest.mark.parametrize(("after", "goes_on"), [(0.9, True), (1.1, False)])
def test_a_wait_gives_the_node_one_more_second(monkeypatch: pytest.MonkeyPatch, after: float, goes_on: bool) -> None:
    """Also where less than that was left for its flow control."""
    clock, coming = [100.0], [(0.4, WAIT), (after, CONTINUE)]

    def next_of(_flows: object, seconds: float) -> bytes:
        comes, data = coming.pop(0)
        clock[0] += min(comes, seconds)
        if comes > seconds:
            raise Empty
        return data

    monkeypatch.setattr(link_module, "time", SimpleNamespace(monotonic=lambda: clock[0]))
    bus: Any = SimpleNamespace(spec=SimpleNamespace(fd=False), next_of=next_of)
    line: Any = SimpleNamespace(flows=None, node=0x21)
    exchange = link_module._Exchange(bus, line, LONG, 1, 5.0, prompt=False, hopeless=lambda: False)
    if goes_on:
        assert exchange._flow(0.5, math.inf, begun=True)[0] == 1
    else:
        with pytest.raises(link_module._NoFlowControlError):
            exchange._flow(0.5, math.inf, begun=True)


def test_a_node_that_says_wait_for_ever_is_given_up(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each Wait had begun the time anew, for two minutes before each block."""
    monkeypatch.setattr(link_module, "REPEAT_SECONDS", 0.6)
    port = CanPort(hub.spec)
    stop = answering(hub, lambda sent: hub.send(TO_US, WAIT) if sent else None)
    began = time.monotonic()
    try:
        with pytest.raises(NodeSilentError):
            port.link(0x21).exchange(LONG)
    finally:
        stop.set()
        port.close()
    assert time.monotonic() - began < 60


def test_a_node_that_takes_a_frame_and_waits_again_is_given_up(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound was one for each block: of 4,094 octets in blocks of one frame that is a day."""
    monkeypatch.setattr(link_module, "REPEAT_SECONDS", 0.6)
    monkeypatch.setattr(link_module, "_LONGEST_TRY", 1.0)
    port = CanPort(hub.spec)
    turns = itertools.count()
    stop = answering(hub, lambda sent: hub.send(TO_US, WAIT if next(turns) % 15 else CONTINUE) if sent else None)
    try:
        with pytest.raises(LinkError):
            port.link(0x21).exchange(LONG)
    finally:
        stop.set()
        port.close()
    taken = sum(identifier == FROM_US and data[0] >> 4 == 2 for identifier, data in list(hub.frames))
    assert 0 < taken < 14, "15 frames at one in 0.3 s are beyond the bound of a try"
