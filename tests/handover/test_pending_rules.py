"""What a receipt closes and an undone move gives back, from rows and receipts made by hand (profile.md, "Handover")."""

from __future__ import annotations

import base64
import hashlib
import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotAuthenticError, NotFoundError, PolicyError
from teds_provision.handover.outgoing import _stale_before
from teds_provision.handover.pending import (
    BundleNotes,
    ListedHandover,
    close,
    content_digest,
    digest_of,
    find_handover,
    list_handovers,
    peer_name,
    refused_in,
    signer_of,
    undo,
)
from teds_provision.protocol.handover.bundle import Bundle, BundledNode
from teds_provision.protocol.handover.receipt import Receipt, RefusedNode, seal_receipt
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, Handover, HandoverMode, Holder, Tombstone, TrustRecord
from teds_provision.teds.image import Image

SOUTH, WEST, STRANGER = SoftwareKey(111), SoftwareKey(112), SoftwareKey(113)
TO_SOUTH, TO_WEST = fingerprint(SOUTH.point), fingerprint(WEST.point)
A, B = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("8d4d9da65281f7000002")
ID, OTHER_ID = "11111111-2222-4333-8444-555555555555", "11119999-2222-4333-8444-555555555555"
FILE = "f1" * 32
AT = "2026-03-01T08:00:00Z"
NOTES = BundleNotes((A.hex(), B.hex()), "c" * 64, "04ab", "2026-03-08T08:00:00Z", ("00" * 32, FILE), (), ("a1", "b1"))
Events = list[tuple[Any, ...]]


@pytest.fixture
def told(station: Station, monkeypatch: pytest.MonkeyPatch) -> Events:
    """What the plant hears; the station trusts south and west."""
    heard: Events = []
    monkeypatch.setattr(station.plant, "record_event", lambda act, uuid, **more: heard.append((act, uuid, more)))
    for name, key in (("south", SOUTH), ("west", WEST)):
        station.policy.trust(TrustRecord(name, "station", key.point, fingerprint(key.point)))
    return heard


def left(
    station: Station, mode: HandoverMode = "move", state: str = "open", *to: str, notes: BundleNotes = NOTES
) -> Handover:
    """Put a bundle that left: both nodes hold a key, which rests if it is a move."""
    row = Handover(ID, "out", mode, to or (TO_SOUTH,), state, notes.to_json(), created=AT)
    station.handovers.put(row)
    for uuid, name in ((A, b"\xa1"), (B, b"\xb1")):
        key_id = name.rjust(8, b"\0")
        station.keys.add_pending(uuid, key=bytes(16), key_id=key_id, epoch=1)
        station.keys.activate(uuid, key_id.hex())
        if mode == "move":
            station.policy.put_tombstone(Tombstone(uuid, TO_SOUTH, ID, AT))
        else:
            station.keys.put_holder(*(Holder(uuid, digits, AT) for digits in row.peers))
    return row


def receipt(station: Station, *imported: bytes, refused: tuple[bytes, ...] = (), signer: SoftwareKey = SOUTH,
            id: str = ID, file: str = FILE, to: str = "") -> bytes:  # fmt: skip
    given = Receipt(
        id, file, fingerprint(signer.point), to or station.fingerprint, imported,
        tuple(RefusedNode(uuid, "why") for uuid in refused), datetime(2026, 3, 2, tzinfo=UTC),
    )  # fmt: skip
    return seal_receipt(given, signer)


def keys(station: Station) -> list[int]:
    return [len(station.keys.keys_of(uuid)) for uuid in (A, B)]


def named(**changes: Any) -> BundleNotes:
    """The notes, with the ids of the keys as they are held."""
    return replace(NOTES, keys=(f"{0xA1:016x}", f"{0xB1:016x}"), **changes)


# -- notes -------------------------------------------------------------------------------------------------------------


def test_notes_come_back_and_those_of_earlier_versions_are_read() -> None:
    whole = replace(NOTES, refused=((A.hex(), "why"),), run="r", created=AT, stale=("s",))
    assert BundleNotes.from_json(whole.to_json()) == whole
    assert json.loads(whole.to_json()) == {
        "uuids": [A.hex(), B.hex()], "content": "c" * 64, "ca": "04ab", "expires": "2026-03-08T08:00:00Z",
        "files": ["00" * 32, FILE], "refused": [[A.hex(), "why"]], "keys": ["a1", "b1"], "run": "r", "created": AT,
        "stale": ["s"],
    }  # fmt: skip
    first = {"uuids": [A.hex()], "content": "c", "ca": "04", "expires": AT, "files": [FILE], "refused": []}
    assert BundleNotes.from_json(json.dumps(first)) == BundleNotes((A.hex(),), "c", "04", AT, (FILE,))


