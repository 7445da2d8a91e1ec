"""Which nodes a measurement has, waits for and asks again: decided without threads, at times that are handed in."""

from __future__ import annotations

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NoRoomError,
    NotAuthenticError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.measure.matching import NodeLoad
from teds_provision.ncap.membership import (
    AGAIN,
    ASKED,
    FIRST_ROUND,
    GATHERING,
    LOOK,
    NO_ROOM,
    QUIET,
    AfterEnd,
    Budget,
    Member,
    Membership,
)
from teds_provision.protocol.messages.identity import NodeState

A, B, C = "aa" * 10, "bb" * 10, "cc" * 10
LATER = FIRST_ROUND + 10.0


def place(state: NodeState = NodeState.PROVISIONED) -> Any:
    return SimpleNamespace(identity=SimpleNamespace(state=state))


def joined(*uuids: str) -> Membership:
    return Membership(0.0, {uuid: Member() for uuid in uuids})


def released(membership: Membership, uuid: str) -> None:
    membership.begin_leaving(uuid)
    membership.leaving.discard(uuid)


def test_nodes_that_come_together_join_together() -> None:
    membership = joined(C)
    membership.arrive(A, LATER)
    assert not membership.gathered(LATER + QUIET / 2)
    membership.arrive(B, LATER + QUIET / 2)
    assert not membership.gathered(LATER + QUIET), "another one came just now"
    assert membership.gathered(LATER + 2 * QUIET)
    assert membership.begin_joining() == [A, B]
    assert not membership.gathered(LATER + 1)


def test_a_crowd_that_never_ends_does_not_keep_the_first_waiting() -> None:
    membership = joined(C)
    for number in range(20):
        membership.arrive(f"{number:020x}", LATER + number * QUIET / 2)
    assert membership.gathered(LATER + GATHERING)


def test_at_the_beginning_all_have_three_seconds_to_answer() -> None:
    membership = Membership(0.0)
    for number in range(30):
        membership.arrive(f"{number:020x}", number * 0.1)
        assert not membership.gathered(number * 0.1 + QUIET)
    assert membership.gathered(FIRST_ROUND)


def test_a_node_counts_as_in_from_joining_until_its_lock_is_released() -> None:
    membership = Membership(0.0)
    membership.arrive(A, 0.0)
    membership.begin_joining()
    assert not membership.has(A), "it is being decided whether there is room"
    membership.join(A)
    assert (membership.has(A), membership.joined) == (True, (A,))
    membership.begin_leaving(A)
    assert (membership.has(A), membership.joined) == (True, (A,))
    assert membership.may_come(A, says_factory=False), "where it answers meanwhile, it is tried again"
    membership.leaving.discard(A)
    assert not membership.has(A)


@pytest.mark.parametrize(
    ("room", "says_factory", "may"),
    [(None, False, True), (None, True, False), (0.3, False, False)],
    ids=["refused", "refused, and the adopter's", "no room"],
)
def test_a_node_that_waits_and_answers(room: float | None, says_factory: bool, may: bool) -> None:
    membership = Membership(0.0)
    assert membership.wait(A, 30.0, room)
    assert not membership.wait(A, 40.0, room), "that it waits is no news"
    assert membership.may_come(A, says_factory=says_factory) is may


def test_a_node_without_room_is_tried_when_there_is_more_or_after_half_a_minute() -> None:
    membership = joined(A)
    released(membership, A)
    membership.end(A, 0.0, NoRoomError("full"), last=place(), seen=place(), room=0.2)
    assert membership.due(1.0, lambda _uuid: 0.2) == []
    assert membership.due(1.0, lambda _uuid: 0.25) == [A]
    membership.wait(A, AGAIN, 0.2)
    assert membership.due(AGAIN, lambda _uuid: 0.2) == [A]
    assert membership.due(AGAIN, lambda _uuid: 0.2) == []


@pytest.mark.parametrize(
    ("error", "last", "seen", "then"),
    [
        (LinkError("silent"), place(), None, AfterEnd.NOTHING),
        (LinkError("silent"), place(), place(), AfterEnd.TRY),
        (PolicyError("banned"), place(), place(), AfterEnd.NOTHING),
        (PolicyError("no key"), place(NodeState.FACTORY), None, AfterEnd.ASK),
        (None, place(), None, AfterEnd.NOTHING),
    ],
    ids=["lost", "seen elsewhere meanwhile", "refused", "without a key", "ended in order"],
)
def test_what_follows_when_a_session_has_ended(
    error: TedsProvisionError | None, last: Any, seen: Any, then: AfterEnd
) -> None:
    membership = joined(A)
    released(membership, A)
    assert membership.end(A, 0.0, error, last=last, seen=seen, room=0.0) is then
    assert membership.places[A] is last
    assert (A in membership.lost) == (isinstance(error, LinkError) and seen is None)
    assert (A in membership.waits) == isinstance(error, PolicyError)


