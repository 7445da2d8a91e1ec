"""Measurements of this station (operation.md section 7), its detection of nodes, and the names that it publishes.

Each kept measurement has an owner. One of ``ncap``, the page or a token of the API is kept until it is deleted, and
``ncap run`` carries it on after ``kill -9``, power loss or a restart. One of a ``measure`` command is kept while that
command lives, which a lock shows: the next reader removes the row of a dead one. Only ``measure GROUP`` without options
takes over its settings, as a separate measurement. A topic's name may be changed while its node is not measured.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import time
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, fields, replace
from pathlib import Path
from shlex import quote
from typing import Any, Final, cast

from teds_provision.errors import BadDataError, FrozenError, NotFoundError, PolicyError, StoreError, UsageError
from teds_provision.station.groups import Groups
from teds_provision.station.store.database import places
from teds_provision.station.store.lock import OwnerLock, UsageLock, UsageLockTakenError
from teds_provision.station.store.records import COMMAND, DetectionMode, KeptMeasurement
from teds_provision.station.store.store import Store

FOLDER = "measuring"  # in the home: which process measures which node now

STATION = bytes(10)
"""Key of the station in :attr:`Measurements.names`: the first part of every topic."""


@dataclass(frozen=True)
class HandedOn:
    """Groups, names and measurements that a node was removed from, or that its replacement has now.

    ``topics`` are chosen names, ``measurements`` those that now have other nodes, ``ended`` those that had no other
    node. ``kept`` holds what could not be moved, a sentence each.
    """

    groups: tuple[str, ...] = ()
    topics: tuple[str, ...] = ()
    measurements: tuple[str, ...] = ()
    ended: tuple[str, ...] = ()
    kept: tuple[str, ...] = ()

    def to_json(self) -> dict[str, list[str]]:
        """Return the members of the report."""
        return {name: list(values) for name, values in vars(self).items()}


class Measurements:
    """The measurements of one station. One that runs is frozen: its group, its nodes and their names stay."""

    def __init__(self, store: Store, groups: Groups, home: Path) -> None:
        self._store, self._groups, self._home = store, groups, home

    def all(self) -> list[KeptMeasurement]:
        """Return every one that is kept, oldest first; removes those of dead commands."""
        kept = self._rows()
        dead = {measurement.id for measurement in kept if self._is_of_dead_command(measurement)}
        with suppress(StoreError):  # with a full disk the list is still returned; the next call tries again
            for measurement_id in dead:
                self.forget(measurement_id)
        return [measurement for measurement in kept if measurement.id not in dead]

    def lasting(self) -> list[KeptMeasurement]:
        """Return those that are kept until they are deleted, oldest first: none of a command's."""
        return [measurement for measurement in self._rows() if measurement.lasting]

    def due(self) -> list[KeptMeasurement]:
        """Return those that ``ncap`` measures now: its own, the page's and the API's that are not past their end."""
        return [measurement for measurement in self.all() if measurement.lasting and not _is_past(measurement)]

    def of_commands(self) -> list[KeptMeasurement]:
        """Return those of commands that live."""
        return [measurement for measurement in self.all() if not measurement.lasting]

    def _is_of_dead_command(self, measurement: KeptMeasurement) -> bool:
        return not measurement.lasting and not OwnerLock(self._home, measurement.id).is_taken

    def get(self, measurement_id: str) -> KeptMeasurement:
        """Return one measurement; raises NotFoundError."""
        statement = f"SELECT {_COLUMNS} FROM measurements WHERE id = ?"
        found = self._store.read_one(_measurement, statement, (measurement_id,))
        if found is None:
            raise NotFoundError(
                f"There is no measurement {measurement_id!r}.",
                hint=f"Measurements: {', '.join(measurement.id for measurement in self.all()) or 'none'}.",
            )
        return found

    def settings_to_continue(self, group: str) -> KeptMeasurement | None:
        """Return what `measure GROUP` continues: the settings of one that was cut off, or that lasts, as a command's.

        None if there is none. The row itself stays its owner's; that of a dead command goes with the next :meth:`all`.
        """
        kept = [measurement for measurement in self._rows() if measurement.group == group and not _is_past(measurement)]
        found = next(
            (
                measurement
                for measurement in reversed(kept)
                if measurement.lasting or self._is_of_dead_command(measurement)
            ),
            None,
        )
        return None if found is None else replace(found, id="", owner=COMMAND, pid=None, started=None)

    def of_group(self, group: str) -> list[KeptMeasurement]:
        """Return those that are kept for a group, and would be deleted with it."""
        return [measurement for measurement in self.all() if measurement.lasting and measurement.group == group]

    def delete_group(self, group: str, *, also: Collection[str] = ()) -> tuple[bool, tuple[str, ...]]:
        """Delete a group and the kept measurements of it; False if there is no such group, and the IDs of those.

        ``also`` are the measurements that may go with it. Raises FrozenError while it is measured, or if another one is
        kept for it.
        """
        kept = [measurement.id for measurement in self.of_group(group)]
        if not kept and self._groups.find(group) is None:
            return False, ()  # no lock file for a group that does not exist
        with self._groups.frozen(group):  # refuses if the group is being measured, whatever `also` permits
            kept = [measurement.id for measurement in self.of_group(group)]
        with self._store.together():
            if set(kept) - set(also):
                several = len(kept) > 1
                raise FrozenError(
                    f"Group {group!r} has {len(kept)} kept measurement{'s' if several else ''} ({', '.join(kept)}), "
                    f"which would be deleted with it.",
                    hint=f"Delete {'them' if several else 'it'} first, or: group delete {quote(group)} --yes",
                )
            found = self._groups.delete(group)
            for measurement_id in kept:
                self.forget(measurement_id)
            return found, tuple(kept)

    def nodes_of(self, measurement: KeptMeasurement) -> tuple[bytes, ...]:
        """Return the UUIDs of its nodes, 10 octets each; raises NotFoundError if its group is gone."""
        return measurement.uuids if measurement.group is None else self._groups.get(measurement.group).uuids

    def keep(self, measurement: KeptMeasurement) -> KeptMeasurement:
        """Keep it, durable when this returns; one with id "" gets one.

        Raises NotFoundError (its group), BadDataError.
        """
        if measurement.group is not None:
            self._groups.get(measurement.group)
        kept = measurement if measurement.id else replace(measurement, id=secrets.token_hex(4))
        self._put(kept)
        return kept

    def _rows(self) -> list[KeptMeasurement]:
        """Return what the station measures, oldest first."""
        return self._store.read(_measurement, f"SELECT {_COLUMNS} FROM measurements ORDER BY created, id")

    def _put(self, measurement: KeptMeasurement) -> None:
        """Keep what the station measures from now on; raises BadDataError if it names none, or two, of what it may."""
        one = measurement
        if sum((one.group is not None, bool(one.uuids), one.match is not None)) != 1:
            raise BadDataError("A measurement names a group, or nodes by UUID, or says which nodes match.")
        values = [_to_column(getattr(one, member.name)) for member in fields(one)]
        self._store.execute(f"INSERT OR REPLACE INTO measurements({_COLUMNS}) VALUES({places(values)})", values)

    @contextmanager
    def owned_by_command(self, measurement: KeptMeasurement) -> Iterator[KeptMeasurement]:
        """Keep a measurement of this process while the block runs, with its process ID and start.

        Its lock is taken before the row exists and released after the row is gone, so a row without a taken lock is
        always that of a dead command. Raises NotFoundError (its group).
        """
        owned = replace(measurement, id=secrets.token_hex(8), owner=COMMAND, pid=os.getpid(), started=_process_start())
        with OwnerLock(self._home, owned.id):
            self.all()  # removes the rows of dead commands
            try:
                yield self.keep(owned)
            finally:  # only after a crash is the row left for the next reader
                self.forget(owned.id)

    def forget(self, measurement_id: str) -> bool:
        """Remove a kept measurement, from the next start on; False if there is none. Ends nothing that runs."""
        return self._store.change("DELETE FROM measurements WHERE id = ?", (measurement_id,)) > 0

    def has_node(self, uuid: bytes) -> bool:
        """Return True if a node is in a group, in a measurement, or has a chosen name: what ``hand_on`` moves."""
        named = any(node == uuid for node, _ in (*self.names, *self.frames))
        return named or bool(self._groups.names_of_node(uuid)) or any(uuid in row.uuids for row in self._rows())

    def hand_on(self, old: bytes, new: bytes | None) -> HandedOn:
        """Put ``new`` in the place of ``old`` in groups, chosen names, frames and measurements; None removes ``old``.

        Changes nothing if ``old`` is in none of them, so it may be repeated.
        """
        with self._store.together():
            kept = [f"{word} goes on with the old node until it is started again." for word in self._commands_with(old)]
            groups = self._groups.hand_on(old, new)
            topics, refused = self._hand_on_names(old, new)
            changed, ended = [], []
            for measurement in self._rows():
                if measurement.group is None and old in measurement.uuids:
                    rest = dict.fromkeys(uuid if uuid != old else new for uuid in measurement.uuids)
                    uuids = tuple(uuid for uuid in rest if uuid is not None)
                    if uuids:
                        self._put(replace(measurement, uuids=uuids))
                        changed.append(measurement.id)
                    else:
                        self.forget(measurement.id)
                        ended.append(measurement.id)
                elif measurement.group is not None and measurement.group in groups:
                    if self._groups.get(measurement.group).uuids:
                        changed.append(measurement.id)
                    else:
                        self.forget(measurement.id)
                        ended.append(measurement.id)
        return HandedOn(tuple(groups), tuple(topics), tuple(changed), tuple(ended), (*kept, *refused))

    def _commands_with(self, uuid: bytes) -> list[str]:
        """Return the `measure` commands that live and have a node, in words."""
        groups = self._groups.names_of_node(uuid)
        mine = [
            measurement
            for measurement in self.of_commands()
            if uuid in measurement.uuids or measurement.group in groups
        ]
        return [
            f"The running command measure {measurement.group or uuid.hex()} (process {measurement.pid})"
            for measurement in mine
        ]

    def _hand_on_names(self, old: bytes, new: bytes | None) -> tuple[list[str], list[str]]:
        """Move chosen names and frames; returns the names, and a sentence for each that cannot be moved."""
        moved, refused = [], []
        names, frames = self.names, self.frames
        for (uuid, channel), name in names.items():
            if uuid != old:
                continue
            if new is not None and (new, channel) in names:
                what = f"of channel {channel}" if channel else "of the node"
                refused.append(f"The topic name {name!r} {what}: the new node has the name {names[new, channel]!r}.")
                continue
            self._remove_name(old, channel)
            if new is not None:
                self._put_name(new, channel, name)
            moved.append(name)
        for (uuid, channel), frame in frames.items():
            if uuid == old:
                self._remove_frame(old, channel)
                if new is not None and (new, channel) not in frames:
                    self._put_frame(new, channel, frame)
        return moved, refused

    @contextmanager
    def running(self, uuids: Iterable[bytes], *, group: str | None = None, what: str = "measure") -> Iterator[None]:
        """Hold these nodes (and their group) as they are while they are measured.

        The marks are locks of the system: they end with the process, however that ends. Raises PolicyError if the group
        is being measured already, or one of the nodes is being renamed.
        """
        with ExitStack() as stack:
            if group is not None:
                stack.enter_context(self._groups.frozen(group))
            for uuid in sorted(set(uuids)):
                try:
                    stack.enter_context(self._mark(uuid, what))
                except UsageLockTakenError as taken:
                    raise PolicyError(f"Node {uuid.hex()} is in use by {taken.holder}.", hint="Try again.") from taken
            yield

    def is_running(self, uuid: bytes) -> bool:
        """Return True if a measurement of this station holds the node, in this process or another one."""
        return self._mark(uuid).is_taken

    def holder(self, uuid: bytes) -> str | None:
        """Return which process measures the node, in words; None if no process of this station does."""
        return self._mark(uuid).holder

    def _mark(self, uuid: bytes, what: str = "") -> UsageLock:
        return UsageLock(self._home / FOLDER / f"{uuid.hex()}.lock", command=what, shared=True)

    def source(self, bus: str, source: int, *, command: str = "", shared: bool = False) -> UsageLock:
        """Return the usage lock of a source address on a bus; ``with`` enters it and raises UsageLockTakenError (7).

        A session belongs to a pair of addresses, and a second Open on it ends the first (operation.md section 6).
        ``bus`` is ``CanSpec.wire``. A user with one short session after another takes it ``shared``.
        """
        name = hashlib.sha256(f"{bus}\0{source}".encode()).hexdigest()[:16]
        return UsageLock(self._home / FOLDER / f"bus-{name}.lock", command=command, shared=shared)

    # -- detection ---------------------------------------------------------------------------------------------------

    @property
    def detection(self) -> DetectionMode:
        """How nodes are detected; ``whitelist`` by default."""
        row = self._store.first_row("SELECT mode FROM detection")
        return "whitelist" if row is None else cast(DetectionMode, row[0])

    @detection.setter
    def detection(self, mode: DetectionMode) -> None:
        self._store.execute("INSERT OR REPLACE INTO detection VALUES(1, ?)", (mode,))

    # -- names of topics ---------------------------------------------------------------------------------------------

    @property
    def names(self) -> dict[tuple[bytes, int], str]:
        """Chosen names by UUID and channel: channel 0 is the node's part, :data:`STATION` the station's part."""
        rows = self._store.execute("SELECT uuid, channel, name FROM topics ORDER BY uuid, channel")
        return {(bytes(uuid), int(channel)): str(name) for uuid, channel, name in rows}

    def names_of(self, uuid: bytes) -> dict[int, str]:
        """Return the chosen names of one node by channel, 0 for the node's part."""
        rows = self._store.execute("SELECT channel, name FROM topics WHERE uuid = ? ORDER BY channel", (uuid,))
        return {int(channel): str(name) for channel, name in rows}

    @property
    def frames(self) -> dict[tuple[bytes, int], str]:
        """Chosen coordinate frames (``frame_id``) by UUID and channel: channel 0 is the whole node."""
        rows = self._store.execute("SELECT uuid, channel, frame FROM frames ORDER BY uuid, channel")
        return {(bytes(uuid), int(channel)): str(frame) for uuid, channel, frame in rows}

    def set_frame(self, uuid: bytes, channel: int, frame: str | None) -> None:
        """Give values of a channel (0: of the whole node) this frame; None: the profile's.

        It counts from the next session on. Raises FrozenError while the node is measured.
        """
        if self.is_running(uuid):
            raise FrozenError(
                f"Node {uuid.hex()} is being measured, so its frames cannot be changed now.",
                hint="End that measurement first.",
            )
        if frame is None:
            self._remove_frame(uuid, channel)
        else:
            self._put_frame(uuid, channel, frame)

    def rename(self, uuid: bytes, channel: int, name: str | None) -> None:
        """Publish a channel (0: the node's part) under this name from the next measurement on; None: the default name.

        The caller has checked that it can be a topic. Raises FrozenError while the node is measured, UsageError if
        another one has the name.
        """
        if self.is_running(uuid):
            raise FrozenError(
                f"Node {uuid.hex()} is being measured, so its names cannot be changed now.",
                hint="End that measurement first.",
            )
        if name is None:
            self._remove_name(uuid, channel)
            return
        for (other, number), taken in self.names.items():
            if taken == name and (other, number) != (uuid, channel):
                raise UsageError(
                    f"{name!r} is the name of channel {number} of node {other.hex()} already.",
                    hint="Choose another name.",
                )
        self._put_name(uuid, channel, name)

    def _put_name(self, uuid: bytes, channel: int, name: str) -> None:
        """Keep a chosen name, in place of the one before."""
        statement = "INSERT INTO topics VALUES(?, ?, ?) ON CONFLICT(uuid, channel) DO UPDATE SET name = excluded.name"
        self._store.execute(statement, (uuid, channel, name))

    def _remove_name(self, uuid: bytes, channel: int) -> None:
        """Forget a chosen name."""
        self._store.execute("DELETE FROM topics WHERE uuid = ? AND channel = ?", (uuid, channel))

    def _put_frame(self, uuid: bytes, channel: int, frame: str) -> None:
        """Keep a chosen frame, in place of the one before."""
        self._store.execute("INSERT OR REPLACE INTO frames VALUES(?, ?, ?)", (uuid, channel, frame))

    def _remove_frame(self, uuid: bytes, channel: int) -> None:
        """Forget a chosen frame."""
        self._store.execute("DELETE FROM frames WHERE uuid = ? AND channel = ?", (uuid, channel))


