"""A bus that dies and comes back, a disk that is full, a reader that stalls: told, and the measurement goes on."""

from __future__ import annotations

import csv
import fcntl
import os
import pty
import shlex
import signal
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.measure.sinks.mcap.recover import recover
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, PASSPHRASE, Running, limited
from tests.links.can.hub import Hub
from tests.measure.rig import Rig, events, of, states
from tests.pace import PATIENCE
from tests.places import free_tcp_port

pytestmark = pytest.mark.link


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path, {"a": ANGLE})
    try:
        yield made
    finally:
        made.close()


def wait_for_count(running: Running, text: str, count: int, seconds: float = 60.0) -> None:
    """Wait until a text has come so often."""
    until = time.monotonic() + seconds
    while running.out.count(text) < count:
        assert time.monotonic() < until, running.out[-2000:]
        running.read(0.1)


def rows(file: Path) -> int:
    """Rows of values in a text recording, without a torn one at the end."""
    return sum(1 for line in file.read_text().splitlines() if not line.startswith("#")) - 1


def test_a_bus_that_dies_is_opened_again_when_it_is_back(rig: Rig) -> None:
    port = free_tcp_port()  # not one that the system may deal out to others while it is closed
    hub = Hub(port=port)
    try:
        rig.nodes["a"].start(can=hub.spec)
        running = rig.begin(rig.nodes["a"].uuid, "--rate", 20, can=hub.spec)
        running.wait_for('"event":"data"')
        hub.close()
        running.wait_for('"state":"lost"')
        hub = Hub(port=port)
        wait_for_count(running, '"state":"running"', 2)
        data = running.out.count('"event":"data"')
        wait_for_count(running, '"event":"data"', data + 5)
        running.signal(signal.SIGTERM)
        outcome = running.end()
    finally:
        hub.close()
    assert outcome.code == 0, outcome.err
    lines = events(outcome.out)
    assert states(lines)[:2] == ["waiting", "running"]
    assert states(lines)[-1] == "ended"
    times = [instant for line in of(lines) for instant in line["time"]]
    assert times == sorted(times)


def test_a_full_disk_ends_that_recording_and_nothing_else(rig: Rig, tmp_path: Path) -> None:
    rig.nodes["a"].start()
    file = tmp_path / "full.csv"
    running = rig.begin(rig.nodes["a"].uuid, "--rate", 500, "--to", file, program=limited(200_000))
    running.wait_for("cannot be written", 90)
    data = running.out.count('"event":"data"')
    wait_for_count(running, '"event":"data"', data + 5)
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 7, outcome.err
    end = events(outcome.out)[-1]
    assert end["nodes"][0]["streams"][0]["bad"] == 0
    assert "error" in end
    text = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    whole = list(csv.DictReader(text[:-1]))
    assert all(row["a/angle [rad]"] for row in whole), "whole up to there"


def test_a_reader_that_stalls_holds_up_no_recording(rig: Rig, tmp_path: Path) -> None:
    rig.nodes["a"].start()
    file = tmp_path / "run.csv"
    running = rig.begin(rig.nodes["a"].uuid, "--rate", 500, "--to", file)
    running.wait_for('"event":"data"')
    until = time.monotonic() + PATIENCE  # its lines are not read from here on: the pipe is full after a second
    before = rows(file)
    while rows(file) < before + 2000:
        assert time.monotonic() < until, "the recording went on"
        time.sleep(0.1)
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 0, outcome.err
    assert events(outcome.out)[-1]["event"] == "end"


def test_a_terminal_that_is_closed_ends_the_recording_in_order_and_lets_the_node_go(rig: Rig, tmp_path: Path) -> None:
    node, file = rig.nodes["a"].start(), tmp_path / "run.mcap"
    near, far = pty.openpty()

    def of_its_own() -> None:
        os.setsid()
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    words = [sys.executable, "-m", "teds_provision", "--home", rig.station.home, "--passphrase-fd", "9", "measure"]
    words += [node.uuid, "--can", rig.can, "--rate", "50", "--to", file]
    given = f"exec {shlex.join(map(str, words))} 9<<< {shlex.quote(PASSPHRASE)}"
    environment = clean_environment(TERM="xterm")
    measure = subprocess.Popen(
        ["bash", "-c", given],
        stdin=far,
        stdout=far,
        stderr=far,
        preexec_fn=of_its_own,  # noqa: PLW1509 - two calls of the system, nothing else
        env=environment,
    )
    os.close(far)
    try:
        shown = b""
        while b"running" not in shown:
            shown += os.read(near, 65536)
        os.close(near)
        assert measure.wait(PATIENCE) >= 0, "it ended by itself; what it said at its end nobody could read"
    finally:
        measure.kill()
        measure.wait()
    assert recover(file).was_whole
    assert rig.ask("mode", node.uuid)["mode"] == "configuration"


def test_a_measurement_that_ignores_sighup_goes_on(rig: Rig) -> None:
    node = rig.nodes["a"].start()
    held = "import runpy, signal, sys; signal.signal(signal.SIGHUP, signal.SIG_IGN); sys.argv[0] = 'teds-provision'; "
    program = (sys.executable, "-c", f"{held}runpy.run_module('teds_provision', run_name='__main__')")
    running = rig.begin(node.uuid, "--rate", 20, program=program, fork=False)
    running.wait_for('"event":"data"')
    running.signal(signal.SIGHUP)
    data = running.out.count('"event":"data"')
    wait_for_count(running, '"event":"data"', data + 10)
    running.signal(signal.SIGTERM)
    assert running.end().code == 0
