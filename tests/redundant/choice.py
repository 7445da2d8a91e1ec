"""Choose the tests whose every statement and branch others run as well: candidates for the mark ``nightly``.

Greedy, the most CPU first. A test is redundant if each probe that it hits is hit by at least two others that stay (a
shared fixture counts as one). Tests of files that a pattern of the mutants names stay, as does a test that failed while
it was measured, and one that runs hardly anything of the package: what it proves is not in these figures.

What this cannot see are values: two tests run the same lines and hold different rules. So each choice is read before
it is marked, and the named mutants are run after it (``python -m tests.mutants.run --patterns``).

Usage: python -m tests.redundant.choice [--least SECONDS] [--others N] [--rooms] [--kept PATTERN ...]
"""

from __future__ import annotations

import argparse
import fnmatch
import pickle
import sys
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from tests.mutants.patterns import C_PATTERNS, PATTERNS
from tests.redundant.recorder import Record

FEWEST_HITS = 100
"""Probes of the package that a test hits at least: below, it proves something else."""
FIXTURE = "::fixture "


@dataclass(frozen=True)
class Measured:
    """A test or a shared fixture: all its records together."""

    name: str
    cpu: float
    hits: npt.NDArray[np.intp]  # numbers of the probes
    failed: bool = False

    @property
    def file(self) -> str:
        """The file that it stands in."""
        return self.name.partition("::")[0]

    @property
    def is_test(self) -> bool:
        """Return False for a fixture."""
        return FIXTURE not in self.name


@dataclass(frozen=True)
class Choice:
    """A redundant test, and the tests that stay and run the same, the most of it first."""

    test: Measured
    holders: tuple[str, ...]


def measured(folder: Path) -> list[Measured]:
    """Return what the recorder wrote below a folder."""
    records: dict[str, list[Record]] = {}
    for path in sorted(folder.glob("*.records")):
        with path.open("rb") as file:
            while file.peek(1):
                try:
                    record = pickle.load(file)  # ours
                except EOFError:  # a run that goes on
                    break
                records.setdefault(record.name, []).append(record)
    return [_together(name, found) for name, found in records.items()]


def _together(name: str, records: Sequence[Record]) -> Measured:
    octets = [np.frombuffer(zlib.decompress(record.hits), np.uint8) for record in records]
    hits = np.flatnonzero(np.any(octets, axis=0))
    return Measured(name, sum(record.cpu for record in records), hits, any(record.failed for record in records))


def kept_files() -> frozenset[str]:
    """Return the files of tests that patterns of the mutants name."""
    return frozenset(pattern.test for pattern in (*PATTERNS, *C_PATTERNS) if pattern.test)


def choose(all_of_them: Sequence[Measured], *, least: float, others: int, kept: Iterable[str] = ()) -> list[Choice]:
    """Return the redundant tests of at least ``least`` seconds; ``kept`` are patterns of ids that stay."""
    patterns = tuple(kept)
    size = 1 + max((int(one.hits.max()) for one in all_of_them if one.hits.size), default=0)
    count = np.zeros(size, np.intp)
    for one in all_of_them:
        count[one.hits] += 1
    stay = {one.name: one for one in all_of_them}
    moved = []
    for test in sorted(all_of_them, key=lambda one: -one.cpu):
        if test.cpu < least:
            break
        fits = test.is_test and not test.failed and test.hits.size >= FEWEST_HITS
        if fits and not _is_kept(test, patterns) and int(count[test.hits].min()) > others:
            count[test.hits] -= 1
            del stay[test.name]
            moved.append(test)
    return [Choice(test, _holders(test, stay.values(), count)) for test in moved]


def _is_kept(test: Measured, patterns: Sequence[str]) -> bool:
    name = test.name.replace("[", "(").replace("]", ")")  # fnmatch has a meaning for brackets
    return any(fnmatch.fnmatchcase(name, pattern) for pattern in patterns)


def _holders(test: Measured, stay: Iterable[Measured], count: npt.NDArray[np.intp], most: int = 3) -> tuple[str, ...]:
    """Return the tests that together run what a test ran, the rarest probes first; as many as ``most``."""
    left, found = test.hits, list[str]()
    tests = [one for one in stay if one.is_test and one.hits.size >= FEWEST_HITS]
    while left.size and len(found) < most:
        rarity = np.zeros(count.size)
        rarity[left] = 1 / np.maximum(1, count[left])
        shares = [(float(rarity[one.hits].sum()) * (1.25 if one.file == test.file else 1.0), one) for one in tests]
        share, best = max(shares, key=lambda pair: pair[0])
        if not share:
            break
        found.append(best.name)
        left = np.setdiff1d(left, best.hits, assume_unique=True)
    return (*found, *([f"and {left.size} probes more"] if left.size else []))


def rooms(all_of_them: Iterable[Measured]) -> list[tuple[str, float]]:
    """Return the CPU of every room of the tests, the most first."""
    sums: Counter[str] = Counter()
    for one in all_of_them:
        sums["/".join(one.file.split("/")[:2])] += one.cpu  # type: ignore[assignment]
    return [(room, float(cpu)) for room, cpu in sums.most_common()]


def main(arguments: list[str]) -> int:
    """Print the choice."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--least", type=float, default=0.5, help="seconds of CPU that a test takes at least")
    parser.add_argument("--others", type=int, default=2, help="tests that stay and hit each probe, at least")
    parser.add_argument("--rooms", action="store_true", help="the CPU of every room alone")
    parser.add_argument("--kept", action="append", default=[], help="ids that stay: a pattern, ( ) for [ ]")
    parser.add_argument("folder", type=Path, nargs="?", default=Path("build/redundant/records"))
    chosen = parser.parse_args(arguments)
    found = measured(chosen.folder)
    print(f"{sum(one.is_test for one in found)} tests, {sum(one.cpu for one in found):.0f} s of CPU")
    if chosen.rooms:
        print("".join(f"{cpu:8.1f} s  {room}\n" for room, cpu in rooms(found)), end="")
        return 0
    kept = [*chosen.kept, *(f"{file}::*" for file in kept_files())]
    choices = choose(found, least=chosen.least, others=chosen.others, kept=kept)
    for choice in choices:
        print(f"{choice.test.cpu:7.2f} s  {choice.test.name}")
        print("".join(f"           {holder}\n" for holder in choice.holders), end="")
    print(f"{len(choices)} tests, {sum(choice.test.cpu for choice in choices):.0f} s of CPU")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
