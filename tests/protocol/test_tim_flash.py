"""Staged writes and the verified commit: every refusal of profile section 5, one by one and in order."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from teds_provision.protocol.keys import GROUP_ORDER, SoftwareKey, station_key_message, verify
from teds_provision.protocol.messages.frames import (
    Attribute,
    Command,
    Function,
    Reason,
    Reply,
    TedsStatus,
    decode_list,
    query_teds,
    read_teds,
    refusal,
    security_command,
    update_teds,
    write_teds,
)
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.tim.node import Tim
from teds_provision.teds.codec import security
from teds_provision.teds.codec.frame import frame, unframe
from teds_provision.teds.image import SECURITY

from .desk import CA, META, NAME, NODE, STATION, UUID, Desk, digest
from .memory import PowerCutError

BLOCKS = {(0, 1): META, (1, 12): NAME}


@pytest.fixture
def desk() -> Desk:
    return Desk().agree().open()


def status(desk: Desk, channel: int, access_code: int) -> TedsStatus:
    return TedsStatus.decode(desk.plain(query_teds(channel, access_code)).payload)


def read(desk: Desk, channel: int, access_code: int) -> bytes:
    octets = b""
    while part := desk.plain(read_teds(channel, access_code, len(octets))).payload[4:]:
        octets += part
    return octets


# -- reading -----------------------------------------------------------------------------------------------------------


def test_query_of_an_absent_teds_says_not_available() -> None:
    found = status(Desk(), 1, 5)
    assert (found.attributes, found.size, found.checksum) == (Attribute.NOT_AVAILABLE, 0, 0)
    assert found.max_size > 0


def test_a_node_may_hold_codes_1_to_17_and_128_to_135_on_channels_0_to_255() -> None:
    """The whole reply of Query to each that is absent: NotAvail, what it would be, no size, no checksum."""
    desk = Desk()
    rest = "0000000000000000004000"
    for code in (1, *range(3, 18), *range(129, 136)):
        shown = 0x42 if code >= 128 else 0x12 if code in (2, 4, 6, 10, 11, 14, 15) else 0x02
        for channel in (0, 1, 255):
            found = desk.plain(query_teds(channel, code))
            assert (found.ok, found.payload.hex()) == (True, f"{shown:02x}{rest}"), (channel, code)
    assert desk.plain(query_teds(255, 128)).payload.hex() == f"42{rest}", "128 may lie on any channel"


def test_query_of_the_security_teds_says_it_is_the_manufacturers() -> None:
    found = status(Desk(), 0, 128)
    assert found.attributes == Attribute.MANUFACTURER
    assert found.size == len(Desk().flash.security_teds())


def test_read_of_an_absent_teds_gets_18() -> None:
    assert Desk().plain(read_teds(1, 5, 0)) == refusal(Reason.NO_SUCH_TEDS)


@pytest.mark.parametrize(("channel", "code"), [(0, 0), (0, 18), (0, 127), (0, 136), (256, 3), (0xFFFF, 1)])
def test_a_teds_that_the_node_could_never_hold_gets_18(channel: int, code: int) -> None:
    assert Desk().plain(query_teds(channel, code)) == refusal(Reason.NO_SUCH_TEDS)
    assert Desk().plain(read_teds(channel, code, 0)) == refusal(Reason.NO_SUCH_TEDS)


def test_read_past_the_end_gives_the_length_and_no_octets() -> None:
    size = len(Desk().flash.security_teds())
    for offset in (size, size + 9, 0xFFFF, 0x10000, 0x1_0010, 0xFFFF_FFFF):  # all 32 bits of it count
        assert Desk().plain(read_teds(0, 128, offset)).payload == size.to_bytes(4, "big")


def test_list_names_every_teds_ascending() -> None:
    desk = Desk().provision()
    assert decode_list(desk.plain(security_command(Function.LIST)).payload) == [(0, 1), (0, 128), (1, 12)]


# -- staging -----------------------------------------------------------------------------------------------------------


def test_segments_build_the_image_and_drop_what_lay_behind(desk: Desk) -> None:
    assert desk.sealed(write_teds(1, 12, 0, NAME[:10] + b"junk")).ok
    assert desk.sealed(write_teds(1, 12, 10, NAME[10:])).ok
    answer = TedsStatus.decode(desk.sealed(update_teds(1, 12)).payload)
    assert answer.size == len(NAME)
    assert desk.plain(read_teds(1, 12, 0)).reason == Reason.NO_SUCH_TEDS, "nothing counts before the commit"


def test_a_gap_gets_4_and_changes_nothing(desk: Desk) -> None:
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok
    for offset in (len(NAME) + 1, 0x10000, 0x10000 + len(NAME), 0xFFFF_FFFF):  # all 32 bits of it count
        assert desk.sealed(write_teds(1, 12, offset, b"x")) == refusal(Reason.BAD_FORM), offset
    assert desk.sealed(update_teds(1, 12)).ok


# -- one staging area --------------------------------------------------------------------------------------------------


@dataclass
class TwoSessions:
    """Two sessions, over NFC and over CAN."""

    desk: Desk
    here: StationSession
    there: StationSession

    def by_nfc(self, command: Command) -> Reply:
        self.desk.session = self.here
        return self.desk.sealed(command)

    def by_can(self, command: Command) -> Reply:
        self.desk.session = self.there
        return self.desk.sealed(command, link="can:f1")


@pytest.fixture
def two(desk: Desk) -> TwoSessions:
    here = desk.session
    there = desk.open(link="can:f1").session
    assert here is not None
    assert there is not None
    two = TwoSessions(desk, here, there)
    assert two.by_can(security_command(Function.LIST)).ok  # half-open no longer
    return two


BUSY = refusal(Reason.BUSY)


def test_while_something_is_staged_write_and_update_in_another_session_get_17(two: TwoSessions) -> None:
    assert two.by_nfc(write_teds(1, 12, 0, NAME)).ok
    assert two.by_can(write_teds(0, 1, 0, META)) == BUSY
    assert two.by_can(update_teds(0, 128)) == BUSY
    assert two.by_can(update_teds(1, 12)) == BUSY
    assert two.by_can(query_teds(1, 12)).ok, "to look is free"
    assert two.by_nfc(update_teds(1, 12)).ok, "and it is all there"


def test_the_17_of_the_staging_area_comes_after_4_3_and_18_and_before_10() -> None:
    block = frame(bytes.fromhex("0304050d0101"))
    desk = Desk(blocks={(0, 13): block}, read_only=frozenset({(0, 13)}))
    desk.agree().open()
    here, there = desk.session, desk.open(link="can:f1").session
    assert here is not None
    assert there is not None
    two = TwoSessions(desk, here, there)
    assert two.by_nfc(write_teds(1, 12, 0, NAME)).ok
    assert two.by_can(Command(1, 1, 3, b"\x0c\0\0\0")) == refusal(Reason.BAD_FORM)
    assert two.by_can(write_teds(1, 12, 1, b"x")) == refusal(Reason.BAD_FORM), "its own staging is empty"
    assert two.by_can(write_teds(0, 13, 0, b"x")) == refusal(Reason.NOT_PERMITTED)
    assert two.by_can(write_teds(0, 127, 0, b"x")) == refusal(Reason.NO_SUCH_TEDS)
    assert two.by_can(update_teds(0, 127)) == refusal(Reason.NO_SUCH_TEDS)
    assert two.by_can(write_teds(1, 12, 0, bytes(1900))) == BUSY


def test_a_write_of_too_much_gets_17_while_another_session_has_staged_and_10_then() -> None:
    desk = Desk().agree()
    desk.tim = Tim(NODE, desk.memory, lambda: desk.now, max_message=2048, max_teds=500)
    here, there = desk.open().session, desk.open(link="can:f1").session
    assert here is not None
    assert there is not None
    two = TwoSessions(desk, here, there)
    assert two.by_nfc(write_teds(1, 12, 0, bytes(500))).ok
    assert two.by_nfc(write_teds(1, 12, 500, b"x")) == refusal(Reason.TOO_LARGE)
    assert two.by_can(write_teds(1, 12, 0, bytes(501))) == BUSY
    desk.now += 60
    assert two.by_can(write_teds(1, 12, 0, bytes(501))) == refusal(Reason.TOO_LARGE)
    assert two.by_nfc(write_teds(1, 12, 500, b"")).ok, "the refusal made nothing give way"


@pytest.mark.parametrize(("seconds", "reply"), [(59.9, BUSY), (60.0, Reply(True))])
@pytest.mark.parametrize("touch", [update_teds(1, 12), write_teds(1, 12, 1, NAME[1:])], ids=["update", "write"])
def test_staging_that_was_not_touched_for_60_seconds_gives_way_to_a_write(
    two: TwoSessions, touch: Command, seconds: float, reply: Reply
) -> None:
    assert two.by_nfc(write_teds(1, 12, 0, NAME)).ok
    two.desk.now += 30
    assert two.by_nfc(touch).ok
    two.desk.now += seconds
    assert two.by_can(update_teds(0, 1)) == BUSY, "an Update makes nothing give way"
    assert two.by_can(write_teds(0, 1, 0, META)) == reply
    if reply.ok:
        assert two.by_nfc(update_teds(1, 12)) == BUSY, "what it had is gone"
        assert two.by_can(update_teds(0, 1)).ok
        assert two.by_can(update_teds(1, 12)) == two.by_can(query_teds(1, 12)), "nor is it the other one's"


def test_a_write_that_is_refused_makes_nothing_give_way(two: TwoSessions) -> None:
    assert two.by_nfc(write_teds(1, 12, 0, NAME)).ok
    two.desk.now += 60
    two.desk.tim._teds = replace(two.desk.tim._teds, max_teds=10)
    assert two.by_can(write_teds(0, 1, 0, META)) == refusal(Reason.TOO_LARGE)
    assert two.by_nfc(update_teds(1, 12)).ok


@pytest.mark.parametrize("end", ["close", "link", "commit"])
def test_the_staging_area_is_free_when_its_session_or_its_commit_is_over(two: TwoSessions, end: str) -> None:
    assert two.by_nfc(write_teds(1, 12, 0, NAME)).ok
    if end == "close":
        assert two.by_nfc(security_command(Function.CLOSE)).ok
    elif end == "link":
        two.desk.tim.link_lost("nfc")
    else:
        two.desk.session = two.here
        assert two.desk.commit(BLOCKS).ok
    assert two.by_can(write_teds(0, 1, 0, META)).ok


def test_a_node_takes_no_teds_that_its_list_could_not_name(desk: Desk) -> None:
    desk.tim._teds = replace(desk.tim._teds, max_message=42 + 3 * 3)
    assert desk.sealed(write_teds(0, 1, 0, META)).ok
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok
    assert desk.sealed(write_teds(2, 12, 0, NAME)) == refusal(Reason.TOO_LARGE)
    assert desk.sealed(write_teds(1, 12, 0, NAME)).ok, "one that is there already may change"


def test_a_read_only_teds_gets_3_and_survives_unlisted() -> None:
    desk = Desk(blocks={(0, 13): frame(bytes.fromhex("0304050d0101"))}, read_only=frozenset({(0, 13)}))
    desk.agree().open()
    assert desk.sealed(write_teds(0, 13, 0, b"x")) == refusal(Reason.NOT_PERMITTED)
    assert desk.commit(BLOCKS).ok
    assert (0, 13) in desk.flash.blocks
    assert status(desk, 0, 13).attributes == Attribute.READ_ONLY


def test_too_much_gets_10(desk: Desk) -> None:
    limit = status(desk, 0, 128).max_size
    for at in range(0, limit, 1024):
        assert desk.sealed(write_teds(0, 128, at, bytes(min(1024, limit - at)))).ok
    assert desk.sealed(write_teds(0, 128, limit, b"x")) == refusal(Reason.TOO_LARGE)


def test_a_frame_longer_than_max_message_gets_10_whatever_it_says(desk: Desk) -> None:
    longest = write_teds(0, 18, 0, bytes(desk.max_message - 11)).encode()
    assert desk.raw(longest) == refusal(Reason.NOT_PERMITTED)
    assert desk.raw(longest + b"\0") == refusal(Reason.TOO_LARGE)


def test_a_node_of_512_octets_takes_everything_that_provisioning_sends() -> None:
    desk = Desk(max_message=512)
    desk.agree().open().commit_in_pieces({(0, 1): META, (1, 12): NAME}, piece=512 - 53)
    assert desk.flash.state == NodeState.PROVISIONED
    desk.agree_in_session()
    assert desk.flash.epoch == 2


def test_a_write_of_what_can_never_be_held_gets_18(desk: Desk) -> None:
    assert desk.sealed(write_teds(0, 18, 0, b"x")) == refusal(Reason.NO_SUCH_TEDS)


@pytest.mark.parametrize(
    "teds",
    [
        NAME[:-1] + bytes([NAME[-1] ^ 1]),
        NAME + b"\0",
        META,
        b"",
        frame(b"\x05\x01\x41"),
        frame(bytes.fromhex("0304000c01")),  # a TEDSID that is cut off
        frame(bytes.fromhex("030600000c010101")),  # one of neither edition
        frame(bytes.fromhex("0404000c0101")),
    ],
)
def test_update_checks_length_checksum_and_class(desk: Desk, teds: bytes) -> None:
    desk.stage((1, 12), teds)
    assert desk.sealed(update_teds(1, 12)) == refusal(Reason.BAD_FORM)


def test_update_of_128_while_only_others_are_staged_gets_2(desk: Desk) -> None:
    desk.stage((1, 12), NAME)
    assert desk.sealed(update_teds(0, 128)) == refusal(Reason.WRONG_STATE)


def test_update_with_nothing_staged_answers_like_query(desk: Desk) -> None:
    assert desk.sealed(update_teds(0, 128)) == desk.sealed(query_teds(0, 128))


def test_staging_goes_with_its_session(desk: Desk) -> None:
    desk.stage((1, 12), NAME)
    desk.open()
    assert desk.sealed(write_teds(1, 12, len(NAME), b"x")) == refusal(Reason.BAD_FORM)


# -- the commit --------------------------------------------------------------------------------------------------------


def test_a_good_commit_answers_like_query_and_can_be_read_back(desk: Desk) -> None:
    assert desk.commit(BLOCKS) == desk.plain(query_teds(0, 128))
    assert read(desk, 0, 1) == META
    assert read(desk, 1, 12) == NAME
    assert security.decode(read(desk, 0, 128)).sequence == 1


def test_the_chip_of_the_node_checks_both_signatures_of_every_commit() -> None:
    """104 and 100, by the node's own ``verify``: what a slow chip costs is told by it."""
    asked: list[bytes] = []

    def chip(point: bytes, message: bytes, signature: bytes) -> bool:
        asked.append(point)
        return verify(point, message, signature)

    desk = Desk()
    desk.tim = Tim(NODE, desk.memory, lambda: desk.now, max_message=desk.max_message, verify=chip)
    desk.agree().open()
    del asked[:]
    assert desk.commit(BLOCKS).ok
    assert desk.commit({(0, 1): META}).ok
    assert asked == [CA.point, STATION.point] * 2


