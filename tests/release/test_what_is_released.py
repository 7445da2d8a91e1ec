"""Locks, workflows, documentation and archives: what a stranger gets."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from teds_provision.optional_rooms import OPTIONAL
from tests.bench import make_station

ROOT = Path(__file__).resolve().parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PIN = re.compile(r"^([A-Za-z0-9._-]+)==([^\s;\\]+)", re.MULTILINE)


def pins(lock: str) -> dict[str, str]:
    return {canonicalize_name(name): version for name, version in PIN.findall((ROOT / "locks" / lock).read_text())}


def required(*extras: str) -> list[Requirement]:
    """Return the direct requirements of the package with these extras; extras that name extras are followed."""
    rows = list(PROJECT["dependencies"])
    for extra in extras:
        rows += PROJECT["optional-dependencies"][extra]
    found = []
    for row in rows:
        requirement = Requirement(row)
        if requirement.name == PROJECT["name"]:
            found += required(*requirement.extras)
        else:
            found.append(requirement)
    return found


@pytest.mark.parametrize(("lock", "extras"), [("base.txt", ()), ("ncap.txt", ("ncap",)), ("dev.txt", ("dev",))])
def test_a_lock_holds_an_allowed_version_of_each_requirement(lock: str, extras: tuple[str, ...]) -> None:
    locked = pins(lock)
    for requirement in required(*extras):
        version = locked.get(canonicalize_name(requirement.name))
        assert version is not None, f"{requirement.name} is not in {lock}: run make locks"
        assert requirement.specifier.contains(version), f"{requirement} and {version} in {lock}: run make locks"


def test_a_station_gets_no_tools_of_tests() -> None:
    for lock in ("base.txt", "ncap.txt"):
        assert not pins(lock).keys() & {"pytest", "mypy", "playwright", "pandas", "hypothesis", "matplotlib"}
    assert pins("base.txt").items() <= pins("ncap.txt").items() <= pins("dev.txt").items()


def test_every_locked_package_has_its_hashes() -> None:
    for path in (ROOT / "locks").glob("*.txt"):
        for block in re.split(r"\n(?=\S)", path.read_text()):
            if PIN.match(block):
                assert "--hash=sha256:" in block, f"{path.name}: {block.splitlines()[0]}"


def test_the_workflows_are_safe() -> None:
    command = [str(Path(sys.executable).parent / "zizmor"), "--offline", "--no-progress", str(ROOT / ".github")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_action_is_pinned_and_listed_for_releases() -> None:
    releasing = (ROOT / "RELEASING.md").read_text()
    for path in (ROOT / ".github" / "workflows").glob("*.yml"):
        for action, reference in re.findall(r"uses: (\S+?)@(\S+)", path.read_text()):
            assert re.fullmatch("[0-9a-f]{40}", reference), f"{path.name}: {action}"
            assert "/".join(action.split("/")[:2]) in releasing, f"{action} is not listed in RELEASING.md"


def test_the_documentation_is_a_site_without_dead_links_or_orphans(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(tmp_path / "site")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    page = (tmp_path / "site" / "reference" / "commands.html").read_text()
    assert "teds-provision provision" in page
    assert not re.search(r'(?:src|href)="https?://[^"]*\.(?:js|css|woff2?)"', page), (
        "the site loads nothing from elsewhere"
    )


def test_a_released_version_is_in_the_changelog_and_others_say_so() -> None:
    version = re.search(r'__version__ = "([^"]+)"', (ROOT / "teds_provision" / "__init__.py").read_text())
    assert version is not None
    heading = f"## [{version[1]}]"
    assert (heading in (ROOT / "CHANGELOG.md").read_text()) is (".dev" not in version[1])


def test_the_functions_that_make_quick_names_one_by_one_exist() -> None:
    named = re.findall(r"(tests/\S+)::(\w+)", (ROOT / "Makefile").read_text())
    assert len(named) >= 4
    for file, function in named:
        assert f"\ndef {function}(" in (ROOT / file).read_text(), f"{file}::{function}"


@pytest.mark.nightly(
    "tests/release/test_what_is_released.py::test_the_functions_that_make_quick_names_one_by_one_exist; which cases "
    "they have, only a collection shows"
)
def test_the_tests_that_make_quick_names_one_by_one_exist() -> None:
    named = re.findall(r"tests/\S+::[^\s']+", (ROOT / "Makefile").read_text())
    assert len(named) >= 4
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "--collect-only", *named]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


def test_each_version_of_the_changelog_begins_with_a_date_and_a_summary() -> None:
    for section in re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(), flags=re.MULTILINE)[1:]:
        heading, _, rest = section.partition("\n")
        summary = rest.partition("\n### ")[0].strip()
        assert re.search(r"\d{4}-\d\d-\d\d", heading + summary), heading
        assert 0 < len(summary.splitlines()) <= 5, heading


# -- make test-all -----------------------------------------------------------------------------------------------------


@pytest.mark.soak
@pytest.mark.timeout(900)
def test_two_builds_of_a_commit_are_equal_and_the_sdist_is_whole(tmp_path: Path) -> None:
    sums = []
    for name, umask in (("first", 0o022), ("second", 0o077)):
        copy = tmp_path / name
        before = os.umask(umask)
        try:
            subprocess.run(["git", "clone", "--quiet", str(ROOT), str(copy)], check=True)
            subprocess.run(["make", "dist"], cwd=copy, check=True, env=os.environ | {"TZ": f"Etc/GMT{umask % 7:+d}"})
        finally:
            os.umask(before)
        sums.append((copy / "dist" / "SHA256SUMS").read_text())
    assert sums[0] == sums[1]
    [sdist] = (tmp_path / "first" / "dist").glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "sdist", filter="data")
    [source] = (tmp_path / "sdist").iterdir()
    subprocess.run(["make", "quick"], cwd=source, check=True)
    shutil.rmtree(source)


@pytest.mark.soak
@pytest.mark.timeout(900)
@pytest.mark.parametrize("asked", ["none", "check"])
def test_a_wheel_without_optional_rooms_works(tmp_path: Path, asked: str) -> None:
    subprocess.run(["git", "clone", "--quiet", str(ROOT), str(tmp_path / "copy")], check=True)
    subprocess.run(["make", ".venv-release/.ready"], cwd=tmp_path / "copy", check=True, capture_output=True)
    build = [".venv-release/bin/python", "-m", "build", "--no-isolation", "--outdir", str(tmp_path / "dist")]
    chosen = os.environ | {"TEDS_PROVISION_WHEEL_ROOMS": asked}
    subprocess.run(build, cwd=tmp_path / "copy", env=chosen, check=True, capture_output=True)
    [wheel] = (tmp_path / "dist").glob("*.whl")
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(tmp_path / "wheel")
    package = tmp_path / "wheel" / "teds_provision"
    assert {room for room in OPTIONAL if (package / room).exists()} == {asked} - {"none"}
    program = [sys.executable, "-m", "teds_provision", "--home", str(tmp_path / "home"), "--json"]
    make_station(tmp_path / "home").close()

    def run(*words: str) -> subprocess.CompletedProcess[str]:
        here = os.environ | {"PYTHONPATH": str(tmp_path / "wheel")}
        return subprocess.run([*program, *words], cwd=tmp_path, env=here, capture_output=True, text=True, check=False)

    assert "registry" not in run("--help").stdout
    assert run("node", "check", "--help").returncode == (0 if asked == "check" else 2)
    assert json.loads(run("nodes").stdout) == {"nodes": []}
    done = run("doctor")
    assert not any(line["result"] == "failed" and line["name"] == "store" for line in json.loads(done.stdout)["checks"])
    shutil.rmtree(tmp_path / "copy")


@pytest.mark.soak
@pytest.mark.timeout(1800)
def test_the_site_has_the_references_that_follow_from_code(tmp_path: Path) -> None:
    command = [sys.executable, "scripts/api.py", str(tmp_path / "python")]
    subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True)
    page = (tmp_path / "python" / "teds_provision" / "client.html").read_text()
    assert "release_actuator" in page
