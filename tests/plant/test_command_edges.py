"""Refusals and warnings of the plant's and the line's commands with their remedies, and the effect of each option."""

from __future__ import annotations

import json
import os
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from uuid import UUID

import pytest

from teds_provision import plant, provisioning
from teds_provision.cli.rendering import local_time
from teds_provision.errors import LinkError, RosterExpiredError
from teds_provision.plant.commands import demo as of_demo
from teds_provision.plant.commands import line as of_line
from teds_provision.plant.commands import registry as commands
from teds_provision.plant.commands.parcels import ParcelCarrier
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.roster import Member, Roster
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import Outcome, call

from .owner import ALL, REGISTRY, alone, join, member, roster_of

NODE = "8d4d9da65281f7000001"
WEST = SoftwareKey(91)
WEST_DIGITS = fingerprint(WEST.point)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    home = tmp_path_factory.mktemp("made") / "owner"
    with alone(home) as station:
        station.ask_by(lambda *_: PASSPHRASE)
        station.unlock()
        west = Member("west", WEST.point, station.identity.certify(WEST.point), frozenset({"line"}))
        join(station, roster_of(station, member(station, "owner", *ALL), west, version=2, previous="0" * 64))
    return home


@pytest.fixture
def home(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "owner")
    return tmp_path / "owner"


@pytest.fixture
def roster(home: Path) -> Roster:
    with Station.inspect(home) as station:
        held = station.plant.roster
    assert held is not None
    return held


def refused(done: Outcome, code: int, message: str, hint: str = "") -> None:
    assert (done.code, done.out) == (code, "")
    assert message in done.err
    assert hint in done.err


# -- the roster --------------------------------------------------------------------------------------------------------


def test_a_roster_that_another_command_changed_meanwhile_is_not_signed(
    home: Path, roster: Roster, monkeypatch: pytest.MonkeyPatch
) -> None:
    stale = replace(roster, version=3, previous="ab" * 32, expires=roster.expires + timedelta(days=1))
    monkeypatch.setattr(plant.owner, "renewed", lambda *_, **__: stale)
    monkeypatch.setattr(plant.owner, "same_end", lambda _held, draft: draft)
    refused(
        call(home, "registry", "renew", "--yes"), 6, "Another command changed the roster in the meantime.",
        "Run this again.",
    )  # fmt: skip
    with Station.inspect(home) as station:
        assert station.plant.roster == roster


def test_a_roster_of_a_wrong_clock_is_warned_of_wherever_it_is_shown(
    home: Path, roster: Roster, monkeypatch: pytest.MonkeyPatch
) -> None:
    def warning(version: int, created: Any) -> str:
        return (
            f"Warning: Roster {version} is dated {local_time(created.isoformat())}, in the future by this machine's"
            " clock. Set the clock; if it is right, no other station takes this roster: registry renew --redate\n"
        )

    assert "in the future" not in call(home, "registry", "status").err
    monkeypatch.setattr(plant.owner, "is_ahead", lambda _: True)
    assert call(home, "registry", "status").err == warning(2, roster.created)
    draft = replace(roster, version=3, created=roster.created + timedelta(days=3))
    monkeypatch.setattr(plant.owner, "renewed", lambda *_, **__: draft)
    monkeypatch.setattr(plant.owner, "same_end", lambda _held, draft: draft)
    assert warning(3, draft.created) in call(home, "registry", "renew", "--dry-run").err


