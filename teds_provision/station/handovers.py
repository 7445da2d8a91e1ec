"""Sent and received bundles, and their outcome (profile.md, "Handover between base stations")."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

from teds_provision.station.store.records import Direction, Handover
from teds_provision.station.store.store import Store


class Handovers:
    """The handovers of one station."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def all(self) -> list[Handover]:
        """Return every bundle that left or came, oldest first."""
        return self._store.read(_handover, "SELECT * FROM handovers ORDER BY created, id")

    def get(self, handover_id: str, direction: Direction) -> Handover | None:
        """Return one bundle, None if it is not known."""
        return self._store.read_one(
            _handover, "SELECT * FROM handovers WHERE id = ? AND direction = ?", (handover_id, direction)
        )

    def put(self, handover: Handover) -> None:
        """Add or replace a bundle."""
        self._store.execute(
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

    def remove(self, handover_id: str, direction: Direction) -> bool:
        """Forget a bundle; False if there is none."""
        statement = "DELETE FROM handovers WHERE id = ? AND direction = ?"
        return self._store.change(statement, (handover_id, direction)) > 0


def _handover(*row: Any) -> Handover:
    handover = Handover(*row)
    return replace(handover, peers=tuple(json.loads(row[3])))
