"""Every format becomes every other one, and what was measured is in all of them."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given, settings
from mcap.reader import make_reader

from teds_provision.errors import StoreError, TedsProvisionError, UsageError
from teds_provision.measure.blocks import Block, GroupRows, InvalidValues, NodeReport, Note
from teds_provision.measure.recordings import converting
from teds_provision.measure.recordings.converting import convert
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.recordings.summary import NOTES, RecordingSummary
from teds_provision.measure.sinks import open_sink
from teds_provision.teds.calibration.model import Calibration, CalibrationInput
from teds_provision.teds.units import parse_units, recognize
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, HAND, OIL, STATION, block, blocks, fill

FORMATS = (".csv", ".txt", ".jsonl", ".mcap", ".parquet")
CURVE = Calibration(
    1,
    "linear",
    (CalibrationInput(1, 1, (0.0, 65535.0), (0.0,)),),
    (0.5, 0.25),
    recognize(parse_units("rad"), 0.01, 0.0),
)
FACTS = (
    replace(ANGLE, units=parse_units("rad"), calibration=CURVE, frame="{node}_tip", deviation=0.002, own_period=1e-4),
    replace(FORCE, sample_form="unsigned integer, 4 octets, 24 bits"),
    replace(OIL, sample_form="Float32, 4 octets"),
)


def measured(n: int = 40) -> list[Any]:
    """Two nodes, one of them with two channels; an invalid value, a gap of three samples, an end."""
    items: list[Any] = []
    for k in range(0, n, 4):
        raw = [[k + row] for row in range(4)]
        index = k if k < n // 2 else k + 3
        items.append(block(raw, valid=[[True], [True], [k != 8], [True]], index=index))
        both = np.array([[k + row, 0.5 * (k + row)] for row in range(4)])
        items.append(block(both, uuid=HAND, channels=(2, 3), index=k))
    counts = {"samples": n, "lost": 1, "invalid": 1}
    items.append(NodeReport(ARM, "ended", **counts, time=1_795_000_100.0))
    return items


def recorded(path: Path, items: list[Any] | None = None) -> Path:
    sink = open_sink(str(path))
    sink.open(FACTS, STATION)
    fill(sink, measured() if items is None else items)
    return path


def convert_to(folder: Path, suffix: str, target: Path) -> None:
    """A recording in any format, Parquet too, which no recorder writes."""
    if suffix != ".parquet":
        recorded(target)
    else:
        convert(recorded(folder / "origin.mcap"), target)


def content(path: Path) -> dict[str, Any]:
    recording, summary = open_recording(path), RecordingSummary()
    for entry in recording.entries():
        summary.add_entry(entry)
    return summary.to_json(recording)


def values(path: Path) -> dict[tuple[str, int], list[tuple[float, Any, float]]]:
    """Time, raw and calibrated value of each channel, by time."""
    found: dict[tuple[str, int], list[tuple[float, Any, float]]] = {}
    for entry in open_recording(path).entries():
        if isinstance(entry, Block):
            for column, key in enumerate(entry.keys):
                pairs = zip(
                    entry.time.tolist(), entry.raw[:, column].tolist(), entry.value[:, column].tolist(), strict=True
                )
                found.setdefault(key, []).extend((round(t, 5), raw, value) for t, raw, value in pairs)
    return {key: sorted(index_, key=lambda pair: pair[0]) for key, index_ in found.items()}


@pytest.mark.parametrize("begin", [name for name in FORMATS if name != ".parquet"])
@pytest.mark.parametrize("end", FORMATS)
def test_a_recording_in_another_format_says_the_same(tmp_path: Path, begin: str, end: str) -> None:
    first = recorded(tmp_path / f"run{begin}")
    done = convert(first, tmp_path / f"other{end}")
    assert done.files == (tmp_path / f"other{end}",)
    again = convert(done.files[0], tmp_path / f"back{begin}")
    before = values(first)
    assert len(before[ARM, 1]) == 40
    for path in (*done.files, *again.files):
        after = values(path)
        assert after.keys() == before.keys()
        for key, expected in before.items():
            assert [pair[:2] for pair in after[key]] == [pair[:2] for pair in expected], (
                "times and raw values are exact"
            )
            np.testing.assert_allclose([pair[2] for pair in after[key]], [pair[2] for pair in expected], rtol=1e-11)
        facts, contents, origin = open_recording(path), content(path), content(first)
        assert facts.facts[ARM, 1] == FACTS[0], "every fact of the datasheet, its calibration too"
        assert (facts.station.name, facts.station.group) == ("bench", "crane")
        names = ("from", "until", "messages", "samples", "invalid", "lost", "missing", "complete")
        assert {name: contents[name] for name in names} == {name: origin[name] for name in names}
    assert (origin["invalid"], origin["lost"], origin["missing"]) == (1, 1, 3)


@given(blocks())
@settings(max_examples=25)
def test_any_block_survives_mcap_to_json_to_mcap(data_block: Block) -> None:
    with TemporaryDirectory() as folder:
        path = recorded(Path(folder) / "run.mcap", [data_block])
        convert(path, Path(folder) / "run.jsonl")
        convert(Path(folder) / "run.jsonl", Path(folder) / "again.mcap")
        first, last = values(path), values(Path(folder) / "again.mcap")
    assert first.keys() == last.keys()
    for key, expected in first.items():
        got = last[key]
        np.testing.assert_array_equal([pair[1] for pair in got], [pair[1] for pair in expected])
        np.testing.assert_array_equal([pair[2] for pair in got], [pair[2] for pair in expected])


def test_foreign_readers_take_what_was_converted(tmp_path: Path) -> None:
    import pandas as pd

    first = recorded(tmp_path / "run.csv")
    [mcap] = convert(first, tmp_path / "run.mcap").files
    with mcap.open("rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file).iter_messages()]
    assert topics.count("/bench/arm/stream_0") == 40
    [parquet] = convert(first, tmp_path / "run.parquet").files
    by_parquet, by_csv = pd.read_parquet(parquet), pd.read_csv(first, comment="#")
    assert len(by_parquet) == len(by_csv) == 80
    arm = by_parquet[by_parquet["uuid"] == ARM]
    assert arm["arm/angle [rad]"].isna().sum() == 1
    assert arm["arm/angle raw"].tolist() == by_csv[by_csv["uuid"] == ARM]["arm/angle raw"].tolist()


def test_a_grid_has_one_row_a_time_and_units_in_its_columns(tmp_path: Path) -> None:
    import pandas as pd

    first = recorded(tmp_path / "run.mcap")
    [wide] = convert(first, tmp_path / "wide.csv", wide=True).files
    table = pd.read_csv(wide, comment="#")
    assert list(table.columns) == ["time", "arm/angle [rad]", "hand/force [N]", "hand/oil [K]"]
    assert table["time"].is_monotonic_increasing
    assert table["time"].is_unique
    assert len(table) == 43, "the three samples that are missing have rows, what lies behind the last one has none"
    assert np.diff(table["time"]).max() == pytest.approx(0.01, abs=1e-5)
    row = table[np.isclose(table["time"] - 1_795_000_000, 0.05, atol=1e-6)]
    assert row["arm/angle [rad]"].tolist() == [0.5]
    assert row["hand/oil [K]"].tolist() == [0.25]
    [again] = convert(wide, tmp_path / "wide.parquet").files
    pd.testing.assert_frame_equal(pd.read_parquet(again), table)
    with pytest.raises(UsageError, match="written with --wide"):
        convert(wide, tmp_path / "no.mcap")


def test_a_grid_is_recorded_as_it_is_converted(tmp_path: Path) -> None:
    import pandas as pd

    sink = open_sink(f"wide:{tmp_path / 'run.csv'}")
    sink.open(FACTS, STATION)
    keys = ((ARM, 1), (HAND, 2))
    time = np.array([1.0, 1.01])
    fill(sink, [GroupRows("crane", keys, time, np.array([[1.5, np.nan], [2.5, -3.0]]), np.zeros((2, 2)))])
    table = pd.read_csv(tmp_path / "run.csv", comment="#")
    assert list(table.columns) == ["time", "arm/angle [rad]", "hand/force [N]"]
    assert table.iloc[0].isna().tolist() == [False, False, True]
    assert table.iloc[1].tolist() == [1.01, 2.5, -3.0]
    assert content(tmp_path / "run.csv")["messages"] == 2


def test_another_datasheet_midway_begins_another_file_of_columns(tmp_path: Path) -> None:
    newer = replace(ANGLE, fingerprint="ef" * 32)
    first = recorded(tmp_path / "run.jsonl", [block(), [newer], block(index=3)])
    for end in (".csv", ".parquet"):
        files = convert(first, tmp_path / f"other{end}").files
        assert [path.name for path in files] == [f"other{end}", f"other.2{end}"]
        assert [open_recording(path).facts[ARM, 1].fingerprint[:2] for path in files] == ["ab", "ef"]
    assert len(convert(first, tmp_path / "one.mcap").files) == 1


def test_notes_of_the_recorder_go_along(tmp_path: Path) -> None:
    first = recorded(tmp_path / "run.mcap", [block()])
    sink = open_sink(str(tmp_path / "noted.mcap"))
    sink.copy([*open_recording(first).entries(), Note(1_795_000_050.0, "The disk was full.")], FACTS, STATION)  # type: ignore[attr-defined]
    path = tmp_path / "noted.mcap"
    for end in (".jsonl", ".csv", ".parquet", ".mcap"):
        [path] = convert(path, tmp_path / f"next{end}").files
        assert [note["why"] for note in content(path)["notes"]] == ["The disk was full."]


def test_entries_come_in_the_order_in_which_they_were_measured(tmp_path: Path) -> None:
    """A report and a note stand behind the samples that came before them, whatever was gathered meanwhile."""
    report = NodeReport(ARM, "lost", why="The link ended.", time=1_795_000_010.0)
    noted = Note(1_795_000_020.0, "The disk was full.")
    items = [block(index=0), report, block(index=3), noted, block(index=6)]
    sink = open_sink(str(tmp_path / "run.mcap"))
    sink.copy(items, FACTS, STATION)  # type: ignore[attr-defined]
    entries = open_recording(tmp_path / "run.mcap").entries()
    found = [entry for entry in entries if isinstance(entry, Block | NodeReport | Note)]
    assert [type(entry) for entry in found] == [Block, NodeReport, Block, Note, Block]
    assert [entry.index for entry in found if isinstance(entry, Block)] == [0, 3, 6]
    assert isinstance(found[1], NodeReport)
    assert (found[1].uuid, found[1].why) == (ARM, "The link ended.")
    assert found[3] == noted


@pytest.mark.parametrize("why", ["", "No message (3 s); again in 1 s"])
@pytest.mark.parametrize("suffix", [".csv", ".jsonl", ".mcap"])
def test_a_report_keeps_its_reason_apart_from_why_values_are_invalid(tmp_path: Path, suffix: str, why: str) -> None:
    """Text gave the last of the reasons for invalid values, or of the node's own reason its last words."""
    invalid = (InvalidValues(1, "above its high limit, 360 ° (a turn)", 66), InvalidValues(1, "no number", 2))
    counts = {"samples": 99, "lost": 1, "late": 2, "bad": 3, "invalid": 68}
    report = NodeReport(ARM, "lost", why, **counts, time=1_795_000_010.0, invalid_why=invalid)
    path = recorded(tmp_path / f"run{suffix}", [block(), report])
    *_, found = (entry for entry in open_recording(path).entries() if isinstance(entry, NodeReport))
    assert (found.state, found.why) == ("lost", why)
    assert {name: getattr(found, name) for name in counts} == counts


