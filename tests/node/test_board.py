"""The hardware of a virtual node: every shipped profile can be imitated, limits are its own, a battery is charged."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError
from teds_provision.node.hardware.board import ActuatorReading, Battery, Board
from teds_provision.node.hardware.clock import NodeClock
from teds_provision.node.node_template import create
from teds_provision.node.sources.base import Reading
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.operation.commands import PowerFlag, PowerReply
from teds_provision.protocol.operation.hardware import RawReading
from teds_provision.protocol.tim import Tim
from teds_provision.teds.calibration.samples import SampleForm
from teds_provision.teds.image import Image
from teds_provision.teds.profile import list_profiles, load_profile
from teds_provision.teds.sheet import Sheet

UUID = bytes(10)
PROFILES = [listed.name for listed in list_profiles() if not load_profile(listed.name).abstract]


def sheet(profile: str) -> Sheet:
    return Sheet.from_image(Image(UUID, load_profile(profile).build(UUID).blocks))


@pytest.mark.parametrize("profile", PROFILES)
def test_every_shipped_profile_gives_samples(profile: str) -> None:
    board = Board(sheet(profile), source="sine:1")
    sensors = [number for number, facts in board.channels.items() if not facts.actuator]
    assert sensors or board.channels
    for number in sensors:
        seen = {board.read(number, tick * 25_000_000) for tick in range(40)}
        assert all(reading.valid and len(reading.octets) == board.channels[number].octets for reading in seen)
        assert len(seen) > 1


def test_an_actuator_begins_and_ends_at_its_low_limit_and_bears_its_range() -> None:
    shown: list[ActuatorReading] = []
    board = Board(sheet("gripper"), shown=shown.append)
    assert board.set_point(1) == b"\0\0"
    assert [board.accepts(1, octets) for octets in (b"\0\0", b"\x0f\xff", b"\x10\x00")] == [True, True, False]
    board.apply({1: b"\x08\x00"})
    assert board.set_point(1) == b"\x08\x00"
    board.stop()
    assert board.set_point(1) == b"\0\0"
    assert [(state.raw, state.safe) for state in shown] == [(2048.0, False), (0.0, True)]
    assert shown[0].value == pytest.approx(0.055, rel=1e-3)


def test_a_fault_and_a_source_without_a_value_are_not_valid() -> None:
    board = Board(sheet("gripper"), source="-")
    assert not board.read(2, 0).valid
    board = Board(sheet("gripper"))
    board.faults.add(2)
    assert board.fault(2)
    assert not board.read(2, 0).valid
    assert board.read(3, 0).valid


def test_a_self_test_takes_its_time_and_ends() -> None:
    class Host:
        now = 0

        def __call__(self) -> int:
            return self.now

    host = Host()
    board = Board(sheet("gripper"), clock=NodeClock(host))
    board.self_test([2])
    assert board.testing(2)
    assert not board.testing(3)
    host.now += 11 * 10**9
    assert not board.testing(2)


def test_a_battery_is_charged_in_the_field_and_emptied_outside() -> None:
    now = [0.0]
    battery = Battery(50, charge=2, drain=1, host=lambda: now[0])
    now[0] = 60 * 46
    assert battery.power().level == 4
    assert battery.power().flags == PowerFlag.BATTERY | PowerFlag.TOO_LOW
    battery.field(present=True)
    now[0] += 60 * 10
    assert battery.power().level == 24
    assert battery.power().flags == PowerFlag.BATTERY | PowerFlag.CHARGING | PowerFlag.IN_FIELD
    now[0] += 60 * 60
    assert battery.power().flags == PowerFlag.BATTERY | PowerFlag.FULL | PowerFlag.IN_FIELD
    battery.field(present=False)
    now[0] += 60 * 200
    assert battery.power().level == 0


def test_what_could_not_be_sent_is_reported_to_the_last_when_all_streams_have_ended(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every ten seconds while one runs; nothing was left to do then, and what was missed last was never reported."""
    made, messages = (
        create(tmp_path / "node", uuid=bytes(range(10)), profile="magnetic-angular-position-sensor"),
        list[str](),
    )
    sheet = Sheet.from_image(Image(made.load().uuid, dict(made.load().blocks)))
    made.release()
    node = VirtualNode(tmp_path / "node", board=lambda _file: Board(sheet, notify=messages.append))
    counts = iter((1, 3, 4))
    running = iter((True, True, False))
    monkeypatch.setattr(Tim, "missed", property(lambda _tim: next(counts)))
    monkeypatch.setattr(Tim, "streaming", property(lambda _tim: next(running)))
    for wait in (0.1, 0.1, None):
        monkeypatch.setattr(Tim, "poll", lambda _tim, wait=wait: wait)
        node.beat()
    assert [line.split()[0] + line[-4:] for line in messages] == ["1(1).", "3(4)."]


