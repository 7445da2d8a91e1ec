"""Sessions of a node over all its links: who has room, who gives way, what lives how long (profile.md, "Sessions")."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest

from teds_provision.protocol.flash import Flash
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.frames import CommandRefusedError, Function, Reason, security_command
from teds_provision.protocol.session import NodeSession, StationSession, open_mac
from teds_provision.protocol.tim import Tim
from teds_provision.protocol.tim.node_sessions import OpenedFrame, Sessions
from teds_provision.protocol.wire_agreement import key_id

from .desk import NODE, STATION, UUID, Desk

KEY = bytes(range(16))
INNER = security_command(Function.IDENTIFY)


class Room:
    """The sessions of one node with room for two; a clock that the test moves; what is claimed; what ended."""

    def __init__(self, *, first: bytes = bytes(7) + b"\x09") -> None:
        self.now, self.claimed, self.ended = 1000.0, set[NodeSession](), list[NodeSession]()
        self.flash = Flash(UUID, NODE.point, b"", key=KEY, station=STATION.point)
        made = iter(range(41, 90))
        self.sessions = Sessions(
            lambda: self.now, lambda size: first[:size], lambda: SoftwareKey(next(made)), room=2,
            claims=lambda session: session in self.claimed, ended=self.ended.append,
        )  # fmt: skip

    @property
    def counter(self) -> int:
        return int.from_bytes(self.sessions.open(b"", "can:f1", self.flash), "big")

    def half_open(self, link: str) -> StationSession:
        station = StationSession(KEY, UUID)
        command = station.open(self.sessions.open(b"", link, self.flash))
        station.accept(self.sessions.open(command.payload, link, self.flash))
        return station

    def frame(self, station: StationSession, link: str, *, counter: int | None = None) -> OpenedFrame:
        return self.sessions.open_frame(station.seal(INNER, counter=counter).payload, link)

    def opened(self, link: str) -> NodeSession:
        self.frame(self.half_open(link), link)
        found = self.sessions.on(link)
        assert found is not None
        return found

    def alive(self, *links: str) -> list[bool]:
        return [self.sessions.any_on(link) for link in links]


def refused(call: Callable[[], object]) -> Reason:
    with pytest.raises(CommandRefusedError) as caught:
        call()
    return Reason(caught.value.reason)


def payload_of(room: Room, one_time: bytes, *, key: bytes = KEY, counter: bytes | None = None) -> bytes:
    c = room.sessions.open(b"", "nfc", room.flash) if counter is None else counter
    return key_id(key) + one_time + open_mac(key, UUID, c, one_time)


GOOD = SoftwareKey(23).point


def test_c_is_used_up_by_a_good_mac_alone_and_begins_anew_after_the_last() -> None:
    room = Room(first=bytes([255] * 7) + b"\xfe")
    assert room.counter == 0xFFFFFFFFFFFFFFFE == room.counter
    good, flash = payload_of(room, GOOD), room.flash
    unknown = payload_of(room, GOOD, key=bytes(16))

    def answer(payload: bytes, state: Flash) -> Reason:
        return refused(lambda: room.sessions.open(payload, "nfc", state))

    for payload, state, why in (
        (good[:-1], flash, Reason.BAD_FORM),
        (good + b"\0", flash, Reason.BAD_FORM),
        (good, replace(flash, key=None), Reason.UNKNOWN_KEY),
        (unknown, flash, Reason.UNKNOWN_KEY),
        (good[:-1] + bytes([good[-1] ^ 1]), flash, Reason.BAD_TAG),
        (payload_of(room, GOOD, counter=bytes(8)), flash, Reason.BAD_TAG),
        (good[:8] + SoftwareKey(24).point + good[-16:], flash, Reason.BAD_TAG),
    ):  # fmt: skip
        assert answer(payload, state) == why
        assert room.counter == 0xFFFFFFFFFFFFFFFE
    assert not room.sessions.any_on("nfc")
    assert len(room.sessions.open(good, "nfc", flash)) == 81
    assert room.counter == 0xFFFFFFFFFFFFFFFF
    for number, point in enumerate((NODE.point, STATION.point, b"\x04" + bytes(63) + b"\x01")):
        assert answer(payload_of(room, point), flash) == Reason.BAD_POINT
        assert room.counter == number
    room.sessions.lose("nfc")
    room.sessions.open(payload_of(room, GOOD), "can:f1", replace(flash, station=None))


def test_the_oldest_of_three_half_open_opens_gives_way() -> None:
    room = Room()
    stations = {}
    for link in ("can:f2", "can:f1", "nfc"):
        room.now += 1
        stations[link] = room.half_open(link)
    assert room.alive("can:f2", "can:f1", "nfc") == [False, True, True]
    assert refused(lambda: room.frame(stations["can:f2"], "can:f2")) == Reason.BAD_TAG
    room.now += 1
    room.half_open("can:f1")  # in the place of its own
    assert room.alive("can:f1", "nfc") == [True, True]
    assert refused(lambda: room.frame(stations["can:f1"], "can:f1")) == Reason.BAD_TAG
    assert room.frame(stations["nfc"], "nfc").inner == INNER.encode()


def test_a_session_takes_no_place_of_an_open_that_is_half_open() -> None:
    room = Room()
    first = room.half_open("can:f1")
    room.now += 1
    room.opened("can:f2")
    room.now += 1
    room.half_open("nfc")
    assert room.frame(first, "can:f1").room


def test_a_half_open_open_lives_one_minute_and_a_silent_session_ten() -> None:
    room = Room()
    room.half_open("nfc")
    session = room.opened("can:f1")
    room.now += 59.999
    assert room.alive("nfc", "can:f1", "ble:2") == [True, True, False]
    room.now = 1060.0
    assert room.alive("nfc", "can:f1") == [False, True]
    room.now = 1599.999
    assert room.alive("can:f1") == [True]
    assert room.ended == []
    room.now = 1600.0
    assert room.alive("can:f1") == [False]
    assert room.sessions.on("can:f1") is None
    assert room.ended == [session]


def test_a_good_frame_keeps_a_session_and_its_counter_rises() -> None:
    room = Room()
    station = room.half_open("can:f1")
    assert room.frame(station, "can:f1", counter=5)[1:] == (5, INNER.encode(), True)
    session = room.sessions.on("can:f1")
    assert session is not None
    assert (session.counter, session.good_at) == (5, 1000.0)
    room.now = 1500.0
    for counter in (5, 4, 0):
        assert refused(partial(room.frame, station, "can:f1", counter=counter)) == Reason.REPLAY
    short = station.seal(INNER, counter=6).payload
    assert refused(lambda: room.sessions.open_frame(short[:35], "can:f1")) == Reason.BAD_FORM
    assert len(short) == 36
    assert refused(lambda: room.sessions.open_frame(short[:-1] + bytes([short[-1] ^ 1]), "can:f1")) == Reason.BAD_TAG
    assert (session.counter, session.good_at) == (5, 1000.0)
    assert room.frame(station, "can:f1", counter=7).session is session
    assert (session.counter, session.good_at) == (7, 1500.0)
    assert room.ended == []
    assert room.sessions.on("nfc") is None
    room.now = 2099.0
    assert room.alive("can:f1") == [True]


def test_a_first_frame_of_counter_0_is_a_replay_and_leaves_the_open_half_open() -> None:
    room = Room()
    station = room.half_open("nfc")
    assert refused(lambda: room.frame(station, "nfc", counter=0)) == Reason.REPLAY
    assert room.frame(station, "nfc", counter=1).room


def test_a_new_session_of_a_link_ends_the_one_before_once_it_has_a_good_frame() -> None:
    room = Room()
    before = room.opened("can:f1")
    station = room.half_open("can:f1")
    assert room.sessions.on("can:f1") is before
    assert room.ended == []
    made = room.frame(station, "can:f1").session
    assert room.sessions.on("can:f1") is made
    assert room.ended == [before]
    room.now += 60
    assert room.alive("can:f1") == [True]


@pytest.mark.parametrize(
    ("silent", "claimed", "ends"),
    [
        (("can:f1", "can:f2"), (), "can:f1"),  # the longest silent first
        (("can:f2", "can:f1"), (), "can:f2"),
        (("can:f1", "can:f2"), ("can:f1",), "can:f2"),
        (("can:f1", "can:f2"), ("can:f1", "can:f2"), None),
    ],
)
def test_the_longest_silent_session_without_a_claim_gives_way_to_a_third(
    silent: tuple[str, ...], claimed: tuple[str, ...], ends: str | None
) -> None:
    room, live = Room(), dict[str, NodeSession]()
    for link in silent:
        room.now += 10
        live[link] = room.opened(link)
    room.claimed = {live[link] for link in claimed}
    room.now += 10
    station = room.half_open("nfc")
    opened = room.frame(station, "nfc")
    assert opened.room is (ends is not None)
    assert room.ended == ([live[ends]] if ends else [])
    assert (room.sessions.on("nfc") is opened.session) is (ends is not None)
    if ends is None:
        assert refused(lambda: room.frame(station, "nfc")) == Reason.BAD_TAG  # its half-open Open is over
        assert room.alive("nfc", *silent) == [False, True, True]


def test_a_link_that_opens_anew_needs_no_room_and_who_was_silent_too_long_takes_none() -> None:
    room = Room()
    first, second = room.opened("can:f1"), room.opened("can:f2")
    room.claimed = {first, second}
    room.opened("can:f2")
    assert room.ended == [second]
    room.now += 600
    room.claimed = {session for session in (first, room.sessions.on("can:f2")) if session is not None}
    room.opened("nfc")
    assert first in room.ended
    assert room.sessions.on("can:f1") is None


def test_no_room_leaves_the_session_that_the_link_has() -> None:
    room = Room()
    links = ("can:f1", "can:f2")
    room.claimed = {room.opened(link) for link in links}
    third = room.half_open("nfc")
    assert not room.frame(third, "nfc").room
    assert [room.sessions.on(link) is not None for link in (*links, "nfc")] == [True, True, False]
    assert room.ended == []


def test_what_ends_a_session() -> None:
    room = Room()
    first, second = room.opened("can:f1"), room.opened("can:f2")
    room.sessions.end("can:f1", second)
    room.sessions.end("nfc", first)
    room.sessions.lose("nfc")
    assert room.ended == []
    room.sessions.end("can:f1", first)
    room.sessions.end("can:f1", first)
    assert room.ended == [first]
    room.half_open("can:f2")
    room.sessions.lose("can:f2")
    assert room.ended == [first, second]
    assert room.alive("can:f1", "can:f2") == [False, False]
    third, fourth = room.opened("can:f1"), room.opened("can:f2")
    room.half_open("nfc")
    room.sessions.end_all()
    assert room.ended == [first, second, third, fourth]
    assert room.alive("can:f1", "can:f2", "nfc") == [False, False, False]


@pytest.mark.parametrize("places", [2, 3])
def test_a_node_has_as_many_sessions_as_it_was_made_with(places: int) -> None:
    desk = Desk().agree()
    desk.tim = Tim(NODE, desk.memory, lambda: desk.now, sessions=places)
    links = [f"can:{number:02x}" for number in range(0xE1, 0xE1 + places + 1)]
    for link in links:
        desk.now += 1
        desk.open(link=link)
    assert [desk.tim._sessions.any_on(link) for link in links] == [False] + [True] * places