def test_more_nodes_than_an_octet_counts_keep_their_samples_apart(tmp_path: Path) -> None:
    uuids = [f"{number:020x}" for number in range(1, 301)]
    sink = open_sink(str(tmp_path / "run.mcap"))
    sink.open([replace(ANGLE, uuid=uuid) for uuid in uuids], STATION)
    fill(sink, [block([[number]], uuid=uuid) for number, uuid in enumerate(uuids)])
    found = values(tmp_path / "run.mcap")
    assert {key: [raw for _, raw, _ in pairs] for key, pairs in found.items()} == {
        (uuid, 1): [number] for number, uuid in enumerate(uuids)
    }


def test_rows_of_a_grid_are_made_as_the_recording_is_read_although_a_stream_has_ended() -> None:
    """Else all that comes after the last value of a node that was lost waits in memory for the end of the file."""
    recording: Any = SimpleNamespace(facts={ANGLE.key: ANGLE, FORCE.key: FORCE}, station=STATION)
    taken, begun = [0], list[int]()

    def entries() -> Iterator[Any]:
        yield block(uuid=HAND, channels=(2,))
        for second in range(60):
            taken[0] = second
            yield block(start=STATION.started + second)
            yield ()

    for rows in converting._gridded(entries(), recording):
        assert isinstance(rows, GroupRows)
        begun.append(taken[0])
    assert begun[-1] == 59
    assert set(range(7, 60)) <= set(begun), "five seconds, and two periods, after its last value"


