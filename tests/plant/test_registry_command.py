"""``registry`` as its keepers use it: three stations and a stick between them.

They join as users do, each command a process; after that a command is a call in this process.
"""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest

from teds_provision import plant
from teds_provision.station.plant.pages import PageRow
from teds_provision.station.station import Station
from teds_provision.station.store.records import Holder
from tests.bench import PASSPHRASE
from tests.cli.shell import Outcome, call, spawn
from tests.plant.stations import ask, certified, owner

UUID = "8d4d9da65281f7000000"
KEY = "ab" * 32


class Desk:
    """Homes of stations under one owner, and a stick."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.stick = folder, folder / "stick"
        self.forks = False

    def lay_out(self) -> None:
        """Make the stick and three stations that have joined nothing."""
        self.stick.mkdir(parents=True)
        north = owner(self.folder / "north")
        for name in ("south", "west"):
            certified(self.folder / name, name, north).close()
        north.close()

    def run(self, station: str, *words: object) -> Outcome:
        if self.forks:
            return spawn("--home", self.folder / station, *words, passphrase=PASSPHRASE)
        return call(self.folder / station, *words)

    def ask(self, station: str, *words: object, code: int = 0) -> dict[str, object]:
        done = self.run(station, "--json", *words)
        assert done.code == code, (done.code, done.out, done.err)
        answer: dict[str, object] = json.loads(done.out)
        return answer

    def sync(self, *stations: str, code: int = 0) -> dict[str, object]:
        return [self.ask(station, "registry", "sync", "--files", self.stick, code=code) for station in stations][-1]


@pytest.fixture(scope="module")
def as_made(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    """Return a desk as it is laid out, and beside it as it is when all have joined: what each test gets a copy of.

    A station keeps the path of its stick, so that each copy is put into the same folder.
    """
    place = tmp_path_factory.mktemp("desks") / "desk"
    made = Desk(place)
    made.lay_out()
    shutil.copytree(place, place.with_name("laid out"))
    made.forks = True
    join_all(made)
    made.forks = False
    shutil.copytree(place, place.with_name("joined"))
    return made


def put(made: Desk, state: str) -> None:
    """Put the desk back into a state that was kept of it."""
    shutil.rmtree(made.folder)
    shutil.copytree(made.folder.with_name(state), made.folder)


@pytest.fixture
def desk(as_made: Desk) -> Desk:
    put(as_made, "laid out")
    return as_made


def joined(desk: Desk) -> None:
    put(desk, "joined")


def join_all(desk: Desk) -> None:
    made = desk.ask("north", "registry", "create", "--name", "plant Augsburg", "--yes")
    assert made["version"] == 1
    for name, roles in (("south", ["base"]), ("west", ["line", "sign"])):
        asked = desk.folder / f"{name}.request"
        reply = desk.ask(name, "registry", "request", "--output", asked)
        assert str(reply["role"]) == f"teds_{str(reply['fingerprint'])[:16]}"
        words = [word for role in roles for word in ("--role", role)]
        desk.ask("north", "registry", "add", asked, *words, "--yes")
    desk.ask("north", "registry", "connect", "--files", desk.stick, "--yes")
    desk.sync("north")
    for name in ("south", "west"):
        assert desk.ask(name, "registry", "connect", "--files", desk.stick, "--yes")["version"] == 3


def test_three_stations_join_and_see_the_same(desk: Desk) -> None:
    joined(desk)
    desk.ask("north", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.sync("north", "south", "west", "north", "south", "west")
    seen = [desk.ask(name, "registry", "status") for name in ("north", "south", "west")]
    assert len({json.dumps(entry["heads"]) for entry in seen}) == 1
    assert {entry["roster"] for entry in seen} == {3}
    listed = desk.ask("south", "whitelist", "list")["whitelist"]
    assert isinstance(listed, list)
    assert [(item["uuid"], item["assurance"]) for item in listed] == [(UUID, "registry")]
    events = desk.ask("west", "registry", "log", UUID)["events"]
    assert isinstance(events, list)
    assert [(event["act"], event["station"]) for event in events] == [("pinned", "north")]
    (node,) = desk.ask("west", "nodes", "--plant")["nodes"]  # type: ignore[misc]
    assert node["uuid"] == UUID
    assert node["says"]["pinned_by"] == {"north": KEY}
    assert node["conflicts"] == []
    assert (node["says"]["firmware"], node["says"]["firmware_by"]) == (None, {})
    assert f"{UUID}  no holder, firmware not reported" in desk.run("west", "nodes", "--plant", "8d4d").out
    assert desk.run("west", "registry", "log").out.count("pinned") == 1
    shown = desk.run("west", "registry", "status")
    assert "plant Augsburg" in shown.out
    assert "here" in shown.out


def holds_what_west_had(desk: Desk) -> None:
    """North has a link key that it gave to west."""
    station = Station.open(desk.folder / "north", ask=ask)
    station.keys.add_pending(bytes.fromhex(UUID), key=bytes(16), key_id=bytes(8), epoch=1)
    west = station.plant.roster.named("west")  # type: ignore[union-attr]
    assert west is not None
    station.keys.put_holder(Holder(bytes.fromhex(UUID), west.fingerprint))
    station.close()


def test_a_removed_station_is_told_so_and_the_others_go_on(desk: Desk) -> None:
    joined(desk)
    desk.ask("west", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.sync("west", "north")
    refused = desk.run("north", "registry", "remove", "west", "--stolen", "--yes")
    assert refused.code == 2
    assert "--last" in refused.err
    holds_what_west_had(desk)
    desk.ask("north", "registry", "remove", "west", "--stolen", "--last", 1, "--yes")
    assert desk.ask("north", "registry", "status")["to_rotate"] == 1, "at once, before any sync"
    desk.sync("north")
    reply = desk.ask("west", "registry", "sync", "--files", desk.stick, code=6)
    assert reply["error"]["code"] == "not-member"  # type: ignore[index]
    assert desk.ask("west", "registry", "status", code=6)["members"]
    desk.sync("south")
    refused = desk.run("south", "trust", "remove", "north", "--yes")
    assert refused.code == 6


def test_members_are_trusted_and_the_roster_alone_says_so(desk: Desk) -> None:
    joined(desk)
    desk.sync("south")
    listed = desk.ask("south", "trust", "list")["trusted"]
    assert isinstance(listed, list)
    assert {(item["name"], item["source"]) for item in listed} == {("north", "roster"), ("west", "roster")}


def test_a_roster_is_drafted_here_and_signed_where_the_ca_key_is(desk: Desk) -> None:
    joined(desk)
    draft, signed = desk.folder / "roster.draft", desk.folder / "roster.signed"
    desk.ask("south", "registry", "role", "west", "line", "--draft", draft)
    refused = desk.run("south", "registry", "sign", draft, "--output", signed, "--yes")
    assert refused.code == 3
    desk.ask("north", "registry", "sign", draft, "--output", signed, "--yes")
    assert desk.ask("north", "registry", "status")["roster"] == 4
    assert signed.read_bytes().count(b".") == 2


def test_the_doctor_sees_the_registry_and_none_if_none_was_joined(desk: Desk) -> None:
    def found(station: str) -> list[tuple[str, str]]:
        checks = json.loads(desk.run(station, "--json", "doctor").out)["checks"]
        return [(check["result"], check["why"]) for check in checks if check["name"] == "registry"]

    assert found("south") == []
    joined(desk)
    assert any("never" in why for _, why in found("south"))
    desk.sync("south")
    assert {result for result, _ in found("south")} == {"ok"}


def test_the_doctor_says_whose_clock_is_wrong_until_that_station_dates_a_page_well(desk: Desk) -> None:
    joined(desk)
    desk.sync("west", "south")
    west = str(desk.ask("west", "init")["fingerprint"])
    soon = f"{datetime.now(UTC) + timedelta(hours=1):%Y-%m-%dT%H:%M:%SZ}"

    def found(created: str) -> list[str]:
        """Return what is said once west has made one page more, and dated it so."""
        with Station.inspect(desk.folder / "south") as south, south.transaction():
            pages = south.plant.pages
            chain = pages.chain(west)
            n = 1 + max((number for number, *_ in pages.times(chain.id, 1)), default=0)
            pages.add(chain.id, PageRow(n, f"{n:064x}", "", created, "", b"", b"{}", bytes(64)))
        checks = json.loads(desk.run("south", "--json", "doctor").out)["checks"]
        findings = [check for check in checks if check["name"] == "registry" and "page" in check["why"]]
        return [f"{item['why']} {item['fix']}" for item in findings]

    assert found("9999-12-31T23:59:59Z") == [
        "west has dated its newest page 9999-12-31T23:59:59Z. Set the clock of west."
    ]
    [why] = found(soon)
    assert why.startswith("The clock is behind the newest page of west")
    assert "Set the clock of this machine" in why
    assert found("2026-11-01T00:00:00Z") == []


def test_a_keeper_who_finds_nothing_to_vouch_for_is_told_so(desk: Desk) -> None:
    joined(desk)
    assert "Nothing to do" in desk.run("north", "registry", "vouch", "--all", "--yes").out


def test_who_joined_none_is_told_how(desk: Desk) -> None:
    for words in (["status"], ["sync", "--files", desk.stick], ["log"], ["seen"], ["renew"]):
        done = desk.run("south", "registry", *words)
        assert done.code == 6
        assert "registry connect" in done.err


def test_a_station_that_the_roster_does_not_name_cannot_join(desk: Desk) -> None:
    desk.ask("north", "registry", "create", "--name", "plant", "--yes")
    desk.ask("north", "registry", "sync", "--files", desk.stick)
    done = desk.run("south", "registry", "connect", "--files", desk.stick, "--yes")
    assert done.code == 3
    assert "registry request" in done.err


def test_a_station_of_another_ca_is_not_added(desk: Desk) -> None:
    owner(desk.folder / "stranger", "stranger").close()
    desk.ask("north", "registry", "create", "--name", "plant", "--yes")
    asked = desk.folder / "stranger.request"
    desk.ask("stranger", "registry", "request", "--output", asked)
    done = desk.run("north", "registry", "add", asked, "--role", "base", "--yes")
    assert done.code == 6
    assert "not certified" in done.err


def test_two_commands_at_once_never_sign_two_rosters_of_one_version(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    desk.ask("north", "registry", "create", "--name", "plant Augsburg", "--yes")
    asked = {name: desk.folder / f"{name}.request" for name in ("south", "west")}
    for name, file in asked.items():
        desk.ask(name, "registry", "request", "--output", file)
    add = plant.owner.add

    def and_another_adds(*what: Any) -> object:
        draft = add(*what)
        monkeypatch.undo()
        desk.ask("north", "registry", "add", asked["west"], "--role", "line", "--yes")
        return draft

    monkeypatch.setattr(plant.owner, "add", and_another_adds)
    done = call(desk.folder / "north", "--json", "registry", "add", asked["south"], "--role", "base", "--yes")
    assert (done.code, "Another command changed the roster" in done.json["error"]["message"]) == (6, True)
    desk.ask("north", "registry", "add", asked["south"], "--role", "base", "--yes")
    desk.ask("north", "registry", "connect", "--files", desk.stick, "--yes")
    desk.sync("north")
    assert desk.ask("south", "registry", "connect", "--files", desk.stick, "--yes")["version"] == 3


def test_a_second_request_is_the_same_and_a_plan_changes_nothing(desk: Desk) -> None:
    first, second = desk.folder / "1.request", desk.folder / "2.request"
    desk.ask("south", "registry", "request", "--output", first)
    desk.ask("south", "registry", "request", "--output", second)
    assert first.read_bytes() == second.read_bytes()
    assert desk.ask("north", "registry", "create", "--name", "plant", "--dry-run")["plan"] is True
    assert desk.run("north", "registry", "status").code == 6


def test_leaving_is_confirmed_and_reported(desk: Desk) -> None:
    joined(desk)
    assert desk.run("south", "registry", "disconnect").code == 6
    desk.ask("south", "registry", "disconnect", "--yes")
    assert desk.run("south", "registry", "status").code == 6
    assert desk.ask("south", "registry", "connect", "--files", desk.stick, "--yes")["version"] == 3


def test_the_same_again_makes_no_new_roster(desk: Desk) -> None:
    joined(desk)
    asked = desk.folder / "west.request"
    desk.ask("west", "registry", "request", "--output", asked)
    same = ("registry", "add", asked, "--role", "sign", "--role", "line", "--yes")
    assert desk.ask("north", *same)["version"] == 3
    assert desk.ask("north", "registry", "add", asked, "--role", "base", "--yes", code=6)
    assert desk.ask("north", "registry", "role", "west", "line", "sign", "--yes")["version"] == 3
    share = ("registry", "share", "--all", "--to", "south", "--yes")
    assert [desk.ask("north", *share)["version"] for _ in range(2)] == [4, 4]
    assert [desk.ask("north", "registry", "unshare", "--all", "--yes")["version"] for _ in range(2)] == [5, 5]
    out = desk.folder / "roster.jws"
    leaves = ("registry", "remove", "west", "--lost", "--last", 0, "--yes", "--output", out)
    assert [desk.ask("north", *leaves)["version"] for _ in range(2)] == [6, 6]
    assert desk.ask("north", "registry", "remove", "west", "--lost", "--retired", code=2)
    assert desk.ask("north", "registry", "renew", "--days", 91, "--yes")["version"] == 7, "a new end is a new version"


def test_a_node_that_only_others_met_is_found_by_its_first_digits_and_name(desk: Desk) -> None:
    joined(desk)
    desk.ask("north", "whitelist", "add", UUID, "--fingerprint", KEY, "--name", "finger 1")
    desk.sync("north")
    asked = desk.folder / "late.request"
    desk.sync("south")
    desk.ask("south", "whitelist", "remove", UUID, "--yes")
    assert asked
    for word in (UUID[:4], f"0x{UUID[:8].upper()}", "finger 1"):
        found = desk.ask("south", "registry", "log", word)["events"]
        assert {item["uuid"] for item in found} == {UUID}, word  # type: ignore[attr-defined]
        assert desk.ask("south", "nodes", "--plant", word)["nodes"], word
    desk.ask("south", "registry", "log", "8d4e", code=3)


def test_a_fork_stops_the_copy_and_a_person_resumes(desk: Desk) -> None:
    joined(desk)
    desk.sync("west")
    shutil.copytree(desk.folder / "west", desk.folder / "copy")
    desk.ask("copy", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.sync("copy")
    desk.ask("west", "whitelist", "add", "00" * 10, "--fingerprint", KEY)
    reply = desk.ask("west", "registry", "sync", "--files", desk.stick, code=4)
    assert reply["error"]["code"] == "fork"  # type: ignore[index]
    assert desk.ask("west", "registry", "status", code=4)["alarms"]
    planned = desk.ask("west", "registry", "resume", "--files", desk.stick, "--dry-run")
    assert (planned["done"], planned["adopts"]) == (0, 1)
    assert desk.ask("west", "registry", "status", code=4)["alarms"], "a plan resumes nothing"
    empty = desk.folder / "empty stick"
    empty.mkdir()
    reply = desk.ask("west", "registry", "sync", "--files", empty, code=4)
    assert reply["error"]["code"] == "fork", "a stick that shows nothing of it resumes nothing"  # type: ignore[index]
    assert not list(empty.glob("*/1.jws")), "a page from here would prove two histories"
    assert desk.ask("west", "registry", "resume", "--files", desk.stick, "--yes")["done"] == 1
    desk.sync("west")


def test_a_home_rebuilt_from_a_backup_takes_its_own_pages_back(desk: Desk) -> None:
    joined(desk)
    copy = desk.folder / "west.backup"
    made = desk.ask("west", "backup", copy)
    assert made
    desk.ask("west", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.sync("west", "north")
    home = (desk.folder / "west" / "registry-home").read_text()
    shutil.rmtree(desk.folder / "west")
    desk.ask("west", "restore", copy, "--yes")
    assert (desk.folder / "west" / "registry-home").read_text() != home
    desk.ask("west", "whitelist", "add", "00" * 10, "--fingerprint", KEY)
    reply = desk.sync("west")
    assert "before its backup" in str(reply["told"])
    assert desk.ask("west", "registry", "status")["unsent"] == 0
    desk.sync("north")
    assert len(desk.ask("north", "registry", "log", "--station", "west")["events"]) == 2  # type: ignore[arg-type]


def test_a_home_rebuilt_from_a_backup_says_nothing_new_by_a_stick_that_knows_less(desk: Desk) -> None:
    joined(desk)
    copy, stale = desk.folder / "west.backup", desk.folder / "old stick"
    desk.sync("west")
    desk.ask("west", "backup", copy)
    shutil.copytree(desk.stick, stale)
    desk.ask("west", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.sync("west")
    shutil.rmtree(desk.folder / "west")
    desk.ask("west", "restore", copy, "--yes")
    desk.ask("west", "whitelist", "add", "00" * 10, "--fingerprint", KEY)
    reply = desk.ask("west", "registry", "sync", "--files", stale)
    assert "was restored from a backup" in str(reply["told"])
    assert not list(stale.glob("*/1.jws")), "page 1 was said before"
    assert "1 page that this station wrote before its backup is back" in desk.sync("west")["told"]  # type: ignore[operator]
    desk.sync("north")
    assert len(desk.ask("north", "registry", "log", "--station", "west")["events"]) == 2  # type: ignore[arg-type]


def test_a_person_accepts_one_of_two_histories_and_sees_it_first(desk: Desk, tmp_path: Path) -> None:
    joined(desk)
    desk.sync("west")
    shutil.copytree(desk.folder / "west", desk.folder / "copy")
    other = tmp_path / "other stick"
    shutil.copytree(desk.stick, other)
    desk.ask("west", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.sync("west")
    desk.ask("copy", "whitelist", "add", UUID, "--fingerprint", "cd" * 32)
    desk.ask("copy", "registry", "sync", "--files", other)
    desk.sync("north")
    reply = desk.ask("north", "registry", "sync", "--files", other, code=4)
    assert [alarm["code"] for alarm in reply["alarms"]] == ["two-histories"]  # type: ignore[attr-defined]
    refused = desk.run("north", "registry", "accept", "west", "--yes")
    assert refused.code == 6
    assert "--page" in refused.err
    (branch,) = [word for word in refused.err.replace(",", " ").split() if len(word) == 16][:1]
    plan = desk.ask("north", "registry", "accept", "west", "--page", branch, "--dry-run")
    assert (plan["done"], plan["n"]) == (0, 1)
    assert desk.ask("north", "registry", "status", code=4)["alarms"]
    taken = desk.ask("north", "registry", "accept", "west", "--page", branch, "--yes")
    assert (taken["done"], taken["hash"]) == (1, plan["hash"])
    reply = desk.ask("north", "registry", "log", "--station", "west")
    pins = [event for event in reply["events"] if event["act"] == "pinned"]  # type: ignore[attr-defined]
    assert sorted(item["counts"] for item in pins) == [False, True], "of two first pages one counts"
    (node,) = desk.ask("north", "nodes", "--plant")["nodes"]  # type: ignore[misc]
    (pinned,) = node["says"]["pinned_by"].values()
    offered = desk.run("north", "registry", "accept", "west", "--page", "0" * 16, "--yes").err
    hashes = {word for word in offered.replace(",", " ").replace(".", " ").split() if len(word) == 16}
    (other_branch,) = hashes - {branch}
    assert desk.ask("north", "registry", "accept", "west", "--page", other_branch, "--yes")["done"] == 1
    (node,) = desk.ask("north", "nodes", "--plant")["nodes"]  # type: ignore[misc]
    assert set(node["says"]["pinned_by"].values()) == {KEY, "cd" * 32} - {pinned}, "a person changed the choice"


def test_a_removed_station_gets_no_login_and_a_member_is_not_asked_to_join_again(desk: Desk) -> None:
    joined(desk)
    west, north = desk.folder / "west.request", desk.folder / "north.request"
    opened = desk.ask("north", "registry", "sql", "--member", west)
    assert "login connection limit" in str(opened["sql"])
    desk.ask("north", "registry", "remove", "west", "--stolen", "--last", 0, "--yes")
    refused = desk.run("north", "registry", "sql", "--member", west)
    assert (refused.code, refused.out) == (6, "")
    assert "west was removed from plant Augsburg (stolen)" in refused.err
    shown = desk.run("north", "registry", "request", "--output", north)
    assert "registry sql --member north.request | psql" in shown.out
    assert "registry add" not in shown.out


def test_what_waits_in_pages_counts_as_unsent(desk: Desk) -> None:
    joined(desk)
    desk.ask("north", "whitelist", "add", "00" * 10, "--fingerprint", KEY)
    desk.sync("north")
    assert desk.ask("north", "registry", "status")["unsent"] == 0
    desk.ask("north", "whitelist", "add", UUID, "--fingerprint", KEY)
    (pages,) = desk.stick.glob("*/1.jws")
    pages.parent.rename(desk.folder / "away")
    pages.parent.write_text("no folder: the page is made, and cannot leave")
    assert desk.run("north", "registry", "sync").code not in (0, 2)
    with Station.inspect(desk.folder / "north") as north:
        assert north.plant.outbox(1) == []
    assert desk.ask("north", "registry", "status")["unsent"] == 1
    checks = json.loads(desk.run("north", "--json", "doctor").out)["checks"]
    assert any(
        check["why"].startswith("1 event unsent, 0 conflicts") for check in checks if check["name"] == "registry"
    )
    pages.parent.unlink()
    (desk.folder / "away").rename(pages.parent)
    desk.ask("north", "registry", "sync")
    assert desk.ask("north", "registry", "status")["unsent"] == 0


def test_a_node_that_only_the_plant_knows_is_revoked_and_whitelisted_by_its_first_digits(desk: Desk) -> None:
    joined(desk)
    desk.ask("west", "whitelist", "add", UUID, "--fingerprint", KEY, "--name", "finger 1")
    desk.sync("west", "south")
    assert desk.run("south", "nodes", UUID[:4]).code == 3
    planned = desk.ask("south", "revoke", UUID[:4], "--why", "stolen", "--dry-run")
    assert planned["uuid"] == UUID
    assert desk.ask("south", "whitelist", "remove", UUID[:4], "--dry-run")["removed"] is False
    assert desk.ask("south", "whitelist", "add", UUID[:4], "--dry-run")["added"] == 1
    desk.ask("south", "whitelist", "add", UUID[:4])
    for word in (UUID[:4], "finger 1"):
        (node,) = desk.ask("south", "nodes", word)["nodes"]  # type: ignore[misc]
        assert (node["uuid"], node["name"]) == (UUID, "finger 1"), "the name that west gave it"
    assert desk.run("south", "revoke", "ffff", "--why", "stolen").code == 3


def test_a_node_on_which_stations_do_not_agree_says_so_itself(desk: Desk) -> None:
    joined(desk)
    desk.ask("north", "whitelist", "add", UUID, "--fingerprint", KEY)
    desk.ask("south", "whitelist", "add", UUID, "--fingerprint", "cd" * 32)
    desk.sync("north", "south")
    (node,) = desk.ask("south", "nodes", UUID)["nodes"]  # type: ignore[misc]
    assert [conflict["name"] for conflict in node["conflicts"]] == ["other pin"]
    assert "conflict     other pin: keepers pin" in desk.run("south", "nodes", UUID).out
    shown = desk.run("south", "nodes", "--plant", UUID).out
    assert "no holder, firmware not reported\n" in shown
    assert "1 conflict," in desk.run("south", "registry", "status").out


def test_a_roster_is_signed_and_put_in_force_under_the_lock_of_the_store(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two commands beside each other would sign two rosters of one version, an alarm at every station."""
    held: list[tuple[str, bool]] = []

    def watch(place: Any, name: str) -> None:
        does = getattr(place, name)

        def watched(station: Station, *words: Any, **named: Any) -> Any:
            held.append((name, station._held > 0))
            return does(station, *words, **named)

        monkeypatch.setattr(place, name, watched)

    watch(plant.owner, "signed")
    watch(plant.owner, "join")
    watch(plant.apply_pages, "put_roster")
    desk.ask("north", "registry", "create", "--name", "plant Augsburg", "--yes")
    desk.ask("north", "registry", "renew", "--days", 30, "--yes")
    assert held == [("signed", True), ("join", True), ("signed", True), ("put_roster", True)]
