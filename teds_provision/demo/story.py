"""The whole story on one machine: two base stations, one virtual node, NFC and CAN frames, a handover.

The node is a process of its own; the stations live in this one, with throwaway homes and vaults that are deleted at the
end. Nothing leaves the machine: NFC goes over UDP on 127.0.0.1, CAN over multicast with hop limit 0.
"""

from __future__ import annotations

import json
import secrets
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from teds_provision import steps as steps_room
from teds_provision import vault
from teds_provision.demo.desk import Demo, provision_over
from teds_provision.demo.handover import hand_over
from teds_provision.demo.measuring import (
    GRIPPER,
    calibrate_sensor,
    calibrations,
    measure_group,
    move_gripper,
    provision_gripper,
)
from teds_provision.errors import LinkFailure
from teds_provision.station.station import Station, initialise
from teds_provision.steps.build import BuildOrder
from teds_provision.talk.meeting import meet
from teds_provision.talk.progress import Reporter, StepResult

PROFILE = "magnetic-angular-position-sensor"
_START_SECONDS = 20.0
_STOP_SECONDS = 5.0


@dataclass(frozen=True)
class DemoDone:
    """The demo's steps and its verdict: that of the last verification."""

    steps: tuple[StepResult, ...]
    verdict: str
    uuid: bytes


def run_demo(reporter: Reporter, say: Callable[[str], None]) -> DemoDone:
    """Run it; raises whatever a step raises. The folder is gone afterwards, however it ends."""
    folder = Path(tempfile.mkdtemp(prefix="teds-provision-demo-"))
    try:
        demo = Demo(folder, reporter, say)
        with demo.stack:
            return _run(demo)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(demo: Demo) -> DemoDone:
    demo.say("Two base stations, each with its own keys, and a sensor on a reader (a process of its own).")
    first, second = _station(demo, "bench"), _station(demo, "crane")
    with demo.steps.step("start node") as step:
        demo.uuid = demo.stack.enter_context(_node(demo, "node", PROFILE, "--nfc", demo.nfc))
        step.detail = f"{demo.uuid.hex()} on {demo.nfc} and {demo.can}"
    demo.say("Tap: station bench provisions the sensor over NFC.")
    done = provision_over(demo, first, "nfc", demo.uuid, BuildOrder(PROFILE))
    demo.say("The same sensor over CAN: written anew under another name, verified, its key rotated.")
    _over_can(demo, first)
    demo.say("Hand over: crane gets a copy of the key, then bench gives the sensor away for good.")
    hand_over(demo, first, second)
    demo.say(
        "Measure: crane calibrates the sensor, takes up a gripper on the same bus, records both, moves the gripper."
    )
    _measure(demo, second)
    return DemoDone(tuple(demo.steps.done), done.verified.verdict, demo.uuid)


def _measure(demo: Demo, station: Station) -> None:
    files = calibrations(demo.folder)
    with demo.steps.step("start node") as step:
        gripper = demo.stack.enter_context(_node(demo, "gripper", GRIPPER))
        step.detail = f"{gripper.hex()}, a gripper on {demo.can}"
    provision_gripper(demo, station, gripper, files[GRIPPER])
    calibrate_sensor(demo, station, files["angle"])
    measure_group(demo, station, (demo.uuid, gripper))
    move_gripper(demo, station, gripper)


def _station(demo: Demo, name: str) -> Station:
    secret = secrets.token_hex(16)
    with demo.steps.step("init") as step:
        station, _ = initialise(
            demo.folder / name,
            name=name,
            keystore="file",
            ask=lambda prompt, confirm: secret,
            costs=vault.passphrase.THROWAWAY,
        )
        step.detail = f"station {name}, key {station.fingerprint[:16]}"
    demo.stack.callback(station.close)
    return station


def _over_can(demo: Demo, station: Station) -> None:
    provision_over(demo, station, "can", demo.uuid, BuildOrder(PROFILE, name="crane slew angle"))
    with meet(station, demo.over("can"), demo.uuid, demo.reporter) as node, demo.steps.step("rotate") as step:
        agreed = steps_room.agree.agree(station, node, steps_room.identify.identify(station, node), rotate=True)
        step.detail = f"key epoch {agreed.epoch}, key {agreed.key_id}"


@contextmanager
def _node(demo: Demo, name: str, profile: str, *links: str) -> Iterator[bytes]:
    """A virtual transducer in a process of its own, while the context lasts; gives its UUID."""
    folder = demo.folder / f"{name}-flash"
    command = [sys.executable, "-m", "teds_provision", "--json", "node"]
    made = subprocess.run(
        [*command, "create", str(folder), "--profile", profile], capture_output=True, text=True, check=False
    )
    if made.returncode:
        raise _failure("The virtual node could not be made", made.stdout)
    process = subprocess.Popen(
        [*command, "run", str(folder), *links, "--can", demo.can, "--source", "sine:4"],
        stdout=subprocess.PIPE,
        text=True,
    )
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
        said = json.loads(line)
        return bytes.fromhex(said["uuid"])
    except (ValueError, KeyError, TypeError):
        raise _failure("The virtual node did not start", line) from None


def _failure(what: str, said: str) -> LinkFailure:
    """Tell what the node's process said on its stdout: an error as JSON, or nothing that can be read."""
    try:
        error = json.loads(said)["error"]
        return LinkFailure(f"{what}: {error['message']}", hint=error["hint"])
    except (ValueError, KeyError, TypeError):
        return LinkFailure(f"{what}: {said.strip() or 'no answer'}")
