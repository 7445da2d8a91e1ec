"""Commands to the node in C over BLE: nothing counts as tapped, and what goes with a connection (wire.md, "BLE")."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from teds_provision.protocol.messages import ble
from teds_provision.protocol.messages.firmware import ABOUT, FirmwareReport
from teds_provision.protocol.messages.frames import (
    IDENTIFY,
    Command,
    Function,
    Reason,
    Reply,
    decode_reply,
    query_teds,
    read_teds,
    refusal,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.session import StationSession
from tests.firmware.desk import CDesk
from tests.protocol.desk import NAME, UUID

pytestmark = pytest.mark.system


class Air(CDesk):
    """A node in the air; ``write`` sends a plain command over a connection as a station does."""

    transaction, report = 0, b""

    def write(self, connection: int, command: Command, *, again: bool = False) -> Reply:
        self.transaction += not again
        assembly, replies = ble.BleAssembly(0xFFFF), []
        for frame in ble.cut(self.transaction, command.encode(), 247):
            for notified in self.node.ble_written(connection, frame):
                if (received := assembly.add_frame(notified)) is not None:
                    assert received.transaction == self.transaction
                    replies.append(decode_reply(received.message))
        (reply,) = replies
        return reply

    def open_over(self, connection: int) -> StationSession:
        """Open a session over a connection; its first good command makes it one."""
        session = StationSession(self.key, UUID)
        session.accept(
            self.write(connection, session.open(self.write(connection, session.request_counter()).payload)).payload
        )
        assert session.unseal(self.write(connection, session.seal(IDENTIFY)).payload).ok
        return session


@pytest.fixture
def air() -> Iterator[Air]:
    air = Air()
    for connection in (0, 1):
        air.node.ble_connected(connection, 247)
    yield air
    CDesk.close_all()


@pytest.mark.parametrize("keyed", [False, True])
def test_nothing_over_ble_counts_as_tapped(air: Air, keyed: bool) -> None:
    if keyed:
        air.agree()
    for command in (
        security_command(1, bytes(259)),
        security_command(2, bytes(16)),
        security_command(10, b"\x21"),
    ):
        assert air.write(0, command) == refusal(Reason.NOT_PERMITTED)


def test_session_and_staging_go_with_their_connection_alone(air: Air) -> None:
    air.agree()
    first, other = air.open_over(0), air.open_over(1)
    assert first.unseal(air.write(0, first.seal(write_teds(1, 12, 0, NAME))).payload).ok
    busy = other.unseal(air.write(1, other.seal(write_teds(1, 12, 0, NAME))).payload)
    assert busy == refusal(Reason.BUSY)
    air.node.ble_disconnected(0)
    air.node.ble_connected(0, 247)
    assert air.write(0, first.seal(IDENTIFY)) == refusal(Reason.WRONG_STATE)
    assert other.unseal(air.write(1, other.seal(write_teds(1, 12, 0, NAME))).payload).ok
    assert other.unseal(air.write(1, other.seal(update_teds(1, 12))).payload).ok


def test_a_repeated_command_is_answered_once_more_until_the_connection_is_gone(air: Air) -> None:
    air.agree()
    session = StationSession(air.key, UUID)
    opening = session.open(air.write(0, session.request_counter()).payload)
    reply = air.write(0, opening)
    assert reply.ok
    assert air.write(0, opening, again=True) == reply
    assert air.write(1, opening, again=True) == refusal(Reason.BAD_TAG), "a connection is a link of its own"
    air.node.ble_disconnected(0)
    air.node.ble_connected(0, 247)
    assert air.write(0, opening, again=True) == refusal(Reason.BAD_TAG)


def test_a_reply_is_kept_for_20_seconds_from_its_end(air: Air) -> None:
    air.agree()
    session = StationSession(air.key, UUID)
    opening = session.open(air.write(0, session.request_counter()).payload)
    (frame,) = ble.cut(7, opening.encode(), 247)
    air.node.ble_write(0, frame)
    air.now += 5
    reply = air.node.ble_notified(0)
    assert reply
    air.now += 19.9
    assert air.node.ble_written(0, frame) == reply
    air.now += 20.0
    assert air.node.ble_written(0, frame) != reply


def test_questions_are_answered_anew_each_time_by_what_is_so_now(air: Air) -> None:
    """Identify, Query, Read, List, Prove and About: their stored reply is never given."""
    air.node.has_firmware(lambda what, _argument, _octets: air.report if what == "a" else b"")
    air.restart()
    for connection in (0, 1):
        air.node.ble_connected(connection, 247)
    air.report = FirmwareReport("board/app", (1, 2, 3)).encode()[1:]
    assert b"board/app" in air.write(0, ABOUT).payload
    air.report = FirmwareReport("board/other", (1, 2, 4)).encode()[1:]
    assert b"board/other" in air.write(0, ABOUT, again=True).payload
    assert air.write(0, IDENTIFY).payload[-1] == 192
    air.node.take_can_address(99)
    assert air.write(0, IDENTIFY, again=True).payload[-1] == 99
    for question in (query_teds(0, 128), read_teds(0, 128, 0)):
        before = air.write(0, question)
        air.agree()
        after = air.write(0, question, again=True)
        assert before != after == air.plain(question)
    question = security_command(Function.LIST)
    assert air.write(0, question).payload == b"\0\0\x80"
    air.open()
    assert air.commit({(1, 12): NAME}).ok
    assert air.write(0, question, again=True).payload == b"\0\0\x80\0\1\x0c"
    prove = security_command(Function.PROVE, bytes(32))
    assert air.write(0, prove).ok
    air.node.chip_fails(1)
    assert air.write(0, prove, again=True) == refusal(Reason.FLASH_FAILURE), "its chip was asked again"


@pytest.mark.parametrize(
    "second",
    ["0008 0040 0014", "0007 0041 0014", "0007 0030 0014", "0007 0040 0013", "0007 0040 0015", "0007 0040 0014", None],
    ids=["transaction", "longer", "shorter", "earlier offset", "later offset", "nothing wrong", "empty"],
)
def test_a_frame_that_does_not_continue_the_message_drops_it(air: Air, second: str | None) -> None:
    """A message of 64 octets in two frames of 20 and 44; without a fault it is answered with refusal 1."""
    message = bytes.fromhex("0000 ff 01 003a") + bytes(58)
    head = bytes.fromhex("0007 0040")
    air.node.ble_written(0, head + b"\0\0" + message[:20])
    rest = message[20:48] if second == "0007 0030 0014" else message[20:] if second else b""  # as long as it says
    replies = air.node.ble_written(0, bytes.fromhex(second or "0007 0040 0014") + rest)
    assert bool(replies) is (second == "0007 0040 0014")
    if not replies:  # and it stays dropped: the right rest comes too late
        assert not air.node.ble_written(0, head + b"\0\x14" + message[20:])
