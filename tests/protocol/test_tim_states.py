"""State and permission of every command: the table of profile section 4, and the lives of sessions."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.protocol.flash import ChipError
from teds_provision.protocol.keys import prove_message, reset_message, verify
from teds_provision.protocol.messages.frames import (
    Command,
    Function,
    Reason,
    Reply,
    query_teds,
    read_teds,
    refusal,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.wire_agreement import StationAgreement, key_id
from teds_provision.teds.codec import security
from teds_provision.teds.image import SECURITY

from .desk import CREDENTIALS, META, NODE, UUID, Desk

CHALLENGE = bytes(range(32))
REQUEST = StationAgreement(CREDENTIALS, UUID).request()
COMMANDS = {
    "request": REQUEST,
    "confirm": security_command(Function.CONFIRM, bytes(16)),
    "open": security_command(Function.OPEN, bytes(89)),
    "counter of open": security_command(Function.OPEN),
    "sealed": security_command(Function.SEALED, bytes(36)),
    "close": security_command(Function.CLOSE),
    "identify": security_command(Function.IDENTIFY),
    "prove": security_command(Function.PROVE, CHALLENGE),
    "reset": security_command(Function.RESET, CHALLENGE),
    "address": security_command(Function.SET_CAN_ADDRESS, b"\x21"),
    "list": security_command(Function.LIST),
    "query": query_teds(0, 1),
    "read": read_teds(0, 128, 0),
    "write": write_teds(0, 1, 0, META),
    "update": update_teds(0, 1),
    "self-test": Command(0, 1, 5, b"\0"),
    "other class": Command(1, 3, 1, bytes(4)),
    "class 128, function 6": Command(0, 128, 6),
    "class 128, channel 1": Command(1, 128, 7),
}
OK = None
# command: factory tapped, factory untapped, keyed tapped, keyed untapped, in session
TABLE: dict[str, tuple[int | None, int | None, int | None, int | None, int | None]] = {
    "request": (OK, 3, OK, 3, OK),
    "confirm": (2, 3, 2, 3, 2),  # none pending
    "open": (2, 2, 16, 16, 3),
    "counter of open": (2, 2, OK, OK, 3),
    "sealed": (2, 2, 2, 2, 3),
    "close": (3, 3, 3, 3, OK),
    "identify": (OK, OK, OK, OK, OK),
    "prove": (OK, OK, OK, OK, OK),
    "reset": (OK, OK, 3, 3, OK),
    "address": (OK, 3, OK, 3, OK),
    "list": (OK, OK, OK, OK, OK),
    "query": (OK, OK, OK, OK, OK),
    "read": (OK, OK, OK, OK, OK),
    "write": (3, 3, 3, 3, OK),
    "update": (3, 3, 3, 3, OK),
    "self-test": (3, 3, 3, 3, 1),
    "other class": (3, 3, 3, 3, 1),
    "class 128, function 6": (1, 1, 1, 1, 1),
    "class 128, channel 1": (1, 1, 1, 1, 1),
}


def answer(reply: Reply) -> int | None:
    return OK if reply.ok else reply.reason


@pytest.mark.parametrize("name", COMMANDS)
def test_the_table_of_states_and_permissions(name: str) -> None:
    command = COMMANDS[name]
    found = (
        answer(Desk().plain(command)),
        answer(Desk().plain(command, tapped=False)),
        answer(Desk().agree().plain(command)),
        answer(Desk().agree().plain(command, tapped=False)),
        answer(Desk().agree().open().sealed(command)),
    )
    assert found == TABLE[name]


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "request"])
def test_a_provisioned_node_permits_what_a_keyed_one_does(name: str) -> None:
    desk = Desk().provision()
    desk.tim.link_lost("nfc")
    assert answer(desk.plain(COMMANDS[name])) == TABLE[name][2]


def test_a_plain_command_is_judged_plainly_even_while_a_session_is_open() -> None:
    desk = Desk().agree().open()
    assert desk.plain(COMMANDS["write"]).reason == Reason.NOT_PERMITTED
    assert desk.sealed(COMMANDS["identify"]).ok


@pytest.mark.parametrize(
    "command",
    [
        security_command(Function.IDENTIFY, b"\0"),
        security_command(Function.PROVE, CHALLENGE[:-1]),
        security_command(Function.RESET, CHALLENGE + b"\0"),
        security_command(Function.SET_CAN_ADDRESS, b""),
        security_command(Function.SET_CAN_ADDRESS, b"\0"),
        security_command(Function.SET_CAN_ADDRESS, b"\xf0"),
        security_command(Function.LIST, b"\0"),
        security_command(Function.REQUEST, REQUEST.payload[:-1]),
        Command(0, 1, 1, b""),
        Command(0, 1, 2, b"\x80"),
    ],
)
def test_a_payload_of_the_wrong_form_gets_4(command: Command) -> None:
    assert Desk().plain(command) == refusal(Reason.BAD_FORM)


@pytest.mark.parametrize("octets", [b"", b"\0\0\x80\x07\0", b"\0\0\x80\x07\0\1", b"\0\0\x80\x07\0\0\0"])
def test_a_frame_whose_length_lies_gets_4(octets: bytes) -> None:
    assert Desk().raw(octets) == refusal(Reason.BAD_FORM)


def test_a_length_that_lies_gets_4_even_where_the_command_would_take_what_came() -> None:
    desk = Desk().agree()
    session = StationSession(desk.key, UUID)
    opening = session.open(desk.plain(COMMANDS["counter of open"]).payload).encode()
    assert opening[4:6] == b"\0\x59"
    for length in (b"\0\0", b"\0\x58", b"\0\x5a", b"\1\x59"):
        assert desk.raw(opening[:4] + length + opening[6:]) == refusal(Reason.BAD_FORM)
    assert desk.raw(opening).ok


def test_identify_says_what_is_so() -> None:
    desk = Desk()
    assert Identity.decode(desk.plain(COMMANDS["identify"]).payload) == Identity(
        UUID, NodeState.FACTORY, 0, 0, 2048, 192
    )
    desk.provision()
    shown = Identity.decode(desk.plain(COMMANDS["identify"]).payload)
    assert (shown.state, shown.epoch, shown.sequence) == (NodeState.PROVISIONED, 1, 1)


def test_prove_signs_the_challenge_for_this_uuid() -> None:
    assert verify(NODE.point, prove_message(UUID, CHALLENGE), Desk().plain(COMMANDS["prove"]).payload)


def test_a_lower_counter_is_a_replay_and_so_is_0_at_first() -> None:
    desk = Desk().agree().open()
    assert desk.session is not None
    session, identify = desk.session, COMMANDS["identify"]
    assert desk.plain(session.seal(identify, counter=0)) == refusal(Reason.REPLAY)
    assert desk.plain(session.seal(identify, counter=9)).ok
    for counter in (9, 8, 1, 0):
        assert desk.plain(session.seal(identify, counter=counter)) == refusal(Reason.REPLAY), counter
    assert desk.plain(session.seal(identify, counter=10)).ok


def test_an_address_is_durable() -> None:
    desk = Desk()
    assert desk.plain(COMMANDS["address"]).ok
    desk.restart()
    assert desk.tim.identity().can_address == 0x21


def address(number: int) -> Command:
    return security_command(Function.SET_CAN_ADDRESS, bytes([number]))


def test_a_second_change_of_the_address_within_10_s_gets_17_and_4_goes_before() -> None:
    desk = Desk()
    assert desk.plain(address(240)) == refusal(Reason.BAD_FORM)
    assert desk.plain(address(0x21)).ok, "what was refused does not count"
    desk.now += 9.9
    assert desk.plain(address(0x22)) == refusal(Reason.BUSY)
    assert desk.plain(address(240)) == refusal(Reason.BAD_FORM)
    desk.now += 0.1
    assert desk.plain(address(0x22)).ok, "nor does the 17"
    desk.restart()
    assert desk.plain(address(0x23)).ok, "the 10 s are of one power-up"


def test_a_node_without_can_has_no_address_and_does_not_know_128_10() -> None:
    desk = Desk().agree()
    desk.tim = Tim(NODE, desk.memory, lambda: desk.now, max_message=desk.max_message, has_can=False)
    assert desk.tim.identity().can_address == 0
    assert desk.plain(address(0x21)) == refusal(Reason.UNKNOWN_COMMAND)
    assert desk.plain(address(0x21), tapped=False) == refusal(Reason.UNKNOWN_COMMAND)
    desk.open()
    assert desk.sealed(address(0x21)) == refusal(Reason.UNKNOWN_COMMAND)


def test_the_address_that_is_in_flash_is_not_written_again_and_a_claim_is_undone() -> None:
    desk = Desk()
    assert desk.plain(address(0x21)).ok
    desk.memory.fail = True  # a write would be refused with 11
    assert desk.plain(address(0x21)).ok
    desk.tim.take_can_address(0x40)
    assert Identity.decode(desk.plain(COMMANDS["identify"]).payload).can_address == 0x40, "the present one"
    assert desk.plain(address(0x21)).ok
    assert desk.tim.can_address == 0x21
    desk.memory.fail = False
    assert desk.plain(address(0x22)) == refusal(Reason.BUSY), "only writes count, and one was made"


def test_a_change_of_the_address_that_flash_refused_does_not_count() -> None:
    desk = Desk()
    desk.memory.fail = True
    assert desk.plain(address(0x21)) == refusal(Reason.FLASH_FAILURE)
    desk.memory.fail = False
    assert desk.plain(address(0x21)).ok


@pytest.mark.parametrize("what", ["an address", "a reset", "a datasheet"])
def test_what_flash_took_and_reads_back_as_something_else_gets_11_and_does_not_count(what: str) -> None:
    desk = Desk().provision().open()
    before = desk.tim.identity()
    desk.memory.garbles = True
    if what == "a datasheet":
        reply = desk.commit({(0, 1): META})
    else:
        reply = desk.sealed(address(0x21) if what == "an address" else security_command(Function.RESET, CHALLENGE))
    assert reply.reason == Reason.FLASH_FAILURE
    assert desk.tim.identity() == before
    desk.memory.garbles = False
    assert desk.sealed(security_command(Function.RESET, CHALLENGE)).ok


@pytest.mark.parametrize("chip", ["random", "one_time", "key"])
def test_a_chip_that_does_not_work_gets_11_and_nothing_has_happened(chip: str) -> None:
    def broken(*_: object) -> Any:
        raise ChipError

    desk = Desk()
    if chip == "key":
        desk.tim._agreeing._key = SimpleNamespace(point=NODE.point, sign=broken)  # type: ignore[assignment]
    else:
        setattr(desk.tim._agreeing, f"_{chip}", broken)
    assert desk.plain(REQUEST) == refusal(Reason.FLASH_FAILURE)
    assert desk.plain(security_command(Function.CONFIRM, bytes(16))) == refusal(Reason.WRONG_STATE)


# -- reset -------------------------------------------------------------------------------------------------------------


def test_reset_goes_back_to_factory_and_keeps_identity_epoch_and_sequence() -> None:
    desk = Desk().provision()
    proof = desk.sealed(COMMANDS["reset"]).payload
    assert verify(NODE.point, reset_message(UUID, 1, CHALLENGE), proof)
    flash = desk.flash
    assert (flash.state, flash.key, flash.ca, flash.station) == (NodeState.FACTORY, None, None, None)
    assert (flash.epoch, flash.sequence, flash.uuid) == (1, 1, UUID)
    assert flash.blocks == {(0, 1): META, (1, 12): flash.blocks[1, 12]}
    shown = security.decode(flash.security_teds())
    assert (shown.signed, shown.sequence, shown.key_epoch) == (False, 1, 1)
    assert desk.plain(COMMANDS["reset"]).payload == proof, "a lost receipt can be fetched again"
    assert desk.plain(COMMANDS["open"]).reason == Reason.WRONG_STATE


def test_reset_by_hand_has_the_same_effect() -> None:
    desk, by_hand = Desk().provision(), Desk().provision()
    desk.sealed(COMMANDS["reset"])
    by_hand.tim.reset_by_hand()
    assert (by_hand.flash.state, by_hand.flash.blocks.keys()) == (desk.flash.state, desk.flash.blocks.keys())
    assert by_hand.agree().flash.epoch == 2


@pytest.mark.parametrize("by", ["command", "hand"])
def test_a_reset_keeps_the_address(by: str) -> None:
    desk = Desk().agree()
    assert desk.plain(address(0x21)).ok
    if by == "hand":
        desk.tim.reset_by_hand()
    else:
        assert desk.open().sealed(COMMANDS["reset"]).ok
    assert desk.tim.identity().state == NodeState.FACTORY
    assert desk.tim.identity().can_address == 0x21
    desk.restart()
    assert desk.tim.identity().can_address == 0x21


def test_a_reset_node_takes_another_owner() -> None:
    desk = Desk().provision()
    desk.sealed(COMMANDS["reset"])
    assert desk.agree().flash.epoch == 2


# -- sessions ----------------------------------------------------------------------------------------------------------


def sealed_frame(desk: Desk, command: Command) -> Command:
    assert desk.session is not None
    return desk.session.seal(command)


def test_a_replayed_counter_gets_13_and_ends_nothing() -> None:
    desk = Desk().agree().open()
    frame = sealed_frame(desk, COMMANDS["identify"])
    assert desk.plain(frame).ok
    assert desk.plain(frame) == refusal(Reason.REPLAY)
    assert desk.sealed(COMMANDS["identify"]).ok


def test_a_bad_tag_gets_12_before_the_counter_and_ends_nothing() -> None:
    desk = Desk().agree().open()
    frame = sealed_frame(desk, COMMANDS["identify"])
    assert desk.plain(frame).ok
    broken = security_command(Function.SEALED, frame.payload[:-1] + bytes([frame.payload[-1] ^ 1]))
    assert desk.plain(broken) == refusal(Reason.BAD_TAG)
    assert desk.sealed(COMMANDS["identify"]).ok


def test_a_half_open_session_replaces_the_old_one_at_its_first_good_frame_only() -> None:
    desk = Desk().agree().open()
    assert desk.sealed(COMMANDS["identify"]).ok
    old = desk.session
    desk.open()
    new, desk.session = desk.session, old
    assert desk.sealed(COMMANDS["identify"]).ok, "the old session lives while the new one is half-open"
    desk.session = new
    assert desk.sealed(COMMANDS["identify"]).ok
    assert old is not None
    assert desk.plain(old.seal(COMMANDS["identify"])) == refusal(Reason.BAD_TAG)


def test_a_new_open_replaces_the_half_open_one() -> None:
    desk = Desk().agree().open()
    first = desk.session
    desk.open()
    assert first is not None
    assert desk.plain(first.seal(COMMANDS["identify"])) == refusal(Reason.BAD_TAG)
    assert desk.sealed(COMMANDS["identify"]).ok


@pytest.mark.parametrize(("seconds", "lives"), [(59.9, True), (60.0, False)])
def test_a_half_open_session_lives_60_seconds(seconds: float, lives: bool) -> None:
    desk = Desk().agree().open()
    desk.now += seconds
    assert desk.plain(sealed_frame(desk, COMMANDS["identify"])).ok is lives


@pytest.mark.parametrize(("seconds", "lives"), [(599.0, True), (600.0, False)])
def test_a_session_lives_ten_minutes_after_its_last_good_frame(seconds: float, lives: bool) -> None:
    desk = Desk().agree().open()
    assert desk.sealed(COMMANDS["identify"]).ok
    desk.now += seconds
    reply = desk.plain(sealed_frame(desk, COMMANDS["identify"]))
    assert reply.ok is lives
    assert lives or reply.reason == Reason.WRONG_STATE


def test_each_good_frame_gives_a_session_ten_minutes_more() -> None:
    desk = Desk().agree().open()
    for _ in range(4):
        assert desk.sealed(COMMANDS["identify"]).ok
        desk.now += 599
    assert desk.sealed(COMMANDS["identify"]).ok
    assert desk.session is not None
    frame = desk.session.seal(COMMANDS["identify"]).payload
    bad = security_command(Function.SEALED, frame[:-1] + bytes([frame[-1] ^ 1]))
    desk.now += 599
    desk.plain(bad)
    desk.now += 1
    assert desk.plain(COMMANDS["sealed"]) == refusal(Reason.WRONG_STATE), "a bad one gives it nothing"


@pytest.mark.parametrize("end", ["close", "lost", "restart"])
def test_what_ends_a_session(end: str) -> None:
    desk = Desk().agree().open()
    assert desk.sealed(COMMANDS["identify"]).ok
    if end == "close":
        assert desk.sealed(COMMANDS["close"]) == Reply(True)
    elif end == "lost":
        desk.tim.link_lost("nfc")
    else:
        desk.restart()
    assert desk.plain(sealed_frame(desk, COMMANDS["identify"])) == refusal(Reason.WRONG_STATE)


def test_sessions_belong_to_their_link() -> None:
    desk = Desk().agree().open()
    assert desk.plain(sealed_frame(desk, COMMANDS["identify"]), link="can:f1") == refusal(Reason.WRONG_STATE)


def test_confirm_and_reset_end_every_session_on_every_link() -> None:
    desk = Desk().agree().open(link="can:f1")
    assert desk.sealed(COMMANDS["identify"], link="can:f1").ok
    other = desk.session
    desk.agree()
    assert other is not None
    assert desk.plain(other.seal(COMMANDS["identify"]), link="can:f1") == refusal(Reason.WRONG_STATE)


def test_a_half_open_open_goes_with_its_link_alone() -> None:
    desk = Desk().agree()
    half_open = {link: desk.open(link=link).session for link in ("nfc", "can:f1")}
    desk.tim.link_lost("nfc")
    for link, reason in (("nfc", Reason.WRONG_STATE), ("can:f1", None)):
        session = half_open[link]
        assert session is not None
        assert desk.plain(session.seal(COMMANDS["identify"]), link=link, tapped=False).reason == reason


def test_confirm_ends_every_half_open_open_too() -> None:
    desk = Desk().agree().open(link="can:f2")
    half_open = desk.session
    desk.agree()
    assert half_open is not None
    assert desk.plain(half_open.seal(COMMANDS["identify"]), link="can:f2") == refusal(Reason.WRONG_STATE)


def test_the_last_counter_is_served_and_ends_the_session() -> None:
    desk = Desk().agree().open()
    session = desk.session
    assert session is not None
    session._counter = 0xFFFFFFFE  # four thousand million frames would take too long
    assert desk.sealed(COMMANDS["identify"]).ok
    assert desk.plain(COMMANDS["sealed"]) == refusal(Reason.WRONG_STATE)


def test_an_open_with_an_old_key_gets_16() -> None:
    desk = Desk().agree()
    old = desk.key
    desk.agree()
    assert key_id(old) != key_id(desk.key)
    session = StationSession(old, UUID)
    assert desk.plain(session.open(desk.plain(session.request_counter()).payload)) == refusal(Reason.UNKNOWN_KEY)


def test_the_security_teds_of_a_keyed_node_is_initial_with_the_present_epoch() -> None:
    desk = Desk().agree()
    teds = desk.plain(read_teds(*SECURITY, 0)).payload[4:]
    shown = security.decode(teds)
    assert (shown.signed, shown.key_epoch, shown.sequence) == (False, 1, 0)
