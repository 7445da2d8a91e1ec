"""One node from first Identify to verdict, in this process: what of it is the tool, the link, the node, the disk.

``python -m benchmarks.provisioning [--nodes 15]``: everything from one run on one machine, as ratios; nothing here is
a test. Nodes are virtual, in a process of their own; paced links last as long as real ones. Of each row: *find* (until
the node is known), *tool* (what in this process is neither exchange nor COMMIT), *disk* (time in COMMIT), *link* (the
least that the octets occupy the wire, finding included), *wait* (what the contract waits: the random wait of this node
after a question to everyone, t_wait), *node* (point operations × their delay, and its flash), and *rest*: turnarounds,
both ends' drivers, the scheduler. With a node in C (``firmware/``, built here where gcc and BearSSL are) *node* is what
its P-256 and its flash took; what else is its own, from the arrival of what it answers to the first bit of its answer,
stands in a line below, and ``--exchanges`` shows where the station's part lies. The ratio is the whole, find included,
to link + wait + node, median of what it was for each node; the one *before* is to the octets of the exchanges after the
finding and the point operations alone, as it was reckoned until 2026-11-21.

``--alone``: the store is in memory, this process has the first core to itself and the nodes have the others. What is
left above the ratio's floor is then the station's own: one interpreter, on one core.
"""

from __future__ import annotations

import argparse
import operator
import os
import secrets
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks import limits
from benchmarks.machine import line as machine
from teds_provision.links import Capabilities, Contact, LinkSettings, Notice, open_port
from teds_provision.links.ports import free_port
from teds_provision.protocol.announce import default_can_address
from teds_provision.protocol.messages.identity import Identity
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.database import Database
from teds_provision.vault.passphrase import THROWAWAY

PROFILE = "magnetic-angular-position-sensor"
SLOW = 0.08


class Span(NamedTuple):
    """When an exchange began and ended; seconds of perf_counter."""

    began: float
    ended: float


@dataclass
class TimedLink:
    """A link that counts: when each exchange was, and the octets of its request and reply."""

    inner: Any
    spans: list[Span] = field(default_factory=list)
    sizes: list[tuple[int, int]] = field(default_factory=list)
    commands: list[str] = field(default_factory=list)

    @property
    def seconds(self) -> float:
        """Seconds inside exchange."""
        return sum(span.ended - span.began for span in self.spans)

    @property
    def via(self) -> str:
        """Return that of the link."""
        return str(self.inner.via)

    @property
    def capabilities(self) -> Capabilities:
        """Return that of the link."""
        return self.inner.capabilities  # type: ignore[no-any-return]

    def exchange(self, frame: bytes) -> bytes:
        """Exchange, with a watch on it."""
        began = time.perf_counter()
        try:
            reply: bytes = self.inner.exchange(frame)
        finally:
            self.spans.append(Span(began, time.perf_counter()))
        self.sizes.append((len(frame), len(reply)))
        self.commands.append(f"{frame[2]}.{frame[3]}")
        return reply

    def close(self) -> None:
        """Close the link."""
        self.inner.close()


@dataclass
class Disk:
    """Seconds and number of COMMITs since it was last asked; ``waited`` are those that waited for the disk."""

    seconds: float = 0.0
    commits: int = 0
    waited: int = 0
    hurried: bool = False

    def watch(self) -> None:
        """Have every COMMIT of this process counted from now on."""
        plain = Database.execute

        def execute(database: Database, statement: str, values: Any = ()) -> list[tuple[Any, ...]]:
            if statement != "COMMIT":
                if statement.startswith("PRAGMA synchronous"):
                    self.hurried = statement.endswith("NORMAL")
                return plain(database, statement, values)
            began = time.perf_counter()
            try:
                return plain(database, statement, values)
            finally:
                self.seconds += time.perf_counter() - began
                self.commits += 1
                self.waited += not self.hurried

        Database.execute = execute  # type: ignore[method-assign, assignment]

    def taken(self) -> tuple[float, int, int]:
        """Return the counts (seconds, commits, those waited for), and reset them."""
        all_three = self.seconds, self.commits, self.waited
        self.seconds, self.commits, self.waited = 0.0, 0, 0
        return all_three


