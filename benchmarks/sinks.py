"""Sinks: recorders and topics at the load of a large machine, and what a kill costs. Ratios, on a machine of any speed.

Run: python -m benchmarks.sinks [--seconds 10] [--kills 10]

Three sizes, 1, 5 and 20 nodes of 25 channels at 100 Hz, two streams each (up to 50,000 values a second):

* recorders: as fast as they go beside the paced load: how many times real time each bears, and octets a value;
* topics: the group's array at full rate and each channel on its own topic at 10 Hz, over ROS 1 (Debian's rosmaster and
  rospy) and ROS 2 (Cyclone DDS), read by a second process: lag from the row's time to the reader. The paper's lag grew,
  so the second half is held against the first; this is wall time, and other work on the machine makes it worse;
* kill -9 of a paced recorder: seconds of data that are missing.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from statistics import median
from typing import IO

import numpy as np

from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, StationFacts
from teds_provision.measure.sinks import Sink, open_sink
from teds_provision.measure.sinks.mcap.recover import recover

SIZES, CHANNELS, RATE = (1, 5, 20), 25, 100
LAG, FLAT, KILLED = 50.0, 20.0, 0.2  # aims: ms (p99), ms by which the second half may be worse, seconds
STATION = StationFacts("bench", group="all")


def layout(nodes: int = 20) -> list[tuple[str, tuple[int, ...]]]:
    """Return nodes of 25 channels, each in two streams."""
    halves = (tuple(range(1, 14)), tuple(range(14, 26)))
    return [(f"{node:020x}", half) for node in range(1, nodes + 1) for half in halves]


def facts(nodes: int = 20) -> list[ChannelFacts]:
    """Return the facts of all channels."""
    return [
        ChannelFacts(uuid, f"node {uuid[-2:]}", n, f"ch {n}", unit="N", period=0.01)
        for uuid, part in layout(nodes)
        for n in part
    ]


def verdict(*, met: bool) -> str:
    """Return the verdict on an aim."""
    return "met" if met else "MISSED"


def tick(k: int, start: float, n: int = 2, nodes: int = 20) -> Iterator[Block]:
    """Yield blocks of n instants of every stream, as the receiver thread makes them each 20 ms."""
    chance = np.random.default_rng(k)
    for number, (uuid, channels) in enumerate(layout(nodes)):
        raw = chance.integers(0, 65536, (n, len(channels))).astype(np.uint64)
        times = start + (k * n + np.arange(n)) / RATE
        valid = np.ones(raw.shape, dtype=bool)
        ticks = ((k * n + np.arange(n)) * 10_000_000).astype(np.uint64)
        yield Block(uuid, number % 2, channels, k * n, times, ticks, raw, raw * 0.001, valid, 0.01, 1e-4)


def recorders(folder: Path, seconds: float, nodes: int) -> None:
    """Measure each recorder as fast as it goes."""
    blocks = [list(tick(k, 1.8e9, nodes=nodes)) for k in range(int(seconds * RATE / 2))]
    rate = nodes * CHANNELS * RATE
    for suffix in ("csv", "jsonl", "mcap"):
        sink = open_sink(str(folder / f"run-{nodes}.{suffix}"))
        sink.open(facts(nodes), STATION)
        cpu, began, given = time.process_time(), time.perf_counter(), 0
        for group in blocks:
            for block in group:
                sink.write(block)
            given += sum(block.value.size for block in group)
            while sink.stats.written + 500_000 < given and not sink.stats.error:
                time.sleep(0.01)
        sink.close()
        elapsed, used = time.perf_counter() - began, time.process_time() - cpu
        stats = sink.stats
        assert stats.dropped == 0
        size = sum(os.path.getsize(name) for name in sink.files)
        share = f"{used / seconds:.0%} of a core at {rate:,} values/s"
        print(
            f"{suffix:6s} {nodes:2d} nodes: {seconds / elapsed:5.1f} × real time, {share}, "
            f"{size / stats.written:.1f} octets a value",
            stats.error,
        )


READER = """
import json, sys, time
sys.path.insert(0, {root!r})
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
end = time.time() + {seconds} + 60
print("ready", flush=True)
while time.time() < end:
    waits.wait(duration(milliseconds=100))
    for message in reader.take(N=100):
        if message.position[0] < 0:
            end = 0
        elif end:
            lags.append((time.time() - message.header.stamp.sec - message.header.stamp.nanosec * 1e-9) * 1e3)
print(json.dumps(lags), flush=True)
"""
READER1 = """
import json, sys, threading, time
import rospy
from sensor_msgs.msg import JointState
lags, done = [], threading.Event()
def take(message):
    if message.position[0] < 0:
        done.set()
    elif not done.is_set():
        lags.append((time.time() - message.header.stamp.to_sec()) * 1e3)
