"""What this station measures (operation.md section 7), how it detects nodes, and the names under which it publishes.

Each kept measurement has an owner. One of ``ncap``, the page or a token of the API is kept until it is deleted, and
``ncap run`` carries it on after ``kill -9``, power loss or a restart. One of a ``measure`` command is kept while that
command lives, which a lock shows: the next reader removes the row of a dead one. Only ``measure GROUP`` without options
takes over its settings, as a measurement of its own. A topic's name may be changed while its node is not measured.
"""

from __future__ import annotations

import hashlib
import os
import secrets
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

from teds_provision.errors import Frozen, NotFound, PolicyRefused, StoreFailure, UsageFailure
from teds_provision.station.groups import Groups
from teds_provision.store import Store
from teds_provision.store.lock import Mark, MarkTaken, OwnerLock
from teds_provision.store.records import COMMAND, DetectionMode, KeptMeasurement

FOLDER = "measuring"  # of the home: who measures what now

STATION = bytes(10)
"""Stands for the station in :attr:`Measurements.names`: the first part of every topic."""


class Measurements:
    """The measurements of one station. One that runs is frozen: its group, its nodes and their names stay."""

    def __init__(self, store: Store, groups: Groups, home: Path) -> None:
        self._store, self._groups, self._home = store, groups, home

    def all(self) -> list[KeptMeasurement]:
        """Return every one that is kept, oldest first; removes those of dead commands."""
        kept = self._store.measurements()
        dead = {one.id for one in kept if self._is_of_dead_command(one)}
        with suppress(StoreFailure):  # a full disk hides no list; the next reader tries again
            for measurement_id in dead:
                self._store.remove_measurement(measurement_id)
        return [one for one in kept if one.id not in dead]

    def due(self) -> list[KeptMeasurement]:
        """Return those that ``ncap`` measures now: its own, the page's and the API's that are not past their end."""
        return [one for one in self.all() if one.lasting and not _is_past(one)]

    def of_commands(self) -> list[KeptMeasurement]:
        """Return those of commands that live."""
        return [one for one in self.all() if not one.lasting]

    def _is_of_dead_command(self, measurement: KeptMeasurement) -> bool:
        return not measurement.lasting and not OwnerLock(self._home, measurement.id).is_taken

    def get(self, measurement_id: str) -> KeptMeasurement:
        """One of them; raises NotFound."""
        found = self._store.measurement(measurement_id)
        if found is None:
            raise NotFound(
                f"There is no measurement {measurement_id!r}.",
                hint=f"Measurements: {', '.join(one.id for one in self.all()) or 'none'}.",
            )
        return found

    def settings_to_continue(self, group: str) -> KeptMeasurement | None:
        """Return what `measure GROUP` continues: the settings of one that was cut off, or that lasts, as a command's.

        None if there is none. The row itself stays its owner's; that of a dead command goes with the next :meth:`all`.
        """
        kept = [one for one in self._store.measurements() if one.group == group and not _is_past(one)]
        found = next((one for one in reversed(kept) if one.lasting or self._is_of_dead_command(one)), None)
        return None if found is None else replace(found, id="", owner=COMMAND, pid=None, started=None)

    def nodes_of(self, measurement: KeptMeasurement) -> tuple[bytes, ...]:
        """UUIDs of its nodes, 10 octets each; raises NotFound where its group is gone."""
        return measurement.uuids if measurement.group is None else self._groups.get(measurement.group).uuids

    def keep(self, measurement: KeptMeasurement) -> KeptMeasurement:
        """Keep it, durable when this returns; one with id "" gets one. Raises NotFound (its group), BadData."""
        if measurement.group is not None:
            self._groups.get(measurement.group)
        kept = measurement if measurement.id else replace(measurement, id=secrets.token_hex(4))
        self._store.put_measurement(kept)
        return kept

    @contextmanager
    def owned_by_command(self, measurement: KeptMeasurement) -> Iterator[KeptMeasurement]:
        """Keep a measurement of this process while the block runs, with its process ID and start.

        Its lock is taken before the row exists and released after the row is gone, so a row without a taken lock is
        always that of a dead command. Raises NotFound (its group).
        """
        owned = replace(measurement, id=secrets.token_hex(8), owner=COMMAND, pid=os.getpid(), started=_process_start())
        with OwnerLock(self._home, owned.id):
            self.all()  # whatever a dead command left goes now
            try:
                yield self.keep(owned)
            finally:  # only a process that dies leaves it to the next reader
                self.forget(owned.id)

    def forget(self, measurement_id: str) -> bool:
        """Measure it no more after the next start; False where it is not there. Ends nothing that runs."""
        return self._store.remove_measurement(measurement_id)

    @contextmanager
    def running(self, uuids: Iterable[bytes], *, group: str | None = None, what: str = "measure") -> Iterator[None]:
        """Hold these nodes (and their group) as they are while they are measured.

        The marks are locks of the system: they go with the process, however that ends. Raises PolicyRefused where the
        group is being measured already, or one of the nodes is being renamed.
        """
        with ExitStack() as stack:
            if group is not None:
                stack.enter_context(self._groups.frozen(group))
            for uuid in sorted(set(uuids)):
                try:
                    stack.enter_context(self._mark(uuid, what))
                except MarkTaken as taken:
                    raise PolicyRefused(f"Node {uuid.hex()} is in use by {taken.holder}.", hint="Try again.") from taken
            yield

    def is_running(self, uuid: bytes) -> bool:
        """Whether a measurement of this station holds the node, in this process or another one."""
        return self._mark(uuid).is_taken

    def _mark(self, uuid: bytes, what: str = "") -> Mark:
        return Mark(self._home / FOLDER / f"{uuid.hex()}.lock", command=what, shared=True)

    def source(self, bus: str, source: int, *, command: str = "", shared: bool = False) -> Mark:
        """The mark of who uses a source address on a bus: to be entered by ``with``, which raises Taken (7).

        A session belongs to a pair of addresses, and a second Open on it ends the first (operation.md section 6).
        ``bus`` is ``CanSpec.wire``. Who has one short session after another takes it ``shared``.
        """
        name = hashlib.sha256(f"{bus}\0{source}".encode()).hexdigest()[:16]
        return Mark(self._home / FOLDER / f"bus-{name}.lock", command=command, shared=shared)

    # -- detection ---------------------------------------------------------------------------------------------------

    @property
    def detection(self) -> DetectionMode:
        """How nodes are detected; ``whitelist`` unless somebody asked otherwise."""
        return self._store.detection() or "whitelist"

    @detection.setter
    def detection(self, mode: DetectionMode) -> None:
        self._store.put_detection(mode)

    # -- names of topics ---------------------------------------------------------------------------------------------

    @property
    def names(self) -> dict[tuple[bytes, int], str]:
        """Chosen names by UUID and channel: channel 0 is the node's part, :data:`STATION` the station's part."""
        return self._store.topic_names()

    @property
    def frames(self) -> dict[tuple[bytes, int], str]:
        """Chosen coordinate frames (``frame_id``) by UUID and channel: channel 0 is the whole node."""
        return self._store.frames()

    def set_frame(self, uuid: bytes, channel: int, frame: str | None) -> None:
        """Give values of a channel (0: of the whole node) this frame; None: the profile's.

        It counts from the next session on. Raises Frozen while the node is measured.
        """
        if self.is_running(uuid):
            raise Frozen(
                f"Node {uuid.hex()} is being measured, so its frames cannot be changed now.",
                hint="End that measurement first.",
            )
        if frame is None:
            self._store.remove_frame(uuid, channel)
        else:
            self._store.put_frame(uuid, channel, frame)

    def rename(self, uuid: bytes, channel: int, name: str | None) -> None:
        """Publish a channel (0: the node's part) under this name from the next measurement on; None: as it was made.

        The caller has checked that it can be a topic. Raises Frozen while the node is measured, UsageFailure
        where another one has the name.
        """
        if self.is_running(uuid):
            raise Frozen(
                f"Node {uuid.hex()} is being measured, so its names cannot be changed now.",
                hint="End that measurement first.",
            )
        if name is None:
            self._store.remove_topic_name(uuid, channel)
            return
        for (other, number), taken in self.names.items():
            if taken == name and (other, number) != (uuid, channel):
                raise UsageFailure(
                    f"{name!r} is the name of channel {number} of node {other.hex()} already.",
                    hint="Choose another name.",
                )
        self._store.put_topic_name(uuid, channel, name)


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
