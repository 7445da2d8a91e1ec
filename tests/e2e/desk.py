"""A desk for whole runs: stations that are driven by command line, nodes in processes of their own, real links."""

from __future__ import annotations

import codecs
import json
import os
import re
import selectors
import sqlite3
import subprocess
import time
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from io import FileIO
from pathlib import Path
from typing import Any, cast

import pytest

from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.node_template import create
from teds_provision.station import station as base_station
from tests.bench import PASSPHRASE
from tests.cli.shell import PROGRAM, ROOT, Outcome, begin
from tests.e2e.powered import PoweredNode
from tests.firmware.c_node import CNode
from tests.pace import PATIENCE, until
from tests.places import free_bus, free_reader, new_uuid

KIND_OF_NODE = os.environ.get("TEDS_NODE", "python")
"""``c``: every node of a desk is the one in C (``make test-c``)."""
ANGLE = "magnetic-angular-position-sensor"
FINGER = "tactile-finger-sensor"
_UTF8 = codecs.getincrementaldecoder("utf-8")
_NOT_IN_TIME = re.compile(r"could not be sent in time \((\d+)\)")
_TIMES = re.compile(r"\d{4}-\d\d-\d\dT[\d:.]+Z?")


@dataclass(frozen=True)
class Links:
    """A reader and a bus that no other test uses."""

    nfc: str = field(default_factory=free_reader)
    can: str = field(default_factory=free_bus)

    def over(self, via: str) -> list[str]:
        """Return the user's options for one of them."""
        return ["--via", "nfc", "--nfc", self.nfc] if via == "nfc" else ["--via", "can", "--can", self.can]


def limited(octets: int) -> tuple[str, ...]:
    """Return the program on a disk on which no file may grow beyond so many octets.

    It compiles nothing: Python 3.11 keeps a module's octets as far as they went, and nothing imports that module again.
    """
    code = (
        "import resource, runpy, sys; sys.dont_write_bytecode = True;"
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({octets}, {octets}));"
        "sys.argv[0] = 'teds-provision'; runpy.run_module('teds_provision', run_name='__main__')"
    )
    return (PROGRAM[0], "-c", code)


class Running:
    """A process whose lines are waited for; ended by its id at the latest when the test ends."""

    def __init__(
        self,
        *words: object,
        passphrase: str | None = None,
        environment: dict[str, str] | None = None,
        cwd: Path = ROOT,
        program: tuple[str, ...] = PROGRAM,
        fork: bool = True,
    ) -> None:
        (read, out), (other, err) = os.pipe(), os.pipe()
        self.stdout, self.stderr = FileIO(read), FileIO(other)
        how: dict[str, Any] = {"environment": environment, "cwd": cwd, "program": program, "fork": fork}
        try:
            self.process = begin(*words, passphrase=passphrase, out=out, err=err, **how)
        finally:
            os.close(out)
            os.close(err)
        self.out = self.err = ""
        self._read_out, self._read_err = _UTF8(), _UTF8()  # a pipe may break a letter in two
        self._selector = selectors.DefaultSelector()
        for stream in (self.stdout, self.stderr):
            os.set_blocking(stream.fileno(), False)
            self._selector.register(stream, selectors.EVENT_READ)

    def read(self, seconds: float) -> bool:
        """Take in what came within ``seconds``; False where there was nothing."""
        came = False
        for key, _ in self._selector.select(seconds):
            octets = os.read(key.fd, 65536)
            came = came or bool(octets)
            if not octets:
                self._selector.unregister(key.fileobj)
            elif key.fileobj is self.stdout:
                self.out += self._read_out.decode(octets)
            else:
                self.err += self._read_err.decode(octets)
        return came

    def wait_for(self, text: str, seconds: float = PATIENCE) -> None:
        """Wait until ``text`` stands on stdout or stderr."""
        end = time.monotonic() + seconds
        while text not in self.out + self.err:
            assert time.monotonic() < end, f"no {text!r} in {self.out!r} {self.err!r}"
            if not self._selector.get_map():
                raise AssertionError(f"ended without {text!r}: {self.out!r} {self.err!r}")
            self.read(0.1)

    def wait_for_lines(self, count: int, seconds: float = PATIENCE) -> list[Any]:
        """Wait for ``count`` lines of JSON on stdout and return them."""
        end = time.monotonic() + seconds
        while self.out.count("\n") < count:
            assert time.monotonic() < end, f"not {count} lines: {self.out!r} {self.err!r}"
            assert self._selector.get_map(), f"ended before line {count}: {self.out!r} {self.err!r}"
            self.read(0.1)
        return [json.loads(line) for line in self.out.split("\n")[:-1]]  # the next one may have come in part

    def end(self, seconds: float = PATIENCE) -> Outcome:
        """Wait for its end by itself."""
        end = time.monotonic() + seconds
        while self._selector.get_map() and time.monotonic() < end:
            self.read(0.1)
        try:
            code = self.process.wait(max(0.1, end - time.monotonic()))
        except subprocess.TimeoutExpired:
            raise AssertionError(f"it runs on after {seconds} s: {self.out!r} {self.err!r}") from None
        return Outcome(code, self.out, self.err)

    @property
    def runs(self) -> bool:
        """Whether it has not ended yet."""
        return self.process.poll() is None

    def signal(self, number: int) -> None:
        """Send it a signal."""
        self.process.send_signal(number)

    def close(self) -> None:
        """End it, whatever it does."""
        if self.runs:
            self.process.kill()
        self.process.wait(PATIENCE)
        self._selector.close()
        for stream in (self.stdout, self.stderr):
            stream.close()


