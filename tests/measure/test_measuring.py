"""`measure`, `sample`, `set`, `mode`, `group` at two virtual nodes over a real CAN bus, every command a process."""

from __future__ import annotations

import csv
import json
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from teds_provision.measure.sinks.mcap.recover import recover
from tests.bench import make_station
from tests.e2e.desk import ANGLE, Desk, Node, Station
from tests.pace import best_of, until

pytestmark = pytest.mark.link
LONG = ("--dead-man", 10_000)  # so that a machine that stands still for a while ends nothing
CALIBRATIONS = {
    ANGLE: "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n",
    "gripper": "# date: 2026-10-01\nraw,value,channel\n0,0,1\n4095,110,1\n0,0,2\n4095,110,2\n0,0,3\n4095,140,3\n",
}


class Bench:
    """A station that has provisioned an angle sensor and a gripper, both on one bus and running."""

    def __init__(self, desk: Desk, only: str = "") -> None:
        self.desk, self.station = desk, desk.station()
        self.can = ["--can", f"{desk.links.can}&fd=1"]
        self.gripper = self.node("g", "gripper")
        self.angle = self.gripper if only else self.node("a", ANGLE)

    def node(self, name: str, type_: str) -> Node:
        node = self.desk.node(name, called=name, type_=type_)
        self.power(node)
        calibration = self.desk.folder / f"{name}.csv"
        calibration.write_text(CALIBRATIONS[type_])
        words = ["--profile", type_, "--calibration", calibration, "--name", name, "--via", "can", *self.can]
        words[-1] = f"{words[-1]}&node=0x{node.flash['can_address']:02X}"
        done = self.station.ask("provision", *words, "--yes")
        assert done["uuid"] == node.uuid
        assert done["verdict"] == "authentic"
        return node

    def power(self, node: Node) -> None:
        node.process = self.desk.start("--json", "node", "run", node.folder, *self.can, "--source", "ramp:2")
        node.process.wait_for('"ready": true')

    @contextmanager
    def visited(self) -> Iterator[None]:
        """One test at this bench, however it ends: what it began ends, and both nodes are powered again."""
        try:
            yield
        finally:
            nodes = {self.gripper.folder: self.gripper, self.angle.folder: self.angle}.values()
            self.desk.clear(but=[node.process for node in nodes])
            for node in nodes:
                if node.process is None or not node.process.runs:
                    self.power(node)
            for group in self.station.ask("group", "list")["groups"]:
                self.station.ask("group", "delete", group["name"])

    def ask(self, *words: object, code: int = 0) -> Any:
        return self.station.ask(*words, *self.can, code=code)

    def measure(self, *words: object, code: int = 0) -> list[dict[str, Any]]:
        """A measurement to its end: its lines of JSON."""
        outcome = self.station.run("--json", "measure", *words, *self.can)
        assert outcome.code == code, outcome
        return [json.loads(line) for line in outcome.out.splitlines()]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    prepared = tmp_path_factory.mktemp("stations")
    make_station(prepared / "bench", "bench").close()
    desk = Desk(tmp_path_factory.mktemp("measuring"), prepared)
    try:
        yield Bench(desk)
    finally:
        desk.clear()


def data(lines: list[dict[str, Any]], channel: int = 1) -> list[dict[str, Any]]:
    return [line for line in lines if line["event"] == "data" and line["channel"] == channel]


def test_sample_gives_calibrated_values_with_unit_and_uncertainty(bench: Bench) -> None:
    def beside() -> float:
        """Seconds by which its time lies outside the command: it is as right as the exchange with the clock was."""
        before = time.time()
        [sample] = bench.ask("sample", bench.angle.uuid)["samples"]
        assert (sample["channel"], sample["name"], sample["unit"], sample["valid"]) == (1, "angle", "rad", True)
        assert sample["value"] == pytest.approx(sample["raw"] * 6.281440 / 65535, abs=1e-4)
        assert sample["uncertainty"] == pytest.approx(0.01745, abs=1e-4)
        return max(before - sample["time"], sample["time"] - time.time())

    best_of(5, 0.5, beside, because="an exchange with the clock is as good as its delay")
    some = bench.ask("sample", bench.gripper.uuid, 3)["samples"]
    assert [item["channel"] for item in some] == [3]


