"""Which nodes an expression means (`ncap run --measure EXPR`), and what joins under which names."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NoRoomError, NotFoundError, UsageError
from teds_provision.links.can.airtime import CanAirtime
from teds_provision.measure import matching
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.matching import NodeLoad, NodeMatch, load_of
from teds_provision.measure.planning import BusShare, BusTime, plan_node
from teds_provision.measure.request import MeasurementRequest
from teds_provision.measure.sinks.names import Topics
from teds_provision.teds.channel import Channel, ChannelKind, SampleForm, Timing


def test_an_expression_is_terms_that_must_all_hold() -> None:
    match = NodeMatch.parse("type:angle-sensor, name:arm-*,group:left,right, angle >= 360 deg, rate >= 1 kHz")
    assert (match.types, match.names, match.groups) == (("angle-sensor",), ("arm-*",), ("left", "right"))
    assert match.fits is not None
    assert [term.text for term in match.fits.terms] == ["angle >= 360 deg", "rate >= 1 kHz"]
    assert NodeMatch.parse("all") == NodeMatch("all")


@pytest.mark.parametrize(
    "text", ["", "all,arm", "kind:x", "type:", "arm,,left", "angle >= much", "angle > 1 deg,mass < 1 kg"]
)
def test_what_says_no_nodes_is_refused_with_its_term(text: str) -> None:
    with pytest.raises(UsageError) as refused:
        NodeMatch.parse(text)
    assert repr(text) in refused.value.message


def test_a_name_that_was_chosen_while_a_node_was_away_is_its_own_alone() -> None:
    """A node that joins a running measurement has its new topic, and nobody else's changes."""
    topics = Topics(StationFacts("bench", nodes={"aa" * 10: "arm", "bb" * 10: "leg"}))
    topics.learn([ChannelFacts("aa" * 10, "arm", 1, "angle"), ChannelFacts("bb" * 10, "leg", 1, "angle")])
    assert topics.channel("bb" * 10, 1) == "/bench/leg/angle"
    topics.learn([ChannelFacts("aa" * 10, "arm", 1, "angle", chosen=((1, "robot/elbow"),))])
    assert (topics.channel("aa" * 10, 1), topics.channel("bb" * 10, 1)) == ("/robot/elbow", "/bench/leg/angle")
    topics.learn([ChannelFacts("aa" * 10, "arm", 1, "angle", chosen=())])
    assert topics.channel("aa" * 10, 1) == "/bench/arm/angle"


def test_a_node_s_array_is_no_channel_s_topic() -> None:
    topics = Topics(StationFacts("bench", nodes={"aa" * 10: "arm"}))
    topics.learn([ChannelFacts("aa" * 10, "arm", 1, "array")])
    assert topics.channel("aa" * 10, 1) != topics.of_node("aa" * 10, "array")


def test_those_that_come_together_share_and_those_that_run_keep_what_they_have() -> None:
    """What a newcomer wants is known from its datasheet, so nobody waits for it to say so."""
    share = BusShare(BusTime(CanAirtime()))
    first, second, third = (bytes([item]) * 10 for item in (1, 2, 3))
    share.expect([first, second], 0.5)
    assert share.for_node(first, sharing=True).taken == pytest.approx(0.3), "half of the room is the other one's"
    share.taken[first] = share.taken[second] = 0.3
    share.expect([third], 0.1)
    assert share.room == 0.0
    assert share.for_node(third, sharing=True).taken == pytest.approx(0.6)
    share.drop_node(second)
    del share.taken[second]
    assert share.room == pytest.approx(0.3)
    assert share.nodes == 2


def test_a_node_costs_the_topics_its_values_and_two_messages_for_each_row() -> None:
    assert NodeLoad(0.1, channels=3, rate=50.0).messages(10.0, rows=True) == 3 * 10 + 2 * 50
    assert NodeLoad(0.1, channels=1, rate=5.0).messages(10.0, rows=True) == 5 + 10
    assert NodeLoad(0.1, channels=3, rate=50.0).messages(10.0, rows=False) == 3 * 10, "MQTT carries no rows"
    assert issubclass(NoRoomError, Exception)
    assert NoRoomError("x").exit_code == 6


