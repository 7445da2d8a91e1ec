"""What the cuts do not show: many processes on one store, two commands at once, a bus whose frames meet with faults."""

from __future__ import annotations

import itertools
import json
import random
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from tests.e2e.desk import ANGLE
from tests.faults.acts import ACTS, MIXED, UUID, Act
from tests.faults.trials import Bench

NOISE = (
    {"loss": 0.01},
    {"loss": 0.03},
    {"double": 0.1},
    {"swap": 0.1},
    {"delay": 0.1},
    {"corrupt": 0.1},
    {"double": 0.05, "swap": 0.02},
    {"delay": 0.02, "corrupt": 0.02},
    {"loss": 0.1, "double": 0.02, "swap": 0.02, "delay": 0.02, "corrupt": 0.02},
)
TRIES = 3


def crowd(bench: Bench, processes: int = 8) -> str:
    """Many processes change one store at once, one of them provisions: the complaint, or nothing."""
    act = next(act for act in ACTS if act.name == "provision")
    with bench.desk(act) as desk, desk.node():
        others = [f"{number:02x}" * 10 for number in range(1, processes)]
        words = [("whitelist", "add", uuid) for uuid in others] + [act.words]
        with ThreadPoolExecutor(processes) as pool:
            done = list(pool.map(lambda item: desk.run(*item), words))
        failed = [f"{run.returncode}: {run.stdout[-200:]}" for run in done if run.returncode]
        listed = desk.run("whitelist", "list").stdout
        missing = [uuid for uuid in [*others, UUID] if uuid not in listed]
        log = json.loads(desk.run("log").stdout)
    return "; ".join(failed + missing + ([] if log["intact"] else ["the audit log does not hold"]))


TOLD = (0, 3, 4, 5, 6, 7)
"""How a command may end beside another one that changes what it works on; 1, 2 and 8 are no answers to that."""
_WRITE_KEYS = ("rewrap", "passphrase", "merge", "rotate")
_TAKES = ("reset", "move", "revoke", "decommission")


def pair(bench: Bench, command: Act, other: Act) -> str:
    """Two commands at once, then each once more alone: every key opens, the log holds, nothing of either is lost."""
    with bench.desk(command) as desk, desk.node():
        both = (command, other)
        with ThreadPoolExecutor(2) as pool:
            done = list(pool.map(lambda act: desk.run(*act.words, until=act.until, seconds=150), both))
        failures = [f"{act.name} {run.returncode} {run.stdout[-200:]}{run.stderr[-200:]}"
                for act, run in zip(both, done, strict=True) if run.buggy or run.returncode not in TOLD]  # fmt: skip
        takes = any(act.name in _TAKES for act in both)
        for act, first in zip(both, done, strict=True):
            again = desk.run(*act.words, until=act.until, seconds=150)
            if again.buggy or again.returncode not in (TOLD if takes or first.returncode else act.ends):
                failures.append(f"{act.name} again {again.returncode} {again.stdout[-200:]}{again.stderr[-200:]}")
        opened = desk.run("vault", "rewrap", "--yes")  # unwraps every key, or fails
        if opened.returncode:
            failures.append(f"not every key opens: {opened.returncode} {opened.stdout[-300:]}{opened.stderr[-200:]}")
        if not json.loads(desk.run("log").stdout or '{"intact": false}')["intact"]:
            failures.append("the audit log does not hold")
        if not takes:
            verified = desk.run("verify", UUID, "LINK")
            if verified.returncode not in (*command.verdicts, *other.verdicts):
                failures.append(f"verify {verified.returncode}: {verified.stdout[-300:]}")
    return "; ".join(failures)


def pairs(bench: Bench, share: random.Random, *, count: int, jobs: int, until: float | None) -> int:
    """Pairs of all changing commands, two at once: ``count`` of them, or all (0); prints; how many lost something.

    Those that write keys or the vault are tried again and again.
    """
    every = list(itertools.combinations_with_replacement(MIXED, 2))
    chosen = share.sample(every, count) if count else list(every)
    vault = [act for act in MIXED if act.name in _WRITE_KEYS]
    chosen += 3 * list(
        itertools.permutations(vault, 2)
    )  # who is first by how much decides: one try in six lost all once

    def run_pair(two: tuple[Act, Act]) -> str | None:
        if until is not None and time.monotonic() > until:
            return None
        try:
            return pair(bench, *two)
        except Exception as error:  # noqa: BLE001  a pair that breaks is a finding, not the end of the bench
            return f"the trial itself failed: {type(error).__name__}: {error}"

    with ThreadPoolExecutor(jobs) as pool:
        failures = list(pool.map(run_pair, chosen))
    found = [(two, complaint) for two, complaint in zip(chosen, failures, strict=True) if complaint]
    for (first, second), complaint in found:
        print(f"LOST  {first.name} beside {second.name}: {complaint}", flush=True)
    tried = sum(complaint is not None for complaint in failures)
    print(f"two commands at once: {len(every)} pairs, tried {tried} times, lost {len(found)}", flush=True)
    return len(found)


def noise(bench: Bench, shares: dict[str, float], seed: int) -> tuple[int, str]:
    """Provision a node over a bus whose frames meet with faults: tries that it took (at most three), the complaint.

    A try ends well or with 5 (link). Octets changed unseen, which CAN's own checksum keeps from a real bus, may also
    look like another node or a refusal (4, 6, 8): outside a session nothing tells them apart. Nothing may be lost, and
    the same command without noise finishes.
    """
    allowed = (0, 4, 5, 6, 8) if "corrupt" in shares else (0, 5)
    act = next(act for act in ACTS if act.name == "provision")
    with bench.desk(act) as desk, desk.node(nfc=False):
        place = desk.links.can.replace("udp_multicast:", "lossy:") + "&under=udp_multicast"
        place += "".join(f"&{kind}={share}" for kind, share in shares.items()) + f"&seed={seed}"
        words = ("provision", "--profile", ANGLE, "--yes", "--via", "can", "--timeout", "20")
        for number in range(1, TRIES + 1):
            try:
                done = desk.run(*words, "--can", place, module="tests.links.can.lossy", seconds=240)
            except subprocess.TimeoutExpired:
                return number, "the command hangs"
            if done.buggy or done.returncode not in allowed:
                return number, f"{done.returncode} {done.stdout[-300:]}{done.stderr[-300:]}"
            if done.returncode == 0:
                break
        tries = number if done.returncode == 0 else TRIES + 1
        done = desk.run(*words, "LINK")
        verified = desk.run("verify", UUID, "LINK")
        if done.returncode or verified.returncode:
            return tries, f"without noise {done.returncode}, verify {verified.returncode}"
        return tries, ""


def noisy(bench: Bench, seeds: int, jobs: int) -> int:
    """Every kind of noise with some seeds; prints how many tries each took; how many ended in a loss."""
    lost = 0
    with ThreadPoolExecutor(4 * jobs) as pool:  # most of each is waiting for what was lost
        runs = [(shares, pool.map(partial(noise, bench, shares), range(seeds))) for shares in NOISE]
        for shares, results in runs:
            found = list(results)
            lost += sum(bool(complaint) for _, complaint in found)
            tries = ", ".join(str(tries) if tries <= TRIES else f"more than {TRIES}" for tries, _ in found)
            description = " ".join(f"{kind} {share:.0%}" for kind, share in shares.items())
            print(
                f"frames on CAN, {description}: tries {tries}",
                *(f"LOST {failure}" for _, failure in found if failure),
                flush=True,
            )
    return lost
