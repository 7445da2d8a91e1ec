"""A process that exports or imports and is killed before its n-th statement or step on disk: ``kill -9`` for real."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

from teds_provision import files
from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.station.station import Station
from teds_provision.station.store.database import Database
from tests.bench import PASSPHRASE


@contextmanager
def counted(at: Callable[[int], None]) -> Iterator[None]:
    """Call ``at(n)`` before the n-th change: each statement that is no SELECT, and each step that writes a file."""
    count = 0

    def step() -> None:
        nonlocal count
        count += 1
        at(count)

    def hooked(real: Callable[..., Any]) -> Callable[..., Any]:
        def run(self: Database, statement: str, values: Any = ()) -> Any:
            if not statement.startswith("SELECT"):
                step()
            return real(self, statement, values)

        return run

    def filed(real: Callable[..., Any]) -> Callable[..., Any]:
        def run(*words: Any, **more: Any) -> Any:
            step()
            return real(*words, **more)

        return run

    with (
        patch.object(Database, "execute", hooked(Database.execute)),
        patch.object(Database, "change", hooked(Database.change)),
        patch.object(Database, "execute_many", hooked(Database.execute_many)),
        patch.object(files, "_publish", filed(files._publish)),
        patch.object(files, "sync_folder", filed(files.sync_folder)),
    ):
        yield


def open_station(home: Path) -> Station:
    return Station.open(home, ask=lambda prompt, confirm: PASSPHRASE)


def export(station: Station, bundle: Path) -> None:
    """A move of all nodes, as the command does it."""
    export_bundle(station, plan_export(station, ExportOrder(("south",), None, "move")), bundle)


def take(station: Station, bundle: Path) -> bytes:
    """An import, as the command does it; returns the receipt."""
    plan = plan_import(station, bundle.read_bytes())
    done = import_bundle(station, plan) if isinstance(plan, ImportPlan) else plan
    return done.receipt


def main(home: str, act: str, last: str, bundle: str) -> None:
    """Do it, and die before step ``last``."""

    def die(count: int) -> None:
        if count == int(last):
            os.kill(os.getpid(), signal.SIGKILL)

    station = open_station(Path(home))
    station.credentials()
    with counted(die):
        (export if act == "export" else take)(station, Path(bundle))


if __name__ == "__main__":
    main(*sys.argv[1:])
