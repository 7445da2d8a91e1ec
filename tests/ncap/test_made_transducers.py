"""Virtual transducers without their processes: what one is made of, who may not be made, and what one leaves behind."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import nullcontext
from datetime import datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import KnownUuidError, NotFoundError, UsageError
from teds_provision.ncap.nodes import virtual
from teds_provision.ncap.nodes.simulation import Feed
from teds_provision.ncap.nodes.virtual import MOST, Virtual, Virtuals
from teds_provision.protocol.announce import default_can_address
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditFilter
from teds_provision.station.store.records import KeptMeasurement, WhitelistEntry
from teds_provision.teds.formats import TedsBlock, write_blocks
from tests.bench import copied_station

OTHER = bytes.fromhex("cd" * 10)
ORDER: dict[str, Any] = {"name": "cell", "source": "noise", "content": None, "profile": "load-cell"}


class Bench:
    """The virtual transducers of a station, and the events that clients are sent."""

    def __init__(self, folder: Path) -> None:
        self.events: list[tuple[str, str]] = []
        self.station: Station = copied_station(folder)
        self.live: Any = SimpleNamespace(event=lambda kind, **facts: self.events.append((kind, facts["state"])))
        self.virtuals = Virtuals(self.station, self.live)

    def make(self, **changed: Any) -> Virtual:
        return self.virtuals.make(**ORDER | changed)

    def outcomes(self) -> list[tuple[bytes | None, str]]:
        return [(entry.uuid, entry.outcome) for entry in self.station.audit_log.chosen(AuditFilter(act="virtual"))]

    def folders(self) -> list[Path]:
        return sorted((self.station.home / "virtual").glob("*"))


@pytest.fixture
def bench(tmp_path: Path) -> Iterator[Bench]:
    made = Bench(tmp_path / "home")
    yield made
    made.station.close()


def test_a_new_one_is_on_the_whitelist_under_the_key_that_it_made_and_is_there_after_a_restart(bench: Bench) -> None:
    made = bench.make(source="sine:2")
    uuid = bytes.fromhex(made.uuid)
    shown = {"uuid": made.uuid, "name": "cell", "source": "sine:2", "state": "starting", "why": "", "channels": 1}
    assert made.as_json() == shown | {"simulation": None}
    assert bench.folders() == [made.folder]
    assert made.folder.stat().st_mode & 0o777 == 0o700
    entry = bench.station.pins.entry(uuid)
    assert entry is not None
    assert (entry.assurance, entry.name, len(entry.fingerprint or "")) == ("import", "cell", 64)
    assert (bench.outcomes(), bench.events) == ([(uuid, "made")], [("virtual", "made")])
    again = Virtuals(bench.station, bench.live)
    assert again.all() == [shown | {"simulation": None}]
    assert made.uuid in again
    assert (again.profile_of(made.uuid), again.name_of(made.uuid)) == ("load-cell", "cell")
    facts = (made.folder / "virtual.json").read_text()
    (made.folder / "virtual.json").write_text(facts.replace('"load-cell"', "7"))
    assert again.profile_of(made.uuid) is None, "a name alone is one"
    path = again.calibration_of(made.uuid)
    assert path is not None
    [_, channel, _, unit, points, *rest] = path.read_text().splitlines()
    assert (channel, unit, rest) == ("channel = 1", 'unit = "N"', [])
    assert points == "points = [[0.0, -500.0], [16777215.0, 500.0]]", "the whole raw range"


def test_what_its_folder_does_not_say_ends_no_start(bench: Bench) -> None:
    made = bench.make()
    for name, text in (("a", "no JSON"), ("b", "[]"), ("c", "{}"), ("d", "null")):
        folder = bench.station.home / "virtual" / name
        folder.mkdir()
        (folder / "virtual.json").write_text(text)
    (bench.station.home / "virtual" / "e").mkdir()
    assert [one["uuid"] for one in Virtuals(bench.station, bench.live).all()] == [made.uuid]


def test_a_profile_with_a_calibration_for_each_channel_needs_a_line_for_each_and_a_datasheet_none(bench: Bench) -> None:
    made = bench.make(name=None, profile="gripper")
    path = bench.virtuals.calibration_of(made.uuid)
    assert path is not None
    lines = [line for line in path.read_text().splitlines() if line.startswith(("channel", "unit", "points"))]
    assert lines == [
        "channel = 1", 'unit = "m"', "points = [[0.0, 0.0], [4095.0, 0.10999999940395355]]",
        "channel = 2", 'unit = "m"', "points = [[0.0, 0.0], [4095.0, 0.10999999940395355]]",
        "channel = 3", 'unit = "N"', "points = [[0.0, 0.0], [4095.0, 140.0]]",
    ]  # fmt: skip
    blocks = bench.virtuals.blocks_of(made.uuid)
    document = write_blocks([TedsBlock(channel, code, octets) for (channel, code), octets in blocks.items()], "xml")
    text = document if isinstance(document, str) else document.decode()
    with pytest.raises(KnownUuidError, match="has the UUID of node"):
        bench.make(name="copy", content=text, profile=None)
    copy = bench.make(name="copy", content=text, profile=None, new_uuid=True)
    assert copy.uuid != made.uuid
    assert default_can_address(bytes.fromhex(copy.uuid)) != default_can_address(bytes.fromhex(made.uuid))
    assert (bench.virtuals.profile_of(copy.uuid), bench.virtuals.calibration_of(copy.uuid)) == (None, None)
    assert (copy.name, copy.channels) == ("copy", 3)
    bench.virtuals.forget(made.uuid)
    with pytest.raises(KnownUuidError):  # of a node that a link has heard, whoever it is
        bench.make(name="third", content=text, profile=None, on_bus=[made.uuid])


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"source": "exec:true"}, "is not a valid source"),
        ({"profile": None}, "needs a datasheet or a profile"),
        ({"content": "<teds/>"}, "needs a datasheet or a profile"),
        ({"name": "hand"}, f"Node {OTHER.hex()} already has the name 'hand'"),
        ({"name": "x" * 121}, "name"),
    ],
)
def test_one_that_is_refused_leaves_nothing(bench: Bench, changed: dict[str, Any], words: str) -> None:
    bench.station.nodes.remember(OTHER, name="hand")
    with pytest.raises(UsageError, match=words):
        bench.make(**changed)
    assert (bench.folders(), bench.outcomes(), bench.events, bench.virtuals.all()) == ([], [], [], [])
    assert list(bench.station.pins.all()) == []


@pytest.mark.parametrize("known", ["virtual", "whitelist", "node", "on a bus", ""])
def test_a_uuid_that_is_anybodys_is_not_made_again(bench: Bench, known: str) -> None:
    if known == "virtual":
        bench.virtuals._all[OTHER.hex()] = Virtual(OTHER.hex(), "", "noise", bench.station.home)
    elif known == "whitelist":
        bench.station.pins.put(WhitelistEntry(OTHER))
    elif known == "node":
        bench.station.nodes.remember(OTHER, name="hand")
    on_bus = frozenset({OTHER.hex()} if known == "on a bus" else ())
    with pytest.raises(KnownUuidError, match="which this station already knows") if known else nullcontext():
        bench.virtuals._require_free(OTHER, 1, "", on_bus)


def test_two_of_one_can_address_would_be_one_node_to_everybody(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    first = bytes([0xAB] * 8 + [0, 1])
    address = default_can_address(first)
    twin = next(
        uuid for number in range(2, 1 << 16)
        if default_can_address(uuid := bytes([0xAB] * 8) + number.to_bytes(2, "big")) == address
    )  # fmt: skip
    bench.virtuals._all[first.hex()] = Virtual(first.hex(), "first", "noise", bench.station.home)
    with pytest.raises(UsageError, match=f"already uses CAN address 0x{address:02X}"):
        bench.virtuals._require_free(twin, address, "", ())
    bench.virtuals._require_free(twin, address ^ 1, "", ())
    octets, other = iter([twin, twin, OTHER]), default_can_address(OTHER)
    monkeypatch.setattr("teds_provision.ncap.nodes.virtual.secrets.token_bytes", lambda _count: next(octets))
    assert (bench.virtuals._new_uuid(), other == address) == (OTHER, False)
    for number in range(MOST - 1):
        bench.virtuals._all[f"{number}"] = bench.virtuals._all[first.hex()]
    with pytest.raises(UsageError, match="already has 100 virtual transducers"):
        bench.make()


def test_one_that_is_removed_leaves_no_key_no_name_and_no_measurement(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, station, course = bench.make(), bench.station, list[Any]()
    uuid = bytes.fromhex(made.uuid)
    station.nodes.remember(uuid, name="cell")
    station.measurements.keep(KeptMeasurement("", uuids=(uuid,)))
    both = station.measurements.keep(KeptMeasurement("", uuids=(uuid, OTHER)))
    monkeypatch.setattr(station.keys, "remove", lambda node: course.append(("key", node)))
    monkeypatch.setattr(station.datasheets, "drop_draft", lambda node: course.append(("draft", node)))
    bench.virtuals.forget(made.uuid)
    assert course == [("key", uuid), ("draft", uuid)]
    assert station.pins.entry(uuid) is None
    record = station.nodes.get(uuid)
    assert record is not None
    assert (record.name, record.retired) == (None, "decommissioned")
    assert [(kept.id, kept.uuids) for kept in station.measurements.all()] == [(both.id, (OTHER,))]
    assert bench.outcomes() == [(uuid, "made"), (uuid, "removed")]
    assert bench.virtuals.all() == []
    assert made.folder.exists(), "until its process has ended"
    made.feed = Feed("page", lambda: course.append("its simulation ends"))
    bench.virtuals.end(made)
    assert (course[2:], bench.folders()) == (["its simulation ends"], [])
    assert bench.events == [("virtual", "made"), ("virtual", "removed")]
    with pytest.raises(NotFoundError):
        bench.virtuals.forget(made.uuid)


def test_one_of_which_the_station_never_heard_is_not_retired(bench: Bench) -> None:
    made = bench.make()
    bench.virtuals.forget(made.uuid)
    assert bench.station.nodes.get(bytes.fromhex(made.uuid)) is None


def test_what_is_known_of_one_is_in_its_folder(bench: Bench) -> None:
    made = bench.make(name=None, source="simulation")
    facts = json.loads((made.folder / "virtual.json").read_text())
    assert (facts["uuid"], facts["source"], facts["profile"], facts["channels"]) == (
        made.uuid, "simulation", "load-cell", 1,
    )  # fmt: skip
    assert made.name == facts["name"] != "", "the profile's"


def test_straight_lines_are_for_channels_that_have_a_range_and_no_values_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    """In the unit that people read, over the whole raw range; a datasheet's own calibration stays as it is."""

    def channel(number: int, **changed: Any) -> Any:
        unit = SimpleNamespace(text="mm", from_si=lambda value: value * 1000.0)
        facts = {"value_problem": "It has no calibration.", "has_range": True, "calibration_problem": "", "unit": unit}
        sample = SimpleNamespace(raw_range=(0, 4095))
        return SimpleNamespace(number=number, sample=sample, low=0.125, high=0.25, **facts | changed)

    def now(zone: Any) -> datetime:
        return datetime(2026, 3, 1, tzinfo=zone)

    monkeypatch.setattr(virtual, "datetime", SimpleNamespace(now=now))
    channels = [
        channel(1),
        channel(2, value_problem=""),
        channel(3, has_range=False),
        channel(4, calibration_problem="Its length is wrong."),
        channel(7),
    ]
    channels[4].sample.raw_range = (-5.0, 5.0)
    without, unknown = channel(5), channel(6)
    without.sample, unknown.sample.raw_range = None, None
    sheet: Any = SimpleNamespace(channels=[*channels[:4], without, unknown, channels[4]])
    assert virtual.ideal_calibration(sheet) == (
        '[[calibration]]\nchannel = 1\ndate = 2026-03-01\nunit = "mm"\npoints = [[0, 125.0], [4095, 250.0]]\n'
        '\n[[calibration]]\nchannel = 7\ndate = 2026-03-01\nunit = "mm"\npoints = [[-5.0, 125.0], [5.0, 250.0]]\n'
    )


