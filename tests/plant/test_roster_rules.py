"""Who is who in a roster, whose signatures count, and which of two rosters does (contract/plant.md section 1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.roster import Member, Place, RemovedMember, Roster, best, taking
from teds_provision.protocol.plant.signer import SignatureClaim, SignerVerdict, limit_of, missing_pages, signing

NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)
REGISTRY = "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
NAMES = ("north", "south", "west", "east", "lost", "left", "never", "stranger")
POINTS = {name: SoftwareKey(number).point for number, name in enumerate(NAMES, 31)}
AT = {name: fingerprint(point) for name, point in POINTS.items()}
DIGESTS = "ab" * 32


def member(name: str, roles: str, signed: Place | None = None) -> Member:
    return Member(name, POINTS[name], b"", frozenset(roles.split()), signed)


def removed(name: str, roles: str, last: int = 9, signed: Place | None = None) -> RemovedMember:
    return RemovedMember(name, POINTS[name], frozenset(roles.split()), "lost", (last, "c" * 64), signed)


MEMBERS = (
    member("north", "keeper sign base"),
    member("south", "base"),
    member("west", "line sign"),
    member("east", "line", (5, "d" * 64)),  # it signed until its page 5
)
GONE = (removed("lost", "sign"), removed("left", "line", 9, (4, "e" * 64)), removed("never", "keeper base"))


def roster(version: int = 1, members: tuple[Member, ...] = MEMBERS, gone: tuple[RemovedMember, ...] = GONE,
           *, previous: str = "", hash: str = "") -> Roster:  # fmt: skip
    until = NOW + timedelta(days=90)
    return Roster(REGISTRY, "plant", version, previous, NOW, until, members, gone, hash=hash or f"{version:064x}")


def test_roles_of_members_and_of_removed_ones_are_signed_in_the_order_of_the_contract() -> None:
    every = "audit base sign line keeper"
    said = roster(members=(member("north", every),), gone=(removed("lost", every),)).unsigned()
    for listed in ("members", "removed"):
        assert said[listed][0]["roles"] == ["keeper", "line", "sign", "base", "audit"]


# -- who is who --------------------------------------------------------------------------------------------------------


def test_a_present_member_a_removed_one_and_a_stranger() -> None:
    known = roster()
    asked = [AT[name] for name in ("north", "lost", "stranger")]
    assert [known.member(digits) for digits in asked] == [MEMBERS[0], None, None]
    assert [known.removed_one(digits) for digits in asked] == [None, GONE[0], None]
    assert [known.point_of(digits) for digits in asked] == [POINTS["north"], POINTS["lost"], None]
    assert [known.roles_of(digits) for digits in asked] == [{"keeper", "sign", "base"}, {"sign"}, frozenset()]
    assert [known.name_of(digits) for digits in asked] == ["north", "lost", AT["stranger"][:16]]
    assert [known.has(digits, "sign") for digits in asked] == [True, False, False], "one that left has no role now"
    assert [known.has(AT[name], "line") for name in ("west", "south")] == [True, False]


def test_a_station_is_named_by_its_name_or_by_16_digits_of_its_fingerprint() -> None:
    known = roster(
        gone=(
            *GONE,
            replace(GONE[1], name="north", why="stolen"),
            removed("stranger", "line"),
        )
    )
    assert known.named("north") == MEMBERS[0], "a member before one that left"
    again = roster(gone=(GONE[0], replace(GONE[1], name="lost")))
    assert again.named("lost") == again.removed[1], "the last of that name"
    digits = AT["west"]
    assert [known.named(text) for text in (digits, digits[:16], digits[:16].upper(), digits[:15], "nobody")] == [
        MEMBERS[2], MEMBERS[2], MEMBERS[2], None, None
    ]  # fmt: skip
    assert known.named(AT["stranger"][:16]) == known.removed[-1]


# -- whose signatures count --------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("one", "limit"),
    [
        (member("north", "sign"), None),
        (member("east", "line", (5, "d")), (5, "d")),
        (removed("lost", "sign line", 9), (9, "c" * 64)),
        (removed("lost", "line", 9), None),
        (removed("lost", "line", 9, (4, "e")), (4, "e")),
        (removed("lost", "line", 9, (12, "a")), (9, "c" * 64)),  # its pages end before
        (removed("lost", "line", 10, (9, "z")), (9, "z")),  # by number, not as text
    ],
)
def test_the_pages_of_a_station_without_sign_count_up_to_the_one_that_the_roster_names(
    one: Member | RemovedMember, limit: Place | None
) -> None:
    assert limit_of(one) == limit


def own(name: str, number: int) -> SignatureClaim:
    return SignatureClaim(AT[name], number, vouched=False)


def vouched(name: str, number: int = 1) -> SignatureClaim:
    return SignatureClaim(AT[name], number, vouched=True)


GONE_FOR_GOOD = "lost was removed, and a removed key never comes back"
NOT_THEN = "this datasheet is not in its pages of that time"


def absent(name: str, named: int, here: int) -> str:
    return f"pages of {name} are missing here: the roster names page {named}, and the last one here is {here}"


BEHIND = "pages of north are missing here: south names page 8, and the last one here is 3"


@pytest.mark.parametrize(
    ("signer", "words", "more", "verdict"),
    [
        ("west", [own("west", 7)], {}, ("passed", "")),
        ("west", [], {}, ("passed", "in no page yet")),
        ("west", [own("north", 7), vouched("west")], {}, ("passed", "in no page yet")),
        ("stranger", [], {}, ("failed", f"station {AT['stranger'][:16]} is not in the roster")),
        ("stranger", [], {"added": True}, ("passed", "trusted here")),
        ("stranger", [own("stranger", 1)], {}, ("failed", f"station {AT['stranger'][:16]} is not in the roster")),
        ("stranger", [vouched("north")], {}, ("passed", "vouched for by a keeper")),
        ("stranger", [vouched("never")], {}, ("passed", "vouched for by a keeper")),  # a keeper then; its page counts
        ("stranger", [vouched("south")], {}, ("failed", f"station {AT['stranger'][:16]} is not in the roster")),
        ("stranger", [own("north", 1)], {}, ("failed", f"station {AT['stranger'][:16]} is not in the roster")),
        ("south", [own("south", 1)], {}, ("failed", "south may not sign: never had the role sign")),
        ("south", [], {"added": True}, ("failed", "south may not sign: never had the role sign")),
        ("south", [], {"behind": BEHIND}, ("failed", "south may not sign: never had the role sign")),
        ("south", [vouched("north")], {}, ("passed", "vouched for by a keeper")),
        ("east", [own("east", 5)], {}, ("passed", "signed by east while it had the role")),
        ("east", [own("east", 9), own("east", 2)], {}, ("passed", "signed by east while it had the role")),
        ("east", [own("east", 6)], {"counted": 6}, ("failed", f"east may not sign: {NOT_THEN}")),
        ("east", [], {"counted": 5}, ("failed", f"east may not sign: {NOT_THEN}")),
        ("east", [], {"counted": 5, "behind": BEHIND}, ("failed", f"east may not sign: {NOT_THEN}")),
        ("east", [], {"counted": 4}, ("unproven", absent("east", 5, 4))),
        ("east", [], {}, ("unproven", absent("east", 5, 0))),
        ("lost", [own("lost", 9)], {}, ("passed", "signed by lost while it had the role")),
        ("lost", [own("lost", 10)], {"counted": 9}, ("failed", f"lost was removed: {NOT_THEN}")),
        ("lost", [], {"counted": 9, "behind": BEHIND}, ("unproven", BEHIND)),
        ("lost", [], {"counted": 8, "behind": BEHIND}, ("unproven", absent("lost", 9, 8))),
        ("left", [own("left", 4)], {}, ("passed", "signed by left while it had the role")),
        ("left", [own("left", 5)], {"counted": 9}, ("failed", f"left was removed: {NOT_THEN}")),
        ("never", [own("never", 1)], {}, ("failed", "never was removed: never had the role sign")),
        ("never", [], {"behind": BEHIND}, ("unproven", BEHIND)),
    ],
)  # fmt: skip
def test_a_datasheet_counts_by_its_signers_role_its_pages_of_that_time_or_a_keepers_word(
    signer: str, words: list[SignatureClaim], more: Mapping[str, Any], verdict: tuple[str, str]
) -> None:
    counted = {AT[signer]: more["counted"]} if "counted" in more else {}
    found = signing(
        roster(), AT[signer], words, counted=counted, keepers_behind=more.get("behind", ""),
        added=more.get("added", False),
    )  # fmt: skip
    assert found == SignerVerdict(*verdict)  # type: ignore[arg-type]


def test_missing_pages_in_words() -> None:
    assert missing_pages("north", "south", 8, 3) == BEHIND


# -- which of two counts -----------------------------------------------------------------------------------------------

ANOTHER_BEFORE = "version 5 follows another version 4 than the one here"
OWN = roster(4, hash="4" * 64)
NEXT = replace(OWN, version=5, previous="4" * 64, hash="5" * 64)
WITHOUT = MEMBERS[:1] + MEMBERS[2:]


@pytest.mark.parametrize(
    ("new", "how", "why"),
    [
        (NEXT, "taken", ""),
        (replace(NEXT, registry="another"), "refused", "it is of another registry"),
        (replace(OWN, version=3), "older", "version 4 is here"),
        (OWN, "same", ""),
        (replace(OWN, name="by its hash alone"), "same", ""),
        (replace(OWN, hash="9" * 64), "two rosters", "two rosters have version 4"),
        (replace(NEXT, previous="9" * 64), "taken, two rosters", ANOTHER_BEFORE),
        (replace(NEXT, version=6, previous="9" * 64), "taken", ""),  # the one between is not here
        (replace(NEXT, members=WITHOUT), "refused", "south is neither a member nor removed in it"),
        (replace(NEXT, members=MEMBERS[2:]), "refused", "north, south is neither a member nor removed in it"),
        (replace(NEXT, members=WITHOUT, removed=(*GONE, removed("south", "base"))), "taken", ""),
        (replace(NEXT, removed=GONE[1:]), "refused", GONE_FOR_GOOD),
        (replace(NEXT, members=(*MEMBERS, member("lost", "base")), removed=GONE[1:]), "refused",
         GONE_FOR_GOOD),
        (replace(NEXT, members=WITHOUT, removed=GONE[1:]), "refused", GONE_FOR_GOOD),
    ],
)  # fmt: skip
def test_a_newer_roster_of_the_registry_that_names_every_station_replaces_the_one_here(
    new: Roster, how: str, why: str
) -> None:
    assert taking(new, OWN, REGISTRY) == (how, why)


def test_the_first_roster_is_taken_if_it_is_of_the_registry() -> None:
    assert taking(NEXT, None, REGISTRY) == ("taken", "")
    assert taking(NEXT, None, "another") == ("refused", "it is of another registry")


def test_rosters_are_applied_by_version_then_by_hash_each_after_those_that_were_taken() -> None:
    twin = replace(NEXT, previous="9" * 64, hash="6" * 64)
    third = replace(NEXT, version=6, previous="5" * 64, hash="7" * 64)
    assert best([third, twin, NEXT], OWN, REGISTRY) == [
        (NEXT, "taken", ""), (twin, "two rosters", "two rosters have version 5"), (third, "taken", "")
    ]  # fmt: skip
    astray = replace(third, previous="6" * 64)
    judged = best([astray, twin], OWN, REGISTRY)
    assert [how for _, how, _ in judged] == ["taken, two rosters", "taken"]
    assert best([], None, REGISTRY) == []
