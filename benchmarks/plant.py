"""The registry on its own PostgreSQL: 50 stations that push at once, waking, and a sync that finds nothing.

``python -m benchmarks.plant [--stations 50] [--pages 20] [--events 20]``; ``--history NODES`` alone: a newcomer takes
of events about that many nodes, four each, in a separate process; ``--local BOARDS`` alone: boards in
memory, provisioned by a station that joined a registry and by one that joined none, in turn. Times are ratios:
client and server share the machine. The floor beside it is as many empty round trips over the same connections.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from teds_provision.links.ports import free_port
from teds_provision.plant import postgres, schema, scram
from teds_provision.plant.demo import cluster
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.sync import sync
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.document import hash_of
from teds_provision.protocol.plant.page import PageDraft, sign_page
from teds_provision.provisioning.build import BuildOrder, prepare
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.station.station import Station
from tests.bench import Board, make_station, talk
from tests.plant.owner import ANGLE, alone
from tests.plant.stations import Plant, ask

REGISTRY = str(uuid.uuid4())
Pages = list[tuple[int, str, bytes]]


def chain(key: SoftwareKey, pages: int, events: int) -> Pages:
    """Return signed pages of one station, each with that many events."""
    made: Pages = []
    before = ""
    for n in range(1, pages + 1):
        page_events = [
            event.made("agreed", os.urandom(8).hex(), "2026-11-23T09:00:00Z", os.urandom(10),
                       {"fingerprint": "ab" * 32, "epoch": 1, "key_id": os.urandom(8).hex()})
            for _ in range(events)
        ]  # fmt: skip
        draft = PageDraft(REGISTRY, n, before, "0" * 16, datetime.now(UTC), {}, (1, "0" * 64))
        octets = sign_page(draft, page_events, key)
        made.append((n, before, octets))
        before = hash_of(octets)
    return made


def at_once(works: list[Callable[[], None]]) -> float:
    """Return the seconds until all are done."""
    gate = threading.Barrier(len(works) + 1)

    def run(work: Callable[[], None]) -> None:
        gate.wait()
        work()

    threads = [threading.Thread(target=run, args=(work,)) for work in works]
    for thread in threads:
        thread.start()
    gate.wait()
    began = time.perf_counter()
    for thread in threads:
        thread.join()
    return time.perf_counter() - began


def main() -> None:
    asked = argparse.ArgumentParser()
    asked.add_argument("--stations", type=int, default=50)
    asked.add_argument("--pages", type=int, default=20)
    asked.add_argument("--events", type=int, default=20)
    asked.add_argument("--history", type=int, metavar="NODES")
    asked.add_argument("--local", type=int, metavar="BOARDS")
    asked.add_argument("--take-in", type=Path, metavar="FOLDER", help=argparse.SUPPRESS)
    size = asked.parse_args()
    if size.history or size.take_in:
        _take_in(size.take_in) if size.take_in else _history(size.history)
        return
    if size.local:
        _local(size.local)
        return
    found = cluster.programs()
    if found is None:
        raise SystemExit("PostgreSQL 15 is not installed.")
    with tempfile.TemporaryDirectory(prefix="pg-bench-") as folder:
        Path(folder).chmod(0o755)
        with cluster.running(Path(folder, "c"), free_port(), found) as server:
            server.psql("create database plant")
            server.psql(schema.registry_sql(REGISTRY), "plant")
            keys = [SoftwareKey.generate() for _ in range(size.stations)]
            posts = []
            for key in keys:
                secret, name = os.urandom(32), fingerprint(key.point)
                server.psql(schema.member_sql(name, scram.verifier(secret)), "plant")
                posts.append(postgres.Registry(postgres.parameters(server.url("plant"), name, secret)))
            chains = [chain(key, size.pages, size.events) for key in keys]
            for transport in posts:
                transport.look()
            _pushed(posts, chains, size)
            _woken(posts, keys)
            for transport in posts:
                transport.close()


def _local(boards: int) -> None:
    """Measure boards in memory, with both ends and with every COMMIT; the ratio is the median of the pairs."""
    with tempfile.TemporaryDirectory(prefix="plant-local-") as folder:
        stations = make_station(Path(folder, "alone"), "alone"), alone(Path(folder, "joined"))
        orders = []
        for station in stations:
            station.unlock()
            orders.append(prepare(station, BuildOrder(ANGLE)))
        spent: list[tuple[float, float, int]] = []
        for number in range(boards):
            for place in (0, 1) if number % 2 else (1, 0):
                board = Board(uuid=(1 + number).to_bytes(10, "big"))
                wall, used = time.perf_counter(), time.process_time()
                with talk(board) as node:
                    provision(
                        stations[place], node, orders[place], operator=AcceptingOperator(), reporter=SilentReporter()
                    )
                spent.append((time.perf_counter() - wall, time.process_time() - used, place))
        for column, what in enumerate(("by the clock", "of the processor")):
            without, beside = ([spent_row[column] for spent_row in spent if spent_row[2] == place] for place in (0, 1))
            ratio = statistics.median(b / a for a, b in zip(without[10:], beside[10:], strict=True))
            print(f"a board: {1000 * statistics.median(without):.1f} ms {what}, beside a registry {ratio:.2f} ×")
        for station in stations:
            station.close()


def _history(nodes: int) -> None:
    """Measure joining with the whole past of a plant on a stick."""
    with tempfile.TemporaryDirectory(prefix="plant-history-") as folder:
        made = Plant(Path(folder))
        west, _ = made.member("west", "line", "sign"), made.member("south", "base")
        stick, key, place = FolderTransport(made.stick), west.vault.identity(), (0, "")
        made.sync(made.north)
        for _ in range(0, nodes, 250):
            events = [entry for _ in range(250) for entry in _told_of(os.urandom(10))]
            draft = PageDraft(
                made.roster.registry, place[0] + 1, place[1], "0" * 16, datetime.now(UTC), {}, (1, "0" * 64)
            )
            octets = sign_page(draft, events, key)
            place = draft.number, hash_of(octets)
            stick.append(west.fingerprint, draft.number, draft.previous, place[1], octets)
        made.close()
        print(f"{nodes} nodes, {4 * nodes} events, {place[0]} pages:", flush=True)
        subprocess.run([sys.executable, "-m", "benchmarks.plant", "--take-in", folder], check=True)


def _told_of(uuid: bytes) -> list[dict[str, Any]]:
    """Return a line's events about a board that it provisioned."""
    at, who, digest = "2026-11-23T09:00:00Z", os.urandom(32).hex(), os.urandom(32).hex()
    written = {"epoch": 1, "sequence": 1, "teds_sha256": digest}
    kind = {"profile": "magnetic-angular-position-sensor", "profile_sha256": "ab" * 32, "due": "2027-11-23"}
    events: list[tuple[str, dict[str, Any]]] = [
        ("pinned", {"fingerprint": who, "assurance": "tap"}),
        ("agreed", {"fingerprint": who, "epoch": 1, "key_id": os.urandom(8).hex()}),
        ("signed", written),
        ("written", {**written, **kind}),
    ]
    return [event.made(act, os.urandom(8).hex(), at, uuid, members) for act, members in events]


