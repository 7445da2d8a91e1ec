"""How fast an image goes into a board, beside the time that its frames take on the wire.

``python -m benchmarks.updating [--kib N] [--boards N] [--only TEXT]``. Each row starts a node (in Python, or in C if
``make firmware`` has built it) on a paced bus of this machine, provisions it, and updates it. A third party on the bus
counts every frame; wire time is that of all frames of the upload, with their stuff bits. Aims for 256 KiB and a node in
C: at most 1.25 times the wire on CAN 500 kbit/s, 1.5 times on CAN FD; many boards on one bus 1.3 times that of all.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.newcomers import Wire
from benchmarks.nodes import PROGRAM
from teds_provision.firmware_image import load_firmware_image
from teds_provision.links import LinkSettings
from teds_provision.links.ports import free_port
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.flash_file import FlashFile
from teds_provision.station.station import Station, initialise
from teds_provision.steps.build import BuildOrder
from teds_provision.steps.provision import provision
from teds_provision.steps.update import BoardUpdate, UpdateOrder, update_boards
from teds_provision.talk.meeting import meet
from teds_provision.talk.progress import SilentReporter, StepResult
from teds_provision.vault import passphrase

PROFILE = "magnetic-angular-position-sensor"


@dataclass(frozen=True)
class Row:
    """One row: its link, whether its boards run the node in C, and the aim as a multiple of the wire."""

    title: str
    more: str
    in_c: bool
    aim: float
    many: bool = False


ROWS = (
    Row("CAN 500 kbit/s, node in C", "", True, 1.25),
    Row("CAN FD 500k/2M, node in C", "&fd=1", True, 1.5),
    Row("CAN 500 kbit/s, virtual node", "", False, 1.25),
    Row("CAN 500 kbit/s, nodes in C, all at once", "", True, 1.3, many=True),
)


class UploadTimes(SilentReporter):
    """When the uploads of all boards began and ended."""

    def __init__(self) -> None:
        self.began: list[float] = []
        self.ended: list[float] = []

    def started(self, step: str) -> None:
        """Note the begin of an upload."""
        if step == "upload":
            self.began.append(time.monotonic())

    def finished(self, step: StepResult) -> None:
        """Note its end."""
        if step.name == "upload":
            self.ended.append(time.monotonic())


def imgtool(*words: object) -> None:
    """Run imgtool in this process."""
    from imgtool.main import imgtool as command

    with contextlib.redirect_stdout(io.StringIO()):
        command.main([str(word) for word in words], standalone_mode=False)


def sign(folder: Path, key: Path, version: str, octets: int) -> Path:
    """Sign an image of random octets."""
    payload, image = folder / "payload", folder / f"{version}.bin"
    payload.write_bytes(os.urandom(octets))
    layout = ("--align", 4, "--header-size", "0x200", "--pad-header", "--slot-size", "0x60000")
    imgtool("sign", "-k", key, "--version", version, "--custom-tlv", "0x54a0", "bench/board", *layout, payload, image)
    return image


@contextmanager
def board(folder: Path, link: str, row: Row, image: Path, key: Path) -> Iterator[bytes]:
    """Run a node on the bus for the block; give its UUID."""
    folder.mkdir()
    uuid = os.urandom(10)
    if row.in_c:
        owner = folder / "owner.raw"
        imgtool("getpub", "-k", key, "-e", "raw", "-o", owner)
        words = [str(PROGRAM), "--flash", str(folder / "flash"), "--uuid", uuid.hex(), "--can", link.partition("&")[0]]
        words += ["--pace", "--images", str(folder / "images"), "--owner", str(owner), "--image", str(image)]
        words += ["--fd"] if "fd=1" in row.more else []
    else:
        FlashFile.create(folder / "node", uuid=uuid)
        ImageSlots.create(folder / "node", image, key)
        words = [sys.executable, "-m", "teds_provision", "--json", "node", "run", str(folder / "node"), "--can", link]
    process = subprocess.Popen(words, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        assert json.loads(process.stdout.readline())["ready"]
        yield uuid
    finally:
        process.terminate()
        process.wait(20)


def measure(row: Row, octets: int, boards: int) -> tuple[float, float, list[BoardUpdate]]:
    """Return the seconds of the uploads, those of their frames on the wire, and how each board ended."""
    link = f"udp_multicast:239.74.163.13?port={free_port()}&pace=1{row.more}"
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack:
        folder, key = Path(place), Path(place, "owner.pem")
        imgtool("keygen", "-k", key, "-t", "ecdsa-p256")
        old, new = sign(folder, key, "1.0.0", 1000), sign(folder, key, "1.1.0", octets)
        station, _ = initialise(
            folder / "home", name="bench", keystore="file", ask=lambda *_: "correct horse", costs=passphrase.THROWAWAY
        )
        stack.callback(station.close)
        uuids = [stack.enter_context(board(folder / f"{n}", link, row, old, key)) for n in range(boards)]
        links = LinkSettings("can", can=link, via_chosen=True)
        time.sleep(0.7)  # their Announces
        _provision(station, links, uuids)
        wire = Wire(link)
        stack.callback(wire.close)
        times, image = UploadTimes(), load_firmware_image(new)
        orders = [(uuid, UpdateOrder(image)) for uuid in uuids]
        ends = list(update_boards(station, links, orders, lambda uuid: times, parallel=4 if row.many else 1))
        if not times.ended:
            return 0.0, 0.0, ends
        talk, data = wire.seconds(times.began[0], times.ended[-1])
        return times.ended[-1] - times.began[0], talk + data, ends


def _provision(station: Station, links: LinkSettings, uuids: list[bytes]) -> None:
    for uuid in uuids:
        with meet(station, links, uuid, SilentReporter(), before=station.unlock) as node:
            provision(
                station,
                node,
                BuildOrder(PROFILE, accept_calibration="a benchmark"),
                accept=lambda who: None,
                reporter=SilentReporter(),
            )


def main() -> None:
    """Print a row for each link."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kib", type=int, default=256, help="KiB of the image")
    parser.add_argument("--boards", type=int, default=4, help="boards of the row with many")
    parser.add_argument("--only", default="", help="rows whose title contains this")
    options = parser.parse_args()
    print(f"{options.kib} KiB; load {os.getloadavg()[0]:.1f}")
    for row in ROWS:
        if options.only not in row.title or (row.in_c and not PROGRAM.exists()):
            continue
        boards = options.boards if row.many else 1
        seconds, wire, ends = measure(row, options.kib << 10, boards)
        failed = [end for end in ends if end.result != "updated"]
        if failed:
            print(f"{row.title:<40} {failed[0].result}: {failed[0].error}")
            continue
        ratio = seconds / wire
        met = "met" if ratio <= row.aim else "MISSED"
        print(
            f"{row.title:<40}{boards:>3} x{seconds:>8.2f} s, wire {wire:>7.2f} s: {ratio:>5.2f}; aim {row.aim}: {met};"
            f" load {os.getloadavg()[0]:.0f}"
        )


if __name__ == "__main__":
    main()
