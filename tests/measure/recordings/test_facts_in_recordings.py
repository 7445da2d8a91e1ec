"""Facts of channels come back from a recording as they went into it; of foreign ones only what has their form."""

from __future__ import annotations

import dataclasses
import fcntl
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import BadDataError
from teds_provision.measure.blocks import Block, ChannelFacts, GroupRows, NodeReport, Note
from teds_provision.measure.recordings import source
from teds_provision.measure.recordings.converting import convert
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.recordings.source import facts_of, first_instants, is_locked, station_of, unix_of
from teds_provision.measure.sinks import open_sink
from teds_provision.teds.units import parse_units
from tests.measure.recordings.test_converting import CURVE
from tests.measure.sinks.parts import ANGLE, ARM, HAND, STATION, block, fill

EVERYTHING = replace(
    ANGLE,
    node="5",
    name="null",
    kind="event",
    units=parse_units("rad"),
    overdue=True,
    unsigned=True,
    unverified=True,
    quantity="angle",
    deviation=0.002,
    own_period=1e-4,
    frame="{node}_tip",
    calibration=CURVE,
    wrapped="CAN message Torque (dbc)",
    vector=(1, 2, 3),
)


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".jsonl", ".mcap", ".parquet"])
def test_every_fact_of_a_channel_comes_back(tmp_path: Path, suffix: str) -> None:
    """A recording of a node that wraps a sensor could be written, but neither read nor converted."""
    unset = {"si_unit", "si_factor", "si_offset", "chosen", "siblings"}  # of files in display units, and of topics
    for field in dataclasses.fields(EVERYTHING):
        assert (getattr(EVERYTHING, field.name) == field.default) == (field.name in unset), field.name
    sink = open_sink(str(tmp_path / f"run{'.csv' if suffix == '.parquet' else suffix}"))
    sink.open((EVERYTHING,), STATION)
    fill(sink, [block()])
    if suffix == ".parquet":
        convert(tmp_path / "run.csv", tmp_path / "run.parquet")
    recording = open_recording(tmp_path / f"run{suffix}")
    assert recording.facts == {(ARM, 1): EVERYTHING}
    assert [entry for entry in recording.entries() if isinstance(entry, tuple) and entry] == [(EVERYTHING,)]


LONG = "x" * 1000


@pytest.mark.parametrize(
    ("words", "more"),
    [
        ({}, {}),
        ({"node": "arm", "name": LONG}, {"node": "arm", "name": LONG}),
        ({"unit": "rad"}, {"unit": "rad", "units": parse_units("rad")}),
        ({"unit": "///"}, {"unit": "///"}),
        ({"unit": ""}, {}),
        ({"low": 1, "high": -2.5}, {"low": 1.0, "high": -2.5}),
        ({"overdue": True, "unsigned": False}, {"overdue": True}),
        ({"vector": [0, 65535]}, {"vector": (0, 65535)}),
        ({"vector": [1] * 1000}, {"vector": (1,) * 1000}),
        ({"kind": "actuator"}, {"kind": "actuator"}),
        ({"colour": "red"}, {}),
    ],
)
def test_facts_of_another_program_are_taken_as_far_as_they_are_known(words: dict[str, Any], more: Any) -> None:
    found = facts_of({"uuid": "ab", "number": 1, **words}, "here")
    assert found == ChannelFacts(**{"uuid": "ab", "node": "", "number": 1, "name": "", **more})


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (None, "the facts of a channel are not a JSON object."),
        ([], "the facts of a channel are not a JSON object."),
        ({"uuid": "ab"}, "a channel has no UUID or no number."),
        ({"number": 1}, "a channel has no UUID or no number."),
        ({"uuid": None, "number": 1}, "uuid of a channel is None."),
        ({"uuid": "ab", "number": True}, "True is not a channel number."),
        ({"uuid": "ab", "number": 1.0}, "1.0 is not a channel number."),
        ({"uuid": "ab", "number": -1}, "-1 is not a channel number."),
        ({"uuid": "ab", "number": 65536}, "65536 is not a channel number."),
        ({"uuid": "ab", "number": "1" * 38}, f"'{'1' * 38}' is not a channel number."),
        ({"uuid": "ab", "number": "1" * 39}, f"'{'1' * 39}… is not a channel number."),
        ({"uuid": "ab", "number": 1, "name": LONG + "x"}, f"name of a channel is '{'x' * 39}…."),
        ({"uuid": "ab", "number": 1, "name": 5}, "name of a channel is 5."),
        ({"uuid": "ab", "number": 1, "low": "1"}, "low of a channel is '1'."),
        ({"uuid": "ab", "number": 1, "low": True}, "low of a channel is True."),
        ({"uuid": "ab", "number": 1, "period": float("inf")}, "period of a channel is not finite."),
        ({"uuid": "ab", "number": 1, "overdue": 1}, "overdue of a channel is 1."),
        ({"uuid": "ab", "number": 1, "kind": "thing"}, "kind of a channel is 'thing'."),
        ({"uuid": "ab", "number": 1, "kind": True}, "kind of a channel is True."),
        ({"uuid": "ab", "number": 1, "vector": "1"}, "vector of a channel is '1'."),
        ({"uuid": "ab", "number": 1, "vector": [1, 65536]}, "65536 is not a channel number."),
        (
            {"uuid": "ab", "number": 1, "vector": [1] * 1001},
            "vector of a channel is [1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, 1, ….",
        ),
        ({"uuid": "ab", "number": 1, "siblings": []}, "siblings of a channel is []."),
        ({"uuid": "ab", "number": 7, "calibration": []}, "the calibration of channel 7 cannot be read."),
    ],
)
def test_facts_of_the_wrong_kind_are_refused_with_their_place(words: Any, why: str) -> None:
    with pytest.raises(BadDataError) as refused:
        facts_of(words, "run.csv:7")
    assert refused.value.message == f"run.csv:7: {why}"


