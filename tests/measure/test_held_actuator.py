"""One actuator held by ``set``: what its dead-man allows, and what is reported of its end. The node is a mock."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, LinkError, NodeRefusedError, PolicyError
from teds_provision.measure import held_actuator
from teds_provision.measure.held_actuator import HeldActuator
from teds_provision.measure.verified_session import VerifiedSession, claim
from teds_provision.protocol.messages.frames import Command, Function
from teds_provision.protocol.operation.commands import ChannelState, OperationReply
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.teds.calibration import ChannelInterpreter
from tests.measure.test_topic_actuators import SHEET
from tests.teds.test_interpreter import sheet_of

DEAD_MAN = 400
Answer = Callable[[], None]


class Clock:
    """The clock that the module reads; an answer of the node may take some of it."""

    def __init__(self) -> None:
        self.now = 100.0

    def monotonic(self) -> float:
        return self.now


class Node:
    """A session with a node: ``writes`` happens when a value is written, ``idles`` when it is released."""

    def __init__(self, state: ChannelState, writes: Answer, idles: Answer) -> None:
        self.state, self.writes, self.idles = state, writes, idles
        self.allowed: list[float | None] = []

    def request(self, command: Command, doing: str, *, within: float | None = None) -> bytes:
        match command.function, doing:
            case _, "to set the actuator":
                self.allowed.append(within)
                self.writes()
            case _, "to let go of the actuator":
                self.idles()
            case Function.OPERATION, _:
                return OperationReply(True, {1: (self.state, 0)}).encode()
        return b""


def lost() -> None:
    raise SessionLostError(LinkError("The node does not answer."))


def refused() -> None:
    raise NodeRefusedError("The node refused.", reason=1)


def quiet() -> None:
    """Answer at once."""


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    made = Clock()
    monkeypatch.setattr(held_actuator, "time", made)
    return made


def held(
    state: ChannelState = ChannelState.SAFE, *, writes: Answer = quiet, idles: Answer = quiet
) -> tuple[HeldActuator, Node]:
    node: Any = Node(state, writes, idles)
    return HeldActuator(VerifiedSession(node, SHEET, "00" * 32, "g"), 1, dead_man=DEAD_MAN), node


def test_a_value_is_abandoned_at_the_end_of_the_dead_man(clock: Clock) -> None:
    actuator, node = held()
    with actuator:
        assert actuator.apply(0.05).value == pytest.approx(0.05, abs=1e-4)
        applied = actuator.apply(0.05)
        assert applied.value == pytest.approx(0.11 * 1861 / 4095, abs=1e-7), "what a sample of 12 bits can hold"
        assert (applied.channel, applied.unit, applied.raw) == (1, "m", 1861)
    assert node.allowed == [DEAD_MAN / 1000] * 2
    assert actuator.require_confirmation() is True


@pytest.mark.parametrize(("seconds", "in_time"), [(0.4, True), (0.41, False)])
def test_a_value_that_took_longer_than_the_dead_man_moved_nothing_that_is_left(
    clock: Clock, seconds: float, in_time: bool
) -> None:
    def slowly() -> None:
        clock.now += seconds

    clock.now = 0.0
    actuator, _ = held(writes=slowly)
    with actuator:
        if in_time:
            actuator.apply(0.05)
            return
        with pytest.raises(LinkError, match="longer than the dead-man") as late:
            actuator.apply(0.05)
        assert "in its safe state" in late.value.hint


def test_a_session_that_is_lost_while_it_moves_says_who_makes_it_safe(clock: Clock) -> None:
    actuator, _ = held(writes=lost)
    with actuator, pytest.raises(LinkError, match="lost while the actuator was in use: The node does not") as gone:
        actuator.apply(0.05)
    assert "safe state by itself" in gone.value.hint


@pytest.mark.parametrize("idles", [lost, refused])
def test_a_node_that_does_not_confirm_its_safe_state_is_left_to_its_dead_man(clock: Clock, idles: Answer) -> None:
    actuator, _ = held(idles=idles)
    with actuator:
        actuator.apply(0.05)
    with pytest.raises(LinkError, match="did not confirm") as unconfirmed:
        actuator.require_confirmation()
    assert "dead-man timer" in unconfirmed.value.hint


def test_an_actuator_that_is_not_safe_at_the_end_is_reported_so(clock: Clock) -> None:
    actuator, _ = held(ChannelState.ACTUATOR)
    with actuator:
        actuator.apply(0.05)
    assert actuator.require_confirmation() is False


def test_a_value_is_sent_again_after_a_quarter_of_the_dead_man_and_half_a_second_at_most(clock: Clock) -> None:
    assert held()[0].pause == pytest.approx(DEAD_MAN / 4000)
    slow: Any = Node(ChannelState.SAFE, quiet, quiet)
    assert HeldActuator(VerifiedSession(slow, SHEET, "00" * 32, "g"), 1, dead_man=10_000).pause == pytest.approx(0.5)


def test_a_quantity_means_its_set_point_unless_an_actuator_has_that_name() -> None:
    def named(*names: str) -> VerifiedSession:
        channels = [SimpleNamespace(name=name, actuator=name != "force") for name in names]
        return cast("VerifiedSession", SimpleNamespace(sheet=SimpleNamespace(channels=channels)))

    def meant(trusted: VerifiedSession, chosen: int | str) -> str | None:
        found = held_actuator._set_point_of(trusted, chosen)
        return None if found is None else found.name

    gripper = named("opening set point", "force", "valve", "valve set point")
    assert meant(gripper, "Opening") == "opening set point"
    assert meant(gripper, "valve") is None  # it is an actuator itself
    assert meant(gripper, "force") is None
    assert meant(gripper, 1) is None


def test_the_claim_of_an_actuator_shortens_no_lease_of_its_session() -> None:
    """A node has one lease for a session, the last Operate's: 40 s of many nodes on one bus would become 10."""
    asked: list[tuple[int, bytes]] = []

    class Claimed(Node):
        def request(self, command: Command, doing: str, *, within: float | None = None) -> bytes:
            if (command.command_class, command.function) == (4, 1):
                asked.append((command.channel, command.payload[16:]))
            return super().request(command, doing, within=within)

    node: Any = Claimed(ChannelState.SAFE, quiet, quiet)
    session = VerifiedSession(node, SHEET, "00" * 32, "g")
    with HeldActuator(session, 1, dead_man=400):
        assert asked == [(1, bytes([10]) + (400).to_bytes(2, "big"))], "10 s where nothing longer was claimed"
    asked.clear()
    claim(session, 0, lease=40)
    with HeldActuator(session, 1, dead_man=400):
        pass
    assert [(channel, payload[0]) for channel, payload in asked] == [(0, 40), (1, 40)]


