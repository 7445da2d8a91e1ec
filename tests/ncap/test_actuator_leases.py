"""Who may move an actuator that a request holds, asked of the leases in this process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import LinkError, NodeBusyError, NodeRefusedError, NoNodeError, PolicyError
from teds_provision.measure.blocks import SetPointCommand
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.ncap.nodes import actuator_leases
from teds_provision.ncap.nodes.actuator_leases import ActuatorLeases, Measured, _HeldActuator, _SetPointOrder
from teds_provision.protocol.messages.frames import Reason
from teds_provision.provisioning.conversation import SessionLostError


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


def leases_of(events: Events | None = None, **parts: Any) -> ActuatorLeases:
    """Return leases with these parts, and none of the others."""
    none = cast(Any, None)
    names = ("station", "live", "desk", "turns", "measured", "is_measured", "lent_for")
    given = {"live": events or Events(), "is_measured": lambda _uuid: False, "lent_for": lambda _uuid: None} | parts
    return ActuatorLeases(*(cast(Any, given.get(name, none)) for name in names))


def test_the_actuators_of_a_node_that_are_held_are_named_in_order() -> None:
    leases, order = leases_of(), _SetPointOrder(0.0, None, 1)
    for uuid, channel, ended in (("ab", 3, False), ("ab", 1, False), ("ab", 2, True), ("cd", 4, False)):
        leases._held[uuid, channel] = _HeldActuator(uuid, channel, 0.0, order, ended=ended)
    leases._held["ab", 1].let_go = True
    assert leases.held("ab") == [1, 3]
    assert leases.held("ef") == []


@pytest.mark.parametrize(
    ("error", "outcome", "why"),
    [
        (None, "done", None),
        (PolicyError("It is too far."), "refused", "It is too far."),
        (SessionLostError(LinkError("Silent.")), "link", "The session was lost: Silent."),
        (ZeroDivisionError(), "bug", "Unexpected ZeroDivisionError."),
    ],
)
def test_the_log_has_the_begin_and_the_end_of_a_lease_and_how_it_ended(
    error: Exception | None, outcome: str, why: str | None
) -> None:
    """A bug was logged as done."""
    log, events = list[tuple[Any, ...]](), Events()

    def audit(act: str, node: bytes, outcome: str, **facts: object) -> None:
        log.append((act, node, outcome, facts))

    class Leases(ActuatorLeases):
        @contextmanager
        def _session(self, uuid: str) -> Iterator[Measured]:
            yield cast(Measured, None)

        def _hold(self, held: _HeldActuator, session: Measured) -> None:
            held.order, held.safe = _SetPointOrder(0.75, "mm", 2), True
            if error is not None:
                raise error

    none = cast(Any, None)
    leases = Leases(cast(Any, SimpleNamespace(audit=audit)), cast(Any, events), none, none, none, none, none)
    held = leases._held["ab", 1] = _HeldActuator("ab", 1, 0.0, _SetPointOrder(0.5, None, 1))
    leases._run(held, 0.5, None)
    reason = {} if why is None else {"why": why}
    assert log == [
        ("set", b"\xab", "begun", {"value": 0.5, "unit": "", "channel": 1}),
        ("set", b"\xab", outcome, {"safe": True, "value": 0.75, "unit": "mm", "channel": 1} | reason),
    ]
    assert (held.ended, held.let_go, leases._held, events.states) == (True, True, {}, ["released"])
    assert leases.state("ab", 1) == {"value": None, "unit": None, "safe": True}
    assert leases.release_actuator("ab", 1) == {"applied": None, "until": None, "safe": True}
    assert leases.release_actuator("ab", 2) == {"applied": None, "until": None, "safe": None}


def test_the_end_of_a_lease_leaves_the_one_that_took_its_place() -> None:
    leases = leases_of(station=SimpleNamespace(audit=lambda *_words, **_facts: None))
    order = _SetPointOrder(0.5, None, 1)
    after = leases._held["ab", 1] = _HeldActuator("ab", 1, 0.0, order)
    leases._run(_HeldActuator("ab", 1, 0.0, order), 0.5, None)
    assert leases._held == {("ab", 1): after}


@pytest.mark.parametrize(
    ("answered", "mine", "facts", "raised"),
    [
        (1, 1, {}, None),
        (2, 1, {}, None),
        (1, 2, {}, LinkError),
        (1, 2, {"let_go": True}, NodeBusyError),
        (2, 2, {"let_go": True}, None),
        (1, 1, {"applied": None}, LinkError),
        (1, 2, {"error": PolicyError("No.")}, PolicyError),
        (2, 1, {"error": PolicyError("No.")}, None),
    ],
)
def test_a_request_is_answered_by_its_own_set_point(
    answered: int, mine: int, facts: dict[str, Any], raised: type[Exception] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(actuator_leases, "time", SimpleNamespace(monotonic=lambda: 100.0, time=lambda: 5000.0))
    order = _SetPointOrder(0.5, None, 1)
    held = _HeldActuator("ab", 1, 0.0, order, **{"applied": {"value": 0.5}, "answered": answered} | facts)
    if raised is not None:
        with pytest.raises(raised):
            ActuatorLeases._answer(held, mine, 0.25)
        return
    assert ActuatorLeases._answer(held, mine, 0.25) == {"applied": {"value": 0.5}, "until": 5000.25, "safe": False}
    assert held.until == 100.25


def test_an_actuator_off_the_whitelist_is_not_moved_and_the_log_has_who_tried() -> None:
    log = list[tuple[Any, ...]]()
    station = SimpleNamespace(
        pins=SimpleNamespace(entry=lambda _uuid: None),
        audit=lambda act, node, outcome, **facts: log.append((act, node, outcome, facts)),
    )
    with pytest.raises(PolicyError, match="is not on the whitelist, so its actuators are not moved") as refused:
        leases_of(station=station).put("ab", 1, 0.5, None, None)
    facts = {"channel": 1, "value": 0.5, "unit": "", "why": refused.value.message}
    assert log == [("set", b"\xab", "refused", facts)]


@pytest.mark.parametrize(("hold", "seconds"), [(None, 1.0), (0.3, 0.3), (100.0, 60.0)])
def test_a_set_point_is_held_for_a_second_or_as_long_as_was_asked_but_a_minute_at_most(
    hold: float | None, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[float]()
    leases = leases_of(station=SimpleNamespace(pins=SimpleNamespace(entry=lambda _uuid: object())))
    held = _HeldActuator("ab", 1, 0.0, _SetPointOrder(0.5, None, 1), applied={"value": 0.5}, answered=1)

    def ordered(_uuid: str, _channel: int, _value: float, _unit: str | None, seconds: float) -> tuple[Any, int]:
        asked.append(seconds)
        return held, 1

    monkeypatch.setattr(leases, "_ordered", ordered)
    leases.put("ab", 1, 0.5, None, hold)
    assert asked == [seconds]


@pytest.mark.parametrize(
    ("reason", "again", "raised"),
    [
        (None, False, None),
        (Reason.WRONG_STATE, True, None),
        (Reason.WRONG_STATE, False, NodeBusyError),
        (Reason.BUSY, False, NodeRefusedError),
    ],
)
def test_an_actuator_that_a_topic_moves_is_busy(
    reason: Reason | None, again: bool, raised: type[Exception] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    course = list[str]()

    class Actuator:
        def __init__(self, _trusted: object, channel: int, *, unit: str | None, dead_man: int) -> None:
            course.append(f"{channel} {unit} {dead_man}")

        def octets_of(self, value: float) -> bytes:
            course.append(f"limits of {value}")
            return b""

        def __enter__(self) -> None:
            course.append("claimed")
            if reason is not None:
                raise NodeRefusedError("No.", reason=reason)

    monkeypatch.setattr(actuator_leases, "HeldActuator", Actuator)
    order = _SetPointOrder(0.5, "mm", 1)
    with pytest.raises(raised) if raised is not None else nullcontext():
        leases_of()._claimed(cast(Any, None), _HeldActuator("ab", 1, 0.0, order), order, again=again)
    assert course == ["1 mm 1000", "limits of 0.5", *([] if again else ["claimed"])]


class Moved:
    """An actuator that was claimed: what it was set to, in which unit, and its end."""

    pause, safe = 0.1, True

    def __init__(self, course: list[Any], unit: str | None) -> None:
        self._course, self._unit = course, unit

    def apply(self, value: float) -> Any:
        self._course.append((value, self._unit))
        if value > 1.0:
            raise PolicyError("It exceeds the limits.")
        return SimpleNamespace(as_json=lambda: {"value": value, "unit": self._unit})

    def __exit__(self, *_: object) -> None:
        self._course.append("released")


@pytest.mark.parametrize(
    ("orders", "stands", "course", "error"),
    [
        ([(0.5, "m"), (0.6, "m")], True, ["claimed m", (0.5, "m"), (0.6, "m"), "released"], None),
        ([(0.5, "m"), (50.0, "mm")], True, ["claimed m", (0.5, "m"), "unit mm", (50.0, "mm"), "released"], PolicyError),
        ([(0.5, "m"), (0.5, None)], True, ["claimed m", (0.5, "m"), "unit None", (0.5, None), "released"], None),
        ([(2.0, "m")], True, ["claimed m", (2.0, "m"), "released"], PolicyError),
        ([(0.5, "m"), (0.6, "m")], False, ["claimed m", (0.5, "m"), "released"], PolicyError),
        ([(0.5, "m"), None], True, ["claimed m", (0.5, "m")], LinkError),
    ],
)
def test_an_actuator_is_claimed_once_and_whatever_ends_its_lease_releases_it(
    orders: list[Any], stands: bool, course: list[Any], error: type[Exception] | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A refused set point releases it, too; so does a node that is on the whitelist no more."""
    done: list[Any] = []
    there = [True]

    def require() -> None:
        if not stands and (0.5, "m") in done:
            raise PolicyError("It is not on the whitelist.")

    class Leases(ActuatorLeases):
        def _claimed(self, _trusted: Any, _held: Any, order: _SetPointOrder, *, again: bool) -> Any:
            done.append(f"{'unit' if again else 'claimed'} {order.unit}")
            return Moved(done, order.unit)

        @staticmethod
        def _until_news(held: _HeldActuator, answered: int, pause: float) -> None:
            assert pause == 0.1
            following = orders[answered] if answered < len(orders) else ()
            if following is None:
                there[0] = False
            elif following:
                held.order = _SetPointOrder(*following, answered + 1)

    @contextmanager
    def session(_uuid: str) -> Iterator[VerifiedSession | None]:
        yield cast(Any, object()) if there[0] else None

    standing = SimpleNamespace(require=require, drives=False)
    monkeypatch.setattr(actuator_leases, "NodeStanding", lambda _station, _uuid: standing)
    none = cast(Any, None)
    leases = Leases(none, cast(Any, Events()), none, none, none, none, none)
    value, unit = orders[0]
    held = _HeldActuator("ab", 1, time.monotonic() - 1.0, _SetPointOrder(value, unit, 1))
    if orders[-1] is None:
        held.until += 100.0
        course = [*course, "released"]
    with pytest.raises(error) if error is not None else nullcontext():
        leases._hold(held, session)
    assert done == course
    assert held.safe is True


