"""A simulation feeds its virtual transducer through the API: one writer, checked lines, a limit, every way to end."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.sync.client import ClientConnection, connect

from teds_provision.ncap.nodes.simulation import MOST_OCTETS
from teds_provision.ncap.web.server import LONGEST_MESSAGE
from tests.bench import make_station
from tests.e2e.desk import Desk
from tests.ncap.service import Service, verdict, verified
from tests.pace import PATIENCE, until

pytestmark = pytest.mark.link
CLIENT = Path(__file__).with_name("simulation_client.py")
OPENING, FORCE = 2, 3


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    folder = tmp_path_factory.mktemp("simulation")
    make_station(folder / "prepared" / "bench", "bench").close()
    (folder / "desk").mkdir()
    desk = Desk(folder / "desk", folder / "prepared")
    service = Service(desk, desk.station()).start()
    try:
        yield service
        service.end()
    finally:
        desk.clear()


@pytest.fixture(scope="module")
def token(service: Service) -> str:
    return service.token("sim")


@pytest.fixture(scope="module")
def hand(service: Service) -> str:
    """Return a gripper that waits for its simulation, and is measured."""
    with service.client() as asked:
        made = asked.request("POST", "/virtual", {"profile": "gripper", "name": "hand", "source": "simulation"})
        assert made["simulation"] is None
        assert verdict(verified(service, made["uuid"])) == "authentic"
        asked.request("POST", "/measurements", {"uuids": [made["uuid"]], "rate": 50})
        until(lambda: asked.measurements()[0]["state"] == "running")
    return str(made["uuid"])


def address(service: Service, name: str = "hand") -> str:
    return f"ws://127.0.0.1:{service.port}/api/v1/virtual/{name}/source"


@contextmanager
def simulation(service: Service, token: str, name: str = "hand", **headers: str) -> Iterator[ClientConnection]:
    """Yield a client that has the place; `ready` is taken."""
    until(lambda: fed(service, name) is None, "the place is free")
    with connect(address(service, name), additional_headers={"Authorization": f"Bearer {token}", **headers}) as socket:
        ready = json.loads(socket.recv(PATIENCE))
        assert ready["ready"] is True
        yield socket


def fed(service: Service, name: str) -> dict[str, Any] | None:
    """Who feeds it, as GET /virtual tells."""
    with service.client() as asked:
        [found] = [
            virtual
            for virtual in asked.request("GET", "/virtual")["virtual"]
            if name in (virtual["name"], virtual["uuid"])
        ]
    return None if found["simulation"] is None else dict(found["simulation"])


def last(service: Service, uuid: str, channel: int = OPENING) -> float | None:
    """Return the newest value of a channel, SI; None if it is not valid."""
    with service.client() as asked:
        found = asked.request("GET", f"/nodes/{uuid}/channels/{channel}")["last"]
    return found and found["value"]


def becomes(service: Service, uuid: str, value: float | None, channel: int = OPENING) -> None:
    def there() -> bool:
        now = last(service, uuid, channel)
        return now is None if value is None else now == pytest.approx(value, rel=1e-2)

    until(there, f"channel {channel} becomes {value}")


def answers(socket: ClientConnection, what: str) -> dict[str, Any]:
    """The next answer of a kind."""
    while True:
        found = json.loads(socket.recv(PATIENCE))
        if what in found:
            return dict(found)


def closed(socket: ClientConnection) -> int | None:
    """Return the code with which the station closes it; None if the connection just broke."""
    try:
        while True:
            socket.recv(PATIENCE)
    except ConnectionClosed as why:
        return why.rcvd.code if why.rcvd is not None else None


def refused(service: Service, name: str = "hand", **headers: str) -> int:
    with pytest.raises(InvalidStatus) as why, connect(address(service, name), additional_headers=headers):
        pass
    return why.value.response.status_code


def test_values_reach_the_measurement_and_rejected_ones_are_reported(service: Service, token: str, hand: str) -> None:
    with simulation(service, token) as socket:
        assert (fed(service, "hand") or {})["by"] == "api:sim"
        socket.send('{"value": {"opening": 0.055, "grip force": 70}}')
        becomes(service, hand, 0.055)
        becomes(service, hand, 70, FORCE)
        socket.send('{"value": {"opening": 5}}\n{"value": {"grip force": 35}}')
        limited = answers(socket, "limited")
        assert limited["limited"] == 1
        assert limited["why"].startswith("opening: 5 m is outside 0 to 0.11 m"), limited
        becomes(service, hand, 0.110)
        becomes(service, hand, 35, FORCE)
        for line, why in (
            ('{"value": {"opening": NaN}}', "is no number"),
            ('{"value": {"opening": Infinity}}', "is no number"),
            ('{"value": {"elbow": 1}}', "no sensor named 'elbow'"),
            ('{"value": {"opening": true}}', "is no number"),
            ("not JSON", "not JSON"),
            ("[" * 60_000, "not JSON"),
        ):
            socket.send(line)
            assert why in answers(socket, "skipped")["why"], line
        assert last(service, hand) == pytest.approx(0.110, abs=1e-4), "what was skipped changed nothing"
        socket.send('{"value": {"opening": null}}')
        becomes(service, hand, None)
        assert last(service, hand, FORCE) == pytest.approx(35, abs=0.1), "the other one is valid"
        socket.send(b'{"raw": {"opening": 4095}}')
        becomes(service, hand, 0.110)
        assert (fed(service, "hand") or {})["skipped"] == 6
    becomes(service, hand, None)  # it has gone: nothing is valid, and the node stays
    with service.client() as asked:
        assert asked.measurements()[0]["state"] == "running"
        entries = asked.request("GET", "/log?act=virtual&text=simulation")["entries"]
    assert [(entry["outcome"], entry["actor"]) for entry in entries[-2:]] == [
        ("simulation connected", "sim"),
        ("simulation disconnected", "sim"),
    ]
    assert entries[-1]["facts"]["skipped"] == 6


def test_it_has_one_writer_and_the_next_one_gets_the_place(service: Service, token: str, hand: str) -> None:
    other = service.token("other")
    process = subprocess.Popen(
        [sys.executable, CLIENT, address(service), token], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        assert json.loads(process.stdout.readline())["ready"] is True
        process.stdin.write('{"value": {"opening": 0.011}}\n')
        process.stdin.flush()
        becomes(service, hand, 0.011)
        bearer = {"Authorization": f"Bearer {other}"}
        assert refused(service, **bearer) == 423
        assert refused(service, hand, **bearer) == 423, "nor by its UUID"
        assert last(service, hand) == pytest.approx(0.011, abs=1e-4)
        process.kill()
        with simulation(service, other) as socket:
            socket.send('{"value": {"opening": 0.022}}')
            becomes(service, hand, 0.022)
            assert (fed(service, "hand") or {})["by"] == "api:other"
    finally:
        process.kill()
        process.wait()
        process.stdin.close()
        process.stdout.close()


def test_who_may_not_is_refused_before_anything_is_taken(service: Service, token: str, hand: str) -> None:
    reader = service.token("reader", "--read-only")
    bearer = {"Authorization": f"Bearer {token}"}
    assert refused(service) == 401
    assert refused(service, Authorization="Bearer wrong") == 401
    assert refused(service, Authorization=f"Bearer {reader}") == 403
    assert refused(service, Origin="http://127.0.0.1:1", **bearer) == 403
    assert refused(service, "nobody", **bearer) == 404
    with service.client() as asked:
        plain = asked.request("POST", "/virtual", {"profile": "gripper", "name": "plain", "source": "sine:2"})
        assert refused(service, "plain", **bearer) == 422
        asked.request("DELETE", f"/virtual/{plain['uuid']}")
    assert fed(service, "hand") is None


def test_a_flood_is_read_no_faster_than_the_limit_and_delays_no_other_node(
    service: Service, token: str, hand: str
) -> None:
    line = '{"value": {"opening": 0.033}}\n'
    message = line * (60_000 // len(line))
    size = 3 * MOST_OCTETS // 2
    with simulation(service, token) as socket, service.client() as asked:
        began, sent = time.monotonic(), 0
        while sent < size:
            socket.send(message)
            sent += len(message)
            asked.status()
        socket.send('{"value": {"opening": 0.044}}')
        becomes(service, hand, 0.044)
        # The rule is of octets: what came beyond the burst waited for its time.
        assert time.monotonic() - began > sent / MOST_OCTETS - 0.5
        assert (fed(service, "hand") or {})["lines"] == sent // len(line) + 1, "none is lost"
        socket.send("x" * (LONGEST_MESSAGE + 1))
        assert closed(socket) == 1009
    becomes(service, hand, None)


def test_a_removed_token_ends_its_simulation(service: Service, hand: str) -> None:
    with simulation(service, service.token("brief")) as socket:
        service.station.ask("ncap", "token", "remove", "brief")
        assert closed(socket) == 1008
    until(lambda: fed(service, "hand") is None)


def test_the_simulation_learns_what_actuators_are_set_to(service: Service, token: str) -> None:
    with service.client() as asked:
        made = asked.request("POST", "/virtual", {"profile": "gripper", "name": "claw", "source": "simulation"})
        verified(service, made["uuid"])
        with simulation(service, token, "claw") as socket:
            asked.request("PUT", f"/nodes/{made['uuid']}/channels/1", {"value": 0.04, "hold": 5})
            until(lambda: answers(socket, "set")["set"]["opening set point"] == pytest.approx(0.04, abs=1e-4))
            asked.request("PUT", f"/nodes/{made['uuid']}/channels/1", {"hold": 0})
            asked.request("DELETE", f"/virtual/{made['uuid']}")
            assert closed(socket) == 1012, "it is removed"


def test_it_is_fed_again_after_the_service_was_killed(service: Service, token: str, hand: str) -> None:
    with simulation(service, token) as socket:
        socket.send('{"value": {"opening": 0.005}}')
        becomes(service, hand, 0.005)
        service.kill()
        assert closed(socket) != 1000
    service.start()
    assert fed(service, "hand") is None
    verified(service, hand)
    with simulation(service, token) as socket:
        socket.send('{"t": 0.1, "value": {"opening": 0.066}}')  # a clock of its own from here on
        for tick in range(2, 400):
            socket.send(json.dumps({"t": tick / 10, "value": {"opening": 0.066}}))
            now = last(service, hand)
            if now == pytest.approx(0.066, abs=1e-4):
                break
            time.sleep(0.02)
        becomes(service, hand, 0.066)