class Desk:
    """Where the processes of one test run; every one of them is gone afterwards."""

    def __init__(self, folder: Path, prepared: Path, *, nodes: str = "") -> None:
        self.folder = folder
        self.prepared = prepared
        self.nodes = nodes or KIND_OF_NODE
        self.links = Links()
        self.running: list[Running] = []
        self.addresses: set[int] = set()  # of its nodes

    def start(self, *words: object, **more: Any) -> Running:
        """Start the program."""
        self.running.append(Running(*words, **more))
        return self.running[-1]

    def clear(self, but: Collection[Running | None] = ()) -> None:
        """End all that runs, but what is named: a test that failed leaves nothing to the next one."""
        for process in self.running:
            if process not in but:
                process.close()
        self.running[:] = [process for process in self.running if process in but]

    def station(self, name: str = "bench") -> Station:
        """Return a station with keys of its own, prepared once and copied for each test."""
        home = self.folder / name
        subprocess.run(["cp", "-a", str(self.prepared / name), str(home)], check=True)
        return Station(self, home)

    def new_uuid(self) -> bytes:
        """Return a random UUID of a node that keeps its default address beside the others of this desk."""
        return new_uuid(self.addresses)

    def node(
        self,
        name: str = "node",
        *,
        uuid: str | None = None,
        called: str = "",
        type_: str | None = None,
        firmware: tuple[Path, Path] | None = None,
    ) -> Node:
        """Return a new node in factory state, made in this process: what the command does is in tests/node.

        ``firmware``: the image that it runs, and the owner's key pair.
        """
        own = bytes.fromhex(uuid) if uuid else self.new_uuid()
        if self.nodes == "c":
            if called or type_:
                pytest.skip("the node in C has no datasheet of its own")
            return cast(Node, CNode(self, self.folder / name, own.hex(), firmware=firmware))
        made = create(self.folder / name, uuid=own, name=called, profile=type_)
        if firmware is not None:
            ImageSlots.create(self.folder / name, *firmware)
        made.release()
        return Node(self, self.folder / name, made.load().uuid.hex())


