"""Groups: their names, members, reports to the plant, and what a running measurement holds as it is."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from teds_provision.errors import FrozenError, NotFoundError, UsageError
from teds_provision.station.groups import is_valid_name, valid_name
from teds_provision.station.station import Station
from teds_provision.station.store.records import Group

A, B, C = (bytes([number] * 10) for number in (1, 2, 3))
Report = tuple[str, bytes | None, str, bool]


@pytest.fixture
def reports(station: Station, monkeypatch: pytest.MonkeyPatch) -> list[Report]:
    """What the plant is told."""
    told: list[Report] = []

    def record(act: str, uuid: bytes | None, *, group: str, member: bool) -> None:
        told.append((act, uuid, group, member))

    monkeypatch.setattr(station.plant, "record_event", record)
    return told


def members(station: Station) -> dict[str, tuple[bytes, ...]]:
    return {group.name: group.uuids for group in station.groups.all()}


@pytest.mark.parametrize(
    ("name", "valid"),
    [
        ("left hand", True),
        ("abc", True),  # three digits are no UUID yet
        ("abcd", False),
        ("ABCDEF0123", False),
        ("0xabcd", False),
        ("abcdg", True),
        ("abcd hand", True),
        ("all", False),
        ("All", True),
        (".", False),
        ("..", False),
        ("...", True),
        ("", False),
        ("  ", False),
        ("a\tb", False),
        ("x" * 64, True),
        ("x" * 65, False),
        ("ü" * 64, True),
    ],
)
def test_a_groups_name_is_no_uuid_no_path_and_not_all(name: str, valid: bool) -> None:
    assert is_valid_name(name) is valid


@pytest.mark.parametrize(
    ("label", "name"),
    [
        ("left hand", "left hand"),
        ("all", "group all"),
        ("cafe", "group cafe"),
        ("y" * 65, "group " + "y" * 58),
        ("y" * 57 + " " + "z" * 9, "group " + "y" * 57),
    ],
)
def test_a_label_of_a_bundle_that_is_no_name_becomes_one(label: str, name: str) -> None:
    assert valid_name(label) == name
    assert is_valid_name(name)


def test_a_group_is_made_once_with_its_members_and_reported(station: Station, reports: list[Report]) -> None:
    groups = station.groups
    made = groups.create("hand", [B, A, B])
    assert made == Group("hand", (A, B), made.created)
    assert groups.create("hand", [A, B]) == made, "the same members, in any order"
    for others in ([A], [A, B, C]):
        with pytest.raises(UsageError, match="already exists"):
            groups.create("hand", others)
    with pytest.raises(UsageError, match="not a valid group name"):
        groups.create("all", [A])
    groups.create("arm", [])
    assert members(station) == {"arm": (), "hand": (A, B)}
    assert [group.name for group in groups.all()] == ["arm", "hand"]
    assert reports == [("grouped", B, "hand", True), ("grouped", A, "hand", True)]


def test_who_is_added_or_taken_out_is_reported_once_and_only_if_that_changed_something(
    station: Station, reports: list[Report]
) -> None:
    groups = station.groups
    groups.create("hand", [A])
    groups.create("arm", [A])
    reports.clear()
    assert groups.add("hand", [C, A, B, C]).uuids == (A, B, C)
    assert reports == [("grouped", C, "hand", True), ("grouped", B, "hand", True)]
    reports.clear()
    assert groups.remove("hand", [C, bytes(10), A, C]).uuids == (B,)
    assert reports == [("grouped", C, "hand", False), ("grouped", A, "hand", False)]
    assert members(station) == {"arm": (A,), "hand": (B,)}
    reports.clear()
    assert groups.delete("hand")
    assert not groups.delete("hand")
    assert reports == [("grouped", B, "hand", False)]
    assert members(station) == {"arm": (A,)}
    assert groups.names_of_node(B) == []


def test_a_group_that_is_not_there_is_named_with_those_that_are(station: Station) -> None:
    groups = station.groups
    absent: tuple[Callable[[], object], ...] = (
        partial(groups.get, "hand"), partial(groups.add, "hand", [A]), partial(groups.remove, "hand", [A])
    )  # fmt: skip
    for call in absent:
        with pytest.raises(NotFoundError) as caught:
            call()
        assert caught.value.hint == "To create it: teds-provision group create NAME UUID …"
    for number in range(10):
        groups.create(f"g{number}", [])
    with pytest.raises(NotFoundError) as caught:
        groups.get("G1")
    assert caught.value.message == "There is no group 'G1'."
    assert caught.value.hint == "Groups: g0, g1, g2, g3, g4, g5, g6, g7, g8, g9."
    groups.create("g91", [])
    with pytest.raises(NotFoundError, match="no group") as caught:
        groups.get("hand")
    assert caught.value.hint == "Groups: g0, g1, g2, g3, g4, g5, g6, g7, g8, g9, …."
    assert groups.find("hand") is None


def test_a_replacement_takes_the_place_in_every_group(station: Station, reports: list[Report]) -> None:
    groups = station.groups
    groups.create("both", [A, B])
    groups.create("old", [A])
    groups.create("other", [C])
    reports.clear()
    with groups.frozen("old"):
        assert groups.hand_on(A, B) == ["both", "old"], "a group that is measured changes too"
    assert members(station) == {"both": (B,), "old": (B,), "other": (C,)}
    assert reports == [("grouped", A, "both", False), ("grouped", A, "old", False), ("grouped", B, "old", True)]
    reports.clear()
    assert groups.hand_on(B, None) == ["both", "old"]
    assert members(station) == {"both": (), "old": (), "other": (C,)}
    assert reports == [("grouped", B, "both", False), ("grouped", B, "old", False)]
    assert groups.hand_on(A, C) == []


def test_a_group_that_is_measured_is_not_changed_until_that_ends(station: Station, reports: list[Report]) -> None:
    groups = station.groups
    groups.create("hand", [A])
    groups.create("arm", [A])
    reports.clear()
    with groups.frozen("hand"):
        changes = partial(groups.add, "hand", [B]), partial(groups.remove, "hand", [A]), partial(groups.delete, "hand")
        for change in changes:
            with pytest.raises(FrozenError, match="Group 'hand' is being measured"):
                change()
        groups.add("arm", [B])
    assert members(station) == {"arm": (A, B), "hand": (A,)}
    assert reports == [("grouped", B, "arm", True)]
    groups.add("hand", [C])
    assert members(station)["hand"] == (A, C)


def test_nothing_is_held_for_a_group_that_is_not_there(station: Station, home: Path) -> None:
    for change in (station.groups.add, station.groups.remove):
        with pytest.raises(NotFoundError):
            change("hand", [A])
    assert not station.groups.delete("hand")
    assert list(home.glob("measuring-*")) == []


def test_what_comes_from_a_backup_or_a_bundle_is_not_reported(station: Station, reports: list[Report]) -> None:
    groups = station.groups
    groups.put(Group("hand", (A, B), "2026-10-01T08:00:00Z"))
    groups.put(Group("hand", (C,), "2026-11-01T08:00:00Z"))
    assert groups.all() == [Group("hand", (C,), "2026-10-01T08:00:00Z")]
    groups.put_members({"hand": [A, C], "arm": [B]})
    assert members(station) == {"arm": (B,), "hand": (A, C)}
    assert groups.names_of_node(A) == ["hand"]
    assert groups.get("hand").created == "2026-10-01T08:00:00Z"
    assert reports == []