BATTERY, CHARGING, FULL, IN_FIELD, TOO_LOW = (
    PowerFlag.BATTERY, PowerFlag.CHARGING, PowerFlag.FULL, PowerFlag.IN_FIELD, PowerFlag.TOO_LOW
)  # fmt: skip


@pytest.mark.parametrize(
    ("level", "in_field", "flags", "shown", "volts", "amperes"),
    [
        (-3.0, False, BATTERY | TOO_LOW, 0, 3.3, -0.002),
        (4.99, False, BATTERY | TOO_LOW, 5, 3.34491, -0.002),
        (5.0, False, BATTERY, 5, 3.345, -0.002),
        (50.0, True, BATTERY | CHARGING | IN_FIELD, 50, 3.75, 0.05),
        (99.4, True, BATTERY | CHARGING | IN_FIELD, 99, 4.1946, 0.05),
        (99.5, True, BATTERY | FULL | IN_FIELD, 100, 4.1955, -0.002),
        (130.0, False, BATTERY | FULL, 100, 4.2, -0.002),
    ],
)
def test_the_reply_to_power(
    level: float, in_field: bool, flags: PowerFlag, shown: int, volts: float, amperes: float
) -> None:
    battery = Battery(level, host=lambda: 0.0)
    battery.field(present=in_field)
    reply = battery.power()
    assert (reply.flags, reply.level, reply.voltage) == (flags, shown, pytest.approx(volts))
    assert (reply.current, reply.temperature) == (amperes, 24)
    assert Board(sheet("gripper")).power() == PowerReply(), "nothing is known without a battery"


def test_a_battery_gains_2_per_cent_a_minute_and_loses_a_tenth() -> None:
    now = [100.0]
    battery = Battery(50.0, host=lambda: now[0])
    now[0] += 600
    battery.field(present=True)  # what passed before counts as outside
    assert battery.power().level == 49
    now[0] += 300
    battery.field(present=False)
    assert battery.power().level == 59
    now[0] += 600
    assert battery.power().level == 58


def test_a_simulation_takes_the_clock_over_and_gives_it_back() -> None:
    host = [5_000]
    clock = NodeClock(lambda: host[0])
    host[0] += 40
    assert (clock.tick(), clock.now(), clock.step, clock.runs_by_itself) == (40, 40e-9, 1000, True)
    seen: list[tuple[str, int]] = []
    guarded: list[str] = []

    @contextmanager
    def guard() -> Iterator[None]:
        guarded.append("in")
        yield
        guarded.append("out")

    clock.due, clock.guard = lambda: seen.append(("due", clock.tick())), guard
    clock.own_clock()
    host[0] += 1_000_000
    assert (clock.tick(), clock.runs_by_itself) == (40, False)
    clock.advance(0.5, lambda: seen.append(("change", clock.tick())))
    assert seen == [("due", 499_999_999), ("change", 499_999_999), ("due", 500_000_000)], "samples before it are older"
    assert guarded == ["in", "out"] * 2
    assert (clock.tick(), clock.step) == (500_000_000, 499_999_960)
    clock.own_clock()
    seen.clear()
    clock.advance(0.25, lambda: None)
    assert (clock.tick(), clock.step) == (500_000_000, 499_999_960), "it never goes back"
    clock.advance(0.5, lambda: None)
    assert clock.step == 499_999_960
    assert seen == [("due", 500_000_000)] * 4
    clock.advance(10.0, lambda: None)
    assert (clock.tick(), clock.step) == (10_000_000_000, 0xFFFFFFFF)
    clock.host_clock()
    host[0] += 7
    clock.host_clock()
    assert (clock.tick(), clock.step, clock.runs_by_itself) == (10_000_000_007, 1000, True)