def test_a_stored_block_that_is_not_listed_is_removed(desk: Desk) -> None:
    assert desk.commit(BLOCKS).ok
    assert desk.commit({(0, 1): META}).ok
    assert set(desk.flash.blocks) == {(0, 1), SECURITY}


def test_a_listed_block_may_be_stored_already(desk: Desk) -> None:
    assert desk.commit(BLOCKS).ok
    desk.stage(SECURITY, desk.signed(BLOCKS))
    assert desk.sealed(update_teds(0, 128)).ok
    assert desk.flash.sequence == 2


def high_s(teds: bytes) -> bytes:
    shown = security.decode(teds)
    assert shown.signature is not None
    s = GROUP_ORDER - int.from_bytes(shown.signature[32:], "big")
    return shown.with_signature(shown.signature[:32] + s.to_bytes(32, "big")).encode()


def resigned(desk: Desk, **changes: object) -> bytes:
    """Change fields and sign again, rightly."""
    shown = replace(security.decode(desk.signed(BLOCKS)), **changes)
    return shown.with_signature(STATION.sign(security.tbs(UUID, shown.encode()))).encode()


def test_every_refusal_of_the_commit(desk: Desk) -> None:
    other = SoftwareKey(23)
    certified_by_other = SoftwareKey(29).sign(station_key_message(STATION.point))
    wrong = {**BLOCKS, (1, 12): frame(bytes.fromhex("0304000c0101040100050161"))}
    cases: list[tuple[bytes, Reason]] = [
        (desk.signed(BLOCKS)[:-1] + b"\0", Reason.BAD_FORM),
        (desk.flash.security_teds(), Reason.BAD_FORM),
        (frame(b"\x03\x04\0\x80\1\1"), Reason.BAD_FORM),
        (resigned(desk, values={**security.OUR_VALUES, 4: 0}), Reason.BAD_FORM),
        (resigned(desk, values={**security.OUR_VALUES, 109: 1}), Reason.BAD_FORM),
        (resigned(desk, node_key=other.point), Reason.BAD_SIGNATURE),
        (resigned(desk, node_key_signature=bytes(64)), Reason.BAD_SIGNATURE),
        (resigned(desk, station_key_signature=certified_by_other), Reason.BAD_SIGNATURE),
        (resigned(desk, station_key=other.point), Reason.BAD_SIGNATURE),
        (security.decode(desk.signed(BLOCKS)).with_signature(bytes(64)).encode(), Reason.BAD_SIGNATURE),
        (high_s(desk.signed(BLOCKS)), Reason.BAD_SIGNATURE),
        (desk.signed(wrong), Reason.DIGEST_MISMATCH),
        (desk.signed({(0, 1): META}), Reason.DIGEST_MISMATCH),
        (desk.signed({**BLOCKS, (1, 3): NAME}), Reason.DIGEST_MISMATCH),
        (desk.signed(BLOCKS, sequence=0), Reason.STALE_SEQUENCE),
        (desk.signed(BLOCKS, sequence=65537), Reason.STALE_SEQUENCE),
        (desk.signed(BLOCKS, key_epoch=0), Reason.WRONG_EPOCH),
        (desk.signed(BLOCKS, key_epoch=2), Reason.WRONG_EPOCH),
    ]
    for teds, reason in cases:
        assert desk.commit(BLOCKS, teds) == refusal(reason)
        assert desk.flash.blocks == {}, "a refusal changes nothing"
    assert desk.commit(BLOCKS, desk.signed(BLOCKS, sequence=65536)).ok


