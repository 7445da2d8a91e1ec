"""Plain lines on a terminal of 80 columns: none is longer, and no word is broken at its edge."""

from __future__ import annotations

import fcntl
import os
import pty
import struct
import termios
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from hypothesis import given
from hypothesis import strategies as st

from teds_provision.cli.context import folded
from tests.terminal import on_terminal

COLUMNS = 80


@contextmanager
def terminal(columns: int) -> Iterator[TextIO]:
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    with open(theirs, "w") as stream:
        yield stream
    os.close(ours)


def test_an_error_and_its_hint_are_broken_between_words(home: Path) -> None:
    """A word in the middle of a line went on in the next one."""
    words = (
        "provision",
        "--watch",
        "--name",
        "the same name for every board of this long watch",
        "--profile",
        "load-cell",
    )
    lines = on_terminal(home, *words, columns=COLUMNS).screen.splitlines()
    assert lines[0].startswith("Error: Every node would get the name")
    assert len(lines) > 2, lines
    assert max(map(len, lines)) <= COLUMNS, lines
    assert "Use {uuid} or {n} in --name, or list the boards in a sheet: --batch FILE." in " ".join(
        line.strip() for line in lines
    )


def test_what_goes_into_a_pipe_is_one_line() -> None:
    with open(os.devnull, "w") as pipe:
        assert folded("word " * 40, pipe) == "word " * 40


def test_lines_that_continue_stand_under_their_beginning() -> None:
    with terminal(40) as stream:
        assert folded("  → Hold the node's antenna flat on the reader, or say --timeout.", stream) == (
            "  → Hold the node's antenna flat on the\n    reader, or say --timeout."
        )
        assert folded("  a  table's  row", stream) == "  a  table's  row"


def test_a_command_that_is_shown_is_copied_whole() -> None:
    command = f"teds-provision whitelist add 8d4d9da65281f7000000 --fingerprint {'ab' * 32}"
    with terminal(COLUMNS) as stream:
        assert folded(f"  → Add --yes, or: {command}", stream).splitlines() == ["  → Add --yes, or:", f"    {command}"]


@given(st.lists(st.text("abcé ", min_size=1, max_size=70), min_size=1, max_size=20))
def test_no_word_is_lost_or_broken(words: list[str]) -> None:
    with terminal(COLUMNS) as stream:
        lines = folded(" ".join(words), stream).splitlines()
    assert " ".join(lines).split() == " ".join(words).split()
    assert all(len(line) <= COLUMNS for line in lines)


def test_of_two_commands_in_a_line_the_first_begins_the_part_that_stays_whole() -> None:
    text = "  → Say it anew: teds-provision log --why 'as in: teds-provision nodes' --since yesterday"
    with terminal(40) as stream:
        assert folded(text, stream).splitlines() == [
            "  → Say it anew:",
            "    teds-provision log --why 'as in: teds-provision nodes' --since yesterday",
        ]
