"""Errors that end nothing: whatever a node, a disk or the network raises at these places, the measurement goes on.

Each place bears several kinds of errors, and one left out of its tuple would end a thread, or reach a person as a bug.
"""

from __future__ import annotations

import os
import subprocess
import threading
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import (
    BadDataError,
    GarbledError,
    LinkError,
    NodeRefusedError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.measure import background_reread, matching, rates, standing
from teds_provision.measure.background_reread import BackgroundReread
from teds_provision.measure.blocks import StationFacts
from teds_provision.measure.held_actuator import HeldActuator
from teds_provision.measure.node_supervisor import NodeSupervisor
from teds_provision.measure.recordings import converting
from teds_provision.measure.recordings.mcap import _values
from teds_provision.measure.running import trigger
from teds_provision.measure.running.common_start import CommonStart
from teds_provision.measure.running.measurement import Measurement
from teds_provision.measure.running.streams import NodeStreams
from teds_provision.measure.sinks import foxglove_server, json_events, live, mqtt
from teds_provision.measure.sinks.foxglove_server import FoxgloveServer
from teds_provision.measure.sinks.live import TopicSink
from teds_provision.measure.sinks.ros import child
from teds_provision.protocol.operation.stream_commands import SOON, WAITS
from teds_provision.provisioning.conversation import SessionLostError

UUID = bytes(range(10))
NONE: Any = None
LOST = SessionLostError(NodeSilentError("Silent."))
REFUSED = NodeRefusedError("Refused.", reason=3)
OF_A_SESSION = [LinkError("Silent."), REFUSED, BadDataError("Torn."), LOST]


def _raising(error: BaseException) -> Any:
    def fails(*_: Any, **__: Any) -> Any:
        raise error

    return fails


# -- a node ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [NodeSilentError("-"), GarbledError("-"), REFUSED, BadDataError("-"), LOST])
def test_what_is_read_in_the_background_begins_again_later_and_only_a_lost_session_ends_it(
    monkeypatch: pytest.MonkeyPatch, error: Exception
) -> None:
    monkeypatch.setattr(background_reread, "time", SimpleNamespace(monotonic=lambda: 500.0))
    monkeypatch.setattr(background_reread, "read_in_between", lambda _node, *, gap: iter(["again", gap]))
    closed: list[int] = []

    class Steps:
        def __next__(self) -> Any:
            raise error

    made: Any = SimpleNamespace(
        _due=100.0, _patient_until=200.0, _bus=SimpleNamespace(beginning=set(), reading=threading.Lock()), _mine=False,
        _steps=Steps(), _verified=SimpleNamespace(node=None), _left=2, close=lambda: closed.append(1),
    )  # fmt: skip
    if error is LOST:
        with pytest.raises(SessionLostError):
            BackgroundReread.step(made)
        return
    assert BackgroundReread.step(made) is True
    assert (made._left, closed, made._due > 500.0, next(made._steps)) == (1, [1], True, "again")
    made._steps, made._due = Steps(), 0.0
    assert BackgroundReread.step(made) is False, "the last try"


@pytest.mark.parametrize("error", [*OF_A_SESSION, KeyError(3)])
def test_an_actuator_whose_release_is_not_confirmed_is_not_called_safe(error: Exception) -> None:
    made: Any = SimpleNamespace(
        _verified=SimpleNamespace(node=SimpleNamespace(request=_raising(error))), safe=True,
        channel=SimpleNamespace(number=3),
    )  # fmt: skip
    HeldActuator.__exit__(made, None, None, None)
    assert made.safe is None


@pytest.mark.parametrize("error", OF_A_SESSION)
def test_a_stream_that_cannot_be_stopped_any_more_is_counted_and_heard_no_more(error: Exception) -> None:
    forgotten, added = list[int](), list[Any]()
    bus: Any = SimpleNamespace(hear_out=lambda *_: None, forget=lambda _address, number: forgotten.append(number))
    heard = SimpleNamespace(ending=lambda: 5, receiver=None)
    made: Any = SimpleNamespace(
        running={0: heard, 2: heard}, totals={n: SimpleNamespace(add=added.append) for n in (0, 2)}
    )
    trusted: Any = SimpleNamespace(node=SimpleNamespace(request=_raising(error)))
    NodeStreams.stop(made, SimpleNamespace(hearing=bus), trusted, 17)  # type: ignore[arg-type]
    assert (forgotten, added, made.running) == ([0, 2], [heard, heard], {})


@pytest.mark.parametrize("error", OF_A_SESSION)
def test_a_node_that_does_not_answer_at_the_end_ends_all_the_same(error: Exception) -> None:
    stopped, forgotten = list[Any](), list[int]()
    trusted: Any = SimpleNamespace(node=SimpleNamespace(request=_raising(error), forget=lambda: forgotten.append(1)))
    made: Any = SimpleNamespace(
        _driven=None, turn=threading.Lock(), verified=trusted, uuid=UUID, _comes_back=False,
        _buses=SimpleNamespace(presence=SimpleNamespace(let_announce=lambda _uuid: None)),
        streams=SimpleNamespace(stop=lambda _bus, session, _address: stopped.append(session)),
    )  # fmt: skip
    for answers in (True, False):
        bus: Any = SimpleNamespace(share=SimpleNamespace(lock=threading.Lock(), taken={UUID: 1}))
        NodeSupervisor._end(made, bus, trusted, 17, answers=answers)
        assert bus.share.taken == {}
    assert (stopped, forgotten, made.verified) == ([trusted, None], [1], None)


@pytest.mark.parametrize("error", [NotAuthenticError("Revoked."), PolicyError("Banned.")])
def test_a_decision_against_a_node_is_kept_as_what_ended_it(
    monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError
) -> None:
    monkeypatch.setattr(standing, "require_measurable", _raising(error))
    made: Any = SimpleNamespace(_station=None, _uuid=UUID, ended=None)
    with pytest.raises(type(error)):
        standing.NodeStanding.require_measurable(made)
    assert made.ended is error
    assert standing.why_not_measured(NONE, UUID) == error.message.removesuffix(".")


def test_what_a_supervisor_holds_is_given_back_however_it_ends() -> None:
    for comes_back in (False, True):
        given: list[str] = []
        share = SimpleNamespace(remove_node=lambda _uuid, given=given: given.append("room"))
        common, needed = (
            SimpleNamespace(drop_node=lambda _uuid, given=given, what=what: given.append(what))
            for what in ("start", "needed")
        )
        made: Any = SimpleNamespace(
            _request=SimpleNamespace(patient=True, requirements=needed, timeout=1.0), _stop=threading.Event(),
            _common_start=common, uuid=UUID, _comes_back=comes_back, done=threading.Event(), ready=threading.Event(),
            _buses=SimpleNamespace(all=lambda share=share: [SimpleNamespace(share=share)]),
            _anew=SimpleNamespace(clear=_raising(ZeroDivisionError())),
        )  # fmt: skip
        with pytest.raises(ZeroDivisionError):
            NodeSupervisor._run(made)
        assert given == ["start", "needed", *([] if comes_back else ["room"])]
        assert made.done.is_set()
        assert made.ready.is_set()


def test_a_broadcast_that_fails_is_no_reason_of_its_own_and_a_patient_caller_sends_none() -> None:
    sent: list[int] = []

    def discover() -> None:
        sent.append(1)
        raise LinkError("The bus is off.")

    bus = SimpleNamespace(discovery=SimpleNamespace(discover=discover))
    for had, ever_ran, patient, asks in (
        (bus, False, False, 1), (None, False, False, 0), (bus, True, False, 0), (bus, False, True, 0)
    ):  # fmt: skip
        sent.clear()
        made: Any = SimpleNamespace(bus=had, ever_ran=ever_ran, _request=SimpleNamespace(patient=patient))
        NodeSupervisor._ask_who_answers(made)
        assert len(sent) == asks


@pytest.mark.parametrize("kept", [True, False])
def test_what_is_read_in_the_background_ends_with_its_session(monkeypatch: pytest.MonkeyPatch, kept: bool) -> None:
    closed: list[int] = []
    monkeypatch.setattr(
        "teds_provision.measure.node_supervisor.BackgroundReread",
        lambda *_, **__: SimpleNamespace(close=lambda: closed.append(1)),
    )
    made: Any = SimpleNamespace(_station=None, _request=SimpleNamespace(by="measure"), _watch=_raising(LOST))
    with pytest.raises(SessionLostError):
        NodeSupervisor._keep(made, NONE, SimpleNamespace(kept=kept), NONE)  # type: ignore[arg-type]
    assert closed == [1] * kept


# -- trigger, start and end --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", OF_A_SESSION)
def test_a_node_that_misses_the_trigger_is_named_and_the_others_start(error: Exception) -> None:
    notes: list[str] = []

    def supervisor(fails: bool) -> Any:
        request = _raising(error) if fails else lambda *_: b""
        return SimpleNamespace(
            uuid=UUID, ever_ran=True, turn=nullcontext(),
            verified=SimpleNamespace(node=SimpleNamespace(request=request)),
            streams=SimpleNamespace(tell_time=_raising(error)),
        )  # fmt: skip

    bad, good = supervisor(True), supervisor(False)
    token: Any = SimpleNamespace(arm=lambda *_: SimpleNamespace(command=lambda: None))
    assert trigger._arm(token, [bad, good], notes.append) == [(good, good.verified)]
    assert trigger._mark(bad, NONE, 0, 1, notes.append) is None
    assert notes == [
        f"Node {UUID.hex()} did not accept the trigger: {error}",
        f"Node {UUID.hex()} did not report when it saw the trigger: {error}",
    ]


def test_a_start_that_is_soon_or_waits_is_in_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("teds_provision.measure.running.common_start.time", SimpleNamespace(monotonic=lambda: 10.0))
    made = CommonStart([UUID, bytes(10)])
    assert made.seconds_until(5) == 0.0
    made._at = 12.5
    assert [made.seconds_until(start) for start in (SOON, WAITS, 5)] == [0.0, 0.0, 2.5]
    made._at = 9.0
    assert made.seconds_until(5) == 0.0


def test_rows_that_cannot_be_made_any_more_keep_no_sink_open() -> None:
    ended: list[str] = []
    supervisor = SimpleNamespace(
        give_room_up=lambda: ended.append("room"),
        stop=lambda: ended.append("stop"),
        join=lambda _seconds: ended.append("join"),
    )
    sinks = [SimpleNamespace(close=lambda name=name: ended.append(name)) for name in ("a", "b")]
    made: Any = SimpleNamespace(
        supervisors=[supervisor], sinks=sinks, _rows=_raising(BadDataError("-")), _look=lambda: ended.append("look")
    )
    Measurement._end(made)
    assert (ended, made._ending) == (["room", "stop", "join", "a", "b", "look"], True)


# -- disks, texts, servers ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("error", [BadDataError("-"), NotFoundError("-"), OSError("-")])
def test_a_profile_that_cannot_be_read_is_none(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    monkeypatch.setattr(matching, "find_profile", _raising(error))
    assert matching._profile("temperature-sensor", Path("/nowhere")) is None


@pytest.mark.parametrize("error", [OverflowError(), OSError(), ValueError()])
def test_a_time_beyond_the_calendar_is_unknown(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    assert json_events.iso(0.0015) == "1970-01-01T00:00:00.001Z"
    monkeypatch.setattr(json_events, "datetime", SimpleNamespace(fromtimestamp=_raising(error)))
    assert json_events.iso(0.0) == "unknown"


def test_a_fact_that_is_nested_too_deep_stays_a_text() -> None:
    deep = "[" * 100_000
    assert _values({"low": "1.5", "kind": "sensor", "unit": "5", "vector": deep}) == {
        "low": 1.5, "kind": "sensor", "unit": "5", "vector": deep,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("path", "error"), [("a\0b", NotFoundError), ("/nowhere/x", NotFoundError), ("/dev/null", BadDataError)]
)
def test_a_file_that_a_brokers_url_names_and_cannot_be_read_is_named(
    path: str, error: type[TedsProvisionError]
) -> None:
    with pytest.raises(error) as refused:
        mqtt._octets("ca", path)
    assert refused.value.message.startswith(f"ca={path} ")


@pytest.mark.parametrize("error", [RuntimeError("in use"), OSError("in use")])
def test_a_port_that_foxglove_cannot_have_is_named(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    foxglove = pytest.importorskip("foxglove")
    monkeypatch.setattr(foxglove, "start_server", _raising(error))
    monkeypatch.setattr(foxglove_server, "_listener", lambda *_: None)
    server = FoxgloveServer("127.0.0.1:9")
    with pytest.raises(LinkError) as refused:
        server.start("bench")
    assert refused.value.message == "No Foxglove server can listen on 127.0.0.1:9: in use."
    assert refused.value.hint == "Choose another port: --foxglove-at 127.0.0.1:PORT"
    assert server.port == 0


def test_a_child_has_no_paths_of_our_python_but_those_of_a_sourced_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("PYTHONPATH", "PYTHONHOME", "ROS_DISTRO"):
        monkeypatch.setenv(name, f"/{name}")
    for sourced, path in ((True, "/PYTHONPATH"), (False, None)):
        found = child.environment(sourced=sourced)
        assert (found.get("PYTHONPATH"), found.get("PYTHONHOME"), found["ROS_DISTRO"]) == (path, None, "/ROS_DISTRO")


@pytest.mark.parametrize("gone", [False, True])
def test_a_child_whose_pipe_is_closed_or_that_ended_meanwhile_is_waited_for(
    monkeypatch: pytest.MonkeyPatch, gone: bool
) -> None:
    waited: list[float | None] = []

    def wait(seconds: float | None = None) -> None:
        waited.append(seconds)
        if seconds is not None:
            raise subprocess.TimeoutExpired("rospy", seconds)

    def kill(_group: int, _signal: int) -> None:
        if gone:
            raise ProcessLookupError

    monkeypatch.setattr(child, "os", SimpleNamespace(killpg=kill))
    process = SimpleNamespace(stdin=SimpleNamespace(close=_raising(BrokenPipeError())), wait=wait, pid=1 << 30)
    made: Any = SimpleNamespace(_child=process)
    child.ChildSink._stop(made, 0.5)
    assert (waited, made._child) == ([0.5, None], None)


# -- what other threads hold, and what is closed -----------------------------------------------------------------------


def test_the_joints_that_another_thread_reads_are_not_changed_under_it(monkeypatch: pytest.MonkeyPatch) -> None:
    joints = {"a": [SimpleNamespace(name="x")], "b": [SimpleNamespace(name="y")]}
    monkeypatch.setattr(live, "joints_of", lambda facts, _topics: joints.get("".join(facts), []))
    before: list[Any] = []
    made: Any = SimpleNamespace(
        _facts={uuid: {0: uuid} for uuid in joints}, _topics=None, _joints=before, _joints_of={}
    )
    TopicSink._find_joints(made, ["a"])
    first = made._joints
    TopicSink._find_joints(made, ["b"])
    assert ([one.name for one in before], [one.name for one in first]) == ([], ["x"])
    assert [one.name for one in made._joints] == ["x", "y"]
    again = made._joints
    TopicSink._find_joints(made, ["a", "b"])
    assert made._joints is again, "nothing has changed"


def test_each_file_of_a_conversion_is_on_the_disk_and_closed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []

    class Writer:
        def __init__(self, path: Path, *_: Any, **__: Any) -> None:
            path.write_text("x")

        finish = close = lambda _self: None

        def add_entry(self, _entry: Any) -> None: ...

    monkeypatch.setattr(converting, "ParquetWriter", Writer)
    recording: Any = SimpleNamespace(station=StationFacts("bench"), facts={})
    before = len(os.listdir("/proc/self/fd"))
    monkeypatch.setattr(os, "fsync", synced.append)
    path = tmp_path / "run.parquet"
    assert converting._as_parquet(path, iter([]), recording, wide=False, units="si") == [path]
    assert (len(synced), len(os.listdir("/proc/self/fd"))) == (1, before)
    monkeypatch.setattr(os, "fsync", _raising(OSError("broken")))
    with pytest.raises(OSError, match="broken"):
        converting._as_parquet(path, iter([]), recording, wide=False, units="si")
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_rate_is_rounded_down_to_1_2_5_of_a_decade_and_stays_if_it_is_one() -> None:
    steps = [0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 1000, 5e6]
    assert [rates.rounded_down(rate) for rate in steps] == steps
    assert [rates.rounded_down(rate) for rate in (0.05, 0.19, 0.99, 4.9, 99.0, 7e6)] == [0.1, 0.1, 0.5, 2, 50, 5e6]
