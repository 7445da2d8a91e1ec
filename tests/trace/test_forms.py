"""Both forms of a trace: what is written is read again, a file that was cut short too, and nothing makes them raise."""

from __future__ import annotations

import json
import os
import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision import __version__
from teds_provision.errors import BadDataError, NotFoundError, StoreError, UsageError
from teds_provision.links.ports import Direction
from teds_provision.trace import pcapng, recorder
from teds_provision.trace import record as lines
from teds_provision.trace.frames import can_words, nfc_words
from teds_provision.trace.record import Record
from teds_provision.trace.recorder import open_trace, read_trace

NODE = bytes.fromhex("0102030405060708090a")
directions: st.SearchStrategy[Direction] = st.sampled_from(["out", "in"])
moments = st.integers(0, 4_000_000_000_000_000).map(lambda microseconds: microseconds / 1e6)
can_frames = st.builds(
    lambda time, direction, octets, identifier, fd: Record(
        time,
        direction,
        "can",
        "frame",
        octets,
        can_words(identifier, octets),
        identifier=identifier,
        fd=fd or len(octets) > 8,
    ),
    moments,
    directions,
    st.binary(max_size=64),
    st.integers(0, 0x1FFFFFFF),
    st.booleans(),
)
nfc_frames = st.builds(
    lambda time, direction, octets: Record(time, direction, "nfc", "frame", octets, nfc_words(octets, direction)),
    moments,
    directions,
    st.binary(max_size=300),
)
messages = st.builds(
    lambda time, direction, octets, opened: Record(
        time,
        direction,
        "can",
        "message",
        octets,
        "List (128.11), 0 octets",
        opened=opened,
        sealed=opened is not None,
        uuid=NODE.hex(),
    ),
    moments,
    directions,
    st.binary(max_size=300),
    st.none() | st.binary(max_size=300),
)
records = st.lists(can_frames | nfc_frames | messages, max_size=8)
Reader = Callable[[bytes], Iterator[Record]]
FORMS: dict[str, tuple[bytes, Callable[[Record], bytes], Reader]] = {
    "lines": (lines.head(), lines.line, lines.read_lines),
    "pcapng": (pcapng.head(), pcapng.block, pcapng.read_pcapng),
}


@pytest.mark.parametrize("form", FORMS)
@given(written=records)
def test_what_is_written_is_read_again(form: str, written: list[Record]) -> None:
    head, encode, read = FORMS[form]
    found = list(read(head + b"".join(map(encode, written))))
    assert [record.as_json() for record in found] == [record.as_json() for record in written]


@pytest.mark.parametrize("form", FORMS)
@given(written=records, cut=st.integers(1, 400))
def test_a_file_that_was_cut_short_gives_what_came_before(form: str, written: list[Record], cut: int) -> None:
    head, encode, read = FORMS[form]
    body = b"".join(map(encode, written))
    rest = body[: max(0, len(body) - cut)]
    found = [record.as_json() for record in read(head + rest)]
    assert found == [record.as_json() for record in written[: len(found)]]
    assert len(found) >= len(written) - 1 - cut // 40


@given(identifier=st.integers(0, 0x1FFFFFFF), octets=st.binary(max_size=64), direction=directions)
def test_every_frame_has_words(identifier: int, octets: bytes, direction: Direction) -> None:
    assert can_words(identifier, octets)
    assert nfc_words(octets, direction)


