"""MCAP recorder: one topic for each stream at full rate, one for each channel, the datasheet's facts, reports.

A message of a stream holds one instant of it (definition SAMPLES below, CDR, described in the file itself, so that
readers of ROS 2 messages decode it): calibrated values, NaN if not valid, and the raw values. Its log time is the
instant. Unless the sink was made without, each channel also has a topic of ``std_msgs/Float64``, which viewers plot
without a panel of their own. Chunks are 64 KiB and at most FLUSH old. The facts of channels are in the metadata of
their stream's topic, in a metadata record, and in a ``std_msgs/String`` on ``…/teds`` at the start of each file, for
users of ``ros2 bag``.
"""

from __future__ import annotations

import json
import struct
import time
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from teds_provision import __version__
from teds_provision.errors import TedsProvisionError
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport, nearest_float
from teds_provision.measure.sinks.base import Item
from teds_provision.measure.sinks.files import FLUSH, FileSink
from teds_provision.measure.sinks.json_events import facts_as_json, iso
from teds_provision.measure.sinks.mcap.recover import recover
from teds_provision.measure.sinks.mcap.writer import MESSAGE, MESSAGE_HEAD, McapWriter
from teds_provision.measure.sinks.names import Topics

CHUNK_OCTETS = 1 << 16
TYPE = "teds_provision_msgs/msg/Samples"
SAMPLES = """\
# One instant of one stream of a transducer node. Channels, units and calibration: metadata of this topic.
builtin_interfaces/Time stamp  # of the instant; clock_error bounds its error
uint64 index                   # sample number in the run of the stream
uint64 tick                    # nanoseconds of the node's clock
float64 clock_error            # seconds; NaN where no bound is known
bool test_pattern              # true: no measurement
float64[] value                # in the SI unit of each channel; NaN where not valid
int64[] raw                    # raw integers (uint64 in two's complement); empty where they are floats
float64[] raw_float            # raw floats; empty where they are integers
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
STRING = "string data\n"
FLOAT_TYPE, FLOAT = "std_msgs/msg/Float64", "float64 data\n"
"""One value of one channel in its SI unit, NaN if it is not valid; the log time is that of the sample."""
QOS = "offered_qos_profiles"
"""QoS that rosbag2 keeps of each topic, so that `ros2 bag play` offers the publisher's: YAML, as from Iron on."""
_NEVER = "{sec: 9223372036, nsec: 854775807}"
_OFFERED = (
    "- history: keep_last\n  depth: {depth}\n  reliability: reliable\n  durability: {durability}\n"
    "  deadline: {never}\n  lifespan: {never}\n  liveliness: automatic\n  liveliness_lease_duration: {never}\n"
    "  avoid_ros_namespace_conventions: false\n"
)
RELIABLE = _OFFERED.format(depth=100, durability="volatile", never=_NEVER)
LATCHED = _OFFERED.format(depth=1, durability="transient_local", never=_NEVER)
_HEAD = b"\x00\x01\x00\x00"  # the start of a CDR message
LITTLE_ENDIAN = int.from_bytes(_HEAD, "little")


