"""The Bluetooth address of a virtual node: static random, new at each reset, kept in a file beside its flash."""

from __future__ import annotations

import json
import secrets
from pathlib import Path
from typing import Final

from teds_provision.errors import StoreError, TedsProvisionError
from teds_provision.files import read_limited, whole_file
from teds_provision.links.hints import BleAddress

FILE: Final = "ble.json"
_OCTETS: Final = 6
_STATIC: Final = 0xC0
"""The two highest bits of a static random address (Bluetooth Core, Vol 6 Part B, 1.3.2.1)."""


class StaticAddress:
    """The address of the node in ``folder``. :meth:`look` must see each change of the node's state.

    A node that was keyed when it was last seen and is in factory state now was reset: it gets another address, also if
    the power went in between.
    """

    def __init__(self, folder: Path, *, factory: bool) -> None:
        self._path = folder / FILE
        self._octets, self._keyed = self._read()
        if not self._octets:
            self._renew(keyed=not factory)
        self.look(factory=factory)

    @property
    def address(self) -> BleAddress:
        """The present address."""
        return BleAddress(self._octets, random=True)

    def look(self, *, factory: bool) -> bool:
        """Record the node's state; return True if the address has changed. Raises StoreError."""
        if self._keyed and factory:
            self._renew(keyed=False)
            return True
        if not self._keyed and not factory:
            self._write(self._octets, keyed=True)
        return False

    def _renew(self, *, keyed: bool) -> None:
        octets = secrets.token_bytes(_OCTETS)
        self._write(bytes((octets[0] | _STATIC,)) + octets[1:], keyed=keyed)

    def _write(self, octets: bytes, *, keyed: bool) -> None:
        try:
            with whole_file(self._path, replace=True) as file:
                file.write(json.dumps({"address": octets.hex(), "keyed": keyed}).encode())
        except OSError as error:
            raise StoreError(f"{self._path} cannot be written: {error.strerror}.") from error
        self._octets, self._keyed = octets, keyed

    def _read(self) -> tuple[bytes, bool]:
        """Return the content of the file; no address if there is none, or no valid one."""
        try:
            document = json.loads(read_limited(self._path, 4096, "address"))
            octets = bytes.fromhex(document["address"])
        except (TedsProvisionError, ValueError, LookupError, TypeError, RecursionError):
            return b"", False
        good = len(octets) == _OCTETS and octets[0] & _STATIC == _STATIC
        return (octets, bool(document.get("keyed"))) if good else (b"", False)