def test_a_node_takes_canonical_datasheets_up_to_their_edges_and_no_others(desk: Desk) -> None:
    listed = dict(security.decode(desk.signed(BLOCKS)).signed_blocks)  # decoded once for all who ask
    ours = security.OUR_VALUES
    for wrong in (
        resigned(desk, ca="x" * 65),
        resigned(desk, signed_blocks={**listed, (0, 128): bytes(32)}),
        resigned(desk, last_modified=bytes(7)),
        resigned(desk, extra={99: b"x"}),
        resigned(desk, values={number: value for number, value in ours.items() if number != 110}),
        *(resigned(desk, values={**ours, number: value + 1}) for number, value in ours.items()),
    ):
        assert desk.commit(BLOCKS, wrong) == refusal(Reason.BAD_FORM)
    beside = {**BLOCKS, (3, 128): frame(bytes.fromhex("030400800101"))}
    listed |= {(3, 128): digest(beside[3, 128])}
    good = resigned(desk, ca="\u00e9" * 32, signed_blocks=listed, extra={111: b"", 255: b"y"})
    assert desk.commit(beside, good).ok, "64 octets of a name, a TEDS of code 128 on another channel"


def test_of_two_faults_of_a_commit_the_first_check_names_its_own(desk: Desk) -> None:
    foreign = frame(bytes.fromhex("030400010101040a") + bytes(10) + bytes.fromhex("0a043f8000000c043f0000000d020001"))
    of_another = {(0, 1): foreign, (1, 12): NAME}
    stale = {"sequence": 0, "key_epoch": 2}
    other_digest = desk.signed({**of_another, (1, 12): NAME + b"x"}, **stale)
    other_key = replace(security.decode(other_digest), node_key_signature=bytes(64)).encode()
    other_value = replace(security.decode(other_key), values={**security.OUR_VALUES, 4: 0}).encode()
    assert desk.commit({(0, 1): foreign, (1, 12): NAME + b"x"}, other_key).reason == 4
    assert desk.commit(of_another, other_value).reason == 4
    assert desk.commit(of_another, other_key).reason == 5
    assert desk.commit(of_another, other_digest).reason == 6
    assert desk.commit(of_another, desk.signed(of_another, **stale)).reason == 9
    assert desk.commit(BLOCKS, desk.signed(BLOCKS, **stale)).reason == 7
    assert desk.commit(BLOCKS, desk.signed(BLOCKS, key_epoch=2)).reason == 8
    assert desk.commit(BLOCKS).ok


