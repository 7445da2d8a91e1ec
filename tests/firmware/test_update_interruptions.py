"""The station's own update of the host port, interrupted at each exchange and flash step, at either end; then again."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import pytest

from teds_provision.errors import NodeSilentError
from teds_provision.firmware_image import FirmwareImage, load_firmware_image
from teds_provision.links import LinkSettings
from teds_provision.links.can.link import CanLink
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter
from teds_provision.provisioning.provision import provision
from teds_provision.provisioning.update import BoardUpdate, UpdateOrder, update_boards
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE, make_station
from tests.e2e.desk import Desk
from tests.firmware.conftest import CNode
from tests.firmware.mcuboot import Owner, digest_of

pytestmark = pytest.mark.system

OWNER: Final = Owner()
OLD: Final = OWNER.image((1, 0, 0, 0), payload=b"old" * 200, counter=3, text="host/loadcell")
NEW: Final = OWNER.image((1, 2, 3, 45), payload=b"new" * 2000, counter=4, text="host/loadcell")
PROFILE: Final = "magnetic-angular-position-sensor"
KEPT: Final = ("flash.bin", "images", "home")


class StationKilledError(BaseException):
    """The station's process was killed."""


class UpdateDesk:
    """A provisioned board in C with the old image, its station, and both as they were before the first update."""

    def __init__(self, desk: Desk, node: CNode, patch: pytest.MonkeyPatch) -> None:
        self.node, self.folder, self.uuid = node, desk.folder, bytes.fromhex(node.uuid)
        (self.folder / "owner.der").write_bytes(OWNER.public)
        for name, octets in (("old.bin", OLD), ("new.bin", NEW)):
            (self.folder / name).write_bytes(octets)
        self.image: FirmwareImage = load_firmware_image(self.folder / "new.bin")
        self.links = LinkSettings("can", can=desk.links.can, via_chosen=True)
        self.exchanges = 0
        self.before: Callable[[int], None] = lambda number: None
        self.after: Callable[[int], None] = lambda number: None
        make_station(self.folder / "home").close()
        self.power_on()
        self._provision()
        self.node.kill()
        self.power_on()  # at a start the old slot is erased
        self.node.kill()
        for name in KEPT:
            _copy(self.folder / name, self.folder / f"first-{name}")
        plain = CanLink._ask

        def ask(link: CanLink, *words: Any, **more: Any) -> bytes:
            self.exchanges += 1
            number = self.exchanges
            self.before(number)
            reply = plain(link, *words, **more)
            self.after(number)
            return reply

        patch.setattr(CanLink, "_ask", ask)

    def power_on(self, *options: object) -> None:
        images = ("--images", self.folder / "images", "--owner", self.folder / "owner.der", "--security-counter")
        self.node.start(*images, "--image", self.folder / "old.bin", *options)

    def power_cycle(self) -> None:
        """Cut the board's power and switch it on again."""
        self.node.kill()
        self.power_on()

    def as_at_first(self) -> None:
        """Put back what stood on the board and in the station before the update."""
        for name in KEPT:
            _copy(self.folder / f"first-{name}", self.folder / name)

    def _station(self) -> Station:
        return Station.open(self.folder / "home", ask=lambda prompt, confirm: PASSPHRASE)

    def _provision(self) -> None:
        station, silent = self._station(), SilentReporter()
        with meet(station, self.links, self.uuid, silent, before=station.unlock) as node:
            order = BuildOrder(PROFILE, accept_calibration="a test")
            provision(station, node, order, operator=AcceptingOperator(), reporter=silent)
        station.close()

    def update(self) -> BoardUpdate:
        """Run the station's step once, in a station that has just been started."""
        station, self.exchanges = self._station(), 0
        station.unlock()
        try:
            order = UpdateOrder(self.image, wait=20.0)
            (done,) = update_boards(station, self.links, [(self.uuid, order)], lambda uuid: SilentReporter())
        finally:
            station.close()
        return done

    def stored(self) -> bytes:
        """Return every octet of identity and slots: what no update may change."""
        return (self.folder / "flash.bin").read_bytes()

    def resumes(self) -> None:
        """Run the same update again until it ends well; nothing but the image has changed."""
        again = [self.update()]
        if again[0].result == "reverted":  # power failed on trial, and nothing had been reported
            again.append(self.update())
        assert again[-1].result in ("updated", "already"), again
        assert self.stored() == (self.folder / "first-flash.bin").read_bytes()
        self.power_cycle()
        assert self.update().result == "already", "it stays over a restart"
        self.node.kill()


def _copy(source: Path, target: Path) -> None:
    if source.is_dir():
        shutil.rmtree(target, ignore_errors=True)
        shutil.copytree(source, target)
    else:
        shutil.copy2(source, target)


@pytest.fixture
def desk_of_updates(desk: Desk, node: CNode, monkeypatch: pytest.MonkeyPatch) -> UpdateDesk:
    return UpdateDesk(desk, node, monkeypatch)


def _lost(desk: UpdateDesk) -> None:
    raise NodeSilentError("It was lost.")


def _killed(desk: UpdateDesk) -> None:
    raise StationKilledError


def _node_off(desk: UpdateDesk) -> None:
    desk.power_cycle()


def _node_off_with_its_reply(desk: UpdateDesk) -> None:
    desk.power_cycle()
    raise NodeSilentError("The board lost power with its reply.")


INTERRUPTIONS: Final = {
    "request lost": ("before", _lost),
    "reply lost": ("after", _lost),
    "station killed": ("before", _killed),
    "station killed after": ("after", _killed),
    "node off": ("before", _node_off),
    "node off after": ("after", _node_off_with_its_reply),
}


def interrupted(desk: UpdateDesk, name: str, at: int) -> bool:
    """Interrupt an update at this exchange, and see that it goes through afterwards; False: it has fewer."""
    when, act = INTERRUPTIONS[name]
    desk.as_at_first()
    desk.power_on()
    happened = False

    def once(number: int) -> None:
        nonlocal happened
        if number == at and not happened:
            happened = True
            act(desk)

    setattr(desk, when, once)
    with suppress(StationKilledError):
        desk.update()
    desk.before = desk.after = lambda number: None
    desk.resumes()
    return happened


def power_fails(desk: UpdateDesk, step: int, *, torn: bool) -> bool:
    """Cut the board's power at this flash step, and see that it goes through afterwards; False: it has fewer."""
    desk.as_at_first()
    desk.power_on("--cut", f"{step}:torn" if torn else str(step))
    first = desk.update()
    process = desk.node.process
    assert process is not None
    happened = not process.runs
    assert happened == (first.result != "updated")
    if happened:
        desk.power_on()
    desk.resumes()
    return happened


def test_an_interrupted_update_of_a_node_in_c_resumes(desk_of_updates: UpdateDesk) -> None:
    assert interrupted(desk_of_updates, "node off after", 9)
    assert digest_of(NEW) == desk_of_updates.image.digest


@pytest.mark.soak
@pytest.mark.parametrize("name", INTERRUPTIONS)
def test_an_update_of_a_node_in_c_resumes_after_any_exchange(desk_of_updates: UpdateDesk, name: str) -> None:
    exchanges = 0
    while interrupted(desk_of_updates, name, exchanges + 1):
        exchanges += 1
    assert exchanges > 20


@pytest.mark.soak
@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
def test_an_update_of_a_node_in_c_resumes_after_any_flash_step(desk_of_updates: UpdateDesk, torn: bool) -> None:
    steps = 0
    while power_fails(desk_of_updates, steps + 1, torn=torn):
        steps += 1
    assert steps > 10
