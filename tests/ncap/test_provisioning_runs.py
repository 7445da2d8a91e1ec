"""Provisioning on request, without nodes: one run for each node, and what becomes of it on its way to the node."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    StoreError,
    UsageError,
)
from teds_provision.links import Notice
from teds_provision.ncap.nodes import provisioning
from teds_provision.ncap.nodes.node_jobs import NodeJobs
from teds_provision.ncap.nodes.provisioning import NEXT, AutoProvisioner, Provisioning, ProvisioningRun
from teds_provision.protocol.messages.frames import Reason
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.station.store.audit import ACTOR, acting_for
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


@pytest.mark.parametrize("uuid", [NODE, NEXT])
def test_what_was_asked_for_is_what_is_built(desk: Desk, monkeypatch: pytest.MonkeyPatch, uuid: str) -> None:
    """It is built before the tap and at the tap; the log has who asked, whichever thread works then."""
    orders, known, actors = list[Any](), list[Any](), list[str | None]()
    desk.runs._trusted = (Path("lab.pem"),)

    def prepare(_station: Any, order: Any, uuid: bytes | None) -> None:
        orders.append(order)
        known.append(uuid)

    def provision(_station: Any, _node: Any, order: Any, **more: Any) -> Any:
        orders.append(order)
        actors.append(ACTOR.get())
        more["reporter"].started("sign")
        more["reporter"].finished(SimpleNamespace(name="sign", result="done", detail="sequence 2"))
        return SimpleNamespace(verified=SimpleNamespace(verdict="authentic"))

    monkeypatch.setattr(provisioning, "prepare", prepare)
    monkeypatch.setattr(provisioning, "provision", provision)
    more = {"name": "left", "channel": 2, "item": "r1", "adopt": True, "accept": "new cell"}
    with acting_for("robot 7"):
        desk.runs.begin(uuid, **ORDER | more)
    assert ACTOR.get() != "robot 7"
    assert desk.tap(NODE)
    assert actors == ["robot 7"]
    assert known == [bytes.fromhex(NODE) if uuid == NODE else None]
    for order in orders:
        path = order.calibration
        assert path.name == "calibration.csv"
        assert order == BuildOrder(
            profile="gripper", name="left", calibration=path, channel=2, item="r1", adopt=True,
            accept_calibration="new cell", trusted=(Path("lab.pem"),),
        )  # fmt: skip
    assert desk.runs.run_of(NODE) == {
        "uuid": NODE, "state": "done", "waits_for": None, "until": None, "error": None, "verdict": "authentic",
        "steps": [{"name": "sign", "result": "done", "detail": "sequence 2"}],
    }  # fmt: skip


def test_a_run_whose_node_is_not_authentic_at_the_end_has_failed(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_verified: Any) -> None:
        raise NotAuthenticError("Its signature is not good.")

    monkeypatch.setattr(provisioning, "require_authentic", refuse)
    desk.runs.begin(NODE, **ORDER)
    assert desk.tap(NODE)
    until(lambda: desk.state(NODE) == "failed")
    run = desk.runs.run_of(NODE)
    assert (run["verdict"], run["waits_for"], run["until"]) == ("authentic", None, None)
    assert run["error"]["message"] == "Its signature is not good."
    assert desk.course[-1] == ("ab", "failed")


def test_a_node_that_is_being_provisioned_is_not_begun_again_and_one_that_never_came_is_waited_for_no_more(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.runs._runs[OTHER] = ProvisioningRun(OTHER)
    with pytest.raises(UsageError, match="already being provisioned"):
        desk.runs.begin(OTHER, **ORDER)
    monkeypatch.setattr(provisioning, "WAITING", 0.0)
    desk.runs.begin(NODE, **ORDER)
    until(lambda: desk.state(NODE) == "failed")
    run = desk.runs.run_of(NODE)
    assert (run["waits_for"], run["until"], run["error"]["code"]) == (None, None, "no-node")
    assert not desk.tap(NODE), "nothing waits any more"
    monkeypatch.setattr(provisioning, "WAITING", 60.0)
    desk.runs.begin(NODE, **ORDER)
    assert desk.tap(NODE)


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
        ({"listed": 256}, True),
        ({"new": True}, True),
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
    who = SimpleNamespace(whitelisted=None if change.get("new") else object(), fingerprint="f")
    newcomers: list[Any] = []

    def agree(*_words: Any, newcomer: Any) -> Any:
        newcomers.append(newcomer)
        return SimpleNamespace(epoch=1)

    for name, found in (("identify", who), ("list_blocks", [None] * change.get("listed", 5))):
        monkeypatch.setattr(provisioning, name, lambda *_words, found=found, **_more: found)
    monkeypatch.setattr(provisioning, "agree", agree)
    monkeypatch.setattr(provisioning, "new_whitelist_entry", lambda *_words: "its entry")
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
    assert newcomers == (["its entry" if change.get("new") else None] if adopted else [])


@pytest.mark.parametrize("error", [BadDataError("It has no unit."), PolicyError("Another node has its name.")])
def test_a_datasheet_that_was_refused_is_tried_again_once_its_node_was_reset(
    error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried, events = list[bool](), list[str]()

    def provision(*_words: Any, **_more: Any) -> Any:
        tried.append(True)
        raise error

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
    ("change", "signed"),
    [
        ({}, True),
        ({"signs": False}, False),
        ({"adopts": False}, False),
        ({"virtual": True}, False),
        ({"wired": False}, False),
        ({"tapped": True}, False),
        ({"held": False}, False),
        ({"pinned": False}, False),
        ({"state": NodeState.PROVISIONED}, False),
    ],
)
def test_with_yes_the_own_datasheet_of_a_node_that_this_station_keyed_on_a_wire_is_signed(
    change: dict[str, Any], signed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    def is_so(word: str) -> bool:
        return bool(change.get(word, True))

    done: list[Any] = []
    station: Any = SimpleNamespace(
        keys=SimpleNamespace(held=lambda _uuid: is_so("held")),
        pins=SimpleNamespace(entry=lambda _uuid: object() if is_so("pinned") else None),
    )
    virtuals: Any = {NODE: None} if change.get("virtual") else {}
    none: Any = None
    auto = AutoProvisioner(station, none, none, virtuals, lambda: is_so("adopts"), signs=is_so("signs"))

    def provision(_station: Any, _node: Any, order: Any, **_more: Any) -> Any:
        done.append(order)
        return SimpleNamespace(verified="verified")

    monkeypatch.setattr(provisioning, "provision", provision)
    monkeypatch.setattr(provisioning, "_show_verified", lambda _directory, *shown: done.append(shown))
    capabilities = SimpleNamespace(wired=is_so("wired"))
    node: Any = SimpleNamespace(
        uuid=bytes.fromhex(NODE),
        tapped=change.get("tapped", False),
        identity=SimpleNamespace(state=change.get("state", NodeState.KEYED)),
        contact=SimpleNamespace(link=SimpleNamespace(capabilities=capabilities)),
    )
    assert auto.serve(node) is signed
    assert done == ([BuildOrder(adopt=True), (NODE, "verified")] if signed else [])


def test_a_node_of_more_teds_than_a_stranger_may_have_is_not_adopted(monkeypatch: pytest.MonkeyPatch) -> None:
    none: Any = None
    auto = Auto(SimpleNamespace(policy=SimpleNamespace(tombstone=lambda _uuid: None)), none)
    monkeypatch.setattr(provisioning, "identify", lambda *_words: None)
    monkeypatch.setattr(provisioning, "list_blocks", lambda _node: [None] * 257)
    contact = SimpleNamespace(link=SimpleNamespace(capabilities=SimpleNamespace(wired=True)))
    identity = SimpleNamespace(state=NodeState.FACTORY)
    node: Any = SimpleNamespace(uuid=bytes.fromhex(NODE), tapped=False, identity=identity, contact=contact)
    with pytest.raises(BadDataError, match="lists 257 TEDS; one with more than 256 is not adopted"):
        auto.serve(node)


@pytest.mark.parametrize("profile", ["gripper", None])
def test_a_virtual_transducer_gets_what_it_was_made_of(profile: str | None, monkeypatch: pytest.MonkeyPatch) -> None:
    course: list[Any] = []

    class Made(dict[str, None]):
        """The one transducer of the station."""

        def profile_of(self, _uuid: str) -> str | None:
            return profile

        def calibration_of(self, _uuid: str) -> Path:
            return Path("calibration.toml")

        def name_of(self, _uuid: str) -> str:
            return "hand"

        def blocks_of(self, uuid: str) -> dict[str, str]:
            return {"of": uuid}

    @contextmanager
    def locked(_uuid: bytes) -> Iterator[None]:
        course.append("locked")
        yield

    def provision(_station: Any, _node: Any, order: Any, **_more: Any) -> Any:
        course.append(order)
        return SimpleNamespace(verified="verified")

    def write_sheet(_station: Any, _node: Any, blocks: Any, _reporter: Any) -> Any:
        course.append(blocks)
        return SimpleNamespace(verified="verified")

    nodes = SimpleNamespace(remember=lambda uuid, **facts: course.append((uuid, facts)))
    none: Any = None
    station: Any = SimpleNamespace(node_lock=locked, nodes=nodes)
    made: Any = Made({NODE: None})
    auto = AutoProvisioner(station, none, none, made, lambda: False)
    monkeypatch.setattr(provisioning, "provision", provision)
    monkeypatch.setattr(provisioning, "write_sheet", write_sheet)
    monkeypatch.setattr(provisioning, "identify", lambda *_words: "who")
    monkeypatch.setattr(provisioning, "agree", lambda _station, _node, who: course.append(who))
    monkeypatch.setattr(provisioning, "_show_verified", lambda _directory, *shown: course.append(shown))
    identity = SimpleNamespace(state=NodeState.FACTORY)
    node: Any = SimpleNamespace(uuid=bytes.fromhex(NODE), tapped=False, identity=identity)
    assert auto.serve(node)
    if profile is not None:
        assert course[:-1] == [BuildOrder("gripper", calibration=Path("calibration.toml"), name="hand")]
    else:
        assert course[:-1] == ["locked", "who", {"of": NODE}, (bytes.fromhex(NODE), {"name": "hand"})]
    assert course[-1] == (NODE, "verified")


@pytest.mark.parametrize(
    ("name", "file"),
    [
        (None, "calibration.csv"), ("Cell.CSV", "calibration.csv"), ("a.b.Json", "calibration.json"),
        ("x.toml", "calibration.toml"), ("x.txt", "calibration.txt"), ("dcc.xml", "calibration.xml"),
    ],
)  # fmt: skip
def test_a_calibration_is_of_the_form_that_its_name_ends_in(tmp_path: Path, name: str | None, file: str) -> None:
    made = provisioning._file(tmp_path, "raw,value\n", name)
    assert made == tmp_path / file
    assert made.read_text() == "raw,value\n"
    with pytest.raises(UsageError, match=r"Unsupported calibration file: 'cell\.xls'"):
        provisioning._file(tmp_path, "x", "cell.xls")


def test_a_full_disk_is_a_failure_of_the_store_and_leaves_the_run_before_it(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.runs.begin(NODE, **ORDER)
    assert desk.tap(NODE)

    def full(*_words: Any, **_facts: Any) -> None:
        raise OSError(28, "No space left on device")

    for patched in ((provisioning, "_file"), (tempfile, "TemporaryDirectory")):
        with monkeypatch.context() as patch:
            patch.setattr(*patched, full)
            patch.setattr(tempfile, "tempdir", str(tmp_path))
            with pytest.raises(StoreError) as failed:
                desk.runs.begin(NODE, **ORDER)
        assert failed.value.message == "No temporary file can be written: No space left on device."
        assert failed.value.hint == f"Make room in {tmp_path}, then try again."
        assert desk.state(NODE) == "done"
        assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("begun", [False, True])
def test_a_node_that_is_tapped_at_the_very_end_of_its_time_is_provisioned(
    begun: bool, desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its work has begun as the time is over: it is no longer waited for, and not failed."""

    class Errand:
        error: Exception | None = None

        def __init__(self) -> None:
            self.done = self
            self.waits: list[float | None] = []

        def wait(self, seconds: float | None = None) -> bool:
            self.waits.append(seconds)
            return seconds is None

    errand, cleaned = Errand(), list[bool]()
    monkeypatch.setattr(desk.jobs, "wait_for", lambda *_words: errand)
    monkeypatch.setattr(desk.jobs, "cancel", lambda _job: not begun)
    run = ProvisioningRun(NODE)
    desk.runs._wait_for_a_tap(run, lambda _node: None, lambda: cleaned.append(True))
    until(lambda: cleaned)
    if begun:
        assert (errand.waits, run.state, run.error) == ([300.0, None], "waiting", None)
    else:
        assert (errand.waits, run.state, run.waits_for, run.until) == ([300.0], "failed", None, None)
        assert run.error == {
            "code": "no-node",
            "message": f"Node {NODE} was not placed on a reader within 300 s.",
            "hint": "Try again, and hold its NFC antenna flat on the reader.",
        }


