"""kill -9 at every durable step of a sync: the same command carries on, and nothing is lost or said twice.

A child process syncs and is killed with SIGKILL at its k-th commit, or at the k-th file that it gives a name; then the
same is run again, whole. A small share runs in the gate; ``make faults`` runs all (mark ``soak``).
"""

from __future__ import annotations

import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from teds_provision import files
from teds_provision.plant.apply_pages import heads_digest, merged_views
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.sync import sync
from teds_provision.station.station import Station
from teds_provision.station.store.connection import Connection
from teds_provision.station.store.records import WhitelistEntry
from tests.plant.stations import Plant, ask

NODES = [bytes([n] * 10) for n in range(1, 5)]
KEY = "ab" * 32


def record_events(station: Station, *uuids: bytes) -> None:
    for uuid in uuids:
        station.pins.put(WhitelistEntry(uuid, KEY, assurance="tap"))


def scene(folder: Path) -> None:
    """North and west have news for each other; the stick has some of it; a roster waits that removes nobody."""
    made = Plant(folder)
    west = made.member("west", "line", "sign")
    made.round()
    record_events(made.north, NODES[0])
    made.sync(made.north)
    record_events(west, NODES[1])
    made.sync(west)
    record_events(made.north, NODES[2])
    record_events(west, NODES[3])
    made.close()


def killed_at(folder: Path, step: int, home: str, before: Callable[[Station], None] = lambda station: None) -> bool:
    """Sync a home in a child that kills itself at a durable step; whether it got that far."""
    pid = os.fork()
    if pid == 0:
        left = [step]

        def one_step() -> None:
            left[0] -= 1
            if left[0] < 0:
                os.kill(os.getpid(), signal.SIGKILL)

        execute, publish = Connection.execute, files._publish

        def counted(self: Connection, statement: str, values: object = ()) -> object:
            if statement == "COMMIT":
                one_step()
            return execute(self, statement, values)  # type: ignore[arg-type]

        def published(draft: Path, path: Path, *, replace: bool) -> None:
            one_step()
            publish(draft, path, replace=replace)

        Connection.execute, files._publish = counted, published  # type: ignore[method-assign, assignment]
        try:
            station = Station.open(folder / home, ask=ask)
            before(station)
            sync(station, FolderTransport(folder / "stick"))
            station.close()
        finally:
            os._exit(0)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == -signal.SIGKILL


def carried_on(folder: Path) -> list[object]:
    """Return what everybody knows once each has synced again, twice."""
    for home in ("west", "north") * 3:
        station = Station.open(folder / home, ask=ask)
        sync(station, FolderTransport(folder / "stick"))
        station.close()
    seen: list[object] = []
    for home in ("west", "north"):
        station = Station.open(folder / home, ask=ask)
        station.unlock()
        roster = station.plant.roster
        assert roster is not None
        assert station.plant.alarms.all() == []
        assert station.plant.unsent() == 0
        assert station.plant.claims.to_judge(1) == []
        views = merged_views(station, roster, NODES)
        seen.append((heads_digest(station)[1], {uuid: sorted(view.pins.values()) for uuid, view in views.items()}))
        entry = station.pins.entry(NODES[0])
        assert entry is not None
        assert entry.fingerprint == KEY
        assert all(chain.counted == chain.folded for chain in station.plant.pages.chains().values())
        station.close()
    assert seen[0] == seen[1]
    return seen


def cut(tmp_path: Path, home: str, steps: range, before: Callable[[Station], None] = lambda station: None) -> int:
    """Cut a sync of one home at each of these steps, each from the same scene; returns how many were reached."""
    (tmp_path / "kept").mkdir()
    scene(tmp_path / "kept")
    done = 0
    for step in steps:
        folder = tmp_path / f"cut {step}"
        shutil.copytree(tmp_path / "kept", folder)
        if not killed_at(folder, step, home, before):
            break
        done += 1
        for _, view in carried_on(folder):  # type: ignore[misc]
            assert view == {uuid: [KEY] for uuid in NODES}, step
        shutil.rmtree(folder)
    return done


@pytest.mark.parametrize("home", ["north", "west"])
def test_a_sync_that_is_killed_is_carried_on_by_the_same_command(tmp_path: Path, home: str) -> None:
    assert cut(tmp_path, home, range(0, 12, 4)) >= 2


@pytest.mark.soak
@pytest.mark.parametrize("home", ["north", "west"])
def test_a_sync_that_is_killed_at_any_step_is_carried_on(tmp_path: Path, home: str) -> None:
    assert cut(tmp_path, home, range(100)) >= 5


@pytest.mark.soak
def test_a_rebuilt_home_that_is_killed_while_it_adopts_is_carried_on(tmp_path: Path) -> None:
    def rebuilt(station: Station) -> None:
        station.unlock()
        station.plant.begin_restored()

    (tmp_path / "kept").mkdir()
    made = Plant(tmp_path / "kept")
    west = made.member("west", "line", "sign")
    record_events(made.north, NODES[0])
    record_events(west, NODES[1])
    made.round()
    west.close()
    shutil.copytree(tmp_path / "kept" / "west", tmp_path / "yesterday")
    west = Station.open(tmp_path / "kept" / "west", ask=ask)
    record_events(west, NODES[3])
    made.sync(west)
    made.sync(made.north)
    west.close()
    made.north.close()
    shutil.rmtree(tmp_path / "kept" / "west")
    shutil.copytree(tmp_path / "yesterday", tmp_path / "kept" / "west")
    back = Station.open(tmp_path / "kept" / "west", ask=ask)
    rebuilt(back)
    record_events(back, NODES[2])
    back.close()
    reached = 0
    for step in range(100):
        folder = tmp_path / f"cut {step}"
        shutil.copytree(tmp_path / "kept", folder)
        if not killed_at(folder, step, "west"):
            break
        reached += 1
        for _, view in carried_on(folder):  # type: ignore[misc]
            assert view == {uuid: [KEY] for uuid in NODES}, step
        shutil.rmtree(folder)
    assert reached >= 4
