"""The last part of the demo: the station that now holds the key measures two nodes and moves a gripper."""

from __future__ import annotations

import csv
import threading
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from teds_provision.demo.desk import Demo, provision_over
from teds_provision.errors import LinkFailure
from teds_provision.lazy import late
from teds_provision.links import can
from teds_provision.station.station import Station
from teds_provision.steps.build_order import BuildOrder
from teds_provision.talk.meeting import meet

if TYPE_CHECKING:
    from teds_provision.measure import blocks, finding, held_actuator, runner, sinks, trusting, wish
else:  # numpy and what measuring needs are loaded when the demo gets there
    blocks, finding, held_actuator, runner, sinks, trusting, wish = (
        late(f"teds_provision.measure.{name}")
        for name in ("blocks", "finding", "held_actuator", "runner", "sinks", "trusting", "wish")
    )

GRIPPER = "gripper"
RATE = 100.0
SECONDS = 1.0
OPENING = 40.0
_HALF_WAY = 0.5


def calibrations(folder: Path) -> dict[str, Path]:
    """Calibration files of today for both nodes: straight lines over the whole raw range."""
    today = datetime.now(UTC).date().isoformat()
    angle = folder / "angle.csv"
    angle.write_text(f"# date: {today}\nraw,value [degree]\n0,0\n65535,360\n")
    gripper = folder / "gripper.toml"
    ranges = {1: ("mm", 110), 2: ("mm", 110), 3: ("N", 140)}
    gripper.write_text(
        "\n".join(
            f'[[calibration]]\nchannel = {channel}\ndate = {today}\nunit = "{unit}"\n'
            f"points = [[0, 0], [4095, {high}]]\n"
            for channel, (unit, high) in ranges.items()
        )
    )
    return {"angle": angle, GRIPPER: gripper}


def provision_gripper(demo: Demo, station: Station, uuid: bytes, calibration: Path) -> None:
    """The same steps for a node without NFC, over the bus that it hangs on."""
    provision_over(demo, station, "can", uuid, BuildOrder(GRIPPER, calibration=calibration, name="hand"))


def calibrate_sensor(demo: Demo, station: Station, calibration: Path) -> None:
    """A new datasheet for the sensor, with its calibration; signed and written by its new owner."""
    order = BuildOrder("magnetic-angular-position-sensor", calibration=calibration, name="crane slew angle")
    provision_over(demo, station, "can", demo.uuid, order)


def measure_group(demo: Demo, station: Station, uuids: tuple[bytes, ...]) -> None:
    """Both nodes at once: sessions, datasheets verified, claims, streams, calibrated values in a file."""
    file = demo.folder / "run.csv"
    station.groups.create("robot", list(uuids))
    with demo.steps.step("measure") as step:
        port: Any = can.port.open_port(demo.can)
        try:
            sink = sinks.open_sink(str(file))
            facts = blocks.StationFacts(station.name, group="robot", started=time.time())
            asked = wish.Wish(rate=RATE, timeout=15.0)
            with finding.buses.Buses([port]) as buses:
                ended = runner.Measurement(station, buses, uuids, asked, [sink], facts).run(threading.Event(), SECONDS)
        finally:
            port.close()
        if ended.error is not None:
            raise ended.error
        streams = [stream for node in ended.nodes for stream in node["streams"]]
        values, lost = sum(stream["samples"] for stream in streams), sum(stream["lost"] for stream in streams)
        step.detail = f"group robot, {len(uuids)} nodes: {values} values, {lost} lost; last {_last_row(file)}"


def _last_row(file: Path) -> str:
    """The newest calibrated value of each column that has a unit, as people read it."""
    with file.open(encoding="utf-8", newline="") as lines:
        rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    newest = {
        name: next((row[place] for row in reversed(rows[1:]) if row[place]), "none")
        for place, name in enumerate(rows[0])
        if "[" in name
    }
    return ", ".join(_told(name, value) for name, value in newest.items())


def _told(column: str, value: str) -> str:
    """``hand/opening [m]`` and ``0.04`` as ``opening 0.04 m``."""
    name, _, unit = column.rpartition("/")[2].partition(" [")
    return f"{name} {float(value):.4g} {unit.rstrip(']')}" if value != "none" else f"{name} none"


def move_gripper(demo: Demo, station: Station, uuid: bytes) -> None:
    """Operate the gripper within its limits for a moment, let go, and see that it is safe."""
    with demo.steps.step("set") as step:
        with meet(station, demo.over("can"), uuid, demo.reporter) as node:
            trusted = trusting.open_trusted(station, node)
            with held_actuator.HeldActuator(trusted, 1, unit="mm") as hand:
                applied = hand.apply(OPENING)
                time.sleep(min(hand.pause, _HALF_WAY))
                hand.apply(OPENING)
            if not hand.safe:
                raise LinkFailure("The demo's gripper is not in its safe state.")
        step.detail = f"hand: opening {applied.value:.4g} {applied.unit}, then let go: safe state"
