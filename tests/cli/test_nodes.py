"""``nodes``: what the store knows, by UUID, prefix and name."""

from __future__ import annotations

import csv
import json
from datetime import date
from pathlib import Path
from typing import Any

import pytest

from teds_provision.cli.node import nodes as listing
from teds_provision.station.nodes import Nodes
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    Group,
    Holder,
    KeyRecord,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    WhitelistEntry,
)
from tests.terminal import on_terminal

from .shell import call, python

ONE, TWO = bytes.fromhex("8d4d9da65281f7000000"), bytes.fromhex("8d4e9da65281f7000001")
POINT = bytes.fromhex("04") + bytes(range(64))
STATION = "cd" * 32


@pytest.fixture
def known(home: Path) -> Path:
    """Return two nodes: one in daily use, one that was moved away and revoked."""
    with Station.inspect(home) as store:
        store.nodes.restore(
            NodeRecord(
                ONE,
                POINT,
                name="[b]finger[/]",
                profile="tactile-finger-sensor",
                state=2,
                epoch=3,
                sequence=7,
                can_address=0x21,
                last_seen="2026-01-31T12:00:00Z",
                channels=4,
            )
        )
        store.groups.put(Group("hand", (ONE,)))
        store.pins.restore([WhitelistEntry(ONE, assurance="tap")])
        store.keys.add(KeyRecord(ONE, 3, "ab" * 8, "active", 1, b"wrapped-secret"))
        store.keys.add(KeyRecord(ONE, 4, "cd" * 8, "pending", 2, b"wrapped-secret"))
        store.keys.put_holder(Holder(ONE, STATION))
        store.nodes.restore(NodeRecord(TWO, POINT))
        store.policy.put_tombstone(Tombstone(TWO, STATION, "an-id"))
        store.policy.deny(RevocationRecord(TWO, None, "lost", "{}"))
    return home


def test_json_holds_all_that_is_known_but_no_key(known: Path) -> None:
    outcome = call(known, "--json", "nodes")
    first, second = outcome.json["nodes"]
    assert first | {"fingerprint": None, "keys": None, "holders": None} == {
        "uuid": ONE.hex(),
        "name": "[b]finger[/]",
        "profile": "tactile-finger-sensor",
        "state": "provisioned",
        "epoch": 3,
        "sequence": 7,
        "fingerprint": None,
        "whitelisted": True,
        "assurance": "tap",
        "verdict": None,
        "reading": None,
        "retired": None,
        "last_seen": "2026-01-31T12:00:00Z",
        "channels": 4,
        "can_address": 0x21,
        "group": "hand",
        "groups": ["hand"],
        "due": None,
        "charging": None,
        "rotation_due": None,
        "teds_sha256": None,
        "keys": None,
        "moved_to": None,
        "holders": None,
        "revoked": None,
        "wrapped": None,
        "firmware": None,
    }
    assert len(first["fingerprint"]) == 64
    assert {key["key_id"]: key["state"] for key in first["keys"]} == {"ab" * 8: "active", "cd" * 8: "pending"}
    assert first["holders"][0]["fingerprint"] == STATION
    assert second["moved_to"] == {"fingerprint": STATION, "handover": "an-id"}
    assert second["revoked"]["why"] == "lost"
    assert not any("wrapped" in key for node in (first, second) for key in node["keys"]), (
        "a key, even sealed, stays here"
    )


@pytest.mark.parametrize("text", [ONE.hex(), "0x8D4D", "[b]finger[/]"])
def test_one_node_by_uuid_prefix_or_name(known: Path, text: str) -> None:
    assert [node["uuid"] for node in call(known, "--json", "nodes", text).json["nodes"]] == [ONE.hex()]
    shown = call(known, "nodes", text).out
    for part in ("[b]finger[/]", "0x21", "active, epoch 3", f"also held by {STATION[:16]}", "1 key pending"):
        assert part in shown


