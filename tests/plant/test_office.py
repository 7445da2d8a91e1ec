"""An office signs for a line what it builds itself, for a board in the line's hands, within a job; and nothing else."""

from __future__ import annotations

import hashlib
import itertools
import json
import uuid
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime, timedelta, tzinfo
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import NotAuthenticError, PolicyError
from teds_provision.plant import jobs, office, parcels, sign_requests
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.jobs import take_job
from teds_provision.plant.line import LineRun
from teds_provision.plant.office import MOST_ANSWERS, RequestAheadError, answer
from teds_provision.plant.sign_requests import (
    Inbox,
    JoinedOffice,
    OfficeRefusedError,
    OfficeSilentError,
    RemoteOffice,
    send,
)
from teds_provision.plant.yield_stats import attempts_of, yield_stats
from teds_provision.protocol.keys import SoftwareKey, fingerprint, node_key_message, prove_message
from teds_provision.protocol.plant import evidence as codec
from teds_provision.protocol.plant.document import SIGN_REQUEST
from teds_provision.protocol.plant.job import CalibrationRule, Job
from teds_provision.protocol.plant.signing import (
    Answer,
    SignRequest,
    challenge,
    open_answer,
    open_request,
    seal_answer,
    seal_request,
)
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord, WhitelistEntry
from teds_provision.teds.codec import security
from teds_provision.teds.codec.access_code import AccessCode
from teds_provision.teds.codec.frame import frame
from teds_provision.teds.image import SECURITY, Image
from teds_provision.teds.profile.load import find_profile
from tests.bench import Board
from tests.provisioning.test_one_verdict import changed_in_flash
from tests.teds.certificates import ANGLE as CERTIFICATE

from .owner import ANGLE, NOW, job_of
from .stations import Plant
from .test_jobs import build, make_board

KAT = json.loads((Path(__file__).parents[1] / "vectors" / "profile" / "plant_kat.json").read_text())


@dataclass
class LocalOffice:
    """An office on the same desk; ``away``: it does not answer. ``change`` is what somebody does to a request."""

    station: Station
    away: bool = False
    asked: list[SignRequest] = field(default_factory=list)

    def request_signature(self, request: SignRequest) -> bytes | None:
        self.asked.append(request)
        return None if self.away else answer(self.station, request.octets)


@dataclass
class Desk:
    """An owner whose station `north` is the office, and a line without `sign`."""

    plant: Plant
    office: Station
    line: Station
    at_hand: LocalOffice

    def run(self, calibrations: Path | None = None, **changes: Any) -> LineRun:
        roster: dict[str, Any] = {
            "stations": {self.line.identity.fingerprint: 3},
            "sign": self.office.identity.fingerprint,
        }
        document = job_of(self.office, **{**roster, "registry": self.plant.roster.registry, **changes})
        take_job(self.office, document)
        return LineRun(self.line, take_job(self.line, document), calibrations=calibrations, office=self.at_hand)

    def request(self, run: LineRun, built_board: Board) -> SignRequest:
        """Return a good request for a board, as its line makes it, which is not answered."""
        self.at_hand.away = True
        with pytest.raises(OfficeSilentError):
            build(run, built_board)
        self.at_hand.away = False
        return self.at_hand.asked[-1]

    def asks(self, request: SignRequest, by: Station | None = None, **more: Any) -> Answer:
        """Have the office answer a request that a station signed as it stands."""
        station = by or self.line
        station.unlock()
        octets = answer(self.office, seal_request(request, station.credentials().key), **more)
        assert octets is not None
        return open_answer(octets, lambda kid: self.office.point)


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    plant = Plant(tmp_path)
    line = plant.member("west", "line")
    plant.north.unlock()
    line.unlock()
    yield Desk(plant, plant.north, line, LocalOffice(plant.north))
    plant.close()


def proven(request: SignRequest, line: Station, built_board: Board, **changes: Any) -> SignRequest:
    """Return the request changed, and the board asked again: what a station can do that has the board in its hands."""
    new = replace(request, **changes)
    blocks = new.image.unsigned_blocks()
    asked = challenge(new.nonce, line.point, new.uuid, new.epoch, new.sequence, blocks)
    return replace(new, proof=built_board.key.sign(prove_message(new.uuid, asked)))


