"""The topics of channels as the API names them: unique, frozen while they are published, made anew after a change."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import FrozenError, NotFoundError, UsageError
from teds_provision.measure.blocks import StationFacts
from teds_provision.ncap import names
from teds_provision.ncap.names import Names

ARM, HAND = "ab" * 10, "cd" * 10


class Bench:
    """Two nodes of a station without a store: ``called`` and ``channels`` are what they are called."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.called = {ARM: "arm", HAND: "hand"}
        self.chosen: dict[tuple[bytes, int], str] = {}
        self.measured, self.by_command, self.made = set[str](), set[bytes](), 0
        self.events: list[str] = []
        self.published: StationFacts | None = None
        self.directory: Any = SimpleNamespace(
            changes=0,
            touch=lambda: None,
            uuids=lambda: list(self.called),
            published_name=lambda uuid: (self.called[uuid], False),
            channel_names=lambda _uuid: [(1, "angle"), (2, "force")],
        )
        measurements = SimpleNamespace(names=self.chosen, is_running=self.by_command.__contains__, rename=self.rename)
        station: Any = SimpleNamespace(measurements=measurements, durable=self.durable, audit=lambda *_w, **_f: None)
        live: Any = SimpleNamespace(event=lambda kind, **_facts: self.events.append(kind))
        monkeypatch.setattr(names, "station_facts", lambda _station: self.facts())
        self.names = Names(station, self.directory, live, self.measured.__contains__, lambda _uuid: self.published)

    def facts(self) -> StationFacts:
        self.made += 1
        chosen = {(uuid.hex(), number): name for (uuid, number), name in self.chosen.items()}
        return StationFacts("bench", names=chosen, nodes=dict(self.called))

    def rename(self, uuid: bytes, channel: int, name: str | None) -> None:
        if name is None:
            self.chosen.pop((uuid, channel), None)
        else:
            self.chosen[uuid, channel] = name

    @contextmanager
    def durable(self, _what: str) -> Iterator[None]:
        yield


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return Bench(monkeypatch)


def test_a_channel_may_be_renamed_unless_its_name_is_anothers_or_none(bench: Bench) -> None:
    bench.names.rename(ARM, 1, "/left/angle/")
    assert bench.names.topic(ARM, 1) == "/left/angle"
    bench.names.rename(ARM, 1, "left/angle")
    assert bench.events == ["names"] * 2, "its own name is no other channel's"
    for number, name, error in ((1, "1/x", UsageError), (7, "left/x", NotFoundError), (2, "left/angle", UsageError)):
        with pytest.raises(error):
            bench.names.rename(ARM, number, name)
    with pytest.raises(UsageError):
        bench.names.rename(HAND, 1, "bench/arm/force")
    with pytest.raises(UsageError):
        bench.names.rename(HAND, 0, "arm")
    bench.names.rename(ARM, 1, None)
    bench.names.rename(ARM, 7, None)
    assert bench.names.topic(ARM, 1) == "/bench/arm/angle"
    rows = {(row["uuid"], row["channel"]): (row["name"], row["topic"]) for row in bench.names.all()}
    assert rows[ARM, 0] == (None, "arm")
    assert rows[HAND, 2] == (None, "/bench/hand/force")


@pytest.mark.parametrize("by", ["this service", "a command"])
def test_no_name_of_a_node_changes_while_it_is_measured_whoever_measures_it(bench: Bench, by: str) -> None:
    """A recording and a subscriber would hold two names of one channel."""
    if by == "a command":
        bench.by_command.add(bytes.fromhex(ARM))
    else:
        bench.measured.add(ARM)
    for name in ("left/angle", None):
        with pytest.raises(FrozenError, match="is being measured"):
            bench.names.rename(ARM, 1, name)
    bench.names.rename(HAND, 1, "left/angle")
    assert bench.chosen == {(bytes.fromhex(HAND), 1): "left/angle"}


def test_names_are_made_anew_after_a_change_and_not_for_each_question(bench: Bench) -> None:
    for _ in range(3):
        assert bench.names.topic(ARM, 1) == "/bench/arm/angle"
    assert bench.made == 1
    bench.called[ARM] = "boom"
    bench.directory.changes += 1
    for _ in range(3):
        assert bench.names.topic(ARM, 1) == "/bench/boom/angle"
    assert bench.made == 2
    bench.names.forget()
    bench.names.topic(ARM, 1)
    assert bench.made == 3


def test_a_node_is_named_as_its_running_measurement_publishes_it(bench: Bench) -> None:
    """A namesake that came since changes the names of the next measurement alone."""
    bench.names.topic(ARM, 1)
    bench.published = StationFacts("bench", names={(ARM, 1): "before/angle"}, nodes={ARM: "arm"})
    assert bench.names.topic(ARM, 1) == "/before/angle"
    made = bench.names._of_running
    bench.names.topic(ARM, 2)
    assert bench.names._of_running is made, "learned once"
    bench.directory.changes += 1
    bench.names.topic(ARM, 1)
    assert bench.names._of_running is not made
    bench.published = None
    assert bench.names.topic(ARM, 1) == "/bench/arm/angle"
