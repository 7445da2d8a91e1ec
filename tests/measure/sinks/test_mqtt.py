"""MQTT by Debian's mosquitto: discovery for late comers, values in people's units, a broker that dies."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import TedsProvisionError, UsageFailure
from teds_provision.measure.blocks import ChannelFacts, NodeReport
from teds_provision.measure.sinks import open_sink
from teds_provision.teds.units import parse_units
from tests.measure.sinks.parts import ANGLE, ARM, FORCE, HAND, STATION, block
from tests.pace import until
from tests.places import free_tcp_port

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin")
BARE = "8d4d9da65281f7000003"
OIL = replace(FORCE, number=3, name="oil", unit="K", units=parse_units("K"))


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
        """A late comer, and the newest of each topic that it hears."""
        import paho.mqtt.client as paho

        topics: dict[str, Any] = {}
        client = paho.Client(paho.CallbackAPIVersion.VERSION2)
        client.on_connect = lambda *_: client.subscribe("#")
        client.on_message = lambda _c, _u, message: topics.update({message.topic: message.payload.decode()})
        client.connect_async("127.0.0.1", self.port)
        client.loop_start()
        return client, topics


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    one = Broker(tmp_path)
    yield one
    one.stop()


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
            assert [one["topic"] for one in config["availability"]] == ["bench/status", "bench/hand/state"]
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
            one, other = "bench/left_arm/status", "bench/right_arm/status"
            until(lambda: heard.get(one) == heard.get(other) == "online")
            sinks[0].close()
            until(lambda: heard[one] == "offline")
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
            until(lambda: sink.stats.detail == f"nobody listens at 127.0.0.1:{broker.port}")
            sink.write(block())
            until(lambda: sink.stats.dropped == 1)
            for _ in range(2):
                broker.start()
                until(lambda: sink.stats.state == "running")
                broker.stop()
                until(lambda: sink.stats.state == "waiting")
        finally:
            sink.close()


@pytest.mark.parametrize("spec", ["mqtt://", "mqtt:host", "mqtt://user:secret@host"])
def test_what_is_no_url_or_holds_a_password_is_refused(spec: str) -> None:
    with pytest.raises(UsageFailure) as caught:
        open_sink(spec)
    assert "secret" not in str(caught.value)


def test_a_password_file_that_is_not_there_is_told(tmp_path: Path) -> None:
    sink = open_sink(f"mqtt://user@127.0.0.1:1?password-file={tmp_path}/none")
    with pytest.raises(TedsProvisionError, match="password-file="):
        sink.open([ANGLE], STATION)
