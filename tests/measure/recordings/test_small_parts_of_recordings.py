"""Small parts of reading and converting: limits, gaps, exact numbers, what is damaged, and what is closed after it."""

from __future__ import annotations

import json
import os
import struct
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from teds_provision.errors import BadDataError
from teds_provision.measure.blocks import Block, GroupRows, NodeReport, Note, StationFacts
from teds_provision.measure.display_units import UnitConversion, in_display_units, in_si_units
from teds_provision.measure.recordings import columns, converting, source, text
from teds_provision.measure.recordings import summary as of_summary
from teds_provision.measure.recordings.columns import part_of
from teds_provision.measure.recordings.mcap import McapRecording
from teds_provision.measure.recordings.opening import open_recording
from teds_provision.measure.recordings.parquet import ParquetRecording, ParquetWriter, _exact
from teds_provision.measure.recordings.summary import RecordingSummary
from teds_provision.measure.recordings.text import TextRecording
from teds_provision.teds.units import parse_units
from tests.measure.sinks.parts import ANGLE, ARM, HAND, STATION, block

FIRST = "# teds-provision measurement, text 1; times are unix seconds, clock: the host's\n"
CHANNEL = json.dumps({"uuid": ARM, "number": 1, "name": "angle", "sample_form": "unsigned integer, 2 octets"})
COLUMNS = "time,uuid,index,clock_error,note,angle,angle raw\n"


# -- display units -----------------------------------------------------------------------------------------------------


def test_a_value_is_converted_once_and_back_by_factor_and_offset() -> None:
    """°F has both: 212 °F are 373.15 K."""
    facts = replace(ANGLE, unit="K", units=parse_units("K"), shown_unit="°F", low=None, high=None, uncertainty=None)
    there, back = UnitConversion(), UnitConversion(back=True)
    (shown,) = there.facts([facts])
    assert (shown.unit, shown.si_unit) == ("°F", "K")
    assert in_display_units(shown) == shown
    assert in_si_units(facts) == facts
    rows: Any = there.convert(block(np.array([[1], [2]]), np.array([[373.15], [273.15]])))
    np.testing.assert_allclose(rows.value, [[212.0], [32.0]])
    assert back.facts([shown]) == (in_si_units(shown),)
    restored: Any = back.convert(rows)
    np.testing.assert_allclose(restored.value, [[373.15], [273.15]])
    note = Note(1.0, "moved")
    assert there.convert(note) is note


# -- columns -----------------------------------------------------------------------------------------------------------


def test_some_rows_of_a_block_have_its_number_and_theirs() -> None:
    whole = block(np.arange(6).reshape(6, 1), index=10)
    for rows, index, raw in ((slice(None, 2), 10, [0, 1]), (slice(2, 4), 12, [2, 3]), (slice(4, None), 14, [4, 5])):
        part = part_of(whole, rows)
        assert (part.index, part.raw.ravel().tolist()) == (index, raw)
        assert len(part.time) == len(part.tick) == len(part.value) == len(part.valid) == 2


@pytest.mark.parametrize(
    ("change", "follows"),
    [
        ({}, True),
        ({"index": 4}, False),
        ({"clock_error": 0.5}, False),
        ({"clock_error": None}, False),
        ({"test_pattern": True}, False),
        ({"raw": np.array([[1.0]])}, False),
    ],
)
def test_a_block_joins_the_one_before_if_all_that_is_one_for_both_is_the_same(
    change: dict[str, Any], follows: bool
) -> None:
    first = block(np.array([[1], [2], [3]]), index=0, clock_error=0.25)
    after = replace(block(np.array([[4]]), index=3, clock_error=0.25), **change)
    assert columns._follows([first], after) is follows


# -- text --------------------------------------------------------------------------------------------------------------


def _text(path: Path, head: str, *lines: str) -> TextRecording:
    path.write_text(f"{FIRST}{head}# started: 2026-11-21T17:58:41Z; part 1\n# channel: {CHANNEL}\n{''.join(lines)}")
    return TextRecording(path)


@pytest.mark.parametrize(
    ("line", "group"),
    [("# station: bench; group: none\n", ""), ("# station: bench; group: hand\n", "hand"), ("", "")],
)
def test_the_group_none_of_a_head_is_no_group(tmp_path: Path, line: str, group: str) -> None:
    assert _text(tmp_path / "run.csv", line, COLUMNS).station.group == group


