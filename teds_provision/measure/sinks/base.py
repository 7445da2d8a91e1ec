"""The interface of a sink, and its thread: the measuring loop never waits for a disk, a broker or a subscriber.

A *recorder* drops nothing that the disk has room for. If it cannot keep up, the recording ends with an error that stays
in its statistics, and what was written until then is whole; while the disk is full it waits for room, counts and
reports losses (:mod:`files`). A *live* sink drops the oldest waiting block and counts it.
"""

from __future__ import annotations

import logging
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final, Literal, Protocol

from teds_provision.errors import InternalError, NotFoundError, StoreError, TedsProvisionError
from teds_provision.measure.blocks import (
    Block,
    ChannelFacts,
    ClockSet,
    GroupRows,
    NodeReport,
    SetPointCommand,
    SinkStats,
    StationFacts,
)

_log = logging.getLogger(__name__)
Item = Block | GroupRows | NodeReport | ClockSet | tuple[ChannelFacts, ...]
CommandTaker = Callable[[SetPointCommand], None]

RECORDER_WAITING = 2_000_000  # values that may be queued for a recorder: some 200 MB, 40 s at 50,000 values a second
LIVE_WAITING = 256  # items that may be queued for a live sink; the oldest are dropped
BUDGET: Final = 5000  # messages a second that one process delivered to ROS 1, ROS 2 or MQTT (docs/ros.md)
ROWS: Final = 1000  # most rows a second of an array on a topic; a recorder gets all of them
TICK = 0.05  # seconds between calls of _idle while no item arrives
LIVE_REST = 0.003  # seconds for which items gather before a live sink is woken, which costs more than an item
RECORDER_LOOKS = 0.02  # seconds between a recorder's checks of its queue
TOGETHER = 64  # most items that a recorder takes at a time
CLOSING = 30.0  # seconds for a recorder to write its queue


class Sink(Protocol):
    """Takes what is measured. ``write``, ``write_group``, ``describe`` and ``report`` return at once, from any thread.

    ``open`` raises TedsProvisionError if the sink cannot work (no folder, no library). Later failures are in
    ``stats``; the measurement goes on.
    """

    @property
    def name(self) -> str:
        """For people and events: ``run.csv``, ``ROS 1``, ``mqtt://host``."""

    @property
    def recorder(self) -> bool:
        """True for a recorder, which drops nothing while the disk has room; False for a live sink."""

    @property
    def budgeted(self) -> bool:
        """True if its messages count against the budget of those that go to ROS and MQTT."""

    @property
    def wants_rows(self) -> bool:
        """True if rows of a group are of use to it."""

    @property
    def files(self) -> tuple[str, ...]:
        """Paths that it wrote so far."""

    @property
    def stats(self) -> SinkStats:
        """Return the counters of this sink as they are now."""

    def open(self, facts: Sequence[ChannelFacts], station: StationFacts) -> None:
        """Begin; ``facts`` are those of the channels that are known by now."""

    def describe(self, facts: Sequence[ChannelFacts]) -> None:
        """Learn the facts of channels that came later, or changed (a new datasheet)."""

    def write(self, block: Block) -> None:
        """Take samples of one stream."""

    def write_group(self, rows: GroupRows) -> None:
        """Take rows of the group's grid; a sink that has no use for them ignores them."""

    def report(self, report: NodeReport) -> None:
        """Take the state of a node."""

    def clock_set(self, news: ClockSet) -> None:
        """Handle a change of the system's clock: later items follow the new one."""

    def close(self) -> None:
        """Write out what is owed, end, give back what was opened. A second call does nothing."""


