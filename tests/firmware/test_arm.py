"""The library on Cortex-M0+, M4 and M33: sizes, stack and instructions held at what was measured and a fifth more."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import pytest

from tests.bench import PASSPHRASE
from tests.e2e.desk import Desk, Station
from tests.firmware import budgets, builds
from tests.firmware.bridge import EmulatedBoard
from tests.firmware.budgets import MORE
from tests.vectors import c_arrays

pytestmark = pytest.mark.machine

MACHINES = {
    ("m0", "measure"): "microbit",
    ("m0", "steps"): "mps2-an386",  # no Cortex-M0 of qemu has the RAM of a node; an M4 runs the same instructions
    ("m4", "measure"): "mps2-an386",
    ("m4", "steps"): "mps2-an386",
    ("m33", "measure"): "mps2-an505",
    ("m33", "steps"): "mps2-an505",
}


@pytest.fixture(scope="module")
def arm() -> Path:
    if lack := builds.missing("arm-none-eabi-gcc", "qemu-system-arm"):
        pytest.fail(f"{lack}: make firmware-arm installs it")
    c_arrays.main([str(builds.ROOT / "build" / "vectors-c")])
    builds.make("arm")
    return builds.BUILD / "arm"


def sizes(archive: Path) -> tuple[int, int, int]:
    """Return octets of text, data and bss."""
    outcome = subprocess.run(
        ["arm-none-eabi-size", "-t", str(archive)], capture_output=True, text=True, check=True
    ).stdout.splitlines()[-1]
    text, data, bss = map(int, outcome.split()[:3])
    return text, data, bss


@pytest.mark.parametrize("build", list(budgets.TEXT))
def test_code_stays_within_its_budget_and_nothing_is_global(arm: Path, build: str) -> None:
    text, data, bss = sizes(arm / f"{build}.a")
    assert text <= budgets.TEXT[build] * MORE
    assert (data, bss) == (0, 0)


def test_a_small_node_is_as_small_as_promised(tmp_path: Path) -> None:
    source = tmp_path / "size.c"
    source.write_text(
        f'#include "teds/node.h"\ntypedef char fits[sizeof(teds_node) <= {budgets.SMALL_BOUND} ? 1 : -1];\n'
        f"typedef char told[sizeof(teds_node) == {budgets.SMALL} ? 1 : -1];\n"
    )
    words = ["-mthumb", "-mcpu=cortex-m4", f"-I{builds.FIRMWARE}/include", *budgets.SMALL_WORDS, "-fsyntax-only"]
    done = subprocess.run(["arm-none-eabi-gcc", *words, str(source)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def counted(arm: Path, cpu: str, image: str) -> dict[tuple[str, str], int]:
    """Return what an image says of each step under qemu: instructions and stack."""
    words = ["qemu-system-arm", "-M", MACHINES[cpu, image], "-display", "none", "-monitor", "none", "-serial", "none"]
    words += ["-semihosting-config", "enable=on,target=native", "-icount", "shift=0"]
    done = subprocess.run(
        [*words, "-kernel", str(arm / f"{cpu}-{image}.elf")], capture_output=True, text=True, check=False, timeout=120
    )
    stderr = done.stdout + done.stderr
    assert "wrong" not in stderr, stderr
    return {(step, what): int(number) for step, what, number in re.findall(r"(\S+) (instructions|stack) (\d+)", stderr)}


@pytest.mark.parametrize("cpu", list(budgets.CPUS))
def test_what_a_point_operation_costs_is_counted(arm: Path, cpu: str) -> None:
    found = counted(arm, cpu, "measure")
    for step, most in budgets.POINTS[cpu].items():
        assert found[step, "instructions"] <= most * MORE, step


@pytest.mark.parametrize("cpu", list(budgets.CPUS))
def test_each_step_of_a_node_stays_within_its_instructions_and_its_stack(arm: Path, cpu: str) -> None:
    """Each reply is the published one, octet for octet, so the steps are what they say."""
    found = counted(arm, cpu, "steps")
    for step, most in budgets.STEPS[cpu].items():
        assert found[step, "instructions"] <= most.instructions * MORE, step
        assert found[step, "stack"] <= most.stack * MORE, step


def test_no_function_of_the_library_calls_itself_or_has_an_array_of_variable_length(arm: Path) -> None:
    calls: dict[str, set[str]] = {}
    for report in (arm / "m4-full").glob("*.ci"):
        for source, target in re.findall(r'sourcename: "([^"]+)" targetname: "([^"]+)"', report.read_text()):
            calls.setdefault(source.split(":")[-1], set()).add(target.split(":")[-1])
    for name, called in calls.items():
        seen: set[str] = set()
        ahead = set(called)
        while ahead:
            address = ahead.pop()
            seen.add(address)
            ahead |= calls.get(address, set()) - seen
        assert name not in seen, f"{name} calls itself"
    for usage in (arm / "m4-full").glob("*.su"):
        assert "dynamic" not in usage.read_text()


def test_the_emulated_node_keeps_every_rule(arm: Path, tmp_path: Path, prepared: Path) -> None:
    desk = Desk(tmp_path, prepared)
    emulated = EmulatedBoard(arm / "m4-node.elf", desk.links.can, desk.new_uuid())
    try:
        assert emulated.ready.wait(60)
        station: Station = desk.station()
        assert station.passphrase == PASSPHRASE
        report = station.run("--json", "node", "check", "--factory", "--yes", *desk.links.over("can")).json
        assert [rule for rule in report["checks"] if rule["result"] == "failed"] == []
        assert report["passed"] > 90
        stack, node = emulated.sizes()
        assert stack <= min(budgets.STACK * MORE, budgets.STACK_BOUND)
        assert node <= budgets.NODE * MORE
    finally:
        emulated.close()
        desk.clear()
