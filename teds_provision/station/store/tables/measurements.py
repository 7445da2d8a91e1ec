"""Measurement groups, what is measured after every start, names, detection (operation.md section 7)."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, cast

from teds_provision.errors import BadDataError
from teds_provision.station.store.database import Database, places
from teds_provision.station.store.records import DetectionMode, Group, KeptMeasurement


class MeasurementTables:
    """The part of the store that is about measuring; see :class:`teds_provision.station.store.Store`."""

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
        with self._database.together():
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

    def measurements(self) -> list[KeptMeasurement]:
        """Return what the station measures, oldest first."""
        return self._database.read(_measurement, "SELECT * FROM measurements ORDER BY created, id")

    def measurement(self, measurement_id: str) -> KeptMeasurement | None:
        """Return one measurement, None if there is none."""
        return self._database.read_one(_measurement, "SELECT * FROM measurements WHERE id = ?", (measurement_id,))

    def put_measurement(self, measurement: KeptMeasurement) -> None:
        """Keep what the station measures from now on; raises BadDataError if it names none, or two, of what it may."""
        one = measurement
        if sum((one.group is not None, bool(one.uuids), one.match is not None)) != 1:
            raise BadDataError("A measurement names a group, or nodes by UUID, or says which nodes match.")
        values = (
            one.id,
            one.group,
            json.dumps([uuid.hex() for uuid in one.uuids]),
            json.dumps(list(one.channels)),
            one.rate,
            one.kind,
            int(one.trigger),
            int(one.actuators),
            one.dead_man,
            float(one.scalar_rate),
            json.dumps(list(one.sinks)),
            one.owner,
            one.ends,
            one.created,
            int(one.test_pattern),
            int(one.unsigned),
            one.require,
            one.match,
            int(one.frozen),
            one.pid,
            one.started,
        )
        self._database.execute(f"INSERT OR REPLACE INTO measurements VALUES({places(values)})", values)

    def remove_measurement(self, measurement_id: str) -> bool:
        """Measure this no more; False if there is none."""
        return self._database.change("DELETE FROM measurements WHERE id = ?", (measurement_id,)) > 0

    # -- names of topics, and how nodes are detected -----------------------------------------------------------------

    def topic_names(self) -> dict[tuple[bytes, int], str]:
        """Return every name that an operator chose, by UUID and channel; channel 0 is the node's part of its topics."""
        rows = self._database.execute("SELECT uuid, channel, name FROM topics ORDER BY uuid, channel")
        return {(bytes(uuid), int(channel)): str(name) for uuid, channel, name in rows}

    def topic_names_of(self, uuid: bytes) -> dict[int, str]:
        """Return the names chosen for the channels of a node; channel 0 is its part of its topics."""
        rows = self._database.execute("SELECT channel, name FROM topics WHERE uuid = ? ORDER BY channel", (uuid,))
        return {int(channel): str(name) for channel, name in rows}

    def put_topic_name(self, uuid: bytes, channel: int, name: str) -> None:
        """Keep a chosen name, in place of the one before."""
        statement = "INSERT INTO topics VALUES(?, ?, ?) ON CONFLICT(uuid, channel) DO UPDATE SET name = excluded.name"
        self._database.execute(statement, (uuid, channel, name))

    def remove_topic_name(self, uuid: bytes, channel: int) -> bool:
        """Forget a chosen name; False if there is none."""
        return self._database.change("DELETE FROM topics WHERE uuid = ? AND channel = ?", (uuid, channel)) > 0

    def frames(self) -> dict[tuple[bytes, int], str]:
        """Return every coordinate frame that an operator chose, by UUID and channel; channel 0 is the whole node."""
        rows = self._database.execute("SELECT uuid, channel, frame FROM frames ORDER BY uuid, channel")
        return {(bytes(uuid), int(channel)): str(frame) for uuid, channel, frame in rows}

    def put_frame(self, uuid: bytes, channel: int, frame: str) -> None:
        """Keep a chosen frame, in place of the one before."""
        self._database.execute("INSERT OR REPLACE INTO frames VALUES(?, ?, ?)", (uuid, channel, frame))

    def remove_frame(self, uuid: bytes, channel: int) -> bool:
        """Forget a chosen frame; False if there is none."""
        return self._database.change("DELETE FROM frames WHERE uuid = ? AND channel = ?", (uuid, channel)) > 0

    def detection(self) -> DetectionMode | None:
        """Return how nodes are detected, None if it was never set."""
        row = self._database.one("SELECT mode FROM detection")
        return None if row is None else cast(DetectionMode, row[0])

    def put_detection(self, mode: DetectionMode) -> None:
        """Keep how nodes are detected."""
        self._database.execute("INSERT OR REPLACE INTO detection VALUES(1, ?)", (mode,))


def _measurement(*row: Any) -> KeptMeasurement:
    one = KeptMeasurement(*row)
    return replace(
        one,
        uuids=tuple(bytes.fromhex(uuid) for uuid in json.loads(row[2])),
        channels=tuple(json.loads(row[3])),
        trigger=bool(one.trigger),
        actuators=bool(one.actuators),
        sinks=tuple(json.loads(row[10])),
        test_pattern=bool(one.test_pattern),
        unsigned=bool(one.unsigned),
        frozen=bool(one.frozen),
    )
