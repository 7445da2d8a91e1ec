"""One way to write a file whole, one way to read with a limit: what killed, hostile and full places do to it."""

from __future__ import annotations

import errno
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import pytest

from teds_provision import files
from teds_provision.errors import BadDataError, NotFoundError, StoreError, UsageError, VaultError
from teds_provision.files import (
    SHARED,
    holds,
    private_folder,
    read_limited,
    require_no_pipe,
    whole_file,
    write_new,
    write_whole,
)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_a_file_comes_whole_private_and_alone(tmp_path: Path) -> None:
    path = tmp_path / "a"
    write_new(path, b"one")
    write_whole(path, b"two")
    assert (path.read_bytes(), path.stat().st_mode & 0o777, names(tmp_path)) == (b"two", 0o600, ["a"])


def test_a_result_that_is_no_secret_has_the_users_mode(tmp_path: Path) -> None:
    before = os.umask(0o027)
    try:
        write_whole(tmp_path / "a", b"", mode=SHARED)
    finally:
        os.umask(before)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o640


@pytest.mark.parametrize("there", ["file", "link", "dangling link"])
def test_a_new_file_never_takes_the_place_of_another(tmp_path: Path, there: str) -> None:
    path, other = tmp_path / "a", tmp_path / "other"
    if there == "file":
        path.write_bytes(b"old")
    else:
        path.symlink_to(other)
        if there == "link":
            other.write_bytes(b"old")
    before = names(tmp_path)
    with pytest.raises(UsageError):
        write_new(path, b"new")
    with pytest.raises(FileExistsError), whole_file(path, replace=False) as file:
        file.write(b"new")
    assert names(tmp_path) == before
    assert not other.exists() or other.read_bytes() == b"old"


def test_a_memory_stick_without_hard_links(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)
    write_new(tmp_path / "a", b"one")
    with pytest.raises(FileExistsError), whole_file(tmp_path / "a", replace=False) as file:
        file.write(b"two")
    assert (tmp_path / "a").read_bytes() == b"one"
    assert names(tmp_path) == ["a"]


def test_replacing_a_link_leaves_what_it_points_to_alone(tmp_path: Path) -> None:
    target = tmp_path / "target"
    target.write_bytes(b"old")
    (tmp_path / "a").symlink_to(target)
    write_whole(tmp_path / "a", b"new")
    assert (target.read_bytes(), (tmp_path / "a").read_bytes()) == (b"old", b"new")
    assert not (tmp_path / "a").is_symlink()


@pytest.mark.parametrize("link", [False, True])
def test_a_device_is_never_replaced(tmp_path: Path, link: bool) -> None:
    """As root, ``show --plot /dev/null`` made /dev/null a file: every other program of the machine wrote into it."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    named = tmp_path / "named"
    named.symlink_to(pipe)
    with pytest.raises(UsageError, match="is a device, pipe or socket"):
        write_whole(named if link else pipe, b"new", failure=UsageError)
    assert pipe.is_fifo()
    assert named.is_symlink()
    assert sorted(tmp_path.iterdir()) == [named, pipe]


@pytest.mark.parametrize("folder", ["/tmp", "/dev/shm"])
def test_a_named_pipe_is_no_file_in_any_folder(folder: str) -> None:
    """Below /dev/shm it was taken for a shell's ``<(command)``, and reading it waited for ever."""
    with tempfile.TemporaryDirectory(dir=folder) as made:
        pipe = Path(made) / "pipe"
        os.mkfifo(pipe)
        with pytest.raises(NotFoundError, match="is a pipe"):
            require_no_pipe(pipe)


def test_nothing_is_left_when_writing_fails(tmp_path: Path) -> None:
    write_whole(tmp_path / "a", b"old")
    with pytest.raises(TypeError), whole_file(tmp_path / "a", replace=True) as file:
        file.write("no octets")  # type: ignore[arg-type]
    with pytest.raises(VaultError, match="cannot be written"):
        write_whole(tmp_path / "none" / "a", b"", failure=VaultError)
    assert (names(tmp_path), (tmp_path / "a").read_bytes()) == (["a"], b"old")


