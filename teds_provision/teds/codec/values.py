"""Octets <-> values for every data type of the field tables (teds.md, "Data types"); big-endian throughout."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import lru_cache
from math import isnan
from numbers import Integral, Rational, Real
from typing import Any, Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import RawTuple, checksum, raw_tuple, tuples
from teds_provision.teds.codec.model import UNIT_PARTS, Edition, Field, TimeInstance, Units, Value
from teds_provision.teds.codec.tables import TEXT, FieldSpec

NOT_AVAILABLE: Final = bytes.fromhex("7fffffff")
"""The NaN that a TEDS uses for "not available"."""

_INTEGERS: Final = {"u8": 1, "u16": 2, "u32": 4}
_F32 = struct.Struct(">f")
NO_EXTENSION: Final = (0x00, 0x80)
"""Value that peers write if no Units Extension TEDS exists."""


# --- reading -----------------------------------------------------------------------------------------------------


def read_int(raw: bytes) -> Value:
    """Return an unsigned integer of any number of octets."""
    return int.from_bytes(raw, "big")


def read_f32(raw: bytes) -> Value:
    """Return a Float32."""
    value: float = _F32.unpack(raw)[0]
    return value


def read_floats(raw: bytes) -> Value:
    """Run of Float32; an incomplete last one is left out (the decoder reports it)."""
    count = len(raw) // 4
    return struct.unpack_from(f">{count}f", raw)


def read_u16s(raw: bytes) -> Value:
    """Run of UInt16; an odd last octet is left out (the decoder reports it)."""
    count = len(raw) // 2
    return struct.unpack_from(f">{count}H", raw)


def read_text(raw: bytes) -> Value:
    """Return UTF-8 text, or the octets if it is none."""
    try:
        return raw.decode()
    except UnicodeDecodeError:
        return raw


def read_key(raw: bytes) -> Value:
    """Return the text of a key or signature (base64, PEM, hex), or the octets if it is raw or DER."""
    try:
        text = raw.decode("ascii")
    except UnicodeDecodeError:
        return raw
    return text if text.isprintable() or "-----BEGIN" in text else raw


def read_octets(raw: bytes) -> Value:
    """Return the octets themselves."""
    return raw


def read_instant(raw: bytes) -> Value:
    """Return a TimeInstance or TimeDuration: 8 octets (U32 s, sign and 31-bit ns) or 10 (48-bit s, U32 ns)."""
    if len(raw) == 8:
        word = int.from_bytes(raw[4:], "big")
        return TimeInstance(int.from_bytes(raw[:4], "big"), word & 0x7FFFFFFF, bool(word >> 31))
    return TimeInstance(int.from_bytes(raw[:6], "big"), int.from_bytes(raw[6:], "big"))


READERS: Final[Mapping[str, Callable[[bytes], Value]]] = {
    "u8": read_int,
    "u16": read_int,
    "u32": read_int,
    "f32": read_f32,
    "f32x2": read_floats,
    "f32[]": read_floats,
    "u16[]": read_u16s,
    "text": read_text,
    "lang": read_text,
    "key": read_key,
    "uuid": read_octets,
    "octets": read_octets,
    "block id": read_octets,
    "instant": read_instant,
    "duration": read_instant,
}


@lru_cache(maxsize=1024)
def units_of(packed: bytes) -> Units:
    """Return units from the packed spelling: interpretation, nine exponents, an extension octet if there is an 11th."""
    rad, sr, m, kg, s, a, k, mol, cd = (Fraction(octet - 128, 2) for octet in packed[1:10])
    extension = packed[10] if len(packed) > 10 and packed[10] not in NO_EXTENSION else 0
    return Units(packed[0], rad, sr, m, kg, s, a, k, mol, cd, extension)


def is_packed_units(raw: bytes) -> bool:
    """Return True if a UNITS value is packed (10 or 11 octets, interpretation first) rather than a run of tuples."""
    return len(raw) in (10, 11) and raw[0] <= 5


# --- writing -----------------------------------------------------------------------------------------------------


def shown(value: object) -> str:
    """Repr of a value for a message, cut to 60 characters."""
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _refuse(name: str, why: str) -> BadDataError:
    return BadDataError(f"{name} {why}.")


def write_int(spec: FieldSpec, value: object, octets: int) -> bytes:
    """Return the octets of an unsigned integer; a text is looked up in the field's enumeration."""
    if isinstance(value, str):
        wanted = value.casefold()
        for number, name in spec.enumeration.items():
            if name.casefold() == wanted:
                return number.to_bytes(octets, "big")
        known = ", ".join(spec.enumeration.values())
        raise _refuse(spec.name, f"knows no value {shown(value)}" + (f"; it has {known}" if known else ""))
    if not isinstance(value, Integral):
        raise _refuse(spec.name, f"is a whole number, not {shown(value)}")
    number = int(value)
    if not 0 <= number < 1 << 8 * octets:
        raise _refuse(spec.name, f"goes from 0 to {(1 << 8 * octets) - 1}, {number} does not fit")
    return number.to_bytes(octets, "big")


