"""A line works on a job: what it may, a unit for each board, and what is refused without a unit lost."""

from __future__ import annotations

import hashlib
import json
import uuid
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import plant
from teds_provision.errors import (
    BadDataError,
    KeyMismatchError,
    NodeSilentError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    RosterExpiredError,
)
from teds_provision.plant import jobs, parcels
from teds_provision.plant import line as line_module
from teds_provision.plant import owner as owning
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.jobs import close_job, digest_of_file, find_job, take_job, take_received
from teds_provision.plant.line import LineRun, Scans
from teds_provision.plant.sign_requests import send_job
from teds_provision.plant.verify_evidence import EvidenceAnchors
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.messages.frames import SECURITY_CLASS, Function
from teds_provision.protocol.messages.identity import NodeState
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.job import CalibrationRule, Job, open_job, require_pattern, seal_job
from teds_provision.protocol.plant.roster import Place, RemovedMember, Roster
from teds_provision.provisioning.board_type import WrongBoardError
from teds_provision.provisioning.build import BuildOrder, PreparedOrder, prepare
from teds_provision.provisioning.identify import IdentifiedNode
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import ProvisionResult, provision, verify_only
from teds_provision.station.plant.parcels import ParcelRow
from teds_provision.station.station import Station
from teds_provision.teds.certificate import certificate_reference_of
from teds_provision.teds.profile.load import files_digest, find_profile, shipped_profiles
from tests.answers import Answers
from tests.bench import PASSPHRASE, Board, MemoryLink, make_station, talk
from tests.provisioning.test_firmware import GOOD, FirmwareBoard
from tests.teds.certificates import ANGLE as CERTIFICATE

from .owner import ALL, ANGLE, NOW, alone, job_of, join, member, roster_of
from .stations import Plant


@pytest.fixture
def owner(tmp_path: Path) -> Iterator[Station]:
    station = alone(tmp_path / "home")
    yield station
    station.close()


def build(line: LineRun, board: Board, link: MemoryLink | None = None) -> ProvisionResult:
    with talk(board, link) as node:
        return provision(
            line.station, node, line.order, operator=AcceptingOperator(), reporter=SilentReporter(), line=line
        )


def line_of(owner: Station, calibrations: Path | None = None, **changes: Any) -> LineRun:
    return LineRun(owner, take_job(owner, job_of(owner, **changes)), calibrations=calibrations)


def make_board(number: int) -> Board:
    return Board(uuid=bytes.fromhex("8d4d9da65281f7") + number.to_bytes(3, "big"))


def units(line: LineRun) -> list[tuple[int, int, int]]:
    assert line.job is not None
    return [(row.unit, row.attempts, row.passed) for row in line.station.plant.line.units(line.job.id)]


def test_each_board_gets_one_unit_and_leaves_evidence(owner: Station) -> None:
    line = line_of(owner, name="angle {unit:03} {uuid8}")
    boards = [make_board(0), make_board(1), FirmwareBoard(make_board(2).uuid)]
    for built_board in boards:
        assert build(line, built_board).verified.verdict == "authentic"
    assert units(line) == [(1, 1, 1), (2, 1, 1), (3, 1, 1)]
    assert (line.passed, line.total) == (3, 3)
    assert line.job is not None
    rows = list(owner.plant.line.evidence(job=line.job.id))
    assert [row.unit for row in rows] == [1, 2, 3]
    for row in rows:
        assert hashlib.sha256(row.document).hexdigest() == row.sha256
        found = codec.read(row.document)
        assert codec.faults(found, owner.identity.ca) == []
        assert [name for name, _, _ in found.facts.steps][-1] == "check"
    assert [codec.read(row.document).facts.firmware for row in rows] == [None, None, codec.firmware_facts(GOOD)]
    known = owner.nodes.get(boards[1].uuid)
    assert known is not None
    assert known.name == "angle 002 8d4d9da6"


def test_a_second_try_takes_no_second_unit(owner: Station) -> None:
    line, board = line_of(owner), make_board(1)
    build(line, board)
    build(line, board)
    assert units(line) == [(1, 2, 1)], "its first pass was its first attempt"
    assert [row.attempt for row in owner.plant.line.evidence(uuid=board.uuid)] == [1, 2]


