"""What a station does with rosters and pages that came: its whitelist, deny list, claims and alarms, rule by rule."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision.handover import deny
from teds_provision.plant import apply_pages
from teds_provision.plant.apply_pages import apply_claims, merged_views, put_roster, take_pages, take_rosters
from teds_provision.protocol.handover.revocation import seal_revocation
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.page import open_page
from teds_provision.protocol.plant.roster import Place, Roster, Why, open_roster, seal_roster
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder, Tombstone, WhitelistEntry
from tests.bench import make_station
from tests.plant.plants import CA, NODES, NOW, REGISTRY, Speaker, roster_of, speaker

A, B, C = NODES
NODE = SoftwareKey(77)
PIN, OTHER = fingerprint(NODE.point), "cd" * 32


class Desk:
    """A station that takes in what four others say, of whom two are keepers."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self.keep, self.keep2 = speaker("keep", "keeper"), speaker("keep2", "keeper")
        self.line, self.base = speaker("line", "line", "sign"), speaker("base", "base")
        self.all = [self.keep, self.keep2, self.line, self.base]
        self.read: dict[str, int] = {}
        station.plant.put_record(PlantRecord(REGISTRY, mac=station.row_macs.note("plant", REGISTRY)))
        self.version = 0
        self.roster = self.next(self.all)

    def next(self, members: list[Speaker], *removed: tuple[Speaker, Place], why: Why = "stolen") -> Roster:
        """Have the next roster count here."""
        self.version += 1
        made = roster_of(members, removed, version=self.version)
        gone = tuple(replace(one, why=why) for one in made.removed)
        self.roster = open_roster(seal_roster(replace(made, removed=gone), CA), CA.point)
        put_roster(self.station, self.roster)
        self.apply()
        return self.roster

    def apply(self) -> None:
        """Take in every page that is new."""
        for one in self.all:
            for octets in one.pages[self.read.get(one.name, 0) :]:
                take_pages(self.station, self.roster, [open_page(octets, REGISTRY, self.roster.point_of)])
            self.read[one.name] = len(one.pages)
        apply_claims(self.station)

    def say(self, one: Speaker, *events: Mapping[str, Any], after: Place | None = None) -> Place:
        place = one.page(*events, after=after)
        self.apply()
        return place

    def pin(self, one: Speaker, key: str = PIN, uuid: bytes = A) -> Place:
        return self.say(one, one.event("pinned", uuid, fingerprint=key, assurance="tap"))

    def ban(
        self, signer: Speaker, uuid: bytes = A, key: str | None = PIN, about: bytes | None = None
    ) -> dict[str, Any]:
        """Return the event of a ban; ``about``: the statement names this node."""
        self.statement = seal_revocation(signer.key, uuid=about or uuid, node=key, why="lost", created=NOW)
        return signer.event("revoked", uuid, statement=self.statement.statement)

    def lift(self, one: Speaker) -> Place:
        return self.say(one, one.event("lifted", None, of=event.hash_of_statement(self.statement.statement)))

    def listed(self, uuid: bytes = A) -> tuple[str | None, str] | None:
        entry = self.station.pins.entry(uuid)
        return None if entry is None else (entry.fingerprint, entry.assurance)

    def denied(self, uuid: bytes = A) -> bool:
        return self.station.policy.revocation(uuid) is not None

    def alarms(self) -> list[tuple[str, str, int]]:
        return [(one.code, self.roster.name_of(one.about), one.n) for one in self.station.plant.alarms.all()]

    def names(self, uuid: bytes = A) -> str | None:
        return merged_views(self.station, self.roster, [uuid])[uuid].name


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    station = make_station(tmp_path / "home")
    station.unlock()
    monkeypatch.setattr(type(station.identity), "ca", property(lambda self: CA.point))
    yield Desk(station)
    station.close()


# -- rosters -----------------------------------------------------------------------------------------------------------