rospy.init_node("reader", anonymous=True, disable_signals=True)
rospy.Subscriber("/bench/all", JointState, take, tcp_nodelay=True)
print("ready", flush=True)
done.wait({seconds} + 60)
print(json.dumps(lags), flush=True)
"""


class Master:
    """Debian's rosmaster on a free port, with its own files."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        self.uri = f"http://127.0.0.1:{port}"
        places = {name: str(folder) for name in ("ROS_HOME", "ROS_LOG_DIR", "HOME")}
        self.environment = {"PATH": "/usr/bin:/bin", "ROS_MASTER_URI": self.uri, "ROS_IP": "127.0.0.1", **places}
        words = ["/usr/bin/python3", "/usr/bin/rosmaster", "--core", "-p", str(port)]
        self.process = subprocess.Popen(
            words, env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    def close(self) -> None:
        """End it."""
        self.process.kill()
        self.process.wait()


def topics_of_ros2(seconds: float, nodes: int) -> None:
    """Measure topics over Cyclone DDS."""
    domain = 90 + (os.getpid() + nodes) % 100
    code = READER.format(root=str(Path(__file__).parents[1]), domain=domain, seconds=seconds)
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as reader:
        topics("ROS 2", open_sink(f"ros2:{domain}"), reader, seconds, nodes)


def topics_of_ros1(folder: Path, seconds: float, nodes: int) -> None:
    """Measure topics over rospy, if Debian's is installed."""
    if not Path("/usr/bin/rosmaster").exists():
        print("ROS 1  is not installed here (apt install python3-rosmaster python3-rospy python3-sensor-msgs)")
        return
    master = Master(folder)
    os.environ["ROS_IP"] = "127.0.0.1"
    words = ["/usr/bin/python3", "-c", READER1.format(seconds=seconds)]
    try:
        with subprocess.Popen(words, env=master.environment, stdout=subprocess.PIPE, text=True) as reader:
            topics("ROS 1", open_sink(f"ros1:{master.uri}"), reader, seconds, nodes)
    finally:
        master.close()


def paced(sink: Sink, keys: tuple[tuple[str, int], ...], rows: int, nodes: int) -> tuple[float, float, int]:
    """Give a sink rows and blocks at their times: seconds that it took, CPU seconds, and how many ticks were late."""
    cpu, began, late = time.process_time(), time.monotonic(), 0
    for k in range(rows):
        values = np.full((1, len(keys)), float(k))
        sink.write_group(GroupRows("all", keys, np.array([time.time()]), values, values * 0))
        if k % 2 == 0:
            for block in tick(k // 2, time.time(), nodes=nodes):
                sink.write(block)
        left = began + (k + 1) / RATE - time.monotonic()
        late += left < 0
        time.sleep(max(0.0, left))
    return time.monotonic() - began, time.process_time() - cpu, late


def topics(name: str, sink: Sink, reader: subprocess.Popen[str], seconds: float, nodes: int) -> None:
    """Publish rows and scalars of that many nodes at their times, and print how late the reader had the rows."""
    assert reader.stdout is not None
    _line(reader.stdout, "ready")
    known = facts(nodes)
    sink.open(known, STATION)
    keys = tuple(facts.key for facts in known)
    ready = time.monotonic() + 30
    while sink.stats.written < len(known) and time.monotonic() < ready:
        for block in tick(0, time.time(), nodes=nodes):
            sink.write(block)  # makes the topics of one value
        time.sleep(1)
    dropped = sink.stats.dropped
    rows = int(seconds * RATE)
    elapsed, used, late = paced(sink, keys, rows, nodes)
    end = np.full((1, len(keys)), -1.0)
    stats = sink.stats
    for _ in range(20):  # the end, for the reader
        sink.write_group(GroupRows("all", keys, np.array([time.time()]), end, end * 0))
        time.sleep(0.05)
    lags = np.array(json.loads(_line(reader.stdout, "["))[10:])
    sink.close()
    p50, p99 = np.percentile(lags, (50, 99))
    first, second = (float(np.percentile(half, 99)) for half in np.array_split(lags, 2))
    print(
        f"{name}  {nodes * CHANNELS:3d} channels: {len(lags) + 10} of {rows} rows read; "
        f"lag p50 {p50:.1f}, p99 {p99:.1f} ms (aim {LAG:.0f}: {verdict(met=p99 <= LAG)}); "
        f"p99 of the halves {first:.1f}, {second:.1f} (aim flat: {verdict(met=second <= first + FLAT)}); "
        f"{used / elapsed:.0%} of a core, {late} ticks late, {stats.dropped - dropped} values dropped, {stats.detail}",
        flush=True,
    )


def _line(lines: IO[str], begin: str) -> str:
    """Return the next line with this beginning; rospy prints other lines too."""
    for line in lines:
        if line.startswith(begin):
            return line
    raise SystemExit(f"The reader ended without a line that begins with {begin!r}.")


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
        f"kill -9 of the MCAP recorder, {rounds} times: {median(lost):.3f} s lost (median), {max(lost):.3f} s at most "
        f"(aim {KILLED}: {verdict(met=max(lost) <= KILLED)}); each file was readable"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10)
    parser.add_argument("--kills", type=int, default=10)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        for nodes in SIZES:
            recorders(Path(folder), arguments.seconds, nodes)
        for nodes in SIZES:
            topics_of_ros2(arguments.seconds, nodes)
        for nodes in SIZES:
            topics_of_ros1(Path(folder), arguments.seconds, nodes)
        kills(Path(folder), arguments.kills)


if __name__ == "__main__":
    main()