def test_sample_of_an_actuator_or_of_nothing_is_refused(bench: Bench) -> None:
    assert bench.ask("sample", bench.gripper.uuid, 1, code=8)["error"]["code"] == "bad-data"
    assert bench.ask("sample", bench.gripper.uuid, 9, code=8)["error"]["code"] == "bad-data"


def test_a_measurement_ends_with_its_counts_and_every_file_says_the_same(bench: Bench, tmp_path: Path) -> None:
    tries = iter(range(5))
    best_of(
        5,
        0.1,
        lambda: counted(bench, tmp_path / str(next(tries))),
        because="a clock is known as well as its best exchange was quick",
    )


def counted(bench: Bench, folder: Path) -> float:
    """Return the largest bound of a clock: a machine that stands still in each exchange knows it badly."""
    folder.mkdir()
    files = [folder / f"run.{suffix}" for suffix in ("csv", "jsonl", "mcap")]
    targets = [word for file in files for word in ("--to", file)]
    lines = bench.measure(bench.angle.uuid, bench.gripper.uuid, "--rate", 100, "--duration", 2, *targets)
    end = lines[-1]
    assert end["event"] == "end"
    assert [node["uuid"] for node in end["nodes"]] == [bench.angle.uuid, bench.gripper.uuid]
    assert end["files"] == [str(file) for file in files]
    for node in end["nodes"]:
        for stream in node["streams"]:
            assert stream["period"] == 0.01
            # two seconds from the first sample on, to the last instant: two of them are a message
            missing = 2 * (stream["lost"] + stream["late"])
            assert stream["samples"] >= (200 - missing) * len(stream["channels"]), stream
            assert (stream["bad"], stream["invalid"]) == (0, 0)
    angles = data(lines)
    values = [value for line in angles for value in line["value"]]
    times = [instant for line in angles for instant in line["time"]]
    raws = [raw for line in angles for raw in line["raw"]]
    assert times == sorted(times)
    assert all(b == pytest.approx(a * 6.281440 / 65535, abs=1e-4) for a, b in zip(raws, values, strict=True))
    assert all(line["unit"] == "rad" and line["uncertainty"] for line in angles)
    running = [line for line in lines if line["event"] == "status" and line["state"] == "running"]
    assert {line["uuid"] for line in running} == {bench.angle.uuid, bench.gripper.uuid}
    text = [line for line in files[0].read_text().splitlines() if not line.startswith("#")]
    rows = [row for row in csv.DictReader(text) if row["uuid"] == bench.angle.uuid]
    assert [int(row["a/angle raw"]) for row in rows] == raws
    recorded = [json.loads(line) for line in files[1].read_text().splitlines()]
    assert [raw for line in data(recorded) if line["uuid"] == bench.angle.uuid for raw in line["raw"]] == raws
    with files[2].open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert topics.count("/bench/a/stream_0") == len(raws)
    return max(stream["clock_error"] for node in end["nodes"] for stream in node["streams"])


def test_a_group_is_measured_by_name_begins_together_and_is_frozen_meanwhile(bench: Bench) -> None:
    made = bench.station.ask("group", "create", "crane", bench.angle.uuid, bench.gripper.uuid)
    assert made["groups"] == [{"name": "crane", "uuids": sorted([bench.angle.uuid, bench.gripper.uuid])}]

    def apart() -> float:
        """By how much the two began apart, in seconds; a machine that is busy hands a trigger on late."""
        running = bench.station.start("--json", "measure", "crane", "--rate", 50, "--trigger", *bench.can)
        for uuid in (bench.angle.uuid, bench.gripper.uuid):
            running.wait_for(f'"event":"data","uuid":"{uuid}"')
        refused = bench.station.refuses("group", "remove", "crane", bench.angle.uuid, code=6)
        assert "measured" in refused["message"]
        running.signal(signal.SIGTERM)
        outcome = running.end()
        assert outcome.code == 0, outcome.err
        lines = [json.loads(line) for line in outcome.out.splitlines()]
        firsts = [next(line for line in lines if line["event"] == "data" and line["uuid"] == uuid)
                  for uuid in (bench.angle.uuid, bench.gripper.uuid)]  # fmt: skip
        zeros = [line["time"][0] - line["index"] / 50 for line in firsts]
        return float(max(lines[-1]["began_apart"], abs(zeros[0] - zeros[1])))

    best_of(5, 0.05, apart, because="50 ms hold a trigger's way through two processes")
    assert bench.station.ask("group", "remove", "crane", bench.angle.uuid)["groups"][0]["uuids"] == [bench.gripper.uuid]
    assert bench.station.ask("group", "delete", "crane")["groups"] == []


