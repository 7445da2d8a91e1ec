"""What the readers make of each line of a recording, by hand and literally."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from teds_provision.errors import BadDataError, UsageError
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
        (
            {"uuid": A, "state": "lost", "why": "x" * 1001, "invalid_why": [{**WHY, "why": "y" * 1001}] * 1001},
            NodeReport(A, "lost", "x" * 1000, time=0.0, invalid_why=(InvalidValues(2, "y" * 1000, 3),) * 1000),
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


DAMAGED = "the values in or above the line are not those of a recording."
LENGTHS = "the lists in or above the line are not of one length."


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"uuid": ...}, DAMAGED),
        ({"index": ...}, DAMAGED),
        ({"index": "x"}, DAMAGED),
        ({"index": None}, DAMAGED),
        ({"index": float("inf")}, DAMAGED),
        ({"time": ...}, DAMAGED),
        ({"time": ["x"]}, DAMAGED),
        ({"raw": ...}, DAMAGED),
        ({"raw": ["0g"]}, DAMAGED),
        ({"raw": 5}, DAMAGED),
        ({"value": ["x"]}, DAMAGED),
        ({"clock_error": "x"}, DAMAGED),
        ({"time": 1}, LENGTHS),
        ({"time": [[1]]}, LENGTHS),
        ({"time": [1, 2]}, LENGTHS),
        ({"raw": [1, 2]}, LENGTHS),
        ({"value": [1, 2]}, LENGTHS),
        ({"uuid": "x" * 1001}, LENGTHS),
        ({"channel": -1}, "-1 is not a channel number."),
        ({"channel": ...}, "the channel number is missing."),
    ],
)
def test_a_line_of_json_that_is_no_samples_is_named(tmp_path: Path, change: dict[str, Any], why: str) -> None:
    """Written with spaces, as by another program: a line without its channel ended in an error of Python."""
    words = {"event": "data", "uuid": "a", "channel": 1, "index": 0, "time": [1], "raw": [1], "value": [1], **change}
    path = tmp_path / "run.jsonl"
    with pytest.raises(BadDataError) as refused:
        read(path, '{"event":"note","why":"x"}\n' + json.dumps({k: v for k, v in words.items() if v is not ...}) + "\n")
    assert refused.value.message == f"{path}:2: {why}"
    if why in (DAMAGED, LENGTHS):
        assert refused.value.hint == "It was changed after it was recorded, or is damaged."


@pytest.mark.parametrize(("line", "why"), [("[1]", "the line is not a JSON object."), ("{", "the line is not JSON.")])
def test_a_line_that_is_no_object_is_named(tmp_path: Path, line: str, why: str) -> None:
    with pytest.raises(BadDataError) as refused:
        read(tmp_path / "run.jsonl", f'{{"event":"note","why":"x"}}\n{line}\n')
    assert refused.value.message == f"{tmp_path / 'run.jsonl'}:2: {why}"


def test_lines_of_json_that_no_reader_knows_are_passed_over(tmp_path: Path) -> None:
    lines = (
        '{"event":"recording","station":"bench","clock":"GPS"}\n'
        '{"event":"later","uuid":"a"}\n'
        '{"kind":"data"}\n'
        f'{{"event":"note","time":2,"why":"{"x" * 1001}"}}\n'
        '{"event":"data","uuid":"a","index":3,"time":[1.5],"raw":[7],"value":[0.5],"channel":1,"clock_error":0.5,'
        '"test_pattern":true}\n'
        '{"event":"data","uuid":"a","index":4,"time":[2.5],"raw":[8],"value":[null],"channel":1,"test_pattern":1}\n'
    )
    note, first, second = (entry for entry in read(tmp_path / "run.jsonl", lines) if entry)
    assert note == Note(2.0, "x" * 1000)
    assert told(first) == ("a", 0, (1,), 3, [1.5], [[7]], 0.5)
    assert told(second) == ("a", 0, (1,), 4, [2.5], [[8]], None)
    assert (first.test_pattern, second.test_pattern) == (True, False)
    assert (first.valid.tolist(), second.valid.tolist()) == ([[True]], [[False]])
    assert first.tick.tolist() == [0]
    assert open_recording(tmp_path / "run.jsonl").station.name == "bench"


def test_the_first_line_of_values_gives_the_facts_that_no_head_gave(tmp_path: Path) -> None:
    """As ``measure --json`` printed them."""
    line = (
        '{"event":"data","uuid":"ab","channel":3,"name":"force","unit":"N","index":0,"time":[1],"raw":[1],"value":[1],'
        '"uncertainty":0.5,"unsigned":true,"unverified":true}\n'
    )
    path = tmp_path / "run.jsonl"
    path.write_text(line + line.replace("force", "later") + line.replace('"uncertainty":0.5', '"uncertainty":null'))
    (facts,) = open_recording(path).facts.values()
    assert (facts.key, facts.name, facts.unit, facts.uncertainty) == (("ab", 3), "force", "N", 0.5)
    assert (facts.unsigned, facts.unverified) == (True, True)


@pytest.mark.parametrize(
    ("form", "cells", "raws"),
    [
        ("", ["00ff", "", "ab"], ["00ff", "", "ab"]),
        ("", ["0.5", "", "7"], [0.5, "nan", 7.0]),
        ("", ["12", "-3", "18446744073709551616"], [12, -3, 2**64]),
        ("Float32, 4 octets", ["12", "3", "4"], [12.0, 3.0, 4.0]),
        ("unsigned integer, 2 octets", ["12", "3", "4"], [12, 3, 4]),
    ],
)
def test_a_raw_value_of_text_is_read_by_its_form_else_by_how_it_looks(
    tmp_path: Path, form: str, cells: list[str], raws: list[Any]
) -> None:
    head = f'{text.FIRST}; times\n# channel: {{"uuid": "{A}", "number": 1, "sample_form": "{form}"}}\n'
    rows = "".join(f"{row},{A},{row},,,,{cell}\n" for row, cell in enumerate(cells))
    found = [entry for entry in read(tmp_path / "run.csv", f"{head}time,uuid,index,clock_error,note,a,a raw\n{rows}")
             if isinstance(entry, Block)]  # fmt: skip
    shown = {
        int(row): value for entry in found for row, value in zip(entry.time, entry.raw[:, 0].tolist(), strict=True)
    }
    expected = {row: bytes.fromhex(raw) if isinstance(raw, str) else raw for row, raw in enumerate(raws) if cells[row]}
    assert shown == expected
    assert [type(value) for value in shown.values()] == [type(value) for value in expected.values()]


@pytest.mark.parametrize("cells", [["0g"], ["abc"], ["zz", "00"], ["1 2 x"]])
def test_a_raw_value_of_text_that_is_neither_number_nor_octets_is_refused(tmp_path: Path, cells: list[str]) -> None:
    head = f'{text.FIRST}; times\n# channel: {{"uuid": "{A}", "number": 1}}\n'
    rows = "".join(f"{row},{A},{row},,,,{cell}\n" for row, cell in enumerate(cells))
    with pytest.raises(
        BadDataError, match=rf":4: one of the {len(cells)} rows from here on has a cell that is no number"
    ):
        read(tmp_path / "run.csv", f"{head}time,uuid,index,clock_error,note,a,a raw\n{rows}")


@pytest.mark.parametrize("line", ["time,a\rb", "time," + "x" * 131_073])
def test_names_of_columns_that_no_csv_has_are_refused(tmp_path: Path, line: str) -> None:
    (tmp_path / "run.csv").write_text(f"{text.FIRST}; times\n{line}\n", newline="")
    with pytest.raises(BadDataError, match=r"run\.csv:2: the line of column names is damaged\.$"):
        open_recording(tmp_path / "run.csv")


def test_parquet_has_the_rows_of_every_group_and_none_of_an_empty_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows are written in groups, so that memory stays small."""
    monkeypatch.setattr(parquet, "_CELLS", 24)
    path = in_parquet(tmp_path / "run.parquet", [block([[k]], index=k) for k in range(5)])
    assert [pq.ParquetFile(path).metadata.row_group(k).num_rows for k in range(3)] == [2, 2, 1]
    assert pq.read_table(path)["arm/angle raw"].to_pylist() == [0, 1, 2, 3, 4]
    empty = in_parquet(tmp_path / "empty.parquet", [])
    assert pq.ParquetFile(empty).metadata.num_rows == 0
    recording = open_recording(empty)
    assert set(recording.facts) == {(ARM, 1), (HAND, 2), (HAND, 3)}
    assert [entry for entry in recording.entries() if isinstance(entry, Block)] == []