def write_f32(spec: FieldSpec, value: object) -> bytes:
    """Return the octets of a Float32; NaN and None become the NaN that means "not available"."""
    if value is None:
        return NOT_AVAILABLE
    if isinstance(value, bool) or not isinstance(value, Real):
        raise _refuse(spec.name, f"is a number, not {shown(value)}")
    try:
        number = float(value)
        return NOT_AVAILABLE if isnan(number) else _F32.pack(number)
    except OverflowError as error:
        raise _refuse(spec.name, f"does not fit a Float32: {shown(value)}") from error


def write_array(spec: FieldSpec, value: object) -> bytes:
    """Return the octets of an array of UInt16 or Float32, given as list, tuple or numpy array."""
    plain: object = value.tolist() if hasattr(value, "tolist") else value
    if not isinstance(plain, Sequence) or isinstance(plain, str | bytes):
        raise _refuse(spec.name, f"is a list of numbers, not {shown(value)}")
    items: list[Any] = list(plain)
    if spec.kind == "f32x2" and len(items) != 2:
        raise _refuse(spec.name, f"has two numbers, not {len(items)}")
    if spec.kind == "u16[]":
        return b"".join(write_int(spec, item, 2) for item in items)
    return b"".join(write_f32(spec, item) for item in items)


def write_text(spec: FieldSpec, value: object) -> bytes:
    """Return text as UTF-8, or octets unchanged."""
    if isinstance(value, str):
        return value.encode()
    return write_octets(spec, value)


def write_octets(spec: FieldSpec, value: object) -> bytes:
    """Return octets unchanged."""
    if not isinstance(value, bytes | bytearray | memoryview):
        raise _refuse(spec.name, f"is octets, not {shown(value)}")
    return bytes(value)


