"""A command that writes to a node which the running base station measures: it is let go, written, and given back."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision import client
from teds_provision.errors import PolicyError
from tests.e2e.desk import ANGLE, Desk, nothing_lost
from tests.ncap.service import unix
from tests.ncap.test_survives import Lab
from tests.pace import best_of, until

pytestmark = pytest.mark.link
HOLDER = """
import sys, time
from teds_provision import client
with client.connect(home=sys.argv[1]).released(sys.argv[2], "write") as had:
    print(had, flush=True)
    time.sleep(600)
"""


@pytest.fixture(scope="module")
def one_lab(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Lab]:
    desk = Desk(tmp_path_factory.mktemp("written"), prepared)
    try:
        yield Lab(desk)
    finally:
        desk.clear()


@pytest.fixture
def lab(one_lab: Lab) -> Iterator[Lab]:
    yield one_lab
    one_lab.tidy()


def events_of(lab: Lab) -> list[dict[str, Any]]:
    """Return what the daemon said of the node being measured, in order."""
    process = lab.service.process
    assert process is not None
    while process.read(0.1):
        pass
    lines = [json.loads(line) for line in process.out[: process.out.rfind("\n") + 1].splitlines()]
    return [line for line in lines if line.get("event") == "measurement" and line.get("uuid") == lab.node.uuid]


def states(lab: Lab) -> list[str]:
    return [entry["state"] for entry in events_of(lab)]


def calibrated(lab: Lab, most: float) -> Path:
    """Return a calibration whose values end elsewhere."""
    file = lab.desk.folder / f"to-{most}.csv"
    file.write_text(f"# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,{most}\n")
    return file


def test_a_node_is_provisioned_while_it_is_measured_and_the_gap_is_reported(lab: Lab) -> None:
    """Its values follow the new calibration from then on, in the same measurement and the same recording."""
    lab.service.start()
    measurement = lab.measure(sinks=["gap.jsonl"])
    words = ["--profile", ANGLE, "--calibration", calibrated(lab, 180.0), "--yes", *lab.desk.links.over("can")]
    done = lab.service.station.ask("provision", lab.node.uuid, *words)
    assert done["verdict"] == "authentic"
    until(lambda: states(lab)[-1:] == ["joined"])
    assert states(lab) == ["joined", "left", "joined"]
    assert events_of(lab)[1]["why"] == "let go for provision"
    assert events_of(lab)[1]["id"] == measurement
    lab.flows()
    lab.service.end()
    lines = [json.loads(line) for line in (lab.service.station.home / "recordings/gap.jsonl").read_text().splitlines()]
    assert len({line["fingerprint"] for line in lines if line["event"] == "channel"}) == 2
    assert any(line["event"] == "status" and line["why"] == "let go for provision" for line in lines)


def test_write_and_address_have_the_node_let_go_too(lab: Lab) -> None:
    station, over = lab.service.station, lab.desk.links.over("can")
    lab.service.start()
    lab.measure()
    sequence = station.ask("history", lab.node.uuid)["history"][0]["sequence"]
    assert station.ask("write", lab.node.uuid, "--from", sequence, *over)["verified"]
    lab.flows()

    def moved() -> float:
        other = station.ask("nodes", lab.node.uuid)["nodes"][0]["can_address"] % 239 + 1
        assert station.ask("address", lab.node.uuid, other, *over)
        until(lambda: states(lab)[-1] == "joined", "it is measured at its new address")
        lab.flows()
        assert lab.state()["address"] == other
        left, joined = events_of(lab)[-2:]
        return unix(joined) - unix(left)

    best_of(3, 8.0, moved)  # not when its old address was given up, 10 s later
    lab.service.end()


def test_a_measured_node_blinks_and_stays_measured(lab: Lab) -> None:
    """Asked of the daemon it blinks in the measurement's session, asked by a command in a session of its own."""
    lab.service.start()
    lab.measure()
    node = lab.node

    def blinks() -> list[Any]:
        assert node.process is not None
        node.process.read(0)
        lines = [json.loads(line) for line in node.process.out[: node.process.out.rfind("\n") + 1].splitlines()]
        return [line["seconds"] for line in lines if line.get("event") == "locate"]

    with lab.service.client() as asked:

        def counts() -> dict[str, Any]:
            return dict(asked.request("GET", "/measurements")["measurements"][0]["nodes"][0])

        before = counts()
        asked.locate(node.uuid, 5)
        asked.locate(node.uuid, 0)
        until(lambda: blinks() == [5, 0])
        done = lab.service.station.ask("locate", node.uuid, "--for", "7s", *lab.desk.links.over("can"))
        assert [board["uuid"] for board in done["located"]] == [node.uuid]
        until(lambda: blinks() == [5, 0, 7])
        until(lambda: counts()["samples"] > before["samples"] + 100, "its values do not go on")
        assert counts()["bad"] == before["bad"]
        assert states(lab) == ["joined"], "it was measured all the time, in one session"
    lab.service.end()


