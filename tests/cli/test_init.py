"""``init``: which keystore, why, once, and never a place that keeps no secret."""

from __future__ import annotations

import importlib.metadata
import json
import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path
from types import SimpleNamespace

import pytest

from teds_provision import lazy
from teds_provision.cli.context import read_line
from teds_provision.cli.station import init as init_command
from teds_provision.lazy import how_to_install
from teds_provision.protocol.keys import SoftwareKey, fingerprint, from_pem, to_pem
from tests.bench import copy_home

from .shell import ROOT, call, clean_environment, spawn

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
    report = made.json
    assert (report["name"], report["keystore"]) == ("bench", "file")
    assert fingerprint(from_pem(report["public_key"].encode())) == report["fingerprint"]
    assert fingerprint(from_pem(report["ca"]["public_key"].encode())) == report["ca"]["fingerprint"]
    assert report["fingerprint"] != report["ca"]["fingerprint"]
    assert init(home, passphrase=None).json == report
    assert home.stat().st_mode & 0o777 == 0o700
    assert {path.name: oct(path.stat().st_mode & 0o777) for path in home.iterdir() if path.is_file()} == {
        path.name: "0o600" for path in home.iterdir()
    }
    assert WORDS not in made.out + made.err
    assert all(WORDS.encode() not in path.read_bytes() for path in home.iterdir())


def test_without_a_keyring_it_takes_the_passphrase_file_and_says_why(tmp_path: Path) -> None:
    outcome = init(tmp_path / "home")
    assert outcome.code == 0
    assert outcome.json["keystore"] == "file"
    assert "no keyring" in outcome.json["why"]


OTHER_BACKEND = pytest.mark.nightly(
    "tests/cli/test_init.py::test_a_keyring_that_may_not_hold_a_secret_is_never_used, by the one that would keep it"
)


@pytest.mark.parametrize(
    "backend",
    [
        pytest.param("keyring.backends.null.Keyring", marks=OTHER_BACKEND),
        pytest.param("keyring.backends.fail.Keyring", marks=OTHER_BACKEND),
        "keyrings.alt.file.PlaintextKeyring",
    ],
)
def test_a_keyring_that_may_not_hold_a_secret_is_never_used(tmp_path: Path, backend: str) -> None:
    refused = init(tmp_path / "one", "--keystore", "keyring", PYTHON_KEYRING_BACKEND=backend)
    assert (refused.code, refused.json["error"]["code"]) == (7, "no-keyring")
    assert backend in refused.json["error"]["message"]
    chosen = init(tmp_path / "two", PYTHON_KEYRING_BACKEND=backend)
    assert (chosen.code, chosen.json["keystore"]) == (0, "file")


def test_a_plan_of_init_makes_nothing_and_asks_for_nothing(tmp_path: Path) -> None:
    home = tmp_path / "home"
    plan = init(home, "--dry-run", "--name", "bench", passphrase=None)
    why = "no OS keyring: this machine has no keyring that is suitable for secrets"
    assert (plan.code, plan.json) == (
        0,
        {"plan": True, "name": "bench", "home": str(home), "keystore": "file", "why": why},
    )
    assert init(home, "--dry-run", "--keystore", "file", passphrase=None).json["why"] == "as requested"
    assert init(home, "--dry-run", "--keystore", "keyring", passphrase=None).code == 7
    assert init(home, "--dry-run", "--keystore", "vault", passphrase=None).code == 2
    request = tmp_path / "lab.request"
    words = ("--keystore", "file", "--request", str(request), "--dry-run")
    shown = spawn("--home", home, "init", *words, passphrase=None).out
    what = f"create the station's key, and write a certificate request to {request}"
    assert shown == f"Plan: {what}, in the file keystore (as requested), home {home}.\n"
    assert list(tmp_path.iterdir()) == []


def test_a_plan_of_a_second_init_shows_the_station(tmp_path: Path) -> None:
    home = tmp_path / "home"
    report = init(home, "--keystore", "file", "--name", "bench").json
    assert init(home, "--dry-run", passphrase=None).json == report | {"plan": True}
    assert init(home, "--dry-run", "--name", "other", passphrase=None).code == 2


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


def test_why_where_and_how_long_is_shown_before_a_question_is_asked(tmp_path: Path) -> None:
    done = call(tmp_path / "new", "init", "--keystore", "file")
    assert done.code == 0, done
    stderr = done.err
    assert str(tmp_path / "new" / "vault.json") in stderr
    assert all(word in stderr for word in ("about a second", "8 characters", "backup"))
    assert "will be stored" not in call(tmp_path / "new", "init").err


