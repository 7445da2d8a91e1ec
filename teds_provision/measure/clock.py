"""Node ticks to host time: an estimate, a bound, and detection of a dishonest clock (operation.md section 5).

Two kinds of evidence. A Clock *exchange* limits the offset to an interval that delay can only widen. An *arrival*
proves that a sample was taken before it came: an upper limit, whose lower hull over time follows the skew. The estimate
is a line through the exchanges (of the hull before there are enough of them), kept inside what the evidence allows. A
refit never steps: the difference is spread over SLEW seconds, so time never goes back.

Host time is CLOCK_MONOTONIC in nanoseconds. :class:`HostClock` converts it by one offset until the system's clock is
set: then all stamps change at once, and every recorder begins a new part.
"""

from __future__ import annotations

import itertools
import math
import operator
import time
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np

from teds_provision.arrays import NDArray
from teds_provision.protocol.operation.subscription import TickBounds

OWN_DRIFT = 50.0  # ppm by which the host's clock may be off, added to the node's
NODE_DRIFT = 100.0  # ppm, until the node has reported its own
AT_FIRST = 5  # exchanges at the start: a single one may have had a long delay
EXCHANGES = 64  # exchanges kept: three and a half minutes at one each 3.3 s
WINDOW = 30_000_000_000  # ns of arrivals in the hull
BUCKET = 50_000_000  # ns; the best arrival represents each bucket
REFIT_AFTER = 10  # buckets
SLEW = 1_000_000_000  # ns over which a refit's difference is phased in
SPAN_OF_A_HULL = 2_000_000_000  # ns of arrivals that are needed to estimate skew
END_OF_TICKS = 1 << 63  # 292 years of ns since the node's start: later ticks are impossible
ANY_TICK = TickBounds(-(1 << 64), 1 << 64)  # without evidence
STEP = 1e-3  # seconds: a smaller change of the system's clock does not count as a step, and is within the bound
SPAN_OF_EXCHANGES = 60_000_000_000  # ns of exchanges from which they estimate skew better than arrivals


@dataclass(frozen=True)
class Exchange:
    """One Clock command: request left at ``asked`` (its first copy), reply whole at ``answered`` (host, monotonic ns).

    ``received`` and ``sent`` are the node's ticks, ``step`` its clock's step in ns, ``drift`` its bound in ppm.
    """

    asked: int
    answered: int
    received: int
    sent: int
    step: int
    drift: int

    @property
    def offset(self) -> float:
        """Host minus node, ns."""
        return ((self.asked - self.received) + (self.answered - self.sent)) / 2

    @property
    def error(self) -> float:
        """Bound of the offset's error at the moment of the exchange, ns."""
        return ((self.answered - self.asked) - (self.sent - self.received)) / 2 + self.step

    @property
    def tick(self) -> int:
        """The moment of the exchange on the node's clock."""
        return (self.received + self.sent) // 2


