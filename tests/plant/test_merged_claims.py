"""Merged claims: one view of the same pages, whatever order they came in, and no liar that makes a good node bad."""

from __future__ import annotations

import json
import random
from dataclasses import replace
from typing import Any

import pytest

from teds_provision.errors import TedsProvisionError
from teds_provision.protocol.handover.revocation import open_revocation, seal_revocation
from teds_provision.protocol.keys import SoftwareKey, fingerprint, reset_message
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.chain import counting
from teds_provision.protocol.plant.claim import Claim
from teds_provision.protocol.plant.merged_claims import LocalState
from teds_provision.protocol.plant.roster import Place, Roster, Why, open_roster
from tests.plant.plants import NODES, NOW, Reader, Speaker, roster_of, shuffled, speaker
from tests.plant.test_documents import CA, KAT, octets_of

NODE = SoftwareKey(77)
PIN, OTHER = fingerprint(NODE.point), "ab" * 32
DIGEST, DIGEST2 = "d1" * 32, "d2" * 32
A = NODES[0]
OLD, NEW = ["nrf/loadcell", "1.2.0+3", "a1" * 32], ["nrf/loadcell", "1.3.0+0", "a2" * 32]


# -- the known answers -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", KAT["views"])
def test_the_known_views_follow_from_their_pages(name: str) -> None:
    given = KAT["views"][name]
    known = {page: octets_of(page) for page in given["pages"]}
    without_bans = [octets for page, octets in known.items() if page != "north 1"]
    roster = open_roster(octets_of(given["roster"]), CA.point)
    reader = Reader(roster, without_bans)
    if "north 1" in known:  # its statements name no signer ("from"): the product's form stands, and they are skipped
        add_without_statements(reader, known["north 1"])
    for digits, due in given["view"]["nodes"].items():
        seen = reader.view(bytes.fromhex(digits))
        assert seen.pin == due["pin"]
        assert seen.pins == due["pins"]
        assert {station: list(key) for station, key in seen.held.items()} == due["held"]
        assert sorted(seen.made) == due["made"]
        holder = (
            {"epoch": seen.holder[0], "says": {k: list(v) for k, v in seen.holder[1].items()}} if seen.holder else None
        )
        assert holder == due["holder"]
        assert {station: list(pair) for station, pair in seen.written.items()} == due["written"]
        assert sorted(map(list, seen.gave)) == due["gave"]
        assert sorted(map(list, seen.resets)) == due["resets"]
        assert (seen.name, seen.groups, seen.keeper_groups) == (due["name"], due["groups"], due["keeper_groups"])
        assert {name: list(groups) for name, groups in seen.own_groups.items()} == due["own_groups"]
        assert (list(seen.conflicts), seen.key_it) == (due["conflicts"], due["key_it"])
    two = [station for station, counts in reader.counting.items() if counts.two]
    assert two == given["view"]["two_histories"]
    for _, station, digest, result, _ in given["signing_station"]:
        signer = KAT["keys"][station]["fingerprint"]
        assert reader.signing(signer, digest).result == result, (station, digest)


@pytest.mark.parametrize("roster", KAT["firmware"]["views"])
def test_the_known_firmware_follows_from_its_pages(roster: str) -> None:
    reader = Reader(open_roster(octets_of(roster), CA.point), [])
    for station, numbers in {"west": (1, 2, 3), "south": (1, 2), "north": (1, 2)}.items():
        pages = [KAT["documents"][f"{station} {n}"]["payload"] for n in numbers]
        signer = KAT["keys"][station]["fingerprint"]
        gone = reader.roster.removed_one(signer)
        for payload in pages:
            for item in map(event.read, payload["events"]):
                if (
                    isinstance(item, event.Event)
                    and item.act != "revoked"
                    and (gone is None or payload["n"] <= gone.last[0])
                ):
                    reader._take(signer, (payload["n"], ""), item)
    for digits, due in KAT["firmware"]["views"][roster].items():
        seen = reader.view(bytes.fromhex(digits)).firmware
        assert [[claim.station, claim.runs and list(claim.runs), claim.at] for claim in seen] == due


