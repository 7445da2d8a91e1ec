"""Restore a backup into an existing store: what is restored, and what stays although the backup differs."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import cached_property
from typing import Final

from teds_provision.protocol.keys import fingerprint
from teds_provision.station.snapshot import Relation, extend_audit
from teds_provision.station.station import Station
from teds_provision.station.store.audit import AuditFilter
from teds_provision.station.store.records import (
    KeyRecord,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    WhitelistEntry,
)

_OUT_OF_SERVICE: Final = ("decommissioned", "replaced by")  # the words that handover/life.py writes


class Merge:
    """Result of one merge: ``back`` counts restored rows, ``kept`` those that stayed although the backup differs."""

    def __init__(self, live: Station, copy: Station, how: Relation) -> None:
        self.live, self.copy = live, copy
        self.newer = how is Relation.NEWER
        self.older = how in (Relation.OLDER, Relation.SAME)
        self.back: Counter[str] = Counter()
        self.kept: Counter[str] = Counter()
        self.known = {record.uuid: record.epoch for record in live.nodes.all()}
        newest: dict[bytes, int] = {}
        for key in live.keys.all():
            newest[key.uuid] = max(newest.get(key.uuid, 0), key.epoch)
        self.newest = newest
        self.held = frozenset(newest)
        self.barred = {gone.uuid for gone in live.policy.revocations()} | {
            gone.uuid for gone in live.policy.tombstones()
        }

    def run(self) -> None:
        """Bring everything in the order in which one part looks at the other."""
        if self.newer:
            self.back["audit entries"] = extend_audit(self.live, self.copy)
        self._bans()
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
        self._names()
        self._measurements()
        self._line()
        self._unsent()

    def kept_sentences(self) -> list[str]:
        """Return sentences about what stayed."""
        return [f"{what}: {count}" for what, count in self.kept.items() if count]

    def _bans(self) -> None:
        """Merge the deny list: a ban that a person lifted here stays lifted, as it is about that very statement."""
        for revocation in self.copy.policy.revocations():
            if self.live.policy.revocation(revocation.uuid) is not None:
                continue
            if self.live.policy.was_lifted(revocation.statement):
                self.kept["bans lifted since"] += 1
                continue
            self.live.policy.deny(revocation)
            self.back["revocations"] += 1
            if self.live.plant.joined is not None:  # stations may have lifted it since: the next fold of pages decides
                self.live.plant.claims.queue([revocation.uuid])
        self.kept["revocations made since"] = _more(self.live.policy.revocations(), self.copy.policy.revocations())

    def _handovers(self) -> None:
        for handover in self.copy.handovers.all():
            known = self.live.handovers.get(handover.id, handover.direction)
            if known is None or (self.newer and known != handover):
                self.live.handovers.put(handover)
                self.back["handovers"] += 1
        if not self.older:  # if the backup is older, a row missing from this store was undone or rotated away since
            for tombstone in self.copy.policy.tombstones():
                if self.live.policy.tombstone(tombstone.uuid) is None:
                    self.live.policy.put_tombstone(tombstone)
                    self.back["tombstones"] += 1
            present = {(holder.uuid, holder.fingerprint) for holder in self.live.keys.holders()}
            for holder in self.copy.keys.holders():
                if (holder.uuid, holder.fingerprint) not in present:
                    self.live.keys.put_holder(holder)
                    self.back["holders"] += 1
        self.kept["nodes moved away since"] = _more(self.live.policy.tombstones(), self.copy.policy.tombstones())

    def _nodes(self) -> None:
        for record in self.copy.nodes.all():
            known = self.live.nodes.get(record.uuid)
            if known is None:
                self.live.nodes.restore(record)
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
                self.live.nodes.restore(wanted)
                self.back["nodes"] += 1
            self.kept["nodes pinned to another key now"] += other
            self.kept["nodes whose epoch or sequence is higher now"] += (
                known.epoch > record.epoch or known.sequence > record.sequence
            )

    def _groups(self) -> None:
        """Merge the measurement groups: add those that are missing here, replace members by those of a newer copy.

        Rows of an older copy that this store lacks were deleted since.
        """
        present = {group.name: set(group.uuids) for group in self.live.groups.all()}
        for group in self.copy.groups.all():
            missing = group.name not in present and not self.older
            if (self.newer or missing) and present.get(group.name) != set(group.uuids):
                self.live.groups.put(group)
                self.back["groups"] += 1

    def _whitelist(self) -> None:
        for entry in self.copy.pins.whitelist():
            known = self.live.pins.row(entry.uuid)
            pin = self._pin(known, entry.uuid)
            if self.live.policy.revocation(entry.uuid) is not None:
                self.kept["revoked nodes off the whitelist"] += known is None
            elif entry.fingerprint is not None and pin not in (None, entry.fingerprint):
                self.kept["whitelist entries pinned to another key now"] += 1
            elif known is None and entry.uuid in self.retired and entry.added <= self.retired[entry.uuid]:
                self.kept["nodes taken out of service since"] += 1
            elif known is None or (self.newer and known != entry):
                self.live.pins.restore([entry])
                self.back["whitelist"] += 1

    def _pin(self, known: WhitelistEntry | None, uuid: bytes) -> str | None:
        """Return the fingerprint that a node is tied to: its entry's, else that of the key it showed, else None."""
        if known is not None and known.fingerprint is not None:
            return known.fingerprint
        node = self.live.nodes.get(uuid)
        return fingerprint(node.point) if node is not None and node.point is not None else None

    def _keys(self) -> None:
        for record in self.copy.keys.all():
            if any(key.key_id == record.key_id for key in self.live.keys.keys_of(record.uuid)):
                continue
            if record.uuid in self.barred:
                self.kept["keys of revoked or moved nodes left out"] += 1
            elif self._lacks(record):
                # If this store already holds a key of the node, add this one as pending; the next Open shows which key
                # is in use.
                self.live.keys.add(
                    replace(record, state="pending", source="import") if record.uuid in self.held else record
                )
                self.back["keys"] += 1
            else:
                self.kept["older keys left out"] += 1

    def _lacks(self, record: KeyRecord) -> bool:
        """Return True if a key is newer than those that this store holds, and than what it knows of the node.

        A store that was rebuilt knows an epoch from its pages whose key it does not hold: then that key is lacking. One
        that holds no key of a node that it knows gave it up.
        """
        newest, known = self.newest.get(record.uuid), self.known.get(record.uuid)
        if newest is None:
            return known is None or record.epoch > known
        return record.epoch > newest and (known is None or record.epoch >= known)

    def _images(self) -> None:
        for record in self.copy.nodes.all():
            draft, known = self.copy.datasheets.draft(record.uuid), self.live.datasheets.draft(record.uuid)
            if draft is not None and draft != known and (self.newer or (known is None and not self.older)):
                self.live.datasheets.keep_draft(draft)
                self.back["drafts"] += 1
            history, present = (
                self.copy.datasheets.whole_history(record.uuid),
                self.live.datasheets.whole_history(record.uuid),
            )
            if history and history != present and (not present or self.newer):
                self.live.datasheets.put_history(history[::-1])
                self.back["datasheets"] += 1

    def _trust(self) -> None:
        """Merge trusted keys: one that a person removed here stays removed, and one that a newer copy removed goes."""
        if self.newer:
            known = {(record.fingerprint, record.role) for record in self.copy.policy.trust_rows()}
            for record in self.live.policy.trust_rows():
                if (record.fingerprint, record.role) not in known and self._trust_ended(record):
                    self.live.policy.drop_trust(record)
                    self.back["trust ended"] += 1
        names = {record.name for record in self.live.policy.trust_rows()}
        keys = {(record.fingerprint, record.role) for record in self.live.policy.trust_rows()}
        for record in self.copy.policy.trust_rows():
            if (record.fingerprint, record.role) in keys:
                continue
            if self._trust_ended(record):
                self.kept["keys no longer trusted since"] += 1
                continue
            if record.name in names:
                self.kept[f"the name {record.name!r} for the key trusted under it now"] += 1
                continue
            self.live.policy.restore_trust(record)
            self.back[f"trust in {record.role} {record.name}"] += 1

    def _trust_ended(self, record: TrustRecord) -> bool:
        """Return True if this store's log states that the trust in a key was ended after it was added."""
        return record.added <= self.distrusted.get((record.fingerprint, record.role), "")

    @cached_property
    def distrusted(self) -> dict[tuple[str, str], str]:
        """When trust in a key and role was last removed, by the log of this store."""
        entries = self.live.audit_log.chosen(AuditFilter(act="trust"))
        return {
            (str(entry.detail.get("key")), str(entry.detail.get("role"))): entry.at
            for entry in entries
            if entry.outcome == "removed"
        }

    @cached_property
    def retired(self) -> dict[bytes, str]:
        """When a node was last taken out of service, by the log of this store."""
        entries = self.live.audit_log.chosen(AuditFilter(act="decommission"))
        return {
            entry.uuid: entry.at
            for entry in entries
            if entry.uuid is not None and entry.outcome.startswith(_OUT_OF_SERVICE)
        }

    def _decisions(self) -> None:
        """Merge the CAs whose trust a person ended, and the bans that a person lifted.

        Rows of an older copy that this store lacks may have been taken back since.
        """
        ended, lifted = self.live.policy.ended_cas(), self.live.policy.lifted()
        for ca, mac in self.copy.policy.ended_cas().items():
            if ca not in ended and not self.older:
                self.live.policy.restore_ended_ca(ca, mac)
                self.back["CAs whose trust has ended"] += 1
        for statement, mac in self.copy.policy.lifted().items():
            if statement not in lifted and self.newer:
                self.live.policy.restore_lifted(statement, mac)
                self.back["bans lifted"] += 1

    def _facts(self) -> None:
        """Merge certificates and the station's facts that init had not reached here; the keystore is this machine's."""
        here, there = self.live.identity.record(), self.copy.identity.record()
        if there is not None and (here is None or here.point is None):
            kept = there if here is None else replace(there, keystore=here.keystore, keystore_why=here.keystore_why)
            self.live.identity.put(kept)
            self.back["station"] += 1
        present = self.live.identity.certificates()
        for (ca, station), signature in self.copy.identity.certificates().items():
            if (ca, station) not in present:
                self.live.identity.put_certificate(ca, station, signature)
                self.back["certificates"] += 1

    def _marks(self) -> None:
        """Merge key flags (the CA that a node keeps, a due rotation) of a newer copy, or with a key missing here.

        Rows of an older copy that this store lacks may have been settled since.
        """
        present = self.live.keys.all_flags()
        wanted = {
            uuid: marks
            for uuid, marks in self.copy.keys.all_flags().items()
            if present.get(uuid) != marks
            and (self.newer or (uuid not in present and not (self.older and uuid in self.held)))
        }
        self.live.keys.put_flags(wanted)
        self.back["marks"] += len(wanted)

    def _names(self) -> None:
        """Merge chosen names of topics and frames: add those that are missing here, take those of a newer copy.

        Rows of an older copy that this store lacks were reset since. Nothing changes below a running measurement.
        """
        if self.older:
            return
        live, copy = self.live.measurements, self.copy.measurements
        present, frames = live.names, live.frames
        taken = set(present.values())
        for (uuid, channel), name in copy.names.items():
            if name == present.get((uuid, channel)) or ((uuid, channel) in present and not self.newer):
                continue
            if name in taken or live.is_running(uuid):
                self.kept["chosen names in use here"] += 1
                continue
            live.rename(uuid, channel, name)
            taken.add(name)
            self.back["names"] += 1
        for (uuid, channel), frame in copy.frames.items():
            if frame == frames.get((uuid, channel)) or ((uuid, channel) in frames and not self.newer):
                continue
            if live.is_running(uuid):
                self.kept["frames of measured nodes"] += 1
                continue
            live.set_frame(uuid, channel, frame)
            self.back["frames"] += 1

    def _measurements(self) -> None:
        """Merge what the service measures: add what is missing here, replace by that of a newer copy.

        Rows of an older copy that this store lacks were ended since; a command's measurement ended with the command.
        """
        if self.older:
            return
        present = {kept.id: kept for kept in self.live.measurements.lasting()}
        for wanted in self.copy.measurements.lasting():
            known = present.get(wanted.id)
            if known == wanted or (known is not None and not self.newer):
                continue
            self.live.measurements.keep(wanted)
            self.back["measurements"] += 1

    def _unsent(self) -> None:
        """Merge events for the plant that wait for a page; an older copy's are in this store or in its pages."""
        joined, theirs = self.live.plant.joined, self.copy.plant.joined
        if self.older or joined is None or theirs is None or joined.registry != theirs.registry:
            return
        known = self.live.plant.own_events()
        for _, event_id, text in self.copy.plant.outbox(sys.maxsize):
            if event_id not in known:
                self.live.plant.queue_event(json.loads(text))
                self.back["events for the plant"] += 1

    def _line(self) -> None:
        """Merge jobs, units, evidence and requests to an office: a station removes none of them, so none is too old."""
        live, copy = self.live.plant.line, self.copy.plant.line
        for job in copy.jobs():
            known, (_, over) = live.job(job.id), copy.state_of(job.id)
            if known is None:
                live.add_job(job)
            elif self.newer and known.hash == job.hash and known.state != job.state:
                live.set_job_state(job.id, job.state)
            self.back["jobs"] += known is None
            if over and not live.state_of(job.id)[1]:
                live.put_end_seen(job.id)
            self._units(job.id)
        present = live.evidence_digests()
        for document in copy.evidence():
            if document.sha256 not in present:
                live.add_evidence(document)
                self.back["evidence"] += 1
        for request in copy.all_sign_requests():
            kept = live.sign_request(request.hash, request.direction)
            if kept is None or (kept.answer is None and request.answer is not None):
                live.put_sign_request(request)
                self.back["sign requests"] += 1

    def _units(self, job: str) -> None:
        """Merge a job's units: the most attempts count; one whose number another board has here gets the next one."""
        live = self.live.plant.line
        known = {unit.uuid: unit for unit in live.units(job)}
        numbers = {unit.unit for unit in known.values()}
        for unit in self.copy.plant.line.units(job):
            here = known.get(unit.uuid)
            if here is None:
                wanted = replace(unit, unit=max(numbers) + 1) if unit.unit in numbers else unit
                numbers.add(wanted.unit)
            else:
                passed = here.passed or unit.passed
                wanted = replace(here, attempts=max(here.attempts, unit.attempts), passed=passed)
            if wanted != here:
                live.put_unit(wanted)
                self.back["units"] += 1


def _more(live: Iterable[RevocationRecord | Tombstone], copy: Iterable[RevocationRecord | Tombstone]) -> int:
    return len({record.uuid for record in live} - {record.uuid for record in copy})
