"""``ncap run --foxglove``: one server for the whole service, whose channels come and go with its measurements."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Callable
from typing import Any

import pytest

from tests.e2e.desk import Desk
from tests.measure.sinks import foxglove_watcher
from tests.ncap.service import Service, virtual
from tests.pace import until
from tests.places import self_signed

pytest.importorskip("foxglove")
AT = ("--foxglove-at", "127.0.0.1:0")


class Watcher:
    """A Foxglove client in a process of its own, and what it has seen so far."""

    def __init__(self, desk: Desk, url: str, *authority: object) -> None:
        self.process = desk.start(url, *authority, program=(sys.executable, foxglove_watcher.__file__), fork=False)

    @property
    def lines(self) -> list[dict[str, Any]]:
        self.process.read(0.05)
        return [json.loads(line) for line in self.process.out.split("\n")[:-1]]

    @property
    def open(self) -> set[str]:
        """The topics that its server has now."""
        topics: set[str] = set()
        for line in self.lines:
            topics = (topics | set(line.get("opened", ()))) - set(line.get("closed", ()))
        return topics

    def messages(self, topic: str) -> list[dict[str, Any]]:
        return [line["fields"] for line in self.lines if line.get("topic") == topic]

    @property
    def parameters(self) -> dict[str, Any]:
        return next((line["parameters"] for line in reversed(self.lines) if "parameters" in line), {})

    def sees(self, what: Callable[[Watcher], object]) -> None:
        until(lambda: what(self), lambda: f"{self.process.out!r} {self.process.err!r}")


def test_channels_come_and_go_with_the_measurements_of_the_service(desk: Desk) -> None:
    service = Service(desk, desk.station(), AT).start()
    assert service.process is not None
    url = service.process.wait_for_lines(1)[0]["foxglove"]
    hand, arm = virtual(service, name="hand"), virtual(service, name="arm")
    early = Watcher(desk, url)
    early.sees(lambda seen: any("teds-provision" in line.get("server", "") for line in seen.lines))
    assert early.open == set()
    with service.client() as asked:
        first = asked.request("POST", "/measurements", {"uuids": [hand], "rate": 20})["id"]
        early.sees(lambda seen: seen.messages("/bench/hand/opening"))
        assert "/bench/hand/stream_0" in early.open
        assert not any(topic.startswith("/bench/arm/") for topic in early.open)
        second = asked.request("POST", "/measurements", {"uuids": [arm], "rate": 20})["id"]
        early.sees(lambda seen: seen.messages("/bench/arm/opening"))
        assert {"/bench/hand/opening", "/bench/arm/opening", "/bench/reports"} <= early.open
        early.sees(lambda seen: {"/bench/hand/opening", "/bench/arm/opening"} <= seen.parameters.keys())
        late = Watcher(desk, url)
        late.sees(lambda seen: seen.messages("/bench/hand/opening") and seen.messages("/bench/arm/opening"))
        late.sees(lambda seen: seen.messages("/bench/hand/teds"))
        assert json.loads(late.messages("/bench/hand/teds")[0]["data"])["uuid"] == hand
        status = asked.request("GET", "/status")
        assert status["foxglove"] == url
        assert {sink["name"] for sink in status["sinks"]} == {"foxglove"}
        assert status["budget"]["used"] == 0, "it counts ROS and MQTT"
        asked.end_measurement(first)
        for client in (early, late):
            client.sees(lambda seen: not any(topic.startswith("/bench/hand/") for topic in seen.open))
            assert {"/bench/arm/opening", "/bench/reports"} <= client.open
            client.sees(lambda seen: not any(name.startswith("/bench/hand/") for name in seen.parameters))
        again = asked.request("POST", "/measurements", {"uuids": [hand], "rate": 20})["id"]
        early.sees(lambda seen: "/bench/hand/opening" in seen.open and len(seen.messages("/bench/hand/opening")) > 3)
        assert f"Foxglove: {url}" in service.station.run("ncap", "status").out
        for measurement in (second, again):
            asked.end_measurement(measurement)
        early.sees(lambda seen: seen.open == set())
    service.end()
    assert early.process.end().code == 0, "the server said goodbye"


def test_a_taken_port_ends_the_start(desk: Desk) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        refused = desk.station().refuses("ncap", "run", "--foxglove-at", f"127.0.0.1:{port}", code=5)
    assert f":{port}" in refused["message"]
    assert "--foxglove-at" in refused["hint"]


def test_without_the_extra_it_says_how_to_install_it(desk: Desk) -> None:
    (desk.folder / "foxglove.py").write_text("raise ImportError\n")
    elsewhere = {"environment": {"PYTHONPATH": str(desk.folder)}, "fork": False}
    done = desk.station().run("--json", "ncap", "run", "--foxglove", **elsewhere)
    assert done.code == 2, done
    assert "[foxglove]" in done.json["error"]["hint"]


@pytest.mark.parametrize("command", [("ncap", "run"), ("measure", "none", "--can", "udp_multicast:239.74.163.2")])
def test_another_address_needs_tls_and_a_name_as_for_the_page(desk: Desk, command: tuple[str, ...]) -> None:
    station = desk.station()
    station.ask("group", "create", "none")
    tls = self_signed(desk.folder)
    at = (*command, "--foxglove-at", "0.0.0.0:8765")
    assert "--tls-cert" in station.refuses(*at, code=2)["hint"]
    assert "--http-allow" in station.refuses(*at, *tls, code=2)["hint"]
    assert "together" in station.refuses(*at, *tls[:2], code=2)["message"]
    assert "HOST:PORT" in station.refuses(*command, "--foxglove-at", "localhost:x", code=2)["hint"]


def test_it_speaks_tls_and_takes_its_settings_from_the_file(desk: Desk) -> None:
    station = desk.station()
    _, certificate, _, key = self_signed(desk.folder)
    (station.home / "config.toml").write_text(
        f'[ncap.run]\nfoxglove-at = "127.0.0.1:0"\ntls-cert = "{certificate}"\ntls-key = "{key}"\nno-scalars = true\n'
    )
    service = Service(desk, station).start()
    assert service.process is not None
    url = service.process.wait_for_lines(1)[0]["foxglove"]
    assert url.startswith("wss://127.0.0.1:")
    watcher = Watcher(desk, url, certificate)
    hand = virtual(service)
    with service.client() as asked:
        asked.request("POST", "/measurements", {"uuids": [hand], "rate": 20})
        watcher.sees(lambda seen: seen.messages("/bench/hand/stream_0"))
    assert watcher.open == {"/bench/hand/stream_0", "/bench/hand/teds", "/bench/reports"}
    service.end()