def add_without_statements(reader: Reader, octets: bytes) -> None:
    from teds_provision.protocol.plant.page import open_page

    page = open_page(octets, KAT["registry"], reader.roster.point_of)
    reader.pages[page.station] = {(page.number, page.hash): page}
    reader.counting[page.station] = counting([(page.number, page.hash, page.previous)], last=None, accepted=None)
    for event_read in map(event.read, page.events):
        assert isinstance(event_read, event.Event)
        if event_read.act != "revoked":
            reader._take(page.station, (page.number, page.hash), event_read)
        else:
            with pytest.raises(TedsProvisionError):
                open_revocation(event_read.members["statement"], reader.roster.point_of)


# -- which pages count -------------------------------------------------------------------------------------------------


def test_a_chain_counts_up_to_where_two_histories_part() -> None:
    first = [(1, "a", ""), (2, "b", "a"), (3, "c", "b")]
    assert counting(first, last=None, accepted=None).pages == ((1, "a"), (2, "b"), (3, "c"))
    two = [*first, (3, "C", "b")]
    assert (counting(two, last=None, accepted=None).newest, counting(two, last=None, accepted=None).two) == (
        (2, "b"),
        3,
    )
    torn = [*first, (4, "d", "X")]  # page 4 follows another page 3 than the one here
    assert (counting(torn, last=None, accepted=None).newest, counting(torn, last=None, accepted=None).two) == (
        (2, "b"),
        3,
    )


def test_the_roster_or_a_person_names_the_branch() -> None:
    pages = [(1, "a", ""), (2, "b", "a"), (2, "B", "a"), (3, "c", "b"), (3, "C", "B")]
    assert counting(pages, last=None, accepted=(2, "B")).newest == (3, "C")
    assert counting(pages, last=None, accepted=(3, "c")).newest == (3, "c")
    assert counting(pages, last=(2, "b"), accepted=(2, "B")).newest == (2, "b")
    assert counting(pages, last=(0, ""), accepted=None).newest == (0, "")
    assert counting(pages[:1], last=(2, "b"), accepted=None) == counting(pages[:1], last=None, accepted=None)
    assert counting([pages[0], pages[2]], last=(2, "b"), accepted=None).two == 2
    later = [*pages, (4, "d", "c"), (4, "D", "c")]
    assert (
        counting(later, last=None, accepted=(3, "c")).newest,
        counting(later, last=None, accepted=(3, "c")).two,
    ) == (
        (3, "c"),
        4,
    )


def test_a_gap_is_waited_for() -> None:
    assert counting([(1, "a", ""), (3, "c", "b")], last=None, accepted=None).pages == ((1, "a"),)


# -- a claim is what it was in the store -------------------------------------------------------------------------------


def chatter(seed: int) -> list[Speaker]:
    """Return stations of every role that say things at random, now and then two things at one place."""
    chance = random.Random(seed)
    speakers = [
        speaker("keep", "keeper", "sign", "line", "base"), speaker("keep2", "keeper"), speaker("line", "line", "sign"),
        speaker("base", "base"), speaker("sign", "sign"), speaker("audit", "audit"),
    ]  # fmt: skip
    for current in speakers:
        places: list[Place] = [(0, "")]
        for _ in range(chance.randrange(1, 5)):
            events = [anything(current, chance, speakers) for _ in range(chance.randrange(5))]
            if chance.random() < 0.1:
                events += events[:1]  # an id that stood before
            fork = chance.choice(places) if chance.random() < 0.1 else None
            heads = {other.fingerprint: other.head for other in speakers if other.head[0] and other is not current}
            places.append(current.page(*events, heads=heads, after=fork))
    return speakers


