"""SocketCAN on vcan0: the kernel's own CAN, ISO-TP and candump beside the program."""

from __future__ import annotations

import json
import socket
import struct
import threading
import time
from typing import Any

from teds_provision.links.can.port import CanPort
from teds_provision.links.ports import Notice
from teds_provision.protocol.messages.frames import Function, decode_reply, security_command
from teds_provision.protocol.messages.identity import Identity
from tests.e2e.desk import ANGLE
from tests.system.inside import FOLDER, Bench, later, look, process, program, sh

CAN, FD = "socketcan:vcan0", "socketcan:vcan0?fd=1"
IDENTIFY = security_command(Function.IDENTIFY).encode()
EXTENDED = 0x8000_0000
CALIBRATION = "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n"


def bus_is_up() -> dict[str, Any]:
    sh("ip", "link", "add", "dev", "vcan0", "type", "vcan")
    sh("ip", "link", "set", "vcan0", "mtu", "72")
    sh("ip", "link", "set", "vcan0", "up")
    return {"link": sh("ip", "-brief", "link", "show", "vcan0").strip()}


def provision(bench: Bench, node: dict[str, Any], where: str) -> dict[str, Any]:
    table = FOLDER / "angle.csv"
    table.write_text(CALIBRATION)
    at = f"{where}{'&' if '?' in where else '?'}node={node['can_address']}"
    done = bench.run(
        *("provision", "--profile", ANGLE, "--calibration", table, "--name", node["name"]),
        *("--via", "can", "--can", at, "--yes"),
    )
    return {"code": done.code, "verdict": done.json.get("verdict"), "said": (done.out + done.err)[-600:]}


def measure(bench: Bench, node: dict[str, Any], where: str, seconds: float) -> dict[str, Any]:
    done = bench.run("measure", node["uuid"], "--can", where, "--rate", "10", "--duration", seconds)
    events = [line for line in done.lines if line.get("event") == "data"]
    ended = done.lines[-1].get("nodes", [{"streams": []}])
    streams = ended[0]["streams"]
    return {
        "code": done.code,
        "samples": sum(stream["samples"] for stream in streams),
        "lost": sum(stream["lost"] for stream in streams),
        "bad": sum(stream["bad"] for stream in streams),
        "events": len(events),
        "states": [line["state"] for line in done.lines if line.get("event") == "status"],
        "said": (done.out + done.err)[-800:],
    }


def two_stations(bench: Bench, node: dict[str, Any]) -> dict[str, Any]:
    """Measure with one station while another, under its own source address, asks who is there."""
    other = Bench("other")
    words = ["--home", other.home, "--json", "identify", "--via", "can", "--can", f"{CAN}?source=0xF2&node="]
    words[-1] = f"{words[-1]}{node['can_address']}"
    with process(*program(*words)) as second:
        measured = measure(bench, node, CAN, 20)
        out, _ = second.communicate(timeout=120)
    record = json.loads(out)
    return {**measured, "second": second.returncode, "second_saw": record.get("uuid"), "uuid": node["uuid"]}


def candump(node: dict[str, Any]) -> dict[str, Any]:
    """Return what candump sees of one Identify to everyone and one to the node."""
    with process("candump", "-L", "vcan0") as dump:
        time.sleep(3)
        port = CanPort(CAN)
        try:
            found = port.find(lambda _: True, seconds=20, notice=quiet, address=node["can_address"])
            found.link.exchange(IDENTIFY)
            everyone = port.find_all(seconds=20, notice=quiet)
        finally:
            port.close()
        time.sleep(2)
        dump.terminate()
        out, _ = dump.communicate(timeout=30)
    frames = [line.split()[2] for line in out.splitlines()]
    return {"frames": frames[:60], "nodes": len(everyone), "address": node["can_address"]}


def quiet(_notice: Notice) -> None:
    """Nobody looks."""


def isotp_socket(rx: int, tx: int) -> socket.socket:
    """Return the kernel's ISO-TP between two 29-bit addresses, padded as the contract says."""
    made = socket.socket(socket.AF_CAN, socket.SOCK_DGRAM, socket.CAN_ISOTP)
    base, options, padding = 106, 1, 0x04  # SOL_CAN_BASE + CAN_ISOTP, CAN_ISOTP_OPTS, CAN_ISOTP_TX_PADDING
    made.setsockopt(base, options, struct.pack("=LLBBBB", padding, 0, 0, 0xCC, 0xCC, 0))
    made.bind(("vcan0", rx | EXTENDED, tx | EXTENDED))
    made.settimeout(20)
    return made


