"""A stream as it is heard: whatever comes together, the same samples come out, each with its own time."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import asdict, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.links.can.bus_multiplexer import Listener
from teds_provision.links.can.data_streams import CanDataListener, CanStreams
from teds_provision.links.can.isotp import Frame
from teds_provision.links.streaming import DataMessage, MeasuringLink
from teds_provision.measure.blocks import Block
from teds_provision.measure.clock import ClockMap, Exchange, HostClock, MonotonicStamps, WallClock
from teds_provision.measure.interpreter import BLOCKS, StreamInterpreter
from teds_provision.measure.stream_receiver import GATHER, HEARD_OUT, HearingThread, ReceivedStream
from teds_provision.protocol.operation.can_frames import DataAddress, StreamAssembly, cut
from teds_provision.protocol.operation.datagram import DatagramSealer, stream_key
from teds_provision.protocol.operation.stream_commands import StreamKind, SubscribeReply
from teds_provision.protocol.operation.subscription import Receiver, StreamPlan
from teds_provision.teds.calibration import fit
from teds_provision.teds.calibration.vectorized import ManyChannels
from tests.pace import best_of, until
from tests.teds.test_interpreter import sheet_of

KEY, MS, SECOND = bytes(32), 1_000_000, 10**9
CURVES = {
    1: fit([(0, 0.0), (65535, 10.0)], "linear", channel=1),
    2: fit([(0, 0.0), (30000, 5.0), (65535, 10.0)], "table", channel=2),
}
SHEET = sheet_of("tactile-finger-sensor", CURVES)
WALL = WallClock(1.8e9)
HOST = HostClock(WALL)


class Scene:
    """A stream of two channels, n = 3 at 1 kHz, whose node's clock stood at 1 s when the host's stood at ``base``."""

    def __init__(
        self,
        kind: StreamKind = StreamKind.PERIODIC,
        period: int = MS,
        *,
        real: int = MS,
        ago: int = 3600,
        fd: bool = True,
    ) -> None:
        self.real = real  # period of a sensor that runs free
        self.plan = StreamPlan.for_channels(0, ((1, 2), (2, 2)), n=3, period=period, kind=kind)
        self.base = time.monotonic_ns() - ago * SECOND
        clock = ClockMap()
        clock.exchange(Exchange(self.base, self.base + 2000, SECOND + 500, SECOND + 1500, 1, 20))
        self.clock, self.blocks = clock, list[Block]()
        receiver = Receiver(self.plan, SubscribeReply(1, self.plan.length, SECOND), KEY)
        interpreter = StreamInterpreter(SHEET, self.plan, 1, clock, HOST, MonotonicStamps())
        assembly = StreamAssembly(self.plan.length, fd=fd)
        self.heard = ReceivedStream(receiver, assembly, interpreter, clock, threading.Lock(), self.blocks.append)
        self._sealer = DatagramSealer(stream_key(KEY, 1))

    def message(self, counter: int, flags: int = 0) -> bytes:
        raws = np.random.default_rng(counter).integers(0, 65536, 6).astype(">u2").tobytes()
        free = (
            (SECOND + counter * 3 * self.real + 17).to_bytes(8, "big")
            if self.plan.subscribe.kind == StreamKind.FREE
            else b""
        )
        return self._sealer.seal(counter, bytes([flags]) + free + raws)

    def arrival(self, counter: int) -> int:
        return self.base + (counter + 1) * self.plan.span

    def samples(self) -> dict[str, list[object]]:
        """All blocks laid end to end."""
        rows = {"index": [block.index + k for block in self.blocks for k in range(len(block.time))]}
        for name in ("time", "tick", "raw", "value", "valid"):
            rows[name] = np.concatenate([getattr(block, name) for block in self.blocks]).tolist() if self.blocks else []
        return rows  # type: ignore[return-value]


@pytest.mark.parametrize("kind", [StreamKind.PERIODIC, StreamKind.FREE])
@given(st.lists(st.tuples(st.integers(0, 3), st.booleans(), st.booleans()), min_size=1, max_size=30), st.integers(0, 4))
@settings(max_examples=60, deadline=None)
def test_together_or_one_by_one_the_same_samples(
    kind: StreamKind, steps: list[tuple[int, bool, bool]], bent: int
) -> None:
    """Gaps, doubles and forged messages between good ones; batches end where the second flag says so."""
    one_by_one, together = Scene(kind), Scene(kind)
    counter = 0
    for number, (step, ends, invalid) in enumerate(steps):
        counter += step  # 0: a double of the one before
        octets = one_by_one.message(counter, flags=int(invalid))
        if number % 5 == bent:
            octets = octets[:-1] + bytes([octets[-1] ^ 1])
        for scene in (one_by_one, together):
            scene.heard.queue_message(octets, scene.arrival(counter))
        one_by_one.heard.finish()
        if ends:
            together.heard.finish()
    together.heard.finish()
    assert asdict(together.heard.receiver.counts) == asdict(one_by_one.heard.receiver.counts)
    alone, all_at_once = one_by_one.samples(), together.samples()
    for name in ("index", "tick", "raw", "valid"):
        assert all_at_once[name] == alone[name]
    np.testing.assert_array_equal(all_at_once["value"], alone["value"])
    true = [tick / 1e9 - 1 + (scene.base / 1e9 + 1.8e9) for scene, tick in ((together, t) for t in all_at_once["tick"])]  # type: ignore[operator]
    assert all_at_once["time"] == pytest.approx(true, abs=2e-5)


@pytest.mark.parametrize("real", [MS - MS // 10, MS + MS // 10])
def test_a_stream_that_runs_free_has_the_period_that_its_ticks_say(real: int) -> None:
    """The asked one stood for it: the last sample of each message had a time that was wrong, up to a period's tenth
    for each sample before it, and the clock was said to lie where samples were dated after they had come.
    """
    scene = Scene(StreamKind.FREE, real=real)
    for counter in range(50):
        scene.heard.queue_message(scene.message(counter), scene.base + (counter * 3 + 2) * real + 1000)
        scene.heard.finish()
    samples = scene.samples()
    true = [SECOND + 17 + k * real for k in range(150)]
    assert np.abs(np.array(samples["tick"][3:], dtype=np.int64) - true[3:]).max() <= 1  # type: ignore[index]
    assert scene.heard.receiver.counts.good == 50
    now = scene.base + 150 * real
    scene.clock.exchange(Exchange(now, now + 2000, SECOND + 150 * real + 500, SECOND + 150 * real + 1500, 1, 20))
    assert not scene.clock.lie


def test_a_stream_that_waited_for_its_trigger_was_not_silent_meanwhile() -> None:
    """A trigger that waited for a missing node had all others lost as soon as it went out."""
    scene = Scene()
    scene.heard.receiver.start = None
    scene.heard.last_good_at -= 15.0
    began = time.monotonic()
    scene.heard.begin(SECOND)
    assert scene.heard.last_good_at >= began


def test_a_stream_was_last_good_when_a_message_with_the_right_tag_came() -> None:
    scene = Scene()
    scene.heard.last_good_at = before = time.monotonic() - 15.0
    forged = scene.message(0)
    scene.heard.queue_message(forged[:-1] + bytes([forged[-1] ^ 1]), scene.arrival(0))
    scene.heard.finish()
    assert scene.heard.last_good_at == before
    began = time.monotonic()
    scene.heard.queue_message(scene.message(1), scene.arrival(1))
    scene.heard.finish()
    assert scene.heard.last_good_at >= began


def test_what_waited_for_12_ms_is_handed_on_and_not_before() -> None:
    scene = Scene()
    before = time.monotonic()
    scene.heard.queue_message(scene.message(0), scene.arrival(0))
    after = time.monotonic()
    scene.heard.flush(before + GATHER * 0.99)
    assert not scene.blocks
    scene.heard.queue_message(scene.message(1), scene.arrival(1))
    scene.heard.flush(after + GATHER)
    (block,) = scene.blocks
    assert (block.index, len(block.time)) == (0, 6)


def test_a_message_that_no_other_will_join_is_handed_on_at_once() -> None:
    """At 100 Hz the next message of two instants comes in 20 ms: to wait for it would only be late."""
    scene = Scene(period=10 * MS)
    assert not scene.heard.due
    scene.heard.queue_message(scene.message(0), scene.arrival(0))
    assert scene.heard.due
    quick = Scene()
    quick.heard.queue_message(quick.message(0), quick.arrival(0))
    assert not quick.heard.due


def test_a_period_of_the_block_is_one_of_the_nodes_clock_mapped() -> None:
    """What the clock's map says of each tick, to the microsecond that the numbers of the wall clock hold."""
    scene = Scene()
    for counter in range(400):
        scene.heard.queue_message(scene.message(counter), scene.arrival(counter))
        if counter % 7 == 6:
            scene.heard.finish()
    for block in scene.blocks:
        assert block.time == pytest.approx(WALL.unix(scene.clock.host(block.tick)), abs=1e-6)


