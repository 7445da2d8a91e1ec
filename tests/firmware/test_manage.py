"""About, Locate and Manage of the node in C: who may, which packets pass, what an upload and a trial keep out."""

from __future__ import annotations

import itertools
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, security_command, write_teds
from teds_provision.protocol.operation.commands import OperateCommand
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.firmware import smp
from tests.firmware.bench import CBench
from tests.firmware.desk import CDesk
from tests.firmware.smp import packet
from tests.protocol.desk import CREDENTIALS, NAME, UUID
from tests.protocol.operation.bench import DIGEST
from tests.protocol.test_manage import ManagedDesk

pytestmark = pytest.mark.system

ABOUT, LOCATE, MANAGE = 21, 22, 23
LOCATES, MANAGES, ON_TRIAL, PENDING, SIGNED = 1, 2, 4, 8, 16
IMAGE, OTHER = bytes(range(32)), bytes(range(32, 64))
TEXT = b"nrf52840dk/nrf52840/loadcell"
_FLASH, _IDENTITY, _FORM = -2, -4, -7


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    CDesk.close_all()
    CBench.close_all()


@dataclass
class Firmware:
    """A board's part: what it reports, and a manager that answers what the test says."""

    flags: int = SIGNED
    text: bytes = TEXT
    answer: object = field(default_factory=dict)
    raw: bytes | None = None
    asked: list[bytes] = field(default_factory=list)
    blinks: list[int] = field(default_factory=list)
    restarts: int = 0
    after: int | None = None
    """The flags once a packet was taken."""

    def __call__(self, what: str, argument: int, octets: bytes) -> bytes:
        if what == "a":
            return bytes([self.flags, 1, 2, 0, 3, 0, 0, 0, 45]) + IMAGE + self.text
        if what == "l":
            self.blinks.append(argument)
        elif what == "r":
            self.restarts += 1
        else:
            self.asked.append(octets)
            self.flags = self.flags if self.after is None else self.after
            if self.raw is not None:
                return self.raw
            return packet((octets[0] | 1, octets[5], octets[7]), smp.encode(self.answer), octets[6])
        return b""


class Board(CDesk):
    """A node in C with firmware that the test holds; sessions by link."""

    firmware: Firmware

    @classmethod
    def make(cls, firmware: Firmware | None = None, *, without: str = "", most: int = 0) -> Board:
        desk = cls()
        desk.firmware = firmware or Firmware()
        desk.node.has_firmware(desk.firmware, most)
        for word in without:
            desk.node.without(word)
        desk.restart()
        return desk

    def keyed(self) -> Board:
        self.agree().open()
        return self

    def manage(self, octets: bytes) -> Reply:
        return self.sealed(Command(0, 128, MANAGE, octets))

    def why(self, octets: bytes) -> Reason | None:
        """Why a packet is refused, None if it is not; it never reaches the manager then."""
        before = len(self.firmware.asked)
        reply = self.manage(octets)
        assert reply.ok or len(self.firmware.asked) == before
        return reply.reason

    def beside(self) -> Session:
        """Another session, over the bus."""
        return Session(self, self.session_on("can:f2"))

    def session_on(self, link: str) -> StationSession:
        kept = self.session
        self.open(link=link)
        made, self.session = self.session, kept
        assert made is not None
        return made


@dataclass
class Session:
    """A second station's session."""

    desk: Board
    session: StationSession
    link: str = "can:f2"

    def sealed(self, command: Command) -> Reply:
        outer = self.desk.plain(self.session.seal(command), link=self.link, tapped=False)
        assert outer.ok
        return self.session.unseal(outer.payload)

    def manage(self, octets: bytes) -> Reply:
        return self.sealed(Command(0, 128, MANAGE, octets))


def piece(off: int, *, octets: int = 1000, sha: bytes = IMAGE, data: bytes = b"x" * 40) -> bytes:
    """Return the packet of an upload at ``off``."""
    values: dict[str, object] = {"off": off, "data": data}
    if off == 0:
        values |= {"len": octets, "sha": sha}
    return packet(smp.UPLOAD, smp.encode(values))


# -- About and Locate --------------------------------------------------------------------------------------------------


def test_about_reports_what_runs() -> None:
    desk = Board.make()
    about = Command(0, 128, ABOUT, b"")
    flags = LOCATES | MANAGES | SIGNED
    expected = bytes([1, flags, 1, 2, 0, 3, 0, 0, 0, 45]) + IMAGE + TEXT
    for link in ("nfc", "can:f1"):
        assert desk.plain(about, link=link, tapped=False).payload == expected
    assert desk.plain(Command(0, 128, ABOUT, b"\0")).reason == Reason.BAD_FORM
    desk.firmware.text = b"a" * 60
    assert desk.plain(about).payload[42:] == b"a" * 48
    desk.keyed()
    assert desk.plain(about, link="can:f1", tapped=False).ok
    assert desk.plain(about, link="nfc").reason == Reason.NOT_PERMITTED
    assert desk.plain(about, link="ble:1", tapped=False).reason == Reason.NOT_PERMITTED
    assert desk.sealed(about).ok


