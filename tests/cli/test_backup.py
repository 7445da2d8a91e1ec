"""``backup`` and ``restore`` as commands: what they ask, refuse, leave behind, and survive."""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft, KeyRecord, NodeRecord
from teds_provision.teds.image import Image
from tests.bench import PASSPHRASE, make_station

from .shell import call, clean_environment, spawn

ONE = bytes.fromhex("8d4d9da65281f7000000")


@pytest.fixture
def sealed(home: Path, tmp_path: Path) -> Path:
    """Return a backup of the station of ``home``, under the same passphrase as its keys."""
    call(home, "whitelist", "add", ONE.hex())
    path = tmp_path / "station.backup"
    done = spawn("--home", home, "--json", "backup", path, passphrase=PASSPHRASE)
    assert done.code == 0, done.out
    return path


def restore(home: Path, path: Path, *words: str, passphrase: str = PASSPHRASE) -> tuple[int, dict[str, object]]:
    done = spawn("--home", home, "--json", "restore", path, *words, passphrase=passphrase)
    assert "Traceback" not in done.err
    return done.code, done.json


def test_backup_and_restore_into_an_empty_home(home: Path, sealed: Path, tmp_path: Path) -> None:
    first = call(home, "--json", "init").json
    new = tmp_path / "new"
    code, plan = restore(new, sealed, "--dry-run")
    assert (code, plan["action"], new.exists()) == (0, "rebuild", False)
    code, plan = restore(new, sealed)
    assert (code, plan["action"], plan["keystore"]) == (0, "rebuilt", "file")
    again = call(new, "--json", "init").json
    assert (again["fingerprint"], again["ca"]) == (first["fingerprint"], first["ca"])
    assert call(new, "--json", "whitelist", "list").json == call(home, "--json", "whitelist", "list").json
    code, plan = restore(new, sealed)
    assert (code, plan["action"], plan["relation"]) == (0, "nothing", "older")


def test_an_existing_file_is_replaced_only_when_told(home: Path, sealed: Path) -> None:
    before = sealed.read_bytes()
    assert spawn("--home", home, "backup", sealed, passphrase=PASSPHRASE).code == 6
    assert sealed.read_bytes() == before
    plan = spawn("--home", home, "--json", "backup", sealed, "--dry-run")
    assert (plan.code, plan.json["replaces"]) == (0, True)
    assert spawn("--home", home, "backup", sealed, "--yes", passphrase=PASSPHRASE).code == 0
    assert sealed.read_bytes() != before


def test_the_stations_own_files_and_missing_folders_are_refused(home: Path, tmp_path: Path) -> None:
    before = (home / "store.sqlite3").stat().st_ino
    for name in ("store.sqlite3", "vault.json"):
        assert spawn("--home", home, "backup", home / name, "--yes", passphrase=PASSPHRASE).code == 2
    assert (home / "store.sqlite3").stat().st_ino == before
    assert spawn("--home", home, "backup", tmp_path / "no" / "b", passphrase=PASSPHRASE).code == 3


def test_an_endless_file_is_not_read_to_its_end(tmp_path: Path) -> None:
    assert restore(tmp_path / "new", Path("/dev/zero"))[0] == 8


def test_a_merge_shows_its_plan_and_asks(home: Path, sealed: Path) -> None:
    call(home, "whitelist", "remove", ONE.hex(), "--yes")
    refused = spawn("--home", home, "restore", sealed, passphrase=PASSPHRASE)
    assert refused.code == 6
    assert "restored: whitelist: 1" in refused.err
    assert "an older state" in refused.err
    assert call(home, "--json", "whitelist", "list").json == {"whitelist": []}
    code, plan = restore(home, sealed, "--yes")
    assert (code, plan["action"], plan["back"]) == (0, "merged", {"whitelist": 1})
    assert call(home, "--json", "log").json["entries"][-1]["act"] == "restore"


