"""Which entries of the log are meant: every criterion, whatever signs a text has, and where a look begins."""

from __future__ import annotations

from typing import Any

import pytest

from teds_provision import errors
from teds_provision.station.store.audit import AuditEntry, AuditFilter, acting_for, by_token, is_failure
from teds_provision.station.store.store import Store

A, B = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("aad4d9da65281f700002")

ENTRIES: list[tuple[str, bytes | None, str, dict[str, object], str | None, str]] = [
    ("init", None, "done", {}, None, "2026-01-01T08:00:00Z"),
    ("write", A, "done", {"name": "50%_off!"}, "page", "2026-01-02T08:00:00Z"),
    ("write", A, "node-refused", {"why": "O'Neil"}, by_token("robot"), "2026-01-05T08:00:00Z"),
    ("verify", B, "authentic", {"name": "Größe"}, None, "2026-01-03T08:00:00Z"),  # the clock was put back
    ("verify", B, "not authentic", {"path": "a\\b"}, None, "2026-01-04T08:00:00Z"),
    ("measure", None, "unproven", {}, "page", "2026-01-06T08:00:00Z"),
]


@pytest.fixture
def log(store: Store, monkeypatch: pytest.MonkeyPatch) -> Store:
    monkeypatch.setattr("teds_provision.station.store.audit._who", lambda: "anna@bench")
    for act, uuid, outcome, detail, actor, at in ENTRIES:
        with monkeypatch.context() as patch, acting_for(actor):
            patch.setattr("teds_provision.station.store.audit.utc_now", lambda at=at: at)
            store.audit.append(act, uuid, outcome, detail)
    return store


@pytest.mark.parametrize(
    ("choice", "numbers"),
    [
        ({}, [1, 2, 3, 4, 5, 6]),
        ({"uuid": A}, [2, 3]),
        ({"act": "write"}, [2, 3]),
        ({"act": "wri"}, []),
        ({"act": "' OR 1=1 --"}, []),
        ({"act": "write\\0"}, []),
        ({"failed": True}, [3, 5, 6]),
        ({"text": "WRITE"}, [2, 3]),  # the act, in either case
        ({"text": "authentic"}, [4, 5]),  # the outcome
        ({"text": "O'NEIL"}, [3]),  # a detail
        ({"text": "50%"}, [2]),
        ({"text": "%"}, [2]),
        ({"text": "_off"}, [2]),
        ({"text": "off!"}, [2]),
        ({"text": "x_off"}, []),  # no sign stands for another
        ({"text": "Größe"}, [4]),
        ({"text": "a\\b"}, [5]),
        ({"text": "robot"}, [3]),  # the actor
        ({"text": "anna@"}, [1, 4, 5]),
        ({"text": "AAD4"}, [4, 5]),  # digits of a UUID
        ({"text": ""}, [1, 2, 3, 4, 5, 6]),
        ({"before": 3}, [1, 2]),
        ({"since": "2026-01-04T08:00:00Z"}, [3, 5, 6]),
        ({"since": "2026-01-04T08:00:01Z"}, [3, 6]),
        ({"since": "' OR 1=1 --"}, [1, 2, 3, 4, 5, 6]),  # a text that is less than every digit
        ({"uuid": A, "failed": True, "act": "write", "before": 4}, [3]),
        ({"uuid": B, "failed": True, "text": "robot"}, []),
    ],
)
def test_an_entry_must_meet_all_criteria(log: Store, choice: dict[str, Any], numbers: list[int]) -> None:
    assert [entry.seq for entry in log.audit.chosen(AuditFilter(**choice))] == numbers
    assert [entry.seq for entry in log.audit.chosen(AuditFilter(**choice), 3)] == [seq for seq in numbers if seq > 3]


@pytest.mark.parametrize(
    ("choice", "last", "before"),
    [
        ({}, None, 0),
        ({}, 2, 4),
        ({}, 99, 0),
        ({"act": "write"}, 1, 2),
        ({"act": "write"}, 5, 1),
        ({"act": "no such"}, 1, 6),  # nothing: all that follows the end
        ({"since": "2026-01-03T08:00:00Z"}, None, 2),
        ({"since": "2027-01-01T00:00:00Z"}, None, 6),
        ({"since": "2026-01-06T08:00:00Z"}, None, 5),
        ({"since": "2026-01-06T08:00:01Z"}, None, 6),
        ({"since": "2026-01-03T08:00:00Z"}, 2, 4),
        ({"act": "write", "since": "2026-01-01T00:00:00Z"}, None, 0),
        ({"act": "write"}, None, 0),
    ],
)
def test_where_a_look_begins(log: Store, choice: dict[str, Any], last: int | None, before: int) -> None:
    assert log.audit.entry_before(AuditFilter(**choice), last=last) == before


def test_an_empty_log_begins_at_its_end(store: Store) -> None:
    assert store.audit.entry_before(AuditFilter(), last=3) == 0
    assert store.audit.entry_before(AuditFilter(since="2026-01-01T00:00:00Z")) == 0
    assert store.audit.latest() is None


def test_who_acted_and_the_newest_entry(log: Store) -> None:
    entries = list(log.audit.entries())
    assert [entry.who for entry in entries] == [
        "anna@bench", "page", "token robot", "anna@bench", "anna@bench", "page"
    ]  # fmt: skip
    assert [entries[number].actor for number in (0, 1, 2)] == ["anna@bench", "page", "robot"]
    assert log.audit.latest() == "2026-01-06T08:00:00Z"
    assert log.audit.newest() == (6, entries[-1].hash)
    assert isinstance(entries[0], AuditEntry)


def codes() -> list[str]:
    """Return the code of every error that can end an act."""
    found, waiting = set(), [errors.TedsProvisionError]
    while waiting:
        kind = waiting.pop()
        waiting += kind.__subclasses__()
        if kind.__module__ == "teds_provision.errors":
            found.add(kind.code)
    return sorted(found - {"error"})


@pytest.mark.parametrize("code", codes())
def test_every_error_that_ends_an_act_is_a_failure(code: str) -> None:
    assert is_failure(code)


GOOD = (
    "done", "authentic", "created", "receipt", "came back", "merged", "again", "lifted", "taken", "passed",
    "decommissioned", "rotation due", "taken over", "nothing to do",
)  # fmt: skip
BAD = (
    "failed", "not authentic", "unsigned", "unproven", "other key", "declined", "read-back differs", "interrupted",
    "wrong-board", "no-node",
)  # fmt: skip


@pytest.mark.parametrize(
    ("outcome", "failed"),
    [
        *((word, False) for word in GOOD),
        *((word, True) for word in BAD),
    ],
)
def test_which_outcomes_are_failures(outcome: str, failed: bool) -> None:
    assert is_failure(outcome) is failed
