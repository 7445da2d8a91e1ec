"""What a ban and a replacement leave in the store: states that no board is needed for."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import BadDataError, NotFoundError, NotWhitelistedError, PolicyError, UsageError
from teds_provision.handover import life
from teds_provision.handover.deny import deny, lift
from teds_provision.handover.life import (
    TakeoverPlan,
    hand_on,
    is_finished,
    is_retired,
    plan_takeover,
    retire,
    revoke,
    take_over,
)
from teds_provision.protocol.handover.revocation import open_revocation, seal_revocation
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.provisioning.agree import ResetReceipt
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, KeyRecord, NodeRecord, Tombstone, WhitelistEntry
from teds_provision.teds.image import Image
from tests.bench import copied_station

OLD, NEW, THIRD = (bytes([number]) * 10 for number in (1, 2, 3))
NODE = SoftwareKey(41)
PIN = fingerprint(NODE.point)
RECEIPT = ResetReceipt(3, bytes(range(32)), bytes(range(64)))
JANUARY, FEBRUARY = datetime(2026, 1, 31, tzinfo=UTC), datetime(2026, 2, 1, tzinfo=UTC)


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    with copied_station(tmp_path / "home") as made:
        made.unlock()
        yield made


def key_of(uuid: bytes, state: Any = "active") -> KeyRecord:
    return KeyRecord(uuid, 1, "ab" * 8, state, 1, b"wrapped", "agreement", "2026-01-31T12:00:00Z")


# -- revoke ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("listed", "keyed"), [(True, True), (True, False), (False, True), (False, False)])
def test_a_ban_of_another_station_is_carried_out_by_revoke_and_stays_as_it_is(
    station: Station, listed: bool, keyed: bool
) -> None:
    """A bundle brought the ban: entry, keys and draft of the node go with this station's own word."""
    other = SoftwareKey(42)
    deny(station, seal_revocation(other, uuid=OLD, node=PIN, why="lost", created=JANUARY), key=PIN)
    banned = station.policy.revocation(OLD)
    if listed:
        station.pins.put(WhitelistEntry(OLD, PIN, assurance="tap"))
    if keyed:
        station.keys.add(key_of(OLD))
    station.datasheets.keep_draft(Draft(OLD, Image(OLD, {})))
    station.keys.add(key_of(NEW))
    before = station.audit_log.newest()[0]
    done = revoke(station, OLD, "stolen")
    assert done.fresh is (listed or keyed)
    assert done.entry == banned == station.policy.revocation(OLD)
    assert (station.pins.entry(OLD), station.keys.held(OLD), station.keys.held(NEW)) == (None, False, True)
    assert (station.datasheets.draft(OLD) is None) is done.fresh
    entries = [(entry.act, entry.outcome, entry.detail) for entry in station.audit_log.entries(before)]
    assert entries == ([("revoke", "done", {"why": "stolen", "keys": int(keyed)})] if done.fresh else [])


@pytest.mark.parametrize(
    ("entry", "point", "named"),
    [
        (WhitelistEntry(OLD, PIN, assurance="tap"), None, PIN),
        (WhitelistEntry(OLD, PIN[:32], assurance="uuid"), None, None),
        (WhitelistEntry(OLD, PIN[:32], assurance="uuid"), NODE.point, PIN),
        (WhitelistEntry(OLD), None, None),
        (None, NODE.point, PIN),
        (None, None, None),
    ],
)
def test_a_statement_names_a_whole_key_or_bans_the_uuid(
    station: Station, entry: WhitelistEntry | None, point: bytes | None, named: str | None
) -> None:
    if entry is not None:
        station.pins.put(entry)
    if point is not None:
        station.nodes.put(NodeRecord(OLD, point))
    done = revoke(station, OLD, "stolen")
    stated = open_revocation(done.entry.statement, lambda kid: station.point)
    assert (stated.fingerprint, stated.sender, stated.why) == (named, station.fingerprint, "stolen")
    assert station.policy.denied(OLD, PIN) is not None


