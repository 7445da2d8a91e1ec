"""Which attempts of a job are known: by evidence, by pages that count, by what an office signed (docs/line.md)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.plant import status
from teds_provision.plant.yield_stats import UNREPORTED, StationYield, attempts_of
from teds_provision.protocol.plant.roster import RemovedMember
from teds_provision.station.plant.line import EvidenceRow, SignRequestRow, UnitRow
from teds_provision.station.plant.pages import PageRow
from teds_provision.station.station import Station
from tests.bench import Board
from tests.plant.owner import alone
from tests.plant.proofs import evidence_of
from tests.plant.test_contract_states import held, others

JOB, OTHER = "11111111-2222-4333-8444-555555555555", "22222222-2222-4333-8444-555555555555"
A, B, C = (bytes([number]) * 10 for number in (1, 2, 3))
AT = "2026-01-31T12:00:00Z"


@pytest.fixture
def station(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "alone")
    yield made
    made.close()


def said(number: int, uuid: bytes, verdict: str = "passed", sha256: str = "", **more: Any) -> dict[str, Any]:
    return {
        "act": "evidence", "id": f"{number:016x}", "at": AT, "uuid": uuid.hex(), "sha256": sha256 or f"{number:064x}",
        "job": JOB, "unit": number, "verdict": verdict, **more,
    }  # fmt: skip


def page(station: Station, of: str, n: int, *events: dict[str, Any], hash: str = "") -> None:
    """Have a page of a station here, as it was taken in."""
    with station.transaction():
        chain = station.plant.pages.chain(of)
        content = json.dumps({"events": list(events)}).encode()
        row = PageRow(n, hash or f"{n:064x}", f"{n - 1:064x}" if n > 1 else "", AT, "", b"", content, bytes(64))
        station.plant.pages.add(chain.id, row)
        station.plant.pages.put_chain(replace(chain, counted=(n, row.hash), folded=(n, row.hash)))


def found(station: Station, *files: bytes) -> list[tuple[str, bytes, int | None, int, str | None]]:
    return [(one.station, one.uuid, one.unit, one.attempt, one.code) for one in attempts_of(station, JOB, files)]


def test_what_pages_say_of_a_job(station: Station) -> None:
    west, south = others(station, west="line", south="line")
    held(station, west, south)
    signed = {**said(5, A), "act": "signed", "epoch": 1, "sequence": 1, "teds_sha256": "ab" * 32}
    bad = {**said(6, A), "sha256": "short"}
    page(station, west.fingerprint, 1, said(1, B, "failed: no-node"), said(2, A), said(7, C, job=OTHER), signed, bad)
    page(station, west.fingerprint, 2, said(3, B), said(4, C, "failed"))
    page(station, south.fingerprint, 1, said(9, B, unit=None))
    first, second = sorted([(west.fingerprint, "west"), (south.fingerprint, "south")])
    of = {
        "west": [
            (west.fingerprint, A, 2, 1, None),
            (west.fingerprint, B, 1, 1, "no-node"),
            (west.fingerprint, B, 3, 2, None),  # the second that its pages have of this board
            (west.fingerprint, C, 4, 1, "failed"),
        ],
        "south": [(south.fingerprint, B, None, 1, None)],
    }
    assert found(station) == of[first[1]] + of[second[1]]
    assert {one.finished for one in attempts_of(station, JOB)} == {AT}
    assert attempts_of(station, "33333333-2222-4333-8444-555555555555") == []


def test_pages_that_do_not_count_say_nothing_of_a_job(station: Station) -> None:
    """Of a station that left, those beyond its last one; of two histories, those from where they part."""
    west, south = others(station, west="line", south="line")
    held(
        station, south, removed=(RemovedMember("west", west.point, frozenset({"line"}), "stolen", (1, f"{1:064x}")),)
    )  # fmt: skip
    page(station, west.fingerprint, 1, said(1, A))
    page(station, west.fingerprint, 2, said(2, B))  # the thief's
    page(station, south.fingerprint, 1, said(3, A))
    page(station, south.fingerprint, 2, said(4, B))
    page(station, south.fingerprint, 2, said(5, C), hash="ee" * 32)
    assert sorted(found(station)) == sorted([(west.fingerprint, A, 1, 1, None), (south.fingerprint, A, 3, 1, None)])


def test_evidence_goes_before_pages_and_is_counted_once(station: Station) -> None:
    (west,) = others(station, west="line")
    held(station, west)
    board = Board()
    steps = (("identify", "done", 41), ("write", "done", 1250), ("verify", "no-node", 300))
    document = evidence_of(station, board, job=JOB, unit=4, attempt=2, steps=steps)
    other = evidence_of(station, Board(uuid=B), job=OTHER, unit=1)
    digest = hashlib.sha256(document).hexdigest()
    own = station.fingerprint
    page(station, own, 1, said(1, board.uuid, "failed: no-node", digest), said(2, board.uuid))
    assert found(station, document, other) == [(own, board.uuid, 4, 2, "no-node")], (
        "of its page by the digest, of the other by its number"
    )
    (attempt,) = attempts_of(station, JOB, [document])
    assert attempt.steps == {"identify": 0.041, "write": 1.25}, "the step that failed has no time of its own"
    station.plant.line.add_evidence(EvidenceRow(digest, board.uuid, JOB, 4, 2, "failed", AT, document))
    assert found(station) == found(station, document)
    page(station, own, 2, said(3, board.uuid))
    assert [row[3:] for row in found(station)] == [(2, "no-node"), (3, None)]


def test_what_an_office_signed_counts_until_the_line_reports(station: Station) -> None:
    west, south = others(station, west="line", south="line")
    held(station, west, south)
    line = station.plant.line
    line.put_unit(UnitRow(JOB, A, 7, AT))
    line.put_unit(UnitRow(JOB, B, 8, AT))
    for number, (uuid, peer, sequence) in enumerate(
        [(A, west, 1), (A, west, 2), (A, south, 3), (B, west, None)]  # the last one was refused
    ):
        row = SignRequestRow(f"{number:064x}", "in", JOB, uuid, peer.fingerprint, b"r", b"a", sequence, AT)
        line.put_sign_request(row)
    line.put_sign_request(SignRequestRow("f" * 64, "out", JOB, B, "ab" * 32, b"r", b"a", 5, AT))
    both = sorted([west.fingerprint, south.fingerprint])
    assert found(station) == [(peer, A, 7, 1, UNREPORTED) for peer in both]
    page(station, west.fingerprint, 1, said(1, A))
    assert sorted(found(station)) == sorted(
        [(west.fingerprint, A, 1, 1, None), (south.fingerprint, A, 7, 1, UNREPORTED)]
    )


@pytest.mark.parametrize(("units", "over"), [(2, False), (3, False), (4, True)])
def test_a_station_is_over_its_allotment_beyond_it(units: int, over: bool) -> None:
    assert StationYield("ab" * 32, "west", 3, units).over is over


def test_which_events_the_log_of_the_registry_gives(station: Station) -> None:
    west, south = others(station, west="line", south="line")
    held(
        station, south, removed=(RemovedMember("west", west.point, frozenset({"line"}), "lost", (1, f"{1:064x}")),)
    )  # fmt: skip
    page(station, west.fingerprint, 1, said(1, A), {"act": "no such act"}, said(2, B))
    page(station, west.fingerprint, 2, said(3, A))
    page(station, south.fingerprint, 1, said(4, A))

    def given(**choice: Any) -> list[tuple[str, int, bool, int]]:
        return sorted((one.station, one.number, one.counts, one.event["unit"]) for one in status.log(station, **choice))

    of_west = [
        (west.fingerprint, 1, True, 1), (west.fingerprint, 1, True, 2), (west.fingerprint, 2, False, 3)
    ]  # fmt: skip
    of_south = [(south.fingerprint, 1, True, 4)]
    assert given() == sorted([*of_west, *of_south]), "each with whether its page counts"
    assert given(of=west.fingerprint) == of_west
    assert given(of=south.fingerprint) == of_south
    assert given(uuid=B) == [of_west[1]]
    assert given(uuid=A, of=west.fingerprint) == [of_west[0], of_west[2]]
    assert given(since=AT) == given()
    assert given(since="2026-01-31T12:00:01Z") == []
    assert [one.number for one in status.log(station, of=west.fingerprint)] == [1, 1, 2], "in the order of the pages"
