"""Text that others wrote, sanitized for a terminal: names from nodes, tags and files cannot control it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from teds_provision.lazy import late

if TYPE_CHECKING:
    import json
else:
    json = late("json")


def printable(text: str) -> str:
    """Return a node's name without the characters that control a terminal or reverse the direction of text."""
    if text.isprintable():
        return text
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)


def sanitize(text: str) -> str:
    """Return text for a terminal without control characters of others; line breaks and tabs stay."""
    if text.isprintable():
        return text
    return "".join(character if character.isprintable() or character in "\n\t" else "?" for character in text)


def sanitize_json(text: str) -> str:
    """Return JSON with every unprintable character escaped: same meaning, and no control of the terminal.

    JSON itself escapes only what is below U+0020; a terminal also obeys U+009B, and U+202E reverses what people read.
    """
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() or character == "\n" else json.dumps(character)[1:-1] for character in text
    )


def counted(number: int, noun: str, plural: str = "") -> str:
    """Return a number with its noun: ``1 entry``, ``2 entries``; ``plural`` if an s is not enough."""
    return f"{number} {noun if number == 1 else plural or f'{noun}s'}"


def by_name(name: str | None, uuid: str) -> tuple[object, ...]:
    """Sort key of a node in lists for people: by name, ``arm 2`` before ``arm 10``; nodes without one last, by UUID."""
    parts = re.split(r"(\d+)", (name or "").casefold())
    return (not name, [int(part) if part.isdecimal() else part for part in parts], uuid)