def test_one_board_too_many_is_refused_and_stays_what_it_is(owner: Station) -> None:
    line = line_of(owner, count=2, stations={owner.identity.fingerprint: 2})
    build(line, make_board(1))
    build(line, make_board(2))
    third = make_board(3)
    with pytest.raises(PolicyError, match="one too many"):
        build(line, third)
    assert third.state.state == NodeState.FACTORY
    assert len(units(line)) == 2


@dataclass
class _HookedLink(MemoryLink):
    """Calls ``before`` with the function of each plain security command before it leaves."""

    before: Callable[[int], None] = lambda function: None

    def exchange(self, frame: bytes) -> bytes:
        if frame[2] == SECURITY_CLASS:
            self.before(frame[3])
        return super().exchange(frame)


def test_the_last_unit_goes_to_one_of_two_boards_that_are_worked_on_at_once(owner: Station) -> None:
    """Another process takes it after this one has looked: then the board gets no key, no unit and no evidence."""
    line, late = line_of(owner, count=1, stations={owner.identity.fingerprint: 1}), make_board(2)
    assert line.job is not None
    with Station.open(owner.home, ask=lambda prompt, confirm: PASSPHRASE) as other:
        beside = LineRun(other, find_job(other, line.job.id))

        def meanwhile(function: int) -> None:
            if function == Function.REQUEST:
                build(beside, make_board(1))

        with pytest.raises(PolicyError, match="one too many"):
            build(line, late, _HookedLink(late, before=meanwhile))
    assert late.state.state == NodeState.FACTORY
    assert not owner.keys.held(late.uuid)
    assert [row.uuid for row in owner.plant.line.units(line.job.id)] == [make_board(1).uuid]
    assert list(owner.plant.line.evidence(uuid=late.uuid)) == []
    assert line.unit_to_json(late.uuid) == {}


@pytest.mark.parametrize("evidence", [True, False])
def test_a_board_that_falls_silent_before_it_has_a_key_has_its_unit_all_the_same(
    owner: Station, evidence: bool
) -> None:
    """The attempt counts, and its evidence names the unit that the store has."""

    def silent(function: int) -> None:
        if function == Function.REQUEST:
            raise NodeSilentError("It was pulled.")

    line, board = line_of(owner, evidence=evidence), make_board(1)
    with pytest.raises(NodeSilentError):
        build(line, board, _HookedLink(board, before=silent))
    assert units(line) == [(1, 1, 0)]
    rows = list(owner.plant.line.evidence(uuid=board.uuid))
    assert [(row.unit, row.attempt, row.verdict) for row in rows] == ([(1, 1, codec.FAILED)] if evidence else [])
    assert line.unit_to_json(board.uuid)["unit"] == 1


def test_a_unit_whose_try_broke_off_is_not_passed_by_a_test_of_the_board(owner: Station) -> None:
    """It was made outside the job meanwhile; only the line passes a unit."""

    def silent(function: int) -> None:
        if function == Function.REQUEST:
            raise NodeSilentError("It was pulled.")

    line, board = line_of(owner), make_board(1)
    with pytest.raises(NodeSilentError):
        build(line, board, _HookedLink(board, before=silent))
    build(LineRun(owner, None, BuildOrder(profile=ANGLE)), board)
    tests = LineRun(owner, line.job, only_verify=True)
    with talk(board) as node:
        assert verify_only(owner, node, tests, SilentReporter()).verified.verdict == "authentic"
    assert units(line) == [(1, 1, 0)]
    build(line, board)
    assert units(line) == [(1, 2, 2)]


