"""A node with a low battery is not written without a word; its charge decides nothing else."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NodeRefusedError, PolicyError
from teds_provision.links.hints import Charging
from teds_provision.protocol.operation.commands import POWER, PowerReply
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.charge import Low, require_charge, wait_for_charge
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.station import Station
from tests.answers import Answers
from tests.bench import Board, contact

ANGLE = "magnetic-angular-position-sensor"


def run(
    station: Station, board: Board, percent: int | None, low: Low = wait_for_charge, name: str = "a"
) -> ProvisionResult:
    charging = None if percent is None else Charging("wanted", percent)
    there = replace(contact(board), charging=charging)
    with Conversation(there, notice=lambda _notice: None) as node:
        order = BuildOrder(profile=ANGLE, name=name)
        return provision(station, node, order, operator=Answers(low_battery=low), reporter=SilentReporter())


def test_below_ten_per_cent_nothing_is_written_without_a_word(station: Station, board: Board) -> None:
    with pytest.raises(PolicyError, match="is at 9 %") as refused:
        run(station, board, 9)
    assert "Charge it first" in refused.value.hint
    assert board.state.sequence == 0
    asked: list[str] = []
    assert run(station, board, 9, asked.append).verified.verdict == "authentic"
    assert asked[0].endswith("Write it?")


@pytest.mark.parametrize("percent", [10, 100, None])
def test_with_enough_no_node_is_asked(station: Station, board: Board, percent: int | None) -> None:
    assert run(station, board, percent).verified.verdict == "authentic"


def test_what_is_not_written_needs_no_charge(station: Station, board: Board) -> None:
    run(station, board, 50)
    assert run(station, board, 1).verified.verdict == "authentic", "reading and verifying go on"


@pytest.mark.parametrize(
    ("answer", "low"),
    [
        (PowerReply(1, 9), [9]),
        (PowerReply(1, 0), [0]),
        (PowerReply(1, 10), []),
        (PowerReply(1), []),
        (PowerReply(0, 3), []),  # fed
        (PowerReply(6, 3), []),
        (PowerReply(3, 9), [9]),
        (NodeRefusedError("no", reason=5), []),
        (BadDataError("other octets"), []),
    ],
)
def test_over_the_air_the_session_asks_for_it(answer: PowerReply | Exception, low: list[int]) -> None:
    asked: list[bytes] = []
    questions: list[str] = []

    def request(frame: bytes, _why: str) -> bytes:
        asked.append(frame)
        if isinstance(answer, Exception):
            raise answer
        return answer.encode()

    def node(**more: Any) -> Any:
        facts = {"charging": None, "tapped": False, "wired": False, "sealed": True, "uuid": bytes(10)}
        return SimpleNamespace(request_idempotent=request, **{**facts, **more})

    require_charge(node(), questions.append)
    assert questions == [
        f"The battery of node {'00' * 10} is at {percent} %: the write may fail halfway and have to be repeated."
        " Write it?"
        for percent in low
    ]
    assert asked == [POWER]
    for other in ({"tapped": True}, {"wired": True}, {"sealed": False}, {"charging": Charging("no", 10)}):
        require_charge(node(**other), questions.append)
    assert (len(asked), len(questions)) == (1, len(low)), "neither asked nor reported"
    require_charge(node(charging=Charging("no")), questions.append)
    assert len(asked) == 2, "a hint without a number is no hint"
