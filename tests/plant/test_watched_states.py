"""The service's part for the plant without a database: what it shows, which state it reports, when it syncs."""

from __future__ import annotations

import asyncio
import os
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import plant
from teds_provision.errors import (
    NoNodeError,
    NotFoundError,
    NotMemberError,
    PolicyError,
    RegistryError,
    StoreLockedError,
    UsageError,
)
from teds_provision.ncap.live import Live
from teds_provision.plant import connecting
from teds_provision.plant.jobs import take_job
from teds_provision.plant.service import PlantWatch
from teds_provision.plant.sync import SyncResult
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.line import UnitRow
from teds_provision.station.station import Station
from tests.plant.handing import board_of
from tests.plant.owner import ANGLE, alone, job_of
from tests.plant.stations import Plant

EARLY, LATE = "2026-01-01T00:00:00Z", "2026-01-02T00:00:00Z"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path)
    yield made
    made.close()


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    yield made
    made.close()


def watching(station: Station) -> tuple[PlantWatch, list[tuple[str, str]], list[str]]:
    """Return the part, each state that it published with its reason, and the times that something changed."""
    live, published, changed = Live(), list[tuple[str, str]](), list[str]()
    live.on_event = lambda event: published.append((event["state"], event["why"]))
    return PlantWatch(station, live, lambda: changed.append("changed")), published, changed


# -- what is shown -----------------------------------------------------------------------------------------------------


