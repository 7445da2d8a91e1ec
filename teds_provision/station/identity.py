"""The identity of this station: its name, its key, its owner's CA, and the signatures of CAs over station keys."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import fields, replace

from teds_provision.errors import NotAuthenticError, NotFoundError, PolicyError, VaultError
from teds_provision.protocol import keys
from teds_provision.station.row_macs import KEY_OCTETS, MacRow, RowMacs, Values, changed
from teds_provision.station.store.database import places
from teds_provision.station.store.records import StationRecord
from teds_provision.station.store.row_sample import RowSample
from teds_provision.station.store.store import Store
from teds_provision.vault.base import Vault
from teds_provision.vault.master import MasterKeys

DEFAULT_NAME = "station"
_FACTS = ", ".join(column.name for column in fields(StationRecord))


class StationIdentity:
    """The facts of one station, and the certificates (SIG104) that it knows; secrets come from the vault."""

    def __init__(self, store: Store, vault: Callable[[], Vault], row_macs: RowMacs) -> None:
        self._store = store
        self._vault = vault
        self._row_macs = row_macs
        self._seen: tuple[tuple[int, int], StationRecord | None] | None = None

    # -- facts -----------------------------------------------------------------------------------------------------

    def record(self) -> StationRecord | None:
        """Return what the station knows of itself, None before init made anything.

        Every step asks for it again and again, so it is read once for each state of the file.
        """
        state = self._store.state()
        if self._seen is None or self._seen[0] != state:
            self._seen = state, self._store.read_one(StationRecord, f"SELECT {_FACTS} FROM station")
        return self._seen[1]

    def put(self, record: StationRecord) -> None:
        """Keep the station's facts, all of them, with the MAC that they have."""
        self._seen = None
        values = tuple(getattr(record, column.name) for column in fields(StationRecord))
        self._store.execute(f"INSERT OR REPLACE INTO station(one, {_FACTS}) VALUES(1, {places(values)})", values)

    def _with_mac(self, record: StationRecord) -> StationRecord:
        """Return the facts with their MAC, and a MAC key if there is none yet."""
        if record.seal_key is None:
            key = os.urandom(KEY_OCTETS)
            record = replace(record, seal_key=self._vault().wrap(key, context=self._context()))
            self._row_macs.use(key)
        return replace(record, mac=self._row_macs.mac("station", _bound(record)))

    def is_complete(self) -> bool:
        """Return True if init was finished: a key, a CA and its signature are there."""
        facts = self.record()
        return facts is not None and facts.point is not None

    @property
    def requested(self) -> bytes | None:
        """P(base station) for which a certificate was requested, None if none was."""
        facts = self.record()
        return facts.requested if facts is not None else None

    def establish(self, name: str | None, keystore: str, keystore_why: str, *, requested: bytes | None = None) -> None:
        """Store where the secrets of a new station are, and the key for which it requests a certificate, if it does."""
        self.put(self._with_mac(StationRecord(name or DEFAULT_NAME, keystore, keystore_why, requested)))

    def complete(self, point: bytes, ca: bytes, signature: bytes) -> None:
        """Keep the station's key, its owner's CA and SIG104: init is finished."""
        self._row_macs.require()
        self.put(self._with_mac(replace(self._facts, point=point, ca=ca, signature=signature)))

    @property
    def _facts(self) -> StationRecord:
        facts = self.record()
        if facts is None:
            raise NotFoundError(
                f"There is no base station in {self._store.home} yet.", hint="To create one: teds-provision init"
            )
        return facts

    def _required(self, value: bytes | None) -> bytes:
        if value is None:
            raise NotFoundError(
                f"init was not finished in {self._store.home}.", hint="To finish it: teds-provision init"
            )
        return value

    @property
    def name(self) -> str:
        """The station's name."""
        return self._facts.name

    @property
    def point(self) -> bytes:
        """P(base station), 65 octets."""
        return self._required(self._facts.point)

    @property
    def fingerprint(self) -> str:
        """Fingerprint of the station's key."""
        return keys.fingerprint(self.point)

    @property
    def ca(self) -> bytes:
        """P(CA) of the owner, 65 octets."""
        return self._required(self._facts.ca)

    @property
    def signature(self) -> bytes:
        """SIG104: the CA's signature over the station's key, 64 octets."""
        return self._required(self._facts.signature)

    @property
    def keystore(self) -> str:
        """Keystore of the secrets: ``keyring``, ``file`` or a ``pkcs11:`` URI."""
        return self._facts.keystore

    @property
    def keystore_why(self) -> str:
        """Why init chose this keystore, in words."""
        return self._facts.keystore_why

    @property
    def rewrapping(self) -> int | None:
        """Number of the next master key during a change, None if no change is in progress."""
        return self._facts.rewrapping

    @property
    def master(self) -> int:
        """Number of the master key that wraps link keys now, 1 if it was never changed."""
        return self._facts.master

    def begin_rewrapping(self, number: int) -> None:
        """Have every process wrap under this master key from now on."""
        with self._store.transaction():
            self.put(replace(self._facts, master=number, rewrapping=number))

    def end_rewrapping(self) -> None:
        """Note that no key is wrapped under an older master key any more."""
        with self._store.transaction():
            self.put(replace(self._facts, rewrapping=None))

    # -- the key of row MACs, available once the vault is open -------------------------------------------------------

    def unlocked(self, vault: Vault) -> None:
        """Check the station's own facts when the vault has opened; row MACs are checked from now on.

        Raises StoreChangedError if the station's own key or CA differs from what this station wrote, VaultError.
        """
        record = self.record()
        if record is None:
            return
        if record.seal_key is not None:
            self._row_macs.use(vault.unwrap(record.seal_key, context=self._context()))
        if record.seal_key is None or not self._row_macs.holds(record.mac, "station", _bound(record)):
            raise changed(
                ["the station's own key or CA"],
                "Move store.sqlite3 away, then restore a backup: teds-provision restore FILE",
            )

    def opened_by(self, masters: MasterKeys) -> bool:
        """Return True if these master keys open the MAC key, and it is the one that is in use here."""
        record = self.record()
        if record is None or record.seal_key is None or not self._row_macs.active:
            return False
        try:
            key = masters.unwrap(record.seal_key, context=self._context())
        except VaultError:
            return False
        return self._row_macs.is_key(key)

    def rewrap(self, vault: Vault) -> None:
        """Wrap the MAC key under the vault's newest master key; the MACs stay as they are."""
        record = self.record()
        if record is not None and record.seal_key is not None:
            key = vault.unwrap(record.seal_key, context=self._context())
            self.put(replace(record, seal_key=vault.wrap(key, context=self._context())))

    def _context(self) -> bytes:
        return b"TEDS1 seal key\0" + self._store.id.encode()

    def mac_rows(self, _sample: RowSample) -> Iterator[MacRow]:
        """Yield the station's own row, for a check of its MAC."""
        record = self.record()
        if record is not None:
            yield "the station's own key and CA", record.mac, "station", _bound(record)

    # -- certificates ----------------------------------------------------------------------------------------------

    def certify(self, point: bytes) -> bytes:
        """Return SIG104 of this owner's CA over another station's key.

        Raises NotFoundError if the CA key is not here.
        """
        ca = self._vault().ca()
        if ca is None or ca.point != self.ca:
            raise NotFoundError("The CA key is not in this vault.", hint="Run this on the station that has the CA key.")
        return ca.sign(keys.station_key_message(point))

    def certificate(self, ca: bytes, point: bytes) -> bytes | None:
        """Return SIG104 of ``ca`` over a station's key if it is known here, else None."""
        return self._certificate(self._facts, ca, point)

    def _certificate(self, facts: StationRecord, ca: bytes, point: bytes) -> bytes | None:
        if (ca, point) == (facts.ca, facts.point):
            return self._required(facts.signature)
        row = self._store.first_row(
            "SELECT signature FROM certificates WHERE ca = ? AND station = ?",
            (keys.fingerprint(ca), keys.fingerprint(point)),
        )
        return None if row is None else bytes(row[0])

    def certificates(self) -> dict[tuple[str, str], bytes]:
        """Return every SIG104, by the fingerprints of CA and station."""
        rows = self._store.execute("SELECT ca, station, signature FROM certificates")
        return {(str(ca), str(station)): bytes(signature) for ca, station, signature in rows}

    def put_certificate(self, ca: str, station: str, signature: bytes) -> None:
        """Keep a SIG104, by the fingerprints of CA and station; the caller has verified it."""
        self._store.execute("INSERT OR REPLACE INTO certificates VALUES(?, ?, ?)", (ca, station, signature))

    def keep_certificate(self, ca: bytes, point: bytes, signature: bytes) -> None:
        """Keep a SIG104; raises NotAuthenticError if it does not verify."""
        if not keys.verify(ca, keys.station_key_message(point), signature):
            raise NotAuthenticError(
                f"The CA {keys.fingerprint(ca)[:16]} did not sign the station {keys.fingerprint(point)[:16]}."
            )
        if self.certificate(ca, point) is None:
            self.put_certificate(keys.fingerprint(ca), keys.fingerprint(point), signature)

    def signature_under(self, ca: bytes) -> bytes:
        """Return SIG104 of ``ca`` over this station's key; raises PolicyError if there is none."""
        facts = self._facts
        signature = self._certificate(facts, ca, self._required(facts.point))
        if signature is None:
            raise PolicyError(
                f"This station is not certified by the CA {keys.fingerprint(ca)[:16]}.",
                hint="Have it signed on the station with that CA key: teds-provision trust ca sign REQUEST",
            )
        return signature

    def credentials(self, ca: bytes | None = None) -> keys.Credentials:
        """Return the credentials that the station shows under ``ca``, by default the owner's."""
        under = self.ca if ca is None else ca
        return keys.Credentials(self._vault().identity(), self.signature_under(under), under)


def _bound(record: StationRecord) -> Values:
    # The last value was the column taken_over, which is no longer written; with None, older MACs still verify.
    return (record.requested, record.point, record.ca, record.signature, None)
