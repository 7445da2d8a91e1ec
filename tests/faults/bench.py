"""A fault bench for the shipped command: cuts at every durable write and message, failing disks, and what is left then.

Each trial copies a station and a node into a folder of its own, runs one changing command with one fault in it (cut.c),
takes the disk as the program left it or as it was at the last fsync, runs the same command again without a fault, and
then asks: does the command end well, is the node authentic, did no epoch and no sequence go back?

Usage: python -m tests.faults.bench [--full] [--quick] [--only NAME] [--jobs N] [--minutes M]
Prints tried, healed and lost per command, and the words of everything that was lost; exits 1 where anything was lost or
the control (a disk that ignores fsync) lost nothing.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import THROWAWAY
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, Links, Running
from tests.faults.disk import build_library, put_back

ROOT = Path(__file__).resolve().parents[2]
PASSPHRASE = "correct horse battery"
UUID = "8d4d9da65281f7000000"
ERRORS = ("ENOSPC", "EIO", "EROFS", "EDQUOT")


@dataclass(frozen=True)
class Desk:
    """One folder with a station (``home``), another (``other``), a node's flash and the files that go to and fro."""

    folder: Path
    links: Links = field(default_factory=Links)

    @property
    def home(self) -> Path:
        return self.folder / "home"

    def words(self, words: tuple[str, ...]) -> list[str]:
        """A command line with the places of this desk put in."""
        files = self.folder / "files"
        bundle = files / "bundle.id"
        places = {"FILES": str(files), "UUID": UUID, "ID": bundle.read_text() if bundle.exists() else ""}
        result: list[str] = []
        for word in words:
            if word == "LINK":
                result += self.links.over("can")
            elif word == "TAP":
                result += self.links.over("nfc")
            else:
                result.append(re.sub(r"\{(\w+)\}", lambda found: places.get(found[1], found[0]), word))
        return result

    def run(
        self,
        *words: str,
        home: str = "home",
        fault: dict[str, str] | None = None,
        seconds: float = 60,
        module: str = "teds_provision",
    ) -> subprocess.CompletedProcess[str]:
        """Run one command of a station of this desk to its end."""
        read, write = os.pipe()
        os.write(write, PASSPHRASE.encode() + b"\n")
        os.close(write)
        second, write = os.pipe()
        os.write(write, PASSPHRASE.encode() + b"\n")
        os.close(write)
        words = tuple(word.replace("{FD}", str(second)) for word in words)
        command = [sys.executable, "-m", module, "--home", str(self.folder / home), "--json"]
        try:
            return subprocess.run(
                [*command, "--passphrase-fd", str(read), *self.words(words)],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                pass_fds=(read, second),
                env=clean_environment() | (fault or {}),
                cwd=ROOT,
                timeout=seconds,
                check=False,
            )
        finally:
            os.close(read)
            os.close(second)

    @contextmanager
    def node(self, fault: dict[str, str] | None = None) -> Iterator[Running]:
        """The virtual node of this desk, on its reader and its bus."""
        links = ("--nfc", self.links.nfc, "--can", self.links.can)
        words = ("--json", "--debug", "node", "run", self.folder / "flash", *links)
        running = Running(*words, environment=clean_environment() | (fault or {}))
        try:
            running.wait_for('"ready": true')
            yield running
        finally:
            running.process.send_signal(signal.SIGKILL)
            running.process.wait()
            for stream in (running.process.stdout, running.process.stderr):
                if stream is not None:
                    stream.close()


@dataclass(frozen=True)
class Act:
    """A changing command: from which state it starts, and what must be true when it was carried on after a cut.

    ``ends`` are the exit codes with which carrying on may end. ``proof`` is the station that must then have the node
    in its hands (none: the command gives it away), ``verdicts`` the exit codes of ``verify`` that count: 0 authentic,
    4 for a node without a datasheet; 5 and 6 mean a lost key.
    """

    name: str
    start: str
    words: tuple[str, ...]
    node: bool = True
    home: str = "home"
    ends: tuple[int, ...] = (0,)
    proof: str = "home"
    verdicts: tuple[int, ...] = (0,)


