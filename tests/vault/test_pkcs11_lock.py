"""The lock of a token: nobody keeps another user out of it by making its folder first (issue 7, L12)."""

from __future__ import annotations

import hashlib
import os
import stat
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import VaultError
from teds_provision.vault import pkcs11


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the home's .cache, where there is no /run/user of this user."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    return tmp_path / ".cache"


def test_the_lock_is_in_a_private_folder_of_this_user_alone(cache: Path) -> None:
    with pkcs11.exclusive("/lib/module.so"):
        (folder,) = cache.iterdir()
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700


@pytest.mark.parametrize("planted", ["link", "open to others"])
def test_a_folder_that_was_planted_is_refused(cache: Path, tmp_path: Path, planted: str) -> None:
    folder = cache / f"teds-provision-{os.getuid()}"
    cache.mkdir()
    if planted == "link":
        (tmp_path / "elsewhere").mkdir(mode=0o700)
        folder.symlink_to(tmp_path / "elsewhere")
    else:
        folder.mkdir()
        folder.chmod(0o777)
    with pytest.raises(VaultError, match="cannot be used"), pkcs11.exclusive("/lib/module.so"):
        pass


def test_a_lock_that_cannot_be_opened_is_named(cache: Path) -> None:
    """A link in its place is not followed: it could lead to a file of someone else."""
    with pkcs11.exclusive("/lib/module.so"):
        (folder,) = cache.iterdir()
        (lock,) = folder.iterdir()
    lock.unlink()
    lock.symlink_to(cache / "elsewhere")
    with pytest.raises(VaultError) as refused, pkcs11.exclusive("/lib/module.so"):
        pass
    assert refused.value.message == f"{lock} cannot be opened: Too many levels of symbolic links."
    assert refused.value.hint == "Check its owner and mode."
    assert not (cache / "elsewhere").exists()


def test_a_token_in_use_is_waited_for_half_a_minute(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    moments, waits = [0.0, 10.0, 30.0, 30.1], list[float]()
    clock = SimpleNamespace(monotonic=lambda: moments.pop(0), sleep=waits.append)
    monkeypatch.setattr(pkcs11, "time", clock)
    with pkcs11.exclusive("/lib/module.so"):
        with pkcs11.exclusive("/lib/another.so"):
            moments[:] = [0.0, 10.0, 30.0, 30.1]
        with pytest.raises(VaultError) as refused, pkcs11.exclusive("/lib/module.so"):
            pass
    assert refused.value.message == "Another teds-provision process is using the token."
    assert refused.value.hint == "Wait for it to finish, or stop it."
    assert (moments, len(waits)) == ([], 2)


def test_the_lock_is_a_private_file_and_is_given_back(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pkcs11, "_WAIT_SECONDS", -1.0)
    for error in (None, KeyError):
        with pytest.raises(error) if error else nullcontext(), pkcs11.exclusive("/lib/module.so"):
            ((lock,),) = (folder.iterdir() for folder in cache.iterdir())
            assert stat.S_IMODE(lock.stat().st_mode) == 0o600
            if error:
                raise error
    with pkcs11.exclusive("/lib/module.so"):
        pass


LABEL = "teds-provision station"


@pytest.mark.parametrize(
    ("uri", "role", "looked_for", "made"),
    [
        ("token=t", "station", (LABEL, "own"), (LABEL, "own")),
        ("token=t", "CA", ("teds-provision CA", "own"), ("teds-provision CA", "own")),
        ("object=k", "station", ("k", None), ("k", "own")),
        ("object=k", "CA", ("k CA", None), ("k CA", "own")),
        ("id=%01", "station", (None, b"\1"), (LABEL, b"\1")),
        ("id=%01", "CA", (None, b"\1CA"), ("teds-provision CA", b"\1CA")),
        ("object=k;id=%01", "station", ("k", b"\1"), ("k", b"\1")),
    ],
)
def test_a_key_is_looked_for_by_what_the_uri_names_and_else_by_what_it_would_be_made_with(
    uri: str, role: str, looked_for: tuple[Any, Any], made: tuple[Any, Any]
) -> None:
    course: list[tuple[Any, Any]] = []
    there: list[str] = []

    def find(*, label: str | None, identifier: bytes | None) -> str | None:
        course.append((label, identifier))
        return there[0] if there else None

    def generate(*, label: str, identifier: bytes) -> str:
        course.append((label, identifier))
        return "made"

    session: Any = SimpleNamespace(find=find, generate=generate)
    where = pkcs11.Pkcs11Uri.parse(f"pkcs11:{uri}?module-path=/m.so")
    own = hashlib.sha256(pkcs11._LABEL + f"{role}\0store".encode()).digest()[:16]
    expected = [(label, own if identifier == "own" else identifier) for label, identifier in (looked_for, made)]
    key: Any = pkcs11._find_or_make(session, "store", where, role)
    assert (key, course) == ("made", expected)
    there.append("found")
    key = pkcs11._find_or_make(session, "store", where, role)
    assert (key, course[2:]) == ("found", expected[:1])