@pytest.mark.parametrize(
    ("without", "flags", "shown"),
    [
        ("L", SIGNED, MANAGES | SIGNED),
        ("M", SIGNED, LOCATES | SIGNED),
        ("R", SIGNED, LOCATES | SIGNED),
        ("", 0, LOCATES),
    ],
    ids=["no LED", "no manager", "cannot restart", "a boot loader that checks nothing"],
)
def test_what_a_board_lacks_is_not_offered(without: str, flags: int, shown: int) -> None:
    desk = Board.make(Firmware(flags=flags), without=without).keyed()
    assert desk.sealed(Command(0, 128, ABOUT, b"")).payload[1] == shown
    assert desk.sealed(Command(0, 128, LOCATE, b"\5")).ok == bool(shown & LOCATES)
    why = None if shown & MANAGES else Reason.UNKNOWN_COMMAND
    assert desk.why(packet(smp.STATES)) == why
    assert desk.why(b"") == (why or Reason.BAD_FORM)


def test_what_a_board_says_of_bits_that_are_not_its_own_is_not_passed_on() -> None:
    """Whether it locates and manages follows from its functions; bits 6 and 7 are 0."""
    desk = Board.make(Firmware(0xFF & ~SIGNED), without="L")
    assert desk.plain(Command(0, 128, ABOUT)).payload[1] == 0x2C


def test_a_board_that_reports_nothing_knows_none_of_the_three() -> None:
    desk = Board.make(without="A")
    assert desk.plain(Command(0, 128, ABOUT, b"")).reason == Reason.UNKNOWN_COMMAND
    assert desk.plain(Command(0, 128, LOCATE, b"\5")).reason == Reason.UNKNOWN_COMMAND
    assert desk.plain(Command(0, 128, MANAGE, b"")).reason == Reason.NOT_PERMITTED
    desk.keyed()
    for function in (ABOUT, LOCATE, MANAGE):
        assert desk.sealed(Command(0, 128, function, b"")).reason == Reason.UNKNOWN_COMMAND
    for desk in (CDesk(), cast("CDesk", CDesk().agree())):
        for command in (Command(0, 128, ABOUT), Command(0, 128, LOCATE, b"\1")):
            for link in ("nfc", "can:f1"):
                assert desk.plain(command, link=link, tapped=link == "nfc").reason == 1, "unknown in every state"


def test_locate_blinks_for_its_time_and_a_new_request_replaces_it() -> None:
    desk = Board.make()

    def locate(octets: bytes) -> Reply:
        return desk.plain(Command(0, 128, LOCATE, octets))

    assert locate(b"").reason == locate(b"\1\1").reason == locate(b"\x3d").reason == Reason.BAD_FORM
    assert desk.firmware.blinks == []
    assert locate(b"\x05").ok
    assert desk.node.poll() == 5 * 10**9
    desk.now = 3
    assert locate(b"\x3c").ok
    desk.now = 62.9
    desk.node.poll()
    assert desk.firmware.blinks == [5, 60]
    desk.now = 63
    desk.node.poll()
    desk.node.poll()
    assert desk.firmware.blinks == [5, 60, 0]
    assert locate(b"\0").ok
    desk.now = 200
    desk.node.poll()
    assert desk.firmware.blinks == [5, 60, 0, 0]
    desk.keyed()
    assert locate(b"\1").reason == Reason.NOT_PERMITTED
    assert desk.sealed(Command(0, 128, LOCATE, b"\1")).ok


def test_a_pressed_button_is_announced_at_once_and_not_too_often() -> None:
    desk = CDesk()
    seen = []
    for tenth in range(3000):
        desk.now = tenth / 10
        desk.node.press()
        desk.node.poll()
        while (frame := desk.node.next_frame()) is not None:
            assert frame[0] & 0x1FFFFF00 == 0x1CFF0000
            assert frame[1][6:] == b"\1\0"
            seen.append(desk.now)
    assert seen[0] == 0
    assert min(after - before for before, after in itertools.pairwise(seen)) >= 1
    assert all(sum(1 for press in seen if at <= press < at + 60) <= 20 for at in seen)
    assert len(seen) >= 50


def test_a_pressed_button_of_another_board_claims_no_address() -> None:
    desk = CDesk()
    address = desk.node.can_address
    greater = b"\1\0\xff\xff\xff\xff"
    desk.node.take_frame(0x1CFF0000 | address, b"\1\0\0\0\0\0\1\0", fd=False)
    desk.node.take_frame(0x1CFF0000 | address, greater + b"\1\0", fd=False)
    assert desk.node.can_address == address
    assert desk.node.next_frame() is None
    desk.node.take_frame(0x1CFF0000 | address, b"\1\0\0\0\0\0\0\0", fd=False)
    assert desk.node.can_address != address


# -- which packets pass ------------------------------------------------------------------------------------------------


