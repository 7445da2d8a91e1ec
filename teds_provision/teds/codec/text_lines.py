"""TEDS of the profile that hold lines of text: Origin (130) and Certificate (131); teds.md, "130 OriginTEDS".

One tuple of type 4 with ``key=value`` lines, each ended by LF, in a fixed order, in the 2007 form. There is one way to
write each, and anything else is refused: what a station signs must not be read in two ways.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

from teds_provision.errors import BadDataError
from teds_provision.teds.codec.frame import TEDSID, frame, raw_tuple, tuples, unframe

LINES: Final = 4
"""Type of the tuple that holds the lines."""
MOST_OCTETS: Final = 255
"""Octets of all lines together: what one length octet can count."""


def compose_lines(access_code: int, values: Mapping[str, str]) -> bytes:
    """Return the framed TEDS with a line for each value, in their order; raises BadDataError if one cannot be held."""
    for key, value in values.items():
        if not value.isprintable():
            raise BadDataError(
                f"{key} cannot stand in a TEDS of lines: {value[:40]!r} is not one line of printable text."
            )
    text = lines_of(values).encode()
    if len(text) > MOST_OCTETS:
        raise BadDataError(
            f"The lines of a TEDS have at most {MOST_OCTETS} octets, these have {len(text)}.",
            hint="Shorten the longest of them.",
        )
    return frame(raw_tuple(TEDSID, _tedsid(access_code)) + raw_tuple(LINES, text))


def lines_of(values: Mapping[str, str]) -> str:
    """Return a ``key=value`` line for each value, each ended by LF."""
    return "".join(f"{key}={value}\n" for key, value in values.items())


def read_lines(access_code: int, teds: bytes, *orders: Sequence[str]) -> dict[str, str]:
    """Return the values of a framed TEDS whose keys are one of ``orders``; raises BadDataError for any other form."""
    parts = list(tuples(unframe(teds)))
    if [part.type for part in parts] != [TEDSID, LINES] or parts[0].value != _tedsid(access_code):
        raise BadDataError(f"This TEDS of access code {access_code} does not have the form of the profile.")
    try:
        text = parts[1].value.decode()
    except UnicodeDecodeError as error:
        raise BadDataError(f"The lines of the TEDS of access code {access_code} are not UTF-8.") from error
    return values_of(access_code, text, *orders)


def values_of(access_code: int, text: str, *orders: Sequence[str]) -> dict[str, str]:
    """Return the values of the lines of a TEDS; raises BadDataError as :func:`read_lines` does."""
    *lines, rest = text.split("\n")
    pairs = [line.partition("=") for line in lines]
    keys = [key for key, equals, _ in pairs if equals]
    if rest or len(keys) != len(pairs) or not any(keys == list(order) for order in orders):
        raise BadDataError(
            f"The lines of the TEDS of access code {access_code} are not {', '.join(orders[0])}, in this order."
        )
    if not all(value.isprintable() for _, _, value in pairs):
        raise BadDataError(f"A line of the TEDS of access code {access_code} is not printable text.")
    return {key: value for key, _, value in pairs}


def _tedsid(access_code: int) -> bytes:
    """Return the TEDSID's value: family 0, this class, version 1, tuples with one length octet."""
    return bytes([0, access_code, 1, 1])
