"""Waiting times of a user: the shipped commands as separate processes, from start to verdict.

``python -m benchmarks.commands [--only WORD] [--nodes 200]``: start-up, what a command costs that is neither link nor
node nor Argon2id, one ``provision`` warm and cold (nothing compiled yet), ``--watch`` with boards that change at once,
eight readers, a whole bus. Passphrase and Argon2id as shipped, but where many run side by side. Slow nodes take 80 ms
for every point operation; beside them is the floor, operations counted × 80 ms.
"""

from __future__ import annotations

import argparse
import compileall
import json
import os
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import timeit
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import teds_provision
from benchmarks.machine import line as machine
from benchmarks.provisioning import SLOW, next_node, next_nodes, nodes
from benchmarks.verifying import fill as fill_images
from teds_provision.links.ports import free_port
from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import PRODUCT, THROWAWAY, SealingKey
from teds_provision.vault.selection import forget_vaults

PASSPHRASE = "correct horse battery"
ANGLE = "magnetic-angular-position-sensor"
UNCALIBRATED = Path(__file__).parent / "angle.toml"  # PROFILE for boards without hardware that could be calibrated
PROVISION = ("provision", "--profile", str(UNCALIBRATED), "--yes")
READERS = 8
_WAIT = 120.0
_ROUNDS = 5


class Rows:
    """Prints lines: what was measured, what it came to, its aim and whether that is met."""

    def add(self, what: str, value: float, unit: str, *, aim: float | None = None, least: bool = False) -> None:
        """Print one row; ``least``: the aim is a floor, not a ceiling."""
        good = aim is None or (value >= aim if least else value <= aim)
        sign = "≥" if least else "≤"
        verdict = "" if aim is None else f"aim {sign} {aim:g}: {'met' if good else 'MISSED'}"
        shown = f"{value:,.0f}" if value >= 100 else f"{value:.2f}"
        print(f"{what:<58}{shown:>9} {unit:<9}{verdict}", flush=True)


@contextmanager
def station(*, quick: bool = False) -> Iterator[Path]:
    """Yield a home with a station; ``quick``: its passphrase costs next to nothing."""
    forget_vaults()
    with tempfile.TemporaryDirectory(dir=os.environ.get("BENCH_DISK")) as folder:
        home = Path(folder) / "home"
        costs = {"costs": THROWAWAY} if quick else {}
        made, _ = initialise(home, name="bench", keystore="file", ask=lambda p, c: PASSPHRASE, **costs)  # type: ignore[arg-type]
        made.close()
        forget_vaults()
        yield home


def started(home: Path, *words: str, **environment: str) -> subprocess.Popen[str]:
    """Start the command; the passphrase comes through a pipe."""
    read, write = os.pipe()
    os.write(write, PASSPHRASE.encode() + b"\n")
    os.close(write)
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "--json", "--passphrase-fd", str(read)]
    process = subprocess.Popen(
        [*command, *words],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        pass_fds=(read,),
        env={**os.environ, **environment},
    )
    os.close(read)
    return process


def finished(process: subprocess.Popen[str]) -> str:
    """Wait for a command that has to succeed; returns what it printed."""
    out, error = process.communicate(timeout=_WAIT)
    if process.returncode != 0:
        raise SystemExit(f"{process.args!r}\nexit {process.returncode}: {error}")
    return out


def start_up(rows: Rows) -> None:
    """Time the start, median of ten, beside the least that a click program can take."""

    def median(*command: str) -> float:
        times = []
        for _ in range(10):
            began = time.perf_counter()
            subprocess.run(command, check=True, capture_output=True)
            times.append(time.perf_counter() - began)
        return statistics.median(times)

    floor = median(sys.executable, "-c", "import click")
    rows.add("import click, bare", floor * 1e3, "ms")
    for name in ("--help", "--version"):
        rows.add(f"{name} against it", median(sys.executable, "-m", "teds_provision", name) / floor, "×", aim=1.4)
    completion(rows)


