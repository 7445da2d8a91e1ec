"""``restore``: rebuild a lost station, or add what an existing one lacks; newer state is never undone.

Into an empty home the backup comes as it is. Into the home of the same station it is merged in one transaction: what is
missing comes back, what is newer stays. Epochs and sequences take the greater of both, keys of the present state are
kept, tombstones and revocations stay, the audit log only grows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from teds_provision.backup.content import Content
from teds_provision.backup.merge import Merge
from teds_provision.errors import (
    NotAuthenticError,
    PolicyError,
    StoreError,
    UsageError,
    VaultChangedError,
    VaultError,
    WrongPassphraseError,
)
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.node_keys import RESTORED
from teds_provision.station.plant.plant import new_home
from teds_provision.station.snapshot import Relation, is_damage, place, relation, set_aside, totals
from teds_provision.station.station import Station
from teds_provision.station.store.lock import StoreLock
from teds_provision.station.store.sqlite import has_store
from teds_provision.vault.base import Ask, Vault
from teds_provision.vault.passphrase import PRODUCT, Costs
from teds_provision.vault.selection import asked_first, create_vault, open_vault


@dataclass(frozen=True)
class RestoreResult:
    """Result of a restore, or of its plan: ``rebuilt``, ``merged`` or ``nothing``; rows restored, and rows kept.

    ``rotations_due`` counts the nodes whose key must be rotated by tap, or by an operator's confirmation, before
    anything else.
    """

    action: str
    relation: Relation | None
    back: dict[str, int]
    kept: tuple[str, ...]
    keystore: str
    set_aside: Path | None = None
    rotations_due: int = 0


class _DryRunRollbackError(Exception):
    """Rolls a transaction back that was tried out."""


def open_present(home: Path, content: Content) -> Station | None:
    """Open the station of ``home`` if it is usable; return None if it is absent or damaged.

    Raises PolicyError if it belongs to another station, StoreError if it cannot be used for another reason.
    """
    if not has_store(home):
        return None
    try:
        station = Station.inspect(home)
    except StoreError as failure:
        if is_damage(failure):
            return None
        raise
    if station.damage() is not None:
        station.close()
        return None
    facts = station.identity.record()
    point = facts.point if facts is not None else None
    if station.id != content.store or (point is not None and point != content.point):
        station.close()
        here = "of an unfinished init" if point is None else f"of station {fingerprint(point)[:32]}"
        raise PolicyError(
            f"The backup is of station {content.station[:32]}; the store in {home} is {here}.",
            hint="Restore into another --home: backups never mix stations.",
        )
    return station


def rebuild(
    home: Path, content: Content, ask: Ask, *, keystore: str | None = None, costs: Costs = PRODUCT
) -> RestoreResult:
    """Make the station of a backup in a home without a usable store; a damaged one is kept under another name.

    ``keystore`` as for init; None selects the kind that the station had, or a passphrase file if the keyring does not
    work. The vault is written first, the store last and in one piece: after a kill in between, the same command carries
    on. Every node with a held key is due for rotation afterwards, by tap or by an operator's confirmation, as its state
    may have changed since the backup. Raises NotAuthenticError, VaultError and its leaves, StoreError.
    """
    copy = content.copy
    _check_inside(copy, content)
    wanted = keystore_for(content, keystore)
    try:
        home.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(f"{home} cannot be made: {error.strerror}.", hint="Choose another --home.") from error

    def make(known: Ask) -> RestoreResult:
        with StoreLock(home, command="restore"):
            # the operator confirmed a restore into an empty home
            if (present := open_present(home, content)) is not None:
                present.close()
                raise VaultChangedError(
                    f"Another command has created the station in {home} in the meantime; this one changed nothing.",
                    hint="Run it again: it restores what is missing.",
                )
            vault, why = bring_vault(home, content, known, wanted, costs)
            kind = wanted if wanted is not None and wanted.startswith("pkcs11:") else vault.kind
            with copy.transaction():
                # The restored store names the keystore of this machine.
                facts = copy.identity.record()
                if facts is not None:
                    copy.identity.put(replace(facts, keystore=kind, keystore_why=why))
                due = _demand_rotations(copy, content)
                # A station of a plant must fetch its own pages before it signs new ones.
                in_plant = copy.plant.record() is not None
                if in_plant:
                    copy.adopt(vault)
                    copy.plant.begin_restored()
                detail = {"created": content.created, "keystore": vault.kind, "rotations_due": due}
                copy.audit("restore", None, "rebuilt", **detail)
            aside = set_aside(home) if has_store(home) else None
            place(copy, home)
            if in_plant:
                new_home(home)
        return RestoreResult("rebuilt", None, totals(copy), (), kind, aside, due)

    return asked_first(ask, make)


def _demand_rotations(copy: Station, content: Content) -> int:
    """Have every node for which a key is held rotate it first, and only when a person has the node in hand."""
    why = f"{RESTORED} of {content.created}: it may have been given away or replaced since"
    keys = copy.keys
    nodes = {record.uuid for record in keys.all()}
    keys.set_flags({uuid: {"rotation": why} for uuid in nodes})
    return len(nodes)


def keystore_for(content: Content, asked: str | None) -> str | None:
    """Return the keystore for a restored station; None means the keyring, or a passphrase file if it does not work.

    The path of a module never comes from a backup: for keys in a token the URI has to be given (UsageError). Raises
    PolicyError if the keys cannot be stored there.
    """
    # Keep the backup's keystore if it works on any machine; None for this machine's default.
    kept = None if content.in_token or content.keystore in ("keyring", "pkcs11") else content.keystore
    wanted = asked or kept
    into_token = wanted is not None and wanted.startswith("pkcs11:")
    if wanted not in (None, "keyring", "file") and not into_token:
        raise UsageError("There is no such keystore.", hint="Give --keystore keyring, file or pkcs11:URI.")
    if content.in_token and asked is None:
        raise UsageError(
            "The station's key is in a token, and a backup does not say by which module it is reached.",
            hint="Add --keystore 'pkcs11:token=LABEL?module-path=/path/of/the/module.so'.",
        )
    if content.in_token and not into_token:
        raise PolicyError(
            "The station's key is in a token and cannot be stored elsewhere.",
            hint="Restore with --keystore pkcs11:URI of that token.",
        )
    if into_token and not content.in_token:
        raise PolicyError(
            "The keys of this backup cannot be put into a token.", hint="Restore with --keystore keyring or file."
        )
    return wanted


def bring_vault(
    home: Path, content: Content, ask: Ask, keystore: str | None, costs: Costs = PRODUCT
) -> tuple[Vault, str]:
    """Make or complete the vault with what the backup holds, and have it show the station's key."""
    vault, why = create_vault(home, content.store, keystore, ask, costs=costs, restored=content.material)
    if vault.identity().point != content.point:
        raise NotAuthenticError("The keys in the backup are not those of the station that signed it.")
    return vault, why


