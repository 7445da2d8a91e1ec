"""For how long the station listens for nodes that advertise, with a clock and an adapter of the test's own."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace

import pytest

from teds_provision.links.ble import port as ble_port
from teds_provision.links.ble.port import BlePort
from teds_provision.links.ports import Contact

ONE, TWO = "C1:D8:57:00:01:01", "C1:D8:57:00:01:02"


def listened(
    monkeypatch: pytest.MonkeyPatch,
    heard: dict[str, float],
    *,
    found: tuple[str, ...] = (),
    asked: dict[str, float] | None = None,
    enough: float = 0.0,
    seconds: float = 60.0,
) -> tuple[list[str], float]:
    """Return what was new, and after how many seconds; ``heard``: when each begins to advertise."""
    now, most = [100.0], [0.0]

    def scan(longest: float, over: Callable[[dict[str, float]], bool]) -> None:
        most[0] = longest
        for tenth in range(round(longest * 10) + 1):
            now[0] = 100.0 + tenth / 10
            if over({address: now[0] for address, at in heard.items() if 100.0 + at <= now[0]}):
                return

    port = BlePort.__new__(BlePort)
    port._loop = SimpleNamespace(run=lambda done: done)  # type: ignore[assignment]
    port._adapter = SimpleNamespace(scan=scan)  # type: ignore[assignment]
    monkeypatch.setattr(ble_port, "time", SimpleNamespace(monotonic=lambda: now[0]))
    contacts: dict[str, Contact] = dict.fromkeys(found)  # type: ignore[arg-type]
    new = port._all_new(seconds, asked or {}, contacts, 100.0 + enough)
    return new, round(now[0] - 100.0, 1)


@pytest.mark.parametrize(
    ("heard", "enough", "new", "seconds"),
    [
        ({ONE: 0.0}, 0.0, [ONE], 1.5),
        ({ONE: 0.0}, 2.5, [ONE], 2.5),
        ({ONE: 0.0}, 20.0, [ONE], 3.0),
        ({TWO: 0.2, ONE: 1.5}, 0.0, [ONE, TWO], 3.0),
        ({ONE: 0.2, TWO: 5.0}, 20.0, [ONE], 3.0),
        ({ONE: 2.5}, 20.0, [ONE], 4.0),
        ({}, 0.0, [], 8.0),
        ({}, 20.0, [], 20.0),
    ],
    ids=[
        "silence after one that came at once",
        "as long as was wanted",
        "three seconds at most once somebody is heard",
        "silence begins with the last one",
        "whoever comes later is for the next time",
        "silence after one that came late",
        "eight seconds for nobody",
        "as long as was wanted for nobody",
    ],
)
def test_it_listens_until_no_new_node_came_for_a_while(
    heard: dict[str, float], enough: float, new: list[str], seconds: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert listened(monkeypatch, heard, enough=enough) == (new, seconds)


def test_once_all_were_found_it_listens_until_enough_time_has_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    assert listened(monkeypatch, {ONE: 0.0}, found=(ONE,), enough=5.0) == ([], 5.0)


def test_a_node_that_did_not_identify_itself_is_new_again_five_seconds_later(monkeypatch: pytest.MonkeyPatch) -> None:
    assert listened(monkeypatch, {ONE: 0.0}, asked={ONE: 98.0}) == ([ONE], 4.5)


def test_it_listens_no_longer_than_there_is_time(monkeypatch: pytest.MonkeyPatch) -> None:
    assert listened(monkeypatch, {}, seconds=2.0) == ([], 2.0)
