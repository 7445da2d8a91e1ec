"""Files that are none of what a command wants, made to cost much: refused in words, within 10 s and 400 MB."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.bench import PASSPHRASE
from tests.places import free_bus

from .shell import PROGRAM, ROOT, call, clean_environment
from .test_files_named import READ, UUID, desk, words  # noqa: F401  (desk is a fixture)

SECONDS, MEGABYTES = 10, 400
MORE = ("CONFIG", "CONFIG doctor", "FLASH", "node run node --source file:")
"""config.toml, the flash of a virtual node, and files that are named within an option."""
READERS = (
    *READ, *MORE, "ncap run --http 127.0.0.1:0 --tls-key /etc/hostname --tls-cert", "whitelist import --format xml",
    "whitelist import --format csv", "whitelist import --format json", "build UUID --profile",
)  # fmt: skip
NO_FILE = pytest.mark.nightly(
    "tests/cli/test_hostile_files.py::test_a_pipe_without_a_writer_is_no_file holds for each command that it "
    "opens files alone; three of the six are tried with a device too"
)
HERE = "tests/cli/test_hostile_files.py::test_a_large_file_of_the_wrong_kind_costs_little"
SMALL: dict[str, Callable[[], bytes]] = {
    "dots": lambda: b"a" + b".a" * 150_000 + b" = 1\n",
    "deep": lambda: b"[" * 300_000,
    "deep-backup": lambda: b'{"format":"teds-backup/1","a":' + b"[" * 300_000,
    "deep-trace": lambda: b'{"format": "teds-trace/1"}\n' + b"[" * 300_000 + b"\n",
    "digits": lambda: b"timeout = " + b"1" * 5000 + b"\n",
    "digits-json": lambda: b'{"format": "teds-image/1", "uuid": ' + b"1" * 5000 + b"}",
    "digits-csv": lambda: b"raw,value [degree]\n" + b"1" * 5000 + b",0\n5,9\n",
}
LARGE: dict[str, tuple[Callable[[], bytes], tuple[str, ...]]] = {
    "elements": (
        lambda: b"<whitelist>" + b"<a/>" * 15_000_000 + b"</whitelist>",
        ("whitelist import", "show", "restore", "trust ca import", "import-keys"),
    ),
    "texts": (lambda: (b"<" + b"a" * 65_000) * 900, ("whitelist import --format xml",)),
    "objects": (
        lambda: b'{"format":"teds-backup/1","a":[' + b"{}," * 30_000_000 + b"1]}",
        ("restore", "import-keys", "show", "verify", "whitelist import --format json"),
    ),
    "lines": (lambda: b"\n" * 60_000_000, ("whitelist import --format csv", "provision --batch", "trace show")),
    "trace": (lambda: b'{"format": "teds-trace/1"}\n' + b"{}\n" * 20_000_000, ("trace show", "show")),
    "cells": (lambda: b"," * 60_000_000, ("whitelist import --format csv", "provision --batch")),
}


@pytest.fixture
def bench(desk: Path, tmp_path: Path) -> Path:  # noqa: F811
    call(desk, "node", "create", tmp_path / "node", "--profile", "load-cell")
    return desk


def arranged(home: Path, command: str, path: Path) -> list[object]:
    """Return the words of a command that reads the file, after it was put where only its name counts."""
    if command.startswith("CONFIG"):
        (home / "config.toml").unlink(missing_ok=True)
        (home / "config.toml").symlink_to(path)
        return [command.partition(" ")[2] or "nodes"]
    if command == "FLASH":
        (flash := path.parent / "node" / "flash.json").unlink(missing_ok=True)
        flash.symlink_to(path)
        return ["node", "run", "node", "--can", free_bus()]
    if command.endswith("file:"):
        os.environ.pop("TEDS_PROVISION_NFC", None)  # the fixture puts back what was there before
        return [*words(command.removesuffix(" file:")), f"file:{path}", "--can", free_bus()]
    return [*words(command), path]


@pytest.fixture
def fifo(tmp_path: Path) -> Iterator[Path]:
    """Yield a pipe; whoever opens it to read gets its end at last, so that a test that fails ends."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    over = threading.Event()

    def let_go() -> None:
        while not over.wait(SECONDS):
            with open(os.open(path, os.O_RDWR | os.O_NONBLOCK), "wb"):
                pass

    helper = threading.Thread(target=let_go)
    helper.start()
    yield path
    over.set()
    helper.join()


@pytest.mark.parametrize("command", READERS)
def test_a_pipe_without_a_writer_is_no_file(bench: Path, command: str, fifo: Path) -> None:
    """Every one of them waited for ever."""
    began = time.monotonic()
    outcome = call(bench, "--json", *arranged(bench, command, fifo))
    assert time.monotonic() - began < SECONDS
    if command == "CONFIG doctor":
        (check,) = [check for check in outcome.json["checks"] if check["name"] == "config"]
        assert (check["result"], "is a pipe" in check["why"]) == ("failed", True)
        return
    assert outcome.code in (3, 7, 8), outcome.out
    assert fifo.name in outcome.json["error"]["message"]


