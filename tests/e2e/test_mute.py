"""A node that answers Identify and nothing else, on a bus: who is tired of waiting for it presses Ctrl-C."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing

import pytest

from tests.bench import Board
from tests.check.board import BOARD
from tests.pace import until

from .desk import ANGLE, Desk, Running, Station

pytestmark = pytest.mark.link


@pytest.fixture
def mute(desk: Desk) -> Iterator[str]:
    with closing(Running("mute", "--can", desk.links.can, program=BOARD)) as process:
        process.wait_for("ready\n")
        yield Board.uuid.hex()


IDENTIFY = pytest.param(
    ("identify",),
    marks=pytest.mark.nightly(
        "tests/e2e/test_mute.py::test_ctrl_c_does_not_wait_for_a_mute_node[provision --all --profile magnetic-angular-"
        "position-sensor] identifies first"
    ),
)


@pytest.mark.parametrize("words", [IDENTIFY, ("provision", "--all", "--profile", ANGLE)], ids=" ".join)
def test_ctrl_c_does_not_wait_for_a_mute_node(desk: Desk, station: Station, mute: str, words: tuple[str, ...]) -> None:
    """``provision --all`` waited a minute for it."""
    good = desk.node("good").start(nfc=False, can=True)
    for uuid in (good.uuid, mute):
        station.ask("whitelist", "add", uuid)
    trace = desk.folder / "trace.jsonl"
    running = station.start(*words, "--trace", trace, *desk.links.over("can"))

    until(lambda: trace.exists() and any(mute in line for line in trace.read_text().splitlines()), "it was not asked")
    running.signal(signal.SIGINT)
    outcome = running.end(30)  # the node is given up after sixty
    assert outcome.code == 130, outcome
    assert "Traceback" not in outcome.err
    assert station.log_is_whole()
