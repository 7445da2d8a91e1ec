"""How many commands a station needs to read an answer off a Type 4 tag: each costs 1.5 ms on air."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import nfc.clf
import nfc.tag
import pytest

from teds_provision.errors import GarbledError
from teds_provision.links.nfc import tag as of_tag
from teds_provision.links.nfc.nfcpy import Type4TagCommandError
from teds_provision.links.nfc.tag import (
    FieldLostError,
    NfcpyType4Ndef,
    ReaderTag,
    Type4Ndef,
    _BufferedFrontend,
    _frame_limits,
    _Type4Tag,
)
from teds_provision.node.nfc.tags import NdefApplication, Type4Memory


class Tag:
    """The NDEF application of a node, in memory.

    ``strict``: it lets nobody read beyond its message; ``mute``: its next answer is lost.
    """

    def __init__(self) -> None:
        self.memory = Type4Memory(2000)
        self.application = NdefApplication(self.memory, lambda seconds: True)
        self.strict = self.mute = False
        self.reads: list[tuple[int, int]] = []

    def send_apdu(self, cla: int, ins: int, p1: int, p2: int, data: bytes | None = None, mrl: int = 0) -> bytearray:
        offset = p1 << 8 | p2
        if ins == 0xB0:
            self.reads.append((offset, mrl))
        if self.mute:
            self.mute = False
            raise Type4TagCommandError(nfc.tag.TIMEOUT_ERROR)
        end = 2 + int.from_bytes(self.memory.read(b"\xe1\x04", 0, 2) or b"", "big")
        if self.strict and ins == 0xB0 and offset + mrl > end:
            raise Type4TagCommandError.from_status(b"\x67\x00")
        body = bytes([len(data)]) + bytes(data) if data else b""
        answer = self.application.run(bytes([cla, ins, p1, p2]) + body + bytes([mrl & 0xFF] if mrl else []), 0)
        assert answer is not None
        assert answer[-2:] == b"\x90\x00"
        return bytearray(answer[:-2])


def written(tag: Tag, *, answer: bytes) -> Any:
    """The station's end after it wrote a request, to which the node puts ``answer``."""
    ndef = Type4Ndef.__new__(Type4Ndef)
    ndef._tag = tag
    assert ndef._read_ndef_data() == b""
    tag.memory.written = lambda octets: tag.memory.put(answer)
    ndef._write_ndef_data(bytearray(b"request"))
    tag.reads.clear()
    return ndef


@pytest.mark.parametrize(
    ("octets", "reads"),
    [
        (78, [(0, 80)]),  # the shortest sealed answer
        (20, [(0, 80)]),
        (79, [(0, 80), (80, 1)]),
        (254, [(0, 80), (80, 176)]),
        (800, [(0, 80), (80, 251), (331, 251), (582, 220)]),
    ],
)
def test_an_answer_comes_with_its_length(octets: int, reads: list[tuple[int, int]]) -> None:
    tag = Tag()
    answer = bytes(range(256)) * 4
    ndef = written(tag, answer=answer[:octets])
    assert ndef._read_ndef_data() == answer[:octets]
    assert tag.reads == reads


def test_a_node_that_is_not_ready_is_asked_for_the_length_alone_from_then_on() -> None:
    tag = Tag()
    ndef = written(tag, answer=b"")
    assert [ndef._read_ndef_data() for _ in range(3)] == [b""] * 3
    tag.memory.put(b"a" * 78)
    assert ndef._read_ndef_data() == b"a" * 78
    assert tag.reads == [(0, 80), (0, 2), (0, 2), (0, 2), (2, 78)]


def test_a_tag_that_cannot_be_read_beyond_its_message_is_read_in_two_steps() -> None:
    tag = Tag()
    ndef = written(tag, answer=b"short")
    tag.strict = True
    assert ndef._read_ndef_data() == b"short"
    assert tag.reads == [(0, 80), (0, 2), (2, 5)]
    ndef._write_ndef_data(bytearray(b"request"))
    assert ndef._read_ndef_data() == b"short"
    assert tag.reads[3:] == [(0, 2), (2, 5)], "and is not asked again"


