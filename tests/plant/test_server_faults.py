"""The registry's server dies at every step of a sync: the next sync carries on, and nothing is lost or sent twice."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from teds_provision import plant as plant_room
from teds_provision.errors import RegistryError
from teds_provision.plant.demo.cluster import Cluster
from teds_provision.plant.postgres import PostgresTransport
from teds_provision.plant.sync import sync
from teds_provision.protocol.plant.roster import Share
from teds_provision.station.station import Station
from tests.plant.handing import board_of
from tests.plant.postgres import own_cluster
from tests.plant.test_synced_by_database import Office, roster_with

pytestmark = pytest.mark.system


class MortalTransport:
    """A post whose server dies, as by a power cut, before the k-th thing that is asked of it; then it is back."""

    def __init__(self, transport: PostgresTransport, cluster: Cluster, step: int) -> None:
        self._transport, self._cluster, self.left = transport, cluster, step

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._transport, name)
        return self._counted(found) if callable(found) else found

    def _counted(self, asked: Callable[..., Any]) -> Callable[..., Any]:
        def ask(*words: Any, **more: Any) -> Any:
            self.left -= 1
            if self.left == 0:
                self._cluster.stop(signal.SIGQUIT)
                self._cluster.start()
            return asked(*words, **more)

        return ask


def survived(office: Office, cluster: Cluster, *steps: int) -> int:
    """A key is shared, a roster changes, pages wait: each sync loses its server; returns how many did."""
    south, reached = office.member("south", "base"), 0
    for step in steps:
        roster_with(office, Share(("all", ""), (south.fingerprint,)))  # a new version each time
        board = board_of(office.north, os.urandom(10))
        for station in (office.north, south, office.north):
            reached += died(office, cluster, station, step)
        office.sync(office.north, south, office.north, south)
        assert [key.epoch for key in south.keys.keys_of(board.uuid)] == [1], step
        assert office.database.sql("select count(*) from registry.parcel") == [["0"]], step
        assert office.database.sql("select count(*) = max(n) from registry.page group by station") == [["t"], ["t"]]
        assert office.database.sql("select count(distinct jws) from registry.roster") == [["1"]], step
        for any_station in (office.north, south):
            assert any_station.plant.alarms.all() == [], step
            assert any_station.plant.unsent() == 0, step
        assert plant_room.parcels.waiting_out(office.north) == 0, step
        plant_room.apply_pages.put_roster(office.north, plant_room.owner.signed(
            office.north, plant_room.owner.unshared(office.north, ("all", ""))))  # fmt: skip
        office.sync(office.north, south)
    return reached


def died(office: Office, cluster: Cluster, station: Station, step: int) -> bool:
    transport = office.transport(station)
    mortal = MortalTransport(transport, cluster, step)
    with suppress(RegistryError):
        sync(station, mortal)  # type: ignore[arg-type]
    transport.close()
    return mortal.left <= 0


@pytest.mark.soak
def test_a_server_that_dies_at_any_step_of_a_sync_costs_nothing(tmp_path: Path) -> None:
    with own_cluster() as cluster:
        office = Office(tmp_path, cluster)
        assert survived(office, cluster, *range(1, 14)) >= 20
        office.plant.close()
