"""A look-out on a link whose nodes do not announce themselves: when it asks, what it reports, how it fails."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import LinkError, NoNodeError
from teds_provision.links import discovery
from teds_provision.links.discovery import PolledDiscovery


def _look_out(*rounds: Any) -> tuple[Any, list[Any], list[Any]]:
    """Return a look-out without its thread; each round is a list of contacts or what it raises."""
    asked, seen, left = list[Any](), list[Any](), list(rounds)

    def find_all(**how: Any) -> list[Any]:
        asked.append({name: value for name, value in how.items() if name != "notice"})
        step = left.pop(0)
        if isinstance(step, Exception):
            raise step
        return list(step)

    made: Any = PolledDiscovery.__new__(PolledDiscovery)
    made._port = SimpleNamespace(find_all=find_all)
    made._presence = SimpleNamespace(add_sighting=seen.append, missing=lambda: True)
    made._stop, made._asked, made._turn = threading.Event(), threading.Event(), threading.Condition()
    made._begun = made._finished = 0
    made._poll, made.failure = None, None
    return made, asked, seen


def test_each_node_that_answers_is_reported_with_its_line_and_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(discovery, "time", SimpleNamespace(monotonic=lambda: 42.0))
    found = [SimpleNamespace(identity=f"identity {n}", line=f"line {n}") for n in (1, 2)]
    made, asked, seen = _look_out(found)
    made._asked.set()
    made._look()
    assert asked == [{"seconds": 2 * discovery.LEAST}]
    assert [(each.identity, each.address, each.at) for each in seen] == [
        ("identity 1", "line 1", 42.0),
        ("identity 2", "line 2", 42.0),
    ]
    assert (made._begun, made._finished, made._asked.is_set(), made.failure) == (1, 1, False, None)


def test_a_round_without_a_node_is_no_failure_and_a_good_round_ends_one() -> None:
    gone = LinkError("gone")
    made, _, _ = _look_out(gone, NoNodeError("none"), gone, [])
    failures = []
    for _ in range(4):
        made._look()
        failures.append(made.failure)
    assert failures == [gone, None, gone, None]
    assert made._finished == 4


def test_after_a_round_the_next_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """While a node is missing; the first pause begins with the end of the round."""
    now, looks, waits = [1000.0], list[float](), list[float]()
    made, _, _ = _look_out()

    def look() -> None:
        looks.append(now[0])
        assert len(looks) < 20, "it asks without a pause"
        now[0] += 3.0

    def wait(seconds: float) -> None:
        waits.append(seconds)
        now[0] += seconds
        if now[0] > 1000.0 + 3.0 + discovery.LEAST + 1.0:
            made._stop.set()

    monkeypatch.setattr(discovery, "time", SimpleNamespace(monotonic=lambda: now[0]))
    made._look, made._asked = look, SimpleNamespace(is_set=lambda: False, wait=wait)
    made._run()
    assert looks[0] == 1000.0
    assert [round(later - looks[0] - 3.0, 3) >= discovery.LEAST for later in looks[1:]] == [True] * len(looks[1:])
    assert set(waits) == {discovery.LOOK}


def test_who_asks_for_a_round_gets_its_failure() -> None:
    made, _, _ = _look_out()
    made._stop.set()
    made.discover(0.0)
    made.failure = LinkError("gone")
    with pytest.raises(LinkError, match="gone"):
        made.discover(0.0)
    assert made._asked.is_set()
