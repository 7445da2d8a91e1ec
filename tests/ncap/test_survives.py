"""What may happen to a base station: ends, cuts, restarts, missing links, full disks, other commands beside it."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import sqlite3
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest

from teds_provision import client
from teds_provision.cli.rendering import local_time
from teds_provision.client import ApiError
from teds_provision.ncap.settings import own_source
from teds_provision.station import station as base_station
from teds_provision.station.store.schema import SCHEMA_VERSION
from teds_provision.station.store.store import Store
from tests.bench import make_station
from tests.cli.shell import clean_environment
from tests.e2e.desk import ANGLE, Desk, Node, Station, limited
from tests.ncap.service import Service, verdict, verified, virtual
from tests.pace import best_of, succeeds, until

pytestmark = pytest.mark.link
LONG = ("--dead-man", 10_000)  # so that a machine that stands still for a while ends nothing
CALIBRATION = "# date: 2026-10-01\nraw,value [degree]\n0,0\n65535,359.9\n"


class Lab:
    """A station with an angle sensor on its bus, and its daemon, which tests start and end."""

    def __init__(self, desk: Desk) -> None:
        self.desk, self.service = desk, Service(desk, desk.station())
        folder = desk.folder / "angle"
        words = ["--profile", ANGLE, "--name", "angle", "--uuid", desk.new_uuid().hex()]
        made = desk.start("--json", "node", "create", folder, *words).end()
        self.node = Node(desk, folder, made.json["uuid"])
        self.power()
        calibration = desk.folder / "angle.csv"
        calibration.write_text(CALIBRATION)
        words = ["--profile", ANGLE, "--calibration", calibration, "--name", "angle", "--yes", *desk.links.over("can")]
        assert self.service.station.ask("provision", *words)["verdict"] == "authentic"

    def power(self) -> Node:
        return self.node.start("--source", "ramp:2", nfc=False, can=True)

    def measure(self, **more: Any) -> str:
        with self.service.client() as asked:
            verified(self.service, self.node.uuid)
            made = asked.request("POST", "/measurements", {"uuids": [self.node.uuid], "rate": 50, **more})
            self.flows()
            return str(made["id"])

    def state(self) -> dict[str, Any]:
        with self.service.client() as asked:
            return asked.node(self.node.uuid)

    def flows(self) -> dict[str, Any]:
        """Wait for a value that is not older than a second."""

        def fresh() -> Any:
            node = self.state()
            last = node["channels"][0]["last"] if node["channels"] else None
            return node if last and last["age"] < 1 else None

        return dict(until(fresh, "no value comes"))

    def tidy(self) -> None:
        """After a test: nothing runs, nothing is kept, the node is there."""
        running = self.service.process
        if running is not None and running.process.poll() is None:
            self.service.kill()
        self.service.process = None
        with base_station.Station.inspect(self.service.station.home) as store:
            for kept in store.measurements.all():
                store.measurements.forget(kept.id)
        if self.node.process is None or self.node.process.process.poll() is not None:
            self.power()


@pytest.fixture(scope="module")
def one_lab(tmp_path_factory: pytest.TempPathFactory, prepared: Path) -> Iterator[Lab]:
    desk = Desk(tmp_path_factory.mktemp("survives"), prepared)
    try:
        yield Lab(desk)
    finally:
        desk.clear()


@pytest.fixture
def lab(one_lab: Lab) -> Iterator[Lab]:
    yield one_lab
    one_lab.tidy()


def test_one_daemon_in_a_home_and_without_one_no_answer(lab: Lab) -> None:
    station = lab.service.station
    assert station.refuses("ncap", "open", code=5)["hint"].endswith("ncap run")
    lab.service.start()
    assert "already running" in station.refuses("ncap", "run", code=7)["message"]
    lab.service.end()
    assert not (station.home / "ncap.sock").exists()
    lab.service.start()
    lab.service.kill()
    station.refuses("ncap", "status", code=5)
    lab.service.start().end()


def test_a_client_that_is_kept_open_changes_something_after_a_restart_of_the_daemon(lab: Lab) -> None:
    """The first change after half a minute of silence failed as well: the daemon ends connections that say nothing."""
    service = lab.service.start()
    with client.connect(home=service.station.home) as asked:
        assert asked.status()["detection"] == "whitelist"
        service.end()
        service.start()
        assert asked.set_detection("transparent") == "transparent"
    service.end()


def test_a_terminal_that_is_closed_ends_the_daemon_in_order(lab: Lab) -> None:
    running = lab.service.process = lab.service.station.start("--json", "ncap", "run")
    running.wait_for_lines(1)
    for _ in range(2):  # the kernel's, and the shell's
        running.signal(signal.SIGHUP)
    assert running.end().code == 0
    assert not (lab.service.station.home / "ncap.sock").exists()


def test_without_http_the_socket_alone_is_served(lab: Lab) -> None:
    running = lab.service.process = lab.service.station.start("--json", "ncap", "run")
    [ready, *_] = running.wait_for_lines(1)
    assert (ready["url"], ready["api"]) == (None, f"unix:{lab.service.station.home / 'ncap.sock'}")
    assert lab.service.station.ask("ncap", "status")["url"] is None
    assert "--http" in lab.service.station.refuses("ncap", "open", code=2)["hint"]


def test_it_ends_in_order_and_the_claims_are_released(lab: Lab) -> None:
    lab.service.start()
    lab.measure(sinks=["run.csv"])
    mode = lab.service.station.ask("mode", lab.node.uuid, *lab.desk.links.over("can"))
    assert mode["mode"] == "measurement"
    lab.service.end()
    mode = lab.service.station.ask("mode", lab.node.uuid, *lab.desk.links.over("can"))
    assert mode["mode"] == "configuration"
    assert all(not channel["claimant"] for channel in mode["channels"])


def recorded(file: Path) -> list[float]:
    """Unix time of each row that is whole."""
    lines = [line for line in file.read_text().splitlines(keepends=True) if not line.startswith("#")]
    rows = [line.split(",") for line in lines[1:] if line.endswith("\n")]
    return [datetime.fromisoformat(row[0]).timestamp() if "T" in row[0] else float(row[0]) for row in rows]


@pytest.mark.realtime
def test_kill_loses_a_fifth_of_a_second_at_most_and_a_start_carries_on(lab: Lab) -> None:
    lab.service.start()
    measurement = lab.measure(sinks=["cut.csv"])
    parts = lab.service.station.home / "recordings"

    def cut() -> float:
        """Return seconds from the last row that was kept to the death of the daemon; then it is started again."""
        time.sleep(1.0)
        file = max(parts.glob("cut*.csv"), key=lambda part: part.stat().st_mtime_ns)
        killed = time.time()
        lab.service.kill()
        kept = recorded(file)
        lab.service.start()
        lab.flows()
        assert recorded(file) == kept, "a recording is never written over: the next part has a name of its own"
        return killed - kept[-1]

    # What is on its way takes 20 ms to be gathered and 40 ms to be measured; the rest may be lost.
    best_of(5, 0.2 + 0.1, cut, because="the 0.1 s hold a chain of three threads and two processes")
    with lab.service.client() as asked:
        [entry] = asked.request("GET", "/measurements")["measurements"]
    assert (entry["id"], entry["rate"]) == (measurement, 50)
    assert all(Path(part) != parts / "cut.csv" for part in entry["files"])
    lab.service.end()


def test_a_node_that_restarts_is_measured_on(lab: Lab) -> None:
    lab.service.start()
    lab.measure()
    lab.node.kill()
    until(lambda: lab.state()["measuring"]["state"] == "lost")
    assert lab.state()["problem"]["message"]
    lab.power()
    until(lambda: lab.state()["measuring"]["state"] == "running", lab.state)
    lab.flows()
    assert lab.state()["problem"] is None
    assert lab.service.process is not None
    lab.service.process.read(0.1)
    states = [json.loads(line) for line in lab.service.process.out.splitlines()]
    states_seen = [
        line["state"] for line in states if line.get("event") == "node" and line.get("uuid") == lab.node.uuid
    ]
    assert "lost" in states_seen
    assert states_seen[-1] in ("running", "came")
    lab.service.end()


def test_a_node_that_leaves_is_shown_as_away_and_comes_back_verified(lab: Lab) -> None:
    lab.service.start()
    assert verdict(verified(lab.service, lab.node.uuid)) == "authentic"
    lab.node.kill()
    until(lambda: not lab.state()["present"])
    seen = local_time(lab.state()["last_seen"])
    assert f"  away, last seen {seen}  authentic" in lab.service.station.run("ncap", "status").out
    lab.power()
    until(lambda: lab.state()["present"])
    assert verdict(verified(lab.service, lab.node.uuid)) == "authentic"
    lab.service.end()


def test_a_link_that_is_missing_is_tried_again_and_delays_no_other(lab: Lab) -> None:
    lab.service.start("--can", "socketcan:nowhere", "--nfc", "tty:nowhere:pn532")
    verified(lab.service, lab.node.uuid)
    links = {link["place"].partition("?")[0]: link for link in lab.service.station.ask("ncap", "status")["links"]}
    for place in ("can:socketcan:nowhere", "nfc:tty:nowhere:pn532"):
        assert links[place]["state"] == "down"
        assert links[place]["problem"]["hint"], place
    lab.service.end()


def test_the_command_line_works_beside_it_at_the_same_node(lab: Lab) -> None:
    station, over = lab.service.station, lab.desk.links.over("can")
    lab.service.start()
    lab.measure()
    assert lab.service.process is not None
    process = lab.service.process

    def lost() -> int:
        """Return how often its session was ended under three commands; a machine that stands still may end it, once."""
        process.read(0.1)
        position = process.out.rfind("\n") + 1
        before = lab.flows()["measuring"]
        assert station.ask("verify", lab.node.uuid, *over)["verdict"] == "authentic"
        assert station.ask("read", lab.node.uuid, *over)
        assert station.ask("sample", lab.node.uuid, *over)["samples"][0]["valid"] is True
        until(lambda: (node := lab.flows()["measuring"])["state"] == "running" and node["samples"] > before["samples"])
        while process.read(0.1):
            pass
        lines = [json.loads(line) for line in process.out[position : process.out.rfind("\n") + 1].splitlines()]
        return sum(line.get("event") == "node" and line["state"] == "lost" for line in lines)

    succeeds(3, lost)
    lab.service.end()


def test_a_full_disk_ends_the_recording_with_an_error_that_everyone_sees(lab: Lab) -> None:
    station = lab.service.station
    assert lab.service.process is None
    lab.service.start(program=limited(400_000))
    lab.measure(sinks=["full.csv"], rate=2000)
    with lab.service.client() as asked:
        sink = until(lambda: next((sink for sink in asked.status()["sinks"] if sink["state"] == "failed"), None))
        assert "full.csv" in sink["error"]
        assert sink["hint"]
        assert sink["dropped"] == 0, "a recorder drops nothing: it ends"
    assert lab.flows()["measuring"]["state"] == "running", "the measurement goes on"
    assert lab.service.process is not None
    lab.service.process.wait_for('"event": "sink"')
    rows = recorded(station.home / "recordings" / "full.csv")
    assert rows == sorted(rows)


def test_an_actuator_is_safe_when_the_daemon_ends(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    uuid = virtual(service)
    with service.client() as asked:
        asked.request("PUT", f"/nodes/{uuid}/channels/1", {"value": 0.05, "hold": 30})
        service.end()
    entries = service.station.ask("log", "--act", "set")["entries"]
    assert (entries[-1]["outcome"], entries[-1]["detail"]["safe"]) == ("done", True)


_OTHER_MOMENTS = pytest.mark.nightly(
    "tests/ncap/test_survives.py::test_no_virtual_node_outlives_a_daemon_that_was_killed[0.0],"
    " tests/ncap/test_survives.py::test_no_virtual_node_outlives_a_daemon_that_was_killed[0.2]: as it starts, and after"
)


@pytest.mark.parametrize(
    "moment", [0.0, pytest.param(0.05, marks=_OTHER_MOMENTS), 0.2, pytest.param(0.5, marks=_OTHER_MOMENTS)]
)
def test_no_virtual_node_outlives_a_daemon_that_was_killed(desk: Desk, moment: float) -> None:
    """Also one that was just being started: a browser's page would show a node that nobody looks after."""
    service = Service(desk, desk.station()).start()
    with service.client() as asked:
        asked.request("POST", "/virtual", {"profile": "gripper", "name": "hand", "source": "sine:3"})
    folder = f"{service.station.home}/virtual/"

    def runs() -> bool:
        return any(folder in words for words in _command_lines())

    until(runs, "no virtual node is started")
    time.sleep(moment)
    service.kill()
    until(lambda: not runs(), "a virtual node runs on")


