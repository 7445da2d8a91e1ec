"""One command at a time: who waits is told for whom, and a killed holder holds nothing."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from teds_provision.errors import StoreError, StoreLockedError
from teds_provision.station.store.lock import NodeLock, StoreLock
from tests.pace import PATIENCE

HOLDER = """
import sys, time
from pathlib import Path
from teds_provision.station.store.lock import StoreLock
with StoreLock(Path(sys.argv[1]), command="provision"):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def place(home: Path) -> Path:
    home.mkdir(mode=0o700)
    return home


@pytest.fixture
def holder(place: Path) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen([sys.executable, "-c", HOLDER, str(place)], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.communicate()


def test_the_second_process_is_told_who_holds_the_store(place: Path, holder: subprocess.Popen[str]) -> None:
    notices: list[str] = []
    begun = time.monotonic()
    with pytest.raises(StoreLockedError) as caught, StoreLock(place, command="write", wait=0.3, notice=notices.append):
        pytest.fail("two hold one lock")
    assert time.monotonic() - begun >= 0.3
    assert f"pid {holder.pid} (provision) since 20" in caught.value.message
    assert len(notices) == 1
    assert f"pid {holder.pid} (provision)" in notices[0]


def test_a_killed_holder_holds_nothing(place: Path, holder: subprocess.Popen[str]) -> None:
    threading.Timer(0.2, holder.send_signal, (signal.SIGKILL,)).start()
    with StoreLock(place, command="write", wait=10):
        assert holder.wait(60) == -signal.SIGKILL


def test_the_lock_is_free_after_use_and_after_an_error(place: Path) -> None:
    with pytest.raises(ValueError, match="x"), StoreLock(place, command="write"):
        raise ValueError("x")
    with StoreLock(place, command="write", wait=0):
        assert (place / "store.lock").stat().st_mode & 0o777 == 0o600


def test_what_the_last_holder_left_names_no_holder(place: Path) -> None:
    with StoreLock(place, command="a command with a longer name than the next one"):
        pass
    with (
        StoreLock(place, command="x"),
        pytest.raises(StoreLockedError) as caught,
        StoreLock(place, command="y", wait=0),
    ):
        pytest.fail("two hold one lock")
    assert "(x)" in str(caught.value)
    assert "longer" not in str(caught.value)


def test_an_unreadable_note_of_the_holder_is_no_obstacle(place: Path, holder: subprocess.Popen[str]) -> None:
    (place / "store.lock").write_bytes(b'{"pid": "\xff')
    with pytest.raises(StoreLockedError, match="another process"), StoreLock(place, command="write", wait=0):
        pytest.fail("two hold one lock")


def test_a_home_that_is_not_there_is_a_store_failure(tmp_path: Path) -> None:
    with pytest.raises(StoreError), StoreLock(tmp_path / "nowhere", command="write"):
        pytest.fail("locked nothing")


def test_a_link_in_place_of_the_lock_is_not_followed(place: Path, tmp_path: Path) -> None:
    target = tmp_path / "precious"
    target.write_text("text")
    (place / "store.lock").symlink_to(target)
    with pytest.raises(StoreError), StoreLock(place, command="write"):
        pytest.fail("followed a link")
    assert target.read_text() == "text"


NODE = bytes(range(10))
ASKED = """
import sys
from pathlib import Path
from teds_provision.station.store.lock import NodeLock
print(NodeLock(Path(sys.argv[1]), bytes(range(10))).is_taken)
"""


def test_of_two_threads_and_two_processes_one_works_on_a_node_at_a_time(place: Path) -> None:
    """A lock of the process would let its own threads in, and be gone once any of them closes the file."""
    notified, worked = threading.Event(), threading.Event()

    def work() -> None:
        with NodeLock(place, NODE, notice=lambda _: notified.set()):
            worked.set()

    def taken_elsewhere() -> str:
        done = subprocess.run(
            [sys.executable, "-c", ASKED, str(place)], capture_output=True, text=True, check=True, timeout=60
        )
        return done.stdout.strip()

    with NodeLock(place, NODE):
        other = threading.Thread(target=work)
        other.start()
        assert notified.wait(PATIENCE), "it waits for the first, and says so"
        assert NodeLock(place, NODE).is_taken  # opens and closes the file
        assert taken_elsewhere() == "True"
        with NodeLock(place, bytes(10)):
            pass  # another node is free
        assert not worked.is_set()
    other.join(PATIENCE)
    assert worked.is_set()
    assert taken_elsewhere() == "False"
