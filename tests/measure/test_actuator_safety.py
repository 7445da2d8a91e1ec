"""Whatever dies, the actuator is in its safe state within its dead-man: consumer, station, ROS child, daemon, link.

What counts is the node's own journal: the line of its safe state, with the time at which it began.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from teds_provision.links.can.port import CanPort
from tests.cli.shell import clean_environment
from tests.e2e.desk import ROOT, Running
from tests.links.can.hub import Hub
from tests.measure.rig import Rig, events
from tests.measure.sinks.test_ros1 import Master, master  # noqa: F401  the fixture
from tests.measure.sinks.test_ros1 import pytestmark as what_ros_needs
from tests.ncap.service import Service, verdict, verified
from tests.pace import PATIENCE, until
from tests.places import ros_domain

pytestmark = [*what_ros_needs, pytest.mark.realtime]
DEAD_MAN = 0.5  # seconds
BUSY = 1.0  # seconds that the machine may need to run the node's timer
SHOWN = 5.0  # seconds more until its line is read here
TOPIC = "/bench/g/opening_set_point/cmd"
CUT = 2 * DEAD_MAN


@contextmanager
def rig_on(folder: Path, can: str = "") -> Iterator[Rig]:
    made = Rig(folder, {"g": "gripper"})
    try:
        made.can = can or made.can
        made.nodes["g"].start()
        yield made
    finally:
        made.close()


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    with rig_on(tmp_path) as made:
        yield made


@pytest.fixture
def wire() -> Iterator[Hub]:
    """Yield a bus that can be cut."""
    with closing(Hub()) as hub:
        yield hub


@pytest.fixture
def cut_rig(tmp_path: Path, wire: Hub) -> Iterator[Rig]:
    with rig_on(tmp_path, wire.spec) as made:
        yield made


@dataclass
class Journal:
    """What the gripper says of itself; ``dead_man`` in seconds."""

    node: Running
    dead_man: float = DEAD_MAN

    @classmethod
    def of(cls, rig: Rig, dead_man: float = DEAD_MAN) -> Journal:
        process = rig.nodes["g"].process
        assert process is not None
        return cls(process, dead_man)

    def states(self) -> list[dict[str, Any]]:
        self.node.read(0.05)
        return [line for line in events(self.node.out) if line.get("event") == "actuator" and line["channel"] == 1]

    def moves(self, since: float = 0.0) -> None:
        """Wait until its last word, younger than ``since``, is that it stands where it was told to.

        A word before the last is not enough: a consumer's last values arrive for a moment after its death.
        """
        end = time.monotonic() + PATIENCE
        while not (lines := self.states()) or lines[-1]["safe"] or time_of(lines[-1]) < since:
            assert time.monotonic() < end, ("it does not move", lines[-5:])

    def is_safe(self, since: float) -> None:
        """It was brought to its safe state within its dead-man of ``since`` (unix seconds).

        Where the machine was so busy that its dead-man had run out a little before, that is its last word, and stays.
        """
        end = time.monotonic() + self.dead_man + BUSY + SHOWN
        while True:
            lines = self.states()
            found = [line for line in lines if line["safe"] and time_of(line) >= since - 0.01]
            if found or (lines and lines[-1]["safe"] and time.monotonic() > end - SHOWN):
                break
            assert time.monotonic() < end, (f"not in its safe state since {since}", lines[-5:])
        seconds = time_of(found[0]) - since if found else 0.0
        assert seconds <= self.dead_man + BUSY, f"in its safe state after {seconds:.3f} s"

    def forgets_while_it_hangs(self, publisher: subprocess.Popen[bytes]) -> float:
        """The publisher dies while the node hangs; what it sent meanwhile moves nothing. When the node woke (unix)."""
        self.node.signal(signal.SIGSTOP)
        time.sleep(DEAD_MAN)  # one goes by command in every half dead-man: it waits for its answer now
        publisher.kill()
        time.sleep(CUT)
        lives = time.time()
        self.node.signal(signal.SIGCONT)
        self.is_safe(lives)
        time.sleep(CUT)
        assert all(line["safe"] for line in self.states() if time_of(line) >= lives), "an order of before"
        return lives


def time_of(line: dict[str, Any]) -> float:
    return datetime.fromisoformat(line["time"]).timestamp()


def begin_set(rig: Rig, dead_man: float = DEAD_MAN) -> Running:
    """Hold its opening by command. Begun again where the machine is so busy that the dead-man runs out at once."""
    words = ["set", rig.nodes["g"].uuid, 1, 0.05, "--dead-man", int(dead_man * 1000), "--can", rig.can]
    journal, acting = Journal.of(rig), rig.station.start("--json", *words)

    def moves() -> bool:
        nonlocal acting
        acting.read(0.05)
        if acting.process.poll() is not None:
            acting = rig.station.start("--json", *words)
        return '"applied"' in acting.out and bool(lines := journal.states()) and not lines[-1]["safe"]

    until(moves, lambda: (acting.out, acting.err, journal.states()[-5:]))
    return acting


def test_a_station_that_is_killed_leaves_it_safe(rig: Rig) -> None:
    acting = begin_set(rig)
    killed = time.time()
    acting.process.kill()
    Journal.of(rig).is_safe(killed)


def test_a_station_that_hangs_leaves_it_safe_and_moves_nothing_when_it_wakes(rig: Rig) -> None:
    acting, journal = begin_set(rig), Journal.of(rig)
    stopped = time.time()
    acting.signal(signal.SIGSTOP)
    journal.is_safe(stopped)
    count = len(journal.states())
    acting.signal(signal.SIGCONT)
    outcome = acting.end()
    assert outcome.code in (5, 6), "it says that it lost the actuator"
    journal.node.read(0.3)
    assert all(line["safe"] for line in journal.states()[count:]), "a late order moves nothing"


def test_a_link_that_is_cut_leaves_it_safe_and_the_command_says_so(cut_rig: Rig, wire: Hub) -> None:
    acting, journal = begin_set(cut_rig), Journal.of(cut_rig)
    cut = time.time()
    wire.lose = lambda _identifier, _data: True
    journal.is_safe(cut)
    assert acting.end().code == 5


def test_one_lost_frame_stops_nothing(cut_rig: Rig, wire: Hub) -> None:
    """A value is repeated after a quarter of the dead-man: its second sending still comes in time."""
    long = 4 * DEAD_MAN  # so that a busy machine has three quarters of it
    acting, journal = begin_set(cut_rig, long), Journal.of(cut_rig)
    lost: list[int] = []

    def lose_a_first_frame(identifier: int, data: bytes) -> bool:
        gone = identifier >> 16 == 0x18DA and identifier & 0xFF == 0xF1 and data[0] >> 4 == 1 and not lost
        if gone:
            lost.append(identifier)
        return gone

    began = time.time()
    wire.lose = lose_a_first_frame
    until(lambda: lost)
    time.sleep(1.5 * long)
    assert [line for line in journal.states() if line["safe"] and time_of(line) > began] == []
    acting.signal(signal.SIGTERM)
    assert acting.end().code == 0


def test_a_value_without_an_answer_is_given_up_at_the_dead_man(cut_rig: Rig, wire: Hub) -> None:
    """Replies are lost: a value leaves three times at most, then none until a Clock has had its answer."""
    acting, journal = begin_set(cut_rig), Journal.of(cut_rig)
    cut = time.time()
    wire.lose = lambda identifier, _data: identifier >> 8 == 0x18DAF1
    asked = len(wire.frames)
    assert acting.end().code == 5
    sent = [identifier for identifier, _ in wire.frames[asked:] if identifier & 0xFFFF00FF == 0x18DA00F1]
    assert len(sent) < 100, "letting go is tried, and no value again and again"
    journal.is_safe(cut)


# -- by topics ---------------------------------------------------------------------------------------------------------


@dataclass
class Ros1:
    """A publisher of ROS 1, and the environment of a station that listens."""

    master: Master

    @property
    def environment(self) -> dict[str, str]:
        return {**self.master.environment, "PYTHONPATH": ""}

    @property
    def words(self) -> list[object]:
        return ["--ros1"]

    def publish(self) -> subprocess.Popen[bytes]:
        words = ["pub", "-r", "100", TOPIC, "std_msgs/Float64", "0.05"]
        return _quiet(["/usr/bin/python3", "/usr/bin/rostopic", *words], self.master.environment)


@dataclass
class Ros2:
    """The same of ROS 2."""

    domain: int

    @property
    def environment(self) -> dict[str, str]:
        return {**clean_environment(), "ROS_DOMAIN_ID": str(self.domain)}

    @property
    def words(self) -> list[object]:
        return ["--ros2"]

    def publish(self) -> subprocess.Popen[bytes]:
        module = "tests.measure.sinks.ros2_publisher"
        return _quiet([sys.executable, "-m", module, str(self.domain), TOPIC, "0.05"], self.environment)


def _quiet(command: list[str], environment: dict[str, str]) -> subprocess.Popen[bytes]:
    return subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, cwd=ROOT)


OTHER_ROS = pytest.mark.nightly(
    "tests/measure/test_actuator_safety.py::test_by_topics_consumer_node_and_station_may_die[ros1]: behind both sinks "
    "a set point is one thing to the code; how one comes by ROS 2 is held by "
    "tests/ncap/test_by_topics.py::test_set_points_move_it_and_whatever_dies_it_is_safe"
)


@pytest.fixture(params=["ros1", pytest.param("ros2", marks=OTHER_ROS)])
def ros(request: pytest.FixtureRequest, master: Master) -> Iterator[Ros1 | Ros2]:  # noqa: F811
    with ros_of(request.param, master) as made:
        yield made


@contextmanager
def ros_of(name: str, master: Master) -> Iterator[Ros1 | Ros2]:  # noqa: F811
    """``ros1`` with its master started, or ``ros2`` in a domain of its own."""
    if name == "ros1":
        master.start()
        yield Ros1(master)
    else:
        pytest.importorskip("cyclonedds")
        with ros_domain() as number:
            yield Ros2(number)


@pytest.fixture
def publishers() -> Iterator[list[subprocess.Popen[bytes]]]:
    """Publishers that a test starts; none outlives it."""
    started: list[subprocess.Popen[bytes]] = []
    yield started
    for process in started:
        process.kill()
        process.wait()


def listen(rig: Rig, ros: Ros1 | Ros2) -> Running:
    words = [rig.nodes["g"].uuid, "--rate", 20, *ros.words, "--dead-man", int(DEAD_MAN * 1000)]
    running = rig.begin(*words, environment=ros.environment)
    running.wait_for('"event":"data"')
    return running


def test_by_topics_consumer_node_and_station_may_die(
    rig: Rig, ros: Ros1 | Ros2, publishers: list[subprocess.Popen[bytes]]
) -> None:
    journal, running = Journal.of(rig), listen(rig, ros)
    driven = CanPort(f"{rig.can}&source=0xF6")
    try:
        with driven.listen_frames(lambda frame: frame.identifier >> 16 == 0x18EF) as ear:
            publishers.append(ros.publish())
            journal.moves()
            assert ear.get(30) is not None, "100 values a second go as Drive messages"
    finally:
        driven.close()
    # The consumer dies.
    died = time.time()
    publishers[-1].kill()
    journal.is_safe(died)
    # The node hangs for longer than its dead-man: it is safe, and moves again once it lives.
    publishers.append(ros.publish())
    journal.moves(died)
    journal.node.signal(signal.SIGSTOP)
    time.sleep(CUT)
    lives = time.time()
    journal.node.signal(signal.SIGCONT)
    journal.is_safe(lives)
    journal.moves(lives)
    # The consumer dies while the node hangs: what was sent meanwhile moves nothing when it wakes.
    lives = journal.forgets_while_it_hangs(publishers[-1])
    # The station is killed, with its consumer alive.
    publishers.append(ros.publish())
    journal.moves(lives + CUT)
    killed = time.time()
    running.process.kill()
    journal.is_safe(killed)
    values = {line["value"] for line in journal.states()}
    assert all(value == pytest.approx(0.0, abs=1e-4) or value == pytest.approx(0.05, abs=1e-4) for value in values)


@pytest.mark.nightly(
    "tests/measure/test_actuator_safety.py::test_a_daemon_whose_bus_is_cut_leaves_it_safe_and_holds_again_when_asked, "
    "tests/measure/test_actuator_safety.py::test_a_link_that_is_cut_leaves_it_safe_and_the_command_says_so: a cut; "
    "tests/measure/test_actuator_safety.py::test_by_topics_consumer_node_and_station_may_die[ros1]: by topics"
)
def test_by_topics_the_bus_may_be_cut(
    cut_rig: Rig, wire: Hub, ros: Ros1 | Ros2, publishers: list[subprocess.Popen[bytes]]
) -> None:
    journal, running = Journal.of(cut_rig), listen(cut_rig, ros)
    publishers.append(ros.publish())
    journal.moves()
    cut = time.time()
    wire.lose = lambda _identifier, _data: True
    journal.is_safe(cut)
    back = time.time()
    wire.lose = lambda _identifier, _data: False
    journal.moves(back)
    running.signal(signal.SIGTERM)
    ended = time.time()
    assert running.end().code == 0
    journal.is_safe(ended)


def test_the_ros_child_may_die(rig: Rig, master: Master, publishers: list[subprocess.Popen[bytes]]) -> None:  # noqa: F811
    master.start()
    ros = Ros1(master)
    journal, running = Journal.of(rig), listen(rig, ros)
    publishers.append(ros.publish())
    journal.moves()
    [child] = children(running.process.pid, "ros1_child.py")
    killed = time.time()
    os.kill(child, signal.SIGKILL)
    journal.is_safe(killed)
    journal.moves(killed)  # another child listens; the measurement went on meanwhile
    running.signal(signal.SIGTERM)
    assert running.end().code == 0


def children(parent: int, program: str) -> list[int]:
    """Processes of this parent that run this program."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, IndexError):
            of = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            if of == parent and program in (folder / "cmdline").read_bytes().decode(errors="replace"):
                found.append(int(folder.name))
    return found