@pytest.mark.parametrize(
    ("words", "facts"),
    [
        ({}, ("", "", "", 0.0, False)),
        ({"station": None, "group": 7, "clock": "GPS", "started": "never", "test_pattern": "false"},
         ("", "7", "GPS", 0.0, False)),
        ({"station": "x" * 1001, "group": "y" * 1001, "clock": "z" * 1001, "test_pattern": True},
         ("x" * 1000, "y" * 1000, "z" * 1000, 0.0, True)),
        ({"station": "bench", "started": "2026-11-21T17:58:41Z", "test_pattern": "true"},
         ("bench", "", "", 1795283921.0, True)),
        ({"test_pattern": 1}, ("", "", "", 0.0, True)),
    ],
)  # fmt: skip
def test_the_head_of_a_recording_states_the_station(words: dict[str, Any], facts: tuple[Any, ...]) -> None:
    found = station_of(words)
    clock = facts[2] or type(found)("").clock
    assert (found.name, found.group, found.clock, found.started, found.test_pattern) == (*facts[:2], clock, *facts[3:])


def test_a_time_that_is_none_counts_as_unknown() -> None:
    assert unix_of("1970-01-01T00:00:01+00:00") == 1.0
    for text in ("", "unknown", None, 5, "0001-01-01T00:00:00+14:00x", "1970-13-01"):
        assert unix_of(text) == 0.0, text


def test_a_recording_is_locked_while_its_recorder_holds_it(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    assert is_locked(path) is False, "there is none"
    path.write_text("x")
    assert is_locked(path) is False
    held = os.open(path, os.O_RDWR)
    fcntl.flock(held, fcntl.LOCK_EX)
    assert is_locked(path) is True
    fcntl.flock(held, fcntl.LOCK_SH)
    assert is_locked(path) is False, "another reader"
    os.close(held)


def test_a_file_system_without_locks_has_no_recorder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_file: int, **_how: bool) -> None:
        raise OSError("no locks available")

    monkeypatch.setattr(source, "lock", refuse)
    (tmp_path / "run.csv").write_text("x")
    assert is_locked(tmp_path / "run.csv") is False


def test_the_first_instants_of_a_few_channels_are_taken_with_all_that_belongs_to_them() -> None:
    keys = ((ARM, 1), (HAND, 2), (HAND, 3))
    table = np.arange(12.0).reshape(4, 3)
    rows = GroupRows("crane", keys, np.arange(4.0), table, table / 10, test_pattern=True)
    found = first_instants(rows, {(HAND, 3), (ARM, 1), (ARM, 9)}, 2)
    assert isinstance(found, GroupRows)
    assert (found.group, found.channels, found.test_pattern) == ("crane", ((ARM, 1), (HAND, 3)), True)
    assert (found.time.tolist(), found.value.tolist()) == ([0.0, 1.0], [[0.0, 2.0], [3.0, 5.0]])
    np.testing.assert_allclose(found.age, [[0.0, 0.2], [0.3, 0.5]])
    part = block([[1, 2], [3, 4], [5, 6]], valid=[[True, False], [True, True], [True, True]], channels=(1, 4), index=7)
    second = first_instants(part, [(ARM, 4)], 2.9)
    assert isinstance(second, Block)
    assert (second.channels, second.index, second.raw.tolist()) == ((4,), 7, [[2], [4]])
    assert (second.time.tolist(), second.tick.tolist()) == (part.time[:2].tolist(), part.tick[:2].tolist())
    assert second.valid.tolist() == [[False], [True]]
    np.testing.assert_array_equal(second.value, [[np.nan], [0.4]])
    for whole in (part, rows):
        every = first_instants(whole, None, float("inf"))
        assert every is not None
        assert (every.channels, len(every.time)) == (whole.channels, len(whole.time))
    assert first_instants(part, [(HAND, 4)], 2) is None
    assert first_instants(rows, [], 2) is None
    for other in (Note(1.0, "x"), NodeReport(ARM, "lost"), (ANGLE,), ()):
        assert first_instants(other, None, 2) is None
