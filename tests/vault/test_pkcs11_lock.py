"""The lock of a token: nobody keeps another user out of it by making its folder first (issue 7, L12)."""

from __future__ import annotations

import os
import stat
from pathlib import Path
from types import SimpleNamespace

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
