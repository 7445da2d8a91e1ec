"""Facts, blocks and strategies for the tests of the sinks."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, NodeReport, StationFacts
from teds_provision.measure.sinks import Sink
from teds_provision.measure.sinks.ros.child import ChildSink
from teds_provision.teds.units import parse_units
from tests.pace import until

ARM = "8d4d9da65281f7000001"
HAND = "8d4d9da65281f7000002"
ANGLE = ChannelFacts(
    ARM,
    "arm",
    1,
    "angle",
    unit="rad",
    shown_unit="°",
    low=0.0,
    high=6.283185,
    uncertainty=0.0087,
    calibrated="2026-03-01",
    due="2027-03-01",
    fingerprint="ab" * 32,
    sample_form="unsigned integer, 2 octets",
    period=0.01,
)
FORCE = ChannelFacts(HAND, "hand", 2, "force", unit="N", uncertainty=0.1, fingerprint="cd" * 32, period=0.01)
OIL = replace(FORCE, number=3, name="oil", unit="K", units=parse_units("K"), uncertainty=0.3)
GRIP = replace(FORCE, kind="actuator")
DISTANCE = replace(ANGLE, number=7, name="range finder", unit="m", units=parse_units("m"), low=0.25, high=8.0)
AXES = [
    replace(ANGLE, number=n, name=f"axis {n}", units=parse_units("m/s^2"), uncertainty=0.3, vector=(4, 5, 6))
    for n in (4, 5, 6)
]
STATION = StationFacts("bench", group="crane", started=1_795_000_000.0)


def block(
    raw: Any = ((1,), (2,), (3,)),
    value: Any = None,
    valid: Any = None,
    *,
    uuid: str = ARM,
    channels: tuple[int, ...] = (1,),
    index: int = 0,
    start: float = 1_795_000_000.0,
    period: float = 0.01,
    clock_error: float | None = 1e-4,
    test_pattern: bool = False,
) -> Block:
    """A block of raw values (n × c); the calibrated ones are a tenth of them unless given."""
    raws = np.asarray(raw) if not isinstance(raw, np.ndarray) else raw
    values = np.asarray(raws / 10 if value is None else value, dtype=np.float64)
    good = np.ones(values.shape, dtype=bool) if valid is None else np.asarray(valid)
    n = len(raws)
    return Block(
        uuid,
        0,
        channels,
        index,
        start + (index % 10**6 + np.arange(n)) * period,
        ((index % 10**6 + np.arange(n)) * int(period * 1e9)).astype(np.uint64),
        raws,
        np.where(good, values, np.nan),
        good,
        0.02,
        clock_error,
        test_pattern,
    )


_DTYPES = ["uint8", "int8", "uint16", "int16", "uint32", "int32", "int64", "float32", "float64"]


@st.composite
def blocks(draw: st.DrawFn) -> Block:
    """Any block of one to four channels, integers or floats, some values invalid."""
    n, c = draw(st.integers(1, 5)), draw(st.integers(1, 4))
    dtype = np.dtype(draw(st.sampled_from(_DTYPES)))
    if dtype.kind == "f":
        cell: st.SearchStrategy[Any] = st.floats(allow_nan=False, allow_infinity=False, width=8 * dtype.itemsize)  # type: ignore[arg-type]
    else:
        limits = np.iinfo(dtype)
        cell = st.integers(int(limits.min), int(limits.max))
    raw = np.array(draw(st.lists(st.lists(cell, min_size=c, max_size=c), min_size=n, max_size=n)), dtype=dtype)
    finite = st.floats(-1e12, 1e12)
    value = draw(st.lists(st.lists(finite, min_size=c, max_size=c), min_size=n, max_size=n))
    valid = draw(st.lists(st.lists(st.booleans(), min_size=c, max_size=c), min_size=n, max_size=n))
    channels = tuple(draw(st.lists(st.integers(1, 255), min_size=c, max_size=c, unique=True)))
    return block(raw, value, valid, channels=channels, index=draw(st.integers(0, 2**40)))


def fill(sink: Sink, items: Iterable[Block | GroupRows | NodeReport | list[ChannelFacts]]) -> None:
    """Give an open sink all of these, close it, and see that it took them."""
    for item in items:
        if isinstance(item, Block):
            sink.write(item)
        elif isinstance(item, GroupRows):
            sink.write_group(item)
        elif isinstance(item, NodeReport):
            sink.report(item)
        else:
            sink.describe(item)
    sink.close()
    assert sink.stats.error == ""


def feed_robot(sink: Sink, k: int) -> None:
    """Row ``k`` of everything: an angle, a distance and an acceleration of the arm, oil and force of the hand."""
    sink.write(block([[10]], index=k, start=time.time()))
    sink.write(replace(block([[1, 2, 3, 4]], channels=(4, 5, 6, 7), index=k, start=time.time()), stream=1))
    sink.write(block([[7, 5]], [[293.15, 0.5]], uuid=HAND, channels=(3, 2), index=k, start=time.time()))
    row = np.array([[1.0, np.nan]])
    sink.write_group(GroupRows("crane", ((ARM, 1), (HAND, 3)), np.array([12.25 + k]), row, row * 0))


def kill_child(sink: ChildSink) -> None:
    """End the process that publishes, as a crash of it would, and wait until the sink has seen it."""
    child = sink._child
    assert child is not None
    os.kill(child.pid, signal.SIGKILL)
    until(lambda: sink.stats.state == "waiting")