def test_names_of_groups(bench: Bench) -> None:
    bench.station.refuses("group", "create", "8d4d", bench.angle.uuid, code=2)
    bench.station.refuses("group", "add", "nothing", bench.angle.uuid, code=3)
    assert bench.station.ask("group", "list") == {"groups": []}


def test_a_test_pattern_is_checked_and_never_a_measurement(bench: Bench) -> None:
    file = bench.desk.folder / "pattern.csv"
    lines = bench.measure(bench.angle.uuid, "--rate", 100, "--duration", 1, "--test-pattern", "--to", file)
    assert data(lines)
    for line in data(lines):
        assert line["test_pattern"] is True
        assert set(line["value"]) == {None}
        assert line["raw"] == [(line["index"] + k + 1) % 65536 for k in range(len(line["raw"]))]
    assert lines[-1]["nodes"][0]["streams"][0]["bad"] == 0
    rows = list(csv.DictReader(line for line in file.read_text().splitlines() if not line.startswith("#")))
    assert {row["note"] for row in rows} == {"test pattern"}


def test_a_rate_that_the_datasheet_does_not_give_is_6_with_the_fastest(bench: Bench) -> None:
    *_, end = bench.measure(bench.angle.uuid, "--rate", 20000, "--duration", 1, code=6)
    assert "10000" in end["error"]["hint"]
    assert end["event"] == "end"


def test_a_node_that_restarts_is_carried_on_with(bench: Bench) -> None:
    running = bench.station.start("--json", "measure", bench.gripper.uuid, "--rate", 20, *bench.can)
    running.wait_for('"event":"data"')
    bench.gripper.kill()
    bench.power(bench.gripper)
    before = running.out.count('"event":"data"')
    running.wait_for('"state":"lost"')
    until(
        lambda: (
            running.read(0.1),
            running.out.count('"state":"running"') > 1 and running.out.count('"event":"data"') >= before + 5,
        )[1],
        lambda: running.out[-2000:],
    )
    running.signal(signal.SIGINT)
    outcome = running.end()
    assert outcome.code == 0, outcome
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    times = [instant for line in data(lines, 2) for instant in line["time"]]
    assert times == sorted(times), "also over a restart"


@pytest.mark.nightly(
    "tests/measure/test_carried_on.py::test_a_group_that_was_killed_is_carried_on_by_the_same_command, "
    "tests/measure/recordings/test_record_command.py::"
    "test_a_recorder_that_is_killed_in_the_middle_leaves_what_info_and_convert_read"
)
def test_a_killed_measurement_leaves_a_recording_and_a_node_that_can_be_measured_again(bench: Bench) -> None:
    file = bench.desk.folder / "killed.mcap"
    running = bench.station.start("--json", "measure", bench.gripper.uuid, "--rate", 100, "--to", file, *bench.can)
    running.wait_for('"index":100')
    running.process.kill()
    running.end()
    done = bench.station.ask("measure", "recover", file)
    assert done["recovered"]["messages"] >= 50
    assert recover(file).was_whole
    lines = bench.measure(bench.gripper.uuid, "--rate", 100, "--duration", 1)
    assert data(lines, 2)


def test_set_applies_within_the_limits_and_ends_safe(bench: Bench) -> None:
    words = ["--unit", "mm", "--hold", 0.5, *LONG]
    outcome = bench.station.run("--json", "set", bench.gripper.uuid, 1, 55, *words, *bench.can)
    assert outcome.code == 0, outcome
    applied, end = [json.loads(line) for line in outcome.out.splitlines()]
    assert applied["applied"]["channel"] == 1
    assert applied["applied"]["value"] == pytest.approx(55, abs=0.05)
    assert applied["applied"]["unit"] == "mm"
    assert applied["applied"]["raw"] == pytest.approx(2048, abs=2)
    assert end == {"event": "end", "safe": True}
    assert bench.gripper.process is not None
    bench.gripper.process.wait_for('"safe": true')


