"""How fast an image goes into a board, beside the time that its frames take on the wire.

``python -m benchmarks.updating [--kib N] [--boards N] [--only TEXT] [--exchanges]``. Each row starts a node (in Python,
or in C if ``make firmware`` has built it) on a paced bus of this machine, provisions it, and updates it. A third
process on the bus counts every frame; wire time is that of all frames of the upload, with their stuff bits. Frames that
overlap on this simulated bus are counted one after the other. Aims for 256 KiB and a node in C: at most 1.25 times the
wire on CAN 500 kbit/s, 1.5 times on CAN FD; twenty boards of 64 KiB on one bus 1.3 times that of all. The rows of nodes
in C take 3 minutes. After each row are the shares of a core that station and nodes took meanwhile: above 80 % the
machine is the limit. ``--exchanges`` shows between which frames the wire was free, and for how long.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import pickle
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.nodes import PROGRAM
from teds_provision.firmware_image import load_firmware_image
from teds_provision.links import LinkSettings
from teds_provision.links.can.bus import Bus, Frame
from teds_provision.links.can.isotp import addresses
from teds_provision.links.can.pacing import Pacer, classic_bits, fd_seconds
from teds_provision.links.can.spec import FIRST_STATION, parse_spec
from teds_provision.links.ports import free_port
from teds_provision.node.firmware.boot_loader import ImageSlots
from teds_provision.node.flash_file import FlashFile
from teds_provision.provisioning.build import BuildOrder
from teds_provision.provisioning.meeting import meet
from teds_provision.provisioning.operator import AcceptingOperator
from teds_provision.provisioning.progress import SilentReporter, StepResult
from teds_provision.provisioning.provision import provision
from teds_provision.provisioning.update import BoardUpdate, UpdateOrder, update_boards
from teds_provision.station.station import Station, initialise
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
    """When the uploads of all boards began and ended, and what processor time each process had used by then."""

    def __init__(self, nodes: Sequence[int]) -> None:
        self._nodes = nodes
        self.began: list[Moment] = []
        self.ended: list[Moment] = []

    def started(self, step: str) -> None:
        """Note the begin of an upload."""
        if step == "upload":
            self.began.append(Moment.now(self._nodes))

    def finished(self, step: StepResult) -> None:
        """Note its end."""
        if step.name == "upload":
            self.ended.append(Moment.now(self._nodes))


@dataclass(frozen=True)
class Moment:
    """A time (monotonic), and the processor seconds of the station, of its pacing, and of the nodes until then."""

    at: float
    station: float
    pacing: float
    nodes: float

    @classmethod
    def now(cls, nodes: Sequence[int]) -> Moment:
        """Return this moment; ``nodes`` are process ids."""
        return cls(time.monotonic(), time.process_time(), PACING.seconds, sum(map(_processor_seconds, nodes)))


def _processor_seconds(process: int) -> float:
    try:
        words = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    except FileNotFoundError:
        return 0.0
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


class PacingTime:
    """Processor time that the station's process spends on being held to the time of a wire."""

    def __init__(self) -> None:
        self.seconds, self._plain, self._lock = 0.0, Pacer.wait, threading.Lock()

    def count(self) -> None:
        """Count from now on."""
        plain = self._plain

        def wait(pacer: Pacer, identifier: int, data: bytes, *, fd: bool) -> None:
            began = time.thread_time()
            plain(pacer, identifier, data, fd=fd)
            seconds = time.thread_time() - began
            with self._lock:
                self.seconds += seconds

        Pacer.wait = wait  # type: ignore[method-assign, assignment]


PACING = PacingTime()


# -- every frame of the bus, by a process of its own -------------------------------------------------------------------


class FrameCount:
    """A process that hears every frame: as a thread it would take the interpreter from the station."""

    def __init__(self, link: str) -> None:
        words = [sys.executable, "-m", "benchmarks.updating", "--listen", link.replace("&pace=1", "")]
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == b"ready\n"

    def frames(self) -> list[Frame]:
        """End the process; return what it heard, in the order in which frames left the wire."""
        heard: list[Frame] = pickle.loads(self._process.communicate()[0])
        return sorted(heard, key=lambda frame: frame.at)

    def close(self) -> None:
        """End the process."""
        if self._process.poll() is None:
            self._process.kill()
            self._process.communicate()


def listen(link: str) -> None:
    """Hear every frame until stdin ends; then write them all."""
    bus, ended, heard = Bus(parse_spec(link)), threading.Event(), list[Frame]()

    def wait_for_the_end() -> None:
        sys.stdin.read()
        ended.set()

    threading.Thread(target=wait_for_the_end, daemon=True).start()
    print("ready", flush=True)
    over = False
    while not over:
        over = ended.wait(0.01)
        while (frame := bus.receive(0.0)) is not None:
            heard.append(frame)
    sys.stdout.buffer.write(pickle.dumps(heard))


def wire_seconds(frame: Frame) -> float:
    """Return how long a frame takes on the wire."""
    if frame.fd:
        return fd_seconds(frame.identifier, frame.data, 500_000, 2_000_000)
    return classic_bits(frame.identifier, frame.data) / 500_000


def _kind(frame: Frame) -> str:
    ends = addresses(frame.identifier)
    if ends is None:
        return "other"
    sender = "station" if ends[1] >= FIRST_STATION else "node"
    return f"{sender}'s {('single', 'first', 'consecutive', 'flow')[frame.data[0] >> 4 & 3]}"


