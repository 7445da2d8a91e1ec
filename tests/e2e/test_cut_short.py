"""Power cuts, ``kill -9`` and Ctrl-C at every step of a provisioning: the same command carries on from there."""

from __future__ import annotations

import signal
import sqlite3
import time
from collections.abc import Callable
from contextlib import closing

import pytest

from tests.pace import PATIENCE

from .desk import ANGLE, Desk, Node, Running, Station

pytestmark = [pytest.mark.link, pytest.mark.needs("a slow chip")]

SLOW = ("--crypto-delay", "120", "--flash-delay", "250")
"""A node slow enough that every step can be met in the middle; milliseconds."""

OTHER_MOMENTS = pytest.mark.nightly(
    "tests/e2e/test_cut_short.py::test_a_killed_station_carries_on is killed between and in all three transactions; "
    "tests/provisioning/test_provision.py::test_cut_at_every_message_the_same_command_carries_on cuts all others"
)

OTHER_POWER = pytest.mark.nightly(
    "tests/e2e/test_cut_short.py::test_a_node_that_lost_power_is_carried_on_with[in the write-nfc]; over CAN "
    "tests/e2e/test_cut_short.py::test_a_node_whose_power_only_flickers_needs_no_second_command_or_one[can]"
)

OTHER_LINK = pytest.mark.nightly(
    "tests/e2e/test_cut_short.py::test_a_node_whose_power_only_flickers_needs_no_second_command_or_one[can], "
    "tests/e2e/test_cut_short.py::test_a_station_that_fell_asleep_in_the_write_wakes_up_well[nfc]: one of each link"
)

OTHER_CTRL_C = pytest.mark.nightly(
    "tests/e2e/test_cut_short.py::test_ctrl_c_ends_at_once_and_loses_nothing[in the write-nfc] ends a wait on that link"
)

Moment = Callable[[Station, Node, Running], bool]


def notices(step: str) -> Moment:
    """The station has just said that ``step`` is done: it is in the next one."""
    return lambda station, node, command: f"✓ {step}" in command.err


def key_pending(station: Station, node: Node, command: Running) -> bool:
    """The station has stored the new key and sends Confirm (loss table, third row)."""
    with closing(sqlite3.connect(f"file:{station.home}/store.sqlite3?mode=ro", uri=True)) as database:
        return database.execute("SELECT count(*) FROM keys WHERE state = 'pending'").fetchone()[0] > 0


def key_on_node(station: Station, node: Node, command: Running) -> bool:
    """The node has committed the key; its reply is on the way."""
    return node.flash["key"] is not None


def sheet_on_node(station: Station, node: Node, command: Running) -> bool:
    """The node has committed the datasheet; its reply, read-back and verification are still to come."""
    return bool(node.flash["provisioned"])


MOMENTS = {
    "once identified": notices("identify"),
    "in the agreement": notices("whitelist"),
    "key stored, not confirmed": key_pending,
    "key committed, reply under way": key_on_node,
    "agreed": notices("agree"),
    "built": notices("build"),
    "in the write": notices("sign"),
    "datasheet committed": sheet_on_node,
    "in the verification": notices("write"),
}


def start(station: Station, via: str) -> Running:
    return station.start("provision", "--profile", ANGLE, "--yes", "--timeout", "55", *station.desk.links.over(via))


def reaches(moment: Moment, station: Station, node: Node, command: Running) -> bool:
    """Let a command run up to the moment; whether it was seen before the command had ended."""
    end = time.monotonic() + PATIENCE
    while not moment(station, node, command):
        assert time.monotonic() < end, (command.out, command.err)
        command.read(0.002)
        if command.process.poll() is not None:
            assert command.end().code == 0, (command.out, command.err)
            return False
    return command.process.poll() is None


def up_to(
    moment: Moment, station: Station, node: Node, via: str, slow: tuple[str, ...] = SLOW
) -> tuple[Node, Running, dict[str, bool]]:
    """Provision a node up to this moment: the node, the command that is at it, the node's links.

    On a busy machine this test may not be run while the moment lasts: then again, with another node that is slower.
    """
    wires = {"nfc": via == "nfc", "can": via == "can"}
    for times in (1, 4, 16):
        node.start(*(str(int(word) * times) if word.isdecimal() else word for word in slow), **wires)
        command = start(station, via)
        if reaches(moment, station, node, command):
            return node, command, wires
        node.stop()
        node = station.desk.node(f"slower-{times}")
    raise AssertionError("the moment was never met")


def carries_on(station: Station, node: Node, via: str) -> None:
    """The same command ends well; station and node agree on one key, and the log is whole."""
    done = station.provision(via, "--profile", ANGLE)
    assert done["verdict"] == "authentic"
    flash = node.flash
    assert flash["provisioned"] is True
    assert station.keys(node.uuid) == [("active", flash["epoch"])]
    assert len(node.datasheet) == 5
    assert station.log_is_whole()


KILLED = {
    ("key stored, not confirmed", "nfc"),
    ("key committed, reply under way", "can"),
    ("in the write", "nfc"),
    ("datasheet committed", "nfc"),
}
"""Moments of the gate: between the two ends' durable writes of the key, in the write, and behind it."""


@pytest.mark.parametrize(
    ("moment", "via"),
    [
        pytest.param(moment, via, marks=() if (moment, via) in KILLED else OTHER_MOMENTS)
        for via, moments in (("nfc", [*MOMENTS]), ("can", [*MOMENTS][1:-1:2]))
        for moment in moments
    ],
)
def test_a_killed_station_carries_on(desk: Desk, station: Station, node: Node, moment: str, via: str) -> None:
    node, command, _ = up_to(MOMENTS[moment], station, node, via)
    command.signal(signal.SIGKILL)
    assert command.end().code == -signal.SIGKILL
    carries_on(station, node, via)


