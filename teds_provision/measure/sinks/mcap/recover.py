"""Makes an MCAP recording whole: one without its end in place, one with damage inside as another file.

A kill or a power cut leaves a torn end. Every whole record stays as it is; what follows the last of them is cut off,
and the summary that the writer would have written is appended. Damage inside is another thing: the file is not touched,
and everything but the damaged pieces goes into a new one. Chunks are found again by their form wherever a record's
length is no longer true.
"""

from __future__ import annotations

import mmap
import os
import stat
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, NotFoundError, StoreLockedError
from teds_provision.files import SHARED, new_file, require_new
from teds_provision.measure.sinks.base import as_sink_failure
from teds_provision.measure.sinks.mcap.writer import (
    ATTACHMENT,
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    HEAD,
    HEADER,
    MAGIC,
    MESSAGE,
    MESSAGE_INDEX,
    METADATA,
    METADATA_INDEX,
    SCHEMA,
    McapSummary,
    chunk_index,
    record,
    text,
)
from teds_provision.measure.sinks.mcap.zstandard_frames import ZstdError, decompress_frame
from teds_provision.portable import CLOSING, NONBLOCK, lock

LARGEST_RECORD: Final = 1 << 28  # a longer length means damage
_PRIVATE: Final = 0x80  # op codes from here on are for private use
_FOOTER_OCTETS: Final = HEAD.size + 20
_ZSTD: Final = text("zstd")
_IN_A_CHUNK: Final = HEAD.size + CHUNK_HEAD.size  # offset of the compression's name


@dataclass(frozen=True)
class Damage:
    """A damaged piece: ``what`` it is, its position and length."""

    what: str
    offset: int
    octets: int


@dataclass(frozen=True)
class RecoveryResult:
    """Content of a recording: messages, the last one's time (unix seconds), whether it was whole before.

    ``cut`` octets at its end were useless. ``damaged`` pieces inside are left out of ``output``, the new file; that is
    None if the recording itself is whole now.
    """

    messages: int
    until: float | None
    was_whole: bool
    cut: int
    damaged: tuple[Damage, ...] = ()
    output: Path | None = None


def recover(path: Path, output: Path | None = None) -> RecoveryResult:
    """Make an MCAP whole: a torn end in place, or all but what is damaged inside as ``output`` (``FILE.recovered``).

    With ``output`` the file itself is never changed. Killed at any instant it can be run again. Raises NotFoundError,
    StoreLockedError (its recorder still writes), UsageError (``output`` exists), BadDataError (no MCAP), StoreError
    (disk).
    """
    if output is not None:
        require_new(output)
    try:
        with _map_alone(path) as (file, octets):
            scan = _Scan(octets, path)
            scan.walk()
            return _finished(scan, file, path, output)
    except FileNotFoundError:
        raise NotFoundError(f"There is no file {path}.", hint="Give the recording that was cut off.") from None
    except IsADirectoryError:
        raise NotFoundError(f"{path} is a folder, not a file.", hint="Give one recording in it.") from None
    except OSError as error:
        raise as_sink_failure(error, str(path)) from error


@contextmanager
def _map_alone(path: Path) -> Iterator[tuple[int, mmap.mmap]]:
    """Map a file that no recorder writes; none begins to while this is open."""
    file = os.open(path, os.O_RDONLY | CLOSING | NONBLOCK)
    try:
        status = os.fstat(file)
        if stat.S_ISDIR(status.st_mode):
            raise IsADirectoryError
        if not stat.S_ISREG(status.st_mode) or status.st_size < len(MAGIC):
            raise _no_mcap(path)
        try:
            lock(file)
        except BlockingIOError:
            raise StoreLockedError(
                f"{path} is being recorded right now.", hint="End that measurement, or wait until it is over."
            ) from None
        except OSError:  # a file system without locks
            pass
        with mmap.mmap(file, 0, access=mmap.ACCESS_READ) as octets:
            yield file, octets
    finally:
        os.close(file)


