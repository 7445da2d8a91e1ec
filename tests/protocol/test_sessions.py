"""Open with one-time keys: what each side refuses, and what a stolen key does not open (profile section 4)."""

from __future__ import annotations

import pytest

from teds_provision.errors import GarbledError, NotAuthenticError
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.messages.frames import Command, Function, Reason, Reply, refusal, security_command
from teds_provision.protocol.session import NodeSession, SessionKeys, StationSession, _decrypt, _seal_padded, open_mac
from teds_provision.protocol.wire_agreement import StationAgreement, key_id

from .desk import CREDENTIALS, NODE, STATION, UUID, Desk

IDENTIFY = security_command(Function.IDENTIFY)
OFF_CURVE = b"\x04" + bytes(63) + b"\x01"


def opening(desk: Desk, *, one_time: SoftwareKey | None = None) -> tuple[StationSession, Command]:
    """A session half made: c was asked for, the Open is not sent yet."""
    session = StationSession(desk.key, UUID, one_time=one_time)
    return session, session.open(desk.plain(session.request_counter()).payload)


@pytest.mark.parametrize("size", [0, 7, 9])
def test_the_station_takes_eight_octets_for_c(size: int) -> None:
    with pytest.raises(GarbledError, match="counter for Open"):
        StationSession(bytes(16), UUID).open(bytes(size))


@pytest.mark.parametrize("point", [OFF_CURVE, bytes(65), b"\x02" + SoftwareKey(19).point[1:33] + bytes(32), "its own"])
def test_the_station_checks_the_nodes_one_time_point(point: bytes | str) -> None:
    own = SoftwareKey(23)
    session = StationSession(bytes(16), UUID, one_time=own)
    session.open(bytes(8))
    shown = own.point if isinstance(point, str) else point
    with pytest.raises(NotAuthenticError, match="is no one-time key"):
        session.accept(shown + bytes(16))


def test_a_static_key_at_hand_is_no_one_time_key_of_an_open() -> None:
    desk = Desk().agree()
    for static in (STATION, NODE):
        session = StationSession(desk.key, UUID, statics=(STATION.point, NODE.point))
        session.open(bytes(8))
        with pytest.raises(NotAuthenticError, match="is no one-time key"):
            session.accept(static.point + bytes(16))
        counter = desk.plain(session.request_counter()).payload
        wrong = StationSession(desk.key, UUID, one_time=static).open(counter)
        assert desk.plain(wrong).reason == Reason.BAD_POINT


@pytest.mark.parametrize("size", [0, 32, 80, 82])
def test_the_station_refuses_a_reply_of_another_length(size: int) -> None:
    session = StationSession(bytes(16), UUID)
    session.open(bytes(8))
    with pytest.raises(GarbledError):
        session.accept(bytes(size))


def test_a_node_without_the_key_is_caught_by_its_tag() -> None:
    desk, thief = Desk().agree(), Desk().agree()
    session, _ = opening(desk)
    reply = thief.plain(session_command(thief, SoftwareKey(29)))
    assert reply.ok
    with pytest.raises(NotAuthenticError, match="does not hold the key"):
        session.accept(reply.payload)


def session_command(desk: Desk, one_time: SoftwareKey) -> Command:
    return opening(desk, one_time=one_time)[1]


def test_an_open_is_good_once_and_counts() -> None:
    desk = Desk().agree()
    before = desk.plain(security_command(Function.OPEN)).payload
    _, frame = opening(desk)
    assert desk.plain(frame).ok
    assert desk.plain(frame) == refusal(Reason.BAD_TAG)
    after = desk.plain(security_command(Function.OPEN)).payload
    assert int.from_bytes(after, "big") == int.from_bytes(before, "big") + 1


def test_the_nodes_one_time_keys_are_each_for_one_open_or_one_request() -> None:
    desk = Desk().agree()
    points = [desk.plain(opening(desk)[1]).payload[:65] for _ in range(2)]
    points += [desk.plain(StationAgreement(CREDENTIALS, UUID).request()).payload[20:85] for _ in range(2)]
    points.append(desk.plain(opening(desk)[1]).payload[:65])
    assert [point[0] for point in points] == [4] * 5
    assert len(set(points)) == 5


def test_a_recorded_reply_is_not_taken_for_the_reply_to_a_later_command() -> None:
    """Its tag is right, under the counter that it names: only that it is not the one asked for tells."""
    desk = Desk().agree().open()
    assert desk.session is not None
    recorded = desk.plain(desk.session.seal(IDENTIFY)).payload
    desk.session.unseal(recorded)
    desk.session.seal(IDENTIFY)
    with pytest.raises(NotAuthenticError, match="does not belong to the command"):
        desk.session.unseal(recorded)


def test_c_is_one_for_all_links_and_new_at_each_start() -> None:
    desk = Desk().agree()
    _, frame = opening(desk)
    assert desk.plain(frame, link="can:f1", tapped=False).ok
    assert desk.plain(frame) == refusal(Reason.BAD_TAG), "used up by the other link"
    _, frame = opening(desk)
    desk.restart()
    assert desk.plain(frame) == refusal(Reason.BAD_TAG)


def test_the_counter_runs_over_without_harm() -> None:
    desk = Desk().agree()
    desk.tim._sessions._opens = (1 << 64) - 1
    _, frame = opening(desk)
    assert desk.plain(frame).ok
    assert desk.plain(security_command(Function.OPEN)).payload == bytes(8)


