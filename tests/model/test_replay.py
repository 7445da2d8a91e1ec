"""The model of a key's life and the code are one: sequences of its steps leave the real store and node as it says.

A sample; ``make model`` replays every sequence up to a depth, and the counterexample of each broken rule.
"""

from __future__ import annotations

import random
import shutil
from pathlib import Path

import pytest

from tests.model.desk import Desk, replay
from tests.model.traces import KEYED, Kind, Program

MISSING = shutil.which("spin") is None or shutil.which("cc") is None
SAMPLE, DEPTH = 12, 11

pytestmark = [pytest.mark.system, pytest.mark.skipif(MISSING, reason="spin or a C compiler missing")]


@pytest.fixture
def fresh(tmp_path: Path) -> Desk:
    """Return the desk of which the others are copies."""
    made = Desk.make(tmp_path / "fresh")
    made.leave()
    return made


def test_sequences_of_the_model_leave_the_code_in_its_states(fresh: Desk, tmp_path: Path) -> None:
    traces = Program(tmp_path / "model", restores=1).every(DEPTH, KEYED)
    sample = random.Random(1).sample(traces, SAMPLE)
    assert {Kind.MOVE, Kind.IMPORT, Kind.REQUEST} <= {step.kind for trace in sample for step in trace.steps if step}
    for number, trace in enumerate(sample):
        desk = fresh.copy(tmp_path / str(number))
        try:
            replay(desk, trace)
        finally:
            desk.leave()


def test_the_code_refuses_what_breaks_the_model(fresh: Desk, tmp_path: Path) -> None:
    """A third station's old copy does not lift a tombstone; who gave a node away agrees on no key with it."""
    model = Program(tmp_path / "model")
    for rule in ("LIFTED", "GIVEN_REQUEST"):
        script = Program(tmp_path / rule, rule).counterexample()
        desk = fresh.copy(tmp_path / f"desk {rule}")
        try:
            done = replay(desk, model.follow(script), script)
        finally:
            desk.leave()
        assert done.tried, f"{rule}: {', '.join(map(str, script))}"
