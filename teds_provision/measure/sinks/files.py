"""Files of a recorder: never overwritten, each complete in itself, whole lines and records only.

Data reach the file within FLUSH, so a kill -9 costs no more than that; the file goes to the disk itself once a second
(power loss). If the disk fills up, the file is cut back to the last whole piece, values are counted as dropped, and the
next part begins as soon as there is room, with a note of what is missing. When the system's clock is set, the next part
begins too, and both contain a note.
"""

from __future__ import annotations

import errno
import os
import time
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from teds_provision.errors import StoreError, TedsProvisionError
from teds_provision.files import sync_folder
from teds_provision.measure.blocks import Block, ChannelFacts, ClockSet, NodeReport, Note, StationFacts
from teds_provision.measure.sinks.base import Item, ThreadedSink, as_sink_failure
from teds_provision.measure.sinks.json_events import iso
from teds_provision.portable import CLOSING, lock

FLUSH = 0.1  # seconds for which octets may remain in this process
SYNC = 1.0  # seconds for which they may remain in the system's cache
PIECE = 1 << 18  # most octets that are written at once
PARTS = 100_000
LARGEST_PART = 1 << 30  # octets; then the next part begins
FULL = frozenset({errno.ENOSPC, errno.EDQUOT})
ROOM = 1 << 20  # octets that must be free before a part is begun on a disk that was full
AGAIN = 1.0  # seconds between checks for free space


