"""Node ticks to host time: the bound holds whatever the delays, stamps never go back, a lying clock is found."""

from __future__ import annotations

import random
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.measure.clock import (
    AT_FIRST,
    BUCKET,
    EXCHANGES,
    STEP,
    ClockMap,
    Exchange,
    HostClock,
    LowerHull,
    MonotonicStamps,
    WallClock,
)
from teds_provision.measure.running.streams import NodeStreams
from teds_provision.measure.verified_session import exchange_clock
from teds_provision.protocol.operation.stream_commands import ClockReply
from tests.pace import best_of
from tests.work import COUNTS_BLOCKS, kept_by_each_thread

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
        bounds.append(clock.line(tick, tick)[2] * 1e9)
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
    node, clock, monotone = Node(80, slowest=30_000_000), ClockMap(), MonotonicStamps()
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


@pytest.mark.parametrize("ppm", [-60, 0, 60])
def test_the_quickest_request_and_the_quickest_reply_count_not_the_mean(ppm: int) -> None:
    """A busy machine: of nine exchanges in 27 s one had a quick request, another one a quick reply."""
    node, clock = Node(ppm), ClockMap()
    chance = random.Random(7)
    for k in range(27 * 50):
        at = BOOT + SECOND + k * SECOND // 50
        if k % 150 == 0:
            there = at + (100_000 if k == 300 else chance.randrange(5_000_000, 20_000_000))
            back = there + 50_000
            came = back + (100_000 if k == 750 else chance.randrange(5_000_000, 20_000_000))
            assert clock.exchange(Exchange(at, came, node.tick(there), node.tick(back), 1000, 100)), clock.lie
        clock.arrival(node.tick(at), at + chance.randrange(3_000_000, 6_000_000))
    tick = node.tick(at)
    error = clock.host_of(tick) * 1e9 - node.host(tick)
    assert abs(error) < 500_000, f"{error / 1e6:.2f} ms"
    assert abs(error) <= clock.line(tick, tick)[2] * 1e9 + 1_000


def test_of_an_exchange_the_link_knows_when_it_left_and_came() -> None:
    """Sealing, opening and waking up are not the link's delay; a link that does not know is not asked."""

    class Link:
        left = came = 7.0  # of another exchange

    def ask(link: object, left: float, came: float) -> Exchange:
        def send(*_: object) -> bytes:
            if isinstance(link, Link):
                assert (link.left, link.came) == (0.0, 0.0), "they are asked of this exchange alone"
                link.left, link.came = left, came
            return ClockReply(SECOND, SECOND + 1000, 0, 1, 20, 0).encode()

        kept: list[Exchange] = []
        clock = SimpleNamespace(exchange=kept.append)
        node = SimpleNamespace(contact=SimpleNamespace(link=link), request=send)
        exchange_clock(node, clock)  # type: ignore[arg-type]  # what it asks of a conversation and of a clock
        return kept[0]

    exchange = ask(Link(), 77.000001, 77.000102)
    assert (exchange.asked, exchange.answered) == (77_000_001_000, 77_000_102_000)
    for link in (Link(), object()):
        before = time.monotonic_ns()
        own = ask(link, 77.0, 0.0)
        assert before <= own.asked <= own.answered <= time.monotonic_ns()


def test_streams_of_a_clock_that_always_lies_have_the_time_of_their_arrival() -> None:
    """Not that of the node's start, hours ago, until a hull of arrivals stands."""
    streams = NodeStreams(WallClock.now(), lambda _block: None)
    sent = 10 * 3600 * SECOND  # its tick
    lying = ClockReply(sent + 1, sent, 0, 1, 20, 0).encode()
    node = SimpleNamespace(contact=SimpleNamespace(link=object()), request=lambda *_: lying)
    streams.tell_time(SimpleNamespace(node=node))  # type: ignore[arg-type]  # what it asks of a conversation
    assert "before it received" in streams.clock.lie
    assert streams.clock.host_of(sent) == pytest.approx(time.monotonic(), abs=10)


