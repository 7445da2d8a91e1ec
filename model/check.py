"""Check the model of a key's life with SPIN: the rules as they are hold, and each broken rule is found.

Usage: python model/check.py [--quick]. Prints a line per run: what was tried, how many states, how long, and whether
the outcome is the expected one; exits 1 where one is not, 2 where spin or a C compiler is missing.
"""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

MODEL = Path(__file__).with_name("keys_life.pml")
SECONDS = 1500


@dataclass(frozen=True)
class Bounds:
    """How much may happen in one run of the model."""

    agreements: int
    bundles: int
    commits: int = 1
    restores: int = 0
    resets: int = 0

    def defines(self) -> list[str]:
        """The bounds as options of spin."""
        return [f"-D{name.upper()}={value}" for name, value in vars(self).items()]

    def __str__(self) -> str:
        return ", ".join(f"{value} {name}" for name, value in vars(self).items() if value)


@dataclass(frozen=True)
class Run:
    """One run of the checker. ``broken`` names the rule that is put out of force; ``whole``: every state is visited.

    ``small``: a million states or so, for which an optimised checker takes longer to compile than to run.
    """

    bounds: Bounds
    broken: str = ""
    whole: bool = True
    small: bool = True

    def __str__(self) -> str:
        how = "" if self.whole else " (by sample: bit state hashing)"
        return (f"without rule {self.broken}: " if self.broken else "the rules: ") + str(self.bounds) + how


SMALL = Bounds(2, 2)
RESTORED = Bounds(2, 2, restores=1)
BROKEN = [
    Run(RESTORED if rule in ("M6", "OLD_PENDING") else SMALL, rule)
    for rule in ("M1", "M2", "M3", "M6", "PENDING", "REFUSAL", "LATE", "HELD_BACK", "OLD_PENDING")
]
QUICK = [Run(SMALL), Run(Bounds(2, 1, restores=1, resets=1)), *BROKEN]
FULL = [
    Run(SMALL),
    Run(Bounds(2, 1, restores=1, resets=1)),
    Run(Bounds(3, 1, resets=1), small=False),
    Run(RESTORED, small=False),
    Run(Bounds(3, 2, commits=0), small=False),
    Run(Bounds(3, 3, commits=2, restores=1, resets=1), whole=False, small=False),
    *BROKEN,
]


@dataclass(frozen=True)
class Outcome:
    """What the checker said: errors found, states visited, wall seconds."""

    errors: int
    states: int
    seconds: float


def check(run: Run, folder: Path) -> Outcome:
    """Generate, compile and run one checker; raises RuntimeError with the tool's own words."""
    began = time.monotonic()
    defines = [*run.bounds.defines(), *([f"-DBREAK_{run.broken}"] if run.broken else [])]
    _call(["spin", "-a", *defines, str(MODEL)], folder)
    memory = ["-DHC4"] if run.whole else ["-DBITSTATE"]
    _call(["cc", "-O0" if run.small else "-O2", "-DSAFETY", *memory, "-DMEMLIM=8000", "-o", "pan", "pan.c"], folder)
    table = 31 if not run.whole else 20 if run.small else 25
    said = _call(["./pan", "-m100000", f"-w{table}"], folder)
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


def main(arguments: list[str]) -> int:
    """Run all; return the exit code."""
    missing = [tool for tool in ("spin", "cc") if shutil.which(tool) is None]
    if missing:
        print(f"{' and '.join(missing)} missing: apt-get install spin gcc libc6-dev", file=sys.stderr)
        return 2
    wrong = 0
    for run in QUICK if "--quick" in arguments else FULL:
        with tempfile.TemporaryDirectory() as folder:
            outcome = check(run, Path(folder))
        good = (outcome.errors > 0) == bool(run.broken)
        wrong += not good
        found = "a violation" if outcome.errors else "no violation"
        verdict = "as it should be" if good else "WRONG"
        print(f"{run}: {found} in {outcome.states:,} states, {outcome.seconds:.1f} s: {verdict}", flush=True)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
