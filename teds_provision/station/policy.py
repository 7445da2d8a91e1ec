"""The trust policy: trusted stations and CAs, the deny list, nodes given away, and the rules for them."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import fields, replace
from operator import attrgetter
from shlex import quote
from typing import TYPE_CHECKING, Final

from teds_provision.errors import NotWhitelistedError, PolicyError, UsageError
from teds_provision.lazy import late
from teds_provision.protocol import keys
from teds_provision.protocol.fingerprints import same_key
from teds_provision.station.handovers import Handovers
from teds_provision.station.identity import StationIdentity
from teds_provision.station.node_keys import NodeKeys
from teds_provision.station.pins import Pins
from teds_provision.station.plant.plant import Plant, PlantConflictError, SignerRules
from teds_provision.station.row_macs import MacRow, RowMacs, Values
from teds_provision.station.store.database import places
from teds_provision.station.store.records import (
    RevocationRecord,
    Tombstone,
    TrustRecord,
    TrustRole,
    WhitelistEntry,
    utc_now,
)
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store

if TYPE_CHECKING:
    from teds_provision.protocol.plant import event, signer
else:  # imports cryptography, which commands that only list do not need
    event = late("teds_provision.protocol.plant.event")

_MIN_FINGERPRINT_PREFIX: Final = 16  # as many digits as users see
_DIGITS: Final = 16
_SHOWN: Final = 5
_tombstone = attrgetter(*(column.name for column in fields(Tombstone)))


class Policy:
    """Trust and refusals of this station."""

    def __init__(
        self,
        store: Store,
        identity: StationIdentity,
        keys: NodeKeys,
        pins: Pins,
        handovers: Handovers,
        row_macs: RowMacs,
        plant: Plant,
        notify: Callable[[str], object],
    ) -> None:
        self._store = store
        self._identity = identity
        self._keys = keys
        self._pins = pins
        self._handovers = handovers
        self._row_macs = row_macs
        self._plant = plant
        self._notify = notify
        self._broken_trust: tuple[str, ...] = ()

    # -- trust -----------------------------------------------------------------------------------------------------

    def trusted(self, role: TrustRole | None = None) -> list[TrustRecord]:
        """Return every station and CA whose key counts here, or those of one role, by name."""
        return [record for record in self.listed() if role in (None, record.role) and self._trust_holds(record)]

    def listed(self) -> list[TrustRecord]:
        """Return every station and CA listed as trusted, by name; also one that another program added.

        For a key that the plant's roster names the roster alone decides: members are listed, whom it removed is not.
        """
        roster = self._plant.roster
        if roster is None:
            return self.trust_rows()
        others = [
            trusted for trusted in self.trust_rows() if trusted.role == "ca" or trusted.fingerprint not in roster.by_key
        ]
        added = roster.created.strftime("%Y-%m-%dT%H:%M:%SZ")
        members = [
            TrustRecord(member.name, "station", member.point, member.fingerprint, added)
            for member in roster.members
            if member.point != self._identity.point
        ]
        return sorted([*others, *members], key=lambda trusted: trusted.name)

    def trust_rows(self) -> list[TrustRecord]:
        """Return every station and CA that was added, by name, whatever its MAC or a roster."""
        return list(self._store.recall(TrustRecord, "SELECT * FROM trust ORDER BY name"))

    def _trust_holds(self, record: TrustRecord) -> bool:
        """Return True if a trusted key counts: its MAC is right, or the vault is closed and it cannot be checked."""
        return not self._row_macs.active or record.name not in self._broken_trust

    def in_roster(self, fingerprint: str) -> bool:
        """Return True if the plant's roster names this key, as a member or as one that left."""
        roster = self._plant.roster
        return roster is not None and fingerprint in roster.by_key

    def signer_rules(self) -> SignerRules | None:
        """Return whose signatures count in the plant at this moment; None if no plant was joined."""
        return self._plant.signer_rules(
            {record.fingerprint for record in self.trust_rows() if record.role == "station"}
        )

    def signing(self, certifier: bytes | None, station_key: bytes, security_teds: bytes) -> signer.SignerVerdict | None:
        """Return the verdict of roster and pages on the signer of a Security TEDS, or of one of this SHA-256.

        None if they do not apply, or there is no plant.
        """
        rules = self.signer_rules()
        return None if rules is None else rules.signing(certifier, station_key, security_teds)

    def trust(self, record: TrustRecord) -> None:
        """Trust a key under a name (the vault opens); PolicyError if another key or role has the name."""
        self._row_macs.require()
        with self._store.transaction():
            self.restore_trust(replace(record, mac=self._row_macs.mac("trust", _bound(record))))
            self._renew(record.fingerprint)

    def restore_trust(self, record: TrustRecord) -> None:
        """Trust a key under a name, with the MAC that it has; the same key and role under another name is renamed.

        Raises PolicyError if another key or role has the name: it must be removed first.
        """
        with self._store.together():
            row = self._store.first_row("SELECT fingerprint, role FROM trust WHERE name = ?", (record.name,))
            if row and row != (record.fingerprint, record.role):
                raise PolicyError(
                    f"The name {record.name!r} is already taken by the {row[1]} {row[0][:16]}.",
                    hint=f"Choose another name, or run teds-provision trust remove {quote(record.name)} first.",
                )
            self._store.execute(
                "DELETE FROM trust WHERE fingerprint = ? AND role = ?", (record.fingerprint, record.role)
            )
            self._store.execute(
                "INSERT INTO trust VALUES(?, ?, ?, ?, ?, ?)",
                (record.name, record.role, record.point, record.fingerprint, record.added, record.mac),
            )

    def drop_trust(self, record: TrustRecord) -> None:
        """Remove a row of the trusted keys, for restore: a newer copy of this store has it no more."""
        self._store.execute("DELETE FROM trust WHERE fingerprint = ? AND role = ?", (record.fingerprint, record.role))

    def distrust(self, name_or_fingerprint: str) -> bool:
        """Trust a key no more (the vault opens); False if none fits, raises UsageError if several do.

        ``name_or_fingerprint``: a name, a fingerprint, or at least 16 digits of one.
        """
        self._row_macs.require()
        digits = name_or_fingerprint.strip().lower()
        with self._store.together():
            if self._store.change("DELETE FROM trust WHERE name = ?", (name_or_fingerprint,)):
                return True
            if not re.fullmatch(f"[0-9a-f]{{{_MIN_FINGERPRINT_PREFIX},64}}", digits):
                return False
            found = self._store.execute(
                "SELECT DISTINCT fingerprint FROM trust WHERE substr(fingerprint, 1, ?) = ?", (len(digits), digits)
            )
            if len(found) > 1:
                raise UsageError(f"{digits} matches {len(found)} trusted keys.", hint="Give the whole fingerprint.")
            return bool(found) and self._store.change("DELETE FROM trust WHERE fingerprint = ?", found[0]) > 0

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        """Return the CA keys that count here: the owner's, those added, and for one node that of its bundle.

        The last one counts no more once trust in those who brought it has ended (:meth:`end_ca`).
        """
        cas = [self._identity.ca, *(record.point for record in self.trusted("ca"))]
        if uuid is None or (kept := self._keys.ca_of(uuid)) in cas or not self.counts(kept):
            return cas
        return [*cas, kept]

    def counts(self, ca: bytes) -> bool:
        """Return True if trust in a CA has not been ended."""
        ended, name = self.ended_cas(), keys.fingerprint(ca)
        return name not in ended or not self._row_macs.noted("ended ca", name, ended[name])

    def end_ca(self, ca: bytes) -> None:
        """Have a CA that came in a bundle count no more for the nodes that keep it."""
        name = keys.fingerprint(ca)
        self.restore_ended_ca(name, self._row_macs.note("ended ca", name))

    def restore_ended_ca(self, ca: str, mac: bytes | None) -> None:
        """End trust as :meth:`end_ca` does, by fingerprint and with the MAC of the row."""
        self._store.execute("INSERT OR REPLACE INTO ended_cas VALUES(?, ?, ?)", (ca, utc_now(), mac))

    def ended_cas(self) -> dict[str, bytes | None]:
        """Return the CAs (fingerprints) that came in bundles and no longer count, with the MAC of each."""
        return dict(self._store.execute("SELECT ca, mac FROM ended_cas"))

    def renew_ca(self, ca: bytes) -> None:
        """Have a CA count again for the nodes that keep it: a person took in a bundle that names it."""
        self._renew(keys.fingerprint(ca))

    def _renew(self, ca: str) -> None:
        self._store.execute("DELETE FROM ended_cas WHERE ca = ?", (ca,))

    def trusted_stations(self) -> list[bytes]:
        """Return the station keys that count without a CA: its own, and those added about which no roster decides."""
        others = (trusted.point for trusted in self.trusted("station") if not self.in_roster(trusted.fingerprint))
        return [self._identity.point, *others]

    def station_points(self) -> dict[str, bytes]:
        """Return the keys of the other stations that count here, by fingerprint."""
        return {record.fingerprint: record.point for record in self.trusted("station")}

    # -- refused nodes ---------------------------------------------------------------------------------------------

    def revocations(self) -> list[RevocationRecord]:
        """Return the deny list, by UUID."""
        return self._store.read(RevocationRecord, "SELECT * FROM revocations ORDER BY uuid")

    def revocation(self, uuid: bytes) -> RevocationRecord | None:
        """Return why a node is denied, None if it is not."""
        return self._store.read_one(RevocationRecord, "SELECT * FROM revocations WHERE uuid = ?", (uuid,))

    def revocations_of(self, uuids: Sequence[bytes]) -> dict[bytes, RevocationRecord]:
        """Return the entries of those of a chunk of nodes that are denied, by UUID."""
        statement = f"SELECT * FROM revocations WHERE uuid IN ({places(uuids)})"
        return {entry.uuid: entry for entry in self._store.read(RevocationRecord, statement, uuids)}

    def deny(self, revocation: RevocationRecord) -> None:
        """Put a node on the deny list."""
        self._store.execute(
            "INSERT OR REPLACE INTO revocations VALUES(?, ?, ?, ?, ?)",
            (revocation.uuid, revocation.fingerprint, revocation.why, revocation.statement, revocation.created),
        )

    def lift(self, uuid: bytes) -> bool:
        """Take a node off the deny list (the vault opens): that statement counts no more; False if it was not on it."""
        entry = self.revocation(uuid)
        if entry is None:
            return False
        self._row_macs.require()
        with self._store.transaction():
            hash = event.hash_of_statement(entry.statement)
            for name in (_digest(entry.statement), hash):
                self.restore_lifted(name, self._row_macs.note("lifted", name))
            self._plant.record_event("lifted", of=hash)
            return self.forgive(uuid)

    def forgive(self, uuid: bytes) -> bool:
        """Take a node off the deny list: stations lifted the ban. False if it was not on it."""
        return self._store.change("DELETE FROM revocations WHERE uuid = ?", (uuid,)) > 0

    def lifted(self) -> dict[str, bytes | None]:
        """Return the bans that a person lifted, as SHA-256 of their signed text, with the MAC of each."""
        return dict(self._store.execute("SELECT statement, mac FROM lifted"))

    def restore_lifted(self, statement: str, mac: bytes | None) -> None:
        """Note that a person lifted a ban (the SHA-256 of its signed text), with the MAC that the row has."""
        self._store.execute("INSERT OR REPLACE INTO lifted VALUES(?, ?, ?)", (statement, utc_now(), mac))

    def was_lifted(self, statement: str) -> bool:
        """Return True if an operator has lifted the ban of this very statement here."""
        lifted = self.lifted()
        names = (_digest(statement), event.hash_of_statement(statement)) if lifted else ()
        return any(name in lifted and self._row_macs.noted("lifted", name, lifted[name]) for name in names)

    def denied(self, uuid: bytes, key: str | None) -> RevocationRecord | None:
        """Return why a node with this key (fingerprint, None: unknown) is denied; other keys' bans do not count."""
        entry = self.revocation(uuid)
        return None if entry is None or (key and entry.fingerprint and not same_key(entry.fingerprint, key)) else entry

    def tombstones(self) -> list[Tombstone]:
        """Return every node that was given away, by UUID."""
        return self._store.read(Tombstone, "SELECT * FROM tombstones ORDER BY uuid")

    def tombstone(self, uuid: bytes) -> Tombstone | None:
        """Return the tombstone of a node that was given away, None if it was not."""
        return self._store.read_one(Tombstone, "SELECT * FROM tombstones WHERE uuid = ?", (uuid,))

    def put_tombstone(self, *tombstones: Tombstone) -> None:
        """Note that nodes were given away."""
        self._store.execute_many("INSERT OR REPLACE INTO tombstones VALUES(?, ?, ?, ?)", map(_tombstone, tombstones))

    def take_back(self, uuids: Iterable[bytes]) -> None:
        """Take the tombstones of these nodes away."""
        self._store.execute_many("DELETE FROM tombstones WHERE uuid = ?", ((uuid,) for uuid in uuids))

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
        row = self._handovers.get(tombstone.handover_id, "out")
        undo = f"Use it there, or: teds-provision handover undo {tombstone.handover_id}"
        back = "Use it there, or have it handed back (export-keys there, import-keys here)."
        raise PolicyError(
            f"Node {uuid.hex()} was moved to station {tombstone.to_fingerprint[:16]}; its key is no longer used here.",
            hint=undo if row is not None and row.state == "open" else back,
        )

    def require_undisputed(self, uuid: bytes) -> None:
        """Raise PlantConflictError if stations know two keys of a node that this one would key for the first time.

        It holds until a keeper, or an operator here, pins one.
        """
        if self._plant.joined is None:
            return
        entry = self._pins.row(uuid)
        own_word = entry is not None and entry.fingerprint is not None and entry.assurance != "registry"
        disputed = next((why for _, name, why in self._plant.claims.conflicts(uuid) if name == "two keys"), None)
        if disputed is not None and not own_word and not self._keys.held(uuid):
            raise PlantConflictError(
                f"The plant's stations know two keys for node {uuid.hex()}: {disputed}.",
                hint=f"A keeper must pin one of them, or you do: whitelist add {uuid.hex()} --fingerprint F",
            )

    # -- row MACs ----------------------------------------------------------------------------------------------------

    def unlocked(self) -> None:
        """Find and report rows about trust that another program wrote, when the vault has opened: none counts."""
        self._broken_trust = tuple(
            record.name for record in self.trust_rows() if not self._row_macs.holds(record.mac, "trust", _bound(record))
        )
        if self._broken_trust:
            names = ", ".join(self._broken_trust[:_SHOWN])
            self._notify(f"Trust in {names} was changed by another program and does not count.")
        strange = [
            name for name, mac, kind, values in self.decision_rows() if not self._row_macs.holds(mac, kind, values)
        ]
        if strange:
            self._notify(f"Another program added {', '.join(strange[:_SHOWN])}, which does not count.")

    def mac_rows(self, _sample: RowSample | None = None) -> Iterator[MacRow]:
        """Yield every trusted key, for a check of its MAC."""
        for record in self.trust_rows():
            yield f"trust in {record.name}", record.mac, "trust", _bound(record)

    def decision_rows(self, _sample: RowSample | None = None) -> Iterator[MacRow]:
        """Yield the bans that a person lifted and the CAs whose trust one ended, for a check of their MACs."""
        for statement, mac in self.lifted().items():
            yield f"the lifting of ban {statement[:_DIGITS]}", mac, "lifted", (statement,)
        for ca, mac in self.ended_cas().items():
            yield f"the end of trust in CA {ca[:_DIGITS]}", mac, "ended ca", (ca,)


def _bound(record: TrustRecord) -> Values:
    return (record.name, record.role, record.point, record.fingerprint)


def _digest(statement: str) -> str:
    return hashlib.sha256(statement.encode()).hexdigest()
