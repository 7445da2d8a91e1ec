"""What the plant and the line refuse, each with its message and with what to do about it, in the words of the user."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import nullcontext
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import psycopg
import pytest

from teds_provision.errors import (
    BadDataError,
    ForkError,
    KeyMismatchError,
    LinkError,
    NotAuthenticError,
    NotFoundError,
    PolicyError,
    RosterExpiredError,
    TedsProvisionError,
    UsageError,
)
from teds_provision.plant import apply_pages, jobs, line, membership, office, owner, postgres, schema, sync
from teds_provision.plant.commands import line as of_line
from teds_provision.plant.commands.nodes import PlantView
from teds_provision.plant.commands.provision import LineOptions
from teds_provision.plant.connecting import NotMemberError
from teds_provision.plant.folder_transport import FolderTransport
from teds_provision.plant.line import LineRun, LineUnit, Scans
from teds_provision.plant.service import LONGEST_TEXT, PlantWatch
from teds_provision.protocol.keys import SoftwareKey
from teds_provision.protocol.plant.roster import Member, RemovedMember, Share
from teds_provision.provisioning.board_type import WrongBoardError

NODE, OTHER = bytes.fromhex("8d4d9da65281f7000001"), bytes.fromhex("8d4d9da65281f7000002")
NOW = datetime(2026, 3, 1, 12, tzinfo=UTC)
MEMBER, GONE = SoftwareKey(61), SoftwareKey(62)


def stub(**members: Any) -> Any:
    return SimpleNamespace(**members)


def refused(run: Callable[[], object], kind: type[TedsProvisionError], message: str, hint: str) -> None:
    with pytest.raises(kind) as error:
        run()
    assert (error.value.message, error.value.hint) == (message, hint)


# -- rosters and registries --------------------------------------------------------------------------------------------

NEW_STATION = "A station without nodes can be set up again: init --request, trust ca sign, init --certificate"


def test_without_a_registry_a_station_is_shown_how_to_join_one() -> None:
    alone = stub(plant=stub(roster=None, joined=None))
    refused(
        lambda: apply_pages.require_roster(alone), PolicyError, "This station has joined no registry.",
        "Join one: teds-provision registry connect --files DIR",
    )  # fmt: skip
    refused(
        lambda: jobs.roster_of(alone), PolicyError, "Jobs need a registry, and this station has not joined one.",
        "To join one: teds-provision registry connect. To create one: teds-provision registry create",
    )  # fmt: skip
    service = cast("Any", PlantWatch.__new__(PlantWatch))
    service.status = lambda: None
    refused(
        lambda: asyncio.run(service._get_plant(None)), NotFoundError, "This station has joined no registry.",
        "Join one: teds-provision registry connect",
    )  # fmt: skip
    service._station = stub(plant=stub(line=stub(jobs=lambda: [stub(id="0b5f1"), stub(id="0b5f2"), stub(id="1111")])))
    for text, count in (("0b5f", 2), ("0B5F", 2), ("9999", "No"), ("111", "No")):
        refused(lambda: service.job(text), NotFoundError, f"{count} jobs begin with {text}.", "GET /jobs lists them.")  # noqa: B023


def test_a_roster_that_cannot_be_joined_is_named_with_what_the_owner_must_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def roster(**changes: Any) -> Any:
        made = {
            "registry": "r1", "version": 1, "hash": "h", "name": "plant", "created": NOW, "expires": NOW + 1 * day,
            "member": lambda _: True,
        }  # fmt: skip
        return stub(**made | changes)

    day = timedelta(days=1)
    found = list[Any]()
    station = stub(ca=b"CA", fingerprint="me", plant=stub(roster=None))
    transport = stub(where="the stick", rosters=lambda: iter(found))
    monkeypatch.setattr(membership, "now", lambda: NOW)
    monkeypatch.setattr(membership, "open_roster", lambda octets, _ca: octets)
    monkeypatch.setattr(membership, "names_other_ca", lambda octets, _ca: octets == b"foreign")

    def join(octets: Any = None) -> Any:
        return membership.found_roster(station, transport, octets)

    refused(
        lambda: join(b"foreign"), PolicyError,
        "The roster is signed by another CA than this station's, so it cannot join.", NEW_STATION,
    )  # fmt: skip
    request = (
        "Send the owner a request (registry request --output FILE); the owner then runs: registry add FILE --role …"
    )
    for rosters in ([], [roster(member=lambda _: None)]):
        found[:] = rosters
        refused(join, NotFoundError, "No roster in the stick that this owner's CA signed names this station.", request)
    strangers = [b"foreign", b"junk", b"foreign"]

    def opened(octets: Any, _ca: bytes) -> Any:
        if isinstance(octets, bytes):
            raise NotAuthenticError("Another CA signed it.") if octets != b"newer" else BadDataError("Of a newer form.")
        return octets

    with monkeypatch.context() as patch:
        patch.setattr(membership, "open_roster", opened)
        for rosters in ([b"foreign"], strangers, strangers[:2], [b"newer", b"foreign"]):
            found[:] = rosters
            refused(
                join, PolicyError,
                "Every roster in the stick is signed by another CA than this station's, so it cannot join.",
                NEW_STATION,
            )  # fmt: skip
        for others in ([b"junk"], [b"newer"], [*strangers, roster(member=lambda _: None)]):
            found[:] = others
            refused(
                join, NotFoundError, "No roster in the stick that this owner's CA signed names this station.", request
            )
        found[:] = [*strangers, mine := roster()]
        assert join() is mine
    found[:] = [roster(), roster(registry="r2")]
    refused(join, PolicyError, "the stick contains rosters of 2 registries.", "Choose one: --roster FILE")
    found[:] = [roster(created=NOW + day + timedelta(seconds=1), expires=NOW + 90 * day)]
    refused(
        join, PolicyError, "The roster of plant is dated 2026-03-02, in the future.",
        "Set the clock of this machine, or have the owner set his and sign the next version: registry renew --redate",
    )  # fmt: skip
    found[:] = [roster(created=NOW + day, expires=NOW)]
    refused(
        join, RosterExpiredError, "The roster of plant expired on 2026-03-01.",
        "Ask its owner to renew it: registry renew",
    )  # fmt: skip
    found[:] = [roster(version=1), newer := roster(version=2), roster(version=3, member=lambda _: None)]
    assert join() is newer


def held(**changes: Any) -> Any:
    north = Member("north", MEMBER.point, b"", frozenset({"line"}))
    members = {"registry": "r", "name": "plant", "version": 3, "created": NOW, "members": (north,)}
    gone = RemovedMember("gone", GONE.point, frozenset({"line"}), "lost", (0, ""))
    return stub(**members | {"by_key": {north.fingerprint: north, gone.fingerprint: gone}} | changes)


def test_who_cannot_be_added_is_refused_with_another_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(owner, "require_roster", lambda _: held())
    monkeypatch.setattr(owner, "now", lambda: NOW)
    good = [True]
    monkeypatch.setattr(owner, "verify", lambda *_: good[0])

    def add(key: SoftwareKey, name: str = "west", created: datetime = NOW) -> Callable[[], object]:
        from teds_provision.protocol.plant.document import MemberRequest

        asked = MemberRequest(name, key.point, b"", "", created)
        return lambda: owner.add(stub(ca=b"CA"), asked, frozenset({"line"}))

    new, late = SoftwareKey(63), NOW + timedelta(days=1, seconds=1)
    refused(
        add(new, created=late), PolicyError, "The request of west is dated 2026-03-02, in the future.",
        "Set the clock of that station, or of this one.",
    )  # fmt: skip
    refused(
        add(GONE), PolicyError, "gone was removed with this key, and a removed key cannot return.",
        "Create a new station on that machine: init in another --home",
    )  # fmt: skip
    refused(add(MEMBER), PolicyError, "north is already a member.", "Change its roles: registry role")
    refused(add(new, "north"), PolicyError, "There is already a member called 'north'.", "Choose another name: --name")
    good[0] = False
    refused(add(new), PolicyError, "Station west is not certified by this owner's CA and cannot join.", NEW_STATION)


def test_the_owner_is_shown_how_to_sign_to_remove_and_to_date_a_roster(monkeypatch: pytest.MonkeyPatch) -> None:
    for key in (None, stub(point=b"another CA")):
        station = stub(vault=stub(ca=lambda key=key: key), ca=b"CA")
        refused(
            lambda: owner.signed(station, stub()), NotFoundError, "The CA key is not in this vault.",  # noqa: B023
            "Add --draft FILE, then sign the draft on the station with the CA key: registry sign FILE",
        )  # fmt: skip
    monkeypatch.setattr(owner, "require_roster", lambda _: held(named=lambda _: None))
    monkeypatch.setattr(owner, "require_member", lambda *_: stub(name="west", fingerprint="w"))
    chains = stub(plant=stub(pages=stub(chain=lambda _: stub(counted=(3, "h")), newest=lambda: [("w", "2027")])))
    for why in ("lost", "stolen"):
        refused(
            lambda: owner.draft_removal(chains, "west", cast("Any", why), None), UsageError,  # noqa: B023
            "Which is the last page of west that you trust?", "Add --last N; registry log lists its pages.",
        )  # fmt: skip
    monkeypatch.setattr(owner, "now", lambda: NOW)
    refused(
        lambda: owner.require_wrong_date(chains, held()), PolicyError,
        "Roster 3 is dated 2026-03-01T12:00:00Z, not in the future.", "Leave --redate out.",
    )  # fmt: skip
    chains.fingerprint = "me"
    ahead = held(created=NOW + timedelta(days=2), member=lambda _: stub(name="west"))
    refused(
        lambda: owner.require_wrong_date(chains, ahead), PolicyError,
        "The clock of this machine is behind: the newest page of west is dated 2027.",
        "Set the clock of this machine. If that of west is wrong, have it set, and sync first.",
    )  # fmt: skip
    monkeypatch.setattr(owner, "read_roster", lambda *_: stub(unsigned=lambda: {"version": 1}))
    refused(
        lambda: owner.read_draft(b'{"version": 1, "more": 2}', b"CA"), BadDataError,
        "The draft was written by a newer version of teds-provision.", "Sign it with that version.",
    )  # fmt: skip


MEMBER_SQL = "At a keeper, with FILE from registry request --output FILE: registry sql --member FILE | psql"
ALONE = "All other work can continue without it."


@pytest.mark.parametrize(
    ("state", "text", "late", "hint"),
    [
        ("TE001", "x", False, MEMBER_SQL),
        ("TE002", "page 3", False, "See: registry status"),
        ("TE003", "page 3", False, "Run it again: registry sync"),
        ("TE004", "100 pages", False, "A later sync sends the rest."),
        ("53100", "disk full", False, "Its administrator must free some space."),
        ("53200", "out of memory", True, "Its administrator must free some space."),
        ("42P01", "x", False, "Ask its administrator to run: registry sql | psql"),
        ("42501", "denied", False, "Ask its administrator to run again: registry sql | psql"),
        (None, "x", True, ALONE),
        (None, 'role "x" is not permitted to log in', False,
         f"If this station was removed, its key cannot return. Otherwise a{MEMBER_SQL[1:]}"),
        ("57P01", "going down", False, ALONE),
    ],
)  # fmt: skip
def test_an_error_of_the_database_has_its_remedy(state: str | None, text: str, late: bool, hint: str) -> None:
    error = psycopg.Error(text)
    error.sqlstate = state
    assert postgres._failure(error, late=late).hint == hint


def test_the_url_of_a_registry_is_a_place_alone_and_a_login_comes_from_a_request() -> None:
    own = "The station logs in with its own key: registry request --output FILE"
    for url in ("postgresql://me:secret@h/d", "postgresql://h/d?password=x"):
        refused(
            lambda: postgres.parameters(url, "ab" * 32, b""), UsageError,  # noqa: B023
            "The URL of a registry must not contain a password.", own,
        )  # fmt: skip
    refused(
        lambda: postgres.parameters("postgresql://h/d?sslmode=disable&options=x", "ab" * 32, b""), UsageError,
        "The URL of a registry may not set options, sslmode.", "Remove it.",
    )  # fmt: skip
    refused(
        lambda: schema.member_sql("ab" * 32, "md5x"), BadDataError,
        "The request's login is not a SCRAM-SHA-256 verifier.", "Create it again: registry request",
    )  # fmt: skip


def test_a_station_that_may_not_go_on_is_shown_how_it_could(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    refused(
        lambda: FolderTransport(tmp_path / "none"), LinkError, f"There is no folder {tmp_path / 'none'}.",
        "Create it, or plug in the stick.",
    )  # fmt: skip
    heads = [("west", "me", 4, "h"), ("gone", "me", 9, "h"), ("west", "other", 9, "h"), ("west", "me", 3, "h")]
    station = stub(fingerprint="me", plant=stub(pages=stub(heads=lambda: heads)))
    roster = stub(member=lambda who: None if who == "gone" else who, name_of=lambda who: f"station {who}")
    monkeypatch.setattr(sync, "own_chain", lambda _: stub(counted=(2, "h")))
    refused(
        lambda: sync._require_all_seen(station, roster, {1, 3}), PolicyError,
        "This home was restored from a backup. station west has seen its page 4, but the last one here is 3.",
        "Get the missing pages: registry sync --files DIR that station west filled; or registry resume",
    )  # fmt: skip
    sync._require_all_seen(station, roster, {4})
    done = list[object]()
    removed = stub(member=lambda _: None, name="plant", version=7)
    station = stub(fingerprint="me", unlock=lambda: done.append("unlocked"), home=tmp_path, notice=None)
    monkeypatch.setattr(sync, "_rosters", lambda *_: [])
    monkeypatch.setattr(sync, "require_roster", lambda _: removed)
    monkeypatch.setattr(sync, "apply_claims", lambda _: done.append("claims"))
    refused(
        lambda: sync.sync(station, stub()), NotMemberError, "This station was removed from plant (roster 7).",
        "A removed key cannot return: create a new station (init) and have it added.",
    )  # fmt: skip
    assert done == ["unlocked", "claims"]


def test_another_home_under_this_key_is_a_fork_that_a_person_decides(monkeypatch: pytest.MonkeyPatch) -> None:
    alarms = list[tuple[object, ...]]()
    monkeypatch.setattr(sync, "alarm", lambda _station, *given: alarms.append(given))
    station = stub(fingerprint="me", plant=stub(home="0123"))
    pages = [stub(number=5, home="ee"), stub(number=4, home=""), stub(number=6, home="aa")]
    refused(
        lambda: sync._stop_at_fork(station, stub(where="office"), pages), ForkError,
        "office has pages under this station's key that are not of this home, from number 4 on (home aa, ee, unknown;"
        " here 0123): a disk image was restored, or a copy of this home is in use.",
        "Find out who has a copy; if in doubt, have this station removed. Then: teds-provision registry resume",
    )  # fmt: skip
    assert alarms == [("fork", "me", 4, "pages of home aa, ee, unknown that are not of this one")]


def test_what_a_roster_cannot_say_of_its_members_is_refused_with_what_can(monkeypatch: pytest.MonkeyPatch) -> None:
    west = stub(name="west", fingerprint="w", roles={"keeper", "line"}, signed=None)
    roster = held(member=lambda who: west if who == "w" else None, name_of=lambda who: f"station {who}")
    monkeypatch.setattr(owner, "require_roster", lambda _: roster)
    monkeypatch.setattr(owner, "require_member", lambda *_: west)
    station = stub(plant=stub(joined=True, pages=stub(chain=lambda _: stub(id=1, counted=(3, "h3")))))
    station.plant.pages.chain_links = lambda _: [(n, f"h{n}", f"h{n - 1}") for n in (1, 2, 3, 4)]
    refused(
        lambda: owner.draft_first(station, "plant", timedelta(days=1)), PolicyError,
        "This station already belongs to a registry.", "See: teds-provision registry status",
    )  # fmt: skip
    refused(
        lambda: owner.with_roles(station, "west", frozenset({"line"}), None), PolicyError,
        "west is a keeper, and that is taken by a removal alone: else its bans would end in silence.",
        "registry remove west --retired",
    )  # fmt: skip
    for n in (4, 5):
        refused(
            lambda: owner.page_place(station, "w", n), NotFoundError,  # noqa: B023
            f"Page {n} of that station is missing here or does not count.", "See: registry status",
        )  # fmt: skip
    assert [owner.page_place(station, "w", n) for n in (3, 1)] == [(3, "h3"), (1, "h1")]
    for to in ("w", "x"):
        refused(
            lambda: owner.shared(station, Share(("all", ""), (to,))), PolicyError,  # noqa: B023
            f"station {to} does not have the role 'base', so it cannot receive keys.", "registry role",
        )  # fmt: skip


def test_what_no_login_and_no_page_can_be_is_refused() -> None:
    for digits in ("ab" * 8, "AB" * 32, "ab" * 32 + "\n", "'; drop --"):
        refused(
            lambda: schema.role_of(digits), BadDataError,  # noqa: B023
            "A station's login needs all 64 digits of its fingerprint.", "",
        )  # fmt: skip
    refused(lambda: schema.mend_sql("ab" * 32, 0), BadDataError, "Page numbers start at 1.", "")
    watch = cast("Any", PlantWatch.__new__(PlantWatch))
    watch.nodes = lambda text: {"text": text}
    request = stub(query_params={"text": "x" * 201})
    assert LONGEST_TEXT == 200
    refused(lambda: asyncio.run(watch._get_nodes(request)), UsageError, "text may have at most 200 characters.", "")


# -- jobs --------------------------------------------------------------------------------------------------------------


def test_a_job_that_cannot_be_worked_on_is_refused_with_whom_to_ask(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    roster = stub(expires=NOW, has=lambda *_: False, name_of=lambda who: f"station {who}", point_of=None, registry="r")
    monkeypatch.setattr(jobs, "now_of", lambda _: NOW)
    refused(
        lambda: jobs.roster_of(stub(plant=stub(roster=roster))), RosterExpiredError,
        "The roster has expired, so no job can start.",
        "Ask the owner to renew it: teds-provision registry renew",
    )  # fmt: skip
    monkeypatch.setattr(jobs, "roster_of", lambda _: roster)
    signed = stub(signer="west", registry="r2", id="j", hash="h", octets=b"", title="cells", ends=NOW)
    monkeypatch.setattr(jobs, "open_job", lambda *_: signed)
    refused(
        lambda: jobs.read_job(stub(), b""), PolicyError, "station west signed this job but is not a keeper.",
        "Ask a keeper for a job.",
    )  # fmt: skip
    roster.has = lambda _who, role: role == "keeper"
    refused(lambda: jobs.read_job(stub(), b""), PolicyError, "This job belongs to another registry.", "")
    signed.registry, known = "r", list[Any]()
    rows = stub(add_job=lambda _: None, job=lambda _: known[0], state_of=lambda _: ("closed", True))
    keeping = stub(plant=stub(line=rows), durable=lambda _: nullcontext(), reading=nullcontext)
    for other in (None, stub(hash="another")):
        known[:] = [other]
        refused(
            lambda: jobs.take_job(keeping, b""), PolicyError, "A different job with the ID j is already known here.",
            "Ask the keeper for a job with a new ID.",
        )  # fmt: skip
    refused(
        lambda: jobs.require_open(keeping, cast("Any", signed)), PolicyError,
        "The job “cells” cannot be worked on: it is closed here.", "Ask the keeper for a new job.",
    )  # fmt: skip
    digests = {"with what it extends": "1", "alone": "2"}
    monkeypatch.setattr(jobs, "files_digest", lambda *_: digests["with what it extends"])
    monkeypatch.setattr(jobs, "digest_of_file", lambda _: digests["alone"])
    station, path = stub(home=tmp_path), tmp_path / "cell.toml"

    def asked(sha256: str) -> Any:
        return stub(profile="cell", profile_sha256=sha256)

    jobs.require_profile(station, asked("1"), path)
    refused(
        lambda: jobs.require_profile(station, asked("2"), path), PolicyError,
        "The job names the file of profile cell alone, without the profiles that it extends.",
        "An earlier version created it. Ask its keeper for a new job.",
    )  # fmt: skip
    refused(
        lambda: jobs.require_profile(station, asked("3"), path), PolicyError,
        f"Profile cell is not the one in the job: {path}, with all that it extends, has a different SHA-256.",
        f"Copy the job's profile, and those that it extends, to {tmp_path / 'profiles'}.",
    )  # fmt: skip
    (tmp_path / "0b5f").mkdir()
    (tmp_path / "file").write_bytes(b"a job")
    with monkeypatch.context() as patch:
        patch.chdir(tmp_path)
        patch.setattr(jobs, "job_row", lambda _station, text: stub(octets=f"kept {text}"))
        patch.setattr(jobs, "read_job", lambda _station, octets: octets)
        patch.setattr(jobs, "take_job", lambda _station, octets: octets)
        assert [cast("Any", jobs.find_job(stub(), text)) for text in ("0b5f", "file")] == ["kept 0b5f", b"a job"]
    monkeypatch.setattr(jobs, "take_received", lambda _: None)
    rows = [stub(id="0b5f1"), stub(id="0b5f2")]
    station = stub(plant=stub(line=stub(jobs=lambda: rows, job=lambda _: None)))
    refused(
        lambda: jobs.job_row(station, "0B5F"), NotFoundError, "2 jobs have an ID that begins with 0B5F.",
        "Give more digits; see: teds-provision job list",
    )  # fmt: skip
    for text in ("0b5f3", "0b5", "0b5f0000-1111-4222-8333-444444444444"):
        refused(
            lambda: jobs.job_row(station, text), NotFoundError, f"There is no job {text}, and no file with that name.",  # noqa: B023
            "See: teds-provision job list",
        )  # fmt: skip


def test_a_board_that_gets_nothing_is_refused_with_where_to_put_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def run(rule: str = "none", *, calibrations: Path | None = None, **job: Any) -> Any:
        made = cast("Any", LineRun.__new__(LineRun))
        made.calibrations, made.scans, made.only_verify, made.office = calibrations, None, False, None
        made.job = stub(
            calibration=stub(rule=rule, sha256="ab", wants=lambda _: None, max_age_days=30), boards={}, title="cells",
            **{"assurance": "tap"} | job,
        )  # fmt: skip
        made.station = stub(identity=stub(fingerprint="me"), plant=stub(roster=stub(has=lambda *_: False)))
        return made

    monkeypatch.setattr(LineRun, "_require_open", lambda _: None)
    refused(
        run().__post_init__, PolicyError,
        "This station may not key new boards: it does not have the role 'line' in the roster.",
        "Ask the owner for it: teds-provision registry role NAME line",
    )  # fmt: skip
    for place in (None, tmp_path):
        refused(
            run("one", calibrations=place)._common_calibration, NotFoundError,
            "The job's calibration (SHA-256 ab) was not found.", "Give its file or directory: --calibrations PATH",
        )  # fmt: skip
    file = tmp_path / "file"
    file.write_bytes(b"")
    for place in (None, file):
        refused(
            lambda: run("list", calibrations=place)._calibration_of(NODE), NotFoundError,  # noqa: B023
            "This job requires a calibration for each board.", "Give their directory: --calibrations DIR",
        )  # fmt: skip
    refused(
        lambda: run("list", calibrations=tmp_path)._calibration_of(NODE), NotFoundError,
        f"There is no file {NODE.hex()}.* in {tmp_path}.", "Copy this board's calibration there.",
    )  # fmt: skip
    digests = iter("12")
    with monkeypatch.context() as patch:
        patch.setattr(line, "digest_of_file", lambda _: next(digests))
        refused(
            lambda: run()._with_digest(file, NODE, lambda: cast("Any", None)), PolicyError,
            f"The calibration {file} changed while it was being read.", "Tap the board again.",
        )  # fmt: skip
    listed = run()
    listed.job.boards = {OTHER: "ab" * 32}
    refused(
        lambda: listed.order(stub(uuid=NODE)), PolicyError, f"Board {NODE.hex()} is not on the job's list.",
        "Set it aside.",
    )  # fmt: skip
    refused(
        lambda: listed.order(stub(uuid=OTHER, fingerprint="cd" * 32)), KeyMismatchError,
        f"Board {OTHER.hex()} holds the key {'cd' * 16}; the job says {'ab' * 16}.",
        "It may be another board under the same UUID. Set it aside.",
    )  # fmt: skip
    for wanted, hint in (("tap", "Tap it on the NFC reader."), ("bus", "Connect it to a wired bus, or tap it.")):
        refused(
            lambda: run(assurance=wanted).allot_unit(stub(tapped=False), stub(uuid=NODE, whitelisted=None), None, None),  # noqa: B023
            PolicyError,
            f"The job requires assurance '{wanted}'; board {NODE.hex()} was identified by 'uuid'.", hint,
        )  # fmt: skip
    full = run(count=3, stations={"me": 2}, id="j")
    full.station.plant.line = stub(unit=lambda *_: None, count_units=lambda _: (2, 0, 2))
    full.station.plant.restored, full._given = False, 0
    refused(
        lambda: full.next_row(full.job, NODE), PolicyError,
        f"All 2 units of the job “cells” for this station are assigned: {NODE.hex()} is one too many.",
        "Lay it aside, or ask the keeper for another job.",
    )  # fmt: skip
    unit = cast("Any", LineUnit.__new__(LineUnit))
    unit.run = run(office="office")
    refused(
        lambda: unit.sign(None, None, None, None), PolicyError,
        "An office signs for this job, but this station has no way to reach it.",
        "Give a transfer folder: --files DIR",
    )  # fmt: skip


def test_a_board_whose_label_was_not_scanned_waits_for_it() -> None:
    scans = Scans([])
    refused(
        lambda: scans.require(stub(uuid=NODE)), PolicyError, f"Scan the label of board {NODE.hex()} first.",
        "Then tap it again.",
    )  # fmt: skip
    scans.add_label(OTHER.hex())
    refused(
        lambda: scans.require(stub(uuid=NODE, fingerprint="ab" * 32)), WrongBoardError,
        f"The scanned label belongs to board {OTHER.hex()}, but this is board {NODE.hex()}.",
        "Use the board with that label, or scan the label of this board.",
    )  # fmt: skip


def test_an_office_without_its_role_is_shown_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    roster = stub(has=lambda *_: False, point_of=None, name_of=lambda who: f"station {who}", created=NOW)
    monkeypatch.setattr(office, "roster_of", lambda _: roster)
    station = stub(identity=stub(fingerprint="me"))
    refused(
        lambda: office.answer(station, b""), PolicyError,
        "This station may not sign datasheets: it does not have the role 'sign' in the roster.",
        "Ask the owner for it: teds-provision registry role NAME sign",
    )  # fmt: skip
    roster.has = lambda *_: True
    monkeypatch.setattr(office, "require_adopted", lambda _: None)
    asked = stub(to="me", signer="west", created=NOW + timedelta(days=1, seconds=1))
    monkeypatch.setattr(office, "open_request", lambda *_: asked)
    monkeypatch.setattr(office, "now_of", lambda _: NOW)
    refused(
        lambda: office.answer(station, b""), office.RequestAheadError,
        "station west dated this request 2026-03-02T12:00:01Z, and it is 2026-03-01T12:00:00Z here.",
        "Set the clock of station west, or that of this machine, and ask again.",
    )  # fmt: skip


# -- options -----------------------------------------------------------------------------------------------------------


def test_options_that_do_not_go_together_are_named_with_what_to_leave_out() -> None:
    plain = stub(names_nothing=True, accept_calibration=None, retype=False)

    def options(*, job: str | None = "j", only: str | None = None) -> LineOptions:
        return LineOptions(job, None, None, only, None, "svg", False, False, None)

    def check(given: LineOptions, *, sheet: object = None, **order: Any) -> Callable[[], object]:
        return lambda: given._check(stub(order=stub(**vars(plain) | order), sheet=sheet))

    check(options(only="verify"))()
    refused(check(options(job=None, only="verify")), UsageError, "--only verify requires --job.", "Add --job FILE.")
    refused(
        check(options(), sheet="a sheet"), UsageError, "--batch cannot be combined with --job or --evidence.",
        "Drop --batch.",
    )  # fmt: skip
    drop = "Drop --profile, --calibration, --no-calibration, --name, --accept-calibration and --retype."
    for order in ({"names_nothing": False}, {"accept_calibration": "x"}, {"retype": True}):
        refused(check(options(), **order), UsageError, "The job already defines what each board gets.", drop)
        check(options(job=None), **order)()


def test_a_job_is_drafted_from_one_of_each_choice(monkeypatch: pytest.MonkeyPatch) -> None:
    choice = "A job needs a number of boards or a list of boards."
    for count, listed in ((None, None), (3, Path("x"))):
        settings = {"count": count, "listed": listed}
        refused(
            lambda: of_line._drafted(stub(), stub(), settings), UsageError, choice,  # noqa: B023
            "Use one of --count and --list.",
        )  # fmt: skip
    for given, named in (
        ({"calibration": 1, "calibrations": 2}, "--calibration and --calibrations"),
        ({"calibrations": 2, "calibration_age": 0}, "--calibrations and --calibration-age"),
        ({"calibration": 1, "calibration_age": 0}, "--calibration and --calibration-age"),
    ):
        settings = {"calibration": None, "calibrations": None, "calibration_age": None} | cast("Any", given)
        refused(
            lambda: of_line._rule(settings, {}), UsageError, "A job takes one calibration option.",  # noqa: B023
            f"Use one of {named}.",
        )  # fmt: skip
    monkeypatch.setattr(of_line, "_allotment", lambda _roster, text, total: (text, total))
    refused(
        lambda: of_line._allotments(stub(name_of=str.upper), ["west", "west"], 3), UsageError,
        "Station WEST is named twice.", "Give each station one allotment.",
    )  # fmt: skip


def test_a_node_that_only_others_know_is_shown_where_to_look(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("teds_provision.plant.status.resolve", lambda _station, _text: NODE)
    known = [False]
    station = stub(plant=stub(joined=True), overview=stub(is_known=lambda _: known[0]))
    refused(
        lambda: PlantView().named(station, "left"), NotFoundError, f"This station has not met node {NODE.hex()}.",
        f"See: nodes --plant {NODE.hex()}",
    )  # fmt: skip
    known[0] = True
    assert PlantView().named(station, "left") == [NODE]
    assert PlantView().named(stub(plant=stub(joined=None)), "left") == []