@pytest.mark.parametrize(("why", "good"), [("x" * 1024, True), ("x" * 1025, False), ("\t", False), (" ", False)])
def test_the_reason_of_a_ban(station: Station, why: str, good: bool) -> None:
    if good:
        assert revoke(station, OLD, why).entry.why == why
    else:
        with pytest.raises(Exception, match="at most 1,024 characters"):
            revoke(station, OLD, why)
        assert station.policy.revocation(OLD) is None


def test_a_ban_that_names_no_key_is_bound_to_the_pinned_one_and_the_first_ban_stays(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = SoftwareKey(42), SoftwareKey(43)
    deny(station, seal_revocation(one, uuid=OLD, node=None, why="lost", created=JANUARY), key=PIN)
    deny(station, seal_revocation(two, uuid=OLD, node="cd" * 32, why="burnt", created=FEBRUARY), key=PIN)
    entry = station.policy.revocation(OLD)
    assert entry is not None
    assert (entry.fingerprint, entry.why, entry.created) == (PIN, "lost", "2026-01-31T00:00:00Z")
    deny(station, seal_revocation(two, uuid=NEW, node="cd" * 32, why="burnt", created=FEBRUARY), key=PIN)
    other = station.policy.revocation(NEW)
    assert other is not None
    assert other.fingerprint == "cd" * 32, "the key that the statement names goes before the pinned one"
    course: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(station, "unlock", lambda: course.append("unlocked"))
        patch.setattr(station, "transaction", lambda: (course.append("begun"), nullcontext())[1])
        assert lift(station, OLD)
        assert course == ["unlocked", "begun"], "no transaction waits for a passphrase"
        assert not lift(station, OLD)
        assert len(course) == 2
    assert [entry.uuid for entry in station.policy.revocations()] == [NEW]
    last = list(station.audit_log.entries())[-1]
    assert (last.act, last.uuid, last.outcome, last.detail) == ("revoke", OLD, "lifted", {"why": "lost"})


# -- out of service ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("retired", "is_out", "finished"),
    [
        (None, False, False),
        ("decommissioned", True, True),
        ("decommissioned, unconfirmed", True, False),
        (f"replaced by {NEW.hex()}", True, True),
        (f"replaced by {NEW.hex()}, unconfirmed", True, False),
        ("another board showed its key", False, False),
    ],
)
def test_which_nodes_are_out_of_service_for_good(
    station: Station, retired: str | None, is_out: bool, finished: bool
) -> None:
    station.nodes.put(NodeRecord(OLD, retired=retired))
    assert (is_retired(station.nodes.get(OLD)), is_finished(station, OLD)) == (is_out, finished)
    assert not is_finished(station, NEW)


def test_what_a_retired_node_leaves(station: Station) -> None:
    station.pins.put(WhitelistEntry(OLD, PIN, assurance="tap"), WhitelistEntry(NEW))
    station.nodes.put(NodeRecord(OLD, NODE.point, name="thumb", profile="p"))
    station.keys.add(key_of(OLD))
    station.groups.create("hand", [OLD, NEW])
    station.datasheets.keep_draft(Draft(OLD, Image(OLD, {})))
    left = retire(station, OLD, None)
    assert left.groups == ("hand",)
    assert [entry.uuid for entry in station.pins.whitelist()] == [NEW]
    assert station.datasheets.drafts() == []
    assert station.keys.held(OLD), "the same command can finish later"
    record = station.nodes.get(OLD)
    assert record is not None
    assert (record.name, record.profile, record.retired) == (None, "p", "decommissioned, unconfirmed")
    entry = list(station.audit_log.entries())[-1]
    assert (entry.act, entry.outcome) == ("decommission", "decommissioned, unconfirmed")
    assert entry.detail == {"name": "thumb", "groups": ["hand"]}
    retire(station, OLD, RECEIPT)
    entry = list(station.audit_log.entries())[-1]
    assert (entry.outcome, entry.detail) == ("decommissioned", {"name": None, "proof": RECEIPT.proof.hex()})


