"""One node from first Identify to verdict, in this process: what of it is the tool, the link, the node, the disk.

``python -m benchmarks.provisioning [--nodes 15]``: everything from one run on one machine, as ratios; nothing here is
a test. Nodes are virtual, in a process of their own; paced links last as long as real ones. Of each row: *find* (until
the node is known), *link* (the least that its octets occupy the wire), *node* (point operations × their delay), *disk*
(time in COMMIT), *tool* (what in this process is neither exchange nor COMMIT), and *rest*: turnarounds, both ends'
drivers, the scheduler. The ratio is the whole, find included, to link + node.
"""

from __future__ import annotations

import argparse
import os
import secrets
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import limits
from teds_provision.links import Capabilities, Contact, LinkSettings, Notice, open_port
from teds_provision.protocol.announce import default_can_address
from teds_provision.station.station import Station, initialise
from teds_provision.steps.build import BuildOrder
from teds_provision.steps.order import prepare
from teds_provision.steps.provision import provision
from teds_provision.store.database import Database
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.progress import Silent
from teds_provision.vault.passphrase import THROWAWAY

PROFILE = "magnetic-angular-position-sensor"
SLOW = 0.08


@dataclass
class Timed:
    """A link that counts: seconds inside exchange, and the octets of every request and reply."""

    inner: Any
    seconds: float = 0.0
    sizes: list[tuple[int, int]] = field(default_factory=list)

    @property
    def via(self) -> str:
        """As the link says."""
        return str(self.inner.via)

    @property
    def capabilities(self) -> Capabilities:
        """As the link says."""
        return self.inner.capabilities  # type: ignore[no-any-return]

    def exchange(self, frame: bytes) -> bytes:
        """Exchange, with a watch on it."""
        began = time.perf_counter()
        try:
            reply: bytes = self.inner.exchange(frame)
        finally:
            self.seconds += time.perf_counter() - began
        self.sizes.append((len(frame), len(reply)))
        return reply

    def close(self) -> None:
        """Close the link."""
        self.inner.close()


@dataclass
class Disk:
    """Seconds and number of COMMITs since it was last asked."""

    seconds: float = 0.0
    commits: int = 0

    def watch(self) -> None:
        """Have every COMMIT of this process counted from now on."""
        plain = Database.execute

        def execute(database: Database, statement: str, values: Any = ()) -> list[tuple[Any, ...]]:
            if statement != "COMMIT":
                return plain(database, statement, values)
            began = time.perf_counter()
            try:
                return plain(database, statement, values)
            finally:
                self.seconds += time.perf_counter() - began
                self.commits += 1

        Database.execute = execute  # type: ignore[method-assign]

    def taken(self) -> tuple[float, int]:
        """What came together, and begin anew."""
        both = self.seconds, self.commits
        self.seconds, self.commits = 0.0, 0
        return both


@dataclass(frozen=True)
class Run:
    """One node. Seconds; ``operations`` are those of the node's chip."""

    find: float
    whole: float
    link: float
    least: float
    disk: float
    commits: int
    operations: int
    authentic: bool

    @property
    def tool(self) -> float:
        """Seconds that this process took beside the link and the disk."""
        return self.whole - self.link - self.disk


@dataclass(frozen=True)
class Line:
    """What one row of the table measures. ``limit`` gives the least seconds of the octets, None for unpaced links."""

    title: str
    via: str
    words: tuple[str, ...] = ()
    limit: Callable[[limits.Sizes], float] | None = None
    options: str = ""
    delay: float = 0.0
    aim: float | None = None
    named: bool = False


LINES = (
    Line("NFC Type 4", "nfc"),
    Line("NFC Type 4, 106 kbit/s", "nfc", ("--pace",), limits.type4, aim=1.10),
    Line("NFC Type 4, 106 kbit/s, slow chip", "nfc", ("--pace",), limits.type4, delay=SLOW),
    Line("NFC Type 2, 106 kbit/s", "nfc", ("--pace", "--tag", "2")),
    Line("CAN", "can"),
    Line("CAN 500 kbit/s", "can", (), limits.classic, "&pace=1", aim=1.15),
    Line("CAN 500 kbit/s, named by UUID", "can", (), limits.classic, "&pace=1", aim=1.15, named=True),
    Line("CAN FD 500k/2M", "can", (), limits.fd, "&pace=1&fd=1", aim=1.5),
    Line("CAN FD 500k/2M, named by UUID", "can", (), limits.fd, "&pace=1&fd=1", aim=1.5, named=True),
    Line("CAN 500 kbit/s, slow chip", "can", (), limits.classic, "&pace=1", SLOW),
)


@contextmanager
def nodes(via: str, link: str, *extra: str) -> Iterator[subprocess.Popen[str]]:
    """The process with the nodes, until the block ends."""
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.nodes", via, link, *extra],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(20)


