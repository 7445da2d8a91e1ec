"""Wrapped sensors in whole runs: a second process plays them on a bus, a third wraps them, a station measures."""

from __future__ import annotations

import base64
import hashlib
import json
import math
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bench import make_station
from tests.e2e.desk import ROOT, Desk, Running
from tests.ncap.service import Service
from tests.pace import until
from tests.places import free_bus

pytestmark = pytest.mark.link
BENCH = ROOT / "examples" / "bench"
DBC = BENCH / "torque.dbc"
TORQUE, SHAFT = 291, 0x18FEF121
GOOD, SPINNING = (TORQUE, "e803e02e41010000"), (SHAFT, "4038c8ffffffffff")


def group_and_port(bus: str) -> list[str]:
    return bus.removeprefix("udp_multicast:").split("?port=")


class Player:
    """The sensors: a process with python-can alone."""

    def __init__(self, bus: str) -> None:
        words = [sys.executable, str(Path(__file__).parents[1] / "node" / "sensor_player.py"), *group_and_port(bus)]
        self.process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        self.sent()

    def sent(self) -> int:
        assert self.process.stdout is not None
        return int(json.loads(self.process.stdout.readline())["sent"])

    def play(self, *frames: tuple[int, str], every: float = 0.02) -> int:
        """Send these from now on, again and again; the number of frames before."""
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"every": every, "frames": frames}) + "\n")
        self.process.stdin.flush()
        return self.sent()

    def close(self) -> None:
        self.process.kill()
        self.process.wait()


class WrappedBench:
    """Two wrapped nodes in one process, and the station that has signed the datasheet of both."""

    def __init__(self, folder: Path) -> None:
        make_station(folder / "bench", "bench").close()
        (folder / "desk").mkdir()
        self.desk = Desk(folder / "desk", folder, nodes="python")
        self.station = self.desk.station()
        self.bus = free_bus()
        self.can = ["--can", self.desk.links.can]
        self.dbc = folder / "torque.dbc"
        # values are late after 1.5 s, so that a machine that stands still for a moment makes none invalid
        self.dbc.write_text(DBC.read_text().replace("BO_ 291 10;", "BO_ 291 500;").replace("844926 20;", "844926 500;"))
        self.folders = {name: folder / name for name in ("Torque", "Shaft")}
        self.made = {name: self.create(name, path) for name, path in self.folders.items()}
        self.player = Player(self.bus)
        self.node = self.run()
        self.player.play(GOOD, SPINNING)
        for name, made in self.made.items():
            words = ["provision", made["uuid"], "--adopt", "--name", name.lower(), "--via", "can", *self.can, "--yes"]
            assert self.station.ask(*words)["verdict"] == "authentic"

    def create(self, name: str, path: Path) -> Any:
        uuid = self.desk.new_uuid().hex()
        return self.station.ask("node", "create", path, "--from", f"dbc:{self.dbc}", "--message", name, "--uuid", uuid)

    def run(self) -> Running:
        where = ["--source", f"dbc:{self.dbc}", "--bus", self.bus]
        node = self.desk.start("--json", "node", "run", *self.folders.values(), *self.can, *where)
        node.wait_for('"ready": true')
        return node

    def sample(self, name: str) -> dict[int, Any]:
        """Value of each channel."""
        return {channel["channel"]: channel["value"] for channel in self.ask("sample", name, "--via", "can")["samples"]}

    def ask(self, *words: object, code: int = 0) -> Any:
        return self.station.ask(*words, *self.can, code=code)

    def reasons(self, _: object = None) -> set[str]:
        """Why channels have been invalid so far."""
        return {line["reason"] for line in self.events("invalid")}

    def events(self, event: str) -> list[dict[str, Any]]:
        self.node.read(0.1)
        lines = [json.loads(line) for line in self.node.out.split("\n")[:-1]]
        return [line for line in lines if line.get("event") == event]


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[WrappedBench]:
    made = WrappedBench(tmp_path_factory.mktemp("wrapped"))
    yield made
    made.player.close()
    made.desk.clear()


def test_what_create_reports_comes_from_the_file(bench: WrappedBench) -> None:
    torque = bench.made["Torque"]
    assert torque["origin"]["kind"] == "dbc"
    assert torque["origin"]["name"] == "Torque"
    assert [(c["name"], c["unit"], c["low"], c["high"], c["period"]) for c in torque["channels"]] == [
        ("torque", "N·m", -200, 200, 0.5),
        ("speed", "rpm", 0, 12000, 0.5),
        ("temperature", "°C", -40, 120, 0.5),
        ("state", "", 0, 3, 0.5),
    ]
    assert torque["channels"][3]["choices"] == {"0": "starting", "1": "measuring", "2": "overload", "3": "fault"}


def test_values_that_a_second_process_sends_arrive_calibrated(bench: WrappedBench) -> None:
    bench.player.play(GOOD, SPINNING)
    outcome = bench.station.run("--json", "measure", "torque", *bench.can, "--duration", "3")
    assert outcome.code == 0, outcome
    lines = [json.loads(line) for line in outcome.out.splitlines()]
    last = {line["channel"]: line for line in lines if line.get("event") == "data"}
    assert last[1]["value"][-1] == pytest.approx(10.0)  # 1000 × 0.01 N·m
    assert last[2]["value"][-1] == pytest.approx(6000 * math.pi / 30)  # 12000 × 0.5 rpm
    assert last[3]["value"][-1] == pytest.approx(273.15 + 25)
    assert last[4]["value"][-1] == 1
    assert last[1]["raw"][-1] == 1000 + 32768


def test_the_other_node_of_the_process_reads_its_own_message(bench: WrappedBench) -> None:
    bench.player.play(GOOD, SPINNING)
    until(lambda: list(bench.sample("shaft").values()) == pytest.approx([1800 * math.pi / 30, 0.75]))


