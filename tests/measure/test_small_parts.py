"""Small parts of measuring, each alone: a clock, a state, a limit, a reason, what is waited for and what is not."""

from __future__ import annotations

import threading
from collections import deque
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from teds_provision.errors import (
    AddressConflictError,
    BadDataError,
    LinkError,
    NoRoomError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
    VaultLockedError,
)
from teds_provision.measure import capture, matching, node_supervisor, standing, verified_session, zero
from teds_provision.measure import clock as of_clock
from teds_provision.measure import interpreter as of_interpreter
from teds_provision.measure import presence as of_presence
from teds_provision.measure.blocks import SetPointCommand, StationFacts
from teds_provision.measure.clock import SLEW, ClockMap, HostClock, WallClock
from teds_provision.measure.interpreter import StreamInterpreter
from teds_provision.measure.matching import NodeLoad, NodeMatch
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.presence import Presence
from teds_provision.measure.request import Events, MeasurementRequest
from teds_provision.measure.running import measurement_job
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.measurement import Measurement
from teds_provision.measure.running.measurement_job import MeasurementJob
from teds_provision.measure.stream_receiver import HearingThread, ReceivedStream
from teds_provision.protocol.operation.stream_commands import StreamKind
from teds_provision.provisioning.progress import DONE, NOTHING
from teds_provision.station.store.records import KeptMeasurement

UUID = bytes(range(10))
NONE: Any = None


# -- clocks ------------------------------------------------------------------------------------------------------------


def test_the_clock_of_a_measurement_goes_on_evenly_when_the_systems_is_set(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_clock, "time", SimpleNamespace(monotonic=lambda: 50.0, time=lambda: 9e9))
    assert HostClock(WallClock(1.8e9)).now() == 1.8e9 + 50


