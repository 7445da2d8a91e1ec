"""`measure recover` record by record: what is damage, what stays, and what of a description can be found again."""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import NonSeekingReader, make_reader

from teds_provision.errors import BadDataError, NotFoundError, StoreError, StoreLockedError
from teds_provision.measure.sinks.mcap import recover as recovery
from teds_provision.measure.sinks.mcap.recover import Damage, recover, unpacked
from teds_provision.measure.sinks.mcap.writer import McapSummary
from teds_provision.measure.sinks.mcap.zstandard_frames import compress_frame
from tests.measure.recordings.test_records_of_mcap import HEADER, MAGIC, pairs, record, text

FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, METADATA = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x0C
BEGIN = MAGIC + record(HEADER, text("ros2") + text(""))
KIND = record(SCHEMA, struct.pack("<H", 1) + text("std_msgs/msg/Float64") + text("ros2msg") + bytes(4))


def channel(number: int = 1, kind: int = 1) -> bytes:
    return record(CHANNEL, struct.pack("<HH", number, kind) + text(f"/x{number}") + text("cdr") + pairs(a="b"))


def message(at: int = 5, number: int = 1) -> bytes:
    return record(MESSAGE, struct.pack("<HIQQ", number, 0, at, at) + bytes(8))


def chunk(
    body: bytes, span: tuple[int, int] = (5, 5), *, name: str = "zstd", size: int | None = None, crc: int | None = None
) -> bytes:
    packed = compress_frame(body) if name == "zstd" else body
    head = struct.pack("<QQQI", *span, len(body) if size is None else size, zlib.crc32(body) if crc is None else crc)
    return record(CHUNK, head + text(name) + struct.pack("<Q", len(packed)) + packed)


def index(*entries: tuple[int, int], number: int = 1) -> bytes:
    body = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(MESSAGE_INDEX, struct.pack("<HI", number, len(body)) + body)


def finished(path: Path, *records: bytes) -> Path:
    octets = BEGIN + b"".join(records)
    path.write_bytes(octets + McapSummary().tail(len(octets)))
    return path


def messages_in(path: Path) -> list[tuple[str, int]]:
    """Topic and log time of each message, as a strict reader of another program finds them."""
    with path.open("rb") as file:
        return [(topic.topic, one.log_time) for _, topic, one in make_reader(file, validate_crcs=True).iter_messages()]


GOOD = (chunk(message(7), (7, 7)), index((7, 0)))
PLACE = len(BEGIN + KIND + channel())


@pytest.mark.parametrize(
    "bad",
    [
        record(METADATA, text("a")),
        record(METADATA, text("a") + pairs(b="c") + b"x"),
        record(METADATA, struct.pack("<I", 2) + b"\xff\xfe" + pairs()),
        record(SCHEMA, b"\1"),
        record(SCHEMA, struct.pack("<H", 2) + text("a") + text("b") + struct.pack("<I", 1)),
        record(CHANNEL, struct.pack("<HH", 1, 1) + text("/x")),
        record(CHANNEL, struct.pack("<HH", 1, 1) + text("/x") + text("cdr") + pairs() + b"x"),
        record(MESSAGE, bytes(21)),
        record(HEADER, text("a")),
        record(HEADER, struct.pack("<I", 99) + b"a"),
        record(FOOTER, bytes(20)),
        record(0x7F, b"unknown"),
        index((7, 0)),
        record(CHUNK, bytes(39)),
        b"\0" * 5,
    ],
)
def test_a_record_that_is_damaged_goes_with_all_up_to_the_next_chunk(tmp_path: Path, bad: bytes) -> None:
    path = finished(tmp_path / "run.mcap", KIND, channel(), bad, *GOOD)
    octets = path.read_bytes()
    done = recover(path)
    what = "chunk" if bad[0] == CHUNK else "record"
    assert done.damaged == (Damage(what, PLACE, len(bad)),)
    assert (done.messages, done.until, done.was_whole, done.output) == (
        1, 7e-9, False, tmp_path / "run.mcap.recovered",
    )  # fmt: skip
    assert path.read_bytes() == octets
    assert messages_in(tmp_path / "run.mcap.recovered") == [("/x1", 7)]
    assert b"/recovered/" not in done.output.read_bytes(), "a topic outside of chunks was described a second time"