def later(desk: Desk, **changes: Any) -> bytes:
    """Return the next roster with changes, signed by the CA."""
    own = desk.station.plant.roster
    assert own is not None
    return seal_roster(replace(own, **{"version": own.version + 1, "previous": own.hash, **changes}), CA)


def test_a_roster_of_another_registry_is_none_of_ours(desk: Desk) -> None:
    foreign = later(desk, registry="00000000-0000-4000-8000-000000000000")
    assert take_rosters(desk.station, [foreign, b"junk", foreign[:-4]]) == []


def test_two_rosters_of_one_version_are_kept_both_and_are_an_alarm_until_a_later_version(desk: Desk) -> None:
    own = desk.roster
    twin = later(desk, version=own.version, previous=own.previous, name="another plant")
    [(_, how, _)] = take_rosters(desk.station, [twin])
    assert how == "two rosters"
    assert desk.station.plant.roster == own, "the one that was here goes on counting"
    assert sorted((row.version, row.held) for row in desk.station.plant.rosters()) == [(1, False), (1, True)]
    assert desk.alarms() == [("two-rosters", "", 1)]
    waiting = [text for _, _, text in desk.station.plant.outbox(9)]
    assert len(waiting) == 1
    assert '"act":"alarm"' in waiting[0]
    assert '"code":"two-rosters","about":null,"n":1' in waiting[0]
    take_rosters(desk.station, [twin])
    assert len(desk.station.plant.outbox(9)) == 1, "the same again is no news"
    [(_, how, _)] = take_rosters(desk.station, [later(desk, previous="0a" * 32)])
    assert how == "taken, two rosters"
    assert desk.alarms() == [("two-rosters", "", 2)], "that of version 1 has ended; version 2 follows another one"
    take_rosters(desk.station, [later(desk)])
    assert desk.alarms() == []


def test_an_older_roster_is_no_news_and_an_expired_one_is_taken(desk: Desk) -> None:
    first = desk.roster
    old = timedelta(days=300)
    [(_, how, _)] = take_rosters(desk.station, [later(desk, created=NOW - old, expires=NOW - old + timedelta(days=1))])
    assert how == "taken"
    assert take_rosters(desk.station, [first.octets]) == []


def test_the_certificates_of_members_are_kept_so_that_keys_can_be_handed_to_them(desk: Desk) -> None:
    for one in desk.all:
        assert desk.station.identity.certificate(CA.point, one.key.point) is not None
    new = speaker("new", "base")
    assert desk.station.identity.certificate(CA.point, new.key.point) is None
    desk.next([*desk.all, new])
    assert desk.station.identity.certificate(CA.point, new.key.point) is not None


def test_a_removal_ends_what_stands_beyond_the_last_page_and_no_more(desk: Desk) -> None:
    first = desk.say(desk.line, desk.line.event("named", A, name="left"))
    grouped = desk.line.event("grouped", B, group="hand", member=True)
    desk.say(desk.line, desk.line.event("named", A, name="right"), grouped)
    assert desk.names() == "right"
    desk.next([desk.keep, desk.keep2, desk.base], (desk.line, first))
    assert desk.names() == "left"
    assert merged_views(desk.station, desk.roster, [B])[B].groups == {}
    desk.next([desk.keep, desk.keep2, desk.base], (desk.line, (0, "")))
    assert desk.names() is None


def test_a_role_that_a_roster_gives_or_takes_counts_for_what_was_said_before(desk: Desk) -> None:
    desk.pin(desk.base)
    assert desk.listed() is None
    desk.base.roles = frozenset({"base", "keeper"})
    desk.next(desk.all)
    assert desk.listed() == (PIN, "registry")
    desk.base.roles = frozenset({"audit"})
    desk.next(desk.all)
    assert desk.listed() is None


# -- pages -------------------------------------------------------------------------------------------------------------


