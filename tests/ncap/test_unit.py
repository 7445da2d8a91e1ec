"""The systemd unit that is shipped: the service starts, measures and ends under exactly its filter of system calls."""

from __future__ import annotations

import errno
import json
import socket
import subprocess
from pathlib import Path

import pytest

from tests.cli.shell import PROGRAM
from tests.e2e.desk import Desk
from tests.ncap.service import Service, virtual
from tests.pace import until

UNIT = Path(__file__).parent.parent.parent / "service" / "teds-provision-ncap.service"
SETS = Path(__file__).parent / "system-call-sets.txt"
SYSTEM_PYTHON = "/usr/bin/python3"
CONFINED = Path(__file__).parent / "confined.py"

pytestmark = pytest.mark.skipif(not UNIT.exists(), reason="the unit is not part of this installation")


def settings(name: str) -> list[str]:
    """Return the values of a setting, in the unit's order."""
    lines = UNIT.read_text(encoding="utf-8").splitlines()
    return [line.partition("=")[2] for line in lines if line.startswith(f"{name}=")]


def sets() -> dict[str, list[str]]:
    """Return the sets of system calls, as `systemd-analyze syscall-filter` printed them."""
    found: dict[str, list[str]] = {}
    for line in SETS.read_text(encoding="utf-8").splitlines():
        if line.startswith("@"):
            found[line.strip()] = members = []
        elif line.startswith(" ") and not line.strip().startswith("#"):
            members.append(line.strip())
    return found


def calls_of(name: str) -> set[str]:
    """Return the calls of a set, or the one call."""
    known = sets()
    return set().union(*map(calls_of, known[name])) if name in known else {name}


def allowed() -> set[str]:
    """What the unit's filter leaves (systemd.exec(5), SystemCallFilter: the first one allows, ``~`` takes away)."""
    calls = calls_of("@default")  # always added: execve, exit, getrlimit, rt_sigreturn, time, sleep
    for value in settings("SystemCallFilter"):
        named = set().union(*map(calls_of, value.removeprefix("~").split()))
        calls = calls - named if value.startswith("~") else calls | named
    return calls


@pytest.fixture
def filter_file(tmp_path: Path) -> Path:
    if subprocess.run([SYSTEM_PYTHON, "-c", "import seccomp"], capture_output=True, check=False).returncode:
        pytest.skip("the Debian package python3-seccomp is not installed (scripts/install-test-packages)")
    [number] = settings("SystemCallErrorNumber")
    [families] = settings("RestrictAddressFamilies")
    rules = {
        "calls": sorted(allowed()),
        "errno": getattr(errno, number),
        "families": [int(getattr(socket, name, 31)) for name in families.split()],  # 31: AF_BLUETOOTH
    }
    file = tmp_path / "filter.json"
    file.write_text(json.dumps(rules))
    return file


@pytest.fixture
def confined(desk: Desk, filter_file: Path) -> Service:
    service = Service(desk, desk.station())
    program = (SYSTEM_PYTHON, str(CONFINED), str(filter_file), *PROGRAM)
    return service.start("--record", desk.folder / "recordings", program=program, fork=False)


def test_what_is_denied_gives_an_error_and_kills_no_process() -> None:
    """numpy's OpenBLAS calls mbind and lives with a no; a filter without an error number kills it at the start."""
    assert settings("SystemCallErrorNumber") == ["EPERM"]
    calls = allowed()
    assert {"read", "openat", "socket", "bpf"} - calls == {"bpf"}
    assert "mbind" not in calls
    assert {"mount", "ptrace", "reboot", "kexec_load", "init_module", "setuid"}.isdisjoint(calls)


def test_the_service_may_keep_its_threads_on_one_core_and_see_whose_work_the_others_do() -> None:
    assert "sched_setaffinity" in allowed()
    assert {"sched_setscheduler", "setpriority"}.isdisjoint(allowed())
    assert settings("ProcSubset") == [], "pid hides /proc/stat"


@pytest.mark.system
def test_the_filter_denies_what_it_should(filter_file: Path) -> None:
    """The bench itself: without it the next test would show nothing."""
    code = (
        "import ctypes, errno, os, socket\n"
        "libc = ctypes.CDLL(None, use_errno=True)\n"
        "assert libc.syscall(237, 0, 0, 0, 0, 0, 0) == -1 and ctypes.get_errno() == errno.EPERM, 'mbind'\n"
        "try: os.chroot('/')\n"
        "except PermissionError: print('denied')\n"
        "try: socket.socket(socket.AF_PACKET, socket.SOCK_RAW)\n"
        "except OSError as error: print(errno.errorcode[error.errno])\n"
    )
    words = [SYSTEM_PYTHON, CONFINED, filter_file, SYSTEM_PYTHON, "-c", code]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout.split()) == (0, ["denied", "EAFNOSUPPORT"]), done.stderr


@pytest.mark.system
@pytest.mark.link
def test_the_service_starts_measures_and_ends_under_its_filter(confined: Service) -> None:
    hand = virtual(confined)
    with confined.client() as asked:
        made = asked.request("POST", "/measurements", {"uuids": [hand], "rate": 50, "sinks": ["run.mcap", "run.csv"]})
        until(lambda: asked.request("GET", "/measurements")["measurements"][0]["nodes"][0].get("samples", 0) > 50)
        asked.end_measurement(made["id"])
        done = asked.request("PUT", f"/nodes/{hand}/channels/1", {"value": 0.02, "hold": 5})
        assert done["applied"]["value"] == pytest.approx(0.02, abs=1e-3)
        assert asked.request("GET", "/log")["intact"] is True
    confined.end()
    folder = confined.desk.folder / "recordings"
    assert {path.suffix for path in folder.iterdir()} == {".csv", ".mcap"}