class SilentBus:
    """A bus, for the test, on which nothing comes but the frames that it hands over."""

    place, lost = "can:x", 0

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self._streams = CanStreams()

    def open_stream(self, node: int, stream: int, length: int) -> StreamAssembly:
        return self._streams.open(node, stream, length, fd=False)

    def close_stream(self, node: int, stream: int) -> None:
        self._streams.close(node, stream)

    @contextmanager
    def listen(self) -> Iterator[CanDataListener]:
        yield CanDataListener(cast(Listener, self), self._streams.opened)

    def get_all(self, seconds: float) -> list[Frame]:
        time.sleep(seconds)
        frames, self.frames = self.frames, []
        return frames


def test_what_comes_before_its_stream_is_registered_is_no_loss() -> None:
    """On a busy machine the first message comes before the reply to Subscribe is looked at."""
    scene, port = Scene(ago=-60, fd=False), SilentBus()
    with closing(HearingThread(cast(MeasuringLink, port))) as hearing:
        frames = frames_of(scene, 3)
        old = replace(frames[0], at=time.monotonic() - 1.0)  # of a stream of the session before
        half = len(frames) // 2
        scene.heard.pieces = hearing.expect(0x21, 0, scene.plan.length)
        port.frames = [old, *frames[:half]]  # a whole message, and the beginning of the next
        until(lambda: hearing._early[0x21, 0].messages)
        hearing.register(0x21, 0, scene.heard)
        port.frames = frames[half:]
        until(lambda: scene.heard.receiver.counts.good == 3)
    counts = scene.heard.receiver.counts
    assert (counts.good, counts.lost, counts.bad, scene.heard.pieces.wrong) == (3, 0, 0, 0)


