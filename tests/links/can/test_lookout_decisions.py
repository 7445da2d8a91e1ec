"""Whom the discovery of a bus asks, and when (operation.md section 7). Bus, sightings and clock are mocks."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import AddressConflictError, LinkError
from teds_provision.links import discovery as of_discovery
from teds_provision.links.can import discovery as of_can
from teds_provision.links.can.discovery import CanDiscovery
from teds_provision.links.can.identify_broadcast import FunctionalAnswers
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.spec import parse_spec
from teds_provision.protocol.announce import Announce
from teds_provision.protocol.messages.identity import Identity, NodeState


def who(number: int) -> Identity:
    return Identity(bytes([number] * 10), NodeState.KEYED, 1, 2, 1024, number)


class Scene:
    """A discovery, its port and who waits for whom; ``course`` is what was asked and reported."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, where: str = "virtual:mock", poll: float | None = 30.0) -> None:
        self.now, self.place, self.spec = 100.0, "can:mock", parse_spec(where)
        self.course: list[Any] = []
        self.answers = FunctionalAnswers()
        self.settles: FunctionalAnswers | None = None
        self.there: dict[int, Identity | Exception] = {}
        self.awaited, self.welcome = set[int](), set[int]()
        self.gone = 0
        self.stops_after = 99
        thread = SimpleNamespace(start=lambda: None, join=lambda seconds: self.course.append(("join", seconds)))
        monkeypatch.setattr(of_discovery.threading, "Thread", lambda **_words: thread)
        monkeypatch.setattr(of_can, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(of_can, "ask_all", self._ask_all)
        mock: Any = self
        self.lookout = CanDiscovery(mock, mock, poll=poll)

    # -- the port

    def bus(self) -> Any:
        return "bus"

    def next_transaction(self) -> int:
        return 7

    def identify(self, node: int, *, seconds: float, until_announced: bool, once: bool) -> Identity | None:
        self.course.append(("ask", node, seconds, until_announced, once))
        found = self.there.get(node)
        if isinstance(found, Exception):
            raise found
        return found

    def settled(self, found: FunctionalAnswers, until: float) -> FunctionalAnswers:
        assert (found, until) == (self.answers, 106.0)
        return found if self.settles is None else self.settles

    def _ask_all(self, bus: object, transaction: int, *, silence: float, longest: float) -> Iterator[Any]:
        assert (bus, transaction, silence, longest) == ("bus", 7, 0.3, 3.0)
        self.course.append("ask all")
        for count, (address, identity) in enumerate(self.answers.identities.items(), 1):
            if count == self.stops_after:
                self.lookout._stop.set()
            yield address, identity
        yield self.answers

    # -- who waits

    def add_sighting(self, sighting: Any) -> None:
        assert sighting.port is self
        assert sighting.at == self.now
        self.course.append(("saw", sighting.address, sighting.uuid[0]))

    def conflict(self, place: str, address: int, error: AddressConflictError) -> None:
        assert (place, error.message) == ("can:mock", f"Two nodes answer at CAN address 0x{address:02X}.")
        self.course.append(("conflict", address))

    def report(self, text: str) -> None:
        self.course.append(text)

    def announced(self, place: str, announce: Announce) -> None:
        assert place == "can:mock"
        self.course.append(("announced", announce.address))

    def is_awaited(self, announce: Announce) -> bool:
        return announce.crc in self.awaited

    def is_welcome(self, announce: Announce) -> bool:
        return announce.crc in self.welcome

    def hear(self, address: int, crc: int = 5, *, pressed: bool = False) -> float:
        news = Announce(address, 2, crc, pressed)
        return self.lookout._heard(Frame(news.identifier, news.encode()))

    def asked(self) -> list[Any]:
        found, self.course = self.course, []
        return found


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Scene:
    return Scene(monkeypatch)


def test_four_announces_of_a_missing_node_are_believed_in_ten_seconds(scene: Scene) -> None:
    """Any device can send them: each that is believed leads to a broadcast, 50 ms after the one before."""
    scene.awaited = {5, 6}
    found = []
    for moment in (0.0, 1.0, 2.0, 9.0, 9.9, 10.0, 10.9, 11.0, 11.5, 12.0):
        scene.now = 100.0 + moment
        found.append(scene.hear(0x21))
    believed, not_believed = 0.05, math.inf
    assert found == [believed] * 4 + [not_believed, believed, not_believed, believed, not_believed, believed]
    assert scene.hear(0x22, 6) == 0.05, "each missing node has its own four"
    assert scene.asked() == [("announced", 0x21)] * 10 + [("announced", 0x22)]


def test_a_node_that_is_measured_as_soon_as_it_comes_is_asked_alone(scene: Scene) -> None:
    scene.welcome, scene.there = {5}, {0x21: who(1)}
    found = [scene.hear(0x21) for _ in range(6)]
    assert found == [math.inf] * 6, "a broadcast's answers would delay the data of other nodes"
    asked = [("announced", 0x21), ("ask", 0x21, 0.5, False, False), ("saw", 0x21, 1)]
    assert scene.asked() == asked * 4 + [("announced", 0x21)] * 2
    assert list(scene.lookout._announcers) == [0x21], "beyond that it has its turn as any other"


@pytest.mark.parametrize("poll", [None, 30.0])
def test_others_have_their_turn_once_if_the_bus_is_polled(monkeypatch: pytest.MonkeyPatch, poll: float | None) -> None:
    scene = Scene(monkeypatch, poll=poll)
    found = [scene.hear(address) for address in (0x21, 0x22, 0x21)]
    assert found == [math.inf] * 3
    assert list(scene.lookout._announcers) == ([] if poll is None else [0x21, 0x22])
    scene.asked()
    scene.awaited = {5}
    assert scene.hear(0x23, pressed=True) == math.inf, "a press is no start"
    assert scene.lookout._heard(None) == scene.lookout._heard(Frame(0x1CFF0021, b"short")) == math.inf
    assert scene.asked() == []
    assert 0x23 not in scene.lookout._announcers


def test_an_announcer_is_asked_once_in_ten_seconds_and_all_five_times_a_second(scene: Scene) -> None:
    """A torn answer counts too: any device can send an Announce."""
    for address in (0x21, 0x22, 0x23):
        scene.hear(address)
    scene.asked()
    asked = list[Any]()
    for moment in (0.0, 0.1, 0.2, 0.3, 0.4, 0.6):
        scene.now = 100.0 + moment
        scene.lookout._ask_announcer()
        asked += [(round(scene.now - 100, 1), word[1], word[2:]) for word in scene.asked()]
    once = (0.5, False, True)
    assert asked == [(0.0, 0x21, once), (0.2, 0x22, once), (0.4, 0x23, once)]
    for moment, address in ((9.9, None), (10.0, 0x21), (10.1, None), (10.2, 0x22)):
        scene.now = 100.0 + moment
        for other in (0x21, 0x22):
            scene.hear(other)
        scene.asked()
        scene.lookout._ask_announcer()
        assert [word[1] for word in scene.asked()] == ([] if address is None else [address]), moment


def test_a_round_reports_each_node_at_once_and_what_was_unclear_when_it_is_settled(scene: Scene) -> None:
    scene.answers = FunctionalAnswers({0x25: who(1), 0x21: who(2)}, {0x22, 0x30}, {0x23})
    scene.settles = FunctionalAnswers(
        {0x25: who(1), 0x21: who(2), 0x23: who(4), 0x22: who(1)}, {0x31, 0x30}, set(), set(), set()
    )
    scene.lookout.failure = LinkError("gone")
    scene.lookout._ask()
    assert scene.asked() == [
        "ask all",
        ("saw", 0x25, 1),
        ("saw", 0x21, 2),
        ("conflict", 0x30),
        ("conflict", 0x31),
        ("saw", 0x22, 1),
        ("saw", 0x23, 4),
        f"Node {'01' * 10} answers at 0x22 and 0x25: one of them is an impostor.",
    ]
    assert scene.lookout.failure is None
    assert (scene.lookout._begun, scene.lookout._finished) == (1, 1)


def test_a_round_ends_early_with_its_discovery(scene: Scene) -> None:
    scene.answers, scene.stops_after = FunctionalAnswers({0x25: who(1), 0x21: who(2)}), 1
    scene.lookout._ask()
    assert scene.asked() == ["ask all", ("saw", 0x25, 1)]
    scene.lookout.close()
    assert scene.asked() == [("join", 5.0)]
    assert scene.lookout._asked.is_set(), "its thread wakes at once"


def test_the_one_node_of_the_option_is_asked_alone_and_a_conflict_there_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    scene = Scene(monkeypatch, "virtual:mock?node=0x21")
    scene.there = {0x21: who(9)}
    scene.lookout._ask()
    scene.there = {0x21: AddressConflictError("two")}
    scene.lookout._ask()
    scene.there = {}
    scene.lookout._ask()
    ask = ("ask", 0x21, 1.0, False, False)
    assert scene.asked() == [ask, ("saw", 0x21, 9), ask, ("conflict", 0x21), ask]
    assert scene.lookout._finished == 3


def test_a_caller_that_asks_one_address_is_answered_by_its_announce_too(scene: Scene) -> None:
    scene.there = {0x21: who(9)}
    scene.lookout.identify_at(0x21, 0.25)
    assert scene.asked() == [("ask", 0x21, 0.25, True, False), ("saw", 0x21, 9)]
    scene.there = {0x21: LinkError("gone")}
    with pytest.raises(LinkError):
        scene.lookout.identify_at(0x21, 0.25)


def test_a_bus_that_fails_ends_the_wait_of_everyone_and_is_tried_again_each_second(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    lookout, pauses = scene.lookout, list[float]()
    stop = SimpleNamespace(is_set=lambda: len(pauses) == 2, wait=pauses.append)
    monkeypatch.setattr(lookout, "_stop", stop)
    monkeypatch.setattr(lookout, "_watch", lambda: (_ for _ in ()).throw(LinkError("gone")))
    lookout._asked.set()
    lookout._run()
    assert pauses == [1.0, 1.0]
    assert (lookout._begun, lookout._finished, lookout._asked.is_set()) == (2, 2, False)
    with pytest.raises(LinkError, match="gone"):
        lookout.discover(0.0)


class Watched(Scene):
    """A scene whose bus is listened to for ``seconds``; ``at`` says what happens when."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, seconds: float, **at: Any) -> None:
        super().__init__(monkeypatch, poll=at.pop("poll", None))
        self.end, self.at, self.rounds = 100.0 + seconds, at, list[float]()
        self.is_missing: bool = at.pop("missing", False)
        monkeypatch.setattr(of_discovery, "time", SimpleNamespace(monotonic=lambda: self.now))
        monkeypatch.setattr(self.lookout, "_ask", self._round)
        self.lookout._watch()

    def bus(self) -> Any:
        return self

    def missing(self) -> bool:
        return self.is_missing

    @contextmanager
    def listen(self, wanted: Any, *, most: int) -> Iterator[Any]:
        assert most == 256
        assert [wanted(Frame(number, b"")) for number in (0x1CFF0021, 0x18DAF121)] == [True, False]
        yield self

    def get(self, seconds: float) -> Frame | None:
        assert seconds == 0.05
        self.now = round(self.now + seconds, 3)
        if self.now >= self.end:
            self.lookout._stop.set()
        for what in [what for what, moment in self.at.items() if self.now >= 100.0 + moment]:
            del self.at[what]
            if what == "asked":
                self.lookout._asked.set()
            elif what == "gone":
                self.gone += 1
            else:
                self.awaited = {5} if what == "announced" else set()
                news = Announce(0x21, 2, 5)
                return Frame(news.identifier, news.encode())
        return None

    def _round(self) -> None:
        self.lookout._round_begins()
        self.rounds.append(round(self.now - 100.0, 2))


@pytest.mark.parametrize(
    ("seconds", "at", "rounds"),
    [
        (40.0, {}, [0.0]),
        (65.0, {"poll": 30.0}, [0.0, 30.0, 60.0]),
        (70.0, {"missing": True}, [0.0, 0.05, 1.05, 3.05, 7.05, 15.05, 31.05, 61.05]),
        (9.0, {"asked": 5.0}, [0.0, 5.0]),
        (14.0, {"missing": True, "gone": 10.0}, [0.0, 0.05, 1.05, 3.05, 7.05, 10.0, 10.05, 11.05, 13.1]),
        (9.0, {"announced": 5.0}, [0.0, 5.0]),
        (9.0, {"foreign": 5.0}, [0.0]),
        (9.0, {"missing": True, "announced": 5.0}, [0.0, 0.05, 1.05, 3.05, 5.0, 5.05, 6.05, 8.05]),
    ],
)
def test_everyone_is_asked_at_the_start_for_who_is_missing_and_as_often_as_it_is_polled(
    monkeypatch: pytest.MonkeyPatch, seconds: float, at: dict[str, Any], rounds: list[float]
) -> None:
    assert Watched(monkeypatch, seconds, **at).rounds == pytest.approx(rounds, abs=0.11)
