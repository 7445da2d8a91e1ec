"""Tap first, air after; whole runs over the air, cut in the middle of every step; the program and a node by command."""

from __future__ import annotations

import json
import signal
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest

from teds_provision.links import LinkSettings, Notice
from teds_provision.links.hints import BleAddress
from teds_provision.node import node_template
from teds_provision.node.virtual import VirtualNode
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.station.station import Station as OpenStation
from tests.bench import make_station, on_reader
from tests.e2e.desk import Desk, Station, results
from tests.firmware_images import make_key, sign
from tests.pace import succeeds, until
from tests.places import free_tcp_port

from .conftest import ANGLE
from .radio import Radio, needs_dbus

pytestmark = [pytest.mark.link, needs_dbus]
Air = Callable[..., Radio]
ENOUGH = 50  # messages, and so at least as many samples


def tapped_once(station: OpenStation, folder: Path) -> None:
    """Provision the node in ``folder`` at a tap, so that it has a key of ``station``."""
    node_template.create(folder, profile=ANGLE)
    node = VirtualNode(folder, exclusive=True)
    with Conversation(on_reader(node), notice=lambda _notice: None) as there:
        provision(station, there, BuildOrder(profile=ANGLE), operator=AcceptingOperator(), reporter=SilentReporter())
    node.flash_file.release()


class CutsAt(SilentReporter):
    """Cuts the connection in the middle of a step, when it has begun."""

    def __init__(self, radio: Radio, step: str, pieces: int) -> None:
        self._radio, self._step, self._pieces = radio, step, pieces
        self.notices: list[Notice] = []
        self.done: list[str] = []

    def started(self, step: str) -> None:
        if step == self._step:
            self._radio.do("cut", 0, self._pieces)

    def finished(self, step: StepResult) -> None:
        self.done.append(step.name)

    def notice(self, notice: Notice) -> None:
        if notice.kind == "retry":
            self.notices.append(notice)


def over_the_air(station: OpenStation, reporter: SilentReporter, order: BuildOrder) -> ProvisionResult:
    with meet(station, LinkSettings(via="ble", timeout=20), None, reporter) as node:
        return provision(station, node, order, operator=AcceptingOperator(), reporter=reporter)


@pytest.mark.nightly(
    "tests/links/ble/test_port.py::test_a_request_whose_connection_is_cut_is_repeated_over_a_new_one, "
    "tests/links/ble/test_port.py::test_an_order_whose_connection_is_cut_is_given_up, "
    "tests/provisioning/test_provision.py::test_cut_at_every_message_the_same_command_carries_on"
)
def test_a_cut_in_the_middle_of_every_step_does_no_harm(station: OpenStation, air: Air, tmp_path: Path) -> None:
    tapped_once(station, tmp_path / "node")
    radio = air([tmp_path / "node"], manners={"mtu": 23})
    cut: set[str] = set()
    for number, (step, pieces) in enumerate(
        [("identify", 2), ("agree", 1), ("agree", 7), ("build", 3), ("write", 1), ("write", 12), ("verify", 5)]
    ):
        reporter = CutsAt(radio, step, pieces)
        done = over_the_air(station, reporter, BuildOrder(profile=ANGLE, name=f"angle-{number}"))
        assert done.verified.verdict == "authentic", step
        assert reporter.done == ["identify", "whitelist", "agree", "build", "sign", "write", "verify", "check"]
        if reporter.notices:
            cut.add(step)
    assert cut == {"identify", "agree", "build", "write", "verify"}


# -- by command --------------------------------------------------------------------------------------------------------


@pytest.fixture
def desk(tmp_path: Path) -> Iterator[Desk]:
    prepared = tmp_path / "prepared"
    make_station(prepared / "bench", "bench").close()
    desk = Desk(tmp_path, prepared)
    yield desk
    desk.clear()


@pytest.fixture
def bench(desk: Desk) -> Station:
    return desk.station()


def test_agreed_at_the_reader_and_written_over_the_air(desk: Desk, bench: Station, air: Air) -> None:
    hci = free_tcp_port()
    radio = air([], hci=[hci])
    node = desk.node().start("--ble", f"tcp-client:127.0.0.1:{hci}")
    trace, both = desk.folder / "run.trace", ["--nfc", desk.links.nfc, "--ble", "auto"]
    done = bench.ask("provision", "--profile", ANGLE, "--yes", *both, "--trace", trace)
    assert done["verdict"] == "authentic"
    assert radio.do("counts")["connects"] == 1
    lines = [json.loads(line) for line in trace.read_text().splitlines()]
    links = {(line["command"].split(" ")[0], line["link"]) for line in lines if line.get("layer") == "message"}
    assert {("Request", "nfc"), ("Write", "ble"), ("Update", "ble")} <= links
    assert ("Write", "nfc") not in links
    assert ("Request", "ble") not in links
    # while it is carried away: the reader is not needed any more
    again = bench.ask("provision", "--profile", ANGLE, "--yes", "--via", "ble")
    ended = results(again)
    assert ended.pop("check") == "skipped"  # it does not measure: its hardware is not asked
    assert set(ended.values()) == {"done", "nothing to do"}
    assert ended["write"] == "nothing to do"
    assert bench.ask("verify", node.uuid, *both)["verdict"] == "authentic"
    shown = bench.ask("identify", "--nfc", desk.links.nfc)
    address = bytes.fromhex(json.loads((node.folder / "ble.json").read_text())["address"])
    assert shown["ble"] == BleAddress(address, random=True).text