def test_a_lost_node_is_asked_ever_more_seldom_for_a_minute() -> None:
    membership, last = joined(A), place()
    released(membership, A)
    membership.end(A, 0.0, LinkError("silent"), last=last, seen=last, room=0.0)
    times = [step * LOOK for step in range(int(2 * ASKED / LOOK))]
    asked = [time for time in times if membership.ask_now(time) == [last]]
    pauses = [later - earlier for earlier, later in itertools.pairwise(asked)]
    assert (asked[0] < 0.5, 5 < len(asked) < 15) == (True, True)
    assert all(later >= earlier - LOOK for earlier, later in itertools.pairwise(pauses))
    assert asked[-1] <= ASKED
    assert not membership.lost


def test_a_node_that_is_in_again_is_asked_for_no_more() -> None:
    membership, last = joined(A), place()
    released(membership, A)
    membership.end(A, 0.0, LinkError("silent"), last=last, seen=last, room=0.0)
    membership.arrive(A, 0.1)
    membership.begin_joining()
    assert membership.ask_now(10.0) == []
    assert not membership.lost


def test_after_a_change_of_the_store_all_but_those_without_room_are_tried() -> None:
    membership = Membership(0.0)
    membership.wait(A, 30.0, None)
    membership.wait(B, 30.0, 0.1)
    membership.elsewhere.add(C)
    assert membership.select_again([B, C]) == [A, C]
    assert membership.due(30.0, lambda _uuid: 0.0) == [B]
    assert not membership.elsewhere


def test_a_node_that_another_part_works_with_is_tried_a_moment_later() -> None:
    membership = Membership(0.0)
    membership.busy[A] = LOOK
    assert membership.free_again(LOOK / 2) == []
    assert membership.free_again(LOOK) == [A]
    assert membership.free_again(2 * LOOK) == []


def test_a_node_joins_only_as_far_as_bus_and_budget_have_room() -> None:
    membership, load = joined(A, B), NodeLoad(0.2, 2, 50.0)
    budget = Budget(150.0, 50.0, rows=False)
    membership.members[A].load = load
    membership.members[B].load = load
    assert membership.why_no_room(B, 0.5, Budget()) == ""
    assert membership.why_no_room(B, 0.001, Budget()) == NO_ROOM
    assert "150" in membership.why_no_room(B, 0.5, budget)
    assert membership.why_no_room(B, 0.5, dataclasses.replace(budget, limit=200.0)) == ""


@pytest.mark.parametrize(
    ("members", "came", "before", "after"),
    [
        ((C,), [10.0], 10.04, 10.06),
        ((C,), [10.0, 10.04], 10.08, 10.1),
        ((C,), [10.0, 10.04, 10.08, 10.12, 10.16, 10.2, 10.24, 10.28], 10.29, 10.31),
        ((), [10.0], 10.24, 10.26),
        ((), [10.0, 10.2], 10.29, 10.31),
        ((), [0.1], 0.34, 0.36),
        ((), [0.2 * step for step in range(1, 15)], 2.99, 3.0),
        ((), [2.9, 3.1], 3.14, 3.35),
    ],
    ids=[
        "one",
        "two",
        "a crowd",
        "the first one",
        "a crowd of first ones",
        "at the start",
        "for three seconds",
        "late",
    ],
)
def test_how_long_nodes_that_come_are_gathered(
    members: tuple[str, ...], came: list[float], before: float, after: float
) -> None:
    """In seconds: 0.05 after the last one and 0.3 after the first; 0.25 if none is in; three seconds at the start."""
    membership = joined(*members)
    for number, at in enumerate(came):
        membership.arrive(f"{number:020x}", at)
    now = before if came[0] != 2.9 else 3.0 - 1e-6
    assert not membership.gathered(now)
    assert membership.gathered(after)


def test_a_lost_node_is_asked_after_a_fifth_of_a_second_and_then_after_twice_as_long_each_time() -> None:
    membership, last = joined(A), place()
    released(membership, A)
    membership.end(A, 1000.0, LinkError("silent"), last=last, seen=last, room=0.0)
    for number, at in enumerate((0.2, 0.4, 0.8, 1.6, 3.2, 6.4, 12.8, 25.6, 41.6, 57.6), 1):
        assert membership.ask_now(1000.0 + at - 0.01) == []
        assert membership.ask_now(1000.0 + at + 0.001 * number) == [last]
    assert (membership.ask_now(1060.0), A in membership.lost) == ([], True)
    assert (membership.ask_now(1060.01), A in membership.lost) == ([], False)


@pytest.mark.parametrize(
    ("error", "seen", "waits"),
    [
        (NoRoomError("full"), True, (1030.0, 0.25)),
        (NoRoomError("full"), False, (1030.0, None)),
        (PolicyError("banned"), True, (1030.0, None)),
        (NotAuthenticError("forged"), False, (1030.0, None)),
        (BadDataError("no sensor"), True, (1030.0, None)),
        (LinkError("silent"), True, None),
        (None, True, None),
    ],
)
def test_a_node_that_is_refused_or_finds_no_room_waits_half_a_minute(
    error: TedsProvisionError | None, seen: bool, waits: tuple[float, float | None] | None
) -> None:
    membership, last = joined(A), place()
    released(membership, A)
    membership.end(A, 1000.0, error, last=last, seen=last if seen else None, room=0.25)
    found = membership.waits.get(A)
    assert (found and (found.at, found.room)) == waits


