"""Deal the tests to the workers of pytest-xdist: each begins with those that take long, and ends with short ones.

``--dist worksteal`` gives each worker an equal number of tests, in their order, and a worker that is done takes from
the end of another one's. In the order of the files, a worker still had the browsers of the page before it when others
had nothing left: one of two cores waited for a fifth of the time. Modules stay whole, as their fixtures are made once
in a worker; so do rooms whose fixtures are of the package.
"""

from __future__ import annotations

import itertools
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeVar

SECONDS: Final = {
    "tests/pairs": 10.0,
    "tests/page": 6.3,
    "tests/mutants": 5.0,
    "tests/faults": 5.0,
    "tests/model": 5.0,
    "tests/ncap": 3.3,
    "tests/e2e": 2.1,
    "tests/strangers": 1.6,
    "tests/measure": 1.5,
    "tests/firmware": 0.74,
    "tests/check": 0.71,
    "tests/links": 0.68,
    "tests/plant": 0.53,
    "tests/node": 0.45,
    "tests/vault": 0.35,
}
"""Seconds of a test of a room in the mean, for the order alone (a gate at a load of 20, 2026-11-27); others: little."""
WHOLE: Final = ("tests/page",)
"""Rooms that are not divided: their fixtures are of the package."""

Test = TypeVar("Test")


@dataclass
class _Share:
    size: int
    seconds: float = 0.0
    places: list[int] = field(default_factory=list)


def room_of(test: str) -> str:
    """Return the room of a test's id: the folder below ``tests``, or the file there."""
    return "/".join(test.partition("::")[0].split("/")[:2])


def dealt(tests: Sequence[Test], names: Sequence[str], workers: int) -> list[Test]:
    """Return tests in the order in which each of so many workers gets a fair share; ``names`` are their ids."""
    shares, left = list[_Share](), len(tests)
    for number in range(workers):
        shares.append(_Share(left // (workers - number)))  # as WorkStealingScheduling divides them
        left -= shares[-1].size
    units = [list(found) for _, found in itertools.groupby(range(len(tests)), key=lambda place: _unit(names[place]))]
    long = [unit for unit in units if room_of(names[unit[0]]) in SECONDS]
    for unit in sorted(long, key=lambda unit: -SECONDS[room_of(names[unit[0]])]):
        fits = [share for share in shares if len(share.places) + len(unit) <= share.size]
        share = min(fits or shares, key=lambda share: share.seconds)
        share.places += unit
        share.seconds += len(unit) * SECONDS[room_of(names[unit[0]])]
    short = iter(place for unit in units if room_of(names[unit[0]]) not in SECONDS for place in unit)
    for share in shares:
        share.places += itertools.islice(short, max(0, share.size - len(share.places)))
    order = [place for share in shares for place in share.places] + list(short)
    return [tests[place] for place in order]


def _unit(name: str) -> Hashable:
    room = room_of(name)
    return room if room in WHOLE else name.partition("::")[0]