def test_a_note_is_read_up_to_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(text, "MOST", replace(source.MOST, text=20))
    made = _text(tmp_path / "run.csv", "", COLUMNS, "# 2026-11-21T17:58:42Z " + "x" * 50 + "\n", "# no time\n")
    notes = [entry for entry in made.entries() if isinstance(entry, Note)]
    assert notes == [Note(1795283922.0, "x" * 20)]


def test_a_head_of_columns_that_is_no_csv_is_damaged(tmp_path: Path) -> None:
    for line in ('time,"a\0b\n', "time," + "x" * 200_000 + "\n"):
        with pytest.raises(BadDataError, match=r"damaged|columns are not those"):
            _text(tmp_path / "run.csv", "", line)


def test_rows_of_all_nodes_together_are_of_the_group_all(tmp_path: Path) -> None:
    for group, name in (("", "all"), ("hand", "hand")):
        made: Any = SimpleNamespace(_known=[ANGLE], station=StationFacts("bench", group=group))
        rows = TextRecording._grid(made, [["1.5", "2.5"], ["2.5", ""]])
        assert (rows.group, rows.channels, rows.time.tolist()) == (name, ((ARM, 1),), [1.5, 2.5])
        np.testing.assert_array_equal(rows.value, [[2.5], [np.nan]])


@pytest.mark.parametrize(
    ("cells", "form", "raw"),
    [
        (["7", "", "340282366920938463463"], "bit sequence, 9 octets", [7, 0, 340282366920938463463]),
        (["18446744073709551615", "1"], "unsigned integer, 8 octets", [18446744073709551615, 1]),
        (["9007199254740993", "1"], "", [9007199254740993, 1]),
        (["1.5", "2"], "", [1.5, 2.0]),
        (["ff00", "7e"], "", [b"\xff\0", b"\x7e"]),
        (["3", "4"], "Float32, 4 octets", [3.0, 4.0]),
    ],
)
def test_raw_values_of_text_are_exact_in_whatever_form(cells: list[str], form: str, raw: list[Any]) -> None:
    found = text._raw(cells, form)
    assert found.tolist() == raw
    assert [type(value) for value in found.tolist()] == [type(value) for value in raw]


@pytest.mark.parametrize("when", ["", "yesterday", "0001-01-01T00:00:00", "9999-12-31T23:59:59", None, "inf"])
def test_a_time_that_is_none_is_0(when: object) -> None:
    assert source.unix_of(when) == 0.0 or when == "9999-12-31T23:59:59"


