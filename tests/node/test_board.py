"""The hardware of a virtual node: every shipped profile can be imitated, limits are its own, a battery is charged."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.node.hardware.board import ActuatorReading, Battery, Board
from teds_provision.node.hardware.clock import NodeClock
from teds_provision.node.node_template import create
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.operation.commands import PowerFlag
from teds_provision.protocol.tim import Tim
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
