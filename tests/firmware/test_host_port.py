"""The node in C under the station's commands, over real frames."""

from __future__ import annotations

import itertools
import re
import signal
import socket

import pytest

from teds_provision.protocol.announce import default_can_address
from tests.e2e.desk import ANGLE, Desk, Station, results
from tests.firmware import builds
from tests.firmware.conftest import CNode
from tests.handover.desk import Pair
from tests.links.can.hub import Hub
from tests.pace import until

pytestmark = pytest.mark.system

OF_A_BUS = {
    "can-flow-control", "can-busy", "can-form", "keyed-untapped", "confirm-other-link", "confirm-beside",
    "two-sessions", "stranger-ends-nothing", "repetition-everyone", "repetition-two", "staging-shared", "session-bound",
    "can-other-address", "can-functional", "can-lengths", "can-sequence", "can-flow-obeyed", "can-announce",
    "can-pressed",
    "stream-messages", "drive-replay", "trigger-token",
}  # fmt: skip
"""What a tag alone cannot show: no second station can ask, and there are no frames of CAN."""
OF_OTHER_LINKS = {"nfc-wait-time", "nfc-wtx", "confirm-elsewhere", "write-read-only"}
"""What a node with a bus alone cannot show, and this one has no TEDS that is read-only."""
WITH_AN_ACTUATOR = "1 sensor 0 2 100000\n2 actuator 0 2 1000000\n"


FD = pytest.param(
    True,
    id="fd",
    marks=pytest.mark.nightly(
        "tests/firmware/test_host_port.py::test_it_keeps_every_rule_of_the_profile[classic]; "
        "tests/firmware/test_faults.py::test_a_good_node_keeps_every_rule[measuring can]"
    ),
)


@pytest.mark.parametrize("fd", [pytest.param(False, id="classic"), FD])
def test_it_keeps_every_rule_of_the_profile(desk: Desk, station: Station, node: CNode, fd: bool) -> None:
    node.channels = node.channels if fd else WITH_AN_ACTUATOR
    node.start(*(["--fd"] if fd else []))
    links = ["--via", "can", "--can", desk.links.can + ("&fd=1" if fd else "")]
    checked = station.ask("node", "check", "--factory", "--yes", *links)
    wrong = [rule for rule in checked["checks"] if rule["result"] == "failed"]
    assert not wrong
    skipped = {rule["rule"] for rule in checked["checks"] if rule["result"] == "skipped"}
    assert skipped == OF_OTHER_LINKS | ({"drive-replay"} if fd else set())


def test_its_tag_keeps_every_rule_of_the_profile(desk: Desk, station: Station, node: CNode) -> None:
    node.start(can="", nfc=True)
    assert node.ready["links"] == ["nfc"]
    checked = station.ask("node", "check", "--factory", "--yes", *desk.links.over("nfc"))
    assert [rule for rule in checked["checks"] if rule["result"] == "failed"] == []
    skipped = {rule["rule"] for rule in checked["checks"] if rule["result"] == "skipped"}
    assert skipped == OF_A_BUS | {"nfc-wtx", "write-read-only", "address-moves", "address-back"}


def test_a_node_that_was_tapped_is_written_over_the_bus(desk: Desk, station: Station, node: CNode) -> None:
    """With an antenna it is not keyed without a tap; and a tap that is pulled leaves all that is on the bus."""
    node.start(nfc=True)
    over = desk.links.over("can")
    assert "tap" in station.refuses("provision", "-p", ANGLE, "--yes", *over, code=6)["hint"].lower()
    assert station.provision("nfc", "--profile", ANGLE)["verdict"] == "authentic"
    assert station.ask("verify", node.uuid, *over)["verdict"] == "authentic"
    assert station.ask("agree", node.uuid, "--rotate", *over)["epoch"] == 2
    node.kill()
    node.start(nfc=True)
    for via in ("nfc", "can"):
        assert station.ask("verify", node.uuid, *desk.links.over(via))["verdict"] == "authentic"


def test_it_is_provisioned_verified_rotated_and_reset(desk: Desk, station: Station, node: CNode) -> None:
    node.start()
    links = desk.links.over("can")
    done = station.provision("can", "--profile", ANGLE, "--name", "slew angle")
    assert set(results(done).values()) == {"done"}
    assert (done["uuid"], done["verdict"]) == (node.uuid, "authentic")
    assert station.ask("agree", node.uuid, "--rotate", *links)["epoch"] == 2
    assert station.ask("verify", node.uuid, *links)["verdict"] == "authentic"
    assert station.ask("reset", node.uuid, "--yes", *links)["uuid"] == node.uuid
    assert station.provision("can", "--profile", ANGLE)["verdict"] == "authentic"


