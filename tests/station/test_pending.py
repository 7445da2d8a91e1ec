"""A node has eight pending keys at most, the newest of them."""

from __future__ import annotations

from pathlib import Path

from teds_provision.station.node_keys import MAX_PENDING
from teds_provision.station.station import initialise
from teds_provision.vault import passphrase
from teds_provision.vault.selection import forget_vaults

NODE = bytes(range(10))


def test_the_ninth_pending_key_takes_the_place_of_the_oldest(tmp_path: Path) -> None:
    forget_vaults()
    station, _ = initialise(
        tmp_path, name="n", keystore="file", ask=lambda p, c: "correct horse battery", costs=passphrase.THROWAWAY
    )
    try:
        station.keys.add_pending(NODE, key=bytes(16), key_id=bytes(8), epoch=1)
        station.keys.promote(NODE, bytes(8).hex())
        for number in range(1, 30):
            station.keys.add_pending(NODE, key=bytes(16), key_id=bytes([number] * 8), epoch=2)
        kept = station.keys.keys_of(NODE)
        assert [record.key_id for record in kept if record.state == "pending"] == [
            bytes([number] * 8).hex() for number in range(29, 29 - MAX_PENDING, -1)
        ]
        assert kept[-1].state == "active"  # the proven key is never among those that go
        assert [held.record.key_id for held in station.keys.unwrapped(NODE)] == [record.key_id for record in kept]
    finally:
        station.close()
        forget_vaults()
