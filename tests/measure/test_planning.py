"""How a node's channels become streams: by period and kind, cut evenly, slowed down together if too many."""

from __future__ import annotations

import math
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NoRoomError, PolicyError
from teds_provision.links.ble.airtime import BleAirtime
from teds_provision.links.can.airtime import CanAirtime
from teds_provision.measure import planning
from teds_provision.measure.planning import BusTime, NodePlans, period_of, plan_node, sensors_of
from teds_provision.protocol.operation.budget import MOST_LOAD
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.protocol.operation.subscription import most_instants
from teds_provision.teds.channel import Channel, ChannelKind, SampleForm, Timing

BUS = BusTime(CanAirtime(1_000_000))


def channels(*periods: float, first: int = 1, kind: ChannelKind = ChannelKind.SENSOR) -> list[Channel]:
    """Return a channel of two octets for each sampling period in seconds."""
    form = SampleForm(0, 2, 16)
    return [
        Channel(number, kind=kind, sample=form, timing=Timing(period=period))
        for number, period in enumerate(periods, first)
    ]


def shape(plans: NodePlans) -> list[tuple[tuple[int, ...], float]]:
    """Return the channels of each stream, and its rate in Hz."""
    return [(plan.layout.channels, 1e9 / plan.subscribe.period) for plan in plans.streams]


def planned(
    every: Sequence[Channel], **settings: float | bool | StreamKind | None
) -> list[tuple[tuple[int, ...], float]]:
    return shape(plan_node(every, BUS, **settings))  # type: ignore[arg-type]


def test_channels_of_one_period_share_a_stream_and_more_than_sixteen_are_cut_evenly() -> None:
    assert planned(channels(0.1, 0.01, 0.1)) == [((1, 3), 10.0), ((2,), 100.0)]
    assert [len(numbers) for numbers, _ in planned(channels(*[0.1] * 25))] == [13, 12]
    assert [len(numbers) for numbers, _ in planned(channels(*[0.1] * 32))] == [16, 16]


def test_more_than_four_streams_are_put_together_at_the_slowest_period_and_events_stay() -> None:
    assert planned(channels(0.1, 0.2, 0.3, 0.4)) == [((1,), 10.0), ((2,), 5.0), ((3,), 1e9 / 3e8), ((4,), 2.5)]
    together = planned(channels(0.1, 0.2, 0.05, 0.4, 0.25))
    assert together == [((1, 2, 3, 4, 5), 2.5)], "what is asked of a sensor is never more than it can"
    events = channels(1.0, first=6, kind=ChannelKind.EVENT_SENSOR)
    assert planned([*channels(0.1, 0.2, 0.05, 0.4), *events]) == [((1, 2, 3, 4), 2.5), ((6,), 1.0)]
    assert planned(channels(1.0, 1.0, first=6, kind=ChannelKind.EVENT_SENSOR)) == [((6,), 1.0), ((7,), 1.0)], "n = 1"
    with pytest.raises(PolicyError, match="70 channels need 5 streams; a node has 4"):
        planned(channels(*[0.1] * 70))


@pytest.mark.parametrize(
    ("period", "rate", "at_most", "ns"),
    [
        (0.01, None, False, 10_000_000),
        (0.01, 50.0, False, 20_000_000),
        (0.01, 100.0, False, 10_000_000),
        (0.01, 50.0, True, 20_000_000),
        (0.01, 200.0, True, 10_000_000),
        (math.nan, None, False, 100_000_000),
        (0.0, None, False, 100_000_000),
        (-1.0, 50.0, False, 20_000_000),
        (math.inf, None, True, 100_000_000),
        (1e6, None, False, 10**12),
        (math.nan, 1e-4, False, 10**12),
    ],
)
def test_a_period_is_that_of_the_rate_and_never_shorter_than_the_datasheets(
    period: float, rate: float | None, at_most: bool, ns: int
) -> None:
    [channel] = channels(period)
    assert period_of(channel, rate, at_most=at_most) == ns


def test_a_rate_above_the_datasheets_is_refused_with_the_fastest() -> None:
    [channel] = channels(0.01)
    with pytest.raises(PolicyError, match="gives at most 100 samples a second") as refused:
        period_of(channel, 100.1)
    assert refused.value.hint == "Use --rate 100"
    assert period_of(channel, 100.0 * (1 + 5e-7)) == 10_000_000 - 5, "a Float32 states no period more exactly"


def test_a_rate_that_does_not_fit_is_refused_and_the_datasheets_is_slowed_with_the_reason() -> None:
    fast = channels(2e-5, 2e-5)
    slowed = plan_node(fast, BUS)
    [(_, rate)] = shape(slowed)
    assert slowed.slowed == f"slowed from 50000 Hz to {rate:.6g} Hz: the bus does not allow more"
    assert 0.5 * MOST_LOAD < slowed.load <= MOST_LOAD
    with pytest.raises(NoRoomError, match=r"50000 Hz does not fit the bus \(60% of it for data\)") as refused:
        plan_node(fast, BUS, rate=50_000.0)
    assert refused.value.hint == f"The maximum is --rate {rate:.6g}"
    for slower in (1.0, 2.0, 1.5, 7 / 3):
        [stream] = plan_node(channels(0.01), BUS, slower=slower).streams
        assert (stream.subscribe.period, type(stream.subscribe.period)) == (round(10_000_000 * slower), int)
    halved = plan_node(channels(0.01), BUS, slower=2.0)
    assert halved.slowed == "slowed from 100 Hz to 50 Hz: the node allows no shorter period"
    with pytest.raises(NoRoomError, match="no capacity left"):
        plan_node(fast, BusTime(CanAirtime(1_000_000), taken=MOST_LOAD))


