"""In which order an office looks at a request, and at which edge it says no (contract/plant.md section 11)."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import BadDataError, PolicyError
from teds_provision.plant import office
from teds_provision.plant.jobs import take_job
from teds_provision.plant.office import RequestAheadError, _RefusedError, _require_name, _text_of
from teds_provision.plant.sign_requests import Delivery, name_of, receivers
from teds_provision.protocol.keys import SoftwareKey, node_key_message
from teds_provision.protocol.plant.job import CalibrationRule, Job
from teds_provision.protocol.plant.signing import SignRequest, open_request, seal_request
from teds_provision.station.plant.line import UnitRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import RevocationRecord, WhitelistEntry
from tests.bench import Board

from .owner import NOW, job_of
from .stations import Plant
from .test_jobs import make_board
from .test_office import Desk, LocalOffice, proven

UUID = bytes.fromhex("8d4d9da65281f7000001")


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    plant = Plant(tmp_path)
    line = plant.member("west", "line")
    plant.north.unlock()
    line.unlock()
    yield Desk(plant, plant.north, line, LocalOffice(plant.north))
    plant.close()


def test_a_request_is_judged_in_the_order_of_the_contract(desk: Desk) -> None:
    """One that is wrong in every way, which is put right one thing after the other."""
    board, base = make_board(1), desk.plant.member("south", "base")
    good = desk.request(desk.run(count=1, stations={desk.line.fingerprint: 1}), board)
    north, line = desk.office, desk.office.plant.line
    named = replace(good, name="another name", nonce=bytes(16), sequence=70_000)
    bad = replace(named, key_signature=bytes(64), proof=bytes(64))
    north.policy.deny(RevocationRecord(board.uuid, None, "stolen", ""))
    north.pins.put(WhitelistEntry(board.uuid, "ab" * 32, assurance="uuid"))
    with north.transaction():
        line.put_unit(UnitRow(good.job, bytes(10), 1, "2026-01-31T12:00:00Z"))

    def refused(request: SignRequest, **more: Any) -> tuple[str, str]:
        reply = desk.asks(request, **more)
        assert reply.security == b""
        if reply.refused != "not-line":
            entry = list(north.audit_log.entries())[-1]
            assert (entry.act, entry.uuid, entry.outcome, entry.detail) == (
                "sign-request", board.uuid, reply.refused,
                {"by": desk.line.fingerprint, "job": request.job, "why": reply.why},
            )  # fmt: skip
        return reply.refused, reply.why

    assert refused(bad, by=base)[0] == "not-line"
    assert refused(bad, jobs=[]) == ("job", "this office is not working on that job")
    assert refused(bad) == ("revoked", "the node was revoked: stolen")
    north.policy.forgive(board.uuid)
    assert refused(bad) == ("other-key", "this office knows the board with another key")
    north.pins.remove(board.uuid)
    assert refused(bad) == ("proof", "field 102 does not sign this key for this UUID")
    assert refused(replace(named, proof=bytes(64))) == ("proof", "the board did not sign this request")
    asked = proven(named, desk.line, board)
    assert refused(asked) == ("full", "all 1 units of the job are assigned")
    line._store.execute("DELETE FROM units")
    assert refused(asked)[0] == "sequence"
    assert refused(asked, jump=True)[0] == "differs"
    assert north.pins.entry(board.uuid) is None, "nothing was kept"
    assert line.units(good.job) == []
    reply = desk.asks(proven(replace(good, nonce=bytes(16)), desk.line, board))
    assert (reply.refused, reply.sequence) == ("", 1)


def test_a_signature_is_durable_with_its_pin_unit_sequence_and_event(desk: Desk) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)
    reply = desk.asks(request)
    north = desk.office
    entry, node = north.pins.entry(board.uuid), north.nodes.get(board.uuid)
    assert entry is not None
    assert node is not None
    assert (entry.assurance, node.point, node.sequence) == ("uuid", board.key.point, 1)
    [row] = north.plant.line.units(request.job)
    assert (row.uuid, row.unit, row.attempts, row.passed) == (board.uuid, 1, 1, 0)
    kept = north.plant.line.sign_request(request.hash, "in")
    assert kept is not None
    assert (kept.peer, kept.job, kept.sequence, kept.request) == (
        desk.line.fingerprint, request.job, 1, request.octets
    )  # fmt: skip
    told = [json.loads(text) for _, _, text in north.plant.outbox(99)]
    [signed] = [one for one in told if one["act"] == "signed"]
    assert (signed["uuid"], signed["sequence"], signed["job"], signed["unit"]) == (
        board.uuid.hex(), 1, request.job, 1
    )  # fmt: skip
    assert reply.sequence == 1
    entry = list(north.audit_log.entries())[-1]
    assert (entry.act, entry.uuid, entry.outcome, entry.detail) == (
        "sign-request", board.uuid, "signed", {"by": desk.line.fingerprint, "job": request.job, "unit": 1}
    )  # fmt: skip


def test_the_same_request_gets_the_stored_answer_whatever_happened_since(desk: Desk) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)
    first = office.answer(desk.office, request.octets)
    assert first is not None
    north = desk.office
    north.plant.line.set_job_state(request.job, "closed")
    north.policy.deny(RevocationRecord(board.uuid, None, "stolen", ""))
    north.plant.line._store.execute("DELETE FROM units")
    assert office.answer(north, request.octets) == first
    assert office.answer(north, request.octets, []) == first
    assert north.plant.line.units(request.job) == [], "no new unit"
    later = proven(replace(request, nonce=bytes(16)), desk.line, board)
    assert desk.asks(later).refused == "job", "another H is another request"


def asked_for(desk: Desk, good: SignRequest, board: Board, **changes: Any) -> SignRequest:
    """Return a good request for another job of the office, which is kept there alone."""
    named = {"stations": {desk.line.fingerprint: 3}, "sign": desk.office.fingerprint, **changes}
    made = take_job(desk.office, job_of(desk.office, registry=desk.plant.roster.registry, **named))
    return proven(replace(good, job=made.id), desk.line, board)


def test_an_answer_that_another_process_gave_meanwhile_is_the_answer(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = desk.request(desk.run(), make_board(1))
    seen, line = list[str](), desk.office.plant.line

    def sign_request(hash: str, way: str) -> Any:
        seen.append(hash)
        return None if len(seen) == 1 else SimpleNamespace(answer=b"given meanwhile" if len(seen) == 2 else None)

    monkeypatch.setattr(line, "sign_request", sign_request)
    assert office.answer(desk.office, request.octets) == b"given meanwhile"
    assert seen == [request.hash] * 2
    assert line.units(request.job) == [], "no second unit or sequence"


def test_a_name_that_the_job_does_not_give_is_signed_for_nobody(desk: Desk) -> None:
    board = make_board(1)
    request = asked_for(desk, desk.request(desk.run(), board), board, name="cell {unit}")
    reply = desk.asks(request)
    assert (reply.refused, reply.why) == ("differs", "the name None does not follow the job's pattern")


def test_an_office_gives_the_unit_above_the_greatest(desk: Desk) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)
    line = desk.office.plant.line
    with desk.office.transaction():
        line.put_unit(UnitRow(request.job, bytes(10), 7, "2026-01-31T12:00:00Z"))
    assert desk.asks(request).security
    assert [row.unit for row in line.units(request.job)] == [7, 8]


def test_after_a_restore_the_answers_of_a_unit_are_those_that_its_pages_have(desk: Desk) -> None:
    """Of an office that is a line of the job as well, attempts are its own boards'."""
    board = make_board(1)
    good = desk.request(desk.run(), board)
    for attempts, builds_too, answers in ((15, False, True), (16, False, False), (16, True, True)):
        stations = {desk.line.fingerprint: 1, **({desk.office.fingerprint: 1} if builds_too else {})}
        request = asked_for(desk, good, board, stations=stations)
        with desk.office.transaction():
            row = UnitRow(request.job, board.uuid, 1, "2026-01-31T12:00:00Z", attempts=attempts)
            desk.office.plant.line.put_unit(row)
        reply = desk.asks(request)
        assert (bool(reply.security), reply.why) == (answers, "" if answers else "the unit already has 16 answers")


