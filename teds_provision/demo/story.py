"""The whole story on one machine: two base stations, one virtual node, NFC and CAN frames, a handover.

The node is a separate process; the stations live in this one, with throwaway homes and vaults that are deleted at the
end. Nothing leaves the machine: NFC goes over UDP on 127.0.0.1, CAN over multicast with hop limit 0.
"""

from __future__ import annotations

import csv
import json
import secrets
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

from teds_provision.errors import LinkError, NotAuthenticError, PolicyError
from teds_provision.handover.incoming import ImportResult, NodeProof, import_bundle, plan_import, prove_nodes
from teds_provision.handover.outgoing import ExportOrder, export_bundle, plan_export
from teds_provision.handover.pending import close
from teds_provision.handover.trust import Candidate, add
from teds_provision.links import LinkSettings
from teds_provision.links.can.port import open_port
from teds_provision.links.ports import free_port
from teds_provision.measure import blocks, held_actuator, request, sinks, verified_session
from teds_provision.measure import buses as buses_room
from teds_provision.measure.running import measurement
from teds_provision.protocol.keys import fingerprint
from teds_provision.provisioning.agree import agree, require_session
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.identify import identify
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import Reporter, StepResult, Steps
from teds_provision.provisioning.provision import ProvisionResult, provision
from teds_provision.provisioning.teds_read import read_image
from teds_provision.provisioning.verify import require_authentic
from teds_provision.provisioning.verify_node import judge_and_keep
from teds_provision.shapes.problem import problem_in
from teds_provision.station.station import Station, initialise
from teds_provision.station.store.records import TrustRecord
from teds_provision.vault.passphrase import THROWAWAY

# The context of the demo: its folder, its links, the node, and what one station knows of it.


@dataclass
class Demo:
    """State of the demo: its folder, stations, links and the steps so far."""

    folder: Path
    reporter: Reporter
    say: Callable[[str], None]
    nfc: str = ""
    can: str = ""
    uuid: bytes = b""
    stack: ExitStack = field(default_factory=ExitStack)

    def __post_init__(self) -> None:
        self.steps = Steps(self.reporter)
        self.nfc = f"udp:127.0.0.1:{free_port()}"
        self.can = f"udp_multicast:239.74.163.2?port={free_port()}"

    def over(self, via: str) -> LinkSettings:
        """Link options of a station in this demo."""
        return LinkSettings(via, self.nfc, self.can, timeout=15.0)


def provision_over(demo: Demo, station: Station, via: str, uuid: bytes, order: BuildOrder) -> ProvisionResult:
    """Run every step of provisioning, from one station over one link; raises unless the node ends up authentic."""
    with meet(station, demo.over(via), uuid, demo.reporter) as node:
        done = provision(station, node, order, operator=AcceptingOperator(), reporter=demo.reporter)
    require_authentic(done.verified)
    demo.steps.done += done.steps
    return done


def verify_from(demo: Demo, station: Station, what: str) -> None:
    """Verify the node from one station over CAN, in a session under its key; raises unless it is authentic."""
    with demo.steps.step(what) as step:
        with meet(station, demo.over("can"), demo.uuid, demo.reporter) as node:
            who = identify(station, node)
            held = require_session(station, node)
            verified = judge_and_keep(station, node, read_image(node), who.point).verified
        if verified.verdict != "authentic":
            raise NotAuthenticError(f"The demo's node is {verified.verdict} as seen from {station.name}.")
        step.detail = f"{station.name} finds it {verified.verdict}, key epoch {held.record.epoch}"


# The second part of the demo: the key goes to another station, first as a copy, then as a move.


def hand_over(demo: Demo, first: Station, second: Station) -> None:
    """Copy: both stations reach the node. Move: only the second does."""
    with demo.steps.step("trust") as step:
        for station, other in ((first, second), (second, first)):
            record = TrustRecord(other.name, "station", other.point, fingerprint(other.point))
            add(station, [Candidate(record, demo.folder)])
        step.detail = "each station trusts the other's key"
    _send(demo, first, second, "copy")
    verify_from(demo, second, "verify")
    verify_from(demo, first, "verify")
    _send(demo, first, second, "move")
    verify_from(demo, second, "verify")
    with demo.steps.step("refuse") as step:
        try:
            first.policy.require_whitelisted(demo.uuid)
        except PolicyError as refused:
            step.detail = refused.message
        else:
            raise LinkError("The demo's first station still uses a key that it gave away.")


