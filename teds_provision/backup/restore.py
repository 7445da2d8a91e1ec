"""``restore``: a lost station comes back, or what a living one lacks is brought back; nothing ever goes back.

Into an empty home the backup comes as it is. Into the home of the same station it is merged in one transaction: what is
missing comes back, what is newer stays. Epochs and sequences take the greater of both, keys of the present state are
kept, tombstones and revocations stay, the audit log only grows.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from teds_provision.backup.content import Content
from teds_provision.errors import (
    NotAuthentic,
    PolicyRefused,
    StoreFailure,
    UsageFailure,
    VaultFailure,
    WrongPassphrase,
)
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.node_keys import RESTORED
from teds_provision.station.station import Station
from teds_provision.store import NodeRecord, Revocation, Store, StoreLock, Tombstone
from teds_provision.store.snapshot import (
    Relation,
    extend_audit,
    is_damage,
    place,
    relation,
    set_aside,
    totals,
)
from teds_provision.vault import Ask, Vault, create_vault, node_key_context, open_vault
from teds_provision.vault.passphrase import PRODUCT, Costs


@dataclass(frozen=True)
class Restored:
    """What was done (or would be): ``rebuilt``, ``merged`` or ``nothing``; how much came back, and what stayed.

    ``rotations_due`` counts the nodes whose key has to be rotated by tap, or by a person's word, before anything else.
    """

    action: str
    relation: Relation | None
    back: dict[str, int]
    kept: tuple[str, ...]
    keystore: str
    set_aside: Path | None = None
    rotations_due: int = 0


class _OnlyAPlan(Exception):
    """Rolls a transaction back that was tried out."""


def open_present(home: Path, content: Content) -> Store | None:
    """Open the store of ``home`` if there is one that can be used, None if there is none or it is damaged.

    Raises PolicyRefused where it is the store of another station, StoreFailure where it cannot be used otherwise.
    """
    if not (home / "store.sqlite3").exists():
        return None
    try:
        store = Store.open(home)
    except StoreFailure as failure:
        if is_damage(failure):
            return None
        raise
    if store.damage() is not None:
        store.close()
        return None
    facts = store.facts()
    point = facts.point if facts is not None else None
    if store.id != content.store or (point is not None and point != content.point):
        store.close()
        here = "of an unfinished init" if point is None else f"of station {fingerprint(point)[:32]}"
        raise PolicyRefused(
            f"The backup is of station {content.station[:32]}; the store in {home} is {here}.",
            hint="Restore into another --home: backups never mix stations.",
        )
    return store


def rebuild(home: Path, content: Content, ask: Ask, *, keystore: str | None = None, costs: Costs = PRODUCT) -> Restored:
    """Make the station of a backup in a home without a usable store; a damaged one is kept under another name.

    ``keystore`` as for init; None takes the kind that the station had, or a passphrase file where the keyring does not
    work. The vault comes first, the store last and in one piece: killed in between, the same command carries on.
    Every node that a key is held for is due for rotation afterwards, by tap or a person's word: nobody here knows what
    became of it since the backup. Raises NotAuthentic, VaultFailure and its leaves, StoreFailure.
    """
    copy = content.copy
    _check_inside(copy, content)
    wanted = keystore_for(content, keystore)
    try:
        home.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise StoreFailure(f"{home} cannot be made: {error.strerror}.", hint="Choose another --home.") from error
    with StoreLock(home, command="restore"):
        vault, why = bring_vault(home, content, ask, wanted, costs)
        kind = wanted if wanted is not None and wanted.startswith("pkcs11:") else vault.kind
        with copy.transaction():
            _move_to(copy, kind, why)
            due = _demand_rotations(copy, content, ask)
            detail = {"created": content.created, "keystore": vault.kind, "rotations_due": due}
            copy.audit.append("restore", None, "rebuilt", detail)
        aside = set_aside(home) if (home / "store.sqlite3").exists() else None
        place(copy, home)
    return Restored("rebuilt", None, totals(copy), (), kind, aside, due)


def _demand_rotations(copy: Store, content: Content, ask: Ask) -> int:
    """Have every node for which a key is held rotate it first, and only when a person has the node in hand."""
    why = f"{RESTORED} of {content.created}: it may have been given away or replaced since"
    keys = Station(copy, ask).keys
    nodes = {record.uuid for record in keys.all()}
    keys.mark({uuid: {"rotation": why} for uuid in nodes})
    return len(nodes)


def keystore_for(content: Content, asked: str | None) -> str | None:
    """Which keystore a restored station gets: None means the keyring, or a passphrase file where it does not work.

    No path of a module ever comes from a backup: for keys in a token the URI has to be given (UsageFailure). Raises
    PolicyRefused where the keys cannot be put there.
    """
    wanted = asked or (None if content.keystore in ("keyring", "pkcs11") or content.in_token else content.keystore)
    if wanted not in (None, "keyring", "file") and not wanted.startswith("pkcs11:"):
        raise UsageFailure("There is no such keystore.", hint="Give --keystore keyring, file or pkcs11:URI.")
    if content.in_token and asked is None:
        raise UsageFailure(
            "The station's key is in a token, and a backup does not say by which module it is reached.",
            hint="Add --keystore 'pkcs11:token=LABEL?module-path=/path/of/the/module.so'.",
        )
    if content.in_token != (wanted or "").startswith("pkcs11:"):
        raise PolicyRefused(
            "The station's key is in a token and cannot be put elsewhere."
            if content.in_token
            else "The keys of this backup cannot be put into a token.",
            hint="Restore with --keystore pkcs11:URI of that token."
            if content.in_token
            else "Restore with --keystore keyring or file.",
        )
    return wanted


def bring_vault(
    home: Path, content: Content, ask: Ask, keystore: str | None, costs: Costs = PRODUCT
) -> tuple[Vault, str]:
    """Make or complete the vault with what the backup holds, and have it show the station's key."""
    vault, why = create_vault(home, content.store, keystore, ask, costs=costs, restored=content.material)
    if vault.identity().point != content.point:
        raise NotAuthentic("The keys in the backup are not those of the station that signed it.")
    return vault, why