def test_a_node_is_neither_agreed_with_nor_pinned_over_the_air(desk: Desk, bench: Station, air: Air) -> None:
    hci = free_tcp_port()
    air([], hci=[hci])
    node = desk.node().start("--ble", f"tcp-client:127.0.0.1:{hci}")
    bench.ask("identify", "--nfc", desk.links.nfc)  # a tap: now it advertises for a minute
    found = bench.ask("identify", "--add", "--via", "ble")
    assert found["uuid"] == node.uuid
    (entry,) = bench.ask("whitelist", "list")["whitelist"]
    assert entry["fingerprint"] is None
    assert entry["assurance"] == "uuid"
    refused = bench.refuses("provision", "--profile", ANGLE, "--yes", "--via", "ble", code=6)
    assert "tap" in (refused["message"] + refused["hint"]).lower()
    assert node.flash["key"] is None


def test_two_nodes_are_measured_over_the_air(desk: Desk, air: Air) -> None:
    """Streams by notifications, each connection kept; one is cut in between, and comes back by itself."""
    home = desk.folder / "home"
    station = make_station(home)
    for name in ("left", "right"):
        tapped_once(station, desk.folder / name)
    station.close()
    radio = air([desk.folder / "left", desk.folder / "right"])
    bench = Station(desk, home)
    uuids = [json.loads((desk.folder / name / "flash.json").read_text())["flash"]["uuid"] for name in ("left", "right")]

    def late() -> int:
        """Messages that were too late, if more than a tenth: two processes carry each, a busy machine holds some up."""
        running = bench.start("--json", "measure", *uuids, "--ble", "auto", "--rate", "100")
        running.wait_for(f'"event":"data","uuid":"{uuids[0]}"')
        running.wait_for(f'"event":"data","uuid":"{uuids[1]}"')
        assert radio.do("counts")["held"] == 2
        radio.do("drop", 0)
        running.wait_for('"state":"lost"')
        lost = len(running.out)

        def has_come_back(uuid: str) -> bool:
            running.read(0.1)
            return running.out[lost:].count(f'"event":"data","uuid":"{uuid}"') > ENOUGH

        for uuid in uuids:  # each by itself: the one that was cut comes back later, the other one's do not count for it
            until(partial(has_come_back, uuid))
        running.signal(signal.SIGTERM)
        done = running.end()
        assert done.code == 0, done
        lines = [json.loads(line) for line in done.out.splitlines()]
        streams = [stream for node in lines[-1]["nodes"] for stream in node["streams"]]
        assert all(stream["samples"] > ENOUGH and stream["bad"] == 0 for stream in streams), streams
        states = [line["state"] for line in lines if line["event"] == "status" and line["uuid"] == uuids[0]]
        assert "lost" in states
        assert "running" in states[states.index("lost") :]
        late = sum(stream["late"] for stream in streams)
        return late if late > sum(stream["messages"] for stream in streams) / 10 else 0

    succeeds(4, late, because="two nodes over a radio in software, each a process of its own")


def test_no_trigger_goes_over_the_air(desk: Desk, bench: Station) -> None:
    refused = bench.refuses("measure", "00" * 10, "--ble", "auto", "--trigger", code=2)
    assert "CAN bus" in refused["message"]


@pytest.mark.nightly(
    "tests/firmware/test_ble.py::test_it_is_checked_written_verified_and_measured_over_the_air; the rules on the "
    "Python node: tests/check/test_node_check.py::test_the_reference_node_keeps_every_rule"
)
def test_node_check_and_mode_work_over_the_air(desk: Desk, air: Air) -> None:
    home = desk.folder / "home"
    station = make_station(home)
    tapped_once(station, desk.folder / "left")
    station.close()
    air([desk.folder / "left"])
    bench = Station(desk, home)
    done = bench.ask("node", "check", "--via", "ble")
    assert done["failed"] == 0, [check for check in done["checks"] if check["result"] == "failed"]
    passed = {check["rule"] for check in done["checks"] if check["result"] == "passed"}
    assert {"repetition", "sealed-counter", "open-once"} <= passed
    assert bench.ask("mode", done["uuid"], "--ble", "auto")["uuid"] == done["uuid"]


def test_new_firmware_goes_over_the_air(desk: Desk, bench: Station, air: Air) -> None:
    hci = free_tcp_port()
    air([], hci=[hci])
    key = make_key(desk.folder / "owner.pem")
    old, new = sign(desk.folder, "1.0.0", key), sign(desk.folder, "1.1.0", key)
    node = desk.node(firmware=(old, key)).start("--ble", f"tcp-client:127.0.0.1:{hci}")
    bench.provision("nfc", "--profile", ANGLE)
    before = node.octets
    done = bench.run("--json", "update", node.uuid, new, "--yes", "--via", "ble")
    assert done.code == 0, done
    line = json.loads(done.out.splitlines()[0])
    assert (line["from"], line["to"], line["result"]) == ("1.0.0", "1.1.0", "updated")
    assert node.octets == before
