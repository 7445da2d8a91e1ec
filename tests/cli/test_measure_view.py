"""What a running ``measure`` prints: JSON lines in their order, plain lines, and the rows of the live table."""

from __future__ import annotations

import io
import json
import sys
import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from teds_provision.cli.context import App
from teds_provision.cli.measure import measure_view
from teds_provision.cli.measure.measure_view import LiveTable, PlainLines, StdoutEvents
from teds_provision.measure.blocks import Block, ChannelFacts, InvalidValues, NodeReport
from teds_provision.teds.units import parse_unit

UUID, OTHER = "0a" * 10, "0b" * 10
KELVIN = parse_unit("K").units


def block(*values: float, uuid: str = UUID, at: float = 100.0, channels: tuple[int, ...] = (1,)) -> Block:
    rows = np.array([values]).T if len(channels) == 1 else np.array([values])
    times = at + np.arange(len(rows)) / 10
    return Block(
        uuid, 0, channels, 7, times, (times * 1e9).astype(np.uint64), rows.astype(object), rows, ~np.isnan(rows)
    )


def sink(name: str, state: str = "ok", *, error: str = "", detail: str = "", hint: str = "") -> Any:
    stats = SimpleNamespace(state=state, error=error, detail=detail, hint=hint, dropped=3, written=1)
    return SimpleNamespace(name=name, stats=stats)


class Said:
    """Stands for the program: keeps notes and warnings."""

    def __init__(self) -> None:
        self.notes: list[str] = []
        self.warnings: list[str] = []

    def note(self, text: str) -> None:
        self.notes.append(text)

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    def app(self) -> App:
        return cast("App", self)


# -- JSON --------------------------------------------------------------------------------------------------------------


class Printed:
    """What came out of the program so far."""

    def __init__(self, captured: pytest.CaptureFixture[bytes]) -> None:
        self._captured, self._octets = captured, b""

    def lines(self) -> list[dict[str, Any]]:
        self._octets += self._captured.readouterr().out
        return [json.loads(line) for line in self._octets.splitlines()]


@pytest.fixture
def printed(capsysbinary: pytest.CaptureFixture[bytes]) -> Printed:
    return Printed(capsysbinary)


def test_a_node_that_left_is_reported_after_its_last_values(printed: Printed) -> None:
    events = StdoutEvents(threading.Event())
    events._process_item((ChannelFacts(UUID, "left", 1, "oil", unit="K"),))
    for state, why in (("running", ""), ("refused", "revoked"), ("refused", "revoked again"), ("running", "")):
        events._process_item(block(300.0))
        events._process_item(NodeReport(UUID, cast("Any", state), why))
    events._process_item(NodeReport(OTHER, "refused", "never ran"))
    found = printed.lines()
    assert [(line["event"], line.get("state", line.get("why", ""))) for line in found] == [
        ("data", ""), ("status", "running"), ("data", ""), ("status", "refused"), ("left", "revoked"),
        ("data", ""), ("status", "refused"), ("data", ""), ("status", "running"), ("status", "refused"),
    ]  # fmt: skip
    assert found[4] == {"event": "left", "uuid": UUID, "why": "revoked"}
    assert (found[0]["name"], found[0]["unit"], found[0]["value"]) == ("oil", "K", [300.0])


def test_a_changed_state_is_reported_once(printed: Printed, monkeypatch: pytest.MonkeyPatch) -> None:
    events = StdoutEvents(threading.Event())
    reported: list[NodeReport] = []
    monkeypatch.setattr(events, "report", reported.append)
    for state, why, lost in (("running", "", 0), ("running", "", 5), ("running", "slow", 5), ("refused", "slow", 5)):
        events.report_change(NodeReport(UUID, cast("Any", state), why, lost=lost))
    events.report_change(NodeReport(OTHER, "refused", "slow"))
    assert [(report.uuid, report.state, report.why, report.lost) for report in reported] == [
        (UUID, "running", "", 0), (UUID, "running", "slow", 5), (UUID, "refused", "slow", 5),
        (OTHER, "refused", "slow", 0),
    ]  # fmt: skip


def test_sinks_come_between_and_at_the_end(printed: Printed) -> None:
    events = StdoutEvents(threading.Event())
    events.sink(sink("csv", "failed", error="disk full", detail="x", hint="Free some."))
    events.sink(sink("mqtt", "waiting", detail="no broker"))
    assert printed.lines() == []
    events._process_item(NodeReport(UUID, "running"))
    events.sink(sink("csv", "ok"))
    events._finish()
    assert [line for line in printed.lines() if line["event"] == "sink"] == [
        {"event": "sink", "sink": "csv", "state": "failed", "why": "disk full", "hint": "Free some.", "dropped": 3},
        {"event": "sink", "sink": "mqtt", "state": "waiting", "why": "no broker", "hint": "", "dropped": 3},
        {"event": "sink", "sink": "csv", "state": "ok", "why": "", "hint": "", "dropped": 3},
    ]
    assert printed.lines()[0]["event"] == "status"


def test_a_reader_that_is_gone_ends_the_measurement(monkeypatch: pytest.MonkeyPatch) -> None:
    class Gone(io.BytesIO):
        def write(self, _octets: Any) -> int:
            raise BrokenPipeError

    monkeypatch.setattr(sys, "stdout", SimpleNamespace(buffer=Gone()))
    stop = threading.Event()
    with pytest.raises(BrokenPipeError):
        StdoutEvents(stop)._process_item(NodeReport(UUID, "running"))
    assert stop.is_set()


