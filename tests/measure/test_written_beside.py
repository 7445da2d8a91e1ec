"""Commands that write to a node which a `measure` of the same station has: refused before anything is signed."""

from __future__ import annotations

import signal
from collections.abc import Iterator

import pytest

from tests.e2e.desk import ANGLE
from tests.measure.hall import Hall, events

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def hall(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hall]:
    made = Hall(tmp_path_factory.mktemp("hall"), {"a": ANGLE})
    try:
        made.nodes["a"].start("--source", "ramp:1000000")  # steady, for a zero
        yield made
    finally:
        made.close()


def test_no_sequence_is_used_up_for_a_node_that_is_being_measured(hall: Hall) -> None:
    uuid = hall.nodes["a"].uuid
    calibration = hall.folder / "new.csv"
    calibration.write_text("# date: 2026-11-01\nraw,value [degree]\n0,0\n65535,359\n")
    provision = ("provision", uuid, "--profile", ANGLE, "--calibration", calibration, "--yes", "--via", "can")
    measuring = hall.begin(uuid, "--rate", 10)
    measuring.wait_for('"event":"data"')
    for words in (provision, ("calibrate", "zero", uuid, 1, "--value", 0.5, "--yes")):
        refused = hall.ask(*words, code=6)["error"]
        assert refused["code"] == "frozen", refused
        assert f"pid {measuring.process.pid} (measure {uuid[:8]})" in refused["message"]
        [node] = hall.station.ask("nodes", uuid)["nodes"]
        assert node["sequence"] == 1, "nothing was signed"
    assert hall.ask("provision", uuid, "--yes", "--via", "can")["verdict"] == "authentic", "there is nothing to write"
    measuring.signal(signal.SIGTERM)
    ended = measuring.end()
    assert ended.code == 0, ended
    assert "lost" not in [line.get("state") for line in events(ended.out)]
    assert hall.ask(*provision)["verdict"] == "authentic"
    [node] = hall.station.ask("nodes", uuid)["nodes"]
    assert node["sequence"] == 2
