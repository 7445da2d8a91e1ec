"""Reads MCAP as ``sinks/mcap/recording.py`` writes it, from the first octet to the last whole record.

An unfinished file is read to its torn end. Damage inside is refused: ``measure recover`` reports the damage, and writes
everything else into another file.
"""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any, BinaryIO, Final

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.errors import BadDataError
from teds_provision.files import open_to_read
from teds_provision.measure.blocks import Block, ChannelFacts, Note
from teds_provision.measure.recordings.columns import BlockJoiner, raw_kind
from teds_provision.measure.recordings.json_lines import report_of
from teds_provision.measure.recordings.source import (
    MOST,
    TEXT_FACTS,
    Entry,
    Recording,
    facts_of,
    station_of,
    unix_of,
)
from teds_provision.measure.sinks.mcap.recording import LITTLE_ENDIAN, TYPE, layout
from teds_provision.measure.sinks.mcap.recover import unpacked
from teds_provision.measure.sinks.mcap.writer import (
    CHANNEL,
    CHUNK,
    DATA_END,
    HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    METADATA,
    SCHEMA,
)

_STREAM: Final = re.compile(r"/stream_(\d{1,3})$")
_SMALLEST: Final = {kind: layout(0, kind).itemsize for kind in (True, False)}
_STRING: Final = "std_msgs/msg/String"


@dataclass(frozen=True)
class _Topic:
    """A topic of the file; ``channels`` empty if it holds no samples."""

    topic: str
    schema: str
    uuid: str = ""
    stream: int = 0
    channels: tuple[int, ...] = ()
    facts: tuple[ChannelFacts, ...] = ()


