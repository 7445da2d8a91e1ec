"""Recorders: what stands in a file is what was measured, whatever the names, the raw values, the disk or a kill do."""

from __future__ import annotations

import csv
import errno
import io
import json
import os
import re
import signal
import struct
import subprocess
import sys
import time
import zlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from teds_provision.errors import (
    BadDataError,
    NotFoundError,
    StoreError,
    StoreLockedError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.measure.blocks import (
    Block,
    ChannelFacts,
    ClockSet,
    GroupRows,
    InvalidValues,
    NodeReport,
    StationFacts,
)
from teds_provision.measure.sinks import ThreadedSink, as_sink_failure, files, json_events, open_sink
from teds_provision.measure.sinks.files import Part
from teds_provision.measure.sinks.mcap.recording import SAMPLES, TYPE, McapSink, plain_samples
from teds_provision.measure.sinks.mcap.recording import samples as sample_records
from teds_provision.measure.sinks.mcap.recover import recover
from teds_provision.measure.sinks.mcap.writer import MAGIC, McapSummary, text
from teds_provision.measure.sinks.mcap.writer import record as mcap_record
from teds_provision.measure.sinks.mcap.zstandard_frames import compress_frame
from teds_provision.measure.sinks.text import TextSink
from teds_provision.measure.sinks.wide import WideSink
from teds_provision.teds.units import parse_units
from tests.cli.shell import call, unmeasured_environment
from tests.faults.disk import build_library, put_back
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, HAND, STATION, block, blocks, fill
from tests.pace import best_of, until


def record(
    path: Path,
    items: Iterable[Block | NodeReport | list[ChannelFacts]],
    facts: Any = (ANGLE,),
    station: StationFacts = STATION,
) -> tuple[str, ...]:
    sink = open_sink(str(path))
    sink.open(facts, station)
    fill(sink, items)
    assert sink.stats.dropped == 0
    return sink.files


def rows(text: str, comma: str = ",") -> list[dict[str, str]]:
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    return list(csv.DictReader(io.StringIO("\n".join(lines)), delimiter=comma))


def samples(path: Path) -> list[tuple[str, Any, int]]:
    """Topic, decoded message and log time of each message of streams, read by mcap's own reader and by rosbags."""
    store = get_typestore(Stores.ROS2_JAZZY)
    store.register(get_types_from_msg(SAMPLES, TYPE))
    with path.open("rb") as file:
        found = list(make_reader(file).iter_messages())
    return [
        (channel.topic, store.deserialize_cdr(message.data, TYPE), message.log_time)
        for schema, channel, message in found
        if schema is not None and schema.name == TYPE
    ]


def floats(path: Path) -> dict[str, list[tuple[int, float]]]:
    """Log time and value of each message of Float64, by topic, read by mcap's own reader and by rosbags."""
    store, found = get_typestore(Stores.ROS2_JAZZY), {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            if schema is not None and schema.name == "std_msgs/msg/Float64":
                value = store.deserialize_cdr(message.data, schema.name).data
                found.setdefault(channel.topic, []).append((message.log_time, value))
    return found


def test_an_mcap_has_a_topic_of_each_channel_that_viewers_plot_unless_it_is_left_out(tmp_path: Path) -> None:
    data = block([[10, 20], [11, 21]], valid=[[True, False], [True, True]], channels=(1, 2))
    with_scalars, without = tmp_path / "run.mcap", McapSink(tmp_path / "bare.mcap", scalars=False)
    record(with_scalars, [data])
    without.open((ANGLE,), STATION)
    fill(without, [data])
    found = floats(with_scalars)
    assert set(found) == {"/bench/arm/angle", "/bench/arm/ch2"}
    times = [logged for _, _, logged in samples(with_scalars)]
    assert [at for at, _ in found["/bench/arm/angle"]] == times
    np.testing.assert_array_equal([value for _, value in found["/bench/arm/angle"]], data.value[:, 0])
    assert np.isnan(found["/bench/arm/ch2"][0][1])
    assert floats(tmp_path / "bare.mcap") == {}
    assert len(samples(tmp_path / "bare.mcap")) == 2


def test_a_csv_says_what_a_reader_needs_then_has_raw_beside_calibrated(tmp_path: Path) -> None:
    record(tmp_path / "run.csv", [block([[10], [20]], valid=[[True], [False]])])
    text = (tmp_path / "run.csv").read_text()
    [facts] = [json.loads(line.partition(": ")[2]) for line in text.splitlines() if line.startswith("# channel: ")]
    assert facts["uuid"] == ARM
    assert facts["unit"] == "rad"
    assert facts["low"] == 0.0, "a limit of nought is one"
    assert (facts["calibrated"], facts["uncertainty"], facts["fingerprint"]) == ("2026-03-01", 0.0087, "ab" * 32)
    assert "clock" in text.splitlines()[0]
    first, second = rows(text)
    assert first["arm/angle [rad]"] == "1"
    assert first["arm/angle raw"] == "10"
    assert float(second["time"]) == pytest.approx(1_795_000_000.01, abs=1e-6)
    assert second["arm/angle [rad]"] == "", "an invalid value is empty"
    assert second["arm/angle raw"] == "20", "its raw value is kept"
    assert first["clock_error"] == "0.0001"


@given(blocks())
@example(block(np.array([[2**63 + 1]], dtype=np.uint64), [[1.0]]))
@example(block(np.array([[b"\x01\xff"]], dtype=object), [[0.0]], [[False]]))
@settings(max_examples=40)
def test_every_block_comes_back_from_text(data_block: Block) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.txt"
        record(path, [data_block], facts=())
        got = rows(path.read_text(), "\t")
    assert len(got) == len(data_block.time)
    for k, row in enumerate(got):
        assert int(row["index"]) == data_block.index + k
        for column, number in enumerate(data_block.channels):
            name = f"{ARM}/channel {number}"
            raw = data_block.raw[k, column]
            if isinstance(raw, bytes):
                assert bytes.fromhex(row[f"{name} raw"]) == raw
            elif data_block.raw.dtype.kind == "f":
                assert float(row[f"{name} raw"]) == raw
            else:
                assert int(row[f"{name} raw"]) == raw
            assert (row[name] != "") == data_block.valid[k, column]
            if data_block.valid[k, column]:
                assert float(row[name]) == pytest.approx(data_block.value[k, column], rel=1e-11)


@given(blocks())
@settings(max_examples=25)
def test_every_block_comes_back_from_mcap_by_foreign_readers(data_block: Block) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        record(path, [data_block])
        got = samples(path)
    assert [topic for topic, _, _ in got] == ["/bench/arm/stream_0"] * len(data_block.time)
    for k, (_, message, logged) in enumerate(got):
        assert (message.index, message.tick) == (data_block.index + k, data_block.tick[k])
        assert abs(logged / 1e9 - data_block.time[k]) < 1e-6
        assert message.stamp.sec == logged // 10**9
        np.testing.assert_array_equal(message.value, data_block.value[k])
        raw = message.raw_float if data_block.raw.dtype.kind == "f" else message.raw
        np.testing.assert_array_equal(raw, data_block.raw[k])
        assert message.clock_error == data_block.clock_error


def test_a_message_of_mcap_says_what_is_not_known_or_no_measurement_and_forgets_it_in_the_next(tmp_path: Path) -> None:
    """The next message of the same stream begins anew; of the largest raw values the bits are kept."""
    odd = block(np.array([[2**63 + 1]], dtype=np.uint64), [[np.nan]], [[False]], clock_error=None, test_pattern=True)
    plain = block(np.array([[7]], dtype=np.uint64), [[0.5]], index=1)
    record(tmp_path / "run.mcap", [odd, plain])
    first, second = (message for _, message, _ in samples(tmp_path / "run.mcap"))
    assert (first.raw.tolist(), second.raw.tolist()) == ([1 - 2**63], [7])
    assert np.isnan([first.clock_error, *first.value]).all()
    assert (first.test_pattern, second.test_pattern) == (True, False)
    assert (second.clock_error, second.value.tolist()) == (1e-4, [0.5])


def test_an_integer_that_no_float_can_hold_is_no_number_in_mcap_and_ends_no_recording(tmp_path: Path) -> None:
    """A sample may have 255 octets; what a node sends must not end the recording of all others."""
    raw = np.empty((3, 1), dtype=object)
    raw[:, 0] = [2**1030, 2**70, b"\1\2"]
    record(tmp_path / "run.mcap", [block(raw, [[np.nan]] * 3, [[False]] * 3), block(index=3)])
    found = [message.raw_float.tolist() for _, message, _ in samples(tmp_path / "run.mcap")][:3]
    np.testing.assert_array_equal(found, [[np.nan], [2.0**70], [np.nan]])
    assert len(samples(tmp_path / "run.mcap")) == 6


@pytest.mark.parametrize("step", ["_process_item", "_idle", "_finish"])
def test_a_bug_in_a_recorder_is_its_failure_and_no_end_in_order(
    tmp_path: Path, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """People saw `ended` and no error, while the measurement went on and nothing was written."""

    def broken(*_words: object) -> None:
        raise OverflowError("int too large to convert to float")

    sink = open_sink(str(tmp_path / "run.csv"))
    monkeypatch.setattr(sink, step, broken)
    sink.open([ANGLE], STATION)
    sink.write(block())
    if step != "_finish":
        until(lambda: sink.stats.state == "failed")
    sink.close()
    assert (sink.stats.state, sink.stats.error) == ("failed", f"{sink.name}: unexpected OverflowError.")


@given(blocks())
@settings(max_examples=25)
def test_every_block_comes_back_from_json_lines(data_block: Block) -> None:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "run.jsonl"
        record(path, [data_block])
        lines = [json.loads(line) for line in path.read_text().splitlines()]
    data = [line for line in lines if line["event"] == "data"]
    assert [line["channel"] for line in data] == list(data_block.channels)
    for column, line in enumerate(data):
        assert line["valid"] == data_block.valid[:, column].tolist()
        assert line["raw"] == data_block.raw[:, column].tolist()
        expected = [v if g else None for v, g in zip(data_block.value[:, column].tolist(), line["valid"], strict=True)]
        assert line["value"] == expected
        assert len(line["time"]) == len(data_block.time)


def test_channels_in_any_order_keep_their_columns(tmp_path: Path) -> None:
    record(tmp_path / "run.csv", [block([[30, 10]], channels=(3, 1))], facts=())
    [row] = rows((tmp_path / "run.csv").read_text())
    assert (row[f"{ARM}/channel 1 raw"], row[f"{ARM}/channel 3 raw"]) == ("10", "30")
    assert (row[f"{ARM}/channel 1"], row[f"{ARM}/channel 3"]) == ("1", "3")


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "mcap"])
def test_a_recording_is_never_written_over(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"run.{suffix}"
    path.write_text("the last run")
    assert record(path, [block()]) == (str(tmp_path / f"run.2.{suffix}"),)
    assert path.read_text() == "the last run"


def test_a_node_that_comes_late_begins_a_part_that_is_complete_in_itself(tmp_path: Path) -> None:
    late = block([[7]], uuid=HAND, channels=(2,))
    files = record(tmp_path / "run.csv", [block(), [FORCE], late, block([[9]], index=3)])
    assert files == (str(tmp_path / "run.csv"), str(tmp_path / "run.2.csv"))
    got = rows(Path(files[1]).read_text())
    assert [row["uuid"] for row in got] == [HAND, ARM]
    assert got[0]["hand/force [N]"] == "0.7"
    assert got[0]["arm/angle [rad]"] == ""
    assert Path(files[1]).read_text().count("# channel: ") == 2


def test_another_datasheet_begins_a_part_and_the_same_one_does_not(tmp_path: Path) -> None:
    other = ChannelFacts(ARM, "arm", 1, "angle", unit="rad", fingerprint="ef" * 32)
    files = record(tmp_path / "run.csv", [block(), [ANGLE], block(index=3), [other], block(index=6)])
    assert len(files) == 2
    assert "ef" * 32 in Path(files[1]).read_text()


def test_every_part_of_an_mcap_declares_the_topics_of_its_own_values(tmp_path: Path) -> None:
    """Also those of a node without a datasheet; a part without them could not be read."""
    bare = block([[7], [9]], uuid=HAND, channels=(2,))
    sink = McapSink(tmp_path / "run.mcap")
    sink._prepare((ANGLE,), STATION)
    sink._begin()
    sink._process_item(block())
    sink._process_item(bare)
    sink._new_part()
    sink._process_item(block(index=3))
    sink._process_item(bare)
    sink._close_part()
    assert sink.files == (str(tmp_path / "run.mcap"), str(tmp_path / "run.2.mcap"))
    for file in sink.files:
        found = floats(Path(file))
        assert {topic: [value for _, value in values] for topic, values in found.items()} == {
            "/bench/arm/angle": [0.1, 0.2, 0.3],
            "/bench/n8d4d9da6/ch2": [0.7, 0.9],
        }


def test_names_from_datasheets_break_neither_csv_nor_spreadsheet(tmp_path: Path) -> None:
    hostile = ChannelFacts(ARM, '=cmd|"x"', 1, "a,b\n\x1b[31m")
    record(tmp_path / "run.csv", [block()], facts=[hostile])
    text = (tmp_path / "run.csv").read_text()
    assert "\x1b" not in text
    heads = next(csv.reader([line for line in text.splitlines() if not line.startswith("#")]))
    assert len(heads) == 7
    assert heads[5].startswith("'=")


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "mcap"])
def test_a_test_pattern_is_marked_in_every_line(tmp_path: Path, suffix: str) -> None:
    nothing = [[False]] * 3
    station = StationFacts("bench", test_pattern=True)
    path = tmp_path / f"run.{suffix}"
    record(path, [block(valid=nothing, test_pattern=True)], station=station)
    if suffix == "csv":
        assert [row["note"] for row in rows(path.read_text())] == ["test pattern"] * 3
        assert "TEST PATTERN" in path.read_text()
    elif suffix == "jsonl":
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        assert all(line["test_pattern"] for line in lines if line["event"] in ("data", "recording"))
    else:
        assert all(message.test_pattern for _, message, _ in samples(path))