@pytest.mark.parametrize(
    ("created", "now", "why"),
    [
        (AT, datetime(2026, 3, 8, 7, 59, 59, tzinfo=UTC), ""),
        (AT, datetime(2026, 3, 8, 8, tzinfo=UTC), "expired at 2026-03-08T08:00:00Z"),
        (AT, datetime(2026, 3, 1, 7, 50, tzinfo=UTC), ""),  # clocks differ by ten minutes at most
        (AT, datetime(2026, 3, 1, 7, 49, 59, tzinfo=UTC), "is dated 2026-03-01T08:00:00Z, in the future"),
        ("", datetime(2026, 3, 1, tzinfo=UTC), ""),
    ],
)
def test_when_no_receiver_takes_the_newest_file(created: str, now: datetime, why: str) -> None:
    assert replace(NOTES, created=created).why_stale(now) == why


def test_a_handover_is_the_same_if_sender_receivers_mode_ca_and_keys_are() -> None:
    nodes = [(A, "a1", 1), (B, "b1", 4294967295)]
    due = f'["s",["a","b"],"move","04ab",[["{A.hex()}","a1",1],["{B.hex()}","b1",4294967295]]]'
    found = content_digest("s", ("b", "a"), "move", b"\x04\xab", iter(nodes))
    assert found == hashlib.sha256(due.encode()).hexdigest()
    assert content_digest("s", (), "copy", b"", []) == hashlib.sha256(b'["s",[],"copy","",[]]').hexdigest()
    many = [(n.to_bytes(10, "big"), "k", n) for n in range(1001)]  # some at a time
    whole = json.dumps(["s", [], "copy", "", [[u.hex(), k, n] for u, k, n in many]], separators=(",", ":"))
    assert content_digest("s", (), "copy", b"", many) == hashlib.sha256(whole.encode()).hexdigest()


def test_a_bundle_that_left_is_found_by_four_digits_of_its_id(station: Station) -> None:
    row = Handover(ID, "out", "copy", (TO_SOUTH,), "open", "{}", created=AT)
    station.handovers.put(row)
    station.handovers.put(replace(row, id=OTHER_ID))
    came = replace(row, id="aaaa1111-2222-4333-8444-555555555555", direction="in")
    station.handovers.put(came)
    assert find_handover(station, "11111") == find_handover(station, ID) == row
    letters = replace(row, id="abcd1111-2222-4333-8444-555555555555")
    station.handovers.put(letters)
    assert find_handover(station, "ABCD") == find_handover(station, letters.id.upper()) == letters
    for text in ("1111", "111", "", "aaaa1", "2222", "11111 "):
        with pytest.raises(NotFoundError):
            find_handover(station, text)
    station.handovers.remove(OTHER_ID, "out")
    assert find_handover(station, "1111") == row
    with pytest.raises(NotFoundError):
        find_handover(station, "111")


# -- undo --------------------------------------------------------------------------------------------------------------


def test_a_move_taken_back_gives_its_own_nodes_back_to_be_rotated(station: Station, told: Events) -> None:
    row = left(station)
    station.policy.put_tombstone(Tombstone(B, TO_WEST, OTHER_ID, AT))  # it rests because of another move by now
    done = undo(station, row)
    assert (done.uuids, done.fresh, done.row) == ((A, B), True, row)
    assert [entry.uuid for entry in station.policy.tombstones()] == [B]
    assert (station.keys.rotation_due(A), station.keys.rotation_due(B)) == (f"the move {ID} did not happen", None)
    assert [(holder.uuid, holder.fingerprint, holder.mode) for holder in station.keys.holders()] == [
        (A, TO_SOUTH, "move")
    ]
    assert told == [("undone", uuid, {"bundle": ID, "peer": TO_SOUTH, "why": "taken back"}) for uuid in (A, B)]
    (kept,) = station.handovers.all()
    assert kept == replace(row, state="undone")
    assert keys(station) == [1, 1]
    last = list(station.audit_log.entries())[-1]
    assert (last.outcome, last.detail) == ("undone", {"handover": ID, "nodes": [A.hex(), B.hex()]})
    again = undo(station, kept)
    assert (again.fresh, len(told)) == (False, 2)


@pytest.mark.parametrize(
    ("mode", "state", "why"),
    [
        ("copy", "open", "A copy cannot be undone: the other station holds the keys."),
        ("copy", "closed", "A copy cannot be undone: the other station holds the keys."),
        ("move", "closed", "The receipt of this move has arrived: station south holds the keys now."),
    ],
)
def test_what_is_over_there_is_not_taken_back(
    station: Station, told: Events, mode: HandoverMode, state: str, why: str
) -> None:
    with pytest.raises(PolicyError) as caught:
        undo(station, left(station, mode, state))
    assert caught.value.message == why
    assert told == []


