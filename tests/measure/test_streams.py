"""The streams of one node: what a refused Subscribe leaves, and which silence counts."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError
from teds_provision.measure.clock import HostClock
from teds_provision.measure.running.streams import SILENT, NodeStreams
from teds_provision.protocol.operation.stream_commands import StreamKind


class Bus:
    """The hearing thread of a link, which only notes what it is told."""

    def __init__(self) -> None:
        self.course: list[tuple[str, int]] = []
        self.hearing = self

    def expect(self, _node: int, stream: int, _length: int) -> object:
        self.course.append(("expected", stream))
        return object()

    def forget(self, _node: int, stream: int) -> None:
        self.course.append(("forgotten", stream))


@pytest.mark.parametrize("runs", [False, True])
def test_a_refused_subscribe_is_expected_no_more_and_a_stream_that_runs_is_heard_on(runs: bool) -> None:
    """A refused one changes nothing (operation.md section 4); what is expected for ever takes memory and time."""
    bus: Any = Bus()
    streams = NodeStreams(HostClock(), lambda _block: None)
    if runs:
        heard: Any = object()
        streams.running[2] = heard

    def refuse(*_words: Any) -> bytes:
        raise NodeRefusedError("No room.", reason=22)

    trusted: Any = SimpleNamespace(node=SimpleNamespace(request=refuse))
    plan: Any = SimpleNamespace(subscribe=SimpleNamespace(stream=2), length=63, command=lambda: None)
    with pytest.raises(NodeRefusedError):
        streams.subscribe(bus, trusted, plan, 0x21)
    assert bus.course == [("expected", 2), *([] if runs else [("forgotten", 2)])]
    assert list(streams.running) == ([2] if runs else [])


def test_events_and_what_waits_for_a_trigger_may_be_silent_and_other_streams_for_three_messages() -> None:
    streams, now = NodeStreams(HostClock(), lambda _block: None), time.monotonic()

    def stream(kind: StreamKind, span: float, start: int | None, ago: float) -> Any:
        plan = SimpleNamespace(subscribe=SimpleNamespace(kind=kind), span=round(span * 1e9))
        return SimpleNamespace(receiver=SimpleNamespace(plan=plan, start=start), last_good_at=now - ago)

    quiet = {0: stream(StreamKind.EVENT, 0.1, 0, 900.0), 1: stream(StreamKind.PERIODIC, 0.1, None, 900.0)}
    streams.running.update(quiet)
    assert (streams.every(), streams.silent(now)) == (None, 0.0)
    streams.running[2] = stream(StreamKind.PERIODIC, 1.0, 5, SILENT + 2.9)
    assert (streams.every(), streams.silent(now)) == (3.0, 0.0)
    streams.running[3] = stream(StreamKind.FREE, 0.2, 5, SILENT + 0.7)
    assert streams.every() == pytest.approx(0.6)
    assert streams.silent(now) == pytest.approx(SILENT + 0.7)
    assert streams.heard_since(now - SILENT - 0.8)
    assert not streams.heard_since(now - SILENT - 0.6)