def _send(demo: Demo, sender: Station, receiver: Station, mode: Literal["copy", "move"]) -> None:
    bundle = demo.folder / f"{mode}.jwe"
    with demo.steps.step("export-keys") as step:
        plan = plan_export(sender, ExportOrder((receiver.name,), (demo.uuid,), mode))
        sealed = export_bundle(sender, plan, bundle)
        step.detail = f"{mode}: {sealed.octets} octets, sealed to {receiver.fingerprint[:16]}"
    with demo.steps.step("import-keys") as step:
        planned = plan_import(receiver, bundle.read_bytes())
        taken = planned if isinstance(planned, ImportResult) else import_bundle(receiver, planned)
        outcome = prove_nodes(receiver, demo.over("can"), taken.uuids, demo.reporter)[0]
        if not isinstance(outcome, NodeProof):
            raise LinkError(f"The node was not reached after the import: {outcome.why}")
        rotated = ", key rotated, the sender is locked out" if outcome.rotated else ""
        step.detail = f"proven in a session{rotated}"
    with demo.steps.step("receipt") as step:
        close(sender, taken.receipt)
        step.detail = f"{sender.name} has {receiver.name}'s signed receipt"


GRIPPER = "gripper"
RATE = 100.0
SECONDS = 1.0
OPENING = 40.0
_HALF_WAY = 0.5


# The last part of the demo: the station that now holds the key measures two nodes and moves a gripper.


def calibrations(folder: Path) -> dict[str, Path]:
    """Write calibration files of today for both nodes: straight lines over the whole raw range. Return them by name."""
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
    """Do the same steps for a node without NFC, over its bus."""
    provision_over(demo, station, "can", uuid, BuildOrder(GRIPPER, calibration=calibration, name="hand"))


def calibrate_sensor(demo: Demo, station: Station, calibration: Path) -> None:
    """Give the sensor a new datasheet with its calibration; signed and written by its new owner."""
    order = BuildOrder("magnetic-angular-position-sensor", calibration=calibration, name="crane slew angle")
    provision_over(demo, station, "can", demo.uuid, order)


def measure_group(demo: Demo, station: Station, uuids: tuple[bytes, ...]) -> None:
    """Measure both nodes together: sessions, verified datasheets, claims, streams, calibrated values in a file."""
    file = demo.folder / "run.csv"
    station.groups.create("robot", list(uuids))
    with demo.steps.step("measure") as step:
        port: Any = open_port(demo.can)
        try:
            sink = sinks.open_sink(str(file))
            facts = blocks.StationFacts(station.name, group="robot", started=time.time())
            asked = request.MeasurementRequest(rate=RATE, timeout=15.0)
            with buses_room.Buses([port]) as buses:
                ended = measurement.Measurement(station, buses, uuids, asked, [sink], facts).run(
                    threading.Event(), SECONDS
                )
        finally:
            port.close()
        if ended.error is not None:
            raise ended.error
        streams = [stream for node in ended.nodes for stream in node["streams"]]
        values, lost = sum(stream["samples"] for stream in streams), sum(stream["lost"] for stream in streams)
        step.detail = f"group robot, {len(uuids)} nodes: {values} values, {lost} lost; last {_last_row(file)}"


def _last_row(file: Path) -> str:
    """Return the newest calibrated value of each column that has a unit, as people read it."""
    with file.open(encoding="utf-8", newline="") as lines:
        rows = list(csv.reader(line for line in lines if not line.startswith("#")))
    newest = {
        name: next((row[place] for row in reversed(rows[1:]) if row[place]), "none")
        for place, name in enumerate(rows[0])
        if "[" in name
    }
    return ", ".join(_told(name, value) for name, value in newest.items())


def _told(column: str, value: str) -> str:
    """Return a column and its value as people read it: ``hand/opening [m]`` and ``0.04`` as ``opening 0.04 m``."""
    name, _, unit = column.rpartition("/")[2].partition(" [")
    return f"{name} {float(value):.4g} {unit.rstrip(']')}" if value != "none" else f"{name} none"


def move_gripper(demo: Demo, station: Station, uuid: bytes) -> None:
    """Operate the gripper within its limits for a moment, let go, and see that it is safe."""
    with demo.steps.step("set") as step:
        with meet(station, demo.over("can"), uuid, demo.reporter) as node:
            trusted = verified_session.open_trusted(station, node, by="demo")
            with held_actuator.HeldActuator(trusted, 1, unit="mm") as hand:
                applied = hand.apply(OPENING)
                time.sleep(min(hand.pause, _HALF_WAY))
                hand.apply(OPENING)
            if not hand.safe:
                raise LinkError("The demo's gripper is not in its safe state.")
        step.detail = f"hand: opening {applied.value:.4g} {applied.unit}, then back to its safe state"


PROFILE = "magnetic-angular-position-sensor"
_START_SECONDS = 20.0
_STOP_SECONDS = 5.0


@dataclass(frozen=True)
class DemoResult:
    """The demo's steps and its verdict: that of the last verification."""

    steps: tuple[StepResult, ...]
    verdict: str
    uuid: bytes


@contextmanager
def temporary_demo(reporter: Reporter, say: Callable[[str], None], *, mode: int = 0o700) -> Iterator[Demo]:
    """Give a demo in a folder of this mode; its processes end and the folder is removed, however the block ends."""
    folder = Path(tempfile.mkdtemp(prefix="teds-provision-demo-"))
    folder.chmod(mode)
    try:
        demo = Demo(folder, reporter, say)
        with demo.stack:
            yield demo
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def run_demo(reporter: Reporter, say: Callable[[str], None]) -> DemoResult:
    """Run it; raises whatever a step raises. The folder is gone afterwards, however it ends."""
    with temporary_demo(reporter, say) as demo:
        return _run(demo)


