"""The C tests: published vectors, ISO-TP, Announce and Claim, the fuzzers' corpus, under ASan and UBSan."""

from __future__ import annotations

import os
import re
import subprocess

import pytest

from tests.firmware import builds
from tests.vectors import c_arrays

pytestmark = pytest.mark.system

_QUICK = ("LEVEL=-O0", "DEBUG=-g1")
OF_UPDATES_ALONE = "-DTEDS_MANAGED=1 -DTEDS_OPERATION=0"
WARNINGS = [
    *("-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Wstrict-prototypes", "-Wmissing-prototypes"),
    *("-pedantic", "-Werror", "-fsyntax-only"),
]


def test_the_c_tests_find_nothing_wrong() -> None:
    builds.need("make", "gcc")
    c_arrays.main([str(builds.BUILD / "vectors-c")])
    done = subprocess.run(
        ["make", "-C", str(builds.FIRMWARE), "check", f"VECTORS={builds.BUILD / 'vectors-c'}", *_QUICK],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "ASAN_OPTIONS": "detect_leaks=1"},
    )
    assert done.returncode == 0, done.stdout + done.stderr
    for name in ("isotp", "small", "reader", "vectors"):
        assert f"{name}: " in done.stdout
    assert " 0 wrong" in done.stdout


def test_it_compiles_without_a_warning_for_clang_too() -> None:
    builds.need("make", "gcc")
    compiler = next((name for name in ("clang", "clang-14") if not builds.missing(name, headers=())), None)
    if compiler is None:
        pytest.skip("no clang here: scripts/install-firmware-packages installs it")
    folders = ("port/bearssl", "port/posix")
    sources = [path for folder in ("src", *folders) for path in sorted((builds.FIRMWARE / folder).glob("*.c"))]
    where = [f"-I{builds.FIRMWARE / folder}" for folder in ("include", "src", *folders)]
    compiled = [compiler, *WARNINGS, "-DTEDS_NFC=1", "-DTEDS_BLE=1", "-DTEDS_MANAGED=1", *where, *map(str, sources)]
    done = subprocess.run(compiled, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "left_out",
    ["-DTEDS_OPERATION=0", "-DTEDS_CAN_FD=0", "-DTEDS_NFC=1", "-DTEDS_BLE=1", "-DTEDS_MANAGED=1", OF_UPDATES_ALONE],
)
def test_it_compiles_with_parts_left_out(left_out: str) -> None:
    """Sources that name the part; what another has of it is in a header, which these read as well."""
    builds.need("make", "gcc")
    names = re.findall(r"TEDS_\w+", left_out)
    files = sorted((builds.FIRMWARE / "src").glob("*.c"))
    sources = [str(path) for path in files if any(name in path.read_text(encoding="utf-8") for name in names)]
    assert len(sources) > 1
    where = [f"-I{builds.FIRMWARE}/include", f"-I{builds.FIRMWARE}/src"]
    options = left_out.split()
    done = subprocess.run(["gcc", *WARNINGS, *options, *where, *sources], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
