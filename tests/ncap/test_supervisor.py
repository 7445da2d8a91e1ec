"""The supervisor of measurements, in this process: one that fails, or a store that fails, stops no other."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from starlette.requests import Request
from starlette.responses import StreamingResponse

from teds_provision import client
from teds_provision.errors import (
    FrozenError,
    LinkError,
    NodeBusyError,
    NoNodeError,
    NotFoundError,
    PolicyError,
    StoreError,
    UsageError,
)
from teds_provision.links.discovery import Sighting
from teds_provision.measure.blocks import InvalidValues, NodeReport
from teds_provision.measure.buses import Buses
from teds_provision.measure.matching import NodeLoad, NodeMatch, UnsignedNodes
from teds_provision.ncap import measurement_supervisor
from teds_provision.ncap.live import Live
from teds_provision.ncap.measurement_supervisor import MeasurementSupervisor, NodeLoan
from teds_provision.ncap.membership import AfterEnd, Member, Membership
from teds_provision.ncap.nodes.actuator_leases import ActuatorLeases
from teds_provision.ncap.nodes.directory import NodeDirectory
from teds_provision.ncap.nodes.node_jobs import NodeJobs, NodeLocks
from teds_provision.ncap.running_measurement import Phase, RunningMeasurement
from teds_provision.ncap.sinks import DaemonSinks
from teds_provision.ncap.web import resources as web
from teds_provision.ncap.web.guard import CALLER
from teds_provision.ncap.web.resources import Resources
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditEntry, AuditFilter
from teds_provision.station.store.records import KeptMeasurement, WhitelistEntry
from tests.bench import make_station
from tests.ncap.short_waits import SHORT
from tests.pace import until

NODE, OTHER = "ab" * 10, "cd" * 10


class Service:
    """A supervisor over a station without links."""

    def __init__(self, folder: Path) -> None:
        self.station: Station = make_station(folder)
        self.station.unlock()
        self.live, self.locks, self.buses = Live(), NodeLocks(), Buses()
        self.directory = NodeDirectory(self.station, self.live)
        sinks = DaemonSinks(self.station.home, actuators=False)
        self.measurements = MeasurementSupervisor(
            self.station, self.directory, self.live, self.locks, self.buses, sinks, lambda _point: True, waits=SHORT
        )
        self.locks.given = self.measurements.on_sighting

    def state(self, measurement: str) -> tuple[str, str]:
        every = {shown["id"]: (shown["state"], shown["why"]) for shown in self.measurements.all()}
        return every[measurement]

    def close(self) -> None:
        self.measurements.stop()
        self.buses.close()
        self.station.close()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    made = Service(tmp_path / "home")
    try:
        yield made
    finally:
        made.close()


def failing_once(service: Service, error: Exception, patch: pytest.MonkeyPatch) -> threading.Event:
    """Let the next look at the store fail; the event is set once it was tried again."""
    tried, again, version = threading.Event(), threading.Event(), service.station.version

    def fails() -> object:
        if tried.is_set():
            again.set()
            return version()
        tried.set()
        raise error

    patch.setattr(service.station, "version", fails)
    return again


def test_a_store_that_cannot_be_read_for_a_moment_ends_no_measurement(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    service.measurements.match("all")
    until(lambda: service.state("run") == ("waiting", "no matching node is present"))
    again = failing_once(service, StoreError("The disk is away."), monkeypatch)
    assert again.wait(10)
    assert service.state("run") == ("waiting", "no matching node is present")


def test_a_bug_in_one_measurement_ends_that_one_alone(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    made = service.measurements.add({"match": "name:x*"})["id"]
    service.measurements.match("all")
    until(lambda: [service.state(identifier)[0] for identifier in (made, "run")] == ["waiting"] * 2)
    again = failing_once(service, RuntimeError("bug"), monkeypatch)
    assert again.wait(10), "the other one looks at the store"
    until(lambda: "failed" in [service.state(identifier)[0] for identifier in (made, "run")])
    states = {identifier: service.state(identifier) for identifier in (made, "run")}
    assert sorted(state for state, _ in states.values()) == ["failed", "waiting"]
    assert [why for state, why in states.values() if state == "failed"] == ["Unexpected RuntimeError."]


def test_a_measurement_that_begins_while_a_writer_has_its_node_leaves_it_to_the_writer(service: Service) -> None:
    loan = NodeLoan(NODE, "let go for write")
    assert service.measurements.lend_node(loan) is False
    kept = service.station.measurements.keep(KeptMeasurement("", uuids=tuple(map(bytes.fromhex, (NODE, OTHER)))))
    running = service.measurements._begin(kept)

    def begun() -> set[str]:
        measurement = running.job.measurement if running.job is not None else None
        supervisors = measurement.supervisors if measurement is not None and measurement.ready.is_set() else ()
        return {supervisor.uuid.hex() for supervisor in supervisors if supervisor.begun}

    until(lambda: begun() == {OTHER})
    service.measurements.return_node(loan)
    assert begun() == {NODE, OTHER}


def test_an_actuator_of_a_node_that_a_writer_has_is_not_claimed(service: Service) -> None:
    """The datasheet does not change under a claim: the command would be refused in the middle of what it writes."""
    service.station.pins.put(WhitelistEntry(bytes.fromhex(NODE)))
    measurements, jobs = service.measurements, NodeJobs(service.directory, service.locks, lambda _place: None)
    leases = ActuatorLeases(
        service.station,
        service.live,
        jobs,
        service.locks,
        measurements.session,
        measurements.is_measured,
        measurements.lent_for,
    )
    loan = NodeLoan(NODE, "let go for write")
    measurements.lend_node(loan)
    with pytest.raises(NodeBusyError, match="busy: let go for write"):
        leases.put(NODE, 1, 0.5, None, None)
    measurements.return_node(loan)
    with pytest.raises(NoNodeError):
        leases.put(NODE, 1, 0.5, None, None)


def test_two_writers_of_one_node_wait_for_each_other_and_those_of_others_do_not(service: Service) -> None:
    loans = [NodeLoan(NODE, "let go for write"), NodeLoan(OTHER, "let go for write")]
    with service.measurements._one_at_a_time(NODE):
        first = threading.Thread(target=service.measurements.lend_node, args=(loans[0],), daemon=True)
        first.start()
        assert service.measurements.lend_node(loans[1]) is False
        assert service.measurements.lent_for(OTHER) == "let go for write"
        assert service.measurements.lent_for(NODE) is None
    first.join(10)
    assert service.measurements.lent_for(NODE) == "let go for write"


def lending(service: Service, *commands: str, updates: object = None) -> list[AsyncIterator[Any]]:
    """Ask for the one node as commands of this home do; returns the lines of each answer."""
    resources = Resources(SimpleNamespace(measuring=service.measurements, updates=updates))  # type: ignore[arg-type]
    answers = []
    for command in commands:
        scope = {"type": "http", "path_params": {"uuid": NODE}, "query_string": f"for={command}".encode()}
        scope[CALLER] = SimpleNamespace(kind="socket")
        answer = asyncio.run(resources.lend_until_closed(Request(scope)))
        assert isinstance(answer, StreamingResponse)
        answers.append(aiter(answer.body_iterator))
    return answers


def test_two_commands_that_wait_for_a_node_at_once_hear_that_they_wait(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second one waits for the first, longer than a command bears silence (client.LETTING_GO)."""
    assert 2 * web._STILL < client.LETTING_GO
    monkeypatch.setattr(web, "_STILL", 0.01)
    commands = lending(service, "write", "address")

    async def heard() -> None:
        with service.measurements._one_at_a_time(NODE):  # as if another were being lent it, or gave it back
            for _ in range(3):
                assert [await anext(command) for command in commands] == ["waiting\n"] * 2
        for command in commands:
            assert [line async for line in until_answered(command)][-1] == "not measured\n"
        whys = sorted(loan.why for loan in service.measurements._loans[NODE])
        assert whys == ["let go for address", "let go for write"]
        for command in commands:
            await command.aclose()  # type: ignore[attr-defined]

    asyncio.run(heard())
    until(lambda: service.measurements.lent_for(NODE) is None)


