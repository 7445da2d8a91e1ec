"""Each record type of MCAP, written by hand, and how the reader interprets it."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import BadDataError
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport, Note
from teds_provision.measure.recordings import mcap, source
from teds_provision.measure.recordings.mcap import McapRecording

MAGIC = b"\x89MCAP0\r\n"
HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK, METADATA, DATA_END = 0x01, 0x03, 0x04, 0x05, 0x06, 0x0C, 0x0F
SAMPLES = "teds_provision_msgs/msg/Samples"
NODE = "ab" * 10
ONE = json.dumps([{"number": 1}])


def record(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


def text(words: str) -> bytes:
    return struct.pack("<I", len(words.encode())) + words.encode()


def pairs(**words: str) -> bytes:
    content = b"".join(text(key) + text(value) for key, value in words.items())
    return struct.pack("<I", len(content)) + content


def schema(number: int = 1, name: str = SAMPLES) -> bytes:
    return record(SCHEMA, struct.pack("<H", number) + text(name) + text("ros2msg") + bytes(4))


def topic(number: int = 1, name: str = "/bench/arm/stream_0", kind: int = 1, **words: str) -> bytes:
    return record(CHANNEL, struct.pack("<HH", number, kind) + text(name) + text("cdr") + pairs(**words))


def message(number: int, data: bytes, at: float = 100.0) -> bytes:
    time = int(at * 1e9)
    return record(MESSAGE, struct.pack("<HIQQ", number, 0, time, time) + b"\0\1\0\0" + data)


def sample(
    *raws: Any,
    number: int = 1,
    index: int = 0,
    value: float = 0.5,
    error: float = 0.25,
    test: int = 0,
    at: float = 100.0,
) -> bytes:
    """One instant of a stream, as docs/measure.md has its definition: integers in two's complement, or floats."""
    count, integral = len(raws), all(isinstance(raw, int) for raw in raws)
    data = struct.pack("<iIQQd", int(at), 0, index, 77, error) + struct.pack("<B3xI", test, count)
    data += struct.pack(f"<{count}d", *[value] * count)
    if integral:
        data += struct.pack("<I4x", count) + struct.pack(f"<{count}q", *raws) + bytes(4)
    else:
        data += struct.pack("<II", 0, count) + struct.pack(f"<{count}d", *raws)
    return message(number, data, at)


def said(words: str, number: int = 1, at: float = 100.0) -> bytes:
    octets = words.encode() + b"\0"
    return message(number, struct.pack("<I", len(octets)) + octets, at)


def written(path: Path, *records: bytes, end: bytes = record(DATA_END, bytes(4)) + MAGIC) -> McapRecording:
    path.write_bytes(MAGIC + record(HEADER, text("ros2") + text("")) + b"".join(records) + end)
    return McapRecording(path)


def entries(path: Path, *records: bytes) -> list[Any]:
    return [entry for entry in written(path, *records).entries() if entry]


def changed(octets: bytes, at: int, new: bytes) -> bytes:
    return octets[:at] + new + octets[at + len(new) :]


ONE_TOPIC = (schema(), topic(uuid=NODE, channels=ONE))
NOT_LISTED = "the metadata of /bench/arm/stream_0 do not list its channels"
DAMAGED = "a message of /bench/arm/stream_0 is damaged"


@pytest.mark.parametrize(
    ("records", "why"),
    [
        ([record(SCHEMA, b"\1")], "a schema record is damaged"),
        ([record(SCHEMA, b"\1\0" + struct.pack("<I", 10) + b"too short")], "a schema record is damaged"),
        ([record(SCHEMA, b"\1\0" + struct.pack("<I", 2) + b"\xff\xfe")], "a schema record is damaged"),
        ([record(CHANNEL, b"\1\0\1")], "a channel record is damaged"),
        ([record(CHANNEL, b"\1\0\1\0" + text("/x"))], "a channel record is damaged"),
        ([record(CHANNEL, b"\1\0\1\0" + text("/x") + text("cdr"))], "a channel record is damaged"),
        ([record(CHANNEL, b"\1\0\1\0" + text("/x") + text("cdr") + struct.pack("<I", 5) + b"k")],
         "a channel record is damaged"),
        ([schema(), topic(channels="[")], NOT_LISTED),
        ([schema(), topic(channels="[" * 100_000)], NOT_LISTED),
        ([schema(), topic(channels="7")], NOT_LISTED),
        ([schema(), topic(channels=json.dumps([{"number": 1}] * 4))], NOT_LISTED),
        ([schema(), *(topic(number) for number in range(4))], "it has more than 3 topics"),
        ([*ONE_TOPIC, sample(5, 6)], "a message of /bench/arm/stream_0 does not have 1 channels"),
        ([*ONE_TOPIC, changed(sample(5), 31, b"\0\0\0\0")], DAMAGED),  # not little-endian
        ([*ONE_TOPIC, changed(sample(5), 71, b"\2")], DAMAGED),  # values
        ([*ONE_TOPIC, changed(sample(5), 83, b"\0")], DAMAGED),  # raw integers
        ([*ONE_TOPIC, changed(sample(0.5), 87, b"\0")], DAMAGED),  # raw floats
        ([*ONE_TOPIC, sample(5), changed(sample(5, index=1), 71, b"\2")], DAMAGED),  # the second of them
    ],
)  # fmt: skip
def test_a_record_that_is_damaged_is_refused_with_its_kind_and_what_recovers_the_rest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, records: list[bytes], why: str
) -> None:
    monkeypatch.setattr(mcap, "MOST", replace(source.MOST, channels=3))
    path = tmp_path / "a run.mcap"
    with pytest.raises(BadDataError) as refused:
        entries(path, *records)
    assert refused.value.message.startswith(f"{path}: {why}")
    assert refused.value.hint == f"To recover what is intact: teds-provision measure recover '{path}'"


