"""Which nodes an expression means (`ncap run --measure EXPR`), and what joins under which names."""

from __future__ import annotations

from pathlib import Path
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
from teds_provision.teds.image import Image
from teds_provision.teds.profile import load_profile


def test_an_expression_is_terms_that_must_all_hold() -> None:
    match = NodeMatch.parse("type:angle-sensor, name:arm-*,group:left,right, angle >= 360 deg, rate >= 1 kHz")
    assert (match.types, match.names, match.groups) == (("angle-sensor",), ("arm-*",), ("left", "right"))
    assert match.fits is not None
    assert [term.text for term in match.fits.terms] == ["angle >= 360 deg", "rate >= 1 kHz"]
    assert NodeMatch.parse("all") == NodeMatch("all")
    spaced = NodeMatch.parse(" type: angle-sensor , name: arm-* , group: left")
    assert (spaced.types, spaced.names, spaced.groups) == (("angle-sensor",), ("arm-*",), ("left",))


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


ARM, LEG, BARE, GUEST = (bytes([number]) * 10 for number in range(1, 5))


def station_of(**more: Any) -> Any:
    """Return a station with an arm, a leg, a node without name and type, and one that it has no row of."""
    rows = {
        ARM: SimpleNamespace(uuid=ARM, profile="angle-sensor", name="arm-1"),
        LEG: SimpleNamespace(uuid=LEG, profile="gripper", name="leg"),
        BARE: SimpleNamespace(uuid=BARE, profile=None, name=None),
    }
    groups = {"left": SimpleNamespace(uuids=(ARM, LEG)), "right": SimpleNamespace(uuids=(LEG,))}
    parts = {
        "nodes": SimpleNamespace(get=rows.get, all=rows.values),
        "groups": SimpleNamespace(find=groups.get),
        "datasheets": SimpleNamespace(datasheet=lambda uuid: None if uuid in (BARE, GUEST) else uuid),
    }
    return SimpleNamespace(**parts | more)


@pytest.mark.parametrize(
    ("text", "uuid", "why"),
    [
        ("all", GUEST, ""),
        ("type:angle-sensor", ARM, ""),
        ("type:angle-sensor", LEG, "its type is gripper, not angle-sensor"),
        ("type:angle-sensor,type:gripper", ARM, "its type is angle-sensor, not gripper"),
        ("type:gripper", BARE, "its type is unknown, and its datasheet does not fit gripper: none is known"),
        ("type:gripper", GUEST, "its type is unknown, and its datasheet does not fit gripper: none is known"),
        ("name:arm-*", ARM, ""),
        ("name:ARM-*", ARM, "its name 'arm-1' is not ARM-*"),
        ("name:*,name:leg", ARM, "its name 'arm-1' is not leg"),
        ("name:leg,name:*", ARM, "its name 'arm-1' is not leg"),
        ("name:arm-*,name:*-1", ARM, ""),
        ("name:*", BARE, ""),
        ("name:?*", BARE, "its name '' is not ?*"),
        ("left", ARM, ""),
        ("group:left,right", ARM, "it is not in group right"),
        ("right", LEG, ""),
        ("gone", LEG, "it is not in group gone"),
        ("angle >= 1 deg", BARE, "its datasheet is unknown"),
        ("left,type:gripper,name:leg,right", LEG, ""),
    ],
)
def test_all_terms_must_hold_and_the_first_that_does_not_is_the_reason(text: str, uuid: bytes, why: str) -> None:
    assert NodeMatch.parse(text).why_not(station_of(), uuid) == why


