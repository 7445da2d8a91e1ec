"""Somebody on the bus says a new UUID each time: the daemon neither grows nor loses the nodes beside him."""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Iterator
from contextlib import suppress
from http.client import HTTPException
from pathlib import Path
from typing import Any

import pytest

from teds_provision.ncap.nodes.directory import MOST_GONE, NodeDirectory
from teds_provision.station.station import Station
from teds_provision.teds.profile import load_profile
from teds_provision.teds.sheet import Sheet
from tests.cli.shell import PROGRAM
from tests.e2e.desk import ANGLE
from tests.measure.rig import Rig, events
from tests.ncap.service import Service, until, verdict
from tests.strangers.attackers import Attacker, always_new, silent_strangers
from tests.strangers.wire import of_spec

STRANGERS = range(60, 100)


class NoListeners:
    """Nobody listens."""

    def event(self, *_words: Any, **_facts: Any) -> None: ...

    def last(self, *_words: Any) -> None: ...


def test_nodes_are_listed_by_name_those_that_are_there_first(prepared: Path, tmp_path: Path) -> None:
    shutil.copytree(prepared / "bench", tmp_path / "bench")
    silence: Any = NoListeners()
    names = {"a1" * 10: "arm 10", "b2" * 10: "", "c3" * 10: "arm 2", "d4" * 10: "Arm 1", "e5" * 10: "zebra"}
    with Station.inspect(tmp_path / "bench") as station:
        for uuid, name in names.items():
            station.nodes.remember(bytes.fromhex(uuid), name=name)
        listed = NodeDirectory(station, silence)
        listed.refresh()
        listed.note("e5" * 10, "came", present=True)
        assert [node["name"] or None for node in listed.nodes()] == ["zebra", "Arm 1", "arm 2", "arm 10", None]


def test_a_datasheet_that_was_read_just_now_is_in_the_next_answer_and_so_is_its_end(
    prepared: Path, tmp_path: Path
) -> None:
    """Parts of the answer are cached until something changes."""
    shutil.copytree(prepared / "bench", tmp_path / "bench")
    silence: Any = NoListeners()
    sheet = Sheet.from_blocks(load_profile("accelerometer").build(bytes(10)).blocks)
    with Station.inspect(tmp_path / "bench") as station:
        listed, uuid = NodeDirectory(station, silence), "a" * 20
        listed.note(uuid, "came", present=True, looked=1.0)

        def channels() -> int:
            return len(json.loads(listed.nodes_text())["nodes"][0]["channels"])

        assert channels() == 0
        listed.show_sheet(uuid, sheet)
        assert channels() == 3
        listed.show_sheet(uuid, None)
        assert channels() == 0


def test_nodes_that_left_and_are_not_known_are_forgotten_but_the_latest(prepared: Path, tmp_path: Path) -> None:
    """The units in which their datasheets were shown had been kept: a few hundred octets for each invented UUID."""
    shutil.copytree(prepared / "bench", tmp_path / "bench")
    silence: Any = NoListeners()
    with Station.inspect(tmp_path / "bench") as station:
        roster = NodeDirectory(station, silence)
        roster.note("a" * 20, "came", present=True, looked=1.0)
        for number in range(2 * MOST_GONE):
            uuid = f"{number:020x}"
            roster.note(uuid, "came", present=True, looked=1.0)
            roster.show_sheet(uuid, Sheet.from_blocks({}))
            roster.nodes_text(1, number % 2)
            roster.note(uuid, "left", present=False)
        assert len(roster.uuids()) == MOST_GONE + 1
        assert not roster.known(f"{0:020x}")
        assert {"a" * 20, uuid} <= set(roster.uuids())
        kept = {name: held for name, held in vars(roster).items() if isinstance(held, dict) and f"{0:020x}" in held}
        assert not kept


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    made = Rig(tmp_path_factory.mktemp("crowds"), {"a": ANGLE})
    yield made
    made.close()


