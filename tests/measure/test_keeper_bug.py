"""A bug of ours while a node is measured: told with the node, never taken for an end in order."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import GarbledError
from teds_provision.measure.blocks import NodeReport
from teds_provision.measure.clock import HostClock
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.measure.running.common_start import CommonStart

UUID = bytes(range(10))


def test_a_foreign_exception_ends_the_node_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[NodeReport] = []
    events = Events(lambda _block: None, lambda _facts: None, reports.append)
    buses: Any = SimpleNamespace(all=list)
    host = HostClock()
    keeper = NodeSupervisor(None, buses, UUID, MeasurementRequest(), host, events, CommonStart([UUID]))  # type: ignore[arg-type]

    def broken() -> None:
        raise ValueError("cannot convert float NaN to integer")

    monkeypatch.setattr(keeper, "_try_once", broken)
    keeper.start()
    keeper.join(60)
    assert keeper.done.is_set()
    assert keeper.error is not None
    assert (keeper.error.code, keeper.error.exit_code) == ("bug", 1)
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
    keeper = NodeSupervisor(none, none, UUID, MeasurementRequest(), HostClock(), events, CommonStart([UUID]))
    with pytest.raises(GarbledError):
        keeper._in_session(cast(Any, bus), none, none)
    assert seen == [{UUID}]
    assert bus.beginning == set()
