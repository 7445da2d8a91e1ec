"""Measurement groups, and what the station measures after every start (operation.md section 7)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from typing import Any

from teds_provision.errors import BadData
from teds_provision.store.database import Database
from teds_provision.store.records import Group, Measurement


class MeasurementTables:
    """The part of the store that is about measuring; see :class:`teds_provision.store.Store`."""

    _database: Database

    def groups(self) -> list[Group]:
        """Return every measurement group, by name."""
        rows = self._database.execute(
            "SELECT name, created, uuid FROM groups LEFT JOIN group_members USING(name) ORDER BY name, uuid"
        )
        found: dict[tuple[str, str], list[bytes]] = {}
        for name, created, uuid in rows:
            found.setdefault((name, created), []).extend([] if uuid is None else [uuid])
        return [Group(name, tuple(uuids), created) for (name, created), uuids in found.items()]

    def group(self, name: str) -> Group | None:
        """Return one group, None if there is none of this name."""
        row = self._database.one("SELECT created FROM groups WHERE name = ?", (name,))
        if row is None:
            return None
        members = self._database.execute("SELECT uuid FROM group_members WHERE name = ? ORDER BY uuid", (name,))
        return Group(name, tuple(bytes(uuid) for (uuid,) in members), str(row[0]))

    def groups_of(self, uuid: bytes) -> list[str]:
        """Return the names of the groups that a node is in."""
        rows = self._database.execute("SELECT name FROM group_members WHERE uuid = ? ORDER BY name", (uuid,))
        return [str(name) for (name,) in rows]

    def put_group(self, group: Group) -> None:
        """Add a group, or replace its members."""
        with self._database.transaction():
            self._database.execute(
                "INSERT INTO groups VALUES(?, ?) ON CONFLICT(name) DO NOTHING", (group.name, group.created)
            )
            self._database.execute("DELETE FROM group_members WHERE name = ?", (group.name,))
            self._add(group.name, group.uuids)

    def add_to_group(self, name: str, uuids: Iterable[bytes]) -> None:
        """Add nodes to a group that is there; one that is in it already stays."""
        self._add(name, uuids)

    def _add(self, name: str, uuids: Iterable[bytes]) -> None:
        self._database.execute_many("INSERT OR IGNORE INTO group_members VALUES(?, ?)", ((name, u) for u in uuids))

    def remove_from_group(self, name: str, uuids: Iterable[bytes]) -> None:
        """Take nodes out of a group."""
        statement = "DELETE FROM group_members WHERE name = ? AND uuid = ?"
        self._database.execute_many(statement, ((name, uuid) for uuid in uuids))

    def remove_group(self, name: str) -> bool:
        """Delete a group, and the measurements of it; False if there is none."""
        return self._database.change("DELETE FROM groups WHERE name = ?", (name,)) > 0

    def measurements(self) -> list[Measurement]:
        """Return what the station measures, oldest first."""
        return self._database.read(_measurement, "SELECT * FROM measurements ORDER BY created, id")

    def measurement(self, measurement_id: str) -> Measurement | None:
        """Return one measurement, None if there is none."""
        return self._database.read_one(_measurement, "SELECT * FROM measurements WHERE id = ?", (measurement_id,))

    def put_measurement(self, measurement: Measurement) -> None:
        """Keep what the station measures from now on; raises BadData where it names both a group and nodes, or none."""
        if (measurement.group is None) == (not measurement.uuids):
            raise BadData("A measurement names a group, or nodes by UUID.")
        self._database.execute(
            "INSERT OR REPLACE INTO measurements VALUES(?, ?, ?, ?, ?, ?, ?, ?)",
            (
                measurement.id,
                measurement.group,
                json.dumps([uuid.hex() for uuid in measurement.uuids]),
                measurement.rate,
                measurement.kind,
                int(measurement.trigger),
                json.dumps(list(measurement.sinks)),
                measurement.created,
            ),
        )

    def remove_measurement(self, measurement_id: str) -> bool:
        """Measure this no more; False if there is none."""
        return self._database.change("DELETE FROM measurements WHERE id = ?", (measurement_id,)) > 0


def _measurement(
    name: str, group: str | None, uuids: str, rate: float | None, kind: Any, trigger: int, sinks: str, created: str
) -> Measurement:
    members = tuple(bytes.fromhex(uuid) for uuid in json.loads(uuids))
    return Measurement(name, group, members, rate, kind, bool(trigger), tuple(json.loads(sinks)), created)