def _no_mcap(path: Path) -> BadDataError:
    return BadDataError(f"{path} is not an MCAP file.", hint="Text and JSON-line recordings need no recovery.")


def _finished(scan: _Scan, file: int, path: Path, output: Path | None) -> RecoveryResult:
    whole = scan.ended and not scan.damaged
    if whole or not (scan.damaged or output):
        summary = scan.assembled(None)
        if not whole:
            _end_in_place(scan, summary, file, path)
    else:
        output = output or path.with_name(path.name + ".recovered")
        with new_file(output, mode=SHARED) as out:
            summary = scan.assembled(out.write)
    messages = sum(summary.counts.values())
    until = summary.last / 1e9 if messages else None
    cut = 0 if whole else len(scan.octets) - scan.end
    return RecoveryResult(messages, until, whole, cut, tuple(scan.damaged), None if whole else output)


def _end_in_place(scan: _Scan, summary: McapSummary, file: int, path: Path) -> None:
    """Cut the torn end off and write the one that belongs there; cut off itself, it leaves a torn end again."""
    with path.open("r+b") as same:
        if not os.path.samestat(os.fstat(file), os.fstat(same.fileno())):
            raise BadDataError(f"{path} was replaced in the meantime.", hint="Run the same command again.")
        same.seek(scan.end)
        same.truncate()
        indexes = scan.end_indexes
        same.write(b"".join(indexes) + summary.tail(scan.end + sum(map(len, indexes))))
        same.flush()
        os.fsync(same.fileno())


@dataclass
class _Chunk:
    """A chunk with a good checksum; its content is read again when it is needed, for there are many.

    ``indexes`` are (channel, offset, octets) of the message indexes behind it; ``found`` their contents until it is
    known whether they name exactly its messages.
    """

    offset: int
    begin: int  # offset of its indexes, which is its own end
    end: int  # end of its indexes
    packed: int
    unpacked: int
    span: tuple[int, int]  # earliest and latest log time of its messages
    counts: dict[int, tuple[int, int, int]]  # by channel: messages, earliest, latest
    described: list[tuple[int, bytes]]  # schemas and channels in it: op code, content
    indexes: list[tuple[int, int, int]] = field(default_factory=list)
    found: dict[int, bytes] | None = field(default_factory=dict)
    indexed: bool = False


_Places = dict[int, list[tuple[int, int]]]
"""(log time, offset in the chunk) of messages by channel."""


def _places(body: bytes) -> _Places:
    found: _Places = {}
    for place, code, content in _inside(body):
        if code == MESSAGE and len(content) >= 22:
            channel, time = int.from_bytes(content[:2], "little"), int.from_bytes(content[6:14], "little")
            found.setdefault(channel, []).append((time, place))
    return found


def _indexes(places: _Places) -> list[bytes]:
    """Return new message indexes of a chunk."""
    return [
        record(
            MESSAGE_INDEX,
            struct.pack("<HI", key, 16 * len(entries)) + b"".join(struct.pack("<QQ", *e) for e in entries),
        )
        for key, entries in places.items()
    ]


def _names_all(found: dict[int, bytes], places: _Places) -> bool:
    """Return True if the contents of message indexes name exactly these messages."""
    indexed = {
        channel: sorted(struct.iter_unpack("<QQ", index[6:])) for channel, index in found.items() if len(index) > 6
    }
    return indexed == {channel: sorted(entries) for channel, entries in places.items()}


