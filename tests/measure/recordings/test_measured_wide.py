"""Real nodes into a grid, and into an MCAP beside it: the same values, read by pandas and by rosbags."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from tests.cli.shell import call
from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("rig"), {"a": ANGLE, "b": ANGLE})
    try:
        for node in made.nodes.values():
            node.start()
        yield made
    finally:
        made.close()


@pytest.mark.realtime  # a value that comes more than 0.1 s late is in the recording, and in no row of the grid
def test_two_nodes_are_one_grid_which_pandas_reads(rig: Rig, tmp_path: Path) -> None:
    import pandas as pd

    grid, whole = tmp_path / "run.csv", tmp_path / "run.mcap"
    uuids = [node.uuid for node in rig.nodes.values()]
    rig.measure(*uuids, "--rate", 50, "--to", grid, "--to", whole, "--wide", "--duration", 2)
    table = pd.read_csv(grid, comment="#")
    assert table.columns[0] == "time"
    assert set(table.columns[1:]) == {"a/angle [rad]", "b/angle [rad]"}
    assert table["time"].is_monotonic_increasing
    assert table.dropna().shape[0] > 10, "rows in which both have a value"
    [same] = json.loads(
        call(tmp_path / "home", "--json", "record", "convert", whole, tmp_path / "w.csv", "--wide").out
    )["files"]
    later = pd.read_csv(same, comment="#")
    both = table.merge(later, on="time", suffixes=("", " again")).dropna()
    assert len(both) > 10
    np.testing.assert_allclose(both["a/angle [rad]"], both["a/angle [rad] again"], rtol=1e-9)
    with AnyReader([whole]) as bag:
        offered = {connection.topic: connection.ext.offered_qos_profiles for connection in bag.connections}  # type: ignore[union-attr]
        kinds = {connection.topic: connection.msgtype for connection in bag.connections}
    [sheet], [stream] = offered["/bench/a/teds"], offered["/bench/a/stream_0"]
    assert (sheet.durability.name, sheet.depth) == ("TRANSIENT_LOCAL", 1)
    assert (stream.reliability.name, stream.durability.name) == ("RELIABLE", "VOLATILE")
    assert kinds["/bench/a/stream_0"] == "teds_provision_msgs/msg/Samples"