def test_of_a_fork_nothing_counts_but_its_bans(desk: Desk) -> None:
    first = desk.say(desk.keep, desk.keep.event("named", A, name="left"))
    desk.say(desk.keep, desk.keep.event("named", A, name="right"))
    assert (desk.names(), desk.alarms()) == ("right", [])
    desk.say(desk.keep, desk.ban(desk.keep), desk.keep.event("named", B, name="hand"), after=first)
    assert desk.alarms() == [("two-histories", "keep", 2)]
    assert (desk.names(), desk.names(B)) == ("left", None)
    assert desk.denied()
    desk.say(desk.keep, desk.ban(desk.keep, C), desk.keep.event("named", C, name="arm"))
    assert (desk.names(C), desk.denied(C)) == (None, True), "nor of a page that follows"
    desk.next([desk.keep2, desk.line, desk.base], (desk.keep, first))
    assert desk.alarms() == [], "the roster's last ends it"
    assert not desk.denied(), "a removed one's bans count up to its last page"


def test_an_event_whose_id_stood_before_is_skipped_and_reported(desk: Desk) -> None:
    first = desk.base.event("named", A, name="left")
    desk.say(desk.base, first, {**first, "name": "right"})
    assert (desk.names(), desk.alarms()) == ("left", [("bad-event", "base", 1)])
    desk.say(desk.base, {**desk.base.event("named", A, name="up"), "id": first["id"]}, {**first, "id": "x"})
    assert (desk.names(), desk.alarms()) == ("left", [("bad-event", "base", 1), ("bad-event", "base", 2)])
    [one, _] = desk.station.plant.alarms.all()
    assert one.why == "1 events were skipped: named: an id that stood before"
    desk.say(desk.line, {**desk.line.event("named", A, name="down"), "id": first["id"]})
    assert len(desk.alarms()) == 2, "an id is of one chain"


# -- the whitelist -----------------------------------------------------------------------------------------------------


def test_what_all_keepers_pin_is_on_the_whitelist_while_they_do(desk: Desk) -> None:
    desk.pin(desk.line, OTHER)
    assert desk.listed() is None
    desk.pin(desk.keep)
    assert desk.listed() == (PIN, "registry")
    desk.pin(desk.keep2, OTHER)
    assert desk.listed() is None
    desk.pin(desk.keep, OTHER)
    assert desk.listed() == (OTHER, "registry")
    desk.pin(desk.keep2, PIN)
    desk.pin(desk.keep, PIN)
    assert desk.listed() == (PIN, "registry")
    for one in (desk.keep, desk.keep2):
        assert desk.listed() == (PIN, "registry")
        desk.say(one, one.event("unpinned", A))
    assert desk.listed() is None


def test_a_keepers_new_pin_takes_the_place_of_the_one_before(desk: Desk) -> None:
    desk.pin(desk.keep)
    desk.say(desk.keep, desk.keep.event("named", B, name="x"))
    desk.pin(desk.keep, OTHER)
    assert desk.listed() == (OTHER, "registry")
    assert desk.station.plant.claims.conflicts(A) == [], "what the registry pinned is no pin of this station's own"


@pytest.mark.parametrize("assurance", ["tap", "bus", "uuid", "import"])
def test_an_own_entry_stays_whatever_keepers_pin_or_take_back(desk: Desk, assurance: Any) -> None:
    desk.station.pins.put(WhitelistEntry(A, OTHER, assurance=assurance))
    desk.pin(desk.keep)
    assert desk.listed() == (OTHER, assurance)
    assert [name for _, name, _ in desk.station.plant.claims.conflicts(A)] == ["other pin"]
    desk.say(desk.keep, desk.ban(desk.keep, key=None))
    desk.say(desk.keep, desk.keep.event("unpinned", A))
    assert desk.listed() == (OTHER, assurance)


def test_no_key_is_pinned_that_differs_from_the_one_that_the_node_showed_here(desk: Desk) -> None:
    desk.station.nodes.remember(A, point=NODE.point)
    desk.pin(desk.keep, OTHER)
    assert desk.listed() is None
    desk.pin(desk.keep)
    assert desk.listed() == (PIN, "registry")


