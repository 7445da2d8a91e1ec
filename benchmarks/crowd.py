"""200 nodes in C on one bus: provisioned together, then switched on together under a station that measures all.

``python -m benchmarks.crowd [--nodes 200] [--only 500|FD] [--alone]``: the nodes in one process
(``tests/firmware/crowd.py``), a paced bus whose senders add up how long their frames take the wire, `provision --all`
and `ncap run --measure all --mqtt` as a user starts them, a mosquitto on loopback. A row is the time from the start of
the conversation with the first node until the last node has its verdict, or from power-on to the last node's first
value, to the wire time of all frames until then. Beside it: the processor time of the station and of the nodes' one
process meanwhile.

``--alone``: the store is in memory and the station has the first core to itself; nodes, broker and this process have
the others. What is left above the wire's time is then the station's own: one interpreter, on one core.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.commands import PROVISION, Rows, finished, started, station
from benchmarks.machine import line as machine
from benchmarks.newcomers import MOSQUITTO, Topics, until
from teds_provision import client
from teds_provision.links.can.pacing import Wire
from teds_provision.links.can.spec import parse_spec
from teds_provision.links.ports import free_port

FIRST = min(os.sched_getaffinity(0))
MEMORY = Path("/dev/shm")  # a file system in memory
ALL_AIM, MEASURE_AIM = 1.15, {"500 kbit/s": 1.2, "FD 500k/2M": 1.5}
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass
class Nodes:
    """The nodes' process, and their UUIDs."""

    process: subprocess.Popen[str]
    uuids: list[str]

    def ask(self, word: str) -> float:
        """Send it a word; return its processor time so far."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(word + "\n")
        self.process.stdin.flush()
        return float(self.process.stdout.readline())


@contextmanager
def crowd(link: str, count: int) -> Iterator[Nodes]:
    """Run the nodes for the block; they have power."""
    command = [sys.executable, "-m", "tests.firmware.crowd", link, str(count), "measuring"]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield Nodes(process, json.loads(process.stdout.readline()))
    finally:
        process.kill()
        process.wait(20)


def to_itself(process: subprocess.Popen[str], options: argparse.Namespace) -> subprocess.Popen[str]:
    """Give a process of the station the first core, if that was asked for; the others are everyone else's."""
    if options.alone:
        os.sched_setaffinity(process.pid, {FIRST})
    return process


def worked(pid: int) -> float:
    """Return the seconds of processor time of a running process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def provisioned(
    rows: Rows, home: Path, link: str, nodes: Nodes, wire: Wire, kind: str, options: argparse.Namespace
) -> None:
    """Measure ``provision --all``."""
    listed = home.parent / "list.csv"
    listed.write_text("uuid\n" + "".join(f"{uuid}\n" for uuid in nodes.uuids))
    finished(started(home, "whitelist", "import", str(listed)))
    time.sleep(1.0)  # Announces
    cpu, busy = nodes.ask("cpu"), wire.busy_seconds
    process = to_itself(started(home, *PROVISION, "--all", "--via", "can", "--can", link), options)
    assert process.stdout is not None
    assert process.stderr is not None
    threading.Thread(target=process.stderr.read, daemon=True).start()
    while wire.busy_seconds == busy:
        time.sleep(0.001)
    began, passed, own = time.monotonic(), 0, 0.0
    failures: list[str] = []
    for text in process.stdout:
        line = json.loads(text)
        passed += line.get("verdict") == "authentic"
        if "error" in line and "uuid" in line:
            failures.append(line["error"]["message"])
        if passed + len(failures) == len(nodes.uuids):
            break
    seconds, taken = time.monotonic() - began, wire.busy_seconds - busy
    own = worked(process.pid)
    process.communicate()
    rows.add(f"provision --all, {passed} of {len(nodes.uuids)} nodes in C, {kind}", seconds, "s")
    for failure in failures:
        print(f"  failed: {failure}")
    rows.add("  the wire time of all frames", taken, "s")
    rows.add("  ratio", seconds / taken, "×", aim=ALL_AIM)
    add_work(rows, own, taken, nodes.ask("cpu") - cpu)


def add_work(rows: Rows, own: float, wire: float, nodes: float) -> None:
    """Add the processor time of the station, also to the wire time, and of the nodes' process."""
    rows.add("  processor time of the station", own, "s")
    rows.add("  that to the wire time: one interpreter takes no less", own / wire, "×")
    rows.add("  of the nodes' one process", nodes, "s")


