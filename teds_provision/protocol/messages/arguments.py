"""Arguments of a message: walked and written by a layout (see :mod:`.tables`), in either of the two payload schools."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.protocol.messages.tables import ENUMERATIONS, ERROR_SOURCES, ERRORS, FLAGS
from teds_provision.teds.codec.model import Finding, TimeInstance
from teds_provision.teds.codec.tables import name_of

MessageValue = int | float | str | bytes | TimeInstance | tuple[int, ...] | tuple[str, ...] | tuple[bytes, ...]
Blocks = tuple[tuple[int, int], ...]

TICKS_PER_SECOND: Final = 65536 * 10**9
"""TimeDuration of the 2024 messages counts 2^-16 ns."""

_INTEGERS: Final = {"u8": 1, "u16": 2, "u32": 4, "bool": 1}
_FIXED: Final = {**_INTEGERS, "f32": 4, "uuid": 16, "time": 10, "duration": 8}

TAGS: Final = {1: 1, 2: 2, 3: 4, 4: 4, 5: 8, 8: 1, 9: 8, 10: 8}
"""Octets of the fixed-size type codes of tagged arguments (teds.md, "Data types"); all others vary."""
_HIGHEST_TAG: Final = 21
_TAG_OF: Final = {"u8": {1, 8}, "u16": {2}, "u32": {3}, "bool": {8, 1}, "f32": {4}}


@dataclass(frozen=True)
class Argument:
    """One argument: ``offset`` of its first octet in the message, ``meaning`` in words if the number is a code."""

    name: str
    type: str
    value: MessageValue | Blocks
    raw: bytes
    offset: int
    meaning: str = ""


def words(layout: str) -> Iterator[tuple[str, str]]:
    """Name and type of each argument of a layout."""
    for word in layout.split():
        name, _, kind = word.partition(":")
        yield name, kind


def size_of(kind: str) -> int | None:
    """Return the octets of a type of fixed size, None if it varies."""
    if kind in _FIXED:
        return _FIXED[kind]
    if kind[0] == "o" and kind[1:].isdigit():
        return int(kind[1:])
    return None


def read_plain(payload: bytes, layout: str, base: int) -> tuple[list[Argument], list[Finding]]:
    """Read arguments put one after the other; ``base`` is the payload's offset in the message."""
    arguments: list[Argument] = []
    findings: list[Finding] = []
    at, count = 0, 0
    for name, kind in words(layout):
        size = _extent(payload, at, kind, count)
        raw = payload[at : at + size]
        if len(raw) < size:
            message = f"The message ends inside {name}: {size} octets asked, {len(payload) - at} there."
            findings.append(Finding("error", "argument-cut", message, base + at, name, str(size), str(len(raw))))
            size = len(raw)
        arguments.append(_argument(name, kind, raw, base + at))
        if name == "count" and size == 2:
            count = int.from_bytes(raw, "big")
        at += size
    if at < len(payload):
        raw = payload[at:]
        arguments.append(Argument("rest", "octets", raw, raw, base + at))
        message = f"{len(raw)} octets follow the last argument."
        findings.append(Finding("warning", "argument-rest", message, base + at, "rest", "0", str(len(raw))))
    return arguments, findings


def _extent(payload: bytes, at: int, kind: str, count: int) -> int:
    """Return the octets that the next argument takes; for one that was cut off, those that it should take."""
    fixed = size_of(kind)
    if fixed is not None:
        return fixed
    if kind == "text":
        end = payload.find(b"\0", at)
        return (end + 1 if end >= 0 else len(payload)) - at
    if kind == "u16s":
        return 2 * count
    if kind == "uuids":
        return 16 * count
    if kind == "texts":
        end = at
        for _ in range(count):
            end = payload.find(b"\0", end) + 1
            if end == 0:
                return len(payload) - at
        return end - at
    return len(payload) - at


def read_tagged(payload: bytes, layout: str, base: int) -> list[Argument] | None:
    """Read tagged arguments (type code u8 ‖ length u16 ‖ value); None if the payload is not of that school.

    Sections of a payload are taken as tagged only if every one closes, there are as many as in the layout, and those of
    fixed size carry the type code that the layout means.
    """
    wanted = list(words(layout))
    parts: list[Argument] = []
    at = 0
    while at < len(payload):
        if at + 3 > len(payload) or len(parts) == len(wanted):
            return None
        tag, length = payload[at], int.from_bytes(payload[at + 1 : at + 3], "big")
        name, kind = wanted[len(parts)]
        raw = payload[at + 3 : at + 3 + length]
        if len(raw) < length or not _tag_fits(tag, length, kind):
            return None
        parts.append(_argument(name, kind, raw, base + at + 3))
        at += 3 + length
    return parts if parts and len(parts) == len(wanted) else None


def _tag_fits(tag: int, length: int, kind: str) -> bool:
    if not 1 <= tag <= _HIGHEST_TAG or TAGS.get(tag, length) != length:
        return False
    expected = _TAG_OF.get(kind)
    return expected is None or tag in expected