class Part:
    """One file that grows by whole pieces; made new, mode 0644 less the umask, and locked as long as it is written."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | CLOSING, 0o644)
        with suppress(OSError):  # some network folders have no locks
            lock(self._file)
        try:
            sync_folder(path.parent)
        except OSError:
            os.close(self._file)
            path.unlink(missing_ok=True)
            raise
        self.size = 0
        self.lost = 0  # values that are not in the file after an error
        self._waiting: list[tuple[bytes, int]] = []
        self.waiting_octets = 0
        self._synced = self._flushed = time.monotonic()

    def add(self, piece: bytes, values: int = 0) -> None:
        """Take a whole piece (lines, a record) of so many values; it is written with the next flush. Raises OSError."""
        self._waiting.append((piece, values))
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
        """Write what waits; if not all of it goes, the file is cut back to whole pieces and OSError raised."""
        self._flushed = time.monotonic()
        if not self._waiting:
            return
        pieces, self._waiting, self.waiting_octets = self._waiting, [], 0
        octets = b"".join([piece for piece, _ in pieces])
        done = 0
        try:
            while done < len(octets):
                done += os.write(self._file, octets[done:])
        except OSError:
            whole = 0
            for count, (piece, _) in enumerate(pieces):
                if whole + len(piece) > done:
                    self.lost += sum(values for _, values in pieces[count:])
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

    def abandon(self) -> int:
        """Close it as it is; values that were added and are not in it."""
        os.close(self._file)
        return self.lost + sum(values for _, values in self._waiting)


class FileSink(ThreadedSink):
    """A recorder over parts: ``run.csv``, then ``run.2.csv`` if another one is needed or the first exists."""

    recorder = True

    def __init__(self, path: Path) -> None:
        super().__init__(str(path))
        self._path = path
        self._parts: list[Path] = []
        self._part: Part | None = None
        self.station = StationFacts("")
        self.facts: dict[tuple[str, int], ChannelFacts] = {}
        # while the disk is full: since when (unix), values dropped, the reason
        self._full: tuple[float, int, str] | None = None
        self._tried = 0.0
        self._gaps: list[str] = []
        self._clock_sets_due: list[ClockSet] = []  # arrived while no part could be written
        self.reports: dict[str, NodeReport] = {}
        """The newest of each node."""

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
        self.facts = {channel_facts.key: channel_facts for channel_facts in facts}
        try:
            self._part = self._next_part()
        except OSError as error:
            raise as_sink_failure(error, self.name) from error

    def _learn(self, facts: tuple[ChannelFacts, ...]) -> tuple[ChannelFacts, ...]:
        """Keep the facts; gives those that are new or other than before."""
        changed = tuple(channel_facts for channel_facts in facts if self.facts.get(channel_facts.key) != channel_facts)
        self.facts.update((facts.key, facts) for facts in changed)
        return changed

    def _next_part(self) -> Part:
        for number in range(1, PARTS + 1):
            path = self._path if number == 1 else self._path.with_suffix(f".{number}{self._path.suffix}")
            try:
                part = Part(path)
            except FileExistsError:
                continue
            self._parts.append(path)
            return part
        raise TedsProvisionError(f"There are {PARTS} parts of {self._path} already.", hint="Name another file.")

    def copy(
        self, entries: Iterable[Item | Note], facts: tuple[ChannelFacts, ...], station: StationFacts
    ) -> list[Path]:
        """Write what was recorded before, on the caller's thread: without waiting, and an error ends it.

        Returns the files, whole and closed. Raises OSError, and TedsProvisionError if the first cannot be made.
        """
        self._prepare(facts, station)
        try:
            self._begin()
            for entry in entries:
                if isinstance(entry, Note):
                    self._note(entry.at, entry.text)
                    continue
                if isinstance(entry, NodeReport):
                    first = entry.uuid not in self.reports
                    self.reports[entry.uuid] = entry
                    if first and entry.samples:
                        self._write_counts(entry)
                        continue
                self._process_item(entry)
            self._close_part()
        finally:
            part, self._part = self._part, None
            if part is not None:
                part.abandon()
        return self._parts

    # -- full disk, and changes of the system's clock ----------------------------------------------------------------

    def _note(self, at: float, text: str) -> None:
        """Write words about the recording into the part, as its format has them."""

    def _write_counts(self, report: NodeReport) -> None:
        """Write what was counted of a node by now, as the beginning of a part needs it (summary.py)."""
        self._process_item(report)

    def _guarded_begin(self) -> None:
        try:
            self._begin()
        except OSError as error:
            self._wait_for_room(error)

    def _guarded_item(self, item: Item) -> None:
        if isinstance(item, NodeReport):
            self.reports[item.uuid] = item
        if self._full is not None:
            self._miss(item)
            return
        try:
            if isinstance(item, ClockSet):
                # The clock was set: begin another part, with this recording's start corrected to the new clock.
                self._note(item.time - item.by, item.words)
                self.station = replace(self.station, started=self.station.started + item.by)
                self._new_part()
                self._note(item.time, item.words)
            else:
                self._process_item(item)
        except OSError as error:
            self._wait_for_room(error)

    def _guarded_idle(self, now: float) -> None:
        if self._full is not None:
            if now - self._tried >= AGAIN:
                self._tried = now
                self._try_again()
            return
        try:
            self._idle(now)
        except OSError as error:
            self._wait_for_room(error)

    def _miss(self, item: Item) -> None:
        """Count an item that is dropped while the disk is full, for the next part's note."""
        if isinstance(item, Block):
            self._count(dropped=int(item.value.size))
        elif isinstance(item, tuple):
            self._learn(item)
        elif isinstance(item, ClockSet):
            self.station = replace(self.station, started=self.station.started + item.by)
            self._clock_sets_due.append(item)

    def _wait_for_room(self, error: OSError) -> None:
        """Give the part up and wait; raises the error if it is another one than a full disk."""
        if error.errno not in FULL:
            raise error
        before = self.stats.dropped
        self._tried = time.monotonic()
        what = "quota of the disk is used up" if error.errno == errno.EDQUOT else "disk is full"
        self._full = time.time(), before, what
        lost = self._abandon()
        self._count(written=-lost, dropped=lost)
        self._set_state("waiting", f"The {what} since {iso(self._full[0])}: nothing is recorded until space is free.")

    def _abandon(self) -> int:
        """Let the part go, and one without a whole piece altogether; how many values are lost with it."""
        part, self._part = self._part, None
        if part is None:
            return 0
        lost = part.abandon()
        if not part.size:
            with suppress(OSError):
                part.path.unlink()
            self._parts.remove(part.path)
        return lost

    def _mend(self, path: Path) -> None:
        """Make the part whole that a full disk cut off; raises OSError if the disk is full again."""

    def _try_again(self) -> None:
        """Begin the next part if there is room by now."""
        assert self._full is not None
        since, before, what = self._full
        try:
            room = os.statvfs(self._path.parent)
            if room.f_bavail * room.f_frsize < ROOM:
                return
            if self._parts:
                self._mend(self._parts[-1])
            self._part = self._next_part()
            self._begin()
            self._go_on()
            now, missing = time.time(), self.stats.dropped - before
            was = what.replace(" is ", " was ")
            gap = f"The {was} from {iso(since)} to {iso(now)}: {missing} values are not recorded."
            self._note(now, gap)
            for news in self._clock_sets_due:
                self._note(news.time, news.words)
            self.part.flush()
        except OSError as error:
            self._abandon()
            if error.errno not in FULL:
                raise
            return
        self._full, self._clock_sets_due = None, []
        self._gaps.append(gap)
        self._set_state("running", gap)

    # -- parts ---------------------------------------------------------------------------------------------------------

    def _new_part(self) -> None:
        """Close the part and begin the next one, with all that a reader needs."""
        self._close_part()
        self._part = self._next_part()
        self._begin()
        self._go_on()

    def _go_on(self) -> None:
        """Record the counts with which this part begins: those of a measurement go on from part to part."""
        for report in self.reports.values():
            self._write_counts(report)

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
        try:
            self._close_part()
        except OSError as error:
            self._wait_for_room(error)
        if self._full is not None:
            since, before, what = self._full
            missing = self.stats.dropped - before
            self._gaps.append(f"The {what} since {iso(since)}: {missing} values are not recorded.")
            if self._parts:
                with suppress(OSError):
                    self._mend(self._parts[-1])
        if self._gaps:
            text = " ".join(self._gaps[-3:])
            raise StoreError(
                f"{self.name} has {len(self._gaps)} {'gap' if len(self._gaps) == 1 else 'gaps'}. {text}",
                hint="Free some space before the next run; what was written is intact.",
            )
