"""A job at a line, rule by rule (contract/plant.md section 9): whose, when, which board, how many, calibrations."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import KeyMismatchError, NotFoundError, PolicyError, RosterExpiredError
from teds_provision.plant import jobs, line
from teds_provision.plant.jobs import close_job, job_id, read_job, require_open, take_job
from teds_provision.plant.line import LineRun, LineUnit, Scans, _firmware_in_session, _step_facts
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.messages.firmware import FirmwareReport
from teds_provision.protocol.plant.evidence import BoardFacts, EvidenceClaim
from teds_provision.protocol.plant.job import CalibrationRule, Job, seal_job
from teds_provision.protocol.plant.roster import RemovedMember
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import PreparedOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.progress import StepResult
from teds_provision.shapes.verdict import Check, Verification
from teds_provision.station.plant.line import EvidenceRow, UnitRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import WhitelistEntry
from tests.bench import make_station
from tests.plant.owner import ALL, NOW, alone, job_of, join, member, roster_of
from tests.provisioning.test_firmware import GOOD

A, B, C, D = (bytes.fromhex("8d4d9da65281f7") + number.to_bytes(3, "big") for number in range(4))
KEEPER = SoftwareKey(4242)
KEY = "ab" * 32
ME, OTHER = "me", "5c" * 32
PREPARED = cast("PreparedOrder", SimpleNamespace(calibrations=None))


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[Station]:
    made = alone(tmp_path / "home")
    yield made
    made.close()


def job(owner: Station, **changes: Any) -> Job:
    if "stations" in changes:
        changes["stations"] = {owner.fingerprint if who == ME else who: n for who, n in changes["stations"].items()}
    return take_job(owner, job_of(owner, **changes))


def board(uuid: bytes = A, key: str = KEY, listed: WhitelistEntry | None = None) -> IdentifiedNode:
    return cast("IdentifiedNode", SimpleNamespace(uuid=uuid, fingerprint=key, whitelisted=listed))


def seen(assurance: Any) -> WhitelistEntry:
    return WhitelistEntry(A, KEY, assurance=assurance)


def allotted(run: LineRun, uuid: bytes = A, how: str = "tap", *, tapped: bool = False) -> LineUnit:
    """Return the unit that a board gets, on the disk."""
    node = cast("Conversation", SimpleNamespace(tapped=tapped))
    unit = run.allot_unit(node, board(uuid), PREPARED, replace(seen(how), uuid=uuid))
    assert unit.prepared is not None
    return unit


# -- whose job, and when -----------------------------------------------------------------------------------------------


def test_a_job_of_who_is_a_keeper_no_more_begins_no_more(owner: Station) -> None:
    made = job(owner)
    octets = seal_job(replace(made, id="11111111-2222-4333-8444-555555555555"), KEEPER)
    gone = RemovedMember("old", KEEPER.point, frozenset({"keeper"}), "retired", (9, "ab" * 32))
    now = roster_of(owner, member(owner, "owner", *ALL), version=2, previous="0" * 64, removed=(gone,))
    join(owner, now)
    with pytest.raises(PolicyError, match="old signed this job but is not a keeper"):
        read_job(owner, octets)


def test_no_job_begins_from_the_very_end_of_the_roster(owner: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    made, roster = job(owner, ends=NOW + timedelta(days=400)), owner.plant.roster
    assert roster is not None
    monkeypatch.setattr(jobs, "now_of", lambda held: held.expires - timedelta(seconds=1))
    require_open(owner, made)
    monkeypatch.setattr(jobs, "now_of", lambda held: held.expires)
    with pytest.raises(RosterExpiredError):
        require_open(owner, made)


@pytest.mark.parametrize(
    ("at", "why"), [(-1, "it begins"), (0, ""), (7199, ""), (7200, "it ended"), (7201, "it ended")]
)
def test_a_job_is_open_from_not_before_until_before_its_end(
    owner: Station, monkeypatch: pytest.MonkeyPatch, at: int, why: str
) -> None:
    made = job(owner)
    monkeypatch.setattr(jobs, "now_of", lambda roster: made.not_before + timedelta(seconds=at))
    if not why:
        require_open(owner, made)
        return
    with pytest.raises(PolicyError, match=why) as error:
        require_open(owner, made)
    assert error.value.exit_code == 6


def test_a_job_is_for_its_stations_and_an_office_asks_for_the_line(owner: Station) -> None:
    made = job(owner, stations={OTHER: 3})
    require_open(owner, made, for_station=OTHER)
    with pytest.raises(PolicyError, match="it is not for this station"):
        require_open(owner, made)
    with pytest.raises(PolicyError, match="it is not for this station"):
        require_open(owner, made, for_station="6d" * 32)


def test_a_line_keys_boards_only_with_its_role_and_tests_them_without(owner: Station) -> None:
    made = job(owner)
    join(owner, roster_of(owner, member(owner, "owner", "keeper", "base"), version=2, previous="0" * 64))
    with pytest.raises(PolicyError, match="does not have the role 'line'"):
        LineRun(owner, made)
    LineRun(owner, made, only_verify=True)


def test_a_job_that_ended_since_the_run_began_takes_no_further_board(
    owner: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = LineRun(owner, job(owner))
    run.order(board())
    made = run.job
    assert made is not None
    monkeypatch.setattr(jobs, "now_of", lambda roster: made.ends)
    with pytest.raises(PolicyError, match="it ended"):
        run.order(board())


def test_a_job_that_is_closed_is_told_and_takes_nothing(owner: Station) -> None:
    made = job(owner)
    for _ in range(2):
        close_job(owner, made)
    closed = [entry for entry in owner.audit_log.entries() if entry.act == "job"]
    assert [(entry.uuid, entry.outcome, entry.detail) for entry in closed] == [(None, "closed", {"job": made.id})]
    [(_, _, text)] = owner.plant.outbox(9)
    told = json.loads(text)
    assert (told["act"], told["job"]) == ("closed", made.id)
    assert "uuid" not in told
    with pytest.raises(PolicyError, match="it is closed here"):
        require_open(owner, made)


def test_a_job_is_named_by_its_id_or_at_least_four_digits_of_it(owner: Station) -> None:
    ids = [f"{digits}-8a55-4d9c-8e56-09c29c295609" for digits in ("abcd0000", "abcd1111", "beef1111")]
    for each in ids:
        job(owner, id=each)
    assert [job_id(owner, text) for text in ("beef", "BEEF1", "abcd0", ids[1], ids[1].upper())] == [
        ids[2], ids[2], ids[0], ids[1], ids[1]
    ]  # fmt: skip
    for text, why in (("abcd", "2 jobs have an ID"), ("bee", "There is no job bee"), (ids[1][:-1] + "0", "no job")):
        with pytest.raises(NotFoundError, match=why):
            job_id(owner, text)


# -- which board -------------------------------------------------------------------------------------------------------


def test_a_job_with_a_list_is_for_these_boards_with_these_keys(owner: Station) -> None:
    run = LineRun(owner, job(owner, count=None, boards={A: KEY, B: KEY}))
    run.order(board(A))
    with pytest.raises(KeyMismatchError, match="the job says"):
        run.order(board(A, "cd" * 32))
    with pytest.raises(PolicyError, match="is not on the job's list"):
        run.order(board(C))
    assert [run.is_listed(uuid) for uuid in (A, C)] == [True, False]
    assert [run.lists(who) for who in (board(A), board(A, "cd" * 32), board(C))] == [True, False, False]


@pytest.mark.parametrize(
    ("wanted", "enough"),
    [
        ("uuid", {"uuid", "import", "registry", "bus", "tap"}),
        ("bus", {"bus", "tap"}),
        ("tap", {"tap"}),
    ],
)
def test_a_board_is_known_as_well_as_the_job_asks(owner: Station, wanted: str, enough: set[str]) -> None:
    run = LineRun(owner, job(owner, assurance=wanted, count=9, stations={ME: 9}))
    for number, how in enumerate(("uuid", "import", "registry", "bus", "tap")):
        uuid = A[:-1] + bytes([number])
        if how in enough:
            assert allotted(run, uuid, how).assurance == how
            continue
        with pytest.raises(PolicyError, match=f"requires assurance '{wanted}'; board .* was identified by '{how}'"):
            allotted(run, uuid, how)
        assert owner.plant.line.unit(run.job.id, uuid) is None  # type: ignore[union-attr]
    assert allotted(run, A[:-1] + b"\x09", "uuid", tapped=True).assurance == "tap", "it is in the field"
    node = cast("Conversation", SimpleNamespace(tapped=False))
    if wanted == "uuid":
        assert run.allot_unit(node, board(D), PREPARED, None).assurance == "uuid"
        assert run.allot_unit(node, board(D, listed=seen("bus")), PREPARED, None).assurance == "bus"


# -- how many ----------------------------------------------------------------------------------------------------------


def test_each_board_gets_the_next_unit_once_and_its_station_no_more_than_its_allotment(
    owner: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = LineRun(owner, job(owner, count=5, stations={ME: 2, OTHER: 3}))
    first = allotted(run)
    assert first.row == UnitRow(run.job.id, A, 1, first.row.at, 1, 0)  # type: ignore[union-attr]
    again = allotted(run)
    assert (again.row.unit, again.attempt) == (1, 2)  # type: ignore[union-attr]
    assert (allotted(run, B).row.unit, run.unit_to_json(B)) == (  # type: ignore[union-attr]
        2, {"job": run.job.id, "unit": 2, "of": 5, "attempt": 1}  # type: ignore[union-attr]
    )  # fmt: skip
    asked = list[bytes]()
    with monkeypatch.context() as patch:
        patch.setattr(LineUnit, "wait_for", lambda _unit, _job, uuid: asked.append(uuid))
        with pytest.raises(PolicyError, match=r"All 2 units of the job .* for this station are assigned") as error:
            allotted(run, C)
    assert (error.value.exit_code, asked) == (6, []), "before anything is asked of the board"
    assert allotted(run, B).attempt == 2, "who has one keeps it"
    fresh = LineRun(owner, run.job)
    with pytest.raises(PolicyError, match="All 2 units"):
        allotted(fresh, C)


def test_the_next_unit_is_one_above_the_greatest(owner: Station) -> None:
    run = LineRun(owner, job(owner, count=9, stations={ME: 9}))
    assert run.job is not None
    with owner.transaction():
        owner.plant.line.put_unit(UnitRow(run.job.id, B, 5, "2026-01-31T12:00:00Z"))
    assert allotted(run).row.unit == 6  # type: ignore[union-attr]


def test_a_job_with_a_list_has_a_unit_for_each_board_of_it_whatever_its_allotment(owner: Station) -> None:
    run = LineRun(owner, job(owner, count=None, boards={A: KEY, B: KEY}, stations={ME: 1}))
    assert [allotted(run, uuid).row.unit for uuid in (A, B)] == [1, 2]  # type: ignore[union-attr]
    with pytest.raises(PolicyError, match="All 2 units"):
        allotted(run, C)


def test_a_rebuilt_home_gives_no_new_unit_before_it_knows_which_it_gave(
    owner: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = LineRun(owner, job(owner))
    allotted(run)
    owner.plant.begin_restored()
    fresh = LineRun(owner, run.job)
    assert allotted(fresh).attempt == 2, "of a board whose unit is known"
    monkeypatch.setattr(LineUnit, "wait_for", lambda *_: pytest.fail("the board was asked"))
    with pytest.raises(PolicyError, match="restored from a backup") as error:
        fresh.allot_unit(cast("Conversation", SimpleNamespace(tapped=True)), board(B), PREPARED, None)
    monkeypatch.undo()
    assert error.value.hint == "To get them: teds-provision registry sync"
    owner.plant.end_restored()
    assert allotted(LineRun(owner, run.job), B).row.unit == 2  # type: ignore[union-attr]


# -- what is noted -----------------------------------------------------------------------------------------------------


def kept(run: LineRun, unit: LineUnit, failure: str | None, document: bytes) -> dict[str, Any]:
    """Keep evidence of an attempt, and return its event."""
    job_id, number = (unit.row.job, unit.row.unit) if unit.row is not None else (None, None)
    facts = SimpleNamespace(failure=failure, job=job_id, unit=number, attempt=unit.attempt)
    run.keep(document, cast("EvidenceClaim", SimpleNamespace(uuid=A, facts=facts)), "2026-03-01T12:00:00Z", unit)
    told: dict[str, Any] = json.loads(run.station.plant.outbox(99)[-1][2])
    return {name: value for name, value in told.items() if name not in ("id", "at")}


def test_evidence_is_kept_whole_and_told_with_its_digest_and_what_failed(owner: Station) -> None:
    run = LineRun(owner, job(owner))
    assert run.job is not None
    line = owner.plant.line
    told = kept(run, allotted(run), "node-silent", b"first")
    digest = hashlib.sha256(b"first").hexdigest()
    assert told == {
        "act": "evidence", "uuid": A.hex(), "sha256": digest, "job": run.job.id, "unit": 1,
        "verdict": "failed: node-silent",
    }  # fmt: skip
    assert list(line.evidence()) == [
        EvidenceRow(digest, A, run.job.id, 1, 1, "failed", "2026-03-01T12:00:00Z", b"first")
    ]
    assert (line.count_units(run.job.id), run.passed, run.total) == ((1, 0, 1), 0, 3)
    assert [(entry.act, entry.uuid, entry.outcome, entry.detail) for entry in owner.audit_log.entries()][-2:] == [
        ("unit", A, "taken", {"job": run.job.id, "unit": 1, "attempt": 1}),
        ("evidence", A, "failed", {"sha256": digest, "attempt": 1}),
    ]
    assert kept(run, allotted(run), None, b"second")["verdict"] == "passed"
    kept(run, allotted(run), None, b"third")
    assert line.unit(run.job.id, A) == UnitRow(run.job.id, A, 1, line.unit(run.job.id, A).at, 3, 2)  # type: ignore[union-attr]
    assert (line.count_units(run.job.id), run.passed) == ((1, 1, 1), 1)


def test_who_only_tests_a_board_takes_no_unit_and_passes_none(owner: Station) -> None:
    made = job(owner)
    build, test = LineRun(owner, made), LineRun(owner, made, only_verify=True)
    earlier = LineRun(owner, job(owner, title="an earlier one"))
    kept(earlier, allotted(earlier), None, b"of another job")
    taken = allotted(build)
    kept(build, taken, "node-silent", b"built")
    for attempt in (2, 3):
        unit = allotted(test)
        assert (unit.attempt, unit.row) == (attempt, taken.row)
        kept(test, unit, None, bytes([attempt]))
    assert owner.plant.line.count_units(made.id) == (1, 0, 1)
    assert (allotted(test, B).row, allotted(test, B).attempt) == (None, 1)
    assert owner.plant.line.count_units(made.id) == (1, 0, 1)


def test_a_job_that_wants_no_evidence_gets_none_of_a_failure_either(owner: Station) -> None:
    run = LineRun(owner, job(owner, evidence=False))
    silent = cast("Conversation", None)
    allotted(run).failed(silent, board(), (), "agree", NotFoundError("x"))
    assert list(owner.plant.line.evidence()) == []


@pytest.mark.parametrize("result", ["passed", "failed"])
@pytest.mark.parametrize("evidence", [True, False])
def test_a_board_of_a_job_counts_and_gets_its_label_if_it_passed_with_evidence_or_without(
    owner: Station, monkeypatch: pytest.MonkeyPatch, evidence: bool, result: Any
) -> None:
    run = LineRun(owner, job(owner, evidence=evidence))
    unit, labels, kept = allotted(run), list[bytes](), list[object]()
    monkeypatch.setattr(run, "passed_board", labels.append)
    monkeypatch.setattr(unit, "_keep", lambda _node, _uuid, _teds, steps, _image: kept.append(steps))
    verified = Verification(A, (Check("signed", result, "why"),))
    step = SimpleNamespace(name="write", result="done", seconds=0.5)
    done: Any = SimpleNamespace(
        who=SimpleNamespace(uuid=A), verified=verified, steps=(step,), image=SimpleNamespace(security=b"teds")
    )
    unit.ended(cast("Conversation", None), done)
    passed = result == "passed"
    assert labels == ([A] if passed else [])
    if evidence:
        steps = (("write", "done", 500),)
        assert kept == [steps if passed else (*steps, ("verdict", "not-authentic", 0))]
    else:
        assert (kept, run.passed) == ([], int(passed))


@pytest.mark.parametrize("of_a_job", [True, False])
def test_the_facts_of_a_board_are_those_of_its_job_else_of_its_datasheet(
    owner: Station, monkeypatch: pytest.MonkeyPatch, of_a_job: bool
) -> None:
    """The profile is the one that the job demanded, whatever the station knows of the board."""
    owner.nodes.remember(A, profile="known-before")
    run = LineRun(owner, job(owner) if of_a_job else None)
    unit, kept = allotted(run), list[BoardFacts]()
    shown = SimpleNamespace(key_epoch=3, sequence=9, signed_blocks={})
    for name, value in {
        "security.decode": lambda _teds: shown,
        "blocks_of": lambda _shown: (),
        "profile_files_digest": lambda _station, record: f"of {record.profile}",
        "_firmware_in_session": lambda _node: ("a", "1.0.0", "", 1),
        "sign_evidence": lambda _node, _credentials, claim, **_more: kept.append(claim.facts) or b"document",
    }.items():
        monkeypatch.setattr(f"teds_provision.plant.line.{name}", value)
    monkeypatch.setattr(run, "keep", lambda *_words: None)
    monkeypatch.setattr(run, "calibration_digest", lambda uuid: "cd" * 32 if uuid == A else None)
    unit._keep(cast("Conversation", None), A, b"teds", (("write", "done", 5),), None)
    [facts] = kept
    of_no_job = (None, None, "known-before", "of known-before")
    wanted = of_no_job if run.job is None else (run.job.id, 1, run.job.profile, run.job.profile_sha256)
    assert (facts.job, facts.unit, facts.profile, facts.profile_sha256) == wanted
    assert facts.profile != "known-before" or not of_a_job
    assert (facts.attempt, facts.epoch, facts.sequence, facts.steps) == (1, 3, 9, (("write", "done", 5),))
    assert (facts.calibration_sha256, facts.assurance, facts.firmware) == ("cd" * 32, "tap", ("a", "1.0.0", "", 1))
    assert facts.heads is not None
    assert (facts.certificates, facts.origin) == ((), None)


def test_a_station_asks_no_office_if_it_is_the_office_itself_or_the_job_has_none(owner: Station) -> None:
    nothing: Any = None
    for sign in ("station", owner.fingerprint):
        unit = allotted(LineRun(owner, job(owner, sign=sign)))
        assert unit.sign(nothing, nothing, nothing, nothing) is None
    unit = allotted(LineRun(owner, job(owner, sign=OTHER)))
    with pytest.raises(PolicyError, match="An office signs for this job"):
        unit.sign(nothing, nothing, nothing, nothing)


def test_attempts_outside_a_job_are_counted_by_themselves(owner: Station) -> None:
    run = LineRun(owner, job(owner))
    kept(run, allotted(run), None, b"in a job")
    outside = LineRun(owner, None)
    unit = allotted(outside)
    assert (unit.row, unit.attempt) == (None, 1)
    told = kept(outside, unit, None, b"outside")
    assert (told["job"], told["unit"]) == (None, None)
    assert allotted(outside).attempt == 2


def test_a_station_that_joined_no_registry_keeps_evidence_and_tells_nothing(tmp_path: Path) -> None:
    station = make_station(tmp_path / "single")
    run = LineRun(station, None)
    facts = SimpleNamespace(failure=None, job=None, unit=None, attempt=1)
    claim = cast("EvidenceClaim", SimpleNamespace(uuid=A, facts=facts))
    run.keep(b"document", claim, "2026-03-01T12:00:00Z", allotted(run))
    assert len(list(station.plant.line.evidence())) == 1
    assert station.plant.outbox(9) == []
    station.close()


@pytest.mark.parametrize(
    ("sealed", "reported", "stated"),
    [
        (True, (7, GOOD), True),
        (True, (6, GOOD), False),  # of an earlier session
        (False, (7, GOOD), False),  # outside any session
        (True, (7, None), False),
        (True, None, False),
    ],
)
def test_evidence_states_the_firmware_of_the_session_that_is_open(
    sealed: bool, reported: tuple[int, FirmwareReport | None] | None, stated: bool
) -> None:
    node = SimpleNamespace(sealed=sealed, reported_firmware=reported, open_counter=7)
    text, version, image = GOOD.stated
    facts = (text, version, image or "0" * 64, int(GOOD.flags))
    assert _firmware_in_session(cast("Conversation", node)) == (facts if stated else None)


# -- calibrations ------------------------------------------------------------------------------------------------------

TABLE = b"raw, value\n0, 0\n16384, 6.283185307\n"


def test_a_calibration_is_the_very_file_that_the_job_names(tmp_path: Path, owner: Station) -> None:
    folder = tmp_path / "calibrations"
    folder.mkdir()
    digest = hashlib.sha256(TABLE).hexdigest()
    one = job(owner, calibration=CalibrationRule("one", digest))
    with pytest.raises(NotFoundError, match=r"calibration .* was not found"):
        LineRun(owner, one, calibrations=folder)
    (folder / "a.csv").write_bytes(b"raw, value\n0, 0\n16384, 3\n")
    (folder / "b.csv").write_bytes(TABLE)
    run = LineRun(owner, one, calibrations=folder)
    assert run.order(board()).order.calibration == folder / "b.csv"
    assert run.order(board()).order.drop_calibration is False
    assert run.calibration_digest(A) == digest
    LineRun(owner, one, calibrations=folder / "b.csv").order(board())
    with pytest.raises(NotFoundError):
        LineRun(owner, one, calibrations=folder / "a.csv")
    LineRun(owner, one, only_verify=True)

    listed = job(owner, calibration=CalibrationRule("list", by_uuid={A: digest}))
    run = LineRun(owner, listed, calibrations=folder)
    with pytest.raises(NotFoundError, match=f"There is no file {A.hex()}"):
        run.order(board())
    (folder / f"{A.hex()}.d").mkdir()
    (folder / f"{A.hex()}.csv").write_bytes(TABLE + b"\n")
    with pytest.raises(PolicyError, match="is not the one the job specifies"):
        run.order(board())
    (folder / f"{A.hex()}.csv").write_bytes(TABLE)
    assert run.order(board()).order.calibration == folder / f"{A.hex()}.csv"
    (folder / f"{A.hex()}.toml").write_bytes(TABLE)
    with pytest.raises(NotFoundError, match="There is 2 files"):
        run.order(board())
    with pytest.raises(NotFoundError, match="requires a calibration for each board"):
        LineRun(owner, listed).order(board())
    none = LineRun(owner, job(owner), calibrations=folder)
    assert none.order(board()).order.drop_calibration is True, "a board that has one loses it"
    assert (none.order(board()).order.calibration, none.calibration_digest(A)) == (None, None)


def test_a_calibration_may_be_so_many_days_old_and_a_day_ahead(
    tmp_path: Path, owner: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = LineRun(owner, job(owner, calibration=CalibrationRule("any", max_age_days=30)), calibrations=tmp_path)
    now = NOW.replace(hour=0, minute=0, second=0)
    monkeypatch.setattr("teds_provision.plant.line.now_of", lambda roster: now)
    for days, good in ((30, True), (31, False), (-1, True), (-2, False)):
        (tmp_path / f"{A.hex()}.csv").write_bytes(f"# date: {now - timedelta(days=days):%Y-%m-%d}\n".encode() + TABLE)
        if good:
            run.order(board())
            continue
        with pytest.raises(PolicyError, match="the job allows at most 30 days"):
            run.order(board())


@pytest.mark.parametrize("wrong", [{2: 31}, {1: 31}, {2: None}, {1: None, 2: 0}])
def test_the_calibration_of_every_channel_must_be_recent_enough(
    owner: Station, monkeypatch: pytest.MonkeyPatch, wrong: dict[int, int | None]
) -> None:
    run = LineRun(owner, job(owner, calibration=CalibrationRule("any", max_age_days=30)))
    monkeypatch.setattr("teds_provision.plant.line.now_of", lambda roster: NOW)

    def aged(days: dict[int, int | None]) -> PreparedOrder:
        dates = {number: None if age is None else NOW - timedelta(days=age) for number, age in days.items()}
        found = {number: SimpleNamespace(date=date) for number, date in dates.items()}
        return cast("PreparedOrder", SimpleNamespace(calibrations=found))

    run._require_fresh(Path("c.csv"), aged({1: 0, 2: 30}))
    with pytest.raises(PolicyError, match=r"The calibration c\.csv of channel [12] .*at most 30 days"):
        run._require_fresh(Path("c.csv"), aged({1: 0, 2: 0, **wrong}))


def test_a_scan_is_of_the_last_label_with_its_key() -> None:
    notices: list[str] = []
    scans = Scans([f"{B.hex()}\n", f"TEDS1:{A.hex()}:{KEY}\n", "\n", "nonsense\n"], notices.append)
    scans.listen()
    assert notices == [
        f"Waiting for board {B.hex()}.", f"Waiting for board {A.hex()}.", "This is not a board label: nonsense"
    ]  # fmt: skip
    scans.require(board(A))
    for other in (board(B), board(A, "cd" * 32)):
        with pytest.raises(WrongBoardError, match=f"belongs to board {A.hex()}, but this is board {other.uuid.hex()}"):
            scans.require(other)
    scans.require(board(A))
    scans.add_label(B.hex().upper())
    scans.require(board(B, "cd" * 32))
    for malformed in (B.hex() + "00", B.hex()[:-1], "g" * 20):
        scans.add_label(malformed)
        assert notices[-1] == f"This is not a board label: {malformed}"
    scans.require(board(B))


def test_the_steps_of_evidence_have_whole_milliseconds_and_the_failure_stands_apart() -> None:
    steps = [StepResult("agree", "done", 0.0016), StepResult("sign", "nothing to do", 0.0004),
             StepResult("write", "skipped"), StepResult("verify", "failed", 1.2506)]  # fmt: skip
    assert _step_facts(steps) == (
        ("agree", "done", 2), ("sign", "nothing to do", 0), ("write", "skipped", 0), ("verify", "done", 1251)
    )  # fmt: skip


def test_the_label_of_each_board_that_passed_has_its_uuid_and_the_chosen_ending(
    owner: Station, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, cleared, written = LineRun(owner, job(owner)), list[bytes](), list[tuple[str, Path, bool]]()
    monkeypatch.setattr(line, "label_of", lambda station, uuid: uuid.hex() if station is owner else "")
    monkeypatch.setattr(line, "write_label", lambda text, path: written.append((text, path, path.parent.is_dir())))
    run.scans = cast("Scans", SimpleNamespace(clear=cleared.append))
    run.passed_board(A)
    assert written == []
    run.label_to = tmp_path / "new" / "labels" / "x.png"
    for uuid in (A, B):
        run.passed_board(uuid)
    folder = run.label_to.parent
    assert written == [(uuid.hex(), folder / f"{uuid.hex()}.png", True) for uuid in (A, B)]
    assert cleared == [A, A, B], "the next board is another one"


def test_a_unit_belongs_to_its_job(owner: Station) -> None:
    first, second = (LineRun(owner, job(owner, title=title)) for title in ("first", "second"))
    allotted(first, B)
    assert allotted(first).row.unit == 2  # type: ignore[union-attr]
    assert allotted(second).row.unit == 1  # type: ignore[union-attr]