@pytest.mark.parametrize("error", [ValueError("no time"), OverflowError("beyond")])
def test_a_time_beyond_that_of_the_machine_is_0(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    def fails(_text: str) -> Any:
        raise error

    monkeypatch.setattr("datetime.datetime", SimpleNamespace(fromisoformat=fails))
    assert source.unix_of("2026-01-01") == 0.0


def test_a_vector_has_no_more_channels_than_are_read() -> None:
    words = {"uuid": ARM, "number": 1, "name": "x"}
    most = source.MOST.text
    assert source.facts_of({**words, "vector": [1] * most}, "run.csv:4").vector == (1,) * most
    with pytest.raises(BadDataError, match=r"^run.csv:4: vector of a channel is"):
        source.facts_of({**words, "vector": [1] * (most + 1)}, "run.csv:4")


# -- Parquet -----------------------------------------------------------------------------------------------------------


def _parquet(path: Path, entries: list[Any], *facts: Any, wide: bool = False) -> ParquetRecording:
    writer = ParquetWriter(path, facts or (ANGLE,), STATION, wide=wide)
    for entry in entries:
        writer.add_entry(entry)
    writer.finish()
    made = open_recording(path)
    assert isinstance(made, ParquetRecording)
    return made


def test_rows_of_one_time_keep_their_order_and_an_unknown_clock_error_is_null(tmp_path: Path) -> None:
    """Sorted by time across nodes; a sort that is not stable mixes rows of a clock that stood still."""
    n, times = 300, 1_795_000_000.0 + np.repeat([0.0, 1.0, 2.0], 100)
    first = replace(block(np.arange(n).reshape(n, 1), clock_error=None), time=times)
    other = replace(block(np.arange(n).reshape(n, 1), uuid=HAND, clock_error=0.5), time=times)
    facts = (ANGLE, replace(ANGLE, uuid=HAND, node="hand"))
    _parquet(tmp_path / "run.parquet", [first, other], *facts)
    table = pq.read_table(tmp_path / "run.parquet")
    assert table.column("uuid").to_pylist() == ([ARM] * 100 + [HAND] * 100) * 3
    hundreds = [list(range(begin, begin + 100)) for begin in (0, 0, 100, 100, 200, 200)]
    assert table.column("index").to_pylist() == [index for hundred in hundreds for index in hundred]
    assert table.column("clock_error").to_pylist() == ([None] * 100 + [0.5] * 100) * 3


def test_a_channel_with_gaps_is_read_and_its_large_raw_values_stay_exact(tmp_path: Path) -> None:
    """A node's channels of two streams share the rows of the file: each has gaps where the other has values."""
    large = 2**53 + 1
    facts = [replace(ANGLE, number=n, sample_form="long integer, 8 octets") for n in (1, 2)]
    long = [replace(one, sample_form="unsigned integer, 8 octets") for one in facts]
    entries = [
        block(np.array([[large], [large + 1]], dtype=np.uint64), channels=(1,)),
        block(np.array([[large + 2]], dtype=np.uint64), channels=(2,), start=1_795_000_005.0),
    ]
    made = _parquet(tmp_path / "run.parquet", entries, *long)
    blocks = [entry for entry in made.entries() if isinstance(entry, Block)]
    found = {one.channels: one.raw.tolist() for one in blocks}
    assert found == {(1,): [[large], [large + 1]], (2,): [[large + 2]]}
    filled = _exact(pa.array([large, None, -large], pa.int64()))
    assert filled.tolist() == [large, 0, -large]


def test_rows_without_a_tick_are_read_with_tick_0_and_the_others_stay_exact(tmp_path: Path) -> None:
    """Other programs write null; as a float the last tick would be another one."""
    path, last = tmp_path / "run.parquet", 2**63 + 1
    _parquet(path, [block()])
    table = pq.read_table(path)
    place = table.schema.get_field_index("tick")
    ticks = pa.array([None, 5, last], pa.uint64())
    pq.write_table(table.set_column(place, table.schema.field(place), ticks), path)
    [read] = [entry for entry in open_recording(path).entries() if isinstance(entry, Block)]
    assert read.tick.tolist() == [0, 5, last]


@pytest.mark.parametrize("octets", [b"PAR1 nothing PAR1", b"PAR1", b"PAR1" + bytes(40) + b"\xff\xff\0\0PAR1"])
def test_a_file_that_only_begins_as_parquet_is_damaged(tmp_path: Path, octets: bytes) -> None:
    path = tmp_path / "run.parquet"
    path.write_bytes(octets)
    with pytest.raises(BadDataError) as refused:
        ParquetRecording(path)
    assert refused.value.message.startswith(f"{path}: it is not a complete Parquet file: ")


@pytest.mark.parametrize(
    "error", [TypeError("odd"), ValueError("odd"), OSError("odd"), pa.ArrowNotImplementedError("odd")]
)
def test_values_of_parquet_that_cannot_be_read_are_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    made = _parquet(tmp_path / "run.parquet", [block()])

    def broken(*_: Any) -> Any:
        raise error

    monkeypatch.setattr(made, "_blocks", broken)
    with pytest.raises(BadDataError, match="its values cannot be read: odd"):
        list(made.entries())


def test_a_raw_value_that_does_not_fit_its_datasheet_is_refused_in_words(tmp_path: Path) -> None:
    facts = replace(ANGLE, sample_form="unsigned integer, 2 octets")
    for raw in (np.array([[2**70]], dtype=object), np.array([["x"]], dtype=object)):
        writer = ParquetWriter(tmp_path / f"{raw.ravel()[0]}.parquet", (facts,), STATION, wide=False)
        writer.add_entry(block(raw, np.array([[1.0]])))
        with pytest.raises(BadDataError) as refused:
            writer.finish()
        assert refused.value.message.startswith(
            f"A raw value of {facts.label} of {ARM} is no unsigned integer, 2 octets: "
        )
        writer.close()


def test_rows_of_a_group_in_parquet_are_of_all_if_there_is_no_group(tmp_path: Path) -> None:
    rows = GroupRows("x", ((ARM, 1),), np.array([1.5]), np.array([[2.5]]), np.array([[0.0]]))
    for group, name in (("", "all"), ("crane", "crane")):
        path = tmp_path / f"{name}.parquet"
        writer = ParquetWriter(path, (ANGLE,), replace(STATION, group=group), wide=True)
        writer.add_entry(rows)
        writer.finish()
        read = [entry for entry in open_recording(path).entries() if isinstance(entry, GroupRows)]
        assert [one.group for one in read] == [name]


# -- MCAP and converting -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "content", [b"", b"\1\0\2", struct.pack("<HHI", 1, 1, 2) + b"\xff\xfe", struct.pack("<HHI", 1, 1, 99)]
)
def test_a_channel_record_that_is_torn_or_no_text_is_damaged(content: bytes) -> None:
    made: Any = SimpleNamespace(_bad=BadDataError)
    with pytest.raises(BadDataError, match="a channel record is damaged"):
        McapRecording._topic(made, content, {})
    if len(content) != 4:
        with pytest.raises(BadDataError, match="a metadata record is damaged"):
            McapRecording._metadata(made, content[4:] or b"\1")


