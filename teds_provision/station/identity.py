"""Who this base station is: its name, its key, its owner's CA, and the signatures of CAs over station keys."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from teds_provision.errors import NotAuthenticError, NotFoundError, PolicyError
from teds_provision.lazy import late
from teds_provision.station.row_macs import RowMacs
from teds_provision.station.store import StationRecord, Store

if TYPE_CHECKING:
    from teds_provision.protocol import keys, wire_agreement
    from teds_provision.vault import Vault
else:  # cryptography: not for commands that only list
    wire_agreement, keys = late("teds_provision.protocol.wire_agreement"), late("teds_provision.protocol.keys")

DEFAULT_NAME = "station"


class StationIdentity:
    """The facts of one station, and the certificates (SIG104) that it knows; secrets come from the vault."""

    def __init__(self, store: Store, vault: Callable[[], Vault], seals: RowMacs) -> None:
        self._store = store
        self._vault = vault
        self._row_macs = seals

    # -- facts -----------------------------------------------------------------------------------------------------

    def is_complete(self) -> bool:
        """Return True if init was finished: a key, a CA and its signature are there."""
        facts = self._store.facts()
        return facts is not None and facts.point is not None

    @property
    def requested(self) -> bytes | None:
        """P(base station) for which a certificate was requested, None if none was."""
        facts = self._store.facts()
        return facts.requested if facts is not None else None

    def establish(self, name: str | None, keystore: str, keystore_why: str, *, requested: bytes | None = None) -> None:
        """Store where the secrets of a new station are, and the key for which it requests a certificate, if it does."""
        self._store.put_facts(
            self._row_macs.facts(StationRecord(name or DEFAULT_NAME, keystore, keystore_why, requested))
        )

    def complete(self, point: bytes, ca: bytes, signature: bytes) -> None:
        """Keep the station's key, its owner's CA and SIG104: init is finished."""
        self._row_macs.require()
        self._store.put_facts(self._row_macs.facts(replace(self._facts, point=point, ca=ca, signature=signature)))

    @property
    def _facts(self) -> StationRecord:
        facts = self._store.facts()
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
            self._store.put_facts(replace(self._facts, master=number, rewrapping=number))

    def end_rewrapping(self) -> None:
        """Note that no key is wrapped under an older master key any more."""
        with self._store.transaction():
            self._store.put_facts(replace(self._facts, rewrapping=None))

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
        """SIG104 of ``ca`` over a station's key as far as it is known here."""
        return self._certificate(self._facts, ca, point)

    def _certificate(self, facts: StationRecord, ca: bytes, point: bytes) -> bytes | None:
        if (ca, point) == (facts.ca, facts.point):
            return self._required(facts.signature)
        return self._store.certificate(keys.fingerprint(ca), keys.fingerprint(point))

    def keep_certificate(self, ca: bytes, point: bytes, signature: bytes) -> None:
        """Keep a SIG104; raises NotAuthenticError if it does not verify."""
        if not keys.verify(ca, keys.station_key_message(point), signature):
            raise NotAuthenticError(
                f"The CA {keys.fingerprint(ca)[:16]} did not sign the station {keys.fingerprint(point)[:16]}."
            )
        if self.certificate(ca, point) is None:
            self._store.put_certificate(keys.fingerprint(ca), keys.fingerprint(point), signature)

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

    def credentials(self, ca: bytes | None = None) -> wire_agreement.Credentials:
        """Return the credentials that the station shows under ``ca``, by default the owner's."""
        under = self.ca if ca is None else ca
        return wire_agreement.Credentials(self._vault().identity(), self.signature_under(under), under)
