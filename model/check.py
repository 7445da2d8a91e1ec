"""Check the models of a key's life and of the plant with SPIN: the rules hold, and each broken rule is found.

Usage: python model/check.py [--quick | --quicker]. Prints a line per run: what was tried, how many states, how
long, and whether the outcome is the expected one; exits 1 if one is not, 2 if spin or a C compiler is missing.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

KEYS_LIFE, PLANT_LIFE = (Path(__file__).with_name(name) for name in ("keys_life.pml", "plant_life.pml"))
SECONDS = 3000
SAMPLE_MINUTES = 10


@dataclass(frozen=True)
class Bounds:
    """How much may happen in one run of the model."""

    agreements: int
    bundles: int
    commits: int = 1
    restores: int = 0
    resets: int = 0

    def defines(self) -> list[str]:
        """Return the bounds as options of spin."""
        return [f"-D{name.upper()}={value}" for name, value in vars(self).items()]

    def __str__(self) -> str:
        return ", ".join(f"{value} {name}" for name, value in vars(self).items() if value)


@dataclass(frozen=True)
class PlantBounds:
    """How long a chain of pages gets in the model of the plant, and how many homes have the CA key."""

    pages: int
    owners: int = 1

    def defines(self) -> list[str]:
        """Return the bounds as options of spin."""
        return [f"-DPAGES={self.pages}", *(["-DTWO_OWNERS"] if self.owners > 1 else [])]

    def __str__(self) -> str:
        return f"the plant, {self.pages} pages, {self.owners} homes with the CA key"


@dataclass(frozen=True)
class Run:
    """One run of the checker. ``whole``: every state is visited.

    ``broken`` names the rule that is put out of force, or two with ``+`` between them. ``parts`` are those of the model
    that cost many states: sessions, and the node's two slots of flash. ``small``: a million states or so, for which an
    optimised checker takes longer to compile than to run.
    """

    bounds: Bounds | PlantBounds
    broken: str = ""
    parts: tuple[str, ...] = ()
    whole: bool = True
    small: bool = True

    def __str__(self) -> str:
        how = "" if self.whole else " (by sample: bit state hashing)"
        more = "".join(f", {part.removesuffix('_TOO').lower()}" for part in self.parts)
        return (f"without rule {self.broken}: " if self.broken else "the rules: ") + str(self.bounds) + more + how


SMALL = Bounds(2, 2)
RESTORED = Bounds(2, 2, restores=1)
RESET = Bounds(2, 1, commits=2, resets=1)
BROKEN = {
    SMALL: "M1 LIFTED BACK_NO_ROTATION UNSETTLED PENDING REFUSAL LATE+MOVE_DUE HELD_BACK STALE_EPOCH MOVE_ORDER "
    "COPY_ORDER MOVE_NO_ROTATION UNDO UNDO_CLOSED EARLY_DELETE ROTATED_EARLY ANY_OPEN NEVER_FORGETS ANY_CONFIRM "
    "CONFIRM_TWICE BEFORE_OPEN RECEIPT_FIRST RECEIPT_OTHER RECEIPT_COPY IMPORT_OLDER COPY_DUE "
    "COPY_UNAWARE COPY_CLOSED CONTINUED GIVEN_REQUEST GIVEN_OPEN GIVEN_COMMIT KEEPS_OLD SESSION MEASURED_ON ERASE",
    RESTORED: "M6 OLD_PENDING BACKUP_TOMBSTONE",
    RESET: "EPOCH_BACK SEQUENCE_BACK RESET_REPLAY RESET_UNPROVEN RESET_RAM RESET_FACTORY SESSION_RESET RESET_KEEPS "
    "COMMIT_UNKEYED",
    Bounds(2, 1, commits=2): "SIGNER",
    Bounds(3, 1): "DROP_PENDING",
}
PLANT_BROKEN = {
    PlantBounds(
        2
    ): "RESTORED_WRITES NO_LOOK PUSH_NEW GAP FORK_UNSEEN REMOVED_COUNTS REMOVED_WRITES ROSTER_BACK OWNER_BLIND",
    PlantBounds(3): "ADOPT_ANY PREVIOUS",
    PlantBounds(2, owners=2): "TWO_ROSTERS ROSTER_PREVIOUS",
}
HARMLESS = ("RECEIPT_ALL", "LATE", "MOVE_DUE", "IMPORT_REPLACES", "IMPORT_TWICE", "EPOCH_UNCHECKED")
"""Rules of the code without which nothing goes wrong in the model, as another rule does the same (README)."""
BY_TEST = {"M1", "LIFTED", "BACK_NO_ROTATION", "UNSETTLED", "M6", "PENDING", "LATE+MOVE_DUE", "HELD_BACK"}
BY_TEST |= {"MOVE_ORDER", "EPOCH_BACK", "CONTINUED", "GIVEN_COMMIT", "SESSION", "ERASE"}
"""Rules that ``--quick`` breaks, and those that ``--quicker`` breaks: one of each kind.

