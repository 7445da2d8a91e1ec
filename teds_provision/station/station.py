"""The base station on this machine: public facts from the store, secrets from the vault when they are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from teds_provision.errors import (
    NoKeyring,
    NotAuthentic,
    NotFound,
    NotWhitelisted,
    PolicyRefused,
    VaultFailure,
    WrongPassphrase,
)
from teds_provision.protocol.agreement import Credentials, other_key
from teds_provision.protocol.keys import fingerprint, station_key_message, verify
from teds_provision.store import KeyRecord, NodeRecord, Store, StoreLock, WhitelistEntry, utc_now
from teds_provision.store.records import KeySource

if TYPE_CHECKING:
    from teds_provision.vault import Ask, Vault

DEFAULT_NAME = "station"
CA_OF, NEXT_CA, ROTATION = "ca-of:", "next-ca:", "rotate:"
"""Names of settings by node (UUID in hex follows): the CA key that it keeps, the one that it keeps if a pending key
(``keyId:P(CA)``, both hex) turns out to be good, and why a rotation is due."""


@dataclass(frozen=True)
class NodeKey:
    """One unwrapped link key that this station holds for a node."""

    record: KeyRecord
    key: bytes

    def __repr__(self) -> str:
        return f"NodeKey({self.record.key_id}, {self.record.state})"


class Station:
    """A base station (NCAP) on this machine. Opening it reads the store only; the vault opens at the first key."""

    def __init__(self, store: Store, ask: Ask) -> None:
        self.store = store
        self._ask = ask
        self._vault: Vault | None = None

    @classmethod
    def open(cls, home: Path, *, ask: Ask) -> Station:
        """Open the station of ``home``; raises NotFound where init was never finished."""
        if not (home / "store.sqlite3").exists():
            raise not_initialised(home)
        station = cls(Store.open(home), ask)
        if station.store.setting("station_point") is None:
            asked = station.store.setting("requested_point") is not None
            station.close()
            raise not_certified() if asked else not_initialised(home)
        return station

    def close(self) -> None:
        """Close the store."""
        self.store.close()

    # -- public facts ----------------------------------------------------------------------------------------------

    def _fact(self, name: str) -> str:
        value = self.store.setting(name)
        if value is None:
            raise not_initialised(self.store.home)
        return value

    @property
    def name(self) -> str:
        """The station's name."""
        return self._fact("station_name")

    @property
    def point(self) -> bytes:
        """P(base station), 65 octets."""
        return bytes.fromhex(self._fact("station_point"))

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the station's key."""
        return fingerprint(self.point)

    @property
    def ca(self) -> bytes:
        """P(CA) of the owner, 65 octets."""
        return bytes.fromhex(self._fact("ca_point"))

    @property
    def station_signature(self) -> bytes:
        """SIG104: the CA's signature over the station's key, 64 octets."""
        return bytes.fromhex(self._fact("station_signature"))

    @property
    def keystore(self) -> str:
        """Where the secrets lie: ``keyring``, ``file`` or a ``pkcs11:`` URI."""
        return self._fact("keystore")

    # -- secrets ---------------------------------------------------------------------------------------------------

    @property
    def vault(self) -> Vault:
        """The vault, unlocked at first use."""
        if self._vault is None:
            from teds_provision.vault import open_vault

            self._vault = open_vault(self.store.home, self.store.id, self.keystore, self._ask)
        return self._vault

    def unlock(self, uuid: bytes | None = None) -> None:
        """Open the vault now: nobody is asked for a passphrase while the store is locked or a node lies there.

        With ``uuid`` only where a key of that node is held, as nothing is unwrapped otherwise.
        """
        if uuid is None or self.has_keys(uuid):
            _ = self.vault

    def credentials(self, uuid: bytes | None = None) -> Credentials:
        """What the station shows and signs with: to node ``uuid`` under the CA that this node keeps, else its own."""
        ca = self.ca if uuid is None else self.ca_of(uuid)
        return Credentials(self.vault.identity(), self.signature_under(ca), ca)

    def certify(self, point: bytes) -> bytes:
        """SIG104 of this owner's CA over another station's key; raises NotFound where the CA key is not here."""
        ca = self.vault.ca()
        if ca is None or ca.point != self.ca:
            raise NotFound("The CA key is not in this vault.", hint="Do this where the CA key is kept.")
        return ca.sign(station_key_message(point))

    # -- CAs and their signatures over stations --------------------------------------------------------------------

    def ca_of(self, uuid: bytes) -> bytes:
        """P(CA) that a node keeps: the owner's, or that of the bundle in which the node's key came."""
        other = self.store.setting(_ca_setting(uuid))
        return bytes.fromhex(other) if other else self.ca

    def cas_of_nodes(self) -> dict[bytes, bytes]:
        """P(CA) of every node that keeps another CA than the owner's."""
        return {bytes.fromhex(uuid): bytes.fromhex(ca) for uuid, ca in self.store.settings(CA_OF).items() if ca}

    def set_ca_of(self, uuid: bytes, ca: bytes) -> None:
        """Note which CA a node keeps."""
        if ca != self.ca_of(uuid):
            self.store.set_setting(_ca_setting(uuid), "" if ca == self.ca else ca.hex())

    def promote(self, uuid: bytes, key_id: str) -> None:
        """Make a key the active one after a good Open under it; its CA is then the one that the node keeps."""
        with self.store.transaction():
            self.store.promote_key(uuid, key_id)
            named, _, ca = (self.store.setting(NEXT_CA + uuid.hex()) or "").partition(":")
            if named:
                self.store.set_setting(NEXT_CA + uuid.hex(), "")
            if named == key_id:
                self.set_ca_of(uuid, bytes.fromhex(ca))

    def certificate(self, ca: bytes, point: bytes) -> bytes | None:
        """SIG104 of ``ca`` over a station's key as far as it is known here."""
        if (ca, point) == (self.ca, self.point):
            return self.station_signature
        known = self.store.setting(_certificate_setting(ca, point))
        return bytes.fromhex(known) if known else None

    def keep_certificate(self, ca: bytes, point: bytes, signature: bytes) -> None:
        """Keep a SIG104; raises NotAuthentic where it does not verify."""
        if not verify(ca, station_key_message(point), signature):
            raise NotAuthentic(f"The CA {fingerprint(ca)[:16]} did not sign the station {fingerprint(point)[:16]}.")
        if self.certificate(ca, point) is None:
            self.store.set_setting(_certificate_setting(ca, point), signature.hex())

    def signature_under(self, ca: bytes) -> bytes:
        """SIG104 of ``ca`` over this station's key; raises PolicyRefused where there is none."""
        signature = self.certificate(ca, self.point)
        if signature is None:
            raise PolicyRefused(
                f"This station is not certified by the CA {fingerprint(ca)[:16]}.",
                hint="Have it signed where that CA key is kept: teds-provision trust ca sign REQUEST",
            )
        return signature

    # -- link keys -------------------------------------------------------------------------------------------------

    def node_keys(self, uuid: bytes) -> Iterator[NodeKey]:
        """Every key held for a node, in the order of trying: newest pending first, the active one last.

        One that cannot be unwrapped does not hide the others; VaultFailure comes after the last.
        """
        damaged: VaultFailure | None = None
        for record in self.store.keys(uuid):
            try:
                key = self.unwrap(record)
            except (WrongPassphrase, NoKeyring):
                raise
            except VaultFailure as failure:
                damaged = failure
                continue
            yield NodeKey(record, key)
        if damaged is not None:
            raise damaged

    def has_keys(self, uuid: bytes) -> bool:
        """Whether any key is held for a node."""
        return bool(self.store.keys(uuid))

    def active_epoch(self, uuid: bytes) -> int:
        """Epoch of the current (active) key of a node, 0 for none."""
        return next((record.epoch for record in self.store.keys(uuid) if record.state == "active"), 0)

    def add_pending(self, uuid: bytes, *, key: bytes, key_id: bytes, epoch: int, imported: bool = False) -> None:
        """Store a new key durably as pending; nothing else is touched."""
        with self.store.transaction():
            slot = self.store.next_slot(uuid)
            source: KeySource = "import" if imported else "agreement"
            self.store.add_key(
                self.wrapped(uuid, key=key, key_id=key_id, epoch=epoch, slot=slot, source=source, created=utc_now())
            )

    def wrapped(
        self, uuid: bytes, *, key: bytes, key_id: bytes, epoch: int, slot: int, source: KeySource, created: str
    ) -> KeyRecord:
        """Return the record of a new pending key in a slot that the node never had."""
        from teds_provision.vault import node_key_context

        context = node_key_context(self.store.id, uuid, epoch, slot)
        sealed = self.vault.wrap(key, context=context)
        return KeyRecord(uuid, epoch, key_id.hex(), "pending", slot, sealed, source, created)

    def unwrap(self, record: KeyRecord) -> bytes:
        """Return a link key in the clear; raises VaultFailure where it is damaged or of another vault."""
        from teds_provision.vault import node_key_context

        context = node_key_context(self.store.id, record.uuid, record.epoch, record.slot)
        return self.vault.unwrap(record.wrapped, context=context)

    # -- trust -----------------------------------------------------------------------------------------------------

    def trusted_cas(self, uuid: bytes | None = None) -> list[bytes]:
        """CA keys that count here: the owner's, those added, and for one node that of the bundle it came in."""
        cas = [self.ca, *(record.point for record in self.store.trusted() if record.role == "ca")]
        return cas if uuid is None or self.ca_of(uuid) in cas else [*cas, self.ca_of(uuid)]

    def trusted_stations(self) -> list[bytes]:
        """Station keys that count here: its own, and those added."""
        return [self.point, *(record.point for record in self.store.trusted() if record.role == "station")]

    def require_whitelisted(self, uuid: bytes, *, returning: bool = False) -> WhitelistEntry:
        """Return the whitelist entry; raises NotWhitelisted, or PolicyRefused for a revoked node or one given away.

        ``returning``: a node given away may come back here, if a key agreement shows that it was reset.
        """
        revoked = self.store.revocation(uuid)
        if revoked is not None:
            raise PolicyRefused(f"Node {uuid.hex()} was revoked: {revoked.why}.")
        if not returning:
            self.require_not_given_away(uuid)
        entry = self.store.whitelisted(uuid)
        if entry is None:
            raise NotWhitelisted(
                f"Node {uuid.hex()} is not on the whitelist.", hint=f"Add it: teds-provision whitelist add {uuid.hex()}"
            )
        return entry

    def require_not_given_away(self, uuid: bytes) -> None:
        """Raise PolicyRefused for a node that was moved to another station: its key is used no more."""
        tombstone = self.store.tombstone(uuid)
        if tombstone is None:
            return
        row = self.store.handover(tombstone.handover_id, "out")
        undo = f"Use it there, or: teds-provision handover undo {tombstone.handover_id}"
        back = "Use it there, or have it handed back (export-keys there, import-keys here)."
        raise PolicyRefused(
            f"Node {uuid.hex()} was moved to station {tombstone.to_fingerprint[:16]}; its key rests here.",
            hint=undo if row is not None and row.state == "open" else back,
        )

    def rotation_due(self, uuid: bytes) -> str | None:
        """Why the next session with a node has to rotate its key first; None where it has not."""
        return self.store.setting(_rotation_setting(uuid)) or None

    def demand_rotation(self, uuid: bytes, why: str) -> None:
        """Have the next session with a node rotate its key before anything else."""
        self.store.set_setting(_rotation_setting(uuid), why)

    def rotated(self, uuid: bytes) -> None:
        """Note that a node has a key that no other station holds."""
        if self.rotation_due(uuid):
            self.store.set_setting(_rotation_setting(uuid), "")
        for holder in self.store.holders(uuid):
            self.store.remove_holder(uuid, holder.fingerprint)

    def check_pin(self, uuid: bytes, point: bytes) -> None:
        """Raise OtherKey where this UUID is known with another key than ``point``."""
        entry, node = self.store.whitelisted(uuid), self.store.node(uuid)
        pinned = entry.fingerprint if entry is not None else None
        if pinned is None and node is not None and node.point is not None:
            pinned = fingerprint(node.point)
        if pinned is not None and pinned != fingerprint(point):
            self.audit("identify", uuid, "other key", shown=fingerprint(point), pinned=pinned)
            raise other_key(pinned, point)

    # -- what is known of nodes ------------------------------------------------------------------------------------

    def remember(self, uuid: bytes, **facts: object) -> NodeRecord:
        """Bring what is known of a node up to date and return it."""
        with self.store.transaction():  # no other process changes what was read before it is written
            present = self.store.node(uuid)
            changed = replace(present or NodeRecord(uuid), **facts)  # type: ignore[arg-type]
            if changed != present:
                self.store.put_node(changed)
        return changed

    def audit(self, act: str, uuid: bytes | None, outcome: str, **detail: object) -> None:
        """Append to the audit log: who did what to which node, with which outcome; never a secret."""
        self.store.audit.append(act, uuid, outcome, detail)

    def lock(self, command: str, notice: Callable[[str], object] | None = None) -> StoreLock:
        """One changing command at a time; waits, then says who holds the store."""
        return StoreLock(self.store.home, command=command, notice=notice)