def next_node(process: subprocess.Popen[str]) -> tuple[bytes, int]:
    """Put another node down: its UUID, and the point operations of the one before."""
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    uuid, operations = process.stdout.readline().split()
    return bytes.fromhex(uuid), int(operations)


def measure(station: Station, disk: Disk, line: Line, count: int) -> list[Run]:
    """Provision ``count`` new nodes, one after the other."""
    if line.via == "nfc":
        link = f"udp:127.0.0.1:{free_port()}"
        settings = LinkSettings("nfc", nfc=link)
    else:
        link = f"udp_multicast:239.74.163.9?port={free_port()}{line.options}"
        settings = LinkSettings("can", can=link)
    runs: list[Run] = []
    order = prepare(station, BuildOrder(PROFILE))  # before the tap, as the command does
    words = (*line.words, *(("--crypto-delay", str(line.delay * 1000)) if line.delay else ()))
    with nodes(line.via, link, *words) as process:
        port = open_port(settings)
        try:
            for number in range(count + 1):
                uuid, operations = next_node(process)
                if runs:
                    runs[-1] = _with(runs[-1], operations)
                if number == count:
                    break
                time.sleep(0.7 if line.via == "can" else 0.0)  # its Announce, which is no part of this
                disk.taken()
                began = time.perf_counter()
                address = default_can_address(uuid) if line.named else None
                contact = port.find(
                    lambda identity, uuid=uuid: identity.uuid == uuid, seconds=20, notice=_quiet, address=address
                )
                found = time.perf_counter()
                timed = Timed(contact.link)
                known = Contact(contact.identity, timed, contact.tag_uid, contact.address)
                with Conversation(known, notice=_quiet) as node:
                    done = provision(station, node, order, accept=lambda who: None, reporter=Silent())
                ended = time.perf_counter()
                seconds, commits = disk.taken()
                least = line.limit(timed.sizes) if line.limit else 0.0
                good = done.verified.verdict == "authentic"
                runs.append(Run(found - began, ended - found, timed.seconds, least, seconds, commits, 0, good))
        finally:
            port.close()
    return runs


def _with(run: Run, operations: int) -> Run:
    return Run(run.find, run.whole, run.link, run.least, run.disk, run.commits, operations, run.authentic)


def _quiet(notice: Notice) -> None:
    return None


HEAD = (
    f"{'one node, in ms (median)':<36}{'find':>6}{'whole':>8}{'spread':>12}{'tool':>7}{'disk':>7}{'link':>7}"
    f"{'node':>7}{'rest':>7}{'ratio':>8}  aim"
)


def report(line: Line, runs: list[Run]) -> None:
    """Print one row."""

    def median(of: Callable[[Run], float]) -> float:
        return statistics.median(of(run) for run in runs)

    find, whole, least = median(lambda r: r.find), median(lambda r: r.whole), median(lambda r: r.least)
    tool, disk, operations = median(lambda r: r.tool), median(lambda r: r.disk), median(lambda r: r.operations)
    chip = operations * line.delay
    rest = whole - tool - disk - least - chip
    floor = least + chip
    ratio = (find + whole) / floor if least else None
    spread = f"{min(r.whole for r in runs) * 1e3:.0f}-{max(r.whole for r in runs) * 1e3:.0f}"
    cells = "".join(f"{value * 1e3:>7.0f}" for value in (tool, disk, least, chip, rest))
    told = f"{ratio:.2f}" if ratio is not None else "-"
    aim = "" if line.aim is None or ratio is None else f"{line.aim:.2f} {'met' if ratio <= line.aim else 'MISSED'}"
    failed = sum(not run.authentic for run in runs)
    bad = f"  {failed} FAILED" if failed else ""
    print(f"{line.title:<36}{find * 1e3:>6.0f}{whole * 1e3:>8.0f}{spread:>12}{cells}{told:>8}  {aim}{bad}", flush=True)


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=11, help="nodes a row")
    options = parser.parse_args(words)
    secret = secrets.token_hex(8)
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_DISK")) as folder:
        station, _ = initialise(
            Path(folder) / "home", name="bench", keystore="file", ask=lambda p, c: secret, costs=THROWAWAY
        )
        disk = Disk()
        disk.watch()
        measure(station, disk, LINES[0], 2)  # loads libraries and caches once, as --watch does
        print(HEAD)
        own: list[float] = []
        commits: list[int] = []
        for line in LINES:
            runs = measure(station, disk, line, options.nodes)
            report(line, runs)
            if line is LINES[0]:
                own = [run.tool + run.disk for run in runs]
                commits = [run.commits for run in runs]
        share, count = statistics.median(own) * 1e3, statistics.median(commits)
        met = "met" if share <= 10 and count <= 8 else "MISSED"
        print(f"own share (tool and disk): {share:.1f} ms, {count:.0f} commits; aim 10 ms, 8 commits: {met}")
        station.close()


def free_port() -> int:
    """A UDP port that nobody uses now."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    print(f"Python {sys.version.split()[0]}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    main()
