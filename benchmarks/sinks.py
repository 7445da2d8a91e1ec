"""Sinks: recorders and topics at the load of a large machine, and what a kill costs. Ratios, on a machine of any speed.

Run: python -m benchmarks.sinks [--seconds 10] [--ros1 URI]

* recorders: 40 streams of 12 or 13 channels at 100 Hz (500 channels, 50,000 values a second) as fast as they go, beside
  the paced load: how many times real time each recorder bears, and octets a value;
* topics: the same as rows of one group and as scalars at 10 Hz over MQTT-free carriers that are there (ROS 2 by
  Cyclone DDS on this machine, read by a second process): lag from the row's time to the reader;
* kill -9 of a paced recorder: seconds of data that are missing.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, StationFacts
from teds_provision.measure.sinks import open_sink
from teds_provision.measure.sinks.mcap.recover import recover

STREAMS, CHANNELS, RATE = 40, 500, 100
STATION = StationFacts("bench", group="all")


def layout() -> list[tuple[str, tuple[int, ...]]]:
    """20 nodes of 25 channels, each in two streams."""
    halves = (tuple(range(1, 14)), tuple(range(14, 26)))
    return [(f"{node:020x}", half) for node in range(1, 21) for half in halves]


def facts() -> list[ChannelFacts]:
    return [
        ChannelFacts(uuid, f"node {uuid[-2:]}", n, f"ch {n}", unit="N", period=0.01)
        for uuid, part in layout()
        for n in part
    ]


def tick(k: int, start: float, n: int = 2) -> Iterator[Block]:
    """Blocks of n instants of every stream, as the hearing thread makes them each 20 ms."""
    chance = np.random.default_rng(k)
    for number, (uuid, channels) in enumerate(layout()):
        raw = chance.integers(0, 65536, (n, len(channels))).astype(np.uint64)
        times = start + (k * n + np.arange(n)) / RATE
        valid = np.ones(raw.shape, dtype=bool)
        ticks = ((k * n + np.arange(n)) * 10_000_000).astype(np.uint64)
        yield Block(uuid, number % 2, channels, k * n, times, ticks, raw, raw * 0.001, valid, 0.01, 1e-4)


def recorders(folder: Path, seconds: float) -> None:
    blocks = [list(tick(k, 1.8e9)) for k in range(int(seconds * RATE / 2))]
    for suffix in ("csv", "jsonl", "mcap"):
        sink = open_sink(str(folder / f"run.{suffix}"))
        sink.open(facts(), STATION)
        cpu, began = time.process_time(), time.perf_counter()
        for group in blocks:
            for block in group:
                sink.write(block)
            while sink.stats.written + 500_000 < 1000 * (blocks.index(group) + 1) and not sink.stats.error:
                time.sleep(0.01)
        sink.close()
        took, used = time.perf_counter() - began, time.process_time() - cpu
        stats = sink.stats
        assert stats.dropped == 0
        size = sum(os.path.getsize(name) for name in sink.files)
        share = f"{used / seconds:.0%} of a core at 50,000 values/s"
        print(
            f"{suffix:6s} {seconds / took:5.1f} × real time, {share}, {size / stats.written:.1f} octets a value",
            stats.error,
        )


READER = """
import sys, time
sys.path.insert(0, {root!r})
import numpy as np
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration
from cyclonedds.core import ReadCondition, SampleState, WaitSet
from teds_provision.measure.sinks.ros.ros2 import THIS_MACHINE
from teds_provision.measure.sinks.ros.ros2_types import JointState
kept = Domain({domain}, THIS_MACHINE)
who = DomainParticipant({domain})
qos = Qos(Policy.Reliability.Reliable(duration(milliseconds=100)), Policy.History.KeepLast(100),
          Policy.DataRepresentation(use_cdrv0_representation=True))
