"""MQTT with Home Assistant discovery: each channel shows up as an entity, with unit and name from the datasheet.

Topics: ``<station>/<node>`` carries the newest values of a node as one JSON object (not retained, QoS 0) at
``StationFacts.scalar_rate``; ``homeassistant/sensor/<uuid>/<channel>/config`` (retained) shows Home Assistant where to
look; ``<station>/<group>/status`` is ``online`` or, by the broker's will, ``offline``: each measurement has its own,
for several may run and one that ends must not end the others. An entity is available while that is online and its node
runs, so the last value of a node that is lost is not taken for one of now. One client identifier serves every
connection of a measurement: a broker that still holds one that was cut then ends it when the next one begins, and its
will cannot publish ``offline`` over the new ``online`` half a minute later. Values are in the unit for people (°C), for
Home Assistant knows units by their signs. Nothing is subscribed: no actuator is moved by MQTT.

A password is read from the file that the URL names (``mqtt://user@host?password-file=PATH``): never from the URL. With
TLS (``mqtts://``) the broker's certificate has to verify, by the system's CAs or those of ``ca=PATH``, for the name in
the URL; ``cert=PATH`` and ``key=PATH`` are this client's own certificate. Files are regular and small, and read when
the sink opens. The reason why a broker takes nothing is reported, and kept if it never took anything.
"""

from __future__ import annotations

import json
import math
import secrets
import socket
import stat
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import parse_qsl, urlsplit

from teds_provision import __version__
from teds_provision.errors import BadDataError, NotFoundError, TedsProvisionError, UsageError
from teds_provision.files import read_limited
from teds_provision.lazy import how_to_install, late
from teds_provision.measure.blocks import Block, ChannelFacts, NodeReport, StationFacts
from teds_provision.measure.sinks.base import TICK, CommandTaker, Item, ThreadedSink
from teds_provision.measure.sinks.json_events import status_line
from teds_provision.measure.sinks.names import Topics, slug
from teds_provision.teds.units import WrittenUnit, display_unit, short_unit

if TYPE_CHECKING:
    import ssl

else:
    ssl = late("ssl")

DISCOVERY = "homeassistant"
FILES: Final = ("password-file", "ca", "cert", "key")
"""Keys of the URL; each names a file."""
_MOST_OCTETS: Final = 1 << 20
PORTS = {"mqtt": 1883, "mqtts": 8883}
_JSON: Final = json.JSONEncoder(allow_nan=False)  # json.dumps would make an encoder for each message
_FULL: Final = 15  # the library's return code if WAITING messages are queued
_FAREWELL: Final = 2.0  # seconds to publish that this measurement has ended
KEEP_ALIVE = 15  # seconds: the broker reports offline after one and a half times this
WAITING = 1000  # messages that the library may queue for a slow broker; refused ones are offered again
RUNS = "{{ 'online' if value_json.state == 'running' else 'offline' }}"  # a template of Home Assistant
DEVICE_CLASSES = {"°C": "temperature", "Pa": "pressure", "hPa": "pressure", "kPa": "pressure", "lx": "illuminance"}