def test_a_meta_teds_of_another_node_gets_9_but_a_2024_uuid_is_not_compared(desk: Desk) -> None:
    foreign = frame(bytes.fromhex("030400010101040a") + bytes(10) + bytes.fromhex("0a043f8000000c043f0000000d020001"))
    assert desk.commit({(0, 1): foreign}) == refusal(Reason.WRONG_UUID)
    new_form = frame(bytes.fromhex("030500ff0102010410") + bytes(16))
    assert desk.commit({(0, 1): new_form}).ok
    nameless = frame(bytes.fromhex("0304000101010a043f8000000c043f0000000d020001"))
    assert desk.commit({(0, 1): nameless}) == refusal(Reason.WRONG_UUID), "field 4 is due"
    assert desk.commit({(0, 1): META, (1, 1): foreign}) == refusal(Reason.WRONG_UUID), "on whatever channel"


def test_a_read_only_meta_teds_of_another_node_gets_9_too() -> None:
    foreign = frame(bytes.fromhex("030400010101040a") + bytes(10) + bytes.fromhex("0a043f8000000c043f0000000d020001"))
    desk = Desk(blocks={(0, 1): foreign}, read_only=frozenset({(0, 1)})).agree().open()
    desk.stage(SECURITY, desk.signed({(0, 1): foreign}))
    assert desk.sealed(update_teds(0, 128)) == refusal(Reason.WRONG_UUID)