def test_messages_hold_twenty_milliseconds_and_more_where_the_bus_is_short_of_room() -> None:
    [usual] = plan_node(channels(0.001), BUS).streams
    assert usual.subscribe.n == 20
    [slow] = plan_node(channels(0.1), BUS).streams
    assert slow.subscribe.n == 1
    [fuller] = plan_node(channels(0.001), BusTime(CanAirtime(50_000))).streams
    assert fuller.subscribe.n > 20
    [full] = plan_node(channels(0.001), BusTime(CanAirtime(50_000)), start=7, test_pattern=True).streams
    assert (full.subscribe.n, full.subscribe.start, full.subscribe.test_pattern) == (fuller.subscribe.n, 7, True)
    [event] = plan_node(channels(0.001, kind=ChannelKind.EVENT_SENSOR), BUS).streams
    assert (event.subscribe.n, event.subscribe.kind) == (1, StreamKind.EVENT)


def test_the_sensors_that_are_measured_are_those_that_were_asked_for_in_their_order() -> None:
    every = [*channels(0.1, 0.1), *channels(0.1, first=3, kind=ChannelKind.EVENT_SENSOR)]
    every += channels(0.1, first=4, kind=ChannelKind.ACTUATOR)
    assert [channel.number for channel in sensors_of(every, (), None)] == [1, 2, 3]
    assert [channel.number for channel in sensors_of(every, (3, 1, 3), None)] == [3, 1]
    assert [channel.number for channel in sensors_of(every, (), StreamKind.EVENT)] == [3]
    assert [channel.number for channel in sensors_of(every, (), StreamKind.FREE)] == [1, 2]
    every.append(Channel(5, kind=ChannelKind.SENSOR, timing=Timing(period=0.1)))
    assert [channel.number for channel in sensors_of(every, (), None)] == [1, 2, 3], "5 has no form of a sample"
    for wanted, kind in (((4,), None), ((5,), None), ((3,), StreamKind.PERIODIC), ((9,), None)):
        with pytest.raises(BadDataError, match="is not a sensor that can be measured this way"):
            sensors_of(every, wanted, kind)
    with pytest.raises(BadDataError, match="no sensor"):
        sensors_of(every[3:], (), None)


def test_frames_of_a_node_are_spread_over_half_of_its_own_time_but_two_milliseconds_at_most() -> None:
    """The other half is left to commands; a gap of 0 would be none."""
    gaps = {}
    for period in (0.1, 0.001, 0.0002):
        [plan] = plan_node(channels(*[period] * 8), BUS).streams
        frames = BUS.airtime.frames(plan.length) / (plan.subscribe.n * plan.subscribe.period / 1e9)
        gaps[period] = plan.subscribe.gap, round(0.5e6 / frames)
    assert gaps[0.1][0] == 2000
    for period in (0.001, 0.0002):
        gap, half = gaps[period]
        assert 0.98 * half - 1 <= gap <= half, gaps


def test_a_plan_says_by_how_much_it_was_slowed_and_a_part_of_a_millionth_is_nothing() -> None:
    assert plan_node(channels(0.01), BUS, slower=1.0000005).slowed == ""
    assert plan_node(channels(0.01), BUS, slower=1.000002).slowed.startswith("slowed from 100 Hz to 99.9998 Hz")
    both = plan_node(channels(0.1, 0.01), BUS, slower=2.0)
    assert both.periods() == {1: 0.2, 2: 0.02}
    assert both.slowed == "slowed from 100 Hz to 50 Hz: the node allows no shorter period", "of the quickest channel"


def test_a_message_holds_a_sample_at_least_and_a_sample_that_fits_none_is_refused() -> None:
    long = [Channel(1, kind=ChannelKind.SENSOR, sample=SampleForm(10, 5000, 0), timing=Timing(period=0.1))]
    with pytest.raises(BadDataError, match="One sample of channels 1 does not fit into a message"):
        plan_node(long, BUS)
    [plan] = plan_node(channels(0.1), BUS, kind=StreamKind.FREE, test_pattern=True, start=7).streams
    asked = plan.subscribe
    assert (asked.n, asked.kind, asked.test_pattern, asked.start) == (1, StreamKind.FREE, True, 7)


@pytest.mark.parametrize(
    ("mtu", "octets", "periodic", "event"), [(247, 240, 113, 1), (244, 240, 113, 1), (243, 239, 113, 1), (23, 19, 3, 0)]
)
def test_over_the_air_a_message_is_one_notification_of_mtu_less_4_octets_and_of_240_at_most(
    mtu: int, octets: int, periodic: int, event: int
) -> None:
    """operation.md section 6, data sets of 2 octets: 113 of them at an MTU of 247, 3 at 23, where no event fits."""
    air = BleAirtime(mtu)
    assert (air.most_octets, BleAirtime().most_octets, air.frames(octets)) == (octets, 19, 1)
    most = [most_instants(kind, 2, air.most_octets) for kind in (StreamKind.PERIODIC, StreamKind.EVENT)]
    assert most == [periodic, event]
    assert air.load(octets, 113, 100_000) == pytest.approx(88.5 / 160, rel=1e-3)


@pytest.mark.parametrize(("load", "n"), [(MOST_LOAD / 2, 20), (MOST_LOAD * 0.51, 113)])
def test_messages_of_a_stream_that_takes_more_than_half_of_the_bus_grow_up_to_what_they_hold(
    load: float, n: int
) -> None:
    bus: Any = SimpleNamespace(airtime=SimpleNamespace(most_octets=240, load=lambda *_words: load))
    plan = planning._plan(0, 1_000_000, StreamKind.PERIODIC, channels(0.001), bus, False, 7)
    assert plan.subscribe.n == n
