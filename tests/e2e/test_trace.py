"""--trace at real links: every frame is there, sealed commands stand opened, no key does, no fault harms the work."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from .desk import ANGLE, PROGRAM, Desk

FULL_DISK = (
    PROGRAM[0],
    "-c",
    """
import os, runpy, sys
real, room = os.write, [3000]
def write(descriptor, octets):
    if os.readlink(f"/proc/self/fd/{descriptor}").endswith(".trace"):
        room[0] -= len(octets)
        if room[0] < 0:
            raise OSError(28, "No space left on device")
    return real(descriptor, octets)
os.write, sys.argv[0] = write, "teds-provision"
runpy.run_module("teds_provision", run_name="__main__")
""",
)
"""The program on a disk that takes 3000 octets of a trace; the store lies elsewhere."""


def frames_of(file: Path) -> list[dict[str, Any]]:
    """Return what ``trace show --json`` says."""
    done = subprocess.run(
        [sys.executable, "-m", "teds_provision", "--json", "trace", "show", str(file)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    return list(json.loads(done.stdout)["frames"])


@pytest.mark.parametrize("name", ["bench.trace", "bench.pcapng"])
def test_a_provisioning_is_written_down_and_opened(desk: Desk, tmp_path: Path, name: str) -> None:
    station, node, file = desk.station(), desk.node().start(), tmp_path / name
    station.provision("nfc", "--profile", ANGLE, "--trace", file)
    assert file.stat().st_mode & 0o777 == 0o600
    frames = frames_of(file)
    messages = [frame for frame in frames if frame["layer"] == "message"]
    sealed = [frame for frame in messages if frame["sealed"]]
    assert len(sealed) > 10
    assert all(frame["opened"] for frame in sealed)
    assert all(frame["uuid"] == node.uuid for frame in messages)
    assert [frame["direction"] for frame in messages] == ["out", "in"] * (len(messages) // 2)
    writes = b"".join(bytes.fromhex(frame["opened"]) for frame in sealed if frame["command"].startswith("Write (1.3)"))
    assert all(octets in writes for octets in node.datasheet.values())
    assert {frame["command"] for frame in messages} >= {"List (128.11), 0 octets", "Prove (128.8), 32 octets"}
    # The frames below carried them: what was written stands in them sealed, in pieces, and whole messages do not fit.
    assert {frame["link"] for frame in frames} == {"nfc"}
    assert any(frame["command"].startswith("I block") for frame in frames if frame["layer"] == "frame")
    key = str(node.flash["key"])
    assert len(key) >= 32
    assert key not in json.dumps(frames), "the link key never crosses the air, and no trace holds it"
    assert bytes.fromhex(key) not in file.read_bytes()


@pytest.mark.system
def test_a_bus_is_written_down_as_wireshark_reads_it(desk: Desk, tmp_path: Path) -> None:
    station, node, file = desk.station(), desk.node(), tmp_path / "bus.pcapng"
    node.start(can=True)
    station.provision("nfc", "--profile", ANGLE)
    station.ask("verify", node.uuid, *desk.links.over("can"), "--trace", file)
    frames = [frame for frame in frames_of(file) if frame["layer"] == "frame"]
    assert {frame["direction"] for frame in frames} == {"out", "in"}
    tshark = shutil.which("tshark")
    if tshark is None:
        pytest.skip("tshark is not installed")
    fields = ("-T", "fields", "-e", "can.id", "-e", "can.padding", "-e", "data.data", "-e", "frame.p2p_dir")
    done = subprocess.run(
        [tshark, "-r", str(file), "-Y", "can", *fields], capture_output=True, text=True, timeout=60, check=True
    )
    rows = [row.split("\t") for row in done.stdout.splitlines()]
    assert [(int(row[0]), row[3]) for row in rows] == [
        (int(frame["identifier"], 16), "0" if frame["direction"] == "out" else "1") for frame in frames
    ]
    carried = "".join(row[2].replace(":", "") for row in rows)
    assert all(frame["octets"] in carried for frame in frames)


def test_a_file_that_is_there_is_refused_before_anything_is_waited_for(desk: Desk, tmp_path: Path) -> None:
    station, file = desk.station(), tmp_path / "t.trace"
    file.write_text("mine")
    error = station.refuses("identify", *desk.links.over("nfc"), "--trace", file, code=2)
    assert "already exists" in error["message"]
    assert file.read_text() == "mine"
    error = station.refuses("identify", *desk.links.over("nfc"), "--trace", tmp_path / "no" / "t", code=3)
    assert "folder" in error["message"]


def test_a_full_disk_ends_the_trace_and_not_the_work(desk: Desk, tmp_path: Path) -> None:
    """The disk takes 3 kB of the trace: it is cut there, the node is read to its end, and 7 says so."""
    station, node, file = desk.station(), desk.node().start(), tmp_path / "t.trace"
    station.provision("nfc", "--profile", ANGLE)
    done = station.run("--json", "read", node.uuid, *desk.links.over("nfc"), "--trace", file, program=FULL_DISK)
    assert done.code == 7, done
    assert done.json["uuid"] == node.uuid
    assert "The trace" in done.err
    assert file.stat().st_size <= 3000
    assert frames_of(file)


def test_a_killed_command_leaves_a_trace_that_can_be_read(desk: Desk, tmp_path: Path) -> None:
    station, file = desk.station(), tmp_path / "t.trace"
    desk.node().start()
    running = station.start("provision", "--profile", ANGLE, "--yes", *desk.links.over("nfc"), "--trace", file)
    running.wait_for("identify")
    running.process.kill()
    running.end()
    assert [frame for frame in frames_of(file) if frame["direction"] == "out"]
