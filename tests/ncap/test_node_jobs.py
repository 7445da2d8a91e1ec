"""Requests that wait for one tap, and what a node is after a measurement gave it back."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import FrozenError, InternalError, NodeBusyError, NodeSilentError, NoNodeError, PolicyError
from teds_provision.ncap.nodes import node_jobs
from teds_provision.ncap.nodes.node_jobs import NodeJob, NodeJobs, NodeLocks
from teds_provision.provisioning.conversation import SessionLostError
from tests.pace import PATIENCE, until

NODE = "ab" * 10


def test_of_requests_that_wait_for_one_tap_the_first_is_served_first() -> None:
    none: Any = None
    tapped: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(NODE))
    jobs, done = NodeJobs(none, none, none), list[str]()
    for uuid, name in ((NODE, "first"), (None, "whichever comes next"), ("cd" * 10, "another's"), (NODE, "last")):
        jobs.wait_for(uuid, "provision", lambda _node, name=name: done.append(name), 60.0)
    assert [jobs.serve(tapped) for _ in range(4)] == [True, True, True, False]
    assert done == ["first", "whichever comes next", "last"]


def test_a_request_that_waits_for_a_tap_is_not_served_by_a_node_on_a_bus() -> None:
    none: Any = None
    node: Any = SimpleNamespace(tapped=False, uuid=bytes.fromhex(NODE))
    jobs, done = NodeJobs(none, none, none), list[str]()
    for uuid in (NODE, None):
        jobs.wait_for(uuid, "provision", lambda _node: done.append("served"), 60.0)
    assert (jobs.serve(node), done) == (False, [])
    node.tapped = True
    assert (jobs.serve(node), done) == (True, ["served"])


@pytest.mark.parametrize(
    ("present", "place", "many", "found"),
    [(True, "can:x", True, True), (False, "can:x", True, False), (True, "nfc:x", False, False),
     (True, "can:gone", True, False), (True, "", True, False)],
)  # fmt: skip
def test_a_node_is_on_a_bus_if_it_is_there_now_and_the_link_is_open_and_has_many(
    present: bool, place: str, many: bool, found: bool
) -> None:
    none: Any = None
    directory: Any = SimpleNamespace(seen=lambda _uuid: SimpleNamespace(present=present, place=place))
    port: Any = SimpleNamespace(capabilities=SimpleNamespace(many=many))
    ports = {"can:x": port, "nfc:x": port, "": port}
    jobs = NodeJobs(directory, none, ports.get)
    assert (jobs.bus_of(NODE), jobs.on_a_bus(NODE)) == ((port, True) if found else (None, False))


def test_a_tap_after_the_time_of_a_request_is_not_for_it_and_who_waited_gives_it_up() -> None:
    """A tap between the two took the request away unserved: its waiter waited for ever, and no other could begin."""
    none: Any = None
    tapped: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(NODE))
    jobs, done = NodeJobs(none, none, none), list[str]()
    late = jobs.wait_for(NODE, "provision", lambda _node: done.append("late"), -1.0)
    jobs.wait_for(NODE, "provision", lambda _node: done.append("in time"), 60.0)
    assert [jobs.serve(tapped) for _ in range(2)] == [True, False]
    assert done == ["in time"]
    assert (jobs.cancel(late), jobs.cancel(late)) == (True, False)


class TappedAtTheEnd(NodeJobs):
    """Whose node is tapped when the time for that is nearly over; the work goes on until it is waited for."""

    waited_for = threading.Event()

    def wait_for(self, *request: Any) -> NodeJob[Any]:
        """Let the node come, and its work begin, before the caller waits."""
        job = super().wait_for(*request)
        job.done.wait = self._wait  # type: ignore[method-assign]
        tapped: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(NODE))
        self.reader = threading.Thread(target=self.serve, args=(tapped,))
        self.reader.start()
        until(lambda: job not in self._waiting)
        return job

    def _wait(self, timeout: float | None = None) -> bool:
        """Wait for the end; a wait with an end is over at once."""
        if timeout is None:
            self.waited_for.set()
            self.reader.join()
        return timeout is None


def test_work_that_began_within_the_time_for_a_tap_is_waited_for() -> None:
    """The request was told that no node came, while its datasheet was being written."""
    none: Any = None
    absent: Any = SimpleNamespace(seen=lambda _uuid: SimpleNamespace(present=False, place=""))
    jobs = TappedAtTheEnd(absent, none, none)

    def work(_node: Any) -> str:
        jobs.waited_for.wait(PATIENCE)
        return "written"

    try:
        assert jobs.with_node(NODE, "a datasheet is written", work, wait=PATIENCE) == "written"
    finally:
        jobs.waited_for.set()


def test_a_node_that_is_not_tapped_in_time_is_reported() -> None:
    none: Any = None
    absent: Any = SimpleNamespace(seen=lambda _uuid: SimpleNamespace(present=False, place=""))
    jobs = NodeJobs(absent, none, none)
    with pytest.raises(NoNodeError, match="was not placed on a reader"):
        jobs.with_node(NODE, "write", lambda _node: None, wait=0.0)
    assert not jobs._waiting


@pytest.mark.parametrize("on_a_bus", [True, False])
def test_who_asked_hears_why_the_session_was_lost_or_what_the_work_refused(
    on_a_bus: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    none: Any = None
    node: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(NODE))
    found: Any = SimpleNamespace(find=lambda _uuid: node)
    directory: Any = SimpleNamespace(seen=lambda _uuid: SimpleNamespace(present=on_a_bus, place="can:x"))
    many: Any = SimpleNamespace(capabilities=SimpleNamespace(many=True))
    jobs = NodeJobs(directory, NodeLocks(), lambda _place: many if on_a_bus else none)
    monkeypatch.setattr(jobs, "_find", lambda _port, _uuid: found)
    monkeypatch.setattr(node_jobs, "Conversation", lambda _contact, notice: nullcontext(node))
    cause = NodeSilentError("The node does not answer.")
    for raised, heard in ((SessionLostError(cause), cause), (refusal := PolicyError("No."), refusal)):

        def work(_node: Any, raised: Exception = raised) -> None:
            raise raised

        wait_for = jobs.wait_for

        def tapped_at_once(*request: Any, wait_for: Any = wait_for) -> NodeJob[Any]:
            assert not on_a_bus, "on a bus nobody is waited for"
            job = wait_for(*request)
            jobs.serve(node)
            return cast("NodeJob[Any]", job)

        monkeypatch.setattr(jobs, "wait_for", tapped_at_once)
        with pytest.raises(type(heard)) as refused:
            jobs.with_node(NODE, "write", work, wait=PATIENCE)
        assert refused.value is heard
        monkeypatch.setattr(jobs, "wait_for", wait_for)
    assert jobs.with_node(NODE, "write", lambda given: given is node, wait=PATIENCE) if on_a_bus else True


def test_a_bug_of_the_work_is_an_error_for_who_asked_and_shown_in_the_log() -> None:
    none: Any = None
    tapped: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(NODE))
    jobs = NodeJobs(none, none, none)
    job = jobs.wait_for(NODE, "write", lambda _node: 1 // 0, 60.0)
    with pytest.raises(ZeroDivisionError):
        jobs.serve(tapped)
    assert job.done.is_set()
    assert isinstance(job.error, InternalError)
    assert job.error.message == "Unexpected ZeroDivisionError."


def test_a_node_that_a_measurement_gave_back_is_frozen_no_more() -> None:
    locks, free = NodeLocks(), list[str]()
    locks.given = free.append
    locks.acquire(NODE, "measurement run", frozen=True)
    locks.release(NODE)
    assert free == [], "its measurement knows"
    locks.acquire(NODE, "it is looked at")
    with pytest.raises(NodeBusyError, match="it is looked at"):
        locks.acquire(NODE, "write", wait=0.0)
    locks.release(NODE)
    assert free == [NODE]


@pytest.mark.parametrize("frozen", [True, False])
def test_a_node_that_is_measured_is_refused_at_once_and_another_is_waited_for(frozen: bool) -> None:
    locks = NodeLocks()
    locks.acquire(NODE, "measurement run", frozen=True)
    with pytest.raises(FrozenError) as no:
        locks.acquire(NODE, "write", wait=2.0, frozen=frozen)
    assert no.value.message == f"Node {NODE} is being measured (measurement run) and cannot be changed now."
    assert no.value.hint == "End the measurement first."
    locks.acquire("cd" * 10, "it is looked at")
    with pytest.raises(NodeBusyError) as busy:
        locks.acquire("cd" * 10, "write", wait=0.0, frozen=frozen)
    assert busy.value.message == f"Node {'cd' * 10} is busy: it is looked at."
    assert busy.value.hint == "Try again when that is done."
    assert (locks.holder(NODE), locks.holder("cd" * 10)) == ("measurement run", "it is looked at")