def test_only_a_roster_of_a_wrong_date_is_dated_again(
    home: Path, roster: Roster, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = list[tuple[str, object]]()
    draft = replace(roster, version=3, name="renamed")
    monkeypatch.setattr(plant.owner, "renewed", lambda _s, days, *, redate: asked.append(("renewed", redate)) or draft)

    def same_end(_held: Roster, made: Roster) -> Roster:
        asked.append(("same end", made.version))
        return made

    monkeypatch.setattr(plant.owner, "same_end", same_end)
    monkeypatch.setattr(plant.owner, "require_wrong_date", lambda _s, held: asked.append(("wrong date", held.version)))
    call(home, "registry", "renew", "--redate", "--dry-run")
    assert asked == [("wrong date", 2), ("renewed", True)]
    asked.clear()
    call(home, "registry", "renew", "--dry-run")
    assert asked == [("renewed", False), ("same end", 3)]


def test_a_draft_is_shown_before_it_is_signed(home: Path, tmp_path: Path) -> None:
    draft, out = tmp_path / "roster.draft", tmp_path / "roster.jws"
    assert call(home, "registry", "remove", "west", "--retired", "--draft", draft).code == 0
    planned = call(home, "registry", "sign", draft, "--output", out, "--dry-run")
    assert planned.out.startswith("Plan:\n")
    assert "west" in planned.out
    shown = call(home, "--json", "registry", "sign", draft, "--output", out, "--dry-run").json
    assert (shown["plan"], shown["version"], [left["name"] for left in shown["removed"]]) == (True, 3, ["west"])
    assert not out.exists()
    assert call(home, "registry", "sign", draft, "--output", out).code == 6, "nobody is there to confirm"
    assert not out.exists()


def test_all_of_a_draft_of_another_registry_is_shown_and_it_is_not_taken_here(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    draft, compared = tmp_path / "roster.draft", list[Any]()
    assert call(home, "registry", "remove", "west", "--retired", "--draft", draft).code == 0
    changes = plant.owner.changes
    monkeypatch.setattr(plant.owner, "changes", lambda before, after: compared.append(before) or changes(before, after))
    for registry, same in ((None, True), (lambda made: replace(made, registry=str(UUID(int=7))), False)):
        read = plant.owner.read_draft
        if registry is not None:
            monkeypatch.setattr(plant.owner, "read_draft", lambda *words, read=read: registry(read(*words)))  # noqa: B023
        call(home, "registry", "sign", draft, "--output", tmp_path / "o", "--dry-run")
        assert (compared.pop() is not None) is same


def test_the_log_of_the_plant_shows_what_is_zero_or_false() -> None:
    event = {"act": "grouped", "at": "x", "id": "y", "group": "hand", "member": False, "n": 0, "why": None, "text": ""}
    assert commands._members(event) == "group=hand member=False n=0 text="


def test_who_is_not_in_the_roster_is_named_with_the_way_to_see_who_is(home: Path, tmp_path: Path) -> None:
    status = "See: teds-provision registry status"
    refused(call(home, "registry", "log", "--station", "nobody"), 3, "'nobody' is not in the roster.", status)
    refused(call(home, "registry", "sql", "--close", "nobody"), 3, "'nobody' is not in the roster.", status)
    refused(
        call(home, "registry", "sync"), 3, "This station does not know how to reach the registry.",
        "Name a folder: registry sync --files DIR",
    )  # fmt: skip


def test_a_request_of_a_station_that_is_not_in_the_roster_gets_its_login_and_a_warning(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = tmp_path / "a request"
    request.write_bytes(b"{}")
    asked = SimpleNamespace(name="south", fingerprint="cd" * 32, login=("verifier", "key"))
    left = SimpleNamespace(name="south", why="stolen")
    monkeypatch.setattr(commands.document, "open_request", lambda _: asked)
    with monkeypatch.context() as patch:
        patch.setattr(
            plant.apply_pages, "require_roster",
            lambda _: SimpleNamespace(name="plant", removed_one=lambda digits: left if digits == "cd" * 32 else None),
        )  # fmt: skip
        refused(
            call(home, "registry", "sql", "--member", request), 6,
            "south was removed from plant (stolen); its login stays closed.",
            "A removed key cannot return: create a new station (init), and add that one.",
        )  # fmt: skip
    monkeypatch.setattr(plant.schema, "member_sql", lambda digits, login: f"-- {digits[:4]} {login[0]}\n")
    done = call(home, "registry", "sql", "--member", request)
    assert (done.code, done.out) == (0, "-- cdcd verifier\n")
    assert done.err == (f"Warning: south is not in the roster yet. To add it: registry add '{request}' --role ROLE\n")
    asked.fingerprint = fingerprint(WEST.point)
    done = call(home, "registry", "sql", "--member", request)
    assert (done.out[:7], done.err) == (f"-- {fingerprint(WEST.point)[:4]}", "")


def test_a_keeper_sees_what_it_vouches_for_and_is_asked(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = [(bytes.fromhex(NODE), "ab" * 32, "0123456789abcdef")]
    vouched = list[object]()
    monkeypatch.setattr(plant.membership, "vouchable", lambda _station, uuids: [] if uuids == [] else found)
    monkeypatch.setattr(plant.membership, "vouch", lambda _station, which: vouched.append(which) or len(which))
    line = f"  {NODE}  signed by 0123456789abcdef"
    planned = call(home, "registry", "vouch", "--all", "--dry-run")
    assert planned.out == f"Plan: vouch for these datasheets:\n{line}\n"
    nodes = [{"uuid": NODE, "teds_sha256": "ab" * 32}]
    assert call(home, "--json", "registry", "vouch", "--all", "--dry-run").json == {
        "nodes": nodes, "done": 0, "plan": True
    }  # fmt: skip
    assert call(home, "registry", "vouch", "--all").code == 6, "nobody answers the question"
    assert vouched == []
    done = call(home, "registry", "vouch", NODE, "--yes")
    assert done.err == f"Datasheets that are authentic here but not in the plant:\n{line}\n"
    assert done.out == "Vouched for 1 datasheet. To tell the others: registry sync\n"
    assert call(home, "--json", "registry", "vouch", NODE, "--yes").json == {"nodes": nodes, "done": 1}
    found.clear()
    none = call(home, "registry", "vouch", "--all", "--yes")
    assert none.out == "Nothing to do: no datasheet needs a keeper's word.\n"
    assert call(home, "registry", "vouch", "--all", "--dry-run").out == "Plan: vouch for these datasheets:\n  none\n"
    assert len(vouched) == 2


def test_a_database_is_joined_if_it_is_of_the_rosters_registry(
    home: Path, roster: Roster, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened, closed = list[str](), list[bool]()
    transport = SimpleNamespace(registry=lambda: REGISTRY, where="office", close=lambda: closed.append(True))
    monkeypatch.setattr(plant.connecting, "database", lambda _station, url: opened.append(url) or transport)
    monkeypatch.setattr(plant.membership, "found_roster", lambda _station, given, octets: roster)
    monkeypatch.chdir(tmp_path)
    url = "postgresql://office/plant?sslrootcert=office.crt&application_name=a%20b"
    absolute = f"postgresql://office/plant?sslrootcert={str(tmp_path).replace('/', '%2F')}%2Foffice.crt"
    planned = call(home, "--json", "registry", "connect", url, "--dry-run")
    assert planned.json == {"registry": REGISTRY, "version": 2, "events": 0, "plan": True}
    assert [one.partition("&")[0] for one in opened] == [absolute]
    assert call(home, "registry", "connect", url).code == 0
    with Station.inspect(home) as station:
        assert station.plant.joined is not None
        assert (station.plant.joined.url or "").startswith(absolute)
    assert closed == [True]
    transport.registry = lambda: "11111111-2222-4333-8444-555555555555"
    refused(
        call(home, "registry", "connect", url), 6,
        f"office belongs to another registry (11111111-2222-4333-8444-555555555555) than the roster ({REGISTRY}).",
    )  # fmt: skip


@pytest.mark.parametrize(
    ("url", "query"),
    [
        ("postgresql://h/d", ""),
        ("postgresql://h/d?sslrootcert=system", "?sslrootcert=system"),
        ("postgresql://h/d?sslrootcert=/etc/x.crt", "?sslrootcert=%2Fetc%2Fx.crt"),
        ("postgresql://h/d?sslrootcert=x.crt&a=&b=c%20d", "?sslrootcert=%2Fhome%2Fme%2Fx.crt&a=&b=c%20d"),
    ],
)
def test_a_root_certificate_is_found_from_any_folder(url: str, query: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "absolute", lambda path: path if path.is_absolute() else Path("/home/me") / path)
    assert plant.connecting.absolute(url) == f"postgresql://h/d{query}"


def test_pages_to_choose_the_last_one_from_are_shown_unless_it_is_given_or_retired(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pages = [(12, "ab" * 32, "2026-03-01T12:00:00Z"), (9, "cd" * 32, "2026-03-01T11:00:00Z")]
    monkeypatch.setattr(plant.status, "page_list", lambda _station, digits: pages if digits == WEST_DIGITS else [])
    listed = (
        f"The newest pages of west:\n      12  {local_time('2026-03-01T12:00:00Z')}  {'ab' * 8}\n"
        f"       9  {local_time('2026-03-01T11:00:00Z')}  {'cd' * 8}\n"
    )
    for why in ("--lost", "--stolen"):
        asked = call(home, "registry", "remove", "west", why, "--dry-run")
        assert (asked.code, asked.err.startswith(listed)) == (2, True)
    for words in (("--lost", "--last", "0"), ("--retired",)):
        assert "newest pages" not in call(home, "registry", "remove", "west", *words, "--dry-run").err
    pages.clear()
    assert "The newest pages of west:\n  none\n" in call(home, "registry", "remove", "west", "--lost").err


def test_what_others_are_to_read_is_open_to_them(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A roster, a request and evidence are handed on: their files have what the umask leaves, no mode of a secret."""
    (tmp_path / "stick").mkdir()
    umask, made = os.umask(0o022), tmp_path / "made"
    try:
        with make_station(made, "first"):
            pass
        for where, *words in (
            (made, "registry", "create", "--name", "plant", "--output", "created.jws", "--yes"),
            (made, "registry", "request", "--output", "a.request"),
            (home, "registry", "renew", "--days", 100, "--output", "renewed.jws", "--yes"),
            (home, "registry", "role", "west", "base", "--draft", "roles.draft"),
            (home, "registry", "sign", "roles.draft", "--output", "signed.jws", "--yes"),
        ):
            monkeypatch.chdir(tmp_path)
            assert call(where, *words).code == 0, words
        plant.sign_requests.FileOffice(tmp_path / "sign.request").request_signature(
            cast("Any", SimpleNamespace(octets=b""))
        )
        plant.evidence._new_file(tmp_path, NODE, 1, set(), b"evidence")
        plant.folder_transport.FolderTransport(tmp_path / "stick").post_roster(7, "ab" * 32, b"roster")
    finally:
        os.umask(umask)
    modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.iterdir() if path.is_file()}
    assert modes == dict.fromkeys(
        ["created.jws", "a.request", "renewed.jws", "roles.draft", "signed.jws", "sign.request", f"{NODE}.1.json"],
        0o644,
    )
    assert {path.stat().st_mode & 0o777 for path in (tmp_path / "stick").rglob("*") if path.is_file()} == {0o644}


def test_a_plan_of_an_export_writes_no_evidence(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    written = list[bool]()

    def export(_station: Station, _rows: object, folder: Path, *, write: bool) -> dict[Path, bool]:
        written.append(write)
        return {folder / "one": True, folder / "two": False, folder / "three": True}

    monkeypatch.setattr(plant.evidence, "export", export)
    words, counts = ("evidence", "export", tmp_path), {"folder": str(tmp_path), "files": 3, "written": 2}
    assert call(home, *words, "--dry-run").out == f"Would write 2 of 3 files to {tmp_path}.\n"
    assert call(home, *words).out == f"Wrote 2 of 3 files to {tmp_path}.\n"
    assert [call(home, "--json", *words, *more).json for more in ([], ["--dry-run"])] == [counts] * 2
    assert written == [False, True, True, False]


def test_what_a_station_will_publish_is_counted_by_act_or_is_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant.backlog, "count", lambda past: dict.fromkeys(past, len(past)))
    says = "  it will publish what this store knows: "
    assert commands._past(["signed", "agreed"]) == f"{says}2 agreed, 2 signed"
    assert commands._past([]) == f"{says}nothing"


def test_a_folder_is_the_one_that_was_joined_by_whatever_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "stick").mkdir()
    (tmp_path / "other").mkdir()
    monkeypatch.chdir(tmp_path)
    joined = [SimpleNamespace(where=str((tmp_path / "stick").resolve()))]
    monkeypatch.setattr(plant.connecting, "open_transport", lambda _: joined[0])
    station = cast("Any", None)
    for path, connected in (("stick", True), ("other/../stick", True), (tmp_path / "stick", True), ("other", False)):
        transport, same = commands._transport(station, Path(path))
        assert (transport.where, same) == (str(Path(path)), connected)
    assert commands._transport(station, None) == (joined[0], True)
    joined[0] = cast("Any", None)
    assert commands._transport(station, Path("stick"))[1] is False


def test_an_office_that_is_silent_is_an_error_unless_its_request_went_into_a_file(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    orders = list[Any]()
    image = SimpleNamespace(uuid=bytes.fromhex(NODE))
    silent = [True]

    def sign_by_office(_station: Station, _links: object, order: Any, _reporter: object) -> Any:
        orders.append(order)
        if silent[0]:
            raise plant.sign_requests.OfficeSilentError("It has not answered yet.", hint="The request is kept.")
        return SimpleNamespace(image=image, sequence=7, reused=True)

    monkeypatch.setattr(plant.sign_requests, "sign_by_office", sign_by_office)
    request = tmp_path / "a.request"
    words = ("sign", NODE, "--by", "office", "--job", "0b5f")
    refused(call(home, *words), 5, "It has not answered yet.", "The request is kept.")
    assert call(home, *words, "--output", request).out == f"Wrote the request to {request}. The request is kept.\n"
    assert call(home, "--json", *words, "--output", request).json == {"request": str(request)}
    assert [(order.node, order.by, order.job, order.output) for order in orders] == [
        (NODE, "office", "0b5f", None), *[(NODE, "office", "0b5f", request)] * 2
    ]  # fmt: skip
    silent[0] = False
    assert call(home, *words).out == (f"office signed {NODE}, sequence 7. Write it: teds-provision write {NODE}\n")
    assert call(home, "--json", *words).json == {"uuid": NODE, "sequence": 7, "signed_by": "office", "reused": True}


def test_who_resumes_is_warned_of_a_copy_and_asked(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    resumed = list[bool]()
    monkeypatch.setattr(plant.sync, "resume", lambda *_: resumed.append(True) or 2)
    monkeypatch.setattr(plant.sync, "unknown_pages", lambda *_: ["page"])
    words = ("registry", "resume", "--files", tmp_path)
    assert call(home, *words, "--dry-run").out == "Plan: 1 page would be adopted.\n"
    assert call(home, "--json", *words, "--dry-run").json == {"done": 0, "adopts": 1, "plan": True}
    warning = "If a copy of this home is in use elsewhere, stop it first. If in doubt, have this station removed.\n"
    asked = call(home, *words)
    assert (asked.code, asked.err.startswith(warning), resumed) == (6, True, [])
    done = call(home, *words, "--yes")
    assert (done.out, done.err) == ("Adopted: 2 pages. Next: teds-provision registry sync\n", warning)
    assert call(home, "--json", *words, "--yes").json == {"done": 2}


def test_a_history_is_accepted_while_no_sync_runs(home: Path, roster: Roster, monkeypatch: pytest.MonkeyPatch) -> None:
    done, west, branch = list[str](), roster.named("west"), (7, "ab" * 32)
    assert west is not None

    @contextmanager
    def sync_lock(_station: Station) -> Iterator[None]:
        done.append("lock")
        yield
        done.append("unlock")

    def step(name: str) -> Callable[..., tuple[int, str]]:
        def run(_station: Station, *given: object) -> tuple[int, str]:
            assert given in ((), (west.fingerprint, "ab" * 4, None)), "this member, by the hash that was given"
            done.append(name)
            return branch

        return run

    monkeypatch.setattr(plant.sync, "sync_lock", sync_lock)
    monkeypatch.setattr(plant.connecting, "open_transport", lambda _: None)
    for module, name in (
        (plant.membership, "branch"),
        (plant.membership, "accept"),
        (plant.apply_pages, "apply_claims"),
    ):
        monkeypatch.setattr(module, name, step(name))
    words = ("registry", "accept", "west", "--page", "ab" * 4)
    shown = {"n": 7, "hash": "ab" * 32}
    assert call(home, *words, "--dry-run").out == f"Plan: page 7 ({'ab' * 8}) would be accepted here.\n"
    assert call(home, "--json", *words, "--dry-run").json == {"done": 0, **shown, "plan": True}
    assert call(home, *words).code == 6, "nobody is there to confirm"
    assert done == ["branch"] * 2
    assert call(home, *words, "--yes").out == f"Page 7 ({'ab' * 8}) and its successors count here.\n"
    assert done[2:] == ["lock", "accept", "apply_claims", "unlock"]
    assert call(home, "--json", *words, "--yes").json == {"done": 1, **shown}


# -- keys as parcels ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("export-keys", "--to", "west", NODE), "Give one of --output FILE and --send."),
        (("export-keys", "--to", "west", "--all"), "Give one of --output FILE and --send."),
        (
            ("export-keys", "--to", "west", "--to", "o", "--all", "--send"),
            "A parcel is for one station: give --to once.",
        ),
        (("export-keys", "--to", "west", NODE, "--send", "--output", "x"), "Give one of --output FILE and --send."),
        (("export-keys", "--to", "west", "--to", "o", NODE, "--send"), "A parcel is for one station: give --to once."),
        (("import-keys",), "Give one of FILE and --received."),
        (("import-keys", "--received", "x.jwe"), "Give one of FILE and --received."),
        (("demo", "--page", "--plant"), "Give one of --page, --plant and --line."),
        (("demo", "--plant", "--line"), "Give one of --page, --plant and --line."),
        (("demo", "--page", "--line"), "Give one of --page, --plant and --line."),
    ],
)
def test_a_way_is_named_once(home: Path, words: tuple[str, ...], message: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_demo.signal, "signal", lambda *_: None)
    done = call(home, *words)
    assert (done.code, done.out) == (2, "")
    assert message in done.err


@pytest.mark.parametrize("story", ["--plant", "--line"])
def test_a_story_has_no_address_to_serve_on(home: Path, story: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_demo.signal, "signal", lambda *_: None)
    for module, name in ((plant.demo.plant, "run_plant_demo"), (plant.demo.line, "run_line")):
        monkeypatch.setattr(module, name, lambda *_: pytest.fail("it was played"))
    refused(
        call(home, "demo", story, "--http", "127.0.0.1:1"), 2, "--http requires --page.",
        "Run: teds-provision demo --page --http 127.0.0.1:8351",
    )  # fmt: skip


def test_a_copy_is_sent_under_a_roster_that_holds_and_a_move_whenever(
    home: Path, roster: Roster, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Station.inspect(home) as station:
        for after, refuses in ((-timedelta(seconds=1), False), (timedelta(0), True), (timedelta(days=1), True)):
            monkeypatch.setattr(plant.jobs, "now_of", lambda held, after=after: held.expires + after)
            ParcelCarrier("move").require(station)
            if not refuses:
                ParcelCarrier("copy").require(station)
                continue
            with pytest.raises(RosterExpiredError) as error:
                ParcelCarrier("copy").require(station)
            assert (error.value.message, error.value.hint) == (
                f"The roster expired on {roster.expires:%Y-%m-%d}, so no copy of keys is sent.",
                "Ask its owner to renew it: registry renew. Or hand over a file: --output FILE",
            )


def test_each_bundle_is_a_parcel_for_the_next_sync(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plant.parcels, "send_export", lambda _station, plan, _now: f"parcel of {plan}")
    sent = ParcelCarrier("copy").send(cast("Any", None), cast("Any", ["one", "two"]))
    assert sent == ({"parcels": ["parcel of one", "parcel of two"]}, "the next registry sync")


# -- demo --------------------------------------------------------------------------------------------------------------


def test_the_demo_plays_the_story_that_is_asked_for(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = [SimpleNamespace(name="sync", result="done", seconds=0.5)]
    plants = SimpleNamespace(steps=steps, by="files", before="authentic", after="not authentic", seconds=12.4)
    lines = SimpleNamespace(steps=steps, passed=3, evidence={"passed": 4, "failed": 1}, refused=("wrong-board",))
    handlers = list[object]()
    monkeypatch.setattr(of_demo.signal, "signal", lambda number, handler: handlers.append((number, handler)))

    def played(done: object) -> Callable[..., object]:
        def play(_reporter: object, say: Callable[[str], object]) -> object:
            say("a chapter")
            return done

        return play

    monkeypatch.setattr(plant.demo.plant, "run_plant_demo", played(plants))
    monkeypatch.setattr(plant.demo.line, "run_line", played(lines))
    shown = call(home, "demo", "--plant")
    assert (shown.code, shown.err) == (0, "\na chapter\n")
    assert shown.out == (
        "\nDone in 12 s: the board was authentic at south; with what the stolen station signed, it is not authentic.\n"
        "Your own plant: docs/plant.md\n"
    )
    rows = [{"name": "sync", "result": "done", "seconds": 0.5}]
    assert call(home, "--json", "demo", "--plant").json == {
        "steps": rows, "by": "files", "before": "authentic", "after": "not authentic", "seconds": 12.4
    }  # fmt: skip
    assert call(home, "demo", "--line").out == (
        "\nDone: 3 boards passed, refused: wrong-board; evidence that holds: 1 failed, 4 passed.\n"
    )
    assert call(home, "--json", "demo", "--line").json == {
        "steps": rows, "passed": 3, "evidence": {"passed": 4, "failed": 1}, "refused": ["wrong-board"]
    }  # fmt: skip
    assert handlers == [(signal.SIGTERM, signal.default_int_handler)] * 4


# -- the line ----------------------------------------------------------------------------------------------------------

JOB = "0b5f0000-1111-4222-8333-444444444444"


@pytest.fixture
def job(monkeypatch: pytest.MonkeyPatch) -> Any:
    found = SimpleNamespace(id=JOB, title="cells", total=50, profile="load-cell", ends=None)
    monkeypatch.setattr(plant.jobs, "find_job", lambda _station, text: found if JOB.startswith(text) else None)
    monkeypatch.setattr(of_line, "_to_json", lambda _station, job: {"id": job.id})
    monkeypatch.setattr(of_line, "_sentence", lambda job: f"“{job.title}”.")
    return found


def test_a_job_is_sent_to_its_stations_and_office(home: Path, job: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    to, sent, closed = [fingerprint(WEST.point), "ab" * 32], list[object](), list[bool]()
    transport = SimpleNamespace(close=lambda: closed.append(True))
    monkeypatch.setattr(plant.sign_requests, "receivers", lambda _station, _job: to)
    monkeypatch.setattr(plant.sign_requests, "transport_for", lambda _station, files: sent.append(files) or transport)
    monkeypatch.setattr(plant.sign_requests, "send_job", lambda _station, by, job: sent.append((by, job.id)))
    planned = call(home, "job", "send", "0b5f", "--dry-run")
    assert planned.out == f"Would send 0b5f0000 to west, {'ab' * 8}.\n"
    assert sent == []
    done = call(home, "job", "send", "0b5f", "--files", home)
    assert done.out == f"Sent 0b5f0000 to west, {'ab' * 8}.\n"
    assert (sent, closed) == ([home, (transport, JOB)], [True])
    assert call(home, "--json", "job", "send", "0b5f", "--files", home).json == {"id": JOB, "to": to}
    to.clear()
    alone_here = call(home, "job", "send", "0b5f", "--dry-run")
    assert alone_here.out == "0b5f0000 is for this station alone: nothing to send.\n"


def test_a_job_is_closed_unless_it_is_a_plan(home: Path, job: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = list[str]()
    monkeypatch.setattr(plant.jobs, "close_job", lambda _station, job: closed.append(job.id))
    assert call(home, "job", "close", "0b5f", "--dry-run").out == "Would close “cells”.\n"
    assert closed == []
    assert call(home, "job", "close", "0b5f").out == "Closed “cells”.\n"
    assert closed == [JOB]


def answered(*, refused: str = "", by: str | None = None) -> Any:
    request = SimpleNamespace(uuid=bytes.fromhex(NODE), job=JOB, signer=by or fingerprint(WEST.point))
    answer = SimpleNamespace(refused=refused, why="the unit is full" if refused else "", sequence=7, security=b"teds")
    return SimpleNamespace(request=request, answer=answer)


def test_an_office_signs_for_so_many_seconds_and_prints_a_line_each(
    home: Path, job: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Out of reach, it waits twice as long each time, half a minute at most, and starts over."""
    tries, waits, timers = list[set[str]](), list[float](), list[Any]()
    inbox = SimpleNamespace(start_over=lambda: waits.append(-1), wait=lambda most, _look: timers[0][1]())
    transport = SimpleNamespace(where="the folder", close=lambda: None)
    monkeypatch.setattr(of_line, "_office_inbox", lambda *_: (None, transport, inbox))
    monkeypatch.setattr(plant.connecting, "place_of", lambda _: None)
    monkeypatch.setattr(of_line.signal, "signal", lambda *_: None)
    monkeypatch.setattr(
        of_line.threading, "Timer",
        lambda seconds, stop: SimpleNamespace(start=lambda: timers.append((seconds, stop))),
    )  # fmt: skip

    class Stop:
        def __init__(self, idle: object) -> None:
            assert idle is None
            self.stopped = False

        def set(self) -> None:
            self.stopped = True

        def is_set(self) -> bool:
            return self.stopped

        def wait(self, seconds: float) -> None:
            waits.append(seconds)

        def request_stop(self) -> None:
            self.stopped = True

    monkeypatch.setattr(provisioning.meeting, "IdleStop", Stop)

    def answers(_station: Any, _transport: Any, _inbox: Any, jobs: set[str], *, stop: Any) -> Iterator[Any]:
        tries.append(jobs)
        if len(tries) <= 7:
            raise LinkError("The folder is gone.")
        assert not stop()
        yield from (answered(), answered(refused="full"), answered(by="ab" * 32))

    monkeypatch.setattr(plant.office, "answer_all", answers)
    done = call(home, "signer", "run", "--job", "0b5f", "--job", JOB, "--for", "2.5")
    assert done.code == 0
    assert [seconds for seconds, _ in timers] == [2.5]
    assert [one for one in waits if one >= 0] == [1, 2, 4, 8, 16, 30, 30]
    assert waits.count(-1) == 7
    assert done.err.splitlines() == [
        "Signing for 1 job; Ctrl-C ends it.",
        "Warning: The folder is gone. Requests wait; trying again until Ctrl-C.",
        "Warning: the folder can be used again; signing continues.",
    ]
    assert done.out.splitlines() == [
        f"signed   {NODE}  7  west", f"refused  {NODE}  full  west: the unit is full", f"signed   {NODE}  7  {'ab' * 8}"
    ]  # fmt: skip
    assert tries == [{JOB}] * 8
    tries[:] = [set()] * 7
    timers.clear()
    lines = call(home, "--json", "signer", "run", "--job", "0b5f", "--for", "1").out.splitlines()
    west = {"uuid": NODE, "job": JOB, "from": fingerprint(WEST.point)}
    assert [json.loads(line) for line in lines] == [
        {**west, "sequence": 7}, {**west, "refused": "full", "why": "the unit is full"},
        {**west, "from": "ab" * 32, "sequence": 7},
    ]  # fmt: skip
    tries[:] = [set()] * 7
    timers.clear()
    assert call(home, "signer", "run", "--job", "0b5f", "--for", "0").code == 0
    assert [seconds for seconds, _ in timers] == [0], "no time is none: what waits is answered, and it ends"


@pytest.mark.parametrize("by_folder", [True, False])
def test_an_office_follows_its_registry_and_no_folder_and_ends_at_sigterm(
    home: Path, job: Any, monkeypatch: pytest.MonkeyPatch, by_folder: bool
) -> None:
    places, opened, closed, handlers = iter(["one", "two", "two"]), list[Any](), list[str](), dict[int, Any]()
    waits, unlocked, timers = list[tuple[float, float]](), list[bool](), list[object]()

    def wait(most: float, look: float) -> None:
        waits.append((most, look))
        if len(waits) == 3:
            handlers[signal.SIGTERM](signal.SIGTERM, None)

    def office_inbox(_station: Any, files: Path | None, stack: Any) -> Any:
        opened.append(files)
        place = ("one", "two")[len(opened) - 1]
        stack.callback(closed.append, place)
        return place, SimpleNamespace(where=place), SimpleNamespace(wait=wait)

    used = list[str]()

    def answers(_station: Any, transport: Any, _inbox: Any, _jobs: Any, *, stop: Any) -> Iterator[Any]:
        used.append(transport.where)
        return iter(())

    unlock = Station.unlock
    monkeypatch.setattr(Station, "unlock", lambda station: unlocked.append(True) or unlock(station))
    monkeypatch.setattr(of_line, "_office_inbox", office_inbox)
    monkeypatch.setattr(plant.connecting, "place_of", lambda _: next(places))
    monkeypatch.setattr(plant.office, "answer_all", answers)
    monkeypatch.setattr(of_line.signal, "signal", lambda number, handler: handlers.update({number: handler}))
    monkeypatch.setattr(of_line.threading, "Timer", lambda *given: timers.append(given))
    done = call(home, "signer", "run", "--job", "0b5f", *(("--files", home) if by_folder else ()))
    assert (done.code, done.out, done.err) == (0, "", "Signing for 1 job; Ctrl-C ends it.\n")
    assert (opened, used) == (([home], ["one"] * 3) if by_folder else ([None] * 2, ["one", "two", "two"]))
    assert closed == (["one"] if by_folder else ["one", "two"])
    assert (waits, timers) == ([(1.0, 0.2)] * 3, [])
    assert len(unlocked) >= 4, "before the first one and at each turn: the passphrase may be another one by then"


def test_an_office_answers_one_file_with_an_answer_or_a_signed_image(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = tmp_path / "request.jws"
    request.write_bytes(b" request \n")
    given, jumps = list[Any](), list[bool]()

    def answer(_station: Any, octets: bytes, *, jump: bool) -> bytes | None:
        assert octets == b"request"
        jumps.append(jump)
        return b"sealed" if given else None

    monkeypatch.setattr(plant.office, "answer", answer)
    monkeypatch.setattr(of_line.signing, "open_answer", lambda *_: given[0].answer)
    image = SimpleNamespace(with_block=lambda block, octets: SimpleNamespace(to_json=lambda: f"{octets!r}"))
    monkeypatch.setattr(
        of_line.signing, "open_request", lambda *_: SimpleNamespace(**vars(given[0].request), image=image)
    )
    out, whole = tmp_path / "answer.jws", tmp_path / "signed.json"
    refused(
        call(home, "signer", "once", request, "--output", out), 4,
        f"{request} is not a request from a member of this plant to this office.",
        "To create one: teds-provision sign UUID --by OFFICE --output FILE",
    )  # fmt: skip
    given.append(answered())
    done = call(home, "signer", "once", request, "--output", out, "--jump")
    assert (done.out, out.read_text()) == (f"signed   {NODE}  7  west\n", "sealed")
    assert call(home, "signer", "once", request, "--output", whole).out == f"signed   {NODE}  7  west\n"
    assert whole.read_text() == "b'teds'"
    assert jumps == [False, True, False]
    given[0] = answered(refused="full")
    given[0].answer.security = b""
    for name in ("refused.jws", "refused.json"):
        refused(
            call(home, "signer", "once", request, "--output", tmp_path / name), 6,
            "Not signed (full): the unit is full.",
        )  # fmt: skip
    assert (tmp_path / "refused.jws").read_text() == "sealed", "the line is told"
    assert not (tmp_path / "refused.json").exists()
