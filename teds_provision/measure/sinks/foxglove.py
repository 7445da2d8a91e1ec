"""Foxglove: a WebSocket server on this machine from which Foxglove, or any client of its protocol, plots live values.

The topics and schemas are those of our MCAP (``sinks/mcap/recording.py``): one of each stream, one of each channel
unless the sink was made without, ``…/teds`` with the facts, and ``reports``; the log time of a message is that of the
sample. The facts of channels are parameters too, which nobody can set: the SDK accepts a connection from any page in a
local browser (its Origin is not checked), so nothing here changes anything. Values reach a client in order; for one
that reads too slowly the server drops the oldest (1,024 messages are kept for each client).
"""

from __future__ import annotations

import ipaddress
import json
import time
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from teds_provision.errors import LinkError, UsageError
from teds_provision.lazy import how_to_install
from teds_provision.measure.blocks import Block, ChannelFacts, ClockSet, GroupRows, NodeReport, StationFacts
from teds_provision.measure.sinks.base import CommandTaker, Item, ThreadedSink
from teds_provision.measure.sinks.lines import facts_as_json
from teds_provision.measure.sinks.mcap.recording import (
    FLOAT,
    FLOAT_TYPE,
    SAMPLES,
    STRING,
    TYPE,
    is_integral,
    nanoseconds,
    plain_samples,
    report_as_json,
    samples,
)
from teds_provision.measure.sinks.names import Topics

if TYPE_CHECKING:
    import foxglove

FOXGLOVE: Final = "foxglove"
ARRAYS: Final = "arrays:"
"""Prefix of the string of a sink without topics of single channels: this one and MCAP."""
PORT: Final = 8765
"""The port that Foxglove offers when a connection is opened."""
_HEAD: Final = b"\x00\x01\x00\x00"


