"""The line by its commands: a job is made, worked on, and shown; the evidence is files that anybody checks."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from teds_provision.protocol.keys import to_pem
from teds_provision.station.station import Station as InMemory
from teds_provision.station.station import initialise
from tests.bench import PASSPHRASE
from tests.cli.shell import set_passphrase
from tests.e2e.desk import PROGRAM, Desk, Links, Station
from tests.places import free_reader
from tests.vault.softhsm import PIN, loaded, unload

from .owner import ALL, ANGLE, alone, join, member, roster_of
from .stations import certified

pytestmark = pytest.mark.link
ENDS = ("--ends", "2099-01-01")


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("stations")
    alone(folder / "owner").close()
    return folder


@pytest.fixture
def desk(tmp_path: Path, prepared: Path) -> Iterator[Desk]:
    desk = Desk(tmp_path, prepared)
    yield desk
    desk.clear()


@pytest.fixture
def owner(desk: Desk) -> Station:
    return desk.station("owner")


def new_job(owner: Station, *more: object) -> dict[str, object]:
    made = owner.ask("job", "new", "--title", "two angles", "--profile", ANGLE, "--station", "owner", *ENDS, *more)
    return dict(made)


def test_from_an_order_to_boards_with_proof(desk: Desk, owner: Station, tmp_path: Path) -> None:
    job = new_job(owner, "--count", 2, "--name", "angle {unit:03}", "--output", tmp_path / "two.jws")
    assert (job["nodes"], job["state"]) == ({"count": 2}, "open")
    for number in (1, 2):
        node = desk.node(f"node{number}").start()
        done = owner.provision("nfc", "--job", tmp_path / "two.jws", "--operator", "A. Meier")
        assert (done["verdict"], done["unit"], done["of"], done["attempt"]) == ("authentic", number, 2, 1)
        assert (done["name"], done["job"]) == (f"angle 00{number}", job["id"])
        node.stop()
    third = desk.node("third").start()
    before = third.octets
    refused = owner.refuses("provision", "--job", str(job["id"])[:8], "--yes", *desk.links.over("nfc"), code=6)
    assert "one too many" in refused["message"]
    assert third.octets == before
    assert owner.ask("evidence", "export", tmp_path / "proof", "--job", job["id"])["written"] == 2
    again = owner.ask("evidence", "export", tmp_path / "proof")
    assert (again["files"], again["written"]) == (2, 0)
    (tmp_path / "ca.pem").write_text(to_pem(_ca(owner)))
    done = owner.run("--json", "evidence", "verify", tmp_path / "proof", "--ca", tmp_path / "ca.pem")
    assert (done.code, json.loads(done.out.splitlines()[-1])["totals"]) == (0, {"files": 2, "passed": 2})
    reply = owner.ask("job", "status", job["id"], "--csv", tmp_path / "attempts.csv")
    (part,) = reply["stations"]
    assert (part["units"], part["passed"], part["first_pass"], part["over"]) == (2, 2, 1.0, False)
    assert list(part["steps"])[-1] == "check"
    assert len((tmp_path / "attempts.csv").read_text().splitlines()) == 3
    assert "2 of 2 passed" in owner.run("job", "status", job["id"]).out
    assert [job["passed"] for job in owner.ask("job", "list")["jobs"]] == [2]
    assert owner.ask("job", "close", job["id"])["state"] == "closed"
    assert {node["profile"] for node in owner.ask("nodes", "--profile", ANGLE)["nodes"]} == {ANGLE}
    assert owner.log_is_whole()


def test_what_no_reader_would_take_is_refused_when_a_job_is_made(owner: Station) -> None:
    """Allotments add up to at most the boards: one station's alone, or those of two; a plan says it too."""
    begin = ("job", "new", "--title", "two angles", "--profile", ANGLE, *ENDS, "--count", 2)
    for more in (("--station", "owner=3"), ("--station", "owner=3", "--dry-run")):
        assert "allotments of more than the 2 boards" in owner.refuses(*begin, *more, code=8)["message"]
    twice = owner.refuses(*begin, "--station", "owner=1", "--station", "owner=1", code=2)
    assert "named twice" in twice["message"]
    two_rules = ("--station", "owner", "--calibration-age", 3, "--calibration", __file__)
    assert "--calibration and --calibration-age" in owner.refuses(*begin, *two_rules, code=2)["hint"]
    assert owner.ask("job", "list")["jobs"] == []


