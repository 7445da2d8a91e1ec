"""Opening, checking and calibrating messages of 25 values, against AES-CCM and numpy alone over the same octets.

Run: python -m benchmarks.measure [--profile]

The second paper's sensor: 16 bits at 10 kHz, n = 25, a message every 2.5 ms, with a table of two segments and limits.
Messages are made beforehand; counted is the CPU of this thread from a whole message to a block of values, time stamps,
clock and counters included. Three sizes: one message at a time, five (what comes in the 12 ms that the station gathers)
and forty (a station that fell behind). Two floors, both with AES-CCM message by message and numpy once for the same
messages together: *calibrated* computes what is asked for (table, limits, NaN), *bare* multiplies by a number.
The aim of three times is held against *calibrated*. From frames to files and topics: ``benchmarks.measure_load``.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import threading
import time
from collections.abc import Callable

import numpy as np

from teds_provision.measure.blocks import Block
from teds_provision.measure.clock import ClockMap, Exchange, HostClock, MonotonicStamps
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.measure.stream_receiver import ReceivedStream
from teds_provision.protocol.operation.can_frames import StreamAssembly
from teds_provision.protocol.operation.datagram import DatagramSealer, stream_key
from teds_provision.protocol.operation.stream_commands import SubscribeReply
from teds_provision.protocol.operation.subscription import Receiver, StreamPlan
from teds_provision.teds.calibration.files import read_calibrations
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet

N, PERIOD, MESSAGES, TIMES = 25, 100_000, 800, 15
TOGETHER = (1, 5, 40)
AIM = 3.0
KEY, SECOND = bytes(32), 10**9
KNOTS, VALUES, LOW, HIGH = np.array([0.0, 30000.0, 65535.0]), np.array([0.0, 5.0, 10.0]), -0.2, 10.2


def sheet() -> Sheet:
    """Return the datasheet of one channel with a table."""
    profile = load_profile("tactile-finger-sensor")
    calibration = read_calibrations("raw,value,channel\n0,0,1\n30000,5,1\n65535,10,1\n", "bench.csv", profile)
    uuid = bytes(9) + b"\1"
    return Sheet.from_image(Image(uuid, profile.build(uuid, calibration=calibration).blocks))


class Stream:
    """Messages of a stream, and what hears them."""

    def __init__(self, known: Sheet) -> None:
        self.plan = StreamPlan.for_channels(0, ((1, 2),), n=N, period=PERIOD)
        chance, sealer = np.random.default_rng(1), DatagramSealer(stream_key(KEY, 1))
        bodies = (b"\0" + chance.integers(0, 65536, N).astype(">u2").tobytes() for _ in range(MESSAGES))
        self.messages = [sealer.seal(k, body) for k, body in enumerate(bodies)]
        clock = ClockMap()
        # All of it lies in the past; the map knows the tick within 2 µs.
        self.base = time.monotonic_ns() - 100 * SECOND
        clock.exchange(Exchange(self.base, self.base + 2000, 500, 1500, 1, 20))
        self.blocks: list[Block] = []
        interpreter = StreamInterpreter(known, self.plan, 1, clock, HostClock(), MonotonicStamps())
        receiver = Receiver(self.plan, SubscribeReply(1, self.plan.length, SECOND), KEY)
        assembly = StreamAssembly(self.plan.length, fd=True)
        self.heard = ReceivedStream(receiver, assembly, interpreter, clock, threading.Lock(), self.blocks.append)

    def run(self, together: int) -> float:
        """Return CPU seconds for all messages, ``together`` at a time."""
        began = time.thread_time()
        at, span = self.base + SECOND, self.plan.span
        for number, message in enumerate(self.messages, 1):
            at += span
            self.heard.queue_message(message, at)
            if number % together == 0:
                self.heard.finish()
        used = time.thread_time() - began
        assert self.heard.receiver.counts.good == MESSAGES
        return used


def floor(messages: list[bytes], together: int, compute: Callable[[np.ndarray], object]) -> float:
    """Return CPU seconds of AES-CCM and numpy alone."""
    sealer = DatagramSealer(stream_key(KEY, 1))
    began = time.thread_time()
    for at in range(0, len(messages), together):
        plain = [sealer.open(message) for message in messages[at : at + together]]
        bodies = [item[1:] for item in plain if item is not None]
        compute(np.frombuffer(b"".join(bodies), ">u2").astype(np.float64))
    return time.thread_time() - began


def bare(raw: np.ndarray) -> object:
    """Compute one multiplication."""
    return raw * 1.5


def calibrated(raw: np.ndarray) -> object:
    """Calibrate by a table and limits; NaN beyond them."""
    value = np.interp(raw, KNOTS, VALUES)
    valid = (value >= LOW) & (value <= HIGH)
    if not valid.all():
        value[~valid] = np.nan
    return value, valid


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--profile", action="store_true", help="show where the time goes, five messages at a time")
    known = sheet()
    if parser.parse_args().profile:
        stream, profile = Stream(known), cProfile.Profile()
        profile.runcall(stream.run, 5)
        pstats.Stats(profile).strip_dirs().sort_stats("tottime").print_stats(25)
        return
    print(f"messages of {N} values (µs each, the best of {TIMES} runs)")
    for together in TOGETHER:
        ours = floors = exact = float("inf")
        for _ in range(TIMES):
            stream = Stream(known)
            ours = min(ours, stream.run(together))
            floors = min(floors, floor(stream.messages, together, bare))
            exact = min(exact, floor(stream.messages, together, calibrated))
        us = (f"{seconds / MESSAGES * 1e6:.1f}" for seconds in (ours, exact, floors))
        print(
            f"{together:3d} together: ours {next(us)}, calibrated {next(us)}, bare {next(us)}: "
            f"{ours / exact:.1f} × calibrated (aim {AIM:.0f}: {'met' if ours / exact <= AIM else 'MISSED'}), "
            f"{ours / floors:.1f} × bare",
            flush=True,
        )


if __name__ == "__main__":
    main()