class _Scan:
    """Walks through a file and records which parts are whole or damaged, and where a torn end begins."""

    def __init__(self, octets: mmap.mmap, path: Path) -> None:
        if octets[: len(MAGIC)] != MAGIC:
            raise _no_mcap(path)
        self.octets, self.path = octets, path
        self.damaged: list[Damage] = []
        self.end = len(MAGIC)  # end of the undamaged records
        self.chunk: _Chunk | None = None  # the last chunk
        self.ended = False
        self._kept: list[tuple[int, int] | _Chunk] = []  # records as (begin, end), and chunks with their indexes
        self._spoiled: list[bytes] = []  # bodies of damaged chunks
        self._limit = len(octets)
        self._summary = b""

    def walk(self) -> None:
        """Judge every record."""
        finished = self.octets[-len(MAGIC) :] == MAGIC and len(self.octets) >= 2 * len(MAGIC)
        good = finished and self._read_end()
        at = len(MAGIC)
        while at < self._limit:
            head = self._head(at)
            if head is not None and head[0] == DATA_END:
                self.ended = finished
                break
            after = self._keep_record(at, *head) if head is not None else None
            if after is None:
                after = self._next_chunk(at + 1)
                self._damage("record" if head is None else "chunk" if head[0] == CHUNK else "record", at, after)
            at = after
        self._close_chunk(torn=not finished)
        if finished and not good:
            self._damage("summary", at, len(self.octets))
        if not finished:
            # In an unfinished file, damage after the last good record is its torn end.
            self.damaged = [damage for damage in self.damaged if damage.offset < self.end]
        self._join_damage()

    def _read_end(self) -> bool:
        """Return True if the summary of a finished file is valid; then its data end where it states."""
        foot = len(self.octets) - len(MAGIC) - _FOOTER_OCTETS
        if foot < len(MAGIC) or HEAD.unpack_from(self.octets, foot) != (FOOTER, 20):
            return False
        start, _, checksum = struct.unpack_from("<QQI", self.octets, foot + HEAD.size)
        start = start or foot
        at = start - HEAD.size - 4
        if not len(MAGIC) <= at < foot or HEAD.unpack_from(self.octets, at) != (DATA_END, 4):
            return False
        if checksum and zlib.crc32(self.octets[start : foot + _FOOTER_OCTETS - 4]) != checksum:
            return False
        self._limit, self._summary, self.ended = at, self.octets[start:foot], True
        return True

    def _head(self, at: int) -> tuple[int, int] | None:
        """Return op code and length of a record that fits into the file; None if there is none."""
        if at + HEAD.size > len(self.octets):
            return None
        code, length = HEAD.unpack_from(self.octets, at)
        known = code in (HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, ATTACHMENT, METADATA, DATA_END)
        if not (known or code >= _PRIVATE) or length > LARGEST_RECORD or at + HEAD.size + length > self._limit:
            return None if code != DATA_END or length != 4 or at != self._limit else (code, length)
        return code, length

    def _keep_record(self, at: int, code: int, length: int) -> int | None:
        """Keep a record; return where the next one begins, or None if it is damaged."""
        after = at + HEAD.size + length
        content = self.octets[at + HEAD.size : after]
        if code == MESSAGE_INDEX:
            if length < 6 or length != 6 + int.from_bytes(content[2:6], "little") or length % 16 != 6:
                return None
            if self.chunk is None:  # the index of a damaged chunk
                if not self.damaged or self.damaged[-1].offset + self.damaged[-1].octets != at:
                    return None
                self._damage("chunk", at, after)
                return after
            channel = int.from_bytes(content[:2], "little")
            assert self.chunk.found is not None
            self.chunk.found[channel] = self.chunk.found.get(channel, b"\0" * 6) + content[6:]
            self.chunk.indexes.append((channel, at, after - at))
            self.chunk.end = self.end = after
            return after
        if code == CHUNK:
            chunk = self._whole_chunk(at, content)
            self._close_chunk()
            if chunk is None:
                if not _fits(content):
                    return None
                self._damage("chunk", at, after)
                return after
            self.chunk = chunk
            self._kept.append(chunk)
            self.end = after
            return after
        if not _parses(code, content):
            return None
        self._close_chunk()
        self._kept.append((at, after))
        self.end = after
        return after

    def _close_chunk(self, *, torn: bool = False) -> None:
        """Close the last chunk: no message index follows; of a torn file's last chunk some may be missing."""
        chunk = self.chunk
        if chunk is None or chunk.found is None:
            return
        body = self._body(chunk)
        chunk.indexed, stated = _names_all(chunk.found, _places(body)), chunk.found
        chunk.found = None
        head = CHUNK_HEAD.unpack_from(self.octets, chunk.offset + HEAD.size)[:2]
        if chunk.counts and head != chunk.span:
            self._damage("chunk header, repaired", chunk.offset, chunk.begin)
        elif torn and not chunk.indexed:
            self.end = chunk.begin
            return
        elif stated and not chunk.indexed:
            self._damage("chunk index, rebuilt", chunk.begin, chunk.end)
        self.chunk = None

    def _body(self, chunk: _Chunk) -> bytes:
        found = unpacked(self.octets[chunk.offset + HEAD.size : chunk.begin], self.path)
        assert found is not None, "it was unpacked before"
        return found[0]

    def _damage(self, what: str, at: int, after: int) -> None:
        self.damaged.append(Damage(what, at, after - at))

    def _join_damage(self) -> None:
        """Join damaged pieces that touch, named by the first one."""
        joined: list[Damage] = []
        for damage in sorted(self.damaged, key=lambda damage: damage.offset):
            last = joined[-1] if joined else None
            if last is not None and last.offset + last.octets >= damage.offset:
                octets = max(last.offset + last.octets, damage.offset + damage.octets) - last.offset
                joined[-1] = Damage(last.what, last.offset, octets)
            else:
                joined.append(damage)
        self.damaged = joined

    def _next_chunk(self, at: int) -> int:
        """Return where something has the form of a chunk; the end of the data if nothing does."""
        place = at + _IN_A_CHUNK
        while (place := self.octets.find(_ZSTD, place, self._limit)) >= 0:
            begin = place - _IN_A_CHUNK
            head = self._head(begin)
            if (
                head is not None
                and head[0] == CHUNK
                and _fits(self.octets[begin + HEAD.size : begin + HEAD.size + head[1]])
            ):
                return begin
            place += 1
        return self._limit

    def _whole_chunk(self, at: int, content: bytes) -> _Chunk | None:
        """Return a chunk with its messages; None if its checksum is wrong, or it cannot be unpacked."""
        found = unpacked(content, self.path)
        if found is None:
            return None
        body, whole = found
        if not whole:
            self._spoiled.append(body)
            return None
        counts = {
            channel: (len(entries), min(entries)[0], max(entries)[0]) for channel, entries in _places(body).items()
        }
        span = (
            min((count[1] for count in counts.values()), default=0),
            max((count[2] for count in counts.values()), default=0),
        )
        described = [(code, content) for _, code, content in _inside(body) if code in (SCHEMA, CHANNEL)]
        packed = len(content) - CHUNK_HEAD.size - 12 - int.from_bytes(content[CHUNK_HEAD.size :][:4], "little")
        begin = at + HEAD.size + len(content)
        return _Chunk(at, begin, begin, packed, len(body), span, counts, described)

    # -- the summary --------------------------------------------------------------------------------------------------

    def assembled(self, put: Callable[[bytes], object] | None) -> McapSummary:
        """Return the summary of all that is whole, in order, unchanged or as ``put`` gets it."""
        summary, at = McapSummary(), len(MAGIC)
        if put is not None:
            put(MAGIC)
        for count, chunk in enumerate(self._kept):
            if isinstance(chunk, _Chunk):
                at = self._chunk_into(summary, chunk, at, put)
            else:
                octets = self.octets[chunk[0] : chunk[1]]
                at = _record_into(summary, octets, at, put)
            if put is not None and count == 0:  # after the header
                for described in self._rescued():
                    at = _record_into(summary, described, at, put)
        if put is not None:
            put(summary.tail(at))
        return summary

    def _chunk_into(self, summary: McapSummary, chunk: _Chunk, at: int, put: Callable[[bytes], object] | None) -> int:
        for code, content in chunk.described:
            _describe(summary, code, content)
        for channel, (count, first, last) in chunk.counts.items():
            summary.saw(channel, count, first, last)
        length = chunk.begin - chunk.offset
        anew = _indexes(_places(self._body(chunk))) if not chunk.indexed and (put or chunk is self.chunk) else None
        if anew is not None:
            indexes = [(int.from_bytes(octets[HEAD.size :][:2], "little"), len(octets)) for octets in anew]
        else:
            indexes = [(channel, octets) for channel, _, octets in chunk.indexes]
        places, end = b"", at + length
        for channel, octets in indexes:
            places += struct.pack("<HQ", channel, end)
            end += octets
        sizes = chunk.packed, chunk.unpacked
        summary.chunk_indexes.append(chunk_index(*chunk.span, at, length, places, end, *sizes))
        if put is not None:
            head = HEAD.pack(CHUNK, length - HEAD.size) + struct.pack("<QQ", *chunk.span)
            if not chunk.counts:
                head = self.octets[chunk.offset : chunk.offset + len(head)]
            put(head + self.octets[chunk.offset + len(head) : chunk.begin])
            put(b"".join(anew) if anew is not None else self.octets[chunk.begin : chunk.end])
        return end

    @property
    def end_indexes(self) -> list[bytes]:
        """Message indexes that the last chunk of a torn file lacks."""
        return _indexes(_places(self._body(self.chunk))) if self.chunk is not None else []

    def _rescued(self) -> list[bytes]:
        """Return schemas and channels of whole messages that were in a damaged chunk, as the summary has them."""
        known, used = McapSummary(), set[int]()
        for kept in self._kept:
            if isinstance(kept, _Chunk):
                used |= kept.counts.keys()
                for code, content in kept.described:
                    _describe(known, code, content)
            elif (code := self.octets[kept[0]]) in (SCHEMA, CHANNEL, MESSAGE):  # of another program: outside of chunks
                content = self.octets[kept[0] + HEAD.size : kept[1]]
                _describe(known, code, content)
                if code == MESSAGE:
                    used.add(int.from_bytes(content[:2], "little"))
        elsewhere = McapSummary()
        for body in (*self._spoiled, self._summary):  # the summary has a good checksum, so it takes precedence
            for _, code, content in _inside(body):
                if code in (SCHEMA, CHANNEL) and _parses(code, content):
                    _describe(elsewhere, code, content)
        lost = [number for number in used if number not in known.channels]
        channels = {number: elsewhere.channels.get(number) or _nameless(number) for number in lost}
        described = (*known.channels.values(), *channels.values())
        schemas = {int.from_bytes(octets[HEAD.size + 2 : HEAD.size + 4], "little") for octets in described} - {0}
        wanted = [number for number in sorted(schemas) if number not in known.schemas]
        return [*(elsewhere.schemas.get(number) or _shapeless(number) for number in wanted), *channels.values()]


