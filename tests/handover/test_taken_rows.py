"""What a bundle's node becomes in the store, and what is decided for each: states that need no bundle and no board."""

from __future__ import annotations

import gc
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError
from teds_provision.handover.gc_pause import pause_gc
from teds_provision.handover.incoming import ImportedRows, PlannedNode, _is_known_ca, _Judge, proven_of
from teds_provision.protocol.handover.bundle import BundledNode
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    KeyFlags,
    KeyRecord,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)
from tests.bench import copied_station

A, B, C, D = (bytes.fromhex(f"8d4d9da65281f700000{number}") for number in (1, 2, 3, 4))
POINT = SoftwareKey(71).point
PIN = fingerprint(POINT)
SENDER, OTHER = "aa" * 32, "bb" * 32
AT = "2026-01-31T12:00:00Z"


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    with copied_station(tmp_path / "home") as made:
        made.unlock()
        yield made


def bundle(station: Station, mode: str = "copy") -> Any:
    return SimpleNamespace(id="h", sender=SENDER, to=(station.fingerprint, OTHER), mode=mode, ca=station.ca)


def node(uuid: bytes = A, epoch: int = 3, key: bytes = b"k" * 16, **more: Any) -> BundledNode:
    return BundledNode(uuid, POINT, key, epoch, **more)


def take(station: Station, *planned: PlannedNode, mode: str = "copy") -> None:
    with station.transaction():
        ImportedRows(station, bundle(station, mode)).take_in(planned)


def test_a_node_that_is_new_here(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    refreshed: list[str] = []
    monkeypatch.setattr(station.keys, "refresh", lambda: refreshed.append("vault"))
    take(station, PlannedNode(node(A, profile="p", sequence=9, teds_sha256="ab" * 32), "new", name="thumb"),
         PlannedNode(node(B), "new"))  # fmt: skip
    assert refreshed == ["vault"], "before a key is wrapped"
    first, second = (station.nodes.get(uuid) for uuid in (A, B))
    assert first is not None
    assert second is not None
    assert (first.point, first.name, first.profile, first.state) == (POINT, "thumb", "p", NodeState.PROVISIONED)
    assert (first.epoch, first.sequence, first.teds_sha256) == (0, 0, "ab" * 32), "a bundle's numbers are hints"
    assert (second.state, second.name, second.profile) == (NodeState.KEYED, None, None)
    entry = station.pins.entry(A)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance, entry.name) == (PIN, "import", "thumb")
    (key,) = station.keys.keys_of(A)
    assert (key.epoch, key.state, key.source, key.slot) == (3, "pending", "import", 1)
    assert station.keys.unwrap(key) == b"k" * 16
    holders = {(holder.uuid, holder.fingerprint, holder.mode) for holder in station.keys.holders()}
    assert holders == {(uuid, other, "copy") for uuid in (A, B) for other in (SENDER, OTHER)}


def test_of_a_node_that_is_known_here_what_is_known_stays(station: Station) -> None:
    station.nodes.put(NodeRecord(A, None, "own name", "own", state=1, epoch=5, sequence=8, teds_sha256="cd" * 32))
    station.nodes.put(NodeRecord(B))
    for uuid, pin in ((A, PIN[:32]), (B, PIN)):
        station.pins.put(WhitelistEntry(uuid, pin, assurance="uuid"))
    station.keys.add(KeyRecord(A, 2, "01" * 8, "active", 7, b"wrapped", "agreement", AT))
    facts: dict[str, Any] = {"profile": "p", "teds_sha256": "ab" * 32}
    take(
        station, PlannedNode(node(A, **facts), "newer", name="thumb"), PlannedNode(node(B, **facts), "new", name="palm")
    )
    first, second = (station.nodes.get(uuid) for uuid in (A, B))
    assert first is not None
    assert second is not None
    assert (first.point, first.name, first.profile, first.state) == (POINT, "own name", "own", 1)
    assert (first.epoch, first.sequence, first.teds_sha256) == (5, 8, "cd" * 32)
    assert (second.name, second.profile, second.state, second.teds_sha256) == ("palm", "p", 2, "ab" * 32)
    entries = [station.pins.entry(uuid) for uuid in (A, B)]
    assert [(one.fingerprint, one.assurance) for one in entries if one] == [(PIN, "import"), (PIN, "uuid")]
    assert [key.slot for key in station.keys.keys_of(A)] == [8, 7], "a slot that the node never had"


