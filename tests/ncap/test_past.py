"""The last hour of a channel in the station's memory: bins that say what came, what was not valid, what was lost."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from itertools import accumulate, pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from teds_provision.errors import NotFoundError
from teds_provision.measure.blocks import Block, ChannelFacts
from teds_provision.ncap import history
from teds_provision.ncap.bins import Bins, FewBins
from teds_provision.ncap.history import HOUR, History
from teds_provision.teds.calibration.model import Calibration, CalibrationInput
from teds_provision.teds.certificate import CertificateReference
from teds_provision.teds.units import parse_units

NODE = "8d4d9da65281f7000000"
NOW = float(int(time.time()))


def block(
    first: float,
    values: Sequence[Sequence[float]],
    *,
    rate: float = 100.0,
    index: int = 0,
    run: int = 0,
    valid: Sequence[Sequence[bool]] | None = None,
) -> Block:
    """Samples of channels 1, 2 … from a moment on."""
    value = np.array(values, float)
    good = np.ones(value.shape, bool) if valid is None else np.array(valid)
    at = first + np.arange(len(value)) / rate
    channels = tuple(range(1, value.shape[1] + 1))
    ticks = np.arange(len(value), dtype=np.uint64)
    return Block(NODE, 1, channels, index, at, ticks, value, np.where(good, value, np.nan), good, run=run)


def ramp(past: History, first: float, seconds: int, *, rate: float = 100.0, start: int = 0) -> None:
    """One channel that counts its samples, a second a block."""
    per_second = int(rate)
    for second in range(seconds):
        at = start + second * per_second
        past.block(block(first + second, [[float(at + step)] for step in range(per_second)], rate=rate, index=at))


def test_a_second_has_its_least_its_greatest_and_its_count(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: NOW)  # which is when this module was loaded
    past = History()
    ramp(past, NOW - 10, 10)
    history = past.channel_history(NODE, 1, NOW - 600, NOW, points=3600)
    assert history["bin"] == 1.0
    assert history["time"] == [NOW - 10 + second for second in range(10)]
    assert (history["low"][3], history["high"][3], history["count"][3]) == (300.0, 399.0, 100)
    assert history["rate"] == pytest.approx(100)
    with pytest.raises(NotFoundError):
        past.channel_history(NODE, 2)


def test_the_last_minute_is_fine_and_what_is_older_is_not() -> None:
    past = History()
    ramp(past, NOW - 100, 100, rate=1000.0)
    fine = past.channel_history(NODE, 1, NOW - 2, NOW, points=3600)
    assert fine["bin"] == pytest.approx(0.01)
    assert (len(fine["time"]), fine["count"][0]) == (200, 10)
    spans = np.array(fine["high"]) - np.array(fine["low"])
    assert ((spans >= 9) & (spans <= 9 * 1.008)).all(), "rounded up, and by less than a hundredth"
    assert past.channel_history(NODE, 1, NOW - 100, NOW, points=3600)["bin"] == 1.0
    thin = past.channel_history(NODE, 1, NOW - 100, NOW, points=10)
    assert len(thin["time"]) <= 11
    assert (min(thin["low"]), max(thin["high"]), sum(thin["count"])) == (0.0, 99999.0, 100_000)


def test_gaps_invalid_and_lost_samples_are_distinguished() -> None:
    past = History()
    past.block(block(NOW - 8, [[1.0, 5.0]] * 100, index=0))
    past.block(block(NOW - 5, [[1.0, 5.0]] * 100, index=300, valid=[[False, True]] * 100))  # 200 were lost before it
    past.block(block(NOW - 4, [[1.0, 5.0]] * 100, index=900, run=1))  # begun again: nothing was lost between
    first, second = (past.channel_history(NODE, number, NOW - 60, NOW) for number in (1, 2))
    by_second = {at - NOW: place for place, at in enumerate(first["time"]) if first["bin"] == 1.0}
    if not by_second:  # the minute: in 10 ms
        first, second = (past.channel_history(NODE, number, NOW - 3000, NOW, points=3600) for number in (1, 2))
        by_second = {at - NOW: place for place, at in enumerate(first["time"])}
    assert set(by_second) == {-8, -5, -4}, "a bin in which nothing happened is left out"
    at = by_second[-5]
    assert (first["low"][at], first["high"][at], first["count"][at], first["invalid"][at], first["lost"][at]) == (
        None, None, 100, 100, 200,
    )  # fmt: skip
    assert (second["low"][at], second["invalid"][at]) == (5.0, 0)
    assert sum(first["lost"]) == 200


def test_a_clock_that_is_set_back_rewrites_that_time_and_one_set_forward_leaves_a_gap() -> None:
    past = History()
    ramp(past, NOW - 300, 100)
    past.block(block(NOW - 250, [[7.0]] * 100, run=1))  # put back by 150 s
    history = past.channel_history(NODE, 1, NOW - 3000, NOW, points=3600)
    assert history["time"][-1] == NOW - 250
    assert (history["low"][-1], history["count"][-1]) == (7.0, 100), "what the old clock called that time is gone"
    assert len(history["time"]) == 51
    past.block(block(NOW - 20, [[8.0]] * 100, run=2))
    history = past.channel_history(NODE, 1, NOW - 3000, NOW, points=3600)
    assert (len(history["time"]), history["time"][-1], history["low"][-1]) == (52, NOW - 20, 8.0)
    past.block(block(NOW + 2 * HOUR, [[9.0]] * 100, run=3))
    history = past.channel_history(NODE, 1, NOW, NOW + 3 * HOUR, points=3600)
    assert history["time"] == [NOW + 2 * HOUR], "an hour is an hour of the clock that is"
    past.block(block(NOW, [[3.0]] * 100, run=4))
    assert past.channel_history(NODE, 1, NOW - HOUR, NOW + 3 * HOUR, points=3600)["time"] == [NOW]


def test_samples_that_come_a_little_late_belong_where_they_are_dated() -> None:
    past = History()
    ramp(past, NOW - 10, 5)
    past.block(block(NOW - 6.5, [[-1.0]], index=500))
    history = past.channel_history(NODE, 1, NOW - 3000, NOW, points=3600)
    assert (history["low"][3], history["count"][3], len(history["time"])) == (-1.0, 101, 5)


@pytest.mark.parametrize(("seconds", "rate"), [(50, 100.0), (70, None)])
def test_a_channel_has_a_rate_for_a_minute_after_its_last_value(
    seconds: int, rate: float | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    past = History()
    ramp(past, NOW - 20, 20)
    monkeypatch.setattr("time.time", lambda: NOW + seconds)
    assert past.channel_history(NODE, 1)["rate"] == rate


def test_a_bin_counts_to_its_end_and_no_further() -> None:
    """One sample more than a count holds must neither begin again at 0 nor end the thread that takes them in."""
    few = FewBins(1.0, 60)
    for _ in range(300):
        few.add_one(7, 1.0, 1, 0, 0)
    assert few.between(0, 9)[3][:2, 0].tolist() == [255, 255]
    for coarse, most in ((True, 255), (False, 65535)):
        bins = Bins(1.0, 60, coarse=coarse)
        many = np.full((3, 1), most - 1)
        bins.add(np.array([7]), np.array([1.0]), np.array([2.0]), many, 0)
        for _ in range(3):
            bins.add_one(7, 1.5, 1, 1, 0)
        assert bins.between(0, 9)[3][:, 0].tolist() == [most, most, 0 if coarse else most]
        bins.add(np.array([7]), np.array([1.0]), np.array([2.0]), many, 0)
        assert bins.between(0, 9)[3][0, 0] == most


@dataclass
class _Bin:
    """Expected content of a bin."""

    segment: int
    values: list[float] = field(default_factory=list)
    counts: list[int] = field(default_factory=lambda: [0, 0, 0])


class _PlainBins:
    """Reference for the rings: a dictionary of all samples that count."""

    def __init__(self, size: int) -> None:
        self.size, self.newest = size, -1
        self.bins: dict[int, _Bin] = {}

    def add_one(self, number: int, value: float, invalid: int, lost: int, segment: int) -> None:
        """Take in a sample: bins are 1 s wide, and one that is older than 2 s means that the clock was put back."""
        if self.newest >= 0 and number < self.newest - 2:
            self.bins = {at: one for at, one in self.bins.items() if at < number}
            self.newest = number
        self.bins = {at: one for at, one in self.bins.items() if at < number or one.segment == segment}
        self.newest = max(self.newest, number)
        held = self.bins.setdefault(number, _Bin(segment))
        if not math.isnan(value):
            held.values.append(value)
        for row, more in enumerate((1, invalid, lost)):
            held.counts[row] += more
        self.bins = {at: one for at, one in self.bins.items() if at > self.newest - self.size}


_STEPS = st.one_of(st.integers(-2, 3), st.sampled_from([-9, -3, 7, 40, 60, 61, 200]))
_VALUES = st.one_of(st.floats(-1e6, 1e6, width=32), st.just(math.nan), st.sampled_from([1.0, -1.0]))


@pytest.mark.parametrize(
    "make", [lambda: Bins(1.0, 60, coarse=False), lambda: Bins(1.0, 60, coarse=True), lambda: FewBins(1.0, 60)]
)
@given(
    samples=st.lists(
        st.tuples(_STEPS, _VALUES, st.booleans(), st.sampled_from([0, 0, 0, 4]), st.sampled_from([0, 0, 0, 1])),
        max_size=120,
    )
)
@example([(0, 0.0, False, 0, 0), (0, 2369.0, False, 0, 0), (0, -1.0, False, 0, 0)])
@example([(-5, math.nan, True, 0, 0), (60, math.nan, False, 0, 0), (-9, 1.0, True, 0, 0)])
def test_bins_hold_what_a_list_of_all_samples_holds(
    make: Callable[[], Bins | FewBins], samples: list[tuple[int, float, bool, int, int]]
) -> None:
    bins, plain, at, segment = make(), _PlainBins(60), 100, 0
    for step, value, invalid, lost, other in samples:
        at, segment = max(0, at + step), segment + other
        for one in (bins, plain):
            one.add_one(at, value, int(invalid), lost, segment)
    numbers, low, high, counts = bins.between(0, at + 1000)
    fine = isinstance(bins, Bins) and not bins.coarse
    assert numbers.tolist() == sorted(plain.bins)
    assert bins.segments_of(numbers).tolist() == [plain.bins[number].segment for number in numbers.tolist()]
    for place, number in enumerate(numbers.tolist()):
        wanted = plain.bins[number]
        assert counts[:, place].tolist() == [*wanted.counts[:2], wanted.counts[2] if fine else 0]
        if not wanted.values:
            assert np.isnan(low[place])
            assert np.isnan(high[place])
            continue
        assert low[place] == min(wanted.values)
        over = float(high[place]) - max(wanted.values)
        apart = max(wanted.values) - min(wanted.values)
        least = list(accumulate(wanted.values, min))
        rounded = 1 + sum(now < before for before, now in pairwise(least))  # the distance is, whenever the least falls
        coarse = isinstance(bins, Bins) and bins.coarse
        most = (1.008**rounded - 1) * apart + 1e-6 * max(map(abs, wanted.values))
        assert 0.0 <= over <= (most if coarse else 0.0)


def test_the_ring_of_an_hour_forgets_what_is_older() -> None:
    past = History()
    for minute in range(70):
        past.block(block(NOW + 60 * minute, [[float(minute)]]))
    history = past.channel_history(NODE, 1, NOW, NOW + 4200, points=3600)
    assert (history["time"][0], len(history["time"])) == (NOW + 60 * 10, 60)


def test_a_channel_takes_less_than_a_hundred_thousand_octets() -> None:
    past = History()
    ramp(past, NOW - 70, 70)
    past.channel_history(NODE, 1)
    channel = past._channels[NODE, 1]

    def held() -> int:
        rows = [
            row for bins in (channel.hour, channel.ring(fine=True)) for row in (bins._low, bins._high, *bins._counts)
        ]
        return sum(sys.getsizeof(row) + 32 * len(row) if isinstance(row, dict) else row.nbytes for row in rows)

    assert held() <= 78_300, "nothing was lost, nothing invalid"
    past.block(block(NOW, [[1.0]] * 6000, index=9000, valid=[[False]] * 6000))
    past.channel_history(NODE, 1)
    assert held() <= 98_400


def test_what_is_rare_takes_no_row_of_the_hour_and_is_forgotten_with_its_second() -> None:
    bins = Bins(1.0, HOUR, coarse=False)
    for second in range(2 * HOUR):
        bins.add_one(second, 1.0, int(second % 700 == 0), 2 * (second % 600 == 0), 0)
    numbers, _, _, (_, invalid, lost) = bins.between(0, 2 * HOUR)
    assert numbers[lost == 2].tolist() == list(range(3600, 7200, 600))
    assert numbers[invalid == 1].tolist() == [4200, 4900, 5600, 6300, 7000]
    assert lost.sum() + invalid.sum() == 12 + 5
    assert all(isinstance(row, dict) for row in bins._counts[1:])
    for second in range(2 * HOUR, 2 * HOUR + 100):  # a row of all is smaller from here on
        bins.add_one(second, 1.0, 0, 1, 0)
    numbers, _, _, (_, _, lost) = bins.between(0, 3 * HOUR)
    assert isinstance(bins._counts[2], np.ndarray)
    assert numbers[lost > 0].tolist() == [*range(4200, 7200, 600), *range(7200, 7300)]
    assert lost.sum() == 5 * 2 + 100


def test_no_bin_holds_values_of_two_calibrations() -> None:
    """A zero, a recalibration or a retype begins a new segment, at a reload and however many bins are asked for."""
    past = History()
    angle, zeroed, warm = (
        replace(ChannelFacts(NODE, "", 1, "a", unit=unit), calibration=calibration)
        for unit, calibration in (("rad", line()), ("rad", line(zero=0.5)), ("K", line()))
    )
    past.learn([angle])
    past.block(block(NOW - 9, [[1.0]] * 150, index=0))
    past.learn([replace(angle, calibration=line(by="again"))])  # documented again, and no other values
    past.block(block(NOW - 7.5, [[1.0]] * 10, run=1))
    past.learn([zeroed])
    past.block(block(NOW - 7.4, [[0.5]] * 40, run=2))  # within the second in which the zero was set
    past.learn([warm])
    past.block(block(NOW - 5, [[300.0]] * 100, run=3))
    for points in (3600, 3, 1):
        history = past.channel_history(NODE, 1, NOW - 3000, NOW, points=points)
        assert (history["low"], history["high"]) == ([1.0, 0.5, 300.0],) * 2, points
        assert history["segment"] == [0, 1, 2]
        assert history["segments"] == [{"id": 0, "unit": "rad"}, {"id": 1, "unit": "rad"}, {"id": 2, "unit": "K"}]
        assert history["count"] == [100, 40, 100], "the second of the change has what came after it"
    fine = past.channel_history(NODE, 1, NOW - 7.45, NOW - 6, points=3600)
    assert set(zip(fine["segment"], fine["low"], strict=True)) == {(0, 1.0), (1, 0.5)}
    past.block(block(NOW - 8.5, [[301.0]] * 10, run=4))  # the clock was put back
    history = past.channel_history(NODE, 1, NOW - 3000, NOW, points=3600)
    assert (history["low"], history["segment"]) == ([1.0, 301.0], [0, 2]) or history["low"] == [301.0]


def line(zero: float = 0.0, by: str = "") -> Calibration:
    """Return a calibration of channel 1."""
    part = CalibrationInput(1, 1, (0.0, 65536.0), (0.0,))
    return Calibration(1, "linear", (part,), (0.0, 1e-4), zero_offset=zero, by=by)


@pytest.mark.parametrize("rate", [1.0, 40.0, 400.0])
def test_samples_one_by_one_leave_the_past_that_they_leave_together(rate: float) -> None:
    drawn = np.random.default_rng(round(rate))
    values = drawn.normal(size=(round(150 * rate), 2)) * 100
    valid = drawn.random(values.shape) > 0.1
    first, one_by_one, together = NOW - 150 + 0.003, History(), History()  # no sample is at the edge of a bin
    for past, most in ((one_by_one, 8), (together, len(values))):
        at = 0
        while at < len(values):
            end = min(len(values), at + most)
            missing = 3 * (at > len(values) // 2)  # what comes behind the middle follows a gap
            past.block(
                block(
                    first + at / rate,
                    values[at:end].tolist(),
                    rate=rate,
                    index=at + missing,
                    valid=valid[at:end].tolist(),
                )
            )
            at = end
    for channel in (1, 2):
        for since in (first, NOW - 20):
            few, many = (
                past.channel_history(NODE, channel, since, NOW, points=3600) for past in (one_by_one, together)
            )
            assert few["bin"] == many["bin"]
            assert few["bin"] == (1.0 if since == first else pytest.approx(0.01))
            for name in ("time", "low", "count", "invalid", "segment"):
                assert few[name] == many[name], name
            for least, high, other in zip(few["low"], few["high"], many["high"], strict=True):
                assert (high is None) == (other is None)
                assert high is None or high == pytest.approx(other, abs=0.02 * (other - least) + 1e-4)
    assert sum(few["lost"]) == 0, "the last minute does not keep it"
    lost = one_by_one.channel_history(NODE, 1, first, NOW, points=3600)["lost"]
    assert (sum(lost), max(lost)) == (3, 3)


def test_a_slow_channel_takes_half_of_the_memory_and_one_that_becomes_quick_loses_nothing() -> None:
    past, first = History(), float(NOW - 60)
    for second in range(30):
        past.block(block(first + second, [[float(second)]], index=second))
    past.channel_history(NODE, 1)
    channel = past._channels[NODE, 1]
    assert type(channel.minute) is FewBins
    ramp(past, first + 30, 30, rate=1000.0)
    fine = past.channel_history(NODE, 1, first + 5, NOW, points=6000)
    assert type(past._channels[NODE, 1].minute) is Bins
    assert fine["time"][:26] == [first + second for second in range(5, 31)]
    assert fine["low"][:25] == fine["high"][:25] == [float(second) for second in range(5, 30)]
    assert sum(fine["count"]) == 25 + 30_000


@pytest.mark.parametrize(("rate", "kind"), [(8.1, FewBins), (1000.0, Bins)])
def test_what_waited_of_a_slow_channel_makes_no_ring_of_its_minute(rate: float, kind: type) -> None:
    """A ring takes 42 kB from then on, and on a busy machine messages of all wait at times."""
    past = History()
    past.block(block(NOW, [[float(number)] for number in range(40)], rate=rate))
    assert sum(past.channel_history(NODE, 1, NOW - 1, NOW + 40)["count"]) == 40
    assert type(past._channels[NODE, 1].minute) is kind


def test_a_raw_integer_that_no_float_can_hold_is_a_gap_and_ends_no_history() -> None:
    """A channel that has raw values alone may have 255 octets."""
    past = History()
    raw = np.empty((2, 1), dtype=object)
    raw[:, 0] = [2**1030, 7]
    past.learn([ChannelFacts(NODE, "arm", 1, "angle")], raw={(NODE, 1)})
    past.block(replace(block(NOW - 2, [[np.nan], [np.nan]], rate=1.0), raw=raw))
    history = past.channel_history(NODE, 1, NOW - 60, NOW + 60)
    assert (history["low"], history["high"]) == ([None, 7.0], [None, 7.0])
    assert history["segments"] == [{"id": history["segment"][0], "unit": "", "raw": True}]


CALIBRATED = ChannelFacts(
    NODE, "", 1, "a", unit="rad", units=parse_units("rad"), low=0.0, high=6.283185307179586,
    calibration=Calibration(1, "linear", (CalibrationInput(1, 1, (0.0, 65536.0), (0.0,)),), (0.0, 1e-4)),
)  # fmt: skip
DAY = datetime(2026, 3, 1, tzinfo=UTC)


@pytest.mark.parametrize(
    ("facts", "calibration", "raw", "another"),
    [
        ({}, {"date": DAY}, False, False),
        ({}, {"zeroed": DAY}, False, False),
        ({}, {"interval": 86400.0}, False, False),
        ({}, {"points": ((0.0, 0.0),)}, False, False),
        ({}, {"by": "another"}, False, False),
        ({}, {"certificate": CertificateReference("7", "lab", "2026-03-01", "ab" * 32)}, False, False),
        ({"due": "2027-03-01", "fingerprint": "ab" * 32, "uncertainty": 0.5, "name": "b"}, {}, False, False),
        ({}, {"zero_offset": 0.5}, False, True),
        ({}, {"coefficients": (0.0, 2e-4)}, False, True),
        ({"unit": "°"}, {}, False, True),
        ({"units": parse_units("m")}, {}, False, True),
        ({"calibration": None}, {}, False, True),
        ({"low": -3.141592653589793, "high": 3.141592653589793}, {}, False, True),
        ({"high": 3.0}, {}, False, True),
        ({"unsigned": True}, {}, False, True),
        ({}, {}, True, True),
    ],
)
def test_a_segment_begins_where_values_mean_something_else_and_nowhere_else(
    facts: dict[str, Any], calibration: dict[str, Any], raw: bool, another: bool
) -> None:
    past = History()
    past.learn([CALIBRATED])
    past.block(block(NOW - 9, [[1.0]] * 10))
    assert CALIBRATED.calibration is not None
    changed = replace(CALIBRATED, **{"calibration": replace(CALIBRATED.calibration, **calibration), **facts})
    past.learn([changed], raw={(NODE, 1)} if raw else ())
    past.block(block(NOW - 5, [[2.0]] * 10))
    history = past.channel_history(NODE, 1, NOW - 600, NOW)
    assert history["segment"] == [0, int(another)]
    last = {"id": 1, "unit": "", "raw": True} if raw else {"id": int(another), "unit": facts.get("unit", "rad")}
    assert history["segments"][-1] == last


def test_limits_of_a_channel_that_does_not_wrap_are_no_meaning() -> None:
    past = History()
    for at, high in ((NOW - 9, 1.0), (NOW - 5, 2.0)):
        past.learn([replace(CALIBRATED, high=high)])
        past.block(block(at, [[1.0]]))
    assert past.channel_history(NODE, 1, NOW - 600, NOW)["segment"] == [0, 0]


@pytest.mark.parametrize("many", [False, True])
def test_values_of_a_channel_without_calibration_are_its_raw_numbers_and_none_of_them_is_a_gap(many: bool) -> None:
    """They are marked as not valid, for nobody says what they mean."""
    count = 400 if many else 4
    past = History()
    past.learn([CALIBRATED, replace(CALIBRATED, number=2, calibration=None)], raw={(NODE, 2)})
    bare = block(NOW - 8, [[5.0, 7.0]] * count, valid=[[False, False]] * count)
    past.block(replace(bare, value=np.full((count, 2), np.nan)))
    for number, value in ((1, None), (2, 7.0)):
        history = past.channel_history(NODE, number, NOW - 600, NOW)
        assert (history["low"][0], history["high"][0], sum(history["invalid"])) == (value, value, count)


def test_what_is_lost_counts_in_the_second_of_the_sample_behind_the_gap() -> None:
    """Of the stream in which it was lost; one that came twice makes no loss of less than nothing."""
    past = History()
    past.block(block(NOW - 9, [[1.0]] * 5, index=0))
    past.block(block(NOW - 7.99, [[1.0]] * 300, index=9))  # 4 before it, and the block takes three seconds
    past.block(replace(block(NOW - 4, [[1.0]] * 5, index=500), channels=(2,), stream=2))
    past.block(
        replace(block(NOW - 3.5, [[1.0]] * 5, index=600), channels=(3,), stream=1)
    )  # another stream of that number
    past.block(replace(block(NOW - 3, [[1.0]] * 5, index=100), channels=(3,), stream=1))
    lost = [past.channel_history(NODE, number, NOW - 600, NOW)["lost"] for number in (1, 2, 3)]
    assert (lost[0][:3], sum(lost[0]), sum(lost[1]), sum(lost[2])) == ([0, 4, 0], 4, 0, 0)
    past.block(replace(block(NOW - 2, [[1.0]] * 5, index=105), channels=(3,), stream=1, test_pattern=True))
    assert sum(past.channel_history(NODE, 3, NOW - 600, NOW)["count"]) == 10, "a test pattern is no measurement"


def test_times_that_go_back_within_a_block_go_no_further_back_than_the_sample_before() -> None:
    for count in (4, 40):
        past = History()
        times = NOW - 8 + np.arange(count) / 1000
        times[1] -= 3.0
        past.block(replace(block(NOW - 8, [[1.0]] * count), time=times))
        assert past.channel_history(NODE, 1, NOW - 600, NOW)["time"] == [NOW - 8]


def test_an_hour_is_shown_unless_less_is_asked_for_and_no_more_bins_than_were_asked_for() -> None:
    past = History()
    for seconds in (3601.0, 3599.0, 100.0, 30.0):
        past.block(block(NOW - seconds, [[seconds]], rate=1.0))
    whole = past.channel_history(NODE, 1, until=NOW, points=3600)
    assert (whole["since"], whole["until"], whole["bin"]) == (NOW - 3600, NOW, 1.0)
    assert whole["time"] == [NOW - 3599, NOW - 100, NOW - 30]
    assert past.channel_history(NODE, 1, NOW - 61, NOW - 1)["bin"] == pytest.approx(0.06), "31 s in 600 parts"
    assert past.channel_history(NODE, 1, NOW - 100, NOW - 1)["bin"] == 1.0, "longer ago than a minute"
    assert past.channel_history(NODE, 1, NOW - 3600, NOW - 3500)["bin"] == 1.0
    thin = past.channel_history(NODE, 1, NOW - 3600, NOW, points=1000)
    assert thin["bin"] == 4.0, "3,571 seconds by 1,000: a bin of three seconds would be too short"


@pytest.mark.parametrize("at_once", [1, 100])
def test_a_sample_at_the_edge_of_a_bin_is_in_the_bin_that_begins_there(at_once: int) -> None:
    """A hundredth is no binary fraction: by its quotient alone every third sample would be in the bin before."""
    past = History()
    first = NOW - 5
    times = [first + place / 100 for place in range(100)]
    for place in range(0, 100, at_once):
        one = block(first, [[1.0]] * at_once, index=place)
        past.block(replace(one, time=np.array(times[place : place + at_once])))
    fine = past.channel_history(NODE, 1, NOW - 6, NOW - 3, points=600)
    assert (fine["count"], fine["time"]) == ([1] * 100, [round(moment, 3) for moment in times])
    past = History()
    past.block(replace(block(first, [[1.0]]), time=np.array([first - 2e-7])))
    assert past.channel_history(NODE, 1, NOW - 600, NOW)["time"] == [first]


def test_what_waits_is_taken_in_by_who_brings_too_much(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("teds_provision.ncap.history._WAITING", 3)
    past = History()
    held = []
    for place in range(5):
        past.block(block(NOW - 5 + place / 100, [[1.0]], index=place))
        held.append(len(past._waiting))
    assert held == [1, 2, 3, 0, 1]


def test_the_rate_is_that_of_the_last_ten_seconds_and_a_value_keeps_seven_digits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("time.time", lambda: NOW)
    past = History()
    ramp(past, NOW - 40, 20)
    for second in range(20):
        past.block(block(NOW - 20 + second, [[1.234567]] * 5, rate=5.0))
    history = past.channel_history(NODE, 1, NOW - 600, NOW)
    assert (history["rate"], history["low"][-1]) == (5.0, 1.234567)
    recent = past.channel_history(NODE, 1, NOW - 30, NOW + 40, points=3600)
    assert recent["bin"] == 1.0, "more than a minute was asked for"


def test_of_few_bins_those_of_a_time_are_emptied_and_a_value_that_is_none_bounds_nothing() -> None:
    few, nan = FewBins(1.0, 60), float("nan")
    for number, values in ((3, (nan, 2.0, nan, 1.0, 1.5)), (5, (4.0, nan)), (7, (nan, nan)), (9, (6.0, 8.0))):
        for value in values:
            few.add_one(number, value, 0, 0, 0)

    def held() -> list[tuple[int, float, float, int]]:
        numbers, low, high, counts = few.between(0, 9)
        return list(zip(numbers.tolist(), low.tolist(), high.tolist(), counts[0].tolist(), strict=True))

    def same(found: list[tuple[int, float, float, int]], wanted: list[tuple[int, float, float, int]]) -> bool:
        return repr(found) == repr(wanted)

    every = [(3, 1.0, 2.0, 5), (5, 4.0, 4.0, 2), (7, nan, nan, 2), (9, 6.0, 8.0, 2)]
    assert same(held(), every)
    few._forget(10, 12)
    assert same(held(), every), "there is nothing of that time"
    few._forget(4, 7)
    assert same(held(), [every[0], every[3]])
    few._forget(9, 9)
    assert same(held(), [every[0]])


def test_what_a_segment_means_is_known_as_long_as_the_minute_or_the_hour_has_samples_of_it() -> None:
    meanings: Any = ["rad", "degree", "m"]
    channel = history._Channel(meanings[0])
    channel.add_one(NOW, 1.0, 0, 0)
    channel.begin_segment(meanings[1])
    channel.minute.add_one(round(NOW / history.FINE) + 5, 1.0, 0, 0, 1)
    channel.hour = Bins(1.0, 10, coarse=False)
    channel.begin_segment(meanings[2])
    assert channel._meanings == {0: "rad", 1: "degree", 2: "m"}, "of the minute alone"
    channel.minute = FewBins(history.FINE, 10)
    channel.begin_segment(meanings[0])
    assert channel._meanings == {3: "rad"}


@pytest.mark.parametrize("together", [False, True])
def test_a_sample_at_an_edge_belongs_to_the_bin_that_begins_there(together: bool) -> None:
    """In 2033 one of 25 had been in the bin before it: what made up for the rounding was less than the rounding."""
    past, first = History(), 2_000_000_000.0
    moments = np.array([first + at / 100 for at in range(600)])
    one = block(first, [[float(at)] for at in range(600)])
    if together:
        past.block(replace(one, time=moments))
    else:
        for at in range(600):
            past.block(replace(block(moments[at], [[float(at)]], index=at), time=moments[at : at + 1]))
    history = past.channel_history(NODE, 1, first + 1.07, first + 5.99, points=3600)
    assert history["bin"] == 0.01
    assert set(history["count"]) == {1}
    assert history["time"] == [round(first + at / 100, 3) for at in range(107, 600)]
    for at in range(550, 600):
        last = past.channel_history(NODE, 1, first + at / 100, first + at / 100, points=3600)
        assert last["low"] == [float(at)]


def test_a_channel_is_forgotten_an_hour_after_its_last_value_looked_at_each_minute(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    past, now, turns = History(), [1000.0, NOW], iter([30.0, 40.0, 70.0, 70.0, None])
    seen = list[int]()
    past.block(block(NOW - HOUR + 60, [[1.0]]))
    past.block(replace(block(NOW, [[1.0]]), uuid="cd" * 10))

    def wait(seconds: float) -> bool:
        assert seconds == 0.5
        seen.append(len(past))
        step = next(turns)
        now[:] = [moment + (step or 0.0) for moment in now]
        return step is None

    monkeypatch.setattr(past, "_end", SimpleNamespace(wait=wait))
    monkeypatch.setattr(history, "time", SimpleNamespace(monotonic=lambda: now[0], time=lambda: now[1]))
    past._run()
    assert seen == [0, 2, 1, 1, 1], "after 70 s: the first one is older than an hour"
    assert list(past._channels) == [("cd" * 10, 1)]


def test_the_rate_counts_ten_whole_seconds_before_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.time", lambda: NOW)
    past = History()
    ramp(past, NOW - 13, 3)
    for second in range(10):
        past.block(block(NOW - 10 + second, [[1.0]] * 5, rate=5.0, index=300 + 5 * second))
    assert past.channel_history(NODE, 1)["rate"] == 14.5, "a hundred in the first of them and five in each of nine"