def _take_in(folder: Path) -> None:
    south = Station.open(folder / "south", ask=ask)
    south.unlock()
    before, cpu, began = _peak(), time.process_time(), time.monotonic()
    done = sync(south, FolderTransport(folder / "stick"))
    spent, seconds = time.process_time() - cpu, time.monotonic() - began
    store = sum(path.stat().st_size for path in (folder / "south").rglob("*") if path.is_file())
    south.close()
    print(f"  {done.fetched} pages in: {spent:.1f} s of CPU ({seconds:.1f} s by the clock), {_peak():.0f} MB at most")
    print(f"  ({before:.0f} MB before it), home {store / 1e6:.0f} MB")


def _peak() -> float:
    """Return the most MB that this process took; getrusage would count its parent's before the exec."""
    (line,) = [
        splitline for splitline in Path("/proc/self/status").read_text().splitlines() if splitline.startswith("VmHWM")
    ]
    return int(line.split()[1]) / 1024


def _pushed(posts: list[postgres.Registry], chains: list[Pages], size: argparse.Namespace) -> None:
    durations: list[float] = []

    def push(transport: postgres.Registry, pages: Pages) -> Callable[[], None]:
        def work() -> None:
            for page in pages:
                began = time.perf_counter()
                transport.append([page])
                durations.append(time.perf_counter() - began)

        return work

    def empty(transport: postgres.Registry) -> Callable[[], None]:
        def ask() -> None:
            for _ in range(size.pages):
                transport.parcel(REGISTRY)

        return ask

    floor = at_once([empty(transport) for transport in posts])
    seconds = at_once([push(transport, pages) for transport, pages in zip(posts, chains, strict=True)])
    pages, durations = len(durations), sorted(durations)
    heads = posts[0].look().heads
    newest = {h for _, h in heads.values()}
    whole = sum(hash_of(pages_of[-1][2]) in newest for pages_of in chains)
    print(f"{pages} pages of {len(posts)} stations in {seconds:.2f} s: {pages / seconds:.0f} pages/s,")
    print(f"  {pages * size.events / seconds:.0f} events/s; page p50 {1000 * durations[pages // 2]:.0f} ms,")
    print(f"  p99 {1000 * durations[pages * 99 // 100]:.0f} ms; {whole} chains whole")
    print(f"  as many empty round trips at once: {floor:.2f} s")
    looks = []
    for _ in range(50):
        began = time.perf_counter()
        posts[0].look()
        looks.append(time.perf_counter() - began)
    print(f"a look that finds nothing new: one round trip, {1000 * statistics.median(looks):.1f} ms")


def _woken(posts: list[postgres.Registry], keys: list[SoftwareKey]) -> None:
    """Time a push to a listener: from its beginning until the page is read there."""
    listener, reader, writer = posts[0], posts[1], posts[2]
    listener.listen()
    while listener.wait(0.2):
        pass
    name, seconds = fingerprint(keys[2].point), []
    n, before = writer.look().heads[name]
    for n in range(n + 1, n + 101):  # noqa: B020
        draft = PageDraft(REGISTRY, n, before, "0" * 16, datetime.now(UTC), {}, (1, "0" * 64))
        octets = sign_page(draft, [], keys[2])
        began = time.perf_counter()
        pushing = threading.Thread(target=writer.append, args=([(n, before, octets)],))
        pushing.start()
        assert listener.wait(10)
        assert [page for _, _, page in reader.pages({name: n - 1})] == [octets]
        seconds.append(time.perf_counter() - began)
        pushing.join()
        before = hash_of(octets)
    seconds.sort()
    print(f"a page is at a watching station after p50 {1000 * seconds[50]:.0f} ms, p99 {1000 * seconds[98]:.0f} ms")


if __name__ == "__main__":
    main()