def _is_past(measurement: KeptMeasurement) -> bool:
    return measurement.ends is not None and measurement.ends <= time.time()


def _process_start() -> int:
    """Return when this process started (unix seconds); now, if the system does not report it."""
    try:
        ticks = int(Path("/proc/self/stat").read_text().rpartition(")")[2].split()[19])
        booted = next(row for row in Path("/proc/stat").read_text().splitlines() if row.startswith("btime "))
        return int(booted.split()[1]) + ticks // os.sysconf("SC_CLK_TCK")
    except (OSError, ValueError, LookupError, StopIteration):
        return int(time.time())


_COLUMNS: Final = ", ".join({"group": "group_name"}.get(member.name, member.name) for member in fields(KeptMeasurement))
"""One for each field, under its name, but for a word of SQL."""


def _to_column(value: Any) -> Any:
    """Return a field as its column has it: lists are JSON, nodes in hex."""
    if isinstance(value, tuple):
        return json.dumps([part.hex() if isinstance(part, bytes) else part for part in value])
    return int(value) if isinstance(value, bool) else value


def _measurement(*row: Any) -> KeptMeasurement:
    """Return a row of :data:`_COLUMNS`."""
    read: dict[str, Any] = {}
    for member, column in zip(fields(KeptMeasurement), row, strict=True):
        if isinstance(member.default, tuple):
            read[member.name] = tuple(json.loads(column))
        else:
            read[member.name] = bool(column) if isinstance(member.default, bool) else column
    return KeptMeasurement(**read | {"uuids": tuple(bytes.fromhex(uuid) for uuid in read["uuids"])})
