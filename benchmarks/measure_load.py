"""A large machine for ten minutes: 20 nodes of 25 channels at 100 Hz on two FD buses into text, MCAP and one ROS array.

Run: ``python -m benchmarks.measure_load [--seconds 600] [--nodes 1 5 20]``; the largest size runs for all of
``seconds``, the others for a tenth. The nodes' CPU is not counted: another process seals the messages of all of
them, two streams a node, and puts their frames on two CAN FD buses (udp_multicast) at their times. The station's side
is the product's: ports, hearing threads, streams, the grid of the group, sinks; ROS is Cyclone DDS, its array alone.
Counted is the CPU of this whole process (user and system). Sessions are left out, so clocks are known to 2 µs.
"""

from __future__ import annotations

import argparse
import itertools
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.pacing import sharp_timers
from teds_provision.links.can.port import CanPort
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.ports import free_port
from teds_provision.measure.blocks import Block, StationFacts
from teds_provision.measure.clock import ClockMap, Exchange, HostClock, MonotonicStamps
from teds_provision.measure.grid import Grid
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.measure.running.measurement import BEAT
from teds_provision.measure.sinks import Sink, open_sink
from teds_provision.measure.stream_receiver import HearingThread, ReceivedStream
from teds_provision.measure.verified_session import facts_of
from teds_provision.protocol.operation.can_frames import DataAddress, StreamAssembly, cut
from teds_provision.protocol.operation.datagram import DatagramSealer, stream_key
from teds_provision.protocol.operation.stream_commands import SubscribeReply
from teds_provision.protocol.operation.subscription import Receiver, StreamPlan
from teds_provision.teds.calibration.files import read_calibrations
from teds_provision.teds.image import Image
from teds_provision.teds.profile.load import parse_profile
from teds_provision.teds.sheet import Sheet

CHANNELS, RATE, N = 25, 100, 2
PERIOD, SECOND = 10_000_000, 10**9
KEY, STATION = bytes(32), 0xF1
HALVES = (tuple(range(1, 14)), tuple(range(14, 26)))
PROFILE = Path(__file__).parents[1] / "profiles" / "tactile-finger-sensor.toml"
APART = 1_000_000  # ns between the starts of one node and of the next
CORE, LATE, GROWTH = 1.0, N / RATE + 0.02, 1.05  # aims: cores, seconds from tick to sink (p99), memory at the end
BODIES = 64
TARGETS = ("run.csv", "run.mcap", "ros2:73")
STEP, LAGS = 1e-4, 50_000  # seconds of a bin of the lags, and how many bins


def node_address(node: int) -> int:
    """Return the CAN address of a node, 0 to 19."""
    return 0x20 + node


def plan_of(stream: int) -> StreamPlan:
    """Return the plan of one of the two streams of each node."""
    return StreamPlan.for_channels(stream, tuple((number, 2) for number in HALVES[stream]), n=N, period=PERIOD)


def sheet_of(node: int) -> Sheet:
    """Return a datasheet of 25 channels, each with a table of two segments."""
    text = PROFILE.read_text(encoding="utf-8").replace("1-12", f"1-{CHANNELS}")
    before, _, after = text.partition("members = [")
    profile = parse_profile(f"{before}members = {list(range(1, CHANNELS + 1))}{after.partition(']')[2]}")
    lines = "".join(f"0,0,{n}\n30000,5,{n}\n65535,10,{n}\n" for n in range(1, CHANNELS + 1))
    uuid = (node + 1).to_bytes(10, "big")
    calibration = read_calibrations(f"raw,value,channel\n{lines}", "bench.csv", profile)
    return Sheet.from_image(Image(uuid, profile.build(uuid, calibration=calibration).blocks))


# -- the nodes --------------------------------------------------------------------------------------------------------


class Feeder:
    """The nodes of all buses, without what makes them nodes."""

    def __init__(self, specs: list[str]) -> None:
        self._buses = [Bus(parse_spec(spec)) for spec in specs]
        self._sealer = DatagramSealer(stream_key(KEY, 1))
        chance = np.random.default_rng(1)
        self._bodies = [
            [b"\0" + chance.integers(0, 65536, N * len(half)).astype(">u2").tobytes() for _ in range(BODIES)]
            for half in HALVES
        ]

    def send(self, node: int, counter: int) -> None:
        """Send a message of each stream of a node."""
        bus = self._buses[node % len(self._buses)]
        for stream, bodies in enumerate(self._bodies):
            octets = self._sealer.seal(counter, bodies[(counter + node) % BODIES])
            for piece in cut(octets, fd=True):
                address = DataAddress(STATION, stream, piece.segment, node_address(node))
                bus.send(Frame(address.identifier, piece.data, fd=True))

    def close(self) -> None:
        """Close the buses."""
        for bus in self._buses:
            bus.close()