@pytest.mark.parametrize(
    "good",
    [
        record(METADATA, text("a") + pairs(b="c")),
        record(MESSAGE, bytes(22)),
        record(HEADER, text("a") + text("b") + b"more"),
        record(SCHEMA, struct.pack("<H", 2) + text("a") + text("b") + struct.pack("<I", 1) + b"x"),
        record(0x09, b"an attachment"),
        record(0x80, b"private"),
    ],
)
def test_what_is_whole_or_not_ours_stays_octet_for_octet(tmp_path: Path, good: bytes) -> None:
    path = finished(tmp_path / "run.mcap", KIND, channel(), good, *GOOD)
    octets = path.read_bytes()
    done = recover(path)
    assert (done.was_whole, done.damaged, done.output, done.cut) == (True, (), None, 0)
    assert path.read_bytes() == octets


@pytest.mark.parametrize(
    "bad",
    [
        chunk(message(), crc=1),
        chunk(message(), size=len(message()) + 1, name=""),
        chunk(message(), size=len(message()) - 1),
        chunk(message(), name="xz"),
        chunk(message(), size=1 << 40),
    ],
)
def test_a_damaged_chunk_goes_with_its_indexes(tmp_path: Path, bad: bytes) -> None:
    path = finished(tmp_path / "run.mcap", KIND, channel(), bad, index((5, 0)), index((5, 0), number=2), *GOOD)
    done = recover(path)
    assert done.damaged == (Damage("chunk", PLACE, len(bad) + 2 * len(index((5, 0)))),)
    assert messages_in(tmp_path / "run.mcap.recovered") == [("/x1", 7)]


@pytest.mark.parametrize(
    ("span", "indexes", "what", "offset", "octets"),
    [
        ((5, 9), [(5, 0), (9, 39)], None, 0, 0),
        ((5, 5), [(5, 0), (9, 39)], "chunk header, repaired", 0, 0),
        ((0, 9), [(5, 0), (9, 39)], "chunk header, repaired", 0, 0),
        ((5, 9), [(5, 0)], "chunk index, rebuilt", 1, 1),
        ((5, 9), [(5, 0), (9, 38)], "chunk index, rebuilt", 1, 1),
        ((5, 9), [(5, 0), (8, 39)], "chunk index, rebuilt", 1, 1),
    ],
)
def test_times_and_indexes_of_a_chunk_that_its_messages_contradict_are_made_anew(
    tmp_path: Path, span: tuple[int, int], indexes: Any, what: str | None, offset: int, octets: int
) -> None:
    body = message(5) + message(9)
    assert len(message(5)) == 39
    whole, of_it = chunk(body, span), index(*indexes)
    path = finished(tmp_path / "run.mcap", KIND, channel(), whole, of_it)
    done = recover(path)
    if what is None:
        assert done.was_whole
        return
    assert done.damaged == (
        Damage(what, PLACE + offset * len(whole), len(of_it) if octets else len(whole)),
    )  # fmt: skip
    assert (done.messages, done.until) == (2, 9e-9)
    assert messages_in(tmp_path / "run.mcap.recovered") == [("/x1", 5), ("/x1", 9)]
    assert recover(tmp_path / "run.mcap.recovered").was_whole


@pytest.mark.parametrize("index_of_it", [index((5, 0)) + b"x", index((5, 0))[:-1], b""])
def test_an_index_of_a_wrong_length_is_no_index(tmp_path: Path, index_of_it: bytes) -> None:
    bad = record(MESSAGE_INDEX, index_of_it[9:]) if index_of_it else record(MESSAGE_INDEX, bytes(5))
    path = finished(tmp_path / "run.mcap", KIND, channel(), chunk(message()), bad, *GOOD)
    done = recover(path)
    [damage] = done.damaged
    assert (damage.offset, damage.octets) == (PLACE + len(chunk(message())), len(bad))
    assert messages_in(tmp_path / "run.mcap.recovered") == [("/x1", 5), ("/x1", 7)]


