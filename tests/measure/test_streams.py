"""The streams of one node: what a refused Subscribe leaves, and which silence counts."""

from __future__ import annotations

import time
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import NodeRefusedError, NotAuthenticError
from teds_provision.measure.blocks import InvalidValues
from teds_provision.measure.clock import Exchange, HostClock
from teds_provision.measure.running import streams as of_streams
from teds_provision.measure.running.streams import SILENT, NodeStreams, StreamTotals
from teds_provision.protocol.operation.stream_commands import StreamKind, SubscribeReply
from teds_provision.protocol.operation.subscription import Counts, StreamPlan, TickBounds


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


def test_the_last_of_its_streams_takes_its_first_sample_when_all_have_begun() -> None:
    streams = NodeStreams(HostClock(), lambda _block: None)
    assert streams.first_sample() == 0.0
    streams.clock.exchange(Exchange(50 * 10**9, 50 * 10**9, 10**9, 10**9, 1, 20))
    for number, start in ((0, 3 * 10**9), (1, 4 * 10**9), (2, None), (3, 2 * 10**9)):
        streams.running[number] = cast(Any, SimpleNamespace(receiver=SimpleNamespace(start=start)))
    assert streams.first_sample() == pytest.approx(53.0, abs=1e-3)


def heard(messages: int, samples: int, bound: float | None, **counts: int) -> Any:
    """Return a run of a stream that counted so; each kind of bad message has a digit of its own."""
    return SimpleNamespace(
        receiver=SimpleNamespace(counts=Counts(good=messages, **counts)),
        samples=samples,
        wrong_pattern=700_000,
        pieces=SimpleNamespace(wrong=6_000_000),
        interpreter=SimpleNamespace(invalid=(InvalidValues(1, "too high", 3), InvalidValues(2, "too high", 1))),
        bound=bound,
    )


def test_what_is_counted_of_a_stream_goes_on_from_run_to_run() -> None:
    totals = StreamTotals((1, 2), 0.01)
    first = heard(5, 50, 0.002, lost=1, late=1, stale=20, overflow=300, bad=1, junk=20, future=300, back=4_000,
                  unasked=50_000, cut=9)  # fmt: skip
    now = totals.with_run(first)
    assert (totals.samples, totals.with_run(None)) == (0, totals)
    assert now == StreamTotals(
        (1, 2), 0.01, messages=5, samples=50, lost=1, late=321, bad=6_754_321, invalid=4, clock_error=0.002,
        invalid_why=(InvalidValues(1, "too high", 3), InvalidValues(2, "too high", 1)),
    )  # fmt: skip
    again = now.with_run(heard(2, 20, None))
    assert (again.messages, again.samples, again.lost, again.bad) == (7, 70, 1, 6_754_321 + 6_700_000)
    assert (again.invalid, again.clock_error) == (8, 0.002), "the last bound that was known"
    assert again.with_run(heard(1, 10, 0.001)).clock_error == 0.001


@pytest.mark.parametrize(
    ("period", "messages", "lost", "rate"),
    [(0.01, 90, 10, 50.0), (0.01, 90, 0, None), (0.01, 0, 10, None), (0.0, 90, 10, None)],
)
def test_a_lower_rate_is_proposed_for_a_stream_that_lost_some_of_its_messages(
    period: float, messages: int, lost: int, rate: float | None
) -> None:
    assert StreamTotals((1,), period, messages=messages, lost=lost).lower_rate == rate


