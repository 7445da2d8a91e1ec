"""Entries of the audit log that the plant's acts leave: which act, of which node, how it ended, and each fact."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import (
    BadDataError,
    LinkError,
    NodeRefusedError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    TedsProvisionError,
)
from teds_provision.plant import apply_pages, evidence, membership, parcels, removed_members
from teds_provision.plant.transport import Parcel
from teds_provision.provisioning.conversation import SessionLostError
from teds_provision.station.plant.parcels import ParcelRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord
from tests.plant.owner import REGISTRY, alone

A, B = (bytes([number] * 10) for number in (1, 2))
WEST, SOUTH = "ee" * 32, "dd" * 32
NOW = datetime(2026, 3, 8, 12, tzinfo=UTC)
SECOND = timedelta(seconds=1)
Entry = tuple[str, bytes | None, str, dict[str, Any]]


def stub(**members: Any) -> Any:
    return SimpleNamespace(**members)


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Station]:
    made = alone(tmp_path_factory.mktemp("audited") / "home")
    made.unlock()
    yield made
    made.close()


class Log:
    """What was added to the log since the last look."""

    def __init__(self, station: Station) -> None:
        self.station = station
        self._seen = station.audit_log.newest()[0]

    def new(self) -> list[Entry]:
        found = [(entry.act, entry.uuid, entry.outcome, entry.detail) for entry in self._entries()]
        self._seen += len(found)
        return found

    def _entries(self) -> list[Any]:
        return list(self.station.audit_log.entries(self._seen))


@pytest.fixture
def log(opened: Station) -> Log:
    return Log(opened)


def text(moment: datetime) -> str:
    return moment.strftime("%Y-%m-%dT%H:%M:%SZ")


def test_a_parcel_that_outlived_its_use_is_dropped_with_an_entry(opened: Station, log: Log) -> None:
    """A registry keeps a request or an answer for 31 days at most."""
    month = timedelta(days=31)
    rows: list[tuple[str, Any, str, datetime, bool]] = [
        ("bundle at its end", "bundle", text(NOW), NOW, True),
        ("bundle before its end", "bundle", text(NOW + SECOND), NOW - 9 * month, False),
        ("bundle without an end", "bundle", "", NOW, False),
        ("old request", "sign-request", text(NOW + month), NOW - month - SECOND, True),
        ("request of a month", "sign-request", text(NOW - month), NOW - month, False),
        ("old answer", "signed", text(NOW + month), NOW - month - SECOND, True),
        ("old job", "job", text(NOW - month), NOW - 9 * month, False),
    ]
    kept = opened.plant.parcels
    for state in ("waiting", "later"):
        for name, kind, expires, created, _ in rows:
            kept.put(ParcelRow(name, "in", WEST, kind, cast("Any", state), expires, name[:3], "", text(created)), b"")
        parcels._drop_outlived(opened, NOW)
        assert {row.id for row in kept.all("in", state)} == {name for name, *_, over in rows if not over}
        assert sorted(log.new(), key=lambda entry: entry[3]["parcel"]) == [
            ("import", None, "expired", {"parcel": name, "handover": name[:3]})
            for name in ("bundle at its end", "old answer", "old request")
        ]
    for name, *_ in rows:
        kept.drop(name, "in")


@pytest.mark.parametrize(
    ("error", "removed", "alarmed"),
    [
        (BadDataError("It is none."), False, True),
        (NotAuthenticError("Nobody signed it."), False, True),
        (NotAuthenticError("West signed it."), True, False),
        (NotFoundError("Its station is unknown."), False, False),
        (PolicyError("It came too late."), False, False),
    ],
)
def test_a_parcel_of_no_use_is_discarded_with_its_reason_and_one_that_is_suspicious_is_an_alarm(
    opened: Station, log: Log, monkeypatch: pytest.MonkeyPatch, error: TedsProvisionError, removed: bool, alarmed: bool
) -> None:
    reader: Any = parcels._Reader.__new__(parcels._Reader)
    reader.station = opened
    monkeypatch.setattr(reader, "_is_from_removed", lambda _: removed)
    assert reader._junk(Parcel("p1", opened.fingerprint, b"", "", WEST), error) is True
    discarded = ("import", None, "parcel discarded", {"parcel": "p1", "why": error.message})
    assert log.new() == [discarded]
    raised = [(one.code, one.about, one.n, one.why) for one in opened.plant.alarms.all() if not one.seen]
    why = f"a parcel was discarded: {error.message.rstrip('.')}"
    assert raised == ([("parcel", WEST, 0, why)] if alarmed else [])
    opened.plant.alarms.see()
    with pytest.raises(LinkError):
        reader._junk(Parcel("p1", opened.fingerprint, b"", "", WEST), LinkError("The registry is gone."))
    assert log.new() == []


def test_a_bundle_that_is_refused_whole_is_an_event_of_each_node_and_one_entry(
    opened: Station, log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    events = list[tuple[object, ...]]()
    monkeypatch.setattr(opened.plant, "record_event", lambda act, uuid, **facts: events.append((act, uuid, facts)))
    nodes = [stub(node=stub(uuid=A), why="revoked"), stub(node=stub(uuid=B), why="older")]
    error = stub(nodes=nodes, bundle=stub(id="b1", sender=WEST), message="Nothing can be imported.")
    for name in ("p1", "p2"):
        opened.plant.parcels.put(ParcelRow(name, "in", WEST, "bundle", "waiting", "2099-01-01T00:00:00Z"), b"")
    parcels.refuse_bundle(opened, error, "p1")
    assert [row.id for row in opened.plant.parcels.all("in", "waiting")] == ["p2"]
    assert events == [
        ("refused", uuid, {"bundle": "b1", "peer": WEST, "why": why}) for uuid, why in ((A, "revoked"), (B, "older"))
    ]
    assert log.new() == [("import", None, "refused", {"handover": "b1", "why": "Nothing can be imported."})]
    parcels.refuse_bundle(opened, error)
    assert [row.id for row in opened.plant.parcels.all("in", "waiting")] == ["p2"]
    opened.plant.parcels.drop("p2", "in")


def test_keys_up_to_an_epoch_are_forgotten_with_an_entry(opened: Station, log: Log) -> None:
    for epoch in (1, 2, 3):
        opened.keys.add_pending(A, key=bytes(16), key_id=bytes([epoch]) * 8, epoch=epoch)
    parcels._delete(opened, A, 2)
    assert [key.epoch for key in opened.keys.keys_of(A)] == [3]
    assert log.new()[-1] == ("handover", A, "forgot", {"epoch": 2})
    opened.keys.remove(A)


def test_a_rotation_that_is_due_is_noted_once_with_why(
    opened: Station, log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    for uuid in (A, B):
        opened.keys.add_pending(uuid, key=bytes(16), key_id=bytes(8), epoch=1)
    keys = {key.uuid: key for uuid in (A, B) for key in opened.keys.keys_of(uuid)}
    roster: Any = stub(removed=[stub(fingerprint=WEST)], removed_one=lambda _: None)
    known = list[Any]()

    def why_due(removed: Any, key: Any, *_: Any, own_turn: bool) -> str | None:
        known.append((key.uuid, [one.fingerprint for one in removed], own_turn))
        return f"{removed_members.REMOVED}west (lost) has held this key" if removed else None

    monkeypatch.setattr(removed_members, "_why_due", why_due)
    monkeypatch.setattr(removed_members, "_own_turn", lambda *_: True)
    beyond = {(A, 1, "00" * 8): {WEST}, (B, 2, "00" * 8): {WEST}}
    for _ in range(2):
        removed_members._mark(opened, roster, keys, beyond, NOW, {})
    why = f"{removed_members.REMOVED}west (lost) has held this key"
    assert log.new() == [("registry", A, "rotation due", {"why": why})]
    assert opened.keys.rotation_due(A) == why
    assert opened.keys.rotation_due(B) is None
    assert known[:2] == [(A, [WEST], True), (B, [], False)], "a key of another epoch is another one"
    for uuid in (A, B):
        opened.keys.remove(uuid)


def test_keys_of_a_removed_stations_pages_that_do_not_count_are_known_as_held(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it wrote after its last page, and on another history below it, shows what else it had."""

    def page(*keys: tuple[bytes, int]) -> Any:
        events = [{"uuid": uuid, "epoch": epoch} for uuid, epoch in keys]
        return stub(content={"events": [*events, "junk", {"uuid": None}]})

    kept = {(1, "h1"): page((A, 1)), (2, "h2"): page((A, 2)), (2, "other"): page((B, 7)), (4, "gone"): None}
    kept[3, "h3"] = page((A, 3), (B, 8))
    chains = {WEST: stub(id=1, counted=(2, "h2")), SOUTH: stub(id=2, counted=(0, ""))}
    pages = stub(
        chains=lambda: chains, chain_links=lambda of: [(n, hash, "") for n, hash in kept] if of == 1 else [],
        get=lambda of, n, hash: kept[n, hash],
    )  # fmt: skip

    def read(value: Any) -> Any:
        if value == "junk":
            return "it has no act"
        members = {"epoch": value["epoch"], "key_id": "k"} if value["uuid"] else {}
        return removed_members.event.Event("agreed", "id", "at", value["uuid"], members)

    monkeypatch.setattr(removed_members, "counted_places", lambda *_: {(1, "h1"), (2, "h2")})
    monkeypatch.setattr(removed_members, "load_exact", lambda content, _what: content)
    monkeypatch.setattr(removed_members.event, "read", read)
    roster: Any = stub(removed=[stub(fingerprint=digits) for digits in (WEST, SOUTH, "aa" * 32)])
    assert removed_members._beyond(stub(plant=stub(pages=pages)), roster) == {
        (B, 7, "k"): {WEST}, (A, 3, "k"): {WEST}, (B, 8, "k"): {WEST}
    }  # fmt: skip