@pytest.mark.link
def test_a_node_of_the_whitelist_does_not_wait_for_strangers(rig: Rig, tmp_path: Path) -> None:
    """Forty that answer nothing but Identify had kept every worker for minutes."""
    group, port = of_spec(rig.desk.links.can)
    service = Service(rig.desk, rig.station, ("--detection", "transparent"))
    with Attacker(group, port, silent_strangers(STRANGERS)):
        asked = service.start(program=PROGRAM).client()
        until(lambda: sum(node["present"] for node in asked.nodes()) == len(STRANGERS))
        rig.nodes["a"].start(can=rig.desk.links.can)
        until(lambda: asked.node(rig.nodes["a"].uuid)["verified"])
        assert verdict(asked.node(rig.nodes["a"].uuid)) == "authentic"
        waiting = sum(node["verdict"] is None and node["problem"] is None for node in asked.nodes())
        assert waiting > len(STRANGERS) / 2, "the strangers still waited when it had been looked at"
    service.end()
    rig.nodes["a"].kill()


@pytest.mark.link
def test_the_count_of_strangers_is_reported_now_and_then(rig: Rig) -> None:
    """Each new UUID was a line of the log: with five a second half a million a day."""
    group, port = of_spec(rig.desk.links.can)
    service = Service(rig.desk, rig.station, ("--detection", "whitelist"))
    requests: list[bytes] = []
    with Attacker(group, port, always_new(STRANGERS, requests)):
        asked = service.start(program=PROGRAM).client()
        until(lambda: len(requests) > 2 * len(STRANGERS) and asked.status()["strangers"])
    assert service.process is not None
    service.end()
    notices = [line for line in events(service.process.out) if line.get("state") == "strangers"]
    assert 1 <= len(notices) < 10, json.dumps(notices)


@pytest.mark.link
def test_reads_of_a_node_that_does_not_answer_hold_up_no_other_request(rig: Rig) -> None:
    """Six of them, with a token that may only read, had stopped the whole API: status, other tokens, set points."""
    service = Service(rig.desk, rig.station, ("--detection", "whitelist"))
    node = rig.nodes["a"].start(can=rig.desk.links.can)
    asked = service.start(program=PROGRAM).client()
    until(lambda: asked.node(node.uuid)["verified"])
    reader = {"Authorization": f"Bearer {service.token('reader', '--read-only')}"}
    writer = {"Authorization": f"Bearer {service.token('writer')}", "Content-Type": "application/json"}
    node.kill()
    read: list[int] = []

    def ask() -> None:
        with suppress(OSError, HTTPException):  # the daemon ended
            read.append(service.raw("GET", f"/api/v1/nodes/{node.uuid}/teds", reader).status)

    readers = [threading.Thread(target=ask, daemon=True) for _ in range(12)]
    for number in readers:
        number.start()
    until(lambda: asked.node(node.uuid)["busy"] or asked.status(), "it is being read")
    assert service.raw("GET", "/api/v1/status", writer).status == 200
    assert service.raw("PUT", f"/api/v1/nodes/{node.uuid}/channels/1", writer, '{"hold": 0}').status < 500
    assert not read, "a node that is silent is waited for, and all of this was answered before"
    service.kill()
    for number in readers:
        number.join(60)


def test_the_text_of_a_node_is_made_again_when_it_changed_and_while_it_ages(monkeypatch: pytest.MonkeyPatch) -> None:
    nothing: Any = None
    silence: Any = NoListeners()
    roster, made = NodeDirectory(nothing, silence), list[str]()
    channel: dict[str, Any] = {"last": None, "actuator": None}

    def node(uuid: str) -> dict[str, Any]:
        made.append(uuid)
        return {"uuid": uuid, "count": len(made), "channels": [channel], "problem": None, "measuring": None}

    monkeypatch.setattr(roster, "node", node)

    def counts(*, reader: bool = False) -> list[int]:
        return [shown["count"] for shown in json.loads(roster.nodes_text(reader=reader))["nodes"]]

    roster.note("a" * 20, "came", present=True)
    assert [counts(), counts(), counts(reader=True), counts(reader=True), counts()] == [[1], [1], [2], [2], [1]]
    roster.note("a" * 20, problem=None)
    assert [counts(), counts()] == [[3], [3]], "something of it changed"
    roster.touch()
    assert [counts(), counts()] == [[4], [4]], "names of topics changed"
    for member in channel:
        channel.update({"last": None, "actuator": None} | {member: {"age": 0.1}})
        roster.touch()
        before = len(made)
        assert [counts(), counts()] == [[before + 1], [before + 2]], f"its {member} has an age"
