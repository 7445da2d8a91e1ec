"""MACs over the rows that decide whom this station trusts: own key and CA, trust, pins, CAs of nodes, bans.

A program that can write the store's file can change rows in it, but cannot make their MAC: HMAC-SHA-256 (RFC 2104), cut
to 16 octets, under a key of 32 octets that the vault wraps. A MAC binds a row's kind and values to this store. When the
vault opens, the station's own facts and the trusted keys are checked; a pin, or the CA of a node, when it is used;
everything by ``doctor --full``. A row with a wrong MAC is reported and ignored.

Not promised: a row that this station once made and removed since can be put back, and a row can be removed.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Callable, Iterator
from typing import Final

from teds_provision.errors import StoreChangedError
from teds_provision.station.store.row_sample import RowSample
from teds_provision.vault.base import Vault

MAC_OCTETS: Final = 16
KEY_OCTETS: Final = 32
_BLOCK_OCTETS: Final = 64
_SHOWN = 5
Values = tuple[str | bytes | None, ...]
MacRow = tuple[str, bytes | None, str, Values]
"""A row with a MAC: its name for people, its MAC, the kind and the values that the MAC is over."""


class RowMacs:
    """Makes and checks the MACs of one store's rows; each topic knows which values of its rows are bound.

    ``vault`` opens the vault, and hands in the key (:meth:`use`).
    """

    def __init__(self, vault: Callable[[], Vault]) -> None:
        self._vault = vault
        self._keyed: _KeyedHash | None = None
        self.sources: tuple[Callable[[RowSample], Iterator[MacRow]], ...] = ()
        """Of each topic, those of its rows with a MAC that are in a sample: what doctor checks."""

    @property
    def active(self) -> bool:
        """True if the vault was opened, so that MACs can be made and checked without asking."""
        return self._keyed is not None

    def require(self) -> None:
        """Open the vault if it is not open yet: what decides whom the station believes is changed by its owner only."""
        self._vault()

    def use(self, key: bytes) -> None:
        """Make and check MACs with this key from now on."""
        self._keyed = _KeyedHash(key)

    def is_key(self, key: bytes) -> bool:
        """Return True if this is the key in use."""
        return self._keyed is not None and hmac.compare_digest(_KeyedHash(key).mac(b""), self._keyed.mac(b""))

    def mac(self, kind: str, values: Values) -> bytes:
        """Return the MAC of a row of this kind; the vault opens if it is closed."""
        if self._keyed is None:
            self.require()
        assert self._keyed is not None
        whole = kind.encode() + b"\0"  # concatenated at once for speed: there may be 100,000 rows
        for value in values:
            if value is None:  # marks None by a length that no value has, to distinguish it from ""
                whole += b"\xff\xff\xff\xff"
            else:
                octets = value if type(value) is bytes else value.encode()  # type: ignore[union-attr]
                whole += len(octets).to_bytes(4, "big") + octets
        return self._keyed.mac(whole)[:MAC_OCTETS]

    def holds(self, mac: bytes | None, kind: str, values: Values) -> bool:
        """Return True if this is the MAC of such a row."""
        return mac is not None and hmac.compare_digest(mac, self.mac(kind, values))

    def counts(self, mac: bytes | None, kind: str, values: Values) -> bool:
        """Return True if a row counts: its MAC is right, or the vault is closed and it cannot be checked."""
        if self._keyed is None:
            return True
        return mac is not None and hmac.compare_digest(mac, self.mac(kind, values))

    def note(self, kind: str, name: str) -> bytes:
        """Return the MAC of a decision, such as ``lifted`` (a ban), or ``ended ca`` (trust in a CA of a bundle)."""
        return self.mac(kind, (name,))

    def noted(self, kind: str, name: str, mac: bytes | None) -> bool:
        """Return True if a decision counts, as :meth:`counts`."""
        return self.counts(mac, kind, (name,))

    def all_broken(self, sample: RowSample | None = None) -> Iterator[str]:
        """Name every row with a MAC that does not hold (the vault is open), for doctor; with ``sample`` among those."""
        chosen = sample or RowSample(full=True)
        for rows in self.sources:
            for name, mac, kind, values in rows(chosen):
                if not self.holds(mac, kind, values):
                    yield name


class _KeyedHash:
    """HMAC-SHA-256 whose two hashes have absorbed the key: a handover makes two or three MACs a node.

    As RFC 2104 section 2 writes it: two thirds of the cost of a copied ``hmac.HMAC``, which is Python around the
    same two hashes.
    """

    __slots__ = ("_inner", "_outer")

    def __init__(self, key: bytes) -> None:
        assert len(key) <= _BLOCK_OCTETS
        padded = key.ljust(_BLOCK_OCTETS, b"\0")
        self._inner = hashlib.sha256(bytes(octet ^ 0x36 for octet in padded))
        self._outer = hashlib.sha256(bytes(octet ^ 0x5C for octet in padded))

    def mac(self, octets: bytes) -> bytes:
        """Return the MAC of these octets, 32 octets."""
        inner, outer = self._inner.copy(), self._outer.copy()
        inner.update(octets)
        outer.update(inner.digest())
        return outer.digest()


def changed(what: list[str], cure: str) -> StoreChangedError:
    """Return the error for rows that another program changed."""
    shown = ", ".join(what[:_SHOWN]) + (f" and {len(what) - _SHOWN} more" if len(what) > _SHOWN else "")
    return StoreChangedError(f"{shown} in the store was changed by another program and is not trusted.", hint=cure)
