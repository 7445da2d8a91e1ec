"""The real-time loop: calls in time, a wake at once, one faulty node harms no other."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import pytest

from teds_provision.errors import LinkError
from teds_provision.node.realtime_loop import RealtimeLoop


class Node:
    def __init__(self, wait: Callable[[int], float | None]) -> None:
        self.wait, self.beats, self.came = wait, [], threading.Event()

    def beat(self) -> float | None:
        self.beats.append(time.monotonic())
        self.came.set()
        return self.wait(len(self.beats))


def test_nodes_are_called_when_they_want_to_be() -> None:
    pulse = RealtimeLoop()
    quick, slow = Node(lambda n: 0.01), Node(lambda n: 0.05 if n < 3 else None)
    began = time.monotonic()
    for node in (quick, slow):
        pulse.wake(node)
    pulse.start()
    try:
        until = began + 10
        while len(slow.beats) < 3 or len(quick.beats) < 10:
            assert time.monotonic() < until
            time.sleep(0.005)
    finally:
        pulse.stop()
    assert slow.beats[2] - slow.beats[0] >= 0.1
    assert len(slow.beats) == 3
    assert quick.beats[9] - quick.beats[0] >= 0.09


def test_a_node_that_rests_is_woken_and_a_faulty_one_harms_none() -> None:
    pulse, resting = RealtimeLoop(), Node(lambda n: None)

    def fails(n: int) -> float | None:
        raise ValueError

    faulty = Node(fails)
    pulse.start()
    try:
        for node in (faulty, resting):
            pulse.wake(node)
            assert node.came.wait(60)
        resting.came.clear()
        pulse.wake(resting)
        assert resting.came.wait(60)
        assert len(resting.beats) == 2
    finally:
        pulse.stop()


def test_a_wake_during_a_beat_is_not_lost() -> None:
    pulse = RealtimeLoop()
    again = threading.Event()

    class WakingNode(Node):
        def beat(self) -> float | None:
            if len(self.beats) == 0:
                pulse.wake(self)
            else:
                again.set()
            return super().beat()

    node = WakingNode(lambda n: 3600.0)
    pulse.start()
    try:
        pulse.wake(node)
        assert again.wait(60)
    finally:
        pulse.stop()


@pytest.mark.parametrize(
    ("failure", "logged"), [(LinkError("The bus is lost."), []), (ValueError("x"), ["A node's measuring failed."])]
)
def test_a_node_that_fails_rests_until_it_is_woken(
    failure: Exception, logged: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    """A lost bus is the matter of the thread that reads it."""
    pulse, beats = RealtimeLoop(), list[str]()

    class Failing:
        def beat(self) -> float | None:
            beats.append("beat")
            raise failure

    class Last:
        def beat(self) -> float | None:
            pulse.stop()
            return None

    pulse.wake(Failing())
    pulse.wake(Last())
    pulse._run()
    assert (beats, caplog.messages) == (["beat"], logged)
    assert pulse._due == {}


def test_a_node_that_is_late_already_is_called_again_at_once() -> None:
    pulse = RealtimeLoop()
    waits = [0.0, 0.0, None]
    beats: list[int] = []

    class Late:
        def beat(self) -> float | None:
            beats.append(len(beats))
            wait = waits.pop(0)
            if wait is None:
                pulse.stop()
            elif len(beats) > 5:
                raise AssertionError
            return wait

    class Last:
        """It ends the loop if nothing else does."""

        def beat(self) -> float | None:
            if not pulse._heap:
                pulse.stop()
            return None

    pulse.wake(Late())
    pulse.wake(Last())
    pulse._run()
    assert beats == [0, 1, 2]