def test_a_sensor_that_is_silent_or_out_of_range_gives_no_value_and_says_why(bench: WrappedBench) -> None:
    bench.player.play((TORQUE, "214e701741010000"))  # 200.01 N·m
    until(lambda: "200.01 N·m is outside -200 to 200 N·m" in bench.reasons(bench.sample("torque")))
    sampled = bench.ask("sample", "torque", "--via", "can")["samples"]
    assert sampled[3]["text"] == "measuring"  # of the value table
    values = bench.sample("torque")
    assert (values[1], values[3]) == (None, pytest.approx(298.15))
    bench.player.play()
    until(lambda: set(bench.sample("torque").values()) == {None})
    assert "no frame for 1500 ms, 3 periods of 500 ms" in bench.reasons()
    bench.player.play(GOOD)
    until(lambda: None not in bench.sample("torque").values())
    until(lambda: {"torque", "speed"} <= {line["name"] for line in bench.events("valid")})


def test_origin_is_signed_and_cannot_be_written(bench: WrappedBench) -> None:
    flash = json.loads((bench.folders["Torque"] / "flash.json").read_text())["flash"]
    assert [0, 130] in [block[:2] for block in flash["blocks"]]
    assert flash["read_only"] == [[0, 130]]
    assert flash["provisioned"]
    seen = bench.ask("verify", "torque", "--via", "can")
    assert seen["verdict"] == "authentic"


def test_it_is_shown_as_wrapped_everywhere(bench: WrappedBench, tmp_path: Path) -> None:
    origin = bench.made["Torque"]["origin"]
    assert origin["sha256"] == hashlib.sha256(bench.dbc.read_bytes()).hexdigest()
    nodes = {node["uuid"]: node for node in bench.station.ask("nodes")["nodes"]}
    assert nodes[bench.made["Torque"]["uuid"]]["wrapped"] == origin
    assert "wrapped: Torque (dbc)" in bench.station.run("nodes").out
    assert "wrapped: Torque (dbc)" in bench.station.run("nodes", "torque").out
    bench.player.play(GOOD, SPINNING)
    files = [tmp_path / f"run.{kind}" for kind in ("csv", "jsonl", "mcap")]
    where = [word for file in files for word in ("--to", file)]
    assert bench.station.run("measure", "torque", *bench.can, "--duration", "2", *where).code == 0
    for file in files:
        assert b"CAN message Torque (dbc)" in file.read_bytes(), file
    image = tmp_path / "image.json"
    bench.ask("read", "torque", "--via", "can", "--output", image)
    assert "the node's proof ends at the wrapper, not at the sensor" in bench.station.run("show", image).out


def test_the_service_and_its_page_have_the_mark(bench: WrappedBench) -> None:
    service = Service(bench.desk, bench.station).start()
    try:
        asked = service.client()
        uuid, origin = bench.made["Torque"]["uuid"], bench.made["Torque"]["origin"]
        assert asked.request("GET", f"/nodes/{uuid}")["wrapped"] == origin
        assert {node["uuid"]: node["wrapped"] for node in asked.request("GET", "/nodes")["nodes"]}[uuid] == origin
    finally:
        service.end()


def test_what_does_not_go_together_is_refused(bench: WrappedBench, tmp_path: Path) -> None:
    run = ["node", "run", bench.folders["Torque"], *bench.can]
    for words, code in (
        ([*run], 2),  # noise from a node whose datasheet names a sensor
        ([*run, "--source", "sine:2"], 2),
        ([*run, "--source", f"dbc:{bench.dbc}"], 2),
        ([*run, "--source", f"canopen:{bench.dbc}", "--bus", bench.bus, "--node-id", 5], 2),
        ([*run, "--source", "noise", "--bus", bench.bus], 2),
        (["node", "create", tmp_path / "x", "--from", f"dbc:{bench.dbc}"], 2),
        (["node", "create", tmp_path / "x", "--from", f"dbc:{bench.dbc}", "--profile", "gripper"], 2),
        (["node", "create", tmp_path / "x", "--message", "Torque"], 2),
        (["profile", "new", "x", "--from", f"dbc:{bench.dbc}", "--message", "Torque", "--extends", "gripper"], 2),
    ):
        assert bench.station.refuses(*words, code=code)
    changed = tmp_path / "torque.dbc"
    changed.write_text(bench.dbc.read_text().replace("0.01,0", "0.02,0"))
    error = bench.station.refuses(*run, "--source", f"dbc:{changed}", "--bus", bench.bus, code=6)
    assert "not the file that the node was made from" in error["message"]


def test_a_type_is_made_from_the_same_file(bench: WrappedBench, tmp_path: Path) -> None:
    path = tmp_path / "torque.toml"
    made = bench.station.ask(
        "profile", "new", "torque", "--from", f"dbc:{bench.dbc}", "--message", "Torque", "-o", path
    )
    assert made["origin"] == bench.made["Torque"]["origin"]
    assert [channel["name"] for channel in made["channels"]] == ["torque", "speed", "temperature", "state"]
    assert bench.station.ask("profile", "check", path)["profiles"][0]["ok"]
    again = bench.ask("provision", "torque", "--profile", path, "--via", "can", "--yes", "--evidence")
    assert again["verdict"] == "authentic"  # the type is the node's: its calibration stays
    bench.station.ask("evidence", "export", tmp_path / "evidence")
    [file] = (tmp_path / "evidence").glob("*.json")
    statement = json.loads(base64.b64decode(json.loads(file.read_text())["payload"]))
    digest = bench.made["Torque"]["origin"]["sha256"]
    assert statement["predicate"]["facts"]["origin"] == f"kind=dbc\nname=Torque\nsha256={digest}\n"
