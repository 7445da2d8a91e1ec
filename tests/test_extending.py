"""docs/extending.md is followed word for word in a copy of the package: what comes out keeps the rules and works."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision.station.store.records import NodeRecord
from tests.bench import make_station
from tests.cli.shell import clean_environment

pytestmark = pytest.mark.slow
ROOT = Path(__file__).parent.parent
BLOCK = re.compile(
    r"^```python\n# (new: |after in |instead in |at the end of )([^\n:]+)(?:: ([^\n]*))?\n(.*?)^```$", re.M | re.S
)


def follow(page: str, folder: Path) -> list[str]:
    """Do what each block says; the files that were touched."""
    touched = []
    for how, name, line, text in BLOCK.findall(page):
        path = folder / name
        touched.append(name)
        if how == "new: ":
            path.parent.mkdir(exist_ok=True)
            path.write_text(f"{line}{text}")
            continue
        before = path.read_text()
        if how == "at the end of ":
            path.write_text(f"{before}\n\n{text}")
            continue
        assert before.count(f"{line}\n") == 1, f"{name} has no such line: {line}"
        path.write_text(before.replace(f"{line}\n", f"{line}\n{text}" if how == "after in " else text))
    return touched


@pytest.fixture(scope="module")
def copy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("house")
    for part in ("teds_provision", "tests", "scripts", "docs", "profiles"):
        shutil.copytree(ROOT / part, folder / part)  # what is compiled as well
    for part in ("include", "src"):  # the rules read the C library, too
        shutil.copytree(ROOT / "firmware" / part, folder / "firmware" / part)
    shutil.copy(ROOT / "firmware" / "README.md", folder / "firmware")
    for file in ("pyproject.toml", "Makefile"):
        shutil.copy(ROOT / file, folder)
    follow((ROOT / "docs" / "extending.md").read_text(), folder)
    return folder


def run(copy: Path, *words: object) -> subprocess.CompletedProcess[str]:
    """Run Python over the copy."""
    return subprocess.run(
        [sys.executable, *map(str, words)],
        cwd=copy,
        env=clean_environment(PYTHONPATH=str(copy)),
        capture_output=True,
        text=True,
        timeout=500,
        check=False,
    )


def test_every_block_of_the_page_is_an_example() -> None:
    page = (ROOT / "docs" / "extending.md").read_text()
    assert len(BLOCK.findall(page)) == page.count("```python") > 10


WHOLE = pytest.mark.nightly(
    "tests/test_extending.py::test_what_the_page_touches_keeps_the_arrows; these read every file once more, "
    "which costs ten times as much, for the few that the page touches"
)
OF_EACH_FILE = (
    "test_arrows_between_rooms_point_one_way",
    "test_protocol_and_teds_do_no_io",
    "test_nothing_above_the_station_gets_its_tables",
    "test_measure_and_ncap_know_a_link_by_its_capabilities_alone",
    "test_no_room_of_the_core_imports_an_optional_room",
)
OF_THE_TABLE = ("test_the_rooms_are_those_of_the_page", "test_no_arrow_of_the_table_makes_a_circle")


def test_what_the_page_touches_keeps_the_arrows(copy: Path) -> None:
    """The rules that look at a file by itself, for each file that the page touches; those of the table as they are."""
    page = (ROOT / "docs" / "extending.md").read_text()
    touched = sorted({str(copy / name) for _, name, *_ in BLOCK.findall(page)})
    code = f"""
from pathlib import Path
from tests import test_architecture as rules
for name in {OF_THE_TABLE!r}:
    getattr(rules, name)()
rules.MODULES = [path for path in rules.MODULES if str(path) in {touched!r}]
assert len(rules.MODULES) == {len(touched)}, rules.MODULES
for name in {OF_EACH_FILE!r}:
    getattr(rules, name)()
