"""ROS 2 without ROS, seen by another maker's DDS (Debian's Fast DDS) and decoded by rosbags."""

from __future__ import annotations

import json
import queue
import shutil
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from teds_provision.errors import UsageError
from teds_provision.measure.blocks import SetPointCommand
from teds_provision.measure.sinks import open_sink
from teds_provision.measure.sinks.ros.ros2_types import HUMBLE_HASHES, TYPE_HASHES
from tests.measure.sinks.parts import ANGLE, AXES, DISTANCE, GRIP, HAND, OIL, STATION, feed_robot
from tests.pace import succeeds, until
from tests.places import ros_domain

HEADER = Path("/usr/include/fastdds/dds/domain/DomainParticipant.hpp")
SOURCE = Path(__file__).with_name("fastdds_reader.cpp")
LATER = [Stores.ROS2_IRON, Stores.ROS2_JAZZY, Stores.ROS2_KILTED, Stores.ROS2_LYRICAL]

needs_fastdds = [
    pytest.mark.system,
    pytest.mark.skipif(
        not HEADER.exists() or not shutil.which("g++"), reason="libfastrtps-dev or g++ is not installed"
    ),
]


def test_type_hashes_are_those_of_every_release() -> None:
    for kind, code in TYPE_HASHES.items():
        package, _, name = kind.partition("/")
        for store in LATER:
            assert get_typestore(store).hash_rihs01(f"{package}/msg/{name}") == f"RIHS01_{code}", (kind, store)
        of_humble = HUMBLE_HASHES.get(kind, code)
        assert get_typestore(Stores.ROS2_HUMBLE).hash_rihs01(f"{package}/msg/{name}") == f"RIHS01_{of_humble}", kind


@pytest.mark.parametrize("spec", ["ros2:x", "ros2:233", "ros2:-1"])
def test_a_domain_is_a_number(spec: str) -> None:
    with pytest.raises(UsageError):
        open_sink(spec)


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the other maker's reader, compiled."""
    program = tmp_path_factory.mktemp("fastdds") / "reader"
    command = ["g++", "-O0", "-o", str(program), str(SOURCE), "-lfastrtps", "-lfastcdr"]
    subprocess.run(command, check=True, timeout=300)
    return program


