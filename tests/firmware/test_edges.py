"""What a board may get wrong before it starts, and what its interrupts do while its loop is held up."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from teds_provision.protocol.messages.frames import Function, security_command
from tests.firmware import builds
from tests.firmware.memory_node import MemoryNode
from tests.firmware.test_beside_python import MS, Station, Twins
from tests.protocol.desk import NODE, UUID

pytestmark = pytest.mark.system
_USAGE = -1
_SENSOR, _ACTUATOR, _EVENT = 0, 1, 2


@pytest.mark.parametrize(
    ("table", "starts"),
    [
        ([], True),
        ([(1, _SENSOR, 2), (9, _ACTUATOR, 200), (255, _EVENT, 8)], True),
        ([(1, _EVENT, 1), (2, _EVENT, 1)], True),
        ([(1, _EVENT, 1), (2, _EVENT, 1), (3, _EVENT, 1)], False),
        ([(0, _SENSOR, 2)], False),
        ([(2, _SENSOR, 2), (1, _SENSOR, 2)], False),
        ([(2, _SENSOR, 2), (2, _ACTUATOR, 2)], False),
        ([(1, 3, 2)], False),
        ([(1, _SENSOR, 0)], False),
        ([(1, _EVENT, 9)], False),
        ([(number, _SENSOR, 1) for number in range(1, 9)], True),
        ([(number, _SENSOR, 1) for number in range(1, 10)], False),
    ],
)
def test_a_channel_table_that_cannot_be_served_is_reported_at_the_start(
    table: list[tuple[int, int, int]], starts: bool
) -> None:
    """-1, and not a channel that is never heard of."""
    node = MemoryNode(lambda kind, size: NODE.secret() if kind == "i" else bytes(size), lambda: 0.0, uuid=UUID)
    for number, kind, octets in table:
        node.add_channel(number, kind, octets)
    assert node.start() == (0 if starts else _USAGE)
    node.close()


@pytest.mark.parametrize("lost", [0, 1, 300])
def test_events_that_found_no_room_are_counted(lost: int) -> None:
    """The loop is held up by a point multiplication: its ring keeps four, and the counter shows the others."""
    twins = Twins(3)
    station = Station(twins, 3)
    station.begin_measuring()
    asked = bytes([0, 1, 1]) + (0).to_bytes(2, "big") + MS.to_bytes(8, "big") + bytes(8) + b"\x09"
    assert station.sealed(security_command(Function.SUBSCRIBE, asked), "can:f1")[0]
    twins.pass_time(50 * MS)
    for _ in range(4 + lost):
        twins.hardware.tick += 2 * MS
        twins.c.interrupt(9, twins.hardware.tick, b"\x12\x34")
    assert _counters(twins) == [3]  # of those that wait the newest leaves
    twins.hardware.tick += 2 * MS
    twins.c.interrupt(9, twins.hardware.tick, b"\x12\x35")
    assert _counters(twins) == [4 + lost]
    twins.c.close()


def _counters(twins: Twins) -> list[int]:
    """Of the messages that leave now."""
    twins.c.poll()
    counters = []
    while (frame := twins.c.next_frame()) is not None:
        if frame[0] >> 8 & 7 == 0:
            counters.append(int.from_bytes(frame[1][:4], "big"))
        twins.hardware.tick += MS // 100
    return counters


BOUNDS = {
    "TEDS_MAX_MESSAGE": (512, 4094),
    "TEDS_STAGING": (512, 60000),
    "TEDS_CAN_LINES": (3, 7),
    "TEDS_CAN_BLOCK": (0, 255),
    "TEDS_CAN_STMIN": (0, 0xF9),
    "TEDS_CHANNELS": (1, 32),
    "TEDS_STREAMS": (1, 127),
    "TEDS_DRIVE_OCTETS": (1, 200),
    "TEDS_EVENTS": (1, 254),
    "TEDS_EVENT_OCTETS": (1, 219),
    "TEDS_MAX_NDEF": (160, 32000),
    "TEDS_BLE_CONNECTIONS": (2, 20),
}


def _compiles(*words: str, what: list[str]) -> subprocess.CompletedProcess[str]:
    where = [f"-I{builds.FIRMWARE}/include", f"-I{builds.FIRMWARE}/src"]
    warnings = ["-std=c99", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-pedantic", "-Werror", "-fsyntax-only"]
    return subprocess.run(["gcc", *warnings, *words, *where, *what], capture_output=True, text=True, check=False)


@pytest.mark.parametrize("sessions", [2, 3, 4, 5, 6, 20])
def test_there_is_a_line_for_each_session_and_one_more_whatever_their_number(sessions: int) -> None:
    builds.need("make", "gcc")
    assert _compiles(f"-DTEDS_SESSIONS={sessions}", what=[str(builds.FIRMWARE / "src/can.c")]).returncode == 0


_BOARD = """
#include "teds/node.h"
#include <stdio.h>
#include <string.h>