@pytest.mark.parametrize("via", ["nfc", pytest.param("can", marks=OTHER_LINK)])
def test_a_node_that_is_still_storing_the_key_when_the_next_run_begins(station: Station, node: Node, via: str) -> None:
    """It identifies itself as in factory state and is keyed a moment later: the key that was sent is found to work."""
    node, command, _ = up_to(key_pending, station, node, via, ("--flash-delay", "1500"))
    command.signal(signal.SIGKILL)
    command.end()
    carries_on(station, node, via)
    assert node.flash["epoch"] == 1 or via == "nfc"


@pytest.mark.parametrize(
    ("moment", "via"),
    [
        pytest.param("in the agreement", "nfc", marks=OTHER_POWER),
        pytest.param("key committed, reply under way", "can", marks=OTHER_POWER),
        pytest.param("agreed", "nfc", marks=OTHER_POWER),
        ("in the write", "nfc"),
        pytest.param("in the write", "can", marks=OTHER_POWER),
    ],
)
def test_a_node_that_lost_power_is_carried_on_with(station: Station, node: Node, moment: str, via: str) -> None:
    """The node is gone for good; the command says so with exit 5, and the same one finishes when it is back."""
    node, command, wires = up_to(MOMENTS[moment], station, node, via)
    node.kill()
    outcome = command.end()
    assert outcome.code == 5, outcome
    assert outcome.out == ""
    assert "Error:" in outcome.err
    assert "Traceback" not in outcome.err
    node.start(**wires)
    carries_on(station, node, via)


@pytest.mark.parametrize("via", [pytest.param("nfc", marks=OTHER_LINK), "can"])
def test_a_node_whose_power_only_flickers_needs_no_second_command_or_one(
    station: Station, node: Node, via: str
) -> None:
    node, command, wires = up_to(MOMENTS["in the write"], station, node, via)
    node.kill()
    node.start(**wires)
    outcome = command.end()
    assert outcome.code in (0, 5), outcome
    carries_on(station, node, via)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("moment", "via"),
    [
        pytest.param("in the agreement", "nfc", marks=OTHER_CTRL_C),
        ("key stored, not confirmed", "can"),
        ("in the write", "nfc"),
    ],
)
def test_ctrl_c_ends_at_once_and_loses_nothing(station: Station, node: Node, moment: str, via: str) -> None:
    node, command, _ = up_to(MOMENTS[moment], station, node, via)
    assert node.process is not None
    node.process.signal(signal.SIGSTOP)  # so that no answer ends the wait, which goes on for 5 s and more
    began = time.monotonic()
    command.signal(signal.SIGINT)
    outcome = command.end()
    assert outcome.code == 130
    assert time.monotonic() - began < 5
    node.process.signal(signal.SIGCONT)
    assert outcome.err.rstrip().endswith("Run the same command again to continue.")
    assert "Traceback" not in outcome.err
    carries_on(station, node, via)


def test_ctrl_c_while_waiting_for_a_node(station: Station, node: Node) -> None:
    before = station.tables()
    command = start(station, "nfc")
    command.wait_for("Place the node")
    command.signal(signal.SIGINT)
    assert command.end(40).code == 130, "and not after the 55 s for which it waits"
    assert station.tables() == before
    node.start()
    carries_on(station, node, "nfc")


@pytest.mark.parametrize("via", ["nfc", pytest.param("can", marks=OTHER_LINK)])
def test_a_station_that_fell_asleep_in_the_write_wakes_up_well(station: Station, node: Node, via: str) -> None:
    node, command, _ = up_to(MOMENTS["in the write"], station, node, via)
    command.signal(signal.SIGSTOP)
    time.sleep(2.5)
    command.signal(signal.SIGCONT)
    outcome = command.end()
    assert outcome.code in (0, 5), outcome
    carries_on(station, node, via)


def kill_after_growing_delays(station: Station, node: Node, via: str, *, first: float, step: float) -> int:
    """Kill the command after ever longer; returns how often it was killed before it ended by itself."""
    kills, delay = 0, first
    while True:
        command = start(station, via)
        end = time.monotonic() + delay
        while time.monotonic() < end and command.process.poll() is None:
            command.read(0.01)
        if command.process.poll() is not None:
            assert command.end().code == 0, (command.out, command.err)
            return kills
        command.signal(signal.SIGKILL)
        command.end()
        kills, delay = kills + 1, delay + step


@pytest.mark.parametrize("via", ["nfc", "can"])
@pytest.mark.nightly("tests/e2e/test_cut_short.py::test_a_killed_station_carries_on at the moments that matter")
def test_a_station_that_is_killed_again_and_again_gets_there(station: Station, node: Node, via: str) -> None:
    node.start(*SLOW, nfc=via == "nfc", can=via == "can")
    assert kill_after_growing_delays(station, node, via, first=0.3, step=0.15) > 2
    carries_on(station, node, via)


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize("via", ["nfc", "can"])
@pytest.mark.parametrize("first", [0.02, 0.027, 0.034])
def test_killed_at_every_hundredth_of_a_second(
    desk: Desk, station: Station, node: Node, via: str, first: float
) -> None:
    node.start("--crypto-delay", "20", "--flash-delay", "40", nfc=via == "nfc", can=via == "can")
    assert kill_after_growing_delays(station, node, via, first=first, step=0.02) > 5
    carries_on(station, node, via)
