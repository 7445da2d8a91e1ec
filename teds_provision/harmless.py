"""Text that others wrote, made harmless for a terminal: names from nodes, tags and files steer nothing."""

from __future__ import annotations


def printable(text: str) -> str:
    """A name as a node gives it, without the characters that steer a terminal."""
    return "".join(character if character.isprintable() else "\N{REPLACEMENT CHARACTER}" for character in text)
