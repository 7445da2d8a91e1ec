"""Drafts of the next roster: what each command of the owner makes of the present one, refuses, and says of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotFoundError, PolicyError, UsageError
from teds_provision.plant import owner as owning
from teds_provision.protocol.keys import SoftwareKey, fingerprint, station_key_message
from teds_provision.protocol.plant.document import MemberRequest
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster, Share
from teds_provision.station.station import Station
from tests.bench import make_station

from .owner import alone, join, roster_of

SOUTH, WEST, GONE = (SoftwareKey(number) for number in (71, 72, 73))
PAGE = (88, "ab" * 32)
NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)
MOMENT = NOON.replace(microsecond=123456)


@pytest.fixture
def station(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Station]:
    """An owner whose roster has two more members, one removed station, and two shares."""
    made = alone(tmp_path / "owner")
    made.unlock()
    ca = made.vault.ca()
    assert ca is not None

    def certificate(key: SoftwareKey) -> bytes:
        return ca.sign(station_key_message(key.point))

    first = made.plant.roster
    assert first is not None
    members = (
        *first.members,
        Member("south", SOUTH.point, certificate(SOUTH), frozenset(("base", "sign"))),
        Member("west", WEST.point, certificate(WEST), frozenset(("base", "keeper"))),
    )
    gone = RemovedMember("gone", GONE.point, frozenset(("line",)), "lost", PAGE)
    share = (Share(("all", ""), (of(SOUTH), of(WEST)), True), Share(("group", "left"), (of(SOUTH),), False))
    join(
        made,
        roster_of(
            made, *members, version=2, previous=first.hash, removed=(gone,), share=share,
            created=NOON - timedelta(days=1), expires=NOON + timedelta(days=30),
        ),
    )  # fmt: skip
    monkeypatch.setattr(owning, "now", lambda: MOMENT)
    yield made
    made.close()


def of(key: SoftwareKey) -> str:
    return fingerprint(key.point)


def held(station: Station) -> Roster:
    found = station.plant.roster
    assert found is not None
    return found


def asked(station: Station, key: SoftwareKey, name: str, **changes: Any) -> MemberRequest:
    station.unlock()
    ca = station.vault.ca()
    assert ca is not None
    made = MemberRequest(name, key.point, ca.sign(station_key_message(key.point)), "", MOMENT)
    return replace(made, **changes)


def test_the_first_roster_has_this_station_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    single = make_station(tmp_path / "single", "single")
    monkeypatch.setattr(owning, "now", lambda: MOMENT)
    draft = owning.draft_first(single, "plant")
    assert (draft.name, draft.version, draft.previous, draft.removed, draft.share) == ("plant", 1, "", (), ())
    assert draft.created == NOON
    assert draft.expires - draft.created == timedelta(days=90)
    (own,) = draft.members
    assert (own.name, own.point, own.roles) == ("single", single.point, {"keeper", "sign", "line", "base"})
    single.close()


def test_it_is_refused_where_one_was_joined(station: Station) -> None:
    with pytest.raises(PolicyError, match="already belongs"):
        owning.draft_first(station, "plant")


def test_the_next_version_follows_this_one_and_is_dated_no_earlier(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = held(station)
    draft = owning.following(station)
    assert (draft.version, draft.previous, draft.hash, draft.octets) == (3, before.hash, "", b"")
    assert draft.created == max(before.created, NOON)
    assert (draft.members, draft.removed, draft.share) == (before.members, before.removed, before.share)
    assert draft.expires == max(before.expires, draft.created + timedelta(days=1))
    monkeypatch.setattr(owning, "now", lambda: before.created - timedelta(days=9))
    assert owning.following(station).created == before.created
    monkeypatch.setattr(owning, "now", lambda: before.expires - timedelta(hours=2))
    late = owning.following(station)
    assert late.expires == late.created + timedelta(days=1), "it is no sooner over than made"
    assert owning.following(station, expires=MOMENT).expires == MOMENT


def test_a_station_is_added_once(station: Station) -> None:
    before = held(station)
    new = SoftwareKey(74)
    draft = owning.add(station, asked(station, new, "east"), frozenset(("line",)))
    assert draft.members[:3] == before.members
    assert (draft.members[3].name, draft.members[3].roles) == ("east", {"line"})
    again = owning.add(station, asked(station, SOUTH, "south"), frozenset(("base", "sign")))
    assert (again.members, again.version) == (before.members, 3)
    with pytest.raises(PolicyError, match="south is already a member") as refused:
        owning.add(station, asked(station, SOUTH, "south"), frozenset(("base",)))
    assert "registry role" in refused.value.hint
    with pytest.raises(PolicyError, match="gone was removed with this key"):
        owning.add(station, asked(station, GONE, "again"), frozenset(("base",)))
    with pytest.raises(PolicyError, match="already a member called 'west'"):
        owning.add(station, asked(station, new, "west"), frozenset(("base",)))
    assert owning.add(station, asked(station, new, "gone"), frozenset(("base",))).members[3].name == "gone"
    with pytest.raises(PolicyError, match="not certified by this owner's CA"):
        owning.add(station, asked(station, new, "east", certificate=bytes(64)), frozenset(("base",)))


@pytest.mark.parametrize(("ahead", "good"), [(timedelta(hours=24), True), (timedelta(hours=24, seconds=1), False)])
def test_a_request_is_dated_at_most_a_day_in_the_future(
    station: Station, monkeypatch: pytest.MonkeyPatch, ahead: timedelta, good: bool
) -> None:
    latest = max(MOMENT, held(station).created)
    request = asked(station, SoftwareKey(74), "east", created=latest + ahead)
    if good:
        assert owning.add(station, request, frozenset(("base",))).members[3].name == "east"
    else:
        with pytest.raises(PolicyError, match="in the future"):
            owning.add(station, request, frozenset(("base",)))
    assert owning.is_ahead(replace(held(station), created=MOMENT + ahead)) is not good


def test_who_loses_sign_keeps_what_was_signed_and_who_gets_it_starts_anew(station: Station) -> None:
    def south(draft: Roster) -> Member:
        (found,) = [member for member in draft.members if member.name == "south"]
        return found

    lost = south(owning.with_roles(station, "south", frozenset(("base",)), PAGE))
    assert (lost.roles, lost.signed) == ({"base"}, PAGE)
    assert south(owning.with_roles(station, "south", frozenset(("base",)), None)).signed == (0, "")
    kept = south(owning.with_roles(station, of(SOUTH), frozenset(("base", "sign", "line")), None))
    assert (kept.roles, kept.signed) == ({"base", "sign", "line"}, None)
    with pytest.raises(PolicyError, match="west is a keeper") as refused:
        owning.with_roles(station, "west", frozenset(("base",)), None)
    assert refused.value.hint == "registry remove west --retired"
    draft = owning.with_roles(station, "west", frozenset(("keeper",)), None)
    assert [member.name for member in draft.members] == ["owner", "south", "west"]
    with pytest.raises(NotFoundError, match="'gone' is not a member of plant") as unknown:
        owning.with_roles(station, "gone", frozenset(("base",)), None)
    assert unknown.value.hint == "Members: owner, south, west."


def test_a_removed_station_leaves_its_shares_too(station: Station) -> None:
    draft = owning.draft_removal(station, "south", "stolen", 0)
    assert [member.name for member in draft.members] == ["owner", "west"]
    assert draft.removed[0] == held(station).removed[0]
    left = draft.removed[1]
    assert (left.name, left.point, left.roles, left.why, left.last) == (
        "south", SOUTH.point, {"base", "sign"}, "stolen", (0, "")
    )  # fmt: skip
    assert draft.share == (Share(("all", ""), (of(WEST),), True),), "a share with nobody left is none"
    assert owning.draft_removal(station, "south", "retired", None).removed[1].last == (0, "")
    for why in ("lost", "stolen"):
        with pytest.raises(UsageError, match="last page of south that you trust"):
            owning.draft_removal(station, "south", why, None)  # type: ignore[arg-type]
    with pytest.raises(NotFoundError, match="Page 5 of that station"):
        owning.draft_removal(station, "south", "lost", 5)
    for last in (None, 88):
        assert owning.draft_removal(station, "gone", "lost", last).removed == held(station).removed, "done already"
    for why, last in (("stolen", None), ("lost", 87)):
        with pytest.raises(NotFoundError):
            owning.draft_removal(station, "gone", why, last)  # type: ignore[arg-type]


def test_a_share_of_the_same_nodes_is_replaced(station: Station) -> None:
    every, left = held(station).share
    more = Share(("group", "left"), (of(WEST),), True)
    assert owning.shared(station, more).share == (every, more)
    other = Share(("profile", "load-cell"), (of(SOUTH),), False)
    assert owning.shared(station, other).share == (every, left, other)
    for wrong in ("ee" * 32, of(GONE)):
        with pytest.raises(PolicyError, match="does not have the role 'base'"):
            owning.shared(station, Share(("all", ""), (of(SOUTH), wrong), False))
    assert owning.unshared(station, ("group", "left")).share == (every,)
    assert owning.unshared(station, ("group", "right")).share == (every, left)


def test_a_roster_is_extended_from_now_on(station: Station) -> None:
    created = held(station).created
    draft = owning.renewed(station, timedelta(days=90))
    assert draft.expires == max(NOON, created) + timedelta(days=90)
    redated = owning.renewed(station, timedelta(days=90), redate=True)
    assert (redated.created, redated.expires) == (NOON, NOON + timedelta(days=90))


def test_what_changes_is_said_in_sentences(station: Station) -> None:
    before = held(station)
    other = SoftwareKey(74)
    after = replace(
        before,
        version=3,
        created=before.created - timedelta(days=1),
        expires=datetime(2026, 12, 24, tzinfo=UTC),
        members=(
            before.members[0],
            replace(before.members[1], roles=frozenset(("line", "base")), signed=PAGE),
            Member("east", other.point, b"", frozenset(("sign", "audit"))),
        ),
        removed=(*before.removed, RemovedMember("west", WEST.point, frozenset(), "retired", (7, "cd" * 32))),
        share=(before.share[0], Share(("profile", "load-cell"), (of(SOUTH), of(other)), True)),
    )
    assert owning.changes(before, after) == [
        f"roster 3 of plant ({before.registry}), until 2026-12-24",
        f"  dates it {after.created:%Y-%m-%d}; the one before was dated {before.created:%Y-%m-%d}",
        "  south: base sign becomes base line",
        "    what it signed up to page 88 stays authentic",
        "  adds east as audit sign",
        f"    {of(other)}",
        "  removes west (retired); its pages up to 7 count",
        f"    {of(WEST)}",
        "  shares profile load-cell with south, east, and forgets them itself",
        "  shares group left no more",
    ]
    first = owning.changes(None, before)
    assert first[0] == f"roster 2 of plant ({before.registry}), until {before.expires:%Y-%m-%d}"
    assert "  shares all nodes with south, west, and forgets them itself" in first
    assert "  shares group left with south" in first
    assert sum(line.startswith("  adds ") for line in first) == 3


@pytest.mark.parametrize(("later", "same"), [(0, True), (3599, True), (3600, False), (-1, False), (86400, False)])
def test_the_same_renewal_again_within_an_hour_changes_nothing(station: Station, later: int, same: bool) -> None:
    before = held(station)
    draft = replace(before, version=9, expires=before.expires + timedelta(seconds=later))
    assert owning.says_the_same(before, owning.same_end(before, draft)) is same


def test_a_version_that_changes_nothing_says_the_same(station: Station) -> None:
    before = held(station)
    same = replace(before, version=9, previous="x", created=before.created + timedelta(days=1))
    assert owning.says_the_same(before, same)
    assert not owning.says_the_same(None, same)
    for change in (
        {"created": before.created - timedelta(seconds=1)}, {"expires": MOMENT}, {"members": ()}, {"removed": ()},
        {"share": ()},
    ):  # fmt: skip
        assert not owning.says_the_same(before, replace(same, **change)), change  # type: ignore[arg-type]


def test_a_draft_as_a_file_is_read_back_and_a_newer_one_refused(station: Station) -> None:
    draft = owning.following(station)
    octets = owning.write_draft(draft)
    assert octets.endswith(b"}\n")
    assert owning.read_draft(octets, station.ca).unsigned() == draft.unsigned()
    with pytest.raises(BadDataError, match="newer version"):
        owning.read_draft(octets.replace(b'{"format"', b'{"more": 1, "format"').replace(b'{"f', b'{"f'), station.ca)


def test_only_the_ca_key_of_this_owner_signs(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    draft = owning.following(station)
    assert owning.signed(station, draft).version == 3
    for key in (None, SoftwareKey(75)):
        monkeypatch.setattr(type(station.vault), "ca", lambda _self, key=key: key)
        with pytest.raises(NotFoundError, match="The CA key is not in this vault"):
            owning.signed(station, draft)
