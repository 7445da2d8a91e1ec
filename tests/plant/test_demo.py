from __future__ import annotations

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from teds_provision.errors import LinkError, TedsProvisionError
from teds_provision.plant.demo import cluster, line, plant
from teds_provision.plant.sync import SyncResult
from teds_provision.provisioning.progress import SilentReporter

BY_DATABASE = pytest.mark.nightly(
    "tests/plant/test_demo.py::test_three_stations_share_a_key_and_refuse_what_the_stolen_one_signs[files]; every test "
    "with a database runs the demo's server, and syncs as tests/plant/test_synced_by_database.py does"
)


@pytest.mark.link
@pytest.mark.parametrize(
    "driver", [pytest.param(True, marks=[pytest.mark.system, BY_DATABASE]), False], ids=["postgresql", "files"]
)
def test_three_stations_share_a_key_and_refuse_what_the_stolen_one_signs(
    driver: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By files, with a word, also where a server is installed and its driver is not."""
    if driver and cluster.programs() is None:
        pytest.skip("no PostgreSQL 15 here (scripts/install-test-packages)")
    if not driver:
        monkeypatch.setattr(plant, "find_spec", lambda _name: None)
    messages: list[str] = []
    done = plant.run_plant_demo(SilentReporter(), messages.append)
    assert (done.by, done.before, done.after) == ("postgresql" if driver else "files", "authentic", "not authentic")
    assert ("No psycopg (the extra registry) is installed here" in messages[0]) == (not driver)
    assert all(step.result != "failed" for step in done.steps)


# -- the server of the demo and of the tests ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("uid", "users", "user"),
    [(0, {"postgres"}, "postgres"), (0, {"me"}, None), (1000, {"me", "postgres"}, "me"), (1000, {"postgres"}, None)],
)
def test_as_root_the_server_runs_as_postgres_and_else_as_this_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uid: int, users: set[str], user: str | None
) -> None:
    def named(name: str) -> Any:
        if name not in users:
            raise KeyError(name)
        return SimpleNamespace(pw_name=name)

    monkeypatch.setattr(cluster.os, "geteuid", lambda: uid)
    monkeypatch.setattr(
        cluster, "pwd", SimpleNamespace(getpwnam=named, getpwuid=lambda of: SimpleNamespace(pw_name=f"m{of and 'e'}"))
    )
    monkeypatch.setattr(cluster, "_ROOMS", tmp_path)
    assert cluster.runs_as() == user
    for version, newest in (("14", None), ("x", None), ("15", "15"), ("9", "15"), ("100", "100"), ("17", "100")):
        (tmp_path / version / "bin").mkdir(parents=True)
        (tmp_path / version / "bin" / "postgres").touch()
        expected = tmp_path / newest / "bin" if newest is not None and user is not None else None
        assert cluster.programs() == expected


@pytest.mark.parametrize(("uid", "user"), [(0, "postgres"), (1000, "me"), (0, None)])
def test_only_its_user_reads_the_servers_key_and_it_is_reached_by_tls_on_this_machine(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, uid: int, user: str | None
) -> None:
    owners, ran = dict[str, str](), list[tuple[str, ...]]()
    made = cluster.Cluster(tmp_path / "own", 54321, tmp_path)

    def run(_made: Any, *words: str, stdin: str = "") -> Any:
        ran.append(words)
        (tmp_path / "own" / "data").mkdir()

    monkeypatch.setattr(cluster.os, "geteuid", lambda: uid)
    monkeypatch.setattr(cluster, "runs_as", lambda: user)
    monkeypatch.setattr(cluster.shutil, "chown", lambda path, owner: owners.update({path.name: owner}))
    monkeypatch.setattr(cluster, "_tls", lambda: (b"key", b"certificate"))
    monkeypatch.setattr(cluster.Cluster, "_run", run)
    made.make()
    data = tmp_path / "own" / "data"
    assert ran == [(
        "initdb", "-D", str(data), "-U", "postgres", "--no-sync", "--no-instructions", "--auth=trust",
        "--encoding=UTF8", "--locale=C",
    )]  # fmt: skip
    modes = {path.name: path.stat().st_mode & 0o777 for path in data.iterdir()}
    assert modes == {"server.key": 0o600, "server.crt": 0o644, "pg_hba.conf": 0o600, "postgresql.conf": 0o600}
    assert (data / "server.key").read_bytes() == b"key"
    assert (data / "server.crt").read_bytes() == made.root_certificate.read_bytes() == b"certificate"
    hba = "local all postgres trust\nhostssl all all 127.0.0.1/32 scram-sha-256\n"
    assert (data / "pg_hba.conf").read_text() == hba
    settings = (data / "postgresql.conf").read_text().splitlines()
    assert {
        "listen_addresses = '127.0.0.1'", "ssl = 'on'", "ssl_min_protocol_version = 'TLSv1.3'", "port = '54321'",
        f"unix_socket_directories = '{tmp_path / 'own' / 's'}'", "password_encryption = 'scram-sha-256'",
    } <= set(settings)  # fmt: skip
    assert owners == (dict.fromkeys([*modes, "own", "s"], user) if uid == 0 and user is not None else {})
    assert made.url("plant") == f"postgresql://localhost:54321/plant?sslrootcert={tmp_path / 'own' / 'root.crt'}"


@pytest.mark.parametrize(("ended", "clock", "looks"), [(None, [0, 1, 60.1], 2), (3, [0], 1)])
def test_a_server_that_does_not_start_is_reported_with_the_end_of_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ended: int | None, clock: list[float], looks: int
) -> None:
    asked, times = list[list[str]](), iter(clock)
    (tmp_path / "log").write_text("x" * 600 + "y" * 500)
    monkeypatch.setattr(cluster.shutil, "which", lambda _: None)
    monkeypatch.setattr(cluster, "time", SimpleNamespace(monotonic=lambda: next(times), sleep=lambda _: None))
    monkeypatch.setattr(cluster.subprocess, "Popen", lambda *_, **__: SimpleNamespace(poll=lambda: ended))
    monkeypatch.setattr(
        cluster.subprocess, "run", lambda words, check: asked.append(words) or SimpleNamespace(returncode=2)
    )
    with pytest.raises(TedsProvisionError) as error:
        cluster.Cluster(tmp_path, 54321, Path("/bin")).start()
    assert error.value.message == f"PostgreSQL did not start: {'y' * 500}"
    assert asked == [["/bin/pg_isready", "-q", "-h", str(tmp_path / "s"), "-p", "54321"]] * looks


@pytest.mark.parametrize("setpriv", [True, False])
def test_the_server_ends_with_the_demo_and_neither_by_ctrl_c_nor_in_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, setpriv: bool
) -> None:
    started, answers = list[Any](), iter([2, 0])

    def popen(words: list[str], *, stdout: Any, stderr: Any, **how: Any) -> Any:
        assert stdout is stderr
        stdout.write(b"started\n")
        started.append((words, how))
        return SimpleNamespace(poll=lambda: None)

    monkeypatch.setattr(cluster.shutil, "which", lambda name: f"/bin/{name}" if setpriv and name == "setpriv" else None)
    monkeypatch.setattr(cluster, "time", SimpleNamespace(monotonic=lambda: 0.0, sleep=lambda _: None))
    monkeypatch.setattr(cluster.subprocess, "Popen", popen)
    monkeypatch.setattr(cluster.subprocess, "run", lambda words, check: SimpleNamespace(returncode=next(answers)))
    monkeypatch.setattr(cluster, "runs_as", lambda: "me")
    monkeypatch.setattr(cluster.os, "geteuid", lambda: 0 if setpriv else 1000)
    (tmp_path / "log").write_bytes(b"made\n")
    cluster.Cluster(tmp_path, 54321, Path("/bin")).start()
    before = ["setpriv", "--pdeathsig", "INT", "--"] if setpriv else []
    [(words, how)] = started
    assert words == [*before, "/bin/postgres", "-D", str(tmp_path / "data")]
    assert how == {
        "stdin": subprocess.DEVNULL, "cwd": "/", "start_new_session": True, "user": "me" if setpriv else None
    }  # fmt: skip
    assert (tmp_path / "log").read_bytes() == b"made\nstarted\n"


@pytest.mark.parametrize("fails", [True, False])
def test_the_server_ends_with_its_block_however_that_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fails: bool
) -> None:
    done = list[str]()
    for name in ("make", "start", "stop"):
        monkeypatch.setattr(cluster.Cluster, name, lambda _, name=name: done.append(name))

    def block() -> None:
        with cluster.running(tmp_path, 54321, tmp_path) as made:
            assert (made.folder, made.port, made.bin) == (tmp_path, 54321, tmp_path)
            done.append("block")
            if fails:
                raise LinkError("A step failed.")

    if fails:
        with pytest.raises(LinkError):
            block()
    else:
        block()
    assert done == ["make", "start", "block", "stop"]


def test_sql_of_the_demo_runs_as_the_superuser_and_a_failure_has_the_servers_words(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran, done = list[Any](), SimpleNamespace(returncode=0, stdout="1\n", stderr="x" * 9 + "y" * 498 + "é.\n")
    monkeypatch.setattr(cluster, "runs_as", lambda: "me")

    def run(words: list[str], *, input: str, cwd: str, user: str | None, **_: object) -> Any:
        ran.append((words, input, cwd))
        assert user == ("me" if cluster.os.geteuid() == 0 else None), "root gives up its rights, others have none"
        return done

    monkeypatch.setattr(cluster.subprocess, "run", run)
    made = cluster.Cluster(tmp_path, 54321, Path("/bin"))
    assert made.psql("select 1;", "plant") == "1\n"
    where = ["-h", str(tmp_path / "s"), "-p", "54321", "-U", "postgres", "-d", "plant"]
    words = ["/bin/psql", "-X", "-q", "-At", "-v", "ON_ERROR_STOP=1", *where, "-f", "-"]
    assert ran == [(words, "select 1;", "/")]
    done.returncode = 3
    monkeypatch.setattr(cluster.os, "geteuid", lambda: 0 if cluster.os.getuid() else 1000)
    with pytest.raises(TedsProvisionError) as error:
        made.psql("select 1;")
    assert error.value.message == f"psql: {'y' * 498}é."
    assert ran[1][0][-3:] == ["postgres", "-f", "-"]


# -- the stories -------------------------------------------------------------------------------------------------------


class Steps:
    """The steps of a story: their names and details."""

    def __init__(self) -> None:
        self.seen = list[tuple[str, Any]]()

    @contextmanager
    def step(self, name: str) -> Iterator[Any]:
        made = SimpleNamespace(detail="")
        yield made
        self.seen.append((name, made.detail))


@pytest.mark.parametrize(
    ("parcels_out", "parcels_in", "moved"),
    [(0, 0, ""), (1, 0, ", 1 parcels out, 0 in"), (0, 2, ", 0 parcels out, 2 in")],
)
def test_a_sync_of_the_story_shows_what_went_and_came_and_closes_what_carries(
    monkeypatch: pytest.MonkeyPatch, parcels_out: int, parcels_in: int, moved: str
) -> None:
    steps, closed, synced = Steps(), list[str](), list[str]()
    story = object.__new__(plant._Story)
    story.demo, story.stations = cast("Any", SimpleNamespace(steps=steps)), cast("Any", {"west": "w", "south": "s"})
    result = SyncResult(pushed=3, fetched=4, parcels_in=parcels_in, parcels_out=parcels_out)
    monkeypatch.setattr(
        plant._Story, "_transport", lambda _, station: SimpleNamespace(close=lambda: closed.append(station))
    )
    monkeypatch.setattr(plant.sync, "sync", lambda station, _: synced.append(station) or result)
    story._sync("west", "south")
    assert steps.seen == [("registry sync", f"{name}: 3 pages out, 4 in{moved}") for name in ("west", "south")]
    story._sync("south", show=False)
    assert (len(steps.seen), synced, closed) == (2, ["w", "s", "s"], ["w", "s", "s"])

    def fails(*_: object) -> Any:
        raise LinkError("The stick is gone.")

    monkeypatch.setattr(plant.sync, "sync", fails)
    for show in (True, False):
        with pytest.raises(LinkError, match="The stick is gone"):
            story._sync("west", show=show)
    assert closed[3:] == ["w", "w"]


@pytest.mark.parametrize(("exit_code", "good"), [(0, True), (4, False)])
def test_a_story_of_a_line_whose_evidence_is_not_valid_fails(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, exit_code: int, good: bool
) -> None:
    steps = Steps()
    judged, added = list[tuple[Any, str]](), list[str]()
    totals = SimpleNamespace(exit_code=exit_code, words={"passed": 3}, files=4, add=added.append)
    monkeypatch.setattr(line, "EvidenceTotals", lambda: totals)
    monkeypatch.setattr(line, "export", lambda _station, rows, folder: [f"{folder.name}-{row}" for row in rows])
    monkeypatch.setattr(line, "judge_file", lambda grounds, path: judged.append((grounds, path)) or f"judged {path}")
    monkeypatch.setattr(line.jobs, "roster_of", lambda station: f"roster of {station.name}")
    office, bench = (
        SimpleNamespace(
            name=name, ca=f"CA of {name}", plant=SimpleNamespace(line=SimpleNamespace(evidence=lambda: "12"))
        )
        for name in ("office", "bench")
    )
    demo = cast("Any", SimpleNamespace(steps=steps, say=lambda _: None, folder=tmp_path))
    if not good:
        with pytest.raises(LinkError, match="The demo's evidence is not valid"):
            line._proof(demo, cast("Any", office), cast("Any", bench))
        return
    assert line._proof(demo, cast("Any", office), cast("Any", bench)) is cast("Any", totals)
    assert added == [f"judged {name}-{row}" for name in ("bench", "office") for row in "12"]
    assert {(grounds.ca, grounds.roster) for grounds, _ in judged} == {("CA of office", "roster of office")}
    assert steps.seen == [("evidence", "4 files valid: 3 passed")]
