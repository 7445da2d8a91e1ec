"""Set points of topics that come fast: as Drive messages where the node takes them, else by command; without a bus."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, NodeRefusedError, NodeSilentError
from teds_provision.measure import topic_actuators
from teds_provision.measure.blocks import Block, SetPointCommand
from teds_provision.measure.topic_actuators import WATCHED, TopicActuators
from teds_provision.measure.verified_session import VerifiedSession
from teds_provision.protocol.messages.frames import Command, Function, Reason
from teds_provision.protocol.operation.stream_commands import CLOCK
from teds_provision.teds.calibration import fit
from tests.measure.test_lookout import clock
from tests.pace import until
from tests.teds.test_interpreter import sheet_of

SHEET = sheet_of("gripper", {1: fit([(0, 0.0), (4095, 0.11)], "linear", channel=1, actuator=True)})
LENGTH = 4 + 4 + 2 + 8
Answer = Callable[[], bytes]


class Node:
    """A session with a node that takes every command; ``driven`` answers Drive."""

    message_key = bytes(32)

    def __init__(self, driven: Answer) -> None:
        self.driven, self.asked, self.values, self.others = driven, 0, 0, 0

    def request(self, command: Command, _doing: str, *, within: float | None = None) -> bytes:
        if (command.command_class, command.function) == (128, Function.DRIVE):
            self.asked += 1
            return self.driven()
        self.values += within is not None
        self.others += within is None
        return b""


class Scene:
    def __init__(self, driven: Answer, dead_man: int = 10_000) -> None:
        self.node, self.messages, self.warnings, self.applied = Node(driven), list[bytes](), list[str](), list[Block]()
        node: Any = self.node
        self.turn = threading.Lock()
        self.actuators = TopicActuators(
            VerifiedSession(node, SHEET, "00" * 32, "g"), self.messages.append, (1,), dead_man=dead_man,
            clock=clock(10**9),
            turn=self.turn, mapping=threading.Lock(), echo=self.applied.append, notify=self.warnings.append,
        )  # fmt: skip

    def give(self, count: int) -> None:
        """So many set points as of a publisher of 500 Hz, each when the one before is applied or refused."""
        began = time.monotonic()
        for k in range(count):
            before = len(self.applied) + self.actuators.refused
            self.actuators.queue_command(SetPointCommand(SHEET.uuid.hex(), 1, 0.05, began + k * 0.002))
            until(lambda before=before: len(self.applied) + self.actuators.refused > before)


def reply(run: int, length: int = LENGTH) -> bytes:
    return run.to_bytes(2, "big") + length.to_bytes(2, "big")


def refusal(reason: int) -> bytes:
    raise NodeRefusedError("The node refused to be driven.", reason=reason)


def test_fast_set_points_go_as_drive_messages() -> None:
    scene = Scene(lambda: reply(1))
    scene.give(3 * WATCHED)
    scene.actuators.close()
    assert scene.node.asked == 1
    assert len(scene.messages) > WATCHED
    assert {len(message) for message in scene.messages} == {LENGTH}
    assert not scene.warnings


@pytest.mark.parametrize(
    "driven",
    [
        lambda: reply(1, LENGTH + 1),
        lambda: reply(0),
        lambda: b"\0\1",
        lambda: refusal(Reason.UNKNOWN_COMMAND),
        lambda: refusal(Reason.NO_ROOM),
    ],
    ids=["another length", "run 0", "half a reply", "unknown", "no room"],
)
def test_a_node_that_cannot_be_driven_is_moved_by_command_and_that_is_reported_once(driven: Answer) -> None:
    """Each set point was refused: what moved at 40 values a second stood in its safe state at 60."""
    scene = Scene(driven)
    scene.give(3 * WATCHED)
    scene.actuators.close()
    assert scene.node.asked == 1
    assert scene.messages == []
    assert scene.node.values == len(scene.applied) == 3 * WATCHED
    assert len(scene.warnings) == 1
    assert "no Drive messages" in scene.warnings[0]


def test_a_claim_that_is_gone_says_nothing_about_drive() -> None:
    answers = iter([None, 1])
    scene = Scene(lambda: reply(1) if next(answers) else refusal(Reason.WRONG_STATE))
    scene.give(3 * WATCHED)
    scene.actuators.close()
    assert scene.node.asked == 2
    assert scene.messages
    assert not scene.warnings


def test_a_set_point_older_than_the_dead_man_moves_nothing_and_is_reported() -> None:
    scene = Scene(lambda: reply(1))
    for age in (10.5, 9.0):
        scene.actuators.queue_command(SetPointCommand(SHEET.uuid.hex(), 1, 0.05, time.monotonic() - age))
        until(lambda: len(scene.applied) + scene.actuators.refused > 0)
        if age > 10:
            assert (scene.node.values, scene.applied, scene.messages, scene.actuators.refused) == (0, [], [], 1)
            assert "10.5" in scene.warnings[0]
            assert "dead-man is 10000 ms" in scene.warnings[0]
            scene.actuators.refused = 0
    scene.actuators.close()
    assert scene.actuators.refused == 0, "a younger one is applied"
    assert scene.node.values == len(scene.applied) == 1


def test_a_set_point_that_grew_old_while_the_node_was_busy_moves_nothing() -> None:
    """It was young when it came; the node's turn was somebody else's until its dead-man had run out."""
    scene = Scene(lambda: reply(1), dead_man=300)
    with scene.turn:
        scene.actuators.queue_command(SetPointCommand(SHEET.uuid.hex(), 1, 0.05, time.monotonic()))
        time.sleep(0.5)  # that much time, and nothing else, is what makes it old
    until(lambda: scene.actuators.refused > 0)
    scene.actuators.close()
    assert (scene.node.values, scene.applied, scene.messages) == (0, [], [])
    assert scene.node.others == 0, "nor is the actuator claimed for it"
    assert "s old" in scene.warnings[0]


def test_a_set_point_beyond_the_limits_moves_nothing_and_is_reported() -> None:
    scene = Scene(lambda: reply(1))
    scene.actuators.queue_command(SetPointCommand(SHEET.uuid.hex(), 1, 5.0, time.monotonic()))
    until(lambda: scene.actuators.refused > 0)
    scene.actuators.close()
    assert (scene.node.values, scene.applied, scene.messages) == (0, [], [])
    assert scene.warnings


def test_after_a_lost_reply_one_clock_settles_that_no_value_is_on_its_way(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, asked = Scene(lambda: reply(1)), list[Command]()
    request = scene.node.request

    def with_one_lost(command: Command, doing: str, *, within: float | None = None) -> bytes:
        asked.append(command)
        if len(asked) == 2:  # the first value, after the claim
            raise NodeSilentError("Its reply was lost.")
        return request(command, doing, within=within)

    monkeypatch.setattr(scene.node, "request", with_one_lost)
    for _ in range(3):
        scene.give(1)
    scene.actuators.close()
    assert (scene.actuators.refused, len(scene.applied)) == (1, 2)
    assert [command == CLOCK for command in asked] == [False, False, True, False, False, False]


def test_a_run_of_drive_that_was_used_before_is_refused() -> None:
    """Its messages would be sealed a second time under one key, with counters that begin again."""
    runs = iter([1, 1, 2])
    scene = Scene(lambda: reply(next(runs)))
    scene.give(3 * WATCHED)
    sent, [actuator] = len(scene.messages), scene.actuators._actuators.values()
    assert sent > WATCHED
    actuator.driver = None  # as after another actuator of the node had a set point
    scene.give(WATCHED)
    assert (len(scene.messages), scene.node.asked) == (sent, 2)
    assert "no Drive messages" in scene.warnings[0]
    scene.actuators.close()


def test_a_refusal_is_a_clause_without_a_full_stop() -> None:
    scene = Scene(lambda: refusal(Reason.WRONG_STATE))
    for why in ("channel 1: 0.2 m is above 0.11 m.", "channel 1: 0.2 m is above 0.11 m"):
        scene.actuators._refuse(why)
    scene.actuators.close()
    assert scene.warnings == ["set point refused, channel 1: 0.2 m is above 0.11 m"] * 2
    assert scene.actuators.refused == 2


def test_a_bug_with_one_set_point_is_reported_and_the_next_one_is_taken(monkeypatch: pytest.MonkeyPatch) -> None:
    """The thread ended without a word, and the actuator followed no topic any more until the session was over."""
    scene, sent = Scene(lambda: reply(1)), scene_send(monkeypatch)
    scene.give(2)
    scene.actuators.close()
    assert scene.warnings == ["set point refused, channel 1: unexpected ZeroDivisionError, which is a bug"]
    assert (scene.actuators.refused, len(scene.applied), len(sent)) == (1, 1, 2)


def scene_send(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let the first set point that is sent meet a bug, and the later ones none."""
    sent, send = list[float](), TopicActuators._send

    def fails_once(self: TopicActuators, command: SetPointCommand, actuator: Any, octets: bytes) -> None:
        sent.append(command.value)
        if len(sent) == 1:
            raise ZeroDivisionError
        send(self, command, actuator, octets)

    monkeypatch.setattr(TopicActuators, "_send", fails_once)
    return sent