@dataclass
class WireUse:
    """Use of the wire: seconds of all frames, of those that overlapped, and gaps by the frames on both sides."""

    frames: float = 0.0
    overlap: float = 0.0
    count: int = 0

    def __post_init__(self) -> None:
        self.gaps: defaultdict[str, list[float]] = defaultdict(list)

    @classmethod
    def of(cls, frames: Sequence[Frame], began: float, ended: float) -> WireUse:
        """Return the use between two times."""
        use, free, before = cls(), began, "the begin"
        for frame in frames:
            if not began < frame.at <= ended:
                continue
            wire_time = wire_seconds(frame)
            use.frames += wire_time
            use.count += 1
            gap = frame.at - wire_time - free
            use.overlap += min(wire_time, max(0.0, -gap))
            use.gaps[f"{before} to {_kind(frame)}"].append(gap)
            free, before = max(free, frame.at), _kind(frame)
        return use

    def show(self) -> None:
        """Print gaps, the longest in all first."""
        for name, gaps in sorted(self.gaps.items(), key=lambda item: -sum(item[1])):
            total = sum(gaps)
            print(f"    {name:<46}{len(gaps):>7} x{total / len(gaps) * 1e6:>7.0f} us = {total * 1e3:>8.1f} ms")


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
def board(folder: Path, link: str, row: Row, image: Path, key: Path) -> Iterator[tuple[bytes, int]]:
    """Run a node on the bus for the block; give its UUID and process id."""
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
        yield uuid, process.pid
    finally:
        process.terminate()
        process.wait(20)


@dataclass(frozen=True)
class Measured:
    """Figures of a row: how each board ended, seconds of all uploads, the use of the wire, and shares of a core."""

    ends: list[BoardUpdate]
    seconds: float = 0.0
    wire: WireUse | None = None
    station: float = 0.0
    pacing: float = 0.0
    nodes: float = 0.0


def measure(row: Row, octets: int, boards: int) -> Measured:
    """Update the boards of a row."""
    link = f"udp_multicast:239.74.163.13?port={free_port()}&pace=1{row.more}"
    with tempfile.TemporaryDirectory() as place, contextlib.ExitStack() as stack:
        folder, key = Path(place), Path(place, "owner.pem")
        imgtool("keygen", "-k", key, "-t", "ecdsa-p256")
        old, new = sign(folder, key, "1.0.0", 1000), sign(folder, key, "1.1.0", octets)
        station, _ = initialise(
            folder / "home", name="bench", keystore="file", ask=lambda *_: "correct horse", costs=passphrase.THROWAWAY
        )
        stack.callback(station.close)
        made = [stack.enter_context(board(folder / f"{n}", link, row, old, key)) for n in range(boards)]
        uuids = [uuid for uuid, _ in made]
        links = LinkSettings("can", can=link, via_chosen=True)
        time.sleep(0.7)  # their Announces
        _provision(station, links, uuids)
        counting = FrameCount(link)
        stack.callback(counting.close)
        times, image = UploadTimes([process for _, process in made]), load_firmware_image(new)
        orders = [(uuid, UpdateOrder(image)) for uuid in uuids]
        ends = list(update_boards(station, links, orders, lambda uuid: times, parallel=4 if row.many else 1))
        if len(times.ended) < boards:
            return Measured(ends)
        began, ended = times.began[0], times.ended[-1]
        seconds = ended.at - began.at
        return Measured(
            ends,
            seconds,
            WireUse.of(counting.frames(), began.at, ended.at),
            (ended.station - began.station) / seconds,
            (ended.pacing - began.pacing) / seconds,
            (ended.nodes - began.nodes) / seconds,
        )


def _provision(station: Station, links: LinkSettings, uuids: list[bytes]) -> None:
    for uuid in uuids:
        with meet(station, links, uuid, SilentReporter(), before=station.unlock) as node:
            provision(
                station,
                node,
                BuildOrder(PROFILE, accept_calibration="a benchmark"),
                operator=AcceptingOperator(),
                reporter=SilentReporter(),
            )


def show(row: Row, boards: int, measured: Measured, *, exchanges: bool) -> None:
    """Print a row."""
    failed = [end for end in measured.ends if end.result != "updated"]
    wire = measured.wire
    if failed or wire is None:
        print(f"{row.title:<40} {failed[0].result}: {failed[0].error}" if failed else f"{row.title:<40} no upload")
        return
    ratio = (measured.seconds + wire.overlap) / wire.frames
    met = "met" if ratio <= row.aim else "MISSED"
    print(
        f"{row.title:<40}{boards:>3} x{measured.seconds:>8.2f} s, wire {wire.frames:>7.2f} s ({wire.count} frames,"
        f" {wire.overlap:.2f} s overlap): {ratio:>5.2f}; aim {row.aim}: {met}; station {measured.station:.0%} of a core"
        f" (pacing {measured.pacing:.0%}), nodes {measured.nodes:.0%}; load {os.getloadavg()[0]:.0f}",
        flush=True,
    )
    if exchanges:
        wire.show()


def main() -> None:
    """Print a row for each link."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kib", type=int, default=256, help="KiB of the image")
    parser.add_argument("--many-kib", type=int, default=64, help="KiB of it in the row with many boards, at most --kib")
    parser.add_argument("--boards", type=int, default=20, help="boards of the row with many")
    parser.add_argument("--only", default="", help="rows whose title contains this")
    parser.add_argument("--exchanges", action="store_true", help="where the wire was free")
    parser.add_argument("--listen", default="", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.listen:
        listen(options.listen)
        return
    PACING.count()
    print(f"{options.kib} KiB, of many boards {options.many_kib}; load {os.getloadavg()[0]:.1f}", flush=True)
    for row in ROWS:
        if options.only not in row.title or (row.in_c and not PROGRAM.exists()):
            continue
        boards = options.boards if row.many else 1
        kib = min(options.kib, options.many_kib) if row.many else options.kib
        show(row, boards, measure(row, kib << 10, boards), exchanges=options.exchanges)


if __name__ == "__main__":
    main()