def write_instant(spec: FieldSpec, value: object, edition: Edition) -> bytes:
    """Return a TimeInstance (2007: 8 octets, 2024: 10) or TimeDuration (8); a plain number counts as seconds."""
    if isinstance(value, Real):
        value = _split_seconds(spec, value)
    if not isinstance(value, TimeInstance):
        raise _refuse(spec.name, f"is a time, not {shown(value)}")
    long = edition == 2024 and spec.kind == "instant"
    if not 0 <= value.nanoseconds < 1 << (32 if long else 31):
        raise _refuse(spec.name, f"has {value.nanoseconds} nanoseconds")
    if long and value.negative:
        raise _refuse(spec.name, "cannot lie before 1970 in the 2024 form")
    bits = 48 if long else 32
    if not 0 <= value.seconds < 1 << bits:
        raise _refuse(spec.name, f"has {bits} bits of seconds, {value.seconds} does not fit")
    return value.seconds.to_bytes(bits // 8, "big") + (value.nanoseconds | value.negative << 31).to_bytes(4, "big")


def _split_seconds(spec: FieldSpec, value: Real) -> TimeInstance:
    try:
        exact = Fraction(value) if isinstance(value, Rational) else Fraction(float(value))
        total = round(exact * 1_000_000_000)
    except (ValueError, OverflowError) as error:
        raise _refuse(spec.name, f"is a time, not {shown(value)}") from error
    seconds, nanoseconds = divmod(abs(total), 1_000_000_000)
    return TimeInstance(seconds, nanoseconds, total < 0)


def write_uuid(spec: FieldSpec, value: object, edition: Edition) -> bytes:
    """Return a UUID from octets or hex digits: 10 octets in the 2007 form, 16 in the 2024 form."""
    if isinstance(value, str):
        try:
            value = bytes.fromhex(value)
        except ValueError as error:
            raise _refuse(spec.name, f"is hex digits, not {shown(value)}") from error
    octets = write_octets(spec, value)
    wanted = 16 if edition == 2024 else 10
    if len(octets) != wanted:
        raise _refuse(spec.name, f"has {wanted} octets in the {edition} edition, not {len(octets)}")
    return octets


def as_units(spec: FieldSpec, value: object) -> Units:
    """Return Units from Units, from a mapping of its attributes, or from the packed octets."""
    if isinstance(value, Units):
        return value
    if isinstance(value, Mapping):
        unknown = set(value) - {"interpretation", "extension", *UNIT_PARTS}
        if unknown:
            raise _refuse(spec.name, f"has no part {sorted(map(str, unknown))[0]}")
        try:
            parts: dict[str, Any] = {
                key: Fraction(part) if key in UNIT_PARTS else int(part) for key, part in value.items()
            }
        except (TypeError, ValueError, OverflowError, ZeroDivisionError) as error:
            raise _refuse(spec.name, "holds something that is no number") from error
        return Units(**parts)
    if isinstance(value, bytes) and is_packed_units(value):
        return units_of(value)
    raise _refuse(spec.name, f"is physical units, not {shown(value)}")


def pack_units(spec: FieldSpec, units: Units) -> bytes:
    """Return the packed spelling B: interpretation, nine exponents (2 x + 128), extension; 11 octets."""
    octets = [units.interpretation]
    for part in UNIT_PARTS:
        doubled = getattr(units, part) * 2 + 128
        if doubled != int(doubled) or not 0 <= doubled <= 255:
            raise _refuse(spec.name, f"cannot hold the exponent {getattr(units, part)} of {part}")
        octets.append(int(doubled))
    if not 0 <= units.interpretation <= 255 or not 0 <= units.extension <= 255:
        raise _refuse(spec.name, "has an interpretation or extension that is no octet")
    return bytes([*octets, units.extension])


def write_fixed(spec: FieldSpec, value: object) -> bytes:
    """Return octets or text of exactly the number in the table."""
    octets = write_text(spec, value)
    if len(octets) not in spec.octets:
        raise _refuse(spec.name, f"has {spec.octets[0]} octets, not {len(octets)}")
    return octets


def write(spec: FieldSpec, value: object, edition: Edition) -> bytes:
    """Return the value octets of one field that holds no tuples; raises BadDataError naming the field."""
    kind = spec.kind
    if kind in _INTEGERS:
        return write_int(spec, value, _INTEGERS[kind])
    if kind == "f32":
        return write_f32(spec, value)
    if kind in {"f32[]", "u16[]", "f32x2"}:
        return write_array(spec, value)
    if kind in {"text", "key"}:
        return write_text(spec, value)
    if kind in {"lang", "block id"}:
        return write_fixed(spec, value)
    if kind in {"instant", "duration"}:
        return write_instant(spec, value, edition)
    if kind == "uuid":
        return write_uuid(spec, value, edition)
    return write_octets(spec, value)


Pairs = Sequence[tuple[str, object]]
Fields = Mapping[str, object] | Pairs


def pairs_of(name: str, fields: object) -> list[tuple[str, object]]:
    """Return a mapping or sequence of pairs as a list of (field name, value).

    A list of values in a mapping is not spread.
    """
    if isinstance(fields, Mapping):
        return [(str(key), value) for key, value in fields.items()]
    if isinstance(fields, Sequence) and not isinstance(fields, str | bytes):
        pairs = [pair for pair in fields if isinstance(pair, tuple | list) and len(pair) == 2]
        if len(pairs) == len(fields):
            return [(str(key), value) for key, value in pairs]
    raise _refuse(name, "is a mapping of field names, or a sequence of (name, value) pairs")


# Text-based TEDS: a directory of languages in tuples, followed by the texts outside any tuple.
# See teds.md, "Text-based TEDS (2, 4, 6, 10, 11, 14, 15)".
#
# The sources leave two points open: the origin of ``Offset`` and the range of ``SubSum``. We write Offset from the
# first octet of the TEDS (its Length), SubSum as the TEDS checksum over the tuples before it, and ``Length`` as the
# text with its own two checksum octets. We read texts by their order and Length, and ignore Offset.

Tuples = Callable[[list[tuple[str, object]], Mapping[str, FieldSpec]], bytes]
_BY_NAME = {row.name: row for row in TEXT}


def compose_text(head: bytes, pairs: list[tuple[str, object]], encode: Tuples, width: int) -> bytes:
    """Return the data block of a text-based TEDS from pairs ("Text", {"LangCode", "Text", "Compress"})."""
    texts = [_text(value) for name, value in pairs if name == "Text"]
    others = [pair for pair in pairs if pair[0] != "Text"]
    if not texts:
        raise BadDataError("A text-based TEDS has at least one Text.")
    if others:
        raise BadDataError(
            f"A text-based TEDS takes Text entries, not {others[0][0]}: its directory follows from them."
        )
    wholes = [text + checksum(text).to_bytes(2, "big") for _, text, _ in texts]

    def directory(start: int) -> bytes:
        at, entries = start, []
        for (language, _, compress), whole in zip(texts, wholes, strict=True):
            entries.append({"LangCode": language, "Offset": at, "Length": len(whole), "Compress": compress})
            at += len(whole)
        pairs = [("NumLang", len(texts)), *(("DirBlock", entry) for entry in entries)]
        block = head + encode(pairs, _BY_NAME)
        return block + raw_tuple(12, checksum(block).to_bytes(2, "big"), width=width)

    return directory(4 + len(directory(0))) + b"".join(wholes)


def _text(value: object) -> tuple[str, bytes, int]:
    parts = dict(pairs_of("Text", value))
    if set(parts) - {"LangCode", "Text", "Compress"}:
        raise BadDataError("Text is a mapping with LangCode, Text and Compress.")
    text, compress = parts.get("Text", ""), parts.get("Compress", 0)
    if not isinstance(text, str | bytes) or not isinstance(compress, int):
        raise BadDataError("Text holds text or octets, Compress a number.")
    return str(parts.get("LangCode", "en")), text.encode() if isinstance(text, str) else text, compress


def split_text(fields: list[Field], area: bytes, at: int, find: Callable[..., None]) -> tuple[bytes, ...]:
    """Split off the texts after the directory, without their checksums; deviations go to ``find``."""
    # Octets of each text, as stated in the directory.
    entries = (child for field in fields if field.name == "DirBlock" for child in field.children)
    known = [child.value for child in entries if child.type == 22 and isinstance(child.value, int)]
    if known and sum(known) == len(area) and min(known) >= 2:
        return _cut(area, known, at, find)
    if known and sum(known) + 2 * len(known) == len(area):
        find("note", "text-length", "The directory counts the texts without their checksums.", at, "Length")
        return _cut(area, [length + 2 for length in known], at, find)
    tagged = _tagged(area)
    if tagged is not None:
        message = "The text is in a tuple of type 128; it should be bare."
        find("warning", "text-tagged", message, at, "", "bare", "128")
        return tagged
    if area:
        message = f"The directory counts {sum(known)} octets of text, {len(area)} are there."
        find("warning", "text-length", message, at, "Length", len(area), sum(known))
    return (area,) if area else ()


def _cut(area: bytes, lengths: list[int], at: int, find: Callable[..., None]) -> tuple[bytes, ...]:
    texts = []
    start = 0
    for length in lengths:
        text, stated = area[start : start + length - 2], area[start + length - 2 : start + length]
        if checksum(text).to_bytes(2, "big") != stated:
            right = f"{checksum(text):04X}"
            message = f"The checksum of a text is {stated.hex().upper()}, the rule for TEDS gives {right}."
            find("warning", "text-checksum", message, at + start + length - 2, "", right, stated.hex().upper())
        texts.append(text)
        start += length
    return tuple(texts)


def _tagged(area: bytes) -> tuple[bytes, ...] | None:
    for width in (1, 2):
        try:
            parts: list[RawTuple] = list(tuples(area, width=width))
        except BadDataError:
            continue
        if parts and parts[0].type == 128:
            return tuple(part.value for part in parts if part.type == 128)
    return None