@pytest.mark.parametrize(
    ("form", "raw", "held"),
    [
        ("unsigned integer, 2 octets", np.array([[5], [6]], dtype=object), [5, 6]),
        ("unsigned integer, 2 octets", np.array([[5.0], [6.0]]), [5, 6]),
        ("unsigned integer, 8 octets", np.array([[5], [2**64 - 1]], dtype=object), [5, 2**64 - 1]),
        ("Float64, 8 octets", np.array([[5], [6]]), [5.0, 6.0]),
        ("long integer, 9 octets", np.array([[5], [2**70]], dtype=object), ["5", str(2**70)]),
        ("octets", np.array([[b"\0\xff"], [b""]], dtype=object), ["00ff", ""]),
    ],
)
def test_raw_values_have_in_parquet_the_type_of_their_form(tmp_path: Path, form: str, raw: Any, held: Any) -> None:
    writer = ParquetWriter(tmp_path / "run.parquet", [replace(ANGLE, sample_form=form)], STATION, wide=False)
    writer.add_entry(block(raw, [[0.0]] * 2))
    writer.finish()
    assert pq.read_table(tmp_path / "run.parquet")["arm/angle raw"].to_pylist() == held


@pytest.mark.parametrize(
    ("form", "raw", "why"),
    [
        ("unsigned integer, 2 octets", np.array([[5.5]]), "unsigned integer, 2 octets: it is not a whole number."),
        ("unsigned integer, 2 octets", np.array([[b"x"]], dtype=object), "unsigned integer, 2 octets: "),
        ("unsigned integer, 2 octets", np.array([[2**64]], dtype=object), "unsigned integer, 2 octets: "),
        ("Float32, 4 octets", np.array([[b"x"]], dtype=object), "Float32, 4 octets: "),
        ("unsigned integer, 8 octets", np.array([[5.0]]), "unsigned integer, 8 octets: "),
    ],
)
def test_a_raw_value_that_contradicts_its_datasheet_is_refused(tmp_path: Path, form: str, raw: Any, why: str) -> None:
    writer = ParquetWriter(tmp_path / "run.parquet", [replace(ANGLE, sample_form=form)], STATION, wide=False)
    writer.add_entry(block(raw, [[0.0]]))
    with pytest.raises(BadDataError) as refused:
        writer.finish()
    writer.close()
    assert refused.value.message.startswith(f"A raw value of angle of {ARM} is no {why}")


