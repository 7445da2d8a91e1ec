"""A board that lacks something, and stations that ask what is not asked: refused as the contract says, or borne."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import pytest

from teds_provision.protocol.keys import GROUP_ORDER, Credentials
from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, security_command
from teds_provision.protocol.operation.commands import read_data_set, run_self_test, sample, set_values, write_data_set
from teds_provision.protocol.operation.stream_commands import stop
from teds_provision.protocol.wire_agreement import StationAgreement
from tests.firmware.bench import CBench, MeasuringMemoryNode
from tests.firmware.desk import CDesk
from tests.protocol.desk import CREDENTIALS, META, NAME, UUID, Desk
from tests.protocol.operation.bench import MS, Bench
from tests.protocol.operation.test_claims import VALUE
from tests.protocol.operation.test_refusals import subscribe

pytestmark = pytest.mark.system
CLOSE = security_command(Function.CLOSE)


@pytest.fixture(autouse=True)
def closed() -> Iterator[None]:
    yield
    CDesk.close_all()
    CBench.close_all()


def node(bench: CBench) -> MeasuringMemoryNode:
    return bench.tim  # type: ignore[return-value]


def claimed(without: str) -> CBench:
    """A sensor and an actuator are claimed of a board that has not this."""
    bench = CBench()
    node(bench).without(without)
    bench.open().operate(1, 4)
    return bench


# -- what a port may leave out -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("word", ["b", "a"], ids=["bears", "set"])
def test_an_actuator_that_cannot_be_set_bears_no_value(word: str) -> None:
    bench = claimed(word)
    assert bench.reason(write_data_set(4, VALUE)) == Reason.OUT_OF_RANGE
    assert bench.reason(set_values([(4, VALUE)])) == Reason.OUT_OF_RANGE


def test_a_sensor_that_cannot_be_read_is_not_valid() -> None:
    bench = claimed("s")
    payload = bench.send(sample([1])).payload
    assert payload[8:] == b"\x01\x00\x00"


def test_an_unknown_set_point_is_0() -> None:
    assert claimed("g").send(read_data_set(4)).payload == bytes(6)


def test_a_board_without_a_self_test_has_passed_it() -> None:
    bench = claimed("t")
    assert bench.send(run_self_test(1)).ok
    assert bench.send(run_self_test(0)).ok


@pytest.mark.parametrize("word", ["f", "m", "k", "T", "F", "p"])
def test_whatever_else_it_has_not_its_actuator_moves_and_goes_idle(word: str) -> None:
    bench = claimed(word)
    assert bench.send(write_data_set(4, VALUE)).ok
    assert bench.send(Command(4, 4, 2)).ok
    assert bench.send(security_command(Function.OPERATION)).ok
    assert bench.send(security_command(Function.POWER)).ok


# -- claims and addresses ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("acts", [False, True])
def test_a_node_with_an_actuator_claimed_stays_where_it_is(acts: bool) -> None:
    """Another node of a smaller CRC announces itself at its address."""
    bench = CBench()
    bench.open().operate(*((1, 4) if acts else (1,)))
    home = node(bench).can_address
    node(bench).take_frame(0x1CFF0000 | home, b"\x01\x02\0\0\0\x01\0\0")
    assert (node(bench).can_address == home) is acts


@pytest.mark.parametrize("polled", [False, True], ids=["a command comes first", "its loop does"])
def test_a_dead_man_that_ran_out_long_ago_is_reported(polled: bool) -> None:
    """The loop was held up until its session was over, too: what stopped the actuator was the dead-man, before."""
    replies = []
    for made in (Bench, CBench):
        bench = made()
        bench.open().operate(4)
        assert bench.send(write_data_set(4, VALUE)).ok
        bench.hardware.tick += 700_000 * MS
        if polled:
            bench.tim.poll()
        bench.open()
        replies.append(bench.send(security_command(Function.OPERATION)).payload)
    assert replies[0] == replies[1]
    assert replies[1][1 + 3 * 3 + 1] & 0x30 == 0x30


def test_what_no_event_sensor_has_seen_is_no_event() -> None:
    bench = CBench()
    bench.open().operate(1, 5)
    assert bench.send(subscribe(kind=1, n=1, channels=(5,), start=0)).ok
    bench.until(bench.hardware.tick + 50 * MS)
    for channel in (99, 1, 4):
        node(bench).interrupt(channel, bench.hardware.tick, bytes(8))
    bench.until(bench.hardware.tick + 50 * MS)
    assert bench.frames == []
    assert bench.send(stop(0)).payload == bytes(4)


# -- what a station may get wrong --------------------------------------------------------------------------------------

_N = GROUP_ORDER.to_bytes(32, "big")
_SIGNED = CREDENTIALS.station_signature
SIGNATURES = {
    "good": _SIGNED,
    "r of 0": bytes(32) + _SIGNED[32:],
    "s of 0": _SIGNED[:32] + bytes(32),
    "r of the order": _N + _SIGNED[32:],
    "s of the order": _SIGNED[:32] + _N,
    "a high s": _SIGNED[:32] + (GROUP_ORDER - int.from_bytes(_SIGNED[32:], "big")).to_bytes(32, "big"),
    "r and s all ones": b"\xff" * 64,
}


@pytest.mark.parametrize("what", SIGNATURES)
def test_a_signature_that_cannot_be_is_5(what: str) -> None:
    credentials = Credentials(CREDENTIALS.key, SIGNATURES[what], CREDENTIALS.ca)
    request = StationAgreement(credentials, UUID).request()
    reply = CDesk().plain(request)
    assert (reply.ok, reply.reason) == ((True, None) if what == "good" else (False, Reason.BAD_SIGNATURE))
    assert Desk().plain(request).reason == reply.reason


@pytest.mark.parametrize("inside", [False, True], ids=["plain", "in a session"])
@pytest.mark.parametrize("group", [0, 1, 2, 3, 4, 5, 7, 127, 128, 129, 255])
def test_functions_that_are_none(group: int, inside: bool) -> None:
    """Every function, with a payload that none has: the same reason from both."""
    reasons = []
    for desk in (Desk(), CDesk()):
        desk.agree().open()
        ask = desk.sealed if inside else desk.plain
        functions = (0, 1, 3, 5, 6, 8, 12, 18, 20, 21, 22, 24, 99, 255)
        replies = [ask(Command(0, group, function, b"\x80\0")) for function in functions]
        reasons.append([reply.reason for reply in replies])
    assert reasons[0] == reasons[1]


def test_a_close_with_a_payload_closes_nothing() -> None:
    desk = CDesk()
    desk.agree().open()
    assert desk.sealed(security_command(Function.CLOSE, b"\0")).reason == Reason.BAD_FORM
    assert desk.sealed(CLOSE).ok


@pytest.mark.parametrize("what", ["a close", "a reset"])
def test_the_last_counter_may_end_what_ends_anyway(what: str) -> None:
    desk = CDesk()
    desk.agree().open()
    assert desk.session is not None
    command = CLOSE if what == "a close" else security_command(Function.RESET, bytes(32))
    outer = desk.plain(desk.session.seal(command, counter=2**32 - 1))
    assert outer.ok
    assert desk.session.unseal(outer.payload).ok
    assert desk.plain(security_command(Function.OPEN)).ok is (what == "a close")


# -- flash that is full, or fails when it is to be erased --------------------------------------------------------------


def teds_of(octets: int, code: int) -> bytes:
    """Return a TEDS of this class and so many octets."""
    block = bytes((3, 4, 0, code, 1, 1))
    left = octets - 4 - 2 - len(block)
    while left > 0:
        size = min(left - 2, 255)
        block += bytes((200, size)) + bytes(size)
        left -= 2 + size
    total = struct.pack(">I", len(block) + 2) + block
    return total + (0xFFFF - sum(total) & 0xFFFF).to_bytes(2, "big")


def commit_kept(desk: CDesk, new: dict[tuple[int, int], bytes], kept: dict[tuple[int, int], bytes]) -> Reply:
    desk.open()
    listed = {**kept, **new}
    for block, teds in {**new, (0, 128): desk.signed(listed)}.items():
        for at in range(0, len(teds), 900):
            piece = bytes((block[1],)) + at.to_bytes(4, "big") + teds[at : at + 900]
            reply = desk.sealed(Command(block[0], 1, 3, piece))
            if not reply.ok:
                return reply
    return desk.sealed(Command(0, 1, 4, b"\x80"))


def test_a_datasheet_that_its_slot_does_not_hold_is_10_and_the_old_one_stays() -> None:
    """What is staged fits, and with what is kept beside it no more: its slot is twice the staging here."""
    desk = CDesk()
    desk.agree()
    kept: dict[tuple[int, int], bytes] = {}
    for channel in (1, 2):
        too_long = {(channel, 130): teds_of(3000, 130)}
        assert commit_kept(desk, too_long, kept).ok
        kept |= too_long
    before = desk.shown()
    assert commit_kept(desk, {(3, 130): teds_of(3000, 130)}, kept).reason == Reason.TOO_LARGE
    assert desk.shown() == before
    assert commit_kept(desk, {(3, 130): teds_of(100, 130)}, kept).ok


def test_if_the_old_slot_cannot_be_erased_a_write_and_a_reset_are_11() -> None:
    desk = CDesk()
    desk.provision()  # not polled: the next write has to erase the old slot
    desk.open()
    desk.node.fails(True)
    assert desk.stage((1, 12), NAME).reason == Reason.FLASH_FAILURE
    assert desk.sealed(security_command(Function.RESET, bytes(32))).reason == Reason.FLASH_FAILURE
    desk.node.fails(False)
    assert desk.stage((1, 12), NAME).ok
    assert desk.sealed(security_command(Function.RESET, bytes(32))).ok


def test_an_empty_image_of_the_security_teds_is_4() -> None:
    desk = CDesk()
    desk.agree().open()
    assert desk.stage((0, 1), META).ok
    for octets in (b"", b"\0", b"\0\0"):
        assert desk.stage((0, 128), octets).ok
        assert desk.sealed(Command(0, 1, 4, b"\x80")).reason == Reason.BAD_FORM
