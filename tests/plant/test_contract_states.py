"""What contract/plant.md says of times and states, at the very edge; and its numbers, as literals."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotFoundError, PolicyError, UsageError
from teds_provision.handover import deny
from teds_provision.plant import (
    apply_pages,
    doctor,
    folder_transport,
    jobs,
    line,
    office,
    owner,
    parcels,
    postgres,
    removed_members,
    schema,
    scram,
    service,
    sign_requests,
    status,
    transport,
)
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.plant import evidence, job, roster, sharing, signing
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.document import MemberRequest
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster, Share
from teds_provision.station.plant.pages import PageRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder, TrustRecord, WhitelistEntry
from tests.cli.shell import call
from tests.plant.owner import ALL, alone, ca_of, join, member, roster_of
from tests.plant.stations import LOGIN

NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)
NODE = bytes.fromhex("8d4d9da65281f7000000")
H = "ab" * 32
SECOND = timedelta(seconds=1)


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    yield made
    made.close()


def others(station: Station, **names: str) -> list[Member]:
    """Return members with these roles, certified by the station's CA."""
    ca = ca_of(station).ca()
    assert ca is not None
    keys = {name: SoftwareKey(5000 + number) for number, name in enumerate(names)}
    return [
        Member(name, key.point, ca.sign(station_key_message(key.point)), frozenset(names[name].split()))
        for name, key in keys.items()
    ]


def held(station: Station, *members: Member, **changes: Any) -> Roster:
    now = roster_of(station, member(station, "owner", *ALL), *members, version=2, previous=H, **changes)
    join(station, now)
    return now


def paged(station: Station, of: str, n: int, created: str, hash: str = H) -> None:
    """Have pages up to number n of a station here, the newest made then."""
    with station.transaction():
        chain = station.plant.pages.chain(of)
        station.plant.pages.add(chain.id, PageRow(n, hash, "", created, "", b"", b"{}", bytes(64)))
        station.plant.pages.put_chain(replace(chain, counted=(n, hash), folded=(n, hash)))


def test_the_numbers_of_the_contract() -> None:
    """Other tests reach these limits by the names of the constants: here they are what the contract says."""
    day = timedelta(days=1)
    numbers: dict[str, tuple[object, object]] = {
        "a roster lasts 90 days by default": (roster.USUAL, timedelta(days=90)),
        "its end is near from 14 days before": (roster.WARN_BEFORE, timedelta(days=14)),
        "what is dated more than 24 hours ahead is not taken": (roster.MOST_AHEAD, day),
        "a station is silent after 7 days": ((sharing.SILENT, status.SILENT), (7 * day, 7 * day)),
        "10,000 nodes go into a bundle": (parcels.NODES, 10_000),
        "a parcel lasts 7 days": ((parcels.DAYS, sign_requests.DAYS), (7, 7)),
        "others rotate after 24 hours": (removed_members.OTHERS, day),
        "16 answers a unit": (office.MOST_ANSWERS, 16),
        "a request may be 65535 ahead": (office.MOST_JUMP, 65_535),
        "nonces have 16 octets": ((evidence.NONCE_OCTETS, signing.NONCE_OCTETS), (16, 16)),
        "a service asks each minute": (service.EVERY, 60),
        "it writes a page each day": (service._EMPTY_PAGE, 86_400),
        "64 MiB are the largest parcel": (folder_transport.LARGEST_PARCEL, 67_108_864),
        "8 MiB, and 16 at once": ((transport.SMALL, transport.AT_ONCE), (8_388_608, 16)),
        "boards of a list, stations, read-only TEDS": (
            (job.MOST_BOARDS, job.MOST_STATIONS, job.MOST_READ_ONLY), (32_768, 256, 2_000)
        ),
        "which assurance is worth more": (
            dict(job.WORTH), {"uuid": 0, "import": 0, "registry": 0, "bus": 1, "tap": 2}
        ),
        "why an office signs nothing": (
            set(signing.REFUSALS),
            {"not-line", "job", "full", "other-key", "proof", "differs", "guard", "sequence", "revoked"},
        ),
        "a parcel out of a line waits for 31 days": (parcels._DAYS_OF_A_LINE, 31),
        "removals are looked at each hour": (removed_members.EVERY, timedelta(hours=1)),
        "connecting, and a statement": ((postgres.CONNECTING, postgres.STATEMENT), (10, 60)),
        "a login has a secret of 32 octets": ((scram.SECRET_OCTETS, scram._ITERATIONS), (32, 4096)),
        "a login has six connections": ((schema.VERSION, schema.CONNECTIONS), (2, 6)),
        "a calibration and a profile of a job": (
            (office._MAX_CALIBRATION, line._MAX_CALIBRATION, jobs._MAX_PROFILE_OCTETS), (1_048_576,) * 3
        ),
        "the first member": (owner.FIRST_ROLES, {"keeper", "sign", "line", "base"}),
    }  # fmt: skip
    assert {what: one for what, (one, _) in numbers.items()} == {what: due for what, (_, due) in numbers.items()}


