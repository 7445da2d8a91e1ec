"""Virtual transducers and their simulations, without processes: who feeds one, how fast, and when one starts again."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import NodeBusyError, NotFoundError, UsageError
from teds_provision.ncap.nodes import simulation, virtual
from teds_provision.ncap.nodes.simulation import MOST_OCTETS, SIMULATION, CheckedLines, FedChannel, Feed, Pace
from teds_provision.ncap.nodes.virtual import Virtual, Virtuals
from teds_provision.ncap.web import simulation as web_simulation
from teds_provision.ncap.web.simulation import _Session
from teds_provision.node.sources.base import SourceChannel

ONE, OTHER = "ab" * 10, "cd" * 10


class Bench:
    """The virtual transducers of a station without a store; ``events`` are what clients are sent."""

    def __init__(self, folder: Path) -> None:
        self.events: list[str] = []
        self.log: list[tuple[Any, ...]] = []
        station: Any = SimpleNamespace(home=folder, audit=lambda *words, **facts: self.log.append((*words, facts)))
        live: Any = SimpleNamespace(event=lambda _kind, **facts: self.events.append(facts["state"]))
        self.virtuals = Virtuals(station, live)

    def made(self, uuid: str, name: str, folder: Path, source: str = SIMULATION) -> Virtual:
        one = self.virtuals._all[uuid] = Virtual(uuid, name, source, folder)
        return one


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def test_a_transducer_has_one_simulation_and_the_end_of_an_earlier_one_is_not_the_end_of_the_next(
    bench: Bench, tmp_path: Path
) -> None:
    one, first, second = bench.made(ONE, "hand", tmp_path), Feed("page", lambda: None), Feed("api:sim", lambda: None)
    bench.virtuals.begin_feed(one, first)
    first.lines, first.skipped, first.since = 7, 2, 1000.5
    assert one.as_json()["simulation"] == {"by": "page", "since": 1000.5, "lines": 7, "skipped": 2}
    with pytest.raises(NodeBusyError, match="already fed by page"):
        bench.virtuals.begin_feed(one, second)
    bench.virtuals.end_feed(one, first)
    bench.virtuals.begin_feed(one, second)
    bench.virtuals.end_feed(one, first)
    assert one.feed is second
    bench.virtuals.end_feed(one, second)
    assert one.feed is None
    assert one.as_json()["simulation"] is None
    assert bench.events == ["fed", "not fed", "fed", "not fed", "not fed"]
    begun, ended = ("virtual", bytes.fromhex(ONE), "simulation connected"), ("virtual", bytes.fromhex(ONE))
    assert bench.log[0] == (*begun, {"by": "page"})
    assert bench.log[1] == (*ended, "simulation disconnected", {"by": "page", "lines": 7, "skipped": 2})
    assert [entry[2] for entry in bench.log].count("simulation connected") == 2
    with pytest.raises(UsageError, match="has the source noise"):
        bench.virtuals.begin_feed(bench.made(OTHER, "foot", tmp_path, "noise"), first)


def test_a_transducer_is_named_by_its_uuid_or_by_a_name_that_only_it_has(bench: Bench, tmp_path: Path) -> None:
    one, other = bench.made(ONE, "hand", tmp_path), bench.made(OTHER, "foot", tmp_path)
    assert [bench.virtuals.find(text) for text in (ONE.upper(), "hand", OTHER, "foot")] == [one, one, other, other]
    other.name = "hand"
    assert bench.virtuals.find(OTHER) is other
    for text in ("hand", "foot", "ef" * 10):
        with pytest.raises(NotFoundError):
            bench.virtuals.find(text)


def test_a_transducer_that_was_ready_is_started_a_second_after_its_end_and_others_ever_later(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, ready = bench.made(ONE, "hand", tmp_path, "noise"), [False] * 7 + [True, False, False]
    pauses: list[float] = []
    monkeypatch.setattr(virtual.subprocess, "Popen", lambda *_words, **_more: SimpleNamespace(poll=lambda: 0))
    monkeypatch.setattr(bench.virtuals, "_until_its_end", lambda _one, _process: ready.pop(0))
    stop = SimpleNamespace(is_set=lambda: not ready, wait=pauses.append)
    monkeypatch.setattr(bench.virtuals, "_stop", stop)
    bench.virtuals._run(one)
    assert pauses == [1, 2, 4, 8, 16, 30, 30, 1, 2], "at most half a minute"


def test_a_simulation_may_save_up_a_quarter_of_a_second_and_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(simulation, "time", SimpleNamespace(monotonic=lambda: now[0]))
    pace = Pace()
    assert pace.delay(MOST_OCTETS // 4) == pytest.approx(0.25)
    now[0] += 0.25
    assert pace.delay(MOST_OCTETS // 8) == pytest.approx(0.125)
    now[0] += 3600.0
    assert pace.delay(MOST_OCTETS // 4) == 0.0
    assert pace.delay(MOST_OCTETS // 2) == pytest.approx(0.5)


FED = [FedChannel(SourceChannel(2, "opening", 0.0, 110.0), "mm"), FedChannel(SourceChannel(3, "count"), "")]


@pytest.mark.parametrize(
    ("line", "skipped", "limited"),
    [
        ('{"value": {"opening": 0, "count": 1e9}}', "", ""),
        ('{"value": {"opening": 110}}', "", ""),
        ('{"value": {"opening": null}}', "", ""),
        ('{"raw": {"opening": 9999}}', "", ""),
        ('{"value": {"count": 5, "opening": -0.5}}', "", "opening: -0.5 mm is outside 0 to 110 mm"),
        ('{"value": {"opening": 110.5}}', "", "opening: 110.5 mm is outside 0 to 110 mm"),
        ('{"value": {"hand": 1}}', "the node has no sensor named 'hand'", ""),
        ('{"t": -1}', '"t" is not a number of seconds of 0 or more', ""),
    ],
)
def test_of_a_line_the_simulation_learns_why_it_is_skipped_or_which_value_is_limited(
    line: str, skipped: str, limited: str
) -> None:
    checked = CheckedLines(FED)
    assert checked.check(b'{"value": {"opening": 200}}')[1].startswith("opening: 200 mm")
    limit = f"{limited}; the sensor gives the nearer limit" if limited else ""
    assert checked.check(line.encode()) == (skipped, limit)
    assert checked.limited == (2 if limited else 1)


def test_the_first_line_of_either_kind_is_reported_at_once_and_the_others_of_that_kind_once_a_second(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Lines that were skipped all the time held up what there was to say about limited values."""
    now, sent = [100.0], list[dict[str, Any]]()

    async def send(found: dict[str, Any]) -> None:
        sent.append(found)

    monkeypatch.setattr(web_simulation, "time", SimpleNamespace(monotonic=lambda: now[0]))
    nothing: Any = None
    session = _Session(cast("Any", SimpleNamespace(send_json=send)), nothing, [], nothing)

    def at(moment: float, skipped: str, limited: str) -> list[dict[str, Any]]:
        sent.clear()
        now[0] = moment
        session.skipped.note(skipped)
        session.limited.note(limited)
        asyncio.run(session._send_news())
        return sent.copy()

    assert at(100.0, "", "") == []
    assert at(100.1, "no JSON", "") == [{"skipped": 1, "why": "no JSON"}]
    assert at(100.2, "no JSON", "too far") == [{"limited": 1, "why": "too far"}]
    assert at(101.0, "NaN", "too far") == []
    assert at(101.15, "", "") == [{"skipped": 3, "why": "NaN"}]
    assert at(101.25, "NaN", "farther") == [{"limited": 3, "why": "farther"}]
    assert at(102.15, "NaN", "farther") == [{"skipped": 5, "why": "NaN"}]
    assert at(102.25, "NaN", "") == [{"limited": 4, "why": "farther"}]
    assert at(110.0, "", "") == [{"skipped": 6, "why": "NaN"}]
    assert at(120.0, "", "") == []


