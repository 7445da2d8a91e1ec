"""The ESP32 port, its Arduino sketch and what package managers read, over stand-ins for ESP-IDF and Arduino."""

from __future__ import annotations

import json
import os
import signal
import subprocess
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import pytest

from tests.bench import make_station
from tests.e2e.desk import ANGLE, Desk, Station
from tests.firmware import builds
from tests.firmware.test_packaging import run, version
from tests.pace import until

pytestmark = pytest.mark.system

STANDIN = builds.FIRMWARE / "port/esp32/standin"
LABEL = "against stand-ins only"


@pytest.fixture
def desk(tmp_path: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Desk]:
    folder = tmp_path_factory.mktemp("stations")
    make_station(folder / "bench", "bench").close()
    desk = Desk(tmp_path, folder)
    yield desk
    desk.clear()


def test_the_arduino_sketch_is_provisioned_comes_back_and_survives_a_bus_off(desk: Desk) -> None:
    """The sketch, the port and the library as they are; below them the stand-in."""
    builds.need("make", "gcc", "g++")
    builds.make("esp32")
    around = os.environ | {"TEDS_FLASH": str(desk.folder / "flash.bin"), "TEDS_CAN": desk.links.can}
    program = (str(builds.BUILD / "boards" / "angle_sensor"),)

    def power_on() -> int:
        running = desk.start(program=program, fork=False, cwd=desk.folder, environment=around)
        assert running.wait_for_lines(1)[0]["ready"]
        return running.process.pid

    board = power_on()
    station: Station = desk.station()
    done = station.provision("can", "--profile", ANGLE)
    over = desk.links.over("can")
    assert done["verdict"] == "authentic"
    assert {step["name"]: step["result"] for step in done["steps"]}["check"] == "done", "the hardware bears it"
    shown = station.ask("sample", done["uuid"], *over)["samples"][0]
    assert 0 < shown["raw"] < 4096, "of the sensor; without a calibration it has no value"
    os.kill(board, signal.SIGUSR2)  # the controller is off the bus; the node keeps silent for a second
    until(lambda: station.ask("identify", *over)["state"] == "provisioned")
    os.kill(board, signal.SIGKILL)
    power_on()
    assert station.ask("verify", done["uuid"], *over)["verdict"] == "authentic"


def test_the_arduino_library_compiles_as_arduino_compiles_it(tmp_path: Path) -> None:
    """Each source below src/ with src/ as the only folder of headers, beside those of the core."""
    builds.need("make", "gcc", "g++")
    builds.make("arduino")
    library = builds.BUILD / "arduino/TedsNode"
    properties = dict(
        line.split("=", 1) for line in (library / "library.properties").read_text().splitlines() if "=" in line
    )
    assert properties["version"] == version()
    assert LABEL in properties["paragraph"]
    sources = sorted((library / "src").rglob("*.c"))
    assert (library / "src" / properties["includes"]).exists()
    where = [f"-I{library / 'src'}", f"-I{STANDIN}"]
    run("gcc", "-std=gnu11", "-w", "-DESP_PLATFORM", *where, "-fsyntax-only", *map(str, sources))
    (sketch,) = (library / "examples").rglob("*.ino")
    head = ["g++", "-std=gnu++17", "-Wall", "-DESP_PLATFORM", *where, "-include", "Arduino.h", "-fsyntax-only"]
    run(*head, "-xc++", str(sketch))


def test_platformio_finds_what_its_manifest_names() -> None:
    manifest = json.loads((builds.FIRMWARE / "library.json").read_text())
    assert manifest["version"] == version()
    assert all((builds.FIRMWARE / "include" / header).exists() for header in manifest["headers"])
    taken = [entry[2:-1] for entry in manifest["build"]["srcFilter"] if entry.startswith("+<")]
    for pattern in taken:
        assert list(builds.FIRMWARE.glob(pattern)), pattern
    for name in manifest["export"]["include"]:
        assert (builds.FIRMWARE / name).exists(), name
    where = [f"-I{builds.FIRMWARE / flag[2:]}" for flag in manifest["build"]["flags"]]
    sources = [str(path) for pattern in taken for path in builds.FIRMWARE.glob(pattern)]
    run("gcc", "-std=gnu11", "-fsyntax-only", *where, *sources)


def test_esp_idf_gets_a_component_whose_files_are_there(tmp_path: Path) -> None:
    """CMake runs component.cmake; ESP-IDF's function is a stand-in that prints what it is given."""
    builds.need("cmake", headers=())
    text = (builds.FIRMWARE / "idf_component.yml").read_text()
    assert f'version: "{version()}"' in text
    assert LABEL in text
    source = tmp_path / "bearssl"
    names = [line for line in (builds.FIRMWARE / "port/bearssl/sources.txt").read_text().splitlines() if line[0] != "#"]
    for name in ["inc/bearssl.h", *names]:
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).touch()
    script = tmp_path / "idf.cmake"
    script.write_text(
        "set(ESP_PLATFORM 1)\n"
        "function(idf_component_register)\n"
        '  cmake_parse_arguments(A "" "" "SRCS;INCLUDE_DIRS;PRIV_INCLUDE_DIRS;REQUIRES" ${ARGN})\n'
        "  foreach(path ${A_SRCS} ${A_INCLUDE_DIRS} ${A_PRIV_INCLUDE_DIRS})\n"
        "    message(NOTICE ${path})\n  endforeach()\n"
        "endfunction()\n"
        "function(target_compile_definitions)\nendfunction()\nfunction(set_source_files_properties)\nendfunction()\n"
        f"include({builds.FIRMWARE}/CMakeLists.txt)\n"
    )
    around = os.environ | {"TEDS_BEARSSL_DIR": str(source)}
    done = subprocess.run(["cmake", "-P", str(script)], capture_output=True, text=True, check=False, env=around)
    assert done.returncode == 0, done.stderr
    paths = [Path(line) for line in done.stderr.split()]
    assert len([path for path in paths if path.suffix == ".c"]) > 60
    assert [path for path in paths if not path.exists()] == []
    lost = subprocess.run(
        ["cmake", "-P", str(script)],
        capture_output=True,
        text=True,
        check=False,
        env=around | {"TEDS_BEARSSL_DIR": "/no"},
    )
    assert "Set TEDS_BEARSSL_DIR in the environment" in lost.stderr


def test_each_partition_is_of_whole_sectors_and_none_reaches_into_another() -> None:
    lines = (builds.FIRMWARE / "port/esp32/partitions.csv").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split(",")] for line in lines if not line.startswith("#")]
    ours = {row[0]: (int(row[3], 16), int(row[4], 16)) for row in rows}
    places = sorted(ours.values())
    assert all(at + octets <= more for (at, octets), (more, _) in pairwise(places))
    for name in ("teds_identity", "teds_slot_a", "teds_slot_b"):
        at, octets = ours[name]
        assert at % 0x1000 == octets % 0x1000 == 0
    assert min(ours["teds_slot_a"][1], ours["teds_slot_b"][1]) >= 4096 + 256