def test_a_listed_packet_goes_to_the_manager_and_its_answer_back() -> None:
    desk = Board.make().keyed()
    for command, body in [
        (smp.PARAMETERS, smp.EMPTY),
        (smp.BOOT_LOADER, smp.encode({"query": "bootloader"})),
        (smp.STATES, b"\xbf\xff"),
        (smp.SLOTS, smp.EMPTY),
        (smp.ECHO, smp.encode({"d": "hello"})),
        (smp.SET_STATE, smp.start(OTHER)),
        (smp.SET_STATE, b"\xa2" + smp.start(OTHER)[1:] + b"\x67confirm\xf4"),
    ]:
        desk.firmware.answer = {"r": [1, {"deep": {"er": b"octets"}}], "rc": 0}
        reply = desk.manage(packet(command, body))
        assert reply.ok, command
        assert desk.firmware.asked.pop() == packet(command, body)
        assert smp.body_of(reply.payload) == desk.firmware.answer


def test_a_packet_outside_a_session_is_refused_whether_it_is_offered_or_not() -> None:
    for without in ("", "M"):
        desk = Board.make(without=without)
        manage = Command(0, 128, MANAGE, packet(smp.STATES))
        assert desk.plain(manage).reason == Reason.NOT_PERMITTED
        desk.keyed()
        assert desk.plain(manage).reason == Reason.NOT_PERMITTED


def test_checks_come_in_the_order_of_the_profile() -> None:
    desk = Board.make(most=200).keyed()
    bad = packet((smp.WRITE, 63, 0), b"\xc0")
    assert desk.why(bad + bytes(201 - len(bad))) == Reason.TOO_LARGE
    assert desk.why(bad + b"\0") == Reason.BAD_FORM
    assert desk.why(bad) == Reason.NOT_PERMITTED
    assert desk.why(packet(smp.PARAMETERS, b"\xc0")) == Reason.BAD_FORM
    assert desk.why(packet(smp.SET_STATE, smp.CONFIRM)) == Reason.WRONG_STATE
    whole = packet(smp.PARAMETERS)
    for wrong in (whole[:8], whole[:3], b"", b"\x00" + whole[1:], b"\x0b" + whole[1:], whole[:1] + b"\1" + whole[2:]):
        assert desk.why(wrong) == Reason.BAD_FORM
    assert desk.why(whole + whole) == Reason.BAD_FORM, "two packets in one"
    longest = Board.make().keyed()
    body = smp.encode({"d": "x" * (1024 - 53 - 8 - 6)})
    assert len(packet(smp.ECHO, body)) == 1024 - 53
    longest.firmware.raw = packet((smp.WRITE | 1, 0, 0), body)
    assert longest.manage(packet(smp.ECHO, body)).payload == longest.firmware.raw
    assert longest.why(packet(smp.ECHO, body) + b"\0") == Reason.TOO_LARGE


def test_nothing_else_than_the_list_passes() -> None:
    desk = Board.make().keyed()
    listed = {smp.PARAMETERS, smp.BOOT_LOADER, smp.STATES, smp.SLOTS, smp.ECHO, smp.RESTART, smp.SET_STATE, smp.UPLOAD}
    for first in (smp.READ, smp.WRITE):
        for group in (0, 1, 2, 3, 63, 64, 256):
            for number in range(12):
                if (first, group, number) not in listed:
                    assert desk.why(packet((first, group, number))) == Reason.NOT_PERMITTED


@pytest.mark.parametrize(
    "body",
    [
        b"\xa2\x64hash\x58\x20" + OTHER + b"\x67confirm\xf5",  # permanent before it ran
        b"\xa2\x67confirm\xf5\x64hash\x58\x20" + OTHER,
        b"\xbf\x67confirm\xf5\xff",
        b"\xa1\x67confirm\xf4",
        b"\xa2\x67confirm\xf5\x67confirm\xf5",
        b"\xa1\x64hash\x59\x00\x20" + OTHER,
        b"\xa1\x64hash\x58\x20" + OTHER + b"\0",
        b"\xa1\x64hash\x58\x1f" + OTHER[:31],
        b"\xa1\x44hash\x58\x20" + OTHER,  # a key of octets
        b"\xa1\x64hash\x78\x20" + OTHER,
        b"\xa1\x64hasH\x58\x20" + OTHER,
        b"\xa3\x64hash\x58\x20" + OTHER + b"\x67confirm\xf4",
        b"\xa1\x64hash\x58\x20" + OTHER + b"\x67confirm\xf4",
        b"\xa2\x64hash\x58\x20" + OTHER,
        b"\xa0",
        b"",
    ],
)
def test_of_1_0_only_three_bodies_pass(body: bytes) -> None:
    desk = Board.make().keyed()
    assert desk.why(packet(smp.SET_STATE, body)) == Reason.BAD_FORM


