"""One more node costs the same work whether 20, 200 or 2,000 are there: what joins must not look at all the others."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.links.discovery import Sighting
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.presence import Presence
from teds_provision.measure.running.measurement import Measurement
from teds_provision.measure.sinks.mqtt import MqttSink
from teds_provision.measure.sinks.names import Topics
from teds_provision.protocol.announce import Announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState
from tests.measure.sinks.parts import ANGLE
from tests.work import steps_of

SIZES = (20, 200, 2000)
SPREAD = 1.2  # a dictionary that grows, a set that is hashed


def uuid_of(number: int) -> bytes:
    return number.to_bytes(10, "big")


def facts_of(number: int, **more: Any) -> ChannelFacts:
    uuid = uuid_of(number).hex()
    return replace(ANGLE, uuid=uuid, node=f"node {number}", **more)


def nodes(size: int) -> dict[str, str]:
    return {uuid_of(number).hex(): f"node {number}" for number in range(size + 1)}


def flat(one_more: Callable[[int], Callable[[], object]]) -> None:
    """Hold that the work for one more node is the same beside few and many; ``one_more`` prepares so many."""
    steps = [steps_of(one_more(size)) for size in SIZES]
    assert min(steps) > 0
    assert max(steps) <= SPREAD * min(steps), steps


def test_an_announce() -> None:
    def beside(size: int) -> Callable[[], object]:
        presence, noticed = Presence(), list[bytes]()
        port: Any = SimpleNamespace(place="can:x")
        for number in range(size):
            uuid = uuid_of(number)
            sighting = Sighting(
                Identity(uuid, NodeState.PROVISIONED, 1, 1, 2048, number), number, port, time.monotonic()
            )
            presence.on_announce(sighting, lambda uuid=uuid: noticed.append(uuid))  # type: ignore[misc]

        def announce() -> None:
            presence.announced("can:x", Announce(7, 2, uuid_crc(uuid_of(9))))
            assert sorted(noticed) == [uuid_of(7), uuid_of(9)], "by its address, and by its digest"

        return announce

    flat(beside)


def described(size: int, names: dict[tuple[str, int], str]) -> Measurement:
    """Return an open measurement with so many nodes, as it is while it runs."""
    chosen = SimpleNamespace(names_of=lambda uuid: {n: name for (of, n), name in names.items() if of == uuid.hex()})
    station: Any = SimpleNamespace(measurements=chosen)
    request: Any = SimpleNamespace(newcomers=True)
    sink: Any = SimpleNamespace(wants_rows=True, describe=lambda _facts: None)
    whole: Any = SimpleNamespace(facts=lambda _facts: None)
    made = Measurement(station, SimpleNamespace(), (), request, [sink], StationFacts("bench", names=names), whole)  # type: ignore[arg-type]
    made._lock, made._known, made._grids, made._chosen = threading.Lock(), {}, {}, {}
    for (uuid, number), name in names.items():
        made._chosen.setdefault(uuid, {})[number] = name
    for number in range(size):
        made._describe([facts_of(number)])
    return made


def test_the_facts_of_a_node_that_joins_a_measurement() -> None:
    def beside(size: int) -> Callable[[], object]:
        measurement = described(size, {})
        return lambda: measurement._describe([facts_of(size)])

    flat(beside)


def test_a_name_that_was_chosen_meanwhile_is_one_of_the_station(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {(uuid_of(1).hex(), 0): "arm"}
    measurement = described(3, names)
    assert measurement.facts.names == names
    del names[uuid_of(1).hex(), 0]
    names[uuid_of(2).hex(), 1] = "arm/angle"
    stated: list[ChannelFacts] = []
    monkeypatch.setattr(measurement.sinks[0], "describe", stated.extend)
    for number in (1, 2):
        measurement._describe([facts_of(number)])
    assert measurement.facts.names == names
    assert [facts.chosen for facts in stated] == [(), ((1, "arm/angle"),)]


def test_the_topics_of_a_node_that_joins_a_broker() -> None:
    def beside(size: int) -> Callable[[], object]:
        sink = MqttSink("mqtt://localhost")
        sink._topics = Topics(StationFacts("bench", nodes=nodes(size), names={(uuid_of(3).hex(), 0): "arm"}))
        for number in range(size):
            sink._learn((facts_of(number, chosen=((0, "arm"),) if number == 3 else ()),))
        return lambda: sink._learn((facts_of(size, chosen=()),))

    flat(beside)


def test_a_node_that_gets_another_name_on_a_broker_is_announced_again() -> None:
    sink = MqttSink("mqtt://localhost")
    sink._topics = Topics(StationFacts("bench", nodes=nodes(2)))
    for number in range(3):
        sink._learn((facts_of(number, chosen=()),))
    sink._owed_entities.clear()
    sink._learn((facts_of(1, chosen=((0, "arm"),)),))
    assert (sink._left, list(sink._owed_entities)) == (["node_1"], [facts_of(1).key])
    sink._learn((facts_of(1, chosen=()),))
    assert sink._left == ["node_1", "arm"]


def test_a_stranger_that_gives_its_name_up_is_announced_again() -> None:
    """Its own name is that of another node that comes later: the names of all may change then."""
    sink = MqttSink("mqtt://localhost")
    sink._topics = Topics(StationFacts("bench"))
    sink._learn((facts_of(1),))
    sink._learn((replace(facts_of(2), node="node 1"),))
    assert sink._left == ["node_1"]
    assert {uuid for uuid, _ in sink._owed_entities} == {uuid_of(1).hex(), uuid_of(2).hex()}
