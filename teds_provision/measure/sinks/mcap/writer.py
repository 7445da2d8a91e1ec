"""The MCAP container (version 0 of its specification), written by whole chunks.

A writer of our own because a chunk must close by the clock, and because a block of samples becomes octets at once
instead of message by message. The module recover makes a file whole that was cut.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from teds_provision.measure.sinks.mcap.zstandard_frames import compress_frame

MAGIC = b"\x89MCAP0\r\n"
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX = range(1, 9)
ATTACHMENT, STATISTICS, METADATA, METADATA_INDEX, SUMMARY_OFFSET, DATA_END = 0x09, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F
MESSAGE_HEAD = struct.Struct("<BQHIQQ")  # op code, length, channel, sequence, log time, publish time
HEAD = struct.Struct("<BQ")
CHUNK_HEAD = struct.Struct("<QQQI")


def record(code: int, content: bytes) -> bytes:
    """Return a record: op code, length, content."""
    return HEAD.pack(code, len(content)) + content


def text(value: str) -> bytes:
    """Return a string: u32 length, UTF-8."""
    octets = value.encode()
    return struct.pack("<I", len(octets)) + octets


def _map(pairs: Mapping[str, str]) -> bytes:
    content = b"".join(text(key) + text(value) for key, value in pairs.items())
    return struct.pack("<I", len(content)) + content


@dataclass
class McapSummary:
    """Summary of a whole file; kept while writing, gathered again when a file is made whole."""

    schemas: dict[int, bytes] = field(default_factory=dict)  # whole records
    channels: dict[int, bytes] = field(default_factory=dict)
    chunk_indexes: list[bytes] = field(default_factory=list)
    metadata_indexes: list[bytes] = field(default_factory=list)
    counts: dict[int, int] = field(default_factory=dict)
    first: int = 0
    last: int = 0

    def saw(self, channel: int, messages: int, first: int, last: int) -> None:
        """Count messages of a channel, with the earliest and latest of their log times."""
        self.first = first if not self.counts else min(self.first, first)
        self.last = max(self.last, last)
        self.counts[channel] = self.counts.get(channel, 0) + messages

    def tail(self, start: int) -> bytes:
        """Return DataEnd, summary, footer and magic for a file whose data section ends at octet ``start``."""
        data_end = record(DATA_END, struct.pack("<I", 0))
        start += len(data_end)
        counts = b"".join(struct.pack("<HQ", key, value) for key, value in sorted(self.counts.items()))
        statistics = struct.pack(
            "<QHIIIIQQ",
            sum(self.counts.values()),
            len(self.schemas),
            len(self.channels),
            0,
            len(self.metadata_indexes),
            len(self.chunk_indexes),
            self.first,
            self.last,
        )
        groups = (
            (SCHEMA, b"".join(self.schemas.values())),
            (CHANNEL, b"".join(self.channels.values())),
            (STATISTICS, record(STATISTICS, statistics + struct.pack("<I", len(counts)) + counts)),
            (CHUNK_INDEX, b"".join(self.chunk_indexes)),
            (METADATA_INDEX, b"".join(self.metadata_indexes)),
        )
        body, offsets = b"", b""
        for code, content in groups:
            if content:
                offsets += record(SUMMARY_OFFSET, struct.pack("<BQQ", code, start + len(body), len(content)))
                body += content
        offset_start = start + len(body)
        foot = HEAD.pack(FOOTER, 20) + struct.pack("<QQ", start, offset_start)
        checksum = zlib.crc32(foot, zlib.crc32(body + offsets))
        return data_end + body + offsets + foot + struct.pack("<I", checksum) + MAGIC


class McapWriter:
    """Writes through ``put(octets)``, one call for each chunk with its indexes; the caller owns the file.

    ``add_messages`` takes messages that are encoded already, whole records one behind the other, so that a block of
    samples can be made at once. A chunk closes by ``close_chunk``; the caller knows its size and age.
    """

    def __init__(self, put: Callable[[bytes], None], *, profile: str, library: str) -> None:
        self._put_octets = put
        self._offset = 0
        self.summary = McapSummary()
        self._chunk: list[bytes] = []
        self._chunk_offset = 0
        self._first = self._last = 0
        self._index: dict[int, list[bytes]] = {}
        self._put(MAGIC + record(HEADER, text(profile) + text(library)))

    @property
    def chunk_octets(self) -> int:
        """Octets that wait in the chunk, before compression."""
        return self._chunk_offset

    def _put(self, octets: bytes) -> None:
        self._offset += len(octets)
        self._put_octets(octets)

    def _into_chunk(self, octets: bytes) -> None:
        self._chunk.append(octets)
        self._chunk_offset += len(octets)

    def schema(self, name: str, definition: str) -> int:
        """Add a ROS 2 message definition; return its number."""
        number = len(self.summary.schemas) + 1
        octets = definition.encode()
        content = struct.pack("<H", number) + text(name) + text("ros2msg") + struct.pack("<I", len(octets)) + octets
        self.summary.schemas[number] = record(SCHEMA, content)
        self._into_chunk(self.summary.schemas[number])
        return number

    def channel(self, topic: str, schema: int, metadata: Mapping[str, str]) -> int:
        """Add a topic of CDR messages; return its number."""
        number = len(self.summary.channels) + 1
        content = struct.pack("<HH", number, schema) + text(topic) + text("cdr") + _map(metadata)
        self.summary.channels[number] = record(CHANNEL, content)
        self._into_chunk(self.summary.channels[number])
        return number

    def metadata(self, name: str, pairs: Mapping[str, str]) -> None:
        """Write texts about the recording; closes the chunk first."""
        self.close_chunk()
        octets = record(METADATA, text(name) + _map(pairs))
        index = struct.pack("<QQ", self._offset, len(octets)) + text(name)
        self.summary.metadata_indexes.append(record(METADATA_INDEX, index))
        self._put(octets)

    def add_messages(self, channel: int, records: bytes, times: list[int]) -> None:
        """Add message records of equal length of one channel, with their log times in ns."""
        if not times:
            return
        step = len(records) // len(times)
        at = self._chunk_offset
        entries = b"".join(struct.pack("<QQ", time, at + k * step) for k, time in enumerate(times))
        first, last = min(times), max(times)
        self._first = first if not self._index else min(self._first, first)
        self._last = last if not self._index else max(self._last, last)
        self._index.setdefault(channel, []).append(entries)
        self.summary.saw(channel, len(times), first, last)
        self._into_chunk(records)

    def add_message(self, channel: int, sequence: int, time: int, data: bytes) -> None:
        """Append one message to the present chunk."""
        head = MESSAGE_HEAD.pack(MESSAGE, 22 + len(data), channel, sequence & 0xFFFFFFFF, time, time)
        self.add_messages(channel, head + data, [time])

    def close_chunk(self) -> None:
        """Write the chunk and its indexes, if there is something in it."""
        if not self._chunk:
            return
        content = b"".join(self._chunk)
        packed = compress_frame(content)
        head = CHUNK_HEAD.pack(self._first, self._last, len(content), zlib.crc32(content))
        chunk = record(CHUNK, head + text("zstd") + struct.pack("<Q", len(packed)) + packed)
        indexes, places = [], b""
        at = self._offset + len(chunk)
        for number, entries in self._index.items():
            body = b"".join(entries)
            indexes.append(record(MESSAGE_INDEX, struct.pack("<HI", number, len(body)) + body))
            places += struct.pack("<HQ", number, at)
            at += len(indexes[-1])
        index = chunk_index(self._first, self._last, self._offset, len(chunk), places, at, len(packed), len(content))
        self.summary.chunk_indexes.append(index)
        self._chunk, self._chunk_offset, self._index = [], 0, {}
        self._first = self._last = 0
        self._put(chunk + b"".join(indexes))

    def finish(self) -> None:
        """Write the last chunk, the summary and the footer."""
        self.close_chunk()
        self._put(self.summary.tail(self._offset))


def chunk_index(
    first: int, last: int, offset: int, length: int, places: bytes, end: int, packed: int, unpacked: int
) -> bytes:
    """Return the record that locates a chunk: log times, offset and length, its message indexes, sizes."""
    content = struct.pack("<QQQQI", first, last, offset, length, len(places)) + places
    content += struct.pack("<Q", end - offset - length) + text("zstd") + struct.pack("<QQ", packed, unpacked)
    return record(CHUNK_INDEX, content)