reader = DataReader(who, Topic(who, "rt/bench/all", JointState), qos=qos)
waits = WaitSet(who)
condition = ReadCondition(reader, SampleState.NotRead)
waits.attach(condition)
lags = []
end = time.time() + {seconds} + 12
print("ready", flush=True)
while time.time() < end:
    waits.wait(duration(milliseconds=100))
    for message in reader.take(N=100):
        lags.append((time.time() - message.header.stamp.sec - message.header.stamp.nanosec * 1e-9) * 1e3)
half = len(lags) // 2
first, second = np.array(lags[10:half]), np.array(lags[half:])
p50, p99 = np.percentile(lags[10:], (50, 99))
print(f"{{len(lags)}} rows of 500 values read; lag in ms: p50 {{p50:.1f}}, p99 {{p99:.1f}}; first half p99 "
      f"{{np.percentile(first, 99):.1f}}, second half {{np.percentile(second, 99):.1f}}")
"""


def topics(seconds: float) -> None:
    domain = 90 + os.getpid() % 100
    code = READER.format(root=str(Path(__file__).parents[1]), domain=domain, seconds=seconds)
    reader = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert reader.stdout is not None
    reader.stdout.readline()
    sink = open_sink(f"ros2:{domain}")
    known = facts()
    sink.open(known, STATION)
    keys = tuple(one.key for one in known)
    for block in tick(0, time.time()):
        sink.write(block)  # makes the 500 topics of one value
    time.sleep(4)
    cpu, began, late = time.process_time(), time.monotonic(), 0
    rows = int(seconds * RATE)
    for k in range(rows):
        values = np.full((1, CHANNELS), float(k))
        sink.write_group(GroupRows("all", keys, np.array([time.time()]), values, values * 0))
        if k % 2 == 0:
            for block in tick(k // 2, time.time()):
                sink.write(block)
        left = began + (k + 1) / RATE - time.monotonic()
        late += left < 0
        time.sleep(max(0.0, left))
    took, used = time.monotonic() - began, time.process_time() - cpu
    stats = sink.stats
    print(f"ROS 2  {rows} rows of {CHANNELS} and scalars at 10 Hz sent in {took:.2f} s of {seconds:.0f}")
    print(f"       {used / took:.0%} of a core, {late} ticks late, {stats.dropped} values dropped, {stats.detail}")
    print("      ", reader.stdout.readline().strip())
    reader.wait()
    reader.stdout.close()
    sink.close()


VICTIM = """
import sys, time
sys.path.insert(0, {root!r})
from benchmarks.sinks import STATION, facts, tick
from teds_provision.measure.sinks import open_sink
sink = open_sink({path!r})
sink.open(facts(), STATION)
begin, k = time.time(), 0
while True:
    for block in tick(k, begin): sink.write(block)
    k += 1
    print(begin + 2 * k / 100, flush=True)
    time.sleep(max(0, begin + k * 0.02 - time.time()))
"""


def kills(folder: Path, rounds: int) -> None:
    lost = []
    for number in range(rounds):
        path = folder / f"kill{number}.mcap"
        code = VICTIM.format(root=str(Path(__file__).parents[1]), path=str(path))
        victim = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        assert victim.stdout is not None
        last = 0.0
        begin = time.monotonic()
        while time.monotonic() - begin < 3 + 0.037 * number:
            last = float(victim.stdout.readline())
        os.kill(victim.pid, signal.SIGKILL)
        for line in victim.stdout:
            last = float(line) if line.endswith("\n") else last
        victim.wait()
        victim.stdout.close()
        done = recover(path)
        lost.append(last - (done.until or 0) - 0.01)
    print(
        f"kill -9 of the MCAP recorder, {rounds} times: {median(lost):.3f} s lost (median), {max(lost):.3f} s at most"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--kills", type=int, default=10)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        recorders(Path(folder), arguments.seconds)
        topics(arguments.seconds)
        kills(Path(folder), arguments.kills)


if __name__ == "__main__":
    main()
