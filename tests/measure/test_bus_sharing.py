"""Nodes measured together without --rate share what the bus bears, in whichever order they ask."""

from __future__ import annotations

import threading

import pytest

from teds_provision.links.can.airtime import CanAirtime
from teds_provision.measure.planning import BusShare, BusTime, NodePlans, plan_node
from teds_provision.protocol.operation.budget import MOST_LOAD
from teds_provision.teds.channel import Channel, ChannelKind, SampleForm, Timing

FIRST, SECOND, THIRD = b"a" * 10, b"b" * 10, b"c" * 10
FAST, SLOW = (
    Channel(1, kind=ChannelKind.SENSOR, sample=SampleForm(0, 2, 16), timing=Timing(period=period))
    for period in (2e-5, 0.1)
)


def measure(share: BusShare, order: list[tuple[bytes, Channel]]) -> dict[bytes, NodePlans]:
    """Each node says what it wants, then plans in this order, as NodeSupervisor does."""
    for uuid, channel in order:
        share.wanted[uuid] = plan_node([channel], share.time).load
    plans = {}
    for uuid, channel in order:
        plans[uuid] = plan_node([channel], share.for_node(uuid, sharing=True))
        share.taken[uuid] = plans[uuid].load
    assert sum(share.taken.values()) <= MOST_LOAD
    return plans


@pytest.mark.parametrize(
    "time", [BusTime(CanAirtime()), BusTime(CanAirtime(500_000, 2_000_000))], ids=["classic", "fd"]
)
def test_the_first_node_leaves_the_second_its_half(time: BusTime) -> None:
    plans = measure(BusShare(time, {FIRST, SECOND}), [(FIRST, FAST), (SECOND, FAST)])
    loads = [plan.load for plan in plans.values()]
    assert loads == pytest.approx([MOST_LOAD / 2] * 2, rel=0.1)
    assert all(plan.slowed for plan in plans.values())


@pytest.mark.parametrize("fast_first", [True, False])
def test_a_node_that_wants_little_leaves_the_rest_to_the_fast_ones(fast_first: bool) -> None:
    order = [(FIRST, FAST), (SECOND, FAST), (THIRD, SLOW)]
    plans = measure(BusShare(BusTime(CanAirtime()), {FIRST, SECOND, THIRD}), order if fast_first else order[::-1])
    assert plans[THIRD].slowed == ""
    for uuid in (FIRST, SECOND):
        assert plans[uuid].load == pytest.approx((MOST_LOAD - plans[THIRD].load) / 2, rel=0.1)


def test_a_node_alone_or_beside_one_that_ended_takes_what_the_bus_bears() -> None:
    share = BusShare(BusTime(CanAirtime()), {FIRST, SECOND})
    share.drop_node(SECOND)
    assert measure(share, [(FIRST, FAST)])[FIRST].load == pytest.approx(MOST_LOAD, rel=0.1)


def test_for_a_node_that_says_nothing_an_equal_part_is_kept() -> None:
    plans = measure(BusShare(BusTime(CanAirtime()), {FIRST, SECOND}), [(FIRST, FAST)])
    assert plans[FIRST].load == pytest.approx(MOST_LOAD / 2, rel=0.1)


def test_many_nodes_all_find_room() -> None:
    uuids = [bytes([number]) * 10 for number in range(40)]
    plans = measure(BusShare(BusTime(CanAirtime()), set(uuids)), [(uuid, FAST) for uuid in uuids])
    assert min(plan.load for plan in plans.values()) > MOST_LOAD / 40 / 2


def test_an_asked_rate_is_kept_or_refused_and_never_shared() -> None:
    share = BusShare(BusTime(CanAirtime()), {FIRST, SECOND})
    assert share.for_node(FIRST).taken == 0
    share.taken[SECOND] = 0.25
    assert share.for_node(FIRST).taken == 0.25


def test_a_node_waits_for_the_others_to_say_what_they_want() -> None:
    share = BusShare(BusTime(CanAirtime()), {FIRST, SECOND})
    seen: list[set[bytes]] = []

    def first() -> None:
        share.announce_share(FIRST, 0.5)
        seen.append(set(share.wanted))

    thread = threading.Thread(target=first)
    thread.start()
    share.announce_share(SECOND, 0.01)
    thread.join(60)
    assert seen == [{FIRST, SECOND}]


def test_room_and_nodes_of_a_bus_count_who_is_expected_and_what_others_take() -> None:
    share = BusShare(BusTime(CanAirtime(), taken=0.1), {FIRST})
    assert (share.nodes, share.room) == (1, pytest.approx(0.5))
    share.taken |= {FIRST: 0.2, SECOND: 0.1}
    assert (share.nodes, share.room) == (2, pytest.approx(0.2))
    assert share.for_node(FIRST).taken == pytest.approx(0.2), "its own part is free for itself"
    share.expect([THIRD], 0.05)
    assert share.nodes == 3
    assert share.for_node(FIRST, sharing=True).taken == pytest.approx(0.25)
    share.drop_node(THIRD)
    assert (share.nodes, share.wanted, share.for_node(FIRST, sharing=True).taken) == (2, {}, pytest.approx(0.2))
    share.drop_node(FIRST)
    assert (share.nodes, share.taken[FIRST]) == (2, 0.2), "its streams run on"
    share.remove_node(FIRST)
    assert (share.nodes, share.taken) == (1, {SECOND: 0.1})
    share.taken[SECOND] = 0.9
    assert share.room == 0.0
