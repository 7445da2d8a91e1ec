"""Who is new on a watched bus, who left, and when it is asked again; the bus is a mock."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import AddressConflictError
from teds_provision.links.can import arrivals
from teds_provision.links.can.arrivals import Arrivals
from teds_provision.links.can.identify_broadcast import FunctionalAnswers
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.ports import Notice
from teds_provision.protocol.announce import Announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState

ONE, TWO = bytes([1]) * 10, bytes([2]) * 10


def identity(uuid: bytes, state: NodeState = NodeState.KEYED) -> Identity:
    return Identity(uuid, state, 1, 0, 1024, 0)


class Clock:
    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = time.monotonic()
        monkeypatch.setattr(arrivals, "time", self)

    def monotonic(self) -> float:
        return self.now


class MockPort:
    """The port and the bus of :class:`Arrivals`: ``answers`` is what the next rounds hear, by address."""

    def __init__(self, clock: Clock, monkeypatch: pytest.MonkeyPatch, spec: str = "udp_multicast:239.1.2.3") -> None:
        self.spec, self.clock = parse_spec(spec), clock
        self.answers: dict[int, Identity] = {}
        self.found = FunctionalAnswers()
        self.asked: list[tuple[int, float | None]] = []
        self.alone: dict[int, Identity | Exception] = {}
        self.notices: list[Notice] = []
        self.announced: list[Frame] = []
        self.listened = self.rivals = 0
        self.presses: Any = self
        self.pressed_crcs: set[int] = set()
        self.waits: list[float] = []
        monkeypatch.setattr(arrivals, "ask_all", self._ask_all)

    def bus(self) -> Any:
        return self

    def next_transaction(self) -> int:
        return 7

    def listen(self, wants: Any, most: int) -> Any:
        self.listened += 1
        self.wants = wants
        assert most == 256
        return self

    def news(self) -> set[int]:
        return self.pressed_crcs

    def get_all(self, _seconds: float) -> list[Frame]:
        waiting, self.announced = self.announced, []
        return waiting

    def get(self, seconds: float) -> Frame | None:
        self.waits.append(seconds)
        self.clock.now += seconds
        return self.announced.pop(0) if self.announced else None

    def report_rivals(self, _notice: object) -> None:
        self.rivals += 1

    def identify(self, node: int, *, seconds: float | None = None) -> Identity | None:
        self.asked.append((node, seconds))
        answer = self.alone.get(node)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def _ask_all(self, _bus: object, transaction: int, *, silence: float, longest: float) -> Any:
        assert (transaction, silence, longest) == (7, 0.055, 3.0)
        yield from self.answers.items()
        yield self.found


@pytest.fixture
def place(monkeypatch: pytest.MonkeyPatch) -> tuple[Arrivals, MockPort, Clock]:
    clock = Clock(monkeypatch)
    port = MockPort(clock, monkeypatch)
    return Arrivals(port, port.notices.append), port, clock


Place = tuple[Arrivals, MockPort, Clock]


def round_of(watched: Arrivals) -> list[tuple[int, bytes]]:
    return [(address, who.uuid) for address, who in watched.round(threading.Event())]


def test_a_node_is_new_once_and_again_after_its_reset_alone(place: Place) -> None:
    watched, port, _ = place
    port.answers = {0x21: identity(ONE)}
    assert round_of(watched) == [(0x21, ONE)]
    assert round_of(watched) == []
    port.answers = {0x22: identity(ONE)}
    assert round_of(watched) == [], "a new address alone makes no new node"
    port.answers = {0x22: identity(ONE, NodeState.FACTORY)}
    assert round_of(watched) == [(0x22, ONE)]
    assert round_of(watched) == []
    port.answers = {0x22: identity(ONE)}
    assert round_of(watched) == []


def test_a_node_that_is_silent_for_three_seconds_has_left_and_is_new_when_it_comes_back(place: Place) -> None:
    watched, port, clock = place
    port.answers = {0x21: identity(ONE), 0x22: identity(TWO)}
    round_of(watched)
    port.answers = {0x22: identity(TWO)}
    round_of(watched)
    clock.now += 2.9
    assert round_of(watched) == []
    assert port.notices == []
    port.answers = {0x21: identity(ONE), 0x22: identity(TWO)}
    assert round_of(watched) == [], "it was not gone"
    port.answers = {0x22: identity(TWO)}
    round_of(watched)
    clock.now += 3.0
    round_of(watched)
    (left,) = port.notices
    assert (left.kind, left.uuid) == ("node-left", ONE)
    assert left.text == f"Node {ONE.hex()} at 0x21 no longer answers."
    round_of(watched)
    assert len(port.notices) == 1
    port.answers = {0x21: identity(ONE)}
    assert round_of(watched) == [(0x21, ONE)]


def test_a_conflict_is_reported_once_and_the_node_there_has_not_left(place: Place) -> None:
    watched, port, clock = place
    port.answers = {0x21: identity(ONE)}
    round_of(watched)
    port.answers, port.found = {}, FunctionalAnswers(conflicts={0x21})
    port.alone = {0x21: AddressConflictError("two")}
    for _ in range(3):
        round_of(watched)
        clock.now += 3.0
    assert [notice.kind for notice in port.notices] == ["conflict"]
    port.found = FunctionalAnswers()
    round_of(watched)
    assert [notice.kind for notice in port.notices] == ["conflict"]
    port.found = FunctionalAnswers(conflicts={0x21})
    round_of(watched)
    assert [notice.kind for notice in port.notices] == ["conflict", "conflict"], "it was gone in between"


def test_a_torn_answer_is_asked_for_once_more_for_a_tenth_of_a_second(place: Place) -> None:
    watched, port, _ = place
    port.found = FunctionalAnswers(unfinished={0x23})
    port.alone = {0x23: identity(ONE)}
    assert round_of(watched) == [(0x23, ONE)]
    assert port.asked
    assert {seconds for _, seconds in port.asked} == {0.1}


def test_one_named_node_is_asked_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock(monkeypatch)
    port = MockPort(clock, monkeypatch, "udp_multicast:239.1.2.3?node=0x21")
    watched = Arrivals(port, port.notices.append)
    port.answers = {0x30: identity(TWO)}
    assert round_of(watched) == []
    port.alone = {0x21: identity(ONE)}
    assert round_of(watched) == [(0x21, ONE)]
    assert port.asked == [(0x21, None)] * 2
    port.alone = {0x21: AddressConflictError("two")}
    assert round_of(watched) == []
    assert [notice.kind for notice in port.notices] == ["conflict"]


def test_a_round_that_is_stopped_reports_nobody_as_gone(place: Place) -> None:
    watched, port, clock = place
    port.answers = {0x21: identity(ONE)}
    round_of(watched)
    rivals, port.answers = port.rivals, {}
    round_of(watched)
    clock.now += 5.0
    stop = threading.Event()
    stop.set()
    assert list(watched.round(stop)) == []
    assert port.notices == []
    assert port.rivals == rivals + 1, "of the whole round in between alone"


def test_a_bus_that_was_lost_is_listened_to_anew(place: Place) -> None:
    watched, port, _ = place
    round_of(watched)
    round_of(watched)
    assert port.listened == 1
    watched.lost()
    assert watched.pressed() == []
    round_of(watched)
    assert port.listened == 2


def test_a_pressed_button_is_of_a_node_that_was_seen(place: Place) -> None:
    watched, port, _ = place
    port.answers = {0x21: identity(ONE), 0x22: identity(TWO)}
    round_of(watched)
    port.pressed_crcs = {uuid_crc(TWO), uuid_crc(bytes(10))}
    assert watched.pressed() == [TWO]


def announce(uuid: bytes, *, pressed: bool = False) -> Frame:
    news = Announce(0x21, 1, uuid_crc(uuid), pressed)
    return Frame(news.identifier, news.encode())


def test_a_start_ends_the_pause_and_a_button_does_not(place: Place) -> None:
    watched, port, _ = place
    round_of(watched)
    assert port.wants(announce(ONE))
    assert not port.wants(announce(ONE, pressed=True))
    assert not port.wants(Frame(0x18DA21F1, bytes(8)))


@pytest.mark.parametrize(("nodes", "pause"), [(0, 0.015), (1, 0.03), (10, 0.3), (60, 1.0)])
def test_the_pause_grows_with_the_nodes_that_answered_to_a_second_at_most(
    place: Place, nodes: int, pause: float
) -> None:
    watched, port, clock = place
    known = {number + 1: identity(bytes([number, 9] * 5)) for number in range(nodes)}
    port.answers = known
    for _ in watched.round(threading.Event()):
        pass
    began = clock.now
    watched.pause(threading.Event())
    assert clock.now - began == pytest.approx(pause if nodes else 0.0)
    if not nodes:
        return
    assert max(port.waits) <= 0.1, "so that a stop is noticed"
    stop = threading.Event()
    stop.set()
    began = clock.now
    watched.pause(stop)
    assert clock.now == began


def test_the_time_of_the_round_counts_and_a_served_board_has_15_ms_to_be_changed(place: Place) -> None:
    watched, port, clock = place
    port.answers = {0x21: identity(ONE)}
    for _ in watched.round(threading.Event()):
        clock.now += 8.0  # the board is worked on
    began = clock.now
    port.announced = [announce(ONE)]  # its own restart meanwhile
    watched.pause(threading.Event())
    assert clock.now - began == pytest.approx(0.015)
    for _ in watched.round(threading.Event()):
        pass
    clock.now += 1.0
    began = clock.now
    watched.pause(threading.Event())
    assert clock.now == began
    port.announced = [announce(TWO)]
    for _ in watched.round(threading.Event()):
        pass
    began = clock.now
    port.announced = [announce(TWO)]
    watched.pause(threading.Event())
    assert clock.now == began, "another board has announced itself"


def test_a_bus_that_was_lost_in_the_round_is_waited_for_without_it(place: Place) -> None:
    watched, port, clock = place
    port.answers = {0x21: identity(ONE), 0x22: identity(TWO)}
    round_of(watched)
    watched.lost()
    pauses = list[float]()

    def wait(seconds: float) -> None:
        pauses.append(seconds)
        clock.now += seconds

    stop: Any = SimpleNamespace(is_set=lambda: False, wait=wait)
    watched.pause(stop)
    assert pauses == [pytest.approx(0.06)]
    assert port.waits == []


def test_an_announce_ends_the_pause_in_the_middle(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    watched, port, clock = place
    port.answers = {number + 1: identity(bytes([number, 9] * 5)) for number in range(20)}
    for _ in watched.round(threading.Event()):
        pass
    monkeypatch.setattr(port, "get_all", lambda _seconds: [])
    port.announced = [announce(TWO)]
    began = clock.now
    watched.pause(threading.Event())
    assert clock.now - began == pytest.approx(0.1), "of six tenths"
