"""Trust, bans and the whitelist as commands change them, each a process, beside `measure`, `ncap run` and `set`."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any

import pytest

from teds_provision.handover.incoming import ImportPlan, import_bundle, plan_import
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.station.station import Station
from teds_provision.teds.profile import shipped_profiles
from tests.bench import PASSPHRASE, make_station
from tests.e2e.desk import Running
from tests.handover.desk import trust
from tests.measure.rig import Rig, RigNode, events, provisioned
from tests.measure.test_actuator_safety import Journal, Ros2, time_of
from tests.ncap.service import Service, unix, verdict, verified
from tests.pace import until
from tests.places import ros_domain

pytestmark = [pytest.mark.link, pytest.mark.realtime]
LIMIT = 2.0
"""Seconds after the command in which the node's measurement ends (cli.md, "Today's verdict")."""
SLACK = 1.5
"""Seconds that the machine may need to run the threads and to hand over the lines."""


@dataclass(frozen=True)
class Decision:
    """A command of the person, the exit code of a measurement that it ends, and a part of the reason."""

    words: tuple[str, ...]
    code: int
    why: str


DECISIONS = {
    "trust removed": Decision(("trust", "remove", "crane", "--yes"), 4, "not authentic now"),
    "revoked": Decision(("revoke", "{uuid}", "--why", "stolen", "--yes"), 4, "was revoked: stolen"),
    "unlisted": Decision(("whitelist", "remove", "{uuid}", "--yes"), 6, "is not on the whitelist"),
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    """Yield a gripper that station `crane` signed and handed over as a copy to `bench`, which trusts it."""
    rig = Rig(tmp_path_factory.mktemp("today"), {})
    crane = make_station(rig.folder / "crane", "crane")
    bench = Station.open(rig.station.home, ask=lambda prompt, confirm: PASSPHRASE)
    try:
        trust(bench, crane)
        trust(crane, bench)
        uuid = provisioned(crane, rig.folder / "handed", "gripper", "g", rig.desk.new_uuid())
        bundle = rig.folder / "handed.jwe"
        export_bundle(crane, plan_export(crane, ExportOrder(("bench",), (bytes.fromhex(uuid),))), bundle)
        plan = plan_import(bench, bundle.read_bytes())
        assert isinstance(plan, ImportPlan)
        import_bundle(bench, plan)
    finally:
        crane.close()
        bench.close()
    rig.nodes["g"] = RigNode(rig, rig.folder / "handed", uuid).start()
    rig.desk.links = type(rig.desk.links)(rig.desk.links.nfc, rig.can)
    yield rig
    rig.close()


_HOMES = count()


@pytest.fixture
def rig(made: Rig) -> Iterator[Rig]:
    """Yield the rig with a home in which nothing was decided yet."""
    before = made.station
    made.station = made.copy(f"home{next(_HOMES)}")
    with made.visited():
        yield made
    made.station = before


def decide(rig: Rig, decision: Decision) -> float:
    """Run the command of a decision; returns when it had ended (unix)."""
    rig.station.ask(*(word.format(uuid=rig.nodes["g"].uuid) for word in decision.words))
    return time.time()


def left_of(service: Running) -> list[dict[str, Any]]:
    """Return the events by which measurements released a node."""
    service.read(0.1)
    lines = events(service.out)
    return [line for line in lines if (line.get("event"), line.get("state")) == ("measurement", "left")]


def require_in_time(decided: float) -> None:
    seconds = time.time() - decided
    assert seconds < LIMIT + SLACK, f"it ended after {seconds:.2f} s"


def require_safe(journal: Journal, decided: float) -> None:
    """Wait until the last state of the actuator is the safe one; its time is the node's."""
    until(lambda: journal.states()[-1]["safe"], lambda: journal.states()[-3:])
    seconds = time_of(journal.states()[-1]) - decided
    assert seconds < LIMIT, f"in its safe state after {seconds:.2f} s"


@pytest.mark.parametrize("decision", DECISIONS.values(), ids=DECISIONS)
def test_measure_ends_with_the_reason_and_marks_its_recording(rig: Rig, decision: Decision, tmp_path: Path) -> None:
    file = tmp_path / "run.csv"
    running = rig.begin(rig.nodes["g"].uuid, "--rate", 20, "--to", file)
    running.wait_for('"event":"data"')
    decided = decide(rig, decision)
    outcome = running.end()
    require_in_time(decided)
    assert outcome.code == decision.code, outcome
    lines = events(outcome.out)
    [refused] = [line for line in lines if line["event"] == "status" and line.get("state") == "refused"]
    assert decision.why in refused["why"]
    [left] = [line for line in lines if line["event"] == "left"]
    assert (left["uuid"], left["why"]) == (rig.nodes["g"].uuid, refused["why"]), "as ncap has it"
    assert decision.why in lines[-1]["error"]["message"]
    assert decision.why in file.read_text()


OTHER_SELECTION = pytest.mark.nightly(
    "tests/ncap/test_decided_today.py::test_ncap_releases_the_node_moves_it_no_more_and_marks_its_recording: each "
    "decision, and each selection"
)
IN_THE_GATE = {("trust removed", "uuids"), ("revoked", "match"), ("unlisted", "uuids")}


@pytest.mark.parametrize(
    ("decision", "selected"),
    [
        pytest.param(decision, how, marks=() if (name, how) in IN_THE_GATE else OTHER_SELECTION, id=f"{name}-{how}")
        for name, decision in DECISIONS.items()
        for how in ("uuids", "match")
    ],
)
def test_ncap_releases_the_node_moves_it_no_more_and_marks_its_recording(
    rig: Rig, decision: Decision, selected: str
) -> None:
    uuid = rig.nodes["g"].uuid
    recorded = rig.station.home / "recorded"
    service = Service(rig.desk, rig.station).start("--record", recorded, "--dead-man", 10_000)
    assert verdict(verified(service, uuid)) == "authentic"
    journal = Journal.of(rig)
    with service.client() as asked:
        what: dict[str, Any] = {"uuids": [uuid]} if selected == "uuids" else {"match": "all"}
        asked.request("POST", "/measurements", {**what, "rate": 20})
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured")
        asked.request("PUT", f"/nodes/{uuid}/channels/1", {"value": 0.05, "hold": 60})
        journal.moves()
        decided = decide(rig, decision)
        assert service.process is not None
        process = service.process
        [left] = until(lambda: left_of(process), lambda: process.out)
        require_in_time(decided)
        assert left["uuid"] == uuid
        assert decision.why in left["why"]
        assert unix(left) - decided < LIMIT
        require_safe(journal, decided)
        recordings = [file for file in recorded.rglob("*") if file.is_file()]
        assert recordings
    service.end()
    assert any(decision.why.encode() in file.read_bytes() for file in recordings), recordings


def test_a_node_that_is_listed_again_does_not_wait_for_the_next_try(rig: Rig) -> None:
    """A measurement by UUID waited out its pause, up to 30 s; and the page kept the unit of an edited profile."""
    uuid = rig.nodes["g"].uuid
    [entry] = [entry for entry in rig.station.ask("whitelist", "list")["whitelist"] if entry["uuid"] == uuid]
    service = Service(rig.desk, rig.station).start()
    assert verdict(verified(service, uuid)) == "authentic"
    with service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [uuid], "rate": 20})
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured")
        decide(rig, DECISIONS["unlisted"])
        # 1, 2 and 4 s are over
        until(lambda: "again in 8 s" in (asked.node(uuid)["measuring"] or {}).get("why", ""))
        units = [channel["shown"]["unit"] for channel in asked.node(uuid)["channels"]]
        rig.station.ask("whitelist", "add", uuid, "--fingerprint", entry["fingerprint"])
        listed = time.monotonic()
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured again")
        assert time.monotonic() - listed < LIMIT + SLACK

        assert "um" not in units
        folder = rig.station.home / "profiles"
        folder.mkdir(exist_ok=True)
        text = (shipped_profiles() / "gripper.toml").read_text()
        text = text.replace('unit = "mm"\n', 'unit = "mm"\ndisplay-unit = "um"\n', 1)
        (folder / "gripper.toml").write_text(text)
        until(lambda: "um" in [channel["shown"]["unit"] for channel in asked.node(uuid)["channels"]], "the old unit")
    service.end()


