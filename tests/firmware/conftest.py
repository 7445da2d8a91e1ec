from __future__ import annotations

import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from tests.bench import make_station
from tests.e2e.desk import Desk, Running, Station
from tests.firmware import builds

ANGLE_CHANNELS = "1 sensor 0 2 100000\n"


@dataclass
class CNode:
    """A node in C as a process; its flash is a file."""

    desk: Desk
    program: Path
    flash: Path
    uuid: str
    channels: str = ANGLE_CHANNELS
    ready: dict[str, Any] = field(default_factory=dict)
    process: Running | None = None

    def start(self, *options: object, can: str | None = None, nfc: bool = False, cwd: Path | None = None) -> CNode:
        """Power on, and wait until it is on the bus; with ``nfc`` it has an antenna and lies on the desk's reader."""
        words: list[object] = ["--flash", self.flash, "--uuid", self.uuid]
        if can != "":
            words += ["--can", can or self.desk.links.can]
        if nfc:
            words += ["--nfc", self.desk.links.nfc]
        if self.channels:
            table = self.flash.with_suffix(".channels")
            table.write_text(self.channels)
            words += ["--channels", table]
        self.process = self.desk.start(
            *words, *options, program=(str(self.program),), fork=False, cwd=cwd or self.desk.folder
        )
        self.ready = self.process.wait_for_lines(1)[0]
        assert self.ready["ready"] is True
        assert self.ready["uuid"] == self.uuid
        return self

    def kill(self) -> None:
        """Cut its power."""
        assert self.process is not None
        self.process.process.kill()
        self.process.end()


@pytest.fixture(scope="session")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Homes of two owners' stations, with passphrase vaults at the lowest cost."""
    folder = tmp_path_factory.mktemp("stations")
    for name in ("bench", "rival"):
        make_station(folder / name, name).close()
    return folder


@pytest.fixture
def desk(tmp_path: Path, prepared: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path, prepared)
    yield desk
    desk.clear()


@pytest.fixture
def station(desk: Desk) -> Station:
    return desk.station()


@pytest.fixture
def node(desk: Desk) -> Iterator[CNode]:
    """Yield a new node in C that is not powered yet; ended politely, so that make firmware-coverage has its counts."""
    made = CNode(desk, builds.host(), desk.folder / "flash.bin", desk.new_uuid().hex())
    yield made
    if made.process is not None and made.process.runs:
        made.process.signal(signal.SIGTERM)
        made.process.end()