# -- replaced ----------------------------------------------------------------------------------------------------------


def test_who_takes_no_place_and_whose_place_is_not_taken(station: Station) -> None:
    plan = partial(plan_takeover, station, OLD, copy_calibration=False)
    with pytest.raises(UsageError, match=r"^A node cannot replace itself\.$"):
        plan(OLD)
    with pytest.raises(NotFoundError, match=rf"^Node {OLD.hex()} is not known here\.$"):
        plan(NEW)
    station.nodes.put(NodeRecord(OLD, NODE.point))
    with pytest.raises(NotWhitelistedError, match=NEW.hex()):
        plan(NEW)
    station.pins.put(WhitelistEntry(NEW))
    assert not plan(NEW).done
    station.policy.put_tombstone(Tombstone(OLD, PIN, "h", "2026-01-31T12:00:00Z"))
    with pytest.raises(PolicyError, match="was moved to station"):
        plan(NEW)


def test_a_replaced_node_that_is_reset_later_is_confirmed(station: Station) -> None:
    station.pins.put(WhitelistEntry(OLD, PIN, assurance="tap"), WhitelistEntry(NEW))
    station.nodes.put(NodeRecord(OLD, NODE.point, name="thumb"))
    take_over(station, plan_takeover(station, OLD, NEW, copy_calibration=False), None)
    assert not is_finished(station, OLD)
    again = plan_takeover(station, OLD, NEW, copy_calibration=False)
    assert again.done
    station.nodes.remember(NEW, name="renamed since")
    take_over(station, again, RECEIPT)
    assert is_finished(station, OLD)
    spare = station.nodes.get(NEW)
    assert spare is not None
    assert spare.name == "renamed since", "what it took over once it does not take over again"
    assert not TakeoverPlan(replace(again.old, retired=f"replaced by {THIRD.hex()}"), again.new, {}).done


def test_what_a_spare_gets_and_what_is_said_of_it(station: Station) -> None:
    station.pins.put(WhitelistEntry(OLD, PIN, assurance="tap"), WhitelistEntry(NEW, name="spare 1"))
    station.nodes.put(NodeRecord(OLD, NODE.point, name="thumb", profile="p"))
    station.groups.create("hand", [OLD])
    before = station.audit_log.newest()[0]
    plan = plan_takeover(station, OLD, NEW, copy_calibration=False)
    hand_on(station, replace(plan, old=NodeRecord(THIRD)))
    assert station.audit_log.newest()[0] == before, "nothing was moved, and nothing is said"
    assert hand_on(station, plan).groups == ("hand",)
    entry = list(station.audit_log.entries())[-1]
    assert (entry.act, entry.uuid, entry.outcome) == ("replace", NEW, "moved")
    take_over(station, plan, RECEIPT)
    listed = station.pins.entry(NEW)
    assert listed is not None
    assert listed.name == "spare 1", "the old entry had no name"
    acts = [(entry.act, entry.uuid, entry.outcome) for entry in station.audit_log.entries(entry.seq)]
    assert acts == [("decommission", OLD, f"replaced by {NEW.hex()}"), ("replace", NEW, "done")]


@pytest.mark.parametrize(("profile", "named"), [("gripper", "built as gripper"), (None, "built")])
def test_a_draft_that_a_spare_loses_is_named_before_and_after(
    station: Station, profile: str | None, named: str
) -> None:
    station.pins.put(WhitelistEntry(NEW))
    station.nodes.put(NodeRecord(OLD, NODE.point, name="thumb"))
    assert plan_takeover(station, OLD, NEW, copy_calibration=False).warnings == ()
    drafted = Draft(NEW, Image(NEW, {(0, 1): b"x"}), "built", profile, "2026-01-31T12:00:00Z")
    station.datasheets.keep_draft(drafted)
    plan = plan_takeover(station, OLD, NEW, copy_calibration=False)
    warning = f"The draft of node {NEW.hex()} ({named}) was never written; it is dropped."
    assert (plan.draft, plan.warnings) == (drafted, (warning,))
    assert take_over(station, plan, None)[0] == (warning,)
    assert station.datasheets.draft(NEW) is None
    station.datasheets.keep_draft(drafted)
    assert plan_takeover(station, OLD, NEW, copy_calibration=False).warnings == (), "it stays: nothing is taken over"