def anything(current: Speaker, chance: random.Random, speakers: list[Speaker]) -> dict[str, Any]:
    uuid, epoch = chance.choice(NODES), chance.randrange(4)
    key, peer = chance.choice([PIN, OTHER]), chance.choice(speakers).fingerprint
    key_id, bundle = chance.choice(["0" * 16, "1" * 16]), f"11111111-2222-4333-8444-{chance.randrange(3):012}"
    handed = {"epoch": epoch, "key_id": key_id, "peer": peer, "mode": chance.choice(["copy", "move"]), "bundle": bundle}
    second, challenge = chance.randrange(100), bytes(32)
    statement = seal_revocation(current.key, uuid=uuid, node=key, why="lost", created=NOW)
    acts: list[tuple[str, bytes | None, dict[str, Any]]] = [
        ("pinned", uuid, {"fingerprint": key, "assurance": "tap"}),
        ("unpinned", uuid, {}),
        ("agreed", uuid, {"fingerprint": key, "epoch": epoch, "key_id": key_id}),
        ("took", uuid, handed),
        ("gave", uuid, handed),
        ("undone", uuid, {"bundle": bundle, "peer": peer, "why": "by hand"}),
        ("forgot", uuid, {"epoch": epoch}),
        ("signed", uuid, {"epoch": epoch, "sequence": 1, "teds_sha256": DIGEST}),
        ("vouched", uuid, {"teds_sha256": DIGEST2}),
        ("written", uuid, {"epoch": epoch, "sequence": chance.randrange(9), "teds_sha256": DIGEST, "profile": "finger",
                           "profile_sha256": None, "due": None}),
        ("reset", uuid, {"epoch": epoch, "challenge": challenge.hex(), "point": NODE.point.hex(),
                         "proof": NODE.sign(reset_message(uuid, epoch, challenge)).hex()}),
        ("named", uuid, {"name": chance.choice(["left", "right"])}),
        ("grouped", uuid, {"group": "hand", "member": chance.random() < 0.5}),
        ("firmware", uuid, {"runs": chance.choice([None, OLD, NEW])}),
        ("revoked", uuid, {"statement": statement.statement}),
        ("lifted", None, {"of": event.hash_of_statement(statement.statement)}),
    ]  # fmt: skip
    act, node, members = chance.choice(acts)
    return current.event(act, node, second, **members)


@pytest.mark.parametrize("seed", range(12))
def test_the_order_in_which_pages_arrive_changes_no_view(seed: int) -> None:
    speakers = chatter(seed)
    pages = [octets for current in speakers for octets in current.pages]
    gone = speakers[seed % len(speakers)]
    rosters = [
        roster_of(speakers),
        roster_of([current for current in speakers if current is not gone], [(gone, gone.head)]),
    ]
    for roster in rosters:
        first = Reader(roster, pages)
        for again in range(4):
            other = Reader(roster, shuffled(pages, again))
            for uuid in NODES:
                for own in (LocalState("f" * 64), LocalState("f" * 64, pin=PIN, met=True)):
                    assert other.view(uuid, own) == first.view(uuid, own)
            for current in speakers:
                for digest in (DIGEST, DIGEST2):
                    assert other.signing(current.fingerprint, digest) == first.signing(current.fingerprint, digest)


@pytest.mark.parametrize("seed", range(6))
def test_a_claim_comes_back_from_the_store_as_it_was(seed: int) -> None:
    speakers = chatter(seed)
    reader = Reader(roster_of(speakers), [octets for current in speakers for octets in current.pages])
    for claims in reader.claims.values():
        for claim in claims.values():
            assert Claim.from_json(json.loads(json.dumps(claim.to_json()))) == claim


# -- who wins ----------------------------------------------------------------------------------------------------------


def pinned(current: Speaker, key: str, uuid: bytes = A) -> dict[str, Any]:
    return current.event("pinned", uuid, fingerprint=key, assurance="tap")


def agreed(current: Speaker, epoch: int, key_id: str = "0" * 16, key: str = PIN) -> dict[str, Any]:
    return current.event("agreed", A, fingerprint=key, epoch=epoch, key_id=key_id)


def handed(
    current: Speaker, act: str, peer: Speaker, epoch: int, mode: str = "copy", bundle: int = 0
) -> dict[str, Any]:
    return current.event(
        act, A, epoch=epoch, key_id="0" * 16, peer=peer.fingerprint, mode=mode,
        bundle=f"11111111-2222-4333-8444-{bundle:012}",
    )  # fmt: skip


@pytest.fixture
def four() -> list[Speaker]:
    return [
        speaker("keep", "keeper"),
        speaker("keep2", "keeper"),
        speaker("line", "line", "sign"),
        speaker("base", "base"),
    ]