@pytest.mark.parametrize(
    ("bus", "room", "budget", "why"),
    [
        (25.0, 0.5, Budget(), ""),
        (25.1, 0.5, Budget(), "no room on the bus"),
        (None, 0.0, Budget(), ""),
        (0.1, 0.0, Budget(), "no room on the bus"),
        (0.1, 0.5, Budget(80.0, 10.0), ""),
        (0.1, 0.5, Budget(79.0, 10.0), "no room in the budget of 79 messages/s"),
        (0.1, 0.5, Budget(280.0, 10.0, rows=True), ""),
        (0.1, 0.5, Budget(279.0, 10.0, rows=True), "no room in the budget of 279 messages/s"),
    ],
)
def test_a_new_node_may_be_slowed_to_a_fiftieth_and_the_messages_of_all_count(
    bus: float | None, room: float, budget: Budget, why: str
) -> None:
    membership = joined(A, B)
    membership.members[A].load = NodeLoad(0.2, 3, 50.0)
    membership.members[B].load = NodeLoad(bus, 5, 50.0)
    assert membership.why_no_room(B, room, budget) == why


def test_a_node_that_has_not_joined_yet_is_locked_and_neither_in_nor_leaving() -> None:
    membership = joined(C)
    membership.busy[A] = 99.0
    membership.elsewhere = {A, B}
    membership.arrive(A, 1.0)
    assert (membership.busy, membership.elsewhere) == ({}, {B})
    assert membership.begin_joining() == [A]
    assert membership.members[A].locked, "its lock was taken when it arrived"
    assert (membership.joined, membership.has(A)) == ((C,), False)
    member = membership.begin_leaving(A)
    assert member is not None
    assert (member.joined, membership.leaving, membership.joined) == (False, set(), (C,))
    assert (membership.begin_leaving(B), membership.leaving) == (None, set())
    membership.begin_leaving(C)
    assert membership.leaving == {C}


def test_a_node_that_is_there_or_on_its_way_does_not_come_again() -> None:
    membership = joined(A)
    membership.arrive(B, 1.0)
    assert [membership.may_come(uuid, says_factory=False) for uuid in (A, B, C)] == [False, False, True]
    assert membership.may_come(C, says_factory=True), "only one that was refused is left to the adopter"


def test_a_node_that_is_in_is_neither_lost_nor_waiting() -> None:
    membership, last = joined(A), place()
    released(membership, A)
    membership.end(A, 0.0, LinkError("silent"), last=last, seen=None, room=0.0)
    membership.wait(A, 30.0, None)
    membership.arrive(A, 1.0)
    membership.begin_joining()
    membership.join(A)
    assert (membership.lost, membership.waits) == ({}, {})


def test_a_node_that_was_refused_is_not_tried_before_its_time_whatever_room_there_is() -> None:
    membership = Membership(0.0)
    membership.wait(A, 30.0, None)
    membership.wait(B, 30.0, 0.25)
    assert membership.due(29.99, lambda uuid: 9.0 if uuid == A else 0.25) == []
    assert membership.due(30.0, lambda _uuid: 0.0) == [A, B]


@pytest.mark.parametrize(
    ("error", "there"),
    [(LinkError("silent"), False), (PolicyError("banned"), False), (None, False), (None, True)],
)
def test_a_node_that_never_had_a_place_or_ended_in_order_is_not_asked(
    error: TedsProvisionError | None, there: bool
) -> None:
    membership = joined(A)
    released(membership, A)
    membership.places[A] = before = place(NodeState.FACTORY)
    last, seen = (place(), place()) if there else (None, None)
    assert membership.end(A, 0.0, error, last=last, seen=seen, room=0.0) is AfterEnd.NOTHING
    assert membership.places[A] is (last or before)
    assert membership.lost == {}


@pytest.mark.parametrize(
    ("members", "began", "came", "now", "gathered"),
    [
        ((), 1000.0, [1002.99], 1002.9999, False),
        ((), 1000.0, [1002.99], 1003.0, True),
        ((), 1000.0, [1003.0], 1003.2, False),
        ((), 1000.0, [1003.0, 1003.2], 1003.31, True),
        ((C,), -1000.0, [0.0], 0.04, False),
        ((C,), -1000.0, [0.0], 0.05, True),
        ((C,), 1000.0, [1000.5 + 0.04 * number for number in range(8)], 1000.79, False),
        ((C,), 1000.0, [1000.5 + 0.04 * number for number in range(8)], 1000.81, True),
    ],
)
def test_the_three_seconds_begin_with_the_measurement_and_are_for_one_without_nodes(
    members: tuple[str, ...], began: float, came: list[float], now: float, gathered: bool
) -> None:
    membership = Membership(began, {uuid: Member() for uuid in members})
    for number, at in enumerate(came):
        membership.arrive(f"{number:020x}", at)
    assert membership.gathered(now) is gathered
