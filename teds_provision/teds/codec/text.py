"""Text-based TEDS: a directory of languages in tuples, then the texts outside of any tuple.

See teds.md, "Text-based TEDS (2, 4, 6, 10, 11, 14, 15)".

Two points are open in every source: what ``Offset`` counts from and over what ``SubSum`` is taken. We write Offset from
the first octet of the TEDS (its Length), SubSum as the TEDS checksum over the tuples before it, and ``Length`` as the
text with its own two checksum octets; we read texts by their order and Length, whatever Offset says.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from teds_provision.errors import BadData
from teds_provision.teds.codec.frame import RawTuple, checksum, raw_tuple, tuples
from teds_provision.teds.codec.model import Field
from teds_provision.teds.codec.tables import FieldSpec
from teds_provision.teds.codec.tables.phy_text_security import TEXT

Tuples = Callable[[list[tuple[str, object]], Mapping[str, FieldSpec]], bytes]
_BY_NAME = {row.name: row for row in TEXT}


def compose_text(head: bytes, pairs: list[tuple[str, object]], encode: Tuples, width: int) -> bytes:
    """Data block of a text-based TEDS from pairs ("Text", {"LangCode", "Text", "Compress"})."""
    texts = [_text(value) for name, value in pairs if name == "Text"]
    others = [pair for pair in pairs if pair[0] != "Text"]
    if not texts:
        raise BadData("A text-based TEDS has at least one Text.")
    if others:
        raise BadData(f"A text-based TEDS takes Text entries, not {others[0][0]}: its directory follows from them.")
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
    if not isinstance(value, Mapping) or set(value) - {"LangCode", "Text", "Compress"}:
        raise BadData("Text is a mapping with LangCode, Text and Compress.")
    text, compress = value.get("Text", ""), value.get("Compress", 0)
    if not isinstance(text, str | bytes) or not isinstance(compress, int):
        raise BadData("Text holds text or octets, Compress a number.")
    return str(value.get("LangCode", "en")), text.encode() if isinstance(text, str) else text, compress


def split_text(fields: list[Field], area: bytes, at: int, find: Callable[..., None]) -> tuple[bytes, ...]:
    """Texts behind the directory, without their checksums; deviations go to ``find``."""
    known = _lengths(fields)
    if known and sum(known) == len(area) and min(known) >= 2:
        return _cut(area, known, at, find)
    if known and sum(known) + 2 * len(known) == len(area):
        find("note", "text-length", "The directory counts the texts without their checksums.", at, "Length")
        return _cut(area, [length + 2 for length in known], at, find)
    tagged = _tagged(area)
    if tagged is not None:
        message = "The text stands in a tuple of type 128; it should stand bare."
        find("warning", "text-tagged", message, at, "", "bare", "128")
        return tagged
    if area:
        message = f"The directory counts {sum(known)} octets of text, {len(area)} are there."
        find("warning", "text-length", message, at, "Length", len(area), sum(known))
    return (area,) if area else ()


def _lengths(fields: list[Field]) -> list[int]:
    """Octets of each text, as the directory counts them."""
    entries = (child for field in fields if field.name == "DirBlock" for child in field.children)
    return [child.value for child in entries if child.type == 22 and isinstance(child.value, int)]


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
        except BadData:
            continue
        if parts and parts[0].type == 128:
            return tuple(part.value for part in parts if part.type == 128)
    return None
