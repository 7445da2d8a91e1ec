"""How often a look-out asks (operation.md section 7), over a bus that writes every frame down; and who has left."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import AddressConflictError, LinkError
from teds_provision.links import discovery as links_discovery
from teds_provision.links.can import discovery
from teds_provision.links.can.discovery import BELIEVED, EACH, SOON, CanDiscovery
from teds_provision.links.can.isotp import Frame
from teds_provision.links.can.port import CanPort
from teds_provision.links.discovery import LEAST, MOST, BroadcastPace, Sighting
from teds_provision.measure.presence import Presence
from teds_provision.ncap.nodes.link_watch import MAX_PARALLEL, PresenceCheck
from teds_provision.ncap.waits import USUAL
from teds_provision.protocol.announce import Announce, is_announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState
from tests.links.can.conftest import hub, nodes  # noqa: F401  fixtures
from tests.links.can.hub import Hub
from tests.links.can.test_can_loss import Start
from tests.measure.test_lookout import ONE, seen
from tests.pace import PATIENCE, best_of, until

pytestmark = pytest.mark.link
ADDRESSES = list(range(0x21, 0x21 + 20))


def asked(bus: Hub) -> Counter[int]:
    """Return how often each address was asked by itself; 0: everybody."""
    found = Counter[int]()
    for identifier, data in list(bus.frames):
        if identifier >> 8 == 0x18DBFF:
            found[0] += 1
        elif identifier >> 16 == 0x18DA and identifier & 0xFF == 0xF1 and data[0] == 7:
            found[identifier >> 8 & 0xFF] += 1
    return found


def announced(bus: Hub) -> set[int]:
    """Addresses that announced themselves."""
    return {identifier & 0xFF for identifier, _ in list(bus.frames) if is_announce(identifier)}


@pytest.fixture
def lookout(hub: Hub, nodes: Start) -> Iterator[CanDiscovery]:  # noqa: F811
    nodes(hub.spec, *ADDRESSES)
    until(lambda: announced(hub) >= {*ADDRESSES}, "every node has sent the Announce of its start")
    port = CanPort(hub.spec)
    made = CanDiscovery(port, Presence(), poll=30.0)
    made.discover()
    until(lambda: made._finished == made._begun and not made._asked.is_set(), "every answer of the start has come")
    assert not made._asked_at, "an address that was asked already has no turn for 10 s"
    yield made
    made.close()
    port.close()


def announce(bus: Hub, address: int, crc: bytes = b"\xaa\xbb\xcc\xdd") -> None:
    bus.send(0x1CFF0000 | address, bytes([1, 2]) + crc + bytes(2))


def test_who_announces_itself_is_asked_once_in_ten_seconds_and_five_a_second_over_all(
    lookout: CanDiscovery,
    hub: Hub,  # noqa: F811
) -> None:
    hub.frames.clear()
    began = time.monotonic()
    while time.monotonic() - began < 2.0 or len(asked(hub)) < 5:
        for address in ADDRESSES:
            announce(hub, address)
        time.sleep(0.05)
        assert time.monotonic() - began < 25, "before everybody is asked again, after 30 s"
    found = asked(hub)
    passed = time.monotonic() - began
    assert found[0] == 0, "nobody asks the whole bus because somebody sends Announce"
    assert set(found.values()) == {1} or passed > 10, found
    assert sum(found.values()) <= 5 * passed + 1


def test_an_announcer_whose_answer_is_torn_is_asked_once_in_ten_seconds_too(
    lookout: CanDiscovery,
    hub: Hub,  # noqa: F811
) -> None:
    """A torn answer was asked for again at once: a device that announces itself could have all the air."""
    torn, began = ADDRESSES[0], time.monotonic()
    answers: list[bytes] = []

    def is_lost(identifier: int, data: bytes) -> bool:
        answer = identifier == 0x18DAF100 | torn
        answers.extend([data] if answer else [])
        return answer and data[0] >> 4 == 2

    hub.frames.clear()
    hub.lose = is_lost
    announce(hub, torn)
    until(lambda: answers, "it began to answer")
    for other in ADDRESSES[1:3]:
        announce(hub, other)
    until(lambda: {*asked(hub)} >= {torn, *ADDRESSES[1:3]}, "the next ones had their turn")
    assert asked(hub)[torn] == 1 or time.monotonic() - began > 10, asked(hub)


@pytest.mark.realtime
def test_a_node_that_a_caller_waits_for_is_looked_for_at_once(lookout: CanDiscovery, hub: Hub) -> None:  # noqa: F811
    with looked_for(lookout):
        until(lambda: asked(hub)[0] >= 4, "somebody is missing: at the start, at once, after 1 s, after 2 s")
        hub.frames.clear()
        began = time.monotonic()
        announce(hub, 0x21, uuid_crc(ONE).to_bytes(4, "big"))
        until(lambda: asked(hub)[0])
        assert time.monotonic() - began < 3, "the next question without an Announce comes after 4 s"


@pytest.mark.realtime
def test_a_question_that_the_missing_node_did_not_hear_is_asked_again_at_once(
    lookout: CanDiscovery,
    hub: Hub,  # noqa: F811
) -> None:
    """The second one came a second later, and in a measurement of many nodes all others waited for it."""

    def pause() -> float:
        hub.frames.clear()
        announce(hub, 0x21, uuid_crc(ONE).to_bytes(4, "big"))
        until(lambda: asked(hub)[0] >= 1, "because it announced itself")
        began = time.monotonic()
        until(lambda: asked(hub)[0] >= 2, "because it is still missing")
        return time.monotonic() - began

    with looked_for(lookout):
        until(lambda: asked(hub)[0] >= 3)
        best_of(BELIEVED - 1, LEAST, pause, because="as many announcements are believed")
    pace = BroadcastPace(time.monotonic(), first=SOON)
    until(lambda: pace.is_due(wanted=False, missing=True, poll=None))
    pace.asked = time.monotonic()
    assert not pace.is_due(wanted=False, missing=True, poll=None), "from there on after 1 s, doubling"


def test_who_goes_on_announcing_a_missing_node_does_not_cause_endless_broadcasts(lookout: CanDiscovery) -> None:
    words = Announce(0x21, NodeState.PROVISIONED, uuid_crc(ONE))
    frame = Frame(words.identifier, words.encode())
    with looked_for(lookout):
        assert [lookout._heard(frame) for _ in range(3 * BELIEVED)] == [SOON] * BELIEVED + [math.inf] * 2 * BELIEVED


@pytest.mark.realtime
def test_a_node_that_is_lost_is_looked_for_at_once_while_another_one_is_missing_for_long(
    lookout: CanDiscovery,
    hub: Hub,  # noqa: F811
) -> None:
    """The pause had grown with the absence of the other one, to 30 s."""
    sightings, stop = lookout._presence, threading.Event()
    [*_, found] = sightings.all()

    def lost() -> float:
        sightings.add_sighting(replace(found, at=time.monotonic()))
        asked_before, began = asked(hub)[0], time.monotonic()
        sightings.search_again(found)
        with suppress(LinkError):
            sightings.find(found.uuid, seconds=PATIENCE, stop=stop, fresh=time.monotonic())
        assert asked(hub)[0] > asked_before
        return time.monotonic() - began

    with looked_for(lookout):
        until(lambda: asked(hub)[0] >= 5, "at the start, at once, after 1, 2 and 4 s; the next one comes after 8 s")
        until(lambda: lookout._finished == lookout._begun, "that question is answered")
        best_of(3, 4.0, lost)
    stop.set()


def test_a_broadcast_now_and_then_finds_a_node_whose_announce_was_lost(
    lookout: CanDiscovery,
    hub: Hub,  # noqa: F811
) -> None:
    hub.frames.clear()
    time.sleep(1.0)
    assert not asked(hub)[0], "nobody is missing, and 30 s have not passed"
    lookout.poll(0.2)
    until(lambda: asked(hub)[0] >= 2)


@contextmanager
def looked_for(lookout: CanDiscovery) -> Iterator[None]:
    """Somebody waits for a node that is not there."""
    stop = threading.Event()

    def wait() -> None:
        with suppress(LinkError):
            lookout._presence.find(ONE, seconds=PATIENCE, stop=stop)

    waiting = threading.Thread(target=wait)
    waiting.start()
    until(lookout._presence.missing)
    try:
        yield
    finally:
        stop.set()
        waiting.join()


class Bus:
    """Answer Identify from ``answers``, by address."""

    place = "can:x"

    def __init__(self, **answers: Any) -> None:
        self.answers: dict[int, Any] = {int(name[1:]): what for name, what in answers.items()}
        self.questions: list[tuple[int, float]] = []

    def identify(self, address: int, *, seconds: float, until_announced: bool) -> Identity | None:
        assert until_announced == (seconds < 3.0), "the last question is waited for to its end"
        self.questions.append((address, seconds))
        answer = self.answers.get(address)
        if isinstance(answer, list):
            answer = answer.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer  # type: ignore[no-any-return]


def last_heard(uuid: bytes, address: int, ago: float) -> Sighting:
    return seen(uuid, address, at=time.monotonic() - ago)


def asks(bus: Bus, known: dict[str, Sighting], held: str = "") -> dict[str, bool]:
    port: Any = bus
    found = PresenceCheck(port, lambda uuid: uuid == held).look(known)
    return {uuid: sighting is not None for uuid, sighting in found}


def test_a_node_is_gone_when_it_does_not_answer_twice_and_not_before() -> None:
    uuids = {number: bytes([number]) * 10 for number in range(1, 6)}
    known = {uuid.hex(): last_heard(uuid, number, 2 * USUAL.silent_node) for number, uuid in uuids.items()}
    known["fresh"] = last_heard(ONE, 9, USUAL.silent_node / 2)
    other = seen(b"\x63" * 10, 3).identity
    bus = Bus(
        a1=None, a2=[None, seen(uuids[2], 2).identity], a3=other, a4=AddressConflictError("two"), a5=LinkError("x")
    )
    names = {number: uuid.hex() for number, uuid in uuids.items()}
    assert asks(bus, known) == {
        names[1]: False, names[2]: True, names[3]: False, names[4]: True, names[5]: False,
    }  # fmt: skip
    assert [question for question in bus.questions if question[0] == 1] == [(1, 1.0), (1, 3.0)]
    assert 9 not in dict(bus.questions), "one that was heard of lately is left in peace"


def test_who_is_held_is_not_asked_and_no_more_than_five_are_at_once() -> None:
    uuids = [bytes([number]) * 10 for number in range(1, 12)]
    silence = 2 * USUAL.silent_node
    known = {uuid.hex(): last_heard(uuid, number, silence + number) for number, uuid in enumerate(uuids, 1)}
    found = asks(Bus(), known, held=uuids[-1].hex())
    assert list(found) == [uuid.hex() for uuid in reversed(uuids[-1 - MAX_PARALLEL : -1])]


def test_a_node_that_starts_often_is_believed_again_ten_seconds_later(monkeypatch: pytest.MonkeyPatch) -> None:
    now, words = [100.0], Announce(0x21, NodeState.PROVISIONED, uuid_crc(ONE))
    monkeypatch.setattr(discovery, "time", SimpleNamespace(monotonic=lambda: now[0]))
    looks = CanDiscovery.__new__(CanDiscovery)  # without its thread and its bus
    looks._awaited = {}
    assert [looks._believes(words) for _ in range(BELIEVED + 1)] == [True] * BELIEVED + [False]
    now[0] += EACH
    assert looks._believes(words)


class Heard:
    """A discovery without its thread and its bus; ``course`` is what it did because of Announces."""

    def __init__(self, poll: float | None, awaited: bool, welcome: bool) -> None:
        self.course = list[object]()
        made = self.looks = CanDiscovery.__new__(CanDiscovery)
        made._awaited, made._announcers, made._asked_at, made._poll = {}, deque(maxlen=239), {}, poll
        presence: Any = SimpleNamespace(
            announced=lambda place, announce: self.course.append((place, announce.address)),
            is_awaited=lambda _announce: awaited,
            is_welcome=lambda _announce: welcome,
        )
        port: Any = SimpleNamespace(place="can:x")
        made._presence, made.port = presence, port
        made._ask_one = lambda address, *_seconds, **_more: self.course.append(address)  # type: ignore[method-assign]

    def hear(self, data: str, identifier: int = 0x1CFF0021) -> float:
        return self.looks._heard(Frame(identifier, bytes.fromhex(data)))


@pytest.mark.parametrize(
    ("poll", "awaited", "welcome", "soon", "course", "queued"),
    [
        (None, False, False, math.inf, [("can:x", 0x21)], []),
        (30.0, False, False, math.inf, [("can:x", 0x21)], [0x21]),
        (30.0, True, True, 0.05, [("can:x", 0x21)], []),
        (30.0, False, True, math.inf, [("can:x", 0x21), 0x21], []),
        (None, False, True, math.inf, [("can:x", 0x21), 0x21], []),
    ],
)
def test_what_an_announce_leads_to_and_that_one_of_a_pressed_button_leads_to_nothing(
    poll: float | None, awaited: bool, welcome: bool, soon: float, course: list[object], queued: list[int]
) -> None:
    """Nobody claims, asks or subscribes because of a pressed button (wire.md, "CAN")."""
    for data, identifier in (
        ("01 02 aabbccdd 01 00", 0x1CFF0021),
        ("02 02 aabbccdd 00 00", 0x1CFF0021),
        ("01 02 aabbccdd 00", 0x1CFF0021),
        ("01 02 aabbccdd 00 00", 0x1CFF2021),
    ):
        silent = Heard(poll, awaited, welcome)
        assert silent.hear(data, identifier) == math.inf
        assert (silent.course, list(silent.looks._announcers)) == ([], [])
    heard = Heard(poll, awaited, welcome)
    assert heard.hear("01 02 aabbccdd 00 00") == soon
    assert (heard.course, list(heard.looks._announcers)) == (course, queued)
    heard.hear("01 02 aabbccdd 00 00")
    assert list(heard.looks._announcers) == queued, "an address has one turn, however often it announces itself"


def test_those_who_announce_themselves_are_asked_each_in_10_s_and_all_in_a_fifth_of_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(discovery, "time", SimpleNamespace(monotonic=lambda: now[0]))
    heard = Heard(30.0, awaited=False, welcome=False)
    looks, course = heard.looks, heard.course
    for at, announced, asked in (
        (100.0, [1, 2, 3], [1]),
        (100.15, [], []),
        (100.25, [], [2]),
        (100.5, [1, 2], [3]),
        (109.0, [], []),  # both were asked within 10 s, and have lost their turn
        (109.75, [1, 4], [4]),
        (110.0, [2, 1], [1]),
        (111.0, [2], [2]),
        (111.1, [5], []),
        (111.25, [], [5]),
    ):
        now[0] = at
        looks._announcers.extend(announced)
        course.clear()
        looks._ask_announcer()
        assert course == asked, at


def test_the_pause_begins_again_once_no_node_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    """The next one that was missing waited for what the absence of the one before had come to, up to 30 s."""
    now = [0.0]
    monkeypatch.setattr(links_discovery, "time", SimpleNamespace(monotonic=lambda: now[0]))
    pace = BroadcastPace(0.0)
    for _ in range(5):
        now[0] += MOST
        assert pace.is_due(wanted=False, missing=True, poll=None)
        pace.asked = now[0]
    assert not pace.is_due(wanted=False, missing=False, poll=None)
    now[0] += LEAST
    assert pace.is_due(wanted=False, missing=True, poll=None)


def test_who_waits_for_the_next_round_gets_the_failure_of_the_bus_at_once() -> None:
    made = CanDiscovery.__new__(CanDiscovery)
    made._stop, made._asked, made._turn = threading.Event(), threading.Event(), threading.Condition()
    made._begun = made._finished = 4
    made.failure = None
    rests: list[float] = []

    def fails() -> None:
        raise LinkError("The adapter was pulled out.")

    def rest(seconds: float) -> None:
        rests.append(seconds)
        made._stop.set()

    made._watch = fails  # type: ignore[method-assign]
    made._stop.wait = rest  # type: ignore[assignment,method-assign]
    made._asked.set()  # a thread that waits for round 5
    made._run()
    assert (made._begun, made._finished, made._asked.is_set()) == (5, 5, False)
    assert made.failure is not None
    assert (made.failure.message, rests) == ("The adapter was pulled out.", [1.0])