class Course:
    """Set points one at a time on a clock of its own; the node refuses what it is told to, once each."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 100.0
        self.scene = Scene(lambda: reply(1), dead_man=1000)
        self.scene.actuators.close()
        self.asked: list[str] = []
        self.refused: dict[str, int] = {}
        monkeypatch.setattr(
            topic_actuators,
            "time",
            SimpleNamespace(monotonic=lambda: self.now, time=time.time, monotonic_ns=time.monotonic_ns),
        )
        monkeypatch.setattr(self.scene.node, "request", self.request)

    def request(self, command: Command, _doing: str, *, within: float | None = None) -> bytes:
        number = f"{command.command_class}.{command.function}"
        text = {
            "4.1": lambda: f"operate {command.payload[16]} s {int.from_bytes(command.payload[17:], 'big')} ms",
            "3.2": lambda: f"value within {round(within or 0, 3):.1f} s",
            "128.16": lambda: "clock",
        }[number]()
        self.asked.append(text)
        if number in self.refused:
            raise NodeRefusedError("No.", reason=self.refused.pop(number))
        return b""

    def at(self, now: float, *, age: float = 0.0) -> list[str]:
        """Return what is asked of the node for a set point that comes at this time; the error is the last word."""
        self.now, self.asked = now, []
        try:
            self.scene.actuators._apply(SetPointCommand(SHEET.uuid.hex(), 1, 0.05, now - age))
        except (NodeRefusedError, LinkError) as error:
            self.asked.append(f"refused: {error.message}")
        return self.asked


def test_an_actuator_is_claimed_for_its_dead_man_and_again_when_that_has_run_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    course = Course(monkeypatch)
    assert course.at(100.0) == ["operate 10 s 1000 ms", "value within 1.0 s"]
    assert course.at(100.5, age=0.3) == ["value within 0.7 s"]
    assert course.at(101.499) == ["value within 1.0 s"], "each value counts the dead-man anew"
    assert course.at(102.5) == ["operate 10 s 1000 ms", "value within 1.0 s"]
    assert course.at(103.0, age=1.0) == ["value within 0.0 s"]
    assert course.at(103.1, age=1.001) == ["refused: It is 1.00 s old; the dead-man is 1000 ms."]


def test_a_claim_that_the_node_ended_sooner_is_made_anew_once(monkeypatch: pytest.MonkeyPatch) -> None:
    course = Course(monkeypatch)
    course.at(100.0)
    course.refused = {"3.2": 2}
    assert course.at(100.2) == ["value within 1.0 s", "operate 10 s 1000 ms", "value within 1.0 s"]
    course.refused = {"3.2": 19}
    assert course.at(100.4) == ["value within 1.0 s", "refused: No."], "the hardware bears no such value"
    assert course.at(100.6) == ["operate 10 s 1000 ms", "value within 1.0 s"], "and what is claimed is asked anew"


def test_an_actuator_of_another_session_is_not_moved_and_its_own_claim_is_no_refusal(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    course = Course(monkeypatch)
    course.refused = {"4.1": 17}
    assert course.at(100.0) == ["operate 10 s 1000 ms", "refused: No."]
    course.refused = {"4.1": 2}
    assert course.at(100.1) == ["operate 10 s 1000 ms", "value within 1.0 s"]


def test_a_value_in_between_goes_by_command_every_half_of_the_dead_man(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drive messages have no reply: a node that was cut off is noticed by a value that has one."""
    course = Course(monkeypatch)
    sent: list[int] = []
    monkeypatch.setattr(
        course.scene.actuators, "_is_driven", lambda *_words: bool(sent.append(round(course.now * 1000))) or True
    )
    commands = [k for k in range(80) if "value within 1.0 s" in course.at(100 + k / 64)]
    assert commands == [*range(9), 40, 72], "64 a second; the rate is known with the tenth"
    assert len(sent) == 80 - len(commands)


