"""The station's side of measuring: frames in, checked and calibrated values out, into text, MCAP and a ROS array.

Run: python -m benchmarks.measure [--seconds 5]

Frames are made beforehand, so the nodes' work is not counted; no bus is between. CPU seconds, not wall time, so that
the ratios hold on a machine that does other things too. Three sizes: 1, 5 and 20 nodes of 24 channels at 100 Hz, two
streams each. The floor is what cannot be left out: AES-CCM and numpy alone over the same messages, one at a time.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from pathlib import Path

import numpy as np

from teds_provision.links.can.bus import Frame
from teds_provision.measure.blocks import Block, StationFacts
from teds_provision.measure.clock import ClockMap, Exchange, Monotone, Wall
from teds_provision.measure.facts import facts_of
from teds_provision.measure.grid import Grid
from teds_provision.measure.hearing import HeardStream
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.measure.sinks import Sink, open_sink
from teds_provision.protocol.operation.can_frames import Assembly, cut
from teds_provision.protocol.operation.datagram import Sealer, stream_key
from teds_provision.protocol.operation.stream_commands import Subscribed
from teds_provision.protocol.operation.subscription import Plan, Receiver
from teds_provision.teds.calibration.files import read_calibrations
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet

PERIOD, CHANNELS = 10_000_000, 12
KEY = bytes(32)
SECOND = 10**9


def sheet(number: int) -> Sheet:
    profile = load_profile("tactile-finger-sensor")
    lines = "".join(f"0,0,{n}\n30000,5,{n}\n65535,10,{n}\n" for n in range(1, CHANNELS + 1))
    calibrations = read_calibrations(f"raw,value,channel\n{lines}", "bench.csv", profile)
    uuid = number.to_bytes(10, "big")
    return Sheet.of(Image(uuid, profile.build(uuid, calibration=calibrations).blocks))


class Stream:
    """One stream of a node: its messages as frames, and what hears them."""

    def __init__(self, number: int, messages: int, deliver: object, wall: Wall) -> None:
        self.sheet = sheet(number)
        widths = tuple((n, 2) for n in range(1, CHANNELS + 1))
        self.plan = Plan.of(0, widths, n=2, period=PERIOD)
        reply = Subscribed(1, self.plan.length, SECOND)
        chance = np.random.default_rng(number)
        sealer = Sealer(stream_key(KEY, 1))
        bodies = [chance.integers(0, 65536, 2 * CHANNELS).astype(">u2").tobytes() for _ in range(messages)]
        self.messages = [sealer.seal(k, b"\0" + body) for k, body in enumerate(bodies)]
        self.frames = [list(cut(message, fd=True)) for message in self.messages]
        clock = ClockMap()
        now = time.monotonic_ns()
        # Ticks run from the first message on; the map knows that within 2 µs, and all of it lies in the past.
        self.base = now - SECOND - messages * self.plan.span
        clock.exchange(Exchange(self.base, self.base + 2000, 500, 1500, 1, 20))
        interpreter = StreamInterpreter(self.sheet, self.plan, 1, clock, wall, Monotone())
        receiver = Receiver(self.plan, reply, KEY, oldest=1 << 62)
        assembly = Assembly(self.plan.length, fd=True)
        self.heard = HeardStream(receiver, assembly, interpreter, clock, threading.Lock(), deliver)  # type: ignore[arg-type]


def floor(streams: list[Stream]) -> float:
    """CPU seconds of AES-CCM and numpy alone."""
    sealer = Sealer(stream_key(KEY, 1))
    slope = np.linspace(1, 2, CHANNELS)
    began = time.process_time()
    for stream in streams:
        for message in stream.messages:
            plain = sealer.open(message)
            assert plain is not None
            np.frombuffer(plain, ">u2", offset=1).reshape(-1, CHANNELS).astype(np.float64) * slope
    return time.process_time() - began


def run(nodes: int, seconds: float, sinks: list[Sink]) -> tuple[int, float, float]:
    """Values, CPU seconds from frames to all sinks, and of opening and calibrating alone."""
    messages = int(seconds * SECOND / (2 * PERIOD))
    blocks: list[Block] = []
    streams = [Stream(number, messages, blocks.append, Wall.now()) for number in range(1, 2 * nodes + 1)]
    facts = [
        facts_of(one.sheet, channel, name="", fingerprint="00" * 32, period=PERIOD / 1e9)
        for one in streams
        for channel in one.sheet.channels
    ]
    grid = Grid("all", facts, patience=0.1)
    for sink in sinks:
        sink.open(facts, StationFacts("bench", "all"))
        while sink.stats.state == "starting":
            time.sleep(0.05)
    time.sleep(1)
    began = time.process_time()
    opened, values = 0.0, 0
    for k in range(messages):
        before = time.thread_time()
        for stream in streams:
            for segment, data in stream.frames[k]:
                stream.heard.take(segment, Frame(0, data, True, at=time.monotonic()))
        if k % 2 == 1:
            for stream in streams:
                stream.heard.finish()
        opened += time.thread_time() - before
        for block in blocks:
            values += block.value.size
            for sink in sinks:
                sink.write(block)
            grid.take(block)
        blocks.clear()
        rows = grid.rows(time.time())
        if rows is not None:
            for sink in sinks:
                sink.write_group(rows)
        while any(sink.stats.written + 300_000 < values for sink in sinks if sink.files):
            time.sleep(0.01)
    for sink in sinks:
        sink.close()
    used = time.process_time() - began
    counts = [stream.heard.receiver.counts for stream in streams]
    assert sum(one.good for one in counts) == messages * len(streams), counts[0]
    assert not any(sink.stats.error for sink in sinks)
    return messages * len(streams) * 2 * CHANNELS, used, opened / max(floor(streams), 1e-9)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=5)
    seconds = parser.parse_args().seconds
    for nodes in (1, 5, 20):
        with tempfile.TemporaryDirectory() as folder:
            sinks = [open_sink(str(Path(folder) / name)) for name in ("run.csv", "run.mcap")] + [open_sink("ros2:73")]
            values, used, ratio = run(nodes, seconds, sinks)
        share = f"{used / seconds:5.0%} of a core into text, MCAP and ROS 2"
        print(f"{nodes:3d} nodes, {values / seconds:7.0f} values/s: {share};", end=" ")
        print(f"open, check, calibrate: {ratio:.1f} × AES-CCM and numpy alone", flush=True)


if __name__ == "__main__":
    main()