class FoxgloveSink(ThreadedSink):
    """``foxglove`` or ``foxglove:HOST:PORT``; ``scalars`` False leaves out the topics of single channels."""

    def __init__(self, spec: str, _commands: CommandTaker | None = None, *, scalars: bool = True) -> None:
        super().__init__(FOXGLOVE)
        self._host, self._port = address_of(spec)
        self._with_scalars = scalars
        self._topics = Topics(StationFacts(""))
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._streams: dict[tuple[str, int, tuple[int, ...], bool], tuple[foxglove.Channel, np.ndarray, int]] = {}
        self._channels: dict[str, foxglove.Channel] = {}
        self._latest: dict[str, bytes] = {}  # facts by topic, for clients that subscribe later
        self._sdk: Any = None
        self._context: foxglove.Context | None = None
        self._server: Any = None

    @property
    def port(self) -> int:
        """The port on which it listens, 0 before it is opened."""
        return int(self._server.port) if self._server is not None else 0

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise UsageError("Foxglove needs the package foxglove-sdk.", hint=how_to_install("foxglove")) from error
        foxglove.set_log_level("ERROR")  # its server writes a line for each client that leaves
        self._sdk, self._context = foxglove, foxglove.Context()
        self._topics = Topics(station)
        listener = _listener(foxglove, self)
        try:
            self._server = foxglove.start_server(
                name=f"teds-provision {station.name}",
                host=self._host,
                port=self._port,
                capabilities=[foxglove.Capability.Parameters],
                server_listener=listener,
                context=self._context,
            )
        except (RuntimeError, OSError) as error:
            raise LinkError(
                f"No Foxglove server can listen on {self._host}:{self._port}: {error}.",
                hint="Choose another port: --foxglove-at 127.0.0.1:PORT",
            ) from error
        self._channel(self._reports, "std_msgs/msg/String", STRING, {})  # before the first one, else it is missed
        self._describe(facts)

    @property
    def _reports(self) -> str:
        return f"/{self._topics.station}/reports"

    def parameters(self, names: list[str]) -> list[Any]:
        """Return the facts of channels as parameters, by topic; all of them if no name is given."""
        found = {self._topics.channel(*key): facts_as_json(facts) for key, facts in tuple(self._facts.items())}
        make = self._sdk.websocket.Parameter
        return [make(name, value=json.dumps(value)) for name, value in found.items() if not names or name in names]

    def _process_item(self, item: Item) -> None:
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, NodeReport):
            self._text(self._reports, json.dumps(report_as_json(item)), item.time or time.time())
        elif not isinstance(item, ClockSet | GroupRows):
            self._describe(item)

    def _describe(self, facts: tuple[ChannelFacts, ...]) -> None:
        if not facts:
            return
        self._facts.update((channel_facts.key, channel_facts) for channel_facts in facts)
        self._topics.learn(facts)
        for uuid in dict.fromkeys(channel_facts.uuid for channel_facts in facts):
            every = [facts_as_json(known) for known in self._facts.values() if known.uuid == uuid]
            topic = self._topics.of_node(uuid, "teds")
            self._latest[topic] = self._text(topic, json.dumps({"uuid": uuid, "channels": every}), time.time())
        self._streams = {key: value for key, value in self._streams.items() if key[0] not in {f.uuid for f in facts}}

    def _channel(self, topic: str, kind: str, definition: str, metadata: dict[str, str]) -> foxglove.Channel:
        """Return the channel of a topic, which clients see from now on; one topic keeps its channel."""
        if topic not in self._channels:
            schema = self._sdk.Schema(name=kind, encoding="ros2msg", data=definition.encode())
            self._channels[topic] = self._sdk.Channel(
                topic, schema=schema, message_encoding="cdr", context=self._context, metadata=metadata
            )
        return self._channels[topic]

    def repeat(self, topic: str) -> None:
        """Send the facts of a node again, if ``topic`` is theirs; called from a thread of the SDK."""
        if topic in self._latest:
            self._channels[topic].log(self._latest[topic], log_time=time.time_ns())

    def _text(self, topic: str, words: str, at: float) -> bytes:
        octets = words.encode() + b"\0"
        message = _HEAD + len(octets).to_bytes(4, "little") + octets
        channel = self._channel(topic, "std_msgs/msg/String", STRING, {})
        channel.log(message, log_time=int(at * 1e9))
        return message

    def _block(self, block: Block) -> None:
        key = (block.uuid, block.stream, block.channels, is_integral(block))
        if key not in self._streams:
            topic = self._topics.of_node(block.uuid, f"stream_{block.stream}")
            plain = plain_samples(0, len(block.channels), key[3])
            assert plain.dtype.fields is not None
            channel = self._channel(topic, TYPE, SAMPLES, {"uuid": block.uuid, "channels": json.dumps(block.channels)})
            self._streams[key] = channel, plain, plain.dtype.fields["cdr"][1]
        channel, plain, head = self._streams[key]
        octets, step = samples(block, plain).tobytes(), plain.dtype.itemsize
        times = nanoseconds(block.time).tolist()
        for place, at in enumerate(times):
            channel.log(octets[place * step + head : (place + 1) * step], log_time=at)
        messages = len(times)
        if self._with_scalars and not block.test_pattern:  # a Float64 cannot be marked as a test pattern
            messages += self._scalars(block, times)
        self._count(written=block.value.size, messages=messages)

    def _scalars(self, block: Block, times: list[int]) -> int:
        for column, number in enumerate(block.channels):
            facts = self._facts.get((block.uuid, number))
            metadata = {"uuid": block.uuid, "channel": str(number), "unit": facts.unit if facts is not None else ""}
            channel = self._channel(self._topics.channel(block.uuid, number), FLOAT_TYPE, FLOAT, metadata)
            values = np.ascontiguousarray(block.value[:, column], dtype="<f8").tobytes()
            for place, at in enumerate(times):
                channel.log(_HEAD + values[place * 8 : place * 8 + 8], log_time=at)
        return len(block.channels) * len(times)

    def _finish(self) -> None:
        if self._server is not None:
            self._server.stop()


def _listener(sdk: Any, sink: FoxgloveSink) -> Any:
    """Return what the SDK calls from its threads; the base class is the SDK's, which is loaded late."""

    class Listener(sdk.websocket.ServerListener):  # type: ignore[misc]
        """Answers requests for parameters, and sends a late subscriber the facts; nothing can be set."""

        def on_get_parameters(self, _client: Any, param_names: list[str], _request_id: str | None = None) -> list[Any]:
            """Return the parameters of these names, or all."""
            return sink.parameters(param_names)

        def on_set_parameters(self, _client: Any, parameters: list[Any], _request_id: str | None = None) -> list[Any]:
            """Return the present values: what a client sets is ignored."""
            return sink.parameters([parameter.name for parameter in parameters])

        def on_subscribe(self, _client: Any, channel: Any) -> None:
            """Send the facts again to a client that subscribed after they had been sent."""
            sink.repeat(channel.topic)

    return Listener()


def address_of(spec: str) -> tuple[str, int]:
    """Return host and port of ``foxglove[:HOST:PORT]``; raises UsageError for a host that is not of this machine."""
    where = spec.removeprefix(FOXGLOVE).removeprefix(":")
    if not where:
        return "127.0.0.1", PORT
    host, _, port = where.rpartition(":")
    host = host.strip("[]") or "127.0.0.1"
    if not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"{where!r} is no address.", hint="Give HOST:PORT, for example 127.0.0.1:8765.")
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback:
        raise UsageError(
            f"Foxglove's server has no login, so it listens on this machine only, not on {host}.",
            hint=f"From another machine: ssh -L {port}:127.0.0.1:{port} THIS-MACHINE",
        )
    return host, int(port)