def kernel_asks_our_node(node: dict[str, Any]) -> dict[str, Any]:
    """Return the kernel's ISO-TP as a station: a short command, and one whose reply has many frames."""
    address = node["can_address"]
    with isotp_socket(0x18DA0000 | 0xF3 << 8 | address, 0x18DA0000 | address << 8 | 0xF3) as station:
        station.send(b"\x07" + IDENTIFY)
        short = station.recv(4096)
        read = bytes((0, 1, 1, 2, 0, 5)) + b"\x03" + bytes(4)  # Read of the Channel TEDS from its begin
        station.send(b"\x08" + read)
        long = station.recv(4096)
    uuid = Identity.decode(decode_reply(short[1:]).payload).uuid.hex()
    return {"transaction": short[0], "uuid": uuid, "expected": node["uuid"], "ok": long[1], "octets": len(long)}


def our_station_asks_the_kernel() -> dict[str, Any]:
    """Talk to the kernel's ISO-TP as a node at 0x55: what we send arrives octet for octet, and the reply comes back."""
    command = bytes((0, 128, 0, 60)) + (1800).to_bytes(2, "big") + bytes(index % 251 for index in range(1800))
    reply = b"\x01" + (1500).to_bytes(2, "big") + bytes(index % 241 for index in range(1500))
    got: list[bytes] = []

    def node() -> None:
        with isotp_socket(0x18DA55F1, 0x18DAF155) as there:
            ready.set()
            got.append(there.recv(4096))
            there.send(got[0][:1] + reply)

    ready = threading.Event()
    thread = threading.Thread(target=node, daemon=True)
    thread.start()
    ready.wait(20)
    port = CanPort(CAN)
    try:
        back = port.link(0x55).exchange(command)
    finally:
        port.close()
    thread.join(20)
    return {"arrived": got[0][1:] == command, "returned": back == reply, "octets": [len(command), len(reply)]}


def link_goes_down_and_comes_back(bench: Bench, node: dict[str, Any]) -> dict[str, Any]:
    later(25, lambda: sh("ip", "link", "set", "vcan0", "down"))
    later(30, lambda: sh("ip", "link", "set", "vcan0", "up"))
    return measure(bench, node, CAN, 70)


def bus_off_is_reported(bench: Bench, node: dict[str, Any]) -> dict[str, Any]:
    """Return an error frame that says bus-off ends the sessions of the bus; the measurement comes back by itself."""
    later(25, lambda: sh("cansend", "vcan0", "20000040#0000000000000000"))
    return measure(bench, node, CAN, 70)


def main() -> None:
    """Play the scene."""
    look("bus", bus_is_up)
    bench = Bench()
    nodes = []
    for name in ("left", "right"):
        folder = FOLDER / name
        words = ("node", "create", folder, "--name", name, "--profile", ANGLE)
        made = bench.run(*words).json
        nodes.append({**made, "name": name, "folder": folder})
    with process(*program("node", "run", *(node["folder"] for node in nodes), "--can", FD, "--json")) as running:
        assert running.stdout is not None
        ready = running.stdout.readline()
        look("ready", lambda: {"said": ready[:300]})
        threading.Thread(target=running.stdout.read, daemon=True).start()
        look("provision", lambda: provision(bench, nodes[0], CAN))
        look("provision-fd", lambda: provision(bench, nodes[1], FD))
        look("candump", lambda: candump(nodes[0]))
        look("kernel-station", lambda: kernel_asks_our_node(nodes[0]))
        look("kernel-node", our_station_asks_the_kernel)
        look("measure-fd", lambda: measure(bench, nodes[1], FD, 15))
        look("two-stations", lambda: two_stations(bench, nodes[0]))
        look("down-and-up", lambda: link_goes_down_and_comes_back(bench, nodes[0]))
        look("bus-off", lambda: bus_off_is_reported(bench, nodes[0]))


if __name__ == "__main__":
    main()