def feed(specs: list[str], nodes: int, began: int, messages: int) -> None:
    """Send the frames of all nodes; sample 0 of node k is taken at ``began`` + k ms (monotonic ns)."""
    sharp_timers()
    feeder, span, late = Feeder(specs), N * PERIOD, []
    for counter, node in itertools.product(range(messages), range(nodes)):
        # A message leaves when its last instant was taken.
        due = (began + node * APART + counter * span + (N - 1) * PERIOD) / SECOND
        left = due - time.monotonic()
        if left > 0:
            time.sleep(left)
        late.append(max(0.0, -left))
        feeder.send(node, counter)
    print(f"{np.percentile(late, 99) * 1e3:.1f} ms late (p99), {max(late) * 1e3:.0f} at most", flush=True)
    feeder.close()


# -- the station ------------------------------------------------------------------------------------------------------


@dataclass
class Load:
    """Result of a run of one size; ``lags``: blocks by the time from their oldest tick to the sinks, 0.1 ms each."""

    nodes: int
    seconds: float
    values: int = 0
    cpu: float = 0.0
    lost: int = 0
    late: int = 0
    dropped: int = 0
    rows: int = 0
    written: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)
    lags: list[int] = field(default_factory=lambda: [0] * LAGS)
    memory: list[float] = field(default_factory=list)
    feeder: str = ""
    threads: dict[str, float] = field(default_factory=dict)

    @property
    def expected(self) -> int:
        """Values that were sent."""
        return int(self.seconds * RATE / N) * N * CHANNELS * self.nodes

    def summary(self) -> str:
        """Return the row of the table."""
        below = np.cumsum(self.lags)
        p50, p99 = (float(np.searchsorted(below, below[-1] * share)) * STEP for share in (0.50, 0.99))
        cores = self.cpu / self.seconds
        early, end = self.memory[len(self.memory) // 5], self.memory[-1]
        whole = not (self.lost or self.late or self.dropped or self.errors) and self.values == self.expected
        return (
            f"{self.nodes:3d} nodes, {self.expected / self.seconds:6.0f} values/s for {self.seconds:.0f} s: "
            f"lost {self.lost}, late {self.late}, dropped {self.dropped} (aim 0: {_verdict(whole)}); "
            f"{cores:.0%} of a core (aim {CORE:.0%}: {_verdict(cores <= CORE)}); memory {early:.0f} to {end:.0f} MB "
            f"(aim flat: {_verdict(end <= early * GROWTH + 2)}); "
            f"tick to sink p50 {p50 * 1e3:.1f}, p99 {p99 * 1e3:.1f} ms "
            f"(aim {LATE * 1e3:.0f}: {_verdict(p99 <= LATE)}); {self.rows} rows of the group; of the CPU "
            f"{', '.join(f'{name} {used / sum(self.threads.values()):.0%}' for name, used in self.threads.items())}; "
            f"the nodes' process was {self.feeder}{''.join('; ' + error for error in self.errors)}"
        )


def _verdict(good: bool) -> str:
    return "met" if good else "MISSED"


class Machine:
    """The station's side of one run."""

    def __init__(self, nodes: int, began: int, sinks: list[Sink], load: Load) -> None:
        self.load, self._sinks = load, sinks
        self.heard: dict[tuple[int, int], ReceivedStream] = {}
        self._for_grid: deque[Block] = deque()
        self._host = HostClock()
        self._since = {}
        facts = []
        for node in range(nodes):
            sheet = sheet_of(node)
            # The tick is 1 s at the first sample.
            since = self._since[sheet.uuid.hex()] = began + node * APART - SECOND
            clock = ClockMap()
            clock.exchange(
                Exchange(since + SECOND // 2, since + SECOND // 2 + 2000, SECOND // 2 + 500, SECOND // 2 + 1500, 1, 20)
            )
            for stream in range(len(HALVES)):
                self.heard[node, stream] = self._stream(sheet, stream, clock)
            facts += [
                facts_of(sheet, channel, name="", fingerprint="00" * 32, period=PERIOD / SECOND)
                for channel in sheet.channels
            ]
        self.grid = Grid("all", facts, patience=N / RATE + 2 * BEAT)
        for sink in sinks:
            sink.open(facts, StationFacts("bench", "all", scalar_rate=0.0))

    def _stream(self, sheet: Sheet, stream: int, clock: ClockMap) -> ReceivedStream:
        plan = plan_of(stream)
        receiver = Receiver(plan, SubscribeReply(1, plan.length, SECOND), KEY)
        interpreter = StreamInterpreter(sheet, plan, 1, clock, self._host, MonotonicStamps())
        return ReceivedStream(
            receiver, StreamAssembly(plan.length, fd=True), interpreter, clock, threading.Lock(), self._block
        )

    def _block(self, block: Block) -> None:
        for sink in self._sinks:
            sink.write(block)
        self._for_grid.append(block)
        lag = (time.monotonic_ns() - self._since[block.uuid] - int(block.tick[0])) / SECOND
        self.load.lags[min(int(lag / STEP), LAGS - 1)] += 1

    def beat(self) -> None:
        """Give out the rows that are due, as the loop of a measurement does."""
        while self._for_grid:
            block = self._for_grid.popleft()
            self.load.values += block.value.size
            self.grid.add_block(block)
        rows = self.grid.rows(time.time())
        if rows is not None:
            self.load.rows += len(rows.time)
            for sink in self._sinks:
                sink.write_group(rows)


def run(nodes: int, seconds: float, folder: Path, targets: Sequence[str] = TARGETS) -> Load:
    """Run the load of one size."""
    load = Load(nodes, seconds)
    specs = [f"udp_multicast:239.74.163.{20 + number}?port={free_port()}&fd=1" for number in range(2)]
    sinks = [open_sink(name if ":" in name else str(folder / name)) for name in targets]
    began, messages = time.monotonic_ns() + 8 * SECOND, int(seconds * RATE / N)
    machine = Machine(nodes, began, sinks, load)
    ports = [CanPort(spec) for spec in specs]
    hearings = [HearingThread(port) for port in ports]
    for (node, stream), heard in machine.heard.items():
        hearing = hearings[node % len(hearings)]
        heard.pieces = hearing.expect(node_address(node), stream, heard.receiver.plan.length)
        hearing.register(node_address(node), stream, heard)
    words = [sys.executable, "-m", "benchmarks.measure_load", "--feed", *specs, "--began", str(began)]
    words += ["--messages", str(messages), "--nodes", str(nodes)]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as feeder:
        _watch(machine, feeder, began)
    for hearing in hearings:
        hearing.close()
    for port in ports:
        port.close()
    machine.beat()
    for sink in sinks:
        sink.close()
    _add_up(load, machine, sinks, messages)
    return load


def _watch(machine: Machine, feeder: subprocess.Popen[str], began: int) -> None:
    """Give out rows until the nodes' process has ended; count CPU and memory from the first sample on."""
    load = machine.load
    while time.monotonic_ns() < began:
        time.sleep(0.1)
    before, threads, looked = _cpu(), _by_thread(), 0.0
    while feeder.poll() is None:
        time.sleep(BEAT)
        machine.beat()
        if time.monotonic() - looked > load.seconds / 100:
            looked = time.monotonic()
            load.memory.append(_megabytes())
    time.sleep(0.2)
    load.cpu = _cpu() - before
    load.threads = {name: used - threads[name] for name, used in _by_thread().items()}
    assert feeder.stdout is not None
    load.feeder = feeder.stdout.readline().strip()


def _add_up(load: Load, machine: Machine, sinks: list[Sink], messages: int) -> None:
    """Add up the counts of receivers and sinks."""
    receivers = [stream.receiver for stream in machine.heard.values()]
    load.lost = sum(receiver.counts.lost + messages - 1 - receiver.last for receiver in receivers)
    load.late = sum(receiver.counts.late + receiver.counts.stale for receiver in receivers)
    load.dropped = sum(sink.stats.dropped for sink in sinks)
    load.errors = [why for why in (_wrong(sink, load.values) for sink in sinks) if why]


def _wrong(sink: Sink, values: int) -> str:
    """Return what went wrong with a sink; a recorder must have written everything."""
    if sink.files and sink.stats.written < values:
        return f"{sink.name} wrote {sink.stats.written} of {values}: {sink.stats.error}"
    return sink.stats.error


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def _by_thread() -> dict[str, float]:
    """Return CPU seconds of each kind of thread since it began."""
    kinds = {"can ": "receiving", "hearing": "opening and calibrating", "sink": "sinks", "MainThread": "rows"}
    found = dict.fromkeys([*kinds.values(), "DDS's own"], 0.0)
    names = {thread.native_id: thread.name for thread in threading.enumerate()}
    for task in Path("/proc/self/task").iterdir():
        name = names.get(int(task.name), "")
        kind = next((kind for begin, kind in kinds.items() if name.startswith(begin)), "DDS's own")
        user, system = (task / "stat").read_text().rpartition(")")[2].split()[11:13]
        found[kind] += (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    return found


def _megabytes() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 5, 20])
    parser.add_argument("--to", nargs="*", default=TARGETS, help="files by name, ros2:DOMAIN")
    parser.add_argument("--feed", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--began", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--messages", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.feed:
        feed(options.feed, options.nodes[0], options.began, options.messages)
        return
    for nodes in options.nodes:
        seconds = options.seconds if nodes == max(options.nodes) else max(5.0, options.seconds / 10)
        with tempfile.TemporaryDirectory() as folder:
            print(run(nodes, seconds, Path(folder), options.to).summary(), flush=True)


if __name__ == "__main__":
    main()