def test_a_draft_that_was_written_is_none_that_a_spare_loses(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    station.pins.put(WhitelistEntry(NEW))
    station.nodes.put(NodeRecord(OLD, NODE.point))
    station.datasheets.keep_draft(Draft(NEW, Image(NEW, {(0, 1): b"x"}), "signed", None, "2026-01-31T12:00:00Z"))
    monkeypatch.setattr(life, "pending_image", lambda _station, uuid, has: None if (uuid, has) == (NEW, None) else has)
    assert plan_takeover(station, OLD, NEW, copy_calibration=False).draft is None


def test_a_calibration_that_cannot_be_built_in(station: Station) -> None:
    station.pins.put(WhitelistEntry(NEW))
    station.nodes.put(NodeRecord(OLD, NODE.point))
    with pytest.raises(NotFoundError, match=f"No calibration of node {OLD.hex()} is known here"):
        plan_takeover(station, OLD, NEW, copy_calibration=True)
    station.datasheets.keep_datasheet(Image(OLD, {(1, 3): b"channel", (1, 5): b"calibration"}))
    with pytest.raises(BadDataError, match="The profile of the old node is not known"):
        plan_takeover(station, OLD, NEW, copy_calibration=True)
    station.nodes.remember(OLD, profile="p")
    plan = plan_takeover(station, OLD, NEW, copy_calibration=True)
    assert plan.calibration == {(1, 3): b"channel", (1, 5): b"calibration"}
    every = {(number, code): b"octets" for number in (0, 1, 2, 3) for code in (1, 3, 4, 5, 12, 16, 128)}
    del every[3, 5], every[2, 3]
    station.datasheets.keep_datasheet(Image(OLD, every))
    plan = plan_takeover(station, OLD, NEW, copy_calibration=True)
    assert sorted(plan.calibration) == [(1, 3), (1, 5), (2, 5)], "of every channel, and nothing of another kind"


@pytest.mark.parametrize(("count", "more"), [(1, "rad. Nothing"), (2, r"rad \(and 1 more\). Nothing")])
def test_a_spare_of_another_type_is_refused_by_its_last_reading(
    station: Station, monkeypatch: pytest.MonkeyPatch, count: int, more: str
) -> None:
    station.pins.put(WhitelistEntry(NEW))
    station.nodes.put(NodeRecord(OLD, NODE.point))
    monkeypatch.setattr(
        life, "differences", lambda *_: ("Channel 1 is in N, not in rad.", "Channel 2 is no sensor.")[:count]
    )
    plan_takeover(station, OLD, NEW, copy_calibration=False)
    station.datasheets.keep_datasheet(Image(OLD, {(1, 3): b"channel"}))
    plan_takeover(station, OLD, NEW, copy_calibration=False)
    station.datasheets.keep_datasheet(Image(NEW, {(1, 3): b"channel"}))
    with pytest.raises(WrongBoardError, match=f"Channel 1 is in N, not in {more} was changed"):
        plan_takeover(station, OLD, NEW, copy_calibration=False)


def test_a_ban_in_a_plant_is_judged_by_its_pages_which_may_have_lifted_it(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    judged: list[list[bytes]] = []
    monkeypatch.setattr(type(station.plant.claims), "queue", lambda _claims, uuids: judged.append(list(uuids)))
    statement = seal_revocation(SoftwareKey(42), uuid=OLD, node=None, why="lost", created=JANUARY)
    station.plant.put_record(PlantRecord("11111111-2222-4333-8444-555555555555"))
    for _ in range(2):
        deny(station, statement, key=PIN)
    assert judged == [[OLD]], "the first ban stays"