"""
    done = run(copy, "-c", code)
    assert done.returncode == 0, done.stderr[-3000:]


@WHOLE
@pytest.mark.parametrize("rules", ["architecture", "house"])
def test_what_comes_out_is_where_the_arrows_allow_it(copy: Path, rules: str) -> None:
    done = run(copy, "-m", "pytest", "-q", "-p", "no:cacheprovider", f"tests/test_{rules}.py")
    assert done.returncode == 0, done.stdout[-3000:]


def test_what_comes_out_is_written_as_all_code_is(copy: Path) -> None:
    page = (ROOT / "docs" / "extending.md").read_text()
    touched = sorted({name for _, name, *_ in BLOCK.findall(page)})
    done = run(copy, "-m", "ruff", "check", *touched)
    assert done.returncode == 0, done.stdout + done.stderr
    done = run(copy, "-m", "ruff", "format", "--check", *touched)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_command_the_link_and_the_check_are_there(copy: Path, tmp_path: Path) -> None:
    make_station(tmp_path / "home").close()
    program = ("-m", "teds_provision", "--home", tmp_path / "home", "--json")
    assert json.loads(run(copy, *program, "nameless").stdout) == {"uuids": []}
    assert "nameless" in run(copy, *program, "--help").stdout
    missing = run(copy, *program, "identify", "--via", "serial")
    assert (missing.returncode, json.loads(missing.stdout)["error"]["code"]) == (5, "no-reader")
    assert "serial-lines" in run(copy, *program, "doctor").stdout


def test_the_optional_room_adds_what_it_registers(copy: Path, tmp_path: Path) -> None:
    with make_station(tmp_path / "home") as station:
        station.nodes.put(NodeRecord(bytes(10), profile="load-cell"))
    program = ("-m", "teds_provision", "--home", tmp_path / "home", "--json")
    assert json.loads(run(copy, *program, "stock").stdout) == {"types": {"load-cell": 1}}
    assert json.loads(run(copy, *program, "nodes", "--count").stdout) == {"count": 1}
    assert len(json.loads(run(copy, *program, "nodes").stdout)["nodes"]) == 1
    assert "0 boards have no type." in run(copy, *program, "doctor").stdout
    assert "Count the boards of each type." in run(copy, *program, "--help").stdout
    shutil.move(copy / "teds_provision" / "stock", tmp_path / "stock")  # the same tree without it
    try:
        assert json.loads(run(copy, *program, "nodes", "--count").stdout)["error"]["code"] == "usage"
        assert "stock" not in run(copy, *program, "--help").stdout
        assert "boards have no type" not in run(copy, *program, "doctor").stdout
    finally:
        shutil.move(tmp_path / "stock", copy / "teds_provision" / "stock")


def test_the_sink_the_source_and_the_class_work(copy: Path, tmp_path: Path) -> None:
    code = f"""
from teds_provision.measure.sinks import open_sink
from teds_provision.node.sources import make_source
from teds_provision.teds import decode, compose
from tests.measure.sinks.parts import ANGLE, STATION, block, fill
sink = open_sink({str(tmp_path / "run.tsv")!r})
sink.open([ANGLE], STATION)
fill(sink, [block([[10], [20]])])
print(open(sink.files[0]).read().split()[3::4])
print(make_source("still", [], print).at(1, 0.0))
print(decode(compose(200, {{"BatchNo": 7}})).get("BatchNo"))
"""
    done = run(copy, "-c", code)
    assert done.stdout.splitlines() == ["['1', '2']", "None", "7"], done.stderr[-2000:]


MEASURED = """
import json, subprocess, sys, threading, time
from pathlib import Path
from teds_provision.links import open_place
from teds_provision.measure.blocks import SetPointCommand
from teds_provision.measure.buses import Buses
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.running.measurement import Watcher
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.station.store.records import KeptMeasurement
from teds_provision.station.store.records import NodeRecord
from tests.bench import make_station
from tests.measure.rig import provisioned

folder = Path(sys.argv[1])
station = make_station(folder / "home")
uuid = bytes.fromhex(provisioned(station, folder / "node", "gripper", "grip"))
words = [sys.executable, "-m", "tests.line_node", str(folder / "node")]
with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as node:
    try:
        port = open_place(f"line:127.0.0.1:{node.stdout.readline().strip()}")
        stop, driven = threading.Event(), threading.Event()
        kept = KeptMeasurement("", uuids=(uuid,), sinks=(str(folder / "run.jsonl"),), actuators=True)
        job = MeasurementJob(station, kept, request=MeasurementRequest(timeout=60.0))
        def drive(_block):  # set points until the node has moved by one, and then an end
            job.measurement.command(SetPointCommand(uuid.hex(), 1, 0.02, time.monotonic()))
        def hear():
            for line in node.stdout:
                if line.startswith("driven"):
                    stop.set()
        threading.Thread(target=hear, daemon=True).start()
        with Buses([port]) as buses:
            ended = job.run(buses, stop, watcher=Watcher(block=drive), duration=60.0)
        port.close()
    finally:
        node.terminate()
station.close()
rows = [json.loads(line) for line in (folder / "run.jsonl").read_text().splitlines()]
[report] = ended.nodes
print(json.dumps({
    "error": str(ended.error or ""),
    "driven": stop.is_set(),
    "values": sum("value" in row for row in rows) > 0,
    "bad": sum(stream["bad"] for stream in report["streams"]),
}))
"""


def test_a_third_link_that_streams_measures(copy: Path, tmp_path: Path) -> None:
    """No file of `measure` or `ncap` was touched for it."""
    page = (ROOT / "docs" / "extending.md").read_text()
    [links] = re.findall(r"^## A link that streams\n(.*?)^## ", page, re.M | re.S)
    assert {name.split("/")[1] for _, name, *_ in BLOCK.findall(links)} == {"links"}
    done = run(copy, "-c", MEASURED, tmp_path)
    assert done.returncode == 0, done.stderr[-3000:]
    assert json.loads(done.stdout) == {"error": "", "driven": True, "values": True, "bad": 0}
