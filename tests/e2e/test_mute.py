"""A node that answers Identify and nothing else, on a bus: who is tired of waiting for it presses Ctrl-C."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator

import pytest

from tests.bench import Board
from tests.cli.shell import clean_environment
from tests.pace import until

from .desk import ANGLE, ROOT, Desk, Station

pytestmark = pytest.mark.link


@pytest.fixture
def mute(desk: Desk) -> Iterator[str]:
    with subprocess.Popen(
        [sys.executable, "-m", "tests.check.board", "mute", "--can", desk.links.can],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT, env=clean_environment(),
    ) as process:  # fmt: skip
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            assert process.stdout.readline() == "ready\n"
            yield Board.uuid.hex()
        finally:
            process.stdin.close()


@pytest.mark.parametrize("words", [("identify",), ("provision", "--all", "--profile", ANGLE)], ids=" ".join)
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