@pytest.mark.parametrize(("mode", "word"), [("copy", "it was returned by h"), ("move", "moved here by h")])
def test_a_node_that_comes_back_is_rotated_and_its_tombstone_goes(station: Station, mode: str, word: str) -> None:
    station.policy.put_tombstone(Tombstone(A, SENDER, "old", AT))
    take(station, PlannedNode(node(A), "new"), PlannedNode(node(B), "new"), mode=mode)
    assert (station.keys.rotation_due(A) or "").startswith(word)
    assert (station.keys.rotation_due(B) is not None) is (mode == "move")
    assert station.policy.tombstones() == []
    log = [
        (entry.uuid, entry.outcome, entry.detail) for entry in station.audit_log.entries() if entry.act == "handover"
    ]
    assert log == [(A, "came back", {"handover": "h"})]


def test_a_node_gets_a_pin_if_it_has_none_whether_it_is_known_or_not(station: Station) -> None:
    station.nodes.put(NodeRecord(A))
    station.pins.put(WhitelistEntry(B, PIN, assurance="tap", name="own name"))
    take(station, *(PlannedNode(node(uuid), "new", name="thumb") for uuid in (A, B)))
    first, second = (station.pins.entry(uuid) for uuid in (A, B))
    assert first is not None
    assert second is not None
    assert (first.fingerprint, first.assurance, first.name) == (PIN, "import", "thumb")
    assert (second.fingerprint, second.assurance, second.name) == (PIN, "tap", "own name")


def test_a_node_joins_the_groups_of_its_bundle_and_leaves_none(station: Station) -> None:
    station.groups.create("arm", [C])
    station.groups.create("own", [A])
    take(
        station,
        PlannedNode(node(A, groups=("arm", "hand")), "new"),
        PlannedNode(node(B, groups=("hand", "all")), "same"),
    )
    groups = {group.name: sorted(group.uuids) for group in station.groups.all()}
    assert groups == {"arm": [A, C], "own": [A], "hand": [A, B], "group all": [B]}, "all is the name of no group"


@pytest.mark.parametrize("mode", ["copy", "move"])
def test_whose_ca_a_node_keeps_is_noted_beside_its_rotation(station: Station, mode: str) -> None:
    other = SoftwareKey(75).point
    own = bundle(station, mode)
    own.ca = other
    station.keys.add(KeyRecord(B, 2, "01" * 8, "active", 1, b"wrapped", "agreement", AT))
    station.keys.set_ca_of(D, other)
    newer = node(B, 5)
    planned = (
        PlannedNode(node(A), "new"), PlannedNode(newer, "newer"), PlannedNode(node(C), "same"),
        PlannedNode(node(D), "new"),
    )  # fmt: skip
    with station.transaction():
        ImportedRows(station, own).take_in(planned)
    flags = {uuid: station.keys._flags(uuid) for uuid in (A, B, C, D)}
    assert [flags[uuid].ca for uuid in (A, B, C, D)] == [other, None, None, other]
    assert (flags[B].next_key_id, flags[B].next_ca) == (newer.kid, other), "once a session proves the key"
    assert {flags[uuid].next_key_id for uuid in (A, C, D)} == {None}
    due = {(flags[uuid].rotation or "").startswith("moved here by h") for uuid in (A, B, C, D)}
    assert due == {mode == "move"}


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("8d4d", "8d4d-0001"), ("FACE", "FACE-0001"), ("0X8d4d", "0X8d4d-0001"), ("8d4", "8d4"), ("8d4g", "8d4g"),
        ("8d4d 2", "8d4d 2"), ("palm", "palm-0001"), ("thumb", "thumb"), ("0x8", "0x8"), (None, None),
    ],
)  # fmt: skip
def test_a_name_is_no_other_nodes_and_looks_like_no_uuid(station: Station, name: str | None, shown: str | None) -> None:
    station.nodes.put(NodeRecord(C, name="palm"))
    station.nodes.put(NodeRecord(B, name="own name"))
    judge = _Judge(station, (), bundle(station))
    first, second = judge.judge_nodes([node(A, name=name), node(B, name=name)])
    assert (first.name, second.name) == (shown, "own name"), "a name that was given here stays"
    why = f"it is called {shown} here: {name} is the name of another node, or like a UUID"
    assert (first.notes, second.notes) == ((why,) if shown != name else (), ())


