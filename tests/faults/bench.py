"""A fault bench for the shipped command: cuts at every durable write and message, failing disks, and what is left then.

What one trial does stands in trials.py. This takes every cut of every changing command, of station and node, with and
without loss of power, and a share of the failing calls (``--full``: all of them), many processes on one store, two
different commands at once (a share of all pairs), backups of 100,000 nodes cut and merged, frames that are lost,
doubled, swapped, late or corrupted, and a control: a disk that ignores fsync must lose something.

Usage: python -m tests.faults.bench [--full] [--quick [--pairs] [--large]] [--only NAME] [--jobs N] [--minutes M]
Prints tried, healed and lost per command, and the words of everything that was lost; exits 1 where anything was lost or
the control lost nothing.
"""

from __future__ import annotations

import argparse
import os
import random
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext

from tests.faults.acts import ACTS, LARGE, UUID, Act
from tests.faults.disk import put_back
from tests.faults.noise import crowd, noisy, pairs
from tests.faults.trials import Bench, Fault, Trial

ERRORS = ("ENOSPC", "EIO", "EROFS", "EDQUOT")
SHARE = 8  # one of so many failing calls is tried, unless all are
PAIRS = 80  # of 276, unless all are
FEW = 4
WAITING = 24  # trials of a cut node that wait for a time-out beside those that work


def cuts_of(count: int) -> Iterator[Fault]:
    """Yield a cut at each of ``count`` changes: as it is, with the power lost, and in the middle of the write."""
    for at in range(1, count + 1):
        yield from (Fault(at), Fault(at, power=True), Fault(at, "torn"))