def test_a_slow_stream_is_waited_for_by_two_of_its_own_periods_and_five_seconds() -> None:
    """Its value of second 10 comes late in the recording: the row of that second has it all the same."""
    slow = replace(FORCE, period=10.0)
    recording: Any = SimpleNamespace(facts={ANGLE.key: ANGLE, slow.key: slow}, station=STATION)
    at = STATION.started

    def entries() -> Iterator[Any]:
        for second in range(40):
            if second in (0, 24):
                yield block([[second]], uuid=HAND, channels=(2,), start=at + second % 14)
            yield block([[second]], start=at + second)
            yield ()

    rows = {
        round(float(time) - at, 3): [float(value) for value in values]
        for made in converting._gridded(entries(), recording)
        for time, values in zip(made.time, made.value, strict=True)
    }
    assert rows[10.0] == [1.0, 2.4]
    assert sorted(second for second in rows if second == int(second)) == list(range(40))


def test_of_very_many_notes_the_first_are_shown() -> None:
    """How it began to go wrong says more than how it went on."""
    summary = RecordingSummary()
    for number in range(2 * NOTES):
        summary.add_entry(Note(float(number), "The disk was full."))
    assert [note.at for note in summary.notes] == [float(number) for number in range(NOTES)]


def test_a_report_after_rows_of_a_node_belongs_to_this_file() -> None:
    """Counts before the first values are of an earlier part; rows of a grid are values, too."""
    summary = RecordingSummary()
    rows = GroupRows("hand", ((ARM, 1),), np.arange(5.0), np.ones((5, 1)), np.zeros((5, 1)))
    summary.add_entry(rows)
    for samples, lost in ((5, 2), (10, 3)):
        summary.add_entry(NodeReport(ARM, "running", "", samples, lost, 0, 0, 0))
    assert summary._of_this_file(summary.reports[ARM]) == summary.reports[ARM]


