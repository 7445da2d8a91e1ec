"""How long a node takes from tap to verified, how much of it is the tool's own, and how fast the tool starts.

``python -m benchmarks.provisioning [--nodes 100]``: prints everything from one run on one machine, so that ratios can
be compared; nothing here is a test. Nodes are virtual, in a process of their own, with no delays for cryptography or
flash; the station lives in this process. "Link" is the time inside ``Link.exchange``, "own" everything else.
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
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from teds_provision.links import Capabilities, Contact, LinkSettings, Notice, open_port
from teds_provision.links.can.pacing import classic_bits
from teds_provision.node.nfc.air import answer_seconds, command_seconds
from teds_provision.station.station import Station, initialise
from teds_provision.steps.build import BuildOrder
from teds_provision.steps.provision import provision
from teds_provision.talk.conversation import Conversation
from teds_provision.talk.progress import Silent
from teds_provision.vault.passphrase import THROWAWAY

PROFILE = BuildOrder("magnetic-angular-position-sensor")
FRAME_DELAY = (9 * 128 + 84 + 1172) / 13.56e6  # seconds: ISO/IEC 14443-3 clause 6.2, both directions
RECORD, STATUS = 40, 6  # octets: header, type and piece header of the payload record; the Te record
LARGEST_APDU_DATA = 248


@dataclass
class Timed:
    """A link that counts: seconds inside exchange, and the octets of every request and reply."""

    inner: object
    seconds: float = 0.0
    sizes: list[tuple[int, int]] = field(default_factory=list)

    @property
    def via(self) -> str:
        """As the link says."""
        return str(self.inner.via)  # type: ignore[attr-defined]

    @property
    def capabilities(self) -> Capabilities:
        """As the link says."""
        return self.inner.capabilities  # type: ignore[attr-defined, no-any-return]

    def exchange(self, frame: bytes) -> bytes:
        """Exchange, with a watch on it."""
        began = time.perf_counter()
        try:
            reply: bytes = self.inner.exchange(frame)  # type: ignore[attr-defined]
        finally:
            self.seconds += time.perf_counter() - began
        self.sizes.append((len(frame), len(reply)))
        return reply

    def close(self) -> None:
        """Close the link."""
        self.inner.close()  # type: ignore[attr-defined]


@dataclass(frozen=True)
class Run:
    """One node: seconds from its first Identify to the verdict, seconds inside the link, and the link's limit."""

    seconds: float
    link: float
    limit: float
    authentic: bool


def can_limit(sizes: list[tuple[int, int]]) -> float:
    """Seconds that all frames of these exchanges occupy a classic CAN bus of 500 kbit/s."""
    bits = classic_bits(0x18DA21F1, bytes(range(8)))
    return sum(_can_frames(size + 1) for pair in sizes for size in pair) * bits / 500_000


