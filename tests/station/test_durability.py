"""What the file survives: a killed process, two processes, a full disk, damage, other people's files."""

from __future__ import annotations

import os
import random
import shutil
import signal
import sqlite3
import stat
import subprocess
import sys
import time
from contextlib import closing, suppress
from pathlib import Path

import pytest

from teds_provision.errors import StoreError
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
from teds_provision.station.store.store import Store

NODE = bytes(range(10))

WRITER = """
import sys
from pathlib import Path
from teds_provision.station.station import Station
from teds_provision.station.store.records import KeyRecord, NodeRecord
node = bytes(range(10))
store = Station.make(Path(sys.argv[1]))
known = store.nodes.get(node)
number = known.sequence if known else 0
while True:
    number += 1
    key_id = f"{number:016x}"
    with store.transaction():
        store.nodes.restore(NodeRecord(node, sequence=number, epoch=number))
        store.keys.add(KeyRecord(node, number, key_id, "pending", number, b"w" * 49))
        store.keys.activate(node, key_id)
        store.audit("write", node, "done", number=number)
    print(number, flush=True)
"""


def python(code: str, *arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def kill_after(process: subprocess.Popen[str], seconds: float) -> list[str]:
    """Kill the process some time after its first line; return every line that it managed to say."""
    assert process.stdout is not None
    first = process.stdout.readline()
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    rest = process.stdout.read()  # communicate() would leave out what readline() had read ahead
    process.communicate()
    return [line for line in (first + rest).split("\n")[:-1] if line]


@pytest.mark.slow
def test_a_writer_killed_at_any_instant_loses_nothing_it_had_committed(home: Path) -> None:
    moments = random.Random(1451)
    last_number = 0
    for _ in range(12):
        lines = kill_after(python(WRITER, home), moments.uniform(0, 0.05))
        last_number = int(lines[-1])
        with Station.inspect(home) as store:
            node = store.nodes.get(NODE)
            assert node is not None
            assert node.sequence in (last_number, last_number + 1)  # it may have died between the commit and the word
            assert [key.key_id for key in store.keys.keys_of(NODE)] == [f"{node.sequence:016x}"]
            verdict = store.audit_log.check()
            assert (verdict.intact, verdict.count) == (True, node.sequence)
            assert store.damage() is None
    assert last_number > 20


@pytest.mark.slow
def test_init_killed_at_any_instant_can_be_run_again(home: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from teds_provision.station.store.store import Store\n"
        "print('ready', flush=True); print(Store.open(Path(sys.argv[1]), create=True).id, flush=True)"
    )
    moments = random.Random(7)
    for _ in range(12):
        shutil.rmtree(home, ignore_errors=True)
        lines = kill_after(python(code, home), moments.uniform(0, 0.006))
        with Station.make(home) as store:
            assert lines[1:] in ([], [store.id])
            store.nodes.restore(NodeRecord(NODE))
            assert store.damage() is None


def test_two_processes_write_at_once_and_nothing_is_lost(home: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from teds_provision.station.station import Station\n"
        "from teds_provision.station.store.records import NodeRecord\n"
        "store = Station.make(Path(sys.argv[1]))\n"
        "for n in range(150):\n"
        "    store.nodes.restore(NodeRecord(bytes([int(sys.argv[2])]) * 8 + n.to_bytes(2, 'big')))\n"
        "    store.audit('write', None, 'done', by=sys.argv[2])\n"
        "print(store.id)"
    )
    both = [python(code, home, number) for number in (1, 2)]
    spoken = [process.communicate() for process in both]
    assert [process.returncode for process in both] == [0, 0], spoken
    with Station.inspect(home) as store:
        assert {line.strip() for line, _ in spoken} == {store.id}
        assert len(store.nodes.all()) == 300
        verdict = store.audit_log.check()
        assert (verdict.intact, verdict.count) == (True, 300)


FILLER = """
import os, resource, sys
sys.dont_write_bytecode = True
from pathlib import Path
from teds_provision.errors import StoreError
from teds_provision.station.station import Station
from teds_provision.station.store.records import Draft
from teds_provision.teds.image import Image
store = Station.make(Path(sys.argv[1]))
if sys.argv[2] != "0":
    resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]),) * 2)
done = 0
try:
    for number in range(1000):
        store.datasheets.keep_draft(Draft(uuid := number.to_bytes(10, "big"), Image(uuid, {(0, 1): os.urandom(20000)})))
        done += 1
except StoreError as failure:
    print(done, failure.exit_code, failure.message, failure.hint)
    print(len(store.nodes.all()), store.damage())
"""


def filled_until_it_failed(home: Path, limit: int, before: list[str] | None = None) -> tuple[int, str]:
    run = subprocess.run(
        [*(before or []), sys.executable, "-c", FILLER, str(home), str(limit)],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    first, second = run.stdout.splitlines()
    assert second == "0 None"
    done, exit_code, words = first.split(" ", 2)
    assert exit_code == "7"
    return int(done), words


def test_a_file_that_may_not_grow_gives_a_clear_error_and_keeps_what_was_there(home: Path) -> None:
    done, words = filled_until_it_failed(home, 600_000)
    assert done > 3
    assert "the disk failed or is full" in words
    with Station.inspect(home) as store:
        drafts = [store.datasheets.draft(number.to_bytes(10, "big")) for number in range(done + 1)]
        assert [draft is not None for draft in drafts] == [True] * done + [False]


def test_a_full_disk_gives_a_clear_error(home: Path) -> None:
    enter = ["unshare", "--mount", "--map-root-user"]
    script = 'mkdir -p "$0" && mount -t tmpfs -o size=600k,mode=700 tmpfs "$0" && exec "$@"'
    mounted = [*enter, "sh", "-c", script, str(home)]
    if not shutil.which("unshare") or subprocess.run([*mounted, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a small file system cannot be mounted here")
    done, words = filled_until_it_failed(home, 0, mounted)
    assert done > 3
    assert "no space left" in words or "full" in words


def test_a_read_only_disk_gives_a_clear_error(station: Station, home: Path) -> None:
    station.nodes.restore(NodeRecord(NODE))
    station.close()
    code = (
        "import sys; from pathlib import Path; from teds_provision.errors import StoreError\n"
        "from teds_provision.station.station import Station\n"
        "from teds_provision.station.store.lock import StoreLock\n"
        "from teds_provision.station.store.records import NodeRecord\n"
        "def write():\n"
        "    with Station.make(Path(sys.argv[1])) as made: made.nodes.restore(NodeRecord(bytes(10)))\n"
        "def lock():\n"
        "    with StoreLock(Path(sys.argv[1]), command='write'): pass\n"
        "for act in (write, lock):\n"
        "    try: act()\n"
        "    except StoreError as failure: print(failure.message, failure.hint)\n"
    )
    script = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'
    mounted = ["unshare", "--mount", "--map-root-user", "sh", "-c", script, str(home)]
    if not shutil.which("unshare") or subprocess.run([*mounted, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a read-only file system cannot be mounted here")
    run = subprocess.run([*mounted, sys.executable, "-c", code, str(home)], capture_output=True, text=True, check=False)
    assert run.returncode == 0, run.stderr
    assert [line.count("read-only") for line in run.stdout.splitlines()] == [1, 1], run.stdout


def test_sqlite_running_out_of_pages_is_a_full_disk(station: Station) -> None:
    station._store.execute("PRAGMA max_page_count = 30")

    def fill() -> None:
        with station.transaction():
            for number in range(2000):
                station.nodes.restore(NodeRecord(number.to_bytes(10, "big"), name="x" * 100))

    with pytest.raises(StoreError, match="no space left"):
        fill()
    assert station.nodes.all() == []
    station._store.execute("PRAGMA max_page_count = 100000")
    station.nodes.restore(NodeRecord(NODE))
    assert len(station.nodes.all()) == 1


def test_directory_and_files_are_for_their_owner_alone(home: Path) -> None:
    before = os.umask(0)
    try:
        with Station.make(home) as store:
            store.nodes.restore(NodeRecord(NODE))
            modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in home.iterdir()}
    finally:
        os.umask(before)
    assert stat.S_IMODE(home.stat().st_mode) == 0o700
    assert set(modes) == {"store.sqlite3", "store.sqlite3-wal", "store.sqlite3-shm"}
    assert set(modes.values()) == {0o600}


def test_an_empty_directory_is_tightened_and_a_full_one_left_alone(tmp_path: Path) -> None:
    fresh, shared = tmp_path / "fresh", tmp_path / "shared"
    for place in (fresh, shared):
        place.mkdir()
        place.chmod(0o755)
    (shared / "thesis.tex").write_text("x")
    Store.open(fresh, create=True).close()
    Store.open(shared, create=True).close()
    assert stat.S_IMODE(fresh.stat().st_mode) == 0o700
    assert stat.S_IMODE(shared.stat().st_mode) == 0o755


def test_a_directory_where_others_may_write_is_refused(tmp_path: Path) -> None:
    home = tmp_path / "open"
    home.mkdir()
    (home / "file").write_text("x")
    home.chmod(0o777)
    with pytest.raises(StoreError, match="Other users can write"):
        Store.open(home, create=True)
    assert not (home / "store.sqlite3").exists()


def test_a_missing_store_names_the_cure_and_makes_nothing(home: Path) -> None:
    with pytest.raises(StoreError) as caught:
        Store.open(home)
    assert "init" in caught.value.hint
    assert not home.exists()
    home.mkdir()
    with pytest.raises(StoreError):
        Store.open(home)
    assert list(home.iterdir()) == []


def test_an_empty_file_is_no_store_until_init(home: Path) -> None:
    home.mkdir(mode=0o700)
    (home / "store.sqlite3").touch()
    with pytest.raises(StoreError, match="empty"):
        Store.open(home)
    Store.open(home, create=True).close()
    Store.open(home).close()


def test_the_identifier_is_made_once(home: Path) -> None:
    with Store.open(home, create=True) as store:
        first = store.id
    with Store.open(home, create=True) as store:
        assert store.id == first
    assert len(bytes.fromhex(first)) == 16


@pytest.mark.parametrize("create", [False, True])
def test_what_is_no_database_is_refused_and_left_as_it_is(home: Path, create: bool) -> None:
    home.mkdir(mode=0o700)
    (home / "store.sqlite3").write_bytes(b"this is a letter to my aunt" * 100)
    with pytest.raises(StoreError, match="damaged or no store"):
        Store.open(home, create=create)
    assert (home / "store.sqlite3").read_bytes().startswith(b"this is a letter")


def test_a_database_of_another_program_is_refused(home: Path) -> None:
    home.mkdir(mode=0o700)
    with closing(sqlite3.connect(home / "store.sqlite3")) as database:
        database.execute("CREATE TABLE recipes(name)")
    with pytest.raises(StoreError, match="another program"):
        Store.open(home, create=True)


def test_a_store_of_a_newer_version_is_refused(store: Store, home: Path) -> None:
    store.execute("PRAGMA user_version = 99")
    store.close()
    with pytest.raises(StoreError, match="schema 99"):
        Store.open(home)


def test_a_damaged_file_never_raises_anything_foreign(station: Station, home: Path) -> None:
    for number in range(500):
        station.nodes.restore(NodeRecord(number.to_bytes(10, "big"), name=f"node {number}"))
        station.audit("write", None, "done", number=number)
    station.close()
    good = (home / "store.sqlite3").read_bytes()
    chance = random.Random(3)
    refused = 0
    for _ in range(60):
        bad = bytearray(good)
        start = chance.randrange(0, len(bad) - 300)
        bad[start : start + 300] = chance.randbytes(300)
        (home / "store.sqlite3").write_bytes(bad)
        try:
            with Station.inspect(home) as again:
                again.nodes.all()
                again.keys.keys_of(NODE)
                list(again.audit_log.entries())
                refused += not again.audit_log.check().intact or again.damage() is not None
                again.nodes.restore(NodeRecord(NODE))
        except StoreError as failure:
            refused += bool(failure.hint)
    assert refused > 10


def test_a_truncated_file_never_raises_anything_foreign(station: Station, home: Path) -> None:
    for number in range(300):
        station.nodes.restore(NodeRecord(number.to_bytes(10, "big")))
    station.close()
    good = (home / "store.sqlite3").read_bytes()
    for length in (1, 50, 100, 512, 4095, 4096, 4097, len(good) // 2, len(good) - 1):
        (home / "store.sqlite3").write_bytes(good[:length])
        with suppress(StoreError), Station.inspect(home) as again:
            again.nodes.all()
            assert again.damage() is not None, f"{length} octets pass for the whole file"


def test_a_home_that_is_a_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "home").write_text("x")
    with pytest.raises(StoreError, match="not a directory"):
        Store.open(tmp_path / "home", create=True)
    with pytest.raises(StoreError):
        Store.open(tmp_path / "home" / "below", create=True)