def test_a_stranger_costs_no_point_arithmetic() -> None:
    """Without K nobody makes the node draw a one-time key or decode a point."""
    desk = Desk().agree()
    made: list[SoftwareKey] = []

    def one_time() -> SoftwareKey:
        made.append(SoftwareKey.generate())
        return made[-1]

    desk.tim._sessions._one_time = one_time
    point = SoftwareKey(31).point
    for payload in (bytes(89), key_id(desk.key) + point + bytes(16), key_id(desk.key) + OFF_CURVE + bytes(16)):
        assert not desk.plain(security_command(Function.OPEN, payload)).ok
    assert not made
    desk.open()
    desk.open()
    assert len({key.point for key in made}) == 2, "each for one Open"


def test_the_link_key_alone_opens_no_recorded_session() -> None:
    """What a thief of K has: K, UUID and every frame. Z is missing, and nothing else he has stands for it."""
    desk = Desk().agree()
    session, opened = opening(desk)
    reply = desk.plain(opened).payload
    session.accept(reply)
    recorded = session.seal(IDENTIFY).payload
    station, node = opened.payload[8:73], reply[:65]
    guesses = (b"", bytes(32), desk.key, station[1:33], node[1:33], open_mac(desk.key, UUID, bytes(8), station))
    for shared in guesses:
        derived = SessionKeys.derive(desk.key, UUID, shared, station, node)
        assert _decrypt(derived.to_node, recorded) is None
    assert desk.plain(security_command(Function.SEALED, recorded)).ok, "the frame was a good one"


def test_no_key_shows_in_what_is_printed() -> None:
    keys = SessionKeys.derive(bytes(16), UUID, b"z" * 32, b"s" * 65, b"n" * 65)
    for secret in (keys.to_node, keys.to_station, keys.messages, keys.node_tag):
        assert repr(secret)[2:-1] not in repr(keys)


def test_both_sides_have_one_key_for_data_messages_and_it_is_new_with_each_open() -> None:
    desk = Desk().agree().open()
    assert desk.session is not None
    first = desk.session.message_key
    assert len(first) == 32
    line = desk.tim._sessions._links["nfc"]
    assert line.half_open is not None
    assert line.half_open.message_key == first
    desk.open()
    assert desk.session.message_key != first


def test_the_station_ends_a_session_whose_counters_are_used_up() -> None:
    desk = Desk().agree().open()
    assert desk.session is not None
    desk.session._counter = 0xFFFFFFFE
    assert desk.sealed(IDENTIFY).ok, "the last one"
    with pytest.raises(GarbledError, match="used up its counters"):
        desk.session.seal(IDENTIFY)


def test_a_sealed_reply_whose_padding_is_wrong_is_not_reported_as_a_wrong_tag() -> None:
    """A node that adds no block of padding to a multiple of 16 octets: its key is right, and was accused."""
    station, key = StationSession(bytes(16), UUID), bytes(16)
    node = NodeSession(key, UUID, station.open(bytes(8)).payload[8:73], SoftwareKey(31))
    station.accept(node.reply)
    station.seal(IDENTIFY)
    inner = Reply(True, bytes(13)).encode()
    assert len(inner) % 16 == 0
    with pytest.raises(NotAuthenticError, match="padding of a sealed reply is wrong; its tag is right"):
        station.unseal(_seal_padded(node._keys.to_station, 1, inner))


def test_a_padding_that_is_none_is_a_wrong_tag_and_uses_up_no_counter() -> None:
    """RFC 5652 6.3: 1 to 16 octets, each their number."""
    desk = Desk().agree().open()
    session = desk.session
    assert session is not None
    frame = IDENTIFY.encode()
    wrong = [frame + bytes(10), frame + bytes(9) + b"\x0a", frame + b"\x0a" * 9 + b"\x0b", frame + b"\x11" * 26]
    wrong += [frame + b"\xff" * 10, frame + b"\x09" + b"\x0a" * 9 + b"\x20" * 16]
    wrong += [frame + bytes(10) + b"\x0f" + b"\x10" * 15]
    for blocks in wrong:
        assert len(blocks) % 16 == 0
        assert desk.plain(session.seal_padded(blocks)) == refusal(Reason.BAD_TAG), blocks.hex()
        session._counter -= 1
    assert desk.sealed(IDENTIFY).ok, "under the counter that was not used up"


def test_a_sealed_command_has_counter_a_block_and_a_tag() -> None:
    desk = Desk().agree().open()
    for octets in range(36):
        sealed = security_command(Function.SEALED, bytes(octets))
        assert desk.plain(sealed) == refusal(Reason.BAD_FORM), octets
    assert desk.plain(security_command(Function.SEALED, bytes(36))) == refusal(Reason.BAD_TAG)


def test_a_request_waits_for_its_confirm_while_other_sessions_end() -> None:
    """A Confirm comes by the session of its Request; what ends beside it is nothing to it."""
    desk = Desk().agree().open()
    own = desk.session
    agreement = StationAgreement(CREDENTIALS, UUID)
    reply = desk.sealed(agreement.request())
    assert reply.ok
    agreed = agreement.accept(
        reply.payload, desk.flash.security_teds(), pinned=fingerprint(NODE.point), epoch=desk.flash.epoch
    )
    desk.open(link="can:f1")
    assert desk.sealed(security_command(Function.CLOSE), link="can:f1").ok
    desk.session = own
    assert desk.sealed(agreed.confirm).ok
