"""ROS 2 without ROS: a DDS participant that ROS 2 tools take for a node (Humble to Lyrical).

It is recognised by ``enclave=/;`` as the participant's user data, topics ``rt/…`` of types ``pkg::msg::dds_::Type_`` in
XCDR1, the type's hash in each endpoint's user data, and ``ros_discovery_info``, rewritten after each new endpoint.
Unless the user brings a configuration (CYCLONEDDS_URI), nothing leaves this machine: loopback only, no multicast.
Writers are reliable with a short history, so that best-effort and reliable readers both match; metadata is transient
local, so that late subscribers get it.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from teds_provision.errors import TedsProvisionError, UsageError
from teds_provision.lazy import how_to_install, late
from teds_provision.measure.blocks import ChannelFacts, StationFacts
from teds_provision.measure.sinks.base import CommandTaker
from teds_provision.measure.sinks.live import DIAGNOSTICS, JOINT_STATE, STRING, DiagnosticEntry, TopicSink
from teds_provision.measure.sinks.ros.rclpy_child import keep_on_loopback, ports_of
from teds_provision.measure.sinks.vectors import FieldValue, Meaning

if TYPE_CHECKING:
    from teds_provision.measure.sinks.ros import ros2_types
else:  # cyclonedds is an extra
    ros2_types = late("teds_provision.measure.sinks.ros.ros2_types")

GRAPH = "rmw_dds_common/ParticipantEntitiesInfo"
DISTRIBUTIONS = ("humble", "iron", "jazzy", "kilted", "lyrical", "rolling")
HISTORY = 100  # messages that a reader may lag behind, enough for a burst of rows
PARTICIPANTS = 10 + 2 * 31 + 2  # the ports that 31 participants of a domain use
NEWEST = 10  # set points that may be queued
BLOCKING_MS = 10  # longest time that a slow reliable reader may delay a write
LISTENING = 0.2  # seconds between checks for the end
THIS_MACHINE = (
    "<CycloneDDS><Domain Id='any'><General><Interfaces><NetworkInterface name='lo' multicast='false'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><Peers><Peer address='127.0.0.1'/></Peers>"
    "<SPDPInterval>2s</SPDPInterval><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex></Discovery>"
    "<Tracing><Verbosity>none</Verbosity></Tracing></Domain></CycloneDDS>"
)
_domains: dict[int, Any] = {}  # a domain can be configured only once in a process


def domain_of(spec: str) -> int:
    """Return the domain of ``ros2`` or ``ros2:DOMAIN``, else ROS_DOMAIN_ID's, else 0; raises UsageError."""
    domain = spec.partition(":")[2] or os.environ.get("ROS_DOMAIN_ID", "0")
    if not domain.isdecimal() or int(domain) > 232:
        raise UsageError(f"{domain!r} is no ROS 2 domain.", hint="Name a number from 0 to 232: ros2:7")
    return int(domain)


