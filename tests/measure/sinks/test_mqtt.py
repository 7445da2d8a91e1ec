"""MQTT by Debian's mosquitto: discovery for late comers, values in people's units, a broker that dies."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import ssl
import subprocess
import sys
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from teds_provision.errors import BadDataError, TedsProvisionError, UsageError
from teds_provision.measure.blocks import ChannelFacts, NodeReport
from teds_provision.measure.sinks import mqtt, open_sink
from teds_provision.measure.sinks.mqtt import MqttSink
from teds_provision.teds.units import parse_units
from tests.e2e.desk import ROOT
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, HAND, STATION, block
from tests.pace import until
from tests.places import free_tcp_port

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin")
BARE = "8d4d9da65281f7000003"
OIL = replace(FORCE, number=3, name="oil", unit="K", units=parse_units("K"))


PUBLISHER = """
import sys, time
from teds_provision.measure.sinks import open_sink
from tests.measure.sinks.parts import ANGLE, STATION
sink = open_sink(sys.argv[1])
sink.open([ANGLE], STATION)
while sink.stats.state != "running":
    time.sleep(0.01)
print("open", flush=True)
time.sleep(60)
"""


class Broker:
    def __init__(self, folder: Path) -> None:
        self.port = free_tcp_port()
        self.config = folder / "mosquitto.conf"
        self.config.write_text(f"listener {self.port} 127.0.0.1\nallow_anonymous true\n")
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        assert MOSQUITTO
        self.process = subprocess.Popen([MOSQUITTO, "-c", str(self.config)], stderr=subprocess.DEVNULL)

    def stop(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process = None

    def heard(self) -> tuple[Any, dict[str, Any]]:
        """Return a late comer, and the newest of each topic that it hears."""
        import paho.mqtt.client as paho

        topics: dict[str, Any] = {}
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        client.on_connect = lambda *_: client.subscribe("#")
        client.on_message = lambda _c, _u, message: topics.update({message.topic: message.payload.decode()})
        client.connect_async("127.0.0.1", self.port)
        client.loop_start()
        return client, topics

    def heard_of(self, topic: str) -> tuple[Any, list[str]]:
        """Return a client, and all that it hears of one topic."""
        import paho.mqtt.client as paho

        heard: list[str] = []
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        client.on_connect = lambda *_: client.subscribe(topic, qos=1)
        client.on_message = lambda _c, _u, message: heard.append(message.payload.decode())
        client.connect("127.0.0.1", self.port)
        client.loop_start()
        return client, heard


class Cable:
    """Lies between a sink and its broker, and can be pulled: the sink notices, the broker does not."""

    def __init__(self, port: int) -> None:
        self._broker = port
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        self._ends: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listening.accept()
            except OSError:
                return
            far = socket.create_connection(("127.0.0.1", self._broker))
            self._ends += [near, far]
            for sock, other in ((near, far), (far, near)):
                threading.Thread(target=self._carry, args=(sock, other), daemon=True).start()

    def _carry(self, source: socket.socket, other: socket.socket) -> None:
        try:
            while octets := source.recv(1 << 16):
                other.sendall(octets)
        except OSError:
            pass

    def pull(self) -> None:
        """The newest connection ends for the sink; its other half stays open."""
        self._ends[-2].shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._listening.close()
        for sock in self._ends:
            sock.close()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    running = Broker(tmp_path)
    yield running
    running.stop()


@pytest.mark.system
@pytest.mark.skipif(not MOSQUITTO, reason="mosquitto is not installed")
class TestWithMosquitto:
    def test_a_late_comer_finds_every_channel_with_its_unit(self, broker: Broker) -> None:
        broker.start()
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        bare = ChannelFacts(BARE, "bare", 1, "angle", unsigned=True)
        sink.open([ANGLE, OIL, bare], STATION)
        until(lambda: sink.stats.state == "running")
        sink.report(NodeReport(ARM, "lost", "no frame"))
        client, heard = broker.heard()
        key = f"homeassistant/sensor/{HAND}/3/config"
        try:
            until(lambda: key in heard and "bench/arm/state" in heard)
            config = json.loads(heard[key])
            assert config["unit_of_measurement"] == "°C"
            assert config["device_class"] == "temperature"
            assert config["value_template"] == "{{ value_json.oil_3 }}"
            assert config["availability_mode"] == "all"
            assert [item["topic"] for item in config["availability"]] == ["bench/status", "bench/hand/state"]
            warm = block([[7]], [[293.15]], uuid=HAND, channels=(3,))
            until(lambda: (sink.write(warm), config["state_topic"] in heard)[1])
            assert json.loads(heard[config["state_topic"]])["oil_3"] == pytest.approx(20.0)
            assert "unsigned" not in json.loads(heard[config["state_topic"]])
            raw = block([[7]], [[0.0]], [[False]], uuid=BARE)
            until(lambda: (sink.write(raw), "bench/bare" in heard)[1])
            assert json.loads(heard["bench/bare"]).items() >= {"angle_1": None, "unsigned": True}.items()
            assert not any(BARE in topic for topic in heard), "no sensor is shown that has no values"
            assert heard["bench/status"] == "online"
            assert json.loads(heard["bench/arm/state"])["why"] == "no frame"
            sink.close()
            until(lambda: heard["bench/status"] == "offline")
        finally:
            client.disconnect()
            client.loop_stop()
            sink.close()
        assert sink.stats.error == ""

    def test_a_measurement_that_ends_leaves_the_others_online(self, broker: Broker) -> None:
        broker.start()
        client, heard = broker.heard()
        sinks = [open_sink(f"mqtt://127.0.0.1:{broker.port}") for _ in range(2)]
        try:
            for sink, group in zip(sinks, ("left arm", "right arm"), strict=True):
                sink.open([ANGLE], replace(STATION, group=group, instance=group))
            first, other = "bench/left_arm/status", "bench/right_arm/status"
            until(lambda: heard.get(first) == heard.get(other) == "online")
            sinks[0].close()
            until(lambda: heard[first] == "offline")
            assert heard[other] == "online"
        finally:
            client.disconnect()
            client.loop_stop()
            for sink in sinks:
                sink.close()

    def test_a_broker_that_comes_late_and_dies_is_survived(self, broker: Broker) -> None:
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        sink.open([ANGLE], STATION)
        try:
            until(lambda: sink.stats.detail == f"nothing is listening at 127.0.0.1:{broker.port}")
            sink.write(block())
            until(lambda: sink.stats.dropped == 1)
            sink.report(NodeReport(ARM, "running"))
            for _ in range(2):  # each is another process: what the first one retained is lost
                broker.start()
                until(lambda: sink.stats.state == "running")
                client, heard = broker.heard()
                until(lambda: "bench/arm/state" in heard)  # noqa: B023  asked before the next round
                client.disconnect()
                client.loop_stop()
                assert json.loads(heard["bench/arm/state"])["state"] == "running"
                broker.stop()
                until(lambda: sink.stats.state == "waiting")
        finally:
            sink.close()

    def test_a_connection_that_was_cut_puts_no_node_offline_afterwards(self, broker: Broker) -> None:
        # The broker noticed the cut only after 22 s, and its will then said offline over the new connection's online.
        broker.start()
        client, heard = until(lambda: _tried(lambda: broker.heard_of("bench/status")))
        cable = Cable(broker.port)
        sink = open_sink(f"mqtt://127.0.0.1:{cable.port}")
        try:
            sink.open([ANGLE], STATION)
            until(lambda: heard == ["online"])
            cable.pull()
            until(lambda: "offline" in heard and heard[-1] == "online")
        finally:
            sink.close()
            cable.close()
            client.disconnect()
            client.loop_stop()
        assert sink.stats.error == ""

    def test_who_subscribes_after_a_station_was_killed_sees_it_offline(self, broker: Broker) -> None:
        broker.start()
        publisher = subprocess.Popen(
            [sys.executable, "-c", PUBLISHER, f"mqtt://127.0.0.1:{broker.port}"], stdout=subprocess.PIPE, cwd=ROOT
        )
        try:
            assert publisher.stdout is not None
            assert publisher.stdout.readline() == b"open\n"
            before, online = broker.heard_of("bench/status")
            until(lambda: online == ["online"])
        finally:
            publisher.kill()
            publisher.communicate()
        until(lambda: online == ["online", "offline"])
        after, found = broker.heard_of("bench/status")
        until(lambda: found, "the will was for those alone who listened then")
        assert found == ["offline"]
        for client in (before, after):
            client.disconnect()
            client.loop_stop()

    def test_more_channels_than_the_library_holds_are_all_announced(self, broker: Broker) -> None:
        broker.start()
        facts = [replace(ANGLE, uuid=f"{number:020x}", node=f"node {number}") for number in range(1500)]
        client, heard = broker.heard()
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        sink.open(facts, STATION)
        try:
            until(lambda: sum(topic.startswith("homeassistant/") for topic in heard) == len(facts))
            sink.close()
            until(lambda: heard["bench/status"] == "offline")
        finally:
            sink.close()
            client.disconnect()
            client.loop_stop()

    def test_what_ends_before_the_broker_took_all_of_it_is_offline(self, broker: Broker) -> None:
        broker.start()
        facts = [replace(ANGLE, uuid=f"{number:020x}", node=f"node {number}") for number in range(1500)]
        client, heard = until(lambda: _tried(lambda: broker.heard_of("bench/status")))
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        sink.open(facts, STATION)
        try:
            until(lambda: heard == ["online"])
            sink.close()
            until(lambda: heard[-1] == "offline")
        finally:
            sink.close()
            client.disconnect()
            client.loop_stop()
        assert sink.stats.state == "ended"

    def test_a_newcomer_is_announced_and_no_other_node_again(self, broker: Broker) -> None:
        broker.start()
        client, heard = until(lambda: _tried(lambda: broker.heard_of("homeassistant/#")))
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        sink.open([ANGLE], STATION)
        try:
            until(lambda: len(heard) == 1)
            sink.describe([ANGLE])
            sink.describe([OIL])
            sink.describe([OIL])
            sink.describe([replace(OIL, name="hot oil")])
            until(lambda: len(heard) == 3)
            sink.close()
        finally:
            sink.close()
            client.disconnect()
            client.loop_stop()
        assert [json.loads(item)["name"] for item in heard] == ["angle", "oil", "hot oil"]

    def test_a_node_that_gets_another_name_leaves_nothing_behind(self, broker: Broker) -> None:
        broker.start()
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        sink.open([ANGLE], STATION)
        client, heard = broker.heard()
        config = f"homeassistant/sensor/{ARM}/1/config"
        try:
            until(lambda: sink.stats.state == "running")
            sink.report(NodeReport(ARM, "running"))
            until(lambda: config in heard and heard.get("bench/arm/state"))
            sink.describe([replace(ANGLE, chosen=((0, "boom"),))])
            sink.report(NodeReport(ARM, "running"))
            until(lambda: json.loads(heard[config])["state_topic"] == "bench/boom" and "bench/boom/state" in heard)
            until(lambda: heard["bench/arm/state"] == "")  # an empty one takes what was retained away
        finally:
            sink.close()
            client.disconnect()
            client.loop_stop()

    def test_a_broker_that_hangs_delays_no_measurement(self, broker: Broker) -> None:
        broker.start()
        sink = open_sink(f"mqtt://127.0.0.1:{broker.port}")
        sink.open([ANGLE], STATION)
        until(lambda: sink.stats.state == "running")
        client, heard = until(lambda: _tried(lambda: broker.heard_of("bench/status")))
        assert broker.process is not None
        broker.process.send_signal(signal.SIGSTOP)
        try:
            sink.close()
            assert sink.stats.state == "ended"
        finally:
            broker.process.send_signal(signal.SIGCONT)
        try:
            until(lambda: heard[-1:] == ["offline"])
        finally:
            client.disconnect()
            client.loop_stop()


def _tried(make: Any) -> Any:
    """Return what a broker gives that may not listen yet."""
    try:
        return make()
    except OSError:
        return None


def test_a_program_that_accepts_and_sends_nothing_is_reported_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mqtt, "KEEP_ALIVE", 1)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1]
        sink = open_sink(f"mqtt://127.0.0.1:{port}")
        sink.open([ANGLE], STATION)
        try:
            until(lambda: sink.stats.detail == f"the broker at 127.0.0.1:{port} has been silent for 1 s")
        finally:
            sink.close()


class DeskClient:
    """A client of a broker, as the library has it, which keeps what is published; mock, no broker is there."""

    def __init__(self) -> None:
        self.published: list[tuple[str, bytes | str]] = []
        self.retained: list[bool] = []

    def publish(self, topic: str, payload: bytes | str, *, retain: bool = False, **_: object) -> SimpleNamespace:
        """Take a message."""
        self.published.append((topic, payload))
        self.retained.append(retain)
        return SimpleNamespace(rc=0)


def desk_sink(*facts: ChannelFacts) -> tuple[MqttSink, DeskClient]:
    """Return a sink that is connected to a client on the desk."""
    sink, client = MqttSink("mqtt://localhost"), DeskClient()
    sink._prepare(facts, STATION)
    sink._client = client
    sink._connected.set()
    return sink, client


def test_a_channel_that_was_renamed_leaves_no_value_under_its_former_name() -> None:
    """The last value of before went on beside the new ones, as if it were one of now."""
    sink, client = desk_sink(ANGLE)
    sink._process_item(block([[7]], [[1.5]]))
    sink._process_item((replace(ANGLE, name="elbow"),))
    sink._due.clear()
    sink._process_item(block([[8]], [[2.5]]))
    first, second = (json.loads(octets) for topic, octets in client.published if topic == "bench/arm")
    assert set(first) - {"time"} == {"angle_1"}
    assert set(second) - {"time"} == {"elbow_1"}


def test_two_brokers_of_one_host_have_two_names() -> None:
    specs = ["mqtt://lab", "mqtt://lab:1883", "mqtt://lab:1884", "mqtts://lab:1884", "mqtt://[::1]:1885"]
    names = [open_sink(spec).name for spec in specs]
    assert names == ["mqtt://lab", "mqtt://lab", "mqtt://lab:1884", "mqtts://lab:1884", "mqtt://[::1]:1885"]


@pytest.mark.parametrize("spec", ["mqtt://", "mqtt:host", "mqtt://user:secret@host"])
def test_what_is_no_url_or_holds_a_password_is_refused(spec: str) -> None:
    with pytest.raises(UsageError) as caught:
        open_sink(spec)
    assert "secret" not in str(caught.value)


def test_a_password_file_that_is_not_there_is_reported(tmp_path: Path) -> None:
    sink = open_sink(f"mqtt://user@127.0.0.1:1?password-file={tmp_path}/none")
    with pytest.raises(TedsProvisionError, match="password-file="):
        sink.open([ANGLE], STATION)


def test_under_another_name_of_their_node_all_channels_are_announced_anew_and_its_old_state_goes() -> None:
    other = replace(ANGLE, number=2, name="other")
    sink, client = desk_sink(ANGLE, other)
    sink._process_item((ANGLE, other))
    first = [topic for topic, _ in client.published]
    assert first == [f"homeassistant/sensor/{ARM}/{number}/config" for number in (1, 2)]
    client.published.clear()
    client.retained.clear()
    sink._process_item((ANGLE, other))
    assert client.published == [], "nothing is new"
    sink._process_item((replace(ANGLE, chosen=((0, "left"),)),))
    topics = [topic for topic, _ in client.published]
    assert topics == ["bench/arm/state", *first]
    assert client.published[0][1] == b""
    assert client.retained[0], "an empty message removes a retained one only if it is retained itself"
    assert [json.loads(octets)["state_topic"] for _, octets in client.published[1:]] == ["bench/left"] * 2


@pytest.mark.parametrize("greeted", [True, False])
def test_values_that_were_dropped_are_no_failure_of_a_broker_that_took_this_client_once(greeted: bool) -> None:
    sink, client = desk_sink(ANGLE)
    client.disconnect = client.loop_stop = lambda: None  # type: ignore[attr-defined]
    sink._connected.clear()
    sink._waits("nothing is listening at localhost:1883")
    if greeted:
        sink._on_connect(None, None, None, SimpleNamespace(is_failure=False), None)
        sink._connected.clear()
    sink._count(dropped=5)
    sink._finish()
    assert (sink.stats.error == "") is greeted
    assert greeted or "accepted nothing: nothing is listening at localhost:1883" in sink.stats.error


def test_a_test_pattern_and_a_rate_of_nothing_reach_no_topic_and_an_invalid_value_is_null() -> None:
    sink, client = desk_sink(replace(ANGLE, units=parse_units("rad")))
    sink._process_item(block([[7]], [[1.5]], test_pattern=True))
    sink._station = replace(STATION, scalar_rate=0.0)
    sink._process_item(block([[7]], [[1.5]]))
    assert (client.published, sink._newest) == ([], {})
    sink._station = STATION
    sink._process_item(block([[7], [8]], [[1.0], [0.5]], [[True], [False]]))
    [(topic, octets)] = client.published
    assert (topic, json.loads(octets)) == ("bench/arm", {"time": 1_795_000_000.01, "angle_1": None})
    sink._process_item(block([[9]], [[1.5]]))
    assert len(client.published) == 1, "ten times a second"
    sink._due.clear()
    sink._process_item(block([[9]], [[1.5]]))
    assert json.loads(client.published[1][1])["angle_1"] == pytest.approx(85.9437), "degrees, as people read them"


def test_what_is_announced_and_the_state_are_retained_and_values_are_not() -> None:
    sink, client = desk_sink()
    sink._process_item((replace(ANGLE, units=parse_units("rad"), unverified=True),))
    sink._process_item(NodeReport(ARM, "running"))
    sink._process_item(block())
    assert [topic for topic, _ in client.published] == [
        f"homeassistant/sensor/{ARM}/1/config", "bench/unverified/arm/state", "bench/unverified/arm",
    ]  # fmt: skip
    assert client.retained == [True, True, False]
    config, _, values = (json.loads(octets) for _, octets in client.published)
    assert (config["unit_of_measurement"], config["state_class"], "device_class" in config) == (
        "°", "measurement", False
    )  # fmt: skip
    assert (config["name"], config["device"]["name"]) == ("angle (unverified)", "arm (unverified)")
    assert config["unique_id"] == f"{ARM}_1"
    assert config["availability"] == [
        {"topic": "bench/status"},
        {
            "topic": "bench/unverified/arm/state",
            "value_template": "{{ 'online' if value_json.state == 'running' else 'offline' }}",
        },
    ]
    assert values["unverified"] is True


class Library:
    """Stands for paho's client and keeps each call; mock, no connection is made."""

    def __init__(self, *_: object, client_id: str = "") -> None:
        self.called: list[tuple[str, tuple[object, ...], dict[str, object]]] = [("id", (client_id,), {})]
        self.rc = 0

    def __getattr__(self, name: str) -> Any:
        return lambda *words, **more: (self.called.append((name, words, more)), SimpleNamespace(rc=self.rc))[1]

    def of(self, name: str) -> list[tuple[tuple[object, ...], dict[str, object]]]:
        """Return what was given to one of its functions, and forget it."""
        found = [(words, more) for called, words, more in self.called if called == name]
        self.called = [call for call in self.called if call[0] != name]
        return found


