"""The server behind ``foxglove``: its channels come and go with the measurements that it serves.

One topic is one channel, whichever measurements publish on it; it is removed after the last of them has ended. The SDK
accepts a connection from any page in a local browser (its Origin is not checked), so nothing here changes anything: the
facts of channels are read-only parameters. For a client that reads too slowly the SDK drops the oldest
messages (1,024 are kept for each client).
"""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING, Any, Final

from teds_provision.errors import LinkError, UsageError
from teds_provision.lazy import how_to_install
from teds_provision.measure.exposure import Exposure

if TYPE_CHECKING:
    import foxglove

PORT: Final = 8765
"""The port that Foxglove offers when a connection is opened."""
USUAL: Final = f"127.0.0.1:{PORT}"
_FLUSH: Final = 0.2
"""Seconds that subscribers have to receive the last messages: the removal of a channel overtakes them."""


class FoxgloveServer:
    """Listens on ``address`` (HOST:PORT) from :meth:`start` to :meth:`stop`; raises UsageError for a wrong address."""

    def __init__(self, address: str = USUAL, exposure: Exposure | None = None) -> None:
        self._exposure = exposure or Exposure()
        self._host, self._port = address_of(address, self._exposure)
        self._guard = threading.Lock()
        self._channels: dict[str, foxglove.Channel] = {}
        self._measurements: list[MeasurementTopics] = []
        self._sdk: Any = None
        self._context: foxglove.Context | None = None
        self._server: Any = None

    def start(self, station: str) -> None:
        """Listen; raises UsageError without the SDK, LinkError if the address is taken, BadDataError for bad TLS."""
        try:
            import foxglove
        except ImportError as error:
            raise UsageError("Foxglove needs the package foxglove-sdk.", hint=how_to_install("foxglove")) from error
        foxglove.set_log_level("ERROR")  # otherwise its server logs a line for each client that leaves
        self._exposure.require_pair()
        certificate, key = self._exposure.certificate, self._exposure.key
        self._sdk, self._context = foxglove, foxglove.Context()
        try:
            self._server = foxglove.start_server(
                name=f"teds-provision {station}",
                host=self._host,
                port=self._port,
                capabilities=[foxglove.Capability.Parameters],
                server_listener=_listener(foxglove, self),
                context=self._context,
                tls_cert=certificate.read_bytes() if certificate is not None else None,
                tls_key=key.read_bytes() if key is not None else None,
            )
        except (RuntimeError, OSError) as error:
            raise LinkError(
                f"No Foxglove server can listen on {self._host}:{self._port}: {error}.",
                hint="Choose another port: --foxglove-at 127.0.0.1:PORT",
            ) from error

    def stop(self) -> None:
        """End it and every connection; a second call does nothing."""
        if self._server is not None:
            self._server.stop()
            self._server = None

    @property
    def port(self) -> int:
        """The port on which it listens, 0 while it does not."""
        return int(self._server.port) if self._server is not None else 0

    @property
    def url(self) -> str:
        """The address to open in Foxglove."""
        return self._exposure.url("ws", self._host, self.port)

    def begin(self) -> MeasurementTopics:
        """Return the topics of one more measurement."""
        topics = MeasurementTopics(self)
        with self._guard:
            self._measurements.append(topics)
        return topics

    def end(self, topics: MeasurementTopics) -> None:
        """Remove the channels that no other measurement uses."""
        with self._guard:
            read = any(self._channels[topic].has_sinks() for topic in self._only_of(topics))
        if read:
            time.sleep(_FLUSH)
        with self._guard:
            for topic in self._only_of(topics):
                self._channels.pop(topic).close()
            self._measurements.remove(topics)

    def _only_of(self, topics: MeasurementTopics) -> set[str]:
        others = {topic for other in self._measurements if other is not topics for topic in other.channels}
        return topics.channels.keys() - others

    def channel(
        self, topics: MeasurementTopics, topic: str, kind: str, definition: str, metadata: dict[str, str]
    ) -> foxglove.Channel:
        """Return the channel of a topic, which clients see from now on; it stays until ``topics`` end."""
        with self._guard:
            if topic not in self._channels:
                schema = self._sdk.Schema(name=kind, encoding="ros2msg", data=definition.encode())
                self._channels[topic] = self._sdk.Channel(
                    topic, schema=schema, message_encoding="cdr", context=self._context, metadata=metadata
                )
            topics.channels[topic] = self._channels[topic]
            return self._channels[topic]

    def parameters(self, names: list[str]) -> list[Any]:
        """Return the parameters of these names, or all; called from threads of the SDK."""
        found = {name: value for topics in tuple(self._measurements) for name, value in topics.parameters.items()}
        make = self._sdk.websocket.Parameter
        return [make(name, value=value) for name, value in found.items() if not names or name in names]

    def repeat(self, topic: str) -> None:
        """Send the last facts of a node again, if ``topic`` is theirs; called from threads of the SDK."""
        for topics in tuple(self._measurements):
            message = topics.latest.get(topic)  # a node that is renamed meanwhile takes it away
            if message is not None and topic in topics.channels:
                topics.channels[topic].log(message, log_time=time.time_ns())


class MeasurementTopics:
    """Topics of one measurement: channels by topic, and for late subscribers its last facts by topic."""

    def __init__(self, server: FoxgloveServer) -> None:
        self._server = server
        self.channels: dict[str, foxglove.Channel] = {}
        self.latest: dict[str, bytes] = {}
        self.parameters: dict[str, str] = {}  # always replaced as a whole, because threads of the SDK read it

    def channel(self, topic: str, kind: str, definition: str, metadata: dict[str, str]) -> foxglove.Channel:
        """Return the channel of a topic, shared with other measurements that use it."""
        return self.channels.get(topic) or self._server.channel(self, topic, kind, definition, metadata)

    def end(self) -> None:
        """Remove the channels that only this measurement used."""
        self._server.end(self)


def _listener(sdk: Any, server: FoxgloveServer) -> Any:
    """Return what the SDK calls from its threads; the base class is the SDK's, which is loaded late."""

    class Listener(sdk.websocket.ServerListener):  # type: ignore[misc]
        """Answers requests for parameters, and sends a late subscriber the facts; nothing can be set."""

        def on_get_parameters(self, _client: Any, param_names: list[str], _request_id: str | None = None) -> list[Any]:
            """Return the parameters of these names, or all."""
            return server.parameters(param_names)

        def on_set_parameters(self, _client: Any, parameters: list[Any], _request_id: str | None = None) -> list[Any]:
            """Return the present values: what a client sets is ignored."""
            return server.parameters([parameter.name for parameter in parameters])

        def on_subscribe(self, _client: Any, channel: Any) -> None:
            """Send the facts again to a client that subscribed after they had been sent."""
            server.repeat(channel.topic)

    return Listener()


def address_of(address: str, exposure: Exposure) -> tuple[str, int]:
    """Return host and port; raises UsageError for a wrong one, and for one that is exposed without protection."""
    host, _, port = address.rpartition(":")
    host = host.strip("[]") or "127.0.0.1"
    if not port.isdecimal() or int(port) > 65535:
        raise UsageError(f"{address!r} is no address.", hint=f"Give HOST:PORT, for example {USUAL}.")
    exposure.require_safe("--foxglove-at", host, sends="values", clients="Foxglove")
    return host, int(port)