def test_what_another_command_writes_is_read_through_its_pipe(home: Path, tmp_path: Path) -> None:
    """``<(command)`` of a shell: a pipe too, and its name is that of a descriptor."""
    (tmp_path / "nodes.csv").write_text(f"uuid\n{UUID}\n")
    line = f'exec "$0" -m teds_provision --home "{home}" whitelist import --format csv --dry-run <(cat nodes.csv)'
    done = subprocess.run(
        ["bash", "-c", line, PROGRAM[0]],
        cwd=tmp_path,
        env=clean_environment(PYTHONPATH=str(ROOT)),
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, "1 new" in done.stdout + done.stderr) == (0, True), done


@pytest.mark.parametrize("name", SMALL)
def test_a_small_file_of_the_wrong_kind_is_no_bug(bench: Path, name: str, tmp_path: Path) -> None:
    """config.toml with an integer of 5,000 digits ended with 1; 300,000 dots took minutes."""
    path = tmp_path / name
    path.write_bytes(SMALL[name]())
    for command in READERS:
        if command in ("show", "node run node --source file:"):
            continue  # some of these are hex, or values, for all that they know
        began = time.monotonic()
        outcome = call(bench, "--json", *arranged(bench, command, path))
        assert outcome.code not in (0, 1) or command == "CONFIG doctor", (command, outcome)
        assert "Traceback" not in outcome.err
        assert time.monotonic() - began < SECONDS, command
        (bench / "config.toml").unlink(missing_ok=True)


def of_the_gate() -> list[Any]:
    """Return each kind of file with each command that reads it: the first of them is in the gate.

    The others have the same bounds of the same reader.
    """
    cases = []
    for name, (_, commands) in LARGE.items():
        for number, command in enumerate(commands):
            marks = pytest.mark.nightly(f"{HERE}[{name}-{commands[0]}] meets the bounds of that reader")
            cases.append(pytest.param(name, command, marks=marks if number else ()))
    return cases


@pytest.mark.parametrize(("name", "command"), of_the_gate())
def test_a_large_file_of_the_wrong_kind_costs_little(bench: Path, name: str, command: str, tmp_path: Path) -> None:
    """90 MB of JSON as a backup took 2.3 GB, 60 MB of XML elements a minute."""
    path = tmp_path / name
    path.write_bytes(LARGE[name][0]())
    code, seconds, megabytes, error = measured(bench, *arranged(bench, command, path))
    assert code not in (0, 1), error
    assert seconds < SECONDS
    assert megabytes < MEGABYTES


@pytest.mark.parametrize(
    "command",
    [
        "show",
        "trace show",
        "restore",
        *(pytest.param(command, marks=NO_FILE) for command in ("whitelist import", "verify", "provision --batch")),
    ],
)
def test_a_device_that_never_ends_is_no_file_either(bench: Path, command: str) -> None:
    """``trace show /dev/zero`` took 2 GB."""
    code, seconds, megabytes, error = measured(bench, *arranged(bench, command, Path("/dev/zero")))
    assert (code in (3, 8), seconds < SECONDS, megabytes < MEGABYTES) == (True, True, True), (error, seconds, megabytes)


LAUNCH = """import os, subprocess, sys
process = subprocess.Popen(sys.argv[2:], stdin=subprocess.DEVNULL, pass_fds=[int(sys.argv[1])])
_, status, used = os.wait4(process.pid, 0)
print(os.waitstatus_to_exitcode(status), used.ru_utime + used.ru_stime, used.ru_maxrss / 1024, file=sys.stderr)
"""
"""A small process between: what is forked counts its parent's memory as its own, and that of the tests is large."""


def measured(home: Path, *command: object) -> tuple[int, float, float, str]:
    """How a command ended in a process of its own: exit code, seconds of processor, megabytes at most, stdout."""
    read, write = os.pipe()
    os.write(write, PASSPHRASE.encode() + b"\n")
    os.close(write)
    line = [*PROGRAM, "--home", home, "--json", "--passphrase-fd", read, *command]
    done = subprocess.run(
        [sys.executable, "-S", "-c", LAUNCH, str(read), *map(str, line)], capture_output=True, pass_fds=[read],
        env=clean_environment(PYTHONPATH=str(ROOT)), text=True, check=True,
    )  # fmt: skip
    os.close(read)
    code, seconds, megabytes = done.stderr.splitlines()[-1].split()
    return int(code), float(seconds), float(megabytes), done.stdout


def test_the_page_and_the_code_name_the_bounds_that_are_tested() -> None:
    """The code had 300 MB when the tests and the page had 400."""
    bounds = f"costs more than {SECONDS} s and {MEGABYTES} MB"
    for file in ("docs/formats.md", "teds_provision/limits.py"):
        assert bounds in " ".join((ROOT / file).read_text(encoding="utf-8").split()), file
