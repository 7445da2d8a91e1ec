"""Pages of one's own: what goes into the next one, what one that came back brings, and what others say of pages."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from teds_provision.plant.sync import acknowledge, own_chain, take_back, unseen_heads, write_page
from teds_provision.protocol.plant import event
from teds_provision.protocol.plant.page import Page, PageDraft, open_page, sign_page
from teds_provision.protocol.plant.roster import RemovedMember, Roster
from teds_provision.station.plant.line import UnitRow
from teds_provision.station.station import Station
from tests.plant.owner import alone
from tests.plant.plants import NOW
from tests.plant.test_contract_states import H, held, others, paged

A, B, C = (bytes.fromhex("8d4d9da65281f7") + number.to_bytes(3, "big") for number in range(3))
JOB = "0b5f6f5e-0f3b-4a55-9d7c-2f1b8a3c4d5e"
AT = "2026-03-01T12:00:00Z"


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    made.unlock()
    yield made
    made.close()


def roster(station: Station) -> Roster:
    now = station.plant.roster
    assert now is not None
    return now


_numbers = iter(range(1, 1000))


def said(act: str, uuid: bytes | None, **members: Any) -> dict[str, Any]:
    return event.made(act, f"{next(_numbers):016x}", AT, uuid, members)


def signed(uuid: bytes, sequence: int, epoch: int = 1, **of_unit: Any) -> dict[str, Any]:
    return said("signed", uuid, epoch=epoch, sequence=sequence, teds_sha256=H, **of_unit)


def evidence(uuid: bytes, unit: int | None, verdict: str = "passed", job: str | None = JOB) -> dict[str, Any]:
    return said("evidence", uuid, sha256=f"{next(_numbers):064x}", job=job, unit=unit, verdict=verdict)


def came_back(station: Station, *events: dict[str, Any]) -> Page:
    """Have one more page under this station's key come back."""
    n, previous = own_chain(station).counted
    draft = PageDraft(roster(station).registry, n + 1, previous, "0" * 16, NOW, {}, (1, "0" * 64))
    octets = sign_page(draft, events, station.vault.identity())
    page = open_page(octets, roster(station).registry, lambda kid: station.point)
    take_back(station, roster(station), [page])
    return page


# -- what came back ----------------------------------------------------------------------------------------------------


def test_epochs_and_sequences_are_known_again_the_greater_ones(station: Station) -> None:
    station.nodes.remember(A, epoch=2, sequence=20)
    written = said("written", A, epoch=5, sequence=21, teds_sha256=H, profile=None, profile_sha256=None, due=None)
    came_back(
        station,
        said("agreed", A, fingerprint=H, epoch=4, key_id="0" * 16),
        signed(A, 19, 3),
        written,
        signed(B, 7),
        signed(B, 6),
        said("agreed", C, fingerprint=H, epoch=4, key_id="0" * 16),
    )
    node = station.nodes.get(A)
    assert node is not None
    assert (node.epoch, node.sequence) == (5, 21)
    unknown = station.nodes.get(B)
    assert unknown is not None
    assert unknown.sequence == 7, "so that none is used twice"
    assert station.nodes.get(C) is None
    came_back(station, signed(A, 30), said("agreed", A, fingerprint=H, epoch=1, key_id="0" * 16))
    node = station.nodes.get(A)
    assert node is not None
    assert (node.epoch, node.sequence) == (5, 30)


def test_a_board_that_this_station_signed_for_is_pinned_again_as_it_was_and_an_entry_stays(station: Station) -> None:
    pins = [said("pinned", uuid, fingerprint=H, assurance="bus") for uuid in (A, B, C)]
    with station.transaction():
        station.plant.record_event("unpinned", C)
    came_back(station, *pins, signed(A, 1), said("unpinned", C), signed(C, 1))
    entry = station.pins.entry(A)
    assert entry is not None
    assert (entry.fingerprint, entry.assurance) == (H, "bus")
    assert [station.pins.entry(uuid) for uuid in (B, C)] == [None, None], "not signed for; not pinned any more"


def test_events_that_are_on_a_page_wait_no_more(station: Station) -> None:
    back, stays = (said("named", A, name=name) for name in ("left", "right"))
    with station.transaction():
        for one in (back, stays):
            station.plant.queue_event(one)
    page = came_back(station, back)
    assert [id for _, id, _ in station.plant.outbox(9)] == [stays["id"]]
    assert own_chain(station).counted == (page.number, page.hash)
    entry = list(station.audit_log.entries())[-1]
    assert (entry.act, entry.outcome, entry.detail) == ("registry", "adopted", {"pages": [page.number]})


def units(station: Station) -> list[tuple[bytes, int, int, int]]:
    return [(row.uuid, row.unit, row.attempts, row.passed) for row in station.plant.line.units(JOB)]


def test_units_are_known_again_with_their_attempts_and_the_first_that_passed(station: Station) -> None:
    came_back(station, evidence(A, 3, "failed: node-silent"))
    assert units(station) == [(A, 3, 1, 0)]
    came_back(station, evidence(A, 3), evidence(A, 3), evidence(B, 4), evidence(C, None), evidence(C, 5, job=None))
    assert units(station) == [(A, 3, 3, 2), (B, 4, 1, 1)]