def test_an_mcap_holds_the_facts_where_its_users_look(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, [block(), NodeReport(ARM, "lost", "no frame for 1 s", lost=3, time=1_795_000_001.0)])
    with path.open("rb") as file:
        reader = make_reader(file)
        summary = reader.get_summary()
        metadata = {metadata.name: metadata.metadata for metadata in reader.iter_metadata()}
        strings = {
            c.topic: m.data[8:-1].decode()
            for s, c, m in reader.iter_messages()
            if s and s.name == "std_msgs/msg/String"
        }
    assert summary is not None
    [stream] = [channel for channel in summary.channels.values() if channel.topic == "/bench/arm/stream_0"]
    assert json.loads(stream.metadata["channels"])[0]["fingerprint"] == "ab" * 32
    assert metadata["channel"]["unit"] == "rad"
    assert metadata["measurement"]["group"] == "crane"
    assert json.loads(strings["/bench/arm/teds"])["channels"][0]["calibrated"] == "2026-03-01"
    assert json.loads(strings["/bench/reports"])["lost"] == 3


def test_a_node_that_is_tried_again_gets_one_line_until_something_changes(tmp_path: Path) -> None:
    path, times = tmp_path / "run.csv", iter(range(100))

    def refused(why: str, state: str = "refused") -> NodeReport:
        return NodeReport(ARM, state, why, time=1_795_000_000.0 + next(times))

    other = refused("TEDS 3 of channel 1 has another digest; again in 8 s")
    tries = [refused(f"the station is not trusted; again in {pause} s") for pause in (1, 2, 4, 8)]
    back = NodeReport(ARM, "running", time=1_795_000_050.0)
    record(path, [block(), *tries, other, tries[0], back, tries[1], tries[2]])
    lines = [line for line in path.read_text().splitlines() if line.startswith("# ") and " refused: " in line]
    assert [line.partition("; ")[2] for line in lines] == [
        "the station is not trusted; again in 1 s",
        "TEDS 3 of channel 1 has another digest; again in 8 s",
        "the station is not trusted; again in 1 s",
        "the station is not trusted; again in 2 s",  # it ran meanwhile
    ]