def chosen(channel: int | str, unit: str | None = None) -> HeldActuator:
    node: Any = None
    return HeldActuator(VerifiedSession(node, SHEET, "00" * 32, "g"), channel, unit=unit)


@pytest.mark.parametrize(
    ("value", "unit", "why"),
    [
        (0.11, None, ""),
        (0.0, None, ""),
        (110, "mm", ""),
        (11, "cm", ""),
        (0.1101, None, "0.1101 m exceeds the limits of channel 1 (opening set point), 0 to 0.11 m."),
        (-0.001, None, "-0.001 m exceeds the limits of channel 1 (opening set point), 0 to 0.11 m."),
        (110.1, "mm", "110.1 mm exceeds the limits of channel 1 (opening set point), 0 to 110 mm."),
        (float("nan"), "mm", "nan mm exceeds the limits of channel 1 (opening set point), 0 to 110 mm."),
        (float("inf"), None, "inf m exceeds the limits of channel 1 (opening set point), 0 to 0.11 m."),
    ],
)
def test_a_value_beyond_the_limits_is_refused_in_its_unit_and_never_adjusted(
    value: float, unit: str | None, why: str
) -> None:
    actuator = chosen(1, unit)
    if not why:
        assert actuator.octets_of(value) == (4095 if value else 0).to_bytes(2, "big")
        return
    with pytest.raises(PolicyError) as refusal:
        actuator.octets_of(value)
    assert (refusal.value.message, refusal.value.exit_code) == (why, 6)


def test_an_actuator_is_chosen_by_its_number_its_name_or_what_it_sets() -> None:
    for channel in (1, "opening set point", "opening", "OPENING"):
        assert chosen(channel).channel.number == 1
    for channel in (2, 3):
        with pytest.raises(BadDataError) as refusal:
            chosen(channel)
        label = SHEET.channels[channel - 1].label
        assert refusal.value.message == f"Channel {label} of node {bytes(10).hex()} is a sensor, not an actuator."
        assert refusal.value.hint == "Its actuators: 1 (opening set point)."
    with pytest.raises(BadDataError):
        chosen("closing")


def test_a_unit_of_another_kind_is_refused_with_those_that_can_be_used() -> None:
    with pytest.raises(BadDataError) as refusal:
        chosen(1, "N")
    assert refusal.value.message == ("N is not a unit for channel 1 (opening set point), whose values are in m.")
    assert refusal.value.hint.startswith("Use ")
    assert " or m." in refusal.value.hint or refusal.value.hint == "Use m."
    assert chosen(1).unit.text == "m"
    assert chosen(1, "um").unit.to_si(5) == pytest.approx(5e-6)


def test_an_actuator_whose_set_points_have_no_way_to_its_raw_values_is_refused() -> None:
    node: Any = SimpleNamespace()
    with pytest.raises(BadDataError) as refusal:
        HeldActuator(VerifiedSession(node, sheet_of("gripper"), "00" * 32, "g"), 1)
    assert refusal.value.message == ChannelInterpreter(sheet_of("gripper"), 1).problem != ""
