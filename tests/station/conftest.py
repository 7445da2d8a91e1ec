from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.station.station import Station
from teds_provision.station.store.store import Store

from ..bench import copied_station


@pytest.fixture
def home(tmp_path: Path) -> Path:
    return tmp_path / "home"


@pytest.fixture
def store(home: Path) -> Iterator[Store]:
    with Store.open(home, create=True) as opened:
        yield opened


@pytest.fixture
def station(home: Path) -> Iterator[Station]:
    with copied_station(home) as made:
        yield made
