"""Which board the link keys of a UUID belong to, once its owner has let the pinned identity key go."""

from __future__ import annotations

from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station


def let_go(station: Station, uuid: bytes) -> None:
    """Note the identity key that is pinned, before it goes: the link keys held belong to the board that has it."""
    entry, node = station.store.whitelisted(uuid), station.store.node(uuid)
    pinned = entry.fingerprint if entry is not None else None
    if pinned is None and node is not None and node.point is not None:
        pinned = fingerprint(node.point)
    if pinned is not None:
        station.store.set_setting(_setting(uuid), pinned)
        station.store.drop_draft(uuid)  # it may hold the old board's calibration


def epoch_to_exceed(station: Station, uuid: bytes, pinned: str | None) -> int:
    """Epoch that an agreement must exceed: that of the active key, but 0 for a board that it was not agreed with."""
    former = station.store.setting(_setting(uuid))
    return 0 if former and pinned and former != pinned else station.active_epoch(uuid)


def settled(station: Station, uuid: bytes) -> None:
    """A session is open: the key in use belongs to the board that lies there."""
    if station.store.setting(_setting(uuid)):
        station.store.set_setting(_setting(uuid), "")


def _setting(uuid: bytes) -> str:
    return f"former-identity:{uuid.hex()}"
