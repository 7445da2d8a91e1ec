"""Which nodes are meant by a search, and which wait for a person: every criterion, at its edge."""

from __future__ import annotations

from typing import Any

import pytest

from teds_provision.station import overview
from teds_provision.station.datasheets import packed
from teds_provision.station.overview import Search
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    Draft,
    Group,
    Holder,
    KeyFlags,
    KeyRecord,
    NodeReading,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    WhitelistEntry,
)
from teds_provision.station.store.row_sample import RowSample
from teds_provision.teds.image import Image

AT, LATER = "2026-01-31T12:00:00Z", "2026-02-01T12:00:00Z"


def uuid(number: int) -> bytes:
    return bytes.fromhex(f"8d4d9da65281f70000{number:02x}")


def key(number: int, epoch: int = 1, state: Any = "active") -> KeyRecord:
    return KeyRecord(uuid(number), epoch, f"{epoch:016x}", state, epoch, b"wrapped", "agreement", AT)


@pytest.fixture
def fleet(station: Station) -> Station:
    """A node for each way of being known, and for each criterion."""
    station.nodes.restore(NodeRecord(uuid(1), name="Finger-1", profile="tactile", state=0, last_seen=AT))
    station.nodes.restore(NodeRecord(uuid(2), bytes(65), name="thumb", profile="angle", state=2, due="2026-03-01"))
    station.nodes.restore(NodeRecord(uuid(3), name="palm", state=0))  # a name alone: nobody has seen it
    station.nodes.restore(NodeRecord(uuid(4), retired="decommissioned", last_seen=LATER, due="2026-03-02"))
    station.pins.restore([WhitelistEntry(uuid(5), name="wrist"), WhitelistEntry(uuid(1), name="listed name")])
    station.keys.add(key(6))
    station.policy.put_tombstone(Tombstone(uuid(7), "ab" * 32, "h", AT))
    station.policy.deny(RevocationRecord(uuid(8), None, "lost", "s", AT))
    station.groups.put(Group("hand", (uuid(1), uuid(5)), AT))
    return station


@pytest.mark.parametrize(
    ("criteria", "numbers"),
    [
        ({}, [1, 2, 3, 4, 5, 6, 7, 8]),
        ({"text": "FINGER"}, [1]),
        ({"text": "wris"}, [5]),
        ({"text": "listed"}, []),  # a node's own name goes before that of its entry
        ({"text": " tact "}, [1]),  # a part of the profile
        ({"text": "0x8D4D9DA65281F7000002"}, [2]),
        ({"text": "F700000"}, [1, 2, 3, 4, 5, 6, 7, 8]),
        ({"text": "8d4d9da65281f70000020"}, []),  # more digits than a UUID has
        ({"text": "a"}, [1, 2, 3, 4, 5, 6, 7, 8]),  # a digit of each UUID, and a letter of names
        ({"text": "m"}, [2, 3]),
        ({"text": ""}, [1, 2, 3, 4, 5, 6, 7, 8]),
        ({"profile": "angle"}, [2]),
        ({"profile": "ang"}, []),
        ({"group": "hand"}, [1, 5]),
        ({"group": "foot"}, []),
        ({"due": "2026-02-28"}, []),
        ({"due": "2026-03-01"}, [2]),
        ({"due": "2026-03-02"}, [2, 4]),
        ({"since": AT}, [1, 4]),
        ({"since": LATER}, [4]),
        ({"since": "2026-02-01T12:00:01Z"}, []),
        ({"state": 0}, [1, 4]),
        ({"state": 2}, [2]),
        ({"state": "moved"}, [7]),
        ({"state": "revoked"}, [8]),
        ({"state": "retired"}, [4]),
        ({"state": "unseen"}, [3, 5, 6, 7, 8]),
        ({"text": "finger", "group": "hand", "state": 0}, [1]),
        ({"text": "finger", "group": "hand", "state": 2}, []),
    ],
)
def test_a_node_must_meet_all_criteria(fleet: Station, criteria: dict[str, Any], numbers: list[int]) -> None:
    assert fleet.overview.find(Search(**criteria)) == [uuid(number) for number in numbers]


def test_which_nodes_are_known(fleet: Station) -> None:
    assert [number for number in range(10) if fleet.overview.is_known(uuid(number))] == [1, 2, 3, 4, 5, 6, 7, 8]


