"""A station that joins another registry forgets the first one, whole."""

from __future__ import annotations

from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.station import Station
from teds_provision.station.store.store import Store

STATION, HASH = "a" * 64, "b" * 64
ROWS = {
    "plant": f"INSERT INTO plant(one, registry, joined) VALUES(1, '{'r' * 36}', 'now')",
    "rosters": f"INSERT INTO rosters VALUES(1, '{HASH}', x'00', 1, 'now', NULL)",
    "alarms": "INSERT INTO alarms VALUES('fork', '', 1, 'why', 'now', 0)",
    "outbox": f"INSERT INTO outbox(id, event) VALUES('{'e' * 16}', '{{}}')",
    "chains": f"INSERT INTO chains(chain, station) VALUES(1, '{STATION}')",
    "pages": f"INSERT INTO pages VALUES(1, 1, '{HASH}', '', 'now', '', x'00', x'00', zeroblob(64), 'now')",
    "heads": f"INSERT INTO heads VALUES(1, '{STATION}', 1, '{HASH}')",
    "event_ids": "INSERT INTO event_ids VALUES(1, 1)",
    "claims": "INSERT INTO claims VALUES(zeroblob(10), 1, '{}')",
    "digests": "INSERT INTO digests VALUES(zeroblob(32), 1, 1, 0, NULL)",
    "statements": f"INSERT INTO statements VALUES('{HASH}', 1, 0, 1, NULL, '{{}}', NULL)",
    "conflicts": "INSERT INTO conflicts VALUES(zeroblob(10), 'two', '')",
    "to_judge": "INSERT INTO to_judge VALUES(zeroblob(10))",
    "parcels": f"INSERT INTO parcels VALUES('p', 'out', '{STATION}', 'copy', 'sent', '', '', '', 'now', x'00')",
    "shared": "INSERT INTO shared VALUES(zeroblob(10), 1, 'x', 'p', 'sent')",
}
"""A row in each table of a registry, in an order in which each refers to one that is there."""


def test_everything_of_a_registry_goes(station: Station, store: Store) -> None:
    with store.together():
        for statement in ROWS.values():
            store.execute(statement)
    station.plant.forget()
    left = {table: store.first_row(f"SELECT count(*) FROM {table}") for table in ROWS}
    assert {table for table, row in left.items() if row is None or row[0]} == set()


def test_an_alarm_that_nobody_has_seen_keeps_its_time_when_it_happens_again(station: Station) -> None:
    alarms, times = station.plant.alarms, ("2026-10-01T08:00:00Z", "2026-10-02T08:00:00Z", "2026-10-03T08:00:00Z")
    first, again, later = (Alarm("junk", "ab" * 32, 3, "why", at) for at in times)
    assert alarms.put(first, again=True)
    assert not alarms.put(again, again=True), "it is reported to the plant once"
    assert alarms.all() == [first]
    assert alarms.see() == 1
    assert alarms.put(later, again=True)
    assert alarms.all() == [later]
