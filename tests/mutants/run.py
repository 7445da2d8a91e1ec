"""Break the code, a mutant at a time, and see whether the tests nearest to it notice.

Mutants are the rules of patterns.py and random ones of changes.py. Each is made in a copy of the checkout below
build/mutants, with an environment of its own, so that processes that tests start run it too. The nearest test files run
until one fails; that test is then run without the mutant once, so that none dies of a test that fails by itself. What
no test notices is printed at the end and kept in build/mutants/survivors.txt: it is a missing test, a rule that nothing
needs, or a change that changes nothing, and only a reader can tell which.

A mutant whose tests did not come to their end is no survivor: nothing is known of it. If they had the whole time of a
mutant, they run once without it, on the machine as busy as it is, and once more with twice the time that this took.
Those that still do not end are listed apart, and kept in build/mutants/unfinished.txt.

Without --patterns, at most half of the mutants are rules, drawn by chance where there are more; all of them take hours:
--patterns --count 1000 --minutes 300.

Usage: python -m tests.mutants.run [--count N] [--room ROOM] [--only WORDS] [--minutes M] [--jobs J] [--seed S]
[--patterns]
Exits 1 where a pattern survived, 2 where one is not found in the code, 3 where the tests of one did not come to their
end and none survived.
"""

from __future__ import annotations

import argparse
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
import venv
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from tests.mutants.changes import ROOT, Mutant, any_of, found, found_in_c, modules
from tests.mutants.nearest import Suite
from tests.mutants.patterns import C_PATTERNS, PATTERNS, SCRIPT_PATTERNS

PLACE = ROOT / "build" / "mutants"
FILES = 14
IN_C = "firmware"
LEAST, MOST = 20.0, 90.0
"""Seconds that the tests of one mutant get at first, whatever the time that is left says."""
LONGEST = 900.0
"""Seconds that tests get which run without a mutant, to measure how long they take."""
MARKS = "not slow and not nightly and not soak and not machine and not realtime"
COMPILING = 90.0
_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+?(?:\[.*?\])?)(?: - .*)?$", re.MULTILINE)


@dataclass(frozen=True)
class Fate:
    """What became of a mutant: the test that noticed it ("" for none), and whether its tests came to their end."""

    mutant: Mutant
    by: str
    seconds: float
    finished: bool = True

    @property
    def survived(self) -> bool:
        """True if its tests came to their end, and none noticed it."""
        return self.finished and not self.by

    def __str__(self) -> str:
        word = f"noticed by {self.by}" if self.by else "SURVIVED" if self.survived else "its tests RAN OUT OF TIME"
        return f"{self.seconds:5.1f} s  {self.mutant}\n         {word}"


@dataclass(frozen=True)
class Ran:
    """A run of pytest: its exit code (None: its time was over), what it printed, and how long it took."""

    code: int | None
    output: str
    seconds: float

    @property
    def failed(self) -> bool:
        """True if a test failed, or the run itself."""
        return self.code not in (0, None, 5)


class Copy:
    """A copy of the checkout, and a Python that takes the package from there and all else from this environment."""

    def __init__(self, number: int, place: Path = PLACE) -> None:
        self.folder = place / f"copy{number}"
        self.python = place / f"python{number}" / "bin" / "python"
        shutil.rmtree(self.folder, ignore_errors=True)
        shutil.rmtree(self.python.parents[1], ignore_errors=True)
        listed = subprocess.run(
            ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            cwd=ROOT,
            capture_output=True,
            check=True,
        ).stdout.decode()
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (self.folder / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, self.folder / name)
        venv.create(self.python.parents[1], symlinks=True)
        (site,) = self.python.parents[1].glob("lib/python*/site-packages")
        usual = next(path for path in sys.path if path.endswith("site-packages"))
        (site / "a_copy.pth").write_text(f"{self.folder}\n")  # before what is installed, and no .pth of there counts
        (site / "b_usual.pth").write_text(f"{usual}\n")
        self._moment = int(time.time()) - 1_000_000

    def run(self, words: list[str], seconds: float) -> Ran:
        """Run pytest for at most so many seconds."""
        began = time.monotonic()
        longest = "150" if any(word.startswith("tests/firmware/") for word in words) else "40"  # it compiles
        command = [str(self.python), "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist",
                   "--hypothesis-profile", "quick", "--timeout", longest, "-m", MARKS, *words]  # fmt: skip
        running = subprocess.Popen(
            command, cwd=self.folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            start_new_session=True, env=os.environ | {"PYTHONDONTWRITEBYTECODE": "1"}, text=True,
        )  # fmt: skip
        try:
            output, _ = running.communicate(timeout=seconds)
        except subprocess.TimeoutExpired:
            with suppress(ProcessLookupError):
                os.killpg(running.pid, signal.SIGTERM)
            try:
                output, _ = running.communicate(timeout=20)
            except subprocess.TimeoutExpired:
                os.killpg(running.pid, signal.SIGKILL)
                output, _ = running.communicate()
            return Ran(None, output, time.monotonic() - began)
        return Ran(running.returncode, output, time.monotonic() - began)

    def put(self, name: str, source: str) -> None:
        """Write a module, so that no compiled form of another text can pass for it."""
        path = self.folder / name
        path.write_text(source)
        if path.suffix != ".py":  # make compares times: what was written now is compiled
            return
        self._moment += 2
        os.utime(path, (self._moment, self._moment))
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()