def test_topics_of_which_nothing_is_left_have_names_that_say_so(tmp_path: Path) -> None:
    """Messages outlive their description: they are kept, with the metadata that the file still has."""
    body = channel(2, 9) + message(7, 2) + message(8, 5)
    path = finished(tmp_path / "run.mcap", chunk(KIND + channel(), crc=1), chunk(body, (7, 8)))
    done = recover(path)
    assert done.output is not None
    with done.output.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert messages_in(done.output) == [("/x2", 7), ("/recovered/channel_5", 8)]
    lost = summary.channels[5]
    assert (lost.schema_id, lost.message_encoding, lost.metadata) == (
        0, "cdr", {"note": "the description of this topic was in a damaged chunk"},
    )  # fmt: skip
    schema = summary.schemas[9]
    assert (schema.name, schema.encoding, schema.data) == ("recovered/unknown", "", b"")
    assert sorted(summary.schemas) == [9], "what no message needs is not invented"


def test_messages_outside_of_chunks_count_and_stay(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(BEGIN + KIND + channel() + message(3) + message(9) + message(4) + b"\5\1")
    done = recover(path)
    assert (done.messages, done.until, done.was_whole, done.cut, done.damaged) == (3, 9e-9, False, 2, ())
    assert recover(path).was_whole
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert (summary.statistics.message_start_time, summary.statistics.message_end_time) == (3, 9)


@pytest.mark.parametrize(("indexed", "messages"), [(True, 1), (False, 1)])
def test_the_last_chunk_of_a_torn_file_gets_the_indexes_that_it_lacks(
    tmp_path: Path, indexed: bool, messages: int
) -> None:
    path = tmp_path / "run.mcap"
    of_it = index((5, 0))
    octets = BEGIN + KIND + channel() + chunk(message())
    path.write_bytes(octets + (of_it if indexed else of_it[:-3]))
    done = recover(path)
    assert (done.messages, done.cut, done.damaged) == (messages, 0 if indexed else len(of_it) - 3, ())
    assert path.read_bytes()[: len(octets) + len(of_it)] == octets + of_it
    assert messages_in(path) == [("/x1", 5)]


def test_of_a_file_in_another_compression_nothing_is_guessed(tmp_path: Path) -> None:
    path = finished(tmp_path / "run.mcap", KIND, channel(), chunk(message(), name="lz4"))
    with pytest.raises(BadDataError) as refused:
        recover(path)
    assert refused.value.message == f"A chunk of {path} is compressed with lz4, which is not supported."
    [bare] = [chunk(message(), name="")[9:]]
    assert unpacked(bare, path) == (message(), True)
    assert unpacked(bare, path, len(message())) == (message(), True)
    assert unpacked(bare, path, len(message()) - 1) is None
    assert unpacked(chunk(message(), name="", crc=0)[9:], path) == (message(), True), "0: it has no checksum"
    assert unpacked(chunk(message(), name="", crc=1)[9:], path) == (message(), False)
    assert unpacked(bare[:-1], path) is None
    assert unpacked(bare + b"x", path) is None


def test_what_is_no_file_of_its_own_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(NotFoundError) as missing:
        recover(tmp_path / "none.mcap")
    assert missing.value.message == f"There is no file {tmp_path / 'none.mcap'}."
    with pytest.raises(NotFoundError) as folder:
        recover(tmp_path)
    assert (folder.value.message, folder.value.hint) == (
        f"{tmp_path} is a folder, not a file.", "Give one recording in it.",
    )  # fmt: skip
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "short").write_bytes(MAGIC[:-1])
    (tmp_path / "other").write_bytes(b"\x89MCAP1\r\n" + bytes(20))
    for name in ("pipe", "short", "other"):
        with pytest.raises(BadDataError) as refused:
            recover(tmp_path / name)
        assert refused.value.message == f"{tmp_path / name} is not an MCAP file."
        assert refused.value.hint == "Text and JSON-line recordings need no recovery."
    path = finished(tmp_path / "run.mcap", KIND, channel(), *GOOD)

    def refuse(error: OSError) -> Any:
        def lock(_file: int) -> None:
            raise error

        return lock

    monkeypatch.setattr(recovery, "lock", refuse(BlockingIOError()))
    with pytest.raises(StoreLockedError) as locked:
        recover(path)
    assert locked.value.message == f"{path} is being recorded right now."
    assert locked.value.hint == "End that measurement, or wait until it is over."
    monkeypatch.setattr(recovery, "lock", refuse(OSError(95, "no locks here")))
    assert recover(path).was_whole, "a file system without locks"
    monkeypatch.undo()
    monkeypatch.setattr(
        recovery.mmap, "mmap", lambda *_words, **_how: (_ for _ in ()).throw(OSError(5, "Input/output error"))
    )
    with pytest.raises(StoreError, match=r"run\.mcap cannot be written: Input/output error\.$"):
        recover(path)