def completion(rows: Rows) -> None:
    """Time what a shell waits for between Tab and its list: a command's name, an option, a node of a station."""
    with station(quick=True) as home:
        words = {
            "a command": "teds-provision prov",
            "an option": "teds-provision provision --pro",
            "a node's name": f"teds-provision --home {home} verify 8d",
        }
        for what, line in words.items():
            asked = {
                "_TEDS_PROVISION_COMPLETE": "bash_complete",
                "COMP_WORDS": line,
                "COMP_CWORD": str(len(line.split()) - 1),
            }
            times = []
            for _ in range(7):
                began, worked = time.perf_counter(), processor_time()
                subprocess.run(
                    [sys.executable, "-m", "teds_provision"], env=os.environ | asked, check=True, capture_output=True
                )
                times.append((time.perf_counter() - began, processor_time() - worked))
            seconds, work = (min(column) * 1e3 for column in zip(*times, strict=True))
            rows.add(f"completion of {what}, least of seven", seconds, "ms", aim=150)
            rows.add("  of it processor time, whatever else runs", work, "ms")


def processor_time() -> float:
    """Return the seconds that ended child processes worked."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def timed(home: Path, *words: str) -> float:
    """Return the seconds of a command that has to succeed."""
    began = time.perf_counter()
    finished(started(home, *words))
    return time.perf_counter() - began


def start_to_end(rows: Rows) -> None:
    """Measure processor time of commands that need no node, beside that of a bare ``import click``."""
    with tempfile.TemporaryDirectory() as name:
        folder, home = Path(name, "images"), Path(name, "home")
        fill_images(folder, home, 1)
        (image,) = folder.iterdir()
        commands = {"nodes": 120, "": 160, f"verify {image}": 160, "doctor": 250}
        rows.add("import click, processor time", _least_work("-c", "import click"), "ms")
        for words, aim in commands.items():
            work = _least_work("-m", "teds_provision", "--home", str(home), *words.split())
            rows.add(f"  {words.partition(' ')[0] or 'the bare command'}", work, "ms", aim=aim)


def _least_work(*words: str) -> float:
    """Return the least processor time of seven runs, in ms."""
    times = []
    for _ in range(7):
        worked = processor_time()
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        times.append(processor_time() - worked)
    return min(times) * 1e3


def fixed_cost(rows: Rows) -> None:
    """Measure a command from its start to its verdict, without link, node and Argon2id; least of seven.

    Links are not paced, so a board of ``--watch`` takes what link and node take, and our own 10 ms between the
    exchanges. ``provision`` over CAN is given the UUID: without it, the contract requires listening 0.3 s for a second
    node.
    """
    stretched = min(timeit.repeat(lambda: SealingKey.derive(PASSPHRASE, costs=PRODUCT), number=1, repeat=7))
    rows.add("Argon2id alone", stretched, "s")
    with station() as home:
        rows.add("nodes, of a new station", min(timed(home, "nodes") for _ in range(7)), "s", aim=0.25)
    for via, link in (
        ("nfc", f"udp:127.0.0.1:{free_port()}"),
        ("can", f"udp_multicast:239.74.163.9?port={free_port()}"),
    ):
        where = ("--via", via, f"--{via}", link)
        with station() as home, nodes(via, link) as boards:
            whole, verify = [], []
            for _ in range(7):
                uuid = next_node(boards)[0].hex()
                time.sleep(0.7)
                named = (uuid,) if via == "can" else ()
                whole.append(timed(home, *PROVISION, *named, *where))
                verify.append(timed(home, "verify", uuid, *where))
            watch = started(home, *PROVISION, "--watch", *where)
            board, _ = _changed_at_once(boards, watch, 7)
            watch.terminate()
            watch.communicate(timeout=_WAIT)
        rows.add(f"provision over {via}, from start to verdict", min(whole), "s")
        rows.add("  of it neither link, node nor Argon2id", min(whole) - board - stretched, "s", aim=0.35)
        rows.add(f"verify UUID over {via}, without Argon2id", min(verify) - stretched, "s", aim=0.35)


def one_command(rows: Rows) -> None:
    """Time ``provision`` from start to verdict, with Argon2id."""
    for via, link, extra in (
        ("nfc", f"udp:127.0.0.1:{free_port()}", ("--pace",)),
        ("can", f"udp_multicast:239.74.163.9?port={free_port()}&pace=1", ()),
    ):
        for slow in (0.0, SLOW):
            delay = ("--crypto-delay", str(slow * 1000)) if slow else ()
            kind = f"{'slow' if slow else 'immediate'} node"
            with station() as home, nodes(via, link, *extra, *delay) as process, tempfile.TemporaryDirectory() as empty:
                for name, environment in (("cold", {"PYTHONPYCACHEPREFIX": empty}), ("warm", {})):
                    taken = []
                    for _ in range(1 if environment else 3):
                        next_node(process)
                        time.sleep(0.7)
                        began = time.perf_counter()
                        finished(started(home, *PROVISION, "--via", via, f"--{via}", link, **environment))
                        taken.append(time.perf_counter() - began)
                    rows.add(f"provision over {via}, paced, {kind}, {name}", statistics.median(taken), "s")
                _, before = next_node(process)
                if slow:
                    rows.add(f"  of it {before.operations} point operations", before.operations * slow, "s")


def zeroing(rows: Rows) -> None:
    """Time ``calibrate zero`` over CAN at 500 kbit/s, from start to verdict: read, sign, write, verify, read again."""
    bus = f"udp_multicast:239.74.163.9?port={free_port()}&pace=1"
    for slow in (0.0, SLOW):
        delay = ("--crypto-delay", str(slow * 1000)) if slow else ()
        with station() as home, tempfile.TemporaryDirectory() as folder:
            still, curve = Path(folder) / "still.csv", Path(folder) / "curve.csv"
            still.write_text("t,angle\n0,45\n100000,45\n")
            curve.write_text("# date: 2026-10-01\nraw,value [degree]\n0,0\n65536,360\n")
            made = str(Path(folder) / "node")
            finished(started(home, "node", "create", made, "--profile", ANGLE, "--name", "joint"))
            node = started(home, "node", "run", made, "--can", bus, "--source", f"file:{still}", *delay)
            try:
                assert node.stdout is not None
                node.stdout.readline()
                over = ("--via", "can", "--can", bus)
                finished(started(home, "provision", "--profile", ANGLE, "--calibration", str(curve), "--yes", *over))
                words = ("calibrate", "zero", "joint", "1", "--unit", "degree", "--value")
                taken = [timed(home, *words, str(10 * number), *over) for number in range(1, 6)]
            finally:
                node.terminate()
                node.communicate(timeout=_WAIT)
        kind = "80 ms node" if slow else "immediate node"
        rows.add(f"calibrate zero over CAN, paced, {kind}", statistics.median(taken), "s", aim=None if slow else 3.0)


def watching(rows: Rows) -> None:
    """Time ``provision --watch``; the next board comes as soon as the line about the last one is out."""
    aims = {("nfc", 0.0): 15_000, ("nfc", SLOW): 2_200, ("can", 0.0): 30_000, ("can", SLOW): 3_500}
    for (via, slow), aim in aims.items():
        link = f"udp:127.0.0.1:{free_port()}" if via == "nfc" else f"udp_multicast:239.74.163.9?port={free_port()}"
        delay = ("--crypto-delay", str(slow * 1000)) if slow else ()
        count = 8 if slow else 25
        with station(quick=True) as home, nodes(via, link, *delay) as process:
            watch = started(home, *PROVISION, "--watch", "--via", via, f"--{via}", link)
            seconds_each, operations = _changed_at_once(process, watch, count)
            watch.terminate()
            watch.communicate(timeout=_WAIT)
        kind = f"{'80 ms' if slow else 'immediate'} nodes"
        rows.add(
            f"provision --watch over {via}, {kind}, changed at once",
            3600 / seconds_each,
            "nodes/h",
            aim=aim,
            least=True,
        )
        if slow:
            rows.add(f"  floor of {operations} point operations", 3600 / (operations * slow), "nodes/h")


def _changed_at_once(process: subprocess.Popen[str], watch: subprocess.Popen[str], count: int) -> tuple[float, int]:
    """Put ``count`` boards down, one after the first: seconds for each, and point operations of the last."""
    began, operations = 0.0, 0
    for number in range(count + 1):
        operations = next_node(process)[1].operations
        if not _next_board(watch):
            raise SystemExit("a board failed under --watch")
        if number == 0:
            began = time.perf_counter()
    return (time.perf_counter() - began) / count, operations


def _next_board(watch: subprocess.Popen[str]) -> bool:
    """Read lines until one reports a board."""
    assert watch.stdout is not None
    for text in watch.stdout:
        line = json.loads(text)
        if "uuid" in line:
            return _passed(line)
    return False


def _passed(line: dict[str, object]) -> bool:
    return line.get("verdict") == "authentic"


def eight_readers(rows: Rows) -> None:
    """Time one ``--watch`` over eight readers against one reader, median of some; then eight commands on one store."""
    slow = ("--crypto-delay", str(SLOW * 1000))

    def side_by_side(home: Path, count: int) -> float:
        links = [f"udp:127.0.0.1:{free_port()}" for _ in range(count)]
        with ExitStack() as stack:
            boards = [stack.enter_context(nodes("nfc", link, *slow)) for link in links]
            watch = started(home, *PROVISION, "--watch", *(word for link in links for word in ("--nfc", link)))
            next_node(boards[0])  # the vault is unlocked with the first board
            _next_board(watch)
            taken, passed = [], 0
            next_nodes(boards)  # a node's process loads with its first board what it needs: not the station's share
            passed += sum(_next_board(watch) for _ in boards)
            for _ in range(_ROUNDS):
                began = time.perf_counter()
                next_nodes(boards)
                passed += sum(_next_board(watch) for _ in boards)
                taken.append(time.perf_counter() - began)
            watch.terminate()
            watch.communicate(timeout=_WAIT)
            if passed != (1 + _ROUNDS) * count:
                raise SystemExit(f"{passed} of {(1 + _ROUNDS) * count} boards passed")
            return statistics.median(taken)

    with station(quick=True) as home:
        alone, all_of_them = side_by_side(home, 1), side_by_side(home, READERS)
    rows.add(f"--watch, one reader, 80 ms node ({READERS}: {all_of_them:.2f} s)", alone, "s")
    rows.add(f"--watch, {READERS} readers against one", all_of_them / alone, "×", aim=1.15)
    with station(quick=True) as home, ExitStack() as stack:
        links = [f"udp:127.0.0.1:{free_port()}" for _ in range(READERS)]
        next_nodes([stack.enter_context(nodes("nfc", link, *slow)) for link in links])
        before, began = os.times(), time.perf_counter()
        commands = [started(home, *PROVISION, "--nfc", link) for link in links]
        for command in commands:
            finished(command)
        taken, after = time.perf_counter() - began, os.times()
    cpu = after.children_user + after.children_system - before.children_user - before.children_system
    rows.add(f"{READERS} commands at once, wall", taken, "s")
    cores = len(os.sched_getaffinity(0))
    rows.add(f"{READERS} commands at once against their CPU on {cores} cores", taken / (cpu / cores), "×", aim=1.2)


def whole_bus(rows: Rows, count: int) -> None:
    """Time ``provision --all`` on a bus of ``count`` slow nodes in one process."""
    for name, options, aim in (("500 kbit/s", "&pace=1", 65.0), ("FD 500k/2M", "&pace=1&fd=1", 15.0)):
        link = f"udp_multicast:239.74.163.9?port={free_port()}{options}"
        delay = ("--crypto-delay", str(SLOW * 1000))
        with station(quick=True) as home, nodes("can", link, *delay, "--many", str(count)) as process:
            assert process.stdout is not None
            uuids = process.stdout.readline().split()
            time.sleep(1.0)  # Announces
            listed = home.parent / "list.csv"
            listed.write_text("uuid\n" + "".join(f"{uuid}\n" for uuid in uuids))
            finished(started(home, "whitelist", "import", str(listed)))
            began = time.perf_counter()
            lines = finished(started(home, *PROVISION, "--all", "--via", "can", "--can", link)).splitlines()
            taken = time.perf_counter() - began
        passed = sum(_passed(json.loads(line)) for line in lines)
        aimed = aim if count == 200 else None
        rows.add(f"provision --all, {passed} of {count} slow nodes, {name}", taken, "s", aim=aimed)


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="one part, such as fixed_cost or whole_bus")
    parser.add_argument("--nodes", type=int, default=200, help="nodes of the whole bus")
    options = parser.parse_args(words)
    # as an installer leaves it: PYTHONDONTWRITEBYTECODE, here or there, would have each process compile what it loads
    compileall.compile_dir(Path(teds_provision.__file__).parent, quiet=2)
    rows = Rows()
    for part in (start_up, start_to_end, fixed_cost, one_command, zeroing, watching, eight_readers):
        if options.only in ("", part.__name__):
            part(rows)
    if options.only in ("", "whole_bus"):
        whole_bus(rows, options.nodes)


if __name__ == "__main__":
    print(machine())
    main()
