"""``ncap run --require-firmware``: a node with outdated firmware is not measured, and is once it was updated."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.desk import ANGLE, Desk
from tests.firmware_images import make_key, sign
from tests.ncap.service import Service
from tests.pace import until

pytestmark = pytest.mark.link


def test_outdated_firmware_is_not_measured_until_it_is_updated(desk: Desk, tmp_path: Path) -> None:
    key = make_key(tmp_path / "owner.pem")
    old, new = (sign(tmp_path, version, key, counter=1) for version in ("1.0.0", "1.1.0"))
    profile, over = tmp_path / "angle.toml", desk.links.over("can")
    demand = f'extends = "{ANGLE}"\ntitle = "Angle"\n[channel.1.calibration]\nrequired = false\n[firmware]\nminimum = '
    profile.write_text(demand + '"1.0.0"\n')
    station = desk.station()
    node = desk.node(type_=ANGLE, firmware=(old, key)).start("--source", "ramp:5", nfc=False, can=True)
    assert station.provision("can", "--profile", profile)["verdict"] == "authentic"
    profile.write_text(demand + '"1.1.0"\n')
    (known,) = station.ask("nodes", node.uuid)["nodes"]
    assert known["firmware"]["state"] == "outdated"
    measured = station.run("--json", "measure", node.uuid, "--require-firmware", "--duration", "1", *over)
    assert measured.code == 6
    assert json.loads(measured.out.splitlines()[-1])["error"]["code"] == "firmware"

    service = Service(desk, station, ("--require-firmware", "--measure", "all", "--rate", 20)).start()
    service.process.wait_for(f"The firmware of node {node.uuid} is outdated")  # type: ignore[union-attr]
    ask = service.client()
    assert ask.node(node.uuid)["firmware"]["state"] == "outdated"
    updated = station.run("--json", "update", node.uuid, new, "--yes", *over)
    assert updated.code == 0, updated
    until(lambda: ask.node(node.uuid)["measurement"], lambda: ask.node(node.uuid))
    until(lambda: ask.node(node.uuid)["firmware"]["state"] == "good", lambda: ask.node(node.uuid)["firmware"])

    until(lambda: (ask.node(node.uuid).get("measuring") or {}).get("state") == "running", ask.measurements)
    planned = station.run("--json", "update", node.uuid, old, "--allow-downgrade", "--dry-run", *over)
    assert planned.code == 0, planned
    assert len(planned.json["interrupts"]) == 1, "the service releases the node for an update"
    service.end()
