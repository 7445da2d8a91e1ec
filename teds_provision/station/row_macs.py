"""MACs over the rows that decide whom this station trusts: own key and CA, trust, pins, CAs of nodes, bans.

A program that can write the store's file can change rows in it, but cannot make their MAC: HMAC-SHA-256 (RFC 2104), cut
to 16 octets, under a key of 32 octets that the vault wraps. A MAC binds a row's kind and values to this store. When the
vault opens, the station's own facts and the trusted keys are checked; a pin, or the CA of a node, when it is used;
everything by ``doctor``. A row with a wrong MAC is reported and ignored.

Not promised: a row that this station once made and removed since can be put back, and a row can be removed.
"""

from __future__ import annotations

import hmac
import os
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from teds_provision.errors import StoreChangedError, VaultError
from teds_provision.station.store import (
    ExportEligibility,
    FirmwareRecord,
    NodeRecord,
    StationRecord,
    Store,
    TrustRecord,
    WhitelistEntry,
)

if TYPE_CHECKING:
    from teds_provision.vault import Vault
    from teds_provision.vault.master import MasterKeys

SEAL_OCTETS = 16
_KEY_OCTETS = 32
_SHOWN = 5
_DIGITS = 16
_Values = tuple[str | bytes | None, ...]
MacRow = tuple[str, bytes | None, str, _Values]
"""A row with a MAC: its name for people, its MAC, the kind and the values that the MAC is over."""