def _command_lines() -> Iterator[str]:
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            yield path.read_bytes().replace(b"\0", b" ").decode(errors="replace")


def test_an_actuator_that_another_command_holds_is_423(desk: Desk) -> None:
    service = Service(desk, desk.station()).start()
    uuid = virtual(service)
    with service.client() as asked:
        place = next(link["place"] for link in asked.status()["links"] if link["virtual"])
        bus = place.removeprefix("can:").partition("&source=")[0]
        held = service.station.start("--json", "set", uuid, 1, 0.05, *LONG, "--via", "can", "--can", bus)
        held.wait_for('"applied"')
        with pytest.raises(ApiError) as refused:
            asked.set(uuid, 1, 0.02)
        assert (refused.value.status, refused.value.code) == (423, "node-refused")
        held.signal(signal.SIGTERM)
        assert held.end().code == 0
        assert asked.set(uuid, 1, 0.02)["applied"]["value"] == pytest.approx(0.02, abs=1e-4)
        assert asked.release_actuator(uuid, 1) is True
    service.end()


def test_factory_nodes_of_a_bus_are_added_if_requested(desk: Desk) -> None:
    node = desk.node("new", called="new").start(nfc=False, can=True)
    service = Service(desk, desk.station()).start("--detection", "transparent", "--adopt")
    with service.client() as asked:
        until(lambda: any(node["whitelisted"] for node in asked.nodes()))
        found = verified(service, node.uuid)
        assert (found["epoch"], found["whitelisted"]) == (1, True)
    assert service.station.keys(node.uuid) == [("active", 1)]
    service.end()


