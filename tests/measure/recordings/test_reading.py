"""What the readers make of each line of a recording, by hand and literally."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from teds_provision.errors import BadDataError
from teds_provision.measure.blocks import Block, GroupRows, InvalidValues, NodeReport, Note
from teds_provision.measure.recordings import json_lines, parquet, source, text
from teds_provision.measure.recordings.converting import convert
from teds_provision.measure.recordings.json_lines import report_of
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.recordings.parquet import ParquetWriter
from teds_provision.measure.sinks import open_sink
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, HAND, OIL, STATION, block, fill

A, B = "aa" * 10, "bb" * 10
HEAD = (
    "# teds-provision measurement, text 1; times are unix seconds, clock: the host's\n"
    "# station: bench; group: crane\n"
    "# started: 2026-11-21T17:58:41Z; part 2\n"
    f'# channel: {{"uuid": "{A}", "number": 1, "name": "angle", "sample_form": "unsigned integer, 2 octets"}}\n'
    f'# channel: {{"uuid": "{A}", "number": 2, "name": "mean", "sample_form": "Float32, 4 octets"}}\n'
    f'# channel: {{"uuid": "{B}", "number": 1, "name": "bits", "sample_form": "bit sequence, 9 octets"}}\n'
)
COLUMNS = "time,uuid,index,clock_error,note,a,b,c,a raw,b raw,c raw\n"


def read(path: Path, text: str) -> list[Any]:
    path.write_text(text)
    return list(open_recording(path).entries())


def told(block: Block) -> tuple[Any, ...]:
    raw = [[value.hex() if isinstance(value, bytes) else value for value in row] for row in block.raw.tolist()]
    return (block.uuid, block.stream, block.channels, block.index, block.time.tolist(), raw, block.clock_error)


def test_rows_of_text_become_blocks_of_each_node_and_stream(tmp_path: Path) -> None:
    lines = (
        f"{HEAD}{COLUMNS}"
        f"1.5,{A},7,0.001,,0.5,,,100,1.25,\n"
        f"1.6,{B},3,,,,,,,,340282366920938463463\n"
        f"2.5,{A},8,0.001,,,2.5,,101,2.5,\n"
        f"3.5,{A},10,0.001,,0.7,,,102,3.5,\n"
        f"4.5,{A},11,0.002,test pattern,0.8,,,103,4.5,\n"
    )
    facts, *entries = read(tmp_path / "run.csv", lines)
    assert [(channel.uuid, channel.number, channel.name) for channel in facts] == [
        (A, 1, "angle"),
        (A, 2, "mean"),
        (B, 1, "bits"),
    ]
    blocks = [entry for entry in entries if isinstance(entry, Block)]
    assert [told(block) for block in blocks] == [
        (A, 0, (1, 2), 7, [1.5, 2.5], [[100, 1.25], [101, 2.5]], 0.001),
        (A, 0, (1, 2), 10, [3.5], [[102, 3.5]], 0.001),
        (A, 0, (1, 2), 11, [4.5], [[103, 4.5]], 0.002),
        (B, 0, (1,), 3, [1.6], [[340282366920938463463]], None),
    ]
    assert [block.test_pattern for block in blocks] == [False, False, True, False]
    np.testing.assert_array_equal(blocks[0].value, [[0.5, np.nan], [np.nan, 2.5]])
    assert blocks[0].valid.tolist() == [[True, False], [False, True]]
    recording = open_recording(tmp_path / "run.csv")
    station = recording.station
    assert (station.name, station.group, station.clock, station.started) == (
        "bench",
        "crane",
        "the host's",
        1795283921.0,
    )
    assert recording.form == "CSV"


def test_rows_of_one_grid_have_a_time_and_a_value_of_each_channel(tmp_path: Path) -> None:
    wide = HEAD.replace("text 1;", "text 1, wide;") + "time\ta\tb\tc\n1.5\t0.5\t\t2\n2.5\t\t1.5\t\n"
    (_, rows) = read(tmp_path / "run.txt", wide)
    assert isinstance(rows, GroupRows)
    assert (rows.group, rows.channels, rows.time.tolist()) == ("crane", ((A, 1), (A, 2), (B, 1)), [1.5, 2.5])
    np.testing.assert_array_equal(rows.value, [[0.5, np.nan, 2], [np.nan, 1.5, np.nan]])
    assert open_recording(tmp_path / "run.txt").form == "text, wide"


def test_remarks_of_text_are_states_and_notes(tmp_path: Path) -> None:
    state = f"# 2026-11-21T17:58:51.500Z {A} lost: 12 values, lost 1, late 2, bad 3, invalid 4"
    text = (
        f"{HEAD}{COLUMNS}{state} (3 too high (above 5); 1 else); No message: it is off\n"
        "# 2026-11-21T17:58:52Z The disk is full.\n"
        "# unknown The clock was set.\n"
        "# just a remark\n"
    )
    _, report, note, undated = read(tmp_path / "run.csv", text)
    assert report == NodeReport(A, "lost", "No message: it is off", 12, 1, 2, 3, 4, time=1795283931.5)
    assert (note, undated) == (Note(1795283932.0, "The disk is full."), Note(0.0, "The clock was set."))


@pytest.mark.parametrize(
    ("row", "why"),
    [
        (f"1,{A},2,,,,,,,\n", ":9: the row has 10 cells in place of 11."),
        (f"1,{A},2,,,,,,,,,\n", ":9: the row has 12 cells in place of 11."),
        (
            f"1,{A},2,,,x,,,5,1,\n",
            ":8: one of the 2 rows from here on has a cell that is no number, or too large a one.",
        ),
    ],
)
def test_a_damaged_row_is_named_with_its_line(tmp_path: Path, row: str, why: str) -> None:
    good = f"1,{A},1,,,,,,4,1,\n"
    for end in ("", "# 2026-11-21T17:58:52Z The disk is full.\n", "# a remark\n# and another\n"):
        with pytest.raises(BadDataError) as refused:
            read(tmp_path / "run.csv", HEAD + COLUMNS + good + row + end)
        assert refused.value.message == f"{tmp_path / 'run.csv'}{why}"


def test_what_is_no_whole_line_at_the_end_is_counted_and_not_read(tmp_path: Path) -> None:
    for name, head, line in (
        ("run.csv", HEAD + COLUMNS, f"1,{A},1,,,,,,4,1,\n"),
        ("run.jsonl", "", '{"event":"note","time":1,"why":"x"}\n'),
    ):
        path = tmp_path / name
        path.write_text(head + line + line + line[:-1])
        recording = open_recording(path)
        blocks = [entry for entry in recording.entries() if isinstance(entry, Block | Note)]
        assert sum(len(entry.time) if isinstance(entry, Block) else 1 for entry in blocks) == 2
        assert recording.torn == len(line) - 1


def test_a_line_is_as_long_as_the_limit_allows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (json_lines, text):
        monkeypatch.setattr(module, "MOST", source.ReadLimits(line=1000))
    for name, head, tail in (("run.csv", HEAD, "# "), ("run.jsonl", '{"event":"note","why":"x"}\n', "{")):
        path = tmp_path / name
        path.write_text(head + tail.ljust(1000, "x"))
        assert open_recording(path).path == path, "it may still be written"
        path.write_text(head + tail.ljust(1001, "x"))
        with pytest.raises(BadDataError, match="the line has more than 1000 octets"):
            open_recording(path)


@pytest.mark.parametrize(
    ("lines", "blocks"),
    [
        ([(A, 1, 0, [1, 2], [5, 6]), (A, 2, 0, [1, 2], [7, 8])], [(A, 0, (1, 2), [[5, 7], [6, 8]])]),
        ([(A, 1, 0, [1, 2], [5, 6]), (A, 1, 2, [3, 4], [7, 8])], [(A, 0, (1,), [[5], [6], [7], [8]])]),
        ([(A, 1, 0, [1, 2], [5, 6]), (A, 2, 2, [1, 2], [7, 8])], [(A, 0, (1,), [[5], [6]]), (A, 1, (2,), [[7], [8]])]),
        ([(A, 1, 0, [1], [5]), (A, 2, 0, [2], [7])], [(A, 0, (1,), [[5]]), (A, 1, (2,), [[7]])]),
        ([(A, 1, 0, [1], [5]), (B, 2, 0, [1], [7])], [(A, 0, (1,), [[5]]), (B, 0, (2,), [[7]])]),
        ([(A, 1, 0, [1], [5]), (A, 1, 0, [1], [7])], [(A, 0, (1,), [[5]]), (A, 0, (1,), [[7]])]),
        ([(A, 1, 0, [1, 2], [5, 1.5])], [(A, 0, (1,), [[5.0], [1.5]])]),
        ([(A, 1, 0, [1, 2], [5, None])], [(A, 0, (1,), [[5.0], ["nan"]])]),
        ([(A, 1, 0, [1], [2**64])], [(A, 0, (1,), [[2**64]])]),
        ([(A, 1, 0, [1], ["00ff"])], [(A, 0, (1,), [["00ff"]])]),
    ],
)
def test_lines_of_json_with_one_node_index_and_time_are_one_block(
    tmp_path: Path, lines: list[Any], blocks: list[Any]
) -> None:
    names = ("uuid", "channel", "index", "time", "raw")
    text = "".join(
        json.dumps({"event": "data", **dict(zip(names, line, strict=True)), "value": [None] * len(line[3])},
                   separators=(",", ":")) + "\n"
        for line in lines
    )  # fmt: skip
    found = [
        (block.uuid, block.stream, block.channels, [[str(v) if v != v else v for v in row] for row in told(block)[5]])
        for block in read(tmp_path / "run.jsonl", text)
        if isinstance(block, Block)
    ]
    assert found == blocks


WHY = {"channel": 2, "why": "too high", "count": 3}


@pytest.mark.parametrize(
    ("words", "report"),
    [
        (
            {"uuid": A, "state": "lost", "why": "off", "samples": 9, "lost": 1, "late": 2, "bad": 3, "invalid": 4,
             "clock_error": 0.5, "time": 7, "invalid_why": [WHY]},
            NodeReport(A, "lost", "off", 9, 1, 2, 3, 4, 0.5, 7.0, (InvalidValues(2, "too high", 3),)),
        ),
        ({"uuid": A, "state": "ended"}, NodeReport(A, "ended", "", time=0.0)),
        ({"uuid": A, "state": "ended", "samples": "9", "why": None}, NodeReport(A, "ended", "", time=0.0)),
        ({"uuid": A, "state": "ended", "clock_error": "x"}, NodeReport(A, "ended", "", time=0.0)),
        ({"uuid": A, "state": "running", "invalid_why": WHY}, NodeReport(A, "running", "", time=0.0)),
        (
            {"uuid": A, "state": "running",
             "invalid_why": [5, {**WHY, "channel": "2"}, {**WHY, "count": None}, {"why": "x"}, WHY]},
            NodeReport(A, "running", "", time=0.0, invalid_why=(InvalidValues(2, "too high", 3),)),
        ),
        ({"uuid": "x" * 1000, "state": "lost"}, NodeReport("x" * 1000, "lost", "", time=0.0)),
        ({"uuid": "x" * 1001, "state": "lost"}, None),
        ({"uuid": A, "state": "gone"}, None),
        ({"uuid": 5, "state": "lost"}, None),
    ],
)  # fmt: skip
def test_the_state_of_a_node_is_read_as_far_as_it_is_one(words: dict[str, Any], report: NodeReport | None) -> None:
    assert report_of(words) == report


def in_parquet(path: Path, entries: list[Any], *, wide: bool = False) -> Path:
    facts = (
        replace(FORCE, sample_form="unsigned integer, 4 octets"),
        ANGLE,
        replace(OIL, sample_form="Float32, 4 octets"),
    )
    writer = ParquetWriter(path, facts, STATION, wide=wide)
    for entry in entries:
        writer.add_entry(entry)
    writer.finish()
    return path


def test_columns_of_parquet_hold_what_blocks_hold_and_give_it_back(tmp_path: Path) -> None:
    """The tick, its clock error and the mark of a test pattern too; null where a cell is empty."""
    arm = block([[5], [6]], [[0.5], [0.6]], [[True], [False]], index=7, start=100.0, clock_error=0.25)
    hand = block(np.array([[8.0, 1.5]]), uuid=HAND, channels=(2, 3), start=100.005, clock_error=None)
    last = replace(block([[9]], index=9, start=200.0, clock_error=0.5), test_pattern=True)
    arm, hand, last = (
        replace(part, time=np.array(times), tick=np.arange(tick, tick + len(times), dtype=np.uint64))
        for part, times, tick in ((arm, [100.0, 100.01], 2**63), (hand, [100.005], 77), (last, [200.0], 1000))
    )
    path = in_parquet(tmp_path / "run.parquet", [hand, arm, Note(5.0, "x"), last])
    table = pq.read_table(path).to_pydict()
    assert list(table) == [
        *("time", "uuid", "index", "tick", "clock_error", "note"),
        *("arm/angle [rad]", "hand/force [N]", "hand/oil [K]"),
        *("arm/angle raw", "hand/force raw", "hand/oil raw"),
    ]
    assert table["time"] == pytest.approx([100.0, 100.005, 100.01, 200.0])
    assert table["uuid"] == [ARM, HAND, ARM, ARM]
    assert table["index"] == [7, 0, 8, 9]
    assert table["tick"] == [2**63, 77, 2**63 + 1, 1000]
    assert table["clock_error"] == [0.25, None, 0.25, 0.5]
    assert table["note"] == [None, None, None, "test pattern"]
    assert table["arm/angle [rad]"] == [0.5, None, None, pytest.approx(table["arm/angle [rad]"][3])]
    assert table["arm/angle raw"] == [5, None, 6, 9]
    assert table["hand/force raw"] == [None, 8, None, None]
    assert table["hand/oil raw"] == [None, 1.5, None, None]
    recording = open_recording(path)
    assert (recording.form, recording.wide, recording.station.name) == ("Parquet", False, "bench")
    found = list(recording.entries())
    blocks = [entry for entry in found if isinstance(entry, Block)]
    assert [(part.uuid, part.channels, part.index, part.tick.tolist(), part.clock_error) for part in blocks] == [
        (ARM, (1,), 7, [2**63, 2**63 + 1], 0.25),
        (ARM, (1,), 9, [1000], 0.5),
        (HAND, (2, 3), 0, [77], None),
    ]
    assert [part.test_pattern for part in blocks] == [False, True, False]
    assert found[-1] == Note(5.0, "x")


def test_a_grid_in_parquet_has_its_time_and_values_alone(tmp_path: Path) -> None:
    keys = ((ARM, 1), (HAND, 3))
    rows = GroupRows("crane", keys, np.array([1.0, 2.0]), np.array([[0.5, np.nan], [np.nan, 2.5]]), np.zeros((2, 2)))
    path = in_parquet(tmp_path / "run.parquet", [rows], wide=True)
    assert pq.read_table(path).to_pydict() == {
        "time": [1.0, 2.0],
        "arm/angle [rad]": [0.5, None],
        "hand/force [N]": [None, None],
        "hand/oil [K]": [None, 2.5],
    }
    recording = open_recording(path)
    assert (recording.form, recording.wide) == ("Parquet, wide", True)
    (again,) = (entry for entry in recording.entries() if isinstance(entry, GroupRows))
    assert (again.group, again.channels) == ("crane", ((ARM, 1), (HAND, 2), (HAND, 3)))
    np.testing.assert_array_equal(again.value, [[0.5, np.nan, np.nan], [np.nan, np.nan, 2.5]])


def test_parquet_that_does_not_fit_its_head_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = in_parquet(tmp_path / "run.parquet", [block()])
    whole = pq.read_table(path)
    for name, table, why in (
        ("less", whole.drop_columns(["note"]), "its columns are not those of its channels"),
        ("more", whole.append_column("x", whole["index"]), "its columns are not those of its channels"),
        ("text", whole.set_column(2, "index", whole["uuid"]), "its values cannot be read"),
        ("other", whole.replace_schema_metadata({}), "it is not a recording of this program"),
    ):
        pq.write_table(table, tmp_path / name)
        with pytest.raises(BadDataError, match=why):
            list(open_recording(tmp_path / name).entries())
    monkeypatch.setattr(parquet, "MOST", source.ReadLimits(channels=3))
    assert open_recording(path).form == "Parquet"
    monkeypatch.setattr(parquet, "MOST", source.ReadLimits(channels=2))
    with pytest.raises(BadDataError, match="it names more than 2 channels"):
        open_recording(path)
    monkeypatch.setattr(parquet, "MOST", source.ReadLimits(columns=11))
    with pytest.raises(BadDataError, match="its columns are not those of its channels"):
        list(open_recording(path).entries())


@pytest.mark.parametrize("suffix", [".csv", ".txt", ".jsonl", ".parquet"])
@pytest.mark.parametrize(
    ("form", "raws"),
    [
        ("long integer, 9 octets", [2**64, 12, 2**72 - 1]),
        ("bit sequence, 10 octets", [1, 12, 10**24 - 1]),
        ("unsigned integer, 8 octets", [2**63, 1, 2**64 - 1]),
        ("unsigned integer, 7 octets", [2**56 - 1, 0, 2**53 + 1]),
        ("Float64, 8 octets", [0.1, -1e300, 2.0**-1074]),
    ],
)
def test_a_raw_value_survives_each_conversion_to_the_last_bit(
    tmp_path: Path, suffix: str, form: str, raws: list[Any]
) -> None:
    facts = replace(ANGLE, sample_form=form)
    origin = open_sink(str(tmp_path / "origin.jsonl"))
    origin.open((facts,), STATION)
    kind = float if form.startswith("Float") else np.uint64 if "8" in form or "7" in form else object
    part = block(np.array([[raw] for raw in raws], dtype=kind), [[0.0]] * 3)
    fill(origin, [part])
    target = tmp_path / f"other{suffix}"
    convert(tmp_path / "origin.jsonl", target)
    found = [entry for entry in open_recording(target).entries() if isinstance(entry, Block)]
    assert [raw for entry in found for raw in entry.raw[:, 0].tolist()] == raws
