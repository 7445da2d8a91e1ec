"""The pair bench: every changing command beside every long-running one, started before, during and after it.

Real processes on virtual nodes, over real links of this machine. Each cell runs in a copy of a prepared scene
(scene.py); what must hold is in changes.py for each change, in long_runs.py for each long run, and in cells.py for all.

Left out: three commands at once, and commands that are killed (``make faults`` has both); readers of hardware,
Bluetooth, SocketCAN, and nodes in C; vaults in a keyring or a token; a registry in PostgreSQL (tests/plant); what the
page and the API change beside a command (tests/ncap); ``calibrate capture``, ``handover undo``, ``reset``, ``node`` and
``record``; ``registry share``, ``role``, ``renew`` and ``resume``; stations on two machines. ``registry sync`` is
short: as a long run it is repeated around the change. Measurements run at 20 Hz.

Usage: python -m tests.pairs.bench [--only TEXT] [--jobs N] [--minutes M] [--busy]
Prints a line for each cell in which something does not hold, then a table, and exits 1 if there was one.
"""

from __future__ import annotations

import argparse
import random
import sys
import time
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

from tests.pairs.cells import TIMES, Cell, CellResult, all_cells, run_cell
from tests.pairs.changes import CHANGES
from tests.pairs.long_runs import LONG_RUNS
from tests.pairs.scene import Scenes

GOOD, BAD, NOT_RUN = ".", "X", "-"


def table(found: Iterable[CellResult]) -> str:
    """Return the result of each cell: a row for each change, a column for each long run, a letter for each time."""
    results = {
        (current.cell.change.name, current.cell.run, current.cell.when): BAD if current.complaints else GOOD
        for current in found
    }
    width = max(len(change.name) for change in CHANGES)
    heads = list(LONG_RUNS)
    lines = ["  ".join([" " * width, *heads])]
    for change in CHANGES:
        cells = [
            "".join(results.get((change.name, run, when), NOT_RUN) for when in TIMES) if run in change.beside else ""
            for run in heads
        ]
        lines.append(
            "  ".join([change.name.ljust(width), *(c.ljust(len(h)) for c, h in zip(cells, heads, strict=True))])
        )
    key = f"{GOOD} holds, {BAD} does not, {NOT_RUN} not run, empty: no such cell; the letters: {', '.join(TIMES)}"
    return "\n".join([*(line.rstrip() for line in lines), key])


def main(arguments: list[str]) -> int:
    """Run the bench; 0 if everything holds."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", action="append", default=[], metavar="TEXT", help="cells whose name contains this")
    parser.add_argument("--jobs", type=int, default=2, help="cells at a time")
    parser.add_argument("--minutes", type=float, default=45.0, help="start no cell after this time")
    parser.add_argument("--busy", action="store_true", help="the machine does other work: hold no rule about time")
    chosen = parser.parse_args(arguments)
    cells = [cell for cell in all_cells() if not chosen.only or any(text in str(cell) for text in chosen.only)]
    random.Random(1).shuffle(cells)  # so that a run that is cut short has seen some of everything
    began = time.monotonic()

    def run(cell: Cell) -> CellResult | None:
        if time.monotonic() - began > chosen.minutes * 60:
            return None
        found = run_cell(scenes, cell, punctual=not chosen.busy)
        for complaint in found.complaints:
            print(f"{cell}: {complaint}", flush=True)
        return found

    with Scenes.open() as scenes, ThreadPoolExecutor(chosen.jobs) as pool:
        found = [item for item in pool.map(run, cells) if item is not None]
    print(table(found))
    bad = sum(bool(current.complaints) for current in found)
    pairs = len({(current.cell.change.name, current.cell.run) for current in found})
    seconds = time.monotonic() - began
    print(
        f"{len(found)} of {len(cells)} cells of {pairs} pairs: "
        f"{len(found) - bad} hold, {bad} do not, in {seconds:.0f} s"
    )
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