def test_the_cure_for_a_missing_package_fits_where_the_program_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    came_from(monkeypatch, None)
    assert how_to_install("plot") == f"Install it: {sys.executable} -m pip install 'teds-provision[plot]'"
    monkeypatch.setattr(sys, "prefix", "/home/anna/.local/share/pipx/venvs/teds-provision")
    assert how_to_install("label") == "Install it: pipx runpip teds-provision install 'teds-provision[label]'"
    monkeypatch.setattr(sys, "prefix", "/srv/pipx/own")
    assert lazy.install_command("nfcpy>=1.0", "pint") == f"{sys.executable} -m pip install 'nfcpy>=1.0' pint"
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    monkeypatch.setattr(lazy, "util", SimpleNamespace(find_spec=lambda _name: None))
    assert how_to_install("ble") == f"Install it: uv pip install --python {sys.executable} 'teds-provision[ble]'"


def came_from(monkeypatch: pytest.MonkeyPatch, url: dict[str, object] | None) -> None:
    """Have this installation's direct_url.json (PEP 610) be ``url``; None: it came from a package index."""
    real = importlib.metadata.distribution("teds-provision")
    own = SimpleNamespace(read_text=lambda name: None if url is None else json.dumps(url), requires=real.requires)
    monkeypatch.setattr(lazy, "metadata", SimpleNamespace(distribution=lambda name: own, PackageNotFoundError=KeyError))


def test_an_extra_is_installed_from_where_the_program_came(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Only an installation from a package index names one: before its first release no index has the package."""
    pip, here = f"{sys.executable} -m pip install", tmp_path.as_uri()
    for url, words in (
        ({"url": here, "dir_info": {"editable": True}}, f"--editable '{tmp_path}[label]'"),
        ({"url": here, "dir_info": {}}, f"'teds-provision[label] @ {here}'"),
        (
            {"url": "https://example.org/it", "vcs_info": {"vcs": "git", "commit_id": "abc"}},
            "'teds-provision[label] @ git+https://example.org/it@abc'",
        ),
        (
            {"url": "https://example.org/it.whl", "archive_info": {}},
            "'teds-provision[label] @ https://example.org/it.whl'",
        ),
    ):
        came_from(monkeypatch, url)
        assert lazy.install_command("teds-provision[label]") == f"{pip} {words}"
    came_from(monkeypatch, {"url": f"{here}/gone.whl", "archive_info": {}})
    gone = lazy.install_command("teds-provision[label]")
    assert "segno" in gone
    assert "teds-provision[" not in gone


def test_no_page_installs_an_extra_from_an_index() -> None:
    """Until there is a release; RELEASING.md names this test."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md")), *sorted((ROOT / "man").glob("*"))]
    assert [page.name for page in pages if "install 'teds-provision[" in page.read_text(encoding="utf-8")] == []


@pytest.mark.parametrize(
    ("receipt", "command"),
    [
        ('requirements = [{ name = "teds-provision" }]', "'teds-provision[ncap]'"),
        ('requirements = [{ name = "teds-provision", specifier = ">=0.2" }]', "'teds-provision[ncap]>=0.2'"),
        (
            'requirements = [{ name = "teds-provision", extras = ["mqtt"], directory = "/src/it" }]\n'
            'python = "/usr/bin/python3"',
            "--python /usr/bin/python3 'teds-provision[mqtt,ncap] @ /src/it'",
        ),
        (
            'requirements = [{ name = "teds-provision", editable = "/src/it" }, { name = "paho-mqtt" }]',
            "--editable '/src/it[ncap]' --with paho-mqtt",
        ),
        (
            'requirements = [{ name = "teds-provision", git = "https://example.org/it?rev=main" }]',
            "'teds-provision[ncap] @ git+https://example.org/it@main'",
        ),
        (
            'requirements = [{ name = "teds-provision", git = "https://example.org/it?tag=v1" }]',
            "'teds-provision[ncap] @ git+https://example.org/it@v1'",
        ),
        (
            'requirements = [{ name = "teds-provision", git = "https://example.org/it?branch=b" }]',
            "'teds-provision[ncap] @ git+https://example.org/it@b'",
        ),
        (
            'requirements = [{ name = "teds-provision", path = "/src/it.whl" }]',
            "'teds-provision[ncap] @ /src/it.whl'",
        ),
        (
            'requirements = [{ name = "pint" }, { name = "teds-provision", url = "https://example.org/it.whl" },'
            ' { name = "paho-mqtt", extras = ["a", "b"], specifier = ">=2" }]',
            "'teds-provision[ncap] @ https://example.org/it.whl' --with pint --with 'paho-mqtt[a,b]>=2'",
        ),
        ("requirements = 3", "'teds-provision[ncap]'"),
        ('python = "/usr/bin/python3"', "'teds-provision[ncap]'"),
        ("python =", "'teds-provision[ncap]'"),
    ],
)
def test_a_tool_of_uv_is_installed_again_with_the_extra_and_all_that_it_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, receipt: str, command: str
) -> None:
    """Receipts of uv 0.13: such an environment has no pip, and what uv was not told of is gone at its next upgrade."""
    (tmp_path / "uv-receipt.toml").write_text(f"[tool]\n{receipt}\nentrypoints = []\n")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert how_to_install("ncap") == f"Install it: uv tool install {command}"