@pytest.mark.parametrize(
    "body",
    [
        b"\xbf\x63off\x00\xff",  # without a length
        b"\xa1\x63off\xf9\x00\x00",  # a floating zero
        b"\xa1\xc0\x63off\x00",
        b"\xa1\x63off\xc2\x00",
        b"\xa2\x63off\x00\x63off\x01",  # two of them: the manager could take the other one
        b"\xa2\x63off\x00\x63sha\x60",
        b"\xa3\x63off\x00\x63sha\x40\x63sha\x40",
        b"\xa3\x63off\x00\x63len\x01\x63len\x02",
        b"\xa2\x63off\x00\x63len\x61\x31",
        b"\xa1\x63off\x20",
        b"\xa1\x63off\x43\x00\x00\x00",
        b"\xa1\x63len\x01",
        b"\xa2\x63off\x00\x00\x00",  # a key that is no text
        b"\xa2\x63off\x00\x64data\xa0",
        b"\xa2\x63off\x00\x64data\x5f\x41\x00\xff",
        b"\xa2\x63off\x00",  # cut
        b"\xa1\x63off\x1b\x00\x00",
        b"\xa1\x63off\x00\x00",  # and more
        b"\xa1\x7f\x63off\xff\x00",
        b"\xa1\x63off\x1c" + bytes(16),
        b"\xa2\x63off\x00\x63sha\x58\x21" + bytes(33),
        b"\x81\x63off",
        b"\xff",
        b"\xa1\x63off\xff",
        b"\xbb\xff\xff\xff\xff\xff\xff\xff\xff\x63off\x00",
    ],
)
def test_an_upload_that_could_mean_two_things_is_refused(body: bytes) -> None:
    desk = Board.make().keyed()
    assert desk.why(packet(smp.UPLOAD, body)) == Reason.BAD_FORM


def test_numbers_may_be_longer_than_they_need_be() -> None:
    desk = Board.make().keyed()
    desk.firmware.answer = {"off": 40}
    for zero in (b"\x00", b"\x18\x00", b"\x19\0\0", b"\x1a\0\0\0\0", b"\x1b\0\0\0\0\0\0\0\0"):
        body = b"\xa4\x63off" + zero + b"\x63sha\x41\x01\x63len\x1b\0\0\0\1\0\0\0\0\x64data\x40"
        assert desk.manage(packet(smp.UPLOAD, body)).ok
    other = b"\xa3\x63off\x1b\0\0\0\0\0\0\0\0\x63sha\x41\x02\x63len\x01"
    assert desk.why(packet(smp.UPLOAD, other)) == Reason.BUSY
    for far in (b"\x1b\0\0\0\1\0\0\0\0", b"\x1b\1\0\0\0\0\0\0\0"):
        body = b"\xa3\x63off" + far + b"\x63sha\x41\x02\x63len\x01"
        assert desk.manage(packet(smp.UPLOAD, body)).ok, "its lower 32 bits are 0, and it begins nothing"


@pytest.mark.parametrize(
    "body",
    [
        b"\xa1\x61d\xc0\x60",
        b"\xa1\xc0\x60",
        b"\xa1\x61d\xd8\x20",
        b"\xa1\xd8\x20\x60",
        b"\xa1\x61d\xfb" + bytes(8),
        b"\xa1\x61d\xf8\x20",
        b"\xa1\x61d",
        b"\xa1\x61d\x60\x60",
        b"\xbf\x61d\xff",
        b"\xbf\x61d\x60",
        b"\xa1\x61d\xff",
        b"\xa1\x61d" + b"\x81" * 8 + b"\x00",
        b"\x60",
        b"\x80",
        b"\xa1\x61d\x7f\x60\xff",
        b"\xba\x80\x00\x00\x00",  # so many pairs that twice their number is 0
        b"\xa2\x61d\xc1\x61e\x01",  # a tag, or a text in pieces, that would stand for a value
        b"\xa2\x61d\x7f\x61e\x01",
        b"\xa2\x61d\x5f\x61e\x01",
    ],
)
def test_a_body_that_is_no_map_of_plain_values_is_refused(body: bytes) -> None:
    desk = Board.make().keyed()
    assert desk.why(packet(smp.ECHO, body)) == Reason.BAD_FORM


def test_maps_and_lists_without_a_length_pass_and_may_be_seven_deep() -> None:
    desk = Board.make().keyed()
    assert desk.manage(packet(smp.ECHO, b"\xbf\x61d\x9f\x01\xbf\x61e\xf5\xff\xff\x61f\xa0\xff")).ok
    assert desk.manage(packet(smp.ECHO, b"\xa1\x61d" + b"\x81" * 7 + b"\x00")).ok


