"""Builds that leave something out, or ask for other sizes: each keeps every rule that it can show."""

from __future__ import annotations

import pytest

from teds_provision.check.rule import Stage
from teds_provision.check.run import RULES
from tests.e2e.desk import ANGLE, Desk, Station
from tests.firmware import builds
from tests.firmware.conftest import CNode

pytestmark = pytest.mark.system

OF_OTHER_LINKS = {"nfc-wait-time", "nfc-wtx", "confirm-elsewhere", "write-read-only", "drive-replay"}
OF_CHANNELS = {rule.name for rule in RULES if rule.stage == Stage.MEASURING}
BUILDS = {
    "security alone": ("-DTEDS_OPERATION=0", "-DTEDS_CAN_FD=0"),
    "the smallest": (
        "-DTEDS_MAX_MESSAGE=512",
        "-UTEDS_STAGING",
        "-DTEDS_STAGING=2048",
        "-DTEDS_STREAMS=1",
        "-DTEDS_CAN_LINES=3",
    ),
    "frames without end": ("-DTEDS_CAN_BLOCK=0",),
    "a slow controller": ("-DTEDS_CAN_BLOCK=2", "-DTEDS_CAN_STMIN=3"),
    "room for many": ("-DTEDS_SESSIONS=6", "-DTEDS_CAN_LINES=7", "-DTEDS_MAX_MESSAGE=4094", "-DTEDS_BLE=1"),
}


@pytest.mark.parametrize("what", ["security alone", "the smallest"])
def test_a_build_is_provisioned_and_verified(desk: Desk, station: Station, node: CNode, what: str) -> None:
    node.program = desk.folder / "node-of-this-build"
    builds.compile_host(node.program, None, *BUILDS[what])
    node.start()
    done = station.provision("can", "--profile", ANGLE)
    assert done["verdict"] == "authentic"
    node.kill()
    node.start()
    assert station.ask("verify", node.uuid, *desk.links.over("can"))["verdict"] == "authentic"


@pytest.mark.soak
@pytest.mark.parametrize("what", BUILDS)
def test_a_build_keeps_every_rule(desk: Desk, station: Station, node: CNode, what: str) -> None:
    node.program = desk.folder / "node-of-this-build"
    builds.compile_host(node.program, None, *BUILDS[what])
    node.start()
    checked = station.ask("node", "check", "--factory", "--yes", *desk.links.over("can"))
    assert [rule for rule in checked["checks"] if rule["result"] == "failed"] == []
    skipped = {rule["rule"] for rule in checked["checks"] if rule["result"] == "skipped"}
    assert skipped == OF_OTHER_LINKS | (OF_CHANNELS if what == "security alone" else set())
