"""Values of documents, and a job: its payload word for word, when it may be worked on (contract/plant.md section 9)."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest

from teds_provision.errors import BadDataError
from teds_provision.protocol.handover.strict_json import decode_base64url
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.document import (
    JOB,
    PAGE,
    Fields,
    NewerFormatError,
    is_form,
    is_name,
    is_number,
    is_text,
    is_time,
    open_document,
    sign_document,
)
from teds_provision.protocol.plant.job import CalibrationRule, Job, open_job, require_pattern, seal_job

KEEPER = SoftwareKey(61)
ID, REGISTRY = "11111111-2222-4333-8444-555555555555", "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29"
A, B = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("8d4d9da65281f7000002")
SHA, SHA2, WEST, OFFICE = "a1" * 32, "a2" * 32, "b1" * 32, "c1" * 32
BEGINS, ENDS = datetime(2026, 3, 1, 8, tzinfo=UTC), datetime(2026, 3, 2, 8, tzinfo=UTC)


def finder(kid: str) -> bytes | None:
    return KEEPER.point if kid == fingerprint(KEEPER.point) else None


COUNTED = Job(
    ID, REGISTRY, "500 fingers", "tactile", SHA, CalibrationRule(), 5, {}, BEGINS, ENDS, {WEST: 3, OFFICE: 2}, "tap",
)  # fmt: skip
LISTED = replace(
    COUNTED, count=None, boards={B: SHA2, A: SHA}, stations={WEST: 900}, sign=OFFICE, evidence=False, assurance="bus",
    read_only=((0, 0), (65535, 255)), name="left {unit:03}", calibration=CalibrationRule("one", SHA2),
)  # fmt: skip
PAYLOAD: dict[str, Any] = {
    "format": "teds-job/1", "id": ID, "registry": REGISTRY, "title": "500 fingers", "profile": "tactile",
    "profile_sha256": SHA, "calibration": {"rule": "none"}, "nodes": {"count": 5},
    "not_before": "2026-03-01T08:00:00Z", "ends": "2026-03-02T08:00:00Z", "stations": {WEST: 3, OFFICE: 2},
    "assurance": "tap", "sign": "station", "evidence": True, "read_only": [], "name": None,
}  # fmt: skip
OF_LISTED = {
    "calibration": {"rule": "one", "sha256": SHA2}, "stations": {WEST: 900}, "assurance": "bus", "sign": OFFICE,
    "nodes": {"list": [{"uuid": B.hex(), "fingerprint": SHA2}, {"uuid": A.hex(), "fingerprint": SHA}]},
    "evidence": False, "read_only": [[0, 0], [65535, 255]], "name": "left {unit:03}",
}  # fmt: skip


@pytest.mark.parametrize(("job", "changes"), [(COUNTED, {}), (LISTED, OF_LISTED)], ids=["count", "list"])
def test_a_jobs_payload_is_its_members_in_the_order_of_the_contract(job: Job, changes: Mapping[str, Any]) -> None:
    octets = seal_job(job, KEEPER)
    due = json.dumps(PAYLOAD | dict(changes), separators=(",", ":"), ensure_ascii=False)
    assert decode_base64url(octets.split(b".")[1], "").decode() == due
    read = open_job(b"\n" + octets + b" \n", finder)
    assert replace(read, hash="", signer="", octets=b"") == job
    assert (read.signer, read.octets, len(read.hash)) == (fingerprint(KEEPER.point), octets, 64)


def test_how_many_boards_and_which_office() -> None:
    assert [(job.total, job.office) for job in (COUNTED, LISTED)] == [(5, None), (2, OFFICE)]


@pytest.mark.parametrize(
    ("rule", "members", "wants"),
    [
        (CalibrationRule(), {"rule": "none"}, [None, None]),
        (CalibrationRule("one", SHA), {"rule": "one", "sha256": SHA}, [SHA, SHA]),
        (CalibrationRule("any", max_age_days=1), {"rule": "any", "max_age_days": 1}, [None, None]),
        (CalibrationRule("list", by_uuid={A: SHA}), {"rule": "list", "by_uuid": {A.hex(): SHA}}, [SHA, None]),
    ],
)
def test_a_rule_for_calibrations(rule: CalibrationRule, members: dict[str, Any], wants: list[str | None]) -> None:
    assert rule.to_json() == members
    assert [rule.wants(uuid) for uuid in (A, B)] == wants
    assert open_job(seal_job(replace(COUNTED, calibration=rule), KEEPER), finder).calibration == rule


SECOND = timedelta(seconds=1)


@pytest.mark.parametrize(
    ("now", "station", "why"),
    [
        (BEGINS - SECOND, WEST, "it begins 2026-03-01T08:00:00Z"),
        (BEGINS, WEST, None),
        (ENDS - SECOND, OFFICE, None),
        (ENDS, WEST, "it ended 2026-03-02T08:00:00Z"),
        (BEGINS, SHA, "it is not for this station (a1a1a1a1a1a1a1a1)"),
    ],
)
def test_when_and_by_whom_a_job_is_worked_on(now: datetime, station: str, why: str | None) -> None:
    assert COUNTED.why_not(now, station) == why


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        (None, None),
        ("left hand", "left hand"),
        ("{unit} of {unit:03}", "7 of 007"),
        ("{unit:01}{unit:09}", "7000000007"),
        ("{uuid8}/{uuid}", "8d4d9da6/8d4d9da65281f7000001"),
    ],
)
def test_the_name_of_a_unit(pattern: str | None, name: str | None) -> None:
    assert replace(COUNTED, name=pattern).name_for(A, 7) == name


@pytest.mark.parametrize(
    "pattern", ["{unit:3}", "{unit:00}", "{unit:010}", "{uuid9}", "{n}", "a{", "a}", " a", "x" * 101]
)
def test_a_pattern_with_another_field_is_refused(pattern: str) -> None:
    with pytest.raises(BadDataError):
        require_pattern(pattern)


MANY = {f"{number:064x}": 0 for number in range(257)}
WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "ends at once": ({"ends": PAYLOAD["not_before"]}, "ends is not after not_before"),
    "too many allotted": ({"stations": {WEST: 4, OFFICE: 2}}, "stations have allotments of more than the 5 boards"),
    "no station": ({"stations": {}}, "stations is no object of 1 to 256 stations"),
    "257 stations": ({"stations": MANY}, "stations is no object of 1 to 256 stations"),
    "a negative allotment": ({"stations": {WEST: -1}}, "does not give each fingerprint an allotment"),
    "a list of stations": ({"stations": [WEST]}, "stations is no object of 1 to 256 stations"),
    "one good station": ({"stations": {WEST: 1, "west": 1}}, "does not give each fingerprint an allotment"),
    "a name as station": ({"stations": {"west": 1}}, "does not give each fingerprint an allotment"),
    "count 0": ({"nodes": {"count": 0}}, "count is no whole number of 1 to 4294967295"),
    "count and list": ({"nodes": {"count": 5, "list": []}}, "nodes is not one of count and list"),
    "neither": ({"nodes": {}}, "nodes is not one of count and list"),
    "no board": ({"nodes": {"list": []}}, "nodes lists no board, or one twice"),
    "a board twice": (
        {"nodes": {"list": [{"uuid": A.hex(), "fingerprint": SHA}, {"uuid": A.hex(), "fingerprint": SHA2}]}},
        "nodes lists no board, or one twice",
    ),
    "a board without a key": ({"nodes": {"list": [{"uuid": A.hex()}]}}, "fingerprint is no SHA-256"),
    "a rule": ({"calibration": {"rule": "some"}}, "rule is none of none, one, list, any"),
    "one of none": ({"calibration": {"rule": "one"}}, "sha256 is no SHA-256"),
    "0 days": ({"calibration": {"rule": "any", "max_age_days": 0}}, "max_age_days is no whole number of 1"),
    "an empty list": ({"calibration": {"rule": "list", "by_uuid": {}}}, "by_uuid is no object of 1 to 32768 boards"),
    "a list of names": ({"calibration": {"rule": "list", "by_uuid": {"a": SHA}}}, "does not give each UUID a SHA-256"),
    "a list of a list": ({"calibration": {"rule": "list", "by_uuid": [A.hex()]}}, "by_uuid is no object of 1 to 32768"),
    "one good digest": (
        {"calibration": {"rule": "list", "by_uuid": {A.hex(): SHA, B.hex(): "b"}}},
        "does not give each UUID",
    ),
    "a list of texts": ({"calibration": {"rule": "list", "by_uuid": {A.hex(): "a"}}}, "does not give each UUID"),
    "assurance": ({"assurance": "import"}, "assurance is none of uuid, bus, tap"),
    "an office by name": ({"sign": "office"}, "sign is no SHA-256"),
    "evidence 1": ({"evidence": 1}, "evidence is neither true nor false"),
    "a channel": ({"read_only": [[65536, 1]]}, "read_only is no list of"),
    "a code": ({"read_only": [[0, 256]]}, "read_only is no list of"),
    "a code below": ({"read_only": [[0, -1]]}, "read_only is no list of"),
    "a channel below": ({"read_only": [[-1, 0]]}, "read_only is no list of"),
    "three of a block": ({"read_only": [[0, 1, 2]]}, "read_only is no list of"),
    "2001 blocks": ({"read_only": [[0, 1]] * 2001}, "read_only has 2001 entries; at most 2000 are read"),
    "a pattern": ({"name": "{n}"}, "holds something else than"),
    "an empty name": ({"name": ""}, "name is no name of 1 to 100 printable characters"),
    "the title": ({"title": " a"}, "title is no name of 1 to 100 printable characters"),
}


@pytest.mark.parametrize("what", WRONG)
def test_a_job_that_does_not_add_up_is_refused_by_the_member_that_is_wrong(what: str) -> None:
    changes, why = WRONG[what]
    octets = sign_document(PAYLOAD | changes, KEEPER, JOB)
    with pytest.raises(BadDataError) as caught:
        open_job(octets, finder)
    assert why in caught.value.message


@pytest.mark.parametrize("changes", [{"stations": {WEST: 3, OFFICE: 2}}, {"stations": {WEST: 0}}, {"more": 1}])
def test_a_job_whose_allotments_are_its_boards_or_fewer_is_read(changes: dict[str, Any]) -> None:
    assert open_job(sign_document(PAYLOAD | changes, KEEPER, JOB), finder).count == 5


# -- values of any document --------------------------------------------------------------------------------------------

POINT = KEEPER.point.hex()


@pytest.mark.parametrize(
    ("check", "good", "bad"),
    [
        (lambda value: is_form("uuid", value), ["0a" * 10], ["0A" * 10, "0a" * 9, "0a" * 10 + "\n", b"0a" * 10, None]),
        (lambda value: is_form("sha256", value), ["0a" * 32], ["0A" * 32, "0a" * 31, "0a" * 33]),
        (lambda value: is_form("digits", value), ["0a" * 8], ["0A" * 8, "0a" * 7, "0g" * 8]),
        (lambda value: is_form("point", value), [POINT], [POINT[2:], "02" + POINT[2:], POINT.upper()]),
        (lambda value: is_form("random_id", value), [ID], [ID.replace("-4", "-5"), ID.replace("-8", "-7"), ID[1:]]),
        (is_time, ["2026-01-31T12:00:00Z"], ["2026-02-31T12:00:00Z", "2026-01-31T12:00:00", "2026-01-31 12:00:00Z",
                                             "2026-01-31T12:00:00+00:00", "2026-01-31T24:00:00Z", 5, None]),
        (is_number, [0, 4294967295], [-1, 4294967296, True, 1.0, "1", None]),
        (is_name, ["a", "x" * 100, "a b", "ü"], ["", "x" * 101, " a", "a ", "a\tb", None, 1]),
        (is_text, ["", " a ", "x" * 1024], ["x" * 1025, "a\nb", None, 1]),
    ],
)  # fmt: skip
def test_each_value_has_one_spelling(check: Callable[[object], bool], good: list[object], bad: list[object]) -> None:
    assert [check(value) for value in good] == [True] * len(good)
    assert [check(value) for value in bad] == [False] * len(bad)


def fields(value: object) -> Fields:
    return Fields({"m": value}, "The thing")


@pytest.mark.parametrize(
    ("read", "good", "bad", "why"),
    [
        (lambda f: f.number("m", 2), [2, 4294967295], [1, 4294967296, True, 2.0, None],
         "is no whole number of 2 to 4294967295"),
        (lambda f: f.number("m"), [0], [-1], "is no whole number of 0 to 4294967295"),
        (lambda f: f.flag("m"), [True, False], [0, 1, None], "is neither true nor false"),
        (lambda f: f.one_of("m", ("a", "b")), ["a", "b"], ["ab", None, 1], "is none of a, b"),
        (lambda f: f.list_of("m", 2), [[], [1, 2]], [(), None, "ab"], "is no list"),
        (lambda f: f.list_of("m", 2), [[]], [[1, 2, 3]], "has 3 entries; at most 2 are read"),
        (lambda f: f.name("m"), ["a"], [""], "is no name of 1 to 100 printable characters"),
        (lambda f: f.text_of_form("digits", "m"), ["0a" * 8], ["0A" * 8], "is no 16 hex digits in lower case"),
        (lambda f: list(f.place("m")), [[0, ""], [1, SHA], [4294967295, SHA]],
         [[0, SHA], [1, ""], [-1, SHA], [1], [1, SHA, 1], [True, SHA], None], "is no page as [number, H]"),
    ],
)  # fmt: skip
def test_a_member_is_read_strictly(read: Callable[[Fields], Any], good: list[Any], bad: list[Any], why: str) -> None:
    assert [read(fields(value)) for value in good] == good
    for value in bad:
        with pytest.raises(BadDataError) as caught:
            read(fields(value))
        assert caught.value.message == f"The thing: m {why}."


def test_members_that_are_read_as_octets_points_and_times() -> None:
    assert fields("AAEC").octets("m", 3) == b"\0\1\2"
    assert fields(POINT).point("m") == KEEPER.point
    assert fields("2026-03-01T08:00:00Z").time("m") == BEGINS
    assert Fields({}, "The thing").list_of("m", 0) == []
    off_the_curve = "04" + "00" * 63 + "01"
    wrong: tuple[tuple[Callable[[], object], str], ...] = (
        (lambda: fields("AAEC").octets("m", 2), "is no 2 octets in base64url"),
        (lambda: fields(None).octets("m", 2), "is no 2 octets in base64url"),
        (lambda: fields(off_the_curve).point("m"), "is no point of the curve P-256"),
        (lambda: fields("2026-02-30T08:00:00Z").time("m"), "is no time"),
    )
    for read, why in wrong:
        with pytest.raises(BadDataError) as caught:
            read()
        assert caught.value.message == f"The thing: m {why}."
    with pytest.raises(BadDataError, match=r"The thing is not an object\."):
        Fields([], "The thing")


@pytest.mark.parametrize(
    ("name", "newer"),
    [("teds-page/2", True), ("teds-page/10", True), ("teds-page/123456789", True), ("teds-page/1234567890", False),
     ("teds-page/0", False), ("teds-page/01", False), ("teds-roster/2", False), ("teds-page/", False), (2, False)],
)  # fmt: skip
def test_a_newer_version_of_the_format_is_told_apart_from_another_format(name: object, newer: bool) -> None:
    octets = sign_document({"format": name}, KEEPER, PAGE)
    with pytest.raises(BadDataError) as caught:
        open_document(octets, finder, PAGE)
    assert isinstance(caught.value, NewerFormatError) is newer