def pages_of(speakers: list[Speaker]) -> list[bytes]:
    return [octets for current in speakers for octets in current.pages]


def test_keepers_pin_for_all_stations_while_they_agree(four: list[Speaker]) -> None:
    keep, keep2, line, _ = four
    keep.page(pinned(keep, PIN))
    line.page(pinned(line, OTHER))
    assert Reader(roster_of(four), pages_of(four)).view(A).pin == PIN
    assert not Reader(roster_of(four), pages_of(four)).view(A).conflicts
    keep2.page(pinned(keep2, OTHER))
    seen = Reader(roster_of(four), pages_of(four)).view(A)
    assert (seen.pin, list(seen.conflicts), seen.key_it) == (None, ["two keys"], False)
    keep2.page(keep2.event("unpinned", A))
    assert Reader(roster_of(four), pages_of(four)).view(A).pin == PIN


def test_a_local_pin_that_differs_from_the_keepers_stays_and_is_reported(four: list[Speaker]) -> None:
    four[0].page(pinned(four[0], PIN))
    seen = Reader(roster_of(four), pages_of(four)).view(A, LocalState("f" * 64, pin=OTHER, assurance="tap", met=True))
    assert (list(seen.conflicts), seen.key_it) == (["other pin"], True)


def test_two_keys_hold_back_only_stations_that_have_not_met_the_node(four: list[Speaker]) -> None:
    _, _, line, base = four
    line.page(pinned(line, PIN))
    base.page(agreed(base, 1, key=OTHER))
    reader = Reader(roster_of(four), pages_of(four))
    assert list(reader.view(A).conflicts) == ["two keys"]
    assert not reader.view(A).key_it
    assert reader.view(A, LocalState("f" * 64, pin=PIN, met=True)).key_it
    assert not reader.view(A, LocalState("f" * 64, pin=PIN, met=True)).conflicts
    assert reader.view(A, LocalState("f" * 64, holds=True)).key_it
    assert reader.view(A, LocalState("f" * 64, pin=PIN, assurance="uuid")).key_it
    assert not reader.view(A, LocalState("f" * 64, pin=PIN, assurance="registry")).key_it


def test_the_highest_epoch_is_the_holder_and_two_keys_of_it_are_reported(four: list[Speaker]) -> None:
    _, _, line, base = four
    line.page(agreed(line, 2))
    base.page(handed(base, "took", line, 1))
    seen = Reader(roster_of(four), pages_of(four)).view(A)
    assert seen.holder == (2, {"0" * 16: (line.fingerprint,)})
    base.page(agreed(base, 2, "1" * 16))
    seen = Reader(roster_of(four), pages_of(four)).view(A)
    assert list(seen.conflicts) == ["two holders"]
    assert seen.key_it


def test_a_move_that_was_not_undone_ends_a_holder_and_a_reset_ends_all(four: list[Speaker]) -> None:
    keep, _, line, base = four
    line.page(agreed(line, 1), handed(line, "gave", base, 1, "move"))
    assert not Reader(roster_of(four), pages_of(four)).view(A).held
    undone = line.event("undone", A, bundle=f"11111111-2222-4333-8444-{0:012}", peer=base.fingerprint, why="")
    line.page(undone)
    assert set(Reader(roster_of(four), pages_of(four)).view(A).held) == {line.fingerprint}
    challenge = bytes(32)
    proof = NODE.sign(reset_message(A, 1, challenge)).hex()
    base.page(base.event("reset", A, epoch=1, challenge=challenge.hex(), proof=proof, point=NODE.point.hex()))
    reader = Reader(roster_of(four), pages_of(four))
    assert set(reader.view(A).held) == {line.fingerprint}, "nobody pins this key: the reset counts nowhere"
    assert not reader.view(A, LocalState("f" * 64, pin=PIN)).held
    assert set(reader.view(A, LocalState("f" * 64, pin=OTHER)).held) == {line.fingerprint}
    keep.page(pinned(keep, PIN))
    reader = Reader(roster_of(four), pages_of(four))
    assert not reader.view(A).held
    assert set(reader.view(A, LocalState("f" * 64, pin=OTHER)).held) == {line.fingerprint}, "one's own pin decides here"


