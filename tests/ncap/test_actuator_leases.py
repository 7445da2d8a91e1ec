"""Who may move an actuator that a request holds, asked of the leases in this process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.measure.blocks import SetPointCommand
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.ncap.nodes import actuator_leases
from teds_provision.ncap.nodes.actuator_leases import ActuatorLeases, Measured, _HeldActuator, _SetPointOrder


class Events:
    """What a page would be told."""

    def __init__(self) -> None:
        self.states: list[str] = []

    def event(self, kind: str, **facts: object) -> None:
        self.states.append(str(facts["state"]))


@pytest.mark.parametrize(
    ("changes", "admitted"), [({}, False), ({"let_go": True}, False), ({"let_go": True, "ended": True}, True)]
)
def test_no_set_point_of_a_topic_moves_an_actuator_until_its_request_has_ended(
    changes: dict[str, bool], admitted: bool
) -> None:
    """One that is let go is on its way to its safe state, by the session that holds it still."""
    events, none = Events(), cast(Any, None)
    leases = ActuatorLeases(none, cast(Any, events), none, none, none, none, none)
    held = _HeldActuator("ab", 1, 0.0, _SetPointOrder(0.0, None, 1), **changes)
    leases._held["ab", 1] = held
    for _ in range(2):
        assert leases.admits(SetPointCommand("ab", 1, 0.5, 0.0)) is admitted
    assert events.states == ([] if admitted else ["refused"]), "reported once"
    assert leases.admits(SetPointCommand("ab", 2, 0.5, 0.0))


class NewsOfTheEnd:
    """The condition of a lease that is being let go: whoever waits for its end is told of it at once."""

    def __init__(self, course: list[str]) -> None:
        self.course = course

    def __enter__(self) -> None:
        pass

    def __exit__(self, *_: object) -> None:
        pass

    def wait_for(self, over: Callable[[], bool], _seconds: float) -> bool:
        assert not over()
        self.course.append("the one before ends")
        return True


def test_an_actuator_is_claimed_again_only_when_its_release_is_over() -> None:
    """Two claims of one session cannot have an actuator: the second would be refused as a topic's."""
    course: list[str] = []

    class Leases(ActuatorLeases):
        @contextmanager
        def _session(self, uuid: str) -> Iterator[Measured]:
            yield cast(Measured, None)

        def _hold(self, held: _HeldActuator, session: Measured) -> None:
            course.append("claimed")

    none, order = cast(Any, None), _SetPointOrder(0.5, None, 1)
    station = cast(Any, SimpleNamespace(audit=lambda *_words, **_facts: None))
    leases = Leases(station, cast(Any, Events()), none, none, none, none, none)
    before = _HeldActuator("ab", 1, 0.0, order, news=cast(Any, NewsOfTheEnd(course)), let_go=True)
    after = _HeldActuator("ab", 1, 0.0, order, before=before)
    leases._run(after, 0.5, None)
    assert course == ["the one before ends", "claimed"]
    assert after.ended


def test_a_first_set_point_is_held_for_its_time_from_when_it_was_applied() -> None:
    """Until then it has fifteen seconds more, for a session that has to be opened."""
    order, applied = _SetPointOrder(0.5, None, 1), {"value": 0.5}
    held = _HeldActuator("ab", 1, time.monotonic() + 15.5, order, applied=applied, answered=1)
    assert ActuatorLeases._answer(held, 1, 0.5)["applied"] == applied
    assert held.until <= time.monotonic() + 0.5


def test_the_session_of_a_nodes_actuators_ends_with_the_last_of_them() -> None:
    ended: list[str] = []
    none, the_session = cast(Any, None), cast(Any, object())

    class Leases(ActuatorLeases):
        @contextmanager
        def _own_session(self, uuid: str) -> Iterator[VerifiedSession]:
            yield the_session
            ended.append(uuid)

    leases = Leases(none, none, none, none, none, lambda _uuid: False, none)
    with leases._session("ab") as first:
        with leases._session("ab"):
            pass
        assert ended == []
        with first("ab") as session:
            assert session is the_session
    assert ended == ["ab"]


def test_a_set_point_whose_time_is_shorter_than_the_way_to_the_node_is_applied_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Else a short hold on a busy bus is answered, or given up, without a move."""
    standing = SimpleNamespace(require=lambda: None, drives=False)
    monkeypatch.setattr(actuator_leases, "NodeStanding", lambda _station, _uuid: standing)
    applied: list[float] = []

    class Actuator:
        pause, safe = 0.1, True

        def apply(self, value: float) -> Any:
            applied.append(value)
            return SimpleNamespace(as_json=lambda: {"value": value, "unit": "m"})

        def __exit__(self, *_: object) -> None:
            applied.append(-1.0)

    class Leases(ActuatorLeases):
        def _claimed(self, *_words: Any, again: bool) -> Any:
            return Actuator()

        @staticmethod
        def _until_news(held: _HeldActuator, answered: int, pause: float) -> None:
            if answered == 1:  # another request comes as the time is over
                held.order = _SetPointOrder(0.75, None, 2)

    @contextmanager
    def session(_uuid: str) -> Iterator[VerifiedSession | None]:
        yield cast(Any, object())

    none = cast(Any, None)
    leases = Leases(none, cast(Any, Events()), none, none, none, none, none)
    held = _HeldActuator("ab", 1, time.monotonic() - 1.0, _SetPointOrder(0.5, None, 1))
    leases._hold(held, session)
    assert applied == [0.5, 0.75, -1.0]
    assert (held.answered, held.let_go, held.safe, standing.drives) == (2, True, True, True)
