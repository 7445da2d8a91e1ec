"""A disk that fills up under a recording and has room again: told to everyone, counted, and recorded on."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from teds_provision.measure.blocks import ClockSet, NodeReport
from teds_provision.measure.sinks import files as recording
from teds_provision.measure.sinks import open_sink
from teds_provision.measure.sinks.mcap.recover import recover
from tests.e2e.desk import ANGLE, PROGRAM, Running
from tests.measure.rig import Rig, events, of
from tests.measure.sinks.parts import ANGLE as FACTS
from tests.measure.sinks.parts import STATION, block
from tests.measure.test_clock_set import stamps, wait_for_data
from tests.ncap.service import Service
from tests.pace import until

pytestmark = pytest.mark.link
SMALL = 3 << 20  # octets of the disk
SUFFIXES = ("csv", "jsonl", "mcap")


class SmallDisk:
    """A disk of SMALL octets that only one program sees, and this test by way of it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        script = f'mount -t tmpfs -o size={SMALL},mode=755 tmpfs "$0" && exec "$@"'
        enter = ("unshare", "--mount", "--map-root-user", "sh", "-c", script, str(folder))
        if not shutil.which("unshare") or subprocess.run([*enter, "true"], capture_output=True, check=False).returncode:
            pytest.skip("a small file system cannot be mounted here")
        self.program = (*enter, *PROGRAM)

    def seen_by(self, running: Running) -> Path:
        """Return the folder as the program sees it."""
        return Path(f"/proc/{running.process.pid}/root{self.folder}")


def fill(folder: Path) -> None:
    """Take all the room that is left."""
    with (folder / "ballast").open("ab", buffering=0) as file:
        for size in (1 << 16, 1 << 10, 1):
            with suppress(OSError):  # no space left
                while True:
                    file.write(bytes(size))


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path / "rig", {"a": ANGLE})
    made.nodes["a"].start()
    try:
        yield made
    finally:
        made.close()


def test_measure_goes_on_when_there_is_room_again(rig: Rig, tmp_path: Path) -> None:
    disk = SmallDisk(tmp_path / "disk")
    to = [word for suffix in SUFFIXES for word in ("--to", disk.folder / f"run.{suffix}")]
    running = rig.begin(rig.nodes["a"].uuid, "--rate", 400, *to, program=disk.program)
    wait_for_data(running)
    folder = disk.seen_by(running)
    until(lambda: all((folder / f"run.{suffix}").stat().st_size > 4000 for suffix in SUFFIXES))
    fill(folder)

    def sink_states(state: str) -> set[str]:
        running.read(0.1)
        lines = [line for line in events(running.out) if line["event"] == "sink" and line["state"] == state]
        return {Path(line["sink"]).suffix[1:] for line in lines if "disk" in line["why"]}

    until(lambda: sink_states("waiting") == set(SUFFIXES), "not all three say that the disk is full")
    wait_for_data(running, 200)
    (folder / "ballast").unlink()
    until(lambda: sink_states("running") == set(SUFFIXES), "not all three go on")
    wait_for_data(running, 200)
    kept = tmp_path / "kept"
    until(lambda: all((folder / f"run.2.{suffix}").stat().st_size > 4000 for suffix in SUFFIXES))
    running.signal(signal.SIGSTOP)  # what it wrote is gone with it
    shutil.copytree(folder, kept)
    running.signal(signal.SIGCONT)
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 7, "values are missing"
    end = events(outcome.out)[-1]
    assert "The disk was full from" in end["error"]["message"]
    shown = [instant for line in of(events(outcome.out)) for instant in line["time"]]
    assert max(b - a for a, b in pairwise(shown)) < 0.5, "the measurement itself went on"
    assert recover(kept / "run.mcap").was_whole, "it is made whole before its next part begins"
    recover(kept / "run.2.mcap")  # it was being written
    for suffix in SUFFIXES:
        first, second = (stamps(kept / f"run{part}.{suffix}") for part in ("", ".2"))
        assert first == sorted(first)
        assert second == sorted(second)
        gap = [instant for instant in shown if first[-1] + 1e-5 < instant < second[0] - 1e-5]
        [line] = [event for event in events(outcome.out) if event["event"] == "sink" and event["state"] == "running"
                  and event["sink"].endswith(suffix)]  # fmt: skip
        assert line["dropped"] == len(gap) > 100, "exactly those that no part has"
        assert str(len(gap)) in line["why"]
        assert line["why"].encode() in (kept / f"run.2.{suffix}").read_bytes(), "the part says what is missing"