class McapRecording(Recording):
    """MCAP; see the module."""

    form = "MCAP"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        for code, content in self._records(chunks=False):
            if code == METADATA:
                name, words = self._metadata(content)
                if name == "measurement":
                    self.station = station_of(words)
                elif name == "channel":
                    self.know(facts_of(_values(words), f"{self.path}: the metadata"))

    def _bad(self, why: str) -> BadDataError:
        return BadDataError(
            f"{self.path}: {why}.",
            hint=f"To recover what is intact: teds-provision measure recover {quote(str(self.path))}",
        )

    def _records(self, *, chunks: bool = True) -> Iterator[tuple[int, bytes]]:
        """Yield records up to the end of the data, those in chunks too; ``chunks`` False skips them."""
        self.complete, self.torn = False, 0
        with open_to_read(self.path) as file:
            if file.read(len(MAGIC)) != MAGIC:
                raise self._bad("it is not an MCAP file")
            at = len(MAGIC)
            while head := file.read(HEAD.size):
                code, length = HEAD.unpack(head) if len(head) == HEAD.size else (0, 0)
                if code == DATA_END:
                    self.complete = _ends(file)
                    return
                content = self._content(file, code, length, chunks=chunks) if code else None
                if content is None:
                    self.torn = file.seek(0, 2) - at
                    if _ends(file):
                        raise self._bad(f"the record at octet {at} is damaged")
                    return
                at += HEAD.size + length
                if code == CHUNK and chunks:
                    yield from self._inside(content, at - length)
                elif code != CHUNK:
                    yield code, content

    def _content(self, file: BinaryIO, code: int, length: int, *, chunks: bool) -> bytes | None:
        """Return the content of a record; None if the file ends before, or the length is impossible."""
        if length > MOST.chunk:
            return None
        if code == CHUNK and not chunks:
            here = file.tell()
            return b"" if file.seek(0, 2) >= file.seek(here + length) else None
        content = file.read(length)
        return content if len(content) == length else None

    def _inside(self, content: bytes, at: int) -> Iterator[tuple[int, bytes]]:
        """Yield the records of a chunk."""
        found = unpacked(content, self.path, MOST.chunk)
        if found is None or not found[1]:
            raise self._bad(f"the chunk at octet {at - HEAD.size} is damaged")
        body, place = found[0], 0
        while place + HEAD.size <= len(body):
            code, length = HEAD.unpack_from(body, place)
            end = place + HEAD.size + length
            if end > len(body):
                break
            yield code, body[place + HEAD.size : end]
            place = end

    def _metadata(self, content: bytes) -> tuple[str, dict[str, str]]:
        try:
            name, at = _text(content, 0)
            return name, _map(content, at)
        except (ValueError, struct.error):
            raise self._bad("a metadata record is damaged") from None

    def _stored_entries(self) -> Iterator[Entry]:
        """See the class above."""
        schemas: dict[int, str] = {}
        topics: dict[int, _Topic] = {}
        waiting: dict[tuple[int, int], list[bytes]] = {}  # messages by topic and length
        joined, count = BlockJoiner(), 0
        for code, content in self._records():
            if code == MESSAGE and len(content) >= MESSAGE_HEAD.size - HEAD.size:
                number = content[0] | content[1] << 8
                topic = topics.get(number)
                if topic is not None and topic.channels:
                    waiting.setdefault((number, len(content)), []).append(content)
                    count += 1
                    if count >= 1024:
                        yield from self._blocks(waiting, topics, joined)
                        waiting, count = {}, 0
                elif topic is not None and topic.schema == _STRING:
                    entry = _reported(topic, content) if topic.topic.endswith("/reports") else None
                    if entry is not None:
                        yield from self._blocks(waiting, topics, joined)
                        waiting, count = {}, 0
                        yield from joined.flush()
                        yield entry
                continue
            if code in (SCHEMA, CHANNEL, METADATA):
                yield from self._blocks(waiting, topics, joined)
                waiting, count = {}, 0
                yield from joined.flush()
            if code == METADATA:
                name, words = self._metadata(content)
                if name == "note":
                    yield Note(unix_of(words.get("time")), words.get("note", "")[: MOST.text])
            elif code == SCHEMA:
                number, name = self._schema(content)
                schemas[number] = name
            elif code == CHANNEL:
                number, topic = self._topic(content, schemas)
                if len(topics) >= MOST.channels:
                    raise self._bad(f"it has more than {MOST.channels} topics")
                topics[number] = topic
                if topic.facts:
                    yield topic.facts
        yield from self._blocks(waiting, topics, joined)
        yield from joined.flush()

    def _schema(self, content: bytes) -> tuple[int, str]:
        try:
            return int.from_bytes(content[:2], "little"), _text(content, 2)[0]
        except (ValueError, struct.error):
            raise self._bad("a schema record is damaged") from None

    def _topic(self, content: bytes, schemas: dict[int, str]) -> tuple[int, _Topic]:
        try:
            number, schema = struct.unpack_from("<HH", content)
            name, at = _text(content, 4)
            _, at = _text(content, at)
            words = _map(content, at)
        except (ValueError, struct.error):
            raise self._bad("a channel record is damaged") from None
        kind = schemas.get(schema, "")
        if kind != TYPE or "channels" not in words:
            return number, _Topic(name, kind)
        try:
            listed = json.loads(words["channels"])
        except (ValueError, RecursionError):
            listed = None
        if not isinstance(listed, list) or len(listed) > MOST.channels:
            raise self._bad(f"the metadata of {name} do not list its channels")
        uuid = words.get("uuid", "")
        where = f"{self.path}: the metadata of {name}"
        known = tuple(facts_of({"uuid": uuid, **item} if isinstance(item, dict) else item, where) for item in listed)
        found = _STREAM.search(name)
        stream = int(found[1]) if found else 0
        facts = tuple(facts for facts, words in zip(known, listed, strict=True) if "uuid" in words)
        return number, _Topic(name, kind, uuid, stream, tuple(facts.number for facts in known), facts)

    def _blocks(
        self, waiting: dict[tuple[int, int], list[bytes]], topics: dict[int, _Topic], joined: BlockJoiner
    ) -> Iterator[Entry]:
        for (number, length), contents in waiting.items():
            topic = topics[number]
            for block in self._decoded(topic, contents, length):
                yield from joined.add_block(block)

    def _decoded(self, topic: _Topic, contents: list[bytes], length: int) -> Iterator[Block]:
        """Yield the blocks of messages of one length, so of one layout; a jump in sample numbers begins a new one."""
        size, columns = length + HEAD.size, len(topic.channels)
        integral = next((kind for kind in (True, False) if _SMALLEST[kind] + 16 * columns == size), None)
        if integral is None:
            raise self._bad(f"a message of {topic.topic} does not have {columns} channels")
        form = layout(columns, integral)
        rows = np.frombuffer(b"".join([bytes(HEAD.size) + content for content in contents]), dtype=form)
        counts = rows["raws" if integral else "floats"]
        if (rows["cdr"] != LITTLE_ENDIAN).any() or (rows["values"] != columns).any() or (counts != columns).any():
            raise self._bad(f"a message of {topic.topic} is damaged")
        error, test = rows["clock_error"], rows["test"] != 0
        same = (error[1:] == error[:-1]) | (np.isnan(error[1:]) & np.isnan(error[:-1]))
        cut = (np.diff(rows["index"].astype(np.int64)) != 1) | ~same | np.diff(test)
        for part in np.split(np.arange(len(rows)), np.flatnonzero(cut) + 1):
            yield self._block(topic, rows[part[0] : part[-1] + 1], float(error[part[0]]), test=bool(test[part[0]]))

    def _block(self, topic: _Topic, rows: NDArray[Any], error: float, *, test: bool) -> Block:
        raw = np.ascontiguousarray(rows["raw"])
        if raw.dtype.kind == "i" and any(raw_kind(facts.sample_form) == "uint64" for facts in topic.facts):
            raw = raw.view(np.uint64)
        value = np.ascontiguousarray(rows["value"])
        time = rows["times"][:, 0].astype(np.float64) / 1e9
        return Block(
            topic.uuid, topic.stream, topic.channels, int(rows["index"][0]), time, rows["tick"].astype(np.uint64), raw,
            value, np.isfinite(value), 0.0, None if np.isnan(error) else error, test,
        )  # fmt: skip


def _ends(file: BinaryIO) -> bool:
    """Return True if the file has the mark of an end; it is longer than that mark."""
    file.seek(-len(MAGIC), 2)
    return file.read() == MAGIC


def _text(content: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise ValueError("beyond the record")
    return content[at + 4 : end].decode(), end


def _map(content: bytes, at: int) -> dict[str, str]:
    (length,) = struct.unpack_from("<I", content, at)
    end, found = at + 4 + length, dict[str, str]()
    at += 4
    while at < end:
        key, at = _text(content, at)
        found[key], at = _text(content, at)
    return found


def _values(words: dict[str, str]) -> dict[str, Any]:
    """Return facts as they were before they became texts; those that are texts stay so."""
    found: dict[str, Any] = {}
    for name, text in words.items():
        try:
            value = json.loads(text)
        except (ValueError, RecursionError):
            value = text
        found[name] = value if not isinstance(value, str) and name not in TEXT_FACTS and name != "kind" else text
    return found


def _reported(topic: _Topic, content: bytes) -> Entry | None:
    """Return a report, as the recorder puts it on its topic: JSON in a string."""
    data = content[MESSAGE_HEAD.size - HEAD.size :]
    try:
        words = json.loads(data[8:].rstrip(b"\0"))
    except (ValueError, RecursionError):
        return None
    if not isinstance(words, dict):
        return None
    time = int.from_bytes(content[6:14], "little") / 1e9
    return report_of({"time": time, **words})