def test_with_record_every_measurement_has_a_file(lab: Lab) -> None:
    folder = lab.desk.folder / "recorded"
    lab.service.start("--record", folder)
    lab.measure()
    lab.service.end()
    [file] = folder.glob("*.csv")
    assert len(recorded(file)) > 5


def another_home(folder: Path, first: Path) -> Path:
    """Return a station whose daemon has another address on a bus; one of six has the same."""
    with Store.open(first) as store:
        taken = own_source(store.id)
    for number in range(20):
        with closing(make_station(folder / str(number), "second")) as station:
            if own_source(station.id) != taken:
                return station.home
    raise AssertionError("twenty stations of one address")


def test_two_daemons_on_one_bus_measure_their_own_nodes(lab: Lab, prepared: Path, tmp_path: Path) -> None:
    """Another station of another home: an address of its own, no session of the first is ended."""
    lab.service.start()
    lab.measure()
    other = Desk(tmp_path, prepared)
    other.links = lab.desk.links
    try:
        home = another_home(tmp_path, lab.service.station.home)
        second = Service(other, Station(other, home)).start("--detection", "transparent")
        with second.client() as asked, lab.service.client() as own:
            until(lambda: [node["uuid"] for node in asked.nodes() if node["present"]] == [lab.node.uuid])
            until(lambda: asked.node(lab.node.uuid)["verified"] or asked.node(lab.node.uuid)["problem"])
            assert lab.flows()["measuring"]["state"] == "running"
            assert [current.status()["links"][0]["notice"] for current in (asked, own)] == [None, None]
        second.end()
    finally:
        other.clear()
    lab.service.end()