def complete_vault(store: Store, content: Content, ask: Ask, *, keystore: str | None = None) -> Vault:
    """Open the vault of a living station; make it again where it is lost, and join master keys that it lacks.

    A CA key that was taken out of the vault since the backup stays out. Raises VaultFailure and its leaves.
    """
    facts = store.facts()
    wanted = facts.keystore if facts is not None else keystore_for(content, keystore)
    try:
        vault = open_vault(store.home, store.id, wanted or "keyring", ask)
    except WrongPassphrase:
        raise
    except VaultFailure:  # lost, or locked: then making it fails as well and says so
        return bring_vault(store.home, content, ask, wanted)[0]
    if _opens_all(vault, content):
        return vault
    had_ca = vault.ca() is not None
    vault, _ = bring_vault(store.home, content, ask, wanted)
    if not had_ca:
        vault.drop_ca()
    return vault


def _opens_all(vault: Vault, content: Content) -> bool:
    try:
        for record in content.copy.all_keys():
            context = node_key_context(content.copy.id, record.uuid, record.epoch, record.slot)
            vault.unwrap(record.wrapped, context=context)
    except VaultFailure:
        return False
    return True


def merge(store: Store, content: Content, *, dry_run: bool) -> Restored:
    """Bring back into a living store what it lacks, in one transaction; ``dry_run`` tries it out and changes nothing.

    Raises NotAuthentic, BadData, StoreFailure.
    """
    copy = content.copy
    _check_inside(copy, content)
    how = relation(copy, store)
    work = _Merge(store, copy, how)
    try:
        with store.transaction():
            work.run()
            back = {name: count for name, count in work.back.items() if count}
            if back:
                detail = {"created": content.created, "relation": how.name.lower(), "back": back}
                store.audit.append("restore", None, "merged", detail)
            if dry_run:
                raise _OnlyAPlan
    except _OnlyAPlan:
        pass
    action = "merged" if back else "nothing"
    facts = store.facts()
    return Restored(action, how, back, tuple(work.told()), facts.keystore if facts is not None else "")