def _argument(name: str, kind: str, raw: bytes, offset: int) -> Argument:
    value = _value(kind, raw)
    return Argument(name, kind, value, raw, offset, _meaning(name, value))


def _value(kind: str, raw: bytes) -> MessageValue | Blocks:
    size = size_of(kind)
    if size is not None and len(raw) != size:
        return raw
    if kind in _INTEGERS:
        return int.from_bytes(raw, "big")
    reader = _READERS.get(kind)
    return raw if reader is None else reader(raw)


def _read_time(raw: bytes) -> TimeInstance:
    return TimeInstance(int.from_bytes(raw[:6], "big"), int.from_bytes(raw[6:], "big"))


def _read_f32(raw: bytes) -> float:
    number: float = struct.unpack(">f", raw)[0]
    return number


def _u16s(raw: bytes) -> tuple[int, ...]:
    return tuple(int.from_bytes(raw[i : i + 2], "big") for i in range(0, len(raw) - 1, 2))


def _texts(raw: bytes) -> tuple[str, ...]:
    return tuple(part.decode(errors="replace") for part in raw.removesuffix(b"\0").split(b"\0")) if raw else ()


def _blocks(raw: bytes) -> Blocks:
    return tuple((int.from_bytes(raw[i : i + 2], "big"), raw[i + 2]) for i in range(0, len(raw) - 2, 3))


_READERS: Final[dict[str, Callable[[bytes], MessageValue | Blocks]]] = {
    "f32": _read_f32,
    "time": _read_time,
    "duration": lambda raw: int.from_bytes(raw, "big", signed=True) / TICKS_PER_SECOND,
    "text": lambda raw: raw.removesuffix(b"\0").decode(errors="replace"),
    "texts": _texts,
    "u16s": _u16s,
    "uuids": lambda raw: tuple(raw[i : i + 16] for i in range(0, len(raw) - 15, 16)),
    "blocks": _blocks,
}


def _meaning(name: str, value: object) -> str:
    if not isinstance(value, int):
        return ""
    if name == "access_code":
        return name_of(value)
    if name == "error":
        number = value & 0x1FFF
        known = ERRORS[number] if number < len(ERRORS) else f"unknown error {number}"
        return known if value == 0 else f"{known} ({ERROR_SOURCES[value >> 13]})"
    if name == "channel":
        return {0: "the TIM itself", 0xFFFF: "every TransducerChannel"}.get(value, "")
    if name in FLAGS:
        names = FLAGS[name]
        return ", ".join(names[bit] if bit < len(names) else f"bit {bit}" for bit in range(32) if value >> bit & 1)
    return ENUMERATIONS.get(name, {}).get(value, "")


def write_plain(layout: str, values: Mapping[str, MessageValue | Blocks], *, of: str) -> bytes:
    """Write arguments one after the other; raises BadDataError naming the argument of the message ``of``."""
    unknown = set(values) - {name for name, _ in words(layout)}
    if unknown:
        raise BadDataError(f"{of} has no argument {sorted(unknown)[0]!r}.")
    out = b""
    for name, kind in words(layout):
        if name not in values:
            raise BadDataError(f"{of} needs the argument {name!r}.")
        try:
            out += _octets(kind, values[name])
        except (TypeError, ValueError, OverflowError, AttributeError, struct.error) as error:
            raise BadDataError(f"The argument {name!r} of {of} does not fit {kind}: {values[name]!r}.") from error
    return out


def _octets(kind: str, value: MessageValue | Blocks) -> bytes:
    if kind in _INTEGERS:
        return int(value).to_bytes(_INTEGERS[kind], "big")  # type: ignore[arg-type]
    writer = _WRITERS.get(kind)
    octets = bytes(value) if writer is None else writer(value)  # type: ignore[arg-type]
    size = size_of(kind)
    if isinstance(value, int | str) and writer is None:
        raise TypeError("octets are asked")
    if size is not None and len(octets) != size:
        raise ValueError(f"{size} octets are asked")
    return octets


def _text(value: str) -> bytes:
    if "\0" in value:
        raise ValueError("a text ends at its first NUL")
    return value.encode() + b"\0"


def _write_duration(seconds: float) -> bytes:
    if not math.isfinite(seconds):
        raise ValueError("not a time")
    return round(seconds * TICKS_PER_SECOND).to_bytes(8, "big", signed=True)


_WRITERS: Final[dict[str, Callable[..., bytes]]] = {
    "f32": lambda value: struct.pack(">f", value),
    "time": lambda value: value.seconds.to_bytes(6, "big") + value.nanoseconds.to_bytes(4, "big"),
    "duration": _write_duration,
    "text": _text,
    "texts": lambda value: b"".join(map(_text, value)),
    "u16s": lambda value: b"".join(number.to_bytes(2, "big") for number in value),
    "uuids": b"".join,
    "blocks": lambda value: b"".join(channel.to_bytes(2, "big") + bytes([code]) for channel, code in value),
}