def test_set_points_go_as_drive_messages_only_while_one_actuator_of_the_node_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    course = Course(monkeypatch)
    actuators = course.scene.actuators
    driven: list[float] = []
    monkeypatch.setattr(actuators, "_is_driven", lambda *_words: bool(driven.append(course.now)) or True)
    other = actuators._actuators[2] = topic_actuators._Actuator(actuators._actuators[1].interpreter)
    other.claimed_until = 100.5
    for k in range(40):
        course.at(100 + k / 64)
    assert driven == [100 + k / 64 for k in range(32, 40)], "from the end of the other one's claim"


def test_what_was_applied_is_published_as_a_sample_that_the_datasheet_can_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    course = Course(monkeypatch)
    for k in range(3):
        course.at(100 + k / 10)
    found = course.scene.applied
    assert [(block.uuid, block.stream, block.channels, block.index) for block in found] == [
        (SHEET.uuid.hex(), 255, (1,), index) for index in range(3)
    ]
    assert found[0].raw.tolist() == [[1861]]
    assert found[0].value.tolist() == [[pytest.approx(0.11 * 1861 / 4095, abs=1e-8)]], "not 0.05, which was asked"
    assert found[0].valid.tolist() == [[True]]
    assert not found[0].test_pattern
    assert (found[0].tick.tolist(), found[0].tick.dtype) == ([0], "uint64"), "it has no time of the node"
    assert 0 <= time.time() - float(found[0].time[0]) < 3600