def test_a_sequence_is_one_more_than_the_greater_and_jumps_at_most_65535(desk: Desk) -> None:
    run = desk.run(count=9, stations={desk.line.fingerprint: 9})
    cases = [(0, 0, 1), (9, 3, 10), (3, 9, 10), (4, 65_539, 65_540), (4, 65_540, None), (0, 65_535, 65_536)]
    for number, (own, asked, sequence) in enumerate(cases):
        board = make_board(number)
        request = proven(desk.request(run, board), desk.line, board, sequence=asked)
        desk.office.nodes.remember(board.uuid, sequence=own)
        reply = desk.asks(request)
        if sequence is None:
            assert (reply.refused, desk.office.plant.line.unit(request.job, board.uuid)) == ("sequence", None)
            reply = desk.asks(request, jump=True)
        assert (reply.refused, reply.sequence) == ("", sequence or asked + 1), (own, asked)


def test_a_request_of_more_than_a_day_ahead_gets_no_answer_yet(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    request = desk.request(desk.run(), make_board(1))
    for ahead, waits in ((timedelta(hours=24), False), (timedelta(hours=24, seconds=1), True)):
        monkeypatch.setattr(office, "now_of", lambda roster, ahead=ahead: request.created - ahead)
        if waits:
            with pytest.raises(RequestAheadError, match="west dated this request"):
                desk.asks(request)
            continue
        assert desk.asks(request).security


def test_a_job_that_names_another_office_or_lists_another_board_or_key_signs_nothing(desk: Desk) -> None:
    board = make_board(1)
    good = desk.request(desk.run(), board)
    key = desk.office.pins

    def refused(**changes: Any) -> tuple[str, str]:
        reply = desk.asks(asked_for(desk, good, board, **changes))
        return reply.refused, reply.why

    assert refused(sign="5c" * 32) == ("job", "the job names another office")
    assert refused(sign="station") == ("job", "the job names another office")
    assert refused(count=None, boards={bytes(10): "ab" * 32}) == ("job", "the board is not on the job's list")
    listed = refused(count=None, boards={board.uuid: "ab" * 32})
    assert listed == ("other-key", "the job lists the board with another key")
    assert refused(stations={desk.office.fingerprint: 3})[0] == "job", "the line has no part in it"
    assert refused() == ("", "")
    assert key.entry(board.uuid) is not None


def test_who_may_not_sign_is_no_office_and_what_is_for_another_gets_no_answer(desk: Desk) -> None:
    request = desk.request(desk.run(), make_board(1))
    with pytest.raises(PolicyError, match="does not have the role 'sign'"):
        office.answer(desk.line, request.octets)
    desk.line.unlock()
    elsewhere = seal_request(replace(request, to="0" * 64), desk.line.credentials().key)
    assert office.answer(desk.office, elsewhere) is None
    assert office.answer(desk.office, request.octets[:-8]) is None
    desk.office.plant.begin_restored()
    with pytest.raises(PolicyError, match="restored from a backup"):
        office.answer(desk.office, request.octets)


# -- names, files, ids -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pattern", "name", "good"),
    [
        (None, "anything", True),
        (None, None, True),
        ("cell {unit:03}", "cell 037", True),
        ("cell {unit:03}", "cell 37", True),  # a line counts as it likes
        ("cell {unit}", "cell 4294967295", True),
        ("cell {unit}", "cell 42949672950", False),
        ("cell {unit}", "cell ", False),
        ("cell {unit}", "cell x", False),
        ("cell {unit}", "cell 1 ", False),
        ("cell {unit}", None, False),
        ("{uuid8}.", "8d4d9da6.", True),
        ("{uuid8}.", "8d4d9da6x", False),
        ("{uuid8}", "00000000", False),
        ("{uuid}", "8d4d9da65281f7000001", True),
        ("{uuid}", "8d4d9da65281f7000002", False),
        ("{uuid8} {unit:05}", "8d4d9da6 00001", True),
        ("[{unit}]", "[7]", True),
        ("[{unit}]", "7", False),
    ],
)
def test_a_board_is_named_by_the_pattern_of_its_job(pattern: str | None, name: str | None, good: bool) -> None:
    made, request = SimpleNamespace(name=pattern), SimpleNamespace(uuid=UUID, name=name)
    if good:
        _require_name(cast("Job", made), cast("SignRequest", request))
        return
    with pytest.raises(_RefusedError) as error:
        _require_name(cast("Job", made), cast("SignRequest", request))
    assert error.value.word == "differs"