def test_a_conversion_leaves_neither_its_folder_nor_open_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "run.csv"
    open_before = len(os.listdir("/proc/self/fd"))

    def fails() -> None:
        with converting._folder_for(target) as folder:
            (folder / "run.csv").write_text("x")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fails()
    assert list(tmp_path.iterdir()) == []
    assert len(os.listdir("/proc/self/fd")) == open_before

    def refuse(*_: Any) -> None:
        raise OSError("no locks here")

    left = tmp_path / ".run.csv.0123456789abcdef.teds-part"
    left.mkdir()
    monkeypatch.setattr(converting, "lock", refuse)
    with converting._folder_for(target) as folder:
        assert folder.is_dir()
        assert left.is_dir(), "it may be held: without locks nobody can say"
    assert len(os.listdir("/proc/self/fd")) == open_before
    monkeypatch.undo()
    converting._sweep(target)
    assert list(tmp_path.iterdir()) == []
    converting._sweep(tmp_path / "gone" / "run.csv")


def test_a_conversion_to_parquet_that_fails_closes_its_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    closed: list[int] = []

    class Writer:
        def __init__(self, *_: Any, **__: Any) -> None: ...

        def add_entry(self, _entry: Any) -> None:
            raise BadDataError("damaged")

        def close(self) -> None:
            closed.append(1)

    monkeypatch.setattr(converting, "ParquetWriter", Writer)
    recording: Any = SimpleNamespace(station=STATION, facts={})
    with pytest.raises(BadDataError):
        converting._as_parquet(tmp_path / "run.parquet", iter([block()]), recording, wide=False, units="si")
    assert closed == [1]


def test_the_log_of_a_parquet_file_is_read_as_far_as_it_is_one(tmp_path: Path) -> None:
    made = _parquet(tmp_path / "run.parquet", [block()])
    made._log = [5, None, {"event": "note", "why": "moved"}, {"event": "status", "uuid": 7}]
    entries = list(made.entries())
    assert [entry for entry in entries if isinstance(entry, Note)] == [Note(0.0, "moved")]
    assert entries[-1] == Note(0.0, "moved")


def test_a_missing_raw_text_is_no_octets() -> None:
    large = 2**70
    assert _exact(pa.array(["7", None, "ff00", "", str(large)])).tolist() == [7, b"", b"\xff\0", b"", large]


def test_counts_that_began_anew_in_this_file_are_not_negative() -> None:
    """A measurement that is begun again into the same file counts from 0."""
    summary = RecordingSummary()
    summary.add_entry(NodeReport(ARM, "running", samples=100, lost=5, late=4, bad=3, invalid=2))
    last = NodeReport(ARM, "ended", samples=130, lost=1, late=6, bad=0, invalid=2)
    found = summary._of_this_file(last)
    assert (found.samples, found.lost, found.late, found.bad, found.invalid) == (30, 0, 2, 0, 0)


def test_of_a_recording_no_more_nodes_and_channels_are_counted_than_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_summary, "MOST", replace(source.MOST, channels=2))
    summary = RecordingSummary()
    summary.add_entry(tuple(replace(ANGLE, number=number) for number in (1, 2, 3)))
    for uuid in (ARM, HAND, "ff" * 10):
        summary.add_entry(NodeReport(uuid, "running"))
    assert list(summary.facts) == [(ARM, 1), (ARM, 2)]
    assert list(summary.reports) == [ARM, HAND]