@pytest.mark.parametrize(
    ("wanted", "waited", "finished"), [(7, [7, 7], (9, 7)), (9, [9, 9], (9, 9)), (0, [0, 9], (9, 9))]
)
def test_a_stream_that_is_stopped_is_heard_out_to_what_was_wanted_of_it(
    wanted: int, waited: list[int], finished: tuple[int, int]
) -> None:
    """What was begun after the end that the station wanted is not lost; without a session nobody is asked."""
    bus: Any = Bus()
    course = list[Any]()
    bus.hear_out = lambda _stream, due: course.append(due)
    for answers in (True, False):
        streams = NodeStreams(HostClock(), lambda _block: None)
        stream = heard(5, 50, None)
        stream.ending = lambda: wanted
        stream.receiver.finish = lambda *counters: course.append(counters)
        streams.running[2] = stream
        streams.totals[2] = StreamTotals((1,), 0.01)
        node = SimpleNamespace(request=lambda _command, _doing: (9).to_bytes(4, "big"))
        streams.stop(bus, cast(Any, SimpleNamespace(node=node)) if answers else None, 0x21)
        assert course == ([*waited, finished] if answers else [])
        assert (bus.course, streams.running, streams.totals[2].samples) == ([("forgotten", 2)], {}, 50)
        course.clear()
        bus.course.clear()


def test_values_that_come_before_their_channels_are_described_are_held_and_keep_their_order() -> None:
    came = list[Any]()
    streams = NodeStreams(HostClock(), came.append)
    before = streams.clock
    for session in range(2):
        streams.new_session()
        streams._run = 5
        streams._deliver(cast(Any, f"{session} early"))
        streams._deliver(cast(Any, f"{session} next"))
        assert came == []
        streams.described()
        streams._deliver(cast(Any, f"{session} late"))
        assert came == [f"{session} early", f"{session} next", f"{session} late"]
        came.clear()
    streams._deliver(cast(Any, "on"))
    streams.new_session()
    assert (came, streams._run, streams.clock is before) == (["on"], 0, False)


def test_a_stream_is_registered_with_its_run_which_is_newer_than_each_before(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two runs of one number would have one key (operation.md section 3); what is under way of the old is no error."""
    streams, registered = NodeStreams(HostClock(), lambda _block: None), list[Any]()
    hearing = SimpleNamespace(
        expect=lambda _node, number, _length: f"pieces {number}",
        register=lambda node, number, heard: registered.append((node, number, heard)),
        forget=lambda *_words: registered.append("forgotten"),
    )
    bus: Any = SimpleNamespace(hearing=hearing)
    made: list[dict[str, Any]] = []

    class Made:
        def __init__(self, *_words: Any, **named: Any) -> None:
            made.append(named)

    monkeypatch.setattr(of_streams, "StreamInterpreter", Made)
    runs = iter([1, 3, 3])
    plans = [StreamPlan.for_channels(number, ((1, 2),), n=2, period=10**7) for number in (0, 1)]
    replies = {plan.command().payload: plan for plan in plans}

    def request(command: Any, _doing: str) -> bytes:
        return SubscribeReply(next(runs), replies[command.payload].length, 10**9).encode()

    trusted: Any = SimpleNamespace(
        node=SimpleNamespace(request=request, message_key=bytes(32)), sheet=None, unsigned=True
    )
    monkeypatch.setattr(streams.clock, "ticks_at", lambda _host: TickBounds(0, 10**9))
    before = time.monotonic()
    streams.subscribe(bus, trusted, plans[0], 0x21, ahead=100.0)
    first = streams.running[0]
    assert registered == [(0x21, 0, first)]
    assert first.last_good_at >= before + 100.0, "it is silent until its first sample, and not lost"
    assert (first.pieces, first.receiver.run, first.receiver._before) == ("pieces 0", 1, None)
    trusted.unsigned = False
    streams.subscribe(bus, trusted, plans[0], 0x21)
    again = streams.running[0]
    assert again.receiver._before is first.receiver._sealer
    assert (again.receiver.run, registered[1:]) == (3, [(0x21, 0, again)])
    assert [named["raw_only"] for named in made] == ["the datasheet is unsigned: raw values only", ""]
    assert (streams.totals[0].channels, streams.totals[0].period) == ((1,), 0.01)
    with pytest.raises(NotAuthenticError, match="run 3 after run 3"):
        streams.subscribe(bus, trusted, plans[1], 0x21)
    assert registered[-1] == "forgotten"
    assert list(streams.running) == [0]