def test_a_file_that_was_replaced_meanwhile_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(BEGIN + KIND + channel() + message() + b"\5")
    walk = recovery._Scan.walk

    def replaced(scan: Any) -> None:
        walk(scan)
        (tmp_path / "new").write_bytes(b"another file")
        (tmp_path / "new").rename(path)

    monkeypatch.setattr(recovery._Scan, "walk", replaced)
    with pytest.raises(BadDataError) as refused:
        recover(path)
    assert refused.value.message == f"{path} was replaced in the meantime."
    assert refused.value.hint == "Run the same command again."
    assert path.read_bytes() == b"another file"


WHOLE = KIND + channel() + b"".join(GOOD)
RUBBISH = b"\xff" * 5000


def test_a_file_that_is_whole_gives_no_other_file_even_if_one_was_asked_for(tmp_path: Path) -> None:
    path = finished(tmp_path / "run.mcap", WHOLE)
    done = recover(path, tmp_path / "other.mcap")
    assert (done.was_whole, done.output, done.cut, done.messages) == (True, None, 0, 1)
    assert [found.name for found in tmp_path.iterdir()] == ["run.mcap"]
    bare = finished(tmp_path / "bare.mcap", KIND)
    assert (recover(bare).messages, recover(bare).until) == (0, None)


@pytest.mark.parametrize("named", [False, True])
def test_a_torn_end_is_cut_off_in_place_or_left_out_of_the_file_that_was_asked_for(tmp_path: Path, named: bool) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(BEGIN + WHOLE + RUBBISH)
    done = recover(path, tmp_path / "other.mcap" if named else None)
    assert (done.cut, done.damaged, done.was_whole, done.messages) == (5000, (), False, 1)
    assert done.output == (tmp_path / "other.mcap" if named else None)
    made = done.output or path
    octets = made.read_bytes()
    assert octets.startswith(BEGIN + WHOLE)
    assert octets.endswith(MAGIC)
    assert RUBBISH[:64] not in octets
    assert recover(made).was_whole
    if named:
        assert path.read_bytes() == BEGIN + WHOLE + RUBBISH


def test_a_damaged_file_goes_where_it_was_asked_to(tmp_path: Path) -> None:
    path = finished(tmp_path / "run.mcap", KIND, channel(), chunk(message(), crc=1), *GOOD)
    assert recover(path, tmp_path / "other.mcap").output == tmp_path / "other.mcap"
    assert sorted(found.name for found in tmp_path.iterdir()) == ["other.mcap", "run.mcap"]
    assert (tmp_path / "other.mcap").stat().st_mode & 0o777 == path.stat().st_mode & 0o777 & 0o644


@pytest.mark.parametrize("place", [-20, -40])
def test_a_damaged_summary_is_made_anew_in_another_file(tmp_path: Path, place: int) -> None:
    path = finished(tmp_path / "run.mcap", WHOLE)
    octets = bytearray(path.read_bytes())
    octets[place] ^= 1
    path.write_bytes(octets)
    begin = len(BEGIN + WHOLE)
    done = recover(path)
    assert done.damaged == (Damage("summary", begin, len(octets) - begin),)
    assert path.read_bytes() == octets
    assert messages_in(tmp_path / "run.mcap.recovered") == [("/x1", 7)]


def test_a_file_that_was_cut_behind_its_first_octets_is_one_without_anything(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(MAGIC)
    done = recover(path)
    assert (done.messages, done.until, done.was_whole, done.cut) == (0, None, False, 0)
    assert recover(path).was_whole


def test_a_message_outside_of_chunks_has_a_topic_too(tmp_path: Path) -> None:
    path = finished(tmp_path / "run.mcap", chunk(KIND + channel(), crc=1), message(3, 4))
    done = recover(path)
    assert done.output is not None
    assert messages_of_stream(done.output) == [("/recovered/channel_4", 3)]


def messages_of_stream(path: Path) -> list[tuple[str, int]]:
    """Topic and log time of each message, as a reader of another program finds them from the first octet on."""
    with path.open("rb") as file:
        reader = NonSeekingReader(file, validate_crcs=True)
        return [(topic.topic, one.log_time) for _, topic, one in reader.iter_messages(log_time_order=False)]
