"""MQTT with Home Assistant discovery: each channel shows up as an entity, with unit and name from the datasheet.

Topics: ``<station>/<node>`` carries the newest values of a node as one JSON object (not retained, QoS 0) at
``StationFacts.scalar_rate``; ``homeassistant/sensor/<uuid>/<channel>/config`` (retained) tells Home Assistant where to
look; ``<station>/<group>/status`` is ``online`` or, by the broker's will, ``offline``: each measurement has its own,
for several may run and one that ends must not end the others. An entity is available while that is online and its node
runs, so the last value of a node that is lost is not taken for one of now. Values are in the unit for people (°C), for
Home Assistant knows units by their signs. Nothing is subscribed: no actuator is moved by MQTT.

A password is read from the file that the URL names (``mqtt://user@host?password-file=PATH``): never from the URL.
"""

from __future__ import annotations

import json
import math
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from teds_provision import __version__
from teds_provision.errors import TedsProvisionError, UsageFailure
from teds_provision.lazy import how_to_install
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport, StationFacts
from teds_provision.measure.sinks.base import CommandTaker, Item, ThreadedSink
from teds_provision.measure.sinks.lines import status_line
from teds_provision.measure.sinks.names import Topics, slug
from teds_provision.teds.units import display_unit, short_unit

if TYPE_CHECKING:
    from teds_provision.teds.units import WrittenUnit

DISCOVERY = "homeassistant"
PORTS = {"mqtt": 1883, "mqtts": 8883}
KEEP_ALIVE = 15  # seconds: the broker says offline after one and a half of it
WAITING = 1000  # messages that the library may hold for a slow broker
RUNS = "{{ 'online' if value_json.state == 'running' else 'offline' }}"  # a template of Home Assistant
DEVICE_CLASSES = {"°C": "temperature", "Pa": "pressure", "hPa": "pressure", "kPa": "pressure", "lx": "illuminance"}


