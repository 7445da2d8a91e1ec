"""The commands of a line in one process: what a job may say, what each command prints, and the figures of a job."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision import plant
from teds_provision.cli.rendering import local_time as local
from teds_provision.errors import NotFoundError, PolicyError, UsageError
from teds_provision.links import LinkSettings
from teds_provision.plant.commands import line as commands
from teds_provision.plant.commands import provision as of_provision
from teds_provision.plant.commands.provision import LineOptions
from teds_provision.plant.evidence import export
from teds_provision.plant.jobs import take_job
from teds_provision.plant.line import LineRun, Scans
from teds_provision.plant.yield_stats import Attempt, StationYield, to_csv, yield_stats
from teds_provision.protocol.keys import station_key_message
from teds_provision.protocol.plant.job import open_job
from teds_provision.protocol.plant.roster import Member
from teds_provision.provisioning.batch import ProvisionRequest
from teds_provision.station.plant.line import EvidenceRow, JobRow, UnitRow
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE
from tests.cli.shell import Outcome, call
from tests.pace import PATIENCE

from .owner import ANGLE, alone, job_of, join, roster_of

ENDS = ("--ends", "2099-01-01T00:00:00Z")
A, B, C = (bytes([number] * 10) for number in (1, 2, 3))
AT = "2026-01-31T12:00:00Z"


@pytest.fixture
def home(tmp_path: Path) -> Path:
    alone(tmp_path / "owner").close()
    return tmp_path / "owner"


def ask(home: Path, *words: object) -> Any:
    outcome = call(home, "--json", *words)
    assert outcome.code == 0, outcome
    return outcome.json


def new(home: Path, *words: object) -> Outcome:
    return call(home, "--json", "job", "new", "--title", "two [left] angles", "-p", ANGLE, *words)


def opened(home: Path) -> Station:
    return Station.open(home, ask=lambda prompt, confirm: PASSPHRASE)


def test_a_new_job_is_signed_as_it_was_asked_for(home: Path, tmp_path: Path) -> None:
    file = tmp_path / "cell.csv"
    file.write_text("raw,value [degree]\n0,0\n65535,360\n")
    words = (
        "--count", 5, "--station", "owner=3", "--not-before", "2026-01-01T00:00:00Z", *ENDS, "--calibration", file,
        "--assurance", "bus", "--sign", "owner", "--no-evidence", "--read-only", "1:5", "--read-only", "0:130",
        "--name", "angle {unit:03}", "--output", tmp_path / "job.jws",
    )  # fmt: skip
    plan = new(home, *words, "--dry-run").json
    assert not (tmp_path / "job.jws").exists()
    assert ask(home, "job", "list") == {"jobs": []}
    assert (plan["state"], plan["H"]) == ("draft", "")
    made = new(home, *words).json
    with opened(home) as station:
        key, digest = station.fingerprint, made["calibration"]["sha256"]
        assert open_job((tmp_path / "job.jws").read_bytes(), lambda _: station.point).hash == made["H"]
    assert {name: made[name] for name in made if name not in ("id", "profile_sha256", "H")} == {
        "format": made["format"],
        "registry": "6f1c0a52-6f0e-4c1b-8a55-0d9ce5609c29",
        "title": "two [left] angles",
        "profile": ANGLE,
        "calibration": {"rule": "one", "sha256": digest},
        "nodes": {"count": 5},
        "not_before": "2026-01-01T00:00:00Z",
        "ends": "2099-01-01T00:00:00Z",
        "stations": {key: 3},
        "assurance": "bus",
        "sign": key,
        "evidence": False,
        "read_only": [[1, 5], [0, 130]],
        "name": "angle {unit:03}",
        "state": "open",
        "units": 0,
        "passed": 0,
    }
    usual = new(home, "--count", 2, "--station", "owner", *ENDS).json
    chosen = ("stations", "assurance", "sign", "evidence", "read_only", "name", "calibration")
    assert [usual[name] for name in chosen] == [
        {key: 2}, "tap", "station", True, [], None, {"rule": "none"}
    ]  # fmt: skip
    age = new(home, "--count", 2, "--station", "owner", *ENDS, "--calibration-age", 90).json
    assert age["calibration"] == {"rule": "any", "max_age_days": 90}


def test_a_job_of_a_list_has_each_board_and_its_calibration(home: Path, tmp_path: Path) -> None:
    boards, folder = tmp_path / "boards.csv", tmp_path / "calibrations"
    boards.write_text(f"uuid,fingerprint\n{A.hex()},{'ab' * 32}\n{B.hex()},{'cd' * 32}\n")
    folder.mkdir()
    (folder / f"{A.hex()}.csv").write_text("raw,value [degree]\n0,0\n65535,360\n")
    (folder / f"{A.hex().upper()[:-1]}G.csv").write_text("no UUID")
    (folder / f"{C.hex()}.toml").mkdir()
    words = ("--list", boards, "--station", "owner", *ENDS, "--calibrations", folder)
    lacking = new(home, *words)
    assert (lacking.code, f"no calibration {B.hex()}.*" in lacking.json["error"]["message"]) == (3, True)
    (folder / f"{B.hex()}.csv").write_text("raw,value [degree]\n0,1\n65535,361\n")
    made = new(home, *words).json
    assert made["nodes"] == {
        "list": [{"uuid": A.hex(), "fingerprint": "ab" * 32}, {"uuid": B.hex(), "fingerprint": "cd" * 32}]
    }
    assert made["calibration"]["rule"] == "list"
    assert set(made["calibration"]["by_uuid"]) == {A.hex(), B.hex()}
    assert list(made["stations"].values()) == [2]
    for text in (f"uuid\n{A.hex()}\n", f"uuid,fingerprint\n{A.hex()},{'ab' * 16}\n"):
        boards.write_text(text)
        refused = new(home, *words)
        assert (refused.code, "full fingerprint (64 digits)" in refused.json["error"]["message"]) == (8, True)


def test_the_allotment_of_a_station_stands_after_the_last_sign_and_is_of_a_member() -> None:
    members = {"bench=2": "aa" * 32, "bench": "bb" * 32, "gone": "cc" * 32}
    roster: Any = SimpleNamespace(
        named=lambda name: SimpleNamespace(fingerprint=members[name]) if name in members else None,
        member=lambda fingerprint: "a member" if fingerprint != members["gone"] else None,
    )
    assert commands._allotment(roster, "bench=2=5", 9) == ("aa" * 32, 5)
    assert commands._allotment(roster, "bench=2", 9) == ("bb" * 32, 2)
    assert commands._allotment(roster, "bench", 9) == ("bb" * 32, 9)
    for name in ("gone", "nobody"):
        with pytest.raises(NotFoundError) as error:
            commands._allotment(roster, f"{name}=3", 9)
        assert (error.value.message, error.value.hint) == (
            f"The roster has no member {name!r}.", "See: teds-provision registry status"
        )  # fmt: skip


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ((), 2, "A job needs a number of boards or a list of boards."),
        (("--count", 2, "--list", "FILE"), 2, "A job needs a number of boards or a list of boards."),
        (("--count", 2, "--calibration", "FILE", "--calibration-age", 3), 2, "A job takes one calibration option."),
        (("--count", 2, "--calibrations", "."), 3, "There is no calibration UUID.* in .."),
        (("--count", 2, "--sign", "nobody"), 3, "The roster has no member 'nobody' with the role sign."),
        (("--count", 2, "--sign", "west"), 3, "The roster has no member 'west' with the role sign."),
        (("--count", 2, "--station", "owner"), 2, "Station owner is named twice."),
        (("--count", 2, "--station", "nobody"), 3, "The roster has no member 'nobody'."),
        (("--count", 2, "--station", "west=0"), 2, "'west=0': an allotment must be 1 or more."),
        (("--count", 2, "--station", "west=-1"), 2, "'west=-1': an allotment must be 1 or more."),
        (("--count", 2, "--station", "west="), 2, "'west=': an allotment must be 1 or more."),
        (("--count", 2, "--read-only", "1"), 2, "'1' is not CHANNEL:CODE, like 1:5."),
        (("--count", 2, "--read-only", "256:5"), 2, "'256:5' is not CHANNEL:CODE, like 1:5."),
        (("--count", 2, "--read-only", "1:256"), 2, "'1:256' is not CHANNEL:CODE, like 1:5."),
    ],
)
def test_what_no_job_can_say_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[Any, ...], code: int, message: str
) -> None:
    (tmp_path / "empty").mkdir()
    monkeypatch.chdir(tmp_path / "empty")
    file = tmp_path / "boards.csv"
    file.write_text(f"uuid,fingerprint\n{A.hex()},{'ab' * 32}\n")
    owner, west = alone(tmp_path / "owner"), alone(tmp_path / "west")
    with_west(owner, west)
    owner.close()
    west.close()
    given = [file if word == "FILE" else word for word in words]
    refused = new(tmp_path / "owner", "--station", "owner", *ENDS, *given)
    assert (refused.code, refused.json["error"]["message"]) == (code, message)
    assert ask(tmp_path / "owner", "job", "list") == {"jobs": []}


def with_west(owner: Station, west: Station) -> None:
    """Have the roster name a second station, of the same CA, without the role to sign."""
    owner.unlock()
    signature = owner.vault.ca().sign(station_key_message(west.point))
    roster = owner.plant.roster
    assert roster is not None
    more = Member("west", west.point, signature, frozenset(("line",)))
    join(owner, roster_of(owner, *roster.members, more, version=2, previous=roster.hash))


@pytest.mark.parametrize("text", ["1:5", "255:255", "0:0"])
def test_a_block_is_named_by_two_octets(text: str) -> None:
    channel, code = text.split(":")
    assert commands._block(text) == (int(channel), int(code))
    with pytest.raises(UsageError):
        commands._block(f"{text}:")
    with pytest.raises(UsageError):
        commands._block(f"-{text}")


ENDS_AT = datetime(2026, 3, 1, 12, tzinfo=UTC)
ID = "abcd1111-8a55-4d9c-8e56-09c29c295609"


def a_job(home: Path, **changes: Any) -> str:
    """Put one job with three units into the store; two of them passed."""
    with opened(home) as station:
        values = {"id": ID, "title": "[b]three[/] angles", "ends": ENDS_AT, "not_before": ENDS_AT.replace(month=2)}
        take_job(station, job_of(station, **(values | changes)))
        with station.transaction():
            for number, board, passed in ((1, A, 1), (2, B, 2), (3, C, 0)):
                station.plant.line.put_unit(UnitRow(ID, board, number, AT, max(1, passed), passed))
        return station.fingerprint


def test_jobs_are_listed_and_shown_as_they_are(home: Path) -> None:
    none = call(home, "job", "list")
    assert none.out == "There are no jobs yet. To create one, at a keeper: teds-provision job new\n"
    a_job(home)
    listed = call(home, "job", "list")
    assert [" ".join(line.split()) for line in listed.out.splitlines()] == [
        "id title profile boards passed here until state",
        f"abcd1111 [b]three[/] angles {ANGLE} 3 2 of 3 {local('2026-03-01T12:00:00+00:00')} open",
    ]
    digest = ask(home, "job", "show", "abcd")["profile_sha256"]
    assert call(home, "job", "show", "abcd").out.splitlines() == [
        f"job          {ID}",
        "title        [b]three[/] angles",
        "signed by    owner",
        f"profile      {ANGLE}  {digest[:16]}",
        "calibration  none",
        "boards       3; 3 given here",
        "stations     owner 3",
        f"from, until  {local('2026-02-01T12:00:00+00:00')}, {local('2026-03-01T12:00:00+00:00')}",
        "assurance    tap",
        "signs        each station",
        "evidence     yes",
        "state        open",
    ]
    alone_here = call(home, "job", "send", "abcd", "--dry-run")
    assert alone_here.out == "abcd1111 is for this station alone: nothing to send.\n"
    until = local("2026-03-01T12:00:00+00:00")
    would = call(home, "job", "close", "abcd", "--dry-run")
    assert would.out == f"Would close “[b]three[/] angles”, 3 × {ANGLE}, until {until}.\n"
    assert ask(home, "job", "show", "abcd")["state"] == "open"
    assert call(home, "job", "close", "abcd").out == f"Closed “[b]three[/] angles”, 3 × {ANGLE}, until {until}.\n"
    assert ask(home, "job", "show", "abcd")["state"] == "closed"


def test_a_job_of_a_keeper_who_is_in_no_roster_any_more_hides_no_other(home: Path, tmp_path: Path) -> None:
    a_job(home)
    other = alone(tmp_path / "other")
    gone = "ffff1111-8a55-4d9c-8e56-09c29c295609"
    octets = job_of(other, id=gone)
    other.close()
    with opened(home) as station, station.transaction():
        station.plant.line.add_job(JobRow(gone, "ab" * 32, octets))
    outcome = call(home, "--json", "job", "list")
    assert (outcome.code, [job["id"] for job in outcome.json["jobs"]]) == (0, [ID])
    assert outcome.err == "Warning: Job ffff1111 is left out: no roster that is known here names its signer.\n"


def test_evidence_is_listed_by_board_and_job(home: Path) -> None:
    none = call(home, "evidence", "list")
    assert none.out == "There is no evidence yet. To collect it: teds-provision provision --evidence\n"
    a_job(home)
    rows = [
        EvidenceRow("11" * 32, A, ID, 1, 1, "failed: no-node", AT, b"{}"),
        EvidenceRow("22" * 32, A, None, None, 2, "passed", AT, b"{}"),
    ]
    with opened(home) as station, station.transaction():
        station.nodes.remember(A)
        for row in rows:
            station.plant.line.add_evidence(row)
    shown = [
        {"uuid": A.hex(), "job": row.job, "unit": row.unit, "attempt": row.attempt, "verdict": row.verdict,
         "finished": AT, "sha256": row.sha256}
        for row in rows
    ]  # fmt: skip
    assert ask(home, "evidence", "list") == {"evidence": shown}
    assert ask(home, "evidence", "list", "--job", "abcd") == {"evidence": shown[:1]}
    assert ask(home, "evidence", "list", A.hex()[:6]) == {"evidence": shown}
    table = call(home, "evidence", "list").out.splitlines()
    assert [" ".join(line.split()) for line in table] == [
        "board job unit attempt verdict finished",
        f"{A.hex()} abcd1111 1 1 failed: no-node {local(AT)}",
        f"{A.hex()} 2 passed {local(AT)}",
    ]


# -- the figures of a job ----------------------------------------------------------------------------------------------


def test_the_figures_of_each_station(home: Path) -> None:
    """First-pass yield counts boards; seconds count attempts that passed; a signed board without a result is none."""
    own = a_job(home)
    other = "ee" * 32
    attempts = [
        Attempt(own, A, 1, 1, None, AT, {"sign": 1.0, "write": 4.0}),
        Attempt(own, B, 2, 2, None, AT, {"sign": 2.0}),
        Attempt(own, B, 2, 1, "no-node", AT, {"sign": 90.0}),
        Attempt(own, C, 3, 1, "no-node", AT, None),
        Attempt(own, C, 3, 2, "timeout", AT, None),
        Attempt(own, b"\4" * 10, 4, 1, "unreported", ""),
        Attempt(other, A, 1, 2, None, AT, {"sign": 7.0004}),
    ]
    with opened(home) as station:
        job = replace(open_job(next(row for row in station.plant.line.jobs()).octets, lambda _: station.point))
        parts = yield_stats(station, job, attempts)
        assert [part.to_json() for part in parts] == [
            {
                "station": own, "name": "owner", "allotment": 3, "units": 4, "passed": 2, "first_pass": 0.3333,
                "attempts": 5, "over": True, "failures": {"no-node": 2, "timeout": 1},
                "steps": {"sign": {"median": 1.5, "worst": 2.0}, "write": {"median": 4.0, "worst": 4.0}},
            },
            {
                "station": other, "name": parts[1].name, "allotment": 0, "units": 1, "passed": 1, "first_pass": 0.0,
                "attempts": 1, "over": True, "failures": {}, "steps": {"sign": {"median": 7.0, "worst": 7.0004}},
            },
        ]  # fmt: skip
        (nothing,) = yield_stats(station, job, [])
        assert (nothing.units, nothing.first_pass, nothing.over) == (0, None, False)
        assert to_csv(station, attempts[1:4]).splitlines() == [
            "station,name,uuid,unit,attempt,verdict,code,finished,seconds,sign",
            f"{own},owner,{B.hex()},2,2,passed,,{AT},2.000,2.0",
            f"{own},owner,{B.hex()},2,1,failed,no-node,{AT},90.000,90.0",
            f"{own},owner,{C.hex()},3,1,failed,no-node,{AT},,",
        ]


def test_the_status_of_a_job_as_a_table(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    own = a_job(home)
    parts = [
        StationYield(own, "[own]", 3, 4, 2, 1, 3, 5, steps={"[sign]": (1.5, 2.0)}),
        StationYield("ee" * 32, "west", 2),
        StationYield("ff" * 32, "east", 1),
    ]
    parts[0].failures.update({"[timeout]": 1, "no-node": 2})
    monkeypatch.setattr(commands.plant.yield_stats, "yield_stats", lambda *_: parts)
    shown = [" ".join(line.split()) for line in call(home, "job", "status", "abcd").out.splitlines()]
    assert shown == [
        "[b]three[/] angles: 2 of 3 passed",
        "station units of passed first pass failures",
        "[own] 4 over 3 2 33.3% 2 no-node, 1 [timeout]",
        "west 0 2 0",
        "east 0 1 0",
        "[own]: step median s worst s",
        "[sign] 1.50 2.00",
        "west, east: nothing received yet, neither pages nor evidence. To add evidence exported there: "
        "teds-provision job status abcd1111 DIR",
    ]
    assert json.loads(call(home, "--json", "job", "status", "abcd").out)["stations"][1]["name"] == "west"
    parts[0].attempts = 0
    assert "\nwest, east: nothing received yet" in call(home, "job", "status", "abcd").out, "this station knows its own"


def test_a_job_takes_no_datasheet_of_another_base(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def reached(*_: object) -> Any:
        raise PolicyError("It goes on.")

    a_job(home)
    with monkeypatch.context() as patch:
        patch.setattr(of_provision, "options_given", lambda *_: set())
        patch.setattr(of_provision.LineOptions, "begin", reached)
        done = call(home, "--json", "provision", "--job", "abcd", "--adopt", "--nfc", "udp:localhost:9")
        assert done.json["error"]["message"] == "It goes on.", "a setting is no order for this board"
    for words in (("--job", "abcd"), ("--job", "abcd", "--all")):
        refused = call(home, "--json", "provision", *words, "--adopt", "--nfc", "udp:localhost:9")
        assert (refused.code, refused.json["error"]["message"]) == (
            2,
            "The sheet or job already defines what each board gets.",
        )


@pytest.mark.parametrize(
    "words",
    [
        ("--profile", "load-cell"),
        ("--calibration", "cell.csv"),
        ("--no-calibration",),
        ("--name", "cell"),
        ("--accept-calibration", "it is so"),
        ("--retype",),
    ],
    ids=" ".join,
)
def test_what_a_job_determines_cannot_be_named_beside_it(home: Path, tmp_path: Path, words: tuple[str, ...]) -> None:
    a_job(home)
    (tmp_path / "cell.csv").write_text("raw,value [N]\n0,0\n65535,100\n")
    given = [word.replace("cell.csv", str(tmp_path / "cell.csv")) for word in words]
    refused = call(home, "--json", "provision", "--job", "abcd", *given, "--nfc", "udp:localhost:9")
    assert refused.code == 2
    error = refused.json["error"]
    assert error["message"] == "The job already defines what each board gets."
    assert words[0] in error["hint"]


@pytest.mark.parametrize(
    "words",
    [
        ("--calibrations", "."),
        ("--operator", "Eve"),
        ("--files", "."),
        ("--only", "verify"),
        ("--label-to", "."),
        ("--scan",),
    ],
    ids=" ".join,
)
def test_what_belongs_to_a_line_needs_a_job_or_evidence(home: Path, words: tuple[str, ...]) -> None:
    refused = call(home, "--json", "provision", *words, "--nfc", "udp:localhost:9")
    assert refused.code == 2
    assert refused.json["error"]["hint"] == "Add --job FILE, or --evidence."
    assert words[0] in refused.json["error"]["message"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--evidence", "--only", "verify"), "--only verify requires --job."),
        (("--evidence", "--batch", "s.csv"), "--batch cannot be combined with --job or --evidence."),
        (("--job", "abcd", "--batch", "s.csv"), "--batch cannot be combined with --job or --evidence."),
    ],
    ids=["only verify", "batch and evidence", "batch and job"],
)
def test_options_of_a_line_that_do_not_go_together(
    home: Path, tmp_path: Path, words: tuple[str, ...], message: str
) -> None:
    a_job(home)
    (tmp_path / "s.csv").write_text("uuid,name\n8d4d9da65281f7000001,a\n")
    given = [word.replace("s.csv", str(tmp_path / "s.csv")) for word in words]
    refused = call(home, "--json", "provision", *given, "--nfc", "udp:localhost:9")
    assert (refused.code, refused.json["error"]["message"]) == (2, message)


def test_a_dry_run_of_an_export_of_evidence_makes_no_folder(home: Path, tmp_path: Path) -> None:
    folder = tmp_path / "proofs"
    with opened(home) as station:
        assert export(station, [], folder, write=False) == {}
        assert not folder.exists()
        assert export(station, [], folder) == {}
        assert folder.is_dir()


# -- what a run of provision is made of --------------------------------------------------------------------------------


def begun(
    station: Station, monkeypatch: pytest.MonkeyPatch, *, sign: str = "station", report: bool = False, **given: Any
) -> tuple[LineRun | None, list[Any]]:
    """Begin a run with these options; return its line, and which office it asks, by which way."""
    offices: list[Any] = []
    office = SimpleNamespace(close=lambda: None)
    monkeypatch.setattr(
        plant.sign_requests, "JoinedOffice", lambda _base, wait: offices.append(("joined", wait)) or office
    )
    monkeypatch.setattr(plant.sign_requests, "transport_for", lambda _base, files: files)
    monkeypatch.setattr(
        plant.sign_requests, "RemoteOffice", lambda _base, files, wait: offices.append((files, wait)) or office
    )
    if given.get("job") is not None:
        given["job"] = take_job(station, job_of(station, sign=sign)).id
    none: dict[str, Any] = dict.fromkeys(("job", "calibrations", "files", "only", "label_to", "operator"))
    options = LineOptions(**none | {"label_format": "svg", "scan": False, "evidence": False} | given)
    app: Any = SimpleNamespace(note=print, closing=offices.append)
    request = ProvisionRequest(report=Path("day.csv") if report else None)
    line = options.begin(app, station, request, LinkSettings(timeout=7.0))
    assert (line is None or line.office is None) == (offices == [])
    if line is not None and line.office is not None:
        assert (line.office, offices.pop()) == (office, office.close)
    return line, offices


def test_a_run_has_what_its_options_say(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with opened(home) as station:
        assert begun(station, monkeypatch) == (None, [])
        assert begun(station, monkeypatch, operator="Ada", report=True) == (None, []), "the report names who worked"
        line, _ = begun(station, monkeypatch, evidence=True, operator="Ada", label_to=tmp_path, label_format="png")
        assert line is not None
        assert (line.job, line.operator, line.label_to, line.only_verify) == (
            None, "Ada", tmp_path / "label.png", False
        )  # fmt: skip
        line, _ = begun(station, monkeypatch, job="x", only="verify", calibrations=tmp_path)
        assert line is not None
        assert line.job is not None
        assert (line.only_verify, line.calibrations, line.label_to, line.scans) == (True, tmp_path, None, None)


@pytest.mark.parametrize("job", ["x", None])
def test_a_scanner_is_read_beside_the_run(home: Path, monkeypatch: pytest.MonkeyPatch, job: str | None) -> None:
    read = threading.Event()
    monkeypatch.setattr(Scans, "listen", lambda _own: read.set())
    with opened(home) as station:
        line, _ = begun(station, monkeypatch, job=job, evidence=job is None, scan=True)
    assert line is not None
    assert line.scans is not None
    assert read.wait(PATIENCE)


@pytest.mark.parametrize(
    ("sign", "files", "asks"),
    [
        ("station", None, []),
        ("own", Path("stick"), []),
        ("ee" * 32, None, [("joined", 7.0)]),
        ("ee" * 32, Path("stick"), [(Path("stick"), 7.0)]),
    ],
)
def test_the_office_of_a_job_is_asked_through_the_folder_that_is_named_else_through_the_registry(
    home: Path, monkeypatch: pytest.MonkeyPatch, sign: str, files: Path | None, asks: list[Any]
) -> None:
    with opened(home) as station:
        by = station.fingerprint if sign == "own" else sign
        assert begun(station, monkeypatch, job="x", sign=by, files=files)[1] == asks


def test_a_board_that_is_adopted_gets_what_no_sheet_or_job_says(home: Path, tmp_path: Path) -> None:
    (tmp_path / "s.csv").write_text("uuid,name\n8d4d9da65281f7000001,a\n")
    for words in (("--job", "abcd"), ("--batch", str(tmp_path / "s.csv"))):
        refused = call(home, "--json", "provision", "--adopt", *words, "--nfc", "udp:localhost:9")
        assert (refused.code, refused.json["error"]["message"]) == (
            2, "The sheet or job already defines what each board gets.",
        )  # fmt: skip


@pytest.mark.parametrize("output", [True, False])
def test_a_request_for_a_file_is_written_and_one_that_no_office_answers_is_5(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, output: bool
) -> None:
    asked: list[Any] = []

    def sign_by_office(_station: object, _links: object, order: Any, _reporter: object) -> Any:
        asked.append(order)
        raise plant.sign_requests.OfficeSilentError("No answer.", hint="Wait.")

    monkeypatch.setattr(plant.sign_requests, "sign_by_office", sign_by_office)
    file = tmp_path / "request.jws"
    words = ("sign", A.hex(), "--by", "office", "--job", "abcd", *(("--output", file) if output else ()))
    done = call(home, *words)
    if output:
        assert (done.code, done.out) == (0, f"Wrote the request to {file}. Wait.\n")
    else:
        assert (done.code, "No answer." in done.err) == (5, True)
    (order,) = asked
    assert (order.node, order.by, order.job, order.output) == (A.hex(), "office", "abcd", file if output else None)
    signed = SimpleNamespace(image=SimpleNamespace(uuid=A), sequence=9, reused=True)
    monkeypatch.setattr(plant.sign_requests, "sign_by_office", lambda *_: signed)
    assert call(home, "--json", *words).json == {
        "uuid": A.hex(), "sequence": 9, "signed_by": "office", "reused": True
    }  # fmt: skip
