"""``registry``: what its commands print of a plant, whole, for people and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision import plant
from teds_provision.cli.rendering import local_time
from teds_provision.errors import BadDataError, PolicyError
from teds_provision.handover.incoming import NothingImportedError
from teds_provision.plant import schema
from teds_provision.plant.commands import nodes as of_nodes
from teds_provision.plant.commands import parcels as of_parcels
from teds_provision.plant.commands import registry as commands
from teds_provision.plant.removed_members import RemovalReview
from teds_provision.plant.status import PlantStatus, StationStanding
from teds_provision.plant.sync import SyncResult
from teds_provision.protocol.keys import SoftwareKey, fingerprint
from teds_provision.protocol.plant.roster import Member, RemovedMember, Roster, Share
from teds_provision.station.plant.alarms import Alarm
from teds_provision.station.plant.parcels import ParcelRow
from teds_provision.station.plant.plant import PlantRecord
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.cli.shell import call

from .owner import ALL, REGISTRY, alone, join, member, roster_of

AT = "2026-01-31T12:00:00Z"
END = datetime(2026, 3, 1, 12, 30, 5, tzinfo=UTC)
WEST = "ee" * 32


@pytest.fixture
def home(tmp_path: Path) -> Path:
    alone(tmp_path / "owner").close()
    return tmp_path / "owner"


@pytest.fixture
def station(home: Path) -> Iterator[Station]:
    made = Station.inspect(home)
    yield made
    made.close()


def test_a_roster_as_json(station: Station) -> None:
    held = station.plant.roster
    assert held is not None
    south, west = b"\4" + b"\1" * 64, b"\4" + b"\2" * 64
    made = replace(
        held,
        name="plant",
        version=7,
        expires=END,
        members=(Member("south", south, b"", frozenset(("audit", "keeper", "base", "sign", "line"))),),
        removed=(RemovedMember("west", west, frozenset(), "lost", (88, "ab" * 32)),),
        share=(Share(("all", ""), ("aa", "bb"), True), Share(("group", "left"), ("aa",), False)),
    )
    found = commands._to_json(made)
    for each in (*found["members"], *found["removed"]):
        assert len(each.pop("fingerprint")) == 64
    assert found == {
        "registry": REGISTRY,
        "name": "plant",
        "version": 7,
        "members": [{"name": "south", "roles": ["keeper", "line", "sign", "base", "audit"]}],
        "removed": [{"name": "west", "why": "lost", "last": 88}],
        "share": [
            {"what": {"all": True}, "to": ["aa", "bb"], "forget": True},
            {"what": {"group": "left"}, "to": ["aa"], "forget": False},
        ],
        "expires": "2026-03-01T12:30:05Z",
    }


@pytest.mark.parametrize(
    ("seconds", "shown"),
    [(0, "0 s"), (59, "59 s"), (60, "1 min"), (119, "1 min"), (7199, "119 min"), (7200, "2 h"), (172799, "47 h"),
     (172800, "2 days"), (1000000, "11 days")],
)  # fmt: skip
def test_ages_for_people(seconds: int, shown: str) -> None:
    assert commands._age(seconds) == shown


def standing(name: str, *roles: str, number: int = 0, age: int | None = None, state: str = "heard") -> StationStanding:
    return StationStanding(name, WEST, roles, number, age, state)


def status_of(station: Station, *, end: timedelta = timedelta(days=30), **changes: Any) -> PlantStatus:
    held = station.plant.roster
    assert held is not None
    held = replace(held, name="plant", version=7, expires=END)
    given: dict[str, Any] = {
        "record": PlantRecord(REGISTRY, synced=AT),
        "standings": (
            standing("owner", "keeper", "sign", number=12, age=30, state="here"),
            standing("west", "line", number=3, age=172800),
            standing("south-1", state="nothing said"),
        ),
        "unsent": 1,
        "conflicts": 2,
        "alarms": (Alarm("junk", "", 0, "old", AT, True), Alarm("fork", WEST, 4, "a copy", AT)),
        "heads": ("0123456789abcdef", 3),
    }
    return PlantStatus(roster=held, at=END - end, **(given | changes))


def test_the_status_for_people(station: Station, monkeypatch: pytest.MonkeyPatch) -> None:
    review: list[RemovalReview | None] = [None]
    due = [0]
    doors: list[str] = []
    monkeypatch.setattr(plant.removed_members, "last", lambda _: review[0])
    monkeypatch.setattr(plant.removed_members, "rotations_due", lambda _: due[0])
    monkeypatch.setattr(type(station.plant), "doors", lambda _: doors)

    def shown(**more: Any) -> list[str]:
        return commands._shown(station, status_of(station, **more)).splitlines()

    west = station.plant.roster.name_of(WEST) if station.plant.roster is not None else ""
    first = f"plant {REGISTRY[:8]}   roster 7, until 2026-03-01   heads 0123 4567 89ab cdef of 3"
    table = [
        "owner    keeper sign  page    12      30 s  here",
        "west     line         page     3    2 days  heard",
        "south-1               page     0         -  nothing said",
    ]
    counts = f"2 conflicts, 1 event unsent, last sync {local_time(AT)}"
    alarm = f"ALARM fork of {west}, 4: a copy"
    assert shown() == [first, *table, counts, alarm]
    quiet = shown(alarms=(), conflicts=1, unsent=2, record=PlantRecord(REGISTRY))
    assert quiet[4:] == ["1 conflict, 2 events unsent, never synced"]
    review[0] = RemovalReview("", "", 9, 0)
    due[0] = 4
    assert shown(alarms=())[5:] == ["to rotate: 4 of 9"]
    review[0] = RemovalReview("", "", 9, 2)
    assert shown(alarms=())[5:] == ["to rotate: 4 of 9; 2 need a tap"]
    due[0] = 0
    assert shown(alarms=())[5:] == ["2 nodes need a tap: only a station that left held the key"]
    review[0] = RemovalReview("", "", 9, 1)
    assert shown(alarms=())[5:] == ["1 node needs a tap: only a station that left held the key"]
    review[0] = RemovalReview("", "", 9, 0)
    doors += ["TEMP for PUBLIC", "writing pages"]
    assert shown(alarms=())[5:] == ["The database allows what it should not: TEMP for PUBLIC, writing pages"]
    doors.clear()
    renew = "on the station with the CA key: registry renew"
    assert shown(alarms=(), end=timedelta(0))[5:] == [f"The roster has EXPIRED: {renew}"]
    assert shown(alarms=(), end=timedelta(seconds=1))[5:] == [f"The roster expires soon: {renew}"]


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({}, 4),
        ({"alarms": ()}, 0),
        ({"alarms": (Alarm("junk", "", 0, "old", AT, True),)}, 0),
        ({"end": timedelta(0)}, 6),
        ({"alarms": (), "standings": (standing("west"),)}, 6),
    ],
    ids=str,
)
def test_the_status_ends_with_what_is_worst(
    home: Path, station: Station, monkeypatch: pytest.MonkeyPatch, changes: dict[str, Any], code: int
) -> None:
    found = status_of(station, **changes)
    monkeypatch.setattr(plant.status, "status", lambda *_: found)
    outcome = call(home, "--json", "registry", "status")
    assert outcome.code == code
    result = json.loads(outcome.out)
    assert set(result) == {
        "registry", "name", "roster", "expires", "members", "unsent", "synced", "conflicts", "alarms", "to_rotate",
        "heads", "open_doors",
    }  # fmt: skip
    if not changes:
        assert result["members"][1] == {
            "name": "west", "fingerprint": WEST, "roles": ["line"], "n": 3, "age": 172800, "state": "heard"
        }  # fmt: skip
        assert result["alarms"][1] == {
            "code": "fork", "about": WEST, "n": 4, "why": "a copy", "at": AT, "seen": False
        }  # fmt: skip
        assert (result["unsent"], result["conflicts"], result["heads"]) == (1, 2, ["0123456789abcdef", 3])


class Carrier:
    """Stands for what carries; is closed in any case."""

    def __init__(self) -> None:
        self.closed = 0

    def close(self) -> None:
        self.closed += 1


def test_what_a_sync_prints(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    carrier, done, doors = Carrier(), SyncResult(), list[str]()
    monkeypatch.setattr(commands, "_transport", lambda *_: (carrier, True))
    monkeypatch.setattr(plant.sync, "sync", lambda *_, **__: done)
    monkeypatch.setattr(plant.connecting, "check_database", lambda *_: doors)
    assert call(home, "registry", "sync").out == "0 pages out, 0 in\n"
    done.pushed, done.fetched, done.parcels_in, done.parcels_out, done.waiting = 1, 2, 3, 0, 1
    done.returned, done.rosters, done.remarks = 4, [7, 8], ["a remark"]
    doors += ["one", "two"]
    with Station.inspect(home) as station, station.transaction():
        station.plant.alarms.put(Alarm("junk", "", 0, "seen already", AT, True))
        station.plant.alarms.put(Alarm("fork", "", 4, "a copy", AT))
    outcome = call(home, "registry", "sync")
    assert outcome.code == 4
    assert outcome.out.splitlines() == [
        "1 page out, 2 in",
        "0 parcels out, 3 in",
        "1 parcel waits for confirmation: teds-provision import-keys --received",
        "roster 7 is now in force",
        "roster 8 is now in force",
        "a remark",
        "ALARM fork, 4: a copy",
    ]
    assert "The database allows what it should not: one, two. As its superuser, run: registry sql | psql" in outcome.err
    assert json.loads(call(home, "--json", "registry", "sync").out) == {
        "pushed": 1,
        "fetched": 2,
        "returned": 4,
        "parcels": {"in": 3, "out": 0, "waiting": 1},
        "alarms": [{"code": "fork", "about": "", "n": 4, "why": "a copy", "at": AT, "seen": False}],
        "told": ["a remark"],
        "rosters": [7, 8],
        "open_doors": ["one", "two"],
    }
    done.waiting = 2
    assert "2 parcels wait for confirmation" in call(home, "registry", "sync").out
    assert carrier.closed == 4

    def broken(*_: Any, **__: Any) -> SyncResult:
        raise plant.sync.NotMemberError("removed")

    monkeypatch.setattr(plant.sync, "sync", broken)
    assert call(home, "registry", "sync").code == 6
    assert carrier.closed == 5


@pytest.mark.parametrize("step", ["sync", "check"])
def test_a_sync_that_fails_lets_go_of_what_carries(home: Path, monkeypatch: pytest.MonkeyPatch, step: str) -> None:
    carrier = Carrier()

    def fails(*_: object, **__: object) -> Any:
        raise PolicyError("It cannot go on.")

    monkeypatch.setattr(commands, "_transport", lambda *_: (carrier, True))
    monkeypatch.setattr(plant.sync, "sync", fails if step == "sync" else lambda *_, **__: SyncResult())
    monkeypatch.setattr(plant.connecting, "check_database", fails)
    assert (call(home, "registry", "sync").code, carrier.closed) == (6, 1)


def test_what_stations_published_is_one_line_each(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    event = {
        "act": "signed", "id": "ff" * 8, "at": AT, "uuid": "8d" * 10, "epoch": 3, "teds_sha256": "ab" * 32,
        "statement": "long", "proof": "longer", "profile": None, "runs": ["text", "1.2.3", "digest"],
    }  # fmt: skip
    stated = [SimpleNamespace(station=WEST, number=12, counts=True, event=event),
              SimpleNamespace(station=WEST, number=13, counts=False, event=event)]  # fmt: skip
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(plant.status, "log", lambda _station, **how: asked.append(how) or iter(stated))
    with Station.inspect(home) as station:
        held = station.plant.roster
        assert held is not None
        west, own = held.name_of(WEST), station.fingerprint
    members = f"uuid={'8d' * 10} epoch=3 teds_sha256={'ab' * 10} runs=text 1.2.3"
    assert call(home, "registry", "log").out.splitlines() == [
        f"{AT}  {west} 12  signed  {members}",
        f"{AT}  {west} 13  signed  {members}  (does not count)",
    ]
    found = json.loads(call(home, "--json", "registry", "log", "--station", "owner", "--since", AT).out)["events"]
    assert found[1] == {**event, "station": west, "fingerprint_of_station": WEST, "page": 13, "counts": False}
    assert asked[0] == {"uuid": None, "of": None, "since": None}
    assert (asked[1]["of"], asked[1]["since"]) == (own, AT)
    assert call(home, "registry", "log", "--station", "nobody").code == 3


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("share", "--to", "owner"), "Give one of --all, --group and --profile."),
        (("share", "--to", "owner", "--all", "--group", "x"), "Give one of --all, --group and --profile."),
        (("unshare", "--profile", "p", "--group", "x"), "Give one of --all, --group and --profile."),
        (("remove", "owner"), "Give one of --retired, --lost and --stolen."),
        (("remove", "owner", "--lost", "--stolen"), "Give one of --retired, --lost and --stolen."),
        (("connect",), "Give a URL, or --files DIR."),
        (("connect", "postgresql://h/d", "--files", "."), "Give a URL, or --files DIR."),
        (("vouch",), "Give UUIDs, or --all."),
        (("vouch", "8d4d", "--all"), "Give UUIDs, or --all."),
        (("sql", "--close", "owner", "--mend", "owner", "3"), "Give one of --member, --close and --mend."),
    ],
)
def test_a_choice_is_made_once(home: Path, words: tuple[str, ...], message: str) -> None:
    refused = call(home, "registry", *words)
    assert refused.code == 2
    assert message in refused.err


def test_what_can_be_shared() -> None:
    assert commands._what(True, None, None) == ("all", "")
    assert commands._what(False, "left", None) == ("group", "left")
    assert commands._what(False, None, "load-cell") == ("profile", "load-cell")


def test_leaving_says_what_it_means_and_changes_nothing_as_a_plan(home: Path) -> None:
    plan = call(home, "registry", "disconnect", "--dry-run")
    assert plan.out == (
        "Plan: Leave plant: this station stops publishing, and trusts every station that the CA certified again, "
        "removed ones included. It stays on the roster until the owner runs: registry remove\n"
    )
    assert call(home, "--json", "registry", "disconnect", "--dry-run").json == {"registry": REGISTRY, "plan": True}
    asked = call(home, "registry", "disconnect")
    assert (asked.code, asked.err.startswith(plan.out.removeprefix("Plan: "))) == (6, True), "before the question"
    with Station.inspect(home) as station:
        assert station.plant.joined is not None
    left = call(home, "registry", "disconnect", "--yes")
    assert left.out == "Left plant.\n"
    with Station.inspect(home) as station:
        assert station.plant.joined is None


def test_alarms_are_acknowledged_and_counted(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for counts, said in (((1, 0), "1 alarm seen."), ((2, 1), "2 alarms seen, 1 report of missing pages.")):
        monkeypatch.setattr(plant.sync, "acknowledge", lambda _station, counts=counts: counts)
        assert call(home, "registry", "seen").out == f"{said}\n"
        assert call(home, "--json", "registry", "seen").json == {"done": sum(counts)}


def test_a_renewal_is_run_again_with_nothing_to_do(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert call(home, "--json", "registry", "renew", "--yes").json["version"] == 2
    later = datetime.now(UTC) + timedelta(minutes=59)
    monkeypatch.setattr(plant.owner, "now", lambda: later)
    for more in (["--dry-run"], ["--yes"]):
        assert call(home, "registry", "renew", *more).out == "Nothing to do: roster 2 already says so.\n"
    for days in (89, 91):
        assert call(home, "--json", "registry", "renew", "--days", days, "--dry-run").json["version"] == 3


def test_a_roster_that_says_the_same_is_not_signed_again(home: Path, tmp_path: Path) -> None:
    out = tmp_path / "roster.jws"
    words = ("registry", "role", "owner", "keeper", "line", "sign", "base", "--output", out)
    planned = call(home, "--json", *words, "--dry-run")
    assert (planned.json["plan"], out.exists()) == (True, False)
    again = call(home, *words, "--yes")
    assert again.out == "Nothing to do: roster 1 already says so.\n"
    with Station.inspect(home) as station:
        held = station.plant.roster
        assert held is not None
        assert out.read_bytes() == held.octets + b"\n"
    draft = tmp_path / "less.draft"
    drafted = call(home, "--json", "registry", "role", "owner", "keeper", "--draft", draft)
    assert (drafted.json["draft"], drafted.json["version"], drafted.json["plan"]) == (str(draft), 2, False)
    assert call(home, "registry", "role", "owner", "keeper").code == 6, "nobody is there to confirm"
    signed = call(home, "registry", "role", "owner", "keeper", "--yes")
    assert signed.out == "Roster 2 is in force here. To tell the others: teds-provision registry sync\n"
    assert isinstance(held, Roster)


def of_a_plant(home: Path, *removed: RemovedMember) -> Roster:
    """Have a roster in force that names this station, and west, and these as removed."""
    with Station.inspect(home) as station:
        station.ask_by(lambda *_: PASSPHRASE)
        station.unlock()
        west = SoftwareKey(91)
        named = Member("west", west.point, station.identity.certify(west.point), frozenset({"line"}))
        now = roster_of(station, member(station, "owner", *ALL), named, version=2, previous="0" * 64, removed=removed)
        join(station, now)
    return now


def gone(number: int, name: str) -> RemovedMember:
    return RemovedMember(name, SoftwareKey(number).point, frozenset({"line"}), "lost", (0, ""))


def test_the_sql_of_each_option(home: Path) -> None:
    lost, old = gone(92, "lost"), gone(93, "old")
    held = of_a_plant(home, lost, old)
    west = fingerprint(SoftwareKey(91).point)

    def sql(*words: object) -> str:
        return call(home, "registry", "sql", *words).out

    whole = schema.registry_sql(held.registry)
    both = "".join(schema.close_sql(fingerprint(left.point)) for left in held.removed)
    assert (len(held.removed), sql()) == (2, (whole + both).rstrip("\n") + "\n"), "a restore opens every login again"
    for name, digits in (("west", west), ("old", fingerprint(old.point))):
        assert sql("--close", name) == schema.close_sql(digits).rstrip("\n") + "\n"
        assert sql("--mend", name, "1") == schema.mend_sql(digits, 1).rstrip("\n") + "\n"
    for words, code in ((("--close", "nobody"), 3), (("--mend", "west", "x"), 2), (("--mend", "west", "-1"), 2),
                        (("--mend", "west", "12345678901"), 2), (("--mend", "west", "0"), 8)):  # fmt: skip
        assert call(home, "registry", "sql", *words).code == code


def test_a_station_belongs_to_one_registry_and_is_asked_once(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    held = of_a_plant(home)
    past: list[object] = []
    monkeypatch.setattr(plant.backlog, "backlog", lambda _station: past.append(1) or [])
    monkeypatch.setattr(plant.membership, "found_roster", lambda *_: held)
    again = call(home, "registry", "connect", "--files", tmp_path)
    assert (again.code, again.out, past) == (0, "Joined plant. Next: teds-provision registry sync\n", [])
    other = replace(held, registry="11111111-2222-4333-8444-555555555555")
    monkeypatch.setattr(plant.membership, "found_roster", lambda *_: other)
    refused = call(home, "registry", "connect", "--files", tmp_path, "--yes")
    assert (refused.code, refused.err) == (
        6,
        f"Error: This station already belongs to registry {REGISTRY}.\n  → Leave it first: registry disconnect\n",
    )
    assert call(home, "registry", "disconnect", "--yes").code == 0
    assert call(home, "registry", "connect", "--files", tmp_path).code == 6, "nobody answers the question"
    assert past == [1]
    with Station.inspect(home) as station:
        assert station.plant.joined is None


def firmware(text: str, by: str, version: str | None = "1.2.3", build: int | None = 0) -> dict[str, Any]:
    return {"text": text, "version": version, "build": build, "image": "ab" * 32, "by": by, "at": AT}


def test_a_node_as_the_plant_reports_it(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    says: dict[str, Any] = {
        "epoch": 3, "holders": {"k1": ["north", "south"], "k2": ["west"]}, "sequence": 9, "written_by": "north",
        "older_than": "north", "revoked": ["west", "east"], "firmware": firmware("cell", "north", build=7),
        "firmware_by": {"north": firmware("cell", "north", build=7), "south": firmware("cell", "south", build=7),
                        "east": firmware("cell", "east", build=6), "west": firmware("", "west")},
    }  # fmt: skip
    bare = {"epoch": None, "holders": {}, "sequence": None, "written_by": None, "older_than": None, "revoked": [],
            "firmware": firmware("", "north", None, None), "firmware_by": {}}  # fmt: skip
    found = [
        {"uuid": "8d" * 10, "name": "left knee", "says": says, "conflicts": [
            {"name": "two keys", "why": "a and b"}, {"name": "other pin", "why": "c"}]},
        {"uuid": "8e" * 10, "name": None, "says": bare, "conflicts": []},
    ]  # fmt: skip
    monkeypatch.setattr(plant.status, "nodes", lambda _station, _roster, _text: iter(found))
    at = local_time(AT)
    assert call(home, "nodes", "--plant").out.splitlines() == [
        f"{'8d' * 10}  left knee  held by north, south, west (epoch 3), datasheet 9 by north, "
        f"firmware cell 1.2.3+7 (north, {at}), revoked by west, east",
        "  the datasheet known here is older than north wrote",
        "  two keys: a and b",
        "  other pin: c",
        f"  also reported: firmware cell 1.2.3+6 (east, {at})",
        f"  also reported: firmware 1.2.3 (west, {at})",
        f"{'8e' * 10}  no holder, firmware not reported (north, {at})",
    ]
    assert call(home, "--json", "nodes", "--plant").json == {"nodes": found}


def test_a_node_of_this_station_has_all_its_conflicts_and_the_name_that_the_plant_gives_it(
    station: Station, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two, three = ("8d" * 10, "8e" * 10, "8f" * 10)
    found = [(bytes.fromhex(one), "two keys", "a and b"), (bytes.fromhex(two), "name", "c"),
             (bytes.fromhex(one), "other pin", "d")]  # fmt: skip
    asked = list[list[str]]()

    def names(_station: Station, _roster: object, uuids: list[bytes]) -> dict[bytes, str]:
        asked.append([uuid.hex() for uuid in uuids])
        return {bytes.fromhex(two): "left", bytes.fromhex(one): "not this one"}

    monkeypatch.setattr(plant.status, "names", names)
    monkeypatch.setattr(station.plant.claims, "conflicts", lambda: iter(found))
    monkeypatch.setattr(of_nodes, "CHUNK", 2)
    rows = [{"uuid": one, "name": "mine", "state": "keyed"}, {"uuid": two, "name": None}, {"uuid": three, "name": ""}]
    assert list(of_nodes.VIEW.described(station, iter(rows))) == [
        {"uuid": one, "name": "mine", "state": "keyed", "conflicts": [
            {"name": "two keys", "why": "a and b"}, {"name": "other pin", "why": "d"}]},
        {"uuid": two, "name": "left", "conflicts": [{"name": "name", "why": "c"}]},
        {"uuid": three, "name": None, "conflicts": []},
    ]  # fmt: skip
    assert asked == [[two], [three]]
    monkeypatch.setattr(type(station.plant), "roster", None)
    assert list(of_nodes.VIEW.described(station, iter(rows))) == rows


@pytest.mark.parametrize(("fate", "refused"), [("the same", True), ("changed", False), ("taken meanwhile", False)])
def test_a_bundle_of_which_nothing_comes_in_is_answered_unless_that_has_changed(
    home: Path, monkeypatch: pytest.MonkeyPatch, fate: str, refused: bool
) -> None:
    with Station.inspect(home) as station:
        row = ParcelRow("p1", "in", WEST, "bundle", "waiting", "2099-01-01T00:00:00Z", "", "a move")
        station.plant.parcels.put(row, b"bundle")
    nodes = (SimpleNamespace(node=SimpleNamespace(uuid=bytes(10)), why="it is revoked"),)
    tries, answered = list[bytes](), list[tuple[str, str]]()

    def plan_import(here: Station, octets: bytes) -> Any:
        tries.append(octets)
        if len(tries) == 1 and fate == "taken meanwhile":
            here.plant.parcels.drop("p1", "in")
        if len(tries) == 1 or fate != "changed":
            raise NothingImportedError(cast("Any", None), cast("Any", nodes))
        return None

    monkeypatch.setattr(of_parcels, "plan_import", plan_import)
    monkeypatch.setattr(
        plant.parcels, "refuse_bundle", lambda _station, error, parcel: answered.append((error.message, parcel))
    )
    why = f"None of the nodes in the bundle can be imported; {'00' * 10}: it is revoked."
    told = call(home, "import-keys", "--received", "--yes")
    assert (told.code, told.out) == (6, "0 parcels imported. 1 parcel refused.\n")
    assert told.err.splitlines()[0] == f"Warning: Parcel p1 is refused: {why}"
    assert "The next sync reports this to the sender, which does not send these keys again." in told.err
    assert answered == ([(why, "p1")] if refused else [])
    assert len(tries) == (1 if fate == "taken meanwhile" else 2)
    if fate == "the same":
        tries.clear()
        planned = call(home, "import-keys", "--received", "--dry-run")
        assert (planned.code, tries, answered) == (6, [b"bundle"], [(why, "p1")]), "a plan answers nothing"


def test_each_parcel_that_waits_is_shown_with_its_reason_and_taken_in(
    home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows = [("bad", "bundle", "waiting", "a move"), ("job", "job", "waiting", ""), ("late", "bundle", "later", "pages"),
            ("new", "bundle", "later", ""), ("sent", "bundle", "sent", ""), ("worse", "bundle", "waiting", ""),
            ("taken meanwhile", "bundle", "waiting", "")]  # fmt: skip
    with Station.inspect(home) as station:
        for name, kind, state, why in rows:
            way: Any = "out" if state == "sent" else "in"
            row = ParcelRow(name, way, WEST, cast("Any", kind), cast("Any", state), "2099-01-01T00:00:00Z", "", why)
            station.plant.parcels.put(row, name.encode() if name != "taken meanwhile" else b"")

    def plan_import(_station: Station, octets: bytes) -> Any:
        if octets == b"bad":
            raise BadDataError("It is none.")
        if octets == b"worse":
            raise PolicyError("Nobody trusts it.")
        return octets

    taken: list[str] = []
    monkeypatch.setattr(of_parcels, "plan_import", plan_import)
    monkeypatch.setattr(of_parcels, "require_as_shown", lambda *_: None)
    monkeypatch.setattr(of_parcels, "import_text", lambda _station, shown: f"Plan of {shown.decode()}.")
    monkeypatch.setattr(of_parcels, "import_plan", lambda shown: {"count": 1})
    done = SimpleNamespace(fresh=True)
    monkeypatch.setattr(plant.parcels, "import_parcel", lambda _station, row, _plan: taken.append(row.id) or done)
    shown = ["Warning: Parcel bad is refused: It is none.", "Plan of late.", "Reason for waiting: pages",
             "Plan of new.", "Reason for waiting: it has just arrived",
             "Warning: Parcel worse is refused: Nobody trusts it."]  # fmt: skip
    plan = call(home, "import-keys", "--received", "--dry-run")
    assert (plan.err.splitlines(), plan.out) == ([*shown, "Error: It is none."], "2 parcels. 2 parcels refused.\n")
    assert (plan.code, taken) == (8, [])
    assert call(home, "import-keys", "--received").code == 6
    assert taken == []
    imported = call(home, "--json", "import-keys", "--received", "--yes")
    assert (imported.code, taken) == (8, ["late", "new"]), "the one that is refused keeps no other out"
    assert imported.json["refused"] == [
        {"parcel": "bad", "why": "It is none."}, {"parcel": "worse", "why": "Nobody trusts it."}
    ]  # fmt: skip
    assert imported.json["plan"] is False
    assert [(one["parcel"], one["why"], one["fresh"]) for one in imported.json["received"]] == [
        ("late", "pages", True), ("new", "", True)
    ]  # fmt: skip
