"""A service that measures and records through bad days: rounds of trouble until the time is over, then the accounts.

Usage: python -m tests.soak.run [--minutes M] (``make soak``). Each round sets the system's clock of the service by an
hour and back, fills the disk of its recording and frees it, pulls a serial CAN adapter and plugs it in again, and has
10,000 invented nodes answer on its bus. After every trouble all three nodes have to be measured again. At the end the
service has to stop in order, no value may stand under a wrong time, and its memory may not have grown by the rounds.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from teds_provision.client import Client
from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig
from tests.measure.test_clock_set import SystemClock, stamps
from tests.measure.test_full_disk import SmallDisk, fill
from tests.measure.test_pulled_adapter import Adapter
from tests.ncap.service import Service
from tests.places import free_bus
from tests.strangers.wire import Wire, frames_of

INVENTED = 10_000
AT_ONCE = 200
"""Invented nodes that answer one question."""
ROUND = 60.0
"""Seconds that are waited for one thing, at the most: the service looks for a node every 30 s at the latest."""
HOUR = 3600.0
GROWTH = 1.25
"""Times the memory of the first round that the last one may have."""


class Crowd:
    """Invents nodes on a bus: announces one after another, and answers each question to all as many of them."""

    def __init__(self, spec: str) -> None:
        group, _, query = spec.partition(":")[2].partition("?")
        port = int(dict(name.split("=") for name in query.split("&"))["port"])
        self.made = self.answers = 0
        self._wire = Wire(group, port, 1, True, lambda *_: None, self._other)

    def _other(self, frame: Any) -> None:
        identifier, data = frame.arbitration_id, bytes(frame.data)
        if identifier >> 8 != 0x18DBFF or data[:1] != b"\7":
            return
        for _ in range(AT_ONCE):
            self.made += 1
            self.answers += 1
            address, uuid = 1 + self.made % 239, os.urandom(10)
            identity = b"\1" + uuid + bytes([2, 0, 0, 0, 1, 0, 0, 0, 1, 2, 0, address])
            body = data[1:2] + b"\1" + len(identity).to_bytes(2, "big") + identity
            self._wire.put(0x18DA0000 | (identifier & 0xFF) << 8 | address, frames_of(body, True)[0], True)

    def come(self, count: int, until: Callable[[], bool]) -> None:
        """Invent so many, or as long as ``until`` is false."""
        end = self.made + count
        while self.made < end and not until():
            address = 1 + self.made % 239
            self._wire.put(0x1CFF0000 | address, bytes([1, 2]) + os.urandom(4) + bytes(2))
            self.made += 1
            self._wire.turn(0.002)

    def close(self) -> None:
        """Leave the bus."""
        self._wire.bus.shutdown()


def report(text: str) -> None:
    """One line of progress."""
    print(f"{time.strftime('%H:%M:%S')}  {text}", flush=True)


def soon(done: Callable[[], bool], what: str, seconds: float = ROUND) -> float:
    """Wait for it; the seconds that it took."""
    began = time.monotonic()
    while not done():
        if time.monotonic() - began > seconds:
            raise AssertionError(f"not within {seconds:.0f} s: {what}")
        time.sleep(0.1)
    return time.monotonic() - began


class Soak:
    """The service, its three nodes (two on FD, one behind the adapter), and what is done to them."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.rig = Rig(folder / "rig", {"a": ANGLE, "b": ANGLE, "s": ANGLE})
        self.serial = free_bus()
        for name, bus in (("a", self.rig.can), ("b", self.rig.can), ("s", self.serial)):
            self.rig.nodes[name].start(can=bus)
        self.clock, self.disk = SystemClock(folder), SmallDisk(folder / "disk")
        self.port = folder / "adapter"
        self.adapter: Adapter | None = None
        self.plug()
        words = [
            "--json",
            "ncap",
            "run",
            "--detection",
            "transparent",
            "--can",
            self.rig.can,
            "--can",
            f"slcan:{self.port}?sleep_after_open=0",
        ]
        words += ["--record", str(self.disk.folder)]
        self.service = Service(self.rig.desk, self.rig.station)
        self.running = self.rig.station.start(
            *words, program=self.disk.program, environment=self.clock.environment, fork=False
        )
        self.service.process = self.running
        self.running.wait_for('"ready"')
        self.shown = self.disk.seen_by(self.running)
        self.sinks: list[dict[str, Any]] = []
        self._over = threading.Event()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        while not self._over.is_set():
            self.running.read(0.2)

    def plug(self) -> None:
        """Plug the adapter in under the same name."""
        self.adapter = Adapter(self.serial)
        with contextlib.suppress(FileNotFoundError):
            self.port.unlink()
        self.port.symlink_to(self.adapter.name)

    @contextmanager
    def asked(self) -> Iterator[Client]:
        with self.service.client() as client:
            yield client

    def fresh(self, names: str = "abs") -> bool:
        """Whether a value of each of these nodes came within the last two seconds, by the service's own clock."""
        with self.asked() as client:
            for name in names:
                last = client.node(self.rig.nodes[name].uuid)["channels"][0].get("last")
                if last is None or abs(last["time"] - time.time() - self.offset) > 2.0:
                    return False
        return True

    offset = 0.0

    def measured(self, why: str, names: str = "abs", seconds: float = ROUND) -> None:
        """All are measured, now."""
        report(f"{why}: measured after {soon(lambda: self.fresh(names), why, seconds):.1f} s")

    def memory(self) -> int:
        """Resident memory of the service in KiB."""
        pid = self.running.process.pid
        text = Path(f"/proc/{pid}/status").read_text()
        return int(next(line.split()[1] for line in text.splitlines() if line.startswith("VmRSS")))

    def begin(self) -> None:
        """Measure all three."""
        with self.asked() as client:
            uuids = [node.uuid for node in self.rig.nodes.values()]
            client.request("POST", "/measurements", {"uuids": uuids, "rate": 50})
        self.measured("begin")

    def sink(self) -> dict[str, Any]:
        """Return the recording of the service."""
        with self.asked() as client:
            return dict(next(iter(client.status()["sinks"]), {}))

    def set_clock(self) -> None:
        """An hour on, and back."""
        for self.offset in (HOUR, 0.0):
            self.clock.put(self.offset)
            self.measured(f"clock set to {self.offset:+.0f} s")

    def fill_disk(self) -> None:
        """Full for a while, then free."""
        fill(self.shown)
        soon(lambda: self.sink()["state"] == "waiting", "the full disk is told")
        assert self.fresh(), "measuring goes on beside a full disk"
        kept = {Path(file).name for file in self.sink()["files"][-2:]}
        for part in self.shown.rglob("*"):
            if part.is_file() and part.name not in kept:  # the operator makes room
                part.unlink()
        report(f"disk freed: recorded again after {soon(lambda: self.sink()['state'] == 'running', 'the disk'):.1f} s")

    def pull(self) -> None:
        """Pull the adapter, and plug it in again."""
        assert self.adapter is not None
        self.adapter.pull()
        soon(lambda: not self.fresh("s"), "the pulled adapter shows")
        assert self.fresh("ab"), "the other bus is measured on"
        self.plug()
        self.measured("adapter plugged in again", seconds=2 * ROUND)

    def crowd(self) -> None:
        """Thousands of nodes that nobody made."""
        crowd, began, over = Crowd(self.rig.can), time.monotonic(), threading.Event()

        def discover() -> None:
            with self.asked() as client:
                while not over.wait(0.5):
                    client.request("POST", "/discover")

        asking = threading.Thread(target=discover)
        asking.start()
        try:
            crowd.come(INVENTED, lambda: time.monotonic() - began > ROUND)
            over.set()
            asking.join()
            with self.asked() as client:
                known = client.request("GET", "/nodes?limit=1")["total"]
        finally:
            over.set()
            asking.join()
            crowd.close()
        seconds = time.monotonic() - began
        report(f"{crowd.made} nodes invented in {seconds:.0f} s, {crowd.answers} of them answered; {known} are shown")
        assert known <= 1000, "invented nodes pile up"
        self.measured("crowd gone")

    def check(self) -> None:
        """What was recorded stands under the time at which it was measured."""
        now = time.time()
        read = 0
        for part in sorted(self.shown.rglob("*.csv")):
            with contextlib.suppress(Exception):  # the part that is being written
                times = stamps(part)
                assert times == sorted(times), part
                assert not times or any(abs(times[-1] - offset - now) < 86_400 for offset in (0.0, HOUR)), part
                read += len(times)
        report(f"{read} values in {len(list(self.shown.glob('*.csv')))} parts that are left")

    def close(self) -> None:
        """End it all."""
        self._over.set()
        self._reader.join()
        if self.adapter is not None:
            self.adapter.pull()
        self.rig.close()


def main(arguments: list[str]) -> int:
    """Run; 0 if every account is right."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=30.0)
    given = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="teds-soak-") as folder:
        soak = Soak(Path(folder))
        try:
            soak.begin()
            end, rounds, memory = time.monotonic() + 60 * given.minutes, 0, list[int]()
            while rounds < 1 or time.monotonic() < end:
                for trouble in (soak.set_clock, soak.fill_disk, soak.pull, soak.crowd):
                    trouble()
                rounds += 1
                memory.append(soak.memory())
                report(f"round {rounds}: {memory[-1] // 1024} MiB")
            soak.check()
            assert memory[-1] <= GROWTH * memory[0], f"its memory grew: {memory}"
            soak._over.set()
            soak._reader.join()
            soak.service.end()
            report(json.dumps({"rounds": rounds, "memory": memory}))
        finally:
            soak.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
