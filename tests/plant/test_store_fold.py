"""The fold over a store's rows comes to what the pure functions say, in whatever pieces and order pages arrive."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision import plant
from teds_provision.plant.apply_pages import apply_claims, merged_views, put_roster, recount, take_pages
from teds_provision.protocol.plant.page import open_page
from teds_provision.protocol.plant.roster import Roster, open_roster, seal_roster
from teds_provision.station.station import Station
from tests.bench import make_station
from tests.plant.plants import CA, NODES, REGISTRY, Reader, roster_of
from tests.plant.test_merged_claims import DIGEST, DIGEST2, chatter


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = make_station(tmp_path / "home")
    made.unlock()
    yield made
    made.close()


def held(station: Station, roster: Roster, monkeypatch: pytest.MonkeyPatch) -> None:
    """Have a roster of the test's CA count in a station of another one."""
    from teds_provision.station.plant.plant import PlantRecord

    monkeypatch.setattr(type(station.identity), "ca", property(lambda self: CA.point))
    station.plant.put_record(PlantRecord(REGISTRY, mac=station.row_macs.note("plant", REGISTRY)))
    put_roster(station, open_roster(seal_roster(roster, CA), CA.point))


@pytest.mark.parametrize("seed", range(8))
def test_pages_in_any_order_and_a_roster_between_them_give_the_oracles_view(
    station: Station, seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    speakers = chatter(seed)
    gone = speakers[seed % len(speakers)]
    first = roster_of(speakers)
    second = roster_of([speaker for speaker in speakers if speaker is not gone], [(gone, gone.head)], version=2)
    held(station, first, monkeypatch)
    chance = random.Random(seed)
    waiting = [open_page(octets, REGISTRY, first.point_of) for speaker in speakers for octets in speaker.pages]
    half = len(waiting) // 2
    while waiting:  # a page comes when one before it is here, as a sync asks for them
        chance.shuffle(waiting)
        for page in list(waiting):
            names = station.plant.pages.chain_links(station.plant.pages.chain(page.station).id)
            if page.number == 1 or any(n == page.number - 1 for n, _, _ in names):
                roster = station.plant.roster
                assert roster is not None
                take_pages(station, roster, [page])
                waiting.remove(page)
                break
        if len(waiting) == half:
            put_roster(station, second)
        if chance.random() < 0.3:
            apply_claims(station)
    apply_claims(station)
    roster = station.plant.roster
    assert roster is not None
    oracle = Reader(roster, [octets for speaker in speakers for octets in speaker.pages])
    seen = merged_views(station, roster, NODES)
    from teds_provision.protocol.plant.merged_claims import LocalState

    for uuid in NODES:
        due = oracle.view(uuid, LocalState(station.fingerprint))
        assert seen[uuid] == due
        entry = station.pins.entry(uuid)
        assert (entry.fingerprint if entry is not None else None) == (None if due.bans else due.pin)
        assert (station.policy.revocation(uuid) is not None) == bool(due.bans)
        assert {name for _, name, _ in station.plant.claims.conflicts(uuid)} == set(due.conflicts)
    rules = station.policy.signer_rules()
    assert rules is not None
    for speaker in speakers:
        for digest in (DIGEST, DIGEST2):
            found = rules.signing(CA.point, speaker.key.point, bytes.fromhex(digest))
            due_verdict = oracle.signing(speaker.fingerprint, digest)
            assert found is not None
            if due_verdict.why == "a page is missing":  # the oracle does not say whose
                assert "are missing here" in found.why
                found = found._replace(why=due_verdict.why)
            assert found == due_verdict
    for speaker in speakers:  # repeated, it changes nothing
        recount(station, station.plant.pages.chain(speaker.fingerprint), roster)
    assert merged_views(station, roster, NODES) == seen
    assert plant.apply_pages.heads_digest(station)[1] == sum(
        counts.newest[0] > 0 for counts in oracle.counting.values()
    )
