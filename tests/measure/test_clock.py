"""Node ticks to host time: the bound holds whatever the delays, stamps never go back, a lying clock is found."""

from __future__ import annotations

import random
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.measure.clock import AT_FIRST, ClockMap, Exchange, Monotone, Wall

SECOND = 1_000_000_000
BOOT = 77 * SECOND  # host time at the node's tick 0


class Node:
    """A node's clock that is off by some ppm, behind a link with random delays; host time in ns."""

    def __init__(self, ppm: float, seed: int = 1, slowest: int = 2_000_000) -> None:
        self.ppm, self.random, self.slowest = ppm, random.Random(seed), slowest

    def tick(self, host: int) -> int:
        return round((host - BOOT) * (1 + self.ppm / 1e6))

    def host(self, tick: int) -> float:
        return BOOT + tick / (1 + self.ppm / 1e6)

    def delay(self) -> int:
        return 20_000 + round(self.slowest * self.random.random() ** 6)

    def exchange(self, at: int) -> Exchange:
        there, back = at + self.delay(), 0
        back = there + 50_000
        return Exchange(at, back + self.delay(), self.tick(there), self.tick(back), 1000, 100)


def run(
    node: Node, seconds: int, *, exchanges: bool = True, rate: int = 100
) -> tuple[list[float], list[float], ClockMap]:
    """Errors against the truth and bounds (ns) of one sample each period, as a station would map them."""
    clock = ClockMap()
    errors, bounds = [], []
    for k in range(AT_FIRST if exchanges else 0):
        assert clock.exchange(node.exchange(BOOT + SECOND // 2 + k * SECOND // 100)), clock.lie
    for k in range(seconds * rate):
        taken = BOOT + SECOND + k * SECOND // rate
        if exchanges and k % (3 * rate + rate // 3) == 0:
            assert clock.exchange(node.exchange(taken)), clock.lie
        tick = node.tick(taken)
        clock.arrival(tick, taken + node.delay())
        errors.append(float(clock.host(np.array([tick], dtype=np.uint64))[0]) * 1e9 - node.host(tick))
        bounds.append(clock.bound(tick) * 1e9)
    return errors, bounds, clock


@pytest.mark.parametrize("ppm", [-80, 0, 30, 99])
def test_stamps_are_right_within_a_millisecond_and_within_their_bound(ppm: int) -> None:
    errors, bounds, clock = run(Node(ppm), 40)
    assert np.percentile(np.abs(errors[500:]), 99) < 100_000, "100 µs, with delays of up to 2 ms"
    assert all(abs(error) <= bound + 1_000 for error, bound in zip(errors, bounds, strict=True))
    assert np.median(bounds) < 1_500_000
    assert not clock.lie


@pytest.mark.parametrize("ppm", [-80, 30])
def test_without_a_clock_command_the_lower_hull_follows_the_skew(ppm: int) -> None:
    errors, bounds, _ = run(Node(ppm), 40, exchanges=False)
    assert np.percentile(np.abs(errors[1000:]), 99) < 300_000
    assert all(bound == np.inf for bound in bounds), "nothing bounds it from below"


@given(st.integers(-100, 100), st.integers(0, 10**6), st.integers(0, 200_000_000))
@settings(max_examples=15)
def test_the_bound_holds_whatever_the_link_does(ppm: int, seed: int, slowest: int) -> None:
    errors, bounds, clock = run(Node(ppm, seed, slowest), 10, rate=20)
    assert not clock.lie
    assert all(abs(error) <= bound + 1_000 for error, bound in zip(errors, bounds, strict=True))


def test_stamps_of_a_stream_never_go_back_and_a_refit_does_not_step() -> None:
    node, clock, monotone = Node(80, slowest=30_000_000), ClockMap(), Monotone()
    stamps = []
    for k in range(3000):
        taken = BOOT + SECOND + k * SECOND // 100
        if k % 50 == 0:
            clock.exchange(node.exchange(taken))
        tick = node.tick(taken)
        clock.arrival(tick, taken + node.delay())
        stamps.append(float(clock.host(np.array([tick], dtype=np.uint64))[0]))
    steps = np.diff(stamps)
    assert steps.min() > 0
    assert np.abs(steps - 0.01).max() < 0.001, "let out over a second, not at once"
    assert monotone(np.array([1.0, 3.0, 2.0])).tolist() == [1.0, 3.0, 3.0]
    assert monotone(np.array([2.5, 4.0])).tolist() == [3.0, 4.0]


def test_a_clock_that_lies_is_found() -> None:
    node = Node(0)
    honest = node.exchange(BOOT + SECOND)
    later = node.exchange(BOOT + 4 * SECOND)

    def lie(*exchanges: Exchange) -> str:
        clock = ClockMap()
        for one in exchanges:
            clock.exchange(one)
        return clock.lie

    assert lie(honest, later) == ""
    assert "before it received" in lie(replace(honest, sent=honest.received - 1))
    assert "longer" in lie(replace(honest, sent=honest.received + SECOND))
    jumped = replace(later, received=later.received + SECOND, sent=later.sent + SECOND)
    assert "contradict" in lie(honest, jumped)


def test_a_lie_moves_no_stamp() -> None:
    node, clock = Node(0), ClockMap()
    clock.exchange(node.exchange(BOOT + SECOND))
    ticks = np.array([3 * SECOND], dtype=np.uint64)
    before = clock.host(ticks)
    later = node.exchange(BOOT + 2 * SECOND)
    clock.exchange(replace(later, received=later.received + SECOND, sent=later.sent + SECOND))
    assert clock.host(ticks) == before


def test_a_delayed_reply_widens_the_bound_and_moves_nothing_beyond_it() -> None:
    node, clock = Node(0), ClockMap()
    one = node.exchange(BOOT + SECOND)
    clock.exchange(replace(one, answered=one.answered + SECOND))
    tick = node.tick(BOOT + SECOND)
    error = abs(float(clock.host(np.array([tick], dtype=np.uint64))[0]) - (BOOT + SECOND) / 1e9)
    assert 0.4 < clock.bound(tick) < 0.6
    assert error <= clock.bound(tick)


def test_ticks_of_years_keep_their_microseconds() -> None:
    clock = ClockMap()
    year = 365 * 86400 * SECOND
    clock.exchange(Exchange(SECOND, SECOND + 2000, 20 * year, 20 * year + 1000, 1, 100))
    stamps = clock.host(np.array([20 * year + k * 1000 for k in range(5)], dtype=np.uint64))
    np.testing.assert_allclose(np.diff(stamps), 1e-6, atol=1e-8)


def test_the_present_tick_is_the_inverse_of_the_map() -> None:
    _, _, clock = run(Node(60), 20)
    host = BOOT + 21 * SECOND
    tick = clock.tick_at(host)
    assert abs(float(clock.host(np.array([tick], dtype=np.uint64))[0]) * 1e9 - host) < 2_000


def test_wall_time_is_read_once() -> None:
    import time

    assert abs(Wall.now().unix(np.array([time.monotonic()]))[0] - time.time()) < 0.5
