"""The supervisor of one node: a bug of ours in it, its place among those that begin, and Announces without end."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import GarbledError
from teds_provision.measure import node_supervisor
from teds_provision.measure.blocks import NodeReport
from teds_provision.measure.clock import HostClock
from teds_provision.measure.node_supervisor import LOOK, NodeSupervisor
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.station.store.records import KeptMeasurement

UUID = bytes(range(10))


def test_a_foreign_exception_ends_the_node_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[NodeReport] = []
    events = Events(lambda _block: None, lambda _facts: None, reports.append)
    buses: Any = SimpleNamespace(all=list)
    host = HostClock()
    supervisor = NodeSupervisor(None, buses, UUID, MeasurementRequest(), host, events, CommonStart([UUID]))  # type: ignore[arg-type]

    def broken() -> None:
        raise ValueError("cannot convert float NaN to integer")

    monkeypatch.setattr(supervisor, "_try_once", broken)
    supervisor.start()
    supervisor.join(60)
    assert supervisor.done.is_set()
    assert supervisor.error is not None
    assert (supervisor.error.code, supervisor.error.exit_code) == ("bug", 1)
    assert reports[-1].state == "refused"
    assert "ValueError" in reports[-1].why


def test_a_node_is_among_those_that_begin_until_it_runs_or_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is read in the background waits for these; one that stayed among them would hold it up for a minute."""
    bus, seen = SimpleNamespace(beginning=set()), list[set[bytes]]()

    def fails(*_: object) -> None:
        seen.append(set(bus.beginning))
        raise GarbledError("It sent nonsense.")

    monkeypatch.setattr(NodeSupervisor, "_open_and_measure", fails)
    events = Events(lambda _block: None, lambda _facts: None, lambda _report: None)
    none: Any = None
    supervisor = NodeSupervisor(none, none, UUID, MeasurementRequest(), HostClock(), events, CommonStart([UUID]))
    with pytest.raises(GarbledError):
        supervisor._in_session(cast(Any, bus), none, none)
    assert seen == [{UUID}]
    assert bus.beginning == set()


def test_announces_without_end_make_it_look_no_more_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any device can announce itself as this node, again at once after each look at the node's data."""
    events = Events(lambda _block: None, lambda _facts: None, lambda _report: None)
    none: Any = None
    supervisor = NodeSupervisor(none, none, UUID, MeasurementRequest(), HostClock(), events, CommonStart([UUID]))
    sends_fast = SimpleNamespace(
        every=lambda: 0.01, heard_since=lambda _moment: True, silent=lambda _now: 0.0, clock=SimpleNamespace(lie="")
    )
    monkeypatch.setattr(supervisor, "streams", sends_fast)
    looks: list[float] = []

    def require() -> None:
        looks.append(time.monotonic())
        supervisor._doubted(looks[-1])
        supervisor._heard_announce()
        if len(looks) == 5:
            supervisor.stop()

    supervisor._watch(none, none, cast(Any, SimpleNamespace(require=require, mark="")), None)
    assert looks[-1] - looks[0] >= 0.9 * 4 * LOOK


def supervisor_at(now: list[float], monkeypatch: pytest.MonkeyPatch, **request: Any) -> NodeSupervisor:
    """Return a supervisor whose clock stands at ``now``, and which waits for nothing."""
    monkeypatch.setattr(node_supervisor, "time", SimpleNamespace(monotonic=lambda: now[0]))
    events, none = Events(lambda _block: None, lambda _facts: None, lambda _report: None), cast(Any, None)
    made = NodeSupervisor(none, none, UUID, MeasurementRequest(**request), HostClock(), events, CommonStart([UUID]))
    monkeypatch.setattr(made, "_anew", SimpleNamespace(wait=lambda _seconds: False, set=lambda: None))
    return made


def test_a_node_is_asked_a_second_after_its_first_announce_however_many_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    supervisor = supervisor_at(now, monkeypatch)
    monkeypatch.setattr(supervisor, "streams", SimpleNamespace(every=lambda: 10.0))
    for _ in range(4):
        supervisor._heard_announce()
        assert not supervisor._doubted(now[0])
        now[0] += 0.25
    assert supervisor._doubted(now[0])
    assert not supervisor._doubted(now[0] + 10.0), "once"


def test_a_node_is_told_the_time_every_third_of_its_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    now, told = [0.0], list[float]()
    supervisor = supervisor_at(now, monkeypatch, lease=3)
    streams = SimpleNamespace(
        tell_time=lambda _trusted: told.append(now[0]), silent=lambda _now: 0.0, clock=SimpleNamespace(lie="")
    )
    monkeypatch.setattr(supervisor, "streams", streams)

    def require() -> None:
        now[0] += 0.25
        if now[0] >= 4.0:
            supervisor.stop()

    none: Any = None
    supervisor._watch(none, none, cast(Any, SimpleNamespace(require=require, mark="")), None)
    assert told == [1.0, 2.0, 3.0, 4.0]


def test_a_node_that_was_given_back_is_lent_no_more() -> None:
    """It would never be let go when it is lost later, and not join again."""
    station: Any = None
    job = MeasurementJob(station, KeptMeasurement("run", uuids=(UUID,)))
    assert job.suspend_node(UUID, "let go for write", 0.0)
    assert job.lent == {UUID}
    job.resume_node(UUID)
    assert job.lent == set()