@pytest.mark.parametrize(
    ("command", "body", "why"),
    [
        (smp.STATES, b"\xa1\x01\x01", 4),  # a key that is no text
        (smp.ECHO, b"\xa1\x41d\x01", 4),
        (smp.ECHO, b"\xa1\xf5\x01", 4),
        (smp.ECHO, b"\xa1\x61d\xa1\x01\x01", 4),  # one map further in
        (smp.ECHO, b"\xa1\x61d\x81\xa1\x01\x01", 4),
        (smp.ECHO, b"\xa1\x61d\xa1\x61e\x01", None),
        (smp.ECHO, b"\xa1\x61d\xf6", None),  # null
        (smp.ECHO, b"\xa1\x61d\xf4", None),
        (smp.ECHO, b"\xa1\x61d\xf7", 4),  # undefined
        (smp.ECHO, b"\xa1\x61d\xf3", 4),
        (smp.ECHO, b"\xa1\x61d\x61\xff", 4),  # not UTF-8
        (smp.ECHO, b"\xa1\x61\xff\x01", 4),
        (smp.ECHO, b"\xa1\x61d\x62\xc3\xa4", None),
        (smp.ECHO, b"\xbf\x61d\x01\xff", None),
        (smp.UPLOAD, b"\xbf\x63off\x01\xff", 4),
        (smp.UPLOAD, b"\xa2\x63off\x01\x61x\xa0", 4),
        (smp.UPLOAD, b"\xa2\x63off\x01\x61x\x80", 4),
        (smp.UPLOAD, b"\xa2\x63off\x01\x61x\xf6", None),
        (smp.UPLOAD, b"\xa2\x63off\x01\x63len\xf5", 4),
        (smp.UPLOAD, b"\xa2\x63off\x01\x63len\x20", 4),
        (smp.UPLOAD, b"\xa2\x63off\x01\x63len\x1b\0\0\0\2\0\0\0\0", None),
        (smp.UPLOAD, b"\xa2\x63off\x01\x63sha\xf6", 4),
        (smp.UPLOAD, b"\xa2\x63off\x01\x63sha\x58\x20" + OTHER, None),
        (smp.UPLOAD, b"\xa2\x63off\x01\x63sha\x58\x21" + OTHER + b"x", 4),
    ],
)
def test_both_nodes_pass_and_refuse_the_same_bodies(
    command: tuple[int, int, int], body: bytes, why: int | None
) -> None:
    assert Board.make().keyed().why(packet(command, body)) == why
    assert ManagedDesk().refuses(packet(command, body)) == why


@pytest.mark.parametrize(
    ("first", "answers", "lives"),
    [
        ({"len": 1000}, [{"off": 40}, {"off": 999}], True),
        ({"len": 1000}, [{"off": 40}, {}], True),
        ({"len": 1000}, [{"off": 40}, {"off": 1000}], False),
        ({"len": 1000}, [{"off": 40}, {"off": 1001}], False),  # more than it has: nothing can follow
        ({"len": 1000}, [{"off": 40}, {"off": 1 << 32}], False),
        ({"len": 1000}, [{"off": 40}, {"match": False}], False),
        ({"len": 1000}, [{"off": 1000}], False),
        ({}, [{"off": 40}], True),  # nobody knows when it is whole
        ({}, [{"off": 40}, {"off": 80, "match": True}], False),
    ],
)
def test_both_nodes_end_an_upload_alike(first: dict[str, int], answers: list[dict[str, Any]], lives: bool) -> None:
    desk, python = Board.make().keyed(), ManagedDesk()

    def answered(answer: dict[str, Any], **body: object) -> None:
        desk.firmware.answer = python.manager.answer = answer
        octets = packet(smp.UPLOAD, smp.encode(body))
        assert desk.why(octets) is None
        assert python.refuses(octets) is None

    answered({"off": 4}, off=0, len=4, data=b"1234")  # the upload before it, whole
    for off, answer in enumerate(answers):
        answered(answer, off=off, data=b"", **({} if off else first))
    write, why = write_teds(1, 12, 0, NAME), 17 if lives else None
    assert desk.sealed(write).reason == why
    assert python.sealed(write, link="can:f1").reason == why


def test_an_answer_that_is_none_gets_11_of_either_node() -> None:
    desk, python = Board.make().keyed(), ManagedDesk(buffer=971)
    good = packet((smp.READ | 1, 0, 6), smp.encode({"buf_size": 971}))
    for wrong in (
        b"",
        good[:8],
        good[:-1],
        good + b"\0",
        good[:1] + b"\1" + good[2:],
        good[:3] + bytes([good[3] + 1]) + good[4:],
        packet((smp.READ | 1, 0, 6), smp.encode({"x": bytes(971 - 8 - 6 + 1)})),  # one octet too long
        packet((smp.READ, 0, 6)),
        packet((smp.READ | 1, 1, 6)),
        packet((smp.READ | 1, 0, 6), sequence=8),
        packet((smp.READ | 1, 0, 6), b"\xa1\x61a\xfa\0\0\0\0"),
        packet((smp.READ | 1, 0, 6), smp.encode({"x": bytes(2000)}))[:1900],
    ):
        desk.firmware.raw = python.manager.raw = wrong
        assert desk.manage(packet(smp.PARAMETERS)).reason == 11
        assert python.ask(packet(smp.PARAMETERS)).reason == 11
    longest = packet((smp.READ | 1, 0, 6), smp.encode({"x": bytes(971 - 8 - 6)}))
    assert len(longest) == 971
    for right in (good, longest):
        desk.firmware.raw = python.manager.raw = right
        assert desk.manage(packet(smp.PARAMETERS)).payload == right
        assert python.ask(packet(smp.PARAMETERS)).payload == right
    for off in (b"\x61x", b"\x20", b"\xf5"):
        desk.firmware.raw = python.manager.raw = packet((smp.WRITE | 1, 1, 1), b"\xa1\x63off" + off)
        assert desk.manage(piece(0)).reason == 11
        assert python.ask(piece(0)).reason == 11