def _shapeless(number: int) -> bytes:
    """Return a schema of which nothing is known any more."""
    return record(SCHEMA, struct.pack("<H", number) + text("recovered/unknown") + text("") + bytes(4))


def _nameless(number: int) -> bytes:
    """Return a channel of which nothing is known any more but its messages."""
    note = text("note") + text("the description of this topic was in a damaged chunk")
    topic = text(f"/recovered/channel_{number}")
    content = struct.pack("<HH", number, 0) + topic + text("cdr") + struct.pack("<I", len(note)) + note
    return record(CHANNEL, content)


def _record_into(summary: McapSummary, octets: bytes, at: int, put: Callable[[bytes], object] | None) -> int:
    code, content = octets[0], octets[HEAD.size :]
    if code == METADATA:
        name = content[4 : 4 + int.from_bytes(content[:4], "little")]
        index = struct.pack("<QQ", at, len(octets)) + text(name.decode(errors="replace"))
        summary.metadata_indexes.append(record(METADATA_INDEX, index))
    elif code == MESSAGE:
        time = int.from_bytes(content[6:14], "little")
        summary.saw(int.from_bytes(content[:2], "little"), 1, time, time)
    else:
        _describe(summary, code, content)
    if put is not None:
        put(octets)
    return at + len(octets)


