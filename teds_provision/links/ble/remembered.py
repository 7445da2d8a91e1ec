"""Which node was met at which Bluetooth address, kept from command to command (operation.md section 7). A hint.

A node keeps its address until it is reset, so a node that is named is looked for there first, and twenty others are
not asked. The file lies in the user's cache folder; a cache that cannot be read or written harms nothing.
"""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Final

from teds_provision.errors import TedsProvisionError
from teds_provision.files import read_limited, whole_file
from teds_provision.protocol.messages.identity import Identity

FILE: Final = "ble-addresses.json"
MOST: Final = 10_000
_MOST_OCTETS: Final = 4 << 20


def cache_file() -> Path:
    """Where it lies: ``~/.cache/teds-provision/ble-addresses.json`` unless XDG_CACHE_HOME says otherwise."""
    from platformdirs import user_cache_path

    return user_cache_path("teds-provision") / FILE


class Remembered:
    """Identify of nodes by address, the newest last; :meth:`save` keeps what was learnt."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._known: dict[str, Identity] = {}
        self._changed = False
        with suppress(OSError, ValueError, TypeError, AttributeError, TedsProvisionError):
            said = json.loads(read_limited(path, _MOST_OCTETS, "cache"))
            self._known = {address: Identity.decode(bytes.fromhex(octets)) for address, octets in said.items()}

    def items(self) -> list[tuple[str, Identity]]:
        """Every address and who was there, the newest first."""
        return list(reversed(self._known.items()))

    def learn(self, address: str, identity: Identity) -> None:
        """A node was met; an address at which it was before is forgotten."""
        others = {at: one for at, one in self._known.items() if at != address and one.uuid != identity.uuid}
        self._changed = self._changed or self._known.get(address) is None or len(others) + 1 != len(self._known)
        self._known = {**others, address: identity}

    def save(self) -> None:
        """Write it, where something is new; never raises."""
        if not self._changed:
            return
        kept = list(self._known.items())[-MOST:]
        with suppress(OSError):
            self._path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            with whole_file(self._path, replace=True) as file:
                file.write(json.dumps({address: identity.encode().hex() for address, identity in kept}).encode())
            self._changed = False
