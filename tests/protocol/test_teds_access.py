"""Query, Read, Write and Update of a node, without a session's frames (profile.md, "Writing to flash")."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import pytest

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.messages.frames import Command, CommandRefusedError, Reply
from teds_provision.protocol.tim.teds_access import Staging, TedsAccess
from teds_provision.teds.codec.frame import frame

NO_SUCH_TEDS, NOT_PERMITTED, BAD_FORM, TOO_LARGE, BUSY, WRONG_STATE = 18, 3, 4, 10, 17, 2
ONE, OTHER = cast("Any", "a session"), cast("Any", "another session")


def flash(**blocks: bytes) -> Flash:
    """Return the state of a node with TEDS of channel 0: ``t3`` has access code 3; the one of code 9 is read-only."""
    stored = {(0, int(name[1:])): teds for name, teds in blocks.items()}
    return Flash(bytes(10), b"", b"", blocks=stored, read_only=frozenset({(0, 9)}))


class Node:
    """What a session writes, at a time that the test sets."""

    def __init__(self, state: Flash, *, max_message: int = 512, max_teds: int = 20) -> None:
        self.flash, self.access, self.staging, self.now = state, TedsAccess(max_message, max_teds), Staging(), 100.0

    def write(self, code: int, offset: int, octets: bytes, *, channel: int = 0, session: Any = ONE) -> int | None:
        payload = bytes([code]) + offset.to_bytes(4, "big") + octets
        command = Command(channel, 1, 3, payload)

        def call() -> None:
            reply = self.access.write(self.flash, command, self.staging, session, now=self.now)
            assert reply == Reply(True)

        return refused(call)

    def update(self, code: int, *, session: Any = ONE) -> int | None:
        command = Command(0, 1, 4, bytes([code]))
        return refused(lambda: self.access.update(self.flash, command, self.staging, session, now=self.now))


def refused(call: Callable[[], object]) -> int | None:
    """Return the reason of a refusal, None if there is none."""
    try:
        call()
    except CommandRefusedError as refusal:
        return int(refusal.reason)
    return None


def test_a_write_goes_on_where_the_image_ends_or_drops_what_follows() -> None:
    node = Node(flash())
    assert node.write(3, 1, b"x") == BAD_FORM, "nothing is staged yet"
    assert node.write(3, 0, b"abcd") is None
    assert node.write(3, 5, b"x") == BAD_FORM
    assert node.write(3, 0x1000000, b"x") == BAD_FORM
    assert node.write(3, 4, b"efgh") is None
    assert node.write(3, 2, b"CD") is None
    assert node.write(4, 0, b"") is None
    assert node.staging.staged_by(ONE) == {(0, 3): b"abCD", (0, 4): b""}
    assert node.staging.staged_by(OTHER) == {}
    assert node.write(3, 4, bytes(16)) is None
    assert node.write(3, 4, bytes(17)) == TOO_LARGE
    assert node.write(3, 20, b"x") == TOO_LARGE
    assert len(node.staging.staged_by(ONE)[0, 3]) == 20, "what was refused changes nothing"


@pytest.mark.parametrize(
    ("code", "channel", "reason"),
    [(1, 0, None), (17, 255, None), (128, 0, None), (135, 0, None), (9, 1, None), (9, 0, NOT_PERMITTED),
     (0, 0, NO_SUCH_TEDS), (18, 0, NO_SUCH_TEDS), (127, 0, NO_SUCH_TEDS), (136, 0, NO_SUCH_TEDS),
     (3, 256, NO_SUCH_TEDS)],
)  # fmt: skip
def test_what_a_session_may_write(code: int, channel: int, reason: int | None) -> None:
    assert Node(flash()).write(code, 0, b"x", channel=channel) == reason


def test_a_write_has_five_octets_before_its_data() -> None:
    node = Node(flash())
    short = Command(0, 1, 3, b"\3\0\0\0")
    assert refused(lambda: node.access.write(node.flash, short, node.staging, ONE, now=0.0)) == BAD_FORM


def test_a_node_takes_no_more_teds_than_its_sealed_list_holds() -> None:
    """(54 - 42) / 3 are four of them; the Security TEDS is one, whether it is written or not."""
    node = Node(flash(t3=b"stored"), max_message=54)
    assert node.write(4, 0, b"x") is None
    assert node.write(3, 0, b"x") is None, "it is there already"
    assert node.write(5, 0, b"x") is None
    assert node.write(6, 0, b"x") == TOO_LARGE
    assert node.write(128, 0, b"x") is None
    assert node.write(5, 1, b"x") is None
    assert Node(flash(t3=b"", t4=b"", t5=b""), max_message=53).write(3, 0, b"x") == TOO_LARGE


def test_staging_gives_way_to_a_write_of_another_session_after_60_seconds() -> None:
    node = Node(flash(t3=b"stored"))
    assert node.write(3, 0, b"mine") is None
    node.now += 59.5
    assert node.write(4, 0, b"his", session=OTHER) == BUSY
    assert node.update(3, session=OTHER) == BUSY
    assert node.update(4) is None, "a query of what is not staged: the session uses its staging"
    node.now += 59.5
    assert node.write(4, 0, b"his", session=OTHER) == BUSY
    node.now += 0.5
    assert node.update(3, session=OTHER) == BUSY, "to a write alone"
    assert node.write(4, 0, b"his", session=OTHER) is None
    assert (node.staging.staged_by(ONE), node.staging.staged_by(OTHER)) == ({}, {(0, 4): b"his"})
    node.staging.end(ONE)
    assert node.write(3, 0, b"mine") == BUSY
    node.staging.touch(ONE, node.now + 60)
    node.now += 60
    assert node.write(3, 0, b"mine") is None, "only its own session keeps a staging"
    node.staging.end(ONE)
    assert node.write(4, 0, b"his", session=OTHER) is None
    node.staging.end()
    assert node.staging.staged_by(OTHER) == {}


def test_an_update_of_what_is_not_staged_is_a_query_unless_a_commit_was_meant() -> None:
    node = Node(flash(t3=b"\0\0\0\2\xab\xcd"))
    command = Command(0, 1, 4, b"\3")
    found = node.access.update(node.flash, command, node.staging, ONE, now=0.0)
    assert found == (Reply(True, bytes.fromhex("0000 00000006 abcd 00000014")), None)
    assert node.update(128) is None, "nothing is staged at all"
    assert node.write(3, 0, b"x") is None
    assert node.update(128) == WRONG_STATE
    assert node.update(3) == BAD_FORM, "Length and Checksum are wrong"
    assert node.write(12, 0, frame(bytes.fromhex("0304000c0101"))) is None
    command = Command(0, 1, 4, b"\x0c")
    found = node.access.update(node.flash, command, node.staging, ONE, now=0.0)
    assert found == (Reply(True, bytes.fromhex("0000 0000000c ffe2 00000014")), None)
    assert node.write(3, 0, frame(bytes.fromhex("0304000c0101"))) is None
    assert node.update(3) == BAD_FORM, "it is of another class"


@pytest.mark.parametrize(
    ("code", "reply"),
    [
        (3, "00 00 00000006 abcd 00000014"),
        (4, "12 00 00000000 0000 00000014"),
        (9, "03 00 00000000 0000 00000014"),
        (13, "02 00 00000000 0000 00000014"),
        (129, "42 00 00000000 0000 00000014"),
    ],
)
def test_a_query_names_attributes_size_checksum_and_the_largest_size(code: int, reply: str) -> None:
    node = Node(flash(t3=b"\0\0\0\2\xab\xcd"))
    assert node.access.query(node.flash, Command(0, 1, 1, bytes([code]))).payload == bytes.fromhex(reply)
    assert node.access.query(node.flash, Command(0, 1, 1, b"\x80")).payload[0] == 0x40, "from 128 on a manufacturer's"


@pytest.mark.parametrize("payload", [b"", b"\3\0"])
def test_a_query_and_an_update_name_one_teds_and_nothing_more(payload: bytes) -> None:
    node = Node(flash(t3=b"stored"))
    assert refused(lambda: node.access.query(node.flash, Command(0, 1, 1, payload))) == BAD_FORM
    asked = Command(0, 1, 4, payload)
    assert refused(lambda: node.access.update(node.flash, asked, node.staging, ONE, now=0.0)) == BAD_FORM
    for wrong in (b"\3" + bytes(3), b"\3" + bytes(5)):
        assert refused(lambda wrong=wrong: node.access.read(node.flash, Command(0, 1, 2, wrong))) == BAD_FORM


@pytest.mark.parametrize(
    ("offset", "octets"),
    [
        (0, bytes(range(18))),
        (17, bytes(range(17, 35))),
        (30, bytes(range(30, 40))),
        (40, b""),
        (0x1000000, b""),
        (4_294_967_295, b""),
    ],
)
def test_a_read_carries_what_one_sealed_message_holds(offset: int, octets: bytes) -> None:
    node = Node(flash(t3=bytes(range(40))), max_message=64)  # 64 less 46
    command = Command(0, 1, 2, b"\3" + offset.to_bytes(4, "big"))
    assert node.access.read(node.flash, command) == Reply(True, min(offset, 40).to_bytes(4, "big") + octets)
    missing = Command(0, 1, 2, b"\4" + bytes(4))
    assert refused(lambda: node.access.read(node.flash, missing)) == NO_SUCH_TEDS
