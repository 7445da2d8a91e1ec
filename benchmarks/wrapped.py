"""Ten wrapped CAN sensors at 1 kHz each: what their wrapper costs, and what is lost on our side.

Run: ``python -m benchmarks.wrapped [--seconds 60] [--nodes 10] [--rate 1000]``

Another process plays the sensors: one frame of each a millisecond, whose first signal counts. Another is
`node run` as a user starts it, with all nodes; a third is `measure` into CSV. Counted are the processor time of the
wrapper, messages that it could not send in time or that were lost on the way, values that were invalid, and of the
counter how many values of the sensors are in the file. A sample takes the last frame, so two frames between two samples
are one value: the nodes' clock and the sensors' are not the same one.
"""

from __future__ import annotations

import argparse
import csv
import os
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.machine import line as machine
from tests.bench import PASSPHRASE, make_station
from tests.e2e.desk import Desk
from tests.places import free_bus

FIRST_IDENTIFIER = 0x200
CORES = 1.0
HERE = Path(__file__).parents[1]


def description(nodes: int, rate: int) -> str:
    """Return a DBC file with a message for each sensor."""
    lines = ['VERSION ""', "NS_ :", "BS_:", "BU_: S"]
    for number in range(nodes):
        identifier = FIRST_IDENTIFIER + number
        lines += [f"BO_ {identifier} S{number}: 8 S", ' SG_ n : 0|16@1+ (1,0) [0|65535] "" S']
        lines += [' SG_ torque : 16|16@1- (0.01,0) [-200|200] "Nm" S', ""]
    lines += ['BA_DEF_ BO_ "GenMsgCycleTime" FLOAT 0 65535;', 'BA_DEF_DEF_ "GenMsgCycleTime" 0;']
    lines += [f'BA_ "GenMsgCycleTime" BO_ {FIRST_IDENTIFIER + n} {1000 / rate:g};' for n in range(nodes)]
    return "\n".join(lines) + "\n"


def play(bus: str, nodes: int, rate: int, seconds: float) -> None:
    """Send the frames of all sensors; print how many of each."""
    import can
    import msgpack

    from teds_provision.links.can.pacing import sharp_timers

    sharp_timers()
    group, port = bus.removeprefix("udp_multicast:").split("?port=")
    with can.Bus(interface="udp_multicast", channel=group, port=int(port), hop_limit=0, fd=False) as opened:
        inside = getattr(opened, "_multicast")  # noqa: B009 - python-can's own sending is too slow for 10,000 a second
        send = getattr(inside, "_send_socket", None) or inside._socket
        to = (group, int(port))
        begun, number, late = time.monotonic(), 0, 0
        while number < rate * seconds:
            wait = begun + number / rate - time.monotonic()
            late += wait < -1 / rate
            time.sleep(max(0.0, wait))
            data = (number & 0xFFFF).to_bytes(2, "little") + (number % 20_000).to_bytes(2, "little") + bytes(4)
            for sensor in range(nodes):
                send.sendto(
                    msgpack.packb(
                        {
                            "timestamp": 0.0,
                            "arbitration_id": FIRST_IDENTIFIER + sensor,
                            "is_extended_id": False,
                            "is_remote_frame": False,
                            "is_error_frame": False,
                            "channel": None,
                            "dlc": 8,
                            "data": data,
                            "is_fd": False,
                            "bitrate_switch": False,
                            "error_state_indicator": False,
                        }
                    ),
                    to,
                )
            number += 1
        print(number, late, flush=True)


def cpu_seconds(process: int) -> float:
    """Return user and system time of a process."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def values_of(file: Path) -> tuple[int, int, int]:
    """Return rows, values of the counters, and distinct ones of a file."""
    rows = values = distinct = 0
    seen: dict[int, set[str]] = {}
    with file.open(newline="") as opened:
        reader = csv.reader(line for line in opened if not line.startswith("#"))
        columns = [index for index, name in enumerate(next(reader)) if "/n" in name and "raw" not in name]
        for row in reader:
            rows += 1
            for column in columns:
                if row[column]:
                    values += 1
                    seen.setdefault(column, set()).add(row[column])
    distinct = sum(map(len, seen.values()))
    return rows, values, distinct


def main(words: Sequence[str] | None = None) -> int:
    """Run it and print a row."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--nodes", type=int, default=10)
    parser.add_argument("--rate", type=int, default=1000)
    parser.add_argument("--play", help=argparse.SUPPRESS)
    asked = parser.parse_args(words)
    if asked.play:
        play(asked.play, asked.nodes, asked.rate, asked.seconds)
        return 0
    with tempfile.TemporaryDirectory() as folder:
        return run(Path(folder), asked.nodes, asked.rate, asked.seconds)


def run(folder: Path, nodes: int, rate: int, seconds: float) -> int:
    """Provision, play, measure; 0 if nothing was lost and the wrapper took a core at most."""
    make_station(folder / "bench", "bench").close()
    (folder / "desk").mkdir()
    desk = Desk(folder / "desk", folder, nodes="python")
    station = desk.station()
    assert station.passphrase == PASSPHRASE
    dbc, bus = folder / "sensors.dbc", free_bus()
    dbc.write_text(description(nodes, rate))
    can = ["--can", f"{desk.links.can}&fd=1&bitrate=1000000&data_bitrate=8000000"]
    folders = [folder / f"s{number}" for number in range(nodes)]
    uuids = [desk.new_uuid().hex() for _ in folders]
    try:
        for number, (path, uuid) in enumerate(zip(folders, uuids, strict=True)):
            station.ask("node", "create", path, "--from", f"dbc:{dbc}", "--message", f"S{number}", "--uuid", uuid)
        node = desk.start("--json", "node", "run", *folders, *can, "--source", f"dbc:{dbc}", "--bus", bus)
        node.wait_for('"ready": true')
        for number, uuid in enumerate(uuids):
            named = ["--adopt", "--name", f"s{number}", "--via", "can", *can, "--yes"]
            assert station.ask("provision", uuid, *named, code=0)["verdict"] == "authentic"
        words = [sys.executable, "-m", "benchmarks.wrapped", "--play", bus, "--nodes", str(nodes), "--rate", str(rate)]
        player = subprocess.Popen([*words, "--seconds", str(seconds + 12)], cwd=HERE, stdout=subprocess.PIPE, text=True)
        time.sleep(1)
        file = folder / "run.csv"
        before, began = cpu_seconds(node.process.pid), time.monotonic()
        outcome = station.start("measure", *uuids, *can, "--duration", str(seconds), "--to", file).end(seconds + 60)
        used, elapsed = cpu_seconds(node.process.pid) - before, time.monotonic() - began
        player.kill()
        player.wait()
        node.read(0.2)
        lost = [int(found) for found in re.findall(r"messages, lost (\d+)", outcome.out)]
        invalid = sum(int(found) for found in re.findall(r"invalid (\d+)", outcome.out))
        rows, values, distinct = values_of(file)
        print(machine())
        print(f"{nodes} sensors at {rate} Hz, measured for {seconds:g} s:")
        print(f"  the wrapper took                      {used / elapsed:9.2f} cores  aim ≤ {CORES:g}")
        print(f"  messages lost                         {sum(lost):9}        aim = 0, of {len(lost)} nodes")
        print(f"  values invalid, of {2 * rows:9}           {invalid:9}")
        print(f"  of the sensors' frames in the file    {distinct / max(values, 1):9.1%}")
        return 0 if len(lost) == nodes and not any(lost) and used / elapsed <= CORES else 1
    finally:
        desk.clear()


if __name__ == "__main__":
    sys.exit(main())
