"""``init``: which keystore, why, once, and never a place that keeps no secret."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from teds_provision.lazy import how_to_install
from teds_provision.protocol.keys import fingerprint, from_pem

from .shell import call, clean_environment, spawn

WORDS = "four random words here"


def init(home: Path, *words: str, passphrase: str | None = WORDS, **variables: str):  # type: ignore[no-untyped-def]
    environment = clean_environment(HOME=str(home.parent), **variables)
    done = spawn("--home", home, "--json", "init", *words, passphrase=passphrase, environment=environment)
    assert "Traceback" not in done.err
    return done


def test_init_makes_the_keys_once_and_shows_them_again_without_a_passphrase(tmp_path: Path) -> None:
    home = tmp_path / "home"
    made = init(home, "--keystore", "file", "--name", "bench")
    assert made.code == 0
    told = made.json
    assert (told["name"], told["keystore"]) == ("bench", "file")
    assert fingerprint(from_pem(told["public_key"].encode())) == told["fingerprint"]
    assert fingerprint(from_pem(told["ca"]["public_key"].encode())) == told["ca"]["fingerprint"]
    assert told["fingerprint"] != told["ca"]["fingerprint"]
    assert init(home, passphrase=None).json == told
    assert home.stat().st_mode & 0o777 == 0o700
    assert {path.name: oct(path.stat().st_mode & 0o777) for path in home.iterdir() if path.is_file()} == {
        path.name: "0o600" for path in home.iterdir()
    }
    assert WORDS not in made.out + made.err
    assert all(WORDS.encode() not in path.read_bytes() for path in home.iterdir())


def test_without_a_keyring_it_takes_the_passphrase_file_and_says_why(tmp_path: Path) -> None:
    told = init(tmp_path / "home")
    assert told.code == 0
    assert told.json["keystore"] == "file"
    assert "no keyring" in told.json["why"]


@pytest.mark.parametrize(
    "backend", ["keyring.backends.null.Keyring", "keyring.backends.fail.Keyring", "keyrings.alt.file.PlaintextKeyring"]
)
def test_a_keyring_that_may_not_hold_a_secret_is_never_used(tmp_path: Path, backend: str) -> None:
    refused = init(tmp_path / "one", "--keystore", "keyring", PYTHON_KEYRING_BACKEND=backend)
    assert (refused.code, refused.json["error"]["code"]) == (7, "no-keyring")
    assert backend in refused.json["error"]["message"]
    chosen = init(tmp_path / "two", PYTHON_KEYRING_BACKEND=backend)
    assert (chosen.code, chosen.json["keystore"]) == (0, "file")


def test_an_asked_for_keyring_that_is_not_there_is_exit_7_and_leaves_no_station(tmp_path: Path) -> None:
    home = tmp_path / "home"
    assert init(home, "--keystore", "keyring").code == 7
    assert spawn("--home", home, "nodes").code == 3
    assert init(home, "--keystore", "file").code == 0  # the same home carries on


@pytest.mark.parametrize(
    ("words", "passphrase", "code"),
    [
        (["--keystore", "file"], None, 7),
        (["--keystore", "file"], "short", 7),
        (["--keystore", "vault"], WORDS, 2),
        (["--keystore", "pkcs11:token=a?module-path=/nowhere.so"], WORDS, 7),
        (["--keystore", "pkcs11:token=a?pin-value=1234"], WORDS, 2),
    ],
)
def test_what_cannot_be_has_its_exit_code(tmp_path: Path, words: list[str], passphrase: str | None, code: int) -> None:
    refused = init(tmp_path / "home", *words, passphrase=passphrase)
    assert refused.code == code
    assert refused.json["error"]["hint"] or code == 2


def test_two_inits_at_once_make_one_station(tmp_path: Path) -> None:
    home, words = tmp_path / "home", tmp_path / "words"
    words.write_text(WORDS + "\n")
    command = (
        f"{sys.executable} -m teds_provision --json --home {home} --passphrase-fd 3 init --keystore file 3<{words}"
    )
    both = [
        subprocess.Popen(["bash", "-c", command], stdout=subprocess.PIPE, text=True, env=clean_environment())
        for _ in range(2)
    ]
    first, second = (process.communicate(timeout=60)[0] for process in both)
    assert [process.returncode for process in both] == [0, 0]
    assert first == second


def test_why_where_and_how_long_is_said_before_anybody_is_asked(tmp_path: Path) -> None:
    done = call(tmp_path / "new", "init", "--keystore", "file")
    assert done.code == 0, done
    told = done.err
    assert str(tmp_path / "new" / "vault.json") in told
    assert all(word in told for word in ("about a second", "8 characters", "backup"))
    assert "about to be made" not in call(tmp_path / "new", "init").err


def test_the_cure_for_a_missing_package_fits_where_the_program_is(monkeypatch: pytest.MonkeyPatch) -> None:
    assert how_to_install("matplotlib") == f"Install it: {sys.executable} -m pip install matplotlib"
    monkeypatch.setattr(sys, "prefix", "/home/anna/.local/share/pipx/venvs/teds-provision")
    assert how_to_install("segno", "pillow") == "Install it: pipx inject teds-provision segno pillow"