def test_a_unit_that_another_board_has_by_now_is_reported_and_an_office_counts_one_more(station: Station) -> None:
    notices: list[str] = []
    station.notice = notices.append
    with station.transaction():
        station.plant.line.put_unit(UnitRow(JOB, A, 1, AT))
    came_back(station, evidence(B, 1))
    assert units(station) == [(A, 1, 1, 0)]
    assert notices == [f"Unit 1 of the job {JOB} was assigned twice: also to {B.hex()}, before this home was restored."]
    came_back(station, signed(C, 9, job=JOB, unit=1))
    assert units(station) == [(A, 1, 1, 0), (C, 2, 1, 0)]
    came_back(station, signed(C, 10, job=JOB, unit=1))
    assert units(station) == [(A, 1, 1, 0), (C, 2, 2, 0)]
    assert len(notices) == 2


# -- the next page -----------------------------------------------------------------------------------------------------


def events_of(page: Page | None) -> list[Any]:
    assert page is not None
    return [one["name"] for one in page.events]


def test_a_page_takes_1000_events_in_their_order_and_leaves_the_others_for_the_next(station: Station) -> None:
    with station.transaction():
        for number in range(1001):
            station.plant.record_event("named", A, name=str(number))
    first, second = write_page(station, roster(station)), write_page(station, roster(station))
    assert events_of(first) == [str(number) for number in range(1000)]
    assert events_of(second) == ["1000"]
    assert write_page(station, roster(station)) is None
    assert first is not None
    assert second is not None
    assert (first.number, first.previous, second.number, second.previous) == (1, "", 2, first.hash)
    assert first.home == second.home == station.plant.home


def test_a_page_stays_below_700000_octets_of_whatever_letters(station: Station) -> None:
    why = "€" * 1024
    with station.transaction():
        for _ in range(300):
            station.plant.record_event("refused", A, bundle=JOB, peer=H, why=why)
    pages = [page for _ in range(3) if (page := write_page(station, roster(station))) is not None]
    assert [len(page.events) for page in pages] == [205, 95]
    assert station.plant.unsent() == 0


def test_an_empty_page_is_written_only_if_asked_for_and_none_before_a_rebuilt_home_has_looked(station: Station) -> None:
    assert write_page(station, roster(station)) is None
    page = write_page(station, roster(station), empty=True)
    assert page is not None
    assert (page.number, list(page.events)) == (1, [])
    station.plant.begin_restored()
    with station.transaction():
        station.plant.record_event("named", A, name="left")
    assert write_page(station, roster(station)) is None
    assert write_page(station, roster(station), empty=True) is None
    assert station.plant.unsent() == 1


def test_a_note_of_a_restored_home_counts_only_as_this_station_wrote_it(station: Station) -> None:
    station.unlock()
    assert not station.plant.restored
    station.plant.begin_restored()
    record = station.plant.record()
    assert record is not None
    assert station.plant.restored
    for change in ({"restored": "2020-01-01T00:00:00Z"}, {"restored_mac": bytes(16)}, {"restored_mac": None}):
        station.plant.put_record(replace(record, **cast("Any", change)))
        assert not station.plant.restored
    station.plant.put_record(record)
    station.plant.end_restored()
    assert not station.plant.restored


def test_a_page_names_the_heads_that_changed_since_the_last_one_and_the_audit_log(station: Station) -> None:
    west, south = "b" * 64, "c" * 64

    def heads() -> dict[str, tuple[int, str]]:
        before = station.audit_log.newest()
        page = write_page(station, roster(station), empty=True)
        assert page is not None
        content = next(row.content for row in station.plant.pages.each(own_chain(station).id) if row.n == page.number)
        assert json.loads(content)["audit"] == list(before)
        return dict(page.heads)

    assert heads() == {}
    paged(station, west, 3, AT, "3" * 64)
    station.plant.pages.chain(south)  # nothing of it counts
    assert heads() == {west: (3, "3" * 64)}, "not its own chain"
    assert heads() == {}
    paged(station, west, 4, AT, "4" * 64)
    paged(station, south, 1, AT, "1" * 64)
    assert heads() == {west: (4, "4" * 64), south: (1, "1" * 64)}


# -- what others say of pages ------------------------------------------------------------------------------------------


def test_a_head_that_is_not_here_is_told_with_who_reports_it_and_a_strangers_or_ones_own_is_not(
    station: Station,
) -> None:
    west, south, gone = others(station, west="line", south="base", gone="base")
    removed = RemovedMember("gone", gone.point, gone.roles, "lost", (2, H))
    now = held(station, west, south, removed=(removed,))
    paged(station, west.fingerprint, 3, AT, "3" * 64)

    def told(who: str, about: str, n: int, hash: str = H) -> list[str]:
        with station.transaction():
            station.plant.pages._store.execute("DELETE FROM heads")
            station.plant.pages.put_heads(station.plant.pages.chain(who).id, {about: (n, hash)})
        return list(unseen_heads(station, now).values())

    here = "the last one here is 3"
    differs = "that differs from the one here"
    assert told(south.fingerprint, west.fingerprint, 4) == [f"south saw page 4 of west; {here}"]
    assert told(south.fingerprint, west.fingerprint, 3) == [f"south reports a page 3 of west {differs}"]
    assert told(south.fingerprint, west.fingerprint, 2) == [f"south reports a page 2 of west {differs}"]
    assert told(south.fingerprint, west.fingerprint, 3, "3" * 64) == [], "it is this very one"
    assert told(south.fingerprint, gone.fingerprint, 1) == ["south saw page 1 of gone; the last one here is 0"]
    assert told(gone.fingerprint, west.fingerprint, 4) == [], "it left"
    assert told("f" * 64, west.fingerprint, 4) == []
    assert told(south.fingerprint, "f" * 64, 4) == []
    assert told(station.fingerprint, west.fingerprint, 4) == []
    told(south.fingerprint, west.fingerprint, 4)
    assert acknowledge(station) == (0, 1)
    assert acknowledge(station) == (0, 0)
