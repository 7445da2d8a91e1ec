from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.bench import make_station

from .desk import Desk, Node, Station


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Homes of two owners' stations, with passphrase vaults at the lowest cost."""
    folder = tmp_path_factory.mktemp("stations")
    for name in ("bench", "rival"):
        make_station(folder / name, name).close()
    return folder


@pytest.fixture
def desk(tmp_path: Path, prepared: Path, node_kind: str) -> Iterator[Desk]:
    desk = Desk(tmp_path, prepared, nodes=node_kind)
    yield desk
    desk.clear()


@pytest.fixture
def station(desk: Desk) -> Station:
    return desk.station()


@pytest.fixture
def node(desk: Desk) -> Node:
    """Return a new node that is not powered yet."""
    return desk.node()