@pytest.mark.parametrize(
    ("identifier", "octets", "words"),
    [
        (0x18DA21F1, "070c0000800700 00", "f1 to 21: single frame, transaction 12, 6 octets"),
        (0x18DAF121, "101b0c0100170115", "21 to f1: first frame, transaction 12, 26 octets"),
        (0x18DA21F1, "301000cccccccccc", "f1 to 21: flow control: go on, block 16, gap 0"),
        (0x18DAF121, "21598c7b187f6bf4", "21 to f1: consecutive frame 1"),
        (0x18DBFFF1, "0701000080070000", "f1 to all: single frame, transaction 1, 6 octets"),
        (0x1CFF2921, "00", "21 to f1: data of stream 1, part 1"),
        (0x18EF21F1, "00ff", "f1 to 21: Drive, part 0"),
        (0x18FF00F1, "0102030405060708", "f1 to all: trigger 0102030405060708"),
        (0x18DAF121, "100000001000070c", "21 to f1: first frame, long form"),
        (0x18DA21F1, "310000cccccccccc", "f1 to 21: flow control: wait, block 0, gap 0"),
        (0x18DA21F1, "320005cccccccccc", "f1 to 21: flow control: overflow, block 0, gap 5"),
        (0x18DA21F1, "330000cccccccccc", "f1 to 21: no frame of ISO 15765-2"),
        (0x18DA21F1, "3000", "f1 to 21: no frame of ISO 15765-2"),
        (0x18DA21F1, "4001", "f1 to 21: no frame of ISO 15765-2"),
        (0x18DA21F1, "", "f1 to 21: empty"),
        (0x1CFF0021, "0102deadbeef0000", "21: Announce"),
        (0x1CFF0021, "0102deadbeef0100", "21: Announce, button pressed"),
        (0x1CFF00F1, "0102deadbeef0100", "not of the profile"),
        (0x00000123, "00", "not of the profile"),
    ],
)
def test_frames_of_the_bus_are_named(identifier: int, octets: str, words: str) -> None:
    assert can_words(identifier, bytes.fromhex(octets)) == words


@pytest.mark.parametrize(
    ("octets", "direction", "words"),
    [
        ("", "out", "empty"),
        ("e080", "out", "RATS"),
        ("3004", "out", "READ from page 4"),
        ("a205deadbeef", "out", "WRITE of page 5"),
        ("00a4040007", "out", "SELECT"),
        ("00b0000010", "out", "READ BINARY"),
        ("00b00000", "out", "READ BINARY"),
        ("00d6000002", "out", "UPDATE BINARY"),
        ("00a404", "out", "3 octets"),
        ("0a", "in", "ACK"),
        ("01", "in", "NAK 1"),
        ("000102030405060708090a0b0c0d0e0f", "in", "16 octets of a Type 2 tag"),
        ("020102030405060708090a0b0c0d9000", "in", "I block 0, 15 octets, status 9000"),
        ("0300b00002", "out", "I block 1, 4 octets: READ BINARY 0002"),
        ("0200a4", "out", "I block 0, 2 octets"),
        ("139000", "in", "I block 1, goes on, 2 octets"),
        ("02900000", "in", "I block 0, 3 octets, status 0000"),
        ("0290", "in", "I block 0, 1 octets"),
        ("a2", "out", "R block 0, ACK"),
        ("b3", "out", "R block 1, NAK"),
        ("a300", "in", "R block 1, ACK"),
        ("c200", "in", "S block, DESELECT"),
        ("f20b", "in", "S block, more time x 11"),
        ("f2cb", "out", "S block, more time x 11"),
        ("4400", "in", "2 octets"),
    ],
)
def test_frames_of_a_tag_are_named(octets: str, direction: Direction, words: str) -> None:
    assert nfc_words(bytes.fromhex(octets), direction) == words


def le(*numbers: int) -> bytes:
    return struct.pack(f"<{len(numbers)}I", *numbers)


def option(code: int, value: bytes) -> bytes:
    return struct.pack("<HH", code, len(value)) + value + bytes(-len(value) % 4)


def packet(interface: int, moment: int, data: bytes, options: bytes) -> bytes:
    """An Enhanced Packet Block as the draft lays it out."""
    body = (
        le(interface, moment >> 32, moment & 0xFFFFFFFF, len(data), len(data)) + data + bytes(-len(data) % 4) + options
    )
    return le(6, len(body) + 12) + body + le(len(body) + 12)


OUT, IN, END = option(2, le(2)), option(2, le(1)), bytes(4)


