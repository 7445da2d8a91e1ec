"""Files of a recorder: never written over, each complete in itself, whole lines and records only.

What stands in the file is at most FLUSH old, so a kill -9 costs no more than that; it goes to the disk itself once a
second (power loss). If the disk fills up, the file is cut back to the last whole piece.
"""

from __future__ import annotations

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

from teds_provision.errors import TedsProvisionError
from teds_provision.files import sync_folder
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.sinks.base import ThreadedSink, as_sink_failure

FLUSH = 0.1  # seconds that a piece may wait in this process
SYNC = 1.0  # seconds that it may wait in the system's cache
PIECE = 1 << 18  # octets that are handed to the system at once, at most
PARTS = 100_000
LARGEST_PART = 1 << 30  # octets; then the next part begins


class Part:
    """One file that grows by whole pieces; made new, mode 0644 less the umask, and locked as long as it is written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        with suppress(OSError):  # some network folders have no locks
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        sync_folder(path.parent)
        self.size = 0
        self._waiting: list[bytes] = []
        self.waiting_octets = 0
        self._synced = self._flushed = time.monotonic()

    def add(self, piece: bytes) -> None:
        """Take a whole piece (lines, a record); it is written with the next flush. Raises OSError."""
        self._waiting.append(piece)
        self.waiting_octets += len(piece)
        if self.waiting_octets >= PIECE:
            self.flush()

    def look(self, now: float) -> None:
        """Flush and sync what is due. Raises OSError."""
        if now - self._flushed >= FLUSH:
            self.flush()
        if now - self._synced >= SYNC:
            os.fsync(self._file)
            self._synced = now

    def flush(self) -> None:
        """Hand over what waits; where not all of it goes, the file is cut back to whole pieces and OSError raised."""
        self._flushed = time.monotonic()
        if not self._waiting:
            return
        pieces, self._waiting, self.waiting_octets = self._waiting, [], 0
        octets = b"".join(pieces)
        done = 0
        try:
            while done < len(octets):
                done += os.write(self._file, octets[done:])
        except OSError:
            whole = 0
            for piece in pieces:
                if whole + len(piece) > done:
                    break
                whole += len(piece)
            with suppress(OSError):
                os.ftruncate(self._file, self.size + whole)
            self.size += whole
            raise
        self.size += len(octets)

    def close(self) -> None:
        """Flush, sync, close; the file is closed whatever happens. Raises OSError."""
        try:
            self.flush()
            os.fsync(self._file)
        finally:
            os.close(self._file)


class FileSink(ThreadedSink):
    """A recorder over parts: ``run.csv``, then ``run.2.csv`` where another one is needed or the first is there."""

    recorder = True

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path
        self._parts: list[Path] = []
        self._part: Part | None = None
        self.station = StationFacts("")
        self.facts: dict[tuple[str, int], ChannelFacts] = {}

    @property
    def files(self) -> tuple[str, ...]:
        """The parts, oldest first."""
        return tuple(str(path) for path in self._parts)

    @property
    def part(self) -> Part:
        """The part that is being written."""
        assert self._part is not None
        return self._part

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        self.station = station
        self.facts = {one.key: one for one in facts}
        try:
            self._part = self._next_part()
        except OSError as error:
            raise as_sink_failure(error, self.name) from error

    def _news(self, facts: tuple[ChannelFacts, ...]) -> tuple[ChannelFacts, ...]:
        """Keep the facts; gives those that are new or other than before."""
        changed = tuple(one for one in facts if self.facts.get(one.key) != one)
        self.facts.update((one.key, one) for one in changed)
        return changed

    def _next_part(self) -> Part:
        for number in range(1, PARTS):
            path = self._path if number == 1 else self._path.with_suffix(f".{number}{self._path.suffix}")
            try:
                part = Part(path)
            except FileExistsError:
                continue
            self._parts.append(path)
            return part
        raise TedsProvisionError(f"There are {PARTS} parts of {self._path} already.", hint="Name another file.")

    def _new_part(self) -> None:
        """Close the part and begin the next one, with all that a reader needs."""
        self._close_part()
        self._part = self._next_part()
        self._begin()

    def _idle(self, now: float) -> None:
        if self._part is not None:
            self._part.look(now)
            if self._part.size > LARGEST_PART:
                self._new_part()

    def _close_part(self) -> None:
        if self._part is not None:
            part, self._part = self._part, None
            part.close()

    def _finish(self) -> None:
        self._close_part()