class Bench:
    """Tries mutants, each in the copy that is free."""

    def __init__(self, copies: Sequence[Copy], until: float, sources: dict[str, str], tests: Suite) -> None:
        """``sources`` are the texts that the mutants were cut from; the checkout may change meanwhile."""
        self._sources = sources
        self._tests, self._until, self._jobs = tests, until, len(copies)
        self._copies: SimpleQueue[Copy] = SimpleQueue()
        self._good: set[str] = set()
        self._bad: set[str] = set()
        self._needed: dict[tuple[str, ...], float] = {}
        self._told = threading.Lock()
        self.left = 0
        for copy in copies:
            self._copies.put(copy)

    def try_one(self, mutant: Mutant) -> Fate | None:
        """Whether the nearest tests notice a mutant; None where the time is over."""
        if time.monotonic() > self._until:
            return None
        copy = self._copies.get()
        began = time.monotonic()
        share = (self._until - began) * self._jobs / max(1, self.left) * 2  # half of them end at once
        try:
            files = self._tests.nearest(mutant, FILES)
            seconds = MOST if mutant.rule else min(MOST, max(LEAST, share))
            whole = seconds == MOST
            seconds += COMPILING if mutant.test.startswith("tests/firmware/") else 0
            by, finished = self._noticed(copy, mutant, files, seconds)
            if whole and not finished and (enough := 2 * self._needed_without(copy, mutant, files)) > seconds:
                by, finished = self._noticed(copy, mutant, files, enough)
        finally:
            copy.put(mutant.path, self._sources[mutant.path])
            self._copies.put(copy)
        fate = Fate(mutant, by, time.monotonic() - began, finished)
        with self._told:
            self.left -= 1
            print(fate, flush=True)
        return fate

    def _noticed(self, copy: Copy, mutant: Mutant, files: list[str], seconds: float) -> tuple[str, bool]:
        """Return the test that notices a mutant, "" for none, and whether the tests came to their end."""
        source = self._sources[mutant.path]
        last = time.monotonic() + seconds
        while True:
            copy.put(mutant.path, mutant.applied(source))
            ran = copy.run(["-x", *self._without_bad(), *files], max(1.0, last - time.monotonic()))
            if not ran.failed:
                return "", ran.code is not None
            by = (_FAILED.findall(ran.output) or ["(the run itself)"])[-1]
            copy.put(mutant.path, source)
            if by in self._bad:  # pytest knows it by another name, and cannot leave it out
                return "", False
            if not by.startswith("tests/") or self._is_good(copy, by):
                return by, True
            # it fails by itself: the others shall say

    def _needed_without(self, copy: Copy, mutant: Mutant, files: list[str]) -> float:
        """Return how many seconds the tests take without the mutant; measured once for each set of them."""
        if tuple(files) not in self._needed:
            copy.put(mutant.path, self._sources[mutant.path])
            self._needed[tuple(files)] = copy.run([*self._without_bad(), *files], LONGEST).seconds
        return self._needed[tuple(files)]

    def _without_bad(self) -> list[str]:
        return [word for test in self._bad for word in ("--deselect" if "::" in test else "--ignore", test)]

    def _is_good(self, copy: Copy, test: str) -> bool:
        if test in self._good:
            return True
        good = copy.run(["-x", test], LONGEST).code == 0
        (self._good if good else self._bad).add(test)
        if not good:
            print(f"         without any mutant {test} fails too: left out from now on", flush=True)
        return good


def among(named: list[Mutant], most: int, chance: random.Random) -> list[Mutant]:
    """Return the rules' mutants, or ``most`` of them by chance: of each room, in C and in scripts, as they are many."""
    return named if len(named) <= most else chance.sample(named, most)