# -- by the daemon, a node that is not its own -------------------------------------------------------------------------

HELD = 1.0  # the daemon's dead-man, seconds


@contextmanager
def held(rig: Rig, *words: object) -> Iterator[Service]:
    """Yield a daemon that holds the gripper's opening for half a minute."""
    rig.desk.links = type(rig.desk.links)(rig.desk.links.nfc, rig.can)
    service = Service(rig.desk, rig.station).start(*words)
    uuid = rig.nodes["g"].uuid
    assert verdict(verified(service, uuid)) == "authentic"
    with service.client() as asked:
        asked.request("PUT", f"/nodes/{uuid}/channels/1", {"value": 0.05, "hold": 30})
    Journal.of(rig).moves()
    yield service


def test_a_daemon_that_is_killed_leaves_it_safe(rig: Rig) -> None:
    with held(rig) as service:
        killed = time.time()
        service.kill()
        Journal.of(rig, HELD).is_safe(killed)


def test_the_dead_man_of_a_daemon_is_the_one_that_it_was_started_with(rig: Rig) -> None:
    with held(rig, "--dead-man", 8000) as service:
        with service.client() as asked:
            assert asked.request("GET", "/status")["dead_man"] == 8000
        killed = time.time()
        service.kill()
        journal = Journal.of(rig, 8.0)
        journal.is_safe(killed)
        safe = [time_of(line) - killed for line in journal.states() if line["safe"] and time_of(line) > killed]
        assert safe[0] > HELD + BUSY, "its last value was fed at most a quarter of the dead-man before"


def test_a_daemon_whose_bus_is_cut_leaves_it_safe_and_holds_again_when_asked(cut_rig: Rig, wire: Hub) -> None:
    with held(cut_rig) as service:
        journal = Journal.of(cut_rig, HELD)
        cut = time.time()
        wire.lose = lambda _identifier, _data: True
        journal.is_safe(cut)
        wire.lose = lambda _identifier, _data: False
        back = time.time()
        path = f"/nodes/{cut_rig.nodes['g'].uuid}/channels/1"
        with service.client() as asked:

            def taken() -> Any:
                with suppress(Exception):
                    return asked.request("PUT", path, {"value": 0.02, "hold": 30})
                return None

            until(taken, "it is never held again", 60)
        journal.moves(back)
        service.end()


def test_who_asks_no_more_lets_go(rig: Rig) -> None:
    """The page is closed, the script died: nobody asks again, and the daemon lets go at the end of the hold."""
    with held(rig) as service, service.client() as asked:
        began = time.time()
        asked.request("PUT", f"/nodes/{rig.nodes['g'].uuid}/channels/1", {"value": 0.05, "hold": 0.5})
        Journal.of(rig, 0.5).is_safe(began)
        service.end()