def measured(
    rows: Rows, home: Path, link: str, nodes: Nodes, wire: Wire, kind: str, options: argparse.Namespace
) -> None:
    """Measure ``ncap run --measure all``, with power for all nodes at once."""
    nodes.ask("off")
    with ExitStack() as stack:

        def process(process: subprocess.Popen[str]) -> subprocess.Popen[str]:
            stack.callback(process.wait, 30)
            stack.callback(process.terminate)
            return process

        port = free_port()
        (home.parent / "broker.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
        broker = [str(MOSQUITTO), "-c", str(home.parent / "broker.conf")]
        process(subprocess.Popen(broker, stderr=subprocess.DEVNULL, text=True))
        words = ("ncap", "run", "--measure", "all", "--rate", "1", "--mqtt", f"mqtt://127.0.0.1:{port}")
        ncap = process(to_itself(started(home, *words, "--can", link), options))
        assert ncap.stdout is not None
        assert ncap.stderr is not None
        ncap.stdout.readline()
        for stream in (ncap.stdout, ncap.stderr):
            threading.Thread(target=stream.read, daemon=True).start()
        topics = Topics(port)
        stack.callback(topics.close)
        here = stack.enter_context(client.connect(home=home))
        time.sleep(2.0)
        cpu, own, busy, began = nodes.ask("cpu"), worked(ncap.pid), wire.busy_seconds, time.monotonic()
        nodes.ask("on")
        until(lambda: len(topics.first) >= len(nodes.uuids), why=f"{len(nodes.uuids)} nodes: {len(topics.first)} came")
        seconds, taken = max(topics.first.values()) - began, wire.busy_seconds - busy
        own, cpu = worked(ncap.pid) - own, nodes.ask("cpu") - cpu
        states = [report["state"] for report in here.measurements()[0]["nodes"]]
        rows.add(f"{len(nodes.uuids)} switched on together, {kind}: last first value", seconds, "s")
        rows.add("  the wire time of all frames until then", taken, "s")
        rows.add("  ratio", seconds / taken, "×", aim=MEASURE_AIM[kind])
        add_work(rows, own, taken, cpu)
        rows.add("  half of them had a value after", sorted(topics.first.values())[len(nodes.uuids) // 2] - began, "s")
        rows.add("  running", states.count("running"), "")


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, default=200)
    parser.add_argument("--only", default="", help="500 (kbit/s) or FD")
    parser.add_argument("--alone", action="store_true", help="store in memory, the station alone on one core")
    options = parser.parse_args(words)
    if MOSQUITTO is None:
        raise SystemExit("mosquitto is not installed: apt-get install mosquitto")
    if options.alone:
        os.environ["BENCH_DISK"] = str(MEMORY)
        cores = os.sched_getaffinity(0)
        if len(cores) < 2:
            raise SystemExit("--alone needs two cores.")
        os.sched_setaffinity(0, cores - {min(cores)})
    rows = Rows()
    for kind, more in (("500 kbit/s", ""), ("FD 500k/2M", "&fd=1")):
        if not kind.startswith(options.only):
            continue
        link = f"udp_multicast:239.74.163.13?port={free_port()}{more}&pace=1"
        wire = Wire(parse_spec(link).wire)
        with station(quick=True) as home, crowd(link, options.nodes) as nodes:
            provisioned(rows, home, link, nodes, wire, kind, options)
            measured(rows, home, link, nodes, wire, kind, options)
        wire.close()


if __name__ == "__main__":
    print(machine())
    main()