# -- receipts ----------------------------------------------------------------------------------------------------------


def test_the_receipt_of_a_move_deletes_the_keys_that_were_in_it_and_gives_back_what_was_refused(
    station: Station, told: Events
) -> None:
    left(station, notes=named())
    station.keys.add_pending(A, key=bytes(16), key_id=b"newer___", epoch=2)
    for uuid in (A, B):
        station.datasheets.keep_draft(Draft(uuid, Image(uuid, {})))
    octets = receipt(station, A, refused=(B,))
    done = close(station, b"\n" + octets + b"\n")
    assert (done.fresh, done.row.state, done.receipt.imported) == (True, "closed", (A,))
    assert [key.epoch for key in station.keys.keys_of(A)] == [2], "a key made since was not in it"
    assert len(station.keys.keys_of(B)) == 1
    assert [draft.uuid for draft in station.datasheets.drafts()] == [B], "of what is given away nothing is written"
    assert [entry.uuid for entry in station.policy.tombstones()] == [A]
    assert station.keys.rotation_due(B) == f"the move {ID} did not happen"
    assert [event for event in told if event[0] == "undone"] == [
        ("undone", B, {"bundle": ID, "peer": TO_SOUTH, "why": "refused"})
    ]
    (row,) = station.handovers.all()
    assert (row.state, row.receipt) == ("closed", octets.decode())
    again = close(station, octets)
    assert (again.fresh, again.row) == (False, row)


def test_a_plan_of_a_receipt_is_what_is_done_then_and_changes_nothing(station: Station, told: Events) -> None:
    row = left(station, notes=named())
    octets, before = receipt(station, A, refused=(B,)), station.audit_log.newest()
    plan = close(station, octets, dry_run=True)
    assert (plan.fresh, plan.row.state) == (True, "closed")
    assert (station.audit_log.newest(), station.handovers.all(), keys(station), told) == (before, [row], [1, 1], [])
    assert close(station, octets) == plan
    last = list(station.audit_log.entries())[-1]
    counts = {"imported": 1, "refused": 1}
    assert (last.act, last.outcome, last.detail) == (
        "handover", "receipt", {"state": "closed", "from": TO_SOUTH, "handover": ID, **counts},
    )  # fmt: skip


def test_the_receipt_of_an_old_row_deletes_the_keys_that_there_were_when_the_bundle_left(station: Station) -> None:
    station.policy.trust(TrustRecord("south", "station", SOUTH.point, TO_SOUTH))
    left(station, notes=replace(NOTES, keys=()))
    station._store.execute("UPDATE keys SET created = ? WHERE uuid = ?", (AT, A))
    station._store.execute("UPDATE keys SET created = '2026-03-01T08:00:01Z' WHERE uuid = ?", (B,))
    close(station, receipt(station, B, A))
    assert keys(station) == [0, 1]


def test_a_late_receipt_deletes_nothing_of_a_node_that_came_back(station: Station, told: Events) -> None:
    left(station, notes=named())
    station.policy.take_back([A])
    station.policy.put_tombstone(Tombstone(B, TO_WEST, OTHER_ID, AT))
    close(station, receipt(station, A, B))
    assert keys(station) == [1, 1]


def test_a_copy_for_two_is_closed_by_the_second_receipt(station: Station, told: Events) -> None:
    left(station, "copy", "open", TO_SOUTH, TO_WEST, notes=named())
    first, second = receipt(station, A, refused=(B,)), receipt(station, A, B, signer=WEST)
    assert close(station, first).row.state == "open"
    assert not close(station, first).fresh
    done = close(station, second)
    assert (done.fresh, done.row.state) == (True, "closed")
    assert done.row.receipt == f"{first.decode()}\n{second.decode()}"
    assert keys(station) == [1, 1]
    assert {(holder.uuid, holder.fingerprint) for holder in station.keys.holders()} == {
        (A, TO_SOUTH), (A, TO_WEST), (B, TO_WEST)
    }  # fmt: skip
    assert told == [("undone", B, {"bundle": ID, "peer": TO_SOUTH, "why": "refused"})]
    assert [signer_of(text) for text in (done.row.receipt or "").split()] == [TO_SOUTH, TO_WEST]
    assert [signer_of(text) for text in ("", "a.b.c", "a")] == ["", "", ""]


def test_a_receipt_of_an_undone_move_says_how_many_keys_are_out(station: Station, told: Events) -> None:
    row = left(station, "move", "undone", notes=named())
    before = station.audit_log.newest()
    with pytest.raises(PolicyError, match="was undone here"):
        close(station, receipt(station, A, refused=(B,)), dry_run=True)
    assert station.audit_log.newest() == before
    with pytest.raises(PolicyError) as caught:
        close(station, receipt(station, A, refused=(B,)))
    assert caught.value.message == "This move was undone here, but station south took 1 key in all the same."
    assert (keys(station), told, station.handovers.all()) == ([1, 1], [], [row])
    last = list(station.audit_log.entries())[-1]
    assert (last.outcome, last.detail) == ("receipt of an undone move", {"handover": ID})


