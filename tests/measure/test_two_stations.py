"""Two stations at one robot: both measure under copied keys, and the actuator obeys one of them while that lives."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from teds_provision.client import ApiError, Client
from tests.bench import make_station
from tests.e2e.desk import Station
from tests.measure.rig import Rig
from tests.measure.test_actuator_safety import BUSY, HELD, Journal, rig_on
from tests.ncap.service import Service, verdict, verified
from tests.pace import until

pytestmark = [pytest.mark.realtime, pytest.mark.link]


def south_of(rig: Rig) -> Station:
    """Return a second station with its own key, to which the first one has copied the keys of all nodes."""
    make_station(rig.folder / "stations" / "south", "south").close()
    north, south, bundle = rig.station, rig.desk.station("south"), rig.folder / "keys.jwe"
    for station, other, name in ((north, south, "south"), (south, north, "bench")):
        key = rig.folder / f"{name}.pem"
        key.write_text(other.ask("init")["public_key"])
        station.ask("trust", "add", name, key, "--yes")
    ca = rig.folder / "bench.ca.pem"
    ca.write_text(north.ask("init")["ca"]["public_key"])
    south.ask("trust", "add", "bench-ca", ca, "--role", "ca", "--yes")
    north.ask("export-keys", "--to", "south", "--all", "--output", bundle, "--yes")
    south.ask("import-keys", bundle, "--yes")
    return south


def moved(asked: Client, uuid: str, value: float) -> Any:
    """Return what a station answers that is to move the gripper, None if another one has it."""
    try:
        return asked.request("PUT", f"/nodes/{uuid}/channels/1", {"value": value, "hold": 30})
    except ApiError as error:
        if error.code == "bad-request":
            raise
        return None


def test_the_second_station_takes_an_actuator_over_once_the_first_is_dead(tmp_path: Path) -> None:
    """No lease and no office between them: the node's claim refuses the second, its dead-man lets go of the first."""
    with rig_on(tmp_path) as rig:
        rig.desk.links = type(rig.desk.links)(rig.desk.links.nfc, rig.can)
        uuid = rig.nodes["g"].uuid
        first, second = Service(rig.desk, rig.station), Service(rig.desk, south_of(rig))
        first.start(), second.start()
        assert [verdict(verified(service, uuid)) for service in (first, second)] == ["authentic", "authentic"]
        with first.client() as north, second.client() as south:
            assert until(lambda: moved(north, uuid, 0.05), "the first never held it")
            Journal.of(rig).moves()
            assert moved(south, uuid, 0.02) is None, "two stations move one actuator"
            first.kill()
            killed = time.time()
            assert until(lambda: moved(south, uuid, 0.02), "it was never taken over")
            seconds = time.time() - killed
        journal = Journal.of(rig, HELD)
        journal.is_safe(killed)
        journal.moves(killed)
        print(f"taken over {seconds:.2f} s after kill -9")
        assert seconds < HELD + 2 * BUSY
        second.end()
