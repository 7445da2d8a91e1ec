"""Hex digits in a text: ``#`` comments, white space, commas and ``0x`` are skipped.

Ours puts a comment ``# channel 1 access code 3`` before each TEDS; read back, it gives the place, and where the next
TEDS begins. Other people's comments mean nothing.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final

from teds_provision.errors import BadData
from teds_provision.limits import LIMITS, check_count
from teds_provision.teds.codec.tables import name_of
from teds_provision.teds.formats.block import Block, class_of, split_run, with_class

_PLACE: Final = re.compile(r"#\s*channel (\d{1,5}|-) access code (\d{1,3}|-)(?=\s|$)")
_SKIP: Final = re.compile(r"0[xX](?=[0-9A-Fa-f])|[\s,]+")
_OTHER: Final = re.compile(r"[^0-9A-Fa-f]")
_LINE_DIGITS: Final = 64


def looks_like_hex(text: str) -> bool:
    """Whether a text holds hex digits and nothing else, comments aside."""
    some = False
    for line in text.splitlines():
        digits = _digits(line)
        if _OTHER.search(digits) is not None:
            return False
        some = some or bool(digits)
    return some


def read_hex(text: str) -> list[Block]:
    """Read a hex text; raises BadData naming line and character."""
    blocks: list[Block] = []
    place: tuple[int | None, int | None] | None = None
    digits: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        found = _PLACE.match(line.strip())
        if found:
            blocks += _finish(place, digits)
            check_count(len(blocks), LIMITS.teds_of_a_file, "TEDS")
            channel, code = (None if part == "-" else int(part) for part in found.groups())
            if (channel or 0) > 0xFFFF or (code or 0) > 0xFF:
                raise BadData(f"Line {number} names channel {channel} and access code {code}; they are u16 and u8.")
            place, digits = (channel, code), []
            continue
        part = _digits(line)
        wrong = _OTHER.search(part)
        if wrong:
            raise BadData(f"Line {number} holds {wrong.group()!r}, which is no hex digit.")
        digits.append(part)
    return blocks + _finish(place, digits)


def _digits(line: str) -> str:
    return _SKIP.sub("", line.partition("#")[0])


def _finish(place: tuple[int | None, int | None] | None, parts: list[str]) -> list[Block]:
    digits = "".join(parts)
    if len(digits) % 2:
        raise BadData(f"There are {len(digits)} hex digits; whole octets need an even number.")
    octets = bytes.fromhex(digits)
    if place is not None:
        channel, code = place
        return [Block(channel, code, octets)]
    return [with_class(piece) for piece in split_run(octets)] if octets else []


def write_hex(blocks: Sequence[Block]) -> str:
    """Write one comment and the digits of each TEDS; nothing is lost."""
    lines: list[str] = []
    for channel, code, octets in blocks:
        if channel is not None or code != class_of(octets) or len(blocks) > 1 or split_run(octets) != [octets]:
            name = f" ({name_of(code)})" if code is not None else ""
            where = "-" if channel is None else channel
            lines.append(f"# channel {where} access code {'-' if code is None else code}{name}")
        digits = octets.hex()
        lines += [digits[at : at + _LINE_DIGITS] for at in range(0, len(digits), _LINE_DIGITS)]
    return "\n".join(lines) + "\n"