def test_a_bench_goes_on_until_it_is_told_to_stop(desk: Desk, owner: Station) -> None:
    job = new_job(owner, "--count", 2)
    running = owner.start("--json", "provision", "--job", job["id"], "--watch", "--yes", *desk.links.over("nfc"))
    lines = []
    for number in (1, 2, 3):
        node = desk.node(f"node{number}").start()
        lines = running.wait_for_lines(number)
        node.stop()
    running.signal(2)
    running.end()
    assert [line.get("unit") for line in lines] == [1, 2, None]
    assert lines[2]["error"]["code"] == "refused"


def test_a_bus_of_boards_gets_as_many_units_as_the_job_has(desk: Desk, owner: Station) -> None:
    """Three boards at once, two units: nobody gets the third."""
    job = new_job(owner, "--count", 2, "--assurance", "uuid")
    boards = [desk.node(f"node{number}").start(nfc=False, can=True) for number in (1, 2, 3)]
    for board in boards:
        owner.ask("whitelist", "add", board.uuid)
    words = ["--json", "provision", "--all", "--yes", "--job", job["id"], *desk.links.over("can")]
    done = owner.run(*words)
    assert done.code == 6, done
    lines = [line for line in map(json.loads, done.out.splitlines()) if "uuid" in line]
    assert sorted(line.get("unit", 0) for line in lines) == [0, 1, 2]
    (refused,) = [line for line in lines if "unit" not in line]
    assert "one too many" in refused["error"]["message"]
    assert [board.flash["key"] is None for board in boards].count(True) == 1
    (part,) = owner.ask("job", "status", job["id"])["stations"]
    assert (part["units"], part["passed"]) == (2, 2)


def test_two_readers_share_the_units_of_a_job(desk: Desk, owner: Station) -> None:
    job = new_job(owner, "--count", 1)
    readers = [desk.links.nfc, free_reader()]
    named = [word for reader in readers for word in ("--nfc", reader)]
    running = owner.start("--json", "provision", "--job", job["id"], "--watch", "--yes", *named)
    for number, reader in enumerate(readers):
        desk.links = Links(nfc=reader, can=desk.links.can)
        desk.node(f"node{number}").start()
    lines = running.wait_for_lines(2)
    running.signal(15)
    assert running.end().code == 6
    assert sorted(line.get("unit", 0) for line in lines) == [0, 1]
    assert [line["error"]["code"] for line in lines if "error" in line] == ["refused"]
    assert owner.log_is_whole()


@pytest.mark.system
def test_evidence_on_a_full_disk_is_whole_or_absent(desk: Desk, owner: Station, tmp_path: Path) -> None:
    """There is room for one file; then for all, and the same command carries on."""
    for number in (1, 2):
        node = desk.node(f"node{number}").start()
        owner.provision("nfc", "--evidence", "--profile", ANGLE)
        node.stop()
    proof = tmp_path / "proof"
    proof.mkdir()
    mounted = (
        'mount -t tmpfs -o size=8192,mode=755 tmpfs "$0" && { "$@"; ended=$?; cat "$0"/*; ls -A "$0"; exit $ended; }'
    )
    small = ("unshare", "--mount", "--map-root-user", "sh", "-c", mounted, str(proof))
    if subprocess.run([*small, "true"], capture_output=True, check=False).returncode not in (0, 1, 2):
        pytest.skip("a small file system cannot be mounted here")
    done = owner.run("--json", "evidence", "export", proof, program=(*small, *PROGRAM))
    assert done.code == 7, done
    error, *files = done.out.splitlines()
    assert json.loads(error)["error"]["code"] == "store"
    assert len(files) == 1, "one whole document, and its name behind it"
    document, _, name = files[0].rpartition("}")
    assert json.loads(document + "}").keys() == {"payload", "payloadType", "signatures"}
    assert name.endswith(".1.json")
    assert owner.ask("evidence", "export", proof)["written"] == 2


