"""Provisioning on request, without nodes: one run for each node, and what becomes of it on its way to the node."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NodeRefusedError, NotFoundError, UsageError
from teds_provision.ncap.nodes import provisioning
from teds_provision.ncap.nodes.node_jobs import NodeJobs
from teds_provision.ncap.nodes.provisioning import NEXT, AutoProvisioner, Provisioning, ProvisioningRun
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from tests.pace import until

NODE, OTHER = "ab" * 10, "cd" * 10
ORDER: dict[str, Any] = {"profile": "gripper", "name": None, "calibration": "raw,value\n", "calibration_name": "a.csv"}


class Desk:
    """Requests whose steps are replaced: ``course`` has what they did, ``files`` where their calibrations lay."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        none: Any = None
        self.course: list[Any] = []
        self.files: list[Path] = []
        self.prepared: Exception | None = None
        live = SimpleNamespace(event=lambda kind, **facts: self.course.append((facts["uuid"][:2], facts["state"])))
        absent: Any = SimpleNamespace(seen=lambda _uuid: SimpleNamespace(present=False, place=""))
        self.jobs = NodeJobs(absent, none, none)
        directory = SimpleNamespace(show_sheet=lambda *_: None, refresh=lambda _uuids: None, note=lambda *_, **__: None)
        words: Any = (None, directory, live, self.jobs)
        self.runs = Provisioning(*words)

        def prepare(_station: Any, order: Any, _uuid: Any) -> None:
            self.files.append(order.calibration)
            if self.prepared is not None:
                raise self.prepared

        def provision(_station: Any, _node: Any, order: Any, **_more: Any) -> Any:
            assert order.calibration.read_text() == "raw,value\n", "the file is there as long as the run"
            return SimpleNamespace(verified=SimpleNamespace(verdict="authentic"))

        monkeypatch.setattr(provisioning, "prepare", prepare)
        monkeypatch.setattr(provisioning, "provision", provision)
        monkeypatch.setattr(provisioning, "require_authentic", lambda _verified: None)

    def tap(self, uuid: str) -> bool:
        node: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(uuid))
        return self.jobs.serve(node)

    def state(self, uuid: str) -> str:
        found: str = self.runs.run_of(uuid)["state"]
        return found


@pytest.fixture
def desk(monkeypatch: pytest.MonkeyPatch) -> Desk:
    return Desk(monkeypatch)


def test_a_request_that_cannot_be_built_leaves_the_run_before_it(desk: Desk) -> None:
    desk.prepared = BadDataError("No such profile.")
    with pytest.raises(BadDataError):
        desk.runs.begin(NODE, **ORDER)
    with pytest.raises(NotFoundError):
        desk.runs.run_of(NODE)
    desk.prepared = None
    desk.runs.begin(NODE, **ORDER)
    assert desk.tap(NODE)
    desk.prepared = BadDataError("No such profile.")
    with pytest.raises(BadDataError):
        desk.runs.begin(NODE, **ORDER)
    assert desk.state(NODE) == "done"
    until(lambda: not any(file.parent.exists() for file in desk.files), "a calibration lies there still")


def test_a_node_has_one_run_at_a_time_and_the_next_one_has_a_name_as_soon_as_it_is_there(desk: Desk) -> None:
    for uuid in (NODE, NEXT):
        assert desk.runs.begin(uuid, **ORDER)["waits_for"] == "tap"
        with pytest.raises(UsageError, match="already being provisioned"):
            desk.runs.begin(uuid, **ORDER)
    assert desk.tap(OTHER)
    assert (desk.state(NODE), desk.state(OTHER)) == ("waiting", "done")
    with pytest.raises(NotFoundError):
        desk.runs.run_of(NEXT)
    desk.runs.begin(NEXT, **ORDER)
    assert desk.runs.cancel(NEXT)["state"] == "cancelled"
    assert desk.runs.cancel(OTHER)["state"] == "done", "what has begun goes on to its end"
    assert desk.tap(NODE)
    assert not desk.tap(OTHER), "nothing waits any more"
    until(lambda: not any(file.parent.exists() for file in desk.files), "a calibration lies there still")
    assert desk.course == [
        ("ab", "waiting"), ("ne", "waiting"), ("cd", "running"), ("cd", "done"),
        ("ne", "waiting"), ("ne", "cancelled"), ("ab", "running"), ("ab", "done"),
    ]  # fmt: skip


