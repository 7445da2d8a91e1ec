"""Who is on a link: nobody stays there for ever, and nobody who makes up names fills it."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, FrozenError, LinkError, NodeBusyError
from teds_provision.links import Notice
from teds_provision.measure import buses as buses_module
from teds_provision.measure.blocks import NodeReport
from teds_provision.measure.buses import Buses
from teds_provision.ncap.measurement_supervisor import MeasurementSupervisor
from teds_provision.ncap.membership import Member, Membership
from teds_provision.ncap.nodes import link_watch
from teds_provision.ncap.nodes.directory import MOST_GONE, NodeDirectory
from teds_provision.ncap.nodes.inspection import look
from teds_provision.ncap.nodes.link_watch import MOST_KNOWN, LinkWatch, PresenceCheck
from teds_provision.ncap.nodes.node_jobs import NodeLocks
from teds_provision.ncap.running_measurement import RunningMeasurement
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.conversation import Conversation, SessionLostError
from teds_provision.station.store.records import KeptMeasurement
from tests.bench import MemoryLink, contact, copied_station, make_station
from tests.pace import until
from tests.provisioning.test_firmware import FirmwareBoard


class NoListeners:
    """Nobody listens."""

    def event(self, *_words: Any, **_facts: Any) -> None: ...

    def last(self, *_words: Any) -> None: ...


def test_the_firmware_of_a_board_without_a_key_here_is_shown_as_unverified_and_not_stored(tmp_path: Path) -> None:
    station, stranger = make_station(tmp_path / "home"), FirmwareBoard()
    station.unlock()
    with Conversation(contact(stranger, MemoryLink(stranger, via="can")), notice=lambda _notice: None) as node:
        found = look(station, node)
    assert found.firmware is not None
    assert (found.firmware["version"], found.firmware["from"], found.firmware["state"]) == (
        "1.2.0",
        "plain",
        "unjudged",
    )
    assert station.firmware_reports.get(stranger.uuid) is None
    directory = NodeDirectory(station, NoListeners())  # type: ignore[arg-type]
    directory.note(stranger.uuid.hex(), "verified", firmware=found.firmware)
    assert directory.node(stranger.uuid.hex())["firmware"] == found.firmware
    station.close()


def test_channels_are_shown_anew_in_the_units_that_their_profiles_name_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    station = copied_station(tmp_path / "home")
    directory = NodeDirectory(station, NoListeners())  # type: ignore[arg-type]
    nodes = {"aa": "arm", "bb": "finger", "cc": "arm"}
    monkeypatch.setattr(directory, "_stored", lambda uuid: SimpleNamespace(profile=nodes[uuid]))
    directory._shown_in.update({uuid: {1: "mm"} for uuid in nodes})
    directory._channels.update({uuid: ("digest", []) for uuid in nodes})
    now = {"arm": {1: "mm"}, "finger": {1: "cm"}}
    homes = set[Path]()
    monkeypatch.setattr(
        "teds_provision.ncap.nodes.directory.units_of_profile", lambda name, home: homes.add(home) or now[name]
    )
    before = directory.changes
    assert directory.follow_profiles() == ["bb"]
    assert (sorted(directory._channels), directory.changes) == (["aa", "cc"], before + 1)
    assert directory.follow_profiles() == []
    now["arm"] = {}
    assert directory.follow_profiles() == ["aa", "cc"]
    assert (directory._channels, directory.changes, homes) == ({}, before + 3, {station.home})
    station.close()


def sighting(number: int) -> Any:
    """Return a node that answered just now."""
    identity = SimpleNamespace(uuid=number.to_bytes(10, "big"), state=SimpleNamespace(name="FACTORY"))
    link = SimpleNamespace(capabilities=SimpleNamespace(tapped=False))
    contact = SimpleNamespace(identity=identity, link=link, address=number % 200)
    return SimpleNamespace(
        uuid=identity.uuid, identity=identity, address=number % 200, at=time.monotonic(), contact=lambda: contact
    )


@pytest.fixture
def watch(monkeypatch: pytest.MonkeyPatch) -> LinkWatch:
    nothing: Any = None
    silence: Any = NoListeners()
    monkeypatch.setattr(link_watch, "is_listed", lambda _station, _uuid: False)
    roster = NodeDirectory(nothing, silence)
    monkeypatch.setattr(roster, "refresh", lambda _uuids=None: None)
    return LinkWatch("can:x", nothing, roster, silence, NodeLocks(), nothing, lambda: True, nothing)


@pytest.fixture
def reader(watch: LinkWatch, monkeypatch: pytest.MonkeyPatch) -> Iterator[LinkWatch]:
    """Yield a watch on a reader that runs; ``open_place`` is to be given before it starts."""
    watch.place = "nfc:x"
    monkeypatch.setattr(watch._directory, "forget_place", lambda _place: None)
    yield watch
    watch.stop()
    watch.join(5)


class Reader:
    """A reader on which nothing lies."""

    closed = False

    def watch(self, *, stop: threading.Event, notice: Any) -> Iterator[Any]:
        stop.wait()
        yield from ()

    def close(self) -> None:
        self.closed = True


def present(watch: LinkWatch) -> int:
    return watch._directory.present(watch.place)


def test_a_node_that_went_just_before_the_broadcast_is_seen_to_leave(watch: LinkWatch) -> None:
    """What was known was forgotten at POST /discover, so nobody ever saw that it did not answer."""
    looked: list[str] = []
    watch._for_strangers = SimpleNamespace(submit=lambda _work, contact: looked.append(contact.identity.uuid.hex()))  # type: ignore[assignment]
    gone, stays = sighting(1), sighting(2)
    for item in (gone, stays):
        watch.on_sighting(item)
    watch._pending.clear()
    watch._look_for_all()
    watch.on_sighting(sighting(2))
    assert looked == [gone.uuid.hex(), stays.uuid.hex(), stays.uuid.hex()], "who answers is looked at anew"
    assert list(watch._known) == [gone.uuid.hex(), stays.uuid.hex()]
    gone.at -= 1000.0
    watch._see_who_left(100.0)
    assert not watch._directory.seen(gone.uuid.hex()).present
    assert watch._directory.seen(stays.uuid.hex()).present


def test_made_up_uuids_fill_no_more_than_the_limit(watch: LinkWatch, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that were being looked at when others came in their place stayed present for ever: 1,127 of them."""
    count, most = 3 * MOST_KNOWN, 0

    def serve(contact: Any) -> None:
        uuid = contact.identity.uuid.hex()
        with watch._node_locks.hold(uuid, "it is looked at"):
            time.sleep(0.001)
        with watch._guard:
            watch._pending.discard(uuid)

    monkeypatch.setattr(watch, "_serve", serve)
    with ThreadPoolExecutor(2) as workers:
        watch._for_strangers = workers
        for number in range(count):
            watch.on_sighting(sighting(number))
            most = max(most, present(watch))
            if number % 100 == 0:
                time.sleep(0.02)  # some are looked at meanwhile
    assert present(watch) == MOST_KNOWN
    assert most <= MOST_KNOWN + 2 + 1, "those that are looked at just now, and the newest"
    assert len(watch._directory._seen) <= MOST_KNOWN + MOST_GONE + 3