def test_chunks_of_an_mcap_are_small(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    record(path, [block(np.full((100, 8), 5), channels=tuple(range(1, 9)), index=100 * k) for k in range(20)])
    with path.open("rb") as file:
        chunks = [record for record in StreamReader(file, emit_chunks=True).records if type(record).__name__ == "Chunk"]
    assert len(chunks) > 3
    assert all(record.uncompressed_size < (1 << 16) + 100 * (300 + 8 * 47) for record in chunks), (
        "64 KiB, and the block that filled it"
    )


@pytest.mark.parametrize("octets", [30, 400, 3000, None])
def test_an_mcap_that_was_cut_anywhere_is_made_whole(tmp_path: Path, octets: int | None) -> None:
    path = tmp_path / "run.mcap"
    record(path, [block(index=3 * k) for k in range(50)])
    whole = path.read_bytes()
    before = len(samples(path))
    footer = whole.rfind(b"\x0f\x04\x00\x00\x00\x00\x00\x00\x00")
    path.write_bytes(whole[: footer if octets is None else octets])
    done = recover(path)
    assert not done.was_whole
    got = samples(path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == done.messages
    if octets is None:
        assert len(got) == before
        assert done.until is not None
    again = recover(path)
    assert again.was_whole
    assert again.messages == done.messages


def test_what_is_no_recording_is_refused_by_recover(tmp_path: Path) -> None:
    with pytest.raises(NotFoundError):
        recover(tmp_path / "nothing.mcap")
    (tmp_path / "words.mcap").write_text("these are words, not records")
    with pytest.raises(BadDataError):
        recover(tmp_path / "words.mcap")


Finished = tuple[bytes, list[tuple[int, int]], list[float]]


@pytest.fixture(scope="module")
def long(tmp_path_factory: pytest.TempPathFactory) -> Finished:
    """A finished recording of many chunks: its octets, where each chunk begins and ends, times of its samples."""
    path = tmp_path_factory.mktemp("long") / "run.mcap"
    sink = McapSink(path)
    sink.open([ANGLE], STATION)
    for k in range(16):  # each block in a chunk of its own, however busy the machine is
        sink.write(block(index=3 * k, start=1e9 + k))
        until(lambda k=k: sink.stats.written == 3 * (k + 1) and not sink._out.chunk_octets)
    sink.close()
    chunks, octets, at = [], path.read_bytes(), 8
    while octets[at] != 0x0F:
        length = int.from_bytes(octets[at + 1 : at + 9], "little")
        if octets[at] == 0x06:
            chunks.append((at, at + 9 + length))
        at += 9 + length
    assert len(chunks) >= 14
    return octets, chunks, readable(path)


def readable(path: Path) -> list[float]:
    """Times of all samples, as a strict reader finds them by the index."""
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert len(list(reader.iter_messages())) == summary.statistics.message_count
    return [pair[2] / 1e9 for pair in samples(path)]


@pytest.mark.parametrize(
    "shape", ["a bit", "a zero page", "the length", "the first chunk", "two places", "no end either"]
)
def test_damage_inside_costs_the_damaged_chunk_alone(long: Finished, tmp_path: Path, shape: str) -> None:
    octets, chunks, before = long  # the first chunk holds schemas alone
    hurt, path = bytearray(octets), tmp_path / "run.mcap"
    begin, end = chunks[0 if shape == "the first chunk" else 7]
    lost = 3
    if shape == "a zero page":  # the chunk, its index and the head of the next one
        hurt[begin - 20 : chunks[8][0] + 4] = bytes(chunks[8][0] + 24 - begin)
        lost = 6
    elif shape == "the length":
        hurt[begin + 3] ^= 0x10
    else:
        hurt[end - 20] ^= 0x04
    if shape == "two places":
        hurt[chunks[11][1] - 20] ^= 0x01
        lost = 6
    if shape == "no end either":
        del hurt[chunks[-1][0] + 30 :]
        lost = 6
    path.write_bytes(bytes(hurt))
    done = recover(path)
    assert path.read_bytes() == bytes(hurt), "the original stays"
    assert done.output == tmp_path / "run.mcap.recovered"
    assert len(done.damaged) == (2 if shape == "two places" else 1)
    assert done.damaged[0].offset <= begin < done.damaged[0].offset + done.damaged[0].octets
    left = readable(done.output)
    assert set(left) <= set(before)
    assert len(before) - len(left) <= lost
    if shape != "no end either":
        assert left[-1] == before[-1], "everything behind it stays"
    assert recover(done.output).was_whole
    with pytest.raises(UsageError, match="already exists"):
        recover(path)
    assert recover(path, tmp_path / "other.mcap").output == tmp_path / "other.mcap"


def test_no_octet_that_is_wrong_costs_more_than_its_chunk_or_changes_the_file(long: Finished, tmp_path: Path) -> None:
    octets, _, before = long
    for count, place in enumerate(range(9, len(octets) - 1, 127)):
        path = tmp_path / f"{count}.mcap"
        hurt = bytearray(octets)
        hurt[place] ^= 0xFF
        path.write_bytes(bytes(hurt))
        done = recover(path)
        assert done.messages >= len(before) - 3
        if place < len(octets) - 8:  # else it has lost the mark of its end, and gets it again
            assert path.read_bytes() == bytes(hurt)
        if done.output is not None:
            assert len(readable(done.output)) >= len(before) - 3


@pytest.mark.parametrize("summary", ["whole", "damaged", "says nothing of it"])
def test_topics_of_a_damaged_chunk_come_from_the_summary_then_from_the_chunk(tmp_path: Path, summary: str) -> None:
    """The summary has a checksum that is right, the damaged chunk has one that is wrong."""
    kind = text("std_msgs/msg/Float64") + text("ros2msg") + text("float64 data")
    schema = mcap_record(0x03, struct.pack("<H", 1) + kind)
    topic = mcap_record(0x04, struct.pack("<HH", 1, 1) + text("/bench/x") + text("cdr") + struct.pack("<I", 0))
    message = mcap_record(0x05, struct.pack("<HIQQ", 1, 0, 5, 5) + bytes(8))
    packed = compress_frame(message)
    content, whole = schema + topic, McapSummary()
    octets = MAGIC + mcap_record(0x01, text("ros2") + text(""))
    head = struct.pack("<QQQI", 0, 0, len(content), zlib.crc32(content)) + text("") + struct.pack("<Q", len(content))
    octets += mcap_record(0x06, head + content.replace(b"/bench/x", b"/bench/y"))
    head = struct.pack("<QQQI", 5, 5, len(message), zlib.crc32(message)) + text("zstd")
    octets += mcap_record(0x06, head + struct.pack("<Q", len(packed)) + packed)
    if summary != "says nothing of it":
        whole.schemas, whole.channels = {1: schema}, {1: topic}
    octets += whole.tail(len(octets))
    if summary == "damaged":
        octets = octets[:-20] + bytes([octets[-20] ^ 1]) + octets[-19:]
    path = tmp_path / "run.mcap"
    path.write_bytes(octets)
    done = recover(path)
    assert done.output is not None
    with done.output.open("rb") as file:
        found = [(schema.name, schema.data, channel.topic) for schema, channel, _ in make_reader(file).iter_messages()]
    name = "/bench/x" if summary == "whole" else "/bench/y"
    assert found == [("std_msgs/msg/Float64", b"float64 data", name)]


@pytest.mark.parametrize("behind", [True, False], ids=["a good record behind it", "nothing good behind it"])
def test_damage_before_a_good_record_is_no_torn_end(tmp_path: Path, behind: bool) -> None:
    """In a file without an end, what is damaged behind the last good record is where the writer was cut."""
    message = mcap_record(0x05, struct.pack("<HIQQ", 1, 0, 5, 5) + bytes(8))
    packed = bytearray(compress_frame(message))
    packed[-1] ^= 0xFF
    octets = MAGIC + mcap_record(0x01, text("ros2") + text(""))
    at = len(octets)
    head = struct.pack("<QQQI", 5, 5, len(message), zlib.crc32(message)) + text("zstd")
    octets += mcap_record(0x06, head + struct.pack("<Q", len(packed)) + packed)
    damaged = len(octets) - at
    if behind:
        octets += mcap_record(0x0C, text("station") + struct.pack("<I", 0))  # metadata
    path = tmp_path / "run.mcap"
    path.write_bytes(octets + b"\x05\xff")
    done = recover(path)
    assert [(each.offset, each.octets) for each in done.damaged] == ([(at, damaged)] if behind else [])


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_whatever_is_behind_a_recording_that_was_cut_its_whole_records_stay(
    long: Finished, tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    octets, chunks, _ = long
    cut = data.draw(st.integers(9, chunks[-1][1]))
    rubbish = data.draw(st.sampled_from([b"", bytes(4096), b"\xff" * 300]) | st.binary(max_size=60))
    assume(MAGIC not in rubbish)  # a file that ends with it is one with damage inside, and reported as that
    path = tmp_path_factory.mktemp("cut") / "run.mcap"
    path.write_bytes(octets[:cut] + rubbish)
    done = recover(path)
    assert not done.damaged
    kept = [end for _, end in chunks if end <= cut]
    assert path.read_bytes()[: kept[-1] if kept else 8] == octets[: kept[-1] if kept else 8]
    assert len(samples(path)) == 3 * max(0, len(kept) - 1), "the first chunk holds schemas alone"
    assert recover(path).was_whole


@pytest.mark.parametrize("name", ["run.mcap", "run.csv", "run.jsonl"])
def test_a_file_whose_recorder_writes_is_refused(tmp_path: Path, name: str) -> None:
    sink = open_sink(str(tmp_path / name))
    sink.open([ANGLE], STATION)
    try:
        sink.write(block())
        until(lambda: (tmp_path / name).stat().st_size > 8, "nothing is written")
        with pytest.raises(StoreLockedError, match="is being recorded right now"):
            recover(tmp_path / name)
    finally:
        sink.close()


def test_a_folder_that_is_not_there_is_reported_before_anything_is_measured(tmp_path: Path) -> None:
    with pytest.raises(TedsProvisionError, match="folder"):
        open_sink(str(tmp_path / "no" / "run.csv")).open([ANGLE], STATION)
    with pytest.raises(UsageError, match="Unsupported format"):
        open_sink("run.xlsx")


RECORDER = """
import sys, time, resource
sys.dont_write_bytecode = True
sys.path.insert(0, {root!r})
from dataclasses import replace
from pathlib import Path
from tests.cli.shell import call, unmeasured_environment
from tests.faults.disk import build_library, put_back
from tests.measure.sinks.parts import ANGLE, STATION, block
from teds_provision.measure.sinks import open_sink
if {limit}: resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))
sinks = [open_sink({folder!r} + "/run." + suffix) for suffix in ("csv", "jsonl", "mcap")]
for sink in sinks: sink.open([ANGLE], STATION)
print("ready", flush=True)
k, begin = 0, time.monotonic()
while time.monotonic() - begin < {seconds} and not any(sink.stats.error for sink in sinks):
    one = block([[k % 60000 + i] for i in range(10)], index=10 * k, start=time.time() - k / 100, period=0.001)
    for sink in sinks: sink.write(one)
    k += 1
    time.sleep(max(0, begin + k * 0.01 - time.monotonic()))
    if k % 10 == 0: print("sent", one.time[-1], flush=True)
for sink in sinks: sink.close()
for sink in sinks: print("sink", sink.stats.error, sink.stats.hint, flush=True)
"""
ROOT = str(Path(__file__).parents[3])


def recorder(folder: Path, *, limit: int = 0, seconds: float = 20) -> subprocess.Popen[str]:
    code = RECORDER.format(root=ROOT, folder=str(folder), limit=limit, seconds=seconds)
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def test_a_killed_recorder_leaves_files_that_are_readable_to_the_end(tmp_path: Path) -> None:
    tries = iter(range(5))
    best_of(
        5,
        1.0,
        lambda: missing_after_a_kill(tmp_path / str(next(tries))),
        because="one second may pass before a disk has what was written",
    )


def missing_after_a_kill(folder: Path) -> float:
    """Seconds of what was given to three recorders that none of the files has; benchmarks/sinks.py measures how few."""
    folder.mkdir()
    with recorder(folder) as child:
        assert child.stdout is not None
        sent = [line for line, _ in zip(child.stdout, range(16), strict=False)][-1]
        os.kill(child.pid, signal.SIGKILL)
    assert recover(folder / "run.mcap").messages > 0
    *_, last = (folder / "run.jsonl").read_text().splitlines()
    ends = (
        samples(folder / "run.mcap")[-1][2] / 1e9,
        float(rows((folder / "run.csv").read_text())[-1]["time"]),
        json.loads(last)["time"][-1],
    )
    return float(sent.split()[1]) - min(ends)


def test_a_full_disk_ends_the_recording_with_an_error_and_whole_lines(tmp_path: Path) -> None:
    child = recorder(tmp_path, limit=20_000)
    output, _ = child.communicate(timeout=60)
    errors = [line for line in output.splitlines() if line.startswith("sink")]
    assert any("cannot be written" in line for line in errors), "the file size is limited in place of the disk"
    text = (tmp_path / "run.csv").read_bytes()
    assert text.endswith(b"\n")
    for line in (tmp_path / "run.jsonl").read_text().splitlines():
        json.loads(line)
    recover(tmp_path / "run.mcap")


PARTS = """
import sys, time
sys.path.insert(0, {root!r})
from tests.measure.sinks.parts import ANGLE, STATION, block
from teds_provision.measure.blocks import ClockSet
from teds_provision.measure.sinks import open_sink
sinks = [open_sink({folder!r} + "/run." + suffix) for suffix in ("csv", "jsonl", "mcap")]
for sink in sinks:
    sink.open([ANGLE], STATION)
    sink.write(block())
    sink.clock_set(ClockSet(STATION.started, 1.0))
    sink.write(block(index=3))
while sum(len(sink.files) == 2 and sink.stats.written == 6 for sink in sinks) < 3: time.sleep(0.05)
time.sleep(2.5)
print("there", flush=True)
time.sleep(600)
"""


def test_a_part_that_began_a_moment_ago_outlives_a_loss_of_power(tmp_path: Path) -> None:
    """A file whose folder was never brought to the disk is gone with the power, however often it was synced itself.

    The shadow of the fault bench is the disk as it was at the last fsync of each file and folder.
    """
    root, shadow = tmp_path.resolve() / "kept", tmp_path.resolve() / "shadow"
    root.mkdir()
    shadow.mkdir()
    faults = {
        "LD_PRELOAD": str(build_library(tmp_path)),
        "FAULT_ROOTS": str(root),
        "FAULT_SHADOW": str(shadow),
        "FAULT_AT": "1000000",
        "FAULT_HOW": "kill",
        "FAULT_COUNT": str(tmp_path / "count"),
    }
    code = PARTS.format(root=ROOT, folder=str(root))
    environment = unmeasured_environment() | faults
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=environment) as child:
        assert child.stdout is not None
        assert child.stdout.readline() == "there\n"
        os.kill(child.pid, signal.SIGKILL)
    put_back(shadow, root)
    for suffix in ("csv", "jsonl", "mcap"):
        assert (root / f"run.{suffix}").exists(), "the first part"
        assert (root / f"run.2.{suffix}").exists(), "the second"
    recover(root / "run.2.mcap")
    for name in ("run.mcap", "run.2.mcap"):
        assert len(samples(root / name)) == 3, name
    for name in ("run.csv", "run.2.csv"):
        assert len(rows((root / name).read_text())) == 3, name


def test_writing_never_waits_for_the_disk(tmp_path: Path) -> None:
    tries = iter(range(5))

    def waited() -> float:
        path = tmp_path / f"run{next(tries)}.csv"
        sink = open_sink(str(path))
        sink.open([ANGLE], STATION)
        began = time.perf_counter()
        for k in range(200):
            sink.write(block(index=3 * k))
        seconds = time.perf_counter() - began
        sink.close()
        sink.close()
        sink.write(block())
        assert sink.stats.written == 600
        assert len(rows(path.read_text())) == 600
        return seconds

    best_of(5, 2.0, waited, because="the disk may be another process's for a second")


def test_the_command_names_what_is_damaged_and_exits_with_8(long: Finished, tmp_path: Path) -> None:
    octets, chunks, _ = long
    hurt, path = bytearray(octets), tmp_path / "run.mcap"
    hurt[chunks[5][1] - 20] ^= 1
    path.write_bytes(bytes(hurt))
    outcome = call(tmp_path / "home", "--json", "measure", "recover", str(path))
    assert outcome.code == 8
    assert outcome.json["output"] == f"{path}.recovered"
    [damage] = outcome.json["damaged"]
    assert (damage["what"], damage["offset"]) == ("chunk", chunks[5][0])
    assert f"chunk at octet {chunks[5][0]}" in outcome.json["error"]["message"]
    assert call(tmp_path / "home", "measure", "recover", str(path)).code == 2
    again = call(tmp_path / "home", "--json", "measure", "recover", str(path), "--output", str(tmp_path / "b.mcap"))
    assert (again.code, again.json["output"]) == (8, str(tmp_path / "b.mcap"))
    good = call(tmp_path / "home", "--json", "measure", "recover", str(tmp_path / "b.mcap"))
    assert (good.code, good.json["damaged"]) == (0, [])
    assert call(tmp_path / "home", "measure", "8d4d", "--can", "virtual:x", "--output", "y").code == 2


@pytest.mark.parametrize("suffix", ["csv", "txt"])
def test_a_number_sign_in_a_name_begins_no_comment(tmp_path: Path, suffix: str) -> None:
    """As pandas.read_csv(comment="#") reads it: a comment begins at a # outside quotes, wherever in a line."""
    path = tmp_path / f"run.{suffix}"
    record(path, [block()], facts=(replace(ANGLE, node="arm #2", name="motor #1"),))
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    for line in lines:
        assert "#" not in re.sub(r'"(?:[^"]|"")*"', "", line)
    [first, *_] = rows(path.read_text(), "," if suffix == "csv" else "\t")
    assert first["arm #2/motor #1 [rad]"] == "0.1"
    assert first["arm #2/motor #1 raw"] == "1"


def test_of_what_a_full_disk_took_in_part_the_whole_pieces_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, write = Part(tmp_path / "run.csv"), os.write
    part.add(b"head\n")
    part.flush()
    for piece in (b"one\n", b"two\n", b"three\n"):
        part.add(piece, 2)

    def full(file: int, octets: bytes) -> int:
        if len(octets) <= len(b"wo\nthree\n"):
            raise OSError(errno.ENOSPC, "No space left on device")
        return write(file, octets[:5])

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OSError, match="No space"):
        part.flush()
    assert ((tmp_path / "run.csv").read_bytes(), part.size) == (b"head\none\n", 9)
    part.add(b"four\n", 3)
    assert part.abandon() == 7, "what was cut off, and what waits"


def test_another_datasheet_in_an_mcap_has_topics_with_its_own_units(tmp_path: Path) -> None:
    """A reader takes unit and calibration of a value from the metadata of the topic that the value is on."""
    path = tmp_path / "run.mcap"
    degrees = replace(ANGLE, unit="degree", fingerprint="ef" * 32)
    record(path, [block(index=0), [degrees], block(index=3)])
    units: dict[str, list[str]] = {}
    with path.open("rb") as file:
        for _, channel, _ in make_reader(file).iter_messages():
            known = channel.metadata
            if "unit" in known or "channels" in known:
                unit = known["unit"] if "unit" in known else json.loads(known["channels"])[0]["unit"]
                units.setdefault(channel.topic, []).append(unit)
    assert units == dict.fromkeys(("/bench/arm/angle", "/bench/arm/stream_0"), ["rad"] * 3 + ["degree"] * 3)


def test_a_wide_file_of_another_datasheet_is_a_part_of_its_own(tmp_path: Path) -> None:
    path = tmp_path / "run.csv"
    sink = open_sink(f"wide:{path}")
    sink.open([ANGLE], STATION)
    other = replace(ANGLE, fingerprint="ef" * 32)
    for facts in ([ANGLE], [ANGLE], [other], [other]):
        sink.describe(facts)
        value = np.array([[1.0], [2.0]])
        sink.write_group(GroupRows("crane", (ANGLE.key,), np.array([0.0, 1.0]) + 1_795_000_000.0, value, 0 * value))
    sink.close()
    assert sink.files == (str(path), str(tmp_path / "run.2.csv"))
    assert [len(rows(Path(name).read_text())) for name in sink.files] == [4, 4]


def test_a_part_goes_to_the_disk_once_a_second(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    part, synced = Part(tmp_path / "run.csv"), list[float]()
    began = time.monotonic()
    monkeypatch.setattr(os, "fsync", lambda _file: synced.append(now))
    for tenth in range(35):
        now = began + tenth / 10
        part.look(now)
    assert len(synced) == 3
    part.abandon()


def test_a_recording_has_as_many_parts_as_its_error_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "PARTS", 3)
    for name in ("run.csv", "run.2.csv", "run.3.csv"):
        sink = open_sink(str(tmp_path / "run.csv"))
        sink.open([ANGLE], STATION)
        sink.close()
        assert [Path(file).name for file in sink.files] == [name]
    with pytest.raises(TedsProvisionError, match="There are 3 parts of"):
        open_sink(str(tmp_path / "run.csv")).open([ANGLE], STATION)


def at_hand(path: Path) -> TextSink:
    """Return a recorder that is open, without its thread."""
    sink = TextSink(path)
    sink._prepare((ANGLE,), STATION)
    sink._begin()
    return sink


def test_a_part_that_is_larger_than_its_limit_is_the_last_of_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = at_hand(tmp_path / "run.csv")
    sink._guarded_item(block())
    sink.part.flush()
    size = sink.part.size
    for limit, parts in ((size, 1), (size - 1, 2)):
        monkeypatch.setattr(files, "LARGEST_PART", limit)
        sink._guarded_idle(time.monotonic())
        assert len(sink.files) == parts
    sink._finish()
    assert [len(rows(Path(name).read_text())) for name in sink.files] == [3, 0]


@pytest.mark.parametrize(
    ("number", "what"),
    [(errno.ENOSPC, "disk was full"), (errno.EDQUOT, "quota of the disk was used up"), (errno.EIO, "")],
)
def test_a_recording_pauses_on_a_full_disk_or_quota_until_a_mebibyte_is_free_and_on_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, what: str
) -> None:
    sink = at_hand(tmp_path / "run.csv")
    sink.part.flush()

    def fails(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as patched:
        patched.setattr(Part, "flush", fails)
        patched.setattr(files, "PIECE", 1)
        if not what:
            with pytest.raises(OSError, match="Input/output"):
                sink._guarded_item(block())
            return
        sink._guarded_item(block())
    sink._guarded_item((replace(ANGLE, name="elbow"),))
    sink._guarded_item(block(index=3))
    sink._guarded_item(ClockSet(1_795_000_100.0, 50.0))
    assert (sink.stats.state, sink.stats.dropped) == ("waiting", 6)
    began = sink._tried
    for free, after, parts in ((1 << 20, 0.9, 1), ((1 << 20) - 1, 1.0, 1), (1 << 20, 1.9, 1), (1 << 20, 2.0, 2)):
        monkeypatch.setattr(os, "statvfs", lambda _place, free=free: SimpleNamespace(f_bavail=free, f_frsize=1))
        sink._guarded_idle(began + after)
        assert len(sink.files) == parts, (free, after)
    assert sink.stats.state == "running"
    sink._guarded_item(block(index=6))
    sink._close_part()
    last = Path(sink.files[-1]).read_text()
    assert re.search(rf"# \S+ The {what} from \S+ to \S+: 6 values are not recorded\.", last)
    assert "The system clock was set forward by 50.000 s" in last
    assert "# started: 2026-11-18T11:07:30" in last, "by the clock as it is now"
    assert [row["arm/elbow raw"] for row in rows(last)] == ["1", "2", "3"], "what was learned meanwhile counts"


@pytest.mark.parametrize(("suffix", "comma"), [("csv", ","), ("txt", "\t")])
def test_lines_of_a_text_file_are_held_whole(tmp_path: Path, suffix: str, comma: str) -> None:
    """Microseconds, three digits of a bound, twelve of a value; cells of other nodes and of what is not known empty."""
    path = tmp_path / f"run.{suffix}"
    plus = replace(ANGLE, node="+arm", name='a "b"')
    record(
        path,
        [
            block([[10], [20]], [[1 / 3], [9.0]], [[True], [False]], index=7, clock_error=0.00012345),
            block([[-5]], [[2e-7]], uuid=HAND, channels=(2,), clock_error=None, start=1_795_000_000.1234567),
        ],
        facts=[plus, FORCE],
    )
    cells = [
        ["time", "uuid", "index", "clock_error", "note", '"\'+arm/a ""b"" [rad]"', "hand/force [N]",
         '"\'+arm/a ""b"" raw"', "hand/force raw"],
        ["1795000000.070000", ARM, "7", "0.000123", "", "0.333333333333", "", "10", ""],
        ["1795000000.080000", ARM, "8", "0.000123", "", "", "", "20", ""],
        ["1795000000.123457", HAND, "0", "", "", "", "2e-07", "", "-5"],
    ]  # fmt: skip
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    assert lines == [comma.join(line) for line in cells]


@pytest.mark.parametrize("sign", "=+-@")
def test_no_name_begins_as_a_formula_of_a_spreadsheet(tmp_path: Path, sign: str) -> None:
    record(tmp_path / "run.csv", [block()], facts=[replace(ANGLE, node=f"{sign}arm")])
    [head] = [line for line in (tmp_path / "run.csv").read_text().splitlines() if line.startswith("time")]
    assert head.split(",")[5:] == [f"'{sign}arm/angle [rad]", f"'{sign}arm/angle raw"]


@pytest.mark.parametrize(
    ("marks", "note"),
    [({"unsigned": True}, "unsigned datasheet"), ({"unverified": True}, "unverified datasheet"), ({}, "")],
)
def test_a_line_by_a_datasheet_that_is_not_signed_is_marked(tmp_path: Path, marks: dict[str, bool], note: str) -> None:
    """Whichever of the channels of the line it is."""
    second = replace(ANGLE, number=2, name="other", **marks)
    record(tmp_path / "run.csv", [block([[1, 2]], channels=(1, 2))], facts=[ANGLE, second])
    assert [row["note"] for row in rows((tmp_path / "run.csv").read_text())] == [note]


def test_values_are_in_the_file_after_a_tenth_of_a_second_and_not_only_on_the_disk_after_one(tmp_path: Path) -> None:
    part = Part(tmp_path / "run.csv")
    part.add(b"first\n", 3)
    began = part._flushed
    part.look(began + 0.09)
    assert (tmp_path / "run.csv").read_bytes() == b""
    part.look(began + 0.11)
    assert (tmp_path / "run.csv").read_bytes() == b"first\n"
    part.add(b"x" * ((1 << 18) - 1))
    assert part.size == 6
    part.add(b"y")
    assert part.size == 6 + (1 << 18), "a quarter of a mebibyte does not wait"
    part.add(b"lost\n", 7)
    part.lost = 2
    assert part.abandon() == 9, "what is not in the file, whether it was tried or still waits"


def test_each_part_ends_with_the_counts_of_its_nodes_and_the_next_begins_with_them(tmp_path: Path) -> None:
    """Since the counters of a measurement run on; and what happened to the clock is in both, each by its own time."""
    sink = at_hand(tmp_path / "run.csv")
    sink._guarded_item(block())
    sink._guarded_item(NodeReport(ARM, "running", samples=3, lost=1, late=2, bad=4, invalid=5, time=1_795_000_001.0))
    sink._guarded_item(ClockSet(1_795_000_100.0, -50.0))
    sink._finish()
    first, second = (Path(name).read_text().splitlines() for name in sink.files)
    counts = f"{ARM} running: 3 values, lost 1, late 2, bad 4, invalid 5"
    news = "The system clock was set back by 50.000 s; earlier times follow the old clock."
    assert [line[2:] for line in first[-2:]] == [
        f"2026-11-18T11:09:10.000Z {news}", f"2026-11-18T11:06:41.000Z {counts}"
    ]  # fmt: skip
    head = next(place for place, line in enumerate(second) if line.startswith("time,"))
    assert [line[2:] for line in second[head + 1 :]] == [
        f"2026-11-18T11:06:41.000Z {counts}", f"2026-11-18T11:08:20.000Z {news}"
    ]  # fmt: skip
    assert (first[2], second[2]) == (
        "# started: 2026-11-18T11:06:40.000Z; part 1", "# started: 2026-11-18T11:05:50.000Z; part 2"
    )  # fmt: skip


@pytest.mark.parametrize(
    ("gaps", "message"),
    [
        (["one."], "run.csv has 1 gap. one."),
        (["one.", "two."], "run.csv has 2 gaps. one. two."),
        (["one.", "two.", "three.", "four."], "run.csv has 4 gaps. two. three. four."),
    ],
)
def test_a_recording_with_gaps_ends_with_an_error_that_names_the_last_three(
    tmp_path: Path, gaps: list[str], message: str
) -> None:
    sink = at_hand(tmp_path / "run.csv")
    sink._gaps = gaps
    with pytest.raises(StoreError) as caught:
        sink._finish()
    assert (caught.value.message.replace(f"{tmp_path}/", ""), caught.value.hint) == (
        message, "Free some space before the next run; what was written is intact."
    )  # fmt: skip


def test_a_recording_that_ends_on_a_full_disk_says_since_when_and_leaves_no_empty_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = TextSink(tmp_path / "run.csv")
    sink._prepare((ANGLE,), STATION)
    sink._count(dropped=4)
    sink._wait_for_room(OSError(errno.ENOSPC, "x"))
    assert (sink.files, list(tmp_path.iterdir())) == ((), []), "a part without a whole line is none"
    assert re.fullmatch(
        r"The disk is full since \S+: nothing is recorded until space is free\.", sink.stats.detail
    )  # fmt: skip
    sink._guarded_item(block())
    with pytest.raises(StoreError, match=r"has 1 gap\. The disk is full since \S+: 3 values are not recorded\."):
        sink._finish()


@pytest.mark.parametrize(
    ("number", "message", "hint", "code"),
    [
        (errno.ENOSPC, "the disk is full.", "Free some space; everything written so far is intact.", 7),
        (errno.EDQUOT, "the disk quota is used up.", "Free some space; everything written so far is intact.", 7),
        (errno.EFBIG, "the file cannot grow any further.", "Record to another disk, or in shorter runs.", 7),
        (errno.EACCES, "permission denied.", "Check the owner and mode of the folder.", 7),
        (errno.EROFS, "the disk is read-only.", "Record to another disk.", 7),
        (errno.EIO, "Input/output error.", "Check the path.", 7),
        (errno.ENOENT, "its folder is not there.", "Create the folder first.", 3),
    ],
)
def test_what_a_disk_refused_is_said_with_its_remedy(number: int, message: str, hint: str, code: int) -> None:
    error = as_sink_failure(OSError(number, os.strerror(number)), "run.csv")
    assert (error.message, error.hint, error.exit_code) == (f"run.csv cannot be written: {message}", hint, code)


def test_a_recorder_holds_two_million_values_and_ends_with_one_more(tmp_path: Path) -> None:
    sink = TextSink(tmp_path / "run.csv")
    sink._put((ANGLE,), 2_000_000)
    assert sink.stats.state == "starting"
    sink._put((ANGLE,), 1)
    stats = sink.stats
    assert (stats.state, stats.dropped) == ("failed", 0)
    assert stats.error == (
        f"The disk is too slow: {tmp_path}/run.csv owes 2000000 values. The recording has ended."
    )  # fmt: skip
    sink._set_state("running")
    assert sink.stats.state == "failed", "a failure stays"


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "mcap"])
def test_a_sink_of_a_file_counts_values_and_octets(tmp_path: Path, suffix: str) -> None:
    sink = open_sink(str(tmp_path / f"run.{suffix}"))
    sink.open((ANGLE,), STATION)
    fill(sink, [block([[1, 2], [3, 4]], channels=(1, 2))])
    assert (sink.stats.written, sink.stats.dropped) == (4, 0)
    written = sum(Path(name).stat().st_size for name in sink.files)
    assert written == sink.stats.octets or suffix == "mcap"
    assert sink.stats.octets > 0


