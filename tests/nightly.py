"""Hold the mark ``nightly``: its reason names a test of the gate that holds the same rule.

A test moves out of the gate only if its rule is still held there, by a cheaper test. The reason begins with the id of
that test, or with those of several: ``@pytest.mark.nightly("tests/x.py::test_y holds this rule")``. Each must be there
and in the gate, as far as its file is among what is collected: ``make test`` collects everything.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

OUTSIDE = ("nightly", "soak", "machine", "rclpy")
REFUSED = pytest.StashKey[list[str]]()
UNNAMED = pytest.StashKey[list[Path]]()
"""Files with tests marked realtime in which the mark does not stand: make unit finds them by it."""
_ID = re.compile(r"tests/[\w/]+\.py::\w+(?:\[[^\]]*\])?")


def reasons(item: pytest.Item) -> Iterator[str]:
    """Yield the reason of each mark ``nightly`` of a test; "" for one without."""
    for mark in item.iter_markers("nightly"):
        yield str(mark.args[0]) if mark.args else ""


def refusals(items: Sequence[pytest.Item]) -> list[str]:
    """Return what is wrong with the marks of tests that were collected, a line each.

    An id without brackets stands for all cases of its test, of which one at least is in the gate.
    """
    marked = [(item.nodeid, reason, _ID.findall(reason)) for item in items for reason in reasons(item)]
    named = {name.partition("[")[0] for _, _, names in marked for name in names}
    holders = [item for item in items if item.nodeid.partition("[")[0] in named]
    gate = [item.nodeid for item in holders if not any(item.get_closest_marker(mark) for mark in OUTSIDE)]
    there = {*gate, *(name.partition("[")[0] for name in gate)}
    files = {item.nodeid.partition("::")[0] for item in items}
    wrong = []
    for test, reason, names in marked:
        if not names or not reason.startswith(names[0]):
            wrong.append(f"{test}: the reason of its mark nightly begins with no test")
        wrong += [
            f"{test}: its rule is not held in the gate by {name}"
            for name in names
            if name not in there and name.partition("::")[0] in files
        ]
    return wrong