def test_a_restart_waits_until_its_reply_has_left() -> None:
    desk = Board.make().keyed()
    for body in (b"\xa1\x65force\x01", b"\xa0\xa0", b"\xbf\xff", b"\xa1", b"\x80"):
        assert desk.why(packet(smp.RESTART, body)) == Reason.BAD_FORM
    reply = desk.sealed(Command(0, 128, MANAGE, packet(smp.RESTART)))
    assert reply.payload == packet((0x0B, 0, 5))
    assert desk.firmware.asked == []
    assert desk.firmware.restarts == 1, "the desk takes each reply at once"
    desk.node.reply_sent("nfc")
    assert desk.firmware.restarts == 1


def test_a_restart_comes_also_if_its_reply_is_never_taken() -> None:
    desk = Board.make()
    desk.agree().open(link="can:f1")
    assert desk.session is not None
    frame = desk.session.seal(Command(0, 128, MANAGE, packet(smp.RESTART))).encode()
    desk.node.handle(frame, link="can:f1", tapped=False)
    assert desk.firmware.restarts == 0
    desk.node.reply_sent("can:f2")
    desk.node.link_lost("can:f2")
    assert desk.firmware.restarts == 0
    desk.node.link_lost("can:f1")
    assert desk.firmware.restarts == 1


@pytest.mark.parametrize(("link", "at_once"), [("can:f1", True), ("can:f7", True), ("nfc", False), ("ble:2", False)])
def test_a_bus_off_restarts_a_node_whose_reply_was_on_that_bus_and_no_other(link: str, at_once: bool) -> None:
    desk = Board.make()
    desk.agree().open(link=link)
    assert desk.session is not None
    frame = desk.session.seal(Command(0, 128, MANAGE, packet(smp.RESTART))).encode()
    desk.node.handle(frame, link=link, tapped=link == "nfc")
    desk.node.bus_off()
    assert desk.firmware.restarts == at_once
    desk.node.reply_sent(link)
    assert desk.firmware.restarts == 1


# -- when: claims, staging, uploads ------------------------------------------------------------------------------------


def of_claims(firmware: Firmware) -> CBench:
    """A board that measures; stations F1 and F2 have a session each."""
    bench = CBench()
    bench.tim.has_firmware(firmware)  # type: ignore[attr-defined]
    bench.restart()
    return cast("CBench", bench.open("can:f1").open("can:f2"))


def test_while_anything_is_claimed_only_reads_and_echo_pass() -> None:
    bench = of_claims(Firmware())
    bench.operate(1)
    changes = [packet(smp.RESTART), piece(0), packet(smp.SET_STATE, smp.start(OTHER))]
    for link in ("can:f1", "can:f2"):
        asked = [Command(0, 128, MANAGE, octets) for octets in changes]
        assert [bench.reason(command, link) for command in asked] == [17, 17, 17], "its own claim counts too"
        for octets in (packet(smp.PARAMETERS), packet(smp.STATES), packet(smp.ECHO)):
            assert bench.reason(Command(0, 128, MANAGE, octets), link) is None
        assert bench.reason(Command(0, 128, MANAGE, packet(smp.SET_STATE, smp.CONFIRM)), link) == 2
    bench.idle(1)
    assert bench.reason(Command(0, 128, MANAGE, changes[1]), "can:f2") is None


def test_nobody_claims_anything_while_an_upload_lives() -> None:
    firmware = Firmware(answer={"off": 40})
    bench = of_claims(firmware)
    assert bench.reason(Command(0, 128, MANAGE, piece(0)), "can:f2") is None
    operate = OperateCommand(1, DIGEST, 60).command()
    for link in ("can:f1", "can:f2"):
        assert bench.reason(operate, link) == 17
        assert bench.reason(Command(1, 4, 2), link) is None, "Idle claims nothing"
    firmware.answer = {"off": 1000}
    assert bench.reason(Command(0, 128, MANAGE, piece(40)), "can:f2") is None
    assert bench.reason(operate, "can:f1") != 17
    bench.operate(1)


