"""What gcov counted in all builds of the library, together: ``python -m tests.firmware.coverage BUILD``.

A line or a branch counts as reached where one build reached it; a build leaves out what it was not given.
"""

from __future__ import annotations

import gzip
import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path
from typing import Final

from tests.firmware.builds import FIRMWARE

LEAST: Final = 0.95
"""Of the branches; what is left is what cannot happen by construction, and is guarded all the same."""

Counts = dict[tuple[int, int], bool]


def counted(build: Path) -> dict[str, Counts]:
    """By file of ``firmware/src``: each branch (line, number) and each line (line, -1), and whether it was reached."""
    found: dict[str, Counts] = defaultdict(dict)
    with tempfile.TemporaryDirectory() as folder:
        for data in sorted(build.rglob("*.gcda")):
            words = ["gcov", "--json-format", "--branch-probabilities", str(data.resolve())]
            if subprocess.run(words, cwd=folder, check=False, capture_output=True).returncode:
                print(f"gcov does not read {data.name}", file=sys.stderr)  # a program that was killed as it wrote
            for written in Path(folder).glob("*.gcov.json.gz"):
                take(json.loads(gzip.decompress(written.read_bytes())), found)
                written.unlink()
    return found


def take(covered: dict[str, list[dict[str, object]]], found: dict[str, Counts]) -> None:
    """Add what gcov says of one object."""
    for file in covered["files"]:
        path = Path(str(file["file"]))
        if path.parent.name != "src" or path.suffix != ".c":
            continue
        counts = found[path.name]
        lines: list[dict[str, object]] = file["lines"]  # type: ignore[assignment]
        for line in lines:
            number: int = line["line_number"]  # type: ignore[assignment]
            branches: list[dict[str, int]] = line["branches"]  # type: ignore[assignment]
            counts[number, -1] = counts.get((number, -1), False) or line["count"] != 0
            for place, branch in enumerate(branches):
                counts[number, place] = counts.get((number, place), False) or branch["count"] != 0


def reached(counts: list[Counts], branches: bool) -> tuple[int, int]:
    """Return how many were reached, of how many."""
    every = [seen for count in counts for (_, place), seen in count.items() if (place >= 0) is branches]
    return sum(every), len(every)


def share(counts: list[Counts], branches: bool) -> str:
    """Of so many, so many per cent."""
    seen, every = reached(counts, branches)
    return f"{seen / max(1, every):7.1%} of {every:5,}"


def main(arguments: list[str]) -> int:
    """Print a line for each file, what it did not reach, and the sum; 1 where that is less than :data:`LEAST`."""
    found = counted(Path(arguments[0]))
    missing = {path.name for path in (FIRMWARE / "src").glob("*.c")} - set(found)
    assert not missing, f"nothing was counted of {', '.join(sorted(missing))}"
    for name, counts in sorted(found.items()):
        lines = sorted(number for (number, place), seen in counts.items() if place == -1 and not seen)
        branches = sorted({number for (number, place), seen in counts.items() if place >= 0 and not seen})
        print(f"{name:<20}lines {share([counts], False)}   branches {share([counts], True)}")
        print(f"{'':<20}not reached {lines}   not each way {branches}")
    every = list(found.values())
    print(f"{'together':<20}lines {share(every, False)}   branches {share(every, True)}")
    seen, of = reached(every, True)
    if seen < LEAST * of:
        print(f"Less than {LEAST:.0%} of the branches: a new one wants a test that takes it.", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
