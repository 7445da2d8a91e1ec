"""`calibrate capture` from running sensors, and a calibration that is made of nothing else."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.e2e.desk import ANGLE
from tests.measure import rig as rigs
from tests.measure.rig import Rig
from tests.measure.test_zero import Shaft

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(rigs.CALIBRATIONS, ANGLE, "# date: 2026-10-01\nraw,value [degree]\n0,0\n65536,360\n")
        rig = Rig(tmp_path_factory.mktemp("capture") / "rig", {"angle": ANGLE})
    try:
        yield rig
    finally:
        rig.close()


@pytest.fixture(scope="module")
def angle(rig: Rig) -> Shaft:
    return Shaft(rig, "angle").start()


def at(rig: Rig, degrees: float, file: Path, *, code: int = 0) -> dict[str, object]:
    words = ("calibrate", "capture", "angle", 1, "--reference", degrees, "--unit", "degree", "--to", file)
    return dict(rig.ask(*words, code=code))


def test_a_calibration_is_captured_fitted_and_written(rig: Rig, angle: Shaft, tmp_path: Path) -> None:
    file = tmp_path / "joint.csv"
    for raw, degrees in ((1000, 5.0), (30_000, 164.0), (65_000, 356.5)):
        angle.turn("angle", raw)
        done = at(rig, degrees, file)
        assert done["added"] == {
            "raw": raw,
            "mean": raw,
            "spread": 0,
            "count": 32,
            "reference": pytest.approx(degrees * 0.0174532925),
            "unit": "rad",
        }
    assert [point["value"] for point in done["points"]] == [5, 164, 356.5]  # type: ignore[attr-defined]
    reply = rig.station.ask("calibrate", "fit", file)
    assert (reply["method"], reply["rms"]) == ("table", pytest.approx(0, abs=1e-4))
    assert rig.station.ask("calibrate", "fit", file, "--profile", ANGLE)["channels"][0]["left_out"]["maximum"] < 1
    words = ("provision", "--calibration", file, "--profile", ANGLE, "--name", "angle", "--yes", "--via", "can")
    assert rig.ask(*words)["verdict"] == "authentic"
    angle.turn("angle", 30_000)
    assert rig.ask("sample", "angle")["samples"][0]["value"] == pytest.approx(164 * 0.0174532925, abs=1e-5)


def test_a_restless_sensor_and_one_at_the_wrap_of_its_raw_values_give_no_point(
    rig: Rig, angle: Shaft, tmp_path: Path
) -> None:
    file = tmp_path / "joint.csv"
    for far, message in ((5, "wrap of its raw values"), (4000, "not steady")):
        about = 0 if far == 5 else 20_000
        angle.turn("angle", about + far)  # before the capture begins, or it may begin with where the shaft was
        running = rig.station.start(
            *("--json", "calibrate", "capture", "angle", 1, "--reference", 0, "--to", file, "--can", rig.can)
        )
        with angle.file.open("a") as lines:
            for step in range(2000):
                lines.write(json.dumps({"raw": {"angle": (about + (far, -far)[step % 2]) % 65536}}) + "\n")
                lines.flush()
                time.sleep(0.003)
                if not running.runs:
                    break
        refused = running.end()
        assert refused.code == 6
        assert message in refused.json["error"]["message"]
    assert not file.exists()


@pytest.mark.nightly(
    "tests/measure/test_capture.py::test_a_calibration_is_captured_fitted_and_written; beside other measurements "
    "values come by tests/measure/test_carried_on.py::test_what_was_asked_beside_is_carried_on_too, "
    "tests/measure/test_carried_on.py::test_two_stations_on_one_bus_measure_one_node_side_by_side"
)
def test_points_are_captured_while_this_and_another_station_measure(rig: Rig, angle: Shaft, tmp_path: Path) -> None:
    angle.turn("angle", 30_000)
    other = rig.copy("other")
    watches = rig.begin("angle", "--rate", 50, can=f"{rig.can}&source=0xF4", station=other)
    mine = rig.begin("angle", "--rate", 50)
    for running in (watches, mine):
        running.wait_for('"event":"data"')
    for count in (1, 2):
        assert len(at(rig, 164, tmp_path / "x.csv")["points"]) == count  # type: ignore[arg-type]
    for running in (watches, mine):
        running.signal(2)
        assert rigs.ran(rigs.events(running.end().out)) == ["running", "ended"]


@pytest.mark.parametrize(
    ("words", "code"),
    [
        (["--reference", "inf", "--to", "x.csv"], 2),
        (["--reference", 1, "--unit", "kg", "--to", "x.csv"], 8),
        (["--reference", 1, "--to", "/nowhere/x.csv"], 3),
    ],
)
def test_what_is_no_point_is_refused(rig: Rig, angle: Shaft, words: list[object], code: int, tmp_path: Path) -> None:
    del angle
    given = [tmp_path / word if word == "x.csv" else word for word in words]
    assert "error" in rig.ask("calibrate", "capture", "angle", 1, *given, code=code)
    assert not (tmp_path / "x.csv").exists()


def test_two_at_once_into_one_file_lose_no_point(rig: Rig, angle: Shaft, tmp_path: Path) -> None:
    angle.turn("angle", 30_000)
    file = tmp_path / "both.csv"
    words = ("--json", "calibrate", "capture", "angle", 1, "--reference", 1, "--to", file, "--can", rig.can)
    both = [rig.station.start(*words) for _ in range(2)]
    assert [running.end().code for running in both] == [0, 0]
    assert file.read_text().count("1, 30000, ") == 2
