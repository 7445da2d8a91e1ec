"""An angle sensor whose zero was adjusted: every angle of the turn is measured; what is not valid says why."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from tests.e2e.desk import ANGLE
from tests.measure import rig as rigs
from tests.measure.rig import Rig

pytestmark = pytest.mark.link


def rig_with(folder: Path, monkeypatch: pytest.MonkeyPatch, calibration: str) -> Rig:
    monkeypatch.setitem(rigs.CALIBRATIONS, ANGLE, calibration)
    return Rig(folder / "rig", {"a": ANGLE})


def values_of(path: Path) -> list[str]:
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return [row[5] for row in list(csv.reader(lines))[1:]]


def test_a_zero_offset_of_90_degrees_loses_no_angle(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = rig_with(tmp_path, monkeypatch, "# zero-offset: 90\nraw,value [degree]\n0,0\n65536,360\n")
    try:
        rig.nodes["a"].start()  # a ramp over the whole turn every 2 s
        run = tmp_path / "run.csv"
        end = rig.measure("a", "--rate", 100, "--duration", 2.5, "--to", run, "--unit", "shown")[-1]
        assert end["unit"] == "shown"
        assert "angle [°]" in run.read_text()
        (stream,) = end["nodes"][0]["streams"]
        assert (stream["invalid"], stream["invalid_why"]) == (0, [])
        values = [float(text) for text in values_of(run)]
        assert len(values) == stream["samples"] > 200
        sixteenth = 360 / 16  # 125 ms of the ramp: a machine that is held up for less leaves none out
        assert {int(value / sixteenth) for value in values} == set(range(16))
        assert "invalid 0" in run.read_text().splitlines()[-1]
        (sampled,) = rig.ask("sample", "a")["samples"]
        assert sampled["valid"]
    finally:
        rig.close()


def test_what_is_not_valid_is_counted_in_every_summary_and_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = rig_with(tmp_path, monkeypatch, "# high-limit: 180\nraw,value [degree]\n0,0\n65535,359.9\n")
    try:
        rig.nodes["a"].start("--source", "ramp:1")
        run, lines = tmp_path / "run.csv", tmp_path / "run.jsonl"
        summary = rig.measure("a", "--rate", 100, "--duration", 2, "--to", run, "--to", lines)
        (stream,) = summary[-1]["nodes"][0]["streams"]
        limit = "above its high limit, 180 °"
        assert stream["invalid_why"] == [{"channel": 1, "why": limit, "count": stream["invalid"]}]
        assert stream["invalid"] == sum(text == "" for text in values_of(run)) > 10
        footer = run.read_text().splitlines()[-1]
        assert f"invalid {stream['invalid']} ({stream['invalid']} of channel 1: {limit})" in footer
        last = [json.loads(line) for line in lines.read_text().splitlines()][-1]
        assert (last["event"], last["invalid"]) == ("status", stream["invalid"])
        assert last["invalid_why"] == stream["invalid_why"]
        person = rig.station.run("measure", "a", "--rate", 100, "--duration", 1, "--can", rig.can)
        assert f"of channel 1: {limit}" in person.out + person.err
    finally:
        rig.close()