@pytest.mark.parametrize(
    ("octets", "kind"),
    [
        (b"\xef\xbb\xbf  <dcc/>", "certificate.xml"),
        (b' {"a": 1}', "calibration.json"),
        (b"[1]", "calibration.json"),
        (b"raw, value\n0, 0\n", "calibration.csv"),
        (b'date = "2026-01-31"\n', "calibration.toml"),
    ],
)
def test_a_calibration_is_read_by_what_it_looks_like(octets: bytes, kind: str) -> None:
    assert _text_of(octets) == (octets.decode("utf-8-sig"), kind)
    with pytest.raises(BadDataError, match="not UTF-8"):
        _text_of(octets + b"\xff")


def test_a_parcel_of_a_document_has_an_id_made_from_its_h_and_a_job_goes_to_its_stations_and_office() -> None:
    assert name_of("0123456789abcdef0123456789abcdef" + "f" * 32) == "01234567-89ab-4def-8123-456789abcdef"
    me = cast("Station", SimpleNamespace(identity=SimpleNamespace(fingerprint="me")))

    def to(office: str | None, *stations: str) -> list[str]:
        return receivers(me, cast("Job", SimpleNamespace(stations=dict.fromkeys(stations, 1), office=office)))

    assert to("office", "west", "me", "south") == ["west", "south", "office"]
    assert to("west", "west", "me") == ["west"]
    assert to("me", "west") == ["west"]
    assert to(None, "me") == []


