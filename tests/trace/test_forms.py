"""Both forms of a trace: what is written is read again, a file that was cut short too, and nothing makes them raise."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.errors import BadDataError, NotFoundError, UsageError
from teds_provision.links.ports import Direction
from teds_provision.trace import pcapng
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
        (0x00000123, "00", "not of the profile"),
    ],
)
def test_frames_of_the_bus_are_named(identifier: int, octets: str, words: str) -> None:
    assert can_words(identifier, bytes.fromhex(octets)) == words


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