NO_SHEET = (0, 4)
ACTS = (
    Act("whitelist add", "new", ("whitelist", "add", "{UUID}"), node=False, proof=""),
    Act("identify", "new", ("identify", "--add", "TAP"), proof=""),
    Act("agree", "listed", ("agree", "{UUID}", "TAP"), verdicts=NO_SHEET),
    Act("build", "keyed", ("build", "{UUID}", "--profile", ANGLE), node=False, verdicts=NO_SHEET),
    Act("sign", "built", ("sign", "{UUID}"), node=False, verdicts=NO_SHEET),
    Act("write", "signed", ("write", "{UUID}", "LINK")),
    Act("provision", "new", ("provision", "--profile", ANGLE, "--yes", "TAP")),
    Act("rotate", "provisioned", ("agree", "{UUID}", "--rotate", "LINK"), verdicts=NO_SHEET),
    Act("address", "provisioned", ("address", "{UUID}", "33", "LINK")),
    Act("reset", "provisioned", ("reset", "{UUID}", "--yes", "LINK"), proof=""),
    Act("trust add", "strangers", ("trust", "add", "crane", "{FILES}/crane.pem", "--yes"), node=False),
    Act("copy", "pair", ("export-keys", "--to", "crane", "--all", "--yes", "--output", "{FILES}/c.jwe"), node=False),
    Act(
        "move",
        "pair",
        ("export-keys", "--to", "crane", "--all", "--mode", "move", "--yes", "--output", "{FILES}/m.jwe"),
        node=False,
        proof="",
    ),
    Act(
        "import",
        "bundled",
        ("import-keys", "{FILES}/bundle.jwe", "--yes", "--no-prove"),
        node=False,
        home="other",
        proof="other",
    ),
    Act("receipt", "imported", ("handover", "receipt", "{FILES}/receipt.jws"), node=False, proof="other"),
    Act("undo", "bundled", ("handover", "undo", "{ID}", "--yes"), node=False),
    Act("backup", "provisioned", ("backup", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes"), node=False),
    Act(
        "restore",
        "backed up",
        ("restore", "{FILES}/backup", "--keystore", "file", "--backup-passphrase-fd", "{FD}", "--yes"),
        node=False,
        home="fresh",
        proof="",
    ),
    Act("revoke", "provisioned", ("revoke", "{UUID}", "--why", "lost", "--yes"), node=False, proof=""),
    Act("rewrap", "provisioned", ("vault", "rewrap", "--yes"), node=False),
    Act("decommission", "provisioned", ("decommission", "{UUID}", "--yes", "LINK"), proof=""),
)

NEXT: dict[str, tuple[str, tuple[tuple[str, tuple[str, ...]], ...]]] = {
    # state: (from which, ((station, words), ...)); "new" is made by hand
    "listed": ("new", (("home", ("whitelist", "add", "{UUID}")),)),
    "keyed": ("listed", (("home", ("agree", "{UUID}", "TAP")),)),
    "built": ("keyed", (("home", ("build", "{UUID}", "--profile", ANGLE)),)),
    "signed": ("built", (("home", ("sign", "{UUID}")),)),
    "provisioned": ("new", (("home", ("provision", "--profile", ANGLE, "--yes", "TAP")),)),
    "strangers": ("provisioned", (("other", ("trust", "add", "bench", "{FILES}/bench.pem", "--yes")),)),
    "pair": ("strangers", (("home", ("trust", "add", "crane", "{FILES}/crane.pem", "--yes")),)),
    "bundled": (
        "pair",
        (
            (
                "home",
                ("export-keys", "--to", "crane", "--all", "--mode", "move", "--yes", "--output", "{FILES}/bundle.jwe"),
            ),
        ),
    ),
    "imported": (
        "bundled",
        (("other", ("import-keys", "{FILES}/bundle.jwe", "--yes", "--receipt", "{FILES}/receipt.jws", "TAP")),),
    ),
    "backed up": ("provisioned", (("home", ("backup", "{FILES}/backup", "--backup-passphrase-fd", "{FD}", "--yes")),)),
}


class States:
    """The states from which commands start: each made once, copied for every trial."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def of(self, name: str) -> Path:
        """The folder of a state, made at first need."""
        place = self.folder / name.replace(" ", "-")
        if place.is_dir():
            return place
        made = place.with_suffix(".new")
        if name == "new":
            _new_desk(made)
        else:
            before, steps = NEXT[name]
            shutil.copytree(self.of(before), made)
            desk = Desk(made)
            with desk.node():
                for station, words in steps:
                    done = desk.run(*words, home=station)
                    assert done.returncode == 0, f"{name}: {words}: {done.stdout}{done.stderr}"
                    if words[0] == "export-keys":
                        (made / "files" / "bundle.id").write_text(json.loads(done.stdout)["id"])
        if name == "backed up":
            (made / "fresh").mkdir(mode=0o700)
        made.rename(place)
        return place


def _new_desk(folder: Path) -> None:
    folder.mkdir()
    (folder / "files").mkdir()
    for home, name in (("home", "bench"), ("other", "crane")):
        station, _ = initialise(
            folder / home, name=name, keystore="file", ask=lambda prompt, confirm=False: PASSPHRASE, costs=THROWAWAY
        )
        station.close()
        told = json.loads(Desk(folder).run("init", home=home).stdout)
        (folder / "files" / f"{name}.pem").write_text(told["public_key"])
    subprocess.run(
        [sys.executable, "-m", "teds_provision", "node", "create", str(folder / "flash"), "--uuid", UUID],
        check=True,
        capture_output=True,
        env=clean_environment(),
        cwd=ROOT,
    )


@dataclass(frozen=True)
class Fault:
    """One fault: at which change, how, whose disk; ``power``: afterwards the disk is as at the last fsync."""

    at: int
    how: str = "kill"
    stays: bool = False
    power: bool = False
    ignore_fsync: bool = False

    def __str__(self) -> str:
        extra = " (and from then on)" if self.stays else ", power lost" if self.power else ""
        return f"{self.how} at {self.at}{extra}"

    def environment(self, library: Path, desk: Desk, *places: str) -> dict[str, str]:
        """What cut.c reads; ``places`` are the folders of the desk whose changes count."""
        chosen = {
            "LD_PRELOAD": str(library),
            "FAULT_ROOTS": ":".join(str(desk.folder / place) for place in places),
            "FAULT_AT": str(self.at),
            "FAULT_HOW": self.how,
            "FAULT_COUNT": str(desk.folder / "count"),
        }
        if self.stays:
            chosen["FAULT_STAYS"] = "1"
        if self.power:
            (desk.folder / "shadow").mkdir(exist_ok=True)
            chosen["FAULT_SHADOW"] = str(desk.folder / "shadow")
        if self.ignore_fsync:
            chosen["FAULT_NOSYNC"] = "1"
        return chosen


class Bench:
    """Runs trials of acts."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.library = build_library(folder)
        (folder / "states").mkdir()
        self.states = States(folder / "states")

    @contextmanager
    def desk(self, act: Act) -> Iterator[Desk]:
        """A copy of the act's starting state; goes when the trial is over."""
        place = Path(tempfile.mkdtemp(dir=self.folder)) / "desk"
        shutil.copytree(self.states.of(act.start), place)
        try:
            yield Desk(place)
        finally:
            shutil.rmtree(place.parent, ignore_errors=True)

    def count(self, act: Act, how: str = "kill") -> int:
        """How many changes and messages the whole command makes."""
        with self.desk(act) as desk, _maybe_node(desk, act):
            done = desk.run(
                *act.words, home=act.home, fault=Fault(0, how).environment(self.library, desk, act.home, "files")
            )
            assert done.returncode in act.ends, f"{act.name} fails without any fault: {done.stdout}{done.stderr}"
            return int.from_bytes((desk.folder / "count").read_bytes()[:8], sys.byteorder)

    def trial(self, act: Act, fault: Fault) -> str:
        """Run one trial; the complaint, or nothing where all healed."""
        with self.desk(act) as desk:
            with _maybe_node(desk, act):
                try:
                    first = desk.run(
                        *act.words,
                        home=act.home,
                        fault=fault.environment(self.library, desk, act.home, "files"),
                        seconds=90,
                    )
                except subprocess.TimeoutExpired:
                    return "the command hangs"
                if "Traceback" in first.stderr or first.returncode == 1:
                    return f"a bug: {first.returncode} {first.stdout[-300:]}{first.stderr[-300:]}"
                if fault.power:
                    for root in (desk.folder / act.home, desk.folder / "files"):
                        if root.exists():
                            put_back(desk.folder / "shadow", root)
                again = desk.run(*act.words, home=act.home)
                if again.returncode not in act.ends:
                    said = again.stdout[-400:] + again.stderr[-200:]
                    return f"first {first.returncode}, again {again.returncode}: {said}"
            return self._proof(act, desk)

    def node_count(self, act: Act) -> int:
        """How many changes of its flash, and datagrams, the node makes while the whole command runs."""
        with self.desk(act) as desk:
            with desk.node(Fault(0).environment(self.library, desk, "flash")):
                done = desk.run(*act.words, home=act.home)
                assert done.returncode in act.ends, f"{act.name} fails without any fault: {done.stdout}{done.stderr}"
            return int.from_bytes((desk.folder / "count").read_bytes()[:8], sys.byteorder)

    def node_trial(self, act: Act, fault: Fault) -> str:
        """The same with the fault in the node; it is started anew, and the command runs again."""
        first: subprocess.CompletedProcess[str] | None = None
        with self.desk(act) as desk:
            try:
                with desk.node(fault.environment(self.library, desk, "flash")) as node:
                    first = desk.run(*act.words, "--timeout", "5", home=act.home, seconds=90)
                    if fault.how not in ("kill", "torn") and node.process.poll() is not None:
                        return f"the node died of a failing flash: {node.err[-300:]}"
            except AssertionError:
                pass  # it was cut before it was ready
            if fault.power:
                put_back(desk.folder / "shadow", desk.folder / "flash")
            if first is not None and ("Traceback" in first.stderr or first.returncode == 1):
                return f"a bug: {first.returncode} {first.stdout[-300:]}{first.stderr[-300:]}"
            with desk.node():
                again = desk.run(*act.words, home=act.home)
                if again.returncode not in act.ends:
                    return f"first {first and first.returncode}, again {again.returncode}: {again.stdout[-400:]}"
            return self._proof(act, desk)

    def _proof(self, act: Act, desk: Desk) -> str:
        if not act.proof:
            listed = desk.run("nodes", home=act.home)
            return "" if listed.returncode == 0 else f"nodes: {listed.stdout[-300:]}"
        with desk.node():
            verified = desk.run("verify", UUID, "TAP", home=act.proof)
        if verified.returncode in act.verdicts:
            return ""
        return f"verify {verified.returncode}: {verified.stdout[-400:]}"


@contextmanager
def _maybe_node(desk: Desk, act: Act) -> Iterator[None]:
    if not act.node:
        yield
        return
    with desk.node():
        yield


def faults_of(bench: Bench, act: Act, *, full: bool, share: random.Random) -> list[Fault]:
    """Every cut, every cut with power lost, and the errors: a share of them unless ``full``."""
    cuts = bench.count(act)
    faults = [Fault(at) for at in range(1, cuts + 1)]
    faults += [Fault(at, power=True) for at in range(1, cuts + 1)]
    faults += [Fault(at, "torn", power=False) for at in range(1, cuts + 1)]
    changes = bench.count(act, "EIO")
    errors = [Fault(at, how, stays) for at in range(1, changes + 1) for how in ERRORS for stays in (False, True)]
    return faults + (errors if full else share.sample(errors, max(4, len(errors) // 8)))


def quick_faults(bench: Bench, act: Act, share: random.Random) -> list[Fault]:
    """A handful, for the test suite: spread over the whole command."""
    cuts = bench.count(act)
    at = share.sample(range(1, cuts + 1), min(2, cuts))
    return [Fault(at[0]), Fault(at[-1], power=True), Fault(max(1, at[0] // 2), share.choice(ERRORS), stays=True)]


def node_faults_of(bench: Bench, act: Act, share: random.Random, *, quick: bool) -> list[Fault]:
    """Cuts of the node at every change of its flash and every datagram; a failing flash at a share of them."""
    count = range(1, bench.node_count(act) + 1)
    if quick:
        return [Fault(share.choice(count)), Fault(share.choice(count), power=True)]
    errors = [Fault(at, how) for at in share.sample(count, min(3, len(count))) for how in ("EIO", "ENOSPC")]
    return [Fault(at) for at in count] + [Fault(at, power=True) for at in count] + errors


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


NOISE = (
    {"loss": 0.01},
    {"loss": 0.03},
    {"double": 0.05, "swap": 0.02},
    {"delay": 0.02, "corrupt": 0.02},
    {"loss": 0.1, "double": 0.02, "swap": 0.02, "delay": 0.02, "corrupt": 0.02},
)
TRIES = 3


def noise(bench: Bench, shares: dict[str, float], seed: int) -> tuple[int, str]:
    """Provision a node over a bus whose frames meet with faults: tries that it took (at most three), the complaint.

    Up to 3 % loss three tries must do; beyond that nothing may be lost, and the same command without noise finishes.
    """
    act = next(act for act in ACTS if act.name == "provision")
    with bench.desk(act) as desk:
        node = Running("--json", "node", "run", desk.folder / "flash", "--can", desk.links.can)
        try:
            node.wait_for('"ready": true')
            place = desk.links.can.replace("udp_multicast:", "lossy:") + "&under=udp_multicast"
            place += "".join(f"&{kind}={share}" for kind, share in shares.items()) + f"&seed={seed}"
            words = ("provision", "--profile", ANGLE, "--yes", "--via", "can", "--timeout", "20")
            for number in range(1, TRIES + 1):
                try:
                    done = desk.run(*words, "--can", place, module="tests.links.can.lossy", seconds=240)
                except subprocess.TimeoutExpired:
                    return number, f"{shares}: the command hangs"
                if "Traceback" in done.stderr or done.returncode not in (0, 5):
                    return number, f"{shares}: {done.returncode} {done.stdout[-300:]}{done.stderr[-300:]}"
                if done.returncode == 0:
                    break
            tries = number if done.returncode == 0 else TRIES + 1
            done = desk.run(*words, "LINK")
            verified = desk.run("verify", UUID, "LINK")
            if done.returncode or verified.returncode:
                return tries, f"{shares}: without noise {done.returncode}, verify {verified.returncode}"
            return tries, ""
        finally:
            node.process.kill()
            node.process.wait()


def noisy(bench: Bench, seeds: int) -> int:
    """Every kind of noise with some seeds; prints how many tries each took; how many ended in a loss."""
    lost = 0
    for shares in NOISE:
        results = [noise(bench, shares, seed) for seed in range(seeds)]
        lost += sum(bool(complaint) for _, complaint in results)
        tries = ", ".join(str(tries) if tries <= TRIES else f"more than {TRIES}" for tries, _ in results)
        told = " ".join(f"{kind} {share:.0%}" for kind, share in shares.items())
        print(f"frames on CAN, {told}: tries {tries}", *(f"LOST {said}" for _, said in results if said), flush=True)
    return lost


@dataclass(frozen=True)
class Trial:
    """One fault in one command, in the station or in the node."""

    act: Act
    fault: Fault
    on_node: bool

    def __str__(self) -> str:
        return f"{self.act.name}, {'node ' if self.on_node else ''}{self.fault}"


def trials_of(bench: Bench, act: Act, share: random.Random, *, full: bool, quick: bool) -> list[Trial]:
    """All trials of one command."""
    station = quick_faults(bench, act, share) if quick else faults_of(bench, act, full=full, share=share)
    node = node_faults_of(bench, act, share, quick=quick) if act.node else []
    return [Trial(act, fault, on_node=False) for fault in station] + [Trial(act, fault, on_node=True) for fault in node]


def control(bench: Bench) -> int:
    """How many of the power cuts of ``whitelist add`` and ``agree`` lose something where fsync does nothing."""
    lost = 0
    for act in (ACTS[0], ACTS[2]):
        cuts = bench.count(act)
        for at in (cuts - 1, cuts):
            with bench.desk(act) as desk, _maybe_node(desk, act):
                fault = Fault(at + 1, power=True, ignore_fsync=True)  # nothing is cut: done, then the power goes
                desk.run(*act.words, home=act.home, fault=fault.environment(bench.library, desk, act.home))
                put_back(desk.folder / "shadow", desk.folder / act.home)
                told = desk.run("whitelist", "list") if act is ACTS[0] else desk.run("nodes", UUID)
                known = UUID in told.stdout and (act is ACTS[0] or '"epoch": 1' in told.stdout)
                lost += told.returncode != 0 or not known
    return lost


def main(arguments: list[str]) -> int:
    """Run the bench; 0 where nothing was lost."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="every error at every change, not a share")
    parser.add_argument("--quick", action="store_true", help="a handful per command, about a minute")
    parser.add_argument("--only", action="append", default=[], metavar="NAME")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--minutes", type=float, default=0, help="stop after so many minutes")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args(arguments)
    until = time.monotonic() + chosen.minutes * 60 if chosen.minutes else None
    share = random.Random(chosen.seed)
    with tempfile.TemporaryDirectory(prefix="faults-") as folder:
        bench = Bench(Path(folder).resolve())
        acts = [act for act in ACTS if not chosen.only or act.name in chosen.only]
        for act in acts:
            bench.states.of(act.start)
        work = [t for act in acts for t in trials_of(bench, act, share, full=chosen.full, quick=chosen.quick)]
        lost = _run_all(bench, work, chosen.jobs, until)
        complaint = crowd(bench)
        print(f"8 processes on one store: {complaint or 'all done, nothing lost'}")
        lost += bool(complaint)
        if not chosen.quick:
            lost += noisy(bench, seeds=4 if chosen.full else 2)
        unseen = control(bench) == 0
    if unseen:
        print("CONTROL FAILED: a disk that ignores fsync lost nothing, so this bench sees nothing")
    return 1 if lost or unseen else 0


def _run_all(bench: Bench, work: list[Trial], jobs: int, until: float | None) -> int:
    tried: Counter[str] = Counter()
    lost: Counter[str] = Counter()

    def one(trial: Trial) -> None:
        if until is not None and time.monotonic() > until:
            return
        try:
            run = bench.node_trial if trial.on_node else bench.trial
            complaint = run(trial.act, trial.fault)
        except Exception as error:  # noqa: BLE001  a trial that breaks is a finding, not the end of the bench
            complaint = f"the trial itself failed: {type(error).__name__}: {error}"
        name = trial.act.name + (" (node)" if trial.on_node else "")
        tried[name] += 1
        if complaint:
            lost[name] += 1
            print(f"LOST  {trial}: {complaint}", flush=True)

    random.Random(2).shuffle(work)
    with ThreadPoolExecutor(jobs) as pool:
        list(pool.map(one, work))
    for name in sorted(tried):
        print(f"{name}: tried {tried[name]}, healed {tried[name] - lost[name]}, lost {lost[name]}")
    all_tried, all_lost = sum(tried.values()), sum(lost.values())
    print(f"all: tried {all_tried} of {len(work)}, healed {all_tried - all_lost}, lost {all_lost}")
    return sum(lost.values())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
