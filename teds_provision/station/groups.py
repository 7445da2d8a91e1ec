"""Measurement groups: a name, and the UUIDs that are measured together (operation.md section 5)."""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from shlex import quote
from typing import Final

from teds_provision.errors import FrozenError, NotFoundError, UsageError
from teds_provision.files import open_lock
from teds_provision.portable import lock
from teds_provision.station.plant.plant import Plant
from teds_provision.station.store.records import Group, utc_now
from teds_provision.station.store.store import Store

_LIKE_A_UUID = re.compile(r"(0x)?[0-9a-fA-F]{4,}\Z")
LONGEST = 64
ALL = "all"
"""Means every node that comes (``ncap run --measure all``): no group is called so."""
_NO_PATHS: Final = (".", "..")
"""Names that are no groups: groups are paths of the API, and browsers remove these two."""
_SHOWN: Final = 10
_CREATE: Final = "teds-provision group create NAME UUID …"


def is_valid_name(name: str) -> bool:
    """Return True if a group may have this name."""
    forbidden = name in (ALL, *_NO_PATHS) or _LIKE_A_UUID.match(name) is not None
    return not forbidden and bool(name.strip()) and name.isprintable() and len(name) <= LONGEST


def valid_name(label: str) -> str:
    """Return the name of the group that a bundle calls ``label``: the label itself if a group may have it."""
    return label if is_valid_name(label) else f"group {label[: LONGEST - len('group ')]}".rstrip()