def errors_of(count: int, share: random.Random, *, full: bool) -> list[Fault]:
    """Return every way in which each of ``count`` changes may fail, once or from then on: all, or a share of them."""
    errors = [Fault(at, how, stays) for at in range(1, count + 1) for how in ERRORS for stays in (False, True)]
    return errors if full else share.sample(errors, min(len(errors), max(4, len(errors) // SHARE)))


def trials_of(bench: Bench, act: Act, share: random.Random, *, full: bool) -> list[Trial]:
    """Return all trials of one command."""
    station = [*cuts_of(bench.count(act)), *errors_of(bench.count(act, "EIO"), share, full=full)]
    node: list[Fault] = []
    if act.node and act.cuts_node:
        node = [*cuts_of(bench.node_count(act)), *errors_of(bench.node_count(act, "EIO"), share, full=full)]
    return [Trial(act, fault, on_node=False) for fault in station] + [Trial(act, fault, on_node=True) for fault in node]


def quick_trials_of(bench: Bench, act: Act, share: random.Random) -> list[Trial]:
    """Return a handful, for the test suite: spread over the whole command."""
    cuts = bench.count(act)
    first, last = share.sample(range(1, cuts + 1), 2)
    station = [Fault(first), Fault(last, power=True), Fault(max(1, first // 2), share.choice(ERRORS), stays=True)]
    node: list[Fault] = []
    if act.node and act.cuts_node:
        count = range(1, bench.node_count(act) + 1)
        node = [Fault(share.choice(count)), Fault(share.choice(count), power=True)]
    return [Trial(act, fault, on_node=False) for fault in station] + [Trial(act, fault, on_node=True) for fault in node]


def few_trials_of(bench: Bench, act: Act, share: random.Random) -> list[Trial]:
    """A few cuts of a long command: at its beginning and end, and somewhere between; each with the power lost once."""
    cuts = bench.count(act)
    between = sorted(share.sample(range(2, cuts), min(FEW, max(0, cuts - 2))))
    return [Trial(act, Fault(at, power=n % 2 == 1), on_node=False) for n, at in enumerate((1, *between, cuts))]


def control(bench: Bench) -> int:
    """Return how many losses of power after ``whitelist add`` and ``agree`` lose something where fsync does nothing."""
    lost = 0
    for act in (ACTS[0], ACTS[2]):
        cuts = bench.count(act)
        with bench.desk(act) as desk, desk.node() if act.node else nullcontext():
            fault = Fault(cuts + 100, power=True, ignore_fsync=True)  # nothing is cut: done, then the power goes
            desk.run(*act.words, home=act.home, fault=fault.environment(bench.library, desk, act.home))
            put_back(desk.folder / "shadow", desk.folder / act.home)
            outcome = desk.run("whitelist", "list") if act is ACTS[0] else desk.run("nodes", UUID)
            known = UUID in outcome.stdout and (act is ACTS[0] or '"epoch": 1' in outcome.stdout)
            lost += outcome.returncode != 0 or not known
    return lost


def main(arguments: list[str]) -> int:
    """Run the bench; 0 where nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="every error at every change, not a share")
    parser.add_argument("--quick", action="store_true", help="a handful per command, about a minute")
    parser.add_argument("--pairs", action="store_true", help="with --quick: all pairs of commands too")
    parser.add_argument("--large", action="store_true", help="with --quick: the backups of 100,000 nodes too")
    parser.add_argument("--only", action="append", default=[], metavar="NAME")
    parser.add_argument("--jobs", type=int, default=2 * (os.cpu_count() or 1), help="trials at a time")
    parser.add_argument("--minutes", type=float, default=0, help="stop after so many minutes")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args(arguments)
    until = time.monotonic() + chosen.minutes * 60 if chosen.minutes else None
    share = random.Random(chosen.seed)
    with Bench.open(chosen.jobs) as bench:
        acts = [act for act in ACTS if not chosen.only or act.name in chosen.only]
        work: list[Trial] = []
        for act in acts:
            work += (
                quick_trials_of(bench, act, share) if chosen.quick else trials_of(bench, act, share, full=chosen.full)
            )
        lost = 0
        if chosen.pairs or not chosen.quick:
            count = 0 if chosen.full or chosen.pairs else PAIRS
            lost += pairs(bench, share, count=count, jobs=chosen.jobs, until=None)
        lost += run_all(bench, work, chosen.jobs, until)
        complaint = crowd(bench)
        print(f"8 processes on one store: {complaint or 'all done, nothing lost'}")
        lost += bool(complaint)
        if chosen.large or not chosen.quick:
            large = [trial for act in LARGE for trial in few_trials_of(bench, act, share)]
            lost += run_all(bench, large, 1, None)
        if not chosen.quick:
            lost += noisy(bench, seeds=4 if chosen.full else 2, jobs=chosen.jobs)
        seen = control(bench)
    print(f"control, a disk that ignores fsync: {seen} of 2 lost")
    if not seen:
        print("CONTROL FAILED: a disk that ignores fsync lost nothing, so this bench sees nothing")
    return 1 if lost or not seen else 0


def run_all(bench: Bench, work: list[Trial], jobs: int, until: float | None) -> int:
    """Run every trial until the time is over; prints what was lost and the sums; how many were lost."""
    tried: Counter[str] = Counter()
    lost: Counter[str] = Counter()
    began = time.monotonic()

    def run_trial(trial: Trial) -> None:
        if until is not None and time.monotonic() > until:
            return
        try:
            complaint = bench.run(trial)
        except Exception as error:  # noqa: BLE001  a trial that breaks is a finding, not the end of the bench
            complaint = f"the trial itself failed: {type(error).__name__}: {error}"
        name = trial.act.name + (" (node)" if trial.on_node else "")
        tried[name] += 1
        if complaint:
            lost[name] += 1
            print(f"LOST  {trial}: {complaint}", flush=True)
        if (done := tried.total()) % 500 == 0:
            rate = done / (time.monotonic() - began)
            print(f"… {done} of {len(work)}, {rate:.1f} a second, lost {lost.total()}", file=sys.stderr, flush=True)

    random.Random(2).shuffle(work)
    with ThreadPoolExecutor(jobs + WAITING) as pool:
        list(pool.map(run_trial, work))
    for name in sorted(tried):
        print(f"{name}: tried {tried[name]}, healed {tried[name] - lost[name]}, lost {lost[name]}")
    seconds, all_tried, all_lost = time.monotonic() - began, tried.total(), lost.total()
    print(f"all: tried {all_tried} of {len(work)}, healed {all_tried - all_lost}, lost {all_lost}, in {seconds:.0f} s")
    return all_lost


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
