"""The registry on a PostgreSQL of its own: 50 stations that push at once, waking, and a sync that finds nothing.

``python -m benchmarks.plant [--stations 50] [--pages 20] [--events 20]``. Times are ratios: client and server share the
machine. The floor beside it is as many empty round trips over the same connections.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

from teds_provision.demo import cluster
from teds_provision.links.ports import free_port
from teds_provision.plant import postgres, schema, scram
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.document import hash_of
from teds_provision.protocol.plant.page import Draft, seal_page

REGISTRY = str(uuid.uuid4())
Pages = list[tuple[int, str, bytes]]


def chain(key: SoftwareKey, pages: int, events: int) -> Pages:
    """Signed pages of one station, each with so many events."""
    made: Pages = []
    before = ""
    for n in range(1, pages + 1):
        told = [
            event.made("agreed", os.urandom(8).hex(), "2026-11-23T09:00:00Z", os.urandom(10),
                       {"fingerprint": "ab" * 32, "epoch": 1, "key_id": os.urandom(8).hex()})
            for _ in range(events)
        ]  # fmt: skip
        draft = Draft(REGISTRY, n, before, "0" * 16, datetime.now(UTC), {}, (1, "0" * 64))
        octets = seal_page(draft, told, key)
        made.append((n, before, octets))
        before = hash_of(octets)
    return made


def at_once(works: list[Callable[[], None]]) -> float:
    """Seconds until all are done."""
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
    size = asked.parse_args()
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
            for post in posts:
                post.look()
            _pushed(posts, chains, size)
            _woken(posts, keys)
            for post in posts:
                post.close()


def _pushed(posts: list[postgres.Registry], chains: list[Pages], size: argparse.Namespace) -> None:
    took: list[float] = []

    def push(post: postgres.Registry, pages: Pages) -> Callable[[], None]:
        def work() -> None:
            for page in pages:
                began = time.perf_counter()
                post.append([page])
                took.append(time.perf_counter() - began)

        return work

    def empty(post: postgres.Registry) -> Callable[[], None]:
        return lambda: [post.parcel(REGISTRY) for _ in range(size.pages)] and None

    floor = at_once([empty(post) for post in posts])
    seconds = at_once([push(post, pages) for post, pages in zip(posts, chains, strict=True)])
    pages, took = len(took), sorted(took)
    heads = posts[0].look().heads
    newest = {h for _, h in heads.values()}
    whole = sum(hash_of(pages_of[-1][2]) in newest for pages_of in chains)
    print(f"{pages} pages of {len(posts)} stations in {seconds:.2f} s: {pages / seconds:.0f} pages/s,")
    print(f"  {pages * size.events / seconds:.0f} events/s; page p50 {1000 * took[pages // 2]:.0f} ms,")
    print(f"  p99 {1000 * took[pages * 99 // 100]:.0f} ms; {whole} chains whole")
    print(f"  as many empty round trips at once: {floor:.2f} s")
    looks = []
    for _ in range(50):
        began = time.perf_counter()
        posts[0].look()
        looks.append(time.perf_counter() - began)
    print(f"a look that finds nothing new: one round trip, {1000 * statistics.median(looks):.1f} ms")


def _woken(posts: list[postgres.Registry], keys: list[SoftwareKey]) -> None:
    """One listens, another pushes: from the begin of the push until the page is read here."""
    listener, reader, writer = posts[0], posts[1], posts[2]
    listener.listen()
    while listener.wait(0.2):
        pass
    name, took = fingerprint(keys[2].point), []
    n, before = writer.look().heads[name]
    for n in range(n + 1, n + 101):  # noqa: B020
        draft = Draft(REGISTRY, n, before, "0" * 16, datetime.now(UTC), {}, (1, "0" * 64))
        octets = seal_page(draft, [], keys[2])
        began = time.perf_counter()
        pushing = threading.Thread(target=writer.append, args=([(n, before, octets)],))
        pushing.start()
        assert listener.wait(10)
        assert [page for _, _, page in reader.pages({name: n - 1})] == [octets]
        took.append(time.perf_counter() - began)
        pushing.join()
        before = hash_of(octets)
    took.sort()
    print(f"a page is at a watching station after p50 {1000 * took[50]:.0f} ms, p99 {1000 * took[98]:.0f} ms")


if __name__ == "__main__":
    main()