class McapSink(FileSink):
    """Recorder of MCAP; see the module."""

    def __init__(self, path: Path, *, scalars: bool = True) -> None:
        super().__init__(path)
        self._scalars: dict[tuple[str, int], np.ndarray] | None = {} if scalars else None
        self._writer: McapWriter | None = None
        self._opened = 0.0
        self._schemas: dict[str, int] = {}
        self._streams: dict[tuple[str, int, tuple[int, ...], str], tuple[int, np.ndarray]] = {}
        self._strings: dict[str, int] = {}
        self._topics: Topics | None = None
        self._in_chunk = 0  # values in the open chunk

    @property
    def _out(self) -> McapWriter:
        assert self._writer is not None
        return self._writer

    @property
    def _names(self) -> Topics:
        assert self._topics is not None
        return self._topics

    def _begin(self) -> None:
        station = self.station
        self._topics = Topics(station)
        self._streams, self._strings = {}, {}
        self._writer = McapWriter(self._octets, profile="ros2", library=f"teds-provision {__version__}")
        self._schemas = {
            TYPE: self._writer.schema(TYPE, SAMPLES),
            "": self._writer.schema("std_msgs/msg/String", STRING),
        }
        if self._scalars is not None:
            self._schemas[FLOAT_TYPE], self._scalars = self._writer.schema(FLOAT_TYPE, FLOAT), {}
        self._writer.metadata(
            "measurement",
            {
                "station": station.name,
                "group": station.group,
                "started": iso(station.started),
                "clock": station.clock,
                "test_pattern": json.dumps(station.test_pattern),
                "part": str(len(self.files)),
            },
        )
        self._opened = time.monotonic()
        self._describe(tuple(self.facts.values()))

    def _octets(self, octets: bytes) -> None:
        values, self._in_chunk = self._in_chunk, 0
        self.part.add(octets, values)
        self.part.flush()
        self._count(octets=len(octets))

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, NodeReport):
            self._report(item)
        elif isinstance(item, tuple):
            self._describe(self._learn(item))
        self._look(time.monotonic())

    def _idle(self, now: float) -> None:
        self._look(now)
        super()._idle(now)

    def _look(self, now: float) -> None:
        if not self._out.chunk_octets:
            self._opened = now
        elif self._out.chunk_octets >= CHUNK_OCTETS or now - self._opened >= FLUSH:
            self._out.close_chunk()
            self._opened = now

    def _describe(self, facts: tuple[ChannelFacts, ...]) -> None:
        if not facts:
            return
        self._names.learn(facts)
        for channel_facts in facts:
            self._out.metadata("channel", _as_texts(facts_as_json(channel_facts)))
        uuids = dict.fromkeys(channel_facts.uuid for channel_facts in facts)
        for uuid in uuids:
            every = [facts_as_json(facts) for facts in self.facts.values() if facts.uuid == uuid]
            self._string(self._names.of_node(uuid, "teds"), json.dumps({"uuid": uuid, "channels": every}), time.time())
        # A stream's topic has facts in its metadata, so changed facts need a new topic record.
        self._streams = {key: value for key, value in self._streams.items() if key[0] not in uuids}
        if self._scalars is not None:
            self._scalars = {key: value for key, value in self._scalars.items() if key[0] not in uuids}

    def _string(self, topic: str, words: str, at: float) -> None:
        if topic not in self._strings:
            self._strings[topic] = self._out.channel(topic, self._schemas[""], {QOS: LATCHED})
        octets = words.encode() + b"\0"
        data = _HEAD + struct.pack("<I", len(octets)) + octets
        self._out.add_message(self._strings[topic], 0, int(at * 1e9), data)

    def _report(self, report: NodeReport) -> None:
        words = json.dumps(report_as_json(report))
        self._string(f"/{self._names.station}/reports", words, report.time or time.time())

    def _stream(self, block: Block) -> tuple[int, np.ndarray]:
        """Return the topic of a stream, and a message of it with all that is the same in each."""
        integral = is_integral(block)
        key = (block.uuid, block.stream, block.channels, "i" if integral else "f")
        if key not in self._streams:
            known = [self.facts.get((block.uuid, number)) for number in block.channels]
            labels = [
                facts_as_json(item) if item else {"number": number}
                for item, number in zip(known, block.channels, strict=True)
            ]
            topic = self._names.of_node(block.uuid, f"stream_{block.stream}")
            metadata = {QOS: RELIABLE, "uuid": block.uuid, "channels": json.dumps(labels)}
            number = self._out.channel(topic, self._schemas[TYPE], metadata)
            self._streams[key] = number, plain_samples(number, len(block.channels), integral)
        return self._streams[key]

    def _block(self, block: Block) -> None:
        channel, plain = self._stream(block)
        rows, times = samples(block, plain), nanoseconds(block.time).tolist()
        self._out.add_messages(channel, rows.tobytes(), times)
        if self._scalars is not None and not block.test_pattern:  # a Float64 cannot be marked as a test pattern
            for column, number in enumerate(block.channels):
                self._scalar(block, column, number, times)
        self._in_chunk += block.value.size
        self._count(written=block.value.size, messages=len(times))

    def _scalar(self, block: Block, column: int, number: int, times: list[int]) -> None:
        """Write one channel of a block as messages of one value."""
        assert self._scalars is not None
        key = (block.uuid, number)
        if key not in self._scalars:
            facts = self.facts.get(key)
            unit = facts.unit if facts is not None else ""
            metadata = {QOS: RELIABLE, "uuid": block.uuid, "channel": str(number), "unit": unit}
            topic = self._out.channel(self._names.channel(block.uuid, number), self._schemas[FLOAT_TYPE], metadata)
            self._scalars[key] = _plain_float(topic)
        rows = self._scalars[key].repeat(len(times))
        rows["sequence"] = np.arange(block.index, block.index + len(times)) & 0xFFFFFFFF
        rows["times"] = nanoseconds(block.time)[:, None]
        rows["data"] = block.value[:, column]
        self._out.add_messages(int(rows["channel"][0]), rows.tobytes(), times)

    def _note(self, at: float, text: str) -> None:
        self._out.metadata("note", {"time": iso(at), "note": text})

    def _close_part(self) -> None:
        # After a failure the summary would be wrong too; `measure recover` repairs the file later.
        if self._writer is not None and self._part is not None and self.stats.state != "failed":
            writer, self._writer = self._writer, None
            writer.finish()
        super()._close_part()

    def _abandon(self) -> int:
        waiting, self._in_chunk, self._writer = self._in_chunk, 0, None
        return waiting + super()._abandon()

    def _mend(self, path: Path) -> None:
        with suppress(TedsProvisionError):  # what cannot be repaired is kept for `measure recover`
            recover(path)