def test_before_the_refit_a_stamp_has_the_whole_residue_and_after_the_slew_none() -> None:
    made: Any = SimpleNamespace(_offset=1000.0, _skew=0.0, _origin=0, _residue=80.0, _refitted=10 * SLEW)
    at = {tick: ClockMap._line(made, tick) for tick in (0, 10 * SLEW, 10 * SLEW + SLEW // 4, 11 * SLEW, 12 * SLEW)}
    assert list(at.values()) == [1080.0, 1080.0, pytest.approx(1060.0), 1000.0, 1000.0]


def test_ticks_and_times_of_years_are_whole_nanoseconds() -> None:
    """2^60 ns are 36 years; as floats they would have steps of 128 ns."""
    made = ClockMap()
    made._offset = 0.25
    large = 2**60 + 1
    host, rate, _ = made.line(large, large + 10)
    assert (host, type(host), rate) == (large, int, 1.0)
    assert (made.tick_at(large), type(made.tick_at(large))) == (large, int)


# -- streams -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("even", "counters", "blocks"),
    [
        (True, (0, 3, 6), [[0, 3, 6]]),
        (True, (0, 3, 9, 12), [[0, 3], [9, 12]]),
        (False, (0, 3, 6), [[0], [3], [6]]),
        (False, (0,), [[0]]),
        (True, (), []),
    ],
)
def test_messages_that_follow_one_another_are_one_block_unless_their_period_varies(
    even: bool, counters: tuple[int, ...], blocks: list[list[int]]
) -> None:
    """A stream that runs free, or of events, has the time of each message alone."""
    made: Any = SimpleNamespace(_even=even, _n=3, _block=lambda part: [message.index for message in part])
    messages: Any = [SimpleNamespace(index=index) for index in counters]
    found: Any = StreamInterpreter.blocks(made, messages)
    assert found == blocks


def test_an_invalid_value_of_a_channel_read_alone_is_not_valid() -> None:
    found = SimpleNamespace(value=np.array([1.0, 2.0]), valid=np.array([True, False]))
    interpreter = SimpleNamespace(
        channel=SimpleNamespace(number=1), others=(), unit=SimpleNamespace(to_si=lambda value: value * 10),
        reader=SimpleNamespace(raw=lambda rows: rows[:, 0]), values=lambda _raw, _others: found,
    )  # fmt: skip
    made: Any = SimpleNamespace(
        _many=None, _row=1, _channels=[interpreter], _places=[slice(0, 1)], problems={},
        _plan=SimpleNamespace(layout=SimpleNamespace(channels=(1,))),
    )  # fmt: skip
    raws, value, valid = StreamInterpreter._values(made, b"\7\x09")
    assert (raws.tolist(), valid.tolist()) == ([[7], [9]], [[True], [False]])
    assert value[0, 0] == 10.0
    assert np.isnan(value[1, 0])


def test_the_clock_error_of_a_stream_is_that_of_its_last_block() -> None:
    """Without an exchange since a jump of the clock it is not known any more."""
    given: list[Any] = []
    made: Any = SimpleNamespace(samples=0, bound=None, _test_pattern=False, deliver=given.append, last_good_at=0.0)
    for errors, bound in (((0.25, 0.5), 0.5), ((0.125, None), None)):
        blocks: Any = [SimpleNamespace(value=np.zeros((3, 2)), clock_error=error) for error in errors]
        ReceivedStream._hand_on(made, [], blocks)
        assert made.bound == bound
    assert (made.samples, len(given), made.last_good_at) == (24, 4, 0.0)


def test_frames_that_the_link_lost_are_counted_and_what_waits_is_handed_on_in_time(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("teds_provision.measure.stream_receiver.time", SimpleNamespace(monotonic=lambda: 100.0))
    flushed: list[float] = []
    holds, done = (SimpleNamespace(flush=flushed.append, holds=holds) for holds in (True, False))
    made: Any = SimpleNamespace(lost_frames=0, _new=deque([holds]))
    waiting: Any = {id(done): done}
    assert HearingThread._flush(made, waiting, 100.0, 7) == 100.0
    assert (made.lost_frames, flushed, len(made._new)) == (0, [], 1), "not yet"
    assert HearingThread._flush(made, waiting, 0.0, 7) == 100.0
    assert (made.lost_frames, flushed) == (7, [100.0, 100.0])
    assert waiting == {id(holds): holds}


# -- a node ------------------------------------------------------------------------------------------------------------


def _supervisor(reports: list[Any], **request: Any) -> NodeSupervisor:
    events = Events(lambda _block: None, lambda _facts: None, reports.append)
    buses: Any = SimpleNamespace(all=list, presence=SimpleNamespace(let_announce=lambda _uuid: None))
    return NodeSupervisor(
        NONE, buses, UUID, MeasurementRequest(**request), HostClock(), events, CommonStart([UUID])
    )  # fmt: skip


@pytest.mark.parametrize(
    ("error", "state"),
    [
        (NotAuthenticError("No.", hint=""), "refused"),
        (PolicyError("Not listed."), "refused"),
        (BadDataError("Unreadable."), "refused"),
        (LinkError("Silent."), "lost"),
    ],
)
def test_a_newcomer_that_may_not_be_measured_is_refused_and_one_that_is_gone_is_lost(
    monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError, state: str
) -> None:
    """Where nodes come and go the owner decides when one is tried again: it ends after one failure."""
    reports: list[Any] = []
    made = _supervisor(reports, newcomers=True)
    monkeypatch.setattr(made, "_failure", lambda: error)
    monkeypatch.setattr(made, "_is_shared", lambda _error: None)
    made._run()
    assert [(report.state, report.why) for report in reports] == [(state, error.message.rstrip("."))]
    assert made.done.is_set()
    assert made.ready.is_set()
    assert made.error is error


def test_the_clock_error_of_a_node_is_the_largest_of_its_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    made = _supervisor([])
    counts = {"samples": 1, "lost": 2, "late": 3, "bad": 4, "invalid": 0, "invalid_why": ()}
    for errors, found in (((0.001, 0.5, None), 0.5), ((None,), None), ((), None)):
        sums = [SimpleNamespace(clock_error=error, **counts) for error in errors]
        monkeypatch.setattr(made, "streams", SimpleNamespace(summed=lambda sums=sums: sums))
        report = made.report()
        assert report.clock_error == found
        assert (report.samples, report.lost, report.late, report.bad) == tuple(n * len(errors) for n in (1, 2, 3, 4))


def test_a_change_of_the_store_ends_the_wait_only_if_the_node_may_be_measured_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made, waits = _supervisor([]), list[float]()
    reasons = ["banned", "banned", ""]
    changes = iter([1, 1, 2, 3, 4, 5, 6])
    now = [0.0]

    def wait(seconds: float) -> bool:
        waits.append(seconds)
        now[0] += seconds
        return False

    monkeypatch.setattr(made, "_station", SimpleNamespace(changes=lambda: next(changes)))
    monkeypatch.setattr(made, "_anew", SimpleNamespace(wait=wait))
    monkeypatch.setattr(made, "_stop", SimpleNamespace(wait=lambda _seconds: None))
    monkeypatch.setattr(node_supervisor, "why_not_measured", lambda *_: reasons.pop(0))
    monkeypatch.setattr(node_supervisor, "time", SimpleNamespace(monotonic=lambda: now[0]))
    made._wait(3600.0, 0.0, decided=True)
    assert (len(waits), reasons) == (4, []), "unchanged, changed, changed, changed and free"
    assert max(waits) < 10


def test_a_locked_vault_is_reported_once_while_it_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[Any] = []
    made, tries = _supervisor(reports, patient=True), [0]

    def unlock(_uuid: bytes) -> None:
        tries[0] += 1
        if tries[0] < 4:
            raise VaultLockedError("Another command changes the master key.")

    monkeypatch.setattr(made, "_station", SimpleNamespace(unlock=unlock))
    monkeypatch.setattr(made, "_stop", SimpleNamespace(is_set=lambda: False, wait=lambda _seconds: None))
    made._wait_for_vault()
    assert tries == [4]
    assert [(report.state, report.why) for report in reports] == [("waiting", "Another command changes the master key")]


def test_only_a_measurement_that_is_patient_waits_for_a_locked_vault(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[Any] = []
    made = _supervisor(reports, patient=False)
    unlock = SimpleNamespace(unlock=lambda _uuid: pytest.fail("the next try says that the vault is locked"))
    monkeypatch.setattr(made, "_station", unlock)
    made._wait_for_vault()
    assert reports == []


def test_a_reason_stands_in_a_sentence_without_its_full_stop(monkeypatch: pytest.MonkeyPatch) -> None:
    for error, why in ((PolicyError("It is banned."), "It is banned"), (NotAuthenticError("No."), "No"), (None, "")):

        def require(*_: Any, error: Any = error) -> None:
            if error is not None:
                raise error

        monkeypatch.setattr(standing, "require_measurable", require)
        assert standing.why_not_measured(NONE, UUID) == why


def test_values_count_up_to_the_moment_in_which_the_store_was_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is decided while the question is answered is decided before the answer."""
    now = [1000.0]
    made: Any = SimpleNamespace(
        _station=SimpleNamespace(changes=lambda: 2), _changes=1, _judged=0.0, _good=900.0, ended=None,
        _require_today=lambda: now.__setitem__(0, 1005.0),
    )  # fmt: skip
    monkeypatch.setattr(standing, "time", SimpleNamespace(monotonic=lambda: 50.0, time=lambda: now[0]))
    standing.NodeStanding.require(made)
    assert made._good == 1000.0
    now[0] = 1010.0
    standing.NodeStanding.require(made)
    assert made._good == 1010.0, "nothing has changed since"


# -- which nodes -------------------------------------------------------------------------------------------------------


def test_each_group_of_an_expression_must_exist() -> None:
    def get(name: str) -> None:
        if name != "hand":
            raise NotFoundError(f"There is no group {name}.")

    station: Any = SimpleNamespace(groups=SimpleNamespace(get=get))
    NodeMatch.parse("hand").require_groups(station)
    for text in ("hand, arm", "arm, hand"):
        with pytest.raises(NotFoundError, match="no group arm"):
            NodeMatch.parse(text).require_groups(station)


def test_of_the_load_of_a_node_its_sensors_count_and_a_node_that_cannot_be_measured_so_has_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    channels = [
        SimpleNamespace(number=1, sample="u2", actuator=False),
        SimpleNamespace(number=2, sample="u2", actuator=True),
        SimpleNamespace(number=3, sample=None, actuator=False),
    ]
    station: Any = SimpleNamespace(datasheets=SimpleNamespace(datasheet=lambda _uuid: "image"))
    monkeypatch.setattr(
        matching, "Sheet", SimpleNamespace(from_image=lambda _image: SimpleNamespace(channels=channels))
    )
    planned: list[list[int]] = []

    def sensors_of(sensors: Any, *_: Any) -> Any:
        planned.append([channel.number for channel in sensors])
        return sensors

    monkeypatch.setattr(matching, "sensors_of", sensors_of)
    for error in (PolicyError("Too many."), BadDataError("No sensor.")):

        def plan(*_: Any, error: Any = error, **__: Any) -> Any:
            raise error

        monkeypatch.setattr(matching, "plan_node", plan)
        assert matching.load_of(station, UUID, MeasurementRequest(), NONE) == NodeLoad()
    assert planned == [[1], [1]]


def test_nodes_that_were_seen_are_listed_by_uuid_with_their_last_place() -> None:
    made = Presence()
    places: Any = made._seen
    for letter in (b"c", b"a", b"b"):
        first, last = (SimpleNamespace(uuid=letter * count, at=float(count)) for count in (1, 2))
        places[letter * 10] = {("can", 2): last, ("can", 1): first}
    made._seen[b"0" * 10] = {}
    assert [sighting.uuid for sighting in made.all()] == [b"aa", b"bb", b"cc"]


# -- a measurement -----------------------------------------------------------------------------------------------------


def _measurement(**more: Any) -> Any:
    made: Any = Measurement(NONE, NONE, (UUID,), MeasurementRequest(), (), StationFacts("bench"))
    made.supervisors, made._by_uuid, made._ending = [], {}, False
    vars(made).update(more)
    return made


def test_a_set_point_goes_to_its_node_and_one_for_a_node_that_is_not_measured_to_none() -> None:
    came: list[Any] = []
    made = _measurement()
    made._by_uuid[UUID] = SimpleNamespace(uuid=UUID, command=came.append)
    mine, other = SetPointCommand(UUID.hex(), 1, 0.5, 0.0), SetPointCommand("ff" * 10, 1, 0.5, 0.0)
    made.command(mine)
    made.command(other)
    assert came == [mine]


def test_a_measurement_that_fails_ends_its_nodes_and_sinks_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    ended: list[int] = []
    buses: Any = SimpleNamespace(expect=lambda _uuids: None)
    made = Measurement(NONE, buses, (), MeasurementRequest(), (), StationFacts("bench"))

    def fails(*_: Any) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(made, "_loop", fails)
    monkeypatch.setattr(made, "_end", lambda: ended.append(1))
    with pytest.raises(ZeroDivisionError):
        made.run(threading.Event())
    assert ended == [1]


@pytest.mark.parametrize("ending", [False, True])
@pytest.mark.parametrize("known", [False, True])
def test_a_node_that_comes_while_the_measurement_ends_begins_no_more(
    monkeypatch: pytest.MonkeyPatch, ending: bool, known: bool
) -> None:
    started: list[bytes] = []

    def supervisor(_station: Any, _buses: Any, uuid: bytes, *_: Any) -> Any:
        return SimpleNamespace(uuid=uuid, start=lambda: started.append(uuid))

    monkeypatch.setattr("teds_provision.measure.running.measurement.NodeSupervisor", supervisor)
    made = _measurement(_ending=ending, _host=None, _events=None, _common_start=None)
    old = supervisor(None, None, UUID)
    if known:
        made.supervisors, made._by_uuid = [old], {UUID: old}
    joined = made.join(UUID)
    assert (joined is old) is known
    assert made.supervisors == [joined]
    assert started == ([] if ending else [UUID])


@pytest.mark.parametrize(
    ("kept", "kept_as", "owned"),
    [
        (KeptMeasurement("", group="hand", owner="command"), "owned", 1),
        (KeptMeasurement("", group="hand"), "7", 0),
        (KeptMeasurement("5", group="hand"), "5", 0),
    ],
)
def test_a_measurement_of_a_group_is_kept_once(kept: KeptMeasurement, kept_as: str, owned: int) -> None:
    """One that a service has started is in the store already."""
    entered: list[Any] = []

    def owned_by_command(it: KeptMeasurement) -> Any:
        entered.append(it)
        return nullcontext(KeptMeasurement("owned", group="hand"))

    measurements = SimpleNamespace(
        owned_by_command=owned_by_command,
        keep=lambda _it: KeptMeasurement("7", group="hand"),
    )
    job: Any = SimpleNamespace(kept=kept, station=SimpleNamespace(measurements=measurements))
    MeasurementJob._keep_while_it_runs(job, SimpleNamespace(enter_context=lambda context: context.__enter__()))  # type: ignore[arg-type]
    assert (job.kept.id, len(entered)) == (kept_as, owned)


@pytest.mark.parametrize(
    ("ends", "asked", "given"),
    [(None, None, None), (1010.0, None, 10.0), (990.0, None, 0.1), (1000.0, None, 0.1), (1010.0, 3.0, 3.0)],
)
def test_a_measurement_whose_end_has_passed_still_measures_for_a_moment(
    monkeypatch: pytest.MonkeyPatch, ends: float | None, asked: float | None, given: float | None
) -> None:
    """A negative duration would be one without end, or an error; ``--duration`` goes before the kept end."""
    seen: list[Any] = []
    monkeypatch.setattr(measurement_job, "time", SimpleNamespace(time=lambda: 1000.0))

    class Made:
        command = began = None

        def __init__(self, *_: Any, **__: Any) -> None: ...

        def run(self, _stop: Any, duration: float | None) -> str:
            seen.append(duration)
            return "ended"

    monkeypatch.setattr(measurement_job, "Measurement", Made)
    measurements = SimpleNamespace(
        nodes_of=lambda _kept: (UUID,), holder=lambda _uuid: None, running=lambda *_, **__: nullcontext()
    )
    station: Any = SimpleNamespace(measurements=measurements)
    job = MeasurementJob(station, KeptMeasurement("8", uuids=(UUID,), ends=ends))
    monkeypatch.setattr(job, "_facts", lambda: None)
    assert job.run(NONE, threading.Event(), duration=asked) == "ended"  # type: ignore[comparison-overlap]
    assert seen == [given]
    assert job.measurement is None


@pytest.mark.parametrize(("late", "named"), [(1, 1), (3, 3), (4, 3)])
def test_of_the_nodes_that_hold_up_a_trigger_three_are_named(late: int, named: int) -> None:
    notes: list[str] = []
    nodes = [
        SimpleNamespace(uuid=bytes([number]), ready=SimpleNamespace(is_set=lambda ready=ready: ready))
        for number, ready in enumerate([True] + [False] * late)
    ]
    common = SimpleNamespace(due=lambda ready, all_of: False, notice_due=lambda: True)
    made: Any = SimpleNamespace(
        request=SimpleNamespace(trigger=True), supervisors=nodes, _common_start=common,
        watcher=SimpleNamespace(note=notes.append),
    )  # fmt: skip
    Measurement._trigger(made)
    names = ", ".join(f"{number:02x}" for number in range(1, named + 1)) + (" …" if late > named else "")
    assert notes == [f"Waiting for {names} before the trigger, up to 15 s."]


# -- calibration points and zero ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("calibration", "problem", "judged"),
    [("curve", "", "values"), ("curve", "an unknown input", "raw"), (None, "", "raw")],
)
def test_a_sensor_whose_calibration_cannot_be_used_is_still_by_its_raw_values(
    monkeypatch: pytest.MonkeyPatch, calibration: str | None, problem: str, judged: str
) -> None:
    looked: list[str] = []
    monkeypatch.setattr(capture, "require_still", lambda _settled: looked.append("values"))
    monkeypatch.setattr(capture, "require_still_raw", lambda _settled, _reading: looked.append("raw"))
    form = SimpleNamespace(raw_range=(0, 100))
    channel = SimpleNamespace(
        number=3, full_turn=False, calibration=SimpleNamespace(raw_range=(0, 100)) if calibration else None
    )
    reader = SimpleNamespace(numbers=lambda raw: (raw, None), form=form)
    interpreter = SimpleNamespace(channel=channel, problem=problem, reader=reader)
    settled: Any = SimpleNamespace(interpreter=interpreter, raw=np.array([10.0, 12.0, 11.0]))
    point = capture._point(settled, 1.5)
    assert (point.channel, point.raw, point.count) == (3, 11.0, 3)
    assert looked == [judged]


def test_a_reading_outside_of_the_calibrated_range_is_warned_of_with_both_ends() -> None:
    own: Any = SimpleNamespace(inputs=[SimpleNamespace(boundaries=(10.0, 20.0, 40.0))])
    for extrapolated, draft, count in ((True, None, 1), (False, None, 0), (True, "draft", 2), (False, "draft", 1)):
        visit = SimpleNamespace(
            station=SimpleNamespace(datasheets=SimpleNamespace(draft=lambda _uuid, draft=draft: draft)),
            node=SimpleNamespace(uuid=UUID),
        )
        run: Any = SimpleNamespace(visit=visit)
        settled: Any = SimpleNamespace(extrapolated=extrapolated)
        warnings = zero._ZeroRun._warnings(run, settled, own)
        assert len(warnings) == count
        assert ("The reading is outside the calibrated range (raw 10 to 40)." in warnings) is extrapolated
        assert (
            "This node has a draft, which does not include this zero offset; to drop it: draft drop UUID." in warnings
        ) is (draft is not None)


class _Steps:
    """The steps of a command; each has a detail."""

    def __init__(self) -> None:
        self.done: list[str] = []

    def step(self, name: str) -> Any:
        self.done.append(name)
        return nullcontext(SimpleNamespace(detail="", result=None))


@pytest.mark.parametrize(
    ("moved", "dry_run", "tapped", "asked"),
    [
        (0.5, False, False, "brought"), (-0.5, False, False, "brought"), (0.5, False, True, "brought"),
        (-0.5, True, False, "planned"), (0.01, False, False, ""), (-0.01, False, False, ""),
    ],
)  # fmt: skip
def test_a_zero_offset_is_written_if_it_moves_either_way_by_more_than_the_doubt(
    monkeypatch: pytest.MonkeyPatch, moved: float, dry_run: bool, tapped: bool, asked: str
) -> None:
    """A dry run records nothing at the guard of calibrations, and writes nothing. Results are in SI units."""
    guarded: list[dict[str, Any]] = []
    checked, shown, dated = list[str](), list[Any](), list[Any]()

    def guard(*_: Any, **more: Any) -> tuple[str, ...]:
        guarded.append(more)
        return ("guarded",)

    unit = SimpleNamespace(scale=2.0, difference_to_si=lambda value: value * 2)
    own = SimpleNamespace(zero_offset=2.0, unit=unit)
    channel = SimpleNamespace(
        number=1,
        full_turn=False,
        show_reading=lambda *_: "",
        show=lambda *_, **how: shown.append(how),
        si_unit="rad",
    )
    image = SimpleNamespace(blocks={(1, 5): b"curve"}, unsigned_blocks=dict)
    reading = SimpleNamespace(mean=1.0, count=32, spread=0.125, doubt=0.02)
    for name, made in {
        "require_session": lambda *_: None,
        "verify_in_session": lambda *_, **__: SimpleNamespace(image=image),
        "trusted_from": lambda *_: None,
        "_adjustable": lambda *_: (channel, own),
        "turn_of": lambda *_, **__: None,
        "take_samples_of": lambda *_, **__: SimpleNamespace(extrapolated=False),
        "require_still": lambda _settled: reading,
        "offset_for": lambda *_: 2.0 + moved,
        "shortest": lambda given, _turn: given,
        "_si": lambda _channel, _own, value: value * 2,
        "with_zero_offset": lambda *words: dated.append(words) or b"new",
        "guard": guard,
        "diff_blocks": lambda *_: (),
        "require_not_measured": lambda *_, **__: checked.append("here"),
        "_require_nobody_else": lambda *_: checked.append("elsewhere"),
    }.items():
        monkeypatch.setattr(zero, name, made)
    node = SimpleNamespace(uuid=UUID, proven=SimpleNamespace(sequence=7, epoch=1), tapped=tapped)
    run: Any = SimpleNamespace(
        visit=SimpleNamespace(station=None, node=node, released=None), steps=_Steps(), dry_run=dry_run,
        order=SimpleNamespace(channel=1, accept_calibration=None), _wanted=lambda *_: 0.0,
        _warnings=lambda *_: ("beyond",),
        _bring=lambda _image, found: ("brought", found),
    )  # fmt: skip
    found: Any = zero._ZeroRun.run(run)
    how, result = found if isinstance(found, tuple) else ("", found)
    assert how == ("brought" if asked == "brought" else "")
    record = {"brought": [True], "planned": [False], "": []}[asked]
    assert guarded == [{"record": recorded, "expected": ("changed",)} for recorded in record]
    assert (result.offset, result.moved) == ((4.0 + 2 * moved, pytest.approx(2 * moved)) if asked else (4.0, 0.0))
    assert (result.before, result.after, result.spread) == (2.0, pytest.approx(2.0 + 2 * moved), 0.25)
    assert result.warnings == (("beyond", "guarded") if asked else ("beyond",))
    assert [(octets, offset, at.microsecond) for octets, offset, at in dated] == [(b"curve", 2.0 + moved, 0)] * bool(
        asked
    )
    assert shown == [{"difference": True}] * bool(asked)
    assert checked == (["here", "elsewhere"] if asked == "brought" and not tapped else []), "a tap ends other claims"
    assert run.steps.done == (["read", "build"] if asked else ["read"])


@pytest.mark.parametrize(("span", "at_once"), [(11_999_999, False), (12_000_000, True), (20_000_000, True)])
def test_a_message_of_12_ms_or_more_waits_for_no_other(span: int, at_once: bool) -> None:
    subscribe = SimpleNamespace(kind=StreamKind.PERIODIC, period=1_000_000, test_pattern=False)
    made: Any = SimpleNamespace(receiver=SimpleNamespace(plan=SimpleNamespace(span=span, subscribe=subscribe)))
    ReceivedStream.__post_init__(made)
    assert (made._at_once, made._last_instant) == (at_once, span - 1_000_000)
    subscribe.kind = StreamKind.FREE
    ReceivedStream.__post_init__(made)
    assert made._last_instant == 0


def test_the_bounds_of_a_batch_are_those_of_its_last_arrival() -> None:
    """What came by then may be as late as that; by the first one's, the last ones would be of the future."""
    asked: list[int] = []

    def lead_bounds(at: int) -> int:
        asked.append(at)
        return at

    opened: list[Any] = []

    def open_messages(came: Any, bounds: int) -> list[Any]:
        opened.append((came, bounds))
        return []

    made: Any = SimpleNamespace(
        _order=threading.RLock(), _came=deque([(b"a", 5), (b"b", 9)]), mapping=threading.Lock(),
        receiver=SimpleNamespace(open_messages=open_messages), clock=SimpleNamespace(lead_bounds=lead_bounds),
        interpreter=SimpleNamespace(blocks=lambda _messages: []), _hand_on=lambda *_: None,
    )  # fmt: skip
    ReceivedStream.finish(made)
    assert (asked, opened, len(made._came)) == ([9], [([(b"a", 5), (b"b", 9)], 9)], 0)
    ReceivedStream.finish(made)
    assert asked == [9], "nothing was left"


def test_a_node_that_may_not_be_measured_is_not_even_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    order: list[str] = []
    for name in ("require_measurable", "require_session", "verify_in_session", "trusted_from"):

        def asked(*_: Any, name: str = name, **__: Any) -> str:
            order.append(name)
            if name == refuses:
                raise PolicyError("Not listed.")
            return name

        monkeypatch.setattr(verified_session, name, asked)
    refuses = ""
    node: Any = SimpleNamespace(uuid=UUID)
    assert verified_session.open_trusted(NONE, node, by="measure") == "trusted_from"  # type: ignore[comparison-overlap]
    assert order == ["require_measurable", "require_session", "verify_in_session", "trusted_from"]
    refuses = "require_measurable"
    for opens in (verified_session.open_trusted, verified_session.open_unverified):
        order.clear()
        with pytest.raises(PolicyError, match="Not listed"):
            opens(NONE, node, by="measure")
        assert order == ["require_measurable"]


@pytest.mark.parametrize(("octets", "profile"), [(12, "joint"), (0, ""), (0, None)])
def test_a_zero_is_signed_written_verified_and_read_once_more_by_the_new_datasheet(
    monkeypatch: pytest.MonkeyPatch, octets: int, profile: str | None
) -> None:
    steps, given, sampled, logged = dict[str, Any](), dict[str, Any](), list[Any](), list[Any]()

    def step(name: str) -> Any:
        steps[name] = SimpleNamespace(detail="", result="", verdict="")
        steps[name].take_verdict = lambda verdict: setattr(steps[name], "verdict", verdict)
        return nullcontext(steps[name])

    def write(_station: Any, _node: Any, image: Any, **how: Any) -> Any:
        given.update(how, image=image)
        return SimpleNamespace(octets=octets, on_node="on the node")

    def take(trusted: Any, number: int, **how: Any) -> Any:
        sampled.append((trusted, number, how))
        return SimpleNamespace(calibrated=lambda: "samples")

    own, channel = "the new curve", SimpleNamespace(number=1, si_unit="rad", full_turn=True)
    for name, made in {
        "SignedNodeKey": lambda *words: words,
        "sign": lambda *_, **how: SimpleNamespace(sequence=how["node_sequence"] + 1, image="signed"),
        "write": write,
        "judge_and_keep": lambda *_, **how: SimpleNamespace(verified=SimpleNamespace(verdict="authentic"), **how),
        "NodeVerification": lambda on_node, judged: on_node,
        "trusted_from": lambda _station, _node, looked: looked,
        "_adjustable": lambda _trusted, _number: (channel, own),
        "turn_of": lambda curve, *, full_turn: (curve, full_turn),
        "take_samples_of": take,
        "reading_of": lambda values, turn: SimpleNamespace(mean=0.25, values=(values, turn)),
        "_si": lambda _channel, curve, value: (curve, value),
    }.items():
        monkeypatch.setattr(zero, name, made)
    record = None if profile is None else SimpleNamespace(profile=profile)
    station = SimpleNamespace(
        nodes=SimpleNamespace(get=lambda _uuid: record), audit=lambda *words, **more: logged.append((words, more))
    )
    node = SimpleNamespace(uuid=UUID, proven=SimpleNamespace(epoch=1, sequence=7), open_counter=3)
    visit = SimpleNamespace(station=station, node=node, who=SimpleNamespace(point=b"point", key_signature=b"signature"))
    ways = SimpleNamespace(step=step, done=["all"], reporter=SimpleNamespace(written="progress"))
    found = zero.ZeroResult(UUID, channel, 0.5, 0.1, 0.2, 0.3, 0.0, 32, 7, (), ("a draft",), (), False)  # type: ignore[arg-type]
    run: Any = SimpleNamespace(visit=visit, steps=ways, low="low")
    done = zero._ZeroRun._bring(run, NONE, found)
    assert done == replace(found, after=(own, 0.25), sequence=8, steps=("all",), written=True)  # type: ignore[arg-type]
    facts = {"profile": profile} if profile else {}
    assert given == {"image": "signed", "progress": "progress", "facts": facts, "low": "low"}
    assert (steps["sign"].detail, steps["write"].detail) == ("sequence 8", f"{octets} octets")
    assert (steps["write"].result, steps["verify"].verdict) == (DONE if octets else NOTHING, "authentic")
    assert sampled == [("on the node", 1, {"count": 16, "seconds": 0.0})]
    assert logged == [(("zero", UUID, "done"), {"channel": 1, "offset": 0.5, "unit": "rad", "sequence": 8})]


def test_a_newcomer_for_which_the_bus_has_no_room_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    reports: list[Any] = []
    made = _supervisor(reports, newcomers=True)
    monkeypatch.setattr(made, "_failure", lambda: NoRoomError("The bus is full."))
    monkeypatch.setattr(made, "_is_shared", lambda _error: None)
    made._run()
    assert [(report.state, report.why) for report in reports] == [("waiting", "no room on the bus")]


def test_a_conflict_of_addresses_is_raised_as_a_new_error_with_its_hint_until_it_is_old(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Several threads raise it, and each adds its own traceback."""
    now, place, made = [0.0], ("can", 7), Presence()
    monkeypatch.setattr(of_presence, "time", SimpleNamespace(monotonic=lambda: now[0]))
    error = AddressConflictError("Two nodes answer.", hint="Readdress one.")
    made._conflicts[place] = (0.0, error)  # type: ignore[index]
    found: Any = made._conflict_at(place)  # type: ignore[arg-type]
    assert (found is not error, found.message, found.hint) == (True, "Two nodes answer.", "Readdress one.")
    now[0] = of_presence.RECENT
    assert made._conflict_at(place) is None  # type: ignore[arg-type]


def test_of_the_channels_that_a_compensation_lacks_the_first_is_named() -> None:
    interpreter: Any = SimpleNamespace(problem="", others=(4, 5, 6), channel=SimpleNamespace(number=1))
    for present, named in (({1}, 4), ({1, 4}, 5), ({1, 4, 5}, 6)):
        assert of_interpreter._why_raw(interpreter, present) == (
            f"Channel 1 is compensated by channel {named}, which is not part of the same stream."
        )
    assert of_interpreter._why_raw(interpreter, {1, 4, 5, 6}) == ""


def test_a_ban_is_looked_up_with_the_key_that_is_pinned_of_the_node() -> None:
    asked: list[Any] = []
    station: Any = SimpleNamespace(
        pins=SimpleNamespace(pinned=lambda uuid: ("pin of", uuid)),
        policy=SimpleNamespace(denied=lambda *words: asked.append(words) or SimpleNamespace(why="stolen")),
    )
    with pytest.raises(NotAuthenticError) as refused:
        standing.require_measurable(station, UUID)
    assert asked == [(UUID, ("pin of", UUID))]
    assert refused.value.message == f"Node {UUID.hex()} was revoked: stolen."
    assert refused.value.hint == f"If that was a mistake: teds-provision revoke --lift {UUID.hex()}"