ONLINE = (("bench/arm_7/status", "online"), {"qos": 1, "retain": True})


def with_library(monkeypatch: pytest.MonkeyPatch, spec: str, *facts: ChannelFacts) -> tuple[MqttSink, Any]:
    """Return a sink that has begun, and its library; the measurement's instance is "Arm 7"."""
    monkeypatch.setattr("paho.mqtt.client.Client", Library)
    sink = MqttSink(spec)
    sink._prepare(facts, replace(STATION, instance="Arm 7"))
    sink._begin()
    return sink, sink._client


def connected(sink: MqttSink) -> None:
    """Let the broker take the client."""
    sink._on_connect(None, None, None, SimpleNamespace(is_failure=False), None)


@pytest.mark.parametrize(
    ("spec", "host", "port"),
    [
        ("mqtt://lab", "lab", 1883),
        ("mqtt://lab:1884", "lab", 1884),
        ("mqtts://lab", "lab", 8883),
        ("mqtt://[::1]", "::1", 1883),
    ],
)
def test_the_broker_learns_at_the_connection_what_it_says_when_the_station_is_gone(
    spec: str, host: str, port: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """``offline``, retained, and with a receipt; each measurement under its own name and its own client."""
    (sink, library), (_, other) = (with_library(monkeypatch, spec) for _ in range(2))
    assert library.of("will_set") == [(("bench/arm_7/status", "offline"), {"qos": 1, "retain": True})]
    assert library.of("connect_async") == [((host, port, 15), {})]
    assert library.of("reconnect_delay_set") == [((1, 30), {})]
    assert library.of("id") != other.of("id")
    assert (sink.stats.state, sink.stats.detail) == ("waiting", f"waiting for the broker at {host}")
    assert not library.of("username_pw_set")


@pytest.mark.parametrize(
    ("octets", "password"),
    [(b"secret", "secret"), (b" se cret \n", " se cret "), (b"secret\r\n", "secret"), ("sécrèt\n".encode(), "sécrèt")],
)
def test_a_password_is_the_files_text_without_its_last_line_end(
    octets: bytes, password: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "password").write_bytes(octets)
    _, library = with_library(monkeypatch, f"mqtt://arm@lab?password-file={tmp_path}/password")
    assert library.of("username_pw_set") == [(("arm", password), {})]
    _, library = with_library(monkeypatch, "mqtt://arm@lab")
    assert library.of("username_pw_set") == [(("arm", None), {})]
    (tmp_path / "password").write_bytes(b"x" * (1 << 20))
    with_library(monkeypatch, f"mqtt://arm@lab?password-file={tmp_path}/password")
    (tmp_path / "password").write_bytes(b"x" * ((1 << 20) + 1))
    with pytest.raises(BadDataError, match="larger"):
        with_library(monkeypatch, f"mqtt://arm@lab?password-file={tmp_path}/password")
    (tmp_path / "password").write_bytes(b"\xff\xfe")
    with pytest.raises(BadDataError, match="is not UTF-8 text"):
        with_library(monkeypatch, f"mqtt://arm@lab?password-file={tmp_path}/password")


def test_each_connection_announces_the_measurement_and_every_channel_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    """A broker that was started again may have lost what it retained."""
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    config = f"homeassistant/sensor/{ARM}/1/config"
    sink._idle(0.0)
    assert library.of("publish") == [], "nothing before there is a connection"
    for _ in range(2):
        connected(sink)
        sink._idle(0.0)
        first, second = library.of("publish")
        assert first == ONLINE
        assert (second[0][0], second[1]) == (config, {"qos": 1, "retain": True})
        assert (sink.stats.state, sink.stats.detail) == ("running", "connected to lab")
        sink._idle(0.0)
        assert library.of("publish") == []
        sink._on_disconnect(None, None, None, "Unspecified error", None)
        assert (sink.stats.state, sink.stats.detail) == ("waiting", "the broker at lab disconnected")
        sink._process_item((OIL,))
        assert library.of("publish") == []
        sink._facts.pop(OIL.key)
        sink._owed_entities.clear()


def test_what_a_full_library_did_not_take_is_announced_later_in_its_order(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    assert library.of("max_queued_messages_set") == [((1000,), {})]
    library.rc = 15
    connected(sink)
    sink._process_item((OIL,))
    assert library.of("publish") == [ONLINE], "no channel before the measurement"
    assert (sink.stats.state, sink.stats.messages) == ("waiting", 0)
    library.rc = 0
    sink._idle(0.0)
    topics = [words[0] for words, _ in library.of("publish")]
    assert topics == [
        "bench/arm_7/status",
        *(f"homeassistant/sensor/{key}/config" for key in (f"{ARM}/1", f"{HAND}/3")),
    ]
    assert sink.stats.messages == 2


def test_an_entity_has_name_unit_and_device_of_the_datasheet() -> None:
    """Also where the datasheet has no name or a unit that is not shown otherwise; without a unit there is none."""
    nameless = replace(ANGLE, node="", name="", unit="")
    sink, client = desk_sink(nameless, replace(FORCE, name="Kraft [N] }}"))
    sink._announce()
    first, second = (json.loads(octets) for _, octets in client.published)
    assert first["device"] == {
        "identifiers": [ARM], "name": ARM, "manufacturer": "IEEE 1451 transducer",
        "sw_version": first["device"]["sw_version"],
    }  # fmt: skip
    assert first["device"]["sw_version"].startswith("teds-provision ")
    assert (first["value_template"], "unit_of_measurement" in first) == ("{{ value_json.ch_1 }}", False)
    assert first["availability_mode"] == "all"
    assert (second["device"]["identifiers"], second["device"]["name"]) == ([HAND], "hand")
    assert (second["unit_of_measurement"], second["name"]) == ("N", "Kraft [N] }}")
    assert second["value_template"] == "{{ value_json.kraft_n_2 }}", "a template is a program"


@pytest.mark.parametrize("mark", ["unsigned", "unverified"])
def test_values_are_marked_if_one_of_their_channels_is_and_each_node_has_its_own_beat(mark: str) -> None:
    marked: dict[str, Any] = {mark: True}
    sink, client = desk_sink(ANGLE, replace(ANGLE, number=2, name="other", **marked), FORCE)
    for _ in range(2):
        sink._process_item(block([[1, 2]], channels=(1, 2)))
        sink._process_item(block(uuid=HAND, channels=(2,)))
    arm, hand = (json.loads(octets) for _, octets in client.published)
    assert (arm[mark], mark in hand) == (True, False)
    assert (sink.stats.written, sink.stats.messages) == (3, 2)
    assert sink.stats.octets == sum(len(octets) for _, octets in client.published)
    sink._connected.clear()
    sink._due.clear()
    sink._process_item(block([[1, 2]], channels=(1, 2)))
    assert (sink.stats.dropped, sink.stats.written, len(client.published)) == (2, 3, 2)


def test_the_state_of_a_node_has_its_counters() -> None:
    sink, client = desk_sink(ANGLE)
    sink._announce()
    client.published.clear()
    sink._process_item(NodeReport(ARM, "lost", "no frame", samples=9, lost=1, late=2, bad=3, invalid=4))
    [(topic, octets)] = client.published
    words = json.loads(octets)
    assert (topic, words["state"], words["why"]) == ("bench/arm/state", "lost", "no frame")
    assert [words[name] for name in ("samples", "lost", "late", "bad", "invalid")] == [9, 1, 2, 3, 4]


def test_each_connection_publishes_the_newest_state_of_every_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """An entity whose node has no retained state stays unavailable, also if the node runs."""
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    state = "bench/arm/state"
    sink._process_item(NodeReport(ARM, "starting"))
    sink._process_item(NodeReport(ARM, "running"))
    assert library.of("publish") == [], "nothing before there is a connection"
    for _ in range(2):
        connected(sink)
        sink._idle(0.0)
        first, (words, more), config = library.of("publish")
        assert (first, words[0], more) == (ONLINE, state, {"qos": 0, "retain": True})
        assert json.loads(words[1])["state"] == "running"
        assert config[0][0].endswith("/config")
        sink._idle(0.0)
        assert library.of("publish") == [], "once"
    library.rc = 4  # the connection was lost, and nobody has noticed yet
    sink._process_item(NodeReport(ARM, "lost"))
    assert [words[0] for words, _ in library.of("publish")] == [state]
    library.rc = 0
    sink._idle(0.0)
    [(words, _)] = library.of("publish")
    assert (words[0], json.loads(words[1])["state"]) == (state, "lost")


def test_the_end_of_a_node_is_published_once_and_not_after_later_connections(monkeypatch: pytest.MonkeyPatch) -> None:
    """By then another measurement may have the node, whose state is running."""
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    for state in ("running", "ended"):
        sink._process_item(NodeReport(ARM, state))  # type: ignore[arg-type]
    for published in (["ended"], []):
        connected(sink)
        sink._idle(0.0)
        sent = [words for words, _ in library.of("publish") if words[0] == "bench/arm/state"]
        assert [json.loads(words[1])["state"] for words in sent] == published


def test_a_former_topic_is_cleared_once_the_library_takes_that(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    connected(sink)
    sink._process_item(NodeReport(ARM, "running"))
    library.of("publish")
    library.rc = 4  # the connection was lost, and nobody has noticed yet
    sink._process_item((replace(ANGLE, chosen=((0, "left"),)),))
    library.of("publish")
    library.rc = 0
    sink._idle(0.0)
    assert next(words[:2] for words, _ in library.of("publish")) == ("bench/arm/state", b"")


def test_a_node_with_a_new_name_keeps_its_state_under_it() -> None:
    sink, client = desk_sink(ANGLE, FORCE)
    sink._announce()
    sink._process_item(NodeReport(ARM, "running"))
    sink._process_item(NodeReport(HAND, "running"))
    client.published.clear()
    sink._process_item((replace(ANGLE, chosen=((0, "left"),)),))
    assert [topic for topic, _ in client.published] == [
        "bench/arm/state", "bench/left/state", f"homeassistant/sensor/{ARM}/1/config",
    ]  # fmt: skip
    assert json.loads(client.published[1][1])["state"] == "running"


def test_values_that_the_library_refuses_are_counted_as_dropped(monkeypatch: pytest.MonkeyPatch) -> None:
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    connected(sink)
    sink._idle(0.0)
    library.rc = 4  # the connection was lost, and nobody has noticed yet
    sink._process_item(block([[7]], [[1.5]]))
    assert (sink.stats.written, sink.stats.dropped) == (0, 1)


def test_two_nodes_that_swap_their_names_lose_neither_state() -> None:
    """The old topic of one is the new one of the other: nothing is to be removed."""
    sink, client = desk_sink(replace(ANGLE, chosen=((0, "left"),)), replace(FORCE, chosen=((0, "right"),)))
    sink._announce()
    client.published.clear()
    sink._process_item((replace(ANGLE, chosen=((0, "right"),)), replace(FORCE, chosen=((0, "left"),))))
    assert not [topic for topic, octets in client.published if octets == b""]
    assert len(client.published) == 2


@pytest.mark.parametrize(
    ("scheme", "connected_before", "reason", "words"),
    [
        ("mqtt", False, "x", "the broker at lab:7 closed the connection without answering; it may expect TLS (mqtts://)"),
        (
            "mqtts", False, "x",
            "the broker at lab:7 closed the connection without answering; it may expect a different client certificate"
            " (cert=, key=)",
        ),
        ("mqtt", False, "Keep alive timeout", "the broker at lab:7 has been silent for 15 s"),
        ("mqtt", True, "Keep alive timeout", "the broker at lab disconnected"),
    ],
)  # fmt: skip
def test_why_a_connection_ended_is_reported_and_kept(
    scheme: str, connected_before: bool, reason: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sink, library = with_library(monkeypatch, f"{scheme}://lab:7")
    if connected_before:
        connected(sink)
    sink._on_disconnect(None, None, None, reason, None)
    assert (sink.stats.state, sink.stats.detail) == ("waiting", words)
    if not connected_before:
        sink._waits("nothing is listening at lab:7")
        sink._on_disconnect(None, None, None, "another", None)
        assert sink.stats.detail == "nothing is listening at lab:7", "the cause that is known stays"
    sink._finish()
    assert sink.stats.error == "", "no value was to be sent"
    assert [call[0] for call in library.called[-2:]] == ["disconnect", "loop_stop"]


class Refusal:
    """A reason code of the library, as it prints itself."""

    is_failure = True

    def __str__(self) -> str:
        return "Not authorized"


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (socket.gaierror(-2, "x"), "unknown host lab"),
        (ConnectionRefusedError(), "nothing is listening at lab:7"),
        (TimeoutError(), "lab:7 does not answer"),
        (ConnectionResetError(), "lab:7 closed the connection; it may not support TLS (mqtt://)"),
        (OSError(113, "No route to host"), "lab:7 cannot be reached: No route to host"),
        (ValueError("odd"), "lab:7 cannot be reached: odd"),
        (ssl.SSLError("odd"), "TLS with lab:7 fails: ('odd',)"),
        (Refusal(), "the broker at lab refused: not authorized"),
    ],
)
def test_why_there_is_no_connection_is_said_in_words(error: Any, words: str, monkeypatch: pytest.MonkeyPatch) -> None:
    sink, _ = with_library(monkeypatch, "mqtt://lab:7")
    if isinstance(error, Refusal):
        sink._on_connect(None, None, None, error, None)
    else:
        try:
            raise error
        except Exception:  # noqa: BLE001  where the library calls it
            sink._on_connect_fail()
    assert (sink.stats.state, sink.stats.detail) == ("waiting", words)
    sink._count(dropped=1)
    sink._finish()
    assert sink.stats.error == f"mqtt://lab:7 accepted nothing: {words}."


@pytest.mark.parametrize(("rc", "again"), [(15, True), (4, False)])
def test_an_entity_that_the_library_did_not_take_is_announced_again_and_one_that_it_keeps_is_not(
    rc: int, again: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """15: its queue is full; 4: the connection was lost, and it keeps what has a receipt until there is one."""
    sink, library = with_library(monkeypatch, "mqtt://lab", ANGLE)
    connected(sink)
    sink._idle(0.0)
    library.of("publish")
    library.rc = rc
    sink._process_item((OIL,))
    assert [words[0] for words, _ in library.of("publish")] == [f"homeassistant/sensor/{HAND}/3/config"]
    library.rc = 0
    sink._idle(0.0)
    assert len(library.of("publish")) == again


def test_a_channel_without_an_entity_keeps_no_other_one_waiting() -> None:
    sink, client = desk_sink(replace(ANGLE, unsigned=True), FORCE)
    sink._announce()
    assert [topic for topic, _ in client.published] == [f"homeassistant/sensor/{HAND}/2/config"]
