"""Intel HEX (hexadecimal object file format, Intel 1988, record types 00 to 05), as flash tools read and write it.

Each run of octets without a gap is one stretch. Ours begins a new stretch for every TEDS, with at least one octet of
gap, at addresses that are multiples of 16; a stretch that holds several framed TEDS is cut apart when read.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.limits import LIMITS, check_count
from teds_provision.teds.codec.tables import name_of
from teds_provision.teds.image import TedsBlock, class_of, split_run, with_class

# Hex digits in a text: ``#`` comments, white space, commas and ``0x`` are skipped.
#
# This program writes a comment ``# channel 1 access code 3`` before each TEDS; when read, it gives the place and the
# beginning of the next TEDS. Other comments are ignored.

_PLACE: Final = re.compile(r"#\s*channel (\d{1,5}|-) access code (\d{1,3}|-)(?=\s|$)")
_SKIP: Final = re.compile(r"0[xX](?=[0-9A-Fa-f])|[\s,]+")
_OTHER: Final = re.compile(r"[^0-9A-Fa-f]")
_LINE_DIGITS: Final = 64


def looks_like_hex(text: str) -> bool:
    """Return True if a text holds hex digits and nothing else, comments aside."""
    some = False
    for line in text.splitlines():
        digits = _digits(line)
        if _OTHER.search(digits) is not None:
            return False
        some = some or bool(digits)
    return some


def read_hex(text: str) -> list[TedsBlock]:
    """Read a hex text; raises BadDataError naming line and character."""
    blocks: list[TedsBlock] = []
    place: tuple[int | None, int | None] | None = None
    digits: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        found = _PLACE.match(line.strip())
        if found:
            blocks += _finish(place, digits)
            check_count(len(blocks), LIMITS.teds_of_a_file, "TEDS")
            channel, code = (None if part == "-" else int(part) for part in found.groups())
            if (channel or 0) > 0xFFFF or (code or 0) > 0xFF:
                raise BadDataError(
                    f"Line {number} names channel {channel} and access code {code}; they are u16 and u8."
                )
            place, digits = (channel, code), []
            continue
        part = _digits(line)
        wrong = _OTHER.search(part)
        if wrong:
            raise BadDataError(f"Line {number} holds {wrong.group()!r}, which is no hex digit.")
        digits.append(part)
    return blocks + _finish(place, digits)


def _digits(line: str) -> str:
    return _SKIP.sub("", line.partition("#")[0])


def _finish(place: tuple[int | None, int | None] | None, parts: list[str]) -> list[TedsBlock]:
    digits = "".join(parts)
    if len(digits) % 2:
        raise BadDataError(f"There are {len(digits)} hex digits; whole octets need an even number.")
    octets = bytes.fromhex(digits)
    if place is not None:
        channel, code = place
        return [TedsBlock(channel, code, octets)]
    return [with_class(piece) for piece in split_run(octets)] if octets else []


def write_hex(blocks: Sequence[TedsBlock]) -> str:
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


DATA, END, SEGMENT_BASE, SEGMENT_START, LINEAR_BASE, LINEAR_START = range(6)
_RECORD: Final = 16
_ALIGNED: Final = 16
_LENGTHS: Final = {END: 0, SEGMENT_BASE: 2, SEGMENT_START: 4, LINEAR_BASE: 2, LINEAR_START: 4}


def read_intel_hex(text: str) -> list[TedsBlock]:
    """Read the TEDS of an Intel HEX text, by address; raises BadDataError naming the line."""
    return [with_class(piece) for _, octets in stretches(text) for piece in split_run(octets)]


def stretches(text: str) -> list[tuple[int, bytes]]:
    """Return runs of octets without a gap as (address, octets), ascending; raises BadDataError if records overlap."""
    pieces: list[tuple[int, bytes]] = []
    check_count(text.count(":"), LIMITS.hex_records, "records in the Intel HEX text")
    base = 0
    ended = False
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        if ended:
            raise BadDataError(f"Line {number} comes after the end record.")
        kind, address, data = _record(line.strip(), number)
        if kind == DATA:
            pieces += _place(base, address, data)
        elif kind in {SEGMENT_BASE, LINEAR_BASE}:
            base = int.from_bytes(data, "big") << (4 if kind == SEGMENT_BASE else 16)
        ended = kind == END
    if not ended:
        raise BadDataError("The Intel HEX text has no end record (:00000001FF): it was cut off.")
    runs = _joined(sorted(pieces))
    check_count(len(runs), LIMITS.hex_stretches, "stretches of octets in the Intel HEX text")
    return runs


def _place(base: int, address: int, data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield data with its addresses, which wrap at 64 KiB within a record."""
    here = 0x10000 - address
    yield base + address, data[:here]
    if data[here:]:
        yield base, data[here:]


def _record(line: str, number: int) -> tuple[int, int, bytes]:
    if not line.startswith(":"):
        raise BadDataError(f"Line {number} does not begin with a colon.")
    try:
        octets = bytes.fromhex(line[1:])
    except ValueError as error:
        raise BadDataError(f"Line {number} holds something that is no hex digit.") from error
    if len(octets) < 5 or octets[0] != len(octets) - 5:
        raise BadDataError(f"Line {number} has a wrong length.")
    if sum(octets) & 0xFF:
        raise BadDataError(f"The checksum of line {number} is wrong.")
    kind, data = octets[3], octets[4:-1]
    if kind > LINEAR_START or _LENGTHS.get(kind, len(data)) != len(data):
        raise BadDataError(f"Line {number} holds a record of type {kind} with {len(data)} octets, which is none.")
    return kind, int.from_bytes(octets[1:3], "big"), data


def _joined(pieces: list[tuple[int, bytes]]) -> list[tuple[int, bytes]]:
    runs: list[tuple[int, list[bytes]]] = []
    end = -1
    for address, data in pieces:
        if not data:
            continue
        if address < end:
            raise BadDataError(f"Two records of the Intel HEX text overlap at address {address:08X}.")
        if address != end:
            runs.append((address, []))
        runs[-1][1].append(data)
        end = address + len(data)
    return [(address, b"".join(parts)) for address, parts in runs]


def write_intel_hex(blocks: Sequence[TedsBlock], *, address: int = 0) -> str:
    """Write each TEDS as a separate stretch, from ``address`` on; channels are lost."""
    lines: list[str] = []
    at, high = address, 0
    for block in blocks:
        octets = block.octets
        if at + len(octets) > 1 << 32:
            raise BadDataError("Intel HEX ends at address FFFFFFFF; these TEDS do not fit.")
        done = 0
        while done < len(octets):
            if at >> 16 != high:
                high = at >> 16
                lines.append(_line(LINEAR_BASE, 0, high.to_bytes(2, "big")))
            take = min(_RECORD, len(octets) - done, 0x10000 - (at & 0xFFFF))
            lines.append(_line(DATA, at & 0xFFFF, octets[done : done + take]))
            done, at = done + take, at + take
        at = (at // _ALIGNED + 1) * _ALIGNED
    return "\n".join([*lines, _line(END, 0, b"")]) + "\n"


def _line(kind: int, address: int, data: bytes) -> str:
    octets = bytes([len(data)]) + address.to_bytes(2, "big") + bytes([kind]) + data
    return f":{octets.hex().upper()}{-sum(octets) & 0xFF:02X}"