def test_facts_of_the_clock_and_of_channels() -> None:
    clock = NodeClock(lambda: 0)
    board = Board(sheet("gripper"), clock=clock)
    assert (board.step, board.drift, board.lag) == (1000, 50, 0)
    assert [board.keeps(period) for period in (-1, 0, 1, 3)] == [False, False, True, True]
    assert board.now() == 0
    board.sampling = 77
    assert board.now() == 77
    clock.own_clock()
    assert board.drift == 0xFFFF
    assert {number: facts.actuator for number, facts in board.channels.items()} == {1: True, 2: False, 3: False}
    assert [place.number for place in board.places] == [2, 3]


class Given:
    """A source with values by channel, which notes what it is asked and told."""

    def __init__(self, **values: float) -> None:
        self.values = {int(name[1:]): value for name, value in values.items()}
        self.asked: list[tuple[int, float]] = []
        self.log: list[object] = []

    def at(self, channel: int, seconds: float) -> Reading | None:
        self.asked.append((channel, seconds))
        value = self.values.get(channel)
        return None if value is None else Reading(raw=value)

    def start(self, drive: object) -> None:
        self.log.append(drive)

    def acted(self, values: Mapping[str, float]) -> None:
        self.log.append(dict(values))

    def stop(self) -> None:
        self.log.append("stopped")


def test_an_event_is_a_change_since_the_last_look() -> None:
    source = Given(c1=0.0)
    switch = sheet("limit-switch")
    board = Board(switch, source=source, clock=NodeClock(lambda: 0))
    assert board.has_events
    assert not Board(sheet("gripper")).has_events
    board.sampling = 2_500_000_000
    assert list(board.events()) == [], "the first state is no event"
    assert list(board.events()) == []
    source.values[1] = 1.0
    ((channel, tick, reading),) = board.events()
    assert (channel, tick, reading) == (1, 2_500_000_000, board.read(1, 0))
    board.faults.add(1)
    ((_, _, faulty),) = board.events()
    assert not faulty.valid
    assert list(board.events()) == []
    assert source.asked[0] == (1, 2.5)


def test_an_actuator_is_shown_and_told_to_the_source() -> None:
    source, shown = Given(), list[ActuatorReading]()
    board = Board(sheet("gripper"), source=source, shown=shown.append, clock=NodeClock(lambda: 0))
    board.start()
    board.apply({1: b"\x0f\xff"})
    board.make_safe(1)
    board.stop()
    name = shown[0].name
    assert source.log[0] is board.clock
    assert source.log[1:] == [
        {name: pytest.approx(shown[0].value)}, {name: pytest.approx(0.0)}, {name: pytest.approx(0.0)}, "stopped"
    ]  # fmt: skip
    assert [(state.channel, state.unit, state.raw, state.safe) for state in shown] == [
        (1, "m", 4095.0, False), (1, "m", 0.0, True), (1, "m", 0.0, True)
    ]  # fmt: skip
    assert board.set_point(1) == b"\0\0"


@pytest.mark.parametrize(
    ("stated", "seconds"),
    [(math.nan, 0.1), (math.inf, 0.1), (0.0, 0.1), (0.05, 0.1), (3.0, 3.0), (10.0, 10.0), (11.0, 10.0)],
)
def test_a_self_test_takes_a_tenth_of_a_second_to_ten(stated: float, seconds: float) -> None:
    now = [0]
    own = sheet("gripper")
    board = Board(replace(own, meta=replace(own.meta, self_test_time=stated)), clock=NodeClock(lambda: now[0]))
    board.self_test([2, 3])
    now[0] = round(seconds * 1e9) - 1
    assert (board.testing(2), board.testing(3), board.testing(1)) == (True, True, False)
    now[0] += 1
    assert not board.testing(2)


def altered(number: int, **changes: Any) -> Sheet:
    """Return the gripper with one channel changed."""
    made = sheet("gripper")
    channels = tuple(replace(each, **changes) if each.number == number else each for each in made.channels)
    return replace(made, channels=channels)


class Missing(Given):
    """A source that has a reading of each channel, and no value in it."""

    def at(self, channel: int, seconds: float) -> Reading | None:
        return Reading(missing=True)


def falling(raw: Mapping[float, Any], *, integer: bool = True) -> Any:
    """Return a converter from the limits 0 and 0.11 to these raw numbers."""

    def convert(value: float) -> float:
        found = raw[value]
        if isinstance(found, Exception):
            raise found
        return float(found)

    return SimpleNamespace(low=0.0, high=0.11, raw=convert, form=SimpleNamespace(integer=integer))