def test_what_came_before_its_stream_was_opened_is_of_a_run_before() -> None:
    scene, port = Scene(ago=-60, fd=False), SilentBus()
    pieces = port.open_stream(0x21, 0, scene.plan.length)
    frames = frames_of(scene, 2)
    half = len(frames) // 2
    before = [replace(frame, at=time.monotonic() - 5.0) for frame in frames[:half]]
    with port.listen() as listener:
        port.frames = before
        assert listener.get_all(0.0) == []
        port.frames = [replace(frame, at=time.monotonic()) for frame in frames[half:]]
        assert [message.octets for message in listener.get_all(0.0)] == [scene.message(1)]
    assert pieces.wrong == 0


class Meanwhile(dict[tuple[int, int], Any]):
    """A table in which something happens beside each search."""

    def __init__(self, table: dict[tuple[int, int], Any], happens: Callable[[], None]) -> None:
        super().__init__(table)
        self._happens = happens

    def get(self, key: tuple[int, int], default: Any = None) -> Any:
        found = super().get(key, default)
        self._happens()
        return found


@pytest.mark.parametrize("table", ["_streams", "_early"])
def test_what_comes_while_its_stream_is_registered_is_no_loss(table: str) -> None:
    """It was looked for among the streams before that was one, and among those to come when it was none any more."""
    scene, port = Scene(ago=-60, fd=False), SilentBus()
    with closing(HearingThread(cast(MeasuringLink, port))) as hearing:
        scene.heard.pieces = hearing.expect(0x21, 0, scene.plan.length)

        def register() -> None:
            if (0x21, 0) in hearing._early:
                setattr(hearing, table, dict(getattr(hearing, table)))
                hearing.register(0x21, 0, scene.heard)

        setattr(hearing, table, Meanwhile(getattr(hearing, table), register))
        port.frames = frames_of(scene, 2)
        until(lambda: scene.heard.receiver.last == 1)
    assert (scene.heard.receiver.counts.good, scene.heard.receiver.counts.lost) == (2, 0)


def frames_of(scene: Scene, messages: int) -> list[Frame]:
    return [
        Frame(DataAddress(0xF1, 0, piece.segment, 0x21).identifier, piece.data, at=scene.arrival(counter) / 1e9)
        for counter in range(messages)
        for piece in cut(scene.message(counter), fd=False)
    ]