def open_vault_of(station: Station, ask: Ask) -> None:
    """Open the vault of an existing station, before any lock is held; a lost vault is not an error yet.

    Raises WrongPassphraseError, VaultChangedError.
    """
    facts = station.identity.record()
    try:
        open_vault(station.home, station.id, facts.keystore if facts is not None else "keyring", ask)
    except (WrongPassphraseError, VaultChangedError):
        raise
    except VaultError:
        pass


def complete_vault(station: Station, content: Content, ask: Ask, *, keystore: str | None = None) -> Vault:
    """Open the vault of an existing station; recreate it if it is lost, and add missing master keys from the backup.

    A CA key that was removed from the vault since the backup stays removed. Raises VaultError and its leaves.
    """
    facts = station.identity.record()
    wanted = facts.keystore if facts is not None else keystore_for(content, keystore)
    try:
        vault = open_vault(station.home, station.id, wanted or "keyring", ask)
    except (WrongPassphraseError, VaultChangedError):
        raise
    except VaultError:  # lost, or locked: then making it fails as well, with the reason
        return bring_vault(station.home, content, ask, wanted)[0]
    if not any(True for _ in content.unopened(vault)):
        return vault
    had_ca = vault.ca() is not None
    vault, _ = bring_vault(station.home, content, ask, wanted)
    if not had_ca:
        vault.drop_ca()
    return vault


def merge_checked(station: Station, content: Content, vault: Vault, ask: Ask) -> RestoreResult:
    """Merge into a station whose own key and CA are as this station sealed them.

    Raises StoreChangedError, and as merge().
    """
    with station.transaction():
        station.adopt(vault)
        return merge(station, content, dry_run=False)


def merge(station: Station, content: Content, *, dry_run: bool) -> RestoreResult:
    """Bring back into a living store what it lacks, in one transaction; ``dry_run`` tries it out and changes nothing.

    Raises NotAuthenticError, BadDataError, StoreError.
    """
    copy = content.copy
    _check_inside(copy, content)
    how = relation(copy, station)
    work = Merge(station, copy, how)
    try:
        with station.transaction():
            work.run()
            back = {name: count for name, count in work.back.items() if count}
            if back:
                detail = {"created": content.created, "relation": how.name.lower(), "back": back}
                station.audit("restore", None, "merged", **detail)
            if dry_run:
                raise _DryRunRollbackError
    except _DryRunRollbackError:
        pass
    action = "merged" if back else "nothing"
    facts = station.identity.record()
    return RestoreResult(action, how, back, tuple(work.kept_sentences()), facts.keystore if facts is not None else "")


def _check_inside(copy: Station, content: Content) -> None:
    facts = copy.identity.record()
    if copy.id != content.store or facts is None or facts.point != content.point:
        raise NotAuthenticError("The store in the backup is not that of the station that signed it.")