def test_a_request_of_another_line_for_the_same_board_binds_its_own_key(desk: Desk) -> None:
    """What a board signed for one line is of no use to another one."""
    board = make_board(1)
    request = desk.request(desk.run(stations={desk.line.fingerprint: 3}), board)
    east = desk.plant.member("east", "line")
    run = desk.run(stations={desk.line.fingerprint: 1, east.fingerprint: 1})
    assert run.job is not None
    moved = replace(request, job=run.job.id)
    east.unlock()
    stolen = desk.asks(moved, by=east)
    assert (stolen.refused, stolen.why) == ("proof", "the board did not sign this request")
    assert open_request(request.octets, lambda kid: desk.line.point).line == desk.line.point


def test_another_board_that_shows_the_key_of_a_listed_one_has_no_field_102(desk: Desk) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)
    other = Board(uuid=make_board(2).uuid)
    moved = replace(
        request, image=replace(request.image, uuid=other.uuid),
        key_signature=other.key.sign(node_key_message(other.uuid, SoftwareKey(9).point)),
    )  # fmt: skip
    assert desk.asks(proven(moved, desk.line, board)).why == "field 102 does not sign this key for this UUID"


DAY = timedelta(days=1)
ANGLES = b"raw, value\n0, 0\n1, 1\n"
ONE = CalibrationRule("one", hashlib.sha256(ANGLES).hexdigest())
LISTED = CalibrationRule("list", by_uuid={UUID: hashlib.sha256(ANGLES).hexdigest()})
RECENT = CalibrationRule("any", max_age_days=30)
TOO_OLD = "the calibration is older than 30 days, or has no date"
OTHER_ONE = "the calibration is not the one the job specifies"
HAS_NONE = "the job requires a calibration, and the request has none"