class Held(SilentBus):
    """A bus whose hearing thread has no processor until ``free``."""

    def __init__(self) -> None:
        super().__init__()
        self.free = threading.Event()

    def get_all(self, seconds: float) -> list[Frame]:
        self.free.wait()
        return super().get_all(seconds)


def test_what_came_before_the_end_is_no_loss_however_late_it_is_looked_at() -> None:
    """A measurement of 100 Hz lost its last three messages on a busy machine: they waited to be looked at."""
    scene, port = Scene(ago=-60, fd=False), Held()
    with closing(HearingThread(cast(MeasuringLink, port))) as hearing:
        scene.heard.pieces = hearing.expect(0x21, 0, scene.plan.length)
        hearing.register(0x21, 0, scene.heard)
        port.frames = frames_of(scene, 3)
        late = threading.Timer(2 * HEARD_OUT, port.free.set)
        late.start()
        hearing.hear_out(scene.heard, 3)
        scene.heard.receiver.finish(3, 3)
        late.join()
    counts = scene.heard.receiver.counts
    assert (counts.good, counts.lost, counts.late) == (3, 0, 0)


def test_a_message_that_never_came_is_waited_for_no_longer_than_it_may_take() -> None:
    scene, port = Scene(ago=-60, fd=False), SilentBus()
    with closing(HearingThread(cast(MeasuringLink, port))) as hearing:
        hearing.register(0x21, 0, scene.heard)
        best_of(3, 2 * HEARD_OUT, lambda: timed(lambda: hearing.hear_out(scene.heard, 1)))
    best_of(3, 2 * HEARD_OUT, lambda: timed(lambda: hearing.hear_out(scene.heard, 1)))
    scene.heard.receiver.finish(1, 1)
    assert scene.heard.receiver.counts.lost == 1


def timed(act: Callable[[], object]) -> float:
    began = time.monotonic()
    act()
    return time.monotonic() - began


class Beside(deque[tuple[bytes, int]]):
    """Messages that another thread would take, too, as soon as one of them is taken."""

    def __init__(self, other: Callable[[], None]) -> None:
        super().__init__()
        self.other = threading.Thread(target=other)

    def popleft(self) -> tuple[bytes, int]:
        taken = super().popleft()
        if self.other.ident is None:
            self.other.start()
            self.other.join(0.2)  # it waits for its turn, or takes what is left
        return taken


def test_two_threads_that_take_what_came_take_it_in_order() -> None:
    """Who ends a stream takes what is left, and the hearing thread may be about to: it found nothing, and ended."""
    scene = Scene()
    scene.heard._came = beside = Beside(scene.heard.finish)
    for counter in range(4):
        scene.heard.queue_message(scene.message(counter), scene.arrival(counter))
    scene.heard.finish()
    beside.other.join()
    counts = scene.heard.receiver.counts
    assert (counts.good, counts.lost, counts.late) == (4, 0, 0)


def test_a_message_of_before_its_stream_was_asked_for_is_not_kept_for_it() -> None:
    """It is one of the session before, which waited in the queue of the link."""
    scene, port = Scene(ago=-60, fd=False), SilentBus()
    with closing(HearingThread(cast(MeasuringLink, port))) as hearing:
        hearing.expect(0x21, 0, scene.plan.length)
        since = hearing._early[0x21, 0].since
        for at in (since - 1, since):
            hearing._dispatch(DataMessage(0x21, 0, scene.message(0), at))
        assert [message.at for message in hearing._early[0x21, 0].messages] == [since]


def test_a_stream_that_is_forgotten_is_taken_no_more_by_its_link() -> None:
    scene, port = Scene(ago=-60, fd=False), SilentBus()
    with closing(HearingThread(cast(MeasuringLink, port))) as hearing:
        scene.heard.pieces = hearing.expect(0x21, 0, scene.plan.length)
        hearing.register(0x21, 0, scene.heard)
        assert hearing.forget(0x21, 0) is scene.heard
        assert not port._streams.opened