def test_a_job_and_what_it_says_are_not_both_named(owner: Station) -> None:
    job = new_job(owner, "--count", 2)
    owner.refuses("provision", "--job", str(job["id"]), "--profile", ANGLE, "--yes", code=2)
    owner.refuses("provision", "--calibrations", "x", "--yes", code=2)
    owner.refuses("job", "show", "ffff", code=3)
    owner.refuses("job", "new", "--title", "x", "--profile", ANGLE, "--station", "owner", *ENDS, code=2)


def test_no_job_is_made_of_a_profile_that_cannot_be_built(owner: Station) -> None:
    folder = owner.home / "profiles"
    folder.mkdir(exist_ok=True)
    (folder / "broken.toml").write_text('title = "Broken"\nextends = "smart-sensor"\nchannels = 3\n')
    more = ("--title", "x", "--station", "owner", "--count", 1, *ENDS)
    assert "no channel" in owner.refuses("job", "new", "--profile", "broken", *more, code=8)["message"]
    assert "only a base" in owner.refuses("job", "new", "--profile", "smart-sensor", *more, code=8)["message"]
    assert owner.ask("job", "list")["jobs"] == []


def test_a_killed_line_gives_no_unit_twice(desk: Desk, owner: Station) -> None:
    """Killed when each step has ended, in turn; the same command carries on."""
    job = new_job(owner, "--count", 1)
    desk.node().start()
    words = ["provision", "--job", job["id"], "--yes", *desk.links.over("nfc")]
    for step in ("identify", "whitelist", "agree", "build", "sign", "write", "verify"):
        running = owner.start(*words)
        running.wait_for(f" {step}")
        running.process.kill()
        running.end()
    done = owner.ask(*words)
    assert (done["verdict"], done["unit"]) == ("authentic", 1)
    (part,) = owner.ask("job", "status", job["id"])["stations"]
    assert (part["units"], part["passed"]) == (1, 1)
    assert owner.log_is_whole()


def test_only_a_keeper_makes_a_job(desk: Desk, owner: Station, prepared: Path) -> None:
    with closing(_opened(owner)) as station:
        roster = station.plant.roster
        assert roster is not None
        join(station, roster_of(station, member(station, "owner", *ALL[1:]), version=2, previous=roster.hash))
    more = ("--title", "x", "--profile", ANGLE, "--station", "owner", "--count", 1)
    refused = owner.refuses("job", "new", *more, *ENDS, code=6)
    assert (refused["message"], refused["hint"]) == (
        "This station is not a keeper, so no station would accept its job.", "Ask a keeper."
    )  # fmt: skip


def _opened(owner: Station) -> InMemory:
    return InMemory.open(owner.home, ask=lambda prompt, confirm=False: PASSPHRASE)


def _ca(owner: Station) -> bytes:
    with closing(_opened(owner)) as station:
        return station.identity.ca


@pytest.fixture
def west(desk: Desk, owner: Station) -> Station:
    """Return a line that signs nothing itself, beside the owner's office."""
    folder = desk.folder / "west"
    with closing(_opened(owner)) as station:
        made = certified(folder, "west", station)
        roster = station.plant.roster
        assert roster is not None
        members = (member(station, "owner", *ALL), member(made, "west", "line"))
        new = roster_of(station, *members, version=2, previous=roster.hash)
        for any_station in (station, made):
            join(any_station, new)
        made.close()
    return Station(desk, folder)