def test_a_simulation_is_sent_the_range_of_a_channel_that_has_one() -> None:
    assert [channel.as_json() for channel in FED] == [
        {"number": 2, "name": "opening", "unit": "mm", "low": 0.0, "high": 110.0},
        {"number": 3, "name": "count", "unit": "", "low": None, "high": None},
    ]


@pytest.mark.parametrize(
    ("source", "good"),
    [
        ("noise", True),
        ("simulation", True),
        ("sine:0.5", True),
        ("sine:86400", True),
        ("ramp:86400", True),
        ("ramp:86401", False),
        ("sine:86401", False),
        ("sine:0", False),
        ("sine", False),
        ("noise:1", False),
        ("simulation:/tmp/x", False),
        ("exec:true", False),
        ("-", False),
        ("unix:x", False),
        ("file:x.csv", False),
    ],
)
def test_the_sources_of_a_virtual_transducer(source: str, good: bool) -> None:
    if good:
        virtual._check_source(source)
        return
    with pytest.raises(UsageError):
        virtual._check_source(source)


def test_sensors_that_are_known_are_fed_and_actuators_are_not(monkeypatch: pytest.MonkeyPatch) -> None:
    def channel(number: int, kind: str | None, *, actuator: bool = False) -> Any:
        return SimpleNamespace(number=number, kind=kind, actuator=actuator, unit=SimpleNamespace(text=f"unit {number}"))

    channels = [channel(1, "actuator", actuator=True), channel(2, "sensor"), channel(3, None), channel(4, "event")]
    monkeypatch.setattr(simulation, "FlashFile", lambda folder: SimpleNamespace(hardware=folder))
    monkeypatch.setattr(simulation.Sheet, "from_blocks", lambda _blocks: SimpleNamespace(channels=channels))
    monkeypatch.setattr(simulation, "Converter", lambda _sheet, channel: SimpleNamespace(place=channel.number))
    found: list[Any] = [(each.place, each.unit) for each in simulation.fed_channels(Path("x"))]
    assert found == [(2, "unit 2"), (4, "unit 4")]


def test_a_folder_is_open_for_the_block_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed, close = list[int](), os.close

    def noted(descriptor: int) -> None:
        closed.append(descriptor)
        close(descriptor)

    monkeypatch.setattr(os, "close", noted)
    given: list[int] = []

    def fails() -> None:
        with virtual.opened_folder(tmp_path) as folder:
            given.append(folder)
            assert os.listdir(folder) == []
            assert folder not in closed
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert given[0] in closed
    (tmp_path / "file").write_text("")
    with pytest.raises(NotADirectoryError), virtual.opened_folder(tmp_path / "file"):
        pass