@pytest.fixture
def domain(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.delenv("CYCLONEDDS_URI", raising=False)
    with ros_domain() as number:
        yield number


class ReaderOutput:
    """What the reader prints, as it comes."""

    def __init__(self, program: Path, domain: int, publish: str, topics: dict[str, str]) -> None:
        words = [word for pair in topics.items() for word in pair]
        command = [str(program), str(domain), "60", publish, *words]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        self.lines: list[list[str]] = []
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self.lines.append(line.split(" ", 3))

    def samples(self, topic: str) -> list[bytes]:
        return [bytes.fromhex(line[2]) for line in list(self.lines) if line[:2] == ["sample", topic]]

    def end(self) -> None:
        self.process.kill()
        self.process.wait()


TOPICS = {
    "ros_discovery_info!": "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
    "rt/bench/arm/teds!": "std_msgs::msg::dds_::String_",
    "rt/bench/hand/oil": "sensor_msgs::msg::dds_::Temperature_",
    "rt/bench/arm/angle": "std_msgs::msg::dds_::Float64_",
    "rt/bench/arm/imu": "sensor_msgs::msg::dds_::Imu_",
    "rt/bench/arm/range_finder": "sensor_msgs::msg::dds_::Range_",
    "rt/bench/crane": "sensor_msgs::msg::dds_::JointState_",
    "rt/diagnostics": "diagnostic_msgs::msg::dds_::DiagnosticArray_",
}


class TestSeenByFastDds:
    pytestmark = needs_fastdds

    @pytest.mark.parametrize("release", ["jazzy", "humble"])
    def test_another_makers_dds_reads_every_topic(
        self, reader: Path, domain: int, release: str, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("ROS_DISTRO", release)
        came: queue.Queue[SetPointCommand] = queue.Queue()
        sink = open_sink(f"ros2:{domain}", came.put)
        sink.open([ANGLE, OIL, GRIP, *AXES, DISTANCE], STATION)
        seen = ReaderOutput(reader, domain, "rt/bench/hand/force/cmd", TOPICS)
        try:
            names = [name.rstrip("!") for name in TOPICS]
            end = time.monotonic() + 60
            k = 0
            while not (all(seen.samples(name) for name in names) and not came.empty()):
                assert time.monotonic() < end, [name for name in names if not seen.samples(name)]
                feed_robot(sink, k)
                time.sleep(0.05)
                k += 1
        finally:
            seen.end()
            sink.close()
        assert sink.stats.error == ""
        command = came.get_nowait()
        assert (command.uuid, command.channel, command.value) == (HAND, 2, 1.25)
        store = get_typestore(Stores.ROS2_HUMBLE if release == "humble" else Stores.ROS2_JAZZY)

        def decoded(topic: str, kind: str) -> Any:
            return store.deserialize_cdr(seen.samples(topic)[-1], kind)

        assert ["participant", "enclave=/;\n"] in seen.lines
        writers = {line[1]: line[3].strip() for line in seen.lines if line[0] == "writer"}
        assert writers["rt/bench/crane"] == f"typehash=RIHS01_{TYPE_HASHES['sensor_msgs/JointState']};"
        temperature = decoded("rt/bench/hand/oil", "sensor_msgs/msg/Temperature")
        assert temperature.temperature == pytest.approx(20.0)
        assert temperature.variance == pytest.approx(0.03)
        imu = decoded("rt/bench/arm/imu", "sensor_msgs/msg/Imu")
        assert (imu.linear_acceleration.x, imu.linear_acceleration.z) == pytest.approx((0.1, 0.3))
        assert imu.linear_acceleration_covariance[8] == pytest.approx(0.03)
        assert imu.orientation_covariance[0] == imu.angular_velocity_covariance[0] == -1, "not measured"
        distance = decoded("rt/bench/arm/range_finder", "sensor_msgs/msg/Range")
        assert (distance.range, distance.min_range, distance.max_range) == pytest.approx((0.4, 0.25, 8.0))
        state = decoded("rt/bench/crane", "sensor_msgs/msg/JointState")
        assert state.name == ["arm/angle", "hand/oil"]
        assert state.position[0] == 1.0
        assert np.isnan(state.position[1])
        assert state.header.stamp.sec >= 12
        assert state.header.stamp.nanosec == 250_000_000
        words = json.loads(decoded("rt/bench/arm/teds", "std_msgs/msg/String").data)
        assert words["channels"][0]["fingerprint"] == ANGLE.fingerprint, "a late comer gets the metadata"
        graph = decoded("ros_discovery_info", "rmw_dds_common/msg/ParticipantEntitiesInfo")
        [node] = graph.node_entities_info_seq
        assert (node.node_namespace, node.node_name) == ("/", "teds_provision_bench")
        assert len(node.writer_gid_seq) >= 6
        assert len(node.reader_gid_seq) == 1
        assert len(graph.gid.data) == (24 if release == "humble" else 16)
        diagnostics = decoded("rt/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
        assert diagnostics.status[-1].hardware_id == "bench"


def in_the_group() -> int:
    """Return how many sockets of this machine hear 239.255.0.1, the group of DDS discovery; other programs' too."""
    rows = [line.split() for line in Path("/proc/net/igmp").read_text().splitlines()]
    return sum(int(row[1]) for row in rows if row[:1] == ["0100FFEF"])


def test_nothing_leaves_this_machine_unless_asked(domain: int) -> None:
    def joined() -> int:
        """Return how many more hear the group while the sink is open."""
        before = in_the_group()
        sink = open_sink(f"ros2:{domain}")
        sink.open([ANGLE], STATION)
        try:
            return max(0, in_the_group() - before)
        finally:
            sink.close()

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        before = in_the_group()
        probe.setsockopt(
            socket.IPPROTO_IP, socket.IP_ADD_MEMBERSHIP, socket.inet_aton("239.255.0.1") + socket.inet_aton("127.0.0.1")
        )
        until(lambda: in_the_group() > before, "whoever joins is seen")
    succeeds(5, joined, because="other tests join the group meanwhile")