def test_a_node_that_takes_a_key_at_a_reader_alone_begins_there_from_the_start(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, cleaned = ProvisioningRun(NODE, steps=[{"name": "identify", "result": "done"}]), list[bool]()
    desk.runs._runs[NODE] = run
    refusals = [Reason.NOT_PERMITTED, Reason.BUSY]

    def with_node(*_words: Any) -> None:
        raise NodeRefusedError("Not here.", reason=refusals.pop(0))

    monkeypatch.setattr(desk.jobs, "with_node", with_node)
    desk.runs._on_the_bus(run, lambda _node: None, lambda: cleaned.append(True))
    assert (run.state, run.waits_for, run.steps, cleaned) == ("waiting", "tap", [], [])
    assert desk.runs.cancel(NODE)["state"] == "cancelled"
    until(lambda: cleaned == [True])
    desk.runs._on_the_bus(run, lambda _node: None, lambda: cleaned.append(True))
    assert (run.state, cleaned) == ("failed", [True, True])


class Auto(AutoProvisioner):
    """Takes up every permitted node; a board's own datasheet is signed at once."""

    def __init__(self, station: Any, live: Any) -> None:
        none: Any = None
        virtuals: Any = {}
        super().__init__(station, none, live, virtuals, lambda: True, signs=True)


@pytest.mark.parametrize(
    ("change", "adopted"),
    [
        ({}, True),
        ({"tapped": True}, False),
        ({"wired": False}, False),
        ({"moved": True}, False),
        ({"state": NodeState.PROVISIONED}, False),
    ],
)
def test_a_factory_node_of_a_wired_bus_is_adopted_unless_it_was_given_away(
    change: dict[str, Any], adopted: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A node that was moved to another station comes back by a move, not because it was reset."""
    done: list[str] = []

    @contextmanager
    def locked(_uuid: bytes) -> Iterator[None]:
        yield

    policy = SimpleNamespace(tombstone=lambda _uuid: object() if change.get("moved") else None)
    station = SimpleNamespace(policy=policy, node_lock=locked, audit=lambda act, *_words, **_facts: done.append(act))
    auto = Auto(station, SimpleNamespace(event=lambda _kind, **facts: done.append(facts["state"])))
    who = SimpleNamespace(whitelisted=object(), fingerprint="f")
    for name, found in (("identify", who), ("list_blocks", []), ("agree", SimpleNamespace(epoch=1))):
        monkeypatch.setattr(provisioning, name, lambda *_words, found=found, **_more: found)
    monkeypatch.setattr(provisioning, "replace", lambda identity, **facts: SimpleNamespace(**vars(identity) | facts))
    monkeypatch.setattr(auto, "_sign_own", lambda node: node.identity.state == NodeState.KEYED)
    capabilities = SimpleNamespace(wired=change.get("wired", True))
    node: Any = SimpleNamespace(
        uuid=bytes.fromhex(NODE),
        tapped=change.get("tapped", False),
        identity=SimpleNamespace(state=change.get("state", NodeState.FACTORY), epoch=0),
        contact=SimpleNamespace(link=SimpleNamespace(capabilities=capabilities)),
    )
    assert auto.serve(node) is adopted
    assert done == (["adopt", "adopted"] if adopted else [])


def test_a_datasheet_that_was_refused_is_tried_again_once_its_node_was_reset(monkeypatch: pytest.MonkeyPatch) -> None:
    tried, events = list[bool](), list[str]()

    def provision(*_words: Any, **_more: Any) -> Any:
        tried.append(True)
        raise BadDataError("It has no unit.")

    monkeypatch.setattr(provisioning, "provision", provision)
    policy = SimpleNamespace(tombstone=lambda _uuid: object())
    station = SimpleNamespace(
        policy=policy, keys=SimpleNamespace(held=lambda _uuid: True), pins=SimpleNamespace(entry=lambda _uuid: object())
    )
    auto = Auto(station, SimpleNamespace(event=lambda _kind, **facts: events.append(facts["state"])))
    contact = SimpleNamespace(link=SimpleNamespace(capabilities=SimpleNamespace(wired=True)))

    def comes(state: NodeState) -> None:
        node: Any = SimpleNamespace(
            uuid=bytes.fromhex(NODE), tapped=False, identity=SimpleNamespace(state=state), contact=contact
        )
        assert not auto.serve(node)

    for _ in range(3):
        comes(NodeState.KEYED)
    assert (len(tried), events) == (1, ["not adopted"])
    comes(NodeState.FACTORY)
    comes(NodeState.KEYED)
    assert (len(tried), events) == (2, ["not adopted"] * 2)


@pytest.mark.parametrize(
    ("name", "file"), [(None, "calibration.csv"), ("Cell.CSV", "calibration.csv"), ("a.b.Json", "calibration.json")]
)
def test_a_calibration_is_of_the_form_that_its_name_ends_in(tmp_path: Path, name: str | None, file: str) -> None:
    made = provisioning._file(tmp_path, "raw,value\n", name)
    assert made == tmp_path / file
    assert made.read_text() == "raw,value\n"
    with pytest.raises(UsageError, match=r"Unsupported calibration file: 'cell\.xls'"):
        provisioning._file(tmp_path, "x", "cell.xls")
