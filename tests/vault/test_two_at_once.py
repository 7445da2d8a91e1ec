"""Two commands that change the vault, at once: one is left at a question, or waits for the store, while another runs.

Each pair runs in this process, in the one order that matters: whatever the second does, it does wholly in the moment
in which the first waits. What a process keeps for itself (the vaults it opened) is kept apart.
"""

from __future__ import annotations

import itertools
import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

import pytest
from _pytest.mark.structures import ParameterSet

from teds_provision.cli.context import App
from teds_provision.errors import TedsProvisionError
from teds_provision.station.station import Station, rewrap
from teds_provision.station.store.lock import StoreLock
from teds_provision.vault import agent, selection
from teds_provision.vault.selection import forget_vaults
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import Outcome, call
from tests.pace import until

NODES = [number.to_bytes(10, "big") for number in range(1, 5)]
NEW = "four other random words"
OF_THE_CA = "the passphrase of a file"
COMMANDS = {
    "rewrap": ("vault", "rewrap"),
    "passphrase": ("vault", "passphrase"),
    "drop": ("trust", "ca", "drop"),
    "import": ("trust", "ca", "import", "{folder}/ca.pem"),
    "restore": ("restore", "{folder}/old.backup"),
    "unlock": ("unlock", "--for", "10m"),
}
PAIRS = list(itertools.product(COMMANDS, repeat=2))


def pairs(test: str, more: str = "") -> list[ParameterSet]:
    """Each command beside one that changes the passphrase, one that changes the master key, and itself; more nightly.

    What the first command looks at again is its own; what the second one changed is one of these, or the CA.
    """
    held = f"tests/vault/test_two_at_once.py::{test}[{{}}-passphrase{more}]: the same second look of that command"
    return [
        pytest.param(
            first,
            second,
            id=f"{first}-{second}",
            marks=() if second in (first, "passphrase", "rewrap") else pytest.mark.nightly(held.format(first)),
        )
        for first, second in PAIRS
    ]


@dataclass
class Running:
    """One command on its way: how many locks it holds, and what runs in the moment in which it waits."""

    name: str
    meanwhile: dict[str, Callable[[], object]]
    locks: int = 0
    asked: list[str] = field(default_factory=list)

    def waits(self, moment: str) -> None:
        act = self.meanwhile.pop(moment, None)
        if act is not None:
            act()


class World:
    """The home, the person, and the commands that run now (the last one has the word)."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.passphrase = PASSPHRASE
        self.stack: list[Running] = []
        self.ran: list[tuple[str, Outcome]] = []

    def run(self, name: str, **meanwhile: Callable[[], object]) -> Outcome:
        """Return a command, as a process of its own would run it."""
        before, current = dict(selection._opened), App.current
        selection._opened.clear()
        running = Running(name, meanwhile)
        self.stack.append(running)
        words = [word.format(folder=self.home.parent) for word in COMMANDS[name]]
        try:
            done = call(self.home, "--json", *words, passphrase=None)
        finally:
            self.stack.pop()
            selection._opened.clear()
            selection._opened.update(before)
            App.current = current
        if name == "passphrase" and done.code == 0:
            self.passphrase = NEW if self.passphrase == PASSPHRASE else PASSPHRASE
        self.ran.append((name, done))
        self.asked = running.asked
        return done

    def answer(self, prompt: str) -> str:
        """Return what the person types: what is right when the question comes, however long the answer takes."""
        running = self.stack[-1]
        assert running.locks == 0, f"{running.name} asks {prompt!r} and holds the store"
        new = NEW if self.passphrase == PASSPHRASE else PASSPHRASE
        answer = new if "New passphrase" in prompt else OF_THE_CA if "CA key's file" in prompt else self.passphrase
        answer = PASSPHRASE if "of the backup" in prompt else answer
        running.asked.append(prompt)
        running.waits(f"question {len(running.asked)}")
        return answer


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a station with keys under its second master key, and a backup with one more, under the first."""
    forget_vaults()
    folder = tmp_path_factory.mktemp("prepared")
    station = make_station(folder / "home")
    for uuid in NODES:
        station.keys.add_pending(uuid, key=uuid + b"first!", key_id=uuid[-8:], epoch=1)
        station.keys.promote(uuid, uuid[-8:].hex())
    station.vault.export_ca(folder / "ca.pem", OF_THE_CA)
    station.close()
    assert call(folder / "home", "backup", folder / "old.backup").code == 0
    station = opened(folder / "home", PASSPHRASE)
    station.keys.remove(NODES[3])
    rewrap(station)
    station.close()
    forget_vaults()
    return folder