def test_parquet_of_another_program_or_with_a_head_of_another_form_is_refused(tmp_path: Path) -> None:
    whole = pq.read_table(in_parquet(tmp_path / "run.parquet", [block()]))
    head = json.loads(whole.schema.metadata[b"teds-provision"])
    assert head["format"] == "teds-provision/measurement-1"
    for words, after in (
        ("[", "[]"), ("[" * 100_000, "[]"), ("[]", "[]"), (json.dumps({**head, "format": "x"}), "[]"),
        (json.dumps(head), "{}"), (json.dumps(head), "["),
    ):  # fmt: skip
        metadata = {"teds-provision": words, "teds-provision.log": after}
        pq.write_table(whole.replace_schema_metadata(metadata), tmp_path / "other")
        with pytest.raises(BadDataError) as refused:
            open_recording(tmp_path / "other")
        assert refused.value.message == f"{tmp_path / 'other'}: it is not a recording of this program."
        assert refused.value.hint == "It was changed since it was written, or is damaged."
    log = [
        5,
        {"event": "note", "time": "x", "why": "y" * 1001},
        {"event": "x"},
        {"uuid": ARM, "state": "lost", "time": 2},
    ]
    metadata = {"teds-provision": json.dumps(head), "teds-provision.log": json.dumps(log)}
    pq.write_table(whole.replace_schema_metadata(metadata), tmp_path / "logged")
    *_, note, report = open_recording(tmp_path / "logged").entries()
    assert (note, report) == (Note(0.0, "y" * 1000), NodeReport(ARM, "lost", time=2.0))
    metadata["teds-provision"] = json.dumps({**head, "channels": None, "wide": 1})
    pq.write_table(whole.replace_schema_metadata(metadata), tmp_path / "nameless")
    assert (open_recording(tmp_path / "nameless").facts, open_recording(tmp_path / "nameless").wide) == ({}, False)


def test_of_a_report_parquet_keeps_the_last_of_each_node(tmp_path: Path) -> None:
    reports = [
        NodeReport(ARM, "running", time=1.0),
        NodeReport(HAND, "lost", time=2.0),
        NodeReport(ARM, "ended", time=3.0),
    ]
    path = in_parquet(tmp_path / "run.parquet", [block(), *reports, Note(4.0, "full")])
    found = [entry for entry in open_recording(path).entries() if isinstance(entry, NodeReport | Note)]
    assert found == [reports[1], reports[2], Note(4.0, "full")]


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (ValueError("Not a footer.\nin thrift"), "Not a footer"),
        (ValueError(), "ValueError"),
        (OSError("x" * 201), "x" * 200),
    ],
)
def test_of_an_error_of_pyarrow_the_first_line_is_quoted(error: Exception, line: str) -> None:
    assert parquet._first_line(error) == line


def test_without_pyarrow_parquet_is_refused_with_what_adds_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = in_parquet(tmp_path / "run.parquet", [block()])
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(UsageError) as refused:
        open_recording(path)
    assert refused.value.message == "Parquet needs pyarrow."
    assert "install" in refused.value.hint
    assert "[parquet]" in refused.value.hint