def test_what_restore_refuses_has_its_exit_code(home: Path, sealed: Path, tmp_path: Path) -> None:
    make_station(tmp_path / "other").close()
    changed, cut, junk = (tmp_path / name for name in ("changed", "cut", "junk"))
    octets = sealed.read_bytes()
    middle = len(octets) // 2
    changed.write_bytes(
        octets[:middle] + (b"A" if octets[middle : middle + 1] != b"A" else b"B") + octets[middle + 1 :]
    )
    cut.write_bytes(octets[:middle])
    junk.write_bytes(os.urandom(5000))
    new = tmp_path / "new"
    assert restore(new, sealed, passphrase="other words here")[0] == 7
    assert restore(new, changed)[0] == 4
    assert restore(new, cut)[0] == 8
    assert restore(new, junk)[0] == 8
    assert restore(new, tmp_path / "none")[0] == 3
    assert restore(tmp_path / "other", sealed)[0] == 6
    assert not new.exists()


def test_the_backup_may_have_another_passphrase_than_the_station(home: Path, tmp_path: Path) -> None:
    read, write = os.pipe()
    os.write(write, b"words for the backup\n")
    os.close(write)
    station_read, station_write = os.pipe()
    os.write(station_write, PASSPHRASE.encode() + b"\n")
    os.close(station_write)
    command = [sys.executable, "-m", "teds_provision", "--home", str(home), "--passphrase-fd", str(station_read)]
    command += ["backup", str(tmp_path / "b"), "--backup-passphrase-fd", str(read)]
    done = subprocess.run(command, pass_fds=(read, station_read), capture_output=True, check=False, timeout=60)
    os.close(read)
    os.close(station_read)
    assert done.returncode == 0, done.stderr
    assert restore(tmp_path / "new", tmp_path / "b")[0] == 7
    assert restore(tmp_path / "new", tmp_path / "b", passphrase="words for the backup")[0] == 0


def test_a_recovery_key_that_openssl_made(home: Path, tmp_path: Path) -> None:
    if shutil.which("openssl") is None:
        pytest.skip("openssl is not installed")
    private, public, path = tmp_path / "recovery.pem", tmp_path / "public.pem", tmp_path / "b"
    words = ["openssl", "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256", "-aes256"]
    make = [*words, "-pass", "stdin", "-out", str(private)]
    subprocess.run(make, input=b"words of the key", check=True, capture_output=True)
    show = ["openssl", "pkey", "-in", str(private), "-passin", "stdin", "-pubout", "-out", str(public)]
    subprocess.run(show, input=b"words of the key", check=True, capture_output=True)
    assert spawn("--home", home, "backup", path, "--to", private, passphrase=PASSPHRASE).code == 8
    assert spawn("--home", home, "--json", "backup", path, "--to", public, passphrase=PASSPHRASE).code == 0
    new = tmp_path / "new"
    assert restore(new, path)[0] == 2
    assert restore(new, path, "--recovery-key", str(private))[0] == 7
    code, _ = restore(new, path, "--recovery-key", str(private), passphrase="words of the key")
    assert code == 6  # only the fingerprint shows whose backup it is
    code, plan = restore(new, path, "--recovery-key", str(private), "--yes", passphrase="words of the key")
    assert (code, plan["action"]) == (0, "rebuilt")


OTHER_MOMENTS = pytest.mark.nightly(
    "tests/cli/test_backup.py::test_killed_at_any_moment_the_home_is_empty_or_the_station[0]; "
    "tests/faults/test_bench.py cuts a restore at its writes"
)


