"""Replay the model against the code: every counterexample, then for some minutes sequences of growing length.

Usage: python -m tests.model.run [MINUTES]. Prints what was replayed, and every sequence after which the code's state is
another than the model's; exits 1 if there is one, or a counterexample that cannot be found or tried.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import cache
from itertools import count
from pathlib import Path
from typing import Final

from tests.model.desk import Desk, Replayed, replay
from tests.model.traces import KEYED, Program, Step, Trace
from tests.passphrase_costs import lower_costs

_BOUNDS: Final[tuple[tuple[str, dict[str, int]], ...]] = (
    (
        "LIFTED BACK_NO_ROTATION UNSETTLED PENDING REFUSAL LATE+MOVE_DUE HELD_BACK MOVE_ORDER COPY_ORDER UNDO "
        "UNDO_CLOSED MOVE_NO_ROTATION EARLY_DELETE ROTATED_EARLY ANY_OPEN NEVER_FORGETS ANY_CONFIRM CONFIRM_TWICE "
        "BEFORE_OPEN RECEIPT_FIRST RECEIPT_OTHER RECEIPT_COPY IMPORT_OLDER COPY_DUE COPY_UNAWARE COPY_CLOSED CONTINUED "
        "GIVEN_REQUEST KEEPS_OLD",
        {"resets": 0},
    ),
    ("M6 OLD_PENDING BACKUP_TOMBSTONE", {"restores": 1, "resets": 0}),
    ("EPOCH_BACK RESET_REPLAY RESET_UNPROVEN RESET_RAM RESET_FACTORY RESET_KEEPS", {"bundles": 1}),
    ("DROP_PENDING", {"agreements": 3, "bundles": 1, "resets": 0}),
    ("M1 STALE_EPOCH GIVEN_COMMIT", {"commits": 1, "resets": 0}),
    ("SIGNER", {"commits": 2, "bundles": 1, "resets": 0}),
    ("SEQUENCE_BACK COMMIT_UNKEYED", {"commits": 2, "bundles": 1}),
    ("GIVEN_OPEN SESSION MEASURED_ON", {"sessions_too": 1, "resets": 0}),
    ("SESSION_RESET", {"sessions_too": 1, "bundles": 1}),
)
COUNTEREXAMPLES: Final = {rule: bounds for rules, bounds in _BOUNDS for rule in rules.split()}
"""Rules whose violations are steps that a trace names, with the bounds within which SPIN finds them soon."""


class ReplayWorkers:
    """Copies of one desk, in processes of their own."""

    def __init__(self, folder: Path, pool: ProcessPoolExecutor) -> None:
        self._folder, self._pool = folder, pool
        self.taken = self.tried = self.traces = 0
        self.faults: list[str] = []

    def run_counterexamples(self) -> None:
        """Replay the counterexample of each broken rule."""
        jobs = [(self._folder, rule) for rule in COUNTEREXAMPLES]
        for rule, outcome in zip(COUNTEREXAMPLES, self._pool.map(_counterexample_replayed, jobs), strict=True):
            if outcome is None:
                self._report(f"without rule {rule}: no counterexample within its bounds")
            elif isinstance(outcome, str) or outcome.untried is None:
                self._count(outcome)
            else:
                self._report(f"without rule {rule}: no way to try {outcome.untried}")

    def run(self, traces: Sequence[Trace], until: float) -> int:
        """Replay as many as there is time for; return how many."""
        jobs = [(self._folder, trace, until) for trace in traces]
        outcomes = [outcome for outcome in self._pool.map(_replayed, jobs, chunksize=4) if outcome is not None]
        for outcome in outcomes:
            self._count(outcome)
        return len(outcomes)

    def _count(self, outcome: Replayed | str) -> None:
        if isinstance(outcome, str):
            self._report(f"ANOTHER STATE: {outcome}")
            return
        self.taken, self.tried, self.traces = self.taken + outcome.taken, self.tried + outcome.tried, self.traces + 1

    def _report(self, fault: str) -> None:
        self.faults.append(fault)
        print(fault, flush=True)


def _counterexample_replayed(job: tuple[Path, str]) -> Replayed | str | None:
    """Return what became of a rule's counterexample: None if there is none, a text if the code's state is another."""
    folder, rule = job
    bounds = COUNTEREXAMPLES[rule]
    script = Program(folder / rule, *rule.split("+"), **bounds).counterexample()
    return _on_a_copy(folder, _model(folder, **bounds).follow(script), script) if script else None


def _replayed(job: tuple[Path, Trace, float]) -> Replayed | str | None:
    folder, trace, until = job
    return _on_a_copy(folder, trace) if time.time() < until else None


def _on_a_copy(folder: Path, trace: Trace, script: Sequence[Step] = ()) -> Replayed | str:
    with tempfile.TemporaryDirectory(dir=folder) as place:
        desk = _fresh(folder).copy(Path(place))
        try:
            return replay(desk, trace, script)
        except AssertionError as difference:
            return str(difference)
        finally:
            desk.leave()


@cache
def _fresh(folder: Path) -> Desk:
    """Return the desk that the copies are made of; each process makes its own once."""
    desk = Desk.make(folder / f"fresh {os.getpid()}")
    desk.leave()
    return desk


@cache
def _model(folder: Path, **bounds: int) -> Program:
    """Return the model within some bounds; each process makes its own."""
    name = " ".join(f"{name} {most}" for name, most in bounds.items())
    return Program(folder / f"model {name} {os.getpid()}", **bounds)


def main(arguments: list[str]) -> int:
    """Replay; return the exit code."""
    minutes = float(arguments[0]) if arguments else 10.0
    with tempfile.TemporaryDirectory() as place, ProcessPoolExecutor(initializer=lower_costs) as pool:
        folder = Path(place)
        replays = ReplayWorkers(folder, pool)
        replays.run_counterexamples()
        print(
            f"{replays.traces} of {len(COUNTEREXAMPLES)} counterexamples:"
            f" {replays.taken} steps, {replays.tried} refusals tried",
            flush=True,
        )
        until = time.time() + 60 * minutes
        model = _model(folder, commits=1, restores=1, sessions_too=1)
        for depth in count(len(KEYED) + 1):
            traces = [trace for trace in model.every(depth, KEYED) if len(trace.steps) == depth]
            done = replays.run(traces, until)
            print(f"{depth - len(KEYED)} steps after the first key: {done} of {len(traces)} sequences", flush=True)
            if done < len(traces):
                break
    print(f"{replays.traces} sequences of {replays.taken} steps, {len(replays.faults)} faults")
    return 1 if replays.faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
