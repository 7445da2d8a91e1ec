from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.links.ble.port import BlePort
from teds_provision.links.opening import open_place
from tests.node.measuring_station import keyed_node

from .radio import Radio

ANGLE = "magnetic-angular-position-sensor"


@pytest.fixture
def air(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., Radio]]:
    """Make the air: so many nodes that have a key, or folders of nodes; the bus is this process's system bus."""
    made: list[Radio] = []

    def make(nodes: int | list[Path] = 1, **more: Any) -> Radio:
        if isinstance(nodes, int):
            folders = [tmp_path / f"node{number}" for number in range(nodes)]
            for folder in folders:
                keyed_node(folder, profile=ANGLE)
            nodes = folders
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
        radio = Radio(tmp_path, nodes, **more)
        made.append(radio)
        monkeypatch.setenv("DBUS_SYSTEM_BUS_ADDRESS", radio.address)
        return radio

    yield make
    for radio in made:
        radio.close()


@pytest.fixture
def port() -> Iterator[Callable[[str], BlePort]]:
    """Open ports as --ble does."""
    opened: list[BlePort] = []

    def make(where: str = "") -> BlePort:
        port = open_place(f"ble:{where}")
        assert isinstance(port, BlePort)
        opened.append(port)
        return port

    yield make
    for port in opened:
        port.close()
