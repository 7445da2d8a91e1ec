"""Writes a trace while commands run: each record reaches the file at once, and a full disk affects no command."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Final

from teds_provision.errors import BadDataError, StoreError
from teds_provision.files import PRIVATE, open_to_read, require_new
from teds_provision.links.ports import Direction
from teds_provision.trace import pcapng
from teds_provision.trace import record as line_form
from teds_provision.trace.frames import can_words, nfc_words
from teds_provision.trace.pcapng import is_pcapng, read_pcapng
from teds_provision.trace.record import Record, is_lines, read_lines

PCAPNG = ".pcapng"


def open_trace(path: Path, notify: Callable[[str], None]) -> Recorder:
    """Make the file of a trace, mode 0600, never over another one; ``notify`` receives the notice about a full disk.

    Raises UsageError if ``path`` exists, NotFoundError if its folder is missing, else StoreError.
    """
    require_new(path)
    try:
        descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC, PRIVATE)
    except OSError as error:
        raise StoreError(
            f"The trace {path} cannot be written: {error.strerror}.", hint="Choose another file for --trace."
        ) from error
    return Recorder(path, descriptor, notify)


class Recorder:
    """An open trace; see ``links.ports.Trace``. Thread-safe.

    ``failure`` is why it is incomplete, "" if it is complete.
    """

    def __init__(self, path: Path, descriptor: int, notify: Callable[[str], None]) -> None:
        self.path, self.failure = path, ""
        self._descriptor, self._notify = descriptor, notify
        self._lock = threading.Lock()
        form = pcapng if path.suffix == PCAPNG else line_form
        self._encode = pcapng.block if form is pcapng else line_form.line
        self._write(form.head())
        self.is_empty = True
        """No frame was written down yet."""

    def frame(
        self,
        link: str,
        direction: Direction,
        octets: bytes,
        *,
        identifier: int | None = None,
        fd: bool = False,
        at: float | None = None,
    ) -> None:
        """Record a frame as the link carried it.

        ``at`` is its arrival in seconds of ``time.monotonic()``, None for now.
        """
        moment = time.time() - (0.0 if at is None else time.monotonic() - at)
        words = can_words(identifier, octets) if identifier is not None else ""
        words = nfc_words(octets, direction) if link in ("nfc", "pcsc") else words
        self._put(Record(moment, direction, link, "frame", octets, words, identifier=identifier, fd=fd))

    def message(
        self,
        link: str,
        direction: Direction,
        octets: bytes,
        words: str,
        *,
        uuid: bytes,
        sealed: bool = False,
        opened: bytes | None = None,
    ) -> None:
        """Record a whole command or reply with its description, and its plain form if it was sealed."""
        text = f"{words}, not opened" if sealed and opened is None else words
        self._put(
            Record(time.time(), direction, link, "message", octets, text, opened=opened, sealed=sealed, uuid=uuid.hex())
        )

    def close(self, *, keep_empty: bool = True) -> None:
        """End the trace; never raises. Without ``keep_empty`` a file without a frame is removed."""
        with self._lock:
            if self._descriptor >= 0:
                if self.is_empty and not keep_empty:
                    with suppress(OSError):
                        self.path.unlink()
                os.close(self._descriptor)
                self._descriptor = -1

    def _put(self, record: Record) -> None:
        if not self.failure:
            self.is_empty = False
            self._write(self._encode(record))

    def _write(self, octets: bytes) -> None:
        """Write whole; what a disk does not take ends the trace, not the command that is traced."""
        with self._lock:
            if self._descriptor < 0 or self.failure:
                return
            try:
                rest = memoryview(octets)
                while rest:
                    rest = rest[os.write(self._descriptor, rest) :]
                return
            except OSError as error:
                self.failure = error.strerror or "it failed"
        self._notify(f"The trace {self.path} ends here: {self.failure}. The command goes on.")


# Reads traces in either form, and captures of CAN frames by other programs.

_MOST_OCTETS: Final = 1 << 30
_HEAD_OCTETS: Final = 64


def read_trace(path: Path) -> Iterator[Record]:
    """Yield every record of a file.

    Raises NotFoundError, and BadDataError if it is no trace (before the first record).
    """
    with open_to_read(path) as file:
        octets = file.read(_HEAD_OCTETS)
        reading = read_lines if is_lines(octets) else read_pcapng if is_pcapng(octets) else None
        if reading is not None:
            octets += file.read(_MOST_OCTETS)
    if len(octets) > _MOST_OCTETS:
        raise BadDataError(f"{path} is larger than {_MOST_OCTETS} octets, which is too large for a trace.")
    if reading is not None:
        return reading(octets)
    raise BadDataError(
        f"{path} is not a trace.", hint="Supported: files written by --trace, or pcapng with CAN frames."
    )
