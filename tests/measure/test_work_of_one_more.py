"""One more node costs the same work whether 20, 200 or 2,000 are there: what joins must not look at all the others."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, Literal

import pytest

from teds_provision.links.discovery import Sighting
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.presence import Presence
from teds_provision.measure.running.measurement import Measurement
from teds_provision.measure.sinks.mqtt import MqttSink
from teds_provision.measure.sinks.names import Topics
from teds_provision.protocol.announce import Announce, uuid_crc
from teds_provision.protocol.messages.identity import Identity, NodeState
from teds_provision.teds.units import parse_units
from tests.measure.sinks.parts import ANGLE, block
from tests.measure.sinks.test_live import Carrier
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


def test_an_announce_while_nodes_are_waited_for() -> None:
    def beside(size: int) -> Callable[[], object]:
        presence = Presence()
        for number in range(size):
            stack.enter_context(presence._waited_for(uuid_of(number)))

        def announce() -> None:
            assert presence.is_awaited(Announce(9, 2, uuid_crc(uuid_of(size - 1))))
            assert not presence.is_awaited(Announce(9, 2, uuid_crc(uuid_of(size))))

        return announce

    with ExitStack() as stack:
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


def test_a_stranger_touches_those_alone_that_it_renames() -> None:
    """What is kept of all other nodes, topics and descriptions, would be made anew for each of them."""
    topics = Topics(StationFacts("bench"))
    for number in range(4):
        topics.learn((facts_of(number),))
    number = ANGLE.number
    before = [topics.channel(uuid_of(n).hex(), number) for n in range(4)]
    assert topics.learn((facts_of(9),)) == {uuid_of(9).hex()}
    assert topics.learn((replace(facts_of(5), node="node 1"),)) == {uuid_of(5).hex(), uuid_of(1).hex()}
    after = [topics.channel(uuid_of(n).hex(), number) for n in range(4)]
    assert before[1] == "/bench/node_1/" + after[0].rpartition("/")[2]
    assert after == [before[0], before[1].replace("node_1", "node_1_00000000000000000001"), *before[2:]]


@pytest.mark.parametrize("kinds", [("sensor",), ("actuator", "sensor")], ids=["a sensor", "a joint"])
def test_the_topics_of_a_node_that_joins_ros(kinds: tuple[Literal["actuator", "sensor"], ...]) -> None:
    def channels(number: int) -> tuple[ChannelFacts, ...]:
        radians = parse_units("rad")
        return tuple(replace(facts_of(number), number=1 + n, kind=kind, units=radians) for n, kind in enumerate(kinds))

    def beside(size: int) -> Callable[[], object]:
        sink = Carrier([])
        sink._prepare((), StationFacts("bench", nodes=nodes(size), each_node=True))
        for number in range(size):
            sink._process_item(channels(number))
        sink._process_item(block([[1]], uuid=uuid_of(3).hex()))

        def join() -> None:
            sink._process_item(channels(size))
            assert f"/bench/node_{size}/teds" in sink.words
            assert list(sink._scalars) == [uuid_of(3).hex()], "what another node's topics are is not asked anew"
            assert (len(sink._joints) == size + 1) is (len(kinds) > 1)

        return join

    flat(beside)


def test_a_joint_that_gets_another_name_is_found_under_it_alone() -> None:
    def facts(number: int, *chosen: tuple[int, str]) -> ChannelFacts:
        return facts_of(number, kind="actuator", units=parse_units("rad"), chosen=chosen)

    sink = Carrier([])
    sink._prepare((facts(0), facts(1), facts(2)), StationFacts("bench", nodes=nodes(2), each_node=True))
    sink._process_item((facts(1, (0, "arm")),))
    assert [joint.name for joint in sink._joints] == ["arm", "node_0", "node_2"]
    sink._process_item((facts(1, (0, "leg")), facts(2, (0, "arm"))))
    assert [(joint.name, joint.uuid) for joint in sink._joints] == [
        ("arm", uuid_of(2).hex()), ("leg", uuid_of(1).hex()), ("node_0", uuid_of(0).hex()),
    ]  # fmt: skip