@pytest.mark.parametrize("seed", [pytest.param(seed, marks=OTHER_MOMENTS if seed else ()) for seed in range(6)])
def test_killed_at_any_moment_the_home_is_empty_or_the_station(
    home: Path, sealed: Path, tmp_path: Path, seed: int
) -> None:
    new = tmp_path / "new"
    command = [sys.executable, "-m", "teds_provision", "--home", str(new), "restore", str(sealed)]
    read, write = os.pipe()
    os.write(write, PASSPHRASE.encode() + b"\n")
    os.close(write)
    process = subprocess.Popen(
        [*command[:3], "--passphrase-fd", str(read), *command[3:]],
        pass_fds=(read,),
        env=clean_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(read)
    until = time.monotonic() + 20
    wait_for = random.Random(seed).choice(["store.lock", "vault.json", "store.sqlite3"])
    while not (new / wait_for).exists() and process.poll() is None and time.monotonic() < until:
        time.sleep(0.0005)
    time.sleep(random.Random(seed).uniform(0, 0.02))
    process.kill()
    process.wait()
    listed = call(new, "--json", "whitelist", "list")
    assert listed.code in (0, 3), listed.out
    assert restore(new, sealed)[0] == 0
    assert [entry["uuid"] for entry in call(new, "--json", "whitelist", "list").json["whitelist"]] == [ONE.hex()]
    assert call(new, "--json", "log").json["intact"]


def test_killed_in_the_middle_of_a_merge_the_store_is_old_or_new(home: Path, sealed: Path) -> None:
    with Station.inspect(home, ask=lambda prompt, confirm: PASSPHRASE) as store, store.transaction():
        store.pins.remove(ONE)
        for number in range(3000):
            store.nodes.restore(NodeRecord(number.to_bytes(10, "big"), sequence=1))
            store.keys.add(KeyRecord(number.to_bytes(10, "big"), 1, f"{number:016x}", "active", 1, b"x" * 40))
    for delay in (0.0, 0.01, 0.03):
        read, write = os.pipe()
        os.write(write, PASSPHRASE.encode() + b"\n")
        os.close(write)
        words = ["--home", str(home), "restore", str(sealed), "--yes"]
        process = subprocess.Popen(
            [sys.executable, "-m", "teds_provision", "--passphrase-fd", str(read), *words],
            pass_fds=(read,),
            env=clean_environment(),
            stderr=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
        )
        os.close(read)
        assert process.stderr is not None
        process.stderr.readline()  # the plan is printed: the merge is next
        time.sleep(delay)
        process.kill()
        process.communicate()
        listed = call(home, "--json", "whitelist", "list")
        assert listed.code == 0
        assert len(listed.json["whitelist"]) in (0, 1)
        assert call(home, "--json", "log").json["intact"]
    assert restore(home, sealed, "--yes")[0] == 0
    assert len(call(home, "--json", "whitelist", "list").json["whitelist"]) == 1


def test_a_full_disk_leaves_the_old_backup_and_no_rest(home: Path, sealed: Path, tmp_path: Path) -> None:
    with Station.inspect(home) as store:
        store.datasheets.keep_draft(Draft(ONE, Image(ONE, {(0, 1): os.urandom(300_000)})))
    before, words = sealed.read_bytes(), tmp_path / "words"
    words.write_text(PASSPHRASE + "\n")
    run = f"{sys.executable} -m teds_provision --home {home} --passphrase-fd 3 backup {sealed} --yes 3<{words}"
    done = subprocess.run(
        ["bash", "-c", f"ulimit -f 128; {run}"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60,
        env=clean_environment(PYTHONDONTWRITEBYTECODE="1"),  # see tests/e2e/desk.py
    )
    assert done.returncode == 7
    assert "cannot be written" in done.stderr
    assert sealed.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(sealed.name)] == [sealed.name]


OTHER_DELAYS = pytest.mark.nightly(
    "tests/cli/test_backup.py::test_killed_while_it_writes_a_backup_is_the_old_or_the_new_one[0.002]"
)


@pytest.mark.parametrize(
    "delay", [pytest.param(0.0, marks=OTHER_DELAYS), 0.002, pytest.param(0.01, marks=OTHER_DELAYS)]
)
def test_killed_while_it_writes_a_backup_is_the_old_or_the_new_one(
    home: Path, sealed: Path, tmp_path: Path, delay: float
) -> None:
    read, write = os.pipe()
    os.write(write, PASSPHRASE.encode() + b"\n")
    os.close(write)
    process = subprocess.Popen(
        [
            sys.executable,
            "-m",
            "teds_provision",
            "--home",
            str(home),
            "--passphrase-fd",
            str(read),
            "backup",
            str(sealed),
            "--yes",
        ],
        pass_fds=(read,),
        env=clean_environment(),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    os.close(read)
    before = sealed.stat().st_ino
    while process.poll() is None and not list(tmp_path.glob(".station.backup.*")):
        if sealed.stat().st_ino != before:
            break
    time.sleep(delay)
    process.kill()
    process.wait()
    assert restore(tmp_path / "new", sealed)[0] == 0
