"""Manage (128.23) on the node: which packets pass to the manager, in which order they are refused, and what waits."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from typing import Any

import cbor2
import pytest
from hypothesis import given
from hypothesis import strategies as st

from teds_provision.protocol.messages.firmware import FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import (
    Command,
    Function,
    Reason,
    Reply,
    query_teds,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.messages.smp import (
    ECHO,
    LISTED,
    RESTART,
    SET_STATE,
    STATES,
    UPLOAD,
    SmpCommand,
    SmpPacket,
    decode_map,
    decode_packet,
)
from teds_provision.protocol.operation.commands import OperateCommand
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.tim import Tim

from .desk import NODE, Desk
from .operation.bench import DIGEST as DIGEST_OF_TEDS
from .operation.bench import SECOND, Bench

DIGEST = bytes(range(32))
SET_ADDRESS = security_command(Function.SET_CAN_ADDRESS, bytes([192]))


@dataclass
class Manager:
    """A manager of which a test says what it is; it notes what reached it."""

    offered: bool = True
    buffer: int = 1024
    on_trial: bool = False
    pending: bool = False
    got: list[SmpPacket] = field(default_factory=list)
    restarts: int = 0
    answer: dict[str, Any] = field(default_factory=dict)
    raw: bytes | None = None
    """The whole reply, in place of one with the answer."""

    def manage(self, packet: bytes) -> bytes:
        self.got.append(decode_packet(packet))
        return self.got[-1].reply(cbor2.dumps(self.answer)).encode() if self.raw is None else self.raw

    def restart(self) -> None:
        self.restarts += 1

    def about(self) -> FirmwareReport:
        return FirmwareReport("board/loadcell", flags=FirmwareFlag.MANAGE)

    def locate(self, seconds: int) -> None:
        raise AssertionError("it has nothing to blink")


class ManagedDesk(Desk):
    """A node with a manager, keyed, and a session on the bus."""

    def __init__(self, **of_the_manager: Any) -> None:
        self.manager = Manager()
        super().__init__()
        self.agree().open(link="can:f1")
        for name, value in of_the_manager.items():
            setattr(self.manager, name, value)

    def restart(self) -> None:
        self.tim = Tim(
            NODE,
            self.memory,
            lambda: self.now,
            max_message=self.max_message,
            firmware=self.manager,
            manager=self.manager,
        )

    def ask(self, packet: bytes | SmpPacket) -> Reply:
        octets = packet if isinstance(packet, bytes) else packet.encode()
        return self.sealed(security_command(Function.MANAGE, octets), link="can:f1")

    def refuses(self, packet: bytes | SmpPacket) -> int | None:
        """Return the reason of a refusal; nothing reached the manager then."""
        before = len(self.manager.got)
        reply = self.ask(packet)
        assert reply.ok or len(self.manager.got) == before
        return reply.reason

    def second_session(self) -> StationSession:
        """The first session, while the desk goes on with another one, of another station."""
        first = self.session
        self.open(link="can:f2")
        assert first is not None
        return first


def packet(command: SmpCommand, **body: Any) -> SmpPacket:
    return SmpPacket(command, 7, cbor2.dumps(body), True)


def piece(off: int, data: bytes = b"x", **more: Any) -> SmpPacket:
    return packet(UPLOAD, off=off, data=data, **more)


def first(sha: bytes = DIGEST, length: int = 100) -> SmpPacket:
    return piece(0, len=length, sha=sha)


START = packet(SET_STATE, hash=DIGEST)
START_TOO = SmpPacket(SET_STATE, 7, b"\xa2\x64hash\x58\x20" + DIGEST + b"\x67confirm\xf4", True)
CONFIRM = packet(SET_STATE, confirm=True)
HARMLESS = [packet(STATES), packet(ECHO, d="a"), *(packet(command) for command in LISTED if command.first == 8)]


MAY_PASS = {
    *((8, 0, 6), (8, 0, 8), (8, 1, 0), (8, 1, 6)),
    *((10, 0, 0), (10, 0, 5), (10, 1, 0), (10, 1, 1)),
}
"""The list of wire.md: operation, group, id."""


def test_what_is_listed_reaches_the_manager_as_it_is() -> None:
    desk = ManagedDesk()
    passing = [*HARMLESS, START, START_TOO, first(), piece(1)]
    for packet_in in passing:
        reply = desk.ask(packet_in)
        assert reply.ok
        assert decode_packet(reply.payload) == packet_in.reply(cbor2.dumps({}))
    assert desk.manager.got == passing


def test_no_other_command_passes_whatever_its_numbers() -> None:
    desk = ManagedDesk()
    for first_octet in (0x08, 0x0A):
        for group in (*range(12), 63, 64, 0x100, 0xFFFF):
            for number in (*range(12), 255):
                asked = SmpCommand(first_octet, group, number)
                if asked not in MAY_PASS:
                    assert desk.refuses(packet(asked)) == Reason.NOT_PERMITTED, asked
    assert not desk.manager.got


@pytest.mark.parametrize(
    ("octets", "reason"),
    [
        (bytes(1025), Reason.TOO_LARGE),
        (b"", Reason.BAD_FORM),
        (packet(STATES).encode()[:8], Reason.BAD_FORM),
        (SmpPacket(SmpCommand(0x0A, 63, 0), 7, b"", True).encode(), Reason.BAD_FORM),  # 8 octets, before the list
        (packet(STATES).encode() + b"\0", Reason.BAD_FORM),  # SMP's length
        (packet(STATES).encode() * 2, Reason.BAD_FORM),  # two packets in one
        (b"\x08\x01" + packet(STATES).encode()[2:], Reason.BAD_FORM),  # flags
        (b"\x00" + packet(STATES).encode()[1:], Reason.BAD_FORM),  # version 1
        (b"\x09" + packet(STATES).encode()[1:], Reason.BAD_FORM),  # a reply
        (b"\x0b\0\0\1\0\0\7\5\xa0", Reason.BAD_FORM),
        (packet(SmpCommand(0x0A, 63, 0)).encode()[:-1] + b"\xff", Reason.NOT_PERMITTED),  # the list before the body
    ],
)
def test_the_form_of_a_packet_is_checked_before_the_list(octets: bytes, reason: Reason) -> None:
    assert ManagedDesk().refuses(octets) == reason


@pytest.mark.parametrize(
    "wrong",
    [
        SmpPacket(RESTART, 7, cbor2.dumps({"force": 1}), True),
        SmpPacket(RESTART, 7, b"\xbf\xff", True),
        packet(SET_STATE),
        packet(SET_STATE, hash=DIGEST, confirm=True),  # makes permanent what has not run
        packet(SET_STATE, confirm=False),
        packet(SET_STATE, hash=DIGEST[:-1]),
        packet(SET_STATE, confirm=True, hash=DIGEST),
        SmpPacket(SET_STATE, 7, b"\xbf\x67confirm\xf5\xff", True),
        SmpPacket(SET_STATE, 7, CONFIRM.body + b"\0", True),
        packet(UPLOAD, data=b"x"),
        piece(-1),
        piece(True),
        packet(UPLOAD, off=0, data=b"x", len=9, sha="text"),
        packet(UPLOAD, off=0.0, data=b"x"),
        SmpPacket(UPLOAD, 7, bytes.fromhex("a1636f6666c24101"), True),  # a tag that reads as a number
        SmpPacket(STATES, 7, b"\xf6", True),
        SmpPacket(STATES, 7, b"\xa1\x61a\xfb" + bytes(8), True),
        SmpPacket(STATES, 7, b"\xd9\xd9\xf7\xa0", True),
        SmpPacket(ECHO, 7, b"\xa1\x61d", True),
        SmpPacket(STATES, 7, b"\xa0\xa0", True),  # more than one item
        SmpPacket(UPLOAD, 7, piece(1).body + b"\0", True),
        SmpPacket(UPLOAD, 7, bytes.fromhex("a2636f666600636f666601"), True),  # two offsets
        SmpPacket(UPLOAD, 7, bytes.fromhex("a2636f6666000102"), True),  # a key that is no text
    ],
)
def test_a_body_of_another_form_is_refused(wrong: SmpPacket) -> None:
    desk = ManagedDesk(on_trial=True)
    assert desk.refuses(wrong) == Reason.BAD_FORM


def test_maps_of_indefinite_length_pass_if_nothing_depends_on_their_octets() -> None:
    desk = ManagedDesk()
    assert desk.refuses(SmpPacket(STATES, 7, b"\xbf\xff", True)) is None
    assert desk.refuses(SmpPacket(UPLOAD, 7, b"\xbf\x63off\x01\xff", True)) == Reason.BAD_FORM, "its off counts"


def test_a_board_that_cannot_revert_offers_nothing_in_a_session_and_shows_it_to_no_stranger() -> None:
    desk = ManagedDesk(offered=False)
    for octets in (b"", bytes(2000), packet(STATES).encode()):
        assert desk.refuses(octets) == Reason.UNKNOWN_COMMAND
    for plain in (ManagedDesk(offered=False), ManagedDesk()):
        command = security_command(Function.MANAGE, packet(STATES).encode())
        for link in ("nfc", "can:f1"):
            assert plain.plain(command, link=link, tapped=link == "nfc").reason == Reason.NOT_PERMITTED


def test_the_longest_packet_is_what_message_and_buffer_hold() -> None:
    desk = ManagedDesk(buffer=4000)
    room = 2048 - 53 - len(piece(1, b"x" * 300).encode()) + 300
    assert desk.refuses(piece(1, bytes(room))) is None
    assert desk.refuses(piece(1, bytes(room + 1))) == Reason.TOO_LARGE


# -- states ------------------------------------------------------------------------------------------------------------


def test_only_an_image_on_trial_is_confirmed() -> None:
    desk = ManagedDesk()
    assert desk.refuses(CONFIRM) == Reason.WRONG_STATE
    desk.manager.on_trial = True
    assert desk.refuses(CONFIRM) is None


@pytest.mark.parametrize("state", ["on_trial", "pending"])
def test_the_way_back_is_not_overwritten(state: str) -> None:
    desk = ManagedDesk(**{state: True})
    for packet_in in (START, START_TOO, first(), piece(5)):
        assert desk.refuses(packet_in) == Reason.BUSY
    for packet_in in HARMLESS:
        assert desk.refuses(packet_in) is None
    assert desk.ask(packet(RESTART)).ok


def test_on_trial_nothing_that_is_stored_changes() -> None:
    desk = ManagedDesk()
    desk.manager.on_trial = True
    stored = desk.flash
    agreement = security_command(Function.REQUEST, bytes(259))
    for command in (
        write_teds(0, 1, 0, b"x"),
        update_teds(0, 128),
        agreement,
        security_command(Function.CONFIRM, bytes(16)),
        security_command(Function.RESET, bytes(32)),
        SET_ADDRESS,
    ):
        assert desk.sealed(command, link="can:f1").reason == Reason.BUSY, command
    assert desk.plain(agreement).reason == Reason.BUSY, "tapped, too"
    assert desk.plain(agreement, tapped=False, link="can:f2").reason == Reason.NOT_PERMITTED, "permission goes before"
    assert desk.flash == stored
    assert desk.sealed(query_teds(0, 128), link="can:f1").ok
    desk.manager.on_trial = False
    assert desk.sealed(SET_ADDRESS, link="can:f1").ok


def test_a_restart_comes_when_its_reply_has_left_and_from_nowhere_else() -> None:
    desk = ManagedDesk()
    reply = desk.ask(packet(RESTART))
    assert decode_packet(reply.payload) == packet(RESTART).reply(b"\xa0")
    assert not desk.manager.got, "the manager is not asked"
    assert desk.manager.restarts == 0
    desk.tim.reply_sent("can:f2")
    assert desk.manager.restarts == 0
    desk.tim.reply_sent("can:f1")
    desk.tim.reply_sent("can:f1")
    assert desk.manager.restarts == 1


# -- uploads -----------------------------------------------------------------------------------------------------------


def of_another(desk: ManagedDesk, session: StationSession, original: SmpPacket, link: str = "can:f1") -> int | None:
    outer = desk.plain(session.seal(security_command(Function.MANAGE, original.encode())), link=link, tapped=False)
    return session.unseal(outer.payload).reason


def test_while_an_upload_lives_nothing_of_others_disturbs_it() -> None:
    desk = ManagedDesk(answer={"off": 1})
    assert desk.refuses(first()) is None
    other = desk.second_session()
    assert desk.session is not None
    second, desk.session = desk.session, other
    for packet_in in (first(), piece(1), START, packet(RESTART)):
        assert of_another(desk, second, packet_in, "can:f2") == Reason.BUSY
    assert of_another(desk, second, packet(STATES), "can:f2") is None
    operate = Command(1, 4, 1, bytes(17))
    for command in (write_teds(0, 1, 0, b"x"), operate):
        for session, link in ((other, "can:f1"), (second, "can:f2")):
            outer = desk.plain(session.seal(command), link=link, tapped=False)
            due = Reason.BUSY if command.command_class == 1 else Reason.UNKNOWN_COMMAND  # it does not measure
            assert session.unseal(outer.payload).reason == due
    assert desk.refuses(piece(1)) is None, "its own goes on"
    desk.now += 60
    assert of_another(desk, second, piece(1), "can:f2") is None, "one that was abandoned has ended"


def test_an_upload_ends_when_it_is_complete_or_its_session_ends() -> None:
    for ends in ("complete", "closed", "another session closed"):
        desk = ManagedDesk(answer={"off": 1})
        assert desk.refuses(first(length=100)) is None
        assert desk.sealed(write_teds(0, 1, 0, b"x"), link="can:f1").reason == Reason.BUSY
        if ends == "complete":
            desk.manager.answer = {"off": 100, "match": True}
            assert desk.refuses(piece(1, bytes(99))) is None
        elif ends == "closed":
            assert desk.sealed(security_command(Function.CLOSE), link="can:f1").ok
            desk.open(link="can:f1")
        else:
            own = desk.second_session()
            assert desk.sealed(security_command(Function.CLOSE), link="can:f2").ok
            desk.session = own
        reason = desk.sealed(write_teds(0, 1, 0, b"x"), link="can:f1").reason
        assert reason == (Reason.BUSY if ends == "another session closed" else None)


def test_the_length_of_an_upload_is_that_of_its_first_piece() -> None:
    desk = ManagedDesk(answer={"off": 1})
    assert desk.refuses(first(length=100)) is None
    desk.manager.answer = {"off": 50}
    assert desk.refuses(piece(1, bytes(49), len=50)) is None
    assert desk.sealed(write_teds(0, 1, 0, b"x"), link="can:f1").reason == Reason.BUSY
    desk.manager.answer = {"off": 100}
    assert desk.refuses(piece(50, bytes(50), len=2000)) is None
    assert desk.sealed(write_teds(0, 1, 0, b"x"), link="can:f1").ok


def test_a_node_that_measures_claims_nothing_while_an_upload_lives() -> None:
    manager = Manager()
    bench = Bench(firmware=manager, manager=manager).open().open("can:f2")
    operate = OperateCommand(1, DIGEST_OF_TEDS, 10).command()
    manager.answer = {"off": 1}
    upload = security_command(Function.MANAGE, first(length=100).encode())
    assert bench.send(upload).ok
    assert [bench.reason(operate, link) for link in ("can:f1", "can:f2")] == [Reason.BUSY] * 2
    bench.later(60 * SECOND)
    assert [bench.reason(operate, link) for link in ("can:f1", "can:f2")] == [None] * 2
    assert bench.reason(upload) == Reason.BUSY, "and no upload begins under a claim"


def test_a_refused_piece_begins_no_upload() -> None:
    for failed in ({"rc": 8}, {"err": {"group": 1, "rc": 30}}, {"rc": 0, "off": 1}):
        desk = ManagedDesk(answer=failed)
        assert desk.ask(first()).ok, "the manager's error is its reply"
        assert desk.sealed(write_teds(0, 1, 0, b"x"), link="can:f1").ok


def test_another_image_waits_ten_seconds_because_each_start_erases_flash() -> None:
    desk = ManagedDesk(answer={"off": 1})
    assert desk.refuses(first()) is None, "the first one since the start is free"
    assert desk.refuses(first(hashlib.sha256(b"2").digest())) == Reason.BUSY
    desk.now += 5
    assert desk.refuses(first()) is None, "the same image resumes at once, and its ten seconds begin again"
    assert desk.refuses(packet(UPLOAD, off=0, data=b"x", len=9)) == Reason.BUSY, "no digest is another one"
    desk.now += 9.9
    assert desk.refuses(first(bytes(32))) == Reason.BUSY
    desk.now += 0.1
    assert desk.refuses(first(bytes(32))) is None
    assert desk.refuses(piece(1)) is None


def test_what_another_session_has_staged_is_not_lost_by_a_restart() -> None:
    desk = ManagedDesk()
    assert desk.sealed(write_teds(0, 1, 0, b"x"), link="can:f1").ok
    first_session = desk.second_session()
    assert desk.session is not None
    for packet_in in (START, first(), packet(RESTART)):
        assert of_another(desk, desk.session, packet_in, "can:f2") == Reason.BUSY
    assert of_another(desk, first_session, START) is None, "one's own staging is one's own matter"


# -- any octets --------------------------------------------------------------------------------------------------------

plain_values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**63) | st.text(max_size=8) | st.binary(max_size=40),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=6,
)


@given(st.dictionaries(st.text(max_size=6), plain_values, max_size=4))
def test_plain_maps_are_read_as_they_were_written(values: dict[str, Any]) -> None:
    assert decode_map(cbor2.dumps(values)) == values


@given(st.binary(max_size=60))
def test_any_body_is_a_plain_map_or_refused(body: bytes) -> None:
    try:
        values = decode_map(body)
    except ValueError:
        return
    assert decode_map(cbor2.dumps(values)) == values


commands = st.sampled_from(sorted(LISTED)) | st.builds(
    SmpCommand, st.integers(0, 255), st.integers(0, 65535), st.integers(0, 255)
)
bodies = st.binary(max_size=50) | st.dictionaries(
    st.sampled_from(["off", "data", "len", "sha", "hash", "confirm", "d", "image", "slot", "force"]),
    st.booleans() | st.integers(-1, 2000) | st.binary(max_size=33) | st.floats() | st.just(DIGEST),
    max_size=4,
).map(cbor2.dumps)
SHARED_DESK = ManagedDesk(answer={"off": 5})


@given(
    st.builds(SmpPacket, commands, st.integers(0, 255), bodies, st.just(True)).map(SmpPacket.encode)
    | st.binary(max_size=80),
    st.booleans(),
)
def test_whatever_comes_only_what_may_pass_passes(octets: bytes, on_trial: bool) -> None:
    desk = SHARED_DESK
    desk.manager.on_trial, desk.manager.got, desk.now = on_trial, [], desk.now + 50
    reply = desk.ask(octets)
    for got in desk.manager.got:
        assert got.command in LISTED - {RESTART}
        assert got.encode() == octets
        body = decode_map(got.body)
        if got.command == SET_STATE:
            assert body in ({"confirm": True}, {"hash": body.get("hash")}, {"hash": body.get("hash"), "confirm": False})
            assert (body == {"confirm": True}) == on_trial
    assert reply.ok or not desk.manager.got