class ClockMap:
    """Ticks of one node in one session to host time. Not thread-safe.

    ``lie`` is empty, or why this clock cannot be believed; then stamps go on, and the data are to be marked.
    """

    def __init__(self, own_drift: float = OWN_DRIFT) -> None:
        self.lie = ""
        self._own = own_drift
        self._rate = (own_drift + NODE_DRIFT) / 1e6  # growth of uncertainty, in ns per ns of age
        # The last EXCHANGES. Plain numbers save memory: a station has these for each of its nodes.
        self._ticks = array("q", [0]) * EXCHANGES  # as long from the start as they ever are
        self._offsets, self._errors = array("d", [0.0]) * EXCHANGES, array("d", [0.0]) * EXCHANGES
        self._exchanges = 0  # how many there were; each goes into the place of the oldest
        self._hull = LowerHull()
        # bounds that follow from the evidence, at tick `_when`
        self._low, self._high, self._when = -math.inf, math.inf, 0
        self._origin = 0  # tick to which the line's offset applies
        self._offset = 0.0
        self._skew = 0.0
        self._residue = 0.0  # the part of the last refit that is not phased in yet
        self._refitted = 0  # tick of that refit
        self._known = False
        self._handed_out = False  # True if stamps were given out: until then a refit may step

    @property
    def known(self) -> bool:
        """True if there is any evidence yet."""
        return self._known

    def exchange(self, exchange: Exchange) -> bool:
        """Take an exchange; False if the clock is dishonest (``lie`` has the reason).

        It moves no stamp if there is better.
        """
        if exchange.sent >= END_OF_TICKS:
            self.lie = "the node claims to have run for centuries"
            return False
        if exchange.sent < exchange.received:
            self.lie = "by its own clock, the node replied before it received the request"
        elif (
            exchange.sent - exchange.received
            > (exchange.answered - exchange.asked) * (1 + exchange.drift / 1e6) + 2 * exchange.step
        ):
            self.lie = "the node claims that its reply took longer than the whole exchange"
        else:
            if (exchange.drift + self._own) / 1e6 > self._rate:
                self._rate = (exchange.drift + self._own) / 1e6
                self._low, self._high = -math.inf, math.inf  # the old bounds assumed a better clock
            low, high = self._limits(exchange.tick)
            if exchange.offset - exchange.error > high or exchange.offset + exchange.error < low:
                self.lie = "two exchanges contradict each other: the node's clock was set or runs at the wrong speed"
                return False
            self._keep(exchange)
            self._narrow(exchange.tick, exchange.offset - exchange.error, exchange.offset + exchange.error)
            self._refit(exchange.tick)
            return True
        # stamps are still needed: until a sample arrives, the end of the reply is the only evidence
        if not self._known:
            self._origin, self._offset = exchange.sent, float(exchange.answered - exchange.sent)
        return False

    def _keep(self, exchange: Exchange) -> None:
        place = self._exchanges % EXCHANGES
        self._ticks[place], self._offsets[place], self._errors[place] = exchange.tick, exchange.offset, exchange.error
        self._exchanges += 1

    def arrival(self, tick: int, host: int) -> None:
        """Take a sample's tick and when the message that held it had come (host, monotonic ns)."""
        upper = host - tick
        # As in _narrow, with only an upper limit.
        age = tick - self._when
        if age > 0:
            doubt = self._rate * age
            self._low -= doubt
            self._high += doubt
            self._when, age = tick, 0
        self._high = min(self._high, upper - self._rate * age)
        if self._hull.add_arrival(tick, upper) and self._hull.count % REFIT_AFTER == 1:
            self._refit(tick)

    def host(self, ticks: NDArray[np.uint64]) -> NDArray[np.float64]:
        """Return the host times (monotonic, seconds) of ticks."""
        self._handed_out = True
        signed = ticks.astype(np.int64)
        slope: NDArray[Any] = self._offset + self._skew * (signed - self._origin)
        if self._residue:
            slope += self._residue * np.clip(1.0 - (signed - self._refitted) / SLEW, 0.0, 1.0)
        # Whole nanoseconds first: as floats, a tick of months and an offset of years would lose microseconds.
        whole: NDArray[np.float64] = (signed + np.rint(slope).astype(np.int64)) / 1e9
        return whole

    def host_of(self, tick: int) -> float:
        """Return the host time (monotonic, seconds) of one tick."""
        return float(self.host(np.array([tick], dtype=np.uint64))[0])

    def tick_at(self, host: int) -> int:
        """Return the node's tick at a host time (monotonic ns), by the present line."""
        guess = host - round(self._offset)
        return host - round(self._line(guess))

    def ticks_at(self, host: int) -> TickBounds:
        """Return the bounds of the node's tick at a host time (monotonic ns), by all evidence."""
        ahead = self.lead_bounds(host)
        return TickBounds(max(0, host + ahead.low), host + ahead.high)

    def lead_bounds(self, host: int) -> TickBounds:
        """Return the bounds by which the node's tick may be ahead of a host time (monotonic ns) at that time."""
        # The tick itself comes from the line; skew would change this uncertainty by only some ns in a minute.
        doubt = self._rate * abs(host - self._offset - self._when) + 1.0
        low, high = self._low - doubt, self._high + doubt
        if low == -math.inf or high == math.inf:
            return ANY_TICK
        return TickBounds(-math.ceil(high), 1 - math.floor(low))

    def line(self, first: int, last: int) -> tuple[int, float, float]:
        """Return a line: host time of a tick (monotonic ns), host ns per node ns, and the bound.

        The bound is of the error of this line for any tick from ``first`` to ``last``, in seconds; infinite without an
        exchange.
        """
        self._handed_out = True
        rate = 1.0 + self._skew
        if self._residue and 0 <= first - self._refitted < SLEW:
            rate -= self._residue / SLEW
        begin = round(self._line(first))
        end = begin + (rate - 1.0) * (last - first)
        upper, lower = (begin, end) if begin > end else (end, begin)
        doubt = self._rate * max(abs(first - self._when), abs(last - self._when))
        bound = max(self._high + doubt - lower, upper - self._low + doubt, 0.0) / 1e9
        return first + begin, rate, bound

    def _line(self, tick: int) -> float:
        line = self._offset + self._skew * (tick - self._origin)
        if not self._residue or tick - self._refitted >= SLEW:
            return line
        return line + self._residue * min(1.0 - (tick - self._refitted) / SLEW, 1.0)

    def _limits(self, tick: int) -> tuple[float, float]:
        """Return the offsets that all evidence allows at a tick."""
        doubt = self._rate * abs(tick - self._when)
        return self._low - doubt, self._high + doubt

    def _narrow(self, tick: int, low: float, high: float) -> None:
        """Narrow the bounds by the evidence of a tick; the known bounds widen with age, and the narrower ones count."""
        now = max(tick, self._when)
        known, new = self._rate * (now - self._when), self._rate * (now - tick)
        self._low = max(self._low - known, low - new)
        self._high = min(self._high + known, high + new)
        self._when = now

    def _refit(self, tick: int) -> None:
        before = self._line(tick) if self._handed_out else None
        offset, skew = self._by_exchanges(tick) if self._exchanges else self._by_arrivals(tick)
        low, high = self._limits(tick)
        self._origin, self._offset, self._skew = tick, float(min(max(offset, low), high)), skew
        self._residue, self._refitted = 0.0 if before is None else before - self._offset, tick
        self._known = True

    def _by_exchanges(self, tick: int) -> tuple[float, float]:
        """Return the middle of what all exchanges allow, at most what the arrivals do; (offset at tick, skew).

        Delay only ever widens an exchange, on one side or the other. So the quickest request of all is better evidence
        than the mean of many, and so is the quickest reply. Their limits are carried to ``tick`` along the skew, whose
        uncertainty weakens old ones.

        Plain numbers: arrays of another size after each exchange stay in the C library's cache of each node's thread.
        """
        kept = min(self._exchanges, EXCHANGES)
        base, errors = self._offsets[(self._exchanges - 1) % EXCHANGES], self._errors[:kept]
        at = [float(moment - tick) for moment in self._ticks[:kept]]
        offsets = [offset - base for offset in self._offsets[:kept]]
        best, span = min(errors), max(at) - min(at)
        edge, skew = self._by_arrivals(tick)
        if len(at) >= 4 and span >= SPAN_OF_EXCHANGES:
            skew = self._skew_of(at, offsets, [error - 0.9 * best + 1_000.0 for error in errors])
        # The longer the time seen, the better the skew is known; its error is that of the best exchange over that time.
        widening = min(self._rate * SPAN_OF_A_HULL, best) / max(self._hull.span, span, SPAN_OF_A_HULL)
        low, high = -math.inf, math.inf
        for moment, offset, error in zip(at, offsets, errors, strict=True):
            carried, widened = offset - skew * moment, error + widening * abs(moment)
            low, high = max(low, carried - widened), min(high, carried + widened)
        middle = base + (low + high) / 2
        return (min(middle, edge) if self._hull.count else middle), skew

    def _skew_of(self, at: list[float], offsets: list[float], doubts: list[float]) -> float:
        """Return the skew of a weighted line through exchanges, held within the drift."""
        # A round trip longer than the quickest one had a delay in one direction or the other: weak evidence.
        weights = [1.0 / doubt**2 for doubt in doubts]
        whole = sum(weights)
        middle = sum(map(operator.mul, weights, at)) / whole
        level = sum(map(operator.mul, weights, offsets)) / whole
        apart = [moment - middle for moment in at]
        pulls = list(map(operator.mul, weights, apart))
        rise = sum(pull * (offset - level) for pull, offset in zip(pulls, offsets, strict=True))
        skew: float = rise / sum(map(operator.mul, pulls, apart))
        return min(max(skew, -self._rate), self._rate)

    def _by_arrivals(self, tick: int) -> tuple[float, float]:
        """Return the edge of the lower hull over the middle of the window; (offset at tick, skew)."""
        hull = self._hull.points()
        if not hull:
            return 0.0, 0.0
        if hull[-1][0] - hull[0][0] < SPAN_OF_A_HULL:
            return float(min(upper for _, upper in hull)), 0.0
        middle = (hull[0][0] + hull[-1][0]) / 2
        for (left, low), (right, high) in itertools.pairwise(hull):
            if right >= middle:
                skew = min(max((high - low) / (right - left), -self._rate), self._rate)
                return low + skew * (tick - left), skew
        raise AssertionError("a hull spans its middle")