def test_a_clock_that_lies_is_found() -> None:
    node = Node(0)
    honest = node.exchange(BOOT + SECOND)
    later = node.exchange(BOOT + 4 * SECOND)

    def lie(*exchanges: Exchange) -> str:
        clock = ClockMap()
        for exchange in exchanges:
            clock.exchange(exchange)
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


def test_a_clock_that_only_ever_lied_is_stamped_by_when_it_said_so() -> None:
    """Nothing was known of it, and its samples were stamped with the time at which the node had started."""
    node, clock = Node(0), ClockMap()
    exchange = node.exchange(BOOT + SECOND)
    clock.exchange(replace(exchange, sent=exchange.received - 1))
    assert "before it received" in clock.lie
    assert not clock.known
    assert abs(clock.host_of(exchange.received) - (BOOT + SECOND) / 1e9) < 1
    clock = ClockMap()
    clock.exchange(replace(exchange, received=2**64 - 2, sent=2**64 - 1))
    assert "centuries" in clock.lie


def test_a_delayed_reply_widens_the_bound_and_moves_nothing_beyond_it() -> None:
    node, clock = Node(0), ClockMap()
    exchange = node.exchange(BOOT + SECOND)
    clock.exchange(replace(exchange, answered=exchange.answered + SECOND))
    tick = node.tick(BOOT + SECOND)
    error = abs(float(clock.host(np.array([tick], dtype=np.uint64))[0]) - (BOOT + SECOND) / 1e9)
    assert 0.4 < clock.line(tick, tick)[2] < 0.6
    assert error <= clock.line(tick, tick)[2]


