"""Joining, leaving, and what a keeper or a person decides (contract/plant.md sections 1, 2 and 8), rule by rule."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import NotAuthenticError, NotFoundError, PolicyError, RosterExpiredError
from teds_provision.handover import trust
from teds_provision.plant import membership
from teds_provision.plant.membership import accept, branch, disconnect, found_roster, request, vouch
from teds_provision.plant.transport import CarriedPage, Transport
from teds_provision.protocol.keys import SoftwareKey, to_pem
from teds_provision.protocol.plant.document import open_request
from teds_provision.protocol.plant.page import PageDraft, open_page, sign_page
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster
from teds_provision.station.station import Station, rewrap
from teds_provision.station.store.records import WhitelistEntry
from tests.bench import make_station
from tests.plant.owner import ALL, REGISTRY, alone, join, member, roster_of
from tests.plant.plants import NOW
from tests.plant.test_contract_states import H, held, others, paged

SECOND, DAY = timedelta(seconds=1), timedelta(hours=24)
UUID = bytes.fromhex("8d4d9da65281f7000000")


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    yield made
    made.close()


@pytest.fixture
def outsider(station: Station) -> Station:
    """A station of the owner that has joined no registry yet."""
    record = station.plant.joined
    assert record is not None
    station.plant.put_record(replace(record, left="2026-01-01T00:00:00Z"))
    assert station.plant.roster is None
    return station


def signed(station: Station, version: int, *members: Member, **changes: Any) -> Roster:
    named = members or (member(station, "owner", *ALL),)
    return roster_of(station, *named, version=version, previous="" if version == 1 else H, **changes)


def carrying(*rosters: Roster | bytes, carries_all: bool = True, pages: tuple[CarriedPage, ...] = ()) -> Transport:
    octets = [one.octets if isinstance(one, Roster) else one for one in rosters]
    return cast("Transport", SimpleNamespace(
        where="the stick", carries_all=carries_all, rosters=lambda: iter(octets), pages=lambda of, after: iter(pages),
    ))  # fmt: skip


# -- joining -----------------------------------------------------------------------------------------------------------


def test_the_newest_roster_that_names_this_station_is_joined(outsider: Station) -> None:
    stranger = Member(
        "west", SoftwareKey(5000).point, others(outsider, west="line")[0].certificate, frozenset({"line"})
    )
    first, third, ninth = signed(outsider, 1), signed(outsider, 3), signed(outsider, 9, stranger)
    assert found_roster(outsider, carrying(first, b"junk", third, ninth, signed(outsider, 2)), None) == third
    assert found_roster(outsider, carrying(third), first.octets) == first, "the file goes before the folder"
    for rosters in ((), (ninth,), (b"junk",)):
        with pytest.raises(NotFoundError, match="this owner's CA signed names this station"):
            found_roster(outsider, carrying(*rosters), None)
    with pytest.raises(NotFoundError):
        found_roster(outsider, carrying(third), ninth.octets)
    elsewhere = signed(outsider, 4, registry="00000000-0000-4000-8000-000000000000")
    with pytest.raises(PolicyError, match="contains rosters of 2 registries"):
        found_roster(outsider, carrying(third, elsewhere), None)
    with pytest.raises(NotAuthenticError):
        found_roster(outsider, carrying(), third.octets[:-6] + b"AAAAAA")


def test_a_station_with_another_ca_is_refused_by_policy(outsider: Station, tmp_path: Path) -> None:
    other = make_station(tmp_path / "other", "other")
    foreign = roster_of(other, member(other, "other", *ALL))
    other.close()
    for carried, octets in ((carrying(), foreign.octets), (carrying(b"junk", foreign), None)):
        with pytest.raises(PolicyError, match="signed by another CA than this station's") as error:
            found_roster(outsider, carried, octets)
        assert error.value.exit_code == 6
    own = signed(outsider, 2)
    assert found_roster(outsider, carrying(foreign, own), None) == own, "another owner's roster beside it does no harm"


@pytest.mark.parametrize(("ends", "joins"), [(SECOND, True), (timedelta(0), False), (-SECOND, False)])
def test_an_expired_roster_is_not_joined(
    outsider: Station, monkeypatch: pytest.MonkeyPatch, ends: timedelta, joins: bool
) -> None:
    made = signed(outsider, 2)
    monkeypatch.setattr(membership, "now", lambda: made.expires - ends)
    if joins:
        assert found_roster(outsider, carrying(made), None) == made
        return
    with pytest.raises(RosterExpiredError) as error:
        found_roster(outsider, carrying(made), None)
    assert error.value.exit_code == 6


def test_a_roster_of_more_than_a_day_ahead_is_not_joined_but_the_own_one_shows_the_time(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = station.plant.roster
    assert own is not None
    made = signed(station, 2, created=own.created + DAY)
    for ahead, joins in ((DAY, True), (DAY + SECOND, False)):
        monkeypatch.setattr(membership, "now", lambda ahead=ahead: made.created - ahead)
        if joins:
            assert found_roster(station, carrying(made), None) == made
        else:
            with pytest.raises(PolicyError, match=r"dated .*, in the future"):
                found_roster(station, carrying(made), None)
        assert found_roster(station, carrying(), None) == own


def test_a_request_stays_the_same_until_the_name_changes_or_a_wrong_clock_dated_it(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    station.unlock()
    first = request(station)
    assert request(station) == first
    asked = open_request(first)
    assert (asked.name, asked.point, asked.certificate) == (station.name, station.point, station.identity.signature)
    for ahead, same in ((DAY, True), (DAY + SECOND, False)):
        monkeypatch.setattr(membership, "now", lambda ahead=ahead: asked.created - ahead)
        again = request(station)
        assert (again == first) is same
        assert open_request(again).login == asked.login, "the login stays"


def test_half_a_login_is_none(station: Station) -> None:
    station.unlock()
    assert station.plant.login() is None
    request(station)
    kept = station.plant.login()
    assert kept is not None
    for name in ("registry-login", "registry-request"):
        [(value,)] = station._store.execute("SELECT value FROM meta WHERE name = ?", (name,))
        station._store.execute("DELETE FROM meta WHERE name = ?", (name,))
        assert station.plant.login() is None
        station._store.execute("INSERT INTO meta VALUES(?, ?)", (name, value))
        assert station.plant.login() == kept


def test_the_secret_of_the_login_is_kept_under_the_newest_master_key(station: Station) -> None:
    station.unlock()
    request(station)
    kept = station.plant.login()
    assert kept is not None
    for version in (1, 2):
        [(wrapped,)] = station._store.execute("SELECT value FROM meta WHERE name = 'registry-login'")
        assert str(wrapped).startswith(f"01{version:08x}")
        assert station.plant.login() == kept
        if version == 1:
            with station.lock("test"):
                rewrap(station)


def test_a_home_that_has_its_own_pages_again_keeps_no_mark_of_its_backup(station: Station) -> None:
    station.unlock()
    before = station.plant.record()
    station.plant.begin_restored()
    marked = station.plant.record()
    assert marked is not None
    assert None not in (marked.restored, marked.restored_mac)
    station.plant.end_restored()
    after = station.plant.record()
    assert after == before
    assert after is not None
    assert (after.restored, after.restored_mac) == (None, None)


def test_a_request_of_another_name_is_made_anew_with_the_same_login(station: Station) -> None:
    station.unlock()
    first = open_request(request(station))
    kept = station.plant.login()
    assert kept is not None
    station.plant.keep_login(kept[0], replace(first, name="an earlier name").signed(station.vault.identity()))
    again = open_request(request(station))
    assert (again.name, again.login) == (station.name, first.login)


def test_who_leaves_keeps_all_and_knows_no_place_any_more(station: Station) -> None:
    record = station.plant.joined
    assert record is not None
    station.plant.put_record(replace(record, url="postgresql://office/plant", acknowledged=7))
    disconnect(station)
    left = station.plant.record()
    assert left is not None
    assert (left.registry, left.url, left.acknowledged, station.plant.joined) == (REGISTRY, None, 7, None)
    assert left.left is not None
    assert station.plant.held_roster() is not None
    with pytest.raises(PolicyError, match="has joined no registry"):
        disconnect(station)


# -- a keeper's word ---------------------------------------------------------------------------------------------------


def test_only_a_keeper_vouches_and_once_for_a_datasheet(station: Station) -> None:
    found = [(UUID, H, "f" * 16), (UUID, "cd" * 32, "f" * 16)]
    own = station.plant.pages.chain(station.fingerprint)
    with station.transaction():
        station.plant.claims.put_digests(own, [(bytes.fromhex(H), 1, True), (bytes.fromhex("cd" * 32), 1, False)])
        station.plant.claims.put_digests(station.plant.pages.chain("9" * 64), [(bytes.fromhex("cd" * 32), 1, True)])
    assert vouch(station, found) == 1
    [(_, _, text)] = station.plant.outbox(9)
    assert '"act":"vouched"' in text
    assert f'"teds_sha256":"{"cd" * 32}"' in text, "another keeper's word and an own signature are no own word"
    join(station, roster_of(station, member(station, "owner", "line", "sign", "base"), version=2, previous=H))
    with pytest.raises(PolicyError, match="Only a keeper can vouch"):
        vouch(station, found)


# -- a person's choice between two histories ---------------------------------------------------------------------------

LIAR = SoftwareKey(5000)


@pytest.fixture
def forked(station: Station) -> tuple[Station, str, dict[str, str]]:
    """A station that has two pages 2 and 3 of west, and what their H is, by the home that wrote them."""
    from teds_provision.plant.apply_pages import take_pages

    (west,) = others(station, west="line")
    now = held(station, west)
    hashes: dict[str, str] = {}

    def page(n: int, previous: str, home: str) -> str:
        octets = sign_page(PageDraft(REGISTRY, n, previous, home * 16, NOW, {}, (1, H)), [], LIAR)
        made = open_page(octets, REGISTRY, lambda kid: LIAR.point)
        take_pages(station, now, [made])
        hashes[f"{home}{n}"] = made.hash
        return made.hash

    first = page(1, "", "a")
    for home in ("a", "b"):
        page(3, page(2, first, home), home)
    return station, west.fingerprint, hashes


def test_a_person_names_the_branch_by_its_hash_and_may_change_his_mind(
    forked: tuple[Station, str, dict[str, str]],
) -> None:
    station, west, hashes = forked
    assert station.plant.pages.chain(west).counted[0] == 1
    for digits in (hashes["a2"][:8], hashes["b2"].upper(), hashes["a2"][:16]):
        n, hash = accept(station, west, digits, None)
        home = "a" if hash == hashes["a2"] else "b"
        assert (n, hash) == (2, hashes[f"{home}2"])
        assert hash.startswith(digits.lower())
        assert station.plant.pages.chain(west).counted == (3, hashes[f"{home}3"])
        assert station.plant.pages.chain(west).accepted == (2, hash)
        entry = list(station.audit_log.entries())[-1]
        assert (entry.act, entry.uuid, entry.outcome, entry.detail) == (
            "registry", None, "accepted", {"station": west, "n": 2, "hash": hash}
        )  # fmt: skip
    for digits in (hashes["a3"], "0" * 8):
        with pytest.raises(PolicyError, match="Page 2 of west exists here twice") as error:
            branch(station, west, digits, None)
        assert error.value.hint == "Choose one: --page HASH"


def test_without_a_hash_the_branch_that_a_registry_shows_is_taken_and_a_folder_shows_none(
    forked: tuple[Station, str, dict[str, str]],
) -> None:
    station, west, hashes = forked
    chain = station.plant.pages.chain(west)
    pages = {row.hash: row for row in station.plant.pages.each(chain.id)}

    def shown(home: str) -> tuple[CarriedPage, ...]:
        from teds_provision.plant.apply_pages import octets_of

        return tuple(CarriedPage(west, n, octets_of(pages[hashes[f"{home}{n}"]])) for n in (2, 3))

    for home in ("b", "a"):
        there = carrying(carries_all=False, pages=shown(home))
        assert branch(station, west, None, there) == (2, hashes[f"{home}2"])
        assert branch(station, west, hashes["a2"], there) == (2, hashes["a2"]), "a person's word goes first"
    for transport in (carrying(pages=shown("a")), carrying(carries_all=False), None):
        with pytest.raises(PolicyError, match=f"twice: {', '.join(sorted(hashes[at][:16] for at in ('a2', 'b2')))}"):
            branch(station, west, None, transport)


def test_who_has_one_history_is_not_accepted(station: Station) -> None:
    (west,) = others(station, west="line")
    gone = RemovedMember("gone", SoftwareKey(7000).point, frozenset({"line"}), "lost", (0, ""))
    held(station, west, removed=(gone,))
    paged(station, west.fingerprint, 2, "2026-01-01T00:00:00Z")
    for of in (west.fingerprint, gone.fingerprint):
        with pytest.raises(NotFoundError, match="has only one history here"):
            branch(station, of, None, None)


# -- what the roster decides alone, and what a dispute holds back ------------------------------------------------------


def test_trust_in_a_key_that_the_roster_names_is_the_rosters(station: Station, tmp_path: Path) -> None:
    (west,) = others(station, west="line")
    gone = RemovedMember("gone", SoftwareKey(7000).point, frozenset({"line"}), "lost", (0, ""))
    held(station, west, removed=(gone,))
    for name, point in (("west", west.point), ("gone", gone.point), ("stranger", SoftwareKey(8000).point)):
        (tmp_path / f"{name}.pem").write_text(to_pem(point))
    for name in ("west", "gone"):
        with pytest.raises(PolicyError, match="is decided by the plant's roster") as error:
            trust.add(station, [trust.candidate(station, name, tmp_path / f"{name}.pem", "station")])
        assert error.value.exit_code == 6
    assert trust.add(station, [trust.candidate(station, "stranger", tmp_path / "stranger.pem", "station")]) == 1
    listed = {record.name: record for record in station.policy.listed()}
    assert set(listed) == {"west", "stranger"}, "members, and what was added; whom it removed is not trusted"
    with pytest.raises(PolicyError, match="is decided by the plant's roster"):
        trust.remove(station, listed["west"])
    trust.remove(station, listed["stranger"])
    assert [record.name for record in station.policy.listed()] == ["west"]


@pytest.mark.parametrize(
    ("conflict", "entry", "holds", "held_back"),
    [
        ("two keys", None, False, True),
        ("two holders", None, False, False),
        ("other pin", None, False, False),
        ("two keys", (H, "uuid"), False, False),
        ("two keys", (H, "tap"), False, False),
        ("two keys", (H, "registry"), False, True),
        ("two keys", (None, "uuid"), False, True),
        ("two keys", None, True, False),  # who has its key goes on
    ],
)
def test_two_keys_of_a_node_hold_back_who_would_key_it_for_the_first_time(
    station: Station, conflict: str, entry: tuple[str | None, Any] | None, holds: bool, held_back: bool
) -> None:
    if entry is not None:
        station.pins.put(WhitelistEntry(UUID, entry[0], assurance=entry[1]))
    if holds:
        station.keys.add_pending(UUID, key=bytes(16), key_id=bytes(8), epoch=1)
    station.plant.claims.put_conflicts({UUID: {conflict: "north and west name two keys"}})
    station.policy.require_undisputed(bytes(10))
    if not held_back:
        station.policy.require_undisputed(UUID)
        return
    with pytest.raises(PolicyError, match="north and west name two keys") as error:
        station.policy.require_undisputed(UUID)
    assert (error.value.exit_code, error.value.code) == (6, "conflict")
    assert f"whitelist add {UUID.hex()} --fingerprint F" in error.value.hint
    disconnect(station)
    station.policy.require_undisputed(UUID)
