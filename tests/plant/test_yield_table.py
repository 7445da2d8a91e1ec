"""The attempts of a job as a table: a sheet shows what stands there, and runs none of it."""

from __future__ import annotations

import csv
import io
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.plant.yield_stats import Attempt, to_csv
from teds_provision.station.station import Station


def rows(attempt: Attempt, name: str) -> dict[str, Any]:
    roster = SimpleNamespace(name_of=lambda fingerprint: name)
    station = cast("Station", SimpleNamespace(plant=SimpleNamespace(roster=roster)))
    (row,) = csv.DictReader(io.StringIO(to_csv(station, [attempt])))
    return row


@pytest.mark.parametrize(
    ("name", "shown"),
    [("west", "west"), ("w=1", "w=1"), *((f"{sign}1+1", f"'{sign}1+1") for sign in "=+-@")],
)
def test_a_stations_name_is_no_formula(name: str, shown: str) -> None:
    assert rows(Attempt("ab" * 32, bytes(10), 1, 1, None, "2026-01-31T12:00:00Z"), name)["name"] == shown


def test_nor_is_what_another_station_or_a_document_says_of_an_attempt() -> None:
    """A code comes from a page, a step's name from a file of evidence."""
    row = rows(Attempt("ab" * 32, bytes(10), 1, 1, "=1+1", "2026-01-31T12:00:00Z", {"@step": 1.0, "sign": 2.0}), "west")
    assert (row["code"], row["'@step"], row["sign"]) == ("'=1+1", "1.0", "2.0")


def test_each_step_has_a_column_in_the_order_in_which_the_attempts_name_them() -> None:
    """A station without a roster has no names of others."""
    station = cast("Station", SimpleNamespace(plant=SimpleNamespace(roster=None)))
    steps: list[dict[str, float]] = [{"write": 0.5}, {"sign": 0.25, "write": 1.0}, {}]
    attempts = (Attempt("ab" * 32, bytes(10), 1, 1, None, "2026-01-31T12:00:00Z", each) for each in steps)
    header, *lines = to_csv(station, attempts).splitlines()
    assert header.endswith(",seconds,write,sign")
    start = f"{'ab' * 32},,{'00' * 10},1,1,passed,,2026-01-31T12:00:00Z,"
    assert lines == [f"{start}0.500,0.5,", f"{start}1.250,1.0,0.25", f"{start}0.000,,"]


def test_seconds_and_verdict_of_an_attempt() -> None:
    passed = rows(Attempt("ab" * 32, bytes(10), 7, 2, None, "2026-01-31T12:00:00Z", {"sign": 0.5, "write": 1.25}), "x")
    assert (passed["seconds"], passed["sign"], passed["verdict"], passed["code"]) == ("1.750", "0.5", "passed", "")
    failed = rows(Attempt("ab" * 32, bytes(10), None, 1, "no-node", "2026-01-31T12:00:00Z"), "x")
    assert (failed["seconds"], failed["unit"], failed["verdict"], failed["code"]) == ("", "", "failed", "no-node")