@pytest.mark.parametrize(
    ("words", "code"), [((1, 0.5), 6), ((1, 5, "--unit", "N"), 8), ((2, 0.01), 8), ((1, "nan"), 2)]
)
def test_set_refuses_what_the_datasheet_does_not_allow(bench: Bench, words: tuple[Any, ...], code: int) -> None:
    assert "error" in bench.ask("set", bench.gripper.uuid, *words, "--hold", 0.1, code=code)
    state = bench.ask("mode", bench.gripper.uuid)["channels"][0]["state"]
    assert "claimed here" not in state
    assert "safe" in state


def test_a_dead_station_leaves_a_safe_actuator(bench: Bench) -> None:
    words = ["--json", "set", bench.gripper.uuid, 1, 0.05, "--dead-man", 300, *bench.can]
    running = bench.station.start(*words)
    running.wait_for('"applied"')
    assert bench.gripper.process is not None
    running.process.kill()
    killed = time.monotonic()
    running.end()
    # its newest word: on a machine that is busy it may have been safe for a moment before, as no value came in time
    while not bench.gripper.process.out.rpartition('"safe": ')[2].startswith("true"):
        assert time.monotonic() < killed + 30  # how soon: test_actuator_safety.py
        bench.gripper.process.read(0.1)


def test_mode_shows_who_claims_what(bench: Bench) -> None:
    running = bench.station.start("--json", "measure", bench.gripper.uuid, "--rate", 20, *bench.can)
    running.wait_for('"event":"data"')
    other = [word + "&source=0xF2" if "udp_multicast" in word else word for word in bench.can]
    reply = bench.station.ask("mode", bench.gripper.uuid, *other)
    assert reply["mode"] == "measurement"
    by_channel = {channel["channel"]: channel for channel in reply["channels"]}
    assert "claimed by other" in by_channel[2]["state"]
    assert by_channel[2]["claimant"] == 0xF1
    running.signal(signal.SIGTERM)
    assert running.end().code == 0
    assert bench.ask("mode", bench.gripper.uuid)["mode"] == "configuration"


def test_a_node_that_is_not_there_is_5_after_the_time_allowed(bench: Bench, tmp_path: Path) -> None:
    bench.angle.kill()
    try:
        *_, end = bench.measure(bench.angle.uuid, "--duration", 1, "--timeout", 2, code=5)
    finally:
        bench.power(bench.angle)
    assert end["event"] == "end"
    assert end["error"]["code"] == "no-node"


BY_START_TIME = pytest.param(
    [],
    id="start time",
    marks=pytest.mark.nightly(
        "tests/measure/test_measuring.py::test_a_node_that_never_came_is_5_at_the_end_of_the_others[trigger]; "
        "tests/measure/test_lookout.py::test_nodes_that_are_there_in_time_begin_at_one_moment_and_a_late_one_when_it_comes"
    ),
)


@pytest.mark.parametrize("words", [BY_START_TIME, pytest.param(["--trigger"], id="trigger")])
def test_a_node_that_never_came_is_5_at_the_end_of_the_others(bench: Bench, words: list[str]) -> None:
    """It was 0: nothing said that one of two was not in the file."""
    bench.gripper.kill()
    outcome = bench.station.run(
        "--json", "measure", bench.angle.uuid, bench.gripper.uuid, "--duration", 1, *words, *bench.can
    )
    assert outcome.code == 5, outcome
    *_, end = [json.loads(line) for line in outcome.out.splitlines()]
    there, away = end["nodes"]
    assert there["streams"][0]["samples"] > 0
    assert "error" not in there
    assert "did not answer before the measurement ended" in away["error"]["message"]
    assert ("before the trigger" in outcome.err) == bool(words)


def test_what_a_task_requires_is_judged_before_anything_is_measured(bench: Bench, tmp_path: Path) -> None:
    file = tmp_path / "task.toml"
    file.write_text('[angle]\nrange = ">= 720 deg"\n')
    lines = bench.measure(bench.angle.uuid, "--duration", 1, "--require", file, code=6)
    refusal = lines[-1]
    assert refusal["fits"][0]["uuid"] == bench.angle.uuid
    assert "360" in refusal["fits"][0]["why"]
    assert refusal["error"]["code"] == "refused"
    assert not data(lines)


def test_measuring_over_nfc_says_what_to_do(station_home: Station) -> None:
    refused = station_home.refuses("measure", "8d4d9da65281f7000000", code=2)
    assert "sample" in refused["hint"]


@pytest.fixture
def station_home(bench: Bench) -> Station:
    return bench.station
