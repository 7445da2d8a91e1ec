"""PC/SC readers: real pcscd and its library on a virtual reader, and what is said where there is no service."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import NoReaderError, UsageError
from teds_provision.links.nfc import pcsc, pcsc_readers, pcsclite
from teds_provision.links.nfc.pcsclite import PcscError
from teds_provision.links.nfc.reader import open_reader
from tests.bench import PASSPHRASE, make_station
from tests.cli.shell import clean_environment

from .conftest import ROOT
from .pcsc_scene import DRIVER

READER = "pcsc:Virtual PCD 00 00"


def why_not() -> str:
    """Why the scene cannot be run here, "" where it can."""
    if not Path(DRIVER).exists() or not Path("/usr/sbin/pcscd").exists():
        return "pcscd or vsmartcard-vpcd is not installed (scripts/install-test-packages)"
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        return "namespaces of its own need root and unshare"
    if subprocess.run(["unshare", "-n", "-m", "true"], capture_output=True, check=False).returncode:
        return "namespaces cannot be made here"
    return ""


class Scene:
    """The scene's process: commands in, outcomes out."""

    def __init__(self, folder: Path, tag: str) -> None:
        self.home = folder / "home"
        make_station(self.home).close()
        (folder / "pass").write_text(PASSPHRASE + "\n")
        self._process = subprocess.Popen(
            ["unshare", "-n", "-m", sys.executable, "-m", "tests.links.nfc.pcsc_scene", folder, tag],
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=clean_environment(),
        )
        self.uuid = self._line()["uuid"]

    def _line(self) -> Any:
        assert self._process.stdout
        return json.loads(self._process.stdout.readline())

    def do(self, *words: str) -> Any:
        assert self._process.stdin
        self._process.stdin.write(json.dumps(words) + "\n")
        self._process.stdin.flush()
        return self._line()

    def run(self, *words: str) -> Any:
        """Run the program with --json; its object, with the exit code under ``code``."""
        done = self.do("--home", str(self.home), "--json", *words)
        return {**json.loads(done["out"]), "code": done["code"]}

    def close(self) -> None:
        assert self._process.stdin
        assert self._process.stdout
        self._process.stdin.close()
        self._process.wait(60)
        self._process.stdout.close()


@pytest.fixture
def scene(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Scene]:
    reason = why_not()
    if reason:
        pytest.skip(reason)
    scene = Scene(tmp_path, request.param)
    yield scene
    scene.close()


OTHER_TAG = pytest.mark.nightly(
    "tests/links/nfc/test_nfc_pcsc.py::test_a_node_is_identified_over_a_pc_sc_reader[4], "
    "tests/links/nfc/test_nfc_pcsc.py::test_a_node_is_provisioned_over_a_pc_sc_reader[2]: either tag type once"
)


@pytest.mark.system
@pytest.mark.link
@pytest.mark.parametrize("scene", ["4", pytest.param("2", marks=OTHER_TAG)], indirect=True)
def test_a_node_is_identified_over_a_pc_sc_reader(scene: Scene) -> None:
    none = scene.run("identify", "--nfc", READER, "--timeout", "1")
    assert (none["code"], none["error"]["code"]) == (5, "no-node")
    scene.do("put")
    found = scene.run("identify", "--nfc", READER, "--timeout", "40")
    assert (found.get("uuid"), found["tag_uid"], found["state"]) == (scene.uuid, "04112233445566", "factory"), found
    several = scene.run("identify", "--timeout", "40")  # auto, and vpcd has two slots
    assert several["code"] == 2
    assert READER in several["error"]["message"]
    scene.do("lift")
    gone = scene.run("identify", "--nfc", READER, "--timeout", "1")
    assert (gone["code"], gone["error"]["code"]) == (5, "no-node")
    wrong = scene.run("identify", "--nfc", "pcsc:Omnikey", "--timeout", "1")
    assert wrong["code"] == 5
    assert "Virtual PCD" in wrong["error"]["message"]