def _describe(summary: McapSummary, code: int, content: bytes) -> None:
    """Take a schema or a channel into the summary, wherever it is."""
    number = int.from_bytes(content[:2], "little")
    if code == SCHEMA:
        summary.schemas[number] = record(SCHEMA, content)
    elif code == CHANNEL:
        summary.channels[number] = record(CHANNEL, content)


def _fits(content: bytes) -> bool:
    """Return True if the lengths within a chunk and the chunk's own agree."""
    if len(content) < CHUNK_HEAD.size + 12:
        return False
    name = int.from_bytes(content[CHUNK_HEAD.size : CHUNK_HEAD.size + 4], "little")
    at = CHUNK_HEAD.size + 4 + name
    return at + 8 <= len(content) and at + 8 + int.from_bytes(content[at : at + 8], "little") == len(content)


def unpacked(content: bytes, path: Path, most: int = LARGEST_RECORD) -> tuple[bytes, bool] | None:
    """Return the records in a chunk, and whether its checksum is right.

    None if it exceeds ``most`` octets or is damaged.
    """
    if not _fits(content):
        return None
    _, _, size, checksum = CHUNK_HEAD.unpack_from(content)
    at = CHUNK_HEAD.size
    name_length = int.from_bytes(content[at : at + 4], "little")
    compression = content[at + 4 : at + 4 + name_length]
    packed = content[at + 4 + name_length + 8 :]
    if size > most:
        return None
    if compression == b"zstd":
        try:
            body = decompress_frame(packed, size)
        except ZstdError:
            return None
    elif compression == b"":
        body = packed
    elif compression == b"lz4":
        raise BadDataError(f"A chunk of {path} is compressed with lz4, which is not supported.")
    else:
        return None
    return body, len(body) == size and (not checksum or zlib.crc32(body) == checksum)