def test_what_was_looked_at_while_others_took_its_place_leaves(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    sighted = sighting(7)

    def serve(contact: Any) -> None:
        with watch._node_locks.hold(sighted.uuid.hex(), "it is looked at"):
            watch._gone(sighted.uuid.hex())
        watch._directory.note(sighted.uuid.hex(), "problem")

    monkeypatch.setattr(watch, "_serve", serve)
    watch._for_strangers = SimpleNamespace(submit=lambda work, contact: work(contact))  # type: ignore[assignment]
    watch.on_sighting(sighted)
    assert present(watch) == 0


def test_a_node_that_was_on_another_bus_meanwhile_is_shown_where_it_answers_now(watch: LinkWatch) -> None:
    looked: list[str] = []
    watch._for_strangers = SimpleNamespace(submit=lambda _work, contact: looked.append(contact.identity.uuid.hex()))  # type: ignore[assignment]
    uuid = sighting(4).uuid.hex()
    for times in (1, 1):
        watch.on_sighting(sighting(4))
        watch._pending.clear()
        assert len(looked) == times, "it is where it was: no news"
    watch._directory.note(uuid, "came", place="can:y", present=True)
    watch.on_sighting(sighting(4))
    assert len(looked) == 2
    assert watch._directory.seen(uuid).place == watch.place


def test_a_node_that_was_carried_to_another_bus_has_not_left(watch: LinkWatch) -> None:
    watch._for_strangers = SimpleNamespace(submit=lambda _work, _contact: None)  # type: ignore[assignment]
    uuid = sighting(5).uuid.hex()
    watch.on_sighting(sighting(5))
    watch._directory.note(uuid, "came", place="can:y", present=True)
    watch._gone(uuid)
    assert watch._directory.seen(uuid).present, "its silence here is no news of it"


@pytest.mark.parametrize("set_by", [-86_400.0, 86_400.0], ids=["back", "forward"])
def test_a_clock_that_is_set_keeps_no_node_from_being_looked_at_again(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch, set_by: float
) -> None:
    looked: list[str] = []
    watch._for_strangers = SimpleNamespace(submit=lambda _work, contact: looked.append(contact.identity.uuid.hex()))  # type: ignore[assignment]
    sighted = sighting(3)
    watch.on_sighting(sighted)
    watch._pending.clear()
    watch._directory.note(sighted.uuid.hex(), "problem", problem={"code": "link", "message": "It fell silent."})
    watch.on_sighting(sighting(3))
    assert len(looked) == 1, "not at once"
    now = time.time() + set_by
    monkeypatch.setattr(link_watch.time, "time", lambda: now)
    watch.on_sighting(sighting(3))
    assert len(looked) == 2


def test_what_a_link_reports_is_published_once_and_what_belongs_to_a_retry_is_not(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages: list[str] = []
    monkeypatch.setattr(watch._live, "event", lambda _kind, **facts: messages.append(facts["text"]), raising=False)
    for kind, text in (("foreign-tag", "a card"), ("foreign-tag", "a card"), ("retry", "again"), ("conflict", "two")):
        watch._notice(Notice(kind, text))
    assert messages == ["a card", "two"]


def test_a_reader_is_lent_again_while_it_is_being_opened(reader: LinkWatch, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second command of a script waited ten seconds, and then met a reader that the station had not closed."""
    opened: list[Reader] = []
    first, second = object(), object()

    def open_place(*_words: Any) -> Reader:
        if opened:  # the first borrower has just ended, and the next one is there before the reader is watched
            reader._borrowers.add(id(second))
            reader._anew.set()
        opened.append(Reader())
        return opened[-1]

    monkeypatch.setattr(link_watch, "open_place", open_place)
    reader.start()
    reader.borrow(first)
    reader.give_back(first)
    until(lambda: len(opened) == 2)
    until(lambda: opened[1].closed)
    assert reader.state.state == "lent"
    reader.give_back(second)


def test_a_reader_that_is_not_there_keeps_no_command_waiting(
    reader: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    def open_place(*_words: Any) -> Reader:
        raise LinkError("No reader there.")

    monkeypatch.setattr(link_watch, "open_place", open_place)
    monkeypatch.setattr(link_watch, "FIRST_PAUSE", 20.0)
    reader.start()
    until(lambda: reader.state.state == "down")
    began = time.monotonic()
    for _ in range(3):
        assert reader.borrow(reader)
        reader.give_back(reader)
    assert time.monotonic() - began < link_watch.LENDING / 2


def test_what_a_measurement_says_of_a_node_that_it_has_no_more_is_no_problem(watch: LinkWatch, tmp_path: Path) -> None:
    """Each reports once a second: an adopted node was measured, and shown with "Its datasheet is signed now"."""
    nothing: Any = None
    uuid, roster = "ab" * 10, watch._directory
    station = make_station(tmp_path)
    measuring = MeasurementSupervisor(station, roster, watch._live, NodeLocks(), nothing, nothing, nothing)
    left, has = (
        RunningMeasurement(kept, Membership(0.0, {uuid: Member() for uuid in uuids}), kept)
        for kept, uuids in (
            (KeptMeasurement("unverified", match="all"), ()),
            (KeptMeasurement("adopted", match="all"), (uuid,)),
        )
    )
    measuring._running = {"unverified": left, "adopted": has}
    measuring._report(has, NodeReport(uuid, "running"))
    for _ in range(2):
        measuring._report(left, NodeReport(uuid, "refused", "Its datasheet is signed now"))
        assert roster.seen(uuid).problem is None
    measuring._report(has, NodeReport(uuid, "lost", "No message of the node came for 2.1 s"))
    problem = roster.seen(uuid).problem
    station.close()
    assert problem is not None
    assert problem["message"] == "No message of the node came for 2.1 s"


def test_a_link_that_was_back_is_tried_a_second_after_it_is_lost_again(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pause had grown with its absence before, up to half a minute."""
    pauses, absent = list[float](), iter([True, True, False, True])

    def open_place(*_words: Any) -> Reader:
        if next(absent):
            raise LinkError("No adapter there.")
        return Reader()

    def lost(_port: Any) -> None:
        raise LinkError("The adapter was pulled.")

    def wait(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 4:
            watch._stop.set()

    monkeypatch.setattr(link_watch, "open_place", open_place)
    monkeypatch.setattr(watch, "_watch", lost)
    monkeypatch.setattr(watch, "_anew", SimpleNamespace(clear=lambda: None, wait=wait))
    watch._run()
    assert pauses == [1.0, 2.0, 1.0, 2.0]


def test_a_reader_that_two_commands_borrowed_is_lent_until_both_gave_it_back(watch: LinkWatch) -> None:
    watch.place = "nfc:x"
    watch._free.set()
    first, second = object(), object()
    for command in (first, second):
        assert watch.borrow(command)
    watch.give_back(first)
    assert watch._borrowers == {id(second)}
    watch.give_back(second)
    assert watch._borrowers == set()


def test_a_node_whose_state_or_address_changed_is_looked_at_anew(watch: LinkWatch) -> None:
    """One that was reset, or provisioned by a command of this machine, is another one to who adopts or measures."""
    looked: list[str] = []
    watch._for_strangers = SimpleNamespace(submit=lambda _work, contact: looked.append(contact.identity.state.name))  # type: ignore[assignment]

    provisioned, factory = (SimpleNamespace(name=name) for name in ("PROVISIONED", "FACTORY"))
    for address, state in ((3, factory), (3, factory), (3, provisioned), (3, provisioned), (4, provisioned)):
        again = sighting(3)
        again.address, again.identity.state = address, state
        watch.on_sighting(again)
        watch._pending.clear()
    assert looked == ["FACTORY", "PROVISIONED", "PROVISIONED"]


def test_of_a_reader_that_is_lost_nothing_is_there_any_more(watch: LinkWatch) -> None:
    uuid = sighting(5).uuid.hex()
    watch.on_sighting(sighting(5))
    watch._directory.note("cd" * 10, "came", place="can:y", present=True)
    watch._directory.stranger(watch.place, "ab" * 10, there=True)
    watch._notice(Notice("reader-lost", "The reader was pulled."))
    assert (watch.state.state, present(watch), watch._directory.strangers(watch.place)) == ("down", 0, 0)
    assert not watch._directory.seen(uuid).present
    assert watch._directory.seen("cd" * 10).present
    watch._notice(Notice("reader-ready", "The reader is back."))
    assert (watch.state.state, watch.state.problem) == ("up", None)


def test_of_silent_nodes_five_a_second_are_asked_and_each_once_in_ten(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bound of operation.md section 7: a bus of two hundred that fell silent is not flooded with questions."""
    now, asked = [1000.0], list[tuple[float, int]]()

    def identify(address: int, **_how: Any) -> None:
        asked.append((now[0], address))

    monkeypatch.setattr(link_watch.time, "monotonic", lambda: now[0])
    port: Any = SimpleNamespace(identify=identify)
    check = PresenceCheck(port, lambda uuid: uuid == "held")
    known: dict[str, Any] = {f"{number}": SimpleNamespace(at=900.0 + number, address=number) for number in range(12)}
    known["held"] = SimpleNamespace(at=0.0, address=99)
    known["heard"] = SimpleNamespace(at=999.0, address=98)
    counts = {}
    for after in (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 10.0):
        now[0] = 1000.0 + after
        counts[after] = len(list(check.look(known)))
    assert counts == {0.0: 5, 0.5: 0, 1.0: 5, 2.0: 2, 3.0: 0, 4.0: 0, 10.0: 5}
    assert {address for at, address in asked if at == 1000.0} == {0, 1, 2, 3, 4}, "those that are silent longest"
    assert not {98, 99} & {address for _, address in asked}


def test_a_bus_that_is_lost_between_two_looks_is_not_closed_by_its_watch(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its discovery opens it again; a closed one is no bus of any measurement or discovery any more."""
    states, looks = list[str](), list[str]()

    def lost(_notice: object) -> None:
        looks.append("lost")
        if len(looks) == 3:
            watch._stop.set()
        raise LinkError("The adapter was pulled.")

    discovery = SimpleNamespace(poll=lambda _seconds: None, failure=None)
    buses: Any = SimpleNamespace(add=lambda _port: SimpleNamespace(discovery=discovery))
    monkeypatch.setattr(watch, "_buses", buses)
    monkeypatch.setattr(watch, "_anew", SimpleNamespace(is_set=lambda: False, wait=lambda _seconds: None))
    monkeypatch.setattr(watch, "_publish_state", lambda state, _problem=None: states.append(state))
    port: Any = SimpleNamespace(
        poll_seconds=30.0, capabilities=SimpleNamespace(connectionless=False), report_rivals=lost
    )
    watch._watch_bus(port)
    assert (looks, states) == (["lost"] * 3, ["up"] * 3)


@pytest.mark.parametrize("connectionless", [True, False])
def test_on_a_bus_that_works_who_does_not_answer_is_gone_unless_another_part_works_with_it(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch, connectionless: bool
) -> None:
    """A bus that fails shows nobody as gone at once, and one that asks no single node waits for its silence."""
    there, away, held = sighting(1), "bb" * 10, "cc" * 10
    course: list[Any] = []
    failures: list[LinkError | None] = [None, LinkError("gone"), None]
    anew = [True, False, False]

    class Check:
        def __init__(self, port: Any, is_held: Any, waits: Any) -> None:
            course.append(("asks", port is bus_port, is_held(held), is_held(away), waits is watch._waits))

        def look(self, known: Any) -> Any:
            assert known == {there.uuid.hex(): there}
            return [(there.uuid.hex(), there), (away, None), (held, None)]

    def wait(seconds: float) -> None:
        course.append(("wait", seconds))
        if len(failures) == 1:
            watch._stop.set()
        failures.pop(0)
        anew.pop(0)

    def discover() -> None:
        course.append("discover")
        raise LinkError("gone just now")

    monkeypatch.setattr(link_watch, "PresenceCheck", Check)

    class Looks:
        def poll(self, seconds: float) -> None:
            course.append(("poll", seconds))

        def discover(self) -> None:
            discover()

        @property
        def failure(self) -> LinkError | None:
            return failures[0]

    buses: Any = SimpleNamespace(add=lambda _port: SimpleNamespace(discovery=Looks()))
    monkeypatch.setattr(watch, "_buses", buses)
    signals = SimpleNamespace(is_set=lambda: anew[0], clear=lambda: course.append("cleared"), wait=wait)
    monkeypatch.setattr(watch, "_anew", signals)
    for name in ("_look_for_all", "_report_strangers"):
        monkeypatch.setattr(watch, name, lambda name=name: course.append(name))
    monkeypatch.setattr(watch, "_publish_state", lambda state, problem=None: course.append((state, problem)))
    monkeypatch.setattr(watch, "on_sighting", lambda found: course.append(("here", found.uuid.hex())))
    monkeypatch.setattr(watch, "_gone", lambda uuid: course.append(("gone", uuid)))
    monkeypatch.setattr(watch, "_see_who_left", lambda seconds: course.append(("silent", seconds)))
    bus_port: Any = SimpleNamespace(
        poll_seconds=30.0,
        capabilities=SimpleNamespace(connectionless=connectionless),
        report_rivals=lambda _notice: course.append("rivals"),
    )
    watch._known[there.uuid.hex()] = there
    watch._node_locks.acquire(held, "it is measured")
    watch._watch_bus(bus_port)
    begin: list[Any] = [("poll", 30.0), *([("asks", True, True, False, True)] if connectionless else [])]
    silent: list[Any] = [("silent", 37.5)]
    looked: list[Any] = [("here", there.uuid.hex()), ("gone", away)] if connectionless else silent
    end: list[Any] = ["_report_strangers", ("wait", 0.5)]
    down = course[course.index(("wait", 0.5)) + 1]
    assert (down[0], down[1].message) == ("down", "gone")
    assert course == [
        *begin, "cleared", "_look_for_all", "discover", ("up", None), "rivals", *looked, *end,
        down, *silent, *end,
        ("up", None), "rivals", *looked, *end,
    ]  # fmt: skip


def test_a_node_that_left_before_its_turn_is_looked_at_when_it_is_back(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    served, taken = list[str](), list[Any]()
    watch._for_strangers = SimpleNamespace(submit=lambda work, contact: taken.append((work, contact)))  # type: ignore[assignment]
    monkeypatch.setattr(watch, "_serve", lambda contact: served.append(contact.identity.uuid.hex()))
    item = sighting(1)
    uuid = item.uuid.hex()
    watch.on_sighting(item)
    assert watch._pending == {uuid}
    watch._gone(uuid)
    (work, contact), *_ = taken
    work(contact)
    assert (served, watch._pending) == ([], set())
    watch.on_sighting(sighting(1))
    work(contact)
    assert (served, len(taken)) == ([uuid], 2)


def test_a_bug_on_a_link_is_shown_and_logged_and_the_link_is_opened_again(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A thread that had ended would watch the link no more, without a word."""
    shown, pauses, opened = list[tuple[str, str, str]](), list[float](), list[tuple[str, Any]]()

    def open_place(place: str, trace: Any) -> Any:
        if place != watch.place:  # the thread of another test that still ends
            raise LinkError("No reader.")
        opened.append((place, trace))
        raise ZeroDivisionError("bug") if len(opened) < 3 else LinkError("No bus.", hint="Plug it in.")

    def wait(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 7:
            watch._stop.set()

    monkeypatch.setattr(link_watch, "open_place", open_place)
    monkeypatch.setattr(watch, "_down", lambda error: shown.append((error.code, error.message, error.hint)))
    monkeypatch.setattr(watch, "_anew", SimpleNamespace(clear=lambda: None, wait=wait))
    watch._run()
    assert (
        shown
        == [("failed", "This link failed unexpectedly.", "See the log.")] * 2 + [("link", "No bus.", "Plug it in.")] * 5
    )
    logged = [line for line in caplog.messages if line.startswith("Watching")]  # of other tests a thread may still end
    assert logged == ["Watching can:x failed; starting again."] * 2
    assert opened == [("can:x", None)] * 7
    assert pauses == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0], "doubled up to half a minute"


def test_a_bus_that_was_opened_anew_is_heard_in_place_of_its_closed_port(monkeypatch: pytest.MonkeyPatch) -> None:
    """All threads of the process kept the closed one: no node of that bus was found until the service was restarted."""
    course = list[str]()

    class Bus:
        def __init__(self, port: Any, _presence: object, *, poll: float | None) -> None:
            self.port = port
            course.append(f"{port.name} {poll}")

        def close(self) -> None:
            course.append(f"{self.port.name} closed")

    monkeypatch.setattr(buses_module, "MeasuredBus", Bus)
    first, again, other = (
        SimpleNamespace(name=name, place=place) for name, place in (("a", "can:x"), ("b", "can:x"), ("c", "can:y"))
    )
    buses = Buses([cast(Any, first)])
    before = buses.add(cast(Any, first))
    assert buses.add(cast(Any, other)) is not before
    made = buses.add(cast(Any, again))
    assert course == ["a None", "c None", "a closed", "b None"]
    assert buses.bus_of(cast(Any, SimpleNamespace(port=first))) is made
    assert {cast(Any, bus.port).name for bus in buses.all()} == {"b", "c"}
    buses.close()
    assert course[-2:] == ["b closed", "c closed"]


@pytest.mark.parametrize(
    ("listed", "transparent", "tapped", "states", "taken"),
    [
        (True, False, False, ["came"], "workers"),
        (True, True, False, ["came"], "workers"),
        (False, True, False, ["came"], "for_strangers"),
        (False, False, False, [], None),
        (False, False, True, ["tapped"], "at once"),
        (True, False, True, ["tapped"], "at once"),
    ],
)
def test_who_comes_is_looked_at_by_detection_and_a_tap_at_once(
    listed: bool,
    transparent: bool,
    tapped: bool,
    states: list[str],
    taken: str | None,
    watch: LinkWatch,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A node of the whitelist never waits for strangers; in whitelist mode those are counted and no more."""
    events, course = list[str](), list[str]()
    monkeypatch.setattr(watch._live, "event", lambda _kind, **facts: events.append(facts["state"]), raising=False)
    monkeypatch.setattr(link_watch, "is_listed", lambda _station, _uuid: listed)
    monkeypatch.setattr(watch, "_transparent", lambda: transparent)
    monkeypatch.setattr(watch, "_serve", lambda _contact: course.append("at once"))
    for name in ("workers", "for_strangers"):
        submitted: Any = SimpleNamespace(submit=lambda work, _contact, name=name: course.append(name))
        monkeypatch.setattr(watch, f"_{name}", submitted)
    node = sighting(9)
    uuid, contact = node.uuid.hex(), node.contact()
    contact.link.capabilities.tapped = tapped
    watch._came(contact)
    assert (events, course) == (states, [taken] if taken else [])
    assert watch._directory.strangers(watch.place) == (0 if taken else 1)
    seen = watch._directory.seen(uuid)
    assert (seen.present, seen.place, seen.says) == ((True, "can:x", "factory") if taken else (False, "", None))
    assert bool(seen.tapped) is tapped
    if taken == "workers":
        watch._came(contact)
        assert course == ["workers"], "it is looked at already"


@pytest.mark.parametrize("listed", [True, False])
def test_a_node_that_comes_while_the_watch_ends_is_no_bug(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch, listed: bool
) -> None:
    """At the end of a service that had just met a node its log had a traceback: of workers that were shut down."""
    monkeypatch.setattr(link_watch, "is_listed", lambda _station, _uuid: listed)
    for workers in (watch._workers, watch._for_strangers, watch._for_rest):
        workers.shutdown()
    found: Any = SimpleNamespace(
        judged=SimpleNamespace(origin="kept", verified=SimpleNamespace(verdict="authentic")),
        sheet=None, power=None, firmware=None,
    )  # fmt: skip
    node: Any = SimpleNamespace(uuid=sighting(1).uuid, contact=sighting(1).contact())
    monkeypatch.setattr(link_watch, "look", lambda _station, _node: found)
    for work in (lambda: watch.on_sighting(sighting(2)), lambda: watch._look(node)):
        with pytest.raises(RuntimeError, match="after shutdown"):
            work()
    watch._stop.set()
    watch.on_sighting(sighting(3))
    watch._look(node)


@pytest.mark.parametrize(
    ("origin", "tapped", "heard", "rest"),
    [("session", False, None, False), ("kept", False, None, True), ("kept", True, None, False),
     ("plain", False, {"verdict": "plain"}, False)],
)  # fmt: skip
def test_what_an_inspection_found_is_shown_and_the_rest_of_a_kept_datasheet_is_read_behind_it(
    origin: str, tapped: bool, heard: Any, rest: bool, watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    noted, later = list[Any](), list[Any]()
    contact = SimpleNamespace(link=SimpleNamespace(capabilities=SimpleNamespace(tapped=tapped)))
    node: Any = SimpleNamespace(uuid=b"\xab" * 10, contact=contact)
    verified = SimpleNamespace(verdict="authentic")
    judged = SimpleNamespace(origin=origin, verified=verified, to_json=lambda: {"verdict": origin})
    found = SimpleNamespace(judged=judged, sheet="sheet", power={"battery": 3}, firmware={"version": "1"})
    directory: Any = SimpleNamespace(
        show_sheet=lambda uuid, sheet: noted.append((uuid, sheet)),
        refresh=noted.append,
        note=lambda uuid, state, **facts: noted.append((uuid, state, facts)),
    )
    watch._directory = directory
    watch._for_rest = cast(Any, SimpleNamespace(submit=lambda work, contact: later.append((work, contact))))
    monkeypatch.setattr(link_watch, "look", lambda _station, _node: found)
    monkeypatch.setattr(watch, "_wanted", lambda _contact: False)
    watch._look(node)
    assert noted == [], "the tap of a board that is not listed shows which one it is, and no more"
    monkeypatch.setattr(watch, "_wanted", lambda _contact: True)
    watch._look(node)
    uuid = "ab" * 10
    facts = noted[2][2]
    assert noted[:2] == [(uuid, "sheet"), [uuid]]
    assert noted[2][:2] == (uuid, "verified")
    assert facts.pop("looked") > 0
    assert facts == {
        "verdict": "authentic", "heard": heard, "power": {"battery": 3}, "firmware": {"version": "1"}, "problem": None,
    }  # fmt: skip
    assert later == ([(watch._read_rest, contact)] if rest else [])


class Met:
    """A conversation with a node, which ends well."""

    def __init__(self, *_words: Any, **_more: Any) -> None: ...

    def __enter__(self) -> Any:
        return self

    def __exit__(self, *_: object) -> None: ...


@pytest.mark.parametrize(
    ("error", "state", "noted", "again"),
    [
        (None, NodeState.FACTORY, [], False),
        (FrozenError("It is measured."), NodeState.FACTORY, [], True),
        (FrozenError("It is measured."), NodeState.PROVISIONED, [], False),
        (NodeBusyError("A command has it."), NodeState.FACTORY, [(None, "A command has it.")], False),
        (SessionLostError(LinkError("Silent.")), NodeState.FACTORY, [("problem", "Silent.")], False),
        (BadDataError("No TEDS."), NodeState.FACTORY, [("problem", "No TEDS.")], False),
        (ZeroDivisionError(), NodeState.FACTORY, [("problem", "Unexpected failure: see the log.")], False),
    ],
)
def test_an_inspection_that_fails_is_the_nodes_problem_and_ends_no_worker(
    error: Exception | None,
    state: NodeState,
    noted: list[Any],
    again: bool,
    watch: LinkWatch,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that is measured is looked at again if it was reset: its measurement lets it go then."""
    shown, refreshed, uuid = list[Any](), list[Any](), "ab" * 10

    def serve_node(_node: Any) -> bool:
        if error is not None:
            raise error
        return True

    def note(_uuid: str, state: str | None = None, *, problem: Any) -> None:
        shown.append((state, problem["message"]))

    directory: Any = SimpleNamespace(note=note, refresh=refreshed.append)
    watch._directory, watch._taps = directory, cast(Any, SimpleNamespace(serve_node=serve_node))
    watch._pending.add(uuid)
    monkeypatch.setattr(link_watch, "Conversation", Met)
    contact: Any = SimpleNamespace(identity=SimpleNamespace(uuid=bytes.fromhex(uuid), state=state))
    watch._serve(contact)
    assert (shown, refreshed, watch._pending) == (noted, [[uuid]], set())
    assert watch._looked_for == ({uuid} if again else set())
    assert watch._node_locks.holder(uuid) is None


@pytest.mark.parametrize(
    ("error", "found", "noted"),
    [
        (None, True, [("refreshed", ["ab" * 10]), ("verified", "authentic")]),
        (None, False, [("refreshed", ["ab" * 10])]),
        (LinkError("Silent."), False, []),
        (SessionLostError(LinkError("Silent.")), False, []),
        (ZeroDivisionError(), False, []),
    ],
)
def test_the_rest_of_a_datasheet_that_cannot_be_read_now_is_no_problem(
    error: Exception | None,
    found: bool,
    noted: list[Any],
    watch: LinkWatch,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    shown: list[Any] = []

    def read_anew(_station: Any, _node: Any) -> Any:
        assert watch._node_locks.holder("ab" * 10) == "the rest of its datasheet is read"
        if error is not None:
            raise error
        return ("image", SimpleNamespace(verified=SimpleNamespace(verdict="authentic"))) if found else None

    def note(_uuid: str, state: str, *, verdict: str, looked: float) -> None:
        shown.append((state, verdict))

    watch._directory = cast(Any, SimpleNamespace(note=note, refresh=lambda uuids: shown.append(("refreshed", uuids))))
    monkeypatch.setattr(link_watch, "Conversation", Met)
    monkeypatch.setattr(link_watch, "read_anew", read_anew)
    contact: Any = SimpleNamespace(identity=SimpleNamespace(uuid=b"\xab" * 10))
    watch._read_rest(contact)
    assert shown == noted
    bug = f"Reading the rest of node {'ab' * 10} failed."
    logged = [line for line in caplog.messages if line.startswith("Reading")]
    assert logged == ([bug] if isinstance(error, ZeroDivisionError) else [])


def test_the_number_of_strangers_is_an_event_when_it_changed_and_at_most_every_ten_seconds(
    watch: LinkWatch, monkeypatch: pytest.MonkeyPatch
) -> None:
    now, counts = [1000.0], list[int]()
    monkeypatch.setattr(link_watch, "time", SimpleNamespace(monotonic=lambda: now[0]))
    monkeypatch.setattr(watch._live, "event", lambda _kind, **facts: counts.append(facts["count"]), raising=False)
    for at, uuid, there in (
        (0.0, "aa", False), (0.0, "aa", True), (5.0, "bb", True), (9.9, "cc", True), (10.0, "cc", True),
        (20.0, "cc", True), (25.0, "cc", False), (26.0, "cc", True), (35.0, "cc", True),
    ):  # fmt: skip
        now[0] = 1000.0 + at
        watch._directory.stranger(watch.place, uuid, there=there)
        watch._report_strangers()
    assert counts == [1, 3, 2, 3]