@pytest.mark.system
@pytest.mark.link
@pytest.mark.parametrize("scene", ["2", pytest.param("4", marks=OTHER_TAG)], indirect=True)
def test_a_node_is_provisioned_over_a_pc_sc_reader(scene: Scene) -> None:
    scene.do("put")
    words = ["provision", "--yes", "--profile", "temperature-sensor", "--nfc", READER, "--timeout", "40"]
    done = scene.run(*words)
    assert (done.get("uuid"), done.get("verdict")) == (scene.uuid, "authentic"), done


class Library:
    """A stand-in for the client library where no service can be had in the state that a test wants."""

    def __init__(self, readers: list[str] | None) -> None:
        self._readers = readers

    def establish(self) -> int:
        if self._readers is None:
            raise PcscError(0x8010001D, "Service not available")
        return 1

    def readers(self, context: int) -> list[str]:
        return self._readers or []

    def release(self, context: int) -> None:
        pass


def put_in(monkeypatch: pytest.MonkeyPatch, readers: list[str] | None) -> None:
    """Put a library with these readers in the place of the system's."""
    for module in (pcsc, pcsc_readers):
        monkeypatch.setattr(module, "load", lambda: Library(readers))


@pytest.mark.parametrize(
    ("readers", "path", "error", "message"),
    [
        (None, "pcsc", NoReaderError, "does not answer: Service not available"),
        ([], "pcsc", NoReaderError, "No PC/SC reader is plugged in"),
        (["ACS ACR1252 PICC 00", "HID Omnikey 5022 00"], "pcsc", UsageError, "2 PC/SC readers fit"),
        (["ACS ACR1252 PICC 00", "HID Omnikey 5022 00"], "pcsc:identiv", NoReaderError, "Omnikey"),
    ],
)
def test_what_is_wrong_with_pc_sc_is_named(
    monkeypatch: pytest.MonkeyPatch, readers: list[str] | None, path: str, error: type[Exception], message: str
) -> None:
    put_in(monkeypatch, readers)
    with pytest.raises(error, match=message):
        open_reader(path)


def test_the_slot_of_a_security_module_is_no_reader_for_nodes(monkeypatch: pytest.MonkeyPatch) -> None:
    put_in(monkeypatch, ["ACS ACR1252 SAM Reader 01", "ACS ACR1252 PICC Reader 00"])
    assert open_reader("pcsc").name == "ACS ACR1252 PICC Reader 00"


@pytest.mark.parametrize(
    ("path", "taken"),
    [
        ("pcsc:ACR1252", "ACS ACR1252 PICC Reader 00"),
        ("pcsc:acs acr1252", "ACS ACR1252 PICC Reader 00"),
        ("pcsc:SAM", "ACS ACR1252 SAM Reader 01"),
        ("pcsc:ACS ACR1252 SAM Reader 01", "ACS ACR1252 SAM Reader 01"),
        ("pcsc:Omni", "HID Omnikey 5022 00"),
        ("pcsc:HID Omnikey 5022 00", "HID Omnikey 5022 00"),
    ],
)
def test_a_reader_is_named_by_a_part_of_its_name_and_its_slot_for_security_modules_is_passed_by(
    monkeypatch: pytest.MonkeyPatch, path: str, taken: str
) -> None:
    """``pcsc:ACR1252`` fitted both slots of one reader, and was refused. A whole name means that reader alone."""
    names = ["ACS ACR1252 SAM Reader 01", "ACS ACR1252 PICC Reader 00", "HID Omnikey 5022 00", "HID Omnikey 5022 00 01"]
    put_in(monkeypatch, names if "Omni" not in path or path.endswith("00") else names[:3])
    found = open_reader(path)
    assert (found.name, found.again) == (taken, f"pcsc:{taken}")


def test_without_the_client_library_its_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pcsclite, "LIBRARY", "libpcsclite.so.none")
    pcsclite.load.cache_clear()
    with pytest.raises(NoReaderError) as caught:
        open_reader("pcsc")
    assert caught.value.hint == "sudo apt install pcscd"
    assert caught.value.message == "PC/SC readers need libpcsclite.so.none, which is not installed."
    monkeypatch.setattr(pcsclite, "LIBRARY", None)  # the program itself: a library without these functions
    with pytest.raises(NoReaderError):
        open_reader("pcsc")