def test_what_is_known_of_a_node_in_its_order(fleet: Station) -> None:
    fleet.keys.add(key(1, 1), key(1, 2, "pending"), key(1, 3, "pending"))
    fleet.keys.put_holder(
        Holder(uuid(1), "bb" * 32, LATER), Holder(uuid(1), "aa" * 32, LATER), Holder(uuid(1), "cc" * 32, AT)
    )
    fleet.keys.put_flags({uuid(1): KeyFlags(rotation="moved here")})
    fleet.groups.put(Group("arm", (uuid(1),), AT))
    first, unknown, moved, revoked = fleet.overview.nodes([uuid(1), uuid(9), uuid(7), uuid(8)])
    assert [(held["epoch"], held["state"]) for held in first.keys] == [(3, "pending"), (2, "pending"), (1, "active")]
    assert [holder["fingerprint"][:2] for holder in first.holders] == ["cc", "aa", "bb"]
    assert (first.groups, first.rotation) == (["arm", "hand"], "moved here")
    assert first.node is not None
    assert first.whitelist is not None
    assert (first.node["name"], first.whitelist["name"], first.moved, first.revoked) == (
        "Finger-1", "listed name", None, None,
    )  # fmt: skip
    assert (unknown.uuid, unknown.node, unknown.whitelist, unknown.keys, unknown.groups) == (
        uuid(9),
        None,
        None,
        [],
        [],
    )
    assert moved.moved == {"to_fingerprint": "ab" * 32, "handover_id": "h"}
    assert revoked.revoked == {"why": "lost", "created": AT}


def test_what_a_node_wraps_is_read_from_its_last_datasheet_and_damage_is_passed_over(
    fleet: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(overview, "origin_of", lambda blocks: blocks.get((0, 1), b"").decode() or None)
    listed = {1: overview._ORIGIN, 2: overview._ORIGIN, 3: b"another", 5: overview._ORIGIN, 6: overview._ORIGIN}
    for number, digests in listed.items():
        fleet._store.execute(
            "INSERT INTO readings(uuid, at, by, whole, digests, checks) VALUES(?, '', '', 1, ?, '[]')",
            (uuid(number), digests),
        )
    for number, blocks in ((1, b"older"), (1, b"newest"), (2, b"\xff damaged"), (3, b"not listed"), (6, b"")):
        octets = b"junk" if number == 2 else packed(Image(uuid(number), {(0, 1): blocks} if blocks else {}))
        fleet._store.execute(
            "INSERT INTO datasheets(uuid, sequence, epoch, seen, digest, blocks) VALUES(?, 1, 1, '', zeroblob(32), ?)",
            (uuid(number), octets),
        )
    found = fleet.overview.nodes([uuid(number) for number in (1, 2, 3, 5, 6)])
    assert [node.origin for node in found] == ["newest", None, None, None, None]


def test_who_waits_for_a_person(fleet: Station) -> None:
    def waiting(today: str) -> list[list[int]]:
        found = fleet.overview.waiting(today, RowSample(full=True))
        named = (found.overdue, found.twice, found.drafts, found.unverified, found.rotations)
        return [[each[-1] for each in uuids] for uuids in named]

    assert waiting("2026-03-01") == [[], [], [], [6], []], "the last day is a good one"
    assert waiting("2026-03-02")[0] == [2]
    assert waiting("2026-03-03")[0] == [2, 4]
    fleet.nodes.restore(NodeRecord(uuid(9), name="thumb"))
    fleet.datasheets.keep_draft(Draft(uuid(1), Image(uuid(1), {})))
    fleet.keys.put_flags({uuid(3): KeyFlags(rotation="why"), uuid(2): KeyFlags(former="ab" * 32)})
    assert waiting("2026-01-01") == [[], [2, 9], [1], [6], [3]]
    for number in (1, 2, 4, 5, 7, 8):  # 4 is out of service, 7 was given away, 8 is banned
        fleet.keys.add(key(number))
    fleet.keys.add(key(3, 1, "pending"))  # no session has proven it: it is not in use
    readings = {1: bytes(8), 2: None}  # in a session, and in none
    for number, c in readings.items():
        fleet.datasheets.keep_reading(NodeReading(uuid(number), AT, "verify", c, True, b""))
    assert waiting("2026-01-01")[3] == [2, 5, 6]


def test_who_waits_longest_is_first_and_nodes_of_one_name_stand_together(fleet: Station) -> None:
    for number in (21, 20):
        fleet.nodes.restore(NodeRecord(uuid(number), due="2026-02-01"))
    for number, name in ((31, "thumb"), (30, "palm"), (29, "alone")):
        fleet.nodes.restore(NodeRecord(uuid(number), name=name))
    for number in (5, 1):
        fleet.datasheets.keep_draft(Draft(uuid(number), Image(uuid(number), {})))
        fleet.keys.put_flags({uuid(number): KeyFlags(rotation="why")})
    found = fleet.overview.waiting("2026-03-03", RowSample(full=True))
    lists = (found.overdue, found.twice, found.drafts, found.rotations)
    assert [[each[-1] for each in uuids] for uuids in lists] == [[20, 21, 2, 4], [3, 30, 2, 31], [1, 5], [1, 5]]
