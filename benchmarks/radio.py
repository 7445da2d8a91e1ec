"""Links with a pace of their own: BLE, Type 2 behind a PN532, and nodes on slow chips, as ratios to their limits.

``python -m benchmarks.radio [ble|pn532|chips]``, all of them without a word. Nodes are virtual, in processes of their
own. Of BLE each acknowledged write takes 37.5 ms (a connection interval of 30 to 50 ms, Linux's default), and the limit
is writes × 37.5 ms. Of a PN532 on a serial line every octet takes 10 bits at the speed of the line, every command of
the chip 1 ms (an assumption), and every frame in the air what it takes at 106 kbit/s. Of slow chips every step of a
provisioning is shown, over paced links, beside the papers' 10 s.
"""

from __future__ import annotations

import json
import os
import secrets
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from teds_provision.links import LinkSettings
from teds_provision.links.ports import free_port
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.station import Station, initialise
from teds_provision.vault.passphrase import THROWAWAY

PROFILE = "magnetic-angular-position-sensor"
WRITE_SECONDS = 0.0375
CHIPS = (0, 115, 220, 665)
PAPER_SECONDS = 10.0
_RUNS = 3


def main(words: list[str]) -> None:
    """Run what is asked for."""
    parts: dict[str, Callable[[Path, Station], None]] = {"ble": ble, "pn532": pn532, "chips": chips}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        station = initialise(
            place / "home", name="bench", keystore="file", ask=lambda _p, _c: "correct horse", costs=THROWAWAY
        )[0]
        for name in words or list(parts):
            parts[name](place, station)
        station.close()


def _run(station: Station, links: LinkSettings, name: str) -> tuple[ProvisionResult, float, float]:
    """Provision the node that is present; return seconds until it was found, and from then to the verdict."""
    began = time.perf_counter()
    with meet(station, links, None, SilentReporter()) as node:
        found = time.perf_counter()
        done = provision(
            station,
            node,
            BuildOrder(profile=PROFILE, name=name),
            operator=AcceptingOperator(),
            reporter=SilentReporter(),
        )
        verdict = time.perf_counter()
    return done, found - began, verdict - found


def ble(place: Path, station: Station) -> None:
    """Give a keyed node a new datasheet over the air: identify to verdict."""
    from tests.links.ble.radio import Radio
    from tests.links.ble.test_whole_runs import tapped_once

    print("\nBLE, paced at 37.5 ms an acknowledged write (virtual radio; bleak's BlueZ code, a stand-in below)")
    print(f"{'MTU':>5} {'writes':>7} {'found':>7} {'seconds':>8} {'limit':>7} {'ratio':>6}")
    for mtu in (23, 247, 517):
        folder = place / f"air{mtu}"
        folder.mkdir()
        tapped_once(station, folder / "node")
        radio = Radio(folder, [folder / "node"], manners={"mtu": mtu, "delay": WRITE_SECONDS})
        os.environ["DBUS_SYSTEM_BUS_ADDRESS"] = radio.address
        try:
            rows = []
            for _ in range(_RUNS):
                before = radio.do("pieces", 0)
                _, found, seconds = _run(station, LinkSettings(via="ble", timeout=30), secrets.token_hex(4))
                rows.append((radio.do("pieces", 0) - before, found, seconds))
        finally:
            radio.close()
        writes, found, seconds = rows[0][0], *(statistics.median(row[column] for row in rows) for column in (1, 2))
        limit = writes * WRITE_SECONDS
        print(f"{mtu:5d} {writes:7d} {found:7.2f} {seconds:8.2f} {limit:7.2f} {seconds / limit:6.2f}")


def pn532(place: Path, station: Station) -> None:
    """Provision a new node on a PN532 behind a serial line: from the tap to the verdict."""
    print("\nPN532 on a serial line, as fast as nfcpy sets it (chip model under nfcpy's own driver), paced")
    print(f"{'tag':>7} {'commands':>9} {'octets':>8} {'seconds':>8} {'limit':>7} {'ratio':>6}")
    for tag in ("4", "2"):
        rows = []
        for turn in range(_RUNS):
            with _serial(place / f"pn532-{tag}-{turn}", tag) as (where, link_usage):
                _, found, seconds = _run(station, LinkSettings(nfc=where, timeout=30), secrets.token_hex(4))
            rows.append((*link_usage(), found + seconds))
        commands, octets, limit, seconds = sorted(rows, key=lambda row: row[3])[len(rows) // 2]
        print(f"Type {tag:>2} {commands:9d} {octets:8d} {seconds:8.2f} {limit:7.2f} {seconds / limit:6.2f}")


@contextmanager
def _serial(folder: Path, tag: str) -> Iterator[tuple[str, Callable[[], tuple[int, int, float]]]]:
    """Yield a reader on a pty with a node on it, and the chip's counters: commands, octets, the least seconds."""
    path = f"udp:localhost:{free_port()}"
    name = f"ttyTP{os.getpid()}{secrets.randbelow(1000)}"
    with _node(folder, "--nfc", path, "--tag", tag):
        chip = subprocess.Popen(
            [sys.executable, "-m", "tests.links.nfc.pn532_chip", name, path, "--pace"],
            stdout=subprocess.PIPE,
            text=True,
        )
        assert chip.stdout is not None
        chip.stdout.readline()
        counts: list[Any] = []

        def usage() -> tuple[int, int, float]:
            return int(counts[0]), int(counts[1]), float(counts[2]) + float(counts[3])

        try:
            yield f"tty:{name}:pn532", usage
        finally:
            chip.terminate()
            counts += json.loads(chip.stdout.readline() or "[0, 0, 0, 0]")
            chip.wait(10)


@contextmanager
def _node(folder: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
    """Run a node in a process."""
    program = [sys.executable, "-m", "teds_provision", "--json", "node"]
    subprocess.run([*program, "create", str(folder)], check=True, stdout=subprocess.DEVNULL)
    running = subprocess.Popen([*program, "run", str(folder), *words], stdout=subprocess.PIPE, text=True)
    assert running.stdout is not None
    running.stdout.readline()
    try:
        yield running
    finally:
        running.terminate()
        running.wait(10)


def chips(place: Path, station: Station) -> None:
    """Provision a new node with a slow chip over paced links, step by step."""
    steps = ("identify", "agree", "build", "sign", "write", "verify")
    print("\nSlow chips: seconds of each step of `provision`, paced links, one new node each; the papers allow 10 s")
    print(f"{'link':<12} {'ms each':>8} " + " ".join(f"{step:>9}" for step in steps) + f" {'whole':>7}  {'of 10 s':>7}")
    for delay in CHIPS:
        slow = ["--crypto-delay", str(delay)] if delay else []
        for link in ("NFC Type 4", "CAN 500k"):
            folder = place / f"chip{delay}{link[:3]}"
            if link.startswith("NFC"):
                path = f"udp:localhost:{free_port()}"
                words, links = ["--nfc", path, "--pace"], LinkSettings(nfc=path, timeout=60)
            else:
                bus = f"udp_multicast:239.74.163.2?port={free_port()}&pace=1"
                words, links = ["--can", bus], LinkSettings(via="can", can=bus, timeout=60)
            with _node(folder, *words, *slow):
                done, found, seconds = _run(station, links, secrets.token_hex(4))
                seconds += found
            durations = {step.name: step.seconds for step in done.steps}
            row = " ".join(f"{durations[step]:9.2f}" for step in steps)
            print(f"{link:<12} {delay:8d} {row} {seconds:7.2f}  {seconds / PAPER_SECONDS:7.0%}")


if __name__ == "__main__":
    main(sys.argv[1:])
