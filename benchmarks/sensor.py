"""The second paper's sensor: 16 bits at 10 kHz from a virtual node over a paced bus into a file, and nothing lost.

Run: ``python -m benchmarks.sensor [--seconds 60]``. Node and station are the shipped commands, processes of their own,
on a bus that is held to the time of the wire: CAN FD by multicast, classic CAN over a socketcand server (a third
process, of Python) and by multicast. Told apart are what the counters of the messages miss (*lost*), what the node did
not take in time (it reports that), and what the kernel of this machine threw away meanwhile, of all programs
(*harness*). Bus load is that of the frames that went, to the bit; beside it the figure of docs/operation.md section 6,
from which it may be 5 % off. On a machine that does other things too, ``nice -n -15`` replaces a quiet one.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.provisioning import PROFILE
from teds_provision.links.can.pacing import classic_bits, fd_seconds
from teds_provision.links.ports import free_port
from teds_provision.protocol.operation.can_frames import cut

RATE = 10_000
PASSPHRASE = b"correct horse battery\n"
BUSES = (
    ("CAN FD 500k/2M", False, "&pace=1&fd=1", True, 500_000, 13.1),
    ("CAN 1 Mbit/s, socketcand", True, "&pace=1&bitrate=1000000", False, 1_000_000, 36.0),
    ("CAN 1 Mbit/s, multicast", False, "&pace=1&bitrate=1000000", False, 1_000_000, 36.0),
)
OFF = 0.05  # share of the table's load that the measured one may be off
NODE = "8d4d9da65281f7000000"


def command(home: Path, *words: str) -> subprocess.CompletedProcess[str]:
    """Run the program; the passphrase comes through a pipe."""
    read, write = os.pipe()
    os.write(write, PASSPHRASE)
    os.close(write)
    program = [sys.executable, "-m", "teds_provision", "--home", str(home), "--passphrase-fd", str(read)]
    try:
        return subprocess.run([*program, *words], pass_fds=(read,), capture_output=True, text=True, check=True)
    except subprocess.CalledProcessError as error:
        raise SystemExit(f"{' '.join(words)}: {error.stderr}") from error
    finally:
        os.close(read)


SERVER = """
import sys
from tests.links.can.hub import Hub
hub = Hub()
print(hub.spec, flush=True)
sys.stdin.read()
"""


@contextmanager
def bus(*, socketcand: bool) -> Iterator[str]:
    """Yield the bus for ``--can``: a multicast, or a server that gives each frame to all others."""
    if not socketcand:
        yield f"udp_multicast:239.74.163.10?port={free_port()}"
        return
    words = [sys.executable, "-c", SERVER]
    with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        assert server.stdin is not None
        yield server.stdout.readline().strip()
        server.stdin.close()


def thrown_away() -> int:
    """Return the datagrams for which no socket of this machine had room, so far (UDP RcvbufErrors)."""
    head, values = [line.split() for line in Path("/proc/net/snmp").read_text().splitlines() if line.startswith("Udp:")]
    return int(values[head.index("RcvbufErrors")]) if "RcvbufErrors" in head else 0


def seconds_of_a_message(octets: int, *, fd: bool, bitrate: int) -> float:
    """Return how long the frames of one message occupy the bus; its octets are random, as ciphertext is."""
    total = 0.0
    for segment, data in cut(random.randbytes(octets), fd=fd):
        identifier = 0x1CFF0021 | segment << 8
        if fd:
            total += fd_seconds(identifier, data, bitrate, 2_000_000)
        else:
            total += classic_bits(identifier, data) / bitrate
    return total


def provisioned(folder: Path, link: str, home: Path) -> None:
    """Give the node its key and its datasheet."""
    calibration = folder / "angle.csv"
    calibration.write_text(f"# date: {time.strftime('%Y-%m-%d')}\nraw,value [degree]\n0,0\n32768,180\n65535,360\n")
    words = ("--via", "can", "--can", link, "--profile", PROFILE, "--calibration", str(calibration), "--yes")
    command(home, "provision", NODE, *words)


def rows_of(file: Path) -> int:
    """Return the rows of values in a text file."""
    with file.open(encoding="utf-8") as lines:
        return sum(1 for line in lines if not line.startswith("#")) - 1


def measured(name: str, link: str, *, fd: bool, bitrate: int, table: float, seconds: int) -> None:
    """Provision a node on one bus, measure it, and print a line."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        home, node, run = folder / "home", folder / "node", folder / "run.csv"
        command(home, "init", "--name", "bench", "--keystore", "file")
        command(home, "node", "create", str(node), "--uuid", NODE, "--profile", PROFILE)
        program = [sys.executable, "-m", "teds_provision", "node", "run", str(node)]
        program += ["--can", link, "--source", "sine:1"]
        with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as running:
            assert running.stdout is not None
            running.stdout.readline()
            provisioned(folder, link, home)
            before = thrown_away()
            words = ("--rate", str(RATE), "--duration", str(seconds), "--can", link, "--to", str(run))
            report = command(home, "measure", NODE, *words)
            harness = thrown_away() - before
            running.terminate()
            missed = [line.split(": ", 1)[-1].strip() for line in running.stdout if "could not leave" in line]
        rows = rows_of(run)
    text = report.stdout + report.stderr
    found = re.search(r"(\d+) values in (\d+) messages, lost (\d+), late (\d+), bad (\d+)", text)
    assert found is not None, text
    values, messages, lost, late, bad = map(int, found.groups())
    n = round(values / messages)
    load = seconds_of_a_message(13 + 2 * n, fd=fd, bitrate=bitrate) * RATE / n
    whole = values == rows >= seconds * RATE and not any((lost, late, bad, missed))
    verdict = "met" if whole and abs(load * 100 / table - 1) <= OFF else "MISSED"
    print(
        f"{name:<25} {values} values ({rows} rows in the file) in {seconds} s, n = {n}: lost {lost}, late {late}, "
        f"bad {bad}; harness {harness}; node {missed[-1] if missed else 'in time'}; "
        f"bus load {load:.1%} (table {table} % for n = 113); aim, not one lost: {verdict}",
        flush=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=int, default=60)
    seconds = parser.parse_args().seconds
    print(f"load {os.getloadavg()[0]:.1f}")
    for name, socketcand, options, fd, bitrate, table in BUSES:
        with bus(socketcand=socketcand) as link:
            measured(name, link + options, fd=fd, bitrate=bitrate, table=table, seconds=seconds)


if __name__ == "__main__":
    main()
