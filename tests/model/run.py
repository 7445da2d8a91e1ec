"""Replay the model against the code for some minutes: sequences of growing length, and every counterexample.

Usage: python -m tests.model.run [MINUTES]. Prints what was replayed, and every sequence after which the code's state is
another than the model's; exits 1 if there is one.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from itertools import count
from pathlib import Path

from tests.model.desk import Desk, replay
from tests.model.traces import KEYED, Program, Step, Trace
from tests.passphrase_costs import lower_costs

COUNTEREXAMPLES = (
    *(
        "LIFTED",
        "BACK_NO_ROTATION",
        "UNSETTLED",
        "PENDING",
        "REFUSAL",
        "LATE+MOVE_DUE",
        "HELD_BACK",
        "MOVE_ORDER",
        "UNDO",
    ),
    *("COPY_ORDER", "MOVE_NO_ROTATION", "UNDO_CLOSED", "EARLY_DELETE", "ROTATED_EARLY", "ANY_OPEN", "NEVER_FORGETS"),
    *("ANY_CONFIRM", "CONFIRM_TWICE", "BEFORE_OPEN", "RECEIPT_FIRST", "RECEIPT_OTHER", "RECEIPT_COPY", "IMPORT_OLDER"),
    *("IMPORT_REPLACES", "COPY_DUE", "COPY_UNAWARE", "COPY_CLOSED", "CONTINUED", "GIVEN_REQUEST", "KEEPS_OLD", "M6"),
    *("OLD_PENDING", "BACKUP_TOMBSTONE", "EPOCH_BACK", "RESET_REPLAY", "RESET_UNPROVEN", "RESET_RAM", "RESET_FACTORY"),
    "RESET_KEEPS",
)
"""Rules whose violations are sequences of steps that a trace names: all but those of commits, sessions and flash."""


class Replays:
    """Copies of one desk, in processes of their own."""

    def __init__(self, folder: Path, until: float) -> None:
        self._folder, self._until = folder, until
        Desk.make(folder / "fresh").leave()
        self.taken = self.tried = self.traces = 0
        self.differences: list[str] = []

    def run(self, pool: ProcessPoolExecutor, traces: Sequence[Trace], scripts: Sequence[Sequence[Step]] = ()) -> int:
        """Replay as many as there is time for; return how many."""
        jobs = [(self._folder, trace, scripts[n] if scripts else (), self._until) for n, trace in enumerate(traces)]
        done = 0
        for outcome in pool.map(_replayed, jobs, chunksize=4):
            if outcome is None:
                continue
            done += 1
            taken, tried, difference = outcome
            self.taken, self.tried, self.traces = self.taken + taken, self.tried + tried, self.traces + 1
            if difference:
                self.differences.append(difference)
                print(f"ANOTHER STATE: {difference}", flush=True)
        return done


def _replayed(job: tuple[Path, Trace, Sequence[Step], float]) -> tuple[int, int, str] | None:
    folder, trace, script, until = job
    if time.time() > until:
        return None
    with tempfile.TemporaryDirectory(dir=folder) as place:
        desk = _fresh(folder).copy(Path(place))
        try:
            return *replay(desk, trace, script), ""
        except AssertionError as difference:
            return 0, 0, str(difference)
        finally:
            desk.leave()


_made: dict[Path, Desk] = {}


def _fresh(folder: Path) -> Desk:
    """Return the desk that the copies are made of; each process makes its own once."""
    mine = folder / f"fresh {os.getpid()}"
    if mine not in _made:
        _made[mine] = Desk.make(mine)
        _made[mine].leave()
    return _made[mine]


def main(arguments: list[str]) -> int:
    """Replay; return the exit code."""
    minutes = float(arguments[0]) if arguments else 10.0
    until = time.time() + 60 * minutes
    with tempfile.TemporaryDirectory() as place, ProcessPoolExecutor(initializer=lower_costs) as pool:
        folder = Path(place)
        replays = Replays(folder, until)
        model = Program(folder / "model", restores=1)
        for number, rule in enumerate(COUNTEREXAMPLES):
            if time.time() > until - 30 * minutes:
                print(f"no time for {', '.join(COUNTEREXAMPLES[number:])}")
                break
            script = Program(folder / rule, *rule.split("+"), restores=1).counterexample()
            if not script:
                print(f"without rule {rule}: no counterexample within these bounds", flush=True)
            else:
                replays.run(pool, [model.follow(script)], [script])
        print(f"{replays.traces} counterexamples: {replays.taken} steps, {replays.tried} refusals tried", flush=True)
        for depth in count(len(KEYED) + 1):
            traces = [trace for trace in model.every(depth, KEYED) if len(trace.steps) == depth]
            done = replays.run(pool, traces)
            print(f"{depth - len(KEYED)} steps after the first key: {done} of {len(traces)} sequences", flush=True)
            if done < len(traces):
                break
    print(f"{replays.traces} sequences of {replays.taken} steps, {len(replays.differences)} differ from the model")
    return 1 if replays.differences else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