@dataclass
class Node(PoweredNode):
    """A virtual transducer; its process lies on the desk's reader and hangs on its bus, as far as it is told to."""

    def start(self, *options: object, nfc: bool = True, can: bool = False, **more: Any) -> Node:
        """Power on, and wait until its links are up."""
        links = self.desk.links
        where = [*(["--nfc", links.nfc] if nfc else []), *(["--can", links.can] if can else [])]
        self.ready(self.desk.start("--json", "node", "run", self.folder, *where, *options, **more))
        return self

    def missed(self) -> int:
        """How many messages of its streams it says that it could not send in time: its process had no processor."""
        assert self.process is not None
        while self.process.read(0):
            pass
        return max(map(int, _NOT_IN_TIME.findall(self.process.out + self.process.err)), default=0)

    @property
    def octets(self) -> bytes:
        """Its whole flash file."""
        return (self.folder / "flash.json").read_bytes()

    @property
    def flash(self) -> dict[str, Any]:
        """What stands in its flash."""
        return dict(json.loads(self.octets)["flash"])


@dataclass
class Station:
    """A base station: its home, and every command as a process of its own."""

    desk: Desk
    home: Path
    passphrase: str | None = PASSPHRASE

    def start(self, *words: object, **more: Any) -> Running:
        """Start a command."""
        return self.desk.start("--home", self.home, *words, passphrase=self.passphrase, **more)

    def run(self, *words: object, **more: Any) -> Outcome:
        """Run a command to its end."""
        return self.start(*words, **more).end()

    def ask(self, *words: object, code: int = 0, **more: Any) -> Any:
        """Run a command with --json to its end; its one object. The exit code must be ``code``."""
        outcome = self.run("--json", *words, **more)
        assert outcome.code == code, outcome
        return outcome.json

    def refuses(self, *words: object, code: int) -> dict[str, str]:
        """Run a command with --json that must fail with ``code``; what it says."""
        reply = self.ask(*words, code=code)
        assert set(reply) == {"error"}
        assert set(reply["error"]) == {"code", "message", "hint"}
        assert reply["error"]["message"].endswith((".", "?", "!", ")")), reply
        return dict(reply["error"])

    def provision(self, via: str = "nfc", *more: object, code: int = 0) -> Any:
        """Take all steps in one command, over one of the desk's links."""
        return self.ask("provision", *more, "--yes", *self.desk.links.over(via), code=code)

    def tables(self, *, without: tuple[str, ...] = ()) -> dict[str, list[Any]]:
        """Return every row of the store by table; moments (which differ between runs) are blanked out."""
        with closing(sqlite3.connect(f"file:{self.home}/store.sqlite3?mode=ro", uri=True)) as database:
            names = [name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            wanted = [name for name in names if not name.startswith("sqlite_") and name not in without]
            tables = {name: [_blank(row) for row in database.execute(f"SELECT * FROM {name}")] for name in wanted}
        if "audit" in without:
            tables["meta"] = [row for row in tables["meta"] if row[0] != "audit-head"]
        return tables

    def keys(self, uuid: str) -> list[tuple[str, int]]:
        """State and epoch of every key that is held for a node."""
        with base_station.Station.inspect(self.home) as store:
            return [(record.state, record.epoch) for record in store.keys.keys_of(bytes.fromhex(uuid))]

    def log_is_whole(self) -> bool:
        """Return True if the hash chain of the audit log holds."""
        with base_station.Station.inspect(self.home) as store:
            return store.audit_log.check().intact


def _blank(row: tuple[Any, ...]) -> tuple[Any, ...]:
    return tuple("(moment)" if isinstance(value, str) and _TIMES.fullmatch(value) else value for value in row)


def results(done: Any) -> dict[str, str]:
    """Result of each step of a provisioning."""
    return {step["name"]: step["result"] for step in done["steps"]}


@contextmanager
def nothing_lost(node: Node, report: Callable[[], Mapping[str, Any]]) -> Iterator[None]:
    """Yield the block costs the station none of a node's values; ``report`` counts ``lost``, ``late`` and ``bad``.

    What the node says that it could not send in time is no loss: that its process had no processor is no matter of the
    station's. It says so every ten seconds, and sends late what it still sends then.
    """
    before, missed = report(), node.missed()
    yield
    after = report()
    lost, late, bad = (after[name] - before.get(name, 0) for name in ("lost", "late", "bad"))
    assert bad == 0
    due = max(lost, late > 0)
    until(lambda: node.missed() - missed >= due, lambda: f"lost {lost}, late {late}; not sent {node.missed() - missed}")