@pytest.mark.realtime
def test_blinking_costs_no_value(lab: Lab) -> None:
    """Ten requests in two seconds through the session that carries the stream."""
    lab.service.start()
    lab.measure()
    with lab.service.client() as asked:

        def counts() -> dict[str, int]:
            return dict(asked.request("GET", "/measurements")["measurements"][0]["nodes"][0])

        until(lambda: counts()["samples"] > 0)
        before = counts()
        with nothing_lost(lab.node, counts):
            for _ in range(10):
                asked.locate(lab.node.uuid, 1)
                time.sleep(0.2)
            until(lambda: counts()["samples"] > before["samples"] + 50, "its values do not go on")
    lab.service.end()


@pytest.mark.nightly(
    "tests/ncap/test_newcomers_in_pairs.py::test_a_writer_that_is_killed_gives_a_matched_node_back, in a "
    "measurement of all"
)
def test_a_writer_that_is_killed_gives_the_node_back(lab: Lab) -> None:
    lab.service.start()
    lab.measure()
    words = [sys.executable, "-c", HOLDER, lab.service.station.home, lab.node.uuid]
    with subprocess.Popen([*map(str, words)], stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "True\n"
        until(lambda: states(lab)[-1:] == ["left"])
        holder.kill()
    until(lambda: states(lab)[-1:] == ["joined"], "the node is not given back")
    lab.flows()
    lab.service.end()


def test_two_writers_have_it_and_it_comes_back_after_the_last(lab: Lab) -> None:
    lab.service.start()
    lab.measure()
    home = lab.service.station.home
    with client.connect(home=home).released(lab.node.uuid, "write") as first:
        assert first is True
        with client.connect(home=home).released(lab.node.uuid, "address") as second:
            assert second is True
        time.sleep(1.5)  # it would be back by now
        assert states(lab)[-1] == "left"
    until(lambda: states(lab)[-1] == "joined")
    assert states(lab) == ["joined", "left", "joined"]
    lab.service.end()


@pytest.mark.nightly(
    "tests/ncap/test_newcomers.py::test_a_node_that_goes_while_its_writer_has_it_joins_when_it_comes_back, in a "
    "measurement of all"
)
def test_a_node_that_goes_while_its_writer_has_it_is_measured_when_it_comes_back(lab: Lab) -> None:
    lab.service.start()
    lab.measure()
    with client.connect(home=lab.service.station.home).released(lab.node.uuid, "write"):
        lab.node.kill()
    lab.power()
    until(lambda: states(lab)[-1] == "joined")
    lab.flows()
    lab.service.end()


def test_a_measurement_that_is_deleted_under_a_writer_stays_deleted(lab: Lab) -> None:
    lab.service.start()
    measurement = lab.measure()
    with client.connect(home=lab.service.station.home).released(lab.node.uuid, "write"), lab.service.client() as asked:
        asked.end_measurement(measurement)
    time.sleep(1.0)
    assert states(lab)[-1] == "left"
    assert lab.state()["measurement"] is None
    lab.service.end()


def test_what_is_not_measured_need_not_be_released(lab: Lab) -> None:
    home = lab.service.station.home
    with client.connect(home=home).released(lab.node.uuid, "write") as had:
        assert had is False, "no base station runs"
    lab.service.start()
    with client.connect(home=home).released(lab.node.uuid, "write") as had:
        assert had is False
    lab.service.end()


@pytest.mark.parametrize(
    "answer", ["", "refused: It is busy.\n", "waiting\nrefused: It is busy.\n"], ids=["nothing", "no", "late"]
)
def test_a_base_station_that_does_not_answer_is_6(tmp_path: Path, answer: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "LETTING_GO", 0.5)
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / client.SOCKET))
        listener.listen()

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(4096)
                if answer:
                    connection.sendall(f"HTTP/1.1 200 OK\r\nContent-Length: {len(answer)}\r\n\r\n{answer}".encode())
                connection.recv(1)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        with pytest.raises(PolicyError) as refused, client.connect(home=tmp_path).released("00" * 10, "write"):
            pass
        assert refused.value.exit_code == 6
        assert ("It is busy." in refused.value.message) == bool(answer)
        thread.join(5)


def test_a_base_station_that_is_not_silent_is_waited_for(tmp_path: Path) -> None:
    """Another command is before this one: each line begins the time anew that a silent base station gets."""
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(str(tmp_path / client.SOCKET))
        listener.listen()

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(4096)
                connection.sendall(b"HTTP/1.1 200 OK\r\nConnection: close\r\n\r\n")
                connection.sendall(5 * client.STILL_WAITING)
                connection.sendall(b"let go\n")
                connection.recv(1)

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        with client.connect(home=tmp_path).released("00" * 10, "write") as had:
            assert had is True
        thread.join(5)