def test_the_whole_answer_about_the_plant(home: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    home.member("south", "line", "base")
    home.member("west", "line")
    north, south, west = home.stations
    board = board_of(south, b"\x8d" + bytes(9))
    for each in home.stations:
        board_of(each, os.urandom(10))
    home.round()
    home.change(plant.owner.draft_removal(home.north, "west", "retired", None))
    home.sync(north)
    north.plant.claims.put_conflicts({board.uuid: {"two keys": "north and south differ"}})
    north.plant.alarms.put(Alarm("junk", south.fingerprint, 3, "a row", EARLY))
    north.plant.alarms.put(Alarm("fork", "", 1, "a copy", LATE))
    north.plant.alarms.see()
    north.plant.alarms.put(Alarm("junk", south.fingerprint, 4, "one more row", LATE))
    north.plant.record_event("forgot", board.uuid, epoch=1)
    record, roster = north.plant.joined, north.plant.roster
    assert record is not None
    assert roster is not None
    north.plant.put_record(replace(record, synced="2026-03-01T00:00:00Z"))
    monkeypatch.setattr(time, "time", lambda: 1772323210.5)
    watch, _, _ = watching(north)
    found = watch.status()
    assert found is not None
    ages = {each.pop("name"): each.pop("age") for each in found["stations"]}
    assert list(ages) == ["north", "south", "west"]
    assert all(age is not None and 0 <= age < 60 for age in ages.values())
    pages = {
        name: each.plant.pages.chain(each.fingerprint).counted[0]
        for name, each in zip(ages, home.stations, strict=True)
    }
    assert found == {
        "registry": roster.registry,
        "name": "plant Augsburg",
        "roster": 4,
        "expires": roster.expires.timestamp(),
        "state": "waiting",
        "why": "",
        "synced": 1772323200.0,
        "age": 10.5,
        "unsent": 1,
        "to_rotate": 0,
        "stations": [
            {"fingerprint": north.fingerprint, "roles": ["keeper", "line", "sign", "base"],
             "page": pages["north"], "state": "here"},
            {"fingerprint": south.fingerprint, "roles": ["line", "base"], "page": pages["south"], "state": "heard"},
            {"fingerprint": west.fingerprint, "roles": ["line"], "page": pages["west"], "state": "retired"},
        ],
        "conflicts": [{"uuid": board.uuid.hex(), "conflict": "two keys", "detail": "north and south differ"}],
        "alarms": [
            {"code": "junk", "about": "south", "why": "a row", "at": EARLY, "seen": True},
            {"code": "fork", "about": "", "why": "a copy", "at": LATE, "seen": True},
            {"code": "junk", "about": "south", "why": "one more row", "at": LATE, "seen": False},
        ],
    }  # fmt: skip
    assert list(watch.metrics()) == [
        ("teds_registry_age_seconds", {}, 10.5), ("teds_registry_unsent", {}, 1), ("teds_registry_alarms", {}, 1)
    ]  # fmt: skip
    assert watch.metric_help == {
        "teds_registry_age_seconds": ("gauge", "Since the last sync with the registry."),
        "teds_registry_unsent": ("gauge", "Events that wait for a sync."),
        "teds_registry_alarms": ("gauge", "Alarms that are not acknowledged yet."),
    }


def test_a_sync_that_a_wrong_clock_dated_ahead_has_no_negative_age(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = station.plant.joined
    assert record is not None
    station.plant.put_record(replace(record, synced=EARLY))
    watch, _, _ = watching(station)
    synced = datetime.fromisoformat(EARLY).timestamp()
    for now, age in ((synced + 2.5, 2.5), (synced, 0.0), (synced - 9, 0.0)):
        monkeypatch.setattr("teds_provision.plant.service.time", SimpleNamespace(time=lambda now=now: now))
        shown = watch.status()
        assert shown is not None
        assert (shown["synced"], shown["age"]) == (synced, age)
        assert next(iter(watch.metrics())) == ("teds_registry_age_seconds", {}, age)


def test_before_the_first_sync_there_is_no_age(station: Station) -> None:
    watch, _, _ = watching(station)
    found = watch.status()
    assert found is not None
    assert (found["synced"], found["age"]) == (None, None)
    assert [name for name, _, _ in watch.metrics()] == ["teds_registry_unsent", "teds_registry_alarms"]


def test_a_station_of_no_registry_shows_nothing(home: Plant, tmp_path: Path) -> None:
    from tests.bench import make_station

    single = make_station(tmp_path / "single")
    watch, _, _ = watching(single)
    assert (watch.is_shown(), watch.status(), list(watch.metrics())) == (False, None, [])
    with pytest.raises(PolicyError):
        watch.start()
    assert watching(home.north)[0].is_shown()
    single.close()


def test_an_answer_about_nodes_has_twenty_and_says_that_there_are_more(station: Station) -> None:
    watch, _, _ = watching(station)
    for count, shown in ((20, 20), (21, 20)):
        found = [{"uuid": f"{number:020x}"} for number in range(count)]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(plant.status, "nodes", lambda *_, found=found: iter(found))
            assert watch.nodes("") == {"nodes": found[:shown], "more": count > shown}


def test_a_job_is_found_by_four_digits_and_shown_whole(station: Station) -> None:
    ids = [f"{digits}-8a55-4d9c-8e56-09c29c295609" for digits in ("abcd0000", "abcd1111")]
    ends = datetime(2026, 3, 1, tzinfo=UTC)
    for each in ids:
        take_job(
            station, job_of(station, id=each, title="three angles", ends=ends, not_before=ends - timedelta(days=1))
        )
    for number, passed in ((1, 1), (2, 0), (3, 2)):
        station.plant.line.put_unit(UnitRow(ids[1], bytes([number] * 10), number, EARLY, 1, passed))
    watch, _, _ = watching(station)

    def shown(id: str, units: int, passed: int) -> dict[str, Any]:
        return {"id": id, "title": "three angles", "profile": ANGLE, "total": 3, "ends": 1772323200.0,
                "state": "open", "units": units, "passed": passed}  # fmt: skip

    assert watch.jobs() == [shown(ids[0], 0, 0), shown(ids[1], 3, 2)]
    found = watch.job("ABCD1")
    assert [each["name"] for each in found.pop("stations")] == ["owner"]
    assert found == shown(ids[1], 3, 2)
    for text, why in (("abcd", "2 jobs begin"), ("abc", "No jobs begin"), (str(uuid.uuid4()), "No jobs begin")):
        with pytest.raises(NotFoundError, match=why):
            watch.job(text)


# -- what is reported --------------------------------------------------------------------------------------------------

SEEN, UNSEEN = Alarm("junk", "", 1, "old", EARLY, True), Alarm("fork", "", 1, "a copy", EARLY)
NEWER = Alarm("two-rosters", "", 2, "version 3", LATE)


@pytest.mark.parametrize(
    ("alarms", "days", "state"),
    [
        ([], 30, ("synced", "")),
        ([SEEN], 30, ("synced", "")),
        ([UNSEEN, NEWER, SEEN], -1, ("alarm", "two-rosters: version 3")),
        ([SEEN], 0, ("expired", "the roster's time was over on {end}")),
        ([], -1, ("expired", "the roster's time was over on {end}")),
        ([], 13, ("expires", "the roster's time is over on {end}")),
    ],
)
def test_the_state_after_a_sync(
    station: Station, monkeypatch: pytest.MonkeyPatch, alarms: list[Alarm], days: int, state: tuple[str, str]
) -> None:
    """An alarm that nobody saw, then an end of the roster, then the end of it that comes."""
    roster = station.plant.roster
    assert roster is not None
    looked = plant.status.status

    def status(*given: Any) -> Any:
        return replace(looked(*given), alarms=tuple(alarms), at=roster.expires - timedelta(days=days))

    monkeypatch.setattr(plant.status, "status", status)
    watch, published, changed = watching(station)
    watch._after(0)
    assert changed == []
    watch._after(1)
    assert published == [(state[0], state[1].format(end=f"{roster.expires:%Y-%m-%d}"))], "once for a state"
    assert changed == ["changed"]


@pytest.mark.parametrize("part", ["pushed", "fetched", "parcels_in", "parcels_out", "rosters"])
def test_what_a_sync_moved_is_a_change(home: Plant, monkeypatch: pytest.MonkeyPatch, part: str) -> None:
    done = SyncResult(**{part: [2] if part == "rosters" else 1})  # type: ignore[arg-type]
    monkeypatch.setattr(connecting, "open_transport", lambda station: SimpleNamespace())
    monkeypatch.setattr(connecting, "check_database", lambda *_: None)
    monkeypatch.setattr(plant.sync, "sync", lambda *_: done)
    watch, published, changed = watching(home.north)
    assert not watch._sync()
    assert (published, changed) == ([("synced", "")], ["changed"])


def test_a_sync_that_fails_is_reported_by_its_kind_and_opens_its_way_once(
    home: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    removed = NotMemberError("removed on Monday")
    errors: list[Exception] = [
        StoreLockedError("registry sync runs"), removed, removed,
        NoNodeError("no host"), RegistryError("no database"), PolicyError("full"), PolicyError("more than full"),
    ]  # fmt: skip
    opened: list[Station] = []

    def failing(*_: Any) -> SyncResult:
        raise errors.pop(0)

    ways: list[object] = [SimpleNamespace(), None]

    def open_transport(station: Station) -> object:
        opened.append(station)
        return ways.pop()

    monkeypatch.setattr(connecting, "open_transport", open_transport)
    monkeypatch.setattr(plant.sync, "sync", failing)
    watch, published, changed = watching(home.north)
    assert [watch._sync() for _ in range(8)] == [False, True, *[False] * 6], "busy: another command syncs"
    assert published == [
        ("unreachable", "nothing is known that carries: registry connect"),
        ("removed", "removed on Monday"),
        ("unreachable", "no host"),
        ("unreachable", "no database"),
        ("alarm", "full"),
        ("alarm", "more than full"),
    ]
    assert (len(opened), changed) == (2, [])
    assert (watch.status() or {})["state"] == "alarm"


def test_the_database_is_checked_at_the_first_sync_and_each_hour(home: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    transport, checks, clock = SimpleNamespace(), list[tuple[Any, ...]](), [0.0]
    monkeypatch.setattr(connecting, "open_transport", lambda station: transport)
    monkeypatch.setattr(connecting, "check_database", lambda *given: checks.append((clock[0], *given)))
    monkeypatch.setattr(plant.sync, "sync", lambda *_: SyncResult())
    monkeypatch.setattr(
        "teds_provision.plant.service.time", SimpleNamespace(monotonic=lambda: clock[0], time=time.time)
    )
    watch, _, _ = watching(home.north)
    for now in (0.0, 60.0, 3599.0, 3600.0, 7199.0, 7200.0):
        clock[0] = now
        watch._sync()
    assert checks == [(now, home.north, transport) for now in (0.0, 3600.0, 7200.0)]


def test_the_page_of_the_day_is_written_before_the_sync_that_sends_it(
    home: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    course, watch = list[str](), watching(home.north)[0]
    monkeypatch.setattr(connecting, "open_transport", lambda station: SimpleNamespace())
    monkeypatch.setattr(connecting, "check_database", lambda *_: course.append("check"))
    monkeypatch.setattr(plant.sync, "sync", lambda *_: course.append("sync") or SyncResult())
    monkeypatch.setattr(watch, "_say_daily", lambda: course.append("page"))
    watch._sync()
    assert course == ["page", "sync", "check"]


@pytest.mark.parametrize(("busy", "seconds"), [(True, 2.0), (False, 60.0)])
def test_the_next_sync_comes_after_a_minute_or_soon_if_another_one_ran(
    home: Plant, monkeypatch: pytest.MonkeyPatch, busy: bool, seconds: float
) -> None:
    watch, _, _ = watching(home.north)
    waits: list[float] = []

    def wait(timeout: float) -> bool:
        waits.append(timeout)
        watch._stop.set()
        return False

    def sync() -> bool:
        assert not watch._wake.is_set(), "what comes during a sync wakes the next one"
        return busy

    watch._wake.set()
    monkeypatch.setattr(watch._wake, "wait", wait)
    monkeypatch.setattr(watch, "_sync", sync)
    watch._run()
    assert waits == [seconds]


@pytest.mark.parametrize(("hours", "written"), [(23.9, 0), (24.1, 1), (-23.9, 0), (-24.1, 1)])
def test_a_station_without_news_writes_an_empty_page_each_day(
    home: Plant, monkeypatch: pytest.MonkeyPatch, hours: float, written: int
) -> None:
    """A station without a page for seven days counts as silent; the clock may have been ahead at the last one."""
    board_of(home.north, os.urandom(10))
    home.sync(home.north)
    watch, _, _ = watching(home.north)
    before = home.north.plant.pages.chains()[home.north.fingerprint].counted[0]
    later = datetime.now(UTC) + timedelta(hours=hours)
    monkeypatch.setattr(
        "teds_provision.plant.service.datetime",
        SimpleNamespace(now=lambda _: later, fromisoformat=datetime.fromisoformat),
    )
    watch._say_daily()
    watch._say_daily()
    after = home.north.plant.pages.chains()[home.north.fingerprint].counted[0]
    assert after - before == (2 if written else 0), "its page is of today's clock, which is not the one of this test"


class Listener:
    """A connection that listens: what ``wait`` brings, one after another; an error ends it."""

    def __init__(self, watch: PlantWatch, *said: bool | Exception) -> None:
        self.watch, self.said, self.log = watch, list(said), list[str]()

    def listen(self) -> None:
        self.log.append("listen")

    def sweep(self) -> None:
        self.log.append("sweep")

    def close(self) -> None:
        self.log.append("close")

    def wait(self, seconds: float) -> bool:
        self.log.append(f"wait {seconds:g}, {'woken' if self.watch._wake.is_set() else 'quiet'}")
        self.watch._wake.clear()
        if not self.said:
            self.watch._stop.set()
            return False
        said = self.said.pop(0)
        if isinstance(said, Exception):
            raise said
        return said


def test_a_registry_that_moved_is_followed_and_its_former_place_let_go(station: Station) -> None:
    watch, _, _ = watching(station)
    done = list[str]()
    transport: Any = SimpleNamespace(close=lambda: done.append("closed"))
    listener: Any = SimpleNamespace(interrupt=lambda: done.append("interrupted"))
    watch._transport, watch._listener, watch._place, watch._look_again = transport, listener, "one", 60.0
    watch._follow("one")
    assert (watch._transport, watch._look_again, done) == (transport, 60.0, [])
    watch._follow("two")
    assert (watch._transport, watch._place, watch._look_again) == (None, "two", 0.0)
    assert done == ["closed", "interrupted"]
    watch._listener = None
    watch._follow(None)
    assert (watch._place, done) == (None, ["closed", "interrupted"])


def test_who_listens_wakes_the_sync_and_sweeps_each_minute(home: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    watch, _, _ = watching(home.north)
    listener, clock = (
        Listener(watch, False, True, RegistryError("cut"), False),
        iter((100.0, 100.0, 159.0, 160.0, 160.0)),
    )
    opened: list[Station] = []
    monkeypatch.setattr(connecting, "listener", lambda station: opened.append(station) or listener)
    monkeypatch.setattr(
        "teds_provision.plant.service.time", SimpleNamespace(monotonic=lambda: next(clock, 160.0), time=time.time)
    )
    pauses: list[float] = []
    stop = watch._stop
    monkeypatch.setattr(stop, "wait", pauses.append)
    watch._listen()
    assert listener.log == [
        "listen", "sweep", "wait 60, woken", "wait 60, quiet", "sweep", "wait 60, woken",
        "listen", "sweep", "wait 60, woken", "wait 60, quiet",
    ]  # fmt: skip
    assert len(opened) == 1
    assert pauses == [1.0]


def test_who_listens_goes_where_the_registry_is_now_and_lets_the_former_place_go(
    home: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch, _, _ = watching(home.north)
    log, pauses = list[str](), list[float]()
    # at the outer look, then after each notification
    places = iter(["one", "one", "two", "two", "two", "stick", "stick", "stick"])

    def listener(_: Station) -> Any:
        name = ("one", "two", "", "")[sum(entry.startswith("open") for entry in log)]
        log.append(f"open {name}")

        def wait(seconds: float) -> bool:
            log.append(f"wait {name}")
            return False

        return SimpleNamespace(
            listen=lambda: log.append(f"listen {name}"), sweep=lambda: None, wait=wait,
            close=lambda: log.append(f"close {name}"),
        ) if name else None  # fmt: skip

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        if len(pauses) == 2:
            watch._stop.set()

    monkeypatch.setattr(connecting, "listener", listener)
    monkeypatch.setattr(connecting, "place_of", lambda _: next(places))
    monkeypatch.setattr(watch._stop, "wait", pause)
    watch._listen()
    assert log == [
        "open one", "listen one", "wait one", "close one", "open two", "listen two", "wait two", "close two",
        "open ", "open ",
    ]  # fmt: skip
    assert pauses == [60.0, 60.0], "a folder may become a database"


def test_a_registry_that_is_out_of_reach_is_listened_to_again_after_a_minute(
    home: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    watch, _, _ = watching(home.north)
    watch._publish_state("unreachable", "no host")
    pauses: list[float] = []

    def pause(seconds: float) -> None:
        pauses.append(seconds)
        watch._stop.set()

    def listener(_: Station) -> Listener:
        raise RegistryError("no host")

    monkeypatch.setattr(connecting, "listener", listener)
    monkeypatch.setattr(threading.Event, "wait", lambda self, seconds=None: pause(seconds or 0))
    watch._listen()
    assert pauses == [60.0]


def test_the_resources_ask_the_store_and_refuse_what_is_too_long(home: Plant, tmp_path: Path) -> None:
    from tests.bench import make_station

    watch, _, _ = watching(home.north)
    assert list(watch.resources()) == ["/plant", "/plant/nodes", "/jobs", "/jobs/{id}"]
    ask = watch.resources()

    def answer(path: str, text: str = "", **parts: str) -> dict[str, Any]:
        request = SimpleNamespace(query_params={"text": text}, path_params=parts)
        return asyncio.run(ask[path](request))  # type: ignore[arg-type]

    assert answer("/plant") == watch.status()
    assert answer("/jobs") == {"jobs": []}
    assert answer("/plant/nodes", "x" * 200) == {"nodes": [], "more": False}
    with pytest.raises(UsageError):
        answer("/plant/nodes", "x" * 201)
    with pytest.raises(NotFoundError, match="No jobs begin with abcd"):
        answer("/jobs/{id}", id="abcd")
    single = make_station(tmp_path / "single")
    ask = watching(single)[0].resources()
    with pytest.raises(NotFoundError, match="joined no registry"):
        answer("/plant")
    single.close()


def test_each_sync_begins_with_the_page_of_the_day_and_leaves_the_database_alone_for_an_hour(
    home: Plant, monkeypatch: pytest.MonkeyPatch
) -> None:
    log: list[str] = []
    monkeypatch.setattr(connecting, "open_transport", lambda station: SimpleNamespace())
    monkeypatch.setattr(connecting, "check_database", lambda *_: log.append("database"))
    monkeypatch.setattr(plant.sync, "sync", lambda *_: log.append("sync") or SyncResult())
    watch, _, _ = watching(home.north)
    monkeypatch.setattr(watch, "_say_daily", lambda: log.append("page"))
    clock = iter((0.0, 0.0, 3599.0, 3600.0, 3600.0))
    monkeypatch.setattr(
        "teds_provision.plant.service.time", SimpleNamespace(monotonic=lambda: next(clock), time=time.time)
    )
    for _ in range(3):
        watch._sync()
    assert log == ["page", "sync", "database", "page", "sync", "page", "sync", "database"]