def test_an_office_signs_for_a_line_over_a_folder(desk: Desk, owner: Station, west: Station, tmp_path: Path) -> None:
    stick, job = tmp_path / "stick", tmp_path / "two.jws"
    stick.mkdir()
    more = ("--count", 2, "--output", job, "--sign", "owner")
    made = owner.ask("job", "new", "--title", "two", "--profile", ANGLE, "--station", "west", *ENDS, *more)
    office = owner.start("--json", "signer", "run", "--job", made["id"], "--files", stick)
    node = desk.node().start()
    done = west.provision("nfc", "--job", job, "--files", stick)
    assert (done["verdict"], done["unit"]) == ("authentic", 1)
    (line,) = office.wait_for_lines(1)
    assert (line["uuid"], line["sequence"]) == (node.uuid, 1)
    office.signal(15)
    assert office.end().code == 0
    node.stop()
    # the office is away: its request is a file
    other = desk.node("other").start()
    late = west.refuses("provision", "--job", job, "--files", stick, "--yes", "--timeout", 1, *nfc(desk), code=5)
    assert late["code"] == "no-answer"
    west.ask("build", other.uuid, "--profile", ANGLE)
    asked = tmp_path / "request.jws"
    assert west.ask("sign", other.uuid, "--by", "owner", "--job", job, "--output", asked, *nfc(desk))["request"]
    assert owner.ask("signer", "once", asked, "--output", tmp_path / "signed.json")["sequence"] == 1
    west.ask("agree", other.uuid, "--rotate", "--yes", *nfc(desk))
    stale = west.refuses("write", other.uuid, "--image", tmp_path / "signed.json", *nfc(desk), code=6)
    assert "--by OFFICE" in stale["hint"], "this station may not sign it itself"
    anew = tmp_path / "anew.jws"
    assert west.ask("sign", other.uuid, "--by", "owner", "--job", job, "--output", anew, *nfc(desk))["request"]
    owner.ask("signer", "once", anew, "--output", tmp_path / "anew.json")
    west.ask("write", other.uuid, "--image", tmp_path / "anew.json", *nfc(desk))
    done = west.provision("nfc", "--job", job, "--files", stick)
    assert (done["verdict"], done["attempt"]) == ("authentic", 2)
    shown = owner.run("job", "status", made["id"]).out
    assert "west: nothing received yet" in shown, "0 units only means that its pages are not here"
    west.ask("evidence", "export", tmp_path / "proof")
    assert "nothing received" not in owner.run("job", "status", made["id"], tmp_path / "proof").out


def test_an_office_follows_the_registry_to_another_place(
    desk: Desk, owner: Station, west: Station, tmp_path: Path
) -> None:
    """It went on looking at the old one without a word, and the line waited."""
    old, new, job = tmp_path / "old", tmp_path / "new", tmp_path / "one.jws"
    old.mkdir()
    new.mkdir()
    for station in (owner, west):
        station.ask("registry", "connect", "--files", old, "--yes")
        station.run("registry", "sync")
    more = ("--count", 1, "--output", job, "--sign", "owner")
    made = owner.ask("job", "new", "--title", "one", "--profile", ANGLE, "--station", "west", *ENDS, *more)
    office = owner.start("signer", "run", "--job", made["id"])
    office.wait_for("Signing for 1 job")
    for station in (owner, west):
        station.ask("registry", "connect", "--files", new, "--yes")
    node = desk.node().start()
    assert west.provision("nfc", "--job", job)["verdict"] == "authentic"
    office.wait_for(node.uuid)
    office.signal(15)
    assert office.end().code == 0


def test_an_office_ends_when_passphrase_and_master_key_were_changed(owner: Station, tmp_path: Path) -> None:
    """It cannot open the vault again: it signs nothing more by the key that it holds, and ends with 7."""
    job, stick = new_job(owner, "--count", 1), tmp_path / "stick"
    stick.mkdir()
    office = owner.start("signer", "run", "--job", job["id"], "--files", stick)
    office.wait_for("Signing for 1 job")
    old, owner.passphrase = owner.passphrase, "a new one for all"
    assert old is not None
    assert set_passphrase(owner.home, old, owner.passphrase).code == 0
    owner.run("vault", "rewrap")
    outcome = office.end()
    assert (outcome.code, "changed" in outcome.err) == (7, True), outcome


