"""The supervisor of one node: a bug of ours in it, its place among those that begin, and Announces without end."""

from __future__ import annotations

import threading
import time
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    BadDataError,
    BadDatasheetError,
    GarbledError,
    KeyStolenError,
    LinkError,
    NodeRefusedError,
    NoRoomError,
    NotAuthenticError,
    PolicyError,
    StoreError,
)
from teds_provision.measure import node_supervisor
from teds_provision.measure.blocks import NodeReport, SetPointCommand
from teds_provision.measure.clock import HostClock
from teds_provision.measure.node_supervisor import CALM, LOOK, NodeSupervisor
from teds_provision.measure.planning import BusShare
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.measure.running import measurement_job
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.protocol.messages.frames import Reason
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.station.measurements import STATION
from teds_provision.station.store.records import KeptMeasurement

UUID = bytes(range(10))


def test_a_foreign_exception_ends_the_node_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[NodeReport] = []
    events = Events(lambda _block: None, lambda _facts: None, reports.append)
    buses: Any = SimpleNamespace(all=list)
    host = HostClock()
    supervisor = NodeSupervisor(None, buses, UUID, MeasurementRequest(), host, events, CommonStart([UUID]))  # type: ignore[arg-type]

    def broken() -> None:
        raise ValueError("cannot convert float NaN to integer")

    monkeypatch.setattr(supervisor, "_try_once", broken)
    supervisor.start()
    supervisor.join(60)
    assert supervisor.done.is_set()
    assert supervisor.error is not None
    assert (supervisor.error.code, supervisor.error.exit_code) == ("bug", 1)
    assert reports[-1].state == "refused"
    assert "ValueError" in reports[-1].why


def test_a_node_is_among_those_that_begin_until_it_runs_or_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is read in the background waits for these; one that stayed among them would hold it up for a minute."""
    bus, seen = SimpleNamespace(beginning=set()), list[set[bytes]]()

    def fails(*_: object) -> None:
        seen.append(set(bus.beginning))
        raise GarbledError("It sent nonsense.")

    monkeypatch.setattr(NodeSupervisor, "_open_and_measure", fails)
    events = Events(lambda _block: None, lambda _facts: None, lambda _report: None)
    none: Any = None
    supervisor = NodeSupervisor(none, none, UUID, MeasurementRequest(), HostClock(), events, CommonStart([UUID]))
    with pytest.raises(GarbledError):
        supervisor._in_session(cast(Any, bus), none, none)
    assert seen == [{UUID}]
    assert bus.beginning == set()


def test_announces_without_end_make_it_look_no_more_often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any device can announce itself as this node, again at once after each look at the node's data."""
    events = Events(lambda _block: None, lambda _facts: None, lambda _report: None)
    none: Any = None
    supervisor = NodeSupervisor(none, none, UUID, MeasurementRequest(), HostClock(), events, CommonStart([UUID]))
    sends_fast = SimpleNamespace(
        every=lambda: 0.01, heard_since=lambda _moment: True, silent=lambda _now: 0.0, clock=SimpleNamespace(lie="")
    )
    monkeypatch.setattr(supervisor, "streams", sends_fast)
    looks: list[float] = []

    def require() -> None:
        looks.append(time.monotonic())
        supervisor._doubted(looks[-1])
        supervisor._heard_announce()
        if len(looks) == 5:
            supervisor.stop()

    supervisor._watch(none, none, cast(Any, SimpleNamespace(require=require, mark="")), None)
    assert looks[-1] - looks[0] >= 0.9 * 4 * LOOK


def supervisor_at(now: list[float], monkeypatch: pytest.MonkeyPatch, **request: Any) -> NodeSupervisor:
    """Return a supervisor whose clock stands at ``now``, and which waits for nothing."""
    monkeypatch.setattr(node_supervisor, "time", SimpleNamespace(monotonic=lambda: now[0]))
    events, none = Events(lambda _block: None, lambda _facts: None, lambda _report: None), cast(Any, None)
    made = NodeSupervisor(none, none, UUID, MeasurementRequest(**request), HostClock(), events, CommonStart([UUID]))
    monkeypatch.setattr(made, "_anew", SimpleNamespace(wait=lambda _seconds: False, set=lambda: None))
    return made


def test_a_node_is_asked_a_second_after_its_first_announce_however_many_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    supervisor = supervisor_at(now, monkeypatch)
    monkeypatch.setattr(supervisor, "streams", SimpleNamespace(every=lambda: 10.0))
    for _ in range(4):
        supervisor._heard_announce()
        assert not supervisor._doubted(now[0])
        now[0] += 0.25
    assert supervisor._doubted(now[0])
    assert not supervisor._doubted(now[0] + 10.0), "once"


def test_a_node_is_told_the_time_every_third_of_its_lease(monkeypatch: pytest.MonkeyPatch) -> None:
    now, told = [0.0], list[float]()
    supervisor = supervisor_at(now, monkeypatch, lease=3)
    streams = SimpleNamespace(
        tell_time=lambda _trusted: told.append(now[0]), silent=lambda _now: 0.0, clock=SimpleNamespace(lie="")
    )
    monkeypatch.setattr(supervisor, "streams", streams)

    def require() -> None:
        now[0] += 0.25
        if now[0] >= 4.0:
            supervisor.stop()

    none: Any = None
    supervisor._watch(none, none, cast(Any, SimpleNamespace(require=require, mark="")), None)
    assert told == [1.0, 2.0, 3.0, 4.0]


