"""``nodes``: what the store knows, by UUID, prefix and name."""

from __future__ import annotations

from pathlib import Path

import pytest

from teds_provision.store import (
    Holder,
    KeyRecord,
    NodeRecord,
    Revocation,
    Store,
    Tombstone,
    WhitelistEntry,
)

from .shell import call

ONE, TWO = bytes.fromhex("8d4d9da65281f7000000"), bytes.fromhex("8d4e9da65281f7000001")
POINT = bytes.fromhex("04") + bytes(range(64))
STATION = "cd" * 32


@pytest.fixture
def known(home: Path) -> Path:
    """Two nodes: one in daily use, one that was moved away and revoked."""
    with Store.open(home) as store:
        store.put_node(
            NodeRecord(
                ONE,
                POINT,
                name="[b]finger[/]",
                profile="tactile-finger-sensor",
                state=2,
                epoch=3,
                sequence=7,
                can_address=0x21,
                groups=("hand",),
                verdict="authentic",
                last_seen="2026-01-31T12:00:00Z",
                channels=4,
            )
        )
        store.put_whitelist(WhitelistEntry(ONE, assurance="tap"))
        store.add_key(KeyRecord(ONE, 3, "ab" * 8, "active", 1, b"wrapped-secret"))
        store.add_key(KeyRecord(ONE, 4, "cd" * 8, "pending", 2, b"wrapped-secret"))
        store.put_holder(Holder(ONE, STATION))
        store.put_node(NodeRecord(TWO, POINT))
        store.put_tombstone(Tombstone(TWO, STATION, "an-id"))
        store.put_revocation(Revocation(TWO, None, "lost", "{}"))
    return home


def test_json_holds_all_that_is_known_but_no_key(known: Path) -> None:
    outcome = call(known, "--json", "nodes")
    one, two = outcome.json["nodes"]
    assert one | {"fingerprint": None, "keys": None, "holders": None} == {
        "uuid": ONE.hex(),
        "name": "[b]finger[/]",
        "profile": "tactile-finger-sensor",
        "state": "provisioned",
        "epoch": 3,
        "sequence": 7,
        "fingerprint": None,
        "whitelisted": True,
        "assurance": "tap",
        "verdict": "authentic",
        "last_seen": "2026-01-31T12:00:00Z",
        "channels": 4,
        "can_address": 0x21,
        "groups": ["hand"],
        "teds_sha256": None,
        "keys": None,
        "moved_to": None,
        "holders": None,
        "revoked": None,
    }
    assert len(one["fingerprint"]) == 64
    assert {key["key_id"]: key["state"] for key in one["keys"]} == {"ab" * 8: "active", "cd" * 8: "pending"}
    assert one["holders"][0]["fingerprint"] == STATION
    assert two["moved_to"] == {"fingerprint": STATION, "handover": "an-id"}
    assert two["revoked"]["why"] == "lost"
    assert "wrapped" not in outcome.out


@pytest.mark.parametrize("text", [ONE.hex(), "0x8D4D", "[b]finger[/]"])
def test_one_node_by_uuid_prefix_or_name(known: Path, text: str) -> None:
    assert [node["uuid"] for node in call(known, "--json", "nodes", text).json["nodes"]] == [ONE.hex()]
    shown = call(known, "nodes", text).out
    for part in ("[b]finger[/]", "0x21", "active, epoch 3", f"also held by {STATION[:16]}", "1 key pending"):
        assert part in shown


def test_people_see_a_table_with_what_is_odd(known: Path) -> None:
    shown = call(known, "nodes").out
    assert "revoked: lost; moved to cdcdcdcdcdcdcdcd; not whitelisted" in shown
    assert "authentic" in shown


def test_nothing_known_says_what_to_do(home: Path) -> None:
    assert "identify --add" in call(home, "nodes").out
    assert call(home, "--json", "nodes").json == {"nodes": []}
    unknown = call(home, "--json", "nodes", ONE.hex())
    assert (unknown.code, unknown.json["error"]["code"]) == (3, "not-found")
    assert call(home, "nodes", "nobody").code == 3


def test_a_node_that_is_only_whitelisted_can_be_asked_for(home: Path) -> None:
    call(home, "whitelist", "add", ONE.hex(), "--name", "spare")
    (node,) = call(home, "--json", "nodes", "spare").json["nodes"]
    assert (node["uuid"], node["name"], node["state"], node["assurance"]) == (ONE.hex(), "spare", None, "uuid")