@pytest.mark.parametrize(
    ("source", "words"),
    [
        ("sine:86400", None),
        ("ramp:0.5", None),
        ("simulation", None),
        ("unix:/run/feed", None),
        ("file:/day.csv", None),
        ("sine:86401", "is longer than a day"),
        ("ramp:86401", "is longer than a day"),
        ("sine:x", "is not a valid source"),
        ("file:day.csv", "is not a valid source"),
        ("noise\n", "is not a valid source"),
        ("noise:2", "is not a valid source"),
        ("simulation:/x", "is not a valid source"),
    ],
)
def test_a_source_is_one_that_its_process_takes(source: str, words: str | None) -> None:
    with pytest.raises(UsageError, match=words) if words else nullcontext():
        virtual._check_source(source)


@pytest.mark.parametrize(("running", "stubborn"), [(False, False), (True, False), (True, True)])
def test_a_process_is_asked_to_end_and_has_five_seconds(running: bool, stubborn: bool) -> None:
    course: list[Any] = []

    def wait(seconds: float) -> None:
        course.append(seconds)
        if stubborn:
            raise subprocess.TimeoutExpired("node", seconds)

    process: Any = SimpleNamespace(
        poll=lambda: None if running else 0,
        terminate=lambda: course.append("asked"),
        wait=wait,
        kill=lambda: course.append("killed"),
    )
    virtual._end(process)
    assert course == ([] if not running else ["asked", 5.0, "killed"] if stubborn else ["asked", 5.0])
    virtual._end(None)
