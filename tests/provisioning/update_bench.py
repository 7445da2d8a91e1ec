"""A station and a virtual node with image slots, in memory: exchanges can be lost, and either end can lose power."""

from __future__ import annotations

import contextlib
import shutil
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from teds_provision.errors import NodeSilentError, NoNodeError
from teds_provision.firmware_image import FirmwareImage, load_firmware_image
from teds_provision.links import LINKS, Capabilities, Contact, LinkSettings
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.node_template import create
from teds_provision.node.virtual import VirtualNode
from teds_provision.protocol.messages.identity import Identity
from teds_provision.protocol.repetition import Repetition
from teds_provision.provisioning import update as update_step
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.conversation import Conversation
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.provision import provision
from teds_provision.provisioning.update import BoardUpdate, UpdateOrder, update_boards
from teds_provision.station.station import Station
from tests.bench import PASSPHRASE, copied_station
from tests.firmware_images import make_key, sign

PROFILE = "tactile-finger-sensor"


class StationKilledError(BaseException):
    """The station's process was killed."""


class Owner:
    """What is made once: the owner's keys and images, a station, and a node of it that runs the old image."""

    def __init__(self, folder: Path) -> None:
        folder.mkdir(exist_ok=True)
        self.folder = folder
        self.key, self.rival = make_key(folder / "owner.pem"), make_key(folder / "rival.pem")
        self.old, self.new = self.image("1.0.0", counter=1), self.image("1.1.0", counter=1)
        self.long = self.image("1.2.0", counter=1, octets=9000)
        first = sign(folder, "1.0.0", self.key, counter=1)
        create(folder / "node", profile=PROFILE).release()
        ImageSlots.create(folder / "node", first, self.key)
        station = copied_station(folder / "home")
        bench = UpdateBench(folder, station, self)
        bench.provision()
        bench.close()

    def image(self, version: str, key: Path | None = None, **more: Any) -> FirmwareImage:
        return load_firmware_image(sign(self.folder, version, key or self.key, **more))


class _Steps(SilentReporter):
    """A reporter that keeps the detail of each finished step, the last one of a name."""

    def __init__(self, details: dict[str, str]) -> None:
        self._details = details

    def finished(self, step: StepResult) -> None:
        """Note what a person would read."""
        self._details[step.name] = step.detail


@dataclass
class UpdateBench:
    """A node in ``folder``/node and a station. ``cut`` is called before each exchange with its number, from 1.

    ``details`` holds what an update printed of each of its steps, by name.
    """

    folder: Path
    station: Station
    owner: Owner
    via: str = "can"
    cut: Callable[[int], None] = lambda number: None
    answered: Callable[[int], None] = lambda number: None
    changed: Callable[[bytes, bytes], bytes] = lambda request, reply: reply
    exchanges: int = 0
    present: bool = True
    details: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.power_on()

    @classmethod
    def copy_of(cls, owner: Owner, folder: Path) -> UpdateBench:
        """Return a bench with a copy of the node and of the station."""
        folder.mkdir(exist_ok=True)
        for name in ("node", "home"):
            shutil.copytree(owner.folder / name, folder / name)
        return cls(folder, Station.open(folder / "home", ask=lambda prompt, confirm: PASSPHRASE), owner)

    def power_on(self) -> None:
        """Cut the node's power and switch it on again."""
        self.node = VirtualNode(self.folder / "node", board=_sine_board)
        self.repetition = Repetition()
        self.node.when_restarted(self._forget)

    def _forget(self) -> None:
        self.repetition = Repetition()

    def close(self) -> None:
        self.station.close()

    # -- what the station sees -------------------------------------------------------------------------------------

    def contact(self) -> Contact:
        if not self.present:
            raise NoNodeError("It is gone.")
        identity = Identity.decode(self.node.identify())
        return Contact(identity, BenchLink(self), address=identity.can_address if self.via == "can" else None)

    def provision(self) -> None:
        self.station.unlock()
        with Conversation(self.contact(), notice=lambda notice: None) as node:
            provision(self.station, node, BuildOrder(PROFILE), operator=AcceptingOperator(), reporter=SilentReporter())

    def update(self, image: FirmwareImage, **order: Any) -> BoardUpdate:
        """Run the step once, as the command does."""
        with self.patched():
            (done,) = update_boards(
                self.station,
                LinkSettings("can", via_chosen=True),
                [(self.uuid, UpdateOrder(image, **{"wait": 5.0, **order}))],
                lambda uuid: _Steps(self.details),
            )
        return done

    @contextlib.contextmanager
    def patched(self) -> Iterator[None]:
        before = update_step.open_port
        update_step.open_port = lambda links: BenchPort(self)  # type: ignore[assignment]
        try:
            yield
        finally:
            update_step.open_port = before

    @property
    def uuid(self) -> bytes:
        return self.node.tim.flash.uuid

    @property
    def runs(self) -> tuple[str, bool, bool]:
        """Version, on trial, another one pending."""
        slots = ImageSlots(self.folder / "node")
        slots._running = slots._verified(slots._state.running)  # as it is on the disk, without a start
        return slots.running.version_text, slots.on_trial, slots.pending


@dataclass
class BenchPort:
    """The one node of the bench."""

    bench: UpdateBench
    via: str = "can"
    place: str = "can:bench"

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.bench.via].capabilities

    def find(self, wanted: Callable[[Identity], bool], **_: Any) -> Contact:
        contact = self.bench.contact()
        assert wanted(contact.identity)
        return contact

    def close(self) -> None:
        pass


@dataclass
class BenchLink:
    """One exchange after the other with the node; a reply has left when it was handed out."""

    bench: UpdateBench
    transaction: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def via(self) -> str:
        return self.bench.via

    @property
    def capabilities(self) -> Capabilities:
        return LINKS[self.via].capabilities

    def exchange(self, frame: bytes) -> bytes:
        bench, link = self.bench, f"{self.bench.via}:f1"
        bench.exchanges += 1
        number = bench.exchanges
        bench.cut(number)
        if not bench.present:
            raise NodeSilentError("It is gone.")
        node = bench.node
        reply = bench.repetition.answer(
            number,
            frame,
            lambda octets: node.request(link, octets, tapped=bench.via == "can" and node.in_factory_state()),
            now=0.0,
        )
        restarting = threading.Event()
        node.when_restarted(restarting.set)
        asked = node.tim._manage is not None and node.tim._manage.restart_link == link
        node.reply_sent(link)
        if asked:
            assert restarting.wait(60), "the board did not restart"
        bench.answered(number)
        return bench.changed(frame, reply)

    def close(self) -> None:
        self.bench.node.lost(f"{self.via}:f1")


def _sine_board(file: Any) -> Any:
    from teds_provision.node.hardware.board import Board
    from teds_provision.teds.image import Image
    from teds_provision.teds.sheet import Sheet

    uuid, hardware = file.load().uuid, file.hardware
    return Board(Sheet.from_image(Image(uuid, hardware)), source="sine:2", lag=0, battery=None) if hardware else None