static struct { teds_node node; unsigned char behind[1 << 16]; } ram;

int main(void)
{
    teds_config config = {0};
    teds_port port = {0};
    int failed;
    memset(&ram, 0xA5, sizeof ram);
    failed = teds_node_init(&ram.node, &config, &port);
    for (size_t i = 0; i < sizeof ram; i++) {
        if (((unsigned char *)&ram)[i] != 0xA5) {
            return 1;
        }
    }
    printf("%d", failed);
    return 0;
}
"""


@pytest.mark.parametrize(
    "board", ["-UTEDS_NFC", "-UTEDS_BLE", "-DTEDS_STAGING=2048", "-DTEDS_OPERATION=0", "-DTEDS_SHA256_OCTETS=100"]
)
def test_a_board_that_was_compiled_with_other_options_is_reported_before_anything_is_written(
    board: str, tmp_path: Path
) -> None:
    """The library's node is larger than the board's: the octets behind it are not its own."""
    (tmp_path / "board.c").write_text(_BOARD)
    objects, words = builds.objects(1024, 4096)  # of another test
    command = ["gcc", "-w", *words, board, str(tmp_path / "board.c"), *map(str, objects), "-lbearssl"]
    subprocess.run([*command, "-o", str(tmp_path / "board")], cwd=builds.FIRMWARE, check=True)
    done = subprocess.run([tmp_path / "board"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "-6")


@pytest.mark.parametrize("end", [0, 1], ids=["least", "most"])
def test_it_compiles_at_the_ends_of_every_size(end: int) -> None:
    builds.need("make", "gcc")
    words = [f"-D{name}={bounds[end]}" for name, bounds in BOUNDS.items()]
    sources = [str(path) for path in sorted((builds.FIRMWARE / "src").glob("*.c"))]
    done = _compiles(*words, "-DTEDS_NFC=1", "-DTEDS_BLE=1", what=sources)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    "word",
    [
        *(f"{name}={bounds[0] - 1}" for name, bounds in BOUNDS.items()),
        *(f"{name}={bounds[1] + 1}" for name, bounds in BOUNDS.items()),
        *("TEDS_CAN_STMIN=0x80", "TEDS_SESSIONS=1", "TEDS_REPLIES=1", "TEDS_REPLIES=2 TEDS_NFC=1", "TEDS_REPLIES=128"),
        *("TEDS_EVENT_CHANNELS=0", "TEDS_EVENT_CHANNELS=9", "TEDS_SESSIONS=4 TEDS_CAN_LINES=4"),
    ],
)
def test_a_size_beyond_its_bounds_does_not_compile(word: str) -> None:
    """Where an index would wrap, and the warning that says so is not asked for."""
    builds.need("make", "gcc")
    words = [f"-D{name}" for name in word.split()]
    done = _compiles(*words, what=[str(builds.FIRMWARE / "src/octets.c"), str(builds.FIRMWARE / "src/isotp.c")])
    assert done.returncode != 0
    assert "#error" in done.stderr
