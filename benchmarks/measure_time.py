"""Time in measuring: stamps against the known truth, from tick to sink, from a node's start to a value in a file.

Run: python -m benchmarks.measure_time [--seconds 10] [--nodes 1 5 20]

Virtual nodes in a process of their own over CAN FD on udp_multicast. Their clocks run on the host's monotonic one,
which both processes read, so the true time of every tick is known; the station knows nothing of that. One CPU-bound
process beside it is "under load". Wall time: other work on the machine makes the figures worse.
"""

from __future__ import annotations

import argparse
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from teds_provision.links.can.port import CanPort
from teds_provision.measure.blocks import Block
from teds_provision.measure.buses import Buses
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.running.measurement import Watcher
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.node.can.server import CanServer
from teds_provision.node.hardware.board import Board
from teds_provision.node.node_template import create
from teds_provision.node.realtime_loop import RealtimeLoop
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.operation.streams import DataFrame
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.records import KeptMeasurement
from teds_provision.teds.image import Image
from teds_provision.teds.sheet import Sheet
from teds_provision.vault import passphrase
from tests.bench import on_reader

TYPE, RATE, N = "magnetic-angular-position-sensor", 100.0, 2
STAMPS, SINK, FIRST = 1e-3, 20e-3, 1.0  # seconds: the aims; a sink's beside n periods
SETTLING = 2.0  # seconds until stamps are judged
CALIBRATION = "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n"


def provisioned(station: Station, folder: Path, name: str) -> bytes:
    """Provision a node with a signed, calibrated datasheet; return its UUID."""
    create(folder, name=name, profile=TYPE)
    node = VirtualNode(folder)
    (folder / "calibration.csv").write_text(CALIBRATION)
    order = BuildOrder(TYPE, calibration=folder / "calibration.csv", name=name)
    with Conversation(on_reader(node), notice=lambda _notice: None) as talk:
        provision(station, talk, order, operator=AcceptingOperator(), reporter=SilentReporter())
    return node.tim.flash.uuid


def serve(can: str, folders: Sequence[str]) -> None:
    """Run the nodes' process: print, for each, the host's time at which its clock was at 0."""
    pulse, server = RealtimeLoop(), CanServer(can)
    boards: dict[str, Board] = {}
    for folder in folders:
        node = VirtualNode(
            Path(folder),
            board=lambda file: Board(Sheet.from_image(Image(file.load().uuid, file.hardware)), source="ramp:2"),
            pulse=pulse,
        )
        server.add(node, measuring_handler=node)
        node.streams_over(_sender(server, node))
        assert node.board is not None
        boards[node.tim.flash.uuid.hex()] = node.board
    pulse.start()
    for board in boards.values():
        board.start()
    server.start()
    print(json.dumps({uuid: board.clock._since for uuid, board in boards.items()}), flush=True)
    threading.Event().wait()


def _sender(server: CanServer, node: VirtualNode) -> Callable[[DataFrame], None]:
    return lambda frame: server.send_data(node, frame.identifier, frame.data, fd=frame.fd)


@dataclass
class SizeResult:
    """Result of one size; seconds."""

    nodes: int
    stamps: np.ndarray
    lags: np.ndarray
    apart: float
    first: float