def test_a_node_is_tried_again_after_1_s_doubling_to_30_and_after_a_long_run_from_1_on(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now, pauses = [0.0], list[float]()
    supervisor = supervisor_at(now, monkeypatch, patient=True)
    monkeypatch.setattr(supervisor, "_set_state", lambda *_what, **_why: None)
    monkeypatch.setattr(supervisor, "_buses", SimpleNamespace(all=list))
    monkeypatch.setattr(supervisor, "_anew", SimpleNamespace(clear=lambda: None))
    lasts = [0.0, 1.0, 2.0, 0.0, 0.0, 0.0, 30.0, 30.1, 0.0]

    def failure() -> LinkError:
        now[0] += lasts[len(pauses)]
        return LinkError("It is gone.")

    def wait(pause: float, began: float, *, decided: bool) -> None:
        assert (began, decided) == (now[0] - lasts[len(pauses)], False)
        pauses.append(pause)
        if len(pauses) == len(lasts):
            supervisor._stop.set()

    monkeypatch.setattr(supervisor, "_failure", failure)
    monkeypatch.setattr(supervisor, "_wait", wait)
    supervisor._run()
    assert pauses == [1, 2, 4, 8, 16, 30, 30, 1, 2]


def test_a_node_that_was_given_back_is_lent_no_more() -> None:
    """It would never be let go when it is lost later, and not join again."""
    station: Any = None
    job = MeasurementJob(station, KeptMeasurement("run", uuids=(UUID,)))
    assert job.suspend_node(UUID, "let go for write", 0.0)
    assert job.lent == {UUID}
    job.resume_node(UUID)
    assert job.lent == set()


def test_on_a_bus_that_has_grown_a_node_gets_a_longer_lease_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each Operate costs the bus what the longer lease saves; and a lease never shrinks in a session."""
    now, claimed = [0.0], list[tuple[int, int]]()
    supervisor = supervisor_at(now, monkeypatch, lease=10)
    nodes = {0.25: 10, 20.25: 90, 60.25: 400, 120.25: 5}
    share = SimpleNamespace(nodes=10)
    supervisor.bus = cast(Any, SimpleNamespace(share=share))
    supervisor._claimed = [1, 2]
    monkeypatch.setattr(node_supervisor, "claim", lambda _trusted, number, *, lease: claimed.append((number, lease)))
    streams = SimpleNamespace(tell_time=lambda _trusted: None, silent=lambda _now: 0.0, clock=SimpleNamespace(lie=""))
    monkeypatch.setattr(supervisor, "streams", streams)

    def require() -> None:
        now[0] += 0.25
        share.nodes = nodes.get(now[0], share.nodes)
        if now[0] >= 200.0:
            supervisor.stop()

    none: Any = None
    supervisor._watch(none, none, cast(Any, SimpleNamespace(require=require, mark="")), None)
    assert claimed == [(1, 18), (2, 18), (1, 60), (2, 60)]


def test_a_node_that_is_on_another_bus_now_leaves_its_room_on_the_others(monkeypatch: pytest.MonkeyPatch) -> None:
    here, other = (SimpleNamespace(share=BusShare(cast(Any, None))) for _ in range(2))
    for bus in (here, other):
        bus.share.taken[UUID] = 0.2
    supervisor = supervisor_at([100.0], monkeypatch)
    presence = SimpleNamespace(find=lambda _uuid, **_how: None)
    buses = SimpleNamespace(presence=presence, bus_of=lambda _sighting: here, all=lambda: [here, other])
    monkeypatch.setattr(supervisor, "_buses", buses)
    for step in ("_let_others_finish", "_wait_for_vault"):
        monkeypatch.setattr(supervisor, step, lambda: None)
    monkeypatch.setattr(supervisor, "_in_session", lambda *_words: None)
    standing = SimpleNamespace(require_measurable=lambda: None)
    monkeypatch.setattr(node_supervisor, "NodeStanding", lambda _station, _uuid: standing)
    supervisor._try_once()
    assert (here.share.taken, other.share.taken) == ({UUID: 0.2}, {})


def test_after_a_failed_session_only_a_sighting_since_then_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its place of before may be another node's by now."""
    now, asked, again = [100.0], list[float](), list[object]()
    supervisor = supervisor_at(now, monkeypatch)
    bus = SimpleNamespace(share=BusShare(cast(Any, None)))

    def find(_uuid: bytes, *, fresh: float, **_how: object) -> str:
        asked.append(fresh)
        return f"seen after {fresh}"

    presence = SimpleNamespace(
        find=find, let_announce=lambda _uuid: None, search_again=again.append, conflict_at=lambda _sighting: None
    )
    buses = SimpleNamespace(presence=presence, bus_of=lambda _sighting: bus, all=lambda: [bus])
    monkeypatch.setattr(supervisor, "_buses", buses)
    for step in ("_let_others_finish", "_wait_for_vault"):
        monkeypatch.setattr(supervisor, step, lambda: None)
    standing = SimpleNamespace(require_measurable=lambda: None)
    monkeypatch.setattr(node_supervisor, "NodeStanding", lambda _station, _uuid: standing)

    def fails(*_words: object) -> None:
        now[0] += 5
        raise LinkError("It is silent.")

    monkeypatch.setattr(supervisor, "_in_session", fails)
    for _ in range(3):
        with pytest.raises(LinkError):
            supervisor._try_once()
    assert asked == [0.0, 105.0, 110.0]
    assert again == ["seen after 0.0", "seen after 105.0", "seen after 110.0"]


def test_a_node_that_begins_again_has_neither_its_error_nor_its_end_any_more(monkeypatch: pytest.MonkeyPatch) -> None:
    reports, tries = list[NodeReport](), list[bool]()
    events = Events(lambda _block: None, lambda _facts: None, reports.append)
    buses: Any = SimpleNamespace(all=list)
    none: Any = None
    made = NodeSupervisor(none, buses, UUID, MeasurementRequest(), HostClock(), events, CommonStart([UUID]))

    def try_once() -> None:
        tries.append(made.done.is_set())
        if len(tries) == 1:
            raise PolicyError("It is revoked.")

    monkeypatch.setattr(made, "_try_once", try_once)
    made.stop("renamed", comes_back=True)
    for _ in range(2):
        made.start()
        made.join(60)
    made.start()
    made.join(60)
    assert tries == [False, False]
    assert (made.error, made.done.is_set()) == (None, True)
    assert [(report.state, report.why) for report in reports] == [
        ("ended", "renamed"), ("refused", "It is revoked"), ("ended", ""),
    ]  # fmt: skip


def test_the_end_of_a_measurement_is_stored_with_its_first_value_and_not_moved_by_a_restart() -> None:
    station: Any = None
    job = MeasurementJob(station, KeptMeasurement("", uuids=(UUID,)))
    job._began(None)
    assert job.kept.ends is None
    job._began(600.0)
    ends = job.kept.ends
    assert ends is not None
    assert ends == pytest.approx(time.time() + 600.0, abs=60.0)
    job._began(5.0)
    assert job.kept.ends == ends


@pytest.mark.parametrize("failure", [None, LinkError("The adapter was pulled.")])
def test_a_node_that_is_silent_is_lost_by_the_fault_of_its_link_if_that_has_one(
    failure: LinkError | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    supervisor = supervisor_at([0.0], monkeypatch)
    streams = SimpleNamespace(tell_time=lambda _trusted: None, silent=lambda _now: 5.0, clock=SimpleNamespace(lie=""))
    monkeypatch.setattr(supervisor, "streams", streams)
    standing, bus = (
        SimpleNamespace(require=lambda: None, mark=""),
        SimpleNamespace(hearing=SimpleNamespace(failure=failure)),
    )
    none: Any = None
    with pytest.raises(LinkError, match="pulled" if failure else r"No message from the node for 5\.0 s"):
        supervisor._watch(cast(Any, bus), none, cast(Any, standing), None)


@pytest.mark.parametrize(
    ("reason", "beside", "change", "shared"),
    [
        (Reason.DOES_NOT_FIT, True, {}, True),
        (Reason.NO_ROOM, True, {}, False),
        (Reason.DOES_NOT_FIT, False, {}, False),
        (Reason.DOES_NOT_FIT, True, {"ran": True}, False),
        (Reason.DOES_NOT_FIT, True, {"patient": True}, False),
    ],
)
def test_a_node_that_another_process_measures_too_is_given_up_only_before_its_first_value(
    reason: Reason, beside: bool, change: dict[str, bool], shared: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    holder = {UUID: "measure arm (process 12)"} if beside else {}
    supervisor = supervisor_at([0.0], monkeypatch, beside=holder, patient=change.get("patient", False))
    supervisor.ever_ran = change.get("ran", False)
    error = supervisor._is_shared(NodeRefusedError("No.", reason=reason))
    assert (error is not None) is shared
    assert error is None or "measure arm (process 12)" in error.message
    assert supervisor._is_shared(LinkError("It is silent.")) is None


@pytest.mark.parametrize(
    ("change", "numbers"),
    [
        ({}, [2]),
        ({"channels": (2, 1)}, [2]),
        ({"channels": (1,)}, []),
        ({"actuators": False}, []),
        ({"unsigned": True}, []),
        ({"unverified": True}, []),
        ({"listed": False}, []),
    ],
)
def test_set_points_are_taken_for_actuators_of_a_signed_node_on_the_whitelist_alone(
    change: dict[str, Any], numbers: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = {name: value for name, value in change.items() if name in ("channels", "actuators")}
    supervisor = supervisor_at([0.0], monkeypatch, **{"actuators": True} | wanted)
    entry = object() if change.get("listed", True) else None
    monkeypatch.setattr(supervisor, "_station", SimpleNamespace(pins=SimpleNamespace(entry=lambda _uuid: entry)))
    channels = [
        SimpleNamespace(number=number, actuator=actuator, value_problem=problem)
        for number, actuator, problem in ((1, False, ""), (2, True, ""), (3, True, "it has no calibration."))
    ]
    trusted: Any = SimpleNamespace(
        unsigned=change.get("unsigned", False),
        unverified=change.get("unverified", False),
        sheet=SimpleNamespace(channels=channels),
    )
    assert [channel.number for channel in supervisor._actuators(trusted)] == numbers


def test_an_announce_is_settled_by_a_value_and_a_sighting_elsewhere_is_one_too(monkeypatch: pytest.MonkeyPatch) -> None:
    now, last = [100.0], [0.0]
    supervisor = supervisor_at(now, monkeypatch)
    streams = SimpleNamespace(every=lambda: 0.1, heard_since=lambda since: last[0] > since, silent=lambda _now: 0.0)
    monkeypatch.setattr(supervisor, "streams", streams)
    supervisor._heard_announce()
    now[0] += 0.1
    last[0] = now[0]
    assert not supervisor._doubted(now[0])
    now[0] += 5.0
    assert not supervisor._doubted(now[0]), "the value that came settled it"
    supervisor._seen_elsewhere()
    assert not supervisor._is_gone()
    now[0] += 0.5
    assert supervisor._is_gone(), "its answers come from there now: this one is not waited for"
    with pytest.raises(LinkError, match="restarted, or now answers elsewhere"):
        supervisor._doubted(now[0])


@pytest.mark.parametrize(
    ("rate", "refusals", "plans", "raised"),
    [
        (None, [], [(700, 1)], None),
        (None, [Reason.OUT_OF_RANGE] * 3, [(700, 1), (700, 2), (700, 4), (700, 8)], None),
        (None, [Reason.OUT_OF_RANGE] * 11, [(700, 2**halved) for halved in range(11)], Reason.OUT_OF_RANGE),
        (50.0, [Reason.OUT_OF_RANGE], [(700, 1)], Reason.OUT_OF_RANGE),
        (50.0, [Reason.TOO_LATE], [(700, 1), (0, 1)], None),
        (None, [Reason.TOO_LATE, Reason.OUT_OF_RANGE], [(700, 1), (0, 1), (0, 2)], None),
        (None, [Reason.TOO_LATE] * 2, [(700, 1), (0, 1)], Reason.TOO_LATE),
        (None, [Reason.DOES_NOT_FIT], [(700, 1)], Reason.DOES_NOT_FIT),
    ],
)
def test_a_refused_subscribe_is_tried_slower_or_at_once_and_as_at_first_in_the_next_session(
    rate: float | None,
    refusals: list[Reason],
    plans: list[tuple[int, int]],
    raised: Reason | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A node whose new firmware allows shorter periods would stay as slow as its old one was."""
    supervisor = supervisor_at([0.0], monkeypatch, rate=rate)
    tried, stops, left = list[tuple[int, int]](), list[int](), list[Reason]()

    def plan(_channels: object, _bus: object, *, start: int, slower: int, **_more: object) -> Any:
        tried.append((start, slower))
        return SimpleNamespace(load=0.1, streams=[SimpleNamespace()])

    def subscribe(*_how: object, **_more: object) -> None:
        if left:
            raise NodeRefusedError("No.", reason=left.pop(0))

    streams = SimpleNamespace(subscribe=subscribe, stop=lambda _bus, _trusted, at: stops.append(at), clock=None)
    together = SimpleNamespace(
        start=lambda _uuid, _clock: 700, seconds_until=lambda _start: 0.0, start_by_itself=lambda _uuid: None
    )
    monkeypatch.setattr(supervisor, "streams", streams)
    monkeypatch.setattr(supervisor, "_common_start", together)
    monkeypatch.setattr(node_supervisor, "plan_node", plan)
    share = BusShare(cast(Any, None))
    bus = cast(Any, SimpleNamespace(share=share, time_for=lambda _time, _address: None))
    monkeypatch.setattr(share, "for_node", lambda _uuid, *, sharing: None)
    for _session in range(2):
        tried.clear()
        stops.clear()
        left[:] = refusals
        with pytest.raises(NodeRefusedError) if raised is not None else nullcontext() as refused:
            supervisor._subscribe(bus, cast(Any, None), [], 9)
        assert tried[rate is None :] == plans, "the first one is the share that is announced"
        assert stops == [9] * (len(plans) - 1), "what began of a refused plan is stopped"
        assert raised is None or cast(Any, refused).value.reason == raised
        assert share.taken == {UUID: 0.1}


def test_a_measurement_goes_on_after_any_failure_of_a_run_and_of_its_sinks(monkeypatch: pytest.MonkeyPatch) -> None:
    """A full disk, on which the folder of the recordings could not be made, ended it without a word; so did a bug."""
    now, pauses, made, ran = [0.0], list[float](), list[int](), list[str]()
    errors: list[Exception | None] = [LinkError("It is away."), ZeroDivisionError(), None, None, LinkError("Again.")]

    def more(_take: object) -> list[Any]:
        made.append(len(made))
        if len(made) == 3:
            raise StoreError("The disk is full.")
        return [SimpleNamespace(number=made[-1])]

    station: Any = None
    job = MeasurementJob(station, KeptMeasurement("run", uuids=(UUID,)), more=more)

    def run(*_words: object, **_how: object) -> Any:
        ran.append(f"sink {cast(Any, job.sinks[0]).number}")
        now[0] += 31.0 if len(ran) == 3 else 1.0
        if (error := errors[len(ran) - 1]) is not None:
            raise error
        return SimpleNamespace(error=None)

    seen = list[str | None]()

    def wait(seconds: float) -> None:
        pauses.append(seconds)
        seen.append(job.error and job.error.message)
        if len(pauses) == 6:
            job._stop.set()

    monkeypatch.setattr(measurement_job, "time", SimpleNamespace(monotonic=lambda: now[0], time=lambda: now[0]))
    monkeypatch.setattr(job, "run", run)
    monkeypatch.setattr(job._stop, "wait", wait)
    job._carry_on(cast(Any, None), None)
    assert seen == ["It is away.", "Unexpected ZeroDivisionError.", "The disk is full.", None, None, "Again."]
    assert pauses == [1.0, 2.0, 4.0, 1.0, 2.0, 4.0], "it begins anew with a run of half a minute"
    assert ran == ["sink 0", "sink 1", "sink 3", "sink 4", "sink 5"], "new ones for each run"


def test_nodes_and_group_are_held_while_it_measures() -> None:
    held: list[tuple[object, object, object]] = []

    def running(uuids: object, *, group: object = None, what: object = None) -> Any:
        held.append((uuids, group, what))
        raise PolicyError("Another measurement holds it.")

    measurements = SimpleNamespace(nodes_of=lambda _kept: (UUID,), holder=lambda _uuid: None, running=running)
    station: Any = SimpleNamespace(measurements=measurements)
    for kept in (KeptMeasurement("7", group="hand"), KeptMeasurement("8", uuids=(UUID,))):
        with pytest.raises(PolicyError, match="holds it"):
            MeasurementJob(station, kept).run(cast(Any, None), threading.Event())
    assert held == [((UUID,), "hand", "measure hand"), ((UUID,), None, f"measure {UUID.hex()[:8]}")]


def test_a_measurement_whose_time_is_over_is_kept_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    forgotten = list[str]()
    station: Any = SimpleNamespace(measurements=SimpleNamespace(forget=forgotten.append))
    monkeypatch.setattr(measurement_job, "time", SimpleNamespace(monotonic=lambda: 0.0, time=lambda: 100.0))
    for ends, stops in ((None, True), (100.5, True), (100.0, False)):
        job = MeasurementJob(station, KeptMeasurement("run", uuids=(UUID,), ends=ends))
        stopped = list[float]()
        monkeypatch.setattr(job, "run", lambda *_words, **_how: SimpleNamespace(error=None))
        monkeypatch.setattr(
            job._stop, "wait", lambda seconds, job=job, stopped=stopped: (stopped.append(seconds), job._stop.set())
        )
        job._carry_on(cast(Any, None), None)
        assert bool(stopped) is stops
    assert forgotten == ["run"]


@pytest.mark.parametrize(
    ("kept", "instance"),
    [
        (KeptMeasurement("7", group="hand", uuids=(UUID,)), "hand"),
        (KeptMeasurement("7", uuids=(UUID, bytes(10))), "n00010203"),
        (KeptMeasurement("7", match="all"), "7"),
        (KeptMeasurement("7", match="all", frozen=True), ""),
    ],
)
def test_measurements_side_by_side_have_names_of_their_own(kept: KeptMeasurement, instance: str) -> None:
    station: Any = SimpleNamespace(
        name="bench",
        measurements=SimpleNamespace(names={(UUID, 0): "arm", (STATION, 0): "lab"}),
        nodes=SimpleNamespace(all=lambda: [SimpleNamespace(uuid=UUID, name=None)]),
    )
    facts = MeasurementJob(station, kept)._facts()
    assert (facts.name, facts.instance, facts.names) == ("lab", instance, {(UUID.hex(), 0): "arm"})
    assert (facts.nodes, facts.group, facts.scalar_rate) == ({UUID.hex(): ""}, kept.group or "", 10.0)
    assert facts.each_node is (kept.match is not None and not kept.frozen)


@pytest.mark.parametrize(
    ("kept", "admits", "passed"),
    [(True, True, [0.5]), (True, False, []), (False, True, None), (True, None, None)],
)
def test_a_set_point_of_a_topic_passes_if_the_measurement_and_its_owner_let_it(
    kept: bool, admits: bool | None, passed: list[float] | None
) -> None:
    takers, came = list[Any](), list[float]()
    station: Any = None
    job = MeasurementJob(
        station,
        KeptMeasurement("run", uuids=(UUID,), sinks=("ros2",), actuators=kept),
        more=lambda take: takers.append(take) or [],
        admits=None if admits is None else lambda _command: admits,
        opened=lambda spec, take: takers.append((spec, take)) or cast(Any, None),
    )
    (spec, first), second = takers
    assert (spec, first) == ("ros2", second)
    assert (first is None) is (passed is None)
    assert job.request.actuators is (passed is not None)
    if first is not None:
        first(SetPointCommand(UUID.hex(), 1, 0.1, 0.0))  # before it runs
        job._commands = lambda command: came.append(command.value)
        first(SetPointCommand(UUID.hex(), 1, 0.5, 0.0))
    assert came == (passed or [])


def test_a_session_goes_from_the_clock_to_the_claim_to_the_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    """operation.md section 7: Clock, Operate, Subscribe; sinks know a channel before its first value."""
    supervisor, done = supervisor_at([0.0], monkeypatch), list[str]()

    def does(name: str) -> Any:
        return lambda *_words, **_more: done.append(name)

    monkeypatch.setattr(
        supervisor,
        "streams",
        SimpleNamespace(new_session=does("new"), tell_time=does("clock"), described=does("described"), running={}),
    )
    monkeypatch.setattr(supervisor, "_actuators", lambda _trusted: [])
    monkeypatch.setattr(supervisor, "_sensors", lambda _every, _actuators: [SimpleNamespace(number=1)])
    monkeypatch.setattr(supervisor, "_claim", does("operate"))
    monkeypatch.setattr(supervisor, "_set_state", does("running"))
    monkeypatch.setattr(supervisor, "_events", SimpleNamespace(facts=does("facts")))

    def subscribe(*_words: Any) -> Any:
        done.append("subscribe")
        return SimpleNamespace(periods=dict, slowed="")

    monkeypatch.setattr(supervisor, "_subscribe", subscribe)
    trusted: Any = SimpleNamespace(sheet=SimpleNamespace(channels=()), facts=lambda _channel, _period: None)
    none: Any = None
    supervisor.ready.clear()
    supervisor._measure(none, trusted, 0x21)
    assert done == ["new", *["clock"] * 5, "operate", "subscribe", "facts", "described", "running"]
    assert (supervisor.ever_ran, supervisor.ready.is_set()) == (True, True)


@pytest.mark.parametrize("answers", [True, False])
def test_a_session_ends_with_actuators_then_streams_then_idle_as_far_as_the_node_answers(
    answers: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    supervisor, done = supervisor_at([0.0], monkeypatch), list[Any]()
    node = SimpleNamespace(
        request=lambda command, _doing: done.append((command.channel, command.command_class, command.function)),
        forget=lambda: done.append("forget"),
    )
    trusted: Any = SimpleNamespace(node=node)
    share = SimpleNamespace(lock=threading.Lock(), taken={UUID: 0.3, b"other": 0.1})
    bus: Any = SimpleNamespace(share=share)
    supervisor._driven = cast(Any, SimpleNamespace(close=lambda: done.append("actuators")))
    supervisor.verified = trusted
    monkeypatch.setattr(
        supervisor, "_buses", SimpleNamespace(presence=SimpleNamespace(let_announce=lambda _uuid: done.append("let")))
    )
    monkeypatch.setattr(
        supervisor,
        "streams",
        SimpleNamespace(stop=lambda _bus, session, address: done.append(("stop", session is trusted, address))),
    )
    supervisor._end(bus, trusted, 0x21, answers=answers)
    last = (0, 4, 2) if answers else "forget"
    assert done == ["actuators", "let", ("stop", answers, 0x21), last]
    assert share.taken == {b"other": 0.1}, "its room on the bus is free"
    assert (supervisor._driven, supervisor.verified) == (None, None)
    supervisor._comes_back = True
    share.taken[UUID] = 0.3
    supervisor._end(bus, trusted, 0x21, answers=answers)
    assert share.taken == {UUID: 0.3, b"other": 0.1}, "it keeps its room while it is lent"


@pytest.mark.parametrize(
    ("ran", "timeout", "left", "seconds"),
    [
        (False, 60.0, 100.0, 60.0),
        (False, 60.0, 12.34, 12.3),
        (False, 60.0, 0.5, 2.0),
        (False, 1.0, 100.0, 2.0),
        (True, 60.0, 100.0, 2.0),
    ],
)
def test_a_node_is_searched_until_the_timeout_and_two_seconds_at_a_time_after_its_first_value(
    monkeypatch: pytest.MonkeyPatch, ran: bool, timeout: float, left: float, seconds: float
) -> None:
    supervisor = supervisor_at([100.0], monkeypatch, timeout=timeout)
    supervisor.ever_ran = ran
    asked: list[tuple[bytes, float, bool]] = []

    def find(uuid: bytes, *, seconds: float, stop: threading.Event, fresh: float) -> None:
        asked.append((uuid, seconds, stop is supervisor._stop and fresh == supervisor._lost_at))

    bus = SimpleNamespace(share=BusShare(cast(Any, None)))
    buses = SimpleNamespace(presence=SimpleNamespace(find=find), bus_of=lambda _sighting: bus, all=lambda: [bus])
    monkeypatch.setattr(supervisor, "_buses", buses)
    monkeypatch.setattr(supervisor, "_retry_policy", SimpleNamespace(seconds_left=left))
    for step in ("_let_others_finish", "_wait_for_vault"):
        monkeypatch.setattr(supervisor, step, lambda: None)
    monkeypatch.setattr(supervisor, "_in_session", lambda *_words: None)
    standing = SimpleNamespace(require_measurable=lambda: None)
    monkeypatch.setattr(node_supervisor, "NodeStanding", lambda _station, _uuid: standing)
    supervisor._try_once()
    assert asked == [(UUID, seconds, True)]


class Session:
    """A session of :meth:`NodeSupervisor._open_and_measure` without a node: ``fails`` is raised while it is kept."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, fails: Exception | None = None, **trusted: bool) -> None:
        self.course: list[Any] = []
        self.supervisor = supervisor_at([100.0], monkeypatch, unsigned=True, by="ncap", **self.asked(trusted))
        self.trusted = SimpleNamespace(sheet="sheet", **{"unsigned": False, "unverified": False, **trusted})
        node = SimpleNamespace(contact=SimpleNamespace(link=None), sealed=True)
        self.standing: Any = SimpleNamespace(drives=None, unsigned=None)
        self.bus: Any = SimpleNamespace(beginning={UUID})
        presence = SimpleNamespace(on_announce=lambda *_words: self.course.append("announce"))
        monkeypatch.setattr(self.supervisor, "_buses", SimpleNamespace(presence=presence))
        monkeypatch.setattr(node_supervisor, "Conversation", lambda *_words, **_how: nullcontext(node))
        monkeypatch.setattr(node_supervisor, "open_trusted", self.opens("signed"))
        monkeypatch.setattr(node_supervisor, "open_unverified", self.opens("unverified"))
        monkeypatch.setattr(node_supervisor, "read_firmware", lambda _node: "1.0")
        monkeypatch.setattr(node_supervisor, "firmware_of", lambda _station, _uuid, read: read)
        monkeypatch.setattr(
            node_supervisor, "require_good_firmware", lambda _u, runs: self.course.append(("good?", runs))
        )
        monkeypatch.setattr(node_supervisor, "firmware_warning", lambda _runs: "old")
        monkeypatch.setattr(self.supervisor, "_measure", lambda *_words: self.course.append("measure"))

        def keep(*_words: Any) -> None:
            self.course.append(("keep", set(self.bus.beginning), self.standing.drives, self.standing.unsigned))
            if fails is not None:
                raise fails

        monkeypatch.setattr(self.supervisor, "_keep", keep)
        monkeypatch.setattr(
            self.supervisor, "_end", lambda _bus, _trusted, address, *, answers: self.course.append((address, answers))
        )

    @staticmethod
    def asked(trusted: dict[str, bool]) -> dict[str, Any]:
        return {"unverified": trusted.get("unverified", False), "require_firmware": trusted.get("unsigned", False)}

    def opens(self, name: str) -> Any:
        return lambda _station, _node, **how: self.course.append((name, how)) or self.trusted

    def run(self) -> None:
        sighting: Any = SimpleNamespace(contact=lambda: None, address=0x21)
        self.supervisor._open_and_measure(self.bus, sighting, self.standing)


@pytest.mark.parametrize(
    ("trusted", "opened", "unsigned"),
    [
        ({}, ("signed", {"by": "ncap", "unsigned": True}), False),
        ({"unsigned": True}, ("signed", {"by": "ncap", "unsigned": True}), True),
        ({"unverified": True}, ("unverified", {"by": "ncap"}), True),
    ],
)
@pytest.mark.parametrize("moves", [False, True])
def test_the_rights_of_a_node_in_its_session_are_those_of_its_datasheet(
    monkeypatch: pytest.MonkeyPatch, trusted: dict[str, bool], opened: Any, unsigned: bool, moves: bool
) -> None:
    session = Session(monkeypatch, **trusted)
    session.supervisor._driven = cast(Any, object()) if moves else None
    session.run()
    good = [("good?", "1.0")] if trusted.get("unsigned") else []
    assert session.course == [
        "announce", opened, *good, "measure", ("keep", set(), moves, unsigned), (0x21, True),
    ]  # fmt: skip
    assert session.supervisor._proven is True
    assert session.supervisor._firmware_warning == "old"
    assert session.supervisor.verified is session.trusted


@pytest.mark.parametrize(
    ("error", "stopped", "answers"),
    [
        (LinkError("It is silent."), False, False),
        (LinkError("It is silent."), True, True),
        (PolicyError("Off the list."), False, True),
        (NotAuthenticError("Revoked."), False, True),
        (BadDataError("Nonsense."), False, True),
        (KeyStolenError("A new key."), False, True),
        (StoreError("The disk is full."), False, False),
    ],
)
def test_a_node_that_is_given_up_by_a_decision_answers_and_its_streams_are_stopped(
    monkeypatch: pytest.MonkeyPatch, error: Exception, stopped: bool, answers: bool
) -> None:
    session = Session(monkeypatch, error)
    if stopped:
        session.supervisor._stop.set()
    with pytest.raises(type(error)):
        session.run()
    assert session.course[-1] == (0x21, answers)


@pytest.mark.parametrize("news", [("", "a", "a", "b", ""), ("", "")])
def test_a_mark_on_values_is_reported_each_time_that_it_changes(
    monkeypatch: pytest.MonkeyPatch, news: tuple[str, ...]
) -> None:
    supervisor, told, marks = supervisor_at([0.0], monkeypatch), list[tuple[str, str]](), iter(news)
    streams = SimpleNamespace(tell_time=lambda _t: None, silent=lambda _now: 0.0, clock=SimpleNamespace(lie=""))
    monkeypatch.setattr(supervisor, "streams", streams)
    monkeypatch.setattr(supervisor, "_set_state", lambda state, why="": told.append((state, why)))
    standing: Any = SimpleNamespace(mark="")

    def require() -> None:
        mark = next(marks, None)
        if mark is None:
            supervisor.stop()
        else:
            standing.mark = mark

    standing.require = require
    none: Any = None
    supervisor._watch(none, none, standing, None)
    assert told == ([("running", "a"), ("running", "b"), ("running", "")] if len(news) > 2 else [])


class Tries:
    """A supervisor's one try, whose session proves the node (or not) and ends with an error; what follows, in order."""

    def __init__(
        self, monkeypatch: pytest.MonkeyPatch, error: BaseException | None = None, *, sealed: bool = True,
        conflict: Exception | None = None,
    ) -> None:  # fmt: skip
        self.course: list[Any] = []
        self.supervisor = supervisor_at([100.0], monkeypatch)
        bus = SimpleNamespace(
            share=BusShare(cast(Any, None)), discovery=SimpleNamespace(discover=self.does("broadcast"))
        )
        presence = SimpleNamespace(
            find=lambda _uuid, **_how: "here", let_announce=self.does("let"), search_again=self.does("search"),
            conflict_at=lambda sighting: self.course.append(("conflict?", sighting)) or conflict,
        )  # fmt: skip
        buses = SimpleNamespace(presence=presence, bus_of=lambda _sighting: bus, all=lambda: [bus])
        monkeypatch.setattr(self.supervisor, "_buses", buses)
        monkeypatch.setattr(self.supervisor, "_let_others_finish", self.does("others"))
        monkeypatch.setattr(self.supervisor, "_wait_for_vault", self.does("vault"))
        standing = SimpleNamespace(require_measurable=self.does("measurable?"))
        monkeypatch.setattr(node_supervisor, "NodeStanding", lambda _station, _uuid: standing)

        def session(*_words: Any) -> None:
            self.course.append("session")
            self.supervisor._proven = sealed
            if error is not None:
                raise error

        monkeypatch.setattr(self.supervisor, "_in_session", session)

    def does(self, name: str) -> Any:
        return lambda *_words: self.course.append(name)


BEFORE = ["others", "vault", "measurable?", "session"]


def refusal(*, sealed: bool) -> NodeRefusedError:
    error = NodeRefusedError("No.", reason=1)
    error.sealed = sealed
    return error


@pytest.mark.parametrize(
    ("error", "sealed", "proven", "after"),
    [
        (NotAuthenticError("Revoked."), True, True, ["let"]),
        (PolicyError("Off the list."), True, True, ["let"]),
        (BadDataError("Nonsense."), True, True, ["let"]),
        (refusal(sealed=True), True, True, ["let"]),
        (refusal(sealed=False), True, False, ["let", "search", "broadcast", ("conflict?", "here")]),
        (refusal(sealed=True), False, False, ["let", "search", "broadcast", ("conflict?", "here")]),
        (NotAuthenticError("Another key."), False, False, ["let", "search", "broadcast", ("conflict?", "here")]),
        (StoreError("The disk is full."), True, True, ["let", "search"]),
        (LinkError("It is silent."), True, False, ["let", "search", ("conflict?", "here")]),
        (LinkError("It is silent."), False, False, ["let", "search", ("conflict?", "here")]),
        (SessionLostError(LinkError("Lost.")), True, False, ["let", "search", "broadcast", ("conflict?", "here")]),
        (KeyboardInterrupt(), False, False, ["let", "search"]),
    ],
)
def test_only_what_the_nodes_key_vouches_for_proves_that_it_is_here(
    monkeypatch: pytest.MonkeyPatch, error: BaseException, sealed: bool, proven: bool, after: list[Any]
) -> None:
    """Any device can show its UUID and refuse: then it is searched again, and two nodes at one address are named."""
    tries = Tries(monkeypatch, error, sealed=sealed)
    with pytest.raises(type(error)) as raised:
        tries.supervisor._try_once()
    assert raised.value is error
    assert (tries.course, tries.supervisor._proven) == ([*BEFORE, *after], proven)
    assert tries.supervisor._lost_at == 100.0
    two = PolicyError("Two nodes answer at address 0x21.")
    again = Tries(monkeypatch, error, sealed=sealed, conflict=two)
    with pytest.raises(type(two) if ("conflict?", "here") in after else type(error)) as raised:
        again.supervisor._try_once()
    assert (raised.value is two) == (("conflict?", "here") in after)
    if raised.value is two:
        assert two.__cause__ is error


def test_a_try_waits_for_commands_and_for_the_vault_and_one_that_was_ended_meanwhile_finds_nobody(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    good = Tries(monkeypatch)
    good.supervisor._try_once()
    assert (good.course, cast(Any, good.supervisor.sighting)) == (BEFORE, "here")
    ended = Tries(monkeypatch)
    ended.supervisor._stop.set()
    ended.supervisor._try_once()
    assert ended.course == BEFORE[:2]
    full = Tries(monkeypatch, NoRoomError("The bus is full."))
    with pytest.raises(NoRoomError):
        full.supervisor._try_once()
    assert full.course == BEFORE, "the node is here, and is not searched"
    for change in ({"ever_ran": True}, {"bus": None}, {"_request": MeasurementRequest(patient=True)}):
        quiet = Tries(monkeypatch)
        quiet.supervisor.bus = cast(Any, quiet.supervisor._buses.all()[0])
        for name, value in change.items():
            setattr(quiet.supervisor, name, value)
        quiet.supervisor._ask_who_answers()
        assert quiet.course == [], "only before its first value"


@pytest.mark.parametrize("sealed", [True, False])
def test_what_a_session_begins_with_counts_under_its_key_alone(monkeypatch: pytest.MonkeyPatch, sealed: bool) -> None:
    """A link that can be given up gives up as soon as the node is gone; requirements are met before anything moves."""
    session = Session(monkeypatch)
    link: Any = SimpleNamespace(hopeless=lambda: False)
    node = SimpleNamespace(contact=SimpleNamespace(link=link), sealed=sealed)
    monkeypatch.setattr(node_supervisor, "Conversation", lambda *_words, **_how: nullcontext(node))
    wanted = SimpleNamespace(offer=lambda uuid, sheet, stop: session.course.append((uuid, sheet)))
    object.__setattr__(session.supervisor._request, "requirements", wanted)
    session.run()
    assert link.hopeless == session.supervisor._is_gone
    assert session.supervisor._proven is sealed
    assert session.course[2:4] == [(UUID, "sheet"), "measure"]
    monkeypatch.setattr(
        node_supervisor, "open_trusted", lambda *_words, **_how: (_ for _ in ()).throw(LinkError("No."))
    )
    session.supervisor._proven = not sealed
    with pytest.raises(LinkError):
        session.run()
    assert session.supervisor._proven is sealed, "a session that could not be opened counts as well"


@pytest.mark.parametrize(
    ("asked", "nodes", "lease"),
    [(2, 0, 2), (2, 10, 2), (2, 11, 3), (2, 12, 3), (2, 15, 3), (2, 16, 4), (9, 16, 9), (2, 300, 60), (2, 301, 60)],
)
def test_a_lease_is_no_shorter_than_a_fifth_of_a_second_for_each_node_of_the_bus(
    asked: int, nodes: int, lease: int
) -> None:
    own: Any = SimpleNamespace(
        _request=SimpleNamespace(lease=asked), bus=SimpleNamespace(share=SimpleNamespace(nodes=nodes))
    )
    assert NodeSupervisor._lease_now(own) == lease
    own.bus = None
    assert NodeSupervisor._lease_now(own) == asked


@pytest.mark.parametrize("fails", [False, True])
def test_a_node_is_on_its_way_while_its_session_begins_and_no_longer(
    monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    """What was seen of it before the session raises no doubt about the session."""
    supervisor = supervisor_at([100.0], monkeypatch)
    supervisor._announced = supervisor._elsewhere = 90.0
    bus: Any = SimpleNamespace(beginning={b"other"})
    seen: list[Any] = []

    def opens(*_words: Any) -> None:
        seen.append((set(bus.beginning), supervisor._announced, supervisor._elsewhere))
        if fails:
            raise LinkError("It is silent.")

    monkeypatch.setattr(supervisor, "_open_and_measure", opens)
    none: Any = None
    with pytest.raises(LinkError) if fails else nullcontext():
        supervisor._in_session(bus, none, none)
    assert seen == [({UUID, b"other"}, 0.0, 0.0)]
    assert bus.beginning == {b"other"}


def test_an_announce_from_before_the_session_was_open_raises_no_doubt(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(monkeypatch)

    def opens(*_words: Any, **_how: Any) -> Any:
        session.supervisor._announced = 95.0
        return session.trusted

    monkeypatch.setattr(node_supervisor, "open_trusted", opens)
    session.run()
    assert session.supervisor._announced == 0.0


def test_a_broadcast_that_cannot_be_sent_changes_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    supervisor, asked = supervisor_at([100.0], monkeypatch), list[int]()

    def discover() -> None:
        asked.append(1)
        raise LinkError("The bus is gone.")

    supervisor.bus = cast(Any, SimpleNamespace(discovery=SimpleNamespace(discover=discover)))
    supervisor._ask_who_answers()
    assert asked == [1]


@pytest.mark.parametrize(
    ("error", "ran", "states"),
    [
        (BadDatasheetError("It changed."), True, ["refused", "ended"]),
        (BadDataError("Nonsense."), True, ["lost", "ended"]),
        (BadDatasheetError("It changed."), False, ["waiting", "ended"]),
        (None, True, ["ended"]),
    ],
)
def test_a_failed_try_is_reported_as_what_it_is_and_the_next_one_is_no_later_than_the_last(
    monkeypatch: pytest.MonkeyPatch, error: Exception | None, ran: bool, states: list[str]
) -> None:
    """None: it is stopped during the try, and the error of that is none."""
    supervisor, seen, pauses = supervisor_at([0.0], monkeypatch), list[str](), list[float]()
    policy = SimpleNamespace(gives_up=lambda *_, **__: False, seconds_left=0.25, next_try=lambda _pause: "soon")
    monkeypatch.setattr(node_supervisor, "RetryPolicy", lambda _seconds: policy)
    monkeypatch.setattr(supervisor, "_set_state", lambda state, *_, **__: seen.append(state))
    monkeypatch.setattr(supervisor, "_buses", SimpleNamespace(all=list))
    monkeypatch.setattr(supervisor, "_anew", SimpleNamespace(clear=lambda: None))
    supervisor.ever_ran = ran

    def failure() -> Exception:
        if error is None:
            supervisor._stop.set()
        return error or LinkError("It is gone.")

    def wait(pause: float, *_: float, **__: bool) -> None:
        pauses.append(pause)
        supervisor._stop.set()

    monkeypatch.setattr(supervisor, "_failure", failure)
    monkeypatch.setattr(supervisor, "_wait", wait)
    supervisor._run()
    assert (seen, pauses) == (states, [0.25] if error else [])


@pytest.mark.parametrize(
    ("rest", "announced", "elsewhere", "pause"),
    [(False, 0.0, 0.0, CALM), (True, 0.0, 0.0, LOOK), (False, 9.0, 0.0, LOOK), (False, 0.0, 9.0, LOOK)],
)
def test_a_session_is_looked_at_more_often_while_there_is_something_to_find_out(
    monkeypatch: pytest.MonkeyPatch, rest: bool, announced: float, elsewhere: float, pause: float
) -> None:
    supervisor, waits = supervisor_at([10.0], monkeypatch), list[float]()
    anew = SimpleNamespace(wait=waits.append, set=lambda: None)
    monkeypatch.setattr(supervisor, "_anew", anew)
    monkeypatch.setattr(supervisor, "_doubted", lambda _now: False)
    supervisor._announced, supervisor._elsewhere = announced, elsewhere
    streams = SimpleNamespace(silent=lambda _now: 0.0, clock=SimpleNamespace(lie=""))
    monkeypatch.setattr(supervisor, "streams", streams)
    none: Any = None
    standing: Any = SimpleNamespace(require=supervisor.stop, mark="")
    supervisor._watch(none, none, standing, cast(Any, SimpleNamespace(step=lambda: True)) if rest else None)
    assert waits == [pause]


def test_a_lie_of_the_clock_and_a_datasheet_that_was_read_are_reported_once(monkeypatch: pytest.MonkeyPatch) -> None:
    supervisor, states, done = supervisor_at([0.0], monkeypatch), list[Any](), list[bytes]()
    steps, turns = iter([True, True, False]), iter(range(5))

    def require() -> None:
        if next(turns) == 4:
            supervisor.stop()

    monkeypatch.setattr(supervisor, "_events", SimpleNamespace(reread_done=done.append))
    monkeypatch.setattr(supervisor, "_set_state", lambda state, why="": states.append((state, why)))
    streams = SimpleNamespace(silent=lambda _now: 0.0, clock=SimpleNamespace(lie="it was set"))
    monkeypatch.setattr(supervisor, "streams", streams)
    none: Any = None
    standing: Any = SimpleNamespace(require=require, mark="")
    supervisor._watch(none, none, standing, cast(Any, SimpleNamespace(step=lambda: next(steps))))
    assert done == [UUID]
    assert states == [("running", "its clock is inconsistent: it was set")]


def test_a_session_ends_after_the_command_that_has_its_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    supervisor, course = supervisor_at([0.0], monkeypatch), list[Any]()

    class Turn:
        def __enter__(self) -> None:
            course.append(supervisor.verified)

        def __exit__(self, *_why: object) -> None:
            course.append(supervisor.verified)

    trusted: Any = SimpleNamespace(node=SimpleNamespace(forget=lambda: None))
    supervisor.verified, supervisor._comes_back = trusted, True
    monkeypatch.setattr(supervisor, "turn", Turn())
    monkeypatch.setattr(supervisor, "_buses", SimpleNamespace(presence=SimpleNamespace(let_announce=lambda _uuid: 0)))
    monkeypatch.setattr(supervisor, "streams", SimpleNamespace(stop=lambda *_words: None))
    none: Any = None
    supervisor._end(none, trusted, 0x21, answers=False)
    assert course == [trusted, None]