@dataclass(frozen=True)
class Run:
    """One node. Seconds; of ``link`` the octets take ``octets`` and the contract ``waits``; see limits.Limit.

    ``operations`` are those of the node's chip, ``flash`` the seconds until what it stored was safe. Of a node in C,
    ``chip``: the seconds of its P-256; ``turned``: of all the rest of its part.
    """

    find: float
    whole: float
    link: float
    octets: float
    waits: float
    exchanges: float
    disk: float
    commits: int
    waited: int
    authentic: bool
    timed: TimedLink
    operations: int = 0
    flash: float = 0.0
    chip: float = 0.0
    turned: float = 0.0

    def ratio(self, delay: float) -> float:
        """Return the ratio of the whole, finding included, to the least that link, waits and node take.

        ``delay`` is the time of a point operation.
        """
        node = self.operations * delay + self.chip + self.flash
        return (self.find + self.whole) / (self.octets + self.waits + node)

    @property
    def tool(self) -> float:
        """Seconds that this process took beside the link and the disk."""
        return self.whole - self.link - self.disk


@dataclass(frozen=True)
class Line:
    """Subject of one row of the table. ``limit`` gives the least seconds, None for unpaced links."""

    title: str
    via: str
    words: tuple[str, ...] = ()
    limit: limits.Limit | None = None
    options: str = ""
    delay: float = 0.0
    aim: float | None = None
    named: bool = False
    in_c: bool = False

    @property
    def asks_everyone(self) -> bool:
        """True if its nodes are found by a broadcast, which each answers after a random wait."""
        return self.via == "can" and self.limit is not None and not self.named


LINES = (
    Line("NFC Type 4", "nfc"),
    Line("NFC Type 4, 106 kbit/s", "nfc", ("--pace",), limits.TYPE4, aim=1.10),
    Line("NFC Type 4, 106 kbit/s, slow chip", "nfc", ("--pace",), limits.TYPE4, delay=SLOW),
    Line("NFC Type 2, 106 kbit/s", "nfc", ("--pace", "--tag", "2")),
    Line("CAN", "can"),
    Line("CAN 500 kbit/s", "can", (), limits.CLASSIC, "&pace=1", aim=1.15),
    Line("CAN 500 kbit/s, named by UUID", "can", (), limits.CLASSIC, "&pace=1", aim=1.15, named=True),
    Line("CAN FD 500k/2M", "can", (), limits.FD, "&pace=1&fd=1", aim=1.5),
    Line("CAN FD 500k/2M, named by UUID", "can", (), limits.FD, "&pace=1&fd=1", aim=1.5, named=True),
    Line("CAN 500 kbit/s, slow chip", "can", (), limits.CLASSIC, "&pace=1", SLOW),
    Line("node in C: NFC Type 4, 106 kbit/s", "nfc", (), limits.TYPE4, aim=1.10, in_c=True),
    Line("node in C: CAN 500 kbit/s, named", "can", (), limits.CLASSIC, "&pace=1", aim=1.08, named=True, in_c=True),
    Line("node in C: CAN FD 500k/2M, named", "can", (), limits.FD, "&pace=1&fd=1", aim=1.20, named=True, in_c=True),
)
MEMORY = Path("/dev/shm")
OWN_SHARE = 0.05
"""Aim: what a node in C takes beside its P-256 and its flash, of the time of the link."""


_ALL_CORES = os.sched_getaffinity(0)


def _cores_of_nodes() -> set[int]:
    """Return the cores that the station leaves to the nodes: all of them, unless it has one to itself."""
    own = os.sched_getaffinity(0)
    return _ALL_CORES - own or own


@contextmanager
def nodes(via: str, link: str, *extra: str) -> Iterator[subprocess.Popen[str]]:
    """Run the process with the nodes for the block."""
    process = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.nodes", via, link, *extra],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    os.sched_setaffinity(process.pid, _cores_of_nodes())
    try:
        yield process
    finally:
        assert process.stdin is not None
        process.stdin.close()
        process.wait(20)


