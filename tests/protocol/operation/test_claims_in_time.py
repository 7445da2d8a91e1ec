"""Claims by themselves: who holds what, when it ends, which actuators are safe then (operation.md sections 1 and 2)."""

from __future__ import annotations

import pytest

from teds_provision.errors import GarbledError
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.operation.claims import Claims
from teds_provision.protocol.operation.datagram import DatagramSealer, DriveValues, Layout, drive_key
from teds_provision.protocol.operation.driving import Driver
from teds_provision.protocol.operation.hardware import ChannelHardware, teds_fits, teds_period
from teds_provision.protocol.operation.stream_commands import DriveReply
from teds_provision.protocol.operation.subscription import TickBounds
from teds_provision.protocol.session import NodeSession
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.sheet import ChannelKind
from tests.protocol.operation.bench import FakeHardware, channel_teds
from tests.protocol.operation.kat import UUID

SECOND, MS = 1_000_000_000, 1_000_000


def session(number: int, *, good_at: float = 0.0) -> NodeSession:
    made = NodeSession(bytes(16), UUID, SoftwareKey(number).point, SoftwareKey(number + 100))
    made.good_at = good_at
    return made


A, B, C = (session(number) for number in (51, 52, 53))


class Held:
    """The claims of a node with sensors 1, 2, 3, event sensor 5, actuators 4 and 6; which went safe, what ended."""

    def __init__(self) -> None:
        self.hardware, self.ended = FakeHardware(), list[tuple[NodeSession, set[int]]]()
        self.claims = Claims(self.hardware, lambda session, channels: self.ended.append((session, set(channels))))
        for one in (A, B, C):
            one.good_at = 0.0

    def went_safe(self) -> list[object]:
        """Which actuators went safe since this was asked last."""
        went = [channel for what, channel in self.hardware.log if what == "safe"]
        self.hardware.log.clear()
        return went

    def acting(self, one: NodeSession, channel: int, *, dead_man: int = 100, lease: int = 10, now: int = 0) -> None:
        self.claims.claim_actuator(one, channel, lease, dead_man, now)
        self.claims.fed([channel], now)
        self.went_safe()


@pytest.fixture
def held() -> Held:
    return Held()


def test_every_actuator_is_safe_from_the_start_and_until_it_is_fed(held: Held) -> None:
    assert held.went_safe() == [4, 6]
    assert held.claims.safe == {4, 6}
    held.claims.fed([], 0)
    held.claims.claim_actuator(A, 4, 10, 100, 0)
    assert held.went_safe() == [4]
    assert held.claims.safe == {4, 6}
    held.claims.fed([4], 5)
    assert held.claims.safe == {6}
    held.claims.claim_actuator(A, 4, 10, 100, 0)
    assert (held.went_safe(), held.claims.safe) == ([4], {4, 6})
    assert held.claims.next_deadline() == 100 * MS


def test_who_holds_what(held: Held) -> None:
    claims = held.claims
    assert (claims.sessions(), claims.channels_of(A), claims.holders(1), claims.next_deadline()) == (
        set(), frozenset(), set(), None
    )  # fmt: skip
    claims.claim_sensors(A, [1, 2], 10)
    claims.claim_sensors(B, [2, 5], 10)
    claims.claim_actuator(A, 4, 10, 100, 0)
    assert claims.channels_of(A) == {1, 2, 4}
    assert claims.channels_of(B) == {2, 5}
    assert claims.channels_of(C) == set()
    assert [claims.holders(channel) for channel in range(1, 7)] == [{A}, {A, B}, set(), {A}, {B}, set()]
    assert [claims.holds(A, channel) for channel in range(1, 7)] == [True, True, False, True, False, False]
    assert [claims.holds(B, channel) for channel in range(1, 7)] == [False, True, False, False, True, False]
    assert claims.sessions() == {A, B}