def _ca_setting(uuid: bytes) -> str:
    return CA_OF + uuid.hex()


def _rotation_setting(uuid: bytes) -> str:
    return ROTATION + uuid.hex()


def _certificate_setting(ca: bytes, point: bytes) -> str:
    return f"certificate:{fingerprint(ca)}:{fingerprint(point)}"


def not_initialised(home: Path) -> NotFound:
    """The error for a home without a station."""
    return NotFound(f"There is no base station in {home} yet.", hint="Make one: teds-provision init")


def not_certified() -> NotFound:
    """The error for a station that asked for a certificate and has none yet."""
    return NotFound(
        "This station waits for the certificate of its CA.", hint="Bring it: teds-provision init --certificate CERT"
    )


def initialise(
    home: Path, *, name: str | None, keystore: str | None, ask: Ask, costs: object | None = None
) -> tuple[Station, str]:
    """Make the station key and the CA key, or open what an earlier run made; returns it and why this keystore.

    Each part is durable before the next begins, so that an interrupted init is carried on by the same command.
    """
    from teds_provision.vault import create_vault

    store = Store.open(home, create=True)
    station = Station(store, ask)
    if store.setting("station_point") is not None:
        return station, store.setting("keystore_why") or ""
    with StoreLock(home, command="init"):
        if store.setting("station_point") is not None:  # another init was first
            return station, store.setting("keystore_why") or ""
        if store.setting("requested_point") is not None:
            raise not_certified()
        more = {} if costs is None else {"costs": costs}
        vault, why = create_vault(home, store.id, keystore, ask, **more)  # type: ignore[arg-type]
        identity, ca = vault.identity(), vault.ca()
        if ca is None:
            raise NotFound("The vault holds no CA key.", hint="Choose another keystore, or bring the CA key back.")
        station._vault = vault
        facts = {
            "station_name": name or DEFAULT_NAME,
            "station_point": identity.point.hex(),
            "ca_point": ca.point.hex(),
            "station_signature": ca.sign(station_key_message(identity.point)).hex(),
            "keystore": keystore if keystore and keystore.startswith("pkcs11:") else vault.kind,
            "keystore_why": why,
        }
        with store.transaction():
            for fact, value in facts.items():
                store.set_setting(fact, value)
            store.audit.append(
                "init", None, "done", {"fingerprint": fingerprint(identity.point), "keystore": vault.kind}
            )
    return station, why
