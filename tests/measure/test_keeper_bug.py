"""A bug of ours while a node is measured: told with the node, never taken for an end in order."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

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

    monkeypatch.setattr(keeper, "_once", broken)
    keeper.start()
    keeper.join(60)
    assert keeper.done.is_set()
    assert keeper.error is not None
    assert (keeper.error.code, keeper.error.exit_code) == ("bug", 1)
    assert reports[-1].state == "refused"
    assert "ValueError" in reports[-1].why