def test_two_nodes_of_a_bundle_have_two_names(station: Station) -> None:
    judge = _Judge(station, (), bundle(station))
    names = [planned.name for planned in judge.judge_nodes([node(A, name="palm"), node(B, name="palm")])]
    assert names == ["palm", "palm-0002"]


def judged(
    station: Station, *nodes: BundledNode, denied: tuple[Any, ...] = (), mode: str = "copy"
) -> list[tuple[str, str]]:
    judge = _Judge(station, denied, bundle(station, mode))
    return [(planned.decision, planned.why) for planned in judge.judge_nodes(nodes)]


def test_what_is_decided_for_a_node(station: Station) -> None:
    assert judged(station, node(A)) == [("new", "")]
    ban = SimpleNamespace(uuid=A, fingerprint=PIN, why="lost")
    assert judged(station, node(A), node(B), denied=(ban,)) == [("refused", "it is revoked: lost"), ("new", "")]
    other = SimpleNamespace(uuid=A, fingerprint="cd" * 32, why="lost")
    assert judged(station, node(A), denied=(other,)) == [("new", "")], "the ban of another key"
    station.policy.deny(RevocationRecord(C, None, "burnt", "s", AT))
    assert judged(station, node(C)) == [("refused", "it is revoked: burnt")]
    station.nodes.put(NodeRecord(A, epoch=3))
    assert judged(station, node(A, 3), node(B, 1)) == [("new", ""), ("new", "")]
    assert judged(station, node(A, 2))[0][1] == "its key epoch 2 is older than 3, which is known here"
    held = node(B, 4)
    station.keys.add(KeyRecord(B, 4, held.kid, "pending", 1, b"wrapped", "import", AT))
    assert judged(station, held) == [("same", "")]
    assert judged(station, node(B, 4, b"o" * 16)) == [("newer", "")], "of one epoch, neither proven"
    assert judged(station, node(B, 3, b"o" * 16))[0][1].startswith(
        "its key epoch 3 is older than 4, that of a key which"
    )
    station.policy.put_tombstone(Tombstone(B, SENDER, "old", AT))
    assert judged(station, held)[0][0] == "refused", "a copy brings nothing back"
    assert judged(station, held, mode="move") == [("new", "")]


def test_which_ca_is_known_without_the_bundle(station: Station) -> None:
    certified, trusted, neither = (SoftwareKey(number) for number in (72, 73, 74))
    station.identity.put_certificate(fingerprint(certified.point), station.fingerprint, bytes(64))
    station.policy.trust(TrustRecord("lab", "ca", trusted.point, fingerprint(trusted.point)))
    keys = (certified.point, trusted.point, station.ca, neither.point)
    assert [_is_known_ca(station, ca) for ca in keys] == [True, True, True, False]
    station.policy.end_ca(certified.point)
    assert not _is_known_ca(station, certified.point), "trust in it has ended"


@pytest.mark.parametrize("enabled", [True, False])
def test_the_collector_rests_while_rows_are_made_and_is_then_as_it_was(enabled: bool) -> None:
    def fails() -> None:
        with pause_gc():
            assert not gc.isenabled()
            raise BadDataError("The bundle is damaged.")

    try:
        if not enabled:
            gc.disable()
        with pytest.raises(BadDataError):
            fails()
        assert gc.isenabled() is enabled
    finally:
        gc.enable()


def test_who_is_proven(station: Station) -> None:
    for uuid, state in ((A, "active"), (B, "pending"), (C, "active")):
        station.keys.add(KeyRecord(uuid, 1, "01" * 8, state, 1, b"wrapped", "import", AT))  # type: ignore[arg-type]
    station.keys.put_flags({C: KeyFlags(rotation="why")})
    assert proven_of(station, [A, B, C]) == {A}