def test_of_set_points_that_wait_the_newest_is_applied() -> None:
    scene = Scene(lambda: reply(1))
    with scene.turn:
        for value in (0.01, 0.02, 0.03, 0.04):
            scene.actuators.queue_command(SetPointCommand(SHEET.uuid.hex(), 1, value, time.monotonic()))
            until(lambda value=value: value > 0.01 or not scene.actuators._newest)
    until(lambda: len(scene.applied) == 2)
    scene.actuators.queue_command(SetPointCommand(SHEET.uuid.hex(), 9, 0.05, time.monotonic()))
    scene.actuators.close()
    assert [round(float(block.value[0, 0]), 3) for block in scene.applied] == [0.01, 0.04]
    assert scene.actuators.refused == 0, "another node's actuator is not refused here"


def test_ten_set_points_are_fast_if_they_come_more_often_than_fifty_a_second() -> None:
    exact = [number / 50 for number in range(10)]
    for came, fast in ((exact, False), ([*exact[:9], 0.179], True), (exact[:9], False)):
        actuator: Any = topic_actuators._Actuator(None)  # type: ignore[arg-type]
        actuator.came.extend(came)
        assert actuator.fast is fast


def test_of_each_actuator_the_newest_set_point_that_waits_is_applied() -> None:
    applied: list[tuple[int, float]] = []
    made: Any = SimpleNamespace(_news=threading.Condition(), _newest={}, _stop=False)

    def apply(command: SetPointCommand) -> None:
        applied.append((command.channel, command.value))
        made._stop = True

    made._apply = apply
    for number, value in ((1, 0.1), (2, 0.2), (1, 0.3)):
        made._newest[number] = SetPointCommand(SHEET.uuid.hex(), number, value, 0.0)
    TopicActuators._run(made)
    assert applied == [(1, 0.3), (2, 0.2)]
