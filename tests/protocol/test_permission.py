"""Which command when, function by function (profile.md, "Which command when"; operation.md sections 1 and 5)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, cast

import pytest

from teds_provision.protocol.messages.frames import Command, CommandRefusedError
from teds_provision.protocol.operation.hardware import port_of
from teds_provision.protocol.session import NodeSession
from teds_provision.protocol.tim.permission import Origin, Permission

SESSION = cast(NodeSession, object())
OPERATION = {(1, 5), (3, 1), (3, 2), (4, 1), (4, 2), *((128, number) for number in range(12, 21))}


@dataclass
class Role:
    """A node that measures: what it has, and what it was asked about a change of its configuration."""

    actuators: bool = False
    running: bool = False
    asked: list[tuple[object, bool]] = field(default_factory=list)

    @property
    def claims(self) -> Role:
        return self

    @property
    def streams(self) -> Role:
        return self

    def knows(self, command: Command) -> bool:
        return (command.command_class, command.function) in OPERATION

    def demand_configuration(self, session: object, *, writes_over_nfc: bool) -> None:
        self.asked.append((session, writes_over_nfc))


@dataclass
class Manage:
    on_trial: bool = False
    uploading: bool = False


@dataclass
class Node:
    """A node in one state, and what it answers: 0 for yes, else the reason."""

    factory: bool = False
    open_on: tuple[str, ...] = ()
    role: Role | None = field(default_factory=Role)
    manage: Manage | None = None
    quick: bool = False
    has_can: bool = True
    has_firmware: bool = True
    now: float = 100.0

    def __post_init__(self) -> None:
        self.permission = Permission(
            lambda: self.factory, lambda link: link in self.open_on, lambda: self.now, cast(Any, self.role),
            self.quick, self.has_can, self.has_firmware, cast(Any, self.manage),
        )  # fmt: skip

    def asks(self, command_class: int, function: int, *, link: str = "can:f1", tapped: bool = False,
             session: bool = False, channel: int = 0, payload: bytes = b"") -> int:  # fmt: skip
        origin = Origin(link, tapped, port_of(link), 0, SESSION if session else None)
        try:
            self.permission.check(Command(channel, command_class, function, payload), origin)
        except CommandRefusedError as refusal:
            return int(refusal.reason)
        return 0


PLAIN: dict[int, tuple[int, int, int, int, int]] = {
    # factory by its bus, factory tapped, keyed by its bus, keyed tapped, keyed by BLE
    1: (3, 0, 3, 0, 3), 2: (3, 0, 3, 0, 3), 3: (2, 2, 0, 0, 0), 4: (2, 2, 2, 2, 2), 5: (3, 3, 3, 3, 3),
    6: (1, 1, 1, 1, 1), 7: (0, 0, 0, 0, 0), 8: (0, 0, 0, 0, 0), 9: (0, 0, 3, 3, 3), 10: (3, 0, 3, 0, 3),
    11: (0, 0, 0, 0, 0), **dict.fromkeys(range(12, 21), (3, 3, 3, 3, 3)), 21: (0, 0, 0, 3, 3),
    22: (0, 0, 3, 3, 3), 23: (3, 3, 3, 3, 3), 24: (1, 1, 1, 1, 1), 0: (1, 1, 1, 1, 1), 255: (1, 1, 1, 1, 1),
}  # fmt: skip


@pytest.mark.parametrize("function", PLAIN)
def test_plain_commands_of_class_128(function: int) -> None:
    found = (
        Node(factory=True).asks(128, function), Node(factory=True).asks(128, function, link="nfc", tapped=True),
        Node().asks(128, function), Node().asks(128, function, link="nfc", tapped=True),
        Node().asks(128, function, link="ble:2"),
    )  # fmt: skip
    assert found == PLAIN[function]
    assert {Node(factory=True).asks(128, function, channel=1), Node().asks(128, function, channel=7)} == {1}


def test_a_sealed_frame_needs_a_session_or_a_half_open_open_on_its_own_link() -> None:
    node = Node(open_on=("can:f1",))
    assert [node.asks(128, 4, link=link) for link in ("can:f1", "can:f2", "nfc")] == [0, 2, 2]


def test_commands_in_a_session() -> None:
    node = Node()
    found = {function: node.asks(128, function, session=True, link="ble:2") for function in range(25)}
    refused = {function: why for function, why in found.items() if why}
    assert refused == {0: 1, 3: 3, 4: 3, 6: 1, 24: 1}
    assert node.asks(128, 7, session=True, channel=1) == 1
    assert {function: node.asks(1, function, session=True) for function in range(8)} == {
        0: 1, 1: 0, 2: 0, 3: 0, 4: 0, 5: 0, 6: 1, 7: 1
    }  # fmt: skip
    assert [node.asks(3, 1, session=True), node.asks(3, 3, session=True), node.asks(7, 1, session=True)] == [0, 1, 1]


def test_a_node_that_does_not_measure_knows_no_command_of_operation() -> None:
    node = Node(role=None)
    known = sorted(OPERATION)
    assert {node.asks(*number, session=True) for number in known} == {1}
    assert {Node().asks(*number, session=True) for number in known} == {0}
    assert {(node.asks(*number), Node().asks(*number)) for number in known} == {(3, 3)}
    assert [node.asks(1, 3, session=True), node.asks(128, 10, session=True), node.asks(128, 8)] == [0, 0, 0]


def test_other_classes_outside_a_session() -> None:
    for node in (Node(), Node(factory=True)):
        found = {function: node.asks(1, function, link="nfc", tapped=True) for function in range(7)}
        assert found == {0: 3, 1: 0, 2: 0, 3: 3, 4: 3, 5: 3, 6: 3}
        assert [node.asks(number, 1) for number in (2, 3, 4, 7, 127, 129)] == [3] * 6


@pytest.mark.parametrize("session", [False, True])
def test_what_a_board_lacks_is_unknown_in_every_state(session: bool) -> None:
    for factory in (True, False):
        without = Node(factory=factory, has_can=False, has_firmware=False)
        assert [without.asks(128, number, session=session) for number in (10, 21, 22, 23)] == [1, 1, 1, 1]
        assert without.asks(128, 7, session=session) == 0


def refused_by(node: Node, commands: Iterable[tuple[int, int]], **how: Any) -> set[tuple[int, int]]:
    return {number for number in commands if node.asks(*number, **how) == 17}


IN_SESSION = [*((128, number) for number in (1, 2, 5, 7, 8, 9, 10, 11, 12, 21, 22, 23)), *((1, n) for n in range(1, 5)),
              (4, 1), (4, 2)]  # fmt: skip


def test_an_image_on_trial_is_given_nothing_and_an_upload_delays_what_needs_the_flash_or_time() -> None:
    trial, upload = Node(manage=Manage(on_trial=True)), Node(manage=Manage(uploading=True))
    assert refused_by(trial, IN_SESSION, session=True) == {(1, 3), (1, 4), (128, 10), (128, 1), (128, 2), (128, 9)}
    assert refused_by(upload, IN_SESSION, session=True) == {(1, 3), (4, 1)}
    assert refused_by(Node(manage=Manage()), IN_SESSION, session=True) == set()
    tapped = {"link": "nfc", "tapped": True}
    plain = [(128, 1), (128, 2), (128, 8), (128, 10), (128, 3)]
    assert refused_by(trial, plain, **tapped) == {(128, 1), (128, 2), (128, 10)}
    assert Node(factory=True, manage=Manage(on_trial=True)).asks(128, 9) == 17


def test_a_change_of_what_is_stored_asks_whether_a_channel_is_claimed() -> None:
    role = Role()
    node = Node(role=role)
    for number in IN_SESSION:
        node.asks(*number, session=True)
    assert role.asked == [(SESSION, False)] * 3, "Write, Update, Set CAN address"
    role.asked.clear()
    for function in (3, 4):
        node.asks(1, function, session=True, link="nfc")
    node.asks(128, 10, link="nfc", tapped=True)
    assert role.asked == [(SESSION, True), (SESSION, False), (None, False)], "a Write over NFC alone"


@pytest.mark.parametrize(("actuators", "quick", "why"), [(True, False, 17), (True, True, 0), (False, False, 0)])
def test_no_stranger_s_point_arithmetic_stops_an_actuator(actuators: bool, quick: bool, why: int) -> None:
    node = Node(role=Role(actuators=actuators), quick=quick)
    assert node.asks(128, 8, payload=bytes(32)) == why
    assert [node.asks(128, 3, payload=bytes(length)) for length in (88, 89, 90)] == [0, why, 0], "the long form"
    assert [node.asks(128, 3), node.asks(128, 7, payload=bytes(89)), node.asks(128, 8, session=True)] == [0, 0, 0]


def test_strangers_read_list_and_ask_about_once_a_second_together_while_a_stream_runs() -> None:
    role = Role()
    node = Node(role=role)
    held_back = [(1, 2), (128, 11), (128, 21)]
    assert refused_by(node, held_back * 2) == set()
    role.running = True
    assert node.asks(1, 2) == 0
    node.now = 100.999
    assert refused_by(node, held_back) == set(held_back)
    assert refused_by(node, held_back, link="can:f2") == set(held_back), "over all links"
    assert {node.asks(*number, session=True) for number in held_back} == {0}
    assert [node.asks(1, 1), node.asks(128, 7), node.asks(128, 8)] == [0, 0, 0]
    node.now = 101.0
    assert [node.asks(128, 11), node.asks(128, 21), node.asks(1, 2)] == [0, 17, 17]
    node.now = 102.0
    assert node.asks(128, 21) == 0
    role.running = False
    assert refused_by(node, held_back) == set()
    assert refused_by(Node(role=None), held_back * 2) == set()
