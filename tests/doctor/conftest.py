"""A fresh desk per test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.station.station import Station
from tests.bench import Board, make_station


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "home")
    yield made
    made.close()


@pytest.fixture
def board() -> Board:
    return Board()