def drawn(count: int, room: str, chance: random.Random) -> list[Mutant]:
    """Random mutants: a module by its weight, then any of it; none twice."""
    every = [mutant for module in modules(room) for mutant in any_of(module)]
    return chance.sample(every, min(count, len(every)))


def main(arguments: list[str]) -> int:
    """Run the bench."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=300, help="patterns and random ones together")
    parser.add_argument(
        "--room", default="", help="a room or a module: steps, protocol/tim, provisioning/agree.py; firmware"
    )
    parser.add_argument(
        "--only", default="", help="a function: every mutant of it, and its patterns; or a part of a pattern's rule"
    )
    parser.add_argument("--minutes", type=float, default=60)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--seed", type=int, default=0, help="0: another sample each time, told")
    parser.add_argument("--patterns", action="store_true", help="no random ones")
    chosen = parser.parse_args(arguments)
    seed = chosen.seed or random.SystemRandom().randrange(1, 100_000)
    where = [] if chosen.room == IN_C else modules(chosen.room)
    everywhere = where if not chosen.room else modules()
    lost = [
        f"{pattern.function}: {pattern.was} is not there once ({pattern.rule})"
        for pattern in PATTERNS
        if len(found(pattern, everywhere)) != 1
    ] + [
        f"{pattern.file}: {pattern.was} is not there once ({pattern.rule})"
        for pattern in (*C_PATTERNS, *SCRIPT_PATTERNS)
        if len(found_in_c(pattern)) != 1
    ]
    if lost:
        print("\n".join(lost), file=sys.stderr)
        return 2
    named = [mutant for pattern in PATTERNS for mutant in found(pattern, where)]
    if chosen.room in ("", IN_C):
        named += [mutant for pattern in C_PATTERNS for mutant in found_in_c(pattern)]
    if chosen.room in ("", "ncap", "ncap/page"):
        named += [mutant for pattern in SCRIPT_PATTERNS for mutant in found_in_c(pattern)]
    chance, without_random = random.Random(seed), chosen.patterns or chosen.room == IN_C
    if not chosen.only:
        named = among(named, chosen.count if without_random else chosen.count // 2, chance)
    others = [] if without_random else drawn(max(0, chosen.count - len(named)), chosen.room, chance)
    if chosen.only:
        named = [mutant for mutant in named if chosen.only == mutant.function or chosen.only in mutant.rule]
        every = [] if chosen.patterns else [mutant for module in where for mutant in any_of(module)]
        others = [mutant for mutant in every if chosen.only in (mutant.function, mutant.function.rpartition(".")[2])]
    sources = {module.name: module.source for module in everywhere}
    sources |= {mutant.path: (ROOT / mutant.path).read_text() for mutant in named if mutant.path not in sources}
    PLACE.mkdir(parents=True, exist_ok=True)
    copies = [Copy(number) for number in range(chosen.jobs)]
    bench = Bench(copies, time.monotonic() + 60 * chosen.minutes, sources, Suite())
    bench.left = len(named) + len(others)
    print(f"{len(named)} patterns, {len(others)} random ones (--seed {seed})", flush=True)
    with ThreadPoolExecutor(chosen.jobs) as pool:
        fates = [fate for fate in pool.map(bench.try_one, [*named, *others]) if fate is not None]
    return report(fates, len(named) + len(others), PLACE)


def report(fates: list[Fate], wanted: int, place: Path) -> int:
    """Print and keep what no test noticed, and apart from it what is not known; return the exit code."""
    survivors = [fate for fate in fates if fate.survived]
    unfinished = [fate for fate in fates if not fate.finished]
    noticed = len(fates) - len(survivors) - len(unfinished)
    print(f"\n{len(fates)} of {wanted} tried, {noticed} noticed, {len(unfinished)} ran out of time; survivors:")
    _list(survivors, place / "survivors.txt")
    print("Ran out of time, so nothing is known of them:")
    _list(unfinished, place / "unfinished.txt")
    if any(fate.mutant.rule for fate in survivors):
        return 1
    return 3 if any(fate.mutant.rule for fate in unfinished) else 0


def _list(fates: list[Fate], file: Path) -> None:
    lines = [str(fate.mutant) for fate in fates]
    file.write_text("".join(f"{line}\n" for line in lines))
    rooms = Counter("/".join(fate.mutant.path.split("/")[:2]) for fate in fates)
    print("".join(f"  {line}\n" for line in lines), end="")
    print("  by room: " + ", ".join(f"{room} {count}" for room, count in rooms.most_common()) if rooms else "  none")


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
