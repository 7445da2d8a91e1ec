"""A new master key: every link key in the store is wrapped anew, and the old master key is forgotten.

Each part is durable before the next begins, so a run that was cut is carried on by the next one: the new master key,
a note in the store that says which one it is, the keys (one transaction), the old master keys, the end of the note.
At no moment is there a key in the store that the vault does not open: another process that opened the vault before
sees by the note that it has to open it again (:class:`.node_keys.NodeKeys`).
"""

from __future__ import annotations

from dataclasses import dataclass

from teds_provision.errors import VaultFailure
from teds_provision.station.station import Station
from teds_provision.store import KeyRecord
from teds_provision.vault.base import node_key_context


@dataclass(frozen=True)
class Rewrapped:
    """How many keys are wrapped under the new master key, and how many no master key opened (they stay as they are)."""

    keys: int
    damaged: int


def rewrap(station: Station) -> Rewrapped:
    """Wrap every link key under a new master key; the caller holds the StoreLock and has unlocked the vault.

    Raises VaultFailure and its leaves, StoreFailure; the same command carries on.
    """
    vault, identity = station.vault, station.identity
    vault.refresh()
    if identity.rewrapping != vault.masters()[-1]:
        if vault.masters()[-1] <= identity.master:  # else a run was cut before it noted the one that it had made
            vault.add_master()
        identity.begin_rewrapping(vault.masters()[-1])
    damaged = 0

    def anew(record: KeyRecord) -> bytes:
        nonlocal damaged
        context = node_key_context(station.id, record.uuid, record.epoch, record.slot)
        try:
            key = vault.unwrap(record.wrapped, context=context)
        except VaultFailure:  # lost before this run: no reason to keep an old master key for the others
            damaged += 1
            return record.wrapped
        return vault.wrap(key, context=context)

    count = station.keys.wrap_anew(anew)
    station.seals.rewrap(vault)
    vault.retire_masters()
    with station.transaction():
        identity.end_rewrapping()
        station.audit("vault", None, "rewrapped", keys=count - damaged, damaged=damaged)
    return Rewrapped(count - damaged, damaged)