class LowerHull:
    """The lower hull of arrivals (tick, host - tick) over the last WINDOW and a little more, a point at a time.

    The best arrival of each BUCKET represents it. Old ones are removed a tenth of the window at a time: then the hull
    is computed again, and not for every point. ``count`` is how many buckets there were.
    """

    def __init__(self) -> None:
        self.count = 0
        self._ticks, self._uppers = array("q"), array("q")  # of closed buckets; a fast stream has some hundred
        self._best = (0, 0)  # of the open bucket, which exists if ``count`` is not 0
        self._end = 0  # tick at which the open bucket ends
        self._hull: list[tuple[int, int]] = []

    def add_arrival(self, tick: int, upper: int) -> bool:
        """Take an arrival; whether it begins a new bucket."""
        if tick >= END_OF_TICKS:
            return False
        if tick < self._end:
            # An arrival of another stream may be a little older than the open bucket; then it is ignored.
            if upper < self._best[1] and tick >= self._end - BUCKET:
                self._best = (tick, upper)
            return False
        if self.count:
            self._ticks.append(self._best[0])
            self._uppers.append(self._best[1])
            _extend(self._hull, self._best)
        if self._ticks and self._ticks[0] < tick - WINDOW - WINDOW // 10:
            kept = next((place for place, closed in enumerate(self._ticks) if closed >= tick - WINDOW), None)
            del self._ticks[:kept], self._uppers[:kept]
            self._hull = []
            for point in zip(self._ticks, self._uppers, strict=True):
                _extend(self._hull, point)
        self._best, self._end = (tick, upper), (tick // BUCKET + 1) * BUCKET
        self.count += 1
        return True

    @property
    def span(self) -> int:
        """Ticks (ns) from the oldest arrival to the newest bucket."""
        return self._best[0] - self._ticks[0] if self._ticks else 0

    def points(self) -> list[tuple[int, int]]:
        """Return the hull's corners, oldest first."""
        hull = list(self._hull)
        if self.count:
            _extend(hull, self._best)
        return hull


def _extend(hull: list[tuple[int, int]], point: tuple[int, int]) -> None:
    """Add a point to the right of a lower hull: corners that then lie above it go."""
    x, y = point
    while len(hull) > 1 and (hull[-1][1] - hull[-2][1]) * (x - hull[-2][0]) >= (y - hull[-2][1]) * (
        hull[-1][0] - hull[-2][0]
    ):
        hull.pop()
    hull.append(point)


@dataclass(frozen=True)
class WallClock:
    """Monotonic to unix seconds, read once, to ``error`` seconds."""

    offset: float
    error: float = 0.0

    @classmethod
    def now(cls, readings: int = 9) -> WallClock:
        """Return the narrowest of a few readings, so that an interruption between the two clocks does not count."""
        found = []
        for _ in range(readings):
            before = time.monotonic_ns()
            wall = time.time_ns()
            after = time.monotonic_ns()
            found.append((after - before, wall - (before + after) / 2))
        width, offset = min(found)
        return cls(offset / 1e9, width / 2e9)

    def unix(self, monotonic: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Unix seconds for monotonic ones."""
        return monotonic + self.offset


class HostClock:
    """The wall clock of one measurement: steady, until the system's clock is set.

    ``number`` counts how often that happened; each block records by which one it is dated. ``apart`` are seconds by
    which the system's clock differs from this one without being a step: they belong to the bound of a stamp's error.
    One thread looks and sets; any thread reads :attr:`present`.
    """

    def __init__(self, wall: WallClock | None = None) -> None:
        self._walls = [wall or WallClock.now()]
        self.present: tuple[int, float] = 0, self._walls[0].offset
        self.apart = 0.0

    def was_set(self) -> bool:
        """Return True if the system's clock was set by more than STEP since; costs a microsecond if it was not."""
        return self._differs(WallClock.now(1)) and self._differs(WallClock.now())

    def _differs(self, wall: WallClock) -> bool:
        apart = max(0.0, abs(wall.offset - self.present[1]) - wall.error)
        if apart > STEP:
            return True
        self.apart = apart
        return False

    def set_anew(self) -> float:
        """Follow the system's clock; gives the seconds by which it was put forward."""
        self._walls.append(WallClock.now())
        before, self.present = self.present, (len(self._walls) - 1, self._walls[-1].offset)
        self.apart = 0.0
        return self.present[1] - before[1]

    def since(self, number: int) -> float:
        """Return the seconds to add to a stamp that was made by an earlier setting."""
        return self.present[1] - self._walls[number].offset

    def now(self) -> float:
        """Return unix seconds by this clock."""
        return time.monotonic() + self.present[1]


class MonotonicStamps:
    """Keeps the stamps of one stream ascending, even after a refit."""

    def __init__(self) -> None:
        self._last = -np.inf

    def __call__(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the times, each at least as late as the one before it."""
        held: NDArray[np.float64] = np.maximum(np.maximum.accumulate(times), self._last)
        if len(held):
            self._last = float(held[-1])
        return held

    def stamp_line(self, times: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the same for at least one time, all on a straight line: mostly there is nothing to do."""
        if times[-1] >= times[0] >= self._last:
            self._last = float(times[-1])
            return times
        return self(times)
