"""The CA key out of a passphrase vault, and back: a file that OpenSSL opens too."""

from __future__ import annotations

import stat
import subprocess
from pathlib import Path

import pytest

from teds_provision.errors import NotFoundError, VaultError, WrongPassphraseError
from teds_provision.vault.file_vault import FileVault
from teds_provision.vault.passphrase import THROWAWAY
from tests.vault.passphrase import GOOD, STORE, Person


def test_the_ca_key_can_be_kept_away_and_brought_back(tmp_path: Path, vault: FileVault) -> None:
    ca = vault.ca()
    assert ca is not None
    away = tmp_path / "ca.pem"
    vault.export_ca(away, "a passphrase for the safe")
    assert stat.S_IMODE(away.stat().st_mode) == 0o600
    assert vault.drop_ca()
    assert not vault.drop_ca()
    assert FileVault.open(tmp_path, STORE, Person()).ca() is None
    with pytest.raises(VaultError, match="does not contain a CA key"):
        vault.export_ca(tmp_path / "other.pem", "a passphrase for the safe")
    with pytest.raises(WrongPassphraseError):
        vault.import_ca(away, "not that passphrase")
    assert vault.ca() is None
    assert vault.import_ca(away, "a passphrase for the safe").point == ca.point
    reopened = FileVault.open(tmp_path, STORE, Person()).ca()
    assert reopened is not None
    assert reopened.point == ca.point


def test_openssl_opens_the_exported_ca_key(tmp_path: Path, vault: FileVault) -> None:
    away = tmp_path / "ca.pem"
    vault.export_ca(away, "a passphrase for the safe")
    command = ["openssl", "pkey", "-in", str(away), "-passin", "stdin", "-pubout", "-outform", "DER"]
    try:
        run = subprocess.run(command, input=b"a passphrase for the safe\n", capture_output=True, check=False)
    except FileNotFoundError:
        pytest.skip("no openssl on this machine")
    ca = vault.ca()
    assert ca is not None
    assert run.stdout[-65:] == ca.point
    wrong = subprocess.run(command, input=b"wrong\n", capture_output=True, check=False)
    assert wrong.returncode != 0


def test_an_export_never_overwrites_and_never_takes_a_weak_passphrase(tmp_path: Path, vault: FileVault) -> None:
    taken = tmp_path / "ca.pem"
    taken.write_text("precious")
    with pytest.raises(VaultError, match="already exists"):
        vault.export_ca(taken, "a passphrase for the safe")
    assert taken.read_text() == "precious"
    with pytest.raises(VaultError, match="too short"):
        vault.export_ca(tmp_path / "new.pem", "short")
    assert not (tmp_path / "new.pem").exists()


def test_what_is_no_ca_file_is_refused(tmp_path: Path, vault: FileVault) -> None:
    with pytest.raises(NotFoundError):
        vault.import_ca(tmp_path / "nowhere.pem", GOOD)
    (tmp_path / "letter.pem").write_text("dear aunt")
    with pytest.raises(VaultError, match="no encrypted private key"):
        vault.import_ca(tmp_path / "letter.pem", GOOD)
    (tmp_path / "torn.pem").write_text(
        "-----BEGIN ENCRYPTED PRIVATE KEY-----\nMIIB\n-----END ENCRYPTED PRIVATE KEY-----\n"
    )
    with pytest.raises(VaultError):
        vault.import_ca(tmp_path / "torn.pem", GOOD)


def test_another_ca_key_does_not_replace_the_one_that_is_there(tmp_path: Path, vault: FileVault) -> None:
    other = tmp_path / "other"
    other.mkdir()
    FileVault.create(other, STORE, Person(), costs=THROWAWAY).export_ca(tmp_path / "ca.pem", GOOD)
    before = vault.ca()
    with pytest.raises(VaultError, match="a different CA key"):
        vault.import_ca(tmp_path / "ca.pem", GOOD)
    after = vault.ca()
    assert before is not None
    assert after is not None
    assert after.point == before.point