def test_the_daemon_begins_a_new_part_when_there_is_room_again(rig: Rig, tmp_path: Path) -> None:
    disk = SmallDisk(tmp_path / "disk")
    service = Service(rig.desk, rig.station)
    words = ["--json", "ncap", "run", "--can", rig.can, "--record", disk.folder]
    service.process = running = rig.station.start(*words, program=disk.program)
    running.wait_for('"ready"')
    folder = disk.seen_by(running)
    with service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [rig.nodes["a"].uuid], "rate": 100})

        def sink() -> dict[str, object]:
            return dict(next(iter(asked.status()["sinks"]), {}))

        until(lambda: int(str(sink().get("written", 0))) > 100, "nothing is recorded")
        fill(folder)
        until(lambda: sink()["state"] == "waiting", "the full disk is not told")
        assert "The disk is full since" in str(sink()["detail"])
        assert "The disk is full since" in rig.station.run("ncap", "status").out
        until(lambda: sink()["dropped"], "what is lost is not counted")
        (folder / "ballast").unlink()
        until(lambda: sink()["state"] == "running", "it does not go on")
        after = sink()
        assert f"{after['dropped']} values are not recorded" in str(after["detail"])
        until(lambda: int(str(sink()["written"])) > int(str(after["written"])) + 100)
        assert len(after["files"]) == 2  # type: ignore[arg-type]
    running.wait_for('"state": "waiting"')
    running.wait_for("values are not recorded")
    service.end()


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_clock_is_set_and_a_datasheet_comes_while_the_disk_is_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    """The next part knows both; the file that could not even be begun leaves nothing."""
    full, real = [False], os.write

    def write(file: int, octets: bytes) -> int:
        if full[0] and os.path.realpath(f"/proc/self/fd/{file}").startswith(str(tmp_path)):
            raise OSError(errno.ENOSPC, "full")
        return real(file, octets)

    monkeypatch.setattr(recording.os, "write", write)
    monkeypatch.setattr(recording, "AGAIN", 0.05)
    sink = open_sink(str(tmp_path / f"run.{suffix}"))
    sink.open([FACTS], STATION)
    sink.write(block())
    until(lambda: (tmp_path / f"run.{suffix}").stat().st_size > 300 and b"8d4d" in
          (tmp_path / f"run.{suffix}").read_bytes())  # fmt: skip
    time.sleep(0.3)
    full[0] = True
    sink.write(block(index=3))
    until(lambda: sink.stats.state == "waiting")
    time.sleep(0.3)
    sink.clock_set(ClockSet(5000.0, 60.0))
    sink.describe([replace(FACTS, fingerprint="ef" * 32)])
    sink.report(NodeReport(FACTS.uuid, "running"))
    sink.write(block(index=6))
    time.sleep(0.3)
    assert sink.stats.state == "waiting"
    until(lambda: [path.name for path in tmp_path.iterdir()] == [f"run.{suffix}"], "tries that failed leave something")
    full[0] = False
    until(lambda: sink.stats.state == "running")
    sink.write(block(index=9))
    sink.close()
    assert (sink.stats.written, sink.stats.dropped) == (6, 6)
    assert sink.stats.error.count("6 values are not recorded") == 1
    assert len(sink.files) == 2
    second = Path(sink.files[1])
    octets = second.read_bytes()
    assert len(stamps(second)) == 3
    assert b"ef" * 32 in octets
    assert b"set forward by 60.000 s" in octets
    if suffix == "mcap":
        assert recover(Path(sink.files[0])).was_whole