@pytest.mark.parametrize(
    ("rule", "octets", "dates", "why"),
    [
        (CalibrationRule(), None, [], ""),
        (CalibrationRule(), ANGLES, [NOW], "the job does not allow a calibration"),
        *((rule, None, [], HAS_NONE) for rule in (ONE, LISTED, RECENT)),
        (RECENT, b" " * (1 << 20), [NOW], ""),
        (RECENT, b" " * ((1 << 20) + 1), [NOW], HAS_NONE),
        *((rule, ANGLES, [None], "") for rule in (ONE, LISTED)),  # the very file: its date does not count
        *((rule, ANGLES + b"\n", [NOW], OTHER_ONE) for rule in (ONE, LISTED)),
        (CalibrationRule("list", by_uuid={bytes(10): LISTED.by_uuid[UUID]}), ANGLES, [NOW], OTHER_ONE),
        (RECENT, ANGLES, [NOW, NOW - 30 * DAY, NOW + DAY], ""),
        (RECENT, ANGLES, [NOW, NOW - 30 * DAY - timedelta(seconds=1)], TOO_OLD),
        (RECENT, ANGLES, [NOW + DAY + timedelta(seconds=1), NOW], TOO_OLD),
        (RECENT, ANGLES, [NOW, None], TOO_OLD),
    ],
)
def test_an_office_takes_the_calibration_that_the_job_asks_for(
    monkeypatch: pytest.MonkeyPatch, rule: CalibrationRule, octets: bytes | None, dates: list[Any], why: str
) -> None:
    found = {channel: SimpleNamespace(date=date) for channel, date in enumerate(dates, 1)}
    monkeypatch.setattr(office, "read_calibrations", lambda _text, _name, profile: {"profile": found}[profile])
    made, asked = SimpleNamespace(calibration=rule), SimpleNamespace(uuid=UUID, calibration=octets)
    if not why:
        taken: Any = office._calibrations(cast("Job", made), cast("SignRequest", asked), cast("Any", "profile"), NOW)
        assert taken == ({} if octets is None else found)
        return
    with pytest.raises(_RefusedError) as error:
        office._calibrations(cast("Job", made), cast("SignRequest", asked), cast("Any", "profile"), NOW)
    assert (error.value.word, error.value.why) == ("job", why)