def test_the_head_of_a_text_says_what_it_is(tmp_path: Path) -> None:
    station = replace(STATION, group="", test_pattern=True)
    twin = replace(FORCE, node="arm", name="angle", unit="")
    unnamed = replace(FORCE, uuid="f" * 20, node="", name="", number=4, unit="")
    record(tmp_path / "run.csv", [block(test_pattern=True)], facts=[ANGLE, twin, unnamed], station=station)
    lines = (tmp_path / "run.csv").read_text().splitlines()
    assert lines[:5] == [
        "# teds-provision measurement, text 1; times are unix seconds, "
        "clock: host's wall clock, node ticks mapped to it",
        "# station: bench; group: none",
        "# started: 2026-11-18T11:06:40.000Z; part 1",
        "# units: SI",
        "# TEST PATTERN: no line of this file is a measurement",
    ]
    [head] = [line.split(",") for line in lines if line.startswith("time,")]
    names = [f"arm/angle {ARM}:1", f"arm/angle {HAND}:2", f"{'f' * 20}/{unnamed.label}"]
    assert head[5:] == [f"{names[0]} [rad]", *names[1:], *(f"{name} raw" for name in names)]
    assert [row["note"] for row in rows("\n".join(lines))] == ["test pattern"] * 3


@pytest.mark.parametrize(
    ("sink", "words"),
    [("run.csv", "as shown to people; each channel states the way to SI"), ("run.jsonl", "shown")],
)
def test_a_file_in_display_units_says_so(tmp_path: Path, sink: str, words: str) -> None:
    shown = open_sink(f"shown:{tmp_path / sink}")
    shown.open((replace(ANGLE, units=parse_units("rad")),), STATION)
    fill(shown, [block()])
    text = (tmp_path / sink).read_text()
    assert (f"# units: {words}\n" in text) or (f'"units":"{words}"' in text.splitlines()[0])
    assert '"si_unit": "rad"' in text or '"si_unit":"rad"' in text