def _can_frames(octets: int) -> int:
    if octets <= 7:
        return 1
    consecutive = -(-(octets - 6) // 7)
    return 1 + consecutive + 1 + (consecutive - 1) // 16


def nfc_limit(sizes: list[tuple[int, int]]) -> float:
    """Seconds that these exchanges take on a Type 4 tag at 106 kbit/s, waiting times and presence checks left out."""

    def block(there: int, back: int) -> float:
        command = bytes(there + 1)
        return command_seconds(command) + FRAME_DELAY + answer_seconds(command, bytes(back + 1))

    total = 0.0
    for request, reply in sizes:
        for octets in _cut(2 + RECORD + request):
            total += block(5 + octets, 2)
        total += block(5, 4)
        for octets in _cut(RECORD + STATUS + reply):
            total += block(5, octets + 2)
    return total


def _cut(octets: int) -> list[int]:
    return [min(LARGEST_APDU_DATA, octets - at) for at in range(0, octets, LARGEST_APDU_DATA)]


@contextmanager
def nodes(via: str, link: str, *extra: str) -> Iterator[subprocess.Popen[str]]:
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
        process.wait(10)


def next_node(process: subprocess.Popen[str]) -> bytes:
    assert process.stdin is not None
    assert process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    return bytes.fromhex(process.stdout.readline())


def measure(station: Station, settings: LinkSettings, count: int, *extra: str) -> list[Run]:
    """Provision ``count`` new nodes, one after the other."""
    limit_of = nfc_limit if settings.via == "nfc" else can_limit
    link = settings.nfc if settings.via == "nfc" else settings.can
    assert link is not None
    runs = []
    with nodes(settings.via, link, *extra) as process:
        port = open_port(settings)
        try:
            for _ in range(count):
                uuid = next_node(process)
                contact = port.find(lambda identity, uuid=uuid: identity.uuid == uuid, seconds=20, notice=_quiet)
                began = time.perf_counter()
                timed = Timed(contact.link)
                known = Contact(contact.identity, timed, contact.tag_uid, contact.address)
                with Conversation(known, notice=_quiet) as node:
                    done = provision(station, node, PROFILE, accept=lambda who: None, reporter=Silent())
                    seconds = time.perf_counter() - began
                authentic = done.verified.verdict == "authentic"
                runs.append(Run(seconds, timed.seconds, limit_of(timed.sizes), authentic))
        finally:
            port.close()
    return runs


def _quiet(notice: Notice) -> None:
    return None


def report(title: str, runs: list[Run], *, limit: bool = False) -> None:
    total = statistics.median(run.seconds for run in runs) * 1e3
    own = statistics.median(run.seconds - run.link for run in runs) * 1e3
    line = f"{title:<34} {total:7.0f} ms per node, tool's own {own:5.0f} ms"
    if limit:
        least = statistics.median(run.limit for run in runs) * 1e3
        line += f", link's limit {least:5.0f} ms, ratio {total / least:.2f}"
    failures = sum(not run.authentic for run in runs)
    print(f"{line}{f', {failures} FAILED' if failures else ''}", flush=True)


def start_up() -> None:
    """Median of ten, beside the least that a click program can take."""

    def median(*command: str) -> float:
        times = []
        for _ in range(10):
            began = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            times.append(time.perf_counter() - began)
        return statistics.median(times) * 1e3

    python = sys.executable
    floor = median(python, "-c", "import click")
    for name in ("--help", "--version"):
        took = median(python, "-m", "teds_provision", name)
        print(f"{name:<34} {took:7.0f} ms, bare import click {floor:.0f} ms, ratio {took / floor:.2f}", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=100, help="nodes of the tap-after-tap run")
    options = parser.parse_args()
    secret = secrets.token_hex(8)
    start_up()
    with tempfile.TemporaryDirectory() as folder:
        station, _ = initialise(
            Path(folder) / "home", name="bench", keystore="file", ask=lambda p, c: secret, costs=THROWAWAY
        )
        nfc = LinkSettings("nfc", nfc=f"udp:127.0.0.1:{_port()}")
        can = LinkSettings("can", can=f"udp_multicast:239.74.163.9?port={_port()}")
        measure(station, nfc, 1)  # loads libraries and caches once, as --watch does
        report("NFC Type 4, t_wait 1 ms", measure(station, nfc, 15))
        report("NFC Type 4, t_wait 16 ms", measure(station, nfc, 10, "--wait-time", "20"))
        report("CAN, udp_multicast", measure(station, can, 15))
        report("NFC Type 4, paced at 106 kbit/s", measure(station, nfc, 5, "--pace"), limit=True)
        paced = LinkSettings("can", can=f"udp_multicast:239.74.163.9?port={_port()}&pace=1")
        report("CAN, paced at 500 kbit/s", measure(station, paced, 5), limit=True)
        began = time.perf_counter()
        runs = measure(station, nfc, options.nodes)
        took = time.perf_counter() - began
        failures = sum(not run.authentic for run in runs)
        each = statistics.mean(run.seconds for run in runs)
        print(
            f"{options.nodes} nodes tap after tap: {failures} failures, {3600 / each:.0f} nodes per hour of work, "
            f"{3600 * len(runs) / took:.0f} with the making of each node and the change of taps"
        )
        station.close()


def _port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


if __name__ == "__main__":
    print(f"Python {sys.version.split()[0]}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    main()
