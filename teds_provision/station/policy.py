"""Who and what counts here: trusted stations and CAs, the deny list, nodes given away, and the rules upon them."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from teds_provision.errors import NotWhitelistedError, PolicyError
from teds_provision.lazy import late
from teds_provision.protocol.fingerprints import same_key
from teds_provision.station.identity import StationIdentity
from teds_provision.station.node_keys import NodeKeys
from teds_provision.station.pins import Pins
from teds_provision.station.plant.plant import Plant, SignerRules
from teds_provision.station.row_macs import RowMacs
from teds_provision.station.store import RevocationRecord, Store, Tombstone, TrustRecord, WhitelistEntry
from teds_provision.station.store.records import TrustRole

if TYPE_CHECKING:
    from teds_provision.protocol import keys
    from teds_provision.protocol.plant import event, signer
else:  # cryptography: not for commands that only list
    keys, event = late("teds_provision.protocol.keys"), late("teds_provision.protocol.plant.event")


class Policy:
    """What this station trusts and refuses."""

    def __init__(
        self, store: Store, identity: StationIdentity, keys: NodeKeys, pins: Pins, seals: RowMacs, plant: Plant
    ) -> None:
        self._plant = plant
        self._store = store
        self._identity = identity
        self._keys = keys
        self._pins = pins
        self._row_macs = seals

    # -- trust -----------------------------------------------------------------------------------------------------

    def trusted(self, role: TrustRole | None = None) -> list[TrustRecord]:
        """Every station and CA whose key counts here, or those of one role, by name."""
        return [record for record in self.listed() if role in (None, record.role) and self._row_macs.trusted(record)]

    def listed(self) -> list[TrustRecord]:
        """Every station and CA that is listed as trusted, by name; also one that another program put there.

        For a key that the plant's roster names the roster alone decides: members are listed, whom it removed is not.
        """
        roster = self._plant.roster
        if roster is None:
            return self._store.trusted()
        others = [
            trusted
            for trusted in self._store.trusted()
            if trusted.role == "ca" or trusted.fingerprint not in roster.by_key
        ]
        added = roster.created.strftime("%Y-%m-%dT%H:%M:%SZ")
        members = [
            TrustRecord(member.name, "station", member.point, member.fingerprint, added)
            for member in roster.members
            if member.point != self._identity.point
        ]
        return sorted([*others, *members], key=lambda trusted: trusted.name)

    def in_roster(self, fingerprint: str) -> bool:
        """Return True if the plant's roster names this key, as a member or as one that left."""
        roster = self._plant.roster
        return roster is not None and fingerprint in roster.by_key

    def signing(self, certifier: bytes | None, station_key: bytes, digest: bytes) -> signer.SignerVerdict | None:
        """Return the verdict of roster and pages on a signer; None if they do not apply, or there is no plant."""
        rules = self._plant.signer_rules()
        return None if rules is None else rules.signing(certifier, station_key, digest)

    def signer_rules(self) -> SignerRules | None:
        """Return the rules for many datasheets at one moment."""
        return self._plant.signer_rules()

    def trust(self, record: TrustRecord) -> None:
        """Trust a key under a name (the vault opens); PolicyError if another key or role has the name."""
        self._row_macs.require()
        with self._store.transaction():
            self._store.put_trust(self._row_macs.trust(record))
            self._store.renew_ca(record.fingerprint)

    def distrust(self, name_or_fingerprint: str) -> bool:
        """Trust a key no more (the vault opens); False if none fits, raises UsageError if several do."""
        self._row_macs.require()
        return self._store.remove_trust(name_or_fingerprint)

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        """CA keys that count here: the owner's, those added, and for one node that of the bundle it came in.

        The last one counts no more once trust in those who brought it has ended (:meth:`end_ca`).
        """
        cas = [self._identity.ca, *(record.point for record in self.trusted("ca"))]
        if uuid is None or (kept := self._keys.ca_of(uuid)) in cas or not self.counts(kept):
            return cas
        return [*cas, kept]

    def counts(self, ca: bytes) -> bool:
        """Return True if trust in a CA has not been ended."""
        ended, name = self._store.ended_cas(), keys.fingerprint(ca)
        return name not in ended or not self._row_macs.noted("ended ca", name, ended[name])

    def end_ca(self, ca: bytes) -> None:
        """Have a CA that came in a bundle count no more for the nodes that keep it."""
        name = keys.fingerprint(ca)
        self._store.end_ca(name, self._row_macs.note("ended ca", name))

    def renew_ca(self, ca: bytes) -> None:
        """Have a CA count again for the nodes that keep it: a person took in a bundle that names it."""
        self._store.renew_ca(keys.fingerprint(ca))

    def trusted_stations(self) -> list[bytes]:
        """Station keys whose datasheets count without a CA: its own, and those added that no roster decides about."""
        others = (trusted.point for trusted in self.trusted("station") if not self.in_roster(trusted.fingerprint))
        return [self._identity.point, *others]

    def station_points(self) -> dict[str, bytes]:
        """Keys of the other stations that count here, by fingerprint."""
        return {record.fingerprint: record.point for record in self.trusted("station")}

    # -- nodes that are refused ------------------------------------------------------------------------------------

    def revocations(self) -> list[RevocationRecord]:
        """Return the deny list, by UUID."""
        return self._store.revocations()

    def revocation(self, uuid: bytes) -> RevocationRecord | None:
        """Why a node is denied, None if it is not."""
        return self._store.revocation(uuid)

    def revocations_of(self, uuids: Sequence[bytes]) -> dict[bytes, RevocationRecord]:
        """Those of a page of nodes that are denied, with why."""
        return {revocation.uuid: revocation for revocation in self._store.revocations_of(uuids)}

    def deny(self, revocation: RevocationRecord) -> None:
        """Put a node on the deny list."""
        self._store.put_revocation(revocation)

    def lift(self, uuid: bytes) -> bool:
        """Take a node off the deny list (the vault opens): that statement counts no more; False if it was not on it."""
        entry = self.revocation(uuid)
        if entry is None:
            return False
        self._row_macs.require()
        with self._store.transaction():
            hash = event.hash_of_statement(entry.statement)
            for name in (_digest(entry.statement), hash):
                self._store.put_lifted(name, self._row_macs.note("lifted", name))
            self._plant.record_event("lifted", of=hash)
            return self._store.remove_revocation(uuid)

    def forgive(self, uuid: bytes) -> bool:
        """Take a node off the deny list: stations lifted the ban. False if it was not on it."""
        return self._store.remove_revocation(uuid)

    def was_lifted(self, statement: str) -> bool:
        """Return True if an operator has lifted the ban of this very statement here."""
        lifted = self._store.lifted()
        names = (_digest(statement), event.hash_of_statement(statement)) if lifted else ()
        return any(name in lifted and self._row_macs.noted("lifted", name, lifted[name]) for name in names)

    def denied(self, uuid: bytes, key: str | None) -> RevocationRecord | None:
        """Why a node with this key (fingerprint, None: not known) is denied; a ban of another key is none."""
        entry = self.revocation(uuid)
        return None if entry is None or (key and entry.fingerprint and not same_key(entry.fingerprint, key)) else entry

    def tombstones(self) -> list[Tombstone]:
        """Every node that was given away, by UUID."""
        return self._store.tombstones()

    def tombstone(self, uuid: bytes) -> Tombstone | None:
        """Return the tombstone of a node that was given away, None if it was not."""
        return self._store.tombstone(uuid)

    def take_back(self, uuids: Iterable[bytes]) -> None:
        """Take the tombstones of these nodes away."""
        self._store.remove_tombstones(uuids)

    def require_whitelisted(self, uuid: bytes, *, returning: bool = False) -> WhitelistEntry:
        """Return the whitelist entry; raises NotWhitelistedError, or PolicyError for a revoked node or one given away.

        ``returning``: a node given away may come back here, if a key agreement shows that it was reset.
        """
        entry = self._pins.entry(uuid)
        revoked = self.denied(uuid, entry.fingerprint if entry is not None else None)
        if revoked is not None:
            raise PolicyError(
                f"Node {uuid.hex()} was revoked: {revoked.why}.",
                hint=f"If that was a mistake: teds-provision revoke --lift {uuid.hex()}",
            )
        if not returning:
            self.require_not_given_away(uuid)
        if entry is None:
            raise NotWhitelistedError(
                f"Node {uuid.hex()} is not on the whitelist.", hint=f"Add it: teds-provision whitelist add {uuid.hex()}"
            )
        return entry

    def require_not_restored(self, uuid: bytes) -> None:
        """Raise PolicyError for a node whose key came back from a backup: it may have been given away since."""
        if self._keys.restored(uuid):
            raise PolicyError(
                f"The key of node {uuid.hex()} was {self._keys.rotation_due(uuid)}.",
                hint=f"Tap it (with any command), or confirm that it is still yours: agree {uuid.hex()} --rotate --yes",
            )

    def require_not_given_away(self, uuid: bytes) -> None:
        """Raise PolicyError for a node that was moved to another station: its key is used no more."""
        tombstone = self.tombstone(uuid)
        if tombstone is None:
            return
        row = self._store.handover(tombstone.handover_id, "out")
        undo = f"Use it there, or: teds-provision handover undo {tombstone.handover_id}"
        back = "Use it there, or have it handed back (export-keys there, import-keys here)."
        raise PolicyError(
            f"Node {uuid.hex()} was moved to station {tombstone.to_fingerprint[:16]}; its key is no longer used here.",
            hint=undo if row is not None and row.state == "open" else back,
        )


def _digest(statement: str) -> str:
    return hashlib.sha256(statement.encode()).hexdigest()
