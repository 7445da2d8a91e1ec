"""Which key a UUID has to show, and what is recorded of those who show another."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path

import pytest

from teds_provision.errors import KeyMismatchError, StoreChangedError
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.station import pins
from teds_provision.station.store.records import Draft, NodeRecord, WhitelistEntry
from teds_provision.teds.image import Image
from tests.bench import make_station

UUID = bytes.fromhex("8d4d9da65281f7000000")


def test_a_flood_of_wrong_keys_does_not_fill_the_audit_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nobody needs a key to show a wrong one on a bus, and the service looks at whoever announces itself."""
    now = [0.0]
    monkeypatch.setattr(pins.time, "monotonic", lambda: now[0])
    with closing(make_station(tmp_path / "home")) as station:
        pinned = fingerprint(SoftwareKey.generate().point)
        station.pins.put(WhitelistEntry(UUID, pinned))
        for at in (0.0, 1.0, 599.0, 600.0, 601.0, 1200.0):
            now[0] = at
            with pytest.raises(KeyMismatchError):
                station.pins.check(UUID, SoftwareKey.generate().point)
        entries = [entry.detail for entry in station.audit_log.entries() if entry.outcome == "other key"]
    assert [entry.get("unrecorded", 0) for entry in entries] == [0, 2, 1]


def test_the_draft_of_a_board_that_was_replaced_goes_with_its_pin(tmp_path: Path) -> None:
    """It may hold the old board's calibration; what was built before any board was met is for whichever comes."""
    with closing(make_station(tmp_path / "home")) as station:
        for fingerprint_of_it, stays in ((fingerprint(SoftwareKey.generate().point), False), (None, True)):
            station.pins.put(WhitelistEntry(UUID, fingerprint_of_it))
            station.datasheets.keep_draft(Draft(UUID, Image(UUID, {(0, 1): b"x"})))
            station.pins.unpin(UUID)
            assert (station.datasheets.draft(UUID) is not None) is stays
            assert station.pins.is_unsettled(UUID) is not stays
            station.pins.settled(UUID)


def test_a_node_that_showed_another_key_than_its_pin_is_found_among_many(tmp_path: Path) -> None:
    with closing(make_station(tmp_path / "home")) as station:
        point, other = SoftwareKey.generate().point, fingerprint(SoftwareKey.generate().point)
        shown = fingerprint(point)
        pinned = {1: shown, 2: shown[:32], 3: None, 4: other, 5: other[:32]}
        for number in range(7):
            uuid = number.to_bytes(10, "big")
            station.nodes.put(NodeRecord(uuid, point if number < 6 else None))
            if number in pinned:
                station.pins.put(WhitelistEntry(uuid, pinned[number]))
        nodes = list(station.nodes.all())
        assert {uuid[-1] for uuid in station.pins.pinned_elsewhere(nodes)} == {4, 5}
        station._store.execute("UPDATE whitelist SET fingerprint = ? WHERE uuid = ?", (shown, nodes[4].uuid))
        with pytest.raises(StoreChangedError, match=nodes[4].uuid.hex()):
            station.pins.pinned_elsewhere(nodes)
