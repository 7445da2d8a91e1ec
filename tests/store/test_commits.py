"""How often a provisioning waits for the disk: the aims of issue 13 row 1 and issue 8."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from teds_provision.station.station import Station
from teds_provision.steps.build import BuildOrder
from teds_provision.steps.provision import provision
from teds_provision.talk.progress import Silent
from tests.bench import Board, make_station, talk

_CHANGES = ("INSERT", "UPDATE", "DELETE", "REPLACE")


@dataclass
class Watched:
    """What SQLite was told to do."""

    station: Station
    statements: list[str] = field(default_factory=list)

    def run(self, board: Board) -> tuple[int, int]:
        """Provision once; returns rows written, and commits that wrote something."""
        self.statements.clear()
        with talk(board) as node:
            order = BuildOrder("temperature-sensor")
            provision(self.station, node, order, accept=lambda who: None, reporter=Silent())
        rows = commits = open_rows = 0
        last = ""
        for statement in self.statements:
            word = statement.split(maxsplit=1)[0]
            if word in _CHANGES and statement != last:  # SQLite tells a statement once more for its trigger
                rows += 1
                open_rows += 1
            elif word == "COMMIT":
                commits += open_rows > 0
                open_rows = 0
            last = statement
        assert open_rows == 0, "a row was written outside a transaction"
        return rows, commits


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    watched = Watched(make_station(tmp_path / "home"))
    watched.station._store._database._connection.set_trace_callback(watched.statements.append)
    yield watched
    watched.station.close()


def test_a_whole_provisioning_is_eight_durable_commits_at_most(watched: Watched) -> None:
    _, commits = watched.run(Board())
    assert commits <= 8


def test_a_provisioning_with_nothing_to_do_writes_four_rows_and_waits_twice_for_the_disk(watched: Watched) -> None:
    board = Board()
    watched.run(board)
    for _ in range(2):
        rows, commits = watched.run(board)
        assert rows <= 4
        assert commits <= 2