class NodeUsage(NamedTuple):
    """Costs of the node before: point operations, seconds of its flash, and of its wait before it answered all.

    Of a node in C also the seconds of its P-256, and of all else that was its own.
    """

    operations: int
    flash: float
    waited: float
    chip: float
    turned: float


def next_node(process: subprocess.Popen[str]) -> tuple[bytes, NodeUsage]:
    """Put another node down: its UUID, and what the one before took."""
    return next_nodes([process])[0]


def next_nodes(processes: Sequence[subprocess.Popen[str]]) -> list[tuple[bytes, NodeUsage]]:
    """Put another node down on each of these readers, all of them at once; see :func:`next_node`."""
    for process in processes:
        assert process.stdin is not None
        process.stdin.write("\n")
        process.stdin.flush()
    lines = [process.stdout.readline().split() for process in processes if process.stdout is not None]
    return [(bytes.fromhex(line[0]), NodeUsage(int(line[1]), *map(float, line[2:]))) for line in lines]


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
    words = (*line.words, *(("--crypto-delay", str(line.delay * 1000)) if line.delay else ()), *(["--c"] * line.in_c))
    with nodes(line.via, link, *words) as process:
        port = open_port(settings)
        try:
            for number in range(count + 1):
                uuid, before = next_node(process)
                if runs:
                    waits = before.waited if line.asks_everyone else runs[-1].waits
                    part = {name: getattr(before, name) for name in ("operations", "flash", "chip", "turned")}
                    runs[-1] = replace(runs[-1], waits=waits, **part)
                if number == count:
                    break
                time.sleep(0.7 if line.via == "can" else 0.0)  # its Announce, which is no part of this
                disk.taken()
                began = time.perf_counter()
                address = default_can_address(uuid) if line.named else None
                contact = port.find(partial(_has_uuid, uuid), seconds=20, notice=_quiet, address=address)
                found = time.perf_counter()
                timed = TimedLink(contact.link)
                known = Contact(contact.identity, timed, contact.tag_uid, contact.address)
                with Conversation(known, notice=_quiet) as node:
                    done = provision(station, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
                ended = time.perf_counter()
                good = done.verified.verdict == "authentic"
                limit = _least(line, timed.sizes)
                runs.append(Run(found - began, ended - found, timed.seconds, *limit, *disk.taken(), good, timed))
        finally:
            port.close()
    return runs


def _least(line: Line, sizes: limits.Sizes) -> tuple[float, float, float]:
    """Return the least of octets, of the contract's waits, and of the exchanges alone; 0 for unpaced links."""
    if line.limit is None:
        return 0.0, 0.0, 0.0
    return line.limit.octets(sizes), line.limit.waits(len(sizes)), line.limit.exchanges(sizes)


def _has_uuid(uuid: bytes, identity: Identity) -> bool:
    return identity.uuid == uuid


def _quiet(notice: Notice) -> None:
    return None


HEAD = (
    f"{'one node, in ms (median)':<36}{'find':>6}{'whole':>8}{'spread':>12}{'tool':>7}{'disk':>7}{'link':>7}"
    f"{'wait':>7}{'node':>7}{'rest':>7}{'before':>8}{'ratio':>8}  aim"
)


def report(line: Line, runs: list[Run]) -> None:
    """Print one row."""

    def median(of: Callable[[Run], float]) -> float:
        return statistics.median(of(run) for run in runs)

    find, whole, octets, waits = (median(operator.attrgetter(name)) for name in ("find", "whole", "octets", "waits"))
    tool, disk = median(lambda run: run.tool), median(lambda run: run.disk)
    chip = median(lambda run: run.operations) * line.delay + median(lambda run: run.chip)
    node = chip + median(lambda run: run.flash)
    rest = find + whole - tool - disk - octets - waits - node
    spread = f"{min(run.whole for run in runs) * 1e3:.0f}-{max(run.whole for run in runs) * 1e3:.0f}"
    cells = "".join(f"{value * 1e3:>7.0f}" for value in (tool, disk, octets, waits, node, rest))
    print(f"{line.title:<36}{find * 1e3:>6.0f}{whole * 1e3:>8.0f}{spread:>12}{cells}", end="")
    if line.limit is None:
        print(f"{'-':>8}{'-':>8}", end="")
    else:
        ratio = median(lambda run: run.ratio(line.delay))
        print(f"{(find + whole) / (median(lambda run: run.exchanges) + chip):>8.2f}{ratio:>8.2f}", end="")
        if line.aim is not None:
            print(f"  {line.aim:.2f} {'met' if ratio <= line.aim else 'MISSED'}", end="")
    failed = sum(not run.authentic for run in runs)
    print(f"  {failed} FAILED" if failed else "", flush=True)
    if line.in_c:
        own = median(lambda run: run.turned / run.octets)
        met = "met" if own <= OWN_SHARE else "MISSED"
        print(f"{'  its own part beside chip and flash':<36}{own:>6.1%} of the link's time; aim {OWN_SHARE:.0%}: {met}")


def report_exchanges(line: Line, runs: list[Run]) -> None:
    """Print each exchange of a row: what it took, the least that its octets take, and what passed before it."""
    if line.limit is None:
        return
    least_of = line.limit.octets
    print(f"{'':<8}{'octets':>12}{'link':>8}{'taken':>8}{'beyond':>8}{'before it':>11}  ms (median)")
    for number, sizes in enumerate(runs[0].timed.sizes):
        like = [run for run in runs if len(run.timed.sizes) == len(runs[0].timed.sizes)]
        spans = [run.timed.spans[number] for run in like]
        taken = statistics.median(span.ended - span.began for span in spans) * 1e3
        gaps = [run.timed.spans[number].began - run.timed.spans[number - 1].ended for run in like] if number else [0.0]
        least = (least_of([sizes]) - least_of([])) * 1e3
        name = runs[0].timed.commands[number]
        octets = f"{sizes[0]}, {sizes[1]}"
        print(f"  {name:<6}{octets:>12}{least:>8.2f}{taken:>8.2f}", end="")
        print(f"{taken - least:>8.2f}{statistics.median(gaps) * 1e3:>11.2f}")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=11, help="nodes a row")
    parser.add_argument("--only", default="", help="rows whose title holds this word")
    parser.add_argument("--exchanges", action="store_true", help="show each exchange of each row")
    parser.add_argument("--alone", action="store_true", help="store in memory, the station alone on one core")
    options = parser.parse_args(words)
    if options.alone:
        if len(_ALL_CORES) < 2:
            raise SystemExit("--alone needs two cores.")
        os.environ["BENCH_DISK"] = str(MEMORY)
    has_c = subprocess.run(["make", "-C", "firmware", "host"], capture_output=True, check=False).returncode == 0
    secret = secrets.token_hex(8)
    if options.alone:
        os.sched_setaffinity(0, {min(_ALL_CORES)})
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_DISK")) as folder:
        station, _ = initialise(
            Path(folder) / "home", name="bench", keystore="file", ask=lambda p, c: secret, costs=THROWAWAY
        )
        disk = Disk()
        disk.watch()
        measure(station, disk, LINES[0], 5)  # loads libraries and caches once, as --watch does
        print(HEAD)
        own: list[float] = []
        commits: list[tuple[int, int]] = []
        for line in LINES:
            if options.only not in line.title or (line.in_c and not has_c):
                continue
            runs = measure(station, disk, line, options.nodes)
            report(line, runs)
            if options.exchanges:
                report_exchanges(line, runs)
            if line is LINES[0]:
                own = [run.tool + run.disk for run in runs]
                commits = [(run.commits, run.waited) for run in runs]
        if not has_c:
            print("node in C: not built here (make firmware)")
        if not own:
            station.close()
            return
        share, (count, waited) = statistics.median(own) * 1e3, max(commits)
        met = "met" if share <= 10 and count <= 8 else "MISSED"
        print(
            f"own share (tool and disk): {share:.1f} ms ({min(own) * 1e3:.1f} to {max(own) * 1e3:.1f}), {count} commits"
            f" of which {waited} wait for the disk; aim 10 ms, 8 commits: {met}"
        )
        station.close()


if __name__ == "__main__":
    print(machine())
    main()