def test_what_a_station_wrote_last_counts_of_one_sequence(four: list[Speaker]) -> None:
    line = four[2]

    def written(sequence: int, digest: str, profile: str) -> dict[str, Any]:
        return line.event(
            "written", A, epoch=1, sequence=sequence, teds_sha256=digest, profile=profile, profile_sha256=None, due=None
        )

    line.page(written(1, DIGEST, "a"), written(2, DIGEST, "b"), written(2, DIGEST, "c"), written(1, DIGEST2, "d"))
    seen = Reader(roster_of(four), pages_of(four)).view(A)
    assert seen.written == {line.fingerprint: (2, DIGEST, "c")}


def test_a_keepers_name_goes_before_a_later_one(four: list[Speaker]) -> None:
    keep, _, line, base = four
    keep.page(keep.event("named", A, 1, name="by keeper"))
    line.page(line.event("named", A, 50, name="later"), line.event("grouped", A, 1, group="hand", member=True))
    base.page(base.event("grouped", A, 9, group="hand", member=False))
    seen = Reader(roster_of(four), pages_of(four)).view(A)
    assert (seen.name, seen.groups) == ("by keeper", {"hand": False})


def reported(current: Speaker, runs: list[str] | None, second: int) -> dict[str, Any]:
    return current.event("firmware", A, second, runs=runs)


def firmware_seen(roster: Roster, speakers: list[Speaker]) -> list[tuple[str, str | None]]:
    """Station and version of each report, as they are shown."""
    seen = Reader(roster, pages_of(speakers)).view(A).firmware
    return [(roster.name_of(claim.station), claim.runs and claim.runs[1]) for claim in seen]


def test_the_newest_report_of_a_nodes_firmware_is_shown_first_with_its_station(four: list[Speaker]) -> None:
    keep, _, line, base = four
    assert firmware_seen(roster_of(four), four) == []
    line.page(reported(line, NEW, 50), reported(line, OLD, 40))  # its newest by place, whatever its clock says
    base.page(reported(base, NEW, 45))
    keep.page(reported(keep, None, 10))
    assert firmware_seen(roster_of(four), four) == [("base", "1.3.0+0"), ("line", "1.2.0+3"), ("keep", None)]


@pytest.mark.parametrize("why", ["retired", "lost", "stolen"])
def test_what_a_removed_station_saw_counts_to_its_last_page_and_of_a_stolen_one_after_all_others(
    four: list[Speaker], why: Why
) -> None:
    keep, keep2, line, base = four
    last = line.page(reported(line, OLD, 4_000_000))
    line.page(reported(line, NEW, 4_000_001))
    base.page(reported(base, NEW, 10))
    gone = roster_of([keep, keep2, base], [(line, last)], version=2)
    gone = replace(gone, removed=(replace(gone.removed[0], why=why),))
    seen = firmware_seen(gone, four)
    assert seen == sorted([("line", "1.2.0+3"), ("base", "1.3.0+0")], reverse=why == "retired")


def test_an_auditor_reports_no_firmware(four: list[Speaker]) -> None:
    audit = speaker("audit", "audit")
    audit.page(reported(audit, NEW, 10))
    assert firmware_seen(roster_of([*four, audit]), [*four, audit]) == []


# -- liars -------------------------------------------------------------------------------------------------------------

LIARS = ["line", "base", "sign", "audit", "line sign base", "stranger"]


def lies(liar: Speaker, victims: list[Speaker]) -> None:
    """All that a station can say to harm: pins, epochs, bans, liftings, groups, heads, other people's moves."""
    statement = seal_revocation(liar.key, uuid=A, node=PIN, why="stolen", created=NOW)
    liar.page(
        pinned(liar, OTHER), agreed(liar, 4_000_000_000, "9" * 16, OTHER), handed(liar, "gave", victims[0], 9, "move"),
        liar.event("revoked", A, statement=statement.statement),
        liar.event("lifted", None, of=event.hash_of_statement(statement.statement)),
        liar.event("vouched", A, teds_sha256=DIGEST2), liar.event("forgot", A, epoch=4_000_000_000),
        liar.event("written", A, epoch=4_000_000_000, sequence=4_000_000_000, teds_sha256=OTHER, profile="x",
                   profile_sha256=None, due=None),
        liar.event("firmware", A, runs=NEW),
        liar.event("reset", A, epoch=4_000_000_000, challenge="00" * 32, proof="00" * 64, point=NODE.point.hex()),
        heads={victim.fingerprint: (999, "ee" * 32) for victim in victims},
    )  # fmt: skip
    liar.page(liar.event("revoked", A, statement=statement.statement))