def test_a_unit_is_on_the_disk_with_the_key_and_the_verdict_with_the_evidence(owner: Station) -> None:
    """Beside a job a board needs no commit more; its unit is durable before the board may keep the key."""
    seen: list[str] = []
    watch = owner._store._connection.set_trace_callback

    def note(function: int) -> None:
        seen.append(f"sent {function}")

    def commits(line: LineRun | None, board: Board) -> list[list[str]]:
        seen.clear()
        watch(seen.append)
        with talk(board, _HookedLink(board, before=note)) as node:
            order = prepare(owner, BuildOrder(ANGLE)) if line is None else line.order
            provision(owner, node, order, operator=AcceptingOperator(), reporter=SilentReporter(), line=line)
        watch(None)
        parts: list[list[str]] = [[]]
        for statement in seen:
            parts[-1].append(statement)
            if statement == "COMMIT":
                parts.append([])
        return parts

    line = line_of(owner)
    line.order_of_all = BuildOrder(ANGLE)
    without, within = commits(None, make_board(1)), commits(line, make_board(2))
    assert len(within) == len(without)
    (with_unit,) = (part for part in within if any(text.startswith("INSERT INTO units") for text in part))
    assert any(text.startswith("INSERT INTO keys") for text in with_unit)
    assert f"sent {int(Function.CONFIRM)}" in within[within.index(with_unit) + 1]
    assert not any(text.startswith("PRAGMA synchronous=NORMAL") for text in with_unit), "it waits for the disk"
    (with_evidence,) = (part for part in within if any("INTO evidence(" in text for text in part))
    assert any("'verify'" in text for text in with_evidence if "INTO audit" in text)


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"not_before": NOW + timedelta(hours=1), "ends": NOW + timedelta(hours=2)}, "it begins"),
        ({"not_before": NOW - timedelta(hours=2), "ends": NOW - timedelta(minutes=5)}, "it ended"),
        ({"stations": {"0" * 64: 3}}, "not for this station"),
        ({"profile_sha256": "0" * 64}, "not the one in the job"),
    ],
)
def test_what_can_be_refused_before_a_tap_is(owner: Station, changes: dict[str, Any], why: str) -> None:
    with pytest.raises(PolicyError, match=why):
        line_of(owner, **changes)


def test_no_job_begins_once_the_roster_has_expired(tmp_path: Path) -> None:
    station = make_station(tmp_path / "home", "owner")
    join(station, roster_of(station, member(station, "owner", *ALL), expires=NOW - timedelta(hours=1)))
    with pytest.raises(RosterExpiredError) as caught:
        take_job(station, job_of(station))
    assert (caught.value.exit_code, caught.value.code) == (6, "roster-expired")
    station.close()


def test_a_job_that_comes_while_the_roster_has_expired_waits_for_the_renewed_one(tmp_path: Path) -> None:
    station = make_station(tmp_path / "home", "owner")
    own = member(station, "owner", *ALL)
    expired = roster_of(station, own, expires=NOW - timedelta(hours=1))
    join(station, expired)
    job = open_job(job_of(station), lambda kid: station.point)
    me = station.identity.fingerprint
    row = ParcelRow(str(uuid.uuid4()), "in", me, "job", "waiting", "")
    station.plant.parcels.put(row, job.octets)
    take_received(station)
    assert station.plant.line.jobs() == []
    plant.apply_pages.put_roster(station, roster_of(station, own, version=2, previous=expired.hash))
    take_received(station)
    assert [job_row.id for job_row in station.plant.line.jobs()] == [job.id]
    assert parcels.received(station, "job") == []
    station.close()


def test_a_closed_job_is_refused(owner: Station) -> None:
    line = line_of(owner)
    assert line.job is not None
    owner.plant.line.set_job_state(line.job.id, "closed")
    with pytest.raises(PolicyError, match="closed"):
        LineRun(owner, line.job)


def test_a_job_is_closed_once(owner: Station) -> None:
    line = line_of(owner)
    assert line.job is not None
    close_job(owner, line.job)
    before = owner.audit_log.newest(), owner.plant.outbox(1000)
    close_job(owner, line.job)
    assert (owner.audit_log.newest(), owner.plant.outbox(1000)) == before, "no second entry, no second event"


