"""Rows of a plant at one station: parcels, copies, pages, claims, bans, alarms (contract/plant.md sections 2 to 4)."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.station.plant import plant
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.pages import Chain, PageRow
from teds_provision.station.plant.parcels import ParcelRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

A, B, C, D = (bytes([number] * 10) for number in (1, 2, 3, 4))
NORTH, SOUTH, WEST = "1a" * 32, "2b" * 32, "3c" * 32
H1, H2, H3 = "d1" * 32, "d2" * 32, "d3" * 32
EARLY, AT, LATE = "2026-10-01T08:00:00Z", "2026-10-01T20:00:00Z", "2026-10-02T08:00:00Z"


# -- parcels and copies ------------------------------------------------------------------------------------------------


def test_parcels_are_kept_by_direction_and_state_the_oldest_first(station: Station) -> None:
    parcels = station.plant.parcels
    late = ParcelRow("p1", "out", SOUTH, "bundle", "ready", LATE, "b1", created=LATE)
    sent = ParcelRow("p2", "out", WEST, "receipt", "sent", LATE, "b2", created=EARLY)
    twin = ParcelRow("p0", "out", WEST, "receipt", "ready", LATE, "b3", created=LATE)
    came = ParcelRow("p1", "in", NORTH, "job", "waiting", LATE, "h1", "why", EARLY)
    for row, document in ((late, b"late"), (sent, b"sent"), (twin, b"twin"), (came, b"came")):
        parcels.put(row, document)
    assert parcels.all("out", "ready", "sent") == [sent, twin, late]
    assert parcels.all("out", "ready") == [twin, late]
    assert parcels.all("in", "ready", "later", "waiting") == [came]
    assert [parcels.get("p1", "out"), parcels.get("p1", "in"), parcels.get("p2", "in")] == [late, came, None]
    assert [parcels.document("p1", "out"), parcels.document("p1", "in"), parcels.document("p2", "in")] == [
        b"late", b"came", b""
    ]  # fmt: skip
    parcels.set_state("p1", "in", "later", "the sender's pages are not here yet")
    assert parcels.get("p1", "in") == replace(came, state="later", detail="the sender's pages are not here yet")
    parcels.set_state("p1", "in", "waiting")
    assert parcels.get("p1", "in") == replace(came, detail="")
    assert parcels.get("p1", "out") == late
    parcels.put(replace(late, expires=EARLY), b"again")
    assert (parcels.get("p1", "out"), parcels.document("p1", "out")) == (replace(late, expires=EARLY), b"again")
    parcels.drop("p1", "out")
    assert [parcels.get("p1", "out"), parcels.get("p1", "in")] == [None, replace(came, detail="")]
    assert parcels.review() is None
    parcels.put_review("a")
    parcels.put_review("b")
    assert parcels.review() == "b"


def test_a_copy_is_due_of_each_active_key_of_its_kind_and_epoch_that_a_receiver_has_not(station: Station) -> None:
    def add(uuid: bytes, epoch: int, state: str, source: str, slot: int = 1) -> None:
        key_id = f"{uuid[0]:08x}{epoch:08x}"
        station.keys.add(KeyRecord(uuid, epoch, key_id, state, slot, b"w", source, EARLY))  # type: ignore[arg-type]

    add(C, 1, "active", "agreement")
    add(A, 3, "active", "agreement")
    add(A, 4, "pending", "agreement")
    add(B, 2, "active", "import")
    parcels = station.plant.parcels
    a, c = (A, 3, "0000000100000003"), (C, 1, "0000000300000001")
    assert parcels.unshared(SOUTH) == [a, c]
    assert parcels.unshared(SOUTH, imported=True) == [(B, 2, "0000000200000002")]
    parcels.put_shared([(A, 2), (C, 1)], SOUTH, "p1", "sent")
    assert parcels.unshared(SOUTH) == [a], "the copy of another epoch counts for nothing"
    assert parcels.unshared(WEST) == [a, c]
    parcels.put_shared([(A, 3)], SOUTH, "p2", "refused")
    assert parcels.unshared(SOUTH) == [], "refused: never again for that epoch"


def test_what_became_of_the_copies_of_a_parcel(station: Station) -> None:
    parcels = station.plant.parcels
    for uuid in (A, B, C):
        station.keys.add(KeyRecord(uuid, 1, f"{uuid[0]:016x}", "active", 1, b"w", "agreement", EARLY))
    parcels.put_shared([(B, 1), (A, 1), (C, 1)], SOUTH, "p1", "sent")
    parcels.put_shared([(A, 1)], WEST, "p2", "sent")
    assert parcels.receipted() == []
    parcels.turn_shared("p1", "taken", [A, B])
    assert parcels.shared_in("p1") == [(A, 1, "taken"), (B, 1, "taken"), (C, 1, "sent")]
    assert parcels.shared_in("p2") == [(A, 1, "sent")]
    parcels.turn_shared("p2", "taken")
    assert sorted(parcels.receipted()) == [(A, 1, {SOUTH, WEST}), (B, 1, {SOUTH})]
    station.keys.remove_key(B, f"{B[0]:016x}")
    station.keys.remove_key(A, f"{A[0]:016x}")
    station.keys.add(KeyRecord(A, 1, f"{A[0]:016x}", "pending", 2, b"w", "agreement", EARLY))
    station.keys.add(KeyRecord(A, 2, f"{9:016x}", "active", 1, b"w", "agreement", EARLY))
    assert parcels.receipted() == [], "a key that is gone, or not proven, is not forgotten again"
    parcels.forget_shared("p1")
    assert parcels.shared_in("p1") == [(A, 1, "taken"), (B, 1, "taken")]
    parcels.put_shared([(A, 1)], SOUTH, "p3", "sent")
    assert parcels.shared_in("p1") == [(B, 1, "taken")]
    parcels.put(ParcelRow("p1", "out", SOUTH, "bundle", "ready", LATE), b"")
    parcels.forget_all()
    assert [parcels.shared_in(parcel) for parcel in ("p1", "p2", "p3")] == [[], [], []]
    assert parcels.all("out", "ready") == []


# -- pages -------------------------------------------------------------------------------------------------------------


def page(n: int, hash: str, created: str = EARLY, previous: str = "") -> PageRow:
    return PageRow(n, hash, previous, created, "0" * 16, b"header", b"content " * n, bytes(64))


def test_a_chain_begins_once_and_keeps_how_far_it_counts(station: Station) -> None:
    pages = station.plant.pages
    first = pages.chain(SOUTH)
    assert first == Chain(first.id, SOUTH)
    other = pages.chain(NORTH)
    assert pages.chain(SOUTH) == first
    changed = Chain(first.id, SOUTH, (7, H1), (6, H2), (5, H3), "why")
    pages.put_chain(changed)
    assert pages.chains() == {SOUTH: changed, NORTH: other}
    pages.put_chain(replace(changed, accepted=None, waits=None))
    assert pages.chain(SOUTH) == Chain(first.id, SOUTH, (7, H1), (6, H2))


def test_pages_of_both_histories_in_order(station: Station) -> None:
    pages = station.plant.pages
    south, north = pages.chain(SOUTH).id, pages.chain(NORTH).id
    rows = [page(1, H2), page(2, H3, LATE, H2), page(2, H1, EARLY, H2), page(10, H1, LATE, H3)]
    for row in reversed(rows):
        pages.add(south, row)
    pages.add(north, page(1, H3, LATE))
    pages.add(south, replace(rows[0], created=LATE, content=b"another"))
    assert pages.chain_links(south) == [(1, H2, ""), (2, H1, H2), (2, H3, H2), (10, H1, H3)]
    assert [pages.get(south, 1, H2), pages.get(south, 2, H2), pages.get(north, 1, H2)] == [rows[0], None, None]
    assert list(pages.each(south)) == [rows[0], rows[2], rows[1], rows[3]]
    assert [row.n for row in pages.each(south, 1)] == [2, 2, 10]
    assert [row.n for row in pages.each(south, 2)] == [10]
    assert pages.times(south, 3) == [(10, H1, LATE, "0" * 16), (2, H1, EARLY, "0" * 16), (2, H3, LATE, "0" * 16)]
    assert dict(pages.newest()) == {SOUTH: LATE, NORTH: LATE}
    pages.add(north, page(2, H3, EARLY))
    assert dict(pages.newest()) == {SOUTH: LATE, NORTH: EARLY}, "by number, not by time"


def test_of_the_heads_that_a_station_reports_the_greatest_of_each_chain_is_kept(station: Station) -> None:
    pages = station.plant.pages
    south, north = pages.chain(SOUTH).id, pages.chain(NORTH).id
    pages.put_heads(south, {NORTH: (5, H1), WEST: (2, H2)})
    pages.put_heads(south, {NORTH: (4, H2), WEST: (9, H3)})
    pages.put_heads(south, {NORTH: (5, H3)})
    pages.put_heads(north, {WEST: (3, H1), SOUTH: (3, H2)})
    assert pages.heads() == [(SOUTH, NORTH, 5, H1), (NORTH, SOUTH, 3, H2), (SOUTH, WEST, 9, H3), (NORTH, WEST, 3, H1)]
    assert pages.seen_heads() == set()
    pages.see_heads(pages.heads()[:2])
    pages.see_heads(pages.heads()[1:3])
    assert pages.seen_heads() == {(NORTH, SOUTH, 3, H2), (SOUTH, WEST, 9, H3)}


# -- what the pages say ------------------------------------------------------------------------------------------------


@pytest.fixture
def chains(station: Station) -> tuple[Chain, Chain]:
    return station.plant.pages.chain(SOUTH), station.plant.pages.chain(NORTH)


def judged(station: Station) -> list[bytes]:
    """Return the nodes that are to be judged again, and note that they were."""
    due = station.plant.claims.to_judge(100)
    station.plant.claims.note_judged(due)
    return due


def test_claims_are_kept_by_station_and_their_nodes_are_judged_again(
    station: Station, chains: tuple[Chain, Chain]
) -> None:
    claims, (south, north) = station.plant.claims, chains
    claims.put(south.id, {B: "sb", A: "sa"})
    claims.put(north.id, {A: "na", C: "nc"})
    assert claims.to_judge(2) == [A, B]
    assert judged(station) == [A, B, C]
    claims.put(south.id, {A: "sa2"})
    assert judged(station) == [A]
    assert claims.of_station(south.id, [A, B, C]) == {A: "sa2", B: "sb"}
    assert claims.of_nodes([A, C, D]) == {A: {SOUTH: "sa2", NORTH: "na"}, C: {NORTH: "nc"}}
    assert [claims.nodes(b"", 2), claims.nodes(A, 2), claims.nodes(C, 2)] == [[A, B], [B, C], []]
    claims.add_ids(south.id, [1, 2])
    claims.add_ids(south.id, [2, 3])
    claims.add_ids(north.id, [4])
    assert claims.known_ids(south.id, [1, 3, 4, 5]) == {1, 3}
    assert claims.known_ids(north.id, range(2000)) == {4}
    claims.put(south.id, {bytes([7] * 10): "s7"})
    assert claims.of_station(south.id, [*[C] * 499, bytes([7] * 10), *[C] * 499, B]) == {bytes([7] * 10): "s7", B: "sb"}
    assert claims.known_ids(south.id, [*[9] * 499, 1, *[9] * 499, 2]) == {1, 2}, "where two chunks meet"


def test_a_ban_counts_once_a_page_of_it_counts_and_who_lifts_it_is_known(
    station: Station, chains: tuple[Chain, Chain]
) -> None:
    claims, (south, north) = station.plant.claims, chains
    claims.put_ban(H1, south.id, counts=False, uuid=A, statement="one")
    claims.put_ban(H1, north.id, counts=False, uuid=A, statement="one")
    claims.put_ban(H2, south.id, counts=True, uuid=B, statement="two")
    assert judged(station) == [A, B]
    claims.put_ban(H1, south.id, counts=True, uuid=A, statement="one")
    claims.put_ban(H2, south.id, counts=False, uuid=B, statement="two")
    assert claims.bans_of([B, A]) == [
        (A, H1, NORTH, False, "one"), (A, H1, SOUTH, True, "one"), (B, H2, SOUTH, True, "two")
    ]  # fmt: skip
    assert claims.bans_of([C]) == []
    claims.put_ban("d4" * 32, north.id, counts=True, uuid=B, statement="three")
    assert [row[1] for row in claims.bans_of([B])] == [H2, "d4" * 32]
    judged(station)
    claims.put_lifting(H1, north)
    claims.put_lifting(H1, north)
    claims.put_lifting(H3, south)
    assert judged(station) == [A]
    assert [claims.lifters(hash) for hash in (H1, H2, H3)] == [{NORTH}, set(), {SOUTH}]
    assert len(claims.bans_of([A, B])) == 4, "a lifting is no ban"


def test_who_signed_a_datasheet_and_who_vouches_for_it(station: Station, chains: tuple[Chain, Chain]) -> None:
    claims, (south, north) = station.plant.claims, chains
    one, two = b"\x01" * 32, b"\x02" * 32
    claims.put_digests(south, [(one, 3, False), (two, 4, False)])
    claims.put_digests(south, [(one, 9, False)])
    claims.put_digests(north, [(one, 5, True)])
    assert sorted(claims.signers(one)) == [(NORTH, 5, True), (SOUTH, 3, False)]
    assert [claims.signers(two), claims.signers(bytes(32))] == [[(SOUTH, 4, False)], []]
    claims.put_lifting(H1, south)
    claims.put_ban(H2, south.id, counts=True, uuid=A, statement="it proves itself")
    names = [name for name, *_ in claims.mac_rows(RowSample(full=True))]
    assert names == [
        "the digest 0101010101010101 of a page", "the digest 0101010101010101 of a page",
        "the digest 0202020202020202 of a page", f"the lifting of ban {H1[:16]} in a page",
    ]  # fmt: skip


@pytest.mark.parametrize(
    "change",
    ["UPDATE digests SET vouched = 1", "UPDATE digests SET n = 1", "UPDATE digests SET mac = NULL",
     "UPDATE statements SET mac = NULL", "UPDATE chains SET station = '" + WEST + "' WHERE station = '" + SOUTH + "'"],
)  # fmt: skip
def test_a_digest_or_a_lifting_that_another_program_changed_counts_for_nothing(
    station: Station, store: Store, chains: tuple[Chain, Chain], change: str
) -> None:
    claims, (south, _), digest = station.plant.claims, chains, b"\x01" * 32
    claims.put_digests(south, [(digest, 3, False)])
    claims.put_lifting(H1, south)
    store.execute(change)
    assert claims.signers(digest) == ([(SOUTH, 3, False)] if "statements" in change else [])
    assert claims.lifters(H1) == ({SOUTH} if "digests" in change else set())


def test_what_was_folded_of_one_chain_is_forgotten_and_what_it_lifted_is_judged_again(
    station: Station, chains: tuple[Chain, Chain]
) -> None:
    claims, (south, north) = station.plant.claims, chains
    digest = b"\x01" * 32
    for chain in (south, north):
        claims.add_ids(chain.id, [1])
        claims.put_digests(chain, [(digest, 3, False)])
    claims.put(south.id, {A: "sa"})
    claims.put(north.id, {A: "na", B: "nb"})
    claims.put_ban(H1, north.id, counts=True, uuid=C, statement="one")
    claims.put_ban(H2, south.id, counts=True, uuid=D, statement="two")
    claims.put_lifting(H1, south)
    judged(station)
    claims.forget(south.id)
    assert judged(station) == [A, C]
    assert claims.of_nodes([A, B]) == {A: {NORTH: "na"}, B: {NORTH: "nb"}}
    assert [claims.known_ids(chain.id, [1]) for chain in (south, north)] == [set(), {1}]
    assert claims.signers(digest) == [(NORTH, 3, False)]
    assert [row[1] for row in claims.bans_of([C, D])] == [H1]
    assert claims.lifters(H1) == set()
    claims.put_conflicts({A: {"two keys": "why"}})
    claims.queue_all()
    assert judged(station) == [A, B, C]
    claims.forget_all()
    claims.queue_all()
    assert (claims.conflicts(), judged(station), claims.signers(digest), claims.bans_of([C])) == ([], [], [], [])


def test_conflicts_take_the_place_of_those_that_were(station: Station) -> None:
    claims = station.plant.claims
    claims.put_conflicts({B: {"two keys": "one"}, A: {"two keys": "two", "other pin": "three"}})
    assert claims.conflicts() == [(A, "other pin", "three"), (A, "two keys", "two"), (B, "two keys", "one")]
    claims.put_conflicts({A: {"two holders": "four"}, C: {}})
    assert claims.conflicts() == [(A, "two holders", "four"), (B, "two keys", "one")]
    assert claims.conflicts(B) == [(B, "two keys", "one")]
    claims.put_conflicts({A: {}})
    assert claims.conflicts(A) == []


@pytest.mark.parametrize(
    ("of", "runs", "at", "other"),
    [
        ("line", "b", AT, True), ("line", "a", AT, False), ("line", "b", EARLY, False), ("line", "b", LATE, True),
        ("line", "b", "2099-01-01T00:00:00Z", False), ("audit", "b", AT, False), ("gone", "b", AT, False),
        ("none", "b", AT, False),
    ],
)  # fmt: skip
def test_another_firmware_is_what_a_member_at_work_reported_since_then_and_not_in_the_future(
    station: Station, monkeypatch: pytest.MonkeyPatch, of: str, runs: str, at: str, other: bool
) -> None:
    roles = {"line": {"line", "audit"}, "audit": {"audit"}, "gone": {"line"}}
    roster = SimpleNamespace(
        roles_of=lambda who: roles.get(who, set()), member=lambda who: who if who != "gone" else None
    )
    monkeypatch.setattr(type(station.plant), "roster", property(lambda _: roster))
    monkeypatch.setattr(
        station.plant.claims, "of_nodes", lambda uuids: {A: {"none": "", of: "said"}} if uuids == [A] else {}
    )
    read = lambda text: SimpleNamespace(firmware=(runs, at) if text else None)  # noqa: E731
    monkeypatch.setattr(plant, "claim", SimpleNamespace(Claim=SimpleNamespace(from_json=read)))
    monkeypatch.setattr(plant, "utc_now", lambda: LATE)
    assert station.plant.reports_other_firmware(A, cast("Any", "a"), AT) is other


# -- alarms ------------------------------------------------------------------------------------------------------------


def test_alarms_end_by_what_they_are_about_and_are_seen_all_at_once(station: Station) -> None:
    alarms = station.plant.alarms

    def put(code: str, about: str, n: int, at: str, **more: Any) -> Alarm:
        alarm = Alarm(code, about, n, "why", at)
        assert alarms.put(alarm, **more)
        return alarm

    junk2, fork = put("junk", NORTH, 2, LATE), put("fork", NORTH, 1, EARLY)
    junk1, gap = put("junk", NORTH, 1, LATE), put("gap", SOUTH, 1, LATE)
    assert alarms.all() == [fork, gap, junk1, junk2]
    assert not alarms.put(replace(fork, why="another", at=LATE))
    assert alarms.all()[0] == fork
    assert (alarms.see(), alarms.see()) == (4, 0)
    assert not alarms.put(replace(fork, at=LATE)), "a state that lasts stays seen"
    again = put("junk", NORTH, 1, "2026-10-03T08:00:00Z", again=True)
    assert alarms.all() == [*(replace(alarm, seen=True) for alarm in (fork, gap, junk2)), again]
    alarms.end(replace(again, why="whatever"))
    assert alarms.end_about("junk", SOUTH) == 0
    assert alarms.end_about("junk", NORTH) == 1
    assert [alarm.code for alarm in alarms.all()] == ["fork", "gap"]
    assert (alarms.end_all_of("gap"), alarms.end_all_of("gap")) == (1, 0)
    assert [alarm.code for alarm in alarms.all()] == ["fork"]
