"""Files in display units (`--unit shown`): what people read in them, and that whatever reads them has SI again."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from teds_provision.measure.blocks import Block, GroupRows
from teds_provision.measure.display_units import UnitConversion, in_display_units, in_si_units
from teds_provision.measure.recordings.converting import convert
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.running.measurement_job import whole_path
from teds_provision.measure.sinks import in_units, open_sink
from teds_provision.teds.units import parse_units
from tests.measure.sinks.parts import ANGLE, ARM, HAND, OIL, STATION, block, fill

TURNED = replace(ANGLE, units=parse_units("rad"), shown_unit="degree", low=0.0, high=math.tau, uncertainty=0.01)
WARM = replace(OIL, unit="K", units=parse_units("K"), shown_unit="degC", low=233.15, high=398.15, uncertainty=0.5)
FACTS = (TURNED, WARM)
RADIANS, KELVINS = [0.0, 1.5, math.pi, 6.0], [250.0, 273.15, 300.0, 350.0]


def items() -> list[Any]:
    raw = [[number] for number in range(4)]
    angle = replace(block(raw), value=np.array([[value] for value in RADIANS]))
    warm = block(raw, uuid=WARM.uuid, channels=(WARM.number,))
    return [angle, replace(warm, value=np.array([[value] for value in KELVINS]))]


def recorded(path: Path, units: str = "shown") -> Path:
    sink = open_sink(in_units(str(path), units))  # type: ignore[arg-type]
    sink.open(FACTS, STATION)
    fill(sink, items())
    return path


def values(path: Path) -> dict[tuple[str, int], list[float]]:
    found: dict[tuple[str, int], list[float]] = {}
    for entry in open_recording(path).entries():
        if isinstance(entry, Block | GroupRows):
            for key, column in zip(entry.keys, entry.value.T.tolist(), strict=True):
                found.setdefault(key, []).extend(value for value in column if math.isfinite(value))
    return found


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".jsonl", ".parquet"])
def test_a_file_holds_what_people_read_and_its_readers_have_si_again(tmp_path: Path, suffix: str) -> None:
    import pandas as pd

    path = tmp_path / f"run{suffix}"
    if suffix == ".parquet":
        convert(recorded(tmp_path / "run.mcap"), path, units="shown")
        frame = pd.read_parquet(path)
    else:
        recorded(path)
        separator = "," if suffix == ".csv" else "\t"
        frame = None if suffix == ".jsonl" else pd.read_csv(path, comment="#", sep=separator)
    if frame is not None:
        (angle,) = [name for name in frame.columns if "[°]" in name]
        (warm,) = [name for name in frame.columns if "[°C]" in name]
        assert frame[angle].dropna().tolist() == pytest.approx([math.degrees(value) for value in RADIANS])
        assert frame[warm].dropna().tolist() == pytest.approx([value - 273.15 for value in KELVINS])
    else:
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        assert lines[0]["units"] == "shown"
        data = [line for line in lines if line["event"] == "data" and line["uuid"] == ARM]
        assert data[0]["unit"] == "°"
        assert data[0]["value"][1] == pytest.approx(math.degrees(1.5))
        assert data[0]["uncertainty"] == pytest.approx(math.degrees(0.01))
    if suffix in (".csv", ".txt"):
        assert "# units: as shown to people" in path.read_text()
    back = values(path)
    assert back[TURNED.key] == pytest.approx(RADIANS)
    assert back[WARM.key] == pytest.approx(KELVINS)
    facts = open_recording(path).facts
    assert (facts[TURNED.key].unit, facts[TURNED.key].si_unit) == ("rad", "")
    assert facts[TURNED.key].high == pytest.approx(math.tau)
    assert facts[TURNED.key].full_turn
    assert (facts[WARM.key].low, facts[WARM.key].uncertainty) == pytest.approx((233.15, 0.5))


def test_an_uncertainty_is_a_difference_and_has_no_offset(tmp_path: Path) -> None:
    """0.5 K is 0.5 degrees Celsius, not -272.65."""
    facts = replace(WARM, deviation=0.25)
    shown = in_display_units(facts)
    assert (shown.unit, shown.low, shown.high) == ("°C", pytest.approx(-40.0), pytest.approx(125.0))
    assert (shown.uncertainty, shown.deviation) == (pytest.approx(0.5), pytest.approx(0.25))
    back = in_si_units(shown)
    assert (back.low, back.uncertainty, back.deviation) == pytest.approx((233.15, 0.5, 0.25))
    turned = in_display_units(TURNED)
    assert turned.uncertainty == pytest.approx(math.degrees(0.01))


def test_the_default_is_si_and_says_so_and_mcap_is_always_si(tmp_path: Path) -> None:
    plain = recorded(tmp_path / "run.csv", "si")
    assert "# units: SI\n" in plain.read_text()
    assert "[rad]" in plain.read_text()
    assert json.loads(recorded(tmp_path / "run.jsonl", "si").read_text().splitlines()[0])["units"] == "si"
    assert in_units("run.mcap", "shown") == "run.mcap"
    assert in_units("mqtt://host/x.csv", "shown") == "mqtt://host/x.csv"
    mcap = recorded(tmp_path / "run.mcap")
    assert open_recording(mcap).facts[TURNED.key].unit == "rad"
    assert values(mcap)[TURNED.key] == pytest.approx(RADIANS)


def test_a_conversion_goes_either_way_and_a_grid_too(tmp_path: Path) -> None:
    shown = recorded(tmp_path / "shown.csv")
    convert(shown, tmp_path / "si.csv")
    assert "# units: SI" in (tmp_path / "si.csv").read_text()
    assert values(tmp_path / "si.csv")[WARM.key] == pytest.approx(KELVINS)
    for name in ("wide.csv", "wide.parquet"):
        convert(shown, tmp_path / name, wide=True, units="shown")
        assert values(tmp_path / name)[TURNED.key] == pytest.approx(RADIANS)
    assert "[°C]" in (tmp_path / "wide.csv").read_text().splitlines()[6]


def test_a_file_without_the_line_of_units_is_in_si(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.csv", "si")
    path.write_text("".join(line for line in path.read_text().splitlines(keepends=True) if "# units" not in line))
    assert values(path)[TURNED.key] == pytest.approx(RADIANS)


def test_the_place_of_a_file_is_whole_behind_its_prefixes() -> None:
    assert whole_path("shown:run.csv") == f"shown:{Path('run.csv').absolute()}"
    assert whole_path("shown:wide:run.csv") == f"shown:wide:{Path('run.csv').absolute()}"
    assert whole_path("wide:run.csv") == f"wide:{Path('run.csv').absolute()}"


def test_facts_come_back_as_they_were_and_channels_in_si_stay() -> None:
    assert in_si_units(in_display_units(TURNED)) == replace(TURNED, high=pytest.approx(math.tau))
    force = replace(ANGLE, unit="N", units=parse_units("N"), shown_unit="")
    assert in_display_units(force) == force
    assert in_display_units(replace(force, units=None)) == replace(force, units=None)
    conversion = UnitConversion()
    conversion.facts([force])
    first = items()[0]
    assert conversion.convert(first) is first
    assert conversion.convert(replace(first, uuid=HAND)) is not None, "a channel that nothing describes stays as it is"


def test_limits_that_are_not_stated_stay_so_and_a_factor_alone_means_nothing() -> None:
    bare = replace(TURNED, low=None, high=None, uncertainty=None, deviation=None)
    shown = in_display_units(bare)
    assert (shown.low, shown.high, shown.uncertainty, shown.deviation, shown.unit) == (None, None, None, None, "°")
    assert in_si_units(shown) == bare
    odd = replace(TURNED, si_unit="", si_factor=2.0)
    assert in_si_units(odd) == odd
