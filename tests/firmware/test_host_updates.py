"""The host port as a board that is updated: a process that restarts, power that fails, an image that does not speak."""

from __future__ import annotations

import hashlib
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from teds_provision.errors import LinkError
from teds_provision.links.can.link import CanLink
from teds_provision.links.can.port import CanPort
from teds_provision.protocol.announce import Announce, default_can_address
from teds_provision.protocol.messages.firmware import ABOUT, FirmwareFlag, FirmwareReport
from teds_provision.protocol.messages.frames import Command, Function, Reply, decode_reply, read_teds, security_command
from teds_provision.protocol.session import StationSession
from teds_provision.protocol.wire_agreement import StationAgreement
from teds_provision.teds.image import SECURITY
from tests.e2e.desk import Desk
from tests.firmware import smp
from tests.firmware.conftest import CNode
from tests.firmware.mcuboot import Owner, digest_of
from tests.firmware.smp import packet
from tests.pace import PATIENCE, until
from tests.protocol.desk import CREDENTIALS

pytestmark = pytest.mark.system

OWNER = Owner()
OLD = OWNER.image((1, 0, 0, 0), payload=b"old" * 200, counter=3, text="host/loadcell")
NEW = OWNER.image((1, 2, 3, 45), payload=b"new" * 3000, counter=4, text="host/loadcell")
CRASHES = OWNER.image((2, 0, 0, 0), payload=b"#!crash\n".ljust(64), counter=4)
MUTE = OWNER.image((2, 0, 1, 0), payload=b"#!mute\n".ljust(64), counter=4)
SETTLED = FirmwareFlag.LOCATE | FirmwareFlag.MANAGE | FirmwareFlag.SIGNATURE | FirmwareFlag.COUNTER


class Bench:
    """A board with images on a bus, and its station."""

    def __init__(self, desk: Desk, node: CNode) -> None:
        self.node, self.uuid, self.key = node, bytes.fromhex(node.uuid), b""
        folder = desk.folder
        (folder / "owner.der").write_bytes(OWNER.public)
        (folder / "old.bin").write_bytes(OLD)
        self.options = ["--images", folder / "images", "--owner", folder / "owner.der"]
        self.options += ["--image", folder / "old.bin", "--security-counter"]
        self.port = CanPort(desk.links.can)
        self.starts = 0

    def start(self, *more: object) -> Bench:
        self.node.start(*self.options, *more)
        self.starts = 1
        return self

    def _link(self) -> CanLink:
        return self.port.link(default_can_address(self.uuid))

    def is_silent(self) -> bool:
        """True if no answer comes within a third of a second."""
        try:
            self._link().exchange_limited(ABOUT.encode(), tries=1, seconds=0.3)
        except LinkError:
            return True
        return False

    def exchange(self, command: Command) -> Reply:
        link = self._link()
        link.hopeless = lambda: self.node.process is None or not self.node.process.runs
        return decode_reply(link.exchange(command.encode()))

    def agree(self) -> Bench:
        agreement = StationAgreement(CREDENTIALS, self.uuid)
        teds = self.exchange(read_teds(*SECURITY, 0)).payload[4:]
        reply = self.exchange(agreement.request())
        agreed = agreement.accept(reply.payload, teds, pinned=None, epoch=0)
        assert self.exchange(agreed.confirm).ok
        self.key = agreed.key
        return self

    def open(self) -> Bench:
        self.session = StationSession(self.key, self.uuid)
        counter = self.exchange(self.session.request_counter())
        self.session.accept(self.exchange(self.session.open(counter.payload)).payload)
        return self

    def sealed(self, command: Command) -> Reply:
        return self.session.unseal(self.exchange(self.session.seal(command)).payload)

    def ask(self, command: tuple[int, int, int], body: bytes = smp.EMPTY) -> Any:
        reply = self.sealed(Command(0, 128, Function.MANAGE, packet(command, body)))
        assert reply.ok, reply.reason
        return smp.body_of(reply.payload)

    def about(self) -> FirmwareReport:
        return FirmwareReport.decode(self.exchange(ABOUT).payload)

    def upload(self, image: bytes) -> None:
        off, first = 0, {"len": len(image), "sha": hashlib.sha256(image).digest()}
        while off < len(image):
            values = {"off": off, "data": image[off : off + 880], **(first if off == 0 else {})}
            off = self.ask(smp.UPLOAD, smp.encode(values))["off"]

    def begin_trial(self, image: bytes) -> None:
        self.upload(image)
        self.ask(smp.SET_STATE, smp.start(digest_of(image)))
        self.ask(smp.RESTART)

    def wait_for_restart(self) -> None:
        """The process that restarts says once more that it is ready."""
        assert self.node.process is not None
        self.starts += 1
        assert self.node.process.wait_for_lines(self.starts)[-1]["ready"] is True

    def stored(self) -> bytes:
        """Return every octet of identity and slots: what no update may change."""
        return self.node.flash.read_bytes()


@pytest.fixture
def bench(desk: Desk, node: CNode) -> Iterator[Bench]:
    made = Bench(desk, node)
    yield made
    made.port.close()