def test_an_office_waits_while_its_folder_or_registry_is_out_of_reach(
    desk: Desk, owner: Station, west: Station, tmp_path: Path
) -> None:
    """A database that restarted ended the office: the line stood still until a person started it again."""
    stick, job = tmp_path / "stick", tmp_path / "one.jws"
    (stick / "to").mkdir(parents=True)
    more = ("--count", 1, "--output", job, "--sign", "owner")
    made = owner.ask("job", "new", "--title", "one", "--profile", ANGLE, "--station", "west", *ENDS, *more)
    office = owner.start("--json", "signer", "run", "--job", made["id"], "--files", stick)
    (stick / "to").rmdir()
    (stick / "to").symlink_to("to")  # a loop: reading it fails, for root too
    office.wait_for("Requests wait")
    (stick / "to").unlink()
    office.wait_for("signing continues")
    node = desk.node().start()
    assert west.provision("nfc", "--job", job, "--files", stick)["verdict"] == "authentic"
    assert office.wait_for_lines(1)[0]["uuid"] == node.uuid
    office.signal(15)
    assert office.end().code == 0


@pytest.mark.system
@pytest.mark.slow
@pytest.mark.nightly(
    "tests/plant/test_line_commands.py::test_an_office_signs_for_a_line_over_a_folder; what signs in a token is held "
    "by tests/vault/token/test_token_keys.py::test_the_station_key_and_the_ca_key_sign_low_s_and_verify"
)
def test_an_office_whose_key_is_in_a_token_signs_for_a_line(
    desk: Desk, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its key is in SoftHSM; the line, whose role is not to sign, makes authentic boards through it."""
    (tmp_path / "hsm").mkdir()
    uri = loaded(tmp_path / "hsm", monkeypatch, ("office",))["office"]
    station, _ = initialise(desk.folder / "office", name="office", keystore=uri, ask=lambda prompt, confirm: PIN)
    try:
        made = certified(desk.folder / "west", "west", station)
        roster = roster_of(station, member(station, "office", *ALL), member(made, "west", "line"))
        for any_station in (station, made):
            join(any_station, roster)
        made.close()
    finally:
        station.close()
        unload()
    office, west = Station(desk, desk.folder / "office", PIN), Station(desk, desk.folder / "west")
    stick, job = tmp_path / "stick", tmp_path / "one.jws"
    stick.mkdir()
    more = ("--count", 1, "--output", job, "--sign", "office")
    named = office.ask("job", "new", "--title", "one", "--profile", ANGLE, "--station", "west", *ENDS, *more)
    signer = office.start("--json", "signer", "run", "--job", named["id"], "--files", stick)
    node = desk.node().start()
    done = west.provision("nfc", "--job", job, "--files", stick)
    assert (done["verdict"], done["unit"]) == ("authentic", 1)
    assert signer.wait_for_lines(1)[0]["uuid"] == node.uuid
    signer.signal(15)
    assert signer.end().code == 0
    # and by a file
    west.ask("build", node.uuid, "--profile", ANGLE, "--name", "another")
    asked, signed = tmp_path / "request.jws", tmp_path / "signed.json"
    west.ask("sign", node.uuid, "--by", "office", "--job", job, "--output", asked, *nfc(desk))
    assert office.ask("signer", "once", asked, "--output", signed)["sequence"] == 2
    west.ask("write", node.uuid, "--image", signed, *nfc(desk))
    assert west.ask("verify", node.uuid, *nfc(desk))["verdict"] == "authentic", "west may not sign: the office did"


def nfc(desk: Desk) -> list[str]:
    return desk.links.over("nfc")


def test_the_demo_of_a_line_ends_as_it_says(desk: Desk) -> None:
    report = desk.start("--json", "demo", "--line").end().json
    assert (report["passed"], report["refused"]) == (3, ["wrong-board", "one too many"])
    assert report["evidence"] == {"passed": 4, "failed": 1}
    assert [step["name"] for step in report["steps"]][-1] == "evidence"