class MqttSink(ThreadedSink):
    """``mqtt://[USER@]HOST[:PORT][?password-file=PATH]``, ``mqtts://…[?ca=PATH&cert=PATH&key=PATH]`` with TLS."""

    def __init__(self, spec: str, commands: CommandTaker | None = None) -> None:
        try:
            parts = urlsplit(spec)
            port = parts.port or PORTS[parts.scheme]
            (parts.hostname or "").encode("idna")
        except (ValueError, KeyError):
            parts, port = urlsplit(""), 0
        if not parts.hostname or parts.path.strip("/") or parts.fragment:
            raise UsageError(f"{spec!r} is not an MQTT URL.", hint="Use mqtt://HOST or mqtts://USER@HOST:8883.")
        if parts.password is not None:
            raise UsageError(
                "Passwords are not allowed on the command line.",
                hint="Store it in a file: mqtt://USER@HOST?password-file=PATH",
            )
        shown = f":{port}" if port != PORTS[parts.scheme] else ""  # distinguishes two brokers of one host
        super().__init__(f"{parts.scheme}://{_host(parts.hostname)}{shown}")
        self._parts = parts
        self._host, self._port = parts.hostname, port
        self._files = _files_of(parts.query, tls=parts.scheme == "mqtts")
        if "password-file" in self._files and not parts.username:
            raise UsageError("A password needs a user.", hint=f"Write {parts.scheme}://USER@HOST?…")
        self._why, self._greeted = "", False
        """Why it is not connected, as far as that is known; whether the broker has ever taken this client."""
        self._client: Any = None
        self._connected = threading.Event()
        self._anew = threading.Event()  # connected, and not announced since
        self._station = StationFacts("")
        self._topics = Topics(self._station)
        self._facts: dict[tuple[str, int], ChannelFacts] = {}
        self._units: dict[tuple[str, int], WrittenUnit | None] = {}
        self._parts_of_topics: dict[str, str] = {}
        """The name of each node in topics, as it was announced last."""
        self._owed_entities: dict[tuple[str, int], None] = {}  # entities to announce, in this order
        self._reports: dict[str, NodeReport] = {}
        """The newest report of each node that is measured; it is published again after each connection and renaming."""
        self._owed_states: dict[str, None] = {}  # nodes whose report the broker does not have, in this order
        self._left: list[str] = []  # topics of former names, whose retained states must be removed
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
        client = paho.Client(CallbackAPIVersion.VERSION2, client_id=f"teds{secrets.token_hex(8)}")
        client.max_queued_messages_set(WAITING)
        if self._parts.scheme == "mqtts":
            client.tls_set_context(self._tls())
        if self._parts.username:
            client.username_pw_set(self._parts.username, self._password())
        client.will_set(self._status, "offline", qos=1, retain=True)
        client.reconnect_delay_set(1, 30)
        client.on_connect = self._on_connect
        client.on_connect_fail = self._on_connect_fail
        client.on_disconnect = self._on_disconnect
        self._client = client

    def _state_topic(self, uuid: str) -> str:
        """Return the topic of a node's state."""
        return f"{self._topics.station}/{self._topics.node(uuid)}/state"

    @property
    def _status(self) -> str:
        """Topic of this measurement's availability."""
        return "/".join(filter(None, (self._topics.station, slug(self._station.instance), "status")))

    def _password(self) -> str | None:
        if "password-file" not in self._files:
            return None
        try:
            return _octets("password-file", self._files["password-file"]).decode().rstrip("\r\n")
        except UnicodeDecodeError as error:
            raise BadDataError(f"The password file {self._files['password-file']} is not UTF-8 text.") from error

    def _tls(self) -> ssl.SSLContext:
        """Return how the broker is checked, and what this client presents; raises NotFoundError, BadDataError."""
        for named, path in self._files.items():
            _octets(named, path)  # checks the size: the library opens files by name, without a limit
        try:
            context = ssl.create_default_context(cafile=self._files.get("ca"))
        except OSError as error:  # ssl.SSLError is one
            raise BadDataError(f"{self._files.get('ca')} contains no CA certificate in PEM format.") from error
        if "cert" in self._files:
            own, key = self._files["cert"], self._files.get("key")
            try:
                context.load_cert_chain(own, key, password=_no_password)
            except (OSError, ValueError) as error:
                raise BadDataError(
                    f"{own} and {key or own} are not a certificate and its key (PEM, unencrypted).",
                    hint="Give them as cert=PATH and key=PATH; openssl pkey removes the passphrase from a key.",
                ) from error
        return context

    def _on_connect(self, _client: Any, _userdata: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._waits(f"the broker at {self._host} refused: {str(reason).lower()}")
            return
        self._greeted = True
        self._connected.set()
        self._anew.set()

    def _on_connect_fail(self, *_: Any) -> None:
        """Record that no connection was made; the library calls this after it caught the cause."""
        error = sys.exc_info()[1]
        self._waits(_in_words(error, self._host, self._port) if error is not None else "")

    def _on_disconnect(self, _client: Any, _userdata: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if self._connected.is_set():
            self._connected.clear()
            self._waits(f"the broker at {self._host} disconnected")
        elif reason == "Keep alive timeout":
            self._waits(f"the broker at {self._host}:{self._port} has been silent for {KEEP_ALIVE} s")
        elif not self._why:  # with TLS 1.3 a server refuses a client's certificate after the client's handshake
            tls = self._parts.scheme == "mqtts"
            other = "; it may expect a different client certificate (cert=, key=)"
            may = other if tls else "; it may expect TLS (mqtts://)"
            self._waits(f"the broker at {self._host}:{self._port} closed the connection without answering{may}")

    def _waits(self, why: str) -> None:
        self._why = why
        self._set_state("waiting", why or f"waiting for the broker at {self._host}")

    def _begin(self) -> None:
        self._waits("")
        self._client.connect_async(self._host, self._port, KEEP_ALIVE)
        self._client.loop_start()

    def _learn(self, facts: tuple[ChannelFacts, ...]) -> None:
        """Announce facts that are new or changed, and those of a node whose topics have been renamed."""
        changed = [channel_facts.key for channel_facts in facts if self._facts.get(channel_facts.key) != channel_facts]
        self._facts.update((channel_facts.key, channel_facts) for channel_facts in facts)
        for uuid in {uuid for uuid, _ in changed}:
            # the last value under a channel's former name would be repeated as a present one
            self._newest.pop(uuid, None)
        own = {channel_facts.uuid for channel_facts in facts}
        touched = {uuid for uuid in self._topics.learn(facts) if uuid in own or uuid in self._parts_of_topics}
        self._units.update(
            (channel_facts.key, display_unit(channel_facts.units) if channel_facts.units else None)
            for channel_facts in facts
        )
        before = {uuid: self._parts_of_topics[uuid] for uuid in touched if uuid in self._parts_of_topics}
        self._parts_of_topics |= {uuid: self._topics.node(uuid) for uuid in touched}
        renamed = {uuid for uuid, name in before.items() if self._parts_of_topics[uuid] != name}
        taken = set(self._parts_of_topics.values()) if renamed else set()
        self._left += [before[uuid] for uuid in renamed if before[uuid] not in taken]
        self._owed_entities |= dict.fromkeys(changed)
        self._owed_states |= dict.fromkeys(uuid for uuid in self._reports if uuid in renamed)
        if renamed:
            self._owed_entities |= dict.fromkeys(key for key in self._facts if key[0] in renamed)

    def _process_item(self, item: Item) -> None:
        self._greet()
        if isinstance(item, Block):
            self._block(item)
        elif isinstance(item, tuple):
            self._learn(item)
            self._announce()
        elif isinstance(item, NodeReport):
            self._reports[item.uuid] = item
            self._owed_states[item.uuid] = None
            self._announce()

    def _idle(self, now: float) -> None:
        self._greet()
        self._announce()

    def _greet(self) -> None:
        """Announce the station and its channels after each connection."""
        if self._anew.is_set() and self._client.publish(self._status, "online", qos=1, retain=True).rc != _FULL:
            self._anew.clear()
            self._why = ""
            self._set_state("running", f"connected to {self._host}")
            self._owed_entities = dict.fromkeys(self._facts)
            self._owed_states |= dict.fromkeys(self._reports)
            self._announce()

    def _announce(self) -> None:
        """Publish states and announce entities that the broker does not have, as far as the library takes them."""
        if not self._connected.is_set() or self._anew.is_set():
            return
        while self._left:
            if self._client.publish(f"{self._topics.station}/{self._left[-1]}/state", b"", retain=True).rc != 0:
                return
            self._left.pop()
        while self._owed_states:
            uuid = next(iter(self._owed_states))
            report = self._reports[uuid]
            if not self._publish(self._state_topic(uuid), status_line(report), retain=True):
                return
            del self._owed_states[uuid]
            if report.state == "ended":  # another measurement may have the node by the next connection
                del self._reports[uuid]
        while self._owed_entities:
            key = next(iter(self._owed_entities))
            if not self._discover(self._facts[key]):
                return
            del self._owed_entities[key]

    def _discover(self, facts: ChannelFacts) -> bool:
        """Announce a channel; False if it has to be done again."""
        if facts.unsigned:  # raw values have no quantity, so there is no sensor to show
            return True
        node = f"{self._topics.station}/{self._topics.node(facts.uuid)}"
        state = self._state_topic(facts.uuid)
        marked = " (unverified)" if facts.unverified else ""
        device = {
            "identifiers": [facts.uuid],
            "name": f"{facts.node or facts.uuid}{marked}",
            "manufacturer": "IEEE 1451 transducer",
            "sw_version": f"teds-provision {__version__}",
        }
        unit = self._units.get(facts.key)
        sign = short_unit(unit.text) if unit else facts.unit
        words = {
            "name": f"{facts.label}{marked}",
            "unique_id": f"{facts.uuid}_{facts.number}",
            "state_topic": node,
            "value_template": f"{{{{ value_json.{self._field(facts)} }}}}",
            "availability": [{"topic": self._status}, {"topic": state, "value_template": RUNS}],
            "availability_mode": "all",
            "state_class": "measurement",
            "device": device,
            **({"unit_of_measurement": sign} if sign else {}),
            **({"device_class": DEVICE_CLASSES[sign]} if sign in DEVICE_CLASSES else {}),
        }
        return self._publish(f"{DISCOVERY}/sensor/{facts.uuid}/{facts.number}/config", words, qos=1, retain=True)

    def _field(self, facts: ChannelFacts) -> str:
        """Name of a channel in the node's JSON; a slug, for a template of Home Assistant is a program."""
        return f"{slug(facts.name) or 'ch'}_{facts.number}"

    def _block(self, block: Block) -> None:
        if block.test_pattern or self._station.scalar_rate <= 0 or not len(block.time):
            return
        newest = self._newest.setdefault(block.uuid, {})
        known = [self._facts.get((block.uuid, n)) or ChannelFacts(block.uuid, "", n, "") for n in block.channels]
        for column, facts in enumerate(known):
            newest[self._field(facts)] = self._shown(facts, float(block.value[-1, column]))
        now = time.monotonic()
        if now >= self._due.get(block.uuid, 0.0):
            self._due[block.uuid] = now + 1 / self._station.scalar_rate
            values = {"time": round(float(block.time[-1]), 6), **newest}
            if any(facts.unsigned for facts in known):
                values["unsigned"] = True
            if any(facts.unverified for facts in known):
                values["unverified"] = True
            topic = f"{self._topics.station}/{self._topics.node(block.uuid)}"
            if self._connected.is_set() and self._publish(topic, values):
                self._count(written=len(newest))
            else:
                self._count(dropped=len(newest))

    def _shown(self, facts: ChannelFacts, value: float) -> float | None:
        """Return a value in its display unit, None if there is none."""
        unit = self._units.get(facts.key)
        if not math.isfinite(value):
            return None
        return value if unit is None else unit.from_si(value)

    def _publish(self, topic: str, words: dict[str, Any], *, qos: int = 0, retain: bool = False) -> bool:
        """Return True if the library took it; without a connection it keeps QoS 1 messages and refuses the rest."""
        octets = _JSON.encode(words).encode()
        code = self._client.publish(topic, octets, qos=qos, retain=retain).rc
        if code == _FULL or (code != 0 and qos == 0):
            return False
        self._count(octets=len(octets), messages=1)
        return True

    def _finish(self) -> None:
        if self._client is None:
            return
        if self._connected.is_set() and not self._publish_offline():
            self._cut()
        self._client.disconnect()
        self._client.loop_stop()
        if not self._greeted and self.stats.dropped:
            why = self._why or f"the broker at {self._host}:{self._port} does not answer"
            self._fail(TedsProvisionError(f"{self.name} accepted nothing: {why}.", hint="Fix that and measure again."))

    def _publish_offline(self) -> bool:
        """Return True if the broker knows that this measurement has ended."""
        until = time.monotonic() + _FAREWELL
        message = self._client.publish(self._status, "offline", qos=1, retain=True)
        while message.rc == _FULL and time.monotonic() < until:
            time.sleep(TICK)
            message = self._client.publish(self._status, "offline", qos=1, retain=True)
        with suppress(ValueError, RuntimeError):  # the message was not accepted
            message.wait_for_publish(max(0.0, until - time.monotonic()))
            return bool(message.is_published())
        return False

    def _cut(self) -> None:
        """End the connection without DISCONNECT, so that the broker publishes offline by its will."""
        connection = self._client.socket()
        if connection is not None:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


def _host(name: str) -> str:
    return f"[{name}]" if ":" in name else name


def _files_of(query: str, *, tls: bool) -> dict[str, str]:
    """Return the files that a URL names; raises UsageError for another key, one that comes twice, a CA without TLS."""
    known = FILES if tls else FILES[:1]
    named: dict[str, str] = {}
    for key, path in parse_qsl(query, keep_blank_values=True):
        if key not in known or key in named or not path:
            what = "comes twice or is empty" if key in known else "is unknown"
            more = "" if tls else f"; with mqtts:// also {', '.join(FILES[1:])}"
            raise UsageError(f"{key!r} in the URL of a broker {what}.", hint=f"Known: {', '.join(known)}{more}.")
        named[key] = path
    if "key" in named and "cert" not in named:
        raise UsageError("'key' in the URL of a broker needs 'cert'.", hint="cert=PATH&key=PATH, both in PEM.")
    return named


def _octets(key: str, path: str) -> bytes:
    """Return a small regular file that the URL names by this key; raises NotFoundError, BadDataError."""
    try:
        if not stat.S_ISREG(Path(path).stat().st_mode):  # opening a pipe would block until it has a writer
            raise BadDataError(f"{key}={path} is no regular file.", hint="Check the URL of the broker.")
    except (OSError, ValueError) as error:
        raise NotFoundError(f"{key}={path} cannot be read.", hint="Check its path and mode.") from error
    return read_limited(Path(path), _MOST_OCTETS, "password or certificate", failure=NotFoundError)


def _no_password() -> str:
    """Return no passphrase for a key: the library would ask for it on the terminal."""
    raise ValueError("the key is encrypted")


def _in_words(error: BaseException, host: str, port: int) -> str:
    """Return why no connection was made, as text."""
    if isinstance(error, ssl.SSLCertVerificationError):
        reason = error.verify_message or str(error)
        return f"the certificate of {host} does not verify: {reason} (ca=PATH names the CA)"
    if isinstance(error, ssl.SSLError):
        return f"TLS with {host}:{port} fails: {getattr(error, 'reason', None) or error}"
    if isinstance(error, socket.gaierror):
        return f"unknown host {host}"
    if isinstance(error, ConnectionRefusedError):
        return f"nothing is listening at {host}:{port}"
    if isinstance(error, TimeoutError):
        return f"{host}:{port} does not answer"
    if isinstance(error, ConnectionResetError):  # during the TLS handshake
        return f"{host}:{port} closed the connection; it may not support TLS (mqtt://)"
    return f"{host}:{port} cannot be reached: {getattr(error, 'strerror', None) or error}"