def test_what_another_session_has_staged_keeps_changes_out_and_reads_not() -> None:
    desk = Board.make().keyed()
    other = desk.beside()
    assert other.sealed(write_teds(1, 12, 0, NAME)).ok
    for body in (packet(smp.RESTART), packet(smp.SET_STATE, smp.start(OTHER)), piece(0)):
        assert desk.why(body) == Reason.BUSY
    assert desk.manage(packet(smp.STATES)).ok
    assert desk.manage(packet(smp.ECHO, smp.encode({"d": "x"}))).ok
    desk.firmware.answer = {"off": 40}
    assert other.manage(piece(0)).ok, "its own is in nobody's way"


def test_an_upload_lives_and_keeps_writes_and_others_out() -> None:
    desk = Board.make().keyed()
    other = desk.beside()
    desk.firmware.answer = {"off": 40}
    assert desk.manage(piece(0)).ok
    for session in (desk, other):
        assert session.sealed(write_teds(1, 12, 0, NAME)).reason == Reason.BUSY
    assert other.manage(piece(0)).reason == Reason.BUSY
    assert other.manage(packet(smp.RESTART)).reason == Reason.BUSY
    assert other.manage(packet(smp.STATES)).ok
    desk.now += 59
    desk.firmware.answer = {"off": 80}
    assert desk.manage(piece(40)).ok
    desk.now += 59.9
    assert other.sealed(write_teds(1, 12, 0, NAME)).reason == Reason.BUSY
    desk.now += 0.1
    assert other.sealed(write_teds(1, 12, 0, NAME)).ok


@pytest.mark.parametrize("answer", [{"off": 1000, "match": True}, {"off": 1000}, {"match": False}])
def test_an_upload_ends_when_it_is_complete(answer: object) -> None:
    desk = Board.make().keyed()
    desk.firmware.answer = {"off": 960}
    assert desk.manage(piece(0)).ok
    desk.firmware.answer = answer
    assert desk.manage(piece(960)).ok
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok


@pytest.mark.parametrize("answer", [{"rc": 8}, {"err": {"group": 1, "rc": 30}}, {"rc": 0, "off": 40}])
def test_a_piece_that_is_refused_starts_no_upload(answer: object) -> None:
    desk = Board.make().keyed()
    desk.firmware.answer = answer
    assert desk.manage(piece(0)).ok
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok


def test_an_upload_ends_with_its_session() -> None:
    desk = Board.make().keyed()
    other = desk.beside()
    desk.firmware.answer = {"off": 40}
    assert desk.manage(piece(0)).ok
    assert other.sealed(security_command(Function.CLOSE)).ok
    assert desk.sealed(write_teds(1, 12, 0, NAME)).reason == Reason.BUSY, "that was the end of another session"
    other = desk.beside()
    assert desk.sealed(security_command(Function.CLOSE)).ok
    assert other.manage(piece(0)).ok
    assert other.sealed(write_teds(1, 12, 0, NAME)).reason == Reason.BUSY
    desk.node.link_lost("can:f2")
    desk.open()
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok


def test_another_image_begins_no_sooner_than_ten_seconds_after_the_last() -> None:
    desk = Board.make().keyed()
    desk.firmware.answer = {"off": 40}
    assert desk.manage(piece(0, sha=b"")).ok, "the first since the start is free"
    without = packet(smp.UPLOAD, smp.encode({"off": 0, "len": 1000, "data": b""}))
    assert desk.manage(without).ok, "a missing digest counts as an empty one"
    assert desk.why(piece(0)) == Reason.BUSY
    desk.now += 9.9
    assert desk.why(piece(0)) == Reason.BUSY
    desk.now += 0.1
    assert desk.manage(piece(0)).ok
    desk.now += 9.9
    assert desk.manage(piece(0)).ok, "the same image begins again at once, and its ten seconds with it"
    desk.now += 9.9
    assert desk.why(piece(0, sha=OTHER)) == Reason.BUSY
    assert desk.manage(piece(40)).ok
    desk.firmware.answer = {"off": 1000, "match": True}
    assert desk.manage(piece(40)).ok
    assert desk.why(piece(0, sha=OTHER)) == Reason.BUSY
    desk.restart()
    desk.open()
    assert desk.manage(piece(0, sha=OTHER)).ok


# -- images on trial ---------------------------------------------------------------------------------------------------


def test_while_an_image_is_pending_the_second_slot_is_left_alone() -> None:
    desk = Board.make().keyed()
    desk.firmware.after = SIGNED | PENDING
    assert desk.manage(packet(smp.SET_STATE, smp.start(OTHER))).ok
    assert desk.why(packet(smp.SET_STATE, smp.start(OTHER))) == Reason.BUSY
    assert desk.why(piece(0)) == Reason.BUSY
    assert desk.why(packet(smp.SET_STATE, smp.CONFIRM)) == Reason.WRONG_STATE
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok, "what is stored may change until the restart"
    assert desk.manage(packet(smp.RESTART)).ok


