"""Plain lines on a terminal: broken between words, never inside one. A pipe gets them as they are."""

from __future__ import annotations

import os
from typing import Final, TextIO

_NARROWEST: Final = 20
_COMMAND: Final = ": teds-provision "
_HINT: Final = "→ "


def folded(text: str, stream: TextIO, *, spare: int = 0) -> str:
    """The text with no line longer than the terminal behind ``stream`` is wide, less ``spare`` columns.

    A word that is longer than that stays whole (the terminal breaks it), and so does a command line at the end of a
    sentence, which begins a line of its own: what is copied from there is what is to be run.
    """
    width = _columns(stream) - spare
    if width < _NARROWEST:
        return text
    return "\n".join(line if len(line) <= width else _fold(line, width) for line in text.split("\n"))


def _columns(stream: TextIO) -> int:
    """Columns of the terminal, 0 where there is none, or none that says."""
    try:
        return os.get_terminal_size(stream.fileno()).columns if stream.isatty() else 0
    except (OSError, ValueError):
        return 0


def _fold(line: str, width: int) -> str:
    lead = " " * (len(line) - len(line.lstrip(" ")))
    said = line[len(lead) :]
    later = lead + " " * len(_HINT) if said.startswith(_HINT) else lead
    at = said.find(_COMMAND)
    words = said.split(" ") if at < 0 else [*said[: at + 1].split(" "), said[at + 2 :]]
    lines, current = [], lead + words[0]
    for word in words[1:]:
        if len(current) + 1 + len(word) <= width:
            current += f" {word}"
        else:
            lines.append(current.rstrip(" "))
            current = later + word
    return "\n".join([*lines, current])
