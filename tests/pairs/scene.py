"""Where a cell of the pair bench runs: three stations, their nodes on one bus, and every command as a process.

A scene is copied from a prepared one, so that a cell costs the two commands and the checks, not a provisioning. The
nodes of a scene, by name:

* ``target``: in the group ``hand``; the change works on it. Calibrated.
* ``bystander``: in the group ``hand``; no change touches it, so nothing may happen to it.
* ``handed``: in the group ``hand``; signed by station ``crane``, so it is authentic while ``crane`` is trusted.
* ``spare``: provisioned, in no group.
* ``gripper``: an actuator, provisioned, in no group.
* ``first``, ``second``, ``third``: boards in factory state on the whitelist, for the commands that provision.
* ``bundled``: known to ``crane`` alone; its keys are in the bundle that ``import-keys`` reads.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
import sqlite3
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from teds_provision.node.node_template import create
from teds_provision.protocol.keys import SoftwareKey, to_pem
from teds_provision.station.station import initialise
from teds_provision.vault.passphrase import THROWAWAY
from tests.cli.shell import clean_environment, zygote
from tests.e2e.desk import ANGLE, Links
from tests.measure.rig import provisioned
from tests.pace import PATIENCE
from tests.zygote import FIRST_FD, Child, Zygote

OLD_PASSPHRASE = "correct horse battery"
NEW_PASSPHRASE = "staple of another shape"
MEMORY = Path("/dev/shm")
NODES = {
    "target": "8d4d9da65281f7000000",
    "bystander": "8d4d9da65281f7000001",
    "handed": "8d4d9da65281f7000002",
    "spare": "8d4d9da65281f7000003",
    "gripper": "8d4d9da65281f7000004",
    "bundled": "8d4d9da65281f7000005",
    "first": "8d4d9da65281f7000010",
    "second": "8d4d9da65281f7000011",
    "third": "8d4d9da65281f7000012",
}
GROUP = ("target", "bystander", "handed")
BOARDS = ("first", "second", "third")
BOARD_TYPE = "limit-switch"
"""The type of the boards: the one that requires no calibration."""
ABSENT = "77777777777777777777"
"""A node that no station has met."""
REVOKED = "66666666666666666666"
"""A node that ``bench`` has banned."""
HOMES = ("bench", "crane", "line", "guest")
OWNERS = ("bench", "crane")
"""Stations with a CA key; the others get a certificate of ``bench``."""
_TIMED_OUT = -1


@dataclass(frozen=True)
class Outcome:
    """How a command ended, and its output."""

    code: int
    out: str
    err: str

    @property
    def lines(self) -> list[dict[str, Any]]:
        """Every whole line of JSON on stdout."""
        found = []
        for line in self.out.split("\n")[:-1]:
            with suppress(json.JSONDecodeError):
                found.append(json.loads(line))
        return found

    @property
    def error(self) -> str:
        """The code word of the error, "" without one."""
        return next((str(line["error"]["code"]) for line in self.lines if "error" in line), "")

    @property
    def is_bug(self) -> bool:
        """True if it ended by a traceback, by exit code 1, by a signal, or not within its time."""
        return "Traceback" in self.err or self.code == 1 or self.code < 0

    def __str__(self) -> str:
        return f"exit {self.code}: {self.out[-400:].strip()} {self.err[-200:].strip()}"


class Scene:
    """One folder with the homes, flashes and files of a cell, and the processes that work on them."""

    def __init__(self, folder: Path, zygote: Zygote) -> None:
        self.folder, self.zygote = folder, zygote
        self.links = Links()
        self.passphrases = dict.fromkeys(HOMES, OLD_PASSPHRASE)
        self._powered: list[Child] = []

    @property
    def files(self) -> Path:
        """Where commands read and write files."""
        return self.folder / "files"

    def home(self, name: str = "bench") -> Path:
        """Return the home of one of the stations."""
        return self.folder / name

    def words(self, words: tuple[str, ...]) -> list[str]:
        """Return a command line with the places and names of this scene filled in."""
        places = {name.upper(): uuid for name, uuid in NODES.items()}
        places |= {
            "FILES": str(self.files),
            "ABSENT": ABSENT,
            "REVOKED": REVOKED,
            "ANGLE": ANGLE,
            "BOARD_TYPE": BOARD_TYPE,
        }
        places |= {"NEW_FD": str(FIRST_FD + 1), "CAN": self.links.can, "NFC": self.links.nfc}
        places |= {path.stem.upper(): path.read_text() for path in self.files.glob("*.id")}
        result: list[str] = []
        for word in words:
            if word == "BUS":
                result += self.links.over("can")
            elif word == "TAP":
                result += self.links.over("nfc")
            else:
                result.append(word.format(**places))
        return result

    def start(self, *words: str, home: str = "bench", piped: bool = False) -> Child:
        """Start a command of a station; a second descriptor holds the new passphrase."""
        secrets = [_pipe_with(self.passphrases[home]), _pipe_with(NEW_PASSPHRASE)]
        options = ["--home", str(self.home(home)), "--json", "--passphrase-fd", str(FIRST_FD)]
        try:
            return self.zygote.start(
                "teds_provision",
                [*options, *self.words(words)],
                clean_environment(),
                tuple(secrets),
                piped=piped,
            )
        finally:
            for descriptor in secrets:
                os.close(descriptor)

    def run(self, *words: str, home: str = "bench", seconds: float = 120.0) -> Outcome:
        """Run a command of a station to its end."""
        return self.end_of(self.start(*words, home=home), seconds)

    def ask(self, *words: str, home: str = "bench") -> dict[str, Any]:
        """Run a command that must succeed; returns its last object. Raises AssertionError."""
        ended = self.run(*words, home=home)
        assert ended.code == 0, f"{' '.join(words)}: {ended}"
        return ended.lines[-1]

    def end_of(self, child: Child, seconds: float = 120.0) -> Outcome:
        """Wait for the end of a command; one that takes longer than ``seconds`` is killed, and ends with -1."""
        try:
            code = child.wait(seconds)
        except Exception:  # noqa: BLE001  subprocess.TimeoutExpired: it has been killed
            code = _TIMED_OUT
        try:
            return Outcome(code, child.stdout(), child.stderr())
        finally:
            child.close()

    def power_nodes(self) -> None:
        """Power every provisioned node of ``bench`` on the bus; returns once their links are up."""
        still = ("--source", f"file:{self.files / 'still.csv'}")
        self.power(*GROUP, "spare", options=still)
        self.power("gripper")

    def power(self, *names: str, options: tuple[str, ...] = ()) -> Child:
        """Power some nodes in one process, on the bus; returns once their links are up."""
        folders = [str(self.folder / "flash" / name) for name in names]
        return self._power([*folders, "--can", self.links.can, *options])

    def tap(self, name: str) -> Child:
        """Place one board on the reader."""
        return self._power([str(self.folder / "flash" / name), "--nfc", self.links.nfc])

    def _power(self, words: list[str]) -> Child:
        child = self.zygote.start("teds_provision", ["--json", "node", "run", *words], clean_environment(), piped=True)
        self._powered.append(child)
        child.wait_for('"ready": true', PATIENCE)
        return child

    def cut(self, node: Child) -> None:
        """Cut the power of a process of nodes; a board on the reader is gone from it."""
        self._powered.remove(node)
        node.close()

    def count(self, query: str, *values: object, home: str = "bench") -> int:
        """Return the number that a query of the station's database returns."""
        with closing(sqlite3.connect(f"file:{self.home(home)}/store.sqlite3?mode=ro", uri=True)) as database:
            (number,) = database.execute(query, values).fetchone()
        return int(number)

    def close(self) -> None:
        """End every node."""
        while self._powered:
            self.cut(self._powered[-1])