def test_on_trial_nothing_stored_changes_until_it_is_confirmed() -> None:
    desk = Board.make(Firmware()).keyed()
    stored = desk.node.image
    desk.firmware.flags = SIGNED | ON_TRIAL
    desk.restart()
    request = StationAgreement(CREDENTIALS, UUID).request()
    assert desk.plain(request).reason == Reason.BUSY
    assert desk.plain(Command(0, 128, 10, bytes([desk.node.can_address]))).reason == Reason.BUSY
    assert desk.plain(Command(0, 128, 9, bytes(32))).reason == Reason.NOT_PERMITTED
    desk.open()
    for command in (
        request,
        Command(0, 128, 2, bytes(16)),
        Command(0, 128, 9, bytes(32)),
        Command(0, 128, 10, bytes([desk.node.can_address])),
        write_teds(1, 12, 0, NAME),
        Command(0, 1, 4, b"\x80"),
    ):
        assert desk.sealed(command).reason == Reason.BUSY
    assert desk.why(piece(0)) == desk.why(packet(smp.SET_STATE, smp.start(OTHER))) == Reason.BUSY
    desk.node.reset_by_hand()
    assert desk.firmware.restarts == 1, "a reset by hand restarts first"
    assert desk.sealed(Command(0, 128, ABOUT, b"")).payload[1] & ON_TRIAL
    desk.firmware.after = SIGNED
    assert desk.manage(packet(smp.SET_STATE, smp.CONFIRM)).ok
    assert desk.node.image == stored
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok
    desk.node.reset_by_hand()
    assert desk.node.identity().state == 0


def test_a_reset_by_hand_in_factory_state_writes_nothing() -> None:
    """Flash wears, and a button may be pressed all day."""
    desk = Board.make()
    desk.node.garble(0)
    desk.node.reset_by_hand()
    assert (desk.node.written, desk.node.identity().state) == (0, 0)
    desk.keyed()
    desk.node.garble(0)
    desk.node.reset_by_hand()
    assert desk.node.written > 0
    assert desk.node.identity().state == 0


def test_a_reset_by_hand_that_flash_refuses_is_an_error_and_ends_no_session() -> None:
    desk = Board.make().keyed()
    desk.node.fails(True)
    with pytest.raises(AssertionError):
        desk.node.reset_by_hand()
    desk.node.fails(False)
    assert desk.sealed(Command(0, 128, ABOUT, b"")).ok
    desk.node.reset_by_hand()
    assert desk.node.identity().state == 0


def test_an_unconfirmed_trial_restarts_after_ten_minutes() -> None:
    desk = Board.make().keyed()
    desk.firmware.flags = SIGNED | ON_TRIAL
    desk.restart()
    assert desk.node.poll() <= 600 * 10**9
    desk.now = 599.9
    desk.node.poll()
    assert desk.firmware.restarts == 0
    desk.now = 600
    desk.node.poll()
    assert desk.firmware.restarts == 1


def test_on_trial_no_torn_slot_is_erased_and_no_identity_is_made() -> None:
    desk = Board.make().keyed()
    desk.node.poll()  # the slot of factory state is erased
    image = desk.node.image
    slot = (len(image) - 256) // 2
    torn = image[: 256 + slot] + b"torn" + image[256 + slot + 4 :]
    if image[256 : 256 + 4] != b"TSLT":
        torn = image[:256] + b"torn" + image[260:]
    desk.firmware.flags = SIGNED | ON_TRIAL
    desk.node.image = torn
    desk.restart()
    desk.node.poll()
    assert desk.node.image == torn
    desk.open()
    desk.firmware.after = SIGNED
    assert desk.manage(packet(smp.SET_STATE, smp.CONFIRM)).ok
    desk.node.poll()
    assert desk.node.image == image, "erased once the image is confirmed"
    desk.firmware.flags, desk.firmware.after = SIGNED | ON_TRIAL, None
    blank = bytes([0xFF]) * len(image)
    for wrong in (blank, b"torn" + blank[4:], image[:256] + blank[256:]):
        desk.node.image = wrong
        assert desk.node.start() == _IDENTITY
        assert desk.node.image == wrong


def test_a_form_of_other_firmware_is_never_erased_nor_taken_for_blank() -> None:
    desk = Board.make().keyed()
    desk.node.poll()  # the slot of factory state is erased
    image = desk.node.image
    at = 256 if image[256:260] == b"TSLT" else 256 + (len(image) - 256) // 2
    spare = 256 if at != 256 else 256 + (len(image) - 256) // 2
    octets = int.from_bytes(image[at + 12 : at + 16], "big")

    def renamed(start: int, whole: bytes) -> bytes:
        body = whole[:4] + b"\2" + whole[5:-4]
        return image[:start] + body + zlib.crc32(body).to_bytes(4, "big") + image[start + len(whole) :]

    for wrong in (
        renamed(at, image[at : at + octets]),
        renamed(spare, image[at : at + octets]),
        renamed(0, image[:192]),
    ):
        desk.node.image = wrong
        assert desk.node.start() == _FORM
        assert desk.node.image == wrong
    desk.node.image = image
    assert desk.node.start() == 0