def test_a_run_that_nobody_requested_cannot_be_cancelled(desk: Desk) -> None:
    with pytest.raises(NotFoundError, match=f"No provisioning was requested for node {NODE}"):
        desk.runs.cancel(NODE)


@pytest.mark.parametrize(
    ("error", "code", "message"),
    [
        (PolicyError("It is another owner's.", hint="Ask it."), "refused", "It is another owner's."),
        (SessionLostError(NodeSilentError("It is silent.")), "node-silent", "It is silent."),
        (RuntimeError("a bug"), "bug", "Unexpected RuntimeError."),
    ],
)
def test_a_run_on_a_bus_that_ends_in_whatever_way_says_why_and_leaves_no_file(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, error: Exception, code: str, message: str
) -> None:
    def provision(*_: Any, **__: Any) -> Any:
        raise error

    @contextmanager
    def apart(_uuid: str, _why: str) -> Iterator[None]:
        yield

    def with_node(uuid: str, _what: str, work: Any) -> None:
        work(SimpleNamespace(uuid=bytes.fromhex(uuid)))

    monkeypatch.setattr(provisioning, "provision", provision)
    monkeypatch.setattr(desk.runs, "_apart", apart)
    monkeypatch.setattr(desk.jobs, "on_a_bus", lambda _uuid: True)
    monkeypatch.setattr(desk.jobs, "with_node", with_node)
    desk.runs.begin(NODE, **ORDER)
    until(lambda: desk.state(NODE) == "failed")
    until(lambda: not desk.files[0].exists())
    found = desk.runs.run_of(NODE)["error"]
    assert (found["code"], found["message"]) == (code, message)


def test_what_a_run_waits_for_is_an_event(desk: Desk) -> None:
    events: list[dict[str, Any]] = []
    live: Any = SimpleNamespace(event=lambda kind, **facts: events.append({"event": kind, **facts}))
    run: Any = SimpleNamespace(uuid=NODE, steps=[])
    provisioning._RunReporter(run, live).notice(Notice("retry", "It is busy."))
    assert events == [{"event": "provision", "uuid": NODE, "state": "running", "text": "It is busy."}]


def test_a_run_is_done_only_when_its_node_is_shown(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """A client that sees the end may ask for the node at once."""
    shown: list[tuple[Any, ...]] = []

    def show(directory: Any, uuid: str, verified: Any) -> None:
        shown.append((directory is desk.runs._directory, uuid, verified.verdict, desk.state(uuid)))

    monkeypatch.setattr(provisioning, "_show_verified", show)
    desk.runs.begin(NEXT, **ORDER)
    assert desk.tap(OTHER)
    until(lambda: desk.state(OTHER) == "done")
    assert shown == [(True, OTHER, "authentic", "running")]
