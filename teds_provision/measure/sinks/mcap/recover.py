"""Makes an MCAP recording whole that a kill or a power cut left without its end.

Whole records are kept as they stand; what follows the last of them is of no use, so it is cut off and the summary that
the writer would have written is appended.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from teds_provision.errors import BadData, NotFound
from teds_provision.measure.sinks.base import as_sink_failure
from teds_provision.measure.sinks.mcap.writer import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    HEAD,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    Summary,
    chunk_index,
    record,
    text,
)

LARGEST_RECORD = 1 << 28  # a length beyond it is damage


@dataclass(frozen=True)
class Recovered:
    """What an unfinished recording holds: messages, the last one's time (unix seconds), whether it was whole before."""

    messages: int
    until: float | None
    was_whole: bool
    cut: int  # octets at the end that were of no use


def recover(path: Path) -> Recovered:
    """Make an unfinished MCAP whole, in place; one that is whole stays as it is.

    Only the torn end is cut off. A cut in the middle of this leaves an unfinished file again, so it can be run again.
    Raises NotFound, BadData (no MCAP, damage inside the file), TedsProvisionError (disk).
    """
    try:
        with path.open("r+b") as file:
            return _recover(file, path)
    except FileNotFoundError:
        raise NotFound(f"There is no file {path}.", hint="Name the recording that was cut.") from None
    except IsADirectoryError:
        raise NotFound(f"{path} is a folder, not a file.", hint="Name one recording in it.") from None
    except OSError as error:
        raise as_sink_failure(error, str(path)) from error


def _recover(file: BinaryIO, path: Path) -> Recovered:
    if file.read(len(MAGIC)) != MAGIC:
        raise BadData(f"{path} is no MCAP file.", hint="A text or JSON-line recording needs no recovery.")
    size = os.fstat(file.fileno()).st_size
    whole_part = _WholePart()
    whole = False
    for code, offset, content in _records(file, size):
        if code == DATA_END:
            file.seek(-len(MAGIC), os.SEEK_END)
            whole = file.read(len(MAGIC)) == MAGIC
            break
        if not whole_part.take(code, offset, content):
            break
    whole_part.close_chunk()
    summary, end = whole_part.summary, whole_part.end
    messages = sum(summary.counts.values())
    until = summary.last / 1e9 if messages else None
    if whole:
        return Recovered(messages, until, True, 0)
    file.seek(end)
    file.truncate()
    file.write(summary.tail(end))
    file.flush()
    os.fsync(file.fileno())
    return Recovered(messages, until, False, size - end)


class _WholePart:
    """What of a file stands whole: ``summary`` of its records, ``end`` where the next one would begin."""

    def __init__(self) -> None:
        self.summary = Summary()
        self.end = len(MAGIC)
        self._pending: _Pending | None = None

    def take(self, code: int, offset: int, content: bytes) -> bool:
        """Take a whole record into the summary; False for one that is of no use, nor is what follows it."""
        if code == MESSAGE_INDEX:
            if self._pending is None:
                return False
            self._pending.index(content, offset, len(content) + HEAD.size)
        else:
            self.close_chunk()
            if code == CHUNK:
                self._pending = _whole_chunk(content, offset, self.summary)
                if self._pending is None:
                    return False
            elif code == METADATA:
                self._metadata(offset, content)
            else:
                _count(code, content, self.summary)
        self.end = offset + HEAD.size + len(content)
        return True

    def close_chunk(self) -> None:
        """No message index of the last chunk follows any more."""
        if self._pending is not None:
            self.summary.chunk_indexes.append(self._pending.record())
        self._pending = None

    def _metadata(self, offset: int, content: bytes) -> None:
        name = content[4 : 4 + int.from_bytes(content[:4], "little")]
        index = struct.pack("<QQ", offset, len(content) + HEAD.size) + text(name.decode(errors="replace"))
        self.summary.metadata_indexes.append(record(METADATA_INDEX, index))


def _records(file: BinaryIO, size: int) -> Iterator[tuple[int, int, bytes]]:
    """Whole records from the start: op code, offset, content; ends where one is torn."""
    at = len(MAGIC)
    while at + HEAD.size <= size:
        file.seek(at)
        code, length = HEAD.unpack(file.read(HEAD.size))
        if code == 0 or length > LARGEST_RECORD or at + HEAD.size + length > size:
            return
        yield code, at, file.read(length)
        at += HEAD.size + length


class _Pending:
    """A chunk whose message indexes are being read."""

    def __init__(self, first: int, last: int, offset: int, length: int, packed: int, unpacked: int) -> None:
        self._parts = (first, last, offset, length)
        self._sizes = (packed, unpacked)
        self._places = b""
        self._end = offset + length

    def index(self, content: bytes, offset: int, length: int) -> None:
        """A message index that stands behind the chunk."""
        self._places += content[:2] + struct.pack("<Q", offset)
        self._end = offset + length

    def record(self) -> bytes:
        """The index of the chunk."""
        return chunk_index(*self._parts, self._places, self._end, *self._sizes)


def _whole_chunk(content: bytes, offset: int, summary: Summary) -> _Pending | None:
    """A chunk whose checksum holds: its schemas, channels and messages counted; None where it is damaged."""
    import zstandard

    first, last, unpacked, checksum = CHUNK_HEAD.unpack_from(content)
    at = CHUNK_HEAD.size
    name_length = int.from_bytes(content[at : at + 4], "little")
    compression = content[at + 4 : at + 4 + name_length]
    packed = content[at + 4 + name_length + 8 :]
    if unpacked > LARGEST_RECORD:
        return None
    if compression == b"zstd":
        try:
            body = zstandard.ZstdDecompressor().decompress(packed, max_output_size=unpacked)
        except zstandard.ZstdError:
            return None
    elif compression == b"":
        body = packed
    else:
        raise BadData(f"A chunk is compressed with {compression!r}, which is not known here.")
    if checksum and zlib.crc32(body) != checksum:
        return None
    for code, one in _inside(body):
        _count(code, one, summary)
    return _Pending(first, last, offset, len(content) + HEAD.size, len(packed), unpacked)


def _count(code: int, content: bytes, summary: Summary) -> None:
    """Take a schema, a channel or a message into the summary, wherever it stands."""
    number = int.from_bytes(content[:2], "little")
    if code == SCHEMA:
        summary.schemas[number] = record(SCHEMA, content)
    elif code == CHANNEL:
        summary.channels[number] = record(CHANNEL, content)
    elif code == MESSAGE:
        time = int.from_bytes(content[6:14], "little")
        summary.saw(number, 1, time, time)


def _inside(body: bytes) -> Iterable[tuple[int, bytes]]:
    at = 0
    while at + HEAD.size <= len(body):
        code, length = HEAD.unpack_from(body, at)
        yield code, body[at + HEAD.size : at + HEAD.size + length]
        at += HEAD.size + length
