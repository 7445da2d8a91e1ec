"""A node beside its own measurement: commands that write to it, and a second board with its UUID."""

from __future__ import annotations

import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from teds_provision.errors import NodeRefusedError
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.protocol.messages.frames import Reason
from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig, RigNode, events, of, ran
from tests.pace import until

pytestmark = pytest.mark.link


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("rig"), {"a": ANGLE, "b": ANGLE})
    try:
        made.nodes["a"].start("--source", "ramp:1000000")  # steady, for a zero
        yield made
    finally:
        made.close()


def test_no_sequence_is_used_up_for_a_node_that_is_being_measured(rig: Rig) -> None:
    uuid = rig.nodes["a"].uuid
    calibration = rig.folder / "new.csv"
    calibration.write_text("# date: 2026-11-01\nraw,value [degree]\n0,0\n65535,359\n")
    provision = ("provision", uuid, "--profile", ANGLE, "--calibration", calibration, "--yes", "--via", "can")
    measuring = rig.begin(uuid, "--rate", 10)
    measuring.wait_for('"event":"data"')
    for words in (provision, ("calibrate", "zero", uuid, 1, "--value", 0.5, "--yes")):
        refused = rig.ask(*words, code=6)["error"]
        assert refused["code"] == "frozen", refused
        assert f"pid {measuring.process.pid} (measure {uuid[:8]})" in refused["message"]
        [node] = rig.station.ask("nodes", uuid)["nodes"]
        assert node["sequence"] == 1, "nothing was signed"
    assert rig.ask("provision", uuid, "--yes", "--via", "can")["verdict"] == "authentic", "there is nothing to write"
    measuring.signal(signal.SIGTERM)
    ended = measuring.end()
    assert ended.code == 0, ended
    assert "lost" not in [line.get("state") for line in events(ended.out)]
    assert rig.ask(*provision)["verdict"] == "authentic"
    [node] = rig.station.ask("nodes", uuid)["nodes"]
    assert node["sequence"] == 2


def test_two_boards_with_one_uuid_at_one_address_are_named_and_end_no_other_measurement(rig: Rig) -> None:
    """Copies answer octet for octet alike: no answer of the address alone shows that they are two.

    One that answers every question before the other keeps its session: its second is measured, and both are named.
    """
    a, b = rig.nodes["a"], rig.nodes["b"]
    b.start()
    beside = rig.begin(b.uuid, "--rate", 20)
    beside.wait_for('"event":"data"')
    shutil.copytree(a.folder, rig.folder / "twin")
    twin = RigNode(rig, rig.folder / "twin", a.uuid).start()
    outcome = rig.begin(a.uuid, "--rate", 10, "--duration", 1, "--timeout", 3).end()
    assert outcome.code in (0, 5), outcome
    if outcome.code:
        assert events(outcome.out)[-1]["error"]["code"] == "address-conflict", outcome
    assert outcome.err.count("Two nodes answer at CAN address") == 1, "once, not at each question"
    assert rig.ask("identify", "--via", "can", code=5)["error"]["code"] == "address-conflict"
    before = beside.out.count('"event":"data"')
    twin.kill()
    assert of(rig.measure(a.uuid, "--rate", 10, "--duration", 0.5), a.uuid), "one of them is gone"
    until(lambda: (beside.read(0.1), beside.out.count('"event":"data"') > before)[1])
    beside.signal(signal.SIGTERM)
    ended = beside.end()
    assert (ended.code, ran(events(ended.out))) == (0, ["running", "ended"]), ended


def test_a_node_without_room_beside_its_other_measurement_is_refused_at_once_and_names_it() -> None:
    """It was tried until the time-out, and then the link's budget was blamed."""
    request = MeasurementRequest(beside={bytes(10): "pid 7 (measure all)"})
    full = NodeRefusedError("The node refused to stream.", reason=Reason.DOES_NOT_FIT)
    unlike = NodeRefusedError("The node is busy.", reason=Reason.BUSY)

    def supervisor(uuid: bytes, wanted: MeasurementRequest) -> NodeSupervisor:
        none: Any = None
        events = Events(none, none, none)
        return NodeSupervisor(none, none, uuid, wanted, none, events, none)

    excess = supervisor(bytes(10), request)._is_shared(full)
    assert excess is not None
    assert "is also being measured by pid 7 (measure all)" in excess.message
    assert supervisor(bytes(10), request)._is_shared(unlike) is None
    assert supervisor(b"another...", request)._is_shared(full) is None
    assert supervisor(bytes(10), replace(request, patient=True))._is_shared(full) is None, "ncap waits for room"