@pytest.mark.parametrize("roles", LIARS)
def test_no_liar_without_a_key_bans_unsigns_or_unpins_a_node(roles: str, four: list[Speaker]) -> None:
    keep, _, line, base = four
    keep.page(pinned(keep, PIN))
    line.page(
        agreed(line, 1), line.event("signed", A, epoch=1, sequence=1, teds_sha256=DIGEST), handed(line, "gave", base, 1)
    )
    base.page(handed(base, "took", line, 1))
    liar = speaker("liar", *roles.split())
    members = four if roles == "stranger" else [*four, liar]
    roster = roster_of(members)
    lies(liar, four)
    pages = [] if roles == "stranger" else liar.pages
    honest, lied = Reader(roster, pages_of(four)), Reader(roster, [*pages_of(four), *pages])
    for own in (
        LocalState("f" * 64),
        LocalState(base.fingerprint, pin=PIN, met=True, holds=True, holders=frozenset({line.fingerprint})),
    ):
        before, after = honest.view(A, own), lied.view(A, own)
        assert (after.pin, after.bans, after.key_it) == (before.pin, before.bans, True)
        assert {name: after.held.get(name) for name in before.held} == dict(before.held)
    assert lied.signing(line.fingerprint, DIGEST).result == "passed"
    assert lied.signing(base.fingerprint, DIGEST2).result == "failed", "a vouching of no keeper counts for nothing"
    gone = roster_of([member for member in members if member is not line], [(line, line.head)], version=2)
    if roles == "stranger":
        assert Reader(gone, pages_of(four)).signing(line.fingerprint, DIGEST).result == "passed"
        return
    after_removal = Reader(gone, [*pages_of(four), *pages])
    assert after_removal.signing(line.fingerprint, DIGEST).result == "passed", "hearsay of heads takes nothing away"


def test_a_ban_counts_from_a_keeper_and_from_who_has_the_key(four: list[Speaker]) -> None:
    keep, _, line, base = four
    statement = seal_revocation(line.key, uuid=A, node=PIN, why="lost", created=NOW)
    line.page(line.event("revoked", A, statement=statement.statement))
    reader = Reader(roster_of(four), pages_of(four))
    assert not reader.view(A, LocalState("f" * 64)).bans
    assert reader.view(A, LocalState("f" * 64, holders=frozenset({line.fingerprint}))).bans
    assert not reader.view(A, LocalState("f" * 64, pin=OTHER, holders=frozenset({line.fingerprint}))).bans, (
        "another board"
    )
    theirs = seal_revocation(keep.key, uuid=A, node=PIN, why="lost", created=NOW)
    base.page(base.event("revoked", A, statement=theirs.statement))  # carried by another station
    assert Reader(roster_of(four), pages_of(four)).view(A).bans
    keep.page(keep.event("lifted", None, of=event.hash_of_statement(theirs.statement)))
    assert not Reader(roster_of(four), pages_of(four)).view(A).bans
    keep.page(keep.event("lifted", None, of=event.hash_of_statement(statement.statement)))
    own = LocalState("f" * 64, holders=frozenset({line.fingerprint}))
    assert not Reader(roster_of(four), pages_of(four)).view(A, own).bans, "a keeper lifts anybody's"


