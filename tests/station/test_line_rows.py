"""Rows of a line: jobs, units, evidence, requests to an office (contract/plant.md sections 9 to 11)."""

from __future__ import annotations

from dataclasses import replace

from teds_provision.station.plant.line import EvidenceRow, JobRow, SignRequestRow, UnitRow
from teds_provision.station.station import Station
from teds_provision.station.store import database

A, B = bytes([1] * 10), bytes([2] * 10)
FIRST, SECOND, THIRD = (f"2026-10-0{day}T08:00:00Z" for day in (1, 2, 3))


def document(digits: str, uuid: bytes, job: str | None, attempt: int) -> EvidenceRow:
    unit = None if job is None else 4
    return EvidenceRow(digits * 32, uuid, job, unit, attempt, "pass", FIRST, b"document " + digits.encode())


def test_a_job_stays_as_it_was_taken_but_for_its_state(station: Station) -> None:
    line = station.plant.line
    late, early = JobRow("job-1", "1" * 64, b"one", "open", SECOND), JobRow("job-2", "2" * 64, b"two", "closed", FIRST)
    twin = JobRow("job-0", "0" * 64, b"none", "open", SECOND)
    for row in (late, early, twin, replace(late, hash="9" * 64, octets=b"another", state="closed", at=FIRST)):
        line.add_job(row)
    assert line.jobs() == [early, twin, late]
    assert [line.job("job-1"), line.job("job-9")] == [late, None]
    assert [line.state_of(id) for id in ("job-1", "job-2", "job-9")] == [
        ("open", False), ("closed", False), (None, False)
    ]  # fmt: skip
    line.set_job_state("job-1", "closed")
    for state in ("open", "closed"):
        line.set_job_state("job-1", state)
        assert [row.state for row in line.jobs()] == ["closed", "open", state]
    line.put_end_seen("job-2")
    line.put_end_seen("job-2")
    line.put_end_seen("job-9")
    assert line.jobs() == [early, twin, replace(late, state="closed")]
    assert [line.state_of(id) for id in ("job-1", "job-2", "job-9")] == [
        ("closed", False), ("closed", True), (None, True)
    ]  # fmt: skip


def test_a_board_keeps_its_unit_of_each_job_and_passes_it_once(station: Station) -> None:
    line = station.plant.line
    assert line.count_units("job-1") == (0, 0, 0)
    rows = UnitRow("job-1", A, 9, SECOND, 1, 0), UnitRow("job-1", B, 3, FIRST), UnitRow("job-2", A, 12, THIRD, 2, 2)
    for row in rows:
        line.put_unit(row)
    assert line.units("job-1") == [rows[1], rows[0]]
    assert [line.unit("job-1", A), line.unit("job-2", A), line.unit("job-2", B)] == [rows[0], rows[2], None]
    line.put_unit(UnitRow("job-1", A, 5, THIRD, 3, 0))
    assert line.unit("job-1", A) == UnitRow("job-1", A, 9, SECOND, 3, 0)
    assert line.count_units("job-1") == (2, 0, 9)
    line.put_passed("job-1", A, 3)
    line.put_passed("job-1", A, 4)
    line.put_passed("job-2", B, 4)
    assert line.unit("job-1", A) == UnitRow("job-1", A, 9, SECOND, 3, 3)
    assert line.unit("job-1", B) == rows[1]
    assert line.units("job-2") == [rows[2]]
    line.put_unit(replace(rows[2], attempts=5, passed=1))
    assert line.units("job-2") == [UnitRow("job-2", A, 12, THIRD, 5, 1)]
    assert [line.count_units(job) for job in ("job-1", "job-2", "job-3")] == [(2, 1, 9), (1, 1, 12), (0, 0, 0)]


def test_attempts_outside_any_job_are_counted_by_themselves(station: Station) -> None:
    line = station.plant.line
    for row in (document("aa", A, "job-1", 7), document("bb", B, None, 5), document("cc", A, "job-2", 8)):
        line.add_evidence(row)
    assert [line.last_attempt(uuid) for uuid in (A, B)] == [0, 5]
    for digits, attempt in (("dd", 2), ("ee", 1)):
        line.add_evidence(document(digits, A, None, attempt))
    assert [line.last_attempt(uuid) for uuid in (A, B)] == [2, 5]


def test_documents_come_by_board_and_attempt_and_stay_as_they_are(station: Station) -> None:
    line = station.plant.line
    rows = [
        document("dd", A, None, 1), document("ee", A, "job-1", 1), document("aa", A, "job-1", 2),
        document("cc", B, "job-1", 1), document("bb", B, "job-2", 10),
    ]  # fmt: skip
    for row in reversed(rows):
        line.add_evidence(row)
    line.add_evidence(replace(rows[0], verdict="fail", document=b"another"))
    assert list(line.evidence()) == rows
    assert list(line.evidence(uuid=A)) == rows[:3]
    assert list(line.evidence(job="job-1")) == rows[1:4]
    assert list(line.evidence(uuid=B, job="job-1")) == [rows[3]]
    assert list(line.evidence(uuid=B, job="job-9")) == []


def test_documents_come_some_at_a_time_without_a_gap(station: Station) -> None:
    assert database.CHUNK == 500
    line = station.plant.line
    with station.transaction():
        for number in range(1001):
            digits = f"{1000 - number:04x}"  # three of each attempt, in the order of their digests
            line.add_evidence(replace(document("aa", A, None, 1 + number // 3), sha256=digits * 16))
    found = [(row.attempt, row.sha256[:4]) for row in line.evidence(uuid=A)]
    assert len(set(found)) == 1001
    assert found == sorted(found)


def test_requests_to_an_office_are_kept_by_direction_and_in_the_order_of_their_sequence(station: Station) -> None:
    line = station.plant.line
    asked = SignRequestRow("1" * 64, "out", "job-1", A, "office", b"request", at=FIRST)
    later = SignRequestRow("2" * 64, "out", "job-1", A, "office", b"again", b"answer", 7, SECOND)
    first = SignRequestRow("3" * 64, "out", "job-1", A, "office", b"before", b"answer", 6, THIRD)
    twin = SignRequestRow("0" * 64, "out", "job-1", A, "office", b"twin", at=THIRD)
    answered = SignRequestRow("4" * 64, "in", "job-1", A, "line", b"request", b"answer", 1, FIRST)
    for row in (
        asked,
        later,
        first,
        twin,
        answered,
        replace(asked, hash="5" * 64, uuid=B),
        replace(asked, hash="6" * 64, job="job-2"),
    ):
        line.put_sign_request(row)
    assert line.sign_requests("job-1", A, "out") == [twin, asked, first, later]
    assert line.sign_requests("job-1", A, "in") == [answered]
    assert [line.sign_request("1" * 64, "out"), line.sign_request("1" * 64, "in")] == [asked, None]
    signed = replace(asked, answer=b"signed", sequence=8)
    line.put_sign_request(signed)
    assert line.sign_requests("job-1", A, "out") == [twin, first, later, signed]


def test_every_request_is_given_once_however_many_there_are(station: Station) -> None:
    line = station.plant.line
    assert list(line.all_sign_requests()) == []
    rows = [
        SignRequestRow(f"{number:02x}" * 32, "out" if number % 2 else "in", "job", A, "office", b"request", at=FIRST)
        for number in range(40)
    ]  # fmt: skip
    with station.transaction():
        for row in reversed(rows):
            line.put_sign_request(row)
    assert list(line.all_sign_requests()) == rows
