"""Growth with the number of nodes: commands on stores of 10 to 100,000 nodes, wall time, memory and exponents.

Run: ``python -m benchmarks.scale [SIZE …]`` (default 10 1000 10000 100000). Each command is the shipped one, a
process of its own, the median of three runs (one at 100,000). ``CPU`` and ``MB`` are those at the largest size.
``exponent``: 0 is flat, 1 grows as the nodes do, between the two largest sizes, less the time of a command that does
nothing (``--version``). Aims: issue 13 row 8, issue 9 "At scale".
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.bulk import BulkRows
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.records import KeyRecord, NodeRecord, WhitelistEntry, utc_now
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile
from teds_provision.vault import passphrase
from teds_provision.vault.base import node_key_context
from teds_provision.vault.selection import forget_vaults

PASSPHRASE = "correct horse battery"
RECEIVER = "receiver"
NODE_PORT = 28653
SIZES = (10, 1000, 10_000, 100_000)
_CHUNK = 2000


@dataclass(frozen=True)
class Row:
    """One command: its words, and what it may take at 100,000 nodes (seconds, MB; None for no aim)."""

    name: str
    words: tuple[str, ...]
    seconds: float | None = None
    megabytes: float | None = 100.0
    once: bool = False
    """Whether a second run would find it done."""


@dataclass(frozen=True)
class CommandCost:
    """Seconds on the wall and of the processor, and megabytes, of one command."""

    seconds: float
    megabytes: float
    cpu: float


def fill(home: Path, count: int) -> None:
    """Make a station with so many provisioned nodes: pin, key, datasheet, and an entry of the audit log each."""
    forget_vaults()
    costs = passphrase.THROWAWAY
    station, _ = initialise(home, name="n", keystore="file", ask=lambda p, c: PASSPHRASE, costs=costs)
    points = [SoftwareKey(number).point for number in range(1, 98)]
    octets = load_profile("temperature-sensor").build(bytes(10)).blocks
    for first in range(0, count, _CHUNK):
        numbers = range(first, min(count, first + _CHUNK))
        entries = [WhitelistEntry(_uuid(n), fingerprint(points[n % 97]), name=f"node-{n}") for n in numbers]
        with station.transaction():
            station.bulk.put(
                BulkRows(
                    nodes=[_node(number, points) for number in numbers],
                    whitelist=entries,
                    keys=[_key(station, number) for number in numbers],
                )
            )
            for number in numbers:
                signed = {**octets, (0, 128): os.urandom(900)}
                station.datasheets.put(Image(_uuid(number), signed), "temperature-sensor")
                station.audit("verify", _uuid(number), "authentic")
    station.close()
    forget_vaults()


def _uuid(number: int) -> bytes:
    return hashlib.sha256(number.to_bytes(4, "big")).digest()[:10]


def _node(number: int, points: list[bytes]) -> NodeRecord:
    return NodeRecord(
        _uuid(number),
        points[number % 97],
        f"node-{number}",
        "temperature-sensor",
        2,
        1,
        3,
        last_seen=utc_now(),
        channels=1,
        teds_sha256="ab" * 32,
    )


def _key(station: Station, number: int) -> KeyRecord:
    uuid, key = _uuid(number), hashlib.sha256(b"k" + number.to_bytes(4, "big")).digest()
    sealed = station.vault.wrap(key[:16], context=node_key_context(station.id, uuid, 1, 1))
    return KeyRecord(uuid, 1, key[:8].hex(), "active", 1, sealed)


def commands(folder: Path, count: int) -> Iterator[Row]:
    """Yield the timed commands on a store of ``count`` nodes."""
    last = _uuid(count - 1).hex()
    listed = str(folder / f"whitelist{count}.csv")
    yield Row("--version", ("--version",))
    yield Row("nodes UUID", ("nodes", last), 0.15)
    yield Row("nodes NAME", ("nodes", f"node-{count - 1}"), 0.15)
    yield Row("log --last 20", ("log", "--last", "20"), 0.15)
    yield Row("nodes --json", ("--json", "nodes"))
    yield Row("nodes (table)", ("nodes",))
    yield Row("nodes TEXT", ("nodes", last[:7]))
    yield Row("log", ("log",))
    yield Row("whitelist list", ("whitelist", "list"))
    yield Row("whitelist add", ("whitelist", "add", "ee" * 10))
    yield Row("whitelist export", ("whitelist", "export", listed))
    yield Row("whitelist import", ("whitelist", "import", listed), None, None)  # whole or not at all: no list
    yield Row("doctor", ("doctor",), 1.0, None)
    yield Row("doctor --full", ("doctor", "--full"), None, None)
    bundle, sealed = str(folder / f"bundle{count}"), str(folder / f"backup{count}")
    words = ("export-keys", "--to", RECEIVER, "--all", "--mode", "copy", "--output", bundle, "--yes")
    yield Row("export-keys", words, None, None, once=True)
    yield Row(
        "import-keys", ("--home", str(folder / f"receiver{count}"), "import-keys", bundle, "--yes"), None, None, True
    )
    yield Row("backup", ("backup", sealed), None, None, once=True)
    restored = ("--home", str(folder / f"restored{count}"), "restore", sealed, "--keystore", "file", "--yes")
    yield Row("restore", restored, None, None, once=True)
    nfc = f"udp:localhost:{NODE_PORT}"
    yield Row("provision (NFC)", ("provision", "-p", "temperature-sensor", "--yes", "--nfc", nfc), None, None, True)


def json_of(home: Path, *words: str) -> dict[str, Any]:
    """Run a command with --json that is not timed; its one object."""
    read, write = os.pipe()
    os.write(write, PASSPHRASE.encode() + b"\n")
    os.close(write)
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "--passphrase-fd", str(read), "--json"]
    done = subprocess.run([*command, *words], capture_output=True, text=True, check=True, pass_fds=(read,))
    os.close(read)
    return dict(json.loads(done.stdout))


def acquaint(folder: Path, home: Path, count: int) -> None:
    """Make a second station, and exchange keys: one hands over, one takes in."""
    receiver = folder / f"receiver{count}"
    keys = {
        "sender": json_of(home, "init"),
        RECEIVER: json_of(receiver, "init", "--keystore", "file", "--name", RECEIVER),
    }
    for at, name in ((receiver, "sender"), (home, RECEIVER)):
        file = folder / f"{name}{count}.pem"
        file.write_text(keys[name]["public_key"])
        json_of(at, "trust", "add", name, str(file), "--yes")


@contextmanager
def node(folder: Path) -> Iterator[None]:
    """Run a factory node on the simulated reader of ``provision``."""
    json_of(folder, "node", "create", str(folder / "node"))
    command = [sys.executable, "-m", "teds_provision", "node", "run", str(folder / "node")]
    process = subprocess.Popen([*command, "--nfc", f"udp:localhost:{NODE_PORT}"], stdout=subprocess.PIPE)
    try:
        assert process.stdout is not None
        process.stdout.readline()
        yield
    finally:
        process.terminate()
        process.wait(20)
        shutil.rmtree(folder / "node")


def run(home: Path, words: tuple[str, ...]) -> CommandCost:
    """Run the program once, output thrown away; the passphrase comes through a pipe."""
    read, write = os.pipe()
    os.write(write, PASSPHRASE.encode() + b"\n")
    os.close(write)
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "--passphrase-fd", str(read), *words]
    begun = time.perf_counter()
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, pass_fds=(read,))
    os.close(read)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        print(f"exit {process.returncode}: {' '.join(words)}", file=sys.stderr)
    return CommandCost(time.perf_counter() - begun, usage.ru_maxrss / 1024, usage.ru_utime + usage.ru_stime)


def main(sizes: tuple[int, ...]) -> None:
    """Fill a store of each size, time every command on it, and print the table."""
    taken: dict[str, dict[int, CommandCost]] = {}
    rows: dict[str, Row] = {}
    with tempfile.TemporaryDirectory() as name:
        for size in sizes:
            home = Path(name, str(size))
            fill(home, size)
            octets = (home / "store.sqlite3").stat().st_size
            print(f"{size} nodes: {octets / size / 1000:.2f} kB a node", file=sys.stderr, flush=True)
            acquaint(Path(name), home, size)
            for row in commands(Path(name), size):
                rows[row.name] = row
                with node(Path(name)) if row.name.startswith("provision") else nullcontext():
                    runs = [run(home, row.words) for _ in range(1 if row.once or size >= 100_000 else 3)]
                median = statistics.median(taken.seconds for taken in runs)
                cpu, most = statistics.median(taken.cpu for taken in runs), max(taken.megabytes for taken in runs)
                taken.setdefault(row.name, {})[size] = CommandCost(median, most, cpu)
    print_table(sizes, rows, taken)


def print_table(sizes: tuple[int, ...], rows: dict[str, Row], taken: dict[str, dict[int, CommandCost]]) -> None:
    """Print one row per command: seconds at each size, memory at the largest, the exponent, the verdict on its aim."""
    print("command".ljust(18) + "".join(f"{size:>10}" for size in sizes) + "       CPU        MB  exponent  aim")
    nothing = taken["--version"]
    for name, entry in taken.items():
        cells = "".join(f"{entry[size].seconds:>8.2f} s" for size in sizes)
        most, least = entry[sizes[-1]], nothing[sizes[-1]]
        exponent, aim = _exponent(sizes, entry, nothing), _aim(rows[name], most, least)
        print(f"{name:<18}{cells}{most.cpu:>8.2f} s{most.megabytes:>10.0f}{exponent:>10}  {aim}")
    table, listed = taken["nodes (table)"][sizes[-1]], taken["nodes --json"][sizes[-1]]
    print(f"table / JSON: {table.seconds / listed.seconds:.2f} (aim 2)")


def _exponent(sizes: tuple[int, ...], taken: dict[int, CommandCost], nothing: dict[int, CommandCost]) -> str:
    if len(sizes) < 2:
        return "-"
    small, large = (max(0.005, taken[size].seconds - nothing[size].seconds) for size in sizes[-2:])
    return f"{math.log(large / small) / math.log(sizes[-1] / sizes[-2]):.2f}"


def _aim(row: Row, at_most: CommandCost, nothing: CommandCost) -> str:
    notes = []
    if row.seconds is not None:
        own = at_most.seconds - (nothing.seconds if row.seconds < 1 else 0)
        notes.append(f"{'met' if own <= row.seconds else 'MISSED'}: {own:.2f} of {row.seconds} s")
    if row.megabytes is not None and at_most.megabytes > row.megabytes:
        notes.append(f"MISSED: {at_most.megabytes:.0f} of {row.megabytes:.0f} MB")
    return ", ".join(notes)


if __name__ == "__main__":
    main(tuple(map(int, sys.argv[1:])) or SIZES)