def test_a_ban_of_ones_own_counts_here_and_who_signed_a_ban_lifts_it(four: list[Speaker]) -> None:
    _, _, line, base = four
    statement = seal_revocation(line.key, uuid=A, node=PIN, why="lost", created=NOW)
    line.page(line.event("revoked", A, statement=statement.statement))
    others = LocalState("f" * 64, holders=frozenset({line.fingerprint}))
    lifted = event.hash_of_statement(statement.statement)
    base.page(base.event("lifted", None, of=lifted))
    for own in (LocalState(line.fingerprint), others):
        assert Reader(roster_of(four), pages_of(four)).view(A, own).bans, "who is no keeper lifts no other's"
        assert not Reader(roster_of(four), pages_of(four)).view(A, replace(own, lifted=frozenset({lifted}))).bans
    line.page(line.event("lifted", None, of=lifted))
    for own in (LocalState(line.fingerprint), others):
        assert not Reader(roster_of(four), pages_of(four)).view(A, own).bans


def test_a_removed_ones_ban_stays_from_its_own_pages_and_comes_from_no_other(four: list[Speaker]) -> None:
    keep, keep2, line, base = four
    before = seal_revocation(keep2.key, uuid=A, node=PIN, why="lost", created=NOW)
    last = keep2.page(keep2.event("revoked", A, statement=before.statement))
    after = seal_revocation(keep2.key, uuid=NODES[1], node=PIN, why="made by a thief", created=NOW)
    keep2.page(keep2.event("revoked", NODES[1], statement=after.statement))
    base.page(base.event("revoked", NODES[1], statement=after.statement))
    left = [keep, line, base]
    reader = Reader(roster_of(left, [(keep2, last)], version=2), pages_of(four))
    assert reader.view(A).bans
    assert not reader.view(NODES[1]).bans


def test_a_statement_on_either_of_two_histories_bans(four: list[Speaker]) -> None:
    keep = four[0]
    first = keep.page()
    keep.page(pinned(keep, PIN))
    statement = seal_revocation(keep.key, uuid=A, node=PIN, why="lost", created=NOW)
    keep.page(keep.event("revoked", A, statement=statement.statement), after=first)
    seen = Reader(roster_of(four), pages_of(four)).view(A)
    assert seen.bans
    assert seen.pin is None, "what stands on one branch alone counts for nothing else"


# -- who may sign ------------------------------------------------------------------------------------------------------


def test_a_removed_signers_datasheets_stay_as_far_as_its_pages_go(four: list[Speaker]) -> None:
    keep, keep2, line, base = four
    last = line.page(line.event("signed", A, epoch=1, sequence=1, teds_sha256=DIGEST))
    line.page(line.event("signed", A, epoch=1, sequence=2, teds_sha256=DIGEST2))
    gone = roster_of([keep, keep2, base], [(line, last)], version=2)
    reader = Reader(gone, pages_of(four))
    assert reader.signing(line.fingerprint, DIGEST).result == "passed"
    assert reader.signing(line.fingerprint, DIGEST2).result == "failed"
    assert Reader(gone, keep.pages).signing(line.fingerprint, DIGEST).result == "unproven"
    keep.page(keep.event("vouched", A, teds_sha256=DIGEST2))
    assert Reader(gone, pages_of(four)).signing(line.fingerprint, DIGEST2).result == "passed"
    base.page(heads={keep.fingerprint: (7, "ee" * 32)})
    other = Reader(gone, pages_of(four)).signing(line.fingerprint, OTHER)
    assert other.result == "unproven", "a keeper may have vouched for it on a page that is not here"


def test_who_lost_the_role_signs_nothing_new(four: list[Speaker]) -> None:
    _, _, line, base = four
    place = line.page(line.event("signed", A, epoch=1, sequence=1, teds_sha256=DIGEST))
    line.page(line.event("signed", A, epoch=1, sequence=2, teds_sha256=DIGEST2))
    line.roles = frozenset({"line"})
    reader = Reader(roster_of(four, version=2, line=place), pages_of(four))
    assert reader.signing(line.fingerprint, DIGEST).result == "passed"
    assert reader.signing(line.fingerprint, DIGEST2).result == "failed"
    assert reader.signing(base.fingerprint, DIGEST).result == "failed"
    assert reader.signing("e" * 64, DIGEST).result == "failed"


def test_one_who_signs_is_believed_before_its_page_is_here(four: list[Speaker]) -> None:
    line = four[2]
    assert Reader(roster_of(four), []).signing(line.fingerprint, DIGEST) == ("passed", "in no page yet")
