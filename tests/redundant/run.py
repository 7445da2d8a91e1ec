"""Run tests with a probe before each statement of the package, and record what each costs and runs.

They run in a copy of the checkout below build/redundant, whose package is compiled with probes (probes.py); the records
lie beside it. Then ``python -m tests.redundant.choice`` names the tests that the others make redundant.

Usage: python -m tests.redundant.run [-n WORKERS] [-m MARKS] [--more] [PATHS]
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys

from tests.mutants.changes import ROOT
from tests.mutants.run import Copy
from tests.redundant.probes import compile_with_probes
from tests.redundant.recorder import RECORDS

PLACE = ROOT / "build" / "redundant"
RECORDED = PLACE / "records"
USUAL = "not soak and not machine and not rclpy and not nightly"


def main(arguments: list[str]) -> int:
    """Make the copy, then run the tests in it: those about time after the others, as ``make unit`` does."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-n", dest="workers", default="4")
    parser.add_argument("-m", dest="marks", default=USUAL)
    parser.add_argument("paths", nargs="*", help="tests; all, if none is named")
    chosen = parser.parse_args(arguments)
    PLACE.mkdir(parents=True, exist_ok=True)
    copy = Copy(0, PLACE)
    places = compile_with_probes(copy.folder)
    RECORDED.mkdir(exist_ok=True)
    for old in RECORDED.iterdir():
        old.unlink()
    (RECORDED / "size").write_text(str(len(places)))
    (RECORDED / "places").write_text("".join(f"{place}\n" for place in places))
    print(f"{len(places)} probes", flush=True)
    environment = os.environ | {RECORDS: str(RECORDED)}
    for marks, workers in ((f"{chosen.marks} and not realtime", chosen.workers), (f"{chosen.marks} and realtime", "2")):
        _run(copy, [*_words(workers, marks), *chosen.paths], environment)
    return 0


def _words(workers: str, marks: str) -> list[str]:
    spread = ["-n", workers, "--dist", "worksteal"] if workers != "0" else []
    return [
        "-p",
        "tests.redundant.recorder",
        "-p",
        "no:cacheprovider",
        "--hypothesis-profile=gate",
        *spread,
        "-m",
        marks,
    ]


def _run(copy: Copy, words: list[str], environment: dict[str, str]) -> None:
    """Run pytest in the copy; a test that fails there (one that counts imports, say) has its records all the same."""
    subprocess.run([str(copy.python), "-m", "pytest", *words], cwd=copy.folder, env=environment, check=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
