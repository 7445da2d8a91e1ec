"""Boards pulled off the reader in the middle of a command under --watch: told, and done when they are put back."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.links.nfc.field import Field

from .desk import ANGLE, ROOT, Links, Running, Station

pytestmark = pytest.mark.link
BOARDS = 6
SAID = 8.0  # seconds after the last frame in which a lost board would be reported


@pytest.fixture
def field() -> Iterator[Field]:
    field = Field()
    yield field
    field.close()


@pytest.fixture
def boards(tmp_path: Path) -> Iterator[list[tuple[str, str]]]:
    """UUID and path of a few factory nodes, none of them on the reader yet."""
    paths = [Links().nfc for _ in range(BOARDS)]
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.e2e.boards", tmp_path / "boards", *paths],
        cwd=ROOT,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin
    assert process.stdout
    yield list(zip(json.loads(process.stdout.readline()), paths, strict=True))
    process.stdin.close()
    process.wait(60)
    process.stdout.close()


def pulled_at(watch: Running, field: Field, path: str, frames: int, lines: int) -> Any:
    """Return what is said of a board that is lifted off after so many frames; of one not identified by then nothing is.

    Such a board is put down again, for a few frames more: how many polls come first is the reader's affair.
    """
    for more in range(0, 40, 2):
        field.put(path, lift_after=frames + more)
        deadline = time.monotonic() + SAID
        while watch.out.count("\n") < lines and not (field.empty and time.monotonic() > deadline):
            deadline = deadline if field.empty else time.monotonic() + SAID
            watch.read(0.1)
        if watch.out.count("\n") >= lines:
            break
    return watch.wait_for_lines(lines)[-1]


def pull_each(watch: Running, field: Field, boards: list[tuple[str, str]], key: str, parts: tuple[float, ...]) -> None:
    """Two boards left alone, then others, each pulled at one of these ``parts`` of its frames, put back, and done.

    Each pull has its error line, and the board its good line once it lies there again.
    """
    counts = []
    for number, (uuid, path) in enumerate(boards[:2]):
        field.put(path)
        assert watch.wait_for_lines(number + 1)[-1]["uuid"] == uuid
        counts.append(field.frames)
    lines, pulled = 2, 0
    for (uuid, path), part in zip(boards[2:], parts, strict=False):
        done = pulled_at(watch, field, path, int(min(counts) * part), lines + 1)
        lines += 1
        if "error" in done:
            pulled += 1
            assert done["error"]["code"] == "node-silent", done
            field.put(path)
            done = watch.wait_for_lines(lines + 1)[-1]
            lines += 1
        assert done.get("uuid") == uuid, done
        assert key in done
    assert pulled >= len(parts) - 1  # on a busy machine one may have needed fewer frames, and be done before


@pytest.mark.nightly(
    "tests/e2e/test_pulled_steps.py::test_above_the_udp_driver pulls at the start of every step and half written"
)
def test_pulled_at_every_part_of_provision(station: Station, field: Field, boards: list[tuple[str, str]]) -> None:
    watch = station.start("--json", "provision", "--watch", "--yes", "--profile", ANGLE, "--nfc", field.path)
    pull_each(watch, field, boards, "verdict", (0.2, 0.4, 0.6, 0.8))  # agree, build, write, verify
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0
    known = {node["uuid"]: node for node in station.ask("nodes")["nodes"]}
    assert {known[uuid]["verdict"] for uuid, _ in boards} == {"authentic"}


@pytest.mark.nightly(
    "tests/e2e/test_pulled_steps.py::test_under_identify_another_one_comes_first, one pull instead of two"
)
def test_pulled_while_it_is_identified(station: Station, field: Field, boards: list[tuple[str, str]]) -> None:
    watch = station.start("--json", "identify", "--watch", "--nfc", field.path)
    pull_each(watch, field, boards, "fingerprint", (0.6, 0.75))
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0


@pytest.fixture
def serial(field: Field) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """A PN532 on a serial line, below nfcpy's own driver; its field is ``field``."""
    if not os.access("/dev", os.W_OK):
        pytest.skip("nfcpy looks for serial lines in /dev alone, and this user may not put one there")
    name = f"ttyTP{os.getpid()}"
    process = subprocess.Popen(
        [sys.executable, "-m", "tests.links.nfc.pn532_chip", name, field.path],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdout
    assert process.stdout.readline() == "ready\n"
    yield f"tty:{name}:pn532", process
    if process.poll() is None:
        process.terminate()
        process.wait(60)
    process.stdout.close()


@pytest.mark.nightly(
    "tests/e2e/test_pulled_steps.py::test_above_the_udp_driver; the same driver and chip are held by "
    "tests/e2e/test_pulled.py::test_a_pn532_needs_few_host_commands_and_one_lost_answer_is_not_reported"
)
def test_pulled_above_a_pn532_on_a_serial_line(
    station: Station, field: Field, boards: list[tuple[str, str]], serial: tuple[str, subprocess.Popen[str]]
) -> None:
    watch = station.start("--json", "provision", "--watch", "--yes", "--profile", ANGLE, "--nfc", serial[0])
    pull_each(watch, field, boards, "verdict", (0.3, 0.8))
    watch.signal(signal.SIGTERM)
    assert watch.end().code == 0


# Four processes play the chip, which gives a tag its time-outs of a tenth of a second: one late is a tag lifted.
@pytest.mark.realtime
def test_a_pn532_needs_few_host_commands_and_one_lost_answer_is_not_reported(
    station: Station, field: Field, boards: list[tuple[str, str]], serial: tuple[str, subprocess.Popen[str]]
) -> None:
    place, process = serial
    uuid, path = boards[0]
    field.put(path)
    done = station.ask("provision", "--yes", "--profile", ANGLE, "--nfc", place)
    assert (done["uuid"], done["verdict"]) == (uuid, "authentic")
    process.send_signal(signal.SIGUSR1)
    time.sleep(0.1)
    again = station.run("--json", "verify", uuid, "--nfc", place)
    assert again.code == 0, again
    process.terminate()
    commands = int(process.communicate(timeout=60)[0].split()[-1])
    assert commands < 500, f"{commands} host commands for provision and verify; 786 before, with identify"