def test_it_is_provisioned_over_socketcand_though_frames_are_lost_and_doubled(
    desk: Desk, station: Station, node: CNode
) -> None:
    """Every 150th frame is lost, every 30th comes twice: the station repeats, the node runs nothing twice."""
    hub = Hub()
    given, numbers = hub.send, itertools.count(1)

    def send(identifier: int, data: bytes, sender: socket.socket | None = None) -> None:
        number = next(numbers)
        if number % 150:
            given(identifier, data, sender)
        if number % 30 == 7:
            given(identifier, data, sender)

    hub.send = send  # type: ignore[method-assign]
    try:
        node.start(can=hub.spec)
        done = station.ask("provision", "--profile", ANGLE, "--yes", "--via", "can", "--can", hub.spec)
        assert done["verdict"] == "authentic"
        assert next(numbers) > 300
    finally:
        hub.close()


def test_what_it_holds_outlives_its_power(desk: Desk, station: Station, node: CNode) -> None:
    node.start()
    assert station.provision("can", "--profile", ANGLE)["verdict"] == "authentic"
    fingerprint = node.ready["fingerprint"]
    node.kill()
    node.start()
    assert node.ready["fingerprint"] == fingerprint
    assert station.ask("verify", node.uuid, *desk.links.over("can"))["verdict"] == "authentic"
    node.kill()
    node.start("--source", "ramp:1")
    assert node.process is not None
    node.process.signal(signal.SIGUSR1)  # the button
    again = station.ask("identify", *desk.links.over("can"))
    assert again["state"] == "factory"


@pytest.mark.realtime
@pytest.mark.parametrize("kind", ["periodic", "free"])
def test_its_stream_loses_nothing(desk: Desk, station: Station, node: CNode, kind: str) -> None:
    node.start("--source", "sine:2")
    links = desk.links.over("can")
    assert station.provision("can", "--profile", ANGLE)["verdict"] == "authentic"
    request = ["--rate", "500", "--duration", "2", "--kind", kind, "--test-pattern"]
    outcome = station.run("measure", node.uuid, *request, *links)
    assert outcome.code == 0, outcome
    counts = re.search(r"(\d+) values in (\d+) messages, lost (\d+), late (\d+), bad (\d+)", outcome.out + outcome.err)
    assert counts is not None, outcome
    values, messages, lost, late, bad = map(int, counts.groups())
    assert values >= 900
    assert messages >= 20
    assert (lost, late, bad) == (0, 0, 0)


def test_an_actuator_is_set_held_and_goes_safe(desk: Desk, station: Station, node: CNode) -> None:
    node.channels = "1 actuator 0 2 1000000 3\n2 sensor 0 2 1000000 0 12\n3 sensor 0 2 1000000 0 12\n"
    node.start()
    links = desk.links.over("can")
    calibration = desk.folder / "gripper.toml"
    calibration.write_text(
        "".join(
            f"[[calibration]]\nchannel = {channel}\ndate = 2026-11-01\nslope = {slope}\nintercept = 0\n"
            for channel, slope in ((1, 37.0), (2, 0.0268), (3, 0.0341))
        )
    )
    done = station.provision("can", "--profile", "gripper", "--calibration", calibration)
    assert done["verdict"] == "authentic"
    held = station.start("set", node.uuid, "1", "20", "--unit", "mm", "--dead-man", "2000", "--hold", "60", *links)
    rival = [*links[:-1], f"{links[-1]}&source=0xf2"]

    def state() -> set[str]:
        return set(station.ask("mode", node.uuid, *rival)["channels"][0]["state"])

    until(lambda: state() == {"actuator", "claimed by other"})
    held.process.kill()  # no station goes on: the dead-man runs out
    held.end()
    until(lambda: state() == {"actuator", "safe", "stopped"})