class ThreadedSink(ABC):
    """A sink whose work is done by one thread; subclasses fill in four steps and the name.

    The steps are called on that thread alone, one after another: ``_begin`` before anything else, ``_process_item`` for
    each item, ``_idle`` at least every TICK, ``_finish`` at the end (also after an error of ``_process_item``).
    """

    recorder = False
    budgeted = False
    wants_rows = False  # True if the sink uses rows of a group's grid

    def __init__(self, name: str) -> None:
        self.name = name
        self._lock = threading.Condition()
        self._items: deque[tuple[float, int, Item]] = deque()
        self._owed = 0
        self._closing = False
        self._tally = SinkStats()
        self._thread: threading.Thread | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Paths that it wrote; a sink without files has none."""
        return ()

    @property
    def stats(self) -> SinkStats:
        """A snapshot of the counters."""
        with self._lock:
            return replace(self._tally)

    def open(self, facts: Sequence[ChannelFacts], station: StationFacts) -> None:
        """Do what can fail at once, then start the thread. Raises TedsProvisionError."""
        self._prepare(tuple(facts), station)
        self._thread = threading.Thread(target=self._work, name=f"sink {self.name}", daemon=True)
        self._thread.start()

    def describe(self, facts: Sequence[ChannelFacts]) -> None:
        """Queue facts that came later; they are never dropped."""
        self._put(tuple(facts), 0)

    def write(self, block: Block) -> None:
        """Queue samples of one stream."""
        self._put(block, int(block.value.size))

    def write_group(self, rows: GroupRows) -> None:
        """Queue rows of the grid."""
        if self.wants_rows:
            self._put(rows, int(rows.value.size))

    def report(self, report: NodeReport) -> None:
        """Queue the state of a node."""
        self._put(report, 0)

    def clock_set(self, news: ClockSet) -> None:
        """Queue a change of the clock."""
        self._put(news, 0)

    def close(self) -> None:
        """Let the thread write what it owes and end."""
        with self._lock:
            self._closing = True
            self._lock.notify_all()
        thread = self._thread
        if thread is not None:
            thread.join(CLOSING)
            if thread.is_alive():
                self._fail(TedsProvisionError(f"{self.name} did not finish within {CLOSING:.0f} s."))

    @abstractmethod
    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        """Check and open, on the caller's thread. Raises TedsProvisionError."""

    def _begin(self) -> None:  # noqa: B027  may be left out
        """Run the first step on the sink's own thread."""

    @abstractmethod
    def _process_item(self, item: Item) -> None:
        """Write one item."""

    def _guarded_begin(self) -> None:
        """Call ``_begin``; a sink that can outlive its failure does so here, and in the two below."""
        self._begin()

    def _guarded_item(self, item: Item) -> None:
        """Call ``_process_item``."""
        self._process_item(item)

    def _guarded_idle(self, now: float) -> None:
        """Call ``_idle``."""
        self._idle(now)

    def _idle(self, now: float) -> None:  # noqa: B027  may be left out
        """Do work that is due by the clock (time.monotonic); called at least every TICK."""

    @abstractmethod
    def _finish(self) -> None:
        """Close files and connections."""

    def _count(self, *, written: int = 0, dropped: int = 0, octets: int = 0, messages: int = 0) -> None:
        with self._lock:
            tally = self._tally
            tally.written += written
            tally.dropped += dropped
            tally.octets += octets
            tally.messages += messages

    def _set_state(self, state: Literal["running", "waiting", "ended"], detail: str = "") -> None:
        """Set the state that people see; a failure stays."""
        with self._lock:
            if self._tally.state != "failed":
                self._tally.state, self._tally.detail = state, detail

    def _fail(self, error: TedsProvisionError) -> None:
        with self._lock:
            self._tally.fail(error.message, error.hint)

    def _fail_by_bug(self, bug: Exception) -> None:
        _log.debug("Sink %s failed.", self.name, exc_info=bug)
        self._fail(
            InternalError(
                f"{self.name}: unexpected {type(bug).__name__}.", hint="This is a bug: please report it with -vv."
            )
        )

    def _put(self, item: Item, values: int) -> None:
        with self._lock:
            if self._closing or self._tally.state == "failed":
                return
            if self.recorder:
                if self._owed + values > RECORDER_WAITING:
                    # Waiting would stop the measurement, and dropping values would leave an unnoticed gap: end the
                    # recording instead.
                    self._tally.fail(
                        f"The disk is too slow: {self.name} owes {self._owed} values. The recording has ended.",
                        "Record to a faster disk, or fewer channels.",
                    )
                    self._lock.notify_all()
                    return
            elif len(self._items) >= LIVE_WAITING:
                self._drop_oldest()
            self._items.append((time.monotonic(), values, item))
            self._owed += values
            if not self.recorder:  # recorders poll: waking one for each block costs more than writing it
                self._lock.notify_all()

    def _drop_oldest(self) -> None:
        """Drop the oldest waiting samples; facts and reports stay, they are few."""
        for place, (_, values, item) in enumerate(self._items):
            if isinstance(item, Block | GroupRows):
                del self._items[place]
                self._owed -= values
                self._tally.dropped += values
                return
        self._items.popleft()

    def _next(self) -> tuple[list[Item], bool]:
        """Return what waits, or nothing after TICK; and whether all is done.

        A recorder takes several at a time; of a live sink the others may still be dropped.
        """
        with self._lock:
            if not self._items and not self._closing:
                self._lock.wait(RECORDER_LOOKS if self.recorder else TICK)
            if self._tally.state == "failed":
                self._items.clear()
                return [], True
            if not self._items:
                return [], self._closing
            count = min(len(self._items), TOGETHER if self.recorder else 1)
            taken = [self._items.popleft() for _ in range(count)]
            self._owed -= sum(values for _, values, _ in taken)
            self._tally.lag = time.monotonic() - taken[0][0]
        return [item for _, _, item in taken], False

    def _work(self) -> None:
        try:
            self._guarded_begin()
            if self.stats.state == "starting":  # a sink that waits for consumers has set its state by now
                self._set_state("running")
            self._run()
        except TedsProvisionError as error:
            self._fail(error)
        except OSError as error:
            self._fail(as_sink_failure(error, self.name))
        except Exception as bug:  # noqa: BLE001  a thread that ends unreported looks like a normal end
            self._fail_by_bug(bug)
        finally:
            self._end()

    def _run(self) -> None:
        looked = time.monotonic()
        done = False
        while not done:
            items, done = self._next()
            for item in items:
                self._guarded_item(item)
            if items and not self.recorder and not self._items and not self._closing:
                time.sleep(LIVE_REST)
            now = time.monotonic()
            if not items or now - looked >= TICK:
                self._guarded_idle(now)
                looked = now

    def _end(self) -> None:
        try:
            self._finish()
        except TedsProvisionError as error:
            self._fail(error)
        except OSError as error:
            self._fail(as_sink_failure(error, self.name))
        except Exception as bug:  # noqa: BLE001  the same
            self._fail_by_bug(bug)
        self._set_state("ended")


def as_sink_failure(error: OSError, name: str) -> TedsProvisionError:
    """Return the error for a refusal of the system."""
    import errno

    cures = {
        errno.ENOSPC: ("the disk is full", "Free some space; everything written so far is intact."),
        errno.EDQUOT: ("the disk quota is used up", "Free some space; everything written so far is intact."),
        errno.EFBIG: ("the file cannot grow any further", "Record to another disk, or in shorter runs."),
        errno.EACCES: ("permission denied", "Check the owner and mode of the folder."),
        errno.EROFS: ("the disk is read-only", "Record to another disk."),
    }
    if error.errno == errno.ENOENT:
        return NotFoundError(f"{name} cannot be written: its folder is not there.", hint="Create the folder first.")
    cause, cure = cures.get(error.errno or 0, (error.strerror or type(error).__name__, "Check the path."))
    return StoreError(f"{name} cannot be written: {cause}.", hint=cure)
