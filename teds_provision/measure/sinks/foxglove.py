"""Foxglove: a WebSocket server on this machine from which Foxglove, or any client of its protocol, plots live values.

The topics and schemas are those of our MCAP (``sinks/mcap/recording.py``): one of each stream, one of each channel
unless the sink was made without, ``…/teds`` with the facts, and ``reports``; the log time of a message is that of the
sample. The facts of channels are parameters too. Values reach a client in order. ``measure`` has a server for its one
measurement, ``ncap run`` one for all of them (:mod:`.foxglove_server`).
"""

from __future__ import annotations

import json
import time
from typing import TYPE_CHECKING, Final

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, ClockSet, GroupRows, NodeReport, StationFacts
from teds_provision.measure.exposure import Exposure
from teds_provision.measure.sinks.base import CommandTaker, Item, ThreadedSink
from teds_provision.measure.sinks.foxglove_server import USUAL, FoxgloveServer, MeasurementTopics
from teds_provision.measure.sinks.json_events import facts_as_json
from teds_provision.measure.sinks.mcap.recording import (
    FLOAT,
    FLOAT_TYPE,
    SAMPLES,
    STRING,
    TYPE,
    is_integral,
    nanoseconds,
    plain_samples,
    report_as_json,
    samples,
)
from teds_provision.measure.sinks.names import Topics

if TYPE_CHECKING:
    import foxglove

FOXGLOVE: Final = "foxglove"
ARRAYS: Final = "arrays:"
"""Prefix of the string of a sink without topics of single channels: this one and MCAP."""
_HEAD: Final = b"\x00\x01\x00\x00"


class FoxgloveSink(ThreadedSink):
    """Publishes one measurement on a server; without ``scalars`` it has no topics of single channels.

    ``own``: the server is for this measurement alone, and starts and stops with it.
    """

    def __init__(self, server: FoxgloveServer, *, own: bool, scalars: bool = True) -> None:
        super().__init__(FOXGLOVE)
        self.server = server
        self._own, self._with_scalars = own, scalars
        self._published: MeasurementTopics | None = None
        self._topics = Topics(StationFacts(""))
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._sheets: dict[str, str] = {}  # the topic of each node's datasheet
        self._streams: dict[tuple[str, int, tuple[int, ...], bool], tuple[foxglove.Channel, np.ndarray, int]] = {}

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        self._topics = Topics(station)
        if self._own:
            self.server.start(station.name)
        self._published = self.server.begin()
        # created before the first report, which clients would miss otherwise
        self._channel(self._reports, "std_msgs/msg/String", STRING, {})
        self._describe(facts)

    @property
    def _reports(self) -> str:
        return f"/{self._topics.station}/reports"

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, NodeReport):
            self._text(self._reports, json.dumps(report_as_json(item)), item.time or time.time())
        elif not isinstance(item, ClockSet | GroupRows):
            self._describe(item)

    def _describe(self, facts: tuple[ChannelFacts, ...]) -> None:
        if not facts:
            return
        self._facts.update((channel_facts.key, channel_facts) for channel_facts in facts)
        own = dict.fromkeys(channel_facts.uuid for channel_facts in facts)
        named = self._topics.learn(facts)
        published = self._published
        assert published is not None
        published.parameters = {
            self._topics.channel(*key): json.dumps(facts_as_json(known)) for key, known in self._facts.items()
        }
        before = {uuid: topic for uuid, topic in self._sheets.items() if uuid in named}
        renamed = [uuid for uuid, topic in before.items() if topic != self._topics.of_node(uuid, "teds")]
        for uuid in renamed:  # a late subscriber must not find the old datasheet there
            published.latest.pop(before[uuid], None)
        for uuid in (*own, *(uuid for uuid in renamed if uuid not in own)):
            every = [facts_as_json(known) for known in self._facts.values() if known.uuid == uuid]
            topic = self._sheets[uuid] = self._topics.of_node(uuid, "teds")
            published.latest[topic] = self._text(topic, json.dumps({"uuid": uuid, "channels": every}), time.time())
        outdated = own.keys() | set(renamed)
        self._streams = {key: value for key, value in self._streams.items() if key[0] not in outdated}

    def _channel(self, topic: str, kind: str, definition: str, metadata: dict[str, str]) -> foxglove.Channel:
        assert self._published is not None
        return self._published.channel(topic, kind, definition, metadata)

    def _text(self, topic: str, words: str, at: float) -> bytes:
        octets = words.encode() + b"\0"
        message = _HEAD + len(octets).to_bytes(4, "little") + octets
        channel = self._channel(topic, "std_msgs/msg/String", STRING, {})
        channel.log(message, log_time=int(at * 1e9))
        return message

    def _block(self, block: Block) -> None:
        key = (block.uuid, block.stream, block.channels, is_integral(block))
        if key not in self._streams:
            topic = self._topics.of_node(block.uuid, f"stream_{block.stream}")
            plain = plain_samples(0, len(block.channels), key[3])
            assert plain.dtype.fields is not None
            channel = self._channel(topic, TYPE, SAMPLES, {"uuid": block.uuid, "channels": json.dumps(block.channels)})
            self._streams[key] = channel, plain, plain.dtype.fields["cdr"][1]
        channel, plain, head = self._streams[key]
        octets, step = samples(block, plain).tobytes(), plain.dtype.itemsize
        times = nanoseconds(block.time).tolist()
        for place, at in enumerate(times):
            channel.log(octets[place * step + head : (place + 1) * step], log_time=at)
        messages = len(times)
        if self._with_scalars and not block.test_pattern:  # a Float64 cannot be marked as a test pattern
            messages += self._scalars(block, times)
        self._count(written=block.value.size, messages=messages)

    def _scalars(self, block: Block, times: list[int]) -> int:
        for column, number in enumerate(block.channels):
            facts = self._facts.get((block.uuid, number))
            metadata = {"uuid": block.uuid, "channel": str(number), "unit": facts.unit if facts is not None else ""}
            channel = self._channel(self._topics.channel(block.uuid, number), FLOAT_TYPE, FLOAT, metadata)
            values = np.ascontiguousarray(block.value[:, column], dtype="<f8").tobytes()
            for place, at in enumerate(times):
                channel.log(_HEAD + values[place * 8 : place * 8 + 8], log_time=at)
        return len(block.channels) * len(times)

    def _finish(self) -> None:
        if self._published is not None:
            self._published.end()
        if self._own:
            self.server.stop()


def foxglove_sink(
    spec: str, _commands: CommandTaker | None = None, *, scalars: bool = True, exposure: Exposure | None = None
) -> FoxgloveSink:
    """Return the sink of ``foxglove`` or ``foxglove:HOST:PORT``, with its server; raises UsageError."""
    address = spec.removeprefix(FOXGLOVE).removeprefix(":")
    return FoxgloveSink(FoxgloveServer(address or USUAL, exposure), own=True, scalars=scalars)