@pytest.mark.parametrize(
    ("name", "good"),
    [
        ("\u0080\u07ff\u0800\ud7ff\ue000\U00010000\U0010ffff".encode(), True),
        (b"\xe0\xa0\x80\xe1\x80\x80\xf0\x90\x80\x80\xf4\x8f\xbf\xbf", True),
        (b"\xc1\xbf", False),  # overlong
        (b"\xe0\x9f\xbf", False),
        (b"\xf0\x8f\xbf\xbf", False),
        (b"\xed\xa0\x80", False),  # a surrogate
        (b"\xf4\x90\x80\x80", False),  # beyond U+10FFFF
        (b"\xe1\x80\xc0", False),
        (b"ab\xe1\x80", False),
    ],
)
def test_the_name_of_a_ca_is_utf_8(desk: Desk, name: bytes, good: bool) -> None:
    stood_in = "x" * len(name)
    shown = security.decode(resigned(desk, ca=stood_in))
    octets = frame(unframe(shown.encode()).replace(stood_in.encode(), name))
    assert (desk.commit(BLOCKS, octets) == refusal(Reason.BAD_FORM)) is not good


def test_no_extra_field_comes_twice_or_behind_a_later_one(desk: Desk) -> None:
    body = unframe(resigned(desk, extra={112: b"ours", 113: b"ours"}))
    for field in (112, 111):
        changed = body.replace(b"\x71\x04ours", bytes([field, 4]) + b"ours")
        assert changed != body
        assert desk.commit(BLOCKS, frame(changed)) == refusal(Reason.BAD_FORM)


