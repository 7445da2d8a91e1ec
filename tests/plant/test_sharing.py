"""Who copies which key to whom, who forgets it, and what is accepted (contract/plant.md section 4), rule by rule."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from typing import Any, Literal

import pytest

from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.plant.merged_claims import MergedClaims, _holders
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster, Share
from teds_provision.protocol.plant.sharing import (
    Offer,
    forgets,
    gave_away,
    receivers,
    rotator,
    sharer,
    shares_any,
    silent,
    why_not,
)

NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)
ROLES = {"north": "keeper sign base", "south": "base", "west": "line", "east": "base"}
POINTS = {name: SoftwareKey(number).point for number, name in enumerate((*ROLES, "gone", "stranger"), 5)}
MEMBERS = {name: Member(name, POINTS[name], b"", frozenset(roles.split())) for name, roles in ROLES.items()}
GONE = RemovedMember("gone", POINTS["gone"], frozenset({"base"}), "lost", (0, ""))
STATIONS: dict[str, Member | RemovedMember] = {
    **MEMBERS,
    "gone": GONE,
    "stranger": replace(GONE, point=POINTS["stranger"]),
}
AT = {name: station.fingerprint for name, station in STATIONS.items()}
NORTH, SOUTH, WEST, EAST = (AT[name] for name in ROLES)
What = tuple[Literal["all", "group", "profile"], str]
ALL: What = ("all", "")
KEY, OTHER = (3, "a1"), (4, "b2")
PIN, PIN2 = "c3" * 32, "d4" * 32
UUID = bytes(10)


def roster(*shares: Share) -> Roster:
    until = NOW + timedelta(days=90)
    return Roster("r", "plant", 1, "", NOW, until, tuple(MEMBERS.values()), (GONE,), share=shares)


def view(**more: Any) -> MergedClaims:
    """A node that west keyed and nobody disputes."""
    known = MergedClaims(
        pin=PIN, pins={WEST: PIN}, held={WEST: KEY}, made=frozenset({WEST}), holder=None, written={}, gave=frozenset(),
        resets=frozenset(), bans=(), name=None, groups={}, conflicts={}, key_it=False,
    )  # fmt: skip
    return replace(known, **more)


def test_copies_go_to_present_members_with_base_in_the_order_of_the_share_and_never_back() -> None:
    share = Share(ALL, (SOUTH, WEST, AT["gone"], AT["stranger"], NORTH, EAST))
    assert receivers(roster(), NORTH, share) == (SOUTH, EAST)
    assert receivers(roster(), EAST, share) == (SOUTH, NORTH)


@pytest.mark.parametrize(
    ("what", "sender", "shared"),
    [
        (ALL, EAST, True),
        (("profile", "imu"), WEST, True),
        (("profile", "imu"), SOUTH, False),  # west wrote it, not south
        (("profile", "load"), WEST, False),
        (("profile", "cell 3"), WEST, False),  # that is a group
        (("group", "cell 3"), WEST, True),  # its own
        (("group", "cell 3"), SOUTH, False),
        (("group", "cell 5"), SOUTH, True),  # a keeper's
        (("group", "cell 6"), SOUTH, False),  # a keeper took it out
        (("group", "imu"), WEST, False),
    ],
)
def test_a_share_is_of_all_nodes_or_of_those_that_its_sender_or_a_keeper_put_there(
    what: What, sender: str, shared: bool
) -> None:
    known = view(
        written={WEST: (7, "e5" * 32, "imu")},
        own_groups={WEST: ("cell 3",)},
        keeper_groups={"cell 5": True, "cell 6": False},
        groups={"cell 3": True, "cell 6": True},
    )
    assert shares_any([Share(what, (NORTH,))], known, sender) is shared
    assert shares_any([Share(("profile", "none"), ()), Share(what, ())], known, sender) is shared
    assert not shares_any([], known, sender)


def test_who_gave_a_node_away_by_a_move_gets_no_copy() -> None:
    copied = (WEST, 3, "a1", SOUTH, "copy", "id")
    moved = (SOUTH, 3, "a1", NORTH, "move", "id")
    known = view(gave=frozenset({copied, moved}))
    assert [gave_away(known, station) for station in (WEST, SOUTH, NORTH)] == [False, True, False]


LOWEST, MIDDLE, HIGHEST = sorted((NORTH, SOUTH, EAST))


@pytest.mark.parametrize(
    ("held", "made", "quiet", "left", "who"),
    [
        ({LOWEST: KEY, HIGHEST: KEY}, {HIGHEST}, set(), {}, HIGHEST),
        ({LOWEST: KEY, MIDDLE: KEY, HIGHEST: KEY}, {MIDDLE, HIGHEST}, set(), {}, MIDDLE),
        ({LOWEST: KEY, MIDDLE: KEY, HIGHEST: KEY}, {MIDDLE, HIGHEST}, {MIDDLE}, {}, HIGHEST),
        ({HIGHEST: KEY, MIDDLE: KEY, LOWEST: KEY}, {HIGHEST}, {HIGHEST}, {}, LOWEST),  # its maker is silent
        ({HIGHEST: KEY, MIDDLE: KEY, LOWEST: KEY}, {HIGHEST}, {HIGHEST, LOWEST}, {}, MIDDLE),
        ({HIGHEST: KEY, MIDDLE: KEY}, {HIGHEST}, {HIGHEST, MIDDLE}, {}, None),
        ({HIGHEST: KEY, MIDDLE: KEY}, set(), set(), {AT["gone"]: KEY}, min(HIGHEST, MIDDLE)),  # its maker was removed
        ({HIGHEST: KEY, MIDDLE: KEY}, set(), set(), {AT["gone"]: OTHER}, None),
        ({HIGHEST: KEY, MIDDLE: KEY}, set(), set(), {}, None),  # who made it is unknown
        ({LOWEST: OTHER, HIGHEST: KEY}, {LOWEST}, {HIGHEST}, {}, None),  # that one made another key
        ({LOWEST: OTHER, HIGHEST: KEY}, {LOWEST, HIGHEST}, set(), {}, HIGHEST),
    ],
)
def test_the_maker_of_a_key_shares_it_else_the_lowest_holder_once_the_maker_is_removed_or_silent(
    held: Any, made: set[str], quiet: set[str], left: Any, who: str | None
) -> None:
    assert sharer(roster(), view(held=held, made=frozenset(made), left=left), KEY, quiet) == who


@pytest.mark.parametrize(
    ("held", "made", "me", "who"),
    [
        ({LOWEST: KEY, HIGHEST: KEY}, {HIGHEST}, LOWEST, HIGHEST),
        ({MIDDLE: KEY, HIGHEST: KEY}, set(), HIGHEST, MIDDLE),
        ({MIDDLE: KEY, HIGHEST: KEY}, set(), LOWEST, LOWEST),  # it holds the key, though no page of its own says so
        ({LOWEST: OTHER, HIGHEST: KEY}, set(), HIGHEST, HIGHEST),
        ({LOWEST: OTHER, HIGHEST: KEY}, {LOWEST}, HIGHEST, HIGHEST),
    ],
)
def test_a_key_that_a_removed_station_held_is_rotated_by_its_maker_else_by_the_lowest_holder(
    held: Any, made: set[str], me: str, who: str
) -> None:
    assert rotator(view(held=held, made=frozenset(made)), KEY, me) == who


def test_a_station_is_silent_if_its_newest_page_is_more_than_seven_days_old_or_none_came() -> None:
    second = timedelta(seconds=1)
    pages = {"old": NOW - timedelta(days=7) - second, "due": NOW - timedelta(days=7), "new": NOW, "none": None}
    assert silent(pages, NOW) == {"old", "none"}


# -- what is accepted ----------------------------------------------------------------------------------------------

OFFER = Offer(UUID, 3, "a1", PIN)
TO_SOUTH, TO_EAST, IMU = Share(ALL, (SOUTH,)), Share(ALL, (EAST,)), Share(("profile", "imu"), (SOUTH,))
LATER = "the sender's pages are not here yet"
OTHER_NODE = "it comes with another node key than the one that it is pinned to"
NOT_THIS_NODE = "no share of the roster is of this node"
NOT_MADE = "east did not make this key, and others of its holders can be asked"
ACCEPTED = ""


def asked(
    *shares: Share, offer: Offer = OFFER, sender: str = WEST, pin: str | None = None, quiet: set[str] | None = None,
    **more: Any,
) -> str:  # fmt: skip
    whole = roster(*(shares or (TO_SOUTH,)))
    return why_not(whole, view(**more), offer, sender=sender, receiver=SOUTH, pin=pin, quiet=quiet or set())


def unpinned(**more: Any) -> str:
    """Of a node that neither this station nor a keeper pins."""
    known = replace(view(**more), pin=None)
    return why_not(roster(TO_SOUTH), known, OFFER, sender=WEST, receiver=SOUTH, pin=None, quiet=set())


DISPUTED = "other pin: the pin is another one; two keys: north and west name two keys"
IN_CONFLICT = {"two keys": "north and west name two keys", "other pin": "the pin is another one"}


@pytest.mark.parametrize(
    ("answer", "why"),
    [
        (asked, ACCEPTED),
        (partial(asked, TO_EAST), "no share of the roster sends it here"),
        (partial(asked, IMU), NOT_THIS_NODE),
        (partial(asked, IMU, TO_EAST), NOT_THIS_NODE),
        (partial(asked, IMU, TO_SOUTH), ACCEPTED),
        (partial(asked, conflicts=IN_CONFLICT), DISPUTED),
        (partial(asked, pin=PIN2), OTHER_NODE),
        (partial(asked, pin=PIN, pins={WEST: PIN2}), ACCEPTED),  # what is pinned here counts
        (partial(asked, pins={}), ACCEPTED),  # the keepers name it
        (partial(asked, offer=replace(OFFER, node=PIN2)), OTHER_NODE),  # the keepers' pin
        (partial(asked, held={WEST: OTHER}), LATER),
        (partial(asked, held={WEST: (2, "a1")}), LATER),
        (partial(asked, held={NORTH: KEY}), LATER),
        (partial(unpinned, pins={WEST: PIN, NORTH: PIN2}), ACCEPTED),  # its sender names it
        (partial(unpinned, pins={WEST: PIN2, NORTH: PIN}), LATER),
        (partial(unpinned, pins={NORTH: PIN}), ACCEPTED),
        (partial(unpinned, pins={}), LATER),
        (partial(asked, sender=EAST, held={WEST: KEY, EAST: KEY}), NOT_MADE),
        (partial(asked, TO_EAST, conflicts=IN_CONFLICT), "no share of the roster sends it here"),  # the first of two
        (partial(asked, conflicts=IN_CONFLICT, pin=PIN2), DISPUTED),
        (partial(asked, pin=PIN2, held={}), OTHER_NODE),
        (partial(asked, IMU, held={WEST: OTHER}), LATER),
        (partial(asked, IMU, sender=EAST, held={WEST: KEY, EAST: KEY}), NOT_MADE),
        (partial(asked, sender=EAST, held={WEST: KEY, EAST: KEY}, quiet={WEST}), ACCEPTED),
    ],
)  # fmt: skip
def test_a_copy_is_accepted_only_by_a_share_from_the_maker_for_an_undisputed_node(
    answer: Callable[[], str], why: str
) -> None:
    assert answer() == why


def test_who_holds_the_newest_epoch_works_with_nodes() -> None:
    roles = ("keeper", "base", "line", "sign")
    members = tuple(Member(name, POINTS[name], b"", frozenset({role})) for name, role in zip(ROLES, roles, strict=True))
    known = replace(roster(), members=members)
    held = {NORTH: (3, "a1"), SOUTH: (3, "b2"), WEST: (3, "a1"), EAST: (4, "c3")}
    assert _holders(known, held) == (3, {"a1": (NORTH, WEST), "b2": (SOUTH,)})
    assert _holders(known, {**held, WEST: (5, "a1")}) == (5, {"a1": (WEST,)})
    assert _holders(known, {EAST: (4, "c3")}) == (None, {})


# -- what is forgotten ---------------------------------------------------------------------------------------------

KEEPS, FORGETS = Share(ALL, (EAST,)), Share(ALL, (SOUTH, NORTH), forget=True)


@pytest.mark.parametrize(
    ("shares", "taken", "forgotten"),
    [
        ([FORGETS], {SOUTH, NORTH}, True),
        ([FORGETS], {SOUTH}, False),
        ([FORGETS], set(), False),
        ([FORGETS], {SOUTH, NORTH, EAST}, True),
        ([], {SOUTH, NORTH}, False),
        ([KEEPS], {EAST}, False),  # nothing allows it
        ([KEEPS, FORGETS], {SOUTH, NORTH}, True),  # only who is named by a share that forgets is waited for
        ([KEEPS, FORGETS], {EAST}, False),
        ([FORGETS, Share(ALL, (EAST,), forget=True)], {SOUTH, NORTH}, False),
        ([FORGETS, Share(ALL, (WEST,))], {SOUTH, NORTH}, False),  # another share names this station
        ([Share(ALL, (WEST, SOUTH), forget=True)], {SOUTH}, False),
        ([Share(ALL, (AT["gone"],), forget=True)], set(), False),  # nobody has it then
        ([Share(ALL, (SOUTH, AT["gone"]), forget=True)], {SOUTH}, True),
    ],
)
def test_a_key_is_forgotten_once_all_receivers_of_a_share_that_forgets_have_it(
    shares: list[Share], taken: set[str], forgotten: bool
) -> None:
    assert forgets(roster(*shares), WEST, iter(shares), taken) is forgotten
