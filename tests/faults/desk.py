"""Where a trial runs: a folder with stations, a node's flash and files, and the processes that work on them."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.scale import fill
from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import THROWAWAY
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, Links
from tests.faults.acts import MANY, NEXT, UUID
from tests.firmware_images import make_key, sign
from tests.zygote import FIRST_FD, Child, Zygote

PASSPHRASE = "correct horse battery"
READY = 60.0
WORKED = 20.0


@dataclass(frozen=True)
class Outcome:
    """How a command ended, and what it said."""

    returncode: int
    stdout: str
    stderr: str

    @property
    def buggy(self) -> str:
        """What it said, where that is no answer: a traceback, or exit code 1."""
        if "Traceback" not in self.stderr and self.returncode != 1:
            return ""
        return f"a bug: {self.returncode} {self.stdout[-300:]}{self.stderr[-300:]}"


@dataclass(frozen=True)
class Desk:
    """One folder with a station (``home``), another (``other``), a node's flash and the files that go to and fro."""

    folder: Path
    zygote: Zygote
    links: Links = field(default_factory=Links)

    @property
    def home(self) -> Path:
        return self.folder / "home"

    def words(self, words: tuple[str, ...]) -> list[str]:
        """A command line with the places of this desk put in."""
        files = self.folder / "files"
        bundle, job = files / "bundle.id", files / "job.id"
        places = {"FILES": str(files), "UUID": UUID, "ID": bundle.read_text() if bundle.exists() else ""}
        places |= {"FD": str(FIRST_FD + 1), "OTHER": "77" * 10, "JOB": job.read_text() if job.exists() else ""}
        result: list[str] = []
        for word in words:
            if word == "LINK":
                result += self.links.over("can")
            elif word == "TAP":
                result += self.links.over("nfc")
            elif word == "BUS":
                result += ["--can", self.links.can]
            else:
                result.append(re.sub(r"\{(\w+)\}", lambda found: places.get(found[1], found[0]), word))
        return result

    def start(
        self, *words: str, home: str = "home", fault: dict[str, str] | None = None, module: str = "teds_provision"
    ) -> Child:
        """Begin one command of a station of this desk; two descriptors hold the passphrase."""
        secrets = [_pipe_with(PASSPHRASE), _pipe_with(PASSPHRASE)]
        options = ["--home", str(self.folder / home), "--json", "--passphrase-fd", str(FIRST_FD)]
        try:
            return self.zygote.start(
                module, [*options, *self.words(words)], clean_environment() | (fault or {}), tuple(secrets)
            )
        finally:
            for descriptor in secrets:
                os.close(descriptor)

    def run(
        self,
        *words: str,
        home: str = "home",
        fault: dict[str, str] | None = None,
        seconds: float = 60,
        module: str = "teds_provision",
        until: str = "",
    ) -> Outcome:
        """Run one command of a station of this desk to its end; raises TimeoutExpired.

        ``until``: it gets SIGTERM when it has said that, or would have long since.
        """
        running = self.start(*words, home=home, fault=fault, module=module)
        if until:
            end = time.monotonic() + WORKED
            while running.poll() is None and until not in running.stdout() and time.monotonic() < end:
                time.sleep(0.05)
            if running.poll() is None:
                running.send_signal(signal.SIGTERM)
        return ended(running, seconds)

    @contextmanager
    def node(self, fault: dict[str, str] | None = None, *, nfc: bool = True) -> Iterator[Child]:
        """Yield the virtual node of this desk, on its bus and (unless told otherwise) on its reader."""
        links = [*(["--nfc", self.links.nfc] if nfc else []), "--can", self.links.can]
        still = self.folder / "files" / "still.csv"
        source = ["--source", f"file:{still}"] if still.exists() else []
        words = ["--json", "--debug", "node", "run", str(self.folder / "flash"), *links, *source]
        running = self.zygote.start("teds_provision", words, clean_environment() | (fault or {}), piped=True)
        try:
            running.wait_for('"ready": true', READY)
            yield running
        finally:
            running.close()


def ended(running: Child, seconds: float) -> Outcome:
    """Wait for the end of a command; raises TimeoutExpired."""
    try:
        code = running.wait(seconds)
        return Outcome(code, running.stdout(), running.stderr())
    finally:
        running.close()


def _pipe_with(line: str) -> int:
    read, write = os.pipe()
    os.write(write, line.encode() + b"\n")
    os.close(write)
    return read


class States:
    """The states from which commands start: each made once, copied for every trial."""

    def __init__(self, folder: Path, zygote: Zygote) -> None:
        self.folder = folder
        self.zygote = zygote
        self._lock = threading.RLock()

    def of(self, name: str) -> Path:
        """Return the folder of a state, made at first need."""
        with self._lock:
            place = self.folder / name.replace(" ", "-")
            if not place.is_dir():
                made = place.with_suffix(".new")
                self._make(name, made)
                made.rename(place)
            return place

    def _make(self, name: str, made: Path) -> None:
        if name in ("new", "sensor", "slots"):
            self._new(made, *(["--profile", ANGLE] if name == "sensor" else []), slots=name == "slots")
            return
        before, steps = NEXT[name]
        shutil.copytree(self.of(before), made)
        desk = Desk(made, self.zygote)
        with desk.node():
            for station, words in steps:
                done = desk.run(*words, home=station, seconds=900)
                assert done.returncode == 0, f"{name}: {words}: {done.stdout}{done.stderr}"
                for what, kept in (("export-keys", "bundle.id"), ("job new", "job.id")):
                    if " ".join(words).startswith(what):
                        (made / "files" / kept).write_text(json.loads(done.stdout)["id"])
        if name == "many":
            fill(made / "home", MANY)
        if name == "many behind":  # what came since is gone again: the store is as it was before the many
            shutil.rmtree(made / "home")
            shutil.copytree(self.of("provisioned") / "home", made / "home")
        if name == "backed up":
            (made / "fresh").mkdir(mode=0o700)

    def _new(self, folder: Path, *hardware: str, slots: bool = False) -> None:
        folder.mkdir()
        (folder / "files" / "stick").mkdir(parents=True)
        (folder / "files" / "sheet.csv").write_text(f"uuid,profile\n{UUID},{ANGLE}\n")
        if hardware:
            (folder / "files" / "still.csv").write_text("t,angle\n0,90\n100000,90\n")
        (folder / "files" / "angle.csv").write_text("# date: 2026-10-01\nraw,value [degree]\n0,0\n65536,360\n")
        desk = Desk(folder, self.zygote)
        for home, name in (("home", "bench"), ("other", "crane"), ("third", "lab")):
            station, _ = initialise(
                folder / home, name=name, keystore="file", ask=lambda prompt, confirm=False: PASSPHRASE, costs=THROWAWAY
            )
            station.close()
            record = json.loads(desk.run("init", home=home).stdout)
            (folder / "files" / f"{name}.pem").write_text(record["public_key"])
        words = ["node", "create", str(folder / "flash"), "--uuid", UUID, *hardware]
        if slots:
            key = make_key(folder / "owner.pem")
            words += ["--firmware", str(sign(folder, "1.0.0", key)), "--firmware-key", str(key)]
            sign(folder, "1.1.0", key).rename(folder / "files" / "new.bin")
        made = ended(self.zygote.start("teds_provision", words, clean_environment()), 60)
        assert made.returncode == 0, made