# -- the roster's time -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("left", "soon", "over"),
    [
        (timedelta(days=14) + SECOND, False, False),
        (timedelta(days=14), True, False),
        (SECOND, True, False),
        (timedelta(0), True, True),
        (-SECOND, True, True),
    ],
)
def test_a_roster_warns_from_14_days_before_its_end_and_is_over_at_it(
    station: Station, monkeypatch: pytest.MonkeyPatch, left: timedelta, soon: bool, over: bool
) -> None:
    now = station.plant.roster
    record = station.plant.joined
    assert now is not None
    assert record is not None
    monkeypatch.setattr(status, "now", lambda: now.expires - left)
    found = status.status(station, record, now)
    assert (found.expires_soon, found.expired, found.exit_code) == (soon, over, 6 if over else 0)
    finding = doctor._roster(now, now.expires - left)
    assert finding.result == ("failed" if over else "warning" if soon else "ok")


def test_the_moment_of_a_clock_before_the_roster_is_that_of_the_roster(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = station.plant.roster
    assert now is not None
    for clock, moment in ((-SECOND, timedelta(0)), (SECOND, SECOND)):
        monkeypatch.setattr(status, "now", lambda clock=clock: now.created + clock)
        assert status.moment(now) == now.created + moment


@pytest.mark.parametrize(("ahead", "taken"), [(timedelta(hours=24), True), (timedelta(hours=24) + SECOND, False)])
@pytest.mark.parametrize("slow", [False, True], ids=["by the clock", "by the roster here, of a clock put back"])
def test_a_roster_of_more_than_24_hours_ahead_is_not_taken_yet(
    station: Station, monkeypatch: pytest.MonkeyPatch, ahead: timedelta, taken: bool, slow: bool
) -> None:
    own = station.plant.roster
    assert own is not None
    clock = own.created - timedelta(days=300) if slow else own.created + timedelta(hours=2)
    monkeypatch.setattr(apply_pages, "now", lambda: clock)
    created = max(clock, own.created) + ahead
    new = roster_of(station, *own.members, version=2, previous=own.hash, created=created)
    [(_, how, why)] = apply_pages.take_rosters(station, [new.octets])
    assert how == ("taken" if taken else "refused")
    assert why.startswith("" if taken else "it is dated in the future")
    assert station.plant.roster == (new if taken else own)


# -- the state of each station -----------------------------------------------------------------------------------------


def test_each_station_has_its_state_and_age(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    week = 7 * 86_400
    members = others(station, old="line", due="base", ahead="audit", quiet="sign", torn="line", newer="line")
    gone = RemovedMember("west", SoftwareKey(99).point, frozenset({"line", "sign"}), "stolen", (0, ""))
    now = held(station, *members, removed=(gone,))
    at = {member.name: member.fingerprint for member in members}
    moment = now.created + timedelta(days=20)
    monkeypatch.setattr(status, "now", lambda: moment)

    def created(seconds: int) -> str:
        return f"{moment - timedelta(seconds=seconds):%Y-%m-%dT%H:%M:%SZ}"

    paged(station, station.fingerprint, 3, created(9))
    paged(station, at["old"], 4, created(1), "4" * 64)  # an earlier page, of a clock that was ahead
    paged(station, gone.fingerprint, 1, created(week + 1))
    for name, seconds, n in (
        ("old", week + 1, 5),
        ("due", week, 7),
        ("ahead", -50, 2),
        ("torn", 8, 4),
        ("newer", 8, 1),
    ):
        paged(station, at[name], n, created(seconds))
    apply_pages.alarm(station, "two-histories", at["torn"], 5, "two")
    newer = station.plant.pages.chain(at["newer"])
    station.plant.pages.put_chain(replace(newer, waits="it is of a newer version"))
    record = station.plant.joined
    assert record is not None
    conflicts = [(bytes(10), "two keys", "a and b"), (bytes(10), "name", "c"), (b"\1" * 10, "name", "d")]
    with monkeypatch.context() as patch:
        patch.setattr(station.plant.claims, "conflicts", lambda: iter(conflicts))
        assert status.status(station, record, now).conflicts == 2, "nodes are counted, not their conflicts"
    found = status.status(station, record, now)
    assert found.conflicts == 0
    assert [(one.name, one.number, one.age, one.state) for one in found.standings] == [
        ("owner", 3, 9, "here"),
        ("old", 5, week + 1, "silent"),
        ("due", 7, week, "heard"),
        ("ahead", 2, 0, "heard"),
        ("quiet", 0, None, "nothing said"),
        ("torn", 4, 8, "two histories"),
        ("newer", 1, 8, "newer version"),
        ("west", 1, week + 1, "stolen"),
    ]
    assert found.standings[-1].roles == ("line", "sign")
    assert found.exit_code == 4
    assert replace(found, standings=found.standings[1:]).exit_code == 6, "this one was removed"
    assert parcels.silent_stations(station, now, moment) == {at["old"]}
    paged(station, station.fingerprint, 4, created(week + 1))
    assert parcels.silent_stations(station, now, moment) == {at["old"]}, "the other members"


def test_heads_are_a_digest_of_the_newest_page_that_counts_of_every_chain(station: Station) -> None:
    paged(station, "b" * 64, 10, "", "d" * 64)
    paged(station, "a" * 64, 9, "", "e" * 64)
    station.plant.pages.chain("c" * 64)  # none of its pages counts
    lines = f"{'a' * 64} 9 {'e' * 64}\n{'b' * 64} 10 {'d' * 64}\n"
    assert apply_pages.heads_digest(station) == (hashlib.sha256(lines.encode()).hexdigest()[:16], 2)


# -- what others say of a node -----------------------------------------------------------------------------------------


def test_what_two_stations_of_one_name_state_of_a_node_is_shown_of_both(station: Station) -> None:
    """A machine that was set up again has the name of its removed self."""
    stations = others(station, west="line", east="line", was_west="base", once="base", twice="base", again="base")
    names = ("west", "east", "west", "once", "twice", "twice")
    removed = [
        RemovedMember(name, one.point, one.roles, "lost", (1, H)) for one, name in zip(stations, names, strict=True)
    ]
    now = held(station, *stations[:2], removed=tuple(removed[2:]))
    with station.transaction():
        for number, one in enumerate(stations):
            claim = Claim(pin=(f"{number}" * 64, "tap"), firmware=(None, f"2026-03-01T00:00:0{number}Z"))
            station.plant.claims.put(station.plant.pages.chain(one.fingerprint).id, {NODE: claim.to_json()})
    digits = [one.fingerprint[:16] for one in stations]
    named = ["west", "east", f"west ({digits[2]})", "once", f"twice ({digits[4]})", f"twice ({digits[5]})"]
    [shown] = status.nodes(station, now)
    assert shown["says"]["pinned_by"] == {name: f"{number}" * 64 for number, name in enumerate(named)}
    at = {name: f"2026-03-01T00:00:0{number}Z" for number, name in enumerate(named)}
    assert {name: one["at"] for name, one in shown["says"]["firmware_by"].items()} == at


def test_a_datasheet_that_is_older_than_one_that_a_member_with_sign_wrote_is_shown(station: Station) -> None:
    members = others(station, west="line sign", south="sign", east="line", left="sign")
    gone = members.pop()
    removed = RemovedMember("left", gone.point, gone.roles, "lost", (1, H))
    now = held(station, *members, removed=(removed,))
    named = {one.name: one.fingerprint for one in (*members, gone)}

    def wrote(**sequences: int) -> str | None:
        with station.transaction():
            for name, digits in named.items():
                written = (sequences[name], H, 1, "load-cell", None, None) if name in sequences else None
                station.plant.claims.put(station.plant.pages.chain(digits).id, {NODE: Claim(written=written).to_json()})
        [shown] = status.nodes(station, now)
        older: str | None = shown["says"]["older_than"]
        return older

    assert wrote(west=9) is None, "this station knows no datasheet of it"
    station.nodes.remember(NODE, sequence=5)
    assert [wrote(west=5), wrote(west=4, south=5)] == [None, None]
    assert [wrote(west=6), wrote(west=6, south=7), wrote(west=8, south=7)] == ["west", "south", "west"]
    assert [wrote(east=9), wrote(left=9), wrote(east=9, west=6)] == [None, None, "west"], "who may not sign"
    shown = call(station.home, "nodes", "--plant").out.splitlines()
    assert shown[0].endswith("no holder, datasheet 9 by east, firmware not reported")
    assert shown[1] == "  the datasheet known here is older than west wrote"


def test_the_doctor_looks_at_clocks_psycopg_the_last_sync_and_what_is_undecided(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    (west,) = others(station, west="line")
    now = held(station, west)
    moment, five = now.created, timedelta(minutes=5)

    def said(of: str, ahead: timedelta) -> list[tuple[str, str, str]]:
        newest = [(of, f"{moment + ahead:%Y-%m-%dT%H:%M:%SZ}")]
        return [(one.result, one.why, one.fix) for one in doctor._clocks(now, newest, moment)]

    late = f"{moment + five + SECOND:%Y-%m-%dT%H:%M:%SZ}"
    assert said(west.fingerprint, five) == []
    assert said(west.fingerprint, five + SECOND) == [(
        "warning", f"The clock is behind the newest page of west ({late}).",
        "Set the clock of this machine, or that of west.",
    )]  # fmt: skip
    assert said("f" * 64, five + SECOND) == []
    ends = now.expires - moment
    assert said(west.fingerprint, ends)[0][2] == "Set the clock of this machine, or that of west."
    assert said(west.fingerprint, ends + SECOND)[0][2] == "Set the clock of west."

    record = station.plant.joined
    assert record is not None
    monkeypatch.setattr(doctor, "find_spec", lambda name: None)
    system: Any = SimpleNamespace(home=station.home)

    def checked(**changes: Any) -> list[tuple[str, str]]:
        station.plant.put_record(replace(record, **changes))
        return [(one.result, one.why) for one in doctor.registry(system)]

    today = datetime.now(UTC)
    week, more = (f"{today - timedelta(days=days, seconds=-5):%Y-%m-%dT%H:%M:%SZ}" for days in (7, 8))
    roster_line = ("ok", f"plant: roster 2 holds until {now.expires:%Y-%m-%d}.")
    nothing = ("ok", "0 events unsent, 0 conflicts.")
    assert checked(synced=week) == [roster_line, nothing]
    ahead, far = (
        f"{today + timedelta(days=days, seconds=seconds):%Y-%m-%dT%H:%M:%SZ}" for days, seconds in ((7, -5), (7, 60))
    )
    assert checked(synced=ahead) == [roster_line, nothing]
    assert checked(synced=far) == [roster_line, ("warning", f"The last sync was {far}."), nothing], "by a wrong clock"
    assert checked(synced=more) == [roster_line, ("warning", f"The last sync was {more}."), nothing]
    assert checked() == [roster_line, ("warning", "The last sync was never."), nothing]
    assert checked(synced=week, url="file:/media/stick") == [roster_line, nothing]
    missing = ("failed", "psycopg is missing.")
    assert checked(synced=week, url="postgresql://office/plant") == [roster_line, missing, nothing]
    station.plant.claims.put_conflicts({NODE: {"two keys": "x", "two holders": "y"}})
    apply_pages.alarm(station, "junk", west.fingerprint, 3, "a page")
    assert checked(synced=week) == [
        roster_line, ("warning", "Alarm junk: a page."), ("warning", "1 event unsent, 1 conflict.")
    ]  # fmt: skip
    station.plant.alarms.see()
    assert checked(synced=week) == [roster_line, ("warning", "1 event unsent, 1 conflict.")]
    assert checked(left="2026-01-01T00:00:00Z") == []


# -- what the owner of the CA key may do -------------------------------------------------------------------------------


def test_the_last_page_of_a_retired_one_is_the_newest_here_and_of_a_lost_one_it_must_be_named(station: Station) -> None:
    west, south = others(station, west="line sign", south="base")
    share = Share(("all", ""), (south.fingerprint, west.fingerprint))
    only_west = Share(("group", "hand"), (west.fingerprint,))
    now = held(station, west, south, share=(share, only_west))
    paged(station, west.fingerprint, 1, "2026-01-01T00:00:00Z", "1" * 64)
    paged(station, west.fingerprint, 2, "2026-01-02T00:00:00Z", "2" * 64)
    for why in ("lost", "stolen"):
        with pytest.raises(UsageError, match="Which is the last page of west that you trust"):
            owner.draft_removal(station, "west", why, None)
    retired = owner.draft_removal(station, "west", "retired", None)
    assert retired.removed == (RemovedMember("west", west.point, west.roles, "retired", (2, "2" * 64)),)
    assert retired.share == (Share(("all", ""), (south.fingerprint,)),)
    assert (retired.version, retired.previous, retired.members) == (3, now.hash, (now.members[0], south))
    assert owner.draft_removal(station, "west", "stolen", 1).removed[0].last == (1, "1" * 64)
    assert owner.draft_removal(station, "west", "stolen", 0).removed[0].last == (0, "")
    assert status.page_list(station, west.fingerprint, 1) == [(2, "2" * 64, "2026-01-02T00:00:00Z")]


def test_a_page_to_remove_at_counts_and_is_the_one_that_the_next_page_follows(station: Station) -> None:
    (west,) = others(station, west="line sign")
    held(station, west)
    pages = station.plant.pages
    with station.transaction():
        chain = pages.chain(west.fingerprint)
        for n, hash, previous in ((1, "1" * 64, ""), (2, "2" * 64, "1" * 64), (2, "b" * 64, "1" * 64),
                                  (3, "3" * 64, "b" * 64), (4, "4" * 64, "3" * 64)):  # fmt: skip
            pages.add(chain.id, PageRow(n, hash, previous, "2026-01-01T00:00:00Z", "", b"", b"{}", bytes(64)))
        pages.put_chain(replace(chain, counted=(3, "3" * 64)))
    assert [owner.page_place(station, west.fingerprint, n) for n in range(4)] == [
        (0, ""), (1, "1" * 64), (2, "b" * 64), (3, "3" * 64)
    ]  # fmt: skip
    for n in (4, 5):
        with pytest.raises(NotFoundError, match=f"Page {n} of that station is missing here or does not count"):
            owner.page_place(station, west.fingerprint, n)


def request(station: Station, key: SoftwareKey, name: str = "west", **changes: Any) -> MemberRequest:
    ca = ca_of(station).ca()
    assert ca is not None
    now = station.plant.roster
    assert now is not None
    made = MemberRequest(name, key.point, ca.sign(station_key_message(key.point)), LOGIN, now.created)
    return replace(made, **changes)


def test_who_may_be_added_to_a_roster(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    (west,) = others(station, west="line")
    key, new = SoftwareKey(5000), SoftwareKey(6000)
    gone = RemovedMember("gone", SoftwareKey(7000).point, frozenset({"line"}), "retired", (0, ""))
    now = held(station, west, removed=(gone,))
    base: Any = frozenset({"base"})

    def refused(asked: MemberRequest, why: str) -> None:
        with pytest.raises(PolicyError, match=why) as error:
            owner.add(station, asked, base)
        assert error.value.exit_code == 6

    made = owner.add(station, request(station, new, "south"), base)
    assert [one.name for one in made.members] == ["owner", "west", "south"]
    assert made.members[2].roles == {"base"}
    refused(request(station, new, "south", certificate=bytes(64)), "is not certified by this owner's CA")
    refused(request(station, SoftwareKey(7000), "gone again"), "gone was removed with this key")
    refused(request(station, key, "west"), "west is already a member")
    refused(request(station, new, "west"), "There is already a member called 'west'")
    line: Any = frozenset({"line"})
    assert owner.says_the_same(now, owner.add(station, request(station, key), line)), "the same again"
    once = replace(west, signed=(7, "ab" * 32))
    still = held(station, once, removed=(gone,))
    assert owner.says_the_same(still, owner.add(station, request(station, key), line)), "also one that lost sign"
    now = held(station, west, removed=(gone,))
    for clock in (now.created, now.created - timedelta(days=300)):
        monkeypatch.setattr(owner, "now", lambda clock=clock: clock)
        day = timedelta(hours=24)
        owner.add(station, request(station, new, "south", created=now.created + day), base)
        refused(request(station, new, "south", created=now.created + day + SECOND), "dated 20.*, in the future")


def test_keys_are_shared_with_members_that_have_base_and_one_share_of_the_same_nodes(station: Station) -> None:
    west, south = others(station, west="line", south="base")
    gone = RemovedMember("gone", SoftwareKey(7000).point, frozenset({"base"}), "retired", (0, ""))
    hand, everything = ("group", "hand"), ("all", "")
    before = (Share(hand, (south.fingerprint,)), Share(everything, (south.fingerprint,)))  # type: ignore[arg-type]
    held(station, west, south, removed=(gone,), share=before)
    for receiver in (west.fingerprint, gone.fingerprint, H):
        with pytest.raises(PolicyError, match="does not have the role 'base'"):
            owner.shared(station, Share(("all", ""), (south.fingerprint, receiver)))
    changed = Share(("group", "hand"), (station.fingerprint,), forget=True)
    assert owner.shared(station, changed).share == (before[1], changed)
    assert owner.unshared(station, hand).share == (before[1],)
    assert owner.unshared(station, ("group", "arm")).share == before


def test_a_list_of_pages_to_choose_from_has_the_last_20(station: Station) -> None:
    for n in range(1, 23):
        paged(station, H, n, f"2026-01-{n:02}T00:00:00Z")
    assert [n for n, _, _ in status.page_list(station, H)] == list(range(22, 2, -1))


def test_sign_is_lost_at_the_newest_page_and_a_keeper_is_only_removed(station: Station) -> None:
    west, north = others(station, west="line sign", north="keeper sign")
    held(station, west, north)
    paged(station, west.fingerprint, 4, "", "4" * 64)

    def changed(*roles: str, last: roster.Place | None = None) -> Member:
        made = owner.with_roles(station, "west", frozenset(roles), last)  # type: ignore[arg-type]
        return next(one for one in made.members if one.name == "west")

    assert (changed("line").signed, changed("line", last=(2, H)).signed) == ((4, "4" * 64), (2, H))
    assert (changed("sign").signed, changed("sign", last=(2, H)).signed) == (None, None)
    with pytest.raises(PolicyError, match="north is a keeper"):
        owner.with_roles(station, "north", frozenset({"sign"}), None)
    owner.with_roles(station, "north", frozenset({"keeper"}), None)
    held(station, replace(west, roles=frozenset({"line"}), signed=(3, H)), north)
    assert (changed("base").signed, changed("line", last=(9, H)).signed) == ((3, H), (3, H)), "it stays as it was"
    assert changed("line", "sign").signed is None


def test_a_roster_is_renewed_for_so_many_days_from_now_never_from_before_the_one_that_it_follows(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = station.plant.roster
    assert now is not None
    for clock, begins in ((timedelta(days=5), timedelta(days=5)), (-timedelta(days=5), timedelta(0))):
        monkeypatch.setattr(owner, "now", lambda clock=clock: now.created + clock)
        made = owner.renewed(station, timedelta(days=90))
        assert (made.created, made.expires) == (now.created + begins, now.created + begins + timedelta(days=90))
        assert (made.version, made.previous, made.members) == (2, now.hash, now.members)


def test_the_next_version_of_an_expired_roster_holds_for_a_day(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = station.plant.roster
    assert own is not None
    for after, ends in ((-timedelta(days=2), own.expires), (timedelta(days=5), own.expires + timedelta(days=6))):
        monkeypatch.setattr(owner, "now", lambda after=after: own.expires + after)
        assert owner.following(station).expires == ends


def test_a_version_that_changes_nothing_says_the_same_unless_it_is_dated_earlier(station: Station) -> None:
    own = station.plant.roster
    assert own is not None
    after = replace(own, version=2, created=own.created + SECOND)
    assert owner.says_the_same(own, after)
    assert not owner.says_the_same(None, after)
    for changes in ({"created": own.created - SECOND}, {"expires": own.expires + SECOND}, {"members": ()},
                    {"share": (Share(("all", ""), ()),)}):  # fmt: skip
        assert not owner.says_the_same(own, replace(after, **changes))


def test_a_date_is_wrong_if_it_is_ahead_and_no_other_member_dates_its_pages_so(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    (west,) = others(station, west="line")
    own = held(station, west)
    monkeypatch.setattr(owner, "now", lambda: own.created - timedelta(hours=24))
    with pytest.raises(PolicyError, match=r"is dated .*, not in the future"):
        owner.require_wrong_date(station, own)
    clock = own.created - timedelta(hours=24) - SECOND
    monkeypatch.setattr(owner, "now", lambda: clock)
    late = f"{clock + timedelta(hours=24) + SECOND:%Y-%m-%dT%H:%M:%SZ}"
    paged(station, station.fingerprint, 1, late)
    paged(station, "f" * 64, 1, late)  # no member
    paged(station, west.fingerprint, 1, f"{clock + timedelta(hours=24):%Y-%m-%dT%H:%M:%SZ}")
    owner.require_wrong_date(station, own)
    paged(station, west.fingerprint, 2, late)
    with pytest.raises(PolicyError, match="The clock of this machine is behind: the newest page of west is dated"):
        owner.require_wrong_date(station, own)


def test_a_first_roster_has_this_station_alone_with_every_role_but_audit_for_90_days(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(PolicyError, match="already belongs to a registry"):
        owner.draft_first(station, "plant")
    record = station.plant.joined
    assert record is not None
    station.plant.put_record(replace(record, left="2026-01-01T00:00:00Z"))
    monkeypatch.setattr(owner, "now", lambda: NOW)
    made = owner.draft_first(station, "plant")
    assert (made.version, made.previous, made.removed, made.share) == (1, "", (), ())
    assert (made.created, made.expires) == (NOW, datetime(2026, 5, 30, 12, tzinfo=UTC))
    [me] = made.members
    assert (me.fingerprint, me.roles) == (fingerprint(station.point), frozenset({"keeper", "sign", "line", "base"}))
    assert me.signed is None


def test_among_members_a_keepers_ban_in_a_bundle_counts_and_no_certificate(station: Station) -> None:
    """The CA certifies every member; who has had the node's key has authority as outside of a plant."""
    west, south, east = others(station, west="keeper", south="base sign line", east="base")
    held(station, west, south, removed=(RemovedMember("east", east.point, frozenset({"keeper"}), "lost", (0, "")),))
    station.pins.put(WhitelistEntry(NODE, "cd" * 32, assurance="tap"))
    bundle: Any = SimpleNamespace(nodes=(), sender="")

    def why(of: Member) -> str:
        statement: Any = SimpleNamespace(uuid=NODE, fingerprint=None, statement="a ban", sender=of.fingerprint)
        return deny.why_not(station, statement, bundle)

    assert why(west) == ""
    for other in (south, east):
        station.identity.keep_certificate(station.ca, other.point, other.certificate)
        assert why(other) == f"station {other.fingerprint[:32]} has no authority over this node"
    station.keys.put_holder(Holder(NODE, south.fingerprint, "2026-01-31T12:00:00Z"))
    assert why(south) == ""


def test_a_key_that_is_trusted_as_a_ca_signs_no_datasheets_in_a_plant(station: Station) -> None:
    held(station)
    for number, role in ((61, "ca"), (62, "station")):
        key = SoftwareKey(number)
        station.policy.trust(TrustRecord(f"lab {role}", role, key.point, fingerprint(key.point)))  # type: ignore[arg-type]
    rules = station.policy.signer_rules()
    assert rules is not None
    assert rules.added == {fingerprint(SoftwareKey(62).point)}
    verdicts = [rules.signing(station.ca, SoftwareKey(number).point, bytes(40)) for number in (61, 62)]
    assert [verdict is not None and verdict.result == "passed" for verdict in verdicts] == [False, True]


def test_a_machine_that_joined_again_under_its_name_does_not_hide_who_wrote(station: Station) -> None:
    """Both state one sequence, one of them without a profile; the view was a TypeError."""
    (west,) = others(station, west="line sign")
    old = SoftwareKey(6001)
    left = RemovedMember("west", old.point, frozenset({"line", "sign"}), "retired", (1, H))
    now = held(station, west, removed=(left,))
    written = {west.fingerprint: (6, H, 1, None, None, None), fingerprint(old.point): (6, H, 1, "angle", None, None)}
    for digits, what in written.items():
        paged(station, digits, 1, "2026-03-01T12:00:00Z")
        with station.transaction():
            station.plant.claims.put(station.plant.pages.chain(digits).id, {NODE: Claim(written=what).to_json()})
    [shown] = status.nodes(station, now)
    assert (shown["says"]["sequence"], shown["says"]["written_by"]) == (6, "west")
    assert status.find_named(station, NODE.hex()[:4]) == NODE
    assert status.find_named(station, NODE.hex()[:3]) is None
    assert status.find_named(station, " 0x8D4D9D ") == NODE
    assert status.find_named(station, "no such name") is None
    with station.transaction():
        chain = station.plant.pages.chain(west.fingerprint).id
        other = bytes.fromhex("8d4d9da65281f7000001")
        palms = {NODE: Claim(name=("palm", "2026-03-01")), other: Claim(name=("palm left", "2026-03-01"))}
        station.plant.claims.put(chain, {uuid: claim.to_json() for uuid, claim in palms.items()})
    assert status.find_named(station, "palm") == NODE, "the whole name"
    assert status.find_named(station, "pal") is None
    with pytest.raises(UsageError, match="'8d4d' matches 2 nodes"):
        status.find_named(station, "8d4d")
    assert status.resolve(station, other.hex()) == other
    with pytest.raises(NotFoundError, match="No node is known as 'elbow'"):
        status.resolve(station, "elbow")
