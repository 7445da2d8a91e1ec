"""A station that dies anywhere in an export or import: the same command carries on, and no key is in two states."""

from __future__ import annotations

import shutil
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.errors import PolicyError
from teds_provision.handover.pending import close
from teds_provision.station.station import Station
from teds_provision.vault.selection import forget_vaults
from tests.bench import Board
from tests.e2e.desk import Running
from tests.handover.desk import Pair, everything, held, session
from tests.handover.victim import counted, export, open_station, take


class KilledError(BaseException):
    """The process ends here; nothing of ours catches this."""


class PreparedHandover:
    """Two homes as they were, and what the boards had in flash, to be tried from again and again."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        pair = Pair.make(folder, 2)
        self.boards = pair.boards
        export(pair.north, folder / "whole.jwe")
        pair.close()
        # north as it was before that export
        for tombstone in (north := open_station(folder / "north")).policy.tombstones():
            north.policy.take_back([tombstone.uuid])
            north.handovers.remove(tombstone.handover_id, "out")
        north.close()
        self.states = [board.state for board in self.boards]
        self.round = 0

    def fresh(self) -> tuple[Path, Path, Path]:
        """North's and south's home and a place for a bundle, as on the first day."""
        self.round += 1
        place = self.folder / f"round{self.round}"
        place.mkdir()
        for name in ("north", "south"):
            shutil.copytree(self.folder / name, place / name)
        for board, state in zip(self.boards, self.states, strict=True):
            board.flash.state = state
            board.power_on()
        return place / "north", place / "south", place / "bundle.jwe"


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[PreparedHandover]:
    yield PreparedHandover(tmp_path_factory.mktemp("handover"))
    forget_vaults()


def killed_before(step: int, act: object, station: Station, bundle: Path) -> bool:
    """Run until the given step; True where it came so far."""

    def at(count: int) -> None:
        if count == step:
            raise KilledError

    try:
        with counted(at):
            act(station, bundle)  # type: ignore[operator]
    except KilledError:
        return True
    return False


def check_export(station: Station, bundle: Path, boards: list[Board]) -> None:
    """Before the move, or in it: never a file while a key is still in use."""
    resting = [tombstone.uuid for tombstone in station.policy.tombstones()]
    assert resting in ([], [board.uuid for board in boards])
    if not resting:
        assert not bundle.exists()
        assert session(station, boards[0]) == 1
        return
    with pytest.raises(PolicyError, match="was moved"):
        session(station, boards[0])


def carry_on(north: Path, south: Path, bundle: Path, boards: list[Board]) -> None:
    """The same export again, then the import, the first contact and the receipt."""
    sender, receiver = open_station(north), open_station(south)
    export(sender, bundle)
    export(sender, bundle)
    receipt = take(receiver, bundle)
    assert [session(receiver, board) for board in boards] == [2, 2]
    assert len(close(sender, receipt).receipt.imported) == 2
    assert [held(sender, board) for board in boards] == [[], []]
    assert len(sender.handovers.all()) == 1
    sender.close()
    receiver.close()


def test_an_export_cut_at_every_write(prepared: PreparedHandover) -> None:
    step, came = 0, True
    while came:
        step += 1
        north, south, bundle = prepared.fresh()
        station = open_station(north)
        came = killed_before(step, export, station, bundle)
        check_export(station, bundle, prepared.boards)
        station.close()
        carry_on(north, south, bundle, prepared.boards)
    assert step > 10


def test_an_import_cut_at_every_write(prepared: PreparedHandover) -> None:
    step, came = 0, True
    while came:
        step += 1
        _, south, _ = prepared.fresh()
        station = open_station(south)
        before = everything(station)
        came = killed_before(step, take, station, prepared.folder / "whole.jwe")
        if came:
            assert everything(station) == before
        first = take(station, prepared.folder / "whole.jwe")
        assert take(station, prepared.folder / "whole.jwe") == first
        assert [session(station, board) for board in prepared.boards] == [2, 2]
        station.close()
    assert step > 15


def kill(home: Path, act: str, step: int, bundle: Path) -> int:
    program = (sys.executable, "-m", "tests.handover.victim")
    running = Running(home, act, step, bundle, program=program)
    try:
        return running.end().code
    finally:
        running.close()


@pytest.mark.parametrize("step", [1, 6, 9, 10, 11, 12])
def test_an_export_killed_by_the_system(prepared: PreparedHandover, step: int) -> None:
    north, south, bundle = prepared.fresh()
    assert kill(north, "export", step, bundle) in (-signal.SIGKILL, 0)
    station = open_station(north)
    check_export(station, bundle, prepared.boards)
    station.close()
    carry_on(north, south, bundle, prepared.boards)


@pytest.mark.parametrize("step", [1, 8, 12, 15])
def test_an_import_killed_by_the_system(prepared: PreparedHandover, step: int) -> None:
    _, south, _ = prepared.fresh()
    bundle = prepared.folder / "whole.jwe"
    assert kill(south, "import", step, bundle) == -signal.SIGKILL
    station = open_station(south)
    assert held(station, prepared.boards[0]) == []
    assert station.handovers.all() == []
    take(station, bundle)
    assert [session(station, board) for board in prepared.boards] == [2, 2]
    station.close()