def test_no_block_is_listed_twice_or_behind_a_later_one(desk: Desk) -> None:
    body = unframe(desk.signed(BLOCKS))
    at = body.index(b"\x6c\x23\0\0\1")
    first, second = body[at : at + 37], body[at + 37 : at + 74]
    assert second[:5] == b"\x6c\x23\0\1\x0c"
    for wrong in (first + first + second, first + second + second, second + first, first + second[:-1]):
        changed = body[:at] + wrong + body[at + 74 :]
        assert desk.commit(BLOCKS, frame(changed)) == refusal(Reason.BAD_FORM)


@pytest.mark.parametrize("field", [100, 101, 102, 103, 104])
def test_spare_bits_and_padding_of_base64_are_as_they_must_be(desk: Desk, field: int) -> None:
    body = unframe(desk.signed(BLOCKS))
    at = body.index(bytes([field, 88])) + 2
    text = body[at : at + 88]
    ends = text.index(b"=")
    assert ends == (87 if field in (101, 103) else 86)
    last = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/".index(text[ends - 1])
    spare = b"ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789+/"[last + 1 : last + 2]
    for wrong in (
        text[: ends - 1] + spare + text[ends:],
        text[:ends] + b"A" + text[ends + 1 :],
        text[: ends - 1] + b"-" + text[ends:],
        text[:40] + b"=" + text[41:],
    ):
        assert desk.commit(BLOCKS, frame(body[:at] + wrong + body[at + 88 :])) == refusal(Reason.BAD_FORM), wrong


