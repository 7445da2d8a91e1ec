"""``backup``: the whole store of this station, with what its vault keeps secret, sealed into one file."""

from __future__ import annotations

import hashlib
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from teds_provision.backup.sealed_file import Content, seal_to_key, seal_to_passphrase
from teds_provision.errors import StoreFailure, VaultFailure
from teds_provision.files import write_whole
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.station import Station
from teds_provision.store import utc_now
from teds_provision.store.snapshot import load, take
from teds_provision.store.store import Store
from teds_provision.vault import Ask, node_key_context
from teds_provision.vault.passphrase import PRODUCT, Costs


@dataclass(frozen=True)
class BackedUp:
    """What was written: size and digest of the file, how much stands in it, and what to know of it."""

    octets: int
    sha256: str
    nodes: int
    keys: int
    sealed_to: str
    warnings: tuple[str, ...]


def backup(
    station: Station, path: Path, ask: Ask, *, recovery: bytes | None = None, costs: Costs = PRODUCT
) -> BackedUp:
    """Write a sealed copy of the station to ``path`` (mode 0600, whole or not at all; an old file is replaced).

    ``recovery`` is the point of a recovery key, else ``ask`` gives a new passphrase. The store may be in use meanwhile.
    Raises StoreFailure, VaultFailure and its leaves.
    """
    vault = station.vault
    database = take(station._store)
    content = Content(
        store=station.id,
        point=station.point,
        name=station.name,
        created=utc_now(),
        keystore=station.identity.keystore,
        material=vault.secret_material(),
        database=database,
    )
    with load(database) as copy:
        nodes, keys, useless = _count(station, copy)
    if recovery is not None:
        sealed, to = seal_to_key(content, vault.identity(), recovery), fingerprint(recovery)
    else:
        sealed = seal_to_passphrase(content, vault.identity(), ask("New passphrase for the backup", True), costs)
        to = "passphrase"
    write_whole(path, sealed, failure=VaultFailure)
    digest = hashlib.sha256(sealed).hexdigest()
    warnings = _warnings(station, recovery, useless)
    with suppress(StoreFailure):  # a full disk is a reason for a backup, and must not make it fail
        station.audit("backup", None, "done", sha256=digest, to=to, nodes=nodes, keys=keys)
    return BackedUp(len(sealed), digest, nodes, keys, to, tuple(warnings))


def _count(station: Station, copy: Store) -> tuple[int, int, int]:
    """Count nodes, keys, and the keys that the vault does not open: those are lost already."""
    keys = useless = 0
    for record in copy.all_keys():
        keys += 1
        try:
            context = node_key_context(copy.id, record.uuid, record.epoch, record.slot)
            station.vault.unwrap(record.wrapped, context=context)
        except VaultFailure:
            useless += 1
    return len(copy.nodes()), keys, useless


def _warnings(station: Station, recovery: bytes | None, useless: int) -> list[str]:
    warnings = []
    if station.identity.keystore.startswith("pkcs11:"):
        warnings.append(
            "The station key (and a CA key in the token) cannot leave the token and is not in this backup: "
            "it opens with the same token only."
        )
    if recovery is not None and recovery in (station.point, station.ca):
        warnings.append("It is sealed to a key of this station: if the station is lost, nobody can open it.")
    if useless:
        warnings.append(f"{useless} keys in the store do not open under this vault; run teds-provision doctor.")
    return warnings
