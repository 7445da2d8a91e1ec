"""The supervisor of measurements, in this process: one that fails, or a store that fails, stops no other."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import AsyncIterator, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from starlette.requests import Request
from starlette.responses import StreamingResponse

from teds_provision import client
from teds_provision.errors import NodeBusyError, NoNodeError, PolicyError, StoreError
from teds_provision.links.discovery import Sighting
from teds_provision.measure.blocks import NodeReport
from teds_provision.measure.buses import Buses
from teds_provision.ncap.live import Live
from teds_provision.ncap.measurement_supervisor import MeasurementSupervisor, NodeLoan
from teds_provision.ncap.membership import Member, Membership
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


def listed(service: Service, *uuids: str) -> RunningMeasurement:
    """Return a measurement of these nodes that is in the table and does nothing: its phase says that it is over."""
    kept = KeptMeasurement("1", uuids=tuple(map(bytes.fromhex, uuids)))
    running = RunningMeasurement(kept, service.measurements._listed(kept), kept, phase=Phase.OVER)
    running.over.set()
    service.measurements._running["1"] = running
    return running


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
