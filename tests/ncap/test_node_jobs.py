"""Requests that wait for one tap, and what a node is after a measurement gave it back."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NodeBusyError
from teds_provision.ncap.nodes.node_jobs import NodeJobs, NodeLocks

NODE = "ab" * 10


def test_of_requests_that_wait_for_one_tap_the_first_is_served_first() -> None:
    none: Any = None
    tapped: Any = SimpleNamespace(tapped=True, uuid=bytes.fromhex(NODE))
    jobs, done = NodeJobs(none, none, none), list[str]()
    for uuid, name in ((NODE, "first"), (None, "whichever comes next"), ("cd" * 10, "another's"), (NODE, "last")):
        jobs.wait_for(uuid, "provision", lambda _node, name=name: done.append(name), 60.0)
    assert [jobs.serve(tapped) for _ in range(4)] == [True, True, True, False]
    assert done == ["first", "whichever comes next", "last"]


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