@pytest.mark.parametrize(
    ("fits", "why"),
    [([], "its datasheet is unknown"), (["The range is 90 deg.", "No rate."], "The range is 90 deg"), (None, "")],
)
def test_a_bound_holds_for_the_stored_datasheet_and_is_said_without_its_full_stop(
    fits: list[str] | None, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(matching, "Sheet", SimpleNamespace(from_image=lambda image: image))
    monkeypatch.setattr(matching, "judge", lambda _fits, _sheet, _now: [SimpleNamespace(why=why) for why in fits or []])
    monkeypatch.setattr(matching, "met", lambda _fits, _judged: fits is None)
    assert NodeMatch.parse("angle >= 1 deg").why_not(station_of(), ARM) == why


def test_nodes_that_may_not_be_measured_are_no_match_whatever_the_expression(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(matching, "why_not_measured", lambda _station, uuid: "it was revoked" if uuid == ARM else "")
    found = matching.survey(station_of(), NodeMatch.parse("name:*-1"))
    assert found.matching == ()
    assert found.others == {
        ARM.hex(): "it was revoked", LEG.hex(): "its name 'leg' is not *-1", BARE.hex(): "its name '' is not *-1",
    }  # fmt: skip
    assert matching.survey(station_of(), NodeMatch.parse("right")).matching == (LEG.hex(),)


def test_a_type_is_unknown_if_neither_a_profile_nor_a_node_is_called_so(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[str]()

    def find(search: Any) -> list[bytes]:
        asked.append(search.profile)
        return [LEG] if search.profile == "kept" else []

    station = station_of(overview=SimpleNamespace(find=find))
    monkeypatch.setattr(matching, "_is_profile", lambda kind, _station: kind == "gripper")
    assert NodeMatch.parse("type:gripper,type:kept").unknown_type(station) == ""
    said = NodeMatch.parse("type:gripper,type:gone,name:x").unknown_type(station)
    assert said == "no profile and no known node is called 'gone'"
    assert asked == ["kept", "gone"]
    assert NodeMatch.parse("all").unknown_type(station) == ""


@pytest.mark.parametrize(
    ("listed", "verdict", "why"),
    [
        (True, "authentic", ""),
        (True, "unsigned", "it was not adopted here"),
        (True, None, "it was not adopted here"),
        (False, "authentic", "it was not adopted here"),
    ],
)
def test_a_node_that_was_adopted_while_it_was_measured_is_measured_on_once_it_is_signed(
    listed: bool, verdict: str | None, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = None if verdict is None else SimpleNamespace(verified=SimpleNamespace(verdict=verdict))
    monkeypatch.setattr(matching, "verdict_of", lambda _station, _uuid: judged)
    adopted = set[bytes]()
    nodes = matching.ListedNodes(adopted)
    if listed:
        adopted.add(ARM)  # the list grows while it is used
    assert nodes.why_not(station_of(), ARM) == why


def test_a_node_whose_type_was_never_named_is_of_the_type_that_its_datasheet_fits(tmp_path: Path) -> None:
    """As after an adoption. What is no name of a profile is none, whatever files there are."""
    (tmp_path / "profiles").mkdir()
    (tmp_path / "profiles" / "damaged.toml").write_text("title = ")
    images = {LEG: Image(LEG, load_profile("gripper").build(LEG).blocks), ARM: Image(ARM, {})}
    station = station_of(
        nodes=SimpleNamespace(get=lambda _: None), datasheets=SimpleNamespace(datasheet=images.get), home=tmp_path
    )
    unknown = "its type is unknown, and its datasheet does not fit "
    for kind, uuid, why in (
        ("gripper", LEG, ""),
        ("load-cell", LEG, f"{unknown}load-cell: its channels are 1, 2, 3, not 1"),
        ("gripper", ARM, f"{unknown}gripper: none is known"),
        ("gripper", BARE, f"{unknown}gripper: none is known"),
        ("no-such-type", LEG, f"{unknown}no-such-type: there is no profile no-such-type"),
        ("damaged", LEG, f"{unknown}damaged: there is no profile damaged"),
        ("../profiles/damaged", LEG, f"{unknown}../profiles/damaged: there is no profile ../profiles/damaged"),
    ):
        assert NodeMatch.parse(f"type:{kind}").why_not(station, uuid) == why
    found = [matching._is_profile(kind, station) for kind in ("gripper", "damaged", "no-such-type", "../gripper")]
    assert found == [True, True, False, False]


@pytest.mark.parametrize(
    ("detection", "verdict", "origin", "why"),
    [
        ("transparent", "unsigned", "session", ""),
        ("whitelist", "unsigned", "session", "detection is not transparent"),
        ("transparent", None, "session", "its datasheet was not read in a session"),
        ("transparent", "unsigned", "plain", "its datasheet is unsigned"),
        ("transparent", "authentic", "session", "its datasheet is authentic"),
        ("transparent", "not authentic", "session", "its datasheet is not authentic"),
    ],
)
def test_only_what_is_read_in_a_session_and_has_no_signature_is_measured_unverified(
    detection: str, verdict: str | None, origin: str, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged = None if verdict is None else SimpleNamespace(verified=SimpleNamespace(verdict=verdict), origin=origin)
    monkeypatch.setattr(matching, "verdict_of", lambda _station, _uuid: judged)
    image = Image(LEG, load_profile("gripper").build(LEG).blocks)
    none = "it has no datasheet of its own"
    for stored, missing in ((image, ""), (Image(LEG, {}), none), (None, none)):
        station = station_of(
            measurements=SimpleNamespace(detection=detection),
            datasheets=SimpleNamespace(datasheet=lambda _, stored=stored: stored),
        )
        assert matching.UnsignedNodes().why_not(station, LEG) == (why or missing)


def test_a_nodes_share_is_waited_for_until_every_expected_one_is_known() -> None:
    share, waits = BusShare(BusTime(CanAirtime())), list[tuple[bool, float]]()
    told = list[str]()
    guard: Any = _Guard(lambda ready, seconds: waits.append((ready(), seconds)), lambda: told.append("told"))
    share.lock = guard
    share.expect([ARM, LEG])
    share.announce_share(ARM, 0.1)
    share.announce_share(LEG, 0.2)
    assert waits == [(False, 1.0), (True, 1.0)]
    told.clear()
    share.drop_node(LEG)
    assert told == ["told"], "those that wait for it wait no more"
    share.announce_share(ARM, 0.1)
    assert waits[-1] == (True, 1.0)


class _Guard:
    """A condition that records what is done with it."""

    def __init__(self, wait_for: Any, notify_all: Any) -> None:
        self.wait_for, self.notify_all = wait_for, notify_all

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None: ...


def test_a_type_is_named_and_never_the_path_of_a_file(tmp_path: Path) -> None:
    """The expression of a measurement may come from another machine: no file of its choice is read."""
    assert matching._profile("gripper", tmp_path) == load_profile("gripper")
    for folder in (tmp_path, tmp_path / "profiles"):
        folder.mkdir(exist_ok=True)
        (folder / "mine.toml").write_text('extends = "gripper"\nname = "mine"\n')
    for kind in (str(tmp_path / "mine.toml"), "../mine", "mine.toml", "no-such-type"):
        assert matching._profile(kind, tmp_path) is None, kind
    (tmp_path / "profiles" / "broken.toml").write_text("[[")
    assert matching._profile("broken", tmp_path) is None