def test_what_a_keeper_pins_is_no_word_of_this_station(desk: Desk) -> None:
    desk.pin(desk.keep)
    desk.say(desk.keep, desk.keep.event("unpinned", B))
    desk.pin(desk.line, OTHER)
    desk.next([desk.keep2, desk.line, desk.base], (desk.keep, (0, "")))
    assert desk.listed() is None
    seen = merged_views(desk.station, desk.roster, [A])[A]
    assert seen.conflicts == {}, "only the line names a key now"


@pytest.mark.parametrize(("assurance", "held_back"), [("tap", False), ("bus", False), ("uuid", True), ("import", True)])
def test_who_met_the_node_itself_sees_no_dispute(desk: Desk, assurance: Any, held_back: bool) -> None:
    desk.station.pins.put(WhitelistEntry(A, PIN, assurance=assurance))
    desk.pin(desk.line, OTHER)
    assert ("two keys" in merged_views(desk.station, desk.roster, [A])[A].conflicts) is held_back


# -- bans --------------------------------------------------------------------------------------------------------------


def test_a_banned_node_is_off_the_registrys_whitelist_and_on_it_again_when_all_bans_are_lifted(desk: Desk) -> None:
    desk.pin(desk.keep)
    desk.say(desk.keep, desk.ban(desk.keep))
    assert (desk.listed(), desk.denied()) == (None, True)
    desk.say(desk.keep2, desk.ban(desk.keep2))
    desk.lift(desk.keep2)
    assert desk.denied(), "each statement needs its own lifting"
    desk.statement = seal_revocation(desk.keep.key, uuid=A, node=PIN, why="lost", created=NOW)
    desk.lift(desk.base)
    assert desk.denied(), "no keeper"
    desk.lift(desk.keep2)
    assert (desk.listed(), desk.denied()) == ((PIN, "registry"), False)


def test_a_ban_counts_of_who_holds_or_was_given_the_nodes_key_by_the_own_store(desk: Desk) -> None:
    for uuid in (A, B, C):
        desk.say(desk.line, desk.ban(desk.line, uuid))
        assert not desk.denied(uuid)
    station = desk.station
    station.keys.put_holder(Holder(A, desk.line.fingerprint, "2026-01-31T12:00:00Z"))
    station.policy.put_tombstone(Tombstone(B, desk.line.fingerprint, "a handover"))
    station.policy.put_tombstone(Tombstone(C, desk.base.fingerprint, "a handover"))
    for uuid in (A, B, C):
        station.plant.claims.queue([uuid])
    apply_claims(station)
    assert [desk.denied(uuid) for uuid in (A, B, C)] == [True, True, False]


def test_a_statement_bans_the_node_that_it_names_not_the_one_of_its_event(desk: Desk) -> None:
    desk.say(desk.keep, desk.ban(desk.keep, A, about=B))
    assert (desk.denied(A), desk.denied(B)) == (False, False)


def test_of_many_nodes_a_few_are_judged_at_once_until_all_are(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    desk.next(desk.all)
    monkeypatch.setattr(apply_pages, "AT_ONCE", 2)
    for one in (desk.keep, desk.keep2):
        one.page(*(one.event("pinned", uuid, fingerprint=PIN, assurance="tap") for uuid in NODES))
        take_pages(desk.station, desk.roster, [open_page(one.pages[-1], REGISTRY, desk.roster.point_of)])
    assert (apply_claims(desk.station), apply_claims(desk.station)) == (3, 0)
    assert [desk.listed(uuid) for uuid in NODES] == [(PIN, "registry")] * 3


@pytest.mark.parametrize(("who", "ends"), [("base", False), ("line", True), ("keep", True)])
def test_a_ban_out_of_a_bundle_stays_until_a_keeper_or_its_signer_lifts_it(desk: Desk, who: str, ends: bool) -> None:
    desk.ban(desk.line)
    with desk.station.transaction():
        deny.deny(desk.station, desk.statement, key=None)
    desk.apply()
    assert desk.denied()
    desk.lift({"base": desk.base, "line": desk.line, "keep": desk.keep}[who])
    assert desk.denied() is not ends