LIFTED is broken by tests/model/test_replay.py as well."""
AT_THE_GATE = {"M1", "EPOCH_BACK", "SESSION"}
FOUND = [Run(bounds, rule) for bounds, rules in BROKEN.items() for rule in rules.split()]
FOUND += [Run(bounds, rule) for bounds, rules in PLANT_BROKEN.items() for rule in rules.split()]
PLANT_RUNS = [Run(PlantBounds(3)), Run(PlantBounds(2, owners=2))]
SMALL_RUNS = [
    Run(SMALL),
    Run(Bounds(2, 1, restores=1, resets=1)),
    Run(Bounds(2, 1, commits=2, resets=1), parts=("SESSIONS_TOO", "SLOTS")),
]
LARGE_RUNS = [
    Run(Bounds(2, 2), parts=("SESSIONS_TOO", "SLOTS"), small=False),
    Run(Bounds(3, 1, resets=1), small=False),
    Run(RESTORED, small=False),
    Run(Bounds(3, 2, commits=0), small=False),
    Run(Bounds(3, 3, commits=2, restores=1, resets=1), whole=False, small=False),
]


@dataclass(frozen=True)
class Outcome:
    """Result of the checker: errors found, states visited, wall seconds."""

    errors: int
    states: int
    seconds: float


def check(run: Run, folder: Path) -> Outcome:
    """Generate, compile and run one checker; raises RuntimeError with the tool's own words."""
    began = time.monotonic()
    defines = [
        *run.bounds.defines(),
        *(f"-DBREAK_{rule}" for rule in run.broken.split("+") if rule),
        *(f"-D{part}" for part in run.parts),
    ]
    _call(["spin", "-a", *defines, str(PLANT_LIFE if isinstance(run.bounds, PlantBounds) else KEYS_LIFE)], folder)
    memory = ["-DHC4"] if run.whole else ["-DBITSTATE"]
    _call(["cc", "-O0" if run.small else "-O2", "-DSAFETY", *memory, "-DMEMLIM=8000", "-o", "pan", "pan.c"], folder)
    table = 31 if not run.whole else 20 if run.small else 25
    limit = [] if run.whole else [f"-Q{SAMPLE_MINUTES}"]
    said = _call(["./pan", "-m100000", f"-w{table}", *limit], folder)
    if "max search depth too small" in said or "out of memory" in said:
        raise RuntimeError("the search was cut short:\n" + said)
    errors = re.search(r"errors: (\d+)", said)
    states = re.search(r"(\S+) states, stored", said)
    if errors is None or states is None:
        raise RuntimeError("pan gave no result:\n" + said)
    return Outcome(int(errors[1]), int(float(states[1])), time.monotonic() - began)


def _call(command: list[str], folder: Path) -> str:
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=SECONDS, check=False)
    if done.returncode:
        raise RuntimeError(f"{command[0]} failed:\n{done.stdout}{done.stderr}")
    return done.stdout


def tried(run: Run) -> Outcome:
    """Run one checker in its own folder."""
    with tempfile.TemporaryDirectory() as folder:
        return check(run, Path(folder))


def told(run: Run, outcome: Outcome) -> bool:
    """Print the outcome of a run; whether it is as it should be."""
    good = (outcome.errors > 0) == (run.broken not in ("", *HARMLESS))
    found = "a violation" if outcome.errors else "no violation"
    verdict = "as it should be" if good else "WRONG"
    print(f"{run}: {found} in {outcome.states:,} states, {outcome.seconds:.1f} s: {verdict}", flush=True)
    return good


def main(arguments: list[str]) -> int:
    """Run all; return the exit code."""
    missing = [tool for tool in ("spin", "cc") if shutil.which(tool) is None]
    if missing:
        print(f"{' and '.join(missing)} missing: apt-get install spin gcc libc6-dev", file=sys.stderr)
        return 2
    wrong = 0
    quicker = "--quicker" in arguments
    quick = quicker or "--quick" in arguments
    chosen = AT_THE_GATE if quicker else BY_TEST
    found = [run for run in FOUND if run.broken in chosen] if quick else FOUND
    harmless = [] if quick else [Run(SMALL, rule) for rule in HARMLESS]
    small = [*SMALL_RUNS, *([] if quick else PLANT_RUNS), *found, *harmless]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for run, outcome in zip(small, pool.map(tried, small), strict=True):
            wrong += not told(run, outcome)
    for run in () if quick else LARGE_RUNS:
        wrong += not told(run, tried(run))
    print(f"{wrong} runs are WRONG" if wrong else f"The rules hold, and each of {len(found)} broken ones is found.")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