@pytest.mark.parametrize(
    ("given", "error", "why"),
    [
        ({"id": OTHER_ID}, NotFoundError, "No bundle 11119999"),
        ({"signer": WEST}, PolicyError, "The receipt is between"),
        ({"to": TO_WEST}, PolicyError, "The receipt is between"),
        ({"signer": STRANGER}, NotAuthenticError, "not trusted here"),
        ({"file": "f2" * 32}, NotAuthenticError, "another bundle than any that left"),
        ({"imported": (A,)}, NotAuthenticError, "names other nodes"),
        ({"imported": (A, B, bytes(10))}, NotAuthenticError, "names other nodes"),
        ({"imported": (A,), "refused": (A,)}, BadDataError, "an UUID twice"),
    ],
)
def test_a_receipt_that_does_not_fit_changes_nothing(
    station: Station, told: Events, given: dict[str, Any], error: type[Exception], why: str
) -> None:
    row = left(station, notes=named())
    more = {name: value for name, value in given.items() if name != "imported"}
    with pytest.raises(error, match=why):
        close(station, receipt(station, *given.get("imported", (A, B)), **more))
    assert (keys(station), told, station.handovers.all()) == ([1, 1], [], [row])
    assert close(station, receipt(station, A, B, file="00" * 32)).fresh, "any file that left under this id"


def test_bundles_are_listed_with_names_and_whether_they_can_still_be_taken(station: Station, told: Events) -> None:
    stranger = fingerprint(STRANGER.point)
    open_one = Handover(ID, "out", "copy", (TO_SOUTH, stranger), "open", NOTES.to_json(), created=AT)
    one = replace(NOTES, uuids=(A.hex(),))
    came = Handover(OTHER_ID, "in", "move", (TO_WEST,), "imported", one.to_json(), created=AT)
    for row in (came, open_one):
        station.handovers.put(row)
    ends = datetime(2026, 3, 8, 8, tzinfo=UTC)
    assert list_handovers(station, ends - timedelta(seconds=1)) == [
        ListedHandover(open_one, ("south", stranger[:16]), 2, "2026-03-08T08:00:00Z", False),
        ListedHandover(came, ("west",), 1, "2026-03-08T08:00:00Z", False),
    ]
    assert [listed.expired for listed in list_handovers(station, ends)] == [True, False]


def test_a_bundle_has_the_digest_of_its_nodes_in_ascending_order() -> None:
    one = BundledNode(A, SOUTH.point, b"k" * 16, 3)
    two = BundledNode(B, WEST.point, b"l" * 16, 4)
    now = datetime(2026, 3, 1, tzinfo=UTC)
    bundle = Bundle(ID, "s", (TO_WEST, TO_SOUTH), now, now, "move", b"\x04", (two, one), {})
    due = content_digest("s", (TO_SOUTH, TO_WEST), "move", b"\x04", [(A, one.kid, 3), (B, two.kid, 4)])
    assert digest_of(bundle) == digest_of(replace(bundle, nodes=(one, two))) == due


def test_a_station_is_called_by_its_name_here_else_by_16_digits(station: Station, told: Events) -> None:
    assert [peer_name(station, digits) for digits in (TO_WEST, TO_SOUTH, "ab" * 32)] == ["west", "south", "ab" * 8]


def test_whom_a_receipt_refuses_is_read_in_small_letters_and_nobody_of_none() -> None:
    document = json.dumps({"refused": [{"uuid": A.hex().upper(), "why": "w"}]}).encode()
    payload = base64.urlsafe_b64encode(document).rstrip(b"=").decode()
    assert refused_in(f"head.{payload}.signature") == {A.hex()}
    for none in ("", "no receipt", "head.!.signature"):
        assert refused_in(none) == frozenset()


@pytest.mark.parametrize(
    ("now", "stale"),
    [(datetime(2026, 3, 2, tzinfo=UTC), ("s",)), (datetime(2027, 1, 1, tzinfo=UTC), (FILE,)), (None, ("s",))],
)
def test_which_files_of_a_bundle_no_receiver_takes_any_more(now: datetime | None, stale: tuple[str, ...]) -> None:
    notes = BundleNotes((A.hex(),), "c", "04", "2026-03-08T08:00:00Z", (FILE,), created=AT, stale=("s",))
    earlier: Any = SimpleNamespace(earlier=SimpleNamespace(nodes=notes.to_json()))
    assert _stale_before(earlier, now) == stale
    assert _stale_before(SimpleNamespace(earlier=None), now) == ()  # type: ignore[arg-type]
