"""Keys that travel by themselves: whom a share reaches, what comes in without a question, what waits for a person."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import RosterExpiredError
from teds_provision.handover import incoming, life, outgoing, pending
from teds_provision.plant import parcels, sign_requests
from teds_provision.plant.commands import parcels as commands_of_parcels
from teds_provision.plant.transport import Parcel
from teds_provision.protocol.handover import jose
from teds_provision.protocol.handover.bundle import CONTENT_TYPE
from teds_provision.protocol.handover.strict_json import time_text
from teds_provision.protocol.plant.roster import Share
from teds_provision.provisioning.agree import agree
from teds_provision.provisioning.identify import identify
from teds_provision.station.plant.line import SignRequestRow
from teds_provision.station.plant.parcels import ParcelKind, ParcelRow, Parcels
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry, utc_now
from tests.bench import Board, talk
from tests.cli.shell import call
from tests.plant.handing import Plant, board_of

ROLES = {"north": "keeper sign line base", "south": "base", "west": "line"}


@pytest.fixture
def plant(tmp_path: Path) -> Iterator[Plant]:
    made = Plant(tmp_path, *ROLES)
    made.trusted()
    yield made
    made.close()


def everything(plant: Plant, *to: str, forget: bool = False) -> Share:
    return Share(("all", ""), tuple(plant[name].fingerprint for name in to), forget)


def now(days: float = 0) -> datetime:
    return datetime.now(UTC) + timedelta(days=days)


def sync(plant: Plant, *names: str, at: datetime | None = None) -> None:
    for name in names:
        parcels.take_in(plant[name], plant.transport, plant.views(name), at or now())
        parcels.send_out(plant[name], plant.transport, plant.views(name), at or now())


def holds(station: Station, uuid: bytes) -> list[tuple[int, str]]:
    return [(key.epoch, key.source) for key in station.keys.keys_of(uuid)]


def waits(station: Station) -> list[str]:
    return [row.detail for row in station.plant.parcels.all("in", "waiting")]


def rotated(station: Station, board: Board) -> None:
    """The station takes the board over at a tap, or makes a new key with it."""
    with talk(board) as node:
        who = identify(station, node)
        agree(station, node, who, rotate=True, newcomer=WhitelistEntry(node.uuid, who.fingerprint, utc_now(), "tap"))


def test_a_key_goes_to_who_shares_it_and_its_receipt_comes_back(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west", "south")
    assert holds(plant["south"], board.uuid) == [(1, "import")]
    assert parcels.waiting_out(plant["west"]) == 1
    sync(plant, "west")
    assert parcels.waiting_out(plant["west"]) == 0
    assert plant.transport.there == {}
    assert [holder.fingerprint for holder in plant["west"].keys.holders(board.uuid)] == [plant["south"].fingerprint]


def test_nothing_goes_round_in_circles(plant: Plant) -> None:
    plant.roster(ROLES | {"west": "line base"}, everything(plant, "north", "south", "west"))
    board = board_of(plant["west"], os.urandom(10))
    for _ in range(3):
        sync(plant, "west", "north", "south")
    assert [len(holds(plant[name], board.uuid)) for name in ROLES] == [1, 1, 1]
    assert plant.transport.there == {}
    sent = [handover for name in ROLES for handover in plant[name].handovers.all() if handover.direction == "out"]
    assert len(sent) == 2


def test_a_group_is_the_senders_own_or_a_keepers(plant: Plant) -> None:
    plant.roster(ROLES, Share(("group", "cell 3"), (plant["south"].fingerprint,)))
    own, keepers, strangers = (board_of(plant["west"], os.urandom(10)) for _ in range(3))
    for name, board in (("west", own), ("north", keepers), ("south", strangers)):
        with plant[name].transaction():
            plant[name].plant.record_event("grouped", board.uuid, group="cell 3", member=True)
    sync(plant, "west", "south")
    assert [bool(holds(plant["south"], board.uuid)) for board in (own, keepers, strangers)] == [True, True, False]


def test_who_forgets_keeps_nothing_once_all_have_it(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "north", "south", forget=True))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west", "south", "west")
    assert holds(plant["west"], board.uuid), "one of two has not receipted"
    sync(plant, "north", "west")
    assert holds(plant["west"], board.uuid) == []
    assert holds(plant["south"], board.uuid)
    sync(plant, "west", "north", "south")
    assert plant.transport.there == {}


def test_a_copy_without_a_share_waits_for_a_person(plant: Plant) -> None:
    plant.roster(ROLES)
    board = board_of(plant["west"], os.urandom(10))
    station = plant["west"]
    with station.lock("test"):
        plan = outgoing.plan_export(station, outgoing.ExportOrder(("south",), (board.uuid,)))
        parcels.send_export(station, plan, now())
    sync(plant, "west", "south")
    assert holds(plant["south"], board.uuid) == []
    assert waits(plant["south"]) == [f"{board.uuid.hex()}: no share of the roster sends it here"]
    assert plant.transport.there == {}


def test_a_copy_that_expired_while_it_waited_makes_room_for_the_next_one(plant: Plant) -> None:
    board_of(plant["west"], os.urandom(10))
    plant.roster(ROLES, everything(plant, "south"))
    parcels.send_out(plant["west"], plant.transport, plant.views("west"), now())
    plant.roster(ROLES)  # shared no more: it waits for a person
    sync(plant, "south")
    assert len(waits(plant["south"])) == 1
    sync(plant, "south", at=now(6))
    assert len(waits(plant["south"])) == 1
    sync(plant, "south", at=now(8))
    assert waits(plant["south"]) == []


def test_a_receipt_that_comes_after_its_copy_expired_closes_it_all_the_same(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    west = plant["west"]
    board_of(west, os.urandom(10))
    sync(plant, "west", "south")
    plant.roster(ROLES)  # no other copy is made
    parcels.send_out(west, plant.transport, plant.views("west"), now(8))
    assert [(one.row.state, one.expired) for one in pending.list_handovers(west, now(8))] == [("dropped", False)]
    sync(plant, "west")
    assert [row.state for row in west.handovers.all()] == ["closed"]


def test_an_order_that_is_given_again_is_the_same_parcel_until_that_has_expired(plant: Plant) -> None:
    plant.roster(ROLES)
    station = plant["west"]
    order = outgoing.ExportOrder(("south",), (board_of(station, os.urandom(10)).uuid,))

    def send(at: datetime) -> str:
        with station.lock("test"):
            return parcels.send_export(station, outgoing.plan_export(station, order, at), at)

    first = send(now())
    assert send(now()) == send(now(6)) == first
    assert send(now(8)) != first


def test_a_copy_that_a_wrong_clock_dated_ahead_is_made_anew_when_the_clock_is_right(plant: Plant) -> None:
    """Its receiver threw it away; it counted as sent for as long as the clock had been ahead, and a week."""
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    right = now(-3)  # a copy is dated by this machine's clock, three days ahead of this
    parcels.send_out(plant["west"], plant.transport, plant.views("west"), now())
    sync(plant, "south", at=right)
    assert (holds(plant["south"], board.uuid), plant.transport.there) == ([], {})
    parcels.send_out(plant["west"], plant.transport, plant.views("west"), right)
    assert len(plant.transport.there) == 1
    sync(plant, "south")
    assert holds(plant["south"], board.uuid) == [(1, "import")]


def test_a_key_of_one_sender_that_was_never_proven_keeps_no_other_senders_key_out(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "north", "south"))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west", "south")
    rotated(plant["north"], board)
    sync(plant, "north", "south")
    assert holds(plant["south"], board.uuid) == [(2, "import"), (1, "import")]
    rotated(plant["west"], board)
    sync(plant, "west", "south")
    assert holds(plant["south"], board.uuid) == [(2, "import"), (1, "import")]
    assert waits(plant["south"]) == [f"{board.uuid.hex()}: a key of it from this sender was never proven"]


def test_only_what_a_line_would_send_again_is_dropped_for_its_age(plant: Plant) -> None:
    plant.roster(ROLES)
    west, peer = plant["west"], plant["north"].fingerprint
    kinds: tuple[ParcelKind, ...] = ("sign-request", "signed", "job")
    with west.transaction():
        for kind in kinds:
            west.plant.parcels.put(ParcelRow(f"{kind} 1", "in", peer, kind, "waiting", "", kind), b"a document")
    sync(plant, "west", at=now(30))
    assert len(parcels.received(west, "signed")) == len(parcels.received(west, "sign-request")) == 1
    sync(plant, "west", at=now(32))
    assert [kind for kind in kinds if parcels.received(west, kind)] == ["job"]


def test_abandoned_requests_do_not_keep_jobs_out(plant: Plant) -> None:
    from teds_provision.protocol.plant import document

    plant.roster(ROLES)
    north, west = plant["north"], plant["west"]

    def send(kind: document.DocumentKind, n: int) -> None:
        members = {"format": kind.format, "id": f"6f1c0a52-6f0e-4c1b-8a55-{n:012d}"}
        signed = document.sign_document(members, north.vault.identity(), kind)
        sealed = jose.encrypt(signed, [west.point], cty=CONTENT_TYPE)
        plant.transport.send(Parcel(f"{kind.typ} {n}", west.fingerprint, sealed, time_text(now(60)), north.fingerprint))

    for n in range(64):
        send(document.SIGN_REQUEST, n)
    sync(plant, "west")
    send(document.JOB, 0)
    sync(plant, "west", at=now(30))
    assert parcels.received(west, "job") == []
    sync(plant, "west", at=now(32))
    assert len(parcels.received(west, "job")) == 1
    assert parcels.received(west, "sign-request") == []
    sync(plant, "west", at=now(90))
    assert len(parcels.received(west, "job")) == 1


def test_an_answer_is_kept_of_the_office_that_was_asked_and_once(plant: Plant) -> None:
    from teds_provision.protocol.plant.document import SIGNED, sign_document

    plant.roster(ROLES)
    west, north = plant["west"], plant["north"]
    asked = SignRequestRow("ab" * 32, "out", "a job", bytes(10), north.fingerprint, b"the request")
    west.plant.line.put_sign_request(asked)

    def kept(by: Station, of: str = asked.hash) -> int:
        signed = sign_document({"format": SIGNED.format, "of": of}, by.vault.identity(), SIGNED)
        sealed = jose.encrypt(signed, [west.point], cty=CONTENT_TYPE)
        plant.transport.send(Parcel(os.urandom(4).hex(), west.fingerprint, sealed, time_text(now(60)), by.fingerprint))
        sync(plant, "west")
        assert plant.transport.there == {}
        return len(parcels.received(west, "signed"))

    assert kept(plant["south"]) == 0
    assert kept(north, of="cd" * 32) == 0
    assert kept(north) == 1
    west.plant.line.put_sign_request(replace(asked, answer=b"an answer"))
    assert kept(north) == 1


def test_a_person_takes_in_what_waits_and_nothing_else_than_was_shown(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plant.roster(ROLES)
    first, other = (board_of(plant["west"], os.urandom(10)).uuid for _ in range(2))
    west, south = plant["west"], plant["south"]
    with west.lock("test"):
        parcels.send_export(west, outgoing.plan_export(west, outgoing.ExportOrder(("south",), (first, other))), now())
    sync(plant, "west", "south")
    shown = call(tmp_path / "south", "--json", "import-keys", "--received", "--dry-run").json
    assert ([parcel["count"] for parcel in shown["received"]], shown["plan"]) == ([2], True)

    planned = incoming.plan_import

    def and_another_revokes(*what: Any) -> object:
        plan = planned(*what)
        monkeypatch.undo()
        life.revoke(south, first, "stolen")
        return plan

    monkeypatch.setattr(commands_of_parcels, "plan_import", and_another_revokes)
    done = call(tmp_path / "south", "--json", "import-keys", "--received", "--yes")
    assert (done.code, "changed the plan" in done.out) == (6, True)
    assert (holds(south, first), holds(south, other)) == ([], [])
    done = call(tmp_path / "south", "--json", "import-keys", "--received", "--yes")
    assert (done.code, [parcel["imported"] for parcel in done.json["received"]]) == (0, [[other.hex()]])
    assert (holds(south, first), holds(south, other)) == ([], [(1, "import")])
    assert call(tmp_path / "south", "--json", "import-keys", "--received").json["received"] == []


def test_a_move_waits_for_a_person_whatever_the_roster_shares(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    station = plant["west"]
    with station.lock("test"):
        order = outgoing.ExportOrder(("south",), (board.uuid,), "move")
        parcels.send_export(station, outgoing.plan_export(station, order), now())
    sync(plant, "west", "south")
    assert waits(plant["south"]) == ["a move needs confirmation"]


def test_what_comes_before_its_senders_pages_waits_one_sync_then_for_a_person(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    plant.deaf = {"west"}
    early, late = board_of(plant["west"], os.urandom(10)), None
    sync(plant, "west", "south")
    assert holds(plant["south"], early.uuid) == []
    assert waits(plant["south"]) == []
    plant.deaf = set()
    sync(plant, "south")
    assert holds(plant["south"], early.uuid)
    plant.deaf = {"west"}
    late = board_of(plant["west"], os.urandom(10))
    sync(plant, "west", "south", "south")
    assert holds(plant["south"], late.uuid) == []
    assert len(waits(plant["south"])) == 1


def test_a_node_on_which_keepers_do_not_agree_waits_and_holds_up_no_other(plant: Plant) -> None:
    plant.roster(ROLES | {"south": "keeper base"}, everything(plant, "south"))
    clear, disputed = (board_of(plant["west"], os.urandom(10)) for _ in range(2))
    for name, key in (("north", "aa"), ("south", "bb")):
        with plant[name].transaction():
            plant[name].plant.record_event("pinned", disputed.uuid, fingerprint=key * 32, assurance="tap")
    sync(plant, "west", "south")
    assert holds(plant["south"], clear.uuid)
    assert holds(plant["south"], disputed.uuid) == []
    assert "two keys" in waits(plant["south"])[0]


def test_a_bundle_of_which_nothing_is_taken_is_refused_and_never_sent_again(plant: Plant) -> None:
    plant.roster({**ROLES, "south": "base line"}, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    other = board_of(plant["south"], board.uuid)
    assert other.key.point != board.key.point
    sync(plant, "west", "south")
    [row] = plant["west"].plant.parcels.all("out", "sent")
    claims = plant.views("west")
    with plant["west"].transaction():  # as the fold would have it
        events = plant["south"].plant.outbox(100)
        assert any('"refused"' in text and row.about in text for _, _, text in events)
        from teds_provision.protocol.plant.claim import Claim

        chain = plant["west"].plant.pages.chain(plant["south"].fingerprint).id
        refused = {(row.about, plant["west"].fingerprint, "no")}
        plant["west"].plant.claims.put(chain, {board.uuid: Claim(refused=refused).to_json()})
    parcels.send_out(plant["west"], plant.transport, claims, now())
    assert parcels.waiting_out(plant["west"]) == 0
    parcels.send_out(plant["west"], plant.transport, claims, now(8))
    assert plant.transport.there == {}


def test_a_copy_without_receipt_is_made_again_after_seven_days(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west")
    [lost] = list(plant.transport.there)
    plant.transport.there.clear()
    sync(plant, "west", at=now(6))
    assert plant.transport.there == {}
    sync(plant, "west", at=now(8))
    assert list(plant.transport.there) != [lost]
    sync(plant, "south", at=now(8))
    assert holds(plant["south"], board.uuid)


def test_a_move_without_receipt_goes_again_under_its_old_id(plant: Plant) -> None:
    plant.roster(ROLES)
    board = board_of(plant["west"], os.urandom(10))
    station = plant["west"]
    with station.lock("test"):
        order = outgoing.ExportOrder(("south",), (board.uuid,), "move")
        parcels.send_export(station, outgoing.plan_export(station, order), now())
    sync(plant, "west")
    [first] = station.plant.parcels.all("out", "sent")
    sync(plant, "west", at=now(8))
    [again] = station.plant.parcels.all("out", "sent")
    assert (again.about, again.id != first.id) == (first.about, True)


def test_what_the_post_takes_no_more_goes_with_a_later_sync(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    plant.transport.full = True
    sync(plant, "west")
    plant.transport.full = False
    sync(plant, "west", "south")
    assert holds(plant["south"], board.uuid)


def test_nothing_goes_by_itself_once_the_roster_has_expired(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"), days=30)
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west", at=now(40))
    assert plant.transport.there == {}
    sync(plant, "west")
    parcels.take_in(plant["south"], plant.transport, plant.views("south"), now(6))
    assert holds(plant["south"], board.uuid)


def test_a_copy_that_is_met_once_the_roster_has_expired_waits_for_a_person(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"), days=3)
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west")
    sync(plant, "south", at=now(4))
    assert waits(plant["south"]) == ["the roster has expired"]
    assert not holds(plant["south"], board.uuid)


def held_back(plant: Plant, at: datetime | None = None) -> str:
    """What a sync of west reports about the parcels that it does not send; none leaves."""
    done = parcels.send_out(plant["west"], plant.transport, plant.views("west"), at or now())
    assert (done.count, plant.transport.there) == (0, {})
    [why] = done.held_back
    return why


@pytest.mark.parametrize("by_hand", [False, True])
def test_a_copy_that_waits_is_not_sent_once_the_roster_has_expired(plant: Plant, by_hand: bool) -> None:
    plant.roster(ROLES, *([] if by_hand else [everything(plant, "south")]), days=3)
    board = board_of(plant["west"], os.urandom(10))
    if by_hand:
        order = outgoing.ExportOrder(("south",), (board.uuid,))
        with plant["west"].lock("test"):
            parcels.send_export(plant["west"], outgoing.plan_export(plant["west"], order), now())
    else:
        plant.transport.full = True
        sync(plant, "west")
        plant.transport.full = False
    why = held_back(plant, now(4))
    assert why.startswith("1 parcel held back: keys for south, as the roster expired on ")
    assert why.endswith("registry renew")
    plant.roster(ROLES, everything(plant, "south"))
    sync(plant, "west", "south", at=now(4))
    assert holds(plant["south"], board.uuid), "a new roster lets it go"


def test_a_move_is_a_persons_act_whatever_the_date_of_the_roster(plant: Plant) -> None:
    plant.roster(ROLES, days=3)
    board = board_of(plant["west"], os.urandom(10))
    order = outgoing.ExportOrder(("south",), (board.uuid,), "move")
    with plant["west"].lock("test"):
        parcels.send_export(plant["west"], outgoing.plan_export(plant["west"], order), now())
    sync(plant, "west", at=now(4))
    assert len(plant.transport.there) == 1


def test_a_copy_that_waits_is_not_sent_once_nothing_shares_it(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board_of(plant["west"], os.urandom(10))
    plant.transport.full = True
    sync(plant, "west")
    plant.transport.full = False
    plant.roster(ROLES)
    assert "no share of the roster" in held_back(plant)
    plant.roster({**ROLES, "south": "line"}, everything(plant, "south"))
    assert "no share of the roster" in held_back(plant)
    plant.roster({"north": "keeper", "west": "line"}, removed={"south": (0, "")})
    assert "south is no member any more" in held_back(plant)


def revoked(station: Station, board: Board) -> None:
    life.revoke(station, board.uuid, "stolen")


def to_be_rotated(station: Station, board: Board) -> None:
    with station.transaction():
        station.keys.demand_rotation(board.uuid, "a holder is no longer trusted")


OUTDATED = [
    (revoked, "it is revoked"),
    (rotated, "its key was replaced since"),
    (to_be_rotated, "its key must be rotated first"),
]


@pytest.mark.parametrize(("happens", "why"), OUTDATED)
def test_a_key_that_is_outdated_does_not_leave_with_a_copy_that_waits(plant: Plant, happens: Any, why: str) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    west, south = plant["west"], plant["south"]
    board, other = (board_of(west, os.urandom(10)) for _ in range(2))
    plant.transport.full = True
    sync(plant, "west")
    plant.transport.full = False
    happens(west, board)
    [waiting] = west.plant.parcels.all("out", "ready")
    done = parcels.send_out(west, plant.transport, plant.views("west"), now())
    cause = f"keys for south, because of node {board.uuid.hex()}: {why}"
    cause += "; a new copy has what may still go"
    assert done.held_back == (f"1 parcel dropped: {cause}",)
    dropped, exported = [entry for entry in west.audit_log.entries() if entry.act == "export"][-2:]
    assert (dropped.uuid, dropped.outcome, exported.outcome) == (None, "parcel dropped", "done")
    assert dropped.detail == {"parcel": waiting.id, "handover": waiting.about, "why": cause}
    listed = pending.list_handovers(west, now())
    assert sorted((one.row.state, one.expired) for one in listed) == [("dropped", False), ("open", False)]
    sync(plant, "south")
    assert holds(south, other.uuid) == [(1, "import")]
    assert holds(south, board.uuid) == ([(2, "import")] if happens is rotated else [])


@pytest.mark.parametrize(("happens", "why"), OUTDATED)
def test_a_copy_that_was_ordered_is_held_back_once_a_key_in_it_is_outdated(
    plant: Plant, happens: Any, why: str
) -> None:
    plant.roster(ROLES)
    west = plant["west"]
    board, other = (board_of(west, os.urandom(10)) for _ in range(2))
    order = outgoing.ExportOrder(("south",), (board.uuid, other.uuid))
    with west.lock("test"):
        parcels.send_export(west, outgoing.plan_export(west, order), now())
    happens(west, board)
    for _ in range(2):
        assert held_back(plant) == (
            f"1 parcel held back: keys for south, because of node {board.uuid.hex()}: {why}."
            " To send what may still go: export-keys --to south UUID --send"
        )


def test_a_move_that_waits_is_held_back_once_a_node_is_revoked_and_dropped_once_it_is_undone(plant: Plant) -> None:
    plant.roster(ROLES)
    west = plant["west"]
    board, other = (board_of(west, os.urandom(10)) for _ in range(2))
    with west.lock("test"):
        plan = outgoing.plan_export(west, outgoing.ExportOrder(("south",), (board.uuid, other.uuid), "move"))
        parcels.send_export(west, plan, now())
    to_be_rotated(west, other)
    revoked(west, board)
    assert held_back(plant) == (
        f"1 parcel held back: keys for south, because of node {board.uuid.hex()}: it is revoked."
        f" Take the move back, then move the others: handover undo {plan.id}"
    )
    with west.lock("test"):
        pending.undo(west, pending.find_handover(west, plan.id))
    assert held_back(plant) == f"1 parcel dropped: keys for south, as the move {plan.id} was undone"
    assert parcels.waiting_out(west) == 0


def test_parcels_that_are_refused_are_named_with_the_exit_code_of_the_refusal(plant: Plant, tmp_path: Path) -> None:
    plant.roster(ROLES)
    west, south = plant["west"], plant["south"]
    boards = [board_of(west, os.urandom(10)) for _ in range(2)]
    for board in boards:
        with west.lock("test"):
            order = outgoing.ExportOrder(("south",), (board.uuid,))
            parcels.send_export(west, outgoing.plan_export(west, order), now())
    sync(plant, "west", "south")
    first, second = (row.id for row in south.plant.parcels.all("in", "waiting"))
    abouts = {row.id: row.about for row in south.plant.parcels.all("in", "waiting")}
    uuids = {row.id: pending_uuid(south, row.id) for row in south.plant.parcels.all("in", "waiting")}
    life.revoke(south, uuids[first], "stolen")
    words = ("import-keys", "--received", "--yes")
    shown = call(tmp_path / "south", "--json", *words, "--dry-run")
    assert (shown.code, [one["parcel"] for one in shown.json["received"]]) == (6, [second])
    assert (shown.json["error"]["code"], [one["parcel"] for one in shown.json["refused"]]) == ("refused", [first])
    assert shown.json["refused"][0]["why"] == shown.json["error"]["message"]
    done = call(tmp_path / "south", *words)
    assert (done.code, done.out) == (6, "1 parcel imported; the receipts leave with the next sync. 1 parcel refused.\n")
    assert f"Warning: Parcel {first} is refused: None of the nodes in the bundle can be imported" in done.err
    hint = "The next sync reports this to the sender, which does not send these keys again.\n"
    assert done.err.endswith(hint)
    again = call(tmp_path / "south", *words)
    assert (again.code, again.out) == (0, "Nothing waits.\n")
    events = [json.loads(text) for _, _, text in south.plant.outbox(100)]
    [refusal] = [one for one in events if one["act"] == "refused"]
    assert (refusal["uuid"], refusal["bundle"]) == (uuids[first].hex(), abouts[first])
    assert refusal["peer"] == west.fingerprint


def pending_uuid(station: Station, parcel: str) -> bytes:
    """Return the one node of a bundle that waits."""
    plan = incoming.plan_import(station, station.plant.parcels.document(parcel, "in"))
    assert isinstance(plan, incoming.ImportPlan)
    [planned] = plan.nodes
    return planned.node.uuid


def test_a_copy_is_not_ordered_under_a_roster_that_has_expired(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    roster = plant.roster(ROLES, days=3)
    monkeypatch.setattr("teds_provision.plant.jobs.now_of", lambda _: roster.expires)
    with pytest.raises(RosterExpiredError, match="no copy of keys is sent"):
        commands_of_parcels.ParcelCarrier("copy").require(plant["west"])
    commands_of_parcels.ParcelCarrier("move").require(plant["west"])


def test_a_removed_station_gets_nothing(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board_of(plant["west"], os.urandom(10))
    plant.transport.full = True
    sync(plant, "west")
    plant.transport.full = False
    plant.roster({"north": "keeper", "west": "line"}, removed={"south": (0, "")})
    sync(plant, "west")
    assert plant.transport.there == {}


def test_junk_and_what_is_for_others_is_thrown_away_and_reported(plant: Plant) -> None:
    plant.roster(ROLES)
    station = plant["south"]
    for octets in (b"junk", b"{}", b'{"a": 1}', b"", b"a.b.c", os.urandom(100)):
        plant.transport.send(Parcel(os.urandom(4).hex(), station.fingerprint, octets, "2027-01-01T00:00:00Z"))
    sync(plant, "south")
    assert plant.transport.there == {}
    assert [alarm.code for alarm in station.plant.alarms.all()] == ["parcel"]


@pytest.mark.parametrize("course", ["stolen", "expired"])
def test_what_comes_from_a_removed_station_or_too_late_is_thrown_away_without_an_alarm(
    plant: Plant, course: str
) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west")
    if course == "stolen":
        plant.roster({"north": "keeper", "south": "base"}, everything(plant, "south"), removed={"west": (0, "")})
    sync(plant, "south", at=now(8 if course == "expired" else 0))
    assert plant.transport.there == {}
    assert plant["south"].plant.alarms.all() == []
    assert not plant["south"].keys.held(board.uuid)
    assert [entry.outcome for entry in plant["south"].audit_log.entries() if entry.act == "import"] == [
        "parcel discarded"
    ]


def test_the_same_parcel_again_gives_the_same_receipt(plant: Plant) -> None:
    plant.roster(ROLES, everything(plant, "south"))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west")
    [parcel] = list(plant.transport.there.values())
    sync(plant, "south")
    plant.transport.there[parcel.id] = parcel  # a cut between import and taking it away, or an administrator
    sync(plant, "south", "west", "west")
    assert plant.transport.there == {}
    assert len(holds(plant["south"], board.uuid)) == 1


def test_another_holder_shares_for_a_maker_that_was_removed(plant: Plant) -> None:
    plant.roster(ROLES | {"west": "line base"}, everything(plant, "north"))
    board = board_of(plant["west"], os.urandom(10))
    sync(plant, "west", "north", "west")
    north = plant["north"]
    [key] = north.keys.keys_of(board.uuid)
    north.keys.activate(board.uuid, key.key_id)  # proven in a session
    plant.roster({"north": "base", "south": "base"}, everything(plant, "south"), removed={"west": (1, "ab" * 32)})
    sync(plant, "north")
    sync(plant, "south")
    assert holds(plant["south"], board.uuid) == [(1, "import")]


def test_a_job_travels_sealed_and_comes_out_as_it_was_signed(plant: Plant) -> None:
    from teds_provision.protocol.plant import document

    plant.roster(ROLES)
    members = {"format": document.JOB.format, "id": "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"}
    signed = document.sign_document(members, plant["north"].vault.identity(), document.JOB)
    sign_requests.send(plant["north"], plant.transport, plant["west"].fingerprint, signed, members["id"])
    [parcel] = plant.transport.there.values()
    assert b"teds-job" not in parcel.octets
    sync(plant, "west")
    [(row, octets)] = parcels.received(plant["west"], "job")
    assert (row.peer, octets) == (plant["north"].fingerprint, signed)
    assert plant.transport.there == {}


def test_what_waits_of_one_sender_keeps_no_other_out(plant: Plant) -> None:
    from teds_provision.protocol.plant.document import JOB, sign_document

    plant.roster(ROLES)
    west, until = plant["west"], time_text(now(60))
    for n in range(64):
        row = ParcelRow(f"{n}", "in", plant["north"].fingerprint, "sign-request", "waiting", until)
        west.plant.parcels.put(row, b"")
    for sender, kept in (("north", 0), ("south", 1)):
        signed = sign_document({"format": JOB.format, "id": sender}, plant[sender].vault.identity(), JOB)
        sealed = jose.encrypt(signed, [west.point], cty=CONTENT_TYPE)
        plant.transport.send(Parcel(sender, west.fingerprint, sealed, until, plant[sender].fingerprint))
        sync(plant, "west")
        assert len(parcels.received(west, "job")) == kept


def test_of_two_commands_at_once_the_later_one_neither_refuses_nor_answers_what_the_other_took(
    plant: Plant, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It read a parcel that was gone, refused the empty octets and ended with 8."""
    plant.roster(ROLES)
    west, south = plant["west"], plant["south"]
    for _ in range(2):
        board = board_of(west, os.urandom(10))
        with west.lock("test"):
            order = outgoing.ExportOrder(("south",), (board.uuid,))
            parcels.send_export(west, outgoing.plan_export(west, order), now())
    sync(plant, "west", "south")
    banned, _ = (pending_uuid(south, row.id) for row in south.plant.parcels.all("in", "waiting"))
    life.revoke(south, banned, "stolen")
    words, listed = ("import-keys", "--received", "--yes"), Parcels.all
    begun: list[str] = []

    def all_and_then_another(self: Parcels, *which: Any) -> Any:
        found = listed(self, *which)
        if which[0] == "in" and not begun:
            begun.append("another")
            assert call(tmp_path / "south", *words).code == 6
        return found

    monkeypatch.setattr(Parcels, "all", all_and_then_another)
    later = call(tmp_path / "south", *words)
    assert (later.code, later.out) == (0, "Nothing waits.\n")
    events = [json.loads(text)["act"] for _, _, text in south.plant.outbox(100)]
    assert events.count("refused") == 1