def test_what_a_recording_holds_is_shown_whole() -> None:
    """`record info --json`: all of it, of two nodes, one of which was measured in an earlier part already."""
    summary = RecordingSummary()
    summary.add_entry((replace(ANGLE, name="angle 2"),))
    summary.add_entry(NodeReport(ARM, "running", samples=100, lost=5, late=1, bad=2, invalid=3))
    summary.add_entry(block([[1], [2]], valid=[[True], [False]], index=200))
    summary.add_entry(block([[4], [0.5]], index=205))
    summary.add_entry(block([[3]], index=0))
    summary.add_entry(block([[3]], index=3))
    summary.add_entry(NodeReport(HAND, "waiting", bad=4))
    summary.add_entry(block(np.array([[7, 70]]), uuid=HAND, channels=(2, 3), start=1_794_999_999.0))
    summary.add_entry(block(np.zeros((0, 1)), uuid=HAND, channels=(4,)))
    summary.add_entry(NodeReport(ARM, "lost", "It is silent.", samples=105, lost=8, late=1, bad=3, invalid=4))
    summary.add_entry(NodeReport(HAND, "ended", samples=2, bad=4))
    summary.add_entry(Note(1_795_000_001.0, "The disk was full."))
    recording: Any = SimpleNamespace(
        path=Path("/r/run.csv"), form="CSV", station=STATION, complete=True, torn=0, being_written=False,
        facts={FORCE.key: FORCE, ANGLE.key: ANGLE},
    )  # fmt: skip
    shown = summary.to_json(recording)
    channels = shown.pop("channels")
    assert shown == {
        "file": "/r/run.csv",
        "format": "CSV",
        "station": "bench",
        "group": "crane",
        "started": "2026-11-18T11:06:40.000Z",
        "test_pattern": False,
        "complete": True,
        "being_written": False,
        "torn": 0,
        "from": "2026-11-18T11:06:39.000Z",
        "until": "2026-11-18T11:06:42.060Z",
        "messages": 7,
        "samples": 8,
        "invalid": 1,
        "lost": 3,
        "missing": 5,
        "nodes": [
            {"uuid": ARM, "state": "lost", "why": "It is silent.", "samples": 5, "lost": 3, "late": 0, "bad": 1,
             "invalid": 1},
            {"uuid": HAND, "state": "ended", "why": "", "samples": 2, "lost": 0, "late": 0, "bad": 4, "invalid": 0},
        ],
        "notes": [{"time": "2026-11-18T11:06:41.000Z", "why": "The disk was full."}],
    }  # fmt: skip
    names = ("channel", "uuid", "name", "unit", "from", "until", "samples", "invalid", "lowest", "highest")
    begin = "2026-11-18T11:06:39.000Z"
    assert [tuple(channel.get(name) for name in names) for channel in channels] == [
        (1, ARM, "angle 2", "rad", "2026-11-18T11:06:40.000Z", "2026-11-18T11:06:42.060Z", 6, 1, 0.05, 0.4),
        (2, HAND, "force", "N", begin, begin, 1, 0, 0.7, 0.7),
        (3, HAND, None, None, begin, begin, 1, 0, 7.0, 7.0),
    ]
    for complete, torn in ((False, 0), (True, 9)):
        cut = SimpleNamespace(**{**vars(recording), "complete": complete, "torn": torn})
        assert summary.to_json(cast(Any, cut))["complete"] is False
    empty = RecordingSummary().to_json(recording)
    assert [empty[name] for name in ("from", "until", "lost", "nodes", "samples")] == [None, None, None, [], 0]
    alone = empty["channels"][-1]
    assert [alone[name] for name in names[4:]] == [None, None, 0, 0, None, None]


