"""The loop of a measurement, without nodes: which states of its sinks are news, and who gets room again."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.measure.blocks import SinkStats
from teds_provision.measure.running import measurement
from teds_provision.measure.running.measurement import WAITING, Measurement


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
