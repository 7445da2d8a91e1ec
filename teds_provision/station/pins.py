"""Which identity key a UUID is pinned to, and which nodes are on the whitelist: the one place that decides it."""

from __future__ import annotations

from teds_provision.protocol.agreement import other_key
from teds_provision.protocol.keys import fingerprint
from teds_provision.station.node_keys import NodeKeys
from teds_provision.store import AuditLog, Store, WhitelistEntry


class Pins:
    """The whitelist, and the key of each UUID: by the whitelist, else from the first proven contact."""

    def __init__(self, store: Store, keys: NodeKeys, audit: AuditLog) -> None:
        self._store = store
        self._keys = keys
        self._audit = audit

    def pinned(self, uuid: bytes) -> str | None:
        """Fingerprint of the key that this UUID has to show, None where none is known yet."""
        entry = self._store.whitelisted(uuid)
        if entry is not None and entry.fingerprint is not None:
            return entry.fingerprint
        node = self._store.node(uuid)
        return fingerprint(node.point) if node is not None and node.point is not None else None

    def all(self) -> dict[bytes, str]:
        """Fingerprint of every pinned UUID."""
        pins = {node.uuid: fingerprint(node.point) for node in self._store.nodes() if node.point is not None}
        listed = {entry.uuid: entry.fingerprint for entry in self._store.whitelist() if entry.fingerprint is not None}
        return pins | listed

    def check(self, uuid: bytes, point: bytes) -> None:
        """Raise OtherKey where this UUID is known with another key than ``point``."""
        pinned = self.pinned(uuid)
        if pinned is not None and pinned != fingerprint(point):
            self._audit.append("identify", uuid, "other key", {"shown": fingerprint(point), "pinned": pinned})
            raise other_key(pinned, point)

    # -- the whitelist ---------------------------------------------------------------------------------------------

    def whitelist(self) -> list[WhitelistEntry]:
        """All entries, by UUID."""
        return self._store.whitelist()

    def entry(self, uuid: bytes) -> WhitelistEntry | None:
        """The whitelist entry of a node, None where it is not on it."""
        return self._store.whitelisted(uuid)

    def put(self, *entries: WhitelistEntry) -> None:
        """Add or replace entries of the whitelist; a key that is pinned stays: the caller has held it against it."""
        with self._store.transaction():
            for entry in entries:
                self._store.put_whitelist(entry)

    def remove(self, uuid: bytes) -> bool:
        """Take a node off the whitelist; False if it was not on it. A key from a contact stays pinned."""
        return self._store.remove_whitelist(uuid)

    # -- a board that was replaced under its UUID ------------------------------------------------------------------

    def let_go(self, uuid: bytes) -> None:
        """Forget the pinned key; the link keys that are held still belong to the board that had it."""
        pinned = self.pinned(uuid)
        if pinned is not None:
            self._keys.set_former(uuid, pinned)
            self._store.drop_draft(uuid)  # it may hold the old board's calibration
        self._store.unpin_node(uuid)

    def epoch_to_exceed(self, uuid: bytes, pinned: str | None) -> int:
        """Epoch that an agreement must exceed: the active key's, but 0 for a board that it was not agreed with."""
        former = self._keys.former(uuid)
        return 0 if former and pinned and former != pinned else self._keys.active_epoch(uuid)

    def settled(self, uuid: bytes) -> None:
        """A session is open: the key in use belongs to the board that lies there."""
        self._keys.set_former(uuid, None)
