"""Whatever a station sends, the node answers and lives: no inner command makes it raise or move what it must not."""

from __future__ import annotations

from unittest.mock import patch

from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.protocol.messages.frames import Command, Function
from teds_provision.protocol.operation.datagram import DatagramSealer
from teds_provision.protocol.operation.stream_commands import CLOCK, StreamKind, SubscribeCommand, stop

from .bench import DIGEST, MS, SAFE_VALUE, Bench

KNOWN = [(1, 5), (3, 1), (3, 2), (4, 1), (4, 2), *((128, n) for n in range(Function.SAMPLE, Function.DRIVE + 1))]
commands = st.tuples(
    st.sampled_from([0, 1, 2, 3, 4, 5, 6, 7, 255, 256, 0xFFFF]),
    st.sampled_from(KNOWN),
    st.binary(max_size=40)
    | st.tuples(st.just(DIGEST), st.binary(max_size=4)).map(b"".join)
    | st.tuples(
        st.integers(0, 3), st.sampled_from([0, 1, 2, 128]), st.integers(0, 200), st.integers(0, 2000),
        st.sampled_from([MS, 10 * MS, 1]), st.sampled_from([0, (1 << 64) - 1]), st.binary(min_size=1, max_size=3),
    ).map(lambda p: bytes(p[:3]) + p[3].to_bytes(2, "big") + p[4].to_bytes(8, "big") + p[5].to_bytes(8, "big") + p[6]),
)  # fmt: skip


@settings(max_examples=150, deadline=None)
@given(st.lists(st.tuples(commands, st.integers(0, 50 * MS)), min_size=1, max_size=25), st.binary(max_size=20))
def test_no_inner_command_makes_the_node_raise(commands: list[tuple[tuple, int]], junk: bytes) -> None:
    bench = Bench().open()
    for (channel, (group, function), payload), pause in commands:
        reply = bench.send(Command(0 if group == 128 else channel, group, function, payload))
        assert reply.ok or 1 <= (reply.reason or 0) <= 23
        bench.later(pause)
        bench.tim.drive("can:f1", junk)
        bench.tim.trigger("can:f1", junk, bench.hardware.tick)
    assert bench.send(CLOCK).ok, "it lives"
    bench.tim.link_lost("can:f1")
    assert bench.hardware.points[4] == bench.hardware.points[6] == SAFE_VALUE
    sent = len(bench.frames)
    bench.later(100 * MS)
    assert len(bench.frames) == sent


class Recording(DatagramSealer):
    """A sealer that notes each key and counter, of every sealer there is."""

    used: list[tuple[bytes, int]]

    def __init__(self, key: bytes) -> None:
        super().__init__(key)
        self._key = key

    def seal(self, counter: int, plain: bytes) -> bytes:
        self.used.append((self._key, counter))
        return super().seal(counter, plain)


subscriptions = st.builds(
    lambda stream, kind, n, period, start: SubscribeCommand(
        stream, kind, 1 if kind == StreamKind.EVENT else n, 0, period, start, (5,) if kind == StreamKind.EVENT else (1,)
    ),
    st.integers(0, 3),
    st.sampled_from(StreamKind),
    st.integers(1, 5),
    st.sampled_from([MS, 7 * MS]),
    st.sampled_from([0, (1 << 64) - 1]),
)
acts = st.one_of(
    subscriptions.map(lambda asked: asked.command()),
    st.integers(0, 3).map(stop),
    st.sampled_from(["idle", "open", "restart"]),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(acts, st.integers(0, 60 * MS)), min_size=3, max_size=20))
def test_no_key_and_nonce_come_twice_whatever_a_station_asks(commands: list[tuple[Command | str, int]]) -> None:
    Recording.used = []
    with patch("teds_provision.protocol.operation.streams.DatagramSealer", Recording):
        bench = Bench().open().operate(0)
        for act, pause in commands:
            if isinstance(act, Command):
                bench.send(act)
            elif act == "idle":
                bench.idle()
                bench.operate(0)
            else:
                if act == "restart":
                    bench.restart()
                bench.open().operate(0)
            bench.later(pause)
            bench.tim.event(5, bench.hardware.tick, b"\1")
    assert len(Recording.used) == len(set(Recording.used))
