"""What a backup restores in an existing store, and what stays although the backup differs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import replace

from teds_provision.protocol.keys import fingerprint
from teds_provision.station.store import RevocationRecord, Store, Tombstone, WhitelistEntry
from teds_provision.station.store.snapshot import Relation, extend_audit


class Merge:
    """Result of one merge: ``back`` counts restored rows, ``kept`` those that stayed although the backup differs."""

    def __init__(self, live: Store, copy: Store, how: Relation) -> None:
        self.live, self.copy = live, copy
        self.newer = how is Relation.NEWER
        self.older = how in (Relation.OLDER, Relation.SAME)
        self.back: Counter[str] = Counter()
        self.kept: Counter[str] = Counter()
        epochs = {record.uuid: record.epoch for record in live.nodes()}
        for key in live.all_keys():
            epochs[key.uuid] = max(epochs.get(key.uuid, 0), key.epoch)
        self.epochs = epochs
        self.held = {key.uuid for key in live.all_keys()}
        self.barred = {gone.uuid for gone in live.revocations()} | {gone.uuid for gone in live.tombstones()}

    def run(self) -> None:
        """Bring everything in the order in which one part looks at the other."""
        if self.newer:
            self.back["audit entries"] = extend_audit(self.live, self.copy)
        for revocation in self.copy.revocations():
            if self.live.revocation(revocation.uuid) is None:
                self.live.put_revocation(revocation)
                self.back["revocations"] += 1
        self.kept["revocations made since"] = _more(self.live.revocations(), self.copy.revocations())
        self._handovers()
        self._nodes()
        self._whitelist()
        self._keys()
        self._images()
        self._trust()
        self._decisions()
        self._facts()
        self._marks()
        self._groups()

    def kept_sentences(self) -> list[str]:
        """Return sentences about what stayed."""
        return [f"{what}: {count}" for what, count in self.kept.items() if count]

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
            kept = record if known.point is None and self.newer else known
            wanted = replace(
                base,
                point=kept.point,
                point_mac=kept.point_mac,
                epoch=max(known.epoch, record.epoch),
                sequence=max(known.sequence, record.sequence),
            )
            if wanted != known:
                self.live.put_node(wanted)
                self.back["nodes"] += 1
            self.kept["nodes pinned to another key now"] += other
            self.kept["nodes whose epoch or sequence is higher now"] += (
                known.epoch > record.epoch or known.sequence > record.sequence
            )

    def _groups(self) -> None:
        """Measurement groups: those that are missing here; their members as a newer copy has them.

        What an older copy has and this store lacks was deleted since.
        """
        present = {group.name: set(group.uuids) for group in self.live.groups()}
        for group in self.copy.groups():
            missing = group.name not in present and not self.older
            if (self.newer or missing) and present.get(group.name) != set(group.uuids):
                self.live.put_group(group)
                self.back["groups"] += 1

    def _whitelist(self) -> None:
        for entry in self.copy.whitelist():
            known = self.live.whitelisted(entry.uuid)
            pin = self._pin(known, entry.uuid)
            if self.live.revocation(entry.uuid) is not None:
                self.kept["revoked nodes off the whitelist"] += known is None
            elif entry.fingerprint is not None and pin not in (None, entry.fingerprint):
                self.kept["whitelist entries pinned to another key now"] += 1
            elif known is None or (self.newer and known != entry):
                self.live.put_whitelist(entry)
                self.back["whitelist"] += 1

    def _pin(self, known: WhitelistEntry | None, uuid: bytes) -> str | None:
        """Fingerprint of the key that this store ties a node to: that of its entry, else of what it showed."""
        if known is not None and known.fingerprint is not None:
            return known.fingerprint
        node = self.live.node(uuid)
        return fingerprint(node.point) if node is not None and node.point is not None else None

    def _keys(self) -> None:
        for record in self.copy.all_keys():
            if any(key.key_id == record.key_id for key in self.live.keys(record.uuid)):
                continue
            newest = self.epochs.get(record.uuid)
            if record.uuid in self.barred:
                self.kept["keys of revoked or moved nodes left out"] += 1
            elif newest is None or record.epoch > newest:
                # Beside a key that is held it comes as pending: an Open under it decides, and drops the other.
                self.live.add_key(
                    replace(record, state="pending", source="import") if record.uuid in self.held else record
                )
                self.back["keys"] += 1
            else:
                self.kept["older keys left out"] += 1

    def _images(self) -> None:
        for record in self.copy.nodes():
            draft, known = self.copy.draft(record.uuid), self.live.draft(record.uuid)
            if draft is not None and draft != known and (self.newer or (known is None and not self.older)):
                self.live.put_draft(draft)
                self.back["drafts"] += 1
            history, present = self.copy.history(record.uuid), self.live.history(record.uuid)
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

    def _decisions(self) -> None:
        """CAs whose trust a person ended, and bans that one lifted.

        What an older copy has and this store lacks may have been taken back since.
        """
        ended, lifted = self.live.ended_cas(), self.live.lifted()
        for ca, mac in self.copy.ended_cas().items():
            if ca not in ended and not self.older:
                self.live.end_ca(ca, mac)
                self.back["CAs whose trust has ended"] += 1
        for statement, mac in self.copy.lifted().items():
            if statement not in lifted and self.newer:
                self.live.put_lifted(statement, mac)
                self.back["bans lifted"] += 1

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
        present = self.live.all_key_flags()
        wanted = {
            uuid: marks
            for uuid, marks in self.copy.all_key_flags().items()
            if present.get(uuid) != marks
            and (self.newer or (uuid not in present and not (self.older and uuid in self.held)))
        }
        self.live.put_key_flags(wanted)
        self.back["marks"] += len(wanted)


def _more(live: Iterable[RevocationRecord | Tombstone], copy: Iterable[RevocationRecord | Tombstone]) -> int:
    return len({record.uuid for record in live} - {record.uuid for record in copy})
