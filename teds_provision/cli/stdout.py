"""stdout that may be closed, full, or a pipe without a reader. None of them may undo or hide what was done.

A closed descriptor is replaced by /dev/null before a file could get its number, and be written into. Output that a full
disk refuses is dropped and recorded: the command goes on to its own end. A broken pipe raises, so that a command with
hours of output ends at once.
"""

from __future__ import annotations

import io
import os
import re
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

BROKEN_PIPE: Final = 141
_NOT_PRINTED: Final = 7
# Control characters except line breaks, tabs and ESC; zero-width and direction marks; halves of surrogate pairs.
_STEERING: Final = (
    "[\x00-\x08\x0b\x0c\x0e-\x1a\x1c-\x1f\x7f-\x9f"
    "\u200b-\u200f\u202a-\u202e\u2060-\u2064\u2066-\u206f\ufeff\ud800-\udfff]"
)


class GuardedOutput(io.FileIO):
    """Descriptor 1; ``failure`` is why output was lost, "" as long as none was."""

    failure = ""

    def write(self, octets: Any, /) -> int:
        """Write octets (bytes, a memoryview), or record why not; raises BrokenPipeError without a reader."""
        try:
            return super().write(octets)
        except BrokenPipeError:
            raise
        except OSError as error:
            self.failure = error.strerror or "it failed"
            return memoryview(octets).nbytes


class CleanText(io.TextIOWrapper):
    """Text for stdout, with escapes in place of characters that steer a terminal or reverse text.

    In JSON such an escape means the same. ESC itself stays, as colours need it: code that prints names removes it
    (:mod:`teds_provision.sanitize`), and JSON never holds it.
    """

    def write(self, text: str, /) -> int:
        """Write a text; returns its length as it was given."""
        if not text.replace("\n", "").isprintable():
            super().write(re.sub(_STEERING, lambda found: f"\\u{ord(found[0]):04x}", text))
        else:
            super().write(text)
        return len(text)


def guard() -> GuardedOutput | None:
    """Put guarded output in the place of ``sys.stdout``; None if it is not a plain descriptor (a test's own)."""
    for _ in range(3):  # the system gives the lowest free numbers, so closed ones of 0, 1 and 2 are opened first
        descriptor = os.open(os.devnull, os.O_RDWR)
        if descriptor > 2:
            os.close(descriptor)
            break
    for number, name in ((0, "stdin"), (1, "stdout"), (2, "stderr")):
        if getattr(sys, name) is None:
            plain = io.FileIO(number, "r" if number == 0 else "w", closefd=False)
            buffer = io.BufferedReader(plain) if number == 0 else io.BufferedWriter(plain)
            setattr(sys, name, io.TextIOWrapper(buffer, encoding="utf-8"))
    if not isinstance(sys.stdout, io.TextIOWrapper):
        return None
    output = GuardedOutput(1, "w", closefd=False)
    encoding = sys.stdout.encoding
    with suppress(OSError):
        sys.stdout.flush()
    # A name that the encoding lacks must not raise an error after the work is done.
    sys.stdout = CleanText(
        io.BufferedWriter(output), encoding=encoding, errors="backslashreplace", line_buffering=output.isatty()
    )
    return output


@dataclass(frozen=True)
class Purpose:
    """Purpose of a run, which decides if lost output is an error.

    ``only_shows``: it shows what is there and changes nothing. ``must_print``: without its output it has failed.
    """

    only_shows: bool
    must_print: bool


def ended(code: int, output: GuardedOutput | None, *, purpose: Callable[[], Purpose]) -> int:
    """Write out what is left and return the exit code: ``code``, or 141 for a broken pipe.

    If output was lost, and all else went well, 7 for a run that ``must_print``: a reader must not take silence for a
    result. ``purpose`` is called only if output was lost.
    """
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        silence()
        return BROKEN_PIPE
    except (OSError, ValueError):
        silence()
    if output is None or not output.failure:
        return code
    of = purpose()
    if of.only_shows or code:
        text = f"The result could not be written to stdout: {output.failure}."
    else:
        text = f"The work is done, but its result could not be written to stdout: {output.failure}."
    with suppress(OSError):
        print(f"Error: {text}", file=sys.stderr, flush=True)
    return _NOT_PRINTED if code == 0 and of.must_print else code


def silence() -> None:
    """Send what Python would still write to stdout when it ends to /dev/null."""
    with suppress(OSError, ValueError):
        devnull = os.open(os.devnull, os.O_WRONLY)
        os.dup2(devnull, 1)
        os.close(devnull)