@pytest.mark.parametrize(("octets", "writeable"), [(101, True), (100, False)])
def test_a_message_that_the_tag_cannot_hold_is_not_written(octets: int, writeable: bool) -> None:
    target = object()
    tag = ReaderTag(
        SimpleNamespace(identifier=b"\1\2\3\4", target=target, clf=SimpleNamespace(target=target)), "Type 4"
    )
    tag._ndef = SimpleNamespace(is_writeable=writeable, capacity=100, octets=b"as it was")
    with pytest.raises(GarbledError, match=f"does not take an NDEF message of {octets} octets"):
        tag.write(bytes(octets))
    assert tag._ndef.octets == b"as it was"
    tag._ndef.is_writeable = True
    tag.write(bytes(100))
    assert tag._ndef.octets == bytes(100)


def test_a_lost_answer_does_not_end_the_quick_way() -> None:
    tag = Tag()
    ndef = written(tag, answer=b"a" * 78)
    tag.mute = True
    assert ndef._read_ndef_data() == b"a" * 78
    tag.reads.clear()
    ndef._write_ndef_data(bytearray(b"request"))
    assert ndef._read_ndef_data() == b"a" * 78
    assert tag.reads == [(0, 80)]


def test_a_file_is_selected_again_after_one_that_is_not_there(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tag then has none open, or still the one before."""
    asked: list[bytes] = []
    monkeypatch.setattr(NfcpyType4Ndef, "_select_fid", lambda self, fid: asked.append(fid) or fid == b"\xe1\x04")
    ndef = Type4Ndef.__new__(Type4Ndef)
    assert [ndef._select_fid(fid) for fid in (b"\xe1\x04", b"\xe1\x04", b"\xe1\x09", b"\xe1\x04")] == [
        True,
        True,
        False,
        True,
    ]
    assert asked == [b"\xe1\x04", b"\xe1\x09", b"\xe1\x04"]


@pytest.mark.parametrize(
    ("ats", "limits"),
    [
        ("0578 80 b0 00", (8, 11)),
        ("0468 b0 00", (8, 11)),
        ("0375 80", (5, 4)),  # announces TB(1), and ends before it
        ("0225", (5, 4)),
        ("0205", (5, 4)),
        ("01", (2, 4)),
        ("", (2, 4)),
    ],
)
def test_an_answer_to_select_may_leave_any_part_out(ats: str, limits: tuple[int, int]) -> None:
    """ISO/IEC 14443-4, 5.2: a format octet, which names those of TA(1), TB(1) and TC(1) that follow."""
    assert _frame_limits(bytes.fromhex(ats)) == limits


class Air:
    """A front end that takes frames of so many octets; the tag answers with ``ats``, and then always ``answer``."""

    def __init__(self, ats: str, sends: int = 256, receives: int = 256) -> None:
        self.ats, self.max_send_data_size, self.max_recv_data_size = bytes.fromhex(ats), sends, receives
        self.sent: list[tuple[bytes, float]] = []
        self.answer: bytes | None = b"\xa3"

    def exchange(self, octets: bytes, timeout: float) -> bytes:
        self.sent.append((bytes(octets), timeout))
        if octets[0] == 0xE0:
            return self.ats
        if self.answer is None:
            raise nfc.clf.TimeoutError
        return self.answer


@pytest.mark.parametrize(
    ("ats", "sends", "receives", "asked", "frame", "periods"),
    [
        ("0578 80 b0 00", 256, 256, "e080", 256, 1 << 11),
        ("0578 80 b0 00", 256, 255, "e070", 256, 1 << 11),
        ("0578 80 b0 00", 64, 256, "e080", 64, 1 << 11),
        ("057f 80 b0 00", 300, 300, "e080", 256, 1 << 11),  # FSCI 9 to 15 are reserved: as 8
        ("0575 80 f0 00", 256, 256, "e080", 64, 1 << 4),  # FWI 15 is reserved: as 4
        ("0575 80 e0 00", 256, 256, "e080", 64, 1 << 14),
        ("01", 256, 256, "e080", 32, 1 << 4),
        ("0270", 256, 256, "e080", 16, 1 << 4),
    ],
)
def test_frames_and_waits_are_those_of_the_tag_and_of_the_reader(
    ats: str, sends: int, receives: int, asked: str, frame: int, periods: int
) -> None:
    """ISO/IEC 14443-4, 5.1 and 5.2.5: FSDI 8 is 256 octets, 7 is 128; the frame waiting time is 302 µs · 2^FWI."""
    air = Air(ats, sends, receives)
    tag = _Type4Tag(air, SimpleNamespace(sdd_res=bytearray(7)))
    assert air.sent[0][0].hex() == asked
    assert tag._dep.miu == frame - 3
    assert tag._dep.fwt == pytest.approx(302.06e-6 * periods, rel=1e-4)


def test_a_type_4_tag_is_there_as_long_as_it_answers_at_all() -> None:
    """An R(NAK) asks for no work, and whatever comes is the tag's."""
    air = Air("0578 80 b0 00")
    tag = _Type4Tag(air, SimpleNamespace(sdd_res=bytearray(7)))
    assert tag.is_present is True
    octets, wait = air.sent[-1]
    assert (octets.hex(), wait) == ("b2", 0.06)
    tag._dep.pni = 1
    air.answer = None
    assert tag.is_present is False
    assert air.sent[-1][0].hex() == "b3"


def test_a_command_has_so_long_as_the_whole_of_its_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr("teds_provision.links.nfc.tag.time.monotonic", lambda: now[0])
    air = Air("")
    front = _BufferedFrontend(air)
    front.until = 105.0
    front.exchange(b"\x02", 9.0)
    now[0] = 104.5
    front.exchange(b"\x02", 9.0)
    front.exchange(b"\x02", 0.1)
    assert [wait for _, wait in air.sent] == [5.0, 0.5, 0.1]
    now[0] = 105.0
    with pytest.raises(Type4TagCommandError):
        front.exchange(b"\x02", 9.0)
    assert len(air.sent) == 3


@pytest.mark.parametrize(("announced", "used"), [(0, 1), (1, 1), (255, 255), (256, 255)])
def test_a_type_4_tag_is_read_and_written_by_one_to_255_octets(
    announced: int, used: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    ndef: Any = Type4Ndef.__new__(Type4Ndef)
    outcomes = [True, False]

    def discover(found: Any) -> bool:
        found._max_le, found._max_lc = announced, announced + 1
        return outcomes.pop(0)

    monkeypatch.setattr(NfcpyType4Ndef, "_discover_ndef", discover)
    assert ndef._discover_ndef() is True
    assert (ndef._max_le, ndef._max_lc) == (used, min(announced + 1, 255))
    assert ndef._discover_ndef() is False


@pytest.mark.parametrize(("reads", "present"), [(1, True), (3, True), (4, True), (4, False)])
def test_a_message_is_read_three_times_at_most_while_its_tag_is_there(
    reads: int, present: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried, pauses = list[int](), list[float]()

    class OneTag(ReaderTag):
        is_present = present

        def _read_once(self) -> bytes | None:
            tried.append(len(tried))
            return b"message" if len(tried) == reads else None

    monkeypatch.setattr(of_tag, "time", SimpleNamespace(sleep=pauses.append))
    tag = OneTag(SimpleNamespace(identifier=b"id"), "Type 4")
    if reads <= 3:
        assert tag.read() == b"message"
    else:
        with pytest.raises(GarbledError if present else FieldLostError) as failure:
            tag.read()
        assert not present or failure.value.message == "The tag has no readable NDEF message."
    assert len(tried) == (min(reads, 3) if present else 1)
    assert pauses == [0.02] * (len(tried) - 1)
