"""Real bluetoothd over the kernel's Bluetooth: a virtual controller on /dev/vhci, two nodes in the air."""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

from teds_provision.links.ble.bluez import adapters
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.e2e.desk import ANGLE
from tests.links.ble.radio import CONFIG
from tests.links.ble.test_whole_runs import tapped_once
from tests.system.inside import FOLDER, Bench, look, process, sh

BUS = Path("/run/dbus/system_bus_socket")


class Air:
    """The process of the nodes."""

    def __init__(self, running: Any) -> None:
        self._running = running

    def ask(self, words: Any) -> Any:
        """Send one line and return the line that comes back."""
        self._running.stdin.write(json.dumps(words) + "\n")
        self._running.stdin.flush()
        return json.loads(self._running.stdout.readline())


def provision(bench: Bench, *words: object) -> dict[str, Any]:
    began = time.monotonic()
    done = bench.run("provision", "--profile", ANGLE, "--yes", "--via", "ble", *words, "--timeout", "120")
    record = json.loads(done.out) if done.out else {}
    steps = {step["name"]: step["result"] for step in record.get("steps", [])}
    return {
        "code": done.code,
        "verdict": record.get("verdict"),
        "uuid": record.get("uuid"),
        "steps": steps,
        "took": round(time.monotonic() - began, 1),
        "said": (done.out + done.err)[-600:],
    }


def power_on() -> dict[str, Any]:
    """bluetoothd starts with the adapter off."""
    until = time.monotonic() + 60
    output = ""
    while time.monotonic() < until:
        output = sh("bluetoothctl", "power", "on")
        found = adapters()
        if found and found[0].powered:
            return {"adapters": [[adapter.name, adapter.powered, adapter.central] for adapter in found]}
        time.sleep(1)
    return {"error": f"the adapter does not come up: {output}"}


def main() -> None:
    """Play the scene."""
    config = FOLDER / "bus.conf"
    config.write_text(CONFIG.format(path=BUS))
    bench = Bench()
    nodes = [FOLDER / "left", FOLDER / "right", FOLDER / "in-c"]
    station = Station.open(bench.home, ask=lambda _prompt, _confirm: PASSPHRASE)
    for node in nodes:
        tapped_once(station, node)
    station.close()
    uuids = [json.loads((node / "flash.json").read_text())["flash"]["uuid"] for node in nodes]
    os.environ["DBUS_SYSTEM_BUS_ADDRESS"] = f"unix:path={BUS}"
    with (
        process("dbus-daemon", f"--config-file={config}", "--nofork", "--nopidfile"),
        process(sys.executable, "-m", "tests.links.ble.air") as running,
    ):
        air = Air(running)
        wanted = {"nodes": [str(node) for node in nodes], "in_c": [str(nodes[2])], "vhci": True}
        addresses = air.ask(wanted)["nodes"]
        with process("/usr/libexec/bluetooth/bluetoothd", "-n"):
            look("power", power_on)
            look("first", lambda: provision(bench, "--ble", f"hci0?address={addresses[0]}"))
            look("again", lambda: provision(bench, "--name", "left", uuids[0], "--ble", "auto"))
            air.ask(["cut", 1, 20])
            look("reconnect", lambda: provision(bench, "--name", "right", "--ble", f"hci0?address={addresses[1]}"))
            look("in-c", lambda: provision(bench, "--name", "in C", "--ble", f"hci0?address={addresses[2]}"))
            look("all", lambda: identify(bench, uuids))
            look("uuids", lambda: {"uuids": uuids})


def identify(bench: Bench, uuids: list[str]) -> dict[str, Any]:
    done = bench.run("identify", "--via", "ble", "--timeout", "120")
    record = json.loads(done.out)
    found = sorted(node["uuid"] for node in record.get("nodes", [record]) if "uuid" in node)
    error = record.get("error") or done.err[-500:]
    return {"code": done.code, "found": found, "expected": sorted(uuids), "told": error}


if __name__ == "__main__":
    main()