def test_a_board_is_updated_and_restarts_as_a_process(bench: Bench) -> None:
    bench.start().agree()
    report = bench.about()
    assert (report.version_text, report.image, report.flags) == ("1.0.0", digest_of(OLD), SETTLED)
    bench.open()
    bench.sealed(security_command(Function.IDENTIFY))
    before = bench.stored()
    bench.begin_trial(NEW)
    bench.wait_for_restart()
    report = bench.about()
    assert (report.version_text, report.build, report.text) == ("1.2.3", 45, "host/loadcell")
    assert report.flags == SETTLED | FirmwareFlag.ON_TRIAL
    bench.open()
    assert bench.ask(smp.SET_STATE, smp.CONFIRM)["images"][0]["confirmed"] is True
    assert bench.about().flags == SETTLED
    bench.node.kill()
    bench.start()
    assert bench.about().image == digest_of(NEW)
    assert bench.stored() == before
    # an image that crashes on trial reverts by itself, one that does not speak when its power comes back
    bench.open()
    bench.begin_trial(CRASHES)
    bench.wait_for_restart()
    assert bench.about().image == digest_of(NEW)
    bench.node.kill()
    bench.start()
    bench.open()
    bench.begin_trial(MUTE)
    bench.wait_for_restart()
    assert bench.is_silent()
    bench.node.kill()
    bench.start()
    assert (bench.about().image, bench.about().flags) == (digest_of(NEW), SETTLED)
    assert bench.stored() == before


def test_a_board_shows_which_one_it_is(bench: Bench) -> None:
    bench.start()
    node = bench.node
    assert node.process is not None
    with bench.port.listen_frames(lambda frame: Announce.decode(frame.identifier, frame.data) is not None) as heard:
        node.process.signal(signal.SIGUSR2)
        seen: list[Announce] = []

        def pressed() -> bool:
            if (frame := heard.get(0.1)) is not None:
                announce = Announce.decode(frame.identifier, frame.data)
                assert announce is not None
                seen.append(announce)
            return any(seen_announce.pressed for seen_announce in seen)

        until(pressed, seconds=PATIENCE)
    assert bench.exchange(security_command(Function.LOCATE, b"\x3c")).ok
    located = node.process.wait_for_lines(2)[1]
    assert located == {"event": "locate", "uuid": node.uuid, "seconds": 60}


def test_a_board_may_report_another_firmware_or_none(desk: Desk, node: CNode) -> None:
    bench = Bench(desk, node)
    node.start("--about", "3.2.1+7,nrf52840dk/nrf52840/loadcell")
    assert bench.about() == FirmwareReport("nrf52840dk/nrf52840/loadcell", (3, 2, 1), 7, None, FirmwareFlag.LOCATE)
    node.kill()
    node.start("--about", "none")
    assert not bench.exchange(ABOUT).ok
    bench.port.close()


def resumes(bench: Bench, step: int, *, torn: bool) -> bool:
    """Cut the power at this step of an update, and see that it goes through afterwards; False: no such step."""
    bench.start("--cut", f"{step}:torn" if torn else str(step))
    before, cut = bench.stored(), False
    bench.open()
    try:
        bench.begin_trial(NEW)
        bench.wait_for_restart()
        bench.open()
        bench.ask(smp.SET_STATE, smp.CONFIRM)
    except (LinkError, AssertionError):
        assert bench.node.process is not None
        assert not bench.node.process.runs
        cut = True
    if not cut:
        bench.node.kill()
    bench.start()
    running = bench.about()
    assert running.image in (digest_of(OLD), digest_of(NEW))
    assert bench.stored() == before
    bench.open()
    if running.image != digest_of(NEW):
        bench.begin_trial(NEW)
        bench.wait_for_restart()
        bench.open()
    if FirmwareFlag.ON_TRIAL in bench.about().flags:
        bench.ask(smp.SET_STATE, smp.CONFIRM)
    assert (bench.about().image, bench.about().flags) == (digest_of(NEW), SETTLED)
    assert bench.stored() == before
    bench.node.kill()
    return cut


def _with_a_key(bench: Bench, folder: Path) -> dict[str, bytes]:
    bench.start().agree().open()
    bench.sealed(security_command(Function.IDENTIFY))
    bench.node.kill()
    bench.start()  # at a start the old slot is erased
    bench.node.kill()
    return {name: (folder / name).read_bytes() for name in ("slot-0.bin", "slot-1.bin", "boot.bin")}


def test_power_that_fails_in_the_middle_costs_nothing(desk: Desk, bench: Bench) -> None:
    _with_a_key(bench, desk.folder / "images")
    assert resumes(bench, 6, torn=True)


@pytest.mark.soak
@pytest.mark.parametrize("torn", [False, True], ids=["clean", "torn"])
def test_power_may_fail_at_each_step_of_an_update(desk: Desk, bench: Bench, torn: bool) -> None:
    folder = desk.folder / "images"
    at_first = _with_a_key(bench, folder)
    steps = 0
    while True:
        for name, octets in at_first.items():
            (folder / name).write_bytes(octets)
        steps += 1
        if not resumes(bench, steps, torn=torn):
            break
    assert steps > 15
