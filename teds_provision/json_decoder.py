"""JSON with one meaning or refused (RFC 8259): the decoder under every reader of untrusted documents.

Python's own takes the last of two members of one name, and NaN, which is no JSON. Readers that differ about either see
two documents in one text, so a check in front could pass another one than is used. The readers above differ in size,
in what they add, and in their messages: ``limits.load_json`` (files of TEDS and settings),
``protocol/handover/strict_json.py`` (signed documents), ``api/schema.py`` (bodies of requests). This module is below
every room and imports nothing of ours.
"""

from __future__ import annotations

import json
from typing import Any


class DuplicateNameError(ValueError):
    """Two members of one object have the same name, :attr:`name`."""

    def __init__(self, name: str) -> None:
        super().__init__(f'an object names "{name[:40]}" twice')
        self.name = name


def strict_decoder(*, constants: bool = False, fractions: bool = True, digits: int | None = None) -> json.JSONDecoder:
    """Return a decoder that refuses equal names at every depth, with DuplicateNameError, and else raises ValueError.

    ``constants``: NaN and Infinity are read, as Python writes them. ``fractions`` False: no number has a fraction or an
    exponent. ``digits``: an integer has at most so many.
    """
    settings: dict[str, Any] = {"object_pairs_hook": _unique}
    if not constants:
        settings["parse_constant"] = _refuse_constant
    if not fractions:
        settings["parse_float"] = _refuse_fraction
    if digits is not None:

        def integer(text: str) -> int:
            if len(text) > digits:
                raise ValueError(f"it holds an integer of {len(text)} digits; at most {digits} are read")
            return int(text)

        settings["parse_int"] = integer
    return json.JSONDecoder(**settings)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    members = dict(pairs)
    if len(members) != len(pairs):
        seen: set[str] = set()
        raise DuplicateNameError(next(name for name, _ in pairs if name in seen or seen.add(name)))  # type: ignore[func-returns-value]
    return members


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


def _refuse_fraction(number: str) -> Any:
    raise ValueError(f"{number[:20]} is no whole number")
