"""The library on Cortex-M0+ and M4: sizes, stack and instructions held at what was measured and a fifth more."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.bench import PASSPHRASE
from tests.e2e.desk import Desk, Station
from tests.firmware import builds
from tests.firmware.bridge import Emulated

pytestmark = pytest.mark.machine

TEXT = {"m0-security": 16_782, "m0-full": 27_475, "m4-security": 16_286, "m4-full": 26_183}
INSTRUCTIONS = {
    "m0": {"make": 10_510_000, "sign": 14_760_000, "verify": 29_420_000, "ecdh": 15_580_000, "ccm-25-samples": 68_200},
    "m4": {"make": 4_340_000, "sign": 5_570_000, "verify": 11_420_000, "ecdh": 6_270_000, "ccm-25-samples": 48_900},
}
MACHINES = {"m0": "microbit", "m4": "mps2-an386"}
STACK, NODE = 3_280, 11_968
MORE = 1.2


@pytest.fixture(scope="module")
def arm() -> Path:
    if lack := builds.missing("arm-none-eabi-gcc", "qemu-system-arm"):
        pytest.fail(f"{lack}: make firmware-arm installs it")
    builds.make("arm")
    return builds.BUILD / "arm"


def sizes(archive: Path) -> tuple[int, int, int]:
    """Octets of text, data and bss."""
    told = subprocess.run(
        ["arm-none-eabi-size", "-t", str(archive)], capture_output=True, text=True, check=True
    ).stdout.splitlines()[-1]
    text, data, bss = map(int, told.split()[:3])
    return text, data, bss


@pytest.mark.parametrize("build", list(TEXT))
def test_code_stays_within_its_budget_and_nothing_is_global(arm: Path, build: str) -> None:
    text, data, bss = sizes(arm / f"{build}.a")
    assert text <= TEXT[build] * MORE
    assert (data, bss) == (0, 0)


@pytest.mark.parametrize("cpu", list(MACHINES))
def test_what_a_step_costs_is_counted(arm: Path, cpu: str) -> None:
    words = ["qemu-system-arm", "-M", MACHINES[cpu], "-display", "none", "-monitor", "none", "-serial", "none"]
    words += ["-semihosting-config", "enable=on,target=native", "-icount", "shift=0"]
    done = subprocess.run(
        [*words, "-kernel", str(arm / f"{cpu}-measure.elf")], capture_output=True, text=True, check=False, timeout=120
    )
    said = done.stdout + done.stderr
    assert "wrong" not in said
    counted = {name: int(number) for name, number in re.findall(r"(\S+) instructions (\d+)", said)}
    for step, most in INSTRUCTIONS[cpu].items():
        assert counted[step] <= most * MORE, step


def test_no_function_of_the_library_calls_itself_or_has_an_array_of_variable_length(arm: Path) -> None:
    calls: dict[str, set[str]] = {}
    for report in (arm / "m4-full").glob("*.ci"):
        for source, target in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', report.read_text()):
            calls.setdefault(source.split(":")[-1], set()).add(target.split(":")[-1])
    for name, called in calls.items():
        seen: set[str] = set()
        ahead = set(called)
        while ahead:
            each = ahead.pop()
            seen.add(each)
            ahead |= calls.get(each, set()) - seen
        assert name not in seen, f"{name} calls itself"
    for usage in (arm / "m4-full").glob("*.su"):
        assert "dynamic" not in usage.read_text()


def test_the_emulated_node_keeps_every_rule(arm: Path, tmp_path: Path, prepared: Path) -> None:
    desk = Desk(tmp_path, prepared)
    emulated = Emulated(arm / "m4-node.elf", desk.links.can, desk.new_uuid())
    try:
        assert emulated.ready.wait(60)
        station: Station = desk.station()
        assert station.passphrase == PASSPHRASE
        told = station.run("--json", "node", "check", "--factory", "--yes", *desk.links.over("can")).json
        assert [rule for rule in told["checks"] if rule["result"] == "failed"] == []
        assert told["passed"] > 90
        stack, node = emulated.sizes()
        assert stack <= STACK * MORE
        assert node <= NODE * MORE
    finally:
        emulated.close()
        desk.clear()