def _run(demo: Demo) -> DemoResult:
    demo.say("Two base stations with their own keys, and a virtual sensor on a reader, in a process of its own.")
    first, second = new_station(demo, "bench"), new_station(demo, "crane")
    with demo.steps.step("start node") as step:
        demo.uuid = demo.stack.enter_context(virtual_node(demo, "node", PROFILE, "--nfc", demo.nfc))
        step.detail = f"{demo.uuid.hex()} on {demo.nfc} and {demo.can}"
    demo.say("Tap: station bench provisions the sensor over NFC.")
    done = provision_over(demo, first, "nfc", demo.uuid, BuildOrder(PROFILE))
    demo.say("The same sensor over CAN: renamed, verified, its key rotated.")
    _over_can(demo, first)
    demo.say("Handover: crane gets a copy of the key, then bench hands the sensor over for good.")
    hand_over(demo, first, second)
    demo.say(
        "Measuring: crane calibrates the sensor, provisions a gripper on the same bus, records both and moves"
        " the gripper."
    )
    _measure(demo, second)
    return DemoResult(tuple(demo.steps.done), done.verified.verdict, demo.uuid)


def _measure(demo: Demo, station: Station) -> None:
    files = calibrations(demo.folder)
    with demo.steps.step("start node") as step:
        gripper = demo.stack.enter_context(virtual_node(demo, "gripper", GRIPPER))
        step.detail = f"{gripper.hex()}, a gripper on {demo.can}"
    provision_gripper(demo, station, gripper, files[GRIPPER])
    calibrate_sensor(demo, station, files["angle"])
    measure_group(demo, station, (demo.uuid, gripper))
    move_gripper(demo, station, gripper)


def new_station(demo: Demo, name: str) -> Station:
    """Return a station with a throwaway vault, closed with the demo."""
    secret = secrets.token_hex(16)
    with demo.steps.step("init") as step:
        station, _ = initialise(
            demo.folder / name,
            name=name,
            keystore="file",
            ask=lambda prompt, confirm: secret,
            costs=THROWAWAY,
        )
        step.detail = f"station {name}, key {station.fingerprint[:16]}"
    demo.stack.callback(station.close)
    return station


def _over_can(demo: Demo, station: Station) -> None:
    provision_over(demo, station, "can", demo.uuid, BuildOrder(PROFILE, name="crane slew angle"))
    with meet(station, demo.over("can"), demo.uuid, demo.reporter) as node, demo.steps.step("rotate") as step:
        agreed = agree(station, node, identify(station, node), rotate=True)
        step.detail = f"key epoch {agreed.epoch}, key {agreed.key_id}"


@contextmanager
def virtual_node(demo: Demo, name: str, profile: str, *links: str) -> Iterator[bytes]:
    """Run a virtual transducer in a process while the context lasts; yield its UUID."""
    folder = make_node(demo, name, profile)
    with run_node(folder, *links, "--can", demo.can, "--source", "sine:4") as uuid:
        yield uuid


_NODE_COMMAND = (sys.executable, "-m", "teds_provision", "--json", "node")


def make_node(demo: Demo, name: str, profile: str) -> Path:
    """Make a virtual transducer that describes itself as this profile; its folder. Raises LinkError."""
    folder = demo.folder / f"{name}-flash"
    words = [*_NODE_COMMAND, "create", str(folder), "--profile", profile]
    made = subprocess.run(words, capture_output=True, text=True, check=False)
    if made.returncode:
        raise _failure("The virtual node could not be made", made.stdout)
    return folder


@contextmanager
def run_node(folder: Path, *links: str) -> Iterator[bytes]:
    """Run a virtual transducer as a process while the context lasts; gives its UUID. Raises LinkError."""
    process = subprocess.Popen([*_NODE_COMMAND, "run", str(folder), *links], stdout=subprocess.PIPE, text=True)
    try:
        yield _ready(process)
    finally:
        process.terminate()
        try:
            process.wait(_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def _ready(process: subprocess.Popen[str]) -> bytes:
    import selectors

    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        line = process.stdout.readline() if selector.select(_START_SECONDS) else ""
    try:
        ready = json.loads(line)
        return bytes.fromhex(ready["uuid"])
    except (ValueError, KeyError, TypeError):
        raise _failure("The virtual node did not start", line) from None


def _failure(what: str, output: str) -> LinkError:
    """Return the error from a node process's stdout: an error as JSON, or nothing readable."""
    body: object = None
    with suppress(ValueError):
        body = json.loads(output)
    problem = problem_in(body, otherwise=output.strip() or "no answer")
    return LinkError(f"{what}: {problem['message']}", hint=problem["hint"])