def test_keys_are_reviewed_when_another_station_is_removed_and_each_hour(
    opened: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    hour, reviews = timedelta(hours=1), list[datetime]()
    monkeypatch.setattr(removed_members, "_first_removals", lambda _station, now: reviews.append(now) or {})
    for name, value in (("_beyond", {}), ("_pages", ()), ("_alone", 3)):
        monkeypatch.setattr(removed_members, name, lambda *_, value=value: value)

    def review(now: datetime, *removed: str) -> removed_members.RemovalReview | None:
        reviews.clear()
        roster: Any = stub(removed=[stub(fingerprint=digits) for digits in removed])
        return removed_members.review(opened, roster, now)

    assert (review(NOW), reviews) == (None, [])
    first = review(NOW, WEST, SOUTH)
    assert first is not None
    assert (first.at, first.alone, reviews) == (NOW.isoformat(), 3, [NOW])
    for removed in ((WEST, SOUTH), (SOUTH, WEST)):
        for now in (NOW + hour - SECOND, NOW - hour + SECOND):
            assert (review(now, *removed), reviews) == (first, []), "it is the same, in whatever order"
    for now in (NOW + hour, NOW - hour):
        assert review(now, WEST, SOUTH) != first, "by a clock that was wrong then, too"
        assert review(NOW, WEST, SOUTH) == first
    assert review(NOW, WEST) != first
    assert removed_members.last(opened) == review(NOW, WEST)


def test_files_of_evidence_are_those_of_a_board_and_a_number(tmp_path: Path) -> None:
    for name in (f"{A.hex()}.1.json", f"{A.hex()}.12.json", f"{B.hex()}.3.json", f"{A.hex()}.json", "x.1.json"):
        (tmp_path / name).touch()
    assert evidence._evidence_files(tmp_path) == {A.hex(): {1, 12}, B.hex(): {3}}
    assert evidence._evidence_files(tmp_path / "nowhere") == {}
    assert evidence._evidence_files(tmp_path / "x.1.json") == {}, "writing there says what is wrong"


@pytest.mark.parametrize(
    "error", [LinkError("x"), NodeRefusedError("x", reason=1), NotAuthenticError("x"), SessionLostError(LinkError("x"))]
)
def test_of_a_board_that_is_gone_the_station_signs_alone(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    sealed = list[Any]()

    def prove(*_: object) -> bytes:
        raise error

    def seal(key: object, signature: object, claim: Any, **more: Any) -> bytes:
        sealed.append((key, signature, more))
        return b"envelope"

    monkeypatch.setattr(evidence, "prove_claim", prove)
    monkeypatch.setattr(evidence, "seal", seal)
    credentials = stub(key="key", station_signature="signature")
    facts = stub(failure="no-node")
    claim: Any = stub(facts=facts)
    node: Any = None
    assert evidence.sign_evidence(node, credentials, claim, operator="Eve", finished="then") == b"envelope"
    without = {"nonce": b"", "proof": b"", "finished": "then", "operator": "Eve"}
    assert sealed == [("key", "signature", without)]
    facts.failure = None
    with pytest.raises(type(error)):
        evidence.sign_evidence(node, credentials, claim)
    assert len(sealed) == 1, "a board that passed must answer"


def test_an_alarm_and_a_roster_are_entries_with_whom_they_are_about(opened: Station, log: Log) -> None:
    for again, why in ((False, "first"), (False, "it lasts"), (True, "once more")):
        apply_pages.alarm(opened, "junk", WEST, 3, why, again=again)
    assert log.new() == [("registry", None, "alarm: junk", {"about": "ee" * 8, "n": 3, "why": "first"})]
    opened.plant.alarms.see()
    apply_pages.alarm(opened, "junk", WEST, 3, "once more", again=True)
    assert log.new() == [("registry", None, "alarm: junk", {"about": "ee" * 8, "n": 3, "why": "once more"})]
    opened.plant.alarms.end_about("junk", WEST)
    held = opened.plant.roster
    assert held is not None
    apply_pages.put_roster(opened, held)
    assert log.new() == [("registry", None, "roster", {"version": held.version, "hash": held.hash})]


def test_a_ban_that_no_page_states_any_more_is_lifted_with_why_it_was(
    opened: Station, log: Log, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(apply_pages.event, "hash_of_statement", lambda statement: f"H of {statement}")
    lifted = [False]
    monkeypatch.setattr(apply_pages, "_is_lifted", lambda *_: lifted[0])
    ban = RevocationRecord(A, None, "stolen", "a statement", "2026-11-21T00:00:00Z")
    opened.policy.deny(ban)
    one, other = (stub(hash=f"H of {text}") for text in ("a statement", "another"))
    for bans, statements in (((one,), [one]), ((), [other]), ((), [])):
        apply_pages._ban(opened, A, stub(bans=bans), statements)
        assert opened.policy.revocation(A) is not None, "it counts, or it came in a bundle that nobody lifted"
    assert log.new() == []
    apply_pages._ban(opened, A, stub(bans=()), [one])
    gone: Entry = ("revoke", A, "lifted", {"by": "registry", "why": "stolen"})
    assert (log.new(), opened.policy.revocation(A)) == ([gone], None)
    opened.policy.deny(ban)
    lifted[0] = True
    apply_pages._ban(opened, A, stub(bans=()), [])
    assert (log.new(), opened.policy.revocation(A)) == ([gone], None)
    opened.policy.deny(replace(ban, statement=""))
    apply_pages._ban(opened, A, stub(bans=()), [])
    assert (log.new(), opened.policy.revocation(A) is not None) == ([], True), "a ban of this station's own, unsigned"
    opened.policy.forgive(A)


def test_who_asks_to_join_and_who_leaves_has_an_entry(tmp_path: Path) -> None:
    station = alone(tmp_path / "home")
    station.unlock()
    log = Log(station)
    membership.request(station)
    asked: Entry = ("registry", None, "requested", {"fingerprint": station.fingerprint})
    assert log.new() == [asked]
    membership.request(station)
    assert log.new() == [], "it is the same request"
    membership.disconnect(station)
    assert log.new() == [("registry", None, "left", {"registry": REGISTRY})]
    station.close()