def test_extra_fields_are_covered_by_the_signature(desk: Desk) -> None:
    assert desk.commit(BLOCKS, resigned(desk, extra={111: b"ours", 255: b""})).ok


def test_any_certified_station_may_write(desk: Desk) -> None:
    second = SoftwareKey(31)
    shown = replace(
        security.decode(desk.signed(BLOCKS)),
        station_key=second.point,
        station_key_signature=CA.sign(station_key_message(second.point)),
    )
    signed = shown.with_signature(second.sign(security.tbs(UUID, shown.encode()))).encode()
    assert desk.commit(BLOCKS, signed).ok


@pytest.mark.parametrize("when", ["die_before", "die_after"])
def test_power_cut_in_the_commit_leaves_all_old_or_all_new(desk: Desk, when: str) -> None:
    assert desk.commit(BLOCKS).ok
    old = dict(desk.flash.blocks)
    new = {(0, 1): META}
    setattr(desk.memory, when, True)
    with pytest.raises(PowerCutError):
        desk.commit(new)
    assert set(desk.flash.blocks) == (set(old) if when == "die_before" else {(0, 1), SECURITY})
    desk.memory.die_before = desk.memory.die_after = False
    desk.restart()
    assert desk.tim.flash == desk.flash


def test_every_flipped_octet_of_a_signed_teds_is_refused(desk: Desk) -> None:
    good = desk.signed({(0, 1): META})
    desk.stage((0, 1), META)
    for at in range(len(good)):
        body = bytearray(good[4:-2]) if 4 <= at < len(good) - 2 else None
        flipped = bytearray(good)
        if body is not None:  # with a right checksum, so that only canonical form and signatures can catch it
            body[at - 4] ^= 1
            flipped = bytearray(frame(bytes(body)))
        else:
            flipped[at] ^= 1
        desk.stage(SECURITY, bytes(flipped))
        assert not desk.sealed(update_teds(0, 128)).ok, f"octet {at}"


@settings(max_examples=200, deadline=None)
@given(octets=st.binary(max_size=80), link=st.sampled_from(["nfc", "can:f1"]), keyed=st.booleans())
def test_any_octets_get_a_reply_and_never_an_exception(octets: bytes, link: str, keyed: bool) -> None:
    desk = Desk().agree() if keyed else Desk()
    before = desk.flash.blocks
    desk.raw(octets, link=link, tapped=link == "nfc")
    desk.raw(b"\0\0" + octets, link=link, tapped=True)
    assert desk.flash.blocks == before


def test_digest_is_over_the_whole_teds() -> None:
    assert security.decode(Desk().signed({(0, 1): META})).signed_blocks == {(0, 1): digest(META)}