def left_over(path: Path) -> Path:
    """Return what a killed writer leaves: begun in another process, which is killed before it is done."""
    code = (
        "import sys, time; from pathlib import Path; from teds_provision.files import whole_file\n"
        "with whole_file(Path(sys.argv[1]), replace=True) as file:\n"
        "    file.write(b'half'); file.flush(); print('begun', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(path)], stdout=subprocess.PIPE) as writer:
        assert writer.stdout is not None
        writer.stdout.readline()
        (begun,) = path.parent.glob(f".{path.name}.*")
        os.utime(begun, (time.time() - 3600,) * 2)
        write_whole(path, b"other")  # a writer that is slow is no dead one: it holds its lock
        assert begun.exists()
        writer.send_signal(signal.SIGKILL)
        writer.wait()
    return begun


def test_what_a_killed_writer_left_goes_and_nothing_else_does(tmp_path: Path) -> None:
    path = tmp_path / "station.backup"
    begun = left_over(path)
    os.utime(begun, (time.time() - 3600,) * 2)
    fresh = tmp_path / f".{path.name}.0123456789abcdef.teds-part"
    mine = [
        tmp_path / "station.backup.notes.new",
        tmp_path / ".station.backup.new",
        tmp_path / ".station.backup.0123456789ABCDEF.teds-part",
        tmp_path / ".other.0123456789abcdef.teds-part",
    ]
    linked = tmp_path / f".{path.name}.aaaaaaaaaaaaaaaa.teds-part"
    linked.symlink_to(mine[0])
    for own in mine:
        own.write_text("the user's own")
        os.utime(own, (time.time() - 3600,) * 2)
    fresh.write_text("begun a moment ago")
    write_whole(path, b"new")
    assert not begun.exists()
    assert all(own.read_text() == "the user's own" for own in mine)
    assert fresh.exists()
    assert linked.is_symlink()


def test_what_is_not_there_or_too_large_or_a_folder(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"12345")
    assert read_limited(tmp_path / "a", 5, "key") == b"12345"
    with pytest.raises(BadDataError, match="larger than 4 octets, which is too large for a key"):
        read_limited(tmp_path / "a", 4, "key")
    for name in ("none", "nu\0l", "."):
        with pytest.raises(NotFoundError):
            read_limited(tmp_path / name, 5, "key")
    (tmp_path / "link").symlink_to("a")
    assert read_limited(tmp_path / "link", 5, "key") == b"12345"
    with pytest.raises(StoreError):
        read_limited(tmp_path / "link", 5, "key", failure=StoreError, follow=False)


@pytest.mark.parametrize("octets", [0, 1, (1 << 16) - 1, 1 << 16, (1 << 16) + 1, 200_000])
@pytest.mark.parametrize("known", [0, 1, (1 << 16) - 1, 1 << 16, 200_000])
def test_a_file_is_read_whole_whatever_size_it_seemed_to_have(tmp_path: Path, octets: int, known: int) -> None:
    (tmp_path / "a").write_bytes(bytes(octets))
    for most in (octets, octets + 1, 10, 1 << 20):
        descriptor = os.open(tmp_path / "a", os.O_RDONLY)
        assert len(files._read(descriptor, known, most)) == min(octets, most)


def test_a_file_without_a_size_is_read_whole() -> None:
    assert read_limited("/proc/self/stat", 1 << 16, "file").endswith(b"\n")


def test_an_endless_file_is_not_read_to_its_end() -> None:
    with pytest.raises(BadDataError):
        read_limited(Path("/dev/zero"), 1000, "key")


def test_a_private_folder_that_others_made_or_may_enter_is_refused(tmp_path: Path) -> None:
    made = private_folder(tmp_path / "a")
    assert made.stat().st_mode & 0o777 == 0o700
    assert private_folder(made) == made
    (tmp_path / "wide").mkdir(mode=0o755)
    (tmp_path / "link").symlink_to(made)
    (tmp_path / "file").write_text("")
    for name in ("wide", "link", "file"):
        with pytest.raises(PermissionError):
            private_folder(tmp_path / name)


def test_a_folder_that_cannot_be_brought_to_the_disk_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = os.fsync

    def broken(descriptor: int) -> None:
        if os.path.isdir(f"/proc/self/fd/{descriptor}"):
            raise OSError(errno.EIO, "Input/output error")
        real(descriptor)

    monkeypatch.setattr(files.os, "fsync", broken)
    with pytest.raises(StoreError):
        write_whole(tmp_path / "a", b"")


def test_a_file_holds_these_octets_and_no_more_is_read_of_it(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"one")
    matches = {octets: holds(path, octets) for octets in (b"one", b"on", b"one ", b"")}
    assert matches == {b"one": True, b"on": False, b"one ": False, b"": False}
    assert not holds(tmp_path / "none", b"")
    assert not holds(Path("/dev/zero"), b"\0")