@pytest.mark.parametrize(
    ("record", "octets"),
    [
        (
            Record(1.5, "out", "can", "frame", b"\1\2\3", "words", identifier=0x18DA21F1),
            packet(0, 1_500_000, b"\x98\xda\x21\xf1\3\0\0\0\1\2\3", OUT + END),
        ),
        (
            Record(5_000_000_000.25, "in", "can", "frame", bytes(12), identifier=1, fd=True),
            packet(0, 5_000_000_000_250_000, b"\x80\0\0\1\x0c\5\0\0" + bytes(12), IN + END),
        ),
        (
            Record(0.0, "out", "nfc", "frame", b"\xe0\x80", "RATS"),
            packet(1, 0, b"\0\xfa\0\2\xe0\x80", OUT + END),
        ),
        (
            Record(0.0, "in", "nfc", "frame", bytes(300)),
            packet(1, 0, b"\0\xfb\1\x2c" + bytes(300), IN + END),
        ),
        (
            Record(0.0, "in", "ble", "frame", b"\7"),
            packet(2, 0, b"\7", option(1, b"") + option(1, b"link: ble frame") + IN + END),
        ),
        (
            Record(1.0, "out", "nfc", "message", b"\1\2", "List", opened=b"\xab", sealed=True, uuid="8d4d"),
            packet(
                2, 1_000_000, b"\1\2",
                option(1, b"List") + option(1, b"opened: ab") + option(1, b"node: 8d4d")
                + option(1, b"link: nfc message") + OUT + END,
            ),
        ),
    ],
    ids=["can", "can-fd", "nfc", "nfc-long", "ble", "message"],
)  # fmt: skip
def test_a_record_as_a_block_of_pcapng(record: Record, octets: bytes) -> None:
    assert pcapng.block(record).hex() == octets.hex()
    (again,) = pcapng.read_pcapng(pcapng.head() + octets)
    assert (again.time, again.direction, again.layer, again.octets) == (
        record.time, record.direction, record.layer, record.octets
    )  # fmt: skip
    assert (again.identifier, again.fd, again.opened, again.sealed, again.uuid) == (
        record.identifier, record.fd, record.opened, record.sealed, record.uuid
    )  # fmt: skip


def test_the_head_of_pcapng_has_three_interfaces_with_times_in_microseconds() -> None:
    head, names = pcapng.head(), ((227, b"can"), (264, b"nfc"), (147, b"messages"))
    interfaces = b""
    for link_type, name in names:
        body = struct.pack("<HHI", link_type, 0, 0) + option(2, name) + option(9, b"\6") + END
        interfaces += le(1, len(body) + 12) + body + le(len(body) + 12)
    assert head.endswith(interfaces)
    section = head.removesuffix(interfaces)
    assert section[:4] == b"\x0a\x0d\x0d\x0a"
    assert section[8:24] == le(0x1A2B3C4D) + struct.pack("<HHq", 1, 0, -1)
    assert b"teds-provision " in section


@pytest.mark.parametrize(
    ("resolution", "ticks", "seconds"), [(6, 1_500_000, 1.5), (9, 1_500_000_000, 1.5), (0x83, 12, 1.5), (3, 1500, 1.5)]
)
def test_times_have_the_resolution_of_their_interface(resolution: int, ticks: int, seconds: float) -> None:
    body = struct.pack("<HHI", 264, 0, 0) + option(9, bytes((resolution,))) + END
    capture = pcapng.head() + le(1, len(body) + 12) + body + le(len(body) + 12)
    reader, tag = b"\0\xfe\0\1\x0a", b"\0\xff\0\1\x0a"  # events of other programs: with a CRC error or so
    found = list(pcapng.read_pcapng(capture + packet(3, ticks, reader, b"") + packet(3, ticks, tag, b"")))
    assert [(record.time, record.direction) for record in found] == [(seconds, "out"), (seconds, "in")]


