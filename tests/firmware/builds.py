"""What ``firmware/Makefile`` builds for the tests, and why a test of it is skipped where that cannot be built."""

from __future__ import annotations

import fcntl
import functools
import os
import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FIRMWARE = ROOT / "firmware"
BUILD = FIRMWARE / os.environ.get("TEDS_C_BUILD", "build")
WORDS = tuple(os.environ.get("TEDS_C_WORDS", "LEVEL=-O0,HOST_LEVEL=-O0,DEBUG=-g1").split(","))
"""Where and how the tests build: make firmware-coverage has a place of its own."""
AT_THE_GATE = os.environ.get("CI", "").lower() not in ("", "0", "false")


def missing(*programs: str, headers: tuple[str, ...] = ("bearssl.h",)) -> str:
    """Return what of these is not on this machine, as a sentence; "" if all is there."""
    lacks = [name for name in programs if shutil.which(name) is None]
    lacks += [name for name in headers if not Path("/usr/include", name).exists()]
    return f"{', '.join(lacks)} missing: scripts/install-test-packages installs it" if lacks else ""


def need(*programs: str, headers: tuple[str, ...] = ("bearssl.h",)) -> None:
    """Skip the test where something is missing; at the gate it has to be there."""
    if lack := missing(*programs, headers=headers):
        assert not AT_THE_GATE, lack
        pytest.skip(lack)


@functools.cache
def make(*words: str) -> str:
    """Run make in firmware/, one process at a time: its output. Fails with what the compiler says."""
    BUILD.mkdir(parents=True, exist_ok=True)
    with (BUILD / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        command = ["make", "-C", str(FIRMWARE), f"BUILD={BUILD.relative_to(FIRMWARE)}", *WORDS, *words]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def host() -> Path:
    """Return the host port, built."""
    need("make", "gcc")
    make("host")
    return BUILD / "host" / "teds-node"


def compile_host(program: Path, source: Path | None = None, *options: str) -> None:
    """The host port with this file in place of the one of its name, with these options beside its own."""
    need("make", "gcc")
    words = make("-s", "--no-print-directory", "words-of-host").split()
    good = [FIRMWARE / word for word in words if word.endswith(".c")]
    sources = [str(source if source is not None and path.name == source.name else path) for path in good]
    flags = [word for word in words if not word.endswith(".c")]
    done = subprocess.run(
        ["gcc", "-O0", "-w", *flags, *options, *sources, "-o", str(program), "-lbearssl", "-lm"],
        cwd=FIRMWARE, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def host_psa() -> Path:
    """Return the host port over the PSA Crypto API, built."""
    need("make", "gcc", headers=("psa/crypto.h",))
    make("psa")
    return BUILD / "host" / "teds-node-psa"


def board(name: str) -> Path:
    """Return an example board over the stand-in for Zephyr, built."""
    need("make", "gcc", headers=("psa/crypto.h",))
    make("boards")
    return BUILD / "boards" / name


def library(max_message: int = 1024, staging: int = 4096, *, sessions: int = 2, streams: int = 2) -> Path:
    """Return the node over flash in memory, built for these sizes."""
    need("make", "gcc")
    room = f"-{sessions}-{streams}" if (sessions, streams) != (2, 2) else ""
    path = BUILD / "host" / f"memory-{max_message}-{staging}{room}.so"
    make(str(path.relative_to(FIRMWARE)))
    return path


def objects(max_message: int, staging: int) -> tuple[list[Path], list[str]]:
    """Return the objects of that library, and the words by which the compiler made them."""
    folder = library(max_message, staging).with_suffix("")
    words = make("-s", "--no-print-directory", f"words-of-{folder.name}").split()
    return sorted(folder.glob("*.o")), words