def test_systemd_hears_when_it_is_ready_that_it_lives_and_when_it_ends(desk: Desk) -> None:
    where, heard = desk.folder / "notify", list[bytes]()
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(str(where))
        systemd.settimeout(60)

        def listen() -> None:  # all the time: a full socket blocks its writer
            while b"STOPPING=1" not in heard:
                heard.append(systemd.recv(100))

        listening = threading.Thread(target=listen, daemon=True)
        listening.start()
        environment = clean_environment() | {"NOTIFY_SOCKET": str(where), "WATCHDOG_USEC": "200000"}
        service = Service(desk, desk.station()).start(environment=environment)
        until(lambda: {b"READY=1", b"WATCHDOG=1"} <= set(heard), heard)
        assert b"STOPPING=1" not in heard
        service.end()
        listening.join(60)
    assert heard[-1] == b"STOPPING=1"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed")
def test_the_unit_that_is_shipped_is_sound_and_hardened(tmp_path: Path) -> None:
    unit = Path(__file__).parent.parent.parent / "service" / "teds-provision-ncap.service"
    if not unit.exists():
        pytest.skip("the unit is not part of this installation")
    copy = tmp_path / unit.name
    copy.write_text(unit.read_text().replace("/usr/bin/teds-provision", "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    judged = subprocess.run(
        ["systemd-analyze", "security", "--offline=true", "--threshold=20", str(copy)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert judged.returncode == 0, judged.stdout.splitlines()[-1]


def test_a_store_that_a_newer_version_brought_forward_ends_the_service_in_words(lab: Lab) -> None:
    """Its eye on the store died with "no such column", while it went on to call nodes authentic."""
    lab.service.start()
    lab.measure()
    home, process = lab.service.station.home, lab.service.process
    assert process is not None
    with closing(sqlite3.connect(home / "store.sqlite3", isolation_level=None)) as newer:
        newer.execute("BEGIN")  # as a newer version does it: no reader sees one change without the other
        newer.execute("ALTER TABLE nodes RENAME COLUMN name TO called")
        newer.execute(f"PRAGMA user_version={SCHEMA_VERSION + 1}")
        newer.execute("COMMIT")
    outcome = process.end()
    assert outcome.code == 7, outcome
    *events, last = [json.loads(line) for line in outcome.out.splitlines()]
    assert (last["error"]["code"], "newer version" in last["error"]["hint"]) == ("newer-store", True)
    [event] = [event for event in events if event.get("event") == "store" and event["state"] == "newer"]
    assert f"has schema {SCHEMA_VERSION + 1}" in event["why"]
    assert "Traceback" not in outcome.err, outcome.err
    assert "no such column" not in outcome.out + outcome.err
    with closing(sqlite3.connect(home / "store.sqlite3", isolation_level=None)) as newer:
        assert newer.execute("SELECT count(*) FROM measurements").fetchone() == (1,), "it goes on with the newer one"
        newer.execute("ALTER TABLE nodes RENAME COLUMN called TO name")  # for the next test
        newer.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