@pytest.mark.parametrize("decision", DECISIONS.values(), ids=DECISIONS)
def test_set_ends_and_its_actuator_is_safe(rig: Rig, decision: Decision) -> None:
    words = ["set", rig.nodes["g"].uuid, 1, 0.05, "--dead-man", 10_000, "--can", rig.can]
    acting, journal = rig.station.start("--json", *words), Journal.of(rig)
    acting.wait_for('"applied"')
    journal.moves()
    decided = decide(rig, decision)
    outcome = acting.end()
    require_in_time(decided)
    assert outcome.code == decision.code, outcome
    assert decision.why in outcome.out
    require_safe(journal, decided)


def test_a_consumer_that_goes_on_moves_nothing_after_its_signer_lost_trust(rig: Rig) -> None:
    """`measure --ros2`: set points by a topic end with the trust, though their publisher lives."""
    pytest.importorskip("cyclonedds")
    with ros_domain() as domain:
        ros = Ros2(domain)
        words = [rig.nodes["g"].uuid, "--rate", 20, *ros.words, "--dead-man", 10_000]
        running = rig.begin(*words, environment=ros.environment)
        running.wait_for('"event":"data"')
        journal, publisher = Journal.of(rig), ros.publish()
        try:
            journal.moves()
            decided = decide(rig, DECISIONS["trust removed"])
            assert running.end().code == 4
            require_in_time(decided)
            require_safe(journal, decided)
        finally:
            publisher.kill()
            publisher.wait()


def test_a_node_that_was_taken_out_of_service_is_not_tried_for_ever_by_a_frozen_measurement(rig: Rig) -> None:
    uuid = rig.nodes["g"].uuid
    service = Service(rig.desk, rig.station).start()
    assert verdict(verified(service, uuid)) == "authentic"
    with service.client() as asked:
        asked.request("POST", "/measurements", {"match": "type:gripper", "frozen": True, "rate": 20})
        until(lambda: (asked.node(uuid)["measuring"] or {}).get("state") == "running", "it is not measured")
        rig.station.ask("decommission", uuid, "--force", "--yes", "--can", rig.can, "--timeout", 2)
        [measurement] = until(
            lambda: [known for known in asked.measurements() if not known["uuids"]], asked.measurements
        )
        assert (measurement["state"], measurement["why"]) == ("waiting", "no known node matches")
        until(lambda: asked.node(uuid)["measuring"] is None, lambda: asked.node(uuid)["measuring"])
    service.end()