def test_what_the_pins_or_the_guard_refuse_is_answered_with_their_reason(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    board = make_board(1)
    request = desk.request(desk.run(), board)

    def refuses(why: str) -> Any:
        def refused(*_: Any, **__: Any) -> None:
            raise PolicyError(why)

        return refused

    with monkeypatch.context() as patch:
        patch.setattr(desk.office.pins, "check", refuses("Keepers pin another key."))
        reply = desk.asks(request)
    assert (reply.refused, reply.why) == ("other-key", "Keepers pin another key.")
    with monkeypatch.context() as patch:
        patch.setattr(office, "guard", refuses("The calibration belongs to another sensor."))
        reply = desk.asks(request)
    assert (reply.refused, reply.why) == ("guard", "The calibration belongs to another sensor.")
    assert desk.asks(request).refused == "", "neither is remembered"


def test_an_office_names_what_it_would_build_differently_up_to_five_places(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = desk.request(desk.run(), make_board(1))
    own = request.image.unsigned_blocks()
    extra = {(channel, code): b"added" for channel in (3, 2) for code in (9, 7, 8)}
    job = SimpleNamespace(read_only=(), name=None, profile="p")
    monkeypatch.setattr(
        office, "_profile", lambda *_: SimpleNamespace(build=lambda *_, **__: SimpleNamespace(blocks=own))
    )
    monkeypatch.setattr(office, "_calibrations", lambda *_: {})
    monkeypatch.setattr(office, "guard", lambda *_, **__: None)
    places = ["TEDS 7 of channel 2", "TEDS 8 of channel 2", "TEDS 9 of channel 2", "TEDS 7 of channel 3",
              "TEDS 8 of channel 3"]  # fmt: skip

    def built(blocks: dict[Any, bytes], *read_only: Any) -> Any:
        job.read_only = read_only
        image = SimpleNamespace(unsigned_blocks=lambda: blocks)
        asked: Any = SimpleNamespace(uuid=request.uuid, name=None, image=image)
        return office._built(desk.office, cast("Any", job), asked)

    with pytest.raises(_RefusedError) as error:
        built(own | extra)
    assert (error.value.word, error.value.why) == (
        "differs", f"this office would build it differently: {', '.join(places)}"
    )  # fmt: skip
    assert built(own).blocks == own
    assert built(own | extra, *extra).blocks == own | extra, "what the job lists is read-only in the node"
    with pytest.raises(_RefusedError, match=r"differently: TEDS 9 of channel 3$"):
        built(own | extra, *sorted(extra)[:5])
    lacking = dict(list(own.items())[1:])
    with pytest.raises(_RefusedError, match="would build it differently: TEDS "):
        built(lacking)


def test_text_that_is_nested_too_deep_for_toml_is_a_table(monkeypatch: pytest.MonkeyPatch) -> None:
    def loads(_: str) -> Any:
        raise RecursionError

    monkeypatch.setattr(office.tomllib, "loads", loads)
    assert _text_of(b"a = [[") == ("a = [[", "calibration.csv")


def test_an_office_answers_in_turn_and_takes_away_what_it_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    """A request from the future stays, one of a removed station gets no answer, a foreign one is discarded."""
    notices, sent, gone = list[str](), list[tuple[str, bytes, str]](), list[str]()
    roster = SimpleNamespace(point_of=lambda _: b"", member=lambda digits: digits if digits == "west" else None)
    station: Any = SimpleNamespace(notice=notices.append, point=b"point")

    def answered(_station: Any, document: bytes, jobs: Any) -> bytes | None:
        assert jobs == {"job"}
        if document == b"ahead":
            raise RequestAheadError("It is not time yet.")
        return None if document == b"foreign" else b"answer to " + document + b".signature"

    monkeypatch.setattr(office, "answer", answered)
    monkeypatch.setattr(office, "roster_of", lambda _: roster)
    monkeypatch.setattr(office, "open_request", lambda document, _: SimpleNamespace(signer=document.decode()))
    monkeypatch.setattr(office, "open_answer", lambda sealed, point_of: (sealed, point_of("anybody")))
    monkeypatch.setattr(office, "send", lambda _s, _t, to, sealed, name: sent.append((to, sealed, name)))
    names = ["ahead", "west", "left", "foreign", "west"]
    inbox: Any = SimpleNamespace(
        collect=lambda: [Delivery(name.encode(), partial(gone.append, f"{at} {name}")) for at, name in enumerate(names)]
    )
    done = list(office.answer_all(station, cast("Any", None), inbox, {"job"}, stop=lambda: len(gone) == 3))
    assert [(one.request.signer, one.answer) for one in done] == [
        ("west", (b"answer to west.signature", b"point")), ("left", (b"answer to left.signature", b"point"))
    ]  # fmt: skip
    assert sent == [("west", b"answer to west.signature", name_of(hashlib.sha256(b"answer to west").hexdigest()))]
    assert gone == ["1 west", "2 left", "3 foreign"], "it was stopped before the last one"
    assert notices == ["Not signed: It is not time yet."]
