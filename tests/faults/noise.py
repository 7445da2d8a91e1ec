"""What the cuts do not show: many processes on one store, and a bus whose frames meet with faults."""

from __future__ import annotations

import json
import subprocess
from concurrent.futures import ThreadPoolExecutor
from functools import partial

from tests.e2e.desk import ANGLE
from tests.faults.acts import ACTS, UUID
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
            done = list(pool.map(lambda each: desk.run(*each), words))
        failed = [f"{run.returncode}: {run.stdout[-200:]}" for run in done if run.returncode]
        listed = desk.run("whitelist", "list").stdout
        missing = [uuid for uuid in [*others, UUID] if uuid not in listed]
        log = json.loads(desk.run("log").stdout)
    return "; ".join(failed + missing + ([] if log["intact"] else ["the audit log does not hold"]))


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
            told = " ".join(f"{kind} {share:.0%}" for kind, share in shares.items())
            print(f"frames on CAN, {told}: tries {tries}", *(f"LOST {said}" for _, said in found if said), flush=True)
    return lost
