"""Whom a station trusts and which nodes it refuses: names, prefixes, what ends what, and the words of each refusal."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime
from typing import Any

import pytest

from teds_provision.errors import NotWhitelistedError, PolicyError, UsageError, VaultLockedError
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster
from teds_provision.station.plant.plant import PlantConflictError
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    Handover,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    TrustRole,
    WhitelistEntry,
)
from teds_provision.station.store.store import Store

A, B = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("8d4d9da65281f7000002")
AT = "2026-10-01T08:00:00Z"
NORTH, SOUTH, WEST = (SoftwareKey(number).point for number in (81, 82, 83))


def trusted(name: str, point: bytes, role: TrustRole = "station", digits: str = "") -> TrustRecord:
    return TrustRecord(name, role, point, digits or fingerprint(point), AT)


def names(records: list[TrustRecord]) -> list[tuple[str, str]]:
    return [(record.name, record.role) for record in records]


# -- trust -------------------------------------------------------------------------------------------------------------


def test_a_key_is_trusted_under_one_name_in_each_role(station: Station) -> None:
    policy = station.policy
    for record in (trusted("west", WEST), trusted("north", NORTH), trusted("owner", NORTH, "ca")):
        policy.trust(record)
    assert names(policy.trusted()) == [("north", "station"), ("owner", "ca"), ("west", "station")]
    assert names(policy.trusted("station")) == [("north", "station"), ("west", "station")]
    assert names(policy.trusted("ca")) == [("owner", "ca")]
    assert policy.station_points() == {fingerprint(NORTH): NORTH, fingerprint(WEST): WEST}
    assert policy.trusted_stations() == [station.point, NORTH, WEST]
    assert policy.trusted_cas() == [station.ca, NORTH]
    policy.trust(trusted("nord", NORTH))
    assert names(policy.trusted()) == [("nord", "station"), ("owner", "ca"), ("west", "station")], "it is renamed"
    for taken in (trusted("west", SOUTH), trusted("west", WEST, "ca")):
        with pytest.raises(PolicyError) as caught:
            policy.trust(taken)
        assert caught.value.message == f"The name 'west' is already taken by the station {fingerprint(WEST)[:16]}."
    policy.trust(trusted("west", WEST))
    assert len(policy.trust_rows()) == 3


def test_trust_ends_by_name_or_by_16_digits_that_fit_one_key(station: Station) -> None:
    policy, one, two = station.policy, "ab" * 8 + "c0" * 24, "ab" * 8 + "c1" * 24
    rows = trusted("one", NORTH, "station", one), trusted("two", SOUTH, "ca", two), trusted("three", NORTH, "ca", one)

    def fresh() -> None:
        for record in policy.trust_rows():
            policy.distrust(record.name)
        for record in rows:
            policy.restore_trust(record)

    def left() -> list[str]:
        return [record.name for record in policy.trust_rows()]

    for text, gone in (
        ("two", ["two"]), (two, ["two"]), (f" {two[:18].upper()} ", ["two"]), (one[:18], ["one", "three"]),
        (one[:15], []), (two + "0", []), ("g" * 16, []), ("three ", []), ("four", []), ("cd" * 32, []),
    ):  # fmt: skip
        fresh()
        assert policy.distrust(text) is bool(gone), text
        assert left() == sorted({"one", "two", "three"} - set(gone)), text
    fresh()
    with pytest.raises(UsageError, match="matches 2 trusted keys"):
        policy.distrust("ab" * 8)
    assert left() == ["one", "three", "two"]


def test_a_ca_of_a_bundle_counts_for_its_node_until_that_is_ended(station: Station) -> None:
    policy = station.policy
    station.keys.set_ca_of(A, WEST)
    assert policy.trusted_cas(A) == [station.ca, WEST]
    assert policy.trusted_cas(B) == policy.trusted_cas() == [station.ca]
    policy.end_ca(WEST)
    assert (policy.counts(WEST), policy.counts(SOUTH)) == (False, True)
    assert policy.trusted_cas(A) == [station.ca]
    assert list(policy.ended_cas()) == [fingerprint(WEST)]
    policy.renew_ca(SOUTH)
    assert not policy.counts(WEST)
    policy.renew_ca(WEST)
    assert policy.trusted_cas(A) == [station.ca, WEST]
    policy.end_ca(WEST)
    policy.trust(trusted("west", WEST, "ca"))
    assert policy.counts(WEST), "who is trusted anew counts again"
    assert policy.trusted_cas(A) == [station.ca, WEST]


@pytest.mark.parametrize("change", ["name = 'west'", "role = 'ca'", "fingerprint = '" + "ab" * 32 + "'", "mac = NULL"])
def test_trust_that_another_program_changed_is_reported_and_does_not_count(
    station: Station, store: Store, change: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(station.policy, "_notify", told.append)
    station.policy.trust(trusted("north", NORTH))
    station.policy.trust(trusted("south", SOUTH))
    station.policy.end_ca(WEST)
    store.execute(f"UPDATE trust SET {change} WHERE name = 'north'")
    station.policy.unlocked()
    name = "west" if "west" in change else "north"
    assert told == [f"Trust in {name} was changed by another program and does not count."]
    assert names(station.policy.trusted()) == [("south", "station")]
    assert [record.name for record in station.policy.listed()] == sorted([name, "south"])
    assert [row[0] for row in station.policy.mac_rows()] == [f"trust in {each}" for each in sorted([name, "south"])]


def test_whom_a_station_believes_changes_only_with_an_open_vault(
    station: Station, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A row without a MAC of its own would count for nothing once the vault is open, or for too much."""
    policy, pins = station.policy, station.pins
    policy.trust(trusted("north", NORTH))
    pins.put(WhitelistEntry(A, fingerprint(WEST), AT, "tap", "elbow"))
    policy.deny(RevocationRecord(B, None, "stolen", "a.signed.ban", AT))

    def rows() -> list[list[tuple[Any, ...]]]:
        tables = ("trust", "whitelist", "revocations", "lifted", "ended_cas", "outbox", "station")
        return [store.execute(f"SELECT * FROM {table}") for table in tables]

    def closed() -> Any:
        raise VaultLockedError("The vault is locked.")

    before = rows()
    for change in (
        lambda: policy.trust(trusted("south", SOUTH)),
        lambda: policy.distrust("north"),
        lambda: policy.lift(B),
        lambda: pins.put(WhitelistEntry(B, fingerprint(WEST), AT, "tap", None)),
        lambda: pins.remove(A),
        lambda: pins.unpin(A),
        lambda: station.identity.complete(WEST, NORTH, bytes(64)),
    ):
        monkeypatch.setattr(station.row_macs, "_vault", closed)
        with pytest.raises(VaultLockedError):
            change()
        monkeypatch.undo()
    assert rows() == before
    assert policy.lift(A) is False, "without a ban nothing is to be decided"