def _check_inside(copy: Store, content: Content) -> None:
    facts = copy.facts()
    if copy.id != content.store or facts is None or facts.point != content.point:
        raise NotAuthentic("The store in the backup is not that of the station that signed it.")


class _Merge:
    """One merge: ``back`` counts what came, ``kept`` what stayed as it is although the backup says otherwise."""

    def __init__(self, live: Store, copy: Store, how: Relation) -> None:
        self.live, self.copy = live, copy
        self.newer = how is Relation.NEWER
        self.older = how in (Relation.OLDER, Relation.SAME)
        self.back: Counter[str] = Counter()
        self.kept: Counter[str] = Counter()
        self.epochs = _epochs(live)
        self.held = {key.uuid for key in live.all_keys()}
        self.barred = {gone.uuid for gone in live.revocations()} | {gone.uuid for gone in live.tombstones()}

    def run(self) -> None:
        """Bring everything in the order in which one part looks at the other."""
        if self.newer:
            self.back["audit entries"] = extend_audit(self.live, self.copy)
        self._revocations()
        self._handovers()
        self._nodes()
        self._whitelist()
        self._keys()
        self._images()
        self._trust()
        self._facts()
        self._marks()

    def told(self) -> list[str]:
        """What stayed, in sentences."""
        return [f"{what}: {count}" for what, count in self.kept.items() if count]

    def _revocations(self) -> None:
        for revocation in self.copy.revocations():
            if self.live.revocation(revocation.uuid) is None:
                self.live.put_revocation(revocation)
                self.back["revocations"] += 1
        self.kept["revocations made since"] = _more(self.live.revocations(), self.copy.revocations())

    def _handovers(self) -> None:
        for handover in self.copy.handovers():
            known = self.live.handover(handover.id, handover.direction)
            if known is None or (self.newer and known != handover):
                self.live.put_handover(handover)
                self.back["handovers"] += 1
        if not self.older:  # what an older copy has and this store lacks was undone, or rotated away, since
            for tombstone in self.copy.tombstones():
                if self.live.tombstone(tombstone.uuid) is None:
                    self.live.put_tombstone(tombstone)
                    self.back["tombstones"] += 1
            present = {(holder.uuid, holder.fingerprint) for holder in self.live.holders()}
            for holder in self.copy.holders():
                if (holder.uuid, holder.fingerprint) not in present:
                    self.live.put_holder(holder)
                    self.back["holders"] += 1
        self.kept["nodes moved away since"] = _more(self.live.tombstones(), self.copy.tombstones())

    def _nodes(self) -> None:
        for record in self.copy.nodes():
            known = self.live.node(record.uuid)
            if known is None:
                self.live.put_node(record)
                self.back["nodes"] += 1
                continue
            other = known.point is not None and record.point is not None and known.point != record.point
            base = record if self.newer and not other else known
            wanted = replace(
                base,
                point=known.point or (record.point if self.newer else None),
                epoch=max(known.epoch, record.epoch),
                sequence=max(known.sequence, record.sequence),
            )
            if wanted != known:
                self.live.put_node(wanted)
                self.back["nodes"] += 1
            self._note_node(known, record, other=other)

    def _note_node(self, known: NodeRecord, record: NodeRecord, *, other: bool) -> None:
        self.kept["nodes pinned to another key now"] += other
        self.kept["nodes whose epoch or sequence is higher now"] += (
            known.epoch > record.epoch or known.sequence > record.sequence
        )

    def _whitelist(self) -> None:
        for entry in self.copy.whitelist():
            known, node = self.live.whitelisted(entry.uuid), self.live.node(entry.uuid)
            pin = known.fingerprint if known else None
            if pin is None and node is not None and node.point is not None:
                pin = fingerprint(node.point)
            if self.live.revocation(entry.uuid) is not None:
                self.kept["revoked nodes off the whitelist"] += known is None
            elif entry.fingerprint is not None and pin not in (None, entry.fingerprint):
                self.kept["whitelist entries pinned to another key now"] += 1
            elif known is None or (self.newer and known != entry):
                self.live.put_whitelist(entry)
                self.back["whitelist"] += 1

    def _keys(self) -> None:
        for record in self.copy.all_keys():
            if any(key.key_id == record.key_id for key in self.live.keys(record.uuid)):
                continue
            newest = self.epochs.get(record.uuid)
            if record.uuid in self.barred:
                self.kept["keys of revoked or moved nodes left out"] += 1
            elif newest is None or record.epoch > newest:
                # Beside a key that is held it comes as pending: an Open under it decides, and drops the other.
                self.live.add_key(replace(record, state="pending") if record.uuid in self.held else record)
                self.back["keys"] += 1
            else:
                self.kept["older keys left out"] += 1

    def _images(self) -> None:
        for record in self.copy.nodes():
            draft, history = self.copy.draft(record.uuid), self.copy.history(record.uuid)
            known = self.live.draft(record.uuid)
            if draft is not None and draft != known and (self.newer or (known is None and not self.older)):
                self.live.put_draft(draft)
                self.back["drafts"] += 1
            present = self.live.history(record.uuid)
            if history and history != present and (not present or self.newer):
                self.live.put_history(history[::-1])
                self.back["datasheets"] += 1

    def _trust(self) -> None:
        names = {record.name for record in self.live.trusted()}
        keys = {(record.fingerprint, record.role) for record in self.live.trusted()}
        for record in self.copy.trusted():
            if (record.fingerprint, record.role) in keys:
                continue
            if record.name in names:
                self.kept[f"the name {record.name!r} for the key trusted under it now"] += 1
                continue
            self.live.put_trust(record)
            self.back[f"trust in {record.role} {record.name}"] += 1

    def _facts(self) -> None:
        """Facts of the station that init had not reached here, and certificates; the keystore is this machine's."""
        here, there = self.live.facts(), self.copy.facts()
        if there is not None and (here is None or here.point is None):
            kept = there if here is None else replace(there, keystore=here.keystore, keystore_why=here.keystore_why)
            self.live.put_facts(kept)
            self.back["station"] += 1
        present = self.live.certificates()
        for (ca, station), signature in self.copy.certificates().items():
            if (ca, station) not in present:
                self.live.put_certificate(ca, station, signature)
                self.back["certificates"] += 1

    def _marks(self) -> None:
        """Whose CA a node keeps, a rotation that is due: from a newer copy, or with a key that is missing here.

        What an older copy has and this store lacks may have been settled since.
        """
        present = self.live.all_marks()
        wanted = {
            uuid: marks
            for uuid, marks in self.copy.all_marks().items()
            if present.get(uuid) != marks
            and (self.newer or (uuid not in present and not (self.older and uuid in self.held)))
        }
        self.live.put_marks(wanted)
        self.back["marks"] += len(wanted)


def _move_to(copy: Store, keystore: str, why: str) -> None:
    """Note in a restored store where the secrets lie on this machine."""
    facts = copy.facts()
    if facts is not None:
        copy.put_facts(replace(facts, keystore=keystore, keystore_why=why))


def _epochs(store: Store) -> dict[bytes, int]:
    """The highest epoch known of every node."""
    epochs = {record.uuid: record.epoch for record in store.nodes()}
    for key in store.all_keys():
        epochs[key.uuid] = max(epochs.get(key.uuid, 0), key.epoch)
    return epochs


def _more(live: Iterable[Revocation | Tombstone], copy: Iterable[Revocation | Tombstone]) -> int:
    return len({record.uuid for record in live} - {record.uuid for record in copy})