def test_a_tool_of_uv_gets_other_packages_beside_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requirements = '[{ name = "teds-provision", extras = ["mqtt"] }, { name = "pint" }]'
    (tmp_path / "uv-receipt.toml").write_text(f"[tool]\nrequirements = {requirements}\n")
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    assert lazy.install_command("teds-provision[ble]", "numpy>=1.26", "rich") == (
        "uv tool install 'teds-provision[ble,mqtt]' --with pint --with 'numpy>=1.26' --with rich"
    )
    (tmp_path / "uv-receipt.toml").write_text('[tool]\nrequirements = [{ name = "teds-provision" }]\n')
    assert lazy.install_command("rich") == "uv tool install teds-provision --with rich"


def test_what_the_demo_installs_is_enough_for_the_steps_that_readme_shows_after_it(tmp_path: Path) -> None:
    """`ncap run` ended in a missing extra."""
    plan = ["make", "-n", "demo", f"VENV={tmp_path / 'venv'}", "PYTHON=python3"]
    output = subprocess.run(plan, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert "teds-provision ncap run" in (ROOT / "README.md").read_text()
    assert "--editable '.[ncap]'" in output


@pytest.mark.needs_room("plant")
def test_every_extra_that_a_hint_names_is_one() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        extra
        for path in (ROOT / "teds_provision").rglob("*.py")
        for extra in re.findall(r"how_to_install\(['\"]([^'\"]+)['\"]\)", path.read_text())
    }
    assert {"ble", "ncap", "parquet", "registry", "units"} <= named
    assert named <= declared.keys()


def test_keys_come_from_one_place(tmp_path: Path) -> None:
    for name in ("ca.pem", "lab.cert"):
        (tmp_path / name).write_text("x")
    outcome = call(tmp_path / "home", "init", "--ca", tmp_path / "ca.pem", "--certificate", tmp_path / "lab.cert")
    assert outcome.code == 2
    assert "--ca" in outcome.err
    assert not (tmp_path / "home" / "store.sqlite3").exists()


def test_a_passphrase_from_a_descriptor_keeps_its_blanks() -> None:
    for given, read in ((b"  two words \r\n", "  two words "), (b"\ttab\n rest\n", "\ttab"), (b"x", "x")):
        near, far = os.pipe()
        os.write(far, given)
        os.close(far)
        assert read_line(near) == read
        os.close(near)


def test_a_plan_with_a_certificate_shows_the_ca_that_it_would_trust(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    point, path = SoftwareKey.generate().point, tmp_path / "lab.cert"
    monkeypatch.setattr(
        init_command, "_read_certificate", lambda file: SimpleNamespace(ca=point) if file == path else None
    )
    path.touch()
    home = tmp_path / "home"
    digits = fingerprint(point)
    found = call(home, "--json", "init", "--dry-run", "--certificate", path).json
    assert found == {
        "plan": True, "name": None, "home": str(home), "ca": {"public_key": to_pem(point), "fingerprint": digits},
    }  # fmt: skip
    shown = call(home, "init", "--dry-run", "--certificate", path).out
    assert shown == f"Plan: trust the CA {digits[:32]}, which issued {path}.\n"
    words = call(home, "init", "--dry-run", "--keystore", "file", "--ca", path).out
    what = f"create the station's key, certified by the CA key of {path}"
    assert words == f"Plan: {what}, in the file keystore (as requested), home {home}.\n"
    assert not home.exists()


@pytest.mark.parametrize(
    ("words", "why"),
    [
        (
            ["--request", "a", "--certificate", "b"],
            "Use --request first, then --certificate once the CA has signed it.",
        ),
        (["--ca", "a", "--certificate", "b"], "Use --ca alone: the key in its file certifies this station at once."),
        (["--ca", "a", "--request", "b"], "Use --ca alone: the key in its file certifies this station at once."),
    ],
)
def test_a_station_is_certified_in_one_way(tmp_path: Path, words: list[str], why: str) -> None:
    for name in ("a", "b"):
        (tmp_path / name).touch()
    given = [tmp_path / word if len(word) == 1 else word for word in words]
    refused = call(tmp_path / "home", "--json", "init", *given)
    assert (refused.code, refused.json["error"]["message"]) == (2, f"{why} (see: teds-provision init --help)")
    assert not (tmp_path / "home").exists()


def test_a_request_that_is_there_is_overwritten_only_if_it_is_this_stations(tmp_path: Path) -> None:
    home, path = tmp_path / "home", tmp_path / "lab.request"
    copy_home(home)
    words = ("--json", "init", "--request", path)
    path.write_bytes(b"something else")
    refused = call(home, *words)
    assert (refused.code, path.read_bytes()) == (2, b"something else")
    path.unlink()
    first = call(home, *words)
    octets = path.read_bytes()
    assert (first.code, first.json["request"], first.json["ca"]) == (0, str(path), None)
    assert call(home, *words).json == first.json
    assert path.read_bytes() == octets
