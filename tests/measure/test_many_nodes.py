"""Fifty nodes at once over one bus: found by a few questions, begun together, nothing lost but to the machine."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator

import pytest

from teds_provision.links.can.isotp import FUNCTIONAL
from teds_provision.links.can.port import CanPort
from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig, crowd, of, states

pytestmark = [pytest.mark.link, pytest.mark.realtime]  # who began with the others is known by when it was heard
NODES = 50


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("many"), {f"n{number}": ANGLE for number in range(NODES)})
    try:
        crowd(made.can, [node.folder for node in made.nodes.values()], made.desk)
        made.station.ask("group", "create", "crowd", *(node.uuid for node in made.nodes.values()))
        yield made
    finally:
        made.close()


def test_fifty_nodes_are_measured_at_once(rig: Rig) -> None:
    uuids = [node.uuid for node in rig.nodes.values()]
    asked, stop = [0], threading.Event()
    port = CanPort(f"{rig.can}&source=0xF7")

    def count() -> None:
        with port.listen_frames(lambda frame: frame.identifier == FUNCTIONAL | 0xF1) as ear:
            while not stop.is_set():
                asked[0] += ear.get(0.1) is not None

    listening = threading.Thread(target=count)
    listening.start()
    try:
        began = time.monotonic()
        lines = rig.measure("crowd", "--rate", 5, "--duration", 3)
        seconds = time.monotonic() - began
    finally:
        stop.set()
        listening.join(60)
        port.close()
    end = lines[-1]
    assert len(end["nodes"]) == NODES
    assert "error" not in end
    for node in end["nodes"]:
        [stream] = node["streams"]
        assert (stream["late"], stream["bad"]) == (0, 0), node
        assert stream["samples"] + stream["lost"] >= 10, node
    lost = sum(node["streams"][0]["lost"] for node in end["nodes"])
    every = sum(node["streams"][0]["messages"] for node in end["nodes"])
    assert lost <= 0.1 * every, "what a busy machine costs"
    assert states([line for line in lines if line.get("uuid") == uuids[0]])[-1] == "ended"
    assert asked[0] <= 1 + seconds / 2, "one look-out asks for all of them"
    firsts = [line["time"][0] for uuid in uuids for line in of(lines, uuid)[:1] if line["index"] == 0]
    together = sum(abs(first - min(firsts)) < 0.05 for first in firsts)
    assert together >= NODES * 0.8, "who was there in time began with the others"