def report_as_json(report: NodeReport) -> dict[str, Any]:
    """Return the report of a node as it is on ``reports``."""
    names = ("uuid", "state", "why", "samples", "lost", "late", "bad", "invalid", "clock_error")
    why = [asdict(invalid) for invalid in report.invalid_why]
    return {**{name: getattr(report, name) for name in names}, "invalid_why": why}


def nanoseconds(times: np.ndarray) -> np.ndarray:
    """Return unix seconds as whole nanoseconds."""
    return np.rint(times * 1e9).astype(np.uint64)


def samples(block: Block, plain: np.ndarray) -> np.ndarray:
    """Return a message record of SAMPLES for each instant of a block; ``plain`` comes from :func:`plain_samples`."""
    raw = block.raw
    if raw.dtype.kind == "O":
        # This message has no octet strings: NaN for them, and for numbers the nearest float.
        raw = np.array([[nearest_float(cell) for cell in row] for row in raw.tolist()], dtype=np.float64)
    times = nanoseconds(block.time)
    rows = plain.repeat(len(times))
    index = np.arange(block.index, block.index + len(times))
    rows["sequence"] = index & 0xFFFFFFFF
    rows["times"] = times[:, None]
    rows["sec"], rows["nanosec"] = np.divmod(times, 10**9)
    rows["index"] = index
    rows["tick"] = block.tick
    if block.clock_error is not None:
        rows["clock_error"] = block.clock_error
    if block.test_pattern:
        rows["test"] = True
    rows["value"] = block.value
    rows["raw"] = raw.view(np.int64) if raw.dtype == np.uint64 else raw
    return rows


def is_integral(block: Block) -> bool:
    """Return True if the raw values of a block go into ``raw`` of SAMPLES, rather than ``raw_float``."""
    return block.raw.dtype.kind in "uib"


def _plain_float(channel: int) -> np.ndarray:
    """Return an array of one message record of Float64 without its number."""
    row = np.zeros(1, dtype=_FLOAT_LAYOUT)
    row["code"], row["length"], row["channel"] = MESSAGE, row.dtype.itemsize - 9, channel
    row["cdr"] = LITTLE_ENDIAN
    return row


def _as_texts(facts: dict[str, Any]) -> dict[str, str]:
    """Return metadata of MCAP as texts: other values become JSON."""
    return {name: value if isinstance(value, str) else json.dumps(value) for name, value in facts.items()}


def plain_samples(channel: int, channels: int, integral: bool) -> np.ndarray:
    """Return an array of one message record without its numbers; those of a block are as many copies of it."""
    row = np.zeros(1, dtype=layout(channels, integral))
    row["code"], row["length"], row["channel"] = MESSAGE, row.dtype.itemsize - 9, channel
    row["cdr"] = LITTLE_ENDIAN
    row["clock_error"] = np.nan
    row["values"] = row["raws" if integral else "floats"] = channels
    return row


_FLOAT_LAYOUT = np.dtype(
    [
        ("code", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("times", "<u8", (2,)),  # logged, published
        ("cdr", "<u4"),
        ("data", "<f8"),
    ]
)


def layout(channels: int, integral: bool) -> np.dtype[Any]:
    """Return a message record of SAMPLES as a packed structure.

    CDR aligns to 8 octets, counted behind its first four.
    """
    head: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [
        ("code", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("times", "<u8", (2,)),  # logged, published
        ("cdr", "<u4"),
        ("sec", "<i4"),
        ("nanosec", "<u4"),
        ("index", "<u8"),
        ("tick", "<u8"),
        ("clock_error", "<f8"),
        ("test", "u1"),
        ("pad", "V3"),
        ("values", "<u4"),
        ("value", "<f8", (channels,)),
    ]
    if integral:
        tail: list[tuple[str, str] | tuple[str, str, tuple[int]]] = [
            ("raws", "<u4"), ("pad2", "V4"), ("raw", "<i8", (channels,)), ("floats", "<u4"),
        ]  # fmt: skip
    else:
        tail = [("raws", "<u4"), ("floats", "<u4"), ("raw", "<f8", (channels,))]
    found = np.dtype(head + tail)
    assert MESSAGE_HEAD.size == found.fields["cdr"][1] if found.fields else True
    return found