def test_every_trusted_key_that_another_program_changed_is_named_up_to_five(
    station: Station, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(station.policy, "_notify", told.append)
    for number in range(7):
        station.policy.trust(trusted(f"s{number}", SoftwareKey(700 + number).point))
    for some, named in (("s0", "s0"), ("s3", "s0, s3"), ("s%", "s0, s1, s2, s3, s4")):
        store.execute(f"UPDATE trust SET mac = NULL WHERE name LIKE '{some}'")
        station.policy.unlocked()
        assert told.pop() == f"Trust in {named} was changed by another program and does not count."
    assert not [record for record in station.policy.trusted() if record.name.startswith("s")]


def test_decisions_that_another_program_wrote_do_not_count(
    station: Station, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    monkeypatch.setattr(station.policy, "_notify", told.append)
    station.unlock()
    policy, statement = station.policy, "a.signed.ban"
    digest = hashlib.sha256(statement.encode()).hexdigest()
    policy.restore_lifted(digest, None)
    policy.restore_ended_ca(fingerprint(WEST), bytes(16))
    assert not policy.was_lifted(statement)
    assert policy.counts(WEST)
    policy.unlocked()
    assert told == [
        f"Another program added the lifting of ban {digest[:16]}, the end of trust in CA {fingerprint(WEST)[:16]},"
        " which does not count."
    ]


def test_for_a_key_that_the_roster_names_the_roster_alone_decides(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = station.policy
    until = datetime(2026, 12, 1, tzinfo=UTC)
    here, south = (
        Member(name, point, b"", frozenset({"base"})) for name, point in (("me", station.point), ("b", SOUTH))
    )
    gone = RemovedMember("gone", WEST, frozenset({"base"}), "lost", (0, ""))
    for record in (
        trusted("c", NORTH), trusted("w", WEST), trusted("s", SOUTH), trusted("a-ca", WEST, "ca"),
        trusted("z", station.ca),
    ):  # fmt: skip
        policy.restore_trust(record)
    assert not policy.in_roster(fingerprint(SOUTH))
    roster = Roster("r", "plant", 1, "", datetime(2026, 3, 1, 12, tzinfo=UTC), until, (here, south), (gone,))
    monkeypatch.setattr(type(station.plant), "roster", property(lambda plant: roster))
    assert names(policy.listed()) == [("a-ca", "ca"), ("b", "station"), ("c", "station"), ("z", "station")]
    (member,) = (record for record in policy.listed() if record.name == "b")
    assert member == TrustRecord("b", "station", SOUTH, fingerprint(SOUTH), "2026-03-01T12:00:00Z")
    assert [policy.in_roster(fingerprint(point)) for point in (SOUTH, WEST, NORTH)] == [True, True, False]
    assert policy.trusted_stations() == [station.point, NORTH, station.ca]
    assert len(policy.trust_rows()) == 5


# -- refused nodes -----------------------------------------------------------------------------------------------------

KEY, OTHER = "aa" * 32, "bb" * 32


def ban(uuid: bytes = A, key: str | None = KEY, statement: str = "h.p.s") -> RevocationRecord:
    return RevocationRecord(uuid, key, "lost", statement, AT)


@pytest.mark.parametrize(
    ("banned", "asked", "denied"),
    [
        (KEY, KEY, True),
        (KEY, OTHER, False),
        (KEY, None, True),
        (None, KEY, True),
        (None, None, True),
        (KEY, KEY[:32], True),
        (KEY, OTHER[:32], False),
    ],
)
def test_a_ban_is_of_the_key_that_it_names(
    station: Station, banned: str | None, asked: str | None, denied: bool
) -> None:
    station.policy.deny(ban(key=banned))
    assert (station.policy.denied(A, asked) is not None) is denied
    assert station.policy.denied(B, asked) is None


def test_the_deny_list(station: Station) -> None:
    policy = station.policy
    policy.deny(ban(B))
    policy.deny(ban(A, None))
    policy.deny(ban(A, OTHER, "x.y.z"))
    assert policy.revocations() == [ban(A, OTHER, "x.y.z"), ban(B)]
    assert policy.revocations_of([B, bytes(10)]) == {B: ban(B)}
    assert (policy.revocation(A), policy.revocation(bytes(10))) == (ban(A, OTHER, "x.y.z"), None)
    assert (policy.forgive(A), policy.forgive(A)) == (True, False)
    assert policy.revocations() == [ban(B)]
    assert policy.lifted() == {}, "others lifted it, no person here"


def test_a_ban_that_a_person_lifts_stays_lifted_by_both_of_its_digests(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[str, dict[str, Any]]] = []
    monkeypatch.setattr(station.plant, "record_event", lambda act, uuid=None, **more: told.append((act, more)))
    policy = station.policy
    policy.deny(ban(A, KEY, "h.p.s"))
    policy.deny(ban(B, KEY, "h.q.s"))
    assert policy.lift(A)
    whole, signed = (hashlib.sha256(text).hexdigest() for text in (b"h.p.s", b"h.p"))
    assert set(policy.lifted()) == {whole, signed}
    assert told == [("lifted", {"of": signed})]
    assert policy.revocations() == [ban(B, KEY, "h.q.s")]
    assert [policy.was_lifted(text) for text in ("h.p.s", "h.p.t", "h.q.s")] == [True, True, False]
    assert not policy.lift(A)
    assert len(told) == 1


def test_nodes_given_away_are_listed_until_they_are_taken_back(station: Station) -> None:
    policy = station.policy
    one, two = Tombstone(A, "f1" * 32, "h1", AT), Tombstone(B, "f2" * 32, "h2", AT)
    policy.put_tombstone(two, one)
    assert policy.tombstones() == [one, two]
    policy.put_tombstone(replace(one, handover_id="h3"))
    assert (policy.tombstone(A), policy.tombstone(bytes(10))) == (replace(one, handover_id="h3"), None)
    policy.take_back([A, bytes(10)])
    assert policy.tombstones() == [two]


REVOKED = f"Node {A.hex()} was revoked: lost."
AWAY = f"Node {A.hex()} was moved to station f1f1f1f1f1f1f1f1; its key is no longer used here."
UNLISTED = f"Node {A.hex()} is not on the whitelist."
LIST_IT = f"Add it: teds-provision whitelist add {A.hex()}"
LIFT_IT = f"If that was a mistake: teds-provision revoke --lift {A.hex()}"
UNDO = "Use it there, or: teds-provision handover undo h1"
BACK = "Use it there, or have it handed back (export-keys there, import-keys here)."


@pytest.mark.parametrize(
    ("listed", "banned", "moved", "returning", "why"),
    [
        ("", False, "", False, (UNLISTED, LIST_IT)),
        (KEY, False, "", False, None),
        (KEY, True, "", False, (REVOKED, LIFT_IT)),
        (OTHER, True, "", False, None),  # the ban is of another key
        ("", True, "open", False, (REVOKED, LIFT_IT)),
        (KEY, True, "open", True, (REVOKED, LIFT_IT)),
        (KEY, False, "open", False, (AWAY, UNDO)),
        (KEY, False, "closed", False, (AWAY, BACK)),
        (KEY, False, "unknown", False, (AWAY, BACK)),
        ("", False, "open", False, (AWAY, UNDO)),
        (KEY, False, "open", True, None),
        ("", False, "open", True, (UNLISTED, LIST_IT)),
    ],
)
def test_a_node_is_met_if_it_is_listed_not_revoked_and_not_given_away(
    station: Station, listed: str, banned: bool, moved: str, returning: bool, why: tuple[str, str] | None
) -> None:
    if listed:
        station.pins.put(WhitelistEntry(A, listed, AT, "tap"))
    if banned:
        station.policy.deny(ban())
    if moved:
        station.policy.put_tombstone(Tombstone(A, "f1" * 32, "h1", AT))
    if moved in ("open", "closed"):
        station.handovers.put(Handover("h1", "out", "move", ("f1" * 32,), moved, "{}", created=AT))
    ask: Callable[[], WhitelistEntry] = lambda: station.policy.require_whitelisted(A, returning=returning)  # noqa: E731
    if why is None:
        assert ask().uuid == A
        return
    with pytest.raises((PolicyError, NotWhitelistedError)) as caught:
        ask()
    assert (caught.value.message, caught.value.hint) == why
    assert isinstance(caught.value, NotWhitelistedError) is (why[0] == UNLISTED)


def test_a_key_that_came_from_a_backup_waits_for_a_person(station: Station) -> None:
    station.policy.require_not_restored(A)
    station.keys.demand_rotation(A, "of another owner")
    station.policy.require_not_restored(A)
    station.keys.demand_rotation(A, "restored from a backup of 2026-03-01")
    with pytest.raises(PolicyError) as caught:
        station.policy.require_not_restored(A)
    assert caught.value.message == f"The key of node {A.hex()} was restored from a backup of 2026-03-01."
    station.policy.require_not_restored(B)


TWO_KEYS = {"two keys": "north and west"}


@pytest.mark.parametrize(
    ("joined", "conflicts", "entry", "held", "refused"),
    [
        (True, TWO_KEYS, None, False, True),
        (False, TWO_KEYS, None, False, False),
        (True, {}, None, False, False),
        (True, {"other pin": "why", "two holders": "why"}, None, False, False),
        (True, TWO_KEYS | {"other pin": "why"}, None, False, True),
        (True, TWO_KEYS, None, True, False),  # it was keyed here before
        (True, TWO_KEYS, WhitelistEntry(A, KEY, AT), False, False),  # a person here pinned one of them
        (True, TWO_KEYS, WhitelistEntry(A, None, AT), False, True),
        (True, TWO_KEYS, WhitelistEntry(A, KEY, AT, "registry"), False, True),
    ],
)
def test_a_node_with_two_keys_in_the_plant_is_not_keyed_for_the_first_time(
    station: Station,
    monkeypatch: pytest.MonkeyPatch,
    joined: bool,
    conflicts: dict[str, str],
    entry: WhitelistEntry | None,
    held: bool,
    refused: bool,
) -> None:
    station.plant.claims.put_conflicts({A: conflicts, B: TWO_KEYS})
    if entry is not None:
        station.pins.restore([entry])
    if held:
        station.keys.add_pending(A, key=bytes(16), key_id=bytes(8), epoch=1)
    monkeypatch.setattr(type(station.plant), "joined", property(lambda plant: object() if joined else None))
    if not refused:
        station.policy.require_undisputed(A)
        return
    with pytest.raises(PlantConflictError) as caught:
        station.policy.require_undisputed(A)
    assert caught.value.message == f"The plant's stations know two keys for node {A.hex()}: north and west."