def test_its_identity_key_may_lie_in_psa_and_never_leave_it(desk: Desk, station: Station, node: CNode) -> None:
    """By Mbed TLS: a key of one use each, agreed with one-time keys; what it signs is known again after a restart."""
    node.program = builds.host_psa()
    node.start(cwd=desk.folder)
    links = desk.links.over("can")
    checked = station.ask("node", "check", "--factory", "--yes", *links)
    assert (checked["failed"], checked["skipped"]) == (0, len(OF_OTHER_LINKS | {"drive-replay"}))
    assert station.provision("can", "--profile", ANGLE)["verdict"] == "authentic"
    fingerprint = node.ready["fingerprint"]
    node.kill()
    [kept] = desk.folder.glob("*.psa_its")  # as Mbed TLS stores a key: after two headers its type, bits and usage
    usage = int.from_bytes(kept.read_bytes()[36:40], "little")
    assert usage & 0x1000, "PSA_KEY_USAGE_SIGN_HASH"
    assert not usage & ~0x1400, "and nothing beyond signing: not PSA_KEY_USAGE_EXPORT (1), COPY (2), DERIVE (0x4000)"
    node.start(cwd=desk.folder)
    assert node.ready["fingerprint"] == fingerprint
    assert station.ask("verify", node.uuid, *links)["verdict"] == "authentic"


COPY = pytest.param(
    "copy",
    marks=pytest.mark.nightly(
        "tests/firmware/test_host_port.py::test_its_keys_go_over_to_another_station[move]: to a node it is the same; "
        "tests/handover/test_copy.py::test_stations_alternate_sessions_under_one_copied_key"
    ),
)


@pytest.mark.parametrize("mode", [COPY, "move"])
def test_its_keys_go_over_to_another_station(desk: Desk, node: CNode, mode: str) -> None:
    Pair.make(desk.folder, 0).close()
    north, south = Station(desk, desk.folder / "north"), Station(desk, desk.folder / "south")
    node.start()
    links = desk.links.over("can")
    assert north.provision("can", "--profile", ANGLE)["verdict"] == "authentic"
    bundle = desk.folder / "keys.jwe"
    north.ask("export-keys", node.uuid, "--to", "south", "--mode", mode, "--output", bundle, "--yes")
    taken = south.ask("import-keys", bundle, "--yes")
    assert taken["imported"] == [node.uuid]
    assert south.ask("verify", node.uuid, *links)["verdict"] == "authentic"
    north.ask("handover", "receipt", taken["receipt"])
    assert south.ask("agree", node.uuid, "--rotate", *links)["epoch"] > 1  # a node that was moved is rotated at once
    assert south.ask("verify", node.uuid, *links)["verdict"] == "authentic"


@pytest.mark.nightly(
    "tests/firmware/test_host_port.py::test_a_node_in_c_and_one_in_python_are_measured_at_once provisions both, too"
)
def test_a_node_in_c_and_one_in_python_lie_on_one_bus(desk: Desk, station: Station, node: CNode) -> None:
    node.start()
    other = desk.node().start(nfc=False, can=True)
    for uuid in (node.uuid, other.uuid):
        links = ["--via", "can", "--can", desk.links.can]
        where = [*links[:-1], f"{links[-1]}&node={default_can_address(bytes.fromhex(uuid))}"]
        done = station.ask("provision", "--profile", ANGLE, "--yes", *where)
        assert (done["uuid"], done["verdict"]) == (uuid, "authentic")


@pytest.mark.realtime
def test_a_node_in_c_and_one_in_python_are_measured_at_once(desk: Desk, station: Station, node: CNode) -> None:
    """One run, started by one trigger frame: both clocks mark it, and neither loses a value."""
    node.start()
    other = desk.node(type_=ANGLE).start(nfc=False, can=True)
    links = desk.links.over("can")
    for uuid in (node.uuid, other.uuid):
        where = [*links[:-1], f"{links[-1]}&node={default_can_address(bytes.fromhex(uuid))}"]
        assert station.ask("provision", "--profile", ANGLE, "--yes", *where)["verdict"] == "authentic"
    file = desk.folder / "run.csv"
    request = ["--rate", "200", "--duration", "2", "--trigger", "--test-pattern", "--to", file]
    outcome = station.run("measure", node.uuid, other.uuid, *request, *links)
    assert outcome.code == 0, outcome
    counted = re.findall(
        r"(\d+) values in (\d+) messages, lost (\d+), late (\d+), bad (\d+)", outcome.out + outcome.err
    )
    assert sum(int(values) for values, *_ in counted) >= 2 * 330
    assert {tuple(map(int, rest)) for _, _, *rest in counted} == {(0, 0, 0)}
