"""A disk that is full or read-only hides nothing: reading goes on, newest entries of a live log included."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision.errors import StoreError
from teds_provision.station.station import Station
from teds_provision.station.store.database import open_copy
from teds_provision.station.store.records import NodeRecord
from teds_provision.station.store.store import Store

ONE, TWO = bytes(range(10)), bytes(range(1, 11))
READ_ONLY = 'mount --bind "$0" "$0" && mount -o remount,ro,bind "$0" && exec "$@"'
FULL = (
    'cp -a "$0" "$0.kept" && mount -t tmpfs -o size=900k,mode=700 tmpfs "$0" && cp -a "$0.kept/." "$0" '
    '&& { head -c 10M /dev/zero > "$0/filler" 2>/dev/null || true; } && exec "$@"'
)

READER = """
import sys
from pathlib import Path
from teds_provision.errors import StoreError
from teds_provision.station.station import Station
from teds_provision.station.store.records import NodeRecord
store = Station.inspect(Path(sys.argv[1]))
print(len(store.nodes.all()), store.audit_log.check().intact, store._store.frozen is not None)
try:
    store.nodes.restore(NodeRecord(bytes(10)))
except StoreError as failure:
    print(failure.exit_code, failure.message)
"""


@pytest.fixture(scope="module")
def left(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a home that a process left by kill -9: one node in the file, one in its write-ahead log alone."""
    home = tmp_path_factory.mktemp("left") / "home"
    with Station.make(home) as store:
        store.nodes.restore(NodeRecord(ONE))
        store.audit("test", ONE, "done")
    script = (
        "import os, sys; from pathlib import Path; from teds_provision.station.station import Station\n"
        "from teds_provision.station.store.records import NodeRecord\n"
        f"Station.inspect(Path({str(home)!r})).nodes.restore(NodeRecord({TWO!r})); os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=60)
    assert (home / "store.sqlite3-wal").stat().st_size > 0
    return home


@pytest.fixture
def home(left: Path, tmp_path: Path) -> Path:
    """Return a copy of it, for one test."""
    return shutil.copytree(left, tmp_path / "home")


def mounted(home: Path, script: str, *words: str) -> subprocess.CompletedProcess[str]:
    enter = ["unshare", "--mount", "--map-root-user", "sh", "-c", script, str(home)]
    if not shutil.which("unshare") or subprocess.run([*enter, "true"], capture_output=True, check=False).returncode:
        pytest.skip("a file system cannot be mounted here")
    return subprocess.run([*enter, *words], capture_output=True, text=True, timeout=120, check=False)


@pytest.mark.parametrize(("script", "word"), [(READ_ONLY, "cannot be written"), (FULL, "no space")])
def test_everything_is_read_and_nothing_is_written(home: Path, script: str, word: str) -> None:
    outcome = mounted(home, script, sys.executable, "-c", READER, str(home))
    assert outcome.returncode == 0, outcome.stderr
    first, second = outcome.stdout.splitlines()[:2]
    assert first.startswith("2 True"), outcome.stdout
    assert second.startswith("7 "), outcome.stdout
    if first.endswith("True"):  # SQLite may manage on a full disk without us, and then says so when it writes
        assert word in second


@pytest.mark.parametrize("words", [["nodes"], ["log"], ["whitelist", "list"], ["trust", "list"]])
def test_commands_that_read_work_on_a_read_only_disk(tmp_path: Path, words: list[str]) -> None:
    from tests.bench import make_station

    make_station(tmp_path / "home").close()
    outcome = mounted(
        tmp_path / "home", READ_ONLY, sys.executable, "-m", "teds_provision", "--home", str(tmp_path / "home"), *words
    )
    assert outcome.returncode == 0, outcome.stderr


def test_nothing_of_the_copy_is_left(home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = set(os.listdir("/dev/shm"))
    connection = open_copy(home / "store.sqlite3")
    assert connection.execute("SELECT count(*) FROM nodes").fetchone() == (2,)
    assert set(os.listdir("/dev/shm")) == before
    connection.close()


@pytest.mark.parametrize("name", ["store.sqlite3", "store.sqlite3-wal", "store.sqlite3-shm"])
def test_a_link_in_the_place_of_the_store_is_not_followed(home: Path, tmp_path: Path, name: str) -> None:
    planted = tmp_path / "planted"
    planted.write_bytes(b"")
    (home / name).unlink(missing_ok=True)
    (home / name).symlink_to(planted)
    with pytest.raises(StoreError, match="a link"):
        Store.open(home, create=True)
    assert planted.read_bytes() == b""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a folder to another user")
def test_a_home_of_another_user_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir(mode=0o700)
    try:
        os.chown(home, 12345, 12345)
    except PermissionError:
        pytest.skip("this root may not give a folder to another user")
    with pytest.raises(StoreError, match="another user"):
        Store.open(home, create=True)
    assert list(home.iterdir()) == []


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can give a file to another user")
@pytest.mark.parametrize("name", ["store.sqlite3", "store.sqlite3-wal", "store.sqlite3-shm"])
@pytest.mark.parametrize("create", [True, False])
def test_a_file_of_another_user_is_no_part_of_the_store(home: Path, name: str, create: bool) -> None:
    (home / name).touch()
    try:
        os.chown(home / name, 12345, 12345)
    except PermissionError:
        pytest.skip("this root may not give a file to another user")
    with pytest.raises(StoreError, match=f"{name} is not owned by this user"):
        Store.open(home, create=create)
    (home / name).unlink()
    (home / name).mkdir()
    with pytest.raises(StoreError, match=f"{name} is not owned by this user"):
        Store.open(home, create=create)


@pytest.mark.parametrize(
    ("mode", "opens"), [(0o700, True), (0o755, True), (0o750, True), (0o720, False), (0o702, False), (0o777, False)]
)
def test_a_home_is_closed_to_others_writing(home: Path, mode: int, opens: bool) -> None:
    home.chmod(mode)
    if opens:
        Store.open(home).close()
    else:
        with pytest.raises(StoreError, match="Other users can write"):
            Store.open(home)
    assert home.stat().st_mode & 0o777 == mode
