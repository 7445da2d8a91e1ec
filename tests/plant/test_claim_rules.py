"""What one station claims of a node, and what follows from several claims (contract/plant.md sections 2 and 3)."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from teds_provision.protocol.handover.revocation import Revocation
from teds_provision.protocol.keys import SoftwareKey, fingerprint, reset_message
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.chain import counting
from teds_provision.protocol.plant.claim import Claim, had_key
from teds_provision.protocol.plant.merged_claims import BanStatement, LocalState, MergedClaims, bans, merge_claims
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster

UUID = bytes.fromhex("8d4d9da65281f7000000")
NODE = SoftwareKey(77)
PIN, PIN2 = fingerprint(NODE.point), "b2" * 32
A, B, F = "aa" * 8, "bb" * 8, "ff" * 8
JOBS = [f"11111111-2222-4333-8444-{number:012}" for number in range(3)]
DIGESTS = [f"{number:02x}" * 32 for number in range(4)]


def heard(*statements: tuple[str, dict[str, Any]]) -> Claim:
    """Return the claim of a station that stated this on its pages, in this order."""
    claim = Claim()
    for number, (act, members) in enumerate(statements):
        at = members.pop("at", "2026-03-01T12:00:00Z")
        read = event.read({"act": act, "id": f"{number:016x}", "at": at, "uuid": UUID.hex(), **members})
        assert isinstance(read, event.Event), read
        claim.apply_event(read)
    return claim


def agreed(epoch: int, key_id: str = A, key: str = PIN) -> tuple[str, dict[str, Any]]:
    return "agreed", {"fingerprint": key, "epoch": epoch, "key_id": key_id}


def handed(act: str, epoch: int, key_id: str = A, *, peer: str = PIN2, mode: str = "copy", bundle: int = 0):  # type: ignore[no-untyped-def]
    return act, {"epoch": epoch, "key_id": key_id, "peer": peer, "mode": mode, "bundle": JOBS[bundle]}


def written(sequence: int, digest: int = 0, profile: str = "imu") -> tuple[str, dict[str, Any]]:
    members = {"epoch": 1, "sequence": sequence, "teds_sha256": DIGESTS[digest], "profile": profile}
    return "written", {**members, "profile_sha256": None, "due": None}


def undone(bundle: int) -> tuple[str, dict[str, Any]]:
    return "undone", {"bundle": JOBS[bundle], "peer": PIN2, "why": ""}


# -- one station -------------------------------------------------------------------------------------------------------


def test_the_greatest_key_counts_by_epoch_then_id_whatever_came_last() -> None:
    assert heard(agreed(2, B), agreed(2, A)).agreed == (2, B, PIN)
    assert heard(agreed(3, A), agreed(2, F)).agreed == (3, A, PIN)
    assert heard(agreed(2, B), agreed(2, B, PIN2)).agreed == (2, B, PIN2), "of the same key the last"
    assert heard(handed("took", 2, B), handed("took", 2, A), handed("took", 1, F)).took == (2, B)
    for statements, key in (
        ((agreed(1, F), handed("took", 2, A)), (2, A)),
        ((agreed(2, A), handed("took", 1, F)), (2, A)),
        ((agreed(2, A), handed("took", 2, B)), (2, B)),
        ((agreed(2, A),), (2, A)),
        ((handed("took", 2, B),), (2, B)),
        ((), None),
    ):
        assert heard(*statements).key() == key


def test_the_greatest_datasheet_counts_by_sequence_then_digest_and_of_the_same_the_last() -> None:
    assert heard(written(5, 1), written(5, 2), written(5, 0)).written == (5, DIGESTS[2], 1, "imu", None, None)
    assert heard(written(6), written(5, 3)).written == (6, DIGESTS[0], 1, "imu", None, None)
    assert heard(written(5), written(5, 0, "load")).written == (5, DIGESTS[0], 1, "load", None, None)


def test_the_last_pin_counts_and_none_after_an_unpinned() -> None:
    pinned = [("pinned", {"fingerprint": key, "assurance": how}) for key, how in ((PIN, "tap"), (PIN2, "import"))]
    assert heard(*pinned).pin == (PIN2, "import")
    assert heard(agreed(1), pinned[0], ("unpinned", {})).pin is None
    assert heard(pinned[0], ("unpinned", {}), pinned[0]).pin == (PIN, "tap")


def test_the_greatest_epoch_is_forgotten_and_the_last_name_group_and_firmware_count_by_place() -> None:
    assert heard(("forgot", {"epoch": 3}), ("forgot", {"epoch": 1})).forgot == 3
    assert heard().forgot == -1
    early, late = "2026-01-01T00:00:00Z", "2026-02-01T00:00:00Z"
    claim = heard(
        ("named", {"name": "left", "at": late}),
        ("named", {"name": "right", "at": early}),
        ("grouped", {"group": "hand", "member": True, "at": late}),
        ("grouped", {"group": "hand", "member": False, "at": early}),
        ("firmware", {"runs": ["app", "1.0.0+0", None], "at": late}),
        ("firmware", {"runs": None, "at": early}),
    )
    assert (claim.name, claim.groups, claim.firmware) == (("right", early), {"hand": (False, early)}, (None, early))


def test_what_was_undone_was_not_given_a_copy_or_a_move() -> None:
    gave = [handed("gave", 1, bundle=number, mode=mode) for number, mode in ((0, "copy"), (1, "move"), (2, "move"))]
    claim = heard(*gave, undone(0), undone(1))
    assert claim.given_keys() == {(JOBS[2], PIN2, 1, A, "move")}
    assert len(claim.gave) == 3
    assert heard(undone(2), *gave).given_keys() == {
        (JOBS[0], PIN2, 1, A, "copy"),
        (JOBS[1], PIN2, 1, A, "move"),
    }, "whatever came first"


def test_a_claim_in_the_store_has_all_that_it_says_and_nothing_else() -> None:
    challenge = bytes(range(32))
    proof = NODE.sign(reset_message(UUID, 4, challenge)).hex()
    reset = {"epoch": 4, "challenge": challenge.hex(), "proof": proof, "point": NODE.point.hex()}
    claim = heard(
        ("pinned", {"fingerprint": PIN, "assurance": "bus"}),
        agreed(2),
        handed("took", 1, B),
        written(5),
        ("forgot", {"epoch": 0}),
        handed("gave", 2, bundle=1, mode="move"),
        undone(1),
        ("refused", {"bundle": JOBS[2], "peer": PIN2, "why": "revoked"}),
        ("reset", reset),
        ("reset", {**reset, "epoch": 5}),
        ("named", {"name": "left"}),
        ("grouped", {"group": "hand", "member": True}),
        ("firmware", {"runs": ["app", "1.0.0+0", None]}),
    )
    at = "2026-03-01T12:00:00Z"
    assert json.loads(claim.to_json()) == {
        "pin": [PIN, "bus"],
        "agreed": [2, A, PIN],
        "took": [1, B],
        "written": [5, DIGESTS[0], 1, "imu", None, None],
        "forgot": 0,
        "gave": [[JOBS[1], PIN2, 2, A, "move"]],
        "undone": [JOBS[1]],
        "refused": [[JOBS[2], PIN2, "revoked"]],
        "resets": [[PIN, 4]],
        "name": ["left", at],
        "groups": {"hand": [True, at]},
        "firmware": [["app", "1.0.0+0", None], at],
    }
    assert Claim.from_json(claim.to_json()) == claim
    assert Claim().to_json() == "{}"
    assert Claim.from_json("{}") == Claim()


@pytest.mark.parametrize(
    ("own", "others", "had"),
    [
        (heard(agreed(2)), Claim(), True),
        (heard(handed("took", 2)), Claim(), True),
        (heard(handed("gave", 2), undone(0)), Claim(), True),  # who gives a key has had it
        (heard(agreed(2, B)), Claim(), False),
        (heard(agreed(3)), Claim(), False),
        (Claim(), heard(handed("gave", 2, peer="c3" * 32)), True),
        (Claim(), heard(handed("gave", 2, peer="c3" * 32), undone(0)), True),  # it may have arrived before
        (Claim(), heard(handed("gave", 2, B, peer="c3" * 32)), False),
        (Claim(), heard(handed("gave", 2)), False),
        (Claim(), heard(agreed(2)), False),
    ],
)
def test_a_station_had_a_key_that_it_agreed_took_gave_or_was_given_by_anyones_page(
    own: Claim, others: Claim, had: bool
) -> None:
    assert had_key("c3" * 32, (2, A), {"c3" * 32: own, "d4" * 32: others}) is had
    assert had_key("c3" * 32, (2, A), {"d4" * 32: others}) is (had and own == Claim())


# -- several stations --------------------------------------------------------------------------------------------------

ROLES = {"keep": "keeper", "keep2": "keeper", "line": "line audit", "base": "base", "sign": "sign", "look": "audit"}
POINTS = {name: SoftwareKey(600 + number).point for number, name in enumerate((*ROLES, "gone", "lost"))}
AT = {name: fingerprint(point) for name, point in POINTS.items()}
MADE = datetime(2026, 3, 1, tzinfo=UTC)
ROSTER = Roster(
    "r", "plant", 1, "", MADE, MADE + timedelta(days=90),
    tuple(Member(name, POINTS[name], b"", frozenset(roles.split())) for name, roles in ROLES.items()),
    (RemovedMember("gone", POINTS["gone"], frozenset({"base", "keeper"}), "stolen", (9, "")),
     RemovedMember("lost", POINTS["lost"], frozenset({"line"}), "lost", (9, ""))),
)  # fmt: skip
ME = "0" * 64


def view(own: LocalState | None = None, /, **claims: Claim) -> MergedClaims:
    return merge_claims(ROSTER, {AT[name]: claim for name, claim in claims.items()}, own or LocalState(ME))


def held(**claims: Claim) -> dict[str, tuple[int, str]]:
    return {ROSTER.name_of(station): key for station, key in view(**claims).held.items()}


def pins(key: str) -> Claim:
    return Claim(pin=(key, "tap"))


def gave(epoch: int, key_id: str, mode: str) -> set[tuple[str, str, int, str, str]]:
    return {(JOBS[0], PIN2, epoch, key_id, mode)}


def test_a_key_is_held_unless_it_was_forgotten_reset_or_given_away_itself() -> None:
    mine = Claim(agreed=(3, A, PIN))
    assert held(line=mine) == {"line": (3, A)}
    assert held(line=replace(mine, forgot=2)) == {"line": (3, A)}
    assert held(line=replace(mine, forgot=3)) == {}
    for epoch, key_id, mode, left in ((3, A, "move", {}), (3, A, "copy", {"line": (3, A)}),
                                      (3, B, "move", {"line": (3, A)}), (2, A, "move", {"line": (3, A)})):  # fmt: skip
        assert held(line=replace(mine, gave=gave(epoch, key_id, mode))) == left
    for epoch, left in ((2, {"line": (3, A)}), (3, {})):
        assert held(line=mine, keep=pins(PIN), sign=Claim(resets={(PIN, epoch), (PIN2, 9)})) == left
    assert held(line=mine, keep=pins(PIN), sign=Claim(resets={(PIN, 1)}), base=Claim(resets={(PIN, 3)})) == {}
    assert held(line=mine, sign=Claim(resets={(PIN, 3)})) == {"line": (3, A)}, "nobody pins that key"


def test_a_reset_counts_by_the_own_pin_else_by_the_keepers() -> None:
    claims = {"line": Claim(agreed=(3, A, PIN)), "keep": pins(PIN), "sign": Claim(resets={(PIN, 3)})}
    assert view(**claims).resets == {(PIN, 3)}
    assert view(LocalState(ME, pin=PIN2), **claims).resets == frozenset()
    assert view(LocalState(ME, pin=PIN2), **{**claims, "sign": Claim(resets={(PIN2, 3)})}).held == {}


def test_made_is_who_agreed_the_very_key_that_it_holds_and_left_who_left_with_one_that_it_made() -> None:
    seen = view(
        line=Claim(agreed=(3, A, PIN)),
        base=Claim(agreed=(1, A, PIN), took=(3, A)),
        gone=Claim(agreed=(3, A, PIN)),
        lost=Claim(agreed=(1, A, PIN), took=(3, A)),
    )
    assert set(seen.held) == {AT["line"], AT["base"]}
    assert seen.made == {AT["line"]}
    assert seen.left == {AT["gone"]: (3, A)}


def test_the_holder_is_who_works_with_nodes_and_has_the_highest_epoch() -> None:
    claims = {"line": Claim(agreed=(2, A, PIN)), "sign": Claim(took=(9, B)), "look": Claim(took=(9, B))}
    assert view(**claims).holder == (2, {A: (AT["line"],)})
    assert view(sign=Claim(took=(9, B))).holder is None
    assert view(**claims, keep=Claim(took=(3, B))).holder == (3, {B: (AT["keep"],)})
    assert view(**claims, base=Claim(took=(2, A))).holder == (2, {A: tuple(sorted((AT["line"], AT["base"])))})
    two = view(**claims, base=Claim(took=(2, B)))
    hold = {AT["line"]: f"line hold {A}", AT["base"]: f"base hold {B}"}
    assert two.conflicts == {"two holders": "epoch 2: " + "; ".join(hold[station] for station in sorted(hold))}
    assert two.key_it, "it holds back only what would be accepted automatically"
    assert view(**claims, gone=Claim(agreed=(9, B, PIN))).holder == (2, {A: (AT["line"],)}), "it left"


@pytest.mark.parametrize(
    ("claims", "own", "pin", "conflict", "key_it"),
    [
        ({"keep": PIN, "keep2": PIN}, {}, PIN, "", True),
        ({"keep": PIN, "keep2": PIN2}, {}, None, "two keys", False),
        ({"keep": PIN, "keep2": PIN2}, {"pin": PIN, "assurance": "tap", "met": True}, None, "two keys", True),
        ({"keep": PIN, "keep2": PIN2}, {"holds": True}, None, "two keys", True),  # who has its key goes on
        ({"keep": PIN, "line": PIN2}, {}, PIN, "", True),  # keepers name one
        ({"keep": PIN}, {"pin": PIN2, "assurance": "uuid"}, PIN, "other pin", True),
        ({"keep": PIN}, {"pin": PIN, "assurance": "uuid"}, PIN, "", True),
        ({"line": PIN, "base": PIN}, {}, None, "", True),
        ({"line": PIN, "base": PIN2}, {}, None, "two keys", False),
        ({"line": PIN, "look": PIN2}, {}, None, "", True),  # an auditor's word counts for nothing
        ({"line": PIN, "gone": PIN2}, {}, PIN2, "", True),  # a keeper then
        ({"line": PIN, "lost": PIN2}, {}, None, "two keys", False),
        ({"line": PIN}, {"pin": PIN2, "assurance": "uuid"}, None, "two keys", True),
        ({"line": PIN}, {"pin": PIN2, "assurance": "tap", "met": True}, None, "", True),
        ({"line": PIN, "base": PIN2}, {"pin": PIN, "assurance": "bus", "met": True}, None, "", True),
    ],
)
def test_two_keys_of_a_uuid_are_a_conflict_that_holds_back_who_has_not_met_the_node(
    claims: dict[str, str], own: dict[str, Any], pin: str | None, conflict: str, key_it: bool
) -> None:
    seen = view(LocalState(ME, **own), **{name: pins(key) for name, key in claims.items()})
    assert (seen.pin, list(seen.conflicts), seen.key_it) == (pin, [conflict] if conflict else [], key_it)
    assert set(seen.pins) == {AT[name] for name in claims if name != "look"}
    if not claims.keys() & {"keep", "keep2", "gone"}:  # so does a key that was agreed
        by_key = {name: Claim(agreed=(1, A, key)) for name, key in claims.items() if name != "line"}
        again = view(LocalState(ME, **own), line=pins(claims["line"]), **by_key)
        assert (TWO_KEYS in again.conflicts, again.key_it) == (conflict == TWO_KEYS, key_it)


TWO_KEYS = "two keys"


def test_names_and_groups_are_a_keepers_then_the_later_ones_then_those_of_the_higher_fingerprint() -> None:
    high, low = sorted(("line", "base"), key=lambda name: AT[name], reverse=True)

    def called(at: int, name: str) -> Claim:
        moment = f"2026-03-01T12:00:{at:02}Z"
        return Claim(name=(name, moment), groups={"hand": (name == "yes", moment), "arm": (True, moment)})

    for claims, name in (
        ({high: called(5, "yes"), low: called(6, "no")}, "no"),
        ({high: called(5, "yes"), low: called(5, "no")}, "yes"),
        ({high: called(5, "no"), low: called(5, "yes")}, "no"),
        ({high: called(9, "no"), "keep": called(1, "yes")}, "yes"),
        ({high: called(9, "no"), "gone": called(1, "yes")}, "yes"),  # a keeper then
        ({"look": called(9, "no"), low: called(1, "yes")}, "yes"),
    ):
        seen = view(**claims)
        assert (seen.name, seen.groups) == (name, {"arm": True, "hand": name == "yes"})
    seen = view(**{high: called(9, "no"), "keep": called(1, "yes")})
    assert seen.keeper_groups == {"arm": True, "hand": True}
    assert seen.own_groups == {AT[high]: ("arm",), AT["keep"]: ("arm", "hand")}
    assert view(**{high: called(9, "yes")}).keeper_groups == {}


def test_firmware_is_that_of_the_newest_report_and_of_a_lost_station_after_all_others() -> None:
    def runs(version: str, at: int) -> Claim:
        return Claim(firmware=(("app", version, None), f"2026-03-01T12:00:{at:02}Z"))

    seen = view(line=runs("1", 5), base=runs("2", 6), gone=runs("3", 59), lost=runs("4", 58), look=runs("5", 59))
    assert [(ROSTER.name_of(one.station), one.runs and one.runs[1]) for one in seen.firmware] == [
        ("base", "2"), ("line", "1"), ("gone", "3"), ("lost", "4")
    ]  # fmt: skip
    retired = replace(ROSTER, removed=(replace(ROSTER.removed[0], why="retired"), ROSTER.removed[1]))
    claims = {AT[name]: runs(name, at) for name, at in (("line", 5), ("gone", 59), ("lost", 58))}
    order = merge_claims(retired, claims, LocalState(ME)).firmware
    assert [ROSTER.name_of(one.station) for one in order] == ["gone", "line", "lost"], "retired in order"


# -- bans --------------------------------------------------------------------------------------------------------------


def ban(signer: str, *, page_of: str = "", counts: bool = True, key: str | None = PIN) -> BanStatement:
    made = Revocation(UUID, key, "lost", MADE, AT[signer], "statement")
    return BanStatement("e5" * 32, AT[page_of or signer], counts, made)


@pytest.mark.parametrize(
    ("statement", "own", "lifted", "bans_it"),
    [
        (ban("keep"), {}, "", True),
        (ban("keep", page_of="line"), {}, "", True),  # carried by another station
        (ban("keep", counts=False), {}, "", True),  # on either branch of two histories
        (ban("line"), {}, "", False),  # certified by the CA is not enough
        (ban("line"), {"holders": frozenset({AT["line"]})}, "", True),
        (ban("line", page_of="base"), {"holders": frozenset({AT["line"]})}, "", True),
        (ban("line"), {"station": AT["line"]}, "", True),
        (ban("line"), {"holders": frozenset({AT["base"]})}, "", False),
        (ban("keep"), {"pin": PIN}, "", True),
        (ban("keep"), {"pin": PIN2}, "", False),  # another board
        (ban("keep", key=None), {"pin": PIN2}, "", True),  # whatever key it has
        (ban("keep", key=PIN2), {}, "", True),
        (ban("gone"), {}, "", True),  # on its own pages up to the last
        (ban("gone", counts=False), {}, "", False),
        (ban("gone", page_of="base"), {}, "", False),
        (ban("lost"), {}, "", False),
        (ban("lost"), {"holders": frozenset({AT["lost"]})}, "", True),
        (ban("keep"), {}, "keep2", False),
        (ban("keep"), {}, "keep", False),
        (ban("keep"), {}, "line", True),
        (ban("keep"), {}, "gone", False),  # a keeper then; the page counts
        (ban("line"), {"holders": frozenset({AT["line"]})}, "line", False),
        (ban("line"), {"holders": frozenset({AT["line"]})}, "base", True),
        (ban("line"), {"holders": frozenset({AT["line"]})}, "keep", False),
        (ban("keep"), {"lifted": frozenset({"e5" * 32})}, "", False),  # by a person here
        (ban("keep"), {"lifted": frozenset({"f6" * 32})}, "", True),
    ],
)
def test_a_ban_counts_by_its_signer_until_a_keeper_its_signer_or_a_person_here_lifts_it(
    statement: BanStatement, own: dict[str, Any], lifted: str, bans_it: bool
) -> None:
    state = LocalState(**{"station": ME, **own})
    liftings = {"e5" * 32: {AT[lifted]}} if lifted else {}
    assert bans(ROSTER, statement, state, liftings) is bans_it
    assert bans(ROSTER, statement, state, {"f6" * 32: set(AT.values()), **liftings}) is bans_it, "each needs its own"
    assert merge_claims(ROSTER, {}, state, [statement], liftings).bans == ((statement,) if bans_it else ())


# -- which pages count -------------------------------------------------------------------------------------------------

STRAIGHT = [(1, "a", ""), (2, "b", "a"), (3, "c", "b")]
FORKED = [*STRAIGHT, (2, "B", "a"), (3, "C", "B"), (4, "D", "C")]


@pytest.mark.parametrize(
    ("pages", "last", "accepted", "newest", "two"),
    [
        (STRAIGHT, None, None, (3, "c"), None),
        (STRAIGHT, (2, "b"), None, (2, "b"), None),
        (STRAIGHT, (0, ""), None, (0, ""), None),
        (STRAIGHT, (3, "C"), None, (2, "b"), 3),  # the roster names another page 3
        (STRAIGHT, (5, "e"), None, (3, "c"), None),  # two pages are not here yet
        ([*STRAIGHT, (5, "e", "d")], None, None, (3, "c"), None),
        ([*STRAIGHT, (4, "d", "X")], None, None, (2, "b"), 3),  # it follows another page 3 than the one here
        ([(1, "a", ""), (3, "c", "X"), (3, "C", "Y")], None, None, (1, "a"), 2),
        ([(1, "a", ""), (3, "c", "b")], None, None, (1, "a"), None),
        ([(2, "b", "a"), (3, "c", "b")], None, None, (0, ""), None),
        (FORKED, None, None, (1, "a"), 2),
        (FORKED, None, (2, "B"), (4, "D"), None),
        (FORKED, None, (2, "b"), (3, "c"), None),
        (FORKED, (3, "c"), (2, "B"), (3, "c"), None),  # the roster goes before a person
        (FORKED, (3, "C"), None, (3, "C"), None),
        (FORKED, None, (2, "x"), (1, "a"), 2),  # no such page
        ([], None, None, (0, ""), None),
    ],
)
def test_a_chain_counts_to_where_it_parts_or_to_the_page_that_the_roster_names(
    pages: list[tuple[int, str, str]], last: Any, accepted: Any, newest: tuple[int, str], two: int | None
) -> None:
    for given in (pages, pages[::-1]):
        found = counting(given, last=last, accepted=accepted)
        assert (found.newest, found.two) == (newest, two)
