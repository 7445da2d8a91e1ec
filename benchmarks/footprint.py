"""What a station that measures all weighs: memory and processor time with 20, 200 and 1,000 nodes.

``python -m benchmarks.footprint [--nodes 20 200 1000] [--rate 1] [--seconds 60] [--soak SECONDS]``: nodes in C, up to
200 in one process and on one bus (``tests/firmware/crowd.py``, CAN FD, not paced: a pace is the bench's own work),
`ncap run --measure all --mqtt` as a user starts it, a mosquitto on loopback. Memory is that of the station's process
(resident, and proportional: pages that it shares with others count in part), once all nodes run and have been read
whole; processor time is that of the next ``--seconds``. 200 nodes send 8.1 values a second each, others ``--rate``.
``--soak``: the first of these sizes runs so long, and a line is drawn through its memory, of a long soak through that
of its second quarter of an hour and what follows.
"""

from __future__ import annotations

import argparse
import subprocess
import threading
import time
from contextlib import ExitStack
from pathlib import Path

from benchmarks.commands import Rows, finished, started, station
from benchmarks.crowd import Nodes, crowd, worked
from benchmarks.machine import line as machine
from benchmarks.measure_time import TYPE
from benchmarks.newcomers import MEMORY, MEMORY_OF_A_NODE, MOSQUITTO
from teds_provision import client
from teds_provision.links.ports import free_port

A_BUS = 200  # nodes
SIZES = [20, 200, 1000]
CPU_NODES, CPU_RATE, CPU_AIM = 200, 8.1, 0.3  # 1,620 values a second; cores
GROWTH = 1.0  # aim, MB an hour
FILLING = 900.0  # seconds in which the bins of the last minute fill, and each thread's stack reaches its depth
_PATIENCE = 600.0


def memory(pid: int) -> tuple[float, float]:
    """Return what a process has in RAM: resident, and proportional (MB)."""
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()[1:]
    kilobytes = {line.split(":")[0]: int(line.split()[1]) for line in lines}
    return kilobytes["Rss"] / 1024, kilobytes["Pss"] / 1024


def threads(pid: int) -> int:
    """Return how many threads a process has."""
    return len(list(Path(f"/proc/{pid}/task").iterdir()))


def provision_all(home: Path, link: str, nodes: Nodes) -> None:
    """Provision the nodes of one bus, each with its name and calibration."""
    listed, calibrations = home.parent / "list.csv", home.parent / "calibrations"
    calibrations.mkdir(exist_ok=True)
    rows = ["uuid,name,profile,calibration"]
    for number, uuid in enumerate(nodes.uuids):
        calibration = calibrations / f"{uuid}.csv"
        calibration.write_text(
            f"# date: {time.strftime('%Y-%m-%d')}\nraw,value [degree]\n0,0\n65535,{359 + number / 1000}\n"
        )
        rows.append(f"{uuid},n-{uuid},{TYPE},{calibration}")
    listed.write_text("\n".join(rows) + "\n")
    finished(started(home, "whitelist", "import", str(listed)))
    time.sleep(1.0)  # Announces
    finished(started(home, "provision", "--yes", "--all", "--batch", str(listed), "--via", "can", "--can", link))


def measured(rows: Rows, count: int, rate: float, seconds: float, soak: float) -> None:
    """Measure so many nodes, and add what that costs."""
    with station(quick=True) as home, ExitStack() as stack:
        links: list[str] = []
        for first in range(0, count, A_BUS):
            links.append(f"udp_multicast:239.74.163.15?port={free_port()}&fd=1")
            nodes = stack.enter_context(crowd(links[-1], min(A_BUS, count - first)))
            provision_all(home, links[-1], nodes)
        port = free_port()
        (home.parent / "broker.conf").write_text(f"listener {port} 127.0.0.1\nallow_anonymous true\n")
        broker = subprocess.Popen([str(MOSQUITTO), "-c", str(home.parent / "broker.conf")], stderr=subprocess.DEVNULL)
        stack.callback(broker.wait, 30)
        stack.callback(broker.terminate)
        words = ["ncap", "run", "--measure", "all", "--rate", str(rate), "--mqtt", f"mqtt://127.0.0.1:{port}"]
        for link in links:
            words += ["--can", link]
        ncap = started(home, *words)
        stack.callback(ncap.wait, 60)
        stack.callback(ncap.terminate)
        assert ncap.stdout is not None
        assert ncap.stderr is not None
        ncap.stdout.readline()
        for stream in (ncap.stdout, ncap.stderr):
            threading.Thread(target=stream.read, daemon=True).start()
        here = stack.enter_context(client.connect(home=home))
        settled(here, count)
        add_costs(rows, here, ncap.pid, count, rate, seconds)
        if soak:
            soaked(rows, here, ncap.pid, count, soak)