class Ros2Sink(TopicSink):
    """``ros2`` or ``ros2:DOMAIN`` (else ROS_DOMAIN_ID, else 0); ROS_DISTRO is the release of the readers."""

    def __init__(self, spec: str, commands: CommandTaker | None = None) -> None:
        super().__init__("ROS 2", commands)
        self._domain = domain_of(spec)
        self._distribution = os.environ.get("ROS_DISTRO", "jazzy")
        if self._distribution not in DISTRIBUTIONS:
            self._distribution = "jazzy"
        self._participant: Any = None
        self._graph: Any = None
        self._writers: dict[str, Any] = {}
        self._readers: dict[str, tuple[Any, str, int]] = {}
        self._attached: list[Any] = []
        self._ending = threading.Event()
        self._listener: threading.Thread | None = None
        self._types: Any = None
        self._unshown = False  # True if endpoints changed since the graph was published

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        super()._prepare(facts, station)
        try:
            from cyclonedds.core import DDSException
            from cyclonedds.domain import Domain, DomainParticipant
            from cyclonedds.qos import Policy, Qos
        except ImportError:
            raise TedsProvisionError("ROS 2 needs the package cyclonedds.", hint=how_to_install("ros2")) from None
        self._types = ros2_types
        try:
            if "CYCLONEDDS_URI" not in os.environ and self._domain not in _domains:
                _domains[self._domain] = Domain(self._domain, THIS_MACHINE)
                keep_on_loopback(ports_of(self._domain, PARTICIPANTS))
            self._participant = DomainParticipant(self._domain, qos=Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            raise TedsProvisionError(
                f"DDS domain {self._domain} cannot be joined: {error}.",
                hint="Check CYCLONEDDS_URI, and that not more than 30 programs use the domain.",
            ) from error
        self._graph = self._new_writer(GRAPH, "ros_discovery_info", latched=True)

    def _qos(self, kind: str, *, latched: bool, reading: bool = False) -> Any:
        """Return the QoS that a writer offers, or a reader requests.

        A reader requests best effort: it receives from both kinds of writers, and no lost set point comes later.
        """
        from cyclonedds.qos import Policy, Qos
        from cyclonedds.util import duration

        humble = self._distribution == "humble"
        code = self._types.HUMBLE_HASHES.get(kind) if humble else None
        code = code or self._types.TYPE_HASHES[kind]
        return Qos(
            Policy.Reliability.BestEffort
            if reading
            else Policy.Reliability.Reliable(duration(milliseconds=BLOCKING_MS)),
            Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
            Policy.History.KeepLast(1 if latched else NEWEST if reading else HISTORY),
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash=RIHS01_{code};".encode()),
        )

    def _topic(self, kind: str, name: str) -> Any:
        from cyclonedds.topic import Topic

        return Topic(self._participant, name, self._type(kind))

    def _type(self, kind: str) -> Any:
        """Return the type of ``package/Type`` in this distribution."""
        of_humble = self._types.HUMBLE_TYPES.get(kind) if self._distribution == "humble" else None
        return of_humble or self._types.TYPES[kind]

    def _new_writer(self, kind: str, name: str, *, latched: bool = False) -> Any:
        from cyclonedds.pub import DataWriter

        return DataWriter(self._participant, self._topic(kind, name), qos=self._qos(kind, latched=latched))

    def _writer(self, topic: str, kind: str, *, latched: bool = False) -> Any:
        if topic not in self._writers:
            self._writers[topic] = self._new_writer(kind, f"rt{topic}", latched=latched)
            self._unshown = True
        return self._writers[topic]

    def _show_node(self) -> None:
        """Publish this node's endpoints to the graph: all of them, so once for all that are new."""
        self._unshown = False
        humble = self._distribution == "humble"
        types = self._types
        gid, info = (types.HumbleGid, types.HumbleNodeEntitiesInfo) if humble else (types.Gid, types.NodeEntitiesInfo)
        whole = types.HumbleParticipantEntitiesInfo if humble else types.ParticipantEntitiesInfo

        def gid_of(entity: Any) -> Any:
            return gid(data=list(entity.guid.bytes) + [0] * (8 if humble else 0))

        node = info(
            node_namespace="/",
            node_name=self._node,
            reader_gid_seq=[gid_of(reader) for reader, _, _ in self._readers.values()],
            writer_gid_seq=[gid_of(writer) for writer in self._writers.values()],
        )
        self._write(self._graph, whole(gid=gid_of(self._participant), node_entities_info_seq=[node]), 0)

    def _idle(self, now: float) -> None:
        super()._idle(now)
        if self._unshown:
            self._show_node()

    def _write(self, writer: Any, message: Any, values: int) -> None:
        """Write a message; a reader that takes nothing costs at most BLOCKING_MS, and the values of this message."""
        from cyclonedds.core import DDSException

        try:
            writer.write(message)
        except DDSException:
            self._count(dropped=values)

    def _header(self, stamp: float, frame: str = "") -> Any:
        seconds, nanoseconds = divmod(round(stamp * 1e9), 10**9)
        return self._types.Header(self._types.Time(seconds, nanoseconds), frame)

    def _advertise(self, topic: str, kind: str) -> None:
        self._writer(topic, kind)

    def _array(
        self,
        topic: str,
        stamp: float,
        names: Sequence[str],
        values: Sequence[float],
        velocity: Sequence[float] = (),
        effort: Sequence[float] = (),
    ) -> None:
        message = self._types.JointState(self._header(stamp), names, values, list(velocity), list(effort))
        self._write(self._writer(topic, JOINT_STATE), message, len(values))

    def _scalar(self, topic: str, meaning: Meaning, stamp: float, frame: str, value: float, variance: float) -> None:
        type_ = self._types.TYPES[meaning.type]
        message = type_(self._header(stamp, frame), value, variance) if meaning.variance else type_(value)
        self._write(self._writer(topic, meaning.type), message, 1)

    def _fields(self, topic: str, kind: str, stamp: float, frame: str, fields: Mapping[str, FieldValue]) -> None:
        message = self._type(kind)(self._header(stamp, frame))
        for path, value in fields.items():
            *way, last = path.split(".")
            part = message
            for name in way:
                part = getattr(part, name)
            if hasattr(part, last):  # Range has a variance since Jazzy
                setattr(part, last, value)
        self._write(self._writer(topic, kind), message, sum(isinstance(value, float) for value in fields.values()))

    def _latched(self, topic: str, words: str) -> None:
        self._write(self._writer(topic, STRING, latched=True), self._types.String(words), 0)

    def _retire(self, topic: str) -> None:
        if self._writers.pop(topic, None) is not None:  # the writer ends with its last reference
            self._unshown = True

    def _parameter(self, name: str, value: object) -> None:
        """Do nothing: ROS 2 has no parameter server; the latched metadata holds the same facts."""

    def _listen(self, topic: str, uuid: str, channel: int) -> None:
        self._read(topic, "std_msgs/Float64", uuid, channel)

    def _listen_joints(self, topic: str) -> None:
        self._read(topic, JOINT_STATE, "", 0)

    def _read(self, topic: str, kind: str, uuid: str, channel: int) -> None:
        from cyclonedds.sub import DataReader

        if topic in self._readers:
            return
        reader = DataReader(
            self._participant, self._topic(kind, f"rt{topic}"), qos=self._qos(kind, latched=False, reading=True)
        )
        self._readers[topic] = (reader, uuid, channel)
        self._unshown = True
        if self._listener is None:
            self._listener = threading.Thread(target=self._hear, name="ROS 2 commands", daemon=True)
            self._listener.start()

    def _hear(self) -> None:
        """Set points, on a thread of their own: each goes on within microseconds, not at the next look."""
        from cyclonedds.core import DDSException, ReadCondition, SampleState, WaitSet
        from cyclonedds.util import duration

        waiting = WaitSet(self._participant)
        known: set[str] = set()
        while not self._ending.is_set():
            for topic, (reader, _, _) in list(self._readers.items()):
                if topic not in known:
                    known.add(topic)
                    condition = ReadCondition(reader, SampleState.NotRead)
                    self._attached.append(condition)
                    waiting.attach(condition)
            try:
                waiting.wait(duration(milliseconds=int(LISTENING * 1000)))
                for reader, uuid, channel in list(self._readers.values()):
                    for message in reader.take(N=NEWEST):
                        if isinstance(message, self._types.Float64):
                            self._command(uuid, channel, float(message.data))
                        elif isinstance(message, self._types.JointState):
                            self._joint_command(message.name, message.position, message.velocity, message.effort)
            except DDSException:
                time.sleep(LISTENING)

    def _diagnose(self, stamp: float, statuses: Sequence[DiagnosticEntry]) -> None:
        types = self._types
        entries = []
        for diagnostic in statuses:
            values = [types.KeyValue(key, value) for key, value in diagnostic.values]
            entries.append(
                types.DiagnosticStatus(
                    diagnostic.level, diagnostic.name, diagnostic.message, diagnostic.hardware, values
                )
            )
        message = types.DiagnosticArray(self._header(stamp), entries)
        self._write(self._writer("/diagnostics", DIAGNOSTICS), message, 0)

    def _finish(self) -> None:
        self._ending.set()
        if self._listener is not None:
            self._listener.join(10 * LISTENING)
        # Entities end with their last reference; the participant announces its end to the others.
        self._attached.clear()
        self._readers.clear()
        self._writers.clear()
        self._graph = self._participant = None
