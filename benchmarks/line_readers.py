"""A line of eight readers with jobs, an office behind PostgreSQL, and evidence, beside the same without them.

``python -m benchmarks.line_readers [--readers 8] [--boards 64] [--pace] [--crypto-delay MS]``: a line station and an
office, each in its own home, joined to a registry on the bench's server; the shipped commands, as processes: ``signer
run``, and ``provision --watch`` over all readers, once with ``--profile`` alone at a station that signs itself, once
with ``--job``. On a reader the next board comes as soon as the line about the last one is out. Nodes, server, office
and line share this machine's cores: so beside boards an hour is what the processor did for each board, by the line
alone and by all processes. ``--pace`` makes a frame take what it takes at 106 kbit/s.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

import teds_provision
from benchmarks.commands import PASSPHRASE, finished, started
from benchmarks.machine import line as machine
from benchmarks.provisioning import next_node, next_nodes, nodes
from teds_provision import plant
from teds_provision.handover import trust
from teds_provision.links.ports import free_port
from teds_provision.plant.demo.cluster import Cluster, programs, running
from teds_provision.protocol.plant.document import open_request
from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import THROWAWAY
from teds_provision.vault.selection import forget_vaults
from tests.plant.owner import ANGLE

AIM = 0.9
_DATABASE = "plant"
_TICK = os.sysconf("SC_CLK_TCK")


class Throughput(NamedTuple):
    """Boards an hour; processor seconds a board of the line's command, and of it with its office and database."""

    an_hour: float
    line: float
    all: float


@contextmanager
def plant_of_two(folder: Path, server: Cluster) -> Iterator[tuple[Path, Path, Path]]:
    """Make homes: an office (keeper, sign), its line station (line), and a station alone that signs itself."""

    def ask(prompt: str, confirm: bool) -> str:
        return PASSPHRASE

    alone, _ = initialise(folder / "alone", name="alone", keystore="file", ask=ask, costs=THROWAWAY)
    alone.close()
    office, _ = initialise(folder / "office", name="office", keystore="file", ask=ask, costs=THROWAWAY)
    asked = trust.ask_for_certificate(folder / "line", name="line", keystore="file", ask=ask)
    line = trust.adopt_certificate(folder / "line", trust.sign_request(office, trust.read_request(asked)), ask=ask)
    roster, _ = plant.owner.create(office, "bench")
    server.psql(f"create database {_DATABASE}")
    server.psql(plant.schema.registry_sql(roster.registry), _DATABASE)
    requests = {}
    for station in (office, line):
        requests[station.name] = request = open_request(plant.membership.request(station))
        server.psql(plant.schema.member_sql(request.fingerprint, request.login), _DATABASE)
    added = plant.owner.add(office, requests["line"], frozenset({"line"}))
    plant.apply_pages.put_roster(office, plant.owner.signed(office, added))
    office.close()
    line.close()
    forget_vaults()
    for home in (folder / "office", folder / "line"):
        finished(started(home, "registry", "connect", server.url(_DATABASE), "--yes"))
        finished(started(folder / "office", "registry", "sync"))
    yield folder / "office", folder / "line", folder / "alone"


def make_job(office: Path, line: Path, boards: int) -> str:
    """Make a job for the line, signed for by the office, sent and known there."""
    words = ("--title", "bench", "--profile", ANGLE, "--station", "line", "--count", str(boards), "--sign", "office")
    job: str = json.loads(finished(started(office, "job", "new", *words, "--ends", "2099-01-01")))["id"]
    finished(started(office, "job", "send", job))
    finished(started(line, "registry", "sync"))
    return job


def processor(*processes: int) -> float:
    """Return the processor seconds of these processes and all that they started, ended children included."""
    total = 0
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if int(entry.name) in processes or int(fields[1]) in processes:
                total += sum(map(int, fields[11:15]))
    return total / _TICK


def run(
    home: Path, readers: int, boards: int, words: Sequence[str], node_words: Sequence[str], *others: int
) -> Throughput:
    """Put ``boards`` boards down on ``readers`` readers, and time them from the second round on."""
    links = [f"udp:127.0.0.1:{free_port()}" for _ in range(readers)]
    with ExitStack() as stack:
        places = [stack.enter_context(nodes("nfc", link, *node_words)) for link in links]
        named = [word for link in links for word in ("--nfc", link)]
        watch = started(home, "provision", "--watch", "--yes", *words, *named)
        assert watch.stdout is not None
        lies = {uuid.hex(): place for place, (uuid, _) in zip(places, next_nodes(places), strict=True)}
        put, began, used = readers, 0.0, (0.0, 0.0)
        for done, text in enumerate(watch.stdout, 1):
            record = json.loads(text)
            if record.get("verdict") != "authentic":
                raise SystemExit(f"a board failed: {record}")
            if done == readers:  # everything is loaded, unlocked, connected
                began, used = time.perf_counter(), (processor(watch.pid), processor(watch.pid, *others))
            place = lies.pop(record["uuid"])
            if put < boards + readers:
                lies[next_node(place)[0].hex()] = place
                put += 1
            if done == boards + readers:
                break
        taken = time.perf_counter() - began
        after = processor(watch.pid), processor(watch.pid, *others)
        watch.terminate()
        watch.communicate(timeout=60)
    return Throughput(3600 * boards / taken, (after[0] - used[0]) / boards, (after[1] - used[1]) / boards)


def main(words: list[str] | None = None) -> None:
    """Measure both in turn, twice, and print the better of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--readers", type=int, default=8)
    parser.add_argument("--boards", type=int, default=64)
    parser.add_argument("--pace", action="store_true")
    parser.add_argument("--crypto-delay", type=float, default=0.0, help="milliseconds a point operation of the boards")
    options = parser.parse_args(words)
    bin = programs()
    if bin is None:
        raise SystemExit("no PostgreSQL 15 here (scripts/install-test-packages)")
    compileall.compile_dir(Path(teds_provision.__file__).parent, quiet=2)
    kind = (["--pace"] if options.pace else []) + ["--crypto-delay", str(options.crypto_delay)]
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_DISK")) as name:
        folder = Path(name)
        folder.chmod(0o755)  # the server runs as another user
        with running(folder / "postgresql", free_port(), bin) as server, plant_of_two(folder, server) as homes:
            office, line, alone = homes
            plain, jobbed = [], []
            for _ in range(2):
                plain.append(run(alone, options.readers, options.boards, ("--profile", ANGLE), kind))
                job = make_job(office, line, options.boards + options.readers)
                signer = started(office, "signer", "run", "--job", job)
                try:
                    with_job = ("--job", job)
                    jobbed.append(run(line, options.readers, options.boards, with_job, kind, signer.pid, server.pid))
                finally:
                    signer.terminate()
                    signer.communicate(timeout=60)
    best, slower = max(plain), max(jobbed)
    for title, ran in (("without", best), ("with job, office and evidence", slower)):
        print(f"{title:<32}{ran.an_hour:>8,.0f} boards/h; processor a board: line {1e3 * ran.line:.1f} ms", end="")
        print(f", with office and database {1e3 * ran.all:.1f} ms")
    ratio = slower.an_hour / best.an_hour
    met = "met" if ratio >= AIM else "MISSED"
    print(f"{options.readers} readers: {ratio:.2f} of the boards an hour; aim {AIM}: {met}")


if __name__ == "__main__":
    print(machine())
    main()