@pytest.fixture
def world(prepared: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    forget_vaults()
    shutil.copytree(prepared, tmp_path, dirs_exist_ok=True)
    world = World(tmp_path / "home")
    enter, leave = StoreLock.__enter__, StoreLock.__exit__

    def entered(lock: StoreLock) -> StoreLock:
        if world.stack:
            world.stack[-1].waits("lock")
        enter(lock)
        if world.stack:
            world.stack[-1].locks += 1
        return lock

    def left(
        lock: StoreLock, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if world.stack:
            world.stack[-1].locks -= 1
        leave(lock, kind, error, trace)

    monkeypatch.setattr(StoreLock, "__enter__", entered)
    monkeypatch.setattr(StoreLock, "__exit__", left)
    monkeypatch.setattr(App, "ask_secret", lambda self, prompt, confirm=False: world.answer(prompt))
    monkeypatch.setattr(App, "ask_new", lambda self, prompt: world.answer(prompt))
    monkeypatch.setattr(App, "confirm", lambda self, question, *, yes: None if yes else world.answer(question))
    yield world
    agent.lock(world.home)
    forget_vaults()


def opened(home: Path, message: str, *, use_agent: bool = True) -> Station:
    forget_vaults()
    station = Station.open(home, ask=lambda prompt, confirm: message)
    station.use_agent = use_agent
    return station


def require_whole(world: World) -> None:
    """Every node key opens, and no passphrase but the newest; the CA is where the last command left it."""
    done = [name for name, outcome in world.ran if outcome.code == 0]
    station = opened(world.home, world.passphrase, use_agent=False)
    held = {record.uuid for record in station.keys.all()}
    assert held == set(NODES if "restore" in done else NODES[:3])
    for uuid in held:
        assert [node_key.key for node_key in station.keys.unwrapped(uuid)] == [uuid + b"first!"]
    ca = [name for name in done if name in ("drop", "import", "restore")]
    if "drop" in ca or "import" in ca:
        there = [name for name in ca if name != "restore"][-1] == "import"
        assert (station.vault.ca() is not None) == there
    assert not list(station.row_macs.all_broken())
    assert station.audit_log.check().intact
    station.close()
    other = NEW if world.passphrase == PASSPHRASE else PASSPHRASE
    with pytest.raises(TedsProvisionError, match="Wrong passphrase"):
        opened(world.home, other, use_agent=False).unlock()
    if "unlock" in done and "passphrase" not in done[done.index("unlock") :]:
        agent = opened(world.home, "nobody is asked")
        agent.unlock()
        agent.close()
    for _, outcome in world.ran:
        assert "backup (" not in outcome.out + outcome.err, "a false hint"


def require_outcome(first: str, second: str, done: Outcome) -> None:
    """A command is refused only where the passphrase that it asked for is not the vault's any more.

    A restore asks again: what it was asked about is the list of what comes back.
    """
    if second == "passphrase" and first != "restore":
        assert (done.code, json.loads(done.out)["error"]["code"]) == (7, "vault-changed"), done
    else:
        assert done.code == 0, (first, second, done)


@pytest.mark.parametrize(("first", "second"), pairs("test_one_is_left_at_each_of_its_questions_beside_the_other"))
def test_one_is_left_at_each_of_its_questions_beside_the_other(first: str, second: str, world: World) -> None:
    pristine = world.home.parent / "pristine"
    shutil.copytree(world.home, pristine)
    number, left = 0, True
    while left:
        number += 1
        outcomes: list[Outcome] = []
        done = world.run(first, **{f"question {number}": lambda: outcomes.append(world.run(second))})  # noqa: B023
        left = bool(outcomes)
        if not left:
            break
        assert outcomes[0].code == 0, outcomes[0]
        asked = world.asked[number - 1]
        if (first, second) == ("restore", "passphrase") and asked == "Passphrase of this station's keys":
            assert json.loads(done.out)["error"]["code"] == "vault-changed", done
        else:
            require_outcome(first, second, done)
        require_whole(world)
        agent.lock(world.home)
        until(lambda: not (world.home / agent.SOCKET).exists())  # the ended agent takes it away
        shutil.rmtree(world.home)
        shutil.copytree(pristine, world.home)
        world.passphrase, world.ran = PASSPHRASE, []
    assert number > 1, "it asks nothing"


@pytest.mark.parametrize("third", [None, "rewrap"])
@pytest.mark.parametrize(
    ("first", "second"), pairs("test_one_waits_for_the_store_that_the_other_takes_before_it", "-None")
)
def test_one_waits_for_the_store_that_the_other_takes_before_it(
    first: str, second: str, third: str | None, world: World
) -> None:
    """With a third: both have opened the vault and wait behind it, the other one comes next, then this one."""

    def other() -> None:
        behind = {} if third is None else {"lock": lambda: world.run(third)}
        done = world.run(second, **behind)
        assert done.code == 0, done

    require_outcome(first, second, world.run(first, lock=other))
    require_whole(world)


@pytest.mark.parametrize(("first", "second"), [pair for pair in PAIRS if pair[0] in ("rewrap", "drop", "import")])
def test_one_that_the_agent_opened_waits_for_the_store(first: str, second: str, world: World) -> None:
    assert world.run("unlock").code == 0
    done = world.run(first, lock=lambda: world.run(second))
    assert not any("Passphrase of this station" in prompt for prompt in world.asked)
    require_outcome(first, second, done)
    require_whole(world)


def test_a_new_station_and_a_restored_one_are_made_without_a_lock_while_a_person_types(world: World) -> None:
    """The person answers by :meth:`World.answer`, which looks whether a lock is held."""
    COMMANDS["init"] = ("init", "--keystore", "file", "--name", "other")
    COMMANDS["request"] = ("init", "--keystore", "file", "--request", "{folder}/other.request")
    old = world.home
    try:
        for name, words in (("made", "init"), ("asked", "request"), ("restored", "restore")):
            world.home = old.parent / name
            done = world.run(words)
            assert done.code == 0, done
            assert world.asked
    finally:
        world.home = old
        del COMMANDS["init"], COMMANDS["request"]


def test_a_backup_beside_a_rewrap_holds_the_master_key_of_its_keys(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, came = Station.rows, [0]

    def rows(station: Station) -> Iterator[bytes]:
        came[0] += 1
        if came[0] == 1:
            world.run("rewrap")
        return real(station)

    monkeypatch.setattr(Station, "rows", rows)
    COMMANDS["backup"] = ("backup", "{folder}/new.backup")
    try:
        done = world.run("backup")
    finally:
        del COMMANDS["backup"]
    assert (done.code, came[0]) == (0, 2), done
    assert json.loads(done.out)["warnings"] == []


def test_a_key_that_was_read_before_a_rewrap_and_opened_after_it_is_found(world: World) -> None:
    station = opened(world.home, PASSPHRASE)
    old = {record.uuid: record for record in station.keys.all()}
    with another_process():
        other = opened(world.home, PASSPHRASE)
        rewrap(other)
        other.close()
    fresh = opened(world.home, PASSPHRASE)
    assert fresh.vault.masters() == (3,)
    assert [fresh.keys.unwrap(record)[:10] for record in old.values()] == list(old)
    corrected = station.keys.correct_epoch(old[NODES[0]], 5)
    again = opened(world.home, PASSPHRASE)
    assert again.keys.unwrap(corrected) == NODES[0] + b"first!"
    for any_station in (station, fresh, again):
        any_station.close()


@contextmanager
def another_process() -> Iterator[None]:
    before = dict(selection._opened)
    selection._opened.clear()
    yield
    selection._opened.clear()
    selection._opened.update(before)


def test_work_that_meets_a_question_begins_anew_once_it_is_answered() -> None:
    course: list[object] = []

    def ask(prompt: str, confirm: bool) -> str:
        course.append((prompt, confirm))
        return f"{prompt} {len(course)}"

    def work(known: Callable[[str, bool], str]) -> list[str]:
        course.append("begun")
        return [known(prompt, confirm) for prompt, confirm in (("PIN", False), ("PIN", True), ("PIN", False))]

    assert selection.asked_first(ask, work) == ["PIN 2", "PIN 4", "PIN 2"]
    assert course == ["begun", ("PIN", False), "begun", ("PIN", True), "begun"]