# -- lines and table ---------------------------------------------------------------------------------------------------


def test_plain_lines_have_each_change_and_each_sink() -> None:
    said = Said()
    plain = PlainLines(said.app())
    for state, why, lost in (("running", "", 0), ("running", "", 5), ("refused", "revoked", 5)):
        plain.report(NodeReport(UUID, cast("Any", state), why, lost=lost))
    assert said.notes == [f"{UUID}: running", f"{UUID}: refused: revoked"]
    plain.sink(sink("csv", "failed", error="The disk is full.", hint="Free some."))
    plain.sink(sink("csv", "failed", error="The disk is full."))
    plain.sink(sink("mqtt", "waiting", detail="no broker"))
    assert said.warnings == ["The disk is full. Free some.", "The disk is full.", "mqtt: waiting, no broker"]


def cells(table: Any) -> list[list[str]]:
    return [list(row) for row in zip(*(column._cells for column in table.columns), strict=True)]


def test_the_live_table_has_the_newest_value_of_each_channel(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [50.0]
    monkeypatch.setattr(measure_view, "time", SimpleNamespace(monotonic=lambda: now[0], time=lambda: 101.5))
    said = Said()
    live = LiveTable(said.app(), [sink("csv [x]"), sink("mqtt", "waiting", detail="no broker")])
    live.facts([ChannelFacts(UUID, "left [b]", 1, "oil", unit="K", units=KELVIN, shown_unit="degC")])
    live.block(block(293.15, 294.15))
    now[0] += 2.0
    live.block(block(295.15, at=101.0))
    live.block(block(1.0, float("nan"), uuid=OTHER, at=102.0, channels=(2, 3)))
    live.report(NodeReport(UUID, "running", lost=1, late=2, bad=3, invalid=4, clock_error=0.00123,
                           invalid_why=(InvalidValues(1, "above its limit", 4),)))  # fmt: skip
    live.report(NodeReport(OTHER, "refused", "revoked [x]"))
    table = live._table()
    label = ChannelFacts(UUID, "left [b]", 1, "oil").label
    assert cells(table) == [
        ["left \\[b]", label, "22", "°C", "0.50 s", "1.5 Hz"],
        [OTHER[:8], ChannelFacts(OTHER, "", 2, "").label, "1", "", "0.00 s", "1000 Hz"],
        [OTHER[:8], ChannelFacts(OTHER, "", 3, "").label, "not valid", "", "0.00 s", "1000 Hz"],
    ]
    assert str(table.caption).splitlines() == [
        f"{UUID} running: lost 1, late 2, bad 3, invalid 4 (4 of channel 1: above its limit), clock ±1.2 ms",
        f"{OTHER} refused (revoked (x]): lost 0, late 0, bad 0, invalid 0",
        "csv (x]: ok, 1 value, 3 dropped. ",
        "mqtt: waiting, 1 value, 3 dropped. no broker",
    ]
    live.sink(sink("csv", "failed", error="The disk is full.", hint="Free some."))
    live.sink(sink("mqtt", "waiting", detail="no broker"))
    assert said.warnings == ["The disk is full. Free some."]


def test_the_table_ends_after_40_rows() -> None:
    live = LiveTable(Said().app(), [])
    live.block(block(*map(float, range(41)), channels=tuple(range(1, 42))))
    assert len(cells(live._table())) == 40


@pytest.mark.parametrize(
    ("quiet", "terminal", "table"), [(False, True, True), (True, True, False), (False, False, False)]
)
def test_who_wants_it_quiet_or_writes_into_a_file_has_no_table(
    monkeypatch: pytest.MonkeyPatch, quiet: bool, terminal: bool, table: bool
) -> None:
    monkeypatch.setattr(sys, "stdout", SimpleNamespace(isatty=lambda: terminal))
    shown: list[str] = []

    class Table:
        def __init__(self, *_: object) -> None:
            self.block = self.facts = self.report = self.sink = None

        def shown(self) -> Any:
            shown.append("table")
            return nullcontext(self)

    monkeypatch.setattr(measure_view, "LiveTable", Table)
    app: Any = SimpleNamespace(json=False, quiet=quiet, warn=None, note=None)
    station: Any = SimpleNamespace(name="bench")
    with measure_view.watcher_for(app, station, [], threading.Event()):
        assert shown == (["table"] if table else [])


def test_another_reason_is_a_change_in_plain_lines_too() -> None:
    said = Said()
    plain = PlainLines(said.app())
    for why in ("it is silent", "it is silent", "it is far"):
        plain.report(NodeReport(UUID, "waiting", why))
    plain.report(NodeReport(OTHER, "waiting", "it is far"))
    assert said.notes == [
        f"{UUID}: waiting: it is silent", f"{UUID}: waiting: it is far", f"{OTHER}: waiting: it is far",
    ]  # fmt: skip


def test_rows_of_the_table_are_by_node_and_channel_whoever_came_first() -> None:
    live = LiveTable(Said().app(), [])
    live.block(block(1.0, 2.0, uuid=OTHER, channels=(3, 1)))
    live.block(block(3.0, uuid=UUID))
    assert [row[0] + row[1][-1] for row in cells(live._table())] == [f"{UUID[:8]}1", f"{OTHER[:8]}1", f"{OTHER[:8]}3"]