def test_a_line_without_sign_makes_authentic_boards_by_its_office(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    done = build(run, board)
    assert done.verified.verdict == "authentic"
    shown = security.decode(done.image.blocks[SECURITY])
    assert shown.station_key == desk.office.point
    (row,) = desk.line.plant.line.evidence(uuid=board.uuid)
    assert codec.faults(codec.read(row.document), desk.office.identity.ca) == []
    assert desk.office.pins.entry(board.uuid) is not None
    assert run.job is not None
    assert [unit.unit for unit in desk.office.plant.line.units(run.job.id)] == [1]


def test_what_a_person_pinned_at_the_office_is_not_weakened_by_a_line(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    pinned = WhitelistEntry(board.uuid, fingerprint(board.key.point), assurance="tap", name="seen")
    desk.office.pins.put(pinned)
    build(run, board)
    entry = desk.office.pins.entry(board.uuid)
    assert entry is not None
    assert (entry.assurance, entry.name) == ("tap", "seen")


def test_nothing_is_asked_twice_for_what_the_board_has(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    build(run, board)
    assert build(run, board).verified.verdict == "authentic"
    assert len(desk.at_hand.asked) == 1


def test_a_board_whose_teds_were_changed_beside_its_signature_is_signed_again(desk: Desk) -> None:
    """Under the sequence that it has it takes nothing."""
    run, board = desk.run(), make_board(1)
    build(run, board)
    changed_in_flash(board, (1, AccessCode.CHANNEL))
    assert build(run, board).verified.verdict == "authentic"
    assert len(desk.at_hand.asked) == 2


def test_an_office_that_is_away_costs_nothing_but_time(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    first = desk.request(run, board)
    second = desk.request(run, board)
    assert first.hash == second.hash, "the same request again: no second datasheet is made"
    done = build(run, board)
    assert (done.verified.verdict, len({request.hash for request in desk.at_hand.asked})) == ("authentic", 1)
    assert security.decode(done.image.blocks[SECURITY]).sequence == 1


def test_the_newest_request_is_that_of_the_highest_sequence_whatever_the_clock_was(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    first = desk.request(run, board)
    (row,) = desk.line.plant.line.sign_requests(first.job, first.uuid, "out")
    sealed = seal_request(replace(first, sequence=first.sequence + 1), desk.line.credentials().key)
    later = replace(row, hash=open_request(sealed, lambda kid: desk.line.point).hash, request=sealed)
    with desk.line.durable("test"):
        desk.line.plant.line.put_sign_request(replace(later, at="2000-01-01T00:00:00Z"))
    assert desk.request(run, board).hash != first.hash, "the later request does not fit the board, so a new one is made"


def test_the_count_holds_when_another_signer_takes_the_last_unit_meanwhile(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = desk.request(desk.run(count=1, stations={desk.line.identity.fingerprint: 1}), make_board(1))
    two = make_board(2)
    signed = two.key.sign(node_key_message(two.uuid, two.key.point))
    second = replace(
        first, image=Image(two.uuid, first.image.blocks), point=two.key.point, key_signature=signed, nonce=bytes(16)
    )

    def and_another_signs(station: Station, job: Job, request: SignRequest) -> Image:
        monkeypatch.undo()
        assert desk.asks(first).security
        return request.image

    monkeypatch.setattr(office, "_built", and_another_signs)
    assert desk.asks(proven(second, desk.line, two)).refused == "full"
    assert [row.uuid for row in desk.office.plant.line.units(first.job)] == [make_board(1).uuid]


def test_an_office_counts_the_boards_that_it_signed_before_their_line_reports(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    build(run, board)
    assert run.job is not None
    (part,) = yield_stats(desk.office, run.job, attempts_of(desk.office, run.job.id))
    assert (part.station, part.units, part.passed, part.failures) == (desk.line.fingerprint, 1, 0, {})
    desk.plant.round()
    (part,) = yield_stats(desk.office, run.job, attempts_of(desk.office, run.job.id))
    assert (part.units, part.passed, part.attempts) == (1, 1, 1)
    (row,) = desk.line.plant.line.evidence(uuid=board.uuid)
    build(run, make_board(2))
    desk.plant.round()
    found = attempts_of(desk.office, run.job.id, [row.document])
    (part,) = yield_stats(desk.office, run.job, found)
    assert (part.units, part.passed, part.attempts) == (2, 2, 2), "one by its evidence, the other by its page"
    later = replace(found[0], uuid=make_board(3).uuid, attempt=2)  # of the first nothing was heard
    failed = replace(found[0], uuid=make_board(4).uuid, code="no-node")
    (part,) = yield_stats(desk.office, run.job, [*found, later, failed, replace(failed, attempt=2, code=None)])
    assert (part.units, part.passed, part.first, part.first_pass) == (4, 4, 2, 0.5)


def test_the_same_request_gets_the_same_answer_octet_for_octet(desk: Desk) -> None:
    request = desk.request(desk.run(), make_board(1))
    first = answer(desk.office, request.octets)
    assert first == answer(desk.office, request.octets)
    assert len(list(desk.office.plant.line.sign_requests(request.job, request.uuid, "in"))) == 1


@pytest.mark.parametrize("kind", ["csv", "xml"])
def test_calibrations_come_along_and_are_fitted_by_the_office(desk: Desk, tmp_path: Path, kind: str) -> None:
    board = make_board(1)
    file = tmp_path / f"{board.uuid.hex()}.{kind}"
    file.write_bytes(b"raw, value\n0, 0\n16384, 6.283185307\n" if kind == "csv" else CERTIFICATE)
    rule = CalibrationRule("list", by_uuid={board.uuid: hashlib.sha256(file.read_bytes()).hexdigest()})
    run = desk.run(tmp_path, calibration=rule)
    done = build(run, board)
    assert done.verified.verdict == "authentic"
    assert ((1, AccessCode.CERTIFICATE) in done.image.blocks) == (kind == "xml"), "the office made the same TEDS"
    request = desk.at_hand.asked[-1]
    other = proven(request, desk.line, board, nonce=bytes(16), calibration=b"raw, value\n0, 0\n16384, 7\n")
    assert desk.asks(other).refused == "job"


@pytest.mark.parametrize("days", [-32, 3, None])
def test_an_office_takes_no_calibration_that_is_too_old_or_dated_in_the_future(
    desk: Desk, tmp_path: Path, days: int | None
) -> None:
    board, table = make_board(1), "raw, value\n0, 0\n16384, 6.283185307\n"
    today = datetime.now(UTC)
    (tmp_path / f"{board.uuid.hex()}.csv").write_text(f"# date: {today:%Y-%m-%d}\n{table}")
    run = desk.run(tmp_path, calibration=CalibrationRule("any", max_age_days=30))
    request = desk.request(run, board)
    dated = "" if days is None else f"# date: {today + timedelta(days=days):%Y-%m-%d}\n"
    assert desk.asks(proven(request, desk.line, board, calibration=f"{dated}{table}".encode())).refused == "job"
    assert build(run, board).verified.verdict == "authentic"


def test_a_clock_before_the_roster_makes_no_calibration_fresh_again_for_an_office(desk: Desk, tmp_path: Path) -> None:
    board, table = make_board(1), "raw, value\n0, 0\n16384, 6.283185307\n"
    (tmp_path / f"{board.uuid.hex()}.csv").write_text(f"# date: {datetime.now(UTC):%Y-%m-%d}\n{table}")
    rule, ends = CalibrationRule("any", max_age_days=30), NOW + timedelta(days=180)
    request = desk.request(desk.run(tmp_path, calibration=rule, ends=ends), board)
    held = desk.office.plant.roster
    assert held is not None
    later = replace(
        held, version=held.version + 1, created=NOW + timedelta(days=31), expires=NOW + timedelta(days=90), hash="",
        octets=b"",
    )  # fmt: skip
    desk.plant.change(later)
    reply = desk.asks(request)
    assert (reply.refused, reply.why) == ("job", "the calibration is older than 30 days, or has no date")


def test_an_office_notices_that_what_its_profile_extends_was_edited(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The profile was kept for as long as its own file stayed as it was."""
    seconds = itertools.count(100.0, 2.0)
    monkeypatch.setattr(office.time, "monotonic", lambda: next(seconds))
    folder = desk.office.home / "profiles"
    folder.mkdir(exist_ok=True)
    for name in (ANGLE, "smart-sensor"):
        (folder / f"{name}.toml").write_bytes(find_profile(name).read_bytes())
    base = folder / "smart-sensor.toml"
    assert build(desk.run(), make_board(1)).verified.verdict == "authentic"
    base.write_text(base.read_text().replace('operation-timeout = "500 ms"', 'operation-timeout = "400 ms"'))
    with pytest.raises(OfficeRefusedError, match=r"\(differs\)"):
        build(desk.run(), make_board(2))


def _meta(image: Image) -> Image:
    return image.with_block((0, 12), frame(bytes.fromhex("0304000c0101040100050d") + b"boom strain 7"))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda r: {"image": _meta(r.image)}, "differs"),
        (lambda r: {"image": Image(r.uuid, dict(list(r.image.blocks.items())[1:]))}, "differs"),
        (lambda r: {"image": r.image.with_block((1, 5), frame(bytes.fromhex("030400050101")))}, "differs"),
        (lambda r: {"name": "another"}, "differs"),
        (lambda r: {"job": "11111111-2222-4333-8444-555555555555"}, "job"),
        (lambda r: {"sequence": 65_536}, "sequence"),
        (lambda r: {"calibration": b"raw, value\n0, 0\n"}, "job"),
    ],
)
def test_a_station_with_the_board_in_its_hands_gets_nothing_that_the_office_did_not_make(
    desk: Desk, change: Callable[[SignRequest], dict[str, Any]], word: str
) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)
    reply = desk.asks(proven(request, desk.line, board, **change(request)))
    assert (reply.refused, reply.security) == (word, b"")
    assert reply.why
    assert desk.office.plant.line.units(request.job) == []


def test_without_the_board_nothing_is_signed(desk: Desk) -> None:
    request = desk.request(desk.run(), make_board(1))
    assert desk.asks(replace(request, epoch=request.epoch + 1)).refused == "proof"
    assert desk.asks(replace(request, nonce=bytes(16))).refused == "proof"
    mine = SoftwareKey(9)
    made_up = replace(request, point=mine.point, key_signature=mine.sign(node_key_message(request.uuid, mine.point)))
    assert desk.asks(made_up).refused == "proof"
    assert desk.asks(replace(request, key_signature=bytes(64))).refused == "proof"


def test_another_key_under_a_known_uuid_is_refused(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    build(run, board)
    twin = Board(uuid=board.uuid)
    request = desk.at_hand.asked[-1]
    signed = twin.key.sign(node_key_message(twin.uuid, twin.key.point))
    asked = replace(request, point=twin.key.point, key_signature=signed, nonce=bytes(16))
    assert desk.asks(proven(asked, desk.line, twin)).refused == "other-key"


def test_only_who_is_line_now_is_answered_with_a_signature(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    base = desk.plant.member("south", "base")
    request = desk.request(run, board)
    assert desk.asks(request, by=base).refused == "not-line"
    assert answer(desk.office, seal_request(request, SoftwareKey(5))) is None, "nobody's"
    assert answer(desk.office, seal_request(replace(request, to="0" * 64), desk.line.credentials().key)) is None
    assert answer(desk.office, b"eyJ.x.y") is None


def test_a_stolen_line_gets_nothing_after_its_removal(desk: Desk) -> None:
    from teds_provision import plant

    run, board = desk.run(), make_board(1)
    request = desk.request(run, board)
    assert desk.asks(request).security
    desk.plant.change(plant.owner.draft_removal(desk.office, "west", "stolen", 0))
    assert desk.asks(request).refused == "not-line", "not even what was answered before"


def test_one_board_too_many_and_one_answer_too_many(desk: Desk) -> None:
    run = desk.run(count=1, stations={desk.line.identity.fingerprint: 1})
    board = make_board(1)
    request = desk.request(run, board)
    for number in range(MOST_ANSWERS):
        reply = desk.asks(proven(request, desk.line, board, nonce=number.to_bytes(16, "big")))
        assert reply.sequence == number + 1
    assert desk.asks(proven(request, desk.line, board, nonce=bytes(15) + b"\xff")).refused == "full"
    assert desk.line.plant.line.count_units(request.job)[0] == 1
    two = make_board(2)  # the line forgot how to count
    signed = two.key.sign(node_key_message(two.uuid, two.key.point))
    more = replace(request, image=Image(two.uuid, request.image.blocks), point=two.key.point, key_signature=signed)
    assert desk.asks(proven(more, desk.line, two, epoch=1)).refused == "full"


def test_a_revoked_board_and_a_job_that_is_over_are_refused(desk: Desk) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)
    assert desk.asks(proven(request, desk.line, board, nonce=bytes(16)), jobs=[]).refused == "job"
    desk.office.policy.deny(RevocationRecord(board.uuid, None, "stolen", ""))
    assert desk.asks(request).refused == "revoked"


def test_a_person_may_let_a_sequence_jump(desk: Desk) -> None:
    board = make_board(1)
    request = proven(desk.request(desk.run(), board), desk.line, board, sequence=70_000)
    assert desk.asks(request).refused == "sequence"
    assert desk.asks(request, jump=True).sequence == 70_001


def test_the_line_takes_no_word_but_the_offices(desk: Desk) -> None:
    """An answer of the line's own making, or to another request, or that says something else."""
    run, board = desk.run(), make_board(1)
    office = desk.at_hand

    class LyingOffice:
        def __init__(self, lie: Callable[[SignRequest], bytes]) -> None:
            self.lie = lie

        def request_signature(self, request: SignRequest) -> bytes | None:
            return self.lie(request)

    def forged(request: SignRequest) -> bytes:
        return seal_answer(Answer(request.hash, 1, b"\0" * 40), desk.line.credentials().key)

    def other(request: SignRequest) -> bytes:
        return seal_answer(Answer("0" * 64, 1, b"\0" * 40), desk.office.credentials().key)

    def nonsense(request: SignRequest) -> bytes:
        return seal_answer(Answer(request.hash, 1, b"\0" * 40), desk.office.credentials().key)

    for lie in (forged, other, nonsense):
        run.office = LyingOffice(lie)
        with pytest.raises(NotAuthenticError):
            build(run, board)
    run.office = office
    assert build(run, board).verified.verdict == "authentic"


def test_a_board_that_waits_for_the_office_has_a_draft_until_its_datasheet_is_written(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    request = desk.request(run, board)
    waiting = desk.line.datasheets.draft(board.uuid)
    assert waiting is not None
    assert (waiting.stage, waiting.profile) == ("built", ANGLE)
    assert waiting.image.unsigned_blocks() == request.image.unsigned_blocks()
    assert build(run, board).verified.verdict == "authentic"
    assert desk.line.datasheets.draft(board.uuid) is None


def test_another_members_answer_neither_ends_the_waiting_nor_hides_the_offices(desk: Desk) -> None:
    east = desk.plant.member("east", "audit")
    desk.plant.round()
    east.unlock()
    run, board, transport = desk.run(), make_board(1), FolderTransport(desk.plant.stick)
    request = desk.request(run, board)
    lies = [
        seal_answer(Answer(request.hash, refused="revoked", why="a lie"), station.credentials().key)
        for station in (east, desk.line)
    ]
    lies.append(seal_answer(Answer(request.hash, 9, b""), SoftwareKey.generate()))

    def leave(document: bytes, name: str) -> None:
        send(east, transport, desk.line.identity.fingerprint, document, f"{name}-0000-4000-8000-000000000000")

    leave(lies[0], "00000000")
    run.office = RemoteOffice(desk.line, transport, 0.2)
    with pytest.raises(OfficeSilentError):
        build(run, board)
    for n, lie in enumerate(lies):
        leave(lie, f"fffffff{n}")
    answered = answer(desk.office, request.octets)
    assert answered is not None
    leave(answered, "88888888")
    assert build(run, board).verified.verdict == "authentic"


def test_a_line_asks_its_office_where_the_registry_is_now(desk: Desk, tmp_path: Path) -> None:
    """A line under --watch asked at the place of its start for ever, after `registry connect` to another one."""
    places = [tmp_path / "old", tmp_path / "new"]
    run, board = desk.run(), make_board(1)
    for place in places:
        place.mkdir()
        desk.line.plant.put_record(replace(desk.line.plant.joined, url=f"file:{place}"))
        if run.office is desk.at_hand:
            run.office = JoinedOffice(desk.line, 0.2)
        with pytest.raises(OfficeSilentError):
            build(run, board)
        assert [file for file in (place / "to").rglob("*") if file.is_file()], place
    inbox = Inbox(desk.office, FolderTransport(places[1]), SIGN_REQUEST)
    assert [
        done.answer.refused for done in office.answer_all(desk.office, FolderTransport(places[1]), inbox, None)
    ] == [""]
    assert build(run, board).verified.verdict == "authentic"


def test_an_answer_waits_for_the_line_that_asked_and_for_no_person(desk: Desk) -> None:
    """One that came again, after the board was done, stayed for ever: "1 parcel waits for import-keys --received"."""
    run, board = desk.run(), make_board(1)
    request = desk.request(run, board)
    transport, me = FolderTransport(desk.plant.stick), desk.line.identity.fingerprint
    sealed = answer(desk.office, request.octets)
    assert sealed is not None
    send(desk.office, transport, me, sealed, str(uuid.uuid4()))
    done = desk.plant.sync(desk.line)
    assert (done.parcels_in, done.waiting) == (0, 0)
    (kept,) = parcels.received(desk.line, "signed")
    assert kept[1] == sealed
    desk.line.plant.parcels.drop(kept[0].id, "in")
    build(run, board)
    send(desk.office, transport, me, sealed, str(uuid.uuid4()))
    assert desk.plant.sync(desk.line).waiting == 0
    assert parcels.received(desk.line, "signed") == []


def test_a_refusal_is_reported_with_its_word_and_the_board_is_finished_later(desk: Desk) -> None:
    run, board = desk.run(), make_board(1)
    assert run.job is not None
    desk.office.plant.line.set_job_state(run.job.id, "closed")
    with pytest.raises(OfficeRefusedError, match=r"\(job\): .*closed here\.$"):
        build(run, board)
    desk.office.plant.line.set_job_state(run.job.id, "open")
    assert build(run, board).verified.verdict == "authentic"


def test_who_has_not_sign_is_no_office(desk: Desk) -> None:
    request = desk.request(desk.run(), make_board(1))
    with pytest.raises(PolicyError, match="role 'sign'"):
        answer(desk.line, request.octets)


def test_the_known_request_and_answer_are_read(desk: Desk) -> None:
    documents, points = (
        KAT["documents"],
        {key["fingerprint"]: bytes.fromhex(key["point"]) for key in KAT["keys"].values()},
    )
    request = open_request(documents["sign-request"]["jws"].encode(), points.get)
    assert request.hash == documents["sign-request"]["H"]
    sign_request = KAT["sign_request"]
    values = {(int(item[:4], 16), int(item[4:6], 16)): bytes.fromhex(item[6:]) for item in sign_request["values_108"]}
    hashed = b"TEDS1 sign request\0" + request.nonce + request.line + request.uuid
    hashed += request.epoch.to_bytes(4, "big") + request.sequence.to_bytes(4, "big")
    hashed += b"".join(c.to_bytes(2, "big") + bytes([a]) + digest for (c, a), digest in values.items())
    assert hashed.hex() == sign_request["hashed"]
    assert hashlib.sha256(hashed).hexdigest() == sign_request["challenge"]
    answered = open_answer(documents["signed"]["jws"].encode(), points.get)
    assert (answered.of, answered.sequence) == (request.hash, 1)


def test_a_request_from_the_future_waits(desk: Desk) -> None:
    request = desk.request(desk.run(), make_board(1))
    late = replace(request, created=NOW + timedelta(hours=25))
    with pytest.raises(RequestAheadError, match=r"dated this request 20\d\d-.*, and it is 20"):
        answer(desk.office, seal_request(late, desk.line.credentials().key))


def test_a_request_of_a_wrong_clock_is_made_anew_when_the_clock_is_right(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same request was repeated until its date had come: no command of the line made that board authentic."""

    class Ahead(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return datetime.now(tz) + timedelta(days=3)

    run, board = desk.run(), make_board(1)
    with monkeypatch.context() as wrong:
        wrong.setattr(sign_requests, "datetime", Ahead)
        early = desk.request(run, board)
    with pytest.raises(RequestAheadError):
        answer(desk.office, early.octets)
    assert build(run, board).verified.verdict == "authentic"
    assert run.job is not None
    assert desk.office.plant.line.count_units(run.job.id)[0] == 1


def test_a_request_that_waited_a_day_is_judged_by_the_job_of_that_day(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nothing carried for a day: one job ended meanwhile, another began; its unit is the board's first there."""
    begins = NOW + timedelta(hours=23)
    today, board = desk.run(), make_board(1)
    tomorrow = {"not_before": begins, "ends": begins + timedelta(days=2), "title": "tomorrow"}
    with pytest.raises(PolicyError, match="it begins"):
        desk.run(**tomorrow)
    waiting = desk.request(today, board)

    class NextDay(datetime):
        @classmethod
        def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
            return datetime.now(tz) + timedelta(days=1)

    monkeypatch.setattr(jobs, "datetime", NextDay)
    assert desk.asks(waiting).refused == "job"
    with pytest.raises(PolicyError, match="it ended"):
        build(today, board)
    run = desk.run(**tomorrow)
    assert build(run, board).verified.verdict == "authentic"
    assert run.job is not None
    assert today.job is not None
    for station, units in ((desk.office, (0, 1)), (desk.line, (1, 1))):
        assert tuple(station.plant.line.count_units(job.id)[0] for job in (today.job, run.job)) == units


def test_a_request_that_was_answered_is_taken_again_when_it_is_asked_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same request is the same parcel."""
    there = {"a parcel": SimpleNamespace(id="a parcel", octets=b"a request")}

    class Post:
        def new_parcels(self, _own: str, known: set[str]) -> list[Any]:
            return [parcel for name, parcel in there.items() if name not in known]

        def drop(self, name: str, _own: str) -> None:
            del there[name]

    station: Any = SimpleNamespace(identity=SimpleNamespace(fingerprint="ab" * 32))
    transport: Any = Post()
    monkeypatch.setattr(parcels, "received", lambda _station, _kind: [])
    inbox = Inbox(station, transport, SIGN_REQUEST)
    monkeypatch.setattr(inbox, "_opened", lambda octets: octets)
    asked = dict(there)
    for _ in range(2):
        there.update(asked)
        (come,) = inbox.collect()
        assert inbox.collect() == [], "each is given once until it is dropped"
        come.drop()


@pytest.mark.parametrize(("seconds", "pause", "slept"), [(1.0, 0.05, 0.05), (0.02, 0.4, 0.02), (0.0, 0.4, 0.0)])
def test_without_notifications_an_office_looks_again_after_the_shorter_of_both_times(
    seconds: float, pause: float, slept: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rests: list[float] = []
    monkeypatch.setattr(sign_requests, "time", SimpleNamespace(sleep=rests.append))
    station: Any = SimpleNamespace(identity=SimpleNamespace(fingerprint="ab" * 32))
    folder: Any = SimpleNamespace()
    Inbox(station, folder, SIGN_REQUEST).wait(seconds, pause)
    assert rests == [slept]
