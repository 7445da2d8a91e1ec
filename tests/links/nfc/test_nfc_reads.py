"""How many commands a station needs to read an answer off a Type 4 tag: each costs 1.5 ms on air."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import GarbledError
from teds_provision.links.nfc.nfcpy import Type4TagCommandError
from teds_provision.links.nfc.tag import ReaderTag, Type4Ndef
from teds_provision.node.nfc.tags import NdefApplication, Type4Memory


class Tag:
    """The NDEF application of a node, in memory; ``strict``: it lets nobody read beyond its message."""

    def __init__(self) -> None:
        self.memory = Type4Memory(2000)
        self.application = NdefApplication(self.memory, lambda seconds: True)
        self.strict = False
        self.reads: list[tuple[int, int]] = []

    def send_apdu(self, cla: int, ins: int, p1: int, p2: int, data: bytes | None = None, mrl: int = 0) -> bytearray:
        offset = p1 << 8 | p2
        if ins == 0xB0:
            self.reads.append((offset, mrl))
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