FOLDER = "There is no folder"


@pytest.mark.parametrize(
    ("target", "wide", "code", "message", "hint"),
    [
        ("run.xml", False, 2, "Unsupported format: 'run.xml'.", "Use .csv, .txt, .jsonl, .mcap, .parquet."),
        ("run", False, 2, "Unsupported format: 'run'.", "Use .csv, .txt, .jsonl, .mcap, .parquet."),
        ("run.mcap", True, 2, "--wide only works with text files and Parquet.", "Name a FILE.csv or FILE.parquet."),
        ("run.JSONL", True, 2, "--wide only works with text files and Parquet.", "Name a FILE.csv or FILE.parquet."),
        ("taken.csv", False, 2, "already exists", ""),
        ("none/run.csv", False, 3, FOLDER, "Create it, or choose another path."),
    ],
)
def test_what_cannot_be_written_is_refused_before_anything_is_read(
    tmp_path: Path, target: str, wide: bool, code: int, message: str, hint: str
) -> None:
    (tmp_path / "taken.csv").write_text("mine")
    with pytest.raises(TedsProvisionError) as refused:
        convert(tmp_path / "not there", tmp_path / target, wide=wide)
    assert refused.value.exit_code == code
    assert message in refused.value.message
    assert hint in refused.value.hint
    assert [path.name for path in tmp_path.iterdir()] == ["taken.csv"]
    assert (tmp_path / "taken.csv").read_text() == "mine"


def test_the_suffix_counts_whatever_its_letters_are(tmp_path: Path) -> None:
    first = recorded(tmp_path / "run.jsonl", [block()])
    for name in ("A.CSV", "B.Parquet", "C.MCAP"):
        assert convert(first, tmp_path / name).files == (tmp_path / name,)


@pytest.mark.parametrize("links", [True, False])
def test_a_name_that_was_taken_during_the_conversion_is_not_written_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, links: bool
) -> None:
    """A file system without hard links gets the file by its new name, if that is still free."""
    first = recorded(tmp_path / "run.jsonl", [block()])

    def none(*_words: Any) -> None:
        raise OSError(1, "Operation not permitted")

    if not links:
        monkeypatch.setattr(converting.os, "link", none)
    assert convert(first, tmp_path / "one.csv").files == (tmp_path / "one.csv",)
    assert open_recording(tmp_path / "one.csv").facts
    published = converting._published

    def beside(path: Path, folder: Path) -> Path:
        (folder / path.name).write_text("mine")
        return published(path, folder)

    monkeypatch.setattr(converting, "_published", beside)
    with pytest.raises(UsageError, match=r"two\.csv already exists"):
        convert(first, tmp_path / "two.csv")
    assert (tmp_path / "two.csv").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.csv", "run.jsonl", "two.csv"]


def test_a_disk_that_refuses_a_conversion_is_named_with_the_target(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = recorded(tmp_path / "run.jsonl", [block()])

    def full(_folder: Path) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(converting, "sync_folder", full)
    with pytest.raises(StoreError) as refused:
        convert(first, tmp_path / "one.csv")
    assert refused.value.message == f"{tmp_path / 'one.csv'} cannot be written: the disk is full."


def test_only_what_a_dead_conversion_to_this_name_left_is_removed(tmp_path: Path) -> None:
    first = recorded(tmp_path / "run.jsonl", [block()])
    dead, running, other, near = (
        tmp_path / name
        for name in (
            f".one.csv.{'0' * 16}.teds-part", f".one.csv.{'1' * 16}.teds-part", f".two.csv.{'0' * 16}.teds-part",
            ".one.csv.00.teds-part",
        )
    )  # fmt: skip
    for folder in (dead, running, other, near):
        folder.mkdir()
        (folder / "one.csv").write_text("x")
    held = os.open(running, os.O_RDONLY | os.O_DIRECTORY)
    fcntl.flock(held, fcntl.LOCK_EX)
    convert(first, tmp_path / "one.csv")
    assert not dead.exists()
    assert (running.exists(), other.exists(), near.exists()) == (True, True, True)
    os.close(held)