def test_the_lines_of_a_json_recording_are_held_whole(tmp_path: Path) -> None:
    facts = [replace(ANGLE, unsigned=True), replace(FORCE, unverified=True)]
    invalid = block([[1.5], [2.5]], [[0.5], [7.0]], [[True], [False]], index=7, clock_error=None)
    record(
        tmp_path / "run.jsonl",
        [
            replace(invalid, age=0.0123456789, test_pattern=True),
            block([[b"\x01\xff"]], [[1.0]], uuid=HAND, channels=(2,)),
            NodeReport(
                ARM, "lost", "no frame", samples=9, lost=1, late=2, bad=3, invalid=4, clock_error=0.5, time=6.5,
                invalid_why=(InvalidValues(1, "above", 4),),
            ),
        ],
        facts=facts,
        station=replace(STATION, instance="another", test_pattern=True),
    )  # fmt: skip
    head, first, second, data, hand, status = map(json.loads, (tmp_path / "run.jsonl").read_text().splitlines())
    assert head == {
        "event": "recording", "format": "teds-provision/measurement-1", "station": "bench", "group": "crane",
        "started": "2026-11-18T11:06:40.000Z", "clock": "host's wall clock, node ticks mapped to it",
        "test_pattern": True, "units": "si",
    }  # fmt: skip
    assert [(line["event"], line["uuid"], line["number"]) for line in (first, second)] == [
        ("channel", ARM, 1), ("channel", HAND, 2)
    ]  # fmt: skip
    assert (first["low"], "vector" in first, "overdue" in first, "due" in second) == (0.0, False, False, False)
    assert data == {
        "event": "data", "uuid": ARM, "channel": 1, "name": "angle", "unit": "rad", "index": 7,
        "time": [1_795_000_000.07, 1_795_000_000.08], "raw": [1.5, 2.5], "value": [0.5, None], "uncertainty": 0.0087,
        "valid": [True, False], "clock_error": None, "age": 0.012346, "test_pattern": True, "unsigned": True,
    }  # fmt: skip
    assert (hand["raw"], hand["unverified"], "unsigned" in hand) == (["01ff"], True, False)
    assert status == {
        "event": "status", "uuid": ARM, "state": "lost", "why": "no frame", "samples": 9, "lost": 1, "late": 2,
        "bad": 3, "invalid": 4, "invalid_why": [{"channel": 1, "why": "above", "count": 4}], "clock_error": 0.5,
        "time": 6.5,
    }  # fmt: skip