async def until_answered(lines: AsyncIterator[Any]) -> AsyncIterator[Any]:
    """Yield lines to the first that is the answer."""
    async for line in lines:
        yield line
        if line != "waiting\n":
            return


@pytest.mark.parametrize(("state", "ended"), [("running", ["This station holds no key of node"]), ("ended", [])])
def test_a_node_that_may_not_be_measured_is_ended_or_refused_by_its_own_supervisor(
    service: Service, state: str, ended: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that begins again, as after `reset`, was ended before it looked, and no client heard why."""
    service.measurements.match("all")
    until(lambda: service.state("run")[0] == "waiting")
    running, whys = service.measurements._running["run"], list[str]()
    supervisor: Any = SimpleNamespace(stop=whys.append, done=threading.Event())
    followed = threading.Event()

    def seen() -> list[Sighting]:
        followed.set()
        return []

    monkeypatch.setattr(service.buses.presence, "all", seen)
    running.reports[NODE] = {"state": state}
    running.membership.members[NODE] = Member(supervisor=supervisor)
    service.measurements.look_who_is_meant()
    assert followed.wait(10)
    assert [why[: len("This station holds no key of node")] for why in whys] == ended


def test_a_node_that_had_just_arrived_when_a_measurement_ends_is_given_back(service: Service) -> None:
    kept = KeptMeasurement("run", match="all")
    running = RunningMeasurement(kept, Membership(0.0), kept)
    service.locks.acquire(NODE, "measurement run", frozen=True)
    running.membership.arrive(NODE, 0.0)
    service.measurements._finish(running)
    assert service.locks.holder(NODE) is None


@pytest.mark.parametrize("measured", [True, False])
def test_a_node_that_is_signed_leaves_the_unverified_ones_with_its_reason(
    service: Service, monkeypatch: pytest.MonkeyPatch, measured: bool
) -> None:
    """It is lent for the block, and given back then."""
    whys = list[str]()
    supervisor: Any = SimpleNamespace(stop=lambda why="": whys.append(why))
    members = {NODE if measured else OTHER: Member(supervisor=supervisor)}
    running: Any = SimpleNamespace(membership=SimpleNamespace(members=members, has=lambda _uuid: False), deleted=False)
    monkeypatch.setitem(service.measurements._running, UnsignedNodes.text, running)
    returned = list[NodeLoan]()
    monkeypatch.setattr(service.measurements, "return_node", returned.append)
    with service.measurements.unmeasured(NODE, "let go for provision"):
        assert returned == []
    assert whys == (["let go for provision"] if measured else [])
    assert [(loan.uuid, loan.why) for loan in returned] == [(NODE, "let go for provision")]


def listed(service: Service, *uuids: str) -> RunningMeasurement:
    """Return a measurement of these nodes that is in the table and does nothing: its phase says that it is over."""
    kept = KeptMeasurement("1", uuids=tuple(map(bytes.fromhex, uuids)))
    running = RunningMeasurement(kept, service.measurements._listed(kept), kept, phase=Phase.OVER)
    running.over.set()
    service.measurements._running["1"] = running
    return running


def test_the_entry_of_a_measurement_has_its_counts_and_that_of_a_node_has_none(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = listed(service, NODE, OTHER)
    running.reports = {NODE: {"samples": 70, "lost": 2}, OTHER: {"samples": 5, "lost": None}}
    service.measurements._log(running, "joined", NODE)
    service.measurements._log(running, "ended")
    assert [(entry.uuid, entry.outcome, entry.detail) for entry in entries(service, "measure")] == [
        (bytes.fromhex(NODE), "joined", {"id": "1", "owner": "ncap"}),
        (None, "ended", {"id": "1", "owner": "ncap", "samples": 75, "lost": 2}),
    ]

    def full(*_words: Any, **_facts: Any) -> None:
        raise StoreError("The disk is full.")

    monkeypatch.setattr(service.station, "audit", full)
    service.measurements._log(running, "ended")  # a store that cannot be written ends no measurement


def entries(service: Service, act: str) -> list[AuditEntry]:
    return list(service.station.audit_log.chosen(AuditFilter(act=act)))


def test_a_writer_that_is_gone_before_its_turn_gets_no_node(service: Service) -> None:
    """Its loan would last until the service ends, and the node would be measured no more."""
    loan = NodeLoan(NODE, "let go for write")
    service.measurements.return_node(loan)
    assert service.measurements.lend_node(loan) is False
    assert service.measurements.lent_for(NODE) is None


def test_the_first_value_of_a_node_is_in_the_log_once_and_its_returns_are_events(service: Service) -> None:
    running, seen = listed(service, NODE), list[str]()
    service.live.on_event = lambda event: seen.append(event["state"]) if event["event"] == "measurement" else None
    for state in ("running", "lost", "running", "lost", "running"):
        service.measurements._report(running, NodeReport(NODE, state, samples=3))
    assert [entry.outcome for entry in entries(service, "measure")] == ["joined"]
    assert [state for state in seen if state in ("joined", "left")] == ["joined", "left", "joined", "left", "joined"]


def test_a_measurement_with_other_nodes_shows_no_reports_of_those_that_it_had(service: Service) -> None:
    running = listed(service, NODE, OTHER)
    running.reports = {NODE: {"state": "lost"}, OTHER: {"state": "running"}}
    service.measurements._set_members(running, replace(running.kept, uuids=(bytes.fromhex(OTHER),)))
    assert running.uuids == (OTHER,)
    assert running.reports == {OTHER: {"state": "running"}}


def test_the_log_has_what_a_deleted_measurement_counted(service: Service) -> None:
    running = listed(service, NODE, OTHER)
    for node in (NODE, OTHER):
        service.measurements._report(running, NodeReport(node, "running", samples=40, lost=2))
    service.measurements.delete("1")
    *_, ended = entries(service, "measure")
    assert (ended.outcome, ended.detail) == ("ended", {"id": "1", "owner": "ncap", "samples": 80, "lost": 4})


def test_a_node_whose_actuator_is_in_use_is_let_go_to_any_command_but_an_update(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The restart would end what the actuator does; another command writes after its release."""

    def require_free(uuid: str) -> None:
        assert uuid == NODE
        raise PolicyError("Actuator 3 of the board is in use; the restart would end that.")

    updates: Any = SimpleNamespace(require_free=require_free)

    async def answers() -> list[str]:
        lines = [[line async for line in until_answered(command)][-1] for command in commands]
        for command in commands:
            await command.aclose()  # type: ignore[attr-defined]
        return lines

    commands = lending(service, "update", "write", updates=updates)
    assert asyncio.run(answers()) == [
        "refused: Actuator 3 of the board is in use; the restart would end that.\n",
        "not measured\n",
    ]


def open_to(service: Service, monkeypatch: pytest.MonkeyPatch) -> RunningMeasurement:
    """Return a measurement that takes nodes in, in whose selection every node is, at a place with room."""
    running = listed(service)
    running.asked = running.kept = replace(running.kept, match="all")
    monkeypatch.setattr(service.measurements, "_why_not", lambda _running, _uuid: "")
    monkeypatch.setattr(service.measurements, "_room_of", lambda _uuid: 0.5)
    sighting = SimpleNamespace(identity=SimpleNamespace(state=None))
    monkeypatch.setattr(service.buses.presence, "seen_at", lambda _uuid: sighting)
    return running


def test_a_node_that_joins_is_shown_again_here_and_in_no_other_measurement(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, kept = open_to(service, monkeypatch), KeptMeasurement("2")
    other = RunningMeasurement(kept, Membership(0.0), kept)
    service.measurements._running["2"] = other
    other.over.set()
    supervisor: Any = object()
    measurement: Any = SimpleNamespace(join=lambda _uuid: supervisor)
    running.membership.members[NODE] = Member(joined=False, locked=True)
    running.past.add(NODE)
    service.measurements._join(running, measurement, NODE)
    assert running.membership.members[NODE].supervisor is supervisor
    assert (running.past, other.past, running.uuids) == (set(), {NODE}, (NODE,))
    assert service.directory.seen(NODE).measurement == "1"
    service.measurements._release(running, NODE)
    assert service.directory.seen(NODE).measurement is None


def test_a_node_that_ended_is_shown_on_unless_it_is_selected_no_more(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, job = open_to(service, monkeypatch), cast(Any, SimpleNamespace(lent=set()))
    done = threading.Event()
    ended: Any = SimpleNamespace(done=done, uuid=bytes.fromhex(NODE), error=None, sighting=None)
    for why, past in (("", set()), ("its name is not x*", {NODE})):
        running.membership.members[NODE] = Member(supervisor=ended)
        done.clear()
        service.measurements._reap(running, job, NODE, 0.0)
        assert NODE in running.membership.members, "it measures"
        done.set()
        job.lent.add(ended.uuid)
        service.measurements._reap(running, job, NODE, 0.0)
        assert NODE in running.membership.members, "it is lent to a writer, and comes back"
        job.lent.clear()
        monkeypatch.setattr(service.measurements, "_why_not", lambda _running, _uuid, why=why: why)
        service.measurements._reap(running, job, NODE, 0.0)
        assert (running.membership.members, running.past) == ({}, past)


def test_who_is_meant_is_asked_once_for_each_change(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    running, asked = open_to(service, monkeypatch), list[float]()

    def select_again(_seen: object) -> list[str]:
        asked.append(now)
        return []

    monkeypatch.setattr(running.membership, "select_again", select_again)
    running.version = service.station.version()
    for now in (1000.0, 2000.0, 3000.0):
        service.measurements._follow_the_store(running, now)
        service.measurements._follow_the_store(running, now)
        if now == 1000.0:
            service.measurements.look_who_is_meant()
    assert asked == [2000.0]


def test_a_measurement_that_is_stopped_does_not_begin_again_with_other_nodes(service: Service) -> None:
    for stopped in (False, True):
        running = listed(service, NODE)
        kept = service.station.measurements.keep(running.kept)
        running.kept = running.asked = kept
        running.again = True
        if stopped:
            running.stop.set()
        service.measurements._finish(running)
        assert running.phase is (Phase.OVER if stopped else Phase.LOCKING)
        assert running.again is stopped, "once"
        running.phase = Phase.OVER


def test_nodes_as_they_come_have_no_actuator_claimed_and_one_expression_is_measured_once(service: Service) -> None:
    made = service.measurements.add({"match": "all", "actuators": True, "rate": 20.0})
    assert not service.station.measurements.get(made["id"]).actuators
    service.measurements.match("all", rate=20.0)
    assert [shown["id"] for shown in service.measurements.all()] == [made["id"]]
    service.measurements.match("all", rate=10.0)
    assert {shown["id"] for shown in service.measurements.all()} == {made["id"], "run"}


def test_the_worst_bound_of_a_clock_is_that_of_a_node_which_gives_values_now(service: Service) -> None:
    assert service.measurements.clock_error() is None
    running = listed(service, NODE, OTHER)
    for node, state, error in ((NODE, "running", 0.002), (OTHER, "lost", 9.0)):
        service.measurements._report(running, NodeReport(node, state, clock_error=error))
    assert service.measurements.clock_error() == 0.002
    service.measurements._report(running, NodeReport(OTHER, "running"))
    assert service.measurements.clock_error() == 0.002, "none is known of it"


def test_a_node_whose_values_come_has_no_problem_any_more(service: Service) -> None:
    running = listed(service, NODE)
    for state, why, problem in (("refused", "It is revoked.", True), ("running", "", False), ("lost", "Silent.", True)):
        service.measurements._report(running, NodeReport(NODE, state, why))
        assert (service.directory.seen(NODE).problem is not None) is problem
        assert service.directory.seen(NODE).present is (state != "refused")


def test_a_measurement_is_shown_with_all_that_was_asked_and_what_its_nodes_report(service: Service) -> None:
    running = listed(service, NODE, OTHER)
    running.kept = replace(
        running.kept, channels=(1, 2), rate=50.0, dead_man=500, created=1700000000.0, owner="page", sinks=("ros2",)
    )
    running.state, running.why = "running", "1 of 2 nodes is missing"
    running.job = cast(
        Any,
        SimpleNamespace(
            measurement=None,
            sinks=[SimpleNamespace(files=(Path("/r/a.csv"), Path("/r/a.2.csv"))), SimpleNamespace(files=())],
        ),
    )
    said = NodeReport(NODE, "running", "slow", samples=9, lost=3, late=2, bad=1, invalid=4, clock_error=0.001, time=5.0)
    service.measurements._report(running, replace(said, invalid_why=(InvalidValues(1, "over range", 4),)))
    report = {
        "uuid": NODE, "state": "running", "why": "slow", "samples": 9, "lost": 3, "late": 2, "bad": 1, "invalid": 4,
        "clock_error": 0.001, "invalid_why": [{"channel": 1, "why": "over range", "count": 4}],
    }  # fmt: skip
    assert service.measurements._json(running) == {
        "group": None,
        "uuids": [NODE, OTHER],
        "match": None,
        "frozen": False,
        "channels": [1, 2],
        "rate": 50.0,
        "kind": None,
        "trigger": False,
        "sinks": ["ros2"],
        "actuators": False,
        "dead_man": 500,
        "scalar_rate": 10.0,
        "id": "1",
        "created": 1700000000.0,
        "owner": "page",
        "process": None,
        "state": "running",
        "why": "1 of 2 nodes is missing",
        "lower_rate": None,
        "nodes": [report, {"uuid": OTHER, "state": "waiting", "why": ""}],
        "files": ["/r/a.csv", "/r/a.2.csv"],
    }
    running.kept = replace(running.kept, owner="command", pid=7, started=12.5)
    shown = service.measurements._json(running)
    assert (shown["process"], shown["nodes"]) == ({"id": 7, "started": 12.5}, []), (
        "a command's own reports are not here"
    )


def test_a_node_that_left_is_shown_until_it_is_meant_no_more(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    running = open_to(service, monkeypatch)
    for node in (OTHER, NODE):
        running.reports[node] = {"uuid": node, "state": "lost"}
    running.membership.members[NODE] = Member()

    def shown() -> list[str]:
        return [report["uuid"] for report in service.measurements._json(running)["nodes"]]

    assert shown() == [NODE, OTHER]
    running.past.add(OTHER)
    assert shown() == [NODE]


def test_what_a_node_reports_is_an_event_and_its_state_on_the_page(service: Service) -> None:
    running, seen = listed(service, NODE), list[tuple[str, str]]()
    service.live.on_event = lambda event: (
        seen.append((event["state"], event["why"])) if event["event"] == "measurement" and "uuid" in event else None
    )
    service.directory.note(NODE, heard={"x": 1}, looked=1.0)
    table = (
        ("waiting", "", 1, {"x": 1}, None),
        ("waiting", "It is busy.", 1, {"x": 1}, "It is busy."),
        ("waiting", "It is busy.", 1, {"x": 1}, "It is busy."),
        ("running", "slowed", 2, None, None),
        ("running", "slowed", 3, None, None),
        ("lost", "Silent.", 3, None, "Silent."),
        ("refused", "Banned.", 3, None, "Banned."),
        ("refused", "Banned.", 3, None, "Banned."),
        ("ended", "renamed", 3, None, "Banned."),
    )
    for state, why, _, heard, problem in table:
        service.measurements._report(running, NodeReport(NODE, cast(Any, state), why))
        row = service.directory.seen(NODE)
        assert (row.heard, row.problem and row.problem["message"]) == (heard, problem), (state, why)
    assert seen == [("waiting", "It is busy."), ("joined", "slowed"), ("left", "Silent."), ("waiting", "Banned.")]


def test_a_node_that_leaves_as_its_measurement_is_stopped_says_so(service: Service) -> None:
    running, seen = listed(service, NODE, OTHER), list[str]()
    service.live.on_event = lambda event: seen.append(event["why"]) if event.get("state") == "left" else None
    for node in (NODE, OTHER):
        service.measurements._report(running, NodeReport(node, "running"))
    service.measurements._report(running, NodeReport(NODE, "ended"))
    service.measurements._report(running, NodeReport(NODE, "running"))
    running.stop.set()
    service.measurements._report(running, NodeReport(NODE, "ended"))
    service.measurements._report(running, NodeReport(OTHER, "ended", "renamed"))
    assert seen == ["", "the measurement ended", "renamed"]


def test_a_rate_is_proposed_for_a_group_or_for_nodes(service: Service) -> None:
    for named in ({}, {"group": "hand", "uuids": [NODE]}):
        with pytest.raises(UsageError, match="for a group, or for nodes"):
            service.measurements.proposed_rate(**cast(Any, named))
    with pytest.raises(NotFoundError, match="nobody"):
        service.measurements.proposed_rate(group="nobody")
    assert service.measurements.proposed_rate(uuids=[NODE]) is None, "no datasheet of it is known"


def test_a_report_of_a_measurement_that_a_node_has_left_is_no_problem_of_the_node(service: Service) -> None:
    kept = KeptMeasurement("2", uuids=(bytes.fromhex(NODE),))
    left = RunningMeasurement(kept, Membership(0.0), kept, phase=Phase.OVER)
    listed(service, NODE)
    service.measurements._report(left, NodeReport(NODE, "lost", "Silent."))
    assert service.directory.seen(NODE).problem is None


@pytest.mark.parametrize(
    ("members", "error", "words"),
    [
        ({}, UsageError, "needs a group, nodes, or an expression"),
        ({"group": "hand", "uuids": [NODE]}, UsageError, "needs a group, nodes, or an expression"),
        ({"match": "all", "uuids": [NODE]}, UsageError, "needs a group, nodes, or an expression"),
        ({"match": "group:nobody"}, NotFoundError, "nobody"),
        ({"match": "all", "trigger": True}, UsageError, "cannot start together"),
        ({"group": "nobody"}, NotFoundError, "nobody"),
        ({"uuids": [NODE], "sinks": ["udp"]}, UsageError, "not a sink"),
    ],
)
def test_what_can_never_be_measured_is_refused_and_not_kept(
    service: Service, members: dict[str, Any], error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        service.measurements.add(members)
    assert service.station.measurements.all() == []
    assert entries(service, "measure") == []


def test_what_is_measured_already_is_refused_to_others_and_a_sink_named_twice_is_one(service: Service) -> None:
    service.station.pins.put(WhitelistEntry(bytes.fromhex(NODE)))
    node = {"uuids": [NODE]}
    listed(service, NODE)
    with pytest.raises(NodeBusyError, match=f"Node {NODE} is already being measured \\(1\\)."):
        service.measurements.add(node)
    del service.measurements._running["1"]
    frozen = {"match": "name:x*", "trigger": True, "frozen": True, "sinks": ["ros2", "ros2"]}
    made = service.measurements.add(frozen, owner="page")
    kept = service.station.measurements.get(made["id"])
    assert (kept.trigger, kept.sinks, kept.owner, kept.dead_man) == (True, ("ros2",), "page", 1000)
    [begun] = entries(service, "measure")
    assert begun.detail == {"id": made["id"], "match": "name:x*", "owner": "page", "nodes": []}


def test_a_measurement_can_be_deleted_once_and_that_of_a_command_only_there(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    listed(service, NODE)
    service.measurements.delete("1")
    with pytest.raises(NotFoundError, match="'1'"):
        service.measurements.delete("1")
    monkeypatch.setattr(service.station.measurements, "all", lambda: [KeptMeasurement("9", owner="command", pid=4711)])
    with pytest.raises(PolicyError, match=r"Measurement 9 belongs to the command measure \(process 4711\)"):
        service.measurements.delete("9")


def test_a_node_that_two_borrow_comes_back_when_the_last_one_returns_it(service: Service) -> None:
    course, running = list[tuple[str, ...]](), listed(service, NODE)
    running.job = cast(
        Any,
        SimpleNamespace(
            kept=running.kept,
            suspend_node=lambda uuid, why, seconds: course.append(("let go", why, f"{seconds:g}")) or True,
            resume_node=lambda uuid: course.append(("resumed", uuid.hex())),
        ),
    )
    loans = [NodeLoan(NODE, "let go for write"), NodeLoan(NODE, "let go for rename")]
    assert [service.measurements.lend_node(loans[0]), service.measurements.lend_node(loans[1], 9.0)] == [True, True]
    assert service.measurements.lent_for(NODE) == "let go for write"
    running.asked_anew = False
    service.measurements.return_node(loans[0])
    assert (service.measurements.lent_for(NODE), running.asked_anew) == ("let go for rename", False)
    service.measurements.return_node(loans[0])
    assert service.measurements.lent_for(NODE) == "let go for rename", "what is returned twice is returned once"
    service.measurements.return_node(loans[1])
    assert (service.measurements.lent_for(NODE), running.asked_anew) == (None, True)
    assert course == [("let go", "let go for write", "4"), ("let go", "let go for rename", "9"), ("resumed", NODE)]


def test_a_node_that_is_not_let_go_in_time_or_is_in_a_frozen_measurement_is_lent_to_nobody(service: Service) -> None:
    course, running = list[str](), listed(service, NODE)
    running.job = cast(
        Any,
        SimpleNamespace(
            kept=running.kept,
            suspend_node=lambda _uuid, _why, _seconds: False,
            resume_node=lambda uuid: course.append(uuid.hex()),
        ),
    )
    with pytest.raises(NodeBusyError, match="was not released within 4 s"):
        service.measurements.lend_node(NodeLoan(NODE, "let go for write"))
    assert (course, service.measurements.lent_for(NODE)) == ([NODE], None), "it is measured on"
    cast(Any, running.job).kept = replace(running.kept, frozen=True)
    with pytest.raises(FrozenError, match=r"is in a frozen measurement \(1\)"):
        service.measurements.lend_node(NodeLoan(NODE, "let go for write"))
    assert service.measurements.lent_for(NODE) is None


@pytest.mark.parametrize(("seen", "stored", "asked"), [(7, 9, [9]), (7, 7, []), (7, None, []), (None, 9, [])], ids=str)
def test_a_node_that_got_another_address_is_asked_there_when_it_is_returned(
    service: Service, seen: int | None, stored: int | None, asked: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It announces no address that a command gave it, and would come back half a minute later."""
    heard: list[tuple[int, float]] = []
    discovery = SimpleNamespace(identify_at=lambda address, seconds: heard.append((address, seconds)))
    sighting = None if seen is None else SimpleNamespace(address=seen)
    monkeypatch.setattr(service.buses.presence, "seen_at", lambda _uuid: sighting)
    monkeypatch.setattr(service.buses, "bus_of", lambda _sighting: SimpleNamespace(discovery=discovery))
    monkeypatch.setattr(service.station.nodes, "get", lambda _uuid: SimpleNamespace(can_address=stored))
    service.measurements._ask_where_it_is(bytes.fromhex(NODE))
    assert heard == [(address, 1.0) for address in asked]


def test_a_share_of_the_bus_is_reserved_only_for_a_node_that_finds_room(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, expected = open_to(service, monkeypatch), list[tuple[list[bytes], float]]()
    share = SimpleNamespace(time=None, room=0.01, expect=lambda uuids, load: expected.append((uuids, load)))
    sighting = SimpleNamespace(uuid=bytes.fromhex(NODE))
    monkeypatch.setattr(service.buses.presence, "seen_at", lambda _uuid: sighting)
    monkeypatch.setattr(service.buses, "bus_of", lambda _sighting: SimpleNamespace(share=share))
    job: Any = SimpleNamespace(request=None)
    for load, reserved in ((0.4, [([bytes.fromhex(NODE)], 0.4)]), (0.6, [])):
        monkeypatch.setattr(measurement_supervisor, "load_of", lambda *_how, load=load: NodeLoad(load, 1, 1.0))
        running.membership.members[NODE] = Member(joined=False)
        expected.clear()
        service.measurements._reserve(running, job, NODE)
        assert (running.membership.members[NODE].load.bus, expected) == (load, reserved)


def test_a_node_that_finds_no_room_waits_half_a_minute_and_says_so_once(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, seen = open_to(service, monkeypatch), list[dict[str, Any]]()
    service.live.on_event = lambda event: seen.append(event) if event["event"] == "measurement" else None
    service.locks.acquire(NODE, "measurement 1", frozen=True)
    running.past.add(NODE)
    monkeypatch.setattr(measurement_supervisor, "time", SimpleNamespace(monotonic=lambda: 100.0, time=lambda: 0.0))
    for _ in range(2):
        running.membership.members[NODE] = Member(joined=False, locked=True, load=NodeLoad(26.0, 1, 1.0))
        service.measurements._join(running, cast(Any, None), NODE)
        assert (service.locks.holder(NODE), running.membership.members) == (None, {})
        waits = running.membership.waits[NODE]
        assert (waits.at, waits.room) == (130.0, 0.5)
    assert running.reports == {NODE: {"uuid": NODE, "state": "waiting", "why": "no room on the bus"}}
    assert [(event["state"], event["uuid"], event["why"]) for event in seen] == [
        ("waiting", NODE, "no room on the bus")
    ]
    assert running.past == set()


@pytest.mark.parametrize(
    ("phase", "match", "arrived", "pause"),
    [
        (Phase.ENDING, None, False, 0.05),
        (Phase.LOCKING, None, False, 0.1),
        (Phase.MEASURING, None, False, 0.5),
        (Phase.SELECTING, None, False, 0.5),
        (Phase.MEASURING, "all", False, 0.1),
        (Phase.MEASURING, "all", True, 0.05),
        (Phase.OVER, "all", True, None),
    ],
)
def test_the_table_is_looked_at_as_often_as_its_most_urgent_measurement_needs(
    service: Service, phase: Phase, match: str | None, arrived: bool, pause: float | None
) -> None:
    running = listed(service, NODE)
    assert service.measurements._pause() is None
    running.asked, running.phase = replace(running.asked, match=match), phase
    if arrived:
        running.membership.arrive(OTHER, 0.0)
    slow = RunningMeasurement(running.kept, Membership(0.0), running.kept, phase=Phase.OVER)
    slow.over.set()
    service.measurements._running["0"] = slow
    assert service.measurements._pause() == pause
    running.phase = Phase.OVER


def test_the_budget_counts_what_goes_to_topics_in_each_second(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = [100.0]
    monkeypatch.setattr(measurement_supervisor, "time", SimpleNamespace(monotonic=lambda: now[0]))
    service.measurements._messages = 100.0, 0
    topics, file = (SimpleNamespace(budgeted=on, stats=SimpleNamespace(messages=0)) for on in (True, False))
    monkeypatch.setattr(service.measurements, "_open_sinks", lambda: [("1", topics), ("1", file)])
    found = []
    for step, messages in ((0.9, 500), (0.1, 1000), (0.5, 5000), (1.5, 3000), (1.0, 0)):
        now[0] += step
        topics.stats.messages, file.stats.messages = messages, 10 * messages
        found.append(service.measurements.budget())
    assert found == [{"used": used, "limit": 5000} for used in (0.0, 1000.0, 1000.0, 1000.0, 0.0)]


def test_an_expression_that_selects_only_nodes_with_a_key_and_a_datasheet_in_service(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    uuids = [bytes([number]) * 10 for number in range(1, 7)]
    monkeypatch.setattr(service.station.keys, "all_key_names", lambda: [(uuid, 1, 1) for uuid in uuids] * 2)
    monkeypatch.setattr(
        measurement_supervisor, "why_not_measured", lambda _station, uuid: "banned" if uuid == uuids[1] else ""
    )
    monkeypatch.setattr(service.measurements, "_is_retired", lambda uuid: uuid == uuids[2].hex())
    monkeypatch.setattr(service.station.datasheets, "datasheet", lambda uuid: None if uuid == uuids[3] else object())
    monkeypatch.setattr(NodeMatch, "why_not", lambda _self, _station, uuid: "named x" if uuid == uuids[4] else "")
    assert service.measurements._selected("all") == ([uuids[0], uuids[5]], "")


def joining(service: Service, monkeypatch: pytest.MonkeyPatch) -> tuple[RunningMeasurement, list[Any]]:
    """Return a measurement with an arrived node that holds its lock, and the sightings that are asked about."""
    running, asked = open_to(service, monkeypatch), list[Any]()
    service.locks.acquire(NODE, "measurement 1", frozen=True)
    running.membership.members[NODE] = Member(joined=False, locked=True)
    running.reports[NODE] = {"uuid": NODE, "state": "lost", "why": ""}
    monkeypatch.setattr(service.measurements._workers, "submit", lambda _ask, sighting: asked.append(sighting))
    return running, asked


@pytest.mark.parametrize(
    ("unselected", "seen", "place", "past", "asked"),
    [
        ("renamed", True, True, {NODE}, []),
        ("renamed", False, True, {NODE}, ["place"]),
        ("", False, True, set(), ["place"]),
        ("", False, False, set(), []),
    ],
)
def test_a_node_that_went_or_is_not_meant_any_more_as_it_joins_is_given_back(
    service: Service,
    monkeypatch: pytest.MonkeyPatch,
    unselected: str,
    seen: bool,
    place: bool,
    past: set[str],
    asked: list[str],
) -> None:
    """One that is only away is asked at the place where its session failed, and joins if it answers."""
    running, questions = joining(service, monkeypatch)
    monkeypatch.setattr(service.measurements, "_why_not", lambda *_: unselected)
    if not seen:
        monkeypatch.setattr(service.buses.presence, "seen_at", lambda _uuid: None)
    if place:
        running.membership.places[NODE] = cast(Any, "place")
    service.measurements._join(running, cast(Any, None), NODE)
    assert (running.past, questions) == (past, asked)
    assert (running.membership.members, service.locks.holder(NODE)) == ({}, None)


def test_a_node_that_is_being_renamed_or_was_lent_as_it_joins_waits_or_goes_to_the_writer(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, _ = joining(service, monkeypatch)
    monkeypatch.setattr(measurement_supervisor, "time", SimpleNamespace(monotonic=lambda: 100.0, time=lambda: 0.0))

    def refuse(*_: Any, **__: Any) -> Any:
        raise PolicyError("The node is being renamed.")

    with monkeypatch.context() as patch:
        patch.setattr(service.station.measurements, "running", refuse)
        service.measurements._join(running, cast(Any, None), NODE)
    waits = running.membership.waits[NODE]
    assert (waits.at, waits.room, service.locks.holder(NODE)) == (101.0, None, None), "a second later it is tried again"
    assert running.reports[NODE] == {"uuid": NODE, "state": "waiting", "why": "The node is being renamed."}

    service.locks.acquire(NODE, "measurement 1", frozen=True)
    running.membership.members[NODE] = Member(joined=False, locked=True)
    service.measurements._loans[NODE] = [NodeLoan(NODE, "let go for write")]
    service.measurements._join(running, cast(Any, None), NODE)
    assert (running.membership.elsewhere, running.membership.members) == ({NODE}, {})
    assert service.locks.holder(NODE) is None
    service.measurements._loans.clear()


def test_a_waiting_node_that_has_gone_is_shown_no_more(service: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    running = open_to(service, monkeypatch)
    considered: list[str] = []
    monkeypatch.setattr(service.measurements, "_consider", lambda _running, uuid: considered.append(uuid))
    for node in (NODE, OTHER):
        running.membership.waits[node] = cast(Any, SimpleNamespace(at=0.0, room=None))
    service.directory.note(OTHER, present=True)
    service.measurements._try_again(running, 1.0)
    assert (considered, running.past) == ([OTHER], {NODE})


@pytest.mark.parametrize(
    ("error", "phase", "state"),
    [
        (StoreError("The disk is away."), Phase.MEASURING, "waiting"),
        (StoreError("The disk is away."), Phase.LOCKING, "failed"),
        (UsageError("It cannot be."), Phase.MEASURING, "failed"),
    ],
)
def test_only_a_store_that_fails_while_values_come_is_waited_for(
    service: Service, monkeypatch: pytest.MonkeyPatch, error: Exception, phase: Phase, state: str
) -> None:
    """Any other error ends that measurement; its reason remains visible."""
    running, looked = listed(service, NODE), threading.Event()
    running.phase, running.state = phase, "waiting"
    running.over.clear()

    def look(_running: RunningMeasurement, _now: float) -> None:
        looked.set()
        raise error

    monkeypatch.setattr(service.measurements, "_look_at", look)
    thread = threading.Thread(target=service.measurements._decide, daemon=True)
    thread.start()
    service.measurements._wake.set()
    assert looked.wait(10)
    until(lambda: running.not_before > 0 if state == "waiting" else running.phase is Phase.ENDING)
    assert (running.failed, service.state("1")[1]) == (("", "") if state == "waiting" else (str(error),) * 2)
    assert (running.not_before > 0, service.state("1")[0]) == (state == "waiting", state)
    running.phase = Phase.OVER
    running.over.set()


def test_a_measurement_that_fails_at_its_end_stays_to_be_seen(service: Service) -> None:
    running = listed(service, NODE)
    running.phase = Phase.ENDING
    running.over.clear()
    service.measurements._fail(running, UsageError("It cannot be."))
    assert (running.phase, running.over.is_set(), service.state("1")) == (Phase.OVER, True, ("failed", "It cannot be."))


@pytest.mark.parametrize(
    ("job", "failed", "stopped", "match", "state", "shown", "logged"),
    [
        (True, "", False, None, "ended", False, ["ended"]),
        (True, "", True, None, "ended", True, []),
        (True, "", False, "all", "ended", True, []),
        (True, "It failed.", False, None, "failed", True, []),
        (False, "", False, None, "failed", True, []),
    ],
)
def test_what_ends_by_itself_is_logged_and_gone_and_all_else_stays_until_it_is_deleted(
    service: Service,
    job: bool,
    failed: str,
    stopped: bool,
    match: str | None,
    state: str,
    shown: bool,
    logged: list[str],
) -> None:
    running, events = listed(service, NODE), list[str]()
    service.live.on_event = lambda event: events.append(event["state"]) if event["event"] == "measurement" else None
    running.asked = replace(running.asked, match=match)
    running.job = cast(Any, SimpleNamespace(sinks=(), measurement=None)) if job else None
    running.failed, running.state = failed, "failed"
    if stopped:
        running.stop.set()
    running.over.clear()
    service.measurements._finish(running)
    assert (running.state, "1" in service.measurements._running, running.over.is_set()) == (state, shown, True)
    assert [entry.outcome for entry in entries(service, "measure")] == logged
    assert events == [*([] if state == "failed" else ["ended"]), *([] if shown else ["deleted"])]


def test_what_commands_measure_is_shown_with_their_process_and_a_group_that_is_gone_is_not(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_commands = [
        KeptMeasurement("8", group="nobody", owner="command", pid=3, started=1.0),
        KeptMeasurement("9", uuids=(bytes.fromhex(NODE),), owner="command", pid=4711, started=2.0),
    ]
    monkeypatch.setattr(service.station.measurements, "of_commands", lambda: of_commands)
    listed(service, OTHER)
    assert [(shown["id"], shown["state"], shown["why"], shown["uuids"]) for shown in service.measurements.all()] == [
        ("1", "starting", "", [OTHER]),
        ("9", "running", "measured by the command measure (process 4711)", [NODE]),
    ]


def test_a_measurement_that_is_being_deleted_is_none_for_a_second_delete(service: Service) -> None:
    running = listed(service, NODE)
    running.deleted = True
    with pytest.raises(NotFoundError, match="No measurement has the ID '1'"):
        service.measurements.delete("1")
    assert not running.stop.is_set()
    assert (service.measurements.all(), service.measurements.measurement_of(NODE)) == ([], None)


@pytest.mark.parametrize(
    ("channels", "set_points", "kind", "asked"),
    [
        (None, True, None, []),
        ([True, True], True, None, []),
        ([True, True], False, None, [10.0, 10.0]),
        ([True, False], True, None, [10.0, 10.0]),
        ([], True, None, []),
        ([False], True, "event", [10.0]),
    ],
)
def test_a_plan_is_required_of_every_channel_unless_a_node_has_actuators_alone(
    service: Service,
    monkeypatch: pytest.MonkeyPatch,
    channels: list[bool] | None,
    set_points: bool,
    kind: str | None,
    asked: list[float],
) -> None:
    given: list[Any] = []
    found = [] if channels is None else [SimpleNamespace(actuator=actuator) for actuator in channels]
    module = measurement_supervisor
    monkeypatch.setattr(module, "require_measurable", lambda _station, uuid: given.append(uuid.hex()))
    monkeypatch.setattr(service.station.datasheets, "datasheet", lambda _uuid: None if channels is None else object())
    monkeypatch.setattr(module.Sheet, "from_image", lambda _image: SimpleNamespace(channels=found))
    monkeypatch.setattr(service.measurements._sinks, "allows_set_points", lambda _kept: set_points)
    kinds: list[Any] = []
    monkeypatch.setattr(module, "sensors_of", lambda of, _chosen, kind: (kinds.append(kind), of)[1])
    monkeypatch.setattr(module, "period_of", lambda _channel, rate: given.append(rate))
    kept = KeptMeasurement("", uuids=(bytes.fromhex(NODE),), rate=10.0, kind=kind)
    service.measurements._require_plan(bytes.fromhex(NODE), kept)
    assert given == [NODE, *asked]
    assert kinds == ([None if kind is None else module.StreamKind[kind.upper()]] if asked or channels == [] else [])


def test_a_frozen_selection_waits_with_its_reason_and_takes_the_nodes_that_no_other_has(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = listed(service, NODE)
    running.asked = running.kept = replace(running.kept, uuids=(), match="name:x*", frozen=True, actuators=True)
    running.phase, running.reports = Phase.SELECTING, {NODE: {"uuid": NODE, "state": "lost"}}
    started: list[tuple[bytes, ...]] = []
    monkeypatch.setattr(service.measurements, "_lock_members", lambda one, _now: started.append(one.kept.uuids))

    def select(found: list[bytes], why: str) -> None:
        done: Future[tuple[list[bytes], str]] = Future()
        running.selection = done
        service.measurements._select(running, 5.0)
        assert (running.selection, started) == (done, []), "it is not ready"
        done.set_result((found, why))
        service.measurements._select(running, 7.0)
        assert running.selection is None

    for why, shown in (("", "no known node matches"), ("no type is named x", "no type is named x")):
        select([], why)
        assert (running.state, running.why, running.looked) == ("waiting", shown, 7.0)
        assert (running.membership.members, running.reports) == ({}, {})
    other = RunningMeasurement(
        KeptMeasurement("2"), Membership(0.0, {OTHER: Member()}), KeptMeasurement("2"), phase=Phase.OVER
    )
    other.over.set()
    service.measurements._running["2"] = other
    select([bytes.fromhex(OTHER), bytes.fromhex(NODE)], "")
    assert started == [(bytes.fromhex(NODE),)]
    assert (running.kept.match, running.kept.actuators, running.uuids) == (None, False, (NODE,))
    assert running.asked.match == "name:x*", "as it was asked, for when it begins again"


@pytest.mark.parametrize(
    ("error", "waited", "shown"),
    [
        (NodeBusyError("It is inspected."), 1.0, False),
        (NodeBusyError("It is inspected."), 1e6, True),
        (FrozenError("It is frozen."), 0.0, True),
    ],
)
def test_a_node_that_something_else_works_on_is_waited_for_and_shown_after_a_while(
    service: Service, monkeypatch: pytest.MonkeyPatch, error: PolicyError, waited: float, shown: bool
) -> None:
    running, course = listed(service, NODE, OTHER), list[str]()
    monkeypatch.setattr(service.measurements, "_start", lambda *_: course.append("start"))

    def acquire(uuid: str, what: str, *, wait: float, frozen: bool) -> None:
        assert (what, wait, frozen) == ("measurement 1", 0.0, True)
        if uuid == OTHER and error is not None:
            raise error
        course.append(uuid)

    monkeypatch.setattr(service.locks, "acquire", acquire)
    running.membership.members[NODE].locked = running.membership.members[OTHER].locked = False
    running.looked = 100.0 - waited
    service.measurements._lock_members(running, 100.0)
    assert (course, running.looked) == ([NODE], 100.0), "the wait counts from the last lock"
    assert service.directory.seen(NODE).measurement == "1"
    running.looked = 100.0 - waited
    service.measurements._lock_members(running, 100.0)
    assert (running.state, running.why) == (("waiting", error.message) if shown else ("starting", ""))
    monkeypatch.setattr(service.locks, "acquire", lambda *_, **__: None)
    service.measurements._lock_members(running, 100.0)
    assert course == [NODE, "start"]


@pytest.mark.parametrize(
    ("frozen", "retired", "kept", "ends", "stopped", "other"),
    [
        (True, False, None, None, False, False),
        (True, True, None, None, False, True),
        (False, True, "same", None, False, False),
        (False, False, "same", None, False, False),
        (False, False, "more", None, False, True),
        (False, False, "gone group", None, False, True),
        (False, False, None, None, False, True),
        (False, False, None, 5.0, False, False),
        (False, False, None, None, True, False),
    ],
)
def test_a_measurement_begins_again_if_the_store_lists_other_nodes(
    service: Service,
    monkeypatch: pytest.MonkeyPatch,
    frozen: bool,
    retired: bool,
    kept: str | None,
    ends: float | None,
    stopped: bool,
    other: bool,
) -> None:
    running = listed(service, NODE)
    running.kept = replace(running.kept, frozen=frozen)
    if stopped:
        running.stop.set()
    node, more = bytes.fromhex(NODE), bytes.fromhex(OTHER)
    now = {
        "same": KeptMeasurement("1", uuids=(node,)),
        "more": KeptMeasurement("1", uuids=(node, more)),
        "gone group": KeptMeasurement("1", group="nobody"),
        None: KeptMeasurement("2"),
    }[kept]
    monkeypatch.setattr(service.station.measurements, "all", lambda: [now])
    monkeypatch.setattr(service.measurements, "_is_retired", lambda _uuid: retired)
    job: Any = SimpleNamespace(kept=SimpleNamespace(ends=ends))
    assert service.measurements._has_other_members(running, job) is other


ALIVE, DEAD = SimpleNamespace(alive=True), SimpleNamespace(alive=False)


@pytest.mark.parametrize(
    ("phase", "job", "more", "course"),
    [
        (Phase.ENDING, ALIVE, {}, []),
        (Phase.ENDING, ALIVE, {"until": 100.0}, ["_finish"]),
        (Phase.ENDING, DEAD, {}, ["_finish"]),
        (Phase.ENDING, None, {"stops": True}, ["_finish"]),
        (Phase.SELECTING, None, {}, ["_select 100.0"]),
        (Phase.SELECTING, None, {"stops": True}, ["_end"]),
        (Phase.LOCKING, None, {}, ["_lock_members 100.0"]),
        (Phase.LOCKING, None, {"stops": True}, ["_end"]),
        (Phase.MEASURING, DEAD, {}, ["_end"]),
        (Phase.MEASURING, None, {}, ["_end"]),
        (Phase.MEASURING, ALIVE, {"stops": True}, ["_end"]),
        (Phase.MEASURING, ALIVE, {"not_before": 100.5, "takes_in": True}, []),
        (Phase.MEASURING, ALIVE, {"takes_in": True}, ["_take_in ALIVE 100.0"]),
        (Phase.MEASURING, ALIVE, {"looked": 99.6}, []),
        (Phase.MEASURING, ALIVE, {"looked": 99.5}, ["waiting silent"]),
        (Phase.MEASURING, ALIVE, {"looked": 99.5, "others": True}, ["waiting silent", "_end"]),
    ],
)
def test_what_is_due_for_a_measurement_in_each_phase(
    phase: Phase, job: Any, more: dict[str, Any], course: list[str]
) -> None:
    """Its end takes at most the time that it was given; one whose members changed begins again with the new ones."""
    done = list[str]()
    stop = threading.Event()
    if more.get("stops"):
        stop.set()
    running: Any = SimpleNamespace(
        phase=phase, job=job, stop=stop, again=False, takes_in=more.get("takes_in", False),
        until=more.get("until", 100.1), not_before=more.get("not_before", 0.0), looked=more.get("looked", 0.0),
        present_state=lambda of, taken: ("waiting", "silent" if (of, taken) == (job, 0) else "wrong"),
    )  # fmt: skip

    def noted(name: str) -> Any:
        def note(about: Any, *words: Any) -> None:
            assert about is running
            done.append(" ".join([name, *("ALIVE" if word is ALIVE else str(word) for word in words)]).strip())

        return note

    names = ("_finish", "_end", "_select", "_lock_members", "_take_in")
    rig: Any = SimpleNamespace(
        _lock=threading.Lock(), _has_other_members=lambda _running, _job: more.get("others", False),
        _publish_state=noted(""), **{name: noted(name) for name in names},
    )  # fmt: skip
    MeasurementSupervisor._look_at(rig, running, 100.0)
    assert done == course
    assert running.again is more.get("others", False)
    assert running.looked == (100.0 if "waiting silent" in course else more.get("looked", 0.0))


def test_a_node_of_another_measurement_is_refused_with_the_remedy(service: Service) -> None:
    listed(service, NODE).phase = Phase.MEASURING
    service.measurements._require_unmeasured(bytes.fromhex(OTHER))
    with pytest.raises(NodeBusyError) as busy:
        service.measurements._require_unmeasured(bytes.fromhex(NODE))
    assert busy.value.message == f"Node {NODE} is already being measured (1)."
    assert busy.value.hint == "End the measurement first."
    service.measurements._running["1"].phase = Phase.OVER


def test_a_node_that_another_part_works_with_is_considered_again_a_tenth_of_a_second_later(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running = open_to(service, monkeypatch)
    running.phase = Phase.MEASURING
    running.membership.elsewhere.add(NODE)
    service.locks.acquire(NODE, "it is looked at")
    monkeypatch.setattr(measurement_supervisor, "time", SimpleNamespace(monotonic=lambda: 100.0))
    service.measurements._consider(running, NODE)
    assert running.membership.busy == {NODE: pytest.approx(100.1)}
    assert running.membership.elsewhere == set()
    assert service.locks.holder(NODE) == "it is looked at"
    running.phase = Phase.OVER


def test_an_expression_of_the_start_is_measured_as_it_was_asked_for(service: Service) -> None:
    """Frozen or not is another measurement; one of a group that does not exist is refused and begins nothing."""
    service.measurements._dead_man = 250
    made = service.measurements.add({"match": "all", "rate": 20.0})["id"]
    for wrong, error in (("group:nobody", NotFoundError), ("colour:red", UsageError)):
        with pytest.raises(error):
            service.measurements.match(wrong)
    assert [shown["id"] for shown in service.measurements.all()] == [made]
    service.measurements.match("all", rate=20.0, frozen=True)
    [begun] = [shown for shown in service.measurements.all() if shown["id"] == "run"]
    assert {name: begun[name] for name in ("match", "rate", "frozen", "dead_man", "owner")} == {
        "match": "all", "rate": 20.0, "frozen": True, "dead_man": 250, "owner": "ncap",
    }  # fmt: skip
    logged = [entry.outcome for entry in entries(service, "measure") if (entry.detail or {}).get("id") == "run"]
    assert logged == ["begun"]


def test_what_follows_for_a_node_that_ended_or_is_lost_is_done(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    running, course = open_to(service, monkeypatch), list[tuple[Any, ...]]()
    workers = SimpleNamespace(
        submit=lambda work, sighting: course.append((work.__name__, sighting)), shutdown=lambda **_how: None
    )
    monkeypatch.setattr(service.measurements, "_workers", workers)
    monkeypatch.setattr(service.measurements, "_consider", lambda _running, uuid: course.append(("consider", uuid)))
    done = threading.Event()
    done.set()
    last, error, decided = cast(Any, object()), LinkError("Silent."), list[tuple[Any, ...]]()
    decisions = [AfterEnd.ASK, AfterEnd.TRY, AfterEnd.NOTHING, AfterEnd.ASK]

    def end(uuid: str, now: float, error: Any, *, last: Any, seen: Any, room: float) -> AfterEnd:
        assert uuid not in running.membership.members, "it is released before"
        decided.append((uuid, now, error, last, seen is service.buses.presence.seen_at(b""), room))
        return decisions.pop(0)

    def release(of: Any, uuid: str) -> None:
        assert of is running
        del running.membership.members[uuid]

    with monkeypatch.context() as patch:
        patch.setattr(service.measurements, "_release", release)
        patch.setattr(running.membership, "end", end)
        for place in (last, last, last, None):
            supervisor: Any = SimpleNamespace(done=done, uuid=bytes.fromhex(NODE), error=error, sighting=place)
            running.membership.members[NODE] = Member(supervisor=supervisor)
            service.measurements._reap(running, cast(Any, SimpleNamespace(lent=set())), NODE, 7.0)
    assert course == [("_ask", last), ("consider", NODE)], "one without a last place cannot be asked"
    assert decided == [(NODE, 7.0, error, place, True, 0.5) for place in (last, last, last, None)]
    course.clear()
    running.membership.busy = {NODE: 5.0, OTHER: 5.5}
    running.membership.lost = {OTHER: cast(Any, SimpleNamespace(sighting=last, since=0.0, at=5.0, pause=1.0))}
    for node in (NODE, OTHER):
        service.directory.note(node, present=True)
    service.measurements._try_again(running, 5.0)
    assert course == [("consider", NODE), ("_ask", last)]