class Bench:
    """A station and its nodes; each run is a measurement."""

    def __init__(self, folder: Path, most: int) -> None:
        self.folder = folder
        self.station = initialise(
            folder / "home", name="bench", keystore="file", ask=lambda *_: "bench station", costs=passphrase.THROWAWAY
        )[0]
        self.nodes = {provisioned(self.station, folder / f"n{k}", f"n{k}"): folder / f"n{k}" for k in range(most)}
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
            free.bind(("127.0.0.1", 0))
            self.can = f"udp_multicast:239.74.163.2?port={free.getsockname()[1]}&fd=1"

    def run(self, count: int, seconds: float) -> SizeResult:
        """Measure so many nodes; they are switched on while the measurement waits for them."""
        uuids = tuple(self.nodes)[:count]
        file = self.folder / f"run-{count}-{time.monotonic_ns()}.csv"
        kept = KeptMeasurement("", uuids=uuids, rate=RATE, sinks=(str(file),), owner="command")
        job = MeasurementJob(self.station, kept, request=MeasurementRequest(timeout=60.0))
        came: list[tuple[int, Block]] = []
        stop, port = threading.Event(), CanPort(self.can)
        with ExitStack() as stack:
            stack.callback(port.close)
            buses = stack.enter_context(Buses([port]))
            watcher = Watcher(block=lambda block: came.append((time.monotonic_ns(), block)))
            measuring = threading.Thread(target=lambda: job.run(buses, stop, watcher=watcher))
            measuring.start()
            while job.measurement is None or not job.measurement.supervisors:
                time.sleep(0.01)
            time.sleep(1.5)  # it asked and got no answer: it waits
            offset = job.measurement._host.present[1]
            began, nodes = time.monotonic(), self._power(uuids)
            stack.callback(nodes.wait)
            stack.callback(nodes.kill)
            assert nodes.stdout is not None
            since = json.loads(nodes.stdout.readline())
            on = time.monotonic()
            first = _first_row(file) - on
            print(f"  (the nodes' process took {on - began:.2f} s to start)", flush=True)
            stop.wait(seconds + SETTLING)
            stop.set()
            measuring.join(30)
        assert job.ended is not None
        return _found(count, came, since, offset, job.ended.apart, first)

    def _power(self, uuids: Sequence[bytes]) -> subprocess.Popen[str]:
        words = ["node", self.can, *(str(self.nodes[uuid]) for uuid in uuids)]
        command = [sys.executable, "-m", "benchmarks.measure_time", *words]
        return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def _first_row(file: Path) -> float:
    """Wait for the first row of values in the file, and return its time (monotonic)."""
    while True:
        rows = [line for line in file.read_text().splitlines() if line and not line.startswith(("#", "time,"))]
        if rows:
            return time.monotonic()
        time.sleep(0.005)


def _found(
    count: int, came: list[tuple[int, Block]], since: dict[str, int], offset: float, apart: float, first: float
) -> SizeResult:
    stamps, lags = [], []
    began = min(at for at, _ in came)
    for at, block in came:
        if at - began < SETTLING * 1e9:
            continue
        true = (block.tick.astype(np.float64) + since[block.uuid]) / 1e9
        stamps.append(block.time - (true + offset))
        lags.append(at / 1e9 - true)
    return SizeResult(count, np.abs(np.concatenate(stamps)), np.concatenate(lags), apart, first)


def main() -> None:
    if sys.argv[1:2] == ["node"]:
        serve(sys.argv[2], sys.argv[3:])
        return
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1, 5, 20])
    options = parser.parse_args()
    load = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        with tempfile.TemporaryDirectory() as folder:
            bench = Bench(Path(folder), max(options.nodes))
            found = [bench.run(count, options.seconds) for count in options.nodes]
    finally:
        load.kill()
        load.wait()
    due = N / RATE + SINK
    print(f"{RATE:.0f} Hz, n = {N}, CAN FD on loopback, one CPU-bound process beside it; milliseconds")
    aims = f"stamps p50, p99 (aim 1) | tick to sink p50, p99 (aim {due * 1e3:.0f}) | start to first row (aim 1000)"
    print(f"nodes | {aims} | begun apart")
    for current in found:
        stamps, lags = np.percentile(current.stamps, (50, 99)), np.percentile(current.lags, (50, 99))
        print(
            f"{current.nodes:5} | {stamps[0] * 1e3:6.3f} {stamps[1] * 1e3:7.3f} {_verdict(stamps[1] <= STAMPS):7}"
            f" | {lags[0] * 1e3:6.1f} {lags[1] * 1e3:7.1f} {_verdict(lags[1] <= due):7}"
            f" | {current.first * 1e3:6.0f} {_verdict(current.first <= FIRST):7} | {current.apart * 1e3:.3f}"
        )


def _verdict(good: bool) -> str:
    return "met" if good else "NOT met"


if __name__ == "__main__":
    main()
