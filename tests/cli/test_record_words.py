"""``record info``, ``record show``, ``record convert``: what they print, asked of their own functions."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import measure
from teds_provision.cli.measure import record
from teds_provision.errors import NotFoundError
from teds_provision.measure.blocks import ChannelFacts

from .shell import call

UUID = "8d4d9da65281f7000000"


@pytest.mark.parametrize(
    ("target", "words", "unit"),
    [
        ("run.csv", (), "si"),
        ("run.csv", ("--unit", "shown"), "shown"),
        ("run.mcap", ("--unit", "shown"), "si"),
        ("RUN.MCAP", ("--unit", "shown"), "si"),
        ("run.mcap.csv", ("--unit", "shown"), "shown"),
    ],
)
@pytest.mark.parametrize(
    ("facts", "warning"),
    [
        ({"complete": True}, None),
        ({"complete": False}, "run.jsonl was cut off: the result ends at 2026-11-22T10:00:00.000Z."),
        ({"complete": False, "until": None}, "run.jsonl was cut off: the result holds no values."),
        (
            {"complete": False, "being_written": True},
            "run.jsonl is still being written: the result ends at 2026-11-22T10:00:00.000Z.",
        ),
        (
            {"complete": True, "being_written": True, "until": None},
            "run.jsonl is still being written: the result holds no values.",
        ),
    ],
)
def test_what_was_converted_is_reported_whole(
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    target: str,
    words: tuple[str, ...],
    unit: str,
    facts: dict[str, Any],
    warning: str | None,
) -> None:
    found = {"until": "2026-11-22T10:00:00.000Z", "being_written": False, "samples": 1, "messages": 2} | facts
    asked: list[Any] = []

    def convert(source: Path, target: Path, **how: Any) -> Any:
        asked.append((source, target, how))
        summary = SimpleNamespace(to_json=lambda _recording: dict(found))
        return SimpleNamespace(summary=summary, recording=None, files=[target, Path(f"{target}.2")])

    monkeypatch.setattr(measure.recordings.converting, "convert", convert)
    done = call(home, "--json", "record", "convert", "run.jsonl", target, "--wide", *words)
    assert done.json == {"files": [target, f"{target}.2"], "unit": unit, **found}
    assert done.err == ("" if warning is None else f"Warning: {warning}\n")
    units = words[1] if words else "si"
    assert asked == [(Path("run.jsonl"), Path(target), {"wide": True, "units": units})]
    people = call(home, "record", "convert", "run.jsonl", target, *words)
    assert people.out == f"{target}, {target}.2: 1 value at 2 time stamps\n"
    assert asked[-1][2]["wide"] is False


INFO: dict[str, Any] = {
    "file": "run.csv", "format": "CSV", "station": "bench", "group": None, "test_pattern": False,
    "from": "2026-11-22T10:00:00.000Z", "until": "2026-11-22T10:00:01.000Z", "lost": 1, "missing": 2, "messages": 1,
    "samples": 1, "invalid": 3, "being_written": False, "complete": True, "torn": 0, "channels": [], "notes": [],
}  # fmt: skip
COUNTS = "1 time stamp, 1 value, 3 invalid; lost: 1 message, missing: 2 samples"


@pytest.mark.parametrize(
    ("changes", "lines"),
    [
        ({}, ["run.csv: CSV, station bench", "From a until b", COUNTS]),
        ({"group": "crane"}, ["run.csv: CSV, station bench, group crane", "From a until b", COUNTS]),
        ({"station": None}, ["run.csv: CSV, station unknown", "From a until b", COUNTS]),
        (
            {"station": "", "from": None},
            ["run.csv: CSV, station unknown", "It contains no values.", COUNTS],
        ),
        (
            {"test_pattern": True, "lost": None},
            [
                "run.csv: CSV, station bench",
                "TEST PATTERN: these are not measurements.",
                "From a until b",
                COUNTS.replace("1 message", "not recorded"),
            ],
        ),
        (
            {"complete": False},
            ["run.csv: CSV, station bench", "From a until b", COUNTS, "It was cut off: no end was written."],
        ),
        (
            {"complete": False, "torn": 5},
            [
                "run.csv: CSV, station bench",
                "From a until b",
                COUNTS,
                "It was cut off: no end was written, and the last 5 octets are incomplete.",
            ],
        ),
        (
            {"complete": False, "torn": 5, "being_written": True},
            ["run.csv: CSV, station bench", "From a until b", COUNTS, "It is still being written."],
        ),
        (
            {"notes": [{"time": "2026-11-22T10:00:00.000Z", "why": "The datasheet changed."}]},
            ["run.csv: CSV, station bench", "From a until b", COUNTS, "  a The datasheet changed."],
        ),
    ],
)
def test_what_info_says_of_a_recording(
    monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], lines: list[str]
) -> None:
    moments = {INFO["from"]: "a", INFO["until"]: "b"}
    monkeypatch.setattr(record, "_local", moments.__getitem__)
    none: Any = None
    assert list(record._lines(INFO | changes, none, none)) == lines


def test_a_moment_of_a_foreign_recording_that_is_none_is_shown_as_it_is() -> None:
    assert record._local("when it was dark") == "when it was dark"


@pytest.mark.parametrize(
    ("value", "facts", "text"),
    [
        (math.nan, {}, "not valid"),
        (math.inf, {}, "not valid"),
        (-math.inf, {}, "not valid"),
        (0.0, {}, "0 N"),
        (2.5, {}, "2.5 N"),
        (2.5, {"unit": ""}, "2.5"),
    ],
)
def test_a_value_of_a_recording_that_is_no_number_is_not_valid(value: float, facts: dict[str, Any], text: str) -> None:
    assert record._value(value, ChannelFacts(UUID, "arm", 1, "force", **{"unit": "N"} | facts)) == text


@pytest.mark.parametrize(
    ("chosen", "error"),
    [
        ((1,), None),
        (("FORCE",), None),
        (("ganz groß",), None),
        (("GANZ GROSS", 1), None),
        ((), None),
        ((9,), ("run.csv has no channel 9.", "It has 1 (force), 2 (ganz groß), 3.")),
        (("palm", 1), ("run.csv has no channel 'palm'.", "It has 1 (force), 2 (ganz groß), 3.")),
    ],
)
def test_a_channel_is_chosen_by_its_number_or_name_in_any_case(
    chosen: tuple[int | str, ...], error: tuple[str, str] | None
) -> None:
    names = {1: "force", 2: "ganz groß", 3: ""}
    facts = {(UUID, number): ChannelFacts(UUID, "arm", number, name) for number, name in names.items()}
    summary: Any = SimpleNamespace(facts=facts)
    if error is None:
        record._require_known(Path("run.csv"), summary, chosen)
    else:
        with pytest.raises(NotFoundError) as unknown:
            record._require_known(Path("run.csv"), summary, chosen)
        assert (unknown.value.message, unknown.value.hint) == error
    record._require_known(Path("empty.csv"), SimpleNamespace(facts={}), chosen)  # type: ignore[arg-type]