def test_a_clock_that_is_put_back_reopens_no_job_whose_end_was_seen(
    owner: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    line, next_job = line_of(owner), line_of(owner, title="the next one")

    class Later(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return datetime.now(tz) + timedelta(hours=2)

    with monkeypatch.context() as patch:
        patch.setattr(jobs, "datetime", Later)
        with pytest.raises(PolicyError, match="it ended"):
            build(line, make_board(1))
    again = Station.open(owner.home, ask=lambda prompt, confirm: PASSPHRASE)  # as the next command does
    assert line.job is not None
    with pytest.raises(PolicyError, match="it ended"):
        LineRun(again, line.job)
    again.close()
    assert build(next_job, make_board(1)).verified.verdict == "authentic", "a job whose end nobody saw is open"


def test_a_board_that_is_not_listed_or_has_another_key_costs_no_unit(owner: Station) -> None:
    first, other = make_board(1), make_board(2)
    line = line_of(owner, count=None, boards={first.uuid: fingerprint(first.key.point), other.uuid: "0" * 64})
    with pytest.raises(KeyMismatchError):
        build(line, other)
    with pytest.raises(PolicyError, match="not on the job's list"):
        build(line, make_board(3))
    assert units(line) == []
    build(line, first)
    assert units(line) == [(1, 1, 1)]


def test_a_board_of_another_type_costs_no_unit(tmp_path: Path, owner: Station) -> None:
    other, board = make_station(tmp_path / "other"), make_board(1)
    with talk(board) as node:
        order = BuildOrder(profile="tactile-finger-sensor")
        provision(other, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
    line = line_of(owner)
    with pytest.raises(WrongBoardError):
        build(line, board)
    assert units(line) == []
    other.close()


def test_a_board_on_the_bus_is_not_enough_for_a_job_that_asks_for_taps(owner: Station) -> None:
    line, board = line_of(owner), make_board(1)
    with pytest.raises(PolicyError, match="assurance 'tap'"):
        build(line, board, MemoryLink(board, via="can", tapped=True))
    assert units(line) == []
    assert board.state.state == NodeState.FACTORY


@pytest.mark.parametrize("kind", ["csv", "xml"])
def test_calibrations_are_those_that_the_job_names(tmp_path: Path, owner: Station, kind: str) -> None:
    first, second = make_board(1), make_board(2)
    folder = tmp_path / "calibrations"
    folder.mkdir()
    file = folder / f"{first.uuid.hex()}.{kind}"
    file.write_bytes(b"raw, value\n0, 0\n16384, 6.283185307\n" if kind == "csv" else CERTIFICATE)
    rule = CalibrationRule(
        "list", by_uuid={uuid: hashlib.sha256(file.read_bytes()).hexdigest() for uuid in (first.uuid, second.uuid)}
    )
    line = line_of(owner, folder, calibration=rule)
    with pytest.raises(NotFoundError, match="no file"):
        build(line, second)
    (folder / f"{second.uuid.hex()}.csv").write_text("raw, value\n0, 0\n16384, 6.28\n")
    with pytest.raises(PolicyError, match="not the one the job specifies"):
        build(line, second)
    assert units(line) == []
    done = build(line, first)
    (row,) = owner.plant.line.evidence(uuid=first.uuid)
    assert codec.read(row.document).facts.calibration_sha256 == rule.by_uuid[first.uuid]
    reference = certificate_reference_of(done.image.blocks, 1)
    assert (reference.sha256 if reference else None) == (rule.by_uuid[first.uuid] if kind == "xml" else None)


TABLE = "raw, value\n0, 0\n16384, 6.283185307\n"


def test_a_calibration_that_is_rewritten_while_it_is_read_is_not_used(
    tmp_path: Path, owner: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its digest was looked at, then the file was read again: evidence would name another one than the board has."""
    board = make_board(1)
    file = tmp_path / f"{board.uuid.hex()}.csv"
    file.write_text(TABLE)
    listed = CalibrationRule("list", by_uuid={board.uuid: hashlib.sha256(file.read_bytes()).hexdigest()})
    line = line_of(owner, tmp_path, calibration=listed)

    def rewritten(*given: Any, **more: Any) -> PreparedOrder:
        file.write_text(TABLE.replace("6.28", "6.27"))
        return prepare(*given, **more)

    monkeypatch.setattr(line_module, "prepare", rewritten)
    with pytest.raises(PolicyError, match="changed while it was being read"):
        build(line, board)
    outside = LineRun(owner, None, BuildOrder(profile=ANGLE, calibration=file))
    file.write_text(TABLE)
    with pytest.raises(PolicyError, match="changed while it was being read"):
        build(outside, board)
    assert units(line) == []
    assert board.state.state == NodeState.FACTORY


def test_evidence_names_the_calibration_that_was_read_even_if_the_file_changes_later(
    tmp_path: Path, owner: Station
) -> None:
    board, file = make_board(1), tmp_path / "angle.csv"
    file.write_text(TABLE)
    read = hashlib.sha256(file.read_bytes()).hexdigest()
    line = LineRun(owner, None, BuildOrder(profile=ANGLE, calibration=file))

    def rewrite(who: Any) -> None:
        file.write_text(TABLE.replace("6.28", "6.27"))

    with talk(board) as node:
        provision(owner, node, line.order, operator=Answers(accept=rewrite), reporter=SilentReporter(), line=line)
    (row,) = owner.plant.line.evidence(uuid=board.uuid)
    assert codec.read(row.document).facts.calibration_sha256 == read


def test_a_profile_that_is_edited_beside_a_job_makes_no_board_of_it(tmp_path: Path, owner: Station) -> None:
    own = owner.home / "profiles" / f"{ANGLE}.toml"
    own.parent.mkdir(exist_ok=True)
    own.write_bytes(find_profile(ANGLE).read_bytes())
    boards = [make_board(1), make_board(2)]
    for built_board in boards:
        (tmp_path / f"{built_board.uuid.hex()}.csv").write_text(f"# date: {NOW:%Y-%m-%d}\n{TABLE}")
    any_date = CalibrationRule("any", max_age_days=30)
    line = line_of(
        owner, tmp_path, calibration=any_date, profile_sha256=files_digest(own, [own.parent, shipped_profiles()])
    )
    build(line, boards[0])
    base = own.with_name("smart-sensor.toml")
    for edited, text in ((base, find_profile("smart-sensor").read_text()), (own, own.read_text())):
        edited.write_text(text + "\n# edited\n")
        with pytest.raises(PolicyError, match="not the one in the job"):
            build(line, boards[1])
        edited.write_text(text)
    build(line, boards[0])
    assert len(units(line)) == 1
    assert boards[1].state.state == NodeState.FACTORY


def test_a_job_of_an_earlier_version_that_names_the_file_alone_is_refused_by_name(owner: Station) -> None:
    with pytest.raises(PolicyError, match="without the profiles that it extends"):
        line_of(owner, profile_sha256=digest_of_file(find_profile(ANGLE)))


def test_the_event_and_the_evidence_of_a_board_name_the_jobs_profile_by_the_same_digest(owner: Station) -> None:
    line, board = line_of(owner), make_board(1)
    build(line, board)
    assert line.job is not None
    files = [find_profile(name).read_bytes() for name in ("smart-sensor", ANGLE)]
    framed = b"".join(len(octets).to_bytes(4, "big") + octets for octets in files)
    assert line.job.profile_sha256 == hashlib.sha256(framed).hexdigest()
    events = [json.loads(text) for _, _, text in owner.plant.outbox(100)]
    assert [event["profile_sha256"] for event in events if event["act"] == "written"] == [line.job.profile_sha256]
    (row,) = owner.plant.line.evidence(uuid=board.uuid)
    assert codec.read(row.document).facts.profile_sha256 == line.job.profile_sha256


def test_a_calibration_of_last_year_is_too_old_for_a_job_that_says_so(tmp_path: Path, owner: Station) -> None:
    board = make_board(1)
    file = tmp_path / f"{board.uuid.hex()}.csv"
    line = line_of(owner, tmp_path, calibration=CalibrationRule("any", max_age_days=30))
    table = "raw, value\n0, 0\n16384, 6.283185307\n"
    wrong = [(f"# date: {NOW + timedelta(days=days):%Y-%m-%d}\n", "is dated") for days in (-32, 3)]
    for dated, why in (*wrong, ("", "has no date")):
        file.write_text(dated + table)
        with pytest.raises(PolicyError, match=why):
            build(line, board)
    file.write_text(f"# date: {NOW - timedelta(days=3):%Y-%m-%d}\n{table}")
    build(line, board)
    assert units(line) == [(1, 1, 1)]


def test_a_clock_before_the_roster_makes_no_calibration_fresh_again(tmp_path: Path, owner: Station) -> None:
    """Now is never before the roster was made: a calibration that is too old then stays so."""
    board = make_board(1)
    later = {"created": NOW + timedelta(days=100), "expires": NOW + timedelta(days=190)}
    join(owner, roster_of(owner, member(owner, "owner", *ALL), version=2, previous="ab" * 32, **later))
    rule = CalibrationRule("any", max_age_days=30)
    line = line_of(owner, tmp_path, calibration=rule, ends=NOW + timedelta(days=180))
    file = tmp_path / f"{board.uuid.hex()}.csv"
    for days, old in ((3, True), (-69, True), (-71, False), (-102, True)):
        file.write_text(f"# date: {NOW - timedelta(days=days):%Y-%m-%d}\nraw, value\n0, 0\n16384, 6.283185307\n")
        with pytest.raises(PolicyError, match="is dated") if old else nullcontext():
            line.order(cast("IdentifiedNode", SimpleNamespace(uuid=board.uuid)))


def test_a_job_is_a_keepers_word_and_its_id_means_one_job(tmp_path: Path, owner: Station) -> None:
    document = job_of(owner)
    job = take_job(owner, document)
    assert take_job(owner, document).hash == job.hash
    twin = seal_job(replace(job, title="another"), owner.credentials().key)
    with pytest.raises(PolicyError, match="A different job"):
        take_job(owner, twin)
    with pytest.raises(NotAuthenticError):
        take_job(owner, seal_job(replace(job, id="11111111-2222-4333-8444-555555555555"), SoftwareKey(5)))
    join(owner, roster_of(owner, member(owner, "owner", "line", "sign"), version=2, previous="0" * 64))
    with pytest.raises(PolicyError, match="not a keeper"):
        take_job(owner, document)


def test_who_joined_no_registry_takes_no_job(tmp_path: Path, owner: Station) -> None:
    stranger = make_station(tmp_path / "stranger")
    with pytest.raises(PolicyError, match="has not joined one"):
        take_job(stranger, job_of(owner))
    stranger.close()


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda job: replace(job, stations={"0" * 64: 4}), "allotments"),
        (lambda job: replace(job, ends=job.not_before), "ends"),
        (lambda job: replace(job, count=None, boards={}), "nodes"),
        (lambda job: replace(job, name="board {n}"), "pattern"),
        (lambda job: replace(job, assurance="word"), "assurance"),
    ],
)
def test_a_job_that_does_not_add_up_is_never_signed(owner: Station, change: Callable[[Job], Job], why: str) -> None:
    job = open_job(job_of(owner), lambda kid: owner.point)
    with pytest.raises(BadDataError, match=why):
        seal_job(change(job), owner.credentials().key)


def test_patterns_of_names() -> None:
    require_pattern("left {unit:03} {uuid}")
    for wrong in ("{unit:3}", "{unit:00}", "{0}", "{uuid", "}"):
        with pytest.raises(BadDataError):
            require_pattern(wrong)


def test_cut_at_every_message_a_unit_is_neither_given_twice_nor_lost(tmp_path: Path) -> None:
    owner = alone(tmp_path / "count")
    link = MemoryLink(make_board(1))
    build(line_of(owner), link.board, link)
    owner.close()
    for first, half in enumerate(("lose_request", "lose_reply"), 1):
        for lost in range(first, link.count, 2):
            home = alone(tmp_path / f"{half}{lost}")
            line, board = line_of(home), make_board(1)
            with pytest.raises(NodeSilentError):
                build(line, board, MemoryLink(board, **{half: lost}))  # type: ignore[arg-type]
            assert build(line, board).verified.verdict == "authentic", (half, lost)
            (unit,) = units(line)
            assert (unit[0], bool(unit[2])) == (1, True)
            rows = list(home.plant.line.evidence(uuid=board.uuid))
            assert rows[-1].verdict == "passed"
            assert all(codec.faults(codec.read(row.document), home.identity.ca) == [] for row in rows)
            home.close()


def test_evidence_is_kept_outside_a_job_too(owner: Station) -> None:
    order = BuildOrder(profile="magnetic-angular-position-sensor")
    line, board = LineRun(owner, None, order, operator="A. Meier"), make_board(1)
    build(line, board)
    build(line, board)
    rows = list(owner.plant.line.evidence(uuid=board.uuid))
    assert [(row.job, row.unit, row.attempt) for row in rows] == [(None, None, 1), (None, None, 2)]
    assert codec.read(rows[0].document).operator == "A. Meier"


def test_a_second_station_tests_what_another_one_made(tmp_path: Path) -> None:
    """Its own evidence stands beside the maker's; nothing is written, and it takes no unit."""
    plant = Plant(tmp_path)
    tester = plant.member("tester", "base")
    members = {"registry": plant.roster.registry, "stations": {plant.north.fingerprint: 2, tester.fingerprint: 1}}
    document = job_of(plant.north, **members)
    made, board = LineRun(plant.north, take_job(plant.north, document)), make_board(1)
    build(made, board)
    before = board.state
    tests = LineRun(tester, take_job(tester, document), only_verify=True)
    tester.unlock()
    for attempt in (1, 2):
        with talk(board) as node:
            done = verify_only(tester, node, tests, SilentReporter())
        assert done.verified.verdict == "authentic"
        assert tests.unit_to_json(board.uuid)["attempt"] == attempt
    assert board.state == before
    assert units(tests) == []
    rows = list(tester.plant.line.evidence(uuid=board.uuid))
    assert [codec.faults(codec.read(row.document), plant.north.identity.ca) for row in rows] == [[], []]
    assert {name for name, _, _ in codec.read(rows[0].document).facts.steps} == {"identify", "verify", "check"}
    other = make_board(2)
    with talk(other) as node:
        order = BuildOrder(profile="tactile-finger-sensor")
        provision(plant.north, node, order, operator=AcceptingOperator(), reporter=SilentReporter())
    with talk(other) as node, pytest.raises(WrongBoardError):
        verify_only(tester, node, tests, SilentReporter())
    tampered = {**board.state.blocks, (0, 12): board.state.blocks[0, 12][:-3] + b"\0\0\0"}
    board.flash.state = replace(board.state, blocks=tampered)
    board.power_on()
    with talk(board) as node:
        assert verify_only(tester, node, tests, SilentReporter()).verified.verdict == "not authentic"
    last = codec.read(list(tester.plant.line.evidence(uuid=board.uuid))[-1].document)
    assert (last.verdict, last.facts.failure) == ("failed", "not-authentic")
    assert codec.faults(last, plant.north.identity.ca) == []
    plant.close()


def test_a_scan_says_which_board_must_come(owner: Station, tmp_path: Path) -> None:
    line, first, second = line_of(owner), make_board(1), make_board(2)
    line.label_to = tmp_path / "labels" / "x.svg"
    line.scans = Scans([])
    with pytest.raises(PolicyError, match="Scan the label"):
        build(line, first)
    line.scans.add_label(f"TEDS1:{first.uuid.hex()}:{fingerprint(first.key.point)}")
    with pytest.raises(WrongBoardError, match="label"):
        build(line, second)
    assert units(line) == []
    build(line, first)
    label = tmp_path / "labels" / f"{first.uuid.hex()}.svg"
    assert first.uuid.hex() in label.read_text()
    assert line.unit_to_json(first.uuid)["label"] == str(label)
    with pytest.raises(PolicyError, match="Scan the label"):
        build(line, first)
    line.scans.add_label(first.uuid.hex())
    build(line, first)
    messages: list[str] = []
    Scans(["nonsense\n", "\n"], messages.append).listen()
    assert messages == ["This is not a board label: nonsense"]


def evidence_by(member: Station, plant: Plant) -> codec.Evidence:
    """Return the evidence of a board that this member builds and signs for a job of the plant."""
    job = job_of(plant.north, registry=plant.roster.registry, stations={member.fingerprint: 3})
    line, board = LineRun(member, take_job(member, job)), make_board(1)
    member.unlock()
    build(line, board)
    (row,) = member.plant.line.evidence(uuid=board.uuid)
    return codec.read(row.document)


def test_a_stolen_stations_evidence_does_not_hold_beside_a_roster(tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    west = plant.member("west", "line", "sign")
    document = evidence_by(west, plant)

    def faults() -> list[str]:
        assert plant.north.plant.roster is not None
        return EvidenceAnchors(plant.north.identity.ca, roster=plant.north.plant.roster).faults(document)

    first = EvidenceAnchors(plant.north.identity.ca, roster=plant.roster)
    assert "its station is not in the roster" in first.faults(document)
    assert faults() == []
    plant.change(owning.with_roles(plant.north, "west", frozenset({"audit"}), (0, "")))
    assert "its station has no role for working on boards" in faults()
    plant.change(owning.draft_removal(plant.north, "west", "stolen", 0))
    assert "its station was removed: stolen" in faults()
    roster = plant.north.plant.roster
    assert roster is not None
    (west_left,) = roster.removed
    for why, holds in (("lost", False), ("stolen", False), ("retired", True)):
        left = replace(roster, removed=(replace(west_left, why=why),))
        found = EvidenceAnchors(plant.north.identity.ca, roster=left).faults(document)
        assert (f"its station was removed: {why}" not in found) == holds, "a file cannot show when it was signed"
    plant.close()


@pytest.mark.parametrize(("place", "holds"), [((3, "ab" * 32), True), ((0, ""), False), (None, False)])
def test_what_a_station_signed_before_it_lost_that_role_may_be_good(
    tmp_path: Path, place: Place | None, holds: bool
) -> None:
    """A file shows no page: only a station whose signatures never counted cannot have made a good one."""
    plant = Plant(tmp_path)
    west = plant.member("west", "line", "sign")
    document = evidence_by(west, plant)
    roster = west.plant.roster
    assert roster is not None
    changed = tuple(
        replace(member, roles=member.roles - {"sign"}, signed=place) if member.name == "west" else member
        for member in roster.members
    )
    anchors = EvidenceAnchors(plant.north.identity.ca, roster=replace(roster, members=changed))
    lacks = "the station that signed the datasheet does not have the role 'sign'"
    assert anchors.faults(document) == ([] if holds else [lacks])
    plant.close()


def test_evidence_of_a_line_whose_office_was_lost_does_not_hold_beside_a_roster(tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    west = plant.member("west", "line", "sign")
    made = evidence_by(west, plant)
    of_a_line = replace(made, facts=replace(made.facts, station=plant.north.fingerprint))  # west only signed for it
    roster = west.plant.roster
    assert roster is not None
    (member,) = [member for member in roster.members if member.name == "west"]
    left = RemovedMember("west", member.point, member.roles, "lost", (1, "ab" * 32))
    others = tuple(other for other in roster.members if other is not member)
    anchors = EvidenceAnchors(plant.north.identity.ca, roster=replace(roster, members=others, removed=(left,)))
    assert "the station that signed the datasheet was removed: lost" in anchors.faults(of_a_line)
    plant.close()


def test_a_job_is_sent_to_those_that_it_is_for(tmp_path: Path) -> None:
    plant = Plant(tmp_path)
    west = plant.member("west", "line")
    members = {"registry": plant.roster.registry, "stations": {west.fingerprint: 3}}
    job = take_job(plant.north, job_of(plant.north, **members))
    send_job(plant.north, FolderTransport(plant.stick), job)
    send_job(plant.north, FolderTransport(plant.stick), job)
    plant.round()
    take_received(west)
    assert find_job(west, job.id[:8]).hash == job.hash
    assert list(FolderTransport(plant.stick).parcels(west.fingerprint)) == []
    plant.close()


def test_a_clock_before_the_roster_counts_as_the_time_of_the_roster() -> None:
    """A clock that was put back opens no job again."""

    class _Roster:
        created = datetime(2999, 1, 1, tzinfo=UTC)

    assert jobs.now_of(cast("Roster", _Roster())) == _Roster.created


def test_a_board_that_is_done_takes_back_its_own_scan_alone() -> None:
    """The next board's label is scanned while the one before is finished."""
    first, second = bytes(10), bytes(range(10))
    who: Any = SimpleNamespace(uuid=second, fingerprint="ab" * 32)
    scans = Scans([])
    scans.add_label(second.hex())
    scans.clear(first)
    scans.require(who)
    scans.clear(second)
    with pytest.raises(PolicyError, match="Scan the label"):
        scans.require(who)