def test_as_many_topics_and_channels_are_read_as_the_limit_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(mcap, "MOST", replace(source.MOST, channels=3))
    three = json.dumps([{"number": number} for number in (1, 2, 3)])
    [block] = entries(tmp_path / "run.mcap", schema(), topic(1, channels=three), topic(2), topic(3), sample(1, 2, 3))
    assert (block.channels, block.raw.tolist()) == ((1, 2, 3), [[1, 2, 3]])


@pytest.mark.parametrize(
    "content",
    [b"", b"\1\0\0", text("note"), text("note") + b"\0\0", text("note") + struct.pack("<I", 9) + text("time"),
     struct.pack("<I", 2) + b"\xff\xfe" + pairs()],
)  # fmt: skip
def test_metadata_that_are_damaged_are_refused_when_the_file_is_opened(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(BadDataError, match=r"run\.mcap: a metadata record is damaged\.$"):
        written(tmp_path / "run.mcap", record(METADATA, content))


def test_a_file_that_begins_with_something_else_is_no_mcap(tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"\x89MCAP1\r\n" + bytes(20))
    with pytest.raises(BadDataError, match=r"run\.mcap: it is not an MCAP file\.$"):
        McapRecording(tmp_path / "run.mcap")


def test_samples_of_a_stream_become_blocks_that_end_where_a_number_is_missing_or_a_constant_changes(
    tmp_path: Path,
) -> None:
    nan = float("nan")
    channels = json.dumps([{"number": 1}, {"number": 4}])
    found = entries(
        tmp_path / "run.mcap",
        schema(),
        topic(775, "/bench/arm/stream_12", uuid=NODE, channels=channels),
        *(sample(index, -index, number=775, index=index, at=100.0 + index) for index in (3, 4)),
        sample(9, 9, number=775, index=6, at=106.0),
        sample(9, 9, number=775, index=7, at=107.0, error=nan),
        sample(9, 9, number=775, index=8, at=108.0, error=nan, value=nan),
        sample(9, 9, number=775, index=9, at=109.0, error=nan, test=1),
        sample(0.5, 1.5, number=775, index=10, at=110.0),
    )
    assert all(isinstance(entry, Block) for entry in found)
    assert [
        (block.uuid, block.stream, block.channels, block.index, block.time.tolist(), block.clock_error,
         block.test_pattern, block.raw.tolist())
        for block in found
    ] == [
        (NODE, 12, (1, 4), 3, [103.0, 104.0], 0.25, False, [[3, -3], [4, -4]]),
        (NODE, 12, (1, 4), 6, [106.0], 0.25, False, [[9, 9]]),
        (NODE, 12, (1, 4), 7, [107.0, 108.0], None, False, [[9, 9], [9, 9]]),
        (NODE, 12, (1, 4), 9, [109.0], None, True, [[9, 9]]),
        (NODE, 12, (1, 4), 10, [110.0], 0.25, False, [[0.5, 1.5]]),
    ]  # fmt: skip
    assert [block.raw.dtype.kind for block in found] == ["i", "i", "i", "i", "f"]
    assert found[0].tick.tolist() == [77, 77]
    assert found[2].valid.tolist() == [[True, True], [False, False]]
    np.testing.assert_array_equal(found[2].value, [[0.5, 0.5], [np.nan, np.nan]])


@pytest.mark.parametrize(
    ("form", "raw"),
    [
        ("unsigned integer, 8 octets", 2**64 - 1),
        ("bit sequence, 8 octets", 2**64 - 1),
        ("unsigned integer, 4 octets", -1),
        ("", -1),
    ],
)
def test_integers_of_eight_octets_are_unsigned_as_the_datasheet_has_them(tmp_path: Path, form: str, raw: int) -> None:
    listed = json.dumps([{"uuid": NODE, "number": 1, "sample_form": form}])
    facts, block = entries(tmp_path / "run.mcap", schema(), topic(uuid=NODE, channels=listed), sample(-1))
    assert facts == (ChannelFacts(NODE, "", 1, "", sample_form=form),)
    assert block.raw.tolist() == [[raw]]
    _, floats = entries(tmp_path / "run.mcap", schema(), topic(uuid=NODE, channels=listed), sample(-0.5))
    assert floats.raw.tolist() == [[-0.5]]


def test_the_instant_of_a_sample_is_its_log_time(tmp_path: Path) -> None:
    late = changed(sample(5, at=100.25), 23, struct.pack("<Q", 200 * 10**9))
    [block] = entries(tmp_path / "run.mcap", *ONE_TOPIC, late)
    assert block.time.tolist() == [100.25]


def test_messages_belong_to_the_topic_that_was_described_before_them(tmp_path: Path) -> None:
    """A part that another program appended renumbers its topics."""
    noted = record(METADATA, text("note") + pairs(note="full"))
    found = entries(
        tmp_path / "run.mcap",
        *ONE_TOPIC, sample(5), topic(uuid="cd" * 10, channels=json.dumps([{"number": 2}])), sample(6), noted, sample(7),
    )  # fmt: skip
    assert [(entry.uuid, entry.channels, entry.raw.tolist()) for entry in found if isinstance(entry, Block)] == [
        (NODE, (1,), [[5]]), ("cd" * 10, (2,), [[6]]), ("cd" * 10, (2,), [[7]]),
    ]  # fmt: skip
    assert found[2] == Note(0.0, "full")


def test_facts_of_a_topic_that_are_no_object_are_refused(tmp_path: Path) -> None:
    where = r"run\.mcap: the metadata of /bench/arm/stream_0: the facts of a channel are not a JSON object\.$"
    for listed in ("[5]", "[[]]", "[null]"):
        with pytest.raises(BadDataError, match=where):
            entries(tmp_path / "run.mcap", schema(), topic(channels=listed))


def test_what_holds_no_samples_or_reports_is_passed_over(tmp_path: Path) -> None:
    strings = (schema(2, "std_msgs/msg/String"), topic(3, "/bench/reports", 2), topic(4, "/bench/arm/teds", 2))
    good = json.dumps({"uuid": NODE, "state": "lost", "why": "off", "samples": 3})
    timed = json.dumps({"uuid": NODE, "state": "ended", "time": 7.5})
    found = entries(
        tmp_path / "run.mcap",
        *ONE_TOPIC,
        *strings,
        schema(5, "std_msgs/msg/Float64"),
        topic(6, "/bench/arm/angle", 5, channels=ONE),  # of another type
        topic(8, "/bench/arm/stream_1", 1, uuid=NODE),  # a stream of a foreign recorder: it names no channels
        topic(9, "/bench/arm/stream_2", 99, uuid=NODE, channels=ONE),  # a schema that no record has
        *(message(number, bytes(48)) for number in (6, 8, 9, 200)),
        record(MESSAGE, bytes(21)),
        said(good, 4),
        *(said(words, 3) for words in ("", "[1]", "{", "[" * 100_000, '{"uuid": 5}')),
        said(good, 3, at=1795283932.123),
        said(timed, 3),
        record(0x80, b"private"),
        record(METADATA, text("note") + pairs(time="2026-11-21T17:58:52Z", note="x" * 1001)),
        record(METADATA, text("note") + pairs()),
        record(METADATA, text("other") + pairs(note="no")),
        sample(5),
    )
    assert found[:4] == [
        NodeReport(NODE, "lost", "off", 3, time=1795283932.123),
        NodeReport(NODE, "ended", time=7.5),
        Note(1795283932.0, "x" * 1000),
        Note(0.0, ""),
    ]
    [block] = found[4:]
    assert block.raw.tolist() == [[5]]


def test_a_stream_is_numbered_by_the_end_of_its_topic(tmp_path: Path) -> None:
    names = ("/bench/arm/stream_7", "/bench/arm/stream_999", "/bench/stream_3/x", "/bench/arm/stream_1000", "/stream_")
    topics = [topic(number, name, channels=ONE) for number, name in enumerate(names)]
    found = entries(tmp_path / "run.mcap", schema(), *topics, *(sample(5, number=number) for number in range(5)))
    assert [block.stream for block in found] == [7, 999, 0, 0, 0]


def test_facts_of_a_channel_keep_their_kinds_although_metadata_are_texts(tmp_path: Path) -> None:
    """A node that is named 5, and one named null, are no numbers."""
    texts = (
        "node",
        "name",
        "unit",
        "shown_unit",
        "fingerprint",
        "sample_form",
        "quantity",
        "frame",
        "calibrated",
        "due",
    )
    words = dict(zip(texts, ("5", "null", "1", "true", "12", "7", "[]", "{}", "2026", "2027"), strict=True))
    numbers = {"low": "-1.5", "high": "2", "uncertainty": "0.25", "period": "0.01"}
    path = tmp_path / "run.mcap"
    channel = pairs(uuid="12", number="3", kind="actuator", overdue="true", vector="[3, 4]", **words, **numbers)
    begun = pairs(station="bench", group="crane", started="2026-11-21T17:58:52Z", clock="GPS", test_pattern="true")
    recording = written(
        path, record(METADATA, text("measurement") + begun), record(METADATA, text("channel") + channel)
    )
    facts = recording.facts["12", 3]
    assert {name: getattr(facts, name) for name in texts} == words
    assert (facts.low, facts.high, facts.uncertainty, facts.period) == (-1.5, 2.0, 0.25, 0.01)
    assert (facts.kind, facts.overdue, facts.vector) == ("actuator", True, (3, 4))
    station = recording.station
    assert (station.name, station.group, station.started, station.clock, station.test_pattern) == (
        "bench", "crane", 1795283932.0, "GPS", True,
    )  # fmt: skip
    with pytest.raises(BadDataError, match=r"run\.mcap: the metadata: low of a channel is 'x'"):
        written(path, record(METADATA, text("channel") + pairs(uuid="12", number="3", low="x")))


def test_a_file_without_its_end_is_read_to_the_last_whole_record(tmp_path: Path) -> None:
    whole = (*ONE_TOPIC, sample(5))
    for torn in (
        b"",
        b"\5",
        sample(6)[:-1],
        struct.pack("<BQ", METADATA, 1 << 40) + bytes(30),
        record(CHUNK, b"1")[:-1],
    ):
        recording = written(tmp_path / "run.mcap", *whole, end=torn)
        [block] = [entry for entry in recording.entries() if entry]
        assert isinstance(block, Block)
        assert (block.raw.tolist(), recording.complete, recording.torn) == ([[5]], False, len(torn))
    recording = written(tmp_path / "run.mcap", *whole)
    assert len(list(recording.entries())) >= 1
    assert (recording.complete, recording.torn) == (True, 0)
    cut = written(tmp_path / "run.mcap", *whole, end=record(DATA_END, bytes(4)) + MAGIC[:-1])
    assert not cut.complete


def chunk(body: bytes, size: int | None = None, checksum: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 0, len(body) if size is None else size, checksum)
    return record(CHUNK, head + text("") + struct.pack("<Q", len(body)) + body)


def test_records_in_a_chunk_are_read_to_the_last_whole_one(tmp_path: Path) -> None:
    body = b"".join(ONE_TOPIC) + sample(5)
    for rest in (b"", b"\5\0", sample(6)[:-1]):
        found = entries(tmp_path / "run.mcap", chunk(body + rest), sample(7, index=1))
        assert [entry.raw.tolist() for entry in found] == [[[5], [7]]]


def test_a_chunk_that_is_damaged_is_named_with_its_octet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = b"".join(ONE_TOPIC) + sample(5)
    at = len(MAGIC + record(HEADER, text("ros2") + text("")))
    for bad in (chunk(body, len(body) + 1), chunk(body, checksum=1), record(CHUNK, bytes(39))):
        with pytest.raises(BadDataError, match=rf"run\.mcap: the chunk at octet {at} is damaged\.$"):
            entries(tmp_path / "run.mcap", bad)
    whole = chunk(body)
    monkeypatch.setattr(mcap, "MOST", replace(source.MOST, chunk=len(whole) - 9))
    assert len(entries(tmp_path / "run.mcap", whole)) == 1
    monkeypatch.setattr(mcap, "MOST", replace(source.MOST, chunk=len(whole) - 10))
    with pytest.raises(BadDataError, match=rf"run\.mcap: the record at octet {at} is damaged\.$"):
        entries(tmp_path / "run.mcap", whole)