def test_the_load_of_a_node_is_that_of_its_sensors_at_the_fastest_rate(monkeypatch: pytest.MonkeyPatch) -> None:
    form = SampleForm(0, 2, 16)
    every = [
        Channel(1, kind=ChannelKind.SENSOR, sample=form, timing=Timing(period=0.01)),
        Channel(2, kind=ChannelKind.SENSOR, sample=form, timing=Timing(period=0.1)),
        Channel(3, kind=ChannelKind.ACTUATOR, sample=form, timing=Timing(period=0.001)),
    ]
    monkeypatch.setattr(matching, "Sheet", SimpleNamespace(from_image=lambda _image: SimpleNamespace(channels=every)))
    stored: dict[bytes, Any] = {b"known": object()}
    station: Any = SimpleNamespace(datasheets=SimpleNamespace(datasheet=stored.get))
    time = BusTime(CanAirtime())
    load = load_of(station, b"known", MeasurementRequest(), time)
    assert (load.channels, load.rate) == (2, 100.0)
    assert load.bus == pytest.approx(plan_node(every[:2], time).load)
    slower = load_of(station, b"known", MeasurementRequest(rate=20.0), time)
    assert slower.rate == 20.0, "and the slow one at its own"
    assert load_of(station, b"unknown", MeasurementRequest(), time) == NodeLoad()
    every.clear()
    assert load_of(station, b"known", MeasurementRequest(), time) == NodeLoad(), "its session will show it"


def test_of_the_known_nodes_those_are_meant_whose_key_is_held_here(monkeypatch: pytest.MonkeyPatch) -> None:
    records = [SimpleNamespace(uuid=bytes([number]) * 10, name=name, profile="") for number, name in enumerate("abc")]
    held = {records[0].uuid, records[2].uuid}
    station: Any = SimpleNamespace(
        nodes=SimpleNamespace(all=lambda: records, get={record.uuid: record for record in records}.get),
        keys=SimpleNamespace(held=held.__contains__),
    )
    assert matching.known_nodes(station, "all") == [records[0].uuid, records[2].uuid]
    assert matching.known_nodes(station, "name:[ab]") == [records[0].uuid]
    with pytest.raises(NotFoundError, match="No node whose key this station holds matches 'name:b'"):
        matching.known_nodes(station, "name:b")


def test_a_type_that_is_near_is_one_that_can_be_built(monkeypatch: pytest.MonkeyPatch) -> None:
    entries = [
        SimpleNamespace(name="gripper", profile=SimpleNamespace(abstract=False)),
        SimpleNamespace(name="gripper-base", profile=SimpleNamespace(abstract=True)),
        SimpleNamespace(name="griper", profile=None),
    ]
    monkeypatch.setattr(matching, "list_profiles", lambda _folders: entries)
    monkeypatch.setattr(matching, "default_folders", lambda _home: ())
    station: Any = SimpleNamespace(home=None)
    assert matching.nearest_types("gripper-bas", station) == ["gripper", "griper"]
    assert matching.nearest_types("gripperr", station) == ["gripper", "griper"]
    assert matching.nearest_types("x", station) == []


@pytest.mark.parametrize(
    ("mode", "origin", "verdict", "channels", "why"),
    [
        ("transparent", "session", "unsigned", True, ""),
        ("transparent", "kept", "unsigned", True, ""),
        ("transparent", "plain", "unsigned", True, "its datasheet is unsigned"),
        ("transparent", "session", "authentic", True, "its datasheet is authentic"),
        ("transparent", "", "", True, "its datasheet was not read in a session"),
        ("transparent", "session", "unsigned", False, "it has no datasheet of its own"),
        ("whitelist", "session", "unsigned", True, "detection is not transparent"),
    ],
)
def test_an_unsigned_node_is_one_whose_datasheet_was_read_in_a_session(
    mode: str, origin: str, verdict: str, channels: bool, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = SimpleNamespace(origin=origin, verified=SimpleNamespace(verdict=verdict)) if origin else None
    monkeypatch.setattr(matching, "verdict_of", lambda _station, _uuid: judged)
    sheet = SimpleNamespace(channels=[object()] if channels else [])
    monkeypatch.setattr(matching, "Sheet", SimpleNamespace(from_image=lambda _image: sheet))
    station: Any = SimpleNamespace(
        measurements=SimpleNamespace(detection=mode), datasheets=SimpleNamespace(datasheet=lambda _uuid: object())
    )
    assert matching.UnsignedNodes().why_not(station, bytes(10)) == why
