"""The system's clock is set while nodes are measured: a new part begins, both say so, and stamps are right again."""

from __future__ import annotations

import signal
import struct
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from teds_provision.measure.blocks import ClockSet, GroupRows
from teds_provision.measure.clock import STEP, HostClock, WallClock
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, Running
from tests.measure.rig import Rig, events, of
from tests.measure.sinks.parts import ANGLE as FACTS
from tests.measure.sinks.parts import ARM, STATION
from tests.measure.sinks.test_live import Carrier
from tests.ncap.service import Service
from tests.pace import PATIENCE, until

pytestmark = pytest.mark.link
HOUR = 3600.0


class SystemClock:
    """The clock as one program sees it."""

    def __init__(self, folder: Path) -> None:
        library, self._offset = folder / "clock.so", folder / "offset"
        source = Path(__file__).with_name("clock.c")
        subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-o", str(library), str(source)], check=True)
        self.put(0.0)
        self.environment = clean_environment(LD_PRELOAD=str(library), CLOCK_OFFSET=str(self._offset))

    def put(self, seconds: float) -> None:
        """Set it so far before (negative: behind) the true one."""
        with self._offset.open("r+b" if self._offset.exists() else "wb") as file:
            file.write(struct.pack("<q", int(seconds * 1e9)))


@pytest.fixture
def clock(tmp_path: Path) -> SystemClock:
    return SystemClock(tmp_path)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    made = Rig(tmp_path / "rig", {"a": ANGLE})
    try:
        yield made
    finally:
        made.close()


def stamps(path: Path) -> list[float]:
    """Times of all samples of a recording."""
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            found = make_reader(file).iter_messages()
            return [message.log_time / 1e9 for _, channel, message in found if "/stream_" in channel.topic]
    if path.suffix == ".jsonl":
        return [instant for line in of(events(path.read_text())) for instant in line["time"]]
    lines = [line for line in path.read_text().splitlines() if line[:1].isdigit()]
    return [float(line.split(",")[0]) for line in lines]


def notes(path: Path) -> list[str]:
    """Return what a recording says of itself."""
    if path.suffix == ".mcap":
        with path.open("rb") as file:
            return [
                metadata.metadata["note"] for metadata in make_reader(file).iter_metadata() if metadata.name == "note"
            ]
    if path.suffix == ".jsonl":
        return [line["why"] for line in events(path.read_text()) if line["event"] == "note"]
    return [line for line in path.read_text().splitlines() if "clock was set" in line]


def wait_for_data(running: Running, more: int = 5) -> None:
    before, end = running.out.count('"event":"data"'), time.monotonic() + PATIENCE
    while running.out.count('"event":"data"') < before + more:
        assert time.monotonic() < end, running.out[-2000:]
        running.read(0.1)


def test_a_clock_that_was_wrong_at_the_start_is_followed_when_it_is_set(
    rig: Rig, clock: SystemClock, tmp_path: Path
) -> None:
    """An hour behind, then right, then put back by ten seconds: three parts, in each of which the stamps agree."""
    rig.nodes["a"].start()
    clock.put(-HOUR)
    files = [tmp_path / f"run.{suffix}" for suffix in ("csv", "jsonl", "mcap")]
    to = [word for file in files for word in ("--to", file)]
    began = time.time()
    running = rig.begin(rig.nodes["a"].uuid, "--rate", 20, *to, environment=clock.environment)
    wait_for_data(running)
    for seconds, way in ((0.0, "set forward by 3600.0"), (-10.0, "set back by 10.0")):
        clock.put(seconds)
        running.wait_for(way)
        wait_for_data(running)
    running.signal(signal.SIGTERM)
    outcome = running.end()
    assert outcome.code == 0, outcome.err
    for file in files:
        parts = [file, file.with_suffix(f".2{file.suffix}"), file.with_suffix(f".3{file.suffix}")]
        assert all(str(part) in events(outcome.out)[-1]["files"] for part in parts)
        assert [len(notes(part)) for part in parts] == [1, 2, 1], file
        for part, offset in zip(parts, (-HOUR, 0.0, -10.0), strict=True):
            times = stamps(part)
            assert times == sorted(times)
            assert began + offset - 1 < times[0] <= times[-1] < time.time() + offset + 1, part
        joined = [instant - offset for part, offset in zip(parts, (-HOUR, 0.0, -10.0), strict=True)
                  for instant in stamps(part)]  # fmt: skip
        assert np.diff(joined).max() < 0.5, "nothing is lost between the parts"
    [header] = [line for line in files[0].with_suffix(".2.csv").read_text().splitlines() if "# started:" in line]
    assert header[11:21] == time.strftime("%Y-%m-%d", time.gmtime(began)), "the start, by the clock that is right"


def test_the_daemon_follows_it_too(rig: Rig, clock: SystemClock, tmp_path: Path) -> None:
    rig.nodes["a"].start()
    clock.put(-HOUR)
    service = Service(rig.desk, rig.station, "--record", tmp_path / "kept")
    service.process = running = rig.station.start(
        "--json", "ncap", "run", "--can", rig.can, "--record", tmp_path / "kept", environment=clock.environment
    )
    running.wait_for('"ready"')
    with service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [rig.nodes["a"].uuid], "rate": 20, "sinks": ["mine.csv"]})
        until(lambda: asked.node(rig.nodes["a"].uuid)["channels"][0]["last"], "no value comes")
        clock.put(0.0)
        running.wait_for("The system clock was set forward by 3600.0")

        def right() -> bool:
            return abs(asked.node(rig.nodes["a"].uuid)["channels"][0]["last"]["time"] - time.time()) < 5

        until(right, "the page's value has the time of the wrong clock")

        def files() -> list[Path]:
            return [Path(file) for sink in asked.status()["sinks"] for file in sink["files"]]

        # its own recording and the one that the measurement names, two parts of each
        until(lambda: len(files()) == 4, files)
        parts = files()
    service.end()
    for file in parts:
        assert stamps(file)
        assert abs(stamps(file)[-1] - (time.time() - (0.0 if ".2." in file.name else HOUR))) < 60


def test_a_small_difference_is_no_step_and_widens_the_bound() -> None:
    now = WallClock.now()
    kept = HostClock(WallClock(now.offset - STEP / 2))
    assert not kept.was_set()
    assert kept.apart == pytest.approx(STEP / 2, abs=1e-4)
    kept = HostClock(WallClock(now.offset - 2 * STEP))
    assert kept.was_set()
    assert kept.set_anew() == pytest.approx(2 * STEP, abs=1e-4)
    assert kept.apart == 0.0
    assert kept.since(0) == pytest.approx(2 * STEP, abs=1e-4)
    assert not kept.was_set()


def test_rows_of_a_group_go_on_when_the_clock_was_put_back() -> None:
    """Each row must be newer than the last one: an hour back would have been an hour without one."""
    sink = Carrier()
    sink.open([FACTS], STATION)
    for start in (5000.0, 1400.0):
        sink.write_group(GroupRows("crane", ((ARM, 1),), np.array([start]), np.ones((1, 1)), np.zeros((1, 1))))
        sink.clock_set(ClockSet(start, -HOUR))
    sink.close()
    assert [stamp for topic, stamp, _, _ in sink.arrays if topic == "/bench/crane"] == [5000.0, 1400.0]
