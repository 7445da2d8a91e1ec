"""Who is trusted, and what was handed over (profile.md, "Handover between base stations")."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from shlex import quote
from typing import Any

from teds_provision.errors import PolicyError, UsageError
from teds_provision.station.store.database import Database, places
from teds_provision.station.store.records import (
    Direction,
    Handover,
    Holder,
    RevocationRecord,
    Tombstone,
    TrustRecord,
    utc_now,
)

_MIN_FINGERPRINT_PREFIX = 16  # what people are shown


class HandoverTables:
    """The part of the store that is about other stations; see :class:`teds_provision.station.store.Store`."""

    _database: Database

    def trusted(self) -> list[TrustRecord]:
        """Return every trusted station and CA, by name."""
        return list(self._database.recall(TrustRecord, "SELECT * FROM trust ORDER BY name"))

    def put_trust(self, record: TrustRecord) -> None:
        """Trust a key under a name; the same key and role under another name is renamed.

        Raises PolicyError if another key or role has the name: it must be removed first.
        """
        with self._database.together():
            row = self._database.one("SELECT fingerprint, role FROM trust WHERE name = ?", (record.name,))
            if row and row != (record.fingerprint, record.role):
                raise PolicyError(
                    f"The name {record.name!r} already stands for the {row[1]} {row[0][:16]}.",
                    hint=f"Choose another name, or run teds-provision trust remove {quote(record.name)} first.",
                )
            self._database.execute(
                "DELETE FROM trust WHERE fingerprint = ? AND role = ?", (record.fingerprint, record.role)
            )
            self._database.execute(
                "INSERT INTO trust VALUES(?, ?, ?, ?, ?, ?)",
                (record.name, record.role, record.point, record.fingerprint, record.added, record.mac),
            )

    def remove_trust(self, name_or_fingerprint: str) -> bool:
        """Trust a key no more, by its name, fingerprint, or at least 16 digits of it; False if none fits.

        Raises UsageError if the digits fit several keys.
        """
        digits = name_or_fingerprint.strip().lower()
        with self._database.together():
            if self._database.change("DELETE FROM trust WHERE name = ?", (name_or_fingerprint,)):
                return True
            if not re.fullmatch(f"[0-9a-f]{{{_MIN_FINGERPRINT_PREFIX},64}}", digits):
                return False
            found = self._database.execute(
                "SELECT DISTINCT fingerprint FROM trust WHERE substr(fingerprint, 1, ?) = ?", (len(digits), digits)
            )
            if len(found) > 1:
                raise UsageError(f"{digits} matches {len(found)} trusted keys.", hint="Give the whole fingerprint.")
            return bool(found) and self._database.change("DELETE FROM trust WHERE fingerprint = ?", found[0]) > 0

    def handovers(self) -> list[Handover]:
        """Return every bundle that left or came, oldest first."""
        return self._database.read(_handover, "SELECT * FROM handovers ORDER BY created, id")

    def handover(self, handover_id: str, direction: Direction) -> Handover | None:
        """Return one bundle."""
        return self._database.read_one(
            _handover, "SELECT * FROM handovers WHERE id = ? AND direction = ?", (handover_id, direction)
        )

    def put_handover(self, handover: Handover) -> None:
        """Add or replace a bundle."""
        self._database.execute(
            "INSERT OR REPLACE INTO handovers VALUES(?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                handover.id,
                handover.direction,
                handover.mode,
                json.dumps(list(handover.peers)),
                handover.state,
                handover.nodes,
                handover.bundle_sha256,
                handover.receipt,
                handover.created,
            ),
        )

    def remove_handover(self, handover_id: str, direction: Direction) -> bool:
        """Forget a bundle; False if there is none."""
        statement = "DELETE FROM handovers WHERE id = ? AND direction = ?"
        return self._database.change(statement, (handover_id, direction)) > 0

    def tombstones(self) -> list[Tombstone]:
        """Return every node that was given away, by UUID."""
        return self._database.read(Tombstone, "SELECT * FROM tombstones ORDER BY uuid")

    def tombstone(self, uuid: bytes) -> Tombstone | None:
        """Return the tombstone of a node that was given away, None if it was not."""
        return self._database.read_one(Tombstone, "SELECT * FROM tombstones WHERE uuid = ?", (uuid,))

    def put_tombstone(self, tombstone: Tombstone) -> None:
        """Note that a node was given away."""
        self._database.execute(
            "INSERT OR REPLACE INTO tombstones VALUES(?, ?, ?, ?)",
            (tombstone.uuid, tombstone.to_fingerprint, tombstone.handover_id, tombstone.created),
        )

    def holders(self, uuid: bytes | None = None) -> list[Holder]:
        """Return who else holds keys: of this node, or of all."""
        which, values = ("", ()) if uuid is None else ("WHERE uuid = ?", (uuid,))  # by the index: there may be 100,000
        return self._database.read(Holder, f"SELECT * FROM holders {which} ORDER BY uuid, since, fingerprint", values)

    def put_holder(self, holder: Holder) -> None:
        """Note that another station holds a key of this node."""
        self._database.execute(
            "INSERT OR REPLACE INTO holders VALUES(?, ?, ?, ?)",
            (holder.uuid, holder.fingerprint, holder.since, holder.mode),
        )

    def remove_holder(self, uuid: bytes, fingerprint: str) -> bool:
        """Note that a station holds it no more (a rotation); False if it was not noted."""
        statement = "DELETE FROM holders WHERE uuid = ? AND fingerprint = ?"
        return self._database.change(statement, (uuid, fingerprint)) > 0

    def revocations(self) -> list[RevocationRecord]:
        """Return the deny list, by UUID."""
        return self._database.read(RevocationRecord, "SELECT * FROM revocations ORDER BY uuid")

    def revocation(self, uuid: bytes) -> RevocationRecord | None:
        """Return why this node is denied, None if it is not."""
        return self._database.read_one(RevocationRecord, "SELECT * FROM revocations WHERE uuid = ?", (uuid,))

    def revocations_of(self, uuids: Sequence[bytes]) -> list[RevocationRecord]:
        """Return the entries of these nodes, at most a batch of them."""
        return self._database.read(
            RevocationRecord, f"SELECT * FROM revocations WHERE uuid IN ({places(uuids)})", uuids
        )

    def put_revocation(self, revocation: RevocationRecord) -> None:
        """Deny a node."""
        self._database.execute(
            "INSERT OR REPLACE INTO revocations VALUES(?, ?, ?, ?, ?)",
            (revocation.uuid, revocation.fingerprint, revocation.why, revocation.statement, revocation.created),
        )

    def remove_revocation(self, uuid: bytes) -> bool:
        """Deny a node no more; False if it was not denied."""
        return self._database.change("DELETE FROM revocations WHERE uuid = ?", (uuid,)) > 0

    def lifted(self) -> dict[str, bytes | None]:
        """Bans that a person lifted, as the SHA-256 of their signed text, and the seal of each."""
        return dict(self._database.execute("SELECT statement, mac FROM lifted"))

    def put_lifted(self, statement: str, mac: bytes | None) -> None:
        """Note that a person lifted a ban."""
        self._database.execute("INSERT OR REPLACE INTO lifted VALUES(?, ?, ?)", (statement, utc_now(), mac))

    def ended_cas(self) -> dict[str, bytes | None]:
        """CAs (fingerprints) that came in bundles and count no more, and the seal of each."""
        return dict(self._database.execute("SELECT ca, mac FROM ended_cas"))

    def end_ca(self, ca: str, mac: bytes | None) -> None:
        """Have a CA (fingerprint) count no more for the nodes that keep it."""
        self._database.execute("INSERT OR REPLACE INTO ended_cas VALUES(?, ?, ?)", (ca, utc_now(), mac))

    def renew_ca(self, ca: str) -> None:
        """Have a CA (fingerprint) count again: a person trusts it, or took in a bundle that names it."""
        self._database.execute("DELETE FROM ended_cas WHERE ca = ?", (ca,))


def _handover(*row: Any) -> Handover:
    handover = Handover(*row)
    return replace(handover, peers=tuple(json.loads(row[3])))