def _parses(code: int, content: bytes) -> bool:
    """Return True if the parts of a record end at its end; other records than these are not checked."""
    try:
        if code == METADATA:
            return _after_map(content, _after_text(content, 0)) == len(content)
        if code == HEADER:
            return _after_text(content, _after_text(content, 0)) <= len(content)
        if code == CHANNEL:
            return _after_map(content, _after_text(content, _after_text(content, 4))) == len(content)
        if code == SCHEMA:
            at = _after_text(content, _after_text(content, 2))
            return at + 4 + int.from_bytes(content[at : at + 4], "little") == len(content)
        if code == MESSAGE:
            return len(content) >= 22
    except (ValueError, struct.error):
        return False
    return True


def _after_text(content: bytes, at: int) -> int:
    """Return where a text ends; raises ValueError if it is none."""
    end = at + 4 + int(struct.unpack_from("<I", content, at)[0])
    if end > len(content):
        raise ValueError("beyond the record")
    content[at + 4 : end].decode()
    return end


def _after_map(content: bytes, at: int) -> int:
    end = at + 4 + int(struct.unpack_from("<I", content, at)[0])
    at += 4
    while at < end:
        at = _after_text(content, at)
    return end


def _inside(body: bytes) -> Iterator[tuple[int, int, bytes]]:
    """Yield records of a chunk or of a summary: offset, op code, content."""
    at = 0
    while at + HEAD.size <= len(body):
        code, length = HEAD.unpack_from(body, at)
        yield at, code, body[at + HEAD.size : at + HEAD.size + length]
        at += HEAD.size + length