def test_a_node_that_is_lent_to_a_writer_or_on_no_bus_moves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[Any] = []

    @contextmanager
    def hold(uuid: str, what: str) -> Iterator[None]:
        opened.append((uuid, what))
        yield

    lent, met = ["let go for write"], [cast(Any, None)]
    desk = SimpleNamespace(contact=lambda _uuid: met[0])
    leases = leases_of(desk=desk, turns=SimpleNamespace(hold=hold), lent_for=lambda _uuid: lent[0] if lent else None)
    with pytest.raises(NodeBusyError, match="Node ab is busy: let go for write"), leases._own_session("ab"):
        pass
    lent.clear()
    with pytest.raises(NoNodeError, match="is not on any bus"), leases._own_session("ab"):
        pass
    assert opened == []
    met[0] = object()
    monkeypatch.setattr(actuator_leases, "Conversation", lambda _contact, *, notice: nullcontext("node"))
    monkeypatch.setattr(actuator_leases, "open_trusted", lambda _station, node, *, by: (node, by))
    with leases._own_session("ab") as session:
        assert session == ("node", "ncap")
        assert opened == [("ab", "its actuators are held")]


def test_the_first_set_point_has_fifteen_seconds_more_and_the_next_one_is_the_same_leases(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, begun = [100.0], list[tuple[float, str | None]]()

    class Thread:
        def __init__(self, *, target: Any, args: Any, **_more: Any) -> None:
            self.words = args[2:]

        def start(self) -> None:
            begun.append(self.words)

    monkeypatch.setattr(actuator_leases, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(actuator_leases.threading, "Thread", Thread)
    leases = leases_of()
    held, mine = leases._ordered("ab", 1, 0.5, "m", 2.0)
    assert (held.until, held.order, mine, begun) == (117.0, _SetPointOrder(0.5, "m", 1), 1, [(0.5, "m")])
    now[0] = 101.0
    assert leases._ordered("ab", 1, 50.0, "mm", 0.25) == (held, 2)
    assert (held.until, held.order, len(begun)) == (101.25, _SetPointOrder(50.0, "mm", 2), 1)
    held.let_go = True
    after, mine = leases._ordered("ab", 1, 0.7, None, 1.0)
    assert (after.before, mine, len(begun)) == (held, 1, 2)
    assert leases._held["ab", 1] is after
    assert leases._ordered("ab", 2, 0.7, None, 1.0)[0].before is None


def test_at_the_end_of_the_service_each_actuator_is_let_go(monkeypatch: pytest.MonkeyPatch) -> None:
    leases, order, ended = leases_of(), _SetPointOrder(0.0, None, 1), list[tuple[str, int]]()
    for uuid, channel in (("ab", 1), ("ab", 2), ("cd", 1)):
        leases._held[uuid, channel] = _HeldActuator(uuid, channel, 0.0, order)
    monkeypatch.setattr(leases, "release_actuator", lambda *words: ended.append(words))
    leases.end()
    assert ended == [("ab", 1), ("ab", 2), ("cd", 1)]


def test_who_lets_go_is_answered_when_the_node_has_answered() -> None:
    class EndsMeanwhile(NewsOfTheEnd):
        def notify_all(self) -> None:
            self.course.append("it is to be let go")

        def wait_for(self, over: Callable[[], bool], seconds: float) -> bool:
            assert (held.let_go, over(), seconds) == (True, False, 15.0)
            held.ended, held.safe, held.applied = True, True, {"value": 0.5}
            return over()

    course = list[str]()
    leases = leases_of()
    held = leases._held["ab", 1] = _HeldActuator(
        "ab", 1, 0.0, _SetPointOrder(0.5, None, 1), news=cast(Any, EndsMeanwhile(course))
    )
    assert leases.release_actuator("ab", 1) == {"applied": {"value": 0.5}, "until": None, "safe": True}
    assert course == ["it is to be let go"]


@pytest.mark.parametrize(
    ("pause", "left", "seconds"), [(0.25, 9.0, 0.25), (0.25, 0.125, 0.125), (0.25, 0.0, 0.0), (0.25, -5.0, 0.0)]
)
def test_a_value_is_sent_again_after_its_pause_and_not_after_its_time(
    pause: float, left: float, seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[float] = []

    class News(NewsOfTheEnd):
        def wait_for(self, over: Callable[[], bool], seconds: float) -> bool:
            waited.append(seconds)
            assert not over()
            held.order = _SetPointOrder(0.75, None, 2)
            assert over(), "another value"
            held.order, held.let_go = _SetPointOrder(0.5, None, 1), True
            assert over(), "it is let go"
            return True

    monkeypatch.setattr(actuator_leases, "time", SimpleNamespace(monotonic=lambda: 100.0))
    news = cast(Any, News([]))
    held = _HeldActuator("ab", 1, 100.0 + left, _SetPointOrder(0.5, None, 1), news=news)
    ActuatorLeases._until_news(held, 1, pause)
    assert waited == [seconds]


@pytest.mark.parametrize(("safe", "state"), [(False, "held"), (True, "released"), (None, "released")])
def test_only_an_actuator_that_is_known_to_move_is_shown_as_held(safe: bool | None, state: str) -> None:
    """None: the node did not say whether it is safe; nothing of this station holds it any more."""
    sent: list[Any] = []
    live = SimpleNamespace(event=lambda kind, **facts: sent.append((kind, facts)))
    leases = leases_of(cast(Any, live))
    applied = {"channel": 1, "value": 50.0, "unit": "mm", "raw": 1861}
    held = _HeldActuator("ab", 1, 0.0, _SetPointOrder(0.5, None, 1), applied=applied)
    leases._publish_state(held, safe=safe)
    facts = {"value": 50.0, "unit": "mm", "safe": safe}
    assert sent == [("actuator", {"uuid": "ab", "state": state, "channel": 1, **facts})]
    assert leases.state("ab", 1) == facts
    assert leases.state("ab", 2) is None


def test_a_session_that_a_measurement_opens_is_waited_for_five_seconds_or_until_it_is_let_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, there, looks = [100.0], [100.0], list[float]()

    class News(NewsOfTheEnd):
        def wait_for(self, over: Callable[[], bool], seconds: float) -> bool:
            assert not over()
            looks.append(seconds)
            now[0] += 1.0
            return False

    @contextmanager
    def session(_uuid: str) -> Iterator[VerifiedSession | None]:
        yield cast(Any, object()) if now[0] >= there[0] else None

    monkeypatch.setattr(actuator_leases, "time", SimpleNamespace(monotonic=lambda: now[0]))
    for at, count in ((100.0, 0), (102.0, 2), (999.0, 5)):
        now[0], there[0] = 100.0, at
        looks.clear()
        held = _HeldActuator("ab", 1, 0.0, _SetPointOrder(0.5, None, 1), news=cast(Any, News([])))
        ActuatorLeases._until_there(held, session)
        assert looks == [0.05] * count
    held.let_go = True
    now[0] = 100.0
    looks.clear()
    ActuatorLeases._until_there(held, session)
    assert looks == []