def test_notes_that_come_before_the_first_row_of_a_wide_file_are_in_its_head(tmp_path: Path) -> None:
    sink = WideSink(tmp_path / "run.csv")
    sink._prepare((ANGLE,), STATION)
    sink._begin()
    sink._guarded_item(NodeReport(ARM, "running", samples=3, time=1_795_000_001.0))
    sink._guarded_item(ClockSet(1_795_000_100.0, 50.0))
    value = np.array([[1.5], [np.nan]])
    times = np.array([1_795_000_000.125, 1_795_000_000.25])
    sink._guarded_item(GroupRows("crane", (), times, np.zeros((2, 0)), np.zeros((2, 0))))
    sink._guarded_item(GroupRows("crane", (ANGLE.key,), times, value, 0 * value))
    sink._guarded_item(GroupRows("crane", (ANGLE.key, FORCE.key), times[:1], np.array([[1.0, 2.0]]), np.zeros((1, 2))))
    sink._finish()
    first, second, third = (Path(name).read_text().splitlines() for name in sink.files)
    assert first[-1] == f"# 2026-11-18T11:06:41.000Z {ARM} running: 3 values, lost 0, late 0, bad 0, invalid 0"
    head = next(place for place, line in enumerate(second) if line.startswith("time,"))
    assert second[head:] == [
        "time,arm/angle [rad]",
        f"# 2026-11-18T11:06:41.000Z {ARM} running: 3 values, lost 0, late 0, bad 0, invalid 0",
        "# 2026-11-18T11:08:20.000Z The system clock was set forward by 50.000 s; earlier times follow the old clock.",
        "1795000000.125000,1.5",
        "1795000000.250000,",
    ]
    assert third[-1] == "1795000000.125000,1,2"
    assert (sink.stats.written, sink.stats.messages) == (4, 3)


