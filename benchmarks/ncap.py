"""The base station under load: many nodes, many clients, some of which never read.

``python -m benchmarks.ncap [--nodes 200] [--clients 50] [--deaf 10] [--seconds 20]``: provisions a bus of virtual nodes
and starts the daemon; how long until each is verified; then asks it while a virtual gripper is measured at 100 Hz and
clients listen. ``--seconds 3600`` is the soak: memory and losses are printed every minute.
"""

from __future__ import annotations

import argparse
import json
import select
import socket
import statistics
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from benchmarks.commands import PROVISION, Rows, finished, started, station
from benchmarks.provisioning import nodes
from teds_provision import client
from teds_provision.links.ports import free_port

RATE = 100.0
_EVERY = 60.0


@contextmanager
def whole_bus(home: Path, count: int) -> Iterator[str]:
    """Yield a bus of so many provisioned nodes in one process."""
    link = f"udp_multicast:239.74.163.9?port={free_port()}&fd=1"
    with nodes("can", link, "--many", str(count)) as process:
        assert process.stdout is not None
        uuids = process.stdout.readline().split()
        listed = home.parent / "list.csv"
        listed.write_text("uuid\n" + "".join(f"{uuid}\n" for uuid in uuids))
        time.sleep(1.0)  # Announces
        finished(started(home, "whitelist", "import", str(listed)))
        finished(started(home, *PROVISION, "--all", "--via", "can", "--can", link))
        yield link


@contextmanager
def daemon(home: Path, link: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Run `ncap run`, discard its lines, and yield its process and URL."""
    process = started(home, "ncap", "run", "--http", "127.0.0.1:0", "--can", link)
    assert process.stdout is not None
    ready = json.loads(process.stdout.readline())
    threading.Thread(target=process.stdout.read, daemon=True).start()
    try:
        yield process, ready["url"]
    finally:
        process.terminate()
        process.wait(60)


def until(found: Any, seconds: float = 300.0) -> float:
    """Return the seconds until ``found`` is true."""
    began = time.perf_counter()
    while not found():
        if time.perf_counter() - began > seconds:
            raise SystemExit("It did not come about.")
        time.sleep(0.2)
    return time.perf_counter() - began


def memory(process: subprocess.Popen[str]) -> float:
    """Return the MiB that a process has in RAM."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return int(next(line for line in lines if line.startswith("VmRSS")).split()[1]) / 1024


def deaf_client(url: str, token: str) -> socket.socket:
    """Return a WebSocket that is opened and never read."""
    port = int(url.rpartition(":")[2])
    deaf = socket.create_connection(("127.0.0.1", port))
    deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    deaf.sendall(
        f"GET /api/v1/live HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        f"Authorization: Bearer {token}\r\n\r\n".encode()
    )
    return deaf


def listen(url: str, token: str, stack: ExitStack, count: int, stop: threading.Event) -> list[int]:
    """Start ``count`` clients that read all they get, on one thread; the list counts their octets."""
    heard = [0]
    sockets = []
    for _ in range(count):
        opened = connect(
            f"{url.replace('http', 'ws')}/api/v1/live",
            additional_headers={"Authorization": f"Bearer {token}"},
            compression=None,
        )
        sockets.append(stack.enter_context(opened))

    def read(item: Any) -> None:
        for text in item:
            heard[0] += len(text)
            if stop.is_set():
                return

    for client_connection in sockets:
        threading.Thread(target=read, args=(client_connection,), daemon=True).start()
    return heard


def asked(station_: client.Client, seconds: float, notify: Any) -> list[float]:
    """GET /nodes again and again; how long each took."""
    times, end, started = [], time.perf_counter() + seconds, time.perf_counter()
    while time.perf_counter() < end:
        began = time.perf_counter()
        station_.nodes()
        times.append(time.perf_counter() - began)
        if time.perf_counter() - started > _EVERY:
            started = time.perf_counter()
            notify()
        select.select([], [], [], 0.1)
    return times


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=200)
    parser.add_argument("--clients", type=int, default=50)
    parser.add_argument("--deaf", type=int, default=10, help="of them, how many never read")
    parser.add_argument("--seconds", type=float, default=20.0)
    options = parser.parse_args(words)
    rows = Rows()
    with station(quick=True) as home, ExitStack() as stack:
        link = stack.enter_context(whole_bus(home, options.nodes))
        process, url = stack.enter_context(daemon(home, link))
        here = stack.enter_context(client.connect(home=home))
        taken = until(lambda: sum(bool(node["verified"]) for node in here.nodes()) >= options.nodes)
        rows.add(f"{options.nodes} nodes found and verified after the start", taken, "s")
        made = here.request("POST", "/virtual", {"profile": "gripper", "name": "hand", "source": "sine:2"})
        until(lambda: (verdict := here.node(made["uuid"])["verdict"]) is not None and verdict["verdict"] == "authentic")
        here.measure(made["uuid"], rate=RATE)
        until(lambda: here.node(made["uuid"])["channels"][1]["last"])
        token = json.loads(finished(started(home, "ncap", "token", "add", "load")))["token"]
        stop = threading.Event()
        quiet = asked(here, 3.0, lambda: None)
        rows.add("GET /nodes, no event stream open: p50", statistics.median(quiet) * 1e3, "ms")
        deaf = [stack.enter_context(deaf_client(url, token)) for _ in range(options.deaf)]
        heard = listen(url, token, stack, options.clients - len(deaf), stop)
        script = stack.enter_context(client.connect(url, token=token))
        before, first = memory(process), here.measurements()[0]["nodes"][0]

        def notify() -> None:
            now = here.measurements()[0]["nodes"][0]
            print(f"  {memory(process):.0f} MiB, {now['samples']} values, {now['lost']} lost", flush=True)

        began = time.perf_counter()
        times = sorted(asked(script, options.seconds, notify))
        seconds = time.perf_counter() - began
        after, last = memory(process), here.measurements()[0]["nodes"][0]
        stop.set()
        name = f"{options.clients} clients, {options.deaf} deaf"
        rows.add(f"GET /nodes, {name}: p50", statistics.median(times) * 1e3, "ms")
        rows.add(f"GET /nodes, {name}: p99", times[int(len(times) * 0.99)] * 1e3, "ms", aim=50)
        rows.add(
            "values measured meanwhile",
            (last["samples"] - first["samples"]) / seconds / 2,
            "/s",
            aim=RATE * 0.95,
            least=True,
        )
        rows.add("messages lost", last["lost"] - first["lost"], "", aim=0)
        rows.add("sent to those who read", heard[0] / seconds / 1e3, "kB/s")
        rows.add(f"memory after {seconds:.0f} s against before", after / before, "×", aim=1.1)


if __name__ == "__main__":
    main()