def test_a_reply_cannot_have_taken_longer_than_the_exchange() -> None:
    """operation.md section 5: sent - received > d - a lies; its own drift and the steps of its clock are borne."""
    asked, seconds, step, drift = BOOT + SECOND, 10_000_000, 1_000, 100
    most = round(seconds * (1 + drift / 1e6)) + 2 * step
    for inside, lies in (
        (seconds, False),
        (most, False),
        (most + 10, True),
        (seconds * 3 // 2, True),
        (2 * seconds, True),
    ):
        clock = ClockMap()
        exchange = Exchange(asked, asked + seconds, SECOND, SECOND + inside, step, drift)
        assert clock.exchange(exchange) is not lies, inside
        assert ("took longer" in clock.lie) is lies


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
    def off() -> float:
        return float(abs(WallClock.now().unix(np.array([time.monotonic()]))[0] - time.time()))

    best_of(3, 0.5, off)


def test_a_clock_that_turns_out_worse_than_it_said_is_judged_anew_and_no_liar() -> None:
    """What was known of it before held for the drift that it reported then."""
    node, clock = Node(3000), ClockMap()
    assert clock.exchange(node.exchange(BOOT + SECOND))
    clock.arrival(node.tick(BOOT + 11 * SECOND), BOOT + 11 * SECOND + node.delay())
    worse = replace(node.exchange(BOOT + 11 * SECOND + SECOND // 10), drift=5000)
    assert clock.exchange(worse), clock.lie
    assert clock.lie == ""


_EXCHANGES = """
from teds_provision.measure.clock import ClockMap, Exchange

def begin():
    clock, ticks = ClockMap(), iter(range(0, 10**13, 13 * 10**9))
    def act():
        tick = next(ticks)
        assert clock.exchange(Exchange(tick, tick + 2_000_000, tick + 300_000, tick + 900_000, 1000, 50)), clock.lie
    return act
"""


@pytest.mark.slow
@pytest.mark.skipif(not COUNTS_BLOCKS, reason="the C library does not count its blocks")
def test_exchanges_leave_nothing_in_the_cache_of_each_nodes_thread() -> None:
    """The fit of n exchanges took arrays of n numbers: blocks of each size stayed with each thread, 10 kB a node."""
    assert kept_by_each_thread(_EXCHANGES, first=10, rounds=EXCHANGES + 10) < 3000


def test_of_another_streams_older_bucket_nothing_is_added_to_the_hull() -> None:
    """A corner behind the last one would turn the hull, and with it the skew, upside down."""
    hull = LowerHull()
    assert hull.add_arrival(3 * BUCKET, 900)
    assert not hull.add_arrival(3 * BUCKET + 1, 800), "the best of its bucket stands for it"
    assert not hull.add_arrival(2 * BUCKET, 100)
    assert hull.points() == [(3 * BUCKET + 1, 800)]
    assert not hull.add_arrival(3 * BUCKET, 700), "a little older, and of the same bucket"
    assert hull.points() == [(3 * BUCKET, 700)]
    assert not hull.add_arrival(3 * BUCKET + 2, 701), "it came later after its samples than the best one"
    assert hull.points() == [(3 * BUCKET, 700)]
    assert not hull.add_arrival(2**63, 1), "292 years after the start of a node"
    assert hull.points() == [(3 * BUCKET, 700)]


def test_a_clock_that_is_followed_anew_is_apart_from_the_systems_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    now = WallClock(100.0)
    monkeypatch.setattr(WallClock, "now", lambda _readings=9: now)
    host = HostClock()
    now = WallClock(100.0 + STEP / 2)
    assert not host.was_set()
    assert host.apart == pytest.approx(STEP / 2), "it belongs to the bound of each stamp"
    now = WallClock(200.0)
    assert host.was_set()
    assert host.set_anew() == pytest.approx(100.0)
    assert host.apart == 0.0


def test_the_exchanges_of_a_clock_take_their_memory_at_once() -> None:
    node, clock = Node(20.0), ClockMap()

    def octets() -> int:
        return sum(sys.getsizeof(column) for column in (clock._ticks, clock._offsets, clock._errors))

    before = octets()
    for number in range(2 * EXCHANGES):
        assert clock.exchange(node.exchange(BOOT + (1 + number) * SECOND)), clock.lie
    assert octets() == before < 2000


def test_the_wall_clock_is_the_narrowest_of_some_readings_and_a_step_is_seen_by_two(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One reading that was interrupted between the two clocks is no clock that was set."""
    monotonic = iter([0, 2_000_000, 10_000_000, 10_000_400, 20_000_000, 21_000_000])
    wall = iter([1_001_000_000, 1_010_000_300, 1_020_500_000])
    reading = SimpleNamespace(monotonic_ns=lambda: next(monotonic), time_ns=lambda: next(wall))
    with monkeypatch.context() as patch:
        patch.setattr("teds_provision.measure.clock.time", reading)
        found = WallClock.now(3)
    assert (found.offset, found.error) == pytest.approx((1.0000001, 200e-9))
    host, asked = HostClock(WallClock(1.0)), list[int]()
    for offsets, was_set in (({1: 1.0}, False), ({1: 9.0, 9: 1.0}, False), ({1: 9.0, 9: 9.0}, True)):
        asked.clear()

        def now(readings: int = 9, offsets: dict[int, float] = offsets) -> WallClock:
            asked.append(readings)
            return WallClock(offsets[readings])

        monkeypatch.setattr(WallClock, "now", now)
        assert host.was_set() is was_set
        assert asked == list(offsets)


def test_the_line_of_a_block_is_that_of_the_map_while_a_refit_is_phased_in() -> None:
    """Over the second after a refit its difference fades: begin and slope of a line follow that, to the nanosecond."""
    clock = ClockMap()
    clock.exchange(Exchange(10**9, 10**9 + 2000, 500, 1500, 1, 20))
    clock.host_of(10**6)
    clock._residue, clock._refitted = 40_000.0, 2 * 10**9  # 40 us, as after a refit
    for first in (2 * 10**9 - 5, 2 * 10**9, 2 * 10**9 + 5 * 10**8, 3 * 10**9 - 1, 3 * 10**9, 4 * 10**9):
        begin, rate, _ = clock.line(first, first + 1000)
        assert begin / 1e9 == pytest.approx(clock.host_of(first), abs=2e-9)
        slews = 2 * 10**9 <= first < 3 * 10**9
        assert rate - 1.0 == pytest.approx(-40e-6 if slews else 0.0, abs=1e-9), first


def test_stamps_of_a_line_are_held_back_only_where_they_would_go_back() -> None:
    stamps = MonotonicStamps()
    for times, held in (
        ([1.0, 2.0], [1.0, 2.0]), ([1.5, 2.5], [2.0, 2.5]), ([2.5], [2.5]), ([4.0, 3.0], [4.0, 4.0]), ([3.5], [4.0]),
        ([4.5], [4.5]),
    ):  # fmt: skip
        assert stamps.stamp_line(np.array(times)).tolist() == held


def test_what_was_stamped_before_the_clock_was_set_is_moved_by_the_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    host = HostClock(WallClock(1000.0))
    monkeypatch.setattr(WallClock, "now", lambda readings=9: WallClock(1060.0))
    assert host.set_anew() == 60.0
    monkeypatch.setattr(WallClock, "now", lambda readings=9: WallClock(1050.0))
    assert host.set_anew() == -10.0
    assert [host.since(number) for number in (0, 1, 2)] == [50.0, -10.0, 0.0]
    assert host.present == (2, 1050.0)


def test_a_lie_of_any_kind_moves_no_stamp_that_has_evidence() -> None:
    node, clock = Node(0), ClockMap()
    assert clock.exchange(node.exchange(BOOT + SECOND))
    before = clock.host_of(3 * SECOND)
    later = node.exchange(BOOT + 2 * SECOND)
    for sent in (later.received - 1, later.received + SECOND):
        assert not clock.exchange(replace(later, sent=sent))
        assert clock.host_of(3 * SECOND) == before


def test_without_evidence_the_nodes_last_tick_is_when_its_reply_was_whole() -> None:
    clock = ClockMap()
    assert not clock.exchange(Exchange(BOOT, BOOT + 3 * SECOND, 2 * SECOND, SECOND, 0, 0))
    assert clock.host_of(SECOND) == (BOOT + 3 * SECOND) / 1e9


@pytest.mark.parametrize(("drift", "ppm"), [(0, 150), (100, 150), (110, 160), (5000, 5050)])
def test_a_bound_grows_by_the_drift_of_both_clocks_and_by_no_less_than_was_assumed(drift: int, ppm: int) -> None:
    clock = ClockMap()
    assert clock.exchange(Exchange(BOOT, BOOT, SECOND, SECOND, 0, drift))
    first, last = (clock.lead_bounds(BOOT + seconds * SECOND) for seconds in (1, 11))
    grown = (last.high - last.low) - (first.high - first.low)
    assert grown == pytest.approx(2 * 10 * SECOND * ppm / 1e6, abs=10)


def test_a_clock_without_resolution_replies_in_the_tick_of_the_request_and_none_is_292_years_old() -> None:
    for sent, lies in ((SECOND, False), (2**63 - 1, False), (2**63, True)):
        clock = ClockMap()
        assert clock.exchange(Exchange(BOOT, BOOT, sent, sent, 0, 0)) is not lies
        assert ("centuries" in clock.lie) is lies


def test_the_bound_of_a_line_is_that_of_its_end_which_is_farther_from_the_evidence() -> None:
    clock = ClockMap()
    assert clock.exchange(Exchange(BOOT, BOOT, 100 * SECOND, 100 * SECOND, 0, 100))
    for first, last, seconds in ((100, 110, 10), (90, 100, 10), (95, 120, 20), (80, 105, 20)):
        assert clock.line(first * SECOND, last * SECOND)[2] == pytest.approx(150e-6 * seconds)
    for skew in (1e-4, -1e-4):
        clock._skew = skew
        assert clock.line(100 * SECOND, 110 * SECOND)[2] == pytest.approx(250e-6 * 10), "a line may fall as well"