def test_a_trace_of_a_later_format_is_none_of_ours(tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(b'{"format": "teds-trace/12", "made_by": "x"}\n')
    with pytest.raises(BadDataError, match="is not a trace"):
        read_trace(tmp_path / "t")


def test_a_record_as_a_line() -> None:
    sealed = Record(1.5, "out", "nfc", "message", b"\1", "List", opened=b"\xab", sealed=True, uuid="8d4d")
    assert sealed.as_json() == {
        "time": "1970-01-01T00:00:01.500000Z", "direction": "out", "link": "nfc", "layer": "message", "command": "List",
        "sealed": True, "octets": "01", "opened": "ab", "uuid": "8d4d",
    }  # fmt: skip
    frame = Record(0.0, "in", "can", "frame", b"", "empty", identifier=0x1F, fd=True)
    assert frame.as_json() == {
        "time": "1970-01-01T00:00:00.000000Z", "direction": "in", "link": "can", "layer": "frame", "command": "empty",
        "sealed": False, "octets": "", "identifier": "0000001f", "fd": True,
    }  # fmt: skip


@pytest.mark.parametrize(
    "change", [{"direction": "up"}, {"layer": "octet"}, {"octets": "0"}, {"time": "now"}, {"time": 7}, {"octets": None}]
)
def test_a_line_that_is_no_record_is_named_unless_it_was_cut_off(change: dict[str, Any]) -> None:
    good = lines.line(Record(0.0, "in", "can", "frame", b""))
    bad = json.dumps({**json.loads(good), **change}).encode()
    with pytest.raises(BadDataError, match="Line 4 of the trace"):
        list(lines.read_lines(lines.head() + good + b"\n" + bad + b"\n" + good))
    assert len(list(lines.read_lines(lines.head() + good + bad))) == 1


@pytest.mark.parametrize("bad", [b"{", b"7", b"[]", b"{}", b"[" * 100_000, b"\xff"])
def test_a_line_of_a_trace_that_is_no_object_of_it_is_named(bad: bytes) -> None:
    with pytest.raises(BadDataError, match="Line 2 of the trace is not a valid record"):
        list(lines.read_lines(lines.head() + bad + b"\n"))
    assert list(lines.read_lines(lines.head() + bad)) == []


def test_a_trace_that_nothing_was_written_to_is_removed_if_it_is_not_kept(tmp_path: Path) -> None:
    for keep, written in ((True, False), (False, True), (False, False)):
        path = tmp_path / f"{keep}-{written}.trace"
        trace = open_trace(path, print)
        assert trace.is_empty
        if written:
            trace.frame("can", "out", b"\2", identifier=1)
        assert trace.is_empty is not written
        trace.close(keep_empty=keep)
        trace.close(keep_empty=False)
        assert path.exists() == (keep or written)


def test_a_full_disk_ends_the_trace_once_and_no_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    path = tmp_path / "t.trace"
    trace = open_trace(path, said.append)
    write = os.write
    monkeypatch.setattr(os, "write", lambda descriptor, octets: write(descriptor, octets[:7]))
    trace.frame("can", "out", b"\2", identifier=1)
    assert len(list(read_trace(path))) == 1, "what the system takes by pieces is written whole"

    def full(_descriptor: int, _octets: bytes) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    for _ in range(2):
        trace.frame("can", "out", b"\3", identifier=1)
    monkeypatch.setattr(os, "write", write)
    trace.frame("can", "out", b"\4", identifier=1)
    trace.close()
    assert said == [f"The trace {path} ends here: No space left on device. The command goes on."]
    assert [record.octets for record in read_trace(path)] == [b"\2"]


def test_a_capture_by_another_program_is_read() -> None:
    """Big-endian, its times in ns, a link type that is not ours beside, no options."""

    def block(kind: int, body: bytes) -> bytes:
        return struct.pack(">II", kind, len(body) + 12) + body + struct.pack(">I", len(body) + 12)

    def packet(interface: int, ticks: int, data: bytes) -> bytes:
        padded = data + bytes(-len(data) % 4)
        return block(
            6, struct.pack(">IIIII", interface, ticks >> 32, ticks & 0xFFFFFFFF, len(data), len(data)) + padded
        )

    section = block(0x0A0D0D0A, struct.pack(">IHHq", 0x1A2B3C4D, 1, 0, -1))
    ethernet = block(1, struct.pack(">HHI", 1, 0, 0))
    can = block(1, struct.pack(">HHI", 227, 0, 0) + struct.pack(">HHB3x", 9, 1, 9))
    frame = struct.pack(">IBBH", 0x98DA21F1, 2, 0, 0) + b"\x01\x02"
    capture = section + ethernet + can + packet(0, 5, b"not ours") + packet(1, 1_500_000_000_000_000_000, frame)
    (record,) = pcapng.read_pcapng(capture)
    assert (record.time, record.identifier, record.octets) == (1_500_000_000.0, 0x18DA21F1, b"\x01\x02")


@pytest.mark.parametrize(
    "octets",
    [
        b"",
        b"some text\n",
        b'{"format": "teds-image/1"}\n',
        lines.head() + b"{}\n{}\n",
        lines.head() + b"[1]\n\n",
        pcapng.head() + struct.pack("<II", 6, 13) + bytes(20),
        pcapng.head() + struct.pack("<II", 6, 32) + struct.pack("<IIIII", 9, 0, 0, 0, 0) + struct.pack("<I", 32),
        pcapng.head() + struct.pack("<II", 6, 32) + struct.pack("<IIIII", 0, 0, 0, 99, 99) + struct.pack("<I", 32),
    ],
)
def test_what_is_no_trace_is_bad_data(octets: bytes, tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(octets)
    with pytest.raises(BadDataError):
        list(read_trace(tmp_path / "t"))


def test_a_trace_is_private_and_never_over_another_file(tmp_path: Path) -> None:
    messages: list[str] = []
    path = tmp_path / "t.trace"
    trace = open_trace(path, messages.append)
    trace.message("nfc", "out", b"\1", "Sealed", uuid=NODE, sealed=True)
    trace.close()
    trace.frame("can", "out", b"\2", identifier=1)  # after its end: nothing, and no error
    assert path.stat().st_mode & 0o777 == 0o600
    (record,) = read_trace(path)
    assert record.command == "Sealed, not opened"
    with pytest.raises(UsageError):
        open_trace(path, messages.append)
    with pytest.raises(NotFoundError):
        open_trace(tmp_path / "none" / "t", messages.append)
    assert not messages


@pytest.mark.parametrize("name", ["t.trace", "t.pcapng"])
def test_a_frame_has_the_time_of_its_arrival_however_late_it_is_written_down(name: str, tmp_path: Path) -> None:
    trace = open_trace(tmp_path / name, lambda _text: None)
    before = time.time()
    trace.frame("can", "in", b"\2", identifier=1, at=time.monotonic() - 3600)
    trace.frame("can", "out", b"\2", identifier=1)
    after = time.time()
    trace.close()
    came, left = read_trace(tmp_path / name)
    assert before - 1 < came.time + 3600 < after + 1
    assert before - 1 < left.time < after + 1


def le_block(kind: int, body: bytes) -> bytes:
    return le(kind, len(body) + 12) + body + le(len(body) + 12)


def test_a_capture_in_several_sections_counts_the_interfaces_of_each_anew() -> None:
    section = le_block(0x0A0D0D0A, struct.pack("<IHHq", 0x1A2B3C4D, 1, 0, -1))
    ethernet, nfc = (le_block(1, struct.pack("<HHI", link_type, 0, 0)) for link_type in (1, 264))
    frame = packet(0, 1_500_000, b"\0\xfa\0\2\xe0\x80", b"")
    (record,) = pcapng.read_pcapng(section + ethernet + frame + section + nfc + frame)
    assert (record.link, record.octets, record.time) == ("nfc", b"\xe0\x80", 1.5)


@pytest.mark.parametrize(
    ("flags", "direction"), [(1, "in"), (2, "out"), (0, "in"), (0b0110, "out"), (0b0101, "in"), (2 | 4 << 5, "out")]
)
def test_the_direction_is_two_bits_of_the_flags_of_a_packet(flags: int, direction: str) -> None:
    data = b"\x98\xda\x21\xf1\2\0\0\0\1\2"
    (record,) = pcapng.read_pcapng(pcapng.head() + packet(0, 0, data, option(2, le(flags)) + END))
    assert record.direction == direction


@pytest.mark.parametrize(
    ("data", "octets", "fd"),
    [
        (b"\x98\xda\x21\xf1\2\0\0\0\1\2\0\0\0\0\0\0", b"\1\2", False),  # the kernel gives all 8 octets of a frame
        (b"\x98\xda\x21\xf1\2\4\0\0\1\2", b"\1\2", True),
        (b"\x98\xda\x21\xf1\2\1\0\0\1\2", b"\1\2", False),
        (b"\x98\xda\x21\xf1\x0c\0\0\0" + bytes(12), bytes(12), True),  # a program that sets no flag
    ],
)
def test_a_frame_of_the_bus_has_its_length_and_its_form(data: bytes, octets: bytes, fd: bool) -> None:
    (record,) = pcapng.read_pcapng(pcapng.head() + packet(0, 0, data, OUT + END))
    assert (record.octets, record.fd, record.identifier) == (octets, fd, 0x18DA21F1)


@pytest.mark.parametrize("name", ["t.trace", "t.pcapng"])
def test_a_message_that_was_not_opened_is_sealed_and_says_so(tmp_path: Path, name: str) -> None:
    trace = open_trace(tmp_path / name, print)
    trace.message("nfc", "in", b"\1", "reply", uuid=NODE, sealed=True)
    trace.message("nfc", "in", b"\2", "reply", uuid=NODE, sealed=True, opened=b"")
    trace.message("nfc", "in", b"\3", "reply", uuid=NODE)
    trace.close()
    assert [(record.command, record.sealed, record.opened) for record in read_trace(tmp_path / name)] == [
        ("reply, not opened", True, None), ("reply", True, b""), ("reply", False, None),
    ]  # fmt: skip


def test_four_octets_of_a_head_are_no_trace(tmp_path: Path) -> None:
    (tmp_path / "t").write_bytes(b"\x0a\x0d\x0d\x0a")
    with pytest.raises(BadDataError, match="is not a trace"):
        read_trace(tmp_path / "t")


@pytest.mark.parametrize(
    ("link", "identifier", "octets", "words"),
    [
        ("nfc", None, "3004", "READ from page 4"),
        ("pcsc", None, "00b000000f", "READ BINARY"),
        ("ble", None, "3004", ""),
        ("can", 0x18DA21F1, "025507", "f1 to 21: single frame, transaction 85, 1 octets"),
    ],
)
def test_each_frame_is_named_by_its_link(
    tmp_path: Path, link: str, identifier: int | None, octets: str, words: str
) -> None:
    path = tmp_path / "t.trace"
    trace = open_trace(path, print)
    trace.frame(link, "out", bytes.fromhex(octets), identifier=identifier, fd=True)
    (record,) = read_trace(path)  # written at once
    trace.close()
    assert (record.link, record.layer, record.direction, record.octets.hex()) == (link, "frame", "out", octets)
    assert (record.command, record.identifier, record.fd) == (words, identifier, identifier is not None)


@pytest.mark.parametrize(
    ("options", "direction"),
    [
        (option(2, le(2)), "out"),
        (option(2, le(1)), "in"),
        (option(2, le(0)), "in"),  # not said
        (option(2, le(0xFFFF_FFFE)), "out"),  # its other bits say other things
        (option(2, b"\2\0"), "in"),  # damaged
        (option(1, b"name") + option(4, le(2)), "in"),  # four octets of another option
    ],
)
def test_the_direction_of_a_packet_is_in_two_bits_of_its_flags(options: bytes, direction: str) -> None:
    """Link-layer flags of pcapng: 01 inbound, 10 outbound."""
    octets = packet(0, 0, b"\x98\xda\x21\xf1\1\0\0\0\1", options + END)
    (record,) = pcapng.read_pcapng(pcapng.head() + octets)
    assert record.direction == direction


def test_a_trace_that_cannot_be_made_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is a file or a link written over that someone else makes meanwhile."""
    with pytest.raises(NotFoundError) as missing:
        open_trace(tmp_path / "nowhere" / "t", pytest.fail)
    assert missing.value.message == f"There is no folder {tmp_path / 'nowhere'}."
    monkeypatch.setattr(recorder, "require_new", lambda _path: (tmp_path / "t").symlink_to("elsewhere"))
    with pytest.raises(StoreError) as failed:
        open_trace(tmp_path / "t", pytest.fail)
    assert failed.value.message == f"The trace {tmp_path / 't'} cannot be written: File exists."
    assert failed.value.hint == "Choose another file for --trace."


@pytest.mark.parametrize("beyond", [0, 1])
def test_a_trace_beyond_its_bound_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, beyond: int) -> None:
    written = lines.head() + lines.line(Record(0.0, "in", "can", "frame", b"\1", identifier=1))
    (tmp_path / "t").write_bytes(written)
    bound = len(written) - beyond
    monkeypatch.setattr(recorder, "_MOST_OCTETS", bound)
    if beyond:
        with pytest.raises(BadDataError) as refused:
            read_trace(tmp_path / "t")
        assert refused.value.message == (
            f"{tmp_path / 't'} is larger than {bound} octets, which is too large for a trace."
        )
    else:
        assert len(list(read_trace(tmp_path / "t"))) == 1


def test_blocks_that_are_no_packets_are_passed_over() -> None:
    """Names, statistics and what other programs add, whatever is in them; the last block may have no body."""
    frame = packet(0, 1_500_000, b"\x98\xda\x21\xf1\1\0\0\0\1", OUT + END)
    others = le_block(4, bytes(40)) + le_block(5, b"\xff" * 40) + le_block(0x0BAD, frame[8:-4])
    found = list(
        pcapng.read_pcapng(pcapng.head() + others + frame + le_block(0x80000001, b"") + frame + le_block(3, b""))
    )
    assert [(record.direction, record.octets) for record in found] == [("out", b"\1")] * 2


@pytest.mark.parametrize("length", [0, 8, 11, 13, 14, 30])
def test_a_block_of_an_impossible_length_is_named_with_its_place(length: int) -> None:
    """At least its own twelve octets, and a multiple of four; otherwise a reader would lose its place or loop."""
    head = pcapng.head()
    with pytest.raises(BadDataError) as refused:
        list(pcapng.read_pcapng(head + le(6, length) + bytes(60)))
    assert refused.value.message == f"The pcapng block at octet {len(head)} says it has {length} octets."


def test_what_follows_the_end_of_the_options_is_none() -> None:
    data = b"\x98\xda\x21\xf1\1\0\0\0\1"
    for options, direction in ((OUT + END + IN, "out"), (END + OUT, "in"), (OUT, "out")):
        (record,) = pcapng.read_pcapng(pcapng.head() + packet(0, 0, data, options))
        assert record.direction == direction


@pytest.mark.parametrize(
    "options", [b"", option(2, b"can"), option(9, b"\6") + option(2, b"can"), option(12, b"Linux")]
)
def test_times_are_in_microseconds_unless_an_interface_says_otherwise(options: bytes) -> None:
    own = le_block(1, struct.pack("<HHI", 264, 0, 0) + options + END)
    (record,) = pcapng.read_pcapng(pcapng.head() + own + packet(3, 1_500_000, b"\0\xfe\0\1\x0a", b""))
    assert record.time == 1.5


def test_the_words_of_a_message_are_in_a_comment_alone() -> None:
    (record,) = pcapng.read_pcapng(pcapng.head() + packet(2, 0, b"\1", option(4, b"abcd") + OUT + END))
    assert record.command == ""
    (record,) = pcapng.read_pcapng(pcapng.head() + packet(2, 0, b"\1", option(4, b"abcd") + option(1, b"List") + END))
    assert record.command == "List"


def test_octets_that_a_packet_says_and_lacks_are_named() -> None:
    head, body = pcapng.head(), le(0, 0, 0, 9, 9) + bytes(8)
    with pytest.raises(BadDataError) as refused:
        list(pcapng.read_pcapng(head + le_block(6, body)))
    assert refused.value.message == (
        f"The pcapng block at octet {len(head)} does not parse: 9 octets are said to be captured, 8 are there."
    )


@pytest.mark.parametrize("block", [le_block(1, b""), le_block(6, le(0, 0, 0, 0)), le_block(6, le(9, 0, 0, 0, 0))])
def test_a_block_that_is_too_short_or_of_no_interface_is_named(block: bytes) -> None:
    with pytest.raises(BadDataError, match=r"^The pcapng block at octet \d+ does not parse"):
        list(pcapng.read_pcapng(pcapng.head() + block))


def test_a_trace_begins_with_its_format_and_who_made_it() -> None:
    assert lines.head().count(b"\n") == 1
    assert json.loads(lines.head()) == {"format": "teds-trace/1", "made_by": f"teds-provision {__version__}"}


def test_of_several_comments_of_a_message_the_first_of_words_is_its_name() -> None:
    comments = (b"node: 8d4d", b"List", b"a note of a person, not opened", b"link: nfc frame")
    options = b"".join(option(1, comment) for comment in comments)
    (record,) = pcapng.read_pcapng(pcapng.head() + packet(2, 0, b"\1", options + END))
    assert (record.command, record.sealed, record.uuid) == ("List", False, "8d4d")
    assert (record.link, record.layer) == ("nfc", "frame")
    (bare,) = pcapng.read_pcapng(pcapng.head() + packet(2, 0, b"\1", OUT + END))
    assert (bare.command, bare.link, bare.layer, bare.sealed, bare.uuid) == ("", "", "message", False, "")