class MqttSink(ThreadedSink):
    """``mqtt://[USER@]HOST[:PORT][?password-file=PATH]``, ``mqtts://…`` with TLS."""

    def __init__(self, spec: str, commands: CommandTaker | None = None) -> None:
        parts = urlsplit(spec)
        if parts.scheme not in PORTS or not parts.hostname:
            raise UsageFailure(f"{spec!r} is no MQTT URL.", hint="Write mqtt://HOST or mqtts://USER@HOST:8883.")
        if parts.password is not None:
            raise UsageFailure(
                "A password may not stand on the command line.",
                hint="Put it into a file: mqtt://USER@HOST?password-file=PATH",
            )
        super().__init__(f"{parts.scheme}://{parts.hostname}")
        self._parts = parts
        self._password_file = parse_qs(parts.query).get("password-file", [""])[0]
        self._client: Any = None
        self._connected = threading.Event()
        self._anew = threading.Event()  # connected, and not announced since
        self._station = StationFacts("")
        self._topics = Topics(self._station)
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._units: dict[tuple[str, int], WrittenUnit | None] = {}
        self._newest: dict[str, dict[str, float | None]] = {}
        self._due: dict[str, float] = {}

    def _prepare(self, facts: tuple[ChannelFacts, ...], station: StationFacts) -> None:
        try:
            import paho.mqtt.client as paho
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError:
            raise TedsProvisionError("MQTT needs the package paho-mqtt.", hint=how_to_install("mqtt")) from None
        self._station, self._topics = station, Topics(station)
        self._learn(facts)
        client = paho.Client(CallbackAPIVersion.VERSION2)
        client.max_queued_messages_set(WAITING)
        if self._parts.scheme == "mqtts":
            client.tls_set()
        if self._parts.username:
            client.username_pw_set(self._parts.username, self._password())
        client.will_set(self._status, "offline", qos=1, retain=True)
        client.reconnect_delay_set(1, 30)
        client.on_connect = self._on_connect
        client.on_disconnect = self._on_disconnect
        self._client = client

    @property
    def _status(self) -> str:
        """Topic that says whether this measurement is there."""
        return "/".join(filter(None, (self._topics.station, slug(self._station.instance), "status")))

    def _password(self) -> str | None:
        if not self._password_file:
            return None
        try:
            return Path(self._password_file).read_text(encoding="utf-8").rstrip("\n")
        except (OSError, UnicodeDecodeError) as error:
            raise TedsProvisionError(
                f"The password file {self._password_file} cannot be read.", hint="Check its path and mode."
            ) from error

    def _on_connect(self, _client: Any, _userdata: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._say("waiting", f"the broker refuses: {reason}")
            return
        self._connected.set()
        self._anew.set()

    def _on_disconnect(self, *_: Any) -> None:
        self._connected.clear()
        self._say("waiting", f"waits for the broker at {self._parts.hostname}")

    def _begin(self) -> None:
        self._say("waiting", f"waits for the broker at {self._parts.hostname}")
        self._client.connect_async(self._parts.hostname, self._parts.port or PORTS[self._parts.scheme], KEEP_ALIVE)
        self._client.loop_start()

    def _learn(self, facts: tuple[ChannelFacts, ...]) -> None:
        self._facts.update((one.key, one) for one in facts)
        self._topics.learn(facts)
        self._units.update((one.key, display_unit(one.units) if one.units else None) for one in facts)

    def _take(self, item: Item) -> None:
        self._greet()
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, tuple):
            self._learn(item)
            if self._connected.is_set():
                self._discover()
        elif isinstance(item, NodeReport):
            self._publish(
                f"{self._topics.station}/{self._topics.node(item.uuid)}/state", status_line(item), retain=True
            )

    def _idle(self, now: float) -> None:
        self._greet()

    def _greet(self) -> None:
        """After each connection: who is here, and what there is."""
        if self._anew.is_set():
            self._anew.clear()
            self._say("running", f"connected to {self._parts.hostname}")
            self._client.publish(self._status, "online", qos=1, retain=True)
            self._discover()

    def _discover(self) -> None:
        for one in self._facts.values():
            if one.unsigned:  # raw values alone, which are none of anything: no sensor to show
                continue
            node = f"{self._topics.station}/{self._topics.node(one.uuid)}"
            device = {
                "identifiers": [one.uuid],
                "name": one.node or one.uuid,
                "manufacturer": "IEEE 1451 transducer",
                "sw_version": f"teds-provision {__version__}",
            }
            unit = self._units.get(one.key)
            sign = short_unit(unit.text) if unit else one.unit
            words = {
                "name": one.label,
                "unique_id": f"{one.uuid}_{one.number}",
                "state_topic": node,
                "value_template": f"{{{{ value_json.{self._field(one)} }}}}",
                "availability": [{"topic": self._status}, {"topic": f"{node}/state", "value_template": RUNS}],
                "availability_mode": "all",
                "state_class": "measurement",
                "device": device,
                **({"unit_of_measurement": sign} if sign else {}),
                **({"device_class": DEVICE_CLASSES[sign]} if sign in DEVICE_CLASSES else {}),
            }
            self._publish(f"{DISCOVERY}/sensor/{one.uuid}/{one.number}/config", words, qos=1, retain=True)

    def _field(self, facts: ChannelFacts) -> str:
        """Name of a channel in the node's JSON; a slug, for a template of Home Assistant is a program."""
        return f"{slug(facts.name) or 'ch'}_{facts.number}"

    def _block(self, block: Block) -> None:
        if block.test_pattern or self._station.scalar_rate <= 0 or not len(block.time):
            return
        newest = self._newest.setdefault(block.uuid, {})
        known = [self._facts.get((block.uuid, n), ChannelFacts(block.uuid, "", n, "")) for n in block.channels]
        for column, facts in enumerate(known):
            newest[self._field(facts)] = self._shown(facts, float(block.value[-1, column]))
        now = time.monotonic()
        if now >= self._due.get(block.uuid, 0.0):
            self._due[block.uuid] = now + 1 / self._station.scalar_rate
            values = {"time": round(float(block.time[-1]), 6), **newest}
            if any(facts.unsigned for facts in known):
                values["unsigned"] = True
            if self._connected.is_set():
                self._publish(f"{self._topics.station}/{self._topics.node(block.uuid)}", values)
                self._count(written=len(newest))
            else:
                self._count(dropped=len(newest))

    def _shown(self, facts: ChannelFacts, value: float) -> float | None:
        """A value in people's unit, None where there is none."""
        unit = self._units.get(facts.key)
        if not math.isfinite(value):
            return None
        return value if unit is None else unit.from_si(value)

    def _publish(self, topic: str, words: dict[str, Any], *, qos: int = 0, retain: bool = False) -> None:
        octets = json.dumps(words, allow_nan=False).encode()
        self._client.publish(topic, octets, qos=qos, retain=retain)
        self._count(octets=len(octets), messages=1)

    def _finish(self) -> None:
        if self._client is None:
            return
        if self._connected.is_set():
            said = self._client.publish(self._status, "offline", qos=1, retain=True)
            said.wait_for_publish(2.0)
        self._client.disconnect()
        self._client.loop_stop()