def settled(here: client.Client, count: int) -> None:
    """Wait until all run and have been read whole."""

    def running() -> bool:
        reports = here.measurements()[0]["nodes"]
        return sum(report["state"] == "running" for report in reports) >= count

    def read_whole() -> bool:
        verdicts = [node["verdict"] for node in here.nodes()]
        return sum(verdict is not None and verdict["from"] == "session" for verdict in verdicts) >= count

    for done in (running, read_whole):
        end = time.monotonic() + _PATIENCE
        while not done():
            if time.monotonic() > end:
                raise SystemExit(f"{count} nodes: not all of them came.")
            time.sleep(1.0)
    time.sleep(3.0)


def samples(here: client.Client) -> tuple[int, int]:
    """Return values that came so far, and messages that did not."""
    reports = here.measurements()[0]["nodes"]
    return sum(report["samples"] for report in reports), sum(
        report["lost"] + report["late"] + report["bad"] for report in reports
    )


def add_costs(rows: Rows, here: client.Client, pid: int, count: int, rate: float, seconds: float) -> None:
    """Add one row each: memory, threads, processor time."""
    resident, proportional = memory(pid)
    rows.add(f"{count} nodes: memory of the station", resident, "MB", aim=MEMORY + MEMORY_OF_A_NODE * count)
    rows.add("  proportional", proportional, "MB")
    rows.add("  its threads", threads(pid), "")
    time.sleep(1.5)  # reports come once a second
    (before, lost), own, began = samples(here), worked(pid), time.monotonic()
    time.sleep(seconds)
    cores = (worked(pid) - own) / (time.monotonic() - began)
    after, lost_after = samples(here)
    rows.add("  values", (after - before) / (time.monotonic() - began), "/s")
    rows.add("  lost, late or bad", lost_after - lost, "")
    rows.add("  processor", cores, "cores", aim=CPU_AIM if (count, rate) == (CPU_NODES, CPU_RATE) else None)


def soaked(rows: Rows, here: client.Client, pid: int, count: int, seconds: float) -> None:
    """Let it run; draw a line through its memory."""
    began, points = time.monotonic(), []
    while (now := time.monotonic() - began) < seconds:
        points.append((now / 3600, memory(pid)[0]))
        time.sleep(min(5.0, seconds / 20))
    late = [point for point in points if point[0] * 3600 >= FILLING] if seconds >= 2 * FILLING else points
    text = f"  {seconds / 60:.0f} minutes with {count} nodes: growth"
    rows.add(
        f"{text} after the first {FILLING / 60:.0f}" if late is not points else text, slope(late), "MB/h", aim=GROWTH
    )
    megabytes = [each for _, each in points]
    rows.add("  from", megabytes[0], "MB")
    rows.add("  when the line begins", late[0][1], "MB")
    rows.add("  to", megabytes[-1], "MB")
    rows.add("  lost, late or bad since the start", samples(here)[1], "")


def slope(points: list[tuple[float, float]]) -> float:
    """Return the slope of the line of least squares through points."""
    middle, level = (sum(column) / len(points) for column in zip(*points, strict=True))
    rise = sum((at - middle) * (each - level) for at, each in points)
    return float(rise / sum((at - middle) ** 2 for at, _ in points))


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--rate", type=float, default=1.0, help="Hz; 200 nodes always have 8.1")
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--soak", type=float, default=0.0, help="seconds for which the first size runs on")
    options = parser.parse_args(words)
    if MOSQUITTO is None:
        raise SystemExit("mosquitto is not installed: apt-get install mosquitto")
    rows = Rows()
    for place, count in enumerate(options.nodes):
        rate = CPU_RATE if count == CPU_NODES else options.rate
        measured(rows, count, rate, options.seconds, options.soak if place == 0 else 0.0)


if __name__ == "__main__":
    print(machine())
    main()