@pytest.mark.parametrize(("period", "quick"), [(MS, True), (16 * MS, True), (17 * MS, False), (100 * MS, False)])
def test_all_values_are_calibrated_beforehand_only_for_a_stream_of_many_messages(
    period: int, quick: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two milliseconds and half a megabyte for each of two hundred nodes, before its first value, for one a second."""
    made: list[int] = []
    scene = Scene(period=period)
    monkeypatch.setattr(ManyChannels, "calibrate_all", lambda _many: made.append(len(scene.blocks)))
    for counter in range(BLOCKS + 5):
        scene.heard.queue_message(scene.message(counter), scene.arrival(counter))
        scene.heard.finish()
    assert made == ([BLOCKS - 1] if quick else [])


def test_of_a_batch_the_message_that_came_soonest_after_its_samples_is_told_to_the_clock() -> None:
    """What waited on the link or in this process says less of the node's clock; of a batch with drops the last does."""
    told: list[tuple[int, int]] = []
    clock: Any = SimpleNamespace(arrival=lambda tick, at: told.append((tick, at)))
    heard: Any = SimpleNamespace(clock=clock, _last_instant=30)
    came = [(b"", 1_000), (b"", 1_090), (b"", 1_210)]
    messages: Any = [SimpleNamespace(tick=tick) for tick in (500, 600, 700)]
    ReceivedStream._note_arrival(heard, came, messages)
    ReceivedStream._note_arrival(heard, came, messages[:2])
    assert told == [(630, 1_090), (630, 1_210)]


@pytest.mark.parametrize(
    ("kind", "n", "last"), [(StreamKind.PERIODIC, 5, 4 * MS), (StreamKind.FREE, 5, 0), (StreamKind.EVENT, 1, 0)]
)
def test_a_message_came_after_its_last_instant_and_of_a_stream_that_runs_free_the_first_alone_is_certain(
    kind: StreamKind, n: int, last: int
) -> None:
    told: list[tuple[int, int]] = []
    plan = StreamPlan.for_channels(0, ((1, 2),), n=n, period=MS, kind=kind)
    receiver: Any = SimpleNamespace(plan=plan)
    clock: Any = SimpleNamespace(arrival=lambda tick, at: told.append((tick, at)))
    other: Any = None
    heard = ReceivedStream(receiver, other, other, clock, other, other)
    message: Any = SimpleNamespace(tick=700)
    heard._note_arrival([(b"", 9_000)], [message])
    assert told == [(700 + last, 9_000)]


def test_a_period_of_less_than_half_or_more_than_twice_the_asked_one_is_a_gap_or_a_fault() -> None:
    """A sensor that stood still for a second would date what comes next as if it took a second for each sample."""
    interpreter = Scene(StreamKind.FREE).heard.interpreter
    real = []
    for index, tick in enumerate(
        (0, MS, 3 * MS, 3 * MS + MS // 2, 6 * MS, 6 * MS + MS // 4, 6 * MS + MS // 4 + 9 * MS // 10)
    ):
        message: Any = SimpleNamespace(index=index, tick=SECOND + tick)
        interpreter._spaced(message, 3)
        real.append(interpreter._real)
    assert real == [MS, MS, 2 * MS, MS / 2, MS / 2, MS / 2, 9 * MS / 10]


def test_a_message_that_the_interpreter_cannot_bear_ends_the_hearing_of_no_other_node() -> None:
    """The thread that hears a whole bus ended without a word: every node of it was silent from then on."""
    heard = list[str]()

    def poison(_octets: bytes, _at: int) -> None:
        raise OverflowError("int too large to convert to float")

    came = [
        [DataMessage(1, 0, b"", 0), DataMessage(2, 0, b"", 0)],
        [DataMessage(2, 0, b"", 0)],
    ]
    started = threading.Event()
    listener = SimpleNamespace(get_all=lambda _seconds: came.pop(0) if came and started.is_set() else [], lost=0)

    @contextmanager
    def listen() -> Iterator[Any]:
        yield listener

    port: Any = SimpleNamespace(place="can:x", listen=listen)
    streams = {
        (node, 0): SimpleNamespace(
            queue_message=poison if node == 1 else lambda _octets, _at: heard.append("two"),
            early=(), due=False, holds=False, flush=lambda _now: None,
        )
        for node in (1, 2)
    }  # fmt: skip
    thread = HearingThread(port)
    with closing(thread):
        thread._streams = cast(Any, streams)
        started.set()
        until(lambda: heard == ["two"])
        until(lambda: thread.failure is None)