def test_an_actuator_without_a_name_is_shown_and_not_told_to_the_source() -> None:
    source, shown = Given(), list[ActuatorReading]()
    board = Board(altered(1, name=""), source=source, shown=shown.append)
    board.apply({1: b"\x01\x00"})
    assert (shown[0].name, shown[0].raw) == ("", 256.0)
    assert source.log == []


def test_a_value_that_cannot_be_converted_is_no_valid_sample() -> None:
    board = Board(altered(2, sample=SampleForm(0, 2, 16)), source=Missing())
    assert board.read(2, 0) == RawReading(b"\0\0", valid=False), "each of the 16 bits is a value"
    assert board.read(3, 0) == RawReading(b"\xff\xff"), "12 bits have room for one that is none"


@pytest.mark.parametrize(
    ("changes", "safe", "accepted", "refused"),
    [
        ({"low": -math.inf}, b"\0\0", [b"\x00\x00", b"\x0f\xff"], [b"\x10\x00"]),
        ({"high": math.inf}, b"\0\0", [b"\x00\x00", b"\x0f\xff"], [b"\x10\x00"]),
        ({"sample": SampleForm(1, 4)}, bytes(4), [b"\x3d\xe1\x47\xae"], [b"\x3d\xe1\x48\xff", b"\xb4\x00\x00\x00"]),
        ({"sample": SampleForm(1, 4), "low": -2.0, "high": -1.0}, b"\xc0\0\0\0", [b"\xbf\x80\0\0"], [bytes(4)]),
        ({"sample": SampleForm(1, 4), "low": -math.inf}, bytes(4), [b"\xff\x7f\xff\xff"], []),
        ({"sample": SampleForm(1, 4), "high": math.inf}, bytes(4), [b"\x7f\x7f\xff\xff"], []),
        ({"sample": SampleForm(4, 1, 3)}, b"\0", [b"\7"], []),
        ({"sample": SampleForm(0, 2, 12), "low": 0.05, "high": 0.11}, b"\0\0", [b"\0\0", b"\x0f\xff"], [b"\x10\0"]),
    ],
)  # fmt: skip
def test_an_actuator_without_limits_is_safe_at_0_and_accepts_every_raw_number(
    changes: dict[str, Any], safe: bytes, accepted: list[bytes], refused: list[bytes]
) -> None:
    board = Board(altered(1, **changes))
    assert board.set_point(1) == safe
    assert [board.accepts(1, octets) for octets in accepted + refused] == [True] * len(accepted) + [False] * len(
        refused
    )


def test_limits_of_a_falling_curve_are_the_same_raw_numbers_in_their_order() -> None:
    board = Board(sheet("gripper"))
    for raw, bounds in (
        ({0.0: 4095.0, 0.11: 0.0}, (-0.5, 4095.5)),
        ({0.0: 10.0, 0.11: math.inf}, (-math.inf, math.inf)),
        ({0.0: OverflowError(), 0.11: 5.0}, (-math.inf, math.inf)),
        ({0.0: 5.0, 0.11: BadDataError("no inverse")}, (-math.inf, math.inf)),
    ):
        board.converters[1] = falling(raw)
        assert board._raw_limits(1) == bounds
    board.converters[1] = falling({0.0: -3e6, 0.11: 1e6}, integer=False)
    assert board._raw_limits(1) == (-3e6 - 3, 1e6 + 3), "a millionth of the larger one"


def test_a_battery_begins_within_0_to_100_per_cent() -> None:
    now = [0.0]
    for level, in_field, minutes, left in ((-50.0, True, 5, 10), (150.0, False, 600, 40)):
        now[0] = 0.0
        battery = Battery(level, host=lambda: now[0])
        if in_field:
            battery.field(present=True)
        now[0] += 60 * minutes
        assert battery.power().level == left


def test_a_channel_without_a_form_of_sample_is_no_hardware() -> None:
    with pytest.raises(BadDataError, match="how a sample of channel 2 is coded"):
        Board(altered(2, sample=None))


@pytest.mark.parametrize(
    ("period", "shortest"),
    [(0.001, 999_999), (1.0, 999_999_000), (0.0, 1), (-1.0, 1), (math.nan, 1), (math.inf, 1), (1e-9, 1)],
)
def test_the_shortest_period_of_a_channel_is_its_own_less_a_millionth(period: float, shortest: int) -> None:
    made = sheet("gripper").channels[1]
    board = Board(altered(2, timing=replace(made.timing, period=period)))
    assert board.channels[2].shortest == shortest
