"""The station that these tests back up."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, NodeRecord, TrustRecord, WhitelistEntry
from teds_provision.teds.image import Image
from teds_provision.vault.selection import forget_vaults
from tests.backup.backups import ONE, POINT, TWO, add_key

from ..bench import copied_station


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    """Yield a station with two nodes in use, one of them in the middle of a rotation, and one trusted CA."""
    forget_vaults()
    made = copied_station(tmp_path / "home")
    for uuid in (ONE, TWO):
        made.pins.put(WhitelistEntry(uuid, assurance="tap"))
        made.nodes.put(NodeRecord(uuid, POINT, state=2, epoch=1, sequence=5))
        add_key(made, uuid, 1)
        made.datasheets.keep_datasheet(Image(uuid))
    add_key(made, TWO, 2, active=False)
    made.policy.trust(TrustRecord("owner", "ca", POINT, "ab" * 32))
    made.datasheets.keep_draft(Draft(ONE, Image(ONE)))
    made.audit("test", ONE, "ready")
    yield made
    made.close()
    forget_vaults()