def test_each_pause_of_a_full_disk_has_its_own_gap_and_the_part_behind_it_all_that_happened(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink = at_hand(tmp_path / "run.csv")
    sink._guarded_item(NodeReport(ARM, "running", samples=3, lost=1, time=1_795_000_001.0))
    sink.part.flush()
    free = [0]
    monkeypatch.setattr(os, "statvfs", lambda _place: SimpleNamespace(f_bavail=free[0], f_bfree=1 << 40, f_frsize=1))

    def pause(*news: ClockSet) -> list[str]:
        """Let the disk be full from within a block, for another one; gives the lines of the next part."""
        free[0] = 0
        sink._guarded_item(block())
        sink._wait_for_room(OSError(errno.ENOSPC, "x"))
        for item in (*news, block()):
            sink._guarded_item(item)
        sink._guarded_idle(sink._tried + 1.0)
        assert sink.stats.state == "waiting", "of what is free only a part is for everybody"
        free[0] = 1 << 20
        sink._guarded_idle(sink._tried + 1.0)
        assert sink.stats.state == "running"
        return Path(sink.files[-1]).read_text().splitlines()

    first = pause(ClockSet(1_795_000_100.0, 50.0), ClockSet(1_795_000_200.0, 30.0))
    assert (sink.stats.written, sink.stats.dropped, len(sink.files)) == (0, 6, 2)
    head = next(place for place, line in enumerate(first) if line.startswith("time,"))
    counts, gap, *news = first[head + 1 :]
    assert counts == f"# 2026-11-18T11:06:41.000Z {ARM} running: 3 values, lost 1, late 0, bad 0, invalid 0"
    assert re.fullmatch(r"# \S+ The disk was full from \S+ to \S+: 6 values are not recorded\.", gap)
    assert [line.partition("set ")[2][:20] for line in news] == ["forward by 50.000 s;", "forward by 30.000 s;"]
    assert re.fullmatch(r"The disk was full from \S+ to \S+: 6 values are not recorded\.", sink.stats.detail)
    second = pause()
    assert not [line for line in second if "clock was set" in line], "that was said"
    assert sink.stats.dropped == 12
    with pytest.raises(StoreError, match=r"has 2 gaps\. The disk was full .*: 6 values .* full .*: 6 values are not"):
        sink._finish()


@pytest.mark.parametrize(("number", "goes_on"), [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.EIO, False)])
def test_a_disk_that_is_full_again_at_the_next_part_is_waited_for_and_a_broken_one_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, goes_on: bool
) -> None:
    sink = at_hand(tmp_path / "run.csv")
    sink._wait_for_room(OSError(errno.ENOSPC, "x"))

    def fails(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Part, "flush", fails)
    if goes_on:
        sink._guarded_idle(sink._tried + 1.0)
        assert (sink.stats.state, sink.files, sink._gaps) == ("waiting", (), [])
    else:
        with pytest.raises(OSError, match="Input/output"):
            sink._guarded_idle(sink._tried + 1.0)
    assert list(tmp_path.iterdir()) == []