@pytest.mark.parametrize("text", [ONE.hex(), "8d4d", "[b]finger[/]"])
def test_one_node_is_shown_without_a_look_at_all_others(
    known: Path, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There may be 100,000."""

    def looked(_nodes: Nodes) -> None:
        raise AssertionError("all nodes are read")

    monkeypatch.setattr(Nodes, "all", looked)
    monkeypatch.setattr(Nodes, "names", looked)
    assert ONE.hex() in call(known, "nodes", text).out


def test_people_see_a_table_with_what_is_odd(known: Path) -> None:
    shown = call(known, "nodes").out
    assert "revoked: lost; moved to cdcdcdcdcdcdcdcd; not whitelisted" in shown


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


@pytest.fixture
def fleet(home: Path) -> Path:
    """Five nodes in five ways known: met, listed, brought by a bundle, moved away, out of service."""
    with Station.inspect(home) as store:
        for number in range(5):
            uuid = bytes([number]) * 10
            store.nodes.restore(
                NodeRecord(
                    uuid,
                    POINT,
                    name=f"finger-{number}",
                    profile="load-cell" if number % 2 else "tactile-finger-sensor",
                    state=number % 3,
                    last_seen=f"2026-0{number + 1}-01T00:00:00Z",
                    due=f"2026-0{number + 1}-15",
                )
            )
        store.nodes.restore(NodeRecord(b"\xaa" * 10, POINT, state=2, name="imported"))  # never seen here
        store.groups.put(Group("left hand", (bytes(10), b"\1" * 10)))
        store.policy.put_tombstone(Tombstone(b"\2" * 10, STATION, "an-id"))
    return home


@pytest.mark.parametrize(
    ("words", "names"),
    [
        (["INGER-3"], ["finger-3"]),
        (["load"], ["finger-1", "finger-3"]),
        (["0303"], ["finger-3"]),
        (["--state", "keyed"], ["finger-1", "finger-4"]),
        (["--state", "moved"], ["finger-2"]),
        (["--profile", "load-cell"], ["finger-1", "finger-3"]),
        (["--group", "left hand"], ["finger-0", "finger-1"]),
        (["--since", "2026-04-01"], ["finger-3", "finger-4"]),
        (["imp"], ["imported"]),
        (["finger", "--state", "factory", "--group", "left hand"], ["finger-0"]),
    ],
    ids=str,
)
def test_nodes_are_found_by_every_part(fleet: Path, words: list[str], names: list[str]) -> None:
    assert [node["name"] for node in call(fleet, "--json", "nodes", *words).json["nodes"]] == names


def test_a_filter_that_nothing_fits_is_not_taken_for_an_empty_store(fleet: Path) -> None:
    """It said that no nodes are known yet, and to tap one."""
    for words in (["--group", "nowhere"], ["--profile", "no-such-type"], ["--since", "2099-01-01"]):
        outcome = call(fleet, "nodes", *words)
        assert (outcome.code, outcome.out.startswith("No known node matches.")) == (0, True), outcome


def test_due_counts_days_from_today_and_what_is_overdue(fleet: Path) -> None:
    ahead = (date(2026, 3, 15) - date.today()).days
    found = call(fleet, "--json", "nodes", "--due", str(max(ahead, 0))).json["nodes"]
    assert {"finger-0", "finger-1", "finger-2"} <= {node["name"] for node in found}
    assert all(node["due"] for node in found)


def test_a_narrow_terminal_drops_columns_and_never_a_digit(fleet: Path) -> None:
    for columns in (80, 60, 40, 24):
        outcome = on_terminal(fleet, "nodes", streams=["stdin", "stdout"], columns=columns)
        assert outcome.code == 0
        lines = outcome.screen.splitlines()
        assert all(len(line) <= columns for line in lines)
        assert sum(("aa" * 10) in line for line in lines) == 1, columns
        assert ("remarks" in lines[0]) == (columns >= 80), lines[0]


def test_people_find_nodes_in_the_order_of_their_names(fleet: Path) -> None:
    with Station.inspect(fleet) as store:
        store.nodes.restore(NodeRecord(b"\x01" + b"\xbb" * 9, POINT, name="Finger-10"))
        store.nodes.restore(NodeRecord(b"\x00" + b"\xbb" * 9, POINT))
    listed = call(fleet, "nodes").out.splitlines()[1:]
    names = [line.split()[1] for line in listed[:-1]]
    assert names == [*(f"finger-{number}" for number in range(5)), "Finger-10", "imported"]
    assert listed[-1].startswith("00bb"), "those without a name come last"
    scripts = [node["uuid"] for node in call(fleet, "--json", "nodes").json["nodes"]]
    assert scripts == sorted(scripts)


def test_csv_and_json_hold_the_same_nodes(fleet: Path) -> None:
    rows = list(csv.DictReader(call(fleet, "nodes", "--format", "csv").out.splitlines()))
    listed = json.loads(call(fleet, "nodes", "--format", "json").out)["nodes"]
    assert [row["uuid"] for row in rows] == [node["uuid"] for node in listed]
    assert len(rows) == 6


@pytest.mark.parametrize("text", ["soon", "2026-13-01", "99999999h", ""])
def test_a_time_that_is_none_is_usage(home: Path, text: str) -> None:
    assert call(home, "nodes", "--since", text).code == 2


def test_listing_loads_no_cryptography_and_decodes_no_teds(home: Path) -> None:
    """They cost more than the list itself."""
    heavy = ("cryptography", "numpy", "rich", "argon2", "teds_provision.teds.codec.decode", "xml.sax")
    script = (
        "import sys; from teds_provision.cli.main import run\n"
        f"for words in (['nodes'], ['log', '--last', '1']): run(['--home', {str(home)!r}, *words])\n"
        f"print([name for name in {heavy!r} if name in sys.modules])"
    )
    assert python(script).out.splitlines()[-1] == "[]"


def test_a_mistyped_name_is_guessed(fleet: Path) -> None:
    for typed, meant in (("fingr-3", "'finger-3'"), ("IMPORT", "'imported'")):
        error = call(fleet, "--json", "whitelist", "remove", typed, "--yes").json["error"]
        assert (error["code"], f"Did you mean {meant}" in error["hint"]) == ("not-found", True), error
    assert "Did you mean" not in call(fleet, "--json", "group", "create", "x", "zzzz").json["error"]["hint"]


FIRMWARE = {
    "text": "loadcell/app",
    "version": "1.2.3",
    "build": 4,
    "image": "ab" * 32,
    "state": "good",
    "from": "session",
    "changed": False,
}
PLAIN: dict[str, Any] = {
    "wrapped": None,
    "firmware": FIRMWARE,
    "revoked": None,
    "moved_to": None,
    "whitelisted": True,
    "rotation_due": None,
    "holders": [],
    "keys": [{"state": "active"}],
    "verdict": "authentic",
    "retired": None,
    "reading": {"from": "session", "at": "2026-01-31T12:00:00Z", "by": "verify"},
}


def test_what_is_odd_about_a_node_is_remarked() -> None:
    for odd, remarks in (
        ({}, ""),
        ({"firmware": None}, ""),
        ({"firmware": {**FIRMWARE, "state": "bad"}}, "firmware bad"),
        ({"firmware": {**FIRMWARE, "state": "other"}}, "firmware other"),
        ({"firmware": {**FIRMWARE, "state": "outdated"}}, "firmware outdated"),
        ({"firmware": {**FIRMWARE, "state": "not-reported"}}, "firmware not-reported"),
        ({"firmware": {**FIRMWARE, "state": "on-trial"}}, ""),
        ({"firmware": {**FIRMWARE, "state": "pending"}}, ""),
        ({"firmware": {**FIRMWARE, "state": "unjudged"}}, ""),
        ({"firmware": {**FIRMWARE, "changed": True}}, "firmware changed since calibration"),
        ({"wrapped": {"name": "scale", "kind": "canopen"}}, "wrapped: scale (canopen)"),
        ({"revoked": {"why": "lost"}, "whitelisted": False}, "revoked: lost; not whitelisted"),
        ({"moved_to": {"fingerprint": "cd" * 32}}, "moved to cdcdcdcdcdcdcdcd"),
        ({"rotation_due": "it was handed over"}, "rotation due"),
        (
            {"holders": [{"fingerprint": "cd" * 32}, {"fingerprint": "ef" * 32}]},
            "also held by cdcdcdcdcdcdcdcd, efefefefefefefef",
        ),
        ({"keys": [{"state": "active"}, {"state": "pending"}]}, "1 key pending"),
        ({"keys": [{"state": "pending"}, {"state": "pending"}]}, "2 keys pending"),
    ):
        assert listing._remarks(PLAIN | odd) == remarks, odd


def test_a_verdict_is_told_with_what_it_is_judged_from(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listing, "local_time", lambda text: f"<{text}>")
    at = "<2026-01-31T12:00:00Z>"
    for read, more, text in (
        ("session", {}, f"authentic (read in a session {at}, by verify)"),
        ("plain", {"verdict": "unproven"}, f"unproven (read without a session {at}, by verify)"),
        ("kept", {}, f"authentic (Security TEDS read in a session, the rest from the stored copy {at}, by verify)"),
        ("session", {"retired": "revoked"}, f"revoked; authentic (read in a session {at}, by verify)"),
        (None, {"verdict": None}, "never verified"),
        (None, {"verdict": "unverified"}, "unverified"),
        (None, {"verdict": "unverified", "retired": "decommissioned"}, "decommissioned"),
    ):
        reading = None if read is None else {**PLAIN["reading"], "from": read}
        assert listing._verdict({**PLAIN, **more, "reading": reading}) == text
    charging = {"text": "wanted, 12 %", "at": "2026-01-31T12:00:00Z"}
    assert listing._charge(charging) == f"wanted, 12 % (reported by the node at {at})"
    assert listing._charge(None) == ""


def test_a_long_cell_is_cut_with_a_mark_at_its_edge() -> None:
    cells = [(text, listing._cut(text, limit)) for text, limit in (("12345", 5), ("123456", 5), ("123456", None))]
    assert cells == [("12345", "12345"), ("123456", "1234…"), ("123456", "123456")]