class Groups:
    """The groups of one station. A group that is measured is frozen: it cannot be changed until the measurement ends.

    The mark of that is a lock that the system takes away with the process, however that ends.
    """

    def __init__(self, store: Store, home: Path, plant: Plant) -> None:
        self._store, self._home, self._plant = store, home, plant

    def all(self) -> list[Group]:
        """Return every measurement group, by name."""
        rows = self._store.execute(
            "SELECT name, created, uuid FROM groups LEFT JOIN group_members USING(name) ORDER BY name, uuid"
        )
        found: dict[tuple[str, str], list[bytes]] = {}
        for name, created, uuid in rows:
            found.setdefault((name, created), []).extend([] if uuid is None else [uuid])
        return [Group(name, tuple(uuids), created) for (name, created), uuids in found.items()]

    def get(self, name: str) -> Group:
        """Return one group; raises NotFoundError."""
        found = self.find(name)
        if found is None:
            known = [group.name for group in self.all()]
            more = ", …" if len(known) > _SHOWN else ""
            hint = f"Groups: {', '.join(known[:_SHOWN])}{more}." if known else f"To create it: {_CREATE}"
            raise NotFoundError(f"There is no group {name!r}.", hint=hint)
        return found

    def find(self, name: str) -> Group | None:
        """Return one group, None if there is none of exactly this name."""
        row = self._store.first_row("SELECT created FROM groups WHERE name = ?", (name,))
        if row is None:
            return None
        members = self._store.execute("SELECT uuid FROM group_members WHERE name = ? ORDER BY uuid", (name,))
        return Group(name, tuple(bytes(uuid) for (uuid,) in members), str(row[0]))

    def create(self, name: str, uuids: Sequence[bytes]) -> Group:
        """Make a group, or return the existing one if it has the same members; raises UsageError."""
        if not is_valid_name(name):
            raise UsageError(
                f"{name!r} is not a valid group name.",
                hint="Use up to 64 characters, not only hex digits or dots, and not 'all', which means every node.",
            )
        present = self.find(name)
        if present is not None and set(present.uuids) != set(uuids):
            raise UsageError(f"Group {name!r} already exists.", hint=f"Add nodes to it: group add {quote(name)} UUID …")
        if present is None:
            each = tuple(dict.fromkeys(uuids))
            with self._store.together():
                self.put(Group(name, each))
                self._report_member(name, each, member=True)
        return self.get(name)

    def add(self, name: str, uuids: Iterable[bytes]) -> Group:
        """Add nodes; raises NotFoundError, FrozenError while it is measured."""
        self.get(name)
        with self.frozen(name), self._store.together():
            there, added = self.get(name).uuids, list(dict.fromkeys(uuids))
            self._add(name, added)
            self._report_member(name, [uuid for uuid in added if uuid not in there], member=True)
        return self.get(name)

    def remove(self, name: str, uuids: Iterable[bytes]) -> Group:
        """Take nodes out; raises NotFoundError, FrozenError while it is measured."""
        self.get(name)
        with self.frozen(name), self._store.together():
            there, gone = self.get(name).uuids, list(dict.fromkeys(uuids))
            self._remove(name, gone)
            self._report_member(name, [uuid for uuid in gone if uuid in there], member=False)
        return self.get(name)

    def delete(self, name: str) -> bool:
        """Delete a group; False if there is none. Raises FrozenError while it is measured."""
        if self.find(name) is None:
            return False
        with self.frozen(name), self._store.together():
            self._report_member(name, self.get(name).uuids, member=False)
            return self._store.change("DELETE FROM groups WHERE name = ?", (name,)) > 0

    def names_of_node(self, uuid: bytes) -> list[str]:
        """Return the names of the groups that a node is in."""
        rows = self._store.execute("SELECT name FROM group_members WHERE uuid = ? ORDER BY name", (uuid,))
        return [str(name) for (name,) in rows]

    def hand_on(self, old: bytes, new: bytes | None) -> list[str]:
        """Replace a node in all of its groups (None: remove it), and return their names.

        A group that is measured changes too, because the node is out of service: `ncap` begins that measurement again.
        """
        names = self.names_of_node(old)
        with self._store.together():
            for name in names:
                self._remove(name, [old])
                self._report_member(name, [old], member=False)
                if new is not None and new not in self.get(name).uuids:
                    self._add(name, [new])
                    self._report_member(name, [new], member=True)
        return names

    def put(self, group: Group) -> None:
        """Add a group, or replace its members, without a report to the plant: it comes from a backup."""
        with self._store.together():
            self._store.execute(
                "INSERT INTO groups VALUES(?, ?) ON CONFLICT(name) DO NOTHING", (group.name, group.created)
            )
            self._store.execute("DELETE FROM group_members WHERE name = ?", (group.name,))
            self._add(group.name, group.uuids)

    def put_members(self, groups: Mapping[str, Sequence[bytes]]) -> None:
        """Add nodes to groups, by name, without a report to the plant; a group that does not exist is created."""
        self._store.execute_many("INSERT OR IGNORE INTO groups VALUES(?, ?)", ((name, utc_now()) for name in groups))
        for name, uuids in groups.items():
            self._add(name, uuids)

    def _add(self, name: str, uuids: Iterable[bytes]) -> None:
        self._store.execute_many("INSERT OR IGNORE INTO group_members VALUES(?, ?)", ((name, u) for u in uuids))

    def _remove(self, name: str, uuids: Iterable[bytes]) -> None:
        """Take nodes out of a group."""
        statement = "DELETE FROM group_members WHERE name = ? AND uuid = ?"
        self._store.execute_many(statement, ((name, uuid) for uuid in uuids))

    def _report_member(self, name: str, uuids: Iterable[bytes], *, member: bool) -> None:
        """Report to the plant which nodes joined or left a group."""
        for uuid in uuids:
            self._plant.record_event("grouped", uuid, group=name, member=member)

    @contextmanager
    def frozen(self, name: str) -> Iterator[None]:
        """Hold a group as it is; raises FrozenError if another process does."""
        digest = hashlib.sha256(
            name.encode()
        ).hexdigest()  # a name of 64 characters in any script can be too long for a file name
        place = self._home / f"measuring-{digest}.lock"
        descriptor = open_lock(place)
        try:
            try:
                lock(descriptor)
            except BlockingIOError:
                raise FrozenError(
                    f"Group {name!r} is being measured and cannot be changed now.", hint="End that measurement first."
                ) from None
            yield
        finally:
            os.close(descriptor)