def test_a_release_of_some_channels_ends_these_of_this_session_alone(held: Held) -> None:
    claims = held.claims
    claims.claim_sensors(A, [1, 2], 10)
    claims.claim_sensors(B, [2], 20)
    held.acting(A, 4)
    claims.release(A, [2, 3, 6])
    assert held.ended == [(A, {2})]
    assert held.went_safe() == []
    assert (set(claims.channels_of(A)), set(claims.channels_of(B))) == ({1, 4}, {2})
    claims.release(B, [1, 4])
    claims.release(C)
    assert held.ended == [(A, {2})], "what nobody held ends for nobody"
    claims.release(A)
    assert held.ended == [(A, {2}), (A, {1, 4})]
    assert held.went_safe() == [4]
    assert (claims.safe, claims.stopped) == ({4, 6}, set())
    assert claims.next_deadline() == 20 * SECOND, "its lease is gone with its last claim"


def test_an_actuator_is_safe_before_anybody_hears_that_its_claim_ended(held: Held) -> None:
    at_the_end = list[set[int]]()
    claims = Claims(held.hardware, lambda session, channels: at_the_end.append(set(claims.safe)))
    claims.claim_actuator(A, 4, 10, 100, 0)
    claims.fed([4], 0)
    claims.release(A)
    assert at_the_end == [{4, 6}]


def test_a_dead_man_runs_out_at_its_time_and_stops_its_actuator_alone(held: Held) -> None:
    claims = held.claims
    claims.claim_sensors(A, [1], 10)
    held.acting(A, 4, dead_man=100)
    held.acting(A, 6, dead_man=250, now=10 * MS)
    assert claims.next_deadline() == 100 * MS
    claims.fed([4], 60 * MS)
    assert claims.next_deadline() == 160 * MS
    claims.expire(160 * MS - 1)
    assert held.ended == []
    claims.expire(160 * MS)
    assert held.ended == [(A, {4})]
    assert (held.went_safe(), claims.stopped, set(claims.channels_of(A))) == ([4], {4}, {1, 6})
    assert claims.next_deadline() == 260 * MS
    claims.claim_actuator(A, 4, 10, 100, 200 * MS)
    assert claims.stopped == set(), "until the next Operate"
    claims.expire(260 * MS)
    assert claims.stopped == {6}


def test_a_lease_counts_from_the_last_good_frame_and_is_that_of_the_last_operate(held: Held) -> None:
    claims = held.claims
    A.good_at, B.good_at = 100.0, 101.0
    claims.claim_sensors(A, [1], 10)
    claims.claim_sensors(B, [1, 2], 5)
    assert claims.next_deadline() == 106 * SECOND
    claims.claim_sensors(A, [2], 3)
    assert claims.next_deadline() == 103 * SECOND
    A.good_at = 102.5
    claims.expire(105_500_000_000 - 1)
    assert held.ended == []
    claims.expire(105_500_000_000)
    assert held.ended == [(A, {1, 2})]
    claims.claim_actuator(B, 4, 2, 60_000, 105 * SECOND)
    held.went_safe()
    assert claims.next_deadline() == 103 * SECOND
    claims.expire(105_600_000_000)
    assert held.ended == [(A, {1, 2}), (B, {1, 2, 4})]
    assert (held.went_safe(), claims.stopped) == ([4], set()), "no dead-man stopped it"
    assert claims.next_deadline() is None


def test_everything_safe_ends_all_claims_and_calls_no_actuator_that_is_safe(held: Held) -> None:
    claims = held.claims
    claims.claim_sensors(A, [1], 10)
    held.acting(B, 4)
    claims.safe.discard(6)  # it was moved without a claim
    claims.everything_safe()
    assert held.went_safe() == [4, 6]
    assert {(one, *channels) for one, channels in held.ended} == {(A, 1), (B, 4)}
    assert claims.sessions() == set()
    claims.everything_safe()
    assert held.went_safe() == []


def test_a_tap_ends_the_claims_of_others_on_sensors_alone(held: Held) -> None:
    claims = held.claims
    claims.claim_sensors(A, [1, 2], 10)
    claims.claim_sensors(B, [2, 5], 10)
    held.acting(B, 4)
    claims.yield_sensors(A)
    assert held.ended == [(B, {2, 5})]
    assert (set(claims.channels_of(A)), set(claims.channels_of(B))) == ({1, 2}, {4})
    claims.yield_sensors(C)
    assert (set(claims.channels_of(A)), set(claims.channels_of(B))) == (set(), {4})
    assert held.went_safe() == []