def test_facts_before_the_first_value_begin_no_other_part_and_why_values_are_invalid_is_said(tmp_path: Path) -> None:
    """A name with a comma is one cell; octets are hex; a float keeps every digit."""
    odd = replace(ANGLE, node="arm, left", sample_form="float, 8 octets")
    bare = replace(FORCE, number=3, name="octets", unit="")
    why = (InvalidValues(1, "above its high limit", 2),)
    files_made = record(
        tmp_path / "run.csv",
        [
            [odd], [bare],
            block([[0.1234567890123456]], [[0.5]]),
            block(np.array([[b"\x01\xff"]], dtype=object), [[1.0]], uuid=HAND, channels=(3,)),
            NodeReport(ARM, "ended", samples=1, invalid=2, invalid_why=why, time=1_795_000_001.0),
        ],
        facts=[],
    )  # fmt: skip
    assert [Path(name).name for name in files_made] == ["run.csv"]
    text = (tmp_path / "run.csv").read_text()
    assert '"arm, left/angle [rad]"' in text
    first, second = rows(text)
    assert (float(first["arm, left/angle raw"]), second["hand/octets raw"]) == (0.1234567890123456, "01ff")
    assert text.splitlines()[-1] == (
        f"# 2026-11-18T11:06:41.000Z {ARM} ended: 1 values, lost 0, late 0, bad 0, invalid 2"
        " (2 of channel 1: above its high limit)"
    )


def test_a_part_is_on_the_disk_when_it_is_closed_and_readable_by_all_and_none_is_left_that_could_not_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, sizes = Part(tmp_path / "run.csv"), list[int]()
    part.add(b"last\n")
    monkeypatch.setattr(os, "fsync", lambda file: sizes.append(os.fstat(file).st_size))
    before = os.umask(0)
    try:
        part.close()
        with Part(tmp_path / "other.csv").path.open() as file:
            assert os.fstat(file.fileno()).st_mode & 0o777 == 0o644
    finally:
        os.umask(before)
    assert sizes[0] == 5

    def full(_folder: Path) -> None:
        raise OSError(errno.ENOSPC, "x")

    monkeypatch.setattr(files, "sync_folder", full)
    with pytest.raises(OSError, match="x"):
        Part(tmp_path / "third.csv")
    assert not (tmp_path / "third.csv").exists()


class SlowCarrier(ThreadedSink):
    """A live sink whose thread is not started; what waits stays."""

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        """Do nothing."""

    def _process_item(self, item: Any) -> None:
        """Do nothing."""

    def _finish(self) -> None:
        raise OSError(errno.EACCES, "x")


def test_of_what_waits_for_a_live_sink_the_oldest_values_go_and_facts_and_reports_stay() -> None:
    sink = SlowCarrier("slow")
    report, facts = NodeReport(ARM, "running"), (ANGLE,)
    sink.report(report)
    sink.describe(facts)
    for number in range(255):
        sink.write(block([[number], [number]], index=number))
    assert (sink.stats.dropped, len(sink._items), sink._owed) == (2, 256, 508)
    row = np.array([[1.0, 2.0, 3.0]])
    sink.write_group(GroupRows("crane", (ANGLE.key,) * 3, np.array([1.0]), row, row))
    assert len(sink._items) == 256, "a sink that has no use for rows gets none"
    sink.wants_rows = True
    sink._items[2] = (0.0, 3, GroupRows("crane", (ANGLE.key,) * 3, np.array([1.0]), row, row))
    sink.write(block([[7]], index=7))
    assert sink.stats.dropped == 5, "rows count as values do"
    items = [item for _, _, item in sink._items]
    assert items[:2] == [report, facts]
    assert [item.index for item in items[2:4] if isinstance(item, Block)] == [2, 3]
    assert isinstance(items[-1], Block)
    assert items[-1].index == 7
    taken, done = sink._next()
    assert ([type(item) for item in taken], done) == ([NodeReport], False)
    sink._fail(TedsProvisionError("It broke.", hint="Mend it."))
    sink._set_state("running", "better")
    sink.write(block())
    assert (sink.stats.state, sink.stats.error, sink.stats.hint) == ("failed", "It broke.", "Mend it.")
    assert sink._next() == ([], True)
    assert not sink._items


def test_what_the_system_refuses_at_the_end_of_a_sink_is_its_error() -> None:
    sink = SlowCarrier("slow")
    sink._end()
    assert (sink.stats.state, sink.stats.error) == ("failed", "slow cannot be written: permission denied.")


def test_lines_of_a_grid_have_no_raw_value_and_null_where_a_value_is_missing() -> None:
    rows_of_two = GroupRows(
        "crane", (ANGLE.key, FORCE.key), np.array([1.0000004, 2.0]), np.array([[0.5, np.nan], [np.nan, 7.0]]),
        np.zeros((2, 2)),
    )  # fmt: skip
    first, second = json_events.row_lines(rows_of_two, {ANGLE.key: ANGLE})
    assert first == {
        "event": "data", "uuid": ARM, "channel": 1, "name": "angle", "unit": "rad", "time": [1.0, 2.0],
        "value": [0.5, None], "uncertainty": 0.0087, "valid": [True, False],
    }  # fmt: skip
    assert (second["name"], second["unit"], second["uncertainty"], second["valid"]) == ("", "", None, [False, True])
    with pytest.raises(ValueError, match="not JSON compliant"):
        json_events.as_line({"value": float("nan")})
    times = [json_events.iso(seconds) for seconds in (0.0, 1e300, float("nan"))]
    assert times == ["1970-01-01T00:00:00.000Z", "unknown", "unknown"]


def test_a_recorder_that_has_nothing_to_do_looks_after_its_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Values go into the file and onto the disk although no more of them come."""
    sink, looks = at_hand(tmp_path / "run.csv"), list[float]()
    monkeypatch.setattr(sink.part, "look", looks.append)
    for now in (5.0, 6.0):
        sink._idle(now)
    assert looks == [5.0, 6.0]
    sink._finish()
    sink._idle(7.0)
    assert looks == [5.0, 6.0]


def test_a_sample_of_mcap_has_the_low_32_bits_of_its_number_as_sequence() -> None:
    plain = plain_samples(7, 1, integral=True)
    found = sample_records(block([[1], [2]], index=(1 << 32) + 70_000), plain)
    assert found["sequence"].tolist() == [70_000, 70_001]
    assert found["index"].tolist() == [(1 << 32) + 70_000, (1 << 32) + 70_001]
    assert found["test"].tolist() == [False, False]
    assert sample_records(block([[1]], test_pattern=True), plain)["test"].tolist() == [True]
    assert np.isnan(sample_records(block([[1]], clock_error=None), plain)["clock_error"]).all()