class RowMacs:
    """Makes and checks the MACs of one store; ``vault`` opens the vault, ``tell`` gets a sentence for the user."""

    def __init__(self, store: Store, vault: Callable[[], Vault], tell: Callable[[str], object]) -> None:
        self._store = store
        self._vault = vault
        self._tell = tell
        self._keyed: hmac.HMAC | None = None
        self.broken_trust: tuple[str, ...] = ()
        """Names of trusted keys whose seal does not hold; they do not count."""
        self.sources: list[Callable[[], Iterator[MacRow]]] = []
        """Of each topic, its rows with a MAC: what doctor checks."""

    @property
    def active(self) -> bool:
        """True if the vault was opened, so that MACs can be made and checked without asking."""
        return self._keyed is not None

    def require(self) -> None:
        """Open the vault if it is not open yet: what decides whom the station believes is changed by its owner only."""
        self._vault()

    # -- making ----------------------------------------------------------------------------------------------------

    def facts(self, facts: StationRecord) -> StationRecord:
        """Return the station's facts with their MAC, and a MAC key if there is none yet."""
        if facts.seal_key is None:
            key = os.urandom(_KEY_OCTETS)
            facts = replace(facts, seal_key=self._vault().wrap(key, context=self._context()))
            self._keyed = _keyed(key)
        return replace(facts, mac=self._mac("station", _facts(facts)))

    def entry(self, entry: WhitelistEntry) -> WhitelistEntry:
        """Return a whitelist entry with its MAC."""
        return replace(entry, mac=self.of_entry(entry))

    def of_entry(self, entry: WhitelistEntry) -> bytes:
        """Return the MAC of a whitelist entry."""
        return self._mac("whitelist", _entry(entry))

    def trust(self, record: TrustRecord) -> TrustRecord:
        """Return a trusted key with its MAC."""
        return replace(record, mac=self._mac("trust", _trust(record)))

    def point(self, uuid: bytes, point: bytes) -> bytes | None:
        """Return the MAC of a node's identity key; None, and so only a hint, as long as the vault is closed."""
        return self._mac("node", (uuid, point)) if self.active else None

    def ca(self, uuid: bytes, ca: bytes) -> bytes:
        """Return the MAC of the CA that a node keeps."""
        return self._mac("ca", (uuid, ca))

    def firmware(self, record: FirmwareRecord) -> FirmwareRecord:
        """Return a firmware report with its MAC; without one, and so only a hint, as long as the vault is closed."""
        return replace(record, mac=self._mac("firmware", _firmware(record)) if self.active else None)

    def note(self, kind: str, name: str) -> bytes:
        """Return the MAC of an operator's decision: ``lifted`` (a ban), ``ended ca`` (trust in a CA of a bundle)."""
        return self._mac(kind, (name,))

    # -- checking --------------------------------------------------------------------------------------------------

    def check_entry(self, entry: WhitelistEntry | None) -> WhitelistEntry | None:
        """Return a whitelist entry.

        Raises StoreChangedError if its seal does not hold. Unchecked with a closed vault.
        """
        if entry is not None and self.active and not self._holds(entry.mac, "whitelist", _entry(entry)):
            raise changed(
                [f"the whitelist entry of {entry.uuid.hex()}"], "Remove it from the whitelist and add it again."
            )
        return entry

    def check_point(self, node: NodeRecord | ExportEligibility) -> None:
        """Raise StoreChangedError if a node's identity key with a MAC was changed."""
        bad = node.point is not None and node.point_mac is not None
        if bad and self.active and not self._holds(node.point_mac, "node", (node.uuid, node.point)):
            remove = f"teds-provision whitelist remove {node.uuid.hex()}, then tap the node."
            raise changed([f"the key of node {node.uuid.hex()}"], remove)

    def check_ca(self, uuid: bytes, ca: bytes, mac: bytes | None) -> None:
        """Raise StoreChangedError if the CA that a node keeps is not the recorded one."""
        if self.active and not self._holds(mac, "ca", (uuid, ca)):
            raise changed(
                [f"the CA of node {uuid.hex()}"], "Restore a backup, or reset the node and agree on a new key."
            )

    def reported(self, record: FirmwareRecord) -> bool:
        """Return True if a firmware report counts: its MAC is right, or the vault is closed, or it is a hint anyway."""
        return not self.active or not record.in_session or self._holds(record.mac, "firmware", _firmware(record))

    def trusted(self, record: TrustRecord) -> bool:
        """Return True if a trusted key counts: its MAC is right, or the vault is closed and it cannot be checked."""
        return not self.active or record.name not in self.broken_trust

    def noted(self, kind: str, name: str, mac: bytes | None) -> bool:
        """Return True if an operator's decision counts.

        Its MAC is right, or the vault is closed and it cannot be checked.
        """
        return not self.active or self._holds(mac, kind, (name,))

    def all_broken(self) -> Iterator[str]:
        """Name every row whose seal does not hold (the vault is open), for doctor."""
        for name, mac, kind, values in self._sealed_rows():
            if not self._holds(mac, kind, values):
                yield name

    def _sealed_rows(self) -> Iterator[MacRow]:
        """Every row that must have a seal: its name, its seal, the kind and the values that the seal is over."""
        facts = self._store.facts()
        if facts is not None:
            yield "the station's own key and CA", facts.mac, "station", _facts(facts)
        for record in self._store.trusted():
            yield f"trust in {record.name}", record.mac, "trust", _trust(record)
        for entry in self._store.whitelist():
            yield f"the whitelist entry of {entry.uuid.hex()}", entry.mac, "whitelist", _entry(entry)
        for node in self._store.nodes():
            if node.point is not None and node.point_mac is not None:
                yield f"the key of node {node.uuid.hex()}", node.point_mac, "node", (node.uuid, node.point)
        for uuid, marks in self._store.all_key_flags().items():
            if marks.ca is not None:
                yield f"the CA of node {uuid.hex()}", marks.ca_mac, "ca", (uuid, marks.ca)
        for reported in self._store.all_firmware():
            if reported.in_session:
                yield f"the firmware report of {reported.uuid.hex()}", reported.mac, "firmware", _firmware(reported)
        yield from self._decisions()
        for rows in self.sources:
            yield from rows()

    def _decisions(self) -> Iterator[MacRow]:
        for statement, mac in self._store.lifted().items():
            yield f"the lifting of ban {statement[:_DIGITS]}", mac, "lifted", (statement,)
        for ca, mac in self._store.ended_cas().items():
            yield f"the end of trust in CA {ca[:_DIGITS]}", mac, "ended ca", (ca,)

    # -- when the vault opens --------------------------------------------------------------------------------------

    def opened_by(self, masters: MasterKeys) -> bool:
        """Return True if these master keys open the MAC key, and it is the one that is in use here."""
        facts = self._store.facts()
        if facts is None or facts.seal_key is None or self._keyed is None:
            return False
        try:
            key = masters.unwrap(facts.seal_key, context=self._context())
        except VaultError:
            return False
        return hmac.compare_digest(_keyed(key).digest(), self._keyed.digest())

    def unlocked(self, vault: Vault) -> None:
        """Check the station's own facts and its trust when the vault has opened.

        Raises StoreChangedError if the station's own key or CA differs from what this station wrote, VaultError.
        """
        facts = self._store.facts()
        if facts is None:
            return
        if facts.seal_key is not None:
            self._keyed = _keyed(vault.unwrap(facts.seal_key, context=self._context()))
        if facts.seal_key is None or not self._holds(facts.mac, "station", _facts(facts)):
            raise changed(
                ["the station's own key or CA"],
                "Move store.sqlite3 away, then restore a backup: teds-provision restore FILE",
            )
        self._look_at_trust()

    def _look_at_trust(self) -> None:
        """Find and report trust rows that another program wrote: none of them counts."""
        self.broken_trust = tuple(
            record.name for record in self._store.trusted() if not self._holds(record.mac, "trust", _trust(record))
        )
        if self.broken_trust:
            names = ", ".join(self.broken_trust[:_SHOWN])
            self._tell(f"Trust in {names} was changed by another program and does not count.")
        strange = [name for name, mac, kind, values in self._decisions() if not self._holds(mac, kind, values)]
        if strange:
            self._tell(f"Another program added {', '.join(strange[:_SHOWN])}, which does not count.")

    def rewrap(self, vault: Vault) -> None:
        """Wrap the seal key under the vault's newest master key; the seals stay as they are."""
        facts = self._store.facts()
        if facts is not None and facts.seal_key is not None:
            key = vault.unwrap(facts.seal_key, context=self._context())
            self._store.put_facts(replace(facts, seal_key=vault.wrap(key, context=self._context())))

    # -- the MAC itself --------------------------------------------------------------------------------------------

    def _context(self) -> bytes:
        return b"TEDS1 seal key\0" + self._store.id.encode()

    def _mac(self, kind: str, values: _Values) -> bytes:
        if self._keyed is None:
            self.require()
        assert self._keyed is not None
        whole = kind.encode() + b"\0"  # in one piece: there may be 100,000
        for value in values:
            if value is None:  # not the empty text: a length that no value has
                whole += b"\xff\xff\xff\xff"
            else:
                octets = value if isinstance(value, bytes) else value.encode()
                whole += len(octets).to_bytes(4, "big") + octets
        mac = self._keyed.copy()
        mac.update(whole)
        return mac.digest()[:SEAL_OCTETS]

    def _holds(self, mac: bytes | None, kind: str, values: _Values) -> bool:
        return mac is not None and hmac.compare_digest(mac, self._mac(kind, values))


def _keyed(key: bytes) -> hmac.HMAC:
    """HMAC that has taken its key in: half of what a short one costs, and a handover makes two for each node."""
    return hmac.new(key, digestmod="sha256")


def _facts(facts: StationRecord) -> _Values:
    # The last is the column taken_over, which is no longer written: seals that were made over it go on holding.
    return (facts.requested, facts.point, facts.ca, facts.signature, None)


def _entry(entry: WhitelistEntry) -> _Values:
    return (entry.uuid, entry.fingerprint, entry.assurance, entry.name)


def _firmware(record: FirmwareRecord) -> _Values:
    return (record.uuid, record.report, str(int(record.in_session)), record.at, record.signed)


def _trust(record: TrustRecord) -> _Values:
    return (record.name, record.role, record.point, record.fingerprint)


def changed(what: list[str], cure: str) -> StoreChangedError:
    """Return the error for rows that another program changed."""
    shown = ", ".join(what[:_SHOWN]) + (f" and {len(what) - _SHOWN} more" if len(what) > _SHOWN else "")
    return StoreChangedError(f"{shown} in the store was changed by another program and is not trusted.", hint=cure)