def test_release_all_ends_every_claim(held: Held) -> None:
    held.claims.claim_sensors(A, [1], 10)
    held.acting(B, 4)
    held.claims.release_all()
    assert {(one, *channels) for one, channels in held.ended} == {(A, 1), (B, 4)}
    assert held.went_safe() == [4]


# -- Drive, on the station's side --------------------------------------------------------------------------------------


def driver(*, dead_man: int = 50) -> Driver:
    return Driver(Layout((4, 6), (2, 1)), DriveReply(3, 19), bytes(32), dead_man=dead_man)


@pytest.mark.parametrize(
    ("now", "hold", "until"),
    [
        (1_000_000_000, None, 1_050_000),
        (1_000_000_999, None, 1_050_000),  # whole microseconds, down
        (1_000_000_000, 20 * MS, 1_020_000),
        (1_000_000_000, 51 * MS, 1_050_000),
        ((1 << 32) * 1000 - 50 * MS - 1, None, 0xFFFFFFFF),
        ((1 << 32) * 1000 - 50 * MS, None, 0),  # it runs over every 71 minutes
        ((1 << 32) * 1000, None, 50_000),
    ],
)
def test_a_drive_message_holds_from_the_earliest_tick_that_it_may_be_now(
    now: int, hold: int | None, until: int
) -> None:
    message = driver().seal((b"ab", b"c"), TickBounds(now, now + 9 * SECOND), hold=hold)
    plain = DatagramSealer(drive_key(bytes(32), 3)).open(message)
    assert plain is not None
    assert DriveValues.decode(plain) == DriveValues(until, b"abc")


def test_a_drive_has_the_counters_0_to_ffffffff_and_each_once() -> None:
    one, now = driver(), TickBounds(0, 0)
    assert [one.seal((b"ab", b"c"), now)[:4].hex() for _ in range(2)] == ["00000000", "00000001"]
    for wrong in ((b"ab",), (b"c", b"ab"), (b"ab", b"c", b""), (b"abc",)):
        with pytest.raises(GarbledError):
            one.seal(wrong, now)
    one.next = 0xFFFFFFFF
    assert one.seal((b"ab", b"c"), now)[:4].hex() == "ffffffff"
    with pytest.raises(GarbledError, match="used up"):
        one.seal((b"ab", b"c"), now)


# -- what a stored Channel TEDS says beside the firmware ---------------------------------------------------------------

SENSOR = ChannelHardware(ChannelKind.SENSOR, 2, model=3)
ACTUATOR = ChannelHardware(ChannelKind.ACTUATOR, 4, halt=1)


@pytest.mark.parametrize(
    ("own", "changes", "fits"),
    [
        (SENSOR, {}, True),
        (SENSOR, {"octets": 4}, False),
        (SENSOR, {"model": 0}, False),
        (SENSOR, {"kind": 1}, False),
        (SENSOR, {"halt": 2}, True),  # ActHalt is of actuators
        (ACTUATOR, {}, True),
        (ACTUATOR, {"halt": 2}, False),
        (ACTUATOR, {"halt": None}, True),
        (ACTUATOR, {"kind": 0}, False),
        (ACTUATOR, {"octets": 2}, False),
    ],
)
def test_a_channel_teds_fits_by_type_model_length_and_an_actuators_halt(
    own: ChannelHardware, changes: dict[str, int | None], fits: bool
) -> None:
    assert teds_fits(own, channel_teds(own, **changes)) is fits
    assert not teds_fits(own, None)
    without_a_sample = frame(bytes.fromhex("030400030101") + bytes([11, 1, int(own.kind)]))
    assert not teds_fits(own, without_a_sample)


@pytest.mark.parametrize(
    ("period", "ns"),
    [
        (None, 0),
        (0.0, 0),
        (-1.0, 0),
        (float("nan"), 0),
        (1.0, 999_999_000),
        (0.5, 499_999_500),
        (float("inf"), 999_999_000_000_000),
        (2e6, 999_999_000_000_000),
    ],
)
def test_the_shortest_period_of_a_channel_teds_in_ns_less_one_ppm(period: float | None, ns: int) -> None:
    assert teds_period(channel_teds(SENSOR, period=period)) == ns
    assert teds_period(None) == 0
