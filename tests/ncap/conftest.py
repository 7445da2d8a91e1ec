"""One prepared station for the room, and one daemon for each module that asks for it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench import make_station
from tests.e2e.desk import Desk
from tests.ncap.service import Service


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ncap-stations")
    make_station(folder / "bench", "bench").close()
    return folder


@pytest.fixture
def desk(tmp_path: Path, prepared: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path, prepared)
    try:
        yield desk
    finally:
        desk.clear()


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Service]:
    """A daemon for a whole module; its end must be clean."""
    desk = Desk(tmp_path_factory.mktemp("ncap"), prepared)
    service = Service(desk, desk.station())
    try:
        yield service.start()
        service.end()
    finally:
        desk.clear()
