"""What comes back of a copy, row by row, if it is older, newer, or went another way (when-something-went-wrong.md)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from teds_provision.backup.merge import Merge
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.event import hash_of_statement
from teds_provision.station.plant.line import JobRow
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.snapshot import Relation
from teds_provision.station.station import Station
from teds_provision.station.store.records import (
    COMMAND,
    Draft,
    Group,
    Handover,
    Holder,
    KeptMeasurement,
    KeyFlags,
    KeyRecord,
    NodeRecord,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)
from teds_provision.teds.image import Image
from tests.backup.test_backup_rows import Octets
from tests.bench import copied_station

A, B = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("8d4d9da65281f7000002")
POINT, POINT2 = SoftwareKey(121).point, SoftwareKey(122).point
KEY, KEY2 = fingerprint(POINT), fingerprint(POINT2)
AT, LATER = "2026-10-01T08:00:00Z", "2026-10-02T08:00:00Z"
OLDER, SAME, NEWER, OTHER = Relation.OLDER, Relation.SAME, Relation.NEWER, Relation.DIVERGED


class Two:
    """A store, and a copy of it from before anything was done to either."""

    def __init__(self, live: Station) -> None:
        self.live, self.copy = live, Station.of_backup(Octets(b"".join(live.rows())))

    def merged(self, how: Relation) -> Merge:
        done = Merge(self.live, self.copy, how)
        done.run()
        done.back = +done.back
        done.kept = +done.kept
        return done


@pytest.fixture
def two(tmp_path: Path) -> Iterator[Two]:
    with copied_station(tmp_path / "home") as live:
        made = Two(live)
        yield made
        made.copy.close()


def key(uuid: bytes, epoch: int, state: str = "active", slot: int = 1) -> KeyRecord:
    return KeyRecord(uuid, epoch, f"{epoch:016x}", state, slot, b"wrapped", "agreement", AT)  # type: ignore[arg-type]


Put = Callable[[Station], object]
HANDOVER = Handover("h1", "out", "move", (KEY,), "open", "{}", created=AT)


@pytest.mark.parametrize(
    ("what", "put", "comes_back_from"),
    [
        ("revocations", lambda s: s.policy.deny(RevocationRecord(A, None, "lost", "s", AT)), {OLDER, NEWER, OTHER}),
        ("handovers", lambda s: s.handovers.put(HANDOVER), {OLDER, NEWER, OTHER}),
        ("tombstones", lambda s: s.policy.put_tombstone(Tombstone(A, KEY, "h", AT)), {NEWER, OTHER}),
        ("holders", lambda s: s.keys.put_holder(Holder(A, KEY, AT)), {NEWER, OTHER}),
        ("nodes", lambda s: s.nodes.restore(NodeRecord(A, POINT, epoch=3)), {OLDER, NEWER, OTHER}),
        ("groups", lambda s: s.groups.put(Group("hand", (A,), AT)), {NEWER, OTHER}),
        ("whitelist", lambda s: s.pins.restore([WhitelistEntry(A, KEY, AT)]), {OLDER, NEWER, OTHER}),
        ("keys", lambda s: s.keys.add(key(A, 3)), {OLDER, NEWER, OTHER}),
        ("trust in ca north", lambda s: s.policy.restore_trust(TrustRecord("north", "ca", POINT, KEY, AT)),
         {OLDER, NEWER, OTHER}),
        ("CAs whose trust has ended", lambda s: s.policy.restore_ended_ca(KEY, b"m" * 16), {NEWER, OTHER}),
        ("bans lifted", lambda s: s.policy.restore_lifted(KEY, b"m" * 16), {NEWER}),
        ("certificates", lambda s: s.identity.put_certificate(KEY, KEY2, bytes(64)), {OLDER, NEWER, OTHER}),
        ("marks", lambda s: s.keys.put_flags({A: KeyFlags(rotation="why")}), {OLDER, NEWER, OTHER}),
    ],
)  # fmt: skip
def test_what_the_copy_alone_has(two: Two, what: str, put: Put, comes_back_from: set[Relation]) -> None:
    put(two.copy)
    whole = b"".join(two.live.rows())
    for how in (OLDER, SAME, NEWER, OTHER):
        with Station.of_backup(Octets(whole)) as live:
            done = Merge(live, two.copy, how)
            done.run()
            comes = (OLDER if how is SAME else how) in comes_back_from
            assert dict(+done.back) == ({what: 1} if comes else {}), how
            assert dict(+done.kept) == {}
            assert (b"".join(live.rows()) != whole) is comes

    put(two.live)
    for how in (OLDER, SAME, NEWER, OTHER):
        done = two.merged(how)
        assert (dict(done.back), dict(done.kept)) == ({}, {}), "both have the same"


def put_a_row_of_each_kind(station: Station, uuid: bytes) -> None:
    point = {A: POINT, B: POINT2}[uuid]
    digits, gone = fingerprint(point), b"\1" + uuid[1:]  # a node that is banned and given away has nothing else
    station.policy.deny(RevocationRecord(gone, None, "lost", f"s.{digits}", AT))
    station.policy.put_tombstone(Tombstone(gone, KEY, "h", AT))
    station.handovers.put(replace(HANDOVER, id=uuid.hex()))
    station.keys.put_holder(Holder(uuid, KEY, AT))
    station.nodes.restore(NodeRecord(uuid, point, epoch=2))
    station.groups.put(Group(f"group {digits}", (uuid,), AT))
    station.pins.restore([WhitelistEntry(uuid, digits, AT)])
    station.keys.add(key(uuid, 3))
    station.policy.restore_trust(TrustRecord(f"ca {digits[:4]}", "ca", point, digits, AT))
    station.policy.restore_ended_ca(f"{uuid.hex():0>64}", b"m" * 16)
    station.policy.restore_lifted(f"{uuid.hex():0>64}", b"m" * 16)
    station.identity.put_certificate(digits, KEY2, bytes(64))
    station.keys.put_flags({uuid: KeyFlags(rotation="why")})
    station.measurements.rename(uuid, 0, f"name {digits[:4]}")
    station.measurements.set_frame(uuid, 0, f"frame {digits[:4]}")


@pytest.mark.parametrize("known", [A, B, None], ids=["the first", "the second", "none"])
def test_a_row_that_is_missing_here_comes_back_beside_one_that_is_known(two: Two, known: bytes | None) -> None:
    if known is not None:
        put_a_row_of_each_kind(two.live, known)
    for uuid in (A, B):
        put_a_row_of_each_kind(two.copy, uuid)
    done = two.merged(NEWER)
    missing = [fingerprint(point)[:4] for uuid, point in ((A, POINT), (B, POINT2)) if uuid != known]
    kinds = (
        "revocations", "tombstones", "handovers", "holders", "nodes", "groups", "whitelist", "keys",
        "CAs whose trust has ended", "bans lifted", "certificates", "marks", "names", "frames",
    )  # fmt: skip
    trust = {f"trust in ca ca {digits}": 1 for digits in missing}
    assert dict(done.back) == dict.fromkeys(kinds, len(missing)) | trust
    assert dict(done.kept) == {}


NODE = NodeRecord(A, POINT, "old", epoch=3, sequence=5)


@pytest.mark.parametrize(
    ("here", "there", "newer", "other", "kept"),
    [
        (NODE, replace(NODE, name="new"), replace(NODE, name="new"), NODE, {}),
        (NODE, replace(NODE, epoch=4), replace(NODE, epoch=4), replace(NODE, epoch=4), {}),
        (NODE, replace(NODE, sequence=9), replace(NODE, sequence=9), replace(NODE, sequence=9), {}),
        (NODE, replace(NODE, epoch=2, name="new"), replace(NODE, name="new"), NODE, {"epoch": 1}),
        (NODE, replace(NODE, sequence=4, epoch=4), replace(NODE, epoch=4), replace(NODE, epoch=4), {"epoch": 1}),
        (NODE, replace(NODE, point=POINT2, name="new", epoch=4), replace(NODE, epoch=4), replace(NODE, epoch=4),
         {"pinned": 1}),
        (replace(NODE, point=None), NODE, NODE, replace(NODE, point=None), {}),
        (NODE, replace(NODE, point=None, name="new"), replace(NODE, name="new"), NODE, {}),
        (NODE, NODE, NODE, NODE, {}),
    ],
)  # fmt: skip
def test_a_node_that_both_have(
    two: Two, here: NodeRecord, there: NodeRecord, newer: NodeRecord, other: NodeRecord, kept: dict[str, int]
) -> None:
    two.copy.nodes.restore(there)
    for how, due in ((OTHER, other), (OLDER, other), (NEWER, newer)):
        two.live._store.execute("DELETE FROM nodes")
        two.live.nodes.restore(here)
        done = two.merged(how)
        assert two.live.nodes.get(A) == due, how
        assert done.back["nodes"] == (due != here)
        words = {"epoch": "nodes whose epoch or sequence is higher now", "pinned": "nodes pinned to another key now"}
        assert dict(done.kept) == {words[name]: count for name, count in kept.items()}


@pytest.mark.parametrize(
    ("here", "shown", "there", "revoked", "how", "back", "kept"),
    [
        (None, None, KEY, False, OLDER, 1, ""),
        (None, None, KEY, True, NEWER, 0, "revoked nodes off the whitelist"),
        (KEY, None, KEY, True, NEWER, 0, ""),
        (KEY2, None, KEY, False, NEWER, 0, "whitelist entries pinned to another key now"),
        (None, POINT2, KEY, False, OLDER, 0, "whitelist entries pinned to another key now"),
        (None, POINT, KEY, False, OLDER, 1, ""),
        (None, POINT2, None, False, OLDER, 1, ""),
        (KEY2, None, None, False, NEWER, 1, ""),
        (KEY2, None, None, False, OTHER, 0, ""),
        (None, None, KEY, False, OTHER, 1, ""),
    ],
)
def test_an_entry_of_the_whitelist(
    two: Two, here: str | None, shown: bytes | None, there: str | None, revoked: bool, how: Relation, back: int,
    kept: str,
) -> None:  # fmt: skip
    if here is not None:
        two.live.pins.restore([WhitelistEntry(A, here, AT)])
    if shown is not None:
        two.live.nodes.restore(NodeRecord(A, shown))
    if revoked:
        two.live.policy.deny(RevocationRecord(A, None, "lost", "s", AT))
    two.copy.pins.restore([WhitelistEntry(A, there, AT)])
    done = two.merged(how)
    expected = {kept: 1} if kept else {}
    expected |= {"revocations made since": 1} if revoked else {}
    assert (done.back["whitelist"], dict(done.kept)) == (back, expected)


@pytest.mark.parametrize(
    ("here", "node_epoch", "barred", "there", "found", "kept"),
    [
        ([], 0, "", [3], [(3, "active", "agreement")], ""),
        ([], 4, "", [5], [(5, "active", "agreement")], ""),
        ([], 5, "", [5], [], "older keys left out"),  # the node was at that epoch: its key was given up since
        ([3], 0, "", [4], [(4, "pending", "import"), (3, "active", "agreement")], ""),
        ([3], 0, "", [3], [(3, "active", "agreement")], ""),
        ([3], 0, "", [2], [(3, "active", "agreement")], "older keys left out"),
        ([], 0, "revoked", [3], [], "keys of revoked or moved nodes left out"),
        ([], 0, "moved", [3], [], "keys of revoked or moved nodes left out"),
    ],
)
@pytest.mark.parametrize("how", [OLDER, NEWER, OTHER])
def test_a_key_comes_back_if_it_is_newer_than_all_that_is_known_here(
    two: Two, how: Relation, here: list[int], node_epoch: int, barred: str, there: list[int],
    found: list[tuple[int, str, str]], kept: str,
) -> None:  # fmt: skip
    if node_epoch:
        two.live.nodes.restore(NodeRecord(A, POINT, epoch=node_epoch))
    for epoch in here:
        two.live.keys.add(key(A, epoch))
    for epoch in there:
        two.copy.keys.add(key(A, epoch, slot=2))
    if barred == "revoked":
        two.live.policy.deny(RevocationRecord(A, None, "lost", "s", AT))
    if barred == "moved":
        two.live.policy.put_tombstone(Tombstone(A, KEY, "h", AT))
    done = two.merged(how)
    assert [(held.epoch, held.state, held.source) for held in two.live.keys.keys_of(A)] == found
    assert done.kept[kept or "nothing"] == bool(kept)


@pytest.mark.parametrize(
    ("put", "change", "read"),
    [
        (lambda s: s.handovers.put(HANDOVER), lambda s: s.handovers.put(replace(HANDOVER, state="closed")),
         lambda s: s.handovers.all()[0].state == "closed"),
        (lambda s: s.groups.put(Group("hand", (A,), AT)), lambda s: s.groups.put(Group("hand", (B,), AT)),
         lambda s: s.groups.get("hand").uuids == (B,)),
        (lambda s: s.keys.put_flags({A: KeyFlags(rotation="a")}),
         lambda s: s.keys.put_flags({A: KeyFlags(rotation="b")}),
         lambda s: s.keys.rotation_due(A) == "b"),
        (lambda s: s.datasheets.keep_draft(Draft(A, Image(A), created=AT)),
         lambda s: s.datasheets.keep_draft(Draft(A, Image(A), "signed", created=AT)),
         lambda s: s.datasheets.draft(A).stage == "signed"),
        (lambda s: s.datasheets.put(Image(A, {(0, 1): b"a"})), lambda s: s.datasheets.put(Image(A, {(0, 1): b"b"})),
         lambda s: [row.image.blocks[0, 1] for row in s.datasheets.whole_history(A)] == [b"b"]),
        (lambda s: s.pins.restore([WhitelistEntry(A, KEY, AT)]),
         lambda s: s.pins.restore([WhitelistEntry(A, KEY, AT, "tap")]), lambda s: s.pins.row(A).assurance == "tap"),
    ],
)  # fmt: skip
def test_a_row_that_both_have_is_replaced_by_that_of_a_newer_copy_alone(
    two: Two, put: Put, change: Put, read: Put
) -> None:
    two.copy.nodes.restore(NodeRecord(A))
    put(two.live)
    change(two.copy)
    for how in (OLDER, SAME, OTHER):
        two.merged(how)
        assert not read(two.live), how
    two.merged(NEWER)
    assert read(two.live)


def test_a_datasheet_that_is_missing_here_comes_back_and_a_draft_unless_the_copy_is_older(two: Two) -> None:
    for store in (two.live, two.copy):
        store.nodes.restore(NODE)
    two.copy.datasheets.put(Image(A, {(0, 1): b"a"}))
    two.copy.datasheets.keep_draft(Draft(A, Image(A), created=AT))
    for how, back in (
        (OLDER, {"datasheets": 1}),
        (SAME, {}),
        (OTHER, {"drafts": 1}),
        (NEWER, {}),
    ):
        assert dict(two.merged(how).back) == back, how
    assert [row.image.blocks for row in two.live.datasheets.whole_history(A)] == [{(0, 1): b"a"}]
    assert two.live.datasheets.drop_draft(A)
    assert two.merged(NEWER).back["drafts"] == 1
    for octets in (b"b", b"c"):
        two.copy.datasheets.put(Image(A, {(0, 1): octets}))
    assert dict(two.merged(OTHER).back) == {}
    assert dict(two.merged(NEWER).back) == {"datasheets": 1}
    history = two.live.datasheets.whole_history(A)
    assert history == two.copy.datasheets.whole_history(A)
    assert [row.image.blocks[0, 1] for row in history] == [b"c", b"b", b"a"], "newest first"


def test_a_flag_of_an_older_copy_comes_with_a_key_that_is_missing_here_alone(two: Two) -> None:
    two.live.keys.add(key(A, 3))
    two.copy.keys.put_flags({A: KeyFlags(rotation="settled since"), B: KeyFlags(rotation="why")})
    assert two.merged(OLDER).back["marks"] == 1
    assert [two.live.keys.rotation_due(uuid) for uuid in (A, B)] == [None, "why"]
    two.merged(OTHER)
    assert two.live.keys.rotation_due(A) == "settled since"


def test_a_key_is_trusted_under_the_name_that_it_has_here(two: Two) -> None:
    two.live.policy.restore_trust(TrustRecord("north", "station", POINT, KEY, AT))
    two.copy.policy.restore_trust(TrustRecord("nord", "station", POINT, KEY, AT))
    two.copy.policy.restore_trust(TrustRecord("north", "ca", POINT2, KEY2, AT))
    two.copy.policy.restore_trust(TrustRecord("west", "ca", POINT, KEY, AT))
    done = two.merged(NEWER)
    assert {(record.name, record.role) for record in two.live.policy.trust_rows()} == {
        ("north", "station"), ("west", "ca")
    }  # fmt: skip
    assert dict(done.kept) == {"the name 'north' for the key trusted under it now": 1}
    again = Merge(two.live, two.copy, OTHER)
    again.kept["nothing of this"] = 0
    assert again.kept_sentences() == []
    assert done.kept_sentences() == ["the name 'north' for the key trusted under it now: 1"]


TRUSTED = TrustRecord("north", "ca", POINT, KEY, AT)


@pytest.mark.parametrize("how", [OLDER, OTHER])
def test_what_a_person_ended_here_stays_ended(two: Two, how: Relation) -> None:
    ban = RevocationRecord(B, None, "lost", "a.b.c", AT)
    two.copy.policy.deny(ban)
    two.live.audit("trust", None, "removed", name="north", role="ca", key=KEY)
    two.live.audit("decommission", A, "replaced by another")
    ended = {entry.act: entry.at for entry in two.live.audit_log.entries()}
    two.copy.policy.restore_trust(replace(TRUSTED, added=ended["trust"]))
    two.copy.pins.restore([WhitelistEntry(A, KEY, ended["decommission"])])  # of the same second
    for before, after in ((b"\0", "a"), (b"\xff", "z")):  # what stays out ends nothing
        two.copy.policy.deny(RevocationRecord(before * 10, None, "lost", f"{after}.other.c", AT))
        point = SoftwareKey(123 + before[0]).point
        two.copy.policy.restore_trust(TrustRecord(after, "ca", point, fingerprint(point), AT))
    two.live.policy.restore_lifted(hash_of_statement(ban.statement), b"m" * 16)
    done = two.merged(how)
    assert dict(done.back) == {"revocations": 2, "trust in ca a": 1, "trust in ca z": 1}
    assert dict(done.kept) == {
        "keys no longer trusted since": 1, "bans lifted since": 1, "nodes taken out of service since": 1,
    }  # fmt: skip


def test_what_was_given_again_after_its_end_comes_back(two: Two) -> None:
    again = "2999-01-01T00:00:00Z"
    two.live.audit("trust", None, "removed", name="north", role="ca", key=KEY)
    two.live.audit("decommission", A, "decommissioned")
    two.live.audit("decommission", B, "no-node")
    two.copy.policy.restore_trust(replace(TRUSTED, added=again))
    two.copy.policy.restore_trust(replace(TRUSTED, name="the station", role="station"))
    two.copy.pins.restore([WhitelistEntry(A, KEY, again), WhitelistEntry(B, KEY, AT)])
    back = {"trust in ca north": 1, "trust in station the station": 1, "whitelist": 2}
    assert dict(two.merged(OTHER).back) == back


@pytest.mark.parametrize("how", [OLDER, OTHER, NEWER])
def test_trust_that_was_only_begun_here_is_not_taken_for_ended(two: Two, how: Relation) -> None:
    two.live.audit("trust", None, "trusted", name="north", role="ca", key=KEY)
    two.live.audit("trust", None, "removed", name="north", role="ca", key=KEY2)
    two.copy.policy.restore_trust(TRUSTED)
    assert dict(two.merged(how).back) == {"trust in ca north": 1}


def test_trust_that_a_newer_copy_ended_ends_here(two: Two) -> None:
    two.live.policy.restore_trust(TRUSTED)
    two.merged(NEWER)
    assert [record.name for record in two.live.policy.trust_rows()] == ["north"], "nobody ended it"
    for how, names in ((OTHER, ["north"]), (NEWER, [])):
        two.live.policy.restore_trust(TRUSTED)
        two.live.audit("trust", None, "removed", name="north", role="ca", key=KEY)  # as extend_audit brings it
        two.merged(how)
        assert [record.name for record in two.live.policy.trust_rows()] == names


def test_kept_measurements_come_from_a_copy_that_is_not_older(two: Two) -> None:
    two.copy.groups.put(Group("hand", (A,), AT))
    kept = two.copy.measurements.keep(KeptMeasurement("m1", group="hand"))
    two.copy.measurements.keep(KeptMeasurement("m2", uuids=(B,), owner=COMMAND, pid=1, started=1))
    assert dict(two.merged(OLDER).back) == {}
    assert two.merged(OTHER).back["measurements"] == 1
    assert two.live.measurements.lasting() == [kept]
    changed = two.copy.measurements.keep(replace(kept, owner="page"))
    assert two.merged(OTHER).back["measurements"] == 0
    assert two.merged(NEWER).back["measurements"] == 1
    assert two.live.measurements.lasting() == [changed]
    more = [two.copy.measurements.keep(KeptMeasurement(name, group="hand")) for name in ("m0", "m3")]
    assert two.merged(OTHER).back["measurements"] == 2, "one that is known ends nothing"
    assert sorted(kept.id for kept in two.live.measurements.lasting()) == ["m0", "m1", "m3"]
    assert {kept.id for kept in more} == {"m0", "m3"}


@pytest.mark.parametrize("how", [OTHER, NEWER])
def test_names_and_frames_of_a_node_that_is_measured_stay_as_they_are(two: Two, how: Relation) -> None:
    two.copy.measurements.rename(A, 0, "wrist")
    two.copy.measurements.set_frame(A, 0, "tool0")
    two.copy.measurements.set_frame(B, 1, "tool1")
    two.live.measurements.set_frame(B, 1, "tool1")
    with two.live.measurements.running([A]):
        done = two.merged(how)
        assert dict(done.back) == {}
        assert dict(done.kept) == {"chosen names in use here": 1, "frames of measured nodes": 1}
        for uuid, channel in ((bytes(10), 0), (B, 0)):
            two.copy.measurements.rename(uuid, channel, f"name {uuid.hex()}")
            two.copy.measurements.set_frame(uuid, channel, "elsewhere")
        assert dict(two.merged(how).back) == {"names": 2, "frames": 2}, "those of others come all the same"
    done = two.merged(how)
    assert (dict(done.back), dict(done.kept)) == ({"names": 1, "frames": 1}, {})
    assert two.live.measurements.names[A, 0] == "wrist"
    assert (two.live.measurements.frames[A, 0], two.live.measurements.frames[B, 1]) == ("tool0", "tool1")


def test_a_name_and_a_frame_that_both_have_are_those_of_a_newer_copy_alone(two: Two) -> None:
    for store, word in ((two.live, "here"), (two.copy, "there")):
        store.measurements.rename(A, 0, word)
        store.measurements.set_frame(A, 0, word)
    for how, word in ((OLDER, "here"), (OTHER, "here"), (NEWER, "there")):
        two.merged(how)
        assert two.live.measurements.names == two.live.measurements.frames == {(A, 0): word}


@pytest.mark.parametrize(
    ("hash_", "how", "state"),
    [
        ("0", NEWER, "closed"),
        ("0", OTHER, "open"),
        ("0", OLDER, "open"),
        ("1", NEWER, "open"),  # another job of the same name
    ],
)
def test_a_job_is_closed_by_a_newer_copy_of_the_same_job_alone(two: Two, hash_: str, how: Relation, state: str) -> None:
    two.live.plant.line.add_job(JobRow("job", "0" * 64, b"octets"))
    two.copy.plant.line.add_job(JobRow("job", hash_ * 64, b"octets"))
    two.copy.plant.line.set_job_state("job", "closed")
    assert two.merged(how).back["jobs"] == 0
    assert two.live.plant.line.state_of("job") == (state, False)


def test_a_ban_that_comes_back_is_judged_again_by_the_plant(two: Two) -> None:
    """Other stations may have lifted it since: the next fold of their pages decides."""
    ban = RevocationRecord(A, None, "lost", "a.b.c", AT)
    two.copy.policy.deny(ban)
    two.merged(OLDER)
    assert two.live.plant.claims.to_judge(9) == [], "this station has joined no plant"
    two.copy.policy.deny(replace(ban, uuid=B, statement="d.e.f"))
    two.live.plant.put_record(PlantRecord("6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"))
    two.merged(OLDER)
    assert two.live.plant.claims.to_judge(9) == [B]


def test_facts_of_a_station_come_back_where_init_had_not_reached_them(two: Two) -> None:
    """The keystore is that of this machine; facts that are here stay."""
    facts = two.live.identity.record()
    assert facts is not None
    assert facts.point is not None
    there = replace(facts, name="copy", keystore="keyring", keystore_why="as the backup had it")
    two.copy.identity.put(there)
    begun = replace(facts, point=None, ca=None, signature=None, keystore="file", keystore_why="as requested")
    for here, after, back in (
        (facts, facts, 0),
        (begun, replace(there, keystore="file", keystore_why="as requested"), 1),
        (None, there, 1),
    ):
        two.live._store.execute("DELETE FROM station")
        if here is not None:
            two.live.identity.put(here)
        two.live.identity._seen = None
        assert two.merged(OTHER).back["station"] == back
        kept = two.live.identity.record()
        assert kept is not None
        assert replace(kept, mac=None) == replace(after, mac=None)


def test_events_for_the_plant_that_wait_come_once_from_a_copy_that_is_not_older(two: Two) -> None:
    for store in (two.live, two.copy):
        store.plant.put_record(PlantRecord("6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"))
    two.live.plant.record_event("unpinned", A)
    two.copy.plant.record_event("unpinned", B)
    [(_, event, text)] = two.copy.plant.outbox(9)
    assert dict(two.merged(OLDER).back) == {}
    assert dict(two.merged(OTHER).back) == {"events for the plant": 1}
    assert dict(two.merged(NEWER).back) == {}, "once"
    assert [(kept, stated) for _, kept, stated in two.live.plant.outbox(9)][1:] == [(event, text)]


def test_what_happened_since_is_counted(two: Two) -> None:
    for uuid in (A, B):
        two.live.policy.deny(RevocationRecord(uuid, None, "lost", "s", AT))
        two.live.policy.put_tombstone(Tombstone(uuid, KEY, "h", AT))
    two.copy.policy.deny(RevocationRecord(A, None, "another", "t", LATER))
    two.copy.policy.put_tombstone(Tombstone(A, KEY2, "another", LATER))
    for store, since in ((two.live, AT), (two.copy, LATER)):
        store.keys.put_holder(Holder(A, KEY, since))
    done = two.merged(NEWER)
    assert [row.since for row in two.live.keys.holders()] == [AT]
    tombstone = two.live.policy.tombstone(A)
    assert tombstone is not None
    assert tombstone.handover_id == "h"
    assert {"holders", "tombstones", "revocations"}.isdisjoint(done.back)
    assert dict(done.kept) == {"revocations made since": 1, "nodes moved away since": 1}
    kept = two.live.policy.revocation(A)
    assert kept is not None
    assert kept.why == "lost", "a ban that is here stays as it is"
