"""The paced host port: a frame in C takes as long as the reference says, and the bench can do with what it tells."""

from __future__ import annotations

import ctypes
import json
import random
import signal
import subprocess

import pytest

from teds_provision.links.can.pacing import FD_LENGTHS, classic_bits, fd_seconds
from teds_provision.node.nfc.server import answer_seconds, command_seconds
from tests.e2e.desk import Desk, Station
from tests.firmware import builds
from tests.firmware.conftest import CNode

pytestmark = pytest.mark.system

DICE = random.Random(24)


class Frame(ctypes.Structure):
    """``teds_can_frame``."""

    _fields_ = (
        ("identifier", ctypes.c_uint32),
        ("length", ctypes.c_uint8),
        ("fd", ctypes.c_bool),
        ("data", ctypes.c_uint8 * 64),
    )


@pytest.fixture(scope="module")
def pacing(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """``firmware/port/posix/pacing.c`` alone."""
    builds.need("gcc")
    library = tmp_path_factory.mktemp("pacing") / "pacing.so"
    where = [f"-I{builds.FIRMWARE / 'include'}", "-DTEDS_NFC=1"]
    source = builds.FIRMWARE / "port/posix/pacing.c"
    subprocess.run(["gcc", "-shared", "-fPIC", *where, str(source), "-o", str(library)], check=True)
    loaded = ctypes.CDLL(str(library))
    loaded.host_wire_ns.restype = loaded.host_air_ns.restype = ctypes.c_uint64
    return loaded


def any_octets(length: int) -> bytes:
    """At random, with long runs of equal bits now and then."""
    return DICE.choice((DICE.randbytes(length), bytes(length), b"\xff" * length, b"\xcc" * length))


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
def test_a_frame_is_on_the_wire_as_long_as_the_reference_says(pacing: ctypes.CDLL, fd: bool) -> None:
    for _ in range(300):
        identifier, data = DICE.getrandbits(29), any_octets(DICE.choice(FD_LENGTHS if fd else range(9)))
        frame = Frame(identifier, len(data), fd, (ctypes.c_uint8 * 64)(*data))
        taken = pacing.host_wire_ns(ctypes.byref(frame), 500_000, 2_000_000) / 1e9
        due = fd_seconds(identifier, data, 500_000, 2_000_000) if fd else classic_bits(identifier, data) / 500_000
        assert taken == pytest.approx(due, abs=2e-9), (hex(identifier), data.hex())


@pytest.mark.parametrize("command", [b"\x26", b"\x52", b"\x93\x20", bytes(7), b"\xe0\x80", bytes(120)])
def test_an_answer_is_in_the_air_as_long_as_the_reference_says(pacing: ctypes.CDLL, command: bytes) -> None:
    taken = pacing.host_air_ns(command, len(command), 17) / 1e9
    delays = (9 * 128 + 84 + 1172) / 13.56e6  # ISO/IEC 14443-3 clause 6.2, both directions
    assert taken == pytest.approx(command_seconds(command) + answer_seconds(command, bytes(17)) + delays, abs=2e-9)


def test_it_reports_at_its_end_its_own_share_of_an_exchange(desk: Desk, station: Station, node: CNode) -> None:
    node.start("--pace")
    assert station.ask("identify", *desk.links.over("can"))["uuid"] == node.uuid
    assert node.process is not None
    node.process.signal(signal.SIGTERM)
    _, usage = map(json.loads, node.process.end().out.splitlines())
    assert usage["turns"] >= 1
    assert usage["turned"] > 0
    assert usage["chip"] > 0, "Prove is a signature"
    assert usage["flash"] == 0, "nothing is stored"
