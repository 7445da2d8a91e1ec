"""Alarms of the plant: what a person has to decide, or must know."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from teds_provision.station.store.database import places
from teds_provision.station.store.records import utc_now
from teds_provision.station.store.store import Store


@dataclass(frozen=True)
class Alarm:
    """Something that a person has to decide, or must know: junk, fork, two histories, two rosters, rolled back."""

    code: str
    about: str
    n: int
    why: str
    at: str = field(default_factory=utc_now)
    seen: bool = False


_ALARM = ", ".join(column.name for column in fields(Alarm))


class Alarms:
    """The alarms that one station knows of."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def forget_all(self) -> None:
        """Remove every alarm."""
        self._store.execute("DELETE FROM alarms")

    def all(self) -> list[Alarm]:
        """Return every alarm, oldest first."""
        return self._store.read(_alarm, f"SELECT {_ALARM} FROM alarms ORDER BY at, code, about, n")

    def put(self, alarm: Alarm, *, again: bool = False) -> bool:
        """Keep an alarm; False if it exists already (it keeps its time, and stays seen).

        ``again``: this is one more occurrence, and no state that lasts, so one that was seen is raised again.
        """
        values = (alarm.code, alarm.about, alarm.n, alarm.why, alarm.at, int(alarm.seen))
        with self._store.together():
            if again:
                self._store.execute(
                    "DELETE FROM alarms WHERE code = ? AND about = ? AND n = ? AND seen = 1", values[:3]
                )
            return self._store.change(f"INSERT OR IGNORE INTO alarms({_ALARM}) VALUES({places(values)})", values) > 0

    def end(self, alarm: Alarm) -> None:
        """Take one alarm away whose cause is gone."""
        self._store.execute(
            "DELETE FROM alarms WHERE code = ? AND about = ? AND n = ?", (alarm.code, alarm.about, alarm.n)
        )

    def end_about(self, code: str, about: str) -> int:
        """Take alarms away whose cause is gone; returns how many."""
        return self._store.change("DELETE FROM alarms WHERE code = ? AND about = ?", (code, about))

    def end_all_of(self, code: str) -> int:
        """Take all alarms of one code away; returns how many."""
        return self._store.change("DELETE FROM alarms WHERE code = ?", (code,))

    def see(self) -> int:
        """Note that a person knows of every alarm; returns of how many he did not."""
        return self._store.change("UPDATE alarms SET seen = 1 WHERE seen = 0", ())


def _alarm(*row: Any) -> Alarm:
    return Alarm(row[0], row[1], row[2], row[3], row[4], bool(row[5]))
