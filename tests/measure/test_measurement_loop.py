"""The loop of a measurement, without nodes: which states of its sinks are news, and who gets room again."""

from __future__ import annotations

import math
import threading
from collections import deque
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NoNodeError,
    NotAuthenticError,
    PolicyError,
    StoreError,
    TedsProvisionError,
)
from teds_provision.measure.blocks import Block, ChannelFacts, SinkStats, StationFacts
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.running import measurement
from teds_provision.measure.running.measurement import WAITING, Measurement
from teds_provision.measure.running.streams import StreamTotals
from tests.measure.sinks.parts import ARM, HAND, block


def test_a_sink_that_waits_for_its_consumers_is_news_after_three_seconds_each_time_anew(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A broker that is away for a second now and then is none, however often that is."""
    now = [0.0]
    monkeypatch.setattr(measurement, "time", SimpleNamespace(monotonic=lambda: now[0]))
    loop: Any = SimpleNamespace(_waits={}, _shown={})
    sink: Any = SimpleNamespace(recorder=False, stats=SinkStats(state="running"))
    news: list[tuple[float, str]] = []
    course = {0.0: "waiting", 2.0: "running", 10.0: "waiting", 12.0: "running", 20.0: "waiting", 30.0: "running"}
    while now[0] < 40.0:
        sink.stats.state = course.get(now[0], sink.stats.state)
        if Measurement._is_news(loop, sink):
            news.append((now[0], sink.stats.state))
        now[0] += 1.0
    assert news == [(20.0 + WAITING, "waiting"), (30.0, "running")]
    sink.stats.fail("It is gone.", "")
    assert [Measurement._is_news(loop, sink) for _ in range(2)] == [True, False]


def test_each_sink_with_news_is_shown_and_each_node_is_reported_at_a_look() -> None:
    shown: list[str] = []
    news = {"first": False, "second": True, "third": True}
    loop: Any = SimpleNamespace(
        supervisors=[SimpleNamespace(report=lambda: "arm"), SimpleNamespace(report=lambda: "hand")],
        sinks=list(news), _report=shown.append, _is_news=news.__getitem__, watcher=SimpleNamespace(sink=shown.append),
    )  # fmt: skip
    Measurement._look(loop)
    assert shown == ["arm", "hand", "second", "third"]


def test_a_recorder_is_news_as_soon_as_it_waits_and_for_each_gap(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measurement, "time", SimpleNamespace(monotonic=lambda: 0.0))
    loop: Any = SimpleNamespace(_waits={}, _shown={})
    sink: Any = SimpleNamespace(recorder=True, stats=SinkStats(state="running"))
    told = []
    course: list[tuple[Any, str]] = [
        ("running", ""), ("waiting", "full since 10:00"), ("running", "gap 1"), ("running", "gap 2"), ("ended", ""),
    ]  # fmt: skip
    for state, detail in course:
        sink.stats.state, sink.stats.detail = state, detail
        told.append(Measurement._is_news(loop, sink))
    assert told == [False, True, True, True, False]


@pytest.mark.parametrize("ending", [False, True])
def test_a_node_that_was_given_back_is_expected_on_its_bus_before_it_begins(ending: bool) -> None:
    """Else another that asks for its part meanwhile gets the room that was kept for it."""
    course: list[str] = []
    uuid, stranger = bytes(10), bytes([1]) * 10
    supervisor = SimpleNamespace(start=lambda: course.append("begun"))
    loop: Any = SimpleNamespace(
        _supervisor_of=lambda node: supervisor if node == uuid else None,
        lent={uuid, stranger},
        buses=SimpleNamespace(expect=lambda _uuids: course.append("expected")),
        _ending=ending,
    )
    Measurement.resume_node(loop, stranger)
    assert course == []
    for _ in range(2):
        Measurement.resume_node(loop, uuid)
    assert course == ["expected"] + ([] if ending else ["begun"])
    assert loop.lent == {stranger}


def test_the_seconds_of_a_measurement_count_from_the_first_sample_of_its_last_stream() -> None:
    began: list[bool] = []

    def until(now: float, duration: float | None, left: float | None, *first: float, ran: bool = True) -> float:
        streams = [SimpleNamespace(first_sample=lambda at=at: at) for at in first]
        loop: Any = SimpleNamespace(
            _common_start=SimpleNamespace(seconds_left=left),
            supervisors=[SimpleNamespace(ever_ran=ran, streams=stream) for stream in streams],
            began=lambda: began.append(True),
        )
        return Measurement._until(loop, now, duration)

    assert until(100.0, None, 0.0, 0.0) == math.inf
    assert until(100.0, 5.0, None, 0.0) == math.inf, "it waits for its trigger"
    assert until(100.0, 5.0, 0.0, 0.0, ran=False) == math.inf
    assert began == []
    assert until(100.0, 5.0, 0.0, 0.0, 0.0) == 105.0
    assert until(100.0, 5.0, 0.0, 100.4, 101.5) == 106.5
    assert until(100.0, 5.0, 2.0, 101.5) == 107.0
    assert began == [True] * 3


UUIDS = bytes(10), bytes([1]) * 10, bytes([2]) * 10


def measurement_of(*supervisors: Any, sinks: Any = (), request: Any = None, **more: Any) -> Any:
    """Return a measurement of these supervisors that does not run."""
    none: Any = None
    made: Any = Measurement(none, none, UUIDS, request or MeasurementRequest(), sinks, StationFacts("bench"), **more)
    made.supervisors = list(supervisors)
    made._by_uuid = {supervisor.uuid: supervisor for supervisor in supervisors}
    made._common_start = SimpleNamespace(spread=0.25)
    return made


def supervisor_of(uuid: bytes, error: TedsProvisionError | None = None, **more: Any) -> Any:
    streams = SimpleNamespace(totals={}, running={})
    facts = {"ever_ran": False, "done": threading.Event(), "ready": threading.Event(), "begun": True} | more
    return SimpleNamespace(uuid=uuid, error=error, streams=streams, turn=threading.Lock(), **facts)


def sink_of(name: str, *, recorder: bool = False, files: tuple[str, ...] = (), **stats: Any) -> Any:
    return SimpleNamespace(name=name, recorder=recorder, files=files, stats=SinkStats(**stats))


def test_the_end_of_a_measurement_has_its_nodes_files_sinks_and_worst_error() -> None:
    first, second = supervisor_of(UUIDS[0], LinkError("Silent.")), supervisor_of(UUIDS[1])
    first.streams.totals = {
        1: StreamTotals((3,), 0.01, messages=9, samples=9, lost=1, clock_error=0.5),
        0: StreamTotals((1, 2), 0.1, messages=90, lost=10),
    }
    sinks = [
        sink_of("run.csv", recorder=True, files=("/r/run.csv", "/r/run.2.csv"), written=40, dropped=2),
        sink_of("ROS 2", written=7),
    ]
    end = measurement_of(first, second, sinks=sinks)._ended()
    stream = {"messages": 90, "samples": 0, "lost": 10, "late": 0, "bad": 0, "invalid": 0, "clock_error": None,
              "invalid_why": ()}  # fmt: skip
    assert end.nodes == [
        {
            "uuid": UUIDS[0].hex(),
            "streams": [
                {"channels": [1, 2], "period": 0.1} | stream,
                {"channels": [3], "period": 0.01} | stream
                | {"messages": 9, "samples": 9, "lost": 1, "clock_error": 0.5},
            ],
            "error": {"code": "link", "message": "Silent."},
        },
        {"uuid": UUIDS[1].hex(), "streams": []},
    ]  # fmt: skip
    assert (end.files, end.apart, end.lower_rate) == (["/r/run.csv", "/r/run.2.csv"], 0.25, 5.0)
    assert end.sinks == [
        {"sink": "run.csv", "written": 40, "dropped": 2},
        {"sink": "ROS 2", "written": 7, "dropped": 0},
    ]
    assert end.error is first.error


@pytest.mark.parametrize(
    ("errors", "sinks", "code", "message"),
    [
        ([], [], None, ""),
        ([LinkError("a"), NotAuthenticError("b"), PolicyError("c")], [], 4, "b"),
        ([LinkError("a"), PolicyError("c"), StoreError("d")], [], 6, "c"),
        ([StoreError("d"), LinkError("a")], [], 5, "a"),
        ([StoreError("d"), BadDataError("e")], [], 7, "d"),
        ([], [sink_of("f", recorder=True, error="The disk is full.", written=3)], 7, "The disk is full."),
        ([], [sink_of("f", recorder=True, dropped=3)], None, ""),
        ([], [sink_of("ROS", dropped=3)], 5, "ROS accepted nothing: all 3 values were dropped."),
        ([], [sink_of("ROS", dropped=3, error="It is gone.")], 5, "It is gone."),
        ([], [sink_of("ROS", dropped=3, written=1)], None, ""),
        ([], [sink_of("ROS", dropped=3, written=1, error="It is gone.")], 1, "It is gone."),
    ],
)
def test_the_worst_error_decides_how_a_measurement_ended(
    errors: list[TedsProvisionError], sinks: list[Any], code: int | None, message: str
) -> None:
    supervisors = [supervisor_of(uuid, error) for uuid, error in zip(UUIDS, errors, strict=False)]
    worst = measurement_of(*supervisors, sinks=sinks)._ended().error
    assert (worst and worst.exit_code, worst.message if worst else "") == (code, message)


@pytest.mark.parametrize(
    ("nodes", "lent", "newcomers", "done", "gave_up"),
    [
        (["done", "done"], set(), False, True, False),
        (["done", "runs"], set(), False, False, False),
        (["done", "done"], {UUIDS[0]}, False, False, False),
        (["done", "done"], set(), True, False, False),
        (["silent", "silent"], set(), False, False, True),
        (["silent", "ran"], set(), False, False, False),
        (["silent", "link"], set(), False, False, False),
        (["silent", "silent"], set(), True, False, False),
    ],
)
def test_a_measurement_is_over_when_all_nodes_are_done_or_none_ever_answered(
    nodes: list[str], lent: set[bytes], newcomers: bool, done: bool, gave_up: bool
) -> None:
    errors = {"silent": NoNodeError("Silent."), "ran": NoNodeError("Silent."), "link": LinkError("Torn.")}
    supervisors = [
        supervisor_of(uuid, errors.get(node), ever_ran=node == "ran") for uuid, node in zip(UUIDS, nodes, strict=False)
    ]
    for supervisor, node in zip(supervisors, nodes, strict=True):
        if node == "done":
            supervisor.done.set()
    made = measurement_of(*supervisors, request=MeasurementRequest(newcomers=newcomers), lent=lent)
    assert (made._all_done(), made._gave_up()) == (done, gave_up)


def test_who_never_came_is_an_error_of_that_node_alone() -> None:
    came, refused, absent = (
        supervisor_of(UUIDS[0], ever_ran=True), supervisor_of(UUIDS[1], PolicyError("No.")), supervisor_of(UUIDS[2])
    )  # fmt: skip
    measurement_of(came, refused, absent)._note_who_never_came()
    assert (came.error, refused.error.message) == (None, "No.")
    assert absent.error.message == f"Node {UUIDS[2].hex()} did not answer before the measurement ended."


def test_a_session_is_lent_for_one_command_while_the_node_is_measured() -> None:
    trusted = object()
    supervisor = supervisor_of(UUIDS[0], verified=trusted, state="waiting")
    made = measurement_of(supervisor)
    for state, streaming, given in (
        ("waiting", False, trusted), ("waiting", True, None), ("running", True, trusted),
    ):  # fmt: skip
        supervisor.state = state
        with made.session(UUIDS[0], streaming=streaming) as session:
            assert session is given
            assert supervisor.turn.locked()
        assert not supervisor.turn.locked()
    with made.session(UUIDS[1]) as session:
        assert session is None


def test_a_node_that_is_let_go_keeps_its_place_and_one_that_never_began_is_free_at_once() -> None:
    course = list[Any]()
    began = supervisor_of(UUIDS[0], stop=lambda why, **how: course.append((why, how)))
    made = measurement_of(began, supervisor_of(UUIDS[1], begun=False), lent=set())
    assert made.suspend_node(UUIDS[0], "let go for write", 0.0) is False
    began.done.set()
    assert made.suspend_node(UUIDS[0], "let go for write", 0.0) is True
    assert course == [("let go for write", {"comes_back": True})] * 2
    assert [made.suspend_node(uuid, "x", 0.0) for uuid in UUIDS[1:]] == [True, True]
    assert made.lent == {*UUIDS}


def test_sinks_that_were_opened_before_one_that_cannot_be_leave_no_empty_recording(tmp_path: Path) -> None:
    course = list[str]()

    def sink(name: str, *, recorder: bool, fails: bool = False) -> Any:
        file = tmp_path / name

        def open_(_facts: object, _station: object) -> None:
            if fails:
                raise StoreError("No folder.")
            file.write_text("head")

        return SimpleNamespace(
            open=open_, close=lambda: course.append(f"{name} closed"), recorder=recorder, files=(str(file),)
        )

    sinks = [sink("a.csv", recorder=True), sink("socket", recorder=False), sink("b.csv", recorder=True, fails=True)]
    with pytest.raises(StoreError, match="No folder"):
        measurement_of(sinks=sinks).run(threading.Event())
    assert course == ["a.csv closed", "socket closed"]
    assert [path.name for path in tmp_path.iterdir()] == ["socket"]


def test_who_holds_up_a_trigger_is_named_once_it_takes_long(monkeypatch: pytest.MonkeyPatch) -> None:
    notes, pulled, due = list[str](), list[str](), [False]
    monkeypatch.setattr(measurement.trigger, "pull", lambda *_words: pulled.append("pulled"))
    supervisors = [supervisor_of(bytes([number]) * 10) for number in range(5)]
    made = measurement_of(*supervisors, request=MeasurementRequest(trigger=True))
    made.watcher = measurement.Watcher(note=notes.append)
    asked = list[tuple[int, int]]()

    def is_due(ready: int, all_of: int) -> bool:
        asked.append((ready, all_of))
        return due[0]

    made._common_start = SimpleNamespace(due=is_due, notice_due=lambda: True)
    made._trigger()
    assert notes == [], "none is ready, so none waits"
    supervisors[0].ready.set()
    made._trigger()
    names = ", ".join(f"{number:02x}" * 10 for number in (1, 2, 3))
    assert notes == [f"Waiting for {names} … before the trigger, up to 15 s."]
    due[0] = True
    made._trigger()
    assert (asked, pulled, len(notes)) == ([(0, 5), (1, 5), (1, 5)], ["pulled"], 1)
    made.request = MeasurementRequest()
    made._trigger()
    assert pulled == ["pulled"]


def facts(uuid: bytes, number: int, kind: str = "sensor", **more: Any) -> Any:
    return ChannelFacts(uuid.hex(), "node", number, "channel", kind, period=0.5, **more)  # type: ignore[arg-type]


def test_rows_have_every_sensor_and_begin_anew_only_if_something_is_described_otherwise() -> None:
    """A node that comes back with the same datasheet costs the others no row."""
    described: list[Any] = []
    sink: Any = SimpleNamespace(wants_rows=True, describe=described.append)
    made = measurement_of(supervisor_of(UUIDS[0]), supervisor_of(UUIDS[1]), sinks=[sink])
    made._lock, made._known, made._grids = threading.Lock(), {}, {}
    made._describe([facts(UUIDS[0], 2), facts(UUIDS[0], 1), facts(UUIDS[0], 3, "actuator")])
    grid = made._grids[""]
    assert (grid.channels, grid.group) == (((UUIDS[0].hex(), 1), (UUIDS[0].hex(), 2)), "all")
    made._describe([facts(UUIDS[0], 2), facts(UUIDS[0], 1), facts(UUIDS[0], 3, "actuator")])
    assert made._grids[""] is grid
    made._describe([facts(UUIDS[0], 2, unit="m")])
    assert made._grids[""] is not grid, "another datasheet"
    made._describe([facts(UUIDS[1], 1, "event")])
    assert [key[0] for key in made._grids[""].channels] == [UUIDS[0].hex()] * 2 + [UUIDS[1].hex()]
    assert len(described) == 4, "a sink hears of each all the same"
    sink.wants_rows, made._grids = False, {}
    made._describe([facts(UUIDS[0], 1, unit="s")])
    assert made._grids == {}


@pytest.mark.parametrize("stopped", [True, False])
def test_a_measurement_that_a_person_stops_early_reports_no_node_as_absent(
    stopped: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    absent = supervisor_of(UUIDS[0], start=lambda: None)
    monkeypatch.setattr(measurement, "NodeSupervisor", lambda *_: absent)
    monkeypatch.setattr(Measurement, "_loop", lambda *_: None)
    monkeypatch.setattr(Measurement, "_end", lambda _: None)
    made = measurement_of()
    made.uuids, made.buses = UUIDS[:1], SimpleNamespace(expect=lambda _: None)
    stop = threading.Event()
    if stopped:
        stop.set()
    error = made.run(stop).error
    if stopped:
        assert error is None
    else:
        assert isinstance(error, NoNodeError)
        assert "did not answer before the measurement ended" in error.message


@pytest.mark.parametrize("begun", [True, False])
def test_a_node_that_leaves_is_ended_with_the_reason_and_waited_for(begun: bool) -> None:
    course = list[Any]()
    one = supervisor_of(UUIDS[0], begun=begun, stop=course.append, join=course.append)
    made = measurement_of(one)
    made.leave(UUIDS[0], "gone")
    made.leave(UUIDS[1], "never here")
    assert course == (["gone", 10.0] if begun else [])
    assert made.supervisors == [one], "its counts stay"


def test_a_block_that_was_stamped_before_the_clock_was_set_has_the_new_time() -> None:
    kept, seen = list[Block](), list[Block]()
    sink: Any = SimpleNamespace(write=kept.append)
    made = measurement_of(sinks=[sink], watcher=measurement.Watcher(block=seen.append))
    made._setting, made._grids, made._for_grid = threading.Lock(), {}, deque()
    made._host = SimpleNamespace(present=(2, 0.0), since=lambda number: {0: 60.0, 1: -2.5}[number])
    for clock, moved in ((0, 60.0), (1, -2.5), (2, 0.0), (None, 0.0)):
        given = replace(block([[1], [2]], start=1000.0), clock=clock)
        made._block(given)
        assert (kept[-1].time - given.time).tolist() == [moved] * 2
        assert kept[-1].clock == (None if clock is None else 2)
        assert seen[-1] is kept[-1]
        assert made._for_grid == deque(), "no sink wants rows"
    made._grids = {"": object()}
    made._block(given)
    assert list(made._for_grid) == [given]


@pytest.mark.parametrize("newcomers", [False, True])
def test_rows_are_made_of_every_node_together_or_of_each_alone_where_nodes_come_and_go(newcomers: bool) -> None:
    class Grid:
        def __init__(self) -> None:
            self.blocks: list[str] = []

        def add_block(self, block: Block) -> None:
            self.blocks.append(block.uuid)

        def rows(self, now: float) -> object:
            return (now, tuple(self.blocks)) if self.blocks else None

    made = measurement_of(request=MeasurementRequest(newcomers=newcomers))
    made._host = SimpleNamespace(now=lambda: 7.0)
    made._for_grid = deque([block(uuid=ARM), block(uuid=HAND, channels=(2,)), block(uuid=ARM)])
    made._grids = {ARM: Grid(), HAND: Grid(), "00": Grid()} if newcomers else {"": Grid()}
    found = made._synchronized()
    assert found == ([(7.0, (ARM, ARM)), (7.0, (HAND,))] if newcomers else [(7.0, (ARM, HAND, ARM))])
    assert made._for_grid == deque()
    made._grids, made._for_grid = {}, deque([block()])
    assert made._synchronized() == [], "its grid is gone"


def test_rows_are_made_if_one_sink_wants_them_and_anew_if_one_channel_is_another() -> None:
    shown: list[Any] = []
    sinks: Any = [SimpleNamespace(wants_rows=wants, describe=lambda _facts: None) for wants in (False, True)]
    made = measurement_of(supervisor_of(UUIDS[0]), sinks=sinks, watcher=measurement.Watcher(facts=shown.append))
    made._lock, made._known, made._grids = threading.Lock(), {}, {}
    described = [facts(UUIDS[0], 1), facts(UUIDS[0], 2)]
    made._describe(described)
    assert shown == [described]
    grid = made._grids[""]
    made._describe([facts(UUIDS[0], 1, unit="m"), facts(UUIDS[0], 2)])
    assert made._grids[""] is not grid


@pytest.mark.parametrize(("ran", "end"), [((True, False), 105.0), ((False, True), 105.0), ((False, False), math.inf)])
def test_one_node_with_values_is_enough_for_the_seconds_to_count(ran: tuple[bool, bool], end: float) -> None:
    streams = SimpleNamespace(first_sample=lambda: 0.0)
    loop: Any = SimpleNamespace(
        _common_start=SimpleNamespace(seconds_left=0.0), began=lambda: None,
        supervisors=[SimpleNamespace(ever_ran=one, streams=streams) for one in ran],
    )  # fmt: skip
    assert Measurement._until(loop, 100.0, 5.0) == end


def test_each_row_goes_to_every_sink() -> None:
    written: list[tuple[str, str]] = []
    sinks = [
        SimpleNamespace(write_group=lambda rows, name=name: written.append((name, rows))) for name in ("file", "topic")
    ]
    made: Any = SimpleNamespace(_lock=threading.Lock(), _synchronized=lambda: ["first", "second"], sinks=sinks)
    Measurement._rows(made)
    assert written == [("file", "first"), ("topic", "first"), ("file", "second"), ("topic", "second")]