def _pipe_with(line: str) -> int:
    read, write = os.pipe()
    os.write(write, line.encode() + b"\n")
    os.close(write)
    return read


class Scenes:
    """The prepared scenes, each made once at first need, and copied for every cell."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.zygote = zygote()
        self._lock = threading.RLock()
        self._numbers = itertools.count()

    @classmethod
    @contextmanager
    def open(cls) -> Iterator[Scenes]:
        """Scenes in a folder that is removed at the end, in memory if possible."""
        where = MEMORY if MEMORY.is_dir() and os.access(MEMORY, os.W_OK) else None
        with tempfile.TemporaryDirectory(prefix="pairs-", dir=where) as folder:
            yield cls(Path(folder).resolve())

    def prepared(self, name: str) -> Path:
        """Return the folder of a prepared scene."""
        with self._lock:
            place = self.folder / name
            if not place.is_dir():
                made = self.folder / f"{name}.new"
                _PREPARE[name](self, made)
                made.rename(place)
            return place

    @contextmanager
    def copy(self, name: str) -> Iterator[Scene]:
        """A copy of a prepared scene (``alone`` or ``plant``), removed at the end."""
        prepared = self.prepared(name)
        place = self.folder / f"cell-{next(self._numbers)}"
        shutil.copytree(prepared, place)
        scene = Scene(place, self.zygote)
        try:
            yield scene
        finally:
            scene.close()
            shutil.rmtree(place, ignore_errors=True)


def _ask(prompt: str, confirm: bool = False) -> str:
    return OLD_PASSPHRASE


def _prepare_alone(scenes: Scenes, folder: Path) -> None:
    """Make a station with its nodes, beside a station of another owner."""
    folder.mkdir()
    (folder / "files" / "stick").mkdir(parents=True)
    (folder / "flash").mkdir()
    scene = Scene(folder, scenes.zygote)
    scene.files.joinpath("still.csv").write_text("t,angle\n0,90\n100000,90\n")
    scene.files.joinpath("angle.csv").write_text("# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n")
    stations = {
        home: initialise(folder / home, name=home, keystore="file", ask=_ask, costs=THROWAWAY)[0] for home in OWNERS
    }
    try:
        scene.files.joinpath("mast.pem").write_text(to_pem(SoftwareKey.generate().point))
        for home, station in stations.items():
            scene.files.joinpath(f"{home}.pem").write_text(to_pem(station.point))
        for name, uuid in NODES.items():
            flash = folder / "flash" / name
            if name in BOARDS:
                create(flash, uuid=bytes.fromhex(uuid), profile=BOARD_TYPE).release()
            else:
                owner = stations["crane" if name in ("handed", "bundled") else "bench"]
                provisioned(owner, flash, "gripper" if name == "gripper" else ANGLE, name, bytes.fromhex(uuid))
    finally:
        for station in stations.values():
            station.close()
    for words, home in _ALONE:
        scene.ask(*words, home=home)
    scene.power("handed")
    scene.ask("verify", "{HANDED}", "BUS")  # until it is read, --all takes it for a board that is not finished
    scene.close()


def _prepare_plant(scenes: Scenes, folder: Path) -> None:
    """Make the plant: ``bench`` is its keeper and office, ``line`` builds; ``guest`` has asked to join."""
    shutil.copytree(scenes.prepared("alone"), folder)
    scene = Scene(folder, scenes.zygote)
    for words, home in _PLANT:
        done = scene.ask(*words, home=home)
        if words[:2] == ("job", "new"):
            scene.files.joinpath("job.id").write_text(str(done["id"]))
    scene.close()


_TO_CRANE = ("export-keys", "--to", "bench", "{HANDED}", "--yes", "--output", "{FILES}/handed.jwe")
_ALONE: tuple[tuple[tuple[str, ...], str], ...] = (
    (("trust", "add", "crane", "{FILES}/crane.pem", "--yes"), "bench"),
    (("trust", "add", "bench", "{FILES}/bench.pem", "--yes"), "crane"),
    (_TO_CRANE, "crane"),
    (("import-keys", "{FILES}/handed.jwe", "--yes", "--no-prove"), "bench"),
    (("export-keys", "--to", "bench", "{BUNDLED}", "--yes", "--output", "{FILES}/bundled.jwe"), "crane"),
    (("group", "create", "hand", "{TARGET}", "{BYSTANDER}", "{HANDED}"), "bench"),
    (("group", "create", "idle", "{SPARE}"), "bench"),
    *((("whitelist", "add", "{" + name.upper() + "}"), "bench") for name in BOARDS),
    (("whitelist", "add", REVOKED), "bench"),
    (("revoke", REVOKED, "--why", "lost", "--yes"), "bench"),
    (("backup", "{FILES}/backup", "--backup-passphrase-fd", "{NEW_FD}", "--yes"), "bench"),
)
_STICK = ("--files", "{FILES}/stick")
_CERTIFY = ("trust", "ca", "sign")
_JOB = (
    *("job", "new", "--title", "three", "--profile", BOARD_TYPE, "--station", "line", "--count", "3"),
    *("--sign", "bench", "--ends", "2099-01-01", "--output", "{FILES}/job.jws"),
)
_PLANT: tuple[tuple[tuple[str, ...], str], ...] = (
    (("registry", "create", "--name", "plant", "--yes"), "bench"),
    *(
        step
        for home in ("line", "guest")
        for step in (
            (("init", "--name", home, "--keystore", "file", "--request", f"{{FILES}}/{home}.request"), home),
            ((*_CERTIFY, f"{{FILES}}/{home}.request", "--output", f"{{FILES}}/{home}.cert", "--yes"), "bench"),
            (("init", "--certificate", f"{{FILES}}/{home}.cert", "--yes"), home),
            (("registry", "request", "--output", f"{{FILES}}/{home}.member"), home),
        )
    ),
    (("registry", "add", "{FILES}/line.member", "--role", "line", "--yes"), "bench"),
    (("registry", "sync", *_STICK), "bench"),
    (("registry", "connect", *_STICK, "--yes"), "line"),
    (("registry", "sync", *_STICK), "line"),
    (
        _JOB,
        "bench",
    ),
)  # fmt: skip
_PREPARE: dict[str, Callable[[Scenes, Path], None]] = {"alone": _prepare_alone, "plant": _prepare_plant}
